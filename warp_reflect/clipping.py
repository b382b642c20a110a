"""Triangles cut along the outline of a set of pixels.

The set is cut into rectangles, runs of pixels that are alike in consecutive rows, and every triangle that crosses its outline
is cut by each rectangle it overlaps: Sutherland and Hodgman, "Reentrant Polygon Clipping" (1974), in homogeneous pixel
coordinates, so that no corner needs to lie in front of the eye.
"""

from __future__ import annotations

import numpy as np

PAIRS_MAX = 1 << 22  # (triangle, rectangle) pairs that are compared at a time, for the memory's sake


def clip_to_mask(corners: np.ndarray, mask: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of triangles that cover pixels of a mask, by area, not by pixel centres.

    Args:
        corners: Homogeneous pixel coordinates (X, Y, W), pixel = (X, Y) / W, W the depth, float64 [n, 3, 3].
        mask: bool [height, width]; pixel (column, row) covers [column, column + 1) x [row, row + 1).
        near: What is nearer is cut off, > 0.

    Returns:
        (owner int [p], weights float64 [p, 3], triangles int32 [m, 3]): points, each the sum of its owner triangle's corners
        times its weights (in space, not on the screen), and the triangles between them; those wholly inside stay whole.
    """
    boxes = rectangles(mask)
    ahead = (corners[..., 2] > near).all(axis=1)
    low, high = np.full((len(corners), 2), -np.inf), np.full((len(corners), 2), np.inf)
    pixel = corners[ahead][..., :2] / corners[ahead][..., 2:]
    low[ahead], high[ahead] = pixel.min(axis=1), pixel.max(axis=1)
    inside, beside = _coverage(mask, low, high)
    owners, weights = [np.repeat(np.flatnonzero(inside), 3)], [np.tile(np.eye(3), (int(inside.sum()), 1))]
    triangles = [np.arange(3 * int(inside.sum())).reshape(-1, 3)]
    points = 3 * int(inside.sum())
    crossing = np.flatnonzero(~inside & ~beside & (corners[..., 2] > near).any(axis=1))
    step = max(PAIRS_MAX // max(len(boxes), 1), 1)
    for first in range(0, len(crossing), step):
        some = crossing[first : first + step]
        overlap = (low[some, None] < boxes[None, :, 2:]).all(axis=2) & (high[some, None] > boxes[None, :, :2]).all(
            axis=2
        )
        triangle, box = np.nonzero(overlap)
        polygon, count = _clip(corners[some[triangle]], boxes[box].astype(np.float64), near)
        kept = count >= 3
        polygon, count, owner = polygon[kept], count[kept], some[triangle[kept]]
        used = np.arange(polygon.shape[1]) < count[:, None]
        start = points + np.cumsum(count) - count
        fan = np.arange(1, max(polygon.shape[1] - 1, 1))
        member, corner = np.nonzero(fan < count[:, None] - 1)
        base, k = start[member], fan[corner]
        triangles.append(np.stack([base, base + k, base + k + 1], axis=1))
        owners.append(np.repeat(owner, count))
        weights.append(polygon[used])
        points += int(count.sum())
    return np.concatenate(owners), np.concatenate(weights), np.concatenate(triangles).astype(np.int32)


def rectangles(mask: np.ndarray) -> np.ndarray:
    """Disjoint rectangles (x0, y0, x1, y1), half-open, int [n, 4], that make up a mask bool [height, width]."""
    framed = np.pad(mask.astype(np.int8), ((0, 0), (1, 1)))
    row, start = np.nonzero(np.diff(framed, axis=1) == 1)
    _, end = np.nonzero(np.diff(framed, axis=1) == -1)
    # Of the same columns in consecutive rows: sorted by columns, then rows, they follow each other.
    order = np.lexsort((row, end, start))
    row, start, end = row[order], start[order], end[order]
    if not len(row):
        return np.zeros((0, 4), int)
    new = np.r_[True, (np.diff(start) != 0) | (np.diff(end) != 0) | (np.diff(row) != 1)]
    first = np.flatnonzero(new)
    last = np.r_[first[1:], len(row)] - 1
    return np.stack([start[first], row[first], end[first], row[last] + 1], axis=1).astype(int)


def _coverage(mask: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether all pixels that a box touches belong to the mask, and whether none does, bool [n] each.

    Args:
        mask: bool [height, width].
        low, high: Corners of the boxes, float64 [n, 2]. [pixels]
    """
    height, width = mask.shape
    total = np.zeros((height + 1, width + 1), np.int64)
    total[1:, 1:] = mask.cumsum(axis=0).cumsum(axis=1)
    x0, y0 = np.floor(np.clip(low, 0.0, [width, height])).astype(int).T
    x1, y1 = np.ceil(np.clip(high, 0.0, [width, height])).astype(int).T
    count = total[y1, x1] - total[y0, x1] - total[y1, x0] + total[y0, x0]
    whole = ((low >= 0.0) & (high <= [width, height])).all(axis=1)
    return whole & (count == (x1 - x0) * (y1 - y0)), count == 0


def _clip(corners: np.ndarray, boxes: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles float64 [n, 3, 3] cut by a box each: (weights of the corners float64 [n, 8, 3], vertex counts [n])."""
    n = len(corners)
    polygon = np.zeros((n, 8, 3))  # five planes add a vertex each to the three
    polygon[:, :3] = np.eye(3)
    count = np.full(n, 3)
    zero, one = np.zeros(n), np.ones(n)
    x0, y0, x1, y1 = boxes.T
    planes = [
        (zero, zero, one, np.full(n, -near)),
        (one, zero, -x0, zero),
        (-one, zero, x1, zero),
        (zero, one, -y0, zero),
        (zero, -one, y1, zero),
    ]
    for a, b, c, d in planes:
        at_corner = corners @ np.stack([a, b, c], axis=1)[:, :, None]
        height = np.einsum("nvk,nk->nv", polygon, at_corner[..., 0]) + d[:, None]
        polygon, count = _cut(polygon, count, height)
    return polygon, count


def _cut(polygon: np.ndarray, count: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts of convex polygons where an affine height, given at their vertices, is at least 0."""
    n, most, _ = polygon.shape
    result, size = np.zeros_like(polygon), np.zeros(n, int)
    rows = np.arange(n)
    for k in range(most):
        here = k < count
        if not here.any():
            break
        following = np.where(k + 1 < count, k + 1, 0)
        h, h_next = height[:, k], height[rows, following]
        inside = here & (h >= 0.0)
        result[rows[inside], size[inside]] = polygon[inside, k]
        size[inside] += 1
        crossed = here & ((h >= 0.0) != (h_next >= 0.0))
        t = (h[crossed] / (h[crossed] - h_next[crossed]))[:, None]
        result[rows[crossed], size[crossed]] = (1.0 - t) * polygon[crossed, k] + t * polygon[rows, following][crossed]
        size[crossed] += 1
    return result, size
