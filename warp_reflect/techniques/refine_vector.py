"""`refine.settle_kernel` for a block of mirror pixels at a time: the same decisions in the same order, bit for bit.

Each lane is one pixel. What one test of its candidate does not settle waits in lists, of pixels that walk on and of
neighbours' candidates that are asked, whose vectors are full at every hop.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import raster, vector
from warp_reflect.techniques.refine import CANDIDATE, DOUBT, EMPTY, WALK

wp.set_module_options({"enable_backward": False})

BLOCKS = 4  # of a task: its lists fill vectors, and what they hold stays in the nearest cache


@wp.func_native(
    vector.snippet(
        f"""
    constexpr int TASK = {BLOCKS} * BLOCK;
    constexpr int DOUBT = {int(DOUBT)}, CANDIDATE = {int(CANDIDATE)}, WALK = {int(WALK)}, EMPTY = {int(EMPTY)};
"""
        + vector.TRIANGLES
        + r"""
    const int count = pixel.shape[0];
    const int box_width = target.x1 - target.x0;
    const unsigned long long* keys = (const unsigned long long*)target.key.data;
    const int* next_triangle = (const int*)neighbours.data;
    const float* record = records.data;
    const int begin = task * TASK;
    const int end = begin + TASK < count ? begin + TASK : count;

    // Of a task's pixels: rays, eight numbers each, and what is found. Of walks: the pixel, the triangle, the one before it, how
    // the first one faced the ray, and their number. A vector more for the last load of a row.
    float origins[4 * TASK + 4], rays[4 * TASK + 4], best_u[TASK], best_v[TASK], best_t[TASK], facing_of[8 * TASK + LANES];
    int best_triangle[TASK], best_hops[TASK], state[TASK];
    int asker[8 * TASK + LANES], asked[8 * TASK + LANES], previous_of[8 * TASK + LANES], number_of[8 * TASK + LANES];
    int walker[TASK + LANES], walked[TASK + LANES];
    int walk_count = 0, ask_count = 0;

    struct Test { F det, t; V at; I inside, found, behind; };
    // shapes.intersect_triangle
    auto test = [&](I mask, I triangle, V origin, V ray) __attribute__((always_inline)) -> Test {
        F corner[8], rest[8];
        const I at = 12 * triangle;
        gather8(record, at, corner);
        gather8(record + 4, at, rest);
        const V a = sub(V{corner[0], corner[1], corner[2]}, origin);
        const V b = sub(V{corner[3], corner[4], corner[5]}, origin);
        const V c = sub(V{corner[6], corner[7], rest[4]}, origin);
        const F eu = dot(cross(sub(c, a), add(c, a)), ray);
        const F ev = dot(cross(sub(a, b), add(a, b)), ray);
        const F ew = dot(cross(sub(b, c), add(b, c)), ray);
        Test result;
        result.det = eu + ev + ew;
        const F inv = 1.0f / result.det;
        const F u = eu * inv, v = ev * inv, w = ew * inv;
        result.t = (w * dot(a, ray) + u * dot(b, ray) + v * dot(c, ray)) / dot(ray, ray);
        result.inside = mask & (result.det != 0.0f) & (((eu >= 0.0f) & (ev >= 0.0f) & (ew >= 0.0f))
            | ((eu <= 0.0f) & (ev <= 0.0f) & (ew <= 0.0f)));
        result.found = result.inside & (result.t > 0.0f);
        result.behind = (result.det > 0.0f) & (rest[5] != 0.0f);
        result.at = V{u, v, w};
        return result;
    };
    // shapes.clamp_weights
    auto clamp = [&](I found, F& u, F& v) {
        u = fmax(u, F(0.0f));
        v = fmax(v, F(0.0f));
        const F total = u + v;
        const I beyond = found & (total > 1.0f);
        if (bits(beyond)) {
            u = pick(beyond, u / total, u);
            v = pick(beyond, v / total, v);
        }
    };
    // The triangle across the edge that a ray is farthest beyond, -1 where there is none.
    auto across = [&](I triangle, V at) -> I {
        I edge = I(0);
        F lowest = at.y;
        edge = ipick(at.z < lowest, I(1), edge);
        lowest = pick(at.z < lowest, at.z, lowest);
        edge = ipick(at.x < lowest, I(2), edge);
        return igather(next_triangle, 3 * triangle + edge);
    };
    // refine.walk of many: lists of pixels and triangles, the numbers in which are kept; of each walk that ends in a hit
    // `take` is told. Those that go on stand side by side again after every hop. What comes to the triangle that its pixel is
    // known to hit ends there.
    auto walk = [&](int* own, int* triangles, int walks, int hops, bool begun, auto take) {
        for (; walks > 0 && hops <= hop_count; ++hops) {
            int on = 0;
            for (int start = 0; start < walks; start += LANES) {
                const I valid = start + lanes() < walks;
                const I place = ipick(valid, iload(own + start), I(own[start]));
                const I triangle = ipick(valid, iload(triangles + start), I(triangles[start]));
                const I previous = begun ? iload(previous_of + start) : I(-1);
                const I number = begun ? iload(number_of + start) : start + lanes();
                F origin[8], ray[8];
                gather8(origins, 4 * place, origin);
                gather8(rays, 4 * place, ray);
                const Test met = test(valid, triangle, V{origin[0], origin[1], origin[2]}, V{ray[0], ray[1], ray[2]});
                const F facing = begun ? load(facing_of + start) : met.det;
                if (bits(met.found)) take(met, place, triangle, number, facing, hops);
                if (hops == hop_count) continue;
                const I following = across(triangle, met.at);
                const I going = valid & (met.det != 0.0f) & ~met.inside & (following != previous) & (following >= 0)
                    & (following != igather(best_triangle, place));
                const unsigned left = marks(going);
                if (left == 0) continue;
                packed(own + on, place, left);
                packed(triangles + on, following, left);
                packed(previous_of + on, triangle, left);
                packed(number_of + on, number, left);
                on += packed((int*)facing_of + on, __builtin_bit_cast(I, facing), left);
            }
            walks = on;
            begun = true;
        }
    };

    // From the second lane on, and behind those the first of others.
    auto next = [](I lane, I other) -> I {
#if defined(__AVX512F__)
        return __builtin_shufflevector(lane, other, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16);
#else
        return __builtin_shufflevector(lane, other, 1, 2, 3, 4, 5, 6, 7, 8);
#endif
    };

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
        I settled = I(DOUBT);
        if (bits(nothing)) {
            // Nothing around either: sky.
            I empty = nothing & I(trust_sky != 0 ? -1 : 0);
            for (int k = 0; k < 9; ++k) empty &= drawn_at[k] < 0;
            settled = empty & EMPTY;
            live &= ~nothing;
        }
        istore(best_triangle + place, I(-1));
        istore(best_hops + place, I(0));
        if (bits(live)) {
            const I known = ipick(drawn < 0, I(0), drawn);
            const I candidate = ipick(live, igather(parents.data, known), I(0));
            const V origin = vrows((const float*)point.data, start, whole, own);
            const V ray = vrows((const float*)direction.data, start, whole, own);
            const Test met = test(live, candidate, origin, ray);
            F u = met.at.x, v = met.at.y;
            clamp(met.found, u, v);
            const I going = live & (met.det != 0.0f) & ~met.inside;
            live &= (met.found & ~met.behind) | going;
            if (bits(going) && hop_count > 0) {
                const I following = across(candidate, met.at);
                const I on = going & (following >= 0);
                const unsigned left = marks(on);
                packed(walker + walk_count, place + lanes(), left);
                packed(walked + walk_count, following, left);
                packed(previous_of + walk_count, candidate, left);
                packed(number_of + walk_count, place + lanes(), left);
                walk_count += packed((int*)facing_of + walk_count, __builtin_bit_cast(I, met.det), left);
            }
            istore(best_triangle + place, ipick(met.found, candidate, I(-1)));
            store(best_u + place, u);
            store(best_v + place, v);
            store(best_t + place, met.t);
            vstore4(origins, place, origin, u);
            vstore4(rays, place, ray, u);

            // The four opposite pairs: (1, 0), (-1, 1), (0, 1), (1, 1) and their negatives.
            I tested = I(-1), patch_at[9];
            if (dense) {
                // Each is three lanes' neighbour.
                _Pragma("clang loop unroll(full)") for (int row = 0; row < 9; row += 3) {
                    const I first = igather(patches.data, most(drawn_at[row], I(0))), last = most(drawn_at[row + 2], I(0));
                    I past = I(0);
                    past[0] = patches.data[last[LANES - 2]];
                    past[1] = patches.data[last[LANES - 1]];
                    patch_at[row] = first;
                    patch_at[row + 1] = next(first, past);
                    past[0] = past[1];
                    patch_at[row + 2] = next(patch_at[row + 1], past);
                }
            } else {
                for (int k = 0; k < 9; ++k) patch_at[k] = igather(patches.data, most(drawn_at[k], I(0)));
            }
            const F step = depth_step * depth, fine = fine_step * depth, nearer = nearer_share * depth;
            const I all = I(wary != 0 ? -1 : 0);
            _Pragma("clang loop unroll(full)") for (int side_of = 0; side_of < 8; ++side_of) {
                const int near_at = side_of % 2 == 0 ? 5 + side_of / 2 : 3 - side_of / 2;
                const F near = depth_at[near_at];
                const F far = depth_at[8 - near_at];
                const I other = drawn_at[near_at];
                const I there = live & (other >= 0);
                // refine.rise
                const F bend = pick(far > 0.0f, near - depth - fmax(depth - far, F(0.0f)), near - depth);
                live &= ~(there & (bend > step));
                const I ask = there & live & (other != tested) & (other != drawn)
                    & (all | (bend > fine) | ((patch_at[near_at] != patch_at[4]) & (near > nearer)));
                tested = ipick(ask, other, tested);
                const unsigned left = marks(ask);
                packed(asker + ask_count, place + lanes(), left);
                ask_count += packed(asked + ask_count, other, left);
            }
            settled = ipick(live, I(CANDIDATE), settled);
        }
        istore(state + place, settled);
    }

    // What leaves its candidate.
    walk(walker, walked, walk_count, 1, true, [&](const Test& met, I place, I triangle, I number, F facing, int hops) {
        F u = met.at.x, v = met.at.y;
        clamp(met.found, u, v);
        const unsigned wrong = bits((facing * met.det < 0.0f) | met.behind);
        for (unsigned left = bits(met.found); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left), i = place[l];
            best_triangle[i] = triangle[l];
            best_u[i] = u[l]; best_v[i] = v[l]; best_t[i] = met.t[l];
            best_hops[i] = hops;
            if (wrong >> l & 1) state[i] = DOUBT;
        }
    });

    // Neighbouring candidates that may be hit before a pixel's own, of those that have one.
    int asks = 0;
    for (int start = 0; start < ask_count; start += LANES) {
        const I valid = start + lanes() < ask_count;
        const I place = ipick(valid, iload(asker + start), I(asker[start]));
        const I drawn = ipick(valid, iload(asked + start), I(asked[start]));
        const I triangle = igather(parents.data, drawn), known = igather(best_triangle, place);
        const unsigned left = marks(valid & (igather(state, place) == CANDIDATE) & (known >= 0) & (triangle != known));
        packed(asker + asks, place, left);
        asks += packed(asked + asks, triangle, left);
    }
    // Those that are, in the order in which they were asked for: that of one thread per pixel.
    struct Nearer { int number, place, triangle, hops; float u, v, t; bool turned; };
    Nearer found[8 * TASK];
    int found_count = 0;
    walk(asker, asked, asks, 0, false, [&](const Test& met, I place, I triangle, I number, F facing, int hops) {
        F u = met.at.x, v = met.at.y;
        clamp(met.found, u, v);
        const unsigned turned = bits(facing * met.det < 0.0f);
        for (unsigned left = bits(met.found & (met.t < gather(best_t, place))); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            int at = found_count++;
            for (; at > 0 && found[at - 1].number > number[l]; --at) found[at] = found[at - 1];
            found[at] = Nearer{number[l], place[l], triangle[l], hops, u[l], v[l], met.t[l], (turned >> l & 1) != 0};
        }
    });
    for (int k = 0; k < found_count; ++k) {
        const Nearer& hit = found[k];
        const int i = hit.place;
        if (state[i] != CANDIDATE || !(hit.t < best_t[i])) continue;
        if (hit.turned) state[i] = DOUBT;
        best_hops[i] = hit.hops;
        best_triangle[i] = hit.triangle;
        best_u[i] = hit.u; best_v[i] = hit.v; best_t[i] = hit.t;
    }

    typedef unsigned char Bytes __attribute__((ext_vector_type(LANES)));
    for (int start = begin; start < end; start += LANES) {
        const int place = start - begin;
        const I as = iload(state + place), triangle = iload(best_triangle + place), empty = as == EMPTY;
        I hit = (as == CANDIDATE) & (triangle >= 0);
        const I by_walk = hit & (iload(best_hops + place) > 0);
        if (wary != 0) hit &= ~by_walk;
        const I who = ipick(hit, ipick(by_walk, I(WALK), I(CANDIDATE)), ipick(empty, I(EMPTY), I(DOUBT)));
        if (start + LANES <= end) {
            // What is in doubt stays as it is.
            const Bytes of = __builtin_convertvector(who, Bytes);
            __builtin_memcpy(out_settled.data + start, &of, sizeof(of));
            Bytes status;
            __builtin_memcpy(&status, out_status.data + start, sizeof(status));
            const I now = ipick(hit, I(converged), ipick(empty, I(sky), __builtin_convertvector(status, I)));
            status = __builtin_convertvector(now, Bytes);
            __builtin_memcpy(out_status.data + start, &status, sizeof(status));
            istore(out_triangle.data + start, ipick(hit, triangle, ipick(empty, I(-1), iload(out_triangle.data + start))));
            store(out_u.data + start, pick(hit, load(best_u + place), load(out_u.data + start)));
            store(out_v.data + start, pick(hit, load(best_v + place), load(out_v.data + start)));
            store(out_distance.data + start, pick(hit, load(best_t + place), load(out_distance.data + start)));
            continue;
        }
        for (int i = start; i < end; ++i) {
            const int l = i - start;
            out_settled.data[i] = (unsigned char)who[l];
            if (who[l] == EMPTY) {
                out_triangle.data[i] = -1;
                out_status.data[i] = (unsigned char)sky;
            } else if (who[l] != DOUBT) {
                out_triangle.data[i] = triangle[l];
                out_u.data[i] = best_u[l + place];
                out_v.data[i] = best_v[l + place];
                out_distance.data[i] = best_t[l + place];
                out_status.data[i] = (unsigned char)converged;
            }
        }
    }
"""
    )
)
def settle_block(
    task: int,
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
    """One thread per `BLOCKS` blocks of mirror pixels."""
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
