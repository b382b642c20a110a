"""Polygon surfaces as plain arrays, outside counter-clockwise: what the scenes' meshes are made of.

Lengths are metres. A `Detail` says how finely; every count of segments goes through it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Detail:
    """How finely a build tessellates: segments along each direction are multiplied by `scale`."""

    scale: float = 1.0

    def count(self, n: int) -> int:
        return max(1, round(n * self.scale))


@dataclass(frozen=True)
class Surface:
    """A polygon mesh: points [n, 3], vertices per face [f], indices, unit normals [n, 3] or None (flat).

    `color_index` [f] into `palette` gives every face a displayColor; None: one material for all. `scheme` is
    UsdGeomMesh's subdivisionScheme: with "catmullClark" the polygons are a control cage, without normals.
    """

    points: np.ndarray
    counts: np.ndarray
    indices: np.ndarray
    normals: np.ndarray | None = None
    palette: tuple[tuple[float, float, float], ...] = ()
    color_index: np.ndarray | None = None
    scheme: str = "none"

    @property
    def triangle_count(self) -> int:
        return int((self.counts - 2).sum())

    def moved(self, translate=(0, 0, 0), rotate=(0, 0, 0), scale=(1, 1, 1)) -> Surface:
        """Scaled, turned about x, then y, then z [degrees], then moved."""
        turn = rotation(rotate)
        stretch = np.broadcast_to(np.asarray(scale, float), 3)
        normals = self.normals
        if normals is not None:
            normals = unit((normals / stretch) @ turn.T)
        return replace(self, points=(self.points * stretch) @ turn.T + np.asarray(translate, float), normals=normals)

    def painted(self, palette, color_index) -> Surface:
        return replace(self, palette=tuple(palette), color_index=np.asarray(color_index, int))


def rotation(degrees) -> np.ndarray:
    result = np.eye(3)
    for axis, angle in enumerate(degrees):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
        result = turn @ result
    return result


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _faces(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(counts, indices) of the cells of a net of point numbers [r, c]; repeated corners (poles) collapse."""
    quads = np.stack([ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]], axis=-1).reshape(-1, 4)
    repeated = quads == np.roll(quads, -1, axis=1)
    return 4 - repeated.sum(axis=1), quads[~repeated]


def merge(*surfaces: Surface) -> Surface:
    """One surface of several; smooth only if all are, painted only if all share a palette."""
    first = np.cumsum([0] + [len(s.points) for s in surfaces])
    smooth = all(s.normals is not None for s in surfaces)
    painted = all(s.color_index is not None and s.palette == surfaces[0].palette for s in surfaces)
    return Surface(
        np.concatenate([s.points for s in surfaces]),
        np.concatenate([s.counts for s in surfaces]),
        np.concatenate([s.indices + k for s, k in zip(surfaces, first, strict=False)]),
        np.concatenate([s.normals for s in surfaces]) if smooth else None,
        surfaces[0].palette if painted else (),
        np.concatenate([s.color_index for s in surfaces]) if painted else None,
    )


def weld(surface: Surface) -> Surface:
    """A flat surface with points that coincide (to a micrometre) made one."""
    _, first, number = np.unique(np.round(surface.points, 6), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)  # keeps the points in the order of their first use
    place = np.empty(len(order), int)
    place[order] = np.arange(len(order))
    return replace(surface, points=surface.points[first[order]], indices=place[number.reshape(-1)[surface.indices]])


def smooth(surface: Surface) -> Surface:
    """With area-weighted vertex normals."""
    p = surface.points
    last = np.cumsum(surface.counts)
    normals = np.zeros_like(p)
    for count in np.unique(surface.counts):
        rows = np.nonzero(surface.counts == count)[0]
        corners = surface.indices[(last[rows] - count)[:, None] + np.arange(count)]
        # Newell's sum gives a polygon's area vector whatever its corner count.
        area = sum(np.cross(p[corners[:, k]], p[corners[:, (k + 1) % count]]) for k in range(count))
        for k in range(count):
            for axis in range(3):
                normals[:, axis] += np.bincount(corners[:, k], area[:, axis], len(p))
    return replace(surface, normals=unit(normals))


def patch(rows: np.ndarray, wrap_rows: bool = False, wrap_columns: bool = False) -> Surface:
    """A net of points [r, c, 3]; outside is (along rows) x (along columns)."""
    r, c = rows.shape[:2]
    ids = np.arange(r * c).reshape(r, c)
    ids = np.concatenate([ids, ids[:1]]) if wrap_rows else ids
    ids = np.concatenate([ids, ids[:, :1]], axis=1) if wrap_columns else ids
    return Surface(rows.reshape(-1, 3), *_faces(ids))


def revolve(radius, height, segments: int, normals=None) -> Surface:
    """A profile (radius, height) turned about +Y, from its lower outside on; radius 0 at an end is a pole.

    Faces run around, span by span: face k lies in span k // segments and sector k % segments. `normals`: the
    (radial, vertical) parts of the profile's unit normals [n, 2]; None: from the facets.
    """
    radius, height = np.asarray(radius, float), np.asarray(height, float)
    angle = np.arange(segments) * (2.0 * math.pi / segments)
    around = np.stack([np.cos(angle), np.zeros(segments), np.sin(angle)], axis=-1)
    up = np.array([0.0, 1.0, 0.0])
    net = radius[:, None, None] * around + height[:, None, None] * up
    ids = np.arange(len(radius) * segments).reshape(len(radius), segments)
    ids[radius == 0.0] = ids[radius == 0.0][:, :1]
    ids = np.concatenate([ids, ids[:, :1]], axis=1)
    counts, indices = _faces(ids)
    used, indices = np.unique(indices, return_inverse=True)
    result = Surface(net.reshape(-1, 3)[used], counts, indices.reshape(-1))
    if normals is None:
        return smooth(result)
    n = np.asarray(normals, float)
    turned_normals = n[:, 0, None, None] * around + n[:, 1, None, None] * up
    return replace(result, normals=unit(turned_normals.reshape(-1, 3)[used]))


def lathe(profile, detail: Detail, segments: int) -> Surface:
    """A smooth solid of revolution through profile points (r, y), refined along a Catmull-Rom spline."""
    p = np.asarray(profile, float)
    q = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = (np.arange(detail.count(1)) / detail.count(1))[:, None]
    a, b, c, d = (q[k : k + len(p) - 1, None] for k in range(4))
    curve = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    curve = np.concatenate([curve.reshape(-1, 2), p[-1:]])
    curve[:, 0] = np.maximum(curve[:, 0], 0.0)
    return revolve(curve[:, 0], curve[:, 1], detail.count(segments))


def turned(profile, detail: Detail, segments: int, palette=(), spans=()) -> Surface:
    """A solid of revolution with straight spans between profile points (r, y).

    `spans`: number of each span's colour in the palette; empty: unpainted.
    """
    p = np.asarray(profile, float)
    pieces = detail.count(1)
    t = np.linspace(0, len(p) - 1, (len(p) - 1) * pieces + 1)
    around = detail.count(segments)
    surface = revolve(np.interp(t, np.arange(len(p)), p[:, 0]), np.interp(t, np.arange(len(p)), p[:, 1]), around)
    return surface.painted(palette, np.repeat(spans, pieces * around)) if len(spans) else surface


def ball(radius: float, detail: Detail, segments: int, rings: int) -> Surface:
    latitude = np.linspace(-math.pi / 2, math.pi / 2, detail.count(rings) + 1)
    r, y = np.cos(latitude), np.sin(latitude)
    r[0] = r[-1] = 0.0
    return revolve(radius * r, radius * y, detail.count(segments), np.stack([r, y], 1))


def torus(ring: float, bead: float, detail: Detail, segments: int, sides: int, turn: float = 360.0) -> Surface:
    """A torus about +Y; `turn` below 360 [degrees] leaves an open arc without caps."""
    whole = turn >= 360.0
    n, m = detail.count(segments), detail.count(sides)
    u = np.radians(turn) * np.arange(n if whole else n + 1) / n
    v = -2.0 * math.pi * np.arange(m) / m
    outward = np.stack([np.cos(u), np.zeros_like(u), np.sin(u)], -1)[:, None]
    normal = outward * np.cos(v)[None, :, None] + np.array([0, 1.0, 0]) * np.sin(v)[None, :, None]
    net = patch(ring * outward + bead * normal, wrap_rows=whole, wrap_columns=True)
    return replace(net, normals=normal.reshape(-1, 3))


def sweep(path, radii, detail: Detail, sides: int) -> Surface:
    """A closed tube along path points [n, 3] with a radius at each; its caps meet in the path's ends."""
    path, radii = np.asarray(path, float), np.asarray(radii, float)
    tangent = unit(np.gradient(path, axis=0))
    side = np.cross(tangent[0], [0.3, 0.9, 0.27])
    m = detail.count(sides)
    v = 2.0 * math.pi * np.arange(m)[:, None] / m
    net = np.empty((len(path), m, 3))
    for k, (p, t, r) in enumerate(zip(path, tangent, radii, strict=True)):
        side = unit(side - t * (side @ t))
        net[k] = p + r * (np.cos(v) * side - np.sin(v) * np.cross(t, side))
    ids = np.arange(len(path) * m).reshape(len(path), m) + 2
    ids = np.concatenate([np.zeros((1, m), int), ids, np.ones((1, m), int)])
    ids = np.concatenate([ids, ids[:, :1]], axis=1)
    return smooth(Surface(np.concatenate([path[:1], path[-1:], net.reshape(-1, 3)]), *_faces(ids)))


def sheet(origin, across, along, columns: int, rows: int) -> Surface:
    """A flat grid of columns x rows cells from a corner; it faces across x along."""
    u = np.linspace(0, 1, columns + 1)[:, None, None] * np.asarray(across, float)
    v = np.linspace(0, 1, rows + 1)[None, :, None] * np.asarray(along, float)
    return patch(np.asarray(origin, float) + u + v)


def block(size, detail: Detail, bevel: float = 0.0, cell: float = 0.0) -> Surface:
    """A box about its bottom's middle: edges cut off by `bevel`, faces in cells of about `cell` (0: one)."""
    half = 0.5 * np.asarray(size, float)
    inner = half - bevel
    parts = []
    for axis in range(3):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            origin, u, v = -inner.copy(), np.zeros(3), np.zeros(3)
            origin[axis] = sign * half[axis]
            u[i], v[j] = 2 * inner[i], 2 * inner[j]
            nu = detail.count(max(1, round(u[i] / cell))) if cell else detail.count(1)
            nv = detail.count(max(1, round(v[j] / cell))) if cell else detail.count(1)
            parts.append(sheet(origin, u, v, nu, nv) if sign > 0 else sheet(origin, v, u, nv, nu))
    if bevel:
        parts.append(_bevels(half, inner))
    return merge(*parts).moved((0, half[1], 0))


def _bevels(half: np.ndarray, inner: np.ndarray) -> Surface:
    """The 12 edge strips and 8 corner triangles of a box with cut edges."""
    faces = []
    for i, j in ((0, 1), (1, 2), (2, 0)):
        k = 3 - i - j
        for si in (-1, 1):
            for sj in (-1, 1):
                corners = []
                for on_i, sk in ((True, -1), (True, 1), (False, 1), (False, -1)):
                    p = np.empty(3)
                    p[i] = si * (half[i] if on_i else inner[i])
                    p[j] = sj * (inner[j] if on_i else half[j])
                    p[k] = sk * inner[k]
                    corners.append(p)
                faces.append(np.array(corners))
    for signs in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).T.reshape(-1, 3):
        faces.append(np.array([np.where(np.arange(3) == a, half, inner) * signs for a in range(3)]))
    points, counts, indices = [], [], []
    for face in faces:
        outward = np.cross(face[1] - face[0], face[2] - face[0]) @ face.mean(axis=0) > 0
        indices += list(range(len(points), len(points) + len(face)))
        points += list(face if outward else face[::-1])
        counts.append(len(face))
    return Surface(np.array(points), np.array(counts), np.array(indices))


def tiles(columns: int, rows: int, pitch: float, palette, detail: Detail, pattern=None) -> Surface:
    """Bevelled tiles in the x-y plane from the origin, facing +z, on grout of the palette's last colour.

    `pattern`: colour number of tile (column, row); None: a checker of the first two.
    """
    joint, depth = 0.02 * pitch, 0.05 * pitch
    pattern = pattern or (lambda i, j: (i + j) % 2)
    pieces, colors = [], []
    for i in range(columns):
        for j in range(rows):
            x0, y0 = i * pitch, j * pitch
            low = np.array([[x0 + joint, y0 + joint], [x0 + pitch - joint, y0 + pitch - joint]])
            top = low + np.array([[depth], [-depth]])
            n = detail.count(1)
            face = sheet(
                (top[0, 0], top[0, 1], depth),
                (top[1, 0] - top[0, 0], 0, 0),
                (0, top[1, 1] - top[0, 1], 0),
                n,
                n,
            )
            ring = []
            for box, z in ((low, 0.0), (top, depth)):
                a, b = box
                ring.append([[a[0], a[1], z], [b[0], a[1], z], [b[0], b[1], z], [a[0], b[1], z]])
            rim = patch(np.swapaxes(np.array(ring), 0, 1), wrap_rows=True)
            pieces += [face, rim]
            colors.append(np.full(len(face.counts) + len(rim.counts), pattern(i, j)))
    n = detail.count(1)
    grout = sheet((0, 0, 0.01 * pitch), (columns * pitch, 0, 0), (0, rows * pitch, 0), n * columns, n * rows)
    colors.append(np.full(len(grout.counts), len(palette) - 1))
    return replace(merge(*pieces, grout), palette=tuple(palette), color_index=np.concatenate(colors))


@dataclass(frozen=True)
class Egg:
    """A strictly convex body of revolution given by its support function, so that its normals are exact.

    h(t) = sqrt(equator^2 cos^2 t + pole^2 sin^2 t) + pear sin 3t over latitude t; its meridian is
    (h cos t - h' sin t, h sin t + h' cos t) with normal (cos t, sin t), convex where h + h'' > 0. It
    rests on y = 0.
    """

    equator: float
    pole: float
    pear: float

    def meridian(self, latitude) -> tuple[np.ndarray, np.ndarray]:
        """Points (r, y) and unit normals [n, 2] at latitudes [radians]."""
        t = np.asarray(latitude, float)
        c, s = np.cos(t), np.sin(t)
        root = np.sqrt(self.equator**2 * c**2 + self.pole**2 * s**2)
        h = root + self.pear * np.sin(3 * t)
        slope = (self.pole**2 - self.equator**2) * s * c / root + 3 * self.pear * np.cos(3 * t)
        bottom = -(self.pole + self.pear)
        return np.stack([h * c - slope * s, h * s + slope * c - bottom], -1), np.stack([c, s], -1)

    def surface(self, detail: Detail, segments: int, bands: int) -> Surface:
        points, normals = self.meridian(np.linspace(-math.pi / 2, math.pi / 2, detail.count(bands) + 1))
        points[[0, -1], 0] = normals[[0, -1], 0] = 0.0  # the poles, where rounding leaves 1e-17
        return revolve(points[:, 0], points[:, 1], detail.count(segments), normals)


def dome(radius: float, height: float, detail: Detail, segments: int, bands: int) -> Surface:
    """A closed paraboloid of revolution y = height (1 - r^2 / radius^2) over a flat base in y = 0, normals exact."""
    n = detail.count(bands)
    r = radius * np.linspace(1.0, 0.0, n + 1)
    around = detail.count(segments)
    slope = np.stack([2.0 * height * r / radius**2, np.ones_like(r)], -1)  # the gradient of y + height r^2 / radius^2
    side = revolve(r, height * (1.0 - (r / radius) ** 2), around, slope)
    base = revolve([0.0, radius], [0.0, 0.0], around, [(0.0, -1.0), (0.0, -1.0)])
    return merge(base, side)


def spherical_cap(radius: float, half_angle: float, detail: Detail, segments: int, bands: int) -> Surface:
    """The bottom of a sphere, seen from inside: open, its lowest point at the origin, its axis +Y; normals exact.

    Args:
        radius: Of the sphere; the focus of the mirror is half of it above the origin.
        half_angle: Of the cap, seen from the sphere's centre. [degrees]
    """
    t = np.radians(half_angle) * np.linspace(1.0, 0.0, detail.count(bands) + 1)
    r, y = radius * np.sin(t), radius * (1.0 - np.cos(t))
    return revolve(r, y, detail.count(segments), np.stack([-np.sin(t), np.cos(t)], -1))
