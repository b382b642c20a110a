"""The kernels of `water` and `still_picture` for a block of pixels at a time: the same formulas in the same order.

What lanes look up lies near each other, but not in a row: two texels that stand side by side are read at once.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.finishes.still_picture import LEAST_COSINE, StillPicture
from warp_reflect.finishes.water import (
    EVEN_COVERAGE,
    LEAST_DEPTH,
    LEAST_NEARNESS,
    MIRROR_STEPS,
    REFRACTION_STEPS,
    RETREATS,
)
from warp_reflect.layers import CameraView

wp.set_module_options({"enable_backward": False})

# Of a block: which lanes there are, and how they are written.
_PIXELS = r"""
    const int count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    auto write = [&](float* to, int start, I mask, V v) {
        if (!bits(~mask)) {
            vstore(to, start, v);
            return;
        }
        for (unsigned left = bits(mask); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            float* at = to + 3 * (start + l);
            at[0] = v.x[l]; at[1] = v.y[l]; at[2] = v.z[l];
        }
    };
"""
# What both look-ups do with a place on the screen.
_PICTURE = (
    _PIXELS
    + r"""
    const float* texels = (const float*)picture.texels.data;
    const bool parallel = camera.orthographic != 0;
    const V eye = spread(camera.eye);
    auto length = [&](V v) -> F { return __builtin_elementwise_sqrt(dot(v, v)); };
    auto whole = [](F x) -> I { return __builtin_convertvector(x, I); };
    // water.seen_at
    auto seen_at = [&](V p, F own_x, F own_y, F& x, F& y) {
        auto along = [&](const auto& row) -> F { return row[0] * p.x + row[1] * p.y + row[2] * p.z + row[3]; };
        const F w = along(camera.w_row);
        const I before = w > least_depth * length(p);
        x = pick(before, along(camera.x_row) / w, own_x);
        y = pick(before, along(camera.y_row) / w, own_y);
    };
    // still_picture.nearness_at
    auto nearness_at = [&](F x, F y, F otherwise) -> F {
        const I column = whole(clip(x - (float)picture.x0, 0.0f, (float)(picture.width - 1)));
        const I row = whole(clip(y - (float)picture.y0, 0.0f, (float)(picture.height - 1)));
        const F near = gather(texels + 3, 4 * (row * picture.width + column));
        return pick(near >= 0.0f, near, otherwise);
    };
    // still_picture.look_up
    auto look_up = [&](F x, F y, F& coverage) -> V {
        const F u = clip(x - 0.5f - (float)picture.x0, 0.0f, (float)(picture.width - 1));
        const F v = clip(y - 0.5f - (float)picture.y0, 0.0f, (float)(picture.height - 1));
        I left = whole(u), top = whole(v);
        left = ipick(left > picture.width - 2, I(picture.width - 2), left);
        top = ipick(top > picture.height - 2, I(picture.height - 2), top);
        const F fx = u - __builtin_convertvector(left, F), fy = v - __builtin_convertvector(top, F);
        V found = same(0.0f);
        coverage = F(0.0f);
        for (int k = 0; k < 2; ++k) {
            F pair[8];
            gather8(texels, 4 * ((top + k) * picture.width + left), pair);
            const F down = k == 1 ? fy : 1.0f - fy;
            const F near = (1.0f - fx) * down, far = fx * down;
            found = add(add(found, times(near, V{pair[0], pair[1], pair[2]})), times(far, V{pair[4], pair[5], pair[6]}));
            coverage += pick(pair[3] >= 0.0f, near, F(0.0f)) + pick(pair[7] >= 0.0f, far, F(0.0f));
        }
        return found;
    };
    // water.shifted_radiance
    auto shifted = [&](I mask, F own_x, F own_y, F x, F y, V otherwise) -> V {
        V result = otherwise;
        F shift_x = x - own_x, shift_y = y - own_y;
        I searching = mask;
        for (int step = 0; step < retreats && bits(searching); ++step) {
            F coverage;
            const V found = look_up(own_x + shift_x, own_y + shift_y, coverage);
            const I good = searching & (coverage >= even_coverage);
            result = vpick(good, V{found.x / coverage, found.y / coverage, found.z / coverage}, result);
            searching &= ~good;
            shift_x *= 0.5f;
            shift_y *= 0.5f;
        }
        return result;
    };
"""
)
# Places of lanes on the screen and the points of the surface there.
_LANES = r"""
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        const bool full = start + LANES <= end;
        const I at = igather(pixel.data, own);
        const I row = at / camera.width;
        const F own_x = __builtin_convertvector(at - row * camera.width, F) + 0.5f;
        const F own_y = __builtin_convertvector(row, F) + 0.5f;
        const V to_point = sub(vrows((const float*)point.data, start, full, own), eye);
        const V kept = vrows((const float*)radiance.data, start, full, own);
        const F distance = length(to_point);
        const F least = least_nearness / fmax(distance, F(least_depth));
        F x = own_x, y = own_y, near = nearness_at(own_x, own_y, F(0.0f));
"""


@wp.func_native(
    vector.snippet(
        _PIXELS
        + r"""
    float* texels = (float*)out_picture.texels.data;
    (void)write;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const bool full = start + LANES <= end;
        const I at = igather(pixel.data, own);
        F near;
        if (nearness.shape[0] > 0) {
            near = gather(nearness.data, own);
        } else {
            const F way = gather(distance.data, own);
            near = pick((igather(triangle.data, own) >= 0) & (way > 0.0f), 1.0f / way, F(0.0f));
        }
        const V d = vrows((const float*)direction.data, start, full, own), n = vrows((const float*)normal.data, start, full, own);
        near = near / fmax(__builtin_elementwise_abs(dot(d, n)), F(least_cosine));
        const I row = at / image_width;
        const I texel = (row - out_picture.y0) * out_picture.width + at - row * image_width - out_picture.x0;
        const int there = end - start < LANES ? end - start : LANES;
        const float* from = (const float*)radiance.data + 3 * start;
        for (int l = 0; l < there; ++l) {
            float* to = texels + 4 * texel[l];
            to[0] = from[3 * l]; to[1] = from[3 * l + 1]; to[2] = from[3 * l + 2]; to[3] = near[l];
        }
    }
"""
    )
)
def fill_block(
    block: int,
    image_width: int,
    nearness: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    least_cosine: float,
    out_picture: StillPicture,
): ...


@wp.kernel
def fill_blocks_kernel(
    first: int,
    image_width: int,
    nearness: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_picture: StillPicture,
):
    """One thread per block of pixels."""
    fill_block(
        first + wp.tid(),
        image_width,
        nearness,
        triangle,
        distance,
        pixel,
        normal,
        direction,
        radiance,
        LEAST_COSINE,
        out_picture,
    )


@wp.func_native(
    vector.snippet(
        _PICTURE
        + r"""
    for (int start = begin; start < end; start += LANES) {"""
        + _LANES
        + r"""
        const V n = vrows((const float*)normal.data, start, full, own);
        const V direct = vrows((const float*)direction.data, start, full, own);
        V shown = n;
        if (normals.shape[0] > 0) {
            const V mapped = vgather((const float*)normals.data, at);
            shown = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
        }
        // surface.turned_reflection
        const V incident = sub(direct, times(2.0f * dot(direct, n), n));
        V turned = sub(incident, times(2.0f * dot(incident, shown), shown));
        turned = unit(sub(turned, times(2.0f * fmin(dot(turned, n), F(0.0f)), n)));
        const F rise = dot(turned, n);
        const V behind = sub(turned, times(2.0f * rise, n));
        for (int step = 0; step < steps; ++step) {
            const F divisor = fmax(near * rise, least);
            seen_at(add(to_point, V{behind.x / divisor, behind.y / divisor, behind.z / divisor}), own_x, own_y, x, y);
            near = nearness_at(x, y, near);
        }
        write((float*)out_radiance.data, start, valid, shifted(valid, own_x, own_y, x, y, kept));
    }
    (void)parallel;
"""
    )
)
def reflect_block(
    block: int,
    camera: CameraView,
    normals: wp.array(dtype=wp.vec3),
    picture: StillPicture,
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    steps: int,
    retreats: int,
    least_nearness: float,
    least_depth: float,
    even_coverage: float,
    out_radiance: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def reflect_blocks_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    normals: wp.array(dtype=wp.vec3),
    picture: StillPicture,
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per block of mirror pixels."""
    reflect_block(
        first + wp.tid(),
        camera[0],
        normals,
        picture,
        pixel,
        point,
        normal,
        direction,
        radiance,
        MIRROR_STEPS,
        RETREATS,
        LEAST_NEARNESS,
        LEAST_DEPTH,
        EVEN_COVERAGE,
        out_radiance,
    )


@wp.func_native(
    vector.snippet(
        _PICTURE
        + r"""
    // water.crossing_point
    auto crossing_point = [&](V near_it, V n, V target) -> V {
        const F height = -dot(near_it, n);
        const F depth = fmax(-dot(sub(target, near_it), n), F(0.0f));
        const V across = sub(target, times(dot(target, n), n));
        const F way = length(across);
        F s = fmin(fmax(length(add(near_it, times(height, n))), F(0.0f)), way);
        const F rest = way - s;
        const F front = s * s + height * height, back = rest * rest + depth * depth;
        const F before = 1.0f / __builtin_elementwise_sqrt(front), after = 1.0f / __builtin_elementwise_sqrt(back);
        const F residual = s * before - ior * rest * after;
        const F slope = height * height * before * before * before + ior * depth * depth * after * after * after;
        const I better = (front > 0.0f) & (back > 0.0f) & (slope > 0.0f);
        s = pick(better, fmin(fmax(s - residual / slope, F(0.0f)), way), s);
        const F share = pick(way > 0.0f, s / way, F(0.0f));
        return sub(vpick(way > 0.0f, times(share, across), same(0.0f)), times(height, n));
    };
    for (int start = begin; start < end; start += LANES) {"""
        + _LANES
        + r"""
        const V n = times(F(-1.0f), vrows((const float*)normal.data, start, full, own));
        V shown = n;
        if (normals.shape[0] > 0) {
            const V mapped = vgather((const float*)normals.data, at);
            shown = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
        }
        const V incident = parallel ? spread(camera.forward) : unit(to_point);
        I within;
        EACH_LANE within[l] = inside.data[own[l]] != 0 ? -1 : 0;
        // optics.refract
        auto refract = [&](V towards, V facing) -> V {
            const V flat = sub(towards, times(dot(towards, facing), facing));
            const V across = V{flat.x / ior, flat.y / ior, flat.z / ior};
            const F square = 1.0f - dot(across, across);
            const V bent = sub(across, times(__builtin_elementwise_sqrt(fmax(square, F(0.0f))), facing));
            return vpick(square > 0.0f, bent, same(0.0f));
        };
        V bent = refract(incident, shown);
        const I enters = valid & within & (dot(incident, n) < 0.0f) & (dot(bent, n) < 0.0f);
        bent = unit(bent);
        const V still = parallel ? refract(incident, n) : same(0.0f);
        V crossing = to_point;
        for (int step = 0; step < steps; ++step) {
            const F divisor = fmin(near * dot(bent, n), -least);
            const V target = sub(to_point, V{bent.x / divisor, bent.y / divisor, bent.z / divisor});
            if (!parallel) {
                crossing = crossing_point(crossing, n, target);
                seen_at(crossing, own_x, own_y, x, y);
            } else {
                const F way = dot(sub(target, to_point), n) / dot(still, n);
                seen_at(sub(target, times(way, still)), own_x, own_y, x, y);
            }
            near = nearness_at(x, y, near);
        }
        write((float*)out_radiance.data, start, valid, shifted(enters, own_x, own_y, x, y, kept));
    }
"""
    )
)
def refract_block(
    block: int,
    camera: CameraView,
    normals: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.uint8),
    ior: float,
    picture: StillPicture,
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    steps: int,
    retreats: int,
    least_nearness: float,
    least_depth: float,
    even_coverage: float,
    out_radiance: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def refract_blocks_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    normals: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.uint8),
    ior: float,
    picture: StillPicture,
    # Pixels of the surface, with the normals on the far side:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per block of pixels of the surface."""
    refract_block(
        first + wp.tid(),
        camera[0],
        normals,
        inside,
        ior,
        picture,
        pixel,
        point,
        normal,
        radiance,
        REFRACTION_STEPS,
        RETREATS,
        LEAST_NEARNESS,
        LEAST_DEPTH,
        EVEN_COVERAGE,
        out_radiance,
    )
