"""What a scene has in common with the same stage's at another time: arrays and findings of what does not move are shared.

Whatever is taken over is what the scene would make anew, to the bit: a frame depends on its own time alone.
"""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import numpy as np
import warp as wp

from warp_reflect.scene import (
    InstanceData,
    MeshData,
    PatchView,
    Scene,
    SceneData,
    SceneView,
    box_corners,
    first_rows,
    placed_normals,
    placed_points,
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
    before, now = (np.stack([each.world_from_object for each in one.instances]) for one in (earlier, data))
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


def lay_out(scene: Scene, earlier: Scene, moved: list[int]) -> None:
    """Lay out a scene like an earlier one with some instances elsewhere, and give it what is known of the others.

    Args:
        scene: Has its data.
        earlier: Of the same stage.
        moved: Of `moved_instances`.
    """
    scene.data = replace(scene.data, materials=earlier.data.materials)
    scene.origin, scene.material_notes = earlier.origin, earlier.material_notes
    scene.notes += [note for note in earlier.material_notes if note not in scene.notes]
    for name in ("host_triangles", "host_triangle_patch", "host_normal_index", "patch_shapes"):
        setattr(scene, name, getattr(earlier, name))
    scene.host_points, scene.host_normals = earlier.host_points.copy(), earlier.host_normals.copy()
    scene.parts = list(earlier.parts)
    patches = earlier.view.patches.numpy().copy()
    first_point, first_normal = first_rows(scene.data)
    parts = _parts_of(earlier, moved)
    for prim in moved:
        instance = scene.data.instances[prim]
        mesh, where = scene.data.meshes[instance.mesh], scene.scene_from_object(instance)
        at = first_point[prim]
        scene.host_points[at : at + len(mesh.points)] = placed_points(mesh, where)
        if mesh.normals is not None:
            at = first_normal[prim]
            scene.host_normals[at : at + len(mesh.normals)] = placed_normals(mesh, where)
        for k in parts[prim]:
            scene.parts[k] = replace(earlier.parts[k], world_from_object=instance.world_from_object)
            for number in earlier.parts[k].patches:
                if (shape := earlier.patch_shapes[number]) is not None:
                    patches[number]["unit_from_scene"] = unit_from_scene(shape, where)
    view, known = SceneView(), earlier.view
    for name in SceneView.vars:
        setattr(view, name, getattr(known, name))
    view.points = wp.array(scene.host_points, dtype=wp.vec3, device=scene.device, copy=False)
    view.normals = wp.array(scene.host_normals, dtype=wp.vec3, device=scene.device, copy=False)
    view.patches = wp.array(patches, dtype=PatchView, device=scene.device)
    scene.view = view
    _take_over(scene, earlier, moved, [k for prim in moved for k in parts[prim]])


def _parts_of(scene: Scene, prims: list[int]) -> dict[int, list[int]]:
    """Parts of some instances, by instance."""
    found: dict[int, list[int]] = {prim: [] for prim in prims}
    for k, part in enumerate(scene.parts):
        if part.prim - 1 in found:
            found[part.prim - 1].append(k)
    return found


def _take_over(scene: Scene, earlier: Scene, moved: list[int], parts: list[int]) -> None:
    """Findings that hold on: of the whole layout, and of the parts that did not move."""
    known, gone = vars(earlier), set(parts)
    gone_triangles = {scene.parts[k].first_triangle for k in parts}
    bent = bent_meshes(earlier.data, scene.data)
    for name in PLACELESS:
        if name in known and not (bent and name in OF_SHAPE):
            vars(scene)[name] = known[name]
    scene.bodies = {k: body for k, body in earlier.bodies.items() if k not in gone}
    scene.bodies_in_place = {key: body for key, body in earlier.bodies_in_place.items() if key[0] not in bent}
    scene.pyramids, scene.lasting = earlier.pyramids, earlier.lasting
    scene.seen = dict(earlier.seen)
    scene.fits = {k: fit for k, fit in earlier.fits.items() if k not in gone}
    scene.segmentations = {k: found for k, found in earlier.segmentations.items() if k not in gone}
    scene.facts = {
        key: fact for key, fact in earlier.facts.items() if key[1] is not None and key[1] not in gone_triangles
    }
    for name in TRACERS:
        if name in known and not bent and (tracer := known[name].at(scene)) is not None:
            # One object where it is one.
            vars(scene)[name] = scene.tracer if known[name] is known.get("tracer") and name != "tracer" else tracer
    scene.part_tracers = {k: tracer for k, tracer in earlier.part_tracers.items() if k not in gone}
    ranges = [slice(p.first_triangle, p.first_triangle + p.triangle_count) for p in map(scene.parts.__getitem__, parts)]
    scene.mirror_tracers = {
        material: tracer
        for material, tracer in earlier.mirror_tracers.items()
        if not any(earlier.seen[material][own].any() for own in ranges)
    }
    if "lights" in known and same_lights(earlier, scene):
        scene.lights = known["lights"]
    if earlier.known_textures is not None:
        scene.known_textures = earlier.known_textures
    if "triangle_records" in known:
        records = known["triangle_records"].numpy().reshape(-1, 12).copy()
        if bent:
            records[:, 9] = scene.closed_patches.numpy()[scene.host_triangle_patch]
        for own in ranges:
            records[own, :9] = scene.host_points[scene.host_triangles[own]].reshape(-1, 9)
        scene.triangle_records = wp.array(records.reshape(-1), dtype=float, device=scene.device)
    if "boxes" in known and len(known["boxes"][0]):
        first, count, corners = known["boxes"]
        corners = corners.copy()
        spans = sorted({(scene.parts[k].first_vertex, scene.parts[k].vertex_count) for k in parts})
        for at, vertices in spans:
            if vertices:
                corners[np.searchsorted(first, at)] = box_corners(
                    scene.host_points[at : at + vertices], np.zeros(1, int)
                )
        scene.boxes = first, count, corners
