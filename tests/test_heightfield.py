"""Rays through heightfields and grids of cells against every box asked in float64; the rows H01 to H16 of the hard cases."""

from __future__ import annotations

import numpy as np
import oracles
import pytest
import warp as wp

from warp_reflect.heightfield import WALKS, greatest_of_four, make_heightfield, trace_heightfield
from warp_reflect.occupancy import make_occupancy, trace_occupancy
from warp_reflect.settings import Status

NONE, WALL, ROOF, CEILING = range(4)
# Cells. Nearer than this a ray is taken to touch a column or to miss it: float32 resolves 4e-6 of 64 cells.
TOUCH = 1e-4
EXACT = 2e-5  # of a distance of up to 100 cells, relative
CORPUS = 2000


def hard_rays(rng: np.random.Generator, count: int, size) -> tuple[np.ndarray, np.ndarray]:
    """Rays in and around a box: any, and on borders, along axes and diagonals, grazing, vertical, with tiny components."""
    size = np.asarray(size, float)
    origins = rng.uniform(-0.3, 1.3, (count, 3)) * size
    directions = rng.normal(size=(count, 3))
    directions[:, 2] *= rng.choice([1.0, 0.1, 1e-3], count)
    kind = rng.integers(0, 8, count)
    origins[kind == 1] = np.round(origins[kind == 1])
    directions[kind == 2] = np.round(directions[kind == 2])
    both = kind == 3
    origins[both], directions[both] = np.round(origins[both]), np.round(directions[both])
    directions[kind == 4, :2] = 0.0
    tiny = kind == 5
    directions[tiny, rng.integers(0, 3, tiny.sum())] = rng.choice([1e-30, -1e-30, -0.0, 1e-9], tiny.sum())
    corner = kind == 6
    directions[corner, :2] = rng.choice([-1.0, 1.0], (corner.sum(), 2))
    origins[corner, :2] = np.round(origins[corner, :2])
    zero = ~directions.any(axis=1)
    directions[zero] = (1.0, 0.0, 0.0)
    # What the kernels are given, exactly.
    return origins.astype(np.float32).astype(float), directions.astype(np.float32).astype(float)


def towns(rng: np.random.Generator) -> list[np.ndarray]:
    """Heights: blocks, a rolling field, spikes with holes, one column, a line."""
    x, y = np.meshgrid(np.arange(41), np.arange(29))
    spikes = rng.uniform(0, 12, (33, 17)) * (rng.random((33, 17)) < 0.3)
    spikes[rng.random(spikes.shape) < 0.1] = np.nan
    return [
        np.where((x // 5 + y // 4) % 2 == 0, 6.0, 1.0),
        2.0 + np.sin(0.3 * x) + np.cos(0.4 * y) + 0.05 * x,
        spikes,
        np.array([[3.0]]),
        rng.uniform(0, 4, (1, 50)),
    ]


def check_against_boxes(trace, low, high, origins, directions) -> int:
    """Every answer between what touches and what is met beyond doubt; the number of rays that are beyond doubt."""
    kind, t, status = trace.kind.numpy(), trace.t.numpy().astype(float), trace.status.numpy()
    touched, near = oracles.first_boxes(low, high, origins, directions, TOUCH)
    met, inside = oracles.first_boxes(low, high, origins, directions, -TOUCH)
    assert (status[inside] == Status.INSIDE).all()
    assert not (status[~near] == Status.INSIDE).any()
    assert (status != Status.STEP_LIMIT).all()
    asked = status != Status.INSIDE
    answer = np.where(kind > NONE, t, np.inf)[asked]
    slack = EXACT * (1.0 + np.where(np.isfinite(answer), answer, 0.0)) + 2.0 * TOUCH / np.maximum(
        np.abs(directions[asked, 2]) / np.linalg.norm(directions[asked], axis=1), 1e-4
    )
    # A touch that is taken may be as much nearer as the grown box is along the ray.
    assert (answer >= touched[asked] - EXACT * (1.0 + np.minimum(answer, 1e3))).all()
    assert (answer <= met[asked] + slack).all()
    assert ((status == Status.CONVERGED) == (kind > NONE)).all()
    sure = np.flatnonzero(asked & np.isfinite(met))
    between = met[sure] - touched[sure]
    sure, between = sure[between < 1e-2], between[between < 1e-2]
    assert (np.abs(t - met)[sure] <= between + EXACT * (1.0 + met[sure])).all()
    return len(sure) + int((asked & np.isinf(touched)).sum())


def check_faces(trace, origins, directions, tops, floors=None) -> None:
    """Hits lie on the face that they name, with its normal towards the ray."""
    kind, t, cell, normal = (x.numpy() for x in (trace.kind, trace.t, trace.cell, trace.normal))
    unit = directions / np.abs(directions).max(axis=1, keepdims=True)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    p = origins + t.astype(float)[:, None] * unit
    hit = kind > NONE
    assert (np.abs(np.linalg.norm(normal[hit], axis=1) - 1.0) < 1e-6).all()
    assert ((normal * unit).sum(axis=1)[hit] <= 0.0).all()
    assert not normal[~hit].any()
    wall = kind == WALL
    axis = np.abs(normal[wall]).argmax(axis=1)
    face = cell[wall, axis] + (normal[wall, axis] > 0)
    np.testing.assert_allclose(p[wall, axis], face, atol=1e-4)
    np.testing.assert_allclose(p[kind == ROOF, 2], tops[kind == ROOF], atol=1e-4)
    assert (normal[kind == ROOF, 2] == 1.0).all()
    if floors is not None:
        np.testing.assert_allclose(p[kind == CEILING, 2], floors[kind == CEILING], atol=1e-4)
        assert (normal[kind == CEILING, 2] == -1.0).all()


def assert_same(a, b) -> None:
    for name in ("kind", "t", "cell", "normal", "status"):
        np.testing.assert_array_equal(getattr(a, name).numpy(), getattr(b, name).numpy(), err_msg=name)


def test_heightfield_answers_as_every_column_asked(device):
    rng = np.random.default_rng(1)
    for heights in towns(rng):
        ny, nx = heights.shape
        field = make_heightfield(heights, device=device)
        origins, directions = hard_rays(rng, CORPUS, (nx, ny, 8.0))
        traces = [trace_heightfield(field, origins, directions, walk) for walk in WALKS]
        assert_same(*traces)
        for walk, vector in zip(WALKS, traces, strict=True):
            plain = trace_heightfield(field, origins, directions, walk, kernels="plain")
            assert_same(plain, vector)
            np.testing.assert_array_equal(plain.steps.numpy(), vector.steps.numpy())
        low, high = oracles.column_boxes(heights)
        assert check_against_boxes(traces[0], low, high, origins, directions) > 0.5 * CORPUS
        cell = np.maximum(traces[0].cell.numpy(), 0)
        check_faces(traces[0], origins, directions, heights[cell[:, 1], cell[:, 0]])
        assert len(np.unique(traces[0].kind.numpy())) == 3


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("walk", list(WALKS))
def test_rays_side_by_side_walk_as_single_ones(walk, up):
    """Far and short ways mixed, rays that are none among them, ends of tasks, limits: to the last bit and step."""
    rng = np.random.default_rng(11)
    heights = rng.uniform(0.0, 9.0, (200, 150)) * (rng.random((200, 150)) < 0.15)
    heights[rng.random(heights.shape) < 0.01] = np.nan
    field = make_heightfield(heights, 0.5, (3.0, -2.0, 1.0), up, (0.25, 0.5, 0.75))
    for count in (1, 63, 255, 257, 3000):
        origins, directions = hard_rays(rng, count, (75.0, 75.0, 6.0))
        directions[rng.random(count) < 0.3, 2] *= 0.02
        origins[rng.random(count) < 0.02] = np.nan
        directions[rng.random(count) < 0.02] = 0.0
        rays = [wp.array(each.astype(np.float32), dtype=wp.vec3) for each in (origins, directions)]
        for limit in (0, 1, 7):
            plain, vector = (trace_heightfield(field, *rays, walk, 1, limit, each) for each in ("plain", "auto"))
            assert_same(plain, vector)
            np.testing.assert_array_equal(plain.steps.numpy(), vector.steps.numpy())
    assert len(np.unique(plain.status.numpy())) >= 5


def test_grid_of_cells_answers_as_every_cell_asked(device):
    rng = np.random.default_rng(2)
    for shape, share in (((23, 17, 9), 0.03), ((8, 31, 14), 0.2), ((1, 1, 1), 1.0), ((40, 3, 1), 0.3)):
        cells = np.argwhere(rng.random(shape) < share)
        floor = cells[:, 2] + rng.choice([0.0, 0.25, 0.7], len(cells))
        top = np.where(rng.random(len(cells)) < 0.4, cells[:, 2] + 1.0, floor + rng.uniform(0.0, 0.3, len(cells)))
        flat = rng.random(len(cells)) < 0.2
        top[flat] = floor[flat]
        spans = np.stack([floor, top], axis=1).astype(np.float32).astype(float)
        grid = make_occupancy(cells, spans, shape, device=device)
        origins, directions = hard_rays(rng, CORPUS, shape)
        traces = [trace_occupancy(grid, origins, directions, walk) for walk in WALKS]
        assert_same(*traces)
        low = np.column_stack([cells[:, :2], spans[:, 0]])
        high = np.column_stack([cells[:, :2] + 1, spans[:, 1]])
        assert check_against_boxes(traces[0], low, high, origins, directions) > 0.5 * CORPUS
        tops, floors = np.zeros(shape), np.zeros(shape)
        tops[tuple(cells.T)], floors[tuple(cells.T)] = spans.T[::-1]
        at = tuple(np.maximum(traces[0].cell.numpy(), 0).T)
        check_faces(traces[0], origins, directions, tops[at], floors[at])


def one(heights, origin, direction, device, walk: str = "hierarchy", **field) -> tuple[int, float, Status, list]:
    """(kind, t, status, cell) of one ray, which both walks and the plain heightfield as boxes agree on."""
    made = make_heightfield(np.asarray(heights, float), device=device, **field)
    both = [trace_heightfield(made, [origin], [direction], walk) for walk in WALKS]
    assert_same(*both)
    trace = both[list(WALKS).index(walk)]
    return (
        int(trace.kind.numpy()[0]),
        float(trace.t.numpy()[0]),
        Status(int(trace.status.numpy()[0])),
        trace.cell.numpy()[0].tolist(),
    )


def wall_at(x: int, nx: int = 32, ny: int = 32, height: float = 5.0) -> np.ndarray:
    heights = np.zeros((ny, nx))
    heights[:, x] = height
    return heights


def test_negative_zero_on_a_border_steps_along_the_other_axis(device):
    """H01."""
    for zero in (0.0, -0.0):
        assert one(wall_at(20), (0.5, 8.0, 1.0), (1.0, zero, zero), device)[:3] == (WALL, 19.5, Status.CONVERGED)


def test_vertical_ray_meets_its_column_at_a_finite_distance(device):
    """H02."""
    for x in (0.0, 3.0, 3.5, 32.0):
        assert one(np.zeros((32, 32)), (x, 7.5, 5.0), (0.0, -0.0, -1.0), device)[:3] == (ROOF, 5.0, Status.CONVERGED)
    assert one(np.zeros((32, 32)), (3.5, 7.5, 5.0), (0.0, 0.0, 1.0), device)[2] == Status.SKY


def test_rays_that_are_no_rays_get_a_status(device):
    """H03."""
    bad = [np.nan, np.inf, -np.inf, 3e38]
    for value in bad:
        for k in range(3):
            origin = np.array([0.5, 0.5, 2.0])
            origin[k] = value
            assert one(np.zeros((4, 4)), origin, (1.0, 0.0, -1.0), device)[::2] == (NONE, Status.BAD_INPUT)
    for value in bad[:3]:
        for k in range(3):
            direction = np.array([1.0, 1.0, -1.0])
            direction[k] = value
            assert one(np.zeros((4, 4)), (0.5, 0.5, 2.0), direction, device)[::2] == (NONE, Status.BAD_INPUT)
    assert one(np.zeros((4, 4)), (0.5, 0.5, 2.0), (0.0, -0.0, 0.0), device)[::2] == (NONE, Status.DEGENERATE)


def test_ray_from_outside_comes_in_through_the_box(device):
    """H04."""
    assert one(wall_at(20), (-5.0, 8.5, 1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 25.0)
    assert one(wall_at(20), (-5.0, 8.5, 1.0), (-1.0, 0.0, 0.0), device)[2] == Status.SKY
    assert one(wall_at(20), (-5.0, 40.0, 1.0), (1.0, 0.0, 0.0), device)[2] == Status.SKY


def test_ray_from_the_far_edge_starts_in_the_last_column(device):
    """H05."""
    assert one(wall_at(6), (32.0, 8.5, 1.0), (-1.0, 0.0, 0.0), device)[:2] == (WALL, 25.0)
    assert one(wall_at(6).T, (8.5, 32.0, 1.0), (0.0, -1.0, 0.0), device)[:2] == (WALL, 25.0)


def test_ray_from_a_border_starts_in_the_column_that_it_enters(device):
    """H06: also a ray that starts on the face of a wall meets it going in, and leaves it going out."""
    heights = wall_at(10)
    assert one(heights, (10.0, 4.5, 1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 0.0)
    assert one(heights, (10.0, 4.5, 1.0), (-1.0, 0.0, -0.25), device)[0] == ROOF
    assert one(heights, (11.0, 4.5, 1.0), (-1.0, 0.0, 0.0), device)[:2] == (WALL, 0.0)
    assert one(heights, (11.0, 4.5, 1.0), (1.0, 0.0, 0.0), device)[2] == Status.SKY
    heights[:, 9] = 5.0
    assert one(heights, (10.0, 4.5, 1.0), (1.0, 0.0, 0.0), device)[2] == Status.INSIDE


def test_diagonal_through_corners_goes_between_no_two_columns(device):
    """H07."""
    for dx in (-1.0, 1.0):
        for dy in (-1.0, 1.0):
            for blocked in ((1, 0), (0, 1)):
                heights = np.zeros((21, 21))
                corner = np.array([10 + 3 * dx, 10 + 3 * dy])
                for k in (0, 1):
                    at = corner + (dx * 0.5, -dy * 0.5) if k == 0 else corner + (-dx * 0.5, dy * 0.5)
                    heights[int(at[1]), int(at[0])] = 5.0
                kind, t, _, _ = one(heights, (10.0, 10.0, 1.0), (dx, dy, 0.0), device)
                assert kind == WALL and abs(t - 3.0 * np.sqrt(2.0)) < 1e-5, (dx, dy, blocked)


def test_tiny_components_and_tiny_directions_are_scaled(device):
    """H08."""
    assert one(wall_at(20), (0.5, 8.5, 1.0), (1.0, 1e-30, -1e-30), device)[:2] == (WALL, 19.5)
    for scale in (1e-38, 1e-44, 1e-20, 1e30):
        assert one(wall_at(20), (0.5, 8.5, 1.0), (scale, 0.0, 0.0), device)[:2] == (WALL, 19.5), scale
    made = make_heightfield(wall_at(20), device=device)
    rng = np.random.default_rng(3)
    origins, directions = hard_rays(rng, 500, (32, 32, 6))
    directions = np.round(directions * 64) / 64
    directions[~directions.any(axis=1)] = (0, 0, -1)
    a, b = (trace_heightfield(made, origins, directions * scale) for scale in (1.0, 2.0**-100))
    np.testing.assert_array_equal(a.status.numpy(), b.status.numpy())
    np.testing.assert_allclose(a.t.numpy(), b.t.numpy(), rtol=5e-7)


@pytest.mark.parametrize("length", [1024, 4096, 16384])
def test_long_rays_stay_in_their_cells(length, device):
    """H09: the column where each ray ends, and how many it went through, as counted in float64."""
    rng = np.random.default_rng(4)
    ny = 256
    heights = np.zeros((ny, length))
    heights[0, -1] = 40.0  # a mast that no ray comes near: under a low top they would start where they meet the ground
    field = make_heightfield(heights, device=device)
    count = 2000
    end = np.column_stack(
        [rng.uniform(0.5 * length, length - 1, count), rng.uniform(1, ny - 1, count), np.zeros(count)]
    )
    start = np.column_stack([rng.uniform(0, 1, count), rng.uniform(1, ny - 1, count), rng.uniform(1, 30, count)])
    start = start.astype(np.float32).astype(float)
    directions = (end - start).astype(np.float32).astype(float)
    met = start + (start[:, 2] / -directions[:, 2])[:, None] * directions
    traces = [trace_heightfield(field, start, directions, walk) for walk in WALKS]
    assert_same(*traces)
    cell = traces[0].cell.numpy()
    # Rays that meet the ground within a thousandth of a cell of a border, a float32 position's worth, are no test.
    sure = (np.abs(met[:, :2] - np.round(met[:, :2])) > 2e-3).all(axis=1)
    assert sure.sum() > 0.98 * count
    np.testing.assert_array_equal(cell[sure, :2], np.floor(met[sure, :2]))
    crossed = np.abs(np.floor(met[:, :2]) - np.floor(start[:, :2])).sum(axis=1)
    # A ray that starts above the ground is in the field from its start on.
    np.testing.assert_array_equal(traces[0].steps.numpy()[sure], crossed[sure] + 1)
    distance = np.linalg.norm(met - start, axis=1)
    assert (np.abs(traces[0].t.numpy() - distance) <= 2e-6 * distance).all()


def test_columns_without_a_height_are_open(device):
    """H10: counted, passed through, and the next thing is met."""
    heights = wall_at(20)
    heights[8, 5:10] = [np.nan, np.inf, -np.inf, np.nan, 1e39]
    made = make_heightfield(heights, device=device)
    assert made.hole_count == 5
    assert one(heights, (0.5, 8.5, 1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 19.5)
    assert one(heights, (7.5, 8.5, 1.0), (0.0, 0.0, -1.0), device)[2] == Status.SKY
    # Below the ground in a hole: the next column's side.
    assert one(heights, (7.5, 8.5, -1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 2.5)
    empty = one(np.full((3, 3), np.nan), (0.5, 0.5, 5.0), (0.3, 0.1, -1.0), device)
    assert empty[2] == Status.SKY


def test_ray_at_the_height_of_a_column_meets_it(device):
    """H11."""
    assert one(wall_at(20, height=1.0), (0.5, 8.5, 1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 19.5)
    assert one(np.ones((4, 4)), (0.5, 0.5, 1.0), (0.3, 0.0, -1.0), device)[:2] == (ROOF, 0.0)
    # One that rises from a roof leaves it.
    assert one(np.ones((4, 4)), (0.5, 0.5, 1.0), (0.3, 0.0, 0.1), device)[2] == Status.SKY


def test_start_below_the_ground_is_told(device):
    """H12."""
    assert one(np.ones((4, 4)), (0.5, 0.5, 0.5), (1.0, 0.0, 0.0), device)[::2] == (NONE, Status.INSIDE)
    assert one(np.ones((4, 4)), (0.5, 0.5, 0.5), (0.0, 0.0, 1.0), device)[::2] == (NONE, Status.INSIDE)
    # From outside the field, below its ground: its side.
    assert one(np.ones((4, 4)), (-2.0, 0.5, 0.5), (1.0, 0.0, 0.0), device)[:2] == (WALL, 2.0)


def test_smallest_grids_and_none(device):
    """H13."""
    assert one([[2.0]], (0.5, 0.5, 5.0), (0.0, 0.0, -1.0), device)[:2] == (ROOF, 3.0)
    assert one([[2.0]], (-1.0, 0.5, 1.0), (1.0, 0.0, 0.0), device)[:2] == (WALL, 1.0)
    assert one([[2.0]], (-1.0, 0.5, 3.0), (1.0, 0.0, 0.0), device)[2] == Status.SKY
    for shape in ((0, 0), (0, 3), (3, 0), (1, 20000)):
        with pytest.raises(ValueError, match="heights"):
            make_heightfield(np.zeros(shape), device=device)
    for shape in ((0, 1, 1), (1, 1, 20000), (2000, 2000, 2000)):
        with pytest.raises(ValueError, match="shape"):
            make_occupancy(np.zeros((0, 3)), None, shape, device=device)
    nothing = trace_heightfield(make_heightfield([[1.0]], device=device), np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(nothing.t) == 0


def test_step_limit_ends_a_walk_and_no_ray_of_the_corpus_reaches_it(device):
    """H14: the corpus is that of `check_against_boxes`; here a worst case for the pyramid, and a limit that is reached."""
    spikes = np.zeros((64, 64))
    spikes[::2, ::2] = 1.0
    made = make_heightfield(spikes, device=device)
    rng = np.random.default_rng(5)
    origins, directions = hard_rays(rng, 4000, (64, 64, 1.0))
    directions[:, 2] *= 1e-3
    for walk in WALKS:
        trace = trace_heightfield(made, origins, directions, walk)
        assert (trace.status.numpy() != Status.STEP_LIMIT).all()
        assert trace.steps.numpy().max() <= made.step_limit(walk) // 2 + 2 or walk == "cells"
        cut = trace_heightfield(made, [(0.5, 1.5, 0.5)], [(1.0, 0.0, 0.0)], walk, step_limit=3)
        assert (int(cut.status.numpy()[0]), int(cut.steps.numpy()[0])) == (Status.STEP_LIMIT, 3)
    grid = make_occupancy(np.zeros((0, 3), int), None, (40, 40, 40), device=device)
    cut = trace_occupancy(grid, [(0.5, 1.5, 0.5)], [(1.0, 0.0, 0.0)], "cells", step_limit=3)
    assert int(cut.status.numpy()[0]) == Status.STEP_LIMIT


def test_cells_are_found_far_from_the_origin(device):
    """H15: cells of 0.5 at 1e7; not one of a million rays ends in another cell."""
    corner = np.array([1e7 + 0.25, -1e7, 1e7])
    count = 1_000_000
    rng = np.random.default_rng(6)
    at = rng.integers(0, 64 * 2048, (count, 2)) / 2048.0
    origins = corner + np.column_stack([0.5 * at, np.full(count, 3.0)])
    field = make_heightfield(np.ones((64, 64)), 0.5, corner, device=device)
    trace = trace_heightfield(field, origins, np.tile((0.0, 0.0, -2.0), (count, 1)))
    np.testing.assert_array_equal(trace.cell.numpy()[:, :2], np.floor(at))
    np.testing.assert_array_equal(trace.t.numpy(), np.float32(2.0))


def test_ray_that_sinks_below_a_roof_within_a_cell_meets_it_there(device):
    """H16."""
    kind, t, status, cell = one(np.ones((1, 2)), (0.0, 0.5, 1.2), (1.0, 0.0, -1.0), device)
    assert (kind, status, cell) == (ROOF, Status.CONVERGED, [0, 0, 0])
    assert abs(t - 0.2 * np.sqrt(2.0)) < 1e-6


def test_rays_are_given_in_the_axes_of_the_stage(device):
    """A field whose Y is up, coarse, and off the origin: the same rays with their axes exchanged."""
    rng = np.random.default_rng(7)
    heights = rng.uniform(0, 5, (20, 30))
    origins, directions = hard_rays(rng, 1000, (30, 20, 6))
    plain = trace_heightfield(make_heightfield(heights, device=device), origins, directions)
    turned = [2.0 * origins[:, [0, 2, 1]] + (100.0, -50.0, 8.0), directions[:, [0, 2, 1]]]
    other = trace_heightfield(make_heightfield(2.0 * heights, 2.0, (100.0, -50.0, 8.0), "Y", device=device), *turned)
    same = plain.status.numpy() == other.status.numpy()
    assert same.mean() > 0.99  # off the origin borders lie elsewhere by a rounding
    met = same & (plain.kind.numpy() > NONE)
    np.testing.assert_allclose(other.t.numpy()[met], 2.0 * plain.t.numpy()[met], rtol=1e-4, atol=1e-3)
    np.testing.assert_array_equal(other.normal.numpy()[met][:, [0, 2, 1]], plain.normal.numpy()[met])
    # Device arrays are taken in the frame of the place.
    shifted = make_heightfield(2.0 * heights, 2.0, (100.0, -50.0, 8.0), "Y", (0.0, 0.0, 4.0), device)
    arrays = [wp.array(x.astype(np.float32), dtype=wp.vec3, device=device) for x in turned]
    arrays[0] = wp.array((turned[0] - (100.0, -50.0, 4.0)).astype(np.float32), dtype=wp.vec3, device=device)
    assert_same(trace_heightfield(shifted, *turned), trace_heightfield(shifted, *arrays))


def test_threads_do_not_change_an_answer(device):
    rng = np.random.default_rng(8)
    origins, directions = hard_rays(rng, 5000, (40, 30, 8))
    field = make_heightfield(rng.uniform(0, 5, (30, 40)), device=device)
    assert_same(*(trace_heightfield(field, origins, directions, threads=threads) for threads in (1, 3)))
    grid = make_occupancy(np.argwhere(rng.random((40, 30, 8)) < 0.1), None, (40, 30, 8), device=device)
    assert_same(*(trace_occupancy(grid, origins, directions, threads=threads) for threads in (1, 3)))


def test_pyramid_holds_the_greatest_of_what_is_below(device):
    level = np.random.default_rng(9).uniform(size=(5, 7)).astype(np.float32)
    above = greatest_of_four(level)
    assert above.shape == (3, 4)
    for j in range(3):
        for i in range(4):
            assert above[j, i] == level[2 * j : 2 * j + 2, 2 * i : 2 * i + 2].max()


def test_arguments_that_cannot_be_are_refused(device):
    field = make_heightfield([[1.0]], device=device)
    for bad in ({"cell": 0.0}, {"cell": np.nan}, {"up": "X"}, {"corner": (0.0, np.inf, 0.0)}, {"corner": (0.0, 1.0)}):
        with pytest.raises(ValueError, match=next(iter(bad))):
            make_heightfield([[1.0]], device=device, **bad)
    with pytest.raises(ValueError, match="walk"):
        trace_heightfield(field, np.zeros((1, 3)), np.ones((1, 3)), "sideways")
    with pytest.raises(ValueError, match="origins"):
        trace_heightfield(field, np.zeros((1, 2)), np.ones((1, 3)))
    with pytest.raises(ValueError, match="one per origin"):
        trace_heightfield(field, np.zeros((1, 3)), np.ones((2, 3)))
    with pytest.raises(ValueError, match="cells"):
        make_occupancy([(0, 0, 4)], None, (4, 4, 4), device=device)
    with pytest.raises(ValueError, match="spans"):
        make_occupancy([(0, 0, 0)], [(1.0, 0.5)], (4, 4, 4), device=device)


def test_steep_rays_go_column_by_column_in_both_walks(device):
    """They meet something before skipping pays; rays that graze skip."""
    rng = np.random.default_rng(8)
    field = make_heightfield(rng.uniform(0.0, 8.0, (256, 256)), device=device)
    turn = rng.uniform(0.0, 2.0 * np.pi, 500)
    origins = np.column_stack([rng.uniform(0.0, 256.0, (500, 2)), np.full(500, 9.0)])
    for slope, same in ((1.0, True), (0.05, False)):
        directions = np.column_stack([np.cos(turn), np.sin(turn), np.full(500, -slope)])
        plain, skipping = (trace_heightfield(field, origins, directions, walk) for walk in ("cells", "hierarchy"))
        assert_same(plain, skipping)
        assert np.array_equal(plain.steps.numpy(), skipping.steps.numpy()) == same
