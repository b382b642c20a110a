"""Frosted glass: what is behind it is blurred by its distance.

`frost_samples` > 0 averages so many rays of the cone into which the surface scatters: the reference, and the accumulation of
jittered pictures of Diefenbach and Badler, Multi-Pass Pipeline Rendering, I3D 1997, as told in Real-Time Rendering, 3rd
edition, section 9.3.1. 0 looks the cone's directions up in the picture of what one would see through clear glass, as the
faster way there does. Differs from it by: the picture is divided by distance into octaves of the cone's radius, each of which is
blurred by its own and laid over what is behind it, so that what touches the glass stays sharp before a blurred background.
What that picture lacks, above all what a cone sees past the surface's own outline, a few rays of every pixel know
(`frost_rays`): by what they see on average beside it in the pixels around one, the blurred picture is corrected.
"""

from __future__ import annotations

import math

import warp as wp

from warp_reflect import compact, launch
from warp_reflect.finishes.pyramid import Pyramid, empty_pyramid, halve, level_of, look_up_level, placed, texel_of
from warp_reflect.layers import CameraView
from warp_reflect.scene import Scene
from warp_reflect.transmission import (
    Through,
    Transmission,
    disc_sample,
    look_through,
    through_radiance,
)

wp.set_module_options({"enable_backward": False})

LOOK_UPS = 12  # of an octave
OCTAVES = wp.constant(7)  # of the cone's radius; what is nearer than the last is blurred as that
SHARPEST = wp.constant(0.5)  # pixels: a smaller disc is the pixel itself
# Of the cone's radius, over which the correction by rays is the mean: a few hundred pixels leave little grain of wide cones.
CORRECTED = 0.25
LEAST_COVERAGE = wp.constant(1.0e-3)  # of a cone: below it there is nothing to mix


@wp.func
def radius_at(spread_px: float, depth: float, nearness: float, camera: CameraView, pyramid: Pyramid) -> float:
    """Radius in pixels of the cone's picture at a distance behind the surface.

    Args:
        spread_px: Of what is infinitely far; orthographic: per scene unit of distance.
        depth: From the eye to the surface.
        nearness: 1 / distance behind the surface.
        camera: An orthographic one sees a cone grow without end.
        pyramid: The pictures that are blurred.
    """
    if camera.orthographic != 0:
        most = float(pyramid.width + pyramid.height)
        return most * spread_px / (spread_px + most * nearness)
    return spread_px / (1.0 + depth * nearness)


@wp.kernel
def divide_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    nearness: wp.array(dtype=float),
    radiance: wp.array(dtype=wp.vec3),
    spread_px: float,
    pyramid: Pyramid,
):
    """One thread per pixel, but for the number -1: its share in the pictures of the octaves next to its own distance."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    out_pyramid = placed(pyramid)
    texel = texel_of(out_pyramid, pixel[i], camera[0].width)
    depth = wp.length(point[i] - camera[0].eye)
    widest = radius_at(spread_px, depth, 0.0, camera[0], out_pyramid)
    radius = radius_at(spread_px, depth, nearness[i], camera[0], out_pyramid)
    octave = wp.clamp(wp.log2(wp.max(radius / widest, 1.0e-6)) + float(OCTAVES - 1), 0.0, float(OCTAVES - 1))
    nearer = wp.min(int(octave), OCTAVES - 2)
    # So that the two discs' mean has the variance of the radius between theirs.
    least = widest * wp.pow(2.0, float(nearer + 1 - OCTAVES))
    share = wp.clamp((radius * radius / (least * least) - 1.0) / 3.0, 0.0, 1.0)
    color = wp.vec4(radiance[i][0], radiance[i][1], radiance[i][2], 1.0)
    out_pyramid.color[nearer * out_pyramid.texels + texel] = (1.0 - share) * color
    out_pyramid.color[(nearer + 1) * out_pyramid.texels + texel] = share * color


@wp.kernel
def frost_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pictures: Pyramid,
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    spread_px: float,
    count: int,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per pixel: the means of the octaves over their own discs, the nearest in front.

    The mean of a picture's coverage over the disc that is the cone's at that distance is the share of the cone that it covers.
    Nothing where the pixel's number is -1.
    """
    i = first + wp.tid()
    if pixel[i] < 0:
        out_radiance[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    pyramid = placed(pictures)
    row = pixel[i] // camera[0].width
    x = float(pixel[i] - row * camera[0].width - pyramid.x0) + 0.5
    y = float(row - pyramid.y0) + 0.5
    depth = wp.length(point[i] - camera[0].eye)
    widest = radius_at(spread_px, depth, 0.0, camera[0], pyramid)
    mixed = wp.vec3(0.0, 0.0, 0.0)
    left = float(1.0)
    for b in range(OCTAVES):
        radius = widest * wp.pow(2.0, float(b + 1 - OCTAVES))
        level = level_of(pyramid, radius * wp.sqrt(3.0 / float(count)))
        # A texel's square and the tent of its look-up have the variance of a disc of this radius, which is not added twice.
        texel = wp.where(level > 0, float(1 << level), 0.0)
        within = wp.sqrt(wp.max(radius * radius - texel * texel, 0.0))
        total = wp.vec4(0.0, 0.0, 0.0, 0.0)
        if radius < SHARPEST:
            total = look_up_level(pyramid, b, x, y, 0)
        else:
            for k in range(count // 2):
                # The same for every pixel: neighbours differ by what they show only, and nothing is grainy. In pairs about
                # the pixel: nothing is shifted.
                disc = within * disc_sample(b, k, count // 2)
                total += look_up_level(pyramid, b, x + disc[0], y + disc[1], level)
                total += look_up_level(pyramid, b, x - disc[0], y - disc[1], level)
            total /= float(2 * (count // 2))
        if total[3] > LEAST_COVERAGE:
            taken = wp.min(total[3], left)
            mixed += (taken / total[3]) * wp.vec3(total[0], total[1], total[2])
            left -= taken
    out_radiance[i] = radiance[i]
    if left < 1.0 - LEAST_COVERAGE:
        out_radiance[i] = mixed / (1.0 - left)


@wp.kernel
def mean_kernel(
    first: int,
    count: int,
    pixel: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per pixel, but for the number -1: adds one of `count` rays' share to the mean."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    out_radiance[i] += radiance[i] / float(count)


@wp.kernel
def missed_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pixel: wp.array(dtype=int),
    blurry: wp.array(dtype=wp.vec3),
    rays: wp.array(dtype=wp.vec3),
    pyramid: Pyramid,
):
    """One thread per pixel, but for the number -1: what its rays see beside the blurred picture."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    out_pyramid = placed(pyramid)
    missed = rays[i] - blurry[i]
    out_pyramid.color[texel_of(out_pyramid, pixel[i], camera[0].width)] = wp.vec4(missed[0], missed[1], missed[2], 1.0)


@wp.kernel
def correct_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pictures: Pyramid,
    pixel: wp.array(dtype=int),
    blurry: wp.array(dtype=wp.vec3),
    radius: float,
    count: int,
    brightest_blurry: wp.array(dtype=wp.vec3),
    brightest_ray: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per pixel, but for the number -1.

    Adds the mean of what is missed over a disc around it, between black and the brightest.
    """
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    missed = placed(pictures)
    row = pixel[i] // camera[0].width
    x = float(pixel[i] - row * camera[0].width - missed.x0) + 0.5
    y = float(row - missed.y0) + 0.5
    level = level_of(missed, radius * wp.sqrt(3.0 / float(count)))
    total = look_up_level(missed, 0, x, y, level)
    for k in range(count // 2):
        disc = radius * disc_sample(0, k, count // 2)
        total += look_up_level(missed, 0, x + disc[0], y + disc[1], level)
        total += look_up_level(missed, 0, x - disc[0], y - disc[1], level)
    out_radiance[i] = blurry[i]
    if total[3] > LEAST_COVERAGE:
        corrected = blurry[i] + wp.vec3(total[0], total[1], total[2]) / total[3]
        brightest = wp.max(brightest_blurry[0], brightest_ray[0])
        out_radiance[i] = wp.min(wp.max(corrected, wp.vec3(0.0, 0.0, 0.0)), brightest)


def apply_through(scene: Scene, through: Through, found: Transmission, radiance: wp.array, pane) -> wp.array:
    """What a frosted surface's pixels see behind it, see `finishes`."""
    samples = pane.settings.frost_samples
    if samples:
        return accumulated(scene, through, found, pane, samples)
    blurry = blurred(scene, through, found, radiance, pane)
    if not pane.settings.frost_rays:
        return blurry
    rays = accumulated(scene, through, found, pane, pane.settings.frost_rays)
    return corrected(scene, through, found, blurry, rays, pane)


def accumulated(scene: Scene, through: Through, found: Transmission, pane, samples: int) -> wp.array:
    """The mean over `samples` rays a pixel."""
    n = found.surface.count
    total = wp.zeros(n, dtype=wp.vec3, device=scene.device)
    for k in range(samples):
        ray = look_through(scene, through.shown, through.interfaces, found.surface, pane.settings, (k, samples))
        seen = through_radiance(scene, through, ray, pane.settings)
        inputs = [samples, found.surface.pixel, seen, total]
        launch.launch(mean_kernel, n, inputs, scene.device, pane.settings.threads)
    return total


def blurred(scene: Scene, through: Through, found: Transmission, radiance: wp.array, pane) -> wp.array:
    """From the picture behind clear glass."""
    pixels, threads, device = found.layer.pixels, pane.settings.threads, scene.device
    view = through.shown.gbuffer.view
    spread_px = pane.effects["frost"].numbers["radius_px"]
    levels = max(int(math.log2(max(spread_px, 1.0))) + 1, 1)
    pyramid = empty_pyramid(pixels, device, int(OCTAVES), levels, through.shown.gbuffer.camera.size[0])
    inputs = [view, pixels.pixel, pixels.point, found.nearness, radiance, spread_px, pyramid]
    launch.launch(divide_kernel, pixels.count, inputs, device, threads)
    halve(pyramid, int(OCTAVES), device, threads)
    blurry = wp.empty(pixels.count, dtype=wp.vec3, device=device)
    inputs = [view, pyramid, pixels.pixel, pixels.point, radiance, spread_px, LOOK_UPS, blurry]
    launch.launch(frost_kernel, pixels.count, inputs, device, threads)
    return blurry


def corrected(scene: Scene, through: Through, found: Transmission, blurry: wp.array, rays: wp.array, pane) -> wp.array:
    """The blurred picture with what it lacks on average beside a few rays a pixel."""
    pixels, threads, device = found.layer.pixels, pane.settings.threads, scene.device
    view = through.shown.gbuffer.view
    radius = CORRECTED * pane.effects["frost"].numbers["radius_px"]
    levels = max(int(math.log2(max(radius, 1.0))) + 1, 1)
    missed = empty_pyramid(pixels, device, 1, levels, through.shown.gbuffer.camera.size[0])
    launch.launch(missed_kernel, pixels.count, [view, pixels.pixel, blurry, rays, missed], device, threads)
    halve(missed, 1, device, threads)
    # Nothing sends out more than there is to be seen.
    brightest = compact.largest(blurry), compact.largest(rays)
    radiance = wp.empty(pixels.count, dtype=wp.vec3, device=device)
    inputs = [view, missed, pixels.pixel, blurry, radius, LOOK_UPS, *brightest, radiance]
    launch.launch(correct_kernel, pixels.count, inputs, device, threads)
    return radiance
