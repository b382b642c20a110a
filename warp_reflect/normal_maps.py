"""Normal maps: the normals that they give to what a frame shows; to reflectors where they are asked to (`finishes/bumps.py`).

A map's directions are in the tangent space of its picture: x along its u, y along its v, z along the surface's normal.
The tangents come from the corners' points and texture coordinates, triangle by triangle; no tangent primvar is needed.
Kernels of their own, so that a scene without normal maps pays nothing.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import warp as wp

from warp_reflect import compact, launch
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin
from warp_reflect.scene import Scene, SceneView
from warp_reflect.shapes import clamp_weights, intersect_triangle, max_abs, unit
from warp_reflect.surface import hit_normal
from warp_reflect.textures import LEAST_DIRECTION, LEAST_LENGTH, TextureSet, footprint, pixel_width, sample_signed

wp.set_module_options({"enable_backward": False})

SHORTEST = wp.constant(LEAST_DIRECTION)
# Cosine to the viewer that a turned normal keeps: it must not show a surface its own back.
LEAST_FACING = wp.constant(0.02)


@wp.func
def picture_point(u_row: wp.vec3, v_row: wp.vec3, st: wp.vec2) -> wp.vec2:
    """A step of texture coordinates as a step of picture coordinates."""
    return wp.vec2(u_row[0] * st[0] + u_row[1] * st[1], v_row[0] * st[0] + v_row[1] * st[1])


@wp.func
def mapped_normal(
    scene: SceneView, textures: TextureSet, triangle: int, u: float, v: float, direction: wp.vec3, width: float
) -> wp.vec3:
    """Unit normal of a normal map at a point, on the side that a ray comes from; 0 where there is none to use.

    Args:
        scene: Holds the triangle.
        textures: Of the scene.
        triangle: The triangle.
        u: Weight of its second corner.
        v: Weight of its third corner.
        direction: Of the ray, unit.
        width: Of the ray's cone, see `footprint`. [scene units]
    """
    nothing = wp.vec3(0.0, 0.0, 0.0)
    number = textures.bindings[scene.patches[scene.triangle_patch[triangle]].material].normal
    index = textures.uv_index[triangle]
    if number < 0 or index[0] < 0:
        return nothing
    bump = sample_signed(textures, number, footprint(textures, scene, triangle, u, v, direction, width))
    # Not `< SHORTEST`: what is no number fails as well.
    if not (wp.length(bump) >= SHORTEST):
        return nothing
    corner = scene.triangles[triangle]
    first = scene.points[corner[1]] - scene.points[corner[0]]
    second = scene.points[corner[2]] - scene.points[corner[0]]
    u_row = textures.textures[number].u_row
    v_row = textures.textures[number].v_row
    a = picture_point(u_row, v_row, textures.uvs[index[1]] - textures.uvs[index[0]])
    b = picture_point(u_row, v_row, textures.uvs[index[2]] - textures.uvs[index[0]])
    # Directions in which u and v grow: the derivatives of the point times the determinant.
    side = wp.sign(a[0] * b[1] - a[1] * b[0])
    along_u = side * (b[1] * first - a[1] * second)
    along_v = side * (a[0] * second - b[0] * first)
    n = hit_normal(scene, triangle, u, v)
    tangent = along_u - wp.dot(n, along_u) * n
    if not (max_abs(tangent) > 0.0):
        return nothing
    tangent = unit(tangent)
    bitangent = wp.cross(n, tangent)
    if wp.dot(bitangent, along_v) < 0.0:
        bitangent = -bitangent
    mapped = unit(bump[0] * tangent + bump[1] * bitangent + bump[2] * n)
    if wp.dot(n, direction) > 0.0:
        mapped = -mapped
    facing = -wp.dot(mapped, direction)
    if facing < LEAST_FACING:
        mapped = unit(mapped + (facing - LEAST_FACING) * direction)
    return mapped


@wp.kernel
def eye_normals_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    textures: TextureSet,
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    bumpy: wp.array(dtype=int),
    out_normals: wp.array(dtype=wp.vec3),
):
    """One thread per pixel."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        return
    if reflector_id[i] > 0:
        if reflector_id[i] >= bumpy.shape[0]:
            return
        if bumpy[reflector_id[i]] == 0:
            return
    row = i // camera[0].width
    x = float(i - row * camera[0].width) + 0.5
    y = float(row) + 0.5
    ray = eye_ray_direction(camera[0], x, y)
    corner = scene.triangles[tri]
    hit = intersect_triangle(
        eye_ray_origin(camera[0], x, y),
        ray,
        scene.points[corner[0]] - camera[0].eye,
        scene.points[corner[1]] - camera[0].eye,
        scene.points[corner[2]] - camera[0].eye,
    )
    uv = clamp_weights(hit.u, hit.v)
    width = pixel_width(camera[0], wp.max(hit.t, 0.0))
    out_normals[i] = mapped_normal(scene, textures, tri, uv[0], uv[1], unit(ray), width)


@wp.kernel
def mirrored_normals_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    textures: TextureSet,
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    out_normals: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel. The cone goes on behind a mirror as it came, as in `mirrored_looks_kernel`."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    to_mirror = point[i] - camera[0].eye
    longer = 1.0 + distance[i] / wp.max(wp.length(to_mirror), LEAST_LENGTH)
    width = pixel_width(camera[0], wp.dot(camera[0].forward, to_mirror) * longer)
    out_normals[i] = mapped_normal(scene, textures, triangle[i], u[i], v[i], direction[i], width)


def _marked(ids: Collection[int], device) -> wp.array:
    """By id from 0 on: 1 for those, int32."""
    marked = np.zeros(max(ids, default=-1) + 1, np.int32)
    marked[list(ids)] = 1
    return wp.array(marked, dtype=int, device=device)


def prepare_normals(
    scene: Scene,
    gbuffer: GBuffer,
    layer: ReflectionLayer | None,
    threads: int = 0,
    bumpy: Collection[int] = (),
) -> wp.array:
    """The normals that normal maps give to what a frame shows.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees, with its `reflector_id` set.
        layer: What is seen in a mirror; None: of what the eye sees itself.
        threads: CPU threads; 0: one per core.
        bumpy: Ids of the reflectors that have their map's normals where the eye sees them; others have their own.

    Returns:
        Unit vec3 [pixels of the G-buffer or of the layer] towards the viewer's side, 0 where the surface's own normal
        counts; length 0 where the scene has no normal map.
    """
    textures = scene.textures
    if textures.normal_count == 0:
        return compact.none(wp.vec3, scene.device)
    if layer is None:
        normals = wp.zeros(len(gbuffer.triangle), dtype=wp.vec3, device=scene.device)
        inputs = [scene.view, gbuffer.view, textures, gbuffer.triangle, gbuffer.reflector_id]
        marked = scene.kept("bumpy reflectors", sorted(bumpy), lambda: _marked(bumpy, scene.device))
        inputs += [marked, normals]
        launch.launch(eye_normals_kernel, len(normals), inputs, scene.device, threads)
        return normals
    pixels = layer.pixels
    normals = wp.zeros(pixels.count, dtype=wp.vec3, device=scene.device)
    inputs = [scene.view, gbuffer.view, textures, pixels.point, pixels.direction, layer.distance]
    inputs += [layer.triangle, layer.u, layer.v, normals]
    launch.launch(mirrored_normals_kernel, pixels.count, inputs, scene.device, threads)
    return normals
