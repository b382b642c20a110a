"""The rays of `shadows.py`'s kernels for a block of points at a time.

The same rays, to the last bit, in packets (`any_hit.py`): those of points of a tile of the picture, sorted by the parts of a
light that they are sent to where points lie closer together than what shines is wide.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import compact, vector
from warp_reflect.any_hit import ANY_HIT
from warp_reflect.direct import CYLINDER, SPHERE, DirectView
from warp_reflect.launch import launch
from warp_reflect.shadow_neighbours import (
    DARK,
    FLATNESS,
    LEAST_COUNT,
    LEAST_SPREAD,
    LEVELS,
    LIT,
    NEIGHBOURS,
    SAME_TURN,
    SHARP,
    STEEP,
    Neighbours,
)
from warp_reflect.shadow_starts import Starts

wp.set_module_options({"enable_backward": False})

# Blocks of pictures of whole multiples of so many pixels, and of half as many rows, are tiles a vector wide: as many as there
# are blocks of one row, whether a vector has 16 lanes and four of them make a block, or 8 and eight do.
TILE = 16
BLOCK_SPLIT_MIN = 8  # blocks; what `bvh.TRACE_SPLIT_MIN` rays are
# What `send_blocks_kernel` does.
FIRST, SHARED, ALL, EACH, SKY = 0, 1, 2, 3, 4
CODES = [FIRST, SHARED, EACH, SKY, SPHERE, CYLINDER, DARK, LIT, LEVELS, NEIGHBOURS]
CODES += [SAME_TURN, FLATNESS, LEAST_COUNT, SHARP, LEAST_SPREAD, STEEP, TILE]


@wp.func_native(
    vector.snippet(
        ANY_HIT
        + r"""
    // A block's points. In a picture of whole tiles they are those of a tile, a row a vector, else they follow each other.
    const int image_width = around.width;
    const bool listed = around.pixel.shape[0] > 0;
    const int pictured_count = listed ? around.index.shape[0] : count;
    const bool tiled = image_width > 0 && image_width % tile == 0 && pictured_count > 0 && pictured_count % image_width == 0
        && pictured_count / image_width % (tile / 2) == 0;
    const int stride = starts.rows.shape[1];
    int own_of[BLOCK], count_of[GROUPS];
    bool beside[GROUPS];
    for (int v = 0; v < GROUPS; ++v) {
        const int across = tiled ? image_width / LANES : 1;
        int first = block * BLOCK + v * LANES;
        if (tiled) first = (block / across * GROUPS + v) * image_width + block % across * LANES;
        I own = first + lanes();
        count_of[v] = first + LANES <= count ? LANES : first < count ? count - first : 0;
        if (tiled && listed) {
            const I index = iload(around.index.data + first);
            count_of[v] = 0;
            for (unsigned left = bits(~(index < 0)); left != 0; left &= left - 1)
                own_of[v * LANES + count_of[v]++] = index[__builtin_ctz(left)];
            for (int l = count_of[v]; l < LANES; ++l) own_of[v * LANES + l] = count_of[v] > 0 ? own_of[v * LANES + l - 1] : 0;
            own = iload(own_of + v * LANES);
        }
        const I there = lanes() < count_of[v];
        beside[v] = own[0] + LANES <= stride && !bits(there & (own != own[0] + lanes()));
        istore(own_of + v * LANES, ipick(there, own, I(count_of[v] > 0 ? own[0] : 0)));
    }
    const float* rows = starts.rows.data;
    // Of all points of a vector.
    auto values = [&](const float* of, int v) -> F {
        return beside[v] ? load(of + own_of[v * LANES]) : gather(of, iload(own_of + v * LANES));
    };
    auto root = [](F a) -> F { return __builtin_elementwise_sqrt(a); };
    auto below = [](F a) -> F { return a - __builtin_elementwise_floor(a); };
    // shadows.sample_place
    auto place_x = [&](F k, F shift) -> F { return below(0.5f + 0.7548776662466927f * k + shift); };
    auto place_y = [&](F k, F shift) -> F { return below(0.5f + 0.5698402909980532f * k + shift); };
    // shadows.turn
    auto turn = [&](F share, F& cosine, F& sine) {
        const F quarter = __builtin_elementwise_floor(4.0f * share + 0.5f);
        const F a = 6.283185307179586f * (share - 0.25f * quarter);
        const F square = a * a;
        const F s = a + a * square * (-1.6666654611e-1f + square * (8.3321608736e-3f + square * -1.9515295891e-4f));
        const F c = 1.0f - 0.5f * square
            + square * square * (4.166664568298827e-2f + square * (-1.388731625493765e-3f + square * 2.443315711809948e-5f));
        const I q = __builtin_convertvector(quarter, I) & 3;
        const I odd = (q & 1) != 0;
        const F x = pick(odd, s, c), y = pick(odd, c, s);
        cosine = pick((q == 1) | (q == 2), -x, x);
        sine = pick(q >= 2, -y, y);
    };
    // optics.tangent_basis
    auto basis = [&](V n, V& t1, V& t2) {
        const F sign = pick(n.z < 0.0f, F(-1.0f), F(1.0f));
        const F a = -1.0f / (sign + n.z);
        const F b = n.x * n.y * a;
        t1 = V{1.0f + sign * n.x * n.x * a, sign * b, -sign * n.x};
        t2 = V{b, sign + n.y * n.y * a, -n.y};
    };
    struct Ray { V d; F reach, weight; };
    // shadows.area_ray
    auto area_ray = [&](const auto& light, V p, V n, F x, F y) -> Ray {
        Ray ray;
        F cosine, sine;
        if (light.kind == sphere) {
            const V to_centre = sub(spread(light.centre), p);
            const F distance = root(dot(to_centre, to_centre));
            const V axis = V{to_centre.x / distance, to_centre.y / distance, to_centre.z / distance};
            const F square = fmin(F(light.radius * light.radius) / (distance * distance), F(1.0f));
            const F fall = x * square / (1.0f + root(1.0f - square));
            const F out = root(fmax(fall * (2.0f - fall), F(0.0f)));
            turn(y, cosine, sine);
            V t1, t2;
            basis(axis, t1, t2);
            ray.d = add(times(1.0f - fall, axis), times(out, add(times(cosine, t1), times(sine, t2))));
            const F half = root(fmax(light.radius * light.radius - distance * distance * out * out, F(0.0f)));
            ray.reach = (1.0f - 1.0e-3f) * (distance * (1.0f - fall) - half);
            ray.weight = fmax(dot(n, ray.d), F(0.0f));
            return ray;
        }
        V x_axis = spread(light.x), y_axis = spread(light.y), normal = spread(light.out);
        int sides = light.sides;
        if (light.kind == cylinder) {
            const float two = __builtin_sqrtf(2.0f);
            const V across = unit(cross(spread(light.x), sub(spread(light.centre), p)));
            x_axis = times(F(two), spread(light.x));
            y_axis = times(F(two * light.radius), across);
            normal = unit(cross(x_axis, y_axis));
            sides = 4;
        }
        V at = spread(light.centre);
        if (sides == 4) {
            const float half = __builtin_sqrtf(0.5f);
            at = add(at, add(times((2.0f * x - 1.0f) * half, x_axis), times((2.0f * y - 1.0f) * half, y_axis)));
        } else {
            turn(y, cosine, sine);
            at = add(at, times(root(x), add(times(cosine, x_axis), times(sine, y_axis))));
        }
        const V to = sub(at, p);
        const F distance = root(dot(to, to));
        ray.d = unit(to);
        ray.reach = (1.0f - 1.0e-3f) * distance;
        ray.weight = fmax(dot(n, ray.d), F(0.0f))
            * (__builtin_elementwise_abs(dot(normal, ray.d)) / fmax(distance * distance, F(1.0e-30f)));
        return ray;
    };
    // Lanes whose point is outside of a sphere that shines: the others are wholly lit.
    auto outside = [&](const auto& light, V p) -> I {
        if (light.kind != sphere) return I(-1);
        const V to_centre = sub(spread(light.centre), p);
        return ~(root(dot(to_centre, to_centre)) <= light.radius);
    };
    // Almost all points ask distant lights: where those of the next block start is on its way while these go. A picture's tiles
    // are too many rows for the processor to see that coming.
    for (int v = 0; v < GROUPS && lights.distant.shape[0] > 0; ++v) {
        const float* next = rows + own_of[v * LANES] + (tiled ? LANES : BLOCK);
        for (int r = 0; r < 6; ++r) __builtin_prefetch(next + r * stride);
    }
    // A light: a distant one, else a shape, or the sky.
    constexpr int SKY = -1;
    // As many rays are sorted at once, at most, by parts of what they are sent to.
    constexpr int RAYS = 16 * BLOCK, PARTS = 16;
    const int area_count = lights.areas.shape[0], distant_count = lights.distant.shape[0];
    const bool to_sky = mode == sky_mode, only_first = mode == first_mode, each = mode == each_mode;
    const bool sharing = mode == shared_mode, to_all = !to_sky && !only_first && !each && !sharing;
    float share[BLOCK], known[BLOCK], before[BLOCK];
    V total[GROUPS];
    for (int v = 0; v < GROUPS; ++v) total[v] = same(0.0f);
    int asking[BLOCK];
    // Where vectors of points lie in the pictures of what rays find (shadow_neighbours.place_of); most lie side by side in a row.
    typedef unsigned char Entries __attribute__((ext_vector_type(LANES)));
    const int line = around.width + 2 * neighbours;
    const bool pictured = sharing || to_all || only_first;
    int number[BLOCK], place[BLOCK];
    bool straight[GROUPS];
    for (int v = 0; pictured && v < GROUPS; ++v) {
        if (count_of[v] == 0) continue;
        const I own = iload(own_of + v * LANES);
        const I pixel = listed ? igather(around.pixel.data, own) : own;
        const int row = pixel[0] / around.width;
        straight[v] = count_of[v] == LANES && (row + 1) * around.width - pixel[0] >= LANES && !bits(pixel != pixel[0] + lanes());
        const I rows_before = straight[v] ? I(row) : pixel / around.width;
        istore(number + v * LANES, pixel);
        istore(place + v * LANES, pixel + 2 * neighbours * rows_before + neighbours * line + neighbours);
    }
    // Where the rays of the next block to shapes start is on its way, too, if it looks as though it sends some.
    if (pictured && area_count > 0) {
        const int ahead = tiled ? LANES : BLOCK;
        bool next_asks = false;
        for (int k = 0; k < area_count; ++k) {
            const float* unshadowed = starts.unshadowed.data + k * stride;
            const unsigned char* of = (sharing || known_samples == 0 ? around.found.data : around.shared.data)
                + k * (long)around.found.shape[1];
            unsigned long long all = 0;
            for (int v = 0; v < GROUPS; ++v) {
                const int next = own_of[v * LANES] + ahead;
                __builtin_prefetch(unshadowed + next + ahead);
                if (count_of[v] == 0) continue;
                unsigned long long some;
                __builtin_memcpy(&some, of + place[v * LANES] + LANES, sizeof(some));
                all |= some;
                if (only_first) next_asks |= next < stride && unshadowed[next] > 0.0f;
            }
            // Some first rays met something there, and some did not.
            constexpr unsigned long long EACH_BYTE = 0x0101010101010101ull;
            if (!only_first) next_asks |= (all & EACH_BYTE * dark) != 0 && (all & EACH_BYTE * lit) != 0;
        }
        for (int v = 0; v < GROUPS && next_asks; ++v) {
            const float* next = rows + own_of[v * LANES] + ahead;
            for (int r = 0; r < 11; ++r)
                if (r < 6 || r >= 9 || to_all) __builtin_prefetch(next + r * stride);
        }
    }
    auto entries = [&](const unsigned char* of, int v, int step) -> Entries {
        Entries e;
        if (straight[v]) __builtin_memcpy(&e, of + place[v * LANES] + step, sizeof(e));
        else EACH_LANE e[l] = of[place[v * LANES + l] + step];
        return e;
    };
    auto numbers = [](Entries e) -> I { return __builtin_convertvector(e, I); };
    // shadow_neighbours.found_around
    auto found_around = [&](const unsigned char* found, int v) -> I {
        Entries together = Entries(0);
        for (int y = -neighbours; y <= neighbours; ++y)
            for (int x = -neighbours; x <= neighbours; ++x) together |= entries(found, v, y * line + x);
        return numbers(together) & (dark | lit);
    };
    // shadow_neighbours.shared_share of a vector of points, lanes `asked` of it.
    auto shared_shares = [&](const unsigned char* shared, const float* unshadowed, int v, I asked) -> F {
        auto own_row = [&](int r) -> F { return values(rows + r * stride, v); };
        const V p = V{own_row(0), own_row(1), own_row(2)}, side = V{own_row(6), own_row(7), own_row(8)};
        const I here = iload(own_of + v * LANES), pixel = iload(number + v * LANES);
        I known = I(0), total = I(0), squares = I(0);
        I sum_x = I(0), sum_y = I(0), square_x = I(0), along_x = I(0), along_y = I(0);
        F brought = F(0.0f), arrived = F(0.0f);
        const F flat = F(flatness * flatness), same_side = F(same_turn);
        for (int y = -neighbours; y <= neighbours; ++y) {
            for (int x = -neighbours; x <= neighbours; ++x) {
                const I entry = numbers(entries(shared, v, y * line + x));
                const I there = asked & (entry != 0);
                const unsigned some = bits(there);
                if (!some) continue;
                I other = ipick(there, pixel + (y * around.width + x), I(0));
                if (around.index.shape[0] > 0) other = igather(around.index.data, other);
                // Points of pixels beside each other mostly follow one another.
                const int lead = __builtin_ctz(some), from = other[lead] - lead;
                const bool beside_each = from >= 0 && from + LANES <= stride && !bits(there & (other != from + lanes()));
                if (!beside_each) other = ipick(there, other, here);
                auto pull = [&](const float* of) -> F { return beside_each ? load(of + from) : gather(of, other); };
                auto row = [&](int r) -> F { return pull(rows + r * stride); };
                const V away = sub(V{row(0), row(1), row(2)}, p);
                const F beside = dot(side, away);
                const F turned = dot(side, V{row(6), row(7), row(8)});
                const I near = there & (beside * beside <= flat * dot(away, away)) & (turned >= same_side);
                if (!bits(near)) continue;
                const I level = near & entry >> 2;
                known -= near;
                total += level;
                squares += level * level;
                sum_x += near & x;
                sum_y += near & y;
                square_x += near & x * x;
                along_x += x * level;
                along_y += y * level;
                const F brings = pull(unshadowed);
                brought = pick(near, brought + brings, brought);
                arrived = pick(near, arrived + brings * __builtin_convertvector(level, F), arrived);
            }
        }
        const I spread = total * (levels * known - total), between = known * squares - total * total;
        const I edge = (sharp * between > spread) & (least_spread * spread > levels * levels * known * known);
        const F slope_x = __builtin_convertvector(known * along_x - total * sum_x, F);
        const F slope_y = __builtin_convertvector(known * along_y - total * sum_y, F);
        const F limit = steep * __builtin_convertvector(levels * known * square_x, F);
        const I asks_itself = edge | (slope_x * slope_x + slope_y * slope_y > limit * limit) | (known < least_count);
        return pick(asks_itself, F(-1.0f), arrived / ((float)levels * brought));
    };
    const int first_light = to_sky ? SKY : only_first || sharing ? distant_count : 0;
    const int last_light = to_sky ? SKY : distant_count + area_count - 1;
    for (int light = first_light; light <= last_light; ++light) {
        const bool distant = light >= 0 && light < distant_count;
        const int k = light - distant_count;
        const int known_count = distant ? 0 : known_samples, ray_count = distant ? 1 : samples;
        const long of_light = light < distant_count ? 0 : k * (long)around.found.shape[1];
        unsigned char* found = around.found.data + of_light;
        unsigned char* shared = around.shared.data + of_light;
        const bool casts = to_sky || (distant ? cast_distant.data[light] : cast_areas.data[k]) != 0;
        // What would arrive unshadowed, `before`, and which points have to ask.
        int asking_count = 0;
        unsigned marks[GROUPS] = {};
        for (int v = 0; v < GROUPS; ++v) {
            if (count_of[v] == 0) continue;
            auto row = [&](int r) -> F { return values(rows + r * stride, v); };
            const I there = lanes() < count_of[v];
            I asks;
            F of_what = F(1.0f), arrives = F(1.0f);
            if (to_sky) {
                asks = there & ((row(3) != 0.0f) | (row(4) != 0.0f) | (row(5) != 0.0f));
            } else {
                if (distant) of_what = dot(V{row(3), row(4), row(5)}, spread(lights.distant.data[light].to_light));
                else of_what = values(starts.unshadowed.data + k * stride, v);
                asks = there & (of_what > 0.0f);
                if (!casts) asks = I(0);
                if (!distant && bits(asks) && (sharing || to_all)) {
                    const bool by_first = sharing || known_count == 0;
                    const Entries entry = entries(by_first ? found : shared, v, 0);
                    const I together = by_first ? found_around(found, v) : numbers(entry) & (lit | dark);
                    const I settled = asks & (together != (lit | dark));
                    store(known + v * LANES, __builtin_convertvector(numbers(entry) >> 2, F) / (float)levels);
                    asks &= ~settled;
                    if (sharing && straight[v]) {
                        unsigned char* own = shared + place[v * LANES];
                        const Entries kept = __builtin_convertvector(settled, Entries);
                        Entries all;
                        __builtin_memcpy(&all, own, sizeof(all));
                        all = (entry & kept) | (all & ~kept);
                        __builtin_memcpy(own, &all, sizeof(all));
                    } else if (sharing) {
                        for (unsigned left = bits(settled); left != 0; left &= left - 1) {
                            const int l = __builtin_ctz(left);
                            shared[place[v * LANES + l]] = entry[l];
                        }
                    } else if (to_all) {
                        arrives = pick(settled & (together == dark), F(0.0f), arrives);
                        if (known_count > 0 && bits(asks)) {
                            const F mean = shared_shares(shared, starts.unshadowed.data + k * stride, v, asks);
                            const I told = asks & ~(mean < 0.0f);
                            arrives = pick(told, mean, arrives);
                            asks &= ~told;
                        }
                    }
                }
            }
            store(before + v * LANES, of_what);
            store(share + v * LANES, arrives);
            marks[v] = bits(asks);
        }
        // In tiles four columns after four: a vector's rays then start close together both ways.
        const int columns = tiled ? 4 : LANES;
        for (int from = 0; from < LANES; from += columns)
            for (int v = 0; v < GROUPS; ++v)
                for (unsigned left = marks[v] & ((1u << columns) - 1) << from; left != 0; left &= left - 1)
                    asking[asking_count++] = v * LANES + __builtin_ctz(left);
        // The starts of those that ask, one after the other.
        float start[11][2 * BLOCK], brought[2 * BLOCK], arrived[2 * BLOCK], brought_by[RAYS], arrived_by[RAYS];
        int of[RAYS], which[RAYS], order[RAYS];
        for (int v = 0; v * LANES < asking_count; ++v) {
            const I asked = v * LANES + lanes() < asking_count ? iload(asking + v * LANES) : I(asking[0]);
            const I own = igather(own_of, asked);
            I lead;
            EACH_LANE lead[l] = own[l & ~3];
            const bool together = !bits(own - own[0] != lanes()), by_fours = !bits(own - lead != (lanes() & 3));
            // Of a distant light all directions are the same, and only those to the sky look at the facet.
            for (int r = 0; r < (distant ? 3 : 11); ++r) {
                if (r >= 6 && r < 9 && !to_sky) continue;
                const float* from = rows + r * stride;
                F of_points;
                if (together) {
                    of_points = load(from + own[0]);
                } else if (by_fours) {
                    Four part[LANES / 4];
                    for (int k = 0; k < LANES / 4; ++k) __builtin_memcpy(&part[k], from + own[4 * k], sizeof(Four));
                    of_points = joined(part);
                } else {
                    of_points = gather(from, own);
                }
                store(start[r] + v * LANES, of_points);
            }
            store(brought + v * LANES, F(0.0f));
            store(arrived + v * LANES, F(0.0f));
        }
        // All of a point's rays, point by point; they go on their way in the order of where on the light they end.
        int point = 0, sample = known_count;
        const bool each_once = ray_count == known_count + 1;
        int together_count = BLOCK;
        bool round = true;
        // What lies between the points and a shape is looked up once where as many packets as make up for that go that way.
        constexpr int LOOKED_UP_FROM = 3 * BLOCK;
        float leaves[8 * LEAVES_MOST];
        const float* roots = tree_nodes;
        int root_count = 1;
        if (!distant && !to_sky && asking_count * (ray_count - known_count) >= LOOKED_UP_FROM) {
            V low = same(3.0e38f), high = same(-3.0e38f);
            for (int v = 0; v * LANES < asking_count; ++v) {
                const V at = V{load(start[0] + v * LANES), load(start[1] + v * LANES), load(start[2] + v * LANES)};
                low = V{fmin(at.x, low.x), fmin(at.y, low.y), fmin(at.z, low.z)};
                high = V{fmax(at.x, high.x), fmax(at.y, high.y), fmax(at.z, high.z)};
            }
            // Of the shape, and wider by more than the rounding of its samples.
            const auto& area = lights.areas.data[k];
            float most[3];
            for (int axis = 0; axis < 3; ++axis) {
                const float across = __builtin_fabsf(area.x[axis]), along = __builtin_fabsf(area.y[axis]);
                most[axis] = area.kind == sphere ? area.radius : across + (area.kind == cylinder ? area.radius : along);
            }
            const V centre = spread(area.centre), wide = times(F(1.0001f), V{F(most[0]), F(most[1]), F(most[2])});
            const int found = leaves_within(shaft_of(low, high, sub(centre, wide), add(centre, wide)), leaves);
            if (found >= 0) {
                roots = leaves;
                root_count = found;
            }
        }
        if (!distant && !each_once && asking_count > 0) {
            // Rays go together that start close to each other, or that end so: how many are asked for at once decides it.
            auto span = [&](const float* of_axis) -> float {
                F least = F(3.0e38f), most = F(-3.0e38f);
                for (int v = 0; v * LANES < asking_count; ++v) {
                    least = fmin(load(of_axis + v * LANES), least);
                    most = fmax(load(of_axis + v * LANES), most);
                }
                return folded(most, larger) - folded(least, lesser);
            };
            auto length = [](float x, float y, float z) -> float { return __builtin_sqrtf(x * x + y * y + z * z); };
            const float of_points = length(span(start[0]), span(start[1]), span(start[2]));
            float of_light = 3.0e38f;
            if (!to_sky) {
                const auto& area = lights.areas.data[k];
                round = area.kind == sphere || area.sides != 4 && area.kind != cylinder;
                of_light = area.kind == sphere
                    ? 2.0f * area.radius
                    : length(area.x[0], area.x[1], area.x[2]) + length(area.y[0], area.y[1], area.y[2]);
            }
            const float all = (float)(asking_count * (ray_count - known_count));
            float narrowest = 3.0e38f;
            for (int count = BLOCK; count <= RAYS; count *= 2) {
                const float share = count < all ? count / all : 1.0f;
                const float wide = of_points * share + of_light * __builtin_sqrtf((float)BLOCK / count);
                if (wide < narrowest) {
                    narrowest = wide;
                    together_count = count;
                }
                if (share == 1.0f) break;
            }
        }
        while (point < asking_count && known_count < ray_count) {
            int used = 0;
            if (each_once) {
                used = asking_count;
                point = asking_count;
                for (int i = 0; i < used; i += LANES) {
                    istore(of + i, i + lanes());
                    istore(which + i, I(sample));
                }
            }
            for (; used < together_count && point < asking_count; ++used) {
                of[used] = point;
                which[used] = sample;
                if (++sample == ray_count) { sample = known_count; ++point; }
            }
            const int whole = (used + BLOCK - 1) / BLOCK * BLOCK;
            for (int i = used; i < whole; ++i) { of[i] = of[used - 1]; which[i] = which[used - 1]; }
            const bool sorted = used > BLOCK;
            if (sorted) {
                int part[RAYS], begin[PARTS + 1] = {};
                for (int from = 0; from < used; from += LANES) {
                    const I own = iload(of + from);
                    const F s = __builtin_convertvector(iload(which + from), F);
                    const F x = place_x(s, gather(start[9], own)), y = place_y(s, gather(start[10], own));
                    const I column = __builtin_convertvector(4.0f * x, I), row = __builtin_convertvector(4.0f * y, I);
                    // Of what is round y is a turn: quarters of it first.
                    const I turned = __builtin_convertvector(8.0f * y, I);
                    const I by_turn = (turned >> 1) * 4 + (column >> 1) * 2 + (turned & 1);
                    const I by_square = (row >> 1) * 8 + (column >> 1) * 4 + (row & 1) * 2 + (column & 1);
                    istore(part + from, round ? by_turn : by_square);
                }
                for (int i = 0; i < used; ++i) ++begin[part[i] + 1];
                for (int i = 1; i < PARTS; ++i) begin[i] += begin[i - 1];
                for (int i = 0; i < used; ++i) order[begin[part[i]]++] = i;
                for (int i = used; i % BLOCK != 0; ++i) order[i] = order[used - 1];
            }
            for (int from = 0; from < used; from += BLOCK) {
                V p[GROUPS], d[GROUPS];
                F weight[GROUPS], reach[GROUPS];
                I sent[GROUPS], met[GROUPS];
                for (int g = 0; g < GROUPS; ++g) {
                    const int at = from + g * LANES;
                    const I own = sorted ? igather(of, iload(order + at)) : iload(of + at);
                    const F s = __builtin_convertvector(sorted ? igather(which, iload(order + at)) : iload(which + at), F);
                    const bool alone = of[at] == of[at + LANES - 1] && !sorted;
                    auto pull = [&](int r) -> F {
                        const float* first = start[r] + own[0];
                        return alone ? F(first[0]) : each_once ? load(first) : gather(start[r], own);
                    };
                    p[g] = V{pull(0), pull(1), pull(2)};
                    sent[g] = from + g * LANES + lanes() < used;
                    if (distant) {
                        d[g] = flushed(spread(lights.distant.data[light].to_light));
                        reach[g] = F(3.0e38f);
                        weight[g] = F(1.0f);
                        continue;
                    }
                    const V n = V{pull(3), pull(4), pull(5)};
                    const F x = place_x(s, pull(9)), y = place_y(s, pull(10));
                    if (to_sky) {
                        // shadows.sky_ray
                        F cosine, sine;
                        V t1, t2;
                        basis(n, t1, t2);
                        turn(y, cosine, sine);
                        const V across = times(root(x), add(times(cosine, t1), times(sine, t2)));
                        d[g] = add(across, times(root(fmax(1.0f - x, F(0.0f))), n));
                        reach[g] = F(3.0e38f);
                        weight[g] = F(1.0f);
                        sent[g] &= dot(d[g], V{pull(6), pull(7), pull(8)}) > 0.0f;
                        d[g] = flushed(d[g]);
                        continue;
                    }
                    const auto& area = lights.areas.data[k];
                    const Ray ray = area_ray(area, p[g], n, x, y);
                    d[g] = flushed(ray.d);
                    reach[g] = ray.reach;
                    weight[g] = ray.weight;
                    sent[g] &= outside(area, p[g]) & (ray.weight > 0.0f);
                }
                find_blocked(sent, p, d, reach, met, roots, root_count);
                for (int g = 0; from + g * LANES < used; ++g) {
                    const int at = from + g * LANES;
                    const F brings = pick(sent[g], weight[g], F(0.0f)), arrives = pick(sent[g] & ~met[g], weight[g], F(0.0f));
                    if (!sorted) {
                        store(brought_by + at, brings);
                        store(arrived_by + at, arrives);
                        continue;
                    }
                    float each[2][LANES];
                    store(each[0], brings);
                    store(each[1], arrives);
                    for (int l = 0; l < LANES && at + l < used; ++l) {
                        brought_by[order[at + l]] = each[0][l];
                        arrived_by[order[at + l]] = each[1][l];
                    }
                }
            }
            if (each_once) {
                for (int i = 0; i < used; i += LANES) {
                    store(brought + of[i], load(brought_by + i));
                    store(arrived + of[i], load(arrived_by + i));
                }
                continue;
            }
            for (int i = 0; i < used; ++i) {
                brought[of[i]] += brought_by[i];
                arrived[of[i]] += arrived_by[i];
            }
        }
        for (int a = 0; a < asking_count; a += LANES) {
            const I asked = a + lanes() < asking_count ? iload(asking + a) : I(asking[0]);
            const F brings = load(brought + a);
            F found_share = pick(brings != 0.0f, load(arrived + a) / brings, gather(share, asked));
            if (known_count > 0) {
                const F first_share = gather(known, asked);
                found_share = ((float)known_count * first_share + (float)(ray_count - known_count) * found_share)
                    / (float)ray_count;
            }
            I code = ipick(found_share == 0.0f, I(dark), I(lit | dark));
            code = ipick(found_share == 1.0f, I(lit), code);
            code |= __builtin_convertvector(found_share * (float)levels + 0.5f, I) << 2;
            // One after the other out of memory: lanes that are named by a variable are kept there anew, each time.
            float share_of[LANES];
            int code_of[LANES];
            store(share_of, found_share);
            istore(code_of, sharing ? code | (lit | dark) : code);
            const int some = asking_count - a < LANES ? asking_count - a : LANES;
            for (int l = 0; l < some; ++l) share[asking[a + l]] = share_of[l];
            unsigned char* kept = only_first ? found : shared;
            for (int l = 0; l < some && (only_first || sharing); ++l) kept[place[asking[a + l]]] = (unsigned char)code_of[l];
            for (int l = 0; l < some && to_sky; ++l)
                if (brought[a + l] != 0.0f) out_share.data[own_of[asking[a + l]]] = share_of[l];
        }
        for (int j = 0; each && j < BLOCK; ++j) {
            if (j % LANES >= count_of[j / LANES]) continue;
            const float* n = rows + 3 * stride + own_of[j];
            if (n[0] == 0.0f && n[stride] == 0.0f && n[2 * stride] == 0.0f) continue;
            out_share.data[own_of[j] * (distant_count + area_count) + light] = share[j];
        }
        if (!to_all) continue;
        const V color = spread(distant ? lights.distant.data[light].irradiance : lights.areas.data[k].radiance);
        for (int v = 0; v < GROUPS; ++v) {
            if (count_of[v] == 0) continue;
            const F of_what = load(before + v * LANES);
            const V sum = add(total[v], times(of_what * load(share + v * LANES), color));
            total[v] = vpick(of_what > 0.0f, sum, total[v]);
        }
    }
    for (int v = 0; to_all && v < GROUPS; ++v) {
        float* to = (float*)out_irradiance.data;
        if (count_of[v] == LANES && beside[v]) {
            vstore(to, own_of[v * LANES], total[v]);
            continue;
        }
        for (int l = 0; l < count_of[v]; ++l) {
            float* one = to + 3 * own_of[v * LANES + l];
            one[0] = total[v].x[l]; one[1] = total[v].y[l]; one[2] = total[v].z[l];
        }
    }
"""
    )
)
def send_block(
    block: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    known_samples: int,
    samples: int,
    around: Neighbours,
    mode: int,
    first_mode: int,
    shared_mode: int,
    each_mode: int,
    sky_mode: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    levels: int,
    neighbours: int,
    same_turn: float,
    flatness: float,
    least_count: int,
    sharp: int,
    least_spread: int,
    steep: float,
    tile: int,
    out_irradiance: wp.array(dtype=wp.vec3),
    out_share: wp.array(dtype=float),
): ...


@wp.kernel
def send_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    known_samples: int,
    samples: int,
    around: Neighbours,
    mode: int,
    first_mode: int,
    shared_mode: int,
    each_mode: int,
    sky_mode: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    levels: int,
    neighbours: int,
    same_turn: float,
    flatness: float,
    least_count: int,
    sharp: int,
    least_spread: int,
    steep: float,
    tile: int,
    # Outputs:
    out_irradiance: wp.array(dtype=wp.vec3),
    out_share: wp.array(dtype=float),
):
    """One thread per block of points; mode: `FIRST` rays, `SHARED` ones, `ALL` that count, `EACH` light, or the `SKY`."""
    send_block(
        first + wp.tid(),
        mesh_id,
        lights,
        cast_distant,
        cast_areas,
        starts,
        count,
        known_samples,
        samples,
        around,
        mode,
        first_mode,
        shared_mode,
        each_mode,
        sky_mode,
        sphere,
        cylinder,
        dark,
        lit,
        levels,
        neighbours,
        same_turn,
        flatness,
        least_count,
        sharp,
        least_spread,
        steep,
        tile,
        out_irradiance,
        out_share,
    )


def irradiance(
    mesh: wp.uint64,
    lights: DirectView,
    cast: list[wp.array],
    starts: Starts,
    count: int,
    samples: tuple[int, int, int],
    around: Neighbours,
    out_irradiance: wp.array,
    threads: int = 0,
) -> None:
    """As `shadow_lists.irradiance`, whose kernels send rays of single points.

    Args:
        mesh: `bvh.Tracer.packets` of what casts shadows.
        lights: Distant ones and shapes.
        cast: Which of either cast shadows.
        starts: From `shadow_starts.starts_of`.
        count: Points.
        samples: Rays to a shape that are always sent, those that neighbours share (0: they share nothing), and all of them.
        around: From `shadow_neighbours.neighbours_of`.
        out_irradiance: vec3 [count].
        threads: CPU threads; 0: one per core.
    """
    device = out_irradiance.device
    first, shared, whole = samples
    none = compact.none(float, device)
    passes = [(ALL, shared, whole)]
    if len(around.found):
        passes = [(FIRST, 0, first), *([(SHARED, first, shared)] if shared else []), *passes]
    for mode, known, sent in passes:
        inputs = [mesh, lights, *cast, starts, count, known, sent, around, mode, *CODES]
        _launch(_block_count(count, around), [*inputs, out_irradiance, none], device, threads)


def shares(
    mesh: wp.uint64, lights: DirectView, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0
) -> None:
    """As `shadows.light_shares_kernel`."""
    device = out_share.device
    cast = [wp.full(len(kind), 1, dtype=int, device=device) for kind in (lights.distant, lights.areas)]
    inputs = [mesh, lights, *cast, starts, count, 0, samples, Neighbours(), EACH, *CODES]
    _launch(vector.block_count(count), [*inputs, compact.none(wp.vec3, device), out_share], device, threads)


def sky_share(mesh: wp.uint64, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0) -> None:
    """As `shadows.sky_share_kernel`."""
    device = out_share.device
    none = compact.none(int, device)
    inputs = [mesh, DirectView(), none, none, starts, count, 0, samples, Neighbours(), SKY, *CODES]
    _launch(vector.block_count(count), [*inputs, compact.none(wp.vec3, device), out_share], device, threads)


def _block_count(count: int, around: Neighbours) -> int:
    """Blocks of points: the tiles of a picture of whole ones, wherever points lie in it."""
    listed = len(around.pixel) if around.width else 0
    pixels = len(around.index) if listed else count
    rows = pixels // around.width if around.width else 0
    if rows and around.width % TILE == 0 and rows % (TILE // 2) == 0 and pixels == rows * around.width:
        return pixels // vector.BLOCK
    return vector.block_count(count)


def _launch(blocks: int, inputs: list, device, threads: int) -> None:
    # Blocks of rays are worth a second thread sooner than `vector.launch_blocks` thinks.
    launch(send_blocks_kernel, blocks, inputs, device, threads, split_min=BLOCK_SPLIT_MIN)
