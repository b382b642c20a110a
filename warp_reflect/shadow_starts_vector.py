"""`shadow_starts.starts_kernel` for a block of points at a time: the same formulas in the same order, the same bits.

What the eye sees needs no pass of its own before: its rays and the weights of what they meet (`direct.eye_weights_kernel`)
are found on the way. Shapes that are no spheres are left to the plain function.
"""

from __future__ import annotations

from functools import cache

import warp as wp

from warp_reflect import vector
from warp_reflect.direct import SPHERE, DirectView, Points, area_irradiance
from warp_reflect.direct_vector import SPHERES
from warp_reflect.hits_vector import HITS
from warp_reflect.launch import launch, module_part
from warp_reflect.layers import CameraView
from warp_reflect.ray_walk import FLOAT_EPS, OFFSET_ULPS
from warp_reflect.scene import SHAPE_QUADRIC, Scene, SceneView
from warp_reflect.shadow_starts import PLACE_ROWS, ROWS, Starts, row_vector, rows_in

wp.set_module_options({"enable_backward": False})
FLAT = module_part(__name__, "flat")


@wp.func_native(
    vector.snippet(
        SPHERES
        + HITS
        + r"""
    const int count = triangle.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const int image_width = of_eye != 0 ? camera.width : width;
    float* rows = out_rows.data;
    const int stride = out_rows.shape[1];
    const int area_count = lights.areas.shape[0] < out_unshadowed.shape[0] ? lights.areas.shape[0] : out_unshadowed.shape[0];
    // shadow_starts.gradient_noise
    auto below = [](F a) -> F { return a - __builtin_elementwise_floor(a); };
    auto noise = [&](F x, F y) -> F { return below(52.9829189f * below(0.06711056f * x + 0.00583715f * y)); };
    auto offset = [&](V a) -> F {
        return offset_share
            * (__builtin_elementwise_abs(a.x) + __builtin_elementwise_abs(a.y) + __builtin_elementwise_abs(a.z));
    };
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const I known = igather(triangle.data, own);
        const I seen = known >= 0;
        auto keep = [&](int row, F value) { store(rows + row * stride + start, pick(seen, value, F(0.0f))); };
        if (!bits(seen)) {
            for (int row = 0; row < (shaped != 0 ? out_rows.shape[0] : 6); ++row) store(rows + row * stride + start, F(0.0f));
            for (int k = 0; k < area_count; ++k) store(out_unshadowed.data + k * stride + start, F(0.0f));
            continue;
        }
        const I tri = ipick(seen, known, I(0));
        const I number = pixel.shape[0] > 0 ? igather(pixel.data, own) : own;
        Triangles triangles = triangles_of(tri);
        V p0, p1, p2, way;
        F u, v;
        corners(records.data, tri, p0, p1, p2);
        F column, line;
        if (image_width > 0) place(number, image_width, column, line);
        if (of_eye != 0) {
            // direct.eye_weights_kernel
            const Sight eye = sight(column + 0.5f, line + 0.5f);
            eye_weights(eye, p0, p1, p2, u, v);
            way = unit(eye.ray);
        } else {
            u = gather(weight_u.data, own);
            v = gather(weight_v.data, own);
            way = vgather((const float*)direction.data, own);
        }
        // shadow_starts.ray_start
        const F w = 1.0f - u - v;
        const V at = add(add(times(w, p0), times(u, p1)), times(v, p2));
        const V facet = facet_normal(p0, p1, p2);
        const I patch = patch_of(triangles);
        const Corners smooth = normals_of(triangles);
        const I quadric = (of_patch(&patches->shape, triangles, patch) == shape_quadric) & ~smooth.has;
        Quadric of;
        V q;
        V n = hit_normal(seen, patch, quadric, [&]() -> V { return facet; }, at, u, v, smooth, of, q), p = at;
        const F turned = pick(dot(n, way) > 0.0f, F(-1.0f), F(1.0f));
        const V side = times(pick(dot(facet, n) < 0.0f, -turned, turned), facet);
        if (bits(seen & smooth.has)) {
            auto above_tangent = [&](V from, V corner, V normal) -> V {
                return times(fmax(dot(sub(corner, from), normal), F(0.0f)), normal);
            };
            V raised = add(p, times(w, above_tangent(p, p0, times(turned, smooth.a))));
            raised = add(raised, times(u, above_tangent(raised, p1, times(turned, smooth.b))));
            raised = add(raised, times(v, above_tangent(raised, p2, times(turned, smooth.c))));
            p = vpick(smooth.has, raised, p);
        }
        if (bits(seen & quadric)) {
            const F f = q.x * q.x + q.y * q.y + (of.a * q.z + of.b) * q.z - of.c;
            const V gradient = from_quadric(of, V{2.0f * q.x, 2.0f * q.y, 2.0f * of.a * q.z + of.b});
            const V step = times(-f / fmax(dot(gradient, gradient), F(1.0e-30f)), gradient);
            p = vpick(quadric & (dot(step, side) > 0.0f), add(p, step), p);
        }
        if (normals.shape[0] > 0) {
            const V mapped = vgather((const float*)normals.data, own);
            n = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
        }
        n = vpick(dot(n, way) > 0.0f, times(F(-1.0f), n), n);
        p = add(p, times(fmax(offset(p0), fmax(offset(p1), offset(p2))), side));
        keep(0, p.x); keep(1, p.y); keep(2, p.z);
        keep(3, n.x); keep(4, n.y); keep(5, n.z);
        if (shaped == 0) continue;
        keep(6, side.x); keep(7, side.y); keep(8, side.z);
        if (width > 0) {
            keep(9, noise(column, line));
            keep(10, noise(line + 113.0f, column + 71.0f));
        } else {
            const F k = __builtin_convertvector(own, F);
            keep(9, below(0.5f + 0.7548776662466927f * k + 0.0f));
            keep(10, below(0.5f + 0.5698402909980532f * k + 0.0f));
        }
        if (out_rows.shape[0] > 11) { keep(11, at.x); keep(12, at.y); keep(13, at.z); }
        for (int k = 0; k < area_count; ++k) {
            const auto& area = lights.areas.data[k];
            F arrives = F(0.0f);
            if (area.kind == sphere) arrives = pick(seen, sphere_irradiance(seen, area, at, n), F(0.0f));
            store(out_unshadowed.data + k * stride + start, arrives);
        }
    }
""",
        exact=True,
    )
)
def start_block(
    block: int,
    of_eye: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    shaped: int,
    shape_quadric: int,
    sphere: int,
    offset_share: float,
    out_rows: wp.array2d(dtype=float),
    out_unshadowed: wp.array2d(dtype=float),
): ...


@wp.kernel
def starts_blocks_kernel(
    first: int,
    of_eye: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: wp.array(dtype=CameraView),
    lights: DirectView,
    triangle: wp.array(dtype=int),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    pixel: wp.array(dtype=int),
    width: int,
    shaped: int,
    # Outputs:
    out_rows: wp.array2d(dtype=float),
    out_unshadowed: wp.array2d(dtype=float),
):
    """One thread per block of points; those of the eye have weights and rays of length 0.

    Not `shaped`: no more than rays to distant lights need, which ask neither for facets nor for samples.
    """
    start_block(
        first + wp.tid(),
        of_eye,
        scene,
        records,
        camera[0],
        lights,
        triangle,
        weight_u,
        weight_v,
        direction,
        normals,
        pixel,
        width,
        shaped,
        SHAPE_QUADRIC,
        SPHERE,
        OFFSET_ULPS * FLOAT_EPS,
        out_rows,
        out_unshadowed,
    )


@wp.kernel(module=FLAT)
def flat_irradiance_kernel(
    first: int,
    lights: DirectView,
    triangle: wp.array(dtype=int),
    rows: wp.array2d(dtype=float),
    # Outputs:
    out_unshadowed: wp.array2d(dtype=float),
):
    """One thread per point: what shapes that are no spheres bring."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    p = row_vector(rows, ROWS, i)
    n = row_vector(rows, 3, i)
    for k in range(lights.areas.shape[0]):
        if lights.areas[k].kind != SPHERE:
            out_unshadowed[k, i] = area_irradiance(lights.areas[k], p, n)


@cache
def _no_camera(device: str) -> wp.array:
    """Stands for the camera where nobody looks at it: kernels take it out of the array before they know."""
    return wp.zeros(1, dtype=CameraView, device=device)


def starts_of(
    scene: Scene,
    points: Points,
    normals: wp.array,
    starts: Starts,
    width: int,
    threads: int,
    room: wp.array | None = None,
    shaped: bool = True,
) -> None:
    """What `shadow_starts.starts_kernel` does; see `shadow_starts.starts_of`."""
    device, count = scene.device, len(points.triangle)
    lights, rows, flat = scene.lights.direct, starts.rows, False
    if len(starts.unshadowed):
        flat = bool((lights.areas.numpy()["kind"] != SPHERE).any())
    if flat:
        rows = rows_in(room, int(ROWS) + PLACE_ROWS, rows.shape[1], device)
        starts.rows = rows
    camera = _no_camera(str(device)) if points.camera is None else points.camera
    at = [points.triangle, points.u, points.v, points.direction, normals, points.pixel, width, int(shaped)]
    inputs = [int(points.camera is not None), scene.view, scene.triangle_records, camera, lights, *at]
    vector.launch_blocks(starts_blocks_kernel, count, [*inputs, rows, starts.unshadowed], device, threads)
    if flat:
        inputs = [lights, points.triangle, rows, starts.unshadowed]
        launch(flat_irradiance_kernel, count, inputs, device, threads)
