"""The forward pass on small scenes: planes against a mirrored eye, grids, warm starts, cutting, refinement."""

import dataclasses

import numpy as np
import pytest
from rooms import CHROME, identical, placed, plane_room, render, room, sphere, square

import warp_reflect as wr
from warp_reflect.layers import Camera
from warp_reflect.scene import CameraData, InstanceData, MaterialData, Scene, SceneData
from warp_reflect.settings import Status
from warp_reflect.techniques import virtual_mesh
from warp_reflect.techniques.vertices import VERTEX_ARRAYS


@pytest.fixture(scope="module")
def ball_room():
    return room(sphere(), placed(0, 0, -1))


def test_planar_without_refinement_equals_the_reference():
    scene = plane_room()
    frame = render(scene, "planar", refine="off")
    assert {row.technique for row in frame.plan.rows} == {"planar"}
    assert identical(frame, render(scene, "reference")) > 0.999


def test_planar_equals_the_picture_of_a_mirrored_eye():
    """What a plane at z = -2 shows is what an eye behind it sees, flipped: other code draws that picture."""
    scene = plane_room()
    frame = render(scene, "planar")
    camera = frame.camera
    flip = np.array([1.0, 1.0, -1.0])
    behind = Camera(
        eye=camera.eye * flip - [0, 0, 4],
        right=camera.right * flip,
        up=camera.up * flip,
        forward=camera.forward * flip,
        fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy, near=6.05, far=camera.far, size=camera.size,
    )  # fmt: skip
    direct = render(scene, "planar", camera=behind)
    mirror = frame["reflectorId"] > 0
    same = frame["reflectedId"][mirror] == np.where(direct["primId"][mirror] == 1, 0, direct["primId"][mirror])
    assert same.mean() > 0.995


def test_plane_seen_edge_on_or_from_its_plane_is_finite():
    scene = plane_room()
    camera = wr.make_plan(scene, size=(64, 36)).camera
    for z in (-2.0, -2.0 + 1e-9, -2.5):
        frame = render(scene, "planar", size=(64, 36), camera=dataclasses.replace(camera, eye=np.array([0, 0.3, z])))
        assert all(np.isfinite(frame[name]).all() for name in frame.keys())


@pytest.mark.parametrize("settings", [{}, {"grid_share": 0.1}, {"grid_share": 0.1, "grid_kind": "position"}])
def test_refined_frame_equals_the_reference(ball_room, settings):
    assert identical(render(ball_room, "reflector_map", **settings), render(ball_room, "reference")) >= 0.999


def test_warm_start_gives_the_same_hits(ball_room):
    cold = render(ball_room, "reflector_map")
    warm = render(ball_room, "reflector_map", previous=cold, keep_static=False)
    assert identical(warm, cold) >= 0.9999


def test_cutting_large_triangles_brings_their_picture_closer():
    """A floor of two triangles: its checkerboard-free picture bends; cut, its points move to where they belong."""
    scene = room(sphere(), placed(0, 0, -1), floor_cells=1)
    reference = render(scene, "reference")
    floor = reference["reflectedId"] == 2
    medians = []
    for edge_px in (0.0, 4.0, 0.25):
        frame = render(scene, "reflector_map", refine="off", edge_px=edge_px)
        both = floor & (frame["reflectedId"] == 2)
        distance = np.linalg.norm(frame.relative("reflectedPoint") - reference.relative("reflectedPoint"), axis=-1)
        medians.append(np.median(distance[both]) if both.sum() > 50 else np.inf)
    assert medians[2] < 0.2 * medians[0] and medians[2] <= medians[1]


def test_lattice_tiles_its_triangle():
    weights, triangles = virtual_mesh.lattice_of(8)
    assert len(triangles) == 64
    corner = weights[triangles] * [0.0, 1.0, 1.0]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_allclose(area[:, 0], 1 / 64)


@pytest.mark.parametrize("method", ["quadric", "reflector_map"])
def test_what_cutting_adds_is_taken_over_from_what_was_solved(ball_room, method, monkeypatch):
    """Corners and middles keep their answers bit for bit; the others are where a search from nothing finds them."""
    knobs = {"edge_px": 0.05, "reuse_px": 0.5}
    history = next(iter(render(ball_room, method, **knobs).layers.values())).history
    mesh, base = history.mesh, history.mesh.base_count
    place, corners = mesh.added_place, ball_room.host_triangles[mesh.added_triangle]
    weights = np.stack([1.0 - place.sum(1), place[:, 0], place[:, 1]], 1)
    assert (weights.max(1) < 1.0).sum() > 300 and (np.sort(weights, 1)[:, 1] < 0.5).sum() > 100
    for name in VERTEX_ARRAYS:
        values = getattr(history.vertices, name).numpy()
        for k in range(3):
            at = np.flatnonzero(weights[:, k] == 1.0)
            assert len(at) > 100
            np.testing.assert_array_equal(values[base + at], values[corners[at, k]], err_msg=name)
    monkeypatch.setattr(virtual_mesh, "start_middles", lambda *given: None)
    monkeypatch.setattr(virtual_mesh, "start_added", lambda *given: None)
    again = next(iter(render(ball_room, method, **knobs).layers.values())).history
    np.testing.assert_array_equal(again.mesh.added_place, place)
    status, anew = history.vertices.status.numpy(), again.vertices.status.numpy()
    np.testing.assert_array_equal(status, anew)
    there, from_nothing = (each.vertices.screen.numpy()[status == 1] for each in (history, again))
    assert np.abs(there[:, :2] - from_nothing[:, :2]).max() < 0.02


def test_statistics_count_every_mirror_pixel(ball_room):
    frame = render(ball_room, "reflector_map")
    settled = sum(frame.statistics.get(name, 0) for name in ("candidate", "walk", "empty", "bvh"))
    assert settled == (frame["reflectorId"] > 0).sum()
    assert set(np.unique(frame["status"])) <= {int(Status.NONE), int(Status.CONVERGED), int(Status.SKY)}


def test_eye_inside_the_mirror_is_traced_without_faults(ball_room):
    camera = dataclasses.replace(wr.make_plan(ball_room, size=(64, 36)).camera, eye=np.array([0, 0, -1.0]), near=1e-3)
    frame = render(ball_room, "reflector_map", size=(64, 36), camera=camera)
    assert (frame["reflectorId"] > 0).all()
    assert all(np.isfinite(frame[name]).all() for name in frame.keys())


def test_unknown_channel_lists_the_known(ball_room):
    frame = render(ball_room, "reference", size=(32, 18))
    with pytest.raises(KeyError, match="pathLength"):
        frame["depth"]
    assert frame["N.X"].shape == (18, 32) and frame["RGBA"].shape == (18, 32, 4)


@pytest.mark.parametrize("method", ["quadric", "reflector_map"])
def test_floors_of_few_large_triangles_are_whole(method):
    """Two triangles a hundred times as large as the mirror, partly hidden by it, and a strip closely above them."""
    floor, strip = square(1, 60.0), square(1, 60.0)
    strip = dataclasses.replace(strip, points=strip.points * np.float32([0.04, 1.0, 1.0]))
    instances = [InstanceData(0, placed(0.0, 0.0, -1.0, 0.8), "/mirror", (0,))]
    instances += [InstanceData(1, placed(0.0, -0.9, 0.0), "/floor", (1,))]
    instances += [InstanceData(2, placed(0.9, -0.88, 0.0), "/strip", (1,))]
    cameras = [CameraData("/camera", placed(0.3, 0.9, 3.0), near=0.05, focal_length=24.0)]
    scene = Scene(SceneData("floors", [sphere(), floor, strip], instances, [CHROME, MaterialData()], [], cameras))
    frames = [render(scene, how, size=(240, 136)) for how in (method, "reference")]
    assert identical(*frames) >= 0.998
    assert frames[0].statistics["bvh"] < 0.6 * (frames[0]["reflectorId"] > 0).sum()
