"""Rays against triangles and the vectors of a facet: device functions that know no scene."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

# Squared lengths between this and its inverse keep all their digits; outside, vectors are scaled first.
SAFE_SQUARE = wp.constant(1.0e-24)


@wp.struct
class TriangleHit:
    """Where a ray meets the plane of a triangle.

    The point is w * v0 + u * v1 + v * v2 and origin + t * direction. The weights are not clipped: outside the
    triangle at least one is negative.
    """

    t: float  # in lengths of the direction; may be negative
    u: float
    v: float
    w: float
    det: float  # twice the projected area times |direction|; 0: edge-on or without area, nothing else is set
    hit: int  # 1: inside or on the border, on either side of the ray's origin


@wp.func
def max_abs(v: wp.vec3) -> float:
    """Largest magnitude of a vector's components."""
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def unit(v: wp.vec3) -> wp.vec3:
    """The vector at length 1 at any scale of its components (1e-38 to 1e38); zero stays zero.

    `wp.normalize` squares first and returns 0 for 1e-23 and for 1e20.
    """
    square = wp.dot(v, v)
    if square > SAFE_SQUARE and square < 1.0 / SAFE_SQUARE:
        return v * (1.0 / wp.sqrt(square))
    m = max_abs(v)
    if m == 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    s = v / m
    return s / wp.sqrt(wp.dot(s, s))


@wp.func
def facet_normal(v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> wp.vec3:
    """Unit normal of a counter-clockwise triangle at any scale; zero if it has no area."""
    e1 = v1 - v0
    e2 = v2 - v0
    n = wp.cross(e1, e2)
    square = wp.dot(n, n)
    if square > SAFE_SQUARE and square < 1.0 / SAFE_SQUARE:
        return n * (1.0 / wp.sqrt(square))
    m = wp.max(max_abs(e1), max_abs(e2))
    if m == 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return unit(wp.cross(e1 / m, e2 / m))


@wp.func
def intersect_triangle(origin: wp.vec3, direction: wp.vec3, v0: wp.vec3, v1: wp.vec3, v2: wp.vec3) -> TriangleHit:
    """Intersect a line with a triangle; two triangles that share an edge never both miss a line through it.

    The edge functions are Pluecker products built from the difference and the sum of an edge's ends. Swapping
    the ends negates every rounded term, with or without fused multiply-add, so both neighbours see exactly
    opposite signs.

    All vectors in one frame; the direction needs no unit length.

    Source: Embree, kernels/geometry/triangle_intersector_pluecker.h. Differs from it by: t interpolated from
    the corners' distances along the ray instead of divided by the normal's projection (no second
    cancellation).
    """
    a = v0 - origin
    b = v1 - origin
    c = v2 - origin
    eu = wp.dot(wp.cross(c - a, c + a), direction)
    ev = wp.dot(wp.cross(a - b, a + b), direction)
    ew = wp.dot(wp.cross(b - c, b + c), direction)
    result = TriangleHit()
    det = eu + ev + ew
    result.det = det
    if det != 0.0:
        inv = 1.0 / det
        u = eu * inv
        v = ev * inv
        w = ew * inv
        along = w * wp.dot(a, direction) + u * wp.dot(b, direction) + v * wp.dot(c, direction)
        result.t = along / wp.dot(direction, direction)
        result.u = u
        result.v = v
        result.w = w
        if wp.min(wp.min(eu, ev), ew) >= 0.0 or wp.max(wp.max(eu, ev), ew) <= 0.0:
            result.hit = 1
    return result


@wp.func
def clamp_weights(u: float, v: float) -> wp.vec2:
    """The weights (u, v) of the second and third corner moved into the triangle."""
    cu = wp.max(u, 0.0)
    cv = wp.max(v, 0.0)
    total = cu + cv
    if total > 1.0:
        cu = cu / total
        cv = cv / total
    return wp.vec2(cu, cv)
