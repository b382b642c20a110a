"""Water: the pictures of a still surface, mirrored and refracted, looked up where its waves turn the rays.

Source: McTaggart, Half-Life 2 / Valve Source Shading, GDC 2004, as told in Akenine-Moller, Haines, Hoffman, Real-Time
Rendering, 3rd edition, section 9.3.1: the reflected and the refracted picture are rendered for the flat surface, and a normal
map shifts where they are looked up. Differs from it by: the shift is not the normal times a constant, but the projection of
the point that the turned ray meets at the height over the surface that the still picture shows there, found step by step; for
the refracted picture through Snell's law at the flat surface. (A constant is off by tens of pixels where this is off by
hundredths, but for what the still picture does not show.) Look-ups that would leave the surface at a shore, or the frame, are
drawn back towards their own pixel.

`waves=traced` follows the turned rays instead: the reference.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import bvh, launch, shade, vector
from warp_reflect.finishes.still_picture import StillPicture, look_up, make_picture, nearness_at, placed
from warp_reflect.layers import CameraView, ReflectionLayer
from warp_reflect.optics import refract
from warp_reflect.scene import Scene
from warp_reflect.shapes import unit
from warp_reflect.surface import shown_normal, turned_reflection
from warp_reflect.transmission import Through, Transmission, look_through, through_radiance

wp.set_module_options({"enable_backward": False})

# Look-ups for the height of what a turned ray meets: more change few pixels.
MIRROR_STEPS = wp.constant(3)
REFRACTION_STEPS = wp.constant(2)
RETREATS = wp.constant(4)  # halvings of a shift that leaves the surface
LEAST_NEARNESS = wp.constant(1.0e-6)  # of the eye's own: what is further is as good as infinitely far
LEAST_DEPTH = wp.constant(1.0e-6)
EVEN_COVERAGE = wp.constant(0.5)  # of the four texels of a look-up: a shore's own pixels count, not what is beyond


@wp.func
def seen_at(camera: CameraView, p_eye: wp.vec3, own: wp.vec2) -> wp.vec2:
    """Pixel coordinates of a point of the eye frame; `own` where it is not before the eye."""
    w = camera.w_row[0] * p_eye[0] + camera.w_row[1] * p_eye[1] + camera.w_row[2] * p_eye[2] + camera.w_row[3]
    if not (w > LEAST_DEPTH * wp.length(p_eye)):
        return own
    x = camera.x_row[0] * p_eye[0] + camera.x_row[1] * p_eye[1] + camera.x_row[2] * p_eye[2] + camera.x_row[3]
    y = camera.y_row[0] * p_eye[0] + camera.y_row[1] * p_eye[1] + camera.y_row[2] * p_eye[2] + camera.y_row[3]
    return wp.vec2(x / w, y / w)


@wp.func
def shifted_radiance(picture: StillPicture, own: wp.vec2, at: wp.vec2, otherwise: wp.vec3) -> wp.vec3:
    """The picture at a place; nearer to the pixel's own where the surface is not seen there."""
    shift = at - own
    for _step in range(RETREATS):
        found = look_up(picture, own[0] + shift[0], own[1] + shift[1])
        if found[3] >= EVEN_COVERAGE:
            return wp.vec3(found[0], found[1], found[2]) / found[3]
        shift = 0.5 * shift
    return otherwise


@wp.kernel
def reflect_waves_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    normals: wp.array(dtype=wp.vec3),
    picture: StillPicture,
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel, but for the number -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    still = placed(picture)
    row = pixel[i] // camera[0].width
    own = wp.vec2(float(pixel[i] - row * camera[0].width) + 0.5, float(row) + 0.5)
    n = normal[i]
    to_point = point[i] - camera[0].eye
    turned = turned_reflection(direction[i], n, shown_normal(normals, pixel[i], n))
    # What the turned ray meets stands, to the eye, where its mirror image in the still plane does.
    rise = wp.dot(turned, n)
    behind = turned - 2.0 * rise * n
    least = LEAST_NEARNESS / wp.max(wp.length(to_point), LEAST_DEPTH)
    near = nearness_at(still, own[0], own[1], 0.0)
    at = own
    for _step in range(MIRROR_STEPS):
        at = seen_at(camera[0], to_point + behind / wp.max(near * rise, least), own)
        near = nearness_at(still, at[0], at[1], near)
    out_radiance[i] = shifted_radiance(still, own, at, radiance[i])


@wp.func
def crossing_point(near_it: wp.vec3, n: wp.vec3, target: wp.vec3, ior: float) -> wp.vec3:
    """Where an eye at the origin sees a point behind a flat interface: the point of the interface on its way.

    Args:
        near_it: A point of the interface near it.
        n: Unit normal on the eye's side.
        target: The point behind.
        ior: Index of refraction behind the interface over that before it.
    """
    height = -wp.dot(near_it, n)
    depth = wp.max(-wp.dot(target - near_it, n), 0.0)
    across = target - wp.dot(target, n) * n
    length = wp.length(across)
    if not (length > 0.0):
        return -height * n
    s = wp.clamp(wp.length(near_it + height * n), 0.0, length)
    # One step of Newton's: waves move the point by little, and the search comes here again.
    left = length - s
    before = s * s + height * height
    after = left * left + depth * depth
    if before > 0.0 and after > 0.0:
        before = 1.0 / wp.sqrt(before)
        after = 1.0 / wp.sqrt(after)
        residual = s * before - ior * left * after
        slope = height * height * before * before * before + ior * depth * depth * after * after * after
        if slope > 0.0:
            s = wp.clamp(s - residual / slope, 0.0, length)
    return (s / length) * across - height * n


@wp.kernel
def refract_waves_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    normals: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.uint8),
    ior: float,
    still_picture: StillPicture,
    # Pixels of the surface, with the normals on the far side:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per pixel of the surface, but for the number -1; an eye behind it has its turned rays already."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    picture = placed(still_picture)
    out_radiance[i] = radiance[i]
    n = -normal[i]
    row = pixel[i] // camera[0].width
    own = wp.vec2(float(pixel[i] - row * camera[0].width) + 0.5, float(row) + 0.5)
    to_point = point[i] - camera[0].eye
    incident = camera[0].forward
    if camera[0].orthographic == 0:
        incident = unit(to_point)
    # Rays that are in the body, totally reflected there, came from it.
    if int(inside[i]) == 0 or wp.dot(incident, n) >= 0.0:
        return
    bent = refract(incident, shown_normal(normals, pixel[i], n), ior)
    if not (wp.dot(bent, n) < 0.0):
        return
    bent = unit(bent)
    still = wp.vec3(0.0, 0.0, 0.0)
    if camera[0].orthographic != 0:
        still = refract(incident, n, ior)
    least = LEAST_NEARNESS / wp.max(wp.length(to_point), LEAST_DEPTH)
    near = nearness_at(picture, own[0], own[1], 0.0)
    at = own
    crossing = to_point
    for _step in range(REFRACTION_STEPS):
        target = to_point - bent / wp.min(near * wp.dot(bent, n), -least)
        if camera[0].orthographic == 0:
            crossing = crossing_point(crossing, n, target, ior)
            at = seen_at(camera[0], crossing, own)
        else:
            way = wp.dot(target - to_point, n) / wp.dot(still, n)
            at = seen_at(camera[0], target - way * still, own)
        near = nearness_at(picture, at[0], at[1], near)
    out_radiance[i] = shifted_radiance(picture, own, at, radiance[i])


@wp.kernel
def turn_kernel(
    first: int,
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel; no direction where the number is -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        out_direction[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    out_direction[i] = turned_reflection(direction[i], normal[i], shown_normal(normals, pixel[i], normal[i]))


def apply(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, radiance: wp.array, row
) -> wp.array:
    """What a mirror with waves shows, see `finishes`; a rough one's lobe is turned by them itself (`glossy.py`)."""
    if row.effects["roughness"].on:
        return radiance
    return turned_radiance(scene, shown, layer, radiance, row)


def turned_radiance(scene: Scene, shown: shade.Shown, layer: ReflectionLayer, radiance: wp.array, row) -> wp.array:
    """What a sharp mirror sees that waves turn, and its normal map where it has one, from what the still one does.

    Maps are looked up however the rest is: they show no place to trace to.
    """
    pixels, threads, device = layer.pixels, row.settings.threads, scene.device
    if _is_traced(row) and layer.radiance is None:
        return traced(scene, shown, layer, row)
    width, hits = shown.gbuffer.camera.size[0], (layer.triangle, layer.distance)
    picture = make_picture(pixels, radiance, width, hits=hits, threads=threads, kernels=row.settings.kernels)
    wavy = wp.empty(pixels.count, dtype=wp.vec3, device=device)
    inputs = [shown.gbuffer.view, shown.normals, picture, pixels.pixel, pixels.point, pixels.normal, pixels.direction]
    inputs += [radiance, wavy]
    if vector.chosen(row.settings.kernels, device):
        from warp_reflect.finishes import water_vector  # which works with this module's constants

        vector.launch_blocks(water_vector.reflect_blocks_kernel, pixels.count, inputs, device, threads)
    else:
        launch.launch(reflect_waves_kernel, pixels.count, inputs, device, threads)
    return wavy


def _is_traced(row) -> bool:
    """Whether rays are asked for of the waves, or of the normal map whose slopes are added to theirs."""
    return row.settings.waves == "traced" or (row.effects["normal_map"].on and row.settings.bumps == "traced")


def traced(scene: Scene, shown: shade.Shown, layer: ReflectionLayer, row) -> wp.array:
    """What the rays see that the waves turn."""
    pixels, settings = layer.pixels, row.settings
    direction = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    inputs = [shown.normals, pixels.pixel, pixels.normal, pixels.direction, direction]
    launch.launch(turn_kernel, pixels.count, inputs, scene.device, settings.threads)
    turned = pixels.turned(direction)
    answer = ReflectionLayer.unset(turned, layer.method, scene.device)
    # A flat mirror never sees itself.
    how = {"threads": settings.threads, "kernels": settings.kernels}
    bvh.trace_pixels(scene, shown.gbuffer, turned, answer, row.reflector.part, True, **how)
    return shown.seen(answer)


def apply_through(scene: Scene, through: Through, found: Transmission, radiance: wp.array, pane) -> wp.array:
    """What is seen through a surface with waves, see `finishes`."""
    pixels, settings, shown = found.layer.pixels, pane.settings, through.shown
    if settings.waves == "traced":
        turned = look_through(scene, shown, through.interfaces, found.surface, settings, wavy=True)
        found.layer, found.nearness = turned.layer, turned.nearness
        return through_radiance(scene, through, found, settings)
    width, kernels = shown.gbuffer.camera.size[0], settings.kernels
    picture = make_picture(pixels, radiance, width, found.nearness, threads=settings.threads, kernels=kernels)
    wavy = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    ior = scene.data.materials[scene.parts[pane.part].material].ior
    inputs = [shown.gbuffer.view, shown.normals, found.inside, ior, picture]
    inputs += [pixels.pixel, pixels.point, pixels.normal, radiance, wavy]
    if vector.chosen(kernels, scene.device):
        from warp_reflect.finishes import water_vector

        vector.launch_blocks(water_vector.refract_blocks_kernel, pixels.count, inputs, scene.device, settings.threads)
    else:
        launch.launch(refract_waves_kernel, pixels.count, inputs, scene.device, settings.threads)
    return wavy
