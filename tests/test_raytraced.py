"""Rays against triangles, the BVH, the surface at a pixel and the reference technique.

Oracles: float64 NumPy written here (every triangle is tried), closed forms on quadrics, and Embree.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from warp_reflect import bvh, raster, surface
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.scene import (
    InstanceData,
    MaterialData,
    MeshData,
    Part,
    Patch,
    Scene,
    SceneData,
    Shape,
)
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.shapes import facet_normal, intersect_triangle, unit
from warp_reflect.techniques import raytraced

wp.set_module_options({"enable_backward": False})
DEVICE = "cpu"
SPHERE = Shape("quadric", np.eye(4), 1.0, 0.0, 1.0)
CYLINDER = Shape("quadric", np.eye(4), 0.0, 0.0, 1.0)
CONE = Shape("quadric", np.eye(4), -1.0, 0.0, 0.0)


def mesh_of(points, triangles, shape=None, normals=None) -> MeshData:
    triangles = np.asarray(triangles, np.int32)
    return MeshData(
        points=np.asarray(points, np.float32),
        triangles=triangles,
        normals=None if normals is None else np.asarray(normals, np.float32),
        parts=[Part(0, len(triangles), "", (Patch(0, len(triangles), shape),))],
    )


def scene_of(*placed) -> Scene:
    """A scene of (mesh, world_from_object) pairs, one material each."""
    return Scene(
        SceneData(
            "test",
            [mesh for mesh, _ in placed],
            [InstanceData(i, np.asarray(m, float), f"/p{i}", (i,)) for i, (_, m) in enumerate(placed)],
            [MaterialData() for _ in placed],
            [],
            [],
        ),
        DEVICE,
    )


def place(x=0.0, y=0.0, z=0.0, scale=1.0) -> np.ndarray:
    m = np.diag([scale, scale, scale, 1.0])
    m[:3, 3] = (x, y, z)
    return m


def look_at(eye, target, size=(64, 48), fov=60.0, orthographic=False) -> Camera:
    eye = np.asarray(eye, float)
    forward = np.asarray(target, float) - eye
    distance = np.linalg.norm(forward)
    forward /= distance
    right = np.cross(forward, [0.1, 1.0, 0.05])
    right /= np.linalg.norm(right)
    width, height = size
    focal = width / (2 * np.tan(np.radians(fov) / 2))
    if orthographic:
        focal /= distance
    return Camera(
        eye=eye,
        right=right,
        up=np.cross(right, forward),
        forward=forward,
        fx=focal,
        fy=focal,
        cx=width / 2,
        cy=height / 2,
        near=1e-3 * distance,
        far=1e3 * distance,
        size=size,
        orthographic=orthographic,
    )


def brute_force(points, triangles, origins, directions):
    """Nearest hit of every ray over all triangles in float64: (triangle, t, weights [n, 3], margin [n]).

    `margin` is the least |weight| over every triangle that the ray meets or nearly meets: where it is tiny,
    rounding may decide either way.
    """
    v0, v1, v2 = (points[triangles[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(v1 - v0, v2 - v0)
    best = np.full(len(origins), -1)
    distance = np.full(len(origins), np.inf)
    weights = np.zeros((len(origins), 3))
    margin = np.full(len(origins), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, (o, d) in enumerate(zip(origins.astype(np.float64), directions.astype(np.float64), strict=True)):
            t = np.einsum("ij,ij->i", v0 - o, n) / (n @ d)
            p = o + t[:, None] * d
            area = np.einsum("ij,ij->i", n, n)
            w = np.stack(
                [
                    np.einsum("ij,ij->i", np.cross(v2 - v1, p - v1), n),
                    np.einsum("ij,ij->i", np.cross(v0 - v2, p - v2), n),
                    np.einsum("ij,ij->i", np.cross(v1 - v0, p - v0), n),
                ],
                axis=1,
            )
            w /= area[:, None]
            valid = np.isfinite(t) & (t > 0)
            near = valid & (w.min(axis=1) > -1e-3)
            if near.any():
                margin[i] = np.abs(w[near]).min()
            hit = valid & (w.min(axis=1) >= 0.0)
            if hit.any():
                k = np.flatnonzero(hit)[np.argmin(t[hit])]
                best[i], distance[i], weights[i] = k, t[k], w[k]
    return best, distance, weights, margin


def random_rays(rng, n, centre, radius):
    origins = centre + rng.uniform(-radius, radius, (n, 3))
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def soup(rng, count):
    """Random triangles of edge about 0.3 in the unit box."""
    corner = rng.uniform(-1, 1, (count, 1, 3))
    points = (corner + rng.uniform(-0.15, 0.15, (count, 3, 3))).reshape(-1, 3)
    return points, np.arange(3 * count).reshape(-1, 3)


# Device functions.


@wp.kernel
def intersect_kernel(
    origin: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    a: wp.array(dtype=wp.vec3),
    b: wp.array(dtype=wp.vec3),
    c: wp.array(dtype=wp.vec3),
    out_hit: wp.array(dtype=int),
    out_t: wp.array(dtype=float),
    out_weights: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    hit = intersect_triangle(origin[i], direction[i], a[i], b[i], c[i])
    out_hit[i] = hit.hit
    out_t[i] = hit.t
    out_weights[i] = wp.vec3(hit.w, hit.u, hit.v)


def intersect(origin, direction, a, b, c):
    arrays = [wp.array(np.asarray(x, np.float32), dtype=wp.vec3, device=DEVICE) for x in (origin, direction, a, b, c)]
    n = len(origin)
    hit = wp.zeros(n, dtype=int, device=DEVICE)
    t = wp.zeros(n, dtype=float, device=DEVICE)
    weights = wp.zeros(n, dtype=wp.vec3, device=DEVICE)
    wp.launch(intersect_kernel, dim=n, inputs=[*arrays, hit, t, weights], device=DEVICE)
    return hit.numpy(), t.numpy(), weights.numpy()


@pytest.mark.parametrize("seed", range(3))
def test_intersect_triangle_matches_float64_over_scales(seed):
    rng = np.random.default_rng(seed)
    n = 3000
    scale = 10.0 ** rng.uniform(-6, 6, (n, 1))
    a, b, c = (np.float32(scale * rng.normal(size=(n, 3))) for _ in range(3))
    inside = rng.dirichlet([1, 1, 1], n) * 3.0 - 2.0 / 3.0  # also well outside
    p = inside[:, :1] * a + inside[:, 1:2] * b + inside[:, 2:] * c
    direction = np.float32(rng.normal(size=(n, 3)))
    origin = np.float32(p - rng.uniform(0.5, 2.0, (n, 1)) * scale * direction)

    normal = np.cross(b.astype(float) - a, c.astype(float) - a)
    length = np.linalg.norm(normal, axis=1)
    cosine = np.abs(np.einsum("ij,ij->i", normal, direction)) / (length * np.linalg.norm(direction, axis=1))
    fair = (cosine > 0.1) & (length > 0.1 * scale[:, 0] ** 2)
    t = np.einsum("ij,ij->i", a - origin.astype(float), normal) / np.einsum("ij,ij->i", direction, normal)
    q = origin + t[:, None] * direction.astype(float)
    area = length**2
    want = np.stack(
        [
            np.einsum("ij,ij->i", np.cross(c.astype(float) - b, q - b), normal) / area,
            np.einsum("ij,ij->i", np.cross(a.astype(float) - c, q - c), normal) / area,
            np.einsum("ij,ij->i", np.cross(b.astype(float) - a, q - a), normal) / area,
        ],
        axis=1,
    )
    hit, got_t, weights = intersect(origin, direction, a, b, c)
    assert fair.sum() > 1000
    # 5e-5: rounding of coordinates up to 10 edges away, seen at a cosine down to 0.1.
    np.testing.assert_allclose(weights[fair], want[fair], atol=5e-5)
    np.testing.assert_allclose(got_t[fair], t[fair], rtol=5e-5, atol=5e-5)
    clear = fair & (np.abs(want).min(axis=1) > 1e-3)
    np.testing.assert_array_equal(hit[clear] == 1, (want.min(axis=1) > 0)[clear])


@pytest.mark.parametrize("offset", [0.0, 148376.0])
def test_intersect_triangle_never_leaks_at_a_shared_edge(offset):
    rng = np.random.default_rng(7)
    n = 100_000
    a, b, c, d = (np.float32(rng.normal(size=(n, 3)) + offset) for _ in range(4))
    # Both triangles hang on the edge ab, on its two sides as seen along the ray.
    s = rng.uniform(0, 1, (n, 1))
    target = s * a + (1 - s) * b
    direction = np.float32(rng.normal(size=(n, 3)))
    origin = np.float32(target - 2.0 * direction)
    side_c = np.einsum("ij,ij->i", np.cross((b - a).astype(float), c - a), direction)
    side_d = np.einsum("ij,ij->i", np.cross((b - a).astype(float), d - a), direction)
    opposite = (side_c * side_d < 0) & (s[:, 0] > 0.05) & (s[:, 0] < 0.95)
    one, _, w1 = intersect(origin, direction, a, b, c)
    two, _, w2 = intersect(origin, direction, b, a, d)
    # Only the shared edge is at stake: the other two weights must be clear of zero.
    clear = opposite & (w1[:, :2].min(axis=1) > 0.01) & (w2[:, :2].min(axis=1) > 0.01)
    assert clear.sum() > 20_000
    assert np.all((one + two)[clear] >= 1)


def test_unit_and_facet_normal_hold_at_every_scale():
    for scale in (1e-30, 1e-20, 1e-12, 1.0, 1e12, 1e20, 1e30):
        np.testing.assert_allclose(unit(wp.vec3(2 * scale, 0.0, -scale)), np.array([2, 0, -1]) / np.sqrt(5), rtol=1e-6)
        n = facet_normal(wp.vec3(0.0, 0.0, 0.0), wp.vec3(scale, 0.0, 0.0), wp.vec3(0.0, scale, scale))
        np.testing.assert_allclose(n, np.array([0, -1, 1]) / np.sqrt(2), atol=1e-6)
    assert list(unit(wp.vec3(0.0, 0.0, 0.0))) == [0.0, 0.0, 0.0]
    assert list(facet_normal(wp.vec3(1.0, 1.0, 1.0), wp.vec3(2.0, 2.0, 2.0), wp.vec3(3.0, 3.0, 3.0))) == [0.0] * 3


# The tracer.


def test_finite_flags_repeat_warps_default():
    assert bvh.FINITE_FLAGS.startswith(wp.config.cpu_compiler_flags)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_trace_matches_brute_force(scale):
    rng = np.random.default_rng(3)
    points, triangles = soup(rng, 1200)
    scene = scene_of((mesh_of(points, triangles), place(scale=scale)))
    origins, directions = random_rays(rng, 1500, 0.0, 1.2 * scale)
    directions[:30] = np.eye(3, dtype=np.float32)[np.arange(30) % 3]  # along the axes
    want, t, weights, margin = brute_force(scene.host_points, scene.host_triangles, origins, directions)
    triangle, got_t, u, v = (x.numpy() for x in scene.tracer.trace(origins, directions))
    clear = margin > 1e-4
    hit = clear & (want >= 0)
    assert hit.sum() > 500 and (clear & (want < 0)).sum() > 100
    np.testing.assert_array_equal(triangle[clear], want[clear])
    # Rounding of coordinates about one scale away, seen at grazing incidence.
    np.testing.assert_allclose(got_t[hit], t[hit], rtol=1e-4, atol=1e-5 * scale)
    got_p = origins[hit] + got_t[hit, None].astype(float) * directions[hit]
    corner = scene.host_points[scene.host_triangles[triangle[hit]]].astype(float)
    w = np.stack([1.0 - u[hit] - v[hit], u[hit], v[hit]], axis=1)
    assert w.min() >= -1e-6
    np.testing.assert_allclose(np.einsum("ij,ijk->ik", w, corner), got_p, atol=2e-6 * scale)
    np.testing.assert_allclose(w, weights[hit], atol=2e-3)


@pytest.mark.parametrize("threads", [1, 2])
def test_trace_matches_embree(threads):
    rng = np.random.default_rng(11)
    ball = trimesh.creation.icosphere(4, radius=0.6)
    torus = trimesh.creation.torus(1.0, 0.3)
    room = trimesh.creation.box((6, 6, 6))
    scene = scene_of(*((mesh_of(m.vertices, m.faces), place(x)) for x, m in ((0.5, ball), (-0.7, torus), (0, room))))
    origins, directions = random_rays(rng, 20_000, 0.0, 2.5)
    embree = rtcore_scene.EmbreeScene()
    TriangleMesh(embree, scene.host_points, scene.host_triangles)
    answer = embree.run(origins, directions, output=True)
    triangle, t, _, _ = (x.numpy() for x in scene.tracer.trace(origins, directions, threads))
    same = triangle == answer["primID"]
    # The rest lies on shared edges, where either neighbour is right.
    assert same.mean() > 0.9995
    np.testing.assert_allclose(t, answer["tfar"], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("offset", [0.0, 1e3, 148376.0, 1e6])
def test_trace_is_watertight_at_vertices_and_edges(offset):
    rng = np.random.default_rng(5)
    ball = trimesh.creation.uv_sphere(radius=10.0, count=[48, 96])
    # Two far clusters hold the scene's origin away from the sphere, so that its coordinates are large indeed.
    anchor = mesh_of([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    centre = np.array([offset, 0.1 * offset, -offset])
    scene = scene_of(
        (mesh_of(ball.vertices, ball.faces), place(*centre)),
        (anchor, place(-50.0)),
        (anchor, place(-51.0)),
    )
    body = scene.parts[0]
    points = scene.host_points[: body.vertex_count].astype(np.float64)
    triangles = scene.host_triangles[: body.triangle_count]
    n = 200_000
    origins = (points.mean(axis=0) + rng.uniform(-3, 3, (n, 3))).astype(np.float32)
    s = rng.uniform(0, 1, (n // 2, 1))
    edge = triangles[rng.integers(0, len(triangles), n // 2)]
    targets = np.concatenate(
        [points[rng.integers(0, len(points), n // 2)], s * points[edge[:, 0]] + (1 - s) * points[edge[:, 1]]]
    )
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    triangle = scene.tracer.trace(origins, directions)[0].numpy()
    # 2e-5 is Embree's own bound (its WatertightTest).
    assert (triangle < 0).sum() <= 2e-5 * n


def test_trace_of_an_empty_scene_is_all_sky():
    scene = scene_of()
    triangle, t, _, _ = scene.tracer.trace(np.zeros((5, 3)), np.eye(3)[[0, 1, 2, 0, 1]])
    assert scene.tracer.id == 0
    assert np.all(triangle.numpy() == -1) and np.all(t.numpy() == 0.0)


def test_refit_follows_moved_points():
    scene = scene_of((mesh_of([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], [[0, 1, 2]]), place()))
    ray = (np.array([[0.0, 0.0, 5.0]]) - scene.origin, np.array([[0.0, 0.0, -1.0]]))
    assert scene.tracer.trace(*ray)[1].numpy()[0] == pytest.approx(5.0)
    moved = scene.host_points + np.float32([0, 0, 2])
    scene.view.points.assign(moved)
    scene.tracer.refit()
    assert scene.tracer.trace(*ray)[1].numpy()[0] == pytest.approx(3.0)


# The surface at a pixel.


def unit_quadric_mesh(kind):
    """(mesh, f, gradient) of a tessellated gprim, its vertices on the surface, wound outwards."""
    if kind == "sphere":
        m = trimesh.creation.icosphere(3)
        return mesh_of(m.vertices, m.faces, SPHERE), SPHERE
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(32)
    low, high = (1.0, 1.0) if kind == "cylinder" else (1.0, 0.2)
    z0, z1 = (-1.0, 1.0) if kind == "cylinder" else (-1.0, -0.2)
    points = np.concatenate([np.c_[ring * low, np.full(32, z0)], np.c_[ring * high, np.full(32, z1)]])
    nxt = (k + 1) % 32
    triangles = np.concatenate([np.c_[k, nxt, 32 + nxt], np.c_[k, 32 + nxt, 32 + k]])
    shape = CYLINDER if kind == "cylinder" else CONE
    return mesh_of(points, triangles, shape), shape


def quadric_hit(shape, unit_from_world, origin, direction, near):
    """Root nearest to `near` of the quadric along world rays, float64: (t, world normals not oriented)."""
    o = origin @ unit_from_world[:3, :3].T + unit_from_world[:3, 3]
    d = direction @ unit_from_world[:3, :3].T
    k = np.array([1.0, 1.0, shape.a])
    qa, qb = (k * d * d).sum(1), (k * o * d).sum(1) + 0.5 * shape.b * d[:, 2]
    qc = (k * o * o).sum(1) + shape.b * o[:, 2] - shape.c
    root = np.sqrt(np.maximum(qb**2 - qa * qc, 0.0))
    roots = np.stack([(-qb - root) / qa, (-qb + root) / qa])
    t = np.take_along_axis(roots, np.abs(roots - near).argmin(axis=0)[None], axis=0)[0]
    p = o + t[:, None] * d
    g = (k * p + 0.5 * shape.b * np.array([0, 0, 1.0])) @ unit_from_world[:3, :3]
    return t, g / np.linalg.norm(g, axis=1, keepdims=True)


def eye_rays(camera: Camera, pixel):
    x, y = pixel % camera.size[0] + 0.5, pixel // camera.size[0] + 0.5
    dx = ((x - camera.cx) / camera.fx)[:, None] * camera.right
    dy = ((y - camera.cy) / camera.fy)[:, None] * camera.up
    if camera.orthographic:
        d = np.broadcast_to(camera.forward, (len(pixel), 3))
        return camera.eye + dx - dy, d
    d = camera.forward + dx - dy
    return np.broadcast_to(camera.eye, d.shape), d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("offset", [0.0, 1e7])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    ("kind", "eye", "orthographic"),
    [
        ("sphere", (2.0, 1.5, -2.5), False),
        ("sphere", (2.0, 1.5, -2.5), True),
        ("sphere", (0.1, 0.3, -0.2), False),
        ("cylinder", (3.0, 1.0, 0.5), False),
        ("cylinder", (0.1, 0.2, 0.3), False),
        ("cone", (3.0, 1.0, 1.5), False),
    ],
)
def test_mirror_pixels_lie_on_the_analytic_surface(kind, eye, orthographic, scale, offset):
    mesh, shape = unit_quadric_mesh(kind)
    world = place(offset, -offset, 0.5 * offset, scale) @ np.diag([1.0, 1.3, 0.8, 1.0])
    scene = scene_of((mesh, world))
    # The eye in the shape's own space, looking across the axis.
    world_eye = (world @ [*eye, 1.0])[:3]
    target = (world @ ([0.9, -0.2, 0.4, 1.0] if np.linalg.norm(eye) < 1 else [0, 0, -0.3, 1.0]))[:3]
    camera = look_at(world_eye, target, orthographic=orthographic)
    gbuffer = raster.draw_scene(scene, camera)
    mirror = surface.mirror_pixels(scene, gbuffer, {1: 0})[0][1]
    assert mirror.count > 200
    pixel = mirror.pixel.numpy()
    origin, direction = eye_rays(camera, pixel)
    origin = origin - scene.origin
    point = mirror.point.numpy().astype(float)
    world[:3, 3] -= scene.origin
    near = np.einsum("ij,ij->i", point - origin, direction)
    t, normal = quadric_hit(shape, np.linalg.inv(world), origin, direction, near)
    normal *= -np.sign(np.einsum("ij,ij->i", normal, direction))[:, None]
    got = mirror.normal.numpy()
    cosine = -np.einsum("ij,ij->i", normal, direction)
    fair = cosine > 0.2  # nearer to the silhouette the raster's 1/256 pixel may pick a facet beyond it
    assert fair.mean() > 0.7
    # Rounding of the quadric's terms over the slope of the ray; at an offset float64 rounds the stage itself.
    stage = 4e-9 * offset / scale
    np.testing.assert_allclose(near[fair] / scale, t[fair] / scale, rtol=0, atol=1e-5 + stage)
    np.testing.assert_allclose(got[fair], normal[fair], atol=1e-5 + stage)
    np.testing.assert_allclose(np.linalg.norm(got, axis=1), 1.0, atol=1e-6)
    want = direction - 2 * np.einsum("ij,ij->i", direction, normal)[:, None] * normal
    np.testing.assert_allclose(mirror.direction.numpy()[fair], want[fair], atol=2e-5 + 2 * stage)


def test_mirror_pixels_seen_from_afar_stay_on_the_surface():
    """A telescope: what float32 loses at the eye's distance may shift P along the surface, not off it."""
    mesh, _ = unit_quadric_mesh("sphere")
    scene = scene_of((mesh, place()))
    camera = look_at((2e4, -1e4, 3e4), (0, 0, 0), fov=4e-3)
    mirror = surface.mirror_pixels(scene, raster.draw_scene(scene, camera), {1: 0})[0][1]
    assert mirror.count > 500
    point, normal = mirror.point.numpy().astype(float) + scene.origin, mirror.normal.numpy()
    np.testing.assert_allclose(np.linalg.norm(point, axis=1), 1.0, atol=2e-6)
    np.testing.assert_allclose(normal, point, atol=2e-6)


def test_mirror_pixels_interpolate_the_normals_of_a_mesh():
    ball = trimesh.creation.icosphere(2)
    scene = scene_of((mesh_of(ball.vertices, ball.faces, normals=ball.vertices), place(3, 2, 1, 2.0)))
    camera = look_at((-3, 5, 6), (3, 2, 1))
    gbuffer = raster.draw_scene(scene, camera)
    mirror = surface.mirror_pixels(scene, gbuffer, {1: 0})[0][1]
    facet = scene.host_triangles[gbuffer.triangle.numpy()[mirror.pixel.numpy()]]
    corner = scene.host_points[facet].astype(float)
    flat = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    origin, direction = eye_rays(camera, mirror.pixel.numpy())
    origin = origin - scene.origin
    t = np.einsum("ij,ij->i", corner[:, 0] - origin, flat) / np.einsum("ij,ij->i", direction, flat)
    on_plane = origin + t[:, None] * direction
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    weights = np.stack(
        [
            np.einsum("ij,ij->i", np.cross(corner[:, k - 1] - corner[:, k - 2], on_plane - corner[:, k - 2]), flat)
            for k in range(3)
        ],
        axis=1,
    )
    weights /= area[:, None]
    inside = (weights.min(axis=1) > 0) & (np.einsum("ij,ij->i", flat, direction) < -0.1)
    assert inside.mean() > 0.8
    np.testing.assert_allclose(mirror.point.numpy()[inside], on_plane[inside], atol=5e-6)
    # The mesh's normals are its unit vertices; its placement does not turn them.
    normal = np.einsum("ij,ijk->ik", weights, ball.vertices[facet])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    np.testing.assert_allclose(mirror.normal.numpy()[inside], normal[inside], atol=1e-5)


def test_mirror_pixels_split_the_picture_by_part():
    one, two = trimesh.creation.icosphere(2), trimesh.creation.box()
    half = MeshData(
        points=np.float32(two.vertices),
        triangles=np.int32(two.faces),
        parts=[Part(0, 6, "a"), Part(6, 6, "b")],
    )
    scene = Scene(
        SceneData(
            "test",
            [mesh_of(one.vertices, one.faces), half],
            [
                InstanceData(0, place(-1.5), "/ball", (0,)),
                InstanceData(1, place(1.5, 0.2), "/box", (0, 0)),
                InstanceData(0, place(0.0, 90.0), "/unseen", (0,)),
            ],
            [MaterialData()],
            [],
            [],
        ),
        DEVICE,
    )
    camera = look_at((0.5, 2, 7), (0, 0, 0))
    gbuffer = raster.draw_scene(scene, camera)
    pixels, reflector_id = surface.mirror_pixels(scene, gbuffer, {4: 0, 2: 2, 9: 3})
    triangle = gbuffer.triangle.numpy()
    got = reflector_id.numpy()
    covered = np.zeros(len(triangle), bool)
    for reflector, part in ((4, 0), (2, 2), (9, 3)):
        r = scene.parts[part]
        want = (triangle >= r.first_triangle) & (triangle < r.first_triangle + r.triangle_count)
        covered |= want
        np.testing.assert_array_equal(got == reflector, want)
        mirror = pixels[reflector]
        assert mirror.reflector == reflector
        np.testing.assert_array_equal(mirror.pixel.numpy(), np.flatnonzero(want))
        y, x = np.nonzero(want.reshape(camera.size[1], camera.size[0]))
        assert mirror.box == ((x.min(), y.min(), x.max() + 1, y.max() + 1) if len(x) else (0, 0, 0, 0))
    assert pixels[4].count > 50 and pixels[2].count > 20 and pixels[9].count == 0
    assert np.all(got[~covered] == 0)


def test_surface_channels_give_depth_normal_and_prim():
    box = trimesh.creation.box((2, 2, 2))
    scene = scene_of((mesh_of(box.vertices, box.faces), place(1e6, 0, 0)), (mesh_of(box.vertices, box.faces), place()))
    camera = look_at((1e6 + 3, 2.5, 4), (1e6, 0, 0))
    gbuffer = raster.draw_scene(scene, camera)
    channels = surface.surface_channels(scene, gbuffer)
    seen = gbuffer.triangle.numpy() >= 0
    assert 0.1 < seen.mean() < 0.9
    np.testing.assert_array_equal(channels["primId"].numpy(), seen.astype(int))
    normal, depth = channels["N"].numpy()[seen], channels["Z"].numpy()[seen]
    # Faces of a box: the point lies at +1 on the axis of its normal, which looks at the eye.
    axis = np.abs(normal).argmax(axis=1)
    np.testing.assert_allclose(normal, np.eye(3)[axis], atol=1e-6)
    origin, direction = eye_rays(camera, np.flatnonzero(seen))
    t = depth / (direction @ camera.forward)
    p = origin - [1e6, 0, 0] + t[:, None] * direction
    np.testing.assert_allclose(p[np.arange(len(p)), axis], 1.0, atol=2e-5)
    assert np.all(channels["Z"].numpy()[~seen] == 0) and np.all(channels["N"].numpy()[~seen] == 0)


# The technique.


def stand_in(part, convex):
    return SimpleNamespace(id=1, part=part, convex=convex)


def traced(scene, camera, part=0, convex=True, threads=0):
    gbuffer = raster.draw_scene(scene, camera)
    pixels = surface.mirror_pixels(scene, gbuffer, {1: part})[0][1]
    settings = Settings(threads=threads)
    reflector = stand_in(part, convex)
    prepared = raytraced.prepare(scene, reflector, settings)
    return gbuffer, raytraced.reflect(scene, prepared, gbuffer, pixels, camera, settings)


def furnished(rng, mirror, world=None):
    """The mirror, then 300 large random triangles around it."""
    corner = rng.normal(size=(300, 1, 3))
    corner *= rng.uniform(3, 5, (300, 1, 1)) / np.linalg.norm(corner, axis=2, keepdims=True)
    points = (corner + rng.uniform(-0.8, 0.8, (300, 3, 3))).reshape(-1, 3)
    return scene_of(
        (mirror, place() if world is None else world),
        (mesh_of(points, np.arange(900).reshape(-1, 3)), place()),
    )


@pytest.mark.parametrize("kind", ["sphere", "mesh", "flat"])
def test_reflect_matches_brute_force(kind):
    ball = trimesh.creation.icosphere(2)
    normals = {"sphere": None, "mesh": ball.vertices, "flat": None}[kind]
    mirror = mesh_of(ball.vertices, ball.faces, SPHERE if kind == "sphere" else None, normals)
    scene = furnished(np.random.default_rng(1), mirror)
    assert raytraced.applies(scene, stand_in(0, True))[0]
    _, layer = traced(scene, look_at((0, 0.3, 2.6), (0, 0, 0), (40, 30)))
    assert layer.method == Technique.RAYTRACED and layer.statistics == {"bvh": layer.pixels.count}
    others = scene.host_triangles[len(ball.faces) :]
    origins, directions = layer.pixels.point.numpy(), layer.pixels.direction.numpy()
    want, t, weights, margin = brute_force(scene.host_points, others, origins, directions)
    clear = margin > 1e-4
    hit = clear & (want >= 0)
    assert hit.sum() > 100 and (clear & ~hit).sum() > 10
    np.testing.assert_array_equal(layer.triangle.numpy()[hit], want[hit] + len(ball.faces))
    assert np.all(layer.triangle.numpy()[clear & ~hit] == -1)
    status = layer.status.numpy()
    assert np.all(status[hit] == Status.CONVERGED) and np.all(status[clear & ~hit] == Status.SKY)
    np.testing.assert_allclose(layer.distance.numpy()[hit], t[hit], rtol=2e-5)
    uv = np.stack([layer.u.numpy(), layer.v.numpy()], axis=1)
    np.testing.assert_allclose(uv[hit], weights[hit, 1:], atol=2e-3)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
@pytest.mark.parametrize("kind", ["sphere", "cylinder"])
def test_reflect_inside_a_body_starts_beyond_its_own_facets(kind, scale):
    """Inside a gprim the polished points lie behind the facets; rays must still cross to the far side."""
    mesh, shape = unit_quadric_mesh(kind)
    scene = scene_of((mesh, place(scale=scale)))
    camera = look_at((0.3 * scale, 0.2 * scale, 0.1 * scale), (scale, 0.1 * scale, 0), (64, 48))
    _, layer = traced(scene, camera, convex=False)
    point, d = layer.pixels.point.numpy().astype(float) / scale, layer.pixels.direction.numpy().astype(float)
    k = np.array([1.0, 1.0, shape.a])
    qa, qb = (k * d * d).sum(1), (k * point * d).sum(1)
    chord = -2.0 * qb / qa
    z = point[:, 2] + chord * d[:, 2]
    # Chords shorter than a facet may end on the facets between: they stay in one facet's sagitta.
    long = (chord > 0.5) & ((np.abs(z) < 0.95) | (kind == "sphere"))
    assert long.sum() > 500
    assert np.all(layer.status.numpy()[long] == Status.CONVERGED)
    # The far wall's facets lie inside the quadric by at most their sagitta, seen at an angle.
    got = layer.distance.numpy()[long] / scale
    assert np.all(got < chord[long] * (1 + 1e-4)) and np.all(got > chord[long] - 0.15)


def test_reflect_keeps_self_reflections_of_a_concave_mesh():
    """Two walls of an L: what the eye sees on one is reflected onto the other, a part of the same mirror."""
    points = [[0, 0, 0], [2, 0, 0], [2, 0, 2], [0, 0, 2], [0, 2, 0], [0, 2, 2]]
    floor = [[0, 2, 1], [0, 3, 2]]
    wall = [[0, 4, 5], [0, 5, 3]]
    scene = scene_of((mesh_of(points, floor + wall), place(5, -3, 2)))
    camera = look_at((7.0, -1.5, 3.0), (5.6, -3.0, 3.0), (48, 36))
    gbuffer, layer = traced(scene, camera, convex=False)
    own = gbuffer.triangle.numpy()[layer.pixels.pixel.numpy()]
    floor_pixel = own < 2
    p = layer.pixels.point.numpy() + scene.origin - [5, -3, 2]
    d = layer.pixels.direction.numpy().astype(float)
    t = -p[:, 0] / d[:, 0]
    q = p + t[:, None] * d
    on_wall = floor_pixel & (d[:, 0] < 0) & (np.abs(q[:, 1] - 1) < 0.99) & (np.abs(q[:, 2] - 1) < 0.99)
    assert on_wall.sum() > 100
    assert np.all(layer.triangle.numpy()[on_wall] >= 2)
    np.testing.assert_allclose(layer.distance.numpy()[on_wall], t[on_wall], rtol=1e-4)
    # The same mirror, declared convex, is stepped over.
    _, over = traced(scene, camera, convex=True)
    assert np.all(over.status.numpy() == Status.SKY)


def test_reflect_never_meets_a_smooth_closed_mirror_itself():
    """Interpolated normals send grazing rays under their own facet, and out through the back of others."""
    ball = trimesh.creation.icosphere(1)
    scene = scene_of((mesh_of(ball.vertices, ball.faces, normals=ball.vertices), place(scale=0.01)))
    _, layer = traced(scene, look_at((0.02, 0.01, 0.03), (0, 0, 0), (96, 96)), convex=False)
    assert layer.pixels.count > 500
    assert np.all(layer.status.numpy() == Status.SKY)


def test_reflect_is_equal_for_any_number_of_threads():
    ball = trimesh.creation.icosphere(3)
    scene = furnished(np.random.default_rng(2), mesh_of(ball.vertices, ball.faces, SPHERE))
    camera = look_at((0, 0.3, 2.4), (0, 0, 0), (160, 120))
    layers = [traced(scene, camera, threads=k)[1] for k in (1, 2, 3)]
    assert layers[0].pixels.count > 5000
    for other in layers[1:]:
        for name in ("triangle", "u", "v", "distance", "status"):
            np.testing.assert_array_equal(getattr(other, name).numpy(), getattr(layers[0], name).numpy())


def test_trace_pixels_writes_only_the_pixels_asked():
    ball = trimesh.creation.icosphere(2)
    scene = furnished(np.random.default_rng(2), mesh_of(ball.vertices, ball.faces, SPHERE))
    gbuffer, whole = traced(scene, look_at((0, 0.3, 2.4), (0, 0, 0)))
    some = np.flatnonzero(np.random.default_rng(0).random(whole.pixels.count) < 0.2).astype(np.int32)
    layer = ReflectionLayer.empty(whole.pixels, Technique.QUADRIC, DEVICE)
    index = wp.array(some, dtype=int, device=DEVICE)
    assert bvh.trace_pixels(scene, gbuffer, whole.pixels, layer, 0, True, index) == len(some)
    asked = np.zeros(whole.pixels.count, bool)
    asked[some] = True
    np.testing.assert_array_equal(layer.triangle.numpy()[asked], whole.triangle.numpy()[asked])
    np.testing.assert_array_equal(layer.status.numpy()[asked], whole.status.numpy()[asked])
    assert np.all(layer.status.numpy()[~asked] == Status.NONE)
    none = wp.zeros(0, dtype=int, device=DEVICE)
    assert bvh.trace_pixels(scene, gbuffer, whole.pixels, layer, 0, True, none) == 0


@pytest.mark.parametrize("spread", ["runs", "alone"])
def test_trace_pixels_asks_again_where_a_ray_slips_through_a_vertex(spread):
    """Pixels whose rays aim at the vertices of a closed room, in runs of a row or none beside another."""
    rng = np.random.default_rng(5)
    room = trimesh.creation.uv_sphere(radius=10.0, count=[48, 96])
    scene = scene_of((mesh_of(room.vertices, room.faces), place()))
    n = 200_000
    points = scene.host_points.astype(float)
    origin = np.float32(rng.uniform(-3, 3, (n, 3)))
    direction = points[rng.integers(0, len(points), n)] - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    pixel = np.arange(n) if spread == "runs" else 2 * np.arange(n)
    pixels = MirrorPixels(
        reflector=1,
        pixel=wp.array(pixel, dtype=int, device=DEVICE),
        point=wp.array(origin, dtype=wp.vec3, device=DEVICE),
        normal=wp.zeros(n, dtype=wp.vec3, device=DEVICE),
        direction=wp.array(np.float32(direction), dtype=wp.vec3, device=DEVICE),
        box=(0, 0, 1, 1),
    )
    camera = look_at((0, 0, 5), (0, 0, 0))
    nowhere = wp.full(2 * n, -1, dtype=int, device=DEVICE)
    gbuffer = GBuffer(camera, camera.view(scene), nowhere, wp.zeros(2 * n, dtype=float, device=DEVICE))
    layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, DEVICE)
    bvh.trace_pixels(scene, gbuffer, pixels, layer, -1, False)
    assert (layer.status.numpy() != Status.CONVERGED).sum() <= 2e-5 * n
