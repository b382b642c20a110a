"""Normal-mapped mirrors: the reflected ray turned pixel by pixel over the answer for the smooth surface.

Sources: Blinn, Simulation of Wrinkled Surfaces, SIGGRAPH 1978, and Real-Time Rendering, 3rd edition, section 9.3 (a normal map
perturbs where the picture of the reflection is looked up). `bumps=lookup` looks for the turned ray's view in the smooth
mirror's own picture (`layer_map.py`) instead of shifting it by a constant, and follows by rays what that picture does not
hold. `bumps=traced` follows every turned ray: the reference.

The data channels stay those of the smooth mirror.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import bvh, compact, launch, shade
from warp_reflect.finishes.layer_map import (
    LayerMap,
    find_in_map,
    make_layer_map,
    map_frame,
    map_radiance,
    map_step,
    nearness_range,
    pixel_at,
    step_from,
)
from warp_reflect.layers import MirrorPixels, ReflectionLayer
from warp_reflect.scene import Scene
from warp_reflect.surface import shown_normal, turned_reflection

wp.set_module_options({"enable_backward": False})

# Of a look-up's texels that belong to the mirror: below it the picture does not hold what the turned ray sees.
LEAST_COVERAGE = wp.constant(0.99)
# Pixels by which a look-up may miss the place whose own ray meets the turned one: what misses by more is traced.
MISS = wp.constant(1.0)


@wp.kernel
def turn_rays_kernel(
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


@wp.kernel
def look_up_kernel(
    first: int,
    image_width: int,
    layer: LayerMap,
    pixel: wp.array(dtype=int),
    turned: wp.array(dtype=wp.vec3),
    # Outputs:
    out_radiance: wp.array(dtype=wp.vec3),
    out_found: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    row = pixel[i] // image_width
    column = pixel[i] - row * image_width - layer.x0
    row -= layer.y0
    frame = map_frame(layer, column, row)
    x = float(column) + 0.5
    y = float(row) + 0.5
    nearness = layer.nearness[row * layer.width + column][0]
    step = map_step(frame, nearness, turned[i] - frame.direction)
    around = nearness_range(layer, x, y, wp.length(wp.vec2(step[0], step[1])))
    found = find_in_map(layer, frame, x, y, nearness, around, turned[i], 0.0)
    if found.there == 0:
        return
    k = pixel_at(layer, found.x, found.y)
    if k < 0:
        return
    again = step_from(layer, frame, k, turned[i], layer.nearness[k][0])
    if again[2] == 0.0 or wp.abs(again[0] - found.x) + wp.abs(again[1] - found.y) > MISS:
        return
    texel = map_radiance(layer, found)
    if texel[3] >= LEAST_COVERAGE:
        out_radiance[i] = wp.vec3(texel[0], texel[1], texel[2]) / texel[3]
        out_found[i] = wp.uint8(1)


def apply(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, radiance: wp.array, row
) -> wp.array:
    """What a normal-mapped mirror shows, see `finishes`.

    A rough one's lobe is turned by the map itself (`glossy.py`), and waves have the map's slopes added to theirs (`water.py`).
    """
    if row.effects["roughness"].on or row.effects["waves"].on:
        return radiance
    return turned_radiance(scene, shown, layer, radiance, row)


def turned_radiance(scene: Scene, shown: shade.Shown, layer: ReflectionLayer, radiance: wp.array, row) -> wp.array:
    """What a sharp mirror sees that its normal map turns, vec3 [layer.pixels.count], from what the smooth one does."""
    pixels, threads, device = layer.pixels, row.settings.threads, scene.device
    direction = wp.empty(pixels.count, dtype=wp.vec3, device=device)
    inputs = [shown.normals, pixels.pixel, pixels.normal, pixels.direction, direction]
    launch.launch(turn_rays_kernel, pixels.count, inputs, device, threads)
    turned = pixels.turned(direction)
    if row.settings.bumps == "traced":
        return _traced(scene, shown, layer, turned, row)
    width = shown.gbuffer.camera.size[0]
    bumpy = wp.zeros(pixels.count, dtype=wp.vec3, device=device)
    found = wp.zeros(pixels.count, dtype=wp.uint8, device=device)
    picture = make_layer_map(scene, width, layer, radiance, threads)
    launch.launch(
        look_up_kernel, pixels.count, [width, picture, pixels.pixel, direction, bumpy, found], device, threads
    )
    left = compact.marked(found, 0)
    if len(left):
        rest = _traced(scene, shown, layer, turned.select(left, pixels.reflector, width), row)
        compact.put(bumpy, left, rest)
    layer.statistics["bumps_traced"] = len(left)
    return bumpy


def _traced(scene: Scene, shown: shade.Shown, layer: ReflectionLayer, turned: MirrorPixels, row) -> wp.array:
    """What rays see that start on a mirror's pixels."""
    answer = ReflectionLayer.unset(turned, layer.method, scene.device)
    part, convex = row.reflector.part, row.reflector.convex
    how = {"threads": row.settings.threads, "kernels": row.settings.kernels}
    bvh.trace_pixels(scene, shown.gbuffer, turned, answer, part, convex, **how)
    return shown.seen(answer)
