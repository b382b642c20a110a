"""`refine.settle_kernel` for a block of mirror pixels at a time: the same decisions in the same order, bit for bit.

Each lane is one pixel. A walk goes on while any lane of its vector walks; lanes that are decided only watch.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import raster, vector

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(r"""
    const int count = pixel.shape[0];
    const int box_width = target.x1 - target.x0;
    const unsigned long long* keys = (const unsigned long long*)target.key.data;
    const int* next_triangle = (const int*)neighbours.data;
    const float* record = records.data;
    const float* points = (const float*)point.data;
    const float* directions = (const float*)direction.data;
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;

    // refine.walk: lanes of `mask` from scene triangles `from`. A walk that comes to `known`, whose hit is known, ends there.
    I hit_triangle, hit_hops, hit_behind, hit_turned;
    F hit_u, hit_v, hit_t;
    auto walk = [&](I mask, I from, I known, V origin, V ray) {
        const F ray_square = dot(ray, ray);
        hit_triangle = I(-1); hit_hops = I(0); hit_behind = I(0); hit_turned = I(0);
        hit_u = F(0.0f); hit_v = F(0.0f); hit_t = F(0.0f);
        I triangle = ipick(mask, from, I(0)), previous = I(-1), walking = mask;
        F facing = F(0.0f);
        for (int hops = 0; hops <= hop_count; ++hops) {
            F corner[8], corner_z, closed;
            const I at = 12 * triangle;
            gather8(record, at, corner);
            EACH_LANE { corner_z[l] = record[at[l] + 8]; closed[l] = record[at[l] + 9]; }
            const V a = sub(V{corner[0], corner[1], corner[2]}, origin);
            const V b = sub(V{corner[3], corner[4], corner[5]}, origin);
            const V c = sub(V{corner[6], corner[7], corner_z}, origin);
            const F eu = dot(cross(sub(c, a), add(c, a)), ray);
            const F ev = dot(cross(sub(a, b), add(a, b)), ray);
            const F ew = dot(cross(sub(b, c), add(b, c)), ray);
            const F det = eu + ev + ew;
            walking &= det != 0.0f;
            if (hops == 0) facing = det;
            const F inv = 1.0f / det;
            const F u = eu * inv, v = ev * inv, w = ew * inv;
            const F t = (w * dot(a, ray) + u * dot(b, ray) + v * dot(c, ray)) / ray_square;
            const I inside = walking & (((eu >= 0.0f) & (ev >= 0.0f) & (ew >= 0.0f))
                | ((eu <= 0.0f) & (ev <= 0.0f) & (ew <= 0.0f)));
            const I found = inside & (t > 0.0f);
            const F cu = fmax(u, F(0.0f)), cv = fmax(v, F(0.0f));
            const F total = cu + cv;
            const I beyond = total > 1.0f;
            hit_triangle = ipick(found, triangle, hit_triangle);
            hit_u = pick(found, pick(beyond, cu / total, cu), hit_u);
            hit_v = pick(found, pick(beyond, cv / total, cv), hit_v);
            hit_t = pick(found, t, hit_t);
            hit_hops = ipick(found, I(hops), hit_hops);
            hit_behind |= found & (det > 0.0f) & (closed != 0.0f);
            hit_turned |= found & (facing * det < 0.0f);
            walking &= ~inside;
            if (!bits(walking) || hops == hop_count) break;
            I edge = I(0);
            F lowest = v;
            edge = ipick(w < lowest, I(1), edge);
            lowest = pick(w < lowest, w, lowest);
            edge = ipick(u < lowest, I(2), edge);
            const I following = igather(next_triangle, 3 * triangle + edge);
            walking &= (following != previous) & (following >= 0) & (following != known);
            if (!bits(walking)) break;
            previous = triangle;
            triangle = ipick(walking, following, triangle);
        }
    };

    // What a block leaves to a second pass: neighbouring candidates that may be hit before the pixel's own.
    int ask_pixel[8 * BLOCK + LANES], ask_drawn[8 * BLOCK + LANES], ask_count = 0;
    int best_triangle[BLOCK], best_hops[BLOCK], state[BLOCK];
    float best_u[BLOCK], best_v[BLOCK], best_t[BLOCK];

    for (int start = begin; start < end; start += LANES) {
        const int place = start - begin;
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        const bool whole = start + LANES <= end;
        const I cell_pixel = whole ? iload(pixel.data + start) : igather(pixel.data, own);
        const int row = cell_pixel[0] / target.mask_width;
        const bool one_row = cell_pixel[LANES - 1] < (row + 1) * target.mask_width;
        const I y = one_row ? I(row) : cell_pixel / target.mask_width;
        const I x = cell_pixel - y * target.mask_width;
        const I cell = (y - target.y0) * box_width + x - target.x0;
        const bool dense = whole && one_row && cell_pixel[LANES - 1] - cell_pixel[0] == LANES - 1 && row > target.y0
            && row + 1 < target.y1 && x[0] > target.x0 && x[LANES - 1] + 1 < target.x1;

        // Depth keys and triangles of the 3x3 neighbourhood; 0 and -1 where nothing is or outside the box.
        F depth_at[9];
        I drawn_at[9];
        if (dense) {
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 9; ++k) {
                I low, high;
                halves(keys + cell[0] + (k / 3 - 1) * box_width + k % 3 - 1, low, high);
                depth_at[k] = __builtin_bit_cast(F, high);
                drawn_at[k] = ipick(high == 0, I(-1), ~low);
            }
        } else {
            for (int k = 0; k < 9; ++k) {
                const int dx = k % 3 - 1, dy = k / 3 - 1;
                unsigned long long key[LANES];
                for (int l = 0; l < LANES; ++l) {
                    const int nx = x[l] + dx, ny = y[l] + dy;
                    const bool in = nx >= target.x0 && nx < target.x1 && ny >= target.y0 && ny < target.y1;
                    key[l] = in ? keys[cell[l] + dy * box_width + dx] : 0ull;
                }
                I low, high;
                halves(key, low, high);
                depth_at[k] = __builtin_bit_cast(F, high);
                drawn_at[k] = ipick(high == 0, I(-1), ~low);
            }
        }
        I live = valid;
        if (blocked.shape[0] > 0) {
            I stopped;
            EACH_LANE stopped[l] = blocked.data[own[l]];
            live &= stopped == 0;
        }
        const F depth = depth_at[4];
        const I drawn = drawn_at[4];
        const I nothing = live & (drawn < 0);
        I settled = I(0);
        if (bits(nothing)) {
            // Nothing around either: sky.
            I empty = nothing & I(trust_sky != 0 ? -1 : 0);
            for (int k = 0; k < 9; ++k) empty &= drawn_at[k] < 0;
            settled = empty & 3;
            live &= ~nothing;
        }
        if (bits(live)) {
            const I known = ipick(drawn < 0, I(0), drawn);
            const I patch = igather(patches.data, known);
            walk(live, igather(parents.data, known), I(-2), vgather(points, own), vgather(directions, own));
            live &= (hit_triangle >= 0) & ~hit_turned & ~hit_behind;
            istore(best_triangle + place, hit_triangle);
            istore(best_hops + place, hit_hops);
            store(best_u + place, hit_u);
            store(best_v + place, hit_v);
            store(best_t + place, hit_t);

            // The four opposite pairs: (1, 0), (-1, 1), (0, 1), (1, 1) and their negatives.
            I tested = I(-1);
            const F step = depth_step * depth, fine = fine_step * depth, nearer = nearer_share * depth;
            _Pragma("clang loop unroll(full)") for (int side_of = 0; side_of < 8; ++side_of) {
                const int near_at = side_of % 2 == 0 ? 5 + side_of / 2 : 3 - side_of / 2;
                const F near = depth_at[near_at];
                const F far = depth_at[8 - near_at];
                const I other = drawn_at[near_at];
                const I there = live & (other >= 0);
                // refine.rise
                const F bend = pick(far > 0.0f, near - depth - fmax(depth - far, F(0.0f)), near - depth);
                live &= ~(there & (bend > step));
                I ask = there & live & (other != tested) & (other != drawn);
                if (bits(ask)) {
                    const I other_patch = igather(patches.data, ipick(other < 0, I(0), other));
                    ask &= I(wary != 0 ? -1 : 0) | (bend > fine) | ((other_patch != patch) & (near > nearer));
                    tested = ipick(ask, other, tested);
                    for (unsigned left = bits(ask); left != 0; left &= left - 1) {
                        const int l = __builtin_ctz(left);
                        ask_pixel[ask_count] = place + l;
                        ask_drawn[ask_count++] = other[l];
                    }
                }
            }
            settled = ipick(live, I(1), settled);
        }
        istore(state + place, settled);
    }

    for (int start = 0; start < ask_count; start += LANES) {
        const I element = start + lanes();
        const I valid = element < ask_count;
        for (int l = ask_count - start; l < LANES; ++l) {
            ask_pixel[start + l] = 0;
            ask_drawn[start + l] = ask_drawn[start];
        }
        const I at = iload(ask_pixel + start);
        const I own = begin + at;
        walk(valid, igather(parents.data, iload(ask_drawn + start)), igather(best_triangle, at), vgather(points, own),
            vgather(directions, own));
        for (unsigned left = bits(hit_triangle >= 0); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const int i = at[l];
            if (state[i] == 1 && hit_t[l] < best_t[i]) {
                if (hit_turned[l]) state[i] = 0;
                best_triangle[i] = hit_triangle[l];
                best_hops[i] = hit_hops[l];
                best_u[i] = hit_u[l]; best_v[i] = hit_v[l]; best_t[i] = hit_t[l];
            }
        }
    }

    for (int i = 0; i < end - begin; ++i) {
        const int pixel_index = begin + i;
        int who = state[i];
        if (who == 1 && best_hops[i] > 0) who = wary != 0 ? 0 : 2;
        out_settled.data[pixel_index] = (unsigned char)who;
        if (who == 3) {
            out_triangle.data[pixel_index] = -1;
            out_status.data[pixel_index] = (unsigned char)sky;
        } else if (who != 0) {
            out_triangle.data[pixel_index] = best_triangle[i];
            out_u.data[pixel_index] = best_u[i];
            out_v.data[pixel_index] = best_v[i];
            out_distance.data[pixel_index] = best_t[i];
            out_status.data[pixel_index] = (unsigned char)converged;
        }
    }
""")
)
def settle_block(
    block: int,
    target: raster.TargetView,
    neighbours: wp.array(dtype=wp.vec3i),
    records: wp.array(dtype=float),
    parents: wp.array(dtype=int),
    patches: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    blocked: wp.array(dtype=wp.uint8),
    hop_count: int,
    trust_sky: int,
    wary: int,
    depth_step: float,
    fine_step: float,
    nearer_share: float,
    converged: int,
    sky: int,
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_settled: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def settle_blocks_kernel(
    first: int,
    target: raster.TargetView,
    neighbours: wp.array(dtype=wp.vec3i),
    records: wp.array(dtype=float),
    parents: wp.array(dtype=int),
    patches: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    blocked: wp.array(dtype=wp.uint8),
    # Settings:
    hop_count: int,
    strict: int,
    caution: wp.array(dtype=int),
    depth_step: float,
    fine_step: float,
    nearer_share: float,
    converged: int,
    sky: int,
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_settled: wp.array(dtype=wp.uint8),
):
    """One thread per block of mirror pixels."""
    settle_block(
        first + wp.tid(),
        target,
        neighbours,
        records,
        parents,
        patches,
        pixel,
        point,
        direction,
        blocked,
        hop_count,
        caution[0],
        wp.max(caution[1], strict),
        depth_step,
        fine_step,
        nearer_share,
        converged,
        sky,
        out_triangle,
        out_u,
        out_v,
        out_distance,
        out_status,
        out_settled,
    )


@wp.func_native(
    vector.snippet(r"""
    const int count = point.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        I known;
        EACH_LANE known[l] = out_settled.data[own[l]];
        I live = valid & (known != doubt);
        const V origin = vgather((const float*)point.data, own), ray = vgather((const float*)direction.data, own);
        const I found = igather(triangle.data, own);
        const F nearest = gather(distance.data, own), ray_square = dot(ray, ray);
        I doubtful = I(0);
        for (int k = 0; k < coarse.shape[0] && bits(live); ++k) {
            const int other = coarse.data[k];
            const float* corner = records.data + 12 * other;
            // shapes.intersect_triangle
            const V a = sub(spread(corner), origin), b = sub(spread(corner + 3), origin), c = sub(spread(corner + 6), origin);
            const F eu = dot(cross(sub(c, a), add(c, a)), ray);
            const F ev = dot(cross(sub(a, b), add(a, b)), ray);
            const F ew = dot(cross(sub(b, c), add(b, c)), ray);
            const I inside = live & (found != other) & (((eu >= 0.0f) & (ev >= 0.0f) & (ew >= 0.0f))
                | ((eu <= 0.0f) & (ev <= 0.0f) & (ew <= 0.0f)));
            if (!bits(inside)) continue;
            const F det = eu + ev + ew;
            const F inv = 1.0f / det;
            const F u = eu * inv, v = ev * inv, w = ew * inv;
            const F t = (w * dot(a, ray) + u * dot(b, ray) + v * dot(c, ray)) / ray_square;
            const I before = inside & (det != 0.0f) & (t > 0.0f) & ((found < 0) | (t < nearest));
            doubtful |= before;
            live &= ~before;
        }
        for (unsigned left = bits(doubtful); left != 0; left &= left - 1)
            out_settled.data[start + __builtin_ctz(left)] = (unsigned char)doubt;
    }
""")
)
def coarse_block(
    block: int,
    records: wp.array(dtype=float),
    coarse: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    doubt: int,
    out_settled: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def coarse_blocks_kernel(
    first: int,
    records: wp.array(dtype=float),
    coarse: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    doubt: int,
    # Outputs:
    out_settled: wp.array(dtype=wp.uint8),
):
    """One thread per block of mirror pixels; as `refine.coarse_kernel`."""
    coarse_block(first + wp.tid(), records, coarse, point, direction, triangle, distance, doubt, out_settled)
