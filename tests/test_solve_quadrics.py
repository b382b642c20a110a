"""Quadrics: what they are, their frame, rays against them, refusals."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import warp as wp

from warp_reflect.mirrors import QuadricMirror
from warp_reflect.quadrics import QuadricKind, intersect_quadric
from warp_reflect.solver import solve

wp.set_module_options({"enable_backward": False})

KINDS = {
    "sphere": QuadricKind.ELLIPSOID,
    "ellipsoid 100:10:1": QuadricKind.ELLIPSOID,
    "elliptic cylinder": QuadricKind.ELLIPTIC_CYLINDER,
    "elliptic paraboloid": QuadricKind.ELLIPTIC_PARABOLOID,
    "parabolic cylinder": QuadricKind.PARABOLIC_CYLINDER,
    "elliptic two sheets": QuadricKind.TWO_SHEETS,
    "hyperbolic cylinder": QuadricKind.HYPERBOLIC_CYLINDER,
    "cone": QuadricKind.CONE,
    "one sheet": QuadricKind.ONE_SHEET,
    "hyperbolic paraboloid": QuadricKind.HYPERBOLIC_PARABOLOID,
}


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", KINDS)
def test_kind_and_matrix_survive_any_pose(name, size):
    rng = np.random.default_rng(83)
    for factor in (1.0, 1e-6, 1e9):
        q = oracles.placed(oracles.matrix_of(name), oracles.random_pose(rng, size, offset=3.0)) * factor
        mirror = QuadricMirror.from_matrix(q)
        assert mirror.canonical.kind == KINDS[name]
        back = mirror.matrix * (q.ravel() @ mirror.matrix.ravel()) / np.sum(mirror.matrix**2)
        # In the units of the surface: linear and constant terms carry lengths.
        units = np.outer([1, 1, 1, 1 / size], [1, 1, 1, 1 / size])
        assert np.abs((back - q) * units).max() < 1e-10 * np.abs(q * units).max()
        assert q.ravel() @ mirror.matrix.ravel() > 0.0
        np.testing.assert_allclose(QuadricMirror.from_matrix(q, side="inner").matrix, -mirror.matrix, rtol=1e-9)
        assert np.linalg.det(mirror.canonical.axes) == pytest.approx(1.0)


def test_reversed_sign_is_the_other_side():
    """-Q swaps inside and outside: the same mirror as side="inner"."""
    rng = np.random.default_rng(89)
    q = np.diag([1.0, 4.0, 9.0, -1.0])
    points = rng.uniform(-0.15, 0.15, (50, 3))
    a = solve(QuadricMirror.from_matrix(-q), [0.3, 0.1, 0.1], points)
    b = solve(QuadricMirror.from_matrix(q, side="inner"), [0.3, 0.1, 0.1], points)
    np.testing.assert_array_equal(a.point, b.point)
    assert (a.status == 1).all()


@pytest.mark.parametrize(
    ("abc", "name"),
    [((1, 0, 4), "sphere"), ((0, 0, 1), "cylinder"), ((0, -2, 0), "paraboloid"), ((-1, 0, -1), "two sheets")],
)
def test_rotational_is_the_papers_equation(abc, name):
    """Found points fulfil x^2 + y^2 + A z^2 + B z - C = 0 in object space, also under a map with shear."""
    a, b, c = abc
    world = np.eye(4)
    world[:3] = [[1.5, 0.2, 0.0, 3.0], [0.0, 0.8, 0.1, -2.0], [0.1, 0.0, 1.2, 0.5]]
    rng = np.random.default_rng(97)
    for pose in (None, world):
        mirror = QuadricMirror.rotational(a, b, c, pose)
        matrix = np.eye(4) if pose is None else pose
        eye = oracles.move(matrix, np.array([4.0, 0.5, -2.0]))
        solution = solve(mirror, eye, oracles.move(matrix, rng.normal(size=(200, 3)) * 4.0))
        found = solution.point[solution.status == 1]
        assert len(found) > 20
        x, y, z = oracles.move(np.linalg.inv(matrix), found).T
        assert np.abs(x**2 + y**2 + a * z**2 + b * z - c).max() < 1e-9 * (1.0 + np.abs(found).max() ** 2)


def test_sheet_follows_the_object_axis():
    for turn in (1.0, -1.0):
        pose = np.diag([1.0, turn, turn, 1.0])
        mirror = QuadricMirror.rotational(-1, 0, -1, pose, sheet=1)
        assert solve(mirror, [0.5, 0.0, 0.0], [[1.0, 0.2, 0.0]]).point[0, 2] * turn > 0.0


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: QuadricMirror.rotational(0, 0, 0), "a line"),
        (lambda: QuadricMirror.rotational(1, 0, -1), "imaginary ellipsoid"),
        (lambda: QuadricMirror.rotational(1, 0, 0), "a single point"),
        (lambda: QuadricMirror.rotational(0, 0, -1), "imaginary cylinder"),
        (lambda: QuadricMirror.rotational(np.nan, 0, 1), "finite"),
        (lambda: QuadricMirror.from_matrix(np.zeros((4, 4))), "PlanarMirror"),
        (lambda: QuadricMirror.from_matrix(np.diag([1.0, -1, 0, 0])), "crossing planes"),
        (lambda: QuadricMirror.from_matrix(np.diag([1.0, 0, 0, -1])), "parallel"),
        (lambda: QuadricMirror.from_matrix(np.diag([1.0, 0, 0, 0])), "planes"),
        (lambda: QuadricMirror.from_matrix(np.diag([1.0, 1, 1, np.inf])), "finite"),
    ],
)
def test_surfaces_without_a_mirror_are_refused_by_name(make, text):
    with pytest.raises(ValueError, match=text):
        make()


# --- rays


@wp.kernel
def ray_roots_kernel(
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    lam: wp.vec3,
    b: float,
    c: float,
    out_count: wp.array(dtype=int),
    out_roots: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    count, first, second = intersect_quadric(origin[i], direction[i], lam, b, c)
    out_count[i] = count
    out_roots[i] = wp.vec2(first, second)


def ray_roots(name, origin, direction, device):
    diagonal, b, c = oracles.SURFACES[name]
    n = len(origin)
    count = wp.zeros(n, dtype=int, device=device)
    roots = wp.zeros(n, dtype=wp.vec2, device=device)
    rays = [wp.array(np.asarray(a, np.float32), dtype=wp.vec3, device=device) for a in (origin, direction)]
    inputs = [*rays, wp.vec3(*map(float, diagonal)), float(b), float(c), count, roots]
    wp.launch(ray_roots_kernel, dim=n, inputs=inputs, device=device)
    return count.numpy(), roots.numpy()


@pytest.mark.parametrize("distance", [10.0, 1e4, 1e5])
def test_far_rays_hit_the_sphere_within_four_roundings(distance, device):
    """Naive float32 loses 0.87 of the radius at 1e5."""
    offset = np.linspace(0.0, 0.95, 20)
    origin = np.stack([offset * 0 - distance, offset, 0.0 * offset], axis=1)
    count, roots = ray_roots("sphere", origin, np.tile([1.0, 0, 0], (20, 1)), device)
    offset = offset.astype(np.float32).astype(float)
    assert (count == 2).all()
    exact = distance - np.sqrt(1.0 - offset**2)
    assert (np.abs(roots[:, 0] - exact) <= 4 * np.spacing(np.float32(distance))).all()


def test_paraboloid_rays_along_the_axis_have_one_root(device):
    """The second root runs to infinity; it must neither spoil the first nor appear."""
    tilt = np.array([1e-1, 1e-3, 1e-4, 1e-6, 0.0])
    origin = np.tile([0.5, 0.0, -2.0], (5, 1))
    direction = np.stack([tilt, 0 * tilt, np.ones(5)], axis=1)
    count, roots = ray_roots("paraboloid", origin, direction, device)
    assert count[-1] == 1
    for k, e in enumerate(tilt.astype(np.float32).astype(float)):
        # 0.5 (0.5 + e s)^2 = s - 2
        qa, qb, qc = 0.5 * e * e, 0.5 * e - 1.0, 2.125
        exact = 2 * qc / (-qb + np.sqrt(qb * qb - 4 * qa * qc))
        assert abs(roots[k, 0] - exact) <= 16 * 6e-8 * exact


def test_asymptotic_ray_of_a_hyperboloid_has_no_second_root(device):
    direction = np.array([[np.sqrt(0.5), 0.0, np.sqrt(0.5)]])
    count, _ = ray_roots("two sheets", [[0.0, 0.0, -3.0]], direction, device)
    assert count[0] == 1


def test_rays_beside_a_surface_miss(device):
    count, _ = ray_roots("sphere", [[-5.0, 1.5, 0], [-1e5, 1.001, 0]], np.tile([1.0, 0, 0], (2, 1)), device)
    assert (count == 0).all()
