"""The z-buffer rasteriser: the eye view, cube faces and virtual meshes all go through `rasterise`.

Coverage is decided in integers: pixel coordinates are rounded to 1/256 pixel and edge functions are exact 64-bit
sums, with the top-left rule, so that triangles that share an edge own each pixel centre exactly once. Depth is a key
that is linear on the screen and grows towards the eye (`layers.project`); ties go to the lower triangle id, so a
picture does not depend on the order of drawing. Two phases: `cull_kernel` keeps the triangles that cover a pixel centre
of the target (on the CPU run by run), `draw_kernel` draws the survivors, each CPU thread its own band of rows; on a device
threads share out what is large (`raster_pieces.py`).

Source of the fixed-point rule: Direct3D 11.3 functional specification, section 3.4 (coordinate snapping and the
top-left rule); 8 sub-pixel bits as there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.compact import listed, none
from warp_reflect.launch import launch, launch_bands, module_part, shared_by, stays
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, project
from warp_reflect.scene import Scene
from warp_reflect.shapes import unit

wp.set_module_options({"enable_backward": False})
PLAIN = module_part(__name__, "plain")  # what vector kernels do elsewhere
RAYS = module_part(__name__, "rays")

SUBPIXEL = wp.constant(256)  # positions per pixel
HALF_PIXEL = wp.constant(128)
# Pixels. Beyond it a triangle is clipped: 2^14 * 2^8 = 2^22 keeps every product below 2^46, far inside int64.
GUARD = wp.constant(16384.0)
RAY_ALONG_MIN = wp.constant(0.02)  # sine between a ray and a plane below which their crossing says nothing of depth
# Of the path: a crossing farther than this from the virtual triangle's depth lies outside the triangle.
RAY_TRUST = wp.constant(0.25)
DROPPED = wp.constant(-1.0)  # depth key of a vertex that has no picture
TILE_SIDE = 8  # pixels: the most rows of a tile of the vector kernel
BALANCED_BY = 64  # every such triangle is looked at for where bands of rows end
PIXELS_PER_TRIANGLE = 350  # pixels that are drawn in the time of a small triangle
CULL_RUNS = 4  # of triangles, for each thread: what one thread must not share
CLIP_VERTICES = 9  # a triangle against five planes has at most eight corners

_polygon = wp.types.matrix(shape=(CLIP_VERTICES, 4), dtype=wp.float32)


@wp.struct
class TargetView:
    """A z-buffer over the box [x0, x1) x [y0, y1) of an image of the given width."""

    key: wp.array(dtype=wp.uint64)  # row-major over the box; 0 empty
    x0: int
    y0: int
    x1: int
    y1: int
    column_first: int  # of the box, those drawn: [column_first, column_end)
    column_end: int
    mask: wp.array(dtype=int)  # per image pixel; drawn only where equal to mask_value
    mask_value: int  # 0: no mask
    mask_width: int
    key_min: float  # depth keys at or below it lie beyond the far plane
    near: float
    far: float
    orthographic: int
    painter: int  # 1: a triangle has one depth, that of its middle
    # Exact depth of virtual triangles (see `attach_rays`), two vectors per cell; length 0: the depth key is interpolated.
    ray: wp.array(dtype=wp.vec4)


@wp.struct
class PlaneView:
    """The plane n . x = offset of a triangle in the frame of the rays."""

    n: wp.vec3
    offset: float


@dataclass
class Target:
    """A z-buffer and where it lies in its image."""

    view: TargetView
    key: wp.array
    box: tuple[int, int, int, int]


@wp.func
def pack_key(depth_key: float, triangle: int) -> wp.uint64:
    # Positive floats order like their bits; the complement makes the lower id win a tie.
    return (wp.uint64(wp.cast(depth_key, wp.uint32)) << wp.uint64(32)) | wp.uint64(~wp.uint32(triangle))


@wp.func
def key_triangle(key: wp.uint64) -> int:
    """Triangle id of a z-buffer key, -1 where nothing was drawn."""
    if key == wp.uint64(0):
        return -1
    return int(~wp.uint32(key & wp.uint64(0xFFFFFFFF)))


@wp.func
def key_depth(key: wp.uint64) -> float:
    """Depth key of a z-buffer key, 0 where nothing was drawn."""
    return wp.cast(wp.uint32(key >> wp.uint64(32)), wp.float32)


@wp.func
def snap(x: float) -> int:
    return int(wp.floor(x * float(SUBPIXEL) + 0.5))


@wp.func
def needs_clipping(v: wp.vec4) -> bool:
    return v[2] == 0.0 or wp.abs(v[0]) > GUARD or wp.abs(v[1]) > GUARD


@wp.func
def first_centre(low: int) -> int:
    """First pixel whose centre lies at or right of a snapped coordinate."""
    return (low - HALF_PIXEL + SUBPIXEL - 1) >> 8


@wp.func
def last_centre(high: int) -> int:
    return (high - HALF_PIXEL) >> 8


@wp.func
def edge_bias(dx: wp.int64, dy: wp.int64) -> wp.int64:
    # Top-left rule for positive area with y down: a pixel centre on a left or top edge is inside.
    if dy < wp.int64(0) or (dy == wp.int64(0) and dx > wp.int64(0)):
        return wp.int64(0)
    return wp.int64(-1)


@wp.func
def pixel_step(d: wp.int64) -> wp.int64:
    # Apart from its caller: Warp merges equal constants of one function whatever their types.
    return d * wp.int64(256)


@wp.func
def ray_key(target: TargetView, cell: int, plane: PlaneView, interpolated: float) -> float:
    """Depth key 1 / (eye -> mirror -> plane) of the ray of a cell.

    Straight virtual triangles are wrong in depth; the ray's own distance to the triangle's plane orders them right. Where
    the ray runs along the plane, or meets it far from where the virtual triangle says, the latter stands.
    """
    origin = target.ray[2 * cell]
    direction = target.ray[2 * cell + 1]
    # The interpolated key is 1 / depth along the camera's axis; direction.w is the eye ray's length at depth 1.
    path = direction[3] / interpolated
    along = plane.n[0] * direction[0] + plane.n[1] * direction[1] + plane.n[2] * direction[2]
    height = plane.offset - plane.n[0] * origin[0] - plane.n[1] * origin[1] - plane.n[2] * origin[2]
    estimate = path - origin[3]
    if wp.abs(along) > RAY_ALONG_MIN:
        t = height / along
        if wp.abs(t - estimate) < RAY_TRUST * path:
            estimate = wp.max(t, 0.0)
    return 1.0 / wp.max(origin[3] + estimate, 1.0e-30)


@wp.func
def draw_triangle(
    target: TargetView,
    a: wp.vec3,
    b: wp.vec3,
    c: wp.vec3,
    plane: PlaneView,
    triangle: int,
    row_first: int,
    row_end: int,
):
    """Draw one triangle of (x, y, key) corners into rows [row_first, row_end) of the image."""
    xa = snap(a[0])
    ya = snap(a[1])
    xb = snap(b[0])
    yb = snap(b[1])
    xc = snap(c[0])
    yc = snap(c[1])
    kb = b[2]
    kc = c[2]
    area = wp.int64(xb - xa) * wp.int64(yc - ya) - wp.int64(yb - ya) * wp.int64(xc - xa)
    if area == wp.int64(0):
        return
    if area < wp.int64(0):
        area = -area
        x = xb
        xb = xc
        xc = x
        y = yb
        yb = yc
        yc = y
        k = kb
        kb = kc
        kc = k
    left = wp.max(first_centre(wp.min(xa, wp.min(xb, xc))), target.column_first)
    right = wp.min(last_centre(wp.max(xa, wp.max(xb, xc))), target.column_end - 1)
    top = wp.max(first_centre(wp.min(ya, wp.min(yb, yc))), wp.max(target.y0, row_first))
    bottom = wp.min(last_centre(wp.max(ya, wp.max(yb, yc))), wp.min(target.y1, row_end) - 1)
    if left > right or top > bottom:
        return
    dxa = wp.int64(xc - xb)
    dya = wp.int64(yc - yb)
    dxb = wp.int64(xa - xc)
    dyb = wp.int64(ya - yc)
    dxc = wp.int64(xb - xa)
    dyc = wp.int64(yb - ya)
    px = wp.int64(left * SUBPIXEL + HALF_PIXEL)
    py = wp.int64(top * SUBPIXEL + HALF_PIXEL)
    # Edge opposite to a, b, c at the first pixel centre; the bias moves centres on excluded edges out.
    ea_row = dxa * (py - wp.int64(yb)) - dya * (px - wp.int64(xb))
    eb_row = dxb * (py - wp.int64(yc)) - dyb * (px - wp.int64(xc))
    ec_row = dxc * (py - wp.int64(ya)) - dyc * (px - wp.int64(xa))
    bias_a = edge_bias(dxa, dya)
    bias_b = edge_bias(dxb, dyb)
    bias_c = edge_bias(dxc, dyc)
    inv_area = 1.0 / float(area)
    width = target.x1 - target.x0
    for y in range(top, bottom + 1):
        ea = ea_row
        eb = eb_row
        ec = ec_row
        cell = (y - target.y0) * width - target.x0
        for x in range(left, right + 1):
            if ((ea + bias_a) | (eb + bias_b) | (ec + bias_c)) >= wp.int64(0):
                depth_key = (float(ea) * a[2] + float(eb) * kb + float(ec) * kc) * inv_area
                if depth_key > target.key_min:
                    visible = bool(True)
                    if target.mask_value > 0:
                        visible = target.mask[y * target.mask_width + x] == target.mask_value
                    if visible:
                        if target.ray.shape[0] > 0:
                            depth_key = ray_key(target, cell + x, plane, depth_key)
                        wp.atomic_max(target.key, cell + x, pack_key(depth_key, triangle))
            ea -= pixel_step(dya)
            eb -= pixel_step(dyb)
            ec -= pixel_step(dyc)
        ea_row += pixel_step(dxa)
        eb_row += pixel_step(dxb)
        ec_row += pixel_step(dxc)


@wp.func
def clip_corner(target: TargetView, v: wp.vec4) -> wp.vec4:
    """Homogeneous (X, Y, W, depth) of a projected vertex, see `layers.project`."""
    if target.orthographic != 0:
        return wp.vec4(v[0], v[1], 1.0, v[3])
    if v[2] == 0.0:
        return wp.vec4(v[0], v[1], v[3], v[3])
    return wp.vec4(v[0] * v[3], v[1] * v[3], v[3], v[3])


@wp.func
def plane_distance(target: TargetView, plane: int, v: wp.vec4) -> float:
    if plane == 0:
        return v[3] - target.near
    if plane == 1:
        return v[0] + GUARD * v[2]
    if plane == 2:
        return GUARD * v[2] - v[0]
    if plane == 3:
        return v[1] + GUARD * v[2]
    return GUARD * v[2] - v[1]


@wp.func
def screen_corner(target: TargetView, v: wp.vec4) -> wp.vec3:
    if target.orthographic != 0:
        return wp.vec3(v[0], v[1], 1.0 - v[3] / target.far)
    inv = 1.0 / v[2]
    return wp.vec3(v[0] * inv, v[1] * inv, inv)


@wp.struct
class Clipped:
    """What is left of a triangle: a convex polygon of homogeneous corners."""

    corners: _polygon
    count: int  # 0: nothing


@wp.func
def clip(target: TargetView, a: wp.vec4, b: wp.vec4, c: wp.vec4) -> Clipped:
    """Clip a triangle against the near plane and the guard band in homogeneous space.

    Each crossing is computed from the corner inside to the corner outside, so that two triangles with a common edge
    get bit-equal points on it (Sutherland and Hodgman 1974, with that order fixed).
    """
    polygon = _polygon()
    clipped = _polygon()
    polygon[0] = clip_corner(target, a)
    polygon[1] = clip_corner(target, b)
    polygon[2] = clip_corner(target, c)
    count = int(3)
    for side in range(5):
        kept = int(0)
        for i in range(count):
            current = polygon[i]
            following = polygon[(i + 1) % count]
            d0 = plane_distance(target, side, current)
            d1 = plane_distance(target, side, following)
            if d0 >= 0.0 and kept < CLIP_VERTICES:
                clipped[kept] = current
                kept += 1
            if (d0 >= 0.0) != (d1 >= 0.0) and kept < CLIP_VERTICES:
                if d0 >= 0.0:
                    clipped[kept] = current + (following - current) * (d0 / (d0 - d1))
                else:
                    clipped[kept] = following + (current - following) * (d1 / (d1 - d0))
                kept += 1
        count = kept
        for i in range(count):
            polygon[i] = clipped[i]
    result = Clipped()
    result.corners = polygon
    result.count = wp.where(count < 3, 0, count)
    return result


@wp.func
def in_guard(corner: wp.vec3) -> bool:
    """Whether a corner lies where clipping is to leave it, which rounding may undo where depths are decades apart."""
    return wp.abs(corner[0]) <= GUARD + 1.0 and wp.abs(corner[1]) <= GUARD + 1.0


@wp.func
def draw_clipped(
    target: TargetView,
    a: wp.vec4,
    b: wp.vec4,
    c: wp.vec4,
    plane: PlaneView,
    triangle: int,
    row_first: int,
    row_end: int,
):
    """Clip a triangle, then draw it as a fan."""
    left = clip(target, a, b, c)
    corner = screen_corner(target, left.corners[0])
    for i in range(1, left.count - 1):
        draw_triangle(
            target,
            corner,
            screen_corner(target, left.corners[i]),
            screen_corner(target, left.corners[i + 1]),
            plane,
            triangle,
            row_first,
            row_end,
        )


@wp.func
def centres(target: TargetView, a: wp.vec4, b: wp.vec4, c: wp.vec4) -> wp.vec4i:
    """Pixels (left, top, right, bottom) of the target whose centres the snapped box of an unclipped triangle holds."""
    left = first_centre(snap(wp.min(a[0], wp.min(b[0], c[0]))))
    right = last_centre(snap(wp.max(a[0], wp.max(b[0], c[0]))))
    top = first_centre(snap(wp.min(a[1], wp.min(b[1], c[1]))))
    bottom = last_centre(snap(wp.max(a[1], wp.max(b[1], c[1]))))
    return wp.vec4i(
        wp.max(left, target.x0), wp.max(top, target.y0), wp.min(right, target.x1 - 1), wp.min(bottom, target.y1 - 1)
    )


@wp.func
def covers_centre(target: TargetView, a: wp.vec4, b: wp.vec4, c: wp.vec4) -> bool:
    """False where the snapped bounding box of an unclipped triangle holds no pixel centre of the target."""
    box = centres(target, a, b, c)
    return box[0] <= box[2] and box[1] <= box[3]


@wp.func
def beyond(target: TargetView, v: wp.vec4) -> int:
    """Bits of the sides of a target's frustum that a projected vertex lies beyond: left, right, top, bottom, near."""
    w = wp.where(v[2] > 0.0 or target.orthographic != 0, 1.0, v[3])  # else (x, y) are homogeneous, see `layers.project`
    sides = wp.where(v[0] < float(target.x0) * w, 1, 0)
    sides += wp.where(v[0] > float(target.x1) * w, 2, 0)
    sides += wp.where(v[1] < float(target.y0) * w, 4, 0)
    sides += wp.where(v[1] > float(target.y1) * w, 8, 0)
    return sides + wp.where(v[3] < target.near, 16, 0)


@wp.func
def beside(target: TargetView, a: wp.vec4, b: wp.vec4, c: wp.vec4) -> bool:
    """Whether a triangle that would have to be clipped lies beyond one side of the frustum: it is cheap to tell."""
    return (beyond(target, a) & beyond(target, b) & beyond(target, c)) != 0


@wp.kernel(module=PLAIN)
def cull_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    step: int,
    out_survivors: wp.array(dtype=int),
    out_survivor_count: wp.array(dtype=int),
):
    """One thread per triangle; each run of `step` triangles compacts its survivors at its own start."""
    i = first + wp.tid()
    corners = triangles[i]
    a = screen[corners[0]]
    b = screen[corners[1]]
    c = screen[corners[2]]
    # Dropped vertices, and those that are not a number: no comparison holds for them.
    if not (a[2] >= 0.0 and b[2] >= 0.0 and c[2] >= 0.0):
        return
    if needs_clipping(a) or needs_clipping(b) or needs_clipping(c):
        if beside(target, a, b, c):
            return
    elif not covers_centre(target, a, b, c):
        return
    part = i / step
    place = wp.atomic_add(out_survivor_count, part, 1)
    out_survivors[part * step + place] = i


@wp.func
def at_depth(v: wp.vec4, key: float) -> wp.vec4:
    """A corner at another depth key; one in front of the near plane stays as it is, for the clipper."""
    return wp.vec4(v[0], v[1], wp.where(v[2] > 0.0, key, v[2]), v[3])


@wp.func
def triangle_plane(points: wp.array(dtype=wp.vec3), corners: wp.vec3i) -> PlaneView:
    plane = PlaneView()
    p = points[corners[0]]
    # Unit length: RAY_ALONG_MIN is a sine.
    plane.n = unit(wp.cross(points[corners[1]] - p, points[corners[2]] - p))
    plane.offset = wp.dot(plane.n, p)
    return plane


@wp.struct
class Survivor:
    """A triangle that is drawn: its corners, as they are projected, and what the z-buffer stores of it."""

    a: wp.vec4
    b: wp.vec4
    c: wp.vec4
    triangle: int


@wp.func
def survivor(
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    t: int,
) -> Survivor:
    """Triangle t; at one depth, its middle's, where the target is painted."""
    corners = triangles[t]
    found = Survivor()
    found.a = screen[corners[0]]
    found.b = screen[corners[1]]
    found.c = screen[corners[2]]
    found.triangle = t + id_offset
    if ids.shape[0] > 0:
        found.triangle = ids[t]
    if target.painter != 0:
        middle = (found.a[2] + found.b[2] + found.c[2]) / 3.0
        found.a = at_depth(found.a, middle)
        found.b = at_depth(found.b, middle)
        found.c = at_depth(found.c, middle)
    return found


@wp.func
def draw_survivor(
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    t: int,
    row_first: int,
    row_end: int,
):
    """Draw triangle t into rows [row_first, row_end), clipped where it must be."""
    drawn = survivor(target, screen, triangles, ids, id_offset, t)
    a = drawn.a
    b = drawn.b
    c = drawn.c
    triangle = drawn.triangle
    plane = PlaneView()
    if target.ray.shape[0] > 0:
        plane = triangle_plane(points, plane_triangles[t])
    if needs_clipping(a) or needs_clipping(b) or needs_clipping(c):
        draw_clipped(target, a, b, c, plane, triangle, row_first, row_end)
    else:
        draw_triangle(
            target,
            wp.vec3(a[0], a[1], a[2]),
            wp.vec3(b[0], b[1], b[2]),
            wp.vec3(c[0], c[1], c[2]),
            plane,
            triangle,
            row_first,
            row_end,
        )


@wp.kernel(module=PLAIN)
def draw_kernel(
    first: int,
    target: TargetView,
    screen: wp.array(dtype=wp.vec4),
    triangles: wp.array(dtype=wp.vec3i),
    ids: wp.array(dtype=int),
    id_offset: int,
    step: int,
    survivors: wp.array(dtype=int),
    survivor_count: wp.array(dtype=int),
    points: wp.array(dtype=wp.vec3),
    plane_triangles: wp.array(dtype=wp.vec3i),
    row_first: int,
    row_end: int,
):
    """One thread per survivor of a slice; writes only rows [row_first, row_end)."""
    i = first + wp.tid()
    part = i / step
    if i - part * step >= survivor_count[part]:
        return
    t = survivors[i]
    draw_survivor(target, screen, triangles, ids, id_offset, points, plane_triangles, t, row_first, row_end)


@wp.kernel(module=PLAIN)
def project_kernel(
    first: int, points: wp.array(dtype=wp.vec3), camera: wp.array(dtype=CameraView), out_screen: wp.array(dtype=wp.vec4)
):
    """One thread per vertex."""
    i = first + wp.tid()
    out_screen[i] = project(camera[0], points[i] - camera[0].eye)


@wp.func
def ray_cell(camera: CameraView, pixel: int, x0: int, y0: int, box_width: int) -> int:
    """The cell of a target's box that a pixel of its image is."""
    row = pixel / camera.width
    return (row - y0) * box_width + pixel - row * camera.width - x0


@wp.kernel(module=RAYS)
def ray_image_kernel(
    first: int,
    camera: wp.array(dtype=CameraView),
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    x0: int,
    y0: int,
    box_width: int,
    out_ray: wp.array(dtype=wp.vec4),
):
    """One thread per mirror pixel: (origin, the eye's distance) and (direction, the eye ray's length at depth 1).

    Pixels ascend, and so do their cells: those up to the next one, which have no ray, are cleared.
    """
    i = first + wp.tid()
    cell = ray_cell(camera[0], pixel[i], x0, y0, box_width)
    end = out_ray.shape[0] / 2
    if i + 1 < pixel.shape[0]:
        end = ray_cell(camera[0], pixel[i + 1], x0, y0, box_width)
    for k in range(wp.where(i == 0, 0, cell + 1), end):
        out_ray[2 * k] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        out_ray[2 * k + 1] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    p = point[i]
    d = direction[i]
    to_eye = p - camera[0].eye
    distance = wp.length(to_eye)
    out_ray[2 * cell] = wp.vec4(p[0], p[1], p[2], distance)
    out_ray[2 * cell + 1] = wp.vec4(d[0], d[1], d[2], distance / wp.max(wp.dot(camera[0].forward, to_eye), 1.0e-30))


def attach_rays(
    target: Target, camera: wp.array, pixels: MirrorPixels, threads: int = 0, kernels: str = "auto"
) -> None:
    """Give a target the reflected rays of its pixels: triangles drawn into it are ordered by exact path length.

    Cells without a ray hold zeros. `camera`: `CameraView` [1].
    """
    device = target.key.device
    make = wp.empty if pixels.count else wp.zeros
    target.view.ray = make(2 * len(target.key), dtype=wp.vec4, device=device)
    x0, y0, x1, _ = target.box
    inputs = [camera, pixels.pixel, pixels.point, pixels.direction, x0, y0, x1 - x0, target.view.ray]
    if vector.chosen(kernels, device):
        from warp_reflect import raster_rays_vector  # which draws with this module's functions

        vector.launch_blocks(raster_rays_vector.ray_blocks_kernel, pixels.count, inputs, device, threads)
    else:
        launch(ray_image_kernel, pixels.count, inputs, device, threads)


@wp.kernel
def resolve_kernel(
    first: int,
    key: wp.array(dtype=wp.uint64),
    out_triangle: wp.array(dtype=int),
    out_depth_key: wp.array(dtype=float),
):
    """One thread per pixel."""
    i = first + wp.tid()
    k = key[i]
    out_triangle[i] = key_triangle(k)
    out_depth_key[i] = key_depth(k)


@dataclass(frozen=True)
class Picture:
    """What a z-buffer asks of a camera, for pictures that have none; named as there."""

    size: tuple[int, int]
    near: float
    far: float
    orthographic: bool = False


def make_target(
    camera: Camera | Picture,
    box: tuple[int, int, int, int],
    device,
    mask: wp.array | None = None,
    mask_value: int = 0,
) -> Target:
    """An empty z-buffer over a pixel box of a camera's image, drawn only where `mask` equals `mask_value` (if > 0)."""
    x0, y0, x1, y1 = box
    key = wp.zeros(max(x1 - x0, 0) * max(y1 - y0, 0), dtype=wp.uint64, device=device)
    view = TargetView()
    view.key = key
    view.x0, view.y0, view.x1, view.y1 = box
    view.column_first, view.column_end = x0, x1
    view.mask = mask if mask is not None else none(int, device)
    view.mask_value = mask_value
    view.mask_width = camera.size[0]
    view.key_min = 0.0 if camera.orthographic else 1.0 / camera.far
    view.near = camera.near
    view.far = camera.far
    view.orthographic = int(camera.orthographic)
    view.ray = none(wp.vec4, device)
    return Target(view, key, box)


def rasterise(
    target: Target,
    screen: wp.array,
    triangles: wp.array,
    *,
    ids: wp.array | None = None,
    id_offset: int = 0,
    points: wp.array | None = None,
    plane_triangles: wp.array | None = None,
    threads: int = 0,
    kernels: str = "auto",
) -> wp.array:
    """Draw triangles into a target; repeated calls accumulate.

    Args:
        target: Where to.
        screen: vec4 per vertex as `layers.project` gives it; a key below 0 drops the vertex's triangles.
        triangles: vec3i [triangle_count], indices into `screen`.
        ids: int [triangle_count], what the z-buffer stores per triangle; None: the triangle's index + id_offset.
        id_offset: See `ids`.
        points: vec3, where the target has rays: the triangles' real corners, in the frame of the rays.
        plane_triangles: vec3i [triangle_count], indices into `points`; None: the triangles themselves.
        threads: CPU threads.
        kernels: `Settings.kernels`.

    Returns:
        int: triangles that survived the culling, in parts to be added up.
    """
    count, device = len(triangles), target.key.device
    if count == 0 or len(target.key) == 0:
        return wp.zeros(1, dtype=int, device=device)
    parts = shared_by(count, device, threads)
    step = count if parts == 1 else -(-count // (parts * CULL_RUNS * vector.BLOCK)) * vector.BLOCK
    vectors = vector.chosen(kernels, device)
    if ids is None:
        ids = none(int, device)
    if points is None:
        points = none(wp.vec3, device)
    named = [triangles, ids, id_offset]
    planes = [points, triangles if plane_triangles is None else plane_triangles]

    def bands(some: np.ndarray) -> list[tuple[int, int]]:
        """Of rows, a thread each, as these triangles lie."""
        if parts == 1:
            return [(target.box[1], target.box[3])]
        corners = screen.numpy()[triangles.numpy()[some, 0]]
        return balanced_bands(target.box, corners[corners[:, 2] >= 0.0, 1], parts)

    if vectors and target.view.ray.shape[0] > 0:
        from warp_reflect import raster_rays_vector  # as above

        survivor_count = wp.zeros(1, dtype=int, device=device)
        inputs = [target.view, screen, *named, *planes, survivor_count]
        some = np.arange(0, count, BALANCED_BY)
        launch_bands(raster_rays_vector.draw_rays_kernel, vector.block_count(count), bands(some), inputs, device)
        return survivor_count
    if vectors and not stays(device):
        from warp_reflect import raster_vector  # as above

        if target.box[2] - target.box[0] >= raster_vector.WIDTH_MIN:
            return raster_vector.draw(target, screen, named, step, parts, threads)
    survivors = wp.empty(count, dtype=int, device=device)
    survivor_count = wp.zeros(-(-count // step), dtype=int, device=device)
    inputs = [target.view, screen, triangles, step, survivors, survivor_count]
    launch(cull_kernel, count, inputs, device, threads, align=step)
    if stays(device):
        from warp_reflect import raster_pieces  # as above

        raster_pieces.draw(target.view, count, survivors, survivor_count, [screen, *named, *planes], device)
        return survivor_count
    runs = [slice(k * step, k * step + int(n)) for k, n in enumerate(survivor_count.numpy())]
    drawn = np.concatenate([survivors.numpy()[run] for run in runs])
    numbers, length = (listed(each, device) for each in (drawn, np.array([len(drawn)], np.int32)))
    inputs = [target.view, screen, *named, len(drawn), numbers, length, *planes]
    launch_bands(draw_kernel, len(drawn), bands(drawn[::BALANCED_BY]), inputs, device)
    return survivor_count


def balanced_bands(box: tuple[int, int, int, int], rows: np.ndarray, count: int) -> list[tuple[int, int]]:
    """A box's rows in at most `count` bands that take as long as each other; each but the last has whole tiles.

    Args:
        box: (x0, y0, x1, y1), half open.
        rows: In which row a corner is, of every `BALANCED_BY`th triangle.
        count: Bands.
    """
    x0, first, x1, end = box
    height = end - first
    row = np.fmax(np.fmin(rows, end - 1), first).astype(int) - first  # of what is no number the first
    cost = BALANCED_BY * np.bincount(row, minlength=height) + (x1 - x0) / PIXELS_PER_TRIANGLE
    spent = np.cumsum(cost)
    edges = [
        int(row) // TILE_SIDE * TILE_SIDE for row in np.searchsorted(spent, spent[-1] / count * np.arange(1, count))
    ]
    edges = [first + row for row in (0, *edges, height)]
    return [(start, stop) for start, stop in pairwise(edges) if stop > start]


def kept_triangles(scene: Scene, without: Collection[int]) -> list[tuple[int, int]]:
    """Ranges [first, end) of a scene's triangles without those of some parts."""
    gone = sorted((part.first_triangle, part.triangle_count) for k in without for part in (scene.parts[k],))
    ranges, first = [], 0
    for start, count in [*gone, (scene.triangle_count, 0)]:
        if start > first:
            ranges.append((first, start))
        first = start + count
    return ranges


def draw_scene(
    scene: Scene, camera: Camera, threads: int = 0, without: Collection[int] = (), kernels: str = "auto"
) -> GBuffer:
    """The eye view of a scene: per pixel the nearest triangle and its depth key.

    Args:
        scene, camera: What is drawn, and from where.
        threads: CPU threads; 0: one per core.
        without: Parts that are left out, indices into `scene.parts`.
        kernels: `Settings.kernels`.
    """
    kept = kept_triangles(scene, without)
    drawn = [(scene.view.triangles[first:end], first) for first, end in kept]
    gbuffer = draw_triangles(camera, camera.view(scene), scene.view.points, drawn, threads, kernels)
    if scene.has_hole is not None:
        from warp_reflect import holes  # only scenes with cut-outs need it

        holes.look_past(scene, gbuffer, without, threads)
    return gbuffer


def draw_triangles(
    camera: Camera,
    view: wp.array,
    points: wp.array,
    drawn: Sequence[tuple[wp.array, wp.array | int]],
    threads: int = 0,
    kernels: str = "auto",
) -> GBuffer:
    """The eye view of some triangles.

    Args:
        camera, view: From where; the view in the frame of the points.
        points: vec3.
        drawn: (vec3i triangles, indices into `points`; what the picture holds of each: numbers, or that of the first).
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.
    """
    device = points.device
    width, height = camera.size
    target = make_target(camera, (0, 0, width, height), device)
    screen = wp.empty(len(points), dtype=wp.vec4, device=device)
    vectors = vector.chosen(kernels, device)
    if vectors:
        from warp_reflect import raster_vector  # as above

        vector.launch_blocks(raster_vector.project_blocks_kernel, len(points), [points, view, screen], device, threads)
    else:
        launch(project_kernel, len(points), [points, view, screen], device, threads)
    for triangles, ids in drawn:
        named = {"id_offset": ids} if isinstance(ids, int) else {"ids": ids}
        rasterise(target, screen, triangles, **named, threads=threads, kernels=kernels)
    triangle = wp.empty(width * height, dtype=int, device=device)
    depth_key = wp.empty(width * height, dtype=float, device=device)
    inputs = [target.key, triangle, depth_key]
    if vectors:
        vector.launch_blocks(raster_vector.resolve_blocks_kernel, width * height, inputs, device, threads)
    else:
        launch(resolve_kernel, width * height, inputs, device, threads)
    return GBuffer(camera, view, triangle, depth_key)
