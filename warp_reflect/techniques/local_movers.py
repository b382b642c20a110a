"""What moves, drawn into a mirror's local map in a second pass: reference maps hold nothing of it.

Source: Meyer and Loscos 2003, section 6, where people walk through the reconstructed maps. Differs from it by: other moving
mirrors are drawn as well, and show their own maps: those of what stands still, or those of the frame before
(`environment_update` "previous").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import raster
from warp_reflect.cubemap import FACE_COUNT
from warp_reflect.environment_maps import CubeMaps, Onward, copied_maps, face_camera, texel_hits
from warp_reflect.layers import Camera
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import local_map

KEY = "moving parts"


@dataclass(frozen=True)
class Movers:
    """The moving parts of a scene by themselves: drawing them costs nothing of the others.

    Attributes:
        points: vec3, scene frame, float32.
        triangles: vec3i [n], indices into `points`.
        ids: Their numbers in the scene, int [n].
        ranges: [first, end) of each moving part in `triangles`, by part.
        low, high: Boxes of the parts, scene frame, float64 [3], by part.
    """

    points: wp.array
    triangles: wp.array
    ids: wp.array
    ranges: dict[int, tuple[int, int]]
    low: dict[int, np.ndarray]
    high: dict[int, np.ndarray]


def moving_in(scene: Scene, part: int) -> tuple[int, ...]:
    """The parts that move and that a mirror may show: not itself, nor what its collection does not name."""
    seen = scene.seen_in(scene.parts[part])
    return tuple(
        k
        for k in scene.moving_parts
        if k != part and scene.parts[k].triangle_count and (seen is None or seen[scene.parts[k].first_triangle])
    )


def draw_moving(
    scene: Scene,
    local: CubeMaps,
    state: wp.array,
    parts: tuple[int, ...],
    onward: Callable[[set[int]], Onward | None],
    settings: Settings,
) -> tuple[CubeMaps, wp.array, dict[str, int]]:
    """A local map with parts that move in front of what it holds.

    Args:
        scene: Of the map.
        local: A map of all else; it is not changed.
        state: Of its texels, see `local_map.blend_local_map`.
        parts: What is drawn, see `moving_in`.
        onward: For the parts that are seen, what mirrors among them show; None: the domes.
        settings: `threads`, shadows.

    Returns:
        (The map; the state of its texels; statistics `local_moving`: texels that show what moves).
    """
    movers = _movers(scene)
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    low, high = (np.array([box[part] for part in parts])[:, None] for box in (movers.low, movers.high))
    corners = np.where(bits[None] == 1, high, low) - (local.centres[0] - scene.origin)
    n, device = local.resolution, scene.device
    made = copied_maps(local)
    distance, triangle = local.view.distance.numpy().copy(), local.view.triangle.numpy().copy()
    of_state = state.numpy().copy()
    texels = []
    for face in range(FACE_COUNT):
        camera = face_camera(scene, local.centres[0], local.axes[0], face, n)
        inside = np.array(parts)[_may_be_seen(corners, camera)]
        if not len(inside):
            continue
        found, met = _draw(scene, movers, camera, inside, settings)
        own = slice(face * n * n, (face + 1) * n * n)
        nearer = (found >= 0) & ((distance[own] == 0.0) | (met < distance[own]))
        distance[own], triangle[own] = np.where(nearer, met, distance[own]), np.where(nearer, found, triangle[own])
        texels.append(face * n * n + np.flatnonzero(nearer))
    shown = np.concatenate(texels) if texels else np.zeros(0, np.int64)
    if len(shown):
        made.view.distance = wp.array(distance, dtype=float, device=device)
        made.view.triangle = wp.array(triangle, dtype=int, device=device)
        patches = np.unique(scene.host_triangle_patch[triangle[shown]])
        seen = {part for part in parts if np.isin(patches, list(scene.parts[part].patches)).any()}
        local_map.shade_texels(scene, made, shown, settings, onward(seen))
        of_state[shown] = local_map.TEXEL_SHADED
    return made, wp.array(of_state, dtype=wp.uint8, device=device), {"local_moving": len(shown)}


def _movers(scene: Scene) -> Movers:
    if (KEY,) not in scene.environments:
        ranges, ids = {}, []
        first = 0
        for k in scene.moving_parts:
            part = scene.parts[k]
            ranges[k] = (first, first + part.triangle_count)
            first += part.triangle_count
            ids.append(np.arange(part.first_triangle, part.first_triangle + part.triangle_count))
        number = np.concatenate(ids)
        used, local = np.unique(scene.host_triangles[number], return_inverse=True)
        triangles, points = local.reshape(-1, 3), scene.host_points[used]
        corners = {k: points[triangles[a:b]].astype(np.float64).reshape(-1, 3) for k, (a, b) in ranges.items() if b > a}
        scene.environments[(KEY,)] = Movers(
            wp.array(points, dtype=wp.vec3, device=scene.device),
            wp.array(triangles.astype(np.int32), dtype=wp.vec3i, device=scene.device),
            wp.array(number.astype(np.int32), dtype=int, device=scene.device),
            ranges,
            {k: corner.min(axis=0) for k, corner in corners.items()},
            {k: corner.max(axis=0) for k, corner in corners.items()},
        )
    return scene.environments[(KEY,)]


def _may_be_seen(corners: np.ndarray, camera: Camera) -> np.ndarray:
    """Which boxes are not wholly beyond one of the planes of a face's camera; corners from its eye, float64 [n, 8, 3]."""
    x, y, depth = (corners @ axis for axis in (camera.right, camera.up, camera.forward))
    beyond = (-depth, x - depth, -x - depth, y - depth, -y - depth)
    return ~np.any([(plane > 0.0).all(axis=1) for plane in beyond], axis=0)


def _draw(scene: Scene, movers: Movers, camera: Camera, parts, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """(triangle of the scene int [n n], -1 none; distance float32 likewise) of a face."""
    drawn = [(movers.triangles[first:end], movers.ids[first:end]) for first, end in _joined(movers, parts)]
    view = camera.view(scene)
    gbuffer = raster.draw_triangles(camera, view, movers.points, drawn, settings.threads, settings.kernels)
    _, distance = texel_hits(scene, gbuffer, settings.threads)
    return gbuffer.triangle.numpy(), distance.numpy()


def _joined(movers: Movers, parts) -> list[tuple[int, int]]:
    """Ranges of triangles of some parts, ascending; those that follow each other are one."""
    joined: list[tuple[int, int]] = []
    for first, end in sorted(movers.ranges[part] for part in parts):
        if joined and joined[-1][1] == first:
            first = joined.pop()[0]
        joined.append((first, end))
    return joined
