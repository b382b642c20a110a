"""Rays against a heightfield: a level grid of columns, each solid from below up to its height.

Two walks with the same answers. `cells` goes from column to column. `hierarchy` goes over a pyramid of greatest heights (but
steep rays, which it would not help, go as by `cells`): a node that the ray passes above is skipped whole, one that it may
meet is looked into; after a skip it goes up one level only where the parent changes too (up after every skip, it would come
down again at once). In a column the ray meets the wall
where it comes in below the top, else the roof where it sinks below it, both exactly: the point of entry into the column,
which Meyer and Loscos take, is off by up to the column's width over the ray's slope.

A column without a height (a hole: not finite when the field was made) is open all the way down. Rays that touch a top or a
wall meet it. One that starts on a roof and rises leaves it; one that starts within a column has status INSIDE and no hit.

Sources: Amanatides and Woo 1987 (see `grid_rays.py`); Musgrave, Grid Tracing, Yale 1988; Tevs, Ihrke and Seidel, Maximum
Mipmaps for Fast, Accurate, and Scalable Dynamic Height Field Rendering, I3D 2008. Differs from the last by: the state is the
integer column, never a position that is moved on, and the walk starts near the bottom of the pyramid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.grid_rays import (
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
from warp_reflect.launch import FINITE_FLAGS, launch

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

HOLE = wp.constant(-3.0e38)  # height of a column without one; below all that a ray reaches
# Of the pyramid. Measured: from level 2 a ray takes 10 to 17 steps where it takes 16 to 23 from the top.
START_LEVEL = wp.constant(2)
# Steep rays go column by column in either walk: through 5 to 11 columns the hierarchy took 1.25 to 1.55 times as long.
STEEP, STEEP_COLUMNS = wp.constant(2.0), wp.constant(16.0)
WALKS = {"cells": 0, "hierarchy": 1}
# Steps of the hierarchy per column along the sides: each column that it stops at may cost a way down the pyramid.
HIERARCHY_STEPS = 4
TRACE_SPLIT_MIN = 1024  # rays; at 0.1 to 0.5 us each


@wp.struct
class HeightfieldView:
    """A heightfield on the device; heights in cells above the grid's corner."""

    place: GridPlace
    heights: wp.array(dtype=float)  # every level of the pyramid of greatest heights, row by row, the columns first
    level_first: wp.array(dtype=int)
    level_count: int
    nx: int
    ny: int
    top: float  # the greatest height


@wp.func
def enter_field(field: HeightfieldView, ray: GridRay) -> Entry:
    """Where a ray comes into the box of a field, which is open below."""
    entry = Entry()
    entry.end = FAR
    entry.axis = START
    entry.inside = 1
    entry = clip_axis(entry, 0, 0, field.nx, ray)
    entry = clip_axis(entry, 1, 0, field.ny, ray)
    if ray.origin[2] > field.top:
        if ray.direction[2] >= 0.0:
            entry.inside = 0
        else:
            t_top = (field.top - ray.origin[2]) * ray.inverse[2]
            if t_top > entry.t:
                entry.t = t_top
                entry.axis = 2
            if t_top > entry.end:
                entry.inside = 0
    return entry


@wp.func
def entry_cell(axis: int, count: int, t: float, ray: GridRay) -> int:
    """The column of an axis in which a ray is when it comes in."""
    return cell_at(
        t,
        True,
        0,
        count - 1,
        ray.origin[axis],
        ray.direction[axis],
        ray.inverse[axis],
        ray.step[axis],
        ray.ahead[axis],
        -1,
    )


@wp.func
def column_height(field: HeightfieldView, x: int, y: int) -> float:
    return field.heights[y * field.nx + x]


@wp.func
def out_of_field(field: HeightfieldView, x: int, y: int) -> bool:
    # One comparison each: as unsigned numbers the negative ones are the largest.
    return wp.uint32(x) >= wp.uint32(field.nx) or wp.uint32(y) >= wp.uint32(field.ny)


@wp.func
def starts_on_a_wall(field: HeightfieldView, ray: GridRay, x: int, y: int, axis: int) -> bool:
    """Whether a ray starts on a side of its first column that no neighbour covers, and goes in."""
    step = ray.step[axis]
    behind = wp.where(axis == 0, x, y) + 1 - ray.ahead[axis]
    if step == 0 or float(behind) != ray.origin[axis]:
        return False
    bx = x - wp.where(axis == 0, step, 0)
    by = y - wp.where(axis == 1, step, 0)
    if bx < 0 or by < 0 or bx >= field.nx or by >= field.ny:
        return True
    return ray.origin[2] >= column_height(field, bx, by)


@wp.func
def meet_column(
    field: HeightfieldView,
    ray: GridRay,
    x: int,
    y: int,
    height: float,
    t_in: float,
    z_in: float,
    t_out: float,
    axis: int,
    steps: int,
) -> GridHit:
    """What a ray meets in a column whose height it reaches; kind NONE where it starts on the roof and rises."""
    hit = GridHit()
    hit.status = OK
    hit.cell = wp.vec3i(x, y, 0)
    hit.steps = steps
    hit.t = t_in
    hit.kind = ROOF
    hit.normal = wp.vec3(0.0, 0.0, 1.0)
    if z_in > height or axis == 2:
        hit.t = wp.clamp((height - ray.origin[2]) * ray.inverse[2], t_in, t_out)
        return hit
    if axis != START:
        hit.kind = WALL
        hit.normal = side_normal(axis, ray)
        return hit
    if z_in == height:
        if ray.direction[2] > 0.0:
            hit.kind = NONE
        return hit
    for k in range(2):
        if hit.kind == ROOF and starts_on_a_wall(field, ray, x, y, k):
            hit.kind = WALL
            hit.normal = side_normal(k, ray)
    if hit.kind == ROOF:
        return miss(INSIDE, steps)
    return hit


@wp.func
def walk_cells(field: HeightfieldView, ray: GridRay, step_limit: int) -> GridHit:
    """The first hit of a ray, column by column; t in cells."""
    if ray.status != OK:
        return miss(ray.status, 0)
    entry = enter_field(field, ray)
    if entry.inside == 0:
        return miss(SKY, 0)
    t_in = entry.t
    axis = entry.axis
    x = entry_cell(0, field.nx, t_in, ray)
    y = entry_cell(1, field.ny, t_in, ray)
    oz = ray.origin[2]
    dz = ray.direction[2]
    z_in = oz + t_in * dz
    steps = int(0)
    while steps < step_limit:
        steps += 1
        t_x = border_time(x + ray.ahead[0], ray.origin[0], ray.inverse[0], ray.never[0])
        t_y = border_time(y + ray.ahead[1], ray.origin[1], ray.inverse[1], ray.never[1])
        t_out = wp.min(t_x, t_y)
        z_out = oz + t_out * dz
        height = column_height(field, x, y)
        if wp.min(z_in, z_out) <= height:
            hit = meet_column(field, ray, x, y, height, t_in, z_in, t_out, axis, steps)
            if hit.kind != NONE or hit.status != OK:
                return hit
        # Without branches: which border comes first is a coin's toss to the processor.
        axis = wp.where(t_x <= t_y, 0, 1)
        x += wp.where(axis == 0, ray.step[0], 0)
        y += wp.where(axis == 0, 0, ray.step[1])
        if t_out >= FAR or out_of_field(field, x, y):
            return miss(SKY, steps)
        if dz >= 0.0 and z_out > field.top:
            return miss(SKY, steps)
        t_in = t_out
        z_in = z_out
    return miss(STEP_LIMIT, steps)


@wp.func
def walk_hierarchy(field: HeightfieldView, ray: GridRay, step_limit: int) -> GridHit:
    """The first hit of a ray, over the pyramid of greatest heights; t in cells."""
    if ray.status != OK:
        return miss(ray.status, 0)
    entry = enter_field(field, ray)
    if entry.inside == 0:
        return miss(SKY, 0)
    t_in = entry.t
    axis = entry.axis
    x = entry_cell(0, field.nx, t_in, ray)
    y = entry_cell(1, field.ny, t_in, ray)
    oz = ray.origin[2]
    dz = ray.direction[2]
    z_in = oz + t_in * dz
    level = wp.min(START_LEVEL, field.level_count - 1)
    steps = int(0)
    while steps < step_limit:
        steps += 1
        node_x = x >> level
        node_y = y >> level
        border_x = (node_x + ray.ahead[0]) << level
        border_y = (node_y + ray.ahead[1]) << level
        t_x = border_time(border_x, ray.origin[0], ray.inverse[0], ray.never[0])
        t_y = border_time(border_y, ray.origin[1], ray.inverse[1], ray.never[1])
        t_out = wp.min(t_x, t_y)
        z_out = oz + t_out * dz
        width = ((field.nx - 1) >> level) + 1
        height = field.heights[field.level_first[level] + node_y * width + node_x]
        reached = wp.min(z_in, z_out) <= height
        if reached and level > 0:
            level -= 1
        else:
            if reached:
                hit = meet_column(field, ray, x, y, height, t_in, z_in, t_out, axis, steps)
                if hit.kind != NONE or hit.status != OK:
                    return hit
            # Over the node, into the column beyond its border; along the other axis the ray stays within the node.
            axis = wp.where(t_x <= t_y, 0, 1)
            if level > 0:
                along_x = axis == 1
                first_cell = wp.where(along_x, node_x, node_y) << level
                other = cell_at(
                    t_out,
                    along_x,
                    first_cell,
                    first_cell + (1 << level) - 1,
                    wp.where(along_x, ray.origin[0], ray.origin[1]),
                    wp.where(along_x, ray.direction[0], ray.direction[1]),
                    wp.where(along_x, ray.inverse[0], ray.inverse[1]),
                    wp.where(along_x, ray.step[0], ray.step[1]),
                    wp.where(along_x, ray.ahead[0], ray.ahead[1]),
                    wp.where(along_x, x, y),
                )
                x = wp.where(along_x, other, border_x - 1 + ray.ahead[0])
                y = wp.where(along_x, border_y - 1 + ray.ahead[1], other)
            else:
                x += wp.where(axis == 0, ray.step[0], 0)
                y += wp.where(axis == 0, 0, ray.step[1])
            if t_out >= FAR or out_of_field(field, x, y):
                return miss(SKY, steps)
            if dz >= 0.0 and z_out > field.top:
                return miss(SKY, steps)
            t_in = t_out
            z_in = z_out
            above = level + 1
            if above < field.level_count and ((x >> above) != (node_x >> 1) or (y >> above) != (node_y >> 1)):
                level = above
    return miss(STEP_LIMIT, steps)


@wp.func
def is_steep(field: HeightfieldView, ray: GridRay) -> bool:
    """Whether a ray falls through all heights above the corner within so few columns that skipping them does not pay."""
    fall = -ray.direction[2]
    level = wp.sqrt(ray.direction[0] * ray.direction[0] + ray.direction[1] * ray.direction[1])
    return level <= STEEP * fall and field.top * level <= STEEP_COLUMNS * fall


@wp.func
def trace_field(
    field: HeightfieldView, origin: wp.vec3, direction: wp.vec3, hierarchy: int, step_limit: int
) -> GridHit:
    """The first hit of a ray in the frame of the field's place: t a distance, the normal along that frame's axes.

    Args:
        field: `Heightfield.view`.
        origin, direction: The ray; the direction may have any length.
        hierarchy: 0: column by column.
        step_limit: From `Heightfield.step_limit`.
    """
    ray = to_grid(field.place, origin, direction)
    hit = GridHit()
    if hierarchy != 0 and not is_steep(field, ray):
        hit = walk_hierarchy(field, ray, step_limit)
    else:
        hit = walk_cells(field, ray, step_limit)
    hit.t = hit.t * field.place.cell
    hit.normal = swap_up(field.place, hit.normal)
    return hit


@wp.func
def put_hit(
    i: int,
    hit: GridHit,
    out_kind: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_cell: wp.array(dtype=wp.vec3i),
    out_normal: wp.array(dtype=wp.vec3),
    out_steps: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
):
    out_kind[i] = hit.kind
    out_t[i] = hit.t
    out_cell[i] = hit.cell
    out_normal[i] = hit.normal
    out_steps[i] = hit.steps
    out_status[i] = wp.uint8(hit.status)


@wp.kernel
def trace_heightfield_kernel(
    first: int,
    field: HeightfieldView,
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
    hit = trace_field(field, origins[i], directions[i], hierarchy, step_limit)
    put_hit(i, hit, out_kind, out_t, out_cell, out_normal, out_steps, out_status)


@dataclass(frozen=True)
class Heightfield:
    """A heightfield and where it lies.

    Attributes:
        view: For kernels, see `trace_field`. Rays in device arrays are given in the frame of `view.place`.
        origin: float64 [3], where `view.place` has its origin in the frame of rays given as host arrays.
        cell: Edge of a column. [scene units]
        nx, ny: Columns.
        hole_count: Columns without a height.
        device: Warp device.
    """

    view: HeightfieldView
    origin: np.ndarray
    cell: float
    nx: int
    ny: int
    hole_count: int
    device: wp.Device

    def step_limit(self, walk: str) -> int:
        """Steps that no ray needs more of, per walk."""
        return (self.nx + self.ny) * (HIERARCHY_STEPS if walk == "hierarchy" else 1) + 2 + 2 * self.view.level_count

    @property
    def bytes(self) -> int:
        """Memory of the pyramid."""
        return 4 * len(self.view.heights)


def make_heightfield(
    heights: np.ndarray, cell: float = 1.0, corner=(0.0, 0.0, 0.0), up: str = "Z", place_corner=None, device="cpu"
) -> Heightfield:
    """A heightfield from an array of heights.

    Args:
        heights: Shape [ny, nx], above `corner` along the up axis, scene units; not finite: a hole. Element [j, i] is the
            column from i to i + 1 cells along the first level axis (X) and from j to j + 1 along the other (Y where Z is
            up, Z where Y is).
        cell: Edge of a column. [scene units]
        corner: Lowest corner of the grid, float64 [3], in the frame of rays given as host arrays.
        up: Axis that points up, "Y" or "Z".
        place_corner: The corner in the frame of rays given as device arrays; None: these are relative to the corner.
        device: Warp device.

    Raises:
        ValueError: no column, more than 16,384 along a side, or a cell, corner or axis that cannot be.
    """
    heights = np.asarray(heights, np.float64)
    if heights.ndim != 2 or not heights.size or max(heights.shape) > CELLS_MAX:
        raise ValueError(f"heights: got shape {heights.shape}, expected [ny, nx] of 1 to {CELLS_MAX} columns a side")
    place = place_grid((0.0, 0.0, 0.0) if place_corner is None else place_corner, cell, up)
    origin = frame_origin(corner, place_corner)
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = (heights / cell).astype(np.float32)
    hole = ~np.isfinite(scaled)
    scaled[hole] = HOLE
    levels = [scaled]
    while levels[-1].size > 1:
        levels.append(greatest_of_four(levels[-1]))
    view = HeightfieldView()
    view.place = place
    view.heights = wp.array(np.concatenate([level.reshape(-1) for level in levels]), dtype=float, device=device)
    first = np.concatenate([[0], np.cumsum([level.size for level in levels])[:-1]])
    view.level_first = wp.array(first.astype(np.int32), dtype=int, device=device)
    view.level_count = len(levels)
    view.ny, view.nx = heights.shape
    view.top = float(levels[-1][0, 0])
    return Heightfield(view, origin, float(cell), view.nx, view.ny, int(hole.sum()), wp.get_device(device))


def greatest_of_four(level: np.ndarray) -> np.ndarray:
    """The next level of a pyramid: the greatest of each 2 x 2 elements, [ceil(ny / 2), ceil(nx / 2)]."""
    ny, nx = level.shape
    padded = np.pad(level, ((0, ny % 2), (0, nx % 2)), mode="edge")
    return padded.reshape((ny + 1) // 2, 2, (nx + 1) // 2, 2).max(axis=(1, 3))


def trace_heightfield(
    field: Heightfield,
    origins,
    directions,
    walk: str = "hierarchy",
    threads: int = 0,
    step_limit: int = 0,
    kernels: str = "auto",
) -> GridTrace:
    """The first thing that each ray meets in a heightfield.

    Args:
        field: From `make_heightfield`.
        origins: Shape [n, 3], in the frame of the corner the field was made with (taken relative to it in float64); or a
            vec3 array on the device, in the frame of `field.view.place`.
        directions: Likewise, of any length but zero.
        walk: "hierarchy" or "cells": the same answers.
        threads: CPU threads; 0: one per core.
        step_limit: A ray ends with status STEP_LIMIT after so many steps; 0: a bound that none reaches.
        kernels: `Settings.kernels`: the same answers.

    Raises:
        ValueError: an unknown walk, or arrays of other or unequal shapes.
    """
    if walk not in WALKS:
        raise ValueError(f"walk: got {walk!r}, expected one of {', '.join(WALKS)}")
    origins = rays_on_device(origins, "origins", field.origin, field.device)
    directions = rays_on_device(directions, "directions", np.zeros(3), field.device)
    if len(origins) != len(directions):
        raise ValueError(f"directions: got {len(directions)}, expected {len(origins)}, one per origin")
    trace = GridTrace.empty(len(origins), field.device)
    limit = step_limit or field.step_limit(walk)
    if vector.chosen(kernels, field.device):
        from warp_reflect import heightfield_vector  # which uses this module's functions

        rays = [origins, directions]
        heightfield_vector.trace(field.view, rays, WALKS[walk], limit, trace, field.device, threads)
        return trace
    inputs = [field.view, origins, directions, WALKS[walk], limit, *trace.arrays]
    launch(trace_heightfield_kernel, len(origins), inputs, field.device, threads, split_min=TRACE_SPLIT_MIN)
    return trace
