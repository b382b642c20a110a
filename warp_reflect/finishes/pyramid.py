"""Pictures of what one surface shows, for finishes to look them up elsewhere than at the pixel itself, and wider than it."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import compact, launch
from warp_reflect.layers import MirrorPixels
from warp_reflect.surface import bounds_box, bounds_of

wp.set_module_options({"enable_backward": False})

TOLD = 6  # numbers of `Pyramid.told`


@wp.struct
class Pyramid:
    """Pictures over the bounds of a surface's pixels, each halved again and again; empty where the surface is not seen.

    Attributes:
        color: Radiance and coverage, multiplied by the latter; picture by picture, level by level.
        first: Texel at which each level starts.
        texels: Of one picture.
        told: Where nothing is read the other numbers, in their order; those are for the most that there can be (`placed`).
            Of length 0: they are these.
    """

    color: wp.array(dtype=wp.vec4)
    first: wp.array(dtype=int)
    texels: int
    x0: int
    y0: int
    width: int
    height: int
    levels: int
    told: wp.array(dtype=int)


@wp.func
def placed(pyramid: Pyramid) -> Pyramid:
    """Pictures with their bounds, wherever these are."""
    result = Pyramid()
    result.color = pyramid.color
    result.first = pyramid.first
    result.texels = pyramid.texels
    result.x0 = pyramid.x0
    result.y0 = pyramid.y0
    result.width = pyramid.width
    result.height = pyramid.height
    result.levels = pyramid.levels
    if pyramid.told.shape[0] > 0:
        result.texels = pyramid.told[0]
        result.x0 = pyramid.told[1]
        result.y0 = pyramid.told[2]
        result.width = pyramid.told[3]
        result.height = pyramid.told[4]
        result.levels = pyramid.told[5]
    return result


@wp.func
def texel_of(pyramid: Pyramid, pixel: int, image_width: int) -> int:
    """Texel of level 0 of a frame's pixel within the bounds."""
    row = pixel // image_width
    return (row - pyramid.y0) * pyramid.width + pixel - row * image_width - pyramid.x0


@wp.func
def level_size(size: int, level: int) -> int:
    """Texels along an edge that has `size` of them at level 0."""
    return wp.max((size + (1 << level) - 1) >> level, 1)


@wp.func
def level_of(pyramid: Pyramid, width: float) -> int:
    """Level whose texels are about as wide as a look-up of some pixels."""
    return wp.clamp(int(wp.log2(wp.max(width, 1.0)) + 0.5), 0, pyramid.levels - 1)


@wp.func
def look_up_level(pyramid: Pyramid, picture: int, x: float, y: float, level: int) -> wp.vec4:
    """Bilinear look-up of a picture's colour at a level; nothing beyond the bounds."""
    width = level_size(pyramid.width, level)
    height = level_size(pyramid.height, level)
    scale = 1.0 / float(1 << level)
    sx = x * scale - 0.5
    sy = y * scale - 0.5
    x0 = int(wp.floor(sx))
    y0 = int(wp.floor(sy))
    start = picture * pyramid.texels + pyramid.first[level]
    found = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(4):
        tx = x0 + k % 2
        ty = y0 + k // 2
        if tx >= 0 and ty >= 0 and tx < width and ty < height:
            share = (1.0 - wp.abs(sx - float(tx))) * (1.0 - wp.abs(sy - float(ty)))
            found += share * pyramid.color[start + ty * width + tx]
    return found


@wp.kernel
def measure_kernel(
    first: int,
    bounds: wp.array(dtype=int),
    most: int,
    # Outputs, see `Pyramid`:
    out_told: wp.array(dtype=int),
    out_first: wp.array(dtype=int),
):
    """One thread: as `empty_pyramid`, of pixels whose bounds are on the device; of so many levels at most."""
    box = bounds_box(bounds)
    i = first + wp.tid()
    out_told[i + 1] = box[0]
    out_told[i + 2] = box[1]
    width = wp.max(box[2] - box[0], 0)
    height = wp.max(box[3] - box[1], 0)
    out_told[i + 3] = width
    out_told[i + 4] = height
    level = int(0)
    texels = int(0)
    while level < most and (wp.max(width, height) >> level) > 0:
        out_first[level] = texels
        texels += level_size(width, level) * level_size(height, level)
        level += 1
    out_told[i + 5] = level
    out_told[i] = texels


@wp.kernel
def halve_kernel(first: int, level: int, pictures: int, pyramid: Pyramid):
    """One thread per texel of a level of all pictures: the mean of four of the level before."""
    i = first + wp.tid()
    out_pyramid = placed(pyramid)
    width = level_size(out_pyramid.width, level)
    count = width * level_size(out_pyramid.height, level)
    if level >= out_pyramid.levels or i >= pictures * count:
        return
    start = (i // count) * out_pyramid.texels
    texel = i % count
    y = texel // width
    x = texel - y * width
    finer_width = level_size(out_pyramid.width, level - 1)
    finer_height = level_size(out_pyramid.height, level - 1)
    color = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(4):
        fx = 2 * x + k % 2
        fy = 2 * y + k // 2
        if fx < finer_width and fy < finer_height:
            color += 0.25 * out_pyramid.color[start + out_pyramid.first[level - 1] + fy * finer_width + fx]
    out_pyramid.color[start + out_pyramid.first[level] + texel] = color


def empty_pyramid(pixels: MirrorPixels, device, pictures: int = 1, levels: int = 1, image_width: int = 0) -> Pyramid:
    """Room for pictures of a surface.

    Args:
        pixels: At which the surface is seen.
        device: Where.
        pictures: Number of them.
        levels: At most so many; 1: no halves.
        image_width: Of the frame. [pixels]
    """
    x0, y0, x1, y1 = pixels.box
    width, height = x1 - x0, y1 - y0
    levels = min(levels, max(width, height).bit_length())
    pyramid = Pyramid()
    pyramid.x0, pyramid.y0, pyramid.width, pyramid.height, pyramid.levels = x0, y0, width, height, levels
    sizes = [_level_texels(pyramid, level) for level in range(levels)]
    pyramid.texels = sum(sizes)
    pyramid.color = wp.zeros(pictures * pyramid.texels, dtype=wp.vec4, device=device)
    if not pixels.everywhere:
        pyramid.first = wp.array(np.cumsum([0, *sizes[:-1]]).astype(np.int32), dtype=int, device=device)
        pyramid.told = compact.none(int, device)
    else:
        pyramid.first, pyramid.told = (wp.empty(count, dtype=int, device=device) for count in (levels, TOLD))
        inputs = [bounds_of(pixels, image_width), levels, pyramid.told, pyramid.first]
        launch.launch(measure_kernel, 1, inputs, device)
    return pyramid


def halve(pyramid: Pyramid, pictures: int, device, threads: int = 0) -> None:
    """Fill the levels above the first."""
    for level in range(1, pyramid.levels):
        count = pictures * _level_texels(pyramid, level)
        launch.launch(halve_kernel, count, [level, pictures, pyramid], device, threads)


def _level_texels(pyramid: Pyramid, level: int) -> int:
    edges = (max((size + (1 << level) - 1) >> level, 1) for size in (pyramid.width, pyramid.height))
    return int(np.prod(list(edges)))
