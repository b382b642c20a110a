"""A reflector made of pieces, each with its own solver: reflect piece by piece, put the answers together.

Estalella et al. 2005, section 4, split a general reflector by hand into pieces that one map each can hold; a gprim with a
rim (a capped cylinder) falls into its analytic patches. Every technique that holds a mirror in more than one piece goes
through here; what no piece holds is traced.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import warp as wp

from warp_reflect import bvh, compact
from warp_reflect.counts import add_statistics
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings

LAYER_ARRAYS = ("triangle", "u", "v", "distance", "status")


@dataclass(frozen=True)
class Piece:
    """A piece of a reflector and the technique that holds it.

    Attributes:
        triangles: int [n], ids of its triangles in the scene.
        technique: A module with `reflect`.
        prepared: What that module's `prepare` would give; its reflector's id is the piece's number, 1-based.
        holds: (points [n, 3], normals [n, 3] on the eye's side, scene frame) -> bool [n]: which of its pixels it holds
            (one side of an open surface); None: all.
    """

    triangles: np.ndarray
    technique: ModuleType
    prepared: object
    holds: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None


def reflect(
    scene: Scene,
    reflector: Reflector,
    method: int,
    pieces: list[Piece],
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history: dict | None,
) -> ReflectionLayer:
    """Reflect a scene in every piece of a mirror that is seen.

    Args:
        method: `Technique` of the whole.
        history: The history of the same reflector's last layer: one entry per piece number.

    Returns:
        One layer; statistics and timings are sums, `pieces` counts those seen, `bvh` includes what no piece holds.
    """
    part = scene.parts[reflector.part]
    width, height = gbuffer.camera.size
    facets = compact.taken(gbuffer.triangle, pixels.pixel).numpy()
    numbers = _numbers(pieces, pixels, facets, part.first_triangle, part.triangle_count)
    mask = wp.zeros(width * height, dtype=int, device=scene.device)
    compact.put(mask, pixels.pixel, wp.array(numbers, dtype=int, device=scene.device))
    masked = dataclasses.replace(gbuffer, reflector_id=mask)
    layer = ReflectionLayer.empty(pixels, method, scene.device)
    layer.history = {}
    layer.statistics["pieces"] = 0
    for number, piece in enumerate(pieces, 1):
        places = np.flatnonzero(numbers == number).astype(np.int32)
        if not len(places):
            continue
        chosen = wp.array(places, dtype=int, device=scene.device)
        own = pixels.select(chosen, number, width)
        before = (history or {}).get(number)
        answer = piece.technique.reflect(scene, piece.prepared, masked, own, camera, settings, before)
        for name in LAYER_ARRAYS:
            compact.put(getattr(layer, name), chosen, getattr(answer, name))
        layer.history[number] = answer.history
        layer.virtual += answer.virtual
        layer.cells += answer.cells
        layer.statistics["pieces"] += 1
        add_statistics(layer.statistics, answer.statistics)
        add_statistics(layer.timings, answer.timings)
    left = wp.array(np.flatnonzero(numbers == 0).astype(np.int32), dtype=int, device=scene.device)
    traced = bvh.trace_pixels(
        scene,
        gbuffer,
        pixels,
        layer,
        reflector.part,
        reflector.convex,
        left,
        threads=settings.threads,
        kernels=settings.kernels,
    )
    layer.statistics["bvh"] = layer.statistics.get("bvh", 0) + traced
    return layer


def _numbers(
    pieces: list[Piece], pixels: MirrorPixels, triangle: np.ndarray, first_triangle: int, triangle_count: int
) -> np.ndarray:
    """The number of the first piece that holds each pixel, int32; 0 none."""
    numbers = np.zeros(len(triangle), np.int32)
    point, normal = None, None
    for number, piece in enumerate(pieces, 1):
        member = np.zeros(triangle_count, bool)
        member[piece.triangles - first_triangle] = True
        chosen = np.flatnonzero(member[triangle - first_triangle] & (numbers == 0))
        if piece.holds is not None and len(chosen):
            if point is None:
                point, normal = pixels.point.numpy(), pixels.normal.numpy()
            chosen = chosen[piece.holds(point[chosen], normal[chosen])]
        numbers[chosen] = number
    return numbers
