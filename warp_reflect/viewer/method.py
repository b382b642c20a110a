"""How the techniques work, as meshes in the scene frame: what `geometry.meshes` adds to the objects."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyvista as pv

from warp_reflect.cubemap import FACE_COUNT, face_axes
from warp_reflect.layers import Camera, ReflectionLayer
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import Plan
from warp_reflect.reflector_maps import ReflectorMap
from warp_reflect.techniques import reflector_map
from warp_reflect.techniques.grid import UsedCells
from warp_reflect.techniques.map_search import search_settings
from warp_reflect.techniques.octree import CORNER_STEP
from warp_reflect.techniques.search_field import search_field, search_path
from warp_reflect.techniques.vertices import solve_frame

FIELD_SIDE = 17  # nodes along a cube edge at which the field is shown: about 1,700 arrows
# One line along all edges of a box, so that a cell of the grid is a cell of the mesh: corners as in `octree.CORNER_STEP`.
BOX_LINE = (0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4)


def grid_mesh(used: list[UsedCells]) -> pv.PolyData:
    """The cells of interpolation grids, a line around each; cells: `level`, `use`, `error_px`, `vertices`."""
    corners, numbers = [], {"level": [], "use": [], "error_px": [], "vertices": []}
    for each in used:
        tree = each.tree
        edge = tree.edge(each.cell)[:, None, None]
        low = (tree.low + tree.place[each.cell] * tree.unit)[:, None, :]
        corners.append((low + edge * CORNER_STEP[list(BOX_LINE)]).reshape(-1, 3))
        numbers["level"].append(tree.level[each.cell])
        numbers["use"].append(each.use)
        numbers["error_px"].append(each.error_px)
        numbers["vertices"].append(tree.count[each.cell])
    count = sum(len(each.cell) for each in used)
    if not count:
        return pv.PolyData()
    mesh = pv.PolyData(np.concatenate(corners), lines=_lines(np.arange(count * len(BOX_LINE)).reshape(count, -1)))
    for name, parts in numbers.items():
        mesh.cell_data[name] = np.concatenate(parts)
    return mesh


def search_meshes(
    plan: Plan, row: PlanRow, layer: ReflectionLayer, camera: Camera, point: np.ndarray | None
) -> Iterator[tuple[str, pv.PolyData]]:
    """(kind, mesh) of what the search for one reflection point follows, in every map of a mirror that sees it.

    Args:
        plan: Of which `row` is, with technique `reflector_map`.
        layer: Of the mirror.
        camera: Of the frame.
        point: float64 [3], the point that is reflected, scene frame; None: what the mirror shows in its middle.
    """
    if point is None:
        point = _middle_point(plan, layer)
    if point is None:
        return
    scene, prepared = plan.scene, plan.prepared(row)
    maps = reflector_map.drawn_maps(prepared)
    for number, map in enumerate(maps, 1):
        frame = solve_frame(scene, camera, map.unit_from_body)
        target = map.unit_from_body[:3, :3] @ point + map.unit_from_body[:3, 3]
        eye = np.array(frame.eye, np.float64)
        field = search_field(map, eye, target, FIELD_SIDE, scene.device, row.settings.threads)
        path = search_path(map, eye, target, search_settings(row.settings, map.resolution), scene.device)
        if not len(path.point):
            continue
        piece = f" piece {number}" if len(maps) > 1 else ""
        scene_from_unit = np.linalg.inv(map.unit_from_body)
        turn = scene_from_unit[:3, :3]
        scale = float(np.cbrt(abs(np.linalg.det(turn))))

        def place(points: np.ndarray, turn=turn, shift=scene_from_unit[:3, 3]) -> np.ndarray:
            return points @ turn.T + shift

        extent = map.extent
        on_surface = pv.PolyData(place(field.point)) if len(field.point) else pv.PolyData()
        on_cube = pv.PolyData(place(field.cube * extent)) if len(field.cube) else pv.PolyData()
        for mesh, vectors in ((on_surface, field.bisector / scale), (on_cube, field.projected * extent)):
            if mesh.n_points:
                mesh.point_data["bisector"] = vectors @ turn.T
                mesh.point_data["residual"] = field.residual
        yield "bisector field" + piece, on_surface
        yield "bisector field on the cube" + piece, on_cube
        yield "cube" + piece, _cube_mesh(map, place)
        for kind, points in (("search path", path.point), ("search path on the cube", path.cube * extent)):
            mesh = pv.PolyData(place(points), lines=_lines(np.arange(len(points))[None]))
            mesh.point_data["residual"] = path.residual
            mesh.point_data["evaluations"] = path.evaluations
            yield kind + piece, mesh


def _middle_point(plan: Plan, layer: ReflectionLayer) -> np.ndarray | None:
    """What a mirror shows at the pixel nearest to the middle of those that show something, scene frame."""
    triangle = layer.triangle.numpy()
    seen = np.flatnonzero(triangle >= 0)
    if not len(seen):
        return None
    pixel = layer.pixels.pixel.numpy()[seen]
    at = np.stack([pixel % plan.size[0], pixel // plan.size[0]], axis=1).astype(float)
    nearest = seen[np.linalg.norm(at - at.mean(axis=0), axis=1).argmin()]
    u, v = float(layer.u.numpy()[nearest]), float(layer.v.numpy()[nearest])
    corners = plan.scene.host_points[plan.scene.host_triangles[triangle[nearest]]].astype(np.float64)
    return (1.0 - u - v) * corners[0] + u * corners[1] + v * corners[2]


def _cube_mesh(map: ReflectorMap, place) -> pv.PolyData:
    """The cube of a map around its mirror: a quad per face; cells: `face`."""
    points, faces = [], []
    for face in range(FACE_COUNT):
        k, ku, kv, sign = face_axes(face)
        corners = np.zeros((4, 3))
        corners[:, k] = sign
        corners[:, ku], corners[:, kv] = (-1, 1, 1, -1), (-1, -1, 1, 1)
        faces.append([4, *range(4 * face, 4 * face + 4)])
        points.append(corners)
    mesh = pv.PolyData(place(np.concatenate(points) * map.extent), np.concatenate(faces))
    mesh.cell_data["face"] = np.arange(FACE_COUNT)
    return mesh


def _lines(numbers: np.ndarray) -> np.ndarray:
    """VTK's form of polylines through points, int [line_count, points a line]."""
    return np.concatenate([np.full((len(numbers), 1), numbers.shape[1]), numbers], axis=1).reshape(-1)
