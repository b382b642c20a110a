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

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.layers import CameraView, GBuffer, eye_ray_direction
from warp_reflect.scene import FinishData, PartRange, Scene, SceneView
from warp_reflect.shapes import unit
from warp_reflect.surface import shown_normal, surface_at

wp.set_module_options({"enable_backward": False})

WAVE_COUNT = 12  # sines of a surface: fewer repeat visibly
OCTAVES = 3.0  # from the longest to the shortest
SPREAD = math.radians(75.0)  # of the directions to either side
GOLDEN = 0.6180339887498949  # multiples of it, without their whole parts, fill an interval evenly
# Cosine to the viewer that a turned normal keeps: it must not show a surface its own back.
LEAST_FACING = wp.constant(0.02)
BOX_VARIANCE = wp.constant(1.0 / 12.0)  # of a pixel of width 1


@wp.struct
class Wave:
    """One sine."""

    vector: wp.vec3  # along its way, in the plane [radians per scene unit]
    phase: float  # at the scene's origin
    slope: float  # largest


def waves_of(scene: Scene, part: PartRange, finish: FinishData) -> list[Wave]:
    """The waves of a flat part at the scene's time."""
    data = scene.data
    seconds = (data.time or 0.0) / data.time_codes_per_second
    first, across = _axes(_normal(scene, part))
    number = np.arange(WAVE_COUNT)
    length = finish.wave_length * 2.0 ** (-OCTAVES * number / (WAVE_COUNT - 1))
    angle = SPREAD * (2.0 * np.mod(GOLDEN * (number + 1), 1.0) - 1.0)
    k = (2.0 * math.pi / length)[:, None] * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * across)
    speed = finish.wave_speed * np.sqrt(length / finish.wave_length)
    start = 2.0 * math.pi * np.mod(GOLDEN * (number + 1) ** 2, 1.0)
    # Whole turns are taken off in float64: neither a late time nor a far origin may cost digits.
    phase = np.mod(k @ scene.origin - 2.0 * math.pi * np.mod(speed * seconds / length, 1.0) + start, 2.0 * math.pi)
    waves = []
    for j in number:
        wave = Wave()
        wave.vector, wave.phase = wp.vec3(*k[j]), float(phase[j])
        # The mean square of a sine is 1/2 of its largest.
        wave.slope = finish.wave_slope * math.sqrt(2.0 / WAVE_COUNT)
        waves.append(wave)
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
    camera: CameraView,
    waves: wp.array(dtype=Wave),
    patch_waves: wp.array(dtype=int),
    count: int,
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    normals: wp.array(dtype=wp.vec3),
    out_normals: wp.array(dtype=wp.vec3),
):
    """One thread per pixel."""
    i = first + wp.tid()
    if normals.shape[0] > 0:
        out_normals[i] = normals[i]
    tri = triangle[i]
    if tri < 0:
        return
    start = patch_waves[scene.triangle_patch[tri]]
    if start < 0:
        return
    row = i // camera.width
    x = float(i - row * camera.width) + 0.5
    y = float(row) + 0.5
    s = surface_at(scene, camera, tri, depth_key[i], x, y)
    # How the point moves over the surface from pixel to pixel.
    d = eye_ray_direction(camera, x, y)
    facing = wp.dot(s.normal, d)
    step_x = camera.ray_dx
    step_y = camera.ray_dy
    if camera.orthographic == 0:
        depth = wp.dot(camera.forward, s.p_eye)
        step_x = depth * step_x
        step_y = depth * step_y
    step_x -= (wp.dot(s.normal, step_x) / facing) * d
    step_y -= (wp.dot(s.normal, step_y) / facing) * d
    tilt = wp.vec3(0.0, 0.0, 0.0)
    for j in range(count):
        wave = waves[start + j]
        along_x = wp.dot(wave.vector, step_x)
        along_y = wp.dot(wave.vector, step_y)
        resolved = wp.exp(-0.5 * BOX_VARIANCE * (along_x * along_x + along_y * along_y))
        slope = resolved * wave.slope * wp.cos(wp.dot(wave.vector, s.p_scene) + wave.phase)
        tilt += slope * unit(wave.vector)
    # The waves' own normal is that of the triangle's winding; from the other side crests are troughs.
    corner = scene.triangles[tri]
    outward = wp.cross(
        scene.points[corner[1]] - scene.points[corner[0]], scene.points[corner[2]] - scene.points[corner[0]]
    )
    if wp.dot(outward, s.normal) < 0.0:
        tilt = -tilt
    n = unit(shown_normal(normals, i, s.normal) - tilt)
    toward = -wp.dot(n, s.incident)
    if toward < LEAST_FACING:
        n = unit(n + (toward - LEAST_FACING) * s.incident)
    out_normals[i] = n


def wave_normals(
    scene: Scene, gbuffer: GBuffer, normals: wp.array, finishes: Mapping[int, FinishData], threads: int = 0
) -> wp.array:
    """Normals of what the eye sees with the waves of some parts.

    Args:
        scene: On the G-buffer's device; its time is the waves'.
        gbuffer: What the eye sees.
        normals: Those that normal maps give, see `normal_maps.prepare_normals`; waves come on top of them.
        finishes: Part to what is asked of it.
        threads: CPU threads; 0: one per core.

    Returns:
        vec3 [pixels], unit towards the eye, 0 where the surface's own normal counts.
    """
    device = scene.device
    waves: list[Wave] = []
    patch_waves = np.full(max(len(scene.patch_shapes), 1), -1, np.int32)
    for index, finish in finishes.items():
        patch_waves[list(scene.parts[index].patches)] = len(waves)
        waves += waves_of(scene, scene.parts[index], finish)
    bent = wp.zeros(len(gbuffer.triangle), dtype=wp.vec3, device=device)
    inputs = [scene.view, gbuffer.view, wp.array(waves, dtype=Wave, device=device)]
    inputs += [wp.array(patch_waves, dtype=int, device=device), WAVE_COUNT, gbuffer.triangle, gbuffer.depth_key]
    launch.launch(wave_normals_kernel, len(bent), [*inputs, normals, bent], device, threads)
    return bent
