"""Rough mirrors from rays of the lobe that are followed through the BVH, what they meet shaded: the reference.

Source: Diefenbach and Badler, Multi-Pass Pipeline Rendering, I3D 1997, as told in Real-Time Rendering, 3rd edition, section
9.3.1: the accumulation of jittered pictures. Differs from it by: the normal is jittered instead of the objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import warp as wp

from warp_reflect import bvh, launch
from warp_reflect.finishes.lobe import (
    even_shift,
    eye_side,
    lattice_point,
    lobe_sample,
    outward,
    share_of_weight,
    surface_lobe,
)
from warp_reflect.layers import ReflectionLayer
from warp_reflect.scene import SceneView
from warp_reflect.shade import schlick
from warp_reflect.surface import shown_normal
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

SAMPLES = 256  # rays a pixel


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
    image_width: int,
    k: int,
    count: int,
    coat: int,
    # Outputs:
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_weight: wp.array(dtype=wp.vec3),
    out_density: wp.array(dtype=float),
):
    """One thread per mirror pixel; a ray without weight or direction where the number is -1."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        out_normal[i] = wp.vec3(0.0, 0.0, 0.0)
        out_direction[i] = wp.vec3(0.0, 0.0, 0.0)
        out_weight[i] = wp.vec3(0.0, 0.0, 0.0)
        out_density[i] = 0.0
        return
    view = eye_side(direction[i], normal[i])
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    shift = even_shift(p % image_width, p // image_width)
    sample = lobe_sample(lobe.alpha, n, view, lattice_point(k, count, shift))
    weight = sample.weight * schlick(lobe.f0, lobe.f90, sample.cosine)
    density = float(0.0)
    if sample.solid_angle > 0.0:
        density = 1.0 / sample.solid_angle
    turned = outward(sample.direction, normal[i])
    half = turned + view
    if sample.weight <= 0.0 or wp.dot(turned, normal[i]) <= 0.0:
        # Not followed for its own sake; the sharp ray is as good as any.
        weight = wp.vec3(0.0, 0.0, 0.0)
        density = float(0.0)
        turned = direction[i]
        half = normal[i]
    out_weight[i] = weight
    out_density[i] = density
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
    """One thread per mirror pixel, but for the number -1."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        return
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    cosine = wp.dot(eye_side(direction[i], normal[i]), n)
    out_radiance[i] = share_of_weight(lobe, cosine, total[i] / float(count), seen[i], total[i])


@dataclass(frozen=True)
class Rays:
    """One ray of every mirror pixel.

    Attributes:
        weight: vec3 [n], of the lobe over the density that the ray was drawn from; 0 where none was.
        density: float32 [n], that one. [1/sr]
        answer: What the rays meet; its pixels have their directions.
        radiance: vec3 [n], what they see.
    """

    weight: wp.array
    density: wp.array
    answer: ReflectionLayer
    radiance: wp.array


def followed(scene, shown, layer, row, which: int, count: int) -> Iterator[Rays]:
    """`count` rays of every pixel, one after the other; weights, densities and directions are the same arrays each time."""
    pixels, threads, device = layer.pixels, row.settings.threads, scene.device
    n = pixels.count
    normal, direction, weight = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(3))
    density = wp.empty(n, dtype=float, device=device)
    turned = pixels.turned(direction, normal)
    surface, reflector, width = surface_of(scene, shown, layer), row.reflector, shown.gbuffer.camera.size[0]
    for k in range(count):
        outputs = [normal, direction, weight, density]
        launch.launch(jitter_kernel, n, [*surface, width, k, count, which, *outputs], device, threads)
        answer = ReflectionLayer.unset(turned, layer.method, device)
        how = {"threads": threads, "kernels": row.settings.kernels}
        bvh.trace_pixels(scene, shown.gbuffer, turned, answer, reflector.part, reflector.convex, **how)
        yield Rays(weight, density, answer, shown.seen(answer))


def surface_of(scene, shown, layer) -> list:
    """The arguments of a kernel that say what lobe a mirror pixel has."""
    pixels = layer.pixels
    seen = [scene.view, shown.looks, shown.normals, shown.gbuffer.triangle]
    return [*seen, pixels.pixel, pixels.normal, pixels.direction]


def add(rays: Rays, seen: wp.array, total: wp.array, device, threads: int) -> None:
    """Add a ray of every pixel to the sums of what they see, by their weights, and of these, vec3 [n] each."""
    launch.launch(accumulate_kernel, len(seen), [rays.weight, rays.radiance, seen, total], device, threads)


def radiance_of(scene, shown, layer, sharp, row, which: int, count: int) -> wp.array:
    """`glossy.lobe_radiance` from `count` rays a pixel."""
    threads, device, n = row.settings.threads, scene.device, layer.pixels.count
    seen, total = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
    for rays in followed(scene, shown, layer, row, which, count):
        add(rays, seen, total, device, threads)
    radiance = wp.empty(n, dtype=wp.vec3, device=device)
    inputs = [*surface_of(scene, shown, layer), which, count, seen, total, radiance]
    launch.launch(settle_kernel, n, inputs, device, threads)
    return radiance
