"""The lobe of a rough mirror: Trowbridge-Reitz (GGX) microfacets, alpha = roughness^2 as UsdPreviewSurface has it.

Sources: Walter et al., Microfacet Models for Refraction through Rough Surfaces, EGSR 2007 (distribution); Heitz,
Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs, JCGT 2014, equations 72 and 99 (Smith, height
correlated); Heitz, Sampling the GGX Distribution of Visible Normals, JCGT 2018, in the form of Dupuy and Benyoub, Sampling
Visible GGX Normals with Spherical Caps, HPG 2023, listing 3. Differs from them by: sums of squares over alpha^2 instead of
cosines near 1, which hold no digits of a lobe of alpha = 1e-4 in float32.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.optics import tangent_basis
from warp_reflect.scene import SceneView
from warp_reflect.shade import schlick
from warp_reflect.shapes import unit
from warp_reflect.textures import Look, plain_look

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.141592653589793)
GOLDEN = wp.constant(0.6180339887498949)  # (sqrt(5) - 1) / 2, the slope of a Fibonacci lattice
# Of the shift from pixel to pixel, right and down: the least of 10,000 in the L2 discrepancy around the square (Hickernell, A
# Generalized Discrepancy and Quadrature Error Bound, Math. Comp. 1998) of the lattices of 2x2 to 7x7 pixels, 1 to 8 points each.
SHIFT = wp.constant(wp.mat22(0.42302, 0.69520, 0.73080, 0.58289))
# Smallest alpha: below it a lobe is narrower than the rounding of a direction. Roughness 0.003.
LEAST_ALPHA = wp.constant(1.0e-5)
# A viewer below this cosine would see none of the lobe's microfacets at a finite density.
LEAST_COSINE = wp.constant(1.0e-4)
LEAST_WEIGHT = wp.constant(1.0e-6)  # of a mirror, that a lobe is put in relation to


@wp.struct
class Lobe:
    """One lobe of a material at a point."""

    alpha: float
    f0: wp.vec3
    f90: wp.vec3


@wp.struct
class LobeSample:
    """One reflected direction of a lobe. World axes."""

    direction: wp.vec3  # unit, out of the surface where the weight is not 0
    half: wp.vec3  # unit, the microfacet's normal
    weight: float  # the lobe over the density it was drawn from, without Fresnel: at most 1
    cosine: float  # of the angle of incidence on the microfacet
    solid_angle: float  # that it stands for, times the number of samples


@wp.func
def surface_lobe(scene: SceneView, looks: wp.array(dtype=Look), pixel: int, triangle: int, coat: int) -> Lobe:
    """The base lobe (coat 0) or the clear coat's (coat 1) of what the eye sees at a pixel.

    `looks` is `shade.Shown.looks`. Without textures colours that vary over a mesh are those of the triangle's middle.
    """
    look = Look()
    if looks.shape[0] > 0:
        look = looks[pixel]
    else:
        look = plain_look(scene, triangle, 1.0 / 3.0, 1.0 / 3.0)
    lobe = Lobe()
    roughness = look.roughness
    lobe.f0 = look.f0
    lobe.f90 = look.f90
    if coat != 0:
        roughness = look.clearcoat_roughness
        lobe.f0 = wp.vec3(look.clearcoat_f0, look.clearcoat_f0, look.clearcoat_f0)
        lobe.f90 = wp.vec3(1.0, 1.0, 1.0)
    lobe.alpha = wp.max(roughness * roughness, LEAST_ALPHA)
    return lobe


@wp.func
def smith(cosine: float, alpha: float) -> float:
    """Lambda of Smith's masking for a direction at a cosine to the normal."""
    c2 = cosine * cosine
    slope = alpha * alpha * wp.max(1.0 - c2, 0.0) / wp.max(c2, LEAST_COSINE * LEAST_COSINE)
    return 0.5 * slope / (1.0 + wp.sqrt(1.0 + slope))


@wp.func
def lattice_point(k: int, count: int, shift: wp.vec2) -> wp.vec2:
    """Point k of a Fibonacci lattice of `count` points on the unit square, moved by `shift` around it."""
    x = (float(k) + 0.5) / float(count) + shift[0]
    y = (float(k) + 0.5) * GOLDEN + shift[1]
    return wp.vec2(x - wp.floor(x), y - wp.floor(y))


@wp.func
def pixel_shift(pixel: int) -> wp.vec2:
    """A pixel's own shift of the lattice, always the same: what is left of its pattern is noise and no ghost image."""
    state = wp.rand_init(pixel)
    return wp.vec2(wp.randf(state), wp.randf(state))


@wp.func
def even_shift(x: int, y: int) -> wp.vec2:
    """A shift of the lattice that differs most between pixels close by: their points together are spread evenly too."""
    u = SHIFT[0, 0] * float(x) + SHIFT[0, 1] * float(y)
    v = SHIFT[1, 0] * float(x) + SHIFT[1, 1] * float(y)
    return wp.vec2(u - wp.floor(u), v - wp.floor(v))


@wp.func
def lobe_sample(alpha: float, n: wp.vec3, view: wp.vec3, point: wp.vec2) -> LobeSample:
    """A reflected direction drawn in proportion to the microfacets that the viewer sees.

    Args:
        alpha: Of the lobe, > 0.
        n: Unit normal.
        view: Unit direction to the viewer, on the normal's side.
        point: On the unit square.
    """
    t1, t2 = tangent_basis(n)
    vx = wp.dot(view, t1)
    vy = wp.dot(view, t2)
    vz = wp.max(wp.dot(view, n), LEAST_COSINE)
    stretched = unit(wp.vec3(alpha * vx, alpha * vy, vz))
    phi = 2.0 * PI * point[0]
    z = (1.0 - point[1]) * (1.0 + stretched[2]) - stretched[2]
    sine = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    cap = wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), z) + stretched
    # The microfacet's normal is (alpha cap.x, alpha cap.y, cap.z) over its length.
    inv = 1.0 / wp.length(wp.vec3(alpha * cap[0], alpha * cap[1], cap[2]))
    hx = alpha * cap[0] * inv
    hy = alpha * cap[1] * inv
    hz = cap[2] * inv
    slope = cap[0] * inv
    slope_y = cap[1] * inv
    shape = hz * hz + slope * slope + slope_y * slope_y
    result = LobeSample()
    result.half = hx * t1 + hy * t2 + hz * n
    cosine = wp.clamp(vx * hx + vy * hy + vz * hz, 0.0, 1.0)
    result.cosine = cosine
    # 2 (v.h) h - v, from the part of h across n: exact for the narrowest lobe.
    result.direction = unit(2.0 * wp.dot(view, result.half) * result.half - view)
    out = wp.dot(result.direction, n)
    if out <= 0.0:
        return result
    seen = 1.0 + smith(vz, alpha)
    result.weight = seen / (seen + smith(out, alpha))
    # Density of directions: D G1 / (4 n.v), D = 1 / (pi alpha^2 shape^2), G1 = 1 / seen.
    result.solid_angle = 4.0 * vz * seen * PI * alpha * alpha * shape * shape
    return result


@wp.func
def lobe_value(alpha: float, n: wp.vec3, view: wp.vec3, direction: wp.vec3) -> LobeSample:
    """A given direction as a sample of a lobe, see `lobe_sample`; weight 0 where it could not be one.

    Args:
        alpha: Of the lobe, > 0.
        n: Unit normal.
        view: Unit direction to the viewer, on the normal's side.
        direction: Unit.
    """
    result = LobeSample()
    result.direction = direction
    out = wp.dot(direction, n)
    across = direction + view
    length = wp.length(across)
    if out <= 0.0 or length == 0.0:
        return result
    h = across / length
    result.half = h
    hz = wp.dot(h, n)
    flat = (h - hz * n) / alpha
    shape = hz * hz + wp.dot(flat, flat)
    vz = wp.max(wp.dot(view, n), LEAST_COSINE)
    seen = 1.0 + smith(vz, alpha)
    result.cosine = wp.clamp(wp.dot(view, h), 0.0, 1.0)
    result.weight = seen / (seen + smith(out, alpha))
    result.solid_angle = 4.0 * vz * seen * PI * alpha * alpha * shape * shape
    return result


@wp.func
def eye_side(direction: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Unit direction back to the eye from a sharp reflection and the normal it was reflected at."""
    return 2.0 * wp.dot(direction, n) * n - direction


@wp.func
def outward(direction: wp.vec3, n: wp.vec3) -> wp.vec3:
    """A direction out of the surface: what a normal map sends into it is reflected once more."""
    into = wp.min(wp.dot(direction, n), 0.0)
    return direction - 2.0 * into * n


@wp.func
def share_of_weight(lobe: Lobe, cosine: float, total: wp.vec3, seen: wp.vec3, given: wp.vec3) -> wp.vec3:
    """Radiance that, times a sharp mirror's weight, is what a lobe reflects.

    Args:
        lobe: Its F0 and F90.
        cosine: Of the angle of incidence on the surface.
        total: Mean of all directions' weights.
        seen: Sum of the weights of those whose radiance is known, times that.
        given: Sum of their weights.
    """
    sharp = schlick(lobe.f0, lobe.f90, cosine)
    result = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if given[c] > 0.0:
            result[c] = seen[c] / given[c]
            if sharp[c] > LEAST_WEIGHT:
                result[c] *= wp.min(total[c] / sharp[c], 1.0)
    return result
