"""What a camera sees, for plans: pixels of every mirror, and a few points that are looked at closer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, raster, surface
from warp_reflect.direct import Points, points_of
from warp_reflect.layers import NO_REFLECTOR, Camera, GBuffer, MirrorPixels, ReflectionLayer
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

    def pixels_of(self, scene: Scene, parts: list[int], threads: int, kernels: str) -> dict[int, int]:
        """Pixels of the picture that show each part."""
        found = {part: self.pixels[number].count for number, part in self.parts.items()}
        others = [part for part in parts if part not in found]
        if others:
            found |= surface.seen_parts(scene, self.gbuffer, others, threads, kernels)
        return found


@dataclass(frozen=True)
class Probe:
    """Points that the eye sees, directly and in mirrors.

    Attributes:
        points: Those tried; None where light is not tried there.
        count: Pixels, and pixels of mirrors, that they stand for.
        mirrored: By part: the share of its points that shows each reflector's part, where any is shown.
    """

    points: Points | None
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


def probe(scene: Scene, seen: EyeView, threads: int = 0, spacing: int = 1, lit: bool = True) -> Probe:
    """Try points on a coarse grid of what is seen, and what mirrors show there.

    Args:
        scene: Its BVH is built if there are mirrors and this is the first use.
        seen: Of the scene.
        threads: CPU threads; 0: one per core.
        spacing: Of the grid; 2: a quarter of the points.
        lit: Whether light is tried at the points.
    """
    gbuffer = seen.gbuffer
    width, height = gbuffer.camera.size
    stride = spacing * (max(width, height) // TRIED_SIDE) | 1  # odd, so that it falls in step with few patterns
    # In the middle where a side has room for one point alone.
    rows, columns = (np.arange(min(stride, side) // 2, side, stride) for side in (height, width))
    chosen = (rows[:, None] * width + columns).ravel().astype(np.int32)
    there = gbuffer.triangle.numpy()[chosen] >= 0
    count = width * height * float(there.mean())
    found = [_taken(points_of(scene, gbuffer, None, threads, chosen[there]), slice(None))] if lit else []
    mirrored: dict[int, dict[int, float]] = {}
    mirrors = {part: seen.pixels[id] for id, part in seen.parts.items() if seen.pixels[id].count}
    ids = gbuffer.reflector_id.numpy()[chosen]
    id_of = {part: id for id, part in seen.parts.items()}
    tried = {part: _some(own.pixel.numpy(), chosen[ids == id_of[part]]) for part, own in mirrors.items()}
    if tried:
        shown = _shown(scene, gbuffer, mirrors, {part: place for part, (place, _) in tried.items()}, threads)
        triangle = shown.triangle.numpy()
        mirror_of_patch = np.full(len(scene.patch_shapes), -1)
        for part in seen.parts.values():
            mirror_of_patch[list(scene.parts[part].patches)] = part
        met = np.where(triangle >= 0, mirror_of_patch[scene.host_triangle_patch.take(triangle, mode="clip")], -1)
        end = 0
        for part, (place, _) in tried.items():
            begin, end = end, end + len(place)
            times = np.bincount(met[begin:end] + 1)[1:]
            mirrored[part] = {int(k): float(times[k]) / len(place) for k in np.flatnonzero(times)}
            count += mirrors[part].count * float((triangle[begin:end] >= 0).mean())
        if lit:
            on_grid = np.concatenate([on_grid for _, on_grid in tried.values()])
            kept = np.flatnonzero((triangle >= 0) & on_grid)
            found.append(_taken(points_of(scene, gbuffer, shown, threads), kept))
    return Probe(_joined(found, (width, height), scene.device) if lit else None, round(count), mirrored)


def _shown(
    scene: Scene,
    gbuffer: GBuffer,
    mirrors: Mapping[int, MirrorPixels],
    places: Mapping[int, np.ndarray],
    threads: int,
) -> ReflectionLayer:
    """What mirrors show at some of their pixels, mirror after mirror, all traced together.

    Neighbours that are far apart share nothing: plain kernels trace them as fast as vectors do.

    Args:
        scene, gbuffer: What is seen.
        mirrors: Their pixels, by part.
        places: Which of those, by part.
        threads: CPU threads; 0: one per core.
    """
    device = scene.device

    def taken(name: str, kind) -> wp.array:
        rows = [getattr(own, name).numpy()[places[part]] for part, own in mirrors.items()]
        return _array(np.concatenate(rows), kind, device)

    vectors = [taken(name, wp.vec3) for name in ("point", "normal", "direction")]
    pixel = taken("pixel", int)
    pixels = MirrorPixels(NO_REFLECTOR, pixel, *vectors, (0, 0, *gbuffer.camera.size))
    layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, device)
    part_of = np.repeat(list(mirrors), [len(places[part]) for part in mirrors])
    tracers: dict[int, list[int]] = {}
    for part in mirrors:
        tracers.setdefault(id(scene.mirror_tracer(part)), []).append(part)
    how = {"threads": threads, "kernels": "plain"}
    for parts in tracers.values():
        index = None
        if len(tracers) > 1:
            index = _array(np.flatnonzero(np.isin(part_of, parts)).astype(np.int32), int, device)
        bvh.trace_pixels(scene, gbuffer, pixels, layer, parts[0], False, index, meets_own=True, **how)
    own = [scene.parts[part] for part in mirrors]
    first, count = (
        np.repeat(numbers, [len(places[part]) for part in mirrors])
        for numbers in ([each.first_triangle for each in own], [each.triangle_count for each in own])
    )
    triangle = layer.triangle.numpy()
    meets_own = (triangle >= first) & (triangle < first + count)
    for part in np.unique(part_of[meets_own]):
        # Of its own body, what a ray leaves from behind is stepped over.
        again = np.flatnonzero(meets_own & (part_of == part)).astype(np.int32)
        bvh.trace_pixels(scene, gbuffer, pixels, layer, int(part), False, _array(again, int, device), **how)
    return layer


def _some(pixel: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(places of those of a mirror's pixels that are tried, which of them are pixels of the grid), both ascending.

    Args:
        pixel: The mirror's, ascending.
        grid: Those of them that are pixels of the grid, ascending.
    """
    place = np.searchsorted(pixel, grid)
    if len(place) >= min(LEAST_TRIED, len(pixel)):
        return place, np.ones(len(place), bool)
    more = np.arange(0, len(pixel), max(len(pixel) // LEAST_TRIED, 1))
    tried, first = np.unique(np.concatenate([place, more]), return_index=True)
    return tried, first < len(place)


def _taken(points: Points, rows: np.ndarray | slice) -> tuple[np.ndarray, ...]:
    return tuple(array.numpy()[rows] for array in (points.triangle, points.u, points.v, points.direction))


def _joined(found: list[tuple[np.ndarray, ...]], size: tuple[int, int], device) -> Points:
    arrays = (np.concatenate(each) for each in zip(*found, strict=True))
    kinds = int, float, float, wp.vec3
    made = [_array(array, kind, device) for array, kind in zip(arrays, kinds, strict=True)]
    return Points(*made, wp.zeros(0, dtype=int, device=device), *size)


def _array(values: np.ndarray, kind, device) -> wp.array:
    """Of values that nobody writes to."""
    return wp.array(values, dtype=kind, device=device, copy=False)
