"""Where what a mirror shows was a frame ago: the `reflectionMotion` channel.

The material point seen at a mirror pixel is followed to the previous frame's scene, and the pixel is sought at which the
previous mirror, seen by the previous camera, showed it: Newton's method on the image plane for the angle by which the
reflected ray through a pixel passes the point, each evaluation a ray against the mirror's own triangles and a reflection at
the surface that every technique reflects at (`surface.surface_at`). Exact for moving eyes, mirrors and objects alike, and
independent of the technique that made the frame. What hides the point from the previous mirror is not asked.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin, project
from warp_reflect.ray_query import first_met, triangle_in
from warp_reflect.scene import Scene, SceneView
from warp_reflect.shapes import intersect_triangle, unit
from warp_reflect.surface import surface_at

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(3.0e38)
STEPS_MAX = wp.constant(24)  # Newton steps, shortened ones included; 3 to 5 are usual
PROBE_PX = wp.constant(0.25)  # of the finite differences; float32 rays resolve 1e-3 of a pixel
STEP_MAX_PX = wp.constant(64.0)  # a longer step leaves the region where a curved mirror's picture is nearly affine
SETTLED_PX = wp.constant(0.005)  # a step below it ends the search
ACCEPTED_PX = wp.constant(0.1)  # a search that ends farther from a root has no answer
SHRINK = wp.constant(0.5)


@wp.func
def miss_angle(
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    mesh_id: wp.uint64,
    first_triangle: int,
    x: float,
    y: float,
    target: wp.vec3,
) -> wp.vec4:
    """How the ray reflected at pixel coordinate (x, y) passes a point: (offset / distance, 1), or 0 off the mirror."""
    direction = unit(eye_ray_direction(camera[0], x, y))
    origin = camera[0].eye + eye_ray_origin(camera[0], x, y)
    met = first_met(mesh_id, origin, direction, FAR)
    triangle = triangle_in(met)
    if triangle < 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    key = 1.0 / wp.max(met[0] * wp.dot(direction, camera[0].forward), 1.0e-30)
    s = surface_at(scene, camera, first_triangle + triangle, key, x, y)
    d = s.incident - 2.0 * wp.dot(s.incident, s.normal) * s.normal
    to_target = target - s.p_scene
    along = wp.dot(to_target, d)
    if along <= 0.0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    off = (to_target - along * d) / wp.max(wp.length(to_target), 1.0e-30)
    return wp.vec4(off[0], off[1], off[2], 1.0)


@wp.func
def point_on(scene: SceneView, triangle: int, u: float, v: float) -> wp.vec3:
    t = scene.triangles[triangle]
    return (1.0 - u - v) * scene.points[t[0]] + u * scene.points[t[1]] + v * scene.points[t[2]]


@wp.kernel
def reflection_motion_kernel(
    first: int,
    # This frame:
    scene: SceneView,
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    # The previous frame:
    before: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle_before: wp.array(dtype=int),
    mesh_id: wp.uint64,
    first_triangle: int,
    # Outputs:
    out_motion: wp.array(dtype=wp.vec2),
):
    """One thread per mirror pixel, which is written at its place in the image; without an answer it keeps what it holds."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    seen = triangle_before[triangle[i]]
    facet = triangle_before[facets[pixel[i]]]
    if seen < 0 or facet < 0:
        return
    target = point_on(before, seen, u[i], v[i])
    # The mirror's material point is where the search starts: the pixel itself where nothing moved.
    corners = scene.triangles[facets[pixel[i]]]
    incident = direction[i] - 2.0 * wp.dot(direction[i], normal[i]) * normal[i]
    on_mirror = intersect_triangle(
        point[i], incident, scene.points[corners[0]], scene.points[corners[1]], scene.points[corners[2]]
    )
    start = project(camera[0], point_on(before, facet, on_mirror.u, on_mirror.v) - camera[0].eye)
    if on_mirror.det == 0.0 or start[2] <= 0.0:
        return
    row = pixel[i] / camera[0].width
    now = wp.vec2(float(pixel[i] - row * camera[0].width) + 0.5, float(row) + 0.5)
    best = wp.vec2(start[0], start[1])
    at = best
    step = wp.vec2(0.0, 0.0)
    least = float(FAR)
    steps = int(0)
    stage = int(0)
    off = wp.vec3(0.0, 0.0, 0.0)
    along_x = wp.vec3(0.0, 0.0, 0.0)
    length = float(FAR)
    wanted = float(FAR)  # the unshortened step from the best place: how far off the root is
    # One loop over evaluations (the centre, then a probe to the right and one below): everything is inlined.
    while steps < STEPS_MAX and length > SETTLED_PX:
        probe = wp.vec2(wp.where(stage == 1, PROBE_PX, 0.0), wp.where(stage == 2, PROBE_PX, 0.0))
        miss = miss_angle(before, camera, mesh_id, first_triangle, at[0] + probe[0], at[1] + probe[1], target)
        angle = wp.vec3(miss[0], miss[1], miss[2])
        if stage == 0:
            steps += 1
            if miss[3] > 0.0 and wp.length(angle) < least:
                least = wp.length(angle)
                best = at
                off = angle
                stage = 1
            else:
                if least == FAR:
                    return
                step = SHRINK * step
                length = wp.length(step)
                at = best + step
        elif miss[3] == 0.0:
            return
        elif stage == 1:
            along_x = (angle - off) / PROBE_PX
            stage = 2
        else:
            along_y = (angle - off) / PROBE_PX
            a = wp.dot(along_x, along_x)
            b = wp.dot(along_x, along_y)
            c = wp.dot(along_y, along_y)
            det = a * c - b * b
            if det <= 0.0:
                return
            gx = wp.dot(along_x, off)
            gy = wp.dot(along_y, off)
            step = wp.vec2((b * gy - c * gx) / det, (b * gx - a * gy) / det)
            length = wp.length(step)
            wanted = length
            if length > STEP_MAX_PX:
                step = step * (STEP_MAX_PX / length)
            at = best + step
            stage = 0
    if wanted <= ACCEPTED_PX:
        out_motion[pixel[i]] = now - best - wp.where(wanted <= SETTLED_PX, 1.0, 0.0) * step


def reflection_motion(
    scene: Scene, gbuffer: GBuffer, layers: dict[int, ReflectionLayer], before: Scene, camera: Camera, threads: int = 0
) -> wp.array:
    """How far what is seen in the mirrors moved on the screen since the previous frame.

    Args:
        scene: Of this frame.
        gbuffer: What its eye sees.
        layers: Its reflections, by reflector id.
        before: The previous frame's scene: the same stage, at the same time or another.
        camera: The previous frame's.
        threads: CPU threads; 0: one per core.

    Returns:
        vec2 [height * width] on the scene's device: pixel now minus pixel then of the same material point seen in the same
        mirror, x to the right, y down; 0 where there is no reflection, where the sky is seen, and where the previous mirror
        did not show it.
    """
    width, height = gbuffer.camera.size
    image = wp.zeros(height * width, dtype=wp.vec2, device=scene.device)
    table, parts = _previous_triangles(scene, before)
    view = camera.view(before)
    for layer in layers.values():
        pixels = layer.pixels
        patch = scene.host_triangle_patch[gbuffer.triangle.numpy()[pixels.pixel.numpy()[:1]]]
        part = next((k for k, own in enumerate(scene.parts) if len(patch) and patch[0] in own.patches), None)
        if part is None or parts[part] < 0:
            continue
        mirror = parts[part]
        launch(
            reflection_motion_kernel,
            pixels.count,
            [scene.view, gbuffer.triangle, pixels.pixel, pixels.point, pixels.direction, pixels.normal]
            + [layer.triangle, layer.u, layer.v]
            + [before.view, view, wp.array(table, dtype=int, device=scene.device)]
            + [wp.uint64(before.part_tracer(mirror).id), before.parts[mirror].first_triangle, image],
            scene.device,
            threads,
        )
    return image


def _previous_triangles(scene: Scene, before: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Per triangle the same one of another time of the stage, and per part likewise; -1 where there is none."""
    if scene is before:
        return np.arange(scene.triangle_count, dtype=np.int32), np.arange(len(scene.parts))
    known = {(part.prim_path, part.subset, part.instance): k for k, part in enumerate(before.parts)}
    table = np.full(scene.triangle_count, -1, np.int32)
    parts = np.full(len(scene.parts), -1)
    for k, part in enumerate(scene.parts):
        same = known.get((part.prim_path, part.subset, part.instance), -1)
        if same < 0 or before.parts[same].triangle_count != part.triangle_count:
            continue
        parts[k] = same
        own = np.arange(part.triangle_count, dtype=np.int32)
        table[part.first_triangle + own] = before.parts[same].first_triangle + own
    return table, parts
