"""Light that comes straight from distant lights and from shapes: irradiance per pixel, unshadowed (`shadows.py` asks rays).

Only scenes with shapes that emit, and frames with shadows, pay for it. Shapes are seen themselves neither directly nor in
mirrors. Their irradiance is exact for rects (Lambert's formula) and for spheres; a disk is a regular polygon of its area,
a cylinder the rectangle that it shows to the point (off by about its radius over the distance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import compact, launch
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin
from warp_reflect.scene import LightData, Scene, SceneView
from warp_reflect.shapes import clamp_weights, intersect_triangle, unit
from warp_reflect.surface import hit_normal, shown_normal

wp.set_module_options({"enable_backward": False})
IRRADIANCE = launch.module_part(__name__, "irradiance")

AREA_KINDS = ("sphere", "rect", "disk", "cylinder")
POLYGON = wp.constant(0)
SPHERE = wp.constant(1)
CYLINDER = wp.constant(2)
DISK_SIDES = 16  # the worst error, close to the rim, is below 1 % of the disk's own irradiance
PI = wp.constant(float(np.pi))
# Below this sine the angle between two corners is the sine itself in float32.
SMALL_SINE = wp.constant(1.0e-4)
LEAST_LENGTH = wp.constant(1.0e-30)  # keeps the quotient of two lengths finite


@wp.struct
class DistantView:
    to_light: wp.vec3  # unit
    irradiance: wp.vec3  # on a facing surface


@wp.struct
class AreaView:
    """A shape that emits the same radiance everywhere; scene frame."""

    kind: int
    sides: int  # of a polygon
    centre: wp.vec3
    # Corner k of a polygon: centre + cos(a) x + sin(a) y, a = 2 pi (k + 1/2) / sides. Cylinder: x is half its axis.
    x: wp.vec3
    y: wp.vec3
    out: wp.vec3  # polygon: unit normal on the side that emits
    radius: float
    radiance: wp.vec3


@wp.struct
class DirectView:
    distant: wp.array(dtype=DistantView)
    areas: wp.array(dtype=AreaView)


@dataclass(frozen=True)
class Points:
    """Points on triangles that are seen: by the eye at every pixel of an image, or by a mirror at some of them.

    Attributes:
        triangle: int32 [n], -1 where nothing is seen.
        u, v: float32 [n], weights of the second and third corner.
        direction: vec3 [n], unit, of the ray that sees it.
        pixel: int32 [n], which pixel of the image; length 0: all of them in order.
        width, height: Of the image. [pixels]
        camera: `CameraView` [1], where u, v and direction have length 0: what the eye sees, by kernels that find them
            themselves.
    """

    triangle: wp.array
    u: wp.array
    v: wp.array
    direction: wp.array
    pixel: wp.array
    width: int
    height: int
    camera: wp.array | None = None


def prepare_direct(lights: list[LightData], origin: np.ndarray, device) -> DirectView:
    """The device form of the distant lights and of the shapes; others are left out."""
    result = DirectView()
    distant = [_distant(light) for light in lights if light.kind == "distant"]
    areas = [_area(light, origin) for light in lights if light.kind in AREA_KINDS]
    result.distant = wp.array(distant, dtype=DistantView, device=device)
    result.areas = wp.array(areas, dtype=AreaView, device=device)
    return result


def _distant(light: LightData) -> DistantView:
    view = DistantView()
    axis = np.asarray(light.world_from_light, np.float64)[:3, 2]
    view.to_light = wp.vec3(*(axis / np.linalg.norm(axis)))
    view.irradiance = wp.vec3(*light.color)
    return view


def _area(light: LightData, origin: np.ndarray) -> AreaView:
    """A scaled sphere or cylinder has the mean of its axes' scales as its own."""
    world = np.asarray(light.world_from_light, np.float64)
    x, y, z = world[:3, :3].T
    scale = np.linalg.norm(world[:3, :3], axis=0)
    view = AreaView()
    view.centre = wp.vec3(*(world[:3, 3] - origin))
    view.radiance = wp.vec3(*light.color)
    if light.kind == "sphere":
        view.kind = int(SPHERE)
        view.radius = light.size[0] * scale.prod() ** (1.0 / 3.0)
        return view
    if light.kind == "cylinder":
        view.kind = int(CYLINDER)
        view.x = wp.vec3(*(0.5 * light.size[0] * x))
        view.radius = light.size[1] * 0.5 * (scale[1] + scale[2])
        return view
    view.kind = int(POLYGON)
    if light.kind == "rect":
        view.sides = 4
        half = np.sqrt(0.5) * np.array(light.size)  # the corners are at 45 degrees
    else:
        view.sides = DISK_SIDES
        corner = light.size[0] * np.sqrt(2.0 * np.pi / (DISK_SIDES * np.sin(2.0 * np.pi / DISK_SIDES)))
        half = np.array([corner, corner])
    view.x, view.y = wp.vec3(*(half[0] * x)), wp.vec3(*(half[1] * y))
    normal = np.cross(x, y)
    normal *= -np.sign(normal @ z) / np.linalg.norm(normal)
    view.out = wp.vec3(*normal)
    return view


@wp.func
def edge_term(a: wp.vec3, b: wp.vec3, n: wp.vec3) -> float:
    """An edge's share of Lambert's sum: the angle that it spans times its plane's normal along n."""
    normal = wp.cross(a, b)
    sine = wp.length(normal)
    if sine == 0.0:
        return 0.0
    if sine < SMALL_SINE and wp.dot(a, b) > 0.0:
        return wp.dot(normal, n)
    return wp.atan2(sine, wp.dot(a, b)) / sine * wp.dot(normal, n)


@wp.func
def area_corner(area: AreaView, k: int) -> wp.vec3:
    """A polygon's corner, scene frame."""
    angle = 2.0 * PI * (float(k) + 0.5) / float(area.sides)
    return area.centre + wp.cos(angle) * area.x + wp.sin(angle) * area.y


@wp.func
def polygon_irradiance(area: AreaView, p: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p on a surface of unit normal n of a convex polygon of radiance 1, the part above the horizon.

    Source: Lambert, Photometria, 1760; as in Baum et al., Improving Radiosity Solutions Through the Use of
    Analytically Determined Form-Factors, SIGGRAPH 1989, equation 5. Clipped edge by edge at the horizon.
    """
    total = float(0.0)
    leaving = wp.vec3(0.0, 0.0, 0.0)
    entering = wp.vec3(0.0, 0.0, 0.0)
    crossed = int(0)
    a = area_corner(area, area.sides - 1) - p
    height_a = wp.dot(a, n)
    k = int(0)
    while k < area.sides:
        b = area_corner(area, k) - p
        height_b = wp.dot(b, n)
        if height_a > 0.0 or height_b > 0.0:
            start = unit(a)
            end = unit(b)
            if height_a <= 0.0 or height_b <= 0.0:
                horizon = unit(a + (height_a / (height_a - height_b)) * (b - a))
                crossed += 1
                if height_a > 0.0:
                    end = horizon
                    leaving = horizon
                else:
                    start = horizon
                    entering = horizon
            total += edge_term(start, end, n)
        a = b
        height_a = height_b
        k += 1
    if crossed == 2:
        total += edge_term(leaving, entering, n)
    return 0.5 * wp.abs(total)


@wp.func
def sphere_irradiance(area: AreaView, p: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p on a surface of unit normal n of a sphere of radiance 1, the part above the horizon.

    Source: Lagarde and de Rousiers, Moving Frostbite to Physically Based Rendering, 2014, listing 7 (after Snyder,
    Area Light Sources for Real-Time Graphics, 1996).
    """
    to_centre = area.centre - p
    distance = wp.length(to_centre)
    if distance <= area.radius:
        return PI
    cosine = wp.clamp(wp.dot(to_centre, n) / distance, -1.0, 1.0)
    sine_sphere = area.radius / distance
    square = sine_sphere * sine_sphere
    if cosine >= sine_sphere:
        return PI * square * cosine
    if cosine <= -sine_sphere:
        return 0.0
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    x = wp.sqrt(wp.max(1.0 / square - 1.0, 0.0))
    y = wp.clamp(-x * cosine / wp.max(sine, LEAST_LENGTH), -1.0, 1.0)
    root = sine * wp.sqrt(wp.max(1.0 - y * y, 0.0))
    total = (cosine * wp.acos(y) - x * root) * square + wp.atan2(root, x)
    return wp.max(total, 0.0)


@wp.func
def shown_area(area: AreaView, p: wp.vec3) -> AreaView:
    """The polygon that stands for a shape seen from p; a sphere stays what it is."""
    shown = area
    if area.kind == CYLINDER:
        across = unit(wp.cross(area.x, area.centre - p))
        shown = AreaView()
        shown.kind = POLYGON
        shown.sides = 4
        shown.centre = area.centre
        shown.x = wp.sqrt(2.0) * area.x
        shown.y = wp.sqrt(2.0) * area.radius * across
    return shown


@wp.func
def area_irradiance(area: AreaView, p: wp.vec3, n: wp.vec3) -> float:
    """Irradiance at p on a surface of unit normal n of a shape of radiance 1, unshadowed."""
    if area.kind == SPHERE:
        return sphere_irradiance(area, p, n)
    if area.kind == POLYGON and wp.dot(p - area.centre, area.out) <= 0.0:
        return 0.0
    return polygon_irradiance(shown_area(area, p), p, n)


@wp.kernel
def eye_weights_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    # Outputs:
    out_direction: wp.array(dtype=wp.vec3),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    """One thread per pixel (an empty `pixel`: of all of them): its ray, and the weights of the point it meets; else all 0."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        out_direction[i] = wp.vec3(0.0, 0.0, 0.0)
        out_u[i] = 0.0
        out_v[i] = 0.0
        return
    p = i
    if pixel.shape[0] > 0:
        p = pixel[i]
    row = p // camera[0].width
    x = float(p - row * camera[0].width) + 0.5
    y = float(row) + 0.5
    ray = eye_ray_direction(camera[0], x, y)
    corner = scene.triangles[tri]
    hit = intersect_triangle(
        eye_ray_origin(camera[0], x, y),
        ray,
        scene.points[corner[0]] - camera[0].eye,
        scene.points[corner[1]] - camera[0].eye,
        scene.points[corner[2]] - camera[0].eye,
    )
    weights = clamp_weights(hit.u, hit.v)
    out_direction[i] = unit(ray)
    out_u[i] = weights[0]
    out_v[i] = weights[1]


@wp.kernel(module=IRRADIANCE)
def direct_kernel(
    first: int,
    scene: SceneView,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    out_irradiance: wp.array(dtype=wp.vec3),
):
    """One thread per point."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        out_irradiance[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    corner = scene.triangles[tri]
    w = 1.0 - u[i] - v[i]
    p = w * scene.points[corner[0]] + u[i] * scene.points[corner[1]] + v[i] * scene.points[corner[2]]
    n = shown_normal(normals, i, hit_normal(scene, tri, u[i], v[i]))
    if wp.dot(n, direction[i]) > 0.0:
        n = -n
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.distant.shape[0]):
        total += wp.max(wp.dot(n, lights.distant[k].to_light), 0.0) * lights.distant[k].irradiance
    for k in range(lights.areas.shape[0]):
        total += area_irradiance(lights.areas[k], p, n) * lights.areas[k].radiance
    out_irradiance[i] = total


def points_of(
    scene: Scene,
    gbuffer: GBuffer,
    layer: ReflectionLayer | None = None,
    threads: int = 0,
    chosen: np.ndarray | None = None,
    weighed: bool = True,
) -> Points:
    """What a frame shows: the eye's picture, at all its pixels or at those chosen (int32), or what is seen in a mirror.

    Not `weighed`: of the eye's picture weights and directions are left to `shadow_starts_vector`.
    """
    device, size = scene.device, gbuffer.camera.size
    if layer is not None:
        pixels = layer.pixels
        return Points(layer.triangle, layer.u, layer.v, pixels.direction, pixels.pixel, *size)
    triangle, pixel = gbuffer.triangle, compact.none(int, device)
    if chosen is not None:
        triangle = wp.array(triangle.numpy()[chosen], dtype=int, device=device, copy=False)
        pixel = wp.array(chosen, dtype=int, device=device, copy=False)
    if not weighed:
        none = compact.none(float, device)
        direction = compact.none(wp.vec3, device)
        return Points(triangle, none, none, direction, pixel, *size, gbuffer.view)
    direction = wp.empty(len(triangle), dtype=wp.vec3, device=device)
    u, v = (wp.empty(len(triangle), dtype=float, device=device) for _ in range(2))
    inputs = [scene.view, gbuffer.view, triangle, pixel, direction, u, v]
    launch.launch(eye_weights_kernel, len(triangle), inputs, device, threads)
    return Points(triangle, u, v, direction, pixel, *size)


def direct_irradiance(
    scene: Scene, lights: DirectView, points: Points, threads: int = 0, normals: wp.array | None = None
) -> wp.array:
    """Unshadowed irradiance of distant lights and shapes at points, on the viewer's side.

    Args:
        scene: Holds the triangles.
        lights: From `prepare_direct`.
        points: What is seen.
        threads: CPU threads; 0: one per core.
        normals: From `normal_maps.prepare_normals`; None: no normal maps.

    Returns:
        vec3 [points], 0 where nothing is seen.
    """
    device = scene.device
    result = wp.empty(len(points.triangle), dtype=wp.vec3, device=device)
    if normals is None:
        normals = compact.none(wp.vec3, device)
    inputs = [scene.view, lights, points.triangle, points.u, points.v, points.direction, normals, result]
    launch.launch(direct_kernel, len(points.triangle), inputs, device, threads)
    return result
