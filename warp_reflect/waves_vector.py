"""`waves.wave_normals_kernel` for a block of pixels at a time: the same formulas in the same order, but for the exponential."""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.waves import Wave

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(
        r"""
    const int count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const bool parallel = camera.orthographic != 0;
    const V eye = spread(camera.eye), forward = spread(camera.forward);
    float* normals = (float*)out_normals.data;
    // 2^x for -20 < x <= 0: the whole part into the exponent, Taylor's polynomial for what is left, to 2e-7.
    auto power = [](F x) -> F {
        const F whole = __builtin_elementwise_floor(x + 0.5f);
        const F t = 0.693147181f * (x - whole);
        F sum = t * (1.0f / 720.0f) + (1.0f / 120.0f);
        sum = t * sum + (1.0f / 24.0f);
        sum = t * sum + (1.0f / 6.0f);
        sum = t * (t * (t * sum + 0.5f) + 1.0f) + 1.0f;
        return sum * __builtin_bit_cast(F, (__builtin_convertvector(whole, I) + 127) << 23);
    };
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        const bool full = start + LANES <= end;
        const I at = igather(pixel.data, own);
        const I tri = igather(triangle.data, at);
        V p0, p1, p2;
        corners(records.data, tri, p0, p1, p2);
        const V outward = facet_normal(p0, p1, p2);
        const I row = at / camera.width;
        const F x = __builtin_convertvector(at - row * camera.width, F) + 0.5f;
        const F y = __builtin_convertvector(row, F) + 0.5f;
        const V plane = add(add(spread(camera.ray_corner), times(x, spread(camera.ray_dx))), times(y, spread(camera.ray_dy)));
        const V d = parallel ? forward : plane;
        const F facing = dot(outward, d);
        const V p = vrows((const float*)point.data, start, full, own);
        const V n = vrows((const float*)normal.data, start, full, own);
        const F depth = parallel ? F(1.0f) : dot(forward, sub(p, eye));
        V step_x = times(depth, spread(camera.ray_dx)), step_y = times(depth, spread(camera.ray_dy));
        step_x = sub(step_x, times(dot(outward, step_x) / facing, d));
        step_y = sub(step_y, times(dot(outward, step_y) / facing, d));
        V tilt = same(0.0f);
        for (int j = 0; j < waves.shape[0]; ++j) {
            const auto& wave = waves.data[j];
            const V way = spread(wave.way);
            const F along_x = dot(way, step_x), along_y = dot(way, step_y);
            const F unseen = box_exponent * wave.turns * wave.turns * (along_x * along_x + along_y * along_y);
            const I there = unseen < least_seen;
            if (!bits(there)) continue;
            // waves.turn_sine
            const F turns = wave.turns * dot(way, p) + wave.phase;
            F t = turns - __builtin_elementwise_floor(turns + 0.5f);
            t = pick(__builtin_elementwise_abs(t) > 0.25f, pick(t < 0.0f, F(-0.5f), F(0.5f)) - t, t);
            const F square = t * t;
            F slope = wave.slope * (t * (sine_1 + square * (sine_3 + square * sine_5)));
            const I partly = there & (unseen > most_seen);
            if (bits(partly)) slope = pick(partly, slope * power(-1.44269504f * fmin(unseen, F(least_seen))), slope);
            tilt = add(tilt, times(pick(there, slope, F(0.0f)), way));
        }
        tilt = times(pick(facing > 0.0f, F(-1.0f), F(1.0f)), tilt);
        V mapped = vgather(normals, at);
        mapped = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
        const F rise = fmax(dot(mapped, n), F(least_facing));
        V turned = unit(sub(V{mapped.x / rise, mapped.y / rise, mapped.z / rise}, tilt));
        const V incident = unit(d);
        const F toward = -dot(turned, incident);
        const I averted = toward < least_facing;
        if (bits(averted))
            turned = vpick(averted, unit(add(turned, times(toward - least_facing, incident))), turned);
        for (unsigned left = bits(valid & (facing != 0.0f)); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            float* to = normals + 3 * at[l];
            to[0] = turned.x[l]; to[1] = turned.y[l]; to[2] = turned.z[l];
        }
    }
"""
    )
)
def wave_block(
    block: int,
    records: wp.array(dtype=float),
    least_facing: float,
    least_seen: float,
    most_seen: float,
    box_exponent: float,
    sine_1: float,
    sine_3: float,
    sine_5: float,
    camera: CameraView,
    waves: wp.array(dtype=Wave),
    triangle: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    out_normals: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def wave_blocks_kernel(
    first: int,
    records: wp.array(dtype=float),
    least_facing: float,
    least_seen: float,
    most_seen: float,
    box_exponent: float,
    sine_1: float,
    sine_3: float,
    sine_5: float,
    camera: wp.array(dtype=CameraView),
    waves: wp.array(dtype=Wave),
    triangle: wp.array(dtype=int),
    # Pixels that show the waves:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    out_normals: wp.array(dtype=wp.vec3),
):
    """One thread per block of pixels."""
    wave_block(
        first + wp.tid(),
        records,
        least_facing,
        least_seen,
        most_seen,
        box_exponent,
        sine_1,
        sine_3,
        sine_5,
        camera[0],
        waves,
        triangle,
        pixel,
        point,
        normal,
        out_normals,
    )
