"""The Newton search in a reflector map (`map_search.solve_vertex`) for a block of vertices at a time.

The same steps with the same decisions in every lane. Visible vertices of the block are moved together first; a vector goes
on while any of its lanes does. Left without a status, for the plain kernel: searches that do not end near a root, which
start again from a coarse seed, and answers beside creases.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.reflector_maps import ReflectorMapView
from warp_reflect.techniques.lanes import REFLECTOR_MAP, VIRTUAL_VERTEX
from warp_reflect.techniques.map_search import (
    ACCEPTED,
    CONVERGED,
    GAUGE_INSIDE,
    GAUGE_STEPS,
    HIDDEN,
    NORMAL_PART_MIN,
    RETRY_SHRINK,
    SHRINK_MIN,
    SPD_SHARE,
    STEP_CAP,
    SearchSettings,
)
from warp_reflect.techniques.vertices import ESTIMATE, SolveFrame, VertexView

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(
        VIRTUAL_VERTEX
        + REFLECTOR_MAP
        + r"""
    const int count = points.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    const V white_eye = product(eye, inv_extent);
    const F eye_height = fmax(length(white_eye) - 1.0f, F(1.0e-3f));
    // What is left to search, side by side, and a vector more for the last load.
    float at[6][BLOCK + LANES];
    int vertex_of[BLOCK + LANES];
    int searched = 0;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        I known;
        EACH_LANE known[l] = status[own[l]];
        I asked = valid & (known == 0) & ~((own >= own_first) & (own < own_first + own_count));
        if (!bits(asked)) continue;
        const V target = add(matrix(frame.unit_from_scene, vgather((const float*)points.data, own)), spread(frame.unit_offset));
        // map_search.is_visible
        const V white = product(target, inv_extent);
        const V d = sub(white, white_eye);
        F t = clip(-dot(white_eye, d) / fmax(dot(d, d), F(1.0e-30f)), 0.0f, 1.0f);
        const F nearest = length(add(white_eye, times(t, d)));
        I visible = nearest > map.outer_radius;
        I open = asked & ~visible & ~(nearest < map.inner_radius);
        if (bits(open)) {
            const V direction = sub(target, eye);
            F low = F(0.0f), high = F(1.0f);
            for (int k = 0; k < gauge_steps && bits(open); ++k) {
                const V w = add(white_eye, times(t, d));
                const Sample s = sample(project_to_cube(w));
                open &= ~(length(w) < (1.0f + gauge_inside) * length(product(s.p, inv_extent)));
                const I falls = dot(s.n, direction) < 0.0f;
                low = pick(falls, t, low);
                high = pick(falls, high, t);
                const I ended = open & ((low >= 1.0f) | (high <= 0.0f));
                visible |= ended;
                open &= ~ended;
                t = 0.5f * (low + high);
            }
            visible |= open;
        }
        for (unsigned left = bits(asked & ~visible); left != 0; left &= left - 1) {
            const int i = start + __builtin_ctz(left);
            status[i] = (unsigned char)hidden;
            seeds[3 * i] = seeds[3 * i + 1] = seeds[3 * i + 2] = 0.0f;
            screen[4 * i] = screen[4 * i + 1] = screen[4 * i + 3] = 0.0f;
            screen[4 * i + 2] = -1.0f;
        }
        asked &= visible;
        if (!bits(asked)) continue;
        V seed = same(0.0f);
        if (warm != 0) seed = vgather(seeds, own);
        const I unknown = size(seed) == 0.0f;
        if (bits(asked & unknown)) {
            // map_search.first_guess
            const F height = fmax(length(white) - 1.0f, F(1.0e-3f));
            const F share = height / (eye_height + height);
            const V w = add(times(share, white_eye), times(1.0f - share, white));
            seed = vpick(unknown, project_to_cube(vpick(size(w) < 1.0e-6f, white_eye, w)), seed);
        }
        const F each[6] = {target.x, target.y, target.z, seed.x, seed.y, seed.z};
        if (bits(asked) == bits(I(-1))) {
            for (int k = 0; k < 6; ++k) store(at[k] + searched, each[k]);
            istore(vertex_of + searched, own);
            searched += LANES;
        } else {
            float lane[6][LANES];
            for (int k = 0; k < 6; ++k) store(lane[k], each[k]);
            for (unsigned left = bits(asked); left != 0; left &= left - 1) {
                const int l = __builtin_ctz(left);
                for (int k = 0; k < 6; ++k) at[k][searched] = lane[k][l];
                vertex_of[searched++] = start + l;
            }
        }
    }
    for (int l = 0; l < LANES && searched > 0; ++l) {
        for (int k = 0; k < 6; ++k) at[k][searched + l] = at[k][searched - 1];
        vertex_of[searched + l] = vertex_of[searched - 1];
    }

    for (int start = 0; start < searched; start += LANES) {
        const I asked = start + lanes() < searched;
        const V target = V{load(at[0] + start), load(at[1] + start), load(at[2] + start)};
        V x = V{load(at[3] + start), load(at[4] + start), load(at[5] + start)};
        // map_search.search_newton
        V best = x, p = same(0.0f), n = same(0.0f), step = same(0.0f);
        F residual = F(1.0e30f), shrink = F(1.0f);
        I going = asked;
        for (int used = 1; used <= settings.iterations; ++used) {
            const Sample s = sample(x);
            const F here = measure(s, target).residual;
            const I better = going & (here < residual);
            best = vpick(better, x, best);
            p = vpick(better, s.p, p);
            n = vpick(better, s.n, n);
            residual = pick(better, here, residual);
            shrink = pick(better, F(1.0f), shrink * retry_shrink);
            going &= ~(residual <= settings.tolerance) & (shrink >= shrink_min);
            if (!bits(going) || used == settings.iterations) break;
            step = vpick(better, newton_step(s, target), step);
            x = vpick(going, step_on_cube(best, p, step, shrink), x);
        }
        const I done = asked & (residual <= accepted);
        if (bits(asked & ~done)) out_left.data[block] = 1;
        if (!bits(done)) continue;
        const F reach = edge_reach(p, n, target, F(map.least_curvature));
        settle(done, iload(vertex_of + start), best, residual, virtual_vertex(p, n, target), reach);
    }
""",
        wide=True,
    )
)
def search_block(
    block: int,
    points: wp.array(dtype=wp.vec3),
    own_first: int,
    own_count: int,
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: CameraView,
    settings: SearchSettings,
    warm: int,
    gauge_steps: int,
    gauge_inside: float,
    normal_part_min: float,
    spd_share: float,
    step_cap: float,
    retry_shrink: float,
    shrink_min: float,
    accepted: float,
    estimate: float,
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
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: CameraView,
    settings: SearchSettings,
    warm: int,
    # Outputs (seed: in and out, zero where none; per block, whether something is left for the plain kernel):
    out_vertex: VertexView,
    out_left: wp.array(dtype=wp.uint8),
):
    """One thread per block of vertices; as `reflector_map.search_kernel`."""
    search_block(
        first + wp.tid(),
        points,
        own_first,
        own_count,
        map,
        frame,
        camera,
        settings,
        warm,
        GAUGE_STEPS,
        GAUGE_INSIDE,
        NORMAL_PART_MIN,
        SPD_SHARE,
        STEP_CAP,
        RETRY_SHRINK,
        SHRINK_MIN,
        ACCEPTED,
        ESTIMATE,
        CONVERGED,
        HIDDEN,
        out_vertex,
        out_left,
    )
