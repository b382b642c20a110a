"""Derivatives of the bare solver: finite differences in float64, and the tape against the Jacobians."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import warp as wp

from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.settings import Status
from warp_reflect.solver import solve
from warp_reflect.solver_gradients import solve_gradients, solve_on_tape

STEP = 1e-5  # central differences: error 1e-10 from the third derivative, 1e-11 from rounding


def cases():
    rng = np.random.default_rng(101)
    pose = oracles.random_pose(rng, offset=0.5)
    pose[:3, :3] = pose[:3, :3] @ np.diag([1.0, 0.7, 2.0])
    hollow = oracles.move(pose, rng.normal(size=(20, 3)) * 0.15)
    around = rng.normal(size=(20, 3)) * 3.0
    eye = np.array([2.0, 0.3, 1.1])
    saddle = QuadricMirror.from_matrix(oracles.matrix_of("hyperbolic paraboloid"))
    return {
        "sphere": (QuadricMirror.sphere((0.1, 0.2, 0.3), 1.3), eye, around),
        "ellipsoid": (QuadricMirror.rotational(3, 0, 1, pose), eye, around),
        "hollow ellipsoid": (
            QuadricMirror.rotational(3, 0, 1, pose, side="inner"),
            oracles.move(pose, np.array([0.3, 0.1, 0.2])),
            hollow,
        ),
        "paraboloid": (QuadricMirror.rotational(0, -1, 0), eye - [0, 0, 3.0], around),
        "saddle": (saddle, np.array([0.5, 0.2, -2.0]), around * 0.2 - [0.0, 0.0, 1.5]),
        "plane": (PlanarMirror((0.1, 0.2, 0.3), (0.3, 0.2, 1.0)), eye, around),
    }


def answers(mirror, eye, points) -> np.ndarray:
    solution = solve(mirror, eye, points)
    return np.concatenate([solution.point, solution.virtual], axis=1)


def slope(function) -> np.ndarray:
    """Derivatives of function(vector of 3) at 0, [n, 6, 3]."""
    columns = [(function(STEP * e) - function(-STEP * e)) / (2 * STEP) for e in np.eye(3)]
    return np.stack(columns, axis=2)


@pytest.mark.parametrize("name", cases())
def test_jacobians_match_finite_differences(name):
    mirror, eye, points = cases()[name]
    solution = solve(mirror, eye, points)
    good = solution.status == Status.CONVERGED
    assert good.sum() >= 5
    jacobians = solve_gradients(mirror, eye, points, solution)
    of_eye = slope(lambda d: answers(mirror, eye + d, points))[good]
    of_points = slope(lambda d: answers(mirror, eye, points + d))[good]
    for found, expected in (
        (jacobians.point_eye, of_eye[:, :3]),
        (jacobians.virtual_eye, of_eye[:, 3:]),
        (jacobians.point_target, of_points[:, :3]),
        (jacobians.virtual_target, of_points[:, 3:]),
    ):
        assert np.abs(found[good] - expected).max() < 1e-6 * (1.0 + np.abs(expected).max())
        assert not found[~good].any()
    if isinstance(mirror, QuadricMirror):
        rng = np.random.default_rng(103)
        for _ in range(3):
            change = rng.normal(size=(4, 4))
            change += change.T
            if mirror.canonical.b != 0.0:
                # Keep the rank, that is the kind.
                change[:3, :3] = 0.0
            plus, minus = (
                answers(QuadricMirror.from_matrix(mirror.matrix + s * STEP * change), eye, points) for s in (1, -1)
            )
            expected = ((plus - minus) / (2 * STEP))[good]
            found = [np.einsum("nijk,jk->ni", j, change) for j in (jacobians.point_matrix, jacobians.virtual_matrix)]
            error = np.abs(np.concatenate(found, axis=1)[good] - expected).max()
            assert error < 1e-5 * (1.0 + np.abs(expected).max())


@pytest.mark.parametrize("name", ["ellipsoid", "hollow ellipsoid", "plane"])
@pytest.mark.parametrize("vector", [wp.vec3, wp.vec3d])
def test_tape_gives_the_transposed_jacobians(name, vector, device):
    mirror, eye, points = cases()[name]
    eyes = np.stack([eye, eye + 0.05])
    solution = solve(mirror, eyes, points)
    jacobians = solve_gradients(mirror, eyes, points, solution)
    rng = np.random.default_rng(107)
    weights = rng.normal(size=(2, *solution.point.shape)) * (solution.status == Status.CONVERGED)[..., None]
    tape = wp.Tape()
    on_device = wp.array(eyes, dtype=wp.vec3d, device=device, requires_grad=True)
    targets = wp.array(points, dtype=vector, device=device, requires_grad=True)
    matrix = wp.array([mirror.matrix], dtype=wp.mat44d, device=device, requires_grad=True)
    point, virtual, _ = solve_on_tape(mirror, on_device, targets, tape, matrix)
    grads = {
        array: wp.array(w.reshape(-1, 3), dtype=vector, device=device)
        for array, w in zip((point, virtual), weights, strict=True)
    }
    tape.backward(grads=grads)
    bound = 2e-5 if vector is wp.vec3 else 1e-11
    pairs = (
        (on_device, "mni,mnij->mj", "eye"),
        (targets, "mni,mnij->nj", "target"),
        (matrix, "mni,mnijk->jk", "matrix"),
    )
    for array, rule, what in pairs:
        expected = np.einsum(rule, weights[0], getattr(jacobians, f"point_{what}"))
        expected = expected + np.einsum(rule, weights[1], getattr(jacobians, f"virtual_{what}"))
        found = array.grad.numpy().reshape(expected.shape)
        assert np.abs(found - expected).max() <= bound * (1.0 + np.abs(expected).max())


def test_gradients_are_finite_on_caustics_and_absent_without_a_point():
    hollow = QuadricMirror.sphere((0, 0, 0), 1.0, side="inner")
    eye, points = [0.3, 0.0, 0.0], np.array([[-0.4, 0.0, 0.0], [2.0, 0.0, 0.0], [np.nan, 0, 0]])
    solution = solve(hollow, eye, points)
    jacobians = solve_gradients(hollow, eye, points, solution)
    assert np.isfinite(jacobians.point_matrix).all() and np.isfinite(jacobians.virtual_eye).all()
    assert not jacobians.point_target[1:].any()


def test_gradients_need_a_mirror_with_a_matrix():
    with pytest.raises(TypeError, match="PlanarMirror or QuadricMirror"):
        solve_gradients("mirror", [0, 0, 0], np.zeros((1, 3)), None)
    sphere = QuadricMirror.sphere((0, 0, 0), 1.0)
    solution = solve(sphere, [3, 0, 0], np.ones((4, 3)) * 2)
    with pytest.raises(ValueError, match="do not give"):
        solve_gradients(sphere, [3, 0, 0], np.ones((5, 3)), solution)
