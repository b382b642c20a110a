"""What a triangle mesh is as a body: closed, convex, star-shaped, and its principal frame. Host, float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Of the body's size. A tessellated convex body has facets that stick out over their neighbours by rounding: float32
# points of a unit body carry 6e-8, and facets of 1/100 the body's size lever that up to 1e-5.
CONVEX_TOLERANCE = 2.0e-5
SOLID_ANGLE_TOLERANCE = 1.0e-3  # of 4 pi; a second shell or an opening changes it by far more


@dataclass(frozen=True)
class Body:
    """A mesh as a solid.

    Attributes:
        closed: Every edge joins exactly two facets that run through it in opposite directions.
        star_shaped: Every ray from `centre` meets the surface once.
        convex: Closed, star-shaped, and no facet sticks out over a neighbour's plane.
        centre: Principal frame's origin, float64 [3].
        axes: Rows are the principal axes, right-handed, float64 [3, 3].
        extent: Half extents along the axes from the centre, float64 [3].
        reason: Why no map can hold it; empty if one can.
    """

    closed: bool
    star_shaped: bool
    convex: bool
    centre: np.ndarray
    axes: np.ndarray
    extent: np.ndarray
    reason: str


def weld(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles over the first of all points with bit-equal coordinates, int64 [triangle_count, 3]."""
    rows = np.ascontiguousarray(points, dtype=np.float32) + np.float32(0.0)  # -0 becomes +0
    keys = rows.view(np.dtype((np.void, rows.dtype.itemsize * 3))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)][triangles].astype(np.int64)


def analyse(points: np.ndarray, triangles: np.ndarray) -> Body:
    """Classify a mesh.

    Args:
        points: Float [vertex_count, 3].
        triangles: Int [triangle_count, 3], counter-clockwise seen from outside.
    """
    used = points[np.unique(triangles)].astype(np.float64) if len(triangles) else np.zeros((1, 3))
    centre = 0.5 * (used.min(axis=0) + used.max(axis=0))
    size = float(np.ptp(used, axis=0).max()) or 1.0
    faces = weld(points, triangles)
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    corner = (points.astype(np.float64) - centre)[faces] / size
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(normal, axis=1)
    axes, centre_local, extent = _principal_frame(corner, area)
    corner = corner - centre_local
    centre = centre + size * centre_local
    extent = extent * size
    closed, partner = _closed(faces)
    solid = area > 1.0e-12 * max(float(area.max(initial=0.0)), 1.0e-300)
    unit = normal[solid] / area[solid, None]
    height = np.einsum("ij,ij->i", unit, corner[solid][:, 0])
    turned = bool(len(height)) and np.median(height) < 0.0  # inside-out body
    if turned:
        unit, height = -unit, -height
    full = abs(abs(_solid_angle(corner)) / (4.0 * np.pi) - 1.0) < SOLID_ANGLE_TOLERANCE
    star_shaped = closed and bool(len(height)) and float(height.min()) > 0.0 and full
    convex = star_shaped and _convex(corner, normal, area, partner, -1.0 if turned else 1.0)
    reason = ""
    if not closed:
        reason = "open: not every edge joins two facets"
    elif not star_shaped:
        reason = "not star-shaped: a ray from its centre meets it more than once"
    return Body(closed, star_shaped, convex, centre, axes, extent, reason)


def _principal_frame(corner: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes of inertia of the surface, the middle of the bounds along them, and the half extents."""
    total = max(float(area.sum()), 1.0e-300)
    middle = corner.mean(axis=1)
    mean = (middle * area[:, None]).sum(axis=0) / total
    spread = ((middle - mean) * area[:, None]).T @ (middle - mean) / total
    _, vectors = np.linalg.eigh(spread)
    axes = vectors.T.copy()
    # A nearly isotropic body has arbitrary principal axes: keep the coordinate axes, which gprims are built on.
    if np.ptp(np.linalg.eigvalsh(spread)) < 1.0e-3 * max(float(np.trace(spread)), 1.0e-300):
        axes = np.eye(3)
    if np.linalg.det(axes) < 0.0:
        axes[2] *= -1.0
    along = corner.reshape(-1, 3) @ axes.T if len(corner) else np.zeros((1, 3))
    low, high = along.min(axis=0), along.max(axis=0)
    extent = np.maximum(0.5 * (high - low), 1.0e-6 * max(float(np.ptp(along)), 1.0e-300))
    return axes, 0.5 * (low + high) @ axes, extent


def _closed(faces: np.ndarray) -> tuple[bool, np.ndarray]:
    """Whether every directed edge has exactly one opposite; the half edge opposite to each (face * 3 + corner)."""
    count = len(faces)
    if count == 0:
        return False, np.zeros(0, np.int64)
    start = faces.reshape(-1)
    end = faces[:, [1, 2, 0]].reshape(-1)
    base = int(faces.max()) + 1
    forward, backward = start * base + end, end * base + start
    order = np.argsort(forward, kind="stable")
    place = np.minimum(np.searchsorted(forward[order], backward), len(order) - 1)
    found = forward[order][place] == backward
    unique = len(np.unique(forward)) == len(forward)
    return bool(unique and found.all()), order[place]


def _convex(corner, normal, area, partner, sign) -> bool:
    """No facet's far corner stands above its neighbour's plane by more than the tolerance."""
    opposite = corner[:, [2, 0, 1]].reshape(-1, 3)[partner]  # far corner of the facet across each edge
    own = np.repeat(normal * sign, 3, axis=0)
    height = np.einsum("ij,ij->i", own, opposite - np.repeat(corner[:, 0], 3, axis=0))
    return bool((height <= CONVEX_TOLERANCE * np.maximum(np.repeat(area, 3), 1.0e-300)).all())


def _solid_angle(corner: np.ndarray) -> float:
    """Signed solid angle of the triangles seen from the origin (van Oosterom and Strackee 1983)."""
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    triple = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a))]
    return float(2.0 * np.arctan2(triple, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb).sum())
