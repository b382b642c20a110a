"""Planar mirrors: every vertex mirrored in the plane, drawn where the mirror is seen.

Source: Akenine-Moller, Haines, Hoffman, "Real-Time Rendering", 3rd edition, section 9.3.1; the mirror matrix as the
Householder form I - 2 n n^T about a point of the plane, which has no special normal (algorithms that turn the plane to an
axis first divide by 1 + n_y). What differs: instead of an oblique near plane, triangles are cut where they cross the
mirror's plane, where the virtual and the real point coincide; depth keeps its resolution and nothing behind shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector, project
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.techniques import forward
from warp_reflect.techniques.vertices import SolveFrame, VertexView

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
# Where no view is known: of the mirror's size, and a sine. Also what counts as exact: float32 points of a unit mesh carry
# 6e-8; a facet 1/100 of the mirror's size that deviates by this turns the ray by 1e-3 of a degree, below a pixel.
FLATNESS_MAX = 1.0e-6
NORMAL_SINE_MAX = 1.0e-5  # of the angle between a shading normal and the plane's: a bent normal is a curved mirror
SLIVER = 1.0e-6  # of the largest facet's area: the normal of a smaller one is rounding


@dataclass(frozen=True)
class Prepared:
    """The plane's frame: unit_from_scene puts it at z = 0, the reflecting side of its winding up.

    Attributes:
        exact: The mirror is the plane to rounding; else the plane gives the candidates, and refinement the hits.
    """

    reflector: Reflector
    unit_from_scene: np.ndarray  # float64 [4, 4]
    bytes: int = 0
    exact: bool = True


@wp.kernel
def mirror_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    out_vertex: VertexView,
):
    """One thread per scene vertex: its mirror image, if it lies on the eye's side."""
    i = first + wp.tid()
    if (i >= own_first and i < own_first + own_count) or int(out_vertex.status[i]) != 0:
        return
    q = frame.unit_from_scene * points[i] + frame.unit_offset
    if q[2] * wp.sign(frame.eye[2]) <= 0.0:
        out_vertex.status[i] = wp.uint8(HIDDEN)
        return
    out_vertex.status[i] = wp.uint8(CONVERGED)
    virtual = wp.vec3(q[0], q[1], -q[2])
    out_vertex.screen[i] = project(camera[0], frame.eye_from_unit * (virtual - frame.eye))


@wp.kernel
def plane_crossing_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    frame: SolveFrame,
    edges: wp.array(dtype=wp.vec2i),
    out_point: wp.array(dtype=wp.vec3),
):
    """One thread per edge (visible vertex, vertex behind): where it meets the plane, eye frame."""
    i = first + wp.tid()
    if edges[i][0] < 0:
        return
    a = frame.unit_from_scene * points[edges[i][0]] + frame.unit_offset
    b = frame.unit_from_scene * points[edges[i][1]] + frame.unit_offset
    t = a[2] / (a[2] - b[2])
    p = a + t * (b - a)
    out_point[i] = frame.eye_from_unit * (wp.vec3(p[0], p[1], 0.0) - frame.eye)


def applies(
    scene: Scene, reflector: Reflector, camera: Camera | None = None, shape_px: float = 0.5
) -> tuple[bool, str]:
    """A part whose points and normals agree with one plane.

    Args:
        camera: The view in whose pixels the deviation is judged; None: by `FLATNESS_MAX` and `NORMAL_SINE_MAX`.
        shape_px: At most this much may it shift what is shown. [pixels]
    """
    part = scene.parts[reflector.part]
    flat, reason = is_flat(scene, part)
    if camera is None or flat:
        return flat, reason
    plane, height, sine = _flatness(scene, part)
    from_eye = _points(scene, part) - (camera.eye - scene.origin)
    nearest = math.sqrt(float(np.einsum("ij,ij->i", from_eye, from_eye).min()))
    # A plane moved by h moves its picture by 2 h, a normal turned by an angle turns the ray by twice that.
    radians = 2.0 * (sine + height * plane[2] / max(nearest, 1.0e-300))
    shift = radians * max(camera.fx, camera.fy)
    if shift > shape_px:
        return False, f"not flat: off its plane by up to {shift:.2g} px (at most shape_px={shape_px:g})"
    return True, f"flat: off its plane by up to {shift:.2g} px (at most shape_px={shape_px:g})"


def is_flat(scene: Scene, part: PartRange) -> tuple[bool, str]:
    """Whether a part is a plane to rounding, and the reason."""
    _, height, sine = _flatness(scene, part)
    flat = f"{height:.1e} of its size off its plane (at most {FLATNESS_MAX:.0e})"
    bent = f"normals off the plane's by a sine of {sine:.1e} (at most {NORMAL_SINE_MAX:.0e})"
    if height > FLATNESS_MAX:
        return False, f"not flat: {flat}"
    return (False, f"not flat: {bent}") if sine > NORMAL_SINE_MAX else (True, f"flat: {flat}")


def prepare(scene: Scene, reflector: Reflector, settings: Settings) -> Prepared:
    """The plane through the mirror's points."""
    part = scene.parts[reflector.part]
    plane, height, sine = _flatness(scene, part)
    exact = height <= FLATNESS_MAX and sine <= NORMAL_SINE_MAX
    # A plane never sees itself, closed or not.
    return Prepared(replace(reflector, convex=True), plane_frame(*plane), exact=exact)


def plane_of(scene: Scene, part: int) -> tuple[np.ndarray, np.ndarray]:
    """(point [3], unit normal [3]) of the plane through a part of the scene, world."""
    point, normal, _ = _plane(scene, scene.parts[part])
    return point + scene.origin, normal


def plane_frame(point: np.ndarray, normal: np.ndarray, size: float) -> np.ndarray:
    """float64 [4, 4]: the similarity that puts a plane at z = 0, its unit normal up, and `size` to 1."""
    # Any rotation that takes the normal to +z: rows are an orthonormal basis.
    helper = np.eye(3)[np.abs(normal).argmin()]
    x = np.cross(helper, normal)
    x /= np.linalg.norm(x)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([x, np.cross(normal, x), normal]) / size
    matrix[:3, 3] = -matrix[:3, :3] @ point
    return matrix


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Mirror every vertex, draw, refine: see `forward.reflect`."""
    part = scene.parts[prepared.reflector.part]

    def solve_vertices(points, has_own: bool, frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        own = forward.own_vertices(part) if has_own else [0, 0]
        inputs = [points, *own, frame, gbuffer.view, out_vertex]
        launch(mirror_kernel, len(points), inputs, scene.device, settings.threads)

    def solve_boundary(points, frame: SolveFrame, edges: wp.array, out_point: wp.array) -> None:
        inputs = [points, frame, edges, out_point]
        launch(plane_crossing_kernel, len(edges), inputs, scene.device, settings.threads)

    return forward.reflect(
        scene,
        prepared.reflector,
        Technique.PLANAR,
        prepared.unit_from_scene,
        solve_vertices,
        solve_boundary,
        gbuffer,
        pixels,
        camera,
        settings,
        history,
        wary=not prepared.exact,
    )


def _corners(scene: Scene, part: PartRange) -> np.ndarray:
    return scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]


def _points(scene: Scene, part: PartRange) -> np.ndarray:
    """The points of a part, each once, scene frame; kept with the scene."""
    key = "points", part.first_triangle
    if key not in scene.facts:
        scene.facts[key] = scene.host_points[np.unique(_corners(scene, part))].astype(np.float64)
    return scene.facts[key]


def _flatness(scene: Scene, part: PartRange):
    """(plane, height, sine) of a part: `_plane` and `_deviation`, kept with the scene."""
    key = "plane", part.first_triangle
    if key not in scene.facts:
        plane = _plane(scene, part)
        scene.facts[key] = plane, *_deviation(scene, part, *plane)
    return scene.facts[key]


def _plane(scene: Scene, part: PartRange) -> tuple[np.ndarray, np.ndarray, float]:
    """(point, unit normal, size) of the plane through a part, area weighted, scene frame."""
    corners = scene.host_points[_corners(scene, part)].astype(np.float64)
    middle = corners.reshape(-1, 3).mean(axis=0)
    local = corners - middle
    size = max(float(np.abs(local).max()), 1.0e-300)
    facets = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
    # A closed box has facets that cancel: its longest facet then says at once that it is not flat.
    normal = facets.sum(axis=0)
    if np.linalg.norm(normal) < 1.0e-6 * np.linalg.norm(facets, axis=1).sum():
        normal = facets[np.linalg.norm(facets, axis=1).argmax()]
    length = np.linalg.norm(normal)
    normal = normal / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    return middle, normal, size


def _deviation(scene: Scene, part: PartRange, point: np.ndarray, normal: np.ndarray, size: float):
    """(largest height off a plane, of the size; largest sine between a normal that reflects and the plane's)."""
    corners = scene.host_points[_corners(scene, part)].astype(np.float64) - point
    height = float(np.abs(corners @ normal).max()) / size
    index = scene.host_normal_index[part.first_triangle : part.first_triangle + part.triangle_count]
    shading = scene.host_normals[np.unique(index[index[:, 0] >= 0])].astype(np.float64)
    flat = corners[index[:, 0] < 0]
    facets = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    area = np.linalg.norm(facets, axis=1)
    large = area > SLIVER * area.max(initial=0.0)
    facets = facets[large] / area[large, None]
    # Facets are flat to the rounding of their points, which their height tells already.
    shading = np.concatenate([shading, facets]) if height > FLATNESS_MAX else shading
    return height, float(np.linalg.norm(np.cross(shading, normal), axis=1).max(initial=0.0))
