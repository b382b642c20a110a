"""What rays in vectors share on their way through a triangle BVH of Warp: a ray's constants, and the test of a triangle.

Every ray's own tests are those of `wp.mesh_query_ray` in the same arithmetic: the same bits for what is met.

Source: Woop, Benthin and Wald, Watertight Ray/Triangle Intersection, JCGT 2013, as in warp/native/intersect.h.
"""

from __future__ import annotations

# After `vector.snippet`'s head.
RAYS = r"""
    // The least or the most of a vector, half by half: the compiler's own reduction minds NaN, one lane after the other.
    auto folded = [](F v, auto better) -> float {
#if defined(__AVX512F__)
        const Row eight = better(__builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7),
            __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15));
#else
        const Row eight = v;
#endif
        const Four four = better(__builtin_shufflevector(eight, eight, 0, 1, 2, 3),
            __builtin_shufflevector(eight, eight, 4, 5, 6, 7));
        const Four two = better(four, __builtin_shufflevector(four, four, 2, 3, 0, 1));
        return better(two, __builtin_shufflevector(two, two, 1, 0, 3, 2))[0];
    };
    auto lesser = [](auto a, auto b) { return a < b ? a : b; };
    auto larger = [](auto a, auto b) { return a > b ? a : b; };
    struct Met { I face; F t, u, v; };
    // ray_walk.flush_direction
    auto flushed = [&](V d) -> V {
        const F least = 1.0e-12f * size(d);
        auto flush = [&](F a) -> F { return pick(__builtin_elementwise_abs(a) < least, F(0.0f), a); };
        return V{flush(d.x), flush(d.y), flush(d.z)};
    };
    // One component of three, each lane its own.
    auto component = [&](I axis, F x, F y, F z) -> F { return pick(axis == 0, x, pick(axis == 1, y, z)); };
    struct Way { V o, inverse; F sx, sy, sz, ox, oy, oz; I kx, ky, kz, zero_x, zero_y, zero_z; };
    auto way_of = [&](V o, V d) -> Way {
        Way r;
        r.o = o;
        r.zero_x = d.x == 0.0f; r.zero_y = d.y == 0.0f; r.zero_z = d.z == 0.0f;
        r.inverse = V{1.0f / pick(r.zero_x, F(1.0e-20f), d.x), 1.0f / pick(r.zero_y, F(1.0e-20f), d.y),
            1.0f / pick(r.zero_z, F(1.0e-20f), d.z)};
        // intersect_ray_tri_woop's constants of a ray.
        const F ax = __builtin_elementwise_abs(d.x), ay = __builtin_elementwise_abs(d.y);
        I kz = ipick(ay > ax, I(1), I(0));
        kz = ipick(__builtin_elementwise_abs(d.z) > fmax(ax, ay), I(2), kz);
        const I after = ipick(kz == 2, I(0), kz + 1), before = ipick(kz == 0, I(2), kz - 1);
        const F dz = component(kz, d.x, d.y, d.z);
        r.kx = ipick(dz < 0.0f, before, after);
        r.ky = ipick(dz < 0.0f, after, before);
        r.kz = kz;
        r.sx = component(r.kx, d.x, d.y, d.z) / dz;
        r.sy = component(r.ky, d.x, d.y, d.z) / dz;
        r.sz = 1.0f / dz;
        r.ox = component(r.kx, o.x, o.y, o.z);
        r.oy = component(r.ky, o.x, o.y, o.z);
        r.oz = component(r.kz, o.x, o.y, o.z);
        return r;
    };
    // Between two planes of a box, where some rays may run along them.
    auto slab = [&](float l, float h, F from, F factor, I zero, F& enter, F& leave) {
        const F a = (l - from) * factor, b = (h - from) * factor;
        // Along a slab: in it for ever, or never.
        const I past = (from < l) | (from > h);
        const F first = pick(zero, pick(past, F(3.402823466e38f), F(-3.402823466e38f)), fmin(a, b));
        const F last = pick(zero, F(3.402823466e38f), fmax(a, b));
        enter = fmax(first, enter);
        leave = fmin(last, leave);
    };
    // a * b - c * d, intersect.h's way.
    auto difference = [](F a, F b, F c, F e) -> F {
        const F ce = c * e;
        return __builtin_elementwise_fma(a, b, -ce) + __builtin_elementwise_fma(-c, e, ce);
    };
    // The axes that all of some rays turn theirs to, where they do (`one`).
    struct Axes { bool one; int x, y, z; };
    // Corners from where rays start, on their own axes; `sx`, `sy`, `sz` are the rays'. `nearest`: what is met replaces
    // `best`; otherwise only its face does.
    auto meet_corners = [&](auto nearest, int face, V a, V b, V c, F sx, F sy, F sz, I asked, Met& best) -> I {
        const F Ax = a.x - sx * a.z, Ay = a.y - sy * a.z;
        const F Bx = b.x - sx * b.z, By = b.y - sy * b.z;
        const F Cx = c.x - sx * c.z, Cy = c.y - sy * c.z;
        F edge_u = difference(Cx, By, Cy, Bx), edge_v = difference(Ax, Cy, Ay, Cx), edge_w = difference(Bx, Ay, By, Ax);
        const unsigned exact = bits(asked & ((edge_u == 0.0f) | (edge_v == 0.0f) | (edge_w == 0.0f)));
        for (unsigned left = exact; left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            edge_u[l] = (float)((double)Cx[l] * (double)By[l] - (double)Cy[l] * (double)Bx[l]);
            edge_v[l] = (float)((double)Ax[l] * (double)Cy[l] - (double)Ay[l] * (double)Cx[l]);
            edge_w[l] = (float)((double)Bx[l] * (double)Ay[l] - (double)By[l] * (double)Ax[l]);
        }
        const F low = fmin(fmin(edge_u, edge_v), edge_w), high = fmax(fmax(edge_u, edge_v), edge_w);
        const F det = edge_u + edge_v + edge_w;
        I hit = asked & ~((low < 0.0f) & (high > 0.0f)) & (det != 0.0f);
        // Most that is asked is passed by: no need to divide.
        if constexpr (!decltype(nearest)::value) if (!bits(hit)) return hit;
        const F along = edge_u * (sz * a.z) + edge_v * (sz * b.z) + edge_w * (sz * c.z);
        const F inverse_det = 1.0f / det;
        const F t = along * inverse_det;
        hit &= (pick(det < 0.0f, -along, along) >= 0.0f) & (t < best.t) & (t >= 0.0f);
        if constexpr (decltype(nearest)::value) {
            best.t = pick(hit, t, best.t);
            best.u = pick(hit, edge_u * inverse_det, best.u);
            best.v = pick(hit, edge_v * inverse_det, best.v);
        }
        best.face = ipick(hit, I(face), best.face);
        return hit;
    };
    // `a`, `b`, `c`: x of the corners, the other numbers STRIDE after one another.
    auto meet_triangle = [&](auto nearest, auto stride, int face, const float* a, const float* b, const float* c,
                             const Axes& axes, const Way& r, I asked, Met& best) -> I {
        constexpr int STRIDE = decltype(stride)::value;
        V p0, p1, p2;
        if (axes.one) {
            const int x = STRIDE * axes.x, y = STRIDE * axes.y, z = STRIDE * axes.z;
            p0 = V{a[x] - r.ox, a[y] - r.oy, a[z] - r.oz};
            p1 = V{b[x] - r.ox, b[y] - r.oy, b[z] - r.oz};
            p2 = V{c[x] - r.ox, c[y] - r.oy, c[z] - r.oz};
        } else {
            auto turned = [&](const float* p) -> V {
                const F px = p[0] - r.o.x, py = p[STRIDE] - r.o.y, pz = p[2 * STRIDE] - r.o.z;
                return V{component(r.kx, px, py, pz), component(r.ky, px, py, pz), component(r.kz, px, py, pz)};
            };
            p0 = turned(a);
            p1 = turned(b);
            p2 = turned(c);
        }
        return meet_corners(nearest, face, p0, p1, p2, r.sx, r.sy, r.sz, asked, best);
    };
    struct Nearest { enum { value = 1 }; };
    struct Any { enum { value = 0 }; };
    struct One { enum { value = 1 }; };
    (void)flushed; (void)slab; (void)folded; (void)lesser; (void)larger;
#define EACH_GROUP _Pragma("clang loop unroll(full)") for (int g = 0; g < GROUPS; ++g)
"""
