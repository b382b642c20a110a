"""What moves, put into a mirror's local map in a second pass: reference maps hold nothing of it.

Source: Meyer and Loscos 2003, section 6, where people walk through the reconstructed maps. Differs from it by: where they draw,
rays of texels go through a tree over the moving triangles alone, to the parts that may lie before what the map holds, and no
farther; other moving mirrors are met as well, and show their own maps: those of what stands still, or those of the frame
before (`environment_update` "previous"). A mirror's own vehicle is not in its map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.cubemap import FACE_COUNT, radiance_direction
from warp_reflect.environment_maps import CubeMaps, Onward, copied_maps
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import local_map
from warp_reflect.techniques.environment import vehicle_of

# Directions and centres are finite: those of texels, and of bodies.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

KEY = "moving parts"
FAR = wp.constant(3.0e38)
TILE = wp.constant(8)  # texels along a side of the squares that are asked at once which parts may be in them
TILE_SPLIT_MIN = 64  # tiles
SPHERE_SLACK = 1.0001  # of a part's radius: roundings hide nothing
CONE_SLACK = wp.constant(1.0e-5)  # of the cosine between a tile and a part


@dataclass
class Tree:
    """A tree over the moving triangles of a stage, each part in a branch of its own: the same at every time.

    Attributes:
        mesh: Of them.
        vertex: Numbers of its points in the scene, int [m].
        number: Of its triangles in the scene, int [n].
        part: Of each, index into the scene's parts, int [n].
        fitted: The points that it is fitted to.
    """

    mesh: wp.Mesh
    vertex: np.ndarray
    number: np.ndarray
    part: np.ndarray
    fitted: wp.array | None = None


@dataclass
class Movers:
    """What moves at one time of a stage.

    Attributes:
        tree: Over it.
        points: Of the tree, scene frame.
        spheres: Around each part of the scene that moves, float32 [parts, 4]: middle, radius.
        row: Of a part in them.
    """

    tree: Tree
    points: wp.array
    spheres: np.ndarray
    row: dict[int, int]

    @property
    def id(self) -> int:
        """Handle of the tree, fitted to what it was at this time."""
        if self.tree.fitted is not self.points:
            wp.copy(self.tree.mesh.points, self.points)
            self.tree.mesh.refit()
            self.tree.fitted = self.points
        return self.tree.mesh.id


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


@wp.kernel
def moving_texels_kernel(
    first: int,
    mesh_id: wp.uint64,
    group: wp.array(dtype=int),
    sphere: wp.array(dtype=wp.vec4),
    eye: wp.vec3,
    resolution: int,
    # Changed:
    out_distance: wp.array(dtype=float),
    out_face: wp.array(dtype=int),
):
    """One thread per tile of texels: the moving triangles before what the map holds there, and the distances to them.

    A part is asked, by a ray for every texel, where its sphere is in the tile's cone and nearer than the farthest that is there.
    """
    tile = first + wp.tid()
    n = resolution
    tiles = (n + TILE - 1) / TILE
    face = tile / (tiles * tiles)
    top = (tile - face * tiles * tiles) / tiles
    left = (tile - (face * tiles + top) * tiles) * TILE
    top = top * TILE
    right = wp.min(left + TILE, n)
    bottom = wp.min(top + TILE, n)
    axis = texel_towards(face, 0.5 * float(left + right), 0.5 * float(top + bottom), n)
    cosine = float(1.0)
    for corner in range(4):
        x = wp.where(corner % 2 == 0, left, right)
        y = wp.where(corner < 2, top, bottom)
        cosine = wp.min(cosine, wp.dot(axis, texel_towards(face, float(x), float(y), n)))
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    farthest = float(0.0)
    row = top
    while row < bottom:
        column = left
        while column < right:
            reach = out_distance[(face * n + row) * n + column]
            farthest = wp.max(farthest, wp.where(reach > 0.0, reach, FAR))
            column += 1
        row += 1
    k = int(0)
    while k < group.shape[0]:
        towards = wp.vec3(sphere[k][0], sphere[k][1], sphere[k][2]) - eye
        away = wp.length(towards)
        radius = sphere[k][3]
        asked = int(1)
        if away > radius:
            # The angle between both axes against the sum of both half angles.
            part_sine = radius / away
            least = cosine * wp.sqrt(1.0 - part_sine * part_sine) - sine * part_sine
            if wp.dot(axis, towards) < (least - CONE_SLACK) * away or away - radius > farthest:
                asked = 0
        if asked == 1:
            root = wp.mesh_get_group_root(mesh_id, group[k])
            row = top
            while row < bottom:
                column = left
                while column < right:
                    i = (face * n + row) * n + column
                    reach = out_distance[i]
                    ray = texel_towards(face, float(column) + 0.5, float(row) + 0.5, n)
                    query = wp.mesh_query_ray(mesh_id, eye, ray, wp.where(reach > 0.0, reach, FAR), root)
                    if query.result:
                        out_face[i] = query.face
                        out_distance[i] = wp.max(query.t, 1.0e-30)
                    column += 1
                row += 1
        k += 1


def draw_moving(
    scene: Scene,
    local: CubeMaps,
    state: wp.array,
    parts: tuple[int, ...],
    onward: Callable[[set[int]], Onward | None],
    settings: Settings,
) -> tuple[CubeMaps, wp.array, dict[str, int]]:
    """A local map with parts that move in front of what it holds.

    Args:
        scene: Of the map.
        local: A map of all else, its faces along the axes of the world; it is not changed.
        state: Of its texels, see `local_map.blend_local_map`.
        parts: What is met, see `moving_in`.
        onward: For the parts that are seen, what mirrors among them show; None: the domes.
        settings: `threads`, shadows.

    Returns:
        (The map; the state of its texels; statistics `local_moving`: texels that show what moves).
    """
    movers, device, n = _movers(scene), scene.device, local.resolution
    made = copied_maps(local)
    made.view.distance = wp.clone(local.view.distance)
    face = wp.full(len(local.view.distance), -1, dtype=int, device=device)
    eye = wp.vec3(*(local.centres[0] - scene.origin))
    groups = wp.array(parts, dtype=int, device=device)
    spheres = wp.array(movers.spheres[[movers.row[k] for k in parts]], dtype=wp.vec4, device=device)
    tiles = FACE_COUNT * (-(-n // int(TILE))) ** 2
    inputs = [wp.uint64(movers.id), groups, spheres, eye, n, made.view.distance, face]
    launch.launch(moving_texels_kernel, tiles, inputs, device, settings.threads, split_min=TILE_SPLIT_MIN)
    met = face.numpy()
    shown = np.flatnonzero(met >= 0)
    if not len(shown):
        return made, state, {"local_moving": 0}
    triangle, of_state = local.view.triangle.numpy().copy(), state.numpy().copy()
    triangle[shown] = movers.tree.number[met[shown]]
    of_state[shown] = local_map.TEXEL_SHADED
    made.view.triangle = wp.array(triangle, dtype=int, device=device)
    seen = set(np.unique(movers.tree.part[met[shown]]).tolist())
    local_map.shade_texels(scene, made, shown, settings, onward(seen))
    return made, wp.array(of_state, dtype=wp.uint8, device=device), {"local_moving": len(shown)}


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand the tree over to the same stage's scene at another time, whose triangles have the same numbers."""
    if (KEY,) in earlier.environments and (KEY,) not in scene.environments:
        scene.environments[(KEY,)] = _at(scene, earlier.environments[(KEY,)].tree)


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
        groups = wp.array(part, dtype=wp.int32, device=device)
        mesh = wp.Mesh(points, indices, bvh_constructor="lbvh" if device.is_cuda else "sah", groups=groups)
        scene.environments[(KEY,)] = _at(scene, Tree(mesh, vertex, number, part))
    return scene.environments[(KEY,)]


def _at(scene: Scene, tree: Tree) -> Movers:
    first, _, boxes = scene.boxes
    solid = [k for k in scene.moving_parts if scene.parts[k].triangle_count]
    corners = boxes[np.searchsorted(first, [scene.parts[k].first_vertex for k in solid])]
    middle = corners.mean(axis=1)
    radius = SPHERE_SLACK * np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
    spheres = np.column_stack([middle, radius]).astype(np.float32)
    points = wp.array(scene.host_points[tree.vertex], dtype=wp.vec3, device=scene.device)
    return Movers(tree, points, spheres, {k: row for row, k in enumerate(solid)})
