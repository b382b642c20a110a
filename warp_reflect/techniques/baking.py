"""Reflector maps out of a file instead of drawn ones, where they were drawn from the very same geometry."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from warp_reflect import __version__
from warp_reflect.baked_maps import BakedMap
from warp_reflect.reflector_maps import ReflectorMap
from warp_reflect.scene import Note, PartRange, Scene

DIGEST_BYTES = 16  # two geometries share a digest by chance once in 1e38
# Of the scale: a mirror that was turned, scaled alike and moved since keeps its map. Turns that a stage stores in float32
# are off by 1e-7, as is the map itself.
MOTION_ROUNDING = 1.0e-6


def mirror_path(part: PartRange) -> str:
    """The prim that a reflector's maps are baked to: the drawn prim, or its GeomSubset."""
    return f"{part.prim_path}/{part.subset}" if part.subset else part.prim_path


def baked_or_drawn(
    scene: Scene, part: PartRange, faces: np.ndarray, resolution: int, draw: Callable[[], ReflectorMap]
) -> ReflectorMap:
    """A map of a reflector or of a piece of it; carries the digest of what it is made from.

    A baked map is used where it was drawn from the same mesh at no lower a resolution and the mirror was only turned, moved
    or scaled alike since; where nothing at all changed it is the drawn map bit for bit. Where a mirror has baked maps but
    none that fits, the scene gets one note and the map is drawn.

    Args:
        scene: Its stage may have named baked maps (`SceneData.baked_maps`).
        part: The reflector.
        faces: The triangles that are mapped, as `segments.part_mesh` counts their points, int [n, 3].
        resolution: Nodes along a cube edge that are asked for.
        draw: Draws the map.
    """
    digest = geometry_digest(scene, part, faces)
    baked = () if part.instance else scene.data.baked_maps.get(mirror_path(part), ())
    same = [each for each in baked if each.geometry == digest]
    moved = [(each, _baked_from_now(each, scene, part)) for each in same if each.resolution >= resolution]
    for each, baked_from_now in moved:
        if baked_from_now is not None:
            return ReflectorMap.restored(each, each.unit_from_body @ baked_from_now, scene.device)
    if baked:
        reason = "does not fit the geometry"
        if same and not moved:
            reason = f"has {same[0].resolution} nodes along an edge, {resolution} are asked for"
        elif moved:
            reason = "is of another shape: the mirror was stretched, sheared or turned inside out since"
        note = Note(mirror_path(part), f"its baked reflector map {reason}: drawn anew; bake the stage again")
        if note not in scene.notes:
            scene.notes.append(note)
    return draw().of_geometry(digest)


def geometry_digest(scene: Scene, part: PartRange, faces: np.ndarray) -> str:
    """Digest, 32 hexadecimal digits, of all that a map is drawn from but for where the mirror is, and of what draws it.

    Args:
        scene: Where the mirror's mesh and its analytic surfaces are from.
        part: The reflector.
        faces: As for `baked_or_drawn`.
    """
    digest = hashlib.blake2b(__version__.encode(), digest_size=DIGEST_BYTES)

    def add(*values) -> None:
        for value in values:
            array = np.ascontiguousarray(value if value is not None else np.zeros(0))
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())

    mesh = scene.data.meshes[scene.data.instances[part.prim - 1].mesh]
    add(mesh.points, mesh.triangles, mesh.normals, mesh.normal_index, faces)
    shapes = [(k - part.patches.start, scene.patch_shapes[k]) for k in part.patches]
    for number, shape in shapes:
        if shape is not None:
            add(number, shape.kind, shape.unit_from_object, shape.a, shape.b, shape.c, shape.z_min, shape.z_max)
    if any(shape is not None for _, shape in shapes):
        own = slice(part.first_triangle, part.first_triangle + part.triangle_count)
        add(scene.host_triangle_patch[own] - part.patches.start)
    return digest.hexdigest()


def _baked_from_now(baked: BakedMap, scene: Scene, part: PartRange) -> np.ndarray | None:
    """The motion of the mirror back to where it was baked, scene frames, float64 [4, 4].

    None where it is not the motion of a rigid body and one scale.
    """
    motion = np.eye(4)
    now, then = part.world_from_object, baked.world_from_object
    if np.array_equal(now, then) and np.array_equal(scene.origin, baked.origin):
        return motion
    if not np.array_equal(now[:3, :3], then[:3, :3]):
        motion[:3, :3] = then[:3, :3] @ np.linalg.inv(now[:3, :3])
    gram = motion[:3, :3] @ motion[:3, :3].T
    scale = np.trace(gram) / 3.0
    if np.linalg.det(motion[:3, :3]) <= 0.0 or np.abs(gram - scale * np.eye(3)).max() > MOTION_ROUNDING * scale:
        return None
    motion[:3, 3] = then[:3, 3] - baked.origin - motion[:3, :3] @ (now[:3, 3] - scene.origin)
    return motion


def to_baked(scene: Scene, part: PartRange, drawn: ReflectorMap) -> BakedMap:
    """A map from `baked_or_drawn` as it is written."""
    return BakedMap(
        drawn.geometry,
        drawn.texels,
        drawn.unit_from_body,
        drawn.extent,
        drawn.inner_radius,
        drawn.outer_radius,
        part.world_from_object,
        scene.origin,
    )
