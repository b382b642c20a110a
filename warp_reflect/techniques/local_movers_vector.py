"""`local_movers.moving_texels_kernel` with the rays of a tile in vectors (`packets.py`): the same triangles.

A texel's ray takes part where it may meet the part's sphere, and what the map holds there is not nearer than that. All go
down Warp's own tree together, from the part's branch on: a node is read once for all, and a ray takes part only where it would
have come alone (Wald et al., Interactive Rendering with Coherent Ray Tracing, Eurographics 2001). Where two triangles are met
at the same distance to the last digit or two, which one is told depends on the way.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.cubemap import RADIANCE_DIRECTION
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.packets import RAYS
from warp_reflect.techniques.local_maps import LocalPlace
from warp_reflect.techniques.local_movers import CONE_SLACK, FAR, MOVING, Asked, Tile, farthest_in, tile_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

DESCENT = (
    RAYS
    + r"""
    using wp::BVHPackedNodeHalf;
    const wp::Mesh& tree_mesh = *(const wp::Mesh*)mesh_id;
    const BVHPackedNodeHalf* node_lowers = tree_mesh.bvh.node_lowers;
    const BVHPackedNodeHalf* node_uppers = tree_mesh.bvh.node_uppers;
    const int* tree_primitives = tree_mesh.bvh.primitive_indices;
    const int* tree_corners = tree_mesh.indices.data;
    const float* tree_points = (const float*)tree_mesh.points.data;
    constexpr int GROUPS = 2;
    // What rays from `o` along `d`, lanes `live` of them, meet first nearer than `reach`, below a node.
    auto first_met_by = [&](int node, const I* live, const V* o, const V* d, const F* reach, Met* met) {
        Way ray[GROUPS];
        I mask[GROUPS];
        bool no_zeros = true;
        Axes axes{true, -1, 0, 0};
        unsigned low_x = 0, low_y = 0, low_z = 0, high_x = 0, high_y = 0, high_z = 0;
        EACH_GROUP {
            const Way& r = ray[g] = way_of(o[g], d[g]);
            mask[g] = live[g];
            met[g] = Met{I(-1), reach[g], F(0.0f), F(0.0f)};
            const unsigned all = bits(live[g]);
            if (!all) continue;
            if (axes.x < 0) {
                const int lead = __builtin_ctz(all);
                axes.x = r.kx[lead]; axes.y = r.ky[lead]; axes.z = r.kz[lead];
            }
            axes.one &= !bits(live[g] & ((r.kz != axes.z) | (r.kx != axes.x)));
            no_zeros &= !bits(live[g] & (r.zero_x | r.zero_y | r.zero_z));
            low_x |= bits(live[g] & (d[g].x < 0.0f)); high_x |= bits(live[g] & (d[g].x > 0.0f));
            low_y |= bits(live[g] & (d[g].y < 0.0f)); high_y |= bits(live[g] & (d[g].y > 0.0f));
            low_z |= bits(live[g] & (d[g].z < 0.0f)); high_z |= bits(live[g] & (d[g].z > 0.0f));
        }
        if (axes.x < 0) return;
        const bool one_way = no_zeros && !(low_x && high_x) && !(low_y && high_y) && !(low_z && high_z);
        // Where rays enter and leave a box: its planes by the sign that they share.
        const BVHPackedNodeHalf* in_x = low_x ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_y = low_y ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* in_z = low_z ? node_uppers : node_lowers;
        const BVHPackedNodeHalf* out_x = low_x ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_y = low_y ? node_lowers : node_uppers;
        const BVHPackedNodeHalf* out_z = low_z ? node_lowers : node_uppers;
        auto box = [&](const Way& r, F far, int node, F& enter) -> I {
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
                slab(low.x, high.x, r.o.x, r.inverse.x, r.zero_x, enter, leave);
                slab(low.y, high.y, r.o.y, r.inverse.y, r.zero_y, enter, leave);
                slab(low.z, high.z, r.o.z, r.inverse.z, r.zero_z, enter, leave);
            }
            return (leave >= 0.0f) & (leave >= enter) & (enter < far);
        };
        // Warp's builders end a branch one short of its stack; a tree of groups has such trees under another.
        constexpr int DEEPEST = 2 * BVH_QUERY_STACK_SIZE;
        struct Waiting { I mask[GROUPS]; F enter[GROUPS]; int node; } waiting[DEEPEST];
        int waiting_count = 0;
        while (true) {
            const int first = node_lowers[node].i, second = node_uppers[node].i;
            if (node_lowers[node].b) {
                for (int k = first; k < second; ++k) {
                    const int face = tree_primitives[k];
                    const float* a = tree_points + 3 * tree_corners[3 * face];
                    const float* b = tree_points + 3 * tree_corners[3 * face + 1];
                    const float* c = tree_points + 3 * tree_corners[3 * face + 2];
                    EACH_GROUP meet_triangle(Nearest{}, One{}, face, a, b, c, axes, ray[g], mask[g], met[g]);
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
                    mask[g] = next.mask[g] & (next.enter[g] < met[g].t);
                    rest |= mask[g];
                }
            } while (!bits(rest));
        }
    };
"""
)


@wp.func_native(
    vector.snippet(
        DESCENT
        + RADIANCE_DIRECTION
        + r"""
    const int n = place.resolution, face = tile.face;
    const V eye = spread(place.eye), towards = spread(asked.towards);
    for (int start = 0; start < 64; start += 2 * LANES) {
        V o[2], d[2];
        I live[2], texel[2];
        F reach[2];
        Met met[2];
        for (int g = 0; g < 2; ++g) {
            const I element = start + g * LANES + lanes();
            const I column = tile.left + (element & 7), row = tile.top + (element >> 3);
            live[g] = (column < tile.right) & (row < tile.bottom);
            texel[g] = ipick(live[g], place.first_texel + (face * n + row) * n + column, I(place.first_texel));
            const F u = 2.0f * (__builtin_convertvector(column, F) + 0.5f) / (float)(n) - 1.0f;
            const F v = 2.0f * (__builtin_convertvector(row, F) + 0.5f) / (float)(n) - 1.0f;
            const V ray = radiance_direction(face, u, v);
            d[g] = times(1.0f / __builtin_elementwise_sqrt(dot(ray, ray)), ray);
            o[g] = eye;
            const F held = gather(out_distance.data, texel[g]);
            reach[g] = pick(held > 0.0f, held, F(far));
            live[g] &= (reach[g] >= asked.near) & (dot(d[g], towards) >= asked.cosine - slack);
        }
        if (!bits(live[0] | live[1])) continue;
        first_met_by(root, live, o, d, reach, met);
        for (int g = 0; g < 2; ++g) {
            for (unsigned rest = bits(live[g] & (met[g].face >= 0)); rest != 0; rest &= rest - 1) {
                const int l = __builtin_ctz(rest), i = texel[g][l];
                out_triangle.data[i] = number.data[met[g].face[l]];
                out_distance.data[i] = met[g].t[l] > 1.0e-30f ? met[g].t[l] : 1.0e-30f;
                out_state.data[i] = moving;
            }
        }
    }
"""
    )
)
def meet_in_tile(
    mesh_id: wp.uint64,
    root: int,
    number: wp.array(dtype=int),
    asked: Asked,
    place: LocalPlace,
    tile: Tile,
    far: float,
    slack: float,
    moving: int,
    out_distance: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_state: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def moving_tiles_kernel(
    first: int,
    mesh_id: wp.uint64,
    number: wp.array(dtype=int),
    asked: wp.array(dtype=Asked),
    asked_first: wp.array(dtype=int),
    places: wp.array(dtype=LocalPlace),
    tile_map: wp.array(dtype=int),
    tile_first: wp.array(dtype=int),
    # Changed:
    out_distance: wp.array(dtype=float),
    out_triangle: wp.array(dtype=int),
    out_state: wp.array(dtype=wp.uint8),
):
    """One thread per tile of texels; arguments as for `local_movers.moving_texels_kernel`."""
    i = first + wp.tid()
    map_number = tile_map[i]
    place = places[map_number]
    tile = tile_of(place, i - tile_first[map_number])
    farthest = float(-1.0)
    k = asked_first[map_number]
    while k < asked_first[map_number + 1]:
        least = tile.cosine * asked[k].cosine - tile.sine * asked[k].sine - CONE_SLACK
        if wp.dot(tile.axis, asked[k].towards) >= least:
            if farthest < 0.0:
                farthest = farthest_in(place, tile, out_distance)
            if asked[k].near <= farthest:
                root = wp.mesh_get_group_root(mesh_id, asked[k].part)
                meet_in_tile(
                    mesh_id,
                    root,
                    number,
                    asked[k],
                    place,
                    tile,
                    FAR,
                    CONE_SLACK,
                    MOVING,
                    out_distance,
                    out_triangle,
                    out_state,
                )
        k += 1
