"""A scene as a field that rays are traced through without its triangles: a heightfield where it has no overhangs, else a grid.

For techniques that ask where a ray meets the surroundings of a mirror but not which triangle exactly (maps). In short:

    field = make_field(scene, settings, without=moving_parts)       # once per stage; `field.reason` for the plan
    trace = field.intersect(origins, directions, threads)           # vec3 arrays, scene frame, any length of direction
    trace.t, trace.normal, trace.triangle, trace.status             # float, vec3, int, uint8 [n]; t a distance

and inside a kernel, with `field.view` as an argument: `hit = intersect_field(view, origin, direction)`, a `FieldHit`. A hit has
status CONVERGED; `triangle` is one of the scene's (its prim: `scene.host_triangle_patch`) that stands in the cell that was hit:
the roof of the column in a heightfield, what fills most of the cell in a grid. The normal is that of the cell's side, or up
or down. SKY: the ray leaves; INSIDE: it starts in something solid; -1 and 0 go with both.

Sources: Meyer and Loscos 2003, section 4.2 (the heightfield, seen from above in an orthographic picture) and section 8 (the 3-D
grid that they left as future work). Differs from them by: the exact point of a roof, see `heightfield.py`; the choice between
the two by measured overhang.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import raster
from warp_reflect.grid_rays import CELLS_MAX, UP_AXES, GridHit
from warp_reflect.heightfield import Heightfield, HeightfieldView, make_heightfield, trace_field
from warp_reflect.launch import FINITE_FLAGS, launch
from warp_reflect.layers import Camera
from warp_reflect.occupancy import GRID_CELLS_MAX, Occupancy, OccupancyView, make_occupancy, trace_grid
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.voxels import voxelise

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

HEIGHTFIELD = wp.constant(0)
OCCUPANCY = wp.constant(1)
FIELD_KINDS = {"heightfield": 0, "occupancy": 1}

AUTO_COLUMNS = 1024  # along the longer side of a heightfield of automatic cell size: 4 MB, the paper's 1 m for 1 km
COLUMNS_MAX = 1 << 24  # of a heightfield: 134 MB with its triangles
# Of a grid of automatic cell size: 8 MB. Rays through finer ones are no faster than through the triangles themselves.
AUTO_CELLS = 1 << 21
# Of the grid that overhang is measured in, and the columns along its longer side: a second for half a million triangles.
MEASURED_CELLS = 1 << 21
MEASURED_COLUMNS = 512
COARSER = 1.5  # times the cell where what was asked for is too much to hold
SPLIT_MIN = 1024  # rays; at 0.1 to 0.5 us each


@wp.struct
class FieldView:
    """A field on the device, in the scene frame; one of the two grids is empty."""

    kind: int
    heightfield: HeightfieldView
    occupancy: OccupancyView
    triangle: wp.array(dtype=int)  # per column, or per cell that is not empty; -1 none
    step_limit: int


@wp.struct
class FieldHit:
    """What a ray meets in a field; scene frame."""

    t: float  # distance from the origin; 0 without a hit
    normal: wp.vec3  # unit, towards the ray's origin; 0 without a hit
    triangle: int  # -1 without a hit
    status: int


@wp.func
def intersect_field(field: FieldView, origin: wp.vec3, direction: wp.vec3) -> FieldHit:
    """The first thing that a ray meets; the direction may have any length."""
    hit = FieldHit()
    hit.triangle = -1
    met = GridHit()
    if field.kind == HEIGHTFIELD:
        met = trace_field(field.heightfield, origin, direction, 1, field.step_limit)
        if met.kind != 0:
            hit.triangle = field.triangle[met.cell[1] * field.heightfield.nx + met.cell[0]]
    else:
        met = trace_grid(field.occupancy, origin, direction, 1, field.step_limit)
        if met.kind != 0:
            place = (met.cell[2] * field.occupancy.ny + met.cell[1]) * field.occupancy.nx + met.cell[0]
            hit.triangle = field.triangle[field.occupancy.index[place]]
    hit.t = met.t
    hit.normal = met.normal
    hit.status = met.status
    return hit


@wp.kernel
def intersect_kernel(
    first: int,
    field: FieldView,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    out_t: wp.array(dtype=float),
    out_normal: wp.array(dtype=wp.vec3),
    out_triangle: wp.array(dtype=int),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per ray."""
    i = first + wp.tid()
    hit = intersect_field(field, origins[i], directions[i])
    out_t[i] = hit.t
    out_normal[i] = hit.normal
    out_triangle[i] = hit.triangle
    out_status[i] = wp.uint8(hit.status)


@dataclass
class FieldTrace:
    """What an array of rays meets in a field; device arrays, one element per ray; see `FieldHit`."""

    t: wp.array  # float32
    normal: wp.array  # vec3
    triangle: wp.array  # int32
    status: wp.array  # uint8: CONVERGED, SKY, INSIDE, BAD_INPUT, DEGENERATE or STEP_LIMIT


@dataclass(frozen=True)
class SceneField:
    """A scene as a field.

    Attributes:
        view: For kernels, see `intersect_field`.
        kind: "heightfield" or "occupancy".
        grid: The one of the two that it is.
        cell: Edge of a column or cell. [scene units]
        overhang: Share of the columns with free space under a roof, as measured; None where the kind was asked for.
        reason: Why it is of this kind, in numbers.
        device: Warp device.
    """

    view: FieldView
    kind: str
    grid: Heightfield | Occupancy
    cell: float
    overhang: float | None
    reason: str
    device: wp.Device

    @property
    def bytes(self) -> int:
        """Memory on the device."""
        return self.grid.bytes + 4 * len(self.view.triangle)

    def intersect(self, origins: wp.array, directions: wp.array, threads: int = 0) -> FieldTrace:
        """The first thing that each ray meets.

        Args:
            origins: vec3 [n], scene frame.
            directions: vec3 [n], of any length; zero or not finite: a status, no hit.
            threads: CPU threads; 0: one per core.
        """
        made = [wp.empty(len(origins), dtype=kind, device=self.device) for kind in (float, wp.vec3, int, wp.uint8)]
        inputs = [self.view, origins, directions, *made]
        launch(intersect_kernel, len(origins), inputs, self.device, threads, split_min=SPLIT_MIN)
        return FieldTrace(*made)


def make_field(scene: Scene, settings: Settings, without: Iterable[int] = ()) -> SceneField | None:
    """The field of a scene's triangles.

    Args:
        scene: The stage at one time.
        settings: `field_kind`, `field_cell`, `field_overhang`, `threads`.
        without: Indices into `scene.parts` of what is left out: what moves, and the mirror itself.

    Returns:
        The field; None if nothing is left to make it of.
    """
    left_out = set(without)
    kept = np.ones(scene.triangle_count, bool)
    for k in left_out:
        part = scene.parts[k]
        kept[part.first_triangle : part.first_triangle + part.triangle_count] = False
    chosen = np.flatnonzero(kept).astype(np.int32)
    if not len(chosen):
        return None
    level = [0, 3 - UP_AXES[scene.data.up_axis]]
    axes = [*level, UP_AXES[scene.data.up_axis]]  # of the scene frame, in the order of the grid frame
    points = scene.host_points[:, axes].astype(np.float64)
    triangles = scene.host_triangles[chosen]
    used = points[np.unique(triangles)]
    low, high = used.min(axis=0), used.max(axis=0)
    kind, overhang = settings.field_kind, None
    if kind == "auto":
        seeds = places_of_interest(scene, left_out)[:, axes]
        overhang = measure_overhang(points, triangles, low, high, seeds, scene.device, settings.threads)
        kind = "heightfield" if overhang <= settings.field_overhang else "occupancy"
        sign = "<=" if kind == "heightfield" else ">"
        reason = f"{100 * overhang:.1f} % of the columns have free space under a roof, {sign} {100 * settings.field_overhang:g} %"
        reason += " (field_overhang)"
    else:
        reason = f"field_kind={kind}"
    view = FieldView()
    view.kind = FIELD_KINDS[kind]
    if kind == "heightfield":
        grid, triangle = build_heightfield(scene, low, high, axes, settings, left_out)
    else:
        grid, own = build_occupancy(scene, points, triangles, low, high, axes, settings)
        triangle = chosen[own]
    view.heightfield = grid.view if kind == "heightfield" else HeightfieldView()
    view.occupancy = grid.view if kind == "occupancy" else OccupancyView()
    view.step_limit = grid.step_limit("hierarchy")
    view.triangle = wp.array(triangle, dtype=int, device=scene.device)
    asked = settings.field_cell
    coarser = f"; cells of {asked:g} would be too many" if asked > 0.0 and grid.cell > 1.001 * asked else ""
    return SceneField(
        view, kind, grid, grid.cell, overhang, f"{reason}; cells of {grid.cell:.3g}{coarser}", scene.device
    )


def build_heightfield(scene, low, high, axes, settings, without) -> tuple[Heightfield, np.ndarray]:
    """The heightfield of a scene by an orthographic picture from above, and the triangle that each column shows, int [n]."""
    extent = np.maximum(high - low, 1e-6 * max(float((high - low).max()), 1e-30))
    sides = float(extent[:2].max())
    cell = settings.field_cell or sides / AUTO_COLUMNS
    cell = max(cell, sides / (CELLS_MAX - 1), float(np.sqrt(extent[0] * extent[1] / COLUMNS_MAX)))
    nx, ny = (max(1, int(np.ceil(n / cell - 1e-6))) for n in extent[:2])
    # Centred: a stage that is symmetric gets a field that is.
    corner = 0.5 * (low + high)
    corner[:2] -= 0.5 * cell * np.array([nx, ny])
    corner[2] = low[2]
    depth = float(extent[2]) + 2.0 * cell
    eye = np.zeros(3)
    eye[axes] = [corner[0] + 0.5 * cell * nx, corner[1] + 0.5 * cell * ny, high[2] + cell]
    right, up = np.zeros(3), np.zeros(3)
    right[axes[0]], up[axes[1]] = 1.0, -1.0  # rows go down the picture and along the second level axis
    forward = np.zeros(3)
    forward[axes[2]] = -1.0
    camera = Camera(
        eye + scene.origin, right, up, forward, 1.0 / cell, 1.0 / cell, 0.5 * nx, 0.5 * ny, 0.0, depth, (nx, ny), True
    )
    seen = raster.draw_scene(scene, camera, settings.threads, without, settings.kernels)
    own = seen.triangle.numpy()
    heights = high[2] + cell - corner[2] - (1.0 - seen.depth_key.numpy().astype(np.float64)) * depth
    heights[own < 0] = np.nan
    place_corner = np.zeros(3)
    place_corner[axes] = corner
    made = make_heightfield(
        heights.reshape(ny, nx), cell, place_corner + scene.origin, scene.data.up_axis, place_corner, scene.device
    )
    return made, own


def build_occupancy(scene, points, triangles, low, high, axes, settings) -> tuple[Occupancy, np.ndarray]:
    """The grid of the cells that triangles touch, and which triangle fills most of each, int [n]."""
    cell = settings.field_cell or automatic_cell(high - low, AUTO_CELLS)
    while True:
        corner, shape, cell = grid_around(low, high, cell)
        made = voxelise((points - corner) / cell, triangles, shape, scene.device, settings.threads)
        if made is not None:
            break
        cell *= COARSER
    cells, spans, own = made
    place_corner = np.zeros(3)
    place_corner[axes] = corner
    grid = make_occupancy(
        cells,
        spans.astype(np.float64) * cell,
        shape,
        cell,
        place_corner + scene.origin,
        scene.data.up_axis,
        place_corner,
        scene.device,
    )
    return grid, own


def automatic_cell(extent: np.ndarray, cells: int) -> float:
    """Edge of the cells of which a box holds about so many."""
    # A flat box still has one layer.
    extent = np.maximum(extent, 1e-3 * max(float(extent.max()), 1e-30))
    return float(np.cbrt(np.prod(extent) / cells))


def grid_around(low: np.ndarray, high: np.ndarray, cell: float) -> tuple[np.ndarray, tuple[int, int, int], float]:
    """Corner, shape and cell of a grid around a box, half a cell wider on every side; coarser where it would be too large."""
    while True:
        shape = tuple(int(n) for n in np.ceil((high - low) / cell - 1e-6) + 1)
        if max(shape) <= CELLS_MAX and np.prod(shape, dtype=float) <= GRID_CELLS_MAX:
            return 0.5 * (low + high) - 0.5 * cell * np.array(shape), shape, cell
        cell *= COARSER


def places_of_interest(scene: Scene, parts: Iterable[int]) -> np.ndarray:
    """Where something is looked from: cameras, reference environment maps, and parts (the mirrors); scene frame, [n, 3]."""
    places = [camera.world_from_camera[:3, 3] - scene.origin for camera in scene.data.cameras]
    places += [each.world_from_map[:3, 3] - scene.origin for each in scene.data.environment_maps]
    for k in parts:
        part = scene.parts[k]
        own = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
        if len(own):
            corners = scene.host_points[own.reshape(-1)].astype(np.float64)
            places.append(0.5 * (corners.min(axis=0) + corners.max(axis=0)))
    return np.array(places).reshape(-1, 3)


def measure_overhang(points, triangles, low, high, seeds, device, threads: int = 0) -> float:
    """Share of the columns with something in them that have free space under a roof.

    Measured in a grid of about two million cells. Space is free where it can be reached from above, from the sides or from
    the seeds, [n, 3]: the inside of a closed house is not, unless the camera or a mirror stands in it.
    """
    extent = high - low
    cell = max(automatic_cell(extent, MEASURED_CELLS), float(extent[:2].max()) / MEASURED_COLUMNS)
    corner, shape, cell = grid_around(low, high, cell)
    made = voxelise((points - corner) / cell, triangles, shape, device, threads)
    if made is None:
        return 1.0
    cells = made[0]
    nx, ny, nz = shape
    full = np.zeros((nz, ny, nx), bool)
    full[cells[:, 2], cells[:, 1], cells[:, 0]] = True
    seed_cells = np.floor((seeds - corner) / cell)
    seed_cells = seed_cells[((seed_cells >= 0) & (seed_cells < shape)).all(axis=1)].astype(int)
    free = reached_space(full, seed_cells)
    # Free cells with a full one above them.
    roof = np.flip(np.logical_or.accumulate(np.flip(full, 0), axis=0), 0)
    covered = (free & roof).any(axis=0)
    return float(covered.sum() / max(full.any(axis=0).sum(), 1))


def reached_space(full: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The empty cells that are joined by empty cells to the top or the sides of a grid, or to a seed, bool [nz, ny, nx].

    Args:
        full: Which cells are not empty, bool [nz, ny, nx].
        seeds: Cells (x, y, z), int [n, 3].
    """
    reached = np.zeros_like(full)
    reached[seeds[:, 2], seeds[:, 1], seeds[:, 0]] = True
    reached[-1] = True
    reached[:, [0, -1]] = True
    reached[:, :, [0, -1]] = True
    reached &= ~full
    before, now = -1, 0
    while before != now:
        before = now
        for axis in range(3):
            lines, seen = np.moveaxis(full, axis, -1), np.moveaxis(reached, axis, -1)
            shape = lines.shape
            flat, lit = lines.reshape(-1, shape[-1]), seen.reshape(-1, shape[-1])
            # Runs of empty cells along the axis: a run is reached where one of its cells is.
            start = np.ones_like(flat)
            start[:, 1:] = flat[:, 1:] != flat[:, :-1]
            first = np.flatnonzero(start.reshape(-1))
            run = np.logical_or.reduceat(lit.reshape(-1), first)
            lengths = np.diff(np.append(first, flat.size))
            lit = np.repeat(run, lengths).reshape(shape) & ~lines
            reached = np.ascontiguousarray(np.moveaxis(lit, -1, axis))
        now = int(reached.sum())
    return reached
