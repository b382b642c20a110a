"""A scene as a field, against the ray tracer and against what is known of small towns."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import rooms
import warp as wp

import warp_reflect as wr
from warp_reflect import scene_field
from warp_reflect.scene import CameraData, InstanceData, MaterialData, MeshData, Scene, SceneData
from warp_reflect.scene_field import make_field, reached_space
from warp_reflect.settings import Status
from warp_reflect.voxels import voxelise

BOX_FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2)]
    + [(1, 3, 7), (1, 7, 5)],
    np.int32,
)
SWAP = {"Z": [0, 1, 2], "Y": [0, 2, 1]}  # towns are built with Z up


def box(low, high) -> np.ndarray:
    low, high = np.array(low, float), np.array(high, float)
    return np.array([np.where([k & 1, k & 2, k & 4], high, low) for k in range(8)])


def town(boxes, device, up: str = "Z", offset=(0.0, 0.0, 0.0), ground: float = 20.0, eyes=()) -> Scene:
    """Boxes on a square ground at height 0."""
    bodies = [box((-ground, -ground, -0.5), (ground, ground, 0.0)), *(box(*each) for each in boxes)]
    meshes = [MeshData(body[:, SWAP[up]].astype(np.float32), BOX_FACES) for body in bodies]
    place = np.eye(4)
    place[:3, 3] = offset
    instances = [InstanceData(k, place, f"/box{k}", (0,)) for k in range(len(meshes))]
    cameras = []
    for k, eye in enumerate(eyes):
        camera = place.copy()
        camera[:3, 3] += np.array(eye, float)[SWAP[up]]
        cameras.append(CameraData(f"/camera{k}", camera))
    data = SceneData("town", meshes, instances, [MaterialData()], [], cameras, up_axis=up)
    return Scene(data, device)


HOUSES = [
    ((-12.0, -12.0, 0.0), (-6.0, -5.0, 9.0)),
    ((-3.0, -12.0, 0.0), (4.0, -6.0, 5.0)),
    ((6.0, 3.0, 0.0), (14.0, 12.0, 12.0)),
    ((-12.0, 2.0, 0.0), (-4.0, 12.0, 7.0)),
]
ARCH = [((-2.0, 6.0, 0.0), (-1.0, 8.0, 6.0)), ((3.0, 6.0, 0.0), (4.0, 8.0, 6.0)), ((-1.0, 6.0, 4.0), (3.0, 8.0, 6.0))]
CLOSED_ROOM = [
    ((-10.0, -10.0, 0.0), (-9.0, 10.0, 8.0)),
    ((9.0, -10.0, 0.0), (10.0, 10.0, 8.0)),
    ((-9.0, -10.0, 0.0), (9.0, -9.0, 8.0)),
    ((-9.0, 9.0, 0.0), (9.0, 10.0, 8.0)),
    ((-10.0, -10.0, 8.0), (10.0, 10.0, 9.0)),
]


def rays_above(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the free space over a town, mostly level and downwards."""
    rng = np.random.default_rng(seed)
    origins = np.column_stack([rng.uniform(-18, 18, (count, 2)), rng.uniform(0.5, 14, count)])
    directions = rng.normal(size=(count, 3)) * (1.0, 1.0, 0.4)
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_device(scene: Scene, origins: np.ndarray, directions: np.ndarray, up: str = "Z", offset=(0.0, 0.0, 0.0)):
    """The same rays in the scene frame."""
    arrays = (origins[:, SWAP[up]] + np.asarray(offset) - scene.origin, directions[:, SWAP[up]])
    return [wp.array(x.astype(np.float32), dtype=wp.vec3, device=scene.device) for x in arrays]


@pytest.mark.parametrize("kind", ["heightfield", "occupancy"])
def test_field_shows_what_the_tracer_shows_within_a_cell(kind, device):
    scene = town(HOUSES, device)
    field = make_field(scene, wr.Settings(field_kind=kind, field_cell=0.25))
    rays = on_device(scene, *rays_above(6000))
    trace = field.intersect(*rays)
    triangle, distance, _, _ = scene.tracer.trace(*rays)
    status, t = trace.status.numpy(), trace.t.numpy()
    outside = status != Status.INSIDE  # some rays start within a house
    hit = outside & (triangle.numpy() >= 0)
    assert hit.sum() > 1500
    assert np.mean((status == Status.CONVERGED)[outside] == (triangle.numpy() >= 0)[outside]) > 0.97
    both = hit & (status == Status.CONVERGED)
    off = np.abs(t - distance.numpy())[both] / field.cell
    assert np.median(off) < 0.6 and np.quantile(off, 0.9) < 2.5
    owner = scene.host_triangle_patch
    assert np.mean(owner[trace.triangle.numpy()[both]] == owner[triangle.numpy()[both]]) > 0.95
    assert (trace.triangle.numpy()[status != Status.CONVERGED] == -1).all()
    normal = trace.normal.numpy()
    np.testing.assert_allclose(np.abs(normal).sum(axis=1), status == Status.CONVERGED)


def test_level_roofs_and_grounds_are_exact_in_both(device):
    """Straight down on the middles of roofs, and on the ground: the height itself, whatever the cell."""
    scene = town(HOUSES, device)
    at = np.array([(*(0.5 * (np.array(low) + high))[:2], 20.0) for low, high in HOUSES] + [(17.0, -17.0, 20.0)])
    for kind in ("heightfield", "occupancy"):
        field = make_field(scene, wr.Settings(field_kind=kind, field_cell=0.7))
        trace = field.intersect(*on_device(scene, at, np.tile((0.0, 0.0, -3.0), (5, 1))))
        heights = [high[2] for _, high in HOUSES] + [0.0]
        np.testing.assert_allclose(trace.t.numpy(), 20.0 - np.array(heights), atol=2e-5)
        assert (trace.normal.numpy() == (0.0, 0.0, 1.0)).all()


def test_overhang_decides_between_the_two_and_says_so(device):
    open_town = make_field(town(HOUSES, device), wr.Settings())
    assert open_town.kind == "heightfield" and open_town.overhang == 0.0
    assert "0.0 % of the columns have free space under a roof, <= 2 % (field_overhang)" in open_town.reason
    arch = make_field(town(HOUSES + ARCH, device), wr.Settings(field_overhang=0.001))
    assert arch.kind == "occupancy"
    # 4 x 2 under the bridge of a ground of 40 x 40; the grid of the measurement is coarse.
    assert arch.overhang == pytest.approx(8.0 / 1600.0, rel=0.35)
    assert make_field(town(HOUSES + ARCH, device), wr.Settings()).kind == "heightfield"
    forced = make_field(town(HOUSES, device), wr.Settings(field_kind="occupancy"))
    assert forced.overhang is None and "field_kind=occupancy" in forced.reason


def test_grid_holds_what_is_below_an_arch(device):
    scene = town(HOUSES + ARCH, device)
    through = on_device(scene, np.array([(1.0, -4.0, 2.0)]), np.array([(0.0, 1.0, 0.0)]))
    grid = make_field(scene, wr.Settings(field_kind="occupancy", field_cell=0.2))
    assert grid.intersect(*through).status.numpy()[0] == Status.SKY
    assert make_field(scene, wr.Settings(field_kind="heightfield", field_cell=0.2)).intersect(*through).t.numpy()[
        0
    ] == pytest.approx(10.0, abs=0.2)
    below = grid.intersect(*on_device(scene, np.array([(1.0, 7.0, 1.0)]), np.array([(0.0, 0.0, 1.0)])))
    assert below.t.numpy()[0] == pytest.approx(3.0, abs=1e-4) and below.normal.numpy()[0, 2] == -1.0


def test_closed_room_is_a_grid_only_for_a_camera_within(device):
    inside = make_field(town(CLOSED_ROOM, device, eyes=[(0.0, 0.0, 2.0)]), wr.Settings())
    assert inside.kind == "occupancy" and inside.overhang > 0.1
    outside = make_field(town(CLOSED_ROOM, device, eyes=[(0.0, 0.0, 30.0)]), wr.Settings())
    assert outside.kind == "heightfield" and outside.overhang == 0.0


@pytest.mark.parametrize("kind", ["heightfield", "occupancy"])
def test_field_is_the_same_for_any_up_axis_and_offset(kind, device):
    settings = wr.Settings(field_kind=kind)
    origins, directions = rays_above(2000, 1)
    plain = town(HOUSES, device)
    field = make_field(plain, settings)
    expected = field.intersect(*on_device(plain, origins, directions))
    for up, offset in (("Y", (0.0, 0.0, 0.0)), ("Z", (1e7, -1e7, 3e6))):
        scene = town(HOUSES, device, up, offset)
        other = make_field(scene, settings).intersect(*on_device(scene, origins, directions, up, offset))
        same = expected.status.numpy() == other.status.numpy()
        assert same.mean() > 0.995
        close = np.isclose(expected.t.numpy()[same], other.t.numpy()[same], rtol=1e-3, atol=2.0 * field.cell)
        assert close.mean() > 0.995
        turned = other.normal.numpy()[same][:, SWAP[up]] == expected.normal.numpy()[same]
        assert turned.all(axis=1).mean() > 0.99


def test_parts_that_are_left_out_are_not_met(device):
    scene = rooms.room(rooms.sphere(), rooms.placed(0, 0, 0))
    at = on_device(scene, np.array([(0.0, 0.0, 3.0)]), np.array([(0.0, 0.0, -1.0)]))
    settings = wr.Settings(field_kind="occupancy", field_cell=0.1)
    mirror = make_field(scene, settings).intersect(*at)
    assert mirror.t.numpy()[0] == pytest.approx(2.0, abs=0.1)
    assert scene.host_triangle_patch[mirror.triangle.numpy()[0]] == 0
    without = make_field(scene, settings, without=[0]).intersect(*at)
    assert without.status.numpy()[0] != Status.CONVERGED or without.t.numpy()[0] > 2.5
    assert make_field(scene, settings, without=range(len(scene.parts))) is None


def test_bad_rays_get_a_status(device):
    scene = town(HOUSES, device)
    origins = np.array([(0.0, 0.0, 3.0), (np.nan, 0.0, 3.0), (0.0, 0.0, 3.0), (0.0, 0.0, 3.0), (0.0, 0.0, -0.2)])
    directions = np.array([(0, 0, 0), (1, 0, 0), (np.inf, 0, 0), (0, 0, -1e-20), (1, 0, 0)], float)
    for kind in ("heightfield", "occupancy"):
        trace = make_field(scene, wr.Settings(field_kind=kind)).intersect(*on_device(scene, origins, directions))
        expected = [Status.DEGENERATE, Status.BAD_INPUT, Status.BAD_INPUT, Status.CONVERGED]
        assert trace.status.numpy()[:4].tolist() == expected
        assert np.isfinite(trace.t.numpy()).all() and np.isfinite(trace.normal.numpy()).all()


def test_cell_that_is_too_small_is_made_larger_and_told(device, monkeypatch):
    monkeypatch.setattr(scene_field, "COLUMNS_MAX", 10000)
    monkeypatch.setattr(scene_field, "GRID_CELLS_MAX", 10000)
    scene = town(HOUSES, device)
    for kind, columns in (("heightfield", 80), ("occupancy", 30)):
        settings = wr.Settings(field_kind=kind, field_cell=0.2)
        field = make_field(scene, settings)
        assert 0.2 < field.cell <= 40.0 / (columns / 2) and "cells of 0.2 would be too many" in field.reason
        settings = settings.replace(field_cell=2.5)
        assert make_field(scene, settings).cell == 2.5 and "too many" not in make_field(scene, settings).reason
    flat = town([], device, ground=5.0)
    flat = Scene(dataclasses.replace(flat.data, instances=flat.data.instances[:1]), device)
    assert make_field(flat, wr.Settings()).kind == "heightfield"
    for bad in ({"field_kind": "fog"}, {"field_cell": -1.0}, {"field_overhang": 2.0}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            wr.Settings(**bad)


def test_voxels_are_the_cells_that_samples_of_the_triangles_lie_in(device):
    rng = np.random.default_rng(3)
    shape = (12, 9, 7)
    points = rng.uniform(0.2, 0.8, (60, 3)) * shape
    points[:20] = np.round(points[:20] * 2) / 2
    triangles = rng.integers(0, 60, (40, 3))
    cells, spans, owner = voxelise(points, triangles, shape, device)
    assert len(np.unique(cells, axis=0)) == len(cells)
    held = np.zeros(shape, bool)
    held[tuple(cells.T)] = True
    low, high = np.zeros(shape), np.zeros(shape)
    low[tuple(cells.T)], high[tuple(cells.T)] = spans.T
    weights = rng.dirichlet(np.ones(3), 4000)
    for a, b, c in points[triangles]:
        samples = (weights @ np.array([a, b, c])).astype(np.float32).astype(float)
        # Samples on a border may be counted to either side.
        samples = samples[(np.abs(samples - np.round(samples)) > 1e-3).all(axis=1)]
        at = tuple(np.floor(samples).astype(int).T)
        assert held[at].all()
        assert (samples[:, 2] >= low[at] - 1e-3).all() and (samples[:, 2] <= high[at] + 1e-3).all()
    boxes = np.sort(points[triangles[owner]], axis=1)
    assert (cells + 1 >= boxes[:, 0] - 1e-3).all() and (cells <= boxes[:, 2] + 1e-3).all()
    assert voxelise(points, triangles, shape, device, fragments_max=3) is None
    assert len(voxelise(points, triangles[:0], shape, device)[0]) == 0


def test_space_is_reached_around_corners_but_not_through_walls(device):
    full = np.zeros((5, 9, 9), bool)
    full[:4, 2:7, 2:7] = True
    full[:3, 3:6, 3:6] = False  # a closed cell
    nothing = np.zeros((0, 3), int)
    assert not reached_space(full, nothing)[:3, 3:6, 3:6].any()
    assert reached_space(full, np.array([(4, 4, 1)]))[:3, 3:6, 3:6].all()
    full[0, 2, 4] = False  # a door
    reached = reached_space(full, nothing)
    assert reached[:3, 3:6, 3:6].all() and not (reached & full).any()
