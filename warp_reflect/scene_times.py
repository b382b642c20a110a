"""What a scene has in common with the same stage's at another time: arrays and findings of what does not move are shared.

Whatever is taken over is what the scene would make anew, to the bit: a frame depends on its own time alone.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace

import numpy as np
import warp as wp

from warp_reflect.at_rest import placed_normals, placed_points
from warp_reflect.scene import (
    InstanceData,
    MeshData,
    PartRange,
    PatchView,
    Scene,
    SceneData,
    SceneView,
    box_corners,
    first_rows,
    unit_from_scene,
)

# Of a scene, made at first use: what says nothing about where things are.
TRACERS = ("tracer", "shadow_tracer")
OF_SHAPE = ("host_neighbours", "neighbours", "closed_patches")
PLACELESS = (*OF_SHAPE, "has_hole", "moving_parts", "still_tracer")


def same_world(a: SceneData, b: SceneData) -> bool:
    """Whether two readings hold the same geometry, materials and lights; times, cameras and notes may differ."""
    return (
        len(a.meshes) == len(b.meshes)
        and len(a.instances) == len(b.instances)
        and a.materials == b.materials
        and all(_same(x, y) for x, y in zip(a.instances, b.instances, strict=True))
        and all(_same(x, y) for x, y in zip(a.meshes, b.meshes, strict=True))
        and _same(a.lights, b.lights)
        and _same(a.pictures, b.pictures)
    )


def same_lights(a: Scene, b: Scene) -> bool:
    """Whether two scenes are lit alike."""
    return _same(a.data.lights, b.data.lights)


def _same(a, b) -> bool:
    """Equality of what a `SceneData` holds: arrays by their numbers."""
    if a is b:
        return True
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and a.dtype == b.dtype and bool((a == b).all())
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    if is_dataclass(a):
        return all(_same(getattr(a, each.name), getattr(b, each.name)) for each in fields(a))
    return a == b


def moved_instances(earlier: SceneData, data: SceneData) -> list[int] | None:
    """Which instances stand elsewhere, or are bent, in a later reading of a stage; None where more than that differs.

    Lights, cameras and notes are not looked at. Where all may move, so may the frame of the scene: that differs.
    """
    alike = (
        len(earlier.meshes) == len(data.meshes)
        and len(earlier.instances) == len(data.instances)
        and all(_same_but_bent(x, y) for x, y in zip(earlier.meshes, data.meshes, strict=True))
        and earlier.materials == data.materials
        and _same(earlier.pictures, data.pictures)
        and list(map(_identity, earlier.instances)) == list(map(_identity, data.instances))
    )
    if not alike:
        return None
    if all(each.moves for each in data.instances):
        return None if data.instances else []
    before, now = (np.array([each.world_from_object for each in one.instances]) for one in (earlier, data))
    bent = bent_meshes(earlier, data)
    moved = np.flatnonzero((before != now).any(axis=(1, 2)) | [each.mesh in bent for each in data.instances])
    # Mirrored, its triangles would be wound the other way.
    turned = np.linalg.det(before[moved, :3, :3]) * np.linalg.det(now[moved, :3, :3]) <= 0.0
    still = any(not data.instances[k].moves for k in moved)
    return None if turned.any() or still else moved.tolist()


def bent_meshes(earlier: SceneData, data: SceneData) -> set[int]:
    """Indices of the meshes that are not what they were."""
    return {k for k, mesh in enumerate(data.meshes) if not _same(mesh, earlier.meshes[k])}


def _same_but_bent(a: MeshData, b: MeshData) -> bool:
    """Whether two meshes differ in the places of their points and the directions of their normals at most."""
    if a is b:
        return True
    alike = a.points.shape == b.points.shape and np.shape(a.normals) == np.shape(b.normals)
    return alike and _same(replace(a, points=b.points, normals=b.normals), b)


def _identity(instance: InstanceData) -> tuple:
    place = instance.prim_path, instance.instance
    return instance.mesh, *place, instance.materials, instance.moves, instance.mover


@dataclass(frozen=True)
class _Rows:
    """Rows of a scene's arrays, range by range: (the row of one of them among these, its row there, how many)."""

    ranges: list[tuple[int, int, int]]

    @staticmethod
    def of(firsts: Iterable[int], counts: Iterable[int]) -> _Rows:
        """Some ranges; those that follow each other are one."""
        ranges, end = [], 0
        for first, count in zip(firsts, counts, strict=True):
            if ranges and sum(ranges[-1][1:]) == first:
                ranges[-1] = *ranges[-1][:2], ranges[-1][2] + count
            elif count:
                ranges.append((end, first, count))
            end += count
        return _Rows(ranges)

    def put(self, array: np.ndarray, values: np.ndarray) -> None:
        """Write values, one for each of these rows."""
        for here, there, count in self.ranges:
            array[there : there + count] = values[here : here + count]

    def any(self, array: np.ndarray) -> bool:
        """Whether any of these rows is true."""
        return any(array[there : there + count].any() for _, there, count in self.ranges)


@dataclass(frozen=True)
class _Moved:
    """Instances that stand elsewhere, laid out so that all are placed at once.

    Attributes:
        prims, meshes: Which.
        points, normals: Of all of them in the frames of their meshes; each with the number of its instance among these, and
            their rows in the scene.
        boxes: First of the points of each instance that has any; the rows of those in `Scene.boxes`.
        parts: Theirs.
        corners: Of their triangles, rows in `Scene.host_points`; their own rows.
        shapes: Patches with an analytic surface; the numbers of their instances; unit_from_object, [n, 4, 4].
    """

    prims: list[int]
    meshes: list[MeshData]
    points: tuple[np.ndarray, np.ndarray, _Rows]
    normals: tuple[np.ndarray, np.ndarray, _Rows]
    boxes: tuple[np.ndarray, np.ndarray]
    parts: list[int]
    corners: tuple[np.ndarray, _Rows]
    shapes: tuple[list[int], list[int], np.ndarray]


def _moved_of(scene: Scene, earlier: Scene, prims: list[int]) -> _Moved:
    """The instances of some numbers; those of the last time where they are the same."""
    meshes = [scene.data.meshes[scene.data.instances[prim].mesh] for prim in prims]
    known: _Moved | None = earlier.lasting.get("moved")
    if known is not None and known.prims == prims and all(map(operator.is_, known.meshes, meshes)):
        return known
    first_point, first_normal = (first[prims] for first in first_rows(scene.data))
    none = np.zeros((0, 3), np.float32)

    def joined(arrays: list[np.ndarray], first: np.ndarray) -> tuple[np.ndarray, np.ndarray, _Rows]:
        counts = [len(each) for each in arrays]
        number = np.repeat(np.arange(len(prims)), counts)
        return np.concatenate([none, *arrays]), number, _Rows.of(first.tolist(), counts)

    points = joined([mesh.points for mesh in meshes], first_point)
    begins = np.flatnonzero(np.diff(points[1], prepend=-1))
    spans = sorted({part.first_vertex for part in earlier.parts if part.vertex_count})
    number_of = {prim: number for number, prim in enumerate(prims)}
    parts = [k for k, part in enumerate(earlier.parts) if part.prim - 1 in number_of]
    own = [earlier.parts[k] for k in parts]
    triangles = _Rows.of([part.first_triangle for part in own], [part.triangle_count for part in own])
    corners = [earlier.host_triangles[there : there + count] for _, there, count in triangles.ranges]
    shaped = [
        (patch, number_of[part.prim - 1], shape.unit_from_object)
        for part in own
        for patch in part.patches
        if (shape := earlier.patch_shapes[patch]) is not None
    ]
    made = _Moved(
        prims,
        meshes,
        points,
        joined([none if mesh.normals is None else mesh.normals for mesh in meshes], first_normal),
        (begins, np.searchsorted(spans, first_point[points[1][begins]])),
        parts,
        (np.concatenate([np.zeros((0, 3), np.int32), *corners]), triangles),
        (
            [patch for patch, _, _ in shaped],
            [number for _, number, _ in shaped],
            np.array([unit for _, _, unit in shaped]),
        ),
    )
    earlier.lasting["moved"] = made
    return made


def lay_out(scene: Scene, earlier: Scene, prims: list[int]) -> None:
    """Lay out a scene like an earlier one with some instances elsewhere, and give it what is known of the others.

    Args:
        scene: Has its data.
        earlier: Of the same stage.
        prims: Of `moved_instances`.
    """
    scene.data = replace(scene.data, materials=earlier.data.materials)
    scene.origin, scene.material_notes = earlier.origin, earlier.material_notes
    scene.notes += [note for note in earlier.material_notes if note not in scene.notes]
    for name in ("host_triangles", "host_triangle_patch", "host_normal_index", "patch_shapes"):
        setattr(scene, name, getattr(earlier, name))
    view, known = SceneView(), earlier.view
    for name in SceneView.vars:
        setattr(view, name, getattr(known, name))
    scene.view = view
    scene.host_points, scene.host_normals = earlier.host_points.copy(), earlier.host_normals.copy()
    scene.parts = list(earlier.parts)
    moved = _moved_of(scene, earlier, prims)
    placed = _place(scene, moved) if prims else np.zeros((0, 3), np.float32)
    view.points = wp.array(scene.host_points, dtype=wp.vec3, device=scene.device, copy=False)
    view.normals = wp.array(scene.host_normals, dtype=wp.vec3, device=scene.device, copy=False)
    _take_over(scene, earlier, moved, placed)


def _place(scene: Scene, moved: _Moved) -> np.ndarray:
    """Put what has moved where it is; its points there."""
    instances = scene.data.instances
    where = np.array([instances[prim].world_from_object for prim in moved.prims])
    where[:, :3, 3] -= scene.origin
    points, of_point, rows = moved.points
    placed = placed_points(points, _each(where, of_point))
    rows.put(scene.host_points, placed)
    normals, of_normal, rows = moved.normals
    rows.put(scene.host_normals, placed_normals(normals, _each(np.linalg.inv(where[:, :3, :3]), of_normal)))
    for k in moved.parts:
        part = scene.parts[k]
        scene.parts[k] = PartRange(**vars(part) | {"world_from_object": instances[part.prim - 1].world_from_object})
    numbers, of_shape, unit_from_object = moved.shapes
    if numbers:
        patches = scene.view.patches.numpy().copy()
        patches["unit_from_scene"][numbers] = unit_from_scene(unit_from_object, where[of_shape])
        scene.view.patches = wp.array(patches, dtype=PatchView, device=scene.device, copy=False)
    return placed


def _each(matrices: np.ndarray, number: np.ndarray) -> np.ndarray:
    """One of the matrices [m, i, j] for every element, [i, j, n]."""
    return np.ascontiguousarray(matrices.transpose(1, 2, 0)).take(number, axis=2)


def _take_over(scene: Scene, earlier: Scene, moved: _Moved, placed: np.ndarray) -> None:
    """Findings that hold on: of the whole layout, and of the parts that did not move; `placed`: points of those that did."""
    # Copied: another thread may draw that time, and find more of it out, meanwhile.
    known = {name: dict(found) if isinstance(found, dict) else found for name, found in dict(vars(earlier)).items()}
    gone = set(moved.parts)
    gone_triangles = {scene.parts[k].first_triangle for k in moved.parts}
    bent = bent_meshes(earlier.data, scene.data)
    for name in PLACELESS:
        if name in known and not (bent and name in OF_SHAPE):
            vars(scene)[name] = known[name]
    scene.bodies = {k: body for k, body in known["bodies"].items() if k not in gone}
    scene.facts_at_rest = {key: fact for key, fact in known["facts_at_rest"].items() if key[0] not in bent}
    scene.pyramids, scene.lasting = earlier.pyramids, earlier.lasting
    scene.seen = known["seen"]
    scene.fits = {k: fit for k, fit in known["fits"].items() if k not in gone}
    scene.segmentations = {k: found for k, found in known["segmentations"].items() if k not in gone}
    scene.facts = {
        key: fact for key, fact in known["facts"].items() if key[1] is not None and key[1] not in gone_triangles
    }
    for name in TRACERS:
        if name in known and not bent and (tracer := known[name].at(scene)) is not None:
            # One object where it is one.
            vars(scene)[name] = scene.tracer if known[name] is known.get("tracer") and name != "tracer" else tracer
    scene.part_tracers = {k: tracer for k, tracer in known["part_tracers"].items() if k not in gone}
    corners, triangles = moved.corners
    scene.mirror_tracers = {
        material: tracer
        for material, tracer in known["mirror_tracers"].items()
        if not triangles.any(known["seen"][material])
    }
    if "lights" in known and same_lights(earlier, scene):
        scene.lights = known["lights"]
    if earlier.known_textures is not None:
        scene.known_textures = earlier.known_textures
    if "triangle_records" in known:
        records = known["triangle_records"].numpy().reshape(-1, 12).copy()
        if bent:
            records[:, 9] = scene.closed_patches.numpy()[scene.host_triangle_patch]
        triangles.put(records[:, :9], scene.host_points.take(corners, axis=0).reshape(-1, 9))
        scene.triangle_records = wp.array(records.reshape(-1), dtype=float, device=scene.device, copy=False)
    if "boxes" in known and len(known["boxes"][0]):
        first, count, boxes = known["boxes"]
        begins, of_box = moved.boxes
        if len(begins):
            boxes = boxes.copy()
            boxes[of_box] = box_corners(placed, begins)
        scene.boxes = first, count, boxes
