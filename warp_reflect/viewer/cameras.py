"""Cameras that a hand moves: orbit, pan, zoom, other sizes, and a view of a stage that has none."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warp_reflect.layers import Camera
from warp_reflect.planner import Plan
from warp_reflect.scene import Scene

POLE_MARGIN = math.radians(2.0)  # an orbit ends short of the pole, where "up" has no direction on the screen
DEFAULT_FIELD = math.radians(40.0)  # of view, the smaller side: a normal lens
DEFAULT_SIDE = np.array([0.55, 0.35, 0.76])  # from where a stage without a camera is seen: right, up, front
NEAR_SHARE = 1.0e-3  # near plane of a default camera as a share of its distance
PATH_DEFAULT = "(no camera in the stage)"


def up_of(scene: Scene) -> np.ndarray:
    """The stage's up axis as a unit vector [3]."""
    return np.array([0.0, 0.0, 1.0]) if scene.data.up_axis == "Z" else np.array([0.0, 1.0, 0.0])


def extent(scene: Scene, part: int | None = None) -> tuple[np.ndarray, float]:
    """(middle [3] in world space, radius) of a scene's box or of one part's; radius 1 where there is nothing."""
    points = scene.host_points
    if part is not None:
        piece = scene.parts[part]
        faces = scene.host_triangles[piece.first_triangle : piece.first_triangle + piece.triangle_count]
        points = points[np.unique(faces)]
    if not len(points):
        return scene.origin.copy(), 1.0
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    radius = 0.5 * float(np.linalg.norm(high - low))
    return scene.origin + 0.5 * (low + high), radius if radius > 0.0 else 1.0


def default_camera(scene: Scene, size: tuple[int, int]) -> Camera:
    """A camera that sees all of a scene, for a stage that has none.

    Args:
        scene: May be empty.
        size: (width, height). [pixels]
    """
    middle, radius = extent(scene)
    up = up_of(scene)
    side, front = (np.array([1.0, 0, 0]), np.cross([1.0, 0, 0], up))
    away = DEFAULT_SIDE[0] * side + DEFAULT_SIDE[1] * up + DEFAULT_SIDE[2] * front
    away /= np.linalg.norm(away)
    distance = radius / math.sin(0.5 * DEFAULT_FIELD)
    right = np.cross(up, away)
    right /= np.linalg.norm(right)
    focal = 0.5 * min(size) / math.tan(0.5 * DEFAULT_FIELD)
    return Camera(
        eye=middle + distance * away,
        right=right,
        up=np.cross(away, right),
        forward=-away,
        fx=focal,
        fy=focal,
        cx=0.5 * size[0],
        cy=0.5 * size[1],
        near=NEAR_SHARE * distance,
        far=distance + 10.0 * radius,
        size=tuple(size),
        path=PATH_DEFAULT,
    )


def pivot_of(plan: Plan) -> np.ndarray:
    """What a camera turns about, world [3]: the middle of the mirror with most pixels, else of the scene."""
    seen = max(plan.rows, key=lambda row: row.pixels, default=None)
    return extent(plan.scene, None if seen is None or not seen.pixels else seen.reflector.part)[0]


def resized(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view with other pixels; where the aspect differs, pixels are no squares any more.

    `planner.find_camera` would keep the focal length in pixels and crop instead.
    """
    x, y = size[0] / camera.size[0], size[1] / camera.size[1]
    return dataclasses.replace(
        camera, fx=camera.fx * x, cx=camera.cx * x, fy=camera.fy * y, cy=camera.cy * y, size=tuple(size)
    )


def orbited(camera: Camera, pivot: np.ndarray, up: np.ndarray, yaw: float, pitch: float) -> Camera:
    """Turned about a point: by `yaw` about the up axis, then by `pitch` about the camera's right, in radians.

    Positive angles carry the eye to the right and up. The pitch is cut short of the poles.
    """
    turn = _rotation(up, yaw)
    forward = turn @ camera.forward
    lean = math.acos(float(np.clip(forward @ -up, -1.0, 1.0)))  # 0 looks straight down
    pitch = float(np.clip(pitch, min(lean - math.pi + POLE_MARGIN, 0.0), max(lean - POLE_MARGIN, 0.0)))
    turn = _rotation(turn @ camera.right, -pitch) @ turn
    axes = [turn @ axis for axis in (camera.right, camera.up, camera.forward)]
    return dataclasses.replace(
        camera, eye=pivot + turn @ (camera.eye - pivot), right=axes[0], up=axes[1], forward=axes[2]
    )


def panned(camera: Camera, pivot: np.ndarray, dx: float, dy: float) -> tuple[Camera, np.ndarray]:
    """(camera, pivot) moved so that what is as far as the pivot follows the pointer by (dx, dy) pixels, y down."""
    depth = 1.0 if camera.orthographic else max(float((pivot - camera.eye) @ camera.forward), camera.near)
    shift = depth * (dy / camera.fy * camera.up - dx / camera.fx * camera.right)
    return dataclasses.replace(camera, eye=camera.eye + shift), pivot + shift


def zoomed(camera: Camera, pivot: np.ndarray, factor: float) -> Camera:
    """Brought to `factor` times its distance from the pivot; an orthographic camera sees that much more.

    The near plane goes along, so that it never cuts the pivot off.
    """
    if camera.orthographic:
        return dataclasses.replace(camera, fx=camera.fx / factor, fy=camera.fy / factor)
    eye = pivot + factor * (camera.eye - pivot)
    away = float(np.linalg.norm(eye - pivot))
    before = float(np.linalg.norm(camera.eye - pivot))
    return dataclasses.replace(
        camera, eye=eye, near=min(camera.near, 0.1 * away), far=max(camera.far, camera.far + away - before)
    )


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation matrix [3, 3] about a unit axis."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * cross @ cross
