"""Scenes, mirrors and what they show as meshes: `meshes`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import IntEnum

import numpy as np
import pyvista as pv

from warp_reflect.frame import Frame, reflect_scene
from warp_reflect.images import srgb_from_linear
from warp_reflect.layers import Camera, ReflectionLayer
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import Plan, prefer_forward
from warp_reflect.scene import Scene
from warp_reflect.scene_field import make_field
from warp_reflect.settings import Status, Technique
from warp_reflect.techniques.forward import History
from warp_reflect.timing import StageTimer
from warp_reflect.viewer.maps import field_mesh, local_mesh, reference_mesh
from warp_reflect.viewer.method import grid_mesh, search_meshes
from warp_reflect.viewer.session import Pick
from warp_reflect.virtual_objects import VirtualObject, virtual_objects

# A point at the hidden boundary is its own virtual point: any point of the sight line would reflect it there.
BOUNDARY_SHARE = 1.0e-5  # of the path length
BLOCKED_SHARE = 1.0e-3  # of the distance to the eye by which a mirror must stand before a point to hide it


class Region(IntEnum):
    """Where a scene point lies as a mirror and an eye see it."""

    UNKNOWN = 0
    """The mirror's own, or the mirror is traced: no point was asked for."""
    REFLECTED = 1
    HIDDEN = 2
    UNREFLECTED = 3


def meshes(
    plan: Plan,
    frame: Frame | None = None,
    picks: Sequence[Pick] = (),
    *,
    apart: bool = True,
    searches: bool = True,
    field: bool = False,
) -> dict[str, pv.PolyData]:
    """A planned view as meshes.

    They lie in the scene frame: world axes with the origin at `origin` (field data, float64 [3]), so that single precision
    suffices at any offset of the stage.

    Args:
        plan: From `make_plan`. Mirrors that it traces, where a forward technique could answer, get virtual objects, too.
        frame: Of that plan; its camera is the eye. None: the plan's camera.
        picks: From `Session.pick`.
        searches: With the field and the path of a search; their kernels take some seconds to compile the first time.
        field: With the field that rays of maps are traced through; making it takes some tenths of a second.
        apart: A mesh for each virtual object; else `virtual PATH`, all of a mirror's as one, which is much faster.

    Returns:
        Name to mesh:
        `scene`: everything but the mirrors; cells: `rgb` uint8, `prim`; points: `region` as the mirror with most pixels
        sees them, and `region PATH` for each mirror (`Region`);
        `mirror PATH`: a mirror; cells: `rgb`, `reflector`;
        `virtual PATH OBJECT`: an object as the mirror PATH shows it, behind the mirror; cells: `rgb`, `triangle` (of the
        scene), points: `source`, the object's own point;
        `reflection points PATH`: on the mirror, a point of the former each; points: `source`, `path_length`;
        `grid PATH`: the interpolation grid's cells, a line around each; cells: `level` of the octree, `use` (`CellUse`),
        `error_px`, `vertices`;
        of a mirror that is searched in a map, for the point picked last in it (none: what its middle shows): `bisector
        field PATH` on the mirror and `bisector field on the cube PATH` on the map's cube around it, the sink of whose
        vectors (points: `bisector`, `residual`) is the reflection point; `cube PATH`; `search path PATH` and `search path
        on the cube PATH`, the places the search takes (points: `residual`, `evaluations`);
        where local maps are blended from reference maps, `reference maps`, their places (points: `map`, `mirrors` that blend
        it), and `local map PATH`, its adaptive mesh on what it sees (cells: `rgb`, `size`, `face`, `torn`
        by a silhouette; points: `distance`);
        `field`: roofs of the field's columns, or what is solid in its cells (cells: `height`);
        `rays`: of the picks, eye to mirror to reflected point, and on to the virtual point; cells: `virtual`, `pick`.
    """
    camera = plan.camera if frame is None else frame.camera
    scene = plan.scene
    forward = prefer_forward(plan)
    _, layers = reflect_scene(scene, forward, camera, StageTimer(scene.device))
    found = {"scene": _scene_mesh(scene, forward, layers, camera)}
    names = names_of(plan)
    colors = _colors(scene)
    for row in plan.rows:
        found["mirror " + names[row.reflector.id]] = _mirror_mesh(scene, row, colors)
    objects = virtual_objects(scene, camera, layers)
    if not apart:
        for row in plan.rows:
            own = [each for each in objects if each.reflector == row.reflector.id]
            if own:
                found["virtual " + names[row.reflector.id]] = _virtual_mesh(scene, camera, own, colors)
    for each in objects if apart else []:
        name = f"virtual {names[each.reflector]} {scene.prims[scene.parts[each.part].prim]}"
        name += f" piece {each.piece}" if each.piece else ""
        subset = scene.parts[each.part].subset
        found[f"{name}:{subset}" if subset else name] = _virtual_mesh(scene, camera, [each], colors)
    for row in plan.rows:
        own = [each for each in objects if each.reflector == row.reflector.id]
        if own:
            found["reflection points " + names[row.reflector.id]] = _reflection_points(scene, camera, own)
    for row in plan.rows:
        layer, name = layers.get(row.reflector.id), names[row.reflector.id]
        if layer is None:
            continue
        if layer.cells:
            found["grid " + name] = grid_mesh(layer.cells)
        if searches and layer.method == Technique.REFLECTOR_MAP:
            found |= _search_meshes(forward, row, layer, camera, picks, name)
    found |= _map_meshes(forward, layers, names)
    if field:
        found |= field_meshes_of(plan)
    if picks:
        found["rays"] = ray_mesh(scene, picks)
    for mesh in found.values():
        mesh.field_data["origin"] = scene.origin
    return found


def search_meshes_of(plan: Plan, frame: Frame, picks: Sequence[Pick]) -> dict[str, pv.PolyData]:
    """Of `meshes` those of searches alone, for a frame's own mirrors."""
    names, found = names_of(plan), {}
    for row in plan.rows:
        layer = frame.layers.get(row.reflector.id)
        if layer is not None and layer.method == Technique.REFLECTOR_MAP:
            found |= _search_meshes(plan, row, layer, frame.camera, picks, names[row.reflector.id])
    for mesh in found.values():
        mesh.field_data["origin"] = plan.scene.origin
    return found


def field_meshes_of(plan: Plan) -> dict[str, pv.PolyData]:
    """Of `meshes` the field of a plan's scene without its mirrors; empty where nothing is left."""
    field = make_field(plan.scene, plan.settings, without=[row.reflector.part for row in plan.rows])
    if field is None:
        return {}
    mesh = field_mesh(field)
    mesh.field_data["origin"] = plan.scene.origin
    return {"field": mesh}


def _map_meshes(plan: Plan, layers: dict[int, ReflectionLayer], names: dict[int, str]) -> dict[str, pv.PolyData]:
    drawn = [row for row in plan.rows if row.reflector.id in layers]
    blended = [row for row in drawn if layers[row.reflector.id].method == Technique.LAYERED_ENVIRONMENT]
    if not blended:
        return {}
    prepared = [(plan.prepared(row), row.settings) for row in blended]
    found = {"reference maps": reference_mesh(plan.scene, prepared)}
    for row, (each, settings) in zip(blended, prepared, strict=True):
        found["local map " + names[row.reflector.id]] = local_mesh(plan.scene, each, settings.depth_ratio)
    return found


def _search_meshes(plan: Plan, row: PlanRow, layer: ReflectionLayer, camera: Camera, picks, name: str):
    own = [pick for pick in picks if pick.reflected_point is not None and pick.reflector == row.path]
    point = own[-1].reflected_point - plan.scene.origin if own else None
    return {f"{kind} {name}": mesh for kind, mesh in search_meshes(plan, row, layer, camera, point)}


def ray_mesh(scene: Scene, picks: Sequence[Pick]) -> pv.PolyData:
    """The rays of picked pixels as lines, scene frame; see `meshes`."""
    points: list[np.ndarray] = []
    lines: list[int] = []
    virtual, number = [], []

    def line(pick: int, is_virtual: bool, *corners: np.ndarray) -> None:
        lines.extend([len(corners), *range(len(points), len(points) + len(corners))])
        points.extend(corner - scene.origin for corner in corners)
        virtual.append(is_virtual)
        number.append(pick)

    for k, pick in enumerate(picks):
        if pick.mirror_point is None:
            continue
        if pick.reflected_point is None:
            line(k, False, pick.eye, pick.mirror_point)
            continue
        line(k, False, pick.eye, pick.mirror_point, pick.reflected_point)
        line(k, True, pick.mirror_point, pick.virtual_point)
    mesh = pv.PolyData()
    if points:
        mesh = pv.PolyData(np.array(points), lines=np.array(lines))
        mesh.cell_data["virtual"] = np.array(virtual, np.uint8)
        mesh.cell_data["pick"] = np.array(number, np.int32)
    return mesh


def names_of(plan: Plan) -> dict[int, str]:
    """Reflector id to a name that no other has."""
    return {
        row.reflector.id: row.path
        + (f"[{row.instance}]" if row.instance else "")
        + (f":{row.subset}" if row.subset else "")
        for row in plan.rows
    }


def _poly(points: np.ndarray, triangles: np.ndarray) -> pv.PolyData:
    """Triangles that were checked when the stage was read: VTK itself ends the process on a bad index."""
    faces = np.empty((len(triangles), 4), np.int64)
    faces[:, 0], faces[:, 1:] = 3, triangles
    return pv.PolyData(points, faces.reshape(-1)) if len(triangles) else pv.PolyData()


def _colors(scene: Scene) -> np.ndarray:
    """Base colours of the scene's parts, sRGB uint8 [parts, 3]."""
    colors = [scene.data.materials[part.material].base_color for part in scene.parts]
    shown = srgb_from_linear(np.clip(np.array(colors, np.float32).reshape(-1, 3), 0.0, 1.0))
    return (255.0 * shown + 0.5).astype(np.uint8)


def _scene_mesh(scene: Scene, plan: Plan, layers: dict[int, ReflectionLayer], camera: Camera) -> pv.PolyData:
    kept = np.ones(scene.triangle_count, bool)
    for row in plan.rows:
        kept[_own(scene, row)] = False
    part_of = np.zeros(scene.triangle_count, np.int32)
    for k, part in enumerate(scene.parts):
        part_of[part.first_triangle : part.first_triangle + part.triangle_count] = k
    mesh = _poly(scene.host_points, scene.host_triangles[kept])
    if not mesh.n_cells:
        return mesh
    prims = np.array([part.prim for part in scene.parts], np.int32)
    mesh.cell_data["rgb"] = _colors(scene)[part_of[kept]]
    mesh.cell_data["prim"] = prims[part_of[kept]]
    names, region = names_of(plan), None
    for row in sorted(plan.rows, key=lambda row: row.pixels):
        region = _regions(scene, row, layers.get(row.reflector.id), camera)
        mesh.point_data["region " + names[row.reflector.id]] = region
    mesh.point_data["region"] = np.zeros(mesh.n_points, np.uint8) if region is None else region
    return mesh


def _own(scene: Scene, row: PlanRow) -> slice:
    part = scene.parts[row.reflector.part]
    return slice(part.first_triangle, part.first_triangle + part.triangle_count)


def _mirror_mesh(scene: Scene, row: PlanRow, colors: np.ndarray) -> pv.PolyData:
    used, place = np.unique(scene.host_triangles[_own(scene, row)], return_inverse=True)
    mesh = _poly(scene.host_points[used], place.reshape(-1, 3))
    if mesh.n_cells:
        mesh.cell_data["rgb"] = np.tile(colors[row.reflector.part], (mesh.n_cells, 1))
        mesh.cell_data["reflector"] = np.full(mesh.n_cells, row.reflector.id, np.int32)
    return mesh


def _virtual_mesh(scene: Scene, camera: Camera, objects: list[VirtualObject], colors: np.ndarray) -> pv.PolyData:
    firsts = np.cumsum([0] + [len(each.points) for each in objects[:-1]])
    points = np.concatenate([each.points for each in objects]) + (camera.eye - scene.origin)
    triangles = np.concatenate([each.triangles + first for each, first in zip(objects, firsts, strict=True)])
    mesh = _poly(points, triangles)
    if mesh.n_cells:
        mesh.cell_data["rgb"] = np.repeat(
            colors[[each.part for each in objects]], [len(each.triangles) for each in objects], axis=0
        )
        mesh.cell_data["triangle"] = np.concatenate([each.parents for each in objects])
        mesh.point_data["source"] = np.concatenate([each.sources for each in objects])
    return mesh


def _reflection_points(scene: Scene, camera: Camera, objects: list[VirtualObject]) -> pv.PolyData:
    """R of every virtual vertex: on the sight line, as far from the point as from the virtual point."""
    eye = camera.eye - scene.origin
    virtual = np.concatenate([each.points for each in objects])
    source = np.concatenate([each.sources for each in objects])
    path = np.linalg.norm(virtual, axis=1)
    sight = virtual / np.maximum(path, 1.0e-300)[:, None]
    from_eye = source - eye
    span = path - np.einsum("ij,ij->i", sight, from_eye)
    sure = span > BOUNDARY_SHARE * path
    reach = 0.5 * (path**2 - np.einsum("ij,ij->i", from_eye, from_eye))[sure] / span[sure]
    if not len(reach):
        return pv.PolyData()
    mesh = pv.PolyData(eye + reach[:, None] * sight[sure])
    mesh.point_data["source"] = source[sure]
    mesh.point_data["path_length"] = path[sure]
    return mesh


# Regions.


def _regions(scene: Scene, row: PlanRow, layer: ReflectionLayer | None, camera: Camera) -> np.ndarray:
    """`Region` of every scene vertex, uint8 [vertex_count], from the statuses of the search."""
    region = np.zeros(scene.vertex_count, np.uint8)
    if layer is None:
        return region
    for status in _statuses(layer.history, scene.vertex_count):
        # Of several pieces: whatever one of them reflects is reflected.
        seen = status == int(Status.CONVERGED)
        hidden = (status == int(Status.HIDDEN)) & (region != Region.REFLECTED)
        neither = (status == int(Status.UNREFLECTED)) & (region == Region.UNKNOWN)
        region[seen], region[hidden], region[neither] = Region.REFLECTED, Region.HIDDEN, Region.UNREFLECTED
    culled = layer.statistics.get("culled", 0)
    if culled and row.reflector.convex and (region == Region.UNREFLECTED).any():
        _tell_culled(scene, row, camera, region)
    part = scene.parts[row.reflector.part]
    region[np.unique(scene.host_triangles[_own(scene, row)])] = Region.UNKNOWN
    if part.is_whole:
        region[part.first_vertex : part.first_vertex + part.vertex_count] = Region.UNKNOWN
    return region


def _tell_culled(scene: Scene, row: PlanRow, camera: Camera, region: np.ndarray) -> None:
    """Part what was culled unsearched, as not shown, into hidden and reflected beside the mirror's pixels.

    Seen from outside, a closed convex mirror reflects every point that it does not hide.
    """
    part = scene.parts[row.reflector.part]
    if not all(scene.closed_patches.numpy()[list(part.patches)]):
        return
    asked = np.flatnonzero(region == Region.UNREFLECTED)
    eye = camera.eye - scene.origin
    ray = scene.host_points[asked].astype(np.float64) - eye
    distance = np.maximum(np.linalg.norm(ray, axis=1), 1.0e-300)
    origins = np.tile(eye, (len(asked), 1))
    tracer = scene.part_tracer(row.reflector.part)
    triangle, t, _, _ = tracer.trace(origins, ray / distance[:, None], row.settings.threads)
    blocked = (triangle.numpy() >= 0) & (t.numpy() < (1.0 - BLOCKED_SHARE) * distance)
    region[asked] = np.where(blocked, Region.HIDDEN, Region.REFLECTED)


def _statuses(history, count: int) -> Iterator[np.ndarray]:
    """Statuses of the scene's own vertices, [count] of each search that a layer's history holds."""
    if isinstance(history, History):
        status = history.vertices.status.numpy()[:count]
        if len(status) == count:
            yield status
    elif isinstance(history, dict):
        for each in history.values():
            yield from _statuses(each, count)
    elif isinstance(history, list | tuple):
        for each in history:
            yield from _statuses(each, count)
