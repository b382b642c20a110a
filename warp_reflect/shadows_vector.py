"""The rays of `shadows.py`'s kernels for a block of points at a time.

The same rays, to the last bit, in packets (`wide_packets.py`): those of neighbouring points towards the same sample, or a point's
own samples.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import compact, vector
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
from warp_reflect.wide_packets import TRAVERSAL

wp.set_module_options({"enable_backward": False})

BLOCK_SPLIT_MIN = 8  # blocks; what `bvh.TRACE_SPLIT_MIN` rays are
# What `send_blocks_kernel` does.
FIRST, SHARED, ALL, EACH, SKY = 0, 1, 2, 3, 4
CODES = [FIRST, SHARED, EACH, SKY, SPHERE, CYLINDER, DARK, LIT, LEVELS, NEIGHBOURS]
CODES += [SAME_TURN, FLATNESS, LEAST_COUNT, SHARP, LEAST_SPREAD, STEEP]


@wp.func_native(
    vector.snippet(
        TRAVERSAL
        + r"""
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const float* rows = starts.rows.data;
    const int stride = starts.rows.shape[1];
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
    // A light: a distant one, else a shape, or the sky.
    constexpr int SKY = -1;
    const int area_count = lights.areas.shape[0], distant_count = lights.distant.shape[0];
    const bool to_sky = mode == sky_mode, only_first = mode == first_mode, each = mode == each_mode;
    const bool sharing = mode == shared_mode, to_all = !to_sky && !only_first && !each && !sharing;
    float sum_x[BLOCK], sum_y[BLOCK], sum_z[BLOCK], share[BLOCK], known[BLOCK], brought[BLOCK], arrived[BLOCK], before[BLOCK];
    int asking[BLOCK];
    for (int j = 0; j < BLOCK; ++j) sum_x[j] = sum_y[j] = sum_z[j] = 0.0f;
    // shadow_neighbours.place_of, found_around, shared_share
    const int line = around.width + 2 * neighbours;
    int number[BLOCK], place[BLOCK];
    for (int j = 0; (sharing || to_all || only_first) && j < end - begin; ++j) {
        number[j] = around.pixel.shape[0] > 0 ? around.pixel.data[begin + j] : begin + j;
        place[j] = number[j] + 2 * neighbours * (number[j] / around.width) + neighbours * line + neighbours;
    }
    auto found_around = [&](const unsigned char* found, int at) -> int {
        unsigned long long together = 0;
        for (int y = -neighbours; y <= neighbours; ++y) {
            unsigned long long row;
            __builtin_memcpy(&row, found + at + y * line - neighbours, sizeof(row));
            together |= row;
        }
        together &= (1ull << (8 * (2 * neighbours + 1))) - 1;
        together |= together >> 32;
        together |= together >> 16;
        together |= together >> 8;
        return (int)(together & (dark | lit));
    };
    // Of points `own` of the block, as many as there are.
    auto shared_shares = [&](const unsigned char* shared, const float* unshadowed, const int* own, int asks, float* out) {
        for (int from = 0; from < asks; from += LANES) {
            int here[LANES], pixel[LANES], entry_at[LANES], other[LANES];
            bool in_fours = true;
            for (int l = 0; l < LANES; ++l) {
                const int j = own[from + l < asks ? from + l : asks - 1];
                here[l] = begin + j;
                pixel[l] = number[j];
                entry_at[l] = place[j];
                in_fours &= (l & 3) == 0 || (pixel[l] - pixel[l - 1] == 1);
            }
            // Four pixels beside each other are mostly four points after one another.
            auto pull = [&](const float* of, const int* index, bool fours) -> F {
                F v;
                if (fours) {
                    Four part[LANES / 4];
                    for (int h = 0; h < LANES / 4; ++h) __builtin_memcpy(&part[h], of + index[4 * h], sizeof(Four));
#if defined(__AVX512F__)
                    const auto low = __builtin_shufflevector(part[0], part[1], 0, 1, 2, 3, 4, 5, 6, 7);
                    const auto high = __builtin_shufflevector(part[2], part[3], 0, 1, 2, 3, 4, 5, 6, 7);
                    v = __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
#else
                    v = __builtin_shufflevector(part[0], part[1], 0, 1, 2, 3, 4, 5, 6, 7);
#endif
                } else {
                    EACH_LANE v[l] = of[index[l]];
                }
                return v;
            };
            const V p = V{pull(rows, here, false), pull(rows + stride, here, false), pull(rows + 2 * stride, here, false)};
            const V side = V{pull(rows + 6 * stride, here, false), pull(rows + 7 * stride, here, false),
                pull(rows + 8 * stride, here, false)};
            I known = I(0), total = I(0), squares = I(0);
            I sum_x = I(0), sum_y = I(0), square_x = I(0), along_x = I(0), along_y = I(0);
            F brought = F(0.0f), arrived = F(0.0f);
            for (int y = -neighbours; y <= neighbours; ++y) {
                for (int x = -neighbours; x <= neighbours; ++x) {
                    const int step = y * around.width + x, entry_step = y * line + x;
                    I entry;
                    EACH_LANE entry[l] = shared[entry_at[l] + entry_step];
                    const I there = entry != 0;
                    if (!bits(there)) continue;
                    bool fours = in_fours;
                    for (int l = 0; l < LANES; ++l) {
                        int i = pixel[l] + step;
                        if (around.index.shape[0] > 0 && there[l]) i = around.index.data[i];
                        other[l] = there[l] ? i : -1;
                    }
                    for (int l = 0; l < LANES; ++l) fours &= other[l] >= 0 && other[l] - other[l & ~3] == (l & 3);
                    if (!fours) for (int l = 0; l < LANES; ++l) other[l] = other[l] < 0 ? here[l] : other[l];
                    auto row = [&](int r) -> F { return pull(rows + r * stride, other, fours); };
                    const V away = sub(V{row(0), row(1), row(2)}, p);
                    const F beside = dot(side, away);
                    const F turned = dot(side, V{row(6), row(7), row(8)});
                    const I near = there & (beside * beside <= flatness * flatness * dot(away, away)) & (turned >= same_turn);
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
                    const F brings = pull(unshadowed, other, fours);
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
            float mean[LANES];
            store(mean, pick(asks_itself, F(-1.0f), arrived / ((float)levels * brought)));
            for (int l = 0; l < LANES && from + l < asks; ++l) out[from + l] = mean[l];
        }
    };
    const int first_light = to_sky ? SKY : only_first || sharing ? distant_count : 0;
    const int last_light = to_sky ? SKY : distant_count + area_count - 1;
    for (int light = first_light; light <= last_light; ++light) {
        const bool distant = light >= 0 && light < distant_count;
        const int k = light - distant_count;
        const int known_count = distant ? 0 : known_samples, ray_count = distant ? 1 : samples;
        const long pictured = light < distant_count ? 0 : k * (long)around.found.shape[1];
        unsigned char* found = around.found.data + pictured;
        unsigned char* shared = around.shared.data + pictured;
        // What would arrive unshadowed, `before`, and which points have to ask.
        int asking_count = 0;
        for (int j = 0; j < end - begin; ++j) {
            const float* from = rows + begin + j;
            const float n_x = from[3 * stride], n_y = from[4 * stride], n_z = from[5 * stride];
            share[j] = 1.0f;
            bool asks;
            if (to_sky) {
                asks = n_x != 0.0f || n_y != 0.0f || n_z != 0.0f;
            } else if (distant) {
                const auto& to_light = lights.distant.data[light].to_light;
                before[j] = n_x * to_light[0] + n_y * to_light[1] + n_z * to_light[2];
                asks = before[j] > 0.0f && cast_distant.data[light] != 0;
            } else {
                before[j] = starts.unshadowed.data[k * stride + begin + j];
                asks = before[j] > 0.0f && cast_areas.data[k] != 0;
                if (asks && sharing) {
                    const int entry = found[place[j]];
                    asks = found_around(found, place[j]) == (lit | dark);
                    known[j] = (float)(entry >> 2) / (float)levels;
                    if (!asks) shared[place[j]] = (unsigned char)entry;
                } else if (asks && to_all) {
                    const int entry = known_count > 0 ? shared[place[j]] : found_around(found, place[j]);
                    const int together = entry & (lit | dark);
                    asks = together == (lit | dark);
                    if (together == dark) share[j] = 0.0f;
                    known[j] = (float)(entry >> 2) / (float)levels;
                }
            }
            if (!asks) continue;
            brought[j] = arrived[j] = 0.0f;
            asking[asking_count++] = j;
        }
        if (to_all && !distant && known_count > 0 && asking_count > 0) {
            float mean[BLOCK];
            shared_shares(shared, starts.unshadowed.data + k * stride, asking, asking_count, mean);
            int left = 0;
            for (int a = 0; a < asking_count; ++a) {
                const int j = asking[a];
                if (mean[a] < 0.0f) asking[left++] = j;
                else share[j] = mean[a];
            }
            asking_count = left;
        }
        // Rays of a point lie side by side: they start at the same place.
        int point = 0, sample = known_count;
        while (point < asking_count && known_count < ray_count) {
            int of[2 * LANES], which[2 * LANES], used = 0;
            for (; used < 2 * LANES && point < asking_count; ++used) {
                of[used] = asking[point];
                which[used] = sample;
                if (++sample == ray_count) { sample = known_count; ++point; }
            }
            for (int l = used; l < 2 * LANES; ++l) { of[l] = of[used - 1]; which[l] = which[used - 1]; }
            V p[2], d[2];
            F weight[2], reach[2];
            I sent[2], met[2];
            for (int g = 0; g < 2; ++g) {
                const I own = iload(of + g * LANES);
                const F s = __builtin_convertvector(iload(which + g * LANES), F);
                const bool alone = of[g * LANES] == of[(g + 1) * LANES - 1];
                auto pull = [&](int r) -> F {
                    const float* from = rows + r * stride + begin;
                    return alone ? F(from[of[g * LANES]]) : gather(from, own);
                };
                p[g] = V{pull(0), pull(1), pull(2)};
                sent[g] = g * LANES + lanes() < used;
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
                    d[g] = add(times(root(x), add(times(cosine, t1), times(sine, t2))), times(root(fmax(1.0f - x, F(0.0f))), n));
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
            is_met_by(sent, p, d, reach, met);
            for (int g = 0; g < 2; ++g) {
                const unsigned free = bits(sent[g] & ~met[g]);
                for (unsigned left = bits(sent[g]); left != 0; left &= left - 1) {
                    const int l = __builtin_ctz(left), j = of[g * LANES + l];
                    brought[j] += weight[g][l];
                    if (free >> l & 1) arrived[j] += weight[g][l];
                }
            }
        }
        for (int a = 0; a < asking_count; ++a) {
            const int j = asking[a];
            if (brought[j] != 0.0f) share[j] = arrived[j] / brought[j];
            if (to_sky && brought[j] != 0.0f) out_share.data[begin + j] = share[j];
            if (known_count > 0)
                share[j] = ((float)known_count * known[j] + (float)(ray_count - known_count) * share[j]) / (float)ray_count;
            if (only_first || sharing) {
                const int code = share[j] == 1.0f ? lit : share[j] == 0.0f ? dark : lit | dark;
                const int entry = code | (int)(share[j] * (float)levels + 0.5f) << 2;
                if (only_first) found[place[j]] = (unsigned char)entry;
                else shared[place[j]] = (unsigned char)(entry | lit | dark);
            }
        }
        for (int j = 0; each && j < end - begin; ++j) {
            const float* n = rows + 3 * stride + begin + j;
            if (n[0] == 0.0f && n[stride] == 0.0f && n[2 * stride] == 0.0f) continue;
            out_share.data[(begin + j) * (distant_count + area_count) + light] = share[j];
        }
        if (!to_all) continue;
        const auto& color = distant ? lights.distant.data[light].irradiance : lights.areas.data[k].radiance;
        for (int j = 0; j < end - begin; ++j) {
            if (!(before[j] > 0.0f)) continue;
            const float arrives = before[j] * share[j];
            sum_x[j] += arrives * color[0];
            sum_y[j] += arrives * color[1];
            sum_z[j] += arrives * color[2];
        }
    }
    if (!to_all) return;
    for (int j = 0; j < end - begin; ++j) {
        float* to = (float*)(out_irradiance.data + begin + j);
        to[0] = sum_x[j]; to[1] = sum_y[j]; to[2] = sum_z[j];
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
    """As `shadows.first_rays_kernel`, `shadows.shared_rays_kernel` and `shadows.shadowed_kernel`.

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
        _launch(count, [*inputs, out_irradiance, none], device, threads)


def shares(
    mesh: wp.uint64, lights: DirectView, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0
) -> None:
    """As `shadows.light_shares_kernel`."""
    device = out_share.device
    cast = [wp.full(len(kind), 1, dtype=int, device=device) for kind in (lights.distant, lights.areas)]
    inputs = [mesh, lights, *cast, starts, count, 0, samples, Neighbours(), EACH, *CODES]
    _launch(count, [*inputs, compact.none(wp.vec3, device), out_share], device, threads)


def sky_share(mesh: wp.uint64, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0) -> None:
    """As `shadows.sky_share_kernel`."""
    device = out_share.device
    none = compact.none(int, device)
    inputs = [mesh, DirectView(), none, none, starts, count, 0, samples, Neighbours(), SKY, *CODES]
    _launch(count, [*inputs, compact.none(wp.vec3, device), out_share], device, threads)


def _launch(count: int, inputs: list, device, threads: int) -> None:
    # Blocks of rays are worth a second thread sooner than `vector.launch_blocks` thinks.
    launch(send_blocks_kernel, vector.block_count(count), inputs, device, threads, split_min=BLOCK_SPLIT_MIN)
