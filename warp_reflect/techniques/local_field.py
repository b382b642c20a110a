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

from warp_reflect import launch
from warp_reflect.cubemap import FACE_COUNT, RADIANCE_AXES, radiance_direction
from warp_reflect.grid_rays import FAR, UP_AXES, border_time, swap_up
from warp_reflect.heightfield import HOLE, HeightfieldView, column_height, out_of_field
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.scene import Scene
from warp_reflect.scene_field import SceneField, make_field
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques.local_mesh import DepthMesh, trace_depth_mesh

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

KEY = "field of local maps"
SIDES = 4  # faces of a map, and sides of a column: towards lower and higher x, then y
STEP_LEAST = 0.5  # cells: lower steps of the field are taken for slopes, of the triangle that the column shows
WALL_REACH = 1.5  # cells from the middle of the column before a wall in which its triangle is looked for
LEAST_HEIGHT = wp.constant(1.0e-6)  # cells over a roof: less is this
OPEN_SLACK = wp.constant(0.05)  # share of a slope: the corner of a roof may rise between two lines
HOLE_BELOW = 1.0  # cells below a top that a wall beside a hole is taken to reach
SPLIT_MIN = 32  # lines; a walk takes 2 to 20 us


@wp.struct
class FieldSides:
    """Which triangles the sides of a field's columns are of."""

    row: wp.array(dtype=int)  # per column: of `triangle`; -1 where no side stands out
    triangle: wp.array(dtype=int)  # four a row; -1 where none was found
    roof: wp.array(dtype=int)  # per column: what it shows from above


@wp.struct
class SideFace:
    """A side face of a map in the axes of a field: texel (line, step) is element base + line line_stride + step step_stride."""

    ahead: wp.vec2  # the face's axis
    across: wp.vec2  # towards higher lines
    base: int
    line_stride: int
    step_stride: int


@dataclass(frozen=True)
class LocalField:
    """A scene's field as local maps use it.

    Attributes:
        field: Of what never moves.
        sides: Of its columns; None where it is no heightfield.
        origin: Of the frame that the field lies in, world, float64 [3]: of the scene that it was made for.
    """

    field: SceneField
    sides: FieldSides | None
    origin: np.ndarray


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


@wp.kernel
def sweep_lines_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    eye: wp.vec3,
    resolution: int,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_open: wp.array(dtype=float),
):
    """One thread per line of texels above one another: the slope from which on it sees the sky, and what is below."""
    k = first + wp.tid()
    n = resolution
    face = faces[k / n]
    line = k - (k / n) * n
    lateral = (2.0 * float(line) + 1.0) / float(n) - 1.0
    walk = level_walk(field, eye, face.ahead + lateral * face.across)
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
            i = face.base + line * face.line_stride + step * face.step_stride
            out_inverse[i] = scale / t_in
            out_triangle[i] = side_triangle(
                sides, y * field.nx + x, axis, wp.where(axis == 0, walk.step_x, walk.step_y)
            )
            step += 1
            rise = (2.0 * float(step) + 1.0) / float(n) - 1.0
        if step == n and t_in > 0.0:
            highest = wp.max(highest, height / t_in)
        while step < n and rise * t_out <= height:
            i = face.base + line * face.line_stride + step * face.step_stride
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
    out_open[k] = highest
    while step < n:
        i = face.base + line * face.line_stride + step * face.step_stride
        out_inverse[i] = 0.0
        out_triangle[i] = -1
        step += 1


@wp.kernel
def trace_steep_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    open_from: wp.array(dtype=float),
    eye: wp.vec3,
    resolution: int,
    steep: wp.vec2i,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
):
    """One thread per texel of the two faces (that of `steep[0]` looks up) which look along the field's third axis."""
    i = first + wp.tid()
    n = resolution
    upwards = i < n * n
    face = wp.where(upwards, steep[0], steep[1])
    rest = wp.where(upwards, i, i - n * n)
    row = rest / n
    texel = face * n * n + rest
    u = (2.0 * float(rest - row * n) + 1.0) / float(n) - 1.0
    v = (2.0 * float(row) + 1.0) / float(n) - 1.0
    towards = radiance_direction(face, u, v)
    out_inverse[texel] = 0.0
    out_triangle[texel] = -1
    if upwards:
        # Open sky where it is above both lines beside: they are less than a column apart.
        d = swap_up(field.place, towards)
        closed = int(0)
        for k in range(4):
            along = faces[k].ahead[0] * d[0] + faces[k].ahead[1] * d[1]
            lateral = faces[k].across[0] * d[0] + faces[k].across[1] * d[1]
            if along >= wp.abs(lateral) and along > 0.0:
                at = 0.5 * (lateral / along + 1.0) * float(n) - 0.5
                lower = int(wp.floor(at))
                for side in range(2):
                    if open_from[k * n + wp.clamp(lower + side, 0, n - 1)] * along > 1.0 - OPEN_SLACK:
                        closed = int(1)
        if closed == 0:
            return
    rise = wp.where(upwards, 1.0, -1.0)
    d = swap_up(field.place, towards)
    walk = level_walk(field, eye, wp.vec2(d[0], d[1]))
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


def local_field(scene: Scene, settings: Settings) -> LocalField | None:
    """The field of what never moves in a scene, made at first use and kept with it; None where nothing stands still."""
    key = (KEY, settings.field_kind, settings.field_cell, settings.field_overhang)
    if key not in scene.environments:
        field = make_field(scene, settings, scene.moving_parts)
        sides = None
        if field is not None and field.kind == "heightfield":
            sides = _sides(scene, field, settings.threads)
        scene.environments[key] = None if field is None else LocalField(field, sides, scene.origin.copy())
    return scene.environments[key]


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand fields over to the same stage's scene at another time, whose triangles have the same numbers."""
    for key, known in earlier.environments.items():
        if key[0] == KEY and key not in scene.environments:
            scene.environments[key] = known


def _sides(scene: Scene, field: SceneField, threads: int) -> FieldSides:
    """The triangles of the sides that stand out, each by a level ray from the middle of the column before it."""
    grid, view = field.grid, field.grid.view
    count = grid.nx * grid.ny
    heights = view.heights.numpy()[:count].reshape(grid.ny, grid.nx).astype(np.float64)
    around = np.pad(heights, 1, constant_values=float(HOLE))
    own = around[1:-1, 1:-1]
    before = (around[1:-1, :-2], around[1:-1, 2:], around[:-2, 1:-1], around[2:, 1:-1])
    row = np.full(count, -1, np.int32)
    stands = np.stack([(own > float(HOLE)) & (own - low > STEP_LEAST) for low in before], -1).reshape(count, SIDES)
    walled = np.flatnonzero(stands.any(axis=1))
    row[walled] = np.arange(len(walled))
    found = np.full((len(walled), SIDES), -1, np.int32)
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
def _side_faces(resolution: int, up: int) -> tuple[list[tuple], tuple[int, int]]:
    """(The side faces' fields of `SideFace`; the faces that look up and down)."""
    n = resolution
    level = [0, 3 - up]
    faces, steep = [], [0, 0]
    for face, (right, above, forward) in enumerate(RADIANCE_AXES):
        if forward[up] != 0.0:
            steep[0 if forward[up] > 0.0 else 1] = face
            continue
        first = face * n * n
        if above[up] != 0.0:  # rows lie above one another
            base, strides = (first + (n - 1) * n, (1, -n)) if above[up] > 0.0 else (first, (1, n))
            across = right
        else:
            base, strides = (first, (n, 1)) if right[up] > 0.0 else (first + n - 1, (n, -1))
            across = -above
        faces.append((forward[level], across[level], base, *strides))
    return faces, tuple(steep)


def depths(
    scene: Scene, known: LocalField, centre: np.ndarray, resolution: int, cells: int, ratio: float, threads: int = 0
) -> DepthMesh | None:
    """Depths of a map at a place; None where the place is not in the open.

    Args:
        scene: The field's.
        known: The field.
        centre: Of the map, world, float64 [3].
        resolution: Texels along a cube edge.
        cells, ratio: Of the mesh whose nodes are traced where the field is no heightfield, see `trace_depth_mesh`.
        threads: CPU threads; 0: one per core.
    """
    if known.sides is not None:
        return sweep(scene, known, centre, resolution, threads)
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


def sweep(scene: Scene, known: LocalField, centre: np.ndarray, resolution: int, threads: int = 0) -> DepthMesh | None:
    """Depths at every texel of a map at a place (world, float64 [3]); None where the place is not in the open."""
    view, n, device = known.field.grid.view, resolution, scene.device
    up = UP_AXES[scene.data.up_axis]
    eye = centre - known.origin
    at = (eye - np.array([*view.place.corner]))[[0, 3 - up, up]] / known.field.cell
    column = np.floor(at[:2]).astype(int)
    if (column < 0).any() or column[0] >= view.nx or column[1] >= view.ny:
        return None
    # One number: the field's own columns stay where they are.
    number = int(column[1]) * view.nx + int(column[0])
    if at[2] <= float(view.heights[number : number + 1].numpy()[0]):
        return None
    faces, steep = _device_faces(n, up, str(device))
    inverse = wp.empty(FACE_COUNT * n * n, dtype=float, device=device)
    triangle = wp.empty(FACE_COUNT * n * n, dtype=int, device=device)
    open_from = wp.empty(SIDES * n, dtype=float, device=device)
    place = wp.vec3(*eye)
    inputs = [view, known.sides, faces, place, n, inverse, triangle, open_from]
    launch.launch(sweep_lines_kernel, SIDES * n, inputs, device, threads, split_min=SPLIT_MIN)
    inputs = [view, known.sides, faces, open_from, place, n, steep, inverse, triangle]
    launch.launch(trace_steep_kernel, 2 * n * n, inputs, device, threads)
    shape = (FACE_COUNT, n, n)
    mesh = DepthMesh(inverse.numpy().reshape(shape), triangle.numpy().reshape(shape), np.ones(shape, bool))
    mesh.statistics["local_lines"] = SIDES * n
    return mesh


@cache
def _device_faces(resolution: int, up: int, device: str) -> tuple[wp.array, wp.vec2i]:
    faces, steep = _side_faces(resolution, up)
    made = []
    for ahead, across, base, line_stride, step_stride in faces:
        face = SideFace()
        face.ahead, face.across = wp.vec2(*ahead), wp.vec2(*across)
        face.base, face.line_stride, face.step_stride = base, line_stride, step_stride
        made.append(face)
    return wp.array(made, dtype=SideFace, device=device), wp.vec2i(*steep)
