"""Text that vector kernels share which look at points of triangles: their normals, and what spheres that shine bring to them.

The formulas of `surface.hit_normal` and `direct.sphere_irradiance` in the same order.
"""

from __future__ import annotations

# After `vector.snippet`'s head. Needs: `scene`, a `SceneView`.
HITS = r"""
// A loop over lanes that is kept one: unrolled, it would take long to compile.
#define LANE_BY_LANE _Pragma("clang loop unroll(disable)") for (int l = 0; l < LANES; ++l)
    // The quadrics of the patches of some lanes: rows and shifts of `unit_from_scene`, and a, b, c.
    struct Quadric { V row[3]; F shift[3], a, b, c; };
    auto quadric_of = [&](I patch, bool alone) -> Quadric {
        const auto* patches = scene.patches.data;
        float rows[15 * LANES];
        LANE_BY_LANE {
            if (alone && l > 0) break;
            const auto& each = patches[patch[l]];
            for (int k = 0; k < 12; ++k) rows[k * LANES + l] = each.unit_from_scene.data[k / 4][k % 4];
            for (int k = 0; k < 3; ++k) rows[(12 + k) * LANES + l] = each.quadric[k];
        }
        auto field = [&](int k) -> F { return alone ? F(rows[k * LANES]) : load(rows + k * LANES); };
        Quadric of;
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 3; ++k) {
            of.row[k] = V{field(4 * k), field(4 * k + 1), field(4 * k + 2)};
            of.shift[k] = field(4 * k + 3);
        }
        of.a = field(12); of.b = field(13); of.c = field(14);
        return of;
    };
    // Point p in the frame of its quadric.
    auto in_quadric = [&](const Quadric& of, V p) -> V {
        return V{dot(of.row[0], p) + of.shift[0], dot(of.row[1], p) + of.shift[1], dot(of.row[2], p) + of.shift[2]};
    };
    // A vector of the frame of a quadric as one of the scene.
    auto from_quadric = [&](const Quadric& of, V g) -> V {
        return add(add(times(g.x, of.row[0]), times(g.y, of.row[1])), times(g.z, of.row[2]));
    };
    // direct.sphere_irradiance; lanes that see a part of a sphere below their horizon take their time.
    auto sphere_irradiance = [&](I mask, const auto& area, V p, V n) -> F {
        constexpr float pi = 3.14159265358979f;
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
    (void)quadric_of; (void)in_quadric; (void)from_quadric; (void)sphere_irradiance;
"""
