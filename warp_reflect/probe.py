"""What a camera sees, for plans: pixels of every mirror, and a few points that are looked at closer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, raster, surface
from warp_reflect.direct import Points, points_of
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.scene import Scene
from warp_reflect.settings import Technique
from warp_reflect.timing import StageTimer

TRIED_SIDE = 64  # points along the longer side of a picture: 2,300 tell a share of 1 % within 0.2 %
LEAST_TRIED = 64  # points of a mirror, however small: whether it shows another is decided by them alone


@dataclass(frozen=True)
class EyeView:
    """What a camera sees, drawn to decide: the first frame's own view, which is so spared it.

    Attributes:
        gbuffer: With the mirrors' ids.
        pixels: By reflector id, as `surface.mirror_pixels` has them.
        parts: Reflector id to part of the scene.
        ms: What that took, by the names of a frame's steps.
    """

    gbuffer: GBuffer
    pixels: dict[int, MirrorPixels]
    parts: dict[int, int]
    ms: dict[str, float]

    def pixels_of(self, scene: Scene, parts: list[int]) -> dict[int, int]:
        """Pixels of the picture that show each part."""
        found = {part: self.pixels[number].count for number, part in self.parts.items()}
        others = [part for part in parts if part not in found]
        if others:
            seen = surface.seen_parts(scene, self.gbuffer, others)
            found |= {part: len(seen.get(part, ())) for part in others}
        return found


@dataclass(frozen=True)
class Probe:
    """Points that the eye sees, directly and in mirrors.

    Attributes:
        points: Those tried.
        count: Pixels, and pixels of mirrors, that they stand for.
        mirrored: By part: the share of its points that shows each reflector's part, where any is shown.
    """

    points: Points
    count: int
    mirrored: dict[int, dict[int, float]]


def look(
    scene: Scene,
    camera: Camera,
    parts: Mapping[int, int],
    threads: int = 0,
    kernels: str = "auto",
    drawn: Callable[[GBuffer], None] | None = None,
) -> EyeView:
    """Draw what a camera sees.

    Args:
        scene, camera: What, from where.
        parts: Reflector id (1-based) to part of the scene.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
        drawn: Told what is seen before the mirrors' pixels are taken from it.
    """
    timer = StageTimer(scene.device)
    with timer("raster"):
        gbuffer = raster.draw_scene(scene, camera, threads, kernels=kernels)
    if drawn is not None:
        drawn(gbuffer)
    with timer("mirror_pixels"):
        pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, parts, threads, kernels)
    return EyeView(gbuffer, pixels, dict(parts), timer.ms)


def probe(scene: Scene, seen: EyeView, threads: int = 0, kernels: str = "auto") -> Probe:
    """Try points on a coarse grid of what is seen, and what mirrors show there.

    Args:
        scene: Its BVH is built if there are mirrors and this is the first use.
        seen: Of the scene.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
    """
    gbuffer = seen.gbuffer
    width, height = gbuffer.camera.size
    stride = max(width, height) // TRIED_SIDE | 1  # odd, so that it falls in step with few patterns
    rows, columns = (np.arange(stride // 2, side, stride) for side in (height, width))
    chosen = (rows[:, None] * width + columns).ravel().astype(np.int32)
    triangle = gbuffer.triangle.numpy()
    there = triangle[chosen] >= 0
    points = points_of(scene, gbuffer, None, threads, chosen[there])
    found = [_taken(points, slice(None))]
    count = width * height * float(there.mean())
    mirrored: dict[int, dict[int, float]] = {}
    mirror_of_patch = np.full(max(len(scene.patch_shapes), 1), -1)
    for part in seen.parts.values():
        mirror_of_patch[list(scene.parts[part].patches)] = part
    for number, part in seen.parts.items():
        own = seen.pixels[number]
        some, on_grid = _some(own.pixel.numpy(), chosen)
        if not len(some):
            continue
        layer = ReflectionLayer.empty(own.select(some, number, width), Technique.RAYTRACED, scene.device)
        bvh.trace_pixels(scene, gbuffer, layer.pixels, layer, part, False, threads=threads, kernels=kernels)
        shown = layer.triangle.numpy()
        met, times = np.unique(mirror_of_patch[scene.host_triangle_patch[shown[shown >= 0]]], return_counts=True)
        mirrored[part] = {int(k): float(n) / len(shown) for k, n in zip(met, times, strict=True) if k >= 0}
        found.append(_taken(points_of(scene, gbuffer, layer, threads), np.flatnonzero((shown >= 0) & on_grid)))
        count += own.count * float((shown >= 0).mean())
    return Probe(_joined(found, (width, height), scene.device), round(count), mirrored)


def _some(pixel: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(places of those of a mirror's pixels that are tried, which of them are pixels of the grid), both ascending."""
    place = np.searchsorted(pixel, grid)
    inside = place < len(pixel)
    place = place[inside]
    place = place[pixel[place] == grid[inside]]
    if len(place) >= min(LEAST_TRIED, len(pixel)):
        return place, np.ones(len(place), bool)
    more = np.union1d(place, np.arange(0, len(pixel), max(len(pixel) // LEAST_TRIED, 1)))
    return more, np.isin(more, place)


def _taken(points: Points, rows: np.ndarray | slice) -> tuple[np.ndarray, ...]:
    return tuple(array.numpy()[rows] for array in (points.triangle, points.u, points.v, points.direction))


def _joined(found: list[tuple[np.ndarray, ...]], size: tuple[int, int], device) -> Points:
    triangle, u, v, direction = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    return Points(
        wp.array(triangle, dtype=int, device=device),
        wp.array(u, dtype=float, device=device),
        wp.array(v, dtype=float, device=device),
        wp.array(direction, dtype=wp.vec3, device=device),
        wp.zeros(0, dtype=int, device=device),
        *size,
    )
