"""Cut-outs: where a texture's opacity is below a material's threshold, its surface is not there, for eyes, rays and shadows.

The test is the renderer-independent one of UsdPreviewSurface: a point is a hole where scale * texel + bias < threshold, the
texel bilinear in the picture's finest level (at most `pictures.SIDE_MAX` a side). It is asked of all that eyes, reflected rays
and shadow rays meet, which go on behind a hole (`holes`, `cut_shadows`), so that all ways to see a point agree; nothing is
filtered, and a leaf smaller than a pixel is there or not. Scenes without cut-outs hold no table, and nothing is asked.

A floor below `scene`, which keeps the table for every kernel.
"""

from __future__ import annotations

import numpy as np
import warp as wp

wp.set_module_options({"enable_backward": False})

WRAP_REPEAT = wp.constant(0)
WRAP_CLAMP = wp.constant(1)
WRAP_MIRROR = wp.constant(2)
WRAP_BLACK = wp.constant(3)
# A wrap mode in the file's metadata is not looked for: repeat is what exporters that write none mean.
WRAPS = {"useMetadata": 0, "repeat": 0, "clamp": 1, "mirror": 2, "black": 3}


@wp.struct
class CutView:
    """One use of an opacity picture: a hole where scale * texel + bias < threshold."""

    first_texel: int
    width: int
    height: int
    wrap_u: int
    wrap_v: int
    scale: float
    bias: float
    threshold: float
    u_row: wp.vec3  # u = dot(u_row, (s, t, 1))
    v_row: wp.vec3


@wp.struct
class Cutouts:
    """The cut-outs of a scene; all arrays have length 0 where there are none."""

    of_triangle: wp.array(dtype=int)  # index into `views`, -1: solid
    views: wp.array(dtype=CutView)
    texels: wp.array(dtype=float)
    uvs: wp.array(dtype=wp.vec2)
    uv_index: wp.array(dtype=wp.vec3i)  # per triangle


@wp.func
def wrapped_coordinate(x: float, mode: int) -> float:
    """A picture coordinate brought near [0, 1], so that no integer overflows."""
    if mode == WRAP_REPEAT:
        return x - wp.floor(x)
    if mode == WRAP_MIRROR:
        return x - 2.0 * wp.floor(0.5 * x)
    return wp.clamp(x, -1.0, 2.0)


@wp.func
def wrapped_texel(i: int, count: int, mode: int) -> int:
    """The texel that one of `wrapped_coordinate` stands for; -1: black."""
    k = i
    if mode == WRAP_REPEAT:
        if k < 0:
            k += count
        if k >= count:
            k -= count
    elif mode == WRAP_MIRROR:
        # Two periods: a neighbour of the last texel of the second is the first of the next.
        if k < 0:
            k = -1 - k
        if k >= 2 * count:
            k -= 2 * count
        if k >= count:
            k = 2 * count - 1 - k
    elif mode == WRAP_BLACK:
        if k < 0 or k >= count:
            return -1
    return wp.clamp(k, 0, count - 1)


@wp.func
def cut_texel(cuts: Cutouts, view: CutView, column: int, row: int) -> float:
    if column < 0 or row < 0:
        return 0.0
    return cuts.texels[view.first_texel + row * view.width + column]


@wp.func
def is_hole(cuts: Cutouts, triangle: int, u: float, v: float) -> bool:
    """Whether a triangle is not there at a point.

    Args:
        cuts: Of the scene, not empty.
        triangle: The triangle.
        u: Weight of its second corner.
        v: Weight of its third corner.
    """
    k = cuts.of_triangle[triangle]
    if k < 0:
        return False
    view = cuts.views[k]
    index = cuts.uv_index[triangle]
    st = (1.0 - u - v) * cuts.uvs[index[0]] + u * cuts.uvs[index[1]] + v * cuts.uvs[index[2]]
    p = wp.vec3(st[0], st[1], 1.0)
    x = wrapped_coordinate(wp.dot(view.u_row, p), view.wrap_u) * float(view.width) - 0.5
    y = wrapped_coordinate(1.0 - wp.dot(view.v_row, p), view.wrap_v) * float(view.height) - 0.5
    x_floor = wp.floor(x)
    y_floor = wp.floor(y)
    fx = x - x_floor
    fy = y - y_floor
    column0 = wrapped_texel(int(x_floor), view.width, view.wrap_u)
    column1 = wrapped_texel(int(x_floor) + 1, view.width, view.wrap_u)
    row0 = wrapped_texel(int(y_floor), view.height, view.wrap_v)
    row1 = wrapped_texel(int(y_floor) + 1, view.height, view.wrap_v)
    top = (1.0 - fx) * cut_texel(cuts, view, column0, row0) + fx * cut_texel(cuts, view, column1, row0)
    bottom = (1.0 - fx) * cut_texel(cuts, view, column0, row1) + fx * cut_texel(cuts, view, column1, row1)
    return view.scale * ((1.0 - fy) * top + fy * bottom) + view.bias < view.threshold


def no_cutouts(device) -> Cutouts:
    """The table of a scene that has none."""
    return make_cutouts(np.zeros(0, np.int32), [], [], np.zeros((0, 2)), np.zeros((0, 3)), device)


def make_cutouts(
    of_triangle: np.ndarray,
    views: list[CutView],
    pictures: list[np.ndarray],
    uvs: np.ndarray,
    uv_index: np.ndarray,
    device,
) -> Cutouts:
    """The table of a scene's cut-outs.

    Args:
        of_triangle: int32 [triangle_count], index into `views`, -1: solid.
        views: Their `first_texel` counts the texels of all `pictures` before theirs.
        pictures: float32 [height, width] each.
        uvs: [n, 2].
        uv_index: [triangle_count, 3].
        device: Warp device.
    """
    flat = np.concatenate([picture.reshape(-1) for picture in pictures]) if pictures else np.zeros(0)
    cuts = Cutouts()
    cuts.of_triangle = wp.array(np.ascontiguousarray(of_triangle, np.int32), dtype=int, device=device)
    cuts.views = wp.array(views, dtype=CutView, device=device)
    cuts.texels = wp.array(np.ascontiguousarray(flat, np.float32), dtype=float, device=device)
    cuts.uvs = wp.array(np.ascontiguousarray(uvs, np.float32), dtype=wp.vec2, device=device)
    cuts.uv_index = wp.array(np.ascontiguousarray(uv_index, np.int32), dtype=wp.vec3i, device=device)
    return cuts
