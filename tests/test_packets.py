"""Rays in packets: against all triangles one by one, against Warp's own queries, and the shadows they find."""

import numpy as np
import pytest
import warp as wp
from test_shade import WHITE, ball_mesh, distant, dome, ground, look_at, place, scene_of, turned

import warp_reflect as wr
from warp_reflect import bounces, bvh, compact, direct, raster, shadows, surface, vector
from warp_reflect.any_hit import ANY_HIT
from warp_reflect.launch import FINITE_FLAGS, launch
from warp_reflect.layers import MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.scene import LightData, MaterialData
from warp_reflect.settings import Status, Technique
from warp_reflect.wide_packets import TRAVERSAL
from warp_reflect.wide_tree import WideTree

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})
CPU = wp.get_device("cpu")
FAR = 3.0e38


@wp.func_native(
    vector.snippet(
        TRAVERSAL
        + r"""
    constexpr int GROUPS = 2;
    struct Pair { enum { value = GROUPS }; static constexpr bool first_alone() { return false; } };
    const int count = origins.shape[0];
    const int begin = block * BLOCK;
    const int end = begin + BLOCK < count ? begin + BLOCK : count;
    for (int start = begin; start < end; start += GROUPS * LANES) {
        I valid[GROUPS];
        V o[GROUPS], d[GROUPS];
        F far[GROUPS];
        for (int g = 0; g < GROUPS; ++g) {
            const I at = start + g * LANES + lanes();
            valid[g] = at < end;
            const I own = ipick(valid[g], at, I(end - 1));
            o[g] = vgather((const float*)origins.data, own);
            d[g] = vgather((const float*)directions.data, own);
            far[g] = gather(reach.data, own);
        }
        Met nearest[GROUPS];
        find_nearest(Pair{}, valid, o, d, far, nearest);
        for (int k = 0; k < GROUPS * LANES && start + k < end; ++k) {
            const int g = k / LANES, l = k % LANES;
            out_face.data[start + k] = nearest[g].face[l];
            if (nearest[g].face[l] < 0) continue;
            out_t.data[start + k] = nearest[g].t[l];
            out_u.data[start + k] = nearest[g].u[l];
            out_v.data[start + k] = nearest[g].v[l];
        }
    }
"""
    )
)
def nearest_block(
    block: int,
    mesh_id: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: wp.array(dtype=float),
    out_face: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
): ...


@wp.func_native(
    vector.snippet(
        ANY_HIT
        + r"""
    const int count = origins.shape[0];
    I valid[GROUPS], blocked[GROUPS];
    V o[GROUPS], d[GROUPS];
    F far[GROUPS];
    for (int g = 0; g < GROUPS; ++g) {
        const I at = block * BLOCK + g * LANES + lanes();
        valid[g] = at < count;
        const I own = ipick(valid[g], at, I(count - 1));
        o[g] = vgather((const float*)origins.data, own);
        d[g] = vgather((const float*)directions.data, own);
        far[g] = gather(reach.data, own);
    }
    find_blocked(valid, o, d, far, blocked, tree_nodes, 1);
    // Again from the leaves in the hull of them all, where the rays end somewhere: 2 where that answers otherwise.
    V starts_low = same(3.0e38f), starts_high = same(-3.0e38f), ends_low = same(3.0e38f), ends_high = same(-3.0e38f);
    unsigned endless = 0;
    for (int g = 0; g < GROUPS; ++g) {
        endless |= bits(valid[g] & (far[g] > 1.0e30f));
        const V end = add(o[g], times(far[g], d[g]));
        auto take_in = [&](F v, F& low, F& high) { low = fmin(v, low); high = fmax(v, high); };
        take_in(o[g].x, starts_low.x, starts_high.x); take_in(end.x, ends_low.x, ends_high.x);
        take_in(o[g].y, starts_low.y, starts_high.y); take_in(end.y, ends_low.y, ends_high.y);
        take_in(o[g].z, starts_low.z, starts_high.z); take_in(end.z, ends_low.z, ends_high.z);
    }
    I again[GROUPS];
    for (int g = 0; g < GROUPS; ++g) again[g] = blocked[g];
    float leaves[8 * LEAVES_MOST];
    const int found = endless ? -1 : leaves_within(shaft_of(starts_low, starts_high, ends_low, ends_high), leaves);
    if (found >= 0) find_blocked(valid, o, d, far, again, leaves, found);
    for (int k = 0; k < BLOCK && block * BLOCK + k < count; ++k) {
        const int met = blocked[k / LANES][k % LANES] != 0;
        out_met.data[block * BLOCK + k] = met == (again[k / LANES][k % LANES] != 0) ? met : 2;
    }
"""
    )
)
def blocked_block(
    block: int,
    mesh_id: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: wp.array(dtype=float),
    out_met: wp.array(dtype=int),
): ...


@wp.kernel
def query_blocks_kernel(
    first: int,
    mesh_id: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: wp.array(dtype=float),
    out_met: wp.array(dtype=int),
    out_face: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    block = first + wp.tid()
    nearest_block(block, mesh_id, origins, directions, reach, out_face, out_t, out_u, out_v)
    blocked_block(block, mesh_id, origins, directions, reach, out_met)


@wp.kernel
def query_kernel(
    first: int,
    mesh_id: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: wp.array(dtype=float),
    out_met: wp.array(dtype=int),
    out_face: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
):
    i = first + wp.tid()
    out_face[i] = -1
    if wp.mesh_query_ray_anyhit(mesh_id, origins[i], directions[i], reach[i]):
        out_met[i] = 1
    query = wp.mesh_query_ray(mesh_id, origins[i], directions[i], reach[i])
    if query.result:
        out_face[i] = query.face
        out_t[i] = query.t
        out_u[i] = query.u
        out_v[i] = query.v


def answers(points, triangles, origins, directions, reach=FAR, threads=1, leaf_size=4):
    """(Warp's, the packets'): whether something is met, the nearest face, t, u, v."""
    mesh = wp.Mesh(
        wp.array(np.float32(points), dtype=wp.vec3, device=CPU),
        wp.array(np.int32(triangles).reshape(-1), dtype=int, device=CPU),
        bvh_constructor="sah",
        bvh_leaf_size=leaf_size,
    )
    n = len(origins)
    reach = np.broadcast_to(np.float32(reach), n)
    wide = WideTree(mesh)
    rays = []
    for values, kind in ((origins, wp.vec3), (directions, wp.vec3), (reach, float)):
        rays.append(wp.array(np.ascontiguousarray(values, np.float32), dtype=kind, device=CPU))
    result = []
    for launched, kernel, tree in ((launch, query_kernel, mesh), (vector.launch_blocks, query_blocks_kernel, wide)):
        outputs = [wp.zeros(n, dtype=kind, device=CPU) for kind in (int, int, float, float, float)]
        launched(kernel, n, [wp.uint64(tree.id), *rays, *outputs], CPU, threads)
        result.append([output.numpy() for output in outputs])
    return result


def one_by_one(points, triangles, origins, directions):
    """Distance to every triangle's plane and the least weight there, float64 [rays, triangles]; Cramer's rule."""
    p = np.float32(points).astype(np.float64)
    a, b, c = p[triangles[:, 0]], p[triangles[:, 1]], p[triangles[:, 2]]
    o, d = (np.float32(each).astype(np.float64)[:, None] for each in (origins, directions))
    normal = np.cross(b - a, c - a)
    det = -np.einsum("rtk,tk->rt", np.broadcast_to(d, (len(o), len(a), 3)), normal)
    with np.errstate(all="ignore"):
        t = np.einsum("rtk,tk->rt", o - a, normal) / det
        across = np.cross(o - a, np.broadcast_to(d, (len(o), len(a), 3)))
        u = np.einsum("rtk,tk->rt", across, c - a) / det
        v = -np.einsum("rtk,tk->rt", across, b - a) / det
    return t, np.minimum(np.minimum(u, v), 1.0 - u - v)


RAYS = {
    "spread": lambda rng, n: rng.normal(size=(n, 3)),
    "alike": lambda rng, n: np.array([0.2, -0.5, 0.8]) + 0.05 * rng.normal(size=(n, 3)),
    "along an axis": lambda rng, n: np.eye(3)[rng.integers(0, 3, n)] * rng.choice([-1.0, 1.0], (n, 1)),
    "in a plane": lambda rng, n: rng.normal(size=(n, 3)) * (np.arange(3) != rng.integers(0, 3, (n, 1))),
}


@pytest.mark.parametrize("kind", RAYS)
def test_packets_meet_what_all_triangles_asked_one_by_one_say(kind):
    """Fails where the layout of Warp's tree is not the one that packets walk down."""
    rng = np.random.default_rng(3)
    triangle_count, n = 700, 1500
    middle = rng.uniform(-2, 2, (triangle_count, 1, 3))
    points = (middle + rng.normal(size=(triangle_count, 3, 3)) * 0.2).reshape(-1, 3)
    triangles = np.arange(3 * triangle_count).reshape(-1, 3)
    origins = rng.uniform(-2, 2, (n, 3))
    d = RAYS[kind](rng, n)
    d = np.float32(d / np.linalg.norm(d, axis=1, keepdims=True))
    reach = rng.choice([0.5, 1.5, FAR], n)
    t, inside = one_by_one(points, triangles, origins, d)
    met = (inside > 0) & (t > 0) & (t < reach[:, None])
    # Rays that pass a border, or end at a triangle, by less than the digits of float32 may go either way.
    near = np.abs(inside) < 1e-4
    sure = ~((np.abs(t) < 1e-4) | (np.abs(t - reach[:, None]) < 1e-4)).any(axis=1) & ~(near & (t > 0)).any(axis=1)
    assert sure.mean() > 0.8 and 0.1 < met[sure].any(axis=1).mean() < 0.95
    first = np.where(met, t, np.inf)
    face = np.where(met.any(axis=1), first.argmin(axis=1), -1)
    for leaf_size in (1, 4):
        _, got = answers(points, triangles, origins, d, reach, leaf_size=leaf_size)
        np.testing.assert_array_equal(got[0][sure] != 0, met[sure].any(axis=1))
        np.testing.assert_array_equal(got[1][sure], face[sure])
        hit = sure & (face >= 0)
        np.testing.assert_allclose(got[2][hit], first.min(axis=1)[hit], rtol=1e-4, atol=1e-5)


def grid_of(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of n x n squares, two triangles each, with whole coordinates: every edge is met exactly."""
    x, z = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    points = np.stack([x, np.zeros_like(x), z], -1).reshape(-1, 3)
    at = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1)
    triangles = np.concatenate([np.stack([at, at + n + 1, at + 1], -1), np.stack([at + 1, at + n + 1, at + n + 2], -1)])
    return points.astype(np.float64), triangles


def hard_case(name: str, rng) -> tuple[np.ndarray, ...]:
    points, triangles = grid_of(12)
    n = 4000
    at = rng.uniform(0, 12, (n, 3)) * (1, 0, 1)
    if name == "edges and corners":
        at = np.round(at * 2) / 2
    elif name == "two sheets in one plane":
        points = np.concatenate([points, points])
        triangles = np.concatenate([triangles, triangles + len(points) // 2])
    elif name == "a soup of slivers":
        points = points + rng.normal(size=points.shape) * (0.5, 1e-4, 0.5)
    elif name == "no area":
        triangles[::2, 1] = triangles[::2, 0]
    elif name == "far from the origin":
        points, at = points + 1.0e4, at + 1.0e4
    origins = at + rng.normal(size=(n, 3)) * (2, 0, 2) + (0, 3, 0)
    if name == "from the surface":
        origins = at + (0, 1e-6, 0)
    d = at - origins + rng.normal(size=(n, 3)) * (name == "from the surface")
    if name == "straight down":
        origins, d = at + (0, 3, 0), np.broadcast_to((0.0, -1.0, 0.0), (n, 3))
    return points, triangles, origins, d / np.linalg.norm(d, axis=1, keepdims=True)


CASES = {
    "edges and corners": 0.1,
    "straight down": 0.0,
    "two sheets in one plane": 0.2,
    "a soup of slivers": 1e-3,
    "no area": 1e-3,
    "far from the origin": 1e-3,
    "from the surface": 1e-3,
}


@pytest.mark.parametrize("case", CASES)
def test_packets_answer_as_warp_does_ray_by_ray(case):
    """What is met at all, bit for bit, and how far; another face only where two are met at the same distance."""
    points, triangles, origins, d = hard_case(case, np.random.default_rng(7))
    own, packed = answers(points, triangles, origins, d)
    assert own[0].any()
    np.testing.assert_array_equal(packed[0], own[0])
    np.testing.assert_array_equal(packed[1] >= 0, own[1] >= 0)
    other = packed[1] != own[1]
    assert other.mean() <= CASES[case]
    np.testing.assert_allclose(packed[2], own[2], rtol=1e-5, atol=1e-6)
    for k in (2, 3, 4):
        np.testing.assert_array_equal(packed[k][~other], own[k][~other])
    for k, again in enumerate(answers(points, triangles, origins, d, threads=2)[1]):
        np.testing.assert_array_equal(packed[k], again)


@pytest.mark.parametrize("spread", (0.02, 0.6))
@pytest.mark.parametrize("offset", (0.0, 300.0))
def test_rays_that_come_together_at_a_light_meet_what_warp_says(spread, offset):
    """What lies without the hull of where they start and end is left out; blocks with flat sides, and of any octant."""
    rng = np.random.default_rng(11)
    middle = rng.uniform(-2, 2, (3000, 1, 3))
    points = (middle + rng.normal(size=(3000, 3, 3)) * 0.05).reshape(-1, 3)
    points = np.concatenate([points, grid_of(12)[0] * 0.3 - 2.0])
    triangles = np.concatenate([np.arange(9000).reshape(-1, 3), 9000 + grid_of(12)[1]])
    blocks = 120
    origins = rng.uniform(-2, 2, (blocks, 1, 3)) + rng.normal(size=(blocks, vector.BLOCK, 3)) * spread
    origins[::3, :, 1] = -2.0 + 1e-5
    ends = np.array([0.1, 1.3, -0.2]) + rng.uniform(-0.1, 0.1, origins.shape)
    d = (ends - origins).reshape(-1, 3)
    reach = np.linalg.norm(d, axis=1)
    origins = np.float32(origins.reshape(-1, 3) + offset)
    own, packed = answers(points + offset, triangles, origins, d / reach[:, None], 0.999 * reach)
    assert 0.2 < own[0].mean() < 0.8
    np.testing.assert_array_equal(packed[0], own[0])


def test_nothing_is_met_in_a_tree_of_points():
    """Shrunk triangles, as a scene's structure has them for what casts no shadow."""
    points, triangles = grid_of(3)
    triangles = np.repeat(triangles[:, :1], 3, axis=1)
    origins = np.float32([[0.5, 1.0, 0.5], [1.0, 1.0, 1.0]])
    down = np.float32([[0, -1, 0], [0, -1, 0]])
    own, packed = answers(points, triangles, origins, down)
    assert not own[0].any() and not packed[0].any() and (packed[1] == -1).all()


def test_a_tree_that_was_fitted_to_moved_points_answers_as_warps():
    rng = np.random.default_rng(5)
    points, triangles = grid_of(9)
    mesh = wp.Mesh(
        wp.array(np.float32(points), dtype=wp.vec3, device=CPU),
        wp.array(np.int32(triangles).reshape(-1), dtype=int, device=CPU),
        bvh_constructor="sah",
    )
    wide = WideTree(mesh)
    mesh.points.assign(np.float32(points + rng.normal(size=points.shape) * 0.3 + (5.0, 0.0, 0.0)))
    mesh.refit()
    wide.fit()
    origins = rng.uniform((5, 3, 0), (14, 4, 9), (500, 3))
    rays = [wp.array(np.float32(origins), dtype=wp.vec3, device=CPU)]
    down = np.float32(rng.normal(size=(500, 3)) * 0.2 + (0, -1, 0))
    rays += [wp.array(down, dtype=wp.vec3, device=CPU), wp.full(500, FAR, dtype=float, device=CPU)]
    found = []
    for launched, kernel, tree in ((launch, query_kernel, mesh), (vector.launch_blocks, query_blocks_kernel, wide)):
        outputs = [wp.zeros(500, dtype=kind, device=CPU) for kind in (int, int, float, float, float)]
        launched(kernel, 500, [wp.uint64(tree.id), *rays, *outputs], CPU, 1)
        found.append([output.numpy() for output in outputs])
    assert found[0][0].mean() > 0.5
    for got, expected in zip(found[1], found[0], strict=True):
        np.testing.assert_array_equal(got, expected)


LIGHTS = [
    distant((1, 1, 1), (0.35, 1.0, 0.1)),
    distant((1, 1, 1), (0.0, 1.0, 0.0)),
    LightData("/rect", "rect", (3, 1, 1), turned(-1.4, 0.4, (0.3, 2.0, 0.2)), size=(1.2, 0.8)),
    LightData("/disk", "disk", (1, 3, 1), turned(-1.5, 0.4, (-1.2, 2.0, 0.2)), size=(0.4,)),
    LightData("/sphere", "sphere", (1, 1, 3), turned(0, 0, (0.3, 2.2, -0.2)), size=(0.5,)),
    LightData("/cylinder", "cylinder", (2, 2, 1), turned(0, 0.4, (0.3, 2.0, 0.9)), size=(1.4, 0.04)),
    LightData("/around", "sphere", (1, 1, 1), place(0, 0.0, 0), size=(0.5,)),
    dome(),
]


def lit_balls(material=WHITE):
    balls = [(ball_mesh(), place(0, 0.8, 0, 0.5), material), (ball_mesh(), place(1, 0.5, 1, 0.4), WHITE)]
    scene = scene_of([(ground(), place(), WHITE), *balls], LIGHTS)
    return scene, look_at((0, 3.0, 4.0), (0, 0.3, 0), fov=50, size=(67, 43))


@pytest.mark.parametrize("asked", ["all", "some", "in no order"])
@pytest.mark.parametrize("convex", [True, False])
def test_pixels_are_asked_in_tiles_each_once_as_one_by_one(asked, convex):
    """Pixels with gaps, or a choice of them; rays that start on their own body, beside it, and under the open sky."""
    rng = np.random.default_rng(6)
    scene, _ = lit_balls(MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0))
    camera = look_at((0, 1.2, 2.0), (0, 0.8, 0), fov=50, size=(161, 90))
    gbuffer = raster.draw_scene(scene, camera)
    pixels = surface.mirror_pixels(scene, gbuffer, {1: 1})[0][1]
    some = np.flatnonzero(rng.random(pixels.count) < 0.8).astype(np.int32)
    pixels = pixels.select(wp.array(some, dtype=int, device=pixels.pixel.device), 1, camera.size[0])
    index = {
        "all": None,
        "some": np.flatnonzero(rng.random(pixels.count) < 0.3),
        "in no order": rng.permutation(pixels.count)[: pixels.count // 2],
    }[asked]
    index = None if index is None else wp.array(index, dtype=int, device=CPU)
    found = []
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2), ("vector", 8)):
        layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, CPU)
        how = {"kernels": kernels, "threads": threads}
        count = bvh.trace_pixels(scene, gbuffer, pixels, layer, 1, convex, index, **how)
        assert count == (pixels.count if index is None else len(index))
        found.append([getattr(layer, name).numpy() for name in ("triangle", "u", "v", "distance", "status")])
    status = found[0][-1]
    assert pixels.count > 2000 and {Status.CONVERGED, Status.SKY} <= set(status)
    for other in found[1:]:
        for got, expected in zip(other, found[0], strict=True):
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("trees", [1, 2])
@pytest.mark.parametrize("convex", [True, False])
def test_mirrors_are_traced_together_as_one_by_one(convex, trees, monkeypatch):
    """One in front of the other; the last pixel of the first is beside the first of the second."""
    scene, _ = lit_balls()
    tracers = [bvh.Tracer(scene) for _ in range(trees)]
    monkeypatch.setattr(scene, "mirror_tracer", lambda part: tracers[part % trees])
    camera = look_at((1.3, 1.2, 3.0), (0.5, 0.6, 0.3), fov=50, size=(161, 90))
    gbuffer = raster.draw_scene(scene, camera)
    seen = surface.mirror_pixels(scene, gbuffer, {1: 1, 2: 2})[0]
    first, second = (seen[id].pixel.numpy() for id in (1, 2))
    (beside,) = np.flatnonzero(np.isin(first + 1, second))[:1]
    some = [np.flatnonzero(first <= first[beside]), len(first) + np.flatnonzero(second > first[beside])]
    arrays = (getattr(seen[1].whole, name) for name in ("pixel", "point", "normal", "direction"))
    chosen = wp.array(np.concatenate(some).astype(np.int32), dtype=int, device=CPU)
    whole = MirrorPixels(0, *(compact.taken(array, chosen) for array in arrays), (0, 0, *camera.size))
    edges = 0, len(some[0]), len(chosen)
    pixels = [whole.part(k + 1, edges[k], edges[k + 1], whole.box) for k in range(2)]
    assert pixels[1].follows(pixels[0]) and min(each.count for each in pixels) > 300
    bodies = bounces.Mirrors(scene, [Reflector(1, 1, convex), Reflector(2, 2, convex)]).bodies
    names = ("triangle", "u", "v", "distance", "status")
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2), ("vector", 8)):
        together = ReflectionLayer.empty(MirrorPixels.joined(pixels), Technique.RAYTRACED, CPU)
        parts = together.parts(pixels)
        bvh.trace_together(scene, gbuffer, parts, [(1, convex), (2, convex)], bodies, threads, kernels)
        for own, part in zip(pixels, parts, strict=True):
            alone = ReflectionLayer.empty(own, Technique.RAYTRACED, CPU)
            bvh.trace_pixels(scene, gbuffer, own, alone, own.reflector, convex, threads=threads, kernels=kernels)
            for name in names:
                np.testing.assert_array_equal(getattr(part, name).numpy(), getattr(alone, name).numpy(), err_msg=name)
        assert {Status.CONVERGED, Status.SKY} <= set(together.status.numpy())


@pytest.mark.parametrize("width", [0, 70])
def test_rays_through_a_body_are_followed_as_one_by_one(width):
    """From its facets inwards and outwards, from points that lie a little off them."""
    rng = np.random.default_rng(8)
    scene, _ = lit_balls()
    own, n = scene.parts[1], 3000
    facet = rng.integers(own.first_triangle, own.first_triangle + own.triangle_count, n)
    a, b, c = np.moveaxis(scene.host_points[scene.host_triangles[facet]].astype(np.float64), 1, 0)
    u, v = np.sort(rng.random((2, n, 1)), axis=0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = rng.random(n) < 0.5
    normal[inside] *= -1.0
    direction = rng.normal(size=(n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction *= np.where((direction * normal).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    point = u * a + (v - u) * b + (1.0 - v) * c + rng.choice([-1e-3, 0.0, 1e-3], (n, 1)) * normal
    vectors = [wp.array(np.float32(each), dtype=wp.vec3, device=CPU) for each in (point, normal, direction)]
    pixels = MirrorPixels(1, wp.array(np.arange(n), dtype=int, device=CPU), *vectors, (0, 0, 1, 1))
    start = [wp.array(facet, dtype=int, device=CPU), wp.array(inside, dtype=wp.uint8, device=CPU)]
    some = wp.array(np.flatnonzero(rng.random(n) < 0.3), dtype=int, device=CPU)
    for index in (None, some):
        found = []
        for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
            layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, CPU)
            bvh.trace_transmitted(scene, layer, *start, threads, index, kernels, width)
            found.append([getattr(layer, name).numpy() for name in ("triangle", "u", "v", "distance", "status")])
        assert {Status.CONVERGED, Status.SKY} <= set(found[0][-1]) and (
            (found[0][0] != facet) | (found[0][0] < 0)
        ).all()
        for other in found[1:]:
            for got, expected in zip(other, found[0], strict=True):
                np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("samples", [1, 5, 16, 40])
def test_shadows_are_found_bit_for_bit_as_the_plain_kernels_find_them(samples):
    scene, camera = lit_balls()
    points = direct.points_of(scene, raster.draw_scene(scene, camera))
    every = shadows.every_shadow(scene, samples)
    some = shadows.Shadows((False, True), (True, False, True, False, True), samples=samples)
    shared = shadows.Shadows(every.distant, every.areas, samples=samples, shared=True)
    sky = shadows.sky_share(scene, points, samples, 1, kernels="plain").numpy()
    assert 0.0 < sky.mean() < 1.0
    for cast in (every, some, shared):
        plain = shadows.shadowed_irradiance(scene, points, cast, 1, kernels="plain").numpy()
        assert plain.any()
        for threads in (1, 2):
            got = shadows.shadowed_irradiance(scene, points, cast, threads, kernels="vector").numpy()
            np.testing.assert_array_equal(got, plain)
    for threads in (1, 2):
        got = shadows.sky_share(scene, points, samples, threads, kernels="vector").numpy()
        np.testing.assert_array_equal(got, sky)


@pytest.mark.parametrize("size", [(96, 64), (90, 50)])
@pytest.mark.parametrize("order", ["rows", "two lists", "any"])
def test_shadows_of_some_pixels_are_those_of_plain_kernels_in_whatever_order_they_are_listed(size, order):
    """In tiles of a picture, or not; points of a row that stand in two lists, or anywhere, do not follow each other."""
    scene, camera = lit_balls()
    gbuffer = raster.draw_scene(scene, look_at(camera.eye, (0, 0.6, 0), fov=50, size=size))
    rng = np.random.default_rng(4)
    some = np.flatnonzero(rng.random(size[0] * size[1]) < 0.7).astype(np.int32)
    if order == "two lists":
        second = rng.random(len(some)) < 0.4
        some = np.concatenate([some[~second], some[second]])
    elif order == "any":
        some = rng.permutation(some)
    points = direct.points_of(scene, gbuffer, chosen=some)
    every = shadows.every_shadow(scene, 16)
    for shared in (False, True):
        cast = shadows.Shadows(every.distant, every.areas, samples=16, shared=shared)
        plain = shadows.shadowed_irradiance(scene, points, cast, 1, kernels="plain").numpy()
        assert plain.any()
        for threads in (1, 2, 8):
            got = shadows.shadowed_irradiance(scene, points, cast, threads, kernels="vector").numpy()
            np.testing.assert_array_equal(got, plain)


def test_distant_lights_alone_ask_for_starts_that_were_left_as_rays_to_shapes_had_them():
    """Their rays need fewer rows, in memory that another picture's rays have filled."""
    balls = [(ball_mesh(), place(0, 0.8, 0, 0.5), WHITE), (ball_mesh(), place(1, 0.5, 1, 0.4), WHITE)]
    scene = scene_of([(ground(), place(), WHITE), *balls], LIGHTS[:2])
    points = direct.points_of(
        scene, raster.draw_scene(scene, look_at((0, 3.0, 4.0), (0, 0.3, 0), fov=50, size=(96, 64)))
    )
    cast = shadows.every_shadow(scene)
    plain = shadows.shadowed_irradiance(scene, points, cast, 1, kernels="plain").numpy()
    assert plain.any() and (plain == 0.0).any()
    for _ in range(2):
        got = shadows.shadowed_irradiance(scene, points, cast, 1, kernels="vector").numpy()
        np.testing.assert_array_equal(got, plain)
        shadows.sky_share(scene, points, 4, 1, kernels="vector")


def test_lights_are_tried_one_by_one_bit_for_bit_as_the_plain_kernel_tries_them():
    scene, _ = lit_balls()
    camera = look_at((0, 1.0, 4.0), (0, 0.8, 0), fov=60, size=(67, 43))
    points = direct.points_of(scene, raster.draw_scene(scene, camera))
    plain = shadows.light_shares(scene, points, 16, 1, kernels="plain")
    assert 0.1 < plain[2].mean() < 0.95 and (points.triangle.numpy() < 0).any()
    for threads in (1, 2):
        for got, expected in zip(
            shadows.light_shares(scene, points, 16, threads, kernels="vector"), plain, strict=True
        ):
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize("method", ["raytraced", "auto"])
def test_mirrors_show_the_same_points_whichever_kernels_follow_their_rays(method):
    """A concave mirror whose rays go on past its own facets, and mirrors that see each other."""
    silver = MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    inside_out = ball_mesh()
    placed = [(ground(), place(), WHITE), (ball_mesh(), place(0.8, 0.6, 0, 0.5), silver)]
    placed += [(inside_out, place(0, 1.0, -1, 3.0), silver), (ball_mesh(), place(-0.8, 0.5, 1, 0.4), WHITE)]
    scene = scene_of(placed, LIGHTS[:1])
    camera = look_at((0, 1.2, 1.5), (0, 0.6, 0), fov=60, size=(120, 80))
    layers = []
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
        settings = wr.Settings(kernels=kernels, threads=threads, shadows=False, bounces=2)
        plan = wr.make_plan(scene, camera, size=camera.size, settings=settings, method=method)
        frame = wr.render_frame(scene, plan)
        found = [frame[name] for name in ("reflectedId", "reflectedPoint", "pathLength", "status", "RGBA")]
        layers.append(found)
    assert (layers[0][0] > 0).sum() > 2000
    for other in layers[1:]:
        for got, expected in zip(other, layers[0], strict=True):
            np.testing.assert_array_equal(got, expected)


def test_a_mirror_shows_the_same_shadows_bit_for_bit():
    """What a mirror shows are points of some pixels only."""
    scene, camera = lit_balls(MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0))
    frames = []
    for kernels in ("plain", "vector"):
        settings = wr.Settings(kernels=kernels, shadows=True, dome_shadows=True, threads=1)
        plan = wr.make_plan(scene, camera, size=camera.size, settings=settings)
        assert plan.shadows.direct and plan.rows
        frames.append(wr.render_frame(scene, plan)["reflection"])
    assert frames[0].any()
    np.testing.assert_array_equal(*frames)
