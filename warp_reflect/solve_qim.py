"""The bare solver's kernel for `method="qim"`, see quadric_curve.py."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.quadric_curve import qim_search
from warp_reflect.quadrics import unit_roundoff
from warp_reflect.solve_device import (
    BAD_INPUT,
    CONVERGED,
    MAX_ITERATIONS,
    NONE,
    QuadricView,
    cut_far,
    finite,
    grazing_limit,
    judge,
    near_limit,
    refuse,
    to_double,
    unit_scale,
    write_answer,
)

# Unrolled, the searches in loops of known length would be compiled many times over.
wp.set_module_options({"enable_backward": False, "max_unroll": 2})


@wp.kernel
def solve_qim_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    view: QuadricView,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per pair of eye and point; convex surfaces of revolution with one sheet."""
    row = first + wp.tid()
    n = points.shape[0]
    zero = points[row % n]
    eye_world = eyes[row / n]
    target_world = to_double(zero)
    if not finite(eye_world) or not finite(target_world):
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    eye = view.unit_from_world * (eye_world - view.origin)
    target = view.unit_from_world * (target_world - view.origin)
    scale = unit_scale(eye, target, view)
    size = view.size * scale
    eye = eye / scale
    target = target / scale
    roundoff = wp.float64(unit_roundoff(zero[0]))
    sheet = view.sheet
    if view.family == 2 and sheet == 0:
        sheet = 1
        if eye[2] < wp.float64(0.0):
            sheet = -1
    found = refuse(eye, target, view, sheet, roundoff)
    if found.status == NONE:
        flip = wp.float64(1.0)
        if sheet < 0:
            flip = wp.float64(-1.0)
        far = near_limit(zero[0])
        e = cut_far(wp.vec3d(eye[0], eye[1], flip * eye[2]), far)
        t = cut_far(wp.vec3d(target[0], target[1], flip * target[2]), far)
        # The nearest-point map shortens distances: R is no farther from the vertex than eye or target.
        reach = wp.max(wp.length(e), wp.length(t))
        low = wp.float64(0.0)
        high = reach
        if view.family == 0:
            if view.lam[2] > wp.float64(0.0):
                high = wp.float64(1.0) / wp.sqrt(view.lam[2])
                low = -high
            else:
                low = wp.min(e[2], t[2])
                high = wp.max(e[2], t[2])
        elif view.family == 2:
            low = wp.sqrt(view.c / -view.lam[2])
            high = low + wp.float64(2.0) * reach
        s_lam = type(zero)(zero.dtype(view.lam[0]), zero.dtype(view.lam[1]), zero.dtype(view.lam[2]))
        p, there = qim_search(
            type(zero)(zero.dtype(e[0]), zero.dtype(e[1]), zero.dtype(e[2])),
            type(zero)(zero.dtype(t[0]), zero.dtype(t[1]), zero.dtype(t[2])),
            s_lam,
            zero.dtype(view.b),
            zero.dtype(view.c),
            zero.dtype(low),
            zero.dtype(high),
        )
        found.status = MAX_ITERATIONS
        if there != 0:
            r = wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), flip * wp.float64(p[2]))
            # A minimum is resolved to the root of the rounding.
            found = judge(r, eye, target, view.lam, view.b, wp.sqrt(roundoff), grazing_limit(zero[0]))
            write_answer(zero, found, view, size, row, out_point, out_normal, out_virtual, out_residual)
    elif found.status == CONVERGED:
        write_answer(zero, found, view, size, row, out_point, out_normal, out_virtual, out_residual)
    out_status[row] = wp.uint8(found.status)


for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
    wp.overload(
        solve_qim_kernel,
        {
            "points": wp.array(dtype=_vector),
            "out_point": wp.array(dtype=_vector),
            "out_normal": wp.array(dtype=_vector),
            "out_virtual": wp.array(dtype=_vector),
            "out_residual": wp.array(dtype=_scalar),
        },
    )
