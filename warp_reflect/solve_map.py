"""The bare solver's kernel for reflector maps: searches in float32 in the map's unit frame, transforms in float64."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.cubemap import project_to_cube
from warp_reflect.optics import specular_residual, virtual_point
from warp_reflect.reflector_maps import ReflectorMapView, nearest_texel, sample_map
from warp_reflect.settings import Status
from warp_reflect.shapes import max_abs
from warp_reflect.solve_device import finite, to_double
from warp_reflect.techniques.map_search import (
    ACCEPTED,
    GAUGE_INSIDE,
    SearchSettings,
    first_guess,
    is_visible,
    search_newton,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
GRAZING = wp.constant(int(Status.GRAZING))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))
INSIDE = wp.constant(int(Status.INSIDE))
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
BAD_INPUT = wp.constant(int(Status.BAD_INPUT))
GRAZING_COS = wp.constant(1.7e-3)  # cosine of 89.9 degrees, where float32 has lost three digits
ENTRY_SAMPLES = wp.constant(64)  # along a line of sight that is blocked, to tell where it enters an open mirror's body
ENTRY_STEPS = wp.constant(12)  # bisections of one of those steps
# Map units: from here on a point only has a direction, and its squares would crowd out the map's digits.
FAR = wp.constant(wp.float64(1.0e6))


@wp.func
def gauge(map: ReflectorMapView, q: wp.vec3) -> float:
    """Minkowski gauge of the body: below 1 inside, above 1 outside."""
    w = wp.cw_mul(q, map.inv_extent)
    if max_abs(w) == 0.0:
        return 0.0
    s = sample_map(map, project_to_cube(w))
    return wp.length(w) / wp.max(wp.length(wp.cw_mul(s.p, map.inv_extent)), 1.0e-20)


@wp.func
def on_reflector(map: ReflectorMapView, q: wp.vec3) -> bool:
    """Whether a ray from the centre through a point leaves the body through the reflector, not its closing part."""
    return map.texels[nearest_texel(map, project_to_cube(wp.cw_mul(q, map.inv_extent)))][3] >= 0.5


@wp.func
def enters_reflector(map: ReflectorMapView, eye: wp.vec3, target: wp.vec3) -> bool:
    """Whether the segment from an outside eye enters the body through the reflector, not its closing part."""
    high = float(1.0)
    for k in range(ENTRY_SAMPLES):
        t = float(k + 1) / float(ENTRY_SAMPLES)
        if high == 1.0 and gauge(map, eye + t * (target - eye)) < 1.0:
            high = t
    low = wp.max(high - 1.0 / float(ENTRY_SAMPLES), 0.0)
    for _ in range(ENTRY_STEPS):
        middle = 0.5 * (low + high)
        if gauge(map, eye + middle * (target - eye)) < 1.0:
            high = middle
        else:
            low = middle
    return on_reflector(map, eye + high * (target - eye))


@wp.func
def to_unit(q: wp.vec3d) -> wp.vec3:
    """A unit-frame point in float32, far ones drawn in along their direction."""
    m = wp.max(wp.abs(q[0]), wp.max(wp.abs(q[1]), wp.abs(q[2])))
    s = q
    if m > FAR:
        s = q / m * FAR
    return wp.vec3(float(s[0]), float(s[1]), float(s[2]))


@wp.kernel
def solve_map_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    # Mirror:
    map: ReflectorMapView,
    unit_from_world: wp.mat44d,
    world_from_unit: wp.mat44d,
    closed: int,
    settings: SearchSettings,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per pair of eye and point."""
    row = first + wp.tid()
    n = points.shape[0]
    eye_world = eyes[row / n]
    target_world = to_double(points[row % n])
    if not finite(eye_world) or not finite(target_world):
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    eye = to_unit(wp.transform_point(unit_from_world, eye_world))
    target = to_unit(wp.transform_point(unit_from_world, target_world))
    eye_gauge = gauge(map, eye)
    if wp.abs(eye_gauge - 1.0) < GAUGE_INSIDE:
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    if eye_gauge < 1.0:
        out_status[row] = wp.uint8(INSIDE)
        return
    inside = gauge(map, target) < 1.0 - GAUGE_INSIDE
    if inside and closed != 0:
        out_status[row] = wp.uint8(INSIDE)
        return
    if inside or not is_visible(map, eye, target):
        hidden = bool(True)
        if closed == 0:
            hidden = enters_reflector(map, eye, target)
        out_status[row] = wp.uint8(wp.where(hidden, HIDDEN, UNREFLECTED))
        return
    seed = first_guess(map, eye, target)
    r = search_newton(map, eye, target, seed, settings.iterations, settings.tolerance, 0.0)
    if closed == 0 and not on_reflector(map, r.p):
        out_status[row] = wp.uint8(UNREFLECTED)
        return
    status = CONVERGED
    if r.residual > ACCEPTED:
        status = MAX_ITERATIONS
    elif wp.min(r.cos_eye, r.cos_target) < GRAZING_COS:
        status = GRAZING
    zero = points[row % n]
    p_unit = wp.vec3d(wp.float64(r.p[0]), wp.float64(r.p[1]), wp.float64(r.p[2]))
    n_unit = wp.vec3d(wp.float64(r.n[0]), wp.float64(r.n[1]), wp.float64(r.n[2]))
    p = wp.transform_point(world_from_unit, p_unit)
    normal = wp.normalize(wp.transform_vector(world_from_unit, n_unit))
    # The curvature of a body of the map's size only picks the form that forgives an error of p more.
    size = wp.length(p - wp.transform_point(world_from_unit, wp.vec3d()))
    v = virtual_point(p, normal, eye_world, target_world, wp.float64(1.0) / size)
    out_point[row] = type(zero)(zero.dtype(p[0]), zero.dtype(p[1]), zero.dtype(p[2]))
    out_normal[row] = type(zero)(zero.dtype(normal[0]), zero.dtype(normal[1]), zero.dtype(normal[2]))
    out_virtual[row] = type(zero)(zero.dtype(v[0]), zero.dtype(v[1]), zero.dtype(v[2]))
    out_residual[row] = zero.dtype(specular_residual(p, normal, eye_world, target_world))
    out_status[row] = wp.uint8(status)


for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
    wp.overload(
        solve_map_kernel,
        {
            "points": wp.array(dtype=_vector),
            "out_point": wp.array(dtype=_vector),
            "out_normal": wp.array(dtype=_vector),
            "out_virtual": wp.array(dtype=_vector),
            "out_residual": wp.array(dtype=_scalar),
        },
    )
