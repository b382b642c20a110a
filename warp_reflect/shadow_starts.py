"""Where the shadow rays of points start, a row a component: what plain and vector kernels send rays from.

Source: ray starts on the smooth surface behind the facets as in Hanika, Hacking the Shadow Terminator, Ray Tracing Gems II,
2021, chapter 4; samples in the order of Roberts' R2 sequence (The Unreasonable Effectiveness of Quasirandom Sequences, 2018),
shifted from pixel to pixel by Jimenez' interleaved gradient noise (Next Generation Post Processing in Call of Duty: Advanced
Warfare, SIGGRAPH 2014).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

from warp_reflect import compact, vector
from warp_reflect.direct import DirectView, Points, area_irradiance
from warp_reflect.launch import launch, module_part, reads
from warp_reflect.ray_walk import ray_offset, scene_facet_normal
from warp_reflect.scene import SHAPE_QUADRIC, Scene, SceneView
from warp_reflect.surface import hit_normal, shown_normal

wp.set_module_options({"enable_backward": False})
PLAIN = module_part(__name__, "plain")  # what vector kernels do elsewhere

ROWS = wp.constant(11)  # of `Starts.rows`: point, normal, facet's normal, shift of the samples
LEAST_SQUARE = wp.constant(1.0e-30)  # keeps quotients finite
# 1 / g and 1 / g^2 of g^3 = g + 1.
R2_X = wp.constant(0.7548776662466927)
R2_Y = wp.constant(0.5698402909980532)
PLACE_ROWS = 3  # behind the others: the points themselves, where something still asks for them
ROOM = "room for shadow starts", None  # of `Scene.facts`


@wp.struct
class RayStart:
    """Where a point's shadow rays start."""

    at: wp.vec3  # the point itself
    p: wp.vec3
    side: wp.vec3  # the facet's unit normal on the viewer's side
    n: wp.vec3  # the normal to shade with, on the viewer's side


@wp.func
def above_tangent(p: wp.vec3, corner: wp.vec3, normal: wp.vec3) -> wp.vec3:
    """How far a point lies below the tangent plane of a corner, as a step up to it."""
    return wp.max(wp.dot(corner - p, normal), 0.0) * normal


@wp.func
def ray_start(
    scene: SceneView, triangle: int, u: float, v: float, direction: wp.vec3, normals: wp.array(dtype=wp.vec3), i: int
) -> RayStart:
    """The start of shadow rays from a point on a triangle that is seen along a unit direction.

    On the surface that the facets stand for where that bulges out, so that a ball's facets do not shade each other.
    """
    tri = scene.triangles[triangle]
    a = scene.points[tri[0]]
    b = scene.points[tri[1]]
    c = scene.points[tri[2]]
    w = 1.0 - u - v
    at = w * a + u * b + v * c
    p = at
    own = hit_normal(scene, triangle, u, v)
    facet = scene_facet_normal(scene, triangle)
    turned = wp.where(wp.dot(own, direction) > 0.0, -1.0, 1.0)
    side = wp.where(wp.dot(facet, own) < 0.0, -turned, turned) * facet
    index = scene.normal_index[triangle]
    patch = scene.triangle_patch[triangle]
    if index[0] >= 0:
        s = turned
        p += w * above_tangent(p, a, s * scene.normals[index[0]])
        p += u * above_tangent(p, b, s * scene.normals[index[1]])
        p += v * above_tangent(p, c, s * scene.normals[index[2]])
    elif scene.patches[patch].shape == SHAPE_QUADRIC:
        # One Newton step onto f(q) = x^2 + y^2 + a z^2 + b z - c: the point is within a facet's sagitta of it.
        m = scene.patches[patch].unit_from_scene
        abc = scene.patches[patch].quadric
        q = wp.transform_point(m, p)
        f = q[0] * q[0] + q[1] * q[1] + (abc[0] * q[2] + abc[1]) * q[2] - abc[2]
        gradient = wp.transform_vector(wp.transpose(m), wp.vec3(2.0 * q[0], 2.0 * q[1], 2.0 * abc[0] * q[2] + abc[1]))
        step = (-f / wp.max(wp.dot(gradient, gradient), LEAST_SQUARE)) * gradient
        if wp.dot(step, side) > 0.0:
            p += step
    n = shown_normal(normals, i, own)
    if wp.dot(n, direction) > 0.0:
        n = -n
    start = RayStart()
    start.at = at
    # The corners', not the point's own: near the origin of a large facet it is off by their rounding.
    start.p = p + wp.max(ray_offset(a), wp.max(ray_offset(b), ray_offset(c))) * side
    start.side = side
    start.n = n
    return start


@wp.func
def gradient_noise(x: float, y: float) -> float:
    """Interleaved gradient noise of a pixel, 0 to 1."""
    a = 0.06711056 * x + 0.00583715 * y
    b = 52.9829189 * (a - wp.floor(a))
    return b - wp.floor(b)


@wp.func
def sample_shift(pixel: wp.array(dtype=int), i: int, width: int) -> wp.vec2:
    """A pixel's own shift of the samples."""
    number = int(i)
    if pixel.shape[0] > 0:
        number = pixel[i]
    row = number // width
    x = float(number - row * width)
    y = float(row)
    return wp.vec2(gradient_noise(x, y), gradient_noise(y + 113.0, x + 71.0))


@wp.func
def sample_place(k: int, shift: wp.vec2) -> wp.vec2:
    """Sample k of a sequence that fills the unit square evenly from its beginning on."""
    x = 0.5 + R2_X * float(k) + shift[0]
    y = 0.5 + R2_Y * float(k) + shift[1]
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.struct
class Starts:
    """`RayStart` of points, and what else their rays need; a row a component, of at least whole blocks."""

    rows: wp.array2d(dtype=float)
    unshadowed: wp.array2d(dtype=float)  # by each shape, 0 where nothing is seen


@wp.kernel(module=PLAIN)
def starts_kernel(
    first: int,
    scene: SceneView,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    out_start: Starts,
):
    """One thread per point; `width` 0: points of no image."""
    i = first + wp.tid()
    areas = out_start.unshadowed.shape[0]
    if triangle[i] < 0:
        for row in range(ROWS):
            out_start.rows[row, i] = 0.0
        for k in range(areas):
            out_start.unshadowed[k, i] = 0.0
        return
    start = ray_start(scene, triangle[i], u[i], v[i], direction[i], normals, i)
    shift = sample_place(i, wp.vec2(0.0, 0.0))
    if width > 0:
        shift = sample_shift(pixel, i, width)
    for k in range(3):
        out_start.rows[k, i] = start.p[k]
        out_start.rows[3 + k, i] = start.n[k]
        out_start.rows[6 + k, i] = start.side[k]
    out_start.rows[9, i] = shift[0]
    out_start.rows[10, i] = shift[1]
    for k in range(areas):
        out_start.unshadowed[k, i] = area_irradiance(lights.areas[k], start.at, start.n)


@wp.func
def row_vector(rows: wp.array2d(dtype=float), row: int, i: int) -> wp.vec3:
    """Three rows from one on, of point i: 0 where its rays start, 3 its normal, 6 its facet's."""
    return wp.vec3(rows[row, i], rows[row + 1, i], rows[row + 2, i])


@contextmanager
def kept_room(scene: Scene, count: int) -> Iterator[wp.array | None]:
    """Memory for the rows of so many points, which the scene keeps for the next ones; None on CUDA, which has a pool for it.

    None also for work that is done again and again: by then it may be another's.

    Memory of this size is given back to a CPU's system at once, and touching as much anew costs more than filling it.
    """
    if scene.device.is_cuda or not reads():
        yield None
        return
    words = (int(ROWS) + PLACE_ROWS) * vector.BLOCK * vector.block_count(count)
    # Taken out, as another thread may render the same scene.
    room = scene.facts.pop(ROOM, None)
    if room is None or len(room) < words:
        room = wp.empty(words, dtype=float, device=scene.device)
    try:
        yield room
    finally:
        scene.facts[ROOM] = room


def rows_in(room: wp.array | None, rows: int, padded: int, device) -> wp.array:
    """Rows of `padded` numbers, in a room or, without one, anew."""
    if room is None:
        return wp.empty((rows, padded), dtype=float, device=device)
    return room[: rows * padded].reshape((rows, padded))


def starts_of(
    scene: Scene,
    points: Points,
    normals: wp.array | None,
    area_count: int,
    threads: int = 0,
    numbered: bool = False,
    kernels: str = "auto",
    room: wp.array | None = None,
    shaped: bool = True,
) -> Starts:
    """Where the shadow rays of points start.

    Args:
        scene: With a triangle at least.
        points: What is seen.
        normals: From `normal_maps.prepare_normals`; None: no normal maps.
        area_count: Shapes whose unshadowed irradiance is wanted: all or none.
        threads: CPU threads; 0: one per core.
        numbered: Samples are shifted by the points' numbers, as for points of no image.
        kernels: `Settings.kernels`.
        room: From `kept_room`, where the rows lie as long as it is; None: they have memory of their own.
        shaped: Whether any of their rays go to shapes or the sky. Others ask neither for facets nor for the samples' shift, and
            vector kernels leave those rows as they are.
    """
    device, count = scene.device, len(points.triangle)
    if normals is None:
        normals = compact.none(wp.vec3, device)
    starts = Starts()
    padded = vector.BLOCK * vector.block_count(count)
    starts.rows = rows_in(room, int(ROWS), padded, device)
    starts.unshadowed = wp.empty((area_count, padded), dtype=float, device=device)
    width = 0 if numbered else points.width
    if vector.chosen(kernels, device):
        from warp_reflect import shadow_starts_vector  # which fills this module's rows

        shadow_starts_vector.starts_of(scene, points, normals, starts, width, threads, room, shaped)
        return starts
    at = [points.triangle, points.u, points.v, points.direction, normals, points.pixel, width]
    launch(starts_kernel, count, [scene.view, scene.lights.direct, *at, starts], device, threads)
    return starts
