"""Rays in vectors through a triangle BVH of Warp: what `wp.mesh_query_ray` and `wp.mesh_query_ray_anyhit` answer ray by ray.

A vector's rays go down the tree together: a node is read once for all, each ray's own box and triangle tests are those of
Warp in the same arithmetic, and a ray takes part only where it would have come alone. Rays that point about the same way
share most of the way.

Sources: Wald et al., Interactive Rendering with Coherent Ray Tracing, Eurographics 2001 (packets with a mask of active
rays); Woop, Benthin and Wald, Watertight Ray/Triangle Intersection, JCGT 2013, as in warp/native/intersect.h. The tree is
Warp's own (warp/native/bvh.h): `missing` asks a small one before any picture depends on its layout.

Answers: the same bits for what is met at all. The nearest triangle is the same but where two are met at the same distance
to the last digit or two: which of them is tested first depends on the way.
"""

from __future__ import annotations

# After `vector.snippet`'s head. Needs: `mesh_id`.
TRAVERSAL = r"""
    using wp::BVHPackedNodeHalf;
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)mesh_id;
    const BVHPackedNodeHalf* node_lowers = tree_mesh.bvh.node_lowers;
    const BVHPackedNodeHalf* node_uppers = tree_mesh.bvh.node_uppers;
    const int* tree_primitives = tree_mesh.bvh.primitive_indices;
    const int* tree_corners = tree_mesh.indices.data;
    const float* tree_points = (const float*)tree_mesh.points.data;
    struct Met { I face; F t, u, v; };
    // bvh.flush_direction
    auto flushed = [&](V d) -> V {
        const F least = 1.0e-12f * size(d);
        auto flush = [&](F a) -> F { return pick(__builtin_elementwise_abs(a) < least, F(0.0f), a); };
        return V{flush(d.x), flush(d.y), flush(d.z)};
    };
    // One component of three, each lane its own.
    auto component = [&](I axis, F x, F y, F z) -> F { return pick(axis == 0, x, pick(axis == 1, y, z)); };
    // Lanes `live` of rays from `o` along `d`, which meet what is nearer than `reach`. `nearest`: the first of it; otherwise
    // a lane is done with the first thing found, and only whether there is one is told (`face`).
    auto traverse = [&](auto nearest, I live, V o, V d, F reach) -> Met {
        Met met{I(-1), reach, F(0.0f), F(0.0f)};
        if (!bits(live)) return met;
        const I zero_x = d.x == 0.0f, zero_y = d.y == 0.0f, zero_z = d.z == 0.0f;
        const V inverse = V{1.0f / pick(zero_x, F(1.0e-20f), d.x), 1.0f / pick(zero_y, F(1.0e-20f), d.y),
            1.0f / pick(zero_z, F(1.0e-20f), d.z)};
        // intersect_ray_tri_woop's constants of a ray.
        const F ax = __builtin_elementwise_abs(d.x), ay = __builtin_elementwise_abs(d.y), az = __builtin_elementwise_abs(d.z);
        I kz = ipick(ay > ax, I(1), I(0));
        kz = ipick(az > fmax(ax, ay), I(2), kz);
        I kx = ipick(kz == 2, I(0), kz + 1), ky = ipick(kz == 0, I(2), ipick(kz == 1, I(0), I(1)));
        const F dz = component(kz, d.x, d.y, d.z);
        const I turned = dz < 0.0f;
        const I kept = kx;
        kx = ipick(turned, ky, kx);
        ky = ipick(turned, kept, ky);
        const F sx = component(kx, d.x, d.y, d.z) / dz, sy = component(ky, d.x, d.y, d.z) / dz, sz = 1.0f / dz;
        const unsigned all = bits(live);
        const int lead = __builtin_ctz(all);
        const bool one_axis = !bits(live & ((kz != kz[lead]) | (kx != kx[lead])));
        const int cx = kx[lead], cy = ky[lead], cz = kz[lead];
        const F ox = component(kx, o.x, o.y, o.z), oy = component(ky, o.x, o.y, o.z), oz = component(kz, o.x, o.y, o.z);
        const bool no_zeros = !bits(live & (zero_x | zero_y | zero_z));
        auto alike = [&](F a) -> bool { const unsigned s = bits(live & (a < 0.0f)); return s == 0 || s == all; };
        const bool one_way = no_zeros && alike(d.x) && alike(d.y) && alike(d.z);
        // Where rays enter and leave a box: its planes by the sign that they share.
        const BVHPackedNodeHalf* in_x = d.x[lead] < 0.0f ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_y = d.y[lead] < 0.0f ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_z = d.z[lead] < 0.0f ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* out_x = d.x[lead] < 0.0f ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_y = d.y[lead] < 0.0f ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_z = d.z[lead] < 0.0f ? node_lowers : node_uppers;
        auto box = [&](int node, F& enter) -> I {
            F leave;
            if (one_way) {
                enter = (in_x[node].x - o.x) * inverse.x;
                leave = (out_x[node].x - o.x) * inverse.x;
                enter = fmax((in_y[node].y - o.y) * inverse.y, enter);
                leave = fmin((out_y[node].y - o.y) * inverse.y, leave);
                enter = fmax((in_z[node].z - o.z) * inverse.z, enter);
                leave = fmin((out_z[node].z - o.z) * inverse.z, leave);
            } else {
                const auto& low = node_lowers[node];
                const auto& high = node_uppers[node];
                enter = F(-3.402823466e38f);
                leave = F(3.402823466e38f);
                auto slab = [&](float l, float h, F from, F factor, I zero) {
                    const F a = (l - from) * factor, b = (h - from) * factor;
                    F first = fmin(a, b), last = fmax(a, b);
                    if (!no_zeros) {
                        // Along a slab: in it for ever, or never.
                        first = pick(zero, pick((from < l) | (from > h), F(3.402823466e38f), F(-3.402823466e38f)), first);
                        last = pick(zero, F(3.402823466e38f), last);
                    }
                    enter = fmax(first, enter);
                    leave = fmin(last, leave);
                };
                slab(low.x, high.x, o.x, inverse.x, zero_x);
                slab(low.y, high.y, o.y, inverse.y, zero_y);
                slab(low.z, high.z, o.z, inverse.z, zero_z);
            }
            return (leave >= 0.0f) & (leave >= enter) & (enter < met.t);
        };
        // a * b - c * d, intersect.h's way.
        auto difference = [](F a, F b, F c, F e) -> F {
            const F ce = c * e;
            return __builtin_elementwise_fma(a, b, -ce) + __builtin_elementwise_fma(-c, e, ce);
        };
        auto triangle = [&](int face, I mask) -> I {
            const float* a = tree_points + 3 * tree_corners[3 * face];
            const float* b = tree_points + 3 * tree_corners[3 * face + 1];
            const float* c = tree_points + 3 * tree_corners[3 * face + 2];
            F a_x, a_y, a_z, b_x, b_y, b_z, c_x, c_y, c_z;
            if (one_axis) {
                a_x = a[cx] - ox; a_y = a[cy] - oy; a_z = a[cz] - oz;
                b_x = b[cx] - ox; b_y = b[cy] - oy; b_z = b[cz] - oz;
                c_x = c[cx] - ox; c_y = c[cy] - oy; c_z = c[cz] - oz;
            } else {
                auto turn = [&](const float* p, F& x, F& y, F& z) {
                    const F px = p[0] - o.x, py = p[1] - o.y, pz = p[2] - o.z;
                    x = component(kx, px, py, pz);
                    y = component(ky, px, py, pz);
                    z = component(kz, px, py, pz);
                };
                turn(a, a_x, a_y, a_z);
                turn(b, b_x, b_y, b_z);
                turn(c, c_x, c_y, c_z);
            }
            const F Ax = a_x - sx * a_z, Ay = a_y - sy * a_z;
            const F Bx = b_x - sx * b_z, By = b_y - sy * b_z;
            const F Cx = c_x - sx * c_z, Cy = c_y - sy * c_z;
            F edge_u = difference(Cx, By, Cy, Bx), edge_v = difference(Ax, Cy, Ay, Cx), edge_w = difference(Bx, Ay, By, Ax);
            const unsigned exact = bits(mask & ((edge_u == 0.0f) | (edge_v == 0.0f) | (edge_w == 0.0f)));
            for (unsigned left = exact; left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left);
                edge_u[l] = (float)((double)Cx[l] * (double)By[l] - (double)Cy[l] * (double)Bx[l]);
                edge_v[l] = (float)((double)Ax[l] * (double)Cy[l] - (double)Ay[l] * (double)Cx[l]);
                edge_w[l] = (float)((double)Bx[l] * (double)Ay[l] - (double)By[l] * (double)Ax[l]);
            }
            const F low = fmin(fmin(edge_u, edge_v), edge_w), high = fmax(fmax(edge_u, edge_v), edge_w);
            const F det = edge_u + edge_v + edge_w;
            I hit = mask & ~((low < 0.0f) & (high > 0.0f)) & (det != 0.0f);
            if (!bits(hit)) return hit;
            const F along = edge_u * (sz * a_z) + edge_v * (sz * b_z) + edge_w * (sz * c_z);
            const F inverse_det = 1.0f / det;
            const F t = along * inverse_det;
            hit &= (pick(det < 0.0f, -along, along) >= 0.0f) & (t < met.t) & (t >= 0.0f);
            if constexpr (decltype(nearest)::value) {
                met.t = pick(hit, t, met.t);
                met.u = pick(hit, edge_u * inverse_det, met.u);
                met.v = pick(hit, edge_v * inverse_det, met.v);
            }
            met.face = ipick(hit, I(face), met.face);
            return hit;
        };
        // No deeper than Warp's own stack: its builders end a branch there.
        int waiting[BVH_QUERY_STACK_SIZE];
        I waiting_mask[BVH_QUERY_STACK_SIZE];
        F waiting_enter[BVH_QUERY_STACK_SIZE];
        int size_ = 0;
        int node = *tree_mesh.bvh.root;
        I mask = live;
        while (true) {
            const int first = node_lowers[node].i, second = node_uppers[node].i;
            if (node_lowers[node].b) {
                for (int k = first; k < second; ++k) {
                    const I hit = triangle(tree_primitives[k], mask);
                    if constexpr (!decltype(nearest)::value) {
                        mask &= ~hit;
                        live &= ~hit;
                        if (!bits(mask)) break;
                    }
                }
                if constexpr (!decltype(nearest)::value) if (!bits(live)) return met;
            } else {
                F enter_first, enter_second;
                const I to_first = mask & box(first, enter_first), to_second = mask & box(second, enter_second);
                const unsigned ask_first = bits(to_first), ask_second = bits(to_second);
                if (ask_first && ask_second) {
                    const unsigned both = ask_first & ask_second;
                    const unsigned nearer = bits(enter_first < enter_second);
                    const bool first_now = both ? 2 * __builtin_popcount(nearer & both) >= __builtin_popcount(both)
                        : __builtin_popcount(ask_first) >= __builtin_popcount(ask_second);
                    waiting[size_] = first_now ? second : first;
                    waiting_mask[size_] = first_now ? to_second : to_first;
                    waiting_enter[size_++] = first_now ? enter_second : enter_first;
                    node = first_now ? first : second;
                    mask = first_now ? to_first : to_second;
                    continue;
                }
                if (ask_first) { node = first; mask = to_first; continue; }
                if (ask_second) { node = second; mask = to_second; continue; }
            }
            do {
                if (size_ == 0) return met;
                --size_;
                node = waiting[size_];
                mask = waiting_mask[size_];
                if constexpr (decltype(nearest)::value) mask &= waiting_enter[size_] < met.t;
                else mask &= live;
            } while (!bits(mask));
        }
    };
    struct Nearest { enum { value = 1 }; };
    struct Any { enum { value = 0 }; };
    auto first_met = [&](I live, V o, V d, F reach) -> Met { return traverse(Nearest{}, live, o, d, reach); };
    auto is_met = [&](I live, V o, V d, F reach) -> I { return traverse(Any{}, live, o, d, reach).face >= 0; };
    (void)flushed; (void)first_met; (void)is_met;
"""
