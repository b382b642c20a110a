"""What the first rays towards a shape found at a pixel and around it: whether points lie in a penumbra, and shares of them.

Points on one plane at neighbouring pixels ask other samples of a shape, so the mean of what they found counts as many rays
as they sent together. It is that of the middle where the share of the shape that is seen changes evenly across them. Where a
penumbra is a few pixels wide it does not: points have to ask on their own where the share is steep, or where they see all of
the shape or nothing, which the variance between them tells.

Source: Heitz et al., Combining Analytic Direct Illumination and Stochastic Shadows, I3D 2018, which filters the ratio of
shadowed to unshadowed light over the image. What differs: the filter is a box over pixels whose points lie in one plane, only
in penumbras, and hard edges are asked instead of filtered.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import compact
from warp_reflect.direct import Points
from warp_reflect.launch import launch
from warp_reflect.shadow_starts import Starts, row_vector

wp.set_module_options({"enable_backward": False})

NEIGHBOURS = wp.constant(2)  # pixels around one whose rays are looked at: 25 pixels stand for a penumbra
MARGIN = 8  # entries behind a picture: eight of a row are read at once
# What rays towards a shape found, the lowest bits of an entry; the share that arrives lies above them.
NOTHING = wp.constant(0)  # it is below the horizon, or no point is there
DARK = wp.constant(1)
LIT = wp.constant(2)
BOTH = wp.constant(3)
LEVELS = wp.constant(63)  # of the share
# Pixels of a tile: those whose rays 32 threads of a CUDA device send in step.
TILE_WIDTH = wp.constant(8)
TILE_HEIGHT = wp.constant(4)
# Neighbours share what they found where they lie in the plane of a point: the cosine between facets, and the share of the
# distance between two points that one may lie beside the other's plane.
SAME_TURN = wp.constant(0.995)
FLATNESS = wp.constant(0.1)
LEAST_COUNT = wp.constant(5)  # of so few points, itself included, none learns anything
# Variance between points of all that there could be, 1: each sees all or nothing; and the least that it must be at all, of a
# share's square: one odd neighbour of 25 is no edge.
SHARP = wp.constant(2)  # its reciprocal
LEAST_SPREAD = wp.constant(20)  # its reciprocal
# Change of the share per pixel from which on a penumbra is so narrow that its bends lie within the box: at 0.12 what bends
# within minified shadows is off by more than 16 rays of each point are.
STEEP = wp.constant(0.06)


@wp.struct
class Neighbours:
    """Pictures with a border of `NEIGHBOURS` pixels, a row a shape: no neighbour lies outside of them."""

    width: int  # of the image
    height: int
    pixel: wp.array(dtype=int)  # of points; length 0: point i is pixel i
    index: wp.array(dtype=int)  # of pixels: which point; length 0 likewise
    found: wp.array2d(dtype=wp.uint8)  # by the first rays
    shared: wp.array2d(dtype=wp.uint8)  # by all that neighbours share; length 0: nothing is shared


@wp.func
def entry_of(share: float) -> int:
    """What is kept of a share, 0 to 1."""
    found = wp.where(share == 1.0, LIT, BOTH)
    found = wp.where(share == 0.0, DARK, found)
    return found | (int(share * float(LEVELS) + 0.5) << 2)


@wp.func
def share_of(entry: int) -> float:
    """The share of an entry."""
    return float(entry >> 2) / float(LEVELS)


@wp.func
def place_of(around: Neighbours, i: int) -> int:
    """Where a point lies in the pictures."""
    number = int(i)
    if around.pixel.shape[0] > 0:
        number = around.pixel[i]
    row = number // around.width
    return number + 2 * NEIGHBOURS * row + NEIGHBOURS * (around.width + 2 * NEIGHBOURS) + NEIGHBOURS


@wp.func
def point_at(around: Neighbours, turn: int) -> int:
    """The point of thread `turn` of `turn_count`: tile by tile, where it is known which point lies where; -1: none."""
    if around.pixel.shape[0] > 0 and around.index.shape[0] == 0:
        return turn
    tile = turn // (TILE_WIDTH * TILE_HEIGHT)
    across = (around.width + TILE_WIDTH - 1) // TILE_WIDTH
    row = tile // across
    within = turn - tile * (TILE_WIDTH * TILE_HEIGHT)
    y = row * TILE_HEIGHT + within // TILE_WIDTH
    x = (tile - row * across) * TILE_WIDTH + within % TILE_WIDTH
    if x >= around.width or y >= around.height:
        return -1
    if around.index.shape[0] > 0:
        return around.index[y * around.width + x]
    return y * around.width + x


@wp.func
def found_around(around: Neighbours, k: int, place: int) -> int:
    """What the first rays of a pixel and its neighbours towards shape k found together."""
    together = int(NOTHING)
    for dy in range(-NEIGHBOURS, NEIGHBOURS + 1):
        for dx in range(-NEIGHBOURS, NEIGHBOURS + 1):
            together = together | int(around.found[k, place + dy * (around.width + 2 * NEIGHBOURS) + dx])
    return together & BOTH


@wp.func
def shared_share(around: Neighbours, starts: Starts, k: int, place: int, i: int) -> float:
    """Share of shape k that point i sees by what its neighbours found; negative where they do not tell."""
    number = int(i)
    if around.pixel.shape[0] > 0:
        number = around.pixel[i]
    p = row_vector(starts.rows, 0, i)
    side = row_vector(starts.rows, 6, i)
    count = int(0)
    total = int(0)
    squares = int(0)
    # Sums over the neighbours' offsets: theirs, of their squares, and of them times the levels.
    sum_x = int(0)
    sum_y = int(0)
    square_x = int(0)
    along_x = int(0)
    along_y = int(0)
    brought = float(0.0)
    arrived = float(0.0)
    for dy in range(-NEIGHBOURS, NEIGHBOURS + 1):
        for dx in range(-NEIGHBOURS, NEIGHBOURS + 1):
            entry = int(around.shared[k, place + dy * (around.width + 2 * NEIGHBOURS) + dx])
            if entry != 0:
                j = number + dy * around.width + dx
                if around.index.shape[0] > 0:
                    j = around.index[j]
                away = row_vector(starts.rows, 0, j) - p
                beside = wp.dot(side, away)
                near = beside * beside <= FLATNESS * FLATNESS * wp.dot(away, away)
                if near and wp.dot(side, row_vector(starts.rows, 6, j)) >= SAME_TURN:
                    level = entry >> 2
                    count += 1
                    total += level
                    squares += level * level
                    sum_x += dx
                    sum_y += dy
                    square_x += dx * dx
                    along_x += dx * level
                    along_y += dy * level
                    brought += starts.unshadowed[k, j]
                    arrived += starts.unshadowed[k, j] * float(level)
    spread = total * (LEVELS * count - total)
    between = count * squares - total * total
    edge = SHARP * between > spread and LEAST_SPREAD * spread > LEVELS * LEVELS * count * count
    slope_x = float(count * along_x - total * sum_x)
    slope_y = float(count * along_y - total * sum_y)
    limit = STEEP * float(LEVELS * count * square_x)
    steep = slope_x * slope_x + slope_y * slope_y > limit * limit
    if edge or steep or count < LEAST_COUNT:
        return -1.0
    return arrived / (float(LEVELS) * brought)


@wp.kernel
def image_index_kernel(first: int, pixel: wp.array(dtype=int), out_index: wp.array(dtype=int)):
    """One thread per point of a mirror: where it lies in the image."""
    i = first + wp.tid()
    if pixel[i] >= 0:
        out_index[pixel[i]] = i


def turn_count(around: Neighbours, count: int) -> int:
    """Threads of a launch over all of so many points, by `point_at`."""
    if len(around.pixel) and not len(around.index):
        return count
    width, height = int(TILE_WIDTH), int(TILE_HEIGHT)
    return width * height * -(-around.width // width) * -(-around.height // height)


def neighbours_of(points: Points, area_count: int, shared: bool, threads: int = 0) -> Neighbours:
    """Pictures of which nothing is known yet.

    Args:
        points: What is seen.
        area_count: Shapes that are asked.
        shared: Whether neighbours share what they find.
        threads: CPU threads; 0: one per core.
    """
    device = points.triangle.device
    around = Neighbours()
    around.width, around.height, around.pixel = points.width, points.height, points.pixel
    around.index = compact.none(int, device)
    if area_count and len(points.pixel):
        around.index = wp.full(points.width * points.height, -1, dtype=int, device=device)
        launch(image_index_kernel, len(points.pixel), [points.pixel, around.index], device, threads)
    size = (points.width + 2 * NEIGHBOURS) * (points.height + 2 * NEIGHBOURS) + MARGIN
    around.found = wp.zeros((area_count, size), dtype=wp.uint8, device=device)
    around.shared = wp.zeros((area_count if shared else 0, size), dtype=wp.uint8, device=device)
    return around
