"""What a search in a reflector map follows, and the way it takes: the projected bisector field and a search's path.

Source: Estalella, Martin, Drettakis, Tost, Devillers, Cazals, "Accurate Interactive Specular Reflections on Curved
Objects" (2005), section 4.2 and figure 4: over the surface the bisector's tangential part, on the cube its projection,
whose sink is the reflection point. What differs: the whole cube is told, not a region of one face; and the path is that
of the search that is set, Newton's by default.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.cubemap import node_directions
from warp_reflect.launch import launch
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView, least_mask, sample_map
from warp_reflect.techniques.map_search import (
    SearchSettings,
    bisector_field,
    first_guess,
    is_visible,
    measure,
    search,
)

wp.set_module_options({"enable_backward": False})

PATH_MAX = 128  # places of a path; the midpoint search of 100:1 bodies takes about so many
# A search that is told to stop just below the residual it stopped at last shows the next place it accepts.
LOWER = wp.constant(0.999999)


@dataclass(frozen=True)
class SearchField:
    """Where the eye and the point are both seen from the mirror: the field at nodes of its cube map.

    Attributes:
        cube: float32 [n, 3], on the cube with edge 2; times `ReflectorMap.extent` it is in the unit frame, around the body.
        point: float32 [n, 3], on the surface, unit frame.
        bisector: float32 [n, 3], the unit bisector's part along the surface, unit frame.
        projected: float32 [n, 3], b of the paper: on the cube, along its face.
        residual: float32 [n], tangent of the angle between bisector and normal.
    """

    cube: np.ndarray
    point: np.ndarray
    bisector: np.ndarray
    projected: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True)
class SearchPath:
    """The places a search accepts one after the other; the last one is its answer.

    Attributes:
        cube, point: As of `SearchField`, [k, 3].
        residual: float32 [k], falling; only the last may be higher, of a search that started anew in vain.
        evaluations: int32 [k], map look-ups up to each place.
        visible: Whether anything stands between the eye and the point; if not, no search is made, and k is 0.
    """

    cube: np.ndarray
    point: np.ndarray
    residual: np.ndarray
    evaluations: np.ndarray
    visible: bool


@wp.kernel
def field_kernel(
    first: int,
    map: ReflectorMapView,
    eye: wp.vec3,
    target: wp.vec3,
    node: wp.array(dtype=wp.vec3),
    out_point: wp.array(dtype=wp.vec3),
    out_bisector: wp.array(dtype=wp.vec3),
    out_projected: wp.array(dtype=wp.vec3),
    out_residual: wp.array(dtype=float),
):
    """One thread per node; residual -1 where the field means nothing."""
    i = first + wp.tid()
    x = node[i]
    s = sample_map(map, x)
    r = measure(s, x, eye, target)
    out_residual[i] = -1.0
    if r.cos_eye <= 0.0 or r.cos_target <= 0.0 or least_mask(map, x) < 0.5:
        return
    w = wp.normalize(eye - s.p) + wp.normalize(target - s.p)
    bisector = wp.normalize(w)
    out_point[i] = s.p
    out_bisector[i] = bisector - wp.dot(bisector, s.n) * s.n
    out_projected[i] = bisector_field(map, s, x, eye, target)
    out_residual[i] = r.residual


@wp.kernel
def path_kernel(
    first: int,
    map: ReflectorMapView,
    eye: wp.vec3,
    target: wp.vec3,
    settings: SearchSettings,
    out_cube: wp.array(dtype=wp.vec3),
    out_point: wp.array(dtype=wp.vec3),
    out_residual: wp.array(dtype=float),
    out_evaluations: wp.array(dtype=int),
):
    """One thread: the search again and again, each time to its next place; evaluations -1 where nothing is seen."""
    i = first + wp.tid()
    if not is_visible(map, eye, target):
        out_evaluations[i] = -1
        return
    seed = first_guess(map, eye, target)
    tolerance = settings.tolerance
    stop = settings
    stop.tolerance = float(1.0e30)
    for k in range(i, out_residual.shape[0]):
        r = search(map, eye, target, seed, stop)
        ended = r.residual >= stop.tolerance  # it could not get there: this is its answer
        if ended and k > 0:
            if r.residual == out_residual[k - 1]:
                return
        out_cube[k] = r.x
        out_point[k] = r.p
        out_residual[k] = r.residual
        out_evaluations[k] = r.evaluations
        if ended or r.residual <= tolerance:
            return
        stop.tolerance = wp.max(LOWER * r.residual, tolerance)


def search_field(map: ReflectorMap, eye: np.ndarray, target: np.ndarray, side: int, device, threads: int = 0):
    """The field of an eye and a point, `SearchField`.

    Args:
        map: The reflector's.
        eye, target: float [3], unit frame.
        side: Nodes along a cube edge.
    """
    nodes = node_directions(side).reshape(-1, 3).astype(np.float32)
    count = len(nodes)
    point, bisector, projected = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(3))
    residual = wp.zeros(count, dtype=float, device=device)
    inputs = [map.view, wp.vec3(*eye), wp.vec3(*target), wp.array(nodes, dtype=wp.vec3, device=device)]
    launch(field_kernel, count, [*inputs, point, bisector, projected, residual], device, threads)
    known = residual.numpy() >= 0.0
    return SearchField(nodes[known], *(each.numpy()[known] for each in (point, bisector, projected, residual)))


def search_path(map: ReflectorMap, eye: np.ndarray, target: np.ndarray, settings: SearchSettings, device) -> SearchPath:
    """The way of a cold search for the reflection point of one point.

    Args:
        map: The reflector's.
        eye, target: float [3], unit frame.
        settings: From `map_search.search_settings`.
    """
    cube, point = (wp.zeros(PATH_MAX, dtype=wp.vec3, device=device) for _ in range(2))
    residual = wp.zeros(PATH_MAX, dtype=float, device=device)
    evaluations = wp.zeros(PATH_MAX, dtype=int, device=device)
    inputs = [map.view, wp.vec3(*eye), wp.vec3(*target), settings, cube, point, residual, evaluations]
    launch(path_kernel, 1, inputs, device)
    used = evaluations.numpy()
    known = used > 0
    arrays = (each.numpy()[known] for each in (cube, point, residual, evaluations))
    return SearchPath(*arrays, bool(used[0] >= 0))
