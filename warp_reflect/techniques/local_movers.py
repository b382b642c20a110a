"""What moves, put into a mirror's local map in a second pass: reference maps hold nothing of it.

Source: Meyer and Loscos 2003, section 6, where people walk through the reconstructed maps. Differs from it by: a ray for every
texel through a tree over the moving triangles alone, no farther than to what the map holds, where they draw; other moving
mirrors are met as well, and show their own maps: those of what stands still, or those of the frame before
(`environment_update` "previous").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.cubemap import radiance_direction
from warp_reflect.environment_maps import CubeMaps, Onward, copied_maps
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import local_map

# Directions and centres are finite: those of texels, and of bodies.
wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

KEY = "moving parts"
FAR = wp.constant(3.0e38)


@dataclass
class Movers:
    """The moving triangles of a scene by themselves, with a tree over them.

    Attributes:
        mesh: Of them; triangles that are left out are shrunk to a point.
        corners: Of its triangles, indices into its points, int32 [n, 3].
        number: Of each in the scene, int [n].
        part: Of each, index into the scene's parts, int [n].
        without: The parts that are left out now.
    """

    mesh: wp.Mesh
    corners: np.ndarray
    number: np.ndarray
    part: np.ndarray
    without: frozenset[int] = frozenset()

    def leave_out(self, parts: frozenset[int]) -> None:
        """Fit the tree to all parts but some."""
        if parts == self.without:
            return
        gone = np.isin(self.part, list(parts))
        corners = np.where(gone[:, None], self.corners[:, :1], self.corners)
        self.mesh.indices.assign(corners.reshape(-1))
        self.mesh.refit()
        self.without = parts


def moving_in(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    """The parts that move and that a mirror may show: not itself, nor its vehicle, nor what its collection does not name."""
    seen, own = scene.seen_in(scene.parts[part]), {part, *vehicle_of(scene, part, settings)}
    return tuple(
        k
        for k in scene.moving_parts
        if k not in own and scene.parts[k].triangle_count and (seen is None or seen[scene.parts[k].first_triangle])
    )


def vehicle_of(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    """What moves with a mirror and is about as large: a map's eye is amid it, where it would hide what the mirror shows.

    Meyer and Loscos leave a car out of its own map. A small mirror on a large vehicle, whose eye is not within it, shows it;
    what stands still is no vehicle, since it is not known what would move together.

    Args:
        scene: Its instances name what they move by.
        part: The mirror, index into `scene.parts`.
        settings: `local_own_size`.

    Returns:
        The parts, without the mirror; none where it does not move.
    """
    instances, own = scene.data.instances, scene.parts[part]
    by, copy = instances[own.prim - 1].mover, own.instance
    if not by or settings.local_own_size == 0.0:
        return ()
    with_it = [
        k
        for k in scene.moving_parts
        if scene.parts[k].instance == copy and f"{instances[scene.parts[k].prim - 1].mover}/".startswith(f"{by}/")
    ]
    first, _, boxes = scene.boxes
    rows = np.searchsorted(first, [own.first_vertex, *(scene.parts[k].first_vertex for k in with_it)])
    alone, together = (np.linalg.norm(np.ptp(boxes[each].reshape(-1, 3), axis=0)) for each in (rows[:1], rows))
    return tuple(k for k in with_it if k != part) if together <= settings.local_own_size * alone else ()


@wp.kernel
def moving_texels_kernel(
    first: int,
    mesh_id: wp.uint64,
    eye: wp.vec3,
    resolution: int,
    distance: wp.array(dtype=float),
    # Outputs:
    out_face: wp.array(dtype=int),
    out_distance: wp.array(dtype=float),
):
    """One thread per texel: the moving triangle before what the map holds there, -1 none, and the distance to what is seen."""
    i = first + wp.tid()
    n = resolution
    face = i / (n * n)
    row = (i - face * n * n) / n
    column = i - (face * n + row) * n
    u = (2.0 * float(column) + 1.0) / float(n) - 1.0
    v = (2.0 * float(row) + 1.0) / float(n) - 1.0
    reach = distance[i]
    query = wp.mesh_query_ray(
        mesh_id, eye, wp.normalize(radiance_direction(face, u, v)), wp.where(reach > 0.0, reach, FAR)
    )
    out_face[i] = -1
    out_distance[i] = reach
    if query.result:
        out_face[i] = query.face
        out_distance[i] = query.t


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
    movers, device = _movers(scene), scene.device
    movers.leave_out(frozenset(scene.moving_parts) - frozenset(parts))
    made = copied_maps(local)
    count = len(local.view.distance)
    face = wp.empty(count, dtype=int, device=device)
    made.view.distance = wp.empty(count, dtype=float, device=device)
    eye = wp.vec3(*(local.centres[0] - scene.origin))
    inputs = [wp.uint64(movers.mesh.id), eye, local.resolution, local.view.distance, face, made.view.distance]
    launch.launch(moving_texels_kernel, count, inputs, device, settings.threads)
    met = face.numpy()
    shown = np.flatnonzero(met >= 0)
    if not len(shown):
        return made, state, {"local_moving": 0}
    triangle, of_state = local.view.triangle.numpy().copy(), state.numpy().copy()
    triangle[shown] = movers.number[met[shown]]
    of_state[shown] = local_map.TEXEL_SHADED
    made.view.triangle = wp.array(triangle, dtype=int, device=device)
    seen = set(np.unique(movers.part[met[shown]]).tolist())
    local_map.shade_texels(scene, made, shown, settings, onward(seen))
    return made, wp.array(of_state, dtype=wp.uint8, device=device), {"local_moving": len(shown)}


def _movers(scene: Scene) -> Movers:
    if (KEY,) not in scene.environments:
        parts = [scene.parts[k] for k in scene.moving_parts]
        number = np.concatenate([np.arange(p.first_triangle, p.first_triangle + p.triangle_count) for p in parts])
        part = np.repeat(scene.moving_parts, [p.triangle_count for p in parts])
        spans = dict.fromkeys((p.first_vertex, p.vertex_count) for p in parts)  # parts of one prim share its vertices
        used = np.concatenate([np.arange(first, first + count) for first, count in spans])
        place = np.zeros(scene.vertex_count, np.int32)
        place[used] = np.arange(len(used), dtype=np.int32)
        corners = place[scene.host_triangles[number]]
        points = wp.array(scene.host_points[used], dtype=wp.vec3, device=scene.device)
        indices = wp.array(corners.reshape(-1), dtype=wp.int32, device=scene.device)
        mesh = wp.Mesh(points, indices, bvh_constructor="lbvh" if scene.device.is_cuda else "sah")
        scene.environments[(KEY,)] = Movers(mesh, corners, number, part)
    return scene.environments[(KEY,)]
