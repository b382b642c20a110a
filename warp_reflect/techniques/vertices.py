"""What a solver is given and what it gives: the unit frame of a reflector, and one virtual vertex per scene vertex."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import raster
from warp_reflect.launch import stays
from warp_reflect.layers import Camera
from warp_reflect.optics import mirror_point, virtual_point
from warp_reflect.scene import Scene

wp.set_module_options({"enable_backward": False})

# The deviation of an edge's picture is (h^2 / 8) 1.5 / (...), see `edge_reach`; 1.5 covers what was measured.
ESTIMATE = wp.constant(8.0 / 1.5)
# Lengths whose squares float32 holds with all digits.
SQUARED_MIN, SQUARED_MAX = wp.constant(1.0e-12), wp.constant(1.0e12)


@wp.struct
class SolveFrame:
    """The unit frame of a reflector (a similarity of the scene frame) and the eye in it."""

    unit_from_scene: wp.mat33
    unit_offset: wp.vec3
    eye_from_unit: wp.mat33  # of differences: eye-frame point = eye_from_unit (q - eye)
    eye: wp.vec3


@wp.struct
class VertexView:
    """Per scene vertex: where its virtual vertex appears (`layers.project`; key -1: nowhere), and how it was found.

    A solver leaves alone what comes to it with a status: what was culled or kept from the last frame.
    """

    screen: wp.array(dtype=wp.vec4)
    status: wp.array(dtype=wp.uint8)
    seed: wp.array(dtype=wp.vec3)  # what a warm start begins from; zero: nothing known
    residual: wp.array(dtype=float)
    reach: wp.array(dtype=float)  # edge length whose picture bends by one radian (unit frame); 0: it never bends
    position: wp.array(dtype=wp.vec3)  # eye-frame virtual vertex; length 0 where nobody reads it
    drift: wp.array(dtype=float)  # bound on its error since it was solved [radians]; length 0 likewise


@wp.func
def virtual_vertex(frame: SolveFrame, p: wp.vec3, n: wp.vec3, target: wp.vec3) -> wp.vec3:
    """Virtual vertex of a reflection point (unit frame), in the eye frame: `optics.virtual_point`."""
    to_eye = frame.eye - p
    to_target = target - p
    a = wp.length(to_eye)
    b = wp.length(to_target)
    # Curvature of a body of the map's size: it only picks the form that forgives an error of p more.
    radius = wp.max(wp.length(p), 1.0e-6)
    if wp.min(a, b) > SQUARED_MIN and wp.max(a, b) < SQUARED_MAX:
        c_a = wp.abs(wp.dot(to_eye, n))
        if (c_a + c_a) * b < (a + b) * radius:
            return frame.eye_from_unit * (mirror_point(target, p, n) - frame.eye)
        # On the line of sight, seen from the eye.
        return frame.eye_from_unit * ((1.0 + b * (1.0 / a)) * -to_eye)
    return frame.eye_from_unit * (virtual_point(p, n, frame.eye, target, 1.0 / radius) - frame.eye)


@wp.func
def edge_reach(frame: SolveFrame, p: wp.vec3, n: wp.vec3, target: wp.vec3, curvature: float) -> float:
    """Length of a scene edge at `target` whose virtual picture deviates from a straight one by one radian.

    The deviation grows with the square of the length: (h^2 / 8) 1.5 / (d_O d_V^2 lambda), lambda the least eigenvalue of
    the path length's Hessian with the body's least curvature. Estimate of the interpolation error of virtual positions.
    """
    to_eye = frame.eye - p
    d_o = wp.length(to_eye)
    d_v = wp.length(target - p)
    per_o = 1.0 / wp.max(d_o, 1.0e-20)
    c = wp.abs(wp.dot(n, to_eye)) * per_o
    least = c * c * (per_o + 1.0 / wp.max(d_v, 1.0e-20)) + 2.0 * c * curvature
    return d_v * wp.sqrt(ESTIMATE * d_o * least)


def solve_frame(scene: Scene, camera: Camera, unit_from_scene: np.ndarray) -> SolveFrame:
    """The frame of a reflector seen by a camera, composed in float64."""
    linear = unit_from_scene[:3, :3]
    eye = linear @ (camera.eye - scene.origin) + unit_from_scene[:3, 3]
    frame = SolveFrame()
    frame.unit_from_scene = wp.mat33(linear.astype(np.float32))
    frame.unit_offset = wp.vec3(*unit_from_scene[:3, 3])
    frame.eye_from_unit = wp.mat33(np.linalg.inv(linear).astype(np.float32))
    frame.eye = wp.vec3(*eye)
    return frame


def empty_vertices(count: int, device, with_position: bool = False) -> VertexView:
    """Per-vertex results before a solver ran: nothing has a picture."""
    vertices = VertexView()
    if stays(device):
        vertices.screen = wp.full(count, wp.vec4(0.0, 0.0, raster.DROPPED, 0.0), dtype=wp.vec4, device=device)
    else:  # NumPy writes one number of each several times as fast as Warp four
        vertices.screen = wp.zeros(count, dtype=wp.vec4, device=device)
        vertices.screen.numpy()[:, 2] = raster.DROPPED
    vertices.status = wp.zeros(count, dtype=wp.uint8, device=device)
    vertices.residual = wp.zeros(count, dtype=float, device=device)
    vertices.reach = wp.zeros(count, dtype=float, device=device)
    vertices.seed = wp.zeros(count, dtype=wp.vec3, device=device)
    vertices.position = wp.zeros(count if with_position else 0, dtype=wp.vec3, device=device)
    vertices.drift = wp.zeros(count if with_position else 0, dtype=float, device=device)
    return vertices


VERTEX_ARRAYS = ("screen", "status", "residual", "reach", "seed", "position", "drift")


def copy_vertices(to: VertexView, source: VertexView, count: int) -> None:
    """Copy the first `count` answers."""
    for name in VERTEX_ARRAYS:
        if len(getattr(to, name)):
            wp.copy(getattr(to, name), getattr(source, name), count=count)


def vertices_from(vertices: VertexView, first: int) -> VertexView:
    """The answers from `first` on, sharing memory."""
    tail = VertexView()
    for name in VERTEX_ARRAYS:
        array = getattr(vertices, name)
        setattr(tail, name, array[first:] if len(array) else array)
    return tail
