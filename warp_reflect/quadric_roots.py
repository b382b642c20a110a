"""Every reflection point on a quadric, also where several compete: device math in float64.

At a reflection point R the normal line meets the segment from eye O to target V, d = O - V, at a point
V + t d with 0 < t < 1:

    R + mu n(R) = V + t d,   mu > 0 on the reflecting side,   so   R = (I + mu A)^-1 (V + t d - mu b e_z).

R is linear in t. Two conditions remain, both quadratic in t: R lies on the surface,
    E1:  q(R) = 0,
and the segment is cut as the bisector cuts it (B: the polar form of q, n(R).(X - R) for R on the surface),
    E2:  t B(R, O) = (1 - t) B(R, V).
Their resultant F(mu) is a polynomial (degree 10 for three different principal values, 8 for a surface of
revolution, 4 for a sphere) once cleared of the poles mu = -1/A_i. Its real roots are found by a scan that
is graded towards the poles; sign changes are bisected and near-touches are minimised, and every candidate
is then polished by Newton's method on the surface itself, so that nothing is lost to the elimination.
"""

from __future__ import annotations

import warp as wp

from warp_reflect.optics import tangent_basis
from warp_reflect.quadrics import MAX_ROOTS, quadric_curve, quadric_half_gradient, quadric_value

wp.set_module_options({"enable_backward": False})

SCAN_NODES = 96  # per interval between poles; 10 roots at most are spread over the intervals
LAST_NODE = wp.float64(SCAN_NODES - 0.25)  # the end itself is a pole or infinity
SCAN_STEP = wp.float64(1.0 / SCAN_NODES)
CELL_NODES = 8  # per cell of the scan that is looked at closely
CELL_STEP = wp.float64(1.0 / CELL_NODES)
ROOT_STEPS = wp.constant(60)
ROOT_WIDTH = wp.float64(1.0e-14)  # of the scan's parameter
DIP_STEPS = wp.constant(40)  # golden section from a cell to 1e-8 of it, where a minimum is flat in float64
DIP_DOUBT = wp.constant(12)  # steps after which a dip that is still high is taken for harmless
TOUCH_SHARE = wp.float64(0.1)  # of the values beside a dip; one that touches zero falls far below
GOLDEN = wp.float64(0.6180339887498949)
T_SLACK = wp.float64(1.0e-3)  # starts this far outside the segment may still end on a root within
POLISH_STEPS = wp.constant(40)
ON_SURFACE = wp.float64(1.0e-7)  # of the size: corrections below it leave less than rounding
SAME_ROOT = wp.float64(1.0e-7)  # of the size: closer points are one root found twice
SPLIT = wp.float64(1.0e-6)  # of the size: how far a symmetric configuration is moved before the scan
NULL_DIRECTION = wp.float64(1.0e-8)  # eigenvalues of the Hessian below this share are no direction to step along

FLAG_RING = wp.constant(16)  # a whole ring (or sphere) of roots

Roots = wp.types.matrix(shape=(MAX_ROOTS, 5), dtype=wp.float64)
"""Rows: x, y, z, path length, Morse index + flags; sorted by path length."""


@wp.struct
class PolishedRoot:
    """A reflection point and what decides about it."""

    point: wp.vec3d
    length: wp.float64
    index: int  # Morse index: negative eigenvalues of the path length's Hessian
    flat: wp.float64  # smallest eigenvalue over the size of its terms and the cosine; 0 on a caustic or a ring
    valid: int


@wp.func
def pencil_resultant(
    mu: wp.float64,
    o: wp.vec3d,
    v: wp.vec3d,
    d: wp.vec3d,
    a: wp.vec3d,
    b: wp.float64,
    c: wp.float64,
    equal: int,
):
    """F(mu), cleared of its poles, and the coefficients of E1 and E2: a t^2 + b t + c."""
    one = wp.float64(1.0)
    two = wp.float64(2.0)
    w0 = one + mu * a[0]
    w1 = one + mu * a[1]
    w2 = one + mu * a[2]
    e = wp.vec3d(d[0] / w0, d[1] / w1, d[2] / w2)
    p = wp.vec3d(v[0] / w0, v[1] / w1, (v[2] - mu * b) / w2)
    a1 = quadric_curve(e, e, a)
    b1 = two * (quadric_curve(e, p, a) + b * e[2])
    c1 = quadric_value(p, a, b, c)
    to_o0 = quadric_curve(p, o, a) + b * (p[2] + o[2]) + c
    to_o1 = quadric_curve(e, o, a) + b * e[2]
    to_v0 = quadric_curve(p, v, a) + b * (p[2] + v[2]) + c
    to_v1 = quadric_curve(e, v, a) + b * e[2]
    a2 = to_o1 + to_v1
    b2 = to_o0 + to_v0 - to_v1
    c2 = -to_v0
    u = a1 * c2 - a2 * c1
    f = u * u - (a1 * b2 - a2 * b1) * (b1 * c2 - b2 * c1)
    # A single principal value leaves poles of order 4, a double or triple one of order 6; w = 1 where a = 0.
    clear = w0 * w0
    if equal == 1:
        clear = clear * w1 * w1
    else:
        clear = clear * w0
    if equal < 3:
        clear = clear * w2 * w2
    return f * clear * clear, wp.vec3d(a1, b1, c1), wp.vec3d(a2, b2, c2)


@wp.func
def scan_node(x: wp.float64, low: wp.float64, high: wp.float64):
    """Mu at parameter x in (0, 1) of the interval [low, high], or [low, infinity) where high < low."""
    one = wp.float64(1.0)
    y = one - x
    # Nodes approach the ends like x^4: down to 1e-8 of the interval.
    p = x * x
    p = p * p
    q = y * y
    q = q * q
    if high < low:
        return low + low * p / q
    if x < wp.float64(0.5):
        return low + (high - low) * (p / (p + q))
    return high - (high - low) * (q / (p + q))


@wp.func
def polish_root(start: wp.vec3d, o: wp.vec3d, v: wp.vec3d, a: wp.vec3d, b: wp.float64, c: wp.float64):
    """Newton's method on the stationary path length from a point near the surface; signed curvature."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    root = PolishedRoot()
    p = start
    error = wp.float64(4.0)
    settled = bool(False)
    noise = zero
    c_o = zero
    c_v = zero
    for _k in range(POLISH_STEPS):
        n = quadric_half_gradient(p, a, b)
        nn = wp.dot(n, n)
        if not (nn > zero):
            return root
        # What is left of the distance to the surface after this correction is its square.
        lift = half * quadric_value(p, a, b, c) / nn
        p = p - lift * n
        height = wp.abs(lift) * wp.sqrt(nn)
        n = quadric_half_gradient(p, a, b)
        n_length = wp.length(n)
        to_o = o - p
        to_v = v - p
        l_o = wp.length(to_o)
        l_v = wp.length(to_v)
        if not (n_length > zero) or not (l_o > zero) or not (l_v > zero):
            return root
        n = n / n_length
        u_o = to_o / l_o
        u_v = to_v / l_v
        t1, t2 = tangent_basis(n)
        o1 = wp.dot(u_o, t1)
        o2 = wp.dot(u_o, t2)
        v1 = wp.dot(u_v, t1)
        v2 = wp.dot(u_v, t2)
        c_o = wp.dot(u_o, n)
        c_v = wp.dot(u_v, n)
        w_n = c_o + c_v
        g1 = o1 + v1
        g2 = o2 + v2
        i_o = one / l_o
        i_v = one / l_v
        bend = w_n / n_length
        s11 = bend * quadric_curve(t1, t1, a)
        s12 = bend * quadric_curve(t1, t2, a)
        s22 = bend * quadric_curve(t2, t2, a)
        h11 = (o2 * o2 + c_o * c_o) * i_o + (v2 * v2 + c_v * c_v) * i_v + s11
        h22 = (o1 * o1 + c_o * c_o) * i_o + (v1 * v1 + c_v * c_v) * i_v + s22
        h12 = s12 - o1 * o2 * i_o - v1 * v2 * i_v
        # Eigenvalues, so that a null direction (a ring of roots) can be left out of the step.
        mean = half * (h11 + h22)
        diff = half * (h11 - h22)
        spread = wp.sqrt(diff * diff + h12 * h12)
        e_low = mean - spread
        e_high = mean + spread
        size = i_o + i_v + wp.abs(s11) + wp.abs(s12) + wp.abs(s22)
        x1 = one
        x2 = zero
        if spread > zero:
            # Eigenvector of e_high.
            if diff > zero:
                x1 = diff + spread
                x2 = h12
            else:
                x1 = h12
                x2 = spread - diff
            norm = wp.sqrt(x1 * x1 + x2 * x2)
            x1 = x1 / norm
            x2 = x2 / norm
        along_high = g1 * x1 + g2 * x2
        along_low = g2 * x1 - g1 * x2
        if wp.abs(e_high) > NULL_DIRECTION * size:
            along_high = along_high / e_high
        else:
            along_high = zero
        if wp.abs(e_low) > NULL_DIRECTION * size:
            along_low = along_low / e_low
        else:
            along_low = zero
        d1 = along_high * x1 - along_low * x2
        d2 = along_high * x2 + along_low * x1
        error = wp.sqrt(g1 * g1 + g2 * g2)
        noise = wp.float64(1.0e-15) * (one + size * (one + wp.length(p)))
        root.index = int(0)
        if e_low < zero:
            root.index = root.index + 1
        if e_high < zero:
            root.index = root.index + 1
        root.flat = wp.min(wp.abs(e_low), wp.abs(e_high)) / (size * wp.max(wp.abs(c_o), wp.float64(1.0e-12)))
        root.point = p
        root.length = l_o + l_v
        long = wp.sqrt(d1 * d1 + d2 * d2)
        settled = height <= ON_SURFACE * (one + wp.length(p))
        if settled and (error <= noise or long <= wp.float64(4.0e-16) * (one + wp.length(p))):
            break
        reach = wp.min(wp.float64(0.3) * (one + wp.length(p)), wp.max(l_o, l_v))
        if long > reach:
            d1 = d1 * reach / long
            d2 = d2 * reach / long
        step = d1 * t1 + d2 * t2
        # Back to the surface along the normal: the smaller root of q(p + step - s n) = 0.
        moved = p + step
        q = quadric_value(moved, a, b, c)
        slope = n_length + quadric_curve(n, step, a)
        curve = quadric_curve(n, n, a)
        disc = slope * slope - curve * q
        if disc >= zero and slope > zero:
            p = moved - (q / (slope + wp.sqrt(disc))) * n
        else:
            p = p + half * step
    if settled and error <= wp.float64(1.0e4) * noise and c_o > zero and c_v > zero:
        root.valid = int(1)
    return root


@wp.func
def add_root(found: Roots, count: int, root: PolishedRoot, symmetric: int):
    """Insert a valid root, in order of path length, unless it is there already."""
    if root.valid == 0:
        return found, count
    flags = root.index
    if symmetric != 0 and root.flat < wp.float64(1.0e-6):
        flags = flags | FLAG_RING
    reach = SAME_ROOT * (wp.float64(1.0) + wp.length(root.point))
    for k in range(count):
        q = wp.vec3d(found[k, 0], found[k, 1], found[k, 2])
        if wp.length(q - root.point) <= reach:
            return found, count
        if flags >= FLAG_RING and int(found[k, 4]) >= FLAG_RING:
            # Two members of one ring have one path length; the first found stands for it.
            if wp.abs(found[k, 3] - root.length) <= reach:
                return found, count
    if count >= wp.static(MAX_ROOTS):
        return found, count
    slot = int(count)
    for k in range(count):
        j = count - 1 - k
        if found[j, 3] > root.length:
            for i in range(5):
                found[j + 1, i] = found[j, i]
            slot = j
    found[slot, 0] = root.point[0]
    found[slot, 1] = root.point[1]
    found[slot, 2] = root.point[2]
    found[slot, 3] = root.length
    found[slot, 4] = wp.float64(flags)
    return found, count + 1


@wp.struct
class Pencil:
    """One pair of eye and target, and the stretch of the scan that is being looked at."""

    o: wp.vec3d  # eye and target as the scan sees them, see `off_symmetry`
    v: wp.vec3d
    d: wp.vec3d  # o - v
    eye: wp.vec3d  # their true positions
    target: wp.vec3d
    a: wp.vec3d
    b: wp.float64
    c: wp.float64
    equal: int
    sheet: int
    symmetric: int
    low: wp.float64  # the interval of mu between two poles; endless where high < low
    high: wp.float64


@wp.func
def resultant_at(pencil: Pencil, x: wp.float64):
    """F at parameter x of the interval."""
    mu = scan_node(x, pencil.low, pencil.high)
    f, _e1, _e2 = pencil_resultant(mu, pencil.o, pencil.v, pencil.d, pencil.a, pencil.b, pencil.c, pencil.equal)
    return f


@wp.func
def add_candidates(found: Roots, count: int, pencil: Pencil, x: wp.float64):
    """Polish the points of the pencil at x that fulfil E1 or E2; keep what becomes a new root."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    mu = scan_node(x, pencil.low, pencil.high)
    _f, e1, e2 = pencil_resultant(mu, pencil.o, pencil.v, pencil.d, pencil.a, pencil.b, pencil.c, pencil.equal)
    # E1 alone is ill-placed where the pencil's line touches the surface or eye and target meet, E2 alone where eye
    # and target are mirror images: both give starts, and what is no root falls out.
    for j in range(4):
        e = e1
        if j > 1:
            e = e2
        hb = wp.float64(0.5) * e[1]
        # A pair that touches may have become complex by rounding; its real part still starts Newton.
        disc = wp.sqrt(wp.max(hb * hb - e[0] * e[2], zero))
        k = -hb - wp.where(hb < zero, -disc, disc)
        t = -one
        if j % 2 == 0:
            if e[0] != zero:
                t = k / e[0]
        elif k != zero:
            t = e[2] / k
        if t > -T_SLACK and t < one + T_SLACK:
            w = pencil.v + t * pencil.d
            start = wp.vec3d(
                w[0] / (one + mu * pencil.a[0]),
                w[1] / (one + mu * pencil.a[1]),
                (w[2] - mu * pencil.b) / (one + mu * pencil.a[2]),
            )
            root = polish_root(start, pencil.eye, pencil.target, pencil.a, pencil.b, pencil.c)
            if pencil.sheet != 0 and root.point[2] * wp.float64(pencil.sheet) <= zero:
                root.valid = int(0)
            found, count = add_root(found, count, root, pencil.symmetric)
    return found, count


@wp.func
def bracketed_root(pencil: Pencil, xa: wp.float64, xb: wp.float64, fa: wp.float64, fb: wp.float64):
    """The root of F between xa and xb (fa, fb of opposite sign): Illinois, every third step a bisection."""
    zero = wp.float64(0.0)
    half = wp.float64(0.5)
    a = xa
    b = xb
    ga = fa
    gb = fb
    x = half * (a + b)
    for k in range(ROOT_STEPS):
        x = half * (a + b)
        if k % 3 != 2:
            x = b - gb * ((b - a) / (gb - ga))
        f = resultant_at(pencil, x)
        if f == zero or wp.abs(b - a) < ROOT_WIDTH:
            break
        if (f > zero) == (gb > zero):
            ga = ga * half
        else:
            a = b
            ga = gb
        b = x
        gb = f
    return x


@wp.func
def lowest_in_dip(pencil: Pencil, xa: wp.float64, xb: wp.float64, sign: wp.float64):
    """Where sign * F is smallest between xa and xb, by golden section; ends early where it crosses zero."""
    a = xa
    b = xb
    x = b - GOLDEN * (b - a)
    y = a + GOLDEN * (b - a)
    fx = sign * resultant_at(pencil, x)
    fy = sign * resultant_at(pencil, y)
    start = wp.max(fx, fy)
    for k in range(DIP_STEPS):
        if fx < wp.float64(0.0) or fy < wp.float64(0.0):
            break
        if k == DIP_DOUBT and wp.min(fx, fy) > TOUCH_SHARE * start:
            break
        if fx < fy:
            b = y
            y = x
            fy = fx
            x = b - GOLDEN * (b - a)
            fx = sign * resultant_at(pencil, x)
        else:
            a = x
            x = y
            fx = fy
            y = a + GOLDEN * (b - a)
            fy = sign * resultant_at(pencil, y)
    if fx < fy:
        return x, fx
    return y, fy


@wp.func
def search_cell(found: Roots, count: int, pencil: Pencil, xa: wp.float64, xb: wp.float64):
    """Look closely at one cell of the scan: sign changes, and dips that may hide two roots."""
    zero = wp.float64(0.0)
    step = CELL_STEP * (xb - xa)
    # One node beyond either end, so that a dip at an end is seen.
    x0 = xa - step
    x1 = xa
    f0 = resultant_at(pencil, x0)
    f1 = resultant_at(pencil, x1)
    for k in range(1, wp.static(CELL_NODES + 2)):
        x2 = xa + step * wp.float64(k)
        f2 = resultant_at(pencil, x2)
        if (f1 > zero) != (f2 > zero):
            if k <= CELL_NODES:
                x = bracketed_root(pencil, x1, x2, f1, f2)
                found, count = add_candidates(found, count, pencil, x)
        elif (f0 > zero) == (f1 > zero) and wp.abs(f1) <= wp.abs(f0) and wp.abs(f1) <= wp.abs(f2):
            sign = wp.where(f1 > zero, wp.float64(1.0), wp.float64(-1.0))
            x, f = lowest_in_dip(pencil, x0, x2, sign)
            if f < zero:
                x_left = bracketed_root(pencil, x0, x, f0, sign * f)
                found, count = add_candidates(found, count, pencil, x_left)
                x = bracketed_root(pencil, x2, x, f2, sign * f)
            if f < TOUCH_SHARE * wp.min(wp.abs(f0), wp.abs(f2)):
                found, count = add_candidates(found, count, pencil, x)
        x0 = x1
        f0 = f1
        x1 = x2
        f1 = f2
    return found, count


@wp.func
def on_one_axis(o: wp.vec3d, v: wp.vec3d, equal: int):
    """1 if eye and target lie on one axis of revolution: roots off it come in rings."""
    tiny = wp.float64(1.0e-9)
    if equal == 3:
        if wp.length(wp.cross(o, v)) <= tiny * (wp.length(o) * wp.length(v) + tiny):
            return 1
    if equal == 2:
        r = wp.sqrt(o[0] * o[0] + o[1] * o[1]) + wp.sqrt(v[0] * v[0] + v[1] * v[1])
        if r <= tiny * (wp.float64(1.0) + wp.length(o) + wp.length(v)):
            return 1
    return 0


@wp.func
def off_symmetry(o: wp.vec3d, v: wp.vec3d, a: wp.vec3d, equal: int):
    """Eye and target for the scan, moved off the planes of symmetry that would hide pairs of roots in a pole.

    With both in the plane x = 0, say, every R with x != 0 has mu = -1/a_x exactly; a shift of 1e-7 moves
    those roots beside the pole. The polish uses the true positions.
    """
    zero = wp.float64(0.0)
    size = SPLIT * wp.max(wp.float64(1.0), wp.min(wp.length(o), wp.length(v)))
    so = o
    sv = v
    if equal == 1:
        if a[0] < zero and wp.abs(o[0]) + wp.abs(v[0]) < size:
            so = so + wp.vec3d(size, zero, zero)
            sv = sv + wp.vec3d(GOLDEN * size, zero, zero)
        if a[1] < zero and wp.abs(o[1]) + wp.abs(v[1]) < size:
            so = so + wp.vec3d(zero, size, zero)
            sv = sv + wp.vec3d(zero, GOLDEN * size, zero)
    if equal == 2:
        area = wp.abs(o[0] * v[1] - o[1] * v[0])
        r_o = wp.sqrt(o[0] * o[0] + o[1] * o[1])
        r_v = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        if a[0] < zero:
            if r_o + r_v < size:
                so = so + wp.vec3d(size, zero, zero)
                sv = sv + wp.vec3d(GOLDEN * size, zero, zero)
            elif area < size * wp.max(r_o, r_v):
                if r_v >= r_o:
                    so = so + (size / r_v) * wp.vec3d(-v[1], v[0], zero)
                else:
                    sv = sv + (size / r_o) * wp.vec3d(-o[1], o[0], zero)
    if equal < 3:
        if a[2] < zero and wp.abs(o[2]) + wp.abs(v[2]) < size:
            so = so + wp.vec3d(zero, zero, size)
            sv = sv + wp.vec3d(zero, zero, GOLDEN * size)
    if equal == 3 and a[0] < zero:
        r_o = wp.length(o)
        r_v = wp.length(v)
        if r_o + r_v < size:
            so = so + wp.vec3d(size, zero, zero)
            sv = sv + wp.vec3d(GOLDEN * size, zero, zero)
        elif wp.length(wp.cross(o, v)) < size * wp.max(r_o, r_v):
            if r_v >= r_o:
                side, _other = tangent_basis(v / r_v)
                so = so + size * side
            else:
                side, _other = tangent_basis(o / r_o)
                sv = sv + size * side
    if wp.length(so - sv) < size:
        # Eye at the target: t is undetermined (1/2 by symmetry) until they are two points.
        so = so + size * wp.vec3d(wp.float64(0.48), wp.float64(0.6), wp.float64(0.64))
    return so, sv


@wp.func
def all_reflections(eye: wp.vec3d, target: wp.vec3d, a: wp.vec3d, b: wp.float64, c: wp.float64, equal: int, sheet: int):
    """Every reflection point on the side where q > 0.

    Args:
        eye: Unit principal frame, q > 0.
        target: Likewise.
        a: Signed coefficients: the half gradient points to the reflecting side.
        b: Likewise.
        c: Likewise.
        equal: 1: principal values differ; 2: those of x and y agree; 3: all agree.
        sheet: Sign of z of the wanted points; 0: any.

    Returns:
        (rows of `Roots`, count).
    """
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    found = Roots()
    count = int(0)
    pencil = Pencil()
    o, v = off_symmetry(eye, target, a, equal)
    pencil.o = o
    pencil.v = v
    pencil.d = o - v
    pencil.eye = eye
    pencil.target = target
    pencil.a = a
    pencil.b = b
    pencil.c = c
    pencil.equal = equal
    pencil.sheet = sheet
    pencil.symmetric = on_one_axis(eye, target, equal)
    # Poles at mu > 0.
    p0 = -one
    p1 = -one
    p2 = -one
    if a[0] < zero:
        p0 = -one / a[0]
    if equal < 2 and a[1] < zero:
        p1 = -one / a[1]
    if equal < 3 and a[2] < zero:
        p2 = -one / a[2]
    low = zero
    for _interval in range(4):
        # The next pole above low.
        high = -one
        if p0 > low:
            high = p0
        if p1 > low and (high < zero or p1 < high):
            high = p1
        if p2 > low and (high < zero or p2 < high):
            high = p2
        if high < zero and low == zero:
            # No pole at all: one finite piece, then the tail.
            high = one / wp.max(wp.max(wp.abs(a[0]), wp.abs(a[1])), wp.abs(a[2]))
        pencil.low = low
        pencil.high = high
        step = SCAN_STEP
        f0 = resultant_at(pencil, wp.float64(0.25) * step)
        f1 = resultant_at(pencil, step)
        f2 = resultant_at(pencil, step + step)
        for k in range(3, wp.static(SCAN_NODES + 1)):
            # The cell between f1 and f2, its neighbours on either side.
            x3 = wp.min(wp.float64(k), LAST_NODE) * step
            f3 = resultant_at(pencil, x3)
            before = wp.abs(f1 - f0)
            across = wp.abs(f2 - f1)
            after = wp.abs(f3 - f2)
            suspect = (f1 > zero) != (f2 > zero)
            # A flat piece between steep ones: a root more on either side of it, or two within.
            suspect = suspect or across < wp.float64(0.5) * wp.min(before, after)
            suspect = suspect or (wp.abs(f1) <= wp.abs(f0) and wp.abs(f1) <= wp.abs(f2))
            suspect = suspect or (wp.abs(f2) <= wp.abs(f1) and wp.abs(f2) <= wp.abs(f3))
            if suspect:
                xb = wp.float64(k - 1) * step
                found, count = search_cell(found, count, pencil, xb - step, xb)
            f0 = f1
            f1 = f2
            f2 = f3
        if high < zero:
            break
        low = high
    return found, count


@wp.func
def flatness(r: wp.vec3d, eye: wp.vec3d, target: wp.vec3d, a: wp.vec3d, b: wp.float64):
    """Smallest eigenvalue of the Hessian over the size of its terms and the cosine; 0 on a caustic."""
    one = wp.float64(1.0)
    n = quadric_half_gradient(r, a, b)
    n_length = wp.length(n)
    n = n / n_length
    to_o = eye - r
    to_v = target - r
    i_o = one / wp.length(to_o)
    i_v = one / wp.length(to_v)
    u_o = i_o * to_o
    u_v = i_v * to_v
    t1, t2 = tangent_basis(n)
    o1 = wp.dot(u_o, t1)
    o2 = wp.dot(u_o, t2)
    v1 = wp.dot(u_v, t1)
    v2 = wp.dot(u_v, t2)
    c_o = wp.dot(u_o, n)
    c_v = wp.dot(u_v, n)
    bend = (c_o + c_v) / n_length
    s11 = bend * quadric_curve(t1, t1, a)
    s12 = bend * quadric_curve(t1, t2, a)
    s22 = bend * quadric_curve(t2, t2, a)
    h11 = (o2 * o2 + c_o * c_o) * i_o + (v2 * v2 + c_v * c_v) * i_v + s11
    h22 = (o1 * o1 + c_o * c_o) * i_o + (v1 * v1 + c_v * c_v) * i_v + s22
    h12 = s12 - o1 * o2 * i_o - v1 * v2 * i_v
    mean = wp.float64(0.5) * (h11 + h22)
    diff = wp.float64(0.5) * (h11 - h22)
    spread = wp.sqrt(diff * diff + h12 * h12)
    size = i_o + i_v + wp.abs(s11) + wp.abs(s12) + wp.abs(s22)
    return wp.min(wp.abs(mean - spread), wp.abs(mean + spread)) / (size * wp.max(c_o, wp.float64(1.0e-12)))
