"""The Newton search in a reflector map (`map_search.solve_vertex`) and what bounds the visible, many vertices at a time.

The same steps with the same decisions in every lane. Visible vertices of a run are moved together first, and again where
few of a vector's lanes go on and where searches that did not end near a root start from a coarse seed. The vectors of a run
take turns at each part of an evaluation: every operation of a search waits for the one before it, those of its
neighbours don't.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.reflector_maps import ReflectorMapView
from warp_reflect.techniques.lanes import IS_VISIBLE, MAP_SAMPLES, MAP_STEPS, UNIT_FRAME, VIRTUAL_VERTEX
from warp_reflect.techniques.map_search import (
    ACCEPTED,
    COARSE_NODES,
    CONVERGED,
    CONVEX_SHARE,
    DET_MIN,
    GAUGE_INSIDE,
    GAUGE_STEPS,
    GRAZING_COS,
    HIDDEN,
    MAX_ITERATIONS,
    NORMAL_PART_MIN,
    RETRY_SHRINK,
    SHRINK_MIN,
    SHRINK_NEAR,
    SPD_SHARE,
    STEP_CAP,
    STRAIGHT,
    TWIST_MAX,
    UNREFLECTED,
    SearchSettings,
)
from warp_reflect.techniques.vertices import ESTIMATE, SQUARED_MAX, SQUARED_MIN, SolveFrame, VertexView

wp.set_module_options({"enable_backward": False})

BLOCKS = 8  # of a task: few of their searches take long, and those fill vectors together


@wp.func_native(
    vector.snippet(
        vector.PACKED
        + VIRTUAL_VERTEX
        + MAP_SAMPLES
        + IS_VISIBLE
        + MAP_STEPS
        + r"""
    const int count = points.shape[0];
    const F eye_height = fmax(length(white_eye) - 1.0f, F(1.0e-3f));
    // What is left to search, side by side, and a vector more for the last load: of a run, then of all runs.
    constexpr int ROWS = 8, RUN = ROWS * LANES, TASK = BLOCKS * BLOCK, RUNS = TASK / RUN;
    constexpr int FEW = LANES / 2 - 1, FEW_ROW = FEW * TASK / LANES + LANES;
    enum { X = 3, BEST = 6, P = 9, N = 12, STEP = 15, RESIDUAL = 18, SHRINK = 19, KEPT = 20 };
    float at[X + 3][RUN + LANES], few[KEPT][FEW_ROW], far[X + 3][TASK + LANES];
    int vertex_of[RUN + LANES], few_vertex[FEW_ROW], few_used[FEW_ROW], far_vertex[TASK + LANES];
    int few_count = 0, far_count = 0;
// Between what is read and what is written of a row: the compiler would make masked stores of them, which are slow.
#define KEEP_APART(row) asm volatile("" : : "r"(&row) : "memory");
    struct Search {
        const float* row;
        V step;
        F shrink;
        I going, better;
        // Of this evaluation and of the next, in turn. Once it is judged, all but the cell is of the best so far. Not more of a
        // sample than this: ROWS searches are to lie in the innermost cache.
        V x[2], p[2], n[2];
        Cell cells[2];
        V p_u, p_v, n_u, n_v;
        Law law;  // with the best's residual
        int last, turns;
    };
    Search group[ROWS];
    Search unasked;  // what is known before the first evaluation
    unasked.law.residual = F(1.0e30f);
    unasked.shrink = F(1.0f);
    unasked.x[1] = unasked.p[1] = unasked.n[1] = unasked.step = same(0.0f);
    // map_search.search_newton. A vector goes on while more than FEW of its lanes do: the others go on side by side after the
    // last run, and then those that ended far from a root start again from a coarse seed.
    for (int round = 0; round < RUNS + 2; ++round) {
        const bool in_few = round == RUNS, in_coarse = round == RUNS + 1;
        int searched = in_few ? few_count : in_coarse ? far_count : 0;
        if (round < RUNS) {
            const int begin = task * TASK + round * RUN;
            const int end = begin + RUN < count ? begin + RUN : count;
            for (int start = begin; start < end; start += LANES) {
                const bool full = end - start >= LANES;
                const I element = start + lanes();
                const I valid = element < end;
                const I own = ipick(valid, element, I(end - 1));
                I known;
                if (full) {
                    Bytes byte;
                    __builtin_memcpy(&byte, status + start, sizeof(byte));
                    known = __builtin_convertvector(byte, I);
                } else EACH_LANE known[l] = status[own[l]];
                I asked = valid & (known == 0) & ~((own >= own_first) & (own < own_first + own_count));
                if (!bits(asked)) continue;
                const V point = vrows((const float*)points.data, start, full, own);
                const V target = add(matrix(frame.unit_from_scene, point), spread(frame.unit_offset));
                const I visible = is_visible(asked, target);
                V seed = same(0.0f);
                if (warm != 0) seed = vrows(seeds, start, full, own);
                const unsigned unseen = bits(asked & ~visible);
                if (unseen && bits(asked) == bits(I(-1))) {
                    // All of them: those in sight are answered later.
                    const Bytes byte = Bytes((unsigned char)hidden);
                    __builtin_memcpy(status + start, &byte, sizeof(byte));
                    vstore(seeds, start, same(0.0f));
                    vstore4(screen, start, V{F(0.0f), F(0.0f), F(-1.0f)}, F(0.0f));
                } else for (unsigned left = unseen; left != 0; left &= left - 1) {
                    const int i = start + __builtin_ctz(left);
                    status[i] = (unsigned char)hidden;
                    seeds[3 * i] = seeds[3 * i + 1] = seeds[3 * i + 2] = 0.0f;
                    screen[4 * i] = screen[4 * i + 1] = screen[4 * i + 3] = 0.0f;
                    screen[4 * i + 2] = -1.0f;
                }
                asked &= visible;
                if (!bits(asked)) continue;
                const I unknown = size(seed) == 0.0f;
                seed = project_to_cube(seed);
                if (bits(asked & unknown)) {
                    // map_search.first_guess
                    const V white = product(target, inv_extent);
                    const F height = fmax(length(white) - 1.0f, F(1.0e-3f));
                    const F share = height / (eye_height + height);
                    const V w = add(times(share, white_eye), times(1.0f - share, white));
                    seed = vpick(unknown, project_to_cube(vpick(size(w) < 1.0e-6f, white_eye, w)), seed);
                }
                const F each[6] = {target.x, target.y, target.z, seed.x, seed.y, seed.z};
                const unsigned here = bits(asked);
                if (here == bits(I(-1))) {
                    for (int k = 0; k < 6; ++k) store(at[k] + searched, each[k]);
                    istore(vertex_of + searched, own);
                    searched += LANES;
                } else {
                    for (int k = 0; k < 6; ++k) packed((int*)at[k] + searched, __builtin_bit_cast(I, each[k]), here);
                    searched += packed(vertex_of + searched, own, here);
                }
            }
        }
        if (searched == 0) continue;
        float* rows = in_few ? few[0] : in_coarse ? far[0] : at[0];
        int* numbers = in_few ? few_vertex : in_coarse ? far_vertex : vertex_of;
        const int ROW = in_few ? FEW_ROW : in_coarse ? TASK + LANES : RUN + LANES;
        if (in_coarse) {
            // map_search.coarse_seed: the nodes are read once, then every target looks at all of them.
            constexpr int SIDE = COARSE_NODES, NODES = 6 * SIDE * SIDE, PADDED = (NODES + LANES - 1) / LANES * LANES;
            float node_p[3][PADDED], node_n[3][PADDED], node_x[3][PADDED];
            for (int first = 0; first < PADDED; first += LANES) {
                const I k = first + lanes(), face = k / (SIDE * SIDE);
                const F u = (2.0f * __builtin_convertvector(k % SIDE, F) + 1.0f) / (float)SIDE - 1.0f;
                const F v = (2.0f * __builtin_convertvector(k / SIDE % SIDE, F) + 1.0f) / (float)SIDE - 1.0f;
                const F side = 1.0f - 2.0f * __builtin_convertvector(face % 2, F);
                const I on_z = face >= 4, on_y = (face >= 2) & ~on_z;
                const V x = vpick(on_z, V{u, v, side}, vpick(on_y, V{v, side, u}, V{side, u, v}));
                const Sample s = sample(x);
                store(node_p[0] + first, s.p.x); store(node_p[1] + first, s.p.y); store(node_p[2] + first, s.p.z);
                store(node_n[0] + first, s.n.x); store(node_n[1] + first, s.n.y); store(node_n[2] + first, s.n.z);
                store(node_x[0] + first, x.x); store(node_x[1] + first, x.y); store(node_x[2] + first, x.z);
            }
            for (int j = 0; j < far_count; ++j) {
                const V target = V{F(far[0][j]), F(far[1][j]), F(far[2][j])};
                F least = F(1.0e30f);
                I where = I(-1);
                for (int first = 0; first < PADDED; first += LANES) {
                    Sample s;
                    s.p = V{load(node_p[0] + first), load(node_p[1] + first), load(node_p[2] + first)};
                    s.n = V{load(node_n[0] + first), load(node_n[1] + first), load(node_n[2] + first)};
                    const Law law = measure(s, target);
                    const I k = first + lanes();
                    const I less = (law.residual < least) & (law.cos_eye > 0.0f) & (law.cos_target > 0.0f) & (k < NODES);
                    least = pick(less, law.residual, least);
                    where = ipick(less, k, where);
                }
                float lane[LANES];
                int node[LANES], found = -1;
                store(lane, least);
                istore(node, where);
                float best = 1.0e30f;
                for (int l = 0; l < LANES; ++l) {
                    if (node[l] >= 0 && (lane[l] < best || (lane[l] == best && node[l] < found))) {
                        best = lane[l];
                        found = node[l];
                    }
                }
                for (int k = 0; k < 3; ++k) far[X + k][j] = found >= 0 ? node_x[k][found] : k == 0 ? 1.0f : 0.0f;
            }
        }
        const int kept = in_few ? KEPT : X + 3;
        for (int l = searched; l < searched + LANES; ++l) {
            for (int k = 0; k < kept; ++k) rows[k * ROW + l] = rows[k * ROW + searched - 1];
            numbers[l] = numbers[searched - 1];
            if (in_few) few_used[l] = few_used[searched - 1];
        }
        // RUN of them at a time, in turns: what one vector waits for, its neighbours do.
        for (int from = 0; from < searched; from += RUN) {
            const int vectors = searched - from < RUN ? (searched - from + LANES - 1) / LANES : ROWS;
            int open[ROWS], opened = vectors;
            bool begun = in_few;
            for (int k = 0; k < vectors; ++k) {
                Search& g = group[k];
                const int start = from + k * LANES;
                const float* row = rows + start;
                auto at_row = [&](int k) -> V {
                    return V{load(row + k * ROW), load(row + (k + 1) * ROW), load(row + (k + 2) * ROW)};
                };
                g.going = start + lanes() < searched;
                g.row = row;
                g.x[0] = at_row(X);
                g.cells[0] = map_cell(g.x[0]);
                if (in_few) {
                    g.x[1] = at_row(BEST);
                    g.p[1] = at_row(P);
                    g.n[1] = at_row(N);
                    g.step = at_row(STEP);
                    g.law.residual = load(row + RESIDUAL * ROW);
                    g.shrink = load(row + SHRINK * ROW);
                }
                open[k] = k;
            }
            auto used_before = [&](int k) -> I { return in_few ? iload(few_used + from + k * LANES) : I(0); };
            auto target_of = [&](const Search& g) -> V { return V{load(g.row), load(g.row + ROW), load(g.row + 2 * ROW)}; };
            for (int turns = 1; opened > 0; ++turns) {
                const int now = (turns - 1) & 1, next = turns & 1;
                // Of all vectors the samples, then how good they are, then the steps, then, of those near a root, their ends.
                int on = 0, near_root[ROWS], near_count = 0;
                auto sample_of = [&](const Search& g) -> Sample {
                    return Sample{g.p[now], g.p_u, g.p_v, g.n[now], g.n_u, g.n_v};
                };
                for (int k = 0; k < opened; ++k) {
                    Search& g = group[open[k]];
                    const Sample s = sample_cell(g.cells[now]);
                    KEEP_APART(g)
                    g.p[now] = s.p;
                    g.n[now] = s.n;
                    g.p_u = s.p_u;
                    g.p_v = s.p_v;
                    g.n_u = s.n_u;
                    g.n_v = s.n_v;
                }
                for (int k = 0; k < opened; ++k) {
                    Search& g = group[open[k]];
                    const Search& known = begun ? g : unasked;
                    Law law = measure(sample_of(g), target_of(g));
                    const I better = g.going & (law.residual < known.law.residual);
                    const F residual = pick(better, law.residual, known.law.residual);
                    const F shrink = pick(better, F(1.0f), known.shrink * retry_shrink);
                    const F least = pick(residual <= accepted, F(shrink_near), F(shrink_min));
                    const I unended = ~(residual <= settings.tolerance) & (shrink >= least);
                    const I going = g.going & unended & (used_before(open[k]) + turns < settings.iterations);
                    if (bits(better) != bits(I(-1))) {
                        const V x = vpick(better, g.x[now], known.x[next]);
                        const V p = vpick(better, g.p[now], known.p[next]), n = vpick(better, g.n[now], known.n[next]);
                        KEEP_APART(g)
                        g.x[now] = x;
                        g.p[now] = p;
                        g.n[now] = n;
                    }
                    law.residual = residual;
                    KEEP_APART(g)
                    g.law = law;
                    g.shrink = shrink;
                    g.better = better;
                    g.going = going;
                    g.last = now;
                    g.turns = turns;
                    near_root[near_count] = open[k];
                    near_count += bits(going & better & (residual * residual <= settings.tolerance)) != 0;
                    open[on] = open[k];
                    on += bits(going) != 0;
                }
                opened = on;
                for (int k = 0; k < opened; ++k) {
                    Search& g = group[open[k]];
                    const V step = vpick(g.better, newton_step(sample_of(g), g.law, target_of(g)), (begun ? g : unasked).step);
                    KEEP_APART(g)
                    g.step = step;
                }
                for (int k = 0; k < opened; ++k) {
                    Search& g = group[open[k]];
                    const V x = vpick(g.going, step_on_cube(g.x[now], g.p[now], g.step, g.shrink), g.x[now]);
                    KEEP_APART(g)
                    g.x[next] = x;
                    g.cells[next] = map_cell(x);
                }
                begun = true;
                for (int k = 0; k < near_count; ++k) {
                    Search& g = group[near_root[k]];
                    const Cell from = g.cells[now], to = g.cells[next];
                    const F along_u = to.a - from.a, along_v = to.b - from.b;
                    const Sample end = slide(sample_of(g), along_u, along_v);
                    const F there = measure(end, target_of(g)).residual, residual_here = g.law.residual;
                    const I near = g.going & g.better & (residual_here * residual_here <= settings.tolerance);
                    const I ended = near & (to.texel == from.texel) & (magnitude(along_u * along_v) <= twist_max)
                        & (there <= settings.tolerance);
                    const V x = vpick(ended, g.x[next], g.x[now]);
                    const V p = vpick(ended, end.p, g.p[now]), n = vpick(ended, end.n, g.n[now]);
                    const F residual = pick(ended, there, residual_here);
                    KEEP_APART(g)
                    g.x[now] = x;
                    g.p[now] = p;
                    g.n[now] = n;
                    g.law.residual = residual;
                    g.going &= ~ended;
                }
                on = 0;
                for (int k = 0; k < opened; ++k) {
                    Search& g = group[open[k]];
                    open[on] = open[k];
                    on += __builtin_popcount(bits(g.going)) > (round < RUNS ? FEW : 0);
                }
                opened = on;
            }
            for (int k = 0; k < vectors; ++k) {
                const Search& g = group[k];
                const int start = from + k * LANES;
                const V target = target_of(g), best = g.x[g.last], p = g.p[g.last], n = g.n[g.last];
                const F residual = g.law.residual;
                const I asked = start + lanes() < searched, later = g.going, vertex = iload(numbers + start);
                if (bits(later)) {
                    const V x = g.x[g.last ^ 1];
                    const F each[KEPT] = {target.x, target.y, target.z, x.x, x.y, x.z, best.x, best.y, best.z,
                        p.x, p.y, p.z, n.x, n.y, n.z, g.step.x, g.step.y, g.step.z, residual, g.shrink};
                    const unsigned marked = bits(later);
                    for (int k = 0; k < KEPT; ++k) packed((int*)few[k] + few_count, __builtin_bit_cast(I, each[k]), marked);
                    packed(few_used + few_count, used_before(k) + g.turns, marked);
                    few_count += packed(few_vertex + few_count, vertex, marked);
                }
                I done = asked & ~later & (residual <= accepted), answer = I(converged);
                I rest = asked & ~later & ~done, nothing = I(0);
                if (bits(rest) && !in_coarse) {
                    // map_search.is_straight
                    const V to_eye = sub(eye, p), to_target = sub(target, p);
                    const V w = add(times(1.0f / fmax(length(to_eye), F(1.0e-20f)), to_eye),
                        times(1.0f / fmax(length(to_target), F(1.0e-20f)), to_target));
                    const I again = rest & ~((residual > map.accepted) & (dot(w, w) < straight * straight));
                    for (unsigned left = bits(again); left != 0; left &= left - 1) {
                        const int l = __builtin_ctz(left);
                        for (int k = 0; k < 3; ++k) far[k][far_count] = rows[k * ROW + start + l];
                        far_vertex[far_count++] = numbers[start + l];
                    }
                    rest &= ~again;
                }
                if (bits(rest)) {
                    // map_search.solve_vertex: what is not near a root.
                    const Sample s = sample(best);
                    const Law law = measure(s, target);
                    const I closing = least_mask(best) < 0.5f, off = residual > map.accepted;
                    const I grazing = ~(fmin(law.cos_eye, law.cos_target) >= grazing_cos);
                    const I without = ipick(grazing, I(hidden), ipick(closing, I(unreflected), I(max_iterations)));
                    nothing = rest & off & ((without != max_iterations) | (residual > settings.accepted));
                    int as[LANES];
                    float lane[4][LANES];
                    istore(as, without);
                    store(lane[0], best.x); store(lane[1], best.y); store(lane[2], best.z); store(lane[3], residual);
                    for (unsigned left = bits(nothing); left != 0; left &= left - 1) {
                        const int l = __builtin_ctz(left), i = numbers[start + l];
                        status[i] = (unsigned char)as[l];
                        out_vertex.residual.data[i] = lane[3][l];
                        for (int k = 0; k < 3; ++k) seeds[3 * i + k] = lane[k][l];
                        screen[4 * i] = screen[4 * i + 1] = screen[4 * i + 3] = 0.0f;
                        screen[4 * i + 2] = -1.0f;
                    }
                    done |= rest & ~nothing;
                    answer = ipick(rest & ~closing, I(max_iterations), answer);
                }
                if (!bits(done)) continue;
                const F reach = edge_reach(p, n, target, F(map.least_curvature));
                const Answer a = answered(answer, best, residual, virtual_vertex(p, n, target), reach);
                // Lanes that are answered later may be written to.
                const I open = placed ? done : asked & ~nothing;
                if (bits(open) == bits(I(-1)) && side_by_side(vertex)) put(vertex[0], done, a);
                else put_each(done, vertex, a);
            }
        }
    }
""".replace("COARSE_NODES", str(COARSE_NODES)).replace("BLOCKS", str(BLOCKS)),
    )
)
def search_block(
    task: int,
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
    convex_share: float,
    det_min: float,
    spd_share: float,
    step_cap: float,
    retry_shrink: float,
    shrink_min: float,
    shrink_near: float,
    straight: float,
    twist_max: float,
    accepted: float,
    estimate: float,
    squared_min: float,
    squared_max: float,
    grazing_cos: float,
    converged: int,
    hidden: int,
    unreflected: int,
    max_iterations: int,
    out_vertex: VertexView,
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
    camera: wp.array(dtype=CameraView),
    settings: SearchSettings,
    warm: int,
    # Outputs (seed: in and out, zero where none):
    out_vertex: VertexView,
):
    """One thread per `BLOCKS` blocks of vertices; as `reflector_map.search_kernel`."""
    search_block(
        first + wp.tid(),
        points,
        own_first,
        own_count,
        map,
        frame,
        camera[0],
        settings,
        warm,
        GAUGE_STEPS,
        GAUGE_INSIDE,
        NORMAL_PART_MIN,
        CONVEX_SHARE,
        DET_MIN,
        SPD_SHARE,
        STEP_CAP,
        RETRY_SHRINK,
        SHRINK_MIN,
        SHRINK_NEAR,
        STRAIGHT,
        TWIST_MAX,
        ACCEPTED,
        ESTIMATE,
        SQUARED_MIN,
        SQUARED_MAX,
        GRAZING_COS,
        CONVERGED,
        HIDDEN,
        UNREFLECTED,
        MAX_ITERATIONS,
        out_vertex,
    )


@wp.func_native(
    vector.snippet(
        UNIT_FRAME
        + MAP_SAMPLES
        + IS_VISIBLE
        + r"""
    const int begin = block * BLOCK, count = edges.shape[0];
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    float* points_of = (float*)out_point.data;
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I own = ipick(element < end, element, I(end - 1));
        const int* ends = (const int*)edges.data;
        const I from = igather(ends, 2 * own), to = igather(ends, 2 * own + 1);
        const I asked = (element < end) & (from >= 0);
        if (!bits(asked)) continue;
        auto place = [&](I vertex) -> V {
            const V point = vgather((const float*)points.data, ipick(asked, vertex, I(0)));
            return add(matrix(frame.unit_from_scene, point), spread(frame.unit_offset));
        };
        const V a = place(from), along = sub(place(to), a);
        F low = F(0.0f), high = F(1.0f);
        for (int k = 0; k < steps; ++k) {
            const F middle = 0.5f * (low + high);
            const I visible = is_visible(asked, add(a, times(middle, along)));
            low = pick(visible, middle, low);
            high = pick(visible, high, middle);
        }
        const V last = matrix(frame.eye_from_unit, sub(add(a, times(low, along)), eye));
        float lane[3][LANES];
        store(lane[0], last.x); store(lane[1], last.y); store(lane[2], last.z);
        for (unsigned left = bits(asked); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left);
            for (int k = 0; k < 3; ++k) points_of[3 * (start + l) + k] = lane[k][l];
        }
    }
""",
    )
)
def boundary_block(
    block: int,
    points: wp.array(dtype=wp.vec3),
    map: ReflectorMapView,
    frame: SolveFrame,
    edges: wp.array(dtype=wp.vec2i),
    steps: int,
    gauge_steps: int,
    gauge_inside: float,
    out_point: wp.array(dtype=wp.vec3),
): ...


@wp.kernel
def boundary_blocks_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    map: ReflectorMapView,
    frame: SolveFrame,
    edges: wp.array(dtype=wp.vec2i),
    steps: int,
    out_point: wp.array(dtype=wp.vec3),
):
    """As `reflector_map.boundary_kernel`, one thread per block of edges."""
    boundary_block(first + wp.tid(), points, map, frame, edges, steps, GAUGE_STEPS, GAUGE_INSIDE, out_point)
