"""The cut-outs of a scene's materials (`cutouts`): their table from pictures, and eyes that look through them."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import warp as wp

from warp_reflect import bvh, launch, ray_walk
from warp_reflect.cutouts import WRAPS, Cutouts, CutView, is_hole, make_cutouts, no_cutouts
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin
from warp_reflect.pictures import (
    TILE_COLUMNS,
    TILE_MARK,
    load_pyramids,
    note_of,
    picture_key,
    pictures_of,
    scale_bias,
    tile_of,
    used_tiles,
)
from warp_reflect.scene import Note, Scene, SceneView, TextureRef
from warp_reflect.settings import Status
from warp_reflect.shapes import clamp_weights, intersect_triangle, unit
from warp_reflect.textures import coordinates

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": launch.FINITE_FLAGS})

OPACITY = "opacity"
HOLES_MAX = wp.constant(256)  # behind one another that a ray goes through; more is as good as no end
STEP_LIMIT = wp.constant(int(Status.STEP_LIMIT))


def cut_materials(scene: Scene) -> list[int]:
    """Materials that cut holes by a picture, indices into `scene.data.materials`."""
    return [k for k, m in enumerate(scene.data.materials) if OPACITY in m.textures and m.opacity_threshold > 0.0]


def prepare_cutouts(scene: Scene, pyramids: dict) -> Cutouts:
    """The table of a scene's cut-outs.

    Args:
        scene: Laid out but for the table; gets notes of what cannot be cut, which is drawn whole.
        pyramids: By `picture_key`; pictures that are not in it are read and added.
    """
    data, views, texels, first_texel = scene.data, [], [], 0
    of_triangle = np.full(scene.triangle_count, -1, np.int32)
    uvs, uv_index = coordinates(data)
    place: dict[str, tuple[int, int, int]] = {}  # of a picture: first texel, height, width

    def tell(material: int, text: str) -> None:
        note = note_of(data.materials[material].path, OPACITY, text)
        if note not in scene.notes:
            scene.notes.append(note)

    for k in cut_materials(scene):
        whole = data.materials[k].textures[OPACITY]
        pictures = pictures_of(data, k, OPACITY)
        missing = [texture for texture in pictures if picture_key(texture) not in pyramids]
        pyramids.update(load_pyramids(data, missing, lambda texture, text, k=k: tell(k, f"{text}; not cut out")))
        own = np.concatenate([np.zeros(0, int), *(_range(part) for part in scene.parts if part.material == k)]).astype(
            int
        )
        mapped = own[uv_index[own, 0] >= 0]
        if len(mapped) < len(own):
            prims = sorted({part.prim_path for part in scene.parts if part.material == k})
            scene.notes.append(
                Note(
                    prims[0],
                    f"no texture coordinates {whole.uv_name} for the opacity of {data.materials[k].path}; not cut out",
                )
            )
        tiles = {None: (whole, 0, 0)}
        if TILE_MARK in whole.file:
            columns = int(TILE_COLUMNS)
            tiles = {n: (tile_of(whole, n), n % columns, n // columns) for n in used_tiles(data, k, whole)}
            numbers = _tiles(whole, uvs, uv_index[mapped])
        for number, (texture, column, row) in tiles.items():
            pyramid = pyramids.get(picture_key(texture))
            if pyramid is None:
                continue
            key = picture_key(texture)
            if key not in place:
                picture = pyramid.levels[0][..., 0]
                place[key] = first_texel, *picture.shape
                texels.append(picture)
                first_texel += picture.size
            chosen = mapped if number is None else mapped[numbers == number]
            of_triangle[chosen] = len(views)
            views.append(_view(texture, place[key], column, row, data.materials[k].opacity_threshold))
    if not views:
        return no_cutouts(scene.device)
    return make_cutouts(of_triangle, views, texels, uvs, uv_index, scene.device)


def _range(part) -> np.ndarray:
    return np.arange(part.first_triangle, part.first_triangle + part.triangle_count)


def _tiles(texture: TextureRef, uvs: np.ndarray, index: np.ndarray) -> np.ndarray:
    """The UDIM tile of triangles, counted from 0, by their middles."""
    rows = np.array(texture.uv_from_st)
    middle = uvs[index].astype(np.float64).mean(axis=1)
    column, row = np.floor(middle @ rows[:, :2].T + rows[:, 2]).astype(int).T
    return np.where((column >= 0) & (column < int(TILE_COLUMNS)), column + int(TILE_COLUMNS) * row, -1)


def _view(texture: TextureRef, place: tuple[int, int, int], column: int, row: int, threshold: float) -> CutView:
    scale, bias = scale_bias(texture)
    view = CutView()
    view.first_texel, view.height, view.width = place
    view.wrap_u, view.wrap_v = (WRAPS[mode] for mode in texture.wrap)
    view.scale, view.bias, view.threshold = float(scale[0]), float(bias[0]), threshold
    u_row, v_row = np.array(texture.uv_from_st, np.float64) - [[0.0, 0.0, column], [0.0, 0.0, row]]
    view.u_row, view.v_row = wp.vec3(*u_row), wp.vec3(*v_row)
    return view


@wp.func
def is_hole_hit(scene: SceneView, hit: ray_walk.RayHit) -> bool:
    return is_hole(scene.cuts, hit.triangle, hit.u, hit.v)


@wp.func
def beyond_hole(origin: wp.vec3, direction: wp.vec3, t: float) -> float:
    """Where a ray goes on that has met a hole at t."""
    return t + ray_walk.ray_offset(origin) + ray_walk.ray_offset(origin + t * direction)


@wp.kernel
def go_past_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    # Where the rays start:
    facet: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    body: ray_walk.OwnBody,
    bodies: wp.array(dtype=ray_walk.OwnBody),
    inside: wp.array(dtype=wp.uint8),
    # Changed:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per ray: where it met a hole, what it meets behind it."""
    i = first + wp.tid()
    if out_triangle[i] < 0:
        return
    hit = ray_walk.RayHit()
    hit.triangle = out_triangle[i]
    hit.u = out_u[i]
    hit.v = out_v[i]
    hit.t = out_distance[i]
    if not is_hole_hit(scene, hit):
        return
    start = int(i)
    if pixel.shape[0] > 0:
        start = pixel[i]
    own = body
    if bodies.shape[0] > 0:
        own = bodies[scene.triangle_patch[facet[start]]]
    t0 = float(0.0)
    holes = int(0)
    while hit.triangle >= 0 and is_hole_hit(scene, hit) and holes < HOLES_MAX:
        holes += 1
        t0 = beyond_hole(point[i], direction[i], wp.max(hit.t, t0))
        if inside.shape[0] > 0:
            hit = ray_walk.trace_onward(
                mesh_id, scene, point[i], direction[i], normal[i], facet[start], int(inside[i]), t0, ray_walk.Met()
            )
        else:
            hit = ray_walk.trace_ray(mesh_id, scene, point[i], direction[i], normal[i], facet[start], own, 1, t0)
    if holes == HOLES_MAX:
        hit = ray_walk.RayHit()
        hit.triangle = -1
        hit.status = STEP_LIMIT
    out_triangle[i] = hit.triangle
    out_u[i] = hit.u
    out_v[i] = hit.v
    out_distance[i] = hit.t
    out_status[i] = wp.uint8(hit.status)


def go_past(
    scene: Scene,
    layer: ReflectionLayer,
    tracer: bvh.Tracer,
    facet: wp.array,
    pixel: wp.array | None = None,
    body: ray_walk.OwnBody | None = None,
    bodies: wp.array | None = None,
    inside: wp.array | None = None,
    threads: int = 0,
) -> None:
    """Follow the rays of a layer that met holes to what is behind those.

    Args:
        scene: With cut-outs.
        layer: Rays and what they met as if there were no holes; changed in place.
        tracer: That found it.
        facet: int32, the triangle that each ray starts on.
        pixel: int32 [n], where in `facet` that of each ray is; None: in order.
        body: The mirror that all rays start on; None: see `bodies`.
        bodies: `OwnBody` of every patch; None: `body`, or none.
        inside: uint8 [n], see `bvh.trace_transmitted`; None: the rays are reflected.
        threads: CPU threads; 0: one per core.
    """
    device, pixels = scene.device, layer.pixels
    empty = {"pixel": int, "bodies": ray_walk.OwnBody, "inside": wp.uint8}
    given = {"pixel": pixel, "bodies": bodies, "inside": inside}
    arrays = {k: wp.zeros(0, dtype=empty[k], device=device) if given[k] is None else given[k] for k in empty}
    inputs = [wp.uint64(tracer.id), scene.view, facet, arrays["pixel"], pixels.point, pixels.normal, pixels.direction]
    inputs += [body or ray_walk.OwnBody(), arrays["bodies"], arrays["inside"]]
    outputs = [layer.triangle, layer.u, layer.v, layer.distance, layer.status]
    launch.launch(go_past_kernel, pixels.count, inputs + outputs, device, threads, split_min=bvh.TRACE_SPLIT_MIN)


@wp.kernel
def look_past_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    # Changed:
    out_triangle: wp.array(dtype=int),
    out_depth_key: wp.array(dtype=float),
):
    """One thread per pixel: where a hole was drawn, what the eye sees behind it."""
    i = first + wp.tid()
    tri = out_triangle[i]
    if tri < 0:
        return
    if scene.cuts.of_triangle[tri] < 0:
        return
    row = i // camera[0].width
    x = float(i - row * camera[0].width) + 0.5
    y = float(row) + 0.5
    origin = eye_ray_origin(camera[0], x, y)
    d = unit(eye_ray_direction(camera[0], x, y))
    corner = scene.triangles[tri]
    a = scene.points[corner[0]] - camera[0].eye
    b = scene.points[corner[1]] - camera[0].eye
    c = scene.points[corner[2]] - camera[0].eye
    exact = intersect_triangle(origin, d, a, b, c)
    weights = clamp_weights(exact.u, exact.v)
    if not is_hole(scene.cuts, tri, weights[0], weights[1]):
        return
    p = (1.0 - weights[0] - weights[1]) * a + weights[0] * b + weights[1] * c
    nothing = wp.vec3(0.0, 0.0, 0.0)
    start = camera[0].eye + p
    hit = ray_walk.RayHit()
    hit.triangle = tri
    hit.u = weights[0]
    hit.v = weights[1]
    t0 = float(0.0)
    holes = int(0)
    while hit.triangle >= 0 and is_hole_hit(scene, hit) and holes < HOLES_MAX:
        holes += 1
        t0 = beyond_hole(start, d, wp.max(hit.t, t0))
        hit = ray_walk.trace_ray(mesh_id, scene, start, d, nothing, tri, ray_walk.OwnBody(), 1, t0)
    depth = wp.dot(camera[0].forward, p + hit.t * d)
    if hit.triangle < 0 or depth > camera[0].far:
        out_triangle[i] = -1
        out_depth_key[i] = 0.0
        return
    out_triangle[i] = hit.triangle
    if camera[0].orthographic != 0:
        out_depth_key[i] = 1.0 - depth / camera[0].far
    else:
        out_depth_key[i] = 1.0 / depth


def look_past(scene: Scene, gbuffer: GBuffer, without: Collection[int] = (), threads: int = 0) -> None:
    """Put what the eye sees through holes into a picture that was drawn as if there were none.

    Args:
        scene: With cut-outs; its BVH is built if this is the first use.
        gbuffer: Changed in place.
        without: Parts that are left out, indices into `scene.parts`.
        threads: CPU threads; 0: one per core.
    """
    tracer = scene.tracer
    if without:
        seen = np.ones(scene.triangle_count, bool)
        for part in without:
            seen[_range(scene.parts[part])] = False
        tracer = bvh.Tracer(scene, seen=seen)
    inputs = [wp.uint64(tracer.id), scene.view, gbuffer.view, gbuffer.triangle, gbuffer.depth_key]
    count = len(gbuffer.triangle)
    launch.launch(look_past_kernel, count, inputs, scene.device, threads, split_min=bvh.TRACE_SPLIT_MIN)
