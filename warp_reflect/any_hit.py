"""Rays in vectors that only ask whether anything is in their way: shadow rays, as many together as a block has points.

As `wide_packets.py`, which has the sources, down the same tree, by the same tests and so with the same answers; what differs
is made for such rays. More of them go together: a node is read, or left out, for all of them once, and an inner one is entered
as soon as one vector of them may meet it. Most of them reach the light, and have to go past all that lies around their way: in
which order does not matter to them, so none is made.
"""

from __future__ import annotations

from warp_reflect.wide_packets import TREE

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`.
ANY_HIT = (
    TREE
    + r"""
    constexpr int GROUPS = BLOCK / LANES;
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them: which meet something nearer than `reach`.
    auto find_blocked = [&](const I* live, const V* o, const V* d, const F* reach, I* blocked) {
        Way ray[GROUPS];
        I left[GROUPS], octant[GROUPS], mask[GROUPS];
        for (int g = 0; g < GROUPS; ++g) {
            left[g] = live[g];
            blocked[g] = I(0);
            ray[g] = way_of(o[g], d[g]);
            octant[g] = octant_of(d[g]);
        }
        while (true) {
            // Rays of one octant at a time: `some` are the vectors that have any.
            int some[GROUPS], some_count = 0;
            int signs = -1;
            Axes axes{true, 0, 0, 0};
            bool no_zeros = true;
            Extremes extremes = nothing_yet();
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
                take_in(extremes, own, r, reach[g]);
            }
            if (signs < 0) return;
            const Bundle by = bundle_of(extremes, signs, no_zeros);
            const float far = folded(extremes.furthest, larger);
            int waiting[DEEPEST], waiting_count = 0, node = 0;
            while (node >= 0) {
                const float* boxes = tree_nodes + 64 * node;
                const int* children = (const int*)(boxes + 48);
                Row enter;
                for (unsigned found = children_met(by, boxes, far, enter); found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found), child = children[slot];
                    if (child == 0) continue;
                    fetch(child);
                    waiting[waiting_count++] = 64 * node + slot;
                }
                node = -1;
                while (waiting_count > 0) {
                    const float* of = tree_nodes + waiting[--waiting_count];
                    const int child = ((const int*)of)[48];
                    auto asked_of = [&](int g) -> I { return mask[g] & box_met(by, ray[g], reach[g], of); };
                    if (child >= 0) {
                        for (int k = 0; k < some_count && node < 0; ++k) if (bits(asked_of(some[k]))) node = child;
                        if (node >= 0) break;
                        continue;
                    }
                    int asking[GROUPS], asking_count = 0;
                    I asked[GROUPS];
                    // All vectors at once: none waits for the branch of another.
                    EACH_GROUP asked[g] = asked_of(g);
                    EACH_GROUP if (bits(asked[g])) asking[asking_count++] = g;
                    if (asking_count == 0) continue;
                    bool changed = false;
                    for (int chunk = ~child;; ++chunk) {
                        const float* corners = tree_chunks + 48 * chunk;
                        for (unsigned met = triangles_met(by, corners, far); met != 0; met &= met - 1) {
                            const float* a = corners + __builtin_ctz(met);
                            for (int k = 0; k < asking_count; ++k) {
                                const int g = asking[k];
                                Met best{I(-1), reach[g], F(0.0f), F(0.0f)};
                                const I hit = meet_triangle(Any{}, Chunk{}, 0, a, a + 12, a + 24, axes, ray[g], asked[g], best);
                                if (!bits(hit)) continue;
                                asked[g] &= ~hit;
                                mask[g] &= ~hit;
                                blocked[g] |= hit;
                                changed = true;
                            }
                        }
                        if (!((const int*)corners)[40]) break;
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
"""
)
