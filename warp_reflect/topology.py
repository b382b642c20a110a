"""Which triangles of a scene meet at their edges, and which surfaces are closed. Host; of arrays alone."""

from __future__ import annotations

import numpy as np

from warp_reflect.bodies import weld


def edge_neighbours(triangles: np.ndarray) -> np.ndarray:
    """Per triangle the triangle across each edge (v0v1, v1v2, v2v0); -1 at borders and where more than two meet.

    Args:
        triangles: Vertex indices, int [triangle_count, 3].

    Returns:
        int32 [triangle_count, 3].
    """
    count = len(triangles)
    result = np.full(3 * count, -1, np.int32)
    if count:
        starts = triangles.reshape(-1).astype(np.int64)
        ends = triangles[:, [1, 2, 0]].reshape(-1).astype(np.int64)
        key = np.minimum(starts, ends) * (int(triangles.max()) + 1) + np.maximum(starts, ends)
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        same = ordered[1:] == ordered[:-1]
        # Exactly two uses of an edge: equal to the next one, and to no other on either side.
        pair = same.copy()
        pair[1:] &= ~same[:-1]
        pair[:-1] &= ~same[1:]
        left, right = order[:-1][pair], order[1:][pair]
        result[left] = right // 3
        result[right] = left // 3
    return result.reshape(count, 3)


def joined_neighbours(points: np.ndarray, triangles: np.ndarray, apart: list[slice]) -> np.ndarray:
    """`edge_neighbours` over welded points: the seams of gprims and of faceVarying exports stop no walk.

    Args:
        points: float32 [vertex_count, 3].
        triangles: int32 [triangle_count, 3].
        apart: Ranges of triangles that are joined with their own alone, whatever they touch.

    Returns:
        int32 [triangle_count, 3].
    """
    rest = np.ones(len(triangles), bool)
    result = np.full((len(triangles), 3), -1, np.int32)
    for own in apart:
        rest[own] = False
        if own.stop > own.start:
            low = int(triangles[own].min())
            corners = weld(points[low : int(triangles[own].max()) + 1], triangles[own] - low)
            across = edge_neighbours(corners)
            result[own] = np.where(across >= 0, across + own.start, -1)
    number = np.flatnonzero(rest)
    across = edge_neighbours(weld(points, triangles[number]))
    result[number] = np.where(across >= 0, number[across], -1)
    return result


def closed_ranges(
    points: np.ndarray, triangles: np.ndarray, across: np.ndarray, first: np.ndarray, count: np.ndarray
) -> np.ndarray:
    """Which ranges of triangles are closed and wound outwards, bool [n].

    Args:
        points: float32 [vertex_count, 3].
        triangles: int32 [triangle_count, 3].
        across: Of `joined_neighbours`.
        first, count: Of the ranges, which follow each other, int [n].
    """
    result = np.zeros(len(first), bool)
    some = np.flatnonzero(count > 0)
    if not len(some):
        return result
    low, high = first[some], first[some] + count[some]
    last = int(high[-1])
    of_triangle = np.repeat(np.arange(len(some)), count[some])
    beyond = across[low[0] : last]
    inside = ((beyond >= low[of_triangle, None]) & (beyond < high[of_triangle, None])).all(axis=1)
    whole = np.logical_and.reduceat(inside, low - low[0])
    # The volume about each range's own middle: about a far origin it would cancel.
    corner = points[triangles[low[0] : last]].astype(np.float64)
    middle = np.add.reduceat(corner.sum(axis=1), low - low[0], axis=0) / (3.0 * count[some, None])
    corner -= middle[of_triangle][:, None]
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    volume = (
        a[:, 0] * (b[:, 1] * c[:, 2] - b[:, 2] * c[:, 1])
        + a[:, 1] * (b[:, 2] * c[:, 0] - b[:, 0] * c[:, 2])
        + a[:, 2] * (b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0])
    )
    result[some] = whole & (np.add.reduceat(volume, low - low[0]) > 0.0)
    return result
