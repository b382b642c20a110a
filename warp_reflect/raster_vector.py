"""`raster.draw_kernel` without rays, with triangles and pixels side by side: the same picture, bit for bit.

Triangles are set up in vectors, and those within a box of 64 pixels are drawn without further ado; larger ones, and what the
plain kernel's functions leave of those that have to be clipped, one at a time. Fragments need no memory but their own keys:
pixels that lie side by side are drawn at once, tile by tile of 64 pixels. A tile remembers what it is covered by, and what
lies behind that is not drawn (Hasselgren, Andersson and Akenine-Moeller, Masked Software Occlusion Culling, HPG 2016, section
3, with one layer; here nothing is lost by it, as the depths themselves are kept too).

Edge functions of a triangle within a box of 64 pixels are exact in 32 bits (products below 2^29, sums of two below 2^30, and a
vector reaches at most 15 pixels past the box); of larger ones in float64, whose 53 bits hold everything below 2^46, or in
64 bits where a tile begins.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.compact import listed
from warp_reflect.launch import launch, launch_bands
from warp_reflect.layers import CameraView
from warp_reflect.raster import (
    GUARD,
    Clipped,
    PlaneView,
    Target,
    TargetView,
    balanced_bands,
    clip,
    draw_triangle,
    in_guard,
    needs_clipping,
    screen_corner,
    survivor,
)

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)
WIDTH_MIN = 16  # pixels: the most lanes
MOST_ROWS = 32767  # of a picture: half of 32 bits


def tile_words(box: tuple[int, int, int, int]) -> int:
    """Words for the tiles of a target over a box, whether they have 8 x 8 pixels or 16 x 4."""
    x0, y0, x1, y1 = box
    return 2 * -(-(x1 - x0) // 8) * -(-(y1 - y0) // 4)


# What both snippets begin with.
_TARGET = (
    vector.TRIANGLES
    + r"""
    const int width = target.x1 - target.x0;
    const bool masked = target.mask_value > 0;
    unsigned long long* keys = (unsigned long long*)target.key.data;
    const F key_min = F(target.key_min);

    // Rows of keys are worked on as they lie, LANES side by side: as their halves, without a shuffle across 128 bits, where
    // lane l has the key `place(l)`.
    auto place = [](int l) -> int { return (l & 1) + ((l >> 2) << 1) + ((l & 2) ? LANES / 2 : 0); };
    I places;
    EACH_LANE places[l] = place(l);
    typedef long long Keys __attribute__((ext_vector_type(LANES / 2)));
    constexpr unsigned ALL = (1u << LANES) - 1;
    // The larger keys, which order like whole numbers with a sign, of those at `at` and of halves that are 0 where there is none.
    auto put = [&](unsigned long long* at, I low, I high) {
        const Keys drawn[2] = {__builtin_bit_cast(Keys, first_words(low, high)),
            __builtin_bit_cast(Keys, last_words(low, high))};
        Keys now[2];
        __builtin_memcpy(now, at, sizeof(now));
        const decltype(now[0] > now[0]) newer[2] = {drawn[0] > now[0], drawn[1] > now[1]};
        if (!marks(__builtin_bit_cast(I, newer[0] | newer[1]))) return;
        now[0] = newer[0] ? drawn[0] : now[0];
        now[1] = newer[1] ? drawn[1] : now[1];
        __builtin_memcpy(at, now, sizeof(now));
    };
    // `count` rows from row y of the target on, at the LANES columns from x on: edge functions with their biases, their steps
    // from row to row, and depth of the row that many below the first from them. Gives a bit for each covered pixel. Masks are
    // signs of numbers: as truth values they would be turned to and fro.
    auto draw_rows = [&](int x, int y, int count, I ea, I eb, I ec, I row_a, I row_b, I row_c, I low, auto depth_of)
        __attribute__((always_inline)) -> unsigned long long {
        unsigned long long* at = keys + y * width + x;
        unsigned long long covered = 0;
        for (int row = 0; row < count; ++row, at += width, ea += row_a, eb += row_b, ec += row_c) {
            const I outside = ea | eb | ec;
            if (marks(outside) == ALL) continue;
            const F depth = depth_of(row, ea, eb, ec, outside);
            I inside = __builtin_bit_cast(I, key_min - depth) & ~outside;
            if (masked) {
                const int* mask = target.mask.data + (target.y0 + y + row) * target.mask_width + target.x0 + x;
                inside &= igather(mask, places) == target.mask_value;
            }
            covered |= (unsigned long long)marks(inside) << LANES * row;
            inside >>= 31;
            put(at, low & inside, __builtin_bit_cast(I, depth) & inside);
        }
        return covered;
    };

    // What hides what, per tile of 64 pixels: all its keys are at least `known`; those of `covered` at least `found`.
    constexpr int TILE_ROWS = 64 / LANES;
    struct Tile { float known, found; unsigned long long covered; };
    Tile* tile_of = (Tile*)tiles.data;
    const int tile_columns = (width + LANES - 1) / LANES;
    auto cover = [&](Tile& tile, int y_tile, unsigned long long covered, float depth) {
        if (covered == 0) return;
        if (tile.covered == 0 || depth < tile.found) tile.found = depth;
        tile.covered |= covered;
        const int left = target.y1 - target.y0 - y_tile;
        const unsigned long long all = left >= TILE_ROWS ? ~0ull : ~0ull >> LANES * (TILE_ROWS - left);
        if (tile.covered != all) return;
        if (tile.found > tile.known) tile.known = tile.found;
        tile.covered = 0;
    };
    // Keys between which the depths of a triangle with these lie, as they are rounded.
    auto above = [](auto key) { return key * 1.000001f + 1.0e-37f; };
    auto below = [](auto key) { return key * 0.999999f - 1.0e-37f; };
"""
)


@wp.func_native(
    vector.snippet(
        vector.TRIANGLES
        + f"    constexpr int MOST_ROWS = {MOST_ROWS};"
        + r"""
    const int* corner_of = (const int*)triangles.data;
    const float* screen_of = (const float*)screen.data;
    const int end = begin + BLOCK < triangles.shape[0] ? begin + BLOCK : triangles.shape[0];
    int survivors[BLOCK + LANES], rows[BLOCK + LANES];
    float nearest[BLOCK + LANES];
    int count = 0;
    for (int start = begin; start < end; start += LANES) {
        const int length = end - start < LANES ? end - start : LANES;
        const int* corners = corner_of + 3 * start;
        int rest[3 * LANES];
        if (length < LANES) {
            for (int k = 0; k < 3 * LANES; ++k) rest[k] = corners[k < 3 * length ? k : k % 3];
            corners = rest;
        }
        const Corners c = cornered(corners, 3, screen_of, guard, target.x0, target.y0, target.x1, target.y1);
        const unsigned valid = (1u << length) - 1;
        unsigned cut = marks(c.clipped) & valid;
        for (unsigned left = cut; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            if (beside(corners + 3 * l, screen_of, target)) cut &= ~(1u << l);
        }
        const unsigned kept = cut | marks(c.sound & (c.left <= c.right) & (c.top <= c.bottom)) & valid;
        const F key = fmax(c.v[0].z, fmax(c.v[1].z, c.v[2].z)), farthest = fmin(c.v[0].z, fmin(c.v[1].z, c.v[2].z));
        packed((int*)nearest + count, __builtin_bit_cast(I, pick(farthest == 0.0f, F(__builtin_inff()), key)), kept);
        packed(rows + count, ipick(c.clipped, I(MOST_ROWS << 16), c.top | c.bottom << 16), kept);
        count += packed(survivors + count, start + lanes(), kept);
    }
    int* place = out_survivor_count.data + begin / step;
    const int at = begin / step * step + *place;
    __builtin_memcpy(out_survivors.data + at, survivors, sizeof(int) * count);
    __builtin_memcpy(out_rows.data + at, rows, sizeof(int) * count);
    *place += count;
    for (int k = 0; k < count; ++k) {
        float& most = out_nearest.data[(at + k) / BLOCK];
        most = (at + k) % BLOCK == 0 || nearest[k] > most ? nearest[k] : most;
    }
"""
    )
)
def cull_block(
    begin: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    step: int,
    guard: float,
    out_survivors: wp.array(dtype=int),
    out_rows: wp.array(dtype=int),
    out_survivor_count: wp.array(dtype=int),
    out_nearest: wp.array(dtype=float),
): ...


@wp.kernel
def cull_blocks_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    step: int,
    out_survivors: wp.array(dtype=int),
    out_rows: wp.array(dtype=int),
    out_survivor_count: wp.array(dtype=int),
    out_nearest: wp.array(dtype=float),
):
    """As `raster.cull_kernel`, one thread per block of triangles; runs of `step` triangles begin at multiples of `BLOCK`.

    Of each survivor there are the first and, times 65536, the last of its rows; of each block of survivors the depth key of the
    nearest corner, infinite where the eye's own plane cuts a triangle.
    """
    begin = (first + wp.tid()) * BLOCK
    cull_block(begin, target, screen, triangles, step, GUARD, out_survivors, out_rows, out_survivor_count, out_nearest)


@wp.func_native(
    vector.snippet(
        _TARGET
        + r"""
    // The most that an edge function grows by from the first pixel of a tile on.
    auto over = [](I dx, I dy) -> I {
        return (dx > 0 ? dx * (256 * (TILE_ROWS - 1)) : 0) - (dy < 0 ? dy * (256 * (LANES - 1)) : 0);
    };
    const int* corner_of = (const int*)triangles.data;
    const int* numbers = survivors.data + begin;
    const float* screen_of = (const float*)screen.data;
    const int row0 = target.y0 > row_first ? target.y0 : row_first;
    const int row1 = target.y1 < row_end ? target.y1 : row_end;

    unsigned long long others = 0;
    for (int start = 0; start < count; start += LANES) {
        const int length = count - start < LANES ? count - start : LANES;
        const unsigned valid = (1u << length) - 1;
        const I reached = iload(rows.data + begin + start);
        if (!(marks(((reached & 65535) < row1) & ((reached >> 16) >= row0)) & valid)) continue;
        int corners[3 * LANES], number[LANES];
        for (int l = 0; l < LANES; ++l) {
            number[l] = numbers[start + (l < length ? l : 0)];
            __builtin_memcpy(corners + 3 * l, corner_of + 3 * number[l], 3 * sizeof(int));
        }
        const Corners c = cornered(corners, 3, screen_of, guard, target.x0, row0, target.x1, row1);
        F k[3] = {c.v[0].z, c.v[1].z, c.v[2].z};
        if (target.painter != 0) {
            const F middle = (k[0] + k[1] + k[2]) / 3.0f;
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each)
                k[each] = pick(k[each] > 0.0f, middle, k[each]);
        }
        const unsigned seen = marks(c.sound & (c.left <= c.right) & (c.top <= c.bottom)) & valid, small = marks(c.small);
        others |= (unsigned long long)(marks(c.clipped) & valid | seen & ~small) << start;
        if (!(seen & small)) continue;
        I drawn = marked(seen & small);
        // Of what is not drawn here products would not fit.
        const I xa = ipick(drawn, c.x[0], I(0)), ya = ipick(drawn, c.y[0], I(0));
        I xb = ipick(drawn, c.x[1], I(0)), yb = ipick(drawn, c.y[1], I(0));
        I xc = ipick(drawn, c.x[2], I(0)), yc = ipick(drawn, c.y[2], I(0));
        I area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa);
        drawn &= area != 0;
        const I turned = area < 0;
        area = ipick(turned, -area, area);
        const I x_b = xb, y_b = yb;
        xb = ipick(turned, xc, xb); yb = ipick(turned, yc, yb);
        xc = ipick(turned, x_b, xc); yc = ipick(turned, y_b, yc);
        const F kb = pick(turned, k[2], k[1]), kc = pick(turned, k[1], k[2]);
        const I dxa = xc - xb, dya = yc - yb, dxb = xa - xc, dyb = ya - yc, dxc = xb - xa, dyc = yb - ya;
        const I px = ipick(drawn, c.left * 256 + 128, I(0)), py = ipick(drawn, c.top * 256 + 128, I(0));
        const F inv_area = 1.0f / __builtin_convertvector(area, F);
        // Of every triangle: edges at the first pixel, steps, and what is left of it.
        enum { EA, EB, EC, BIAS_A, BIAS_B, BIAS_C, OVER_A, OVER_B, OVER_C,
            DXA, DXB, DXC, DYA, DYB, DYC, COLUMN, COLUMNS, ROW, ROWS, LOW, FIELDS };
        int field[FIELDS][LANES];
        istore(field[EA], dxa * (py - yb) - dya * (px - xb));
        istore(field[EB], dxb * (py - yc) - dyb * (px - xc));
        istore(field[EC], dxc * (py - ya) - dyc * (px - xa));
        const I bias[3] = {edge_bias(dxa, dya), edge_bias(dxb, dyb), edge_bias(dxc, dyc)};
        istore(field[BIAS_A], bias[0]);
        istore(field[BIAS_B], bias[1]);
        istore(field[BIAS_C], bias[2]);
        istore(field[OVER_A], bias[0] + over(dxa, dya));
        istore(field[OVER_B], bias[1] + over(dxb, dyb));
        istore(field[OVER_C], bias[2] + over(dxc, dyc));
        istore(field[DXA], dxa * 256);
        istore(field[DXB], dxb * 256);
        istore(field[DXC], dxc * 256);
        istore(field[DYA], dya * 256);
        istore(field[DYB], dyb * 256);
        istore(field[DYC], dyc * 256);
        istore(field[COLUMN], c.left - target.x0);
        istore(field[COLUMNS], c.right - c.left);
        istore(field[ROW], c.top - target.y0);
        istore(field[ROWS], c.bottom - c.top);
        istore(field[LOW], ~(ids.shape[0] > 0 ? igather(ids.data, iload(number)) : iload(number) + id_offset));
        float keys_a[LANES], keys_b[LANES], keys_c[LANES], inverse[LANES];
        store(keys_a, k[0]);
        store(keys_b, kb);
        store(keys_c, kc);
        store(inverse, inv_area);
        float most_key[LANES], least_key[LANES];
        store(most_key, above(fmax(k[0], fmax(kb, kc))));
        store(least_key, below(fmin(k[0], fmin(kb, kc))));
        for (unsigned left_over = marks(drawn); left_over != 0; left_over &= left_over - 1) {
            const int l = __builtin_ctz(left_over);
            const int x_first = field[COLUMN][l], x_last = x_first + field[COLUMNS][l];
            const int y_first = field[ROW][l], y_last = y_first + field[ROWS][l];
            const int row_a = field[DXA][l], row_b = field[DXB][l], row_c = field[DXC][l];
            const int step_a = field[DYA][l], step_b = field[DYB][l], step_c = field[DYC][l];
            const I bias_a = I(field[BIAS_A][l]), bias_b = I(field[BIAS_B][l]), bias_c = I(field[BIAS_C][l]);
            const I across_a = bias_a - places * step_a, across_b = bias_b - places * step_b;
            const I across_c = bias_c - places * step_c;
            const F key_a = F(keys_a[l]), key_b = F(keys_b[l]), key_c = F(keys_c[l]), inv = F(inverse[l]);
            auto depth_of = [&](int row, I ea, I eb, I ec, I outside) __attribute__((always_inline)) -> F {
                return (__builtin_convertvector(ea - bias_a, F) * key_a + __builtin_convertvector(eb - bias_b, F) * key_b
                    + __builtin_convertvector(ec - bias_c, F) * key_c) * inv;
            };
            // From a multiple of LANES on: what a triangle writes and the next one reads are the same words, which are
            // handed on without waiting for memory. The last vector of a row ends with it.
            auto columns_at = [&](int x) -> int { return x + LANES <= width ? x : width - LANES; };
            auto draw_at = [&](int x, int y, int count) __attribute__((always_inline)) -> unsigned long long {
                const int a = field[EA][l] + (y - y_first) * row_a - (x - x_first) * step_a;
                const int b = field[EB][l] + (y - y_first) * row_b - (x - x_first) * step_b;
                const int c = field[EC][l] + (y - y_first) * row_c - (x - x_first) * step_c;
                if (((a + field[OVER_A][l]) | (b + field[OVER_B][l]) | (c + field[OVER_C][l])) < 0) return 0;
                return draw_rows(x, y, count, a + across_a, b + across_b, c + across_c, I(row_a), I(row_b), I(row_c),
                    I(field[LOW][l]), depth_of);
            };
            for (int y_tile = y_first & -TILE_ROWS; y_tile <= y_last; y_tile += TILE_ROWS) {
                const int y = y_tile > y_first ? y_tile : y_first;
                const int count = (y_tile + TILE_ROWS <= y_last ? y_tile + TILE_ROWS : y_last + 1) - y;
                for (int x = x_first & -LANES; x <= x_last; x += LANES) {
                    Tile& tile = tile_of[y_tile / TILE_ROWS * tile_columns + x / LANES];
                    if (most_key[l] < tile.known) continue;
                    cover(tile, y_tile, draw_at(columns_at(x), y, count) << LANES * (y - y_tile), least_key[l]);
                }
            }
        }
    }
    return others;
""",
        "return 0;",
    )
)
def draw_block(
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    survivors: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    begin: int,
    count: int,
    row_first: int,
    row_end: int,
    guard: float,
    tiles: wp.array(dtype=wp.uint64),
) -> wp.uint64:
    """Draw those of `count` survivors that are small; a bit for each of the others."""
    ...


@wp.func_native(
    vector.snippet(
        _TARGET
        + vector.ONE_TRIANGLE
        + r"""
    const float ka = a[2];
    const int x_first = left - target.x0, x_last = right - target.x0;
    const int y_first = top - target.y0, y_last = bottom - target.y0;
    // Steps are multiples of 256, so that the sign of an edge function is that of its whole part in those: within a tile
    // that the edge crosses it has 32 bits, and elsewhere any number as large has its sign.
    auto coarse = [](long long e) -> int {
        e >>= 8;
        return e > (1 << 30) ? 1 << 30 : e < -(1 << 30) ? -(1 << 30) : (int)e;
    };
    auto over = [](int dx, int dy) -> long long {
        return (dx > 0 ? 256LL * (TILE_ROWS - 1) * dx : 0) - (dy < 0 ? 256LL * (LANES - 1) * dy : 0);
    };
    const long long over_a = over(dxa, dya), over_b = over(dxb, dyb), over_c = over(dxc, dyc);
    const I across_a = places * dya, across_b = places * dyb, across_c = places * dyc;
    const D wide = __builtin_convertvector(places, D);
    const D wide_a = wide * (dya * 256.0), wide_b = wide * (dyb * 256.0), wide_c = wide * (dyc * 256.0);
    const double over_area = 1.0 / (double)area;
    const double x_slope = -256.0 * ((double)dya * ka + (double)dyb * kb + (double)dyc * kc) * over_area;
    const double y_slope = 256.0 * ((double)dxa * ka + (double)dxb * kb + (double)dxc * kc) * over_area;
    // With what the slopes lose where a sliver's terms cancel.
    auto magnitude = [&](double a, double b, double c) -> double {
        return (__builtin_fabs(a) * ka + __builtin_fabs(b) * kb + __builtin_fabs(c) * kc) * over_area * 1.0e-14;
    };
    const double rise = (x_slope > 0.0 ? x_slope * (LANES - 1) : 0.0) + (y_slope > 0.0 ? y_slope * (TILE_ROWS - 1) : 0.0)
        + 256.0 * (LANES * magnitude(dya, dyb, dyc) + TILE_ROWS * magnitude(dxa, dxb, dxc));
    const float most_key = ka > kb ? (ka > kc ? ka : kc) : (kb > kc ? kb : kc);
    for (int y_tile = y_first & -TILE_ROWS; y_tile <= y_last; y_tile += TILE_ROWS) {
        const int y = y_tile > y_first ? y_tile : y_first;
        const int count = (y_tile + TILE_ROWS <= y_last ? y_tile + TILE_ROWS : y_last + 1) - y;
        for (int x = x_first & -LANES; x <= x_last; x += LANES) {
            const int x_begin = x + LANES <= width ? x : width - LANES;
            const long long right_of = 256LL * (x_begin - x_first), under = 256LL * (y - y_first);
            const long long ea = ea0 + under * dxa - right_of * dya, eb = eb0 + under * dxb - right_of * dyb;
            const long long ec = ec0 + under * dxc - right_of * dyc;
            if (((ea + bias_a + over_a) | (eb + bias_b + over_b) | (ec + bias_c + over_c)) < 0) continue;
            Tile& tile = tile_of[y_tile / TILE_ROWS * tile_columns + x / LANES];
            const double nearest = ((double)ea * ka + (double)eb * kb + (double)ec * kc) * over_area
                + magnitude(ea, eb, ec) + rise;
            if (above((float)(nearest < most_key ? nearest : most_key)) < tile.known) continue;
            F found = F(__builtin_inff());
            auto depth_of = [&](int row, I, I, I, I outside) __attribute__((always_inline)) -> F {
                const double down = 256.0 * row;
                const F a = __builtin_convertvector((double)ea + down * dxa - wide_a, F);
                const F b = __builtin_convertvector((double)eb + down * dxb - wide_b, F);
                const F c = __builtin_convertvector((double)ec + down * dxc - wide_c, F);
                const F depth = (a * ka + b * kb + c * kc) * inv_area;
                found = fmin(found, pick(outside < 0, F(__builtin_inff()), depth));
                return depth;
            };
            const unsigned long long covered = draw_rows(x_begin, y, count, coarse(ea + bias_a) - across_a,
                coarse(eb + bias_b) - across_b, coarse(ec + bias_c) - across_c, I(dxa), I(dxb), I(dxc),
                I(low), depth_of);
            float nearby = found[0];
            EACH_LANE nearby = found[l] < nearby ? found[l] : nearby;
            cover(tile, y_tile, covered << LANES * (y - y_tile), nearby);
        }
    }
"""
    )
)
def draw_large(
    target: TargetView,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    triangle: int,
    row_first: int,
    row_end: int,
    tiles: wp.array(dtype=wp.uint64),
): ...


@wp.kernel
def draw_blocks_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    step: int,
    survivors: wp.array(dtype=int),
    rows: wp.array(dtype=int),
    survivor_count: wp.array(dtype=int),
    order: wp.array(dtype=int),
    tiles: wp.array(dtype=wp.uint64),
    row_first: int,
    row_end: int,
):
    """As `raster.draw_kernel` into a target without rays, one thread per block of what `cull_blocks_kernel` leaves.

    `order`: where the blocks begin. The target is `WIDTH_MIN` pixels wide or more.
    """
    task, _ = wp.tid()
    begin = order[first + task]
    part = begin / step
    count = wp.min(part * step + survivor_count[part] - begin, BLOCK)
    left = draw_block(
        target,
        screen,
        triangles,
        ids,
        id_offset,
        survivors,
        rows,
        begin,
        count,
        row_first,
        row_end,
        GUARD,
        tiles,
    )
    i = begin
    while left != wp.uint64(0):
        if (left & wp.uint64(1)) != wp.uint64(0):
            t = survivors[i]
            drawn = survivor(target, screen, triangles, ids, id_offset, t)
            a = drawn.a
            b = drawn.b
            c = drawn.c
            triangle = drawn.triangle
            clipped = Clipped()
            clipped.count = 3
            whole = not (needs_clipping(a) or needs_clipping(b) or needs_clipping(c))
            if not whole:
                clipped = clip(target, a, b, c)
            for k in range(1, clipped.count - 1):
                p = wp.vec3(a[0], a[1], a[2])
                q = wp.vec3(b[0], b[1], b[2])
                r = wp.vec3(c[0], c[1], c[2])
                if not whole:
                    p = screen_corner(target, clipped.corners[0])
                    q = screen_corner(target, clipped.corners[k])
                    r = screen_corner(target, clipped.corners[k + 1])
                if in_guard(p) and in_guard(q) and in_guard(r):
                    draw_large(
                        target,
                        p,
                        q,
                        r,
                        triangle,
                        row_first,
                        row_end,
                        tiles,
                    )
                else:
                    draw_triangle(target, p, q, r, PlaneView(), triangle, row_first, row_end)
        left = left >> wp.uint64(1)
        i += 1


def draw(target: Target, screen: wp.array, named: list, step: int, parts: int, threads: int) -> wp.array:
    """Cull triangles and draw what is left; see `raster.rasterise`, which gives survivors in runs of `step` triangles.

    Args:
        named: Triangles, what the z-buffer stores of them, and what is added to their index otherwise.
        parts: Threads that there are for it.
    """
    triangles, device = named[0], target.key.device
    count = len(triangles)
    survivors = wp.empty(count, dtype=int, device=device)
    rows = wp.empty(count + BLOCK, dtype=int, device=device)  # vectors end behind the last one
    survivor_count = wp.zeros(-(-count // step), dtype=int, device=device)
    nearest = wp.empty(vector.block_count(count), dtype=float, device=device)
    inputs = [target.view, screen, triangles, step, survivors, rows, survivor_count, nearest]
    split, runs_of = vector.BLOCK_SPLIT_MIN, vector.block_count(step)  # the only run may end within a block
    launch(cull_blocks_kernel, vector.block_count(count), inputs, device, threads, split, runs_of)
    # The blocks with the nearest corners first: what lies behind need not be drawn. Blocks stay together: neighbours in a mesh
    # find each other's corners and pixels in the caches.
    left = survivor_count.numpy()
    order = np.concatenate(
        [np.arange(k * step, k * step + n, vector.BLOCK, np.int32) for k, n in enumerate(left.tolist())]
    )
    order = order[np.argsort(-nearest.numpy()[order // vector.BLOCK], kind="stable")]
    bands = [(target.box[1], target.box[3])]
    if parts > 1:
        bands = balanced_bands(target.box, rows.numpy()[order] & MOST_ROWS, parts)
    tiles = wp.zeros(tile_words(target.box), dtype=wp.uint64, device=device)
    inputs = [target.view, screen, *named, step, survivors, rows, survivor_count, listed(order, device), tiles]
    launch_bands(draw_blocks_kernel, len(order), bands, inputs, device)
    return survivor_count


@wp.func_native(
    vector.snippet(r"""
    // layers.project
    const int end = begin + BLOCK < points.shape[0] ? begin + BLOCK : points.shape[0];
    const float* point_of = (const float*)points.data;
    const V eye = spread(camera.eye), forward = spread(camera.forward);
    auto along = [](const auto& row, V p) -> F { return row[0] * p.x + row[1] * p.y + row[2] * p.z + row[3]; };
    for (int start = begin; start < end; start += LANES) {
        const bool full = start + LANES <= end;
        const V p = sub(vrows(point_of, start, full, ipick(start + lanes() < end, start + lanes(), I(start))), eye);
        const F depth = dot(forward, p);
        const I before = depth < camera.near;
        V v = V{along(camera.x_row, p), along(camera.y_row, p), 1.0f - depth / camera.far};
        if (camera.orthographic == 0) {
            const F inverse = 1.0f / depth;
            v = V{pick(before, v.x, v.x * inverse), pick(before, v.y, v.y * inverse), inverse};
        }
        v.z = pick(before, F(0.0f), v.z);
        float rest[4 * LANES];
        vstore4(full ? (float*)out_screen.data + 4 * start : rest, 0, v, depth);
        if (!full) __builtin_memcpy((float*)out_screen.data + 4 * start, rest, 4 * sizeof(float) * (end - start));
    }
""")
)
def project_block(
    begin: int, points: wp.array(dtype=wp.vec3), camera: CameraView, out_screen: wp.array(dtype=wp.vec4)
): ...


@wp.kernel
def project_blocks_kernel(
    first: int, points: wp.array(dtype=wp.vec3), camera: wp.array(dtype=CameraView), out_screen: wp.array(dtype=wp.vec4)
):
    """As `raster.project_kernel`, one thread per block of vertices."""
    project_block((first + wp.tid()) * BLOCK, points, camera[0], out_screen)


@wp.func_native(
    vector.snippet(r"""
    const unsigned long long* keys = (const unsigned long long*)key.data;
    const int end = begin + BLOCK < key.shape[0] ? begin + BLOCK : key.shape[0];
    int i = begin;
    // The complement of an empty key's half is -1.
    for (; i + LANES <= end; i += LANES) {
        I low, high;
        halves(keys + i, low, high);
        istore(out_triangle.data + i, ~low);
        store(out_depth_key.data + i, __builtin_bit_cast(F, high));
    }
    for (; i < end; ++i) {
        out_triangle.data[i] = ~(int)keys[i];
        out_depth_key.data[i] = __builtin_bit_cast(float, (unsigned)(keys[i] >> 32));
    }
""")
)
def resolve_block(
    begin: int, key: wp.array(dtype=wp.uint64), out_triangle: wp.array(dtype=int), out_depth_key: wp.array(dtype=float)
): ...


@wp.kernel
def resolve_blocks_kernel(
    first: int, key: wp.array(dtype=wp.uint64), out_triangle: wp.array(dtype=int), out_depth_key: wp.array(dtype=float)
):
    """As `raster.resolve_kernel`, one thread per block of pixels."""
    resolve_block((first + wp.tid()) * BLOCK, key, out_triangle, out_depth_key)
