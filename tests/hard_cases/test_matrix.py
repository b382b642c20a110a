"""Every row of the matrix of hard cases has its tests; here are those that no other file holds.

Bounds are K(c): relative error against an oracle of more digits <= c u (1 + condition), u half a spacing at 1.
"""

from __future__ import annotations

import ast
import csv
from collections import Counter
from itertools import pairwise
from pathlib import Path

import mpmath
import numpy as np
import pytest
import warp as wp
from matrix import COUNTS, MATRIX
from rooms import CHROME, placed, render, room, sphere
from test_raster import draw, flat
from test_solve_quadrics import ray_roots

import warp_reflect as wr
from warp_reflect import reflector_maps
from warp_reflect.cubemap import project_to_cube
from warp_reflect.optics import specular_residual
from warp_reflect.scene import MeshData
from warp_reflect.settings import Status
from warp_reflect.techniques import octree

wp.set_module_options({"enable_backward": False})

HERE = Path(__file__).resolve().parent
TABLE = list(csv.DictReader((HERE / "oracle_table.csv").open()))
FLAGGED = (Status.CONVERGED, Status.GRAZING, Status.NEAR_CAUSTIC, Status.AMBIGUOUS)


def roundoff(dtype) -> float:
    return float(np.finfo(dtype).eps) / 2


# --- the matrix itself


def test_every_row_is_there():
    found = Counter(name.rstrip("0123456789") for name in MATRIX)
    assert dict(found) == COUNTS
    for prefix, count in COUNTS.items():
        assert all(f"{prefix}{k:02d}" in MATRIX for k in range(1, count + 1))


def test_every_row_names_a_test():
    assert [name for name, (_, tests) in MATRIX.items() if not tests] == []


def test_every_test_that_is_named_exists():
    named = {test for _, tests in MATRIX.values() for test in tests}
    for file in sorted({test.partition("::")[0] for test in named}):
        path = HERE / file if (HERE / file).exists() else HERE.parent / file
        tree = ast.parse(path.read_text())
        functions = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
        wanted = {test.partition("::")[2] for test in named if test.startswith(file + "::")}
        assert wanted <= functions, f"{file} lacks {wanted - functions}"


# --- reflection points (RP09-RP11, RP25, Q09, Q14)

# c of K(c) by precision. Measured worst: float32 1.9, float64 3.3; where the solver stops at the residual of a nearly
# double root (near-caustic 105) or of a flat one (near-silhouette 45) it leaves the last digits of float64.
BOUND = {np.float32: 4.0, np.float64: 8.0}
BOUND_FLAT = 256.0


def mirror_of(row: dict) -> wr.QuadricMirror:
    lx, ly, lz, b, c = (float(row[name]) for name in ("lx", "ly", "lz", "b", "c"))
    q = np.diag([lx, ly, lz, c])
    q[2, 3] = q[3, 2] = b
    return wr.QuadricMirror.from_matrix(
        q, side="outer" if row["side"] == "1" else "inner", sheet=1 if lz < 0 and c > 0 else 0
    )


def vector(row: dict, name: str) -> np.ndarray:
    return np.array([float(row[f"{name}{axis}"]) for axis in "xyz"])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("family", sorted({row["family"] for row in TABLE}))
def test_hard_cases_match_forty_digits(family, dtype):
    rows = [row for row in TABLE if row["family"] == family]
    assert len(rows) >= 4
    for row in rows:
        inner = row["side"] != "1"
        solution = wr.solve(mirror_of(row), vector(row, "e"), vector(row, "p").astype(dtype)[None], all_roots=inner)
        points = solution.roots[0] if inner else solution.point
        status = solution.root_status[0] if inner else solution.status
        exact = vector(row, "r")
        distance = np.linalg.norm(points.astype(np.float64) - exact, axis=1)
        nearest = int(np.argmin(np.where(status == Status.NONE, np.inf, distance)))
        assert status[nearest] in FLAGGED
        if family not in ("near-silhouette", "near-focus", "near-caustic"):
            assert status[nearest] == Status.CONVERGED
        flat_root = dtype is np.float64 and family in ("near-silhouette", "near-caustic")
        bound = (BOUND_FLAT if flat_root else BOUND[dtype]) * roundoff(dtype) * (1.0 + float(row["condition"]))
        assert distance[nearest] / max(1.0, np.linalg.norm(exact)) <= bound, row


# --- the residual (RP03)


@wp.kernel
def residual_kernel(
    p: wp.vec3, n: wp.vec3, eye: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3), out: wp.array(dtype=float)
):
    i = wp.tid()
    out[i] = specular_residual(p, n, eye[i], target[i])


def test_residual_resolves_small_angles(device):
    """The half vector turned by theta: K(8) down to 1e-3, at least 8 roundings of the directions below."""
    theta = np.array([1e-1, 1e-2, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6])
    slant = np.radians(40.0)
    eye = np.stack([np.sin(slant + theta), np.cos(slant + theta), 0 * theta], 1) * 2.0
    target = np.stack([np.sin(-slant + theta), np.cos(-slant + theta), 0 * theta], 1) * 3.0
    out = wp.zeros(len(theta), dtype=float, device=device)
    ends = [wp.array(x.astype(np.float32), dtype=wp.vec3, device=device) for x in (eye, target)]
    wp.launch(residual_kernel, len(theta), [wp.vec3(), wp.vec3(0.0, 1.0, 0.0), *ends, out], device=device)
    error = np.abs(out.numpy() - np.sin(theta))
    assert (error <= 8 * roundoff(np.float32) * (1.0 + theta)).all(), error
    assert (error[:5] <= 1e-2 * theta[:5]).all()  # where E = (1 - B.N) / 2 is already 0


# --- reflector maps (RP15, RP16, RP18, RP21)


@wp.kernel
def texel_kernel(
    map: reflector_maps.ReflectorMapView,
    directions: wp.array(dtype=wp.vec3),
    out_texel: wp.array(dtype=int),
    out_point: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    x = project_to_cube(directions[i])
    out_texel[i] = reflector_maps.nearest_texel(map, x)
    out_point[i] = reflector_maps.sample_map(map, x).p


def ball(rows=24, columns=48, axes=(1.0, 1.0, 1.0)):
    mesh = sphere(rows, columns)
    return mesh.points.astype(np.float64) * axes, np.asarray(mesh.triangles)


def look_up(drawn, directions, device):
    directions = np.asarray(directions, np.float32)
    texel = wp.zeros(len(directions), dtype=int, device=device)
    point = wp.zeros(len(directions), dtype=wp.vec3, device=device)
    given = wp.array(directions, dtype=wp.vec3, device=device)
    wp.launch(texel_kernel, len(directions), [drawn.on(device).view, given, texel, point], device=device)
    return texel.numpy(), point.numpy()


def around_edges(rng) -> np.ndarray:
    """Directions at edges and corners of the cube, exact and one spacing to either side."""
    found = []
    for signs in np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T:
        corner = signs.astype(np.float32)
        found += [corner, corner * [1, 1, rng.uniform(-1, 1)], corner * [rng.uniform(-1, 1), 1, 1]]
    found = np.array(found, np.float32)
    shifts = [found]
    for axis in range(3):
        for towards in (-2.0, 2.0):
            moved = found.copy()
            moved[:, axis] = np.nextafter(moved[:, axis], np.float32(towards))
            shifts.append(moved)
    return np.concatenate(shifts)


def test_map_is_seamless_at_edges_and_corners_of_the_cube(device):
    """Neighbours in direction stay neighbours across faces, and points reflected there are as exact as elsewhere."""
    drawn = wr.ReflectorMap.from_mesh(*ball(), resolution=64)
    rng = np.random.default_rng(1)
    directions = around_edges(rng)
    _, points = look_up(drawn, directions, device)
    groups = points.reshape(7, -1, 3)
    assert np.abs(groups - groups[0]).max() <= 1e-6
    n = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    side = np.cross(n, rng.normal(size=n.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    away, here = [], []
    for normals, errors in ((n, away), (oracles_sphere(rng, len(n)), here)):
        tangent = np.cross(normals, side)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        eye = normals + 2.0 * (0.8 * normals + 0.6 * tangent)
        point = normals + 1.5 * (0.8 * normals - 0.6 * tangent)
        for k in range(0, len(normals), 4):
            solution = wr.solve(drawn, eye[k], point[k][None])
            assert solution.status[0] == Status.CONVERGED
            errors.append(np.linalg.norm(solution.point[0] - normals[k]))
    assert np.max(away) <= 2.0 * np.max(here)


def oracles_sphere(rng, count) -> np.ndarray:
    x = rng.normal(size=(count, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def test_texels_of_any_direction_are_in_range(device):
    """A million directions of all sizes, the edges of faces, zero and what is not finite."""
    drawn = wr.ReflectorMap.from_mesh(*ball(12, 24), resolution=16)
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(1_000_000, 3)) * 10.0 ** rng.uniform(-38, 37, (1_000_000, 1))
    directions = np.concatenate([directions, around_edges(rng), np.zeros((1, 3)), np.full((1, 3), 1e-45)])
    texel, point = look_up(drawn, directions, device)
    assert texel.min() >= 0 and texel.max() < len(drawn.view.texels.numpy())
    assert np.isfinite(point).all()
    # What is not finite is stopped before any look-up.
    for bad in ((np.nan, 0, 1), (np.inf, 0, 0), (0, -np.inf, np.nan)):
        for eye, target in ((bad, (3, 0, 0)), ((3, 0, 0), bad)):
            assert wr.solve(drawn, np.array(eye, float), np.array([target], float)).status[0] == Status.BAD_INPUT


@pytest.mark.parametrize("axes", [(1, 1, 1e-2), (1, 1e-2, 1e-2), (1, 1, 1e-3), (1, 1e-4, 1e-4), (1, 1, 1e-4)])
def test_flat_bodies_and_sharp_edges_have_finite_answers(axes):
    """Bodies of 100:1 to 10,000:1, whose normals turn round within a texel: a status, no NaN, and the law where it says so."""
    drawn = wr.ReflectorMap.from_mesh(*ball(axes=np.array(axes, float)), resolution=64)
    rng = np.random.default_rng(3)
    points = rng.normal(size=(300, 3)) * 10.0 ** rng.uniform(-4, 2, (300, 1))
    for eye in ([0.2, 0.1, 2.0], [3.0, 0.0, 0.0], [1.5, 1e-4, 1e-5]):
        solution = wr.solve(drawn, np.array(eye), points)
        assert all(np.isfinite(x).all() for x in (solution.point, solution.normal, solution.virtual, solution.residual))
        assert (solution.status != Status.NONE).all()
        # Beyond 1000:1 the float32 search of a map says itself that it did not end; a quadric of it is solved exactly.
        assert (solution.status == Status.CONVERGED).sum() > 20 or min(axes) < 1e-3
        assert (solution.residual[solution.status == Status.CONVERGED] < 2e-2).all()


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


@pytest.mark.parametrize(
    ("points", "faces", "text"),
    [
        (SQUARE, [(0, 1, 2), (0, 2, 3), (2, 1, 0), (3, 2, 0)], "open"),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2), (2, 1, 0)], "without any area"),
        ([(5, 5, 5)] * 3, [(0, 1, 2), (2, 1, 0)], "without any area"),
        (SQUARE, np.zeros((0, 3), np.int32), "0 triangles"),
        (SQUARE, [(0, 1, 4)], "got 0 to 4, expected 0 to 3"),
        (SQUARE, [(0, 1, -1)], "got -1 to 1"),
        (SQUARE, [(0.0, 1.0, np.nan)], "got float64"),
        ([(0, 0, np.nan), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)], "finite"),
        ([(0, 0), (1, 0), (1, 1)], [(0, 1, 2)], "got shape (3, 2)"),
    ],
)
def test_bodies_without_an_inside_are_refused(points, faces, text):
    """Two-sided sheets, lines, points and damaged arrays: there is no centre off the surface."""
    with pytest.raises(ValueError) as caught:
        wr.ReflectorMap.from_mesh(np.array(points, float), np.array(faces), resolution=16)
    assert text in str(caught.value) and "\n" not in str(caught.value)


# --- the octree of the grid (GI01-GI03, GI06-GI08)


@pytest.mark.parametrize("kind", ["flat", "long", "far", "equal", "line", "corners"])
def test_octree_holds_flat_long_far_and_equal_points(kind):
    rng = np.random.default_rng(4)
    unit = rng.random((3000, 3))
    points = {
        "flat": unit * [1, 1, 0],
        "long": unit * [1, 1e-6, 1e-6],
        "far": 1e7 + 0.5 * unit,
        "equal": np.ones((3000, 3)),
        "line": unit[:, :1] * [1, 1, 1],
        "corners": np.rint(unit),
    }[kind]
    tree = octree.build(points)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(3000))
    cells = np.arange(len(tree.level))
    low, edge = tree.low + tree.place * tree.unit, tree.edge(cells)
    for cell in cells[:: max(len(cells) // 200, 1)]:
        own = points[tree.order[tree.first[cell] : tree.first[cell] + tree.count[cell]]]
        slack = 1e-9 * tree.size + 4 * np.spacing(np.abs(points).max())
        assert (own >= low[cell] - slack).all() and (own <= low[cell] + edge[cell] + slack).all()
    assert tree.corners.min() >= 0 and tree.corners.max() < len(tree.nodes)
    assert tree.nodes.min() >= 0 and tree.nodes.max() <= 1 << octree.LEVEL_MAX
    assert len(tree.nodes) <= 8 * len(cells) and np.isfinite(tree.size) and tree.size > 0.0


# --- rays against quadrics (Q02, Q03, Q08, Q15)


def test_grazing_rays_hit_as_in_forty_digits(device):
    """Beside the middle by 1 +- 1e-6 and farther: the count is right wherever the chord is longer than float32 can hide."""
    beside = np.array([1 - 1e-3, 1 - 1e-5, 1 - 1e-6, 1 + 1e-6, 1 + 1e-5, 1 + 1e-3])
    origin = np.stack([0 * beside - 5.0, beside, 0 * beside], 1).astype(np.float32)
    count, roots = ray_roots("sphere", origin, np.tile([1.0, 0, 0], (len(beside), 1)), device)
    b = origin[:, 1].astype(float)
    np.testing.assert_array_equal(count, np.where(b < 1.0, 2, 0))
    chord = np.sqrt(np.maximum(1.0 - b**2, 0.0))
    hit = b < 1.0
    # A root moves by u / chord: K(8) with that condition.
    bound = 8 * roundoff(np.float32) * (5.0 + 1.0 / np.maximum(chord, 1e-3))
    assert (np.abs(roots[:, 0] - (5.0 - chord))[hit] <= bound[hit]).all()
    touching, _ = ray_roots("sphere", [[-5.0, 1.0, 0.0]], [[1.0, 0, 0]], device)
    assert touching[0] in (0, 2)


@pytest.mark.parametrize("tilt", [1e-2, 1e-4, 1e-6])
def test_rays_with_roots_far_apart_keep_both(tilt, device):
    """Near an asymptote of two sheets: the roots differ by 1 / tilt, and neither loses its digits."""
    origin = np.array([[0.3, 0.1, -3.0]], np.float32)
    slope = np.float32(1.0 - tilt)
    count, roots = ray_roots("two sheets", origin, [[slope, 0.0, 1.0]], device)
    assert count[0] in (1, 2)
    with mpmath.workdps(40):
        x, y, z = (mpmath.mpf(float(v)) for v in origin[0])
        s = mpmath.mpf(float(slope))
        # x^2 + y^2 - z^2 + 1 along the ray.
        a, half, c = s * s - 1, s * x - z, x * x + y * y - z * z + 1
        root = mpmath.sqrt(half * half - a * c)
        exact = sorted([float((-half - root) / a), float((-half + root) / a)])
    assert count[0] == 2
    for found, true in zip(roots[0], exact, strict=True):
        # a = (s - 1)(s + 1) itself carries the rounding of s, 1 / tilt times, into the far root alone.
        condition = 1.0 / tilt if abs(true) == max(map(abs, exact)) else 4.0
        assert abs(found - true) <= 16 * roundoff(np.float32) * condition * abs(true)


def test_rays_along_a_cylinder_miss(device):
    """Parallel to the axis there is no root, on the axis, inside or outside."""
    origin = [[0.0, 0.0, -3.0], [0.5, 0.1, 2.0], [4.0, 0.0, 0.0]]
    count, roots = ray_roots("elliptic cylinder", origin, np.tile([0, 0, 1.0], (3, 1)), device)
    np.testing.assert_array_equal(count, 0)
    assert np.isfinite(roots).all()


@pytest.mark.parametrize("exponent", [-60, 17, 60])
def test_hollow_quadrics_scale_by_powers_of_two(exponent):
    """Degree-8 equations of coordinates of 1e-18 to 1e18: the same bits after scaling."""
    scale = 2.0**exponent
    rng = np.random.default_rng(5)
    points = rng.uniform(-0.4, 0.4, (40, 3))
    q = np.diag([1.0, 2.0, 4.0, -1.0])
    big = q.copy()
    big[3, 3] *= scale * scale
    eye = np.array([0.2, 0.1, 0.15])
    unit = wr.solve(wr.QuadricMirror.from_matrix(q, side="inner"), eye, points, all_roots=True)
    scaled = wr.solve(wr.QuadricMirror.from_matrix(big, side="inner"), eye * scale, points * scale, all_roots=True)
    np.testing.assert_array_equal(scaled.root_status, unit.root_status)
    np.testing.assert_allclose(scaled.roots, unit.roots * scale, rtol=0, atol=1e-13 * scale)
    assert unit.root_count.min() >= 2


# --- planes (P06, P08)


def test_far_plane_mirrors_as_near():
    """K(16) at 1e7: heights are measured from the plane's own point."""
    rng = np.random.default_rng(6)
    normal = np.array([0.36, 0.48, 0.8])
    centre = np.array([1e7, -1e7, 1e7])
    points = np.rint(rng.normal(size=(200, 3)) * 4.0) + 6.0 * np.rint(normal * 4.0)
    eye = 8.0 * np.rint(normal * 4.0)
    near = wr.solve(wr.PlanarMirror(np.zeros(3), normal), eye, points)
    far = wr.solve(wr.PlanarMirror(centre, normal), eye + centre, points + centre)
    np.testing.assert_array_equal(far.status, near.status)
    assert (near.status == Status.CONVERGED).mean() > 0.9
    assert np.abs(far.virtual - centre - near.virtual).max() <= 16 * np.spacing(1e7)


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6, 1e8])
def test_far_points_reflect_in_a_plane_where_they_should(distance):
    """K(8): R divides the line to the mirrored point by the heights, and a height share near 1 keeps its complement."""
    rng = np.random.default_rng(9)
    eye = np.array([-0.75, 1.0, 3.5])
    points = rng.normal(size=(50, 3))
    points[:, 2] = np.abs(points[:, 2]) + 0.1
    points *= distance / np.linalg.norm(points, axis=1, keepdims=True)
    for dtype in (np.float32, np.float64):
        given = points.astype(dtype)
        solution = wr.solve(wr.PlanarMirror((0, 0, 0), (0, 0, 1)), eye, given)
        assert (solution.status == Status.CONVERGED).all()
        for found, point in zip(solution.point, given.astype(np.float64), strict=True):
            with mpmath.workdps(40):
                h_eye, h_point = mpmath.mpf(eye[2]), mpmath.mpf(float(point[2]))
                exact = [
                    float((h_point * mpmath.mpf(eye[k]) + h_eye * mpmath.mpf(float(point[k]))) / (h_eye + h_point))
                    for k in (0, 1)
                ]
            assert np.abs(found[:2] - exact).max() <= 8 * roundoff(dtype) * max(1.0, np.abs(exact).max())


@pytest.mark.parametrize("method", ["reference", "reflector_map"])
def test_mirrored_transform_shows_the_baked_mesh(method):
    """A world matrix of negative determinant, and the same body with mirrored points and turned faces."""
    points, triangles = ball(axes=np.array([1.0, 0.7, 0.5]))
    points = points + 0.1 * points[:, :1] ** 2 * [0, 0, 1]  # no symmetry that would hide a mistake
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)

    def body(p, n, t):
        return MeshData(p.astype(np.float32), np.ascontiguousarray(t, np.int32), n.astype(np.float32))

    flip = np.array([-1.0, 1.0, 1.0])
    mirrored = room(body(points, normals, triangles), placed(0, 0, -1) @ np.diag([*flip, 1.0]))
    baked = room(body(points * flip, normals * flip, triangles[:, ::-1]), placed(0, 0, -1))
    a, b = (render(scene, method, size=(96, 54)) for scene in (mirrored, baked))
    assert (b["reflectorId"] > 0).sum() > 300
    np.testing.assert_array_equal(a["reflectorId"], b["reflectorId"])
    assert (a["reflectedId"] == b["reflectedId"]).mean() > 0.999
    # At the silhouette a pixel's place on its facet, and so its normal, is worth fewer digits.
    assert (np.abs(a["N"] - b["N"]) > 1e-4).mean() < 1e-3 and np.abs(a["N"] - b["N"]).max() < 1e-2
    assert CHROME.metallic == 1.0


# --- the rasteriser (R04, R06, R09, R11)


def test_tiny_triangles_own_a_pixel_once():
    """A mesh of triangles of 1e-6 of a pixel: each draws nothing or one pixel, and together they own each at most once."""
    rng = np.random.default_rng(7)
    corner = rng.uniform(2, 14, (400, 1, 2))
    tiny = corner + rng.uniform(-1e-3, 1e-3, (400, 3, 2))
    for triangle in tiny[:60]:
        assert (draw(flat([triangle]), 16, 16)[0] >= 0).sum() <= 1
    # A square cut into cells of 1/512 of a pixel around a pixel's centre owns that pixel exactly once.
    line = 5.5 + np.linspace(-4, 4, 9) / 512
    owned = 0
    for x0, x1 in pairwise(line):
        for y0, y1 in pairwise(line):
            for triangle in ([(x0, y0), (x1, y0), (x0, y1)], [(x1, y0), (x1, y1), (x0, y1)]):
                owned += int((draw(flat([triangle]), 12, 12)[0] >= 0).sum())
    assert owned == 1


def test_long_edges_have_one_side():
    """Two triangles on either side of an edge of 1,920 pixels: every pixel of a strip belongs to exactly one."""
    rng = np.random.default_rng(8)
    for _ in range(6):
        left, right = rng.uniform(0, 32, 2)
        a, b = (-1.0, left), (1921.0, right)
        above, below = [a, b, (900.0, -5000.0)], [b, a, (900.0, 5000.0)]
        count = sum((draw(flat([triangle]), 1920, 32)[0] >= 0).astype(int) for triangle in (above, below))
        assert (count[:, 100:-100] == 1).all()


def test_depths_near_1000_stay_apart():
    """Near 1e-3, far 1e7: depths 1000 + k 1e-3 keep their order in the z-buffer's reversed key."""
    for k in range(5):
        depths = np.array([1000.0 + 1e-3 * k, 1000.0 + 1e-3 * (k + 1)])
        triangle = [[0, 0], [16, 0], [0, 16]]
        for order in ((0, 1), (1, 0)):
            corners = flat([triangle, triangle])
            for place, which in enumerate(order):
                corners[place, :, 2], corners[place, :, 3] = 1.0 / depths[which], depths[which]
            ids, _ = draw(corners, 16, 16)
            assert order[ids[2, 2]] == 0, (k, order)


def test_vertices_that_are_not_finite_draw_nothing():
    """A NaN or infinite corner takes its triangle out and leaves the others."""
    good = [[2, 2], [12, 2], [2, 12]]
    clean, _ = draw(flat([good]), 16, 16)
    for value in (np.nan, np.inf, -np.inf):
        # x, y, and the depth with its key; a depth is never infinite, its key is its reciprocal.
        for component in ([0], [1], [2, 3])[: 3 if np.isnan(value) else 2]:
            corners = flat([good, good])
            corners[0, 1, component] = value
            ids, keys = draw(corners, 16, 16)
            assert np.isfinite(keys).all()
            if np.isnan(value):
                np.testing.assert_array_equal(ids >= 0, clean >= 0)
                assert (ids[clean >= 0] == 1).all(), (value, component)


# --- scales (S02, S05)

STAGE = """#usda 1.0
(
    upAxis = "{axis}"
    metersPerUnit = {meters}
)
def Xform "World" {{
    matrix4d xformOp:transform = {matrix}
    uniform token[] xformOpOrder = ["xformOp:transform"]
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        double radius = 1
        rel material:binding = </World/Chrome>
    }}
    def Mesh "Floor" {{
        point3f[] points = [(-4, -1.5, 4), (4, -1.5, 4), (4, -1.5, -4), (-4, -1.5, -4)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform token subdivisionScheme = "none"
        color3f[] primvars:displayColor = [(0.7, 0.2, 0.1)]
    }}
    def Material "Chrome" {{
        token outputs:surface.connect = </World/Chrome/S.outputs:surface>
        def Shader "S" {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.9, 0.9, 0.9)
            float inputs:metallic = 1
            float inputs:roughness = 0
            token outputs:surface
        }}
    }}
}}
def Camera "Camera" {{
    float focalLength = 30
    float2 clippingRange = {clipping}
    matrix4d xformOp:transform = {camera}
    uniform token[] xformOpOrder = ["xformOp:transform"]
}}
"""


def test_units_and_up_axis_do_not_change_the_picture(tmp_path):
    """Metres with Y up, and 1/128 of a metre with Z up: the same hits at 128 times the length."""
    frames = []
    for name, values in (
        (
            "m",
            ("Y", "1", "((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))", "((1,0,0,0),(0,1,0,0),(0,0,1,0),(0.25,0.5,5,1))"),
        ),
        (
            "u",
            (
                "Z",
                "0.0078125",
                "((128,0,0,0),(0,0,128,0),(0,-128,0,0),(0,0,0,1))",
                "((1,0,0,0),(0,0,1,0),(0,-1,0,0),(32,-640,64,1))",
            ),
        ),
    ):
        path = tmp_path / f"{name}.usda"
        clipping = "(0.125, 128)" if name == "m" else "(16, 16384)"
        keys = ("axis", "meters", "matrix", "camera")
        path.write_text(STAGE.format(clipping=clipping, **dict(zip(keys, values, strict=True))))
        scene = wr.load_stage(path)
        frames.append(wr.render_frame(scene, wr.make_plan(scene, size=(64, 48))))
    m, u = frames
    mirror = m["reflectorId"] > 0
    assert mirror.sum() > 300
    np.testing.assert_array_equal(u["reflectorId"], m["reflectorId"])
    assert (u["reflectedId"] == m["reflectedId"])[mirror].mean() > 0.998
    both = mirror & (m["reflectedId"] > 0) & (u["reflectedId"] == m["reflectedId"])
    np.testing.assert_allclose(u["pathLength"][both], 128.0 * m["pathLength"][both], rtol=2e-5)
    assert np.abs(u["RGBA"] - m["RGBA"])[both].max() < 2e-3


@pytest.mark.parametrize("size", [1e-38, 1e-42, 1e-45])
def test_denormal_points_are_answered(size):
    """Sizes at which float32 has no digits left: a status and no NaN, for mirrors of that size and of size 1."""
    for dtype in (np.float32, np.float64):
        points = (np.array([[3.0, 1, 0], [0, 3, 1], [-3, 0, 1]]) * size).astype(dtype)
        for mirror in (wr.QuadricMirror.sphere((0, 0, 0), 1.0), wr.QuadricMirror.sphere((0, 0, 0), size)):
            solution = wr.solve(mirror, np.array([4.0, 0.5, 1.0]) * max(size, 1e-300), points)
            assert all(np.isfinite(x).all() for x in (solution.point, solution.virtual, solution.residual))
            assert (solution.status != Status.NONE).all()
    exact = wr.solve(wr.QuadricMirror.sphere((0, 0, 0), 1.0), [4.0, 0.5, 1.0], np.array([[3.0, 1.0, size]], np.float32))
    same = wr.solve(wr.QuadricMirror.sphere((0, 0, 0), 1.0), [4.0, 0.5, 1.0], np.array([[3.0, 1.0, 0.0]], np.float32))
    np.testing.assert_allclose(exact.point, same.point, atol=1e-7)
