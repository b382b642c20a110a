"""Meshes as a binary glTF file, for readers that know no USD."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from warp_reflect.stage.write import passing_name

# glTF is +Y up; USD's other choice is +Z.
GLTF_FROM_UP = {"Y": np.eye(3), "Z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])}


def write_glb(
    path: str | os.PathLike,
    meshes: list[tuple[str, str, np.ndarray, np.ndarray, tuple]],
    origin: np.ndarray,
    up_axis: str,
    meters_per_unit: float,
) -> None:
    """Write meshes in metres, +Y up; one node per mirror, one below it per object.

    Args:
        path: Where; written to a passing name, synced and renamed.
        meshes: (mirror's name, object's name, points [n, 3] from `origin`, triangles [m, 3], linear colour), one or more.
        origin: float64 [3], stage units; becomes the translation of the root node, so that points stay small.
        up_axis: "Y" or "Z".
        meters_per_unit: Of the stage.

    Raises:
        OSError: it could not be written; an older file under the name is still whole.
    """
    import trimesh

    gltf_from_stage = np.eye(4)
    gltf_from_stage[:3, :3] = meters_per_unit * GLTF_FROM_UP[up_axis]
    gltf_from_stage[:3, 3] = gltf_from_stage[:3, :3] @ origin
    scene = trimesh.Scene()
    scene.graph.update(frame_from="world", frame_to="WarpReflect", matrix=gltf_from_stage)
    for mirror, name, points, triangles, color in meshes:
        scene.graph.update(frame_from="WarpReflect", frame_to=mirror, matrix=np.eye(4))
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[*color, 1.0], metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
        )
        mesh = trimesh.Trimesh(points, triangles, process=False, validate=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        unique = f"{mirror}/{name}"
        scene.add_geometry(mesh, node_name=unique, geom_name=unique, parent_node_name=mirror)
    data = scene.export(file_type="glb")
    final = Path(os.path.realpath(path))
    part = passing_name(final)
    try:
        with open(part, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, final)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)
