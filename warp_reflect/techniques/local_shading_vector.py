"""`local_shading`'s kernels of a row of texels in native code: the same texels, hits a vector at a time."""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.cubemap import RADIANCE_DIRECTION
from warp_reflect.techniques.local_maps import LocalPlace
from warp_reflect.techniques.local_shading import (
    ASKED,
    COUNTED,
    NOT_ASKED,
    TEXEL_BLENDED,
    TEXEL_MISSING,
    TEXEL_MOVING,
    TEXEL_SHADED,
    TEXEL_SKY,
)

wp.set_module_options({"enable_backward": False})

# Both need: `place`, `r`, `step`, `missing`, `triangle`, `state`.
ROW = rf"""
    const int n = place.resolution;
    const int row = r - place.first_row;
    const int start = place.first_texel + row * n;
    const int face = row / n;
    const int y = row - face * n;
    const int middle_y = y / step * step + step / 2;
    const int middle_row = place.first_texel + (face * n + (middle_y < n - 1 ? middle_y : n - 1)) * n;
    // local_shading.is_asked, shown_for
    auto is_asked = [&](int t) -> bool {{
        const int own = state.data[t];
        return own == {TEXEL_MOVING} || (missing == 1 && own == {TEXEL_MISSING} && triangle.data[t] >= 0);
    }};
    auto shown_for = [&](int column) -> int {{
        if (step == 1) return start + column;
        const int middle_x = column / step * step + step / 2;
        const int middle = middle_row + (middle_x < n - 1 ? middle_x : n - 1);
        return triangle.data[middle] == triangle.data[start + column] && is_asked(middle) ? middle : start + column;
    }};
"""


@wp.func_native(
    vector.snippet(
        ROW
        + rf"""
    int surfaces = 0, unseen = 0, asked = 0, moving = 0, shaded = 0;
    for (int column = 0; column < n; ++column) {{
        const int own = state.data[start + column];
        if (own == {TEXEL_SKY}) continue;
        if (own == {TEXEL_MOVING}) ++moving; else ++surfaces;
        if (own == {TEXEL_BLENDED}) continue;
        if (own == {TEXEL_MISSING}) ++unseen;
        if (!is_asked(start + column)) continue;
        ++asked;
        if (shown_for(column) == start + column) ++shaded;
    }}
    const int stride = out_counts.shape[1];
    const int counts[{COUNTED}] = {{surfaces, unseen, asked, moving, shaded}};
    for (int k = 0; k < {COUNTED}; ++k) out_counts.data[k * stride + r] = counts[k];
"""
    )
)
def count_row(
    r: int,
    place: LocalPlace,
    step: int,
    missing: int,
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    out_counts: wp.array2d(dtype=int),
): ...


@wp.kernel
def count_rows_kernel(
    first: int,
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    step: int,
    missing: int,
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    out_counts: wp.array2d(dtype=int),
):
    """As `local_shading.count_asked_kernel`."""
    r = first + wp.tid()
    count_row(r, places[row_map[r]], step, missing, triangle, state, out_counts)


@wp.func_native(
    vector.snippet(
        ROW
        + RADIANCE_DIRECTION
        + r"""
    const V eye = spread(place.eye);
    int columns[LANES];
    int waiting = 0;
    auto send = [&]() {
        I own = I(0);
        EACH_LANE own[l] = columns[l < waiting ? l : 0];
        const F u = (2.0f * __builtin_convertvector(own, F) + 1.0f) / (float)(n) - 1.0f;
        const F v = F((2.0f * (float)(y) + 1.0f) / (float)(n) - 1.0f);
        const F one = F(1.0f);
        const V towards = radiance_direction(face, u, v);
        const F length = __builtin_elementwise_sqrt(dot(towards, towards));
        const V d = V{towards.x / length, towards.y / length, towards.z / length};
        const I tri = igather(triangle.data + start, own);
        V p0, p1, p2;
        corners(records.data, tri, p0, p1, p2);
        // shapes.intersect_triangle, clamp_weights
        const V a = sub(p0, eye), b = sub(p1, eye), c = sub(p2, eye);
        const F eu = dot(cross(sub(c, a), add(c, a)), d);
        const F ev = dot(cross(sub(a, b), add(a, b)), d);
        const F ew = dot(cross(sub(b, c), add(b, c)), d);
        const F det = eu + ev + ew;
        const I there = det != 0.0f;
        const F inverse = 1.0f / pick(there, det, one);
        F wu = fmax(eu * inverse, F(0.0f)), wv = fmax(ev * inverse, F(0.0f));
        const F total = wu + wv;
        wu = pick(total > 1.0f, wu / total, wu);
        wv = pick(total > 1.0f, wv / total, wv);
        wu = pick(there, wu, F(1.0f / 3.0f));
        wv = pick(there, wv, F(1.0f / 3.0f));
        const V p = add(eye, times(gather(distance.data + start, own), d));
        float* points = (float*)out_point.data;
        float* directions = (float*)out_direction.data;
        EACH_LANE if (l < waiting) {
            const int j = hit_number + l;
            out_pixel.data[j] = start - place.first_texel + own[l];
            out_triangle.data[j] = tri[l];
            out_u.data[j] = wu[l];
            out_v.data[j] = wv[l];
            points[3 * j] = p.x[l]; points[3 * j + 1] = p.y[l]; points[3 * j + 2] = p.z[l];
            directions[3 * j] = d.x[l]; directions[3 * j + 1] = d.y[l]; directions[3 * j + 2] = d.z[l];
        }
        hit_number += waiting;
        waiting = 0;
    };
    for (int column = 0; column < n; ++column) {
        int number = not_asked;
        if (is_asked(start + column)) {
            const int source = shown_for(column);
            number = -2 - source;
            if (source == start + column) {
                number = hit_number + waiting;
                columns[waiting++] = column;
                if (waiting == LANES) send();
            }
        }
        out_number.data[start + column] = number;
    }
    if (waiting > 0) send();
"""
    )
)
def hits_of_row(
    r: int,
    place: LocalPlace,
    records: wp.array(dtype=float),
    step: int,
    missing: int,
    hit_number: int,
    not_asked: int,
    distance: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    out_number: wp.array(dtype=int),
    out_pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
): ...


@wp.kernel
def hits_of_rows_kernel(
    first: int,
    records: wp.array(dtype=float),
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    step: int,
    missing: int,
    counts: wp.array2d(dtype=int),
    row_first: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    state: wp.array(dtype=wp.uint8),
    # Outputs:
    out_number: wp.array(dtype=int),
    out_pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    """As `local_shading.shaded_hits_kernel`."""
    r = first + wp.tid()
    if counts[ASKED, r] > 0:
        hits_of_row(
            r,
            places[row_map[r]],
            records,
            step,
            missing,
            row_first[r],
            NOT_ASKED,
            distance,
            triangle,
            state,
            out_number,
            out_pixel,
            out_point,
            out_direction,
            out_triangle,
            out_u,
            out_v,
        )


@wp.func_native(
    vector.snippet(
        rf"""
    const int start = place.first_texel + (r - place.first_row) * place.resolution;
    float* radiances = (float*)out_radiance.data;
    for (int t = start; t < start + place.resolution; ++t) {{
        int k = number.data[t];
        if (k == not_asked) continue;
        if (k < 0) k = number.data[-2 - k];
        const float* found = (const float*)radiance.data + 3 * k;
        const bool fine = __builtin_isfinite(found[0]) && __builtin_isfinite(found[1]) && __builtin_isfinite(found[2]);
        for (int c = 0; c < 3; ++c) radiances[4 * t + c] = fine ? found[c] : 0.0f;
        radiances[4 * t + 3] = 1.0f;
        out_state.data[t] = {TEXEL_SHADED};
    }}
"""
    )
)
def put_row(
    r: int,
    place: LocalPlace,
    not_asked: int,
    number: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec4),
    out_state: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def put_rows_kernel(
    first: int,
    places: wp.array(dtype=LocalPlace),
    row_map: wp.array(dtype=int),
    counts: wp.array2d(dtype=int),
    number: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    # Changed:
    out_radiance: wp.array(dtype=wp.vec4),
    out_state: wp.array(dtype=wp.uint8),
):
    """As `local_shading.put_radiance_kernel`."""
    r = first + wp.tid()
    if counts[ASKED, r] > 0:
        put_row(r, places[row_map[r]], NOT_ASKED, number, radiance, out_radiance, out_state)
