"""Catmull-Clark and Loop subdivision onto the limit surface, with its normals. Plain NumPy, knows no USD.

Holes, boundaries, semi-sharp creases and corners follow OpenSubdiv's rules (uniform creases). Values that
vary linearly over a face ("varying", "faceVarying") are refined linearly within each face: OpenSubdiv's
faceVaryingLinearInterpolation "all"; its smooth interior ("cornersPlus1") differs from that by a second-order
slide of the values along the surface.

Sources: E. Catmull, J. Clark, Recursively generated B-spline surfaces on arbitrary topological meshes, 1978;
C. Loop, Smooth subdivision surfaces based on triangles, 1987; T. DeRose, M. Kass, T. Truong, Subdivision
surfaces in character animation, 1998 (semi-sharp creases); limit masks: M. Halstead, M. Kass, T. DeRose,
Efficient, fair interpolation using Catmull-Clark surfaces, 1993; H. Biermann, A. Levin, D. Zorin, Piecewise
smooth subdivision surfaces with normal control, 2000.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np

BOUNDARY_RULES = ("none", "edgeOnly", "edgeAndCorner")
SHARPNESS_INFINITE = 10.0  # OpenSubdiv's threshold: from here on sharpness does not decay
# Squared sine between two limit tangents under which they do not span a plane.
TANGENT_PARALLEL = 1.0e-12


@dataclass
class Cage:
    """A control mesh.

    Attributes:
        counts: Corners of each face, int64 [face_count], all >= 3 (Loop: all 3).
        indices: Vertex of each corner, int64.
        boundary: One of `BOUNDARY_RULES`, UsdGeomMesh's interpolateBoundary.
        crease_edges: Vertex pairs, int64 [n, 2]; those that are no edge are ignored.
        crease_sharpness: float64 [n].
        corners: Sharp vertices, int64 [m].
        corner_sharpness: float64 [m].
        holes: bool [face_count]: refined but not drawn.
    """

    counts: np.ndarray
    indices: np.ndarray
    boundary: str = "edgeAndCorner"
    crease_edges: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    crease_sharpness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    corners: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    corner_sharpness: np.ndarray = field(default_factory=lambda: np.zeros(0))
    holes: np.ndarray | None = None


@dataclass
class Refined:
    """A refined mesh, all quads (Catmull-Clark) or all triangles (Loop); holes left out.

    Attributes:
        points: Limit values of the vertex columns, float64 [vertex_count, width].
        indices: int64 [face_count, 4 or 3].
        source: Face of the cage each face came from, int64 [face_count].
        normals: Unit limit normals, one per fan of faces between sharp edges at a vertex, float64 [n, 3].
        normal_index: int64, shape of `indices`.
        varying: float64 [vertex_count, width], or None.
        face_varying: Values per corner, float64 [face_count, 4 or 3, width], or None.
    """

    points: np.ndarray
    indices: np.ndarray
    source: np.ndarray
    normals: np.ndarray
    normal_index: np.ndarray
    varying: np.ndarray | None
    face_varying: np.ndarray | None


def subdivide(
    scheme: str,
    level: int,
    cage: Cage,
    points: np.ndarray,
    varying: np.ndarray | None = None,
    face_varying: np.ndarray | None = None,
) -> Refined:
    """Refine a cage and push its vertices onto the limit surface.

    Args:
        scheme: "catmullClark" or "loop".
        level: Refinement steps, >= 1.
        cage: Topology and sharpness.
        points: Values refined by the scheme, float64 [vertex_count, width]; the first three columns are the
            positions.
        varying: Values per vertex refined linearly, float64 [vertex_count, width].
        face_varying: Values per corner refined linearly, float64 [corner_count, width].

    Raises:
        ValueError: an unknown scheme, or a level below 1.
    """
    if scheme not in ("catmullClark", "loop"):
        raise ValueError(f"scheme: got {scheme!r}, expected catmullClark or loop")
    if level < 1:
        raise ValueError(f"level: got {level}, expected 1 or more")
    state = _State.from_cage(cage, points, varying, face_varying)
    step = _refine_quads if scheme == "catmullClark" else _refine_triangles
    for _ in range(level):
        state = step(state)
    edges = _Edges(state)
    fans = _Fans(state, edges)
    limit, normals = _limit(scheme, state, edges, fans)
    size = 4 if scheme == "catmullClark" else 3
    kept = ~state.holes
    corner_values = None if state.face_varying is None else state.face_varying.reshape(len(kept), size, -1)[kept]
    return Refined(
        limit,
        state.indices.reshape(-1, size)[kept],
        state.source[kept],
        normals,
        fans.fan_of_corner.reshape(-1, size)[kept],
        state.varying,
        corner_values,
    )


@dataclass
class _State:
    """A mesh between two refinement steps."""

    counts: np.ndarray
    indices: np.ndarray
    points: np.ndarray
    varying: np.ndarray | None
    face_varying: np.ndarray | None
    source: np.ndarray
    holes: np.ndarray
    crease_key: np.ndarray  # sorted low * vertex_count + high of the edges with a sharpness
    crease_sharpness: np.ndarray
    vertex_sharpness: np.ndarray

    @classmethod
    def from_cage(cls, cage: Cage, points, varying, face_varying) -> _State:
        count = len(points)
        pairs = np.sort(np.asarray(cage.crease_edges, np.int64).reshape(-1, 2), axis=1)
        key, first = np.unique(pairs[:, 0] * count + pairs[:, 1], return_index=True)
        sharpness = np.zeros(count)
        sharpness[cage.corners] = cage.corner_sharpness
        holes = np.zeros(len(cage.counts), bool) if cage.holes is None else cage.holes.copy()
        state = cls(
            np.asarray(cage.counts, np.int64),
            np.asarray(cage.indices, np.int64),
            np.asarray(points, np.float64),
            varying,
            face_varying,
            np.arange(len(cage.counts)),
            holes,
            key,
            np.asarray(cage.crease_sharpness, np.float64)[first],
            sharpness,
        )
        # Sheets that touch in a vertex only are pinned there (OpenSubdiv: a non-manifold vertex is sharp).
        bare = dataclasses.replace(
            state, crease_key=key[:0], crease_sharpness=np.zeros(0), vertex_sharpness=np.zeros(count)
        )
        edges = _Edges(bare)
        sheets = np.bincount(_Fans(bare, edges).vertex, minlength=count)
        border_ends = edges.vertices[edges.border].reshape(-1)
        state.vertex_sharpness[(sheets > 1) & (np.bincount(border_ends, minlength=count) <= 2)] = np.inf
        on_border = np.zeros(count, bool)
        on_border[edges.vertices[edges.border]] = True
        if cage.boundary == "none":
            corner_face = np.repeat(np.arange(len(cage.counts)), cage.counts)
            holes[corner_face[on_border[state.indices]]] = True
        elif cage.boundary == "edgeAndCorner":
            face_uses = np.bincount(state.indices, minlength=count)
            state.vertex_sharpness[on_border & (face_uses == 1)] = np.inf
        return state


class _Edges:
    """The edges of a mesh.

    Attributes:
        start, next_corner, prev_corner: int64 [corner_count]; the half-edge of a corner leads to the next
        one.
        edge_of: Edge of each corner's half-edge.
        vertices: int64 [edge_count, 2].
        border: Edges that are not shared by exactly two faces of one winding: sharp for ever.
        sharpness: float64 [edge_count].
    """

    def __init__(self, state: _State):
        counts, indices = state.counts, state.indices
        corner_count, vertex_count = len(indices), len(state.points)
        first = np.cumsum(counts) - counts
        self.face_of = np.repeat(np.arange(len(counts)), counts)
        self.first_of = first[self.face_of]
        within = np.arange(corner_count) - self.first_of
        size = counts[self.face_of]
        self.next_corner = self.first_of + np.where(within + 1 == size, 0, within + 1)
        self.prev_corner = self.first_of + np.where(within == 0, size - 1, within - 1)
        ends = indices[self.next_corner]
        low, high = np.minimum(indices, ends), np.maximum(indices, ends)
        key, self.edge_of = np.unique(low * vertex_count + high, return_inverse=True)
        self.edge_of = self.edge_of.reshape(-1)
        self.vertices = np.stack([key // vertex_count, key % vertex_count], axis=1)
        uses = np.bincount(self.edge_of, minlength=len(key))
        forward = np.bincount(self.edge_of[indices == low], minlength=len(key))
        self.border = (uses != 2) | (forward != 1)
        self.sharpness = np.zeros(len(key))
        if len(state.crease_key):
            at = np.minimum(np.searchsorted(state.crease_key, key), len(state.crease_key) - 1)
            found = state.crease_key[at] == key
            self.sharpness[found] = state.crease_sharpness[at[found]]
        self.sharpness[self.border] = np.inf


def _sums(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sum of the rows of `values` [n, width] with equal index, float64 [count, width]."""
    return np.stack([np.bincount(index, column, count) for column in values.T], axis=1)


def _decayed(sharpness: np.ndarray) -> np.ndarray:
    return np.where(sharpness >= SHARPNESS_INFINITE, np.inf, np.maximum(sharpness - 1.0, 0.0))


def _blend_vertices(state: _State, edges: _Edges, smooth: np.ndarray, crease_mask) -> np.ndarray:
    """New vertex values: the smooth, crease or corner rule, blended where a sharpness fades out in this step.

    Args:
        state: The mesh.
        edges: Its edges.
        smooth: The smooth rule's values [vertex_count, width].
        crease_mask: (weight of the vertex, weight of each of the two neighbours along the crease).
    """
    count, points = len(state.points), state.points
    child_edge, child_vertex = _decayed(edges.sharpness), _decayed(state.vertex_sharpness)
    ends = edges.vertices

    def rule(edge_sharpness: np.ndarray, vertex_sharpness: np.ndarray) -> np.ndarray:
        sharp = edge_sharpness > 0.0
        number = np.bincount(ends[sharp].reshape(-1), minlength=count)
        other = _sums(ends[sharp].reshape(-1), points[ends[sharp][:, ::-1].reshape(-1)], count)
        crease = crease_mask[0] * points + crease_mask[1] * other
        result = np.where((number == 2)[:, None], crease, smooth)
        return np.where(((number > 2) | (vertex_sharpness > 0.0))[:, None], points, result)

    parent, child = rule(edges.sharpness, state.vertex_sharpness), rule(child_edge, child_vertex)
    # The fading weight: mean sharpness of what is sharp now and smooth after this step.
    fading = (edges.sharpness > 0.0) & (child_edge == 0.0)
    fading_ends = ends[fading].reshape(-1)
    total = np.bincount(fading_ends, np.repeat(edges.sharpness[fading], 2), count).astype(np.float64)
    number = np.bincount(fading_ends, minlength=count).astype(np.float64)
    fading_vertex = (state.vertex_sharpness > 0.0) & (child_vertex == 0.0)
    total[fading_vertex] += state.vertex_sharpness[fading_vertex]
    number[fading_vertex] += 1.0
    weight = np.where(number > 0.0, np.minimum(total / np.maximum(number, 1.0), 1.0), 1.0)[:, None]
    return weight * parent + (1.0 - weight) * child


def _edge_points(edges: _Edges, points: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    middle = 0.5 * (points[edges.vertices[:, 0]] + points[edges.vertices[:, 1]])
    weight = np.minimum(edges.sharpness, 1.0)[:, None]
    return weight * middle + (1.0 - weight) * smooth


def _child_creases(edges: _Edges, vertex_count: int, child_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Keys and sharpness of the two halves of every edge that stays sharp; borders find themselves."""
    decayed = _decayed(edges.sharpness)
    kept = np.flatnonzero((decayed > 0.0) & ~edges.border)
    middle = vertex_count + kept
    key = np.concatenate([edges.vertices[kept, k] * child_count + middle for k in (0, 1)])
    order = np.argsort(key)
    return key[order], np.tile(decayed[kept], 2)[order]


def _refine_quads(state: _State) -> _State:
    """One Catmull-Clark step; vertices are ordered old vertices, edges, faces."""
    edges = _Edges(state)
    points, count, edge_count = state.points, len(state.points), len(edges.vertices)
    sizes = state.counts.astype(np.float64)[:, None]
    face_points = _sums(edges.face_of, points[state.indices], len(state.counts)) / sizes
    around = _sums(edges.edge_of, face_points[edges.face_of], edge_count)
    ends = points[edges.vertices].sum(axis=1)
    smooth_edges = 0.25 * (ends + around)  # only used where two faces meet

    valence = np.bincount(state.indices, minlength=count).astype(np.float64)[:, None]
    face_sum = _sums(state.indices, face_points[edges.face_of], count)
    edge_ends = edges.vertices.reshape(-1)
    edge_valence = np.maximum(np.bincount(edge_ends, minlength=count), 1).astype(np.float64)[:, None]
    neighbour = _sums(edge_ends, points[edges.vertices[:, ::-1].reshape(-1)], count) / edge_valence
    n = np.maximum(valence, 1.0)
    # (Q + 2 R + (n - 3) P) / n with R = (P + mean neighbour) / 2.
    smooth = (face_sum / n + neighbour + (n - 2.0) * points) / n
    new_vertices = _blend_vertices(state, edges, smooth, (0.75, 0.125))
    new_points = np.concatenate([new_vertices, _edge_points(edges, points, smooth_edges), face_points])

    corner = np.arange(len(state.indices))
    ahead, behind = count + edges.edge_of, count + edges.edge_of[edges.prev_corner]
    quads = np.stack([state.indices, ahead, count + edge_count + edges.face_of, behind], axis=1)
    varying = state.varying
    if varying is not None:
        centre = _sums(edges.face_of, varying[state.indices], len(state.counts)) / sizes
        varying = np.concatenate([varying, varying[edges.vertices].mean(axis=1), centre])
    corner_values = state.face_varying
    if corner_values is not None:
        centre = (_sums(edges.face_of, corner_values, len(state.counts)) / sizes)[edges.face_of]
        ahead_value = 0.5 * (corner_values + corner_values[edges.next_corner])
        behind_value = 0.5 * (corner_values + corner_values[edges.prev_corner])
        corner_values = np.stack([corner_values, ahead_value, centre, behind_value], axis=1)
        corner_values = corner_values.reshape(4 * len(corner), -1)
    key, sharpness = _child_creases(edges, count, len(new_points))
    return _State(
        np.full(len(quads), 4, np.int64),
        quads.reshape(-1),
        new_points,
        varying,
        corner_values,
        state.source[edges.face_of],
        state.holes[edges.face_of],
        key,
        sharpness,
        np.concatenate([_decayed(state.vertex_sharpness), np.zeros(len(new_points) - count)]),
    )


def _refine_triangles(state: _State) -> _State:
    """One Loop step; vertices are ordered old vertices, edges."""
    edges = _Edges(state)
    points, count, edge_count = state.points, len(state.points), len(edges.vertices)
    opposite = points[state.indices[edges.prev_corner]]
    smooth_edges = 0.375 * points[edges.vertices].sum(axis=1) + 0.125 * _sums(edges.edge_of, opposite, edge_count)
    ends = edges.vertices.reshape(-1)
    valence = np.bincount(ends, minlength=count).astype(np.float64)
    neighbours = _sums(ends, points[edges.vertices[:, ::-1].reshape(-1)], count)
    beta = _loop_beta(valence)[:, None]
    smooth = (1.0 - valence[:, None] * beta) * points + beta * neighbours
    new_vertices = _blend_vertices(state, edges, smooth, (0.75, 0.125))
    new_points = np.concatenate([new_vertices, _edge_points(edges, points, smooth_edges)])

    a, b, c = state.indices.reshape(-1, 3).T
    ab, bc, ca = (count + edges.edge_of.reshape(-1, 3)).T
    triangles = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    varying = state.varying
    if varying is not None:
        varying = np.concatenate([varying, varying[edges.vertices].mean(axis=1)])
    corner_values = state.face_varying
    if corner_values is not None:
        at = corner_values.reshape(len(a), 3, -1)
        half = 0.5 * (at + at[:, [1, 2, 0]])
        order = [at[:, 0], half[:, 0], half[:, 2], at[:, 1], half[:, 1], half[:, 0]]
        order += [at[:, 2], half[:, 2], half[:, 1], half[:, 0], half[:, 1], half[:, 2]]
        corner_values = np.stack(order, axis=1).reshape(3 * len(triangles), -1)
    key, sharpness = _child_creases(edges, count, len(new_points))
    return _State(
        np.full(len(triangles), 3, np.int64),
        triangles.reshape(-1),
        new_points,
        varying,
        corner_values,
        np.repeat(state.source, 4),
        np.repeat(state.holes, 4),
        key,
        sharpness,
        np.concatenate([_decayed(state.vertex_sharpness), np.zeros(len(new_points) - count)]),
    )


def _loop_beta(valence: np.ndarray) -> np.ndarray:
    """Loop's weight of each neighbour of a smooth vertex."""
    n = np.maximum(valence, 1.0)
    return (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / n)) ** 2) / n


class _Fans:
    """The corners at each vertex in order around it, cut where the surface has a crease there.

    Attributes:
        fan_of_corner: int64 [corner_count].
        place: Position of each corner in its fan, counter-clockwise from outside.
        vertex, size: Per fan, int64.
        closed: Per fan: it goes all around and has no crease.
    """

    def __init__(self, state: _State, edges: _Edges):
        count, corner_count = len(state.points), len(state.indices)
        # Half-edges of one edge in opposite directions pair up; a border has none to go to.
        forward = state.indices == edges.vertices[edges.edge_of, 0]
        pair = np.full((len(edges.vertices), 2), -1, np.int64)
        pair[edges.edge_of, forward.astype(np.int64)] = np.arange(corner_count)
        twin = pair[edges.edge_of, (~forward).astype(np.int64)]
        twin[edges.border[edges.edge_of]] = -1
        sharp = edges.sharpness > 0.0
        sharp_number = np.bincount(edges.vertices[sharp].reshape(-1), minlength=count)
        creased = (sharp_number >= 2) | (state.vertex_sharpness > 0.0)
        cut_ahead = (sharp[edges.edge_of] & creased[state.indices]) | (twin < 0)
        # Counter-clockwise neighbour: over the edge that arrives at the vertex.
        after = twin[edges.prev_corner]
        behind_edge = edges.edge_of[edges.prev_corner]
        stops = (sharp[behind_edge] & creased[state.indices]) | (after < 0)

        self.fan_of_corner = np.full(corner_count, -1, np.int64)
        self.place = np.zeros(corner_count, np.int64)
        starts = np.flatnonzero(cut_ahead)
        self._walk(starts, 0, after, stops)
        first_closed = len(starts)
        left = np.flatnonzero(self.fan_of_corner < 0)
        while len(left):
            # A full ring starts anywhere: at its lowest corner. A second ring at a vertex takes another turn.
            _, lowest = np.unique(state.indices[left], return_index=True)
            ring = left[lowest]
            self._walk(ring, len(starts), after, stops)
            starts = np.concatenate([starts, ring])
            left = left[self.fan_of_corner[left] < 0]
        self.vertex = state.indices[starts]
        self.size = np.bincount(self.fan_of_corner, minlength=len(starts))
        self.closed = np.arange(len(starts)) >= first_closed

    def _walk(self, starts: np.ndarray, first_fan: int, after: np.ndarray, stops: np.ndarray) -> None:
        """Number the corners reached from each start, one step around all vertices at a time."""
        current, fan, place = starts, first_fan + np.arange(len(starts)), 0
        while len(current):
            self.fan_of_corner[current] = fan
            self.place[current] = place
            going = ~stops[current]
            current, fan = after[current[going]], fan[going]
            fresh = self.fan_of_corner[current] < 0
            current, fan, place = current[fresh], fan[fresh], place + 1


def _limit(scheme: str, state: _State, edges: _Edges, fans: _Fans) -> tuple[np.ndarray, np.ndarray]:
    """(limit values [vertex_count, width], unit normals [fan_count, 3])."""
    points, count = state.points, len(state.points)
    ahead = points[state.indices[edges.next_corner]]
    behind = points[state.indices[edges.prev_corner]]
    fan, fan_count = fans.fan_of_corner, len(fans.vertex)
    size = fans.size.astype(np.float64)
    step = fans.place.astype(np.float64)

    smooth_fan = fans.closed & (state.vertex_sharpness[fans.vertex] == 0.0)
    limit = points.copy()
    ring = smooth_fan[fan]
    if scheme == "catmullClark":
        across = points[state.indices[edges.next_corner[edges.next_corner]]]
        total = _sums(fan, 4.0 * ahead + across, fan_count)
        smooth = (size[:, None] ** 2 * points[fans.vertex] + total) / (size * (size + 5.0))[:, None]
    else:
        across = None
        chi = 1.0 / (0.375 / _loop_beta(size) + size)
        smooth = (1.0 - size * chi)[:, None] * points[fans.vertex] + chi[:, None] * _sums(fan, ahead, fan_count)
    limit[fans.vertex[smooth_fan]] = smooth[smooth_fan]
    sharp = edges.sharpness > 0.0
    sharp_ends = edges.vertices[sharp]
    sharp_number = np.bincount(sharp_ends.reshape(-1), minlength=count)
    along = _sums(sharp_ends.reshape(-1), points[sharp_ends[:, ::-1].reshape(-1)], count)
    crease = (sharp_number == 2) & (state.vertex_sharpness == 0.0)
    limit[crease] = ((4.0 * points + along) / 6.0)[crease]

    xyz, ahead, behind = points[:, :3], ahead[:, :3], behind[:, :3]
    across = None if across is None else across[:, :3]
    first, second = np.zeros((fan_count, 3)), np.zeros((fan_count, 3))
    if ring.any():
        angle = 2.0 * np.pi / size  # per fan; per corner only one sine and cosine are taken
        turn, c, s = step * angle[fan], np.cos(angle), np.sin(angle)
        cosine, sine = np.where(ring, np.cos(turn), 0.0), np.where(ring, np.sin(turn), 0.0)
        weight = 1.0 + c + np.cos(0.5 * angle) * np.sqrt(2.0 * (9.0 + c)) if across is not None else None
        for tangent, here, there in (
            (first, cosine, cosine * c[fan] - sine * s[fan]),
            (second, sine, sine * c[fan] + cosine * s[fan]),
        ):
            along_edges = _sums(fan, here[:, None] * ahead, fan_count)
            if across is None:
                tangent += along_edges
            else:
                tangent += weight[:, None] * along_edges
                tangent += _sums(fan, (here + there)[:, None] * across, fan_count)
    open_fan = ~smooth_fan
    if open_fan.any():
        _open_tangents(first, second, xyz[fans.vertex], fan, fans, ahead, behind, across, crease[fans.vertex])
    normals = np.cross(first, second)
    # Where the tangents do not span a plane (a corner, a degenerate ring): the facets around decide; they
    # also tell which side is out.
    p_limit = limit[:, :3]
    facet = np.cross(
        p_limit[state.indices[edges.next_corner]] - p_limit[state.indices],
        p_limit[state.indices[edges.prev_corner]] - p_limit[state.indices],
    )
    facets = _sums(fan, facet, fan_count)
    squared = (first**2).sum(axis=1) * (second**2).sum(axis=1)
    flat = ~((normals**2).sum(axis=1) > TANGENT_PARALLEL * squared)
    normals = np.where(flat[:, None], facets, normals)
    normals *= np.where(np.einsum("nk,nk->n", normals, facets) < 0.0, -1.0, 1.0)[:, None]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return limit, np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])


def _open_tangents(first, second, vertex, fan, fans: _Fans, ahead, behind, across, crease) -> None:
    """Tangents of the fans that end at creases or borders, written into `first` and `second` [fan_count, 3].

    Along the crease, and across it by Biermann et al. (quads) or the ring's eigenvector (triangles); a fan
    at a corner has its two end edges. `vertex` [fan_count, 3], `ahead`, `behind`, `across` [corner_count, 3].
    """
    fan_count = len(vertex)
    is_open = ~fans.closed
    start, last = fans.place == 0, fans.place == fans.size[fan] - 1
    begin, end = np.zeros((fan_count, 3)), np.zeros((fan_count, 3))
    begin[fan[start]] = ahead[start]
    end[fan[last]] = behind[last]
    by_rule = is_open & crease & (fans.size >= 2)
    corner = is_open & ~by_rule
    first[corner], second[corner] = (begin - vertex)[corner], (end - vertex)[corner]
    if not by_rule.any():
        return
    first[by_rule] = (begin - end)[by_rule]
    k = fans.size.astype(np.float64)
    theta = np.pi / np.maximum(k, 2.0)
    inner = by_rule[fan] & ~start  # the edge ahead of every corner but the first lies inside the fan
    i, t = fans.place.astype(np.float64), theta[fan]
    if across is None:
        # Left eigenvector of the ring's subdivision matrix for 3/8 + cos(theta) / 4: sin(i theta) at the
        # inner edges, and at the vertex and the two ends what the matrix' columns ask for.
        value = _sums(fan[inner], (np.sin(i * t)[:, None] * ahead)[inner], fan_count)
        inside = np.bincount(fan[inner], np.sin(i * t)[inner], fan_count).astype(np.float64)
        root = 0.375 + 0.25 * np.cos(theta)
        # (1/2 - root) at_end + at_vertex / 8 = -sin(theta) / 8;  at_end + (3/4 - root) at_vertex = -3/8
        # inside
        determinant = (0.5 - root) * (0.75 - root) - 0.125
        at_end = (-0.125 * np.sin(theta) * (0.75 - root) + 0.046875 * inside) / determinant
        at_vertex = ((0.5 - root) * -0.375 * inside + 0.125 * np.sin(theta)) / determinant
        tangent = value + at_vertex[:, None] * vertex + at_end[:, None] * (begin + end)
    else:
        c, s = np.cos(theta), np.sin(theta)
        r = (c + 1.0) / s
        value = _sums(fan[inner], (4.0 * np.sin(i * t)[:, None] * ahead)[inner], fan_count)
        faces = by_rule[fan]
        weight = np.sin(i * t) + np.sin((i + 1.0) * t)
        value += _sums(fan[faces], (weight[:, None] * across)[faces], fan_count)
        tangent = value + (4.0 * r * (c - 1.0))[:, None] * vertex - (r * (1.0 + 2.0 * c))[:, None] * (begin + end)
    second[by_rule] = tangent[by_rule]
