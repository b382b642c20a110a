"""The bare solver on planes and convex quadrics: truth by construction, invariances, statuses, arrays."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import warp as wp

from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.settings import Status
from warp_reflect.solver import solve

FLOATS = (np.float32, np.float64)
NO_POINT = (
    Status.NONE,
    Status.HIDDEN,
    Status.UNREFLECTED,
    Status.DEGENERATE,
    Status.INSIDE,
    Status.BAD_INPUT,
)
SPHERE = QuadricMirror.sphere((0.0, 0.0, 0.0), 1.0)


def status_of(mirror, eye, point, dtype=np.float32) -> Status:
    return Status(int(solve(mirror, eye, np.array([point], dtype)).status[0]))


def world_mirror(name: str, pose: np.ndarray) -> QuadricMirror:
    """The surface in the world, on two-sheeted ones the sheet towards its own +z."""
    mirror = QuadricMirror.from_matrix(oracles.placed(oracles.matrix_of(name), pose))
    if mirror.max_roots == 2:
        sheet = 1 if mirror.axis @ pose[:3, 2] > 0 else -1
        return QuadricMirror.from_matrix(oracles.placed(oracles.matrix_of(name), pose), sheet=sheet)
    return mirror


def no_nan(solution) -> bool:
    return all(np.isfinite(a).all() for a in (solution.point, solution.normal, solution.virtual, solution.residual))


# --- truth


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", oracles.CONVEX)
def test_convex_points_match_constructed_truth(name, size):
    """float32: 1e-4 of the size for 99.9 % of the points; float64: 1e-9 for all. Distances over four decades."""
    rng = np.random.default_rng(abs(hash((len(name), size))) % 2**32)
    far = 1000.0 if name.startswith(("sphere", "ellipsoid")) else 100.0
    for eye_distance in (0.3, 3.0, 100.0):
        pose = oracles.random_pose(rng, size, offset=2.0)
        mirror = world_mirror(name, pose)
        truth = oracles.constructed(name, rng, 3000, eye_distance, 80.0, far / 1e4, far)
        assert len(truth.points) > 100
        eye, points = oracles.move(pose, truth.eye), oracles.move(pose, truth.points)
        expected = oracles.move(pose, truth.reflection)
        for dtype, bound, share in ((np.float32, 1e-4, 0.999), (np.float64, 1e-9, 1.0)):
            solution = solve(mirror, eye, points.astype(dtype))
            assert solution.point.dtype == dtype
            assert (solution.status == Status.CONVERGED).mean() >= share
            # Beyond a few sizes from the middle float32 coordinates are themselves coarser than the size allows.
            scale = np.maximum(1.0, np.linalg.norm(truth.reflection, axis=1) / 4.0)
            error = np.linalg.norm(solution.point - expected, axis=1) / size / scale
            assert (error <= bound).mean() >= share, np.quantile(error, [0.5, 0.95, 0.999, 1.0])
            turned = np.sum(solution.normal * (truth.normal @ pose[:3, :3].T / size), axis=1)
            assert np.quantile(turned, 1.0 - share) > 1.0 - 1e-3


@pytest.mark.parametrize("name", ["sphere", "ellipsoid 3:1:1", "paraboloid", "two sheets", "elliptic cylinder"])
def test_points_near_grazing_incidence_match_constructed_truth(name):
    """80 to 89 degrees: the bound of 1e-4 of the size still holds in float32 (the error grows with 1 / cosine)."""
    rng = np.random.default_rng(3)
    truth = oracles.constructed(name, rng, 4000, 2.0, 89.0, 0.1, 100.0)
    flat = truth.cosine < np.cos(np.radians(80.0))
    assert flat.sum() > 100
    mirror = world_mirror(name, np.eye(4))
    for dtype, bound, share in ((np.float32, 1e-4, 0.999), (np.float64, 1e-9, 1.0)):
        solution = solve(mirror, truth.eye, truth.points[flat].astype(dtype))
        scale = np.maximum(1.0, np.linalg.norm(truth.reflection[flat], axis=1) / 4.0)
        error = np.linalg.norm(solution.point - truth.reflection[flat], axis=1) / scale
        assert (error <= bound).mean() >= share
        assert (solution.status == Status.CONVERGED).mean() >= share


@pytest.mark.parametrize("name", ["ellipsoid 100:10:1", "elliptic paraboloid", "elliptic two sheets"])
def test_convex_points_match_forty_digits(name):
    rng = np.random.default_rng(5)
    truth = oracles.constructed(name, rng, 5, 2.0)
    solution = solve(world_mirror(name, np.eye(4)), truth.eye, truth.points)
    for i in range(len(truth.points)):
        exact = oracles.exact_point(oracles.matrix_of(name), truth.eye, truth.points[i], truth.reflection[i])
        assert np.linalg.norm(solution.point[i] - exact) <= 1e-12 * (1.0 + np.linalg.norm(exact))


def test_virtual_points_lie_on_the_ray_at_the_path_length():
    rng = np.random.default_rng(7)
    truth = oracles.constructed("ellipsoid 3:1:1", rng, 2000, 2.0)
    solution = solve(world_mirror("ellipsoid 3:1:1", np.eye(4)), truth.eye, truth.points)
    path = np.linalg.norm(truth.eye - truth.reflection, axis=1)
    path += np.linalg.norm(truth.points - truth.reflection, axis=1)
    sight = solution.virtual - truth.eye
    length = np.linalg.norm(sight, axis=1)
    np.testing.assert_allclose(length, path, rtol=1e-9)
    through = (truth.reflection - truth.eye) / np.linalg.norm(truth.reflection - truth.eye, axis=1)[:, None]
    assert np.abs(sight / length[:, None] - through).max() < 1e-9


def test_qim_agrees_up_to_the_flatness_of_its_minimum():
    """float32 8e-3 (the root of its rounding, at 95 %), float64 1e-6; where the curve is found it is the point."""
    rng = np.random.default_rng(11)
    for mirror in (SPHERE, QuadricMirror.rotational(4, 0, 1), QuadricMirror.rotational(0, -1, 0)):
        points = rng.normal(size=(2000, 3)) * 3.0
        for dtype, bound in ((np.float32, 8e-3), (np.float64, 1e-6)):
            best = solve(mirror, [2.0, 0.3, -1.1], points.astype(dtype))
            qim = solve(mirror, [2.0, 0.3, -1.1], points.astype(dtype), method="qim")
            both = (best.status == Status.CONVERGED) & (qim.status == Status.CONVERGED)
            assert both.sum() > 0.95 * (best.status == Status.CONVERGED).sum()
            error = np.linalg.norm(best.point - qim.point, axis=1)[both]
            assert np.quantile(error, 0.95) < bound
            assert np.median(best.residual[both]) < 0.1 * np.median(qim.residual[both])


# --- invariances


@pytest.mark.parametrize("name", ["sphere", "ellipsoid 5:5:1", "paraboloid", "cone"])
def test_exchanging_eye_and_point_changes_nothing(name):
    """To 16 roundings of the size in float32 (99 %; the condition grows towards grazing incidence)."""
    rng = np.random.default_rng(13)
    truth = oracles.constructed(name, rng, 300, 3.0, 70.0, 0.5, 5.0)
    mirror = world_mirror(name, np.eye(4))
    eyes = truth.points.astype(np.float32)
    there = solve(mirror, truth.eye.astype(np.float32), eyes)
    back = solve(mirror, eyes, truth.eye.astype(np.float32)[None])
    scale = 1.0 + np.linalg.norm(there.point, axis=1)
    error = np.linalg.norm(there.point - back.point[:, 0], axis=1) / scale
    assert np.quantile(error, 0.99) <= 16 * 2.0**-23


@pytest.mark.parametrize("exponent", [-40, -20, 30, 66])
def test_sphere_scales_exactly_by_powers_of_two(exponent):
    scale = 2.0**exponent
    rng = np.random.default_rng(17)
    points = (rng.normal(size=(200, 3)) * 3.0).astype(np.float32)
    unit = solve(SPHERE, [3.0, 0.5, 1.0], points)
    scaled = solve(
        QuadricMirror.sphere((0, 0, 0), scale), np.array([3.0, 0.5, 1.0]) * scale, points * np.float32(scale)
    )
    np.testing.assert_array_equal(scaled.status, unit.status)
    np.testing.assert_array_equal(scaled.point, unit.point * np.float32(scale))


@pytest.mark.parametrize("offset", [1e4, 1e6, 1e7])
def test_far_offset_gives_the_points_of_the_origin(offset):
    """Whole numbers are exact in float32 at 1e7: the difference is the rounding of the output alone."""
    rng = np.random.default_rng(19)
    points = np.rint(rng.normal(size=(200, 3)) * 5.0)
    eye = np.array([4.0, 1.0, 2.0])
    centre = np.array([offset, -offset, 0.5 * offset])
    near = solve(SPHERE, eye, points.astype(np.float32))
    far = solve(QuadricMirror.sphere(centre, 1.0), eye + centre, (points + centre).astype(np.float32))
    np.testing.assert_array_equal(far.status, near.status)
    found = near.status == Status.CONVERGED
    expected = (near.point[found].astype(np.float64) + centre).astype(np.float32)
    assert np.abs(far.point[found] - expected).max() <= np.spacing(np.float32(offset))
    np.testing.assert_array_equal(far.normal[found], near.normal[found])


def test_turning_the_scene_turns_the_answer():
    rng = np.random.default_rng(23)
    truth = oracles.constructed("ellipsoid 3:1:1", rng, 500, 2.0, 75.0, 0.1, 10.0)
    for _ in range(3):
        pose = oracles.random_pose(rng)
        solution = solve(
            world_mirror("ellipsoid 3:1:1", pose), oracles.move(pose, truth.eye), oracles.move(pose, truth.points)
        )
        assert np.abs(solution.point - oracles.move(pose, truth.reflection)).max() < 1e-12


def test_start_changes_nothing_but_rounding():
    rng = np.random.default_rng(29)
    truth = oracles.constructed("ellipsoid 100:10:1", rng, 2000, 2.0)
    mirror = world_mirror("ellipsoid 100:10:1", np.eye(4))
    points = truth.points.astype(np.float32)
    cold = solve(mirror, truth.eye, points)
    moved = (truth.points * 1.01).astype(np.float32)
    warm, fresh = solve(mirror, truth.eye, moved, start=cold), solve(mirror, truth.eye, moved)
    np.testing.assert_array_equal(warm.status, fresh.status)
    assert np.quantile(np.linalg.norm(warm.point - fresh.point, axis=1), 0.999) < 1e-4
    cold.point[:] = np.nan
    np.testing.assert_array_equal(solve(mirror, truth.eye, points, start=cold).status, fresh.status * 0 + 1)


def test_threads_give_equal_bits():
    rng = np.random.default_rng(31)
    points = (rng.normal(size=(20000, 3)) * 3.0).astype(np.float32)
    one, three = (solve(SPHERE, [3.0, 0.5, 1.0], points, threads=t) for t in (1, 3))
    np.testing.assert_array_equal(one.point, three.point)
    np.testing.assert_array_equal(one.status, three.status)


# --- hard cases


@pytest.mark.parametrize(
    ("eye", "point", "expected"),
    [
        ((3, 1, 0), (3, 1, 0), Status.CONVERGED),
        ((3, 0, 0), (-5, 0, 0), Status.HIDDEN),
        ((3, 0, 0), (-3, 0, 0), Status.HIDDEN),
        ((3, 0, 0), (-3, 0.2, 0), Status.HIDDEN),
        ((1, 0, 0), (3, 0, 0), Status.BAD_INPUT),
        ((3, 0, 0), (1, 0, 0), Status.CONVERGED),
        ((3, 0, 0), (0.6, 0.8, 0), Status.CONVERGED),
        ((3, 0, 0), (-0.6, 0.8, 0), Status.HIDDEN),
        ((0.5, 0, 0), (3, 0, 0), Status.INSIDE),
        ((3, 0, 0), (0.5, 0, 0), Status.INSIDE),
        ((3, 0, 0), (np.nan, 0, 1), Status.BAD_INPUT),
        ((3, 0, 0), (np.inf, 0, 1), Status.BAD_INPUT),
        ((np.nan, 0, 0), (2, 0, 1), Status.BAD_INPUT),
        ((0, -np.inf, 0), (2, 0, 1), Status.BAD_INPUT),
        ((3, 0, 0), (0, 1e4, 0), Status.CONVERGED),
        ((3, 0, 0), (0, 1e30, 0), Status.CONVERGED),
    ],
)
@pytest.mark.parametrize("dtype", FLOATS)
def test_sphere_status(eye, point, expected, dtype):
    solution = solve(SPHERE, eye, np.array([point], dtype))
    assert Status(int(solution.status[0])) == expected
    assert no_nan(solution)
    if expected in NO_POINT:
        assert not solution.point.any() and not solution.virtual.any() and not solution.residual.any()


def test_coincident_eye_and_point_reflect_at_the_foot_of_the_normal():
    for dtype, bound in ((np.float32, 32 * 6e-8), (np.float64, 32 * 1.2e-16)):
        solution = solve(SPHERE, [3.0, 1.0, -2.0], np.array([[3.0, 1.0, -2.0]], dtype))
        foot = np.array([3.0, 1.0, -2.0]) / np.sqrt(14.0)
        assert np.abs(solution.point[0] - foot).max() <= bound


@pytest.mark.parametrize("height", [0.0, 1e-7, -1e-7])
def test_point_on_the_surface_is_its_own_reflection(height):
    point = np.array([0.6, 0.8, 0.0]) * (1.0 + height)
    solution = solve(SPHERE, [3.0, 2.0, 0.0], point.astype(np.float32)[None])
    assert solution.status[0] == Status.CONVERGED
    assert np.abs(solution.point[0] - [0.6, 0.8, 0.0]).max() <= 32 * 6e-8
    assert np.abs(solution.virtual[0] - [0.6, 0.8, 0.0]).max() <= 32 * 6e-8


@pytest.mark.parametrize("degrees", [80.0, 89.0, 89.9, 89.99, 89.9999])
@pytest.mark.parametrize("dtype", FLOATS)
def test_grazing_incidence_is_resolved_or_flagged(degrees, dtype):
    """64 roundings over the cosine up to 89 degrees; above, 3e-3 of the radius or the status GRAZING."""
    angle = np.radians(degrees)
    eye = np.array([1.0 + 2.0 * np.cos(angle), 2.0 * np.sin(angle), 0.0]).astype(dtype)
    point = np.array([1.0 + 3.0 * np.cos(angle), -3.0 * np.sin(angle), 0.0]).astype(dtype)
    solution = solve(SPHERE, eye, point[None])
    error = np.linalg.norm(solution.point[0] - [1.0, 0.0, 0.0])
    if degrees <= 89.0:
        assert solution.status[0] == Status.CONVERGED
        assert error <= 64 * np.finfo(dtype).eps / np.cos(angle)
    else:
        assert solution.status[0] in (Status.CONVERGED, Status.GRAZING)
        assert error <= 3e-3
    if dtype is np.float32 and degrees > 89.95:
        assert solution.status[0] == Status.GRAZING


def test_cone_apex_has_no_normal():
    """Eye and point before the apex, outside the reach of every normal of the surface."""
    cone = QuadricMirror.rotational(-1.0, 0.0, 0.0, sheet=1)
    assert status_of(cone, [0.1, 0.0, -3.0], [-0.2, 0.0, -2.0]) == Status.DEGENERATE


def test_hyperboloid_camera_at_the_other_focus_sees_the_other_sheet():
    """The catadioptric set-up: a ray from one focus leaves as if it came from the other."""
    mirror = QuadricMirror.rotational(-1.0, 0.0, -1.0)
    focus = np.sqrt(2.0)
    rng = np.random.default_rng(37)
    r = rng.normal(size=(200, 3))
    r[:, 2] = np.sqrt(1.0 + r[:, 0] ** 2 + r[:, 1] ** 2)
    away = r - [0.0, 0.0, focus]
    # Seen from the focus below, the upper sheet sends every ray straight away from the focus above.
    points = r + 2.0 * away / np.linalg.norm(away, axis=1)[:, None]
    outside = points[:, 2] ** 2 - points[:, 0] ** 2 - points[:, 1] ** 2 < 1.0
    solution = solve(mirror, [0.0, 0.0, -focus], points[outside])
    assert (solution.status == Status.CONVERGED).all()
    assert np.abs(solution.point - r[outside]).max() < 1e-11


def test_random_hard_inputs_never_give_nan():
    """Log-uniform coordinates over 16 decades with zeros, infinities and NaN, every kind and side."""
    rng = np.random.default_rng(41)
    for name in oracles.SURFACES:
        for side in ("outer", "inner"):
            mirror = QuadricMirror.from_matrix(oracles.matrix_of(name), side=side)
            count = 400 if mirror.convex else 100
            points = rng.choice([-1.0, 1.0], (count, 3)) * 10.0 ** rng.uniform(-8, 8, (count, 3))
            points[rng.random((count, 3)) < 0.2] = 0.0
            points[rng.random((count, 3)) < 0.02] = np.nan
            points[rng.random((count, 3)) < 0.02] = np.inf
            eyes = np.concatenate([rng.normal(size=(3, 3)) * 2.0, [[0, 0, 0], [0, 0, 5], [1e8, 0, 1], [0.5, 0.5, 0]]])
            for dtype in FLOATS:
                solution = solve(mirror, eyes, points.astype(dtype))
                assert no_nan(solution), (name, side)
                assert np.isin(solution.status, [int(s) for s in Status if s != Status.NONE]).all()
                empty = np.isin(solution.status, NO_POINT)
                assert not solution.point[empty].any() and not solution.normal[empty].any()
                bad = ~np.isfinite(points).all(axis=1)
                assert (solution.status[:, bad] == Status.BAD_INPUT).all()
                good = solution.status == Status.CONVERGED
                assert (solution.residual[good] < 0.1).all()


# --- planes


@pytest.mark.parametrize("normal", [(0, -1, 0), (1e-3, -1, 0), (3e-4, -1, 0), (0, 0, 1e-25), (3, -4, 12)])
@pytest.mark.parametrize("dtype", FLOATS)
def test_plane_mirrors_the_point(normal, dtype):
    rng = np.random.default_rng(43)
    n = np.array(normal, float) / np.abs(normal).max()
    n /= np.linalg.norm(n)
    origin = np.array([0.5, -2.0, 1.0])
    points = rng.normal(size=(100, 3)) + origin
    eye = origin + 3.0 * n + np.cross(n, [0.3, 0.2, 0.9])
    solution = solve(PlanarMirror(origin, normal), eye, points.astype(dtype))
    height = (points - origin) @ n
    front = height > 1e-5
    np.testing.assert_array_equal(solution.status[front], Status.CONVERGED)
    np.testing.assert_array_equal(solution.status[height < -1e-5], Status.HIDDEN)
    eps = np.finfo(dtype).eps
    expected = points - 2.0 * height[:, None] * n
    assert np.abs(solution.virtual - expected)[front].max() <= 8 * eps * 5.0
    assert np.abs((solution.point - origin) @ n)[front].max() <= 8 * eps * 5.0
    assert solution.residual[front].max() <= 1e-6


def test_plane_mirrors_twice_to_itself():
    rng = np.random.default_rng(47)
    points = rng.normal(size=(200, 3)).astype(np.float32)
    points[:, 2] = np.abs(points[:, 2]) + 0.1
    once = solve(PlanarMirror((0, 0, 0), (0.1, 0.2, 1)), (0, 0, 9), points)
    seen = once.status == Status.CONVERGED
    back = solve(PlanarMirror((0, 0, 0), (0.1, 0.2, 1), side="inner"), (0, 0, -9), once.virtual[seen])
    assert np.abs(back.virtual - points[seen]).max() <= 8 * 2.0**-23 * np.abs(points).max()


@pytest.mark.parametrize("offset", [0.0, 1e7])
def test_plane_status(offset):
    mirror = PlanarMirror((offset, 0, 0), (0, 0, 1), extent=(2.0, 1.0))
    assert status_of(mirror, (offset, 0, 0), (offset, 0, 1)) == Status.HIDDEN
    assert status_of(mirror, (offset, 0, -1), (offset, 0, 1)) == Status.HIDDEN
    assert status_of(mirror, (offset, 0, 1), (offset, 0, -1)) == Status.HIDDEN
    assert status_of(mirror, (offset, 0, 1), (offset, 0, 0)) == Status.CONVERGED
    assert status_of(mirror, (offset, 0, 1), (offset + 3, 0, 1)) == Status.CONVERGED
    assert status_of(mirror, (offset, 0, 1), (offset + 5, 0, 1)) == Status.OUT_OF_EXTENT
    assert status_of(mirror, (offset, 0, 1), (offset, 3, 1)) == Status.OUT_OF_EXTENT


@pytest.mark.parametrize("height", [0.0, 1e-9, -1e-9, 1e-7])
def test_eye_in_a_tilted_plane_is_hidden(height):
    """Within 8 roundings of the terms of its height."""
    normal = np.array([1.0, 2.0, -2.0]) / 3.0
    eye = np.array([2.0, 0.0, 1.0]) + height * normal
    assert status_of(PlanarMirror((0, 0, 0), normal), eye, normal * 2.0) == Status.HIDDEN


def test_plane_extent_follows_up():
    """Width along up x normal, height along up; world +Y unless another is given."""
    flat = {"point": (0, 0, 0), "normal": (0, 0, 1), "extent": (3.0, 1.0)}
    along_x, along_y = (4.0, 0.0, 1.0), (0.0, 4.0, 1.0)
    assert status_of(PlanarMirror(**flat), (0, 0, 1), along_x) == Status.CONVERGED
    assert status_of(PlanarMirror(**flat), (0, 0, 1), along_y) == Status.OUT_OF_EXTENT
    assert status_of(PlanarMirror(**flat, up=(1, 0, 0)), (0, 0, 1), along_x) == Status.OUT_OF_EXTENT
    assert status_of(PlanarMirror(**flat, up=(1, 0, 0)), (0, 0, 1), along_y) == Status.CONVERGED
    floor = PlanarMirror((0, 0, 0), (0, 1, 0), extent=(3.0, 1.0))
    assert status_of(floor, (0, 1, 0), (4, 1, 0)) == Status.CONVERGED
    assert status_of(floor, (0, 1, 0), (0, 1, 4)) == Status.OUT_OF_EXTENT


# --- arrays in and out


class Foreign:
    """An array of another library: DLPack and a module with from_dlpack is all that is asked."""

    def __init__(self, array):
        self.array = np.asarray(array) if not isinstance(array, wp.array) else array.numpy()

    def __dlpack__(self, **keywords):
        return self.array.__dlpack__()

    def __dlpack_device__(self):
        return self.array.__dlpack_device__()

    def __array_namespace__(self):
        return Foreign

    @staticmethod
    def from_dlpack(array):
        return Foreign(np.from_dlpack(array))


POINTS = np.array([[3.0, 2.0, 0.0], [0.5, 2.0, 2.0], [-4.0, 0.0, 0.0]])
EYE = (4.0, 0.0, 0.5)


@pytest.mark.parametrize("dtype", FLOATS)
def test_arrays_come_back_in_their_library_and_type(dtype, device):
    expected = solve(SPHERE, EYE, POINTS.astype(dtype), device=device)
    assert isinstance(expected.point, np.ndarray) and expected.point.dtype == dtype
    assert expected.residual.dtype == dtype and expected.status.dtype == np.uint8
    vector = wp.vec3 if dtype is np.float32 else wp.vec3d
    as_vectors = solve(SPHERE, EYE, wp.array(POINTS, dtype=vector, device=device))
    assert as_vectors.point.dtype is vector and as_vectors.point.shape == (3,)
    np.testing.assert_array_equal(as_vectors.virtual.numpy(), expected.virtual)
    scalar = wp.float32 if dtype is np.float32 else wp.float64
    as_floats = solve(SPHERE, EYE, wp.array(POINTS, dtype=scalar, device=device))
    assert as_floats.point.dtype is scalar and as_floats.point.shape == (3, 3)
    np.testing.assert_array_equal(as_floats.point.numpy(), expected.point)
    expected = solve(SPHERE, EYE, POINTS.astype(dtype), device="cpu")  # where the foreign array lies
    foreign = solve(SPHERE, EYE, Foreign(POINTS.astype(dtype)))
    assert isinstance(foreign.point, Foreign) and foreign.point.array.dtype == dtype
    np.testing.assert_array_equal(foreign.point.array, expected.point)
    np.testing.assert_array_equal(foreign.status.array, expected.status)


def test_lists_and_integers_count_as_float64():
    solution = solve(SPHERE, [4, 0, 1], [[3, 2, 0], [0, 2, 2]])
    assert solution.point.dtype == np.float64 and solution.point.shape == (2, 3)


def test_shapes_follow_eyes_and_points():
    one = solve(SPHERE, EYE, POINTS[0])
    assert one.point.shape == (3,) and one.status.shape == ()
    grid = solve(SPHERE, EYE, np.broadcast_to(POINTS, (2, 3, 3)).copy())
    assert grid.point.shape == (2, 3, 3) and grid.status.shape == (2, 3)
    eyes = np.array([EYE, (0.0, 4.0, 0.0)])
    both = solve(SPHERE, eyes, POINTS)
    assert both.point.shape == (2, 3, 3) and both.residual.shape == (2, 3)
    for i, eye in enumerate(eyes):
        np.testing.assert_array_equal(both.point[i], solve(SPHERE, eye, POINTS).point)
    assert solve(SPHERE, EYE, np.zeros((0, 3))).point.shape == (0, 3)


def test_inputs_are_left_alone():
    points = POINTS.astype(np.float32)
    points.flags.writeable = False
    before = points.copy()
    solve(SPHERE, EYE, points)
    np.testing.assert_array_equal(points, before)


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: solve(SPHERE, EYE, np.zeros((3, 2))), ValueError, "points: got shape (3, 2)"),
        (lambda: solve(SPHERE, np.zeros((2, 2, 3)), POINTS), ValueError, "eye: got shape (2, 2, 3)"),
        (lambda: solve(SPHERE, EYE, np.array([["a", "b", "c"]])), TypeError, "points"),
        (lambda: solve("sphere", EYE, POINTS), TypeError, "got str"),
        (lambda: solve(SPHERE, EYE, POINTS, method="magic"), ValueError, "newton, qim"),
        (lambda: solve(SPHERE, EYE, POINTS, start=solve(SPHERE, EYE, POINTS[:2])), ValueError, "start"),
        (lambda: solve(PlanarMirror((0, 0, 0), (0, 0, 1)), EYE, POINTS, method="qim"), ValueError, "plane"),
        (lambda: PlanarMirror((0, 0, 0), (0, 0, 0)), ValueError, "normal"),
        (lambda: PlanarMirror((0, 0, np.nan), (0, 0, 1)), ValueError, "point"),
        (lambda: PlanarMirror((0, 0, 0), (0, 0, 1), extent=(1, -1)), ValueError, "extent"),
        (lambda: PlanarMirror((0, 0, 0), (0, 0, 1), up=(0, 0, 2)), ValueError, "up"),
        (lambda: PlanarMirror((0, 0, 0), (0, 0, 1), side="left"), ValueError, "side"),
        (lambda: QuadricMirror.sphere((0, 0, 0), -1.0), ValueError, "radius"),
        (lambda: QuadricMirror.sphere((0, np.inf, 0), 1.0), ValueError, "center"),
        (lambda: QuadricMirror.from_matrix(np.eye(3)), ValueError, "(3, 3)"),
        (lambda: QuadricMirror.rotational(1, 0, 1, sheet=1), ValueError, "ellipsoid has one part"),
        (lambda: QuadricMirror.rotational(1, 0, 1, np.zeros((4, 4))), ValueError, "last row"),
    ],
)
def test_refusals_name_the_argument(call, error, text):
    with pytest.raises(error) as caught:
        call()
    assert text in str(caught.value)
