"""`raster.draw_kernel` where rays tell the depth, with triangles and fragments side by side: the same picture, bit for bit.

Virtual meshes have more triangles than their pictures have pixels, most of them slivers or smaller than a pixel: what such a
triangle costs is what it costs to find out that it covers nothing. So nothing is culled beforehand and read again. Triangles
of a block are read as they lie, set up in vectors, and their rows are walked side by side: edges are divided by their slopes
for the columns between them, in float32, a little too wide. Runs of pixels that lie between are put one after the other
without a branch; only triangles that have some get their planes, and the pixels of all of them one list, whose vectors are
full however few pixels a triangle has. Whether a fragment is inside is told by its exact edge functions when it is worked on,
and what it needs of memory has been asked for by then.

Triangles beyond a box of 64 pixels are drawn one at a time in float64, whose 53 bits hold everything below 2^46; within it
edge functions are exact in 32 bits (products below 2^29, sums of two below 2^30). What has to be clipped is, by the
plain kernel's functions, and drawn like those.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.raster import (
    GUARD,
    RAY_ALONG_MIN,
    RAY_TRUST,
    Clipped,
    PlaneView,
    TargetView,
    clip,
    draw_triangle,
    in_guard,
    needs_clipping,
    screen_corner,
    survivor,
    triangle_plane,
)

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)

# What both snippets begin with.
_TARGET = (
    vector.TRIANGLES
    + r"""
    const int width = target.x1 - target.x0;
    const float* ray_of = (const float*)target.ray.data;
    unsigned long long* keys = (unsigned long long*)target.key.data;
    const F key_min = F(target.key_min);

    // Fragments of interpolated keys at cells, of triangles with these planes and, by owner, complements of their numbers:
    // raster.ray_key. A masked target has no rays outside its mask.
    auto put = [&](I inside, I cell, F depth, V n, F offset, I owner, const int* low_of) {
        inside &= depth > key_min;
        F now;
        EACH_LANE now[l] = __builtin_bit_cast(float, (unsigned)(keys[cell[l]] >> 32));
        F ray[8];
        gather8(ray_of, 8 * cell, ray);
        const V o = V{ray[0], ray[1], ray[2]}, d = V{ray[4], ray[5], ray[6]};
        const F o_w = ray[3], d_w = ray[7];
        const F path = d_w / depth;
        const F along = n.x * d.x + n.y * d.y + n.z * d.z;
        const F height = offset - n.x * o.x - n.y * o.y - n.z * o.z;
        const F linear = path - o_w;
        const F t = height / along;
        const I trusted = (__builtin_elementwise_abs(along) > ray_along_min)
            & (__builtin_elementwise_abs(t - linear) < ray_trust * path);
        const F total = o_w + pick(trusted, fmax(t, F(0.0f)), linear);
        depth = 1.0f / fmax(total, F(1.0e-30f));
        inside &= d_w > 0.0f;
        float depths[LANES];
        int cells[LANES], owners[LANES];
        store(depths, depth);
        istore(cells, cell);
        istore(owners, owner);
        for (unsigned left = marks(inside & (depth >= now)); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const unsigned high = __builtin_bit_cast(unsigned, depths[l]);
            const unsigned long long key = ((unsigned long long)high << 32) | (unsigned)low_of[owners[l]];
            if (key > keys[cells[l]]) keys[cells[l]] = key;
        }
    };
"""
)


@wp.func_native(
    vector.snippet(
        _TARGET
        + r"""
    constexpr int LISTED = 256;  // fragments that are worked on together
    constexpr int SIDE = 65;  // the most pixels that a box of 64 pixels has side by side
    auto whole = [](F x) -> I { return __builtin_convertvector(x, I); };
    auto apart = [](V a, F s) -> V { return V{a.x / s, a.y / s, a.z / s}; };
    const int* corner_of = (const int*)triangles.data;
    const int* plane_corner_of = (const int*)plane_triangles.data;
    const float* point_of = (const float*)points.data;
    const float* screen_of = (const float*)screen.data;
    const int row0 = target.y0 > row_first ? target.y0 : row_first;
    const int row1 = target.y1 < row_end ? target.y1 : row_end;
    const int end = begin + BLOCK < triangles.shape[0] ? begin + BLOCK : triangles.shape[0];

    // Of a triangle: edges opposite to a and b at its first pixel, their steps from pixel to pixel and from row to row, its
    // area and first cell; the depth keys of a, b, c and which of the edges own no centre on them; its plane. And the
    // complement of its number.
    enum { EA, EB, STEP_A, ROW_A, STEP_B, ROW_B, AREA, CELL, KEY_A, KEY_B, KEY_C, OPEN, NX, NY, NZ, OFFSET };
    constexpr int FIELDS = 16;
    float record[BLOCK * FIELDS];
    int low_of[BLOCK], cell_of[BLOCK];
    // Runs of fragments: owner, row, first column from the triangle's first pixel, and how many, 8 bits each.
    int runs[BLOCK * SIDE + LANES];
    int run_count = 0;
    unsigned long long touched = 0;  // a bit for each owner of runs
    // Fragments: owner, row and column.
    int list[LISTED + SIDE + LANES];
    int listed = 0;
    auto flush = [&]() __attribute__((noinline)) {
        for (int start = 0; start < listed; start += LANES) {
            const I valid = start + lanes() < listed;
            const I fragment = ipick(valid, iload(list + start), I(list[start]));
            const I owner = fragment >> 16, row = (fragment >> 8) & 255, column = fragment & 255;
            F one[8], other[8];
            gather8(record, FIELDS * owner, one);
            gather8(record, FIELDS * owner + 8, other);
            auto number = [](F x) -> I { return __builtin_bit_cast(I, x); };
            const I ea = number(one[EA]) + row * number(one[ROW_A]) - column * number(one[STEP_A]);
            const I eb = number(one[EB]) + row * number(one[ROW_B]) - column * number(one[STEP_B]);
            const I area = number(one[AREA]);
            const I ec = area - ea - eb;
            const I open = number(other[OPEN - 8]);
            const I inside = valid & (((ea - (open & 1)) | (eb - (open >> 1 & 1)) | (ec - (open >> 2))) >= 0);
            const F depth = (__builtin_convertvector(ea, F) * other[KEY_A - 8] + __builtin_convertvector(eb, F) * other[KEY_B - 8]
                + __builtin_convertvector(ec, F) * other[KEY_C - 8]) * (1.0f / __builtin_convertvector(area, F));
            put(inside, number(one[CELL]) + row * width + column, depth, V{other[NX - 8], other[NY - 8], other[NZ - 8]},
                other[OFFSET - 8], owner, low_of);
        }
        listed = 0;
    };

    unsigned long long others = 0;
    int survivors = 0;
    for (int start = begin; start < end; start += LANES) {
        const int count = end - start < LANES ? end - start : LANES;
        const int* corners = corner_of + 3 * start;
        int rest[3 * LANES];
        if (count < LANES) {
            for (int k = 0; k < 3 * LANES; ++k) rest[k] = corners[k < 3 * count ? k : k % 3];
            corners = rest;
        }
        const Corners c = cornered(corners, 3, screen_of, guard, target.x0, target.y0, target.x1, target.y1);
        const unsigned valid = (1u << count) - 1;
        const I top = most(c.top, I(row0)), bottom = least(c.bottom, I(row1 - 1));
        const I surviving = c.sound & (c.left <= c.right) & (c.top <= c.bottom);
        const unsigned seen = marks(surviving & (top <= bottom)) & valid, small = marks(c.small);
        unsigned cut = marks(c.clipped) & valid;
        survivors += __builtin_popcount(marks(surviving) & valid);
        for (unsigned left_over = cut; left_over != 0; left_over &= left_over - 1) {
            const int l = __builtin_ctz(left_over);
            if (beside(corners + 3 * l, screen_of, target)) cut &= ~(1u << l);
        }
        survivors += __builtin_popcount(cut);
        others |= (unsigned long long)(cut | (seen & ~small)) << (start - begin);
        if (!(seen & small)) continue;
        I drawn = marked(seen & small);
        F k[3] = {c.v[0].z, c.v[1].z, c.v[2].z};
        if (target.painter != 0) {
            const F middle = (k[0] + k[1] + k[2]) / 3.0f;
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each)
                k[each] = pick(k[each] > 0.0f, middle, k[each]);
        }
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
        const I dx[3] = {xc - xb, xa - xc, xb - xa}, dy[3] = {yc - yb, ya - yc, yb - ya};
        const I px = ipick(drawn, c.left * 256 + 128, I(0)), py = ipick(drawn, top * 256 + 128, I(0));
        const I e[3] = {dx[0] * (py - yb) - dy[0] * (px - xb), dx[1] * (py - yc) - dy[1] * (px - xc),
            dx[2] * (py - ya) - dy[2] * (px - xa)};
        const I columns = c.right - c.left, rows = ipick(drawn, bottom - top, I(-1));
        const I cell = (top - target.y0) * width + c.left - target.x0;
        const int own = start - begin;
        // Columns from `edge / step` on, or up to there. Half of a 1/65536 pixel off, no quotient is 0 by 0.
        F inverse[3];
        I is_left[3], at_row[3], down[3];
        I open = I(0);
        _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) {
            const I bias = edge_bias(dx[each], dy[each]);
            open -= bias * (1 << each);
            is_left[each] = dy[each] < 0;
            inverse[each] = pick(dy[each] == 0, F(1.0e30f), 1.0f / __builtin_convertvector(dy[each] * 256, F));
            at_row[each] = e[each] + bias;
            down[each] = dx[each] * 256;
        }
        const F last = __builtin_convertvector(columns, F);
        const int row_count = __builtin_reduce_max(rows) + 1;
        I run = ((own + lanes()) << 24) + 1;
        unsigned owners = 0;
        for (int y = 0; y < row_count; ++y, run += 1 << 16) {
            F from = F(0.0f), to = last;
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) {
                const F bound = (__builtin_convertvector(at_row[each], F) + 0.5f) * inverse[each];
                from = pick(is_left[each], fmax(from, bound), from);
                to = pick(is_left[each], to, fmin(to, bound));
                at_row[each] += down[each];
            }
            // Quotients up to 64 are rounded by less than 2e-5.
            from = __builtin_elementwise_ceil(from - 1.0e-4f);
            to = __builtin_elementwise_floor(to + 1.0e-4f);
            const I some = (from <= to) & (y <= rows);
            const unsigned here = marks(some);
            owners |= here;
            // Of lanes without a run any number.
            run_count += packed(runs + run_count, run + whole(pick(some, from * 255.0f + to, F(0.0f))), here);
        }
        if (owners == 0) continue;
        touched |= (unsigned long long)owners << own;
        istore(cell_of + own, cell);
        const I number = start + lanes();
        istore(low_of + own, ~(ids.shape[0] > 0 ? igather(ids.data, least(number, I(end - 1))) : number + id_offset));
        float fields[(FIELDS - 4) * LANES];
        auto keep = [&](int field, I value) { istore((int*)fields + LANES * field, value); };
        auto keep_float = [&](int field, F value) { store(fields + LANES * field, value); };
        keep(EA, e[0]);
        keep(EB, e[1]);
        keep(STEP_A, dy[0] * 256);
        keep(ROW_A, down[0]);
        keep(STEP_B, dy[1] * 256);
        keep(ROW_B, down[1]);
        keep(AREA, area);
        keep(CELL, cell);
        keep_float(KEY_A, k[0]);
        keep_float(KEY_B, pick(turned, k[2], k[1]));
        keep_float(KEY_C, pick(turned, k[1], k[2]));
        keep(OPEN, open);
        _Pragma("clang loop unroll(full)") for (int part = 0; part < LANES; part += 8)
            _Pragma("clang loop unroll(full)") for (int half = 0; half < FIELDS; half += 8) {
                int at[8];
                for (int field = 0; field < 8; ++field) at[field] = LANES * ((half + field) % (FIELDS - 4)) + part;
                Row lying[8];
                transposed(fields, at, lying);
                for (int l = 0; l < 8; ++l)
                    __builtin_memcpy(record + FIELDS * (own + part + l) + half, &lying[l], sizeof(Row));
            }
    }
    if (row0 == target.y0) out_survivor_count.data[0] += survivors;

    // raster.triangle_plane of those that have runs.
    int owner_of[BLOCK + LANES];
    int owner_count = 0;
    for (unsigned long long left_over = touched; left_over != 0; left_over &= left_over - 1)
        owner_of[owner_count++] = __builtin_ctzll(left_over);
    for (int start = 0; start < owner_count; start += LANES) {
        const I owner = ipick(start + lanes() < owner_count, iload(owner_of + start), I(owner_of[start]));
        V p[3];
        I corner[3];
        I last = I(0);
        if (end < triangles.shape[0]) {
            int at[LANES];
            istore(at, 3 * (begin + owner));
            F of[4];
            fours((const float*)plane_corner_of, at, of);
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each)
                corner[each] = __builtin_bit_cast(I, of[each]);
        } else {
            // Of the last triangle there are but three words to read.
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each)
                corner[each] = igather(plane_corner_of, 3 * (begin + owner) + each);
        }
        _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) last |= corner[each] >= points.shape[0] - 1;
        // Of the last point there are but three floats to read.
        if (bits(last)) {
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) p[each] = vgather(point_of, corner[each]);
        } else {
            _Pragma("clang loop unroll(full)") for (int each = 0; each < 3; ++each) {
                int at[LANES];
                istore(at, 3 * corner[each]);
                F of[4];
                fours(point_of, at, of);
                p[each] = V{of[0], of[1], of[2]};
            }
        }
        const V n = cross(sub(p[1], p[0]), sub(p[2], p[0]));
        const F square = dot(n, n);
        const I safe = (square > 1.0e-24f) & (square < 1.0e24f);
        V plane = times(1.0f / __builtin_elementwise_sqrt(square), n);
        if (bits(~safe)) {
            const V s = apart(n, size(n));
            plane = vpick(safe, plane, vpick(size(n) == 0.0f, same(0.0f), apart(s, __builtin_elementwise_sqrt(dot(s, s)))));
        }
        float planes[4 * LANES];
        vstore4(planes, 0, plane, dot(plane, p[0]));
        for (int l = 0; l < LANES; ++l)
            __builtin_memcpy(record + FIELDS * owner[l] + NX, planes + 4 * l, 4 * sizeof(float));
    }
    for (int k = 0; k < run_count; ++k) {
        const int fragment = (int)((unsigned)runs[k] >> 8), length = runs[k] & 255;
        const int at = cell_of[fragment >> 16] + (fragment >> 8 & 255) * width + (fragment & 255);
        __builtin_prefetch(keys + at);
        // Two rays fill a cache line; runs are hardly ever longer than those of three.
        __builtin_prefetch(ray_of + 8 * at);
        __builtin_prefetch(ray_of + 8 * (at + length / 2));
        __builtin_prefetch(ray_of + 8 * (at + length - 1));
        istore(list + listed, fragment + lanes());
        if (length > 4) {
            for (int part = 2; part < length; part += 2) __builtin_prefetch(ray_of + 8 * (at + part));
            for (int part = LANES; part < length; part += LANES) istore(list + listed + part, fragment + part + lanes());
        }
        listed += length;
        if (listed >= LISTED || k + 1 == run_count) flush();
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
    begin: int,
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    row_first: int,
    row_end: int,
    guard: float,
    ray_along_min: float,
    ray_trust: float,
    out_survivor_count: wp.array(dtype=int),
) -> wp.uint64:
    """Draw those triangles of a block that are small; a bit for each of the others. The first band counts what has a pixel."""
    ...


@wp.func_native(
    vector.snippet(
        _TARGET
        + vector.ONE_TRIANGLE
        + r"""
    typedef decltype(D() < D()) Wide;
    const V n = spread(plane.n);
    const F offset = F(plane.offset);
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
                const F depth = (__builtin_convertvector(ea, F) * a[2] + __builtin_convertvector(eb, F) * kb
                    + __builtin_convertvector(ec, F) * kc) * inv_area;
                put(inside, cell + (column < target.x1 ? column : I(target.x1 - 1)), depth, n, offset, I(0), &low);
            }
            ea -= xstep_a * LANES;
            eb -= xstep_b * LANES;
            ec -= xstep_c * LANES;
        }
        ea_row += ystep_a;
        eb_row += ystep_b;
        ec_row += ystep_c;
    }
"""
    )
)
def draw_large(
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
def draw_rays_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    out_survivor_count: wp.array(dtype=int),
    row_first: int,
    row_end: int,
):
    """As `raster.cull_kernel` and `raster.draw_kernel`, one thread per block of triangles."""
    begin = (first + wp.tid()) * BLOCK
    left = draw_block(
        target,
        screen,
        triangles,
        ids,
        id_offset,
        begin,
        points,
        plane_triangles,
        row_first,
        row_end,
        GUARD,
        RAY_ALONG_MIN,
        RAY_TRUST,
        out_survivor_count,
    )
    t = begin
    while left != wp.uint64(0):
        if (left & wp.uint64(1)) != wp.uint64(0):
            drawn = survivor(target, screen, triangles, ids, id_offset, t)
            a = drawn.a
            b = drawn.b
            c = drawn.c
            triangle = drawn.triangle
            plane = triangle_plane(points, plane_triangles[t])
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
                        plane,
                        triangle,
                        row_first,
                        row_end,
                        RAY_ALONG_MIN,
                        RAY_TRUST,
                    )
                else:
                    draw_triangle(target, p, q, r, plane, triangle, row_first, row_end)
        left = left >> wp.uint64(1)
        t += 1


@wp.func_native(
    vector.snippet(r"""
    const int end = begin + BLOCK < pixel.shape[0] ? begin + BLOCK : pixel.shape[0];
    const float* points = (const float*)point.data;
    const float* directions = (const float*)direction.data;
    const V eye = spread(camera.eye), forward = spread(camera.forward);
    for (int start = begin; start < end; start += LANES) {
        const bool full = start + LANES <= end;
        const int count = full ? LANES : end - start;
        const I own = full ? start + lanes() : ipick(lanes() < count, start + lanes(), I(start));
        const V p = vrows(points, start, full, own), d = vrows(directions, start, full, own);
        const V to_eye = sub(p, eye);
        const F distance = __builtin_elementwise_sqrt(dot(to_eye, to_eye));
        const F unit_depth = distance / fmax(dot(forward, to_eye), F(1.0e-30f));
        // Turned as they lie: eight numbers of a ray side by side.
        float columns[8 * LANES];
        const F column[8] = {p.x, p.y, p.z, distance, d.x, d.y, d.z, unit_depth};
        for (int half = 0; half < LANES / 8; ++half) {
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 8; ++k) store(columns + LANES * k, column[k]);
            int at[8];
            for (int k = 0; k < 8; ++k) at[k] = LANES * k + 8 * half;
            Row rows[8];
            transposed(columns, at, rows);
            for (int k = 0; k < 8 && 8 * half + k < count; ++k) {
                const int i = pixel.data[start + 8 * half + k], row = i / camera.width;
                const int cell = (row - y0) * box_width + i - row * camera.width - x0;
                __builtin_memcpy((float*)out_ray.data + 8 * cell, &rows[k], sizeof(Row));
            }
        }
    }
    // Pixels ascend, and so do cells: those up to the next pixel's have no ray.
    const int last = pixel.shape[0], cells = out_ray.shape[0] / 2;
    auto cell_of = [&](int place) -> int {
        if (place == last) return cells;
        const int i = pixel.data[place], row = i / camera.width;
        return (row - y0) * box_width + i - row * camera.width - x0;
    };
    auto clear = [&](int from, int to) {
        if (to > from) __builtin_memset((float*)out_ray.data + 8 * from, 0, sizeof(Row) * (to - from));
    };
    if (begin == 0) clear(0, cell_of(0));
    if (cell_of(end) - cell_of(begin) == end - begin) return;
    for (int i = begin; i < end; ++i) clear(cell_of(i) + 1, cell_of(i + 1));
""")
)
def ray_block(
    begin: int,
    camera: CameraView,
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    x0: int,
    y0: int,
    box_width: int,
    out_ray: wp.array(dtype=wp.vec4),
): ...


@wp.kernel
def ray_blocks_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    x0: int,
    y0: int,
    box_width: int,
    out_ray: wp.array(dtype=wp.vec4),
):
    """As `raster.ray_image_kernel`, one thread per block of mirror pixels."""
    ray_block((first + wp.tid()) * BLOCK, camera[0], pixel, point, direction, x0, y0, box_width, out_ray)
