"""Level of detail of local maps: as many texels as a mirror's size on screen asks for, within what a frame's maps may share.

Source: Meyer and Loscos 2003, section 5, who take the smallest quad of a local map's mesh from the mirror's box on screen.
Differs from it by: the map's resolution follows as well; levels change only well beyond the size at which they would
(hysteresis); and what all maps of a frame may have together is shared, the finest for their size giving first.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from warp_reflect.cubemap import FACE_COUNT
from warp_reflect.layers import Camera
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings

LEAST = 8  # texels along an edge: fewer show no more than a colour for each side
# Texels for each pixel that a mirror is seen at, at most: a ball in full view gets 8 by its size, one that hides behind others
# shows little of its map.
SEEN_TEXELS = 16.0
HYSTERESIS = 0.2  # of a level's texels: a size has to be so far beyond before another level is taken


@dataclass(frozen=True)
class Detail:
    """Texels along an edge of a mirror's local map, why, and the numbers it was decided by."""

    resolution: int
    reason: str
    numbers: dict = field(default_factory=dict)


def size_px(scene: Scene, camera: Camera, part: int) -> float:
    """Diameter in pixels, on screen, of the sphere around a part's box; at most twice the picture's longer side."""
    own = scene.parts[part]
    first, _, corners = scene.boxes
    box = corners[np.searchsorted(first, own.first_vertex)]
    low, high = box.min(axis=0), box.max(axis=0)
    diameter = float(np.linalg.norm(high - low))
    most = 2.0 * max(camera.size)
    if camera.orthographic:
        return min(diameter * camera.fx, most)
    depth = float((0.5 * (low + high) + scene.origin - camera.eye) @ camera.forward)
    return most if depth * most <= diameter * camera.fx else diameter * camera.fx / depth


def details(
    sizes: Mapping[int, float], settings: Settings, before: Mapping[int, int], pixels: Mapping[int, int] | None = None
) -> dict[int, Detail]:
    """The resolution of every mirror's local map.

    Args:
        sizes: Reflector id to `size_px`.
        settings: `local_detail`, `local_texels`; full detail is `local_edge`.
        before: Reflector id to the resolution of the frame before, where there was one.
        pixels: Reflector id to the pixels at which it is seen; None: nothing hides it.
    """
    full, seen = settings.local_edge, {} if pixels is None else pixels
    most = {id: math.sqrt(SEEN_TEXELS * seen[id] / FACE_COUNT) if id in seen else math.inf for id in sizes}
    wanted = {id: min(settings.local_detail * size, most[id]) for id, size in sizes.items()}
    chosen = {id: _level(wanted[id], full, before.get(id)) for id in sizes}
    asked = dict(chosen)
    while 0 < settings.local_texels < _texels(chosen):
        finest = max(chosen, key=lambda id: (chosen[id] > LEAST, chosen[id] / max(sizes[id], 1.0e-30), id))
        if chosen[finest] <= LEAST:
            break
        chosen[finest] = max(chosen[finest] // 2, LEAST)
    return {id: _told(chosen[id], asked[id], sizes[id], before.get(id), settings, most[id]) for id in sizes}


def _level(wanted: float, full: int, before: int | None) -> int:
    """The coarsest of full, full / 2, full / 4 ... that has the texels wanted; that of before where it nearly has."""
    if wanted == 0.0:
        return full
    level = full
    while level // 2 >= max(wanted, LEAST):
        level //= 2
    if before is not None and level != before:
        enough, spare = wanted <= (1.0 + HYSTERESIS) * before, 0.5 * before >= (1.0 + HYSTERESIS) * wanted
        if before <= full and enough and (not spare or before // 2 < LEAST):
            return before
    return level


def _texels(chosen: Mapping[int, int]) -> int:
    return sum(FACE_COUNT * resolution * resolution for resolution in chosen.values())


def _told(resolution: int, asked: int, size: float, before: int | None, settings: Settings, most: float) -> Detail:
    reason = f"{size:.0f} px on screen at local_detail={settings.local_detail:g} ask for {asked} texels an edge"
    if settings.local_detail == 0.0:
        reason = f"{asked} texels an edge, local_detail=0"
    elif most < settings.local_detail * size:
        reason = f"{size:.0f} px on screen, hidden but for pixels that ask for {asked} texels an edge"
    elif before == asked:
        reason += ", as before"
    if resolution < asked:
        reason += f"; {resolution}, to share {settings.local_texels:,d} texels (local_texels)"
    numbers = {"size_px": size, "asked": asked, "resolution": resolution}
    return Detail(resolution, reason, numbers)
