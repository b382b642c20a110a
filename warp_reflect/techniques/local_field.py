"""Depths around a local map's centre out of a heightfield: every texel's own, without a ray for each.

Source: Meyer and Loscos, Real-Time Reflection on Moving Vehicles in Urban Environments, VRST 2003, section 4.2, who trace the
nodes of a mesh through a heightfield. Differs from it by:

* the texels of a side face that lie above one another have one way over the ground, so one walk from column to column
  finds what all of them meet, from the lowest up (as floating horizons do; Wright, ACM TOMS 1973): a texel costs no ray
  and there is no mesh that could miss something. The face that looks down, and what of the face that looks up is not open
  sky, is traced ray by ray;
* what a column's sides are of is asked of the triangles once, when the field is made; `local_map.py` meets their planes.

A centre beyond the field's columns or within something solid has no depths here: the caller traces the triangles.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warp_reflect import launch, vector
from warp_reflect.cubemap import RADIANCE_AXES
from warp_reflect.grid_rays import FAR, UP_AXES, border_time, swap_up
from warp_reflect.heightfield import HOLE, HeightfieldView, column_height, out_of_field
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.scene import Scene
from warp_reflect.scene_field import SceneField, make_field
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques.local_maps import LINES, LocalMaps, LocalPlace, texel_towards
from warp_reflect.techniques.local_mesh import DepthMesh, trace_depth_mesh

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

KEY = "field of local maps"
STEP_LEAST = 0.5  # cells: lower steps of the field are taken for slopes, of the triangle that the column shows
WALL_REACH = 1.5  # cells from the middle of the column before a wall in which its triangle is looked for
LEAST_HEIGHT = wp.constant(1.0e-6)  # cells over a roof: less is this
OPEN_SLACK = wp.constant(0.05)  # share of a slope: the corner of a roof may rise between two lines
HOLE_BELOW = 1.0  # cells below a top that a wall beside a hole is taken to reach
SPLIT_MIN = 32  # lines; a walk takes 2 to 20 us
GROUP_SPLIT_MIN = 8  # groups of them
GROUP_LINES = wp.constant(LINES)
STEEP_BLOCK = wp.constant(vector.BLOCK)
COLUMN_SIDES = 4  # towards lower and higher x, then y


@wp.struct
class FieldSides:
    """Which triangles the sides of a field's columns are of."""

    row: wp.array(dtype=int)  # per column: of `triangle`; -1 where no side stands out
    triangle: wp.array(dtype=int)  # four a row; -1 where none was found
    roof: wp.array(dtype=int)  # per column: what it shows from above


@wp.struct
class SideFace:
    """A side face of a map in the axes of a field, see `side_texel`."""

    ahead: wp.vec2  # the face's axis
    across: wp.vec2  # towards higher lines
    face: int
    corner: wp.vec2i  # 1: line 0, step 0 is the last row, the last column
    line_step: wp.vec2i  # rows and columns from line to line
    rise_step: wp.vec2i  # from step to step


@dataclass(frozen=True)
class LocalField:
    """A scene's field as local maps use it.

    Attributes:
        field: Of what never moves.
        sides: Of its columns; None where it is no heightfield.
        origin: Of the frame that the field lies in, world, float64 [3]: of the scene that it was made for.
        heights: Of its columns, float32 [ny, nx], as kernels have them; None where it is no heightfield.
    """

    field: SceneField
    sides: FieldSides | None
    origin: np.ndarray
    heights: np.ndarray | None = None


@wp.struct
class LevelWalk:
    """A way over the ground from column to column, in the field's axes; a time of 1 is as far as the way's vector."""

    x: int
    y: int
    step_x: int
    step_y: int
    ahead_x: int
    ahead_y: int
    inverse: wp.vec2
    never: wp.vec2
    origin: wp.vec3


@wp.func
def level_walk(field: HeightfieldView, eye: wp.vec3, way: wp.vec2) -> LevelWalk:
    """The walk from a place (scene frame) within a field; a component of 0 is none."""
    walk = LevelWalk()
    walk.origin = swap_up(field.place, eye - field.place.corner) * field.place.inverse
    walk.x = wp.clamp(int(wp.floor(walk.origin[0])), 0, field.nx - 1)
    walk.y = wp.clamp(int(wp.floor(walk.origin[1])), 0, field.ny - 1)
    walk.step_x = wp.where(way[0] < 0.0, -1, 1)
    walk.step_y = wp.where(way[1] < 0.0, -1, 1)
    walk.ahead_x = wp.where(way[0] < 0.0, 0, 1)
    walk.ahead_y = wp.where(way[1] < 0.0, 0, 1)
    walk.inverse = wp.vec2(wp.where(way[0] == 0.0, 0.0, 1.0 / way[0]), wp.where(way[1] == 0.0, 0.0, 1.0 / way[1]))
    walk.never = wp.vec2(wp.where(way[0] == 0.0, FAR, 0.0), wp.where(way[1] == 0.0, FAR, 0.0))
    return walk


@wp.func
def side_triangle(sides: FieldSides, column: int, axis: int, step: int) -> int:
    """The triangle that a ray which comes into a column along an axis meets on its side."""
    row = sides.row[column]
    found = int(-1)
    if row >= 0:
        found = sides.triangle[4 * row + 2 * axis + wp.where(step > 0, 0, 1)]
    return wp.where(found >= 0, found, sides.roof[column])


@wp.func
def side_texel(face: SideFace, n: int, line: int, step: int) -> int:
    """The texel of a map at a line of a side face, so many steps up."""
    row = face.corner[0] * (n - 1) + face.line_step[0] * line + face.rise_step[0] * step
    column = face.corner[1] * (n - 1) + face.line_step[1] * line + face.rise_step[1] * step
    return (face.face * n + row) * n + column


@wp.func
def sweep_line(
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    place: LocalPlace,
    origin: wp.vec3,
    k: int,
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_open: wp.array(dtype=float),
):
    """Line k of a map's side faces: the slope from which on it sees the sky, and what is below; `origin` is the field's."""
    n = place.resolution
    face = faces[k / n]
    line = k - (k / n) * n
    lateral = (2.0 * float(line) + 1.0) / float(n) - 1.0
    walk = level_walk(field, place.eye + origin, face.ahead + lateral * face.across)
    x = walk.x
    y = walk.y
    scale = field.place.inverse
    step = int(0)
    rise = 1.0 / float(n) - 1.0
    t_in = float(0.0)
    axis = int(0)
    highest = float(1.0)
    walking = int(1)
    while walking == 1 and step < n:
        t_x = border_time(x + walk.ahead_x, walk.origin[0], walk.inverse[0], walk.never[0])
        t_y = border_time(y + walk.ahead_y, walk.origin[1], walk.inverse[1], walk.never[1])
        t_out = wp.min(t_x, t_y)
        height = column_height(field, x, y) - walk.origin[2]
        # Into its wall, then onto its roof; a time of 1 is one cell along the face's axis.
        while step < n and t_in > 0.0 and rise * t_in <= height:
            i = place.first_texel + side_texel(face, n, line, step)
            out_inverse[i] = scale / t_in
            out_triangle[i] = side_triangle(
                sides, y * field.nx + x, axis, wp.where(axis == 0, walk.step_x, walk.step_y)
            )
            step += 1
            rise = (2.0 * float(step) + 1.0) / float(n) - 1.0
        if step == n and t_in > 0.0:
            highest = wp.max(highest, height / t_in)
        while step < n and rise * t_out <= height:
            i = place.first_texel + side_texel(face, n, line, step)
            out_inverse[i] = scale / wp.max(t_in, wp.min(height / rise, t_out))
            out_triangle[i] = sides.roof[y * field.nx + x]
            step += 1
            rise = (2.0 * float(step) + 1.0) / float(n) - 1.0
        axis = wp.where(t_x <= t_y, 0, 1)
        x += wp.where(axis == 0, walk.step_x, 0)
        y += wp.where(axis == 0, 0, walk.step_y)
        t_in = t_out
        if out_of_field(field, x, y) or (rise >= 0.0 and rise * t_out > field.top - walk.origin[2]):
            walking = 0
    # Above the face's last texel: how high what is beyond reaches.
    if step < n:
        highest = rise
    while step == n and walking == 1:
        t_x = border_time(x + walk.ahead_x, walk.origin[0], walk.inverse[0], walk.never[0])
        t_y = border_time(y + walk.ahead_y, walk.origin[1], walk.inverse[1], walk.never[1])
        t_out = wp.min(t_x, t_y)
        height = column_height(field, x, y) - walk.origin[2]
        if t_in > 0.0 and height > highest * t_in:
            highest = height / t_in
        x += wp.where(t_x <= t_y, walk.step_x, 0)
        y += wp.where(t_x <= t_y, 0, walk.step_y)
        t_in = t_out
        if out_of_field(field, x, y) or highest * t_out > field.top - walk.origin[2]:
            walking = 0
    out_open[place.first_group * GROUP_LINES + k] = highest
    while step < n:
        i = place.first_texel + side_texel(face, n, line, step)
        out_inverse[i] = 0.0
        out_triangle[i] = -1
        step += 1


@wp.kernel
def sweep_lines_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    places: wp.array(dtype=LocalPlace),
    group_map: wp.array(dtype=int),
    origin: wp.vec3,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_open: wp.array(dtype=float),
):
    """One thread per line of texels above one another."""
    k = first + wp.tid()
    place = places[group_map[k / GROUP_LINES]]
    line = k - place.first_group * GROUP_LINES
    if place.swept == 1 and line < 4 * place.resolution:
        sweep_line(field, sides, faces, place, origin, line, out_inverse, out_triangle, out_open)


@wp.func
def trace_steep(
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    open_from: wp.array(dtype=float),
    place: LocalPlace,
    origin: wp.vec3,
    steep: wp.vec2i,
    i: int,
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
):
    """Texel i of the two faces of a map (that of `steep[0]` looks up) which look along the field's third axis."""
    n = place.resolution
    upwards = i < n * n
    own = wp.where(upwards, steep[0] * n * n + i, steep[1] * n * n + i - n * n)
    texel = place.first_texel + own
    d = swap_up(field.place, texel_towards(place, own))
    out_inverse[texel] = 0.0
    out_triangle[texel] = -1
    if upwards:
        # Open sky where it is above both lines beside: they are less than a column apart.
        closed = int(0)
        for k in range(4):
            along = faces[k].ahead[0] * d[0] + faces[k].ahead[1] * d[1]
            lateral = faces[k].across[0] * d[0] + faces[k].across[1] * d[1]
            if along >= wp.abs(lateral) and along > 0.0:
                at = 0.5 * (lateral / along + 1.0) * float(n) - 0.5
                lower = int(wp.floor(at))
                for side in range(2):
                    beside = place.first_group * GROUP_LINES + k * n + wp.clamp(lower + side, 0, n - 1)
                    if open_from[beside] * along > 1.0 - OPEN_SLACK:
                        closed = int(1)
        if closed == 0:
            return
    rise = wp.where(upwards, 1.0, -1.0)
    walk = level_walk(field, place.eye + origin, wp.vec2(d[0], d[1]))
    x = walk.x
    y = walk.y
    top = field.top - walk.origin[2]
    t_in = float(0.0)
    axis = int(0)
    walking = int(1)
    while walking == 1:
        t_x = border_time(x + walk.ahead_x, walk.origin[0], walk.inverse[0], walk.never[0])
        t_y = border_time(y + walk.ahead_y, walk.origin[1], walk.inverse[1], walk.never[1])
        t_out = wp.min(t_x, t_y)
        height = column_height(field, x, y) - walk.origin[2]
        if rise * t_in <= height and t_in > 0.0:
            out_inverse[texel] = field.place.inverse / t_in
            step = wp.where(axis == 0, walk.step_x, walk.step_y)
            out_triangle[texel] = side_triangle(sides, y * field.nx + x, axis, step)
            walking = 0
        elif rise * t_out <= height:
            out_inverse[texel] = field.place.inverse / wp.max(wp.abs(height), LEAST_HEIGHT)
            out_triangle[texel] = sides.roof[y * field.nx + x]
            walking = 0
        axis = wp.where(t_x <= t_y, 0, 1)
        x += wp.where(axis == 0, walk.step_x, 0)
        y += wp.where(axis == 0, 0, walk.step_y)
        t_in = t_out
        if t_out >= FAR or out_of_field(field, x, y) or (upwards and t_out > top):
            walking = 0


@wp.kernel
def trace_steep_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    open_from: wp.array(dtype=float),
    places: wp.array(dtype=LocalPlace),
    steep_map: wp.array(dtype=int),
    origin: wp.vec3,
    steep: wp.vec2i,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
):
    """One thread per texel that looks up or down."""
    k = first + wp.tid()
    place = places[steep_map[k / STEEP_BLOCK]]
    i = k - place.first_steep * STEEP_BLOCK
    if place.swept == 1 and i < 2 * place.resolution * place.resolution:
        trace_steep(field, sides, faces, open_from, place, origin, steep, i, out_inverse, out_triangle)


def local_field(scene: Scene, settings: Settings) -> LocalField | None:
    """The field of what never moves in a scene, made at first use and kept with it; None where nothing stands still."""
    key = (KEY, settings.field_kind, settings.field_cell, settings.field_overhang)
    if key not in scene.environments:
        field = make_field(scene, settings, scene.moving_parts)
        sides = heights = None
        if field is not None and field.kind == "heightfield":
            heights = _heights(field)
            sides = _sides(scene, field, heights, settings.threads)
        scene.environments[key] = None if field is None else LocalField(field, sides, scene.origin.copy(), heights)
    return scene.environments[key]


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand fields over to the same stage's scene at another time, whose triangles have the same numbers."""
    for key, known in earlier.environments.items():
        if key[0] == KEY and key not in scene.environments:
            scene.environments[key] = known


def _heights(field: SceneField) -> np.ndarray:
    grid = field.grid
    return grid.view.heights.numpy()[: grid.nx * grid.ny].reshape(grid.ny, grid.nx).copy()


def _sides(scene: Scene, field: SceneField, heights: np.ndarray, threads: int) -> FieldSides:
    """The triangles of the sides that stand out, each by a level ray from the middle of the column before it."""
    grid, view = field.grid, field.grid.view
    count = grid.nx * grid.ny
    around = np.pad(heights.astype(np.float64), 1, constant_values=float(HOLE))
    own = around[1:-1, 1:-1]
    before = (around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1])
    row = np.full(count, -1, np.int32)
    stands = np.stack([(own > float(HOLE)) & (own - low > STEP_LEAST) for low in before], -1).reshape(
        count, COLUMN_SIDES
    )
    walled = np.flatnonzero(stands.any(axis=1))
    row[walled] = np.arange(len(walled))
    found = np.full((len(walled), COLUMN_SIDES), -1, np.int32)
    up = UP_AXES[scene.data.up_axis]
    axes = [0, 3 - up, up]
    corner = np.array([*view.place.corner])
    y, x = np.divmod(walled, grid.nx)
    for side, low in enumerate(before):
        asked = np.flatnonzero(stands[walled, side])
        ahead = np.zeros(3)
        ahead[side // 2] = 1.0 - 2.0 * (side % 2)
        top = own.reshape(-1)[walled[asked]]
        foot = np.maximum(low.reshape(-1)[walled[asked]], top - HOLE_BELOW)
        middle = np.column_stack([x[asked] + 0.5, y[asked] + 0.5, 0.5 * (top + foot)]) - ahead
        origins, directions = np.zeros_like(middle), np.zeros(3)
        origins[:, axes] = middle * field.cell
        directions[axes] = ahead
        if not len(asked):
            continue
        triangle, t, _, _ = scene.still_tracer.trace(corner + origins, np.tile(directions, (len(asked), 1)), threads)
        found[asked, side] = np.where(t.numpy() <= WALL_REACH * field.cell, triangle.numpy(), -1)
    sides, device = FieldSides(), scene.device
    sides.row = wp.array(row, dtype=int, device=device)
    sides.triangle = wp.array(found.reshape(-1), dtype=int, device=device)
    sides.roof = field.view.triangle
    return sides


@cache
def _side_faces(up: int, device: str) -> tuple[wp.array, wp.vec2i]:
    """(The side faces; the faces that look up and down)."""
    level = [0, 3 - up]
    faces, steep = [], [0, 0]
    for number, (right, above, forward) in enumerate(RADIANCE_AXES):
        if forward[up] != 0.0:
            steep[0 if forward[up] > 0.0 else 1] = number
            continue
        face = SideFace()
        face.face = number
        if above[up] != 0.0:  # rows lie above one another
            upright, across = above[up] > 0.0, right
            face.corner, face.line_step = wp.vec2i(int(upright), 0), wp.vec2i(0, 1)
            face.rise_step = wp.vec2i(-1 if upright else 1, 0)
        else:
            rightwards, across = right[up] > 0.0, -above
            face.corner, face.line_step = wp.vec2i(0, int(not rightwards)), wp.vec2i(1, 0)
            face.rise_step = wp.vec2i(0, 1 if rightwards else -1)
        face.ahead, face.across = wp.vec2(*forward[level]), wp.vec2(*across[level])
        faces.append(face)
    return wp.array(faces, dtype=SideFace, device=device), wp.vec2i(*steep)


def in_the_open(scene: Scene, known: LocalField, centres: np.ndarray) -> np.ndarray:
    """Which places (world, float64 [n, 3]) lie over the columns of a heightfield and above what is there, bool [n]."""
    view, up = known.field.grid.view, UP_AXES[scene.data.up_axis]
    at = (centres - known.origin - np.array([*view.place.corner]))[:, [0, 3 - up, up]] / known.field.cell
    column = np.floor(at[:, :2])
    inside = ((column >= 0) & (column < [view.nx, view.ny])).all(axis=1)
    x, y = np.where(inside[:, None], column, 0.0).astype(int).T
    return inside & (at[:, 2] > known.heights[y, x])


def depths(
    scene: Scene, known: LocalField, centre: np.ndarray, resolution: int, cells: int, ratio: float, threads: int = 0
) -> DepthMesh | None:
    """Depths of a map at a place by rays through a field that is no heightfield; None where the place is not in the open.

    Args:
        scene: The field's.
        known: The field.
        centre: Of the map, world, float64 [3].
        resolution: Texels along a cube edge.
        cells, ratio: Of the mesh whose nodes are traced, see `trace_depth_mesh`.
        threads: CPU threads; 0: one per core.
    """
    inside = []

    def intersect(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = wp.array(directions, dtype=wp.vec3, device=scene.device)
        origins = wp.array(np.tile(centre - known.origin, (len(directions), 1)), dtype=wp.vec3, device=scene.device)
        trace = known.field.intersect(origins, way, threads)
        inside.append((trace.status.numpy() == int(Status.INSIDE)).any())
        return trace.t.numpy(), trace.triangle.numpy()

    mesh = trace_depth_mesh(resolution, intersect, cells, ratio, scene.device, threads)
    mesh.traced[:] = True  # an exact ray would find no more where the field has missed something between the nodes
    return None if any(inside) else mesh


def sweep(scene: Scene, known: LocalField, maps: LocalMaps, settings: Settings) -> None:
    """Depths at every texel of the maps that are swept, whose places are in the open of a heightfield.

    Args:
        scene: Of the maps.
        known: The field.
        maps: Get `inverse` and `triangle`.
        settings: `threads`, `kernels`.
    """
    view, device, where = known.field.grid.view, scene.device, maps.layout
    faces, steep = _side_faces(UP_AXES[scene.data.up_axis], str(device))
    lines = len(where.group_map) * LINES
    open_from = wp.empty(lines, dtype=float, device=device)
    origin, outputs = wp.vec3(*(scene.origin - known.origin)), [maps.inverse, maps.triangle]
    inputs = [view, known.sides, faces, maps.places, where.group_map, origin, *outputs, open_from]
    threads = settings.threads
    steep_inputs = [view, known.sides, faces, open_from, maps.places, where.steep_map, origin, steep, *outputs]
    if vector.chosen(settings.kernels, device):
        from warp_reflect.techniques import local_field_vector  # which uses this module's functions

        groups, blocks = len(where.group_map), len(where.steep_map)
        launch.launch(
            local_field_vector.sweep_groups_kernel, groups, inputs, device, threads, split_min=GROUP_SPLIT_MIN
        )
        kernel = local_field_vector.trace_steep_blocks_kernel
        launch.launch(kernel, blocks, steep_inputs, device, threads, split_min=vector.BLOCK_SPLIT_MIN)
        return
    launch.launch(sweep_lines_kernel, lines, inputs, device, threads, split_min=SPLIT_MIN)
    launch.launch(trace_steep_kernel, len(where.steep_map) * vector.BLOCK, steep_inputs, device, threads)
