"""Independent truth for the tests: NumPy, SciPy and mpmath in float64 or more; nothing of the package.

A surface is a symmetric 4x4 matrix Q: x~^T Q x~ = 0, negative inside; the outward normal is along (Q x~)_xyz.
"""

from __future__ import annotations

from dataclasses import dataclass

import mpmath
import numpy as np
from scipy.optimize import fsolve

# Unit-frame surfaces x~^T Q x~ = 0 that a test places in the world: diagonal, half linear term in z, constant.
SURFACES = {
    "sphere": ((1, 1, 1), 0, -1),
    "ellipsoid 3:1:1": ((1, 9, 9), 0, -1),
    "ellipsoid 5:5:1": ((1, 1, 25), 0, -1),
    "ellipsoid 100:1:1": ((1, 1e4, 1e4), 0, -1),
    "ellipsoid 100:100:1": ((1, 1, 1e4), 0, -1),
    "ellipsoid 100:10:1": ((1, 100, 1e4), 0, -1),
    "elliptic cylinder": ((1, 4, 0), 0, -1),
    "paraboloid": ((0.5, 0.5, 0), -0.5, 0),
    "elliptic paraboloid": ((0.5, 2.0, 0), -0.5, 0),
    "parabolic cylinder": ((0.5, 0, 0), -0.5, 0),
    "two sheets": ((1, 1, -1), 0, 1),
    "elliptic two sheets": ((1, 4, -2), 0, 1),
    "hyperbolic cylinder": ((1, 0, -2), 0, 1),
    "cone": ((1, 1, -1), 0, 0),
    "one sheet": ((1, 2, -1), 0, -1),
    "hyperbolic paraboloid": ((0.5, -0.7, 0), -0.5, 0),
}
CONVEX = [name for name in SURFACES if name not in ("one sheet", "hyperbolic paraboloid")]


def matrix_of(name: str) -> np.ndarray:
    """Q of a unit-frame surface, float64 [4, 4]."""
    diagonal, b, c = SURFACES[name]
    q = np.diag([*map(float, diagonal), float(c)])
    q[2, 3] = q[3, 2] = b
    return q


def placed(q: np.ndarray, world_from_object: np.ndarray) -> np.ndarray:
    """Q in world space."""
    back = np.linalg.inv(world_from_object)
    return back.T @ q @ back


def random_pose(rng: np.random.Generator, size: float = 1.0, offset: float = 0.0) -> np.ndarray:
    """A rotation, a uniform scale and a translation, float64 [4, 4]."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn * size
    pose[:3, 3] = rng.normal(size=3) * offset * size
    return pose


def move(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points through a pose, [..., 3]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def surface_points(name: str, rng: np.random.Generator, count: int) -> np.ndarray:
    """Random points of a unit-frame surface, z > 0 on two-sheeted ones, [count, 3]."""
    (lx, ly, lz), b, c = SURFACES[name]
    x = rng.normal(size=(count, 3)) * 1.5
    if b != 0:
        x[:, 2] = -(lx * x[:, 0] ** 2 + ly * x[:, 1] ** 2 + c) / (2 * b)
    elif lz < 0 and c >= 0:
        x[:, 2] = np.sqrt((lx * x[:, 0] ** 2 + ly * x[:, 1] ** 2 + c) / -lz)
    elif lz < 0:
        radius = np.sqrt(-lz * x[:, 2] ** 2 - c)
        angle = rng.uniform(0, 2 * np.pi, count)
        x[:, 0], x[:, 1] = radius * np.cos(angle) / np.sqrt(lx), radius * np.sin(angle) / np.sqrt(ly)
    else:
        lam = np.array([lx, ly, lz], float)
        curved = lam > 0
        x[:, curved] /= np.linalg.norm(x[:, curved], axis=1)[:, None] * np.sqrt(lam[curved])
    return x


@dataclass
class Truth:
    """One eye and points whose reflection points are known because they were chosen first."""

    eye: np.ndarray  # [3]
    points: np.ndarray  # [n, 3]
    reflection: np.ndarray  # [n, 3]
    normal: np.ndarray  # [n, 3], on the side that was asked for
    cosine: np.ndarray  # [n], of incidence


def constructed(
    name: str,
    rng: np.random.Generator,
    count: int,
    eye_distance: float,
    max_degrees: float = 80.0,
    near: float = 0.1,
    far: float = 1000.0,
    side: float = 1.0,
) -> Truth:
    """Choose a point of the surface, an eye before it, then for many R that the eye sees the reflected point.

    Args:
        name: A key of SURFACES; everything is in its unit frame.
        rng: Source of randomness.
        count: Points asked for; fewer come back where the eye sees little.
        eye_distance: From the surface point under the eye.
        max_degrees: Greatest incidence.
        near: Least distance R to point; log-uniform up to far.
        far: Greatest.
        side: 1 the outside reflects, -1 the inside.
    """
    q = matrix_of(name)
    for _ in range(1000):
        foot = surface_points(name, rng, 1)
        up = _normals(q, foot, side)[0]
        tilt = np.radians(rng.uniform(0, 60))
        aside = np.cross(up, rng.normal(size=3))
        direction = np.cos(tilt) * up + np.sin(tilt) * aside / np.linalg.norm(aside)
        eye = foot[0] + eye_distance * direction
        if side * _value(q, eye[None])[0] > 0:
            break
    r = surface_points(name, rng, 40 * count)
    n = _normals(q, r, side)
    to_eye = eye - r
    d = np.linalg.norm(to_eye, axis=1)
    o = to_eye / d[:, None]
    cosine = (o * n).sum(1)
    seen = np.flatnonzero(cosine > np.cos(np.radians(max_degrees)))[:count]
    r, n, o, cosine = r[seen], n[seen], o[seen], cosine[seen]
    v = 2 * cosine[:, None] * n - o
    distance = np.exp(rng.uniform(np.log(near), np.log(far), len(r)))
    return Truth(eye, r + distance[:, None] * v, r, n, cosine)


def _value(q: np.ndarray, x: np.ndarray) -> np.ndarray:
    h = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    return np.einsum("ni,ij,nj->n", h, q, h)


def _normals(q: np.ndarray, x: np.ndarray, side: float) -> np.ndarray:
    n = side * (x @ q[:3, :3] + q[:3, 3])
    return n / np.linalg.norm(n, axis=1)[:, None]


def reflection_error(q, eye, target, r, side: float = 1.0) -> float:
    """Angle between half vector and normal at r; pi where either end is behind; in radians."""
    n = _normals(q, r[None], side)[0]
    o, v = eye - r, target - r
    if n @ o <= 0 or n @ v <= 0:
        return np.pi
    w = o / np.linalg.norm(o) + v / np.linalg.norm(v)
    return float(np.arctan2(np.linalg.norm(np.cross(w, n)), w @ n))


def alhazen_points(eye: np.ndarray, target: np.ndarray, side: float) -> np.ndarray:
    """Every reflection point on the unit sphere, from a quartic in the plane of eye, target and centre, [k, 3].

    With z = e^(i angle) of R and complex numbers a, b for eye and target: the bisector condition
    (a - z)(b - z) / z^2 real gives conj(ab) z^4 - conj(a + b) z^3 + (a + b) z - ab = 0.
    """
    e1 = eye / np.linalg.norm(eye)
    e2 = target - target @ e1 * e1
    e2 /= np.linalg.norm(e2)
    a = complex(eye @ e1, eye @ e2)
    b = complex(target @ e1, target @ e2)
    roots = np.roots([np.conj(a * b), -np.conj(a + b), 0, a + b, -a * b])
    found = []
    for z in roots:
        if abs(abs(z) - 1) < 1e-7:
            r = z.real * e1 + z.imag * e2
            r /= np.linalg.norm(r)
            if reflection_error(np.diag([1.0, 1, 1, -1]), eye, target, r, side) < 1e-6:
                found.append(r)
    return np.array(found).reshape(-1, 3)


def sphere_points(centre: np.ndarray, eye: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reflection points outside unit spheres, [n, 3], and the cosines of incidence, by bisection in the plane of incidence."""
    a, b = eye - centre, target - centre
    e1 = a / np.linalg.norm(a, axis=1, keepdims=True)
    across = b - np.einsum("ij,ij->i", b, e1)[:, None] * e1
    e2 = across / np.linalg.norm(across, axis=1, keepdims=True)
    low, high = np.zeros(len(a)), np.arctan2(np.linalg.norm(across, axis=1), np.einsum("ij,ij->i", b, e1))
    for _ in range(60):
        angle = 0.5 * (low + high)
        n = np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2
        cosines = [np.einsum("ij,ij->i", n, (x - n) / np.linalg.norm(x - n, axis=1, keepdims=True)) for x in (a, b)]
        ahead = cosines[0] > cosines[1]
        low, high = np.where(ahead, angle, low), np.where(ahead, high, angle)
    return centre + n, cosines[0]


def scanned_points(name: str, eye: np.ndarray, target: np.ndarray, side: float, nodes: int = 160) -> np.ndarray:
    """Every reflection point on a unit-frame surface by a dense scan of the path length's slope, [k, 3].

    The surface is laid out in two parameters; cells in whose corners both slopes change sign start MINPACK on the
    stationarity of the path length under the constraint q = 0, four equations without any geometry in common with
    the solver.
    """
    q = matrix_of(name)
    found: list[np.ndarray] = []
    for x in _charts(name, nodes):
        slope = []
        for axis in (0, 1):
            along = np.gradient(x, axis=axis)
            o, v = eye - x, target - x
            w = o / np.linalg.norm(o, axis=2)[..., None] + v / np.linalg.norm(v, axis=2)[..., None]
            slope.append((w * along).sum(2))
        cells = np.ones(np.array(x.shape[:2]) - 1, bool)
        for s in slope:
            corners = np.stack([s[:-1, :-1], s[1:, :-1], s[:-1, 1:], s[1:, 1:]])
            cells &= (corners.min(0) <= 0) & (corners.max(0) >= 0)
        for i, j in np.argwhere(cells):
            r = _stationary_point(q, eye, target, 0.25 * (x[i, j] + x[i + 1, j] + x[i, j + 1] + x[i + 1, j + 1]))
            if r is None or reflection_error(q, eye, target, r, side) > 1e-8:
                continue
            if all(np.linalg.norm(r - other) > 1e-6 * (1 + np.linalg.norm(r)) for other in found):
                found.append(r)
    return np.array(found).reshape(-1, 3)


def _stationary_point(q, eye, target, start):
    n = start @ q[:3, :3] + q[:3, 3]

    def equations(unknown):
        x = unknown[:3]
        g = x @ q[:3, :3] + q[:3, 3]
        o, v = eye - x, target - x
        w = o / np.linalg.norm(o) + v / np.linalg.norm(v)
        return np.append(w - unknown[3] * g, x @ q[:3, :3] @ x + 2 * q[:3, 3] @ x + q[3, 3])

    o, v = eye - start, target - start
    w = o / np.linalg.norm(o) + v / np.linalg.norm(v)
    solution, _, good, _ = fsolve(equations, np.append(start, w @ n / (n @ n)), xtol=1e-13, full_output=True)
    if good != 1 and np.abs(equations(solution)).max() > 1e-10:
        return None
    return solution[:3]


def _charts(name: str, nodes: int):
    """Grids [nodes, nodes, 3] that cover a unit-frame surface as far as the tests' points can reach."""
    (lx, ly, lz), b, c = SURFACES[name]
    t = np.linspace(-1, 1, nodes + 1) + 0.013  # no node on a plane of symmetry
    if b != 0:
        s = 3.0 * np.sinh(2 * t) / np.sinh(2)
        x, y = np.meshgrid(s, s, indexing="ij")
        yield np.stack([x, y, -(lx * x**2 + ly * y**2 + c) / (2 * b)], axis=2)
    elif lz < 0 and c < 0:
        angle, height = np.meshgrid(np.pi * t, 6.0 * t**3, indexing="ij")
        radius = np.sqrt(-lz * height**2 - c)
        yield np.stack([radius * np.cos(angle) / lx**0.5, radius * np.sin(angle) / ly**0.5, height], axis=2)
    elif lz < 0:
        s = 4.0 * t**3
        x, y = np.meshgrid(s, s, indexing="ij")
        z = np.sqrt((lx * x**2 + ly * y**2 + c) / -lz)
        yield np.stack([x, y, z], axis=2)
        yield np.stack([x, y, -z], axis=2)
    elif lz == 0:
        angle, height = np.meshgrid(np.pi * t, 4.0 * t, indexing="ij")
        yield np.stack([np.cos(angle) / lx**0.5, np.sin(angle) / ly**0.5, height], axis=2)
    else:
        # Six faces of a cube, blown up: no pole.
        u, v = np.meshgrid(t, t, indexing="ij")
        for axis in range(3):
            for sign in (-1.0, 1.0):
                p = np.stack(np.roll([np.full_like(u, sign), u, v], axis, axis=0), axis=2)
                p /= np.linalg.norm(p, axis=2)[..., None]
                yield p / np.sqrt(np.array([lx, ly, lz], float))


def exact_point(q: np.ndarray, eye: np.ndarray, target: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The stationary point next to `start`, with 40 digits, rounded to float64, [3]."""
    with mpmath.workdps(40):
        a = mpmath.matrix(q.tolist())
        o, v = mpmath.matrix(eye.tolist()), mpmath.matrix(target.tolist())

        def half_vector(x):
            to_o, to_v = o - x, v - x
            return to_o / mpmath.norm(to_o) + to_v / mpmath.norm(to_v)

        def equations(x0, x1, x2, multiplier):
            x = mpmath.matrix([x0, x1, x2])
            h = mpmath.matrix([x0, x1, x2, 1])
            g = a * h
            w = half_vector(x)
            return [w[i] - multiplier * g[i] for i in range(3)] + [(h.T * g)[0]]

        g = a * mpmath.matrix([*start.tolist(), 1])
        w = half_vector(mpmath.matrix(start.tolist()))
        first = sum(w[i] * g[i] for i in range(3)) / sum(g[i] ** 2 for i in range(3))
        solution = mpmath.findroot(equations, [*start.tolist(), first], tol=1e-60, maxsteps=30)
        return np.array([float(solution[i]) for i in range(3)])


def first_boxes(low, high, origins, directions, grow: float) -> tuple[np.ndarray, np.ndarray]:
    """The first of many boxes that rays meet, every box asked: (distance [n], inf for none; starts within one [n]).

    Args:
        low, high: Corners of boxes with axes along the frame's, [k, 3]; may be infinite along the third.
        origins, directions: Rays, [n, 3].
        grow: The boxes are wider by so much on every side (narrower if negative), but never upside down along the third axis.
    """
    low, high = np.array(low, float), np.array(high, float)
    low[:, :2] -= grow
    high[:, :2] += grow
    middle = np.where(np.isfinite(low[:, 2]), 0.5 * (low[:, 2] + high[:, 2]), -np.inf)
    low[:, 2] = np.minimum(low[:, 2] - grow, np.where(np.isfinite(middle), middle, np.inf))
    high[:, 2] = np.maximum(high[:, 2] + grow, middle)
    t, within = np.full(len(origins), np.inf), np.zeros(len(origins), bool)
    unit = np.asarray(directions, float)
    unit = unit / np.abs(unit).max(axis=1, keepdims=True)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    for n, (o, d) in enumerate(zip(np.asarray(origins, float), unit, strict=True)):
        start, end = np.zeros(len(low)), np.full(len(low), np.inf)
        for axis in range(3):
            if d[axis] == 0.0:
                end[(o[axis] < low[:, axis]) | (o[axis] > high[:, axis])] = -1.0
            else:
                a, b = (low[:, axis] - o[axis]) / d[axis], (high[:, axis] - o[axis]) / d[axis]
                start, end = np.maximum(start, np.minimum(a, b)), np.minimum(end, np.maximum(a, b))
        met = start <= end
        if met.any():
            t[n] = start[met].min()
        within[n] = ((low <= o) & (o <= high)).all(axis=1).any()
    return t, within


def column_boxes(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The columns of a heightfield of cells of size 1 as boxes without a bottom; what is not finite is no column."""
    heights = np.asarray(heights, float)
    y, x = np.nonzero(np.isfinite(heights))
    tall = heights[y, x]
    return np.stack([x, y, np.full(len(x), -np.inf)], axis=1), np.stack([x + 1, y + 1, tall], axis=1)
