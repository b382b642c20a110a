"""Shadows: which share of a light reaches a point past everything in between.

Distant lights are asked by one ray. A shape is asked by `samples` rays to points spread over it; the share of what they
bring that arrives multiplies the exact unshadowed irradiance of `direct.py`, so that what is wholly lit keeps it to the
last digit. A sixteenth of the rays is sent everywhere, more where those of a pixel and its neighbours disagree: only
penumbras pay for more, and share what they find (`shadow_neighbours.py`), or send all. A dome is asked by rays in
cosine-distributed directions, whatever it shows there.

Source: the ratio of shadowed to unshadowed samples as in Heitz et al., Combining Analytic Direct Illumination and Stochastic
Shadows, I3D 2018.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_reflect import compact, launch, vector
from warp_reflect.bvh import TRACE_SPLIT_MIN
from warp_reflect.direct import (
    CYLINDER,
    SPHERE,
    AreaView,
    DirectView,
    Points,
    shown_area,
)
from warp_reflect.optics import tangent_basis
from warp_reflect.ray_query import any_met
from warp_reflect.ray_walk import flush_direction
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.shadow_neighbours import neighbours_of
from warp_reflect.shadow_starts import LEAST_SQUARE, RayStart, Starts, kept_room, row_vector, sample_place, starts_of
from warp_reflect.shapes import unit

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": launch.FINITE_FLAGS})
# What vector kernels do elsewhere, and what tries lights for a plan.
PLAIN, TRIED = (
    launch.module_part(__name__, name, cpu_compiler_flags=launch.FINITE_FLAGS) for name in ("plain", "tried")
)

# Rays towards a shape end this share of the way before it, so that a lamp's own surface, drawn where the light is, does
# not hide it from without.
SHORT_OF_LIGHT = wp.constant(1.0e-3)
FAR = wp.constant(3.0e38)
WHOLE_TURN = wp.constant(float(2.0 * np.pi))
FIRST_SHARE = 16  # of the samples, one in so many is asked everywhere
SHARED_SHARE = 4  # and one in so many in penumbras where neighbours share


@dataclass(frozen=True)
class Shadows:
    """Which lights of a scene cast shadows; see `direct.prepare_direct` for their order."""

    distant: tuple[bool, ...] = ()
    areas: tuple[bool, ...] = ()
    domes: bool = False
    samples: int = 16
    shared: bool = False  # among neighbours, see `shadow_neighbours`

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
    cast = replace(every_shadow(scene, settings.shadow_samples, domes), shared=settings.shadow_sharing == "on")
    return cast if cast.direct or cast.domes else None


@wp.func
def is_free(mesh_id: wp.uint64, start: RayStart, direction: wp.vec3, reach: float) -> bool:
    """Whether nothing is met on the way."""
    return not any_met(mesh_id, start.p, flush_direction(direction), reach)


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
def start_of(starts: Starts, i: int) -> RayStart:
    """Where a point's rays start; of the point itself nothing is kept."""
    start = RayStart()
    start.p = row_vector(starts.rows, 0, i)
    start.n = row_vector(starts.rows, 3, i)
    start.side = row_vector(starts.rows, 6, i)
    return start


@wp.func
def shift_of(starts: Starts, i: int) -> wp.vec2:
    """A point's shift of the samples."""
    return wp.vec2(starts.rows[9, i], starts.rows[10, i])


@wp.func
def sample_ray(lights: DirectView, starts: Starts, k: int, i: int, sample: int) -> AreaRay:
    """The ray from point i to a sample of shape k; none has anything to bring to what lies in a sphere.

    All of it is read anew for each: what would be kept while a ray is on its way leaves a CUDA device less to wait with.
    """
    light = lights.areas[k]
    start = start_of(starts, i)
    if light.kind == SPHERE and wp.length(light.centre - start.p) <= light.radius:
        return AreaRay()
    return area_ray(light, area_shown(light, start.p), start.p, start.n, sample_place(sample, shift_of(starts, i)))


@wp.func
def area_share(mesh_id: wp.uint64, lights: DirectView, starts: Starts, k: int, i: int, begin: int, end: int) -> float:
    """Share of shape k's irradiance that arrives at point i by samples begin to end, 0 to 1; 1 where none brings anything."""
    brought = float(0.0)
    arrived = float(0.0)
    sample = int(begin)
    while sample < end:
        ray = sample_ray(lights, starts, k, i, sample)
        if ray.weight > 0.0:
            brought += ray.weight
            if is_free(mesh_id, start_of(starts, i), ray.direction, ray.reach):
                arrived += ray.weight
        sample += 1
    if brought == 0.0:
        return 1.0
    return arrived / brought


@wp.kernel(module=TRIED)
def light_shares_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    starts: Starts,
    count: int,
    out_share: wp.array(dtype=float),
):
    """One thread per point: light by light, the distant ones first."""
    i = first + wp.tid()
    start = start_of(starts, i)
    if wp.dot(start.n, start.n) == 0.0:
        return
    distant = lights.distant.shape[0]
    light_count = distant + lights.areas.shape[0]
    for k in range(light_count):
        share = float(1.0)
        if k < distant:
            to_light = lights.distant[k].to_light
            if wp.dot(start.n, to_light) > 0.0 and not is_free(mesh_id, start, to_light, FAR):
                share = float(0.0)
        elif starts.unshadowed[k - distant, i] > 0.0:
            share = area_share(mesh_id, lights, starts, k - distant, i, 0, count)
        out_share[i * light_count + k] = share


@wp.func
def sky_ray(n: wp.vec3, place: wp.vec2) -> wp.vec3:
    """A direction of a cosine distribution about a unit normal."""
    t1, t2 = tangent_basis(n)
    angle = turn(place[1])
    return wp.sqrt(place[0]) * (angle[0] * t1 + angle[1] * t2) + wp.sqrt(wp.max(1.0 - place[0], 0.0)) * n


@wp.kernel(module=PLAIN)
def sky_share_kernel(first: int, mesh_id: wp.uint64, starts: Starts, count: int, out_share: wp.array(dtype=float)):
    """One thread per point: share of cosine-distributed rays that leave the scene."""
    i = first + wp.tid()
    start = start_of(starts, i)
    if wp.dot(start.n, start.n) == 0.0:
        return
    shift = shift_of(starts, i)
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


def shared_count(samples: int) -> int:
    """Rays to a shape from points in its penumbra, where neighbours share them."""
    return max(samples // SHARED_SHARE, 1)


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
    of_lights = cast.distant, cast.areas
    distant, areas = scene.kept("lights that cast", of_lights, lambda: [_flags(each, device) for each in of_lights])
    mesh, lights = wp.uint64(scene.shadow_tracer.id), scene.lights.direct
    if scene.has_hole is not None:
        from warp_reflect import cut_shadows  # only scenes with cut-outs need it

        at = [*_arrays(points, normals, device), points.pixel, points.width]
        inputs = [mesh, scene.view, lights, distant, areas, *at, cast.samples]
        result = wp.zeros(count, dtype=wp.vec3, device=device)
        cut_shadows.cut_irradiance(inputs, result, threads)
        return result
    result = wp.empty(count, dtype=wp.vec3, device=device)
    around = neighbours_of(points, len(areas) if any(cast.areas) else 0, cast.shared, threads)
    samples = first_count(cast.samples), shared_count(cast.samples) if cast.shared else 0, cast.samples
    # Either sends this module's rays.
    if vector.chosen(kernels, device):
        from warp_reflect import shadows_vector as sent

        mesh = wp.uint64(scene.shadow_tracer.packets)
    else:
        from warp_reflect import shadow_lists as sent
    with kept_room(scene, count) as room:
        starts = starts_of(
            scene, points, normals, len(areas), threads, kernels=kernels, room=room, shaped=len(areas) > 0
        )
        sent.irradiance(mesh, lights, [distant, areas], starts, count, samples, around, result, threads)
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
    if scene.has_hole is not None:
        from warp_reflect import cut_shadows

        at = [*_arrays(points, normals, device), points.pixel, points.width]
        cut_shadows.cut_sky_share([mesh, scene.view, *at, samples], result, threads)
        return result
    with kept_room(scene, count) as room:
        starts = starts_of(scene, points, normals, 0, threads, kernels=kernels, room=room)
        if vector.chosen(kernels, device):
            from warp_reflect import shadows_vector

            shadows_vector.sky_share(wp.uint64(scene.shadow_tracer.packets), starts, count, samples, result, threads)
            return result
        inputs = [mesh, starts, samples, result]
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
    mesh, direct = wp.uint64(scene.shadow_tracer.id), scene.lights.direct
    lights = len(direct.distant) + len(direct.areas)
    share = wp.zeros(count * lights, dtype=float, device=device)
    starts = starts_of(scene, points, None, len(direct.areas), threads, True, kernels)
    if vector.chosen(kernels, device):
        from warp_reflect import shadows_vector

        shadows_vector.shares(wp.uint64(scene.shadow_tracer.packets), direct, starts, count, samples, share, threads)
    else:
        inputs = [mesh, direct, starts, samples, share]
        launch.launch(light_shares_kernel, count, inputs, device, threads, split_min=TRACE_SPLIT_MIN)
    n = starts.rows.numpy()[3:6, :count]
    brought = []
    for light in direct.distant.numpy():
        to = light["to_light"]
        cosine = np.maximum(n[0] * to[0] + n[1] * to[1] + n[2] * to[2], np.float32(0.0))
        brought.append(cosine[:, None] * light["irradiance"])
    for light, irradiance in zip(direct.areas.numpy(), starts.unshadowed.numpy(), strict=True):
        brought.append(irradiance[:count, None] * light["radiance"])
    return np.ascontiguousarray(n.T), np.stack(brought, 1), share.numpy().reshape(count, lights)


def _arrays(points: Points, normals: wp.array | None, device) -> list:
    if normals is None:
        normals = compact.none(wp.vec3, device)
    return [points.triangle, points.u, points.v, points.direction, normals]
