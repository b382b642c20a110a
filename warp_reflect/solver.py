"""The bare solver: where does the eye see each point in one mirror?

`solve(mirror, eye, points)` finds the reflection point R on the mirror, its normal and the virtual point, for
analytic mirrors (`PlanarMirror`, `QuadricMirror`) and every other type that registers with `solve_on_device`.

Methods: convex quadrics, Newton's method with a bracketed one-dimensional search behind it (quadrics.py); all
other quadrics, every real root of the reflection equation (quadric_roots.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import singledispatch
from typing import Any

import numpy as np
import warp as wp

from warp_reflect.launch import launch
from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.reflector_maps import ReflectorMap
from warp_reflect.settings import Settings
from warp_reflect.solve_convex import solve_convex_kernel
from warp_reflect.solve_device import quadric_view
from warp_reflect.solve_general import solve_general_kernel
from warp_reflect.solve_map import solve_map_kernel
from warp_reflect.solve_plane import solve_plane_kernel
from warp_reflect.solve_qim import solve_qim_kernel
from warp_reflect.solver_arrays import host_vectors, points_to_device
from warp_reflect.techniques.map_search import search_settings

MAX_PAIRS = 2**31 - 1  # elements of one launch: kernels index with 32-bit integers

METHODS = ("newton", "qim")


@dataclass
class Request:
    """One call of `solve`, on the device.

    Attributes:
        eyes: vec3d [m], world.
        points: vec3 or vec3d [n], world.
        start: Like points, [m * n]; a reflection point near the answer, or None.
        all_roots: Every root is wanted.
        method: One of METHODS.
        threads: CPU threads; 0: one per core.
    """

    eyes: wp.array
    points: wp.array
    start: wp.array | None
    all_roots: bool
    method: str
    threads: int

    @property
    def count(self) -> int:
        return len(self.eyes) * len(self.points)


@dataclass
class Answer:
    """Device arrays of `count` elements, eye by eye; the vector type is that of the points.

    Attributes:
        point, normal, virtual: vec3 or vec3d.
        residual: float32 or float64.
        status: uint8.
        root_count: int32, or None where the roots were not asked for; so the following, [count, k].
        roots, root_length, root_index, root_status: vec3, float, uint8, uint8.
    """

    point: wp.array
    normal: wp.array
    virtual: wp.array
    residual: wp.array
    status: wp.array
    root_count: wp.array | None = None
    roots: wp.array | None = None
    root_length: wp.array | None = None
    root_index: wp.array | None = None
    root_status: wp.array | None = None

    @classmethod
    def empty(cls, request: Request, max_roots: int) -> Answer:
        """Zeros, status NONE; room for roots if they are wanted."""
        vector, device, count = request.points.dtype, request.points.device, request.count
        scalar = wp.float64 if vector is wp.vec3d else wp.float32
        make = lambda shape, dtype: wp.zeros(shape, dtype=dtype, device=device)  # noqa: E731
        k = max_roots if request.all_roots else 0
        return cls(
            make(count, vector),
            make(count, vector),
            make(count, vector),
            make(count, scalar),
            make(count, wp.uint8),
            make(count if k else 0, int),
            make((count if k else 0, k), vector),
            make((count if k else 0, k), scalar),
            make((count if k else 0, k), wp.uint8),
            make((count if k else 0, k), wp.uint8),
        )


@dataclass
class Solution:
    """Reflection points, in the type and library of the points that were given.

    Shapes are for one eye; with eyes [m, 3] each has a leading m. Where there is no reflection point
    everything is 0 and `status` says why; the status of a root that needs a warning (GRAZING, NEAR_CAUSTIC,
    AMBIGUOUS, MAX_ITERATIONS) comes with its values.

    Attributes:
        point: Reflection points R, world, [n, 3]. [scene units]
        normal: Unit normals at R on the reflecting side, [n, 3].
        virtual: Where the eye sees the points: on the ray through R at the path length, [n, 3]. [scene units]
        residual: Sine of the angle between half vector and normal at R, [n].
        status: `Status`, uint8 [n].
        root_count: int32 [n]; this and the following are None unless all roots were asked for.
        roots: Every reflection point, sorted by path length, padded with 0, [n, k, 3]; k is the kind's bound.
        root_length: Path lengths, [n, k]. [scene units]
        root_index: Morse index: 0 minimum (erect), 1 saddle (mirrored), 2 maximum (inverted); uint8 [n, k].
        root_status: `Status`, uint8 [n, k], NONE in the padding.
    """

    point: Any
    normal: Any
    virtual: Any
    residual: Any
    status: Any
    root_count: Any = None
    roots: Any = None
    root_length: Any = None
    root_index: Any = None
    root_status: Any = None


def solve(
    mirror,
    eye,
    points,
    *,
    all_roots: bool = False,
    start: Solution | None = None,
    method: str = "newton",
    device=None,
    threads: int = 0,
) -> Solution:
    """Where the eye sees each point in the mirror.

    Args:
        mirror: A `PlanarMirror`, a `QuadricMirror`, or another type that `solve_on_device` knows.
        eye: World position [3], or several [m, 3]. [scene units]
        points: World positions [n, 3] (or one, [3]); NumPy, a Warp array (of vec3, vec3d or floats), or any
            array with DLPack (PyTorch, CuPy, JAX); lists and integers count as float64. float32 in gives
            float32 out.
        all_roots: Also give every reflection point. Without, the one with Morse index 0, else the shortest of
            index 2, else of index 1.
        start: An earlier solution for as many eyes and points, for speed. On convex mirrors it changes nothing
            but rounding. Where several roots compete, a start whose root has index 0 is followed even if
            another root of index 0 has become shorter; not used with all_roots.
        method: "newton", or "qim" for the search of Lages Miguel et al. 2014 (convex surfaces of revolution).
        device: Warp device for arrays of the host; None: Warp's current one. Device arrays stay where they
            are.
        threads: CPU threads; 0: one per core.

    Returns:
        A `Solution`. Nothing in it is ever NaN; unusable input has the status BAD_INPUT.

    Raises:
        ValueError: wrong shapes, an unknown method, a start of another size, or more than 2^31 - 1 pairs.
        TypeError: a mirror of a type that cannot be solved, or points that are no numbers.
    """
    if method not in METHODS:
        raise ValueError(f"solve method: got {method!r}, expected one of {', '.join(METHODS)}")
    given = points_to_device(points, "solve points", device)
    eyes = host_vectors(eye, "solve eye")
    several = eyes.ndim == 2
    eyes = eyes.reshape(-1, 3)
    if len(eyes) * len(given.array) > MAX_PAIRS:
        raise ValueError(
            f"solve: {len(eyes)} eyes x {len(given.array)} points exceed {MAX_PAIRS} pairs; split the points"
        )
    request = Request(
        wp.array(eyes, dtype=wp.vec3d, device=given.array.device),
        given.array,
        None,
        all_roots,
        method,
        threads,
    )
    if start is not None:
        near = points_to_device(start.point, "solve start.point", device)
        if len(near.array) != request.count or near.array.dtype is not given.array.dtype:
            raise ValueError(
                f"solve start: holds {len(near.array)} points of {near.array.dtype.__name__}, "
                f"expected {request.count} of {given.array.dtype.__name__}"
            )
        request.start = near.array.to(given.array.device)
    answer = solve_on_device(mirror, request)
    shape = (len(eyes), *given.shape) if several else given.shape
    out = lambda array: None if array is None else given.give_back(array, shape)  # noqa: E731
    solution = Solution(*(out(a) for a in (answer.point, answer.normal, answer.virtual, answer.residual)), None)
    solution.status = out(answer.status)
    if all_roots:
        solution.root_count = out(answer.root_count)
        solution.roots = out(answer.roots)
        solution.root_length = out(answer.root_length)
        solution.root_index = out(answer.root_index)
        solution.root_status = out(answer.root_status)
    return solution


@singledispatch
def solve_on_device(mirror, request: Request) -> Answer:
    """Solve a request for one type of mirror; others register theirs with `solve_on_device.register`."""
    raise TypeError(f"solve mirror: got {type(mirror).__name__}, expected PlanarMirror, QuadricMirror or ReflectorMap")


@solve_on_device.register
def _(mirror: PlanarMirror, request: Request) -> Answer:
    if request.method != "newton":
        raise ValueError(f"solve method: {request.method!r} is for quadrics of revolution; a plane needs none")
    answer = Answer.empty(request, 1)
    half_width, half_height = mirror.extent or (0.0, 0.0)
    frame = [wp.vec3d(x) for x in (mirror.point, mirror.normal, mirror.width_axis, mirror.height_axis)]
    outputs = [answer.point, answer.normal, answer.virtual, answer.residual, answer.status]
    outputs += [answer.root_count, answer.roots, answer.root_length, answer.root_index, answer.root_status]
    inputs = [request.eyes, request.points, *frame, wp.float64(half_width), wp.float64(half_height), *outputs]
    launch(solve_plane_kernel, request.count, inputs, request.points.device, request.threads)
    return answer


@solve_on_device.register
def _(mirror: QuadricMirror, request: Request) -> Answer:
    answer = Answer.empty(request, mirror.max_roots)
    view = quadric_view(mirror)
    outputs = [answer.point, answer.normal, answer.virtual, answer.residual, answer.status]
    outputs += [answer.root_count, answer.roots, answer.root_length, answer.root_index, answer.root_status]
    device, threads = request.points.device, request.threads
    if request.method == "qim":
        if not mirror.convex or mirror.canonical.equal < 2 or request.all_roots:
            raise ValueError(
                "solve method 'qim': the curve search finds the one point on a convex surface of revolution; "
                "use method='newton' for other quadrics, other sides and all roots"
            )
        launch(solve_qim_kernel, request.count, [request.eyes, request.points, view, *outputs[:5]], device, threads)
        return answer
    warm = request.start is not None and not (request.all_roots and not mirror.convex)
    start = request.start if warm else request.points
    inputs = [request.eyes, request.points, start, int(warm), view, *outputs]
    kernel = solve_convex_kernel if mirror.convex else solve_general_kernel
    launch(kernel, request.count, inputs, device, threads)
    return answer


@solve_on_device.register
def _(mirror: ReflectorMap, request: Request) -> Answer:
    if request.method != "newton" or request.all_roots:
        raise ValueError("solve: a reflector map holds a convex body, which has one root; use method='newton' alone")
    mirror = mirror.on(request.points.device)
    answer = Answer.empty(request, 1)
    unit_from_world = wp.mat44d(mirror.unit_from_body)
    world_from_unit = wp.mat44d(np.linalg.inv(mirror.unit_from_body))
    chosen = search_settings(Settings(), mirror.resolution)
    inputs = [request.eyes, request.points, mirror.view, unit_from_world, world_from_unit, int(mirror.closed), chosen]
    inputs += [answer.point, answer.normal, answer.virtual, answer.residual, answer.status]
    launch(solve_map_kernel, request.count, inputs, request.points.device, request.threads)
    return answer
