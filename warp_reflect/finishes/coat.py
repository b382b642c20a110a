"""A clear coat: a second mirror over the base, each with its own roughness.

Source of the weights: the UsdPreviewSurface specification, as `shade.split_lobes` has them: the coat reflects Fresnel's share of
an index of 1.5 (`clearcoat` times), the base what that leaves. What both see is mixed by their weights at the pixel; where both
are equally smooth the sharp picture serves both, and nothing of this runs.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch, shade
from warp_reflect.finishes import bumps, glossy, water
from warp_reflect.layers import ReflectionLayer
from warp_reflect.scene import Scene, SceneView
from warp_reflect.shade import schlick
from warp_reflect.surface import shown_normal
from warp_reflect.textures import Look, plain_look

wp.set_module_options({"enable_backward": False})

LEAST_WEIGHT = wp.constant(1.0e-6)  # of both together: below it nothing of the mixture is seen


@wp.kernel
def mix_coat_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    base: wp.array(dtype=wp.vec3),
    coat: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel, but for the number -1."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        return
    look = Look()
    if looks.shape[0] > 0:
        look = looks[p]
    else:
        look = plain_look(scene, triangle[p], 1.0 / 3.0, 1.0 / 3.0)
    incident = direction[i] - 2.0 * wp.dot(direction[i], normal[i]) * normal[i]
    cosine = wp.abs(wp.dot(incident, shown_normal(normals, p, normal[i])))
    f0 = look.clearcoat_f0
    upper = look.clearcoat * schlick(wp.vec3(f0, f0, f0), wp.vec3(1.0, 1.0, 1.0), cosine)[0]
    lower = (1.0 - upper) * schlick(look.f0, look.f90, cosine)
    for c in range(3):
        total = upper + lower[c]
        share = float(1.0)
        if total > LEAST_WEIGHT:
            share = upper / total
        out_radiance[i][c] = share * coat[i][c] + (1.0 - share) * base[i][c]


def apply(
    scene: Scene, shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array, radiance: wp.array, row
) -> wp.array:
    """What base and coat of a mirror see together, see `finishes`."""
    pixels, settings, device = layer.pixels, row.settings, scene.device
    if row.effects["clearcoat"].numbers["roughness"] > settings.glossy_min_roughness:
        coat = glossy.lobe_radiance(scene, shown, layer, sharp, row, glossy.COAT)
    elif row.effects["waves"].on:
        coat = water.turned_radiance(scene, shown, layer, sharp, row)
    elif row.effects["normal_map"].on:
        coat = bumps.turned_radiance(scene, shown, layer, sharp, row)
    else:
        coat = sharp
    mixed = wp.empty(pixels.count, dtype=wp.vec3, device=device)
    inputs = [scene.view, shown.looks, shown.normals, shown.gbuffer.triangle, pixels.pixel, pixels.normal]
    launch.launch(
        mix_coat_kernel, pixels.count, [*inputs, pixels.direction, radiance, coat, mixed], device, settings.threads
    )
    return mixed
