"""Sheets seen from their hollow side, in which one vertex appears several times: the map searched by branches.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 4.1 (maps) and
section 6.2 (concave pieces, which the paper searches like convex ones: one reflection point per vertex). What differs: on a
concave mirror a vertex has up to six reflection points. All that the eye can see are searched, from the cells of a lattice
of mirror pixels around which the gradient of the path length turns, by Newton's method with the map's own signed shape
operator, and sorted into branches by Morse index; `quadric_branches` draws the branches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.cubemap import project_to_cube
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.optics import tangent_basis
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView, sample_map
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.shapes import max_abs
from warp_reflect.techniques import forward
from warp_reflect.techniques.quadric_branches import BRANCHES, Root, reflect_branches, write_root
from warp_reflect.techniques.vertices import SolveFrame, VertexView, empty_vertices, solve_frame

wp.set_module_options({"enable_backward": False, "max_unroll": 2})

NODES = 17  # of the lattice along each side of the sheet's pixels; at half of it a root in a hundred is missed
CELL_SLACK = wp.constant(0.15)  # barycentric; a root near a cell's border may interpolate to just outside of it
NEWTON_STEPS = wp.constant(10)
STEP_MAX = wp.constant(0.25)  # of the whitened radius
TOLERANCE = wp.constant(1.0e-5)  # angle; the map's own error at 128 nodes is larger
ACCEPTED = wp.constant(5.0e-3)  # angle above which a start led to no root; a crease of the texels may stop it before
NO_NODE = wp.constant(1.0e30)
DET_MIN = wp.constant(1.0e-20)
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
NODE_COUNT = wp.constant(NODES)

_row = wp.types.vector(length=NODES, dtype=wp.float32)


@wp.struct
class PixelLattice:
    """Points of a sheet at a lattice of pixels, unit frame, row by row [NODES * NODES]; `there` is 0 beside the sheet."""

    point: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)  # on the eye's side
    tangent_x: wp.array(dtype=wp.vec3)  # along the screen's axes, up to a positive factor
    tangent_y: wp.array(dtype=wp.vec3)
    slope_x: wp.array(dtype=float)  # tangent_x . o, o towards the eye
    slope_y: wp.array(dtype=float)
    there: wp.array(dtype=wp.uint8)


@wp.struct
class SheetRoot:
    root: Root
    x: wp.vec3  # cube point


@wp.func
def polish(map: ReflectorMapView, side: float, eye: wp.vec3, target: wp.vec3, start: wp.vec3) -> SheetRoot:
    """Newton's method on the stationary path length from a cube point, with signed curvature.

    Args:
        side: 1 where the eye sees the sheet from outside its convex body, -1 from inside.
    """
    best = SheetRoot()
    best.root.angle = 4.0
    x = start
    steps = int(0)
    while steps < NEWTON_STEPS:
        steps += 1
        s = sample_map(map, x)
        n = side * s.n
        to_o = eye - s.p
        to_v = target - s.p
        l_o = wp.max(wp.length(to_o), 1.0e-20)
        l_v = wp.max(wp.length(to_v), 1.0e-20)
        o = to_o / l_o
        v = to_v / l_v
        t1, t2 = tangent_basis(n)
        a11 = wp.dot(t1, s.p_u)
        a12 = wp.dot(t1, s.p_v)
        a21 = wp.dot(t2, s.p_u)
        a22 = wp.dot(t2, s.p_v)
        det_p = a11 * a22 - a12 * a21
        if wp.abs(det_p) < DET_MIN:
            return best
        inv_p = side / det_p
        b11 = wp.dot(t1, s.n_u)
        b12 = wp.dot(t1, s.n_v)
        b21 = wp.dot(t2, s.n_u)
        b22 = wp.dot(t2, s.n_v)
        s11 = (b11 * a22 - b12 * a21) * inv_p
        s22 = (b22 * a11 - b21 * a12) * inv_p
        s12 = 0.5 * ((b12 * a11 - b11 * a12) + (b21 * a22 - b22 * a21)) * inv_p
        o1 = wp.dot(o, t1)
        o2 = wp.dot(o, t2)
        v1 = wp.dot(v, t1)
        v2 = wp.dot(v, t2)
        c_o = wp.dot(o, n)
        c_v = wp.dot(v, n)
        i_o = 1.0 / l_o
        i_v = 1.0 / l_v
        bend = c_o + c_v
        h11 = (1.0 - o1 * o1) * i_o + (1.0 - v1 * v1) * i_v + bend * s11
        h22 = (1.0 - o2 * o2) * i_o + (1.0 - v2 * v2) * i_v + bend * s22
        h12 = bend * s12 - o1 * o2 * i_o - v1 * v2 * i_v
        g1 = o1 + v1
        g2 = o2 + v2
        tangential = wp.sqrt(g1 * g1 + g2 * g2)
        angle = tangential / wp.max(tangential + bend, 1.0e-6)
        if angle < best.root.angle:
            mean = 0.5 * (h11 + h22)
            spread = wp.sqrt(0.25 * (h11 - h22) * (h11 - h22) + h12 * h12)
            best.x = x
            best.root.point = s.p
            best.root.normal = n
            best.root.angle = angle
            best.root.length = l_o + l_v
            best.root.index = wp.where(mean - spread < 0.0, 1, 0) + wp.where(mean + spread < 0.0, 1, 0)
            best.root.least = wp.min(wp.abs(mean - spread), wp.abs(mean + spread))
            best.root.valid = wp.where(angle <= ACCEPTED and c_o > 0.0 and c_v > 0.0, 1, 0)
        det = h11 * h22 - h12 * h12
        if angle <= TOLERANCE or det == 0.0:
            return best
        d1 = (h22 * g1 - h12 * g2) / det
        d2 = (h11 * g2 - h12 * g1) / det
        whitened = wp.cw_mul(s.p, map.inv_extent)
        move = wp.cw_mul(d1 * t1 + d2 * t2, map.inv_extent)
        cap = wp.min(1.0, STEP_MAX * wp.length(whitened) / wp.max(wp.length(move), 1.0e-30))
        # From the cube point, not from the bilinear position, whose own direction is off by h^2.
        x = project_to_cube(x * max_abs(whitened) + cap * move)
    return best


@wp.func
def write(frame: SolveFrame, camera: CameraView, found: SheetRoot, target: wp.vec3, i: int, out_vertex: VertexView):
    write_root(frame, camera, found.root, target, i, out_vertex)
    out_vertex.seed[i] = found.x


@wp.kernel
def search_sheet_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    map: ReflectorMapView,
    side: float,
    lattice: PixelLattice,
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
            if int(lattice.there[k]) != 0:
                to_v = target - lattice.point[k]
                if wp.dot(to_v, lattice.normal[k]) > 0.0:
                    v = wp.normalize(to_v)
                    gx = lattice.slope_x[k] + wp.dot(lattice.tangent_x[k], v)
                    gy = lattice.slope_y[k] + wp.dot(lattice.tangent_y[k], v)
            over_x = float(NO_NODE)
            over_y = float(0.0)
            if y > 0:
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
                                start = wa * lattice.point[at]
                                start += wb * lattice.point[k - NODE_COUNT] + wc * lattice.point[k - 1]
                                seed = project_to_cube(wp.cw_mul(start, map.inv_extent))
                                found = polish(map, side, frame.eye, target, seed)
                                if found.root.valid != 0:
                                    if found.root.index == 0 and found.root.length < shortest_0:
                                        shortest_0 = found.root.length
                                        write(frame, camera[0], found, target, i, out_upright)
                                    elif found.root.index == 1 and found.root.length < shortest_1:
                                        shortest_1 = found.root.length
                                        write(frame, camera[0], found, target, i, out_mirrored)
                                    elif found.root.index == 2 and found.root.length < shortest_2:
                                        shortest_2 = found.root.length
                                        write(frame, camera[0], found, target, i, out_turned)
            corner_x = over_x
            corner_y = over_y
            above_x[x] = gx
            above_y[x] = gy
            left_x = gx
            left_y = gy
            x += 1
        y += 1


@wp.kernel
def follow_sheet_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    map: ReflectorMapView,
    side: float,
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
    found = polish(map, side, frame.eye, target, out_vertex.seed[pairs[k][1]])
    if found.root.valid != 0 and found.root.index == branch:
        write(frame, camera[0], found, target, i, out_vertex)


@dataclass(frozen=True)
class Prepared:
    """One side of a sheet on which reflection points compete.

    Attributes:
        reflector: The mirror; its id is what the mask holds at the sheet's pixels.
        map: Of the sheet's convex body.
        side: 1: seen from outside the body; -1: from inside.
    """

    reflector: Reflector
    map: ReflectorMap
    side: int

    @property
    def bytes(self) -> int:
        return self.map.bytes


def lattice_of(scene: Scene, prepared: Prepared, pixels: MirrorPixels, camera: Camera, eye: np.ndarray) -> PixelLattice:
    """The sheet at the pixels next to a lattice over their box.

    Args:
        eye: Unit frame.
    """
    x0, y0, x1, y1 = pixels.box
    width = camera.size[0]
    pixel = pixels.pixel.numpy()
    place = np.full((y1 - y0, x1 - x0), -1)
    place[pixel // width - y0, pixel % width - x0] = np.arange(len(pixel))
    columns, rows = (np.linspace(0, n - 1, NODES) for n in (x1 - x0, y1 - y0))
    chosen = np.full((NODES, NODES), -1)
    # Of the pixels within half a cell the nearest one: the border of a sheet is none of the lattice's lines.
    reach_x, reach_y = (int(np.ceil(0.5 * max(n - 1, 1) / (NODES - 1))) for n in (x1 - x0, y1 - y0))
    offsets = [
        (dx * dx + dy * dy, dy, dx) for dy in range(-reach_y, reach_y + 1) for dx in range(-reach_x, reach_x + 1)
    ]
    for _, dy, dx in sorted(offsets):
        row, column = np.round(rows).astype(int) + dy, np.round(columns).astype(int) + dx
        inside = ((row >= 0) & (row < y1 - y0))[:, None] & ((column >= 0) & (column < x1 - x0))[None]
        seen = place[np.clip(row, 0, y1 - y0 - 1)[:, None], np.clip(column, 0, x1 - x0 - 1)[None]]
        chosen = np.where((chosen < 0) & inside, seen, chosen)
    chosen = chosen.reshape(-1)
    there = chosen >= 0
    linear = prepared.map.unit_from_body[:3, :3]
    scale = float(np.cbrt(abs(np.linalg.det(linear))))
    index = np.maximum(chosen, 0)
    p = pixels.point.numpy()[index].astype(np.float64) @ linear.T + prepared.map.unit_from_body[:3, 3]
    n = pixels.normal.numpy()[index].astype(np.float64) @ linear.T / scale
    d = p - eye
    distance = np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1.0e-300)
    d /= distance
    along = np.einsum("ij,ij->i", n, d)
    tangents = []
    for axis in (linear @ camera.right, -linear @ camera.up):
        # dP along a screen axis times -(n . d) > 0, which vanishes at the silhouette where dP itself grows without bound.
        tangents.append(distance * ((n @ axis)[:, None] * d - along[:, None] * axis))
    size = max(float(np.abs(tangents).max()), 1.0e-300)
    tangents = [t / size for t in tangents]
    result = PixelLattice()
    rows_of = {"point": p, "normal": n, "tangent_x": tangents[0], "tangent_y": tangents[1]}
    for name, values in rows_of.items():
        setattr(result, name, wp.array(values.astype(np.float32), dtype=wp.vec3, device=scene.device))
    for name, t in (("slope_x", tangents[0]), ("slope_y", tangents[1])):
        slope = -np.einsum("ij,ij->i", t, d)
        setattr(result, name, wp.array(slope.astype(np.float32), dtype=float, device=scene.device))
    result.there = wp.array((there & (along < 0.0)).astype(np.uint8), dtype=wp.uint8, device=scene.device)
    return result


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Search the branches of every vertex, see `quadric_branches.reflect_branches`."""
    part = scene.parts[prepared.reflector.part]
    if pixels.count == 0:
        return ReflectionLayer.empty(pixels, Technique.REFLECTOR_MAP, scene.device)
    frame = solve_frame(scene, camera, prepared.map.unit_from_body)
    lattice = lattice_of(scene, prepared, pixels, camera, np.array(frame.eye, np.float64))
    view, side = prepared.map.view, float(prepared.side)

    def solve(points, has_own: bool) -> list[VertexView]:
        answers = [empty_vertices(len(points), scene.device, with_position=True) for _ in range(BRANCHES)]
        own = forward.own_vertices(part) if has_own else [0, 0]
        inputs = [points, *own, view, side, lattice, frame, gbuffer.view, *answers]
        launch(search_sheet_kernel, len(points), inputs, scene.device, settings.threads)
        return answers

    def follow(points, pairs: wp.array, branch: int, vertices: VertexView) -> None:
        inputs = [points, view, side, frame, gbuffer.view, pairs, branch, vertices]
        launch(follow_sheet_kernel, len(pairs), inputs, scene.device, settings.threads)

    return reflect_branches(
        scene,
        prepared.reflector,
        Technique.REFLECTOR_MAP,
        prepared.map.unit_from_body,
        solve,
        follow,
        gbuffer,
        pixels,
        camera,
        settings,
    )
