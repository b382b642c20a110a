"""Reflection points by an explosion map: the historical baseline of the accuracy/time curves.

Source: Ofek and Rappoport, "Interactive Reflections on Curved Objects" (1998), as told in Akenine-Moller, Haines, Hoffman,
"Real-Time Rendering", 3rd edition, section 9.3.1, and in the SIGGRAPH'99 course notes on OpenGL, section 11.1.3. For each
eye the mirror's vertices send their reflected rays to a far sphere; a picture of that sphere holds which mirror triangle
reflects into each direction. A scene vertex looks its direction up, is placed between the three rays of that triangle, and
is mirrored in the tangent plane that the triangle's corners give.

What differs: the picture says the truth for points on the far sphere alone, and the nearer a vertex the more it errs
(parallax, which no resolution mends). `explosion_walk` > 0 walks from the triangle found to the neighbour across the edge
that the vertex lies beyond; 0 is the paper's far map. The answer is as good as the mirror's tessellation and is not
iterated: a vertex that has one is CONVERGED, its residual says how wrong it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.bodies import weld
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector, project
from warp_reflect.optics import mirror_point, specular_residual
from warp_reflect.raster import Picture, make_target, rasterise, resolve_kernel
from warp_reflect.scene import PartRange, Scene
from warp_reflect.segments import part_mesh
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.techniques import forward
from warp_reflect.techniques.vertices import SolveFrame, VertexView, edge_reach
from warp_reflect.topology import edge_neighbours

wp.set_module_options({"enable_backward": False})

DISC_NODES = 512  # texels along the disc map; 256 and 1024 give the same error, which is parallax
FAR_SIZES = 2.0  # radius of the far sphere in diagonals of the scene
RIM_Z = -0.98  # directions with less along the axis to the eye lie on the disc's rim, where triangles wrap around
NORMAL_MEAN_MIN = (
    0.95  # length of a vertex's mean corner normal; below it the mirror has an edge that one normal rounds off
)
SECANT_STEPS = wp.constant(12)
SECANT_SHARE = wp.constant(1.0e-6)  # of the distance: a smaller step changes nothing
OUTSIDE = wp.constant(-1.0e-3)  # least barycentric weight of a point that counts as inside its cell
HOLE_STEPS = wp.constant(64)  # towards the disc's centre from a texel that no triangle covers
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))


@wp.struct
class ExplosionView:
    """The mirror's mesh with one eye's reflected rays, in the unit frame, and the disc map of its triangles."""

    point: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    ray: wp.array(dtype=wp.vec3)  # unit reflected directions
    triangle: wp.array(dtype=wp.vec3i)
    neighbour: wp.array(dtype=wp.vec3i)  # across each edge (v0v1, v1v2, v2v0)
    front: wp.array(dtype=wp.uint8)  # per triangle: 1 where a corner faces the eye
    disc: wp.array(dtype=int)  # triangle per texel, -1 none
    nodes: int
    x: wp.vec3  # axes of the disc map; z towards the eye
    y: wp.vec3
    z: wp.vec3
    walk: int


@wp.struct
class ExplosionHit:
    """A point of the mirror as the barycentric mean of a triangle's corners."""

    p: wp.vec3
    n: wp.vec3
    found: int  # 0: nothing reflects there


@dataclass(frozen=True)
class Prepared:
    """The mirror's welded mesh in its unit frame (centre at 0, largest half extent 1).

    Attributes:
        unit_from_scene: float64 [4, 4], a similarity.
        points, normals: float64 [n, 3].
        triangles: int32 [m, 3], over the welded points.
        least_curvature: Of an ellipsoid with the body's extents. [1/unit]
    """

    reflector: Reflector
    unit_from_scene: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    neighbours: wp.array
    device_triangles: wp.array
    least_curvature: float

    @property
    def bytes(self) -> int:
        return self.points.nbytes + self.normals.nbytes + 2 * self.triangles.nbytes


@wp.func
def disc_cell(map: ExplosionView, direction: wp.vec3) -> wp.vec2:
    """Texel coordinates of a direction: (1 + x / sqrt(2 (z + 1))) / 2 of the disc, likewise y."""
    d = wp.normalize(direction)
    scale = 1.0 / wp.sqrt(wp.max(2.0 * (wp.dot(d, map.z) + 1.0), 1.0e-12))
    half = 0.5 * float(map.nodes)
    return wp.vec2(half + half * scale * wp.dot(d, map.x), half + half * scale * wp.dot(d, map.y))


@wp.func
def look_up(map: ExplosionView, target: wp.vec3) -> int:
    """The triangle of a direction; with a walk to follow, the nearest one towards the disc's centre."""
    c = disc_cell(map, target)
    middle = 0.5 * float(map.nodes)
    steps = wp.where(map.walk > 0, HOLE_STEPS, 1)
    for k in range(steps):
        t = float(k) / float(HOLE_STEPS)
        i = wp.clamp(int(c[0] + t * (middle - c[0])), 0, map.nodes - 1)
        j = wp.clamp(int(c[1] + t * (middle - c[1])), 0, map.nodes - 1)
        triangle = map.disc[j * map.nodes + i]
        if triangle >= 0:
            return triangle
    return -1


@wp.func
def above(map: ExplosionView, t: wp.vec3i, target: wp.vec3, s: float) -> float:
    """Volume of the target over the plane of the three rays' points at length s, relative to their area."""
    a = map.point[t[0]] + s * map.ray[t[0]] - target
    b = map.point[t[1]] + s * map.ray[t[1]] - target
    c = map.point[t[2]] + s * map.ray[t[2]] - target
    n = wp.cross(b - a, c - a)
    return wp.dot(a, n) / wp.max(wp.length(n), 1.0e-30)


@wp.func
def explode(map: ExplosionView, eye: wp.vec3, target: wp.vec3) -> ExplosionHit:
    """The mirror point that a target is seen in."""
    hit = ExplosionHit()
    triangle = look_up(map, target)
    hops = int(0)
    while triangle >= 0:
        t = map.triangle[triangle]
        # Where along the rays their plane holds the target: the secant method, from the distance to the middle.
        s0 = wp.length(target - (map.point[t[0]] + map.point[t[1]] + map.point[t[2]]) / 3.0)
        s1 = 0.9 * s0
        f0 = above(map, t, target, s0)
        for _ in range(SECANT_STEPS):
            f1 = above(map, t, target, s1)
            change = f1 - f0
            if wp.abs(change) < 1.0e-20 or wp.abs(s1 - s0) < SECANT_SHARE * s0:
                break
            next = wp.clamp(s1 - f1 * (s1 - s0) / change, 0.0, 4.0 * wp.max(s0, s1))
            s0 = s1
            f0 = f1
            s1 = next
        a = map.point[t[0]] + s1 * map.ray[t[0]]
        b = map.point[t[1]] + s1 * map.ray[t[1]]
        c = map.point[t[2]] + s1 * map.ray[t[2]]
        n = wp.cross(b - a, c - a)
        area = wp.max(wp.dot(n, n), 1.0e-30)
        w0 = wp.dot(wp.cross(c - b, target - b), n) / area
        w1 = wp.dot(wp.cross(a - c, target - c), n) / area
        w2 = 1.0 - w0 - w1
        least = wp.min(w0, wp.min(w1, w2))
        if least >= OUTSIDE or map.walk == 0 or hops >= map.walk:
            hit.p = w0 * map.point[t[0]] + w1 * map.point[t[1]] + w2 * map.point[t[2]]
            hit.n = wp.normalize(w0 * map.normal[t[0]] + w1 * map.normal[t[1]] + w2 * map.normal[t[2]])
            facing = wp.dot(hit.n, eye - hit.p) > 0.0 and wp.dot(hit.n, target - hit.p) > 0.0
            if facing and wp.length(hit.p) < 2.0:
                hit.found = 1
            return hit
        # Corner 0 lies opposite to edge 1 (v1v2), corner 1 to edge 2, corner 2 to edge 0.
        edge = int(1)
        if w1 == least:
            edge = 2
        elif w2 == least:
            edge = 0
        triangle = map.neighbour[triangle][edge]
        if triangle >= 0 and int(map.front[triangle]) == 0:
            return hit  # beyond the silhouette: hidden
        hops += 1
    return hit


@wp.kernel
def explosion_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    map: ExplosionView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    least_curvature: float,
    out_vertex: VertexView,
):
    """One thread per scene vertex; what comes with a status keeps it."""
    i = first + wp.tid()
    if (i >= own_first and i < own_first + own_count) or int(out_vertex.status[i]) != 0:
        return
    target = frame.unit_from_scene * points[i] + frame.unit_offset
    hit = explode(map, frame.eye, target)
    if hit.found == 0:
        out_vertex.status[i] = wp.uint8(HIDDEN)
        return
    out_vertex.status[i] = wp.uint8(CONVERGED)
    out_vertex.residual[i] = specular_residual(hit.p, hit.n, frame.eye, target)
    out_vertex.reach[i] = edge_reach(frame, hit.p, hit.n, target, least_curvature)
    virtual = frame.eye_from_unit * (mirror_point(target, hit.p, hit.n) - frame.eye)
    out_vertex.screen[i] = project(camera[0], virtual)
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[i] = virtual


@wp.kernel
def explosion_boundary_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    map: ExplosionView,
    frame: SolveFrame,
    edges: wp.array(dtype=wp.vec2i),
    steps: int,
    out_point: wp.array(dtype=wp.vec3),
):
    """One thread per edge (visible vertex, vertex that is not): the last point with an answer, eye frame."""
    i = first + wp.tid()
    if edges[i][0] < 0:
        return
    a = frame.unit_from_scene * points[edges[i][0]] + frame.unit_offset
    b = frame.unit_from_scene * points[edges[i][1]] + frame.unit_offset
    low = float(0.0)
    high = float(1.0)
    for _ in range(steps):
        middle = 0.5 * (low + high)
        hit = explode(map, frame.eye, a + middle * (b - a))
        if hit.found != 0:
            low = middle
        else:
            high = middle
    out_point[i] = frame.eye_from_unit * (a + low * (b - a) - frame.eye)


def applies(scene: Scene, reflector: Reflector) -> tuple[bool, str]:
    """A closed convex body whose vertices have one normal each."""
    body = scene.body(reflector.part)
    if not body.convex:
        return False, body.reason or "not convex: the triangles of its explosion map overlap"
    _, _, _, mean = _welded(scene, scene.parts[reflector.part])
    if mean < NORMAL_MEAN_MIN:
        return False, f"sharp edges: mean normals of length {mean:.2f} (at least {NORMAL_MEAN_MIN})"
    return True, "closed convex smooth body: its explosion map does not overlap"


def _welded(scene: Scene, part: PartRange) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """(points [n, 3], unit normals [n, 3], triangles [m, 3], shortest mean normal) of a part, seams closed."""
    points, faces, corner_normals = part_mesh(scene, part)
    faces = weld(points, faces)
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    faces, corner_normals = faces[distinct], corner_normals[distinct]
    normals = np.zeros((len(used), 3))
    np.add.at(normals, faces.reshape(-1), corner_normals.reshape(-1, 3))
    length = np.linalg.norm(normals, axis=1)
    mean = float((length / np.maximum(np.bincount(faces.reshape(-1), minlength=len(used)), 1)).min(initial=1.0))
    return points[used].astype(np.float64), normals / np.maximum(length, 1.0e-300)[:, None], faces, mean


def prepare(scene: Scene, reflector: Reflector, settings: Settings) -> Prepared:
    """The welded mesh; the map itself belongs to an eye and is made in `reflect`."""
    body = scene.body(reflector.part)
    points, normals, faces, _ = _welded(scene, scene.parts[reflector.part])
    scale = 1.0 / float(body.extent.max())
    unit_from_scene = np.eye(4)
    unit_from_scene[:3, :3] *= scale
    unit_from_scene[:3, 3] = -scale * body.centre
    return Prepared(
        reflector,
        unit_from_scene,
        (points - body.centre) * scale,
        normals,
        faces,
        wp.array(edge_neighbours(faces), dtype=wp.vec3i, device=scene.device),
        wp.array(faces, dtype=wp.vec3i, device=scene.device),
        float(body.extent.min() / body.extent.max() ** 2) / scale,
    )


def explosion_view(prepared: Prepared, eye: np.ndarray, far: float, walk: int, device) -> ExplosionView:
    """The explosion map of one eye.

    Args:
        eye: Float [3], unit frame.
        far: Radius of the far sphere about the mirror's centre, unit frame.
        walk: Neighbours a look-up may walk over.
    """
    points, normals, faces = prepared.points, prepared.normals, prepared.triangles
    from_eye = points - eye
    from_eye /= np.maximum(np.linalg.norm(from_eye, axis=1, keepdims=True), 1.0e-300)
    cosine = np.einsum("ij,ij->i", from_eye, normals)
    # A vertex behind the silhouette lets the line of sight pass: so do the points of the silhouette itself.
    rays = from_eye - 2.0 * np.minimum(cosine, 0.0)[:, None] * normals
    along = np.einsum("ij,ij->i", points, rays)
    reach = -along + np.sqrt(np.maximum(along**2 + far**2 - np.einsum("ij,ij->i", points, points), 0.0))
    direction = points + reach[:, None] * rays
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1.0e-300)
    z = eye / max(float(np.linalg.norm(eye)), 1.0e-300)
    x = np.cross(np.eye(3)[np.abs(z).argmin()], z)
    x /= max(float(np.linalg.norm(x)), 1.0e-300)
    y = np.cross(z, x)
    view = ExplosionView()
    view.point = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    view.normal = wp.array(normals.astype(np.float32), dtype=wp.vec3, device=device)
    view.ray = wp.array(rays.astype(np.float32), dtype=wp.vec3, device=device)
    view.triangle, view.neighbour = prepared.device_triangles, prepared.neighbours
    front = (cosine < 0.0)[faces].any(axis=1)
    view.front = wp.array(front.astype(np.uint8), dtype=wp.uint8, device=device)
    view.nodes, view.walk = DISC_NODES, walk
    view.x, view.y, view.z = (wp.vec3(*axis) for axis in (x, y, z))
    view.disc = _draw_disc(direction, np.stack([x, y, z]), faces, front, device)
    return view


def _draw_disc(direction, axes, faces, front, device) -> wp.array:
    """Triangle per texel of the disc map, int32 [DISC_NODES^2], -1 none."""
    local = direction @ axes.T
    scale = 1.0 / np.sqrt(np.maximum(2.0 * (local[:, 2] + 1.0), 1.0e-12))
    screen = np.ones((len(direction), 4), np.float32)
    screen[:, :2] = 0.5 * DISC_NODES * (1.0 + local[:, :2] * scale[:, None])
    drawn = np.flatnonzero(front & (local[:, 2] > RIM_Z)[faces].all(axis=1)).astype(np.int32)
    picture = Picture((DISC_NODES, DISC_NODES), near=1.0e-3, far=1.0e3)
    target = make_target(picture, (0, 0, DISC_NODES, DISC_NODES), device)
    count = DISC_NODES * DISC_NODES
    disc = wp.full(count, -1, dtype=int, device=device)
    if len(drawn):
        rasterise(
            target,
            wp.array(screen, dtype=wp.vec4, device=device),
            wp.array(faces[drawn], dtype=wp.vec3i, device=device),
            ids=wp.array(drawn, dtype=int, device=device),
        )
        launch(resolve_kernel, count, [target.key, disc, wp.empty(count, dtype=float, device=device)], device)
    return disc


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Make the eye's explosion map, look every vertex up, draw, refine: see `forward.reflect`."""
    part = scene.parts[prepared.reflector.part]
    matrix = prepared.unit_from_scene
    eye = matrix[:3, :3] @ (camera.eye - scene.origin) + matrix[:3, 3]
    far = FAR_SIZES * scene.size * float(matrix[0, 0])
    map = explosion_view(prepared, eye, far, settings.explosion_walk, scene.device)

    def solve_vertices(points, has_own: bool, frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        own = forward.own_vertices(part) if has_own else [0, 0]
        inputs = [points, *own, map, frame, gbuffer.view, prepared.least_curvature, out_vertex]
        launch(explosion_kernel, len(points), inputs, scene.device, settings.threads)

    def solve_boundary(points, frame: SolveFrame, edges: wp.array, out_point: wp.array) -> None:
        inputs = [points, map, frame, edges, forward.BOUNDARY_STEPS[settings.refine], out_point]
        launch(explosion_boundary_kernel, len(edges), inputs, scene.device, settings.threads)

    return forward.reflect(
        scene,
        prepared.reflector,
        Technique.EXPLOSION_MAP,
        matrix,
        solve_vertices,
        solve_boundary,
        gbuffer,
        pixels,
        camera,
        settings,
        history,
    )
