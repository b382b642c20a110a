"""What lies behind a flat refracting surface, drawn as the eye sees it there, and made exact by refinement.

Source: McTaggart, Half-Life 2 / Valve Source Shading, GDC 2004, as told in Akenine-Moller, Haines, Hoffman, Real-Time
Rendering, 3rd edition, section 9.3.1: what is under water is rendered into a picture of its own. Differs from it by: it is not
the scene as it is, shifted later, but its virtual image: every vertex is put where the eye sees it through the surface, by
Snell's law solved from the point to the surface (`solve_refraction.py` does so in float64), and each pixel's refracted ray
is then tested against the triangle drawn there, as `refine.py` does behind mirrors.

Edges are bent by refraction: how far off its straight picture each edge's middle is seen is measured in every frame, and
triangles are cut until that falls below `edge_px`. Triangles that cross the surface are cut there, where point and image
coincide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, raster, vector
from warp_reflect.launch import launch
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, project
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import planar, refine, refraction_vector
from warp_reflect.techniques.virtual_mesh import COARSE_MAX, CUT_MAX, STRADDLING_MAX, VirtualMesh, lattice_of

wp.set_module_options({"enable_backward": False})

FOOT_STEPS = wp.constant(12)  # of the search: Newton's steps, halved where they leave the bracket
FOOT_DIGITS = wp.constant(1.0e-6)  # of the distance along the surface: a pixel is some 1e-3 of it
NOISE_ULPS = 16.0  # of the coordinates: what is less deep lies on the surface
# Against following rays, counted in rays: solving a vertex or an edge's middle; drawing and refining a pixel.
POINT_COST, PIXEL_COST = 0.35, 0.35


@dataclass(frozen=True)
class Under:
    """What lies under a flat surface, on the side that its winding turns away from.

    Attributes:
        points: float32 [m, 3], scene frame, of these triangles alone.
        triangles: int32 [t, 3], into them.
        parents: int32 [t], the scene's triangle that each belongs to.
        edges: int32 [e, 2], into the points.
        sides: int32 [t, 3], the edges of each triangle.
        point, normal: The surface's plane, float64, scene frame.
        solved: vec3 [m + e], the points and the edges' middles.
        drawn, owners, patches: `triangles`, `parents` and the patches of these on the device.
    """

    points: np.ndarray
    triangles: np.ndarray
    parents: np.ndarray
    edges: np.ndarray
    sides: np.ndarray
    point: np.ndarray
    normal: np.ndarray
    solved: wp.array
    drawn: wp.array
    owners: wp.array
    patches: wp.array


@wp.kernel
def refract_vertices_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    camera: wp.array(dtype=CameraView),
    on_plane: wp.vec3,
    normal: wp.vec3,
    height: float,
    ior: float,
    out_screen: wp.array(dtype=wp.vec4),
):
    """One thread per point under a plane: where the eye, `height` above it, sees the point."""
    i = first + wp.tid()
    p = points[i] - camera[0].eye
    depth = wp.max(-wp.dot(points[i] - on_plane, normal), 0.0)
    across = p - wp.dot(p, normal) * normal
    way = wp.length(across)
    crossing = -height * normal
    if way > 0.0:
        # f(s) = sin i - ior sin r grows with the distance s of the crossing from the eye's foot.
        low = float(0.0)
        high = way
        s = way * height / (height + depth / ior)
        step = int(0)
        while step < FOOT_STEPS:
            step += 1
            rest = way - s
            before = 1.0 / wp.sqrt(s * s + height * height)
            after = 1.0 / wp.sqrt(wp.max(rest * rest + depth * depth, 1.0e-30))
            f = s * before - ior * rest * after
            if f < 0.0:
                low = s
            else:
                high = s
            slope = height * before * height * before * before + ior * depth * after * depth * after * after
            moved = s - f / wp.max(slope, 1.0e-30)
            if not (moved >= low and moved <= high):
                moved = 0.5 * (low + high)
            if wp.abs(moved - s) <= FOOT_DIGITS * way:
                step = FOOT_STEPS
            s = moved
        crossing += (s / way) * across
    length = wp.length(crossing)
    behind = wp.length(p - crossing)
    out_screen[i] = project(camera[0], crossing * ((length + behind) / wp.max(length, 1.0e-30)))


def applies(scene: Scene, part: int, pixels: int) -> tuple[bool, str, dict]:
    """(whether drawing is cheaper than rays, the reason, the numbers it was decided by) for a surface.

    Args:
        scene: The scene.
        part: The surface, index into `scene.parts`.
        pixels: At which the eye sees it.
    """
    flat, why = planar.is_flat(scene, scene.parts[part])
    if not flat:
        return False, why, {}
    found = under(scene, part)
    if found is None:
        return False, "its triangles do not face one way", {}
    if not len(found.triangles):
        return False, "nothing lies under it", {}
    points = len(found.solved)
    cost = (points * POINT_COST + pixels * PIXEL_COST) / max(pixels, 1)
    numbers = {"triangles": len(found.triangles), "cost": cost}
    told = f"{len(found.triangles)} triangles under it: {cost:.2g} of the time of rays"
    return cost < 1.0, f"{told}, {'<' if cost < 1.0 else '>='} 1", numbers


def under(scene: Scene, part: int) -> Under | None:
    """What lies under a flat surface; None where its triangles do not all face one way."""
    key = "under", part
    if key not in scene.facts:
        scene.facts[key] = _under(scene, part)
    return scene.facts[key]


def _under(scene: Scene, part: int) -> Under | None:
    own = scene.parts[part]
    mine = slice(own.first_triangle, own.first_triangle + own.triangle_count)
    point, normal = planar.plane_of(scene, part)
    point = point - scene.origin
    corner = scene.host_points[scene.host_triangles[mine]].astype(np.float64)
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) @ normal
    if (facing < 0.0).any() and (facing > 0.0).any():
        return None
    normal = normal if facing.sum() > 0.0 else -normal
    host = scene.host_points.astype(np.float64)
    depth = -(host - point) @ normal
    noise = NOISE_ULPS * np.finfo(np.float32).eps * float(np.abs(host).max(initial=0.0) + np.abs(point).max())
    below = depth > noise
    reaches = below[scene.host_triangles].any(axis=1)
    reaches[mine] = False
    ids = np.flatnonzero(reaches)
    points, triangles, parents = _cut_at_plane(host, depth, scene.host_triangles[ids], ids)
    pairs = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    code, sides = np.unique(pairs[:, 0] * (len(points) + 1) + pairs[:, 1], return_inverse=True)
    edges = np.stack(np.divmod(code, len(points) + 1), axis=1).astype(np.int32)
    middles = points[edges].mean(axis=1) if len(edges) else np.zeros((0, 3))
    device = scene.device
    return Under(
        points.astype(np.float32),
        triangles,
        parents,
        edges,
        sides.reshape(-1, 3).astype(np.int32),
        point,
        normal,
        wp.array(np.concatenate([points, middles]).astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(triangles, dtype=wp.vec3i, device=device),
        wp.array(parents, dtype=int, device=device),
        wp.array(scene.host_triangle_patch[parents], dtype=int, device=device),
    )


def _cut_at_plane(points: np.ndarray, depth: np.ndarray, corner: np.ndarray, ids: np.ndarray):
    """(points [m, 3], triangles int32 [t, 3], their ids int32 [t]): of triangles what is deeper than 0."""
    above = depth[corner] <= 0.0
    whole = ~above.any(axis=1)
    made, triangles, owners = [points], [corner[whole]], [ids[whole]]
    count = len(points)
    for lone in (False, True):
        # One corner below, or one above: turned so that it comes first.
        chosen = np.flatnonzero(above.sum(axis=1) == (1 if lone else 2))
        if not len(chosen):
            continue
        turn = (above if lone else ~above)[chosen].argmax(axis=1)
        a, b, c = np.take_along_axis(corner[chosen], (turn[:, None] + np.arange(3)) % 3, axis=1).T
        n = len(chosen)
        for other in (b, c):
            # From the lower number to the higher: neighbours get the same point.
            low, high = np.minimum(a, other), np.maximum(a, other)
            share = (depth[low] / (depth[low] - depth[high]))[:, None]
            made.append((1.0 - share) * points[low] + share * points[high])
        ab, ac = count + np.arange(n), count + n + np.arange(n)
        count += 2 * n
        if lone:
            triangles += [np.stack([b, c, ac], 1), np.stack([b, ac, ab], 1)]
            owners += [ids[chosen], ids[chosen]]
        else:
            triangles.append(np.stack([a, ab, ac], 1))
            owners.append(ids[chosen])
    corners = np.concatenate(triangles)
    used, index = np.unique(corners, return_inverse=True)
    return np.concatenate(made)[used], index.reshape(-1, 3).astype(np.int32), np.concatenate(owners).astype(np.int32)


def follow(
    scene: Scene,
    gbuffer: GBuffer,
    part: int,
    layer: ReflectionLayer,
    facet: wp.array,
    inside: wp.array,
    settings: Settings,
) -> None:
    """What refracted rays meet first: as `bvh.trace_transmitted`, from the virtual image of what lies under the surface.

    Those of an eye in the body, of a parallel one, and over nothing, are traced.

    Args:
        scene, gbuffer: The scene, and what the eye sees of it.
        part: The surface, flat; the rays are those that it refracts itself, not turned by waves or frost.
        layer: Its pixels' rays; receives triangle, u, v, distance, status and who settled them.
        facet: int32 [n], the triangle that each ray starts on.
        inside: uint8 [n], 1 where the ray is in the body of its facet.
        settings: `edge_px`, `walk_hops`, `refine`, threads, kernels.
    """
    found, width = under(scene, part), gbuffer.camera.size[0]
    eye = gbuffer.camera.eye - scene.origin
    height = 0.0
    if found is not None and len(found.triangles):
        height = float((eye - found.point) @ found.normal)
    if height <= 0.0 or gbuffer.camera.orthographic:
        bvh.trace_transmitted(scene, layer, facet, inside, settings.threads, None, settings.kernels, width)
        return
    ior = scene.data.materials[scene.parts[part].material].ior
    frame = [wp.vec3(*found.point), wp.vec3(*found.normal), height, float(ior)]
    threads, device = settings.threads, scene.device

    def seen_at(points: wp.array) -> wp.array:
        screen = wp.empty(len(points), dtype=wp.vec4, device=device)
        if vector.chosen(settings.kernels, device):
            inputs = [points, gbuffer.view, *frame, FOOT_STEPS, FOOT_DIGITS, screen]
            vector.launch_blocks(refraction_vector.refract_blocks_kernel, len(points), inputs, device, threads)
        else:
            launch(refract_vertices_kernel, len(points), [points, gbuffer.view, *frame, screen], device, threads)
        return screen

    screen = seen_at(found.solved)
    mesh, screen = _cut_where_bent(scene, found, screen, seen_at, layer.pixels.box, settings)
    target = raster.make_target(gbuffer.camera, layer.pixels.box, device)
    raster.attach_rays(target, gbuffer.view, layer.pixels, threads, settings.kernels)
    drawn = raster.rasterise(
        target, screen, mesh.triangles, points=mesh.points, threads=threads, kernels=settings.kernels
    )
    none = wp.empty(0, dtype=wp.uint8, device=device)
    caution = refine.fixed_caution(True, False, device)
    doubtful = refine.settle(scene, gbuffer, layer.pixels, target, mesh, layer, none, settings, caution)
    bvh.trace_transmitted(scene, layer, facet, inside, threads, doubtful, settings.kernels, width)
    layer.statistics.later(lambda: {"drawn": int(drawn.numpy().sum()), "vertices": mesh.vertex_count})


def _cut_where_bent(scene: Scene, found: Under, screen: wp.array, seen_at, box, settings: Settings):
    """(mesh, its vertices on the screen): triangles cut until their edges' pictures bend by less than `edge_px`."""
    count = len(found.points)
    if settings.edge_px == 0.0 or not len(found.edges):
        return _mesh(scene, found, None, np.zeros(0, np.int32)), screen
    pieces, coarse = _pieces(found, screen.numpy(), box, settings.edge_px)
    if not (pieces > 1).any():
        return _mesh(scene, found, None, coarse), screen
    kept = pieces == 1
    points, triangles, parents = [], [found.triangles[kept]], [found.parents[kept]]
    for number in np.unique(pieces[~kept]):
        ids = np.flatnonzero(pieces == number)
        weights, lattice = lattice_of(int(number))
        points.append(np.einsum("lk,tkj->tlj", weights, found.points[found.triangles[ids]]).reshape(-1, 3))
        first = count + np.arange(len(ids)) * len(weights)
        triangles.append((lattice[None] + first[:, None, None]).reshape(-1, 3))
        parents.append(np.repeat(found.parents[ids], len(lattice)))
        count += len(ids) * len(weights)
    more = wp.array(np.concatenate(points).astype(np.float32), dtype=wp.vec3, device=scene.device)
    all_points = wp.empty(count, dtype=wp.vec3, device=scene.device)
    all_screen = wp.empty(count, dtype=wp.vec4, device=scene.device)
    base = len(found.points)
    for whole, before, after in ((all_points, found.solved, more), (all_screen, screen, seen_at(more))):
        wp.copy(whole, before, count=base)
        wp.copy(whole, after, dest_offset=base)
    cut = all_points, np.concatenate(triangles).astype(np.int32), np.concatenate(parents).astype(np.int32)
    return _mesh(scene, found, cut, coarse), all_screen


def _pieces(found: Under, screen: np.ndarray, box, edge_px: float) -> tuple[np.ndarray, np.ndarray]:
    """(pieces along the edges of every triangle, a power of two; the scene's triangles that no cut makes straight enough)."""
    count = len(found.points)
    x, y, key = (screen[:, k].astype(np.float64) for k in range(3))
    start, end = found.edges.T
    along = np.stack([x[end] - x[start], y[end] - y[start]], axis=1)
    off = np.stack([x[count:] - x[start], y[count:] - y[start]], axis=1)
    length = np.maximum(np.linalg.norm(along, axis=1), 1.0)
    deviation = np.abs(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]) / length
    # Before the near plane there is no picture to measure.
    shown = (key[start] > 0.0) & (key[end] > 0.0) & (key[count:] > 0.0)
    deviation = np.where(shown, deviation, edge_px * STRADDLING_MAX**2)
    bent = deviation[found.sides].max(axis=1)
    corner_x, corner_y = x[found.triangles], y[found.triangles]
    behind = ~shown[found.sides].all(axis=1)
    beside = (corner_x.max(axis=1) < box[0] - 1.0) | (corner_x.min(axis=1) > box[2] + 1.0)
    beside |= (corner_y.max(axis=1) < box[1] - 1.0) | (corner_y.min(axis=1) > box[3] + 1.0)
    beside &= (bent < 1.0) & ~behind
    wanted = np.sqrt(np.maximum(np.where(beside, 0.0, bent) / edge_px, 1.0))
    pieces = np.minimum(2.0 ** np.ceil(np.log2(wanted)), float(CUT_MAX))
    too_bent = wanted > pieces
    order = np.argsort(-bent[too_bent], kind="stable")[:COARSE_MAX]
    return pieces.astype(np.int64), np.unique(found.parents[np.flatnonzero(too_bent)[order]]).astype(np.int32)


def _mesh(scene: Scene, found: Under, cut, coarse: np.ndarray) -> VirtualMesh:
    """What is drawn, with the fields that refinement reads."""
    device = scene.device
    rest = {"estimated": np.zeros(0, np.uint8), "relaxed": 1.0, "base_count": len(found.points)}
    rest["coarse"] = wp.array(coarse, dtype=int, device=device) if len(coarse) else None
    if cut is None:
        arrays = found.solved[: len(found.points)], found.drawn, found.owners, found.patches
        return VirtualMesh(*arrays, found.triangles, found.parents, **rest)
    points, triangles, parents = cut
    arrays = [wp.array(triangles, dtype=wp.vec3i, device=device), wp.array(parents, dtype=int, device=device)]
    arrays.append(wp.array(scene.host_triangle_patch[parents], dtype=int, device=device))
    return VirtualMesh(points, *arrays, triangles, parents, **rest)
