"""UsdGeomPoints as balls of triangles."""

from __future__ import annotations

import numpy as np
from pxr import UsdGeom

from warp_reflect.scene import MeshData, Part
from warp_reflect.stage.intake import COORDINATE_MAX, BadPrim, Intake, floats
from warp_reflect.stage.primvars import read_primvar

WIDTH_DEFAULT = 1.0  # what Hydra draws where no widths are authored
# Points up to which each is a ball of 320 triangles, of 80; more of them are icosahedra with smooth normals.
FINE_MAX, MEDIUM_MAX = 1_000, 50_000
ICOSAHEDRON_FACES = [
    *((0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11)),
    *((1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8)),
    *((3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9)),
    *((4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)),
]


def read_points(prim, intake: Intake, level: int, color_name: str = "displayColor") -> MeshData:
    """A UsdGeomPoints in object space: one ball per point, its width the diameter.

    Args:
        prim: The points.
        intake: The reading; points that cannot be drawn are noted and left out.
        level: Finer balls, each level once more.
        color_name: Primvar that becomes the colours, where it varies from point to point.

    Raises:
        BadPrim: no point that can be drawn, or more than the limit of triangles.
    """
    path, points = prim.GetPath(), UsdGeom.Points(prim)
    centres = floats(points.GetPointsAttr(), intake.time, 3)
    if centres is None or not len(centres):
        raise BadPrim(f"points: got {'no value' if centres is None else 'an empty array'}, expected points")
    widths = _widths(points, len(centres), intake)
    fine = np.isfinite(centres).all(axis=1) & (np.abs(centres) <= COORDINATE_MAX).all(axis=1)
    if not fine.all():
        first = int(np.argmin(fine))
        got = tuple(centres[first].tolist())
        intake.bad(path, f"points[{first}]: got {got}, expected finite ones; {np.sum(~fine)} points dropped")
    wrong = ~((widths >= 0.0) & (widths <= COORDINATE_MAX))
    if wrong.any():
        first = int(np.argmax(wrong))
        intake.bad(path, f"widths[{first}]: got {widths[first]:g}, expected >= 0; {np.sum(wrong)} points dropped")
    kept = np.flatnonzero(fine & ~wrong & (widths > 0.0))
    if not len(kept):
        raise BadPrim("widths: got no point with a width, expected one")
    steps = level + (2 if len(kept) <= FINE_MAX else 1 if len(kept) <= MEDIUM_MAX else 0)
    ball, faces = icosphere(steps)
    if len(kept) * len(faces) > intake.limits.triangles:
        raise BadPrim(f"points: got {len(kept)} points, expected at most {intake.limits.triangles // len(faces)}")
    corners = (centres[kept, None] + 0.5 * widths[kept, None, None] * ball).astype(np.float32)
    first = (len(ball) * np.arange(len(kept), dtype=np.int32))[:, None, None]
    triangles = (faces + first).reshape(-1, 3)
    mesh = MeshData(corners.reshape(-1, 3), triangles, ball.astype(np.float32), np.tile(faces, (len(kept), 1)))
    mesh.parts = [Part(0, len(triangles))]
    color = read_primvar(prim, color_name, 3, intake)
    if color is not None and color.interpolation != "constant" and color.element_count == len(centres):
        mesh.colors = color.flat()[kept].astype(np.float32)
        mesh.color_index = np.repeat(np.arange(len(kept), dtype=np.int32), 3 * len(faces)).reshape(-1, 3)
    elif color is not None and color.element_count > 1:
        intake.bad(
            path,
            f"primvars:{color_name}: got {color.element_count} values, expected {len(centres)}; their mean is used",
        )
    return mesh


def _widths(points: UsdGeom.Points, count: int, intake: Intake) -> np.ndarray:
    """Width of each point, float64 [count]."""
    widths = floats(points.GetWidthsAttr(), intake.time, 1)
    if widths is None or not len(widths):
        intake.note(points.GetPath(), f"widths: no value; {WIDTH_DEFAULT:g} is used")
        return np.full(count, WIDTH_DEFAULT)
    if len(widths) not in (1, count):
        raise BadPrim(f"widths: got {len(widths)} values, expected 1 or {count}")
    return np.broadcast_to(widths, count)


def icosphere(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """(vertices of a unit ball float64 [n, 3], faces int32 [20 * 4^steps, 3], counter-clockwise from outside)."""
    t = 0.5 * (1.0 + np.sqrt(5.0))
    corners = [(-1, t, 0), (1, t, 0), (-1, -t, 0), (1, -t, 0)]
    corners += [(0, *pair) for pair in ((-1, t), (1, t), (-1, -t), (1, -t))]
    corners += [(a, 0, b) for a, b in ((t, -1), (t, 1), (-t, -1), (-t, 1))]
    points, faces = np.array(corners), np.array(ICOSAHEDRON_FACES, np.int32)
    for _ in range(steps):
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        unique, middle = np.unique(edges, axis=0, return_inverse=True)
        m = (len(points) + middle.reshape(-1, 3)).astype(np.int32)
        points = np.concatenate([points, points[unique].mean(axis=1)])
        a, b, c = faces.T
        p, q, r = m.T
        faces = np.concatenate([np.stack(f, axis=1) for f in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))])
    return points / np.linalg.norm(points, axis=1, keepdims=True), faces
