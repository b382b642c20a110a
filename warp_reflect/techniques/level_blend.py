"""Simple blending where a mirror's local map takes another level of detail: no pixel jumps.

Source: Meyer and Loscos 2003, section 7, who leave it to future work. A pixel goes from what the level before shows towards
what the new one shows by at most so many grey levels a frame, of 255 in sRGB; both are looked up in every frame on the way, so
that what moves goes on moving. Levels taken before others are reached wait as far as they came.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch

wp.set_module_options({"enable_backward": False})

GREY = 1.0 / 255.0
# Of a step: roundings of the curves make no two levels of one.
STEP_SHARE = 0.99

# IEC 61966-2-1, continued beyond white.
LINEAR_END = wp.constant(0.0031308)
ENCODED_END = wp.constant(0.04045)
SLOPE = wp.constant(12.92)
GAMMA = wp.constant(2.4)

Levels = tuple[tuple[int, int], ...]  # (texels along an edge, frames since it was taken), the asked one last


@wp.func
def encoded(value: float) -> float:
    """A linear value in sRGB."""
    if value <= LINEAR_END:
        return SLOPE * value
    return 1.055 * wp.pow(value, 1.0 / GAMMA) - 0.055


@wp.func
def decoded(value: float) -> float:
    """Linear value of an sRGB one."""
    if value <= ENCODED_END:
        return value / SLOPE
    return wp.pow((value + 0.055) / 1.055, GAMMA)


@wp.kernel
def approach_kernel(
    first: int,
    before: wp.array(dtype=wp.vec3),
    reach: float,
    # Changed:
    out_radiance: wp.array(dtype=wp.vec3),
    out_open: wp.array(dtype=wp.uint8),
):
    """One thread per pixel: its radiance no farther from `before` than `reach` in sRGB; `out_open` 1 where that held it."""
    i = first + wp.tid()
    shown = out_radiance[i]
    held = int(0)
    for k in range(3):
        start = encoded(before[i][k])
        step = encoded(shown[k]) - start
        if wp.abs(step) > reach:
            shown[k] = decoded(start + wp.where(step > 0.0, reach, -reach))
            held = 1
    out_radiance[i] = shown
    out_open[i] = wp.uint8(held)


def advanced(before: Levels, resolution: int) -> Levels:
    """The levels of a frame, given those of the one before and the texels along an edge that are asked for now."""
    if not before or (len(before) == 1 and before[0][0] == resolution):
        return ((resolution, 0),)
    *others, (last, frames) = before
    if last == resolution:
        return (*others, (last, frames + 1))
    return (*before, (resolution, 1))


def approach(before: wp.array, radiance: wp.array, frames: int, step: float, threads: int = 0) -> bool:
    """Hold radiance back to what may be shown so many frames after a switch.

    Args:
        before: What is shown without it, vec3 [n].
        radiance: vec3 [n]; changed.
        frames: Since the switch, at least 1.
        step: Grey levels a frame, `Settings.local_blend`.
        threads: CPU threads; 0: one per core.

    Returns:
        Whether any of it was held back.
    """
    device = radiance.device
    held = wp.zeros(len(radiance), dtype=wp.uint8, device=device)
    reach = frames * step * STEP_SHARE * GREY
    launch.launch(approach_kernel, len(radiance), [before, reach, radiance, held], device, threads)
    return bool(held.numpy().any())
