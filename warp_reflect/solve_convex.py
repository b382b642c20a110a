"""The bare solver's kernel for convex quadrics: one reflection point on each convex part.

Newton's method in the precision of the points; where it does not settle, the bracketed search in float64.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.optics import safe_normalize
from warp_reflect.quadrics import (
    bracket_on_convex,
    first_guess,
    newton_on_convex,
    put_on_surface,
    quadric_half_gradient,
    unit_roundoff,
)
from warp_reflect.solve_device import (
    BAD_INPUT,
    DEGENERATE,
    HIDDEN,
    INSIDE,
    NONE,
    Found,
    QuadricView,
    cut_far,
    finite,
    grazing_limit,
    has_point,
    judge,
    near_limit,
    refuse,
    to_double,
    unit_scale,
    write_answer,
    write_root,
)

# Unrolled, the searches in loops of known length would be compiled many times over.
wp.set_module_options({"enable_backward": False, "max_unroll": 2})

NEWTON_STEPS = wp.constant(12)  # evaluations before the bracketed search takes over
FINE_COSINE = wp.constant(0.2)  # of 78 degrees: beyond, float32 loses a digit and more
FINE_STEPS = wp.constant(4)
GUESS_STEPS = wp.constant(4)  # Newton steps of the first foot point; more do not pay


@wp.func
def search_convex(
    eye: wp.vec3d,
    target: wp.vec3d,
    near: Any,
    warm: int,
    lam: wp.vec3d,
    b: wp.float64,
    c: wp.float64,
    family: int,
):
    """The reflection point on a convex body in the precision of `near`, in float64 where that fails."""
    s_lam = type(near)(near.dtype(lam[0]), near.dtype(lam[1]), near.dtype(lam[2]))
    s_b = near.dtype(b)
    s_c = near.dtype(c)
    s_eye = type(near)(near.dtype(eye[0]), near.dtype(eye[1]), near.dtype(eye[2]))
    s_target = type(near)(near.dtype(target[0]), near.dtype(target[1]), near.dtype(target[2]))
    tolerance = near.dtype(6.0) * unit_roundoff(s_b)
    start = near
    if warm != 0:
        start = put_on_surface(near, s_lam, s_b, s_c, family)
    else:
        start = first_guess(s_eye, s_target, s_lam, s_b, s_c, family, GUESS_STEPS)
    r, angle = newton_on_convex(start, s_eye, s_target, s_lam, s_b, s_c, family, NEWTON_STEPS, tolerance)
    result = to_double(r)
    n = quadric_half_gradient(r, s_lam, s_b)
    bend = (s_lam[0] + s_lam[1] + wp.abs(s_lam[2])) / wp.length(n)
    reach = near.dtype(1.0) / wp.length(s_eye - r) + near.dtype(1.0) / wp.length(s_target - r)
    good = tolerance * near.dtype(4.0) * (near.dtype(1.0) + (near.dtype(1.0) + wp.length(r)) * (bend + reach))
    fine = wp.float64(6.0) * unit_roundoff(b)
    if not (angle <= wp.min(good, near.dtype(1.0e-2))):
        result = bracket_on_convex(eye, target, lam, b, c, family)
        if wp.length(quadric_half_gradient(result, lam, b)) > wp.float64(1.0e-9):
            result, _angle = newton_on_convex(result, eye, target, lam, b, c, family, NEWTON_STEPS, fine)
    elif wp.dot(n, s_eye - r) < near.dtype(FINE_COSINE) * wp.length(n) * wp.length(s_eye - r):
        # The error grows with 1 / cosine; a step or two in float64 leave that of the input alone.
        result = put_on_surface(result, lam, b, c, family)
        result, _angle = newton_on_convex(result, eye, target, lam, b, c, family, FINE_STEPS, fine)
    return result


@wp.func
def solve_sheet(
    eye: wp.vec3d, target: wp.vec3d, near: Any, warm: int, view: QuadricView, sheet: int, roundoff: wp.float64
):
    """The one reflection point on a convex body, or on its part on one side of z = 0 (sheet != 0)."""
    found = refuse(eye, target, view, sheet, roundoff)
    if found.status != NONE:
        return found
    flip = wp.float64(1.0)
    if sheet < 0:
        flip = wp.float64(-1.0)
    e = wp.vec3d(eye[0], eye[1], flip * eye[2])
    t = wp.vec3d(target[0], target[1], flip * target[2])
    s = type(near)(near[0], near[1], near.dtype(flip) * near[2])
    if view.family == 2 and view.c == wp.float64(0.0):
        # The apex of a cone is the shortest way iff the half vector there lies among its normals, the polar cone.
        w = safe_normalize(e) + safe_normalize(t)
        across = w[0] * w[0] / view.lam[0] + w[1] * w[1] / view.lam[1]
        if w[2] <= wp.float64(0.0) and across <= -w[2] * w[2] / view.lam[2]:
            found.status = DEGENERATE
            return found
    far = near_limit(near[0])
    usable = int(warm)
    if sheet != 0 and not (s[2] > near.dtype(0.0)):
        usable = int(0)
    r = search_convex(cut_far(e, far), cut_far(t, far), s, usable, view.lam, view.b, view.c, view.family)
    r[2] = flip * r[2]
    return judge(r, eye, target, view.lam, view.b, roundoff, grazing_limit(near[0]))


@wp.func
def worse_status(a: int, b: int):
    """Of two refusals the one that says more."""
    if a == BAD_INPUT or b == BAD_INPUT:
        return BAD_INPUT
    if a == HIDDEN or b == HIDDEN:
        return HIDDEN
    if a == INSIDE and b == INSIDE:
        return INSIDE
    if a == INSIDE:
        return b
    return a


@wp.kernel
def solve_convex_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    start: wp.array(dtype=Any),
    warm: int,
    view: QuadricView,
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
    near = zero
    usable = int(0)
    if warm != 0:
        s = view.unit_from_world * (to_double(start[row]) - view.origin) / scale
        if finite(s):
            usable = int(1)
            near = type(zero)(zero.dtype(s[0]), zero.dtype(s[1]), zero.dtype(s[2]))
    roundoff = wp.float64(unit_roundoff(zero[0]))
    best = Found()
    if view.family != 2:
        best = solve_sheet(eye, target, near, usable, view, 0, roundoff)
    elif view.sheet != 0:
        best = solve_sheet(eye, target, near, usable, view, view.sheet, roundoff)
    else:
        best = solve_sheet(eye, target, near, usable, view, 1, roundoff)
        other = solve_sheet(eye, target, near, usable, view, -1, roundoff)
        if has_point(best.status) and has_point(other.status):
            if other.length < best.length:
                swap = best
                best = other
                other = swap
            if out_roots.shape[1] > 1:
                write_root(
                    zero, other, 1, 0, view, size, row, out_roots, out_root_length, out_root_index, out_root_status
                )
                out_root_count[row] = 1
        elif has_point(other.status):
            best = other
        elif not has_point(best.status):
            best.status = worse_status(best.status, other.status)
    out_status[row] = wp.uint8(best.status)
    if has_point(best.status):
        write_answer(zero, best, view, size, row, out_point, out_normal, out_virtual, out_residual)
        if out_roots.shape[1] > 0:
            write_root(zero, best, 0, 0, view, size, row, out_roots, out_root_length, out_root_index, out_root_status)
            out_root_count[row] = out_root_count[row] + 1


for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
    wp.overload(
        solve_convex_kernel,
        {
            "points": wp.array(dtype=_vector),
            "start": wp.array(dtype=_vector),
            "out_roots": wp.array2d(dtype=_vector),
            "out_root_length": wp.array2d(dtype=_scalar),
            "out_point": wp.array(dtype=_vector),
            "out_normal": wp.array(dtype=_vector),
            "out_virtual": wp.array(dtype=_vector),
            "out_residual": wp.array(dtype=_scalar),
        },
    )
