"""One convex quadric patch of a mirror: every vertex solved on it, drawn where the patch is seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, vector
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.quadrics import FAMILY, CanonicalQuadric, Family
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Technique
from warp_reflect.techniques import forward, quadric_vector
from warp_reflect.techniques.quadric_search import QuadricView, is_visible, solve_vertex
from warp_reflect.techniques.vertices import SolveFrame, VertexView

wp.set_module_options({"enable_backward": False, "max_unroll": 2})


@wp.kernel
def search_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    quadric: QuadricView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    warm: int,
    # Outputs (seed: in and out, zero where none):
    out_vertex: VertexView,
):
    """One thread per scene vertex; vertices of the reflector itself have no picture."""
    i = first + wp.tid()
    if (i >= own_first and i < own_first + own_count) or int(out_vertex.status[i]) != 0:
        return
    target = frame.unit_from_scene * points[i] + frame.unit_offset
    seed = wp.vec3(0.0, 0.0, 0.0)
    if warm != 0:
        seed = out_vertex.seed[i]
    solve_vertex(quadric, frame, camera, target, seed, i, out_vertex)


def search(
    points: wp.array,
    own: list[int],
    quadric: QuadricView,
    frame: SolveFrame,
    camera: CameraView,
    warm: bool,
    out_vertex: VertexView,
    device,
    threads: int,
    kernels: str,
) -> None:
    """Solve every vertex that has no status yet.

    Args:
        points: vec3 [n], scene frame.
        own: [first, count] of the vertices that have no picture.
        warm: Start from `out_vertex.seed` where it is not zero.
        kernels: `Settings.kernels`.
    """
    inputs = [points, *own, quadric, frame, camera, int(warm), out_vertex]
    cone = quadric.family == int(Family.SHEET) and quadric.c == 0.0
    if not cone and vector.chosen(kernels, device):
        left = wp.zeros(vector.block_count(len(points)), dtype=wp.uint8, device=device)
        vector.launch_blocks(quadric_vector.search_blocks_kernel, len(points), [*inputs, left], device, threads)
        if not left.numpy().any():
            return
    launch(search_kernel, len(points), inputs, device, threads)


@wp.kernel
def boundary_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    quadric: QuadricView,
    frame: SolveFrame,
    edges: wp.array(dtype=wp.vec2i),
    steps: int,
    out_point: wp.array(dtype=wp.vec3),
):
    """One thread per edge (visible vertex, vertex that is not): the last visible point, eye frame."""
    i = first + wp.tid()
    if edges[i][0] < 0:
        return
    a = frame.unit_from_scene * points[edges[i][0]] + frame.unit_offset
    b = frame.unit_from_scene * points[edges[i][1]] + frame.unit_offset
    low = float(0.0)
    high = float(1.0)
    for _ in range(steps):
        middle = 0.5 * (low + high)
        if is_visible(quadric, frame.eye, a + middle * (b - a)):
            low = middle
        else:
            high = middle
    out_point[i] = frame.eye_from_unit * (a + low * (b - a) - frame.eye)


@dataclass(frozen=True)
class Prepared:
    """A quadric in its unit principal frame and the way there.

    Attributes:
        reflector: The mirror; its id is what the mask holds at the patch's pixels.
        quadric: World is the scene frame.
        unit_from_scene: float64 [4, 4], a similarity.
        wary: The mirror is a mesh that the quadric describes, not the quadric itself.
    """

    reflector: Reflector
    quadric: CanonicalQuadric
    unit_from_scene: np.ndarray
    wary: bool = False
    bytes: int = 0


def device_view(quadric: CanonicalQuadric) -> QuadricView:
    """The float32 form of a quadric."""
    view = QuadricView()
    view.lam = wp.vec3(*quadric.lam)
    view.b = quadric.b
    view.c = quadric.c
    view.family = int(FAMILY[quadric.kind])
    return view


def similarity(quadric: CanonicalQuadric) -> np.ndarray:
    """float64 [4, 4] from the world of a quadric to its unit principal frame."""
    matrix = np.eye(4)
    matrix[:3, :3] = quadric.axes.T / quadric.size
    matrix[:3, 3] = -matrix[:3, :3] @ quadric.origin
    return matrix


def gradients(quadric: CanonicalQuadric, points: np.ndarray) -> np.ndarray:
    """Directions out of the body at surface points, not normalised, float64 [n, 3]."""
    x = (points - quadric.origin) @ quadric.axes / quadric.size
    return (x * quadric.lam + [0.0, 0.0, quadric.b]) @ quadric.axes.T


def greatest_curvature(quadric: CanonicalQuadric) -> float | None:
    """Of a convex body, unit frame; None where it has no bound (a cone's apex)."""
    most = float(quadric.lam.max())
    family = FAMILY[quadric.kind]
    # Curvature along x at the end of another axis, where the gradient is least.
    if family == Family.RADIAL:
        return most / float(np.sqrt(quadric.lam[quadric.lam > 0.0].min()))
    if family == Family.BOWL:
        return most / abs(quadric.b)
    return most / float(np.sqrt(-quadric.lam[2] * quadric.c)) if quadric.c > 0.0 else None


def eye_is_inside(scene: Scene, prepared: Prepared, camera: Camera) -> bool:
    """True where the eye lies in the body (of a sheet: in that part), float64."""
    quadric = prepared.quadric
    x = prepared.unit_from_scene[:3, :3] @ (camera.eye - scene.origin) + prepared.unit_from_scene[:3, 3]
    value = float(quadric.lam @ (x * x) + 2.0 * quadric.b * x[2] + quadric.c)
    return value <= 0.0 and (quadric.b != 0.0 or quadric.lam[2] >= 0.0 or x[2] > 0.0)


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Search every vertex, draw the virtual meshes, refine: see `forward.reflect`."""
    reflector = prepared.reflector
    if eye_is_inside(scene, prepared, camera):
        # Only rounding at the silhouette shows the outside from in there.
        layer = ReflectionLayer.empty(pixels, Technique.QUADRIC, scene.device)
        traced = bvh.trace_pixels(
            scene,
            gbuffer,
            pixels,
            layer,
            reflector.part,
            reflector.convex,
            threads=settings.threads,
            kernels=settings.kernels,
        )
        layer.statistics["bvh"] = traced
        return layer
    part = scene.parts[reflector.part]
    view = device_view(prepared.quadric)

    def solve_vertices(points, has_own: bool, frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        own = forward.own_vertices(part) if has_own else [0, 0]
        sort = settings.kernels
        search(points, own, view, frame, gbuffer.view, warm, out_vertex, scene.device, settings.threads, sort)

    def solve_boundary(points, frame: SolveFrame, edges: wp.array, out_point: wp.array) -> None:
        steps = forward.BOUNDARY_STEPS[settings.refine]
        launch(
            boundary_kernel, len(edges), [points, view, frame, edges, steps, out_point], scene.device, settings.threads
        )

    return forward.reflect(
        scene,
        reflector,
        Technique.QUADRIC,
        prepared.unit_from_scene,
        solve_vertices,
        solve_boundary,
        gbuffer,
        pixels,
        camera,
        settings,
        history,
        greatest_curvature(prepared.quadric),
        prepared.wary,
    )
