"""Waves on flat surfaces: the normals that they give to what the eye sees, at the time of the scene.

A sum of sines over three octaves, each with the same share of the slopes' variance, spread about one direction, at the
speeds of deep water. Source of the speeds: Tessendorf, Simulating Ocean Water, SIGGRAPH course notes 2001, equation 14
(omega^2 = g k); of the sum: section 4.1 there, Gerstner's waves without their sideways motion. Differs from it by: no
spectrum of a wind, but the slope, the length and the speed that are asked for. The surface stays flat: only its normals move,
as those of the normal map of McTaggart's water do. A wave that pixels do not resolve is left out by its share of a pixel's mean.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
import warp as wp

from warp_reflect import launch, vector
from warp_reflect.layers import CameraView, GBuffer, MirrorPixels, eye_ray_direction
from warp_reflect.scene import FinishData, PartRange, Scene, SceneView
from warp_reflect.shapes import facet_normal, unit
from warp_reflect.surface import shown_normal

wp.set_module_options({"enable_backward": False})

WAVE_COUNT = 8  # sines of a surface: fewer repeat visibly, more are not told from these
OCTAVES = 3.0  # from the longest to the shortest
SPREAD = math.radians(75.0)  # of the directions to either side
GOLDEN = 0.6180339887498949  # multiples of it, without their whole parts, fill an interval evenly
# Cosine to the viewer that a turned normal keeps: it must not show a surface its own back.
LEAST_FACING = wp.constant(0.02)
# Exponents of a wave's share of a pixel's mean: above the first it is nothing, below the second it is all.
LEAST_SEEN = wp.constant(7.0)
MOST_SEEN = wp.constant(1.0e-3)
BOX_EXPONENT = wp.constant(0.5 * (2.0 * math.pi) ** 2 / 12.0)  # of a wave over a pixel, whose width has variance 1/12
# Through p(1/4) = 1, p'(0) = 2 pi, p'(1/4) = 0.
SINE_1 = wp.constant(2.0 * math.pi)
SINE_3 = wp.constant(160.0 - 64.0 * math.pi)
SINE_5 = wp.constant(512.0 * math.pi - 1536.0)


@wp.struct
class Wave:
    """One sine."""

    way: wp.vec3  # unit, in the plane
    turns: float  # per scene unit
    phase: float  # at the scene's origin [turns]
    slope: float  # largest


@wp.func
def turn_sine(turns: float) -> float:
    """Sine of an angle in turns, to 4e-4: waves need no more, and it takes a fourth of the time.

    The odd polynomial of degree 5 that has the sine's values and slopes at 0 and at a quarter turn.
    """
    t = turns - wp.floor(turns + 0.5)
    if wp.abs(t) > 0.25:
        t = wp.sign(t) * 0.5 - t
    square = t * t
    return t * (SINE_1 + square * (SINE_3 + square * SINE_5))


def waves_of(scene: Scene, part: PartRange, finish: FinishData) -> np.ndarray:
    """The waves of a flat part at the scene's time, `Wave` [WAVE_COUNT]."""
    data = scene.data
    seconds = (data.time or 0.0) / data.time_codes_per_second
    first, across = _axes(_normal(scene, part))
    number = np.arange(WAVE_COUNT)
    length = finish.wave_length * 2.0 ** (-OCTAVES * number / (WAVE_COUNT - 1))
    angle = SPREAD * (2.0 * np.mod(GOLDEN * (number + 1), 1.0) - 1.0)
    way = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * across
    speed = finish.wave_speed * np.sqrt(length / finish.wave_length)
    # Whole turns are taken off in float64: neither a late time nor a far origin may cost digits.
    turns = (way @ scene.origin - np.mod(speed * seconds, length)) / length
    phase = np.mod(turns + GOLDEN * (number + 1) ** 2, 1.0)
    waves = np.zeros(WAVE_COUNT, Wave.numpy_dtype())
    # The mean square of a sine is 1/2 of its largest.
    waves["slope"] = finish.wave_slope * math.sqrt(2.0 / WAVE_COUNT)
    waves["way"], waves["turns"], waves["phase"] = way, 1.0 / length, phase
    return waves


def _normal(scene: Scene, part: PartRange) -> np.ndarray:
    corners = scene.host_points[scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]]
    corners = corners.astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(axis=0)
    length = np.linalg.norm(normal)
    return normal / length if length > 0.0 else np.array([0.0, 1.0, 0.0])


def _axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors of a plane, the same whichever way round it is wound."""
    helper = np.eye(3)[np.abs(normal).argmin()]
    first = helper - (helper @ normal) * normal
    first /= np.linalg.norm(first)
    across = np.cross(first, normal if normal[np.abs(normal).argmax()] > 0.0 else -normal)
    return first, across


@wp.kernel
def wave_normals_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    waves: wp.array(dtype=Wave),
    triangle: wp.array(dtype=int),
    # Pixels that show the waves:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    out_normals: wp.array(dtype=wp.vec3),
):
    """One thread per pixel, but for the number -1; finds what normal maps give in `out_normals`."""
    k = first + wp.tid()
    i = pixel[k]
    if i < 0:
        return
    corner = scene.triangles[triangle[i]]
    outward = facet_normal(scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]])
    row = i // camera[0].width
    d = eye_ray_direction(camera[0], float(i - row * camera[0].width) + 0.5, float(row) + 0.5)
    facing = wp.dot(outward, d)
    if facing == 0.0:
        return
    p = point[k]
    n = normal[k]
    # How the point moves over the surface from pixel to pixel.
    step_x = camera[0].ray_dx
    step_y = camera[0].ray_dy
    if camera[0].orthographic == 0:
        depth = wp.dot(camera[0].forward, p - camera[0].eye)
        step_x = depth * step_x
        step_y = depth * step_y
    step_x -= (wp.dot(outward, step_x) / facing) * d
    step_y -= (wp.dot(outward, step_y) / facing) * d
    tilt = wp.vec3(0.0, 0.0, 0.0)
    for j in range(waves.shape[0]):
        wave = waves[j]
        along_x = wp.dot(wave.way, step_x)
        along_y = wp.dot(wave.way, step_y)
        unseen = BOX_EXPONENT * wave.turns * wave.turns * (along_x * along_x + along_y * along_y)
        if unseen < LEAST_SEEN:
            slope = wave.slope * turn_sine(wave.turns * wp.dot(wave.way, p) + wave.phase)
            if unseen > MOST_SEEN:
                slope *= wp.exp(-unseen)
            tilt += slope * wave.way
    # The waves' own normal is that of the triangle's winding; from the other side crests are troughs.
    if facing > 0.0:
        tilt = -tilt
    # Slopes add up: a normal map's normal counts by what it has across for a unit along the surface's.
    mapped = shown_normal(out_normals, i, n)
    rise = wp.max(wp.dot(mapped, n), LEAST_FACING)
    turned = unit(mapped / rise - tilt)
    incident = unit(d)
    toward = -wp.dot(turned, incident)
    if toward < LEAST_FACING:
        turned = unit(turned + (toward - LEAST_FACING) * incident)
    out_normals[i] = turned


def _waves(scene: Scene, part: int, finish: FinishData) -> wp.array:
    return wp.array(waves_of(scene, scene.parts[part], finish), dtype=Wave, device=scene.device)


def wave_normals(
    scene: Scene,
    gbuffer: GBuffer,
    normals: wp.array,
    finishes: Mapping[int, FinishData],
    pixels: Mapping[int, MirrorPixels],
    threads: int = 0,
    kernels: str = "auto",
) -> wp.array:
    """Normals of what the eye sees with the waves of some parts.

    Args:
        scene: On the G-buffer's device; its time is the waves'.
        gbuffer: What the eye sees.
        normals: Those that normal maps give, see `normal_maps.prepare_normals`; the slopes of the waves are added to theirs.
        finishes: Part to what is asked of it.
        pixels: At which the eye sees them, from `surface.part_pixels`; a part that it does not see may be missing.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Returns:
        vec3 [pixels of the G-buffer], unit towards the eye, 0 where the surface's own normal counts.
    """
    device = scene.device
    asked = {part: finish for part, finish in finishes.items() if part in pixels}
    if not asked:
        return normals
    bent = wp.clone(normals) if len(normals) else wp.zeros(len(gbuffer.triangle), dtype=wp.vec3, device=device)
    for part, finish in asked.items():
        seen = pixels[part]
        asked_at = finish, scene.data.time
        waves = scene.kept(f"waves of {part}", asked_at, partial(_waves, scene, part, finish))
        inputs = [gbuffer.view, waves, gbuffer.triangle, seen.pixel, seen.point, seen.normal, bent]
        if vector.chosen(kernels, device):
            from warp_reflect import waves_vector  # which works with this module's structure

            limits = [LEAST_FACING, LEAST_SEEN, MOST_SEEN, BOX_EXPONENT, SINE_1, SINE_3, SINE_5]
            inputs = [scene.triangle_records, *limits, *inputs]
            vector.launch_blocks(waves_vector.wave_blocks_kernel, seen.count, inputs, device, threads)
        else:
            launch.launch(wave_normals_kernel, seen.count, [scene.view, *inputs], device, threads)
    return bent
