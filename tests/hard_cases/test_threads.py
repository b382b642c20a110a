"""Whole frames with every effect on are the same bits by one thread, by two and by eight."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from rooms import placed, plane_room, room, sphere, square

import warp_reflect as wr
from warp_reflect.channels import CHANNELS
from warp_reflect.launch import SPLIT_MIN
from warp_reflect.scene import FinishData, InstanceData, LightData, MaterialData, Scene
from warp_reflect.techniques import MAPS, TECHNIQUES

SIZE = (160, 90)
DOWN = np.array([[1.0, 0, 0, 0], [0, 0.2, 0.98, 0], [0, -0.98, 0.2, 0], [0, 0, 0, 1]])  # a light's -Z, steeply down
ASKED = {"bounces": 3, "shadows": "on", "dome_shadows": "on", "fade_distance": 3.0, "grid_error_px": 0.5}
ASKED |= {"environment_resolution": 32, "map_resolution": 48, "few_pixels": 0, "keep_static": False, "reuse_px": 0.5}


def everything(scene: Scene) -> Scene:
    """A rough mirror, a second one that it sees, a frosted pane before it, a sun, a lamp and a dome."""
    data = scene.data
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    turn[:3, 3] = 1.0, 0.6, 1.2
    pane = MaterialData(
        base_color=(1, 1, 1), transmission=1.0, roughness=0.3, finish=FinishData("/pane", frost=3.0, frost_distance=4.0)
    )
    chrome = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    materials = [dataclasses.replace(data.materials[0], roughness=0.15), *data.materials[1:], pane, chrome]
    instances = [
        *data.instances,
        InstanceData(len(data.meshes), turn, "/pane", (2,)),
        InstanceData(2, placed(-1.2, 0.0, 1.0, 0.5), "/other", (3,)),
    ]
    lights = [
        LightData("/dome", "dome", (0.4, 0.5, 0.6), np.eye(4)),
        LightData("/sun", "distant", (2.0, 2.0, 1.8), DOWN),
        LightData("/lamp", "sphere", (8.0, 7.0, 6.0), placed(1.0, 2.5, 1.0), size=(0.3,)),
    ]
    meshes = [*data.meshes, square(1, 0.5)]
    return Scene(
        dataclasses.replace(data, meshes=meshes, instances=instances, materials=materials, lights=lights), scene.device
    )


@pytest.fixture(scope="module")
def rooms():
    return {"ball": everything(room(sphere(), placed(0, 0, -1, 1.5))), "plane": everything(plane_room())}


def two_frames(scene: Scene, method: str, threads: int) -> wr.Frame:
    """The second frame of a moving eye, which starts from the first."""
    settings = wr.Settings(threads=threads).replace(**ASKED)
    plan = wr.make_plan(scene, size=SIZE, settings=settings, method=method)
    first = wr.render_frame(scene, plan)
    camera = dataclasses.replace(first.camera, eye=first.camera.eye + [0.02, 0.01, 0.0])
    return wr.render_frame(scene, plan, camera=camera, previous=first)


@pytest.mark.parametrize(("method", "threads"), [*((method, 2) for method in TECHNIQUES), ("reflector_map", 8)])
def test_frames_are_the_same_bits_by_any_number_of_threads(rooms, method, threads):
    scene = rooms["plane" if method == "planar" else "ball"]
    one, two = (two_frames(scene, method, count) for count in (1, threads))
    row = next(row for row in one.plan.rows if row.path == "/mirror")
    assert row.technique == method and row.forced
    effects = {name: effect.on for name, effect in row.effects.items()}
    assert effects["roughness"] and effects["shadows"] and effects["fade"] == (method not in MAPS)
    assert any(pane.effects["frost"].on for pane in one.plan.panes)
    assert SIZE[0] * SIZE[1] > 2 * SPLIT_MIN  # or nothing would be split
    for name in CHANNELS:
        assert np.isfinite(one[name]).all()
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    assert (one["reflectedId"] > 0).any() or method == "environment"
