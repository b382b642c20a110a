"""Shadows: which share of a light reaches a point past everything in between.

Distant lights are asked by one ray. A shape is asked by `samples` rays to points spread over it; the share of what they
bring that arrives multiplies the exact unshadowed irradiance of `direct.py`, so that what is wholly lit keeps it to the
last digit. A sixteenth of the rays is sent everywhere, the rest where those of a pixel and its neighbours disagree: only
penumbras pay for all. A dome is asked by rays in cosine-distributed directions, whatever it shows there.

Sources: samples in the order of Roberts' R2 sequence (The Unreasonable Effectiveness of Quasirandom Sequences, 2018),
shifted from pixel to pixel by Jimenez' interleaved gradient noise (Next Generation Post Processing in Call of Duty:
Advanced Warfare, SIGGRAPH 2014); the ratio of shadowed to unshadowed samples as in Heitz et al., Combining Analytic Direct
Illumination and Stochastic Shadows, I3D 2018; ray starts on the smooth surface behind the facets as in Hanika, Hacking the
Shadow Terminator, Ray Tracing Gems II, 2021, chapter 4. What differs from the third: nothing is filtered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import launch, vector
from warp_reflect.bvh import FINITE_FLAGS, TRACE_SPLIT_MIN, flush_direction, ray_offset, scene_facet_normal
from warp_reflect.direct import (
    CYLINDER,
    SPHERE,
    AreaView,
    DirectView,
    Points,
    area_irradiance,
    shown_area,
)
from warp_reflect.optics import tangent_basis
from warp_reflect.scene import SHAPE_QUADRIC, Scene, SceneView
from warp_reflect.settings import Settings
from warp_reflect.shapes import unit
from warp_reflect.surface import hit_normal, shown_normal

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})
# What vector kernels do elsewhere, and what tries lights for a plan.
PLAIN, TRIED = (launch.module_part(__name__, name, cpu_compiler_flags=FINITE_FLAGS) for name in ("plain", "tried"))

# Rays towards a shape end this share of the way before it, so that a lamp's own surface, drawn where the light is, does
# not hide it from without.
SHORT_OF_LIGHT = wp.constant(1.0e-3)
FAR = wp.constant(3.0e38)
LEAST_SQUARE = wp.constant(1.0e-30)  # keeps quotients finite
WHOLE_TURN = wp.constant(float(2.0 * np.pi))
# 1 / g and 1 / g^2 of g^3 = g + 1.
R2_X = wp.constant(0.7548776662466927)
R2_Y = wp.constant(0.5698402909980532)
FIRST_SHARE = 16  # of the samples, one in so many is asked everywhere
NEIGHBOURS = wp.constant(1)  # pixels around one whose first rays are looked at: 25 pixels stand for a penumbra
# What the first rays towards a shape found.
NOTHING = wp.constant(0)  # it is below the horizon, or no point is there
DARK = wp.constant(1)
LIT = wp.constant(2)
BOTH = wp.constant(3)


@dataclass(frozen=True)
class Shadows:
    """Which lights of a scene cast shadows; see `direct.prepare_direct` for their order."""

    distant: tuple[bool, ...] = ()
    areas: tuple[bool, ...] = ()
    domes: bool = False
    samples: int = 16

    @property
    def direct(self) -> bool:
        """Whether any light but the domes casts one."""
        return any(self.distant) or any(self.areas)


def every_shadow(scene: Scene, samples: int = 16, domes: bool = False) -> Shadows:
    """All distant lights and shapes of a scene cast shadows, its domes if asked for."""
    direct = scene.lights.direct
    return Shadows((True,) * len(direct.distant), (True,) * len(direct.areas), domes, samples)


def asked_shadows(scene: Scene, settings: Settings) -> Shadows | None:
    """What settings alone ask for, without a plan: `auto` is every light."""
    domes = settings.dome_shadows == "on"
    if settings.shadows == "off":
        return Shadows(domes=True, samples=settings.shadow_samples) if domes else None
    cast = every_shadow(scene, settings.shadow_samples, domes)
    return cast if cast.direct or cast.domes else None


@wp.struct
class RayStart:
    """Where a point's shadow rays start."""

    at: wp.vec3  # the point itself
    p: wp.vec3
    side: wp.vec3  # the facet's unit normal on the viewer's side
    n: wp.vec3  # the normal to shade with, on the viewer's side


@wp.func
def above_tangent(p: wp.vec3, corner: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """How far a point lies below the tangent plane of a corner, as a step up to it."""
    return wp.max(wp.dot(corner - p, normal), 0.0) * normal


@wp.func
def ray_start(
    scene: SceneView, triangle: int, u: float, v: float, direction: wp.vec3, normals: wp.array(dtype=wp.vec3), i: int
) -> RayStart:
    """The start of shadow rays from a point on a triangle that is seen along a unit direction.

    On the surface that the facets stand for where that bulges out, so that a ball's facets do not shade each other.
    """
    tri = scene.triangles[triangle]
    a = scene.points[tri[0]]
    b = scene.points[tri[1]]
    c = scene.points[tri[2]]
    w = 1.0 - u - v
    at = w * a + u * b + v * c
    p = at
    own = hit_normal(scene, triangle, u, v)
    facet = scene_facet_normal(scene, triangle)
    turned = wp.where(wp.dot(own, direction) > 0.0, -1.0, 1.0)
    side = wp.where(wp.dot(facet, own) < 0.0, -turned, turned) * facet
    index = scene.normal_index[triangle]
    patch = scene.triangle_patch[triangle]
    if index[0] >= 0:
        s = turned
        p += w * above_tangent(p, a, s * scene.normals[index[0]])
        p += u * above_tangent(p, b, s * scene.normals[index[1]])
        p += v * above_tangent(p, c, s * scene.normals[index[2]])
    elif scene.patches[patch].shape == SHAPE_QUADRIC:
        # One Newton step onto f(q) = x^2 + y^2 + a z^2 + b z - c: the point is within a facet's sagitta of it.
        m = scene.patches[patch].unit_from_scene
        abc = scene.patches[patch].quadric
        q = wp.transform_point(m, p)
        f = q[0] * q[0] + q[1] * q[1] + (abc[0] * q[2] + abc[1]) * q[2] - abc[2]
        gradient = wp.transform_vector(wp.transpose(m), wp.vec3(2.0 * q[0], 2.0 * q[1], 2.0 * abc[0] * q[2] + abc[1]))
        step = (-f / wp.max(wp.dot(gradient, gradient), LEAST_SQUARE)) * gradient
        if wp.dot(step, side) > 0.0:
            p += step
    n = shown_normal(normals, i, own)
    if wp.dot(n, direction) > 0.0:
        n = -n
    start = RayStart()
    start.at = at
    # The corners', not the point's own: near the origin of a large facet it is off by their rounding.
    start.p = p + wp.max(ray_offset(a), wp.max(ray_offset(b), ray_offset(c))) * side
    start.side = side
    start.n = n
    return start


@wp.func
def is_free(mesh_id: wp.uint64, start: RayStart, direction: wp.vec3, reach: float) -> bool:
    """Whether nothing is met on the way."""
    return not wp.mesh_query_ray_anyhit(mesh_id, start.p, flush_direction(direction), reach)


@wp.func
def gradient_noise(x: float, y: float) -> float:
    """Interleaved gradient noise of a pixel, 0 to 1."""
    a = 0.06711056 * x + 0.00583715 * y
    b = 52.9829189 * (a - wp.floor(a))
    return b - wp.floor(b)


@wp.func
def sample_shift(pixel: wp.array(dtype=int), i: int, width: int) -> wp.vec2:
    """A pixel's own shift of the samples."""
    number = int(i)
    if pixel.shape[0] > 0:
        number = pixel[i]
    row = number // width
    x = float(number - row * width)
    y = float(row)
    return wp.vec2(gradient_noise(x, y), gradient_noise(y + 113.0, x + 71.0))


@wp.func
def sample_place(k: int, shift: wp.vec2) -> wp.vec2:
    """Sample k of a sequence that fills the unit square evenly from its beginning on."""
    x = 0.5 + R2_X * float(k) + shift[0]
    y = 0.5 + R2_Y * float(k) + shift[1]
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.func
def turn(share: float) -> wp.vec2:
    """Cosine and sine of a share of a whole turn, 0 to 1, within 1.2e-7: sums and products, the same bits in vectors.

    Source: the polynomials of Moshier's Cephes library, single/sinf.c, on an eighth of a turn to either side.
    """
    quarter = wp.floor(4.0 * share + 0.5)
    a = WHOLE_TURN * (share - 0.25 * quarter)
    square = a * a
    s = a + a * square * (-1.6666654611e-1 + square * (8.3321608736e-3 + square * -1.9515295891e-4))
    c = (
        1.0
        - 0.5 * square
        + square * square * (4.166664568298827e-2 + square * (-1.388731625493765e-3 + square * 2.443315711809948e-5))
    )
    q = int(quarter) & 3
    cosine = wp.where((q & 1) != 0, s, c)
    sine = wp.where((q & 1) != 0, c, s)
    if q == 1 or q == 2:
        cosine = -cosine
    if q >= 2:
        sine = -sine
    return wp.vec2(cosine, sine)


@wp.func
def sphere_sample(light: AreaView, p: wp.vec3, place: wp.vec2) -> wp.vec4:
    """Unit direction to a point of a sphere's visible cap, even in solid angle, and its distance."""
    to_centre = light.centre - p
    distance = wp.length(to_centre)
    axis = to_centre / distance
    square = wp.min(light.radius * light.radius / (distance * distance), 1.0)
    # 1 - cos of the angle from the axis.
    fall = place[0] * square / (1.0 + wp.sqrt(1.0 - square))
    sine = wp.sqrt(wp.max(fall * (2.0 - fall), 0.0))
    angle = turn(place[1])
    t1, t2 = tangent_basis(axis)
    d = (1.0 - fall) * axis + sine * (angle[0] * t1 + angle[1] * t2)
    half = wp.sqrt(wp.max(light.radius * light.radius - distance * distance * sine * sine, 0.0))
    return wp.vec4(d[0], d[1], d[2], distance * (1.0 - fall) - half)


@wp.func
def polygon_sample(light: AreaView, p: wp.vec3, place: wp.vec2) -> wp.vec4:
    """Unit direction to a point of a rectangle or a disk, even in area, and its distance."""
    at = light.centre
    if light.sides == 4:
        # Corners stand at 45 degrees.
        half = wp.sqrt(0.5)
        at += (2.0 * place[0] - 1.0) * half * light.x + (2.0 * place[1] - 1.0) * half * light.y
    else:
        angle = turn(place[1])
        at += wp.sqrt(place[0]) * (angle[0] * light.x + angle[1] * light.y)
    to = at - p
    distance = wp.length(to)
    d = unit(to)
    return wp.vec4(d[0], d[1], d[2], distance)


@wp.struct
class AreaRay:
    """A ray to a sample of a shape."""

    direction: wp.vec3  # unit
    reach: float  # up to shortly before the shape
    weight: float  # of what it brings, 0: nothing


@wp.func
def area_ray(light: AreaView, shown: AreaView, p: wp.vec3, n: wp.vec3, place: wp.vec2) -> AreaRay:
    """The ray from p, of unit normal n, to a shape's sample; `shown` is what `area_shown` says of the shape."""
    if light.kind == SPHERE:
        s = sphere_sample(light, p, place)
    else:
        s = polygon_sample(shown, p, place)
    ray = AreaRay()
    ray.direction = wp.vec3(s[0], s[1], s[2])
    ray.reach = (1.0 - SHORT_OF_LIGHT) * s[3]
    ray.weight = wp.max(wp.dot(n, ray.direction), 0.0)
    if light.kind != SPHERE:
        ray.weight *= wp.abs(wp.dot(shown.out, ray.direction)) / wp.max(s[3] * s[3], LEAST_SQUARE)
    return ray


@wp.func
def area_shown(light: AreaView, p: wp.vec3) -> AreaView:
    """The flat shape that stands for one seen from p, with its normal; a sphere stays what it is."""
    shown = shown_area(light, p)
    if light.kind == CYLINDER:
        shown.out = unit(wp.cross(shown.x, shown.y))
    return shown


@wp.func
def area_share(mesh_id: wp.uint64, light: AreaView, start: RayStart, shift: wp.vec2, count: int) -> float:
    """Share of a shape's irradiance that arrives by so many samples, 0 to 1; 1 where none has anything to bring."""
    p = start.p
    n = start.n
    if light.kind == SPHERE and wp.length(light.centre - p) <= light.radius:
        return 1.0
    shown = area_shown(light, p)
    brought = float(0.0)
    arrived = float(0.0)
    k = int(0)
    while k < count:
        ray = area_ray(light, shown, p, n, sample_place(k, shift))
        if ray.weight > 0.0:
            brought += ray.weight
            if is_free(mesh_id, start, ray.direction, ray.reach):
                arrived += ray.weight
        k += 1
    if brought == 0.0:
        return 1.0
    return arrived / brought


@wp.kernel
def image_index_kernel(first: int, pixel: wp.array(dtype=int), out_index: wp.array(dtype=int)):
    """One thread per point of a mirror: where it lies in the image."""
    i = first + wp.tid()
    out_index[pixel[i]] = i


@wp.kernel(module=PLAIN)
def first_rays_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    lights: DirectView,
    cast_areas: wp.array(dtype=int),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    count: int,
    out_found: wp.array(dtype=wp.uint8),
):
    """One thread per point: what the first rays towards each shape find."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    shift = sample_shift(pixel, i, width)
    for k in range(lights.areas.shape[0]):
        if cast_areas[k] != 0:
            if area_irradiance(lights.areas[k], start.at, start.n) > 0.0:
                share = area_share(mesh_id, lights.areas[k], start, shift, count)
                found = wp.where(share == 1.0, LIT, BOTH)
                found = wp.where(share == 0.0, DARK, found)
                out_found[i * lights.areas.shape[0] + k] = wp.uint8(found)


@wp.func
def around(
    found: wp.array(dtype=wp.uint8), index: wp.array(dtype=int), number: int, width: int, light: int, light_count: int
) -> int:
    """What the first rays of a pixel and its neighbours found together."""
    height = index.shape[0] // width
    if index.shape[0] == 0:
        height = found.shape[0] // (width * light_count)
    row = number // width
    column = number - row * width
    together = int(NOTHING)
    for dy in range(-NEIGHBOURS, NEIGHBOURS + 1):
        for dx in range(-NEIGHBOURS, NEIGHBOURS + 1):
            x = column + dx
            y = row + dy
            if x >= 0 and x < width and y >= 0 and y < height:
                at = y * width + x
                if index.shape[0] > 0:
                    at = index[at]
                if at >= 0:
                    together = together | int(found[at * light_count + light])
    return together


@wp.kernel(module=PLAIN)
def shadowed_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    cast_areas: wp.array(dtype=int),
    # Points:
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    # Samples:
    count: int,
    found: wp.array(dtype=wp.uint8),
    index: wp.array(dtype=int),
    out_irradiance: wp.array(dtype=wp.vec3),
):
    """One thread per point: the irradiance of all lights but the domes."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.distant.shape[0]):
        to_light = lights.distant[k].to_light
        cosine = wp.dot(start.n, to_light)
        if cosine > 0.0:
            lit = bool(True)
            if cast_distant[k] != 0:
                lit = is_free(mesh_id, start, to_light, FAR)
            if lit:
                total += cosine * lights.distant[k].irradiance
    shift = sample_shift(pixel, i, width)
    number = int(i)
    if pixel.shape[0] > 0:
        number = pixel[i]
    area_count = lights.areas.shape[0]
    for k in range(area_count):
        light = lights.areas[k]
        unshadowed = area_irradiance(light, start.at, start.n)
        if unshadowed > 0.0:
            share = float(1.0)
            if cast_areas[k] != 0:
                together = around(found, index, number, width, k, area_count)
                if together == BOTH:
                    share = area_share(mesh_id, light, start, shift, count)
                elif together == DARK:
                    share = float(0.0)
            total += unshadowed * share * light.radiance
    out_irradiance[i] = total


@wp.kernel(module=TRIED)
def light_shares_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    count: int,
    # Outputs:
    out_normal: wp.array(dtype=wp.vec3),
    out_unshadowed: wp.array(dtype=wp.vec3),
    out_share: wp.array(dtype=float),
):
    """One thread per point: light by light, the distant ones first."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    out_normal[i] = start.n
    distant = lights.distant.shape[0]
    light_count = distant + lights.areas.shape[0]
    for k in range(light_count):
        unshadowed = wp.vec3(0.0, 0.0, 0.0)
        share = float(1.0)
        if k < distant:
            to_light = lights.distant[k].to_light
            cosine = wp.dot(start.n, to_light)
            if cosine > 0.0:
                unshadowed = cosine * lights.distant[k].irradiance
                if not is_free(mesh_id, start, to_light, FAR):
                    share = float(0.0)
        else:
            light = lights.areas[k - distant]
            irradiance = area_irradiance(light, start.at, start.n)
            unshadowed = irradiance * light.radiance
            if irradiance > 0.0:
                share = area_share(mesh_id, light, start, sample_place(i, wp.vec2(0.0, 0.0)), count)
        out_unshadowed[i * light_count + k] = unshadowed
        out_share[i * light_count + k] = share


@wp.func
def sky_ray(n: wp.vec3, place: wp.vec2) -> wp.vec3:
    """A direction of a cosine distribution about a unit normal."""
    t1, t2 = tangent_basis(n)
    angle = turn(place[1])
    return wp.sqrt(place[0]) * (angle[0] * t1 + angle[1] * t2) + wp.sqrt(wp.max(1.0 - place[0], 0.0)) * n


@wp.kernel(module=PLAIN)
def sky_share_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    count: int,
    out_share: wp.array(dtype=float),
):
    """One thread per point: share of cosine-distributed rays that leave the scene."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    shift = sample_shift(pixel, i, width)
    free = float(0.0)
    asked = float(0.0)
    k = int(0)
    while k < count:
        d = sky_ray(start.n, sample_place(k, shift))
        # A normal map, or an interpolated normal, looks below its own facet.
        if wp.dot(d, start.side) > 0.0:
            asked += 1.0
            if is_free(mesh_id, start, d, FAR):
                free += 1.0
        k += 1
    if asked > 0.0:
        out_share[i] = free / asked


def _flags(cast: tuple[bool, ...], device) -> wp.array:
    return wp.array(np.array(cast, np.int32), dtype=int, device=device)


def first_count(samples: int) -> int:
    """Rays to a shape that are always sent."""
    return max(samples // FIRST_SHARE, 1)


def shadowed_irradiance(
    scene: Scene,
    points: Points,
    cast: Shadows,
    threads: int = 0,
    normals: wp.array | None = None,
    kernels: str = "auto",
) -> wp.array:
    """Irradiance of distant lights and shapes at points, with the shadows asked for.

    Args:
        scene: With a triangle at least; its BVH is built if this is the first use.
        points: What is seen.
        cast: Which lights are asked by rays, and by how many.
        threads: CPU threads; 0: one per core.
        normals: From `normal_maps.prepare_normals`; None: no normal maps.
        kernels: `Settings.kernels`. Scenes with cut-outs have plain ones only.

    Returns:
        vec3 [points], on the viewer's side; 0 where nothing is seen.
    """
    device = scene.device
    count = len(points.triangle)
    result = wp.zeros(count, dtype=wp.vec3, device=device)
    distant, areas = _flags(cast.distant, device), _flags(cast.areas, device)
    mesh, lights = wp.uint64(scene.shadow_tracer.id), scene.lights.direct
    at = [*_arrays(points, normals, device), points.pixel, points.width]
    if scene.has_hole is not None:
        from warp_reflect import cut_shadows  # only scenes with cut-outs need it

        inputs = [mesh, scene.view, lights, distant, areas, *at, cast.samples]
        cut_shadows.cut_irradiance(inputs, result, threads)
        return result
    index = wp.zeros(0, dtype=int, device=device)
    if any(cast.areas) and len(points.pixel):
        index = wp.full(points.width * points.height, -1, dtype=int, device=device)
        launch.launch(image_index_kernel, count, [points.pixel, index], device, threads)
    if vector.chosen(kernels, device):
        from warp_reflect import shadows_vector  # which sends this module's rays

        starts = shadows_vector.starts_of([scene.view, lights, *at], count, len(areas), device, threads)
        samples = first_count(cast.samples), cast.samples
        image = [points.pixel, points.width, index]
        shadows_vector.irradiance(mesh, lights, [distant, areas], starts, count, samples, image, result, threads)
        return result
    found = wp.zeros(count * len(areas) if any(cast.areas) else 0, dtype=wp.uint8, device=device)
    if any(cast.areas):
        inputs = [mesh, scene.view, lights, areas, *at, first_count(cast.samples), found]
        launch.launch(first_rays_kernel, count, inputs, device, threads, split_min=TRACE_SPLIT_MIN)
    inputs = [mesh, scene.view, lights, distant, areas, *at, cast.samples, found, index, result]
    launch.launch(shadowed_kernel, count, inputs, device, threads, split_min=TRACE_SPLIT_MIN)
    return result


def sky_share(
    scene: Scene,
    points: Points,
    samples: int,
    threads: int = 0,
    normals: wp.array | None = None,
    kernels: str = "auto",
) -> wp.array:
    """Share of the cosine-weighted sky over points that is not hidden by the scene.

    Args:
        scene: With a triangle at least.
        points: What is seen.
        samples: Rays a point.
        threads: CPU threads; 0: one per core.
        normals, kernels: As for `shadowed_irradiance`.

    Returns:
        float32 [points], 0 where nothing is seen.
    """
    device = scene.device
    count = len(points.triangle)
    result = wp.zeros(count, dtype=float, device=device)
    mesh = wp.uint64(scene.shadow_tracer.id)
    at = [*_arrays(points, normals, device), points.pixel, points.width]
    if scene.has_hole is not None:
        from warp_reflect import cut_shadows

        cut_shadows.cut_sky_share([mesh, scene.view, *at, samples], result, threads)
        return result
    if vector.chosen(kernels, device):
        from warp_reflect import shadows_vector

        starts = shadows_vector.starts_of([scene.view, scene.lights.direct, *at], count, 0, device, threads)
        shadows_vector.sky_share(mesh, starts, count, samples, result, threads)
        return result
    inputs = [mesh, scene.view, *at, samples, result]
    launch.launch(sky_share_kernel, count, inputs, device, threads, split_min=TRACE_SPLIT_MIN)
    return result


def light_shares(
    scene: Scene, points: Points, samples: int, threads: int = 0, kernels: str = "auto"
) -> tuple[np.ndarray, ...]:
    """What each light would bring to points, and which share of it arrives; without normal maps, cut-outs uncut.

    Args:
        scene: With a triangle and a light that casts shadows at least.
        points: What is seen.
        samples: Rays to a shape.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Returns:
        (unit normals on the viewer's side float32 [n, 3]; unshadowed irradiance float32 [n, lights, 3], distant lights
        first, then shapes; shares float32 [n, lights]).
    """
    device = scene.device
    count = len(points.triangle)
    lights = len(scene.lights.direct.distant) + len(scene.lights.direct.areas)
    normal = wp.zeros(count, dtype=wp.vec3, device=device)
    unshadowed = wp.zeros(count * lights, dtype=wp.vec3, device=device)
    share = wp.zeros(count * lights, dtype=float, device=device)
    mesh, direct, at = wp.uint64(scene.shadow_tracer.id), scene.lights.direct, _arrays(points, None, device)
    if vector.chosen(kernels, device):
        from warp_reflect import shadows_vector

        areas = direct.areas.numpy()
        starts = shadows_vector.starts_of(
            [scene.view, direct, *at, points.pixel, 0], count, len(areas), device, threads
        )
        shadows_vector.shares(mesh, direct, starts, count, samples, share, threads)
        n = starts.rows.numpy()[3:6, :count]
        brought = []
        for light in direct.distant.numpy():
            to = light["to_light"]
            cosine = np.maximum(n[0] * to[0] + n[1] * to[1] + n[2] * to[2], np.float32(0.0))
            brought.append(cosine[:, None] * light["irradiance"])
        for light, irradiance in zip(areas, starts.unshadowed.numpy(), strict=True):
            brought.append(irradiance[:count, None] * light["radiance"])
        return np.ascontiguousarray(n.T), np.stack(brought, 1), share.numpy().reshape(count, lights)
    inputs = [mesh, scene.view, direct, *at, samples]
    launch.launch(
        light_shares_kernel, count, [*inputs, normal, unshadowed, share], device, threads, split_min=TRACE_SPLIT_MIN
    )
    return normal.numpy(), unshadowed.numpy().reshape(count, lights, 3), share.numpy().reshape(count, lights)


def _arrays(points: Points, normals: wp.array | None, device) -> list:
    if normals is None:
        normals = wp.zeros(0, dtype=wp.vec3, device=device)
    return [points.triangle, points.u, points.v, points.direction, normals]
