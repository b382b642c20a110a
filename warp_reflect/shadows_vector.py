"""`shadows.first_rays_kernel`, `shadows.shadowed_kernel` and `shadows.sky_share_kernel` for a block of points at a time.

The same rays, to the last bit, in packets (`packets.py`): those of neighbouring points towards the same sample, or a point's
own samples. Where the points' rays start is found first, by the plain functions.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.direct import CYLINDER, SPHERE, DirectView, area_irradiance
from warp_reflect.launch import FINITE_FLAGS, launch
from warp_reflect.packets import TRAVERSAL
from warp_reflect.scene import SceneView
from warp_reflect.shadows import DARK, LIT, NEIGHBOURS, ray_start, sample_place, sample_shift

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

ROWS = 11  # of `Starts.rows`: point, normal, facet's normal, shift of the samples
BLOCK_SPLIT_MIN = 8  # blocks; what `bvh.TRACE_SPLIT_MIN` rays are
# What `send_blocks_kernel` does.
FIRST, ALL, EACH, SKY = 0, 1, 2, 3
CODES = [FIRST, EACH, SKY, SPHERE, CYLINDER, DARK, LIT, NEIGHBOURS]


@wp.struct
class Starts:
    """`shadows.RayStart` of points, and what else their rays need; a row a component, of at least whole blocks."""

    rows: wp.array2d(dtype=float)
    unshadowed: wp.array2d(dtype=float)  # by each shape, 0 where nothing is seen


@wp.kernel
def starts_kernel(
    first: int,
    scene: SceneView,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    out_start: Starts,
):
    """One thread per point; `width` 0: points of no image."""
    i = first + wp.tid()
    areas = out_start.unshadowed.shape[0]
    if triangle[i] < 0:
        for row in range(ROWS):
            out_start.rows[row, i] = 0.0
        for k in range(areas):
            out_start.unshadowed[k, i] = 0.0
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    shift = sample_place(i, wp.vec2(0.0, 0.0))
    if width > 0:
        shift = sample_shift(pixel, i, width)
    for k in range(3):
        out_start.rows[k, i] = start.p[k]
        out_start.rows[3 + k, i] = start.n[k]
        out_start.rows[6 + k, i] = start.side[k]
    out_start.rows[9, i] = shift[0]
    out_start.rows[10, i] = shift[1]
    for k in range(areas):
        out_start.unshadowed[k, i] = area_irradiance(lights.areas[k], start.at, start.n)


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
    float sum_x[BLOCK], sum_y[BLOCK], sum_z[BLOCK], share[BLOCK], brought[BLOCK], arrived[BLOCK], before[BLOCK];
    int asking[BLOCK];
    for (int j = 0; j < BLOCK; ++j) sum_x[j] = sum_y[j] = sum_z[j] = 0.0f;
    // shadows.around
    auto around = [&](int i, int k) -> int {
        const int number = pixel.shape[0] > 0 ? pixel.data[i] : i;
        const int height = index.shape[0] > 0 ? index.shape[0] / width : out_found.shape[0] / (width * area_count);
        const int row = number / width, column = number - row * width;
        int together = 0;
        for (int y = row - neighbours; y <= row + neighbours; ++y) {
            if (y < 0 || y >= height) continue;
            for (int x = column - neighbours; x <= column + neighbours; ++x) {
                if (x < 0 || x >= width) continue;
                int at = y * width + x;
                if (index.shape[0] > 0) at = index.data[at];
                if (at >= 0) together |= out_found.data[at * area_count + k];
            }
        }
        return together;
    };
    for (int light = to_sky ? SKY : only_first ? distant_count : 0; light < (to_sky ? 0 : distant_count + area_count); ++light) {
        const bool distant = light >= 0 && light < distant_count;
        const int k = light - distant_count;
        const int ray_count = distant ? 1 : samples;
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
                if (asks && !only_first && !each) {
                    const int together = around(begin + j, k);
                    asks = together == (lit | dark);
                    if (together == dark) share[j] = 0.0f;
                }
            }
            if (!asks) continue;
            brought[j] = arrived[j] = 0.0f;
            asking[asking_count++] = j;
        }
        // Rays of a point lie side by side: they start at the same place.
        int point = 0, sample = 0;
        while (point < asking_count) {
            int of[2 * LANES], which[2 * LANES], used = 0;
            for (; used < 2 * LANES && point < asking_count; ++used) {
                of[used] = asking[point];
                which[used] = sample;
                if (++sample == ray_count) { sample = 0; ++point; }
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
            if (only_first) {
                const int found = share[j] == 1.0f ? lit : share[j] == 0.0f ? dark : lit | dark;
                out_found.data[(begin + j) * area_count + k] = (unsigned char)found;
            }
        }
        for (int j = 0; each && j < end - begin; ++j) {
            const float* n = rows + 3 * stride + begin + j;
            if (n[0] == 0.0f && n[stride] == 0.0f && n[2 * stride] == 0.0f) continue;
            out_share.data[(begin + j) * (distant_count + area_count) + light] = share[j];
        }
        if (to_sky || only_first || each) continue;
        const auto& color = distant ? lights.distant.data[light].irradiance : lights.areas.data[k].radiance;
        for (int j = 0; j < end - begin; ++j) {
            if (!(before[j] > 0.0f)) continue;
            const float arrives = before[j] * share[j];
            sum_x[j] += arrives * color[0];
            sum_y[j] += arrives * color[1];
            sum_z[j] += arrives * color[2];
        }
    }
    if (to_sky || only_first || each) return;
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
    samples: int,
    pixel: wp.array(dtype=int),
    width: int,
    index: wp.array(dtype=int),
    mode: int,
    first_mode: int,
    each_mode: int,
    sky_mode: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    neighbours: int,
    out_found: wp.array(dtype=wp.uint8),
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
    samples: int,
    pixel: wp.array(dtype=int),
    width: int,
    index: wp.array(dtype=int),
    mode: int,
    first_mode: int,
    each_mode: int,
    sky_mode: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    neighbours: int,
    # Outputs:
    out_found: wp.array(dtype=wp.uint8),
    out_irradiance: wp.array(dtype=wp.vec3),
    out_share: wp.array(dtype=float),
):
    """One thread per block of points; mode: `FIRST` rays, `ALL` that are worth it, `EACH` light apart, or to the `SKY`."""
    send_block(
        first + wp.tid(),
        mesh_id,
        lights,
        cast_distant,
        cast_areas,
        starts,
        count,
        samples,
        pixel,
        width,
        index,
        mode,
        first_mode,
        each_mode,
        sky_mode,
        sphere,
        cylinder,
        dark,
        lit,
        neighbours,
        out_found,
        out_irradiance,
        out_share,
    )


def starts_of(inputs: list, count: int, area_count: int, device, threads: int = 0) -> Starts:
    """Where the shadow rays of points start, of `starts_kernel`'s inputs."""
    starts = Starts()
    padded = vector.BLOCK * vector.block_count(count)
    starts.rows = wp.empty((ROWS, padded), dtype=float, device=device)
    starts.unshadowed = wp.empty((area_count, padded), dtype=float, device=device)
    launch(starts_kernel, count, [*inputs, starts], device, threads)
    return starts


def irradiance(
    mesh: wp.uint64,
    lights: DirectView,
    cast: list[wp.array],
    starts: Starts,
    count: int,
    samples: tuple[int, int],
    image: list,
    out_irradiance: wp.array,
    threads: int = 0,
) -> None:
    """As `shadows.first_rays_kernel` and `shadows.shadowed_kernel`.

    Args:
        mesh: What casts shadows.
        lights: Distant ones and shapes.
        cast: Which of either cast shadows.
        starts: From `starts_of`.
        count: Points.
        samples: Rays to a shape that are always sent, and all of them.
        image: The points' pixels, the image's width, and from `shadows.image_index_kernel` where its pixels are.
        out_irradiance: vec3 [count].
        threads: CPU threads; 0: one per core.
    """
    device = out_irradiance.device
    asked = len(cast[1]) if cast[1].numpy().any() else 0
    found = wp.zeros(count * asked, dtype=wp.uint8, device=device)
    none = wp.zeros(0, dtype=float, device=device)
    for mode in (FIRST, ALL) if asked else (ALL,):
        inputs = [mesh, lights, *cast, starts, count, samples[mode == ALL], *image, mode, *CODES]
        _launch(count, [*inputs, found, out_irradiance, none], device, threads)


def shares(
    mesh: wp.uint64, lights: DirectView, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0
) -> None:
    """The last output of `shadows.light_shares_kernel`."""
    device = out_share.device
    none, no_points = wp.zeros(0, dtype=int, device=device), wp.zeros(0, dtype=wp.vec3, device=device)
    cast = [wp.full(len(kind), 1, dtype=int, device=device) for kind in (lights.distant, lights.areas)]
    inputs = [mesh, lights, *cast, starts, count, samples, none, 0, none, EACH, *CODES]
    _launch(count, [*inputs, wp.zeros(0, dtype=wp.uint8, device=device), no_points, out_share], device, threads)


def sky_share(mesh: wp.uint64, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0) -> None:
    """As `shadows.sky_share_kernel`."""
    device = out_share.device
    none = wp.zeros(0, dtype=int, device=device)
    outputs = [wp.zeros(0, dtype=kind, device=device) for kind in (wp.uint8, wp.vec3)]
    inputs = [mesh, DirectView(), none, none, starts, count, samples, none, 0, none, SKY, *CODES]
    _launch(count, [*inputs, *outputs, out_share], device, threads)


def _launch(count: int, inputs: list, device, threads: int) -> None:
    # Blocks of rays are worth a second thread sooner than `vector.launch_blocks` thinks.
    launch(send_blocks_kernel, vector.block_count(count), inputs, device, threads, split_min=BLOCK_SPLIT_MIN)
