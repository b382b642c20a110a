"""Quadrics on which one vertex appears several times (a bowl from within, a saddle): one virtual mesh per branch.

A scene point has up to ten reflection points on such a mirror. They fall into branches by Morse index, the number of
negative eigenvalues of the path length's Hessian: 0 upright, 1 mirrored, 2 upside down (algorithms of catastrophe optics;
Estalella et al. 2005, section 8, leave concave mirrors open). Every branch is drawn into the same z-buffer from those
triangles all of whose corners have it. Branches end at caustics: around the corners of triangles that one crosses,
nothing is trusted and the BVH decides.

The roots of a vertex: the gradient of the path length is read at a lattice of eye rays over the mirror's pixels; cells of
the lattice around which it turns start Newton's method. Only what the eye can see is searched, whatever the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, compact, raster
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector, project
from warp_reflect.optics import tangent_basis
from warp_reflect.quadrics import CanonicalQuadric, quadric_curve, quadric_half_gradient, quadric_value
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.techniques import forward, refine, virtual_mesh
from warp_reflect.techniques.quadric_patch import similarity
from warp_reflect.techniques.vertices import (
    ESTIMATE,
    SolveFrame,
    VertexView,
    copy_vertices,
    empty_vertices,
    solve_frame,
    vertices_from,
    virtual_vertex,
)
from warp_reflect.techniques.virtual_mesh import Drawn, VirtualMesh
from warp_reflect.timing import StageTimer

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

BRANCHES = 3  # Morse indices
NODES = 17  # of the lattice along each side of the mirror's pixels; at half of it a root in a hundred is missed
MARGIN = 0.15  # of the box: roots beside the mirror's pixels are the corners of triangles that reach into them
CELL_SLACK = wp.constant(0.15)  # barycentric; a root near a cell's border may interpolate to just outside of it
NEWTON_STEPS = wp.constant(10)
STEP_MAX = wp.constant(0.25)  # of the unit
TOLERANCE = wp.constant(4.0e-6)  # angle
ACCEPTED = wp.constant(1.0e-3)  # angle above which a start led to no root
NO_NODE = wp.constant(1.0e30)
FOLD_STEP = 2.5  # of the edge before it: how far a picture reaches on towards a fold, see `_add_doubt`
FOLD_REACH = 2.0  # the fold of a caustic lies within twice the straight extrapolation of an edge that crosses it
FOLD_BUDGET = 4000  # triangles that cutting at folds may add to a branch: each costs a search
FOLLOW_ROUNDS = 2  # rings of vertices beyond what the lattice found
CONVERGED = wp.constant(int(Status.CONVERGED))
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
NODE_COUNT = wp.constant(NODES)

_row = wp.types.vector(length=NODES, dtype=wp.float32)


@wp.struct
class BranchView:
    """A quadric in its unit principal frame, its half gradient on the reflecting side, and the lattice of eye rays."""

    a: wp.vec3
    b: float
    c: float
    point: wp.array(dtype=wp.vec3)  # [NODES * NODES], on the quadric
    tangent_x: wp.array(dtype=wp.vec3)  # along the screen's axes, up to a positive factor
    tangent_y: wp.array(dtype=wp.vec3)
    slope: wp.array(dtype=wp.vec3)  # (tangent_x . o, tangent_y . o, 1 where the eye meets the quadric)
    normal: wp.array(dtype=wp.vec3)
    bounds: wp.vec4  # of the lattice: x0, y0, x1, y1 [pixels]


@wp.struct
class Root:
    point: wp.vec3
    normal: wp.vec3
    index: int
    least: float  # smallest absolute eigenvalue of the Hessian
    angle: float
    length: float
    valid: int


@wp.func
def polish(view: BranchView, eye: wp.vec3, target: wp.vec3, start: wp.vec3) -> Root:
    """Newton's method on the stationary path length, with signed curvature."""
    root = Root()
    root.angle = 4.0
    p = start
    steps = int(0)
    while steps < NEWTON_STEPS:
        steps += 1
        # Back onto the surface: what is left of the distance is its square, and the next step takes that.
        g = quadric_half_gradient(p, view.a, view.b)
        p = p - (0.5 * quadric_value(p, view.a, view.b, view.c) / wp.max(wp.dot(g, g), 1.0e-20)) * g
        n = quadric_half_gradient(p, view.a, view.b)
        n_length = wp.max(wp.length(n), 1.0e-20)
        n = n / n_length
        to_o = eye - p
        to_v = target - p
        l_o = wp.max(wp.length(to_o), 1.0e-20)
        l_v = wp.max(wp.length(to_v), 1.0e-20)
        o = to_o / l_o
        v = to_v / l_v
        t1, t2 = tangent_basis(n)
        o1 = wp.dot(o, t1)
        o2 = wp.dot(o, t2)
        v1 = wp.dot(v, t1)
        v2 = wp.dot(v, t2)
        c_o = wp.dot(o, n)
        c_v = wp.dot(v, n)
        i_o = 1.0 / l_o
        i_v = 1.0 / l_v
        bend = (c_o + c_v) / n_length
        h11 = (o2 * o2 + c_o * c_o) * i_o + (v2 * v2 + c_v * c_v) * i_v + bend * quadric_curve(t1, t1, view.a)
        h22 = (o1 * o1 + c_o * c_o) * i_o + (v1 * v1 + c_v * c_v) * i_v + bend * quadric_curve(t2, t2, view.a)
        h12 = bend * quadric_curve(t1, t2, view.a) - o1 * o2 * i_o - v1 * v2 * i_v
        g1 = o1 + v1
        g2 = o2 + v2
        tangential = wp.sqrt(g1 * g1 + g2 * g2)
        angle = tangential / wp.max(tangential + c_o + c_v, 1.0e-6)
        mean = 0.5 * (h11 + h22)
        spread = wp.sqrt(0.25 * (h11 - h22) * (h11 - h22) + h12 * h12)
        root.point = p
        root.normal = n
        root.angle = angle
        root.length = l_o + l_v
        root.index = wp.where(mean - spread < 0.0, 1, 0) + wp.where(mean + spread < 0.0, 1, 0)
        root.least = wp.min(wp.abs(mean - spread), wp.abs(mean + spread))
        root.valid = wp.where(angle <= ACCEPTED and c_o > 0.0 and c_v > 0.0, 1, 0)
        det = h11 * h22 - h12 * h12
        if angle <= TOLERANCE or det == 0.0:
            return root
        d1 = (h22 * g1 - h12 * g2) / det
        d2 = (h11 * g2 - h12 * g1) / det
        shrink = wp.min(1.0, STEP_MAX / wp.max(wp.sqrt(d1 * d1 + d2 * d2), 1.0e-20))
        p = p + shrink * (d1 * t1 + d2 * t2)
    return root


@wp.func
def write_root(frame: SolveFrame, camera: CameraView, root: Root, target: wp.vec3, i: int, out_vertex: VertexView):
    out_vertex.status[i] = wp.uint8(CONVERGED)
    out_vertex.residual[i] = root.angle
    out_vertex.seed[i] = root.point
    d_o = wp.length(frame.eye - root.point)
    d_v = wp.length(target - root.point)
    out_vertex.reach[i] = d_v * wp.sqrt(ESTIMATE * d_o * root.least)
    out_vertex.screen[i] = project(camera, virtual_vertex(frame, root.point, root.normal, target))
    # What `drift` holds here: how far the reflection point moves per length of the vertex, seen from the eye.
    out_vertex.drift[i] = 1.0 / wp.max(d_o * d_v * root.least, 1.0e-20)


@wp.kernel
def search_branches_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    view: BranchView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    # Outputs:
    out_upright: VertexView,
    out_mirrored: VertexView,
    out_turned: VertexView,
):
    """One thread per scene vertex: of each index the root with the shortest path."""
    i = first + wp.tid()
    if i >= own_first and i < own_first + own_count:
        return
    out_upright.status[i] = wp.uint8(UNREFLECTED)
    out_mirrored.status[i] = wp.uint8(UNREFLECTED)
    out_turned.status[i] = wp.uint8(UNREFLECTED)
    target = frame.unit_from_scene * points[i] + frame.unit_offset
    shortest_0 = float(1.0e30)
    shortest_1 = float(1.0e30)
    shortest_2 = float(1.0e30)
    # A point close to the mirror is seen beside its foot, where the lattice's cells are too coarse.
    near = polish(view, frame.eye, target, target)
    if near.valid != 0 and near.index == 0:
        shown = project(camera[0], frame.eye_from_unit * (near.point - frame.eye))
        bounds = view.bounds
        # Beside the lattice it would be the one corner of its triangles that is known.
        inside = shown[0] > bounds[0] and shown[0] < bounds[2] and shown[1] > bounds[1] and shown[1] < bounds[3]
        if inside and shown[2] > 0.0:
            shortest_0 = near.length
            write_root(frame, camera[0], near, target, i, out_upright)
    above_x = _row()
    above_y = _row()
    y = int(0)
    while y < NODE_COUNT:
        left_x = float(NO_NODE)
        left_y = float(0.0)
        corner_x = float(NO_NODE)
        corner_y = float(0.0)
        x = int(0)
        while x < NODE_COUNT:
            k = y * NODE_COUNT + x
            gx = float(NO_NODE)
            gy = float(0.0)
            slope = view.slope[k]
            to_v = target - view.point[k]
            if slope[2] > 0.0 and wp.dot(to_v, view.normal[k]) > 0.0:
                v = wp.normalize(to_v)
                gx = slope[0] + wp.dot(view.tangent_x[k], v)
                gy = slope[1] + wp.dot(view.tangent_y[k], v)
            over_x = above_x[x]
            over_y = above_y[x]
            if x > 0 and y > 0 and over_x != NO_NODE and left_x != NO_NODE:
                # Two triangles share the diagonal from the left node to the one above.
                half = int(0)
                while half < 2:
                    ax = wp.where(half == 0, gx, corner_x)
                    ay = wp.where(half == 0, gy, corner_y)
                    at = wp.where(half == 0, k, k - NODE_COUNT - 1)
                    half += 1
                    if ax != NO_NODE:
                        wa = over_x * left_y - over_y * left_x
                        wb = left_x * ay - left_y * ax
                        wc = ax * over_y - ay * over_x
                        total = wa + wb + wc
                        if total != 0.0:
                            wa = wa / total
                            wb = wb / total
                            wc = wc / total
                            if wa >= -CELL_SLACK and wb >= -CELL_SLACK and wc >= -CELL_SLACK:
                                start = wa * view.point[at] + wb * view.point[k - NODE_COUNT] + wc * view.point[k - 1]
                                root = polish(view, frame.eye, target, start)
                                if root.valid != 0:
                                    if root.index == 0 and root.length < shortest_0:
                                        shortest_0 = root.length
                                        write_root(frame, camera[0], root, target, i, out_upright)
                                    elif root.index == 1 and root.length < shortest_1:
                                        shortest_1 = root.length
                                        write_root(frame, camera[0], root, target, i, out_mirrored)
                                    elif root.index == 2 and root.length < shortest_2:
                                        shortest_2 = root.length
                                        write_root(frame, camera[0], root, target, i, out_turned)
            corner_x = over_x
            corner_y = over_y
            above_x[x] = gx
            above_y[x] = gy
            left_x = gx
            left_y = gy
            x += 1
        y += 1


@wp.kernel
def follow_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    view: BranchView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    pairs: wp.array(dtype=wp.vec2i),
    branch: int,
    out_vertex: VertexView,
):
    """One thread per (vertex without the branch, neighbour with it): the neighbour's root, followed to the vertex."""
    k = first + wp.tid()
    i = pairs[k][0]
    target = frame.unit_from_scene * points[i] + frame.unit_offset
    root = polish(view, frame.eye, target, out_vertex.seed[pairs[k][1]])
    if root.valid != 0 and root.index == branch:
        write_root(frame, camera[0], root, target, i, out_vertex)


@dataclass(frozen=True)
class Prepared:
    """One side of a quadric on which reflection points compete.

    Attributes:
        reflector: The mirror; its id is what the mask holds at the patch's pixels.
        quadric: World is the scene frame.
        side: 1: out of the canonical body reflects; -1: its inside.
        unit_from_scene: float64 [4, 4], a similarity.
    """

    reflector: Reflector
    quadric: CanonicalQuadric
    side: int
    unit_from_scene: np.ndarray
    bytes: int = 0


def prepare_side(reflector: Reflector, quadric: CanonicalQuadric, side: int) -> Prepared:
    """One side of a quadric patch."""
    return Prepared(reflector, quadric, side, similarity(quadric))


def lattice(scene: Scene, prepared: Prepared, camera: Camera, box: tuple[int, int, int, int]) -> BranchView:
    """The device form of a side and the eye rays over a pixel box that meet it."""
    quadric = prepared.quadric
    a, b, c = (prepared.side * x for x in (quadric.lam, quadric.b, quadric.c))
    linear = prepared.unit_from_scene[:3, :3]
    eye = linear @ (camera.eye - scene.origin) + prepared.unit_from_scene[:3, 3]
    x0, y0, x1, y1 = box
    margin_x, margin_y = (1.0 + MARGIN * (x1 - x0), 1.0 + MARGIN * (y1 - y0))
    x, y = np.meshgrid(
        np.linspace(x0 - margin_x, x1 + margin_x, NODES), np.linspace(y0 - margin_y, y1 + margin_y, NODES)
    )
    dx, dy = linear @ camera.right / camera.fx, -linear @ camera.up / camera.fy
    corner = linear @ camera.forward - camera.cx * dx - camera.cy * dy
    d = corner + x.reshape(-1, 1) * dx + y.reshape(-1, 1) * dy
    # f(s) = q(eye + s d); the side reflects where q falls along the ray: the root with a negative derivative.
    qa = (d * d) @ a
    qb = d @ (a * eye) + b * d[:, 2]
    qc = float(a @ (eye * eye) + 2.0 * b * eye[2] + c)
    disc = qb * qb - qa * qc
    root = np.sqrt(np.maximum(disc, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        s = np.where(qb > 0.0, -(qb + root) / qa, qc / (root - qb))
    valid = (disc > 0.0) & np.isfinite(s) & (s > 0.0)
    s = np.where(valid, s, 0.0)
    p = eye + s[:, None] * d
    n = p * a + [0.0, 0.0, b]
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1.0e-300)
    along = np.einsum("ij,ij->i", n, d)
    # dP/dx times -(n . d) > 0, which vanishes at the silhouette where dP/dx itself grows without bound.
    tangent = [s[:, None] * ((n @ e)[:, None] * d - along[:, None] * e) for e in (dx, dy)]
    scale = max(float(np.abs(tangent).max()), 1.0e-300)
    tangent = [t / scale for t in tangent]
    o = -d / np.linalg.norm(d, axis=1, keepdims=True)
    slope = np.stack([np.einsum("ij,ij->i", t, o) for t in tangent] + [valid.astype(float)], 1)
    view = BranchView()
    view.a = wp.vec3(*a)
    view.b = float(b)
    view.c = float(c)
    view.bounds = wp.vec4(x.min(), y.min(), x.max(), y.max())
    for name, rows in zip(("point", "tangent_x", "tangent_y", "slope", "normal"), (p, *tangent, slope, n), strict=True):
        setattr(view, name, wp.array(rows.astype(np.float32), dtype=wp.vec3, device=scene.device))
    return view


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Search the branches of every vertex, see `reflect_branches`."""
    part = scene.parts[prepared.reflector.part]
    if pixels.count == 0:
        return ReflectionLayer.empty(pixels, Technique.QUADRIC, scene.device)
    frame = solve_frame(scene, camera, prepared.unit_from_scene)
    view = lattice(scene, prepared, camera, pixels.box)

    def solve(points, has_own: bool) -> list[VertexView]:
        answers = [empty_vertices(len(points), scene.device, with_position=True) for _ in range(BRANCHES)]
        own = forward.own_vertices(part) if has_own else [0, 0]
        inputs = [points, *own, view, frame, gbuffer.view, *answers]
        launch(search_branches_kernel, len(points), inputs, scene.device, settings.threads)
        return answers

    def follow(points, pairs: wp.array, branch: int, vertices: VertexView) -> None:
        inputs = [points, view, frame, gbuffer.view, pairs, branch, vertices]
        launch(follow_kernel, len(pairs), inputs, scene.device, settings.threads)

    return reflect_branches(
        scene,
        prepared.reflector,
        Technique.QUADRIC,
        prepared.unit_from_scene,
        solve,
        follow,
        gbuffer,
        pixels,
        camera,
        settings,
    )


def reflect_branches(
    scene: Scene,
    reflector: Reflector,
    technique: int,
    unit_from_scene: np.ndarray,
    solve: Callable,
    follow: Callable,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
) -> ReflectionLayer:
    """Search, cut, draw every branch into one z-buffer, refine.

    Args:
        technique: `Technique` of the answer.
        unit_from_scene: float64 [4, 4] similarity into the solver's frame.
        solve: (points, whether they are the scene's vertices) -> one VertexView per branch, see `write_root`.
        follow: (points, pairs vec2i of a vertex without the branch and one with it, branch, vertices in and out).
    """
    part = scene.parts[reflector.part]
    layer = ReflectionLayer.empty(pixels, technique, scene.device)
    timer = StageTimer(scene.device)
    frame = solve_frame(scene, camera, unit_from_scene)
    unit_per_scene = float(np.cbrt(abs(np.linalg.det(unit_from_scene[:3, :3]))))

    with timer("search"):
        whole = virtual_mesh.whole(scene, part)
        solved = solve(whole.points, True)
    branches = []
    with timer("tessellate"):
        for k, vertices in enumerate(solved):

            def solve_into(points, has_own, frame, warm, out_vertex, k=k) -> None:
                copy_vertices(out_vertex, solve(points, has_own)[k], len(points))

            mesh, vertices = forward.cut_where_bent(
                scene, part, whole, vertices, frame, solve_into, unit_per_scene, camera, pixels, settings
            )
            _follow(mesh, vertices, k, follow)
            finer = _cut_at_folds(scene, part, mesh, vertices)
            if finer is not mesh:
                mesh, known = finer, empty_vertices(finer.vertex_count, scene.device, with_position=True)
                base = mesh.base_count
                copy_vertices(known, vertices, base)
                solve_into(mesh.points[base:], False, frame, False, vertices_from(known, base))
                vertices = known
                _follow(mesh, vertices, k, follow)
            branches.append((mesh, vertices))
        layer.virtual = [Drawn(pixels, mesh, vertices.screen) for mesh, vertices in branches]
    with timer("virtual_raster"):
        target = raster.make_target(gbuffer.camera, pixels.box, scene.device, gbuffer.reflector_id, reflector.id)
        if settings.refine != "off":
            raster.attach_rays(target, gbuffer.view, pixels, settings.threads, settings.kernels)
        drawn = offset = 0
        doubt = np.zeros((target.box[3] - target.box[1] + 1, target.box[2] - target.box[0] + 1), np.int64)
        for k, (mesh, vertices) in enumerate(branches):
            survivors = raster.rasterise(
                target,
                vertices.screen,
                mesh.triangles,
                id_offset=offset,
                points=mesh.points,
                threads=settings.threads,
                kernels=settings.kernels,
            )
            drawn += int(survivors.numpy().sum())
            offset += len(mesh.triangles)
            solved = vertices.status.numpy() == int(Status.CONVERGED)
            _add_doubt(doubt, mesh, vertices, solved, k, solve, unit_per_scene, camera, target.box)
        together = _together([mesh for mesh, _ in branches], settings.refine == "off")
    layer.statistics.update(vertices=sum(mesh.vertex_count for mesh, _ in branches), drawn=drawn)
    if settings.refine == "off":
        with timer("candidates"):
            screen = wp.array(
                np.concatenate([vertices.screen.numpy() for _, vertices in branches]),
                dtype=wp.vec4,
                device=scene.device,
            )
            launch(
                forward.candidate_hits_kernel,
                pixels.count,
                [scene.view, gbuffer.view, target.view, screen, pixels.pixel, pixels.point, pixels.direction]
                + [together.points, together.triangles, together.parents]
                + [layer.triangle, layer.u, layer.v, layer.distance, layer.status],
                scene.device,
                settings.threads,
            )
        layer.statistics.update(candidate=pixels.count)
        layer.timings = timer.ms
        return layer
    with timer("own_body"):
        blocked = bvh.own_obstacles(scene, gbuffer, pixels, reflector.part, settings.threads)
        pixel = pixels.pixel.numpy()
        covered = doubt.cumsum(axis=0).cumsum(axis=1) > 0
        width = gbuffer.camera.size[0]
        doubtful = covered[pixel // width - target.box[1], pixel % width - target.box[0]]
        blocked = wp.array(np.maximum(blocked.numpy(), doubtful).astype(np.uint8), dtype=wp.uint8, device=scene.device)
    with timer("refine"):
        caution = refine.fixed_caution(False, False, scene.device)
        seen = scene.seen_in(part)
        left = refine.settle(scene, gbuffer, pixels, target, together, layer, blocked, settings, caution, seen)
    with timer("trace"):
        how = {"threads": settings.threads, "kernels": settings.kernels}
        bvh.trace_pixels(scene, gbuffer, pixels, layer, reflector.part, reflector.convex, left, **how)
    layer.statistics.update(doubt=int(doubtful.sum()))
    layer.timings = timer.ms
    return layer


def _follow(mesh: VirtualMesh, vertices: VertexView, branch: int, follow: Callable) -> None:
    """Give triangles that lack a branch at some corners what can be followed from the others.

    The lattice misses roots beyond its border, and pairs of roots that lie in one of its cells.
    """
    device = mesh.points.device
    for _ in range(FOLLOW_ROUNDS):
        solved = vertices.status.numpy() == int(Status.CONVERGED)
        corner = solved[mesh.host_triangles]
        partly = np.flatnonzero(corner.any(axis=1) & ~corner.all(axis=1))
        triangle, has = mesh.host_triangles[partly], corner[partly]
        known = np.take_along_axis(triangle, has.argmax(axis=1)[:, None], 1)
        missing, first = np.unique(triangle[~has], return_index=True)
        if not len(missing):
            return
        pairs = np.stack([missing, np.broadcast_to(known, triangle.shape)[~has][first]], 1).astype(np.int32)
        follow(mesh.points, wp.array(pairs, dtype=wp.vec2i, device=device), branch, vertices)


def _cut_at_folds(scene: Scene, part, mesh: VirtualMesh, vertices: VertexView) -> VirtualMesh:
    """The mesh with the scene triangles that a fold crosses cut as finely as may be; the mesh itself if there is none."""
    corner = (vertices.status.numpy() == int(Status.CONVERGED))[mesh.host_triangles]
    partly = np.unique(mesh.host_parents[corner.any(axis=1) & ~corner.all(axis=1)])
    if not len(partly):
        return mesh
    cuts = np.sqrt(np.bincount(mesh.host_parents, minlength=scene.triangle_count)).round().astype(np.uint8)
    cuts = np.maximum(cuts, 1)
    finest = int(virtual_mesh.CUT_MAX)
    while finest > 1 and len(partly) * finest**2 > FOLD_BUDGET:
        finest //= 2
    if (cuts[partly] >= finest).all():
        return mesh
    cuts[partly] = np.maximum(cuts[partly], finest)
    return virtual_mesh.cut_mesh(scene, part, cuts, mesh.estimated, mesh.relaxed)


def _together(meshes: list[VirtualMesh], numbered: bool) -> VirtualMesh:
    """Several virtual meshes as one, vertices and triangles one after the other.

    Args:
        numbered: With the corners of its triangles, which refinement does not ask for.
    """
    host = np.zeros((0, 3), np.int32)
    if numbered:
        firsts = np.cumsum([0] + [mesh.vertex_count for mesh in meshes[:-1]])
        host = np.concatenate([mesh.host_triangles + n for mesh, n in zip(meshes, firsts, strict=True)])
    points, parents, patches = (
        compact.joined([getattr(mesh, name) for mesh in meshes]) for name in ("points", "parents", "patches")
    )
    return VirtualMesh(
        points,
        wp.array(host.astype(np.int32), dtype=wp.vec3i, device=parents.device),
        parents,
        patches,
        host,
        np.concatenate([mesh.host_parents for mesh in meshes]),
        len(points),
        meshes[0].estimated,
        meshes[0].relaxed,
    )


def _add_doubt(
    doubt, mesh: VirtualMesh, vertices: VertexView, solved: np.ndarray, branch: int, solve, unit_per_scene, camera, box
) -> None:
    """Mark the pixels at which the missing part of a triangle may appear that lacks the branch at one or two corners.

    Towards a fold of the caustic the picture of a corner comes to meet its picture in a branch of the next index: the
    missing part lies between the two. Where there is none, the picture ends beside the lattice, and a straight
    extrapolation along the longest edge tells how far the missing part may reach.

    Args:
        doubt: int64 [rows + 1, columns + 1], differences of a count: summed along both axes it is > 0 at such pixels.
        solved: bool [vertex_count], vertices that have the branch.
    """
    corner = solved[mesh.host_triangles]
    partly = np.flatnonzero(corner.any(axis=1) & ~corner.all(axis=1))
    if not len(partly):
        return
    triangle = mesh.host_triangles[partly]
    points = mesh.points.numpy()
    ids, place = np.unique(triangle, return_inverse=True)
    place = place.reshape(-1, 3)
    answers = solve(wp.array(points[ids], dtype=wp.vec3, device=mesh.points.device), False)
    screens = [answer.screen.numpy().astype(np.float64) for answer in answers]
    own = screens[branch]
    gap = np.zeros(len(ids))
    for other in (branch - 1, branch + 1):
        if 0 <= other < BRANCHES:
            there = screens[other][:, 2] > 0.0
            apart = np.abs(screens[other][:, :2] - own[:, :2]).max(axis=1)
            gap = np.where(there, np.maximum(gap, apart), gap)
    p = points[triangle].astype(np.float64)
    longest = np.linalg.norm(p - p[:, [1, 2, 0]], axis=2).max(axis=1) * unit_per_scene
    # Where the picture moves like the root of the distance to the fold, which lies within the next edge, it moves by at most
    # 1 / (sqrt(2) - 1) of the edge before.
    edge = mesh.host_triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    edge = edge[solved[edge].all(axis=1)]
    screen = vertices.screen.numpy()[..., :3]
    edge = edge[(screen[edge][..., 2] > 0.0).all(axis=1)]
    step = np.linalg.norm(screen[edge[:, 0], :2] - screen[edge[:, 1], :2], axis=1)
    before = np.zeros(mesh.vertex_count)
    for end in (0, 1):
        np.maximum.at(before, edge[:, end], step)
    before = np.where(before > 0.0, FOLD_STEP * before, np.inf)[triangle]
    straight = FOLD_REACH * longest[:, None] * answers[branch].drift.numpy()[place] * max(camera.fx, camera.fy)
    straight = np.minimum(straight, before)
    reach = np.where(gap[place] > 0.0, np.minimum(gap[place], straight), straight) + 1.0
    use = corner[partly] & (own[place][..., 2] > 0.0)
    x, y, r = own[place][..., 0][use], own[place][..., 1][use], reach[use]
    x0, y0, x1, y1 = box
    left, right = (np.clip(np.floor(edge), x0, x1).astype(int) - x0 for edge in (x - r, x + r + 1.0))
    top, bottom = (np.clip(np.floor(edge), y0, y1).astype(int) - y0 for edge in (y - r, y + r + 1.0))
    for row, column, sign in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        np.add.at(doubt, (row, column), sign)
