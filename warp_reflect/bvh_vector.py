"""What rays meet first, for a block of them at a time: `ray_walk.trace_ray` in packets, bit for bit.

Neighbouring rays stay together for most of the way (`wide_packets.py`). The few rays that meet their own facet or body first
are left to `bvh`, with what they met. A convex body is not there for rays that leave it steeply: a tree's branches near a
ray's start cost as much as any, and what a ray met of its own body it would step over.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_reflect import compact, vector
from warp_reflect.launch import launch
from warp_reflect.ray_walk import OwnBody
from warp_reflect.settings import Status
from warp_reflect.wide_packets import TRAVERSAL

wp.set_module_options({"enable_backward": False})

BLOCK_SPLIT_MIN = 8  # blocks; what `bvh.TRACE_SPLIT_MIN` rays are
LEFT, MISSED = 1, 2  # flags of a block: rays are left to the plain kernels, some meet nothing
UNASKED = -2  # a triangle: nothing is known of what the ray meets
# Pixels of a packet's part of the picture: as many as share most of a walk down the tree; a nearly square part meets few boxes.
TILE_WIDTH, TILE_HEIGHT = 8, 4
# Cosine to the normal of a convex body below which a ray may still meet it: a normal between corners is not that of the facet.
GRAZING = 1.0 / 16.0
MOST_RUNS = 64  # of ascending pixels; more are no picture's
JOINED = 16  # rays; tiles with fewer are joined with the next ones, as most of a walk costs the same for any number


_CONSTANTS = f"""
    constexpr int NONE = {int(Status.NONE)}, CONVERGED = {int(Status.CONVERGED)}, SKY = {int(Status.SKY)};
    constexpr int LEFT = {LEFT}, MISSED = {MISSED}, UNASKED = {UNASKED};
    constexpr int TILE_WIDTH = {TILE_WIDTH}, TILE_HEIGHT = {TILE_HEIGHT}, JOINED = {JOINED};
    constexpr float GRAZING = {GRAZING}f;
"""


class Leaving(NamedTuple):
    """Rays that follow one another among those asked, the first of them, and the body that they leave.

    `branches`: Those of the tree that are the body's (`WideTree.branches_of`) if it is convex; none: it is met like anything
    else.
    """

    first: int
    body: OwnBody
    branches: wp.array


@wp.struct
class Run:
    """Rays whose pixels ascend."""

    first_triangle: int  # of the body that they leave
    triangle_count: int
    branches: wp.uint64  # where that body's are, 0: none
    first: int
    end: int
    first_band: int  # row of tiles
    first_block: int


@wp.func_native(
    vector.snippet(
        _CONSTANTS
        + TRAVERSAL
        + r"""
    int of_block = 0;
    while (of_block + 1 < runs.shape[0] && runs.data[of_block + 1].first_block <= block) ++of_block;
    const auto run = runs.data[of_block];
    const int own_block = block - run.first_block;
    const float* points = (const float*)point.data;
    const float* normals = (const float*)normal.data;
    const float* directions = (const float*)direction.data;
    // Arrays' own pointers would be read anew after whatever is written.
    const int *orders = indexed != 0 ? index.data : 0, *pixels = numbers.data, *facet_at = facets.data;
    const int* facet_of = pixel.shape[0] > 0 ? pixel.data : 0;
    int* triangle_to = out_triangle.data;
    float *u_to = out_u.data, *v_to = out_v.data, *t_to = out_t.data;
    unsigned char* status_to = out_status.data;
    // What is at a place of the order that is asked for.
    auto ray_at = [&](int place) -> int { return orders ? orders[place] : place; };
    auto number_at = [&](int place) -> int { return pixels[ray_at(place)]; };
    // Rays that go together: those of a tile, row by row of either half, or the next of a block.
    constexpr int RAYS = TILE_WIDTH * TILE_HEIGHT, GROUPS = RAYS / LANES;
    struct Tile { enum { value = GROUPS }; bool alone; bool first_alone() const { return alone; } };
    int ray[RAYS], taken = 0;
    // A tile that is full, whose rows of rays begin at these places.
    bool full = false;
    int row_start[TILE_HEIGHT];
    int at[TILE_HEIGHT], stop[TILE_HEIGHT], next_place = run.first + own_block * BLOCK;
    const int last_place = next_place + BLOCK < run.end ? next_place + BLOCK : run.end;
    const int top = TILE_HEIGHT * (run.first_band + own_block);
    if (width > 0) {
        auto place_of = [&](int number, int low, int high) -> int {
            while (low < high) {
                const int middle = (low + high) / 2;
                if (number_at(middle) < number) low = middle + 1;
                else high = middle;
            }
            return low;
        };
        int low = place_of(top * width, run.first, run.end);
        for (int row = 0; row < TILE_HEIGHT; ++row) {
            at[row] = low;
            stop[row] = low = place_of((top + row + 1) * width, low, low + width < run.end ? low + width : run.end);
        }
    }
    // Rays beside a tile and their answers' places, while those of the tile are on their way.
    auto fetch_beside = [&](int row) {
        if (at[row] == stop[row] || indexed != 0) return;
        const int next = at[row];
        // A row of a tile lies on two cache lines or three.
        for (int word = 0; word < 3 * TILE_WIDTH; word += word ? 3 * TILE_WIDTH - 17 : 16) {
            __builtin_prefetch(points + 3 * next + word);
            __builtin_prefetch(normals + 3 * next + word);
            __builtin_prefetch(directions + 3 * next + word);
        }
        __builtin_prefetch(facet_at + (facet_of ? facet_of[next] : next));
        __builtin_prefetch(status_to + next, 1);
        for (int last = next; last < next + TILE_WIDTH; last += TILE_WIDTH - 1) {
            __builtin_prefetch(triangle_to + last, 1);
            __builtin_prefetch(u_to + last, 1);
            __builtin_prefetch(v_to + last, 1);
            __builtin_prefetch(t_to + last, 1);
        }
    };
    auto take = [&]() {
        taken = 0;
        full = false;
        if (width == 0) {
            while (taken < RAYS && next_place < last_place) ray[taken++] = ray_at(next_place++);
            return;
        }
        while (taken < JOINED) {
            int x = width;
            for (int row = 0; row < TILE_HEIGHT; ++row) {
                const int own = at[row] < stop[row] ? number_at(at[row]) - (top + row) * width : width;
                x = own < x ? own : x;
            }
            if (x == width) return;
            x -= x % TILE_WIDTH;
            int middle[TILE_HEIGHT], end[TILE_HEIGHT], full_rows = 0;
            for (int row = 0; row < TILE_HEIGHT; ++row) {
                const int own = (top + row) * width + x;
                int k = at[row];
                if (k + TILE_WIDTH <= stop[row] && number_at(k + TILE_WIDTH - 1) == own + TILE_WIDTH - 1) {
                    middle[row] = k + TILE_WIDTH / 2;
                    end[row] = k + TILE_WIDTH;
                    ++full_rows;
                    continue;
                }
                while (k < stop[row] && number_at(k) < own + TILE_WIDTH / 2) ++k;
                middle[row] = k;
                while (k < stop[row] && number_at(k) < own + TILE_WIDTH) ++k;
                end[row] = k;
            }
            full = full_rows == TILE_HEIGHT && indexed == 0 && taken == 0;
            if (full) {
                for (int row = 0; row < TILE_HEIGHT; ++row) {
                    row_start[row] = at[row];
                    at[row] = end[row];
                    fetch_beside(row);
                }
                taken = RAYS;
                return;
            }
            int more = 0;
            for (int row = 0; row < TILE_HEIGHT; ++row) more += end[row] - at[row];
            if (taken + more > RAYS) return;
            for (int half = 0; half < 2; ++half)
                for (int row = 0; row < TILE_HEIGHT; ++row)
                    for (int k = half ? middle[row] : at[row]; k < (half ? end[row] : middle[row]); ++k) ray[taken++] = ray_at(k);
            for (int row = 0; row < TILE_HEIGHT; ++row) {
                at[row] = end[row];
                fetch_beside(row);
            }
        }
    };
    // Of a full tile rays follow one another in fours, which begin there: rows are read and turned.
    auto four_of = [&](int lane) -> int { return row_start[lane / 4 % TILE_HEIGHT] + lane / 4 / TILE_HEIGHT * 4; };
    auto own_of = [&](int g) -> I {
        if (!full) return iload(ray + g * LANES);
        I first;
        EACH_LANE first[l] = four_of(g * LANES + l);
        return first + (lanes() & 3);
    };
    auto rows = [&](const float* p, I own) -> V {
        if (!full) return vgather(p, own);
        auto four = [&](int k) -> Four { Four v; __builtin_memcpy(&v, p + k, sizeof(v)); return v; };
#if defined(__AVX512F__)
        // Of each of its blocks of 128 bits: x y z x, y z x y, z x y z.
        Four part[3][4];
        _Pragma("clang loop unroll(full)") for (int row = 0; row < 4; ++row) {
            const int own_row = 3 * own[4 * row];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 3; ++k) part[k][row] = four(own_row + 4 * k);
        }
        const F a = joined(part[0]), b = joined(part[1]), c = joined(part[2]);
        return V{
            __builtin_shufflevector(__builtin_shufflevector(a, b,
                0, 3, 18, -1, 4, 7, 22, -1, 8, 11, 26, -1, 12, 15, 30, -1), c,
                0, 1, 2, 17, 4, 5, 6, 21, 8, 9, 10, 25, 12, 13, 14, 29),
            __builtin_shufflevector(__builtin_shufflevector(a, b,
                1, 16, 19, -1, 5, 20, 23, -1, 9, 24, 27, -1, 13, 28, 31, -1), c,
                0, 1, 2, 18, 4, 5, 6, 22, 8, 9, 10, 26, 12, 13, 14, 30),
            __builtin_shufflevector(__builtin_shufflevector(a, b,
                2, 17, -1, -1, 6, 21, -1, -1, 10, 25, -1, -1, 14, 29, -1, -1), c,
                0, 1, 16, 19, 4, 5, 20, 23, 8, 9, 24, 27, 12, 13, 28, 31)};
#else
        const int one = 3 * own[0], other = 3 * own[4];
        float both[24];
        const F a = __builtin_shufflevector(four(one), four(one + 4), 0, 1, 2, 3, 4, 5, 6, 7);
        const F b = __builtin_shufflevector(four(one + 8), four(other), 0, 1, 2, 3, 4, 5, 6, 7);
        const F c = __builtin_shufflevector(four(other + 4), four(other + 8), 0, 1, 2, 3, 4, 5, 6, 7);
        store(both, a); store(both + 8, b); store(both + 16, c);
        return vload(both, 0);
#endif
    };
    // `ray_walk.exact_hit`, lanes of `hit`; the weights of the second and third corner in place of Warp's.
    auto finish = [&](I hit, V o, V d, Met& met) {
        V v0, v1, v2;
        corners(records.data, ipick(hit, met.face, I(0)), v0, v1, v2);
        const V a = sub(v0, o), b = sub(v1, o), c = sub(v2, o);
        const F eu = dot(cross(sub(c, a), add(c, a)), d);
        const F ev = dot(cross(sub(a, b), add(a, b)), d);
        const F ew = dot(cross(sub(b, c), add(b, c)), d);
        const F det = eu + ev + ew;
        const F inverse = 1.0f / pick(det != 0.0f, det, F(1.0f));
        const F u = eu * inverse, v = ev * inverse, w = ew * inverse;
        const F t = (w * dot(a, d) + u * dot(b, d) + v * dot(c, d)) / dot(d, d);
        const I exact = (det != 0.0f) & (fmin(fmin(u, v), w) > -0.01f);
        met.t = pick(hit, pick(exact, fmax(t, F(0.0f)), met.t), F(0.0f));
        const F cu = fmax(pick(exact, u, met.v), F(0.0f)), cv = fmax(pick(exact, v, 1.0f - met.u - met.v), F(0.0f));
        const F total = cu + cv;
        const I beyond = hit & (total > 1.0f);
        met.u = pick(hit, cu, F(0.0f));
        met.v = pick(hit, cv, F(0.0f));
        if (bits(beyond)) {
            met.u = pick(beyond, cu / total, met.u);
            met.v = pick(beyond, cv / total, met.v);
        }
    };
    int state = 0;
    for (take(); taken > 0; take()) {
        if (!full)
            for (int k = taken; k < RAYS; ++k) ray[k] = ray[taken - 1];
        V from[GROUPS], o[GROUPS], d[GROUPS], along[GROUPS];
        I live[GROUPS], own[GROUPS], moved[GROUPS], missed[GROUPS];
        F reach[GROUPS];
        Met met[GROUPS];
        I grazing = I(0);
        for (int g = 0; g < GROUPS; ++g) {
            live[g] = g * LANES + lanes() < taken;
            own[g] = own_of(g);
            from[g] = rows(points, own[g]);
            along[g] = rows(directions, own[g]);
            // ray_walk.ray_offset
            const F offset = 16.0f * 1.1920929e-7f * (__builtin_elementwise_abs(from[g].x)
                + __builtin_elementwise_abs(from[g].y) + __builtin_elementwise_abs(from[g].z));
            const V upright = rows(normals, own[g]);
            o[g] = add(from[g], times(offset, upright));
            grazing |= live[g] & (dot(upright, along[g]) < GRAZING);
            d[g] = flushed(along[g]);
            reach[g] = F(3.0e38f);
            moved[g] = I(0);
            missed[g] = live[g];
        }
        left_out = !bits(grazing) ? (const unsigned char*)run.branches : 0;
        for (int round = 0; round < 2; ++round) {
            Met found[GROUPS];
            find_nearest(Tile{taken <= LANES}, missed, o, d, reach, found);
            I some = I(0);
            for (int g = 0; g < GROUPS; ++g) {
                Met& m = met[g];
                if (round == 0) {
                    m = found[g];
                } else {
                    m.face = ipick(missed[g], found[g].face, m.face);
                    m.t = pick(missed[g], found[g].t, m.t);
                    m.u = pick(missed[g], found[g].u, m.u);
                    m.v = pick(missed[g], found[g].v, m.v);
                    moved[g] = missed[g];
                }
                missed[g] &= found[g].face < 0;
                some |= missed[g];
                // ray_walk.moved_direction
                const F step = 8.0f * 1.1920929e-7f * size(d[g]);
                d[g] = vpick(missed[g], add(d[g], V{step, -0.625f * step, 0.375f * step}), d[g]);
            }
            if (retry == 0 || !bits(some)) break;
        }
        for (int g = 0; g < GROUPS; ++g) {
            I facet;
            if (full) {
                for (int l = 0; l < LANES; l += 4) {
                    const int start = four_of(g * LANES + l);
                    const int* of = facet_at + (facet_of ? facet_of[start] : start);
                    for (int k = 0; k < 4; ++k) facet[l + k] = of[k];
                }
            } else {
                facet = igather(facet_at, facet_of ? igather(facet_of, own[g]) : own[g]);
            }
            I first = I(run.first_triangle), length = I(run.triangle_count);
            if (bodies.shape[0] > 0) {
                const I patch = igather(patches.data, ipick(facet < 0, I(0), facet));
                EACH_LANE {
                    first[l] = bodies.data[patch[l]].first_triangle;
                    length[l] = bodies.data[patch[l]].triangle_count;
                }
            }
            Met& m = met[g];
            const I hit = m.face >= 0;
            I over = (m.face >= first) & (m.face < first + length);
            if (inside.shape[0] > 0 && bits(over)) {
                // ray_walk.trace_onward
                V v0, v1, v2;
                corners(records.data, ipick(hit, m.face, I(0)), v0, v1, v2);
                const I leaves = dot(facet_normal(v0, v1, v2), d[g]) > 0.0f;
                const F longest = fmax(fmax(size(sub(v1, v0)), size(sub(v2, v1))), size(sub(v0, v2)));
                I in;
                EACH_LANE in[l] = inside.data[own[g][l]] != 0 ? -1 : 0;
                over &= (in ^ leaves) & (m.t <= 2.0f * longest);
            }
            const I left = live[g] & hit & ((m.face == facet) | over);
            const F warp_t = m.t, warp_u = m.u, warp_v = m.v;
            finish(hit & ~left, from[g], along[g], m);
            m.face = ipick(left & moved[g], I(UNASKED), m.face);
            m.t = pick(left, warp_t, m.t); m.u = pick(left, warp_u, m.u); m.v = pick(left, warp_v, m.v);
            const I status = ipick(left, I(NONE), ipick(hit, I(CONVERGED), I(SKY)));
            state |= (bits(left) != 0 ? LEFT : 0) | (bits(live[g] & ~hit) != 0 ? MISSED : 0);
            // By memory: the compiler would store a whole vector for every lane that is taken out of it.
            int at[LANES], face[LANES], told[LANES];
            float t[LANES], u[LANES], v[LANES];
            istore(at, own[g]); istore(face, m.face); istore(told, status);
            store(t, m.t); store(u, m.u); store(v, m.v);
            if (full) {
                for (int l = 0; l < LANES; l += 4) {
                    const int start = four_of(g * LANES + l);
                    __builtin_memcpy(triangle_to + start, face + l, 16);
                    __builtin_memcpy(u_to + start, u + l, 16);
                    __builtin_memcpy(v_to + start, v + l, 16);
                    __builtin_memcpy(t_to + start, t + l, 16);
                    for (int k = 0; k < 4; ++k) status_to[start + k] = (unsigned char)told[l + k];
                }
            } else {
                for (unsigned some = bits(live[g]); some != 0; some &= some - 1) {
                    const int l = __builtin_ctz(some), i = at[l];
                    triangle_to[i] = face[l];
                    u_to[i] = u[l];
                    v_to[i] = v[l];
                    t_to[i] = t[l];
                    status_to[i] = (unsigned char)told[l];
                }
            }
        }
    }
    out_state.data[block] = state;
"""
    )
)
def first_met_block(
    block: int,
    mesh_id: wp.uint64,
    records: wp.array(dtype=float),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    bodies: wp.array(dtype=OwnBody),
    patches: wp.array(dtype=int),
    inside: wp.array(dtype=wp.uint8),
    index: wp.array(dtype=int),
    indexed: int,
    numbers: wp.array(dtype=int),
    width: int,
    runs: wp.array(dtype=Run),
    retry: int,
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_t: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_state: wp.array(dtype=int),
): ...


@wp.kernel
def first_met_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    records: wp.array(dtype=float),
    # Rays:
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Where they start:
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    bodies: wp.array(dtype=OwnBody),
    patches: wp.array(dtype=int),
    inside: wp.array(dtype=wp.uint8),
    # Which are asked:
    index: wp.array(dtype=int),
    indexed: int,
    numbers: wp.array(dtype=int),
    width: int,
    runs: wp.array(dtype=Run),
    retry: int,
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_t: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_state: wp.array(dtype=int),
):
    """One thread per block of asked rays; width > 0: per row of tiles of the picture."""
    block = first + wp.tid()
    first_met_block(
        block,
        mesh_id,
        records,
        point,
        normal,
        direction,
        facets,
        pixel,
        bodies,
        patches,
        inside,
        index,
        indexed,
        numbers,
        width,
        runs,
        retry,
        out_triangle,
        out_u,
        out_v,
        out_t,
        out_status,
        out_state,
    )


def first_met(
    mesh: int,
    records: wp.array,
    rays: list[wp.array],
    start: list,
    leaving: Sequence[Leaving],
    index: wp.array | None,
    numbers: wp.array,
    width: int,
    retry: bool,
    outputs: list[wp.array],
    threads: int = 0,
) -> int:
    """What rays meet first.

    Args:
        mesh: `bvh.Tracer.packets`.
        records: `Scene.triangle_records`.
        rays: vec3 each: points, normals on the rays' side, unit directions.
        start: Where they start: facets; int32, where among these that of each ray is, none: in order; bodies of patches, none:
            those that the rays leave; the patches of triangles; uint8, where rays have gone through a surface: 1 where they are
            in its body (`ray_walk.trace_onward`), none: they are reflected.
        leaving: The rays asked, body after body.
        index: int32, which of the rays; None: all.
        numbers: int32, the pixels of rays.
        width: Of their picture, whose tiles stay together where the pixels of the rays asked ascend, or do so `MOST_RUNS` times;
            0: there is none.
        retry: A ray that meets nothing is asked once more, turned by a few ulp.
        outputs: Triangle, u, v, t, status of the rays asked. What meets its own facet or body first is left: status NONE, with
            what was met (u and v as Warp's queries name them), or triangle `UNASKED`.
        threads: CPU threads; 0: one per core.

    Returns:
        `LEFT` and `MISSED`, where they hold for any ray.
    """
    device = rays[0].device
    asked = numbers.numpy() if index is None else numbers.numpy()[index.numpy()]
    runs, blocks, width = _runs(leaving, asked, width)
    which = [compact.none(int, device) if index is None else index, int(index is not None)]
    state = wp.empty(blocks, dtype=int, device=device)
    inputs = [
        wp.uint64(mesh),
        records,
        *rays,
        *start,
        *which,
        numbers,
        width,
        wp.array(runs, dtype=Run, device=device, copy=False),
        int(retry),
        *outputs,
        state,
    ]
    split = vector.block_count(len(asked)) >= BLOCK_SPLIT_MIN
    launch(first_met_blocks_kernel, blocks, inputs, device, threads, split_min=1 if split else blocks + 1)
    return int(np.bitwise_or.reduce(state.numpy()))


def _runs(leaving: Sequence[Leaving], asked: np.ndarray, width: int) -> tuple[np.ndarray, int, int]:
    """(runs of rays of one body whose pixels ascend; their blocks; the width, or 0 where they are runs of any pixels)."""
    firsts = [each.first for each in leaving]
    falls = np.flatnonzero(asked[1:] <= asked[:-1]) + 1 if width > 0 else []
    if len(falls) > MOST_RUNS:
        width = 0
    elif len(falls):
        firsts = sorted({*firsts, *falls.tolist()})
    if width > 0 and asked[firsts].min() < 0:
        width = 0
    runs, of_body, before = [], -1, 0
    for first, end in zip(firsts, [*firsts[1:], len(asked)], strict=True):
        if of_body + 1 < len(leaving) and leaving[of_body + 1].first == first:
            of_body += 1
        band, blocks = 0, vector.block_count(end - first)
        if width > 0:
            band = int(asked[first]) // (TILE_HEIGHT * width)
            blocks = int(asked[end - 1]) // (TILE_HEIGHT * width) + 1 - band
        own = leaving[of_body]
        triangles = own.body.first_triangle, own.body.triangle_count
        runs.append((*triangles, own.branches.ptr or 0, first, end, band, before))
        before += blocks
    return np.array(runs, Run.numpy_dtype()), before, width
