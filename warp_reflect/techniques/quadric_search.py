"""The search for a reflection point on the convex side of a quadric, in float32: device functions for the frame.

Source: the foot-point and Newton searches of `warp_reflect.quadrics`; the mirrors are those of Lages Miguel, Nogueira,
Goncalves, "Real-Time 3D Visualization of Accurate Specular Reflections in Curved Mirrors" (GRAPP 2014). What differs from
the paper: it walks along the curve in which the mirror meets a second quadric and compares path lengths, whose minimum
float32 knows to 3e-4 only (`solve_qim.py` keeps that search to compare with); here the root of the law of reflection is
found, to 1e-7. Where the body stands between eye and point is read from the quadric along the line of sight.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.layers import CameraView, project
from warp_reflect.optics import safe_normalize, tangent_basis
from warp_reflect.quadrics import (
    bracket_on_convex,
    first_guess,
    newton_on_convex,
    put_on_surface,
    quadric_curve,
    quadric_half_gradient,
    quadric_value,
)
from warp_reflect.settings import Status
from warp_reflect.techniques.vertices import SolveFrame, VertexView, edge_reach, virtual_vertex

# Unrolled, the searches in loops of known length would be compiled many times over.
wp.set_module_options({"enable_backward": False, "max_unroll": 2})

# Angle. The float32 floor of the residual is 1e-7 to 3e-7; a vertex that is off by this moves by 1/100 of a pixel.
TOLERANCE = wp.constant(4.0e-6)
ACCEPTED = wp.constant(1.0e-3)  # angle above which an answer is MAX_ITERATIONS rather than CONVERGED
NEWTON_STEPS = wp.constant(12)  # evaluations; cold starts need 3 to 6
GUESS_STEPS = wp.constant(3)  # Newton steps of the first foot point; more do not pay
GRAZING_COS = wp.constant(0.1)  # cosine of incidence below which a search without a root lies on the silhouette
TOUCHING = wp.constant(5.0e-7)  # of the unit: a few roundings of a float32 point
APEX_NEAR = wp.constant(1.0e-6)  # of the unit: a foot point so close to a cone's apex is the apex
FAMILY_SHEET = wp.constant(2)
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))


@wp.struct
class QuadricView:
    """A quadric in its unit principal frame, see `warp_reflect.quadrics`; a sheet lies at z > 0."""

    lam: wp.vec3
    b: float
    c: float
    family: int


@wp.func
def in_body(quadric: QuadricView, x: wp.vec3) -> bool:
    """True on the body's side of its surface."""
    if quadric.family == FAMILY_SHEET and x[2] <= 0.0:
        return False
    return quadric_value(x, quadric.lam, quadric.b, quadric.c) < 0.0


@wp.func
def touches(quadric: QuadricView, x: wp.vec3) -> bool:
    """True for a point of the surface, within rounding."""
    if quadric.family == FAMILY_SHEET and x[2] <= 0.0:
        return False
    q = quadric_value(x, quadric.lam, quadric.b, quadric.c)
    n = wp.length(quadric_half_gradient(x, quadric.lam, quadric.b))
    return wp.abs(q) <= 2.0 * TOUCHING * (1.0 + wp.length(x)) * n


@wp.func
def is_visible(quadric: QuadricView, eye: wp.vec3, target: wp.vec3) -> bool:
    """True where the segment from an outside eye to the target misses the convex body and ends outside it."""
    if in_body(quadric, target):
        return False
    d = target - eye
    along = quadric_curve(d, d, quadric.lam)
    at_eye = quadric_half_gradient(eye, quadric.lam, quadric.b)
    at_target = quadric_half_gradient(target, quadric.lam, quadric.b)
    if along <= 0.0 or wp.dot(at_eye, d) >= 0.0 or wp.dot(at_target, d) <= 0.0:
        return True
    # The least value on the segment, reached from the nearer end: a discriminant would lose a far eye's digits.
    p = eye
    slope = wp.dot(at_eye, d)
    if wp.dot(target, target) < wp.dot(eye, eye):
        p = target
        slope = wp.dot(at_target, d)
    return not in_body(quadric, p - (slope / along) * d)


@wp.func
def apex_is_shortest(quadric: QuadricView, eye: wp.vec3, target: wp.vec3) -> bool:
    """True where the shortest path over a cone touches its apex: the half vector lies among the apex's normals."""
    w = safe_normalize(eye) + safe_normalize(target)
    across = w[0] * w[0] / quadric.lam[0] + w[1] * w[1] / quadric.lam[1]
    return w[2] <= 0.0 and across <= -w[2] * w[2] / quadric.lam[2]


@wp.func
def least_curvature(quadric: QuadricView, p: wp.vec3, n: wp.vec3, n_length: float) -> float:
    """The smaller principal curvature of a convex body at a surface point."""
    t1, t2 = tangent_basis(n)
    s11 = quadric_curve(t1, t1, quadric.lam)
    s12 = quadric_curve(t1, t2, quadric.lam)
    s22 = quadric_curve(t2, t2, quadric.lam)
    mean = 0.5 * (s11 + s22)
    spread = wp.sqrt(0.25 * (s11 - s22) * (s11 - s22) + s12 * s12)
    return wp.max(mean - spread, 0.0) / n_length


@wp.func
def search_convex(quadric: QuadricView, eye: wp.vec3, target: wp.vec3, seed: wp.vec3):
    """(reflection point, angle error) of a visible target; a seed of zero length is none.

    A search that ends far from a root starts once more from the bracketed search, which always converges. One loop for
    both: everything is inlined, and a second copy of the body would double the compile time.
    """
    start = seed
    if wp.dot(seed, seed) > 0.0:
        start = put_on_surface(seed, quadric.lam, quadric.b, quadric.c, quadric.family)
    else:
        start = first_guess(eye, target, quadric.lam, quadric.b, quadric.c, quadric.family, GUESS_STEPS)
    best = start
    best_angle = float(4.0)
    attempt = int(0)
    while attempt < 2:
        p, angle = newton_on_convex(
            start, eye, target, quadric.lam, quadric.b, quadric.c, quadric.family, NEWTON_STEPS, TOLERANCE
        )
        if angle < best_angle:
            best = p
            best_angle = angle
        attempt += 1
        if best_angle <= ACCEPTED:
            break
        if attempt == 1:
            start = bracket_on_convex(eye, target, quadric.lam, quadric.b, quadric.c, quadric.family)
    return best, best_angle


@wp.func
def solve_vertex(
    quadric: QuadricView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    target: wp.vec3,
    warm_seed: wp.vec3,
    i: int,
    out_vertex: VertexView,
):
    """Full solution of one vertex into entry i; the eye is outside the body."""
    out_vertex.seed[i] = wp.vec3(0.0, 0.0, 0.0)
    out_vertex.screen[i] = wp.vec4(0.0, 0.0, -1.0, 0.0)
    if touches(quadric, target):
        # Its own reflection, where the eye sees it.
        facing = wp.dot(quadric_half_gradient(target, quadric.lam, quadric.b), frame.eye - target) > 0.0
        out_vertex.status[i] = wp.uint8(wp.where(facing, CONVERGED, HIDDEN))
        if facing:
            out_vertex.seed[i] = target
            image = frame.eye_from_unit * (target - frame.eye)
            out_vertex.screen[i] = project(camera[0], image)
            if out_vertex.position.shape[0] > 0:
                out_vertex.position[i] = image
        return
    if not is_visible(quadric, frame.eye, target):
        out_vertex.status[i] = wp.uint8(HIDDEN)
        return
    if quadric.family == FAMILY_SHEET and quadric.c == 0.0:
        if apex_is_shortest(quadric, frame.eye, target):
            # Its picture is the apex itself, the limit of what the cone shows around it.
            out_vertex.status[i] = wp.uint8(CONVERGED)
            beyond = wp.normalize(-frame.eye) * wp.length(target)
            image = frame.eye_from_unit * (beyond - frame.eye)
            out_vertex.screen[i] = project(camera[0], image)
            if out_vertex.position.shape[0] > 0:
                out_vertex.position[i] = image
            return
    p, angle = search_convex(quadric, frame.eye, target, warm_seed)
    out_vertex.residual[i] = angle
    n = quadric_half_gradient(p, quadric.lam, quadric.b)
    n_length = wp.length(n)
    if not (angle <= ACCEPTED) or n_length < APEX_NEAR:
        # So close behind the silhouette that rounding decides: as good as hidden, and the boundary's bisection ends at
        # the vertex itself, where virtual and real point coincide.
        cosine = wp.dot(safe_normalize(n), safe_normalize(frame.eye - p))
        out_vertex.status[i] = wp.uint8(wp.where(cosine < GRAZING_COS, HIDDEN, MAX_ITERATIONS))
        return
    n = n / n_length
    out_vertex.seed[i] = p
    out_vertex.status[i] = wp.uint8(CONVERGED)
    out_vertex.reach[i] = edge_reach(frame, p, n, target, least_curvature(quadric, p, n, n_length))
    q = virtual_vertex(frame, p, n, target)
    out_vertex.screen[i] = project(camera[0], q)
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[i] = q
