"""Triangles to the cells of a regular grid that they touch, with the heights between which they do.

Every column of the grid under a triangle's box is asked between which heights the triangle lies in it: the heights of its
edges where they cross the column, and of its plane at the column's corners that it covers. That is exact where a test of
boxes against triangles only answers yes, so that a level floor stays as thin as it is. Two launches, one that counts and one
that writes, as every thread writes to places of its own.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect.launch import launch

wp.set_module_options({"enable_backward": False})

# Cells. A triangle that misses a column by less is taken to touch it: float32 corners of cells resolve 1e-3 of a cell at
# worst, and two triangles must leave no slit between them.
TOUCH = wp.constant(1.0e-4)
EMPTY_SPAN = wp.constant(3.0e38)


@wp.func
def widen(span: wp.vec2, z: float) -> wp.vec2:
    return wp.vec2(wp.min(span[0], z), wp.max(span[1], z))


@wp.func
def edge_span(span: wp.vec2, p: wp.vec3, q: wp.vec3, x: float, y: float) -> wp.vec2:
    """The span with the heights of a segment over the unit square at (x, y); Liang and Barsky 1984."""
    d = q - p
    s0 = float(0.0)
    s1 = float(1.0)
    for k in range(2):
        low = wp.where(k == 0, x, y) - TOUCH - p[k]
        high = wp.where(k == 0, x, y) + 1.0 + TOUCH - p[k]
        if d[k] == 0.0:
            if low > 0.0 or high < 0.0:
                s0 = float(2.0)
        else:
            a = low / d[k]
            b = high / d[k]
            s0 = wp.max(s0, wp.min(a, b))
            s1 = wp.min(s1, wp.max(a, b))
    if s0 > s1:
        return span
    return widen(widen(span, p[2] + s0 * d[2]), p[2] + s1 * d[2])


@wp.func
def corner_span(span: wp.vec2, a: wp.vec3, b: wp.vec3, c: wp.vec3, x: float, y: float) -> wp.vec2:
    """The span with the height of a triangle above the point (x, y), if it covers it."""
    eb = (c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)
    ec = (a[0] - x) * (b[1] - y) - (a[1] - y) * (b[0] - x)
    ea = (b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)
    total = ea + eb + ec
    inside = (ea >= 0.0 and eb >= 0.0 and ec >= 0.0) or (ea <= 0.0 and eb <= 0.0 and ec <= 0.0)
    if not inside or total == 0.0:
        return span
    z = (ea * a[2] + eb * b[2] + ec * c[2]) / total
    # Within the triangle's own heights: a sliver's quotient may say anything.
    return widen(span, wp.clamp(z, wp.min(a[2], wp.min(b[2], c[2])), wp.max(a[2], wp.max(b[2], c[2]))))


@wp.func
def column_span(a: wp.vec3, b: wp.vec3, c: wp.vec3, i: int, j: int) -> wp.vec2:
    """Least and greatest height of a triangle over a column; upside down where it is not over it."""
    x = float(i)
    y = float(j)
    span = wp.vec2(EMPTY_SPAN, -EMPTY_SPAN)
    span = edge_span(span, a, b, x, y)
    span = edge_span(span, b, c, x, y)
    span = edge_span(span, c, a, x, y)
    span = corner_span(span, a, b, c, x, y)
    span = corner_span(span, a, b, c, x + 1.0, y)
    span = corner_span(span, a, b, c, x, y + 1.0)
    return corner_span(span, a, b, c, x + 1.0, y + 1.0)


@wp.func
def first_cell(low: float, count: int) -> int:
    return wp.clamp(int(wp.floor(low)), 0, count - 1)


@wp.func
def last_cell(low: float, high: float, count: int) -> int:
    """The last cell that low..high reaches into; what ends on a border belongs to the cell before it."""
    return wp.clamp(wp.max(int(wp.ceil(high)) - 1, int(wp.floor(low))), 0, count - 1)


@wp.kernel
def voxelise_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    triangles: wp.array(dtype=wp.vec3i),
    nx: int,
    ny: int,
    nz: int,
    write: int,
    place: wp.array(dtype=wp.int64),
    out_count: wp.array(dtype=int),
    out_cell: wp.array(dtype=wp.vec3i),
    out_span: wp.array(dtype=wp.vec2),
    out_triangle: wp.array(dtype=int),
):
    """One thread per triangle: how many cells it touches (write 0), or those cells, from its own place on."""
    t = first + wp.tid()
    corner = triangles[t]
    a = points[corner[0]]
    b = points[corner[1]]
    c = points[corner[2]]
    x_low = wp.min(a[0], wp.min(b[0], c[0]))
    x_high = wp.max(a[0], wp.max(b[0], c[0]))
    y_low = wp.min(a[1], wp.min(b[1], c[1]))
    y_high = wp.max(a[1], wp.max(b[1], c[1]))
    x_first = first_cell(x_low, nx)
    x_last = last_cell(x_low, x_high, nx)
    y_first = first_cell(y_low, ny)
    y_last = last_cell(y_low, y_high, ny)
    alone = x_first == x_last and y_first == y_last
    at = wp.int64(0)
    if write != 0:
        at = place[t]
    count = int(0)
    for j in range(y_first, y_last + 1):
        for i in range(x_first, x_last + 1):
            span = wp.vec2(wp.min(a[2], wp.min(b[2], c[2])), wp.max(a[2], wp.max(b[2], c[2])))
            if not alone:
                span = column_span(a, b, c, i, j)
            if span[0] <= span[1]:
                k_first = first_cell(span[0], nz)
                k_last = last_cell(span[0], span[1], nz)
                for k in range(k_first, k_last + 1):
                    if write != 0:
                        n = int(at) + count
                        out_cell[n] = wp.vec3i(i, j, k)
                        low = wp.clamp(span[0], float(k), float(k + 1))
                        out_span[n] = wp.vec2(low, wp.clamp(span[1], low, float(k + 1)))
                        out_triangle[n] = t
                    count += 1
    if write == 0:
        out_count[t] = count


def voxelise(
    points: np.ndarray,
    triangles: np.ndarray,
    shape: tuple[int, int, int],
    device="cpu",
    threads: int = 0,
    fragments_max: int = 1 << 27,
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """The cells of a grid that triangles touch.

    Args:
        points: In the grid frame (`grid_rays.py`), finite, [n, 3]; what lies outside the grid counts to its outermost cells.
        triangles: int [triangle_count, 3].
        shape: Cells (nx, ny, nz).
        device: Warp device.
        threads: CPU threads; 0: one per core.
        fragments_max: Most (triangle, cell) pairs.

    Returns:
        The cells, int32 [k, 3], distinct; the least and the greatest height in each of what touches it, in cells, float32
        [k, 2]; and of the triangle that fills most of it the index, int32 [k]. None if there are too many pairs.
    """
    count = len(triangles)
    if count == 0:
        return np.zeros((0, 3), np.int32), np.zeros((0, 2), np.float32), np.zeros(0, np.int32)
    on_device = [
        wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.ascontiguousarray(triangles, np.int32), dtype=wp.vec3i, device=device),
    ]
    counts = wp.zeros(count, dtype=int, device=device)
    place = wp.zeros(count, dtype=wp.int64, device=device)

    def run(write: int, total: int) -> list[wp.array]:
        kinds = (wp.vec3i, wp.vec2, int)
        made = [wp.empty(total, dtype=kind, device=device) for kind in kinds]
        launch(voxelise_kernel, count, [*on_device, *shape, write, place, counts, *made], device, threads)
        return made

    run(0, 0)
    ends = np.cumsum(counts.numpy(), dtype=np.int64)
    if ends[-1] > fragments_max:
        return None
    place = wp.array(ends - counts.numpy(), dtype=wp.int64, device=device)
    cell, span, triangle = (made.numpy() for made in run(1, int(ends[-1])))
    nx, ny, _ = shape
    number = (cell[:, 2].astype(np.int64) * ny + cell[:, 1]) * nx + cell[:, 0]
    order = np.lexsort((span[:, 1] - span[:, 0], number))
    ordered = number[order]
    start = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    last = np.concatenate([start[1:], [len(order)]]) - 1
    spans = np.stack([np.minimum.reduceat(span[order, 0], start), np.maximum.reduceat(span[order, 1], start)], axis=1)
    return cell[order[start]], spans, triangle[order[last]]
