"""Local maps that are made together: the arrays that they share, and where each of them lies in those.

What a frame's mirrors show is made by a few launches whatever their number; a map's texels are the same, bit for bit, alone
and among others. Every map's texels begin at a whole block, its lines and rows at whole groups, so that one small table for
each tells which map an element is of.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
import warp as wp

from warp_reflect.cubemap import FACE_COUNT, radiance_direction
from warp_reflect.environment_maps import CubeMaps, CubeMapsView, PackedRange
from warp_reflect.scene import Scene
from warp_reflect.vector import BLOCK

wp.set_module_options({"enable_backward": False})

SIDES = 4  # faces of a map that stand upright
LINES = 16  # of a group of neighbouring lines of such a face: the widest vectors have as many lanes
ROW_MULTIPLE = 16  # texels: no vector of them goes over the end of a row


@wp.struct
class LocalPlace:
    """A map among those that are made together."""

    eye: wp.vec3  # its centre, scene frame
    resolution: int
    first_texel: int  # in the arrays
    first_group: int  # of lines
    first_steep: int  # block of texels of the two faces that look along the third axis of a field
    first_row: int
    slack: float  # length by which its depths may be off
    swept: int  # 1: its depths are those of a field


@dataclass(frozen=True)
class Layout:
    """Where maps of some resolutions lie.

    Attributes:
        resolutions: Texels along a cube edge of every map.
        first_texel, first_group, first_steep, first_row: Of every map, int [maps]; see `LocalPlace`.
        texel_count: Elements of arrays of texels.
        block_map, group_map, steep_map, row_map: Which map a block of texels, a group of lines, a block of steep texels and a
            row is of, on the device.
    """

    resolutions: tuple[int, ...]
    first_texel: np.ndarray
    first_group: np.ndarray
    first_steep: np.ndarray
    first_row: np.ndarray
    texel_count: int
    block_map: wp.array
    group_map: wp.array
    steep_map: wp.array
    row_map: wp.array

    def texels(self, k: int) -> slice:
        """Those of map k."""
        first = int(self.first_texel[k])
        return slice(first, first + FACE_COUNT * self.resolutions[k] ** 2)


@cache
def layout(resolutions: tuple[int, ...], device: str) -> Layout:
    """Where maps of these resolutions lie; a frame's are mostly those of the one before."""
    n = np.array(resolutions, np.int64)

    def tabled(counts: np.ndarray) -> tuple[np.ndarray, wp.array]:
        first = np.concatenate([[0], np.cumsum(counts)[:-1]])
        table = np.repeat(np.arange(len(n), dtype=np.int32), counts)
        return first, wp.array(table, dtype=int, device=device)

    blocks, block_map = tabled(-(-FACE_COUNT * n * n // BLOCK))
    groups, group_map = tabled(-(-SIDES * n // LINES))
    steep, steep_map = tabled(-(-2 * n * n // BLOCK))
    rows, row_map = tabled(FACE_COUNT * n)
    return Layout(
        resolutions,
        blocks * BLOCK,
        groups,
        steep,
        rows,
        len(block_map) * BLOCK,
        block_map,
        group_map,
        steep_map,
        row_map,
    )


@dataclass
class LocalMaps:
    """Local maps that are made together; arrays on the device, of texels where nothing else is said.

    Attributes:
        scene: Of its frame.
        centres: World, float64 [maps, 3].
        layout: Where each lies.
        places: `LocalPlace` of each.
        inverse: Inverse depth along the face's axis, 0 sky, float32; None where the maps were known.
        triangle: What it shows, -1 sky or unknown, int32.
        radiance, distance: As in `environment_maps.CubeMapsView`.
        state: uint8, a `local_map.TEXEL_...`.
        cells: Of the meshes of those that have one, see `local_mesh.DepthMesh`.
        statistics: Of each map.
    """

    scene: Scene
    centres: np.ndarray
    layout: Layout
    places: wp.array
    inverse: wp.array | None
    triangle: wp.array
    radiance: wp.array
    distance: wp.array
    state: wp.array
    cells: dict[int, np.ndarray] = field(default_factory=dict)
    statistics: list[dict] = field(default_factory=list)

    @classmethod
    def empty(cls, scene: Scene, centres: np.ndarray, resolutions, slack=0.0, swept=0) -> LocalMaps:
        """Maps to be filled.

        Args:
            scene: Of their frame.
            centres: World, [maps, 3].
            resolutions: Texels along a cube edge of each.
            slack, swept: Of all, or of each; see `LocalPlace`.
        """
        device, centres = scene.device, np.asarray(centres, np.float64).reshape(-1, 3)
        where = layout(tuple(resolutions), str(device))
        places = np.zeros(len(centres), LocalPlace.numpy_dtype())
        places["eye"] = centres - scene.origin
        places["resolution"] = where.resolutions
        for name in ("first_texel", "first_group", "first_steep", "first_row"):
            places[name] = getattr(where, name)
        places["slack"], places["swept"] = slack, swept
        kinds = (float, int, wp.vec4, float, wp.uint8)
        arrays = [wp.empty(where.texel_count, dtype=kind, device=device) for kind in kinds]
        made = wp.array(places, dtype=LocalPlace, device=device)
        return cls(scene, centres, where, made, *arrays, {}, [{} for _ in centres])

    @property
    def count(self) -> int:
        return len(self.centres)

    @cached_property
    def eyes(self) -> wp.array:
        """Their centres, scene frame, vec3 [maps]."""
        centres = (self.centres - self.scene.origin).astype(np.float32)
        return wp.array(centres, dtype=wp.vec3, device=self.scene.device)

    def cube_map(self, k: int) -> tuple[CubeMaps, wp.array]:
        """(Map k, which shares these arrays; the state of its texels)."""
        texels, n = self.layout.texels(k), self.layout.resolutions[k]
        view = CubeMapsView()
        of_size, nothing, unturned = _view_of(n, str(self.scene.device))
        view.resolution, view.map_texels, view.level_count = n, FACE_COUNT * n * n, 1
        view.level_first, view.level_size = of_size
        view.packed, view.ranges, view.palette = nothing
        view.map_from_world = unturned
        view.radiance, view.distance, view.triangle = (
            each[texels] for each in (self.radiance, self.distance, self.triangle)
        )
        centre = self.centres[k : k + 1]
        view.centre = wp.array((centre - self.scene.origin).astype(np.float32), dtype=wp.vec3, device=self.scene.device)
        return CubeMaps(view, centre, np.eye(3)[None]), self.state[texels]

    def put(self, k: int, local: CubeMaps, state: wp.array) -> None:
        """Copy a map's texels and their state to map k, of the same resolution."""
        first = int(self.layout.first_texel[k])
        pairs = [(self.radiance, local.view.radiance), (self.distance, local.view.distance)]
        pairs += [(self.triangle, local.view.triangle), (self.state, state)]
        for own, other in pairs:
            wp.copy(own, other, dest_offset=first, count=len(state))


@cache
def _view_of(resolution: int, device: str) -> tuple:
    """Of a view of one map: its levels, no packed texels, axes of the world."""
    levels = [wp.array(np.array([each], np.int32), dtype=int, device=device) for each in (0, resolution)]
    nothing = [wp.empty(0, dtype=kind, device=device) for kind in (wp.uint32, PackedRange, wp.vec2)]
    return levels, nothing, wp.array(np.eye(3, dtype=np.float32)[None], dtype=wp.mat33, device=device)


@wp.func
def texel_towards(place: LocalPlace, t: int) -> wp.vec3:
    """The direction of texel t of a map, at length 1 along its face's axis."""
    n = place.resolution
    face = t / (n * n)
    row = (t - face * n * n) / n
    column = t - (face * n + row) * n
    u = (2.0 * float(column) + 1.0) / float(n) - 1.0
    v = (2.0 * float(row) + 1.0) / float(n) - 1.0
    return radiance_direction(face, u, v)
