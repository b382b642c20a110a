"""The walk that answers single rays on CUDA, run on the CPU: it meets what Warp's own query meets."""

import numpy as np
import pytest
import warp as wp

from warp_reflect import ray_tree
from warp_reflect.launch import launch
from warp_reflect.ray_query import any_met, any_walked, first_met, first_walked, triangle_in
from warp_reflect.ray_tree import RayTree

wp.set_module_options({"enable_backward": False})
CPU = wp.get_device("cpu")
FAR = 3.0e38


@wp.kernel
def walk_kernel(
    first: int,
    mesh_id: wp.uint64,
    tree_id: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    reach: float,
    out_triangle: wp.array2d(dtype=int),
    out_place: wp.array2d(dtype=wp.vec3),
    out_any: wp.array2d(dtype=int),
):
    """One thread per ray: by Warp's query in row 0, by the walk in row 1."""
    i = first + wp.tid()
    for row in range(2):
        met = wp.vec4(0.0, 0.0, 0.0, 0.0)
        anything = bool(False)
        if row == 0:
            met = first_met(mesh_id, origins[i], directions[i], reach)
            anything = any_met(mesh_id, origins[i], directions[i], reach)
        else:
            met = first_walked(tree_id, origins[i], directions[i], reach)
            anything = any_walked(tree_id, origins[i], directions[i], reach)
        out_triangle[row, i] = triangle_in(met)
        out_place[row, i] = wp.vec3(met[0], met[1], met[2])
        out_any[row, i] = wp.where(anything, 1, 0)


def mesh_of(points: np.ndarray, triangles: np.ndarray, **more) -> wp.Mesh:
    at = wp.array(np.ascontiguousarray(points, np.float32), dtype=wp.vec3, device=CPU)
    return wp.Mesh(at, wp.array(triangles.reshape(-1).astype(np.int32), dtype=int, device=CPU), **more)


def asked(mesh: wp.Mesh, origins: np.ndarray, directions: np.ndarray, reach: float = FAR, tree: RayTree | None = None):
    """(triangles, [t, u, v], whether anything is met), by Warp's query and by the walk."""
    tree = tree or RayTree(mesh)
    assert tree.is_whole
    n = len(origins)
    triangle, anything = (wp.zeros((2, n), dtype=int, device=CPU) for _ in range(2))
    place = wp.zeros((2, n), dtype=wp.vec3, device=CPU)
    rays = [
        wp.array(np.ascontiguousarray(each, np.float32), dtype=wp.vec3, device=CPU) for each in (origins, directions)
    ]
    inputs = [wp.uint64(mesh.id), wp.uint64(tree.id), *rays, float(reach), triangle, place, anything]
    launch(walk_kernel, n, inputs, CPU, 1)
    return triangle.numpy(), place.numpy(), anything.numpy()


def assert_alike(
    mesh: wp.Mesh, origins: np.ndarray, directions: np.ndarray, reach: float = FAR, tree: RayTree | None = None
):
    """Rays in general position: the same triangles, but where two are as near but for rounding; the same places."""
    triangle, place, anything = asked(mesh, origins, directions, reach, tree)
    assert (anything == (triangle >= 0)).all()
    assert ((triangle[0] >= 0) == (triangle[1] >= 0)).all()
    hit = triangle[0] >= 0
    # Of triangles seen edge-on, either test is off by roundings of coordinates over the sine.
    rounding = 1.2e-7 * max(np.abs(mesh.points.numpy()).max(), np.abs(origins).max())
    off = np.abs(place[1, hit, 0].astype(float) - place[0, hit, 0])
    assert np.quantile(off, 0.99, method="lower") <= 16.0 * rounding if hit.any() else True
    same = hit & (triangle[0] == triangle[1])
    assert same.sum() >= 0.999 * hit.sum()
    return hit


def soup(
    rng: np.random.Generator, count: int, size: float, stretch: tuple = (1.0, 1.0, 1.0)
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of about that size in a box of two units."""
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + size * rng.uniform(-1.0, 1.0, (count, 3, 3)) * stretch
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def rays(rng: np.random.Generator, count: int, width: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    d = rng.normal(size=(count, 3))
    return rng.uniform(-width, width, (count, 3)), d / np.linalg.norm(d, axis=1, keepdims=True)


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A square of 2 n^2 triangles at z = 0, -1 to 1, its corners' heights uneven."""
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, n + 1), np.linspace(-1.0, 1.0, n + 1))
    z = 0.05 * np.sin(7.0 * x) * np.cos(9.0 * y)
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    quads = first + [0, 1, n + 2, 0, n + 2, n + 1]
    return np.stack([x, y, z], -1).reshape(-1, 3), quads.reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9, 100, 5000])
@pytest.mark.parametrize("size", [0.02, 0.5])
def test_rays_meet_what_they_meet_by_warps_query(count, size):
    rng = np.random.default_rng(count)
    mesh = mesh_of(*soup(rng, count, size))
    hit = assert_alike(mesh, *rays(rng, 20000))
    assert count < 100 or 0.0 < hit.mean() < 1.0


@pytest.mark.parametrize("constructor", ["sah", "median"])
@pytest.mark.parametrize("leaf", [1, 4, 8])
def test_any_tree_of_warp_is_laid_out(constructor, leaf):
    rng = np.random.default_rng(3)
    mesh = mesh_of(*soup(rng, 3000, 0.05), bvh_constructor=constructor, bvh_leaf_size=leaf)
    assert_alike(mesh, *rays(rng, 5000))


def test_thin_and_long_triangles():
    rng = np.random.default_rng(1)
    assert_alike(mesh_of(*soup(rng, 2000, 0.5, (1.0, 1.0e-4, 1.0e-3))), *rays(rng, 50000))


@pytest.mark.parametrize("scale", [1.0e-6, 1.0e6, 1.0e12])
@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_any_scale_far_from_the_origin(scale, offset):
    rng = np.random.default_rng(2)
    points, triangles = soup(rng, 2000, 0.2)
    origins, directions = rays(rng, 20000)
    assert_alike(mesh_of(scale * (points + offset), triangles), scale * (origins + offset), directions)


def test_a_reach_ends_rays():
    rng = np.random.default_rng(4)
    mesh = mesh_of(*soup(rng, 500, 0.3))
    near, far = assert_alike(mesh, *rays(rng, 5000), reach=0.3), assert_alike(mesh, *rays(rng, 5000))
    assert near.sum() < far.sum()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_rays_along_an_axis_cross_a_closed_surface(axis, sign):
    """Through corners, along edges and in planes of boxes: none is lost."""
    n = 16
    points, triangles = grid(n)
    points, order = points.copy(), np.roll(np.arange(3), axis + 1)
    targets = np.concatenate([points, 0.5 * (points[triangles[:, 0]] + points[triangles[:, 1]])])
    inner = np.abs(targets[:, :2]).max(1) < 0.999
    targets = targets[inner][:, order]
    direction = np.zeros(3)
    direction[order == 2] = sign
    triangle, _, anything = asked(
        mesh_of(points[:, order], triangles), targets - direction, np.tile(direction, (len(targets), 1))
    )
    assert (triangle[1] >= 0).all()
    assert anything[1].all()


def test_no_ray_goes_between_triangles_that_share_an_edge():
    """Aimed at corners and at points of edges, from everywhere; Warp's query, whose boxes are as tight as can be, loses some."""
    rng = np.random.default_rng(5)
    points, triangles = grid(24)
    inner = np.abs(points[:, :2]).max(1) < 0.999
    a, b = triangles[:, [0, 1, 2]].reshape(-1), triangles[:, [1, 2, 0]].reshape(-1)
    both = inner[a] & inner[b]
    share = rng.uniform(size=(both.sum(), 1))
    targets = np.tile(
        np.concatenate([points[inner], points[a[both]] * share + points[b[both]] * (1.0 - share)]), (8, 1)
    )
    away = rng.normal(size=targets.shape)
    away[:, 2] = np.abs(away[:, 2]) + 2.0
    origins = (targets + away).astype(np.float32)
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    triangle, _, anything = asked(mesh_of(points, triangles), origins, directions)
    assert (triangle[1] >= 0).all()
    assert anything[1].all()


def test_triangles_in_the_plane_of_a_ray_and_without_area_are_not_met():
    flat = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 2, 2], [2, 2, 2], [2, 2, 2], [0, 0, 1], [1, 1, 1], [3, 3, 1]], float
    )
    mesh = mesh_of(flat, np.arange(9).reshape(3, 3))
    origins = np.array([[-1, 0.2, 0], [0, 2, 2], [0, 0, 1], [0.2, 0.2, 5]], float)
    directions = np.array([[1, 0, 0], [1, 0, 0], [0.6, 0.8, 0], [0, 0, -1]], float)
    triangle, place, anything = asked(mesh, origins, directions)
    assert triangle[1].tolist() == triangle[0].tolist() == [-1, -1, -1, 0]
    assert anything[1].tolist() == [0, 0, 0, 1]
    assert place[1, 3, 0] == 5.0


def test_a_tree_too_deep_to_be_walked_is_told(monkeypatch):
    mesh = mesh_of(*soup(np.random.default_rng(7), 500, 0.1))
    assert RayTree(mesh).is_whole
    monkeypatch.setattr(ray_tree, "DEEPEST", 3)
    assert not RayTree(mesh).is_whole


def test_many_triangles_in_one_place():
    points = np.tile([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], (500, 1))
    mesh = mesh_of(points, np.arange(1500).reshape(-1, 3))
    triangle, place, _ = asked(mesh, np.array([[0.2, 0.2, 2.0], [0.8, 0.8, 2.0]]), np.array([[0.0, 0.0, -1.0]] * 2))
    assert triangle[1, 0] >= 0
    assert triangle[1, 1] == -1
    assert place[1, 0, 0] == 2.0


def test_moved_points_are_met_where_they_are():
    rng = np.random.default_rng(6)
    points, triangles = soup(rng, 1000, 0.2)
    mesh = mesh_of(points, triangles)
    tree = RayTree(mesh)
    for moved in (points * [2.0, 0.5, 1.0] + 3.0, points[::-1]):
        mesh.points.assign(moved.astype(np.float32))
        mesh.refit()
        tree.fit()
        origins, directions = rays(rng, 5000)
        assert_alike(mesh, moved.mean(0) + origins, directions, tree=tree)
