"""UsdGeom's analytic solids as triangles that carry their analytic surface. Plain NumPy, knows no USD.

Every vertex lies on the surface (to float32), normals are the surface's own, and each smooth piece is a
`Patch` with its `Shape`. Solids are built about +Z and turned to their axis at the end.
"""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from warp_reflect.scene import MeshData, Part, Patch, Shape

SEGMENTS = 64  # around the axis at complexity low; a sphere has half as many bands from pole to pole
ROWS_MAX = 64  # along the axis of a cylinder or cone at complexity low; rows are as high as segments are wide

# Cyclic permutations (det +1): object axes of the builder's x, y, z.
AXIS_ORDER = {"X": (2, 0, 1), "Y": (1, 2, 0), "Z": (0, 1, 2)}


def sphere(radius: float, level: int = 0) -> MeshData:
    """A sphere about the origin: 64 x 32 faces, twice as many each way per level; one quadric patch."""
    segments, bands = SEGMENTS << level, (SEGMENTS // 2) << level
    latitude = np.pi * (np.arange(1, bands) / bands - 0.5)
    normals = np.concatenate([[[0.0, 0.0, -1.0]], _rings(np.cos(latitude), np.sin(latitude), segments), [[0, 0, 1.0]]])
    triangles = [_pole(0, 1, segments, flip=True)]
    triangles += [_band(1 + k * segments, segments) for k in range(bands - 2)]
    triangles.append(_pole(len(normals) - 1, 1 + (bands - 2) * segments, segments))
    shape = Shape("quadric", _unit(radius), a=1.0, b=0.0, c=1.0)
    triangles = np.concatenate(triangles)
    return _mesh(radius * normals, [(triangles, normals, triangles, shape)])


def cube(size: float, level: int = 0) -> MeshData:
    """A cube about the origin: six plane patches of two triangles, in the order -x +x -y +y -z +z."""
    half = 0.5 * size
    points = half * np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float64)
    quads = ((0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6))
    pieces = []
    for quad in quads:
        a, b, c, d = quad
        normal = points[list(quad)].mean(axis=0) / half
        pieces.append((np.array([[a, b, c], [a, c, d]]), normal[None], np.zeros((2, 3), int), _plane(normal, half)))
    return _mesh(points, pieces)


def plane(width: float, length: float, axis: str, level: int = 0) -> MeshData:
    """A UsdGeomPlane: width along x (z for axis X), length along y (z for axis Y), facing +axis."""
    u, v = {"X": (2, 1), "Y": (0, 2), "Z": (0, 1)}[axis]
    points = np.zeros((4, 3))
    points[:, u] = 0.5 * width * np.array([-1, 1, 1, -1])
    points[:, v] = 0.5 * length * np.array([-1, -1, 1, 1])
    normal = np.eye(3)["XYZ".index(axis)]
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    if np.cross(points[1] - points[0], points[2] - points[1]) @ normal < 0.0:
        triangles = triangles[:, [0, 2, 1]]
    return _mesh(points, [(triangles, normal[None], np.zeros((2, 3), int), _plane(normal, 0.0))])


def cylinder(radius_bottom: float, radius_top: float, height: float, axis: str, level: int = 0) -> MeshData:
    """A capped cylinder or, where the radii differ, frustum; caps only where a radius is not 0."""
    half = 0.5 * height
    side = _side_rings(radius_bottom, radius_top, -half, half, SEGMENTS << level, level)
    points, pieces = side.points, [side.piece]
    if radius_bottom > 0.0:
        pieces.append(_cap(side.bottom, [0.0, 0.0, -1.0], half))
    if radius_top > 0.0:
        pieces.append(_cap(side.top, [0.0, 0.0, 1.0], half))
    return _turn(_mesh(points, pieces), axis)


def cone(radius: float, height: float, axis: str, level: int = 0) -> MeshData:
    """A cone with its apex at +axis height / 2 and a capped base."""
    return cylinder(radius, 0.0, height, axis, level)


def capsule(radius_bottom: float, radius_top: float, height: float, axis: str, level: int = 0) -> MeshData:
    """A cylinder (frustum where the radii differ) of `height` closed by two hemispheres."""
    segments, bands, half = SEGMENTS << level, (SEGMENTS // 4) << level, 0.5 * height
    if height > 0.0:
        side = _side_rings(radius_bottom, radius_top, -half, half, segments, level)
        points, pieces, bottom, top = [side.points], [side.piece], side.bottom, side.top
    else:
        points, pieces = [_rings([radius_top], [0.0], segments)], []
        bottom = top = np.arange(segments)
    for sign, radius, ring in ((1.0, radius_top, top), (-1.0, radius_bottom, bottom)):
        if radius == 0.0:
            continue
        latitude = 0.5 * np.pi * np.arange(1, bands) / bands
        first = sum(map(len, points))
        rim = _rings(np.ones(1), np.zeros(1), segments)
        cap = np.concatenate([_rings(np.cos(latitude), sign * np.sin(latitude), segments), [[0.0, 0.0, sign]]])
        points.append(radius * cap + [0.0, 0.0, sign * half])
        # Vertices of the cap counted from its rim: the rim is the side's, the rest its own.
        local = np.arange(bands * segments).reshape(bands, segments)
        triangles = [_between(a, b, flip=sign < 0.0) for a, b in itertools.pairwise(local)]
        triangles.append(_pole(bands * segments, local[-1, 0], segments, flip=sign < 0.0))
        triangles = np.concatenate(triangles)
        vertex = np.concatenate([ring, first + np.arange(len(cap))])
        z_range = (0.0, np.inf) if sign > 0.0 else (-np.inf, 0.0)
        shape = Shape("quadric", _unit(radius, sign * half), 1.0, 0.0, 1.0, *z_range)
        pieces.append((vertex[triangles], np.concatenate([rim, cap]), triangles, shape))
    return _turn(_mesh(np.concatenate(points), pieces), axis)


@dataclasses.dataclass(frozen=True)
class _Side:
    """The side of a cylinder or frustum: points, piece for `_mesh`, vertices of its end rings."""

    points: np.ndarray
    piece: tuple
    bottom: np.ndarray
    top: np.ndarray


def _side_rings(r0: float, r1: float, z0: float, z1: float, segments: int, level: int) -> _Side:
    height, slope = z1 - z0, r0 - r1
    slant = np.hypot(height, slope)
    width = 2.0 * np.pi * max(r0, r1) / segments
    rows = int(np.clip(np.ceil(slant / width), 1, ROWS_MAX << level))
    t = np.linspace(0.0, 1.0, rows + 1)
    points = _rings((1.0 - t) * r0 + t * r1, (1.0 - t) * z0 + t * z1, segments)
    around = _rings(np.full(1, height / slant), np.full(1, slope / slant), segments)
    triangles = np.concatenate([_band(k * segments, segments) for k in range(rows)])
    normal_index = triangles % segments
    ring = np.arange(segments)
    bottom, top = ring, rows * segments + ring
    if r0 == 0.0 or r1 == 0.0:
        # One apex vertex, shared by all triangles of its fan, with a normal of its own in each: the one
        # between.
        between = _rings(np.full(1, height / slant), np.full(1, slope / slant), segments, shift=0.5)
        around = np.concatenate([around, between])
        fan = slice(-2 * segments, None, 2) if r1 == 0.0 else slice(1, 2 * segments, 2)
        kept = np.ones(len(triangles), bool)
        apex = top if r1 == 0.0 else bottom
        rest = slice(-2 * segments, None) if r1 == 0.0 else slice(0, 2 * segments)
        kept[rest] = False
        kept[fan] = True
        at_apex = np.isin(triangles, apex)
        # The fan triangle between segments i and i + 1 sees the apex along i + 1/2.
        order = np.zeros(len(triangles), np.int64)
        order[fan] = segments + ring
        normal_index = np.where(at_apex, order[:, None], normal_index)[kept]
        triangles = np.where(at_apex, apex[0], triangles)[kept]
        if r1 == 0.0:
            points, top = points[: -segments + 1], top[:1]
        else:
            points, triangles = points[segments - 1 :], np.maximum(triangles - (segments - 1), 0)
            bottom, top = bottom[:1], top - (segments - 1)
    if r0 == r1:
        unit = _unit(r0)
        shape = Shape("quadric", unit, a=0.0, b=0.0, c=1.0, z_min=z0 / r0, z_max=z1 / r0)
    else:
        # x^2 + y^2 - z^2 = 0 with the apex at the origin and the wider rim, of radius 1, at z = -1 or 1.
        apex = z0 + height * r0 / slope
        wide = max(r0, r1)
        unit = np.diag([1.0 / wide, 1.0 / wide, abs(slope) / (wide * height), 1.0])
        unit[2, 3] = -unit[2, 2] * apex
        low, high = (float(unit[2, 2] * (z - apex)) for z in (z0, z1))
        shape = Shape("quadric", unit, a=-1.0, b=0.0, c=0.0, z_min=low, z_max=high)
    return _Side(points, (triangles, around, normal_index, shape), bottom, top)


def _rings(radii: np.ndarray, heights: np.ndarray, segments: int, shift: float = 0.0) -> np.ndarray:
    """Points ring by ring, float64 [len(radii) * segments, 3]; `shift` turns them by a part of a segment."""
    angle = 2.0 * np.pi * (np.arange(segments) + shift) / segments
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.empty((len(radii), segments, 3))
    points[:, :, :2] = np.asarray(radii)[:, None, None] * circle
    points[:, :, 2] = np.asarray(heights)[:, None]
    return points.reshape(-1, 3)


def _band(first: int, segments: int) -> np.ndarray:
    ring = first + np.arange(segments)
    return _between(ring, ring + segments)


def _between(low: np.ndarray, high: np.ndarray, flip: bool = False) -> np.ndarray:
    """Two triangles per segment between a ring and the one above it, outside counter-clockwise."""
    low_next, high_next = np.roll(low, -1), np.roll(high, -1)
    pairs = np.stack([low, low_next, high_next, low, high_next, high], axis=1).reshape(-1, 3)
    return pairs[:, [0, 2, 1]] if flip else pairs


def _pole(tip: int, first: int, segments: int, flip: bool = False) -> np.ndarray:
    """A fan from the ring that starts at vertex `first` to `tip` above it (below it: flip)."""
    ring = first + np.arange(segments)
    fan = np.stack([ring, np.roll(ring, -1), np.full(segments, tip)], axis=1)
    return fan[:, [0, 2, 1]] if flip else fan


def _cap(ring: np.ndarray, normal: list[float], offset: float) -> tuple:
    step = np.arange(1, len(ring) - 1)
    fan = np.stack([np.full(len(step), ring[0]), ring[step], ring[step + 1]], axis=1)
    normal = np.asarray(normal)
    fan = fan if normal[2] > 0.0 else fan[:, [0, 2, 1]]
    return fan, normal[None], np.zeros_like(fan), _plane(normal, offset)


def _unit(radius: float, z: float = 0.0) -> np.ndarray:
    """`unit_from_object` of a uniform scale about (0, 0, z)."""
    unit = np.diag([1.0 / radius] * 3 + [1.0])
    unit[2, 3] = -z / radius
    return unit


def _plane(normal: np.ndarray, offset: float) -> Shape:
    """The plane dot(normal, p) = offset of an axis-parallel unit normal."""
    k = int(np.argmax(np.abs(normal)))
    rows = np.roll(np.eye(3), -(k + 1), axis=0)  # the cyclic permutation with axis k last: det +1
    if normal[k] < 0.0:
        rows = rows[[1, 0, 2]] * np.array([[1.0], [1.0], [-1.0]])
    unit = np.eye(4)
    unit[:3, :3] = rows
    unit[2, 3] = -offset
    return Shape("plane", unit)


def _mesh(points: np.ndarray, pieces: list[tuple]) -> MeshData:
    """One MeshData from pieces (triangles, normals, normal index per corner, shape), one patch each."""
    triangles, normals, index, patches = [], [], [], []
    first_triangle = first_normal = 0
    for piece, piece_normals, corner, shape in pieces:
        triangles.append(piece)
        normals.append(piece_normals)
        index.append(corner + first_normal)
        patches.append(Patch(first_triangle, len(piece), shape))
        first_triangle += len(piece)
        first_normal += len(piece_normals)
    return MeshData(
        points=points.astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.int32),
        normals=np.concatenate(normals).astype(np.float32),
        normal_index=np.concatenate(index).astype(np.int32),
        parts=[Part(0, first_triangle, patches=tuple(patches))],
    )


def _turn(mesh: MeshData, axis: str) -> MeshData:
    """The mesh with its Z axis turned to `axis`."""
    if axis == "Z":
        return mesh
    order = list(AXIS_ORDER[axis])  # object = built[order]
    z_from_object = np.eye(4)
    z_from_object[:3, :3] = 0.0
    z_from_object[order, [0, 1, 2]] = 1.0
    patches = tuple(
        dataclasses.replace(
            patch,
            shape=dataclasses.replace(patch.shape, unit_from_object=patch.shape.unit_from_object @ z_from_object),
        )
        for patch in mesh.parts[0].patches
    )
    mesh.points = np.ascontiguousarray(mesh.points[:, order])
    mesh.normals = np.ascontiguousarray(mesh.normals[:, order])
    mesh.parts = [dataclasses.replace(mesh.parts[0], patches=patches)]
    return mesh
