"""The rasteriser of a device: triangles in pieces of the same few pixels, so that no thread draws a large one alone.

What covers little is drawn by one thread each. What is larger is cut into pieces of the pixels it may cover, and threads take
piece after piece. Which triangles those are and where their pieces begin in the row of all pieces is
one sum of an atomic counter: its upper bits count triangles, its lower ones pieces, so that the first pieces of later
triangles are later. Nothing is read by the host.

Source of the idea: Laine and Karras, High-Performance Software Rasterization on GPUs, 2011, section 4 (large triangles must
be shared for the load to balance). Differs from it by: pieces of a triangle instead of queues of tiles, and a z-buffer of
atomic maxima, so that order does not matter.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.launch import launch
from warp_reflect.raster import TargetView, centres, clip, draw_survivor, needs_clipping, screen_corner

wp.set_module_options({"enable_backward": False})

# Pixels of a piece: a thread takes a microsecond for a few of them, and a triangle of as many needs no pieces.
PIECE_WIDTH = wp.constant(16)
PIECE_HEIGHT = wp.constant(8)
# Threads that take pieces: about as many as a large device (132 multiprocessors) holds at a time.
TAKERS = 1 << 17
COUNT_SHIFT = wp.constant(
    wp.int64(38)
)  # of the counter: below it pieces, a million pictures full; above, 33 million triangles
ONE = wp.constant(wp.int64(1))


@wp.func
def piece_rows(window: wp.vec4i) -> wp.vec2i:
    """(pieces side by side, pieces in all) of the pixels (left, top, right, bottom), none of them empty."""
    across = (window[2] - window[0]) / PIECE_WIDTH + 1
    return wp.vec2i(across, across * ((window[3] - window[1]) / PIECE_HEIGHT + 1))


@wp.func
def covered(target: TargetView, a: wp.vec4, b: wp.vec4, c: wp.vec4) -> wp.vec4i:
    """Pixels (left, top, right, bottom) of the target that a triangle may cover; right before left: none."""
    if not (needs_clipping(a) or needs_clipping(b) or needs_clipping(c)):
        return centres(target, a, b, c)
    left = clip(target, a, b, c)
    if left.count == 0:
        return wp.vec4i(0, 0, -1, -1)
    corner = screen_corner(target, left.corners[0])
    low = corner
    high = corner
    for i in range(1, left.count):
        corner = screen_corner(target, left.corners[i])
        low = wp.min(low, corner)
        high = wp.max(high, corner)
    flat = wp.vec4(low[0], low[1], 1.0, 1.0)
    return centres(target, flat, wp.vec4(high[0], high[1], 1.0, 1.0), flat)


@wp.kernel
def draw_small_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    survivors: wp.array(dtype=int),
    survivor_count: wp.array(dtype=int),
    counter: wp.array(dtype=wp.int64),
    out_large: wp.array(dtype=int),
    out_first_piece: wp.array(dtype=wp.int64),
    out_window: wp.array(dtype=wp.vec4i),
):
    """One thread per triangle that may have survived: draws it, or lists it with the number of its first piece."""
    i = first + wp.tid()
    if i >= survivor_count[0]:
        return
    t = survivors[i]
    corners = triangles[t]
    window = covered(target, screen[corners[0]], screen[corners[1]], screen[corners[2]])
    if window[0] > window[2] or window[1] > window[3]:
        return
    pieces = piece_rows(window)
    if pieces[1] > 1:
        before = wp.atomic_add(counter, 0, (ONE << COUNT_SHIFT) + wp.int64(pieces[1]))
        place = int(before >> COUNT_SHIFT)
        out_large[place] = t
        out_window[place] = window
        out_first_piece[place] = before - (wp.int64(place) << COUNT_SHIFT)
        return
    draw_survivor(target, screen, triangles, ids, id_offset, points, plane_triangles, t, target.y0, target.y1)


@wp.kernel
def draw_pieces_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    counter: wp.array(dtype=wp.int64),
    large: wp.array(dtype=int),
    first_piece: wp.array(dtype=wp.int64),
    windows: wp.array(dtype=wp.vec4i),
    takers: int,
):
    """One thread per taker: the pieces whose numbers are its own modulo the takers."""
    large_count = int(counter[0] >> COUNT_SHIFT)
    piece_count = counter[0] - (wp.int64(large_count) << COUNT_SHIFT)
    piece = wp.int64(first + wp.tid())
    while piece < piece_count:
        # The last triangle whose first piece is not behind this one.
        low = int(0)
        high = large_count
        while high - low > 1:
            middle = (low + high) / 2
            if first_piece[middle] <= piece:
                low = middle
            else:
                high = middle
        t = large[low]
        window = windows[low]
        number = int(piece - first_piece[low])
        across = piece_rows(window)[0]
        top = window[1] + number / across * PIECE_HEIGHT
        target.column_first = window[0] + number % across * PIECE_WIDTH
        target.column_end = wp.min(target.column_first + PIECE_WIDTH, target.x1)
        bottom = wp.min(top + PIECE_HEIGHT, target.y1)
        draw_survivor(target, screen, triangles, ids, id_offset, points, plane_triangles, t, top, bottom)
        piece += wp.int64(takers)


def draw(target: TargetView, count: int, survivors: wp.array, survivor_count: wp.array, drawn: list, device) -> None:
    """Draw the survivors of a culling into a target.

    Args:
        target: Where to.
        count: Triangles that may have survived.
        survivors, survivor_count: int, which did; how many, [1].
        drawn: [screen, triangles, ids, id_offset, points, plane_triangles], see `raster.rasterise`.
        device: Warp device.
    """
    counter = wp.zeros(1, dtype=wp.int64, device=device)
    large = wp.empty(count, dtype=int, device=device)
    first_piece = wp.empty(count, dtype=wp.int64, device=device)
    listed = [counter, large, first_piece, wp.empty(count, dtype=wp.vec4i, device=device)]
    launch(draw_small_kernel, count, [target, *drawn, survivors, survivor_count, *listed], device)
    launch(draw_pieces_kernel, TAKERS, [target, *drawn, *listed, TAKERS], device)
