"""`local_movers.moving_texels_kernel` with the rays of a tile in packets (`packets.py`): the same triangles.

A texel's ray takes part where it may meet the part's sphere, and what the map holds there is not nearer than that.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.packets import TRAVERSAL
from warp_reflect.techniques.local_maps import LocalPlace
from warp_reflect.techniques.local_movers import CONE_SLACK, FAR, MOVING, Asked, Tile, farthest_in, tile_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

WHOLE_TREE = "int node = *tree_mesh.bvh.root;"
assert WHOLE_TREE in TRAVERSAL


@wp.func_native(
    vector.snippet(
        TRAVERSAL.replace(WHOLE_TREE, "int node = root;")
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
            const F one = F(1.0f);
            V ray;
            switch (face) {
                case 0: ray = V{one, -v, u}; break;
                case 1: ray = V{-one, -v, -u}; break;
                case 2: ray = V{u, one, -v}; break;
                case 3: ray = V{u, -one, v}; break;
                case 4: ray = V{-u, -v, one}; break;
                default: ray = V{u, -v, -one}; break;
            }
            d[g] = times(1.0f / __builtin_elementwise_sqrt(dot(ray, ray)), ray);
            o[g] = eye;
            const F held = gather(out_distance.data, texel[g]);
            reach[g] = pick(held > 0.0f, held, F(far));
            live[g] &= (reach[g] >= asked.near) & (dot(d[g], towards) >= asked.cosine - slack);
        }
        if (!bits(live[0] | live[1])) continue;
        first_met_by(live, o, d, reach, met);
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
