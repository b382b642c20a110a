"""Rays in vectors that only ask whether anything is in their way: shadow rays, as many together as a block has points.

As `wide_packets.py`, which has the sources, down the same tree, by the same tests and so with the same answers; what differs
is made for such rays. More of them go together: a node is read, or left out, for all of them once, and an inner one is entered
as soon as one vector of them may meet it. Most of them reach the light, and have to go past all that lies around their way: in
which order does not matter to them, so none is made.
"""

from __future__ import annotations

from warp_reflect.packets import RAYS

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`.
ANY_HIT = (
    RAYS
    + r"""
    const unsigned long long* tree = (const unsigned long long*)mesh_id;
    const float* tree_nodes = (const float*)tree[1];
    const float* tree_chunks = (const float*)tree[2];
    typedef int RowMask __attribute__((ext_vector_type(8)));
    typedef bool RowBits __attribute__((ext_vector_type(8)));
    typedef int FourMask __attribute__((ext_vector_type(4)));
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)tree[0];
    constexpr int GROUPS = BLOCK / LANES;
    struct Chunk { enum { value = 4 }; };
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them: which meet something nearer than `reach`.
    auto find_blocked = [&](const I* live, const V* o, const V* d, const F* reach, I* blocked) {
        Way ray[GROUPS];
        I left[GROUPS], octant[GROUPS], mask[GROUPS];
        for (int g = 0; g < GROUPS; ++g) {
            left[g] = live[g];
            blocked[g] = I(0);
            ray[g] = way_of(o[g], d[g]);
            octant[g] = ipick(d[g].x < 0.0f, I(1), I(0)) + ipick(d[g].y < 0.0f, I(2), I(0)) + ipick(d[g].z < 0.0f, I(4), I(0));
        }
        while (true) {
            // Rays of one octant at a time: `some` are the vectors that have any.
            int some[GROUPS], some_count = 0;
            int signs = -1;
            Axes axes{true, 0, 0, 0};
            bool no_zeros = true;
            float far = 0.0f;
            F first_x = F(3.0e38f), first_y = first_x, first_z = first_x, low_x = first_x, low_y = first_x, low_z = first_x;
            F last_x = -first_x, last_y = last_x, last_z = last_x, high_x = last_x, high_y = last_x, high_z = last_x;
            F furthest = F(0.0f);
            for (int g = 0; g < GROUPS; ++g) {
                const unsigned all = bits(left[g]);
                mask[g] = I(0);
                if (!all) continue;
                const Way& r = ray[g];
                if (signs < 0) {
                    const int lead = __builtin_ctz(all);
                    signs = octant[g][lead];
                    axes.x = r.kx[lead]; axes.y = r.ky[lead]; axes.z = r.kz[lead];
                }
                const I own = left[g] & (octant[g] == signs);
                if (!bits(own)) continue;
                mask[g] = own;
                some[some_count++] = g;
                left[g] &= ~own;
                axes.one &= !bits(own & ((r.kz != axes.z) | (r.kx != axes.x)));
                no_zeros &= !bits(own & (r.zero_x | r.zero_y | r.zero_z));
                auto least = [&](F v, F& of) { of = fmin(pick(own, v, F(3.0e38f)), of); };
                auto most = [&](F v, F& of) { of = fmax(pick(own, v, F(-3.0e38f)), of); };
                least(r.o.x, first_x); least(r.o.y, first_y); least(r.o.z, first_z);
                most(r.o.x, last_x); most(r.o.y, last_y); most(r.o.z, last_z);
                least(r.inverse.x, low_x); least(r.inverse.y, low_y); least(r.inverse.z, low_z);
                most(r.inverse.x, high_x); most(r.inverse.y, high_y); most(r.inverse.z, high_z);
                most(reach[g], furthest);
            }
            if (signs < 0) return;
            far = folded(furthest, larger);
            const bool down_x = signs & 1, down_y = signs & 2, down_z = signs & 4;
            const auto& root_low = tree_mesh.bvh.node_lowers[*tree_mesh.bvh.root];
            const auto& root_high = tree_mesh.bvh.node_uppers[*tree_mesh.bvh.root];
            // All of the rays at once, as intervals of starts and inverse directions.
            struct Span { float enter_from, leave_from, low, high; };
            float width = 0.0f;
            auto span = [&](F first, F last, F low, F high, float root_least, float root_most) -> Span {
                const float a = folded(first, lesser), b = folded(last, larger);
                const float away = b - root_least > root_most - a ? b - root_least : root_most - a;
                width = width > away ? width : away;
                return Span{b, a, folded(low, lesser), folded(high, larger)};
            };
            Span by_x = span(first_x, last_x, low_x, high_x, root_low.x, root_high.x);
            Span by_y = span(first_y, last_y, low_y, high_y, root_low.y, root_high.y);
            Span by_z = span(first_z, last_z, low_z, high_z, root_low.z, root_high.z);
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
            auto box = [&](int g, const float* of) -> I {
                const Way& r = ray[g];
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
                return mask[g] & (leave >= 0.0f) & (leave >= enter) & (enter < reach[g]);
            };
            // Warp's builders end a branch one short of its stack; a tree of groups has such trees under another.
            constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE * 8;
            int waiting[DEEPEST], waiting_count = 0, node = 0;
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
                for (; found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found), child = children[slot];
                    if (child == 0) continue;
                    // On its way while others are asked.
                    const float* next = child > 0 ? tree_nodes + 64 * child : tree_chunks + 48 * ~child;
                    __builtin_prefetch(next);
                    __builtin_prefetch(next + 16);
                    __builtin_prefetch(next + 32);
                    waiting[waiting_count++] = 64 * node + slot;
                }
                node = -1;
                while (waiting_count > 0) {
                    const float* of = tree_nodes + waiting[--waiting_count];
                    const int child = ((const int*)of)[48];
                    if (child >= 0) {
                        for (int k = 0; k < some_count && node < 0; ++k) if (bits(box(some[k], of))) node = child;
                        if (node >= 0) break;
                        continue;
                    }
                    int asking[GROUPS], asking_count = 0;
                    I asked[GROUPS];
                    // All vectors at once: none waits for the branch of another.
                    EACH_GROUP asked[g] = box(g, of);
                    EACH_GROUP if (bits(asked[g])) asking[asking_count++] = g;
                    if (asking_count == 0) continue;
                    bool changed = false;
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
                        unsigned candidates = 0;
                        for (int k = 0; k < 4; ++k) candidates |= (may[k] & 1) << k;
                        for (; candidates != 0; candidates &= candidates - 1) {
                            const float* a = corners + __builtin_ctz(candidates);
                            for (int k = 0; k < asking_count; ++k) {
                                const int g = asking[k];
                                Met met{I(-1), reach[g], F(0.0f), F(0.0f)};
                                const I hit = meet_triangle(Any{}, Chunk{}, 0, a, a + 12, a + 24, axes, ray[g], asked[g], met);
                                if (!bits(hit)) continue;
                                asked[g] &= ~hit;
                                mask[g] &= ~hit;
                                blocked[g] |= hit;
                                changed = true;
                            }
                        }
                        if (!faces[4]) break;
                    }
                    if (!changed) continue;
                    int open = 0;
                    for (int k = 0; k < some_count; ++k) if (bits(mask[some[k]])) some[open++] = some[k];
                    some_count = open;
                    if (open == 0) waiting_count = 0;
                }
            }
        }
    };
    (void)find_blocked;
"""
)
