"""The interpolation grid: solve the corners of the cells that hold vertices, interpolate the vertices.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 5, and the
level-of-detail hierarchy of its section 8. What differs:
- the cells are those of one octree over the scene, so that small meshes share them;
- which level a vertex is interpolated from is decided per view, by an estimate of the interpolation error on the screen
  (`vertices.edge_reach`): down to `grid_error_px`, or until the solves asked for by `grid_share` are spent;
- by default the grid holds *reflection directions* and each vertex takes one exact step from the interpolated one (fourth
  order instead of second, at the same count of solves); `grid_kind="slope"` holds virtual positions and their derivatives
  (third order, no map read per vertex); `grid_kind="position"` is the paper's interpolation of virtual positions;
- vertices of cells that straddle the hidden boundary, or whose corners would outnumber them, are solved one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.launch import launch
from warp_reflect.layers import Camera
from warp_reflect.reflector_maps import ReflectorMap
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques import interpolation_vector, octree
from warp_reflect.techniques.interpolation import (
    NEAR,
    UNSAFE,
    CellTest,
    ChunkView,
    direction_kernel,
    estimate_kernel,
    gather_kernel,
    position_kernel,
    scatter_kernel,
    slope_kernel,
    slope_position_kernel,
)
from warp_reflect.techniques.octree import CORNER_COUNT, Octree
from warp_reflect.techniques.vertices import SolveFrame, VertexView, empty_vertices, vertices_from

START_SHARE = 0.02  # nodes per vertex of the level a frame starts from: it costs little and is rarely good enough
ROUNDS_MAX = 16
ROUND_WORTH = 400  # vertices: solving fewer costs less than the launches of another round
NODES_MAX = 0.15  # nodes per vertex that `grid_error_px` may solve: where it asks for more, the grid saves little
BUDGET_ROUNDS = 2  # descents by `grid_share`: the second sees better estimates
NODES_PER_CELL = 2.5  # of a surface's cells, shared corners counted in parts
STRADDLING_COUNT = 16.0  # vertices of a cell at the hidden boundary below which nodes cost more than they save
TOLERANCE_LEAST = 1.0e-3  # pixels: no budget is spent on less
FIT_STEPS = 24
ORDERS = {"position": 2, "slope": 3, "direction": 4}  # of the error in a cell's edge
# Directions from cells judged worse than this often miss ACCEPTED after their step, and would be solved after all.
DIRECTION_PX = 0.25
CHUNK = 64  # vertices per thread
CHUNK_SPLIT_MIN = CHUNK  # a chunk is worth many elements of an ordinary launch


@dataclass(frozen=True)
class Grid:
    """An octree over the vertices of a scene that a mirror reflects.

    Attributes:
        tree: Its cells; `tree.order` counts `vertices`.
        vertices: int32 [n], scene vertices along the tree's curve.
        order, points: The same on the device, and where they lie (scene frame).
        start: The cells a frame starts from.
    """

    tree: Octree
    vertices: np.ndarray
    order: wp.array
    points: wp.array
    start: np.ndarray


class CellUse(IntEnum):
    """What a frame did with the vertices of a cell."""

    NONE = 0
    INTERPOLATED = 1
    HIDDEN = 2
    """The mirror hides the whole cell: nothing was asked of its vertices."""
    SOLVED = 3
    """One by one: the cell straddles the hidden boundary, or its corners would have cost more."""


@dataclass(frozen=True)
class UsedCells:
    """The cells that a frame ended with.

    Attributes:
        tree: Of which they are.
        cell: int [n], indices of its cells; no two overlap.
        use: uint8 [n], `CellUse`.
        error_px: float64 [n], estimated error where INTERPOLATED, else 0. [pixels]
    """

    tree: Octree
    cell: np.ndarray
    use: np.ndarray
    error_px: np.ndarray


def build(scene: Scene, own: PartRange) -> Grid | None:
    """The octree over everything but the mirror's own vertices; None where there is nothing to reflect."""
    members = np.ones(scene.vertex_count, bool)
    if own.is_whole:
        members[own.first_vertex : own.first_vertex + own.vertex_count] = False
    vertices = np.flatnonzero(members).astype(np.int32)
    if not len(vertices):
        return None
    tree = octree.build(scene.host_points[vertices])
    vertices = vertices[tree.order]
    level = 0
    allowed = max(START_SHARE * len(vertices), CORNER_COUNT)
    while level + 1 < tree.level_count:
        finer = tree.cells_of(level + 1)
        if len(np.unique(tree.corners[finer])) > allowed:
            break
        level += 1
    return Grid(
        tree,
        vertices,
        wp.array(vertices, dtype=int, device=scene.device),
        wp.array(scene.host_points[vertices], dtype=wp.vec3, device=scene.device),
        tree.cells_of(level),
    )


def fill(
    scene: Scene,
    cells: Grid,
    solve: Callable,
    frame: SolveFrame,
    map: ReflectorMap,
    view: wp.array,
    camera: Camera,
    box: tuple[int, int, int, int],
    settings: Settings,
    out_vertex: VertexView,
) -> tuple[dict[str, int], UsedCells]:
    """Fill the vertices of a scene from a grid, solving as few as `grid_error_px` or `grid_share` allow.

    Args:
        solve: (points, out VertexView) -> None: the exact solution of every point, from `out.seed` where not zero.
        map: The reflector.
        camera: What `view` was made from.
        box: Of the mirror's pixels.
        out_vertex: One entry per scene vertex, empty.

    Returns:
        (statistics: `grid_vertices` of which `grid_nodes` and `grid_exact` solves were made, `grid_levels` used; the cells).
    """
    descent = _Descent(scene, cells, solve, frame, map, camera, box, settings, out_vertex)
    interpolated, error, exact = descent.run()
    tree = cells.tree
    failed = _interpolate(scene, cells, descent, interpolated, map, frame, view, camera, settings, out_vertex)
    places = np.concatenate([_ranges(tree.first[exact], tree.count[exact]), failed]).astype(np.int32)
    if descent.waiting_before is not None:
        places = places[np.diff(descent.waiting_before)[places] > 0]
    if len(places):
        listed = wp.array(places, dtype=int, device=scene.device)
        points = wp.empty(len(places), dtype=wp.vec3, device=scene.device)
        solved = empty_vertices(len(places), scene.device, with_position=len(out_vertex.position) > 0)
        inputs = [cells.points, cells.order, listed, out_vertex, points, solved]
        launch(gather_kernel, len(places), inputs, scene.device, settings.threads)
        solve(points, solved)
        launch(scatter_kernel, len(places), [cells.order, listed, solved, out_vertex], scene.device, settings.threads)
    levels = np.unique(tree.level[interpolated])
    statistics = {
        "grid_vertices": len(cells.vertices) if descent.waiting_before is None else int(descent.waiting_before[-1]),
        "grid_nodes": descent.node_count,
        "grid_exact": len(places),
        "grid_levels": len(levels),
    }
    use = np.r_[np.where(error < 0.0, CellUse.HIDDEN, CellUse.INTERPOLATED), np.full(len(exact), CellUse.SOLVED)]
    error = np.r_[np.maximum(error, 0.0), np.zeros(len(exact))]
    return statistics, UsedCells(tree, np.r_[interpolated, exact], use.astype(np.uint8), error)


class _Descent:
    """Which cells a view interpolates from, with their nodes solved."""

    def __init__(self, scene, cells, solve, frame, map, camera, box, settings, out_vertex):
        self.scene, self.cells, self.solve, self.frame, self.settings = scene, cells, solve, frame, settings
        tree = cells.tree
        status = out_vertex.status.numpy()
        self.waiting_before = None  # of vertices in the grid's order; None: all of them
        if status.any():
            self.waiting_before = np.r_[0, np.cumsum(status[cells.vertices] == 0)]
        self.slot = np.full(len(tree.nodes), -1, np.int32)
        self.node_count = 0
        # More nodes than this are not solved: the rest is exact.
        share = max(NODES_MAX, 1.5 * settings.grid_share)
        self.capacity = min(len(tree.nodes), int(share * len(cells.vertices)) + len(cells.start) * CORNER_COUNT)
        self.node = empty_vertices(self.capacity, scene.device, with_position=True)
        self.slope = wp.empty(
            self.capacity if settings.grid_kind == "slope" else 0, dtype=wp.mat33, device=scene.device
        )
        self.map = map
        self.point = wp.empty(self.capacity, dtype=wp.vec3, device=scene.device)
        linear = np.array(frame.unit_from_scene, np.float64).reshape(3, 3)
        self.unit_per_scene = float(np.cbrt(abs(np.linalg.det(linear))))
        self.test = CellTest()
        self.test.pixels_per_radian = max(camera.fx, camera.fy)
        self.test.unit_per_scene = self.unit_per_scene
        self.test.order = ORDERS[settings.grid_kind]
        self.test.extent = wp.vec3(*map.extent)
        self.test.body_width = 2.0 * float(min(map.extent))
        self.test.body_radius = float(map.outer_radius * max(map.extent))
        self.test.box = wp.vec4(*(float(side) for side in box))

    def waiting(self, cell) -> np.ndarray:
        """Vertices of cells that have no answer yet."""
        if self.waiting_before is None:
            return self.cells.tree.count[cell]
        first = self.cells.tree.first[cell]
        return self.waiting_before[first + self.cells.tree.count[cell]] - self.waiting_before[first]

    def run(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(cells to interpolate from or hidden, their errors [pixels], cells whose vertices are solved one by one)."""
        by_error = self.settings.grid_error_px > 0.0
        asked = self.settings.grid_error_px
        if self.settings.grid_kind == "direction":
            asked = min(asked, DIRECTION_PX)
        done, errors, exact = [], [], []
        cell = self.cells.start[self.waiting(self.cells.start) > 0]
        error = self._estimate(cell)
        rounds = ROUNDS_MAX if by_error else BUDGET_ROUNDS
        for step in range(rounds + 1):
            unsafe = error >= UNSAFE
            tolerance = asked if by_error else self._tolerance(cell, error)
            depth = self._depth(cell, error, tolerance)
            wrong = error > tolerance
            split = wrong & (depth > 0)
            if step == rounds or self.waiting(cell[split]).sum() < ROUND_WORTH:
                split[:] = False
            direct = (wrong if by_error else unsafe) & ~split
            exact.append(cell[direct])
            done.append(cell[~split & ~direct])
            errors.append(error[~split & ~direct])
            if not split.any():
                break
            cell = self._below(cell[split], depth[split])
            cell = cell[self.waiting(cell) > 0]
            error = self._estimate(cell)
        return np.concatenate(done), np.concatenate(errors), np.concatenate(exact)

    def _depth(self, cell, error, tolerance) -> np.ndarray:
        """Levels to go down from cells until their error falls to the tolerance; 0 where solving the vertices is cheaper."""
        tree = self.cells.tree
        count = self.waiting(cell)
        # A boundary halves the vertices in doubt with every level; a surface has 4 children a cell.
        depth = np.floor(0.5 * np.log2(np.maximum(count / STRADDLING_COUNT, 1.0)))
        depth[error >= NEAR] = np.minimum(depth[error >= NEAR], 1.0)
        known = error < UNSAFE
        levels = np.ceil(np.log2(np.maximum(error[known] / tolerance, 1.0)) / self.test.order)
        depth[known] = np.where(count[known] > NODES_PER_CELL * 4.0**levels, levels, 0.0)
        return np.where(tree.child_count[cell] > 0, depth, 0.0).astype(np.int64)

    def _tolerance(self, cell, error) -> float:
        """The error that the solves left by `grid_share` reach, by the estimates so far, in pixels."""
        tree = self.cells.tree
        rest = self.settings.grid_share * len(self.cells.vertices) - self.node_count
        unsafe = error >= UNSAFE
        rest -= NODES_PER_CELL * float((self.waiting(cell[unsafe]) / STRADDLING_COUNT).sum())
        known = ~unsafe & (error > 0.0) & (tree.child_count[cell] > 0)
        if not known.any():
            return 1.0
        error, count = error[known], self.waiting(cell[known])
        low, high = 0.0, float(np.log2(error.max() / TOLERANCE_LEAST + 1.0))
        for _ in range(FIT_STEPS):
            middle = 0.5 * (low + high)
            levels = np.ceil(np.log2(np.maximum(error / (TOLERANCE_LEAST * 2.0**middle), 1.0)) / self.test.order)
            leaves = 4.0**levels
            price = np.where(levels > 0, np.minimum(NODES_PER_CELL * leaves, count), 0.0).sum()
            if price <= rest:
                high = middle
            else:
                low = middle
        return TOLERANCE_LEAST * 2.0**high

    def _below(self, cell, depth) -> np.ndarray:
        """The cells so many levels below, or where the tree ends."""
        tree = self.cells.tree
        result = []
        current = cell
        while len(current):
            number = tree.child_count[current]
            child = _ranges(tree.child_first[current], number)
            depth = np.repeat(depth, number) - 1
            end = (depth == 0) | (tree.child_count[child] == 0)
            result.append(child[end])
            current, depth = child[~end], depth[~end]
        return np.concatenate(result)

    def _estimate(self, cell) -> np.ndarray:
        """Errors of cells [pixels]; their corners are solved."""
        tree = self.cells.tree
        device, threads = self.scene.device, self.settings.threads
        self._solve_corners(cell)
        corner = self.slot[tree.corners[cell]]
        room = (corner >= 0).all(axis=1)
        edge = (tree.edge(cell) * self.unit_per_scene).astype(np.float32)
        error = wp.empty(len(cell), dtype=float, device=device)
        inputs = [wp.array(np.maximum(corner, 0), dtype=int, device=device), wp.array(edge, dtype=float, device=device)]
        launch(
            estimate_kernel,
            len(cell),
            [*inputs, self.point, self.node, self.slope, self.frame, self.test, error],
            device,
            threads,
        )
        return np.where(room, error.numpy(), UNSAFE)

    def _solve_corners(self, cell) -> None:
        tree = self.cells.tree
        device, threads = self.scene.device, self.settings.threads
        asked = np.zeros(len(tree.nodes), bool)
        asked[tree.corners[cell]] = True
        new = np.flatnonzero(asked & (self.slot < 0))[: self.capacity - self.node_count]
        if not len(new):
            return
        first, end = self.node_count, self.node_count + len(new)
        part = vertices_from(self.node, first)
        point = self.point[first:end]
        point.assign((tree.low + tree.nodes[new] * tree.unit).astype(np.float32))
        self.solve(point, part)
        if len(self.slope):
            inputs = [point, part, self.map.view, self.frame, self.slope[first:]]
            launch(slope_kernel, len(new), inputs, device, threads)
        self.slot[new] = np.arange(first, end, dtype=np.int32)
        self.node_count = end


def _interpolate(scene, cells, descent, cell, map, frame, view, camera, settings, out_vertex) -> np.ndarray:
    """Interpolate the vertices of cells; returns the places (in the grid's order) of those that must be solved."""
    tree, device = cells.tree, scene.device
    if not len(cell):
        return np.zeros(0, np.int32)
    slots = descent.slot[tree.corners[cell]]
    hidden = (descent.node.status.numpy()[slots] == int(Status.HIDDEN)).all(axis=1)
    edge = tree.edge(cell)
    pieces = -(-tree.count[cell] // CHUNK)
    owner = np.repeat(np.arange(len(cell)), pieces)
    step = (np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)) * CHUNK
    begin = tree.first[cell][owner] + step
    chunks = ChunkView()
    ranges = np.stack([begin, np.minimum(tree.count[cell][owner] - step, CHUNK)], axis=1)
    chunks.range = wp.array(ranges.astype(np.int32), dtype=wp.vec2i, device=device)
    chunks.cell = wp.array(owner.astype(np.int32), dtype=int, device=device)
    chunks.corner = wp.array(slots, dtype=int, device=device)
    low = tree.low + tree.place[cell] * tree.unit
    chunks.low = wp.array(low.astype(np.float32), dtype=wp.vec3, device=device)
    chunks.inv_edge = wp.array(np.where(hidden, 0.0, 1.0 / edge).astype(np.float32), dtype=float, device=device)
    inputs = [cells.points, cells.order, chunks, descent.node]
    if settings.grid_kind == "slope":
        inputs += [descent.slope, view, out_vertex]
        launch(slope_position_kernel, len(owner), inputs, device, settings.threads, split_min=CHUNK_SPLIT_MIN)
        return np.zeros(0, np.int32)
    if settings.grid_kind == "position":
        launch(
            position_kernel,
            len(owner),
            [*inputs, view, out_vertex],
            device,
            settings.threads,
            split_min=CHUNK_SPLIT_MIN,
        )
        return np.zeros(0, np.int32)
    tolerance = settings.grid_error_px / max(camera.fx, camera.fy) if settings.grid_error_px > 0.0 else 1.0
    failed = wp.zeros(len(cells.vertices), dtype=wp.uint8, device=device)
    inputs += [map.view, frame, view, tolerance, out_vertex, failed]
    step_from_directions(len(owner), inputs, device, settings.threads, settings.kernels)
    return np.flatnonzero(failed.numpy()).astype(np.int32)


def step_from_directions(chunk_count: int, inputs: list, device, threads: int, kernels: str) -> None:
    """Run `interpolation.direction_kernel` or its vector form; `inputs` are its arguments, `out_failed` all zero."""
    lanes = vector.chosen(kernels, device)
    kernel = interpolation_vector.direction_lanes_kernel if lanes else direction_kernel
    launch(kernel, chunk_count, inputs, device, threads, split_min=CHUNK_SPLIT_MIN)


def _ranges(first: np.ndarray, count: np.ndarray) -> np.ndarray:
    """The numbers of consecutive ranges, one after the other."""
    ends = np.cumsum(count)
    total = int(ends[-1]) if len(ends) else 0
    return np.arange(total) + np.repeat(first - ends + count, count)
