"""The one pass of every forward technique: solve vertices -> virtual mesh -> rasterise -> refine.

A technique supplies the solver; this module owns the virtual vertex, the clipping of triangles at the hidden boundary,
the masked drawing and the hand-over to `refine`. Source of virtual objects: Diefenbach and Badler 1997 for planes,
Ofek and Rappoport 1998 and Estalella et al. 2005 for curved mirrors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, compact, raster
from warp_reflect.launch import launch
from warp_reflect.layers import (
    Camera,
    CameraView,
    GBuffer,
    MirrorPixels,
    ReflectionLayer,
    Reflector,
    project,
)
from warp_reflect.scene import PartRange, Scene, SceneView
from warp_reflect.settings import Settings, Status
from warp_reflect.shapes import clamp_weights, intersect_triangle
from warp_reflect.techniques import cull, refine, reuse, virtual_mesh
from warp_reflect.techniques.vertices import (
    VertexView,
    copy_vertices,
    empty_vertices,
    solve_frame,
    vertices_from,
)
from warp_reflect.techniques.virtual_mesh import Drawn, Straddling, VirtualMesh
from warp_reflect.timing import StageTimer

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))
SKY = wp.constant(int(Status.SKY))
DROPPED = raster.DROPPED
# Of a triangle, by its corners.
STRADDLING = wp.constant(1)
FAILED = wp.constant(2)
# Bisections of an edge at the hidden boundary: 1/4096 of its length, below a pixel, or, where refinement finds the exact
# hit anyway, a candidate close enough to walk from.
BOUNDARY_STEPS = {"off": 12, "exact": 5, "strict": 5}
DENSE = 2.0  # virtual triangles per mirror pixel: from here on a pixel hides nearer ones that only a strict look finds


@dataclass
class History:
    """What the next frame of a reflector may start from: the mesh it reflected, its vertices, and the eye's place."""

    mesh: VirtualMesh
    vertices: VertexView
    eye: np.ndarray


@wp.kernel
def straddle_kernel(
    first: int,
    triangles: wp.array(dtype=wp.vec3i),
    status: wp.array(dtype=wp.uint8),
    out_kind: wp.array(dtype=wp.uint8),
):
    """One thread per triangle: `STRADDLING` the hidden boundary, `FAILED` if a corner's search did, else 0."""
    i = first + wp.tid()
    t = triangles[i]
    first_status = int(status[t[0]])
    if first_status != MAX_ITERATIONS and int(status[t[1]]) == first_status and int(status[t[2]]) == first_status:
        # Nearly all of them.
        out_kind[i] = wp.uint8(0)
        return
    hidden = int(0)
    solved = int(0)
    failed = int(0)
    for k in range(3):
        s = int(status[t[k]])
        if s == HIDDEN:
            hidden += 1
        elif s == CONVERGED:
            solved += 1
        elif s == MAX_ITERATIONS:
            failed += 1
    kind = int(0)
    if failed > 0:
        kind = FAILED
    elif hidden > 0 and solved > 0:
        kind = STRADDLING
    out_kind[i] = wp.uint8(kind)


@wp.kernel
def turn_kernel(
    first: int,
    ids: wp.array(dtype=int),
    triangles: wp.array(dtype=wp.vec3i),
    status: wp.array(dtype=wp.uint8),
    out_corners: wp.array(dtype=wp.vec3i),
    out_edges: wp.array(dtype=wp.vec2i),
):
    """One thread per straddling triangle: turned so that the corner unlike the other two comes first, and its two edges.

    An edge is (visible vertex, vertex that is not); (-1, -1) where there is no triangle (id -1).
    """
    i = first + wp.tid()
    count = ids.shape[0]
    if ids[i] < 0:
        out_edges[i] = wp.vec2i(-1, -1)
        out_edges[count + i] = wp.vec2i(-1, -1)
        return
    t = triangles[ids[i]]
    visible = int(0)
    for k in range(3):
        if int(status[t[k]]) == CONVERGED:
            visible += 1
    odd = int(0)
    for k in range(3):
        if (int(status[t[k]]) == CONVERGED) == (visible == 1):
            odd = k
    a = t[odd]
    b = t[(odd + 1) % 3]
    c = t[(odd + 2) % 3]
    out_corners[i] = wp.vec3i(a, b, c)
    if visible == 1:
        out_edges[i] = wp.vec2i(a, b)
        out_edges[count + i] = wp.vec2i(a, c)
    else:
        out_edges[i] = wp.vec2i(b, a)
        out_edges[count + i] = wp.vec2i(c, a)


@wp.kernel
def sides_kernel(
    first: int,
    ids: wp.array(dtype=int),
    triangles: wp.array(dtype=wp.vec3i),
    screen: wp.array(dtype=wp.vec4),
    status: wp.array(dtype=wp.uint8),
    corners: wp.array(dtype=wp.vec3i),
    boundary: wp.array(dtype=wp.vec3),
    camera: wp.array(dtype=CameraView),
    # Outputs:
    out_screen: wp.array(dtype=wp.vec4),
    out_triangles: wp.array(dtype=wp.vec3i),
    out_owners: wp.array(dtype=int),
    out_planes: wp.array(dtype=wp.vec3i),
):
    """One thread per straddling triangle: its visible side, one triangle or two; see `Straddling` for their points.

    The last point has no picture: what is no triangle has it for its corners.
    """
    i = first + wp.tid()
    n = ids.shape[0]
    none = wp.vec3i(5 * n, 5 * n, 5 * n)
    if i == 0:
        out_screen[5 * n] = wp.vec4(0.0, 0.0, DROPPED, 0.0)
    out_triangles[i] = none
    out_triangles[n + i] = none
    if ids[i] < 0:
        return
    corner = corners[i]
    for k in range(3):
        out_screen[k * n + i] = screen[corner[k]]
    for k in range(2):
        out_screen[(3 + k) * n + i] = project(camera[0], boundary[k * n + i])
        out_owners[k * n + i] = ids[i]
        out_planes[k * n + i] = triangles[ids[i]]
    if int(status[corner[0]]) == CONVERGED:
        out_triangles[i] = wp.vec3i(i, 3 * n + i, 4 * n + i)
    else:
        # The quadrilateral b, c, cut ca, cut ba.
        out_triangles[i] = wp.vec3i(n + i, 2 * n + i, 4 * n + i)
        out_triangles[n + i] = wp.vec3i(n + i, 4 * n + i, 3 * n + i)


@wp.kernel
def caution_kernel(
    first: int,
    drawn: wp.array(dtype=int),
    dense: int,
    failed: wp.array(dtype=int),
    wary: int,
    out_caution: wp.array(dtype=int),
):
    """One thread: see `refine.fixed_caution`; `drawn` in parts, `dense`: how many of them make wary."""
    total = int(0)
    for k in range(drawn.shape[0]):
        total += drawn[k]
    out_caution[0] = wp.where(failed[0] == 0, 1, 0)
    out_caution[1] = wp.where(total > dense, 1, wary)


@wp.func
def triangle_weights(p: wp.vec3, e1: wp.vec3, e2: wp.vec3) -> wp.vec2:
    """Weights of the second and third corner of a point in a triangle's plane, all relative to the first."""
    g11 = wp.dot(e1, e1)
    g12 = wp.dot(e1, e2)
    g22 = wp.dot(e2, e2)
    det = g11 * g22 - g12 * g12
    if det <= 0.0:
        return wp.vec2(0.0, 0.0)
    d1 = wp.dot(p, e1)
    d2 = wp.dot(p, e2)
    return clamp_weights((g22 * d1 - g12 * d2) / det, (g11 * d2 - g12 * d1) / det)


@wp.kernel
def candidate_hits_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    target: raster.TargetView,
    screen: wp.array(dtype=wp.vec4),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Virtual mesh:
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    parents: wp.array(dtype=int),
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel: the point of the virtual triangle drawn there, without refinement."""
    i = first + wp.tid()
    x = pixel[i] % camera[0].width
    y = pixel[i] / camera[0].width
    cell = (y - target.y0) * (target.x1 - target.x0) + x - target.x0
    drawn = raster.key_triangle(target.key[cell])
    if drawn < 0:
        out_status[i] = wp.uint8(SKY)
        return
    t = triangles[drawn]
    v0 = points[t[0]]
    v1 = points[t[1]]
    v2 = points[t[2]]
    a = screen[t[0]]
    b = screen[t[1]]
    c = screen[t[2]]
    weights = wp.vec2(0.0, 0.0)
    if a[2] > 0.0 and b[2] > 0.0 and c[2] > 0.0:
        px = float(x) + 0.5
        py = float(y) + 0.5
        # Screen weights times the depth keys are perspective-correct weights.
        wa = ((b[0] - px) * (c[1] - py) - (b[1] - py) * (c[0] - px)) * a[2]
        wb = ((c[0] - px) * (a[1] - py) - (c[1] - py) * (a[0] - px)) * b[2]
        wc = ((a[0] - px) * (b[1] - py) - (a[1] - py) * (b[0] - px)) * c[2]
        total = wa + wb + wc
        if total != 0.0:
            weights = clamp_weights(wb / total, wc / total)
    else:
        # A triangle clipped at the hidden boundary has no picture of its corners: its plane seen along the ray.
        hit = intersect_triangle(point[i], direction[i], v0, v1, v2)
        weights = clamp_weights(hit.u, hit.v)
    position = v0 + weights[0] * (v1 - v0) + weights[1] * (v2 - v0)
    triangle = parents[drawn]
    owner = scene.triangles[triangle]
    p0 = scene.points[owner[0]]
    inside = triangle_weights(position - p0, scene.points[owner[1]] - p0, scene.points[owner[2]] - p0)
    out_triangle[i] = triangle
    out_u[i] = inside[0]
    out_v[i] = inside[1]
    out_distance[i] = wp.length(position - point[i])
    out_status[i] = wp.uint8(CONVERGED)


def own_vertices(part: PartRange) -> list[int]:
    """[first, count] of the scene vertices that belong to the mirror alone and have no picture in it."""
    return [part.first_vertex, part.vertex_count if part.is_whole else 0]


def reflect(
    scene: Scene,
    reflector: Reflector,
    technique: int,
    unit_from_scene: np.ndarray,
    solve_vertices: Callable,
    solve_boundary: Callable,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history: History | None,
    greatest_curvature: float | None = None,
    wary: bool = False,
) -> ReflectionLayer:
    """Reflect a scene in one mirror by virtual objects.

    Args:
        unit_from_scene: float64 [4, 4] similarity into the solver's frame.
        solve_vertices: (points, own_count, frame, warm, out VertexView) -> None, fills one entry per point; the first
            `own_count` are the mirror's own or the scene's, see `own_vertices`.
        solve_boundary: (points, frame, edges vec2i, out points vec3) -> None, see `reflector_map.boundary_kernel`.
        history: The same reflector's layer history of the previous frame.
        greatest_curvature: Of the mirror, unit frame; None: its vertices are solved anew every frame.
        wary: The solver's surface is not quite the mirror's own, see `refine.settle`.

    Returns:
        The layer; unless `refine="off"` every pixel is the hit of an exact ray-triangle test.
    """
    layer = ReflectionLayer.empty(pixels, technique, scene.device)
    if pixels.count == 0:
        return layer
    timer = StageTimer(scene.device)
    part = scene.parts[reflector.part]
    frame = solve_frame(scene, camera, unit_from_scene)
    unit_per_scene = float(np.cbrt(abs(np.linalg.det(unit_from_scene[:3, :3]))))

    def solve_apart(points: wp.array) -> VertexView:
        """Points that are no vertices of the scene's."""
        answers = empty_vertices(len(points), scene.device)
        solve_vertices(points, False, frame, False, answers)
        return answers

    with timer("search"):
        mesh = history.mesh if history else virtual_mesh.whole(scene, part)
        keeping = settings.reuse_px > 0.0 and greatest_curvature is not None
        vertices = empty_vertices(mesh.vertex_count, scene.device, with_position=keeping)
        if history:
            wp.copy(vertices.seed, history.vertices.seed)  # the previous frame keeps its own answer
        # A frame that was to keep nothing did not store where its virtual vertices lie.
        if history and keeping and len(history.vertices.position):
            curvature = greatest_curvature * unit_per_scene
            reused = reuse.keep(scene, mesh.points, camera, gbuffer.view, history, curvature, settings, vertices)
            layer.statistics.later(reused)
        cull.settle_unseen(scene, part, vertices)
        if reflector.convex:
            culled = cull.settle_culled(scene, solve_apart, pixels, camera, unit_per_scene, vertices)
            layer.statistics.later(lambda: {"culled": culled()})
        solve_vertices(mesh.points, True, frame, history is not None, vertices)
    with timer("tessellate"):
        mesh, vertices = cut_where_bent(
            scene, part, mesh, vertices, frame, solve_vertices, unit_per_scene, camera, pixels, settings
        )
        layer.history = History(mesh, vertices, camera.eye)
    with timer("virtual_raster"):
        target = raster.make_target(gbuffer.camera, pixels.box, scene.device, gbuffer.reflector_id, reflector.id)
        target.view.painter = int(settings.occlusion == "painter")
        if settings.refine != "off":
            raster.attach_rays(target, gbuffer.view, pixels, settings.threads, settings.kernels)
        drawn = raster.rasterise(
            target,
            vertices.screen,
            mesh.triangles,
            points=mesh.points,
            threads=settings.threads,
            kernels=settings.kernels,
        )
        straddling, clipped, failed = _draw_straddling(
            scene, mesh, target, frame, vertices, solve_boundary, gbuffer, settings
        )
        layer.virtual = [Drawn(pixels, mesh, vertices.screen, straddling)]
    if settings.refine == "off":
        with timer("candidates"):
            launch(
                candidate_hits_kernel,
                pixels.count,
                [scene.view, gbuffer.view, target.view, vertices.screen]
                + [pixels.pixel, pixels.point, pixels.direction]
                + [mesh.points, mesh.triangles, mesh.parents]
                + [layer.triangle, layer.u, layer.v, layer.distance, layer.status],
                scene.device,
                settings.threads,
            )
        layer.statistics.update(candidate=pixels.count)
        doubtful = refine.in_doubt_of_holes(scene, layer, settings.threads)
        if doubtful is not None:
            bvh.trace_pixels(
                scene,
                gbuffer,
                pixels,
                layer,
                reflector.part,
                reflector.convex,
                doubtful,
                settings.threads,
                settings.kernels,
            )
    else:
        with timer("own_body"):
            blocked = compact.none(wp.uint8, scene.device)
            if not reflector.convex:
                blocked = bvh.own_obstacles(scene, gbuffer, pixels, reflector.part, settings.threads)
        with timer("refine"):
            caution = wp.empty(2, dtype=int, device=scene.device)
            dense = int(DENSE * pixels.count)
            launch(caution_kernel, 1, [drawn, dense, failed, int(wary), caution], scene.device)
            doubtful = refine.settle(
                scene,
                gbuffer,
                pixels,
                target,
                mesh,
                layer,
                blocked,
                settings,
                caution,
                scene.seen_in(part),
            )
        with timer("trace"):
            bvh.trace_pixels(
                scene,
                gbuffer,
                pixels,
                layer,
                reflector.part,
                reflector.convex,
                doubtful,
                settings.threads,
                settings.kernels,
            )
    counts = {"drawn": drawn, "clipped": clipped, "failed": failed}
    layer.statistics.later(lambda: {name: int(count.numpy().sum()) for name, count in counts.items()})
    layer.statistics.update(vertices=mesh.vertex_count)
    layer.timings = timer.ms
    return layer


def cut_where_bent(
    scene, part, mesh, vertices, frame, solve_vertices, unit_per_scene, camera, pixels, settings
) -> tuple[VirtualMesh, VertexView]:
    """Cut triangles whose picture would bend by more than `edge_px`; keep the mesh where it is fine enough."""
    if settings.edge_px == 0.0:
        return mesh, vertices
    tolerance = settings.edge_px / max(camera.fx, camera.fy)

    def needed(multiple: float) -> wp.array:
        allowed = tolerance * multiple
        return virtual_mesh.needed_cuts(scene, vertices, unit_per_scene, allowed, pixels.box, settings.threads)

    def cuts_for(multiple: float) -> np.ndarray:
        cuts = needed(multiple).numpy()
        cuts[part.first_triangle : part.first_triangle + part.triangle_count] = 1
        return cuts

    if not virtual_mesh.is_late(part, mesh, needed(mesh.relaxed), settings.threads):
        return mesh, vertices
    estimated = cuts_for(1.0 / virtual_mesh.CUT_SLACK)
    ids = np.flatnonzero(estimated > 1)
    places = wp.array(virtual_mesh.edge_middles(scene, ids), dtype=wp.vec3, device=scene.device)
    with_position = len(vertices.position) > 0
    middles = empty_vertices(len(places), scene.device, with_position)
    virtual_mesh.start_middles(scene, ids, vertices, middles, settings.threads)
    solve_vertices(places, False, frame, True, middles)
    cuts, relaxed = np.ones(scene.triangle_count, np.uint8), 1.0
    for _ in range(virtual_mesh.RELAX_STEPS):
        allowed_px = settings.edge_px * relaxed / virtual_mesh.CUT_SLACK
        upper = estimated[ids] if relaxed == 1.0 else cuts_for(relaxed / virtual_mesh.CUT_SLACK)[ids]
        ask = scene, ids, upper, vertices, middles, allowed_px, unit_per_scene
        cuts[ids] = virtual_mesh.measured_cuts(*ask, settings.threads)
        if virtual_mesh.triangle_cost(cuts) <= virtual_mesh.budget(scene):
            break
        relaxed *= virtual_mesh.RELAX
    finer = virtual_mesh.cut_mesh(scene, part, cuts, estimated, relaxed)
    coarse = virtual_mesh.coarse_triangles(scene, part, vertices, ids, middles, cuts, unit_per_scene)
    finer.coarse = wp.array(coarse, dtype=int, device=scene.device)
    base = mesh.base_count
    known = empty_vertices(finer.vertex_count, scene.device, with_position)
    copy_vertices(known, vertices, base)
    if finer.vertex_count > base:  # as measured, nothing may be left to cut
        added = vertices_from(known, base)
        virtual_mesh.start_added(scene, finer, ids, vertices, middles, added, settings.threads)
        solve_vertices(finer.points[base:], False, frame, True, added)
    return finer, known


def _draw_straddling(
    scene, mesh, target, frame, vertices, solve_boundary, gbuffer, settings
) -> tuple[Straddling, wp.array, wp.array]:
    """Draw the visible side of triangles that straddle the hidden boundary.

    Returns:
        (what was drawn; how many straddle it, int32 [1]; triangles with a failed corner, likewise).

    On the boundary the line of sight grazes the mirror, so the virtual point is the real one.
    """
    count, device, threads = len(mesh.triangles), scene.device, settings.threads
    kind = wp.zeros(count, dtype=wp.uint8, device=device)
    launch(straddle_kernel, count, [mesh.triangles, vertices.status, kind], device, threads)
    ids, clipped = compact.padded(kind, STRADDLING)
    n = len(ids)
    sides = Straddling(
        wp.zeros(n, dtype=wp.vec3i, device=device),
        wp.empty(2 * n, dtype=wp.vec3, device=device),
        wp.empty(2 * n, dtype=wp.vec3i, device=device),
        wp.zeros(2 * n, dtype=int, device=device),
    )
    if n:
        edges = wp.empty(2 * n, dtype=wp.vec2i, device=device)
        launch(turn_kernel, n, [ids, mesh.triangles, vertices.status, sides.corners, edges], device, threads)
        solve_boundary(mesh.points, frame, edges, sides.boundary)
        screen = wp.empty(5 * n + 1, dtype=wp.vec4, device=device)
        planes = wp.zeros(2 * n, dtype=wp.vec3i, device=device)
        inputs = [ids, mesh.triangles, vertices.screen, vertices.status, sides.corners, sides.boundary, gbuffer.view]
        outputs = [screen, sides.triangles, sides.owners, planes]
        launch(sides_kernel, n, inputs + outputs, device, threads)
        raster.rasterise(
            target,
            screen,
            sides.triangles,
            ids=sides.owners,
            points=mesh.points,
            plane_triangles=planes,
            threads=threads,
            kernels=settings.kernels,
        )
    return sides, clipped, compact.counted(kind, FAILED)
