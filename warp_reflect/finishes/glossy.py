"""Rough mirrors: the mean over a GGX lobe of what a sharp mirror sees, so that blur grows with the path length.

`glossy=accumulate` follows 256 rays of the lobe a pixel (`glossy_rays.py`): the reference. `glossy=gather` follows a few, and
neighbouring pixels share what these meet (`glossy_gather.py`). `glossy=filter` looks the lobe's directions up in the sharp
picture (`glossy_filter.py`), and follows none. `glossy=prefiltered` looks lobes up in the map of a mirror whose technique is
one (`glossy_prefiltered.py`). `effects.glossy_way` says which it is.

All weigh a direction by Fresnel's term at its own microfacet and by Smith's masking, over the weight that the surface gives
its sharp mirror. A lobe never gives more than that weight: the layers below have only given up as much.
"""

from __future__ import annotations

import importlib

import warp as wp

from warp_reflect import shade
from warp_reflect.layers import ReflectionLayer
from warp_reflect.scene import Scene

BASE, COAT = 0, 1
# The module of each method, with `SAMPLES` and `radiance_of`.
METHODS = {
    "filter": "glossy_filter",
    "gather": "glossy_gather",
    "prefiltered": "glossy_prefiltered",
    "accumulate": "glossy_rays",
}


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
    method = importlib.import_module(f"warp_reflect.finishes.{METHODS[row.effects['roughness'].numbers['way']]}")
    return method.radiance_of(scene, shown, layer, sharp, row, which, row.settings.glossy_samples or method.SAMPLES)
