"""What moves, put into a mirror's local map in a second pass: reference maps hold nothing of it.

Source: Meyer and Loscos 2003, section 6, where people walk through the reconstructed maps. Differs from it by: where they draw,
rays of texels go through a tree over the moving triangles alone, to the parts that may lie before what the map holds, and no
farther; other moving mirrors are met as well, and show their own maps: those of what stands still, or those of the frame
before (`environment_update` "previous"). A mirror's own vehicle is not in its map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from warp_reflect import launch, trees, vector
from warp_reflect.cubemap import FACE_COUNT, radiance_direction
from warp_reflect.environment_maps import CubeMaps, Onward
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import local_shading
from warp_reflect.techniques.environment import vehicle_of
from warp_reflect.techniques.local_maps import LocalMaps, LocalPlace

# Directions and centres are finite: those of texels, and of bodies.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

KEY = "moving parts"
FAR = wp.constant(3.0e38)
TILE = wp.constant(8)  # texels along a side of the squares that are asked at once which parts may be in them
TILE_SPLIT_MIN = 64  # tiles
SPHERE_SLACK = 1.0001  # of a part's radius: roundings hide nothing
CONE_SLACK = wp.constant(1.0e-5)  # of the cosine between a tile and a part
INSIDE = 4.0  # times the cosine of half a tile's angle, which is above 0.5, is more than the cosine of any angle
MOVING = wp.constant(local_shading.TEXEL_MOVING)


@dataclass
class Moving:
    """The moving triangles of a stage: the same at every time.

    Attributes:
        tree: Over them, each part in a branch of its own.
        vertex: Numbers of its points in the scene, int [m].
        number: Of its triangles in the scene, int [n].
        part: Of each, index into the scene's parts, int [n].
    """

    tree: trees.Tree
    vertex: np.ndarray
    number: np.ndarray
    part: np.ndarray

    @cached_property
    def on_device(self) -> wp.array:
        """`number`, on the device."""
        return wp.array(self.number.astype(np.int32), dtype=int, device=self.tree.mesh.device)


@dataclass
class Movers:
    """What moves at one time of a stage.

    Attributes:
        known: Of all times.
        points: Of the tree, scene frame.
        spheres: Around each part of the scene that moves, float32 [parts, 4]: middle, radius.
        row: Of a part in them.
    """

    known: Moving
    points: wp.array
    spheres: np.ndarray
    row: dict[int, int]

    @property
    def id(self) -> int:
        """Handle of the tree, fitted to what it was at this time."""
        return self.known.tree.to(self.points).mesh.id


def moving_in(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    """The parts that move and that a mirror may show: not itself, nor its vehicle, nor what its collection does not name."""
    seen, own = scene.seen_in(scene.parts[part]), {part, *vehicle_of(scene, part, settings)}
    return tuple(
        k
        for k in scene.moving_parts
        if k not in own and scene.parts[k].triangle_count and (seen is None or seen[scene.parts[k].first_triangle])
    )


@wp.func
def texel_towards(tile_face: int, column: float, row: float, n: int) -> wp.vec3:
    """Unit direction to a place on a face, in texels from its corner."""
    u = 2.0 * column / float(n) - 1.0
    v = 2.0 * row / float(n) - 1.0
    return wp.normalize(radiance_direction(tile_face, u, v))


@wp.struct
class Asked:
    """A moving part as a map sees it."""

    part: int
    towards: wp.vec3  # unit, to the middle of its sphere
    near: float  # the least distance of what is in the sphere
    cosine: float  # of half the angle that the sphere takes; -`INSIDE` where the eye is in it
    sine: float


@wp.struct
class Tile:
    """Neighbouring texels of a face, columns left to right - 1 and rows top to bottom - 1, and the cone of their rays."""

    face: int
    left: int
    top: int
    right: int
    bottom: int
    axis: wp.vec3
    cosine: float  # of half its angle
    sine: float


@wp.func
def tile_of(place: LocalPlace, number: int) -> Tile:
    """Tile of a map."""
    n = place.resolution
    tiles = (n + TILE - 1) / TILE
    tile = Tile()
    tile.face = number / (tiles * tiles)
    row = (number - tile.face * tiles * tiles) / tiles
    tile.left = (number - (tile.face * tiles + row) * tiles) * TILE
    tile.top = row * TILE
    tile.right = wp.min(tile.left + TILE, n)
    tile.bottom = wp.min(tile.top + TILE, n)
    tile.axis = texel_towards(tile.face, 0.5 * float(tile.left + tile.right), 0.5 * float(tile.top + tile.bottom), n)
    tile.cosine = 1.0
    for corner in range(4):
        x = wp.where(corner % 2 == 0, tile.left, tile.right)
        y = wp.where(corner < 2, tile.top, tile.bottom)
        tile.cosine = wp.min(tile.cosine, wp.dot(tile.axis, texel_towards(tile.face, float(x), float(y), n)))
    tile.sine = wp.sqrt(wp.max(1.0 - tile.cosine * tile.cosine, 0.0))
    return tile


@wp.func
def farthest_in(place: LocalPlace, tile: Tile, distance: wp.array(dtype=float)) -> float:
    """How far away the farthest is that a map holds in a tile."""
    farthest = float(0.0)
    row = tile.top
    while row < tile.bottom:
        column = tile.left
        while column < tile.right:
            reach = distance[place.first_texel + (tile.face * place.resolution + row) * place.resolution + column]
            farthest = wp.max(farthest, wp.where(reach > 0.0, reach, FAR))
            column += 1
        row += 1
    return farthest


@wp.kernel
def moving_texels_kernel(
    first: int,
    mesh_id: wp.uint64,
    number: wp.array(dtype=int),
    asked: wp.array(dtype=Asked),
    asked_first: wp.array(dtype=int),
    places: wp.array(dtype=LocalPlace),
    tile_map: wp.array(dtype=int),
    tile_first: wp.array(dtype=int),
    # Changed:
    out_distance: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_state: wp.array(dtype=wp.uint8),
):
    """One thread per tile of texels: the moving triangles before what the map holds there, and the distances to them.

    A part is asked, by a ray for every texel, where its sphere is in the tile's cone and nearer than the farthest that is there.
    Those of map k are `asked_first[k]` to `asked_first[k + 1]`; `number` of a triangle of the tree is its own in the scene.
    """
    number_of_tile = first + wp.tid()
    map_number = tile_map[number_of_tile]
    place = places[map_number]
    tile = tile_of(place, number_of_tile - tile_first[map_number])
    n = place.resolution
    farthest = float(-1.0)
    k = asked_first[map_number]
    while k < asked_first[map_number + 1]:
        # The angle between both axes against the sum of both half angles.
        least = tile.cosine * asked[k].cosine - tile.sine * asked[k].sine - CONE_SLACK
        if wp.dot(tile.axis, asked[k].towards) >= least:
            if farthest < 0.0:
                farthest = farthest_in(place, tile, out_distance)
            if asked[k].near <= farthest:
                root = wp.mesh_get_group_root(mesh_id, asked[k].part)
                row = tile.top
                while row < tile.bottom:
                    column = tile.left
                    while column < tile.right:
                        i = place.first_texel + (tile.face * n + row) * n + column
                        reach = out_distance[i]
                        ray = texel_towards(tile.face, float(column) + 0.5, float(row) + 0.5, n)
                        query = wp.mesh_query_ray(mesh_id, place.eye, ray, wp.where(reach > 0.0, reach, FAR), root)
                        if query.result:
                            out_triangle[i] = number[query.face]
                            out_distance[i] = wp.max(query.t, 1.0e-30)
                            out_state[i] = wp.uint8(MOVING)
                        column += 1
                    row += 1
        k += 1


def meet_moving(scene: Scene, local: LocalMaps, parts: Sequence[tuple[int, ...]], settings: Settings) -> None:
    """Put parts that move before what local maps hold, to be shaded.

    Args:
        scene: Of the maps.
        local: Their faces along the axes of the world; changed.
        parts: What each of them meets, see `moving_in`.
        settings: `threads`, `kernels`.
    """
    movers, device = _movers(scene), scene.device
    asked, asked_first = _asked(movers, local, parts)
    if not len(asked):
        return
    made = wp.array(asked, dtype=Asked, device=device)
    inputs = [wp.uint64(movers.id), movers.known.on_device, made, wp.array(asked_first, dtype=int, device=device)]
    tiles = FACE_COUNT * (-(-np.array(local.layout.resolutions) // int(TILE))) ** 2
    tile_map = np.repeat(np.arange(len(tiles), dtype=np.int32), tiles)
    tile_first = (np.cumsum(tiles) - tiles).astype(np.int32)
    inputs += [local.places, *(wp.array(each, dtype=int, device=device) for each in (tile_map, tile_first))]
    inputs += [local.distance, local.triangle, local.state]
    kernel = moving_texels_kernel
    if vector.chosen(settings.kernels, device):
        from warp_reflect.techniques import local_movers_vector  # which uses this module's structures

        kernel = local_movers_vector.moving_tiles_kernel
    launch.launch(kernel, len(tile_map), inputs, device, settings.threads, split_min=TILE_SPLIT_MIN)


def _asked(movers: Movers, local: LocalMaps, parts: Sequence[tuple[int, ...]]) -> tuple[np.ndarray, np.ndarray]:
    """Rows of `Asked`, those of a map after one another, the nearest first; where each map's begin and the last ends."""
    counts = [len(each) for each in parts]
    numbers = np.array([k for each in parts for k in each], np.int64)
    of_map = np.repeat(np.arange(len(parts)), counts)
    rows = np.zeros(len(numbers), Asked.numpy_dtype())
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    if len(numbers):
        sphere = movers.spheres[[movers.row[k] for k in numbers.tolist()]].astype(np.float64)
        towards = sphere[:, :3] - (local.centres - local.scene.origin)[of_map]
        away, radius = np.linalg.norm(towards, axis=1), sphere[:, 3]
        order = np.lexsort((away, of_map))
        towards, away, radius = towards[order], away[order], radius[order]
        outside = away > radius
        sine = np.where(outside, radius / np.maximum(away, 1.0e-300), 0.0)
        rows["part"] = numbers[order]
        rows["towards"] = towards / np.maximum(away, 1.0e-300)[:, None]
        rows["near"] = np.maximum(away - radius, 0.0)
        # Around the eye: whatever the tile, the test is passed.
        rows["cosine"], rows["sine"] = np.where(outside, np.sqrt(1.0 - sine * sine), -INSIDE), sine
    return rows, first


def draw_moving(
    scene: Scene,
    local: CubeMaps,
    state: wp.array,
    parts: tuple[int, ...],
    onward: Callable[[], Onward | None],
    settings: Settings,
) -> tuple[CubeMaps, wp.array, dict[str, int]]:
    """A local map with parts that move in front of what it holds.

    Args:
        scene: Of the map.
        local: A map of all else, its faces along the axes of the world; it is not changed.
        state: Of its texels, see `local_map.blend_local_map`.
        parts: What is met, see `moving_in`.
        onward: Where any is seen, what mirrors among them show; None: the domes.
        settings: `threads`, shadows.

    Returns:
        (The map; the state of its texels; statistics `local_moving`: texels that show what moves).
    """
    made = LocalMaps.empty(scene, local.centres[:1], [local.resolution])
    made.put(0, local, state)
    meet_moving(scene, made, [parts], settings)
    local_shading.shade(scene, made, settings.replace(rem_missing="best"), onward)
    return *made.cube_map(0), {"local_moving": made.statistics[0].get("local_moving", 0)}


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand what moves over to the same stage's scene at another time, whose triangles have the same numbers."""
    if (KEY,) in earlier.environments and (KEY,) not in scene.environments:
        scene.environments[(KEY,)] = _at(scene, earlier.environments[(KEY,)].known)


def _movers(scene: Scene) -> Movers:
    if (KEY,) not in scene.environments:
        parts = [scene.parts[k] for k in scene.moving_parts]
        number = np.concatenate([np.arange(p.first_triangle, p.first_triangle + p.triangle_count) for p in parts])
        part = np.repeat(scene.moving_parts, [p.triangle_count for p in parts]).astype(np.int32)
        spans = dict.fromkeys((p.first_vertex, p.vertex_count) for p in parts)  # parts of one prim share its vertices
        vertex = np.concatenate([np.arange(first, first + count) for first, count in spans])
        place = np.zeros(scene.vertex_count, np.int32)
        place[vertex] = np.arange(len(vertex), dtype=np.int32)
        device = scene.device
        points = wp.array(scene.host_points[vertex], dtype=wp.vec3, device=device)
        indices = wp.array(place[scene.host_triangles[number]].reshape(-1), dtype=wp.int32, device=device)
        scene.environments[(KEY,)] = _at(scene, Moving(trees.Tree(points, indices, part), vertex, number, part))
    return scene.environments[(KEY,)]


def _at(scene: Scene, known: Moving) -> Movers:
    first, _, boxes = scene.boxes
    solid = [k for k in scene.moving_parts if scene.parts[k].triangle_count]
    corners = boxes[np.searchsorted(first, [scene.parts[k].first_vertex for k in solid])]
    middle = corners.mean(axis=1)
    radius = SPHERE_SLACK * np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    spheres = np.column_stack([middle, radius]).astype(np.float32)
    points = wp.array(scene.host_points[known.vertex], dtype=wp.vec3, device=scene.device)
    return Movers(known, points, spheres, {k: row for row, k in enumerate(solid)})
