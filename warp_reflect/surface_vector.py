"""`surface.mirror_pixels_kernel` for a block of pixels at a time: the same formulas in the same order.

What needs a second look (near a silhouette, without area, a quadric in parallel projection) is left to the plain function.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import vector
from warp_reflect.compact import listed
from warp_reflect.hits_vector import HITS
from warp_reflect.layers import CameraView
from warp_reflect.scene import SHAPE_PLANE, SHAPE_QUADRIC, SceneView
from warp_reflect.surface import LEAST_NORMAL, SURE_SLOPE, mirror_pixel

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)
MIRROR_BLOCKS = 4  # blocks of mirror pixels a task: the scene and the camera, which a task copies, are large
LISTED_IDS = 32  # each has a number in every block of pixels


@wp.func_native(
    vector.snippet(
        HITS
        + r"""
    const int count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const V eye = spread(camera.eye);
    float* points = (float*)out_point.data;
    float* normals = (float*)out_normal.data;
    float* directions = (float*)out_direction.data;
    unsigned long long unanswered = 0;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I at = start + LANES <= end ? iload(pixel.data + start)
                                          : igather(pixel.data, ipick(valid, element, I(end - 1)));
        // Mostly side by side in a row.
        const int first = at[0];
        const bool row = !bits(at != first + lanes());
        F column, line;
        place(at, camera.width, column, line);
        const Sight of_eye = sight(column + 0.5f, line + 0.5f);
        const V ray = of_eye.ray;
        const I tri = irow(triangle.data, first, row, at);
        const I patch = igather(scene.triangle_patch.data, tri);
        const int* of_shape = &patches->shape;
        const I shape = !bits(patch != patch[0]) ? I(of_shape[patch_words * patch[0]]) : igather(of_shape, patch_words * patch);
        Quadric of;
        if (bits(shape != 0)) of = quadric_of(patch);
        V p, n, incident = unit(ray);
        I good = I(0);
        const I quadric = shape == shape_quadric;
        if (!parallel && bits(quadric)) {
            // surface.polish, where its first root is sure
            const F key = frow(depth_key.data, first, row, at);
            const V start_at = add(eye, V{ray.x / key, ray.y / key, ray.z / key});
            const V q = in_quadric(of, start_at);
            const V d = V{dot(of.row[0], incident), dot(of.row[1], incident), dot(of.row[2], incident)};
            const F a = of.a, b = of.b, c = of.c;
            const F z = a * q.z + 0.5f * b;
            const F qa = d.x * d.x + d.y * d.y + a * d.z * d.z;
            const F qb = q.x * d.x + q.y * d.y + z * d.z;
            const F qc = q.x * q.x + q.y * q.y + (z + 0.5f * b) * q.z - c;
            const F disc = qb * qb - qa * qc;
            const F root = __builtin_elementwise_sqrt(fmax(disc, F(0.0f)));
            good = quadric & (disc >= 0.0f) & (__builtin_elementwise_abs(qb) > sure_slope * root) & (qb != 0.0f);
            const F s = -qc / (qb + pick(qb < 0.0f, -root, root));
            n = unit(from_quadric(of, V{q.x + s * d.x, q.y + s * d.y, z + s * a * d.z}));
            p = add(start_at, times(s, incident));
        }
        const I facets = ~quadric;
        if (bits(facets)) {
            V p0, p1, p2;
            corners(records.data, tri, p0, p1, p2);
            const V a = sub(p0, eye), b = sub(p1, eye), c = sub(p2, eye);
            F u, v;
            const F det = eye_weights(of_eye, p0, p1, p2, u, v);
            const F w = 1.0f - u - v;
            V at_scene = add(add(times(w, p0), times(u, p1)), times(v, p2));
            const V way = parallel ? incident : unit(add(add(times(w, a), times(u, b)), times(v, c)));
            V turned = facet_normal(a, b, c);
            const Corners smooth = normals_of(triangles_of(tri));
            if (bits(smooth.has)) {
                const V mixed = between(smooth, u, v);
                turned = vpick(smooth.has & (dot(mixed, mixed) >= least_normal * least_normal), unit(mixed), turned);
            }
            const I flat = shape == shape_plane;
            if (bits(flat)) {
                const F along = dot(of.row[2], way);
                const F s = -(dot(of.row[2], at_scene) + of.shift[2]) / along;
                const V of_plane = unit(of.row[2]);
                const I polished = flat & (along != 0.0f) & (size(of_plane) > 0.0f);
                turned = vpick(polished, of_plane, turned);
                at_scene = vpick(polished, add(at_scene, times(s, way)), at_scene);
            }
            good |= facets & (det != 0.0f);
            p = vpick(facets, at_scene, p);
            n = vpick(facets, turned, n);
            incident = vpick(facets, way, incident);
        }
        good &= valid & (size(n) > 0.0f);
        n = vpick(dot(n, incident) > 0.0f, times(F(-1.0f), n), n);
        const V d = sub(incident, times(2.0f * dot(incident, n), n));
        const V direction = times(1.5f - 0.5f * dot(d, d), d);
        unanswered |= (unsigned long long)bits(valid & ~good) << (start - begin);
        if (bits(good) == bits(I(-1))) {
            vstore(points, start, p);
            vstore(normals, start, n);
            vstore(directions, start, direction);
            continue;
        }
        for (unsigned left = bits(good); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const int i = 3 * (start + l);
            points[i] = p.x[l]; points[i + 1] = p.y[l]; points[i + 2] = p.z[l];
            normals[i] = n.x[l]; normals[i + 1] = n.y[l]; normals[i + 2] = n.z[l];
            directions[i] = direction.x[l]; directions[i + 1] = direction.y[l]; directions[i + 2] = direction.z[l];
        }
    }
    return unanswered;
""",
        "return 0;",
    )
)
def mirror_block(
    block: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    shape_quadric: int,
    shape_plane: int,
    sure_slope: float,
    least_normal: float,
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
) -> wp.uint64: ...


@wp.kernel
def mirror_blocks_kernel(
    first: int,
    blocks: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
):
    """One thread per `blocks` blocks of mirror pixels."""
    own, _ = wp.tid()
    task = first + own
    for block in range(task * blocks, wp.min((task + 1) * blocks, (pixel.shape[0] + BLOCK - 1) / BLOCK)):
        left = mirror_block(
            block,
            scene,
            records,
            camera[0],
            triangle,
            depth_key,
            pixel,
            SHAPE_QUADRIC,
            SHAPE_PLANE,
            SURE_SLOPE,
            LEAST_NORMAL,
            out_point,
            out_normal,
            out_direction,
        )
        i = block * BLOCK
        while left != wp.uint64(0):
            if (left & wp.uint64(1)) != wp.uint64(0):
                mirror_pixel(scene, camera, triangle, depth_key, pixel[i], i, out_point, out_normal, out_direction)
            left = left >> wp.uint64(1)
            i += 1


@wp.func_native(
    vector.snippet(r"""
    const int begin = block * BLOCK, end = begin + BLOCK < triangle.shape[0] ? begin + BLOCK : triangle.shape[0];
    const int blocks = (triangle.shape[0] + BLOCK - 1) / BLOCK, kinds = out_count.shape[0] / blocks;
    const int* seen = triangle.data;
    int* own = out_count.data + block - blocks;
    for (int id = 1; id <= kinds; ++id) own[id * blocks] = 0;
    auto id_of = [&](int t) -> int { return t < 0 ? 0 : patch_id.data[triangle_patch.data[t]]; };
    auto count = [&](int id, int pixels) { if (id != 0) own[id * blocks] += pixels; };
    int i = begin;
    for (; i + LANES <= end; i += LANES) {
        const I t = iload(seen + i);
        const int first = seen[i];
        // Side by side lie pixels of one triangle, and where there is nothing; or else of one patch.
        bool alike = !bits(t != first);
        I patch;
        if (!alike && !bits(t < 0)) {
            EACH_LANE patch[l] = triangle_patch.data[seen[i + l]];
            alike = !bits(patch != patch[0]);
        }
        I id;
        if (alike) {
            id = I(id_of(first));
            count(id[0], LANES);
        } else EACH_LANE {
            id[l] = id_of(t[l]);
            count(id[l], 1);
        }
        istore(out_id.data + i, id);
    }
    for (; i < end; ++i) count(out_id.data[i] = id_of(seen[i]), 1);
""")
)
def id_block(
    block: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patch_id: wp.array(dtype=int),
    out_id: wp.array(dtype=int),
    out_count: wp.array(dtype=int),
): ...


@wp.kernel
def id_blocks_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patch_id: wp.array(dtype=int),
    out_id: wp.array(dtype=int),
    out_count: wp.array(dtype=int),
):
    """As `surface.reflector_id_kernel`, one thread per block of pixels; for each id, of every block how many have it."""
    id_block(first + wp.tid(), triangle, triangle_patch, patch_id, out_id, out_count)


@wp.func_native(
    vector.snippet(
        f"    constexpr int MOST = {LISTED_IDS};"
        + r"""
    const int begin = block * BLOCK, end = begin + BLOCK < ids.shape[0] ? begin + BLOCK : ids.shape[0];
    const int blocks = (ids.shape[0] + BLOCK - 1) / BLOCK, kinds = place.shape[0] / blocks;
    int* next[MOST + 1];
    for (int id = 1; id <= kinds; ++id) next[id] = out_pixel.data + place.data[(id - 1) * blocks + block];
    int i = begin;
    for (; i + LANES <= end; i += LANES) {
        const I id = iload(ids.data + i);
        if (!bits(id != id[0])) {
            if (id[0] == 0) continue;
            istore(next[id[0]], i + lanes());
            next[id[0]] += LANES;
        } else EACH_LANE if (id[l] != 0) *next[id[l]]++ = i + l;
    }
    for (; i < end; ++i) if (ids.data[i] != 0) *next[ids.data[i]]++ = i;
"""
    )
)
def list_block(block: int, ids: wp.array(dtype=int), place: wp.array(dtype=int), out_pixel: wp.array(dtype=int)): ...


@wp.kernel
def list_blocks_kernel(
    first: int, ids: wp.array(dtype=int), place: wp.array(dtype=int), out_pixel: wp.array(dtype=int)
):
    """One thread per block of pixels: the pixels of each id, from the place of that id's and that block's first one on."""
    list_block(first + wp.tid(), ids, place, out_pixel)


def pixels_by_id(
    triangle: wp.array, triangle_patch: wp.array, patch_id: wp.array, ids: int, threads: int
) -> tuple[wp.array, wp.array, list[int]]:
    """Which pixels have each of the ids from 1 on, at most `LISTED_IDS`.

    Returns:
        (id per pixel, int32, 0 none; the pixels of the first id, ascending, then those of the next, int32; where each
        id's begin, and their end).
    """
    count, device = len(triangle), triangle.device
    id, counts = (wp.empty(n, dtype=int, device=device) for n in (count, ids * vector.block_count(count)))
    vector.launch_blocks(id_blocks_kernel, count, [triangle, triangle_patch, patch_id, id, counts], device, threads)
    ends = np.cumsum(counts.numpy(), dtype=np.int32)
    place = listed(ends - counts.numpy(), device)
    pixel = wp.empty(int(ends[-1]), dtype=int, device=device)
    vector.launch_blocks(list_blocks_kernel, count, [id, place, pixel], device, threads)
    return id, pixel, [0, *ends[vector.block_count(count) - 1 :: vector.block_count(count)].tolist()]
