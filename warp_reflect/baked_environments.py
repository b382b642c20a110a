"""Reference environment maps as files: one compressed EXR each.

Layout `LAYOUT`: the six faces (+X -X +Y -Y +Z -Z, orientation of OpenEXR's cubes, texel-centred) lie one below the other.
Channels `R G B` are radiance, linear Rec.709, half; `A` is 0 where there is only sky; `Z` is the distance from the eye along
the texel's own ray, float32, 0 for sky. The header says where the eye was (`warp_reflect:place`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from warp_reflect import images
from warp_reflect.scene import EnvironmentMapData

LAYOUT = "radiance_cube_1"  # ends in the version of how maps are drawn and stored; others are not read
LAYOUT_HEADER = "warp_reflect:layout"
PLACE_HEADER = "warp_reflect:place"
WORLD_HEADER = "warp_reflect:world"  # digest of what it was drawn from
FACES = 6
EDGE_MIN, EDGE_MAX = 4, 4096  # texels, as `Settings.environment_resolution`
PLACE_ROUNDING = 1.0e-6  # of a coordinate: a place that is off by more has been moved since


def write_map(
    path: str | os.PathLike,
    radiance: np.ndarray,
    distance: np.ndarray,
    world_from_map: np.ndarray,
    attributes: Mapping[str, object] | None = None,
) -> None:
    """Write a map; under a passing name first, so that nobody meets half a file.

    Args:
        path: An .exr.
        radiance: RGB times coverage, coverage; float32 [6, n, n, 4].
        distance: 0 sky, float32 [6, n, n].
        world_from_map: The eye and the axes, float64 [4, 4].
        attributes: More header entries.

    Raises:
        OSError: the file could not be written.
    """
    n = radiance.shape[1]
    header = {LAYOUT_HEADER: LAYOUT, PLACE_HEADER: np.asarray(world_from_map, np.float64).tolist()}
    channels = {"RGBA": radiance.reshape(FACES * n, n, 4), "Z": distance.reshape(FACES * n, n)}
    images.write_exr(path, channels, attributes=header | dict(attributes or {}))


def read_map(asked: EnvironmentMapData, world: str) -> tuple[np.ndarray, np.ndarray]:
    """(radiance float32 [6, n, n, 4], distance float32 [6, n, n]) of the file of a place.

    Args:
        asked: The place.
        world: Digest of what it would be drawn from now.

    Raises:
        OSError: no such file, or not whole.
        ValueError: it holds something else, or was drawn at another place or of another world; one line.
    """
    channels, header = images.read_exr(asked.map_file)
    layout = header.get(LAYOUT_HEADER)
    if layout != LAYOUT:
        raise ValueError(f"{asked.map_file}: got the layout {layout!r}, expected {LAYOUT!r}; bake it again")
    try:
        place = np.array(header[PLACE_HEADER], np.float64).reshape(4, 4)
        radiance = np.stack([channels[letter] for letter in "RGBA"], axis=-1).astype(np.float32)
        distance = np.ascontiguousarray(channels["Z"], np.float32)
        height, n = distance.shape
        if height != FACES * n or not EDGE_MIN <= n <= EDGE_MAX:
            raise ValueError(f"{n} x {height} pixels do not hold six faces of 4 to 4096 texels")
        if not (np.isfinite(radiance).all() and np.isfinite(distance).all() and (radiance >= 0.0).all()):
            raise ValueError("values that are no light")
        if not np.array_equal(radiance[..., 3] > 0.0, distance > 0.0):
            raise ValueError("coverage and distances that do not fit")
    except (KeyError, TypeError, ValueError) as fault:
        raise ValueError(f"{asked.map_file}: not a baked environment map ({fault}); bake it again") from None
    size = np.abs(asked.world_from_map).max()
    if np.abs(place - asked.world_from_map).max() > PLACE_ROUNDING * size:
        raise ValueError(f"{asked.map_file}: was drawn at another place; bake it again")
    if header.get(WORLD_HEADER) != world:
        raise ValueError(f"{asked.map_file}: was drawn of another world; bake it again")
    return radiance.reshape(FACES, n, n, 4), distance.reshape(FACES, n, n)
