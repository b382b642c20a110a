"""Text that the vector searches share: what comes after a reflection point is found, and how a reflector map is read.

Each piece is the device function named above it for a vector of elements, with the same operations in the same order. They
follow the head of `vector.snippet` and name the arguments `frame`, `camera` and, of a map, `map` of the function around them.
"""

from __future__ import annotations

# What every search begins with.
UNIT_FRAME = r"""
    const V eye = spread(frame.eye);
    auto root = [](F a) -> F { return __builtin_elementwise_sqrt(a); };
    auto magnitude = [](F a) -> F { return __builtin_elementwise_abs(a); };
    auto length = [&](V a) -> F { return root(dot(a, a)); };
    auto over = [](V a, F s) -> V { return V{a.x / s, a.y / s, a.z / s}; };
    auto matrix = [&](const auto& m, V a) -> V {
        return V{m.data[0][0] * a.x + m.data[0][1] * a.y + m.data[0][2] * a.z,
            m.data[1][0] * a.x + m.data[1][1] * a.y + m.data[1][2] * a.z,
            m.data[2][0] * a.x + m.data[2][1] * a.y + m.data[2][2] * a.z};
    };
    (void)root; (void)magnitude; (void)length; (void)over; (void)matrix;
"""

# What every search ends with: `vertices.edge_reach`, `vertices.virtual_vertex`, `layers.project`.
VIRTUAL_VERTEX = (
    UNIT_FRAME
    + r"""
    // optics.safe_normalize
    auto safe = [&](V a, F& big) -> I {
        big = size(a);
        const F total = 0.25f * magnitude(a.x) + 0.25f * magnitude(a.y) + 0.25f * magnitude(a.z);
        return (big > 0.0f) & (total - total == 0.0f);
    };
    auto safe_normalize = [&](V a) -> V {
        F big;
        const I fine = safe(a, big);
        const V s = over(a, big);
        return vpick(fine, over(s, length(s)), same(0.0f));
    };
    auto safe_length = [&](V a) -> F {
        F big;
        const I fine = safe(a, big);
        return pick(fine, big * length(over(a, big)), F(0.0f));
    };
    // optics.tangent_basis
    auto tangents = [&](V n, V& t1, V& t2) {
        const F sign = pick(n.z < 0.0f, F(-1.0f), F(1.0f));
        const F a = -1.0f / (sign + n.z);
        const F both = n.x * n.y * a;
        t1 = V{1.0f + sign * n.x * n.x * a, sign * both, -sign * n.x};
        t2 = V{both, sign + n.y * n.y * a, -n.y};
    };
    // vertices.edge_reach
    auto edge_reach = [&](V p, V n, V target, F curvature) -> F {
        const V to_eye = sub(eye, p);
        const F d_o = length(to_eye), d_v = length(sub(target, p));
        const F per_o = 1.0f / fmax(d_o, F(1.0e-20f));
        const F cosine = magnitude(dot(n, to_eye)) * per_o;
        const F least = cosine * cosine * (per_o + 1.0f / fmax(d_v, F(1.0e-20f))) + 2.0f * cosine * curvature;
        return d_v * root(estimate * d_o * least);
    };
    // vertices.virtual_vertex
    auto virtual_vertex = [&](V p, V n, V target) -> V {
        const V to_eye = sub(eye, p), to_target = sub(target, p);
        const F a = length(to_eye), b = length(to_target), radius = fmax(length(p), F(1.0e-6f));
        const F c_a = magnitude(dot(to_eye, n));
        const F behind = dot(to_target, n);
        const I flat = (c_a + c_a) * b < (a + b) * radius;
        V q = sub(sub(target, times(behind + behind, n)), eye);
        // The reciprocal is edge_reach's.
        if (bits(~flat)) q = vpick(flat, q, times(1.0f + b * (1.0f / fmax(a, F(1.0e-20f))), sub(same(0.0f), to_eye)));
        const I squared = (fmin(a, b) > squared_min) & (fmax(a, b) < squared_max);
        if (bits(~squared)) {
            // optics.virtual_point
            const F a_length = safe_length(to_eye), b_length = safe_length(to_target);
            const I as_plane = (c_a + c_a) * (1.0f / radius) * b_length < a_length + b_length;
            const V other = vpick(as_plane, sub(target, times(behind + behind, n)),
                add(p, times(b_length, safe_normalize(sub(p, eye)))));
            q = vpick(squared, q, sub(other, eye));
        }
        return matrix(frame.eye_from_unit, q);
    };
    // layers.project, and the answer of one lane
    typedef unsigned char Bytes __attribute__((ext_vector_type(LANES)));
    unsigned char* status = (unsigned char*)out_vertex.status.data;
    float* screen = (float*)out_vertex.screen.data;
    float* seeds = (float*)out_vertex.seed.data;
    float* positions = (float*)out_vertex.position.data;
    const bool placed = out_vertex.position.shape[0] > 0;
    struct Answer { I status; F x, y, key, depth, reach, residual; V seed, place; };
    auto answered = [&](I answer, V seed, F residual, V image, F reach) -> Answer {
        const F depth = dot(spread(camera.forward), image);
        F x = camera.x_row[0] * image.x + camera.x_row[1] * image.y + camera.x_row[2] * image.z + camera.x_row[3];
        F y = camera.y_row[0] * image.x + camera.y_row[1] * image.y + camera.y_row[2] * image.z + camera.y_row[3];
        const I before = depth < camera.near;
        F key;
        if (camera.orthographic != 0) {
            key = pick(before, F(0.0f), 1.0f - depth / camera.far);
        } else {
            const F inv = 1.0f / depth;
            key = pick(before, F(0.0f), inv);
            x = pick(before, x, x * inv);
            y = pick(before, y, y * inv);
        }
        return Answer{answer, x, y, key, depth, reach, residual, seed, image};
    };
    auto side_by_side = [&](I vertex) -> bool { return bits(vertex == vertex[0] + lanes()) == bits(I(-1)); };
    // Of vertices side by side, all of which are answered, or are to be answered later, if only by a status.
    auto put = [&](int at, I done, const Answer& a) {
        const Bytes byte = __builtin_convertvector(a.status, Bytes);
        __builtin_memcpy(status + at, &byte, sizeof(byte));
        float* reach = (float*)out_vertex.reach.data + at;
        store(reach, pick(done, a.reach, load(reach)));
        store((float*)out_vertex.residual.data + at, a.residual);
        vstore4(screen, at, V{a.x, a.y, a.key}, a.depth);
        vstore(seeds, at, a.seed);
        if (placed) vstore(positions, at, a.place);
    };
    auto put_each = [&](I done, I vertex, const Answer& a) {
        // By memory: the compiler would store a whole vector for every lane that is taken out of it.
        float reach[LANES], residual[LANES], row[4 * LANES], seed[3 * LANES], place[3 * LANES];
        int to[LANES], as[LANES];
        store(reach, a.reach);
        store(residual, a.residual);
        vstore4(row, 0, V{a.x, a.y, a.key}, a.depth);
        vstore(seed, 0, a.seed);
        if (placed) vstore(place, 0, a.place);
        istore(to, vertex);
        istore(as, a.status);
        for (unsigned left = bits(done); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left), i = to[l];
            status[i] = (unsigned char)as[l];
            out_vertex.reach.data[i] = reach[l];
            out_vertex.residual.data[i] = residual[l];
            __builtin_memcpy(screen + 4 * i, row + 4 * l, 4 * sizeof(float));
            __builtin_memcpy(seeds + 3 * i, seed + 3 * l, 3 * sizeof(float));
            if (placed) __builtin_memcpy(positions + 3 * i, place + 3 * l, 3 * sizeof(float));
        }
    };
    auto settle = [&](I done, I answer, I vertex, V seed, F residual, V image, F reach) {
        const Answer a = answered(answer, seed, residual, image, reach);
        if (bits(done) == bits(I(-1)) && side_by_side(vertex)) put(vertex[0], done, a);
        else put_each(done, vertex, a);
    };
    (void)safe_normalize; (void)safe_length; (void)tangents; (void)edge_reach; (void)virtual_vertex; (void)settle; (void)seeds;
"""
)

# `reflector_maps.sample_map`, after either.
MAP_SAMPLES = r"""
    const V inv_extent = spread(map.inv_extent);
    const float* texels = (const float*)map.texels.data;
    const int resolution = map.resolution;
    const float scale = 0.5f * (float)(resolution - 1);
    // cubemap.project_to_cube
    auto project_to_cube = [&](V x) -> V {
        const F m = size(x);
        return vpick(m == 0.0f, V{F(1.0f), F(0.0f), F(0.0f)}, times(1.0f / m, x));
    };
    auto whole = [&](F f) -> I {
        I i = __builtin_convertvector(f, I);
        i = ipick(i < 0, I(0), i);
        return ipick(i > resolution - 2, I(resolution - 2), i);
    };
    // reflector_maps.map_cell
    struct Cell { I texel; F a, b; };
    auto map_cell = [&](V x) -> Cell {
        const F ax = magnitude(x.x), ay = magnitude(x.y), az = magnitude(x.z);
        const I on_x = (ax >= ay) & (ax >= az), on_y = ay >= az;
        const F major = pick(on_x, x.x, pick(on_y, x.y, x.z));
        const F u = pick(on_x, x.y, pick(on_y, x.z, x.x)), v = pick(on_x, x.z, pick(on_y, x.x, x.y));
        const I face = ipick(on_x, I(0), ipick(on_y, I(2), I(4))) - (major < 0.0f);
        const F fu = (u + 1.0f) * scale, fv = (v + 1.0f) * scale;
        const I i = whole(fu), j = whole(fv);
        return Cell{8 * ((face * resolution + j) * resolution + i),
            fu - __builtin_convertvector(i, F), fv - __builtin_convertvector(j, F)};
    };
    struct Sample { V p, p_u, p_v, n, n_u, n_v; };
    auto sample_cell = [&](const Cell& cell) -> Sample {
        const I at = cell.texel;
        const F a = cell.a, b = cell.b;
        F t00[8], t01[8], t10[8], t11[8];
        gather8(texels, at, t00);
        gather8(texels + 8, at, t01);
        gather8(texels + 8 * resolution, at, t10);
        gather8(texels + 8 * resolution + 8, at, t11);
        auto three = [](const F* t) -> V { return V{t[0], t[1], t[2]}; };
        auto between = [&](int k, V& value, V& by_u, V& by_v) {
            const V c00 = three(t00 + k), c10 = three(t10 + k);
            const V d0 = sub(three(t01 + k), c00), d1 = sub(three(t11 + k), c10);
            const V low = add(c00, times(a, d0)), high = add(c10, times(a, d1));
            by_v = sub(high, low);
            value = add(low, times(b, by_v));
            by_u = add(times(1.0f - b, d0), times(b, d1));
        };
        Sample s;
        V raw, n_u, n_v;
        between(0, s.p, s.p_u, s.p_v);
        between(4, raw, n_u, n_v);
        const F inv = 1.0f / fmax(length(raw), F(1.0e-20f));
        s.n = times(inv, raw);
        s.n_u = times(inv, n_u);
        s.n_v = times(inv, n_v);
        return s;
    };
    auto least_mask = [&](V x) -> F {
        const I at = map_cell(x).texel + 3;
        const float* below = texels + 8 * resolution;
        return fmin(fmin(gather(texels, at), gather(texels + 8, at)), fmin(gather(below, at), gather(below + 8, at)));
    };
    auto sample = [&](V x) -> Sample { return sample_cell(map_cell(x)); };
    (void)sample; (void)least_mask;
"""

# After that, `map_search.is_visible`.
IS_VISIBLE = r"""
    const V white_eye = product(eye, inv_extent);
    auto is_visible = [&](I asked, V target) __attribute__((always_inline)) -> I {
        const V white = product(target, inv_extent);
        const V d = sub(white, white_eye);
        F t = clip(-dot(white_eye, d) / fmax(dot(d, d), F(1.0e-30f)), 0.0f, 1.0f);
        const F nearest = length(add(white_eye, times(t, d)));
        I visible = nearest > map.outer_radius;
        I open = asked & ~visible & ~(nearest < map.inner_radius);
        if (!bits(open)) return visible;
        const V direction = sub(target, eye);
        F low = F(0.0f), high = F(1.0f);
        for (int k = 0; k < gauge_steps && bits(open); ++k) {
            const V w = add(white_eye, times(t, d));
            const Sample s = sample(project_to_cube(w));
            open &= ~(length(w) < (1.0f + gauge_inside) * length(product(s.p, inv_extent)));
            const V plane = cross(s.p_u, s.p_v);
            const F height = dot(plane, s.p), side = pick(height < 0.0f, F(-1.0f), F(1.0f));
            const F level = (1.0f + gauge_inside) * side * height;
            const I before = open & (side * dot(plane, eye) > level) & (side * dot(plane, target) > level);
            visible |= before;
            open &= ~before;
            const I falls = dot(s.n, direction) < 0.0f;
            low = pick(falls, t, low);
            high = pick(falls, high, t);
            const I ended = open & ((low >= 1.0f) | (high <= 0.0f));
            visible |= ended;
            open &= ~ended;
            t = 0.5f * (low + high);
        }
        return visible | open;
    };
    (void)is_visible;
"""

# After those samples, of `map_search`: `measure`, `newton_step`, `step_on_cube`.
MAP_STEPS = r"""
    struct Law { F inv_o, inv_v, inv_w, residual, cos_eye, cos_target; };
    // reflector_maps.slide
    auto slide = [&](const Sample& s, F along_u, F along_v) -> Sample {
        Sample moved;
        moved.p = add(add(s.p, times(along_u, s.p_u)), times(along_v, s.p_v));
        const V raw = add(add(s.n, times(along_u, s.n_u)), times(along_v, s.n_v));
        moved.n = times(1.0f / fmax(length(raw), F(1.0e-20f)), raw);
        return moved;
    };
    auto measure = [&](const Sample& s, V target) -> Law {
        const V to_eye = sub(eye, s.p), to_target = sub(target, s.p);
        Law law;
        law.inv_o = 1.0f / fmax(length(to_eye), F(1.0e-20f));
        law.inv_v = 1.0f / fmax(length(to_target), F(1.0e-20f));
        const V o = times(law.inv_o, to_eye), v = times(law.inv_v, to_target);
        law.cos_eye = dot(s.n, o);
        law.cos_target = dot(s.n, v);
        const F w_n = law.cos_eye + law.cos_target;
        const V w_t = sub(add(o, v), times(w_n, s.n));
        law.inv_w = 1.0f / w_n;
        law.residual = pick(w_n > normal_part_min, length(w_t) * law.inv_w, 1.0e4f - w_n);
        return law;
    };
    // Directions are calculated again: what a vector keeps of an evaluation takes as long to write as to find.
    auto newton_step = [&](const Sample& s, const Law& law, V target) -> V {
        const F inv_o = law.inv_o, inv_v = law.inv_v, n_o = law.cos_eye, n_v = law.cos_target, w_n = n_o + n_v;
        const V n = s.n, o = times(inv_o, sub(eye, s.p)), v = times(inv_v, sub(target, s.p));
        const V w_t = sub(add(o, v), times(w_n, n));
        const F n_1 = dot(n, s.p_u), n_2 = dot(n, s.p_v);
        const F o1 = dot(o, s.p_u) - n_o * n_1, o2 = dot(o, s.p_v) - n_o * n_2;
        const F v1 = dot(v, s.p_u) - n_v * n_1, v2 = dot(v, s.p_v) - n_v * n_2;
        const F e = dot(s.p_u, s.p_u) - n_1 * n_1, f = dot(s.p_u, s.p_v) - n_1 * n_2, g = dot(s.p_v, s.p_v) - n_2 * n_2;
        const F s11 = fmax(dot(s.n_u, s.p_u), F(0.0f)), s22 = fmax(dot(s.n_v, s.p_v), F(0.0f));
        F s12 = 0.5f * (dot(s.n_u, s.p_v) + dot(s.n_v, s.p_u));
        const I bent = s12 * s12 > convex_share * (s11 * s22);
        if (bits(bent)) {
            const F bound = root(s11 * s22);
            s12 = pick(bent, fmin(fmax(s12, -bound), bound), s12);
        }
        const F k = fmax(w_n, F(0.0f)), both = inv_o + inv_v;
        const F i_o1 = o1 * inv_o, i_o2 = o2 * inv_o, i_v1 = v1 * inv_v, i_v2 = v2 * inv_v;
        const F h11 = e * both - o1 * i_o1 - v1 * i_v1 + k * s11;
        const F h22 = g * both - o2 * i_o2 - v2 * i_v2 + k * s22;
        const F h12 = f * both - o1 * i_o2 - v1 * i_v2 + k * s12;
        const F g1 = o1 + v1, g2 = o2 + v2;
        const F det_h = h11 * h22 - h12 * h12;
        const F inv_w = law.inv_w;
        const F q1 = (dot(s.n_u, w_t) + n_o * i_o1 + n_v * i_v1) * inv_w;
        const F q2 = (dot(s.n_v, w_t) + n_o * i_o2 + n_v * i_v2) * inv_w;
        const F j11 = h11 + g1 * q1, j12 = h12 + g1 * q2, j21 = h12 + g2 * q1, j22 = h22 + g2 * q2;
        const F det_j = j11 * j22 - j12 * j21;
        const I full = (w_n > normal_part_min) & (det_j > spd_share * det_h) & (det_j > 0.0f);
        const F det = pick(full, det_j, det_h);
        const F inv = pick(det > det_min, 1.0f / det, F(0.0f));
        const F d1 = (pick(full, j22, h22) * g1 - pick(full, j12, h12) * g2) * inv;
        const F d2 = (pick(full, j11, h11) * g2 - pick(full, j21, h12) * g1) * inv;
        return add(times(d1, s.p_u), times(d2, s.p_v));
    };
    auto step_on_cube = [&](V x, V p, V step, F shrink) -> V {
        const V whitened = product(p, inv_extent), move = product(step, inv_extent);
        F cap = F(1.0f);
        // Hardly ever: what is no longer than nearly so much is not cut.
        if (bits(dot(move, move) > 0.98f * step_cap * step_cap * dot(whitened, whitened)))
            cap = fmin(cap, step_cap * length(whitened) / fmax(length(move), F(1.0e-30f)));
        return project_to_cube(add(times(size(whitened), x), times(cap * shrink, move)));
    };
    (void)slide;
"""
