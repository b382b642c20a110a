"""The bare solver's kernels for refraction, in float64 between arrays of either precision.

A path through an interface is stationary in optical length (Fermat), which is Snell's law at every interface.

* Plane: the law in the plane of incidence is one equation with one root; Newton's method in a bracket.
* Ellipsoid, one interface (the point lies inside) or two: Newton's method on the entry point, whose ray leaves the body
  where and how it must, until it meets the point. Source: Walter et al., Single Scattering in Refractive Media with Triangle
  Mesh Boundaries, SIGGRAPH 2009 (one interface, whose Newton search is on the surface point). What differs: two interfaces
  have no more unknowns than one, because the second surface point of a quadric is explicit (for chains of meshes see Jakob
  and Marschner, Manifold Exploration, SIGGRAPH 2012, section 4); and no seed is asked for. A lens shows a point several
  times or not at all, so rays are shot through a net of entry points on the eye's side, and Newton starts in every triangle
  of the net whose linear interpolant meets the point; of several paths the one of least optical length is given.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.optics import refract, safe_length, safe_normalize, snell_residual, tangent_basis
from warp_reflect.quadrics import put_on_surface, quadric_curve, quadric_half_gradient, unit_roundoff
from warp_reflect.settings import Status
from warp_reflect.solve_device import (
    BAD_INPUT,
    CONVERGED,
    GRAZING,
    INSIDE,
    MAX_ITERATIONS,
    NEAR_CAUSTIC,
    OUT_OF_EXTENT,
    SLACK,
    TOUCHING,
    QuadricView,
    cut_far,
    finite,
    grazing_limit,
    near_limit,
    signed_distance,
    to_double,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
DEGENERATE = wp.constant(int(Status.DEGENERATE))
PLANE_STEPS = wp.constant(80)  # halving alone ends float64's bracket in 60
NEWTON_STEPS = wp.constant(40)
LONGEST_STEP = wp.constant(0.5)  # of the body's size
SHORTENINGS = wp.constant(8)  # of a step that makes things worse, each to 0.4
RINGS = wp.constant(10)  # of the net of entry points; 20 x 32 of them find not one path in 1e5 more
SECTORS = wp.constant(16)
WIDEST = wp.constant(0.9999)  # of the angle to the rim, where a grazing ray leaves by no more than a rounding
NET_MARGIN = wp.constant(0.15)  # of a barycentric weight: the net's interpolant is not the map itself
DIFFERENCE = wp.constant(1.0e-7)  # of the size; the slopes it gives lose half of float64's digits, the root none
MEETS = wp.constant(1.0e-12)  # of the size (of the distance, far away): a ray that passes a point this close meets it
CAUSTIC = wp.constant(0.1)  # square roots of a rounding: a slope this far from singular is one of a path that merges
ON_AXIS = wp.constant(1.0e-6)  # sine within which eye, centre and point lie on one line, and no plane is theirs


@wp.func
def plane_foot(h_eye: wp.float64, h_target: wp.float64, distance: wp.float64, ior: wp.float64):
    """Where a refracted path meets a plane, as the share of the way from the target's foot to the eye's.

    The law as f(x) = ratio x / |x, near| - (d - x) / |d - x, far| with x from the foot of the lower end, whose digits count
    most; f grows from below 0 to above.

    Args:
        h_eye: Height of the eye above the plane, positive.
        h_target: Depth of the target below it, positive.
        distance: Between their feet.
        ior: Index of refraction below over that above.
    """
    zero = wp.float64(0.0)
    if not (distance > zero):
        return wp.float64(0.5)
    swap = h_eye < h_target
    near = h_target / distance
    far = h_eye / distance
    ratio = ior
    if swap:
        near = h_eye / distance
        far = h_target / distance
        ratio = wp.float64(1.0) / ior
    low = zero
    high = wp.float64(1.0)
    x = near / (near + far)
    step = int(0)
    while step < PLANE_STEPS:
        step += 1
        y = wp.float64(1.0) - x
        length_x = wp.sqrt(x * x + near * near)
        length_y = wp.sqrt(y * y + far * far)
        f = ratio * (x / length_x) - y / length_y
        if f == zero:
            break
        if f < zero:
            low = x
        else:
            high = x
        slope = (
            ratio * (near / length_x) * (near / length_x) / length_x + (far / length_y) * (far / length_y) / length_y
        )
        moved = x - f / slope
        if not (moved > low and moved < high):
            moved = wp.float64(0.5) * (low + high)
        # In digits of x itself, which may be small.
        if wp.abs(moved - x) <= wp.float64(2.0e-16) * x or moved == low or moved == high:
            x = moved
            break
        x = moved
    if swap:
        return wp.float64(1.0) - x
    return x


@wp.kernel
def refract_plane_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    # Interface:
    ior: wp.float64,
    origin: wp.vec3d,
    plane_normal: wp.vec3d,
    width_axis: wp.vec3d,
    height_axis: wp.vec3d,
    half_width: wp.float64,
    half_height: wp.float64,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_exit: wp.array(dtype=Any),
    out_exit_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_length: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
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
    eye = eye_world - origin
    target = target_world - origin
    normal = plane_normal
    ratio = ior
    if wp.dot(eye, normal) < wp.float64(0.0):
        normal = -normal
        ratio = wp.float64(1.0) / ior
    h_eye = wp.dot(eye, normal)
    h_target = -wp.dot(target, normal)
    roundoff = wp.float64(8.0) * wp.float64(unit_roundoff(out_residual[row]))
    n_abs = wp.vec3d(wp.abs(normal[0]), wp.abs(normal[1]), wp.abs(normal[2]))
    eye_noise = roundoff * wp.dot(n_abs, wp.vec3d(wp.abs(eye[0]), wp.abs(eye[1]), wp.abs(eye[2])))
    target_noise = roundoff * wp.dot(n_abs, wp.vec3d(wp.abs(target[0]), wp.abs(target[1]), wp.abs(target[2])))
    if h_eye <= eye_noise:
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    if h_target < -target_noise:
        out_status[row] = wp.uint8(UNREFLECTED)
        return
    eye_foot = eye - h_eye * normal
    r = target + h_target * normal
    residual = wp.float64(0.0)
    status = CONVERGED
    if h_target > target_noise:
        share = plane_foot(h_eye, h_target, safe_length(eye_foot - r), ratio)
        r = r + share * (eye_foot - r)
        residual = snell_residual(r, normal, eye, target, ratio)
    else:
        h_target = wp.float64(0.0)
    # A rounding of the coordinates turns the direction to an end the more the nearer it is.
    reach = safe_length(eye) + safe_length(target) + safe_length(r)
    if h_eye < grazing_limit(out_residual[row]) * wp.float64(1.0e-3) * safe_length(eye - r):
        status = GRAZING
    elif residual * wp.min(safe_length(eye - r), safe_length(target - r)) > wp.float64(SLACK) * roundoff * reach:
        status = MAX_ITERATIONS
    if half_width > wp.float64(0.0):
        if wp.abs(wp.dot(r, width_axis)) > half_width or wp.abs(wp.dot(r, height_axis)) > half_height:
            status = OUT_OF_EXTENT
    behind = safe_length(target - r)
    v = r + origin + behind * safe_normalize(r - eye)
    r = r + origin
    optical = safe_length(eye_world - r) + ratio * behind
    out_point[row] = type(zero)(zero.dtype(r[0]), zero.dtype(r[1]), zero.dtype(r[2]))
    out_normal[row] = type(zero)(zero.dtype(normal[0]), zero.dtype(normal[1]), zero.dtype(normal[2]))
    out_exit[row] = out_point[row]
    out_exit_normal[row] = -out_normal[row]
    out_virtual[row] = type(zero)(zero.dtype(v[0]), zero.dtype(v[1]), zero.dtype(v[2]))
    out_length[row] = zero.dtype(optical)
    out_residual[row] = zero.dtype(residual)
    out_status[row] = wp.uint8(status)


@wp.struct
class Pathway:
    """A path through an ellipsoid in its unit frame: where it enters, where it leaves (or ends, inside)."""

    entry: wp.vec3d
    leave: wp.vec3d
    error: wp.float64  # Snell's residual, the larger of both interfaces
    length: wp.float64  # optical
    pivot: wp.float64  # how far the map from entry points to rays is from singular
    found: int


@wp.func
def far_end(p: wp.vec3d, direction: wp.vec3d, lam: wp.vec3d):
    """Where a ray from a surface point of an ellipsoid x^T diag(lam) x = 1 through its inside leaves it."""
    s = -wp.float64(2.0) * quadric_curve(p, direction, lam) / quadric_curve(direction, direction, lam)
    return put_on_surface(p + s * direction, lam, wp.float64(0.0), wp.float64(-1.0), 0)


@wp.func
def unit_normal(p: wp.vec3d, lam: wp.vec3d):
    return wp.normalize(quadric_half_gradient(p, lam, wp.float64(0.0)))


@wp.func
def shoot(entry: wp.vec3d, eye: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int):
    """(last surface point, direction from there) of the eye's ray through a surface point; a zero direction: total reflection."""
    n = unit_normal(entry, lam)
    d = refract(wp.normalize(entry - eye), n, ior)
    if inside != 0 or wp.dot(d, d) == wp.float64(0.0):
        return entry, d
    leave = far_end(entry, d, lam)
    return leave, refract(d, -unit_normal(leave, lam), wp.float64(1.0) / ior)


@wp.func
def net_point(ring: int, sector: int, eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d):
    """A node of the net over the part of an ellipsoid that an eye outside sees, scaled to a sphere; ring 0 is the middle.

    Sector 0 and the opposite one lie in the plane of eye, centre and target, where a sphere has all its paths.
    """
    scale = wp.vec3d(wp.sqrt(lam[0]), wp.sqrt(lam[1]), wp.sqrt(lam[2]))
    e = wp.cw_mul(scale, eye)
    away = wp.length(e)
    e = e / away
    t1, t2 = tangent_basis(e)
    to_target = safe_normalize(wp.cw_mul(scale, target))
    side = to_target - wp.dot(to_target, e) * e
    if wp.length(side) > wp.float64(ON_AXIS):
        t1 = wp.normalize(side)
        t2 = wp.cross(e, t1)
    widest = wp.float64(WIDEST) * wp.acos(wp.min(wp.float64(1.0) / away, wp.float64(1.0)))
    theta = widest * wp.float64(ring) / wp.float64(RINGS)
    phi = wp.float64(6.283185307179586) * wp.float64(sector) / wp.float64(SECTORS)
    on = wp.cos(theta) * e + wp.sin(theta) * (wp.cos(phi) * t1 + wp.sin(phi) * t2)
    return wp.cw_div(on, scale)


@wp.func
def passing(x: wp.vec3d, d: wp.vec3d, target: wp.vec3d):
    """From a ray to the target, across it; far away as an angle. Close by, an angle would turn round in passing."""
    to_target = target - x
    return (to_target - wp.dot(to_target, d) * d) / (wp.float64(1.0) + safe_length(to_target))


@wp.func
def miss(entry: wp.vec3d, eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int):
    """How far the ray through a surface point passes the target by: two numbers and 1 if there is a ray."""
    x, d = shoot(entry, eye, lam, ior, inside)
    if wp.dot(d, d) == wp.float64(0.0):
        return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    off = passing(x, d, target)
    t1, t2 = tangent_basis(safe_normalize(target - eye))
    return wp.vec3d(wp.dot(off, t1), wp.dot(off, t2), wp.float64(1.0))


@wp.func
def holds_zero(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d):
    """Of the linear interpolant of the misses at a triangle's corners: weights of b and c at its zero, and its determinant.

    The determinant is 0 where the triangle has none.
    """
    none = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
    if a[2] * b[2] * c[2] == wp.float64(0.0):
        return none
    bx = b[0] - a[0]
    by = b[1] - a[1]
    cx = c[0] - a[0]
    cy = c[1] - a[1]
    det = bx * cy - by * cx
    if det == wp.float64(0.0):
        return none
    return wp.vec3d((cx * a[1] - cy * a[0]) / det, (by * a[0] - bx * a[1]) / det, det)


@wp.func
def path_error(a: wp.vec3d, b: wp.vec3d, eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int):
    """The larger of Snell's residuals along eye, a, b, target, without regard to sides; inside: along eye, a, target."""
    n_a = unit_normal(a, lam)
    d = wp.normalize(b - a)
    w = ior * d - wp.normalize(a - eye)
    error = wp.length(w - wp.dot(w, n_a) * n_a)
    if inside == 0:
        n_b = unit_normal(b, lam)
        w = ior * d - safe_normalize(target - b)
        error = wp.max(error, wp.length(w - wp.dot(w, n_b) * n_b))
    return error


@wp.func
def newton_path(entry: wp.vec3d, eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int):
    """Newton's method from an entry point to one whose ray meets the target."""
    one = wp.float64(1.0)
    zero = wp.float64(0.0)
    h = wp.float64(DIFFERENCE)
    result = Pathway()
    a = entry
    x, d = shoot(a, eye, lam, ior, inside)
    off = passing(x, d, target)
    error = wp.length(off)
    step = int(0)
    while step < NEWTON_STEPS:
        step += 1
        a1, a2 = tangent_basis(unit_normal(a, lam))
        t1, t2 = tangent_basis(d)
        # Away from the limit of total reflection, if one is that near.
        h1 = h
        h2 = h
        x1, d1 = shoot(put_on_surface(a + h1 * a1, lam, zero, -one, 0), eye, lam, ior, inside)
        if wp.dot(d1, d1) == zero:
            h1 = -h
            x1, d1 = shoot(put_on_surface(a + h1 * a1, lam, zero, -one, 0), eye, lam, ior, inside)
        x2, d2 = shoot(put_on_surface(a + h2 * a2, lam, zero, -one, 0), eye, lam, ior, inside)
        if wp.dot(d2, d2) == zero:
            h2 = -h
            x2, d2 = shoot(put_on_surface(a + h2 * a2, lam, zero, -one, 0), eye, lam, ior, inside)
        if wp.dot(d1, d1) == zero or wp.dot(d2, d2) == zero:
            break
        along_1 = (passing(x1, d1, target) - off) / h1
        along_2 = (passing(x2, d2, target) - off) / h2
        j11 = wp.dot(along_1, t1)
        j12 = wp.dot(along_2, t1)
        j21 = wp.dot(along_1, t2)
        j22 = wp.dot(along_2, t2)
        det = j11 * j22 - j12 * j21
        result.pivot = wp.abs(det) / (j11 * j11 + j12 * j12 + j21 * j21 + j22 * j22 + wp.float64(1.0e-300))
        if det == zero:
            break
        f1 = wp.dot(off, t1)
        f2 = wp.dot(off, t2)
        move = ((j12 * f2 - j22 * f1) / det) * a1 + ((j21 * f1 - j11 * f2) / det) * a2
        factor = wp.min(one, wp.float64(LONGEST_STEP) / wp.max(wp.length(move), wp.float64(1.0e-300)))
        better = int(0)
        shortened = int(0)
        while better == 0 and shortened < SHORTENINGS:
            shortened += 1
            next_a = put_on_surface(a + factor * move, lam, zero, -one, 0)
            next_x, next_d = shoot(next_a, eye, lam, ior, inside)
            next_off = passing(next_x, next_d, target)
            if wp.dot(next_d, next_d) > zero and wp.length(next_off) < error:
                better = int(1)
                a = next_a
                x = next_x
                d = next_d
                off = next_off
                error = wp.length(off)
            else:
                factor = wp.float64(0.4) * factor
        if better == 0 or error == zero:
            break
    result.entry = a
    result.leave = x
    end = x
    if inside != 0:
        end = target
    result.error = path_error(a, end, eye, target, lam, ior, inside)
    result.length = safe_length(a - eye) + ior * safe_length(end - a) + safe_length(target - end)
    # The ray must go towards the target, not away from it.
    if wp.dot(eye - a, unit_normal(a, lam)) > zero and error <= wp.float64(MEETS) and wp.dot(target - x, d) > zero:
        result.found = 1
    return result


@wp.func
def rim_distance(m: wp.vec3d):
    """Square of a node's miss; very large where it has no ray."""
    if m[2] == wp.float64(0.0):
        return wp.float64(1.0e30)
    return m[0] * m[0] + m[1] * m[1]


@wp.func
def nearer_path(
    best: Pathway, start: wp.vec3d, eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int
):
    """The shorter of a path and the one that is found from a start."""
    on = put_on_surface(start, lam, wp.float64(0.0), wp.float64(-1.0), 0)
    path = newton_path(on, eye, target, lam, ior, inside)
    if path.found != 0 and (best.found == 0 or path.length < best.length):
        return path
    return best


@wp.func
def least_path(eye: wp.vec3d, target: wp.vec3d, lam: wp.vec3d, ior: wp.float64, inside: int):
    """Of all paths from an eye outside an ellipsoid through it to the target the one of least optical length."""
    one = wp.float64(1.0)
    best = Pathway()
    middle = net_point(0, 0, eye, target, lam)
    # Two paths about to merge lie on either side of a fold, where the net's triangles turn over and may both miss: the
    # nearest triangle of either orientation is tried as well.
    least_up = wp.float64(1.0e30)
    least_down = wp.float64(1.0e30)
    start_up = middle
    start_down = middle
    # Where total reflection begins the net is ragged: the nearest of its nodes there is tried.
    least_rim = wp.float64(1.0e30)
    start_rim = middle
    sector = int(0)
    while sector < SECTORS:
        p0 = middle
        q0 = middle
        m_p0 = miss(middle, eye, target, lam, ior, inside)
        m_q0 = m_p0
        ring = int(1)
        while ring <= RINGS:
            p1 = net_point(ring, sector, eye, target, lam)
            q1 = net_point(ring, sector + 1, eye, target, lam)
            m_p1 = miss(p1, eye, target, lam, ior, inside)
            m_q1 = miss(q1, eye, target, lam, ior, inside)
            half = int(0)
            while half < 2:
                b = p1
                c = q1
                m_b = m_p1
                m_c = m_q1
                if half == 1:
                    b = q1
                    c = q0
                    m_b = m_q1
                    m_c = m_q0
                half += 1
                zero = holds_zero(m_p0, m_b, m_c)
                inmost = wp.min(wp.min(zero[0], zero[1]), one - zero[0] - zero[1])
                if zero[2] != wp.float64(0.0):
                    if inmost >= -wp.float64(NET_MARGIN):
                        start = p0 + zero[0] * (b - p0) + zero[1] * (c - p0)
                        best = nearer_path(best, start, eye, target, lam, ior, inside)
                    middle_miss = m_p0 + m_b + m_c
                    near = middle_miss[0] * middle_miss[0] + middle_miss[1] * middle_miss[1]
                    if zero[2] > wp.float64(0.0) and near < least_up:
                        least_up = near
                        start_up = p0 + b + c
                    elif zero[2] < wp.float64(0.0) and near < least_down:
                        least_down = near
                        start_down = p0 + b + c
                elif m_p0[2] + m_b[2] + m_c[2] > wp.float64(0.0):
                    near_p0 = rim_distance(m_p0)
                    near_b = rim_distance(m_b)
                    near_c = rim_distance(m_c)
                    near = wp.min(near_p0, wp.min(near_b, near_c))
                    if near < least_rim:
                        least_rim = near
                        start_rim = wp.where(near == near_p0, p0, wp.where(near == near_b, b, c))
            p0 = p1
            q0 = q1
            m_p0 = m_p1
            m_q0 = m_q1
            ring += 1
        sector += 1
    side = int(0)
    while side < 3:
        start = wp.where(side == 0, start_up, wp.where(side == 1, start_down, start_rim))
        best = nearer_path(best, start, eye, target, lam, ior, inside)
        side += 1
    return best


@wp.kernel
def refract_body_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    # Interface:
    ior: wp.float64,
    view: QuadricView,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_exit: wp.array(dtype=Any),
    out_exit_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_length: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
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
    far = near_limit(wp.float64(0.0))
    eye = view.unit_from_world * (eye_world - view.origin)
    target = view.unit_from_world * (target_world - view.origin)
    lam = view.lam / -view.c
    roundoff = wp.float64(unit_roundoff(zero[0]))
    eye_height = signed_distance(eye, lam, wp.float64(0.0), wp.float64(-1.0))
    target_height = signed_distance(target, lam, wp.float64(0.0), wp.float64(-1.0))
    limit = wp.float64(TOUCHING) * roundoff
    if wp.abs(eye_height) <= limit * wp.max(wp.float64(1.0), safe_length(eye)):
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    touching = wp.abs(target_height) <= limit * wp.max(wp.float64(1.0), safe_length(target))
    eye_inside = eye_height < wp.float64(0.0)
    target_inside = target_height < wp.float64(0.0) or touching
    if eye_inside and target_inside:
        out_status[row] = wp.uint8(INSIDE)
        return
    start = cut_far(eye, far)
    goal = cut_far(target, far)
    if eye_inside:
        # The way back is the same way, and its first point is the only one.
        start = cut_far(target, far)
        goal = eye
    single = int(0)
    if eye_inside or target_inside:
        single = int(1)
    path = least_path(start, goal, lam, ior, single)
    if path.found == 0:
        out_status[row] = wp.uint8(UNREFLECTED)
        return
    a = path.entry
    b = path.leave
    if single != 0:
        b = a
    status = CONVERGED
    if path.pivot < wp.float64(CAUSTIC) * wp.sqrt(roundoff):
        status = NEAR_CAUSTIC
    normal = unit_normal(a, lam)
    exit_normal = unit_normal(b, lam)
    if eye_inside:
        normal = -normal
    if single != 0:
        exit_normal = -normal
    cosine = wp.abs(wp.dot(wp.normalize(a - start), unit_normal(a, lam)))
    if status == CONVERGED and cosine < grazing_limit(zero[0]):
        status = GRAZING
    straight = safe_length(a - eye) + safe_length(b - a) + safe_length(target - b)
    v = a + (straight - safe_length(a - eye)) * safe_normalize(a - eye)
    p = view.origin + view.size * (view.axes * a)
    q = view.origin + view.size * (view.axes * b)
    w = view.origin + view.size * (view.axes * v)
    n_p = view.axes * normal
    n_q = view.axes * exit_normal
    out_point[row] = type(zero)(zero.dtype(p[0]), zero.dtype(p[1]), zero.dtype(p[2]))
    out_exit[row] = type(zero)(zero.dtype(q[0]), zero.dtype(q[1]), zero.dtype(q[2]))
    out_virtual[row] = type(zero)(zero.dtype(w[0]), zero.dtype(w[1]), zero.dtype(w[2]))
    out_normal[row] = type(zero)(zero.dtype(n_p[0]), zero.dtype(n_p[1]), zero.dtype(n_p[2]))
    out_exit_normal[row] = type(zero)(zero.dtype(n_q[0]), zero.dtype(n_q[1]), zero.dtype(n_q[2]))
    out_length[row] = zero.dtype(view.size * path.length)
    out_residual[row] = zero.dtype(path.error)
    out_status[row] = wp.uint8(status)


for _kernel in (refract_plane_kernel, refract_body_kernel):
    for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
        _vectors = ("points", "out_point", "out_normal", "out_exit", "out_exit_normal", "out_virtual")
        wp.overload(
            _kernel,
            {name: wp.array(dtype=_vector) for name in _vectors}
            | {name: wp.array(dtype=_scalar) for name in ("out_length", "out_residual")},
        )
