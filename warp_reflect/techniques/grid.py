"""The interpolation grid: solve the corners of the cells that hold vertices, interpolate the vertices.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 5. What differs:
by default the grid holds *reflection directions* and each vertex takes one exact step from the interpolated one (fourth
order instead of second, at the same count of solves); `grid_kind="position"` is the paper's interpolation of virtual
positions. Cells with a corner behind the reflector are not interpolated: their vertices are solved one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.cubemap import project_to_cube
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, project
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView, sample_map
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques.map_search import (
    ACCEPTED,
    SearchSettings,
    measure,
    newton_step,
    solve_vertex,
    step_on_cube,
)
from warp_reflect.techniques.vertices import SolveFrame, VertexView, edge_reach, virtual_vertex

wp.set_module_options({"enable_backward": False})

CORNER_COUNT = 8
FIT_STEPS = 14  # bisections of a cell size over FIT_SPAN: within 1 % of the share asked
FIT_SPAN = 1.0e3  # from the mesh's extent down to this part of it
CELL_LIMIT = 1 << 20  # cells along an axis; keeps cell numbers inside int64
RESIDUAL_MAX = wp.constant(0.1)  # of an interpolated direction; one step squares it to below 1e-2 of itself
# Pixels. Virtual positions of a cell whose interpolation is estimated to be wrong by more are not interpolated: a cell as
# large as the mirror would say nothing. The paper's own grids are wrong by about as much.
POSITION_PX = 4.0
SPACE_DIAGONAL = wp.constant(1.7320508)  # of a cube with edge 1
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))


@wp.struct
class GridView:
    nodes: wp.array(dtype=wp.vec3)  # scene frame
    cell_nodes: wp.array2d(dtype=int)  # [cell_count, 8], corner k at bits (x, y, z) of k
    vertex_cell: wp.array(dtype=int)  # per scene vertex, -1: solved directly
    vertex_local: wp.array(dtype=wp.vec3)  # position in the cell, [0, 1]^3


@dataclass(frozen=True)
class Grid:
    """Cells over the meshes of a scene, one size per instance.

    Attributes:
        view: For kernels.
        node_count: Points that are solved.
        share: node_count / vertices that are interpolated.
    """

    view: GridView
    node_count: int
    share: float


@wp.func
def corner_weight(local: wp.vec3, corner: int) -> float:
    """Trilinear weight of a cell's corner."""
    x = wp.where((corner & 1) != 0, local[0], 1.0 - local[0])
    y = wp.where((corner & 2) != 0, local[1], 1.0 - local[1])
    z = wp.where((corner & 4) != 0, local[2], 1.0 - local[2])
    return x * y * z


@wp.kernel
def interpolate_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: CameraView,
    settings: SearchSettings,
    # Grid:
    grid_view: GridView,
    node: VertexView,
    position_root: float,
    # Outputs:
    out_vertex: VertexView,
):
    """One thread per scene vertex: interpolated from its cell's solved corners, or solved where that is unsafe."""
    i = first + wp.tid()
    if i >= own_first and i < own_first + own_count:
        return
    target = frame.unit_from_scene * points[i] + frame.unit_offset
    cell = int(-1)
    if i < grid_view.vertex_cell.shape[0]:  # beyond: vertices of cut triangles
        cell = grid_view.vertex_cell[i]
    x = wp.vec3(0.0, 0.0, 0.0)
    position = wp.vec3(0.0, 0.0, 0.0)
    solved = int(0)
    hidden = int(0)
    shortest = float(1.0e30)
    if cell >= 0:
        local = grid_view.vertex_local[i]
        for k in range(8):
            corner = grid_view.cell_nodes[cell, k]
            status = int(node.status[corner])
            if status == CONVERGED:
                solved += 1
                weight = corner_weight(local, k)
                seed = node.seed[corner]
                x += weight * seed
                if position_root > 0.0:
                    position += weight * node.position[corner]
                    shortest = wp.min(shortest, node.reach[corner])
            elif status == HIDDEN:
                hidden += 1
    if hidden == 8:
        # What lies behind a convex body is convex: so does the whole cell.
        out_vertex.status[i] = wp.uint8(HIDDEN)
        out_vertex.screen[i] = wp.vec4(0.0, 0.0, -1.0, 0.0)
        return
    if solved == 8:
        first_corner = grid_view.nodes[grid_view.cell_nodes[cell, 0]]
        last_corner = grid_view.nodes[grid_view.cell_nodes[cell, 7]]
        diagonal = wp.length(frame.unit_from_scene * (last_corner - first_corner))
        if position_root > 0.0 and diagonal < SPACE_DIAGONAL * shortest * position_root:
            out_vertex.status[i] = wp.uint8(CONVERGED)
            out_vertex.screen[i] = project(camera, position)
            return
        x = project_to_cube(x)
        sample = sample_map(map, x)
        r = measure(sample, x, frame.eye, target)
        if position_root == 0.0 and r.residual < RESIDUAL_MAX:
            x = step_on_cube(map, r, newton_step(sample, frame.eye, target), 1.0)
            # Read again: a tangent step leaves the body by its sagitta, which coarse cells make visible.
            sample = sample_map(map, x)
            r = measure(sample, x, frame.eye, target)
            if r.residual < ACCEPTED:
                out_vertex.seed[i] = x
                out_vertex.residual[i] = r.residual
                out_vertex.status[i] = wp.uint8(CONVERGED)
                out_vertex.reach[i] = edge_reach(frame, r.p, r.n, target, map.least_curvature)
                out_vertex.screen[i] = project(camera, virtual_vertex(frame, r.p, r.n, target))
                return
    solve_vertex(map, frame, camera, settings, target, wp.vec3(0.0, 0.0, 0.0), i, out_vertex)


def build(scene: Scene, own: PartRange, share: float) -> Grid:
    """A grid over every instance but the mirror's own.

    Args:
        own: The mirror.
        share: Grid nodes as a fraction of the vertices, the paper's percentage.
    """
    vertex_cell = np.full(scene.vertex_count, -1, np.int32)
    vertex_local = np.zeros((scene.vertex_count, 3), np.float32)
    nodes, cells = [], []
    node_count = cell_count = gridded = 0
    seen = set()
    for part in scene.parts:
        if part.first_vertex in seen or part.first_vertex == own.first_vertex:
            continue
        seen.add(part.first_vertex)
        members = slice(part.first_vertex, part.first_vertex + part.vertex_count)
        fitted = _fit(scene.host_points[members].astype(np.float64), share)
        if fitted is None:
            continue
        points, corners, cell, local = fitted
        nodes.append(points)
        cells.append(corners + node_count)
        vertex_cell[members] = cell + cell_count
        vertex_local[members] = local
        node_count += len(points)
        cell_count += len(corners)
        gridded += part.vertex_count
    view = GridView()
    stacked = np.concatenate(nodes) if nodes else np.zeros((0, 3))
    view.nodes = wp.array(stacked.astype(np.float32), dtype=wp.vec3, device=scene.device)
    table = np.concatenate(cells) if cells else np.zeros((0, CORNER_COUNT))
    view.cell_nodes = wp.array(table.astype(np.int32), dtype=int, device=scene.device, ndim=2)
    view.vertex_cell = wp.array(vertex_cell, dtype=int, device=scene.device)
    view.vertex_local = wp.array(vertex_local, dtype=wp.vec3, device=scene.device)
    return Grid(view, node_count, node_count / max(gridded, 1))


def _fit(points: np.ndarray, share: float):
    """(nodes, cell corners, vertex cell, vertex local) with about `share` nodes per vertex; None if direct is cheaper."""
    wanted = share * len(points)
    if wanted < CORNER_COUNT:
        return None
    low = points.min(axis=0)
    span = points.max(axis=0) - low
    longest = float(span.max())
    if longest == 0.0:
        return None
    coarse, fine = 1.0, FIT_SPAN
    best = None
    for _ in range(FIT_STEPS):
        middle = float(np.sqrt(coarse * fine))
        layout = _layout(points, low, span, longest / middle)
        if layout[1] <= wanted:
            best, coarse = layout, middle
        else:
            fine = middle
    if best is None:
        return None
    return _cells(points, low, *best[:1])


def _layout(points, low, span, cell) -> tuple[np.ndarray, int]:
    """(cell size per axis, nodes of the occupied cells) for nearly cubic cells of about the given size."""
    counts = np.clip(np.round(span / cell), 1, CELL_LIMIT)
    # A flat mesh has no extent along an axis: any positive size makes it one cell thick.
    size = np.where(span > 0.0, span / counts, cell)
    index, counts = _cell_index(points, low, span, size)
    occupied = np.unique(_flatten(index, counts))
    return size, len(np.unique(_corner_numbers(occupied, counts)))


def _cell_index(points, low, span, size) -> tuple[np.ndarray, np.ndarray]:
    counts = np.maximum(np.round(span / size), 1).astype(np.int64)
    return np.clip(((points - low) / size).astype(np.int64), 0, counts - 1), counts


def _flatten(index, counts) -> np.ndarray:
    return (index[:, 2] * counts[1] + index[:, 1]) * counts[0] + index[:, 0]


def _corner_numbers(cells, counts) -> np.ndarray:
    """Lattice numbers of the corners of flat cells, [cell_count, 8]."""
    x, y, z = cells % counts[0], cells // counts[0] % counts[1], cells // (counts[0] * counts[1])
    corner = np.arange(CORNER_COUNT)
    cx = x[:, None] + (corner & 1)
    cy = y[:, None] + (corner >> 1 & 1)
    cz = z[:, None] + (corner >> 2 & 1)
    return (cz * (counts[1] + 1) + cy) * (counts[0] + 1) + cx


def _cells(points, low, size):
    span = points.max(axis=0) - low
    index, counts = _cell_index(points, low, span, size)
    occupied, cell = np.unique(_flatten(index, counts), return_inverse=True)
    numbers, corners = np.unique(_corner_numbers(occupied, counts), return_inverse=True)
    wide = counts + 1
    lattice = np.stack([numbers % wide[0], numbers // wide[0] % wide[1], numbers // (wide[0] * wide[1])], 1)
    local = np.clip((points - low) / size - index, 0.0, 1.0)
    return low + lattice * size, corners.reshape(-1, CORNER_COUNT), cell.reshape(-1), local


def interpolate(
    scene: Scene,
    cells: Grid,
    node: VertexView,
    points: wp.array,
    own: list[int],
    map: ReflectorMap,
    frame: SolveFrame,
    view: CameraView,
    search: SearchSettings,
    camera: Camera,
    settings: Settings,
    out_vertex: VertexView,
) -> None:
    """Fill the vertices of a scene from the solved nodes of a grid.

    Args:
        node: Solved nodes of `cells`, with positions where `settings.grid_kind` is "position".
        points: vec3 [n], scene frame; the scene's own vertices come first.
        own: [first, count] of the mirror's own vertices, see `forward.own_vertices`.
        map: The reflector, for the exact step and for vertices that are solved after all.
        camera: What `view` was made from.
        out_vertex: One entry per point.
    """
    positions = settings.grid_kind == "position"
    root = float(np.sqrt(POSITION_PX / max(camera.fx, camera.fy))) if positions else 0.0
    inputs = [points, *own, map.view, frame, view, search, cells.view, node, root, out_vertex]
    launch(interpolate_kernel, len(points), inputs, scene.device, settings.threads)
