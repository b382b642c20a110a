"""`local_field.sweep_lines_kernel` and `trace_steep_kernel` for neighbouring lines and texels at a time: the same answers.

Lines that lie beside one another pass the same columns at nearly the same steps, so that a vector of them walks as far as its
longest. What a column hides of a line is written line by line: most columns hide nothing that is not hidden already.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.cubemap import RADIANCE_DIRECTION
from warp_reflect.grid_rays import FAR
from warp_reflect.heightfield import HeightfieldView
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.techniques.local_field import (
    LEAST_HEIGHT,
    OPEN_SLACK,
    FieldSides,
    SideFace,
    sweep_line,
    trace_steep,
)
from warp_reflect.techniques.local_maps import LINES, ROW_MULTIPLE, LocalPlace

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

GROUP_LINES = wp.constant(LINES)
BLOCK = wp.constant(vector.BLOCK)
ROWS = wp.constant(ROW_MULTIPLE)

# What both snippets walk with: `local_field.level_walk`, `side_triangle`.
WALK = r"""
    const int n = place.resolution;
    const float edge = (float)(n);
    const float* heights = field.heights.data;
    const int nx = field.nx, ny = field.ny;
    const float scale = field.place.inverse;
    float at[3] = {place.eye[0] + origin[0] - field.place.corner[0], place.eye[1] + origin[1] - field.place.corner[1],
        place.eye[2] + origin[2] - field.place.corner[2]};
    if (field.place.up == 1) { const float y = at[1]; at[1] = at[2]; at[2] = y; }
    const float ox = at[0] * scale, oy = at[1] * scale, oz = at[2] * scale;
    auto within = [](float a, int most) -> int {
        const int k = (int)__builtin_floorf(a);
        return k < 0 ? 0 : k > most ? most : k;
    };
    const int x_first = within(ox, nx - 1), y_first = within(oy, ny - 1);
    const float top = field.top - oz;
    auto lower = [](F a, F b) -> F { return a < b ? a : b; };
    struct Way { F inverse_x, inverse_y, never_x, never_y; I step_x, step_y, ahead_x, ahead_y; };
    auto way_of = [&](F a, F b) -> Way {
        Way way;
        const I no_x = a == 0.0f, no_y = b == 0.0f;
        way.inverse_x = pick(no_x, F(0.0f), 1.0f / a);
        way.inverse_y = pick(no_y, F(0.0f), 1.0f / b);
        way.never_x = pick(no_x, F(far), F(0.0f));
        way.never_y = pick(no_y, F(far), F(0.0f));
        way.step_x = ipick(a < 0.0f, I(-1), I(1));
        way.step_y = ipick(b < 0.0f, I(-1), I(1));
        way.ahead_x = ipick(a < 0.0f, I(0), I(1));
        way.ahead_y = ipick(b < 0.0f, I(0), I(1));
        return way;
    };
    auto time = [](I border, float o, F inverse, F never) -> F {
        const F product = (__builtin_convertvector(border, F) - o) * inverse;
        return product + never;
    };
    auto side_of = [&](int column, int axis, int step) -> int {
        const int row = sides.row.data[column];
        const int found = row >= 0 ? sides.triangle.data[4 * row + 2 * axis + (step > 0 ? 0 : 1)] : -1;
        return found >= 0 ? found : sides.roof.data[column];
    };
    auto outside = [&](I x, I y) -> I { return (x < 0) | (y < 0) | (x >= nx) | (y >= ny); };
"""


@wp.func_native(
    vector.snippet(
        WALK
        + r"""
    const int line_first = 16 * group;
    for (int start = 0; start < 16; start += LANES) {
        const int number = line_first + start;
        const auto& face = faces.data[number / n];
        const int line = number - number / n * n;
        const F lateral = (2.0f * __builtin_convertvector(line + lanes(), F) + 1.0f) / edge - 1.0f;
        const F across_x = lateral * face.across[0], across_y = lateral * face.across[1];
        const Way way = way_of(face.ahead[0] + across_x, face.ahead[1] + across_y);
        // local_field.side_texel
        const int stride = face.rise_step[0] * n + face.rise_step[1];
        int texel[LANES], step[LANES];
        float rises[LANES], highests[LANES];
        for (int l = 0; l < LANES; ++l) {
            const int row = face.corner[0] * (n - 1) + face.line_step[0] * (line + l);
            const int column = face.corner[1] * (n - 1) + face.line_step[1] * (line + l);
            texel[l] = place.first_texel + (face.face * n + row) * n + column;
            step[l] = 0;
            rises[l] = 1.0f / edge - 1.0f;
            highests[l] = 1.0f;
        }
        auto rise_at = [&](int k) -> float { return (2.0f * (float)(k) + 1.0f) / edge - 1.0f; };
        F rise = load(rises), highest = F(1.0f), t_in = F(0.0f);
        I x = I(x_first), y = I(y_first), on_y = I(0), walking = I(-1), whole = I(0);
        while (bits(walking)) {
            const F t_x = time(x + way.ahead_x, ox, way.inverse_x, way.never_x);
            const F t_y = time(y + way.ahead_y, oy, way.inverse_y, way.never_y);
            const F t_out = lower(t_x, t_y);
            const I column = y * nx + x;
            const F height = gather(heights, ipick(walking, column, I(0))) - oz;
            const I was_whole = whole;
            const I hidden = walking & ~whole & (((t_in > 0.0f) & (rise * t_in <= height)) | (rise * t_out <= height));
            for (unsigned rest = bits(hidden); rest != 0; rest &= rest - 1) {
                const int l = __builtin_ctz(rest);
                int k = step[l];
                float slope = rises[l];
                const float t_near = t_in[l], t_far = t_out[l], h = height[l];
                const int c = column[l];
                if (t_near > 0.0f && slope * t_near <= h) {
                    const float inverse = scale / t_near;
                    const int axis = on_y[l] != 0 ? 1 : 0;
                    const int triangle = side_of(c, axis, axis == 0 ? way.step_x[l] : way.step_y[l]);
                    do {
                        const int i = texel[l] + k * stride;
                        out_inverse.data[i] = inverse;
                        out_triangle.data[i] = triangle;
                        ++k;
                        slope = rise_at(k);
                    } while (k < n && slope * t_near <= h);
                }
                if (k == n && t_near > 0.0f) {
                    const float reached = h / t_near;
                    highests[l] = highests[l] > reached ? highests[l] : reached;
                }
                while (k < n && slope * t_far <= h) {
                    const float met = h / slope;
                    const float t = met < t_far ? met : t_far;
                    const int i = texel[l] + k * stride;
                    out_inverse.data[i] = scale / (t_near > t ? t_near : t);
                    out_triangle.data[i] = sides.roof.data[c];
                    ++k;
                    slope = rise_at(k);
                }
                step[l] = k;
                rises[l] = slope;
            }
            if (bits(hidden)) {
                rise = load(rises);
                whole = iload(step) == n;
                highest = pick(whole & ~was_whole, load(highests), highest);
            }
            const I above = was_whole & (t_in > 0.0f) & (height > highest * t_in);
            highest = pick(above & walking, height / t_in, highest);
            const I first_x = t_x <= t_y;
            on_y = ~first_x;
            x += ipick(walking & first_x, way.step_x, I(0));
            y += ipick(walking & ~first_x, way.step_y, I(0));
            const I over = ipick(was_whole, highest * t_out > top, (rise >= 0.0f) & (rise * t_out > top));
            walking &= ~(outside(x, y) | over);
            t_in = t_out;
        }
        highest = pick(whole, highest, rise);
        store(out_open.data + 16 * place.first_group + number, highest);
        for (int l = 0; l < LANES; ++l) {
            for (int k = step[l]; k < n; ++k) {
                const int i = texel[l] + k * stride;
                out_inverse.data[i] = 0.0f;
                out_triangle.data[i] = -1;
            }
        }
    }
""",
        exact=True,
    )
)
def sweep_group(
    group: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    place: LocalPlace,
    origin: wp.vec3,
    far: float,
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_open: wp.array(dtype=float),
): ...


@wp.kernel
def sweep_groups_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    places: wp.array(dtype=LocalPlace),
    group_map: wp.array(dtype=int),
    origin: wp.vec3,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_open: wp.array(dtype=float),
):
    """One thread per group of lines; those of maps whose faces are no whole number of groups one by one."""
    number = first + wp.tid()
    place = places[group_map[number]]
    if place.swept == 0:
        return
    group = number - place.first_group
    if place.resolution % ROWS == 0:
        sweep_group(group, field, sides, faces, place, origin, FAR, out_inverse, out_triangle, out_open)
    else:
        line = group * GROUP_LINES
        while line < wp.min((group + 1) * GROUP_LINES, 4 * place.resolution):
            sweep_line(field, sides, faces, place, origin, line, out_inverse, out_triangle, out_open)
            line += 1


@wp.func_native(
    vector.snippet(
        WALK
        + RADIANCE_DIRECTION
        + r"""
    const int square = n * n;
    const bool upwards = block * BLOCK < square;
    const int face = upwards ? steep[0] : steep[1];
    const int begin = upwards ? block * BLOCK : block * BLOCK - square;
    const float rise = upwards ? 1.0f : -1.0f;
    for (int start = begin; start < begin + BLOCK; start += LANES) {
        const int row = start / n;
        const F u = (2.0f * __builtin_convertvector(start - row * n + lanes(), F) + 1.0f) / edge - 1.0f;
        const F v = F((2.0f * (float)(row) + 1.0f) / edge - 1.0f);
        const F one = F(1.0f);
        V towards = radiance_direction(face, u, v);
        if (field.place.up == 1) { const F y = towards.y; towards.y = towards.z; towards.z = y; }
        I walking = I(-1);
        if (upwards) {
            I closed = I(0);
            for (int k = 0; k < 4; ++k) {
                const auto& side = faces.data[k];
                const F a = side.ahead[0] * towards.x, b = side.ahead[1] * towards.y;
                const F along = a + b;
                const F c = side.across[0] * towards.x, d = side.across[1] * towards.y;
                const F lateral = c + d;
                const I on_side = (along >= __builtin_elementwise_abs(lateral)) & (along > 0.0f);
                if (!bits(on_side)) continue;
                const F share = lateral / pick(on_side, along, one) + 1.0f;
                const F place_of_line = 0.5f * share * edge;
                const F low = __builtin_elementwise_floor(pick(on_side, place_of_line - 0.5f, F(0.0f)));
                const I line = __builtin_convertvector(low, I);
                for (int beside = 0; beside < 2; ++beside) {
                    I its = line + beside;
                    its = ipick(its < 0, I(0), ipick(its > n - 1, I(n - 1), its));
                    const F open = gather(open_from.data + 16 * place.first_group + k * n, its);
                    closed |= on_side & (open * along > 1.0f - open_slack);
                }
            }
            walking = closed;
        }
        F inverse = F(0.0f);
        I triangle = I(-1);
        if (bits(walking)) {
            const Way way = way_of(towards.x, towards.y);
            I x = I(x_first), y = I(y_first), on_y = I(0);
            F t_in = F(0.0f);
            while (bits(walking)) {
                const F t_x = time(x + way.ahead_x, ox, way.inverse_x, way.never_x);
                const F t_y = time(y + way.ahead_y, oy, way.inverse_y, way.never_y);
                const F t_out = lower(t_x, t_y);
                const I column = y * nx + x;
                const F height = gather(heights, ipick(walking, column, I(0))) - oz;
                const I wall = walking & (rise * t_in <= height) & (t_in > 0.0f);
                const I roof = walking & ~wall & (rise * t_out <= height);
                if (bits(wall | roof)) {
                    const F size = __builtin_elementwise_abs(height);
                    const F over_roof = scale / pick(size > least_height, size, F(least_height));
                    inverse = pick(wall, scale / t_in, pick(roof, over_roof, inverse));
                    for (unsigned rest = bits(wall | roof); rest != 0; rest &= rest - 1) {
                        const int l = __builtin_ctz(rest);
                        const int axis = on_y[l] != 0 ? 1 : 0;
                        triangle[l] = wall[l] != 0 ? side_of(column[l], axis, axis == 0 ? way.step_x[l] : way.step_y[l])
                            : sides.roof.data[column[l]];
                    }
                    walking &= ~(wall | roof);
                }
                const I first_x = t_x <= t_y;
                on_y = ~first_x;
                x += ipick(walking & first_x, way.step_x, I(0));
                y += ipick(walking & ~first_x, way.step_y, I(0));
                t_in = t_out;
                I over = (t_out >= far) | outside(x, y);
                if (upwards) over |= t_out > top;
                walking &= ~over;
            }
        }
        const int texel = place.first_texel + face * square + start;
        store(out_inverse.data + texel, inverse);
        istore(out_triangle.data + texel, triangle);
    }
""",
        exact=True,
    )
)
def trace_steep_block(
    block: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    open_from: wp.array(dtype=float),
    place: LocalPlace,
    origin: wp.vec3,
    steep: wp.vec2i,
    far: float,
    open_slack: float,
    least_height: float,
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
): ...


@wp.kernel
def trace_steep_blocks_kernel(
    first: int,
    field: HeightfieldView,
    sides: FieldSides,
    faces: wp.array(dtype=SideFace),
    open_from: wp.array(dtype=float),
    places: wp.array(dtype=LocalPlace),
    steep_map: wp.array(dtype=int),
    origin: wp.vec3,
    steep: wp.vec2i,
    # Outputs:
    out_inverse: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
):
    """One thread per block of texels that look up or down."""
    number = first + wp.tid()
    place = places[steep_map[number]]
    if place.swept == 0:
        return
    block = number - place.first_steep
    if place.resolution % ROWS == 0:
        trace_steep_block(
            block,
            field,
            sides,
            faces,
            open_from,
            place,
            origin,
            steep,
            FAR,
            OPEN_SLACK,
            LEAST_HEIGHT,
            out_inverse,
            out_triangle,
        )
    else:
        i = block * BLOCK
        while i < wp.min((block + 1) * BLOCK, 2 * place.resolution * place.resolution):
            trace_steep(field, sides, faces, open_from, place, origin, steep, i, out_inverse, out_triangle)
            i += 1
