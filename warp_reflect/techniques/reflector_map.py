"""Reflection points by search in a cube map of the reflector's positions and normals.

Source: Estalella, Martin, Drettakis, Tost, Devillers, Cazals, "Accurate Interactive Specular Reflections on Curved
Objects" (2005), section 4.1 (maps); the search itself is `map_search.py`. What differs:
- the map is node-centred and *whitened* (indexed by position / half extents in principal axes), so that long bodies keep
  their resolution and faces join without seams;
- triangles that straddle the hidden boundary are clipped there, where the virtual and the real point coincide.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.bodies import weld
from warp_reflect.launch import few_registers, launch, module_part
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView
from warp_reflect.scene import PartRange, Scene
from warp_reflect.segments import EDGE_SINE_MAX, Segmentation, mesh_at_rest, part_mesh, segment
from warp_reflect.settings import Settings, Technique
from warp_reflect.techniques import baking, forward, map_vector, pieces, planar, sheet_branches
from warp_reflect.techniques.map_search import (
    SEARCH_MIDPOINT,
    SearchSettings,
    is_visible,
    search_settings,
    solve_vertex,
)
from warp_reflect.techniques.pieces import Piece
from warp_reflect.techniques.vertices import SolveFrame, VertexView, vertices_from

if TYPE_CHECKING:
    from warp_reflect.techniques import grid

wp.set_module_options({"enable_backward": False})

SHEET_EVALUATIONS = 40  # of a search: where a sheet's curvature jumps at its border, steps have to be shortened
PLAIN = module_part(__name__, "plain")  # what vector kernels do elsewhere
HELD_MIN = 0.25  # of a mirror's area; where its sheets hold less, nearly all of it would be traced anyway


@few_registers
@wp.kernel(module=PLAIN)
def search_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    settings: SearchSettings,
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
    solve_vertex(map, frame, camera, settings, target, seed, i, out_vertex)


def search(
    points: wp.array,
    own: list[int],
    map: ReflectorMap,
    frame: SolveFrame,
    camera: CameraView,
    chosen: SearchSettings,
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
        chosen: From `map_search.search_settings`.
        warm: Start from `out_vertex.seed` where it is not zero.
        kernels: `Settings.kernels`.
    """
    count = len(points)
    inputs = [points, *own, map.view, frame, camera, chosen, int(warm), out_vertex]
    if chosen.method != int(SEARCH_MIDPOINT) and vector.chosen(kernels, device):
        vector.launch_blocks(map_vector.search_blocks_kernel, count, inputs, device, threads, map_vector.BLOCKS)
    else:
        launch(search_kernel, count, inputs, device, threads)


@wp.kernel(module=PLAIN)
def boundary_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    map: ReflectorMapView,
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
        if is_visible(map, frame.eye, a + middle * (b - a)):
            low = middle
        else:
            high = middle
    out_point[i] = frame.eye_from_unit * (a + low * (b - a) - frame.eye)


def boundary(
    points: wp.array,
    map: ReflectorMap,
    frame: SolveFrame,
    edges: wp.array,
    steps: int,
    out_point: wp.array,
    device,
    threads: int,
    kernels: str,
) -> None:
    """The last visible point of each edge, see `boundary_kernel`.

    Args:
        points: vec3 [n], scene frame.
        edges: vec2i, (visible vertex, vertex that is not); -1: none.
        steps: Bisections.
        out_point: vec3, eye frame.
        kernels: `Settings.kernels`.
    """
    inputs = [points, map.view, frame, edges, steps, out_point]
    if vector.chosen(kernels, device):
        vector.launch_blocks(map_vector.boundary_blocks_kernel, len(edges), inputs, device, threads)
    else:
        launch(boundary_kernel, len(edges), inputs, device, threads)


@dataclass
class Prepared:
    """What a reflector map needs beside the frame: the map in the scene's frame and the mirror it belongs to."""

    reflector: Reflector
    map: ReflectorMap
    unit_from_scene: np.ndarray  # float64 [4, 4]
    grid: grid.Grid | None = None

    @property
    def bytes(self) -> int:
        return self.map.bytes


@dataclass(frozen=True)
class PreparedPieces:
    """A mirror of several sheets, each with its map.

    Attributes:
        reflector: The mirror.
        pieces: See `pieces.Piece`; triangles that none holds are traced.
        bytes: Of the maps.
    """

    reflector: Reflector
    pieces: list[Piece]
    bytes: int


def applies(scene: Scene, reflector: Reflector) -> tuple[bool, str]:
    """One map holds a closed convex body without sharp edges; of other mirrors every sheet gets its own."""
    if _one_map(scene, reflector.part):
        return True, "closed convex smooth body: one reflection point per vertex"
    segmentation = scene_segments(scene, reflector.part)
    if segmentation.held < HELD_MIN:
        body = scene.body(reflector.part)
        why = body.reason or ("not convex" if not body.convex else "sharp edges")
        return False, f"{why}; {segmentation} (at least {100 * HELD_MIN:.0f} % wanted)"
    return True, str(segmentation)


def extent(scene: Scene, reflector: Reflector) -> tuple[int, float]:
    """(how often a frame reflects every vertex of the scene, share of the mirror that its maps hold)."""
    if _one_map(scene, reflector.part):
        return 1, 1.0
    segmentation = scene_segments(scene, reflector.part)
    return max(len(segmentation.segments), 1), segmentation.held


def has_branches(scene: Scene, reflector: Reflector, camera: Camera) -> bool:
    """Whether the eye sees the hollow side of a sheet, on which every vertex may appear several times."""
    if _one_map(scene, reflector.part):
        return False
    closed = scene.body(reflector.part).closed
    eye = camera.eye - scene.origin
    for kind, corner, area in _facets(scene, reflector.part):
        facing = np.einsum("ij,ij->i", area, eye - corner)
        front, back = (facing > 0.0).any(), (facing < 0.0).any() and not closed
        if (kind == "concave" and front) or (kind == "convex" and back):
            return True
    return False


def _facets(scene: Scene, part: int) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """(kind of a sheet, a corner and twice the area of each facet of it) of a part; kept with the scene."""
    key = "facets", scene.parts[part].first_triangle
    if key not in scene.facts:
        points, faces, _ = part_mesh(scene, scene.parts[part])
        found = []
        for sheet in scene_segments(scene, part).segments:
            a, b, c = points[faces[sheet.triangles]].astype(np.float64).transpose(1, 0, 2)
            found.append((sheet.kind, a, np.cross(b - a, c - a)))
        scene.facts[key] = found
    return scene.facts[key]


def scene_segments(scene: Scene, part: int) -> Segmentation:
    """The sheets of a part; kept with the scene."""
    if part not in scene.segmentations:
        scene.segmentations[part] = segment(*part_mesh(scene, scene.parts[part]))
    return scene.segmentations[part]


def _one_map(scene: Scene, part: int) -> bool:
    key = "one map", scene.parts[part].first_triangle
    known = scene.facts.get(key)
    if known is None:
        known = scene.body(part).convex and _sharpest_of(scene, part) <= EDGE_SINE_MAX
        scene.facts[key] = known
    return known


def _sharpest_of(scene: Scene, part: int) -> float:
    """`_sharpest` of a part; of one that moves wherever it stands."""
    rest = scene.at_rest(part)
    if rest is None:
        return _sharpest(*part_mesh(scene, scene.parts[part]))
    return scene.kept_at_rest(rest, "sharpest", lambda: _sharpest(*mesh_at_rest(rest)))


def _sharpest(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> float:
    """Largest sine between the corner normals of two facets at a point they share (facets at a right angle or more: 1)."""
    corner = weld(points, faces).reshape(-1)
    flat = normals.reshape(-1, 3)
    order = np.argsort(corner, kind="stable")
    starts = np.flatnonzero(np.r_[True, np.diff(corner[order]) > 0])
    middle = np.add.reduceat(flat[order], starts)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1.0e-300)
    spread = np.repeat(middle, np.diff(np.r_[starts, len(order)]), axis=0)
    cosine = np.einsum("ij,ij->i", spread, flat[order])
    sine = np.linalg.norm(np.cross(spread, flat[order]), axis=1)
    # From the mean of both: the jump itself is twice that.
    half = float(np.where(cosine > 0.0, sine, 1.0).max())
    return min(1.0, 2.0 * half)


def prepare(scene: Scene, reflector: Reflector, settings: Settings) -> Prepared | PreparedPieces:
    """Draw the map of a reflector, or those of its sheets; gprims are polished onto their analytic surface."""
    part = scene.parts[reflector.part]
    if not _one_map(scene, reflector.part):
        return _prepare_pieces(scene, reflector, settings)
    points, faces, normals = part_mesh(scene, part)
    polish = _polish(scene, part)
    resolution, body = settings.map_resolution, scene.body(reflector.part)
    draw = partial(
        ReflectorMap.from_mesh,
        points,
        faces,
        resolution,
        normals=normals,
        polish=polish,
        body=body,
        device=scene.device,
    )
    drawn = baking.baked_or_drawn(scene, part, faces, resolution, draw)
    if settings.grid_share <= 0.0 and settings.grid_error_px <= 0.0:
        return Prepared(reflector, drawn, drawn.unit_from_body)
    from warp_reflect.techniques import grid

    return Prepared(reflector, drawn, drawn.unit_from_body, grid.build(scene, part))


def _prepare_pieces(scene: Scene, reflector: Reflector, settings: Settings) -> PreparedPieces:
    part = scene.parts[reflector.part]
    points, faces, normals = part_mesh(scene, part)
    polish = _polish(scene, part)
    found: list[Piece] = []
    total = 0
    for sheet_of in scene_segments(scene, reflector.part).segments:
        members = sheet_of.triangles
        own = members + part.first_triangle
        numbered = replace(reflector, id=len(found) + 1, convex=False)
        if sheet_of.kind == "planar":
            frame = planar.plane_frame(*_mean_plane(points[faces[members]].astype(np.float64)))
            found.append(Piece(own, planar, planar.Prepared(numbered, frame)))
            continue
        draw = partial(
            ReflectorMap.from_sheet,
            points,
            faces[members],
            sheet_of.sheet,
            settings.map_resolution,
            normals=normals[members],
            polish=None if polish is None else _Members(polish, members),
            device=scene.device,
        )
        drawn = baking.baked_or_drawn(scene, part, faces[members], settings.map_resolution, draw)
        total += drawn.bytes
        centre, other = sheet_of.sheet.centre, replace(numbered, id=len(found) + 2)
        outside = Piece(own, sys.modules[__name__], Prepared(numbered, drawn, drawn.unit_from_body), _Side(centre, 1))
        inside = Piece(own, sheet_branches, sheet_branches.Prepared(other, drawn, -1), _Side(centre, -1))
        found += [outside, inside]
    return PreparedPieces(reflector, found, total)


def drawn_maps(prepared: Prepared | PreparedPieces) -> list[ReflectorMap]:
    """The maps of a mirror, in the order of its pieces."""
    if isinstance(prepared, Prepared):
        return [prepared.map]
    return [piece.prepared.map for piece in prepared.pieces if isinstance(piece.prepared, Prepared)]


def _mean_plane(corner: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """(point, unit normal, size) of flat triangles."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    flat = corner.reshape(-1, 3)
    return flat.mean(axis=0), normal / np.linalg.norm(normal), float(np.ptp(flat, axis=0).max())


@dataclass(frozen=True)
class _Side:
    """Which pixels see a sheet from outside (1) or inside (-1) its body: normals on the eye's side and the centre tell."""

    centre: np.ndarray
    side: int

    def __call__(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        return self.side * np.einsum("ij,ij->i", normals, points - self.centre) > 0.0


@dataclass(frozen=True)
class _Members:
    """A polish for some of a part's triangles."""

    polish: _Polish
    members: np.ndarray

    def __call__(self, triangle, origin, directions, distance):
        return self.polish(self.members[triangle], origin, directions, distance)


def _polish(scene: Scene, part: PartRange) -> _Polish | None:
    return _Polish(scene, part) if any(scene.patch_shapes[k] is not None for k in part.patches) else None


class _Polish:
    """Moves map nodes of quadric patches onto the quadric, see `ReflectorMap.from_mesh`."""

    def __init__(self, scene: Scene, part: PartRange):
        self.scene, self.part = scene, part

    def __call__(self, triangle, origin, directions, distance):
        scene, part = self.scene, self.part
        patch = scene.host_triangle_patch[part.first_triangle + triangle]
        distance = distance.copy()
        normal = np.zeros((len(triangle), 3))
        world_origin = origin + scene.origin
        for k in part.patches:
            shape = scene.patch_shapes[k]
            at = np.flatnonzero(patch == k)
            if shape is None or shape.kind != "quadric" or not len(at):
                continue
            unit_from_world = shape.unit_from_object @ np.linalg.inv(part.world_from_object)
            linear = unit_from_world[:3, :3]
            o = linear @ world_origin + unit_from_world[:3, 3]
            d = directions[at] @ linear.T
            diagonal = np.array([1.0, 1.0, shape.a])
            qa = (d * d) @ diagonal
            qb = d @ (o * diagonal) + 0.5 * shape.b * d[:, 2]
            qc = float((o * o) @ diagonal + shape.b * o[2] - shape.c)
            root = np.sqrt(np.maximum(qb * qb - qa * qc, 0.0))
            q = -(qb + np.where(qb < 0.0, -root, root))
            with np.errstate(divide="ignore", invalid="ignore"):
                roots = np.stack([q / qa, qc / q])
            roots = np.where(np.isfinite(roots), roots, np.inf)
            nearest = np.abs(roots - distance[at]).argmin(axis=0)
            t = roots[nearest, np.arange(len(at))]
            good = np.isfinite(t) & (qb * qb - qa * qc >= 0.0)
            t = np.where(good, t, distance[at])
            distance[at] = t
            p = o + t[:, None] * d
            gradient = p * diagonal
            gradient[:, 2] += 0.5 * shape.b
            n = gradient @ linear
            length = np.linalg.norm(n, axis=1)
            good &= length > 0.0
            n /= np.maximum(length, 1.0e-300)[:, None]
            n *= np.sign(np.einsum("ij,ij->i", n, directions[at]))[:, None]
            normal[at[good]] = n[good]
        return distance, normal


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Search every vertex, draw the virtual meshes, refine: see `forward.reflect` and, for sheets, `pieces.reflect`."""
    if isinstance(prepared, PreparedPieces):
        method = Technique.REFLECTOR_MAP
        mirror, found = prepared.reflector, prepared.pieces
        return pieces.reflect(scene, mirror, method, found, gbuffer, pixels, camera, settings, history)
    part = scene.parts[prepared.reflector.part]
    chosen = search_settings(settings, prepared.map.resolution)
    if not prepared.map.closed and not settings.iterations:
        chosen.iterations = SHEET_EVALUATIONS
    statistics, used = {}, []

    def solve(points, own: list[int], frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        run_on = scene.device, settings.threads, settings.kernels
        search(points, own, prepared.map, frame, gbuffer.view, chosen, warm, out_vertex, *run_on)

    def solve_vertices(points, has_own: bool, frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        own = forward.own_vertices(part) if has_own else [0, 0]
        if prepared.grid is None or not has_own:
            solve(points, own, frame, warm, out_vertex)
            return
        from warp_reflect.techniques import grid

        counts, cells = grid.fill(
            scene,
            prepared.grid,
            lambda asked, out: solve(asked, [0, 0], frame, True, out),
            frame,
            prepared.map,
            gbuffer.view,
            camera,
            pixels.box,
            settings,
            out_vertex,
        )
        statistics.update(counts)
        used.append(cells)
        if len(points) > scene.vertex_count:
            # Vertices of triangles that the previous frame cut.
            added = vertices_from(out_vertex, scene.vertex_count)
            solve(points[scene.vertex_count :], [0, 0], frame, warm, added)

    def solve_boundary(points, frame: SolveFrame, edges: wp.array, out_point: wp.array) -> None:
        steps, run_on = forward.BOUNDARY_STEPS[settings.refine], (scene.device, settings.threads, settings.kernels)
        boundary(points, prepared.map, frame, edges, steps, out_point, *run_on)

    layer = forward.reflect(
        scene,
        prepared.reflector,
        Technique.REFLECTOR_MAP,
        prepared.unit_from_scene,
        solve_vertices,
        solve_boundary,
        gbuffer,
        pixels,
        camera,
        settings,
        history,
        prepared.map.view.greatest_curvature,
        wary=not prepared.map.closed,  # near its rim a sheet map feels the companion
    )
    layer.statistics.update(statistics)
    layer.cells += used
    return layer
