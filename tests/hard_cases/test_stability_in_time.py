"""Along a slow path of the eye answers move smoothly: no jump where an iteration count or a texel changes."""

from __future__ import annotations

import dataclasses

import numpy as np
import oracles
import pytest
from rooms import placed, room, sphere

import warp_reflect as wr
from warp_reflect.layers import Camera
from warp_reflect.settings import Status

STEPS = 160
TURN = 1e-3  # radians of a step


def path(start=(1.5, 1.2, 2.0)) -> np.ndarray:
    """Eyes on an arc around the z axis that rises a little, [STEPS, 3]."""
    t = TURN * np.arange(STEPS)
    x, y, z = start
    return np.stack([x * np.cos(t) - y * np.sin(t), x * np.sin(t) + y * np.cos(t), z + 0.5 * t], 1)


def second_difference(values: np.ndarray) -> np.ndarray:
    """Length of the second difference along the first axis."""
    return np.linalg.norm(values[2:] - 2.0 * values[1:-1] + values[:-2], axis=-1)


def around(rng, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * rng.uniform(1.6, 6.0, (count, 1))


@pytest.fixture(scope="module")
def body_map():
    mesh = sphere(48, 96)
    return wr.ReflectorMap.from_mesh(mesh.points * np.array([1.0, 0.7, 0.5]), mesh.triangles, resolution=96)


ELLIPSOID = np.diag([1.0, 1 / 0.49, 4.0, -1.0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["ellipsoid", "hollow", "map"])
def test_points_move_smoothly_with_the_eye(name, dtype, body_map):
    """Second differences are those of the smooth path (TURN squared) plus the rounding, or the map's own error."""
    rng = np.random.default_rng(21)
    if name == "hollow":  # the eye within a hollow sphere of radius 8
        mirror, points = wr.QuadricMirror.sphere((0, 0, 0), 8.0, side="inner"), 0.5 * around(rng, 60)
    else:
        mirror, points = (body_map if name == "map" else wr.QuadricMirror.from_matrix(ELLIPSOID)), around(rng, 200)
    solution = wr.solve(mirror, path(), points.astype(dtype))
    always = (solution.status == Status.CONVERGED).all(axis=0)
    assert always.sum() >= 20
    # A texel of a map of n = 96: the bilinear surface and its normals kink by h^2 where the path crosses an edge.
    texel = (2.0 / 95) ** 2
    size = 8.0 if name == "hollow" else 1.0
    for values, reach in ((solution.point, size), (solution.virtual, 6.0 * size)):
        moved = values[:, always].astype(np.float64)
        rough = second_difference(moved)
        step = np.linalg.norm(np.diff(moved, axis=0), axis=-1)
        rounding = 8 * np.finfo(dtype).eps * np.abs(moved).max()
        if name == "map":
            assert rough.max() <= reach * texel
        else:
            # 40: the path's own curvature, over the cosine of incidence to its third power near the silhouette.
            assert (np.quantile(rough, 0.95, axis=0) <= 40 * reach * TURN**2 + rounding).all()
        # A root of a hollow mirror may end at a caustic, and another takes over, once; it does not come and go.
        jumps = (step > 20 * reach * TURN + rounding).sum(axis=0)
        assert jumps.max() <= (1 if name == "hollow" else 0)


@pytest.mark.parametrize("name", ["ellipsoid", "map"])
def test_statuses_do_not_flicker(name, body_map):
    """A point seen from an eye on an arc is hidden or seen in a few runs at most, and float32 says what float64 says."""
    mirror = body_map if name == "map" else wr.QuadricMirror.from_matrix(ELLIPSOID)
    points = around(np.random.default_rng(22), 400)
    for dtype in (np.float32, np.float64):
        status = wr.solve(mirror, path(), points.astype(dtype)).status.astype(int)
        # Where it passes the silhouette, a map of bilinear texels may say that it found nothing for a step.
        assert (status == Status.MAX_ITERATIONS).mean() <= (1e-3 if name == "map" else 0.0)
        seen = np.isin(status, [Status.CONVERGED, Status.GRAZING, Status.MAX_ITERATIONS])
        assert (seen | (status == Status.HIDDEN)).all()
        changes = np.abs(np.diff(seen.astype(int), axis=0)).sum(axis=0)
        assert changes.max() <= 2 and (changes > 0).sum() >= 3


def test_residuals_stay_at_rounding_along_the_path():
    """No step of the path is answered with fewer digits than its neighbours."""
    rng = np.random.default_rng(23)
    mirror = wr.QuadricMirror.from_matrix(oracles.matrix_of("ellipsoid 100:10:1"))
    points = around(rng, 200)
    for dtype, floor in ((np.float32, 1e-6), (np.float64, 1e-11)):
        solution = wr.solve(mirror, path((1.5, 1.2, 0.8)), points.astype(dtype))
        found = solution.status == Status.CONVERGED
        assert found.mean() > 0.3
        assert solution.residual[found].max() <= floor


@pytest.mark.parametrize("method", ["reference", "quadric", "reflector_map", "layered_environment"])
def test_pixels_of_a_mirror_move_smoothly(method):
    """What a fixed pixel of the mirror shows of the floor slides as smoothly as the eye: no pixel jumps and returns."""
    scene = room(sphere(48, 96), placed(0, 0, -1))
    camera = scene.data.cameras[0]
    plan = wr.make_plan(scene, size=(64, 36), method=method)
    shown, what, mirror, previous = [], [], [], None
    for k in range(9):
        matrix = camera.world_from_camera.copy()
        matrix[:3, 3] += 0.002 * k * np.array([1.0, 0.3, 0.1])
        moved = dataclasses.replace(camera, world_from_camera=matrix)
        view = Camera.from_data(moved, (64, 36))
        previous = wr.render_frame(scene, plan, camera=view, previous=previous)
        shown.append(previous["reflectedPoint"].astype(np.float64))
        what.append(np.where(previous["status"] == Status.CONVERGED, previous["reflectedId"], -1.0))
        mirror.append(previous["mirrorPoint"].astype(np.float64))
    floor = next(number for number, prim in previous.prims.items() if prim == "/floor")
    shown, same = np.array(shown), (np.array(what) == int(floor)).all(axis=0)
    assert same.sum() > 60
    step = np.linalg.norm(np.diff(shown, axis=0), axis=-1)[:, same]
    rough = second_difference(shown)[:, same]
    # The reflected ray's slope on the floor grows towards the horizon, and with it the step: a share of it is curvature.
    # A local map shows another triangle's plane from a texel on: of the floor as much as a texel sees, at its grazing angle.
    legs = (shown - np.array(mirror))[1:-1, same]
    texel = 2.0 / plan.settings.environment_resolution * (legs**2).sum(axis=-1) / np.abs(legs[..., 1])
    mapped = method == "layered_environment"
    assert (rough <= 0.1 * step[1:] + 1e-4).mean() > (0.97 if mapped else 0.98)
    assert (rough <= 0.5 * step[1:] + 1e-3 + mapped * texel).all()
