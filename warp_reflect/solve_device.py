"""What the bare solver's kernels share: the way to the unit frame, refusals, the judgement of a found point.

World positions come in the caller's precision and leave in it; the way to the unit principal frame and all
decisions (inside, hidden, touching) are float64, the search on convex bodies is in the caller's precision.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.mirrors import QuadricMirror
from warp_reflect.optics import safe_length, safe_normalize, specular_residual, virtual_point
from warp_reflect.quadrics import FAMILY, quadric_curve, quadric_half_gradient, quadric_value
from warp_reflect.settings import Status

wp.set_module_options({"enable_backward": False})

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

TOUCHING = wp.constant(4.0)  # roundings of a unit coordinate within which a point is on the surface
SLACK = wp.constant(64.0)  # roundings of the terms of the angle within which it is 0
MOST_SLACK = wp.constant(0.1)  # a sine that no rounding excuses


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
    zero = wp.float64(0.0)
    d = target - eye
    aa = quadric_curve(d, d, lam)
    if not (aa > zero):
        return False
    if not (wp.dot(quadric_half_gradient(eye, lam, b), d) < zero):
        return False
    if not (wp.dot(quadric_half_gradient(target, lam, b), d) > zero):
        return False
    # q where it is least on the segment, reached from the nearer end: a discriminant would lose a far eye's digits.
    p = eye
    if wp.dot(target, target) < wp.dot(eye, eye):
        p = target
    p = p - (wp.dot(quadric_half_gradient(p, lam, b), d) / aa) * d
    if not (quadric_value(p, lam, b, c) < zero):
        return False
    return sheet == 0 or p[2] * wp.float64(sheet) > zero


@wp.func
def normal_curvature(n: wp.vec3d, along: wp.vec3d, lam: wp.vec3d, n_length: wp.float64):
    """Absolute normal curvature in the plane of n and `along`."""
    t = along - wp.dot(along, n) * n
    tt = wp.dot(t, t)
    if tt > wp.float64(0.0):
        return wp.abs(quadric_curve(t, t, lam)) / (tt * n_length)
    return wp.abs(lam[0] + lam[1] + lam[2] - quadric_curve(n, n, lam)) / n_length


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
    slack = wp.min(slack / wp.max(cosine, grazing), wp.float64(MOST_SLACK))
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
def has_point(status: int):
    """True for a status that comes with a reflection point."""
    return (
        status == CONVERGED
        or status == GRAZING
        or status == NEAR_CAUSTIC
        or status == AMBIGUOUS
        or status == MAX_ITERATIONS
    )


@wp.func
def unit_scale(eye: wp.vec3d, target: wp.vec3d, view: QuadricView):
    """Further scale of the unit frame for one pair: a cone has no size of its own, the nearer end gives it."""
    scale = wp.float64(1.0)
    if view.c == wp.float64(0.0) and view.b == wp.float64(0.0):
        nearer = wp.min(safe_length(eye), safe_length(target))
        if nearer > wp.float64(0.0):
            scale = nearer
    return scale


@wp.func
def write_answer(
    zero: Any,
    found: Found,
    view: QuadricView,
    size: wp.float64,
    row: int,
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
):
    if found.status == DEGENERATE:
        return  # no direction: what is there stays 0
    p = view.origin + size * (view.axes * found.point)
    v = view.origin + size * (view.axes * found.image)
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
    size: wp.float64,
    row: int,
    out_roots: wp.array2d(dtype=Any),
    out_root_length: wp.array2d(dtype=Any),
    out_root_index: wp.array2d(dtype=wp.uint8),
    out_root_status: wp.array2d(dtype=wp.uint8),
):
    if found.status == DEGENERATE:
        out_root_status[row, slot] = wp.uint8(found.status)
        return
    p = view.origin + size * (view.axes * found.point)
    out_roots[row, slot] = type(zero)(zero.dtype(p[0]), zero.dtype(p[1]), zero.dtype(p[2]))
    out_root_length[row, slot] = zero.dtype(size * found.length)
    out_root_index[row, slot] = wp.uint8(index)
    out_root_status[row, slot] = wp.uint8(found.status)
