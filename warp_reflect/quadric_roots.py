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
from warp_reflect.quadrics import quadric_curve, quadric_half_gradient, quadric_value

wp.set_module_options({"enable_backward": False})

MAX_ROOTS = 10  # the degree of the elimination for three different principal values
SCAN_NODES = wp.constant(64)  # per interval between poles; 10 roots at most are spread over the intervals
GRADING = wp.float64(5.0)  # nodes approach an interval's ends like x^5: down to 1e-9 of it
BISECTIONS = wp.constant(50)
POLISH_STEPS = wp.constant(40)
SAME_ROOT = wp.float64(1.0e-7)  # of the size: closer points are one root found twice
SPLIT = wp.float64(1.0e-7)  # of the size: how far a symmetric configuration is moved before the scan
NULL_DIRECTION = wp.float64(
    1.0e-8
)  # eigenvalues of the Hessian below this share are no direction to step along

FLAG_RING = wp.constant(16)  # a whole ring (or sphere) of roots

Roots = wp.types.matrix(shape=(MAX_ROOTS, 5), dtype=wp.float64)
"""Rows: x, y, z, path length, Morse index + flags; sorted by path length."""


@wp.struct
class PolishedRoot:
    """A reflection point and what decides about it."""

    point: wp.vec3d
    length: wp.float64
    index: int  # Morse index: negative eigenvalues of the path length's Hessian
    flat: (
        wp.float64
    )  # smallest eigenvalue over the size of its terms and the cosine; 0 on a caustic or a ring
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
    """F(mu), cleared of its poles, and E1 as (a1, b1, c1): a1 t^2 + b1 t + c1."""
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
    clear = one
    if a[0] != wp.float64(0.0):
        clear = clear * w0
    if equal < 2 and a[1] != wp.float64(0.0):
        clear = clear * w1
    if equal < 3 and a[2] != wp.float64(0.0):
        clear = clear * w2
    clear = clear * clear
    return f * clear * clear, wp.vec3d(a1, b1, c1)


@wp.func
def scan_node(x: wp.float64, low: wp.float64, high: wp.float64):
    """Mu at parameter x in (0, 1) of the interval [low, high], or [low, infinity) where high < low."""
    one = wp.float64(1.0)
    y = one - x
    p = wp.pow(x, GRADING)
    q = wp.pow(y, GRADING)
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
    for _k in range(4):
        n = quadric_half_gradient(p, a, b)
        nn = wp.dot(n, n)
        if nn > zero:
            p = p - (half * quadric_value(p, a, b, c) / nn) * n
    error = wp.float64(4.0)
    noise = zero
    c_o = zero
    c_v = zero
    for _k in range(POLISH_STEPS):
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
        if error <= noise or long <= wp.float64(4.0e-16) * (one + wp.length(p)):
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
        for _j in range(2):
            m = quadric_half_gradient(p, a, b)
            mm = wp.dot(m, m)
            if mm > zero:
                p = p - (half * quadric_value(p, a, b, c) / mm) * m
    if error <= wp.float64(1.0e4) * noise and c_o > zero and c_v > zero:
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


@wp.func
def pencil_point(mu: wp.float64, t: wp.float64, v: wp.vec3d, d: wp.vec3d, a: wp.vec3d, b: wp.float64):
    """R of the pencil at (mu, t)."""
    one = wp.float64(1.0)
    return wp.vec3d(
        (v[0] + t * d[0]) / (one + mu * a[0]),
        (v[1] + t * d[1]) / (one + mu * a[1]),
        (v[2] + t * d[2] - mu * b) / (one + mu * a[2]),
    )


@wp.func
def add_candidates(
    found: Roots,
    count: int,
    mu: wp.float64,
    eq1: wp.vec3d,
    v: wp.vec3d,
    d: wp.vec3d,
    eye: wp.vec3d,
    target: wp.vec3d,
    a: wp.vec3d,
    b: wp.float64,
    c: wp.float64,
    sheet: int,
    symmetric: int,
):
    """Polish both points of the pencil at mu that lie on the surface; keep what becomes a new root."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    slack = wp.float64(1.0e-3)
    a1 = eq1[0]
    hb = wp.float64(0.5) * eq1[1]
    c1 = eq1[2]
    # A root that touches: the pair may have become complex by rounding, its real part still starts Newton.
    disc = wp.sqrt(wp.max(hb * hb - a1 * c1, zero))
    k = -hb - wp.where(hb < zero, -disc, disc)
    t_first = wp.float64(-1.0)
    t_second = wp.float64(-1.0)
    if a1 != zero:
        t_first = k / a1
    if k != zero:
        t_second = c1 / k
    for j in range(2):
        t = t_first
        if j == 1:
            t = t_second
        if t > -slack and t < one + slack:
            start = pencil_point(mu, t, v, d, a, b)
            root = polish_root(start, eye, target, a, b, c)
            if sheet != 0 and root.point[2] * wp.float64(sheet) <= zero:
                root.valid = int(0)
            found, count = add_root(found, count, root, symmetric)
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
    golden = wp.float64(0.6180339887498949)
    so = o
    sv = v
    if equal == 1:
        if a[0] < zero and wp.abs(o[0]) + wp.abs(v[0]) < size:
            so = so + wp.vec3d(size, zero, zero)
            sv = sv + wp.vec3d(golden * size, zero, zero)
        if a[1] < zero and wp.abs(o[1]) + wp.abs(v[1]) < size:
            so = so + wp.vec3d(zero, size, zero)
            sv = sv + wp.vec3d(zero, golden * size, zero)
    if equal == 2:
        area = wp.abs(o[0] * v[1] - o[1] * v[0])
        r_o = wp.sqrt(o[0] * o[0] + o[1] * o[1])
        r_v = wp.sqrt(v[0] * v[0] + v[1] * v[1])
        if a[0] < zero:
            if r_o + r_v < size:
                so = so + wp.vec3d(size, zero, zero)
                sv = sv + wp.vec3d(golden * size, zero, zero)
            elif area < size * wp.max(r_o, r_v):
                if r_v >= r_o:
                    so = so + (size / r_v) * wp.vec3d(-v[1], v[0], zero)
                else:
                    sv = sv + (size / r_o) * wp.vec3d(-o[1], o[0], zero)
    if equal < 3:
        if a[2] < zero and wp.abs(o[2]) + wp.abs(v[2]) < size:
            so = so + wp.vec3d(zero, zero, size)
            sv = sv + wp.vec3d(zero, zero, golden * size)
    if equal == 3 and a[0] < zero:
        r_o = wp.length(o)
        r_v = wp.length(v)
        if r_o + r_v < size:
            so = so + wp.vec3d(size, zero, zero)
            sv = sv + wp.vec3d(golden * size, zero, zero)
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
def all_reflections(
    eye: wp.vec3d, target: wp.vec3d, a: wp.vec3d, b: wp.float64, c: wp.float64, equal: int, sheet: int
):
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
    found = Roots()
    count = int(0)
    symmetric = on_one_axis(eye, target, equal)
    o, v = off_symmetry(eye, target, a, equal)
    d = o - v
    # Poles at mu > 0, ascending.
    p0 = wp.float64(-1.0)
    p1 = wp.float64(-1.0)
    p2 = wp.float64(-1.0)
    if a[0] < zero:
        p0 = wp.float64(-1.0) / a[0]
    if equal < 2 and a[1] < zero:
        p1 = wp.float64(-1.0) / a[1]
    if equal < 3 and a[2] < zero:
        p2 = wp.float64(-1.0) / a[2]
    low = zero
    span = wp.float64(1.0) / wp.max(wp.max(wp.abs(a[0]), wp.abs(a[1])), wp.abs(a[2]))
    for _interval in range(4):
        # The next pole above low.
        high = wp.float64(-1.0)
        if p0 > low:
            high = p0
        if p1 > low and (high < zero or p1 < high):
            high = p1
        if p2 > low and (high < zero or p2 < high):
            high = p2
        last = int(0)
        base = low
        if high < zero:
            last = int(1)
            if low == zero:
                # No pole at all: one finite piece, then the tail.
                high = span
                last = int(0)
        x0 = wp.float64(0.0)
        x1 = wp.float64(0.0)
        f0 = wp.float64(0.0)
        f1 = wp.float64(0.0)
        for k in range(1, SCAN_NODES):
            x2 = wp.float64(k) / wp.float64(SCAN_NODES)
            mu = scan_node(x2, base, high)
            f2, eq1 = pencil_resultant(mu, o, v, d, a, b, c, equal)
            if k > 1 and (f1 > zero) != (f2 > zero):
                xa = x1
                xb = x2
                fa = f1
                for _j in range(BISECTIONS):
                    xm = wp.float64(0.5) * (xa + xb)
                    fm, eq1 = pencil_resultant(scan_node(xm, base, high), o, v, d, a, b, c, equal)
                    if (fm > zero) == (fa > zero):
                        xa = xm
                    else:
                        xb = xm
                mu = scan_node(xa, base, high)
                fm, eq1 = pencil_resultant(mu, o, v, d, a, b, c, equal)
                found, count = add_candidates(
                    found, count, mu, eq1, v, d, eye, target, a, b, c, sheet, symmetric
                )
            elif (
                k > 2 and wp.abs(f1) <= wp.abs(f0) and wp.abs(f1) <= wp.abs(f2) and (f0 > zero) == (f1 > zero)
            ):
                # A dip towards zero: two roots close together, or one that touches (equal mu, different t).
                sign = wp.where(f1 > zero, wp.float64(1.0), wp.float64(-1.0))
                ratio = wp.float64(0.6180339887498949)
                xa = x0
                xb = x2
                xl = xb - ratio * (xb - xa)
                xr = xa + ratio * (xb - xa)
                fl, eq1 = pencil_resultant(scan_node(xl, base, high), o, v, d, a, b, c, equal)
                fr, eq1 = pencil_resultant(scan_node(xr, base, high), o, v, d, a, b, c, equal)
                for _j in range(40):
                    if sign * fl < sign * fr:
                        xb = xr
                        xr = xl
                        fr = fl
                        xl = xb - ratio * (xb - xa)
                        fl, eq1 = pencil_resultant(scan_node(xl, base, high), o, v, d, a, b, c, equal)
                    else:
                        xa = xl
                        xl = xr
                        fl = fr
                        xr = xa + ratio * (xb - xa)
                        fr, eq1 = pencil_resultant(scan_node(xr, base, high), o, v, d, a, b, c, equal)
                    if sign * fl < zero or sign * fr < zero:
                        break
                xm = xl
                if sign * fr < sign * fl:
                    xm = xr
                mu = scan_node(xm, base, high)
                fm, eq1 = pencil_resultant(mu, o, v, d, a, b, c, equal)
                if sign * fm < zero:
                    # It crosses after all: one root on either side of the dip.
                    for side in range(2):
                        xa = x0
                        if side == 1:
                            xa = x2
                        xb = xm
                        for _j in range(BISECTIONS):
                            x = wp.float64(0.5) * (xa + xb)
                            fm, eq1 = pencil_resultant(scan_node(x, base, high), o, v, d, a, b, c, equal)
                            if sign * fm > zero:
                                xa = x
                            else:
                                xb = x
                        mu = scan_node(xb, base, high)
                        fm, eq1 = pencil_resultant(mu, o, v, d, a, b, c, equal)
                        found, count = add_candidates(
                            found, count, mu, eq1, v, d, eye, target, a, b, c, sheet, symmetric
                        )
                else:
                    found, count = add_candidates(
                        found, count, mu, eq1, v, d, eye, target, a, b, c, sheet, symmetric
                    )
            x0 = x1
            f0 = f1
            x1 = x2
            f1 = f2
        if last == 1:
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
