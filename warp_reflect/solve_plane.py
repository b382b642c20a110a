"""The bare solver's kernel for planes, in float64 between arrays of either precision."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.optics import safe_normalize, specular_residual
from warp_reflect.quadrics import unit_roundoff
from warp_reflect.solve_device import (
    BAD_INPUT,
    CONVERGED,
    GRAZING,
    HIDDEN,
    OUT_OF_EXTENT,
    finite,
    grazing_limit,
    to_double,
)

# Unrolled, the searches in loops of known length would be compiled many times over.
wp.set_module_options({"enable_backward": False, "max_unroll": 2})


@wp.kernel
def solve_plane_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    # Mirror:
    origin: wp.vec3d,
    normal: wp.vec3d,
    width_axis: wp.vec3d,
    height_axis: wp.vec3d,
    half_width: wp.float64,
    half_height: wp.float64,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
    out_root_count: wp.array(dtype=int),
    out_roots: wp.array2d(dtype=Any),
    out_root_length: wp.array2d(dtype=Any),
    out_root_index: wp.array2d(dtype=wp.uint8),
    out_root_status: wp.array2d(dtype=wp.uint8),
):
    """One thread per pair of eye and point."""
    row = first + wp.tid()
    n = points.shape[0]
    eye_world = eyes[row / n]
    target_world = to_double(points[row % n])
    if not finite(eye_world) or not finite(target_world):
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    eye = eye_world - origin
    target = target_world - origin
    h_eye = wp.dot(eye, normal)
    h_target = wp.dot(target, normal)
    # Rounding of the products in the heights, in the precision of the points.
    roundoff = wp.float64(8.0) * wp.float64(unit_roundoff(out_residual[row]))
    n_abs = wp.vec3d(wp.abs(normal[0]), wp.abs(normal[1]), wp.abs(normal[2]))
    eye_noise = roundoff * wp.dot(n_abs, wp.vec3d(wp.abs(eye[0]), wp.abs(eye[1]), wp.abs(eye[2])))
    target_noise = roundoff * wp.dot(n_abs, wp.vec3d(wp.abs(target[0]), wp.abs(target[1]), wp.abs(target[2])))
    if h_eye <= eye_noise or h_target < -target_noise:
        out_status[row] = wp.uint8(HIDDEN)
        return
    r = target - h_target * normal
    if h_target > target_noise:
        # Heights add: no cancellation, nor in 1 - t, which a far target would multiply. R is a weighted mean of the feet.
        total = h_eye + h_target
        r = (h_target / total) * (eye - h_eye * normal) + (h_eye / total) * r
    status = CONVERGED
    if half_width > wp.float64(0.0):
        if wp.abs(wp.dot(r, width_axis)) > half_width or wp.abs(wp.dot(r, height_axis)) > half_height:
            status = OUT_OF_EXTENT
    residual = wp.float64(0.0)
    if h_target > target_noise:
        residual = specular_residual(r, normal, eye, target)
        cosine = wp.dot(safe_normalize(eye - r), normal)
        if status == CONVERGED and cosine < grazing_limit(out_residual[row]) * wp.float64(1.0e-3):
            status = GRAZING
    v = target_world - (h_target + h_target) * normal
    r = r + origin
    zero = points[row % n]
    out_point[row] = type(zero)(zero.dtype(r[0]), zero.dtype(r[1]), zero.dtype(r[2]))
    out_normal[row] = type(zero)(zero.dtype(normal[0]), zero.dtype(normal[1]), zero.dtype(normal[2]))
    out_virtual[row] = type(zero)(zero.dtype(v[0]), zero.dtype(v[1]), zero.dtype(v[2]))
    out_residual[row] = zero.dtype(residual)
    out_status[row] = wp.uint8(status)
    if out_roots.shape[1] > 0 and status != OUT_OF_EXTENT:
        out_root_count[row] = 1
        out_roots[row, 0] = out_point[row]
        out_root_length[row, 0] = zero.dtype(wp.length(v - eye_world))
        out_root_index[row, 0] = wp.uint8(0)
        out_root_status[row, 0] = wp.uint8(status)


for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
    wp.overload(
        solve_plane_kernel,
        {
            "points": wp.array(dtype=_vector),
            "out_point": wp.array(dtype=_vector),
            "out_normal": wp.array(dtype=_vector),
            "out_virtual": wp.array(dtype=_vector),
            "out_residual": wp.array(dtype=_scalar),
            "out_roots": wp.array2d(dtype=_vector),
            "out_root_length": wp.array2d(dtype=_scalar),
        },
    )
