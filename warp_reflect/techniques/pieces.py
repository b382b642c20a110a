"""A reflector made of pieces, each with its own solver: reflect piece by piece, put the answers together.

Estalella et al. 2005, section 4, split a general reflector by hand into pieces that one map each can hold; a gprim with a
rim (a capped cylinder) falls into its analytic patches. Every technique that holds a mirror in more than one piece goes
through here; what no piece holds is traced.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import warp as wp

from warp_reflect import bvh
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer, Reflector, add_statistics
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
    """

    triangles: np.ndarray
    technique: ModuleType
    prepared: object


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
    pixel = pixels.pixel.numpy()
    table = np.zeros(part.triangle_count, np.int32)
    for number, piece in enumerate(pieces, 1):
        table[piece.triangles - part.first_triangle] = number
    numbers = table[gbuffer.triangle.numpy()[pixel] - part.first_triangle]
    mask = np.zeros(width * height, np.int32)
    mask[pixel] = numbers
    masked = dataclasses.replace(gbuffer, reflector_id=wp.array(mask, dtype=int, device=scene.device))
    layer = ReflectionLayer.empty(pixels, method, scene.device)
    whole = {name: getattr(layer, name).numpy().copy() for name in LAYER_ARRAYS}
    layer.history = {}
    layer.statistics["pieces"] = 0
    for number, piece in enumerate(pieces, 1):
        chosen = np.flatnonzero(numbers == number)
        if not len(chosen):
            continue
        own = pixels.select(chosen, number, width)
        before = (history or {}).get(number)
        answer = piece.technique.reflect(scene, piece.prepared, masked, own, camera, settings, before)
        for name in LAYER_ARRAYS:
            whole[name][chosen] = getattr(answer, name).numpy()
        layer.history[number] = answer.history
        layer.statistics["pieces"] += 1
        add_statistics(layer.statistics, answer.statistics)
        add_statistics(layer.timings, answer.timings)
    for name in LAYER_ARRAYS:
        wp.copy(getattr(layer, name), wp.array(whole[name], dtype=getattr(layer, name).dtype, device=scene.device))
    left = wp.array(np.flatnonzero(numbers == 0).astype(np.int32), dtype=int, device=scene.device)
    traced = bvh.trace_pixels(
        scene, gbuffer, pixels, layer, reflector.part, reflector.convex, left, threads=settings.threads
    )
    layer.statistics["bvh"] = layer.statistics.get("bvh", 0) + traced
    return layer
