"""Every reflection point on concave and saddle quadrics, against a dense scan, a quartic and topology."""

from __future__ import annotations

import numpy as np
import oracles
import pytest

from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.settings import Status
from warp_reflect.solver import solve

HOLLOW = QuadricMirror.sphere((0.0, 0.0, 0.0), 1.0, side="inner")


def inside_points(name: str, rng: np.random.Generator, count: int) -> np.ndarray:
    """Points on the body's side near a unit-frame surface, z > 0 on two-sheeted ones."""
    x = rng.uniform(-1.0, 1.0, (200 * count, 3)) * [1.0, 1.0, 1.5] + [0.0, 0.0, 0.5]
    h = np.concatenate([x, np.ones((len(x), 1))], axis=1)
    q = oracles.matrix_of(name)
    value = np.einsum("ni,ij,nj->n", h, q, h)
    return x[(value < -0.05) & ((q[2, 2] >= 0) | (q[3, 3] < 0) | (x[:, 2] > 0))][:count]


def found_roots(solution, row: int) -> np.ndarray:
    return solution.roots[row][: solution.root_count[row]]


def same_set(a: np.ndarray, b: np.ndarray, bound: float) -> bool:
    if len(a) != len(b):
        return False
    return all(np.linalg.norm(b - p, axis=1).min() <= bound * (1.0 + np.linalg.norm(p)) for p in a)


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("sphere", -1),
        ("ellipsoid 3:1:1", -1),
        ("ellipsoid 5:5:1", -1),
        ("elliptic cylinder", -1),
        ("paraboloid", -1),
        ("elliptic paraboloid", -1),
        ("two sheets", -1),
        ("one sheet", -1),
        ("one sheet", 1),
        ("hyperbolic paraboloid", 1),
        ("hyperbolic paraboloid", -1),
        ("ellipsoid 3:1:1", 1),
        ("two sheets", 1),
    ],
)
def test_all_roots_are_those_of_a_dense_scan(name, side):
    rng = np.random.default_rng(53)
    if side < 0:
        x = inside_points(name, rng, 7)
    else:
        truth = oracles.constructed(name, rng, 6, 1.0, 70.0, 0.2, 3.0)
        x = np.concatenate([[truth.eye], truth.points])
        x = x[np.abs(x).max(axis=1) < 3.0]
    eye, points = x[0], x[1:]
    mirror = QuadricMirror.from_matrix(oracles.matrix_of(name), side="outer" if side > 0 else "inner")
    solution = solve(mirror, eye, points, all_roots=True)
    compared = 0
    for row, point in enumerate(points):
        expected = oracles.scanned_points(name, eye, point, side)
        got = found_roots(solution, row)
        # The scan ends where its charts do; roots beyond them it cannot judge.
        got = got[np.abs(got).max(axis=1, initial=0.0) < 2.9]
        expected = expected[np.abs(expected).max(axis=1, initial=0.0) < 2.9]
        if (solution.root_status[row] == Status.NEAR_CAUSTIC).any():
            continue
        assert same_set(expected, got, 1e-8), (point, expected, got)
        compared += 1
    assert compared >= 3


def test_hollow_sphere_gives_the_roots_of_alhazens_quartic():
    rng = np.random.default_rng(59)
    points = rng.normal(size=(400, 3))
    points *= (rng.uniform(0.05, 0.95, 400) / np.linalg.norm(points, axis=1))[:, None]
    solution = solve(HOLLOW, points[0], points[1:], all_roots=True)
    counts = []
    for row, point in enumerate(points[1:]):
        expected = oracles.alhazen_points(points[0], point, -1.0)
        counts.append(len(expected))
        assert same_set(expected, found_roots(solution, row), 1e-6), row
    assert counts.count(2) > 100 and counts.count(4) >= 20


@pytest.mark.parametrize(
    "axes", [(1, 1, 1), (2, 1, 1), (1, 1, 0.1), (3, 2, 1), (10, 3, 1), (100, 10, 1), (1, 0.999, 0.998)]
)
def test_roots_in_a_closed_body_balance(axes):
    """Minima - saddles + maxima = 2 on a closed surface; at most 1 pair in 1000 may have lost merging roots."""
    rng = np.random.default_rng(61)
    semi = np.array(axes, float) / max(axes)
    mirror = QuadricMirror.from_matrix(np.diag([*(1.0 / semi**2), -1.0]), side="inner")
    x = rng.normal(size=(2000, 3))
    x = x / np.linalg.norm(x, axis=1)[:, None] * semi * (0.98 * rng.random(2000) ** (1 / 3))[:, None]
    solution = solve(mirror, x[0], x[1:], all_roots=True)
    there = solution.root_status != Status.NONE
    balance = np.where(there, np.where(solution.root_index == 1, -1, 1), 0).sum(axis=1)
    assert (balance != 2).sum() <= 2
    np.testing.assert_array_equal(there.sum(axis=1), solution.root_count)
    assert (np.diff(solution.root_length, axis=1)[there[:, 1:]] >= 0.0).all()
    assert not solution.roots[~there].any() and not solution.root_length[~there].any()


@pytest.mark.parametrize("name", ["ellipsoid 3:1:1", "paraboloid", "one sheet"])
def test_roots_match_forty_digits(name):
    rng = np.random.default_rng(67)
    x = inside_points(name, rng, 4)
    mirror = QuadricMirror.from_matrix(oracles.matrix_of(name), side="inner")
    solution = solve(mirror, x[0], x[1:], all_roots=True)
    assert solution.root_count.min() >= 1
    for row in range(3):
        for root in found_roots(solution, row):
            exact = oracles.exact_point(oracles.matrix_of(name), x[0], x[1 + row], root)
            assert np.linalg.norm(root - exact) < 1e-11 * (1.0 + np.linalg.norm(exact))


def test_the_one_root_is_the_shortest_of_the_best_index():
    """Index 0 before 2 before 1."""
    rng = np.random.default_rng(71)
    seen = set()
    for mirror, eye in (
        (QuadricMirror.rotational(0.0, -4.0, 0.0, side="inner"), (0.3, -0.2, 4.0)),
        (QuadricMirror.rotational(-1.0, 0.0, 1.0), (3.0, 0.1, 0.5)),
        (QuadricMirror.from_matrix(oracles.matrix_of("hyperbolic paraboloid")), (0.5, 0.2, -2.0)),
    ):
        points = rng.uniform(-2.0, 2.0, (300, 3))
        solution, every = solve(mirror, eye, points), solve(mirror, eye, points, all_roots=True)
        np.testing.assert_array_equal(solution.point, every.point)
        np.testing.assert_array_equal(solution.status, every.status)
        for row in np.flatnonzero(every.root_count):
            there = every.root_count[row]
            index, roots = every.root_index[row][:there], every.roots[row][:there]
            wanted = next(k for k in (0, 2, 1) if (index == k).any())
            seen.add((int(wanted), int(there) > 1))
            np.testing.assert_array_equal(solution.point[row], roots[np.flatnonzero(index == wanted)[0]])
    assert {(0, True), (0, False)} <= seen


def test_convex_bodies_have_one_root():
    rng = np.random.default_rng(73)
    for name in oracles.CONVEX:
        mirror = QuadricMirror.from_matrix(oracles.matrix_of(name))
        truth = oracles.constructed(name, rng, 200, 1.0, 75.0, 0.1, 5.0)
        solution = solve(mirror, truth.eye, truth.points, all_roots=True)
        assert solution.roots.shape[1:] == (mirror.max_roots, 3)
        assert (solution.root_count >= 1).all()
        nearest = np.linalg.norm(solution.roots - truth.reflection[:, None], axis=2).min(axis=1)
        assert nearest.max() < 1e-9
        if mirror.max_roots == 1:
            np.testing.assert_array_equal(solution.roots[:, 0], solution.point)
            assert not solution.root_index.any()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_merging_roots_are_flagged_near_the_caustic(dtype):
    """At distance e from the caustic two roots are sqrt(e) apart: within 4 sqrt(u), and NEAR_CAUSTIC when close."""
    eye = np.array([0.0, 0.7, 0.0])

    def count(y: float) -> int:
        return len(oracles.alhazen_points(eye, np.array([0.2, y, 0.0]), -1.0))

    inside, outside = -0.9, 0.5
    assert count(inside) == 4 and count(outside) == 2
    for _ in range(50):
        middle = 0.5 * (inside + outside)
        inside, outside = (middle, outside) if count(middle) == 4 else (inside, middle)
    flagged = []
    for gap in (1e-2, 1e-4, 1e-6):
        point = np.array([[0.2, inside - gap, 0.0]])
        solution = solve(HOLLOW, eye, point.astype(dtype), all_roots=True)
        expected = oracles.alhazen_points(eye, point.astype(dtype)[0].astype(float), -1.0)
        assert solution.root_count[0] == 4
        assert same_set(expected, found_roots(solution, 0), 4.0 * np.sqrt(np.finfo(dtype).eps))
        flagged.append((solution.root_status[0] == Status.NEAR_CAUSTIC).sum())
    assert flagged[0] == 0
    if dtype is np.float32:
        assert flagged[2] == 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rings_on_an_axis_are_ambiguous_and_fixed(dtype):
    points = np.array([[-0.4, 0.0, 0.0]], dtype)
    first, again = (solve(HOLLOW, [0.3, 0.0, 0.0], points, all_roots=True) for _ in range(2))
    np.testing.assert_array_equal(first.roots, again.roots)
    assert sorted(first.root_status[0][:3]) == [Status.CONVERGED, Status.CONVERGED, Status.AMBIGUOUS]
    ring = first.roots[0][np.flatnonzero(first.root_status[0] == Status.AMBIGUOUS)[0]].astype(float)
    q = oracles.matrix_of("sphere")
    assert oracles.reflection_error(q, np.array([0.3, 0, 0]), points[0].astype(float), ring, -1.0) < 1e-6
    centre = solve(HOLLOW, [0.0, 0.0, 0.0], np.zeros((1, 3), dtype))
    assert centre.status[0] == Status.AMBIGUOUS
    spheroid = QuadricMirror.rotational(0.25, 0.0, 1.0, side="inner")
    on_axis = solve(spheroid, [0.0, 0.0, 1.0], np.array([[0.0, 0.0, -1.0]], dtype), all_roots=True)
    assert (on_axis.root_status[0] == Status.AMBIGUOUS).sum() == 1


def test_symmetric_positions_keep_their_pairs():
    """In a plane of symmetry roots off it come in mirrored pairs; equal heights give equal multipliers."""
    mirror = QuadricMirror.from_matrix(np.diag([1.0, 2.0, 4.0, -1.0]), side="inner")
    for eye, point in (
        ((0.4, 0.1, 0.0), (-0.3, 0.2, 0.0)),
        ((0.3, 0.0, 0.1), (-0.5, 0.0, 0.2)),
        ((0.2, 0.1, 0.1), (-0.2, 0.1, 0.1)),
    ):
        eye, point = np.array(eye), np.array(point)
        solution = solve(mirror, eye, point[None], all_roots=True)
        index = solution.root_index[0][: solution.root_count[0]]
        assert np.where(index == 1, -1, 1).sum() == 2
        for root in found_roots(solution, 0):
            assert oracles.reflection_error(np.diag([1.0, 2, 4, -1]), eye, point, root, -1.0) < 1e-9
    retro = solve(mirror, [0.2, 0.1, 0.1], np.array([[0.2, 0.1, 0.1]]), all_roots=True)
    assert np.where(retro.root_index[0][: retro.root_count[0]] == 1, -1, 1).sum() == 2


def test_no_root_is_hidden_or_unreflected():
    one_sheet = QuadricMirror.rotational(-1.0, 0.0, 1.0)
    assert solve(one_sheet, [3.0, 0.0, 0.0], [[-3.0, 0.0, 0.0]]).status[0] == Status.HIDDEN
    inside = QuadricMirror.rotational(-1.0, 0.0, -1.0, side="inner")
    apart = solve(inside, [0.0, 0.0, 3.0], [[0.1, 0.0, -3.0]])
    assert apart.status[0] in (Status.UNREFLECTED, Status.HIDDEN)


def test_a_followed_start_stays_on_its_branch():
    rng = np.random.default_rng(79)
    points = rng.uniform(-0.5, 0.5, (500, 3))
    before = solve(HOLLOW, [0.3, 0.1, -0.5], points)
    moved = points + 1e-4
    warm, cold = solve(HOLLOW, [0.3, 0.1, -0.5], moved, start=before), solve(HOLLOW, [0.3, 0.1, -0.5], moved)
    assert (np.linalg.norm(warm.point - cold.point, axis=1) < 1e-12).mean() > 0.98
    assert np.linalg.norm(warm.point - before.point, axis=1)[before.status == Status.CONVERGED].max() < 0.1


def test_plane_has_no_list_of_roots_longer_than_one():
    solution = solve(PlanarMirror((0, 0, 0), (0, 0, 1)), (0, 0, 2), [[1.0, 0, 1], [1, 0, -1]], all_roots=True)
    np.testing.assert_array_equal(solution.root_count, [1, 0])
    np.testing.assert_array_equal(solution.roots[:, 0], solution.point)
    np.testing.assert_array_equal(solution.root_status[:, 0], [Status.CONVERGED, Status.NONE])
