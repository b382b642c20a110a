"""The mesh that forward techniques reflect: a scene without the mirror, large triangles cut where their picture bends.

A straight edge reflects as a curve, but a virtual triangle has straight edges: where the error estimate of a triangle
exceeds a tolerance it is replaced by a lattice of smaller ones (the limit that Estalella et al. 2005, section 8, and Ofek
and Rappoport 1998 leave open). Neighbours may be cut differently; the gaps along their edges are left to refinement.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import warp as wp

from warp_reflect import compact, raster
from warp_reflect.launch import launch, stays
from warp_reflect.layers import MirrorPixels
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Status
from warp_reflect.techniques.vertices import VertexView

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))
DROPPED = raster.DROPPED
CUT_MAX = wp.constant(32)  # pieces along an edge; a lattice of 32 has 1024 triangles
# Pieces of a triangle that is partly hidden: the estimate grows without bound at grazing incidence.
STRADDLING_MAX = wp.constant(4)
CUT_SLACK = 1.5  # the tolerance is divided by it when cutting, so that a moving eye does not cut anew every frame
# Of the triangles that are cut: as many may want more pieces before everything is cut anew for a moving eye. The estimate
# of a triangle at the hidden boundary grows without bound, and there are always some.
LATE_SHARE = 0.02
BUDGET_SHARE = 2.0  # new triangles per triangle of the scene (beside BUDGET_MIN) before the tolerance is relaxed
BUDGET_MIN = 20000
RELAX = 2.0  # factor of the tolerance per attempt to meet the budget
RELAX_STEPS = 24  # 2^23 times the tolerance cuts nothing any more
# Of a mirror's radius: the deviation of longer pieces says nothing about that of shorter ones.
MEASURED_LENGTH = wp.constant(2.0)
GONE_LANES = 64  # threads of a device for each box whose vertices are settled together
# Of the mirror's radius: longer pieces of a partly hidden triangle end in a straight line where the border of what is hidden
# is curved, and what lies between is not drawn. Such triangles are asked for at every pixel (`refine.settle`).
COARSE_SHARE = 1.0
COARSE_MAX = 48  # of them at most, the largest first: a test costs 10 ns a pixel, a ray a few hundred
BOX_MARGIN = wp.constant(8.0)  # pixels around a virtual triangle's straight picture that its bent one may reach
# An edge's picture bends by (length / reach)^2 radians where the estimate holds; it is trusted up to here, twice over.
BEND_MAX = wp.constant(0.1)
BEND_SLACK = wp.constant(2.0)


@dataclass
class VirtualMesh:
    """Vertices and triangles of a scene as one mirror reflects them.

    Attributes:
        points: vec3 [vertex_count], scene frame; the scene's own vertices first.
        triangles: vec3i [triangle_count], without the mirror's own, those it may not show and those that were cut.
        parents: int32 [triangle_count], the scene triangle each belongs to.
        patches: int32 [triangle_count], the scene patch each belongs to.
        estimated: uint8 [scene triangle_count], pieces along an edge by the estimate that was in force, 1 where whole.
        relaxed: Multiple of the tolerance asked that it was made for, 1 unless the budget was short.
        coarse: int32 [k], scene triangles whose picture is not whole, see `coarse_triangles`.
        added_triangle: int32 [vertex_count - base_count], the scene triangle that each further vertex lies in; None: none do.
        added_place: float32 [vertex_count - base_count, 2], and its weights of the second and the third corner.
    """

    points: wp.array
    triangles: wp.array
    parents: wp.array
    patches: wp.array
    host_triangles: np.ndarray
    host_parents: np.ndarray
    base_count: int
    estimated: np.ndarray
    relaxed: float
    coarse: wp.array | None = None
    added_triangle: np.ndarray | None = None
    added_place: np.ndarray | None = None

    @property
    def vertex_count(self) -> int:
        return len(self.points)

    @cached_property
    def estimated_there(self) -> wp.array:
        """`estimated` on the device."""
        return wp.array(self.estimated, dtype=wp.uint8, device=self.points.device)

    @cached_property
    def late_most(self) -> float:
        """Triangles that may want more pieces before everything is cut anew."""
        return LATE_SHARE * np.count_nonzero(self.estimated > 1)


@dataclass(frozen=True)
class Straddling:
    """The visible sides of n triangles that cross the hidden boundary.

    Their points are, one after the other: the first corner of every triangle (the one unlike the other two), the second, the
    third, where the edge from the first to the second meets the boundary, and where that to the third does.

    Attributes:
        corners: vec3i [n], vertices of the mesh.
        boundary: vec3 [2 n], where the edges meet the boundary, on which virtual and real point coincide; eye frame.
        triangles: vec3i [2 n], into the points; 5 n where there is none.
        owners: int32 [2 n], the triangle of the mesh that each is a side of.
    """

    corners: wp.array
    boundary: wp.array
    triangles: wp.array
    owners: wp.array

    def on_host(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """(vertices of the mesh: the first points; the points after those; triangles into all of them; their owners)."""
        triangles = self.triangles.numpy()
        there = triangles[:, 0] < 5 * len(self.corners)
        corners = self.corners.numpy().T.reshape(-1)
        return corners, self.boundary.numpy(), triangles[there], self.owners.numpy()[there]


@dataclass(frozen=True)
class Drawn:
    """What was drawn into the pixels of a mirror, or of a piece of it.

    Attributes:
        pixels: Where it is seen.
        mesh: What is reflected.
        screen: vec4 [vertex_count], see `layers.project`: where the virtual vertices appear; key `raster.DROPPED`: nowhere.
        straddling: What was drawn of the triangles that are partly hidden; None: nothing.
    """

    pixels: MirrorPixels
    mesh: VirtualMesh
    screen: wp.array
    straddling: Straddling | None = None


@wp.kernel
def cut_kernel(
    first: int,
    triangles: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=wp.vec3),
    screen: wp.array(dtype=wp.vec4),
    status: wp.array(dtype=wp.uint8),
    reach: wp.array(dtype=float),
    unit_per_scene: float,
    tolerance_root: float,
    box: wp.vec4,
    out_cut: wp.array(dtype=wp.uint8),
):
    """One thread per scene triangle: pieces along an edge, a power of two."""
    i = first + wp.tid()
    t = triangles[i]
    a = points[t[0]]
    b = points[t[1]]
    c = points[t[2]]
    # The root of the longest's square is the longest root.
    square = wp.max(wp.dot(b - a, b - a), wp.max(wp.dot(c - b, c - b), wp.dot(a - c, a - c)))
    longest = wp.sqrt(square) * unit_per_scene
    shortest = float(1.0e30)
    for k in range(3):
        v = t[k]
        if int(status[v]) == CONVERGED and reach[v] > 0.0:
            shortest = wp.min(shortest, reach[v] * tolerance_root)
    if longest <= shortest:
        # Nearly all of them: where they appear need not be read.
        out_cut[i] = wp.uint8(1)
        return
    left = float(1.0e30)
    right = float(-1.0e30)
    top = float(1.0e30)
    bottom = float(-1.0e30)
    seen_corners = int(0)
    for k in range(3):
        v = t[k]
        if int(status[v]) == CONVERGED and reach[v] > 0.0:
            p = screen[v]
            seen_corners += 1
            if p[2] > 0.0:
                left = wp.min(left, p[0])
                right = wp.max(right, p[0])
                top = wp.min(top, p[1])
                bottom = wp.max(bottom, p[1])
    pieces = int(1)
    margin = BOX_MARGIN + 0.5 * wp.max(right - left, bottom - top)
    seen = right + margin >= box[0] and left - margin <= box[2] and bottom + margin >= box[1] and top - margin <= box[3]
    if seen:
        # Pieces of two pixels bend by less than one; the picture of a partly hidden triangle may be larger than known.
        extent = wp.max(right - left, bottom - top)
        if seen_corners < 3:
            extent = float(CUT_MAX)
        while pieces < CUT_MAX and 2.0 * float(pieces) < extent and longest > shortest * float(pieces):
            pieces = pieces * 2
    out_cut[i] = wp.uint8(pieces)


@wp.kernel
def late_kernel(
    first: int,
    cut: wp.array(dtype=wp.uint8),
    estimated: wp.array(dtype=wp.uint8),
    own_first: int,
    own_count: int,
    out_late: wp.array(dtype=wp.uint8),
):
    """One thread per scene triangle: 1 where it wants more pieces than were estimated, and is not the mirror's own."""
    i = first + wp.tid()
    late = cut[i] > estimated[i] and (i < own_first or i >= own_first + own_count)
    out_late[i] = wp.uint8(wp.where(late, 1, 0))


def is_late(part: PartRange, mesh: VirtualMesh, cut: wp.array, threads: int) -> bool:
    """Whether too many triangles want more pieces (`needed_cuts`) than a mesh was made for."""
    late = wp.empty(len(cut), dtype=wp.uint8, device=cut.device)
    own = [part.first_triangle, part.triangle_count]
    launch(late_kernel, len(cut), [cut, mesh.estimated_there, *own, late], cut.device, threads)
    return int(compact.counted(late, 1).numpy()[0]) > mesh.late_most


def needed_cuts(scene: Scene, vertices, unit_per_scene: float, tolerance: float, box, threads: int) -> wp.array:
    """Pieces per scene triangle, uint8 [triangle_count].

    Args:
        tolerance: Bending of an edge's picture. [radians]
    """
    cut = wp.empty(scene.triangle_count, dtype=wp.uint8, device=scene.device)
    inputs = [scene.view.triangles, scene.view.points, vertices.screen, vertices.status, vertices.reach]
    inputs += [unit_per_scene, float(np.sqrt(tolerance))]
    inputs += [wp.vec4(*(float(side) for side in box)), cut]
    launch(cut_kernel, scene.triangle_count, inputs, scene.device, threads)
    return cut


@wp.kernel
def gone_kernel(
    first: int,
    corners: wp.array(dtype=wp.vec3),
    status: wp.array(dtype=wp.uint8),
    screen: wp.array(dtype=wp.vec4),
    reach: wp.array(dtype=float),
    unit_per_scene: float,
    focal: float,
    pixels: wp.vec4,
    out_gone: wp.array(dtype=wp.uint8),
):
    """One thread per box of eight solved corners: 1 if all are hidden, or all appear beside the pixels, bent edges included."""
    i = first + wp.tid()
    at = 8 * i
    hidden = int(0)
    seen = int(0)
    least = float(1.0e30)
    left = float(1.0e30)
    right = float(-1.0e30)
    top = float(1.0e30)
    bottom = float(-1.0e30)
    for k in range(8):
        s = int(status[at + k])
        p = screen[at + k]
        if s == HIDDEN:
            hidden += 1
        elif s == CONVERGED and p[2] > 0.0:
            seen += 1
        if reach[at + k] > 0.0:
            least = wp.min(least, reach[at + k])
        left = wp.min(left, p[0])
        right = wp.max(right, p[0])
        top = wp.min(top, p[1])
        bottom = wp.max(bottom, p[1])
    gone = hidden == 8
    if seen == 8:
        across = wp.length(corners[at + 7] - corners[at]) * unit_per_scene / least
        bend = across * across
        margin = BOX_MARGIN + BEND_SLACK * bend * focal
        beside = (
            right + margin < pixels[0]
            or left - margin > pixels[2]
            or bottom + margin < pixels[1]
            or top - margin > pixels[3]
        )
        gone = bend < BEND_MAX and beside
    out_gone[i] = wp.uint8(wp.where(gone, 1, 0))


@wp.kernel
def settle_gone_kernel(
    first: int,
    gone: wp.array(dtype=wp.uint8),
    first_vertex: wp.array(dtype=int),
    vertex_count: wp.array(dtype=int),
    lanes: int,
    out_status: wp.array(dtype=wp.uint8),
    out_screen: wp.array(dtype=wp.vec4),
):
    """`lanes` threads per box, which share its vertices."""
    i = first + wp.tid()
    box = i // lanes
    if gone[box] == wp.uint8(0):
        return
    v = first_vertex[box] + i - box * lanes
    end = first_vertex[box] + vertex_count[box]
    while v < end:
        out_status[v] = wp.uint8(UNREFLECTED)
        out_screen[v] = wp.vec4(0.0, 0.0, DROPPED, 0.0)
        v += lanes


def settle_gone(
    boxes: tuple[wp.array, wp.array, wp.array],
    solved: VertexView,
    unit_per_scene: float,
    focal: float,
    pixels: tuple[int, int, int, int],
    out_vertex: VertexView,
) -> wp.array:
    """Settle the vertices of boxes that a mirror cannot show as `Status.UNREFLECTED`.

    Args:
        boxes: First vertex and vertex count, int32 [n], and corners, vec3 [8 n].
        solved: The corners.
        unit_per_scene: Scale of the solver's frame.
        focal: Of the camera. [pixels]
        pixels: Bounds of the mirror's.
        out_vertex: The scene's own vertices come first.

    Returns:
        uint8 [n], 1 of those boxes.
    """
    first, count, corners = boxes
    device = corners.device
    gone = wp.empty(len(first), dtype=wp.uint8, device=device)
    inputs = [corners, solved.status, solved.screen, solved.reach, unit_per_scene, focal]
    launch(gone_kernel, len(first), [*inputs, wp.vec4(*(float(side) for side in pixels)), gone], device)
    lanes = GONE_LANES if stays(device) else 1
    inputs = [gone, first, count, lanes, out_vertex.status, out_vertex.screen]
    launch(settle_gone_kernel, lanes * len(first), inputs, device)
    return gone


@wp.kernel
def measure_kernel(
    first: int,
    triangles: wp.array(dtype=wp.vec3i),
    points: wp.array(dtype=wp.vec3),
    ids: wp.array(dtype=int),
    estimate: wp.array(dtype=wp.uint8),
    screen: wp.array(dtype=wp.vec4),
    middle: wp.array(dtype=wp.vec4),
    tolerance_px: float,
    unit_per_scene: float,
    out_cut: wp.array(dtype=wp.uint8),
):
    """One thread per asked triangle, see `measured_cuts`."""
    i = first + wp.tid()
    t = triangles[ids[i]]
    longest = float(0.0)
    deviation = float(0.0)
    seen = int(1)
    for k in range(3):
        a = t[k]
        b = t[(k + 1) % 3]
        longest = wp.max(longest, wp.length(points[b] - points[a]))
        start = screen[a]
        end = screen[b]
        between = middle[k * ids.shape[0] + i]
        along_x = end[0] - start[0]
        along_y = end[1] - start[1]
        off = wp.abs(along_x * (between[1] - start[1]) - along_y * (between[0] - start[0]))
        deviation = wp.max(deviation, off / wp.max(wp.sqrt(along_x * along_x + along_y * along_y), 1.0))
        if start[2] <= 0.0 or between[2] <= 0.0:
            seen = 0
    most = int(estimate[i])
    pieces = int(1)
    if seen == 0:
        pieces = wp.min(STRADDLING_MAX, most)
    else:
        wanted = wp.max(wp.sqrt(wp.max(deviation / tolerance_px, 1.0)), longest * unit_per_scene / MEASURED_LENGTH)
        # `most` is a power of two, too.
        while pieces < most and float(pieces) < wanted:
            pieces = pieces * 2
    out_cut[i] = wp.uint8(pieces)


def whole(scene: Scene, part: PartRange) -> VirtualMesh:
    """The scene without the mirror, nothing cut."""
    ones = np.ones(scene.triangle_count, np.uint8)
    return cut_mesh(scene, part, ones, ones, 1.0)


def edge_middles(scene: Scene, ids: np.ndarray) -> np.ndarray:
    """Middles of the edges of scene triangles, float32 [3 len(ids), 3], edge by edge (v0v1, v1v2, v2v0)."""
    corner = [scene.host_points[each] for each in scene.host_triangles[ids].T]
    return np.concatenate([0.5 * (corner[k] + corner[(k + 1) % 3]) for k in range(3)])


def measured_cuts(
    scene: Scene,
    ids: np.ndarray,
    estimate: np.ndarray,
    vertices,
    middles,
    tolerance_px: float,
    unit_per_scene: float,
    threads: int,
) -> np.ndarray:
    """Pieces per triangle from how far the picture of each edge's middle lies off the straight edge.

    The deviation falls with the square of the pieces, once these are no longer than the mirror; longer ones are asked for
    by the estimate alone. Where a corner or a middle has no picture (behind the mirror's silhouette, which compresses it)
    the estimate stands up to STRADDLING_MAX.

    Args:
        ids: Scene triangles asked.
        estimate: Their pieces by `needed_cuts`, the upper bound.
        vertices, middles: Solved vertices of the scene, and of `edge_middles`.
        tolerance_px: Deviation allowed. [pixels]
        unit_per_scene: Of the mirror's unit frame, in which it is about 1 in radius.
    """
    device, measured = scene.device, wp.empty(len(ids), dtype=wp.uint8, device=scene.device)
    inputs = [scene.view.triangles, scene.view.points, wp.array(ids.astype(np.int32), dtype=int, device=device)]
    inputs += [wp.array(estimate, dtype=wp.uint8, device=device), vertices.screen, middles.screen]
    launch(measure_kernel, len(ids), [*inputs, tolerance_px, unit_per_scene, measured], device, threads)
    return measured.numpy()


def coarse_triangles(
    scene: Scene, part: PartRange, vertices, ids: np.ndarray, middles, cuts: np.ndarray, unit_per_scene: float
) -> np.ndarray:
    """Scene triangles that are partly hidden by the mirror and cut into pieces too long for the border of what is hidden.

    Args:
        vertices, middles: Solved vertices of the scene, and of `edge_middles` of the triangles `ids`.
        cuts: Pieces along an edge of every scene triangle.
        unit_per_scene: Of the mirror's unit frame, in which it is about 1 in radius.

    Returns:
        int32, the largest first.
    """
    unsolved = vertices.status.numpy() != int(Status.CONVERGED)
    first, second, third = (unsolved[each] for each in scene.host_triangles.T)
    partly = first | second | third
    if len(ids):
        first, second, third = middles.screen.numpy()[:, 2].reshape(3, len(ids)) <= 0.0
        partly[ids] |= first | second | third
    partly[part.first_triangle : part.first_triangle + part.triangle_count] = False
    seen = scene.seen_in(part)
    if seen is not None:
        partly &= seen
    partly = np.flatnonzero(partly)
    longest = _longest_edges(scene, partly) * unit_per_scene / cuts[partly]
    found, longest = partly[longest > COARSE_SHARE], longest[longest > COARSE_SHARE]
    return found[np.argsort(-longest, kind="stable")][:COARSE_MAX].astype(np.int32)


def _longest_edges(scene: Scene, ids: np.ndarray) -> np.ndarray:
    """Lengths of the longest edges of scene triangles in scene units, float64 [len(ids)]."""
    corner = [scene.host_points[each].astype(np.float64) for each in scene.host_triangles[ids].T]
    square = np.zeros(len(ids))
    for k in range(3):
        edge = corner[k] - corner[(k + 1) % 3]
        square = np.maximum(square, np.einsum("ij,ij->i", edge, edge))
    return np.sqrt(square)


def triangle_cost(cuts: np.ndarray) -> float:
    """Triangles that cuts add."""
    return float((cuts.astype(np.int64) ** 2 * (cuts > 1)).sum())


def budget(scene: Scene) -> float:
    """Triangles that may be added to a scene."""
    return BUDGET_MIN + BUDGET_SHARE * scene.triangle_count


def cut_mesh(scene: Scene, part: PartRange, cuts: np.ndarray, estimated: np.ndarray, relaxed: float) -> VirtualMesh:
    """Replace every triangle with cuts > 1 by its lattice; drop the mirror's own, and what it may not show."""
    dropped = np.zeros(scene.triangle_count, bool)
    dropped[part.first_triangle : part.first_triangle + part.triangle_count] = True
    seen = scene.seen_in(part)
    if seen is not None:
        dropped |= ~seen
    cuts = np.where(dropped, 1, cuts)
    kept = (cuts == 1) & ~dropped
    points, triangles = [scene.host_points], [scene.host_triangles[kept]]
    parents = [np.flatnonzero(kept).astype(np.int32)]
    added, places = [np.zeros(0, np.int32)], [np.zeros((0, 2), np.float32)]
    count = scene.vertex_count
    for pieces in np.unique(cuts[cuts > 1]):
        ids = np.flatnonzero(cuts == pieces).astype(np.int32)
        weights, lattice = lattice_of(int(pieces))
        corner = scene.host_points[scene.host_triangles[ids]]
        lattice_points = corner.transpose(0, 2, 1).reshape(-1, 3) @ weights.T
        points.append(lattice_points.reshape(len(ids), 3, -1).transpose(0, 2, 1).reshape(-1, 3).astype(np.float32))
        first = np.arange(count, count + len(ids) * len(weights), len(weights), dtype=np.int32)
        triangles.append((lattice[None].astype(np.int32) + first[:, None, None]).reshape(-1, 3))
        parents.append(np.repeat(ids, len(lattice)))
        added.append(np.repeat(ids, len(weights)))
        places.append(np.tile(weights[:, 1:].astype(np.float32), (len(ids), 1)))
        count += len(ids) * len(weights)
    host_triangles = np.concatenate(triangles).astype(np.int32, copy=False)
    host_parents = np.concatenate(parents)

    def on_device(values: np.ndarray, kind) -> wp.array:
        return wp.array(values, dtype=kind, device=scene.device, copy=False)  # nobody writes to them

    return VirtualMesh(
        on_device(np.concatenate(points), wp.vec3),
        on_device(host_triangles, wp.vec3i),
        on_device(host_parents, int),
        on_device(scene.host_triangle_patch[host_parents], int),
        host_triangles,
        host_parents,
        scene.vertex_count,
        estimated,
        relaxed,
        added_triangle=np.concatenate(added),
        added_place=np.concatenate(places),
    )


@wp.func
def known_seed(vertices: VertexView, i: int) -> wp.vec3:
    """What a search from vertex i would start from; zero where it has no picture."""
    if int(vertices.status[i]) != CONVERGED:
        return wp.vec3(0.0, 0.0, 0.0)
    return vertices.seed[i]


@wp.kernel
def start_middles_kernel(
    first: int,
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    vertices: VertexView,
    out_middle: VertexView,
):
    """One thread per edge of `edge_middles`: searches start between what the edge's ends have found."""
    i = first + wp.tid()
    t = triangles[ids[i % ids.shape[0]]]
    edge = i / ids.shape[0]
    a = t[edge]
    b = t[(edge + 1) % 3]
    at_a = known_seed(vertices, a)
    at_b = known_seed(vertices, b)
    if wp.length_sq(at_a) > 0.0 and wp.length_sq(at_b) > 0.0:
        out_middle.seed[i] = 0.5 * (at_a + at_b)


@wp.func
def copy_answer(source: VertexView, i: int, j: int, out_vertex: VertexView):
    """Entry i of the source into entry j."""
    out_vertex.screen[j] = source.screen[i]
    out_vertex.status[j] = source.status[i]
    out_vertex.residual[j] = source.residual[i]
    out_vertex.reach[j] = source.reach[i]
    out_vertex.seed[j] = source.seed[i]
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[j] = source.position[i]
        out_vertex.drift[j] = source.drift[i]


@wp.kernel
def start_added_kernel(
    first: int,
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    slot: wp.array(dtype=int),
    place: wp.array(dtype=wp.vec2),
    vertices: VertexView,
    middles: VertexView,
    out_added: VertexView,
):
    """One thread per added vertex: corners and middles of edges are known, other searches start between these."""
    i = first + wp.tid()
    k = slot[i]
    t = triangles[ids[k]]
    b = place[i][0]
    c = place[i][1]
    a = 1.0 - b - c
    for corner in range(3):
        weight = wp.where(corner == 0, a, wp.where(corner == 1, b, c))
        if weight == 1.0:
            copy_answer(vertices, t[corner], i, out_added)
            return
        if weight == 0.0 and wp.max(a, wp.max(b, c)) == 0.5:
            # The middle of the edge across from this corner.
            copy_answer(middles, ((corner + 1) % 3) * ids.shape[0] + k, i, out_added)
            return
    # Quadratic in the triangle: corners and middles.
    count = ids.shape[0]
    missing = int(0)
    total = wp.vec3(0.0, 0.0, 0.0)
    for corner in range(3):
        weight = wp.where(corner == 0, a, wp.where(corner == 1, b, c))
        onward = wp.where(corner == 0, b, wp.where(corner == 1, c, a))
        at_corner = known_seed(vertices, t[corner])
        at_middle = known_seed(middles, corner * count + k)
        if wp.length_sq(at_corner) == 0.0 or wp.length_sq(at_middle) == 0.0:
            missing = 1
        total += weight * (2.0 * weight - 1.0) * at_corner + 4.0 * weight * onward * at_middle
    if missing == 0:
        out_added.seed[i] = total


def start_middles(scene: Scene, ids: np.ndarray, vertices: VertexView, out_middle: VertexView, threads: int) -> None:
    """Have the searches of `edge_middles` start between the answers of their edges' ends.

    Args:
        ids: Scene triangles asked.
        vertices: Solved vertices of the scene.
        out_middle: Empty.
    """
    listed = wp.array(ids.astype(np.int32), dtype=int, device=scene.device)
    inputs = [scene.view.triangles, listed, vertices, out_middle]
    launch(start_middles_kernel, 3 * len(ids), inputs, scene.device, threads)


def start_added(
    scene: Scene,
    mesh: VirtualMesh,
    ids: np.ndarray,
    vertices: VertexView,
    middles: VertexView,
    out_added: VertexView,
    threads: int,
) -> None:
    """Take over what is known of the vertices that cutting added, and have other searches start between known answers.

    Args:
        ids: Scene triangles whose `middles` are given, ascending; those that were cut are among them.
        vertices, middles: Solved vertices of the scene, and of `edge_middles`.
        out_added: Empty; one entry per added vertex.
    """
    device = scene.device
    inputs = [scene.view.triangles, wp.array(ids.astype(np.int32), dtype=int, device=device)]
    slot = np.zeros(scene.triangle_count, np.int32)
    slot[ids] = np.arange(len(ids), dtype=np.int32)
    inputs.append(wp.array(slot[mesh.added_triangle], dtype=int, device=device))
    inputs += [wp.array(mesh.added_place, dtype=wp.vec2, device=device), vertices, middles, out_added]
    launch(start_added_kernel, len(mesh.added_triangle), inputs, device, threads)


@cache
def lattice_of(pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """(corner weights [vertex_count, 3], triangles [pieces^2, 3]) of a triangle cut into pieces along each edge."""
    row, column = np.meshgrid(np.arange(pieces + 1), np.arange(pieces + 1), indexing="ij")
    inside = row + column <= pieces
    number = np.full(inside.shape, -1)
    number[inside] = np.arange(inside.sum())
    b, c = row[inside] / pieces, column[inside] / pieces
    i, j = np.nonzero(inside[:-1, :-1] & (row + column < pieces)[:-1, :-1])
    up = np.stack([number[i, j], number[i + 1, j], number[i, j + 1]], 1)
    i, j = np.nonzero((row + column < pieces - 1)[:-1, :-1])
    down = np.stack([number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], 1)
    return np.stack([1.0 - b - c, b, c], 1), np.concatenate([up, down])
