"""Rough mirrors from look-ups in the sharp picture (`layer_map.py`), each as wide as the part of the lobe that it stands for.

Source: Krivanek and Colbert, Real-time Shading with Filtered Importance Sampling, EGSR 2008. Differs from it by: the sharp
picture of the mirror itself instead of an environment map, searched at the path length that it shows. What a lobe sees beyond
that picture is taken for what the rest of the lobe sees.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import bvh, launch
from warp_reflect.finishes.layer_map import (
    LayerMap,
    find_in_map,
    make_layer_map,
    map_frame,
    map_radiance,
    map_step,
    nearness_range,
)
from warp_reflect.finishes.lobe import (
    eye_side,
    lattice_point,
    lobe_sample,
    outward,
    pixel_shift,
    share_of_weight,
    surface_lobe,
)
from warp_reflect.scene import SceneView
from warp_reflect.shade import schlick
from warp_reflect.surface import shown_normal
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

SAMPLES = 16  # look-ups a pixel
LOBE_WIDTH = wp.constant(4.0)  # radius of a lobe over alpha: most of it is within twice the microfacets' own
LEAST_COVERAGE = wp.constant(1.0e-3)  # of all look-ups: below it the sharp picture has nothing to mix


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


def radiance_of(scene, shown, layer, sharp, row, which: int, count: int) -> wp.array:
    """`glossy.lobe_radiance` from `count` look-ups a pixel in the sharp picture."""
    pixels, threads = layer.pixels, row.settings.threads
    width = shown.gbuffer.camera.size[0]
    picture = make_layer_map(scene, width, layer, sharp, threads)
    radiance = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    surface = [scene.view, shown.looks, shown.normals, shown.gbuffer.triangle, width]
    inputs = [*surface, pixels.pixel, pixels.normal, sharp, picture, which, count, radiance]
    launch.launch(filter_kernel, pixels.count, inputs, scene.device, threads, split_min=bvh.TRACE_SPLIT_MIN)
    return radiance
