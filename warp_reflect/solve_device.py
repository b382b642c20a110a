"""Kernels of the bare solver: planes, convex quadrics, and quadrics with several reflection points.

World positions come in the caller's precision and leave in it; the way to the unit principal frame and all
decisions (inside, hidden, touching) are float64, the search on convex bodies is in the caller's precision.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.mirrors import QuadricMirror
from warp_reflect.optics import safe_length, safe_normalize, specular_residual, virtual_point
from warp_reflect.quadric_curve import qim_search
from warp_reflect.quadric_roots import FLAG_RING, all_reflections, flatness
from warp_reflect.quadrics import (
    FAMILY,
    bracket_on_convex,
    first_guess,
    newton_on_convex,
    put_on_surface,
    quadric_curve,
    quadric_half_gradient,
    quadric_value,
    unit_roundoff,
)
from warp_reflect.settings import Status

# Every kernel is a Warp module of its own: who asks for a sphere compiles no plane and no scan for all roots.
# Unrolled, the searches in loops of known length would be compiled many times over.
OPTIONS = {"enable_backward": False, "max_unroll": 2}
wp.set_module_options(OPTIONS)

NONE = wp.constant(int(Status.NONE))
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
GRAZING = wp.constant(int(Status.GRAZING))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))
DEGENERATE = wp.constant(int(Status.DEGENERATE))
AMBIGUOUS = wp.constant(int(Status.AMBIGUOUS))
NEAR_CAUSTIC = wp.constant(int(Status.NEAR_CAUSTIC))
INSIDE = wp.constant(int(Status.INSIDE))
BAD_INPUT = wp.constant(int(Status.BAD_INPUT))
OUT_OF_EXTENT = wp.constant(int(Status.OUT_OF_EXTENT))

NEWTON_STEPS = wp.constant(12)  # evaluations before the bracketed search takes over
GUESS_STEPS = wp.constant(4)  # Newton steps of the first foot point; more do not pay
TOUCHING = wp.constant(4.0)  # roundings of a unit coordinate within which a point is on the surface
SLACK = wp.constant(64.0)  # roundings of the terms of the angle within which it is 0


@wp.func
def near_limit(x: wp.float32):
    """Distances beyond it, in sizes, are cut for the search: R does not feel it, and squares stay finite."""
    return wp.float64(1.0e9)


@wp.func
def near_limit(x: wp.float64):
    return wp.float64(1.0e15)


@wp.func
def grazing_limit(x: wp.float32):
    """Cosine of 89.9 degrees: below it a rounding moves the reflection point by 1e-4 of the size."""
    return wp.float64(1.75e-3)


@wp.func
def grazing_limit(x: wp.float64):
    return wp.float64(1.0e-7)


@wp.func
def to_double(x: Any):
    return wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))


@wp.func
def finite(x: wp.vec3d):
    """True for finite numbers only: x - x = 0; min, max and comparisons would hide a NaN."""
    e = x - x
    return e[0] == wp.float64(0.0) and e[1] == wp.float64(0.0) and e[2] == wp.float64(0.0)


@wp.func
def cut_far(x: wp.vec3d, limit: wp.float64):
    r = safe_length(x)
    if r > limit:
        return (limit / r) * x
    return x


@wp.func
def signed_distance(x: wp.vec3d, lam: wp.vec3d, b: wp.float64, c: wp.float64):
    """First-order distance of a point near the surface; far away only its sign and order count."""
    q = quadric_value(x, lam, b, c)
    n = quadric_half_gradient(x, lam, b)
    return q / (wp.length(n) + wp.sqrt(wp.dot(n, n) + wp.abs(q)))


@wp.func
def chord_enters(eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, b: wp.float64, c: wp.float64, sheet: int):
    """True if the segment between outsiders enters the body (sheet != 0: its part with that sign of z)."""
    d = target - eye
    aa = quadric_curve(d, d, lam)
    hb = wp.dot(quadric_half_gradient(eye, lam, b), d)
    cc = quadric_value(eye, lam, b, c)
    if not (aa > wp.float64(0.0)) or not (hb < wp.float64(0.0)) or not (hb + aa > wp.float64(0.0)):
        return False
    if hb * hb <= aa * cc:
        return False
    return sheet == 0 or (eye[2] - (hb / aa) * d[2]) * wp.float64(sheet) > wp.float64(0.0)


@wp.func
def normal_curvature(n: wp.vec3d, along: wp.vec3d, lam: wp.vec3d, n_length: wp.float64):
    """Absolute normal curvature in the plane of n and `along`."""
    t = along - wp.dot(along, n) * n
    tt = wp.dot(t, t)
    if tt > wp.float64(0.0):
        return wp.abs(quadric_curve(t, t, lam)) / (tt * n_length)
    return wp.abs(lam[0] + lam[1] + lam[2] - quadric_curve(n, n, lam)) / n_length


# --------------------------------------------------------------------------------------------------
# Planes


@wp.kernel(module="unique", module_options=OPTIONS)
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
        # Heights add: no cancellation. R is a weighted mean of the two feet.
        t = h_target / (h_eye + h_target)
        r = t * (eye - h_eye * normal) + (wp.float64(1.0) - t) * r
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


# --------------------------------------------------------------------------------------------------
# Quadrics


@wp.struct
class QuadricView:
    """A quadric mirror on the device.

    `lam`, `b`, `c` describe the canonical body; `sign` is -1 where its inside reflects.
    """

    unit_from_world: wp.mat33d
    axes: wp.mat33d  # world_from_unit, without the size
    origin: wp.vec3d
    size: wp.float64
    lam: wp.vec3d
    b: wp.float64
    c: wp.float64
    sign: wp.float64
    family: int
    equal: int
    sheet: int


def quadric_view(mirror: QuadricMirror) -> QuadricView:
    """The device form of a quadric mirror."""
    quadric = mirror.canonical
    view = QuadricView()
    view.unit_from_world = wp.mat33d(quadric.axes.T / quadric.size)
    view.axes = wp.mat33d(quadric.axes)
    view.origin = wp.vec3d(quadric.origin)
    view.size = quadric.size
    view.lam = wp.vec3d(quadric.lam)
    view.b = quadric.b
    view.c = quadric.c
    view.sign = -1.0 if mirror.reverse else 1.0
    view.family = int(FAMILY[quadric.kind])
    view.equal = quadric.equal
    view.sheet = mirror.sheet
    return view


@wp.struct
class Found:
    """A reflection point in the unit frame (float64) and what it is worth."""

    point: wp.vec3d
    normal: wp.vec3d
    image: wp.vec3d
    residual: wp.float64
    length: wp.float64
    status: int


@wp.func
def judge(
    r: wp.vec3d,
    eye: wp.vec3d,
    target: wp.vec3d,
    lam: wp.vec3d,
    b: wp.float64,
    roundoff: wp.float64,
    grazing: wp.float64,
):
    """Normal, virtual point, residual and status of a reflection point found in a precision."""
    one = wp.float64(1.0)
    found = Found()
    n = quadric_half_gradient(r, lam, b)
    n_length = wp.length(n)
    if not (n_length > wp.float64(1.0e-9)):
        # The apex of a cone.
        found.status = DEGENERATE
        return found
    n = n / n_length
    to_eye = eye - r
    to_target = target - r
    l_eye = safe_length(to_eye)
    l_target = safe_length(to_target)
    k = normal_curvature(n, to_eye, lam, n_length)
    found.point = r
    found.normal = n
    found.image = virtual_point(r, n, eye, target, k)
    found.length = l_eye + l_target
    found.residual = specular_residual(r, n, eye, target)
    bend = (wp.abs(lam[0]) + wp.abs(lam[1]) + wp.abs(lam[2]) - wp.abs(quadric_curve(n, n, lam))) / n_length
    scale = one + wp.length(r)
    cosine = wp.dot(to_eye, n) / l_eye
    # The half vector shrinks with the cosine, the rounding of its two parts does not.
    slack = wp.float64(SLACK) * roundoff * (one + scale * (bend + one / l_eye + one / l_target))
    slack = slack / wp.max(cosine, grazing)
    found.status = CONVERGED
    if cosine < grazing:
        found.status = GRAZING
    if found.residual > slack:
        found.status = MAX_ITERATIONS
    return found


@wp.func
def touch(target: wp.vec3d, eye: wp.vec3d, lam: wp.vec3d, b: wp.float64):
    """The answer for a point on the surface: it is its own reflection where the eye sees it."""
    found = Found()
    n = safe_normalize(quadric_half_gradient(target, lam, b))
    found.status = HIDDEN
    if wp.dot(eye - target, n) > wp.float64(0.0):
        found.point = target
        found.normal = n
        found.image = target
        found.length = wp.length(eye - target)
        found.status = CONVERGED
    return found


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
    if not (angle <= wp.min(good, near.dtype(1.0e-2))):
        result = bracket_on_convex(eye, target, lam, b, c, family)
        if wp.length(quadric_half_gradient(result, lam, b)) > wp.float64(1.0e-9):
            fine = wp.float64(6.0) * unit_roundoff(b)
            result, _angle = newton_on_convex(result, eye, target, lam, b, c, family, NEWTON_STEPS, fine)
    return result


@wp.func
def refuse(eye: wp.vec3d, target: wp.vec3d, view: QuadricView, sheet: int, roundoff: wp.float64):
    """What needs no search on a convex body: status NONE where one is needed."""
    found = Found()
    limit = wp.float64(TOUCHING) * roundoff
    eye_height = signed_distance(eye, view.lam, view.b, view.c)
    target_height = signed_distance(target, view.lam, view.b, view.c)
    facing = wp.float64(sheet)
    eye_here = sheet == 0 or eye[2] * facing > wp.float64(0.0)
    target_here = sheet == 0 or target[2] * facing > wp.float64(0.0)
    eye_limit = limit * wp.max(wp.float64(1.0), wp.length(eye))
    target_limit = limit * wp.max(wp.float64(1.0), wp.length(target))
    if eye_here and wp.abs(eye_height) <= eye_limit:
        found.status = BAD_INPUT
    elif (eye_here and eye_height < wp.float64(0.0)) or (target_here and target_height < -target_limit):
        found.status = INSIDE
    elif target_here and target_height <= target_limit:
        found = touch(target, eye, view.lam, view.b)
    elif chord_enters(eye, target, view.lam, view.b, view.c, sheet):
        found.status = HIDDEN
    return found


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


@wp.func
def has_point(status: int):
    """True for a status that comes with a reflection point."""
    return (
        status == CONVERGED
        or status == GRAZING
        or status == NEAR_CAUSTIC
        or status == AMBIGUOUS
        or status == MAX_ITERATIONS
    )


@wp.kernel(module="unique", module_options=OPTIONS)
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
    near = zero
    usable = int(0)
    if warm != 0:
        s = view.unit_from_world * (to_double(start[row]) - view.origin)
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
                write_root(zero, other, 1, 0, view, row, out_roots, out_root_length, out_root_index, out_root_status)
                out_root_count[row] = 1
        elif has_point(other.status):
            best = other
        elif not has_point(best.status):
            best.status = worse_status(best.status, other.status)
    out_status[row] = wp.uint8(best.status)
    if has_point(best.status):
        write_answer(zero, best, view, row, out_point, out_normal, out_virtual, out_residual)
        if out_roots.shape[1] > 0:
            write_root(zero, best, 0, 0, view, row, out_roots, out_root_length, out_root_index, out_root_status)
            out_root_count[row] = out_root_count[row] + 1


@wp.func
def write_answer(
    zero: Any,
    found: Found,
    view: QuadricView,
    row: int,
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
):
    p = view.origin + view.size * (view.axes * found.point)
    v = view.origin + view.size * (view.axes * found.image)
    n = view.axes * found.normal
    out_point[row] = type(zero)(zero.dtype(p[0]), zero.dtype(p[1]), zero.dtype(p[2]))
    out_virtual[row] = type(zero)(zero.dtype(v[0]), zero.dtype(v[1]), zero.dtype(v[2]))
    out_normal[row] = type(zero)(zero.dtype(n[0]), zero.dtype(n[1]), zero.dtype(n[2]))
    out_residual[row] = zero.dtype(found.residual)


@wp.func
def write_root(
    zero: Any,
    found: Found,
    slot: int,
    index: int,
    view: QuadricView,
    row: int,
    out_roots: wp.array2d(dtype=Any),
    out_root_length: wp.array2d(dtype=Any),
    out_root_index: wp.array2d(dtype=wp.uint8),
    out_root_status: wp.array2d(dtype=wp.uint8),
):
    p = view.origin + view.size * (view.axes * found.point)
    out_roots[row, slot] = type(zero)(zero.dtype(p[0]), zero.dtype(p[1]), zero.dtype(p[2]))
    out_root_length[row, slot] = zero.dtype(view.size * found.length)
    out_root_index[row, slot] = wp.uint8(index)
    out_root_status[row, slot] = wp.uint8(found.status)


@wp.kernel(module="unique", module_options=OPTIONS)
def solve_general_kernel(
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
    # The scan works in float64 whatever the points are: its polynomial is beyond float32.
    eye = view.unit_from_world * (eye_world - view.origin)
    target = view.unit_from_world * (target_world - view.origin)
    roundoff = wp.float64(unit_roundoff(zero[0]))
    a = view.sign * view.lam
    b = view.sign * view.b
    c = view.sign * view.c
    one = wp.float64(1.0)
    limit = wp.float64(TOUCHING) * roundoff
    eye_height = signed_distance(eye, a, b, c)
    target_height = signed_distance(target, a, b, c)
    eye_limit = limit * wp.max(one, wp.length(eye))
    target_limit = limit * wp.max(one, wp.length(target))
    if wp.abs(eye_height) <= eye_limit:
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    if eye_height < wp.float64(0.0) or target_height < -target_limit:
        out_status[row] = wp.uint8(INSIDE)
        return
    best = Found()
    best_rank = int(4)
    count = int(0)
    far = near_limit(zero[0])
    if target_height <= target_limit:
        # A point on the mirror is its own reflection, the shortest path of all.
        best = touch(target, eye, a, b)
        if best.status == CONVERGED:
            best_rank = 0
            if out_roots.shape[1] > 0:
                write_root(zero, best, 0, 0, view, row, out_roots, out_root_length, out_root_index, out_root_status)
            count = 1
        else:
            best = Found()
    found, root_count = all_reflections(cut_far(eye, far), cut_far(target, far), a, b, c, view.equal, view.sheet)
    for k in range(root_count):
        code = int(found[k, 4])
        ring = code & FLAG_RING
        index = code - ring
        r = wp.vec3d(found[k, 0], found[k, 1], found[k, 2])
        if count > 0 and k == 0 and wp.length(r - target) <= wp.float64(16.0) * target_limit:
            continue
        root = judge(r, eye, target, a, b, roundoff, grazing_limit(zero[0]))
        if root.status == CONVERGED:
            if ring != 0:
                root.status = AMBIGUOUS
            elif flatness(r, eye, target, a, b) < wp.float64(16.0) * wp.sqrt(roundoff):
                root.status = NEAR_CAUSTIC
        if count < out_roots.shape[1]:
            write_root(
                zero,
                root,
                count,
                index,
                view,
                row,
                out_roots,
                out_root_length,
                out_root_index,
                out_root_status,
            )
        count = count + 1
        # Index 0 first, then 2, then 1; within a class the first one is the shortest.
        rank = index
        if index > 0:
            rank = 3 - index
        if rank < best_rank:
            best_rank = rank
            best = root
    if out_roots.shape[1] > 0:
        out_root_count[row] = wp.min(count, out_roots.shape[1])
    if count == 0:
        if chord_enters(eye, target, a, b, c, 0):
            out_status[row] = wp.uint8(HIDDEN)
        else:
            out_status[row] = wp.uint8(UNREFLECTED)
        return
    out_status[row] = wp.uint8(best.status)
    write_answer(zero, best, view, row, out_point, out_normal, out_virtual, out_residual)


@wp.kernel(module="unique", module_options=OPTIONS)
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
            write_answer(zero, found, view, row, out_point, out_normal, out_virtual, out_residual)
    elif found.status == CONVERGED:
        write_answer(zero, found, view, row, out_point, out_normal, out_virtual, out_residual)
    out_status[row] = wp.uint8(found.status)


def _overloads() -> None:
    """Declare both precisions, so that one module holds both and the first call of either compiles once."""
    scan = {}
    for vector, scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
        one, two = wp.array(dtype=vector), wp.array2d(dtype=vector)
        number, table = wp.array(dtype=scalar), wp.array2d(dtype=scalar)
        scan[vector] = {
            "points": one,
            "out_point": one,
            "out_normal": one,
            "out_virtual": one,
            "out_residual": number,
        }
        wp.overload(solve_plane_kernel, scan[vector])
        wp.overload(solve_qim_kernel, scan[vector])
        roots = {"out_roots": two, "out_root_length": table}
        wp.overload(solve_general_kernel, scan[vector] | roots)
        wp.overload(solve_convex_kernel, scan[vector] | roots | {"start": one})


_overloads()
