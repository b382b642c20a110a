"""Exact hits from a picture of virtual objects: where forward and backward meet.

The z-buffer of a reflector's virtual meshes names a candidate triangle per mirror pixel. One exact ray-triangle test
settles most pixels; a ray that leaves the candidate across an edge walks to the neighbour there. What is in doubt (no
candidate beside one, an edge of a nearer object close by, a walk that ends) is left to the BVH. A candidate that is hit
is taken only where its 3x3 neighbourhood holds nothing nearer that the ray might meet first.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import compact, raster, vector
from warp_reflect.launch import FINITE_FLAGS, launch, module_part
from warp_reflect.layers import GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Settings, Status
from warp_reflect.shapes import clamp_weights, intersect_triangle
from warp_reflect.techniques.virtual_mesh import VirtualMesh

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

UNSURE = module_part(__name__, "unsure")

CONVERGED = wp.constant(int(Status.CONVERGED))
SKY = wp.constant(int(Status.SKY))

# Who settled a pixel.
DOUBT = wp.constant(0)
CANDIDATE = wp.constant(1)
WALK = wp.constant(2)
EMPTY = wp.constant(3)

# Of the depth key. A surface seen in a mirror is smooth on the screen: its key's second difference stays below this;
# what exceeds it is the edge of a nearer object.
DEPTH_STEP = wp.constant(0.01)
# Of the depth key: a smaller rise may be a step of the same mesh (a tile over its joint); its triangle is tested.
FINE_STEP = wp.constant(2.0e-4)
# Candidates of another patch at nearly the same depth (a label on a bottle) are tested too and the nearer hit is taken.
NEARER_SHARE = wp.constant(0.995)


@wp.struct
class WalkHit:
    triangle: int  # -1: the walk ended outside every triangle it met
    u: float
    v: float
    t: float
    hops: int
    from_behind: int  # 1: the ray leaves through the hit triangle's back
    turned: int  # 1: the hit triangle faces the ray unlike the first one


@wp.func
def walk(
    scene: SceneView,
    neighbours: wp.array(dtype=wp.vec3i),
    origin: wp.vec3,
    direction: wp.vec3,
    start: int,
    hop_count: int,
) -> WalkHit:
    """Test a triangle, then the neighbour across the most violated edge, at most `hop_count` times."""
    result = WalkHit()
    result.triangle = -1
    triangle = start
    previous = int(-1)
    facing = float(0.0)
    hops = int(0)
    while triangle >= 0 and hops <= hop_count:
        t = scene.triangles[triangle]
        hit = intersect_triangle(origin, direction, scene.points[t[0]], scene.points[t[1]], scene.points[t[2]])
        if hit.det == 0.0:
            return result
        if hops == 0:
            facing = hit.det
        if hit.hit != 0:
            if hit.t > 0.0:
                result.triangle = triangle
                weights = clamp_weights(hit.u, hit.v)
                result.u = weights[0]
                result.v = weights[1]
                result.t = hit.t
                result.hops = hops
                if hit.det > 0.0:
                    result.from_behind = 1
                if facing * hit.det < 0.0:
                    result.turned = 1
            return result
        # Edge k joins corners k and k + 1; the weight of the corner opposite to it says how far outside the ray is.
        edge = int(0)
        lowest = hit.v
        if hit.w < lowest:
            lowest = hit.w
            edge = 1
        if hit.u < lowest:
            edge = 2
        following = neighbours[triangle][edge]
        if following == previous:
            return result
        previous = triangle
        triangle = following
        hops += 1
    return result


@wp.func
def cell_key(target: raster.TargetView, cell: int, inside: bool, x: int, y: int, dx: int, dy: int) -> wp.uint64:
    """Z-buffer key beside a pixel, 0 outside the box; `inside`: the whole 3x3 neighbourhood lies in the box."""
    if not inside:
        if x + dx < target.x0 or x + dx >= target.x1 or y + dy < target.y0 or y + dy >= target.y1:
            return wp.uint64(0)
    return target.key[cell + dy * (target.x1 - target.x0) + dx]


@wp.func
def rise(near: float, depth: float, opposite: float) -> float:
    """By how much a neighbour's depth key stands above the surface that the pixel and the opposite neighbour span.

    Only a rise counts: an opposite side that falls away (or is empty, 0) is a farther surface.
    """
    if opposite > 0.0:
        return near - depth - wp.max(depth - opposite, 0.0)
    return near - depth


@wp.kernel
def settle_kernel(
    first: int,
    scene: SceneView,
    neighbours: wp.array(dtype=wp.vec3i),
    closed: wp.array(dtype=int),
    target: raster.TargetView,
    parents: wp.array(dtype=int),
    patches: wp.array(dtype=int),
    # Mirror pixels:
    pixel: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    blocked: wp.array(dtype=wp.uint8),
    # Settings:
    hop_count: int,
    strict: int,
    caution: wp.array(dtype=int),
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_settled: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel."""
    i = first + wp.tid()
    out_settled[i] = wp.uint8(DOUBT)
    if blocked.shape[0] > 0:
        if int(blocked[i]) != 0:
            return
    y = pixel[i] / target.mask_width
    x = pixel[i] - y * target.mask_width
    cell = (y - target.y0) * (target.x1 - target.x0) + x - target.x0
    key = target.key[cell]
    trust_sky = caution[0]
    wary = wp.max(caution[1], strict)
    inside = x > target.x0 and x + 1 < target.x1 and y > target.y0 and y + 1 < target.y1
    if key == wp.uint64(0):
        if trust_sky == 0:
            return
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                if cell_key(target, cell, inside, x, y, dx, dy) != wp.uint64(0):
                    return
        out_triangle[i] = -1
        out_status[i] = wp.uint8(SKY)
        out_settled[i] = wp.uint8(EMPTY)
        return
    drawn = raster.key_triangle(key)
    candidate = parents[drawn]
    patch = patches[drawn]
    hit = walk(scene, neighbours, point[i], direction[i], candidate, hop_count)
    if hit.triangle < 0 or hit.turned != 0:
        return
    if hit.from_behind != 0 and closed[scene.triangle_patch[hit.triangle]] != 0:
        return
    depth = raster.key_depth(key)
    tested = int(-1)
    for k in range(4):
        # The four opposite pairs: (1, 0), (-1, 1), (0, 1), (1, 1) and their negatives.
        dx = wp.where(k == 0, 1, k - 2)
        dy = wp.where(k == 0, 0, 1)
        ahead = cell_key(target, cell, inside, x, y, dx, dy)
        behind = cell_key(target, cell, inside, x, y, -dx, -dy)
        depth_ahead = raster.key_depth(ahead)
        depth_behind = raster.key_depth(behind)
        for side in range(2):
            near_key = wp.where(side == 0, ahead, behind)
            near = wp.where(side == 0, depth_ahead, depth_behind)
            far = wp.where(side == 0, depth_behind, depth_ahead)
            if near_key != wp.uint64(0):
                bend = rise(near, depth, far)
                if bend > DEPTH_STEP * depth:
                    return
                other = raster.key_triangle(near_key)
                separate = patches[other] != patch and near > NEARER_SHARE * depth
                if other != tested and (wary != 0 or separate or bend > FINE_STEP * depth):
                    tested = other
                    second = walk(scene, neighbours, point[i], direction[i], parents[other], hop_count)
                    if second.triangle >= 0 and second.t < hit.t:
                        if second.turned != 0:
                            return
                        hit = second
    if wary != 0 and hit.hops > 0:
        return
    out_triangle[i] = hit.triangle
    out_u[i] = hit.u
    out_v[i] = hit.v
    out_distance[i] = hit.t
    out_status[i] = wp.uint8(CONVERGED)
    out_settled[i] = wp.uint8(wp.where(hit.hops == 0, CANDIDATE, WALK))


@wp.kernel
def coarse_kernel(
    first: int,
    scene: SceneView,
    coarse: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    # Outputs:
    out_settled: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel: in doubt where a triangle whose picture is not whole is hit before what was found."""
    i = first + wp.tid()
    if int(out_settled[i]) == DOUBT:
        return
    found = triangle[i]
    for k in range(coarse.shape[0]):
        other = coarse[k]
        if other != found:
            corner = scene.triangles[other]
            hit = intersect_triangle(
                point[i], direction[i], scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]]
            )
            if hit.hit == 1 and hit.t > 0.0 and (found < 0 or hit.t < distance[i]):
                out_settled[i] = wp.uint8(DOUBT)
                return


def doubt_coarse(
    scene: Scene,
    coarse: wp.array,
    point: wp.array,
    direction: wp.array,
    layer: ReflectionLayer,
    settled: wp.array,
    settings: Settings,
) -> None:
    """Set `settled` to DOUBT where a ray meets one of the triangles `coarse` before what the layer has for it."""
    rays = [coarse, point, direction, layer.triangle, layer.distance]
    if vector.chosen(settings.kernels, scene.device):
        inputs = [scene.triangle_records, *rays, DOUBT, settled]
        from warp_reflect.techniques import refine_vector  # which decides as this module's kernels do

        vector.launch_blocks(refine_vector.coarse_blocks_kernel, len(point), inputs, scene.device, settings.threads)
    else:
        launch(coarse_kernel, len(point), [scene.view, *rays, settled], scene.device, settings.threads)


@wp.kernel(module=UNSURE)
def doubt_kernel(
    first: int, triangle: wp.array(dtype=int), unsure: wp.array(dtype=wp.uint8), out_settled: wp.array(dtype=wp.uint8)
):
    """One thread per mirror pixel: in doubt where it shows a triangle that is not sure to be seen."""
    i = first + wp.tid()
    if triangle[i] >= 0:
        if unsure[triangle[i]] != wp.uint8(0):
            out_settled[i] = wp.uint8(DOUBT)


def doubt_unsure(
    scene: Scene, seen: np.ndarray | None, layer: ReflectionLayer, settled: wp.array, threads: int
) -> None:
    """Set `settled` to DOUBT where a layer shows what may have holes, or what `Scene.seen_in` leaves out."""
    if seen is None and scene.has_hole is None:
        return
    key = "unsure", id(seen)
    if key not in scene.lasting:
        unsure = np.zeros(scene.triangle_count, np.uint8) if seen is None else ~seen
        if scene.has_hole is not None:
            unsure = unsure | scene.has_hole
        # With what it was made from, which so keeps its id.
        scene.lasting[key] = seen, wp.array(unsure.astype(np.uint8), dtype=wp.uint8, device=scene.device)
    launch(doubt_kernel, len(settled), [layer.triangle, scene.lasting[key][1], settled], scene.device, threads)


def in_doubt_of_holes(scene: Scene, layer: ReflectionLayer, threads: int) -> wp.array | None:
    """The pixels that show a triangle that may have holes, see `compact.padded`; None: no triangle of the scene has."""
    if scene.has_hole is None:
        return None
    settled = wp.full(layer.pixels.count, CANDIDATE, dtype=wp.uint8, device=scene.device)
    doubt_unsure(scene, None, layer, settled, threads)
    return compact.padded(settled, DOUBT)[0]


def fixed_caution(trust_sky: bool, wary: bool, device) -> wp.array:
    """How `settle` takes a picture, int32 [2].

    Args:
        trust_sky: No virtual triangle was dropped: an empty neighbourhood is sky.
        wary: The picture may be off by a part of a pixel: every candidate of the neighbourhood is tested, and what none of
            them is hit by directly is left to the BVH.
    """
    caution = wp.zeros(2, dtype=int, device=device)
    for k, asked in enumerate((trust_sky, wary)):
        if asked:
            caution[k : k + 1].fill_(1)
    return caution


def settle(
    scene: Scene,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    target: raster.Target,
    mesh: VirtualMesh,
    layer: ReflectionLayer,
    blocked: wp.array,
    settings: Settings,
    caution: wp.array,
    seen: np.ndarray | None = None,
) -> wp.array:
    """Write the hits that a virtual picture settles into the layer.

    Args:
        target: The reflector's virtual z-buffer over `pixels.box`, ids are virtual triangles.
        mesh: What was drawn.
        layer: Receives triangle, u, v, distance, status of the settled pixels, and their counts.
        blocked: uint8 [pixels.count], 1 where the mirror's own body (which is not drawn) is in the way; length 0: nowhere.
        caution: From `fixed_caution`, or found out where the picture was drawn.
        seen: Which triangles of the scene the mirror may show, see `Scene.seen_in`: a walk may end on another.

    Returns:
        Indices into `pixels` of what the BVH must decide, see `compact.padded`.
    """
    settled = wp.empty(pixels.count, dtype=wp.uint8, device=scene.device)
    picture = [mesh.parents, mesh.patches, pixels.pixel, pixels.point, pixels.direction, blocked]
    how = [settings.walk_hops, int(settings.refine == "strict"), caution]
    outputs = [layer.triangle, layer.u, layer.v, layer.distance, layer.status, settled]
    if vector.chosen(settings.kernels, scene.device):
        from warp_reflect.techniques import refine_vector  # which decides as this module's kernels do

        records = [target.view, scene.neighbours, scene.triangle_records]
        limits = [DEPTH_STEP, FINE_STEP, NEARER_SHARE, CONVERGED, SKY]
        inputs = [*records, *picture, *how, *limits, *outputs]
        kernel, blocks = refine_vector.settle_blocks_kernel, refine_vector.BLOCKS
        vector.launch_blocks(kernel, pixels.count, inputs, scene.device, settings.threads, blocks)
    else:
        inputs = [scene.view, scene.neighbours, scene.closed_patches, target.view, *picture, *how, *outputs]
        launch(settle_kernel, pixels.count, inputs, scene.device, settings.threads)
    if mesh.coarse is not None and len(mesh.coarse):
        doubt_coarse(scene, mesh.coarse, pixels.point, pixels.direction, layer, settled, settings)
    # Whether a hole is met, and what is behind it, is for a ray to say.
    doubt_unsure(scene, seen, layer, settled, settings.threads)
    layer.statistics.later(lambda: _counts(settled))
    return compact.padded(settled, DOUBT)[0]


def _counts(settled: wp.array) -> dict[str, int]:
    """Pixels by who settled them."""
    counts = np.bincount(settled.numpy(), minlength=4)
    names = {"candidate": CANDIDATE, "walk": WALK, "empty": EMPTY, "bvh": DOUBT}
    return {name: int(counts[who]) for name, who in names.items()}
