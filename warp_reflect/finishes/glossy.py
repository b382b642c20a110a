"""Rough mirrors: the mean over a GGX lobe of what a sharp mirror sees, so that blur grows with the path length.

`glossy=accumulate` follows `glossy_samples` rays of the lobe per pixel through the BVH and shades what they meet: the
reference, and the accumulation of jittered pictures of Diefenbach and Badler, Multi-Pass Pipeline Rendering, I3D 1997, as
told in Real-Time Rendering, 3rd edition, section 9.3.1, with the normal jittered instead of the objects. `glossy=filter`
looks the same directions up in the sharp picture (`layer_map.py`), each as wide as the part of the lobe that it stands for.
Source of the filter: Krivanek and Colbert, Real-time Shading with Filtered Importance Sampling, EGSR 2008. Differs from it
by: the sharp picture of the mirror itself instead of an environment map, searched at the path length that it shows.

Both weigh a direction by Fresnel's term at its own microfacet and by Smith's masking, over the weight that the surface
gives its sharp mirror. A lobe never gives more than that weight: the layers below have only given up as much.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import bvh, launch, shade
from warp_reflect.finishes.layer_map import (
    LayerMap,
    find_in_map,
    make_layer_map,
    map_frame,
    map_radiance,
    map_step,
    nearness_range,
)
from warp_reflect.finishes.lobe import Lobe, lattice_point, lobe_sample, pixel_shift, surface_lobe
from warp_reflect.layers import MirrorPixels, ReflectionLayer
from warp_reflect.scene import Scene, SceneView
from warp_reflect.shade import schlick
from warp_reflect.surface import shown_normal
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

BASE, COAT = 0, 1
ACCUMULATED = 256  # rays a pixel
FILTERED = 16  # look-ups a pixel
LOBE_WIDTH = wp.constant(4.0)  # radius of a lobe over alpha: most of it is within twice the microfacets' own
LEAST_COVERAGE = wp.constant(1.0e-3)  # of all look-ups: below it the sharp picture has nothing to mix
LEAST_WEIGHT = wp.constant(1.0e-6)  # of a mirror, that a lobe is put in relation to


@wp.func
def eye_side(direction: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Unit direction back to the eye from a sharp reflection and the normal it was reflected at."""
    return 2.0 * wp.dot(direction, n) * n - direction


@wp.func
def outward(direction: wp.vec3, n: wp.vec3) -> wp.vec3:
    """A direction out of the surface: what a normal map sends into it is reflected once more."""
    into = wp.min(wp.dot(direction, n), 0.0)
    return direction - 2.0 * into * n


@wp.func
def share_of_weight(lobe: Lobe, cosine: float, total: wp.vec3, seen: wp.vec3, given: wp.vec3) -> wp.vec3:
    """Radiance that, times a sharp mirror's weight, is what a lobe reflects.

    Args:
        lobe: Its F0 and F90.
        cosine: Of the angle of incidence on the surface.
        total: Mean of all directions' weights.
        seen: Sum of the weights of those whose radiance is known, times that.
        given: Sum of their weights.
    """
    sharp = schlick(lobe.f0, lobe.f90, cosine)
    result = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if given[c] > 0.0:
            result[c] = seen[c] / given[c]
            if sharp[c] > LEAST_WEIGHT:
                result[c] *= wp.min(total[c] / sharp[c], 1.0)
    return result


@wp.kernel
def filter_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    image_width: int,
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    sharp: wp.array(dtype=wp.vec3),
    layer: LayerMap,
    # Settings:
    coat: int,
    count: int,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    p = pixel[i]
    row = p // image_width
    column = p - row * image_width - layer.x0
    row -= layer.y0
    frame = map_frame(layer, column, row)
    x = float(column) + 0.5
    y = float(row) + 0.5
    nearness = layer.nearness[row * layer.width + column][0]
    view = eye_side(frame.direction, normal[i])
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    per_pixel = wp.sqrt(map_step(frame, nearness, view)[2])
    around = wp.vec2(nearness, nearness)
    if per_pixel > 0.0:
        around = nearness_range(layer, x, y, LOBE_WIDTH * lobe.alpha / per_pixel)
    total = wp.vec3(0.0, 0.0, 0.0)
    seen = wp.vec3(0.0, 0.0, 0.0)
    given = wp.vec3(0.0, 0.0, 0.0)
    covered = float(0.0)
    shift = pixel_shift(p)
    for k in range(count):
        sample = lobe_sample(lobe.alpha, n, view, lattice_point(k, count, shift))
        if sample.weight > 0.0:
            weight = sample.weight * schlick(lobe.f0, lobe.f90, sample.cosine)
            total += weight
            direction = outward(sample.direction, normal[i])
            found = find_in_map(layer, frame, x, y, nearness, around, direction, sample.solid_angle / float(count))
            if found.there != 0:
                texel = map_radiance(layer, found)
                seen += wp.cw_mul(weight, wp.vec3(texel[0], texel[1], texel[2]))
                given += texel[3] * weight
                covered += texel[3]
    if covered < LEAST_COVERAGE * float(count):
        seen = wp.cw_mul(total, sharp[i])
        given = total
    out_radiance[i] = share_of_weight(lobe, wp.dot(view, n), total / float(count), seen, given)


@wp.kernel
def jitter_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Which sample of how many, of which lobe:
    k: int,
    count: int,
    coat: int,
    # Outputs:
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_weight: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    p = pixel[i]
    view = eye_side(direction[i], normal[i])
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    sample = lobe_sample(lobe.alpha, n, view, lattice_point(k, count, pixel_shift(p)))
    weight = sample.weight * schlick(lobe.f0, lobe.f90, sample.cosine)
    turned = outward(sample.direction, normal[i])
    half = turned + view
    if sample.weight <= 0.0 or wp.dot(turned, normal[i]) <= 0.0:
        # Not followed for its own sake; the sharp ray is as good as any.
        weight = wp.vec3(0.0, 0.0, 0.0)
        turned = direction[i]
        half = normal[i]
    out_weight[i] = weight
    out_direction[i] = turned
    out_normal[i] = wp.normalize(half)


@wp.kernel
def accumulate_kernel(
    first: int,
    weight: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    # Outputs:
    out_seen: wp.array(dtype=wp.vec3),
    out_total: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    out_seen[i] += wp.cw_mul(weight[i], radiance[i])
    out_total[i] += weight[i]


@wp.kernel
def settle_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    coat: int,
    count: int,
    seen: wp.array(dtype=wp.vec3),
    total: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    p = pixel[i]
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    cosine = wp.dot(eye_side(direction[i], normal[i]), n)
    out_radiance[i] = share_of_weight(lobe, cosine, total[i] / float(count), seen[i], total[i])


def apply(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, radiance: wp.array, row
) -> wp.array:
    """What the base lobe of a rough mirror sees, see `finishes`."""
    return lobe_radiance(scene, shown, layer, sharp, row, BASE)


def lobe_radiance(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, row, which: int
) -> wp.array:
    """What one lobe of a mirror sees, in relation to the weight of a sharp mirror's.

    Args:
        scene: On the layer's device.
        shown: What the eye sees.
        layer: The sharp mirror's answer.
        sharp: What its pixels see, vec3 [layer.pixels.count].
        row: The reflector's `PlanRow`.
        which: `BASE` or `COAT`.

    Returns:
        vec3 [layer.pixels.count].
    """
    if row.settings.glossy == "accumulate":
        return accumulated(scene, shown, layer, row, which, row.settings.glossy_samples or ACCUMULATED)
    return filtered(scene, shown, layer, sharp, row, which, row.settings.glossy_samples or FILTERED)


def filtered(scene, shown, layer, sharp, row, which: int, count: int) -> wp.array:
    """`lobe_radiance` from `count` look-ups a pixel in the sharp picture."""
    pixels, threads = layer.pixels, row.settings.threads
    width = shown.gbuffer.camera.size[0]
    picture = make_layer_map(scene, width, layer, sharp, threads)
    radiance = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    surface = [scene.view, shown.looks, shown.normals, shown.gbuffer.triangle, width]
    inputs = [*surface, pixels.pixel, pixels.normal, sharp, picture, which, count, radiance]
    launch.launch(filter_kernel, pixels.count, inputs, scene.device, threads, split_min=bvh.TRACE_SPLIT_MIN)
    return radiance


def accumulated(scene, shown, layer, row, which: int, count: int) -> wp.array:
    """`lobe_radiance` from `count` rays a pixel."""
    pixels, threads, device = layer.pixels, row.settings.threads, scene.device
    n = pixels.count
    normal, direction, weight = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(3))
    seen, total = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
    turned = MirrorPixels(pixels.reflector, pixels.pixel, pixels.point, normal, direction, pixels.box)
    surface = [scene.view, shown.looks, shown.normals, shown.gbuffer.triangle]
    surface += [pixels.pixel, pixels.normal, pixels.direction]
    reflector = row.reflector
    for k in range(count):
        launch.launch(jitter_kernel, n, [*surface, k, count, which, normal, direction, weight], device, threads)
        answer = ReflectionLayer.empty(turned, layer.method, device)
        bvh.trace_pixels(scene, shown.gbuffer, turned, answer, reflector.part, reflector.convex, threads=threads)
        radiance = shown.seen(answer)
        launch.launch(accumulate_kernel, n, [weight, radiance, seen, total], device, threads)
    radiance = wp.empty(n, dtype=wp.vec3, device=device)
    launch.launch(settle_kernel, n, [*surface, which, count, seen, total, radiance], device, threads)
    return radiance
