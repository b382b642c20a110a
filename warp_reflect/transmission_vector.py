"""`transmission.cross_seen_kernel` for a block of pixels at a time: the same formulas in the same order.

What enters through flat facets of a vector's first patch, without colours of its own from corner to corner, is answered here;
curved and vertex-coloured surfaces, cones and rays that leave a body are left to the plain function.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.scene import SHAPE_QUADRIC, SceneView
from warp_reflect.shade import ROUGH_ROUGHNESS, SHARP_ROUGHNESS
from warp_reflect.textures import Look
from warp_reflect.transmission import OPAQUE, SOLID, InterfaceView, cross_pixel

wp.set_module_options({"enable_backward": False})

BLOCK = wp.constant(vector.BLOCK)


@wp.func_native(
    vector.snippet(
        r"""
    const int pixel_count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < pixel_count ? begin + BLOCK : pixel_count;
    const bool parallel = camera.orthographic != 0;
    const bool looked_up = looks.shape[0] > 0;
    const int* normal_index = (const int*)scene.normal_index.data;
    const int* color_index = (const int*)scene.color_index.data;
    float* normals_out = (float*)out_normal.data;
    float* directions_out = (float*)out_direction.data;
    float* weights_out = (float*)out_weight.data;
    unsigned long long unanswered = 0;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        const bool full = start + LANES <= end;
        const I at = igather(pixel.data, own);
        const I tri = igather(triangle.data, at);
        const I patch = igather(scene.triangle_patch.data, tri);
        const auto& surface = scene.patches.data[patch[0]];
        const auto& interface = interfaces.data[patch[0]];
        const auto& material = scene.materials.data[surface.material];
        const bool cone = interface.spread > 0.0f && count > 0;
        const bool flat = surface.shape != shape_quadric && interface.kind != opaque && !cone;
        I good = valid & (patch == patch[0]) & (igather(normal_index, 3 * tri) < 0) & (flat ? I(-1) : I(0));
        if (!looked_up && material.uses_vertex_color != 0 && scene.color_index.shape[0] > 0)
            good &= igather(color_index, 3 * tri) < 0;
        unanswered |= (unsigned long long)bits(valid & ~good) << (start - begin);
        if (!bits(good)) continue;

        V p0, p1, p2;
        corners(records.data, tri, p0, p1, p2);
        V outward = facet_normal(p0, p1, p2);
        V n = vrows((const float*)normal.data, start, full, own);
        const V onward = vrows((const float*)direction.data, start, full, own);
        const V incident = unit(sub(onward, times(2.0f * dot(onward, n), n)));
        const I leaving = dot(outward, incident) > 0.0f;
        if (interface.kind == solid) {
            unanswered |= (unsigned long long)bits(good & leaving) << (start - begin);
            good &= ~leaving;
            if (!bits(good)) continue;
        }
        V shown = outward;
        if (normals.shape[0] > 0) {
            const V mapped = vgather((const float*)normals.data, at);
            const I has = dot(mapped, mapped) > 0.0f;
            shown = vpick(has, mapped, shown);
            n = vpick(has & (leaving | (wavy != 0 ? I(-1) : I(0))), mapped, n);
        }
        const I row = at / camera.width;
        const F x = __builtin_convertvector(at - row * camera.width, F) + 0.5f;
        const F y = __builtin_convertvector(row, F) + 0.5f;
        const V plane = add(add(spread(camera.ray_corner), times(x, spread(camera.ray_dx))), times(y, spread(camera.ray_dy)));
        const V ray = unit(parallel ? spread(camera.forward) : plane);
        const F cosine = clip(__builtin_elementwise_abs(dot(shown, ray)), 0.0f, 1.0f);

        // shade.split_lobes, what goes through
        auto of = [&](auto read) -> F {
            if (!looked_up) return F(read(material));
            F v;
            EACH_LANE v[l] = read(looks.data[at[l]]);
            return v;
        };
        const I reflector = igather(reflector_id.data, at) > 0;
        auto sharp_share = [&](F rough) -> F {
            return pick(reflector, F(1.0f), clip((rough_roughness - rough) / (rough_roughness - sharp_roughness), 0.0f, 1.0f));
        };
        const F m = 1.0f - cosine, m2 = m * m, m5 = m2 * m2 * m;
        const F opacity = of([](const auto& a) { return a.opacity; });
        const F transmission = of([](const auto& a) { return a.transmission; });
        const F sharp = sharp_share(of([](const auto& a) { return a.roughness; }));
        const F clearcoat = of([](const auto& a) { return a.clearcoat; });
        F coat = F(0.0f);
        const I coated = clearcoat > 0.0f;
        if (bits(coated)) {
            const F f0 = of([](const auto& a) { return a.clearcoat_f0; });
            coat = pick(coated, clearcoat * (f0 + m5 * (1.0f - f0)), F(0.0f));
        }
        auto through = [&](F f0, F f90) -> F {
            const F mirror = pick(sharp > 0.0f, sharp * (f0 + m5 * (f90 - f0)), F(0.0f));
            const F rest = transmission * (1.0f - mirror - (1.0f - sharp) * f0);
            return opacity * pick(coated, (1.0f - coat) * rest, rest) + (1.0f - opacity);
        };
        const V weight = V{
            through(of([](const auto& a) { return a.f0[0]; }), of([](const auto& a) { return a.f90[0]; })),
            through(of([](const auto& a) { return a.f0[1]; }), of([](const auto& a) { return a.f90[1]; })),
            through(of([](const auto& a) { return a.f0[2]; }), of([](const auto& a) { return a.f90[2]; }))};

        // transmission.cross_interface
        V bent = incident;
        if (interface.kind == solid) {
            // optics.refract
            const float ior = interface.ior;
            const V flat_part = sub(incident, times(dot(incident, n), n));
            const V across = V{flat_part.x / ior, flat_part.y / ior, flat_part.z / ior};
            const F square = 1.0f - dot(across, across);
            const F root = __builtin_elementwise_sqrt(fmax(square, F(0.0f)));
            bent = unit(vpick(square > 0.0f, sub(across, times(root, n)), same(0.0f)));
        }
        outward = vpick(dot(outward, bent) < 0.0f, times(F(-1.0f), outward), outward);
        const unsigned char inside = interface.kind == solid ? 1 : 0;
        if (full && !bits(~good)) {
            istore(out_facet.data + start, tri);
            for (int l = 0; l < LANES; ++l) out_inside.data[start + l] = inside;
            vstore(normals_out, start, outward);
            vstore(directions_out, start, bent);
            vstore(weights_out, start, weight);
            continue;
        }
        for (unsigned left = bits(good); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const int i = start + l;
            out_facet.data[i] = tri[l];
            out_inside.data[i] = inside;
            normals_out[3 * i] = outward.x[l]; normals_out[3 * i + 1] = outward.y[l]; normals_out[3 * i + 2] = outward.z[l];
            directions_out[3 * i] = bent.x[l]; directions_out[3 * i + 1] = bent.y[l]; directions_out[3 * i + 2] = bent.z[l];
            weights_out[3 * i] = weight.x[l]; weights_out[3 * i + 1] = weight.y[l]; weights_out[3 * i + 2] = weight.z[l];
        }
    }
    return unanswered;
""",
        "return 0;",
    )
)
def cross_block(
    block: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    count: int,
    wavy: int,
    opaque: int,
    solid: int,
    shape_quadric: int,
    sharp_roughness: float,
    rough_roughness: float,
    out_facet: wp.array(dtype=int),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
) -> wp.uint64: ...


@wp.kernel
def cross_blocks_kernel(
    first: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: wp.array(dtype=CameraView),
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    # Pixels of the surface:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # See `cross_seen_kernel`:
    sample: int,
    count: int,
    wavy: int,
    # Outputs:
    out_facet: wp.array(dtype=int),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
):
    """One thread per block of pixels."""
    block = first + wp.tid()
    left = cross_block(
        block,
        scene,
        records,
        camera[0],
        interfaces,
        looks,
        normals,
        triangle,
        reflector_id,
        pixel,
        normal,
        direction,
        count,
        wavy,
        OPAQUE,
        SOLID,
        SHAPE_QUADRIC,
        SHARP_ROUGHNESS,
        ROUGH_ROUGHNESS,
        out_facet,
        out_normal,
        out_direction,
        out_inside,
        out_weight,
    )
    i = block * BLOCK
    while left != wp.uint64(0):
        if (left & wp.uint64(1)) != wp.uint64(0):
            cross_pixel(
                scene,
                camera[0],
                interfaces,
                looks,
                normals,
                triangle,
                reflector_id,
                pixel[i],
                normal[i],
                direction[i],
                sample,
                count,
                wavy,
                i,
                out_facet,
                out_normal,
                out_direction,
                out_inside,
                out_weight,
            )
        left = left >> wp.uint64(1)
        i += 1
