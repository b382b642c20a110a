"""A mirror's picture as a map from directions to radiance: where in it is seen what a turned ray would see?

The sharp picture of a curved mirror holds what nearby rays see, at other pixels. For a ray from a mirror pixel's point in
another direction `find_in_map` looks for the pixel whose own reflected ray meets it where the first surface is: Newton steps
with the derivatives of points and directions from pixel to pixel (ray differentials), at the path length that the picture
has there. A near surface so moves little and a far one much, on a plane as well as on a curved mirror: a plane's is
f d_o / (d_e + d_o) pixels a radian.

Sources: Igehy, Tracing Ray Differentials, SIGGRAPH 1999 (derivatives of a reflected ray; here differences of neighbouring
pixels); Williams, Pyramidal Parametrics, SIGGRAPH 1983, of colour times coverage (Porter and Duff, SIGGRAPH 1984), so that
nothing outside the mirror is mixed in.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch
from warp_reflect.layers import ReflectionLayer
from warp_reflect.optics import tangent_basis
from warp_reflect.scene import Scene

wp.set_module_options({"enable_backward": False})

# Differences to the two neighbours of a pixel that are further apart than this lie on either side of a crease.
CREASE_RATIO = wp.constant(4.0)
# Of the product of the map's derivatives: below it a beam of pixels sees one point (a focus), and there is no step.
LEAST_DETERMINANT = wp.constant(1.0e-6)
LEAST_REACH = wp.constant(2.0)  # pixels that a second step may lead away, however short the first was
LEAST_TEXELS = wp.constant(1.0e-12)  # keeps a logarithm finite
# Share of a look-up's length by which it is shortened at a time where it leads beyond the mirror.
DRAW_STEP = wp.constant(0.125)
# Share of the largest nearness around a pixel by which the least is smaller where there is more than one surface.
MIXED_NEARNESS = wp.constant(0.3)
STRIDE = wp.constant(3.0)  # pixels between two distances that are tried there
STRIDES = wp.constant(8)  # of them at most
# Levels finer than a texel as wide as the look-up: noise is seen less than blur.
LEVEL_BIAS = wp.constant(-0.5)
FAR_NEARNESS = wp.constant(3.0e38)
# Share of a distance that makes no difference to where its surface is seen.
SAME_NEARNESS = wp.constant(0.05)
# Share of the difference between two distances within which a third between them is taken for the surface's own.
SAME_SURFACE = wp.constant(0.25)


@wp.struct
class LayerMap:
    """The pixels of one mirror in the box that holds them; level k has 2^k pixels to a texel."""

    x0: int
    y0: int
    width: int
    height: int
    level_count: int
    first: wp.array(dtype=int)  # texel of each level
    texels: wp.array(dtype=wp.vec4)  # radiance times coverage, coverage
    nearness: wp.array(dtype=wp.vec2)  # least and largest 1 / path length from the mirror; 0 for the sky
    # Of level 0 only:
    point: wp.array(dtype=wp.vec3)  # scene frame
    direction: wp.array(dtype=wp.vec3)  # of the sharp reflection; 0 outside the mirror


@wp.struct
class MapFrame:
    """How a mirror pixel's ray changes from pixel to pixel."""

    point: wp.vec3
    direction: wp.vec3
    t1: wp.vec3
    t2: wp.vec3
    # Per pixel to the right and down, along t1 and t2: of the direction, and of the point.
    turn: wp.mat22
    move: wp.mat22
    reach: float  # distance at which both count the same; a plane's is that of the eye


@wp.struct
class Found:
    """A place in a map."""

    x: float  # in pixels of the map's box, centres at + 0.5
    y: float
    level: float  # whose texel is as wide as the look-up
    there: int  # 0: the mirror does not show it


@wp.func
def level_width(layer: LayerMap, level: int) -> int:
    return (layer.width + (1 << level) - 1) >> level


@wp.func
def level_height(layer: LayerMap, level: int) -> int:
    return (layer.height + (1 << level) - 1) >> level


@wp.func
def is_mirror(layer: LayerMap, x: int, y: int) -> bool:
    if x < 0 or y < 0 or x >= layer.width or y >= layer.height:
        return False
    return layer.texels[y * layer.width + x][3] > 0.0


@wp.func
def step_of(before: wp.vec3, here: wp.vec3, after: wp.vec3, has_before: bool, has_after: bool) -> wp.vec2:
    """Weights of (here - before) and (after - here) in the derivative: their mean, or the smaller at a crease."""
    if has_before and has_after:
        a = wp.length_sq(here - before)
        b = wp.length_sq(after - here)
        if a > CREASE_RATIO * CREASE_RATIO * b:
            return wp.vec2(0.0, 1.0)
        if b > CREASE_RATIO * CREASE_RATIO * a:
            return wp.vec2(1.0, 0.0)
        return wp.vec2(0.5, 0.5)
    return wp.vec2(wp.where(has_before, 1.0, 0.0), wp.where(has_after, 1.0, 0.0))


@wp.func
def map_frame(layer: LayerMap, x: int, y: int) -> MapFrame:
    """The derivatives at a mirror pixel; 0 along a side where it has no neighbour."""
    k = y * layer.width + x
    p = layer.point[k]
    d = layer.direction[k]
    turn_x = wp.vec3(0.0, 0.0, 0.0)
    turn_y = wp.vec3(0.0, 0.0, 0.0)
    move_x = wp.vec3(0.0, 0.0, 0.0)
    move_y = wp.vec3(0.0, 0.0, 0.0)
    left = is_mirror(layer, x - 1, y)
    right = is_mirror(layer, x + 1, y)
    a = wp.where(left, k - 1, k)
    b = wp.where(right, k + 1, k)
    w = step_of(layer.direction[a], d, layer.direction[b], left, right)
    turn_x = w[0] * (d - layer.direction[a]) + w[1] * (layer.direction[b] - d)
    move_x = w[0] * (p - layer.point[a]) + w[1] * (layer.point[b] - p)
    above = is_mirror(layer, x, y - 1)
    below = is_mirror(layer, x, y + 1)
    a = wp.where(above, k - layer.width, k)
    b = wp.where(below, k + layer.width, k)
    w = step_of(layer.direction[a], d, layer.direction[b], above, below)
    turn_y = w[0] * (d - layer.direction[a]) + w[1] * (layer.direction[b] - d)
    move_y = w[0] * (p - layer.point[a]) + w[1] * (layer.point[b] - p)
    frame = MapFrame()
    frame.point = p
    frame.direction = d
    t1, t2 = tangent_basis(d)
    frame.t1 = t1
    frame.t2 = t2
    frame.turn = wp.mat22(wp.dot(t1, turn_x), wp.dot(t1, turn_y), wp.dot(t2, turn_x), wp.dot(t2, turn_y))
    frame.move = wp.mat22(wp.dot(t1, move_x), wp.dot(t1, move_y), wp.dot(t2, move_x), wp.dot(t2, move_y))
    turned = wp.abs(wp.determinant(frame.turn))
    if turned > 0.0:
        frame.reach = wp.sqrt(wp.abs(wp.determinant(frame.move)) / turned)
    return frame


@wp.func
def level_texel(layer: LayerMap, level: int, x: float, y: float) -> wp.vec4:
    """Bilinear look-up of radiance times coverage in one level, at pixel coordinates of the box."""
    scale = 1.0 / float(1 << level)
    width = level_width(layer, level)
    height = level_height(layer, level)
    u = wp.clamp(x * scale - 0.5, 0.0, float(width - 1))
    v = wp.clamp(y * scale - 0.5, 0.0, float(height - 1))
    x0 = int(u)
    y0 = int(v)
    x1 = wp.min(x0 + 1, width - 1)
    y1 = wp.min(y0 + 1, height - 1)
    fx = u - float(x0)
    fy = v - float(y0)
    upper = layer.first[level] + y0 * width
    lower = layer.first[level] + y1 * width
    top = (1.0 - fx) * layer.texels[upper + x0] + fx * layer.texels[upper + x1]
    bottom = (1.0 - fx) * layer.texels[lower + x0] + fx * layer.texels[lower + x1]
    return (1.0 - fy) * top + fy * bottom


@wp.func
def map_radiance(layer: LayerMap, found: Found) -> wp.vec4:
    """Radiance times coverage, and coverage, at a place in a map: bilinear in a level, linear between two."""
    level = wp.clamp(found.level, 0.0, float(layer.level_count - 1))
    lower = wp.min(int(level), wp.max(layer.level_count - 2, 0))
    share = level - float(lower)
    value = level_texel(layer, lower, found.x, found.y)
    if share > 0.0:
        value = (1.0 - share) * value + share * level_texel(layer, lower + 1, found.x, found.y)
    return value


@wp.func
def map_step(frame: MapFrame, nearness: float, off: wp.vec3) -> wp.vec3:
    """Pixels (right, down) that turn a ray by `off` at a distance, and the determinant; 0 where there is no such step."""
    m = frame.turn + nearness * frame.move
    straight = m[0, 0] * m[1, 1]
    crossed = m[0, 1] * m[1, 0]
    det = straight - crossed
    if not (wp.abs(det) > LEAST_DETERMINANT * (wp.abs(straight) + wp.abs(crossed))):
        return wp.vec3(0.0, 0.0, 0.0)
    a = wp.dot(frame.t1, off)
    b = wp.dot(frame.t2, off)
    return wp.vec3((m[1, 1] * a - m[0, 1] * b) / det, (m[0, 0] * b - m[1, 0] * a) / det, wp.abs(det))


@wp.func
def pixel_at(layer: LayerMap, x: float, y: float) -> int:
    """The mirror's pixel at a place in its box; -1: there is none."""
    if not (x >= 0.0 and y >= 0.0 and x < float(layer.width) and y < float(layer.height)):
        return -1
    k = int(y) * layer.width + int(x)
    if layer.texels[k][3] > 0.0:
        return k
    return -1


@wp.func
def step_from(layer: LayerMap, frame: MapFrame, k: int, direction: wp.vec3, nearness: float) -> wp.vec3:
    """The place that shows a ray's point at a distance, by one step from pixel k; and the determinant, see `map_step`."""
    # The ray's point seen from pixel k's, over the distance, less what that pixel's own ray shows.
    off = direction + nearness * (frame.point - layer.point[k]) - layer.direction[k]
    step = map_step(frame, nearness, off)
    row = k // layer.width
    return wp.vec3(float(k - row * layer.width) + 0.5 + step[0], float(row) + 0.5 + step[1], step[2])


@wp.func
def drawn_in(layer: LayerMap, x: float, y: float, to_x: float, to_y: float) -> int:
    """The last mirror pixel on the way from one to a place beyond the mirror's border: what lies beyond looks like that."""
    share = float(1.0)
    while share > 0.0:
        k = pixel_at(layer, x + share * (to_x - x), y + share * (to_y - y))
        if k >= 0:
            return k
        share -= DRAW_STEP
    return pixel_at(layer, x, y)


@wp.func
def nearness_range(layer: LayerMap, x: float, y: float, radius: float) -> wp.vec2:
    """Least and largest nearness around a place; a little beyond the radius too."""
    level = wp.clamp(int(wp.ceil(wp.log2(wp.max(2.0 * radius, 1.0)))), 0, layer.level_count - 1)
    width = level_width(layer, level)
    height = level_height(layer, level)
    scale = 1.0 / float(1 << level)
    column = int(wp.floor(x * scale - 0.5))
    row = int(wp.floor(y * scale - 0.5))
    result = wp.vec2(FAR_NEARNESS, 0.0)
    for k in range(4):
        u = wp.clamp(column + (k & 1), 0, width - 1)
        v = wp.clamp(row + (k >> 1), 0, height - 1)
        texel = layer.nearness[layer.first[level] + v * width + u]
        result = wp.vec2(wp.min(result[0], texel[0]), wp.max(result[1], texel[1]))
    return result


@wp.func
def nearness_towards(layer: LayerMap, frame: MapFrame, x: float, y: float, off: wp.vec3, nearness: float) -> float:
    """Nearness of what is seen where a turned ray's point at a given nearness would be; -1: no mirror there."""
    step = map_step(frame, nearness, off)
    k = pixel_at(layer, x + step[0], y + step[1])
    if k < 0 or step[2] == 0.0:
        return -1.0
    return layer.nearness[k][0]


@wp.func
def nearness_met(layer: LayerMap, frame: MapFrame, x: float, y: float, around: wp.vec2, off: wp.vec3) -> float:
    """Nearness at which a turned ray meets a surface first, among surfaces at several distances.

    Along the ray from the nearest to the farthest, in even steps on the picture: a distance d is seen at the share
    d / (reach + d) of the way to infinity. A ray's point that lies behind what is seen there, but was not before it one
    step ago, passes behind it.

    Args:
        layer, frame, x, y, around: As for `find_in_map`.
        off: What the ray is turned by.

    Returns:
        The nearness of a step that met a surface, or of the farthest.
    """
    last = map_step(frame, around[0], off)
    share = 1.0 / (1.0 + frame.reach * around[1])
    rest = 1.0 / (1.0 + frame.reach * around[0]) - share
    count = wp.clamp(int(rest * (wp.abs(last[0]) + wp.abs(last[1])) / STRIDE) + 2, 2, STRIDES)
    before = around[1]
    seen_before = float(-1.0)
    j = int(0)
    while j < count:
        j += 1
        share += rest / float(count)
        at = wp.max((1.0 - share) / (share * frame.reach), around[0])
        if seen_before > at and seen_before < before:
            # A small surface, seen at the last step, between the two.
            seen = nearness_towards(layer, frame, x, y, off, seen_before)
            if wp.abs(seen - seen_before) <= SAME_NEARNESS * seen_before:
                return seen_before
        seen_before = nearness_towards(layer, frame, x, y, off, at)
        if seen_before >= (1.0 - SAME_NEARNESS) * at and seen_before <= (1.0 + SAME_NEARNESS) * before:
            return at
        before = at
    return around[0]


@wp.func
def find_in_map(
    layer: LayerMap,
    frame: MapFrame,
    x: float,
    y: float,
    nearness: float,
    around: wp.vec2,
    direction: wp.vec3,
    solid_angle: float,
) -> Found:
    """The place in a mirror's picture that shows what a ray from a mirror pixel's point sees.

    The distance is searched as the place is: the picture has one at each place, and the ray meets a surface where that is
    its own. Where nothing near hides it, it is what lies behind.

    Args:
        layer: The picture.
        frame: Of the mirror pixel.
        x, y: The mirror pixel's centre, in the map's box.
        nearness: 1 / path length of the mirror pixel.
        around: Least and largest nearness around it.
        direction: Of the ray, unit.
        solid_angle: That the look-up stands for. [sr]
    """
    found = Found()
    off = direction - frame.direction
    near0 = nearness
    if around[1] - around[0] > MIXED_NEARNESS * around[1] and frame.reach > 0.0:
        near0 = nearness_met(layer, frame, x, y, around, off)
    place = map_step(frame, near0, off)
    if place[2] == 0.0:
        return found
    found.x = x + place[0]
    found.y = y + place[1]
    k = pixel_at(layer, found.x, found.y)
    if k < 0:
        k = drawn_in(layer, x, y, found.x, found.y)
    near1 = layer.nearness[k][0]
    # Across a crease another face's rays lead far away from where this one's would.
    smooth = map_step(frame, near1, off)
    place = step_from(layer, frame, k, direction, near1)
    if place[2] == 0.0 or smooth[2] == 0.0:
        return found
    allowed = 0.5 * (wp.abs(smooth[0]) + wp.abs(smooth[1])) + LEAST_REACH
    if wp.abs(place[0] - x - smooth[0]) + wp.abs(place[1] - y - smooth[1]) > allowed:
        return found
    found.x = place[0]
    found.y = place[1]
    found.level = 0.5 * wp.log2(wp.max(solid_angle / place[2], LEAST_TEXELS)) + LEVEL_BIAS
    found.there = int(1)
    k = pixel_at(layer, place[0], place[1])
    if k < 0:
        k = drawn_in(layer, x, y, found.x, found.y)
        row = k // layer.width
        found.x = float(k - row * layer.width) + 0.5
        found.y = float(row) + 0.5
        return found
    if wp.abs(near1 - near0) <= SAME_NEARNESS * near1:
        return found
    near2 = layer.nearness[k][0]
    if wp.abs(near2 - near1) <= SAME_NEARNESS * near1:
        return found
    # One step of the secant method: exact for a slanted plane, whose nearness changes linearly in the picture.
    rise = (near1 - near0) - (near2 - near1)
    if rise == 0.0:
        return found
    near = near0 + (near1 - near0) * (near1 - near0) / rise
    if not (near >= 0.0 and near <= 2.0 * wp.max(near1, near0)):
        return found
    place = step_from(layer, frame, k, direction, near)
    k = pixel_at(layer, place[0], place[1])
    if k >= 0 and place[2] > 0.0:
        if wp.abs(layer.nearness[k][0] - near) <= SAME_SURFACE * wp.abs(near1 - near0):
            found.x = place[0]
            found.y = place[1]
            found.level = 0.5 * wp.log2(wp.max(solid_angle / place[2], LEAST_TEXELS)) + LEVEL_BIAS
    return found


@wp.kernel
def place_kernel(
    first: int,
    image_width: int,
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    radiance: wp.array(dtype=wp.vec3),
    # Outputs:
    out_map: LayerMap,
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    row = pixel[i] // image_width
    k = (row - out_map.y0) * out_map.width + pixel[i] - row * image_width - out_map.x0
    seen = radiance[i]
    out_map.texels[k] = wp.vec4(seen[0], seen[1], seen[2], 1.0)
    out_map.point[k] = point[i]
    out_map.direction[k] = direction[i]
    near = float(0.0)
    if distance[i] > 0.0:
        near = 1.0 / distance[i]
    out_map.nearness[k] = wp.vec2(near, near)


@wp.kernel
def halve_kernel(first: int, level: int, out_map: LayerMap):
    """One thread per texel of a level: the mean of its four of the level below; outside there is nothing."""
    i = first + wp.tid()
    width = level_width(out_map, level)
    below_width = level_width(out_map, level - 1)
    below_height = level_height(out_map, level - 1)
    row = i // width
    column = i - row * width
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    near = wp.vec2(FAR_NEARNESS, 0.0)
    for k in range(4):
        x = 2 * column + (k & 1)
        y = 2 * row + (k >> 1)
        if x < below_width and y < below_height:
            texel = out_map.first[level - 1] + y * below_width + x
            below = out_map.nearness[texel]
            total += out_map.texels[texel]
            near = wp.vec2(wp.min(near[0], below[0]), wp.max(near[1], below[1]))
    out_map.texels[out_map.first[level] + i] = 0.25 * total
    out_map.nearness[out_map.first[level] + i] = near


def make_layer_map(scene: Scene, width: int, layer: ReflectionLayer, radiance: wp.array, threads: int = 0) -> LayerMap:
    """The picture of a sharp mirror as a map.

    Args:
        scene: On the layer's device.
        width: Of the image. [pixels]
        layer: The mirror's answer, of one pixel at least.
        radiance: What its pixels see, vec3 [layer.pixels.count].
        threads: CPU threads; 0: one per core.
    """
    x0, y0, x1, y1 = layer.pixels.box
    result = LayerMap()
    result.x0, result.y0, result.width, result.height = x0, y0, x1 - x0, y1 - y0
    sides, first = [(x1 - x0, y1 - y0)], [0]
    while max(sides[-1]) > 1:
        first.append(first[-1] + sides[-1][0] * sides[-1][1])
        sides.append(tuple((side + 1) // 2 for side in sides[-1]))
    texel_count = first[-1] + sides[-1][0] * sides[-1][1]
    device = scene.device
    result.level_count = len(sides)
    result.first = wp.array(first, dtype=int, device=device)
    result.texels = wp.zeros(texel_count, dtype=wp.vec4, device=device)
    area = sides[0][0] * sides[0][1]
    # Outside the mirror the range of distances is empty.
    result.nearness = wp.full(texel_count, wp.vec2(float(FAR_NEARNESS), 0.0), dtype=wp.vec2, device=device)
    result.point = wp.zeros(area, dtype=wp.vec3, device=device)
    result.direction = wp.zeros(area, dtype=wp.vec3, device=device)
    pixels = layer.pixels
    inputs = [width, pixels.pixel, pixels.point, pixels.direction, layer.distance, radiance, result]
    launch.launch(place_kernel, pixels.count, inputs, device, threads)
    for level in range(1, len(sides)):
        launch.launch(halve_kernel, sides[level][0] * sides[level][1], [level, result], device, threads)
    return result
