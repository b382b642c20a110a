"""What is not there at all is not drawn, and neither reflects nor is reflected."""

from __future__ import annotations

import dataclasses

import numpy as np

from warp_reflect.scene import InstanceData, MeshData, SceneData
from warp_reflect.stage.intake import Intake


def drop_transparent(data: SceneData, intake: Intake) -> None:
    """Take out the parts whose material has opacity 0, with a note; what the user calls a mirror stays.

    Args:
        data: Its instances and meshes are replaced where they lose parts.
        intake: The reading.
    """
    hidden = {
        index
        for index, material in enumerate(data.materials)
        if material.opacity == 0.0 and not (material.mirror is not None and material.mirror.include)
    }
    if not hidden:
        return
    reduced: dict[tuple, int] = {}
    kept: list[InstanceData] = []
    for instance in data.instances:
        shown = tuple(material not in hidden for material in instance.materials)
        for material, visible in zip(instance.materials, shown, strict=True):
            if not visible:
                path = data.materials[material].path or instance.prim_path
                intake.note(path, "opacity: got 0; what has it is not drawn")
        if all(shown):
            kept.append(instance)
        elif any(shown):
            key = instance.mesh, shown
            if key not in reduced:
                reduced[key] = len(data.meshes)
                data.meshes.append(_with_parts(data.meshes[instance.mesh], shown))
            left = tuple(m for m, visible in zip(instance.materials, shown, strict=True) if visible)
            kept.append(dataclasses.replace(instance, mesh=reduced[key], materials=left))
    data.instances = kept


def _with_parts(mesh: MeshData, shown: tuple[bool, ...]) -> MeshData:
    """The mesh with some of its parts only; points and corner attributes stay as they are."""
    parts, ranges, count = [], [], 0
    for part, visible in zip(mesh.parts, shown, strict=True):
        if visible:
            moved = count - part.first_triangle
            patches = tuple(
                dataclasses.replace(patch, first_triangle=patch.first_triangle + moved) for patch in part.patches
            )
            parts.append(dataclasses.replace(part, first_triangle=count, patches=patches))
            ranges.append(np.arange(part.first_triangle, part.first_triangle + part.triangle_count))
            count += part.triangle_count
    rows = np.concatenate(ranges)
    names = ("normal_index", "uv_index", "color_index")
    indices = {name: getattr(mesh, name) for name in names}
    # An attribute without an index of its own goes by the triangles, which are cut too.
    cut = {name: index[rows] for name, index in indices.items() if index is not None}
    return dataclasses.replace(mesh, triangles=mesh.triangles[rows], parts=parts, **cut)
