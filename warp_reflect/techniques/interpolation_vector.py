"""One exact step from interpolated reflection directions (`interpolation.direction_kernel`) for a vector of vertices.

The same operations in the same order; a task is a chunk of the grid's vertices, all within one cell.
"""

from __future__ import annotations

import warp as wp

from warp_reflect import vector
from warp_reflect.layers import CameraView
from warp_reflect.reflector_maps import ReflectorMapView
from warp_reflect.techniques.interpolation import CONVERGED, HIDDEN, RESIDUAL_MAX, ChunkView
from warp_reflect.techniques.lanes import MAP_SAMPLES, MAP_STEPS, VIRTUAL_VERTEX
from warp_reflect.techniques.map_search import ACCEPTED, CONVEX_SHARE, DET_MIN, NORMAL_PART_MIN, SPD_SHARE, STEP_CAP
from warp_reflect.techniques.vertices import ESTIMATE, SQUARED_MAX, SQUARED_MIN, SolveFrame, VertexView

wp.set_module_options({"enable_backward": False})


@wp.func_native(
    vector.snippet(
        VIRTUAL_VERTEX
        + MAP_SAMPLES
        + MAP_STEPS
        + r"""
    const int cell = chunks.cell.data[chunk];
    const int begin = chunks.range.data[chunk][0], end = begin + chunks.range.data[chunk][1];
    const float inv = chunks.inv_edge.data[cell];
    const int* vertices = (const int*)order.data;
    if (inv == 0.0f) {
        for (int j = begin; j < end; ++j)
            if (status[vertices[j]] == 0) status[vertices[j]] = (unsigned char)hidden;
        return;
    }
    // interpolation.trilinear: 1, x, y, xy, z, xz, yz, xyz
    float t[8][3];
    const int* corner = (const int*)chunks.corner.data + 8 * cell;
    for (int k = 0; k < 3; ++k) {
        float v[8];
        for (int c = 0; c < 8; ++c) v[c] = ((const float*)node.seed.data)[3 * corner[c] + k];
        t[0][k] = v[0]; t[1][k] = v[1] - v[0]; t[2][k] = v[2] - v[0]; t[4][k] = v[4] - v[0];
        t[3][k] = v[3] - v[2] - t[1][k];
        t[5][k] = v[5] - v[4] - t[1][k];
        t[6][k] = v[6] - v[4] - t[2][k];
        t[7][k] = v[7] - v[6] - v[5] + v[4] - t[3][k];
    }
    for (int start = begin; start < end; start += LANES) {
        const I element = start + lanes();
        const I valid = element < end;
        const I own = ipick(valid, element, I(end - 1));
        const I vertex = igather(vertices, own);
        I known;
        EACH_LANE known[l] = status[vertex[l]];
        const I asked = valid & (known == 0);
        if (!bits(asked)) continue;
        const V point = vgather((const float*)points.data, own);
        const V at = times(F(inv), sub(point, spread(chunks.low.data[cell])));
        // interpolation.evaluate
        auto evaluate = [&](int k) -> F {
            const F low = t[0][k] + at.x * t[1][k] + at.y * (t[2][k] + at.x * t[3][k]);
            const F high = t[4][k] + at.x * t[5][k] + at.y * (t[6][k] + at.x * t[7][k]);
            return low + at.z * high;
        };
        const V from = project_to_cube(V{evaluate(0), evaluate(1), evaluate(2)});
        const V target = add(matrix(frame.unit_from_scene, point), spread(frame.unit_offset));
        V x = from;
        I tried = asked, done = I(0);
        for (int k = 0; k < 2 && bits(tried); ++k) {
            const Sample s = sample(x);
            const Law law = measure(s, target);
            if (k == 0) {
                tried &= law.residual < residual_max;
                x = vpick(tried, step_on_cube(x, s.p, newton_step(s, law, target), F(1.0f)), x);
                continue;
            }
            const F reach = edge_reach(s.p, s.n, target, F(map.least_curvature));
            const F share = length(sub(target, s.p)) / fmax(reach, F(1.0e-20f));
            const F left = law.residual * (law.cos_eye + law.cos_target) * estimate * share * share;
            done = tried & (law.residual < accepted) & (left < tolerance);
            if (bits(done)) settle(done, I(converged), vertex, x, law.residual, virtual_vertex(s.p, s.n, target), reach);
        }
        for (unsigned left = bits(asked & ~done); left != 0; left &= left - 1) {
            const int l = __builtin_ctz(left), i = vertices[start + l];
            out_failed.data[start + l] = 1;
            seeds[3 * i] = from.x[l]; seeds[3 * i + 1] = from.y[l]; seeds[3 * i + 2] = from.z[l];
        }
    }
""",
    )
)
def step_chunk(
    chunk: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    chunks: ChunkView,
    node: VertexView,
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: CameraView,
    tolerance: float,
    residual_max: float,
    normal_part_min: float,
    convex_share: float,
    det_min: float,
    spd_share: float,
    step_cap: float,
    accepted: float,
    estimate: float,
    squared_min: float,
    squared_max: float,
    converged: int,
    hidden: int,
    out_vertex: VertexView,
    out_failed: wp.array(dtype=wp.uint8),
): ...


@wp.kernel
def direction_lanes_kernel(
    first: int,
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=int),
    chunks: ChunkView,
    node: VertexView,
    map: ReflectorMapView,
    frame: SolveFrame,
    camera: wp.array(dtype=CameraView),
    tolerance: float,
    out_vertex: VertexView,
    out_failed: wp.array(dtype=wp.uint8),
):
    """One thread per chunk; as `interpolation.direction_kernel`, with `out_failed` zero before."""
    step_chunk(
        first + wp.tid(),
        points,
        order,
        chunks,
        node,
        map,
        frame,
        camera[0],
        tolerance,
        RESIDUAL_MAX,
        NORMAL_PART_MIN,
        CONVEX_SHARE,
        DET_MIN,
        SPD_SHARE,
        STEP_CAP,
        ACCEPTED,
        ESTIMATE,
        SQUARED_MIN,
        SQUARED_MAX,
        CONVERGED,
        HIDDEN,
        out_vertex,
        out_failed,
    )
