"""Deferred shading: the picture from the G-buffer and the reflectors' layers.

Approximates UsdPreviewSurface, textures included (`textures.py`):

* base: Lambert under the dome's irradiance (its first nine spherical harmonics), the distant lights and the shapes
  that emit (`direct.py`), with the shadows asked for (`shadows.py`);
* mirror term: Schlick's Fresnel between F0 and F90 at the angle of incidence, and the white clear coat on top
  of it, times the radiance from the reflected direction. At a reflector that is the surface its layer names;
  elsewhere, and for a mirror seen in a mirror, the dome;
* roughness: up to `SHARP_ROUGHNESS` a surface mirrors, from `ROUGH_ROUGHNESS` on its specular share is
  reflected like Lambert's, between them it is divided linearly (a lobe's shape is not modelled); a reflector
  mirrors whatever its roughness, and a finish (`finishes/glossy.py`) gives its mirror image the lobe's shape;
* the clear coat's roughness divides its share as the base's is divided;
* energy: what the clear coat and the mirror term take is taken from the layers below;
* normal maps turn the normal of what is no reflector, seen directly or in one, and of a reflector where the plan says so.

What is seen through a surface is not here (`transmission.py`), but its share is left for it. The background is the dome;
alpha is coverage.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import compact, launch, vector
from warp_reflect.direct import AREA_KINDS, AreaView, DirectView, direct_irradiance, points_of, prepare_direct
from warp_reflect.layers import (
    CameraView,
    GBuffer,
    ReflectionLayer,
    eye_ray_direction,
    eye_ray_origin,
    undivided,
)
from warp_reflect.normal_maps import prepare_normals
from warp_reflect.scene import SHAPE_QUADRIC, Scene, SceneView
from warp_reflect.shadows import Shadows, shadowed_irradiance, sky_share
from warp_reflect.shapes import clamp_weights, intersect_triangle, unit
from warp_reflect.surface import hit_normal, shown_normal
from warp_reflect.textures import Look, plain_look, prepare_looks

wp.set_module_options({"enable_backward": False})
PLAIN = launch.module_part(__name__, "plain")  # what vector kernels do elsewhere

# The grey dome of a stage without any light: radiance at the horizon, and what is added straight up and taken
# straight down, so that shapes can be told.
DEFAULT_SKY = 0.5
DEFAULT_SLOPE = 0.3
# Up to the first a mirror image looks sharp; at the second the lobe is some 35 degrees wide.
SHARP_ROUGHNESS = wp.constant(0.05)
ROUGH_ROUGHNESS = wp.constant(0.3)
PI = wp.constant(float(np.pi))
LIGHT_KINDS = ("dome", "distant", *AREA_KINDS)


@dataclass(frozen=True)
class Shown:
    """What the eye sees directly, with what textures say of it.

    Attributes:
        looks: `Look` [height * width], see `textures.prepare_looks`.
        normals: vec3 [height * width], see `normal_maps.prepare_normals`.
        seen: Radiance, vec3 [n], that a layer's rays see.
        add: The same, but what a layer does not know itself goes with the mirrors' weights into a picture and the weights, and
            of length 0 is returned; None: there is no such way.
    """

    gbuffer: GBuffer
    looks: wp.array
    normals: wp.array
    seen: Callable[[ReflectionLayer], wp.array]
    add: Callable[[ReflectionLayer, tuple[wp.array, wp.array]], wp.array] | None = None


# Of what is shown, a mirror's layer and what its pixels see in a sharp mirror: what they see in this one.
Finish = Callable[[Shown, ReflectionLayer, wp.array], wp.array]


@wp.struct
class DomeView:
    """A textured dome light: a latlong map in OpenEXR orientation, its pole the light's +Y."""

    first_texel: int
    width: int
    height: int
    color: wp.vec3
    light_from_world: wp.mat33


@wp.struct
class LightView:
    """All light of a scene. Directions have world axes."""

    sky: wp.vec3  # radiance of the domes without a texture
    sky_slope: wp.vec3  # grey radiance added in proportion to the direction's component along this vector
    domes: wp.array(dtype=DomeView)
    texels: wp.array(dtype=wp.vec3)
    direct: DirectView
    # Irradiance of the textured domes on a surface of normal (x, y, z): a quadratic form.
    e_1: wp.vec3
    e_x: wp.vec3
    e_y: wp.vec3
    e_z: wp.vec3
    e_xx: wp.vec3
    e_yy: wp.vec3
    e_zz: wp.vec3
    e_xy: wp.vec3
    e_yz: wp.vec3
    e_xz: wp.vec3


def dome_moments(texture: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrals of a latlong map's radiance L(d) over the sphere: of L, L d and L d d^T.

    Args:
        texture: Latlong map in OpenEXR orientation, shape [h, w, 3].

    Returns:
        float64 [3 channels], [3 channels, 3], [3 channels, 3, 3], in the light's frame.
    """
    height, width = texture.shape[:2]
    edges = np.sin(np.linspace(0.5 * np.pi, -0.5 * np.pi, height + 1))
    solid_angle = (edges[:-1] - edges[1:]) * (2.0 * np.pi / width)
    lat = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    lon = (1.0 - 2.0 * (np.arange(width) + 0.5) / width) * np.pi
    # The map's rows against functions of the longitude first: five sums a row hold all moments.
    functions = np.stack([np.ones(width), np.sin(lon), np.cos(lon), np.sin(lon) ** 2, np.sin(lon) * np.cos(lon)])
    one, sx, cz, sxx, sxz = np.einsum("kw,hwc->khc", functions, texture.astype(np.float64), optimize=True)
    c, s = np.cos(lat)[:, None], np.sin(lat)[:, None]

    def total(rows: np.ndarray) -> np.ndarray:
        return solid_angle @ rows

    first = np.stack([total(c * sx), total(s * one), total(c * cz)], axis=-1)
    xy, yz, xz = total(c * s * sx), total(c * s * cz), total(c * c * sxz)
    xx, yy, zz = total(c * c * sxx), total(s * s * one), total(c * c * (one - sxx))
    second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(3, 3, 3)
    return total(one), first, second


def prepare_lights(scene: Scene) -> LightView:
    """The device form of a scene's lights; unknown kinds are left out.

    Source of the irradiance: Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment
    Maps, 2001, equation 8 (cosine lobe coefficients pi, 2 pi / 3, pi / 4). Differs from it by: moments of the
    radiance instead of spherical harmonics, which span the same functions and turn with the light as a vector
    and a matrix do.
    """
    domes = [light for light in scene.data.lights if light.kind == "dome"]
    zeroth, first, second = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3, 3))
    sky, sky_slope = np.zeros(3), np.zeros(3)
    if not any(light.kind in LIGHT_KINDS for light in scene.data.lights):
        sky[:] = DEFAULT_SKY
        sky_slope["XYZ".index(scene.data.up_axis)] = DEFAULT_SLOPE
    dome_views, texels, texel_count = [], [], 0
    for light in domes:
        color = np.asarray(light.color, np.float64)
        if light.texture is None:
            sky += color
            continue
        world_from_light = _rotation(light.world_from_light)
        m0, m1, m2 = dome_moments(light.texture)
        zeroth += color * m0
        first += color[:, None] * (m1 @ world_from_light.T)
        second += color[:, None, None] * (world_from_light @ m2 @ world_from_light.T)
        view = DomeView()
        view.first_texel = texel_count
        view.height, view.width = light.texture.shape[:2]
        view.color = wp.vec3(*color)
        view.light_from_world = wp.mat33(world_from_light.T.astype(np.float32))
        dome_views.append(view)
        texels.append(np.ascontiguousarray(light.texture, np.float32).reshape(-1, 3))
        texel_count += len(texels[-1])

    lights = LightView()
    device = scene.device
    lights.sky = wp.vec3(*sky)
    lights.sky_slope = wp.vec3(*sky_slope)
    lights.domes = wp.array(dome_views, dtype=DomeView, device=device)
    lights.texels = wp.array(
        np.concatenate(texels) if texels else np.zeros((0, 3), np.float32), dtype=wp.vec3, device=device
    )
    lights.direct = prepare_direct(scene.data.lights, scene.origin, device)
    # E(n) = sum over l of A_l (2 l + 1) / (4 pi) * integral of L(d) P_l(n . d), A = (pi, 2 pi / 3, pi / 4).
    linear, quadratic = 0.5 * first, 15.0 / 32.0 * second
    lights.e_1 = wp.vec3(*((1.0 / 4.0 - 5.0 / 32.0) * zeroth))
    lights.e_x, lights.e_y, lights.e_z = (wp.vec3(*linear[:, k]) for k in range(3))
    lights.e_xx, lights.e_yy, lights.e_zz = (wp.vec3(*quadratic[:, k, k]) for k in range(3))
    lights.e_xy = wp.vec3(*(2.0 * quadratic[:, 0, 1]))
    lights.e_yz = wp.vec3(*(2.0 * quadratic[:, 1, 2]))
    lights.e_xz = wp.vec3(*(2.0 * quadratic[:, 0, 2]))
    return lights


def _rotation(matrix: np.ndarray) -> np.ndarray:
    """The rotation of a light's transform: its axes at unit length."""
    axes = np.asarray(matrix, np.float64)[:3, :3]
    return axes / np.linalg.norm(axes, axis=0)


@wp.func
def map_radiance(lights: LightView, dome: DomeView, direction: wp.vec3) -> wp.vec3:
    """Bilinear look-up of a latlong map; wraps around the pole's axis, ends at the poles."""
    d = dome.light_from_world * direction
    lon = wp.atan2(d[0], d[2])
    lat = wp.asin(wp.clamp(d[1], -1.0, 1.0))
    x = (0.5 - lon / (2.0 * PI)) * float(dome.width) - 0.5
    y = wp.clamp((0.5 - lat / PI) * float(dome.height) - 0.5, 0.0, float(dome.height - 1))
    x_floor = wp.floor(x)
    fx = x - x_floor
    x0 = int(x_floor)
    if x0 < 0:
        x0 += dome.width
    x1 = x0 + 1
    if x1 >= dome.width:
        x1 -= dome.width
    y0 = int(y)
    y1 = wp.min(y0 + 1, dome.height - 1)
    fy = y - float(y0)
    upper = dome.first_texel + y0 * dome.width
    lower = dome.first_texel + y1 * dome.width
    top = (1.0 - fx) * lights.texels[upper + x0] + fx * lights.texels[upper + x1]
    bottom = (1.0 - fx) * lights.texels[lower + x0] + fx * lights.texels[lower + x1]
    return wp.cw_mul(dome.color, (1.0 - fy) * top + fy * bottom)


@wp.func
def dome_radiance(lights: LightView, direction: wp.vec3) -> wp.vec3:
    """Radiance of all domes from a unit direction."""
    grey = wp.dot(lights.sky_slope, direction)
    radiance = lights.sky + wp.vec3(grey, grey, grey)
    for k in range(lights.domes.shape[0]):
        radiance += map_radiance(lights, lights.domes[k], direction)
    return radiance


@wp.func
def dome_irradiance(lights: LightView, n: wp.vec3) -> wp.vec3:
    """Irradiance of all domes on a surface of unit normal n."""
    grey = (2.0 * PI / 3.0) * wp.dot(lights.sky_slope, n)
    total = PI * lights.sky + wp.vec3(grey, grey, grey)
    if lights.domes.shape[0] > 0:
        e = lights.e_1 + n[0] * lights.e_x + n[1] * lights.e_y + n[2] * lights.e_z
        e += n[0] * (n[0] * lights.e_xx + n[1] * lights.e_xy + n[2] * lights.e_xz)
        e += n[1] * (n[1] * lights.e_yy + n[2] * lights.e_yz) + n[2] * n[2] * lights.e_zz
        # A small bright sun drives nine coefficients below zero on its far side.
        total += wp.vec3(wp.max(e[0], 0.0), wp.max(e[1], 0.0), wp.max(e[2], 0.0))
    return total


@wp.kernel
def dome_irradiance_kernel(
    first: int, lights: LightView, normal: wp.array(dtype=wp.vec3), out_irradiance: wp.array(dtype=wp.vec3)
):
    """One thread per normal."""
    i = first + wp.tid()
    out_irradiance[i] = dome_irradiance(lights, normal[i])


def dome_irradiances(scene: Scene, normal: np.ndarray, threads: int = 0) -> np.ndarray:
    """Irradiance of a scene's domes on surfaces of unit normals [n, 3], float32 [n, 3]."""
    normals = wp.array(np.ascontiguousarray(normal, np.float32), dtype=wp.vec3, device=scene.device, copy=False)
    result = wp.zeros(len(normals), dtype=wp.vec3, device=scene.device)
    launch.launch(dome_irradiance_kernel, len(normals), [scene.lights, normals, result], scene.device, threads)
    return result.numpy()


@wp.func
def irradiance_at(
    lights: LightView, direct: wp.array(dtype=wp.vec3), sky: wp.array(dtype=float), i: int, n: wp.vec3
) -> wp.vec3:
    """Irradiance of all lights on a surface of unit normal n; `direct` has point i's share of all but the domes.

    Where `direct` is empty there are only domes and distant lights, without shadows. `sky` has the share of the domes
    that reaches point i; empty: all.
    """
    total = dome_irradiance(lights, n)
    if sky.shape[0] > 0:
        total *= sky[i]
    if direct.shape[0] > 0:
        return total + direct[i]
    for k in range(lights.direct.distant.shape[0]):
        cosine = wp.max(wp.dot(n, lights.direct.distant[k].to_light), 0.0)
        total += cosine * lights.direct.distant[k].irradiance
    return total


@wp.struct
class Lobes:
    """What a surface does with light at one point and angle: base + mirror * radiance(reflected) + through * radiance(behind)."""

    base: wp.vec3
    mirror: wp.vec3
    through: wp.vec3


@wp.func
def schlick(f0: wp.vec3, f90: wp.vec3, cosine: float) -> wp.vec3:
    """Fresnel reflectance. Source: Schlick, An Inexpensive BRDF Model, 1994, equation 15, with a free F90."""
    m = 1.0 - wp.clamp(cosine, 0.0, 1.0)
    m2 = m * m
    return f0 + (m2 * m2 * m) * (f90 - f0)


@wp.func
def sharp_share(roughness: float, reflector: bool) -> float:
    """Share of a specular lobe that is reflected as a mirror does."""
    if reflector:
        return 1.0
    return wp.clamp((ROUGH_ROUGHNESS - roughness) / (ROUGH_ROUGHNESS - SHARP_ROUGHNESS), 0.0, 1.0)


@wp.func
def split_lobes(look: Look, irradiance: wp.vec3, cosine: float, reflector: bool) -> Lobes:
    """Base radiance, mirror weight and weight of what is behind a surface.

    `irradiance` is that of the viewer's side, `cosine` that of the angle of incidence.
    """
    sharp = sharp_share(look.roughness, reflector)
    mirror = wp.vec3(0.0, 0.0, 0.0)
    if sharp > 0.0:
        mirror = sharp * schlick(look.f0, look.f90, cosine)
    blurred = (1.0 - sharp) * look.f0
    # F90 is 1 for a dielectric and the colour itself for a metal: the difference reaches the diffuse layer.
    albedo = blurred + (1.0 - look.transmission) * wp.cw_mul(look.f90 - mirror - blurred, look.base_color)
    through = look.transmission * (wp.vec3(1.0, 1.0, 1.0) - mirror - blurred)
    if look.clearcoat > 0.0:
        f0 = look.clearcoat_f0
        coat = look.clearcoat * schlick(wp.vec3(f0, f0, f0), wp.vec3(1.0, 1.0, 1.0), cosine)[0]
        sharp_coat = coat * sharp_share(look.clearcoat_roughness, reflector)
        blurred_coat = coat - sharp_coat
        albedo = (1.0 - coat) * albedo + wp.vec3(blurred_coat, blurred_coat, blurred_coat)
        mirror = (1.0 - coat) * mirror + wp.vec3(sharp_coat, sharp_coat, sharp_coat)
        through = (1.0 - coat) * through
    absent = 1.0 - look.opacity
    lobes = Lobes()
    lobes.base = look.opacity * (look.emissive + wp.cw_mul(albedo, (1.0 / PI) * irradiance))
    lobes.mirror = look.opacity * mirror
    lobes.through = look.opacity * through + wp.vec3(absent, absent, absent)
    return lobes


@wp.func
def weights_matter(scene: SceneView, triangle: int) -> bool:
    """Whether shading looks different from point to point of a triangle."""
    if scene.normal_index[triangle][0] >= 0 or scene.color_index.shape[0] > 0:
        return True
    return scene.patches[scene.triangle_patch[triangle]].shape == SHAPE_QUADRIC


@wp.func
def weights_seen(scene: SceneView, camera: CameraView, triangle: int, x: float, y: float) -> wp.vec2:
    """Weights of a triangle's second and third corner at pixel coordinate (x, y), where they matter for shading."""
    uv = wp.vec2(0.0, 0.0)
    if weights_matter(scene, triangle):
        corner = scene.triangles[triangle]
        hit = intersect_triangle(
            eye_ray_origin(camera, x, y),
            eye_ray_direction(camera, x, y),
            scene.points[corner[0]] - camera.eye,
            scene.points[corner[1]] - camera.eye,
            scene.points[corner[2]] - camera.eye,
        )
        uv = clamp_weights(hit.u, hit.v)
    return uv


@wp.func
def hit_radiance(
    scene: SceneView,
    lights: LightView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    i: int,
    triangle: int,
    u: float,
    v: float,
    direction: wp.vec3,
) -> wp.vec3:
    """Radiance back along a unit ray: of the surface it hits, which mirrors only the dome, or of the dome."""
    base = wp.vec3(0.0, 0.0, 0.0)
    weight = wp.vec3(1.0, 1.0, 1.0)
    onward = direction
    if triangle >= 0:
        n = shown_normal(normals, i, hit_normal(scene, triangle, u, v))
        cosine = wp.dot(n, direction)
        onward = direction - 2.0 * cosine * n
        if cosine > 0.0:
            n = -n
        look = Look()
        if looks.shape[0] > 0:
            look = looks[i]
        else:
            look = plain_look(scene, triangle, u, v)
        lobes = split_lobes(look, irradiance_at(lights, direct, sky, i, n), wp.abs(cosine), False)
        base = lobes.base
        weight = lobes.mirror
    if wp.max(weight) > 0.0:
        base += wp.cw_mul(weight, dome_radiance(lights, onward))
    return base


@wp.kernel(module=PLAIN)
def shade_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    lights: LightView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    # Outputs:
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
):
    """One thread per pixel: all but the mirror term of reflectors, whose weight is left in `out_mirror`."""
    i = first + wp.tid()
    row = i // camera[0].width
    x = float(i - row * camera[0].width) + 0.5
    y = float(row) + 0.5
    tri = triangle[i]
    incident = unit(eye_ray_direction(camera[0], x, y))
    base = wp.vec3(0.0, 0.0, 0.0)
    weight = wp.vec3(1.0, 1.0, 1.0)
    onward = incident
    reflector = reflector_id[i] > 0
    coverage = float(0.0)
    if tri >= 0:
        uv = weights_seen(scene, camera[0], tri, x, y)
        n = shown_normal(normals, i, hit_normal(scene, tri, uv[0], uv[1]))
        cosine = wp.dot(n, incident)
        onward = incident - 2.0 * cosine * n
        if cosine > 0.0:
            n = -n
        look = Look()
        if looks.shape[0] > 0:
            look = looks[i]
        else:
            look = plain_look(scene, tri, uv[0], uv[1])
        lobes = split_lobes(look, irradiance_at(lights, direct, sky, i, n), wp.abs(cosine), reflector)
        base = lobes.base
        weight = lobes.mirror
        coverage = float(1.0)
    if reflector:
        out_mirror[i] = weight
    else:
        out_mirror[i] = wp.vec3(0.0, 0.0, 0.0)
        if wp.max(weight) > 0.0:
            base += wp.cw_mul(weight, dome_radiance(lights, onward))
    out_picture[i] = wp.vec4(base[0], base[1], base[2], coverage)


@wp.kernel(module=PLAIN)
def seen_radiance_kernel(
    first: int,
    scene: SceneView,
    lights: LightView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    out_radiance[i] = hit_radiance(scene, lights, looks, normals, direct, sky, i, triangle[i], u[i], v[i], direction[i])


@wp.kernel(module=PLAIN)
def mirror_term_kernel(
    first: int,
    pixel: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    # Outputs:
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel, but for the number -1; finds the mirror's weight in `out_mirror`."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        return
    term = wp.cw_mul(out_mirror[p], radiance[i])
    out_mirror[p] = term
    out_picture[p] += wp.vec4(term[0], term[1], term[2], 0.0)


def arriving(
    scene: Scene,
    gbuffer: GBuffer,
    layer: ReflectionLayer | None,
    normals: wp.array,
    threads: int = 0,
    shadows: Shadows | None = None,
    without_areas: bool = False,
    kernels: str = "auto",
) -> tuple[wp.array, wp.array]:
    """The light that reaches what a frame shows, as far as it is not the same everywhere.

    Args:
        layer: What is seen in a mirror; None: of what the eye sees itself.
        normals: From `normal_maps.prepare_normals`.
        shadows: Which lights cast shadows; None: none.
        without_areas: The shapes' light is added where it is used, see `summed_late`.
        kernels: `Settings.kernels`.

    Returns:
        (irradiance of distant lights and shapes vec3 [n], length 0 where there are neither shapes nor shadows: the distant
        lights alone are summed where they are used; share of the domes float32 [n], length 0: all of them).
    """
    direct = compact.none(wp.vec3, scene.device)
    sky = compact.none(float, scene.device)
    asked = shadows is not None and scene.triangle_count > 0
    areas = 0 if without_areas else len(scene.lights.direct.areas)
    if not asked and areas == 0:
        return direct, sky
    # What rays are sent from is found in vectors, which need no weights before.
    late = asked and shadows.direct and scene.has_hole is None and vector.chosen(kernels, scene.device)
    points = points_of(scene, gbuffer, layer, threads, weighed=not late)
    if asked and shadows.direct:
        direct = shadowed_irradiance(scene, points, shadows, threads, normals, kernels)
    elif areas > 0:
        direct = direct_irradiance(scene, scene.lights.direct, points, threads, normals)
    if asked and shadows.domes:
        sky = sky_share(scene, points, shadows.samples, threads, normals, kernels)
    return direct, sky


def summed_late(scene: Scene, shadows: Shadows | None) -> wp.array:
    """The shapes whose light the vector kernels add themselves, `AreaView`: all, where they are spheres without shadows."""
    kinds = {light.kind for light in scene.data.lights} & set(AREA_KINDS)
    if kinds == {"sphere"} and not (shadows is not None and shadows.direct):
        return scene.lights.direct.areas
    return compact.none(AreaView, scene.device)


def seen_radiance(
    scene: Scene,
    gbuffer: GBuffer,
    layer: ReflectionLayer,
    threads: int = 0,
    shadows: Shadows | None = None,
    kernels: str = "auto",
    into: tuple[wp.array, wp.array] | None = None,
) -> wp.array:
    """What a mirror's pixels see, before the mirror's own weight.

    Args:
        kernels: `Settings.kernels`.
        into: Picture and mirrors' weights, see `Shown.add`; only where kernels are in vectors.

    Returns:
        Linear RGB radiance, vec3 [layer.pixels.count]: the layer's own where it has one (maps), else that of its hits.
    """
    if layer.radiance is not None:
        return layer.radiance
    pixels = layer.pixels
    looks = prepare_looks(scene, gbuffer, layer, threads)
    normals = prepare_normals(scene, gbuffer, layer, threads)
    if vector.chosen(kernels, scene.device):
        from warp_reflect import shade_vector  # which shades with this module's structures

        areas = summed_late(scene, shadows)
        direct, sky = arriving(scene, gbuffer, layer, normals, threads, shadows, len(areas) > 0, kernels)
        light = [scene.lights, areas, looks, normals, direct, sky, SHARP_ROUGHNESS, ROUGH_ROUGHNESS]
        return shade_vector.shade_rays(scene, gbuffer, layer, light, threads, into)
    direct, sky = arriving(scene, gbuffer, layer, normals, threads, shadows, kernels=kernels)
    inputs = [scene.view, scene.lights, looks, normals, direct, sky, pixels.direction, layer.triangle, layer.u, layer.v]
    radiance = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    launch.launch(seen_radiance_kernel, pixels.count, [*inputs, radiance], scene.device, threads)
    return radiance


def look(
    scene: Scene,
    gbuffer: GBuffer,
    threads: int = 0,
    shadows: Shadows | None = None,
    bumpy: Collection[int] = (),
    kernels: str = "auto",
) -> Shown:
    """What the eye sees, with what textures and normal maps say of it.

    Args:
        scene: On the G-buffer's device.
        gbuffer: With its `reflector_id` set.
        threads: CPU threads; 0: one per core.
        shadows: Which lights cast shadows on what is seen in mirrors; None: none.
        bumpy: Ids of the reflectors that have the normals of their maps.
        kernels: `Settings.kernels`.
    """
    looks, normals = prepare_looks(scene, gbuffer, None, threads), prepare_normals(scene, gbuffer, None, threads, bumpy)

    def seen(layer: ReflectionLayer, into: tuple[wp.array, wp.array] | None = None) -> wp.array:
        return seen_radiance(scene, gbuffer, layer, threads, shadows, kernels, into)

    return Shown(gbuffer, looks, normals, seen, seen if vector.chosen(kernels, scene.device) else None)


def shade(
    scene: Scene,
    gbuffer: GBuffer,
    layers: Mapping[int, ReflectionLayer],
    threads: int = 0,
    shadows: Shadows | None = None,
    finish: Finish | None = None,
    shown: Shown | None = None,
    kernels: str = "auto",
) -> tuple[wp.array, wp.array]:
    """The picture of a frame.

    Args:
        scene: On the G-buffer's device.
        gbuffer: With its `reflector_id` set.
        layers: The answer of every reflector that `reflector_id` names.
        threads: CPU threads; 0: one per core.
        shadows: Which lights cast shadows, directly seen and in mirrors; None: none.
        finish: Turns what a sharp mirror's pixels see (vec3 [layer.pixels.count]) into what this mirror's do; None: all
            are sharp.
        shown: What the eye sees, where more is known of it than `look` tells.
        kernels: `Settings.kernels`.

    Returns:
        (linear RGB radiance and coverage, vec4 [height * width]; the reflectors' mirror term alone, vec3
        [height * width], 0 elsewhere).
    """
    shown = shown or look(scene, gbuffer, threads, shadows, kernels=kernels)
    count = gbuffer.camera.size[0] * gbuffer.camera.size[1]
    device = scene.device
    lights, looks, normals = scene.lights, shown.looks, shown.normals
    picture = wp.empty(count, dtype=wp.vec4, device=device)
    mirror = wp.empty(count, dtype=wp.vec3, device=device)
    vectors = vector.chosen(kernels, device)
    if vectors:
        from warp_reflect import shade_vector  # which shades with this module's structures

        areas = summed_late(scene, shadows)
        direct, sky = arriving(scene, gbuffer, None, normals, threads, shadows, len(areas) > 0, kernels)
        light = [lights, areas, looks, normals, direct, sky, SHARP_ROUGHNESS, ROUGH_ROUGHNESS]
        shade_vector.shade_eye(scene, gbuffer, light, picture, mirror, threads)
    else:
        direct, sky = arriving(scene, gbuffer, None, normals, threads, shadows, kernels=kernels)
        inputs = [scene.view, gbuffer.view, lights, looks, normals, direct, sky, gbuffer.triangle]
        inputs += [gbuffer.reflector_id, picture, mirror]
        launch.launch(shade_kernel, count, inputs, device, threads)
    for layer in undivided(layers.values()):
        if finish is None and shown.add is not None:
            radiance = shown.add(layer, (picture, mirror))
            if not len(radiance):
                continue
        else:
            radiance = shown.seen(layer)
        if finish is not None:
            radiance = finish(shown, layer, radiance)
        term = [layer.pixels.pixel, radiance, picture, mirror]
        if vectors:
            shade_vector.add_mirror_term(*term, threads)
        else:
            launch.launch(mirror_term_kernel, layer.pixels.count, term, device, threads)
    return picture, mirror
