"""Text of `direct.py`'s functions for the vector kernels that sum light: the same formulas in the same order."""

from __future__ import annotations

# After `vector.snippet`'s head.
SPHERES = r"""
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
"""
