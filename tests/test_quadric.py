"""The quadric technique: its search against constructed truth and the curve search, recognised meshes, frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import oracles
import pytest
import warp as wp

import warp_reflect as wr
from warp_reflect.layers import Camera, Reflector
from warp_reflect.mirrors import QuadricMirror
from warp_reflect.quadric_fit import fit_quadric
from warp_reflect.quadrics import QuadricKind
from warp_reflect.scene import CameraData, InstanceData, MaterialData, MeshData, Scene, SceneData
from warp_reflect.settings import Status
from warp_reflect.solver import solve
from warp_reflect.stage import gprims
from warp_reflect.techniques import quadric, quadric_branches, quadric_patch, quadric_sheets
from warp_reflect.techniques.vertices import empty_vertices, solve_frame

FOLDER = Path(__file__).resolve().parents[1] / "usd_scenes"
CHROME = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
GPRIM_SCENES = ("sphere_on_checker", "capped_cylinder", "ellipsoid_row")
CONCAVE = ("sphere", "ellipsoid 3:1:1", "elliptic cylinder", "paraboloid", "one sheet", "hyperbolic paraboloid")


class Origin:
    """What the solver's frame asks of a scene."""

    origin = np.zeros(3)


def looking(eye, at=(0.0, 0.0, 0.0), size=(64, 64), focal=60.0) -> Camera:
    forward = np.asarray(at, float) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    return Camera(
        np.asarray(eye, float), right, np.cross(right, forward), forward, focal, focal,
        0.5 * size[0], 0.5 * size[1], 1e-6, 1e9, size,
    )  # fmt: skip


def placed_mirror(name: str, rng, size: float) -> tuple[QuadricMirror, np.ndarray]:
    pose = oracles.random_pose(rng, size, offset=1.0)
    mirror = QuadricMirror.from_matrix(oracles.placed(oracles.matrix_of(name), pose))
    quadric_ = mirror.canonical
    # from_matrix may turn a sheet's axis round: the technique turns it to the patch.
    up = quadric._towards(quadric_, oracles.move(pose, oracles.surface_points(name, rng, 50)))
    return dataclasses.replace(mirror, canonical=up), pose


def searched(quadric_, eye, points, device, warm=None):
    """(status, reflection points, eye-frame virtual points) of the float32 search, world frame."""
    matrix = quadric_patch.similarity(quadric_)
    camera = looking(eye, quadric_.origin)
    scene = type("At", (Origin,), {"device": device})
    frame = solve_frame(scene, camera, matrix)
    vertices = empty_vertices(len(points), device, with_position=True)
    if warm is not None:
        wp.copy(vertices.seed, warm.seed)
    array = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    inputs = [
        0,
        array,
        0,
        0,
        quadric_patch.device_view(quadric_),
        frame,
        camera.view(scene),
        int(warm is not None),
        vertices,
    ]
    wp.launch(quadric_patch.search_kernel, dim=len(points), inputs=inputs, device=device)
    back = np.linalg.inv(matrix)
    seed = vertices.seed.numpy().astype(np.float64) @ back[:3, :3].T + back[:3, 3]
    return vertices.status.numpy(), seed, vertices.position.numpy().astype(np.float64), vertices


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("name", oracles.CONVEX)
def test_search_finds_the_constructed_point(name, size, device):
    rng = np.random.default_rng(5)
    mirror, pose = placed_mirror(name, rng, size)
    worst_angle, solved, asked = 0.0, 0, 0
    for distance in (0.5, 3.0, 30.0):
        truth = oracles.constructed(name, rng, 400, distance, near=0.05, far=100.0)
        eye, points, r, n = (oracles.move(pose, x) for x in (truth.eye, truth.points, truth.reflection, truth.normal))
        n = (n - pose[:3, 3]) / size
        status, _, virtual, _ = searched(mirror.canonical, eye, points, device)
        good = status == Status.CONVERGED
        solved, asked = solved + good.sum(), asked + len(good)
        image = points - 2.0 * np.einsum("ij,ij->i", points - r, n)[:, None] * n - eye
        angle = np.linalg.norm(np.cross(image, virtual), axis=1) / np.linalg.norm(image, axis=1) ** 2
        # float32 points carry roundings of their distance from the origin; what they move on the screen is theirs.
        rounding = 6e-8 * (np.abs(points).max(axis=1) + np.abs(eye).max()) / np.linalg.norm(image, axis=1)
        worst_angle = max(worst_angle, float((angle - 20.0 * rounding)[good].max()))
    assert solved >= 0.995 * asked
    assert worst_angle < 3e-4  # a third of a pixel at 1000 pixels a radian; the median is 1e-7


def test_search_is_as_exact_as_float32_on_a_sphere(device):
    rng = np.random.default_rng(6)
    truth = oracles.constructed("sphere", rng, 2000, 3.0)
    status, r, _, _ = searched(QuadricMirror.sphere([0, 0, 0], 1.0).canonical, truth.eye, truth.points, device)
    assert (status == Status.CONVERGED).all()
    error = np.linalg.norm(r - truth.reflection, axis=1)
    assert np.median(error) < 1e-6 and error.max() < 1e-4


@pytest.mark.parametrize("name", ["sphere", "paraboloid", "two sheets"])
def test_search_agrees_with_the_papers_curve_search(name, device):
    """Lages Miguel et al. 2014 walk along the curve where the mirror meets the coplanarity quadric."""
    rng = np.random.default_rng(7)
    truth = oracles.constructed(name, rng, 300, 2.0, near=0.2, far=10.0, max_degrees=70.0)
    mirror = QuadricMirror.from_matrix(oracles.matrix_of(name), sheet=1 if name == "two sheets" else 0)
    curve = solve(mirror, truth.eye, truth.points, method="qim", device=device)
    status, r, _, _ = searched(mirror.canonical, truth.eye, truth.points, device)
    both = (status == Status.CONVERGED) & (curve.status == Status.CONVERGED)
    assert both.mean() > 0.95
    # A minimum of the path length is known to the root of its rounding, here of float64.
    np.testing.assert_allclose(r[both], curve.point[both], atol=2e-5)


@pytest.mark.parametrize("name", ["sphere", "ellipsoid 3:1:1", "elliptic cylinder", "cone", "elliptic paraboloid"])
def test_statuses_agree_with_the_bare_solver(name, device):
    rng = np.random.default_rng(8)
    mirror = QuadricMirror.from_matrix(oracles.matrix_of(name), sheet=1 if name == "cone" else 0)
    eye = oracles.constructed(name, rng, 10, 3.0).eye
    points = rng.normal(size=(4000, 3)) * 3.0
    status, _, _, _ = searched(mirror.canonical, eye, points, device)
    bare = solve(mirror, eye, points, device=device).status
    shown = np.isin(bare, [Status.CONVERGED, Status.GRAZING, Status.DEGENERATE])  # degenerate: at a cone's apex
    hidden = np.isin(bare, [Status.HIDDEN, Status.INSIDE])
    assert (shown | hidden).all()
    assert ((status == Status.CONVERGED) == shown).mean() > 0.998
    assert ((status == Status.HIDDEN) == hidden).mean() > 0.998


def test_degenerate_points_are_answered_without_nan(device):
    sphere = QuadricMirror.sphere([0, 0, 0], 1.0).canonical
    eye = np.array([0.0, 0.0, 3.0])
    points = np.array(
        [[0, 0, 1], [0, 0, -1], [0, 0, 0], [0, 0, 3], [0, 0, 5], [1, 0, 0], [1e-20, 0, 2], [1e6, 0, 1e6]], float
    )
    status, r, virtual, vertices = searched(sphere, eye, points, device)
    assert status.tolist() == [1, 3, 3, 1, 1, 3, 1, 1]
    for array in (r, virtual, vertices.screen.numpy(), vertices.reach.numpy(), vertices.residual.numpy()):
        assert np.isfinite(array).all()
    np.testing.assert_allclose(r[[0, 3, 4, 6]], [[0, 0, 1]] * 4, atol=1e-6)
    cone = QuadricMirror.rotational(-1, 0, 0, sheet=1).canonical
    status, _, virtual, _ = searched(cone, np.array([0.1, 0.0, -2.0]), np.array([[0, 0, -1], [0.3, 0.1, -3.0]]), device)
    assert (status == Status.CONVERGED).all()
    along = virtual / np.linalg.norm(virtual, axis=1, keepdims=True)
    apex = np.array([-0.1, 0.0, 2.0]) / np.hypot(0.1, 2.0)
    np.testing.assert_allclose(along, [apex, apex], atol=1e-6)  # both appear at the apex


def test_warm_start_ends_where_a_cold_one_does(device):
    rng = np.random.default_rng(9)
    mirror, pose = placed_mirror("ellipsoid 3:1:1", rng, 1.0)
    truth = oracles.constructed("ellipsoid 3:1:1", rng, 500, 3.0)
    eye, points = oracles.move(pose, truth.eye), oracles.move(pose, truth.points)
    *_, before = searched(mirror.canonical, eye * 1.02, points, device)
    status, r, _, _ = searched(mirror.canonical, eye, points, device, warm=before)
    assert (status == Status.CONVERGED).all()
    assert np.linalg.norm(r - oracles.move(pose, truth.reflection), axis=1).max() < 1e-4


@pytest.mark.parametrize("name", CONCAVE)
def test_branches_hold_the_constructed_point(name, device):
    """Seen from within: the constructed point is in one of the branches, or a shorter path of its index is."""
    rng = np.random.default_rng(10)
    mirror = QuadricMirror.from_matrix(oracles.matrix_of(name))
    side = -1 if name != "hyperbolic paraboloid" else 1
    found = asked = 0
    for _ in range(4):
        truth = oracles.constructed(name, rng, 300, 0.7, near=0.05, far=2.0, side=side, max_degrees=60.0)
        middle = truth.reflection.mean(axis=0)
        camera = looking(truth.eye, middle, size=(200, 200), focal=100.0)
        ray = truth.reflection - truth.eye
        depth = ray @ camera.forward
        x = camera.fx * (ray @ camera.right) / depth + camera.cx
        y = -camera.fy * (ray @ camera.up) / depth + camera.cy
        seen = (depth > 0) & (np.abs(x - 100) < 100) & (np.abs(y - 100) < 100)
        prepared = quadric_branches.prepare_side(Reflector(1, 0, False), mirror.canonical, side)
        scene = type("At", (), {"origin": np.zeros(3), "device": device})
        view = quadric_branches.lattice(scene, prepared, camera, (0, 0, 200, 200))
        frame = solve_frame(scene, camera, prepared.unit_from_scene)
        points = wp.array(truth.points.astype(np.float32), dtype=wp.vec3, device=device)
        answers = [empty_vertices(len(points), device, with_position=True) for _ in range(quadric_branches.BRANCHES)]
        inputs = [0, points, 0, 0, view, frame, camera.view(scene), *answers]
        wp.launch(quadric_branches.search_branches_kernel, dim=len(points), inputs=inputs, device=device)
        q = mirror.matrix * side
        back = np.linalg.inv(prepared.unit_from_scene)
        matched = np.zeros(len(seen), bool)
        length = np.linalg.norm(truth.eye - truth.reflection, axis=1) + np.linalg.norm(
            truth.points - truth.reflection, axis=1
        )
        for answer in answers:
            good = answer.status.numpy() == Status.CONVERGED
            r = answer.seed.numpy().astype(np.float64) @ back[:3, :3].T + back[:3, 3]
            for k in np.flatnonzero(good)[:40]:
                assert oracles.reflection_error(q, truth.eye, truth.points[k], r[k]) < 2e-3
            shorter = np.linalg.norm(truth.eye - r, axis=1) + np.linalg.norm(truth.points - r, axis=1) < length
            matched |= good & ((np.linalg.norm(r - truth.reflection, axis=1) < 1e-3) | shorter)
        found, asked = found + matched[seen].sum(), asked + seen.sum()
    assert asked > 200
    assert found >= 0.95 * asked  # pairs of roots that are about to merge share a cell of the lattice


def mesh_of(built: MeshData, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corner points and normals of a tessellated solid's first patch under an affine map, float32 as a stage gives them."""
    patch = built.parts[0].patches[0]
    own = slice(patch.first_triangle, patch.first_triangle + patch.triangle_count)
    points = built.points[built.triangles[own]].reshape(-1, 3).astype(np.float64)
    normals = built.normals[built.normal_index[own]].reshape(-1, 3).astype(np.float64)
    normals = normals @ np.linalg.inv(matrix[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return oracles.move(matrix, points).astype(np.float32), normals.astype(np.float32)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("axes", [(1, 1, 1), (3, 2, 1), (1, 1, 0.01), (1, 0.01, 0.01)])
def test_fit_finds_the_half_axes_of_an_ellipsoid(axes, size):
    rng = np.random.default_rng(11)
    pose = oracles.random_pose(rng, size, offset=2.0) @ np.diag([*map(float, axes), 1.0])
    fit = fit_quadric(*mesh_of(gprims.sphere(1.0), pose))
    assert fit.quadric.kind == QuadricKind.ELLIPSOID
    np.testing.assert_allclose(np.sort(fit.half_axes) / size, np.sort(axes), rtol=2e-3)
    assert fit.distance < 1e-6 * size and fit.sine < 3e-3  # of a rim 100 times as curved as the body


@pytest.mark.parametrize(
    ("built", "kind"),
    [
        (gprims.cylinder(0.4, 0.4, 2.0, "Z"), QuadricKind.ELLIPTIC_CYLINDER),
        (gprims.cylinder(0.6, 0.3, 1.0, "Z"), QuadricKind.CONE),
    ],
)
def test_fit_knows_a_cylinder_and_a_cone(built, kind):
    pose = oracles.random_pose(np.random.default_rng(12), 5.0, offset=1.0)
    fit = fit_quadric(*mesh_of(built, pose))
    assert fit.quadric.kind == kind
    assert fit.distance < 1e-5 * 5.0 and fit.sine < 1e-4


def test_fit_of_what_is_no_quadric_says_so():
    rng = np.random.default_rng(13)
    points, normals = mesh_of(gprims.sphere(1.0), np.eye(4))
    bumpy = points * (1.0 + 0.05 * np.sin(7.0 * points[:, :1]))
    assert fit_quadric(bumpy, normals).distance > 0.005
    assert fit_quadric(points[:9], normals[:9]) is None
    assert fit_quadric(np.zeros((50, 3)), normals[:50]) is None
    assert fit_quadric(np.full((50, 3), np.nan), normals[:50]) is None
    flat = np.concatenate([rng.normal(size=(50, 2)), np.zeros((50, 1))], axis=1)
    fit = fit_quadric(flat, np.tile([0.0, 0.0, 1.0], (50, 1)))
    assert fit is None or fit.distance > 1e-3 or fit.sine > 1e-3


def room(mirror: MeshData, material: MaterialData = CHROME, eye=(0.1, 0.3, 4.0), wall: bool = False) -> Scene:
    """A mirror at z = -1 among balls, with or without a wall behind the camera, which looks down -Z."""
    ball = gprims.sphere(0.3)
    instances = [InstanceData(0, translation(0, 0, -1), "/mirror", (0,) * max(len(mirror.parts), 1))]
    rng = np.random.default_rng(0)
    for k in range(8):
        x, y, z = rng.uniform(-2.5, 2.5), rng.uniform(-1, 1.5), rng.uniform(0, 4)
        instances.append(InstanceData(1, translation(x, y, z), f"/ball{k}", (1,)))
    if wall:
        instances.append(InstanceData(2, translation(0, 0, 8), "/wall", (1,)))
    camera = CameraData("/camera", translation(*eye), near=0.05, focal_length=22.0)
    return Scene(
        SceneData(
            "room", [mirror, ball, gprims.plane(60.0, 60.0, "Z")], instances, [material, MaterialData()], [], [camera]
        )
    )


def translation(x, y, z) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def plain_mesh(built: MeshData, kept=slice(None)) -> MeshData:
    """The triangles as a mesh that does not know what it was made from."""
    return MeshData(built.points, built.triangles[kept], built.normals, built.normal_index[kept])


def render(scene, method, size=(160, 90), **settings):
    plan = wr.make_plan(scene, size=size, settings=wr.Settings(**settings), method=method)
    return wr.render_frame(scene, plan)


def identical(frame, reference) -> float:
    compared = wr.compare_frames(frame, reference)
    assert compared.interior_pixels > 500
    return compared.share(compared.identical)


def test_mesh_of_a_sphere_is_recognised_and_shows_its_own_surface(device):
    scene = room(plain_mesh(gprims.sphere(1.0)))
    frame = render(scene, "quadric")
    row = frame.plan.rows[0]
    assert row.technique == "quadric" and "recognised as ellipsoid (1 x 1 x 1)" in row.reason and "px" in row.reason
    assert identical(frame, render(scene, "reference")) >= 0.999
    settled = frame.statistics["candidate"] + frame.statistics["walk"] + frame.statistics.get("empty", 0)
    assert settled > 0.8 * (frame["reflectorId"] > 0).sum()


def test_mesh_that_is_no_quadric_is_refused_with_its_residual():
    built = gprims.sphere(1.0)
    dented = dataclasses.replace(plain_mesh(built), points=built.points.copy())
    dented.points[:, 0] += 0.1 * np.sin(4.0 * dented.points[:, 1])
    row = render(room(dented), "quadric").plan.rows[0]
    assert row.technique == "raytraced" and "not recognised" in row.reason and "px" in row.reason


@pytest.mark.parametrize(
    "built", [gprims.cone(0.9, 1.5, "Y"), gprims.capsule(0.5, 0.3, 0.8, "Y"), gprims.cylinder(0.7, 0.4, 1.2, "X")]
)
def test_solid_with_rims_is_solved_patch_by_patch(built):
    scene = room(built, eye=(0.1, 0.9, 3.0))
    frame = render(scene, "quadric")
    assert frame.plan.rows[0].technique == "quadric"
    assert frame.statistics["pieces"] >= 1
    assert identical(frame, render(scene, "reference")) >= 0.999
    assert frame.statistics["bvh"] < 0.5 * (frame["reflectorId"] > 0).sum()


def test_mesh_with_rims_is_recognised_sheet_by_sheet():
    scene = room(plain_mesh(gprims.cylinder(0.7, 0.4, 1.2, "X")), eye=(1.5, 0.9, 3.0))
    frame = render(scene, "quadric")
    reason = frame.plan.rows[0].reason
    assert "recognised as cone, plane (3 patches)" in reason
    assert identical(frame, render(scene, "reference")) >= 0.999
    # A capsule is smooth all over and no quadric.
    row = render(room(plain_mesh(gprims.capsule(0.5, 0.5, 0.8, "Y"))), "quadric").plan.rows[0]
    assert row.technique == "raytraced" and "not recognised" in row.reason


@pytest.mark.parametrize("is_mirrored", [False, True])
def test_what_moves_is_recognised_once_and_as_what_it_is_where_it_stands(is_mirrored, monkeypatch):
    """A cylinder with rims, turned, shifted and three times as large: as one of the same place that does not move."""
    turned = oracles.random_pose(np.random.default_rng(3), 3.0)
    if (np.linalg.det(turned) < 0.0) != is_mirrored:
        turned[:, 0] *= -1.0
    data = room(plain_mesh(gprims.cylinder(0.7, 0.4, 1.2, "X"))).source_data
    asked = []
    fitted = quadric_sheets.fit_quadric
    monkeypatch.setattr(quadric_sheets, "fit_quadric", lambda *given: asked.append(1) or fitted(*given))

    def at(place: np.ndarray, moves: bool, earlier: Scene | None = None) -> Scene:
        mirror = dataclasses.replace(data.instances[0], world_from_object=place, moves=moves)
        return Scene(dataclasses.replace(data, instances=[mirror, *data.instances[1:]]), earlier=earlier)

    still, before = at(turned, False), at(translation(0.2, 0.1, 0.0) @ turned, True)
    expected, _ = quadric_sheets.sheets_of(still, 0), quadric_sheets.sheets_of(before, 0)
    asked.clear()
    moved = at(turned, True, before)
    found = quadric_sheets.sheets_of(moved, 0)
    assert bool(asked) == is_mirrored
    assert [sheet.name for sheet in found] == [sheet.name for sheet in expected] and len(found) == 3
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours.triangles, theirs.triangles)
        assert ours.known and ours.distance == pytest.approx(theirs.distance, abs=1e-5)
        assert ours.sine == pytest.approx(theirs.sine, abs=1e-3)
        here, there = (
            each.host_points[each.host_triangles[ours.triangles]].reshape(-1, 3).astype(np.float64)
            for each in (moved, still)
        )
        if ours.plane is None:
            assert ours.quadric.kind == theirs.quadric.kind and np.linalg.det(ours.quadric.axes) == pytest.approx(1.0)
            assert max(ours.quadric.distances(here).max(), theirs.quadric.distances(there).max()) < 1e-5
            continue
        for sheet, points, scene in ((ours, here, moved), (theirs, there, still)):
            in_plane = np.append(points, np.ones((len(points), 1)), axis=1) @ sheet.plane.T
            assert np.abs(in_plane[:, 2]).max() < 1e-5 and np.abs(in_plane).max() < 2.0
            a, b, c = scene.host_points[scene.host_triangles[sheet.triangles[0]]]
            assert sheet.plane[2, :3] @ np.cross(b - a, c - a) > 0.0


def bowl() -> MeshData:
    """The far half of a sphere of radius 1: its inside faces +Z."""
    built = gprims.sphere(1.0)
    middle = built.points[built.triangles].mean(axis=1)
    half = plain_mesh(built, np.flatnonzero(middle[:, 2] < -0.6))
    half.double_sided = True
    return half


def test_bowl_shows_every_branch_from_within():
    scene = room(bowl(), eye=(0.05, 0.1, 1.5), wall=True)
    frame = render(scene, "quadric")
    assert frame.plan.rows[0].technique == "quadric" and "from within" in frame.plan.rows[0].reason
    assert identical(frame, render(scene, "reference")) >= 0.999
    assert frame.statistics["bvh"] < 0.5 * (frame["reflectorId"] > 0).sum()
    assert render(scene, "auto").plan.rows[0].technique == "raytraced"  # every vertex costs a search of all its roots
    papers = render(scene, "quadric", refine="off")
    both = (papers["reflectedId"] > 0) & (frame["reflectedId"] > 0)
    assert (papers["reflectedId"] == frame["reflectedId"])[both].mean() > 0.8


def test_eye_inside_the_mirror_is_traced_without_faults():
    scene = room(gprims.sphere(1.0))
    plan = wr.make_plan(scene, size=(64, 36), method="quadric")
    camera = dataclasses.replace(plan.camera, eye=np.array([0.1, 0.0, -1.0]), near=1e-3)
    frame = wr.render_frame(scene, plan, camera=camera)
    assert (frame["reflectorId"] > 0).all()
    assert all(np.isfinite(frame[name]).all() for name in frame.keys())


@pytest.mark.parametrize("name", GPRIM_SCENES)
def test_scene_of_gprims_shows_what_the_reference_shows(name, device):
    scene = wr.load_stage(str(FOLDER / f"{name}.usda"), device=device)
    frame = render(scene, "quadric", size=(320, 180))
    assert {row.technique for row in frame.plan.rows} == {"quadric"}
    assert identical(frame, render(scene, "reference", size=(320, 180))) >= 0.999
