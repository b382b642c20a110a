"""Reflector maps out of a file instead of drawn ones, where they were drawn from the very same geometry."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from warp_reflect.baked_maps import BakedMap
from warp_reflect.bodies import Sheet
from warp_reflect.reflector_maps import ReflectorMap
from warp_reflect.scene import Note, PartRange, Scene

DIGEST_BYTES = 16  # two geometries share a digest by chance once in 1e38


def mirror_path(part: PartRange) -> str:
    """The prim that a reflector's maps are baked to: the drawn prim, or its GeomSubset."""
    return f"{part.prim_path}/{part.subset}" if part.subset else part.prim_path


def baked_or_drawn(
    scene: Scene,
    part: PartRange,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray | None],
    resolution: int,
    draw: Callable[[], ReflectorMap],
    sheet: Sheet | None = None,
) -> ReflectorMap:
    """A map of a reflector or of a piece of it; carries the digest of what it was made from.

    A baked map is used where it was drawn from the same geometry at no lower a resolution. Where a mirror has baked maps but
    none that fits, the scene gets one note and the map is drawn.

    Args:
        part: The reflector.
        mesh: (points [n, 3], triangles [m, 3], corner normals [m, 3, 3] or None) that it is drawn from.
        resolution: Nodes along a cube edge that are asked for.
        draw: Draws the map.
        sheet: The frame that it is drawn about, for a piece.
    """
    digest = geometry_digest(scene, part, mesh, sheet)
    baked = () if part.instance else scene.data.baked_maps.get(mirror_path(part), ())
    same = [each for each in baked if each.geometry == digest]
    fine = [each for each in same if each.resolution >= resolution]
    if fine:
        return ReflectorMap.restored(fine[0], scene.device)
    if baked:
        reason = f"has {same[0].resolution} nodes, {resolution} are asked for" if same else "does not fit the geometry"
        note = Note(mirror_path(part), f"its baked reflector map {reason}: drawn anew; bake the stage again")
        if note not in scene.notes:
            scene.notes.append(note)
    return draw().of_geometry(digest)


def geometry_digest(
    scene: Scene, part: PartRange, mesh: tuple[np.ndarray, np.ndarray, np.ndarray | None], sheet: Sheet | None = None
) -> str:
    """Digest, 32 hexadecimal digits, of all numbers that a map is drawn from.

    Args:
        scene: Its analytic surfaces are part of it where the reflector has some.
        part: The reflector.
        mesh: As for `baked_or_drawn`.
        sheet: As for `baked_or_drawn`.
    """
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)

    def add(*values) -> None:
        for value in values:
            array = np.ascontiguousarray(value)
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())

    add(*(values if values is not None else np.zeros(0) for values in mesh))
    shapes = [(k, scene.patch_shapes[k]) for k in part.patches if scene.patch_shapes[k] is not None]
    for k, shape in shapes:
        add(k - part.patches.start, shape.kind, shape.unit_from_object)
        add(shape.a, shape.b, shape.c, shape.z_min, shape.z_max)
    if shapes:
        own = slice(part.first_triangle, part.first_triangle + part.triangle_count)
        add(part.world_from_object, scene.origin, scene.host_triangle_patch[own] - part.patches.start)
    if sheet is not None:
        add(sheet.centre, sheet.axes, sheet.extent, sheet.inner)
    return digest.hexdigest()


def to_baked(drawn: ReflectorMap) -> BakedMap:
    """A map from `baked_or_drawn` as it is written."""
    return BakedMap(
        drawn.geometry,
        drawn.texels,
        drawn.unit_from_body,
        drawn.extent,
        drawn.inner_radius,
        drawn.outer_radius,
    )
