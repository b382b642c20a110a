"""A mirror's mesh cut into sheets that one reflector map each can hold: convex, concave and flat ones. Host, float64.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 6.2: concave and
convex pieces and the closed objects that accompany open ones were made by hand there, and an automatic preprocess was left
open. Here: principal curvatures per triangle (Rusinkiewicz, "Estimating Curvatures and Their Derivatives on Triangle
Meshes", 2004), regions of one sign grown over smooth edges, slivers given to their neighbours, and what is not
star-shaped about a point split until it is. A region that curves both ways belongs to no sheet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_reflect.at_rest import AtRest
from warp_reflect.bodies import Sheet, fit_sheet, overhang, weld
from warp_reflect.scene import PartRange, Scene
from warp_reflect.topology import edge_neighbours

EDGE_SINE_MAX = 0.3  # 17 degrees; facets of a coarse but smooth body stay below, the rim of a cylinder is far above
CREASE_COS = 0.85  # 32 degrees: facets that turn by more do not share a vertex normal
# Curvature times the mesh's size below which a triangle counts as flat: a radius of 50 sizes.
FLAT_CURVATURE = 0.02
# Likewise: a fillet of a smaller radius turns within three texels of a map with 128 nodes, which cannot hold it.
CURVATURE_MAX = 40.0
SIGN_SHARE = 0.04  # of the larger curvature: a smaller one of the other sign is the tessellation's noise
SMOOTH_STEPS = 2  # times that curvatures are averaged with the neighbours'
SLIVER_SHARE = 0.003  # of the mesh's area: a smaller region is noise of its neighbour, or left out
SLIVER_ROUNDS = 3
PIECE_SHARE = 0.004  # of the mesh's area: a smaller sheet is not worth a pass over the scene's vertices
PIECES_MAX = 16
SPLIT_DEPTH = 5
NORMAL_WEIGHT = 0.7  # of a unit normal against a position in sizes, where a region is split in two
# 85 degrees between a facet's normal and the ray that reaches it: beyond, its map is stretched too much to be of use.
COSINE_MIN = 0.08
# Of a sheet's size: a corner may stand out over other facets by so much. Where a sheet is not convex a vertex has pictures
# that a search for one does not find: at 1e-2 one pixel in 300 of a car showed what lies behind, at 8e-4 one in 1500.
OVERHANG_MAX = 8.0e-4
TRIM_SHARE = 0.5  # of a region's area that must be left when its overhung triangles are cut off; else it is halved
FLATNESS_MAX = 1.0e-6  # of a sheet's size: off its plane by less it is a plane

FLAT, CONVEX, CONCAVE, SADDLE, SHARP = range(5)


@dataclass(frozen=True)
class Segment:
    """One sheet of a mirror.

    Attributes:
        triangles: Ascending ids into the mesh's triangles, int64 [n].
        kind: "planar", "convex" or "concave", seen from the front of its triangles.
        sheet: Its frame as the surface of a body, which lies behind a convex sheet and before a concave one.
        area: Of its triangles. [units^2]
    """

    triangles: np.ndarray
    kind: str
    sheet: Sheet
    area: float


@dataclass(frozen=True)
class Segmentation:
    """The sheets of a mesh, largest first, and what none of them holds.

    Attributes:
        segments: At most `PIECES_MAX`.
        held: Share of the area that they hold.
        saddle: Share of the area that curves both ways.
        sharp: Share of the area that curves more than a map resolves.
    """

    segments: list[Segment]
    held: float
    saddle: float
    sharp: float

    def __str__(self) -> str:
        counts = [(kind, sum(s.kind == kind for s in self.segments)) for kind in ("convex", "concave", "planar")]
        kinds = ", ".join(f"{count} {kind}" for kind, count in counts if count) or "none"
        number = len(self.segments)
        text = f"{number} piece{'s' * (number != 1)} hold{'s' * (number == 1)} {100 * self.held:.0f} % "
        text += f"of its triangles' area: {kinds}"
        if self.held < 0.9995:
            text += f"; {100 * (1 - self.held):.1f} % traced"
            reasons = [(self.saddle, "curves both ways"), (self.sharp, "curves too sharply")]
            listed = ", ".join(f"{100 * share:.1f} % {why}" for share, why in reasons if share > 0.0005)
            text += f" ({listed})" if listed else ""
        return text


def part_mesh(scene: Scene, part: PartRange) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(points, triangles, corner normals) of a part, scene frame; flat facets get their own."""
    triangles = slice(part.first_triangle, part.first_triangle + part.triangle_count)
    points = scene.host_points[part.first_vertex : part.first_vertex + part.vertex_count]
    faces = scene.host_triangles[triangles] - part.first_vertex
    return points, faces, _corner_normals(points, faces, scene.host_normal_index[triangles], scene.host_normals)


def mesh_at_rest(rest: AtRest) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a part that moves, in the frame where it rests."""
    points, faces, normals, index = rest.shape()
    if normals is None:
        return points, faces, _corner_normals(points, faces, np.full_like(faces, -1), points)
    return points, faces, _corner_normals(points, faces, index, normals)


def _corner_normals(points: np.ndarray, faces: np.ndarray, index: np.ndarray, normals: np.ndarray) -> np.ndarray:
    corner = points[faces].astype(np.float64)
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    facet /= np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1.0e-300)
    found = np.repeat(facet[:, None], 3, axis=1)
    smooth = index[:, 0] >= 0
    found[smooth] = normals[index[smooth]]
    return found


def segment(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> Segmentation:
    """Cut a mesh into sheets.

    Args:
        points: Float [vertex_count, 3].
        faces: Int [triangle_count, 3], counter-clockwise seen from the front.
        normals: Unit normals at the corners, float [triangle_count, 3, 3]; equal on a triangle where it is flat.

    Returns:
        The same for the same input, bit by bit.
    """
    corner = points.astype(np.float64)[faces]
    low, high = corner.reshape(-1, 3).min(axis=0), corner.reshape(-1, 3).max(axis=0)
    size = float((high - low).max()) or 1.0
    local = (corner - 0.5 * (low + high)) / size
    facet = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
    area = 0.5 * np.linalg.norm(facet, axis=1)
    total = max(float(area.sum()), 1.0e-300)
    unit = facet / np.maximum(2.0 * area, 1.0e-300)[:, None]
    welded = weld(points, faces)
    solid = area > 1.0e-14
    across = edge_neighbours(welded)
    smooth_normals = _vertex_normals(welded, unit, area, normals)
    a, b, length = _smooth_edges(welded, across, unit, smooth_normals, local, solid)
    low_curvature, high_curvature = _curvatures(local, unit, smooth_normals, solid)
    for _ in range(SMOOTH_STEPS):
        low_curvature, high_curvature = (_average(k, area, a, b) for k in (low_curvature, high_curvature))
    label = _label(low_curvature, high_curvature)
    region, kind = _regions(label, solid, a, b)
    region, kind = _absorb_slivers(region, kind, area / total, a, b, length)
    found: list[Segment] = []
    for number in np.unique(region):
        if kind[number] in (SADDLE, SHARP):
            continue
        inside = region == number
        place = np.cumsum(inside) - 1
        kept = inside[a] & inside[b]
        members = np.flatnonzero(inside)
        found += _sheets(local, unit, area, total, members, kind[number], place[a[kept]], place[b[kept]], SPLIT_DEPTH)
    found.sort(key=lambda s: (-s.area, s.triangles[0]))
    found = found[:PIECES_MAX]
    scaled = [
        Segment(s.triangles, s.kind, s.sheet.placed(size, 0.5 * (low + high)), s.area * size * size) for s in found
    ]
    held = sum(s.area for s in found) / total
    saddle, sharp = (float(area[[kind[r] == k for r in region]].sum()) / total for k in (SADDLE, SHARP))
    return Segmentation(scaled, float(held), saddle, sharp)


def _vertex_normals(welded, unit, area, normals) -> np.ndarray:
    """Normals at the corners, [n, 3, 3]: the authored ones; on flat triangles the mean over facets without a crease."""
    result = normals.astype(np.float64).copy()
    spread = np.abs(result - result[:, :1]).max(axis=(1, 2))
    flat = spread < 1.0e-7
    if not flat.any():
        return result
    vertex = welded.reshape(-1)
    order = np.argsort(vertex, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(vertex[order]) > 0])
    counts = np.diff(np.r_[starts, len(order)])
    # Every corner with every corner of the same vertex; around poles of many facets every k-th will do.
    stride = np.maximum(1, -(-counts // 32))
    used = -(-counts // stride)
    group = np.repeat(np.arange(len(starts)), counts)
    pair_count = used[group]
    first = np.repeat(np.arange(len(order)), pair_count)
    place = np.arange(len(first)) - np.repeat(np.cumsum(pair_count) - pair_count, pair_count)
    second = starts[group[first]] + place * stride[group[first]]
    own, other = order[first] // 3, order[second] // 3
    weight = area[other] * (np.einsum("ij,ij->i", unit[own], unit[other]) > CREASE_COS)
    total = np.empty((len(order), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(order[first], weights=weight * unit[other, axis], minlength=len(order))
    length = np.linalg.norm(total, axis=1)
    facets = np.repeat(unit, 3, axis=0)
    mean = np.where(length[:, None] > 0.0, total / np.maximum(length, 1.0e-300)[:, None], facets)
    result[flat] = mean.reshape(-1, 3, 3)[flat]
    return result


def _smooth_edges(welded, across, unit, normals, local, solid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of triangles that an edge without a crease joins in the same sense (each once), and the edge's length."""
    triangle, edge = np.nonzero(across > np.arange(len(across))[:, None])
    other = across[triangle, edge]
    start, end = welded[triangle, edge], welded[triangle, (edge + 1) % 3]
    place_start = (welded[other] == start[:, None]).argmax(axis=1)
    place_end = (welded[other] == end[:, None]).argmax(axis=1)
    opposite = (place_end + 1) % 3 == place_start
    jump = np.zeros(len(triangle))
    for own, far in ((edge, place_start), ((edge + 1) % 3, place_end)):
        n, m = normals[triangle, own], normals[other, far]
        sine = np.linalg.norm(np.cross(n, m), axis=1)
        jump = np.maximum(jump, np.where(np.einsum("ij,ij->i", n, m) > 0.0, sine, 1.0))
    facets = np.einsum("ij,ij->i", unit[triangle], unit[other])
    keep = opposite & (jump <= EDGE_SINE_MAX) & (facets > 0.5) & solid[triangle] & solid[other]
    length = np.linalg.norm(local[triangle, (edge + 1) % 3] - local[triangle, edge], axis=1)
    return triangle[keep], other[keep], length[keep]


def _curvatures(local, unit, normals, solid) -> tuple[np.ndarray, np.ndarray]:
    """Principal curvatures (lower, higher) per triangle, positive where convex, from the normals' change along edges."""
    edge = np.stack([local[:, (k + 1) % 3] - local[:, k] for k in range(3)], 1)
    change = np.stack([normals[:, (k + 1) % 3] - normals[:, k] for k in range(3)], 1)
    x = edge[:, 0] / np.maximum(np.linalg.norm(edge[:, 0], axis=1, keepdims=True), 1.0e-300)
    y = np.cross(unit, x)
    u, v = np.einsum("nkj,nj->nk", edge, x), np.einsum("nkj,nj->nk", edge, y)
    du, dv = np.einsum("nkj,nj->nk", change, x), np.einsum("nkj,nj->nk", change, y)
    # Least squares of [u v 0; 0 u v] (a, b, c) = (du, dv) over the three edges.
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    zero = np.zeros_like(uu)
    matrix = np.stack([np.stack([uu, uv, zero], 1), np.stack([uv, uu + vv, uv], 1), np.stack([zero, uv, vv], 1)], 1)
    right = np.stack([(u * du).sum(1), (v * du + u * dv).sum(1), (v * dv).sum(1)], 1)
    good = solid & (np.linalg.det(matrix) > 1.0e-12 * np.maximum(uu + vv, 1.0e-300) ** 3)
    shape = np.zeros((len(local), 3))
    shape[good] = np.linalg.solve(matrix[good], right[good][..., None])[..., 0]
    mean = 0.5 * (shape[:, 0] + shape[:, 2])
    radius = np.hypot(0.5 * (shape[:, 0] - shape[:, 2]), shape[:, 1])
    return mean - radius, mean + radius


def _average(value, area, a, b) -> np.ndarray:
    """Area-weighted mean over a triangle and those that smooth edges join to it."""
    count = len(value)
    weighted = value * area
    total = weighted + np.bincount(a, weighted[b], count) + np.bincount(b, weighted[a], count)
    weight = area + np.bincount(a, area[b], count) + np.bincount(b, area[a], count)
    return total / np.maximum(weight, 1.0e-300)


def _label(low, high) -> np.ndarray:
    largest = np.maximum(np.abs(low), np.abs(high))
    slack = np.maximum(SIGN_SHARE * largest, FLAT_CURVATURE)
    label = np.full(len(low), SADDLE)
    label[low >= -slack] = CONVEX
    label[(high <= slack) & (low < -slack)] = CONCAVE
    label[largest <= FLAT_CURVATURE] = FLAT
    label[largest > CURVATURE_MAX] = SHARP
    return label


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The lowest member of each item's component in the graph with edges (a, b), int64 [count]."""
    parent = np.arange(count)
    while True:
        low, high = np.minimum(parent[a], parent[b]), np.maximum(parent[a], parent[b])
        differs = low != high
        if not differs.any():
            return parent
        np.minimum.at(parent, high[differs], low[differs])
        while True:
            following = parent[parent]
            if (following == parent).all():
                break
            parent = following


def _regions(label, solid, a, b) -> tuple[np.ndarray, dict[int, int]]:
    """Connected regions of one kind; flat triangles go with the convex, else the concave region that they touch."""
    region = np.full(len(label), -1)
    kind: dict[int, int] = {-1: SHARP}
    for wanted in (CONVEX, CONCAVE, FLAT, SADDLE, SHARP):
        open_ = (region < 0) & solid
        member = open_ & ((label == wanted) | ((label == FLAT) & (wanted in (CONVEX, CONCAVE))))
        inside = member[a] & member[b]
        root = components(len(label), a[inside], b[inside])
        # Only components that hold a triangle of the wanted kind.
        rooted = np.zeros(len(label), bool)
        rooted[root[member & (label == wanted)]] = True
        taken = member & rooted[root]
        region[taken] = root[taken]
        kind.update(dict.fromkeys(np.unique(root[taken]).tolist(), wanted))
    return region, kind


def _absorb_slivers(region, kind, share, a, b, length) -> tuple[np.ndarray, dict[int, int]]:
    """Give regions too small to be a sheet to the neighbour with which they share the most border."""
    region = region.copy()
    for _ in range(SLIVER_ROUNDS):
        size = np.bincount(np.maximum(region, 0), share * (region >= 0), len(region))
        ra, rb = region[a], region[b]
        border = (ra != rb) & (ra >= 0) & (rb >= 0)
        small = np.concatenate([ra[border], rb[border]])
        large = np.concatenate([rb[border], ra[border]])
        weight = np.tile(length[border], 2)
        good = (size[small] < SLIVER_SHARE) & (size[large] > size[small])
        if not good.any():
            break
        pair, inverse = np.unique(small[good] * len(region) + large[good], return_inverse=True)
        shared = np.bincount(inverse.reshape(-1), weight[good])
        order = np.lexsort((-pair, shared))  # the longest border last wins
        target = np.arange(len(region))
        target[pair[order] // len(region)] = pair[order] % len(region)
        region = np.where(region >= 0, target[np.maximum(region, 0)], region)
    return region, kind


def _sheets(local, unit, area, total, members, kind, a, b, depth) -> list[Segment]:
    """The sheets of one region: itself if a map can hold it, else those of what is left of it, trimmed or halved.

    (a, b) are the smooth edges within the region, as places in `members`.
    """
    own = area[members]
    if float(own.sum()) < PIECE_SHARE * total:
        return []
    corner, normal = local[members], unit[members]
    if _flatness(corner, normal, own) <= FLATNESS_MAX:
        return [Segment(members, "planar", fit_sheet(corner, inner=False), float(own.sum()))]
    tries = {FLAT: (False, True), CONVEX: (False,), CONCAVE: (True,)}[kind]
    for inner in tries:
        sheet = fit_sheet(corner, inner)
        if sheet.cosine >= COSINE_MIN and sheet.overhang <= OVERHANG_MAX:
            return [Segment(members, "concave" if inner else "convex", sheet, float(own.sum()))]
    if depth == 0:
        return []
    chosen = overhang(corner, tries[0]) <= OVERHANG_MAX
    if chosen.all() or own[chosen].sum() < TRIM_SHARE * own.sum():
        chosen = _half(corner, normal, own)
    same = chosen[a] == chosen[b]
    root = components(len(members), a[same], b[same])
    found = []
    for number in np.unique(root):
        inside = root == number
        place = np.cumsum(inside) - 1
        kept = inside[a] & same
        if inside.all():
            continue  # nothing was cut off: it would go on like this
        found += _sheets(local, unit, area, total, members[inside], kind, place[a[kept]], place[b[kept]], depth - 1)
    return found


def _half(corner, normal, area) -> np.ndarray:
    """A cut across the direction in which a region's triangles, by place and normal, differ most; bool [n]."""
    middle = corner.mean(axis=1)
    spread = max(float(np.ptp(middle, axis=0).max()), 1.0e-300)
    feature = np.concatenate([middle / spread, NORMAL_WEIGHT * normal], axis=1)
    weight = area / area.sum()
    feature = feature - weight @ feature
    _, vectors = np.linalg.eigh((feature * weight[:, None]).T @ feature)
    axis = vectors[:, -1] * np.sign(vectors[np.abs(vectors[:, -1]).argmax(), -1])
    order = np.argsort(feature @ axis, kind="stable")
    upper = np.zeros(len(area), bool)
    upper[order[np.searchsorted(np.cumsum(weight[order]), 0.5) :]] = True
    return upper


def _flatness(local, unit, area) -> float:
    """Largest distance of the corners from the mean plane, of the sheet's size."""
    normal = (unit * area[:, None]).sum(axis=0)
    length = np.linalg.norm(normal)
    if length == 0.0:
        return np.inf
    corner = local.reshape(-1, 3)
    height = (corner - corner.mean(axis=0)) @ (normal / length)
    return float(np.abs(height).max() / max(float(np.ptp(corner, axis=0).max()), 1.0e-300))
