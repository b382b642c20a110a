"""The shared objects of the city: houses, trees and cars; after Meyer and Loscos 2003, section 5."""

from __future__ import annotations

import math

import numpy as np
from scene_shapes import Detail, Surface, block, merge, smooth

TREE_TRIANGLES = 59_100  # of one tree, as in the paper
SHRUB_TRIANGLES = 400
HOUSE_LOOKS = (
    ((0.62, 0.5, 0.38), (0.1, 0.13, 0.17)),
    ((0.5, 0.22, 0.16), (0.16, 0.17, 0.16)),
    ((0.72, 0.7, 0.64), (0.12, 0.16, 0.22)),
    ((0.36, 0.4, 0.46), (0.55, 0.52, 0.36)),
)
HOUSE_SIZES = ((26.0, 18.0, 22.0), (22.0, 27.0, 26.0), (30.0, 12.0, 20.0), (24.0, 36.0, 24.0))  # x, y, z [m]
BODY_POWER = 0.72  # of a superellipse's coordinates: 1 is an ellipsoid, less a box with round edges


def _house(kind: int):
    """Four fronts of windows; 64 triangles: 6 faces a front and storey, a roof and a floor of 8 triangles each."""

    def make(d: Detail):
        wall, window = HOUSE_LOOKS[kind]
        x, y, z = HOUSE_SIZES[kind]
        fronts = []
        for turn, width, depth in ((0, x, z), (90, z, x), (180, x, z), (270, z, x)):
            fronts.append(_front(width, y).moved((0, 0, depth / 2)).moved(rotate=(0, turn, 0)))
        skin = merge(*fronts)
        panes = np.tile([0, 1, 0, 1, 0, 1], len(skin.counts) // 6)
        return [("Fronts", skin.painted((wall, window), panes), None), ("Roof", _lid(x, y, z), "Ceiling")]

    return make


def _front(width: float, high: float) -> Surface:
    """Three bands of wall and three of windows, upwards, in the plane z = 0 facing +z."""
    edges = np.array([0.0, 0.08, 0.3, 0.38, 0.6, 0.68, 0.92]) * high / 0.92
    points, counts, indices = [], [], []
    for k in range(6):
        first = len(points)
        for y in (edges[k], edges[k + 1]):
            points += [(-width / 2, y, 0.0), (width / 2, y, 0.0)]
        counts.append(4)
        indices += [first, first + 1, first + 3, first + 2]
    return Surface(np.array(points), np.array(counts), np.array(indices))


def _lid(x: float, y: float, z: float) -> Surface:
    return block((x + 0.6, 0.6, z + 0.6), Detail()).moved((0, y, 0))


def _crown(triangles: int, radius: float, high: float, seed: int) -> Surface:
    """Leaves of two triangles each, scattered in an egg-shaped crown and turned every way."""
    rng = np.random.default_rng(seed)
    count = triangles // 2
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    middle = way * rng.random((count, 1)) ** 0.33 * (radius, 0.5 * high, radius)
    middle[:, 1] += 0.65 * high
    size = 0.42 * radius * (600.0 / max(triangles, 600)) ** 0.38
    across = rng.normal(size=(count, 3))
    across -= way * np.einsum("ij,ij->i", across, way)[:, None]
    across *= 0.5 * size / np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(way, across)
    corners = np.stack([middle - across, middle + 0.6 * along, middle + across, middle - 0.6 * along], 1).reshape(-1, 3)
    shades = ((0.08, 0.25, 0.05), (0.12, 0.32, 0.07), (0.05, 0.18, 0.04))
    surface = Surface(corners, np.full(count, 4), np.arange(4 * count))
    return surface.painted(shades, rng.integers(0, len(shades), count))


def _tree(triangles: int, seed: int):
    def make(d: Detail):
        return [
            ("Trunk", block((0.7, 4.5, 0.7), d), "DarkWood"),
            ("Crown", _crown(triangles - 12, 4.0, 10.0, seed), None),
        ]

    return make


def _car(d: Detail):
    """A body with round edges, its cabin, and wheels; front +Z. The body is what mirrors."""
    rows, columns = d.count(14), d.count(28)
    latitude = np.linspace(-math.pi / 2, math.pi / 2, rows + 1)
    longitude = 2.0 * math.pi * np.arange(columns) / columns
    power = lambda v: np.sign(v) * np.abs(v) ** BODY_POWER  # noqa: E731
    ring = np.stack([power(np.cos(longitude)), np.zeros(columns), -power(np.sin(longitude))], -1)
    net = (
        power(np.cos(latitude))[:, None, None] * ring[None]
        + np.array([0, 1.0, 0]) * power(np.sin(latitude))[:, None, None]
    )
    points = [np.array([0, -1.0, 0]), np.array([0, 1.0, 0]), *net[1:-1].reshape(-1, 3)]
    faces = []
    row = lambda r, c: 2 + (r - 1) * columns + c % columns  # noqa: E731
    for c in range(columns):
        faces.append([0, row(1, c + 1), row(1, c)])
        faces.append([1, row(rows - 1, c), row(rows - 1, c + 1)])
        for r in range(1, rows - 1):
            faces.append([row(r, c), row(r, c + 1), row(r + 1, c + 1), row(r + 1, c)])
    body = Surface(np.array(points), np.array([len(f) for f in faces]), np.concatenate(faces).astype(int))
    body = smooth(body.moved(scale=(0.95, 0.62, 2.3))).moved((0, 0.9, 0))
    wheels = [block((0.3, 0.64, 0.64), d, 0.1).moved((x, 0, z)) for x in (-0.8, 0.8) for z in (-1.3, 1.3)]
    cabin = block((1.25, 0.4, 1.5), d, 0.16).moved((0, 1.36, -0.25))
    return [("Body", body, None), ("Cabin", cabin, "Black"), ("Wheels", merge(*wheels), "Rubber")]


CITY_PARTS = {
    "city_car": _car,
    **{f"city_house_{'abcd'[k]}": _house(k) for k in range(4)},
    "city_shrub": _tree(SHRUB_TRIANGLES, 3),
    "city_tree": _tree(TREE_TRIANGLES, 5),
}
