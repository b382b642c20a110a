"""The local environment map of a mirror out of reference environment maps (REMs): no rendering of the scene.

Source: Meyer and Loscos, Real-Time Reflection on Moving Vehicles in Urban Environments, VRST 2003, sections 4.1 to 4.4.
A mesh over every face of a cube around the mirror's centre meets the scene at points I (`local_mesh.py`, `local_field.py`), and
the texel in the direction of I is blended from the REMs that see I. Differs from it by:

* the position of I along the axis of two REMs counts with its sign: the paper's unsigned distances give weights whose sum
  is not 1 beyond the axis' ends;
* the depth test has slack in proportion to a texel's footprint on the surface at I (its distances are float32, the paper's
  8 bits), so that a surface does not fail it against itself;
* for more than two REMs the weights of Buehler et al., Unstructured Lumigraph Rendering, SIGGRAPH 2001, section 4.2;
* a REM on the other side of a surface does not see it, however thin the wall;
* a REM whose texel would cover many of the local map's texels at I (a street seen along it from afar) does not count as
  seeing it, on demand;
* what no REM sees can be shaded where it is met;
* where depths are those of a field, a texel's ray is met with the plane of the triangle that the field names there, if that
  is within a cell: walls and roads are then where they are.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warp_reflect import launch, vector
from warp_reflect.environment_maps import CubeMaps, CubeMapsView, fetch_covered, nearest_texel, texel_distance
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Settings
from warp_reflect.shade import LightView, dome_radiance
from warp_reflect.shapes import facet_normal, unit
from warp_reflect.techniques import local_shading
from warp_reflect.techniques.local_maps import ROW_MULTIPLE, LocalMaps, LocalPlace, texel_towards
from warp_reflect.techniques.local_mesh import DepthMesh, Intersect
from warp_reflect.techniques.local_shading import TEXEL_BLENDED, TEXEL_MISSING, TEXEL_SKY

wp.set_module_options({"enable_backward": False})

REMS_MAX = 8  # maps that a local map may look at
TEXEL_BLOCK = wp.constant(vector.BLOCK)
RemWeights = wp.types.vector(length=REMS_MAX, dtype=wp.float32)

# The depth test's slack: texels' footprint on the surface, and rounding (algorithms: 0.3 to 2 % of the visible fail it).
SLOPE_TEXELS = wp.constant(0.75)
SLOPE_MAX = wp.constant(8.0)  # tangent of the angle at which the footprint stops to grow
DEPTH_SLACK = wp.constant(0.002)  # of the distance
COINCIDENT = wp.constant(1.0e-12)  # squared distance of two REMs, of the point's, at which they have no axis
AT_CENTRE = wp.constant(
    1.0e-12
)  # squared distance of a point from a REM, of the local map's, at which it has no direction
LEAST_WEIGHT = wp.constant(1.0e-6)  # weights that add up to less are one map's alone: no division by what rounding left
PENALTY_FLOOR = wp.constant(1.0e-4)  # keeps a REM that sees a point from exactly there finite
SCALE_PENALTY = wp.constant(0.2)  # per doubled distance, against an angle in radians

PLANE_REACH = wp.constant(8.0)  # times the slack: farther along the ray a plane within the slack is grazed, and not met
WHOLE = wp.constant(0.999)  # coverage of a look-up from which on the sky behind it is not asked


@wp.func
def axis_share(p: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    """Where a point lies along the axis from a to b, 0 to 1; 1/2 where they coincide."""
    axis = b - a
    square = wp.dot(axis, axis)
    to_point = p - a
    if square <= COINCIDENT * wp.dot(to_point, to_point):
        return 0.5
    return wp.clamp(wp.dot(to_point, axis) / square, 0.0, 1.0)


@wp.func
def sees_point(maps: CubeMapsView, k: int, p: wp.vec3, normal: wp.vec3, slack: float) -> bool:
    """Whether map k sees a point of a surface: it stands on its side, and nothing is nearer in its direction.

    Args:
        maps: The maps.
        k: Which.
        p: Scene frame.
        normal: Of the surface on the side that is asked for, unit; zero: unknown.
        slack: Length by which p itself may be off its surface.
    """
    ray = p - maps.centre[k]
    if wp.dot(normal, ray) > 0.0:
        return False
    distance = wp.length(ray)
    found = texel_distance(maps, k, nearest_texel(maps, k, ray))
    if found == 0.0:
        return True
    tangent = SLOPE_MAX
    cosine = wp.abs(wp.dot(normal, ray)) / distance
    if cosine > 0.0:
        tangent = wp.min(wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0)) / cosine, SLOPE_MAX)
    footprint = 2.0 * distance / float(maps.resolution)
    return distance <= found + SLOPE_TEXELS * footprint * tangent + DEPTH_SLACK * distance + slack


@wp.func
def blur(maps: CubeMapsView, k: int, p: wp.vec3, normal: wp.vec3, eye: wp.vec3, resolution: int) -> float:
    """How many texels of the local map at `eye` a texel of map k covers at a point of a surface, along the worse direction.

    A map that looks along a surface from afar holds little of what lies before the eye. Without a normal: by distance alone.
    """
    to_map = maps.centre[k] - p
    to_eye = eye - p
    far = wp.length(to_map)
    near = wp.max(wp.length(to_eye), 1.0e-30)
    ratio = far / near * float(resolution) / float(maps.resolution)
    along_map = wp.abs(wp.dot(normal, to_map)) / wp.max(far, 1.0e-30)
    along_eye = wp.abs(wp.dot(normal, to_eye)) / near
    if along_map > 0.0:
        ratio = ratio * wp.max(1.0, along_eye / along_map)
    return ratio


@wp.func
def penalty(p: wp.vec3, eye: wp.vec3, centre: wp.vec3) -> float:
    """How badly a REM at `centre` stands in for `eye` at a point: angle between them, and how much farther it is."""
    a = eye - p
    b = centre - p
    near = wp.max(wp.length(a), 1.0e-30)
    angle = wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))
    return angle + SCALE_PENALTY * wp.max(0.0, wp.length(b) / near - 1.0) + PENALTY_FLOOR


@wp.func
def normalised(weights: RemWeights, count: int, valid: RemWeights, prior: RemWeights) -> RemWeights:
    """Weights of the valid maps that add up to 1; without any, all to the one that weighed most before.

    Args:
        weights: 0 where a map is not used.
        count: Maps in use.
        valid: 1 where a map sees the point.
        prior: Weights before validity was asked.
    """
    total = float(0.0)
    best = int(-1)
    most = float(-1.0)
    best_prior = int(0)
    most_prior = float(-1.0)
    k = int(0)
    while k < count:
        total += weights[k]
        if valid[k] > 0.0 and prior[k] > most:
            most = prior[k]
            best = k
        if prior[k] > most_prior:
            most_prior = prior[k]
            best_prior = k
        k += 1
    if total > LEAST_WEIGHT:
        return weights / total
    result = RemWeights()
    result[wp.where(best >= 0, best, best_prior)] = 1.0
    return result


@wp.func
def rem_weights(
    maps: CubeMapsView, rems: wp.array(dtype=int), used: int, eye: wp.vec3, p: wp.vec3, valid: RemWeights
) -> RemWeights:
    """Weights of the candidate maps at a point; they add up to 1.

    Args:
        maps: The reference maps.
        rems: Numbers of the candidates, the nearest to the eye first.
        used: How many are blended; with two the position along their axis decides, with more `penalty`.
        eye: Centre of the local map.
        p: The point, scene frame.
        valid: 1 for each candidate that sees it.
    """
    count = rems.shape[0]
    prior = RemWeights()
    weights = RemWeights()
    blended = count
    if used == 1 or count == 1:
        blended = 1
        prior[0] = 1.0
        weights[0] = valid[0]
    elif used == 2 or count == 2:
        blended = 2
        share = axis_share(p, maps.centre[rems[0]], maps.centre[rems[1]])
        prior[0] = 1.0 - share
        prior[1] = share
        weights[0] = prior[0] * valid[0]
        weights[1] = prior[1] * valid[1]
    else:
        pen = RemWeights()
        worst = float(0.0)
        k = int(0)
        while k < count:
            pen[k] = penalty(p, eye, maps.centre[rems[k]])
            prior[k] = 1.0 / pen[k]
            worst = wp.max(worst, pen[k])
            k += 1
        # A weight is 0 from the (used + 1)-th smallest penalty on, of the maps that see the point.
        bound = float(2.0) * worst
        k = int(0)
        while k < count:
            smaller = int(0)
            j = int(0)
            while j < count:
                if valid[j] > 0.0 and (pen[j] < pen[k] or (pen[j] == pen[k] and j < k)):
                    smaller += 1
                j += 1
            if valid[k] > 0.0 and smaller == used:
                bound = pen[k]
            k += 1
        k = int(0)
        while k < count:
            if valid[k] > 0.0 and pen[k] < bound:
                weights[k] = (1.0 - pen[k] / bound) / pen[k]
            k += 1
    return normalised(weights, blended, valid, prior)


@wp.func
def blend_texel(
    scene: SceneView,
    lights: LightView,
    maps: CubeMapsView,
    rems: wp.array(dtype=int),
    used: int,
    place: LocalPlace,
    blur_max: float,
    shaded: int,
    i: int,
    inverse: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    out_radiance: wp.array(dtype=wp.vec4),
    out_distance: wp.array(dtype=float),
    out_state: wp.array(dtype=wp.uint8),
):
    """Colour, distance and state of a texel of the map at `place`; arguments as for `blend_kernel`."""
    n = place.resolution
    eye = place.eye
    slack = place.slack
    if i - place.first_texel >= 6 * n * n:
        return
    if inverse[i] <= 0.0:
        out_radiance[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        out_distance[i] = 0.0
        out_state[i] = wp.uint8(TEXEL_SKY)
        return
    towards = texel_towards(place, i - place.first_texel)
    depth = 1.0 / inverse[i]
    off = slack
    normal = wp.vec3(0.0, 0.0, 0.0)
    if triangle[i] >= 0:
        corner = scene.triangles[triangle[i]]
        normal = facet_normal(scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]])
        height = wp.dot(normal, scene.points[corner[0]] - eye)
        across = wp.dot(normal, towards)
        if slack > 0.0 and wp.abs(across * depth - height) <= slack and height * across > 0.0:
            met = height / across
            if wp.abs(met - depth) <= PLANE_REACH * slack:
                depth = met
                off = 0.0
        if across > 0.0:
            normal = -normal
    local = depth * towards
    p = eye + local
    distance = wp.length(towards) * depth
    out_distance[i] = wp.max(distance, 1.0e-30)
    count = rems.shape[0]
    asked = wp.where(used <= 2, wp.min(used, count), count)
    valid = RemWeights()
    any_valid = int(0)
    k = int(0)
    while k < asked:
        ray = p - maps.centre[rems[k]]
        if blur_max == 0.0 or blur(maps, rems[k], p, normal, eye, n) <= blur_max:
            if wp.dot(ray, ray) > AT_CENTRE * distance * distance and sees_point(maps, rems[k], p, normal, off):
                valid[k] = 1.0
                any_valid = int(1)
        k += 1
    out_state[i] = wp.uint8(wp.where(any_valid == 1, TEXEL_BLENDED, TEXEL_MISSING))
    if any_valid == 0 and shaded == 1 and triangle[i] >= 0:
        return
    weights = rem_weights(maps, rems, used, eye, p, valid)
    total = wp.vec3(0.0, 0.0, 0.0)
    k = int(0)
    while k < asked:
        if weights[k] > 0.0:
            ray = p - maps.centre[rems[k]]
            if wp.dot(ray, ray) <= 0.0:
                ray = local
            value = fetch_covered(maps, rems[k], ray, 0.0)
            seen = wp.vec3(value[0], value[1], value[2])
            if value[3] < WHOLE:
                seen += (1.0 - value[3]) * dome_radiance(lights, unit(ray))
            total += weights[k] * seen
        k += 1
    out_radiance[i] = wp.vec4(total[0], total[1], total[2], 1.0)


@wp.kernel
def blend_kernel(
    first: int,
    scene: SceneView,
    lights: LightView,
    maps: CubeMapsView,
    rems: wp.array2d(dtype=int),
    used: int,
    places: wp.array(dtype=LocalPlace),
    block_map: wp.array(dtype=int),
    blur_max: float,
    shaded: int,
    index: wp.array(dtype=int),
    inverse: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    # Outputs:
    out_radiance: wp.array(dtype=wp.vec4),
    out_distance: wp.array(dtype=float),
    out_state: wp.array(dtype=wp.uint8),
):
    """One thread per texel; where `index` has a length, of those. `shaded`: what no map sees is shaded afterwards.

    Row k of `rems` has the reference maps that map k looks at.
    """
    i = first + wp.tid()
    if index.shape[0] > 0:
        i = index[i]
    k = block_map[i / TEXEL_BLOCK]
    blend_texel(
        scene,
        lights,
        maps,
        rems[k],
        used,
        places[k],
        blur_max,
        shaded,
        i,
        inverse,
        triangle,
        out_radiance,
        out_distance,
        out_state,
    )


def vector_fits(resolution: int, used: int, rem_count: int) -> bool:
    """Whether blocks of texels are blended at once: rows of whole vectors, and one or two maps."""
    return resolution % ROW_MULTIPLE == 0 and min(used, rem_count) <= 2


def blend(
    scene: Scene,
    local: LocalMaps,
    maps: CubeMaps,
    rems: np.ndarray,
    settings: Settings,
    texels: np.ndarray | None = None,
) -> None:
    """Colour the texels of local maps from reference maps.

    Args:
        scene: Of the maps.
        local: Its depths; gets all else.
        maps: The reference maps.
        rems: Numbers of those that each looks at, the nearest first, int [local maps, at most `REMS_MAX`].
        settings: `rem_count`, `rem_missing`, `rem_blur_px`, `threads`, `kernels`.
        texels: Only these.
    """
    device, threads, where = scene.device, settings.threads, local.layout
    chosen = wp.array(np.ascontiguousarray(rems, np.int32), dtype=int, device=device)
    ask = [scene.lights, maps.view, chosen, settings.rem_count, local.places, where.block_map]
    ask += [settings.rem_blur_px, int(settings.rem_missing == "shade")]
    outputs = [local.inverse, local.triangle, local.radiance, local.distance, local.state]
    fits = any(vector_fits(n, settings.rem_count, chosen.shape[1]) for n in where.resolutions)
    if texels is None and fits and vector.chosen(settings.kernels, device):
        from warp_reflect.techniques.local_map_vector import blend_blocks_kernel  # which uses this module's functions

        inputs = [scene.view, scene.triangle_records, *ask, *outputs]
        vector.launch_blocks(blend_blocks_kernel, where.texel_count, inputs, device, threads)
        return
    index = wp.array(np.zeros(0, np.int32) if texels is None else texels, dtype=int, device=device)
    count = where.texel_count if texels is None else len(texels)
    launch.launch(blend_kernel, count, [scene.view, *ask, index, *outputs], device, threads)


def blend_again(
    scene: Scene,
    local: LocalMaps,
    meshes: Mapping[int, tuple[DepthMesh, Intersect]],
    maps: CubeMaps,
    rems: np.ndarray,
    settings: Settings,
) -> None:
    """Give texels between the nodes of meshes whose points no map sees rays of their own: mostly a mesh has missed something.

    Args:
        meshes: By number of a local map; those of texels that get rays are changed.
        scene, local, maps, rems, settings: As for `blend`. Statistics `local_retraced`: texels that got a ray.
    """
    state = local.state.numpy() if meshes else None
    again = []
    for k, (mesh, intersect) in meshes.items():
        own = local.layout.texels(k)
        texels = np.flatnonzero((state[own] == TEXEL_MISSING) & ~mesh.traced.reshape(-1)).astype(np.int32)
        local.statistics[k]["local_retraced"] = len(texels)
        if len(texels):
            mesh.trace(texels, intersect)
            put_mesh(local, k, mesh)
            again.append(own.start + texels)
    if again:
        blend(scene, local, maps, rems, settings, np.concatenate(again).astype(np.int32))


def put_mesh(local: LocalMaps, k: int, mesh: DepthMesh) -> None:
    """Give local map k the depths of a mesh."""
    first, device = int(local.layout.first_texel[k]), local.scene.device
    for own, values, kind in ((local.inverse, mesh.inverse, float), (local.triangle, mesh.triangle, int)):
        wp.copy(own, wp.array(values.reshape(-1), dtype=kind, device=device), dest_offset=first, count=values.size)


def blend_local_map(
    scene: Scene,
    centre: np.ndarray,
    mesh: DepthMesh,
    intersect: Intersect,
    maps: CubeMaps,
    rems: np.ndarray,
    settings: Settings,
    slack: float = 0.0,
) -> tuple[CubeMaps, wp.array, dict[str, int]]:
    """One local map from the depths of a mesh.

    Args:
        scene: Of the maps.
        centre: Of the local map, world, float64 [3].
        mesh: Its depths; those of texels that get rays are changed.
        intersect: Follows rays from the centre.
        maps: The reference maps.
        rems: Numbers of those to be looked at, the nearest first, at most `REMS_MAX`.
        settings: `rem_count`, `rem_missing`, `shadows`, `threads`.
        slack: Length by which the depths may be off the surfaces (cells of a height field).

    Returns:
        (One map; the state of its texels, uint8 [6 n n], a `TEXEL_...`; statistics `local_retraced`, and those of
        `local_shading.shade`).
    """
    local, rems = LocalMaps.empty(scene, centre, mesh.inverse.shape[1:2], slack), np.asarray(rems)[None]
    put_mesh(local, 0, mesh)
    blend(scene, local, maps, rems, settings)
    blend_again(scene, local, {0: (mesh, intersect)}, maps, rems, settings)
    local_shading.shade(scene, local, settings)
    return *local.cube_map(0), local.statistics[0]
