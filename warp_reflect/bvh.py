"""Rays against the whole scene: the owner of the acceleration structure and the only module that queries it.

What becomes of one ray is in `ray_walk.py`. Compiled finite-only, as all that reaches these kernels is finite.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import accumulate

import numpy as np
import warp as wp

from warp_reflect import compact, launch, vector
from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.layers import GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.ray_walk import (
    SKY,
    OwnBody,
    answered,
    moved_direction,
    trace_onward,
    trace_ray,
    trace_ray_from,
)
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Status
from warp_reflect.trees import Tree, resting_tree

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})
NONE = wp.constant(int(Status.NONE))
FREE, OWN, ONWARD = (
    launch.module_part(__name__, name, cpu_compiler_flags=FINITE_FLAGS) for name in ("free", "own", "onward")
)

# Rays for each triangle of a scene that moves, from which on their packets save what fitting the wide tree at another time
# costs: 0.015 to 0.025 us a triangle against 0.6 to 0.9 us a ray, measured in `kitchen` and `one_mirror`.
RAYS_A_TRIANGLE = 0.04
TRACE_SPLIT_MIN = 512  # rays; at 0.3 us and more a ray, half of them outweigh the hand-off to a second thread


@wp.kernel(module=FREE)
def trace_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    body: OwnBody,
    out_triangle: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    """One thread per ray from free space."""
    i = first + wp.tid()
    hit = trace_ray(mesh_id, scene, origins[i], directions[i], wp.vec3(0.0, 0.0, 0.0), -1, body, 1, 0.0)
    out_triangle[i] = hit.triangle
    out_t[i] = hit.t
    out_u[i] = hit.u
    out_v[i] = hit.v


@wp.func
def body_at(
    scene: SceneView,
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    body: OwnBody,
    bodies: wp.array(dtype=OwnBody),
    i: int,
) -> OwnBody:
    """The body that a mirror pixel is on."""
    own = body
    if bodies.shape[0] > 0:
        own = bodies[scene.triangle_patch[facets[pixel[i]]]]
    return own


@wp.func
def is_on(
    scene: SceneView,
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    body: OwnBody,
    bodies: wp.array(dtype=OwnBody),
    i: int,
) -> bool:
    """Whether a mirror pixel is on a body too; nothing is where there is none, -1, which is what pixel 0 counts back to."""
    if pixel[i] < 0:
        return False
    return body_at(scene, facets, pixel, body, bodies, i).first_triangle == body.first_triangle


@launch.most_registers(launch.RAY_REGISTERS)
@wp.kernel
def trace_pixels_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    # Mirror pixels:
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    body: OwnBody,
    bodies: wp.array(dtype=OwnBody),
    index: wp.array(dtype=int),
    indexed: int,
    known: int,
    twice: int,
    blank: int,
    status: wp.array(dtype=wp.uint8),
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per asked mirror pixel, or per ray, without pixels.

    Where a pixel's number is -1 nothing is met, or if not `blank` nothing is written: the entry may be another mirror's.
    A ray's facet is `facets`' own; one without a facet meets nothing. `bodies` are those of patches; of length 0: `body` is all
    pixels' own. `known` is 1 for what `bvh_vector.first_met` has left. Rays that meet nothing are turned and asked `twice`. With
    a `status` a miss beside a hit, or without a neighbour, is asked again. Kernels of their own would each be compiled for as
    long as this one.
    """
    row, _ = wp.tid()
    i = first + row
    if indexed != 0:
        i = index[i]
        if i < 0:
            return
    facet = int(-1)
    there = bool(False)
    if pixel.shape[0] == 0:
        facet = facets[i]
        there = facet >= 0
    elif pixel[i] >= 0:
        facet = facets[pixel[i]]
        there = bool(True)
    if not there:
        if blank != 0:
            out_triangle[i] = -1
            out_u[i] = 0.0
            out_v[i] = 0.0
            out_distance[i] = 0.0
            out_status[i] = wp.uint8(NONE)
        return
    retry = status.shape[0]
    ray = direction[i]
    own = body
    if bodies.shape[0] > 0:
        own = bodies[scene.triangle_patch[facet]]
    if retry != 0:
        if int(status[i]) != SKY:
            return
        again = int(0)
        neighbours = int(0)
        if i > 0:
            if pixel[i - 1] == pixel[i] - 1 and is_on(scene, facets, pixel, own, bodies, i - 1):
                neighbours += 1
                if int(status[i - 1]) != SKY:
                    again = int(1)
        if i + 1 < pixel.shape[0]:
            if pixel[i + 1] == pixel[i] + 1 and is_on(scene, facets, pixel, own, bodies, i + 1):
                neighbours += 1
                if int(status[i + 1]) != SKY:
                    again = int(1)
        if again == 0 and neighbours > 0:
            return
        ray = moved_direction(ray)
    met = answered(known, out_triangle[i], out_u[i], out_v[i], out_distance[i])
    hit = trace_ray_from(mesh_id, scene, point[i], ray, normal[i], facet, own, twice, 0.0, met)
    if retry != 0 and hit.status == SKY:
        return
    out_triangle[i] = hit.triangle
    out_u[i] = hit.u
    out_v[i] = hit.v
    out_distance[i] = hit.t
    out_status[i] = wp.uint8(hit.status)


@wp.kernel(module=OWN)
def own_obstacles_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    # Mirror pixels:
    facets: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    body: OwnBody,
    out_blocked: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    hit = trace_ray(mesh_id, scene, point[i], direction[i], normal[i], facets[pixel[i]], body, 0, 0.0)
    out_blocked[i] = wp.uint8(wp.where(hit.status == SKY, 0, 1))


@launch.most_registers(launch.RAY_REGISTERS)
@wp.kernel(module=ONWARD)
def trace_onward_kernel(
    first: int,
    mesh_id: wp.uint64,
    scene: SceneView,
    facet: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    inside: wp.array(dtype=wp.uint8),
    index: wp.array(dtype=int),
    indexed: int,
    known: int,
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
):
    """One thread per asked ray; one without a facet meets nothing."""
    i = first + wp.tid()
    if indexed != 0:
        i = index[i]
        if i < 0:
            return
    if facet[i] < 0:
        out_triangle[i] = -1
        out_u[i] = 0.0
        out_v[i] = 0.0
        out_distance[i] = 0.0
        out_status[i] = wp.uint8(NONE)
        return
    met = answered(known, out_triangle[i], out_u[i], out_v[i], out_distance[i])
    hit = trace_onward(mesh_id, scene, point[i], direction[i], normal[i], facet[i], int(inside[i]), 0.0, met)
    out_triangle[i] = hit.triangle
    out_u[i] = hit.u
    out_v[i] = hit.v
    out_distance[i] = hit.t
    out_status[i] = wp.uint8(hit.status)


class Tracer:
    """Owner of the triangle BVH of a scene, of one of its parts alone, or of those triangles that a mirror may show.

    Attributes:
        id: Handle for `trace_ray`; valid while this object lives. 0 for a scene without triangles, which has
            no structure and must not be queried.
        origin: float64 [3]; rays are those of the frame world - origin.
    """

    def __init__(self, scene: Scene, part: int | None = None, seen: np.ndarray | None = None):
        # Not the scene itself, which owns this: the pair would wait for the garbage collector, a scene a frame.
        self._device, self._view, self.origin = scene.device, scene.view, scene.origin
        self._tree: Tree | None = None
        # What moves is in a tree that tracers of all times share.
        self._shared = part is None and bool(scene.moving_parts) and not scene.device.is_cuda
        self._turn = scene.turn if self._shared else nullcontext()
        triangles = scene.host_triangles
        if part is not None:
            own = scene.parts[part]
            triangles = triangles[own.first_triangle : own.first_triangle + own.triangle_count]
        if seen is not None:
            # Shrunk to a point, which no ray hits, the others keep the numbering.
            triangles = np.where(seen[:, None], triangles, triangles[:, :1])
        if len(triangles):
            # The traversal wants flat indices. Copied: the structure's memory must not move.
            indices = wp.array(triangles.reshape(-1), dtype=wp.int32, device=scene.device)
            self._tree = resting_tree(scene, indices) if self._shared else Tree(scene.view.points, indices)

    @property
    def id(self) -> int:
        return 0 if self._tree is None else self._tree.to(self._view.points).id

    @property
    def packets(self) -> int:
        """Handle for the snippets of `wide_packets.py`, 0 as `id` is; on the CPU only."""
        return 0 if self._tree is None else self._tree.to(self._view.points).packets

    def own_branches(self, body: OwnBody) -> wp.array:
        """What packets of rays that leave a body pass by (`bvh_vector.first_met`): its branches if it is convex, else none."""
        if self._tree is None or not body.convex or body.alone:
            return compact.none(wp.uint8, self._device)
        return self._tree.to(self._view.points).wide.branches_of(body.first_triangle, body.triangle_count)

    def pays(self, count: int) -> bool:
        """Whether packets of so many rays are worth it: of a scene that moves their tree is fitted again at every time."""
        if not self._shared or self._tree.has_packets(self._view.points):
            return True
        return count >= RAYS_A_TRIANGLE * (len(self._tree.mesh.indices) // 3)

    def at(self, scene: Scene) -> Tracer | None:
        """The same structure over the same stage's scene at another time, in which nothing but places differs; None: anew."""
        if not self._shared:
            return None
        other = copy.copy(self)
        other._view, other.origin = scene.view, scene.origin
        return other

    def refit(self) -> None:
        """Fit the structure to points that were moved in place."""
        if self._tree is not None:
            self._tree.loosen()

    def trace(
        self, origins, directions, threads: int = 0, without: OwnBody | None = None
    ) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """First hits of rays from free space; holes of cut-outs count as there.

        Args:
            origins: Scene frame, finite, shape [n, 3] or a vec3 array.
            directions: Likewise, of unit length.
            threads: CPU threads; 0: one per core.
            without: A convex `body_of` that is not there; a ray that crosses it more than `MAX_STEPS` times hits nothing.

        Returns:
            (triangle int32 [n], -1 none; t float32 [n]; u, v float32 [n], the weights of the second and third
            corner).
        """
        device = self._device
        origins = _vectors(origins, device)
        directions = _vectors(directions, device)
        n = len(origins)
        triangle = wp.full(n, -1, dtype=int, device=device)
        t, u, v = (wp.zeros(n, dtype=float, device=device) for _ in range(3))
        if self._tree is not None:
            with self._turn:
                inputs = [wp.uint64(self.id), self._view, origins, directions, without or OwnBody(), triangle, t, u, v]
                launch.launch(trace_kernel, n, inputs, device, threads)
        return triangle, t, u, v


def _vectors(values, device) -> wp.array:
    if isinstance(values, wp.array):
        return values
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=device)


def body_of(scene: Scene, part: int, convex: bool) -> OwnBody:
    """The triangles of a part as the body that its own reflected rays start on; part -1: none."""
    body = OwnBody()
    if part >= 0:
        body.first_triangle = scene.parts[part].first_triangle
        body.triangle_count = scene.parts[part].triangle_count
        body.convex = int(convex)
    return body


def trace_pixels(
    scene: Scene,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    layer: ReflectionLayer,
    part: int,
    convex: bool,
    index: wp.array | None = None,
    threads: int = 0,
    kernels: str = "auto",
    meets_own: bool = False,
) -> int:
    """Follow the reflected rays of mirror pixels through the BVH and write their hits into the layer.

    Args:
        scene: Its BVH, or that of what the mirror may show, is built if this is the first use.
        gbuffer: Names the facet each pixel starts on.
        pixels: The mirror pixels of a reflector.
        layer: Receives triangle, u, v, distance and status (CONVERGED, SKY, STEP_LIMIT) of the pixels asked.
        part: The mirror itself, index into `scene.parts`.
        convex: The mirror's own triangles are stepped over.
        index: int32, which of the pixels, each at most once, and -1 for none; None: all.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
        meets_own: The mirror is met like anything else, but for the facet that a ray starts on.

    Returns:
        The length of `index`, or the number of pixels.
    """
    leaving = [(0, body_of(scene, -1 if meets_own else part, convex))]
    bodies = compact.none(OwnBody, scene.device)
    return _trace(scene, gbuffer, scene.mirror_tracer(part), pixels, layer, leaving, bodies, index, threads, kernels)


def trace_together(
    scene: Scene,
    gbuffer: GBuffer,
    layers: Sequence[ReflectionLayer],
    mirrors: Sequence[tuple[int, bool]],
    bodies: wp.array,
    threads: int = 0,
    kernels: str = "auto",
) -> None:
    """The same of all pixels of several mirrors, whose layers are slices of a whole.

    Args:
        layers: Of each mirror.
        mirrors: Its part, and whether it is convex.
        bodies: `OwnBody` of every patch that is a mirror's.
    """
    whole, tracer = layers[0].whole, scene.mirror_tracer(mirrors[0][0])
    if any(scene.mirror_tracer(part) is not tracer for part, _ in mirrors):
        # They may not show the same things. Where nothing is read each has an entry for every pixel, those of the whole.
        first = True
        for layer, (part, convex) in zip(layers, mirrors, strict=True):
            leaving, tracer = [(0, body_of(scene, part, convex))], scene.mirror_tracer(part)
            none = compact.none(OwnBody, scene.device)
            _trace(scene, gbuffer, tracer, layer.pixels, layer, leaving, none, None, threads, kernels, first)
            first = False
        return
    firsts = accumulate((layer.pixels.count for layer in layers[:-1]), initial=0)
    leaving = [(first, body_of(scene, *mirror)) for first, mirror in zip(firsts, mirrors, strict=True)]
    _trace(scene, gbuffer, tracer, whole.pixels, whole, leaving, bodies, None, threads, kernels)


def _trace(
    scene: Scene,
    gbuffer: GBuffer,
    tracer: Tracer,
    pixels: MirrorPixels,
    layer: ReflectionLayer,
    leaving: Sequence[tuple[int, OwnBody]],
    bodies: wp.array,
    index: wp.array | None,
    threads: int,
    kernels: str,
    blank: bool = True,
) -> int:
    """What `trace_pixels` does, of pixels body after body, from such a ray on; `bodies` of length 0: there is one.

    Not `blank`: entries without a pixel are left as they are.
    """
    count = pixels.count if index is None else len(index)
    if count == 0:
        return 0
    rays = [
        wp.uint64(tracer.id),
        scene.view,
        gbuffer.triangle,
        pixels.pixel,
        pixels.point,
        pixels.normal,
        pixels.direction,
        leaving[0][1],
        bodies,
    ]
    asked = [pixels.pixel if index is None else index, int(index is not None)]
    outputs = [layer.triangle, layer.u, layer.v, layer.distance, layer.status]
    start = [gbuffer.triangle, pixels.pixel, bodies]
    width = gbuffer.camera.size[0]
    known, left, missed = _first_met(scene, tracer, layer, start, leaving, index, False, threads, kernels, width)
    if left:
        some = _with_status(layer, index, Status.NONE) if known else asked
        inputs = [*rays, *some, known, 0, int(blank), compact.none(wp.uint8, scene.device), *outputs]
        launch.launch(trace_pixels_kernel, len(some[0]), inputs, scene.device, threads, split_min=TRACE_SPLIT_MIN)
    # What CUDA walks loses no ray (`ray_query.py`).
    if (left or missed) and not scene.device.is_cuda:
        some = _with_status(layer, index, Status.SKY) if known else asked
        # The neighbours' answers are read from a copy, so that the order of threads cannot matter.
        inputs = [*rays, *some, 0, 0, 0, wp.clone(layer.status), *outputs]
        launch.launch(trace_pixels_kernel, len(some[0]), inputs, scene.device, threads, split_min=TRACE_SPLIT_MIN)
    if scene.has_hole is not None:
        own = {"body": leaving[0][1]} if not len(bodies) else {"bodies": bodies}
        _past_holes(scene, layer, tracer, gbuffer.triangle, pixels.pixel, threads=threads, **own)
    return count


def _with_status(layer: ReflectionLayer, index: wp.array | None, status: Status) -> list:
    """Which of the rays asked have a status: int32, and 1."""
    found = layer.status.numpy()
    if index is None:
        some = np.flatnonzero(found == np.uint8(status))
    else:
        asked = index.numpy()
        some = asked[found[asked] == np.uint8(status)]
    return [compact.listed(some, layer.status.device), 1]


def _first_met(
    scene: Scene,
    tracer: Tracer,
    layer: ReflectionLayer,
    start: list,
    leaving: Sequence[tuple[int, OwnBody]],
    index: wp.array | None,
    retry: bool,
    threads: int,
    kernels: str,
    width: int,
    inside: wp.array | None = None,
) -> tuple[int, bool, bool]:
    """Answer rays of a layer in packets, where there are packets for it, see `bvh_vector.first_met`.

    Returns:
        (1 if there are, else 0; whether any ray is left; whether any meets nothing).
    """
    pixels = layer.pixels
    count = pixels.count if index is None else len(index)
    if count == 0:
        return 0, False, False
    if launch.stays(scene.device) or not vector.chosen(kernels, scene.device) or not tracer.pays(count):
        return 0, True, True
    from warp_reflect import bvh_vector  # not compiled where it is not asked for

    rays = [pixels.point, pixels.normal, pixels.direction]
    outputs = [layer.triangle, layer.u, layer.v, layer.distance, layer.status]
    inside = compact.none(wp.uint8, scene.device) if inside is None else inside
    start = [*start, scene.view.triangle_patch, inside]
    bodies = [bvh_vector.Leaving(first, body, tracer.own_branches(body)) for first, body in leaving]
    rays = [tracer.packets, scene.triangle_records, rays, start, bodies, index, pixels.pixel]
    state = bvh_vector.first_met(*rays, width, retry, outputs, threads)
    return 1, bool(state & bvh_vector.LEFT), bool(state & bvh_vector.MISSED)


def trace_transmitted(
    scene: Scene,
    layer: ReflectionLayer,
    facet: wp.array,
    inside: wp.array,
    threads: int = 0,
    index: wp.array | None = None,
    kernels: str = "auto",
    width: int = 0,
) -> None:
    """Follow rays that have gone through a surface and write their hits into the layer.

    Args:
        scene: Its BVH is built if this is the first use.
        layer: Its pixels' points, directions, and normals of their facets on the rays' side; receives triangle, u, v,
            distance and status.
        facet: int32 [n], the triangle that each ray starts on.
        inside: uint8 [n], 1 where the ray is in the body of its facet.
        threads: CPU threads; 0: one per core.
        index: int32, which of the rays, each at most once, and -1 for none; None: all.
        kernels: `Settings.kernels`.
        width: Of the picture that the pixels are of; 0: not known.
    """
    pixels, device = layer.pixels, scene.device
    bodies = scene.kept("bodies of parts", None, lambda: _part_bodies(scene))
    start = [facet, compact.none(int, device), bodies]
    anybody = [(0, OwnBody())]
    known, left, _ = _first_met(
        scene, scene.tracer, layer, start, anybody, index, True, threads, kernels, width, inside
    )
    if left:
        some = [facet if index is None else index, int(index is not None)]
        if known:
            some = _with_status(layer, index, Status.NONE)
        count = len(some[0]) if some[1] else pixels.count
        inputs = [wp.uint64(scene.tracer.id), scene.view, facet, pixels.point, pixels.normal, pixels.direction, inside]
        inputs += [*some, known, layer.triangle, layer.u, layer.v, layer.distance, layer.status]
        launch.launch(trace_onward_kernel, count, inputs, device, threads, split_min=TRACE_SPLIT_MIN)
    if scene.has_hole is not None:
        _past_holes(scene, layer, scene.tracer, facet, inside=inside, threads=threads)


def _part_bodies(scene: Scene) -> wp.array:
    """Of every patch the part that it belongs to, as an `OwnBody`."""
    bodies = np.zeros(max(len(scene.patch_shapes), 1), OwnBody.numpy_dtype())
    for part in scene.parts:
        own = list(part.patches)
        bodies["first_triangle"][own], bodies["triangle_count"][own] = part.first_triangle, part.triangle_count
    return wp.array(bodies, dtype=OwnBody, device=scene.device)


def _past_holes(scene: Scene, layer: ReflectionLayer, tracer: Tracer, facet: wp.array, *more, **options) -> None:
    from warp_reflect import holes  # only scenes with cut-outs need it

    holes.go_past(scene, layer, tracer, facet, *more, **options)


def trace_bounced(
    scene: Scene,
    layer: ReflectionLayer,
    facet: wp.array,
    bodies: wp.array,
    threads: int = 0,
    kernels: str = "auto",
    width: int = 0,
) -> None:
    """Follow rays that mirrors of any bodies reflect and write their hits into the layer.

    Args:
        scene: Its BVH is built if this is the first use.
        layer: Its pixels' points, directions and normals on the rays' side; receives triangle, u, v, distance and status.
        facet: int32 [n], the triangle that each ray starts on.
        bodies: `OwnBody` of every patch.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
        width: Of the picture that the pixels are of; 0: not known.
    """
    pixels = layer.pixels
    start = [facet, compact.none(int, scene.device), bodies]
    anybody = [(0, OwnBody())]
    known, left, _ = _first_met(scene, scene.tracer, layer, start, anybody, None, True, threads, kernels, width)
    if left:
        some = _with_status(layer, None, Status.NONE) if known else [facet, 0]
        count = len(some[0]) if known else pixels.count
        inputs = [wp.uint64(scene.tracer.id), scene.view, *start[:2], pixels.point, pixels.normal, pixels.direction]
        inputs += [OwnBody(), bodies, *some, known, 1, 1, compact.none(wp.uint8, scene.device)]
        inputs += [layer.triangle, layer.u, layer.v, layer.distance, layer.status]
        launch.launch(trace_pixels_kernel, count, inputs, scene.device, threads, split_min=TRACE_SPLIT_MIN)
    if scene.has_hole is not None:
        _past_holes(scene, layer, scene.tracer, facet, bodies=bodies, threads=threads)


def own_obstacles(scene: Scene, gbuffer: GBuffer, pixels: MirrorPixels, part: int, threads: int = 0) -> wp.array:
    """Which reflected rays meet the mirror's own body again (or are not settled).

    Args:
        scene: Its part's own BVH is built if this is the first use.
        gbuffer: Names the facet each pixel starts on.
        pixels: The mirror pixels of a reflector.
        part: The mirror itself, index into `scene.parts`.
        threads: CPU threads; 0: one per core.

    Returns:
        uint8 [pixels.count], 1 where the own body is in the way.
    """
    blocked = wp.zeros(pixels.count, dtype=wp.uint8, device=scene.device)
    seen, own = scene.seen_in(scene.parts[part]), scene.parts[part].first_triangle
    if seen is not None and not seen[own]:
        return blocked
    body = body_of(scene, part, convex=False)
    body.alone = 1
    rays = [gbuffer.triangle, pixels.pixel, pixels.point, pixels.normal, pixels.direction]
    inputs = [wp.uint64(scene.part_tracer(part).id), scene.view, *rays, body, blocked]
    launch.launch(own_obstacles_kernel, pixels.count, inputs, scene.device, threads, split_min=TRACE_SPLIT_MIN)
    return blocked
