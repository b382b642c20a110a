"""What is seen through transparent surfaces: panes, water, bodies of glass.

Source of the weights: the UsdPreviewSurface specification. Opacity below 1 in its mode "transparent" is the share of the
light entering the surface that is not let through (`MaterialData.transmission` is the rest), and leaves the mirror term
alone; in its mode "presence" it is the share of the surface that is there (`MaterialData.opacity`). Fresnel's reflectance
on entering is Schlick's, as for the mirror term, so that both sum to 1; on leaving a body it is Fresnel's own, with total
reflection, which Schlick's does not know.

A pane is thin: one looks straight through. A solid body bends the ray by Snell's law on the way in and on the way out.
What a ray meets behind is shaded as what a mirror shows, and where that is transparent too the ray goes on, up to a number
of surfaces. What a body reflects inside, other than totally, is lost: it is not followed.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, launch, shade
from warp_reflect.layers import (
    CameraView,
    GBuffer,
    MirrorPixels,
    ReflectionLayer,
    eye_ray_direction,
    pixel_bounds,
)
from warp_reflect.normal_maps import prepare_normals
from warp_reflect.optics import dielectric_reflectance, refract
from warp_reflect.scene import SHAPE_NONE, PartRange, Scene, SceneView
from warp_reflect.settings import Settings, Technique
from warp_reflect.shadows import Shadows
from warp_reflect.shapes import facet_normal, unit
from warp_reflect.surface import hit_normal, polish, shown_normal, surface_at
from warp_reflect.textures import Look, plain_look, prepare_looks

wp.set_module_options({"enable_backward": False})

OPAQUE = wp.constant(0)
THIN = wp.constant(1)
SOLID = wp.constant(2)
KINDS = ("opaque", "thin", "solid")
# Share of the light below which what is behind is not looked for: half a step of an 8 bit picture.
LEAST_WEIGHT = wp.constant(2.0e-3)


@wp.struct
class InterfaceView:
    """How light goes through a patch."""

    kind: int  # OPAQUE, THIN or SOLID
    ior: float


@wp.struct
class Crossing:
    """A ray behind a surface."""

    direction: wp.vec3  # unit
    normal: wp.vec3  # of the facet, on the ray's side
    weight: wp.vec3  # of what it sees; 0: nothing goes on
    own: float  # of what the surface itself shows
    inside: int  # the ray is in the surface's body now


@dataclass
class Transmission:
    """What is seen through one surface.

    Attributes:
        layer: Its pixels' rays behind the surface and the first thing that they meet.
        weight: vec3 [n], share of it in the picture.
    """

    layer: ReflectionLayer
    weight: wp.array


def is_transparent(scene: Scene, part: PartRange) -> bool:
    """Whether anything is seen through a part."""
    material = scene.data.materials[part.material]
    return material.opacity < 1.0 or material.transmission > 0.0


def interface_of(scene: Scene, part_index: int) -> tuple[str, str]:
    """(one of `KINDS`, the reason) of a part."""
    part = scene.parts[part_index]
    material = scene.data.materials[part.material]
    if not is_transparent(scene, part):
        return "opaque", "opacity 1"
    shares = f"opacity {material.opacity:g}, transmission {material.transmission:g}"
    if material.transmission == 0.0:
        return "thin", f"{shares}: partly not there"
    if material.ior == 1.0:
        return "thin", f"{shares}, ior 1: nothing bends a ray"
    asked = material.finish.interface if material.finish is not None else "auto"
    if asked != "auto":
        return asked, f"{shares}, ior {material.ior:g}, {asked} as authored"
    if scene.body(part_index).closed:
        return "solid", f"{shares}, ior {material.ior:g}, closed: a body"
    return "thin", f"{shares}, open: a pane"


def interface_views(scene: Scene) -> wp.array:
    """`InterfaceView` of every patch of a scene."""
    views = [InterfaceView() for _ in scene.patch_shapes]
    for index, part in enumerate(scene.parts):
        kind, _ = interface_of(scene, index)
        for patch in part.patches:
            views[patch].kind = KINDS.index(kind)
            views[patch].ior = scene.data.materials[part.material].ior
    return wp.array(views, dtype=InterfaceView, device=scene.device)


@wp.func
def cross_interface(
    scene: SceneView,
    interface: InterfaceView,
    look: Look,
    triangle: int,
    n: wp.vec3,
    incident: wp.vec3,
    shaded: float,
    reflector: bool,
) -> Crossing:
    """Lead a ray through a surface.

    Args:
        scene: Holds the triangle.
        interface: Of its patch.
        look: Its material there.
        triangle: The facet.
        n: Unit shading normal on the side that the ray comes from, polished onto the analytic surface.
        incident: Unit, towards the surface.
        shaded: Cosine of the angle of incidence that the surface itself is shaded by: what is let through is what that leaves.
        reflector: Whether its mirror term is a reflector's, see `shade.split_lobes`.
    """
    crossing = Crossing()
    tri = scene.triangles[triangle]
    outward = facet_normal(scene.points[tri[0]], scene.points[tri[1]], scene.points[tri[2]])
    leaving = wp.dot(outward, incident) > 0.0
    cosine = wp.abs(wp.dot(n, incident))
    lobes = shade.split_lobes(look, wp.vec3(0.0, 0.0, 0.0), shaded, reflector)
    crossing.direction = incident
    crossing.weight = lobes.through
    crossing.own = 1.0
    if interface.kind == SOLID:
        if not leaving:
            crossing.direction = unit(refract(incident, n, interface.ior))
            crossing.inside = 1
        else:
            back = 1.0 / interface.ior
            crossing.direction = unit(refract(incident, n, back))
            share = look.opacity * look.transmission * (1.0 - dielectric_reflectance(cosine, back)) + 1.0 - look.opacity
            # Seen from inside, a surface shows nothing of its own but what it scatters.
            crossing.own = 1.0 - look.transmission
            if crossing.direction[0] == 0.0 and crossing.direction[1] == 0.0 and crossing.direction[2] == 0.0:
                crossing.direction = unit(incident - 2.0 * wp.dot(incident, n) * n)
                crossing.inside = 1
                share = look.opacity * look.transmission
            crossing.weight = wp.vec3(share, share, share)
    crossing.normal = outward
    if wp.dot(outward, crossing.direction) < 0.0:
        crossing.normal = -outward
    return crossing


@wp.kernel
def cross_seen_kernel(
    first: int,
    scene: SceneView,
    camera: CameraView,
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    reflector_id: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    # Outputs:
    out_facet: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
):
    """One thread per pixel that shows a transparent surface."""
    i = first + wp.tid()
    p = pixel[i]
    row = p // camera.width
    tri = triangle[p]
    x = float(p - row * camera.width) + 0.5
    y = float(row) + 0.5
    s = surface_at(scene, camera, tri, depth_key[p], x, y)
    uv = shade.weights_seen(scene, camera, tri, x, y)
    look = Look()
    if looks.shape[0] > 0:
        look = looks[p]
    else:
        look = plain_look(scene, tri, uv[0], uv[1])
    n = shown_normal(normals, p, hit_normal(scene, tri, uv[0], uv[1]))
    shaded = wp.abs(wp.dot(n, unit(eye_ray_direction(camera, x, y))))
    interface = interfaces[scene.triangle_patch[tri]]
    crossing = cross_interface(scene, interface, look, tri, s.normal, s.incident, shaded, reflector_id[p] > 0)
    out_facet[i] = tri
    out_point[i] = s.p_scene
    out_normal[i] = crossing.normal
    out_direction[i] = crossing.direction
    out_inside[i] = wp.uint8(crossing.inside)
    out_weight[i] = crossing.weight


@wp.kernel
def cross_hits_kernel(
    first: int,
    scene: SceneView,
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    # Hits:
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.vec3),
    # Outputs:
    out_own: wp.array(dtype=float),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
):
    """One thread per ray: where it goes on behind what it met; weight 0 where it does not."""
    i = first + wp.tid()
    tri = triangle[i]
    out_own[i] = 1.0
    if tri < 0:
        return
    patch = scene.triangle_patch[tri]
    if interfaces[patch].kind == OPAQUE:
        return
    d = direction[i]
    corner = scene.triangles[tri]
    p = (1.0 - u[i] - v[i]) * scene.points[corner[0]] + u[i] * scene.points[corner[1]] + v[i] * scene.points[corner[2]]
    n = hit_normal(scene, tri, u[i], v[i])
    shaded = wp.abs(wp.dot(shown_normal(normals, i, n), d))
    if scene.patches[patch].shape != SHAPE_NONE:
        polished = polish(scene, tri, p, d)
        if polished[0] != 0.0 or polished[1] != 0.0 or polished[2] != 0.0:
            n = wp.vec3(polished[0], polished[1], polished[2])
            p += polished[3] * d
    if wp.dot(n, d) > 0.0:
        n = -n
    look = Look()
    if looks.shape[0] > 0:
        look = looks[i]
    else:
        look = plain_look(scene, tri, u[i], v[i])
    crossing = cross_interface(scene, interfaces[patch], look, tri, n, d, shaded, False)
    out_own[i] = crossing.own
    out_point[i] = p
    out_normal[i] = crossing.normal
    out_direction[i] = crossing.direction
    out_inside[i] = wp.uint8(crossing.inside)
    carried = wp.cw_mul(weight[i], crossing.weight)
    if wp.max(carried) >= LEAST_WEIGHT:
        out_weight[i] = carried


@wp.kernel
def gather_kernel(
    first: int,
    index: wp.array(dtype=int),
    weight: wp.array(dtype=wp.vec3),
    own: wp.array(dtype=float),
    seen: wp.array(dtype=wp.vec3),
    out_total: wp.array(dtype=wp.vec3),
):
    """One thread per ray; each adds to the total of its own pixel."""
    i = first + wp.tid()
    out_total[index[i]] += own[i] * wp.cw_mul(weight[i], seen[i])


@wp.kernel
def transmitted_term_kernel(
    first: int,
    pixel: wp.array(dtype=int),
    weight: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_picture: wp.array(dtype=wp.vec4),
):
    """One thread per pixel that shows a transparent surface."""
    i = first + wp.tid()
    term = wp.cw_mul(weight[i], radiance[i])
    out_picture[pixel[i]] += wp.vec4(term[0], term[1], term[2], 0.0)


def look_through(
    scene: Scene, gbuffer: GBuffer, interfaces: wp.array, parts: Iterable[int], settings: Settings
) -> dict[int, Transmission]:
    """The rays behind the transparent surfaces that the eye sees, and the first thing that each meets.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        interfaces: From `interface_views`.
        parts: The transparent surfaces, indices into `scene.parts`.
        settings: Threads.

    Returns:
        By part; nothing of one that is not seen.
    """
    device, threads = scene.device, settings.threads
    triangle = gbuffer.triangle.numpy()
    shown = np.full(len(triangle), -1)
    part_of_patch = np.full(max(len(scene.patch_shapes), 1), -1)
    for part in parts:
        part_of_patch[list(scene.parts[part].patches)] = part
    shown[triangle >= 0] = part_of_patch[scene.host_triangle_patch[triangle[triangle >= 0]]]
    looks = prepare_looks(scene, gbuffer, None, threads)
    normals = prepare_normals(scene, gbuffer, None, threads)
    found = {}
    for part in sorted(parts):
        pixel = np.flatnonzero(shown == part).astype(np.int32)
        if not len(pixel):
            continue
        n = len(pixel)
        vectors = [wp.empty(n, dtype=wp.vec3, device=device) for _ in range(4)]
        point, normal, direction, weight = vectors
        facet, inside = wp.empty(n, dtype=int, device=device), wp.empty(n, dtype=wp.uint8, device=device)
        box = pixel_bounds(pixel, gbuffer.camera.size[0])
        pixels = MirrorPixels(0, wp.array(pixel, dtype=int, device=device), point, normal, direction, box)
        inputs = [scene.view, gbuffer.view, interfaces, looks, normals, gbuffer.triangle, gbuffer.depth_key]
        inputs += [gbuffer.reflector_id, pixels.pixel]
        launch.launch(cross_seen_kernel, n, [*inputs, facet, point, normal, direction, inside, weight], device, threads)
        layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, device)
        bvh.trace_transmitted(scene, layer, facet, inside, threads)
        found[part] = Transmission(layer, weight)
    return found


def behind(
    scene: Scene,
    gbuffer: GBuffer,
    interfaces: wp.array,
    layer: ReflectionLayer,
    seen: wp.array,
    settings: Settings,
    shadows: Shadows | None = None,
) -> wp.array:
    """What a layer's rays see, with all that is behind the transparent surfaces among it.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        interfaces: From `interface_views`.
        layer: Rays and what they met.
        seen: vec3 [n], radiance of that; not written to.
        settings: `transparency_depth`, threads.
        shadows: Which lights cast shadows; None: none.

    Returns:
        vec3 [n]; `seen` itself where nothing is transparent. The layer's statistics get `onward`: rays followed, and
        `depth_limit`: those that `transparency_depth` ended (through the surface they met nothing is seen).
    """
    device, threads = scene.device, settings.threads
    count = layer.pixels.count
    index = np.arange(count, dtype=np.int32)
    weight = wp.full(count, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
    total = None
    for depth in range(settings.transparency_depth + 1):
        n = layer.pixels.count
        looks = prepare_looks(scene, gbuffer, layer, threads)
        normals = prepare_normals(scene, gbuffer, layer, threads)
        own = wp.empty(n, dtype=float, device=device)
        point, normal, direction, carried = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(4))
        inside = wp.zeros(n, dtype=wp.uint8, device=device)
        inputs = [scene.view, interfaces, looks, normals, layer.triangle, layer.u, layer.v]
        inputs += [layer.pixels.direction, weight]
        outputs = [own, point, normal, direction, inside, carried]
        launch.launch(cross_hits_kernel, n, inputs + outputs, device, threads)
        going = np.flatnonzero(carried.numpy().max(axis=1) > 0.0)
        if depth == 0:
            if not len(going):
                return seen
            total, first = wp.zeros(count, dtype=wp.vec3, device=device), layer
        gathered = [wp.array(index, dtype=int, device=device), weight, own, seen, total]
        launch.launch(gather_kernel, n, gathered, device, threads)
        if depth == settings.transparency_depth:
            _count(first, depth_limit=len(going))
            break
        if not len(going):
            break
        _count(first, onward=len(going))
        taken = lambda array: wp.array(array.numpy()[going], dtype=array.dtype, device=device)  # noqa: B023, E731
        index, weight = index[going], taken(carried)
        pixels = MirrorPixels(
            layer.pixels.reflector,
            taken(layer.pixels.pixel),
            taken(point),
            taken(normal),
            taken(direction),
            layer.pixels.box,
        )
        facet, inside = taken(layer.triangle), taken(inside)
        layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, device)
        bvh.trace_transmitted(scene, layer, facet, inside, threads)
        seen = shade.seen_radiance(scene, gbuffer, layer, threads, shadows)
    return total


def _count(layer: ReflectionLayer, **numbers: int) -> None:
    for name, value in numbers.items():
        layer.statistics[name] = layer.statistics.get(name, 0) + value


def add_to_picture(picture: wp.array, transmission: Transmission, radiance: wp.array, threads: int = 0) -> None:
    """Add what is seen through a surface to the picture that has its own light already.

    Args:
        picture: vec4 [height * width].
        transmission: The surface's.
        radiance: vec3 [n], what its pixels see behind it.
        threads: CPU threads; 0: one per core.
    """
    pixels = transmission.layer.pixels
    inputs = [pixels.pixel, transmission.weight, radiance, picture]
    launch.launch(transmitted_term_kernel, pixels.count, inputs, picture.device, threads)
