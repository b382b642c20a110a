"""A small picture of what a camera sees, for plans: pixels of every mirror, and a few points that are looked at closer."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, raster, surface
from warp_reflect.direct import Points, points_of
from warp_reflect.layers import Camera, GBuffer, ReflectionLayer
from warp_reflect.scene import Scene
from warp_reflect.settings import Technique

PREVIEW_SIDE = 320  # pixels; enough to count a mirror's pixels within a few per cent for the choice of technique
# Pixels of the picture for each triangle of the scene, up to which drawing it whole costs little more than drawing it small,
# and the frame is spared it.
WHOLE_PIXELS = 4
STRIDE = 3  # pixels of the preview from one point to the next; odd, so that it falls in step with few patterns


@dataclass(frozen=True)
class Preview:
    """The eye's view in few pixels.

    Attributes:
        gbuffer: What is seen.
        scale: Pixels of the picture for each of the preview's.
        stride: Pixels from one point that is tried to the next.
    """

    gbuffer: GBuffer
    scale: float
    stride: int = STRIDE

    def pixels_of(self, scene: Scene, parts: list[int]) -> dict[int, int]:
        """Pixels of the picture that show each part."""
        triangle = self.gbuffer.triangle.numpy()
        patches = np.bincount(scene.host_triangle_patch[triangle[triangle >= 0]], minlength=len(scene.patch_shapes))
        return {k: round(float(patches[list(scene.parts[k].patches)].sum()) * self.scale) for k in parts}


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


def preview(scene: Scene, camera: Camera, threads: int = 0, kernels: str = "auto") -> Preview:
    """Draw a scene small, or whole where that is as cheap; `kernels` as in `Settings`."""
    width, height = camera.size
    shrink = smaller = max(1.0, max(width, height) / PREVIEW_SIDE)
    if width * height <= WHOLE_PIXELS * scene.triangle_count:
        shrink = 1.0
    small = dataclasses.replace(
        camera,
        size=(max(1, round(width / shrink)), max(1, round(height / shrink))),
        fx=camera.fx / shrink,
        fy=camera.fy / shrink,
        cx=camera.cx / shrink,
        cy=camera.cy / shrink,
    )
    gbuffer = raster.draw_scene(scene, small, threads, kernels=kernels)
    stride = int(STRIDE * smaller / shrink) | 1
    return Preview(gbuffer, width * height / (small.size[0] * small.size[1]), stride)


def probe(scene: Scene, small: Preview, parts: list[int], threads: int = 0, kernels: str = "auto") -> Probe:
    """Try every `stride`-th point of a preview in both directions, and what mirrors show there.

    Args:
        scene: Its BVH is built if there are mirrors and this is the first use.
        small: Of the scene.
        parts: The reflectors, indices into `scene.parts`.
        threads: CPU threads.
        kernels: `Settings.kernels`.
    """
    gbuffer = small.gbuffer
    width, height = gbuffer.camera.size
    row, column = np.divmod(np.arange(width * height), width)
    chosen = (row % small.stride == small.stride // 2) & (column % small.stride == small.stride // 2)
    triangle = gbuffer.triangle.numpy()
    found = [_taken(points_of(scene, gbuffer, None, threads), np.flatnonzero(chosen & (triangle >= 0)))]
    count = float(np.count_nonzero(triangle >= 0))
    ids = dict(enumerate(parts, 1))
    mirrored: dict[int, dict[int, float]] = {}
    pixels, _ = surface.mirror_pixels(scene, gbuffer, ids, threads, kernels)
    mirror_of_patch = np.full(max(len(scene.patch_shapes), 1), -1)
    for part in parts:
        mirror_of_patch[list(scene.parts[part].patches)] = part
    for number, part in ids.items():
        own = pixels[number]
        some = np.flatnonzero(chosen[own.pixel.numpy()])
        if not len(some):
            continue
        layer = ReflectionLayer.empty(own.select(some, number, width), Technique.RAYTRACED, scene.device)
        bvh.trace_pixels(scene, gbuffer, layer.pixels, layer, part, False, threads=threads, kernels=kernels)
        shown = layer.triangle.numpy()
        seen, times = np.unique(mirror_of_patch[scene.host_triangle_patch[shown[shown >= 0]]], return_counts=True)
        mirrored[part] = {int(k): float(n) / len(shown) for k, n in zip(seen, times, strict=True) if k >= 0}
        found.append(_taken(points_of(scene, gbuffer, layer, threads), np.flatnonzero(shown >= 0)))
        count += own.count * float((shown >= 0).mean())
    return Probe(_joined(found, (width, height), scene.device), round(count * small.scale), mirrored)


def _taken(points: Points, rows: np.ndarray) -> tuple[np.ndarray, ...]:
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
