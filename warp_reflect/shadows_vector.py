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


_RAYS = (
    TRAVERSAL
    + r"""
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const float* rows = starts.rows.data;
    const int stride = starts.rows.shape[1];
    auto row = [&](int r, int i) -> F { return load(rows + r * stride + i); };
    auto vrow = [&](int r, int i) -> V { return V{row(r, i), row(r + 1, i), row(r + 2, i)}; };
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
    (void)row; (void)vrow; (void)place_x; (void)place_y; (void)area_ray; (void)outside;
"""
)


@wp.func_native(
    vector.snippet(
        _RAYS
        + r"""
    const int area_count = lights.areas.shape[0];
    for (int start = begin; start < end; start += LANES) {
        const I seen = start + lanes() < end;
        for (int k = 0; k < area_count; ++k) {
            if (cast_areas.data[k] == 0) continue;
            const I asked = seen & (load(starts.unshadowed.data + k * stride + start) > 0.0f);
            if (!bits(asked)) continue;
            const auto& light = lights.areas.data[k];
            const V p = vrow(0, start), n = vrow(3, start);
            const F shift_x = row(9, start), shift_y = row(10, start);
            const I asking = asked & outside(light, p);
            F brought = F(0.0f), arrived = F(0.0f);
            for (int s = 0; s < samples; ++s) {
                const Ray ray = area_ray(light, p, n, place_x(F((float)s), shift_x), place_y(F((float)s), shift_y));
                const I sent = asking & (ray.weight > 0.0f);
                const I free = sent & ~is_met(sent, p, flushed(ray.d), ray.reach);
                brought += pick(sent, ray.weight, F(0.0f));
                arrived += pick(free, ray.weight, F(0.0f));
            }
            const F share = pick(brought == 0.0f, F(1.0f), arrived / brought);
            const I found = ipick(share == 1.0f, I(lit), ipick(share == 0.0f, I(dark), I(lit | dark)));
            for (unsigned left = bits(asked); left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left);
                out_found.data[(start + l) * area_count + k] = (unsigned char)found[l];
            }
        }
    }
"""
    )
)
def first_rays_block(
    block: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    out_found: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def first_rays_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    # Outputs:
    out_found: wp.array(dtype=wp.uint8),
):
    """One thread per block of points."""
    block = first + wp.tid()
    first_rays_block(block, mesh_id, lights, cast_areas, starts, count, samples, sphere, cylinder, dark, lit, out_found)


@wp.func_native(
    vector.snippet(
        _RAYS
        + r"""
    const int area_count = lights.areas.shape[0], distant_count = lights.distant.shape[0];
    float sum_x[BLOCK], sum_y[BLOCK], sum_z[BLOCK];
    for (int start = begin; start < end; start += LANES) {
        const I seen = start + lanes() < end;
        const V p = vrow(0, start), n = vrow(3, start);
        V total = same(0.0f);
        for (int k = 0; k < distant_count; ++k) {
            const auto& light = lights.distant.data[k];
            const V to_light = spread(light.to_light);
            const F cosine = dot(n, to_light);
            I arrives = seen & (cosine > 0.0f);
            if (cast_distant.data[k] != 0 && bits(arrives)) {
                arrives &= ~is_met(arrives, p, flushed(to_light), F(3.0e38f));
            }
            total = vpick(arrives, add(total, times(cosine, spread(light.irradiance))), total);
        }
        store(sum_x + start - begin, total.x);
        store(sum_y + start - begin, total.y);
        store(sum_z + start - begin, total.z);
    }
    // shadows.around
    auto around = [&](int i, int k) -> int {
        const int number = pixel.shape[0] > 0 ? pixel.data[i] : i;
        const int height = index.shape[0] > 0 ? index.shape[0] / width : found.shape[0] / (width * area_count);
        const int row_ = number / width, column = number - row_ * width;
        int together = 0;
        for (int y = row_ - neighbours; y <= row_ + neighbours; ++y) {
            if (y < 0 || y >= height) continue;
            for (int x = column - neighbours; x <= column + neighbours; ++x) {
                if (x < 0 || x >= width) continue;
                int at = y * width + x;
                if (index.shape[0] > 0) at = index.data[at];
                if (at >= 0) together |= found.data[at * area_count + k];
            }
        }
        return together;
    };
    for (int k = 0; k < area_count; ++k) {
        const auto& light = lights.areas.data[k];
        const float* unshadowed = starts.unshadowed.data + k * stride + begin;
        float share[BLOCK], brought[BLOCK], arrived[BLOCK];
        int asking[BLOCK];
        int asking_count = 0;
        for (int j = 0; j < end - begin; ++j) {
            share[j] = 1.0f;
            if (!(unshadowed[j] > 0.0f) || cast_areas.data[k] == 0) continue;
            const int together = around(begin + j, k);
            if (together == (lit | dark)) {
                brought[j] = arrived[j] = 0.0f;
                asking[asking_count++] = j;
            } else if (together == dark) {
                share[j] = 0.0f;
            }
        }
        // Rays of a point lie side by side: they start at the same place.
        int point = 0, sample = 0;
        while (point < asking_count) {
            int of[LANES], which[LANES], used = 0;
            for (; used < LANES && point < asking_count; ++used) {
                of[used] = asking[point];
                which[used] = sample;
                if (++sample == samples) { sample = 0; ++point; }
            }
            const bool alone = of[0] == of[used - 1];
            for (int l = used; l < LANES; ++l) { of[l] = of[0]; which[l] = which[0]; }
            const I own = iload(of);
            const F s = __builtin_convertvector(iload(which), F);
            V p, n;
            F shift_x, shift_y;
            if (alone) {
                const float* from = rows + begin + of[0];
                p = V{F(from[0]), F(from[stride]), F(from[2 * stride])};
                n = V{F(from[3 * stride]), F(from[4 * stride]), F(from[5 * stride])};
                shift_x = F(from[9 * stride]);
                shift_y = F(from[10 * stride]);
            } else {
                auto pull = [&](int r) -> F { return gather(rows + r * stride + begin, own); };
                p = V{pull(0), pull(1), pull(2)};
                n = V{pull(3), pull(4), pull(5)};
                shift_x = pull(9);
                shift_y = pull(10);
            }
            const Ray ray = area_ray(light, p, n, place_x(s, shift_x), place_y(s, shift_y));
            const I sent = (lanes() < used) & outside(light, p) & (ray.weight > 0.0f);
            const unsigned free = bits(sent & ~is_met(sent, p, flushed(ray.d), ray.reach));
            for (unsigned left = bits(sent); left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left);
                brought[of[l]] += ray.weight[l];
                if (free >> l & 1) arrived[of[l]] += ray.weight[l];
            }
        }
        for (int a = 0; a < asking_count; ++a) {
            const int j = asking[a];
            if (brought[j] != 0.0f) share[j] = arrived[j] / brought[j];
        }
        for (int j = 0; j < end - begin; ++j) {
            if (!(unshadowed[j] > 0.0f)) continue;
            const float arrives = unshadowed[j] * share[j];
            sum_x[j] += arrives * light.radiance[0];
            sum_y[j] += arrives * light.radiance[1];
            sum_z[j] += arrives * light.radiance[2];
        }
    }
    for (int j = 0; j < end - begin; ++j) {
        float* to = (float*)(out_irradiance.data + begin + j);
        to[0] = sum_x[j]; to[1] = sum_y[j]; to[2] = sum_z[j];
    }
"""
    )
)
def shadowed_block(
    block: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    neighbours: int,
    pixel: wp.array(dtype=int),
    width: int,
    found: wp.array(dtype=wp.uint8),
    index: wp.array(dtype=int),
    out_irradiance: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def shadowed_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    dark: int,
    lit: int,
    neighbours: int,
    pixel: wp.array(dtype=int),
    width: int,
    found: wp.array(dtype=wp.uint8),
    index: wp.array(dtype=int),
    # Outputs:
    out_irradiance: wp.array(dtype=wp.vec3),
):
    """One thread per block of points."""
    shadowed_block(
        first + wp.tid(),
        mesh_id,
        lights,
        cast_distant,
        cast_areas,
        starts,
        count,
        samples,
        sphere,
        cylinder,
        dark,
        lit,
        neighbours,
        pixel,
        width,
        found,
        index,
        out_irradiance,
    )


@wp.func_native(
    vector.snippet(
        _RAYS
        + r"""
    for (int start = begin; start < end; start += LANES) {
        const V p = vrow(0, start), n = vrow(3, start), side = vrow(6, start);
        const F shift_x = row(9, start), shift_y = row(10, start);
        const I seen = (start + lanes() < end) & (dot(n, n) > 0.0f);
        V t1, t2;
        basis(n, t1, t2);
        F free = F(0.0f), asked = F(0.0f);
        for (int s = 0; s < samples; ++s) {
            const F x = place_x(F((float)s), shift_x), radius = root(x);
            F cosine, sine;
            turn(place_y(F((float)s), shift_y), cosine, sine);
            const V d = add(times(radius, add(times(cosine, t1), times(sine, t2))), times(root(fmax(1.0f - x, F(0.0f))), n));
            const I sent = seen & (dot(d, side) > 0.0f);
            asked += pick(sent, F(1.0f), F(0.0f));
            free += pick(sent & ~is_met(sent, p, flushed(d), F(3.0e38f)), F(1.0f), F(0.0f));
        }
        const F share = free / asked;
        for (unsigned left = bits(asked > 0.0f); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            out_share.data[start + l] = share[l];
        }
    }
"""
    )
)
def sky_block(
    block: int,
    mesh_id: wp.uint64,
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    out_share: wp.array(dtype=float),
): ...


@wp.kernel
def sky_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    starts: Starts,
    count: int,
    samples: int,
    sphere: int,
    cylinder: int,
    # Outputs:
    out_share: wp.array(dtype=float),
):
    """One thread per block of points."""
    sky_block(first + wp.tid(), mesh_id, starts, count, samples, sphere, cylinder, out_share)


def starts_of(inputs: list, count: int, area_count: int, device, threads: int = 0) -> Starts:
    """Where the shadow rays of points start, of `starts_kernel`'s inputs."""
    starts = Starts()
    padded = vector.BLOCK * vector.block_count(count)
    starts.rows = wp.empty((ROWS, padded), dtype=float, device=device)
    starts.unshadowed = wp.empty((area_count, padded), dtype=float, device=device)
    # Read by the lanes that the last vector has left, which do nothing.
    for rows in (starts.rows, starts.unshadowed):
        if rows.shape[0] and count < padded:
            rows[:, count:].zero_()
    launch(starts_kernel, count, [*inputs, starts], device, threads)
    return starts


def send_first(
    mesh: wp.uint64,
    lights: DirectView,
    cast_areas: wp.array,
    starts: Starts,
    count: int,
    samples: int,
    out_found: wp.array,
    threads: int = 0,
) -> None:
    """As `shadows.first_rays_kernel`."""
    inputs = [mesh, lights, cast_areas, starts, count, samples, SPHERE, CYLINDER, DARK, LIT, out_found]
    _launch(first_rays_blocks_kernel, count, inputs, out_found.device, threads)


def send_all(
    mesh: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array,
    cast_areas: wp.array,
    starts: Starts,
    count: int,
    samples: int,
    around: list,
    out_irradiance: wp.array,
    threads: int = 0,
) -> None:
    """As `shadows.shadowed_kernel`; `around`: pixels, width, what `send_first` found, and `shadows.image_index_kernel`'s."""
    kinds = [SPHERE, CYLINDER, DARK, LIT, NEIGHBOURS]
    inputs = [mesh, lights, cast_distant, cast_areas, starts, count, samples, *kinds, *around, out_irradiance]
    _launch(shadowed_blocks_kernel, count, inputs, out_irradiance.device, threads)


def send_to_sky(
    mesh: wp.uint64, starts: Starts, count: int, samples: int, out_share: wp.array, threads: int = 0
) -> None:
    """As `shadows.sky_share_kernel`."""
    inputs = [mesh, starts, count, samples, SPHERE, CYLINDER, out_share]
    _launch(sky_blocks_kernel, count, inputs, out_share.device, threads)


def _launch(kernel, count: int, inputs: list, device, threads: int) -> None:
    # Blocks of rays are worth a second thread sooner than `vector.launch_blocks` thinks.
    launch(kernel, vector.block_count(count), inputs, device, threads, split_min=BLOCK_SPLIT_MIN)
