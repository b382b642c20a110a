"""The surface that the eye sees at a pixel, and the compact list of a reflector's pixels.

There is one mirror surface, the same for every technique: the facet's position and its interpolated shading
normal, or for a gprim the analytic surface behind the facet, met by the eye ray itself ("polished").
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import warp as wp

from warp_reflect import compact, launch, vector
from warp_reflect.layers import (
    NO_REFLECTOR,
    Box,
    CameraView,
    GBuffer,
    MirrorPixels,
    eye_ray_direction,
    eye_ray_origin,
    pixel_bounds,
)
from warp_reflect.scene import SHAPE_PLANE, SHAPE_QUADRIC, Scene, SceneView
from warp_reflect.shapes import clamp_weights, facet_normal, intersect_triangle, max_abs, unit

wp.set_module_options({"enable_backward": False})
PLAIN = launch.module_part(__name__, "plain")  # what vector kernels do elsewhere
CHANNELS = launch.module_part(__name__, "channels")
SORTED = launch.module_part(__name__, "sorted")
UNREAD = launch.module_part(__name__, "unread")

Run = tuple[int, int, Box]  # of an id's pixels: the first, the end, their bounds

# An interpolated normal shorter than this has lost its direction (corners apart); the facet's is used.
LEAST_NORMAL = wp.constant(0.1)
# Share of the surface's slope along the ray that the facet point must show for its sign to be trusted.
SURE_SLOPE = wp.constant(0.5)


@wp.struct
class Surface:
    """What is seen at a pixel. Vectors have world axes; the eye frame has its origin at the eye."""

    p_eye: wp.vec3
    p_scene: wp.vec3
    incident: wp.vec3  # unit, from the eye to the point
    normal: wp.vec3  # unit shading normal, on the eye's side


@wp.func
def shading_normal(scene: SceneView, triangle: int, u: float, v: float, facet: wp.vec3) -> wp.vec3:
    """Unit normal interpolated between the corners, the facet's if they have none; not turned to the eye."""
    index = scene.normal_index[triangle]
    if index[0] < 0:
        return facet
    n = (1.0 - u - v) * scene.normals[index[0]] + u * scene.normals[index[1]] + v * scene.normals[index[2]]
    if wp.dot(n, n) < LEAST_NORMAL * LEAST_NORMAL:
        return facet
    return unit(n)


@wp.func
def hit_normal(scene: SceneView, triangle: int, u: float, v: float) -> wp.vec3:
    """Unit normal to shade with: interpolated, or of the analytic surface, or the facet's; not turned."""
    if scene.normal_index[triangle][0] >= 0:
        # The last argument counts where the corners' normals cancel.
        return shading_normal(scene, triangle, u, v, wp.vec3(0.0, 0.0, 1.0))
    tri = scene.triangles[triangle]
    v0 = scene.points[tri[0]]
    v1 = scene.points[tri[1]]
    v2 = scene.points[tri[2]]
    patch = scene.triangle_patch[triangle]
    if scene.patches[patch].shape != SHAPE_QUADRIC:
        return facet_normal(v0, v1, v2)
    m = scene.patches[patch].unit_from_scene
    q = wp.transform_point(m, (1.0 - u - v) * v0 + u * v1 + v * v2)
    abc = scene.patches[patch].quadric
    gradient = wp.vec3(q[0], q[1], abc[0] * q[2] + 0.5 * abc[1])
    return unit(wp.transform_vector(wp.transpose(m), gradient))


@wp.func
def shown_normal(normals: wp.array(dtype=wp.vec3), i: int, own: wp.vec3) -> wp.vec3:
    """The normal to shade point i with: of its normal map, or the surface's own where it has none.

    Args:
        normals: From `normal_maps.prepare_normals`; length 0: no normal maps.
        i: The point.
        own: The surface's.
    """
    if normals.shape[0] > 0:
        mapped = normals[i]
        if wp.dot(mapped, mapped) > 0.0:
            return mapped
    return own


@wp.func
def turned_reflection(direction: wp.vec3, n: wp.vec3, turned_normal: wp.vec3) -> wp.vec3:
    """Where another normal than n reflects what n reflects along `direction`; never into the surface."""
    incident = direction - 2.0 * wp.dot(direction, n) * n
    turned = incident - 2.0 * wp.dot(incident, turned_normal) * turned_normal
    into = wp.min(wp.dot(turned, n), 0.0)
    return unit(turned - 2.0 * into * n)


@wp.func
def polish(scene: SceneView, triangle: int, p: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Move a point near a facet along its ray onto the analytic surface behind the facet.

    The quadric is solved from that point, not from the eye: the constant term is then small and exact, and so
    is the root. Of the two roots the one is meant whose surface is crossed in the same sense as the facet;
    near the silhouette the other may be nearer.

    Args:
        scene: Holds the shape of the triangle's patch.
        triangle: The facet.
        p: On the ray near the facet, scene frame.
        direction: Of the ray, unit length.

    Returns:
        Unit normal and distance moved; a zero normal if the ray has no such root near the facet.
    """
    patch = scene.triangle_patch[triangle]
    m = scene.patches[patch].unit_from_scene
    q = wp.transform_point(m, p)
    d = wp.transform_vector(m, direction)
    if scene.patches[patch].shape == SHAPE_PLANE:
        if d[2] == 0.0:
            return wp.vec4(0.0, 0.0, 0.0, 0.0)
        n = unit(wp.vec3(m[2, 0], m[2, 1], m[2, 2]))
        return wp.vec4(n[0], n[1], n[2], -q[2] / d[2])
    abc = scene.patches[patch].quadric
    a = abc[0]
    # f(q + s d) = qa s^2 + 2 qb s + qc; half the derivative is qb + qa s = -+ root.
    z = a * q[2] + 0.5 * abc[1]
    qa = d[0] * d[0] + d[1] * d[1] + a * d[2] * d[2]
    qb = q[0] * d[0] + q[1] * d[1] + z * d[2]
    qc = q[0] * q[0] + q[1] * q[1] + (z + 0.5 * abc[1]) * q[2] - abc[2]
    disc = qb * qb - qa * qc
    if disc < 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    root = wp.sqrt(disc)
    # Half derivative = +root has s = (root - qb) / qa = -qc / (qb + root), exact where the signs agree.
    s = -qc / (qb + wp.sign(qb) * root)
    if wp.abs(qb) <= SURE_SLOPE * root or qb == 0.0:
        corner = scene.triangles[triangle]
        v0 = scene.points[corner[0]]
        v1 = scene.points[corner[1]]
        v2 = scene.points[corner[2]]
        facet = facet_normal(v0, v1, v2)
        # Sense of the crossing: of the facet, times whether the gradient agrees with the winding.
        agree = wp.dot(wp.transform_vector(m, facet), wp.vec3(q[0], q[1], z))
        if wp.dot(facet, direction) * agree < 0.0:
            root = -root
        if qb * root > 0.0:
            s = -qc / (qb + root)
        elif qa != 0.0:
            s = (root - qb) / qa
        else:
            return wp.vec4(0.0, 0.0, 0.0, 0.0)
        if not (wp.abs(s) <= wp.max(wp.max(max_abs(v1 - v0), max_abs(v2 - v1)), max_abs(v0 - v2))):
            return wp.vec4(0.0, 0.0, 0.0, 0.0)
    gx = q[0] + s * d[0]
    gy = q[1] + s * d[1]
    gz = z + s * a * d[2]
    n = unit(
        gx * wp.vec3(m[0, 0], m[0, 1], m[0, 2])
        + gy * wp.vec3(m[1, 0], m[1, 1], m[1, 2])
        + gz * wp.vec3(m[2, 0], m[2, 1], m[2, 2])
    )
    return wp.vec4(n[0], n[1], n[2], s)


@wp.func
def surface_at(
    scene: SceneView, camera: wp.array(dtype=CameraView), triangle: int, depth_key: float, x: float, y: float
) -> Surface:
    """The surface that the eye sees at pixel coordinate (x, y) on a triangle of the G-buffer.

    A polished point is the pixel ray's own; the facet, or in perspective the depth key alone, tells where to
    look. On other facets the weights come from the eye frame, where a far scene loses nothing. The raster
    snaps to 1/256 pixel, so a ray may pass just outside its facet: the weights are clamped and the incident
    direction is the one to the point.
    """
    result = Surface()
    direction = eye_ray_direction(camera[0], x, y)
    incident = unit(direction)
    shape = scene.patches[scene.triangle_patch[triangle]].shape
    if shape == SHAPE_QUADRIC and camera[0].orthographic == 0:
        p = direction / depth_key
        start = camera[0].eye + p
        polished = polish(scene, triangle, start, incident)
        n = wp.vec3(polished[0], polished[1], polished[2])
        if n[0] != 0.0 or n[1] != 0.0 or n[2] != 0.0:
            result.p_eye = p + polished[3] * incident
            # From the very point that was polished: a distant eye's rounding must not enter again.
            result.p_scene = start + polished[3] * incident
            result.incident = incident
            if wp.dot(n, incident) > 0.0:
                n = -n
            result.normal = n
            return result

    tri = scene.triangles[triangle]
    v0 = scene.points[tri[0]]
    v1 = scene.points[tri[1]]
    v2 = scene.points[tri[2]]
    a = v0 - camera[0].eye
    b = v1 - camera[0].eye
    c = v2 - camera[0].eye
    hit = intersect_triangle(eye_ray_origin(camera[0], x, y), direction, a, b, c)
    weights = clamp_weights(hit.u, hit.v)
    if hit.det == 0.0:
        weights = wp.vec2(1.0 / 3.0, 1.0 / 3.0)
    u = weights[0]
    v = weights[1]
    w = 1.0 - u - v
    result.p_scene = w * v0 + u * v1 + v * v2
    result.p_eye = w * a + u * b + v * c
    if camera[0].orthographic == 0:
        incident = unit(result.p_eye)
    n = shading_normal(scene, triangle, u, v, facet_normal(a, b, c))
    if shape == SHAPE_PLANE or (shape == SHAPE_QUADRIC and camera[0].orthographic != 0):
        polished = polish(scene, triangle, result.p_scene, incident)
        if polished[0] != 0.0 or polished[1] != 0.0 or polished[2] != 0.0:
            n = wp.vec3(polished[0], polished[1], polished[2])
            result.p_scene += polished[3] * incident
            result.p_eye += polished[3] * incident
    if wp.dot(n, incident) > 0.0:
        n = -n
    if n[0] == 0.0 and n[1] == 0.0 and n[2] == 0.0:
        n = -incident
    result.incident = incident
    result.normal = n
    return result


@wp.kernel
def reflector_id_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patch_reflector: wp.array(dtype=int),
    out_reflector: wp.array(dtype=int),
):
    """One thread per pixel."""
    i = first + wp.tid()
    tri = triangle[i]
    reflector = int(0)
    if tri >= 0:
        reflector = patch_reflector[triangle_patch[tri]]
    out_reflector[i] = reflector


@wp.func
def mirror_pixel(
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    p: int,
    i: int,
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
):
    """The surface at pixel p of the picture and its reflected direction, into entry i."""
    row = p // camera[0].width
    x = float(p - row * camera[0].width) + 0.5
    s = surface_at(scene, camera, triangle[p], depth_key[p], x, float(row) + 0.5)
    out_point[i] = s.p_scene
    out_normal[i] = s.normal
    d = s.incident - 2.0 * wp.dot(s.incident, s.normal) * s.normal
    # Distances count in its length, which is 1 up to rounding: one Newton step of 1 / sqrt restores it.
    out_direction[i] = (1.5 - 0.5 * wp.dot(d, d)) * d


@wp.kernel(module=PLAIN)
def mirror_pixels_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel; nothing where the number is -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        out_point[i] = wp.vec3(0.0, 0.0, 0.0)
        out_normal[i] = wp.vec3(0.0, 0.0, 0.0)
        out_direction[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    mirror_pixel(scene, camera, triangle, depth_key, pixel[i], i, out_point, out_normal, out_direction)


def mirror_pixels(
    scene: Scene, gbuffer: GBuffer, parts: Mapping[int, int], threads: int = 0, kernels: str = "auto"
) -> tuple[dict[int, MirrorPixels], wp.array]:
    """The pixels of every reflector with their points, normals and reflected directions.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        parts: Reflector id (1-based) to the index of its part in `scene.parts`.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Returns:
        (`MirrorPixels` per id, of length 0 where a reflector is not seen, or see there where nothing is read; reflector id
        per pixel, int32 [height * width], 0 none).
    """
    width, height = gbuffer.camera.size
    if not parts:
        return {}, wp.zeros(width * height, dtype=int, device=scene.device)
    if not launch.reads():
        ids = _ids(scene, gbuffer, parts, threads, "reflectors")
        return _unread_pixels(scene, gbuffer, ids, parts), ids
    pixel, runs, reflector_id = _pixels_of(scene, gbuffer, parts, threads, kernels, "reflectors")
    whole = _met(scene, gbuffer, pixel, threads, kernels)
    return {id: whole.part(id, *runs[id]) for id in parts}, reflector_id


def _pixels_of(
    scene: Scene, gbuffer: GBuffer, parts: Mapping[int, int], threads: int, kernels: str, who: str = "others"
) -> tuple[wp.array, dict[int, Run], wp.array]:
    """Which pixels show some parts.

    Returns:
        (these pixels, part after part, ascending in each; where among them those of each id are; id per pixel, 0 where there
        is none of the parts).
    """
    width = gbuffer.camera.size[0]
    if vector.chosen(kernels, scene.device) and not launch.stays(scene.device):
        from warp_reflect import surface_vector  # which reflects at this module's surface

        if max(parts) <= surface_vector.LISTED_IDS:
            inputs = [gbuffer.triangle, scene.view.triangle_patch, _id_of_patch(scene, parts, who)]
            ids, pixel, edges = surface_vector.pixels_by_id(*inputs, max(parts), threads)
            return pixel, _runs(pixel.numpy(), {id: (edges[id - 1], edges[id]) for id in parts}, width), ids
    ids = _ids(scene, gbuffer, parts, threads, who)
    if launch.stays(scene.device):
        return *_sorted_by_id(ids, parts, width), ids
    pixel, ends = _pixels_by_id(ids.numpy(), parts)
    return compact.listed(pixel, scene.device), _runs(pixel, ends, width), ids


def _ids(scene: Scene, gbuffer: GBuffer, parts: Mapping[int, int], threads: int, who: str) -> wp.array:
    """Id per pixel."""
    ids = wp.empty(len(gbuffer.triangle), dtype=int, device=scene.device)
    inputs = [gbuffer.triangle, scene.view.triangle_patch, _id_of_patch(scene, parts, who), ids]
    launch.launch(reflector_id_kernel, len(ids), inputs, scene.device, threads)
    return ids


def _runs(pixel: np.ndarray, ends: Mapping[int, tuple[int, int]], width: int) -> dict[int, Run]:
    return {id: (first, end, pixel_bounds(pixel[first:end], width)) for id, (first, end) in ends.items()}


def _id_of_patch(scene: Scene, parts: Mapping[int, int], who: str) -> wp.array:
    """int32 [patches], 0 of those of no such part; the last that were asked for by `who` are kept with the scene."""

    def make() -> wp.array:
        ids = np.zeros(max(len(scene.patch_shapes), 1), np.int32)
        for id, part in parts.items():
            ids[scene.parts[part].patches] = id
        return wp.array(ids, dtype=int, device=scene.device)

    return scene.kept(f"ids of {who}", dict(parts), make)


def _met(scene: Scene, gbuffer: GBuffer, pixel: wp.array, threads: int, kernels: str) -> MirrorPixels:
    """The surface at some pixels of the picture, whichever mirror they show."""
    n, device = len(pixel), scene.device
    vectors = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(3))
    mirror = MirrorPixels(NO_REFLECTOR, pixel, *vectors, (0, 0, *gbuffer.camera.size))
    if not n:
        return mirror
    seen = [gbuffer.view, gbuffer.triangle, gbuffer.depth_key, mirror.pixel]
    outputs = [mirror.point, mirror.normal, mirror.direction]
    if vector.chosen(kernels, device):
        from warp_reflect import surface_vector  # which reflects at this module's surface

        kernel, blocks = surface_vector.mirror_blocks_kernel, surface_vector.MIRROR_BLOCKS
        inputs = [blocks, scene.view, scene.triangle_records, *seen, *outputs]
        vector.launch_blocks(kernel, n, inputs, device, threads, blocks=blocks)
    else:
        launch.launch(mirror_pixels_kernel, n, [scene.view, *seen, *outputs], device, threads)
    return mirror


def part_pixels(
    scene: Scene,
    gbuffer: GBuffer,
    parts: Iterable[int],
    known: Mapping[int, MirrorPixels],
    threads: int = 0,
    kernels: str = "auto",
) -> dict[int, MirrorPixels]:
    """The pixels at which the eye sees each of some parts, mirrors or not, with the surface there.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        parts: Indices into `scene.parts`.
        known: Those of mirrors, by part, as `mirror_pixels` found them: they are taken as they are.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Returns:
        Part to its pixels, of the reflector `NO_REFLECTOR` where it is none; nothing of a part that is not seen.
    """
    found = {part: known[part] for part in parts if part in known}
    others = [part for part in parts if part not in known]
    if others:
        asked = dict(enumerate(others, 1))
        if not launch.reads():
            ids = _ids(scene, gbuffer, asked, threads, "others")
            own = _unread_pixels(scene, gbuffer, ids, asked)
            return found | {part: replace(own[id], reflector=NO_REFLECTOR) for id, part in asked.items()}
        pixel, runs, _ = _pixels_of(scene, gbuffer, asked, threads, kernels)
        whole = _met(scene, gbuffer, pixel, threads, kernels)
        found |= {part: whole.part(NO_REFLECTOR, *runs[id]) for id, part in asked.items()}
    return {part: pixels for part, pixels in found.items() if pixels.count}


def seen_parts(scene: Scene, gbuffer: GBuffer, parts: Iterable[int], threads: int, kernels: str) -> dict[int, int]:
    """Number of the pixels at which the eye sees each of some parts."""
    asked = dict(enumerate(parts, 1))
    _, runs, _ = _pixels_of(scene, gbuffer, asked, threads, kernels)
    return {part: end - first for part, (first, end, _) in ((part, runs[id]) for id, part in asked.items())}


def _pixels_by_id(ids: np.ndarray, wanted: Collection[int]) -> tuple[np.ndarray, dict[int, tuple[int, int]]]:
    """Ascending int32 pixel numbers of the least id, then those of the next; where those of each begin and end."""
    # The comparison makes it twice as fast as on the numbers themselves.
    pixel = np.flatnonzero(ids != 0).astype(np.int32)
    if len(wanted) == 1:
        return pixel, dict.fromkeys(wanted, (0, len(pixel)))
    ids = ids[pixel]
    found = {id: pixel[ids == id] for id in sorted(wanted)}
    edges = pairwise(np.cumsum([0, *map(len, found.values())]).tolist())
    return np.concatenate(list(found.values())), dict(zip(found, edges, strict=True))


FARTHEST = wp.constant(2**30)  # more than a picture has rows or columns
RUN = wp.constant(6)  # numbers of an id's run: first, end; first and last row; columns left of the right end, its end


@wp.kernel(module=SORTED)
def numbered_kernel(first: int, ids: wp.array(dtype=int), out_id: wp.array(dtype=int), out_pixel: wp.array(dtype=int)):
    """One thread per pixel."""
    i = first + wp.tid()
    out_id[i] = ids[i]
    out_pixel[i] = i


@wp.kernel(module=SORTED)
def runs_kernel(
    first: int,
    count: int,
    id: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    width: int,
    out_run: wp.array(dtype=int),
):
    """One thread per pixel, sorted by id: where an id's run begins and ends, and how far its rows reach; all 0 before."""
    i = first + wp.tid()
    own = id[i]
    if own == 0:
        return
    row = pixel[i] // width
    column = pixel[i] - row * width
    before = int(0)
    after = int(0)
    if i > 0:
        before = id[i - 1]
    if i + 1 < count:
        after = id[i + 1]
    if before != own:
        out_run[own * RUN] = i
        out_run[own * RUN + 2] = row
    if after != own:
        out_run[own * RUN + 1] = i + 1
        out_run[own * RUN + 3] = row
    # Ends of rows alone: every pixel's would queue for one number.
    left = before != own
    if not left:
        left = pixel[i - 1] // width != row
    right = after != own
    if not right:
        right = pixel[i + 1] // width != row
    if left:
        wp.atomic_max(out_run, own * RUN + 4, width - column)
    if right:
        wp.atomic_max(out_run, own * RUN + 5, column + 1)


def _sorted(ids: wp.array, most: int, width: int) -> tuple[wp.array, wp.array, wp.array]:
    """(ids, ascending; their pixels, ascending in each; `RUN` numbers of each id up to the largest)."""
    count, device = len(ids), ids.device
    # The sort wants room for as many again; it keeps the order of what has the same id.
    id, pixel = (wp.empty(2 * count, dtype=int, device=device) for _ in range(2))
    launch.launch(numbered_kernel, count, [ids, id, pixel], device)
    wp.utils.radix_sort_pairs(id, pixel, count)
    runs = wp.zeros((most + 1) * RUN, dtype=int, device=device)
    launch.launch(runs_kernel, count, [count, id, pixel, width, runs], device)
    return id, pixel, runs


@wp.kernel(module=UNREAD)
def own_pixels_kernel(first: int, ids: wp.array(dtype=int), least: int, most: int, out_pixel: wp.array(dtype=int)):
    """One thread per pixel: it, or -1 where its id is another."""
    i = first + wp.tid()
    out_pixel[i] = wp.where(ids[i] >= least and ids[i] <= most, i, -1)


def _unread_pixels(scene: Scene, gbuffer: GBuffer, ids: wp.array, wanted: Collection[int]) -> dict[int, MirrorPixels]:
    """The pixels of every id where nothing is read: each alone, in as many entries as there are pixels."""

    def own(least: int, most: int) -> wp.array:
        numbers = wp.empty(len(ids), dtype=int, device=scene.device)
        launch.launch(own_pixels_kernel, len(ids), [ids, least, most, numbers], scene.device)
        return numbers

    whole = replace(_met(scene, gbuffer, own(1, max(wanted)), 1, "plain"), everywhere=True)
    return {k: replace(whole, reflector=k, pixel=whole.pixel if len(wanted) == 1 else own(k, k)) for k in wanted}


def told(pixels: MirrorPixels, width: int) -> tuple[wp.array, MirrorPixels]:
    """Which entries of pixels that were found where nothing was read have one, and these alone; read now."""
    numbers = np.flatnonzero(pixels.pixel.numpy() >= 0)
    where = compact.listed(numbers, pixels.pixel.device)
    arrays = (compact.taken(array, where) for array in (pixels.pixel, pixels.point, pixels.normal, pixels.direction))
    return where, MirrorPixels(pixels.reflector, *arrays, pixel_bounds(numbers, width))


@wp.kernel(module=UNREAD)
def bounds_kernel(first: int, pixel: wp.array(dtype=int), width: int, out_bounds: wp.array(dtype=int)):
    """One thread per pixel; those that have others on all sides tell nothing new."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    row = i // width
    column = i - row * width
    left = column == 0
    if not left:
        left = pixel[i - 1] < 0
    right = column == width - 1
    if not right:
        right = pixel[i + 1] < 0
    top = row == 0
    if not top:
        top = pixel[i - width] < 0
    bottom = i + width >= pixel.shape[0]
    if not bottom:
        bottom = pixel[i + width] < 0
    if left:
        wp.atomic_max(out_bounds, 0, FARTHEST - column)
    if top:
        wp.atomic_max(out_bounds, 1, FARTHEST - row)
    if right:
        wp.atomic_max(out_bounds, 2, column + 1)
    if bottom:
        wp.atomic_max(out_bounds, 3, row + 1)


def bounds_of(pixels: MirrorPixels, width: int) -> wp.array:
    """Bounds of pixels where nothing is read, for `bounds_box`."""
    device = pixels.pixel.device
    bounds = wp.zeros(4, dtype=int, device=device)
    launch.launch(bounds_kernel, len(pixels.pixel), [pixels.pixel, width, bounds], device)
    return bounds


@wp.func
def bounds_box(bounds: wp.array(dtype=int)) -> wp.vec4i:
    """The bounds as a `Box`; of no pixels its ends lie before its starts."""
    return wp.vec4i(FARTHEST - bounds[0], FARTHEST - bounds[1], bounds[2], bounds[3])


def _box(width: int, top: int, bottom: int, before: int, right: int) -> Box:
    """Bounds by the last numbers of a run."""
    return width - before, top, right, bottom + 1


def _sorted_by_id(ids: wp.array, wanted: Collection[int], width: int) -> tuple[wp.array, dict[int, Run]]:
    """The pixels of every id, as `_pixels_by_id` finds them, with nothing read but `RUN` numbers an id."""
    _, pixel, runs = _sorted(ids, max(wanted), width)
    read = runs.numpy().reshape(-1, RUN).tolist()
    # Those of no id lie before the others.
    begin = min((start for start, end, *_ in read if end > start), default=0)
    last = max(end for _, end, *_ in read)
    found = {}
    for k, (start, end, *edges) in enumerate(read):
        if k in wanted and end > start:
            found[k] = start - begin, end - begin, _box(width, *edges)
        elif k in wanted:
            found[k] = 0, 0, (0, 0, 0, 0)
    return compact.run(pixel, begin, last), found


@wp.kernel(module=CHANNELS)
def surface_channels_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    out_depth: wp.array(dtype=float),
    out_normal: wp.array(dtype=wp.vec3),
    out_prim: wp.array(dtype=int),
):
    """One thread per pixel."""
    row, _ = wp.tid()
    i = first + row
    tri = triangle[i]
    if tri < 0:
        out_depth[i] = 0.0
        out_normal[i] = wp.vec3(0.0, 0.0, 0.0)
        out_prim[i] = 0
        return
    row = i // camera[0].width
    s = surface_at(scene, camera, tri, depth_key[i], float(i - row * camera[0].width) + 0.5, float(row) + 0.5)
    out_depth[i] = wp.dot(camera[0].forward, s.p_eye)
    out_normal[i] = s.normal
    out_prim[i] = scene.patches[scene.triangle_patch[tri]].prim


def surface_channels(scene: Scene, gbuffer: GBuffer, threads: int = 0) -> dict[str, wp.array]:
    """The channels of what the eye sees directly.

    Returns:
        `Z` float32 [height * width], depth along the camera's forward axis in scene units, 0 background; `N`
        vec3, unit shading normal turned to the eye; `primId` int32, 1-based, 0 background.
    """
    count = gbuffer.camera.size[0] * gbuffer.camera.size[1]
    depth = wp.empty(count, dtype=float, device=scene.device)
    normal = wp.empty(count, dtype=wp.vec3, device=scene.device)
    prim = wp.empty(count, dtype=int, device=scene.device)
    launch.launch(
        surface_channels_kernel,
        count,
        [scene.view, gbuffer.view, gbuffer.triangle, gbuffer.depth_key, depth, normal, prim],
        scene.device,
        threads,
    )
    return {"Z": depth, "N": normal, "primId": prim}
