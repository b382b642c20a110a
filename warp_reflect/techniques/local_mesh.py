"""Depths around a local map's centre: rays at the nodes of an adaptive mesh over every face of a cube.

Source: Meyer and Loscos, Real-Time Reflection on Moving Vehicles in Urban Environments, VRST 2003, section 4.1. Differs from
it by:

* nodes are the texels' centres, so a mesh refined to the end holds every discontinuity that it met exactly; between nodes
  the inverse of the depth along the face's axis is interpolated, which is affine on planes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.cubemap import FACE_COUNT, texel_directions

wp.set_module_options({"enable_backward": False})

RATIO_TOLD = 0.25  # of depths that count as discontinuities where all texels are traced
INVERSE_MAX = 1.0e30  # inverse depth of a point at the centre itself

# (directions float32 [n, 3]) -> (distance float32 [n], 0 where there is only sky; triangle int32 [n], -1 likewise, or
# where it is not known)
Intersect = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass
class DepthMesh:
    """What the rays of a local map met, at every texel.

    Attributes:
        inverse: Inverse depth along the face's axis, 0 sky, float32 [6, n, n].
        triangle: Of the ray, or of the nearest node's; -1 sky or unknown, int32 [6, n, n].
        traced: Whether it has a ray of its own, bool [6, n, n].
        cells: Of the mesh, (face, y, x, size in texels), int32 [m, 4]: its nodes are their corners.
        statistics: `local_rays`, `local_discontinuities` (neighbouring texels at depths apart by more than the ratio),
            `local_discontinuities_traced` (those of which both have rays of their own).
    """

    inverse: np.ndarray
    triangle: np.ndarray
    traced: np.ndarray
    cells: np.ndarray = field(default_factory=lambda: np.zeros((0, 4), np.int32))
    statistics: dict = field(default_factory=dict)

    @classmethod
    def empty(cls, resolution: int) -> DepthMesh:
        shape = (FACE_COUNT, resolution, resolution)
        return cls(np.zeros(shape, np.float32), np.full(shape, -1, np.int32), np.zeros(shape, bool))

    def trace(self, texels: np.ndarray, intersect: Intersect) -> np.ndarray:
        """Give texels (flat indices, each once) rays of their own; returns their inverse distances, 0 sky, float32."""
        axis_directions, lengths = texel_rays(self.inverse.shape[1])
        length = lengths[texels]
        distance, triangle = intersect(axis_directions[texels] / length[:, None])
        with np.errstate(divide="ignore", over="ignore"):
            near = np.minimum(np.float32(1.0) / distance, np.float32(INVERSE_MAX))
        # A distance of 0 on a triangle is a point at the centre, without one the sky.
        radial = np.where((distance > 0.0) | (triangle >= 0), near, np.float32(0.0))
        self.inverse.reshape(-1)[texels] = np.minimum(radial * length, INVERSE_MAX)
        self.triangle.reshape(-1)[texels] = triangle
        self.traced.reshape(-1)[texels] = True
        self.statistics["local_rays"] = self.statistics.get("local_rays", 0) + len(texels)
        return radial


@cache
def texel_rays(resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions of a map's texels at length 1 along their face's axis, float32 [6 n n, 3], and their lengths."""
    directions = texel_directions(resolution).reshape(-1, 3)
    return directions.astype(np.float32), np.linalg.norm(directions, axis=1).astype(np.float32)


@wp.kernel
def fill_cells_kernel(
    first: int,
    resolution: int,
    cells: wp.array(dtype=wp.vec4i),
    traced: wp.array(dtype=wp.uint8),
    # Changed:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
):
    """One thread per cell (face, y, x, size): the texels between its corners; on its far edges only where no cell follows."""
    i = first + wp.tid()
    cell = cells[i]
    n = resolution
    x0 = cell[2]
    y0 = cell[1]
    x1 = wp.min(x0 + cell[3], n - 1)
    y1 = wp.min(y0 + cell[3], n - 1)
    base = cell[0] * n * n
    a = base + y0 * n + x0
    b = base + y0 * n + x1
    c = base + y1 * n + x0
    d = base + y1 * n + x1
    last_x = wp.where(x1 == n - 1, x1, x1 - 1)
    last_y = wp.where(y1 == n - 1, y1, y1 - 1)
    for y in range(y0, last_y + 1):
        fy = float(y - y0) / float(wp.max(y1 - y0, 1))
        for x in range(x0, last_x + 1):
            t = base + y * n + x
            if int(traced[t]) == 0:
                fx = float(x - x0) / float(wp.max(x1 - x0, 1))
                top = (1.0 - fx) * out_inverse[a] + fx * out_inverse[b]
                low = (1.0 - fx) * out_inverse[c] + fx * out_inverse[d]
                out_inverse[t] = (1.0 - fy) * top + fy * low
                nearest = wp.where(fy < 0.5, wp.where(fx < 0.5, a, b), wp.where(fx < 0.5, c, d))
                out_triangle[t] = out_triangle[nearest]


def trace_depth_mesh(
    resolution: int, intersect: Intersect, cells: int, ratio: float, device, threads: int = 0
) -> DepthMesh:
    """Depths at every texel of a cube map, traced where they have to be.

    Args:
        resolution: Texels along a cube edge.
        intersect: Follows rays from the centre.
        cells: Cells along a face before refinement, at least.
        ratio: A cell is refined where |Zi - Zj| / min(Zi, Zj) of its corners is above it; 0: every texel is traced.
        device: For the filling.
        threads: CPU threads; 0: one per core.
    """
    n = resolution
    mesh = DepthMesh.empty(n)
    if ratio <= 0.0 or n < 3:
        mesh.trace(np.arange(FACE_COUNT * n * n), intersect)
    else:
        mesh.cells = _refine(mesh, intersect, cells, ratio)
    leaves = mesh.cells[mesh.cells[:, 3] > 1]  # the others have no texels but their corners
    arrays = [wp.array(mesh.inverse.reshape(-1), dtype=float, device=device)]
    arrays += [wp.array(mesh.triangle.reshape(-1), dtype=int, device=device)]
    known = wp.array(mesh.traced.reshape(-1).astype(np.uint8), dtype=wp.uint8, device=device)
    ready = wp.array(np.ascontiguousarray(leaves, np.int32), dtype=wp.vec4i, device=device)
    launch.launch(fill_cells_kernel, len(leaves), [n, ready, known, *arrays], device, threads)
    mesh.inverse, mesh.triangle = (array.numpy().reshape(mesh.traced.shape) for array in arrays)
    mesh.statistics |= _discontinuities(mesh, ratio if ratio > 0.0 else RATIO_TOLD)
    return mesh


def _refine(mesh: DepthMesh, intersect: Intersect, cells: int, ratio: float) -> np.ndarray:
    """Trace the nodes of the mesh; the cells that stay, (face, y, x, size), int32 [n, 4]."""
    n = mesh.inverse.shape[1]
    radial = np.zeros(FACE_COUNT * n * n, np.float32)
    size = 1
    while 2 * size * cells <= n:
        size *= 2
    start = np.arange(0, n - 1, size)
    grid = np.stack(np.meshgrid(np.arange(FACE_COUNT), start, start, indexing="ij"), -1).reshape(-1, 3)
    done = []
    while True:
        face, y0, x0 = grid.T
        y1, x1 = np.minimum(y0 + size, n - 1), np.minimum(x0 + size, n - 1)
        corners = face * n * n + np.stack([y0 * n + x0, y0 * n + x1, y1 * n + x0, y1 * n + x1])
        wanted = np.zeros(len(radial), bool)
        wanted[corners] = True
        asked = np.flatnonzero(wanted & ~mesh.traced.reshape(-1))
        if len(asked):
            radial[asked] = mesh.trace(asked, intersect)
        if size == 1:
            done.append(np.column_stack([grid, np.ones(len(grid), np.int64)]))
            break
        a, b, c, d = radial[corners]
        most, least = np.maximum(np.maximum(a, b), np.maximum(c, d)), np.minimum(np.minimum(a, b), np.minimum(c, d))
        # |Zi - Zj| / min > ratio in inverse depths; sky, at 0, splits from everything but sky.
        split = most > (1.0 + ratio) * least
        done.append(np.column_stack([grid[~split], np.full(int((~split).sum()), size)]))
        size //= 2
        steps = np.array([[0, 0, 0], [0, 0, size], [0, size, 0], [0, size, size]])
        grid = (grid[split][:, None] + steps).reshape(-1, 3)
        grid = grid[(grid[:, 1] < n - 1) & (grid[:, 2] < n - 1)]
    return np.concatenate(done).astype(np.int32)


def _discontinuities(mesh: DepthMesh, ratio: float) -> dict[str, int]:
    met = traced = 0
    for axis in (1, 2):
        first = [slice(None)] * 3
        second = [slice(None)] * 3
        first[axis], second[axis] = slice(None, -1), slice(1, None)
        a, b = mesh.inverse[tuple(first)], mesh.inverse[tuple(second)]
        apart = np.maximum(a, b) > (1.0 + ratio) * np.minimum(a, b)
        met += int(apart.sum())
        traced += int((apart & mesh.traced[tuple(first)] & mesh.traced[tuple(second)]).sum())
    return {"local_discontinuities": met, "local_discontinuities_traced": traced}
