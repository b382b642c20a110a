"""Device math of mirror reflection, written once for float32 and float64.

Notation of every function: `p` a point on the mirror, `n` its unit normal on the reflecting side, `eye` and
`target` the two ends of the light path, all in one frame and one unit; `o` and `v` unit directions to them.
`Any` stands for `wp.vec3` or `wp.vec3d` (scalars: the matching float type).
"""

from __future__ import annotations

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

MIN_HALF_NORMAL = wp.constant(1.0e-3)  # below it w_T / w_N has no slope that float32 resolves
MIN_DET_SHARE = wp.constant(0.05)  # of det H; a Jacobian below it would overshoot past the root
PI = wp.constant(3.141592653589793)


@wp.func
def safe_length(v: Any):
    """Euclidean length without overflow or underflow of the squares; 0 for a zero vector, never NaN.

    A vector that is not finite has length 0: it has no direction.
    """
    big = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))
    # A sum, unlike max, keeps a NaN; the quarter keeps the sum of three large finite numbers finite.
    total = v.dtype(0.25) * wp.abs(v[0]) + v.dtype(0.25) * wp.abs(v[1]) + v.dtype(0.25) * wp.abs(v[2])
    if big > v.dtype(0.0) and total - total == v.dtype(0.0):
        return big * wp.length(v / big)
    return v.dtype(0.0)


@wp.func
def safe_normalize(v: Any):
    """Unit vector along `v`; the zero vector where `v` is zero or not finite, never NaN.

    Scaled by the largest component first: in float32 `wp.normalize` gives 0 for lengths below 1e-19 or above
    1e19.
    """
    big = wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))
    total = v.dtype(0.25) * wp.abs(v[0]) + v.dtype(0.25) * wp.abs(v[1]) + v.dtype(0.25) * wp.abs(v[2])
    if big > v.dtype(0.0) and total - total == v.dtype(0.0):
        s = v / big
        return s / wp.length(s)
    return type(v)(v.dtype(0.0), v.dtype(0.0), v.dtype(0.0))


@wp.func
def tangent_basis(n: Any):
    """Two unit vectors that complete the unit vector `n` to a right-handed orthonormal basis.

    Source: Duff et al., Building an Orthonormal Basis, Revisited, JCGT 2017, listing 3.
    """
    one = n.dtype(1.0)
    sign = wp.where(n[2] < n.dtype(0.0), -one, one)
    a = -one / (sign + n[2])
    b = n[0] * n[1] * a
    t1 = type(n)(one + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    t2 = type(n)(b, sign + n[1] * n[1] * a, -n[1])
    return t1, t2


@wp.func
def mirror_point(x: Any, p: Any, n: Any):
    """`x` mirrored at the plane through `p` with unit normal `n` (Householder form, exact for any normal)."""
    s = wp.dot(x - p, n)
    return x - (s + s) * n


@wp.func
def specular_residual(p: Any, n: Any, eye: Any, target: Any):
    """Sine of the angle between half vector and normal; 0 at a reflection point, 1 from 90 degrees on.

    Args:
        p: Candidate point on the mirror. [scene units]
        n: Unit normal at `p`, on the reflecting side.
        eye: One end of the path. [scene units]
        target: The other end; exchanging the ends changes nothing.

    Returns:
        Residual in [0, 1]; within 1e-7 (float32) of 0 where the law of reflection holds.
    """
    w = safe_normalize(eye - p) + safe_normalize(target - p)
    w_n = wp.dot(w, n)
    w_t = w - w_n * n
    if not (w_n > n.dtype(0.0)):
        return n.dtype(1.0)
    tangential = wp.length(w_t)
    return tangential / wp.sqrt(tangential * tangential + w_n * w_n)


@wp.func
def refract(direction: Any, n: Any, ior: Any):
    """The direction behind an interface; the zero vector where the ray is totally reflected.

    Args:
        direction: Unit, towards the interface.
        n: Unit normal on the side that the ray comes from.
        ior: Index of refraction behind the interface over that before it.
    """
    across = (direction - wp.dot(direction, n) * n) / ior
    square = n.dtype(1.0) - wp.dot(across, across)
    if not (square > n.dtype(0.0)):
        return type(n)(n.dtype(0.0), n.dtype(0.0), n.dtype(0.0))
    return across - wp.sqrt(square) * n


@wp.func
def snell_residual(p: Any, n: Any, eye: Any, target: Any, ior: Any):
    """How far a path through an interface is off Snell's law: sin i - ior sin r, with the directions that sines have here.

    Args:
        p: Candidate point on the interface. [scene units]
        n: Unit normal at `p`, on the eye's side.
        eye: One end of the path. [scene units]
        target: The other end, behind the interface.
        ior: Index of refraction behind the interface over that before it.

    Returns:
        0 where the law holds; 1 where the ends are not on either side.
    """
    o = safe_normalize(eye - p)
    v = safe_normalize(target - p)
    if not (wp.dot(o, n) > n.dtype(0.0) and wp.dot(v, n) < n.dtype(0.0)):
        return n.dtype(1.0)
    w = o + ior * v
    return wp.length(w - wp.dot(w, n) * n)


@wp.func
def dielectric_reflectance(cosine: Any, ior: Any):
    """Fresnel's reflectance of unpolarised light at a dielectric; 1 where it is totally reflected.

    Source: Fresnel's equations; Born and Wolf, Principles of Optics, 7th edition, section 1.5.2, equations 21 and 35.

    Args:
        cosine: Of the angle of incidence.
        ior: Index of refraction behind the interface over that before it.
    """
    one = cosine.dtype(1.0)
    c = wp.clamp(wp.abs(cosine), cosine.dtype(0.0), one)
    square = one - (one - c * c) / (ior * ior)
    if not (square > cosine.dtype(0.0)):
        return one
    behind = ior * wp.sqrt(square)
    across = (c - behind) / (c + behind)
    # ior^2 cos i - ior cos r, over the sum.
    along = (ior * ior * c - behind) / (ior * ior * c + behind)
    return cosine.dtype(0.5) * (across * across + along * along)


@wp.func
def virtual_point(p: Any, n: Any, eye: Any, target: Any, curvature: Any):
    """The virtual point in the form that a tangential error of `p` moves less on the screen.

    Mirror form iff 2 c k a b / (a + b) < 1 with c the cosine of incidence, k the normal curvature in the
    plane of incidence, a and b the distances of eye and target: the first-order errors on screen of the
    two forms are e/a and 2 c k b e/(a + b).

    Args:
        p: Point on the mirror.
        n: Unit normal at `p`.
        eye: The eye.
        target: The point seen.
        curvature: Absolute normal curvature at `p`, at least in the plane of incidence. [1/scene units]
    """
    to_eye = eye - p
    to_target = target - p
    a = safe_length(to_eye)
    b = safe_length(to_target)
    c_a = wp.abs(wp.dot(to_eye, n))  # c * a
    if (c_a + c_a) * curvature * b < a + b:
        return mirror_point(target, p, n)
    return p + b * safe_normalize(p - eye)


@wp.func
def specular_newton_step(
    n: Any, t1: Any, t2: Any, s11: Any, s12: Any, s22: Any, o: Any, v: Any, inv_eye: Any, inv_target: Any
):
    """One Newton step on the tangent plane towards a reflection point of a convex mirror.

    The residual is w_T / w_N (w = o + v), whose root at grazing incidence is simple where that of the
    gradient w_T is nearly double; where its Jacobian is not safely positive the gradient's own step is taken.

    Args:
        n: Unit normal.
        t1: First unit tangent.
        t2: Second unit tangent.
        s11: Shape operator dN = S dP in the basis (t1, t2), positive for convex. [1/scene units]
        s12: Its mixed entry.
        s22: Its second diagonal entry.
        o: Unit direction to the eye.
        v: Unit direction to the target.
        inv_eye: 1 / distance to the eye. [1/scene units]
        inv_target: 1 / distance to the target.

    Returns:
        (step along t1, step along t2). [scene units]
    """
    one = n.dtype(1.0)
    zero = n.dtype(0.0)
    o1 = wp.dot(o, t1)
    o2 = wp.dot(o, t2)
    v1 = wp.dot(v, t1)
    v2 = wp.dot(v, t2)
    o_n = wp.dot(o, n)
    v_n = wp.dot(v, n)
    w_n = o_n + v_n
    g1 = o1 + v1
    g2 = o2 + v2
    bend = wp.max(w_n, zero)
    # 1 - o1^2 cancels at grazing; o2^2 + o_n^2 does not.
    h11 = (o2 * o2 + o_n * o_n) * inv_eye + (v2 * v2 + v_n * v_n) * inv_target + bend * s11
    h22 = (o1 * o1 + o_n * o_n) * inv_eye + (v1 * v1 + v_n * v_n) * inv_target + bend * s22
    h12 = bend * s12 - o1 * o2 * inv_eye - v1 * v2 * inv_target
    det_h = h11 * h22 - h12 * h12
    if w_n > n.dtype(MIN_HALF_NORMAL):
        q1 = s11 * g1 + s12 * g2 + o_n * o1 * inv_eye + v_n * v1 * inv_target
        q2 = s12 * g1 + s22 * g2 + o_n * o2 * inv_eye + v_n * v2 * inv_target
        inv_w = one / w_n
        j11 = h11 + g1 * q1 * inv_w
        j12 = h12 + g1 * q2 * inv_w
        j21 = h12 + g2 * q1 * inv_w
        j22 = h22 + g2 * q2 * inv_w
        det_j = j11 * j22 - j12 * j21
        if det_j > n.dtype(MIN_DET_SHARE) * det_h:
            return (j22 * g1 - j12 * g2) / det_j, (j11 * g2 - j21 * g1) / det_j
    if det_h > zero:
        return (h22 * g1 - h12 * g2) / det_h, (h11 * g2 - h12 * g1) / det_h
    return zero, zero
