"""`shade.shade_kernel` and `shade.seen_radiance_kernel` for a block of points at a time.

The same formulas in the same order; lanes differ in their triangle, patch and material. Neighbouring points mostly share a
patch, whose constants are then read once for a vector. Spheres that shine without shadows are summed here as well, so that
their light needs no pass of its own.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.direct import AreaView
from warp_reflect.layers import CameraView
from warp_reflect.scene import SceneView
from warp_reflect.shade import LightView
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

# Expects `triangle`, `scene`, `records`, `lights`, `areas`, `looks`, `normals`, `direct`, `sky`, `block`.
_SHADING = r"""
    const float pi = 3.14159265358979f;
    const int count = triangle.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    // shade.dome_radiance
    auto dome_radiance = [&](I mask, V d) -> V {
        const F slope = dot(spread(lights.sky_slope), d);
        V radiance = add(spread(lights.sky), grey(slope));
        for (int k = 0; k < lights.domes.shape[0]; ++k) {
            const auto& dome = lights.domes.data[k];
            for (unsigned left = bits(mask); left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left);
                const auto& m = dome.light_from_world.data;
                const float x = m[0][0] * d.x[l] + m[0][1] * d.y[l] + m[0][2] * d.z[l];
                const float y = m[1][0] * d.x[l] + m[1][1] * d.y[l] + m[1][2] * d.z[l];
                const float z = m[2][0] * d.x[l] + m[2][1] * d.y[l] + m[2][2] * d.z[l];
                const float lon = __builtin_atan2f(x, z);
                const float lat = __builtin_asinf(y < -1.0f ? -1.0f : y > 1.0f ? 1.0f : y);
                const float column = (0.5f - lon / (2.0f * pi)) * (float)dome.width - 0.5f;
                float row = (0.5f - lat / pi) * (float)dome.height - 0.5f;
                const float last = (float)(dome.height - 1);
                row = row < 0.0f ? 0.0f : row > last ? last : row;
                const float column_floor = __builtin_floorf(column);
                const float fx = column - column_floor;
                int x0 = (int)column_floor;
                if (x0 < 0) x0 += dome.width;
                const int x1 = x0 + 1 >= dome.width ? x0 + 1 - dome.width : x0 + 1;
                const int y0 = (int)row;
                const int y1 = y0 + 1 < dome.height ? y0 + 1 : dome.height - 1;
                const float fy = row - (float)y0;
                const auto* upper = lights.texels.data + dome.first_texel + y0 * dome.width;
                const auto* lower = lights.texels.data + dome.first_texel + y1 * dome.width;
                float sum[3];
                for (int c = 0; c < 3; ++c) {
                    const float top = (1.0f - fx) * upper[x0][c] + fx * upper[x1][c];
                    const float bottom = (1.0f - fx) * lower[x0][c] + fx * lower[x1][c];
                    sum[c] = dome.color[c] * ((1.0f - fy) * top + fy * bottom);
                }
                radiance.x[l] += sum[0]; radiance.y[l] += sum[1]; radiance.z[l] += sum[2];
            }
        }
        return radiance;
    };
    // direct.sphere_irradiance; lanes that see a part of a sphere below their horizon take their time.
    auto sphere_irradiance = [&](I mask, const auto& area, V p, V n) -> F {
        const V to_centre = sub(spread(area.centre), p);
        const F distance = __builtin_elementwise_sqrt(dot(to_centre, to_centre));
        const F cosine = clip(dot(to_centre, n) / distance, -1.0f, 1.0f);
        const F sine_sphere = area.radius / distance;
        const F square = sine_sphere * sine_sphere;
        const I within = distance <= area.radius;
        const I above = cosine >= sine_sphere;
        F total = pick(within, F(pi), pick(above, pi * square * cosine, F(0.0f)));
        for (unsigned left = bits(mask & ~within & ~above & (cosine > -sine_sphere)); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            const float c = cosine[l], s2 = square[l];
            const float from_sine = 1.0f - c * c, from_sphere = 1.0f / s2 - 1.0f;
            const float sine = __builtin_sqrtf(from_sine > 0.0f ? from_sine : 0.0f);
            const float x = __builtin_sqrtf(from_sphere > 0.0f ? from_sphere : 0.0f);
            float y = -x * c / (sine > 1.0e-30f ? sine : 1.0e-30f);
            y = y < -1.0f ? -1.0f : y > 1.0f ? 1.0f : y;
            const float rest = 1.0f - y * y;
            const float root = sine * __builtin_sqrtf(rest > 0.0f ? rest : 0.0f);
            const float sum = (c * __builtin_acosf(y) - x * root) * s2 + __builtin_atan2f(root, x);
            total[l] = sum > 0.0f ? sum : 0.0f;
        }
        return total;
    };
    struct Lit { V base, mirror; };
    // What lanes `seen` of points `own` on triangles `tri` give back along unit rays: base radiance and weight of the mirror
    // term, whose direction is left in `onward`. `weights` gives u and v, and is asked only where they matter.
    auto lit = [&](I seen, I own, I tri, V ray, I reflector, auto weights, V& onward) -> Lit {
        V p0, p1, p2;
        corners(records.data, tri, p0, p1, p2);
        const I patch = igather(scene.triangle_patch.data, tri);
        // One patch for all lanes, or for each its own.
        const bool alone = !bits(patch != patch[0]);
        const auto* patches = scene.patches.data;
        auto of_patch = [&](auto read) -> F {
            if (alone) return F(read(patches[patch[0]]));
            F v;
            EACH_LANE v[l] = read(patches[patch[l]]);
            return v;
        };
        I shape, material;
        if (alone) {
            shape = I(patches[patch[0]].shape);
            material = I(patches[patch[0]].material);
        } else {
            EACH_LANE { shape[l] = patches[patch[l]].shape; material[l] = patches[patch[l]].material; }
        }
        const int* normal_index = (const int*)scene.normal_index.data;
        const I first_normal = igather(normal_index, 3 * tri);
        const I smooth = first_normal >= 0;
        const I quadric = (shape == 1) & ~smooth;
        const bool colored = scene.color_index.shape[0] > 0 && looks.shape[0] == 0;
        F u = F(0.0f), v = F(0.0f);
        if (bits(seen & (smooth | quadric)) || colored || areas.shape[0] > 0) weights(p0, p1, p2, u, v);
        const F w = 1.0f - u - v;

        // surface.hit_normal
        V n = facet_normal(p0, p1, p2);
        if (bits(seen & smooth)) {
            const I i0 = ipick(smooth, first_normal, I(0));
            const I i1 = ipick(smooth, igather(normal_index, 3 * tri + 1), I(0));
            const I i2 = ipick(smooth, igather(normal_index, 3 * tri + 2), I(0));
            const float* all = (const float*)scene.normals.data;
            const V mixed = add(add(times(w, vgather(all, i0)), times(u, vgather(all, i1))), times(v, vgather(all, i2)));
            const V kept = vpick(dot(mixed, mixed) < 0.01f, V{F(0.0f), F(0.0f), F(1.0f)}, unit(mixed));
            n = vpick(smooth, kept, n);
        }
        const V p = add(add(times(w, p0), times(u, p1)), times(v, p2));
        if (bits(seen & quadric)) {
            V row[3];
            F shift[3];
            _Pragma("clang loop unroll(full)") for (int k = 0; k < 3; ++k) {
                row[k] = V{of_patch([k](const auto& a) { return a.unit_from_scene.data[k][0]; }),
                    of_patch([k](const auto& a) { return a.unit_from_scene.data[k][1]; }),
                    of_patch([k](const auto& a) { return a.unit_from_scene.data[k][2]; })};
                shift[k] = of_patch([k](const auto& a) { return a.unit_from_scene.data[k][3]; });
            }
            const F a = of_patch([](const auto& q) { return q.quadric[0]; });
            const F b = of_patch([](const auto& q) { return q.quadric[1]; });
            const F x = dot(row[0], p) + shift[0], y = dot(row[1], p) + shift[1];
            const F z = a * (dot(row[2], p) + shift[2]) + 0.5f * b;
            n = vpick(quadric, unit(add(add(times(x, row[0]), times(y, row[1])), times(z, row[2]))), n);
        }
        if (normals.shape[0] > 0) {
            const V mapped = vgather((const float*)normals.data, own);
            n = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
        }
        const F along = dot(n, ray);
        onward = sub(ray, times(2.0f * along, n));
        n = vpick(along > 0.0f, times(F(-1.0f), n), n);
        const F cosine = __builtin_elementwise_abs(along);

        // textures.plain_look, or what was looked up before.
        V base_color, f0, f90, emissive;
        F roughness, clearcoat, clearcoat_roughness, clearcoat_f0, opacity, through;
        auto look_of = [&](auto element) {
            auto vector_of = [&](auto read) -> V {
                return V{element([&](const auto& a) { return read(a)[0]; }), element([&](const auto& a) { return read(a)[1]; }),
                    element([&](const auto& a) { return read(a)[2]; })};
            };
            base_color = vector_of([](const auto& a) { return a.base_color; });
            f0 = vector_of([](const auto& a) { return a.f0; });
            f90 = vector_of([](const auto& a) { return a.f90; });
            emissive = vector_of([](const auto& a) { return a.emissive; });
            roughness = element([](const auto& a) { return a.roughness; });
            clearcoat = element([](const auto& a) { return a.clearcoat; });
            clearcoat_roughness = element([](const auto& a) { return a.clearcoat_roughness; });
            clearcoat_f0 = element([](const auto& a) { return a.clearcoat_f0; });
            opacity = element([](const auto& a) { return a.opacity; });
            through = element([](const auto& a) { return a.transmission; });
        };
        const auto* materials = scene.materials.data;
        auto of_material = [&](auto read) -> F {
            if (alone) return F(read(materials[material[0]]));
            F value;
            EACH_LANE value[l] = read(materials[material[l]]);
            return value;
        };
        if (looks.shape[0] > 0) {
            look_of([&](auto read) -> F { F value; EACH_LANE value[l] = read(looks.data[own[l]]); return value; });
        } else {
            look_of(of_material);
        }
        if (colored) {
            const int* color_index = (const int*)scene.color_index.data;
            const I first_color = igather(color_index, 3 * tri);
            const F uses = of_material([](const auto& a) { return (float)a.uses_vertex_color; });
            const I has = (first_color >= 0) & (uses != 0.0f);
            if (bits(seen & has)) {
                const float* all = (const float*)scene.colors.data;
                const V c0 = vgather(all, ipick(has, first_color, I(0)));
                const V c1 = vgather(all, ipick(has, igather(color_index, 3 * tri + 1), I(0)));
                const V c2 = vgather(all, ipick(has, igather(color_index, 3 * tri + 2), I(0)));
                const V mixed = add(add(times(w, c0), times(u, c1)), times(v, c2));
                base_color = vpick(has, mixed, base_color);
                const F metallic = of_material([](const auto& a) { return a.metallic; });
                const I metal = has & (metallic > 0.0f);
                const V tint = times(metallic, mixed);
                f0 = vpick(metal, add(grey((1.0f - metallic) * clearcoat_f0), tint), f0);
                f90 = vpick(metal, add(grey(1.0f - metallic), tint), f90);
            }
        }

        // shade.irradiance_at
        V total;
        {
            const F slope = (2.0f * pi / 3.0f) * dot(spread(lights.sky_slope), n);
            total = add(times(F(pi), spread(lights.sky)), grey(slope));
            if (lights.domes.shape[0] > 0) {
                V e = add(spread(lights.e_1), times(n.x, spread(lights.e_x)));
                e = add(e, times(n.y, spread(lights.e_y)));
                e = add(e, times(n.z, spread(lights.e_z)));
                V x = add(times(n.x, spread(lights.e_xx)), times(n.y, spread(lights.e_xy)));
                e = add(e, times(n.x, add(x, times(n.z, spread(lights.e_xz)))));
                e = add(e, times(n.y, add(times(n.y, spread(lights.e_yy)), times(n.z, spread(lights.e_yz)))));
                e = add(e, times(n.z * n.z, spread(lights.e_zz)));
                total = add(total, V{fmax(e.x, F(0.0f)), fmax(e.y, F(0.0f)), fmax(e.z, F(0.0f))});
            }
            if (sky.shape[0] > 0) total = times(gather(sky.data, own), total);
            if (direct.shape[0] > 0) {
                total = add(total, vgather((const float*)direct.data, own));
            } else {
                for (int k = 0; k < lights.direct.distant.shape[0]; ++k) {
                    const auto& light = lights.direct.distant.data[k];
                    total = add(total, times(fmax(dot(n, spread(light.to_light)), F(0.0f)), spread(light.irradiance)));
                }
                for (int k = 0; k < areas.shape[0]; ++k) {
                    const auto& area = areas.data[k];
                    total = add(total, times(sphere_irradiance(seen, area, p, n), spread(area.radiance)));
                }
            }
        }

        // shade.split_lobes
        auto sharp_share = [&](F rough) -> F {
            return pick(reflector, F(1.0f), clip((rough_roughness - rough) / (rough_roughness - sharp_roughness), 0.0f, 1.0f));
        };
        auto schlick = [&](V at_0, V at_90) -> V {
            const F m = 1.0f - clip(cosine, 0.0f, 1.0f);
            const F m2 = m * m;
            return add(at_0, times(m2 * m2 * m, sub(at_90, at_0)));
        };
        const F sharp = sharp_share(roughness);
        V mirror = vpick(sharp > 0.0f, times(sharp, schlick(f0, f90)), same(0.0f));
        const V blurred = times(1.0f - sharp, f0);
        V albedo = add(blurred, times(1.0f - through, product(sub(sub(f90, mirror), blurred), base_color)));
        if (bits(seen & (clearcoat > 0.0f))) {
            const F coat = clearcoat * schlick(grey(clearcoat_f0), same(1.0f)).x;
            const F sharp_coat = coat * sharp_share(clearcoat_roughness);
            const I coated = clearcoat > 0.0f;
            albedo = vpick(coated, add(times(1.0f - coat, albedo), grey(coat - sharp_coat)), albedo);
            mirror = vpick(coated, add(times(1.0f - coat, mirror), grey(sharp_coat)), mirror);
        }
        Lit result;
        result.base = times(opacity, add(emissive, product(albedo, times(F(1.0f / pi), total))));
        result.mirror = times(opacity, mirror);
        return result;
    };
    auto put = [](float* p, V a, int l) { p[0] = a.x[l]; p[1] = a.y[l]; p[2] = a.z[l]; };
"""

_EYE = r"""
    float* picture = (float*)out_picture.data;
    float* mirror = (float*)out_mirror.data;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const I tri = igather(triangle.data, own);
        const I reflector = igather(reflector_id.data, own) > 0;
        const int first_row = start / camera.width;
        const bool one_row = own[LANES - 1] < (first_row + 1) * camera.width;
        const I row = one_row ? I(first_row) : own / camera.width;
        const F x = __builtin_convertvector(own - row * camera.width, F) + 0.5f;
        const F y = __builtin_convertvector(row, F) + 0.5f;
        const V plane = add(add(spread(camera.ray_corner), times(x, spread(camera.ray_dx))), times(y, spread(camera.ray_dy)));
        const bool parallel = camera.orthographic != 0;
        const V ray = parallel ? spread(camera.forward) : plane;
        const V incident = unit(ray);
        const I seen = tri >= 0;
        Lit shown = Lit{same(0.0f), same(1.0f)};
        V onward = incident;
        if (bits(seen)) {
            // shade.weights_seen
            auto weights = [&](V p0, V p1, V p2, F& u, F& v) {
                const V eye = spread(camera.eye);
                V a = sub(p0, eye), b = sub(p1, eye), c = sub(p2, eye);
                if (parallel) { a = sub(a, plane); b = sub(b, plane); c = sub(c, plane); }
                const F eu = dot(cross(sub(c, a), add(c, a)), ray);
                const F ev = dot(cross(sub(a, b), add(a, b)), ray);
                const F ew = dot(cross(sub(b, c), add(b, c)), ray);
                const F det = eu + ev + ew;
                const F inv = 1.0f / det;
                const F cu = pick(det != 0.0f, fmax(eu * inv, F(0.0f)), F(0.0f));
                const F cv = pick(det != 0.0f, fmax(ev * inv, F(0.0f)), F(0.0f));
                const F total = cu + cv;
                u = pick(total > 1.0f, cu / total, cu);
                v = pick(total > 1.0f, cv / total, cv);
            };
            V reflected;
            const Lit found = lit(seen, own, ipick(seen, tri, I(0)), incident, reflector, weights, reflected);
            shown = Lit{vpick(seen, found.base, shown.base), vpick(seen, found.mirror, shown.mirror)};
            onward = vpick(seen, reflected, onward);
        }
        const I dome = ~reflector & (size(shown.mirror) > 0.0f);
        V base = shown.base;
        if (bits(dome)) base = vpick(dome, add(base, product(shown.mirror, dome_radiance(dome, onward))), base);
        const V weight = vpick(reflector, shown.mirror, same(0.0f));
        const F coverage = pick(seen, F(1.0f), F(0.0f));
        const int whole = end - start < LANES ? end - start : LANES;
        for (int l = 0; l < whole; ++l) {
            put(picture + 4 * (start + l), base, l);
            picture[4 * (start + l) + 3] = coverage[l];
            put(mirror + 3 * (start + l), weight, l);
        }
    }
"""

_MIRROR = r"""
    float* radiance = (float*)out_radiance.data;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const I tri = igather(triangle.data, own);
        const V ray = vgather((const float*)direction.data, own);
        const I seen = tri >= 0;
        Lit shown = Lit{same(0.0f), same(1.0f)};
        V onward = ray;
        if (bits(seen)) {
            auto weights = [&](V, V, V, F& u, F& v) { u = gather(weight_u.data, own); v = gather(weight_v.data, own); };
            V reflected;
            const Lit found = lit(seen, own, ipick(seen, tri, I(0)), ray, I(0), weights, reflected);
            shown = Lit{vpick(seen, found.base, shown.base), vpick(seen, found.mirror, shown.mirror)};
            onward = vpick(seen, reflected, onward);
        }
        const I dome = size(shown.mirror) > 0.0f;
        V base = shown.base;
        if (bits(dome)) base = vpick(dome, add(base, product(shown.mirror, dome_radiance(dome, onward))), base);
        const int whole = end - start < LANES ? end - start : LANES;
        for (int l = 0; l < whole; ++l) put(radiance + 3 * (start + l), base, l);
    }
"""


@wp.func_native(vector.snippet(_SHADING + _EYE))
def shade_block(
    block: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    lights: LightView,
    areas: wp.array(dtype=AreaView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    sharp_roughness: float,
    rough_roughness: float,
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
): ...


@wp.func_native(vector.snippet(_SHADING + _MIRROR))
def seen_block(
    block: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    lights: LightView,
    areas: wp.array(dtype=AreaView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    sharp_roughness: float,
    rough_roughness: float,
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    out_radiance: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def shade_blocks_kernel(
    first: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: CameraView,
    lights: LightView,
    areas: wp.array(dtype=AreaView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    sharp_roughness: float,
    rough_roughness: float,
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    # Outputs:
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
):
    """One thread per block of pixels; as `shade.shade_kernel`."""
    shade_block(
        first + wp.tid(),
        scene,
        records,
        camera,
        lights,
        areas,
        looks,
        normals,
        direct,
        sky,
        sharp_roughness,
        rough_roughness,
        triangle,
        reflector_id,
        out_picture,
        out_mirror,
    )


@wp.kernel
def seen_blocks_kernel(
    first: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    lights: LightView,
    areas: wp.array(dtype=AreaView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    direct: wp.array(dtype=wp.vec3),
    sky: wp.array(dtype=float),
    sharp_roughness: float,
    rough_roughness: float,
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per block of mirror pixels; as `shade.seen_radiance_kernel`."""
    seen_block(
        first + wp.tid(),
        scene,
        records,
        lights,
        areas,
        looks,
        normals,
        direct,
        sky,
        sharp_roughness,
        rough_roughness,
        direction,
        triangle,
        weight_u,
        weight_v,
        out_radiance,
    )
