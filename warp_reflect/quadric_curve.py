"""The Quadric Intersection Method on convex surfaces of revolution: a named alternative to compare with.

The reflection point lies on the mirror Q and on a second quadric S of eye and target (coplanarity with the
normal); the search runs along their curve of intersection for the shortest path.

Source: Lages Miguel, Nogueira and Goncalves, Real-Time 3D Visualization of Accurate Specular Reflections in
    Curved
Mirrors, GRAPP 2014, section 3, equations 2 and 3. At fixed z the square terms of S cancel and leave a line
in (x, y), which gives the curve in closed form. A minimum of the path length is flat: its place is known to
the square root of the rounding only (3e-4 of the size in float32), which is the method's own limit.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.quadrics import quadric_half_gradient

wp.set_module_options({"enable_backward": False})

LEVELS = 96  # heights at which the curve is looked for
LOOP_NODES = 64  # places on a loop of the curve at which the path length is compared
EDGE_STEPS = wp.constant(30)  # bisections for the ends of a loop
GOLDEN_STEPS = wp.constant(48)  # golden section from two cells of a loop to 1e-10 of them
GOLDEN = wp.constant(0.6180339887498949)
TURN = wp.constant(6.283185307179586)


@wp.func
def curve_point(z: Any, branch: Any, o: Any, v: Any, lam: Any, b: Any, c: Any):
    """Point of the curve at height z on one of its branches, and a measure that is < 0 where there is none."""
    zero = o.dtype(0.0)
    a = lam[2] / lam[0]
    b1 = b / lam[0]
    d = o - v
    m = wp.cross(o, v)
    w = (o.dtype(1.0) - a) * z - b1
    alpha = m[0] - d[1] * w
    beta = m[1] + d[0] * w
    gamma = -(a * z + b1) * m[2]
    rho2 = -(c / lam[0]) - (b1 + b1) * z - a * z * z
    n2 = alpha * alpha + beta * beta
    room = rho2 * n2 - gamma * gamma
    if not (n2 > zero):
        # The plane of incidence is horizontal: no line, the whole circle.
        return type(o)(zero, zero, z), o.dtype(-1.0)
    s = branch * wp.sqrt(wp.max(room, zero))
    return type(o)((gamma * alpha - s * beta) / n2, (gamma * beta + s * alpha) / n2, z), room


@wp.func
def path_on_loop(angle: Any, middle: Any, half: Any, o: Any, v: Any, lam: Any, b: Any, c: Any):
    """Point of a loop at an angle, and its path length; 1e30 with an end behind the tangent plane."""
    branch = wp.where(wp.sin(angle) < o.dtype(0.0), o.dtype(-1.0), o.dtype(1.0))
    r, _room = curve_point(middle + half * wp.cos(angle), branch, o, v, lam, b, c)
    n = quadric_half_gradient(r, lam, b)
    length = wp.length(o - r) + wp.length(v - r)
    if wp.dot(n, o - r) <= o.dtype(0.0) or wp.dot(n, v - r) <= o.dtype(0.0):
        length = o.dtype(1.0e30)
    return r, length


@wp.func
def qim_search(o: Any, v: Any, lam: Any, b: Any, c: Any, low: Any, high: Any):
    """The point of the curve with the shortest path, both ends before its tangent plane.

    Args:
        o: Eye, unit principal frame of a surface of revolution about z.
        v: Target.
        lam: Coefficients, those of x and y equal.
        b: Coefficient.
        c: Coefficient.
        low: Least height of the surface.
        high: Greatest height at which the point can be.

    Returns:
        (point, 1 if one was found, else 0).
    """
    zero = o.dtype(0.0)
    best = o * zero
    best_length = o.dtype(1.0e30)
    step = (high - low) / o.dtype(float(wp.static(LEVELS)))
    before = o.dtype(-1.0)
    start = low
    for k in range(wp.static(LEVELS + 1)):
        z = low + step * o.dtype(float(k))
        room = o.dtype(-1.0)
        if k < wp.static(LEVELS):
            _p, room = curve_point(z, o.dtype(1.0), o, v, lam, b, c)
        if room >= zero and before < zero:
            # The lower end of a loop.
            inside = z
            outside = wp.max(z - step, low)
            for _j in range(EDGE_STEPS):
                x = o.dtype(0.5) * (inside + outside)
                _p, there = curve_point(x, o.dtype(1.0), o, v, lam, b, c)
                if there >= zero:
                    inside = x
                else:
                    outside = x
            start = inside
        if room < zero and before >= zero:
            inside = z - step
            outside = z
            for _j in range(EDGE_STEPS):
                x = o.dtype(0.5) * (inside + outside)
                _p, there = curve_point(x, o.dtype(1.0), o, v, lam, b, c)
                if there >= zero:
                    inside = x
                else:
                    outside = x
            middle = o.dtype(0.5) * (start + inside)
            half = o.dtype(0.5) * (inside - start)
            cell = o.dtype(TURN) / o.dtype(float(wp.static(LOOP_NODES)))
            lowest = o.dtype(1.0e30)
            at = zero
            for j in range(wp.static(LOOP_NODES)):
                angle = cell * (o.dtype(float(j)) + o.dtype(0.5))
                _p, length = path_on_loop(angle, middle, half, o, v, lam, b, c)
                if length < lowest:
                    lowest = length
                    at = angle
            if lowest < best_length:
                left = at - cell
                right = at + cell
                ratio = o.dtype(GOLDEN)
                x = right - ratio * (right - left)
                y = left + ratio * (right - left)
                _p, fx = path_on_loop(x, middle, half, o, v, lam, b, c)
                _p, fy = path_on_loop(y, middle, half, o, v, lam, b, c)
                for _j in range(GOLDEN_STEPS):
                    if fx < fy:
                        right = y
                        y = x
                        fy = fx
                        x = right - ratio * (right - left)
                        _p, fx = path_on_loop(x, middle, half, o, v, lam, b, c)
                    else:
                        left = x
                        x = y
                        fx = fy
                        y = left + ratio * (right - left)
                        _p, fy = path_on_loop(y, middle, half, o, v, lam, b, c)
                p, length = path_on_loop(o.dtype(0.5) * (left + right), middle, half, o, v, lam, b, c)
                if length < best_length:
                    best_length = length
                    best = p
        before = room
    found = int(0)
    if best_length < o.dtype(1.0e30):
        found = int(1)
    return best, found
