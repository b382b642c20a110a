"""Rays in vectors through a whole triangle BVH of Warp, widened: the answers of `wp.mesh_query_ray` and its `_anyhit`.

A vector's rays go down the tree together: a node is read once for all, each ray's own box and triangle tests are those of
Warp in the same arithmetic, and a ray takes part only where it would have come alone. Rays that point about the same way
share most of the way. A ray's constants and its test of a triangle are in `packets.py`.

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

from warp_reflect.packets import RAYS

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`. May set: `left_out`.
TRAVERSAL = (
    RAYS
    + r"""
    const unsigned long long* tree = (const unsigned long long*)mesh_id;
    const float* tree_nodes = (const float*)tree[1];
    const float* tree_chunks = (const float*)tree[2];
    typedef int RowMask __attribute__((ext_vector_type(8)));
    typedef bool RowBits __attribute__((ext_vector_type(8)));
    struct Chunk { enum { value = 4 }; };
    typedef int FourMask __attribute__((ext_vector_type(4)));
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)tree[0];
    // Branches that are passed by: `WideTree.branches_of`, or none.
    const unsigned char* left_out = 0;
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them, which meet what is nearer than `reach`. `nearest`: the
    // first of it; otherwise a lane is done with the first thing found, and only whether there is one is told (`face`).
    auto traverse = [&](auto nearest, auto groups, const I* live, const V* o, const V* d, const F* reach, Met* met) {
        constexpr int GROUPS = decltype(groups)::value;
        constexpr bool NEAREST = decltype(nearest)::value;
        Way ray[GROUPS];
        I left[GROUPS], octant[GROUPS];
        const bool alone = groups.first_alone();
        EACH_GROUP {
            left[g] = live[g];
            if (g > 0 && alone) {
                ray[g] = ray[0];
                octant[g] = I(0);
                met[g] = met[0];
                continue;
            }
            ray[g] = way_of(o[g], d[g]);
            met[g] = Met{I(-1), reach[g], F(0.0f), F(0.0f)};
            octant[g] = ipick(d[g].x < 0.0f, I(1), I(0)) + ipick(d[g].y < 0.0f, I(2), I(0)) + ipick(d[g].z < 0.0f, I(4), I(0));
        }
        while (true) {
            // Rays of one octant at a time.
            I mask[GROUPS];
            int signs = -1;
            Axes axes{true, 0, 0, 0};
            bool no_zeros = true;
            EACH_GROUP {
                const unsigned all = bits(left[g]);
                if (signs < 0 && all) {
                    const int lead = __builtin_ctz(all);
                    signs = octant[g][lead];
                    axes.x = ray[g].kx[lead]; axes.y = ray[g].ky[lead]; axes.z = ray[g].kz[lead];
                }
            }
            if (signs < 0) return;
            EACH_GROUP {
                const Way& r = ray[g];
                mask[g] = left[g] & (octant[g] == signs);
                left[g] &= ~mask[g];
                axes.one &= !bits(mask[g] & ((r.kz != axes.z) | (r.kx != axes.x)));
                no_zeros &= !bits(mask[g] & (r.zero_x | r.zero_y | r.zero_z));
            }
            const bool down_x = signs & 1, down_y = signs & 2, down_z = signs & 4;
            auto least = [&](auto of) -> float {
                F v = F(3.0e38f);
                EACH_GROUP v = fmin(pick(mask[g], of(g), F(3.0e38f)), v);
                return folded(v, lesser);
            };
            auto most = [&](auto of) -> float {
                F v = F(-3.0e38f);
                EACH_GROUP v = fmax(pick(mask[g], of(g), F(-3.0e38f)), v);
                return folded(v, larger);
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
            auto box = [&](const Way& r, F far, const float* of) -> I {
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
                    slab(of[0], of[24], r.o.x, r.inverse.x, r.zero_x, enter, leave);
                    slab(of[8], of[32], r.o.y, r.inverse.y, r.zero_y, enter, leave);
                    slab(of[16], of[40], r.o.z, r.inverse.z, r.zero_z, enter, leave);
                }
                return (leave >= 0.0f) & (leave >= enter) & (enter < far);
            };
            // Warp's builders end a branch one short of its stack; a tree of groups has such trees under another.
            constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE * 8;
            struct Waiting { int child; float enter; } waiting[DEEPEST];
            int waiting_count = 0, node = 0;
            while (node >= 0) {
                const float* boxes = tree_nodes + 64 * node;
                const int* children = (const int*)(boxes + 48);
                auto row = [&](int k) -> Row { Row v; __builtin_memcpy(&v, boxes + k, sizeof(v)); return v; };
                Row enter = Row(0.0f), leave = Row(3.0e38f);
                meets(by_x, row(down_x ? 24 : 0), row(down_x ? 0 : 24), enter, leave);
                meets(by_y, row(down_y ? 32 : 8), row(down_y ? 8 : 32), enter, leave);
                meets(by_z, row(down_z ? 40 : 16), row(down_z ? 16 : 40), enter, leave);
                const RowMask passed = (leave >= enter) & (enter < far);
                unsigned found = __builtin_bit_cast(unsigned char, __builtin_convertvector(passed < 0, RowBits));
                if (left_out) found &= ~left_out[node];
                float entered[8];
                __builtin_memcpy(entered, &enter, sizeof(entered));
                const int from = waiting_count;
                for (; found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found), child = children[slot];
                    if (child == 0) continue;
                    // On its way while others are asked.
                    const float* next = child > 0 ? tree_nodes + 64 * child : tree_chunks + 48 * ~child;
                    __builtin_prefetch(next);
                    __builtin_prefetch(next + 16);
                    __builtin_prefetch(next + 32);
                    int place = waiting_count++;
                    for (; place > from && waiting[place - 1].enter < entered[slot]; --place) waiting[place] = waiting[place - 1];
                    waiting[place] = Waiting{64 * node + slot, entered[slot]};
                }
                node = -1;
                while (waiting_count > 0) {
                    const Waiting next = waiting[--waiting_count];
                    if (next.enter >= far) continue;
                    const float* of = tree_nodes + next.child;
                    const int child = ((const int*)of)[48];
                    I asked[GROUPS], any = I(0);
                    if (alone) {
                        EACH_GROUP asked[g] = I(0);
                        asked[0] = any = mask[0] & box(ray[0], met[0].t, of);
                    } else {
                        EACH_GROUP {
                            asked[g] = mask[g] & box(ray[g], met[g].t, of);
                            any |= asked[g];
                        }
                    }
                    if (!bits(any)) continue;
                    if (child >= 0) { node = child; break; }
                    I changed = I(0);
                    for (int chunk = ~child;; ++chunk) {
                        const float* corners = tree_chunks + 48 * chunk;
                        const int* faces = (const int*)(corners + 36);
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
                                const I hit = meet_triangle(nearest, Chunk{}, faces[k], corners + k, corners + 12 + k,
                                    corners + 24 + k, axes, ray[g], asked[g], met[g]);
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
"""
)
