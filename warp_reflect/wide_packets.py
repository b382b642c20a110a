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

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`. What all walks down it share.
TREE = (
    RAYS
    + r"""
    const unsigned long long* tree = (const unsigned long long*)mesh_id;
    const float* tree_nodes = (const float*)tree[1];
    const float* tree_chunks = (const float*)tree[2];
    typedef int RowMask __attribute__((ext_vector_type(8)));
    typedef bool RowBits __attribute__((ext_vector_type(8)));
    typedef int FourMask __attribute__((ext_vector_type(4)));
    struct Chunk { enum { value = 4 }; };
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)tree[0];
    // Warp's builders end a branch one short of its stack; a tree of groups has such trees under another.
    constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE * 8;
    // One number for each of eight directions.
    auto octant_of = [&](V d) -> I {
        return ipick(d.x < 0.0f, I(1), I(0)) + ipick(d.y < 0.0f, I(2), I(0)) + ipick(d.z < 0.0f, I(4), I(0));
    };
    // Rays of one octant, all at once, as intervals of starts and inverse directions.
    struct Span { float enter_from, leave_from, low, high; };
    struct Bundle { bool down_x, down_y, down_z, no_zeros; Span x, y, z; };
    // The least and the most of them: vectors whose lanes are folded here.
    struct Extremes { V first, last, low, high; F furthest; };
    auto nothing_yet = [&]() -> Extremes {
        return Extremes{same(3.0e38f), same(-3.0e38f), same(3.0e38f), same(-3.0e38f), F(0.0f)};
    };
    auto take_in = [&](Extremes& all, I own, const Way& r, F reach) {
        auto least = [&](F v, F& of) { of = fmin(pick(own, v, F(3.0e38f)), of); };
        auto most = [&](F v, F& of) { of = fmax(pick(own, v, F(-3.0e38f)), of); };
        least(r.o.x, all.first.x); least(r.o.y, all.first.y); least(r.o.z, all.first.z);
        most(r.o.x, all.last.x); most(r.o.y, all.last.y); most(r.o.z, all.last.z);
        least(r.inverse.x, all.low.x); least(r.inverse.y, all.low.y); least(r.inverse.z, all.low.z);
        most(r.inverse.x, all.high.x); most(r.inverse.y, all.high.y); most(r.inverse.z, all.high.z);
        most(reach, all.furthest);
    };
    auto bundle_of = [&](const Extremes& all, int signs, bool no_zeros) -> Bundle {
        Bundle by{(signs & 1) != 0, (signs & 2) != 0, (signs & 4) != 0, no_zeros};
        const auto& root_low = tree_mesh.bvh.node_lowers[*tree_mesh.bvh.root];
        const auto& root_high = tree_mesh.bvh.node_uppers[*tree_mesh.bvh.root];
        float width = 0.0f;
        auto span = [&](F first, F last, F low, F high, float root_least, float root_most) -> Span {
            const float least = folded(first, lesser), most = folded(last, larger);
            const float away = most - root_least > root_most - least ? most - root_least : root_most - least;
            width = width > away ? width : away;
            return Span{most, least, folded(low, lesser), folded(high, larger)};
        };
        by.x = span(all.first.x, all.last.x, all.low.x, all.high.x, root_low.x, root_high.x);
        by.y = span(all.first.y, all.last.y, all.low.y, all.high.y, root_low.y, root_high.y);
        by.z = span(all.first.z, all.last.z, all.low.z, all.high.z, root_low.z, root_high.z);
        const float margin = 1.0e-6f * width + 1.0e-30f;
        auto widen = [&](Span& of, bool down) {
            const float first = of.leave_from - margin, last = of.enter_from + margin;
            of.enter_from = down ? first : last;
            of.leave_from = down ? last : first;
        };
        widen(by.x, by.down_x); widen(by.y, by.down_y); widen(by.z, by.down_z);
        return by;
    };
    // Where the first of them may enter between two planes, and the last leave; and about where they all have entered, and
    // where none has left.
    auto meets_all = [&](const Span& by, auto in, auto out, auto& enter, auto& leave, auto& all_in, auto& none_out) {
        const auto a = in - by.enter_from, b = out - by.leave_from;
        const auto a_low = a * by.low, a_high = a * by.high, b_low = b * by.low, b_high = b * by.high;
        const auto first = a_low < a_high ? a_low : a_high, late = a_low > a_high ? a_low : a_high;
        const auto last = b_low > b_high ? b_low : b_high, early = b_low < b_high ? b_low : b_high;
        enter = first > enter ? first : enter;
        leave = last < leave ? last : leave;
        all_in = late > all_in ? late : all_in;
        none_out = early < none_out ? early : none_out;
    };
    auto meets = [&](const Span& by, auto in, auto out, auto& enter, auto& leave) {
        auto all_in = enter, none_out = leave;
        meets_all(by, in, out, enter, leave, all_in, none_out);
    };
    // Which of a node's eight children some of the rays may meet nearer than `far`, a bit each, and where they enter them;
    // `all`: those that about all of the rays meet, at any distance.
    auto children_met = [&](const Bundle& by, const float* boxes, float far, Row& enter, unsigned& all) -> unsigned {
        auto row = [&](int k) -> Row { Row v; __builtin_memcpy(&v, boxes + k, sizeof(v)); return v; };
        Row leave = Row(3.0e38f), all_in = Row(0.0f), none_out = Row(3.0e38f);
        enter = Row(0.0f);
        meets_all(by.x, row(by.down_x ? 24 : 0), row(by.down_x ? 0 : 24), enter, leave, all_in, none_out);
        meets_all(by.y, row(by.down_y ? 32 : 8), row(by.down_y ? 8 : 32), enter, leave, all_in, none_out);
        meets_all(by.z, row(by.down_z ? 40 : 16), row(by.down_z ? 16 : 40), enter, leave, all_in, none_out);
        auto marked_bits = [](RowMask of) -> unsigned {
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(of < 0, RowBits));
        };
        all = marked_bits(none_out >= all_in);
        return marked_bits((leave >= enter) & (enter < far));
    };
    // A child is on its way while others are asked.
    auto fetch = [&](int child) {
        const float* next = child > 0 ? tree_nodes + 64 * child : tree_chunks + 48 * ~child;
        __builtin_prefetch(next);
        __builtin_prefetch(next + 16);
        __builtin_prefetch(next + 32);
    };
    // Which rays of a vector meet the box of a child, at `of`, nearer than `far`.
    auto box_met = [&](const Bundle& by, const Way& r, F far, const float* of) -> I {
        F enter, leave;
        if (by.no_zeros) {
            enter = (of[by.down_x ? 24 : 0] - r.o.x) * r.inverse.x;
            leave = (of[by.down_x ? 0 : 24] - r.o.x) * r.inverse.x;
            enter = fmax((of[by.down_y ? 32 : 8] - r.o.y) * r.inverse.y, enter);
            leave = fmin((of[by.down_y ? 8 : 32] - r.o.y) * r.inverse.y, leave);
            enter = fmax((of[by.down_z ? 40 : 16] - r.o.z) * r.inverse.z, enter);
            leave = fmin((of[by.down_z ? 16 : 40] - r.o.z) * r.inverse.z, leave);
        } else {
            enter = F(-3.402823466e38f);
            leave = F(3.402823466e38f);
            slab(of[0], of[24], r.o.x, r.inverse.x, r.zero_x, enter, leave);
            slab(of[8], of[32], r.o.y, r.inverse.y, r.zero_y, enter, leave);
            slab(of[16], of[40], r.o.z, r.inverse.z, r.zero_z, enter, leave);
        }
        return (leave >= 0.0f) & (leave >= enter) & (enter < far);
    };
    // Which of a chunk's four triangles some of the rays may meet nearer than `far`, by their boxes.
    auto triangles_met = [&](const Bundle& by, const float* corners, float far) -> unsigned {
        auto four = [&](int k) -> Four { Four v; __builtin_memcpy(&v, corners + k, sizeof(v)); return v; };
        Four in = Four(0.0f), out = Four(3.0e38f);
        auto side = [&](const Span& of, int axis, bool down) {
            const Four a = four(4 * axis), b = four(4 * axis + 12), c = four(4 * axis + 24);
            const Four ab_low = a < b ? a : b, ab_high = a > b ? a : b;
            const Four low = ab_low < c ? ab_low : c, high = ab_high > c ? ab_high : c;
            meets(of, down ? high : low, down ? low : high, in, out);
        };
        side(by.x, 0, by.down_x); side(by.y, 1, by.down_y); side(by.z, 2, by.down_z);
        FourMask faces;
        __builtin_memcpy(&faces, corners + 36, sizeof(faces));
        const FourMask may = (out >= in) & (in < far) & (faces >= 0);
        unsigned some = 0;
        for (int k = 0; k < 4; ++k) some |= (may[k] & 1) << k;
        return some;
    };
"""
)

# After `vector.snippet`'s head. Needs: `mesh_id`, as TREE. May set: `left_out`.
TRAVERSAL = (
    TREE
    + r"""
    // Branches that are passed by: `WideTree.branches_of`, or none.
    const unsigned char* left_out = 0;
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them: the first that each meets nearer than `reach`.
    auto find_nearest = [&](auto groups, const I* live, const V* o, const V* d, const F* reach, Met* met) {
        constexpr int GROUPS = decltype(groups)::value;
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
            octant[g] = octant_of(d[g]);
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
            Extremes all = nothing_yet();
            EACH_GROUP {
                const Way& r = ray[g];
                mask[g] = left[g] & (octant[g] == signs);
                left[g] &= ~mask[g];
                axes.one &= !bits(mask[g] & ((r.kz != axes.z) | (r.kx != axes.x)));
                no_zeros &= !bits(mask[g] & (r.zero_x | r.zero_y | r.zero_z));
                take_in(all, mask[g], r, met[g].t);
            }
            const Bundle by = bundle_of(all, signs, no_zeros);
            float far = folded(all.furthest, larger);
            // `child`: where it stands; inverted where a branch with other branches below it need not be asked ray by ray.
            struct Waiting { int child; float enter; } waiting[DEEPEST];
            int waiting_count = 0, node = 0;
            while (node >= 0) {
                const float* boxes = tree_nodes + 64 * node;
                const int* children = (const int*)(boxes + 48);
                Row enter;
                unsigned all_meet, found = children_met(by, boxes, far, enter, all_meet);
                if (left_out) found &= ~left_out[node];
                float entered[8];
                __builtin_memcpy(entered, &enter, sizeof(entered));
                const int from = waiting_count;
                for (; found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found), child = children[slot];
                    if (child == 0) continue;
                    fetch(child);
                    int place = waiting_count++;
                    for (; place > from && waiting[place - 1].enter < entered[slot]; --place) waiting[place] = waiting[place - 1];
                    const int stands = 64 * node + slot;
                    waiting[place] = Waiting{child > 0 && all_meet >> slot & 1 ? ~stands : stands, entered[slot]};
                }
                node = -1;
                while (waiting_count > 0) {
                    const Waiting next = waiting[--waiting_count];
                    if (next.enter >= far) continue;
                    const float* of = tree_nodes + (next.child < 0 ? ~next.child : next.child);
                    const int child = ((const int*)of)[48];
                    if (next.child < 0) { node = child; break; }
                    I asked[GROUPS], any = I(0);
                    if (alone) {
                        EACH_GROUP asked[g] = I(0);
                        asked[0] = any = mask[0] & box_met(by, ray[0], met[0].t, of);
                    } else {
                        EACH_GROUP {
                            asked[g] = mask[g] & box_met(by, ray[g], met[g].t, of);
                            any |= asked[g];
                        }
                    }
                    if (!bits(any)) continue;
                    if (child >= 0) { node = child; break; }
                    I changed = I(0);
                    for (int chunk = ~child;; ++chunk) {
                        const float* corners = tree_chunks + 48 * chunk;
                        const int* faces = (const int*)(corners + 36);
                        for (unsigned some = triangles_met(by, corners, far); some != 0; some &= some - 1) {
                            const int k = __builtin_ctz(some);
                            EACH_GROUP {
                                if (!bits(asked[g])) continue;
                                changed |= meet_triangle(Nearest{}, Chunk{}, faces[k], corners + k, corners + 12 + k,
                                    corners + 24 + k, axes, ray[g], asked[g], met[g]);
                            }
                        }
                        if (!faces[4]) break;
                    }
                    if (!bits(changed)) continue;
                    F furthest = F(-3.0e38f);
                    EACH_GROUP furthest = fmax(pick(mask[g], met[g].t, F(-3.0e38f)), furthest);
                    far = folded(furthest, larger);
                }
            }
        }
    };
"""
)
