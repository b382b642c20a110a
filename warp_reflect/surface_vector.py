"""`surface.mirror_pixels_kernel` for a block of pixels at a time: the same formulas in the same order.

What needs a second look (near a silhouette, without area, a quadric in parallel projection) is left to the plain function.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.scene import SHAPE_PLANE, SHAPE_QUADRIC, SceneView
from warp_reflect.surface import LEAST_NORMAL, SURE_SLOPE, mirror_pixel

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)


@wp.func_native(
    vector.snippet(
        r"""
    const int count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const bool parallel = camera.orthographic != 0;
    const V eye = spread(camera.eye);
    const int* normal_index = (const int*)scene.normal_index.data;
    const auto* patches = scene.patches.data;
    float* points = (float*)out_point.data;
    float* normals = (float*)out_normal.data;
    float* directions = (float*)out_direction.data;
    unsigned long long unanswered = 0;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I at = start + LANES <= end ? iload(pixel.data + start)
                                          : igather(pixel.data, ipick(valid, element, I(end - 1)));
        const int first_row = at[0] / camera.width;
        const bool one_row = at[LANES - 1] < (first_row + 1) * camera.width;
        const I row = one_row ? I(first_row) : at / camera.width;
        const F x = __builtin_convertvector(at - row * camera.width, F) + 0.5f;
        const F y = __builtin_convertvector(row, F) + 0.5f;
        const V plane = add(add(spread(camera.ray_corner), times(x, spread(camera.ray_dx))), times(y, spread(camera.ray_dy)));
        const V ray = parallel ? spread(camera.forward) : plane;
        const I tri = igather(triangle.data, at);
        const I patch = igather(scene.triangle_patch.data, tri);
        const bool alone = !bits(patch != patch[0]);
        auto of_patch = [&](auto read) -> F {
            if (alone) return F(read(patches[patch[0]]));
            F v;
            EACH_LANE v[l] = read(patches[patch[l]]);
            return v;
        };
        I shape;
        if (alone) shape = I(patches[patch[0]].shape);
        else EACH_LANE shape[l] = patches[patch[l]].shape;
        V m[3];
        F shift[3];
        if (bits(shape != 0)) {
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 3; ++k) {
                m[k] = V{of_patch([k](const auto& a) { return a.unit_from_scene.data[k][0]; }),
                    of_patch([k](const auto& a) { return a.unit_from_scene.data[k][1]; }),
                    of_patch([k](const auto& a) { return a.unit_from_scene.data[k][2]; })};
                shift[k] = of_patch([k](const auto& a) { return a.unit_from_scene.data[k][3]; });
            }
        }
        V p, n, incident = unit(ray);
        I good = I(0);
        const I quadric = shape == shape_quadric;
        if (!parallel && bits(quadric)) {
            // surface.polish, where its first root is sure
            const F key = gather(depth_key.data, at);
            const V start_at = add(eye, V{ray.x / key, ray.y / key, ray.z / key});
            const V q = V{dot(m[0], start_at) + shift[0], dot(m[1], start_at) + shift[1], dot(m[2], start_at) + shift[2]};
            const V d = V{dot(m[0], incident), dot(m[1], incident), dot(m[2], incident)};
            const F a = of_patch([](const auto& s) { return s.quadric[0]; });
            const F b = of_patch([](const auto& s) { return s.quadric[1]; });
            const F c = of_patch([](const auto& s) { return s.quadric[2]; });
            const F z = a * q.z + 0.5f * b;
            const F qa = d.x * d.x + d.y * d.y + a * d.z * d.z;
            const F qb = q.x * d.x + q.y * d.y + z * d.z;
            const F qc = q.x * q.x + q.y * q.y + (z + 0.5f * b) * q.z - c;
            const F disc = qb * qb - qa * qc;
            const F root = __builtin_elementwise_sqrt(fmax(disc, F(0.0f)));
            good = quadric & (disc >= 0.0f) & (__builtin_elementwise_abs(qb) > sure_slope * root) & (qb != 0.0f);
            const F s = -qc / (qb + pick(qb < 0.0f, -root, root));
            n = unit(add(add(times(q.x + s * d.x, m[0]), times(q.y + s * d.y, m[1])), times(z + s * a * d.z, m[2])));
            p = add(start_at, times(s, incident));
        }
        const I facets = ~quadric;
        if (bits(facets)) {
            V p0, p1, p2;
            corners(records.data, tri, p0, p1, p2);
            const V a = sub(p0, eye), b = sub(p1, eye), c = sub(p2, eye);
            const V o = parallel ? plane : same(0.0f);
            const V ao = sub(a, o), bo = sub(b, o), co = sub(c, o);
            const F eu = dot(cross(sub(co, ao), add(co, ao)), ray);
            const F ev = dot(cross(sub(ao, bo), add(ao, bo)), ray);
            const F ew = dot(cross(sub(bo, co), add(bo, co)), ray);
            const F det = eu + ev + ew;
            const F inv = 1.0f / det;
            const F cu = fmax(eu * inv, F(0.0f)), cv = fmax(ev * inv, F(0.0f));
            const F total = cu + cv;
            const F u = pick(total > 1.0f, cu / total, cu), v = pick(total > 1.0f, cv / total, cv);
            const F w = 1.0f - u - v;
            V at_scene = add(add(times(w, p0), times(u, p1)), times(v, p2));
            const V way = parallel ? incident : unit(add(add(times(w, a), times(u, b)), times(v, c)));
            V turned = facet_normal(a, b, c);
            const I first_normal = igather(normal_index, 3 * tri);
            const I smooth = first_normal >= 0;
            if (bits(smooth)) {
                const I i0 = ipick(smooth, first_normal, I(0));
                const I i1 = ipick(smooth, igather(normal_index, 3 * tri + 1), I(0));
                const I i2 = ipick(smooth, igather(normal_index, 3 * tri + 2), I(0));
                const float* all = (const float*)scene.normals.data;
                const V mixed = add(add(times(w, vgather(all, i0)), times(u, vgather(all, i1))), times(v, vgather(all, i2)));
                turned = vpick(smooth & (dot(mixed, mixed) >= least_normal * least_normal), unit(mixed), turned);
            }
            const I flat = shape == shape_plane;
            if (bits(flat)) {
                const F along = dot(m[2], way);
                const F s = -(dot(m[2], at_scene) + shift[2]) / along;
                const V of_plane = unit(m[2]);
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
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    triangle: wp.array(dtype=int),
    depth_key: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
):
    """One thread per block of mirror pixels."""
    block = first + wp.tid()
    left = mirror_block(
        block,
        scene,
        records,
        camera,
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
    const int end = begin + BLOCK < triangle.shape[0] ? begin + BLOCK : triangle.shape[0];
    const int* seen = triangle.data;
    auto id_of = [&](int t) -> int { return t < 0 ? 0 : patch_id.data[triangle_patch.data[t]]; };
    int i = begin;
    for (; i + LANES <= end; i += LANES) {
        const I t = iload(seen + i);
        I id;
        // Side by side lie pixels of one triangle, and where there is nothing.
        if (!bits(t != seen[i])) id = I(id_of(seen[i]));
        else EACH_LANE id[l] = id_of(t[l]);
        istore(out_id.data + i, id);
    }
    for (; i < end; ++i) out_id.data[i] = id_of(seen[i]);
""")
)
def id_block(
    begin: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patch_id: wp.array(dtype=int),
    out_id: wp.array(dtype=int),
): ...


@wp.kernel
def id_blocks_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patch_id: wp.array(dtype=int),
    out_id: wp.array(dtype=int),
):
    """As `surface.reflector_id_kernel`, one thread per block of pixels."""
    id_block((first + wp.tid()) * BLOCK, triangle, triangle_patch, patch_id, out_id)
