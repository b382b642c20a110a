"""Rays in vectors through a whole triangle BVH of Warp, widened: the answers of `wp.mesh_query_ray` and its `_anyhit`.

A vector's rays go down the tree together: a node is read once for all, each ray's own box and triangle tests are those of
Warp in the same arithmetic, and a ray takes part only where it would have come alone. Rays that point about the same way
share most of the way. `packets.py` goes down from any node of the tree as Warp has it.

Sources: Wald et al., Interactive Rendering with Coherent Ray Tracing, Eurographics 2001 (packets with a mask of active
rays); Boulos, Wald and Shirley, Geometric and Arithmetic Culling Methods for Entire Ray Packets, 2006 (intervals of starts and
inverse directions, here against the eight children of a node and the triangles of a leaf at once); Woop, Benthin and Wald,
Watertight Ray/Triangle Intersection, JCGT 2013, as in warp/native/intersect.h. The tree is Warp's own, widened
(`wide_tree.py`). Intervals only leave out what no ray meets: they are bounds of the rounded numbers too, as rounding keeps
order, and wider by more than the triangle test's own rounding.

Answers: the same bits for what is met at all. The nearest triangle is the same but where two are met at the same distance
to the last digit or two: which of them is tested first depends on the way.
"""

from __future__ import annotations

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`.
TRAVERSAL = r"""
    const unsigned long long* tree = (const unsigned long long*)mesh_id;
    const float* tree_boxes = (const float*)tree[1];
    const int* tree_children = (const int*)tree[2];
    const float* tree_corners = (const float*)tree[3];
    const int* tree_faces = (const int*)tree[4];
    typedef int RowMask __attribute__((ext_vector_type(8)));
    typedef bool RowBits __attribute__((ext_vector_type(8)));
    typedef float Four __attribute__((ext_vector_type(4)));
    typedef int FourMask __attribute__((ext_vector_type(4)));
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)tree[0];
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
        constexpr bool NEAREST = decltype(nearest)::value;
#define EACH_GROUP _Pragma("clang loop unroll(full)") for (int g = 0; g < GROUPS; ++g)
        struct Ray { V o, inverse; F sx, sy, sz, ox, oy, oz; I kx, ky, kz, zero_x, zero_y, zero_z; } ray[GROUPS];
        I left[GROUPS], octant[GROUPS];
        EACH_GROUP {
            Ray& r = ray[g];
            left[g] = live[g];
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
            octant[g] = ipick(d[g].x < 0.0f, I(1), I(0)) + ipick(d[g].y < 0.0f, I(2), I(0)) + ipick(d[g].z < 0.0f, I(4), I(0));
        }
        while (true) {
            // Rays of one octant at a time.
            I mask[GROUPS];
            int signs = -1, cx = 0, cy = 0, cz = 0;
            bool no_zeros = true, one_axis = true;
            EACH_GROUP {
                const unsigned all = bits(left[g]);
                if (signs < 0 && all) {
                    const int lead = __builtin_ctz(all);
                    signs = octant[g][lead];
                    cx = ray[g].kx[lead]; cy = ray[g].ky[lead]; cz = ray[g].kz[lead];
                }
            }
            if (signs < 0) return;
            EACH_GROUP {
                const Ray& r = ray[g];
                mask[g] = left[g] & (octant[g] == signs);
                left[g] &= ~mask[g];
                one_axis &= !bits(mask[g] & ((r.kz != cz) | (r.kx != cx)));
                no_zeros &= !bits(mask[g] & (r.zero_x | r.zero_y | r.zero_z));
            }
            const bool down_x = signs & 1, down_y = signs & 2, down_z = signs & 4;
            auto least = [&](auto of) -> float {
                F v = F(3.0e38f);
                EACH_GROUP v = fmin(pick(mask[g], of(g), F(3.0e38f)), v);
                return __builtin_reduce_min(v);
            };
            auto most = [&](auto of) -> float {
                F v = F(-3.0e38f);
                EACH_GROUP v = fmax(pick(mask[g], of(g), F(-3.0e38f)), v);
                return __builtin_reduce_max(v);
            };
            const auto& root_low = tree_mesh.bvh.node_lowers[*tree_mesh.bvh.root];
            const auto& root_high = tree_mesh.bvh.node_uppers[*tree_mesh.bvh.root];
            // All of the rays at once, as intervals of starts and inverse directions.
            struct Span { float enter_from, leave_from, low, high; };
            float width = 0.0f;
            auto span = [&](auto start, auto inverse, float low, float high) -> Span {
                const float first = least(start), last = most(start);
                const float away = last - low > high - first ? last - low : high - first;
                width = width > away ? width : away;
                return Span{last, first, least(inverse), most(inverse)};
            };
            Span by_x = span([&](int g) { return ray[g].o.x; }, [&](int g) { return ray[g].inverse.x; }, root_low.x, root_high.x);
            Span by_y = span([&](int g) { return ray[g].o.y; }, [&](int g) { return ray[g].inverse.y; }, root_low.y, root_high.y);
            Span by_z = span([&](int g) { return ray[g].o.z; }, [&](int g) { return ray[g].inverse.z; }, root_low.z, root_high.z);
            const float margin = 1.0e-6f * width + 1.0e-30f;
            auto widen = [&](Span& by, bool down) {
                const float first = by.leave_from - margin, last = by.enter_from + margin;
                by.enter_from = down ? first : last;
                by.leave_from = down ? last : first;
            };
            widen(by_x, down_x); widen(by_y, down_y); widen(by_z, down_z);
            auto meets = [&](const Span& by, auto in, auto out, auto& enter, auto& leave) {
                const auto a = in - by.enter_from, b = out - by.leave_from;
                const auto a_low = a * by.low, a_high = a * by.high, b_low = b * by.low, b_high = b * by.high;
                const auto first = a_low < a_high ? a_low : a_high;
                const auto last = b_low > b_high ? b_low : b_high;
                enter = first > enter ? first : enter;
                leave = last < leave ? last : leave;
            };
            float far = most([&](int g) { return met[g].t; });
            auto box = [&](const Ray& r, F far, const float* of) -> I {
                F enter, leave;
                if (no_zeros) {
                    enter = (of[down_x ? 24 : 0] - r.o.x) * r.inverse.x;
                    leave = (of[down_x ? 0 : 24] - r.o.x) * r.inverse.x;
                    enter = fmax((of[down_y ? 32 : 8] - r.o.y) * r.inverse.y, enter);
                    leave = fmin((of[down_y ? 8 : 32] - r.o.y) * r.inverse.y, leave);
                    enter = fmax((of[down_z ? 40 : 16] - r.o.z) * r.inverse.z, enter);
                    leave = fmin((of[down_z ? 16 : 40] - r.o.z) * r.inverse.z, leave);
                } else {
                    enter = F(-3.402823466e38f);
                    leave = F(3.402823466e38f);
                    auto slab = [&](float l, float h, F from, F factor, I zero) {
                        const F a = (l - from) * factor, b = (h - from) * factor;
                        // Along a slab: in it for ever, or never.
                        const I past = (from < l) | (from > h);
                        const F first = pick(zero, pick(past, F(3.402823466e38f), F(-3.402823466e38f)), fmin(a, b));
                        const F last = pick(zero, F(3.402823466e38f), fmax(a, b));
                        enter = fmax(first, enter);
                        leave = fmin(last, leave);
                    };
                    slab(of[0], of[24], r.o.x, r.inverse.x, r.zero_x);
                    slab(of[8], of[32], r.o.y, r.inverse.y, r.zero_y);
                    slab(of[16], of[40], r.o.z, r.inverse.z, r.zero_z);
                }
                return (leave >= 0.0f) & (leave >= enter) & (enter < far);
            };
            // a * b - c * d, intersect.h's way.
            auto difference = [](F a, F b, F c, F e) -> F {
                const F ce = c * e;
                return __builtin_elementwise_fma(a, b, -ce) + __builtin_elementwise_fma(-c, e, ce);
            };
            // `at`: x of the first corner; the other numbers follow four by four.
            auto triangle = [&](int face, const float* at, const Ray& r, I asked, Met& best) -> I {
                F a_x, a_y, a_z, b_x, b_y, b_z, c_x, c_y, c_z;
                if (one_axis) {
                    a_x = at[4 * cx] - r.ox; a_y = at[4 * cy] - r.oy; a_z = at[4 * cz] - r.oz;
                    b_x = at[4 * cx + 12] - r.ox; b_y = at[4 * cy + 12] - r.oy; b_z = at[4 * cz + 12] - r.oz;
                    c_x = at[4 * cx + 24] - r.ox; c_y = at[4 * cy + 24] - r.oy; c_z = at[4 * cz + 24] - r.oz;
                } else {
                    auto turn_axes = [&](const float* p, F& x, F& y, F& z) {
                        const F px = p[0] - r.o.x, py = p[4] - r.o.y, pz = p[8] - r.o.z;
                        x = component(r.kx, px, py, pz);
                        y = component(r.ky, px, py, pz);
                        z = component(r.kz, px, py, pz);
                    };
                    turn_axes(at, a_x, a_y, a_z);
                    turn_axes(at + 12, b_x, b_y, b_z);
                    turn_axes(at + 24, c_x, c_y, c_z);
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
            constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE * 8;
            struct Waiting { int child; float enter; } waiting[DEEPEST];
            int waiting_count = 0, node = 0;
            while (node >= 0) {
                const float* boxes = tree_boxes + 48 * node;
                auto row = [&](int k) -> Row { Row v; __builtin_memcpy(&v, boxes + k, sizeof(v)); return v; };
                Row enter = Row(0.0f), leave = Row(3.0e38f);
                meets(by_x, row(down_x ? 24 : 0), row(down_x ? 0 : 24), enter, leave);
                meets(by_y, row(down_y ? 32 : 8), row(down_y ? 8 : 32), enter, leave);
                meets(by_z, row(down_z ? 40 : 16), row(down_z ? 16 : 40), enter, leave);
                const RowMask passed = (leave >= enter) & (enter < far);
                unsigned found = __builtin_bit_cast(unsigned char, __builtin_convertvector(passed < 0, RowBits));
                float entered[8];
                __builtin_memcpy(entered, &enter, sizeof(entered));
                const int from = waiting_count;
                for (; found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found);
                    int place = waiting_count++;
                    for (; place > from && waiting[place - 1].enter < entered[slot]; --place) waiting[place] = waiting[place - 1];
                    waiting[place] = Waiting{8 * node + slot, entered[slot]};
                }
                node = -1;
                while (waiting_count > 0) {
                    const Waiting next = waiting[--waiting_count];
                    if (next.enter >= far) continue;
                    const int child = tree_children[next.child];
                    if (child == 0) continue;
                    I asked[GROUPS], any = I(0);
                    EACH_GROUP {
                        asked[g] = mask[g] & box(ray[g], met[g].t, tree_boxes + 48 * (next.child >> 3) + (next.child & 7));
                        any |= asked[g];
                    }
                    if (!bits(any)) continue;
                    if (child >= 0) { node = child; break; }
                    I changed = I(0);
                    for (int chunk = ~child;; ++chunk) {
                        const float* corners = tree_corners + 36 * chunk;
                        const int* faces = tree_faces + 8 * chunk;
                        auto four = [&](int k) -> Four { Four v; __builtin_memcpy(&v, corners + k, sizeof(v)); return v; };
                        Four in = Four(0.0f), out = Four(3.0e38f);
                        auto side = [&](const Span& by, int axis, bool down) {
                            const Four a = four(4 * axis), b = four(4 * axis + 12), c = four(4 * axis + 24);
                            const Four ab_low = a < b ? a : b, ab_high = a > b ? a : b;
                            const Four low = ab_low < c ? ab_low : c, high = ab_high > c ? ab_high : c;
                            meets(by, down ? high : low, down ? low : high, in, out);
                        };
                        side(by_x, 0, down_x); side(by_y, 1, down_y); side(by_z, 2, down_z);
                        FourMask own;
                        __builtin_memcpy(&own, faces, sizeof(own));
                        const FourMask may = (out >= in) & (in < far) & (own >= 0);
                        unsigned some = 0;
                        for (int k = 0; k < 4; ++k) some |= (may[k] & 1) << k;
                        for (; some != 0; some &= some - 1) {
                            const int k = __builtin_ctz(some);
                            EACH_GROUP {
                                if (!bits(asked[g])) continue;
                                const I hit = triangle(faces[k], corners + k, ray[g], asked[g], met[g]);
                                changed |= hit;
                                if constexpr (!NEAREST) { mask[g] &= ~hit; asked[g] &= ~hit; }
                            }
                        }
                        if (!faces[4]) break;
                    }
                    if (!bits(changed)) continue;
                    if constexpr (NEAREST) {
                        far = most([&](int g) { return met[g].t; });
                    } else {
                        any = I(0);
                        EACH_GROUP any |= mask[g];
                        if (!bits(any)) waiting_count = 0;
                    }
                }
            }
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
