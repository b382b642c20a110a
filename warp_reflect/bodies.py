"""What a triangle mesh is as a body: closed, convex, star-shaped, and its principal frame. Host, float64."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Of the body's size. A tessellated convex body has facets that stick out over their neighbours by rounding: float32
# points of a unit body carry 6e-8, and facets of 1/100 the body's size lever that up to 1e-5.
CONVEX_TOLERANCE = 2.0e-5
SIMILARITY_TOLERANCE = (
    1.0e-9  # a rotation authored in float64 is off by 1e-15, in float32 by 1e-7: that one is looked at
)
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

    def placed(self, scene_from_object: np.ndarray) -> Body:
        """The same body placed by a similarity (`is_similarity`), float64 [4, 4]."""
        linear = scene_from_object[:3, :3]
        scale = float(np.cbrt(abs(np.linalg.det(linear))))
        axes = self.axes @ (linear / scale).T
        if np.linalg.det(axes) < 0.0:
            axes[2] *= -1.0
        centre = linear @ self.centre + scene_from_object[:3, 3]
        return replace(self, centre=centre, axes=axes, extent=self.extent * scale)


def is_similarity(matrix: np.ndarray) -> bool:
    """Whether a matrix turns, mirrors, shifts and scales alike in all directions, float64 [4, 4]."""
    gram = matrix[:3, :3].T @ matrix[:3, :3]
    square = float(np.trace(gram)) / 3.0
    return square > 0.0 and bool(np.abs(gram - square * np.eye(3)).max() <= SIMILARITY_TOLERANCE * square)


def weld(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Triangles over the first of all points with bit-equal coordinates, int64 [triangle_count, 3]."""
    rows = np.ascontiguousarray(points, dtype=np.float32) + np.float32(0.0)  # -0 becomes +0
    if not len(rows):
        return np.zeros((len(triangles), 3), np.int64)
    bits = rows.view(np.uint32).astype(np.uint64)
    order = np.lexsort((bits[:, 2], (bits[:, 0] << np.uint64(32)) | bits[:, 1]))
    ordered = bits[order]
    starts = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    # The sort is stable: the first of a run of equals has the lowest number.
    first = np.empty(len(rows), np.int64)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return first[triangles]


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
    middle = np.sort(height)[[(len(height) - 1) // 2, len(height) // 2]] if len(height) else np.zeros(1)
    turned = bool(middle.sum() < 0.0)  # inside-out body; not `np.median`, which imports masked arrays
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


@dataclass(frozen=True)
class Sheet:
    """An open mesh as a part of the surface of a convex body, its *companion*.

    The companion is what lies behind the tangent planes of the sheet's rim and in a superellipsoid around it: it continues
    the sheet without an edge and closes far from it.

    Attributes:
        centre: A point of the companion that sees the whole sheet from behind, float64 [3].
        axes: Rows are the superellipsoid's axes, right-handed, float64 [3, 3].
        extent: Its half extents along the axes about the centre, float64 [3].
        cosine: Least cosine between a facet's normal and the ray from the centre to it: above 0 the sheet is star-shaped.
        overhang: Of the sheet's size: by how much a corner stands out over the plane of a facet; 0 if truly convex.
        inner: The body lies before the sheet's winding side: it is concave seen from its front.
    """

    centre: np.ndarray
    axes: np.ndarray
    extent: np.ndarray
    cosine: float
    overhang: float
    inner: bool

    def placed(self, scale: float, offset: np.ndarray) -> Sheet:
        """The same for the mesh times a scale plus an offset."""
        return replace(self, centre=self.centre * scale + offset, extent=self.extent * scale)


SHEET_SAMPLES = 384  # planes and corners that stand for a sheet's where each meets each
DEPTHS = 25  # places tried for the centre
DEPTH_MAX = 0.6  # of the sheet's size, behind its middle: deeper, the sheet fills too little of its map
EXTENT_MIN = 0.25  # of the largest half extent: a flat sheet's companion is no blade
CLOSING_POWER = 4.0  # of the superellipsoid (|x| / extent)^4 + ... = 1 that closes a companion: round, but roomy
CLOSING_GAUGE = 0.65  # of the superellipsoid: the sheet stays inside by so much


def fit_sheet(corner: np.ndarray, inner: bool) -> Sheet:
    """Frame of a sheet's companion, and how well it fits.

    Args:
        corner: Corners of its triangles, float64 [n, 3, 3], counter-clockwise seen from the front.
        inner: Whether the companion lies in front (the sheet is concave) or behind.
    """
    flat = corner.reshape(-1, 3)
    low, high = flat.min(axis=0), flat.max(axis=0)
    size = float((high - low).max()) or 1.0
    local = (corner - 0.5 * (low + high)) / size
    facet = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0]) * (-1.0 if inner else 1.0)
    area = np.linalg.norm(facet, axis=1)
    solid = area > 1.0e-9 * max(float(area.max(initial=0.0)), 1.0e-300)
    local, facet, area = local[solid], facet[solid], area[solid]
    unit = facet / area[:, None]
    mean = facet.sum(axis=0) / area.sum()
    openness = float(np.linalg.norm(mean))
    axes, middle, _ = _principal_frame(local, area)
    depth = np.linspace(-0.3 * DEPTH_MAX, DEPTH_MAX, DEPTHS) if openness > 1.0e-6 else np.zeros(1)
    places = middle - depth[:, None] * mean / max(openness, 1.0e-12)
    some = local[_spread(len(local), 4 * SHEET_SAMPLES)]
    some_unit = unit[_spread(len(local), 4 * SHEET_SAMPLES)]
    towards = some.mean(axis=1)[None] - places[:, None]
    cosine = np.einsum("pnj,nj->pn", towards, some_unit) / np.maximum(np.linalg.norm(towards, axis=2), 1.0e-12)
    best = int(cosine.min(axis=1).argmax())
    centre = places[best]
    towards = local.mean(axis=1) - centre
    exact = np.einsum("ij,ij->i", towards, unit) / np.maximum(np.linalg.norm(towards, axis=1), 1.0e-12)
    above = overhang(local[_spread(len(local), SHEET_SAMPLES)], inner, local)
    along = np.abs((local.reshape(-1, 3) - centre) @ axes.T)
    extent = along.max(axis=0)
    extent = np.maximum(extent, EXTENT_MIN * extent.max())
    extent *= float((((along / extent) ** CLOSING_POWER).sum(axis=1) ** (1.0 / CLOSING_POWER)).max()) / CLOSING_GAUGE
    result = Sheet(centre, axes, extent, float(exact.min()), float(above.max()), inner)
    return result.placed(size, 0.5 * (low + high))


def overhang(facets: np.ndarray, inner: bool, sheet: np.ndarray | None = None) -> np.ndarray:
    """By how much a sheet stands out over the planes of facets, of its size; float64 [n], at least 0.

    Args:
        facets: Corners, float64 [n, 3, 3].
        inner: The planes' outside is their back.
        sheet: Corners of the triangles that may stand out; None: the facets themselves.
    """
    tips = (facets if sheet is None else sheet).reshape(-1, 3)
    tips = tips[_spread(len(tips), 4 * SHEET_SAMPLES)]
    normal = np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0]) * (-1.0 if inner else 1.0)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-300)
    height = np.empty(len(facets))
    for first in range(0, len(facets), 4096):
        block = slice(first, first + 4096)
        height[block] = (normal[block] @ tips.T).max(axis=1) - np.einsum("ij,ij->i", normal[block], facets[block, 0])
    return np.maximum(height, 0.0) / max(float(np.ptp(tips, axis=0).max()), 1.0e-300)


def _spread(count: int, wanted: int) -> np.ndarray:
    """At most `wanted` of `count` numbers at equal steps."""
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(np.int64))
