"""Virtual vertices kept from the last frame while a bound on their error on the screen stays below a tolerance.

Source: Estalella et al. 2005, section 5 ("constant partial virtual vertices": some vertices are solved each frame, the
others keep their virtual position). What differs: which ones is decided by an upper bound in pixels instead of by turns,
so that vertices near the hidden boundary, where the bound is large, are solved every frame and distant smooth ones rarely.

The bound. Let the eye O move by dO. The virtual vertex V' of a fixed point moves across the line of sight by M dO, in
first order; in the plane of incidence (c the cosine of incidence, k the normal curvature there, r_O and r_V the path's
two legs)

    M = (r_V / r_O) 2 k / (c (1 / r_O + 1 / r_V) + 2 k),

from the Hessian of the path length (H = c^2 (1/r_O + 1/r_V) + 2 c k), and less across that plane. It grows with k: the
body's greatest curvature bounds it, a plane's virtual vertices stay. Seen from the eye that is M |dO| / (r_O + r_V) radians.
"""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, project
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques.vertices import VertexView

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))
SPREAD = wp.constant(
    1.5
)  # of the bound, for what a first-order estimate leaves out where the legs change within a step


@wp.func
def drift_rate(to_virtual: wp.vec3, to_target: wp.vec3, curvature: float) -> float:
    """Upper bound of the angle by which a virtual vertex moves on the screen, per length of the eye's motion.

    Args:
        to_virtual, to_target: Virtual vertex and its point, from the eye. Both legs follow from these alone: R lies on the
            first, as far from the point as from the virtual vertex.
        curvature: Greatest of the body. [1 / length]
    """
    path = wp.length(to_virtual)
    u = to_virtual / wp.max(path, 1.0e-30)
    span = path - wp.dot(u, to_target)
    r_o = 0.5 * (path * path - wp.dot(to_target, to_target)) / wp.max(span, 1.0e-30)
    r_o = wp.clamp(r_o, 1.0e-6 * path, path)
    r_v = wp.max(path - r_o, 1.0e-6 * path)
    # The bisector's angle to either leg: cos(2 i) = u_o . u_v.
    v = (to_target - r_o * u) / r_v
    c = wp.sqrt(wp.clamp(0.5 * (1.0 - wp.dot(u, v)), 0.0, 1.0))
    return (r_v / r_o) * 2.0 * curvature / (c * (1.0 / r_o + 1.0 / r_v) + 2.0 * curvature) / path


@wp.kernel
def keep_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    camera: wp.array(dtype=CameraView),
    eye_before: wp.vec3,
    curvature: float,
    limit: float,
    before: VertexView,
    out_vertex: VertexView,
):
    """One thread per virtual vertex: what it was, seen from the new eye, where the bound allows."""
    i = first + wp.tid()
    if int(before.status[i]) != CONVERGED:
        return
    position = before.position[i]
    if wp.length_sq(position) == 0.0:
        return
    move = camera[0].eye - eye_before
    rate = drift_rate(position, points[i] - eye_before, curvature)
    moved = position - move
    # Radians off the axis are more pixels than on it.
    depth = wp.dot(camera[0].forward, moved)
    if depth <= 0.0:
        return
    oblique = wp.length_sq(moved) / (depth * depth)
    drift = before.drift[i] + SPREAD * rate * wp.length(move) * oblique
    if not (drift <= limit):
        return
    out_vertex.status[i] = wp.uint8(CONVERGED)
    out_vertex.position[i] = moved
    out_vertex.drift[i] = drift
    out_vertex.reach[i] = before.reach[i]
    out_vertex.residual[i] = before.residual[i]
    out_vertex.screen[i] = project(camera[0], moved)


def keep(
    scene: Scene,
    points: wp.array,
    camera: Camera,
    view: wp.array,
    history,
    curvature: float,
    settings: Settings,
    out_vertex: VertexView,
) -> Callable[[], dict]:
    """Settle the vertices whose virtual positions of the last frame are good enough; the others stay unsolved.

    Args:
        points: vec3 [n], scene frame.
        camera, view: Of this frame.
        history: `forward.History` of the last frame, its vertices with positions and drifts.
        curvature: Greatest curvature of the mirror. [1 / scene unit]
        settings: `reuse_px` bounds the drift of a kept vertex since it was last solved. [pixels]
        out_vertex: One entry per point.

    Returns:
        Gives, when it is called, `reused`: vertices kept, and `reused_px`: the largest bound among them.
    """
    pixels_per_radian = max(camera.fx, camera.fy)
    limit = settings.reuse_px / pixels_per_radian
    eye_before = wp.vec3(*(history.eye - scene.origin))
    inputs = [points, view, eye_before, curvature, limit, history.vertices, out_vertex]
    launch(keep_kernel, len(points), inputs, scene.device, settings.threads)
    status = wp.clone(out_vertex.status)  # what is solved later counts no more

    def counted() -> dict:
        drift = out_vertex.drift.numpy()[status.numpy() == int(Status.CONVERGED)]
        return {"reused": len(drift), "reused_px": float(drift.max(initial=0.0)) * pixels_per_radian}

    return counted
