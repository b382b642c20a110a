"""`shade.shade_kernel`, `shade.seen_radiance_kernel` and `shade.mirror_term_kernel` for a block of points at a time.

The same formulas in the same order; lanes differ in their triangle, patch and material. Neighbouring points mostly share a
patch, whose constants are then read once for a vector. Spheres that shine without shadows are summed here as well, so that
their light needs no pass of its own.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.compact import none
from warp_reflect.direct import AreaView
from warp_reflect.direct_vector import SPHERES
from warp_reflect.hits_vector import HITS
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer
from warp_reflect.scene import Scene, SceneView
from warp_reflect.shade import LightView
from warp_reflect.textures import Look

wp.set_module_options({"enable_backward": False})

EYE_BLOCKS = 4  # blocks of pixels a task: what does not change along them (lights, camera) is spread into vectors once
RAY_BLOCKS = 4  # blocks of rays a task, where all of them are split over threads just the same
HITS_SPLIT_MIN = 16  # blocks of rays; those of a few pixels meet triangles all over the scene, at 8 us a block

# After `vector.snippet`'s head, in functions that have `pixel`, `out_picture` and `out_mirror`.
TERMS = r"""
    float* picture = (float*)out_picture.data;
    float* mirrors = (float*)out_mirror.data;
    // Mirror pixels from `start` on whose rays see `radiance`: as many as there are lanes, or those before `end`.
    auto add_term = [&](int start, int end, V radiance) {
        const bool full = start + LANES <= end;
        const int first = pixel.data[start];
        // Mostly side by side in a row.
        if (full && !bits(iload(pixel.data + start) != first + lanes())) {
            const V term = product(vload(mirrors, first), radiance);
            float rows[4 * LANES];
            vstore4(rows, 0, term, F(0.0f));
            vstore(mirrors, first, term);
            for (int k = 0; k < 4 * LANES; k += LANES)
                store(picture + 4 * first + k, load(picture + 4 * first + k) + load(rows + k));
            return;
        }
        float seen[3 * LANES];
        vstore(seen, 0, radiance);
        for (int i = start; i < (full ? start + LANES : end); ++i) {
            const int p = pixel.data[i];
            for (int c = 0; c < 3; ++c) {
                const float term = mirrors[3 * p + c] * seen[3 * (i - start) + c];
                mirrors[3 * p + c] = term;
                picture[4 * p + c] += term;
            }
        }
    };
    // What that will change, while other pixels are shaded.
    constexpr int AHEAD = 2 * LANES;
    auto fetch_term = [&](int start) {
        const int first = pixel.data[start];
        for (int word = 0; word < 3 * LANES; word += 16) __builtin_prefetch(mirrors + 3 * first + word, 1);
        for (int word = 0; word < 4 * LANES; word += 16) __builtin_prefetch(picture + 4 * first + word, 1);
    };
    (void)fetch_term;
"""


@wp.func_native(
    vector.snippet(
        SPHERES
        + HITS
        + TERMS
        + r"""
    const float pi = 3.14159265358979f;
    const int count = triangle.shape[0];
    const int span = blocks * BLOCK;
    const int begin = task * span;
    const int end = begin + span < count ? begin + span : count;
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
    const bool looked_up = looks.shape[0] > 0;
    const auto* materials = scene.materials.data;
    constexpr int look_words = sizeof(*looks.data) / 4, material_words = sizeof(*materials) / 4;
    static_assert(look_words == 18, "a look is what is read here");
    const float* table = looked_up ? (const float*)looks.data : (const float*)materials;
    const bool have_colors = scene.color_index.shape[0] > 0 && !looked_up;
    float* radiance = (float*)out_radiance.data;
    const bool adds = pixel.shape[0] > 0;
    for (int start = begin; start < end; start += LANES) {
        if (adds && start + AHEAD < count) fetch_term(start + AHEAD);
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const bool full = start + LANES <= end;
        const I named = irow(triangle.data, start, full, own);
        const I seen = named >= 0;
        const I tri = ipick(seen, named, I(0));
        I reflector = I(0);
        if (of_eye != 0) reflector = irow(reflector_id.data, start, full, own) > 0;

        // textures.plain_look without the mesh's colours, or what was looked up before.
        Triangles triangles;
        bool alone = false;
        I patch = I(0), at = I(0), colored = I(0), even = I(0), bare = I(0);
        V base_color, f0, f90, emissive;
        F roughness, clearcoat = F(0.0f), clearcoat_roughness, clearcoat_f0, opacity, through;
        if (bits(seen)) {
            triangles = triangles_of(tri);
            patch = patch_of(triangles);
            at = looked_up ? look_words * own : material_words * of_patch(&patches->material, triangles, patch);
            alone = triangles.one_patch && !looked_up;
            F field[18];
            if (alone) {
                _Pragma("clang loop unroll(full)") for (int k = 0; k < 18; ++k) field[k] = F(table[at[0] + k]);
            } else {
                F last[8];
                gather8(table, at, field);
                gather8(table, at + 8, field + 8);
                gather8(table, at + 10, last);
                field[16] = last[6]; field[17] = last[7];
            }
            base_color = V{field[0], field[1], field[2]};
            f0 = V{field[3], field[4], field[5]};
            f90 = V{field[6], field[7], field[8]};
            emissive = V{field[9], field[10], field[11]};
            roughness = field[12]; clearcoat = field[13]; clearcoat_roughness = field[14]; clearcoat_f0 = field[15];
            opacity = field[16]; through = field[17];
            if (have_colors) {
                const int* uses = &materials->uses_vertex_color;
                colored = alone ? I(uses[at[0]]) != 0 : igather(uses, at) != 0;
            }
            // What mirrors as much at any angle, and gives back nothing besides.
            even = (f0.x == f90.x) & (f0.y == f90.y) & (f0.z == f90.z) & ~colored;
            if (bits(reflector) == bits(I(-1))) bare = seen & even & ~(clearcoat > 0.0f);
        }

        V base = same(0.0f), mirror = same(1.0f);
        if (bits(bare) == bits(I(-1))) {
            base = times(opacity, emissive);
            mirror = times(opacity, f0);
        } else {
            Sight eye;
            V ray;
            if (of_eye != 0) {
                F column, line;
                place(own, camera.width, column, line);
                eye = sight(column + 0.5f, line + 0.5f);
                ray = eye.ray;
            } else {
                ray = vrows((const float*)direction.data, start, full, own);
            }
            V onward;
            if (bits(seen)) {
                // shade.sharp_share
                auto sharp_share = [&](F rough) -> F {
                    const F share = clip((rough_roughness - rough) / (rough_roughness - sharp_roughness), 0.0f, 1.0f);
                    return pick(reflector, F(1.0f), share);
                };
                const F sharp = sharp_share(roughness);
                const I coated = seen & (clearcoat > 0.0f), sharply = seen & (sharp > 0.0f);
                // Where it matters under which angle a surface is seen, and where a ray goes on.
                const I glancing = ~seen | coated | (sharply & ~(even & reflector));

                V p0, p1, p2;
                corners_of(records.data, tri, triangles.runs, p0, p1, p2);
                const Corners smooth = normals_of(triangles);
                Corners colors = {};
                if (bits(seen & colored)) colors = at_corners(triangles, scene.color_index, scene.colors);
                const I has_color = colored & colors.has;
                const I quadric = (of_patch(&patches->shape, triangles, patch) == 1) & ~smooth.has;
                F u = F(0.0f), v = F(0.0f);
                V p = same(0.0f);
                if (bits(seen & (smooth.has | quadric | has_color)) || areas.shape[0] > 0) {
                    if (of_eye != 0) {
                        eye_weights(eye, p0, p1, p2, u, v);
                    } else {
                        u = frow(weight_u.data, start, full, own);
                        v = frow(weight_v.data, start, full, own);
                    }
                    p = add(add(times(1.0f - u - v, p0), times(u, p1)), times(v, p2));
                }
                if (bits(seen & has_color)) {
                    const V mixed = between(colors, u, v);
                    base_color = vpick(has_color, mixed, base_color);
                    const F metallic = alone ? F((&materials->metallic)[at[0]]) : gather(&materials->metallic, at);
                    const I metal = has_color & (metallic > 0.0f);
                    const V tint = times(metallic, mixed);
                    f0 = vpick(metal, add(grey((1.0f - metallic) * clearcoat_f0), tint), f0);
                    f90 = vpick(metal, add(grey(1.0f - metallic), tint), f90);
                }

                Quadric of;
                V q;
                auto facet = [&]() -> V { return facet_normal(p0, p1, p2); };
                V n = hit_normal(seen, patch, quadric, facet, p, u, v, smooth, of, q);
                if (normals.shape[0] > 0) {
                    const V mapped = vrows((const float*)normals.data, start, full, own);
                    n = vpick(dot(mapped, mapped) > 0.0f, mapped, n);
                }
                n = vpick(dot(n, ray) > 0.0f, times(F(-1.0f), n), n);
                F grazing = F(0.0f);  // what is left of Schlick's power of the cosine
                if (bits(glancing)) {
                    if (of_eye != 0) ray = unit(ray);
                    const F along = dot(n, ray);
                    onward = vpick(seen, sub(ray, times(2.0f * along, n)), ray);
                    const F m = 1.0f - clip(__builtin_elementwise_abs(along), 0.0f, 1.0f);
                    const F m2 = m * m;
                    grazing = m2 * m2 * m;
                }

                // shade.irradiance_at
                const F slope = (2.0f * pi / 3.0f) * dot(spread(lights.sky_slope), n);
                V total = add(times(F(pi), spread(lights.sky)), grey(slope));
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
                if (sky.shape[0] > 0) total = times(frow(sky.data, start, full, own), total);
                if (direct.shape[0] > 0) {
                    total = add(total, vrows((const float*)direct.data, start, full, own));
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

                // shade.split_lobes
                auto schlick = [&](V at_0, V at_90) -> V { return add(at_0, times(grazing, sub(at_90, at_0))); };
                V gleam = same(0.0f);
                if (bits(sharply)) gleam = vpick(sharply, times(sharp, schlick(f0, f90)), gleam);
                const V blurred = times(1.0f - sharp, f0);
                V albedo = add(blurred, times(1.0f - through, product(sub(sub(f90, gleam), blurred), base_color)));
                if (bits(coated)) {
                    const F coat = clearcoat * schlick(grey(clearcoat_f0), same(1.0f)).x;
                    const F sharp_coat = coat * sharp_share(clearcoat_roughness);
                    albedo = vpick(coated, add(times(1.0f - coat, albedo), grey(coat - sharp_coat)), albedo);
                    gleam = vpick(coated, add(times(1.0f - coat, gleam), grey(sharp_coat)), gleam);
                }
                base = vpick(seen, times(opacity, add(emissive, product(albedo, times(F(1.0f / pi), total)))), base);
                mirror = vpick(seen, times(opacity, gleam), mirror);
            } else {
                onward = of_eye != 0 ? unit(ray) : ray;
            }
            const I dome = ~reflector & (size(mirror) > 0.0f);
            if (bits(dome)) base = vpick(dome, add(base, product(mirror, dome_radiance(dome, onward))), base);
        }
        const V weight = vpick(reflector, mirror, same(0.0f));
        const F covered = pick(seen, F(1.0f), F(0.0f));
        if (adds) {
            add_term(start, end, base);
        } else if (of_eye == 0 && full) {
            vstore(radiance, start, base);
        } else if (full) {
            vstore4(picture, start, base, covered);
            vstore(mirrors, start, weight);
        } else {
            for (int l = 0; l < end - start; ++l) {
                const int i = start + l;
                float* of_base = of_eye == 0 ? radiance + 3 * i : picture + 4 * i;
                of_base[0] = base.x[l]; of_base[1] = base.y[l]; of_base[2] = base.z[l];
                if (of_eye == 0) continue;
                of_base[3] = covered[l];
                mirrors[3 * i] = weight.x[l]; mirrors[3 * i + 1] = weight.y[l]; mirrors[3 * i + 2] = weight.z[l];
            }
        }
    }
"""
    )
)
def shade_block(
    task: int,
    blocks: int,
    of_eye: int,
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
    direction: wp.array(dtype=wp.vec3),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def shade_blocks_kernel(
    first: int,
    blocks: int,
    of_eye: int,
    scene: SceneView,
    records: wp.array(dtype=float),
    camera: wp.array(dtype=CameraView),
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
    direction: wp.array(dtype=wp.vec3),
    weight_u: wp.array(dtype=float),
    weight_v: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    # Outputs:
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per some blocks of pixels that the eye sees, or of rays, whose arrays are then those of length 0.

    What rays see goes into the picture where their pixels are told.
    """
    shade_block(
        first + wp.tid(),
        blocks,
        of_eye,
        scene,
        records,
        camera[0],
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
        direction,
        weight_u,
        weight_v,
        pixel,
        out_picture,
        out_mirror,
        out_radiance,
    )


def shade_eye(scene: Scene, gbuffer: GBuffer, light: list, picture: wp.array, mirror: wp.array, threads: int) -> None:
    """What `shade.shade_kernel` does.

    Args:
        light: Light, spheres to sum, looks, normals, direct irradiance, share of the sky, the two roughnesses.
    """
    device = scene.device
    rays = [none(wp.vec3, device), none(float, device), none(float, device), none(int, device)]
    inputs = [
        EYE_BLOCKS,
        1,
        scene.view,
        scene.triangle_records,
        gbuffer.view,
        *light,
        gbuffer.triangle,
        gbuffer.reflector_id,
        *rays,
    ]
    inputs += [picture, mirror, none(wp.vec3, device)]
    vector.launch_blocks(shade_blocks_kernel, len(gbuffer.triangle), inputs, device, threads, blocks=EYE_BLOCKS)


def shade_rays(
    scene: Scene, gbuffer: GBuffer, layer: ReflectionLayer, light: list, threads: int, into: tuple | None = None
) -> wp.array:
    """What `shade.seen_radiance_kernel` does; `light` as in `shade_eye`.

    Args:
        into: Picture and mirrors' weights, to which `shade.mirror_term_kernel` adds; None: it is left to the caller.

    Returns:
        Radiance, vec3 [layer.pixels.count]; of length 0 where it went into a picture.
    """
    device, pixels = scene.device, layer.pixels
    radiance = none(wp.vec3, device) if into else wp.empty(pixels.count, dtype=wp.vec3, device=device)
    rays = [pixels.direction, layer.u, layer.v, pixels.pixel if into else none(int, device)]
    inputs = [
        RAY_BLOCKS,
        0,
        scene.view,
        scene.triangle_records,
        gbuffer.view,
        *light,
        layer.triangle,
        none(int, device),
        *rays,
    ]
    inputs += [*(into or (none(wp.vec4, device), none(wp.vec3, device))), radiance]
    vector.launch_blocks(shade_blocks_kernel, pixels.count, inputs, device, threads, RAY_BLOCKS, HITS_SPLIT_MIN)
    return radiance


@wp.func_native(
    vector.snippet(
        TERMS
        + r"""
    const int count = pixel.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const bool full = start + LANES <= end;
        const V seen = vrows((const float*)radiance.data, start, full, ipick(element < end, element, I(end - 1)));
        add_term(start, end, seen);
    }
"""
    )
)
def mirror_term_block(
    block: int,
    pixel: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def mirror_term_blocks_kernel(
    first: int,
    pixel: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    # Outputs:
    out_picture: wp.array(dtype=wp.vec4),
    out_mirror: wp.array(dtype=wp.vec3),
):
    """One thread per block of mirror pixels."""
    mirror_term_block(first + wp.tid(), pixel, radiance, out_picture, out_mirror)


def add_mirror_term(pixel: wp.array, radiance: wp.array, picture: wp.array, mirror: wp.array, threads: int) -> None:
    """What `shade.mirror_term_kernel` does."""
    inputs = [pixel, radiance, picture, mirror]
    vector.launch_blocks(mirror_term_blocks_kernel, len(pixel), inputs, picture.device, threads)
