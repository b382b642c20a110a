"""Texels of local maps that are shaded where they lie: what no reference map sees, and what moves.

Squares of `local_shade_step` texels that show one triangle share what their middle one sees. Which texels are shaded is
counted and gathered row by row, of all maps that are made together, and shaded in one call where nothing in it asks for the
eye or for neighbours (pictures on surfaces, and soft shadows, do); else map by map: either way a map is what it is alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import warp as wp

from warp_reflect import launch, vector
from warp_reflect import shade as shading
from warp_reflect.cubemap import FACE_COUNT
from warp_reflect.environment_maps import Onward, face_camera, hits_layer
from warp_reflect.layers import GBuffer
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Settings
from warp_reflect.shadows import Shadows, asked_shadows
from warp_reflect.shapes import clamp_weights, intersect_triangle
from warp_reflect.techniques.local_maps import LocalMaps, LocalPlace, texel_towards

wp.set_module_options({"enable_backward": False})

# Of a texel after resampling.
TEXEL_SKY = 0
TEXEL_BLENDED = 1
TEXEL_MISSING = 2  # no REM sees its point
TEXEL_SHADED = 3  # nor did one, and it was shaded where it is
TEXEL_MOVING = 4  # a part that moves, which is to be shaded

# What is counted of a row.
SURFACES, UNSEEN, ASKED, MOVING, SHADED = (wp.constant(k) for k in range(5))
COUNTED = 5
ROW_SPLIT_MIN = 64  # rows
NOT_ASKED = wp.constant(-1)


@wp.func
def is_asked(state: wp.uint8, triangle: int, missing: int) -> bool:
    """Whether a texel is shaded; `missing` 1: also where no reference map sees it."""
    return int(state) == TEXEL_MOVING or (missing == 1 and int(state) == TEXEL_MISSING and triangle >= 0)


@wp.func
def shown_for(
    place: LocalPlace,
    row: int,
    column: int,
    step: int,
    missing: int,
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
) -> int:
    """The texel whose shading one shows that is asked for, at a row of the map: itself or the middle one of its square."""
    n = place.resolution
    face = row / n
    y = row - face * n
    own = place.first_texel + row * n + column
    if step == 1:
        return own
    middle_y = wp.min(y / step * step + step / 2, n - 1)
    middle_x = wp.min(column / step * step + step / 2, n - 1)
    middle = place.first_texel + (face * n + middle_y) * n + middle_x
    if triangle[middle] == triangle[own] and is_asked(state[middle], triangle[middle], missing):
        return middle
    return own


@wp.kernel
def count_asked_kernel(
    first: int,
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    step: int,
    missing: int,
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    out_counts: wp.array2d(dtype=int),
):
    """One thread per row of texels."""
    r = first + wp.tid()
    place = places[row_map[r]]
    row = r - place.first_row
    start = place.first_texel + row * place.resolution
    surfaces = int(0)
    unseen = int(0)
    asked = int(0)
    moving = int(0)
    shaded = int(0)
    column = int(0)
    while column < place.resolution:
        own = int(state[start + column])
        if own == TEXEL_BLENDED:
            surfaces += 1
        elif own != TEXEL_SKY:
            if own == TEXEL_MOVING:
                moving += 1
            else:
                surfaces += 1
            if own == TEXEL_MISSING:
                unseen += 1
            if is_asked(state[start + column], triangle[start + column], missing):
                asked += 1
                if shown_for(place, row, column, step, missing, triangle, state) == start + column:
                    shaded += 1
        column += 1
    out_counts[SURFACES, r] = surfaces
    out_counts[UNSEEN, r] = unseen
    out_counts[ASKED, r] = asked
    out_counts[MOVING, r] = moving
    out_counts[SHADED, r] = shaded


@wp.kernel
def shaded_hits_kernel(
    first: int,
    scene: SceneView,
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    step: int,
    missing: int,
    counts: wp.array2d(dtype=int),
    row_first: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    # Outputs:
    out_number: wp.array(dtype=int),
    out_pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    """One thread per row of texels: the hits of those that are shaded.

    `out_number`: of a texel that is shaded its hit, of one that shows another's -2 less that one's number, else `NOT_ASKED`.
    """
    r = first + wp.tid()
    if counts[ASKED, r] == 0:
        return
    place = places[row_map[r]]
    row = r - place.first_row
    hit_number = row_first[r]
    column = int(0)
    while column < place.resolution:
        t = place.first_texel + row * place.resolution + column
        number = NOT_ASKED
        if is_asked(state[t], triangle[t], missing):
            source = shown_for(place, row, column, step, missing, triangle, state)
            number = -2 - source
            if source == t:
                number = hit_number
                direction = wp.normalize(texel_towards(place, t - place.first_texel))
                corner = scene.triangles[triangle[t]]
                hit = intersect_triangle(
                    place.eye, direction, scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]]
                )
                weights = clamp_weights(hit.u, hit.v)
                if hit.det == 0.0:
                    weights = wp.vec2(1.0 / 3.0, 1.0 / 3.0)
                out_pixel[hit_number] = t - place.first_texel
                out_point[hit_number] = place.eye + distance[t] * direction
                out_direction[hit_number] = direction
                out_triangle[hit_number] = triangle[t]
                out_u[hit_number] = weights[0]
                out_v[hit_number] = weights[1]
                hit_number += 1
        out_number[t] = number
        column += 1


@wp.kernel
def put_radiance_kernel(
    first: int,
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    counts: wp.array2d(dtype=int),
    number: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    # Changed:
    out_radiance: wp.array(dtype=wp.vec4),
    out_state: wp.array(dtype=wp.uint8),
):
    """One thread per row of texels: what was shaded; a value that is not finite is black."""
    row = first + wp.tid()
    if counts[ASKED, row] == 0:
        return
    place = places[row_map[row]]
    start = place.first_texel + (row - place.first_row) * place.resolution
    column = int(0)
    while column < place.resolution:
        t = start + column
        k = number[t]
        if k != NOT_ASKED:
            if k < 0:
                k = number[-2 - k]
            r = radiance[k]
            if not (wp.isfinite(r[0]) and wp.isfinite(r[1]) and wp.isfinite(r[2])):
                r = wp.vec3(0.0, 0.0, 0.0)
            out_radiance[t] = wp.vec4(r[0], r[1], r[2], 1.0)
            out_state[t] = wp.uint8(TEXEL_SHADED)
        column += 1


def shade(
    scene: Scene, local: LocalMaps, settings: Settings, onward: Callable[[], Onward | None] | None = None
) -> None:
    """Shade the texels of maps that show what moves, and those that no reference map sees where `rem_missing` asks for that.

    Args:
        scene: Of the maps.
        local: Their states `TEXEL_MOVING` and `TEXEL_MISSING` become `TEXEL_SHADED`. Statistics, of what stands still and is
            not hidden by what moves: `rem_texels`: texels with a surface, `rem_missing`: those that no reference map sees,
            `rem_shaded`: those of them that were shaded where they lie; and `local_moving`: texels that show what moves.
        settings: `local_shade_step`, `rem_missing`, `shadows`, `threads`, `kernels`.
        onward: What mirrors among them show, asked where something moves; None: the domes.
    """
    device, where, threads = scene.device, local.layout, settings.threads
    rows, missing, step = len(where.row_map), int(settings.rem_missing == "shade"), settings.local_shade_step
    counts = wp.empty((COUNTED, rows), dtype=int, device=device)
    at = [local.places, where.row_map]
    ask = [*at, step, missing]
    count_kernel, hits_kernel, put_kernel = count_asked_kernel, shaded_hits_kernel, put_radiance_kernel
    by_rows = vector.chosen(settings.kernels, device)
    if by_rows:
        from warp_reflect.techniques import local_shading_vector as rows_of  # which uses this module's constants

        count_kernel, hits_kernel = rows_of.count_rows_kernel, rows_of.hits_of_rows_kernel
        put_kernel = rows_of.put_rows_kernel
    inputs = [*ask, local.triangle, local.state, counts]
    launch.launch(count_kernel, rows, inputs, device, threads, split_min=ROW_SPLIT_MIN)
    counted = counts.numpy()
    totals = np.add.reduceat(counted, where.first_row, axis=1)
    for k, (surfaces, unseen, asked, moving, _) in enumerate(totals.T.tolist()):
        known = {"rem_texels": surfaces, "rem_missing": unseen, "rem_shaded": asked - moving}
        local.statistics[k] |= known | ({"local_moving": moving} if moving else {})
    count = int(totals[int(SHADED)].sum())
    if count == 0:
        return
    ends = np.cumsum(counted[int(SHADED)], dtype=np.int32)
    row_first = wp.array(ends - counted[int(SHADED)], dtype=int, device=device)
    number = wp.empty(where.texel_count, dtype=int, device=device)
    pixel, triangle = (wp.empty(count, dtype=int, device=device) for _ in range(2))
    point, direction = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(2))
    u, v = (wp.empty(count, dtype=float, device=device) for _ in range(2))
    hits = [point, direction, triangle, u, v]
    inputs = [scene.triangle_records if by_rows else scene.view, *ask, counts, row_first]
    inputs += [local.distance, local.triangle, local.state, number, pixel, *hits]
    launch.launch(hits_kernel, rows, inputs, device, threads, split_min=ROW_SPLIT_MIN)
    shadows = asked_shadows(scene, settings)
    change = onward() if onward is not None and totals[int(MOVING)].any() else None
    if _asks_no_eye(scene, shadows):
        radiance = _radiance(scene, local, 0, hits, pixel, settings, shadows, change)
    else:
        radiance = wp.empty(count, dtype=wp.vec3, device=device)
        last = ends[np.append(where.first_row[1:], rows) - 1]
        begin = 0
        for k, end in enumerate(last.tolist()):
            if end > begin:
                own = [each[begin:end] for each in (*hits, pixel)]
                found = _radiance(scene, local, k, own[:-1], own[-1], settings, shadows, change)
                wp.copy(radiance, found, dest_offset=begin, count=end - begin)
            begin = end
    inputs = [*at, counts, number, radiance, local.radiance, local.state]
    launch.launch(put_kernel, rows, inputs, device, threads, split_min=ROW_SPLIT_MIN)


def _asks_no_eye(scene: Scene, shadows: Shadows | None) -> bool:
    """Whether shading asks neither from where something is seen nor what is beside it."""
    textures = scene.textures
    soft = shadows is not None and (any(shadows.areas) or shadows.domes)
    return textures.look_count == 0 and textures.normal_count == 0 and not soft


def _radiance(
    scene: Scene, local: LocalMaps, k: int, hits: list[wp.array], pixel: wp.array, settings: Settings, shadows, onward
) -> wp.array:
    """Radiance of hits as seen from map k, whose texels `pixel` are those of a picture of its faces one below the other."""
    n = local.layout.resolutions[k]
    camera = face_camera(scene, local.centres[k], np.eye(3), 0, n)  # of any face: it tells the size of a texel
    camera = dataclasses.replace(camera, size=(n, FACE_COUNT * n))
    point, direction, triangle, u, v = hits
    gbuffer = GBuffer(camera, camera.view(scene), triangle, u)
    layer = hits_layer(point, direction, triangle, u, v, pixel)
    radiance = shading.seen_radiance(scene, gbuffer, layer, settings.threads, shadows, settings.kernels)
    if onward is not None:
        onward(gbuffer, layer, radiance)
    return radiance
