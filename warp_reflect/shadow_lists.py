"""Shadow rays of single points to distant lights and shapes, listed before they are sent: as CUDA runs them.

A CUDA device runs 32 threads in step. Of 32 neighbouring points a few lie in a penumbra and send more rays, for which the
others would wait: so which (shape, point) pairs have rays left is listed first, and each thread sends one of their rays. What a
ray finds is a bit of its pair's own; sums are made afterwards, in the order of the samples. So nothing depends on the order of
a list, which on CUDA is another each time. How long a list is stays on the device (`launch.stays`).

Source: rays that go on in rows without gaps, as in Laine, Karras and Aila, Megakernels Considered Harmful: Wavefront Path
Tracing on GPUs, HPG 2013.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import launch
from warp_reflect.bvh import TRACE_SPLIT_MIN
from warp_reflect.direct import DirectView
from warp_reflect.shadow_neighbours import (
    BOTH,
    DARK,
    LIT,
    Neighbours,
    entry_of,
    found_around,
    place_of,
    point_at,
    share_of,
    shared_share,
    turn_count,
)
from warp_reflect.shadow_starts import Starts
from warp_reflect.shadows import FAR, area_share, is_free, sample_ray, start_of

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": launch.FINITE_FLAGS})

# Threads of a launch over a list whose length the host does not know: four times what a large device runs at a time; those
# that find nothing cost little, and where there is more each takes several.
MOST_THREADS = 1 << 20
RUN = 32  # rays of a pair that are sent at a time: what they find is told by the bits of a number
# Lists: pairs whose rays neighbours share, and pairs that ask on their own.
SHARING = wp.constant(0)
SINGLE = wp.constant(1)


@wp.struct
class Asked:
    """Pairs of a shape and a point from which more rays go, by the number of their entry in `Starts.unshadowed`.

    The other arrays have a row a shape, as that one.
    """

    counts: wp.array(dtype=int)  # pairs of each list
    pairs: wp.array(dtype=int)  # of one list, then of the other
    share: wp.array2d(dtype=float)  # that arrives; negative where it is asked for
    free: wp.array2d(dtype=wp.uint32)  # bit k: whether ray k of a run met nothing
    # Of runs before; length 0 where there is one.
    brought: wp.array2d(dtype=float)
    arrived: wp.array2d(dtype=float)


@wp.func
def with_more(known: float, known_count: int, more: float, count: int) -> float:
    """A share by `count` rays, of which so many have found what is known of it and the rest more."""
    if known_count == 0:
        return more
    return (float(known_count) * known + float(count - known_count) * more) / float(count)


@launch.most_registers(launch.RAY_REGISTERS)
@wp.kernel
def first_rays_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    count: int,
    out_around: Neighbours,
):
    """One thread per point: what the first rays towards each shape find."""
    i = point_at(out_around, first + wp.tid())
    if i < 0:
        return
    place = place_of(out_around, i)
    for k in range(lights.areas.shape[0]):
        if cast_areas[k] != 0 and starts.unshadowed[k, i] > 0.0:
            share = area_share(mesh_id, lights, starts, k, i, 0, count)
            out_around.found[k, place] = wp.uint8(entry_of(share))


@wp.func
def add_pair(asked: Asked, entry: int, k: int, i: int):
    """Put a shape and a point into a list."""
    asked.free[k, i] = wp.uint32(0)
    asked.pairs[wp.atomic_add(asked.counts, entry, 1)] = k * asked.free.shape[1] + i


@wp.kernel
def list_sharing_kernel(
    first: int, cast_areas: wp.array(dtype=int), starts: Starts, out_around: Neighbours, out_asked: Asked
):
    """One thread per point: in a penumbra it is listed; elsewhere neighbours get what its first rays found."""
    i = point_at(out_around, first + wp.tid())
    if i < 0:
        return
    place = place_of(out_around, i)
    for k in range(cast_areas.shape[0]):
        if cast_areas[k] != 0 and starts.unshadowed[k, i] > 0.0:
            if found_around(out_around, k, place) == BOTH:
                add_pair(out_asked, SHARING, k, i)
            else:
                out_around.shared[k, place] = out_around.found[k, place]


@wp.kernel
def list_single_kernel(
    first: int, cast_areas: wp.array(dtype=int), starts: Starts, known_count: int, around: Neighbours, out_asked: Asked
):
    """One thread per point: the share that is known by what neighbours share, or by the first rays where `known_count` is 0."""
    i = point_at(around, first + wp.tid())
    if i < 0:
        return
    place = place_of(around, i)
    for k in range(cast_areas.shape[0]):
        if cast_areas[k] != 0 and starts.unshadowed[k, i] > 0.0:
            found = int(0)
            if known_count > 0:
                found = int(around.shared[k, place]) & BOTH
            else:
                found = found_around(around, k, place)
            share = float(-1.0)
            if found == DARK:
                share = 0.0
            elif found == LIT:
                share = 1.0
            elif known_count > 0:
                share = shared_share(around, starts, k, place, i)
            out_asked.share[k, i] = share
            if share < 0.0:
                add_pair(out_asked, SINGLE, k, i)


@launch.most_registers(launch.RAY_REGISTERS)
@wp.kernel
def listed_rays_kernel(
    first: int,
    threads: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    starts: Starts,
    entry: int,
    begin: int,
    end: int,
    out_asked: Asked,
):
    """One thread per ray of a listed pair, samples begin to end, or per one of several pairs: whether it meets nothing."""
    t = first + wp.tid()
    rays = end - begin
    q = t // rays
    bit = t - q * rays
    row = starts.unshadowed.shape[1]
    while q < out_asked.counts[entry]:
        k = out_asked.pairs[q] // row
        i = out_asked.pairs[q] - k * row
        ray = sample_ray(lights, starts, k, i, begin + bit)
        if ray.weight > 0.0:
            if is_free(mesh_id, start_of(starts, i), ray.direction, ray.reach):
                wp.atomic_add(out_asked.free, k, i, wp.uint32(1) << wp.uint32(bit))
        q += threads // rays


@wp.kernel
def listed_shares_kernel(
    first: int,
    threads: int,
    lights: DirectView,
    starts: Starts,
    entry: int,
    begin: int,
    end: int,
    known_count: int,
    count: int,
    out_around: Neighbours,
    out_asked: Asked,
):
    """One thread per listed pair, or per several: sums what the rays of a run found, as `shadows.area_share` does.

    Behind the last run the share goes to the neighbours, or to the point itself.
    """
    q = first + wp.tid()
    row = starts.unshadowed.shape[1]
    while q < out_asked.counts[entry]:
        k = out_asked.pairs[q] // row
        i = out_asked.pairs[q] - k * row
        brought = float(0.0)
        arrived = float(0.0)
        if begin > known_count:
            brought = out_asked.brought[k, i]
            arrived = out_asked.arrived[k, i]
        free = out_asked.free[k, i]
        sample = int(begin)
        while sample < end:
            weight = sample_ray(lights, starts, k, i, sample).weight
            if weight > 0.0:
                brought += weight
                if (free >> wp.uint32(sample - begin)) & wp.uint32(1) != wp.uint32(0):
                    arrived += weight
            sample += 1
        if end < count:
            out_asked.brought[k, i] = brought
            out_asked.arrived[k, i] = arrived
            out_asked.free[k, i] = wp.uint32(0)
        else:
            more = float(1.0)
            if brought > 0.0:
                more = arrived / brought
            place = place_of(out_around, i)
            if entry == SHARING:
                known = share_of(int(out_around.found[k, place]))
                out_around.shared[k, place] = wp.uint8(BOTH | entry_of(with_more(known, known_count, more, count)))
            else:
                known = float(0.0)
                if known_count > 0:
                    known = share_of(int(out_around.shared[k, place]))
                out_asked.share[k, i] = with_more(known, known_count, more, count)
        q += threads


@launch.most_registers(launch.RAY_REGISTERS)
@wp.kernel
def distant_kernel(
    first: int,
    mesh_id: wp.uint64,
    lights: DirectView,
    cast_distant: wp.array(dtype=int),
    starts: Starts,
    around: Neighbours,
    out_irradiance: wp.array(dtype=wp.vec3),
):
    """One thread per point: the irradiance of distant lights."""
    i = point_at(around, first + wp.tid())
    if i < 0:
        return
    start = start_of(starts, i)
    total = wp.vec3(0.0, 0.0, 0.0)
    for k in range(lights.distant.shape[0]):
        to_light = lights.distant[k].to_light
        cosine = wp.dot(start.n, to_light)
        if cosine > 0.0:
            lit = bool(True)
            if cast_distant[k] != 0:
                lit = is_free(mesh_id, start, to_light, FAR)
            if lit:
                total += cosine * lights.distant[k].irradiance
    out_irradiance[i] = total


@wp.kernel
def areas_kernel(
    first: int,
    lights: DirectView,
    cast_areas: wp.array(dtype=int),
    starts: Starts,
    asked: Asked,
    out_irradiance: wp.array(dtype=wp.vec3),
):
    """One thread per point: the irradiance of shapes is added to that of distant lights, where there are any."""
    i = first + wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    if lights.distant.shape[0] > 0:
        total = out_irradiance[i]
    for k in range(lights.areas.shape[0]):
        unshadowed = starts.unshadowed[k, i]
        if unshadowed > 0.0:
            share = float(1.0)
            if cast_areas[k] != 0:
                share = asked.share[k, i]
            total += unshadowed * share * lights.areas[k].radiance
    out_irradiance[i] = total


def irradiance(
    mesh: wp.uint64,
    lights: DirectView,
    cast: list[wp.array],
    starts: Starts,
    count: int,
    samples: tuple[int, int, int],
    around: Neighbours,
    out_irradiance: wp.array,
    threads: int = 0,
) -> None:
    """As `shadows_vector.irradiance`, through `bvh.Tracer.id`."""
    device = out_irradiance.device
    distant, areas = cast
    first, shared, whole = samples
    turns = turn_count(around, count)
    asked = Asked()
    if len(around.found):
        asked = _none_asked(starts.unshadowed.shape, whole > RUN, device)
        inputs = [mesh, lights, areas, starts, first, around]
        launch.launch(first_rays_kernel, turns, inputs, device, threads, TRACE_SPLIT_MIN)
        # One thread of a CPU makes a list: its atomics are none.
        if shared:
            launch.launch(list_sharing_kernel, turns, [areas, starts, around, asked], device, 1)
            _send_listed(mesh, lights, starts, int(SHARING), (first, shared), around, asked, threads)
        launch.launch(list_single_kernel, turns, [areas, starts, shared, around, asked], device, 1)
        _send_listed(mesh, lights, starts, int(SINGLE), (shared, whole), around, asked, threads)
    if len(distant) or not len(areas):
        inputs = [mesh, lights, distant, starts, around, out_irradiance]
        launch.launch(distant_kernel, turns, inputs, device, threads, TRACE_SPLIT_MIN)
    if len(areas):
        launch.launch(areas_kernel, count, [lights, areas, starts, asked, out_irradiance], device, threads)


def _none_asked(shape: tuple[int, int], runs: bool, device) -> Asked:
    """Two empty lists with room for all pairs; `runs`: one could send several."""
    asked = Asked()
    asked.counts = wp.zeros(2, dtype=int, device=device)
    asked.pairs = wp.empty(shape[0] * shape[1], dtype=int, device=device)
    asked.share = wp.empty(shape, dtype=float, device=device)
    asked.free = wp.empty(shape, dtype=wp.uint32, device=device)
    asked.brought, asked.arrived = (wp.empty(shape if runs else (0, 0), dtype=float, device=device) for _ in range(2))
    return asked


def _send_listed(
    mesh: wp.uint64,
    lights: DirectView,
    starts: Starts,
    entry: int,
    samples: tuple[int, int],
    around: Neighbours,
    asked: Asked,
    threads: int,
) -> None:
    """Send samples [first, end) of all listed pairs."""
    device = starts.rows.device
    known, count = samples
    pairs = len(asked.pairs) if launch.stays(device) else int(asked.counts.numpy()[entry])
    for begin in range(known, max(count, known + 1), RUN):
        end = min(begin + RUN, count)
        rays = end - begin
        if rays:
            sent = rays * min(pairs, MOST_THREADS // rays)
            inputs = [sent, mesh, lights, starts, entry, begin, end, asked]
            # A thread of a CPU sends all rays of a pair.
            launch.launch(listed_rays_kernel, sent, inputs, device, threads, TRACE_SPLIT_MIN, align=rays)
        sent = min(pairs, MOST_THREADS)
        inputs = [sent, lights, starts, entry, begin, end, known, count, around, asked]
        launch.launch(listed_shares_kernel, sent, inputs, device, threads)
