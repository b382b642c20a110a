"""`local_map.blend_kernel` for a block of texels at a time, where one or two reference maps are blended: the same formulas.

Look-ups over the edge of a face, and those that see sky, are left to the plain function.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.cubemap import RADIANCE_DIRECTION
from warp_reflect.environment_maps import PALETTE, CubeMapsView
from warp_reflect.scene import SceneView
from warp_reflect.shade import LightView
from warp_reflect.techniques.local_map import (
    AT_CENTRE,
    COINCIDENT,
    DEPTH_SLACK,
    LEAST_WEIGHT,
    PLANE_REACH,
    SLOPE_MAX,
    SLOPE_TEXELS,
    WHOLE,
    blend_texel,
)
from warp_reflect.techniques.local_maps import ROW_MULTIPLE, LocalPlace
from warp_reflect.techniques.local_shading import TEXEL_BLENDED, TEXEL_MISSING

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)
ROWS = wp.constant(ROW_MULTIPLE)
EVERY = wp.constant(wp.uint64(0xFFFFFFFFFFFFFFFF))  # texel of a block


@wp.func_native(
    vector.snippet(
        RADIANCE_DIRECTION
        + r"""
    typedef float Texel __attribute__((ext_vector_type(4)));
    const int begin = block * BLOCK;
    const int n = place.resolution;
    const int own = begin - place.first_texel;
    const int face_texels = n * n;
    const int face = own / face_texels;
    const float slack = place.slack;
    const V e = spread(place.eye);
    const int count = rems.shape[0] < used ? rems.shape[0] : used;
    const int edge = maps.resolution;
    const float size_of_map = (float)(edge);
    const bool packed = maps.packed.shape[0] > 0;
    float* radiance = (float*)out_radiance.data;
    unsigned long long unanswered = 0;
    for (int start = begin; start < begin + BLOCK; start += LANES) {
        const F inv = load(inverse.data + start);
        const I there = inv > 0.0f;
        if (!bits(there)) {
            __builtin_memset(radiance + 4 * start, 0, 16 * LANES);
            __builtin_memset(out_distance.data + start, 0, 4 * LANES);
            __builtin_memset(out_state.data + start, 0, LANES);
            continue;
        }
        const int of_face = start - place.first_texel - face * face_texels;
        const int row = of_face / n;
        const I column = of_face - row * n + lanes();
        const F u = (2.0f * __builtin_convertvector(column, F) + 1.0f) / (float)(n) - 1.0f;
        const F v = F((2.0f * (float)(row) + 1.0f) / (float)(n) - 1.0f);
        const F one = F(1.0f);
        const V towards = radiance_direction(face, u, v);
        F depth = 1.0f / pick(there, inv, one);
        F off = F(slack);
        const I tri = iload(triangle.data + start);
        const I known = there & (tri >= 0);
        V normal = same(0.0f);
        if (bits(known)) {
            V p0, p1, p2;
            corners(records.data, ipick(known, tri, I(0)), p0, p1, p2);
            normal = vpick(known, facet_normal(p0, p1, p2), normal);
            const F height = dot(normal, sub(p0, e));
            const F across = dot(normal, towards);
            if (slack > 0.0f) {
                const F met = height / across;
                const I good = known & (__builtin_elementwise_abs(across * depth - height) <= slack) & (height * across > 0.0f)
                    & (__builtin_elementwise_abs(met - depth) <= plane_reach * slack);
                depth = pick(good, met, depth);
                off = pick(good, F(0.0f), off);
            }
            normal = vpick(across > 0.0f, times(F(-1.0f), normal), normal);
        }
        const V local = times(depth, towards);
        const V p = add(e, local);
        const F distance = __builtin_elementwise_sqrt(dot(towards, towards)) * depth;
        const F near = fmax(distance, F(1.0e-30f));
        store(out_distance.data + start, pick(there, near, F(0.0f)));
        I valid[2] = {I(0), I(0)}, where[2];
        F x[2], y[2], square[2];
        for (int k = 0; k < count; ++k) {
            const int rem = rems.data[k];
            const V ray = sub(p, spread(maps.centre.data[rem]));
            const auto& m = maps.map_from_world.data[rem];
            const V d = V{m.data[0][0] * ray.x + m.data[0][1] * ray.y + m.data[0][2] * ray.z,
                m.data[1][0] * ray.x + m.data[1][1] * ray.y + m.data[1][2] * ray.z,
                m.data[2][0] * ray.x + m.data[2][1] * ray.y + m.data[2][2] * ray.z};
            square[k] = dot(ray, ray);
            const F far = __builtin_elementwise_sqrt(square[k]);
            const F facing = dot(normal, ray);
            const F along_map = __builtin_elementwise_abs(facing) / fmax(far, F(1.0e-30f));
            I good = there;
            if (blur_max > 0.0f) {
                F ratio = far / near * (float)(n) / size_of_map;
                const F along_eye = __builtin_elementwise_abs(dot(normal, local)) / near;
                ratio = pick(along_map > 0.0f, ratio * fmax(one, along_eye / along_map), ratio);
                good &= ratio <= blur_max;
            }
            good &= (square[k] > at_centre * distance * distance) & (facing <= 0.0f);
            // cubemap.radiance_point
            const F ax = __builtin_elementwise_abs(d.x), ay = __builtin_elementwise_abs(d.y), az = __builtin_elementwise_abs(d.z);
            const I on_x = (ax >= ay) & (ax >= az), on_y = ~on_x & (ay >= az);
            const F major = pick(on_x, d.x, pick(on_y, d.y, d.z));
            const I behind = major < 0.0f;
            const F a = pick(on_x, pick(behind, -d.z, d.z), pick(on_y, d.x, pick(behind, d.x, -d.x)));
            const F b = pick(on_y, pick(behind, d.z, -d.z), -d.y);
            const F over = __builtin_elementwise_abs(major);
            const I its_face = ipick(on_x, I(0), ipick(on_y, I(2), I(4))) - behind;
            x[k] = 0.5f * (a / over + 1.0f) * size_of_map;
            y[k] = 0.5f * (b / over + 1.0f) * size_of_map;
            where[k] = its_face * (edge * edge);
            if (bits(good)) {
                I cx = __builtin_convertvector(clip(pick(good, x[k], F(0.0f)), 0.0f, size_of_map - 1.0f), I);
                I cy = __builtin_convertvector(clip(pick(good, y[k], F(0.0f)), 0.0f, size_of_map - 1.0f), I);
                const I at = ipick(good, where[k] + cy * edge + cx, I(0));
                F found;
                if (packed) {
                    const auto& range = maps.ranges.data[rem];
                    EACH_LANE {
                        const int number = (int)(maps.packed.data[rem * maps.map_texels + at[l]] >> 19);
                        found[l] = number == 0 ? 0.0f : wp::exp(range.distance_low + range.distance_step * (float)(number - 1));
                    }
                } else {
                    found = gather(maps.distance.data + rem * 6 * edge * edge, at);
                }
                const F tangent = pick(along_map > 0.0f,
                    fmin(__builtin_elementwise_sqrt(fmax(1.0f - along_map * along_map, F(0.0f))) / along_map, F(slope_max)),
                    F(slope_max));
                const F footprint = 2.0f * far / size_of_map;
                good &= (found == 0.0f)
                    | (far <= found + slope_texels * footprint * tangent + depth_slack * far + off);
            }
            valid[k] = good;
        }
        const I any = valid[0] | valid[1];
        EACH_LANE out_state.data[start + l] = there[l] == 0 ? 0 : any[l] != 0 ? blended : missing;
        I need = there & any;
        if (shaded == 0) need = there;
        else need |= there & ~known;
        F w[2] = {one, F(0.0f)};
        if (count == 2) {
            // local_map.axis_share, local_map.normalised
            const V first = spread(maps.centre.data[rems.data[0]]);
            const V axis = sub(spread(maps.centre.data[rems.data[1]]), first);
            const V to_point = sub(p, first);
            const F length = dot(axis, axis);
            const I apart = length > coincident * dot(to_point, to_point);
            const F share = pick(apart, clip(dot(to_point, axis) / length, 0.0f, 1.0f), F(0.5f));
            const F prior[2] = {1.0f - share, share};
            const F a = pick(valid[0], prior[0], F(0.0f)), b = pick(valid[1], prior[1], F(0.0f));
            const F total = a + b;
            const I best = ipick(any, valid[0] & (~valid[1] | (prior[0] >= prior[1])), prior[0] >= prior[1]);
            const I enough = total > least_weight;
            w[0] = pick(enough, a / total, pick(best, one, F(0.0f)));
            w[1] = pick(enough, b / total, pick(best, F(0.0f), one));
        }
        const I sky = ~there;
        for (unsigned rest = bits(sky); rest != 0; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            *(Texel*)(radiance + 4 * (start + l)) = Texel(0.0f);
        }
        // environment_maps.fetch_level, of looks-up that stay within a face.
        I there_of[2] = {I(0), I(0)}, beyond = I(0);
        float weight[2][LANES], shares[2][4][LANES];
        int first_tap[2][LANES];
        for (int k = 0; k < count; ++k) {
            const F px = x[k] - 0.5f, py = y[k] - 0.5f;
            const I asked = need & (w[k] > 0.0f);
            const I inside = (px >= 0.0f) & (py >= 0.0f) & (px < size_of_map - 1.0f) & (py < size_of_map - 1.0f)
                & (square[k] > 0.0f);
            there_of[k] = asked & inside;
            beyond |= asked & ~inside;
            const F in_x = pick(there_of[k], px, F(0.0f)), in_y = pick(there_of[k], py, F(0.0f));
            const I x0 = __builtin_convertvector(in_x, I), y0 = __builtin_convertvector(in_y, I);
            const F fx = in_x - __builtin_convertvector(x0, F), fy = in_y - __builtin_convertvector(y0, F);
            istore(first_tap[k], rems.data[k] * maps.map_texels + where[k] + y0 * edge + x0);
            store(weight[k], w[k]);
            store(shares[k][0], (1.0f - fx) * (1.0f - fy));
            store(shares[k][1], fx * (1.0f - fy));
            store(shares[k][2], (1.0f - fx) * fy);
            store(shares[k][3], fx * fy);
        }
        const unsigned of_first = bits(there_of[0]), of_second = bits(there_of[1]);
        unsigned left_over = bits(beyond);
        for (unsigned rest = bits(need) & ~left_over; rest != 0; rest &= rest - 1) {
            const int l = __builtin_ctz(rest);
            Texel sum = Texel(0.0f);
            bool whole = true;
            for (int k = 0; k < count; ++k) {
                if (((k == 0 ? of_first : of_second) >> l & 1) == 0) continue;
                const int at = first_tap[k][l];
                const int taps[4] = {at, at + 1, at + edge, at + edge + 1};
                Texel value = Texel(0.0f);
                for (int tap = 0; tap < 4; ++tap) {
                    Texel one_tap;
                    if (packed) {
                        // environment_maps.unpack_radiance
                        const unsigned code = maps.packed.data[taps[tap]];
                        const int luma = (int)((code >> 10) & 0x1FF);
                        one_tap = Texel(0.0f);
                        one_tap.w = (code >> 19) == 0 ? 0.0f : 1.0f;
                        if ((code >> 19) != 0 && luma != 0) {
                            const auto& range = maps.ranges.data[rems.data[k]];
                            const float total = wp::exp(range.luma_low + range.luma_step * (float)(luma - 1));
                            const auto& part = maps.palette.data[rems.data[k] * palette + (int)(code & 0x3FF)];
                            one_tap.x = total * part[0];
                            one_tap.y = total * (1.0f - part[0] - part[1]);
                            one_tap.z = total * part[1];
                        }
                    } else {
                        __builtin_memcpy(&one_tap, (const float*)maps.radiance.data + 4 * (long long)taps[tap], sizeof(one_tap));
                    }
                    value += shares[k][tap][l] * one_tap;
                }
                whole &= value.w >= whole_coverage;
                sum += weight[k][l] * value;
            }
            if (!whole) {
                left_over |= 1u << l;
                continue;
            }
            sum.w = 1.0f;
            __builtin_memcpy(radiance + 4 * (start + l), &sum, sizeof(sum));
        }
        unanswered |= (unsigned long long)left_over << (start - begin);
    }
    return unanswered;
""",
        "return 0;",
    )
)
def blend_block(
    block: int,
    records: wp.array(dtype=float),
    maps: CubeMapsView,
    rems: wp.array(dtype=int),
    used: int,
    place: LocalPlace,
    blur_max: float,
    shaded: int,
    inverse: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    plane_reach: float,
    at_centre: float,
    coincident: float,
    least_weight: float,
    slope_max: float,
    slope_texels: float,
    depth_slack: float,
    whole_coverage: float,
    palette: int,
    blended: int,
    missing: int,
    out_radiance: wp.array(dtype=wp.vec4),
    out_distance: wp.array(dtype=float),
    out_state: wp.array(dtype=wp.uint8),
) -> wp.uint64: ...


@wp.kernel
def blend_blocks_kernel(
    first: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    lights: LightView,
    maps: CubeMapsView,
    rems: wp.array2d(dtype=int),
    used: int,
    places: wp.array(dtype=LocalPlace),
    block_map: wp.array(dtype=int),
    blur_max: float,
    shaded: int,
    inverse: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    # Outputs:
    out_radiance: wp.array(dtype=wp.vec4),
    out_distance: wp.array(dtype=float),
    out_state: wp.array(dtype=wp.uint8),
):
    """One thread per block of texels, those of a row that is no whole number of vectors one by one."""
    block = first + wp.tid()
    k = block_map[block]
    place = places[k]
    own = rems[k]
    left = EVERY
    if place.resolution % ROWS == 0:
        left = blend_block(
            block,
            records,
            maps,
            own,
            used,
            place,
            blur_max,
            shaded,
            inverse,
            triangle,
            PLANE_REACH,
            AT_CENTRE,
            COINCIDENT,
            LEAST_WEIGHT,
            SLOPE_MAX,
            SLOPE_TEXELS,
            DEPTH_SLACK,
            WHOLE,
            PALETTE,
            TEXEL_BLENDED,
            TEXEL_MISSING,
            out_radiance,
            out_distance,
            out_state,
        )
    i = block * BLOCK
    while left != wp.uint64(0):
        if (left & wp.uint64(1)) != wp.uint64(0):
            blend_texel(
                scene,
                lights,
                maps,
                own,
                used,
                place,
                blur_max,
                shaded,
                i,
                inverse,
                triangle,
                out_radiance,
                out_distance,
                out_state,
            )
        left = left >> wp.uint64(1)
        i += 1
