"""Rays against a 3-D grid of cells, for what a heightfield cannot hold: arches, balconies, trees, rooms.

A cell is empty or solid from a floor to a top within it (the whole height of the cell where a wall stands in it), so that
level surfaces are met exactly at any size of the cells. Two walks with the same answers, as in `heightfield.py` on three axes:
`cells` from cell to cell, `hierarchy` over a pyramid of what is not empty. A ray that starts within the solid span of its
cell has status INSIDE and no hit; one that starts on its surface and goes out leaves it.

Source: Amanatides and Woo 1987 (see `grid_rays.py`); the grid in place of the heightfield is what Meyer and Loscos 2003,
section 8, name as future work.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.grid_rays import (
    CEILING,
    CELLS_MAX,
    FAR,
    INSIDE,
    NONE,
    OK,
    ROOF,
    SKY,
    START,
    STEP_LIMIT,
    WALL,
    Entry,
    GridHit,
    GridPlace,
    GridRay,
    GridTrace,
    border_time,
    cell_at,
    clip_axis,
    frame_origin,
    miss,
    place_grid,
    rays_on_device,
    side_normal,
    swap_up,
    to_grid,
)
from warp_reflect.heightfield import HIERARCHY_STEPS, START_LEVEL, TRACE_SPLIT_MIN, WALKS
from warp_reflect.launch import FINITE_FLAGS, launch

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

EMPTY = wp.constant(-1)
GRID_CELLS_MAX = 1 << 26  # in all: 268 MB


@wp.struct
class OccupancyView:
    """A grid of cells on the device; element (z ny + y) nx + x."""

    place: GridPlace
    index: wp.array(dtype=int)  # per cell: its place in `spans`, or EMPTY
    spans: wp.array(dtype=wp.vec2)  # floor and top of each cell that is not empty, in cells above the grid's corner
    pyramid: wp.array(dtype=wp.uint8)  # levels from 1 on: 1 where a node holds a cell that is not empty
    level_first: wp.array(dtype=int)
    level_count: int  # the cells count as level 0
    nx: int
    ny: int
    nz: int


@wp.func
def enter_grid(grid: OccupancyView, ray: GridRay) -> Entry:
    """Where a ray comes into the box of a grid."""
    entry = Entry()
    entry.end = FAR
    entry.axis = START
    entry.inside = 1
    entry = clip_axis(entry, 0, 0, grid.nx, ray)
    entry = clip_axis(entry, 1, 0, grid.ny, ray)
    return clip_axis(entry, 2, 0, grid.nz, ray)


@wp.func
def cell_of_axis(axis: int, t: float, inclusive: bool, low: int, high: int, at: int, ray: GridRay) -> int:
    return cell_at(
        t,
        inclusive,
        low,
        high,
        ray.origin[axis],
        ray.direction[axis],
        ray.inverse[axis],
        ray.step[axis],
        ray.ahead[axis],
        at,
    )


@wp.func
def axis_time(ray: GridRay, axis: int, border: int) -> float:
    return border_time(border, ray.origin[axis], ray.inverse[axis], ray.never[axis])


@wp.func
def height_at(ray: GridRay, t: float, t_border: float, border: int) -> float:
    """The height of a ray at a time; on a level border the border's own, or a floor that lies in it could be missed."""
    return wp.where(t_border <= t, float(border), ray.origin[2] + t * ray.direction[2])


@wp.func
def entry_height(grid: OccupancyView, ray: GridRay, entry: Entry) -> float:
    if entry.axis == 2:
        return wp.where(ray.direction[2] < 0.0, float(grid.nz), 0.0)
    return ray.origin[2] + entry.t * ray.direction[2]


@wp.func
def out_of_grid(grid: OccupancyView, x: int, y: int, z: int) -> bool:
    # One comparison each: as unsigned numbers the negative ones are the largest.
    return (
        wp.uint32(x) >= wp.uint32(grid.nx) or wp.uint32(y) >= wp.uint32(grid.ny) or wp.uint32(z) >= wp.uint32(grid.nz)
    )


@wp.func
def solid_at(grid: OccupancyView, x: int, y: int, z: int, height: float) -> bool:
    """Whether a height lies within the solid span of a cell."""
    if out_of_grid(grid, x, y, z):
        return False
    place = grid.index[(z * grid.ny + y) * grid.nx + x]
    if place < 0:
        return False
    span = grid.spans[place]
    return height >= span[0] and height <= span[1]


@wp.func
def starts_on_a_side(grid: OccupancyView, ray: GridRay, x: int, y: int, z: int, axis: int) -> bool:
    """Whether a ray starts on a side of its first cell that no neighbour covers, and goes in."""
    step = ray.step[axis]
    at = wp.where(axis == 0, x, y)
    if step == 0 or float(at + 1 - ray.ahead[axis]) != ray.origin[axis]:
        return False
    bx = x - wp.where(axis == 0, step, 0)
    by = y - wp.where(axis == 1, step, 0)
    return not solid_at(grid, bx, by, z, ray.origin[2])


@wp.func
def meet_cell(
    grid: OccupancyView,
    ray: GridRay,
    x: int,
    y: int,
    z: int,
    span: wp.vec2,
    t_in: float,
    z_in: float,
    t_out: float,
    z_out: float,
    axis: int,
    steps: int,
) -> GridHit:
    """What a ray meets in a cell that is not empty; kind NONE where it passes."""
    hit = GridHit()
    hit.status = OK
    hit.cell = wp.vec3i(x, y, z)
    hit.steps = steps
    low = span[0]
    high = span[1]
    dz = ray.direction[2]
    if z_in > high:
        if z_out <= high:
            hit.kind = ROOF
            hit.t = wp.clamp((high - ray.origin[2]) * ray.inverse[2], t_in, t_out)
            hit.normal = wp.vec3(0.0, 0.0, 1.0)
        return hit
    if z_in < low:
        if z_out >= low:
            hit.kind = CEILING
            hit.t = wp.clamp((low - ray.origin[2]) * ray.inverse[2], t_in, t_out)
            hit.normal = wp.vec3(0.0, 0.0, -1.0)
        return hit
    hit.t = t_in
    if axis != START:
        hit.normal = side_normal(axis, ray)
        hit.kind = WALL
        if axis == 2:
            hit.kind = wp.where(dz < 0.0, ROOF, CEILING)
        return hit
    # It starts within the span, or on its border.
    if (z_in == high and dz > 0.0) or (z_in == low and dz < 0.0):
        return hit
    if z_in == high or z_in == low:
        on_top = z_in == high
        hit.kind = wp.where(on_top, ROOF, CEILING)
        hit.normal = wp.vec3(0.0, 0.0, wp.where(on_top, 1.0, -1.0))
        return hit
    for k in range(2):
        if hit.kind == NONE and starts_on_a_side(grid, ray, x, y, z, k):
            hit.kind = WALL
            hit.normal = side_normal(k, ray)
    if hit.kind == NONE:
        return miss(INSIDE, steps)
    return hit


@wp.func
def walk_grid_cells(grid: OccupancyView, ray: GridRay, step_limit: int) -> GridHit:
    """The first hit of a ray, cell by cell; t in cells."""
    if ray.status != OK:
        return miss(ray.status, 0)
    entry = enter_grid(grid, ray)
    if entry.inside == 0:
        return miss(SKY, 0)
    t_in = entry.t
    axis = entry.axis
    x = cell_of_axis(0, t_in, True, 0, grid.nx - 1, -1, ray)
    y = cell_of_axis(1, t_in, True, 0, grid.ny - 1, -1, ray)
    z = cell_of_axis(2, t_in, True, 0, grid.nz - 1, -1, ray)
    z_in = entry_height(grid, ray, entry)
    steps = int(0)
    while steps < step_limit:
        steps += 1
        t_x = axis_time(ray, 0, x + ray.ahead[0])
        t_y = axis_time(ray, 1, y + ray.ahead[1])
        t_z = axis_time(ray, 2, z + ray.ahead[2])
        t_out = wp.min(t_x, wp.min(t_y, t_z))
        z_out = height_at(ray, t_out, t_z, z + ray.ahead[2])
        place = grid.index[(z * grid.ny + y) * grid.nx + x]
        if place >= 0:
            hit = meet_cell(grid, ray, x, y, z, grid.spans[place], t_in, z_in, t_out, z_out, axis, steps)
            if hit.kind != NONE or hit.status != OK:
                return hit
        axis = wp.where(t_x <= t_out, 0, wp.where(t_y <= t_out, 1, 2))
        x += wp.where(axis == 0, ray.step[0], 0)
        y += wp.where(axis == 1, ray.step[1], 0)
        z += wp.where(axis == 2, ray.step[2], 0)
        if out_of_grid(grid, x, y, z):
            return miss(SKY, steps)
        t_in = t_out
        z_in = z_out
    return miss(STEP_LIMIT, steps)


@wp.func
def walk_grid_hierarchy(grid: OccupancyView, ray: GridRay, step_limit: int) -> GridHit:
    """The first hit of a ray, over the pyramid of what is not empty; t in cells."""
    if ray.status != OK:
        return miss(ray.status, 0)
    entry = enter_grid(grid, ray)
    if entry.inside == 0:
        return miss(SKY, 0)
    t_in = entry.t
    axis = entry.axis
    x = cell_of_axis(0, t_in, True, 0, grid.nx - 1, -1, ray)
    y = cell_of_axis(1, t_in, True, 0, grid.ny - 1, -1, ray)
    z = cell_of_axis(2, t_in, True, 0, grid.nz - 1, -1, ray)
    z_in = entry_height(grid, ray, entry)
    level = wp.min(START_LEVEL, grid.level_count - 1)
    steps = int(0)
    while steps < step_limit:
        steps += 1
        node_x = x >> level
        node_y = y >> level
        node_z = z >> level
        place = int(EMPTY)
        full = bool(False)
        if level > 0:
            width = ((grid.nx - 1) >> level) + 1
            depth = ((grid.ny - 1) >> level) + 1
            full = grid.pyramid[grid.level_first[level] + (node_z * depth + node_y) * width + node_x] != wp.uint8(0)
        else:
            place = grid.index[(z * grid.ny + y) * grid.nx + x]
        if full:
            level -= 1
        else:
            border_x = (node_x + ray.ahead[0]) << level
            border_y = (node_y + ray.ahead[1]) << level
            border_z = (node_z + ray.ahead[2]) << level
            t_x = axis_time(ray, 0, border_x)
            t_y = axis_time(ray, 1, border_y)
            t_z = axis_time(ray, 2, border_z)
            t_out = wp.min(t_x, wp.min(t_y, t_z))
            z_out = height_at(ray, t_out, t_z, border_z)
            if place >= 0:
                hit = meet_cell(grid, ray, x, y, z, grid.spans[place], t_in, z_in, t_out, z_out, axis, steps)
                if hit.kind != NONE or hit.status != OK:
                    return hit
            # Over the node, into the cell beyond its border; along the other axes the ray stays within the node.
            axis = wp.where(t_x <= t_out, 0, wp.where(t_y <= t_out, 1, 2))
            last = (1 << level) - 1
            if level > 0:
                # Of equal times the lower axis is first: its border is behind already.
                if axis != 0:
                    x = cell_of_axis(0, t_out, True, node_x << level, (node_x << level) + last, x, ray)
                if axis != 1:
                    y = cell_of_axis(1, t_out, axis == 2, node_y << level, (node_y << level) + last, y, ray)
                if axis != 2:
                    z = cell_of_axis(2, t_out, False, node_z << level, (node_z << level) + last, z, ray)
            x = wp.where(axis == 0, border_x - 1 + ray.ahead[0], x)
            y = wp.where(axis == 1, border_y - 1 + ray.ahead[1], y)
            z = wp.where(axis == 2, border_z - 1 + ray.ahead[2], z)
            if out_of_grid(grid, x, y, z):
                return miss(SKY, steps)
            t_in = t_out
            z_in = z_out
            above = level + 1
            moved = (x >> above) != (node_x >> 1) or (y >> above) != (node_y >> 1) or (z >> above) != (node_z >> 1)
            if above < grid.level_count and moved:
                level = above
    return miss(STEP_LIMIT, steps)


@wp.func
def trace_grid(grid: OccupancyView, origin: wp.vec3, direction: wp.vec3, hierarchy: int, step_limit: int) -> GridHit:
    """The first hit of a ray in the frame of the grid's place: t a distance, the normal along that frame's axes.

    Args:
        grid: `Occupancy.view`.
        origin, direction: The ray; the direction may have any length.
        hierarchy: 0: cell by cell.
        step_limit: From `Occupancy.step_limit`.
    """
    ray = to_grid(grid.place, origin, direction)
    hit = GridHit()
    if hierarchy != 0:
        hit = walk_grid_hierarchy(grid, ray, step_limit)
    else:
        hit = walk_grid_cells(grid, ray, step_limit)
    hit.t = hit.t * grid.place.cell
    hit.normal = swap_up(grid.place, hit.normal)
    return hit


@wp.kernel
def trace_occupancy_kernel(
    first: int,
    grid: OccupancyView,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    hierarchy: int,
    step_limit: int,
    out_kind: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_cell: wp.array(dtype=wp.vec3i),
    out_normal: wp.array(dtype=wp.vec3),
    out_steps: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per ray."""
    i = first + wp.tid()
    hit = trace_grid(grid, origins[i], directions[i], hierarchy, step_limit)
    out_kind[i] = hit.kind
    out_t[i] = hit.t
    out_cell[i] = hit.cell
    out_normal[i] = hit.normal
    out_steps[i] = hit.steps
    out_status[i] = wp.uint8(hit.status)


@dataclass(frozen=True)
class Occupancy:
    """A grid of cells and where it lies.

    Attributes:
        view: For kernels, see `trace_grid`. Rays in device arrays are given in the frame of `view.place`.
        origin: float64 [3], where `view.place` has its origin in the frame of rays given as host arrays.
        cell: Edge of a cell. [scene units]
        shape: Cells (nx, ny, nz), z up.
        full_count: Cells that are not empty.
        device: Warp device.
    """

    view: OccupancyView
    origin: np.ndarray
    cell: float
    shape: tuple[int, int, int]
    full_count: int
    device: wp.Device

    def step_limit(self, walk: str) -> int:
        """Steps that no ray needs more of, per walk."""
        return sum(self.shape) * (HIERARCHY_STEPS if walk == "hierarchy" else 1) + 2 + 2 * self.view.level_count

    @property
    def bytes(self) -> int:
        """Memory of the cells and the pyramid."""
        return 4 * len(self.view.index) + 8 * len(self.view.spans) + len(self.view.pyramid)


def make_occupancy(
    cells: np.ndarray,
    spans: np.ndarray | None,
    shape: tuple[int, int, int],
    cell: float = 1.0,
    corner=(0.0, 0.0, 0.0),
    up: str = "Z",
    place_corner=None,
    device="cpu",
) -> Occupancy:
    """A grid from the list of its cells that are not empty.

    Args:
        cells: int [n, 3], distinct (x, y, z), z up; x and y as in `heightfield.make_heightfield`.
        spans: Floor and top of what is solid in each, above `corner`, [n, 2], scene units, within the cell; None: all of it.
        shape: Cells (nx, ny, nz).
        cell, corner, up, place_corner, device: As for `heightfield.make_heightfield`.

    Raises:
        ValueError: a shape without cells or with too many, cells outside it, spans that are not finite or upside down, or a
            cell, corner or axis that cannot be.
    """
    nx, ny, nz = (int(n) for n in shape)
    if min(nx, ny, nz) < 1 or max(nx, ny, nz) > CELLS_MAX or nx * ny * nz > GRID_CELLS_MAX:
        raise ValueError(f"shape: got {shape}, expected 1 to {CELLS_MAX} cells a side and {GRID_CELLS_MAX} in all")
    cells = np.asarray(cells, np.int64).reshape(-1, 3)
    if len(cells) and (cells.min() < 0 or (cells >= (nx, ny, nz)).any()):
        raise ValueError(f"cells: got {cells.min(axis=0)} to {cells.max(axis=0)}, expected cells of a grid of {shape}")
    if spans is None:
        spans = np.stack([cells[:, 2], cells[:, 2] + 1], axis=1) * float(cell)
    spans = np.asarray(spans, np.float64)
    if spans.shape != (len(cells), 2) or not np.isfinite(spans).all() or (spans[:, 0] > spans[:, 1]).any():
        raise ValueError(f"spans: got shape {spans.shape}, expected [{len(cells)}, 2], finite, floor below top")
    view = OccupancyView()
    view.place = place_grid((0.0, 0.0, 0.0) if place_corner is None else place_corner, cell, up)
    origin = frame_origin(corner, place_corner)
    order = np.argsort((cells[:, 2] * ny + cells[:, 1]) * nx + cells[:, 0], kind="stable")
    index = np.full((nz, ny, nx), EMPTY, np.int32)
    index[cells[order, 2], cells[order, 1], cells[order, 0]] = np.arange(len(cells), dtype=np.int32)
    levels = []
    level = index >= 0
    while level.size > 1:
        level = any_of_eight(level)
        levels.append(level)
    first = np.concatenate([[0, 0], np.cumsum([each.size for each in levels])[:-1]]).astype(np.int32)
    view.index = wp.array(index.reshape(-1), dtype=int, device=device)
    view.spans = wp.array((spans[order] / cell).astype(np.float32), dtype=wp.vec2, device=device)
    flat = np.concatenate([each.reshape(-1) for each in levels]) if levels else np.zeros(0, bool)
    view.pyramid = wp.array(flat.astype(np.uint8), dtype=wp.uint8, device=device)
    view.level_first = wp.array(first, dtype=int, device=device)
    view.level_count = len(levels) + 1
    view.nx, view.ny, view.nz = nx, ny, nz
    return Occupancy(view, origin, float(cell), (nx, ny, nz), len(cells), wp.get_device(device))


def any_of_eight(level: np.ndarray) -> np.ndarray:
    """The next level of a pyramid of booleans: whether any of each 2 x 2 x 2 elements is."""
    padded = np.pad(level, [(0, n % 2) for n in level.shape])
    nz, ny, nx = (n // 2 for n in padded.shape)
    return padded.reshape(nz, 2, ny, 2, nx, 2).any(axis=(1, 3, 5))


def trace_occupancy(
    grid: Occupancy, origins, directions, walk: str = "hierarchy", threads: int = 0, step_limit: int = 0
) -> GridTrace:
    """The first thing that each ray meets in a grid of cells; see `heightfield.trace_heightfield`."""
    if walk not in WALKS:
        raise ValueError(f"walk: got {walk!r}, expected one of {', '.join(WALKS)}")
    origins = rays_on_device(origins, "origins", grid.origin, grid.device)
    directions = rays_on_device(directions, "directions", np.zeros(3), grid.device)
    if len(origins) != len(directions):
        raise ValueError(f"directions: got {len(directions)}, expected {len(origins)}, one per origin")
    trace = GridTrace.empty(len(origins), grid.device)
    inputs = [grid.view, origins, directions, WALKS[walk], step_limit or grid.step_limit(walk), *trace.arrays]
    launch(trace_occupancy_kernel, len(origins), inputs, grid.device, threads, split_min=TRACE_SPLIT_MIN)
    return trace
