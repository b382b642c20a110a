"""Shadows of scenes with cut-outs: as in `shadows`, by rays that go through holes.

Apart, so that other scenes' shadow rays, which stop at the first thing they meet, pay nothing for it. All points send all
rays: which of them lie in a penumbra is not looked for first.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch
from warp_reflect.bvh import TRACE_SPLIT_MIN
from warp_reflect.cutouts import is_hole
from warp_reflect.direct import SPHERE, AreaView, DirectView, area_irradiance
from warp_reflect.holes import HOLES_MAX
from warp_reflect.ray_query import first_met, triangle_in
from warp_reflect.ray_walk import flush_direction, ray_offset
from warp_reflect.scene import SceneView
from warp_reflect.shadow_starts import RayStart, ray_start, sample_place, sample_shift
from warp_reflect.shadows import FAR, area_ray, area_shown, sky_ray

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": launch.FINITE_FLAGS})


@wp.func
def is_free_past_holes(mesh_id: wp.uint64, scene: SceneView, start: RayStart, direction: wp.vec3, reach: float) -> bool:
    """Whether nothing but holes is met on the way."""
    d = flush_direction(direction)
    t0 = float(0.0)
    holes = int(0)
    while holes < HOLES_MAX and t0 < reach:
        holes += 1
        met = first_met(mesh_id, start.p + t0 * d, d, reach - t0)
        triangle = triangle_in(met)
        if triangle < 0:
            return True
        # The traversal names its weights for the first and second corner.
        if not is_hole(scene.cuts, triangle, met[2], 1.0 - met[1] - met[2]):
            return False
        t0 += met[0]
        t0 += ray_offset(start.p + t0 * d)
    return t0 >= reach


@wp.func
def share_past_holes(
    mesh_id: wp.uint64, scene: SceneView, light: AreaView, start: RayStart, shift: wp.vec2, count: int
) -> float:
    """As `shadows.area_share`."""
    if light.kind == SPHERE and wp.length(light.centre - start.p) <= light.radius:
        return 1.0
    shown = area_shown(light, start.p)
    brought = float(0.0)
    arrived = float(0.0)
    k = int(0)
    while k < count:
        ray = area_ray(light, shown, start.p, start.n, sample_place(k, shift))
        if ray.weight > 0.0:
            brought += ray.weight
            if is_free_past_holes(mesh_id, scene, start, ray.direction, ray.reach):
                arrived += ray.weight
        k += 1
    if brought == 0.0:
        return 1.0
    return arrived / brought


@wp.kernel
def cut_irradiance_kernel(
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
    count: int,
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
                lit = is_free_past_holes(mesh_id, scene, start, to_light, FAR)
            if lit:
                total += cosine * lights.distant[k].irradiance
    shift = sample_shift(pixel, i, width)
    for k in range(lights.areas.shape[0]):
        light = lights.areas[k]
        unshadowed = area_irradiance(light, start.at, start.n)
        if unshadowed > 0.0:
            share = float(1.0)
            if cast_areas[k] != 0:
                share = share_past_holes(mesh_id, scene, light, start, shift, count)
            total += unshadowed * share * light.radiance
    out_irradiance[i] = total


@wp.kernel
def cut_sky_share_kernel(
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
    """One thread per point: as `shadows.sky_share_kernel`."""
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
        if wp.dot(d, start.side) > 0.0:
            asked += 1.0
            if is_free_past_holes(mesh_id, scene, start, d, FAR):
                free += 1.0
        k += 1
    if asked > 0.0:
        out_share[i] = free / asked


def cut_irradiance(inputs: list, out_irradiance: wp.array, threads: int = 0) -> None:
    """Irradiance of distant lights and shapes at points; see `shadows.shadowed_irradiance`, which has the inputs."""
    launch.launch(
        cut_irradiance_kernel,
        len(out_irradiance),
        [*inputs, out_irradiance],
        out_irradiance.device,
        threads,
        split_min=TRACE_SPLIT_MIN,
    )


def cut_sky_share(inputs: list, out_share: wp.array, threads: int = 0) -> None:
    """Share of the sky over points that is not hidden; see `shadows.sky_share`, which has the inputs."""
    launch.launch(
        cut_sky_share_kernel,
        len(out_share),
        [*inputs, out_share],
        out_share.device,
        threads,
        split_min=TRACE_SPLIT_MIN,
    )
