"""Baked reflector maps as files: one EXR per mirror.

Layout `LAYOUT`: algorithm and texel of `reflector_maps` (node-centred, whitened, shared edge nodes), float32. The six faces
(+X -X +Y -Y +Z -Z) lie one below the other; where a mirror has several maps, they lie side by side. Channels
`position.X .Y .Z .W` and `normal.X .Y .Z .W` are the two halves of a texel in the map's unit frame (no colour, and not an
environment map); everything else is in the header under `warp_reflect:maps`, one entry per map.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warp_reflect import images

LAYOUT = "whitened_cube_nodes_1"  # ends in the version of how maps are drawn and stored; others are not read
FACES = 6
RESOLUTION_MIN, RESOLUTION_MAX = 8, 2048  # nodes along a cube edge, as `Settings.map_resolution`
HEADER = "warp_reflect:maps"
LAYOUT_HEADER = "warp_reflect:layout"
TURN_ROUNDING = 1.0e-6  # of a unit frame's axes: how far from orthogonal they may be


@dataclass(frozen=True)
class BakedMap:
    """A reflector map as it lies in a file.

    Attributes:
        geometry: Digest of all that it was drawn from (`techniques.baking.geometry_digest`).
        texels: float32 [6, n, n, 8], as `reflector_maps.ReflectorMap`.
        unit_from_body: float64 [4, 4].
        extent: float64 [3].
        inner_radius, outer_radius: As in `ReflectorMap`.
        world_from_object: Where the mirror was when its map was drawn, float64 [4, 4].
        origin: The scene frame's origin then, which `unit_from_body` refers to, float64 [3].
    """

    geometry: str
    texels: np.ndarray
    unit_from_body: np.ndarray
    extent: np.ndarray
    inner_radius: float
    outer_radius: float
    world_from_object: np.ndarray
    origin: np.ndarray

    @property
    def resolution(self) -> int:
        """Nodes along a cube edge."""
        return self.texels.shape[1]

    def fault(self) -> str:
        """What makes the numbers unusable; empty if nothing does."""
        n = self.texels.shape[1] if self.texels.ndim == 4 else 0
        if self.texels.shape != (FACES, n, n, 8) or not RESOLUTION_MIN <= n <= RESOLUTION_MAX:
            return f"texels: got shape {list(self.texels.shape)}, expected [6, n, n, 8] with n of 8 to 2048"
        if self.texels.dtype != np.float32 or not np.isfinite(self.texels).all():
            return "texels: got values that are not finite float32"
        if self.unit_from_body.shape != (4, 4) or not np.isfinite(self.unit_from_body).all():
            return "unit_from_body: expected 4 x 4 finite numbers"
        turn = self.unit_from_body[:3, :3] @ self.unit_from_body[:3, :3].T
        scale = turn[0, 0]
        if not (scale > 0.0 and np.abs(turn / scale - np.eye(3)).max() < TURN_ROUNDING):
            return "unit_from_body: expected a turn and one scale"
        if self.extent.shape != (3,) or not (np.isfinite(self.extent) & (self.extent > 0.0)).all():
            return f"extent: got {self.extent.tolist()}, expected 3 numbers above 0"
        if not (np.isfinite([self.inner_radius, self.outer_radius]).all() and self.outer_radius > 0.0):
            return f"radii: got {self.inner_radius:g} and {self.outer_radius:g}, expected finite numbers"
        place = self.world_from_object
        if place.shape != (4, 4) or self.origin.shape != (3,):
            return f"place: got shapes {list(place.shape)} and {list(self.origin.shape)}, expected [4, 4] and [3]"
        if not (np.isfinite(place).all() and np.isfinite(self.origin).all()):
            return "place: expected finite numbers"
        return ""


def write_maps(
    path: str | os.PathLike, maps: Sequence[BakedMap], attributes: Mapping[str, object] | None = None
) -> None:
    """Write the maps of one mirror; under a passing name first, so that nobody meets half a file.

    Args:
        path: An .exr.
        maps: At least one, all of one resolution.
        attributes: More header entries.

    Raises:
        ValueError: no map, or resolutions that differ.
        OSError: the file could not be written.
    """
    if not maps or len({each.resolution for each in maps}) != 1:
        raise ValueError(f"{path}: got maps of {[each.resolution for each in maps]} nodes, expected one resolution")
    n = maps[0].resolution
    texels = np.concatenate([each.texels.reshape(FACES * n, n, 8) for each in maps], axis=1)
    # One JSON text: the header's own float attributes are float32.
    entries = [
        {
            "geometry": each.geometry,
            "unit_from_body": each.unit_from_body.tolist(),
            "extent": each.extent.tolist(),
            "inner_radius": float(each.inner_radius),
            "outer_radius": float(each.outer_radius),
            "world_from_object": each.world_from_object.tolist(),
            "origin": each.origin.tolist(),
        }
        for each in maps
    ]
    header = {LAYOUT_HEADER: LAYOUT, HEADER: entries} | dict(attributes or {})
    images.write_exr(path, {"position": texels[..., :4], "normal": texels[..., 4:]}, half=(), attributes=header)


def read_maps(path: str | os.PathLike) -> tuple[BakedMap, ...]:
    """The maps that `write_maps` wrote, bit for bit.

    Raises:
        OSError: no such file, or not whole.
        ValueError: it holds something else; one line that says what.
    """
    channels, header = images.read_exr(path)
    layout, entries = header.get(LAYOUT_HEADER), header.get(HEADER)
    if layout != LAYOUT:
        raise ValueError(f"{path}: got the layout {layout!r}, expected {LAYOUT!r}; bake it again")
    try:
        texels = np.concatenate(
            [
                channels["position"],
                channels["position.W"][..., None],
                channels["normal"],
                channels["normal.W"][..., None],
            ],
            axis=-1,
        )
        height, width = texels.shape[:2]
        n = height // FACES
        if not isinstance(entries, list) or not entries or (height, width) != (FACES * n, len(entries) * n):
            raise ValueError(f"{width} x {height} pixels do not hold six faces for each entry of its header")
        maps = tuple(
            BakedMap(
                str(entry["geometry"]),
                np.ascontiguousarray(texels[:, k * n : (k + 1) * n]).reshape(FACES, n, n, 8),
                np.array(entry["unit_from_body"], np.float64),
                np.array(entry["extent"], np.float64),
                float(entry["inner_radius"]),
                float(entry["outer_radius"]),
                np.array(entry["world_from_object"], np.float64),
                np.array(entry["origin"], np.float64),
            )
            for k, entry in enumerate(entries)
        )
        faults = [fault for fault in (each.fault() for each in maps) if fault]
        if faults:
            raise ValueError(faults[0])
    except (KeyError, TypeError, ValueError) as fault:
        raise ValueError(f"{path}: not a baked reflector map ({fault}); bake it again") from None
    return maps
