"""Rough mirrors from a few rays of the lobe a pixel, each of which serves the pixels around it as well.

Source: Stachowiak, Stochastic Screen-Space Reflections, SIGGRAPH 2015 (Advances in Real-Time Rendering): a pixel weighs what its
neighbours' rays have met by its own lobe over the density that they were drawn from, and divides by the sum of these weights.
Differs from it by: rays through the BVH instead of the screen; no frames before; as many neighbours, as far away, as have lobes
that overlap the pixel's own (`glossy_neighbours`), those that overlap less weighing less; a ray never counts as rarer than a
share of the pixel's own density.

What is left is grain without a pattern, as every pixel asks other neighbours. Its mean is then taken over pixels whose lobes are
all but the same: by a Gaussian of the angle between what they see (`glossy_smooth`), after Tomasi and Manduchi, Bilateral
Filtering for Gray and Color Images, ICCV 1998. It widens a lobe by its own width at most: 0.3 of alpha make 4 % of it.

That a pixel sees the places that its neighbours' rays have met is taken for granted.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import bvh, launch
from warp_reflect.finishes import glossy_rays
from warp_reflect.finishes.lobe import GOLDEN, PI, eye_side, lobe_value, share_of_weight, surface_lobe
from warp_reflect.layers import MirrorPixels
from warp_reflect.scene import SceneView
from warp_reflect.shade import schlick
from warp_reflect.surface import shown_normal
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

SAMPLES = 6  # rays a pixel
# Angle between two pixels' sharp rays, over alpha, from which on they share nothing. At 3 spheres are shown worse: what is
# shared there is grain that neighbours have in common, which is seen more.
OVERLAP = wp.constant(2.0)
REACH = wp.constant(12.0)  # pixels up to which rays are shared: at 4 grain that neighbours have in common is seen more
PACKING = wp.constant(3.0)  # neighbours asked per squared pixel of that reach, at most: there are pi
LEAST_DENSITY = wp.constant(0.25)  # of a neighbour's ray, over that of the pixel's own lobe in the same direction
SMOOTH_REACH = wp.constant(4)  # pixels over which grain is smoothed: over 2 it is seen a tenth more, over 6 as much
FLAT = wp.constant(1.0e-9)  # sine from pixel to pixel below which a mirror is a plane seen from infinitely far


@wp.struct
class Neighbours:
    """Which mirror pixel is where: its number at its place in the mirror's box, -1 beside the mirror."""

    image_width: int
    x0: int
    y0: int
    width: int
    height: int
    number: wp.array(dtype=int)


@wp.struct
class Met:
    """What the rays of mirror pixels have met: ray k of pixel i at `count` i + k."""

    count: int  # rays a pixel
    nearness: wp.array(dtype=float)  # of a pixel: root mean square of 1 / distance of what its rays met
    place: wp.array(dtype=wp.vec4)  # scene frame, 1; of what is infinitely far its direction, 0
    seen: wp.array(dtype=wp.vec4)  # radiance; density of the ray [1/sr], 0: there is none


@wp.func
def box_column(around: Neighbours, pixel: int) -> int:
    return pixel % around.image_width - around.x0


@wp.func
def box_row(around: Neighbours, pixel: int) -> int:
    return pixel // around.image_width - around.y0


@wp.func
def number_at(around: Neighbours, x: int, y: int) -> int:
    """Number of the mirror pixel at a place in the box, -1: none."""
    if x < 0 or y < 0 or x >= around.width or y >= around.height:
        return -1
    return around.number[y * around.width + x]


@wp.kernel
def number_kernel(first: int, pixel: wp.array(dtype=int), out_around: Neighbours):
    """One thread per mirror pixel, but for the number -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
    place = box_row(out_around, pixel[i]) * out_around.width + box_column(out_around, pixel[i])
    out_around.number[place] = i


@wp.kernel
def keep_kernel(
    first: int,
    k: int,
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    density: wp.array(dtype=float),
    radiance: wp.array(dtype=wp.vec3),
    out_met: Met,
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    d = direction[i]
    place = wp.vec4(d[0], d[1], d[2], 0.0)
    if distance[i] > 0.0:
        nearness = out_met.nearness[i]
        near = 1.0 / distance[i]
        out_met.nearness[i] = wp.sqrt(nearness * nearness + near * near / float(out_met.count))
        p = point[i] + distance[i] * d
        place = wp.vec4(p[0], p[1], p[2], 1.0)
    at = i * out_met.count + k
    out_met.place[at] = place
    out_met.seen[at] = wp.vec4(radiance[i][0], radiance[i][1], radiance[i][2], density[i])


@wp.func
def angle_between(
    direction: wp.array(dtype=wp.vec3), point: wp.array(dtype=wp.vec3), nearness: wp.array(dtype=float), i: int, j: int
) -> float:
    """Sine of the angle between the directions in which two pixels see the same; of a place as near as either's."""
    near = wp.max(nearness[i], nearness[j])
    return wp.length(direction[j] - direction[i] + near * (point[j] - point[i]))


@wp.func
def largest_turn(
    around: Neighbours,
    direction: wp.array(dtype=wp.vec3),
    point: wp.array(dtype=wp.vec3),
    nearness: wp.array(dtype=float),
    i: int,
    x: int,
    y: int,
) -> float:
    """Largest `angle_between` a pixel and the four beside it."""
    turn = float(0.0)
    for side in range(4):
        step = 1 - 2 * (side & 1)
        j = number_at(around, x + step * (1 - (side >> 1)), y + step * (side >> 1))
        if j >= 0:
            turn = wp.max(turn, angle_between(direction, point, nearness, i, j))
    return turn


@wp.kernel
def gather_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    point: wp.array(dtype=wp.vec3),
    around: Neighbours,
    # Their rays; and of every pixel's own the sums of weights, without and with what they see:
    met: Met,
    own_total: wp.array(dtype=wp.vec3),
    own_seen: wp.array(dtype=wp.vec3),
    # Settings:
    coat: int,
    neighbour_count: int,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel, but for the number -1."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        return
    column = box_column(around, p)
    row = box_row(around, p)
    view = eye_side(direction[i], normal[i])
    n = shown_normal(normals, p, normal[i])
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    given = own_total[i]
    seen = own_seen[i]
    widest = OVERLAP * lobe.alpha
    turn = largest_turn(around, direction, point, met.nearness, i, column, row)
    reach = wp.min(REACH, widest / wp.max(turn, FLAT))
    asked = wp.min(neighbour_count, int(PACKING * reach * reach))
    turned = wp.randf(wp.rand_init(p))
    m = int(0)
    while m < asked:
        # Vogel's spiral: points at golden angles, of even density.
        radius = reach * wp.sqrt((float(m) + 0.5) / float(asked)) + 0.5
        angle = 2.0 * PI * (GOLDEN * float(m) + turned)
        x = column + int(wp.round(radius * wp.cos(angle)))
        y = row + int(wp.round(radius * wp.sin(angle)))
        m += 1
        j = number_at(around, x, y)
        if j >= 0 and j != i:
            apart = angle_between(direction, point, met.nearness, i, j) / widest
            apart *= apart
            if apart < 1.0:
                k = int(0)
                while k < met.count:
                    at = j * met.count + k
                    k += 1
                    there = met.seen[at]
                    place = met.place[at]
                    to = wp.vec3(place[0], place[1], place[2]) - place[3] * point[i]
                    value = lobe_value(lobe.alpha, n, view, wp.normalize(to))
                    if there[3] > 0.0 and value.weight > 0.0:
                        rarity = wp.max(there[3] * value.solid_angle, LEAST_DENSITY)
                        share = (1.0 - apart) * value.weight / rarity
                        weight = share * schlick(lobe.f0, lobe.f90, value.cosine)
                        given += weight
                        seen += wp.cw_mul(weight, wp.vec3(there[0], there[1], there[2]))
    total = own_total[i] / float(met.count)
    out_radiance[i] = share_of_weight(lobe, wp.dot(view, n), total, seen, given)


@wp.kernel
def smooth_kernel(
    first: int,
    scene: SceneView,
    looks: wp.array(dtype=Look),
    triangle: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    direction: wp.array(dtype=wp.vec3),
    point: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    around: Neighbours,
    met: Met,
    # Settings:
    coat: int,
    width: float,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per mirror pixel, but for the number -1; `width` is the Gaussian's, over alpha."""
    i = first + wp.tid()
    p = pixel[i]
    if p < 0:
        return
    column = box_column(around, p)
    row = box_row(around, p)
    lobe = surface_lobe(scene, looks, p, triangle[p], coat)
    scale = 0.5 / (width * width * lobe.alpha * lobe.alpha)
    total = radiance[i]
    given = float(1.0)
    y = row - SMOOTH_REACH
    while y <= row + SMOOTH_REACH:
        x = column - SMOOTH_REACH
        while x <= column + SMOOTH_REACH:
            j = number_at(around, x, y)
            if j >= 0 and j != i:
                off = angle_between(direction, point, met.nearness, i, j)
                weight = wp.exp(-scale * off * off)
                total += weight * radiance[j]
                given += weight
            x += 1
        y += 1
    out_radiance[i] = total / given


def numbered(pixels: MirrorPixels, image_width: int, device, threads: int) -> Neighbours:
    """Where the pixels of a mirror are."""
    x0, y0, x1, y1 = pixels.box
    around = Neighbours()
    around.image_width, around.x0, around.y0 = image_width, x0, y0
    around.width, around.height = x1 - x0, y1 - y0
    around.number = wp.full(around.width * around.height, -1, dtype=int, device=device)
    launch.launch(number_kernel, pixels.count, [pixels.pixel, around], device, threads)
    return around


def radiance_of(scene, shown, layer, sharp, row, which: int, count: int) -> wp.array:
    """`glossy.lobe_radiance` from `count` rays a pixel and those of its neighbours."""
    settings, pixels, device = row.settings, layer.pixels, scene.device
    threads, n = settings.threads, pixels.count
    met = Met()
    met.count = count
    met.place, met.seen = (wp.empty(count * n, dtype=wp.vec4, device=device) for _ in range(2))
    met.nearness = wp.zeros(n, dtype=float, device=device)
    own_seen, own_total = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(2))
    for k, rays in enumerate(glossy_rays.followed(scene, shown, layer, row, which, count)):
        glossy_rays.add(rays, own_seen, own_total, device, threads)
        answer = rays.answer
        inputs = [k, pixels.point, answer.pixels.direction, answer.distance, rays.density, rays.radiance, met]
        launch.launch(keep_kernel, n, inputs, device, threads)
    around = numbered(pixels, shown.gbuffer.camera.size[0], device, threads)
    radiance = wp.empty(n, dtype=wp.vec3, device=device)
    inputs = [*glossy_rays.surface_of(scene, shown, layer), pixels.point, around, met, own_total, own_seen, which]
    inputs += [settings.glossy_neighbours, radiance]
    launch.launch(gather_kernel, n, inputs, device, threads, split_min=bvh.TRACE_SPLIT_MIN)
    if settings.glossy_smooth == 0.0:
        return radiance
    smooth = wp.empty(n, dtype=wp.vec3, device=device)
    inputs = [scene.view, shown.looks, shown.gbuffer.triangle, pixels.pixel, pixels.direction, pixels.point]
    inputs += [radiance, around, met, which, settings.glossy_smooth, smooth]
    launch.launch(smooth_kernel, n, inputs, device, threads, split_min=bvh.TRACE_SPLIT_MIN)
    return smooth
