"""An octree over points whose cells of all levels share the nodes of one lattice. Host, made once per scene.

Source: the level-of-detail hierarchy of grids that Estalella et al. 2005, section 8, leave as future work; their grids
(section 5) keep the cells that hold a vertex, as here. The points are ordered along the octree's curve (Morton order),
so every cell of every level is one range of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CORNER_COUNT = 8
LEVEL_MAX = 16  # the finest lattice has 2^16 cells along an axis: 3 x 16 bits of Morton order fit int64
SPLIT_MIN = 6  # points; below it the nodes of smaller cells outnumber what they hold
CORNER_STEP = np.array([[k & 1, k >> 1 & 1, k >> 2 & 1] for k in range(CORNER_COUNT)])
LATTICE_WIDTH = (1 << LEVEL_MAX) + 1


@dataclass(frozen=True)
class Octree:
    """Cells of all levels, coarse levels first; the children of a cell are consecutive.

    Attributes:
        order: int32 [point_count], points along the curve.
        low: float64 [3], lowest corner of the cube.
        size: Its edge.
        level: int32 [cell_count]; a cell's edge is size / 2^level.
        place: int32 [cell_count, 3], lowest corner on the finest lattice.
        first, count: int32 [cell_count], a cell's range of `order`.
        child_first, child_count: int32 [cell_count]; count 0: it holds too few points to be split.
        corners: int32 [cell_count, 8], indices into `nodes`, corner k at bits (x, y, z) of k.
        nodes: int32 [node_count, 3], on the finest lattice.
        level_first: int [level_count + 1], first cell of every level.
    """

    order: np.ndarray
    low: np.ndarray
    size: float
    level: np.ndarray
    place: np.ndarray
    first: np.ndarray
    count: np.ndarray
    child_first: np.ndarray
    child_count: np.ndarray
    corners: np.ndarray
    nodes: np.ndarray
    level_first: np.ndarray

    @property
    def level_count(self) -> int:
        return len(self.level_first) - 1

    @property
    def unit(self) -> float:
        """Edge of a cell of the finest lattice."""
        return self.size / (1 << LEVEL_MAX)

    def edge(self, cells: np.ndarray) -> np.ndarray:
        """Edge length of cells, float64."""
        return np.ldexp(self.size, -self.level[cells])

    def cells_of(self, level: int) -> np.ndarray:
        """Every cell of a level, and the coarser ones above its gaps that are not split."""
        whole = np.arange(self.level_first[level])
        whole = whole[self.child_count[whole] == 0]
        return np.concatenate([whole, np.arange(self.level_first[level], self.level_first[level + 1])])


def build(points: np.ndarray) -> Octree:
    """An octree over points, float [n, 3], n > 0."""
    points = np.asarray(points, np.float64)
    low = points.min(axis=0)
    # A hair larger than the bounds, so that the farthest points lie inside; a single point gets a cube of edge 1.
    size = float((points.max(axis=0) - low).max()) * (1.0 + 1.0e-6) or 1.0
    lattice = np.clip(((points - low) * ((1 << LEVEL_MAX) / size)).astype(np.int64), 0, (1 << LEVEL_MAX) - 1)
    code = _morton(lattice)
    order = np.argsort(code, kind="stable").astype(np.int32)
    code, lattice = code[order], lattice[order].astype(np.int32)
    n = len(points)
    alive = np.ones(n, bool)
    cell_of = np.zeros(n, np.int64)  # the cell of the level above
    levels = []
    cell_count = 0
    for level in range(LEVEL_MAX + 1):
        key = code >> (3 * (LEVEL_MAX - level))
        starts = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
        counts = np.diff(np.r_[starts, n])
        kept = alive[starts]
        first, count = starts[kept], counts[kept]
        split = (count >= SPLIT_MIN) & (level < LEVEL_MAX)
        place = lattice[first] >> (LEVEL_MAX - level) << (LEVEL_MAX - level)
        levels.append((first, count, place, cell_of[first]))
        number = np.full(len(starts), -1, np.int64)
        number[kept] = cell_count + np.arange(len(first))
        cell_of = np.repeat(number, counts)
        going = np.zeros(len(starts), bool)
        going[kept] = split
        alive = np.repeat(going, counts)
        cell_count += len(first)
        if not alive.any():
            break
    level = np.repeat(np.arange(len(levels)), [len(part[0]) for part in levels]).astype(np.int32)
    first, count, place, parent = (np.concatenate([part[k] for part in levels]) for k in range(4))
    child_first, child_count = np.zeros(cell_count, np.int32), np.zeros(cell_count, np.int32)
    if cell_count > 1:
        parents, starts, counts = np.unique(parent[1:], return_index=True, return_counts=True)
        child_first[parents], child_count[parents] = starts + 1, counts
    step = (1 << (LEVEL_MAX - level.astype(np.int64)))[:, None, None]
    corner = place[:, None, :] + CORNER_STEP * step
    key = (corner[..., 2] * LATTICE_WIDTH + corner[..., 1]) * LATTICE_WIDTH + corner[..., 0]
    numbers, corners = np.unique(key, return_inverse=True)
    corners = corners.reshape(-1, CORNER_COUNT).astype(np.int32)
    nodes = np.stack(
        [numbers % LATTICE_WIDTH, numbers // LATTICE_WIDTH % LATTICE_WIDTH, numbers // LATTICE_WIDTH**2], axis=1
    )
    level_first = np.searchsorted(level, np.arange(len(levels) + 1))
    return Octree(
        order,
        low,
        size,
        level,
        place.astype(np.int32),
        first.astype(np.int32),
        count.astype(np.int32),
        child_first,
        child_count,
        corners,
        nodes.astype(np.int32),
        level_first,
    )


def _morton(lattice: np.ndarray) -> np.ndarray:
    """Interleaved bits of non-negative lattice coordinates below 2^16, x lowest."""
    x = lattice.astype(np.int64)
    for shift, mask in (
        (16, 0x0000FF0000FF),
        (8, 0x00F00F00F00F),
        (4, 0x0C30C30C30C3),
        (2, 0x249249249249),
    ):
        x = (x | (x << shift)) & mask
    return x[:, 0] | (x[:, 1] << 1) | (x[:, 2] << 2)
