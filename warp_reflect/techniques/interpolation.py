"""Device side of the interpolation grid: how wrong a cell is, and the vertices inside it.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 5; see `grid.py`.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.cubemap import project_to_cube
from warp_reflect.layers import CameraView, project
from warp_reflect.optics import tangent_basis
from warp_reflect.reflector_maps import MapSample, ReflectorMapView, sample_map
from warp_reflect.settings import Status
from warp_reflect.techniques.map_search import ACCEPTED, measure, newton_step, step_on_cube
from warp_reflect.techniques.vertices import ESTIMATE, SolveFrame, VertexView, edge_reach, virtual_vertex

wp.set_module_options({"enable_backward": False})

UNSAFE = wp.constant(1.0e30)  # pixels: corners of both kinds, or a cell that may reach around or into the mirror
NEAR = wp.constant(2.0e30)  # likewise, but one level less may do
# Interpolation with slopes is wrong by t (1 - t) (1 - 2 t) <= 0.1 of the residual along an edge; terms of fourth order
# raise the largest error met to this.
SLOPE_ERROR = wp.constant(0.3)
HIDDEN_CELL = wp.constant(-1.0)
SPACE_DIAGONAL = wp.constant(1.7320508)  # of a cube with edge 1
RESIDUAL_MAX = wp.constant(0.3)  # of an interpolated direction; a step from farther off is not worth its price
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))


@wp.struct
class CellTest:
    """How the error of a cell is judged."""

    pixels_per_radian: float
    unit_per_scene: float
    order: int  # of the error in the cell's edge: 2 positions, 3 with slopes, 4 directions and a step
    extent: wp.vec3  # half extents of the body, unit frame
    body_width: float  # twice the least of them
    body_radius: float  # of a ball around it
    box: wp.vec4  # of the mirror's pixels: x0, y0, x1, y1


@wp.func
def edge_residual(node: VertexView, slope: wp.array(dtype=wp.mat33), a: int, b: int, axis: int, edge: float) -> float:
    """By how much the mean of the slopes at both ends misses the change along an edge, in radians on the screen.

    h^3 / 12 of the third derivative (the trapezoidal rule); only the part across the line of sight shows.
    """
    pa = node.position[a]
    pb = node.position[b]
    ja = slope[a]
    jb = slope[b]
    half = 0.5 * edge
    mean = wp.vec3(ja[0, axis] + jb[0, axis], ja[1, axis] + jb[1, axis], ja[2, axis] + jb[2, axis])
    miss = pb - pa - half * mean
    along = wp.dot(miss, pa) / wp.max(wp.dot(pa, pa), 1.0e-30)
    return wp.length(miss - along * pa) / wp.max(wp.length(pa), 1.0e-20)


@wp.kernel
def estimate_kernel(
    first: int,
    # Cells: slots of their corners, edge (unit frame)
    corner: wp.array2d(dtype=int),
    edge: wp.array(dtype=float),
    # Nodes:
    point: wp.array(dtype=wp.vec3),
    node: VertexView,
    slope: wp.array(dtype=wp.mat33),
    frame: SolveFrame,
    test: CellTest,
    out_error: wp.array(dtype=float),
):
    """One thread per cell: estimated interpolation error [pixels], HIDDEN_CELL where no vertex has a picture."""
    i = first + wp.tid()
    h = edge[i]
    hidden = int(0)
    solved = int(0)
    error = float(0.0)
    centre = wp.vec3(0.0, 0.0, 0.0)
    left = float(1.0e30)
    right = float(-1.0e30)
    top = float(1.0e30)
    bottom = float(-1.0e30)
    # Of a length that the compiler does not know: unrolled, the corners take 228 registers of a GPU, all loaded at once.
    for k in range(corner.shape[1]):
        slot = corner[i, k]
        status = int(node.status[slot])
        if status == HIDDEN:
            hidden += 1
        elif status == CONVERGED:
            solved += 1
            # The reflection point lies on the line of sight, where its distance to the point ends the path.
            q = frame.unit_from_scene * node.position[slot]
            path = wp.length(q)
            away = frame.unit_from_scene * point[slot] + frame.unit_offset - frame.eye
            distance = wp.length(away)
            spare = path * path - wp.dot(q, away)
            d_o = path
            if spare > 0.0:
                d_o = wp.clamp(0.5 * path * (path * path - distance * distance) / spare, 1.0e-6 * path, path)
            d_v = path - d_o
            ratio = h / wp.max(node.reach[slot], 1.0e-20)
            bend = ratio * ratio  # radians on the screen
            if test.order == 4:
                # On the mirror it is d_o times as long, and a Newton step squares it over the length on which the
                # residual bends: the distance to the point or the body's size.
                bend = bend * bend * d_o / wp.clamp(d_v, 1.0e-6, 1.0)
            error = wp.max(error, bend * test.pixels_per_radian)
            centre += 0.125 * (away + frame.eye)
            p = node.screen[slot]
            if p[2] > 0.0:
                left = wp.min(left, p[0])
                right = wp.max(right, p[0])
                top = wp.min(top, p[1])
                bottom = wp.max(bottom, p[1])
    if hidden == 8:
        # What lies behind a convex body is convex: so does the whole cell.
        out_error[i] = HIDDEN_CELL
        return
    if solved < 8:
        out_error[i] = UNSAFE
        return
    # The mirror itself may reach into the cell: the distance from the ball around it to the box around the mirror.
    gap = wp.vec3(
        wp.max(wp.abs(centre[0]) - test.extent[0], 0.0),
        wp.max(wp.abs(centre[1]) - test.extent[1], 0.0),
        wp.max(wp.abs(centre[2]) - test.extent[2], 0.0),
    )
    radius = 0.5 * SPACE_DIAGONAL * h
    if wp.length(gap) < radius:
        error = NEAR
    # So may its shadow, where that is narrower than the cell: the cone from the eye around the ball around the mirror.
    to_body = wp.length(frame.eye)
    to_cell = wp.length(centre - frame.eye)
    if 2.0 * radius > test.body_width * to_cell / to_body and to_cell + radius > to_body - test.body_radius:
        cone = wp.asin(wp.min(test.body_radius / to_body, 1.0)) + wp.asin(
            wp.min(radius / wp.max(to_cell, 1.0e-20), 1.0)
        )
        if (
            wp.acos(wp.clamp(-wp.dot(centre - frame.eye, frame.eye) / wp.max(to_cell * to_body, 1.0e-20), -1.0, 1.0))
            < cone
        ):
            error = NEAR
    if test.order == 3 and error < UNSAFE:
        bend = float(0.0)
        for axis in range(3):
            worst = float(0.0)
            for k in range(4):
                # The four edges along an axis: bit `axis` of the corner 0 and 1, the other bits all four values.
                low_bits = k & ((1 << axis) - 1)
                a = ((k - low_bits) << 1) | low_bits
                b = a | (1 << axis)
                worst = wp.max(
                    worst, edge_residual(node, slope, corner[i, a], corner[i, b], axis, h / test.unit_per_scene)
                )
            bend += worst
        error = SLOPE_ERROR * bend * test.pixels_per_radian
    # A vertex far outside the mirror's pixels moves a triangle inside them by less than itself.
    if right >= left and error < UNSAFE:
        outside_x = wp.max(wp.max(test.box[0] - right, left - test.box[2]), 0.0)
        outside_y = wp.max(wp.max(test.box[1] - bottom, top - test.box[3]), 0.0)
        outside = wp.max(wp.max(outside_x, outside_y) - error, 0.0)
        error = error / (1.0 + outside / (test.box[2] - test.box[0] + test.box[3] - test.box[1]))
    out_error[i] = error


@wp.struct
class ChunkView:
    """Ranges of a grid's vertices, each within one cell."""

    range: wp.array(dtype=wp.vec2i)  # first, count
    cell: wp.array(dtype=int)
    corner: wp.array2d(dtype=int)  # per cell: slots of its corners
    low: wp.array(dtype=wp.vec3)  # per cell: lowest corner
    inv_edge: wp.array(dtype=float)  # per cell; 0: hidden


@wp.struct
class Trilinear:
    """A vector as a polynomial of the position in a cell."""

    c: wp.vec3
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    xy: wp.vec3
    yz: wp.vec3
    xz: wp.vec3
    xyz: wp.vec3


@wp.func
def trilinear_of(
    v0: wp.vec3, v1: wp.vec3, v2: wp.vec3, v3: wp.vec3, v4: wp.vec3, v5: wp.vec3, v6: wp.vec3, v7: wp.vec3
) -> Trilinear:
    t = Trilinear()
    t.c = v0
    t.x = v1 - v0
    t.y = v2 - v0
    t.z = v4 - v0
    t.xy = v3 - v2 - t.x
    t.xz = v5 - v4 - t.x
    t.yz = v6 - v4 - t.y
    t.xyz = v7 - v6 - v5 + v4 - t.xy
    return t


@wp.func
def trilinear(values: wp.array(dtype=wp.vec3), corner: wp.array2d(dtype=int), cell: int) -> Trilinear:
    return trilinear_of(
        values[corner[cell, 0]],
        values[corner[cell, 1]],
        values[corner[cell, 2]],
        values[corner[cell, 3]],
        values[corner[cell, 4]],
        values[corner[cell, 5]],
        values[corner[cell, 6]],
        values[corner[cell, 7]],
    )


@wp.func
def column(m: wp.mat33, k: int) -> wp.vec3:
    return wp.vec3(m[0, k], m[1, k], m[2, k])


@wp.func
def evaluate(t: Trilinear, p: wp.vec3) -> wp.vec3:
    low = t.c + p[0] * t.x + p[1] * (t.y + p[0] * t.xy)
    high = t.z + p[0] * t.xz + p[1] * (t.yz + p[0] * t.xyz)
    return low + p[2] * high


@wp.func
def path_slope(frame: SolveFrame, s: MapSample, target: wp.vec3) -> wp.mat33:
    """Derivative of a virtual vertex (eye frame) by its scene point, at a reflection point of a convex map.

    The virtual vertex is L u: L the length of the path, whose derivative is v (Fermat), u the direction from the eye
    to R, which moves by dR = T H^-1 T^T (I - v v^T) / d_v on the mirror, H the Hessian of the path length.
    """
    to_eye = frame.eye - s.p
    to_target = target - s.p
    d_o = wp.max(wp.length(to_eye), 1.0e-20)
    d_v = wp.max(wp.length(to_target), 1.0e-20)
    o = to_eye / d_o
    v = to_target / d_v
    t1, t2 = tangent_basis(s.n)
    o1 = wp.dot(t1, o)
    o2 = wp.dot(t2, o)
    v1 = wp.dot(t1, v)
    v2 = wp.dot(t2, v)
    bend = wp.max(wp.dot(s.n, o) + wp.dot(s.n, v), 0.0)
    # Shape operator from the map's own derivatives, clamped to a convex body's, as in `map_search.newton_step`.
    a11 = wp.dot(t1, s.p_u)
    a12 = wp.dot(t1, s.p_v)
    a21 = wp.dot(t2, s.p_u)
    a22 = wp.dot(t2, s.p_v)
    b11 = wp.dot(t1, s.n_u)
    b12 = wp.dot(t1, s.n_v)
    b21 = wp.dot(t2, s.n_u)
    b22 = wp.dot(t2, s.n_v)
    det_p = a11 * a22 - a12 * a21
    inv_p = wp.where(wp.abs(det_p) > 1.0e-20, 1.0 / det_p, 0.0)
    s11 = wp.max((b11 * a22 - b12 * a21) * inv_p, 0.0)
    s22 = wp.max((b22 * a11 - b21 * a12) * inv_p, 0.0)
    limit = wp.sqrt(s11 * s22)
    s12 = wp.clamp(0.5 * ((b12 * a11 - b11 * a12) + (b21 * a22 - b22 * a21)) * inv_p, -limit, limit)
    h11 = (1.0 - o1 * o1) / d_o + (1.0 - v1 * v1) / d_v + bend * s11
    h22 = (1.0 - o2 * o2) / d_o + (1.0 - v2 * v2) / d_v + bend * s22
    h12 = bend * s12 - o1 * o2 / d_o - v1 * v2 / d_v
    det = wp.max(h11 * h22 - h12 * h12, 1.0e-20)
    # Rows of T^T (I - v v^T) / d_v, then H^-1.
    r1 = (t1 - v1 * v) / d_v
    r2 = (t2 - v2 * v) / d_v
    m1 = (h22 * r1 - h12 * r2) / det
    m2 = (h11 * r2 - h12 * r1) / det
    path = d_o + d_v
    turn = path / d_o
    # (I - u u^T) t with u = -o.
    slope = wp.outer(turn * (t1 - o1 * o), m1) + wp.outer(turn * (t2 - o2 * o), m2) - wp.outer(o, v)
    return frame.eye_from_unit * slope * frame.unit_from_scene


@wp.kernel
def slope_kernel(
    first: int,
    point: wp.array(dtype=wp.vec3),
    node: VertexView,
    map: ReflectorMapView,
    frame: SolveFrame,
    out_slope: wp.array(dtype=wp.mat33),
):
    """One thread per solved node."""
    i = first + wp.tid()
    if int(node.status[i]) == CONVERGED:
        target = frame.unit_from_scene * point[i] + frame.unit_offset
        out_slope[i] = path_slope(frame, sample_map(map, node.seed[i]), target)


@wp.func
def interpolated_reach(node: VertexView, chunks: ChunkView, cell: int) -> float:
    """The least of a cell's corners: it decides where triangles are cut, by measure."""
    reach = float(1.0e30)
    for k in range(8):
        reach = wp.min(reach, node.reach[chunks.corner[cell, k]])
    return reach


@wp.func
def settle(out_vertex: VertexView, vertex: int, camera: CameraView, q: wp.vec3, reach: float):
    """Write an interpolated virtual vertex (eye frame)."""
    out_vertex.status[vertex] = wp.uint8(CONVERGED)
    out_vertex.reach[vertex] = reach
    out_vertex.screen[vertex] = project(camera, q)
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[vertex] = q


@wp.kernel
def position_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    chunks: ChunkView,
    node: VertexView,
    camera: wp.array(dtype=CameraView),
    out_vertex: VertexView,
):
    """One thread per chunk: virtual positions from the cell's corners."""
    i = first + wp.tid()
    cell = chunks.cell[i]
    begin = chunks.range[i][0]
    end = begin + chunks.range[i][1]
    inv = chunks.inv_edge[cell]
    if inv == 0.0:
        for j in range(begin, end):
            if int(out_vertex.status[order[j]]) == 0:
                out_vertex.status[order[j]] = wp.uint8(HIDDEN)
        return
    low = chunks.low[cell]
    position = trilinear(node.position, chunks.corner, cell)
    reach = interpolated_reach(node, chunks, cell)
    for j in range(begin, end):
        if int(out_vertex.status[order[j]]) == 0:
            local = (points[j] - low) * inv
            settle(out_vertex, order[j], camera[0], evaluate(position, local), reach)


@wp.kernel
def slope_position_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    chunks: ChunkView,
    node: VertexView,
    slope: wp.array(dtype=wp.mat33),
    camera: wp.array(dtype=CameraView),
    out_vertex: VertexView,
):
    """One thread per chunk: as `position_kernel`, with the slopes at the corners.

    Each corner predicts position and half the change of its slope: sum w_k (f_k + J_k (x - x_k) / 2). In f's expansion
    about x the second-order terms of both cancel, so what is left is of third order.
    """
    i = first + wp.tid()
    cell = chunks.cell[i]
    begin = chunks.range[i][0]
    end = begin + chunks.range[i][1]
    inv = chunks.inv_edge[cell]
    if inv == 0.0:
        for j in range(begin, end):
            if int(out_vertex.status[order[j]]) == 0:
                out_vertex.status[order[j]] = wp.uint8(HIDDEN)
        return
    low = chunks.low[cell]
    half = 0.5 / inv
    m0 = half * slope[chunks.corner[cell, 0]]
    m1 = half * slope[chunks.corner[cell, 1]]
    m2 = half * slope[chunks.corner[cell, 2]]
    m3 = half * slope[chunks.corner[cell, 3]]
    m4 = half * slope[chunks.corner[cell, 4]]
    m5 = half * slope[chunks.corner[cell, 5]]
    m6 = half * slope[chunks.corner[cell, 6]]
    m7 = half * slope[chunks.corner[cell, 7]]
    # f_k - J_k c_k / 2 (c_k the corner in the cell), and the columns of J_k / 2 that the position multiplies.
    position = trilinear_of(
        node.position[chunks.corner[cell, 0]],
        node.position[chunks.corner[cell, 1]] - m1 * wp.vec3(1.0, 0.0, 0.0),
        node.position[chunks.corner[cell, 2]] - m2 * wp.vec3(0.0, 1.0, 0.0),
        node.position[chunks.corner[cell, 3]] - m3 * wp.vec3(1.0, 1.0, 0.0),
        node.position[chunks.corner[cell, 4]] - m4 * wp.vec3(0.0, 0.0, 1.0),
        node.position[chunks.corner[cell, 5]] - m5 * wp.vec3(1.0, 0.0, 1.0),
        node.position[chunks.corner[cell, 6]] - m6 * wp.vec3(0.0, 1.0, 1.0),
        node.position[chunks.corner[cell, 7]] - m7 * wp.vec3(1.0, 1.0, 1.0),
    )
    along_x = trilinear_of(
        column(m0, 0),
        column(m1, 0),
        column(m2, 0),
        column(m3, 0),
        column(m4, 0),
        column(m5, 0),
        column(m6, 0),
        column(m7, 0),
    )
    along_y = trilinear_of(
        column(m0, 1),
        column(m1, 1),
        column(m2, 1),
        column(m3, 1),
        column(m4, 1),
        column(m5, 1),
        column(m6, 1),
        column(m7, 1),
    )
    along_z = trilinear_of(
        column(m0, 2),
        column(m1, 2),
        column(m2, 2),
        column(m3, 2),
        column(m4, 2),
        column(m5, 2),
        column(m6, 2),
        column(m7, 2),
    )
    reach = interpolated_reach(node, chunks, cell)
    for j in range(begin, end):
        if int(out_vertex.status[order[j]]) == 0:
            local = (points[j] - low) * inv
            q = evaluate(position, local) + local[0] * evaluate(along_x, local)
            q += local[1] * evaluate(along_y, local) + local[2] * evaluate(along_z, local)
            settle(out_vertex, order[j], camera[0], q, reach)


@wp.kernel
def direction_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    chunks: ChunkView,
    node: VertexView,
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    tolerance: float,
    out_vertex: VertexView,
    out_failed: wp.array(dtype=wp.uint8),
):
    """One thread per chunk: one exact step from the direction that the cell's corners give.

    A vertex whose residual after the step moves its picture by more than `tolerance` [radians] is marked.
    """
    i = first + wp.tid()
    cell = chunks.cell[i]
    begin = chunks.range[i][0]
    end = begin + chunks.range[i][1]
    inv = chunks.inv_edge[cell]
    if inv == 0.0:
        for j in range(begin, end):
            if int(out_vertex.status[order[j]]) == 0:
                out_vertex.status[order[j]] = wp.uint8(HIDDEN)
        return
    low = chunks.low[cell]
    seed = trilinear(node.seed, chunks.corner, cell)
    for j in range(begin, end):
        vertex = order[j]
        if int(out_vertex.status[vertex]) == 0:
            x = project_to_cube(evaluate(seed, (points[j] - low) * inv))
            target = frame.unit_from_scene * points[j] + frame.unit_offset
            sample = sample_map(map, x)
            r = measure(sample, x, frame.eye, target)
            out_failed[j] = wp.uint8(1)
            out_vertex.seed[vertex] = x
            if r.residual < RESIDUAL_MAX:
                x = step_on_cube(map, r, newton_step(sample, frame.eye, target), 1.0)
                # Read again: a tangent step leaves the body by its sagitta, which coarse cells make visible.
                sample = sample_map(map, x)
                r = measure(sample, x, frame.eye, target)
                reach = edge_reach(frame, r.p, r.n, target, map.least_curvature)
                # residual 2 c / lambda is the way left on the mirror; 1 / d_o makes it an angle.
                share = wp.length(target - r.p) / wp.max(reach, 1.0e-20)
                left = r.residual * (r.cos_eye + r.cos_target) * ESTIMATE * share * share
                if r.residual < ACCEPTED and left < tolerance:
                    out_failed[j] = wp.uint8(0)
                    out_vertex.residual[vertex] = r.residual
                    out_vertex.seed[vertex] = x
                    settle(out_vertex, vertex, camera[0], virtual_vertex(frame, r.p, r.n, target), reach)


@wp.kernel
def gather_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    place: wp.array(dtype=int),
    vertex: VertexView,
    out_point: wp.array(dtype=wp.vec3),
    out_vertex: VertexView,
):
    """One thread per listed vertex of the grid: where it is and what its search starts from."""
    i = first + wp.tid()
    j = place[i]
    out_point[i] = points[j]
    out_vertex.seed[i] = vertex.seed[order[j]]


@wp.kernel
def scatter_kernel(
    first: int,
    order: wp.array(dtype=int),
    place: wp.array(dtype=int),
    solved: VertexView,
    out_vertex: VertexView,
):
    """One thread per listed vertex of the grid: its own solution into the scene's vertices."""
    i = first + wp.tid()
    vertex = order[place[i]]
    out_vertex.screen[vertex] = solved.screen[i]
    out_vertex.status[vertex] = solved.status[i]
    out_vertex.seed[vertex] = solved.seed[i]
    out_vertex.residual[vertex] = solved.residual[i]
    out_vertex.reach[vertex] = solved.reach[i]
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[vertex] = solved.position[i]
