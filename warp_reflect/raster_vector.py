"""`raster.draw_kernel` with pixels of a row side by side: the same picture, bit for bit.

Edge functions of a triangle within a box of 64 pixels are exact in 32 bits (products below 2^29, sums of two below 2^30, and a
vector reaches at most 16 pixels past the box); of larger ones in float64, whose 53 bits hold everything below 2^46.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.raster import (
    RAY_ALONG_MIN,
    RAY_TRUST,
    PlaneView,
    TargetView,
    at_depth,
    draw_clipped,
    needs_clipping,
    triangle_plane,
)

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(r"""
    typedef double D __attribute__((ext_vector_type(LANES)));
    typedef long long S __attribute__((ext_vector_type(LANES)));
    auto snap = [](float x) -> int { return (int)__builtin_floorf(x * 256.0f + 0.5f); };
    auto least = [](int p, int q) -> int { return p < q ? p : q; };
    auto most = [](int p, int q) -> int { return p > q ? p : q; };
    // What is no finite number snaps to no pixel.
    const float none = (a[0] + a[1] + a[2] + b[0] + b[1] + b[2] + c[0] + c[1] + c[2]) * 0.0f;
    if (!(none == 0.0f)) return;
    const int xa = snap(a[0]), ya = snap(a[1]);
    int xb = snap(b[0]), yb = snap(b[1]), xc = snap(c[0]), yc = snap(c[1]);
    const float ka = a[2];
    float kb = b[2], kc = c[2];
    long long area = (long long)(xb - xa) * (yc - ya) - (long long)(yb - ya) * (xc - xa);
    if (area == 0) return;
    if (area < 0) {
        area = -area;
        const int x = xb, y = yb;
        const float k = kb;
        xb = xc; yb = yc; kb = kc;
        xc = x; yc = y; kc = k;
    }
    const int low_x = least(xa, least(xb, xc)), high_x = most(xa, most(xb, xc));
    const int low_y = least(ya, least(yb, yc)), high_y = most(ya, most(yb, yc));
    const int left = most((low_x + 127) >> 8, target.x0), right = least((high_x - 128) >> 8, target.x1 - 1);
    const int top = most((low_y + 127) >> 8, most(target.y0, row_first));
    const int bottom = least((high_y - 128) >> 8, least(target.y1, row_end) - 1);
    if (left > right || top > bottom) return;
    const int dxa = xc - xb, dya = yc - yb, dxb = xa - xc, dyb = ya - yc, dxc = xb - xa, dyc = yb - ya;
    const int px = left * 256 + 128, py = top * 256 + 128;
    const long long ea0 = (long long)dxa * (py - yb) - (long long)dya * (px - xb);
    const long long eb0 = (long long)dxb * (py - yc) - (long long)dyb * (px - xc);
    const long long ec0 = (long long)dxc * (py - ya) - (long long)dyc * (px - xa);
    // raster.edge_bias
    const int bias_a = dya < 0 || (dya == 0 && dxa > 0) ? 0 : -1;
    const int bias_b = dyb < 0 || (dyb == 0 && dxb > 0) ? 0 : -1;
    const int bias_c = dyc < 0 || (dyc == 0 && dxc > 0) ? 0 : -1;
    const float inv_area = 1.0f / (float)area;
    const int width = target.x1 - target.x0;
    const bool rays = target.ray.shape[0] > 0;
    // A masked target with rays has none outside its mask.
    const bool masked = target.mask_value > 0 && !rays;
    const float* ray_of = (const float*)target.ray.data;
    unsigned long long* keys = (unsigned long long*)target.key.data;
    const unsigned low_word = ~(unsigned)triangle;
    const F key_min = F(target.key_min);

    auto put = [&](int cell, float key) {
        const unsigned high = __builtin_bit_cast(unsigned, key);
        const unsigned long long packed = ((unsigned long long)high << 32) | low_word;
        if (packed > keys[cell]) keys[cell] = packed;
    };
    // Fragments of interpolated keys at cells; raster.ray_key where there are rays.
    auto put_all = [&](I inside, I cell, F depth) {
        inside &= depth > key_min;
        F now;
        EACH_LANE now[l] = __builtin_bit_cast(float, (unsigned)(keys[cell[l]] >> 32));
        if (rays) {
            F ray[8];
            gather8(ray_of, 8 * cell, ray);
            const V o = V{ray[0], ray[1], ray[2]}, d = V{ray[4], ray[5], ray[6]};
            const F o_w = ray[3], d_w = ray[7];
            const F path = d_w / depth;
            const F along = plane.n[0] * d.x + plane.n[1] * d.y + plane.n[2] * d.z;
            const F height = plane.offset - plane.n[0] * o.x - plane.n[1] * o.y - plane.n[2] * o.z;
            const F linear = path - o_w;
            const F t = height / along;
            const I trusted = (__builtin_elementwise_abs(along) > ray_along_min)
                & (__builtin_elementwise_abs(t - linear) < ray_trust * path);
            const F total = o_w + pick(trusted, fmax(t, F(0.0f)), linear);
            depth = 1.0f / fmax(total, F(1.0e-30f));
            inside &= d_w > 0.0f;
        }
        float depths[LANES];
        int cells[LANES];
        store(depths, depth);
        istore(cells, cell);
        for (unsigned left_bits = bits(inside & (depth >= now)); left_bits != 0; left_bits &= left_bits - 1) {
            const int l = __builtin_ctz(left_bits);
            put(cells[l], depths[l]);
        }
    };

    if (high_x - low_x <= 64 * 256 && high_y - low_y <= 64 * 256) {
        // The run of covered pixels of every row, rows side by side: an edge is crossed at a quotient of whole numbers below
        // 2^31 and 2^22, which float64 tells from its neighbours with `slack` to spare.
        int run_first[64 + LANES], run_length[64 + LANES];
        const double slack = 1.0 / (1 << 24);
        const int rows = bottom - top + 1;
        const I last = I(right - left);
        for (int start = 0; start < rows; start += LANES) {
            const I row = start + lanes();
            I first = I(0), end = last;
            auto cut = [&](int e0, int bias, int dx, int dy) {
                const I e = e0 + bias + row * (dx * 256);
                if (dy == 0) {
                    end = ipick(e >= 0, end, I(-1));
                    return;
                }
                const D crossing = __builtin_convertvector(e, D) * (1.0 / (dy * 256.0));
                if (dy > 0) {
                    const I at = __builtin_convertvector(__builtin_elementwise_floor(crossing + slack), I);
                    end = at < end ? at : end;
                } else {
                    const I at = __builtin_convertvector(__builtin_elementwise_ceil(crossing - slack), I);
                    first = at > first ? at : first;
                }
            };
            cut((int)ea0, bias_a, dxa, dya);
            cut((int)eb0, bias_b, dxb, dyb);
            cut((int)ec0, bias_c, dxc, dyc);
            const I length = end - first + 1;
            istore(run_first + start, first);
            istore(run_length + start, length > 0 ? length : I(0));
        }
        const int xstep_a = dya * 256, xstep_b = dyb * 256, xstep_c = dyc * 256;
        const int ystep_a = dxa * 256, ystep_b = dxb * 256, ystep_c = dxc * 256;
        const int cell0 = (top - target.y0) * width + left - target.x0;
        // Covered pixels of the triangle, one after the other, as (row << 8) | column.
        int list[16 * LANES + 64 + LANES];
        int listed = 0;
        auto flush = [&](int whole) {
            for (int start = 0; start < whole; start += LANES) {
                const I valid = start + lanes() < listed;
                const I code = ipick(valid, iload(list + start), I(list[start]));
                const I y = code >> 8, x = code & 255;
                const I ea = (int)ea0 + y * ystep_a - x * xstep_a;
                const I eb = (int)eb0 + y * ystep_b - x * xstep_b;
                const I ec = (int)ec0 + y * ystep_c - x * xstep_c;
                const F depth = (__builtin_convertvector(ea, F) * ka + __builtin_convertvector(eb, F) * kb
                    + __builtin_convertvector(ec, F) * kc) * inv_area;
                I inside = valid;
                if (masked) {
                    I mask;
                    const I at = (top + y) * target.mask_width + left + x;
                    EACH_LANE mask[l] = target.mask.data[at[l]];
                    inside &= mask == target.mask_value;
                }
                put_all(inside, cell0 + y * width + x, depth);
            }
        };
        for (int row = 0; row < rows; ++row) {
            const int length = run_length[row];
            const I code = (row << 8) + run_first[row] + lanes();
            istore(list + listed, code);
            for (int x = LANES; x < length; x += LANES) istore(list + listed + x, code + x);
            listed += length;
            if (listed >= 16 * LANES) {
                flush(16 * LANES);
                const int rest = listed - 16 * LANES;
                for (int x = 0; x < rest; ++x) list[x] = list[16 * LANES + x];
                listed = rest;
            }
        }
        flush(listed);
        return;
    }

    // Large triangles: LANES pixels of a row at a time.
    typedef decltype(D() < D()) Wide;
    const D lane = __builtin_convertvector(lanes(), D);
    const double xstep_a = dya * 256.0, xstep_b = dyb * 256.0, xstep_c = dyc * 256.0;
    const double ystep_a = dxa * 256.0, ystep_b = dxb * 256.0, ystep_c = dxc * 256.0;
    D ea_row = (double)ea0 - lane * xstep_a, eb_row = (double)eb0 - lane * xstep_b, ec_row = (double)ec0 - lane * xstep_c;
    for (int y = top; y <= bottom; ++y) {
        D ea = ea_row, eb = eb_row, ec = ec_row;
        const int cell = (y - target.y0) * width - target.x0;
        for (int x = left; x <= right; x += LANES) {
            const Wide within = (ea + (double)bias_a >= 0.0) & (eb + (double)bias_b >= 0.0) & (ec + (double)bias_c >= 0.0);
            const I column = x + lanes();
            I inside = __builtin_convertvector(within, I) & (column <= right);
            if (bits(inside)) {
                const F depth = (__builtin_convertvector(ea, F) * ka + __builtin_convertvector(eb, F) * kb
                    + __builtin_convertvector(ec, F) * kc) * inv_area;
                if (!rays && !masked && x + LANES <= target.x1) {
                    inside &= depth > key_min;
                    // Positive keys order as signed words too. Without a branch, and without a masked store, which is slow.
                    S now;
                    __builtin_memcpy(&now, keys + cell + x, sizeof(now));
                    const S key = (__builtin_convertvector(__builtin_bit_cast(U, depth), S) << 32) | (long long)low_word;
                    const S kept = __builtin_convertvector(inside, S) & (key > now);
                    now ^= (now ^ key) & kept;
                    __builtin_memcpy(keys + cell + x, &now, sizeof(now));
                } else {
                    const I inner = column < target.x1 ? column : I(target.x1 - 1);
                    if (masked) {
                        I mask;
                        const I at = y * target.mask_width + inner;
                        EACH_LANE mask[l] = target.mask.data[at[l]];
                        inside &= mask == target.mask_value;
                    }
                    put_all(inside, cell + inner, depth);
                }
            }
            ea -= xstep_a * LANES;
            eb -= xstep_b * LANES;
            ec -= xstep_c * LANES;
        }
        ea_row += ystep_a;
        eb_row += ystep_b;
        ec_row += ystep_c;
    }
""")
)
def draw_lanes(
    target: TargetView,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    plane: PlaneView,
    triangle: int,
    row_first: int,
    row_end: int,
    ray_along_min: float,
    ray_trust: float,
): ...


@wp.kernel
def draw_lanes_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    step: int,
    survivors: wp.array(dtype=int),
    survivor_count: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    row_first: int,
    row_end: int,
):
    """As `raster.draw_kernel`; what has to be clipped is drawn as there."""
    i = first + wp.tid()
    part = i / step
    if i - part * step >= survivor_count[part]:
        return
    t = survivors[i]
    corners = triangles[t]
    a = screen[corners[0]]
    b = screen[corners[1]]
    c = screen[corners[2]]
    triangle = t + id_offset
    if ids.shape[0] > 0:
        triangle = ids[t]
    plane = PlaneView()
    if target.ray.shape[0] > 0:
        plane = triangle_plane(points, plane_triangles[t])
    if target.painter != 0:
        middle = (a[2] + b[2] + c[2]) / 3.0
        a = at_depth(a, middle)
        b = at_depth(b, middle)
        c = at_depth(c, middle)
    if needs_clipping(a) or needs_clipping(b) or needs_clipping(c):
        draw_clipped(target, a, b, c, plane, triangle, row_first, row_end)
    else:
        draw_lanes(
            target,
            wp.vec3(a[0], a[1], a[2]),
            wp.vec3(b[0], b[1], b[2]),
            wp.vec3(c[0], c[1], c[2]),
            plane,
            triangle,
            row_first,
            row_end,
            RAY_ALONG_MIN,
            RAY_TRUST,
        )
