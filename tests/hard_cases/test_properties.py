"""What must hold of every answer, whatever the input: symmetry, motion, stationarity, precision, order, repetition."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from test_reflector_map import constructed, draw, probe

import warp_reflect as wr
from warp_reflect.settings import Settings, Status

wp.set_module_options({"enable_backward": False})

# Warp's launches have no place in a shrinking search of many thousand examples; each example is a batch of its own.
QUICK = settings(max_examples=25, deadline=None, derandomize=True)
SEEDS = st.integers(0, 2**32 - 1)
NAMES = st.sampled_from(oracles.CONVEX)
BATCH = 200
ACCEPTED = 1e-3  # residual up to which an answer of a map counts as found


def sample(name: str, seed: int, degrees: float = 75.0):
    """(mirror, truth, rng) of a convex surface in its own frame, the sheet towards +z."""
    rng = np.random.default_rng(seed)
    far = 100.0 if name.startswith(("sphere", "ellipsoid")) else 10.0
    truth = oracles.constructed(name, rng, BATCH, 10.0 ** rng.uniform(-0.5, 1.0), degrees, 0.05, far)
    return mirror_at(name, np.eye(4)), truth, rng


def mirror_at(name: str, pose: np.ndarray) -> wr.QuadricMirror:
    q = oracles.placed(oracles.matrix_of(name), pose)
    mirror = wr.QuadricMirror.from_matrix(q)
    if mirror.max_roots == 2:
        mirror = wr.QuadricMirror.from_matrix(q, sheet=1 if mirror.axis @ pose[:3, 2] > 0 else -1)
    return mirror


def size_of(points: np.ndarray) -> np.ndarray:
    return np.maximum(1.0, np.linalg.norm(points, axis=-1))


@QUICK
@given(NAMES, SEEDS)
def test_exchanging_eye_and_point_changes_nothing(name, seed):
    """Fermat's path has no direction: 1e-10 of the size in float64."""
    mirror, truth, _ = sample(name, seed)
    there = wr.solve(mirror, truth.eye, truth.points)
    back = wr.solve(mirror, truth.points, truth.eye[None])
    np.testing.assert_array_equal(there.status, back.status[:, 0])
    error = np.linalg.norm(there.point - back.point[:, 0], axis=1) / size_of(there.point)
    assert error.max(initial=0.0) <= 1e-10


@QUICK
@given(NAMES, SEEDS, st.floats(-6.0, 6.0), st.floats(0.0, 3.0))
def test_moving_the_world_moves_the_answer(name, seed, decade, far):
    """Scaled over twelve decades, turned and shifted: R and V' move along, to what the inputs' rounding leaves."""
    mirror, truth, rng = sample(name, seed)
    pose = oracles.random_pose(rng, 10.0**decade, offset=10.0**far)
    here = wr.solve(mirror, truth.eye, truth.points)
    moved = wr.solve(mirror_at(name, pose), oracles.move(pose, truth.eye), oracles.move(pose, truth.points))
    good = (here.status == Status.CONVERGED) & (moved.status == Status.CONVERGED)
    assert good.mean() > 0.99
    scale = 10.0**decade * (size_of(here.point) + 10.0**far)
    # The matrix in world space loses the square of the offset, in units of the size.
    bound = 1e-11 * (1.0 + 10.0 ** (2 * far)) * (1e4 if "100" in name else 10.0)
    for there, back in ((moved.point, here.point), (moved.virtual, here.virtual)):
        error = np.linalg.norm(there - oracles.move(pose, back), axis=1) / scale
        assert np.quantile(error[good], 0.99) <= bound


@QUICK
@given(NAMES, SEEDS)
def test_path_length_is_stationary(name, seed):
    """Along the surface it changes by less than the square of a step of 1e-4 explains; a convex mirror's is least."""
    mirror, truth, rng = sample(name, seed)
    solution = wr.solve(mirror, truth.eye, truth.points)
    q = oracles.matrix_of(name)
    good = solution.status == Status.CONVERGED
    r, points = solution.point[good], truth.points[good]
    n = r @ q[:3, :3] + q[:3, 3]
    slant = np.cross(n, rng.normal(size=n.shape))
    slant /= np.linalg.norm(slant, axis=1, keepdims=True)

    def length(x):
        return np.linalg.norm(x - truth.eye, axis=1) + np.linalg.norm(x - points, axis=1)

    near = np.minimum(np.linalg.norm(r - truth.eye, axis=1), np.linalg.norm(r - points, axis=1))
    # By how far the surface bends from its tangent within a step: of the second order, and told by its gradient.
    step = 1e-4 * np.minimum(near, np.linalg.norm(n, axis=1) / np.linalg.norm(q[:3, :3], 2))[:, None]
    for sign in (-1.0, 1.0):
        x = r + sign * step * slant
        for _ in range(2):  # back onto the surface, by Newton along the gradient
            gradient = x @ q[:3, :3] + q[:3, 3]
            value = np.einsum("ni,ij,nj->n", x, q[:3, :3], x) + 2 * x @ q[:3, 3] + q[3, 3]
            x = x - 0.5 * value[:, None] * gradient / (gradient**2).sum(1, keepdims=True)
        change = (length(x) - length(r)) / step[:, 0]
        rounding = 64 * np.finfo(float).eps * length(r) / step[:, 0]
        assert (change >= -1e-6 - rounding).all() and (change <= 1e-3 + rounding).all()


@QUICK
@given(NAMES, SEEDS)
def test_float32_agrees_with_float64(name, seed):
    """On the same (float32) points: 4 roundings, and 4 times what a rounding of eye and point moves the exact answer."""
    mirror, truth, _ = sample(name, seed)
    points, eye = truth.points.astype(np.float32).astype(np.float64), truth.eye
    single, double = wr.solve(mirror, eye, points.astype(np.float32)), wr.solve(mirror, eye, points)
    both = (single.status == Status.CONVERGED) & (double.status == Status.CONVERGED)
    assert both.mean() > 0.99
    eps = float(np.finfo(np.float32).eps)
    nudges = eps * np.eye(3)
    others = [wr.solve(mirror, eye, points + nudge * np.abs(points).max(axis=1)[:, None]) for nudge in nudges]
    others += [wr.solve(mirror, eye + nudge * np.abs(eye).max(), points) for nudge in nudges]
    for field in ("point", "virtual"):
        exact = getattr(double, field)
        moved = sum(np.linalg.norm(getattr(other, field) - exact, axis=1) for other in others)
        error = np.linalg.norm(getattr(single, field) - exact, axis=1)
        bound = 4 * (moved + eps * size_of(exact))
        assert np.quantile((error / bound)[both], 0.99) <= 1.0


MIRRORS = {
    "convex": wr.QuadricMirror.rotational(4, 0, 1),
    "hollow": wr.QuadricMirror.sphere((0, 0, 0), 4.0, side="inner"),
    "saddle": wr.QuadricMirror.from_matrix(oracles.matrix_of("hyperbolic paraboloid")),
    "plane": wr.PlanarMirror((0, 0, 0), (0.1, 0.3, 1)),
}


@pytest.fixture(scope="module")
def body_map():
    return draw((2, 1, 0.5), 64)[1]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", [*MIRRORS, "map"])
def test_answers_do_not_depend_on_order_threads_or_batch(name, dtype, body_map):
    """Bit for bit: again, with 1, 2 and 8 threads, permuted, cut into batches, one by one."""
    mirror = body_map if name == "map" else MIRRORS[name]
    rng = np.random.default_rng(11)
    points = (rng.normal(size=(700, 3)) * 1.5).astype(dtype)
    eye = np.array([0.4, 0.3, 3.0])
    whole = wr.solve(mirror, eye, points, threads=1)
    order = rng.permutation(len(points))
    parts = np.split(np.arange(len(points)), [1, 2, 65, 333])
    for other, rows in (
        (wr.solve(mirror, eye, points, threads=1), slice(None)),
        (wr.solve(mirror, eye, points, threads=2), slice(None)),
        (wr.solve(mirror, eye, points, threads=8), slice(None)),
        (wr.solve(mirror, eye, points[order], threads=2), order),
        *((wr.solve(mirror, eye, points[part]), part) for part in parts),
    ):
        for field in ("point", "normal", "virtual", "residual", "status"):
            np.testing.assert_array_equal(getattr(other, field), getattr(whole, field)[rows], err_msg=field)


def test_one_more_iteration_never_raises_the_residual():
    """Where the limit alone ends the search: what one limit accepts, the next accepts, and late ones never rise.

    A limit so low that the search fails lets it start again with as many more; above the accepted residual that is all
    there is to compare.
    """
    axes, drawn = draw((2, 1, 0.5), 64)
    _, eye, target = constructed(axes, 1500, np.random.default_rng(12), incidence=85.0)
    for search, limits, late in (("newton", range(1, 15), 6), ("midpoint", (1, 2, 4, 8, 16, 32), 4)):
        last = None
        for iterations in limits:
            chosen = Settings(search=search, iterations=iterations, tolerance=1e-7)
            _, residual, _ = probe(drawn, eye, target, chosen)
            if last is not None:
                assert (residual <= np.maximum(last, ACCEPTED) + 1e-6).all(), (search, iterations)
                if iterations > late:
                    assert (residual <= last + 1e-6).all(), (search, iterations)
            last = residual


@pytest.mark.parametrize("axes", [(1, 1, 1), (3, 1, 1), (1, 1, 0.3)])
def test_finer_map_converges_at_its_order(axes):
    """Bilinear normals of a smooth body: the error falls with the square of the texel, slope 2 within 0.3."""
    resolutions = (24, 48, 96, 192)
    errors = []
    for resolution in resolutions:
        semi, drawn = draw(axes, resolution)
        r, eye, target = constructed(semi, 1500, np.random.default_rng(13), incidence=60.0)
        found, _, _ = probe(drawn, eye, target, Settings(tolerance=1e-7))
        errors.append(np.median(np.linalg.norm(found - r, axis=1)))
    slope = np.polyfit(np.log([n - 1 for n in resolutions]), np.log(errors), 1)[0]
    assert -2.3 < slope < -1.7, (slope, errors)
