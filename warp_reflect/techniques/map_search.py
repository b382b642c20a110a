"""The search for a reflection point in a reflector map: device functions and the solution of one virtual vertex.

Source: Estalella, Martin, Drettakis, Tost, Devillers, Cazals, "Accurate Interactive Specular Reflections on Curved
Objects" (2005), sections 4.2-4.3 (search) and 6.1 (hidden vertices). What differs:
- the default search is Newton's method on the tangential bisector over its normal part, with the surface derivatives of
  the same four texels; the paper's midpoint search is `search="midpoint"`;
- where the residual is so small that Newton's next one will do, the texels just read tell what is at the end of its step;
- the residual is the angle's tangent, not E = (1 - B.N) / 2, which loses all angles below 3.4e-4 in float32;
- a vertex behind the reflector is recognised by the body's gauge along the eye's line of sight, which is convex for a
  convex body.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.cubemap import project_to_cube
from warp_reflect.layers import CameraView, project
from warp_reflect.reflector_maps import MapSample, ReflectorMapView, least_mask, map_cell, sample_map, slide
from warp_reflect.settings import Settings, Status
from warp_reflect.shapes import max_abs
from warp_reflect.techniques.vertices import SolveFrame, VertexView, edge_reach, virtual_vertex

wp.set_module_options({"enable_backward": False})

# Sines. Of the residual at which a search stops where no tolerance is set: the float32 floor of the residual is
# 4e-8 to 3e-7, and 0.1 h^2 is the map's own error at texel size h. A picture of 1280 pixels lies up to some 1200 pixels times
# the residual from where it would be without: in all but a hundredth of a stage's vertices a hundredth of a pixel at most.
TOLERANCE_MIN = 2.0e-6
TOLERANCE_MAX = 8.0e-6
ACCEPTED = wp.constant(1.0e-3)  # residual above which an answer is MAX_ITERATIONS rather than CONVERGED
NEWTON_EVALUATIONS = 12  # cold starts need 3-6; what is left after 12 takes the coarse seed
MIDPOINT_ITERATIONS = 9  # the paper's best setting (figure 8)
STEP_CAP = wp.constant(0.7)  # of the whitened radius; keeps a Newton step on the visible side
RETRY_SHRINK = wp.constant(0.4)
SHRINK_MIN = wp.constant(1.0e-3)  # a step shortened to this share lowers nothing any more
SHRINK_NEAR = wp.constant(0.1)  # likewise where the residual is ACCEPTED: what is left is the map's own roughness
NORMAL_PART_MIN = wp.constant(1.0e-3)  # of |o + v|; below it the residual's tangent is not trusted
CONVEX_SHARE = wp.constant(0.98)  # of the square that bounds a convex body's mixed curvature: up to here nothing is cut
DET_MIN = wp.constant(1.0e-30)  # of the Hessian in texels; below it there is no step
SPD_SHARE = wp.constant(0.05)  # det J below this share of det H: take the safe step
# Length of o + v where the path over a point is as good as straight. The root's path is no longer: on a convex body it grazes
# as well, and what a picture shows of it is as good as the real point, with or without a second start.
STRAIGHT = wp.constant(0.1)
TWIST_MAX = wp.constant(
    0.01
)  # of a cell's twist (h^2 or so): what the end of a last step may be off, 2e-6 at 128 nodes
COARSE_NODES = wp.constant(7)  # per face edge of the fallback seed
GAUGE_STEPS = wp.constant(10)  # of the bracket that finds the least gauge along a line of sight
GAUGE_INSIDE = wp.constant(1.0e-4)  # gauge margin inside which a point counts as on the surface
MIDPOINT_STEP = wp.constant(0.5)  # first step, in units where the field of a sphere is the angle
MIDPOINT_DELTA = wp.constant(0.5)  # |b_m - b| / |b| steered to; best factor per step of the midpoint rule
GRAZING_COS = wp.constant(0.1)  # cosine of incidence below which a search without a root lies on the silhouette
SEARCH_MIDPOINT = wp.constant(1)
CONVERGED = wp.constant(int(Status.CONVERGED))
HIDDEN = wp.constant(int(Status.HIDDEN))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))
UNREFLECTED = wp.constant(int(Status.UNREFLECTED))


@wp.struct
class SearchResult:
    x: wp.vec3  # cube point
    p: wp.vec3
    n: wp.vec3
    residual: float  # tangent of the angle between bisector and normal
    cos_eye: float
    cos_target: float
    evaluations: int


@wp.func
def is_visible(map: ReflectorMapView, eye: wp.vec3, target: wp.vec3) -> bool:
    """True where the segment from eye to target misses the body and the target lies outside it.

    The gauge along the segment is convex and the sign of its slope is that of N . (target - eye): its least value is
    found by bisection. Most segments are decided by the balls inside and around the whitened body.
    """
    o = wp.cw_mul(eye, map.inv_extent)
    v = wp.cw_mul(target, map.inv_extent)
    d = v - o
    t = wp.clamp(-wp.dot(o, d) / wp.max(wp.dot(d, d), 1.0e-30), 0.0, 1.0)
    nearest = wp.length(o + t * d)
    if nearest > map.outer_radius:
        return True
    if nearest < map.inner_radius:
        return False
    direction = target - eye
    low = float(0.0)
    high = float(1.0)
    for _ in range(GAUGE_STEPS):
        w = o + t * d
        s = sample_map(map, project_to_cube(w))
        if wp.length(w) < (1.0 + GAUGE_INSIDE) * wp.length(wp.cw_mul(s.p, map.inv_extent)):
            return False
        # The body lies behind the plane of its texels: a segment wholly before that misses it.
        plane = wp.cross(s.p_u, s.p_v)
        height = wp.dot(plane, s.p)
        side = wp.where(height < 0.0, -1.0, 1.0)
        level = (1.0 + GAUGE_INSIDE) * side * height
        if side * wp.dot(plane, eye) > level and side * wp.dot(plane, target) > level:
            return True
        if wp.dot(s.n, direction) < 0.0:
            low = t
        else:
            high = t
        # At the target end the slope still falls: the target itself is the nearest point, and it is outside.
        if low >= 1.0 or high <= 0.0:
            return True
        t = 0.5 * (low + high)
    return True


@wp.func
def first_guess(map: ReflectorMapView, eye: wp.vec3, target: wp.vec3) -> wp.vec3:
    """Cube point below the foot of the bisector in whitened space (exact for two points at equal height on a sphere)."""
    o = wp.cw_mul(eye, map.inv_extent)
    v = wp.cw_mul(target, map.inv_extent)
    a = wp.max(wp.length(o) - 1.0, 1.0e-3)
    b = wp.max(wp.length(v) - 1.0, 1.0e-3)
    t = b / (a + b)
    w = t * o + (1.0 - t) * v
    if max_abs(w) < 1.0e-6:
        return project_to_cube(o)
    return project_to_cube(w)


@wp.func
def measure(s: MapSample, x: wp.vec3, eye: wp.vec3, target: wp.vec3) -> SearchResult:
    """The law of reflection at a sample; residual grows beyond any tangent where the normal part is not positive."""
    r = SearchResult()
    r.x = x
    r.p = s.p
    r.n = s.n
    to_eye = eye - s.p
    to_target = target - s.p
    # The reciprocals, here and below, are those of `newton_step`, which the compiler shares.
    o = to_eye * (1.0 / wp.max(wp.length(to_eye), 1.0e-20))
    v = to_target * (1.0 / wp.max(wp.length(to_target), 1.0e-20))
    w = o + v
    r.cos_eye = wp.dot(s.n, o)
    r.cos_target = wp.dot(s.n, v)
    w_n = r.cos_eye + r.cos_target
    w_t = wp.length(w - w_n * s.n)
    if w_n > NORMAL_PART_MIN:
        r.residual = w_t * (1.0 / w_n)
    else:
        r.residual = 1.0e4 - w_n
    return r


@wp.func
def newton_step(s: MapSample, eye: wp.vec3, target: wp.vec3) -> wp.vec3:
    """Displacement on the texels' patch towards the zero of w_T / w_N (w = o + v unnormalised).

    H = T^T [(I - o o^T)/d_O + (I - v v^T)/d_V] T + w_N II is the Hessian of the path length in the map's own coordinates: T
    holds the tangential parts of p_u and p_v, and the second fundamental form II, clamped to a convex body's, comes from the
    derivatives of the same texels. The residual's Jacobian adds the rank-one change of w_N.
    """
    to_eye = eye - s.p
    to_target = target - s.p
    inv_o = 1.0 / wp.max(wp.length(to_eye), 1.0e-20)
    inv_v = 1.0 / wp.max(wp.length(to_target), 1.0e-20)
    o = to_eye * inv_o
    v = to_target * inv_v
    n = s.n
    n_o = wp.dot(n, o)
    n_v = wp.dot(n, v)
    w_n = n_o + n_v
    w_t = (o + v) - w_n * n
    # Tangential parts: of both directions, and of the squares.
    n_1 = wp.dot(n, s.p_u)
    n_2 = wp.dot(n, s.p_v)
    o1 = wp.dot(o, s.p_u) - n_o * n_1
    o2 = wp.dot(o, s.p_v) - n_o * n_2
    v1 = wp.dot(v, s.p_u) - n_v * n_1
    v2 = wp.dot(v, s.p_v) - n_v * n_2
    e = wp.dot(s.p_u, s.p_u) - n_1 * n_1
    f = wp.dot(s.p_u, s.p_v) - n_1 * n_2
    g = wp.dot(s.p_v, s.p_v) - n_2 * n_2
    s11 = wp.max(wp.dot(s.n_u, s.p_u), 0.0)
    s22 = wp.max(wp.dot(s.n_v, s.p_v), 0.0)
    s12 = 0.5 * (wp.dot(s.n_u, s.p_v) + wp.dot(s.n_v, s.p_u))
    if s12 * s12 > CONVEX_SHARE * (s11 * s22):
        bound = wp.sqrt(s11 * s22)
        s12 = wp.clamp(s12, -bound, bound)
    k = wp.max(w_n, 0.0)
    both = inv_o + inv_v
    i_o1 = o1 * inv_o
    i_o2 = o2 * inv_o
    i_v1 = v1 * inv_v
    i_v2 = v2 * inv_v
    h11 = e * both - o1 * i_o1 - v1 * i_v1 + k * s11
    h22 = g * both - o2 * i_o2 - v2 * i_v2 + k * s22
    h12 = f * both - o1 * i_o2 - v1 * i_v2 + k * s12
    g1 = o1 + v1
    g2 = o2 + v2
    det = h11 * h22 - h12 * h12
    m11 = h11
    m12 = h12
    m21 = h12
    m22 = h22
    if w_n > NORMAL_PART_MIN:
        inv_w = 1.0 / w_n
        q1 = (wp.dot(s.n_u, w_t) + n_o * i_o1 + n_v * i_v1) * inv_w
        q2 = (wp.dot(s.n_v, w_t) + n_o * i_o2 + n_v * i_v2) * inv_w
        j11 = h11 + g1 * q1
        j12 = h12 + g1 * q2
        j21 = h12 + g2 * q1
        j22 = h22 + g2 * q2
        det_j = j11 * j22 - j12 * j21
        if det_j > SPD_SHARE * det and det_j > 0.0:
            det = det_j
            m11 = j11
            m12 = j12
            m21 = j21
            m22 = j22
    inv = float(0.0)
    if det > DET_MIN:
        inv = 1.0 / det
    d1 = (m22 * g1 - m12 * g2) * inv
    d2 = (m11 * g2 - m21 * g1) * inv
    return d1 * s.p_u + d2 * s.p_v


@wp.func
def step_on_cube(map: ReflectorMapView, r: SearchResult, step: wp.vec3, shrink: float) -> wp.vec3:
    """The cube point a tangential step leads to, capped so that it stays on its side of the body."""
    whitened = wp.cw_mul(r.p, map.inv_extent)
    move = wp.cw_mul(step, map.inv_extent)
    cap = wp.min(1.0, STEP_CAP * wp.length(whitened) / wp.max(wp.length(move), 1.0e-30))
    # From the cube point, not from the bilinear position, whose own direction is off by h^2.
    return project_to_cube(r.x * max_abs(whitened) + move * (cap * shrink))


@wp.func
def coarse_seed(map: ReflectorMapView, eye: wp.vec3, target: wp.vec3) -> wp.vec3:
    """The best of a coarse set of directions: the fallback of a search that ended far from a root."""
    best = float(1.0e30)
    seed = wp.vec3(1.0, 0.0, 0.0)
    for k in range(6 * COARSE_NODES * COARSE_NODES):
        face = k / (COARSE_NODES * COARSE_NODES)
        u = (2.0 * float(k % COARSE_NODES) + 1.0) / float(COARSE_NODES) - 1.0
        v = (2.0 * float((k / COARSE_NODES) % COARSE_NODES) + 1.0) / float(COARSE_NODES) - 1.0
        sign = 1.0 - 2.0 * float(face % 2)
        x = wp.vec3(sign, u, v)
        if face >= 4:
            x = wp.vec3(u, v, sign)
        elif face >= 2:
            x = wp.vec3(v, sign, u)
        r = measure(sample_map(map, x), x, eye, target)
        if r.residual < best and r.cos_eye > 0.0 and r.cos_target > 0.0:
            best = r.residual
            seed = x
    return seed


@wp.func
def is_straight(r: SearchResult, eye: wp.vec3, target: wp.vec3, straight: float) -> bool:
    """True where eye, point and target lie on a line but for so much, see STRAIGHT."""
    to_eye = eye - r.p
    to_target = target - r.p
    o = to_eye * (1.0 / wp.max(wp.length(to_eye), 1.0e-20))
    v = to_target * (1.0 / wp.max(wp.length(to_target), 1.0e-20))
    w = o + v
    return wp.dot(w, w) < straight * straight


@wp.func
def search_newton(
    map: ReflectorMapView,
    eye: wp.vec3,
    target: wp.vec3,
    seed: wp.vec3,
    evaluations: int,
    tolerance: float,
    straight: float,
) -> SearchResult:
    """Reflection point of a visible target: Newton steps, each shortened until it lowers the residual.

    A search that ends far from a root, and not on a path as straight as `straight`, starts once more from the coarse seed. One
    loop over samples for both starts: everything is inlined, and a second copy of the body would double the compile time.
    """
    best = SearchResult()
    best.residual = 1.0e30
    step = wp.vec3(0.0, 0.0, 0.0)
    x = seed
    shrink = float(1.0)
    used = int(0)
    attempt = int(0)
    while used < 2 * evaluations:
        sample = sample_map(map, x)
        r = measure(sample, x, eye, target)
        used += 1
        better = r.residual < best.residual
        if better:
            best = r
            step = newton_step(sample, eye, target)
            shrink = 1.0
        else:
            shrink = shrink * RETRY_SHRINK
        if best.residual <= tolerance or (best.residual <= ACCEPTED and shrink < SHRINK_NEAR):
            break
        if attempt == 0 and (used >= evaluations or shrink < SHRINK_MIN):
            if best.residual <= ACCEPTED:
                break
            if best.residual > map.accepted and is_straight(best, eye, target, straight):
                break
            attempt = 1
            used = evaluations
            x = coarse_seed(map, eye, target)
            # The coarse seed may be worse than where the first start got stuck, and must replace it all the same.
            best = SearchResult()
            best.residual = 1.0e30
            shrink = 1.0
        elif shrink < SHRINK_MIN:
            break
        else:
            x = step_on_cube(map, best, step, shrink)
            # Newton squares the residual. Where that will do, the last step hardly ever leaves the four texels just read:
            # they tell what is at its end.
            if better and best.residual * best.residual <= tolerance and used < 2 * evaluations:
                cell = map_cell(map, x)
                along_u = cell.a - sample.cell.a
                along_v = cell.b - sample.cell.b
                if cell.texel == sample.cell.texel and wp.abs(along_u * along_v) <= TWIST_MAX:
                    end = measure(slide(sample, along_u, along_v), x, eye, target)
                    if end.residual <= tolerance:
                        best = end
                        break
    best.evaluations = used
    return best


@wp.func
def bisector_field(map: ReflectorMapView, s: MapSample, x: wp.vec3, eye: wp.vec3, target: wp.vec3) -> wp.vec3:
    """Projected bisector b: the push-forward of B - N to the cube face (paper, section 4.2)."""
    w = wp.normalize(eye - s.p) + wp.normalize(target - s.p)
    bisector = wp.normalize(w)
    d = wp.cw_mul(bisector - s.n, map.inv_extent)
    whitened = wp.cw_mul(s.p, map.inv_extent)
    # x lies on face k: x_k = +-1 and (x_k d_k) is the change of the face's distance.
    ax = wp.abs(x[0])
    ay = wp.abs(x[1])
    az = wp.abs(x[2])
    along = float(0.0)
    if ax >= ay and ax >= az:
        along = d[0] * x[0]
    elif ay >= az:
        along = d[1] * x[1]
    else:
        along = d[2] * x[2]
    return (d - along * x) * (wp.length(s.p) / wp.max(max_abs(whitened), 1.0e-20))


@wp.func
def search_midpoint(
    map: ReflectorMapView, eye: wp.vec3, target: wp.vec3, seed: wp.vec3, iterations: int, tolerance: float
) -> SearchResult:
    """The paper's search: midpoint rule on the projected bisector with adaptive step (section 4.3), two samples a step.

    The step is steered so that |b_m - b| / |b| tends to 1/2, where the midpoint rule contracts best, and accepted only
    if the residual falls.
    """
    best = SearchResult()
    best.residual = 1.0e30
    middle = SearchResult()
    b = wp.vec3(0.0, 0.0, 0.0)
    b_m = wp.vec3(0.0, 0.0, 0.0)
    h = float(MIDPOINT_STEP)
    x = seed
    # Samples in turn: the seed, then midpoint and full step of each iteration (one loop: see search_newton).
    used = int(0)
    while used <= 2 * iterations:
        sample = sample_map(map, x)
        r = measure(sample, x, eye, target)
        field = bisector_field(map, sample, x, eye, target)
        used += 1
        if used == 1:
            best = r
            b = field
        elif used % 2 == 0:
            middle = r
            b_m = field
        else:
            delta = wp.length(b_m - b) / wp.max(wp.length(b), 1.0e-20)
            if r.residual < best.residual:
                best = r
                b = field
                h = h * wp.clamp(MIDPOINT_DELTA / wp.max(delta, 1.0e-6), 0.5, 1.5)
            elif middle.residual < best.residual:
                best = middle
                b = b_m
            else:
                h = 0.5 * h
        if best.residual <= tolerance:
            break
        if used % 2 == 1:
            h = wp.min(h, 1.0 / wp.max(wp.length(b), 1.0e-20))
            x = project_to_cube(best.x + 0.5 * h * b)
        else:
            x = project_to_cube(best.x + h * b_m)
    best.evaluations = used
    return best


@wp.struct
class SearchSettings:
    method: int  # SEARCH_MIDPOINT, else Newton
    iterations: int
    tolerance: float
    accepted: float  # residual up to which an answer has a picture, where the map asks for less


@wp.func
def search(
    map: ReflectorMapView, eye: wp.vec3, target: wp.vec3, seed: wp.vec3, settings: SearchSettings
) -> SearchResult:
    """Reflection point of a visible target by the chosen search."""
    if settings.method == SEARCH_MIDPOINT:
        return search_midpoint(map, eye, target, seed, settings.iterations, settings.tolerance)
    return search_newton(map, eye, target, seed, settings.iterations, settings.tolerance, STRAIGHT)


@wp.func
def solve_vertex(
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    settings: SearchSettings,
    target: wp.vec3,
    warm_seed: wp.vec3,
    i: int,
    out_vertex: VertexView,
):
    """Full solution of one vertex into entry i."""
    out_vertex.seed[i] = wp.vec3(0.0, 0.0, 0.0)
    out_vertex.screen[i] = wp.vec4(0.0, 0.0, -1.0, 0.0)
    if not is_visible(map, frame.eye, target):
        out_vertex.status[i] = wp.uint8(HIDDEN)
        return
    seed = first_guess(map, frame.eye, target)
    if max_abs(warm_seed) > 0.0:
        seed = project_to_cube(warm_seed)
    r = search(map, frame.eye, target, seed, settings)
    out_vertex.seed[i] = r.x
    out_vertex.residual[i] = r.residual
    status = CONVERGED
    if r.residual > ACCEPTED:
        # On the part that closes an open reflector nothing is seen, and its border is a crease between two texels: any
        # picture near the right one will do.
        closing = least_mask(map, r.x) < 0.5
        if r.residual > map.accepted:
            # So close behind the silhouette that the bilinear body and the gauge disagree: as good as hidden, and the
            # boundary's bisection ends at the vertex itself, where virtual and real point coincide.
            grazing = wp.min(r.cos_eye, r.cos_target) < GRAZING_COS
            status = wp.where(grazing, HIDDEN, wp.where(closing, UNREFLECTED, MAX_ITERATIONS))
            if status != MAX_ITERATIONS or r.residual > settings.accepted:
                out_vertex.status[i] = wp.uint8(status)
                return
        # A crease sharper than the texels: drawn near its place, refinement walks from there, but nothing beside it is
        # trusted to be sky.
        status = wp.where(closing, CONVERGED, MAX_ITERATIONS)
    out_vertex.status[i] = wp.uint8(status)
    out_vertex.reach[i] = edge_reach(frame, r.p, r.n, target, map.least_curvature)
    q = virtual_vertex(frame, r.p, r.n, target)
    out_vertex.screen[i] = project(camera[0], q)
    if out_vertex.position.shape[0] > 0:
        out_vertex.position[i] = q


def default_tolerance(resolution: int) -> float:
    """0.1 h^2 for texel size h, between the float32 floor and what a picture needs."""
    h = 2.0 / (resolution - 1)
    return min(max(0.1 * h * h, TOLERANCE_MIN), TOLERANCE_MAX)


def search_settings(settings: Settings, resolution: int) -> SearchSettings:
    """The device form of the search's settings, defaults filled in."""
    result = SearchSettings()
    midpoint = settings.search == "midpoint"
    result.method = int(SEARCH_MIDPOINT) if midpoint else 0
    result.iterations = settings.iterations or (MIDPOINT_ITERATIONS if midpoint else NEWTON_EVALUATIONS)
    result.tolerance = settings.tolerance or default_tolerance(resolution)
    # Whoever bounds the midpoint search and refines nothing asks for the picture of so many steps, as the paper shows it.
    result.accepted = 1.0 if midpoint and settings.iterations and settings.refine == "off" else 0.0
    return result
