"""Reflection motion against analytic spheres and against the other frame's own picture."""

import dataclasses

import numpy as np
import pytest
from oracles import sphere_points
from rooms import identical, placed, plane_room, render, room, sphere

import warp_reflect as wr
from warp_reflect.scene import Scene


@pytest.fixture(scope="module")
def ball_room():
    return room(sphere(), placed(0, 0, -1))


def pixel_of(camera, points):
    """Pixel coordinates of world points, float64 [n, 2]."""
    p = points - camera.eye
    depth = p @ camera.forward
    return np.stack(
        [camera.cx + camera.fx * (p @ camera.right) / depth, camera.cy - camera.fy * (p @ camera.up) / depth], 1
    )


def moved(scene, path, offset):
    instances = [
        dataclasses.replace(
            i, world_from_object=i.world_from_object + np.pad(np.reshape(offset, (3, 1)), ((0, 1), (3, 0)))
        )
        if i.prim_path == path
        else i
        for i in scene.data.instances
    ]
    return Scene(dataclasses.replace(scene.data, instances=instances))


def errors(now, before, centre_before, offsets=None):
    """Pixels between the channel and the analytic motion, away from the silhouette."""
    seen = now["reflectedId"] > 0
    y, x = np.nonzero(seen)
    target = now.relative("reflectedPoint")[seen].astype(float) + now.camera.eye
    if offsets is not None:
        target = target - offsets[now["reflectedId"][seen].astype(int)]
    eye = np.broadcast_to(before.camera.eye, target.shape)
    r, cosine = sphere_points(np.broadcast_to(centre_before, target.shape), eye, target)
    expected = np.stack([x + 0.5, y + 0.5], 1) - pixel_of(before.camera, r)
    away = cosine > 0.15
    assert away.sum() > 800
    return np.linalg.norm(now["reflectionMotion"][seen] - expected, axis=1)[away]


def check(error):
    assert np.median(error) < 0.02
    assert np.quantile(error, 0.99) < 0.2


def test_motion_of_a_moving_eye_is_that_of_the_law_of_reflection(ball_room):
    before = render(ball_room, "reference")
    camera = dataclasses.replace(before.camera, eye=before.camera.eye + [0.15, -0.05, 0.1])
    check(errors(render(ball_room, "reference", previous=before, camera=camera), before, [0, 0, -1]))


def test_motion_of_a_moving_mirror_and_a_moving_object(ball_room):
    before = render(ball_room, "reference")
    step = np.array([0.05, 0.02, 0.04])
    check(errors(render(moved(ball_room, "/mirror", step), "reference", previous=before), before, [0, 0, -1]))
    scene = moved(ball_room, "/ball3", step)
    offsets = np.zeros((len(scene.data.instances) + 1, 3))
    offsets[1 + [i.prim_path for i in scene.data.instances].index("/ball3")] = step
    now = render(scene, "reflector_map", previous=before)
    check(errors(now, before, [0, 0, -1], offsets))


def test_motion_of_a_plane_finds_the_same_points_in_the_other_picture():
    scene = plane_room()
    before = render(scene, "planar")
    camera = dataclasses.replace(before.camera, eye=before.camera.eye + [0.1, 0.0, 0.0])
    now = render(scene, "planar", previous=before, camera=camera)
    seen = now["reflectedId"] > 0
    y, x = np.nonzero(seen)
    target = now.relative("reflectedPoint")[seen].astype(float) + camera.eye
    image = target.copy()
    image[:, 2] = -4.0 - image[:, 2]  # mirrored in z = -2
    expected = np.stack([x + 0.5, y + 0.5], 1) - pixel_of(before.camera, image)
    motion = now["reflectionMotion"][seen]
    found = np.abs(motion).max(axis=1) > 0
    assert found.mean() > 0.95
    error = np.abs(motion - expected)[found].max(axis=1)
    # What lay just off the mirror's edge is followed up to `ACCEPTED_PX` beyond it.
    assert np.quantile(error, 0.99) < 0.001
    assert error.max() < 0.1


def test_motion_of_a_still_scene_and_of_a_first_frame_is_zero(ball_room):
    first = render(ball_room, "reference")
    again = render(ball_room, "reference", previous=first)
    assert not first["reflectionMotion"].any()
    assert np.abs(again["reflectionMotion"]).max() < 0.02
    assert identical(first, again) == 1.0


def test_motion_of_what_was_not_there_is_zero(ball_room):
    data = dataclasses.replace(ball_room.data, instances=ball_room.data.instances[:2])
    before = render(Scene(data), "reference")
    now = render(ball_room, "reference", previous=before)
    new = now["reflectedId"] > 2
    assert new.any()
    assert not now["reflectionMotion"][new].any()


def test_plan_of_one_time_renders_another(ball_room):
    plan = wr.make_plan(ball_room, size=(160, 90), method="reflector_map")
    first = wr.render_frame(ball_room, plan)
    scene = moved(ball_room, "/mirror", np.array([0.3, 0.1, 0.2]))
    now = wr.render_frame(scene, plan, previous=first)
    assert now.statistics == render(scene, "reflector_map").statistics
    assert identical(now, render(scene, "reference")) > 0.995
