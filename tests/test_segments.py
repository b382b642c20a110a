"""Meshes of known shape cut into sheets: kinds, shares, determinism; and the sheets' mirrors against traced rays."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from rooms import CHROME, identical, placed, render, sphere, square

import warp_reflect as wr
from warp_reflect.bodies import fit_sheet
from warp_reflect.cubemap import project_to_cube
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView
from warp_reflect.scene import CameraData, InstanceData, MaterialData, MeshData, Scene, SceneData
from warp_reflect.segments import segment
from warp_reflect.techniques import sheet_branches
from warp_reflect.techniques.quadric_branches import Root

wp.set_module_options({"enable_backward": False})


def surface(function, rows, columns, span_u, span_v):
    """(points, faces, corner normals) of a parametrised patch; outside where the cross product of its axes points."""
    u, v = np.meshgrid(np.linspace(*span_u, rows + 1), np.linspace(*span_v, columns + 1), indexing="ij")
    step = 1e-5
    points = function(u, v)
    normal = np.cross(function(u + step, v) - function(u - step, v), function(u, v + step) - function(u, v - step))
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-300)
    i = np.arange(rows * columns)
    a = i // columns * (columns + 1) + i % columns
    c = a + columns + 1
    faces = np.concatenate([np.stack([a, c, a + 1], 1), np.stack([a + 1, c, c + 1], 1)])
    # Ends that meet must meet bit by bit.
    return np.round(points.reshape(-1, 3), 7), faces, normal.reshape(-1, 3)[faces]


def torus(rows=96, columns=48, tube=0.35):
    def point(u, v):
        ring = 1.0 + tube * np.cos(v)
        return np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], -1)

    return surface(point, rows, columns, (0, 2 * np.pi), (0, 2 * np.pi))


def dome(rows=24, columns=64, angle=70.0, axes=(1.0, 1.0, 1.0)):
    def point(u, v):
        return np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], -1) * axes

    return surface(point, rows, columns, (1e-3, np.radians(angle)), (0, 2 * np.pi))


def car(rows=160, columns=80):
    """A bonnet, a windscreen, a roof and a boot as one sheet: convex panels with hollow valleys between them."""

    def point(u, v):
        rise = 0.22 * (np.tanh(3.5 * (u + 0.75)) - np.tanh(3.5 * (u - 0.95)))
        height = 0.7 + rise - 0.05 * u**2 - 0.28 * v**2 * (1.0 + 0.4 * rise)
        return np.stack([u, v, height], -1)

    return surface(point, rows, columns, (-2.0, 2.0), (-0.8, 0.8))


def box(low, high):
    corner = np.array([[low[k] if not (i >> k) & 1 else high[k] for k in range(3)] for i in range(8)], float)
    quads = [(0, 4, 6, 2), (1, 3, 7, 5), (0, 1, 5, 4), (2, 6, 7, 3), (0, 2, 3, 1), (4, 5, 7, 6)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    return corner, faces, facet_normals(corner, faces)


def facet_normals(points, faces):
    p = points[faces]
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.repeat(normal[:, None], 3, axis=1)


def kinds(found):
    return sorted(s.kind for s in found.segments)


def assert_is_a_partition(found, faces):
    held = np.concatenate([s.triangles for s in found.segments])
    assert len(np.unique(held)) == len(held) and held.min() >= 0 and held.max() < len(faces)
    assert all((np.diff(s.triangles) > 0).all() for s in found.segments)


def test_torus_falls_into_its_outer_half_and_a_saddle_that_is_left():
    points, faces, normals = torus()
    found = segment(points, faces, normals)
    assert kinds(found) == ["convex"]
    middle = points[faces].mean(axis=1)
    outer = np.hypot(middle[:, 0], middle[:, 1]) > 1.0
    # The outer half holds 1/2 + tube / pi of the area.
    np.testing.assert_allclose(found.held, 0.5 + 0.35 / np.pi, atol=0.02)
    assert outer[found.segments[0].triangles].mean() > 0.99
    assert found.saddle > 0.3 and "curves both ways" in str(found)
    assert "1 piece holds 61 %" in str(found)


def test_capsule_and_box_fall_into_a_convex_sheet_and_six_planes():
    def capsule(u, v):
        z = np.clip(u, -0.5, 0.5)
        turn = np.clip(np.pi * (u - z), -np.pi / 2 + 1e-3, np.pi / 2 - 1e-3)
        return np.stack([np.cos(turn) * np.cos(-v), np.cos(turn) * np.sin(-v), 2 * z + np.sin(turn)], -1)

    points, faces, _ = surface(capsule, 40, 48, (-1.0, 1.0), (0, 2 * np.pi))
    more = box((3, -1, -1), (5, 1, 1))
    found = segment(
        np.concatenate([points, more[0]]),
        np.concatenate([faces, more[1] + len(points)]),
        np.concatenate([facet_normals(points, faces), more[2]]),
    )
    assert kinds(found) == ["convex"] + ["planar"] * 6
    assert found.held > 0.99


@pytest.mark.parametrize("shading", ["smooth", "flat"])
def test_car_falls_into_convex_and_hollow_sheets(shading):
    points, faces, normals = car()
    assert len(faces) > 20000
    normals = normals if shading == "smooth" else facet_normals(points, faces)
    found = segment(points, faces, normals)
    assert_is_a_partition(found, faces)
    assert len(found.segments) >= 3 and kinds(found).count("convex") >= 2
    assert 0.4 < found.held < 1.0
    for sheet in found.segments:
        # By their own geometry: the centre sees every facet from the side that the kind says.
        p = points[faces[sheet.triangles]]
        side = np.einsum("ij,ij->i", np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), p[:, 0] - sheet.sheet.centre)
        assert (side > 0).all() if sheet.kind == "convex" else (side < 0).all()


@pytest.mark.parametrize("turned", [False, True])
def test_dome_is_convex_and_hollow_from_its_other_side(turned):
    points, faces, normals = dome()
    if turned:
        faces, normals = faces[:, [0, 2, 1]], -normals[:, [0, 2, 1]]
    found = segment(points, faces, normals)
    assert kinds(found) == ["concave" if turned else "convex"]
    assert found.held > 0.9999 and "traced" not in str(found)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_segmentation_is_the_same_at_any_scale_and_place_and_bit_by_bit_repeatable(scale):
    points, faces, normals = car(60, 40)
    plain = segment(points, faces, normals)
    again = segment(points.copy(), faces.copy(), normals.copy())
    moved = segment(points * scale + 7.0 * scale, faces, normals)
    assert len(plain.segments) == len(again.segments) == len(moved.segments)
    for a, b, c in zip(plain.segments, again.segments, moved.segments, strict=True):
        np.testing.assert_array_equal(a.triangles, b.triangles)
        np.testing.assert_array_equal(a.triangles, c.triangles)
        assert a.kind == b.kind == c.kind and (a.sheet.centre == b.sheet.centre).all()
        np.testing.assert_allclose(c.area, a.area * scale**2, rtol=1e-6)


@pytest.mark.parametrize(
    ("points", "faces"),
    [
        (np.zeros((3, 3)), [[0, 1, 2]]),
        (np.eye(3), [[0, 1, 2], [0, 0, 1], [2, 2, 2]]),
        (np.r_[np.eye(3), [[1, 1, 1]]], [[0, 1, 2], [0, 1, 3], [1, 0, 2], [1, 0, 3]]),
    ],
)
def test_degenerate_meshes_have_finite_sheets_or_none(points, faces):
    faces = np.array(faces)
    found = segment(points, faces, facet_normals(points, faces))
    assert 0.0 <= found.held <= 1.0 + 1e-12
    assert all(np.isfinite(s.sheet.centre).all() and np.isfinite(s.sheet.extent).all() for s in found.segments)


def test_sheet_of_a_dome_knows_its_convexity():
    points, faces, _ = dome()
    good, bad = (fit_sheet(points[faces], inner) for inner in (False, True))
    assert good.cosine > 0.8 and good.overhang < 1e-6
    assert bad.overhang > 0.1 or bad.cosine < 0.0


def stage(mesh, eye):
    """A mirror at the origin in a room of balls over a floor; the camera looks down -Z."""
    points, faces, normals = mesh
    mirror = MeshData(
        points.astype(np.float32),
        faces.astype(np.int32),
        normals.reshape(-1, 3).astype(np.float32),
        normal_index=np.arange(3 * len(faces), dtype=np.int32).reshape(-1, 3),
        double_sided=True,
    )
    plain = dataclasses.replace(sphere(12, 24), parts=[])
    instances = [InstanceData(0, np.eye(4), "/mirror", (0,)), InstanceData(1, placed(0, -2.2, 0), "/floor", (1,))]
    rng = np.random.default_rng(0)
    for k in range(8):
        x, y = rng.uniform(-3, 3, 2)
        instances.append(InstanceData(2, placed(x, y, rng.uniform(2.0, 4.0), 0.35), f"/ball{k}", (1,)))
    camera = CameraData("/camera", placed(*eye), near=0.05, focal_length=30.0)
    meshes = [mirror, square(12, 6.0), plain]
    return Scene(SceneData("stage", meshes, instances, [CHROME, MaterialData()], [], [camera]))


def hollow(radius=1.0, angle=40.0):
    """A cap over the origin seen from within; its focus lies at half the radius."""
    points, faces, normals = dome(angle=angle)
    return radius * (points * [1, 1, -1] + [0, 0, 1]), faces, normals * [-1, -1, 1]


def lying_torus():
    points, faces, normals = torus()
    return points[:, [2, 0, 1]], faces, normals[..., [2, 0, 1]]


@pytest.mark.parametrize(
    ("mesh", "eye", "bvh_max"),
    [
        (dome(), (0.1, 0.2, 5.0), 0.2),
        (dome(angle=50.0, axes=(1.5, 1.0, 0.4)), (0.3, 0.2, 4.0), 0.2),
        (lying_torus(), (0.3, 0.4, 4.5), 0.7),
        (hollow(9.0, 20.0), (0.1, 0.2, 8.0), 1.0),
        (hollow(), (0.1, 0.2, 3.0), 1.0),
    ],
    ids=["dome", "bonnet", "torus", "hollow near", "hollow far"],
)
def test_open_and_hollow_mirrors_show_what_tracing_shows(mesh, eye, bvh_max):
    scene = stage(mesh, eye)
    frame = render(scene, "reflector_map")
    row = frame.plan.rows[0]
    assert row.technique == "reflector_map" and "of its triangles' area" in row.reason
    assert identical(frame, render(scene, "reference")) >= 0.999
    pixels = (frame["reflectorId"] > 0).sum()
    assert frame.statistics["bvh"] <= bvh_max * pixels
    assert all(np.isfinite(frame[name]).all() for name in frame.keys())


def test_hollow_cap_shows_its_near_and_its_far_field_by_search():
    for mesh, eye in ((hollow(9.0, 20.0), (0.1, 0.2, 8.0)), (hollow(), (0.1, 0.2, 3.0))):
        frame = render(stage(mesh, eye), "reflector_map")
        statistics = frame.statistics
        assert statistics["drawn"] > 100 and statistics["candidate"] + statistics["walk"] > 100
        assert statistics["empty"] == 0  # where pictures may be missed, no pixel without one is sky by that alone


@wp.kernel
def polish_kernel(
    first: int,
    map: ReflectorMapView,
    eye: wp.array(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.vec3),
    out: wp.array(dtype=Root),
):
    i = first + wp.tid()
    out[i] = sheet_branches.polish(map, -1.0, eye[i], target[i], project_to_cube(start[i])).root


@pytest.mark.parametrize(("index", "beyond"), [(0, False), (2, True)])
def test_branches_of_a_hollow_sphere_have_the_index_of_their_focal_points(index, beyond):
    """Reflection points by construction: upright within both focal lengths, upside down beyond both."""
    points, faces, normals = dome(48, 128, 60.0)
    sheet = fit_sheet(points[faces], inner=False)
    drawn = ReflectorMap.from_sheet(points, faces, sheet, 256, normals=normals)
    rng = np.random.default_rng(3)
    count = 2000
    polar, turn = np.radians(rng.uniform(2, 40, count)), rng.uniform(0, 2 * np.pi, count)
    r = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1)
    tangent = np.cross(r, rng.normal(size=(count, 3)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    incidence = np.radians(rng.uniform(0, 40, count))[:, None]
    o = -np.cos(incidence) * r + np.sin(incidence) * tangent
    v = -np.cos(incidence) * r - np.sin(incidence) * tangent
    d_o = rng.uniform(1.2, 3.0, (count, 1))
    # Coddington's equations of a sphere of radius 1: the focal lengths in and across the plane of incidence.
    near = 1.0 / (2.0 / np.cos(incidence) - 1.0 / d_o)
    far = 1.0 / (2.0 * np.cos(incidence) - 1.0 / d_o)
    d_v = rng.uniform(1.3, 3.0, (count, 1)) * far if beyond else rng.uniform(0.1, 0.7, (count, 1)) * near
    m = drawn.unit_from_body
    unit = [x @ m[:3, :3].T + m[:3, 3] for x in (r + d_o * o, r + d_v * v, r + 0.02 * tangent)]
    unit[2] /= drawn.extent
    arrays = [wp.array(x.astype(np.float32), dtype=wp.vec3) for x in unit]
    out = wp.zeros(count, dtype=Root)
    wp.launch(polish_kernel, dim=count, inputs=[0, drawn.view, *arrays, out])
    root = out.numpy()
    found = (root["point"].astype(np.float64) - m[:3, 3]) @ np.linalg.inv(m[:3, :3]).T
    good = (root["valid"] == 1) & (np.linalg.norm(found - r, axis=1) < 2e-3)
    assert good.mean() > 0.97
    assert (root["index"][good] == index).mean() > 0.99
    assert all(np.isfinite(root[name]).all() for name in ("point", "normal", "angle", "length", "least"))


def test_open_map_tells_unreflected_from_hidden():
    """A dome is the upper half of a sphere: what the lower half would reflect is unreflected, not hidden."""
    points, faces, normals = dome(48, 128, 90.0)
    mirror = wr.ReflectorMap.from_mesh(points, faces, resolution=128, normals=normals)
    rng = np.random.default_rng(5)
    r = rng.normal(size=(600, 3))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    r = r[np.abs(r[:, 2]) > 0.1]
    tangent = np.cross(r, rng.normal(size=r.shape))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    o, v = r + 0.8 * tangent, r - 0.8 * tangent
    above = r[:, 2] > 0.0
    for k in range(0, len(r), 7):
        answer = wr.solve(mirror, r[k] + 4.0 * o[k], (r[k] + 3.0 * v[k])[None])
        if above[k]:
            assert answer.status[0] == wr.Status.CONVERGED
            assert np.linalg.norm(answer.point[0] - r[k]) < 5e-3
        else:
            assert answer.status[0] in (wr.Status.UNREFLECTED, wr.Status.INSIDE, wr.Status.HIDDEN)
            assert np.isfinite(answer.virtual).all()
    below = wr.solve(mirror, [4.0, 0, 0.6], np.array([[-4.0, 0, 0.3], [0.6, 0, 0.1], [4.0, 1.0, 3.0]]))
    assert below.status[0] == wr.Status.HIDDEN
    assert below.status[2] == wr.Status.CONVERGED
    side = wr.solve(mirror, [0, 0, -6.0], np.array([[0.0, 0.0, -4.0]]))
    assert side.status[0] == wr.Status.UNREFLECTED
