"""Quadric surfaces: classification on the host, device math in the unit principal frame.

In the unit principal frame (centre or vertex at 0, size 1, axes along x, y, z) every quadric reads

    q(x) = lam_x x^2 + lam_y y^2 + lam_z z^2 + 2 b z + c,

negative inside the body; the half gradient n = (lam_x x, lam_y y, lam_z z + b) points to the reflecting side.
`lam` is a vector, `b` and `c` are scalars of its float type; `Any` stands for float32 or float64 types.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import warp as wp

from warp_reflect.optics import specular_newton_step, tangent_basis

wp.set_module_options({"enable_backward": False})


class QuadricKind(IntEnum):
    """The real quadrics that have a surface to reflect at."""

    ELLIPSOID = 0
    ELLIPTIC_CYLINDER = 1
    ELLIPTIC_PARABOLOID = 2
    PARABOLIC_CYLINDER = 3
    TWO_SHEETS = 4
    HYPERBOLIC_CYLINDER = 5
    CONE = 6
    ONE_SHEET = 7
    HYPERBOLIC_PARABOLOID = 8


class Family(IntEnum):
    """How a point is put back on the surface, and how its foot point is found (convex bodies only)."""

    RADIAL = 0  # lam >= 0, b = 0: scaled towards the centre or axis
    BOWL = 1  # lam_z = 0, b < 0: moved along z onto the graph of a parabola
    SHEET = 2  # lam_z < 0, c >= 0, z > 0: moved along z onto the graph of a hyperbola or cone
    GENERAL = 3  # not convex: no foot points


FAMILY = {
    QuadricKind.ELLIPSOID: Family.RADIAL,
    QuadricKind.ELLIPTIC_CYLINDER: Family.RADIAL,
    QuadricKind.ELLIPTIC_PARABOLOID: Family.BOWL,
    QuadricKind.PARABOLIC_CYLINDER: Family.BOWL,
    QuadricKind.TWO_SHEETS: Family.SHEET,
    QuadricKind.HYPERBOLIC_CYLINDER: Family.SHEET,
    QuadricKind.CONE: Family.SHEET,
    QuadricKind.ONE_SHEET: Family.GENERAL,
    QuadricKind.HYPERBOLIC_PARABOLOID: Family.GENERAL,
}

MAX_ROOTS = 10  # of the elimination that finds reflection points, for three different principal values: its degree
RANK_TOLERANCE = {
    np.dtype(np.float64): 1e-13,
    np.dtype(np.float32): 4e-7,
}  # of the largest term: a few roundings
EQUAL_TOLERANCE = 1e-12  # principal values this close are one value: a surface of revolution


@dataclass(frozen=True)
class CanonicalQuadric:
    """A quadric in its unit principal frame, and the way there.

    Attributes:
        kind: What it is.
        inner: The sign was reversed: the reflecting side is the inside of the body of that kind.
        lam, b, c: Coefficients of the body of that kind (before the reversal); float64 [3], scalars.
        equal: 1: the principal values differ; 2: those of x and y agree; 3: a sphere.
        origin: Centre or vertex, world, float64 [3]. [scene units]
        axes: Columns are the unit principal directions in world, right-handed, float64 [3, 3].
        size: World length of the unit. [scene units]
    """

    kind: QuadricKind
    inner: bool
    lam: np.ndarray
    b: float
    c: float
    equal: int
    origin: np.ndarray
    axes: np.ndarray
    size: float

    @property
    def convex(self) -> bool:
        """The reflecting side is the outside of a convex body, or of two."""
        return not self.inner and FAMILY[self.kind] != Family.GENERAL

    def distances(self, points: np.ndarray) -> np.ndarray:
        """First-order distances from the surface of points near it, float64 [n], in scene units.

        Args:
            points: World, [n, 3].
        """
        x = (points - self.origin) @ self.axes / self.size
        slope = np.linalg.norm(x * self.lam + [0.0, 0.0, self.b], axis=1)
        value = np.abs((x * x) @ self.lam + 2.0 * self.b * x[:, 2] + self.c)
        return self.size * value / (slope + np.sqrt(slope * slope + value))


def canonical_quadric(
    a: np.ndarray, b: np.ndarray, c: float, offset: np.ndarray, name: str, rank_tolerance: float
) -> CanonicalQuadric:
    """Classify y^T a y + 2 b^T y + c = 0, y = x_world - offset, and find its unit principal frame.

    Args:
        a: Symmetric, float64 [3, 3]. [1/scene units^2, up to a common factor]
        b: float64 [3].
        c: Constant.
        offset: Origin of y in the world, float64 [3].
        name: What the caller's argument is called, for messages.
        rank_tolerance: Principal values below this share of the largest are taken as 0.

    Raises:
        ValueError: the coefficients are not finite, or describe no curved real surface.
    """
    if not (np.isfinite(a).all() and np.isfinite(b).all() and np.isfinite(c) and np.isfinite(offset).all()):
        raise ValueError(f"{name}: expected finite numbers, got {a.tolist()}, {b.tolist()}, {c}")
    largest = np.abs(a).max()
    if largest == 0.0:
        raise ValueError(f"{name}: has no quadratic terms, it is a plane or nothing; use PlanarMirror")
    a, b, c = a / largest, b / largest, c / largest
    lam, axes = np.linalg.eigh(0.5 * (a + a.T))
    top = np.abs(lam).max()
    lam = np.where(np.abs(lam) <= rank_tolerance * top, 0.0, lam)
    linear = axes.T @ b
    curved = lam != 0.0
    centre = np.where(curved, -linear / np.where(curved, lam, 1.0), 0.0)
    terms = np.where(curved, linear * centre, 0.0)
    rest = c + terms.sum()
    if abs(rest) <= rank_tolerance * (abs(c) + np.abs(terms).sum()):
        rest = 0.0
    slope = np.where(curved, 0.0, linear)
    slope_length = np.linalg.norm(slope)
    if slope_length <= rank_tolerance * np.linalg.norm(linear):
        slope_length = 0.0
    plus, minus = int((lam > 0).sum()), int((lam < 0).sum())
    kind, inner = _kind(plus, minus, rest, slope_length > 0.0, name)
    if inner:
        lam, rest, slope = -lam, -rest, -slope
    order = _axis_order(kind, lam)
    lam, axes, centre = lam[order], axes[:, order], centre[order]
    slope = slope[order]
    if slope_length > 0.0:
        # The free axes are turned so that z runs along -slope: the body lies at z > 0.
        free = np.flatnonzero(lam == 0.0)
        z_axis = -(axes[:, free] @ slope[free]) / slope_length
        if len(free) == 2:
            axes = np.stack([axes[:, 0], np.cross(z_axis, axes[:, 0]), z_axis], axis=1)
            centre = np.array([centre[0], 0.0, 0.0])
        else:
            axes = np.stack([axes[:, 0], axes[:, 1], z_axis], axis=1)
        centre[2] = rest / (2.0 * slope_length)
        lam, b_z, rest = lam / (2.0 * slope_length), -0.5, 0.0
        size = 0.5 / np.abs(lam[lam != 0.0]).min()
        lam = lam * size
    elif rest != 0.0:
        lam = lam / abs(rest)
        size = 1.0 / np.sqrt(np.abs(lam[lam != 0.0]).min())
        lam, b_z, rest = lam * size**2, 0.0, float(np.sign(rest))
    else:
        lam, size, b_z = lam / abs(lam[2]), 1.0, 0.0
    origin = offset + axes @ centre
    if np.linalg.det(axes) < 0.0:
        axes = axes * np.array([-1.0, 1.0, 1.0])
    equal = 1
    if lam[0] != 0.0 and abs(lam[0] - lam[1]) <= EQUAL_TOLERANCE * abs(lam[0]):
        equal = 2
        lam[:2] = lam[:2].mean()
        if abs(lam[0] - lam[2]) <= EQUAL_TOLERANCE * abs(lam[0]):
            equal = 3
            lam[:] = lam.mean()
    return CanonicalQuadric(kind, inner, lam, float(b_z), float(rest), equal, origin, axes, float(size))


def _kind(plus: int, minus: int, rest: float, sloped: bool, name: str) -> tuple[QuadricKind, bool]:
    """Kind and whether the sign is reversed, from the signature of the quadratic part."""
    inner = minus > plus
    if inner:
        plus, minus, rest = minus, plus, -rest
    if plus + minus == 3:
        if minus == 0:
            if rest < 0.0:
                return QuadricKind.ELLIPSOID, inner
            raise ValueError(
                f"{name}: {'a single point' if rest == 0.0 else 'an imaginary ellipsoid (no real points)'}; "
                "an ellipsoid is negative inside and positive outside"
            )
        if rest == 0.0:
            return QuadricKind.CONE, inner
        return (QuadricKind.ONE_SHEET if rest < 0.0 else QuadricKind.TWO_SHEETS), inner
    if plus + minus == 2:
        if sloped:
            return (QuadricKind.HYPERBOLIC_PARABOLOID if minus else QuadricKind.ELLIPTIC_PARABOLOID), inner
        if minus:
            if rest == 0.0:
                raise ValueError(f"{name}: a pair of crossing planes; use two PlanarMirrors")
            return QuadricKind.HYPERBOLIC_CYLINDER, rest < 0.0
        if rest < 0.0:
            return QuadricKind.ELLIPTIC_CYLINDER, inner
        raise ValueError(
            f"{name}: {'a line' if rest == 0.0 else 'an imaginary cylinder (no real points)'}; "
            "a cylinder is negative inside and positive outside"
        )
    if sloped:
        return QuadricKind.PARABOLIC_CYLINDER, inner
    raise ValueError(f"{name}: a pair of parallel, equal or imaginary planes; use PlanarMirror")


def _axis_order(kind: QuadricKind, lam: np.ndarray) -> list[int]:
    """Principal axes so that z is the odd one out: the null, the negative or the unequal one."""
    if kind == QuadricKind.HYPERBOLIC_CYLINDER:
        return [int(np.argmax(lam)), int(np.argmin(np.abs(lam))), int(np.argmin(lam))]
    if kind == QuadricKind.HYPERBOLIC_PARABOLOID:
        return [int(np.argmax(lam)), int(np.argmin(lam)), int(np.argmin(np.abs(lam)))]
    if kind in (QuadricKind.ELLIPTIC_CYLINDER, QuadricKind.ELLIPTIC_PARABOLOID):
        z = int(np.argmin(np.abs(lam)))
    elif kind == QuadricKind.PARABOLIC_CYLINDER:
        x = int(np.argmax(np.abs(lam)))
        return [x, *[i for i in range(3) if i != x]]
    elif kind == QuadricKind.ELLIPSOID:
        ranked = np.argsort(lam)
        gaps = lam[ranked[1]] - lam[ranked[0]], lam[ranked[2]] - lam[ranked[1]]
        z = int(ranked[2] if gaps[0] <= gaps[1] else ranked[0])
    else:
        z = int(np.argmin(lam))
    return [*[i for i in range(3) if i != z], z]


# --------------------------------------------------------------------------------------------------
# Device: value, normal, rays


@wp.func
def quadric_value(x: Any, lam: Any, b: Any, c: Any):
    """q(x); negative inside the body."""
    return lam[0] * x[0] * x[0] + lam[1] * x[1] * x[1] + lam[2] * x[2] * x[2] + (b + b) * x[2] + c


@wp.func
def quadric_half_gradient(x: Any, lam: Any, b: Any):
    """Half the gradient of q: along the outward normal."""
    return type(x)(lam[0] * x[0], lam[1] * x[1], lam[2] * x[2] + b)


@wp.func
def quadric_curve(u: Any, v: Any, lam: Any):
    """The bilinear form u^T diag(lam) v."""
    return lam[0] * u[0] * v[0] + lam[1] * u[1] * v[1] + lam[2] * u[2] * v[2]


@wp.func
def intersect_quadric(origin: Any, direction: Any, lam: Any, b: Any, c: Any):
    """Where the line origin + s direction meets the quadric.

    Evaluated at the line's point nearest to the frame's origin, where the terms of q are small: from the
    ray's own origin the discriminant of a far ray is lost (a unit sphere seen from 1e5 in float32 misses by
    its radius).

    Returns:
        (count 0, 1 or 2, first s, second s), ascending; a double root counts as 2.
    """
    zero = origin.dtype(0.0)
    shift = -wp.dot(origin, direction) / wp.dot(direction, direction)
    p = origin + shift * direction
    aa = quadric_curve(direction, direction, lam)
    hb = quadric_curve(direction, p, lam) + b * direction[2]
    cc = quadric_value(p, lam, b, c)
    terms = wp.abs(lam[0]) * direction[0] * direction[0] + wp.abs(lam[1]) * direction[1] * direction[1]
    terms = terms + wp.abs(lam[2]) * direction[2] * direction[2]
    if wp.abs(aa) <= origin.dtype(4.0) * unit_roundoff(terms) * terms:
        # An asymptotic direction: the second root is at infinity.
        if hb == zero:
            return 0, zero, zero
        s = shift - origin.dtype(0.5) * cc / hb
        return 1, s, s
    disc = hb * hb - aa * cc
    if disc < zero:
        return 0, zero, zero
    # The q form: no difference of nearly equal numbers for the root near p.
    k = -hb - wp.where(hb < zero, -wp.sqrt(disc), wp.sqrt(disc))
    s1 = k / aa
    s2 = s1
    if k != zero:
        s2 = cc / k
    return 2, shift + wp.min(s1, s2), shift + wp.max(s1, s2)


@wp.func
def unit_roundoff(x: wp.float32):
    """2^-24."""
    return wp.float32(5.9604645e-8)


@wp.func
def unit_roundoff(x: wp.float64):
    """2^-53."""
    return wp.float64(1.1102230246251565e-16)


# --------------------------------------------------------------------------------------------------
# Device: convex bodies. Source of the foot-point method: the bisector of the angle at the reflection point
# R meets the segment from eye O to target V at W = t O + (1 - t) V, t = |V-R| / (|O-R| + |V-R|); so R is
# the point of the body nearest to W, and t the one root of g(t) = t - |V-F(t)| / (|O-F(t)| + |V-F(t)|), F
# the nearest-point map.

FAR_FEET = wp.constant(60)  # Newton steps of one nearest-point search; the monotone iteration needs 3 to 12
OUTER_STEPS = wp.constant(60)  # bracketed steps for t: bisection alone would settle float64


@wp.func
def foot_radial(w: Any, lam: Any, mu_start: Any, steps: int):
    """Nearest point of sum lam x^2 = 1 to an outside point, and its multiplier mu (w = x + mu diag(lam) x).

    Source: More and Sorensen, Computing a Trust Region Step, SIAM J. Sci. Stat. Comput. 1983: Newton on the
        inverse
    root of the secular function, monotone from the left.
    """
    one = w.dtype(1.0)
    mu = mu_start
    r = w
    for _k in range(steps):
        m0 = one / (one + mu * lam[0])
        m1 = one / (one + mu * lam[1])
        m2 = one / (one + mu * lam[2])
        r = type(w)(w[0] * m0, w[1] * m1, w[2] * m2)
        p0 = lam[0] * r[0] * r[0]
        p1 = lam[1] * r[1] * r[1]
        p2 = lam[2] * r[2] * r[2]
        n2 = p0 + p1 + p2
        slope = p0 * lam[0] * m0 + p1 * lam[1] * m1 + p2 * lam[2] * m2
        excess = wp.sqrt(n2) - one
        mu = wp.max(mu + excess * n2 / slope, w.dtype(0.0))
        if wp.abs(excess) < w.dtype(32.0) * unit_roundoff(excess):
            break
    m0 = one / (one + mu * lam[0])
    m1 = one / (one + mu * lam[1])
    m2 = one / (one + mu * lam[2])
    return type(w)(w[0] * m0, w[1] * m1, w[2] * m2), mu


@wp.func
def foot_bowl(w: Any, lam: Any, b: Any, c: Any, steps: int):
    """Nearest point of lam_x x^2 + lam_y y^2 + 2 b z + c = 0 (lam >= 0, b < 0) to an outside point.

    Newton on N^(-1/2) - E^(-1/2), N = sum lam_i w_i^2 / (1 + mu lam_i)^2, E = -(2 b (w_z - mu b) + c):
    increasing and concave, hence monotone from the left; kept inside a bracket against rounding.
    """
    zero = w.dtype(0.0)
    one = w.dtype(1.0)
    half = w.dtype(0.5)
    e0 = -(b + b) * w[2] - c
    e1 = w.dtype(2.0) * b * b
    pole = wp.max(-e0 / e1, zero)
    n_at_zero = lam[0] * w[0] * w[0] + lam[1] * w[1] * w[1]
    low = pole
    high = pole + n_at_zero / e1 + w.dtype(1.0e-30)
    mu = zero
    if pole > zero:
        m0 = one / (one + pole * lam[0])
        m1 = one / (one + pole * lam[1])
        n_at_pole = lam[0] * w[0] * w[0] * m0 * m0 + lam[1] * w[1] * w[1] * m1 * m1
        mu = pole + w.dtype(0.1) * wp.min(n_at_pole, one) / e1
    for _k in range(steps):
        m0 = one / (one + mu * lam[0])
        m1 = one / (one + mu * lam[1])
        p0 = lam[0] * w[0] * w[0] * m0 * m0
        p1 = lam[1] * w[1] * w[1] * m1 * m1
        n = p0 + p1
        e = e0 + e1 * mu
        if not (n > zero) or not (e > zero):
            mu = low
            break
        inv_n = one / wp.sqrt(n)
        inv_e = one / wp.sqrt(e)
        h = inv_n - inv_e
        if h < zero:
            low = mu
        else:
            high = mu
        slope = (p0 * lam[0] * m0 + p1 * lam[1] * m1) * inv_n * inv_n * inv_n + half * e1 * inv_e * inv_e * inv_e
        step = -h / slope
        if not (mu + step > low) or not (mu + step < high):
            step = half * (low + high) - mu
        mu = mu + step
        if wp.abs(step) <= w.dtype(8.0) * unit_roundoff(mu) * (one + mu):
            break
    r0 = w[0] / (one + mu * lam[0])
    r1 = w[1] / (one + mu * lam[1])
    return type(w)(r0, r1, -(lam[0] * r0 * r0 + lam[1] * r1 * r1 + c) / (b + b))


@wp.func
def foot_sheet(w: Any, lam: Any, c: Any, steps: int):
    """Nearest point with z > 0 of sum lam_i x_i^2 + c = 0 (lam_z < 0, c >= 0) to an outside point.

    Newton on G^(-1/2) in the height z of the foot, G = sum lam_i w_i^2 / (z (1 + k_i) - k_i w_z)^2 + c /
    z^2 with k_i = lam_i / |lam_z|: increasing and concave, monotone from the left. The usual multiplier has
    a pole for points beyond the centre plane (a camera at the other focus), the height has none. A cone's
    apex: z = 0.
    """
    zero = w.dtype(0.0)
    one = w.dtype(1.0)
    top = -lam[2]
    k0 = lam[0] / top
    k1 = lam[1] / top
    across = lam[0] * w[0] * w[0] + lam[1] * w[1] * w[1]
    target = one / wp.sqrt(top)
    low = wp.max(wp.max(w[2], zero), wp.sqrt(c / top))
    tiny = w.dtype(1.0e-9) * wp.sqrt(across / top)
    z = wp.max(low, tiny)
    if not (z > zero):
        return type(w)(zero, zero, zero)
    high = low + wp.sqrt((across + c) / top) + wp.abs(w[2]) + tiny
    for _k in range(steps):
        l0 = one / (z * (one + k0) - k0 * w[2])
        l1 = one / (z * (one + k1) - k1 * w[2])
        p0 = lam[0] * w[0] * w[0] * l0 * l0
        p1 = lam[1] * w[1] * w[1] * l1 * l1
        pz = c / (z * z)
        g = p0 + p1 + pz
        if not (g > zero):
            z = low
            break
        inv_g = one / wp.sqrt(g)
        h = inv_g - target
        if h < zero:
            low = z
        else:
            high = z
        slope = (p0 * l0 * (one + k0) + p1 * l1 * (one + k1) + pz / z) * inv_g * inv_g * inv_g
        step = -h / slope
        if not (z + step > low) or not (z + step < high):
            step = w.dtype(0.5) * (low + high) - z
        z = z + step
        if wp.abs(step) <= w.dtype(8.0) * unit_roundoff(z) * z:
            break
    r0 = w[0] * z / (z * (one + k0) - k0 * w[2])
    r1 = w[1] * z / (z * (one + k1) - k1 * w[2])
    return type(w)(r0, r1, wp.sqrt((lam[0] * r0 * r0 + lam[1] * r1 * r1 + c) / top))


@wp.func
def put_on_surface(p: Any, lam: Any, b: Any, c: Any, family: int):
    """A point of the surface near `p`: by scaling (RADIAL), along z (BOWL, SHEET)."""
    zero = p.dtype(0.0)
    if family == 0:
        s = p.dtype(1.0) / wp.sqrt(quadric_curve(p, p, lam))
        return type(p)(
            wp.where(lam[0] > zero, p[0] * s, p[0]),
            wp.where(lam[1] > zero, p[1] * s, p[1]),
            wp.where(lam[2] > zero, p[2] * s, p[2]),
        )
    across = lam[0] * p[0] * p[0] + lam[1] * p[1] * p[1] + c
    if family == 1:
        return type(p)(p[0], p[1], -across / (b + b))
    return type(p)(p[0], p[1], wp.sqrt(across / -lam[2]))


@wp.func
def nearest_on_surface(w: Any, lam: Any, b: Any, c: Any, family: int, steps: int):
    """The point of a convex body nearest to an outside point `w`."""
    if family == 0:
        r, _mu = foot_radial(w, lam, w.dtype(0.0), steps)
        return put_on_surface(r, lam, b, c, 0)
    if family == 1:
        return foot_bowl(w, lam, b, c, steps)
    return foot_sheet(w, lam, c, steps)


@wp.func
def surface_distance(x: Any, lam: Any, b: Any, c: Any, family: int):
    """Rough distance of an outside point from the surface, for a first guess of t only."""
    q = quadric_value(x, lam, b, c)
    if family == 0:
        return q / (wp.sqrt(q + x.dtype(1.0)) + x.dtype(1.0))
    if family == 2 and x[2] < x.dtype(0.0):
        # Below the centre q belongs to the other part.
        return wp.length(x)
    n = quadric_half_gradient(x, lam, b)
    return q / (wp.length(n) + wp.sqrt(wp.dot(n, n) + q))


@wp.func
def first_guess(o: Any, v: Any, lam: Any, b: Any, c: Any, family: int, steps: int):
    """A surface point near the reflection point: the foot of the point that a flat mirror would give."""
    tiny = o.dtype(1.0e-3)
    a_o = wp.max(surface_distance(o, lam, b, c, family), tiny)
    a_v = wp.max(surface_distance(v, lam, b, c, family), tiny)
    t = a_v / (a_o + a_v)
    return nearest_on_surface(t * o + (o.dtype(1.0) - t) * v, lam, b, c, family, steps)


@wp.func
def newton_on_convex(start: Any, eye: Any, target: Any, lam: Any, b: Any, c: Any, family: int, steps: int, tol: Any):
    """Newton's method on the tangent plane, from a surface point, with the angle as merit.

    Args:
        start: Surface point.
        eye: Outside point.
        target: Outside point, not behind the body.
        lam: Coefficients.
        b: Coefficient.
        c: Coefficient.
        family: `Family`.
        steps: Bound on evaluations.
        tol: Angle at which to stop. [radians]

    Returns:
        (surface point, its angle error; 2 where the half vector points inwards).
    """
    zero = start.dtype(0.0)
    one = start.dtype(1.0)
    best = start
    best_angle = start.dtype(4.0)
    d = start * zero
    p = start
    for _k in range(steps):
        n = quadric_half_gradient(p, lam, b)
        n_length = wp.length(n)
        n = n / n_length
        o = eye - p
        v = target - p
        inv_o = one / wp.length(o)
        inv_v = one / wp.length(v)
        o = o * inv_o
        v = v * inv_v
        w = o + v
        w_n = wp.dot(w, n)
        tangential = wp.length(w - w_n * n)
        # A stand-in for the angle that grows with it over [0, pi] and equals it near 0.
        angle = tangential / (tangential + wp.abs(w_n))
        if w_n <= zero:
            angle = start.dtype(2.0) - angle
        if angle < best_angle:
            best = p
            best_angle = angle
            if angle <= tol:
                break
            t1, t2 = tangent_basis(n)
            inv_n = one / n_length
            s11 = quadric_curve(t1, t1, lam) * inv_n
            s12 = quadric_curve(t1, t2, lam) * inv_n
            s22 = quadric_curve(t2, t2, lam) * inv_n
            d1, d2 = specular_newton_step(n, t1, t2, s11, s12, s22, o, v, inv_o, inv_v)
            d = d1 * t1 + d2 * t2
            # A step over more than this share of the body leaves the region where the tangent plane says
            # anything.
            long = quadric_curve(d, d, lam)
            reach = start.dtype(0.5)
            if family != 0:
                long = wp.abs(long) + lam[2] * lam[2] * d[2] * d[2]
                reach = reach * (one + wp.abs(p[2]))
            if long > reach:
                d = d * wp.sqrt(reach / long)
        else:
            if best_angle <= start.dtype(64.0) * tol:
                break
            d = d * start.dtype(0.4)
        p = put_on_surface(best + d, lam, b, c, family)
    return best, best_angle


@wp.func
def bracket_on_convex(eye: Any, target: Any, lam: Any, b: Any, c: Any, family: int):
    """The reflection point on a convex body by the bracketed search for t: slow, and always converges."""
    zero = eye.dtype(0.0)
    one = eye.dtype(1.0)
    o = eye
    v = target
    # With the farther end as o, t <= 1/2: 1 - t keeps its digits.
    if surface_distance(o, lam, b, c, family) < surface_distance(v, lam, b, c, family):
        o = target
        v = eye
    d = o - v
    a_o = wp.max(surface_distance(o, lam, b, c, family), eye.dtype(1.0e-12))
    a_v = wp.max(surface_distance(v, lam, b, c, family), eye.dtype(1.0e-12))
    t = a_v / (a_o + a_v)
    low = zero
    high = one
    r = eye
    for _k in range(OUTER_STEPS):
        w = v + t * d
        r = nearest_on_surface(w, lam, b, c, family, FAR_FEET)
        to_o = o - r
        to_v = v - r
        l_o = wp.length(to_o)
        l_v = wp.length(to_v)
        total = l_o + l_v
        share = l_v / total
        g = t - share
        if wp.abs(g) <= eye.dtype(8.0) * unit_roundoff(g) * wp.min(share, one - share):
            break
        if g > zero:
            high = t
        else:
            low = t
        n = quadric_half_gradient(r, lam, b)
        n_length = wp.length(n)
        slope = one
        if n_length > zero:
            # dF/dt = (I + delta S)^-1 of the tangential part of d, delta the distance of w from the surface.
            n = n / n_length
            t1, t2 = tangent_basis(n)
            k = wp.length(w - r) / n_length
            m11 = one + k * quadric_curve(t1, t1, lam)
            m12 = k * quadric_curve(t1, t2, lam)
            m22 = one + k * quadric_curve(t2, t2, lam)
            det = m11 * m22 - m12 * m12
            d1 = wp.dot(d, t1)
            d2 = wp.dot(d, t2)
            move = ((m22 * d1 - m12 * d2) / det) * t1 + ((m11 * d2 - m12 * d1) / det) * t2
            slope = one + ((one - t) * wp.dot(to_v, move) / l_v - t * wp.dot(to_o, move) / l_o) / total
        t_next = t - g / slope
        if not (t_next > low) or not (t_next < high):
            t_next = eye.dtype(0.5) * (low + high)
        if t_next == t:
            break
        t = t_next
    return r
