"""The bare solver's kernel for quadrics on which several reflection points compete; in float64."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_reflect.quadric_roots import FLAG_RING, all_reflections, flatness, polish_root
from warp_reflect.quadrics import unit_roundoff
from warp_reflect.solve_device import (
    AMBIGUOUS,
    BAD_INPUT,
    CONVERGED,
    HIDDEN,
    INSIDE,
    NEAR_CAUSTIC,
    TOUCHING,
    UNREFLECTED,
    Found,
    QuadricView,
    chord_enters,
    cut_far,
    finite,
    grazing_limit,
    judge,
    near_limit,
    signed_distance,
    to_double,
    touch,
    unit_scale,
    write_answer,
    write_root,
)

# Unrolled, the searches in loops of known length would be compiled many times over.
wp.set_module_options({"enable_backward": False, "max_unroll": 2})

FOLLOW_FLAT = wp.constant(wp.float64(4.0e-3))  # a flatter start is near a caustic: all roots are looked at


@wp.kernel
def solve_general_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    start: wp.array(dtype=Any),
    warm: int,
    view: QuadricView,
    # Outputs:
    out_point: wp.array(dtype=Any),
    out_normal: wp.array(dtype=Any),
    out_virtual: wp.array(dtype=Any),
    out_residual: wp.array(dtype=Any),
    out_status: wp.array(dtype=wp.uint8),
    out_root_count: wp.array(dtype=int),
    out_roots: wp.array2d(dtype=Any),
    out_root_length: wp.array2d(dtype=Any),
    out_root_index: wp.array2d(dtype=wp.uint8),
    out_root_status: wp.array2d(dtype=wp.uint8),
):
    """One thread per pair of eye and point."""
    row = first + wp.tid()
    n = points.shape[0]
    zero = points[row % n]
    eye_world = eyes[row / n]
    target_world = to_double(zero)
    if not finite(eye_world) or not finite(target_world):
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    # The scan works in float64 whatever the points are: its polynomial is beyond float32.
    eye = view.unit_from_world * (eye_world - view.origin)
    target = view.unit_from_world * (target_world - view.origin)
    scale = unit_scale(eye, target, view)
    size = view.size * scale
    eye = eye / scale
    target = target / scale
    roundoff = wp.float64(unit_roundoff(zero[0]))
    a = view.sign * view.lam
    b = view.sign * view.b
    c = view.sign * view.c
    one = wp.float64(1.0)
    limit = wp.float64(TOUCHING) * roundoff
    eye_height = signed_distance(eye, a, b, c)
    target_height = signed_distance(target, a, b, c)
    eye_limit = limit * wp.max(one, wp.length(eye))
    target_limit = limit * wp.max(one, wp.length(target))
    if wp.abs(eye_height) <= eye_limit:
        out_status[row] = wp.uint8(BAD_INPUT)
        return
    if eye_height < wp.float64(0.0) or target_height < -target_limit:
        out_status[row] = wp.uint8(INSIDE)
        return
    best = Found()
    best_rank = int(4)
    count = int(0)
    far = near_limit(zero[0])
    if target_height <= target_limit:
        # A point on the mirror is its own reflection, the shortest path of all.
        best = touch(target, eye, a, b)
        if best.status == CONVERGED:
            best_rank = 0
            if out_roots.shape[1] > 0:
                write_root(
                    zero, best, 0, 0, view, size, row, out_roots, out_root_length, out_root_index, out_root_status
                )
            count = 1
        else:
            best = Found()
    e = cut_far(eye, far)
    t = cut_far(target, far)
    if warm != 0 and count == 0:
        s = view.unit_from_world * (to_double(start[row]) - view.origin) / scale
        if finite(s):
            near = polish_root(s, e, t, a, b, c)
            there = view.sheet == 0 or near.point[2] * wp.float64(view.sheet) > wp.float64(0.0)
            # Index 0 is what is wanted: the branch of the start is followed, no scan.
            if near.valid != 0 and near.index == 0 and there and near.flat > FOLLOW_FLAT:
                best = judge(near.point, eye, target, a, b, roundoff, grazing_limit(zero[0]))
                if best.status == CONVERGED:
                    out_status[row] = wp.uint8(CONVERGED)
                    write_answer(zero, best, view, size, row, out_point, out_normal, out_virtual, out_residual)
                    return
                best = Found()
    found, root_count = all_reflections(e, t, a, b, c, view.equal, view.sheet)
    for k in range(root_count):
        code = int(found[k, 4])
        ring = code & FLAG_RING
        index = code - ring
        r = wp.vec3d(found[k, 0], found[k, 1], found[k, 2])
        if count > 0 and k == 0 and wp.length(r - target) <= wp.float64(16.0) * target_limit:
            continue
        root = judge(r, eye, target, a, b, roundoff, grazing_limit(zero[0]))
        if root.status == CONVERGED:
            if ring != 0:
                root.status = AMBIGUOUS
            elif flatness(r, eye, target, a, b) < wp.float64(16.0) * wp.sqrt(roundoff):
                root.status = NEAR_CAUSTIC
        if count < out_roots.shape[1]:
            write_root(
                zero,
                root,
                count,
                index,
                view,
                size,
                row,
                out_roots,
                out_root_length,
                out_root_index,
                out_root_status,
            )
        count = count + 1
        # Index 0 first, then 2, then 1; within a class the first one is the shortest.
        rank = index
        if index > 0:
            rank = 3 - index
        if rank < best_rank:
            best_rank = rank
            best = root
    if out_roots.shape[1] > 0:
        out_root_count[row] = wp.min(count, out_roots.shape[1])
    if count == 0:
        if chord_enters(eye, target, a, b, c, 0):
            out_status[row] = wp.uint8(HIDDEN)
        else:
            out_status[row] = wp.uint8(UNREFLECTED)
        return
    out_status[row] = wp.uint8(best.status)
    write_answer(zero, best, view, size, row, out_point, out_normal, out_virtual, out_residual)


for _vector, _scalar in ((wp.vec3, wp.float32), (wp.vec3d, wp.float64)):
    wp.overload(
        solve_general_kernel,
        {
            "points": wp.array(dtype=_vector),
            "start": wp.array(dtype=_vector),
            "out_roots": wp.array2d(dtype=_vector),
            "out_root_length": wp.array2d(dtype=_scalar),
            "out_point": wp.array(dtype=_vector),
            "out_normal": wp.array(dtype=_vector),
            "out_virtual": wp.array(dtype=_vector),
            "out_residual": wp.array(dtype=_scalar),
        },
    )
