"""Warp's structure over triangles, and what rays walk instead: packets on a CPU, single ones on CUDA.

Built once, fitted where points have moved.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_reflect.launch import Turns
from warp_reflect.ray_tree import RayTree
from warp_reflect.scene import Scene

if TYPE_CHECKING:
    from warp_reflect.wide_tree import WideTree


# On CUDA: triangles of a leaf, of which `ray_tree.py` puts a few together. Down "sah", which the host builds 60 times as long,
# rays take 0.86 to 0.93 of the time, mirrors' and shadows', in two scenes on an H100.
CUDA_LEAF = 1


class Tree:
    """Triangles in a BVH, laid out once and fitted to the points of who asks; several times of a stage may share one.

    Attributes:
        mesh: Owner of the structure.
    """

    def __init__(self, points: wp.array, indices: wp.array, groups: np.ndarray | None = None):
        """Lay it out after points, which it keeps; `groups`: of every triangle, each in a branch of its own."""
        kind = (
            {"bvh_constructor": "lbvh", "bvh_leaf_size": CUDA_LEAF}
            if points.device.is_cuda
            else {"bvh_constructor": "sah"}
        )
        self._groups = None if groups is None else wp.array(groups, dtype=wp.int32, device=points.device)
        self.mesh = wp.Mesh(points, indices, groups=self._groups, **kind)
        self._making = Turns()  # of what several threads that draw one scene ask for at once
        self._wide: WideTree | None = None
        self._fitted: wp.array | None = points
        self._wide_fits = False
        self._rays: RayTree | None = None

    @property
    def id(self) -> int:
        """Handle for `ray_query.py`, of what it is fitted to."""
        if not self.mesh.device.is_cuda:
            return self.mesh.id
        with self._making:
            if self._rays is None:
                self._rays = RayTree(self.mesh)
                if not self._rays.is_whole:
                    # Some branch is much longer than the others; where each is of half the triangles, none is.
                    points, indices = self.mesh.points, self.mesh.indices
                    self.mesh = wp.Mesh(points, indices, groups=self._groups, bvh_constructor="median")
                    self._rays = RayTree(self.mesh)
            return self._rays.id

    def to(self, points: wp.array) -> Tree:
        """Fit it to points, if it is not."""
        if self._fitted is not points:  # asked twice: a frame asks dozens of times, and nearly always it is
            with self._making:
                if self._fitted is not points:
                    if self.mesh.points is not points:
                        wp.copy(self.mesh.points, points)
                    self.mesh.refit()
                    if self._rays is not None:
                        self._rays.fit()
                    self._wide_fits = False
                    self._fitted = points
        return self

    def loosen(self) -> None:
        """Points were moved in place: it is fitted when it is asked for next."""
        self._fitted, self._wide_fits = None, False

    def has_packets(self, points: wp.array) -> bool:
        """Whether what packets walk down is there, and fitted to these points."""
        return self._wide_fits and self._fitted is points

    @property
    def packets(self) -> int:
        """Handle for the snippets of `wide_packets.py`; on the CPU only, laid out at first use, fitted where it is not."""
        return self.wide.id

    @property
    def wide(self) -> WideTree:
        """The structure that packets walk down; as `packets`."""
        if not self._wide_fits:
            with self._making:
                if self._wide is None:
                    from warp_reflect.wide_tree import WideTree  # not compiled where there are no packets

                    self._wide = WideTree(self.mesh)
                elif not self._wide_fits:
                    self._wide.fit()
                self._wide_fits = True
        return self._wide


def resting_tree(scene: Scene, indices: wp.array) -> Tree:
    """A tree for all times of a stage, over its triangles' flat indices.

    It follows from what stands still and from the shapes of what moves, each in a branch of its own, wherever that stands: rays
    meet the same at a time whichever was looked at before.
    """
    groups = np.zeros(scene.triangle_count, np.int32)
    for part in (scene.parts[k] for k in scene.moving_parts):
        groups[part.first_triangle : part.first_triangle + part.triangle_count] = part.prim
    return Tree(wp.array(scene.points_at_rest, dtype=wp.vec3, device=scene.device), indices, groups)
