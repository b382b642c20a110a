"""How a ray goes on until it has met what it can see: what `bvh.py`'s kernels, and others', do with one.

Compiled finite-only where kernels are (`launch.FINITE_FLAGS`): everything that reaches these functions is finite by
construction (points are checked when a stage is read, directions come normalised from `surface.py`), and NaN must not be
tested for here.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.ray_query import first_met, loses_rays, triangle_in
from warp_reflect.scene import SceneView
from warp_reflect.settings import Status
from warp_reflect.shapes import clamp_weights, facet_normal, intersect_triangle, max_abs

wp.set_module_options({"enable_backward": False})

FLOAT_EPS = wp.constant(1.1920929e-7)  # one ulp of 1 in float32
# A point made of barycentric weights is off its facet by at most about 4 roundings of its coordinates, the
# traversal adds about 4 of its own; twice that.
OFFSET_ULPS = wp.constant(16.0)
# A convex body is left after two crossings; shared edges and the start may count twice.
MAX_STEPS = wp.constant(8)
# On a CPU: the box test of wp.mesh_query_ray rounds to nearest, not outwards, and loses up to 1.5e-2 of the rays aimed
# exactly at a vertex. Moved by this many ulp a ray has left the corner's box planes (2.5e-6 lost are left, at
# any offset); 1e-6 of the distance is no more than the rounding of a hit.
RETRY_ULPS = wp.constant(8.0)
# Share of the largest component below which one is worth nothing, and 1 / component overflows the box test.
FLUSH_DIRECTION = wp.constant(1.0e-12)
FAR = wp.constant(3.0e38)
# Own facets that a ray leaves through from behind are at most this many of their longest edges away: the
# sagitta of a tessellated surface is shorter than its edge.
OWN_FACET_REACH = wp.constant(2.0)

UNASKED = wp.constant(-2)  # `bvh_vector.UNASKED`
HIT = wp.constant(int(Status.CONVERGED))
SKY = wp.constant(int(Status.SKY))
STEP_LIMIT = wp.constant(int(Status.STEP_LIMIT))


@wp.struct
class RayHit:
    """The first surface along a ray."""

    triangle: int  # -1: none
    t: float  # in lengths of the direction
    u: float  # weights of the triangle's second and third corner
    v: float
    status: int  # CONVERGED, SKY or STEP_LIMIT


@wp.struct
class Met:
    """What a ray's first query finds: of Warp, or of a packet (`bvh_vector.py`)."""

    known: int  # 0: not asked yet
    triangle: int  # -1: none
    t: float  # in lengths of the direction
    first: float  # weights of the triangle's first and second corner
    second: float


@wp.struct
class OwnBody:
    """The mirror that a ray starts on: a range of triangles."""

    first_triangle: int
    triangle_count: int  # 0: no body
    convex: int  # a ray that leaves it cannot meet it again
    alone: int  # 1: the structure holds these triangles and no others


@wp.func
def ray_offset(p: wp.vec3) -> float:
    """How far off its surface a float32 point may lie, and so how far from it a ray starts, in units of p.

    From the summed magnitudes of its coordinates: a fixed distance is wrong at some scale.
    """
    return OFFSET_ULPS * FLOAT_EPS * (wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]))


@wp.func
def flush_direction(direction: wp.vec3) -> wp.vec3:
    """The direction with negligible components exactly zero (which the traversal handles apart)."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    least = FLUSH_DIRECTION * max_abs(direction)
    if wp.abs(x) < least:
        x = float(0.0)
    if wp.abs(y) < least:
        y = float(0.0)
    if wp.abs(z) < least:
        z = float(0.0)
    return wp.vec3(x, y, z)


@wp.func
def moved_direction(direction: wp.vec3) -> wp.vec3:
    """The direction turned by a few ulp, unevenly, so that it leaves edges and diagonals."""
    step = RETRY_ULPS * FLOAT_EPS * max_abs(direction)
    return direction + wp.vec3(step, -0.625 * step, 0.375 * step)


@wp.func
def scene_facet_normal(scene: SceneView, triangle: int) -> wp.vec3:
    """Unit normal of a triangle of the scene by its winding."""
    tri = scene.triangles[triangle]
    return facet_normal(scene.points[tri[0]], scene.points[tri[1]], scene.points[tri[2]])


@wp.func
def leaves_from_behind(
    scene: SceneView, triangle: int, t: float, direction: wp.vec3, normal: wp.vec3, facet: int
) -> bool:
    """Whether a hit on the mirror's own body is no obstacle: the ray comes out through a facet from its back.

    A point polished onto a concave surface lies behind its facets, and an interpolated normal can send a
    grazing ray under its own facet. Both then cross the body from behind: the first near the start, the
    second anywhere. The back is told by the winding and by the side that the eye sees of the start's facet.
    """
    own = scene_facet_normal(scene, facet)
    incident = direction - 2.0 * wp.dot(direction, normal) * normal
    side = wp.where(wp.dot(own, incident) > 0.0, -1.0, 1.0)
    if side * wp.dot(scene_facet_normal(scene, triangle), direction) <= 0.0:
        return False
    if side * wp.dot(own, direction) < 0.0:
        return True
    tri = scene.triangles[triangle]
    a = scene.points[tri[0]]
    b = scene.points[tri[1]]
    c = scene.points[tri[2]]
    return t <= OWN_FACET_REACH * wp.max(wp.max(max_abs(b - a), max_abs(c - b)), max_abs(a - c))


@wp.func
def exact_hit(
    scene: SceneView, triangle: int, origin: wp.vec3, direction: wp.vec3, t: float, first: float, second: float
) -> RayHit:
    """What a ray meets at the triangle that a traversal found: by `intersect_triangle`, else as the traversal has it.

    Args:
        scene: Holds the triangle.
        triangle: It.
        origin, direction: Of the ray, before it was moved for the traversal.
        t: Of the traversal.
        first, second: The traversal's weights, which it names for the first and second corner.
    """
    tri = scene.triangles[triangle]
    exact = intersect_triangle(origin, direction, scene.points[tri[0]], scene.points[tri[1]], scene.points[tri[2]])
    result = RayHit()
    result.triangle = triangle
    result.status = HIT
    result.t = t
    weights = clamp_weights(second, 1.0 - first - second)
    if exact.det != 0.0 and wp.min(wp.min(exact.u, exact.v), exact.w) > -0.01:
        result.t = wp.max(exact.t, 0.0)
        weights = clamp_weights(exact.u, exact.v)
    result.u = weights[0]
    result.v = weights[1]
    return result


@wp.func
def ask(mesh_id: wp.uint64, origin: wp.vec3, direction: wp.vec3) -> Met:
    """What the structure answers."""
    met = Met()
    answer = first_met(mesh_id, origin, direction, FAR)
    met.triangle = triangle_in(answer)
    met.t = answer[0]
    met.first = answer[1]
    met.second = answer[2]
    return met


@wp.func
def answered(known: int, triangle: int, u: float, v: float, t: float) -> Met:
    """What `bvh_vector.first_met` has left in a ray's outputs, if it was asked."""
    met = Met()
    met.known = wp.where(triangle == UNASKED, 0, known)
    met.triangle = triangle
    met.t = t
    met.first = u
    met.second = v
    return met


@wp.func
def trace_ray_from(
    mesh_id: wp.uint64,
    scene: SceneView,
    # Ray:
    origin: wp.vec3,
    direction: wp.vec3,
    normal: wp.vec3,
    # The mirror it starts on:
    facet: int,
    body: OwnBody,
    # Settings:
    retry: int,
    t_first: float,
    known: Met,
) -> RayHit:
    """First surface along a ray that starts on a surface or in free space.

    Args:
        mesh_id: `Tracer.id`.
        scene: The same scene's arrays.
        origin: Scene frame.
        direction: Unit length.
        normal: Surface normal at the origin on the ray's side; zero for a ray from free space, which starts
            at its origin exactly.
        facet: Triangle that the ray starts on, never hit; -1 none, and then `body` is empty too.
        body: The mirror around it. A convex one is stepped over, of others what the ray leaves from behind.
        retry: 1: a ray that finds nothing is asked once more, turned by a few ulp, where that may be a rounding's doing.
        t_first: What is nearer is not met.
        known: What is met first where t_first is 0, if that was asked before.

    Returns:
        The hit; t, u and v are those of `intersect_triangle` from the origin itself, clamped to the triangle.
    """
    result = RayHit()
    result.triangle = -1
    result.status = SKY
    d = flush_direction(direction)
    offset = ray_offset(origin)
    start = origin + offset * normal
    if wp.dot(normal, normal) == 0.0:
        offset = float(0.0)

    t0 = float(t_first)
    asked = int(1 - loses_rays())
    step = int(0)
    # A range over the constant would be unrolled, eight traversals long.
    while step < MAX_STEPS:
        step += 1
        met = known
        if known.known == 0 or step > 1:
            met = ask(mesh_id, start + t0 * d, d)
        if met.triangle < 0:
            if retry == 0 or asked != 0:
                return result
            asked = int(1)
            d = moved_direction(d)
        else:
            triangle = met.triangle
            if body.alone != 0:
                triangle += body.first_triangle
            t = t0 + met.t
            step_over = triangle == facet
            if triangle >= body.first_triangle and triangle < body.first_triangle + body.triangle_count:
                if body.convex != 0:
                    step_over = bool(True)
                elif not step_over:
                    step_over = leaves_from_behind(scene, triangle, t, d, normal, facet)
            if not step_over:
                return exact_hit(scene, triangle, origin, direction, t, met.first, met.second)
            t0 = t + wp.max(ray_offset(start + t * d), offset)
    result.status = STEP_LIMIT
    return result


@wp.func
def trace_ray(
    mesh_id: wp.uint64,
    scene: SceneView,
    # Ray:
    origin: wp.vec3,
    direction: wp.vec3,
    normal: wp.vec3,
    # The mirror it starts on:
    facet: int,
    body: OwnBody,
    # Settings:
    retry: int,
    t_first: float,
) -> RayHit:
    """`trace_ray_from` of a ray of which nothing is known."""
    return trace_ray_from(mesh_id, scene, origin, direction, normal, facet, body, retry, t_first, Met())


@wp.func
def trace_onward(
    mesh_id: wp.uint64,
    scene: SceneView,
    # Ray:
    origin: wp.vec3,
    direction: wp.vec3,
    normal: wp.vec3,
    facet: int,
    inside: int,
    t_first: float,
    known: Met,
) -> RayHit:
    """First surface along a ray that has gone through a surface; like `trace_ray_from` otherwise.

    Args:
        mesh_id: `Tracer.id`.
        scene: The same scene's arrays.
        origin: On the surface, scene frame.
        direction: Unit length.
        normal: Of the facet, on the ray's side.
        facet: Triangle that the ray starts on, never hit.
        inside: 1: the ray is in the body that the facet belongs to. It does not enter that a second time, nor does a ray
            outside leave it a second time close by: a point polished onto an analytic surface is off its facets.
        t_first: What is nearer is not met.
        known: What is met first where t_first is 0, if that was asked before.
    """
    result = RayHit()
    result.triangle = -1
    result.status = SKY
    d = flush_direction(direction)
    offset = ray_offset(origin)
    start = origin + offset * normal
    part = scene.patches[scene.triangle_patch[facet]].part
    t0 = float(t_first)
    asked = int(1 - loses_rays())
    step = int(0)
    while step < MAX_STEPS:
        step += 1
        met = known
        if known.known == 0 or step > 1:
            met = ask(mesh_id, start + t0 * d, d)
        if met.triangle < 0:
            if asked != 0:
                return result
            asked = int(1)
            d = moved_direction(d)
        else:
            triangle = met.triangle
            t = t0 + met.t
            tri = scene.triangles[triangle]
            a = scene.points[tri[0]]
            b = scene.points[tri[1]]
            c = scene.points[tri[2]]
            step_over = triangle == facet
            if not step_over and scene.patches[scene.triangle_patch[triangle]].part == part:
                leaves = wp.dot(facet_normal(a, b, c), d) > 0.0
                longest = wp.max(wp.max(max_abs(b - a), max_abs(c - b)), max_abs(a - c))
                if inside != 0:
                    step_over = not leaves and t <= OWN_FACET_REACH * longest
                else:
                    step_over = leaves and t <= OWN_FACET_REACH * longest
            if not step_over:
                return exact_hit(scene, triangle, origin, direction, t, met.first, met.second)
            t0 = t + wp.max(ray_offset(start + t * d), offset)
    result.status = STEP_LIMIT
    return result
