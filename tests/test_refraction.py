"""The bare solver through interfaces: truth from mpmath and from rays shot by NumPy, statuses, arrays."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from scipy.optimize import brentq

import warp_reflect as wr
from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.settings import Status

WATER = PlanarMirror((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))
BALL = QuadricMirror.sphere((0.0, 0.0, 0.0), 1.0)
FOCAL_PX = 640.0 / np.tan(np.radians(30.0))  # a camera of 1280 pixels and 60 degrees
WITH_PATH = (Status.CONVERGED, Status.GRAZING, Status.NEAR_CAUSTIC)


def pixels(eye, found, true) -> np.ndarray:
    """Angles between the eye's rays through two points each, in pixels of a 1280 pixel camera."""
    a, b = found - eye, true - eye
    sine = np.linalg.norm(np.cross(a, b), axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return FOCAL_PX * sine


def refracted(d, n, ior):
    """(directions behind an interface, whether there is one); NumPy, rows."""
    across = (d - np.sum(d * n, 1, keepdims=True) * n) / ior
    square = 1.0 - np.sum(across * across, 1)
    return across - np.sqrt(np.maximum(square, 0.0))[:, None] * n, square > 0.0


def snell(p, n, a, b, ior) -> np.ndarray:
    """|sin - ior sin| as vectors at p between the ends a and b."""
    u = (a - p) / np.linalg.norm(a - p, axis=1, keepdims=True)
    v = (b - p) / np.linalg.norm(b - p, axis=1, keepdims=True)
    return np.linalg.norm(np.cross(u + ior * v, n), axis=1)


def shot(eye, lam, ior, count, seed):
    """Paths through an ellipsoid x^T diag(lam) x = 1 by construction: (entry, exit, point), rows."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(count, 3))
    a /= np.sqrt(np.sum(a * a * lam, 1, keepdims=True))
    n = a * lam / np.linalg.norm(a * lam, axis=1, keepdims=True)
    seen = np.sum((eye - a) * n, 1) > 0.0
    a, n = a[seen], n[seen]
    inside, enters = refracted((a - eye) / np.linalg.norm(a - eye, axis=1, keepdims=True), n, ior)
    b = a - 2.0 * (np.sum(a * inside * lam, 1) / np.sum(inside * inside * lam, 1))[:, None] * inside
    m = b * lam / np.linalg.norm(b * lam, axis=1, keepdims=True)
    out, leaves = refracted(inside, -m, 1.0 / ior)
    good = enters & leaves
    return a[good], b[good], (b + 10.0 ** rng.uniform(-2.0, 1.5, (len(b), 1)) * out)[good]


# --- plane


@pytest.mark.parametrize("ior", [1.333, 2.4, 0.75])
def test_water_matches_mpmath(ior):
    """Heights and distances over six decades; 1e-3 pixels in float32, 1e-8 in float64."""
    rng = np.random.default_rng(1)
    mpmath.mp.dps = 40
    for _ in range(25):
        h_eye, h_point, distance = (10.0 ** rng.uniform(-3.0, 3.0) for _ in range(3))
        eye = np.array([0.0, h_eye, 0.0])
        for dtype, bound in ((np.float32, 1e-3), (np.float64, 1e-8)):
            point = np.array([[0.6 * distance, -h_point, 0.8 * distance]], dtype)
            x, y, z = (mpmath.mpf(float(c)) for c in point[0])
            away, depth, height = mpmath.sqrt(x * x + z * z), -y, mpmath.mpf(h_eye)

            def law(t, away=away, depth=depth, height=height):
                rest = away - t
                return t / mpmath.sqrt(t * t + height**2) - ior * rest / mpmath.sqrt(rest**2 + depth**2)

            t = mpmath.findroot(law, (mpmath.mpf(0), away), solver="bisect", maxsteps=150, tol=1e-30, verify=False)
            true = np.array([[float(t * x / away), 0.0, float(t * z / away)]])
            found = wr.refract(WATER, eye, point, ior)
            assert found.status[0] == Status.CONVERGED
            assert found.residual[0] * min(h_eye, h_point) < 1e-15 * (h_eye + h_point + distance)
            assert pixels(eye, found.point.astype(float), true)[0] < bound
            length = np.linalg.norm(true - eye) + np.linalg.norm(true - point)
            assert np.linalg.norm(found.virtual[0] - eye) == pytest.approx(length, rel=1e-6)


def test_a_straight_spoon_looks_bent_up_from_above_and_the_way_back_is_the_same():
    eye, spoon = np.array([0.0, 1.0, 0.0]), np.array([[2.0, -1.0, 0.0]])
    down = wr.refract(WATER, eye, spoon, 1.333)
    # Seen at a smaller depth below where it is, and nearer to the eye's foot than the straight line.
    assert down.point[0, 0] > 1.0
    up = wr.refract(WATER, spoon[0], eye[None], 1.333)
    np.testing.assert_allclose(up.point, down.point, atol=1e-14)
    np.testing.assert_allclose(up.normal, -down.normal)
    np.testing.assert_allclose(wr.refract(WATER, eye, spoon, 1.0).point, [[1.0, 0.0, 0.0]], atol=1e-15)


# --- bodies


def sphere_paths(eye, point, ior) -> list[tuple[float, np.ndarray]]:
    """Every path through the unit ball: (optical length, entry point), from sign changes in the plane of incidence."""
    e = eye / np.linalg.norm(eye)
    side = point - point @ e * e
    side /= np.linalg.norm(side)
    widest = np.arccos(1.0 / np.linalg.norm(eye))

    def path(theta):
        theta = np.atleast_1d(theta)[:, None]
        a = np.cos(theta) * e + np.sin(theta) * side
        inside, _ = refracted((a - eye) / np.linalg.norm(a - eye, axis=1, keepdims=True), a, ior)
        b = a - 2.0 * np.sum(a * inside, 1, keepdims=True) * inside
        out, _ = refracted(inside, -b, 1.0 / ior)
        return a, b, out

    def miss(theta):
        _, b, d = path(theta)
        return np.cross(d, point - b) @ np.cross(e, side)

    angles = np.linspace(-widest, widest, 4001)[1:-1]
    values = miss(angles)
    found = []
    for k in np.flatnonzero(values[1:] * values[:-1] < 0.0):
        a, b, d = (v[0] for v in path(brentq(lambda t: miss(t)[0], angles[k], angles[k + 1], xtol=1e-15)))
        if d @ (point - b) > 0.0:
            found.append((np.linalg.norm(a - eye) + ior * np.linalg.norm(b - a) + np.linalg.norm(point - b), a))
    return sorted(found, key=lambda each: each[0])


def test_ball_matches_every_path_found_in_the_plane_of_incidence():
    eye = np.array([1.2, 0.9, 2.5])
    _, _, points = shot(eye, np.ones(3), 1.5, 60, 3)
    found = {dtype: wr.refract(BALL, eye, points.astype(dtype), 1.5) for dtype in (np.float32, np.float64)}
    several = 0
    for k, point in enumerate(points):
        paths = sphere_paths(eye, point, 1.5)
        several += len(paths) > 1
        length, true = paths[0]
        assert found[np.float64].length[k] == pytest.approx(length, rel=1e-9)
        if len(paths) > 1 and paths[1][0] - length < 1e-4:
            continue  # two paths as good as one another, or about to merge
        assert pixels(eye, found[np.float64].point[k][None], true[None])[0] < 1e-6
        assert pixels(eye, found[np.float32].point[k][None].astype(float), true[None])[0] < 0.02
    assert several > 4


@pytest.mark.parametrize("lam", [(1, 1, 1), (1, 4, 2), (1, 9, 9), (1, 1, 25)])
@pytest.mark.parametrize("ior", [1.33, 1.5])
def test_bodies_are_seen_through_two_interfaces(lam, ior):
    """At most 1 % of the points that a ray of the eye's reaches are lost; the paths are Snell's, and none is a detour."""
    lam, eye = np.array(lam, float), np.array([1.7, 1.3, 3.5])
    body = QuadricMirror.from_matrix(np.diag([*lam, -1.0]))
    entry, leave, points = shot(eye, lam, ior, 1200, 5)
    built = np.linalg.norm(entry - eye, axis=1) + ior * np.linalg.norm(leave - entry, axis=1)
    built += np.linalg.norm(points - leave, axis=1)
    found = wr.refract(body, eye, points, ior)
    there = np.isin(found.status, WITH_PATH)
    assert there.mean() >= 0.99
    assert (found.length[there] <= built[there] * (1.0 + 1e-12)).mean() >= 0.98
    a, b, n, m = (v[there] for v in (found.point, found.exit, found.normal, found.exit_normal))
    assert np.abs(np.sum(a * a * lam, 1) - 1.0).max() < 1e-12
    assert snell(a, n, np.broadcast_to(eye, a.shape), b, ior).max() < 1e-10
    assert (snell(b, m, points[there], a, ior) * np.linalg.norm(points[there] - b, axis=1)).max() < 1e-10
    same = there & (np.abs(found.length - built) < 1e-9)
    assert same.mean() > 0.5
    error = pixels(eye, found.point[same], entry[same])
    assert np.quantile(error, 0.95) < 1e-6
    single = wr.refract(body, eye, points.astype(np.float32), ior)
    both = same & (single.status == Status.CONVERGED) & (np.abs(single.length - built) < 1e-5)
    error = pixels(eye, single.point[both].astype(float), entry[both])
    assert np.quantile(error, 0.95) < 1e-3


def test_points_inside_a_ball_are_seen_through_one_interface():
    rng = np.random.default_rng(7)
    eye, inside = np.array([0.5, 0.3, 4.0]), 0.5 * rng.uniform(-1.0, 1.0, (300, 3))
    found = wr.refract(BALL, eye, inside, 1.33)
    assert (found.status == Status.CONVERGED).all()
    assert snell(found.point, found.normal, np.broadcast_to(eye, inside.shape), inside, 1.33).max() < 1e-12
    # A fish bowl magnifies: what is seen lies farther out than it is, as seen from the eye.
    toward = -eye / np.linalg.norm(eye)
    off = lambda p: np.linalg.norm(np.cross(p - eye, toward), axis=1) / ((p - eye) @ toward)  # noqa: E731
    assert (off(found.virtual) > off(inside)).mean() > 0.99
    back = wr.refract(BALL, inside[0], eye[None], 1.33)
    np.testing.assert_allclose(back.point[0], found.point[0], atol=1e-12)
    np.testing.assert_allclose(back.normal[0], -found.normal[0], atol=1e-12)


# --- statuses, arrays


def status(surface, eye, point, ior=1.5, dtype=np.float64) -> Status:
    found = wr.refract(surface, eye, np.array([point], dtype), ior)
    for array in (found.point, found.normal, found.exit, found.virtual, found.length, found.residual):
        assert np.isfinite(array).all()
    return Status(int(found.status[0]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_statuses(dtype):
    above, below = (0.0, 1.0, 0.0), (1.0, -1.0, 0.0)
    pool = PlanarMirror((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), extent=(0.1, 0.1))
    assert status(WATER, above, below, dtype=dtype) == Status.CONVERGED
    assert status(WATER, above, (1.0, 1.0, 0.0), dtype=dtype) == Status.UNREFLECTED
    assert status(WATER, (0.0, 0.0, 0.0), below, dtype=dtype) == Status.BAD_INPUT
    assert status(WATER, above, (np.nan, 0.0, 0.0), dtype=dtype) == Status.BAD_INPUT
    assert status(WATER, above, (1.0, 0.0, 0.0), dtype=dtype) == Status.CONVERGED
    assert status(pool, above, below, dtype=dtype) == Status.OUT_OF_EXTENT
    assert status(BALL, (0.0, 0.0, 3.0), (0.0, 0.0, -0.5), dtype=dtype) == Status.CONVERGED
    assert status(BALL, (0.0, 0.0, 0.5), (0.0, 0.2, -0.5), dtype=dtype) == Status.INSIDE
    assert status(BALL, (0.0, 0.0, 1.0), (0.0, 0.2, -0.5), dtype=dtype) == Status.BAD_INPUT
    assert status(BALL, (0.0, 0.0, 3.0), (0.0, 5.0, 3.0), dtype=dtype) == Status.UNREFLECTED
    assert status(BALL, (0.0, 0.0, 3.0), (0.0, np.inf, 3.0), dtype=dtype) == Status.BAD_INPUT
    for behind in (-1.1, -1.4, -10.0):
        assert status(BALL, (0.0, 0.0, 10.0), (0.0, 0.0, behind), dtype=dtype) == Status.CONVERGED
    for far in (1e6, 1e9):
        assert status(BALL, (0.0, 0.0, 3.0), (0.01 * far, 0.0, -far), dtype=dtype) in WITH_PATH


def test_a_bubble_is_entered_within_the_limit_angle_only():
    """A ball of air in water: beyond an incidence whose sine is 0.75 it mirrors."""
    eye = np.array([0.0, 0.0, 5.0])
    angle = np.radians(np.linspace(0.0, 150.0, 31))
    points = 3.0 * np.stack([np.sin(angle), np.zeros(31), -np.cos(angle)], axis=1)
    found = wr.refract(BALL, eye, points, 0.75)
    there = found.status == Status.CONVERGED
    incidence = np.linalg.norm(np.cross(found.normal[there], (eye - found.point[there])), axis=1)
    incidence /= np.linalg.norm(eye - found.point[there], axis=1)
    assert incidence.max() < 0.75 and (np.diff(incidence) > 0.0).all()
    # At the limit a ray is turned by 2 (90 - 48.6) degrees.
    assert (there == (found.status != Status.UNREFLECTED)).all() and 75.0 < np.degrees(angle[there].max()) < 120.0


def test_shapes_and_libraries_follow_the_points():
    import warp as wp

    eyes = np.array([[0.0, 1.0, 0.0], [0.5, 2.0, 0.0]])
    points = np.array([[1.0, -1.0, 0.0], [0.0, -2.0, 1.0], [0.3, -0.1, 0.2]])
    found = wr.refract(WATER, eyes, points, 1.33)
    assert found.point.shape == (2, 3, 3) and found.status.shape == found.length.shape == (2, 3)
    one = wr.refract(WATER, eyes[0], points[0], 1.33)
    assert one.point.shape == (3,) and one.status.shape == ()
    given = wp.array(points.astype(np.float32), dtype=wp.vec3)
    device = wr.refract(WATER, eyes[0], given, 1.33)
    assert isinstance(device.virtual, wp.array) and device.virtual.dtype == wp.vec3
    np.testing.assert_allclose(device.point.numpy(), found.point[0], atol=1e-6)
    many = np.random.default_rng(0).normal(size=(5000, 3)) - [0.0, 9.0, 0.0]
    a, b = (wr.refract(WATER, eyes[0], many, 1.33, threads=t).virtual for t in (1, 4))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    ("arguments", "kind", "message"),
    [
        ((WATER, [0, 1, 0], [[0, -1, 0]], 0.0), ValueError, "ior: got 0.0, expected a positive number"),
        ((WATER, [0, 1, 0], [[0, -1, 0]], np.nan), ValueError, "ior: got nan"),
        ((WATER, [0, 1], [[0, -1, 0]], 1.3), ValueError, "refract eye: got shape"),
        ((WATER, [0, 1, 0], ["x"], 1.3), TypeError, "refract points"),
        (("pool", [0, 1, 0], [[0, -1, 0]], 1.3), TypeError, "got str, expected PlanarMirror or QuadricMirror"),
        ((QuadricMirror.rotational(0, -1, 0), [0, 1, 0], [[0, -1, 0]], 1.3), ValueError, "paraboloid"),
        ((QuadricMirror.sphere((0, 0, 0), 1, "inner"), [0, 0, 0], [[0, 3, 0]], 1.3), ValueError, "inner ellipsoid"),
    ],
)
def test_what_cannot_be_is_refused_by_name(arguments, kind, message):
    with pytest.raises(kind, match=message):
        wr.refract(*arguments)
