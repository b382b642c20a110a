"""The picture of what one surface shows while it is still, with how near that is: what waves are looked up in."""

from __future__ import annotations

import warp as wp

from warp_reflect import compact, launch, vector
from warp_reflect.layers import MirrorPixels
from warp_reflect.surface import bounds_box, bounds_of

wp.set_module_options({"enable_backward": False})

NOT_SEEN = wp.constant(-1.0)  # nearness of a texel that does not show the surface
LEAST_COSINE = wp.constant(1.0e-6)  # to the surface's normal: a distance along a ray as a distance from the surface


@wp.struct
class StillPicture:
    """Texels over the bounds of a surface's pixels and one more on every side, which do not show it.

    Attributes:
        texels: Radiance and nearness: 1 / distance from the surface's plane, 0 for the sky, `NOT_SEEN` with radiance 0.
        x0, y0: The frame's pixel that is the first texel.
        width, height: Of the texels.
        bounds: Where nothing is read those of the surface's pixels, on the device (`placed`). Of length 0: the others tell.
    """

    texels: wp.array(dtype=wp.vec4)
    x0: int
    y0: int
    width: int
    height: int
    bounds: wp.array(dtype=int)


@wp.func
def placed(picture: StillPicture) -> StillPicture:
    """A picture with its bounds, wherever these are."""
    result = StillPicture()
    result.texels = picture.texels
    result.x0 = picture.x0
    result.y0 = picture.y0
    result.width = picture.width
    result.height = picture.height
    if picture.bounds.shape[0] > 0:
        box = bounds_box(picture.bounds)
        result.x0 = box[0] - 1
        result.y0 = box[1] - 1
        result.width = box[2] - box[0] + 2
        result.height = box[3] - box[1] + 2
    return result


@wp.func
def look_up(picture: StillPicture, x: float, y: float) -> wp.vec4:
    """Bilinear look-up at a pixel coordinate of the frame: radiance times coverage, and coverage."""
    u = wp.clamp(x - 0.5 - float(picture.x0), 0.0, float(picture.width - 1))
    v = wp.clamp(y - 0.5 - float(picture.y0), 0.0, float(picture.height - 1))
    left = wp.min(int(u), picture.width - 2)
    top = wp.min(int(v), picture.height - 2)
    fx = u - float(left)
    fy = v - float(top)
    found = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for k in range(4):
        texel = picture.texels[(top + k // 2) * picture.width + left + k % 2]
        share = wp.where(k % 2 == 1, fx, 1.0 - fx) * wp.where(k // 2 == 1, fy, 1.0 - fy)
        found += share * wp.vec4(texel[0], texel[1], texel[2], wp.where(texel[3] >= 0.0, 1.0, 0.0))
    return found


@wp.func
def nearness_at(picture: StillPicture, x: float, y: float, otherwise: float) -> float:
    """Nearness of the nearest texel; `otherwise` where the surface is not seen there."""
    column = int(wp.clamp(x - float(picture.x0), 0.0, float(picture.width - 1)))
    row = int(wp.clamp(y - float(picture.y0), 0.0, float(picture.height - 1)))
    near = picture.texels[row * picture.width + column][3]
    return wp.where(near >= 0.0, near, otherwise)


@wp.kernel
def fill_kernel(
    first: int,
    image_width: int,
    nearness: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_picture: StillPicture,
):
    """One thread per pixel, but for the number -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    picture = placed(out_picture)
    near = float(0.0)
    if nearness.shape[0] > 0:
        near = nearness[i]
    elif triangle[i] >= 0 and distance[i] > 0.0:
        near = 1.0 / distance[i]
    near /= wp.max(wp.abs(wp.dot(direction[i], normal[i])), LEAST_COSINE)
    row = pixel[i] // image_width
    texel = (row - picture.y0) * picture.width + pixel[i] - row * image_width - picture.x0
    out_picture.texels[texel] = wp.vec4(radiance[i][0], radiance[i][1], radiance[i][2], near)


def make_picture(
    pixels: MirrorPixels,
    radiance: wp.array,
    image_width: int,
    nearness: wp.array | None = None,
    hits: tuple[wp.array, wp.array] | None = None,
    threads: int = 0,
    kernels: str = "auto",
) -> StillPicture:
    """The picture of what a surface's pixels see.

    Args:
        pixels: At which the surface is seen, one at least; their rays.
        radiance: vec3 [n], what those see.
        image_width: Of the frame. [pixels]
        nearness: float [n], 1 / distance along the rays, 0 for the sky; None: that of `hits`.
        hits: int32 [n] triangles, -1 none, and float [n] distances.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
    """
    device = radiance.device
    x0, y0, x1, y1 = pixels.box
    picture = StillPicture()
    picture.bounds = bounds_of(pixels, image_width) if pixels.everywhere else compact.none(int, device)
    picture.x0, picture.y0, picture.width, picture.height = x0 - 1, y0 - 1, x1 - x0 + 2, y1 - y0 + 2
    texels = wp.vec4(0.0, 0.0, 0.0, float(NOT_SEEN))
    picture.texels = wp.full(picture.width * picture.height, texels, dtype=wp.vec4, device=device)
    none = compact.none(float, device), compact.none(int, device)
    hits = hits or (none[1], none[0])
    inputs = [image_width, none[0] if nearness is None else nearness, *hits]
    inputs += [pixels.pixel, pixels.normal, pixels.direction, radiance, picture]
    if vector.chosen(kernels, device):
        from warp_reflect.finishes import water_vector  # which works with this module's structure

        vector.launch_blocks(water_vector.fill_blocks_kernel, pixels.count, inputs, device, threads)
    else:
        launch.launch(fill_kernel, pixels.count, inputs, device, threads)
    return picture
