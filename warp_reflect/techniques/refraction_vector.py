"""`refraction_image.refract_vertices_kernel` for a block of points at a time: the same search, to the same digits."""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(
        r"""
    const int count = points.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const V n = spread(normal), eye = spread(camera.eye), plane = spread(on_plane);
    float* screen = (float*)out_screen.data;
    auto length = [&](V v) -> F { return __builtin_elementwise_sqrt(dot(v, v)); };
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const V point = vrows((const float*)points.data, start, start + LANES <= end, own);
        const V p = sub(point, eye);
        const F depth = fmax(-dot(sub(point, plane), n), F(0.0f));
        const V across = sub(p, times(dot(p, n), n));
        const F way = length(across);
        const I aside = way > 0.0f;
        F low = F(0.0f), high = way, s = way * height / (height + depth / ior);
        I searching = aside;
        for (int step = 0; step < steps && bits(searching); ++step) {
            const F rest = way - s;
            const F before = 1.0f / __builtin_elementwise_sqrt(s * s + height * height);
            const F after = 1.0f / __builtin_elementwise_sqrt(fmax(rest * rest + depth * depth, F(1.0e-30f)));
            const F f = s * before - ior * rest * after;
            low = pick(f < 0.0f, s, low);
            high = pick(f < 0.0f, high, s);
            const F slope = height * before * height * before * before + ior * depth * after * depth * after * after;
            F moved = s - f / fmax(slope, F(1.0e-30f));
            moved = pick((moved >= low) & (moved <= high), moved, 0.5f * (low + high));
            const I settled = __builtin_elementwise_abs(moved - s) <= digits * way;
            s = pick(searching, moved, s);
            searching &= ~settled;
        }
        V crossing = times(F(-height), n);
        crossing = vpick(aside, add(crossing, times(s / way, across)), crossing);
        const F before = length(crossing), behind = length(sub(p, crossing));
        const V seen = times((before + behind) / fmax(before, F(1.0e-30f)), crossing);
        // layers.project
        auto along = [&](const auto& row) -> F { return row[0] * seen.x + row[1] * seen.y + row[2] * seen.z + row[3]; };
        const F w = dot(spread(camera.forward), seen);
        const I shown = ~(w < camera.near);
        const F inverse = 1.0f / w;
        float rows[4 * LANES];
        store(rows, pick(shown, along(camera.x_row) * inverse, along(camera.x_row)));
        store(rows + LANES, pick(shown, along(camera.y_row) * inverse, along(camera.y_row)));
        store(rows + 2 * LANES, pick(shown, inverse, F(0.0f)));
        store(rows + 3 * LANES, w);
        const int whole = end - start < LANES ? end - start : LANES;
        for (int l = 0; l < whole; ++l)
            for (int k = 0; k < 4; ++k) screen[4 * (start + l) + k] = rows[k * LANES + l];
    }
"""
    )
)
def refract_block(
    block: int,
    points: wp.array(dtype=wp.vec3),
    camera: CameraView,
    on_plane: wp.vec3,
    normal: wp.vec3,
    height: float,
    ior: float,
    steps: int,
    digits: float,
    out_screen: wp.array(dtype=wp.vec4),
): ...


@wp.kernel
def refract_blocks_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    camera: wp.array(dtype=CameraView),
    on_plane: wp.vec3,
    normal: wp.vec3,
    height: float,
    ior: float,
    steps: int,
    digits: float,
    out_screen: wp.array(dtype=wp.vec4),
):
    """One thread per block of points under a plane; perspective cameras."""
    refract_block(first + wp.tid(), points, camera[0], on_plane, normal, height, ior, steps, digits, out_screen)
