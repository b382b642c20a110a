"""Rays in vectors that only ask whether anything is in their way: shadow rays, as many together as a block has points.

As `wide_packets.py`, down the same tree, by the same tests and so with the same answers; what differs is made for such rays.
More of them go together, and which of them meet a box is kept with it, a bit each: only those are asked further down. They end
close to each other, at a light: no ray leaves the hull of where they start and where they end, which leaves out more than
intervals of directions do where rays come together. In which order they meet things does not matter to them, so none is made.
A triangle is mostly asked by a few rays of each vector: those of all vectors go four abreast (two where vectors have eight
lanes) against four triangles. Where several packets go the same way, the tree's leaves in the hull of them all are looked up
once: each of the packets asks those, and no nodes above them.

Sources: Haines and Wallace, Shaft Culling for Efficient Ray-Traced Radiosity, Eurographics Workshop on Rendering 1991 (the hull
of two boxes); Boulos, Wald and Shirley, Geometric and Arithmetic Culling Methods for Entire Ray Packets, 2006. Other sources
are in `wide_packets.py`. The hull is that of rounded ends, and wider by more than the rounding of a triangle's test.
"""

from __future__ import annotations

from warp_reflect.wide_packets import TREE

# After `vector.snippet`'s head. Needs: `mesh_id`, the handle of a `WideTree`.
ANY_HIT = (
    TREE
    + r"""
    constexpr int GROUPS = BLOCK / LANES, ABREAST = LANES / 4;
    // A bit for each ray; those of a vector.
    typedef unsigned long long Rays;
    struct Waiting { int child; Rays rays; };
    auto part_of = [](Rays rays, int g) -> unsigned { return (LaneBits)(rays >> g * LANES); };
    auto marked = [lanes](unsigned marks) -> I { return (I(marks) << (31 - lanes())) < 0; };
    // How far from the origin the scene reaches, on any axis.
    float scene_width = 0.0f;
    {
        const auto& low = tree_mesh.bvh.node_lowers[*tree_mesh.bvh.root];
        const auto& high = tree_mesh.bvh.node_uppers[*tree_mesh.bvh.root];
        const float far[6] = {-low.x, -low.y, -low.z, high.x, high.y, high.z};
        for (int k = 0; k < 6; ++k) scene_width = scene_width > far[k] ? scene_width : far[k];
    }
    // The hull of a box around where rays start and one around where they end: between `low` and `high`, and within sides along
    // one axis past a corner of either box. `out_u`, `out_v` lead out of such a one on the other two, past `at`.
    struct Side { int row_u, row_v; float out_u, out_v, at; };
    struct Shaft { float low[3], high[3]; int count, ends[3]; Side sides[13]; };
    auto shaft_of = [&](V starts_low, V starts_high, V ends_low, V ends_high) -> Shaft {
        const float p[2][3] = {
            {folded(starts_low.x, lesser), folded(starts_low.y, lesser), folded(starts_low.z, lesser)},
            {folded(starts_high.x, larger), folded(starts_high.y, larger), folded(starts_high.z, larger)}};
        const float e[2][3] = {
            {folded(ends_low.x, lesser), folded(ends_low.y, lesser), folded(ends_low.z, lesser)},
            {folded(ends_high.x, larger), folded(ends_high.y, larger), folded(ends_high.z, larger)}};
        Shaft by;
        float width = scene_width;
        for (int axis = 0; axis < 3; ++axis) {
            by.low[axis] = p[0][axis] < e[0][axis] ? p[0][axis] : e[0][axis];
            by.high[axis] = p[1][axis] > e[1][axis] ? p[1][axis] : e[1][axis];
            width = larger(width, larger(-by.low[axis], by.high[axis]));
        }
        const float margin = 4.0e-6f * width + 1.0e-30f;
        const Four sign_u = {-1.0f, 1.0f, -1.0f, 1.0f}, sign_v = {-1.0f, -1.0f, 1.0f, 1.0f};
        by.count = 0;
        for (int u = 0; u < 3; ++u) {
            by.low[u] -= margin;
            by.high[u] += margin;
            const int v = u < 2 ? u + 1 : 0;
            // Four corners at once. Where one leads outwards and the other inwards on the way from the starts to the ends, a side
            // runs along it.
            const Four at_u = {p[0][u], p[1][u], p[0][u], p[1][u]}, at_v = {p[0][v], p[0][v], p[1][v], p[1][v]};
            const Four to_u = {e[0][u], e[1][u], e[0][u], e[1][u]}, to_v = {e[0][v], e[0][v], e[1][v], e[1][v]};
            const Four on_u = sign_u * (to_u - at_u), on_v = sign_v * (to_v - at_v);
            const Four far_u = __builtin_elementwise_abs(on_u), far_v = __builtin_elementwise_abs(on_v);
            const Four out_u = sign_u * far_v, out_v = sign_v * far_u;
            const Four at = out_u * at_u + out_v * at_v + margin * (far_u + far_v);
            const Four bent = on_u * on_v;
            for (int k = 0; k < 4; ++k) {
                by.sides[by.count] = Side{8 * u + (k & 1 ? 0 : 24), 8 * v + (k & 2 ? 0 : 24), out_u[k], out_v[k], at[k]};
                by.count += bent[k] < 0.0f;
            }
            by.ends[u] = by.count;
        }
        return by;
    };
    // Which of a node's eight children are not wholly outside, a bit each.
    auto within = [&](const Shaft& by, const float* boxes) -> unsigned {
        auto row = [&](int k) -> Row { Row v; __builtin_memcpy(&v, boxes + k, sizeof(v)); return v; };
        RowMask out = (row(0) > by.high[0]) | (row(8) > by.high[1]) | (row(16) > by.high[2])
            | (row(24) < by.low[0]) | (row(32) < by.low[1]) | (row(40) < by.low[2]);
        for (int k = 0; k < by.count; ++k) {
            const Side& side = by.sides[k];
            out |= side.out_u * row(side.row_u) + side.out_v * row(side.row_v) > side.at;
        }
        return 255 & ~__builtin_bit_cast(unsigned char, __builtin_convertvector(out < 0, RowBits));
    };
    // Which of a chunk's four triangles are not wholly outside, by their boxes and by their corners.
    auto four_within = [&](const Shaft& by, const float* corners) -> unsigned {
        // First and second corners together, and third ones.
        struct Corners { Row ab; Four c; };
        auto row = [&](int axis) -> Corners {
            Four a, b, c;
            __builtin_memcpy(&a, corners + 4 * axis, sizeof(a));
            __builtin_memcpy(&b, corners + 4 * axis + 12, sizeof(b));
            __builtin_memcpy(&c, corners + 4 * axis + 24, sizeof(c));
            return Corners{__builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7), c};
        };
        auto folded_by = [](auto better, const Corners& of) -> Four {
            return better(better(__builtin_shufflevector(of.ab, of.ab, 0, 1, 2, 3),
                __builtin_shufflevector(of.ab, of.ab, 4, 5, 6, 7)), of.c);
        };
        const Corners x = row(0), y = row(1), z = row(2);
        FourMask out;
        __builtin_memcpy(&out, corners + 36, sizeof(out));
        out = out < 0;
        auto past = [&](const Corners& of, int axis) {
            out |= (folded_by(lesser, of) > by.high[axis]) | (folded_by(larger, of) < by.low[axis]);
        };
        past(x, 0); past(y, 1); past(z, 2);
        int k = 0;
        auto beside = [&](int end, const Corners& u, const Corners& v) {
            for (; k < end; ++k) {
                const Side& side = by.sides[k];
                const Corners at{side.out_u * u.ab + side.out_v * v.ab, side.out_u * u.c + side.out_v * v.c};
                out |= folded_by(lesser, at) > side.at;
            }
        };
        beside(by.ends[0], x, y); beside(by.ends[1], y, z); beside(by.ends[2], z, x);
        unsigned some = 0;
        for (int l = 0; l < 4; ++l) some |= (~out[l] & 1) << l;
        return some;
    };
    // The leaves of the tree within a hull, eight of them a node, for rays that do not leave it: how many nodes. -1: more than
    // packets that go down from the root each ask themselves, a few dozen nodes and leaves, and then some.
    constexpr int LEAVES_MOST = 128, NODES_MOST = 96;
    auto leaves_within = [&](const Shaft& by, float* out_nodes) -> int {
        int open_nodes[8 * NODES_MOST], open_count = 1, asked = 0, count = 0, leaf = 0;
        open_nodes[0] = 0;
        auto put = [&](const float* box, bool none) {
            float* to = out_nodes + 64 * (count / 8) + count % 8;
            for (int k = 0; k < 48; k += 8) to[k] = none ? k < 24 ? 3.0e38f : -3.0e38f : box[k];
            __builtin_memcpy(to + 48, &leaf, sizeof(leaf));
            ++count;
        };
        while (open_count > 0) {
            if (++asked > NODES_MOST) return -1;
            const float* boxes = tree_nodes + 64 * open_nodes[--open_count];
            for (unsigned found = within(by, boxes); found != 0; found &= found - 1) {
                const int slot = __builtin_ctz(found), child = ((const int*)boxes)[48 + slot];
                fetch(child);
                if (child >= 0) {
                    open_nodes[open_count] = child;
                    open_count += child > 0;
                    continue;
                }
                if (count == LEAVES_MOST) return -1;
                leaf = child;
                put(boxes + slot, false);
            }
        }
        while (count % 8 != 0) put(0, true);
        return count / 8;
    };
    // GROUPS vectors of rays from `o` along `d`, lanes `live` of them: which meet something nearer than `reach`, of what lies
    // below nodes one after the other from `roots` on: the tree's own, or those of `leaves_within` a hull of all rays.
    auto find_blocked = [&](const I* live, const V* o, const V* d, const F* reach, I* blocked, const float* roots,
                            int root_count) {
        Way ray[GROUPS];
        I octant[GROUPS];
        unsigned left[GROUPS];
        Rays done = 0;
        // Of each ray alone: where it starts on its own axes; how it turns, and its reach.
        float starts_at[4 * BLOCK], turns_by[4 * BLOCK];
        bool listed = false;
        bool endless = false;
        for (int g = 0; g < GROUPS; ++g) {
            left[g] = bits(live[g]);
            ray[g] = way_of(o[g], d[g]);
            octant[g] = octant_of(d[g]);
            endless |= bits(live[g] & (reach[g] > 1.0e38f)) != 0;
        }
        // A chunk's triangles and as many rays as go abreast: a bit for each of those that meet one of `met`.
        auto chunk_blocks = [&](const float* corners, const Axes& axes, const int* of, int count, unsigned met) -> unsigned {
            Four starts[ABREAST], turns[ABREAST];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < ABREAST; ++k) {
                __builtin_memcpy(&starts[k], starts_at + 4 * of[k], sizeof(Four));
                __builtin_memcpy(&turns[k], turns_by + 4 * of[k], sizeof(Four));
            }
            const F start = joined(starts), turn = joined(turns);
            const V from = V{spread_out(start, I(0)), spread_out(start, I(1)), spread_out(start, I(2))};
            auto corner = [&](int number) -> V {
                auto of_all = [&](int axis) -> F {
                    Four own, all[ABREAST];
                    __builtin_memcpy(&own, corners + 12 * number + 4 * axis, sizeof(own));
                    for (int k = 0; k < ABREAST; ++k) all[k] = own;
                    return joined(all);
                };
                return sub(V{of_all(axes.x), of_all(axes.y), of_all(axes.z)}, from);
            };
            const unsigned asked = met * 0x1111u & (1u << 4 * count) - 1;
            Met best{I(-1), spread_out(turn, I(3)), F(0.0f), F(0.0f)};
            return bits(meet_corners(Any{}, 0, corner(0), corner(1), corner(2), spread_out(turn, I(0)), spread_out(turn, I(1)),
                spread_out(turn, I(2)), marked(asked), best));
        };
        while (true) {
            // Rays to a light all at once; of those that end nowhere those of one octant at a time.
            Rays open = 0, down_x = 0, down_y = 0, down_z = 0, zeros = 0;
            int signs = -1;
            V starts_low = same(3.0e38f), starts_high = same(-3.0e38f), ends_low = same(3.0e38f), ends_high = same(-3.0e38f);
            for (int g = 0; g < GROUPS; ++g) {
                if (!left[g]) continue;
                const Way& r = ray[g];
                if (signs < 0) signs = octant[g][__builtin_ctz(left[g])];
                const I own = endless ? marked(left[g]) & (octant[g] == signs) : marked(left[g]);
                const unsigned some = bits(own);
                if (!some) continue;
                auto put = [&](Rays& all, I which) { all |= (Rays)(bits(which) & some) << g * LANES; };
                put(open, own);
                put(down_x, r.inverse.x < 0.0f); put(down_y, r.inverse.y < 0.0f); put(down_z, r.inverse.z < 0.0f);
                put(zeros, r.zero_x | r.zero_y | r.zero_z);
                left[g] &= ~some;
                // Beyond the scene nothing is met.
                const F last = 4.0f * fmax(size(o[g]), F(scene_width)) / size(d[g]);
                const V end = add(o[g], times(fmin(reach[g], last), d[g]));
                auto take_in = [&](F v, F& low, F& high) {
                    low = fmin(pick(own, v, F(3.0e38f)), low);
                    high = fmax(pick(own, v, F(-3.0e38f)), high);
                };
                take_in(o[g].x, starts_low.x, starts_high.x); take_in(end.x, ends_low.x, ends_high.x);
                take_in(o[g].y, starts_low.y, starts_high.y); take_in(end.y, ends_low.y, ends_high.y);
                take_in(o[g].z, starts_low.z, starts_high.z); take_in(end.z, ends_low.z, ends_high.z);
            }
            if (signs < 0) break;
            const Rays all = open;
            // Rays whose triangles' tests turn the axes alike.
            Rays alike[6];
            Axes axes[6];
            int kinds = 0;
            for (Rays rest = all; rest != 0; ++kinds) {
                const int lead = __builtin_ctzll(rest), of = lead / LANES, l = lead % LANES;
                axes[kinds] = Axes{true, ray[of].kx[l], ray[of].ky[l], ray[of].kz[l]};
                alike[kinds] = 0;
                for (int g = 0; g < GROUPS; ++g) {
                    const unsigned own = bits((ray[g].kz == axes[kinds].z) & (ray[g].kx == axes[kinds].x));
                    alike[kinds] |= rest & (Rays)own << g * LANES;
                }
                rest &= ~alike[kinds];
            }
            auto box_asked = [&](int g, const float* of) -> I {
                const Way& r = ray[g];
                F enter = F(0.0f), leave = F(3.402823466e38f);
                if (zeros) {
                    slab(of[0], of[24], r.o.x, r.inverse.x, r.zero_x, enter, leave);
                    slab(of[8], of[32], r.o.y, r.inverse.y, r.zero_y, enter, leave);
                    slab(of[16], of[40], r.o.z, r.inverse.z, r.zero_z, enter, leave);
                } else {
                    auto between = [&](Rays down, int row, F from, F inverse) {
                        const F in = (of[down == all ? row + 24 : row] - from) * inverse;
                        const F out = (of[down == all ? row : row + 24] - from) * inverse;
                        const bool mixed = down != 0 && down != all;
                        enter = fmax(mixed ? fmin(in, out) : in, enter);
                        leave = fmin(mixed ? fmax(in, out) : out, leave);
                    };
                    between(down_x, 0, r.o.x, r.inverse.x);
                    between(down_y, 8, r.o.y, r.inverse.y);
                    between(down_z, 16, r.o.z, r.inverse.z);
                }
                return (leave >= enter) & (enter < reach[g]);
            };
            const Shaft shaft = shaft_of(starts_low, starts_high, ends_low, ends_high);
            Waiting waiting[DEEPEST];
            int waiting_count = 0, root = 0;
            const float* boxes = root_count > 0 ? roots : 0;
            Rays rays = open;
            while (boxes) {
                const int* children = (const int*)(boxes + 48);
                // Vectors with rays that came here.
                int some[GROUPS + 1], some_count = 0;
                EACH_GROUP {
                    some[some_count] = g;
                    some_count += part_of(rays, g) != 0;
                }
                for (unsigned found = within(shaft, boxes); found != 0; found &= found - 1) {
                    const int slot = __builtin_ctz(found), child = children[slot];
                    fetch(child);
                    Rays met = 0;
                    for (int k = 0; k < some_count; ++k)
                        met |= (Rays)bits(box_asked(some[k], boxes + slot)) << some[k] * LANES;
                    met &= rays;
                    waiting[waiting_count] = Waiting{child, met};
                    waiting_count += met != 0;
                }
                boxes = 0;
                while (waiting_count > 0) {
                    const int child = waiting[--waiting_count].child;
                    rays = waiting[waiting_count].rays & open;
                    if (!rays) continue;
                    if (child >= 0) { boxes = tree_nodes + 64 * child; break; }
                    for (int chunk = ~child;; ++chunk) {
                        const float* corners = tree_chunks + 48 * chunk;
                        const unsigned met = four_within(shaft, corners);
                        for (int kind = 0; met != 0 && kind < kinds; ++kind) {
                            const Rays own = rays & alike[kind];
                            if (!own) continue;
                            int vectors = 0;
                            EACH_GROUP vectors += part_of(own, g) != 0;
                            if (__builtin_popcountll(own) > ABREAST * vectors * __builtin_popcount(met)) {
                                for (unsigned left = met; left != 0; left &= left - 1) {
                                    const float* a = corners + __builtin_ctz(left);
                                    EACH_GROUP {
                                        const unsigned asked = part_of(rays & own, g);
                                        if (!asked) continue;
                                        Met best{I(-1), reach[g], F(0.0f), F(0.0f)};
                                        const unsigned hits = bits(meet_triangle(Any{}, Chunk{}, 0, a, a + 12, a + 24, axes[kind],
                                            ray[g], marked(asked), best));
                                        rays &= ~((Rays)hits << g * LANES);
                                    }
                                }
                                continue;
                            }
                            if (!listed) {
                                for (int g = 0; g < GROUPS; ++g) {
                                    const Way& r = ray[g];
                                    vstore4(starts_at, g * LANES, V{r.ox, r.oy, r.oz}, F(0.0f));
                                    vstore4(turns_by, g * LANES, V{r.sx, r.sy, r.sz}, reach[g]);
                                }
                                listed = true;
                            }
                            int single[BLOCK + ABREAST], count = 0;
                            for (Rays rest = own; rest != 0; rest &= rest - 1) single[count++] = __builtin_ctzll(rest);
                            for (int k = count; k % ABREAST != 0; ++k) single[k] = single[count - 1];
                            for (int k = 0; k < count; k += ABREAST) {
                                const int together = count - k < ABREAST ? count - k : ABREAST;
                                unsigned hits = chunk_blocks(corners, axes[kind], single + k, together, met);
                                // Of each ray's four triangles one is enough.
                                hits |= hits >> 2;
                                hits |= hits >> 1;
                                for (hits &= 0x1111u; hits != 0; hits &= hits - 1)
                                    rays &= ~((Rays)1 << single[k + __builtin_ctz(hits) / 4]);
                            }
                        }
                        if (!((const int*)corners)[40]) break;
                    }
                    open &= ~(waiting[waiting_count].rays & ~rays);
                }
                if (!boxes && ++root < root_count && open) {
                    boxes = roots + 64 * root;
                    rays = open;
                }
            }
            done |= all & ~open;
        }
        for (int g = 0; g < GROUPS; ++g) blocked[g] = marked(part_of(done, g));
    };
"""
)
