"""Meshes where they are placed, and parts of what moves where they rest: what follows from their shape is found out once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_reflect.scene import MeshData, Part


def placed_points(points: np.ndarray, scene_from_object: np.ndarray) -> np.ndarray:
    """A mesh's points in the scene frame, float32.

    Args:
        points: [n, 3].
        scene_from_object: [4, 4], or [4, 4, n] of points that are placed each for itself, with the same bits.
    """
    x, y, z = np.ascontiguousarray(points.T, np.float64)
    placed = np.empty((len(points), 3), np.float32)
    for k, row in enumerate(scene_from_object[:3]):
        placed[:, k] = row[0] * x + row[1] * y + row[2] * z + row[3]
    return placed


def placed_normals(normals: np.ndarray, object_from_scene: np.ndarray) -> np.ndarray:
    """A mesh's normals in the scene frame, float32, of unit length; arguments as for `placed_points`, [3, 3] or [3, 3, n]."""
    x, y, z = np.ascontiguousarray(normals.T, np.float64)
    m = object_from_scene
    turned = [m[0][k] * x + m[1][k] * y + m[2][k] * z for k in range(3)]
    length = np.maximum(np.sqrt(turned[0] * turned[0] + turned[1] * turned[1] + turned[2] * turned[2]), 1e-300)
    placed = np.empty((len(normals), 3), np.float32)
    for k in range(3):
        placed[:, k] = turned[k] / length
    return placed


@dataclass(frozen=True)
class AtRest:
    """A part of what moves, in the frame of its mesh, or where its place is no similarity in one as stretched and turned.

    Attributes:
        key: (mesh, which of its parts, and of what is stretched which prim).
        mesh, own: Those.
        scene_from_rest: Where it stands: a similarity, float64 [4, 4].
        stretch: float64 [3, 3] before that; None: the frame is the mesh's.
    """

    key: tuple[int, ...]
    mesh: MeshData
    own: Part
    scene_from_rest: np.ndarray
    stretch: np.ndarray | None

    @property
    def is_mirrored(self) -> bool:
        return bool(np.linalg.det(self.scene_from_rest[:3, :3]) < 0.0)

    def shape(self) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
        """(points, triangles of the part, normals, their index) at rest; as in `MeshData`."""
        own = slice(self.own.first_triangle, self.own.first_triangle + self.own.triangle_count)
        mesh, faces = self.mesh, self.mesh.triangles[own]
        index = faces if mesh.normal_index is None else mesh.normal_index[own]
        if self.stretch is None:
            return mesh.points, faces, mesh.normals, index
        order = [0, 2, 1] if np.linalg.det(self.stretch) < 0.0 else [0, 1, 2]
        points = placed_points(mesh.points, np.column_stack([self.stretch, np.zeros(3)]))
        normals = None if mesh.normals is None else placed_normals(mesh.normals, np.linalg.inv(self.stretch))
        return points, faces[:, order], normals, index[:, order]
