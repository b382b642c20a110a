"""The search on a convex quadric (`quadric_search.solve_vertex`) for a block of vertices at a time.

The same Newton iteration with the same decisions in every lane; a vector goes on while any of its lanes does. Left without
a status, for the plain kernel: points of the surface itself, cones, searches without a seed on a paraboloid or a sheet, and
those that need the bracketed search.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.optics import MIN_DET_SHARE, MIN_HALF_NORMAL
from warp_reflect.techniques.lanes import VIRTUAL_VERTEX
from warp_reflect.techniques.quadric_search import (
    ACCEPTED,
    APEX_NEAR,
    CONVERGED,
    GUESS_STEPS,
    HIDDEN,
    NEWTON_STEPS,
    TOLERANCE,
    TOUCHING,
    QuadricView,
)
from warp_reflect.techniques.vertices import ESTIMATE, SQUARED_MAX, SQUARED_MIN, SolveFrame, VertexView

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(
        VIRTUAL_VERTEX
        + r"""
    const int count = points.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const float l0 = quadric.lam[0], l1 = quadric.lam[1], l2 = quadric.lam[2], b = quadric.b, c = quadric.c;
    const int family = quadric.family;
    auto value = [&](V x) -> F { return l0 * x.x * x.x + l1 * x.y * x.y + l2 * x.z * x.z + (b + b) * x.z + c; };
    auto gradient = [&](V x) -> V { return V{l0 * x.x, l1 * x.y, l2 * x.z + b}; };
    auto curve = [&](V u, V v) -> F { return l0 * u.x * v.x + l1 * u.y * v.y + l2 * u.z * v.z; };
    auto on_sheet = [&](V x) -> I { return family == 2 ? x.z > 0.0f : I(-1); };
    auto in_body = [&](V x) -> I { return on_sheet(x) & (value(x) < 0.0f); };
    // quadrics.put_on_surface
    auto put_on_surface = [&](V p) -> V {
        if (family == 0) {
            const F s = 1.0f / root(curve(p, p));
            return V{l0 > 0.0f ? p.x * s : p.x, l1 > 0.0f ? p.y * s : p.y, l2 > 0.0f ? p.z * s : p.z};
        }
        const F across = l0 * p.x * p.x + l1 * p.y * p.y + c;
        if (family == 1) return V{p.x, p.y, -across / (b + b)};
        return V{p.x, p.y, root(across / -l2)};
    };
    // quadrics.surface_distance and foot_radial, of a body about its centre.
    auto distance = [&](V x) -> F { const F q = value(x); return q / (root(q + 1.0f) + 1.0f); };
    auto foot = [&](V w) -> V {
        F mu = F(0.0f);
        I going = I(-1);
        V r = w;
        for (int k = 0; k <= guess_steps; ++k) {
            const F m0 = 1.0f / (1.0f + mu * l0), m1 = 1.0f / (1.0f + mu * l1), m2 = 1.0f / (1.0f + mu * l2);
            r = V{w.x * m0, w.y * m1, w.z * m2};
            if (k == guess_steps) break;
            const F p0 = l0 * r.x * r.x, p1 = l1 * r.y * r.y, p2 = l2 * r.z * r.z;
            const F n2 = p0 + p1 + p2;
            const F slope = p0 * l0 * m0 + p1 * l1 * m1 + p2 * l2 * m2;
            const F excess = root(n2) - 1.0f;
            mu = pick(going, fmax(mu + excess * n2 / slope, F(0.0f)), mu);
            going &= ~(magnitude(excess) < 32.0f * 5.9604645e-8f);
        }
        return put_on_surface(r);
    };
    const V at_eye = gradient(eye);
    const F eye_square = dot(eye, eye);

    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        I known;
        EACH_LANE known[l] = status[own[l]];
        I asked = valid & (known == 0) & ~((own >= own_first) & (own < own_first + own_count));
        if (!bits(asked)) continue;
        const V target = add(matrix(frame.unit_from_scene, vgather((const float*)points.data, own)), spread(frame.unit_offset));
        const V at_target = gradient(target);
        {
            const F n = length(at_target);
            const I touching = on_sheet(target) & (magnitude(value(target)) <= 2.0f * touches * (1.0f + length(target)) * n);
            if (bits(asked & touching)) out_left.data[block] = 1;
            asked &= ~touching;
        }
        // quadric_search.is_visible
        const V d = sub(target, eye);
        const F along = curve(d, d);
        const F falls = dot(at_eye, d);
        const I clear = (along <= 0.0f) | (falls >= 0.0f) | (dot(at_target, d) <= 0.0f);
        const I nearer = dot(target, target) < eye_square;
        const V near = vpick(nearer, target, eye);
        const F slope = pick(nearer, dot(at_target, d), falls);
        const V lowest = sub(near, times(slope / along, d));
        const I visible = ~in_body(target) & (clear | ~in_body(lowest));
        for (unsigned left = bits(asked & ~visible); left != 0; left &= left - 1) {
            const int i = start + __builtin_ctz(left);
            status[i] = (unsigned char)hidden;
            seeds[3 * i] = seeds[3 * i + 1] = seeds[3 * i + 2] = 0.0f;
            screen[4 * i] = screen[4 * i + 1] = screen[4 * i + 3] = 0.0f;
            screen[4 * i + 2] = -1.0f;
        }
        asked &= visible;
        V p;
        I has = I(0);
        if (warm != 0) {
            const V seed = vgather(seeds, own);
            has = dot(seed, seed) > 0.0f;
            p = put_on_surface(seed);
        }
        if (family != 0) {
            if (bits(asked & ~has)) out_left.data[block] = 1;
            asked &= has;
        }
        if (!bits(asked)) continue;
        if (bits(asked & ~has)) {
            // quadrics.first_guess
            const F a_o = fmax(distance(eye), F(1.0e-3f)), a_v = fmax(distance(target), F(1.0e-3f));
            const F t = a_v / (a_o + a_v);
            const V guess = foot(add(times(t, eye), times(1.0f - t, target)));
            p = vpick(has, p, guess);
        }

        // quadrics.newton_on_convex
        V best = p, step = same(0.0f);
        F best_angle = F(4.0f);
        I going = asked;
        for (int k = 0; k < newton_steps; ++k) {
            V n = gradient(p);
            const F n_length = length(n);
            n = over(n, n_length);
            V o = sub(eye, p), v = sub(target, p);
            const F inv_o = 1.0f / length(o), inv_v = 1.0f / length(v);
            o = times(inv_o, o);
            v = times(inv_v, v);
            const V w = add(o, v);
            const F w_n = dot(w, n);
            const F tangential = length(sub(w, times(w_n, n)));
            F angle = tangential / (tangential + magnitude(w_n));
            angle = pick(w_n <= 0.0f, 2.0f - angle, angle);
            const I better = going & (angle < best_angle);
            best = vpick(better, p, best);
            best_angle = pick(better, angle, best_angle);
            going &= ~(better & (angle <= tolerance)) & (better | (best_angle > 64.0f * tolerance));
            if (!bits(going)) break;
            V t1, t2;
            tangents(n, t1, t2);
            const F inv_n = 1.0f / n_length;
            const F s11 = curve(t1, t1) * inv_n, s12 = curve(t1, t2) * inv_n, s22 = curve(t2, t2) * inv_n;
            // optics.specular_newton_step
            const F o1 = dot(o, t1), o2 = dot(o, t2), v1 = dot(v, t1), v2 = dot(v, t2);
            const F o_n = dot(o, n), v_n = dot(v, n);
            const F half_n = o_n + v_n, g1 = o1 + v1, g2 = o2 + v2;
            const F bend = fmax(half_n, F(0.0f));
            const F h11 = (o2 * o2 + o_n * o_n) * inv_o + (v2 * v2 + v_n * v_n) * inv_v + bend * s11;
            const F h22 = (o1 * o1 + o_n * o_n) * inv_o + (v1 * v1 + v_n * v_n) * inv_v + bend * s22;
            const F h12 = bend * s12 - o1 * o2 * inv_o - v1 * v2 * inv_v;
            const F det_h = h11 * h22 - h12 * h12;
            const F q1 = s11 * g1 + s12 * g2 + o_n * o1 * inv_o + v_n * v1 * inv_v;
            const F q2 = s12 * g1 + s22 * g2 + o_n * o2 * inv_o + v_n * v2 * inv_v;
            const F inv_w = 1.0f / half_n;
            const F j11 = h11 + g1 * q1 * inv_w, j12 = h12 + g1 * q2 * inv_w;
            const F j21 = h12 + g2 * q1 * inv_w, j22 = h22 + g2 * q2 * inv_w;
            const F det_j = j11 * j22 - j12 * j21;
            const I full = (half_n > min_half_normal) & (det_j > min_det_share * det_h);
            const I safe_h = det_h > 0.0f;
            const F zero = F(0.0f);
            const F d1 = pick(full, (j22 * g1 - j12 * g2) / det_j, pick(safe_h, (h22 * g1 - h12 * g2) / det_h, zero));
            const F d2 = pick(full, (j11 * g2 - j21 * g1) / det_j, pick(safe_h, (h11 * g2 - h12 * g1) / det_h, zero));
            V move = add(times(d1, t1), times(d2, t2));
            F stretch = curve(move, move), reach = F(0.5f);
            if (family != 0) {
                stretch = magnitude(stretch) + l2 * l2 * move.z * move.z;
                reach = reach * (1.0f + magnitude(p.z));
            }
            move = vpick(stretch > reach, times(root(reach / stretch), move), move);
            step = vpick(better, move, times(F(0.4f), step));
            p = vpick(going, put_on_surface(add(best, step)), p);
        }

        V n = gradient(best);
        const F n_length = length(n);
        const I done = asked & (best_angle <= accepted) & (n_length >= apex_near);
        if (bits(asked & ~done)) out_left.data[block] = 1;
        n = over(n, n_length);
        V t1, t2;
        tangents(n, t1, t2);
        const F s11 = curve(t1, t1), s12 = curve(t1, t2), s22 = curve(t2, t2);
        const F mean = 0.5f * (s11 + s22);
        const F apart = root(0.25f * (s11 - s22) * (s11 - s22) + s12 * s12);
        const F least_curvature = fmax(mean - apart, F(0.0f)) / n_length;
        const F reach = edge_reach(best, n, target, least_curvature);
        settle(done, I(converged), own, best, best_angle, virtual_vertex(best, n, target), reach);
    }
"""
    )
)
def search_block(
    block: int,
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    quadric: QuadricView,
    frame: SolveFrame,
    camera: CameraView,
    warm: int,
    touches: float,
    guess_steps: int,
    newton_steps: int,
    tolerance: float,
    accepted: float,
    apex_near: float,
    min_half_normal: float,
    min_det_share: float,
    estimate: float,
    squared_min: float,
    squared_max: float,
    converged: int,
    hidden: int,
    out_vertex: VertexView,
    out_left: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def search_blocks_kernel(
    first: int,
    # Scene:
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    # Reflector:
    quadric: QuadricView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    warm: int,
    # Outputs (seed: in and out, zero where none; per block, whether something is left for the plain kernel):
    out_vertex: VertexView,
    out_left: wp.array(dtype=wp.uint8),
):
    """One thread per block of vertices; as `quadric_patch.search_kernel`."""
    search_block(
        first + wp.tid(),
        points,
        own_first,
        own_count,
        quadric,
        frame,
        camera[0],
        warm,
        TOUCHING,
        GUESS_STEPS,
        NEWTON_STEPS,
        TOLERANCE,
        ACCEPTED,
        APEX_NEAR,
        MIN_HALF_NORMAL,
        MIN_DET_SHARE,
        ESTIMATE,
        SQUARED_MIN,
        SQUARED_MAX,
        CONVERGED,
        HIDDEN,
        out_vertex,
        out_left,
    )
