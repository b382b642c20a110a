"""Reflection points by search in a cube map of the reflector's positions and normals.

Source: Estalella, Martin, Drettakis, Tost, Devillers, Cazals, "Accurate Interactive Specular Reflections on Curved
Objects" (2005), section 4.1 (maps); the search itself is `map_search.py`. What differs:
- the map is node-centred and *whitened* (indexed by position / half extents in principal axes), so that long bodies keep
  their resolution and faces join without seams;
- triangles that straddle the hidden boundary are clipped there, where the virtual and the real point coincide.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import warp as wp

from warp_reflect.bodies import weld
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings, Technique
from warp_reflect.techniques import baking, forward, grid
from warp_reflect.techniques.map_search import SearchSettings, is_visible, search_settings, solve_vertex
from warp_reflect.techniques.vertices import SolveFrame, VertexView, vertices_from

wp.set_module_options({"enable_backward": False})

EDGE_SINE_MAX = 0.3  # 17 degrees; facets of a coarse but smooth body stay below, the rim of a cylinder is far above


@wp.kernel
def search_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: CameraView,
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


@wp.kernel
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


def part_mesh(scene: Scene, part: PartRange) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """(points, triangles, corner normals or None) of a part, scene frame; flat facets get no normals."""
    triangles = slice(part.first_triangle, part.first_triangle + part.triangle_count)
    points = scene.host_points[part.first_vertex : part.first_vertex + part.vertex_count]
    faces = scene.host_triangles[triangles] - part.first_vertex
    index = scene.host_normal_index[triangles]
    corner = points[faces].astype(np.float64)
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    facet /= np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1.0e-300)
    normals = np.repeat(facet[:, None], 3, axis=1)
    smooth = index[:, 0] >= 0
    normals[smooth] = scene.host_normals[index[smooth]]
    return points, faces, normals


def applies(scene: Scene, reflector: Reflector) -> tuple[bool, str]:
    """A closed convex body without sharp edges can be held by one map."""
    body = scene.body(reflector.part)
    if not body.convex:
        return False, body.reason or "not convex: several reflection points per vertex"
    sine = _sharpest(*part_mesh(scene, scene.parts[reflector.part]))
    if sine > EDGE_SINE_MAX:
        return (
            False,
            f"sharp edges: its normals jump by a sine of {sine:.2f} (at most {EDGE_SINE_MAX}); a map smooths them",
        )
    return True, "closed convex smooth body: one reflection point per vertex"


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


def prepare(scene: Scene, reflector: Reflector, settings: Settings) -> Prepared:
    """Draw the map of a reflector; gprims are polished onto their analytic surface."""
    part = scene.parts[reflector.part]
    points, faces, normals = part_mesh(scene, part)
    polish = _Polish(scene, part) if any(scene.patch_shapes[k] is not None for k in part.patches) else None
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
    gridded = settings.grid_share > 0.0 or settings.max_error_px > 0.0
    cells = grid.build(scene, part) if gridded else None
    return Prepared(reflector, drawn, drawn.unit_from_body, cells)


def drawn_maps(prepared: Prepared) -> list[ReflectorMap]:
    """The maps of a mirror, in the order of its pieces."""
    return [prepared.map]


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
    """Search every vertex, draw the virtual meshes, refine: see `forward.reflect`."""
    part = scene.parts[prepared.reflector.part]
    chosen = search_settings(settings, prepared.map.resolution)
    statistics = {}

    def search(points, own: list[int], frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        inputs = [points, *own, prepared.map.view, frame, gbuffer.view, chosen, int(warm), out_vertex]
        launch(search_kernel, len(points), inputs, scene.device, settings.threads)

    def solve_vertices(points, has_own: bool, frame: SolveFrame, warm: bool, out_vertex: VertexView) -> None:
        own = forward.own_vertices(part) if has_own else [0, 0]
        if prepared.grid is None or not has_own:
            search(points, own, frame, warm, out_vertex)
            return
        statistics.update(
            grid.fill(
                scene,
                prepared.grid,
                lambda asked, out: search(asked, [0, 0], frame, True, out),
                frame,
                prepared.map,
                gbuffer.view,
                camera,
                pixels.box,
                settings,
                out_vertex,
            )
        )
        if len(points) > scene.vertex_count:
            # Vertices of triangles that the previous frame cut.
            added = vertices_from(out_vertex, scene.vertex_count)
            search(points[scene.vertex_count :], [0, 0], frame, warm, added)

    def solve_boundary(points, frame: SolveFrame, edges: wp.array, out_point: wp.array) -> None:
        launch(
            boundary_kernel,
            len(edges),
            [points, prepared.map.view, frame, edges, forward.BOUNDARY_STEPS[settings.refine], out_point],
            scene.device,
            settings.threads,
        )

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
    )
    layer.statistics.update(statistics)
    return layer
