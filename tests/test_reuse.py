"""What is kept, left out or ordered otherwise between frames: reuse, culling, the painter's order."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from oracles import sphere_points
from rooms import identical, placed, plane_room, render, room, sphere

import warp_reflect as wr
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques.reuse import drift_rate

wp.set_module_options({"enable_backward": False})


@wp.kernel
def rate_kernel(
    first: int, seen: wp.array(dtype=wp.vec3), target: wp.array(dtype=wp.vec3), out_rate: wp.array(dtype=float)
):
    i = first + wp.tid()
    out_rate[i] = drift_rate(seen[i], target[i], 1.0)


def unit_sphere_virtual(eye, target):
    """Virtual vertices in the unit sphere at the origin, float64."""
    point, cosine = sphere_points(np.zeros(3), eye, target)
    legs = np.linalg.norm(point - eye, axis=1), np.linalg.norm(target - point, axis=1)
    return eye + (point - eye) * (1.0 + legs[1] / legs[0])[:, None], cosine


def test_drift_rate_bounds_how_far_virtual_vertices_move_on_the_screen():
    rng = np.random.default_rng(3)
    count = 4000
    eye = rng.normal(size=(count, 3))
    eye *= (1.2 + rng.exponential(3.0, count) / 1.0)[:, None] / np.linalg.norm(eye, axis=1, keepdims=True)
    target = rng.normal(size=(count, 3))
    target *= (1.05 + rng.exponential(2.0, count))[:, None] / np.linalg.norm(target, axis=1, keepdims=True)
    before, cosine = unit_sphere_virtual(eye, target)
    step = rng.normal(size=(count, 3))
    step *= 1e-5 / np.linalg.norm(step, axis=1, keepdims=True)
    after, _ = unit_sphere_virtual(eye + step, target)
    rate = wp.zeros(count, dtype=float)
    vectors = [wp.array((x - eye).astype(np.float32), dtype=wp.vec3) for x in (before, target)]
    wp.launch(rate_kernel, dim=count, inputs=[0, *vectors, rate])
    kept, true = before - eye - step, after - eye - step
    moved = np.linalg.norm(np.cross(kept, true), axis=1) / np.einsum("ij,ij->i", kept, true)
    seen = cosine > 0.05
    share = (moved / (rate.numpy() * 1e-5))[seen]
    assert seen.sum() > 1000
    # Above 1 by second order and by the float32 legs only; a bound ten times too wide would keep nothing.
    assert share.max() < 1.02
    assert np.median(share) > 0.3


@pytest.fixture(scope="module")
def ball_room():
    return room(sphere(), placed(0, 0, -1))


def moved_camera(scene, step, size=(160, 90)):
    camera = wr.make_plan(scene, size=size).camera
    return dataclasses.replace(camera, eye=camera.eye + step * camera.right)


def test_reuse_begins_after_a_frame_that_was_to_keep_nothing(ball_room):
    """Its virtual vertices were not stored: all are searched, and the next frame keeps them."""
    first = render(ball_room, "quadric")
    second = render(ball_room, "quadric", first, keep_static=False, reuse_px=0.5)
    third = render(ball_room, "quadric", second, keep_static=False, reuse_px=0.5)
    assert "reused" not in second.layers[1].statistics
    assert third.layers[1].statistics["reused"] > 0
    assert identical(second, first) == 1.0


def test_reuse_keeps_vertices_of_a_slow_eye_within_its_tolerance(ball_room):
    first = render(ball_room, "reflector_map", refine="off", reuse_px=0.5)
    camera = moved_camera(ball_room, 1e-3)
    kept = render(ball_room, "reflector_map", previous=first, camera=camera, refine="off", reuse_px=0.5)
    full = render(ball_room, "reflector_map", camera=camera, refine="off")
    assert 0.0 < kept.statistics["reused_px"] <= 0.5
    assert kept.statistics["reused"] > 0.5 * kept.statistics["vertices"]
    comparison = wr.compare_frames(kept, full)
    assert comparison.error_max_px < 1.0
    assert comparison.share(comparison.within_half_px) > 0.99


def test_reuse_of_a_still_eye_keeps_the_picture(ball_room):
    first = render(ball_room, "reflector_map", reuse_px=0.5)
    again = render(ball_room, "reflector_map", previous=first, reuse_px=0.5, keep_static=False)
    assert again.statistics["reused_px"] == 0.0
    assert np.array_equal(first["reflectedId"], again["reflectedId"])


def test_reuse_that_is_off_keeps_nothing(ball_room):
    first = render(ball_room, "reflector_map")
    again = render(ball_room, "reflector_map", previous=first, keep_static=False)
    assert "reused" not in again.statistics


def test_reuse_of_a_fast_eye_solves_anew(ball_room):
    first = render(ball_room, "reflector_map", reuse_px=0.1)
    camera = moved_camera(ball_room, 0.5)
    again = render(ball_room, "reflector_map", previous=first, camera=camera, reuse_px=0.1)
    assert again.statistics["reused"] < 0.05 * again.statistics["vertices"]
    assert identical(again, render(ball_room, "reference", camera=camera)) > 0.995


def with_ball(scene, place):
    """The scene and one more ball, of the same mesh as the last one."""
    ball = dataclasses.replace(scene.data.instances[-1], world_from_object=place, prim_path="/behind")
    return Scene(dataclasses.replace(scene.data, instances=[*scene.data.instances, ball]))


def test_objects_behind_a_plane_are_culled():
    scene = with_ball(plane_room(), placed(0.3, 0, -3, 0.4))
    frame = render(scene, "planar")
    assert frame.statistics["culled"] == scene.parts[-1].vertex_count
    assert identical(frame, render(scene, "reference")) == 1.0


def test_objects_behind_a_ball_are_culled(ball_room):
    scene = with_ball(ball_room, placed(0, 0, -2.6, 0.2))
    with_it = render(scene, "reflector_map")
    assert with_it.statistics["culled"] >= render(ball_room, "reflector_map").statistics["culled"] + 24 * 48
    assert identical(with_it, render(scene, "reference")) > 0.999


def test_painters_order_shows_what_path_length_hides(ball_room):
    exact = render(ball_room, "reflector_map", refine="off")
    painter = render(ball_room, "reflector_map", refine="off", occlusion="painter")
    assert 0.5 < identical(painter, exact) < 1.0


def test_painters_order_is_refused_with_refinement():
    with pytest.raises(ValueError, match=r"occlusion.*refine=off"):
        Settings(occlusion="painter")
