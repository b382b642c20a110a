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
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them, which meet what is nearer than `reach`. `nearest`: the
    // first of it; otherwise a lane is done with the first thing found, and only whether there is one is told (`face`).
    auto traverse = [&](auto nearest, auto groups, const I* live, const V* o, const V* d, const F* reach, Met* met) {
        constexpr int GROUPS = decltype(groups)::value;
#define EACH_GROUP _Pragma("clang loop unroll(full)") for (int g = 0; g < GROUPS; ++g)
        struct Ray { V o, inverse; F sx, sy, sz, ox, oy, oz; I kx, ky, kz, zero_x, zero_y, zero_z; } ray[GROUPS];
        I mask[GROUPS], open[GROUPS];
        bool no_zeros = true, one_axis = true, one_way = true;
        int cx = -1, cy = 0, cz = 0;
        unsigned low_x = 0, low_y = 0, low_z = 0, high_x = 0, high_y = 0, high_z = 0;
        EACH_GROUP {
            Ray& r = ray[g];
            mask[g] = open[g] = live[g];
            met[g] = Met{I(-1), reach[g], F(0.0f), F(0.0f)};
            r.o = o[g];
            r.zero_x = d[g].x == 0.0f; r.zero_y = d[g].y == 0.0f; r.zero_z = d[g].z == 0.0f;
            r.inverse = V{1.0f / pick(r.zero_x, F(1.0e-20f), d[g].x), 1.0f / pick(r.zero_y, F(1.0e-20f), d[g].y),
                1.0f / pick(r.zero_z, F(1.0e-20f), d[g].z)};
            // intersect_ray_tri_woop's constants of a ray.
            const F ax = __builtin_elementwise_abs(d[g].x), ay = __builtin_elementwise_abs(d[g].y);
            I kz = ipick(ay > ax, I(1), I(0));
            kz = ipick(__builtin_elementwise_abs(d[g].z) > fmax(ax, ay), I(2), kz);
            const I after = ipick(kz == 2, I(0), kz + 1), before = ipick(kz == 0, I(2), kz - 1);
            const F dz = component(kz, d[g].x, d[g].y, d[g].z);
            r.kx = ipick(dz < 0.0f, before, after);
            r.ky = ipick(dz < 0.0f, after, before);
            r.kz = kz;
            r.sx = component(r.kx, d[g].x, d[g].y, d[g].z) / dz;
            r.sy = component(r.ky, d[g].x, d[g].y, d[g].z) / dz;
            r.sz = 1.0f / dz;
            r.ox = component(r.kx, o[g].x, o[g].y, o[g].z);
            r.oy = component(r.ky, o[g].x, o[g].y, o[g].z);
            r.oz = component(r.kz, o[g].x, o[g].y, o[g].z);
            const unsigned all = bits(live[g]);
            if (!all) continue;
            if (cx < 0) {
                const int lead = __builtin_ctz(all);
                cx = r.kx[lead]; cy = r.ky[lead]; cz = r.kz[lead];
            }
            one_axis &= !bits(live[g] & ((r.kz != cz) | (r.kx != cx)));
            no_zeros &= !bits(live[g] & (r.zero_x | r.zero_y | r.zero_z));
            low_x |= bits(live[g] & (d[g].x < 0.0f)); high_x |= bits(live[g] & (d[g].x > 0.0f));
            low_y |= bits(live[g] & (d[g].y < 0.0f)); high_y |= bits(live[g] & (d[g].y > 0.0f));
            low_z |= bits(live[g] & (d[g].z < 0.0f)); high_z |= bits(live[g] & (d[g].z > 0.0f));
        }
        if (cx < 0) return;
        one_way = no_zeros && !(low_x && high_x) && !(low_y && high_y) && !(low_z && high_z);
        // Where rays enter and leave a box: its planes by the sign that they share.
        const BVHPackedNodeHalf* in_x = low_x ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_y = low_y ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_z = low_z ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* out_x = low_x ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_y = low_y ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_z = low_z ? node_lowers : node_uppers;
        auto box = [&](const Ray& r, F far, int node, F& enter) -> I {
            F leave;
            if (one_way) {
                enter = (in_x[node].x - r.o.x) * r.inverse.x;
                leave = (out_x[node].x - r.o.x) * r.inverse.x;
                enter = fmax((in_y[node].y - r.o.y) * r.inverse.y, enter);
                leave = fmin((out_y[node].y - r.o.y) * r.inverse.y, leave);
                enter = fmax((in_z[node].z - r.o.z) * r.inverse.z, enter);
                leave = fmin((out_z[node].z - r.o.z) * r.inverse.z, leave);
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
                slab(low.x, high.x, r.o.x, r.inverse.x, r.zero_x);
                slab(low.y, high.y, r.o.y, r.inverse.y, r.zero_y);
                slab(low.z, high.z, r.o.z, r.inverse.z, r.zero_z);
            }
            return (leave >= 0.0f) & (leave >= enter) & (enter < far);
        };
        // a * b - c * d, intersect.h's way.
        auto difference = [](F a, F b, F c, F e) -> F {
            const F ce = c * e;
            return __builtin_elementwise_fma(a, b, -ce) + __builtin_elementwise_fma(-c, e, ce);
        };
        auto triangle = [&](int face, const Ray& r, I asked, Met& best) -> I {
            const float* a = tree_points + 3 * tree_corners[3 * face];
            const float* b = tree_points + 3 * tree_corners[3 * face + 1];
            const float* c = tree_points + 3 * tree_corners[3 * face + 2];
            F a_x, a_y, a_z, b_x, b_y, b_z, c_x, c_y, c_z;
            if (one_axis) {
                a_x = a[cx] - r.ox; a_y = a[cy] - r.oy; a_z = a[cz] - r.oz;
                b_x = b[cx] - r.ox; b_y = b[cy] - r.oy; b_z = b[cz] - r.oz;
                c_x = c[cx] - r.ox; c_y = c[cy] - r.oy; c_z = c[cz] - r.oz;
            } else {
                auto turn_axes = [&](const float* p, F& x, F& y, F& z) {
                    const F px = p[0] - r.o.x, py = p[1] - r.o.y, pz = p[2] - r.o.z;
                    x = component(r.kx, px, py, pz);
                    y = component(r.ky, px, py, pz);
                    z = component(r.kz, px, py, pz);
                };
                turn_axes(a, a_x, a_y, a_z);
                turn_axes(b, b_x, b_y, b_z);
                turn_axes(c, c_x, c_y, c_z);
            }
            const F Ax = a_x - r.sx * a_z, Ay = a_y - r.sy * a_z;
            const F Bx = b_x - r.sx * b_z, By = b_y - r.sy * b_z;
            const F Cx = c_x - r.sx * c_z, Cy = c_y - r.sy * c_z;
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
            if (!bits(hit)) return hit;
            const F along = edge_u * (r.sz * a_z) + edge_v * (r.sz * b_z) + edge_w * (r.sz * c_z);
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
        // Warp's builders end a branch one short of its stack; a tree of groups has such trees under another.
        constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE;
        struct Waiting { I mask[GROUPS]; F enter[GROUPS]; int node; } waiting[DEEPEST];
        int waiting_count = 0;
        int node = *tree_mesh.bvh.root;
        while (true) {
            const int first = node_lowers[node].i, second = node_uppers[node].i;
            if (node_lowers[node].b) {
                for (int k = first; k < second; ++k) {
                    const int face = tree_primitives[k];
                    I rest = I(0);
                    EACH_GROUP {
                        const I hit = triangle(face, ray[g], mask[g], met[g]);
                        if constexpr (!decltype(nearest)::value) {
                            mask[g] &= ~hit;
                            open[g] &= ~hit;
                            rest |= mask[g];
                        }
                    }
                    if constexpr (!decltype(nearest)::value) if (!bits(rest)) break;
                }
                if constexpr (!decltype(nearest)::value) {
                    I rest = I(0);
                    EACH_GROUP rest |= open[g];
                    if (!bits(rest)) return;
                }
            } else {
                F enter_first[GROUPS], enter_second[GROUPS];
                I to_first[GROUPS], to_second[GROUPS], any_first = I(0), any_second = I(0);
                EACH_GROUP {
                    to_first[g] = mask[g] & box(ray[g], met[g].t, first, enter_first[g]);
                    to_second[g] = mask[g] & box(ray[g], met[g].t, second, enter_second[g]);
                    any_first |= to_first[g];
                    any_second |= to_second[g];
                }
                const bool ask_first = bits(any_first) != 0, ask_second = bits(any_second) != 0;
                if (ask_first && ask_second) {
                    if (waiting_count == DEEPEST) return;
                    int balance = 0;
                    EACH_GROUP {
                        const I both = to_first[g] & to_second[g];
                        balance += __builtin_popcount(bits(both & (enter_first[g] < enter_second[g])));
                        balance -= __builtin_popcount(bits(both & (enter_first[g] >= enter_second[g])));
                    }
                    const bool first_now = balance > 0;
                    Waiting& later = waiting[waiting_count++];
                    later.node = first_now ? second : first;
                    node = first_now ? first : second;
                    EACH_GROUP {
                        const I now = I(first_now ? -1 : 0);
                        later.mask[g] = ipick(now, to_second[g], to_first[g]);
                        if constexpr (decltype(nearest)::value)
                            later.enter[g] = pick(now, enter_second[g], enter_first[g]);
                        mask[g] = ipick(now, to_first[g], to_second[g]);
                    }
                    continue;
                }
                if (ask_first || ask_second) {
                    node = ask_first ? first : second;
                    EACH_GROUP mask[g] = ask_first ? to_first[g] : to_second[g];
                    continue;
                }
            }
            I rest;
            do {
                if (waiting_count == 0) return;
                const Waiting& next = waiting[--waiting_count];
                node = next.node;
                rest = I(0);
                EACH_GROUP {
                    if constexpr (decltype(nearest)::value) mask[g] = next.mask[g] & (next.enter[g] < met[g].t);
                    else mask[g] = next.mask[g] & open[g];
                    rest |= mask[g];
                }
            } while (!bits(rest));
        }
    };
    struct Nearest { enum { value = 1 }; };
    struct Any { enum { value = 0 }; };
    struct One { enum { value = 1 }; };
    struct Two { enum { value = 2 }; };
    auto first_met = [&](I live, V o, V d, F reach) -> Met {
        Met met;
        traverse(Nearest{}, One{}, &live, &o, &d, &reach, &met);
        return met;
    };
    auto is_met = [&](I live, V o, V d, F reach) -> I {
        Met met;
        traverse(Any{}, One{}, &live, &o, &d, &reach, &met);
        return met.face >= 0;
    };
    auto first_met_by = [&](const I* live, const V* o, const V* d, const F* reach, Met* met) {
        traverse(Nearest{}, Two{}, live, o, d, reach, met);
    };
    auto is_met_by = [&](const I* live, const V* o, const V* d, const F* reach, I* blocked) {
        Met met[2];
        traverse(Any{}, Two{}, live, o, d, reach, met);
        for (int g = 0; g < 2; ++g) blocked[g] = met[g].face >= 0;
    };
    (void)first_met; (void)is_met; (void)first_met_by; (void)is_met_by;
    (void)flushed;
"""
