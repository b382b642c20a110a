"""What rays meet first, for a block of them at a time: the first of the queries of `bvh.trace_ray`, in packets.

Neighbouring rays stay together for most of the way (`wide_packets.py`). What `bvh` makes of the answer, and the queries of the
few rays that go on from there, are its own.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.launch import FINITE_FLAGS, launch
from warp_reflect.wide_packets import TRAVERSAL

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

BLOCK_SPLIT_MIN = 8  # blocks; what `bvh.TRACE_SPLIT_MIN` rays are
TILE = 4  # pixels along a side of a packet's part of the picture: a square one is met by the fewest boxes


@wp.func_native(
    vector.snippet(r"""
    const int* numbers = pixel.data;
    const int count = pixel.shape[0];
    auto place_of = [&](int number) -> int {
        int low = 0, high = count;
        while (low < high) {
            const int middle = (low + high) / 2;
            if (numbers[middle] < number) low = middle + 1;
            else high = middle;
        }
        return low;
    };
    int at[4], end[4];
    for (int row = 0; row < 4; ++row) {
        at[row] = place_of((4 * band + row) * width);
        end[row] = place_of((4 * band + row + 1) * width);
    }
    int place = at[0];
    while (true) {
        int next = width;
        for (int row = 0; row < 4; ++row) {
            const int x = at[row] < end[row] ? numbers[at[row]] - (4 * band + row) * width : width;
            next = x < next ? x : next;
        }
        if (next == width) return;
        const int after = (next & ~3) + 4;
        for (int row = 0; row < 4; ++row)
            while (at[row] < end[row] && numbers[at[row]] - (4 * band + row) * width < after)
                out_order.data[place++] = at[row]++;
    }
""")
)
def order_band(band: int, pixel: wp.array(dtype=int), width: int, out_order: wp.array(dtype=int)): ...


@wp.kernel
def order_kernel(first: int, pixel: wp.array(dtype=int), width: int, out_order: wp.array(dtype=int)):
    """One thread per `TILE` rows of the picture, whose pixels lie together."""
    order_band(first + wp.tid(), pixel, width, out_order)


@wp.func_native(
    vector.snippet(
        TRAVERSAL
        + r"""
    const int count = indexed != 0 ? index.shape[0] : point.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    for (int start = begin; start < end; start += 2 * LANES) {
        V o[2], d[2];
        I live[2], own[2];
        F reach[2];
        Met met[2];
        for (int g = 0; g < 2; ++g) {
            const I element = start + g * LANES + lanes();
            live[g] = element < end;
            own[g] = ipick(live[g], element, I(end - 1));
            if (indexed != 0) own[g] = igather(index.data, own[g]);
            const V at = vgather((const float*)point.data, own[g]), n = vgather((const float*)normal.data, own[g]);
            // bvh.ray_offset
            const F offset = 16.0f * 1.1920929e-7f
                * (__builtin_elementwise_abs(at.x) + __builtin_elementwise_abs(at.y) + __builtin_elementwise_abs(at.z));
            o[g] = add(at, times(offset, n));
            d[g] = flushed(vgather((const float*)direction.data, own[g]));
            reach[g] = F(3.0e38f);
        }
        first_met_by(live, o, d, reach, met);
        for (int g = 0; g < 2; ++g)
            for (unsigned left = bits(live[g]); left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left), i = own[g][l];
                out_triangle.data[i] = met[g].face[l];
                out_u.data[i] = met[g].u[l];
                out_v.data[i] = met[g].v[l];
                out_t.data[i] = met[g].t[l];
            }
    }
"""
    )
)
def first_met_block(
    block: int,
    mesh_id: wp.uint64,
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=int),
    indexed: int,
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_t: wp.array(dtype=float),
): ...


@wp.kernel
def first_met_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=int),
    indexed: int,
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_t: wp.array(dtype=float),
):
    """One thread per block of asked rays; u and v as Warp's queries name them, for the first and second corner."""
    block = first + wp.tid()
    first_met_block(block, mesh_id, point, normal, direction, index, indexed, out_triangle, out_u, out_v, out_t)


def in_tiles(pixel: wp.array, width: int, threads: int = 0) -> wp.array | None:
    """The order of pixels tile by tile: int32 indices into `pixel`, of a picture of `width`; None: they do not ascend."""
    numbers, device = pixel.numpy(), pixel.device
    if len(numbers) == 0 or numbers[0] < 0 or not (numbers[1:] > numbers[:-1]).all():
        return None
    order = wp.empty(len(numbers), dtype=int, device=device)
    bands = int(numbers[-1]) // (TILE * width) + 1
    launch(order_kernel, bands, [pixel, width, order], device, threads, split_min=BLOCK_SPLIT_MIN)
    return order


def first_met(
    mesh: int, rays: list[wp.array], index: wp.array | None, outputs: list[wp.array], threads: int = 0
) -> None:
    """What rays meet first.

    Args:
        mesh: `bvh.Tracer.packets`.
        rays: vec3 each: points, normals on the rays' side, unit directions.
        index: int32, which of the rays; None: all.
        outputs: Triangle (-1 none), u, v, t of the rays asked; what is met alone sets the last three.
        threads: CPU threads; 0: one per core.
    """
    device = rays[0].device
    count = len(rays[0]) if index is None else len(index)
    which = [wp.zeros(0, dtype=int, device=device) if index is None else index, int(index is not None)]
    inputs = [wp.uint64(mesh), *rays, *which, *outputs]
    launch(first_met_blocks_kernel, vector.block_count(count), inputs, device, threads, split_min=BLOCK_SPLIT_MIN)
