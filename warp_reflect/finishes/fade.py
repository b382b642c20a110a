"""Mirrors whose picture fades with the distance of what it shows.

Source: Akenine-Moller, Haines, Hoffman, Real-Time Rendering, 3rd edition, section 9.3.1: the depth of what is reflected is
compared with the reflector's and diminishes it. Differs from it by: the length of the reflected ray in place of a difference
of depths, which changes with the camera's direction, and e^(-length / distance) in place of linear fog.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch, shade
from warp_reflect.layers import ReflectionLayer
from warp_reflect.scene import Scene

wp.set_module_options({"enable_backward": False})


@wp.kernel
def fade_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    radiance: wp.array(dtype=wp.vec3),
    per_length: float,
    color: wp.vec3,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    share = float(0.0)
    if triangle[i] >= 0:
        share = wp.exp(-distance[i] * per_length)
    out_radiance[i] = share * radiance[i] + (1.0 - share) * color


def apply(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, radiance: wp.array, row
) -> wp.array:
    """What a fading mirror's pixels see, see `finishes`; the sky is infinitely far."""
    asked = row.effects["fade"].numbers
    faded = wp.empty(layer.pixels.count, dtype=wp.vec3, device=scene.device)
    inputs = [layer.triangle, layer.distance, radiance, 1.0 / asked["distance"], wp.vec3(*asked["color"])]
    launch.launch(fade_kernel, layer.pixels.count, [*inputs, faded], scene.device, row.settings.threads)
    return faded
