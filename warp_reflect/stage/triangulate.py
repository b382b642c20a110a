"""Polygons to triangles: any number of corners, convex or not, planar or not. Plain NumPy, knows no USD.

Triangles name *corners* (positions in the flat list of face corners), so that every interpolation of a corner
attribute can follow them.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque

import numpy as np

# Sine below which a turn counts as straight: a float32 coordinate carries 6e-8, a corner is made of six of
# them.
STRAIGHT_SINE = 1.0e-6
# Corners that are tested faster one by one than by a call of NumPy.
SCALAR_MAX = 12
BLOCK = 1 << 14  # faces cut at a time: their float64 intermediates stay in the cache


def triangulate(
    counts: np.ndarray, indices: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut faces into triangles with the faces' own winding.

    Triangles, quads and convex faces are fans, cut without a loop over faces; of a quad the diagonal 0-2 is
    taken unless it lies outside the face. Everything else is ear-clipped in the plane of the face's Newell
    normal; a face that crosses itself still gives count - 2 triangles, whose signed areas sum to the face's.

    Args:
        counts: Corners of each face, all >= 3, int [face_count].
        indices: Point of each corner, face after face, int [sum(counts)].
        points: float [point_count, 3].

    Returns:
        (corners int32 [triangle_count, 3] into `indices`, face int32 [triangle_count], crossing int [n]: the
        faces whose outline crosses itself or has no area in its own plane). Triangles are in face order.
    """
    counts = np.asarray(counts)
    if (counts == 3).all():
        corners = np.arange(3 * len(counts), dtype=np.int32).reshape(-1, 3)
        return corners, np.arange(len(counts), dtype=np.int32), np.zeros(0, np.int64)
    starts = (np.cumsum(counts) - counts).astype(np.int32)
    corner_sets, face_sets, crossing = [], [], []
    for size in np.flatnonzero(np.bincount(counts)).tolist():
        of_size = np.flatnonzero(counts == size).astype(np.int32)
        for first in range(0, len(of_size), BLOCK):
            faces = of_size[first : first + BLOCK]
            corners = starts[faces][:, None] + np.arange(size, dtype=np.int32)
            if size == 3:
                corner_sets.append(corners)
                face_sets.append(faces)
            else:
                cut_corners, cut_faces, crossed = _cut(faces, corners, points[indices[corners]].astype(np.float64))
                corner_sets += cut_corners
                face_sets += cut_faces
                crossing += crossed
    if not corner_sets:
        return np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros(0, np.int64)
    face, corners = np.concatenate(face_sets), np.concatenate(corner_sets)
    if (face[1:] < face[:-1]).any():
        order = np.argsort(face, kind="stable")
        face, corners = face[order], corners[order]
    return corners, face, np.sort(np.asarray(crossing, np.int64))


def _cut(faces: np.ndarray, corners: np.ndarray, outline: np.ndarray) -> tuple[list, list, list]:
    """Faces of one size > 3, outlines [n, size, 3]: arrays of corners, of the face of each, faces that cross."""
    size = corners.shape[1]
    fan = _fan(size)
    good = _fan_is_inside(outline, fan)
    if good.all():
        return [corners[:, fan].reshape(-1, 3)], [np.repeat(faces, size - 2)], []
    corner_sets, face_sets, crossing = [], [], []
    if size == 4:
        other = np.array([[0, 1, 3], [1, 2, 3]])
        turned = ~good & _fan_is_inside(outline, other)
        corner_sets.append(corners[turned][:, other].reshape(-1, 3))
        face_sets.append(np.repeat(faces[turned], 2))
        # A quad without an inside diagonal is degenerate or a bow tie: both diagonals are equally wrong.
        crossing.extend(faces[~good & ~turned])
        good = ~turned
    corner_sets.append(corners[good][:, fan].reshape(-1, 3))
    face_sets.append(np.repeat(faces[good], size - 2))
    for row in np.flatnonzero(~good) if size > 4 else ():
        local, clean = clip_ears(_flatten(outline[row]))
        corner_sets.append(corners[row][local])
        face_sets.append(np.full(len(local), faces[row]))
        if not clean:
            crossing.append(faces[row])
    return corner_sets, face_sets, crossing


def newell_normals(outline: np.ndarray) -> np.ndarray:
    """Area vectors of closed polygons (length = 2 x area), float64 [..., size, 3] -> [..., 3].

    Source: M. E. Newell's method as given in Sutherland, Sproull, Schumacker, A Characterization of Ten
    Hidden-Surface Algorithms, 1974; taken relative to the first corner so that no digits are lost far from
    the origin.
    """
    local = outline - outline[..., :1, :]
    return np.cross(local, np.roll(local, -1, axis=-2)).sum(axis=-2)


def _fan(size: int) -> np.ndarray:
    step = np.arange(1, size - 1)
    return np.stack([np.zeros_like(step), step, step + 1], axis=1)


def _fan_is_inside(outline: np.ndarray, fan: np.ndarray) -> np.ndarray:
    """Whether the triangles `fan` [m, 3] tile each outline [n, size, 3] without a flip; bool [n]."""
    normal = newell_normals(outline)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = normal / np.where(length > 0.0, length, 1.0)
    good = length[:, 0] > 0.0
    # Every triangle of the fan must keep the face's side; a turn at a corner may be straight but not inward.
    good &= (_sine(outline[:, fan], normal) > -STRAIGHT_SINE).all(axis=1)
    if outline.shape[1] > 4:
        around = np.stack([np.roll(outline, 1, axis=1), outline, np.roll(outline, -1, axis=1)], axis=2)
        good &= (_sine(around, normal) > -STRAIGHT_SINE).all(axis=1)
    return good


def _sine(triangles: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Signed sine of the turn a-b-c about `normal`; triangles [n, m, 3, 3], normal [n, 3] -> [n, m]."""
    first = triangles[:, :, 1] - triangles[:, :, 0]
    second = triangles[:, :, 2] - triangles[:, :, 1]
    scale = np.linalg.norm(first, axis=2) * np.linalg.norm(second, axis=2)
    return np.einsum("nmk,nk->nm", np.cross(first, second), normal) / np.where(scale > 0.0, scale, 1.0)


def _flatten(outline: np.ndarray) -> np.ndarray:
    """Project a polygon [size, 3] along its Newell normal, counter-clockwise, of size 1."""
    local = outline - outline.mean(axis=0)
    scale = np.abs(local).max()
    if scale == 0.0:
        return np.zeros((len(outline), 2))
    local = local / scale
    normal = newell_normals(local)
    if not normal.any():
        # No area seen along any axis (a bow tie): the plane of largest spread.
        normal = np.linalg.svd(local, full_matrices=False)[2][2]
    normal = normal / np.linalg.norm(normal)
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(axis, normal)
    u /= np.linalg.norm(u)
    return np.stack([local @ u, local @ np.cross(normal, u)], axis=1)


def clip_ears(outline: np.ndarray) -> tuple[np.ndarray, bool]:
    """Ear-clip one counter-clockwise polygon.

    Only reflex corners can lie in an ear; they are kept sorted, so that an ear is tested against its
    neighbourhood, and a blocked ear is tested again only once the corner that blocks it is gone. Where no
    ear is left (the outline crosses itself) the corner with the largest turn is cut.

    Args:
        outline: float64 [size, 2].

    Returns:
        (corners int64 [size - 2, 3], clean): clean is False where a corner had to be cut that was no ear.

    Source: G. H. Meisters, Polygons have ears, 1975; D. Eberly, Triangulation by Ear Clipping (reflex list).
    """
    size = len(outline)
    x, y = outline[:, 0].tolist(), outline[:, 1].tolist()
    before = [size - 1, *range(size - 1)]
    after = [*range(1, size), 0]

    def turn(a: int, b: int, c: int) -> float:
        return (x[b] - x[a]) * (y[c] - y[b]) - (y[b] - y[a]) * (x[c] - x[b])

    reflex = np.array([turn(before[i], i, after[i]) <= 0.0 for i in range(size)])
    search = _BoxSearch(outline, reflex)

    def blocker(a: int, b: int, c: int) -> int:
        """A reflex corner inside triangle a, b, c; -1 if there is none."""
        corners = ((x[a], y[a]), (x[b], y[b]), (x[c], y[c]))
        near = search.near(a, b, c)
        if len(near) > SCALAR_MAX:
            return _first_inside(outline[[a, b, c]], outline, near)
        for k in near.tolist():
            # The two sides of a bridge to a hole touch; they do not cross.
            if (x[k], y[k]) not in corners and turn(a, b, k) >= 0.0 and turn(b, c, k) >= 0.0 and turn(c, a, k) >= 0.0:
                return k
        return -1

    triangles, clean = [], True
    alive = [True] * size
    waiting: dict[int, list[int]] = {}  # reflex corner -> tips whose ear it blocks: tested again only once it goes
    queue, straight = deque(range(size)), deque()
    left, last = size, 0
    while left > 3:
        if queue or straight:
            # Straight corners wait: cut early they join edges into long ones, whose ears span the whole face.
            first_choice = bool(queue)
            cut = (queue if first_choice else straight).popleft()
            if not alive[cut]:
                continue
            a, c = before[cut], after[cut]
            bend = turn(a, cut, c)
            if bend == 0.0 and first_choice:
                straight.append(cut)
                continue
            if bend < 0.0 or (bend == 0.0 and not _folds_flat(x, y, a, cut, c)):
                continue
            blocked = blocker(a, cut, c) if bend > 0.0 else -1
            if blocked >= 0:
                waiting.setdefault(blocked, []).append(cut)
                continue
        else:
            cut, clean = _largest_turn(last, left, after, before, turn), False
            a, c = before[cut], after[cut]
        triangles.append((a, cut, c))
        after[a], before[c] = c, a
        alive[cut] = False
        left -= 1
        last = a
        for k in (cut, a, c):
            still = alive[k] and turn(before[k], k, after[k]) <= 0.0
            if reflex[k] and not still:
                reflex[k] = False
                search.removed()
                queue.extend(waiting.pop(k, ()))
        queue.extend((a, c))
    triangles.append((before[last], last, after[last]))
    clean = clean and turn(before[last], last, after[last]) >= 0.0
    return np.asarray(triangles), clean


class _BoxSearch:
    """The reflex corners in a triangle's box: the shorter of its two slabs in sorted x and sorted y."""

    def __init__(self, outline: np.ndarray, reflex: np.ndarray):
        self.outline, self.reflex = outline, reflex
        self._sort()

    def _sort(self) -> None:
        kept = np.flatnonzero(self.reflex)
        self.orders = [kept[np.argsort(self.outline[kept, k], kind="stable")] for k in (0, 1)]
        self.keys = [self.outline[order, k] for k, order in enumerate(self.orders)]
        self.sorted_keys = [key.tolist() for key in self.keys]
        self.stale = 0

    def removed(self) -> None:
        """A corner is no longer reflex; the tables are rebuilt once half of them is."""
        self.stale += 1
        if 2 * self.stale > len(self.orders[0]):
            self._sort()

    def near(self, a: int, b: int, c: int) -> np.ndarray:
        corners = self.outline[[a, b, c]]
        low, high = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
        slabs = [(bisect_left(self.sorted_keys[k], low[k]), bisect_right(self.sorted_keys[k], high[k])) for k in (0, 1)]
        k = 0 if slabs[0][1] - slabs[0][0] <= slabs[1][1] - slabs[1][0] else 1
        slab = self.orders[k][slice(*slabs[k])]
        other = self.outline[slab, 1 - k]
        return slab[self.reflex[slab] & (other >= low[1 - k]) & (other <= high[1 - k])]


def _first_inside(corners: np.ndarray, outline: np.ndarray, near: np.ndarray) -> int:
    p = outline[near]
    good = np.ones(len(near), bool)
    for k in range(3):
        edge, offset = corners[(k + 1) % 3] - corners[k], p - corners[(k + 1) % 3]
        good &= edge[0] * offset[:, 1] - edge[1] * offset[:, 0] >= 0.0
        good &= (p != corners[k]).any(axis=1)
    return int(near[np.argmax(good)]) if good.any() else -1


def _folds_flat(x: list, y: list, a: int, b: int, c: int) -> bool:
    """Whether b lies on the segment a-c (rather than being the tip of a spike of width 0)."""
    return (x[a] - x[b]) * (x[c] - x[b]) + (y[a] - y[b]) * (y[c] - y[b]) <= 0.0


def _largest_turn(tip: int, left: int, after: list, before: list, turn) -> int:
    best, best_turn = tip, -np.inf
    for _ in range(left):
        bend = turn(before[tip], tip, after[tip])
        if bend > best_turn:
            best, best_turn = tip, bend
        tip = after[tip]
    return best
