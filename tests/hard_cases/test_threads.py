"""Whole frames are the same bits by one thread, by two and by eight; and a program's own threads may draw at once."""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from rooms import placed, plane_room, room, sphere, square

import warp_reflect as wr
from warp_reflect import wide_tree
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


def by_threads(count: int, job) -> list:
    """What a job gives for each number, all at once."""
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(job, range(count)))


def test_threads_that_ask_a_new_scene_at_once_are_given_one_tree(monkeypatch):
    """Of two that are made the first would be freed where its number is already on its way to a kernel."""
    lay_out = wide_tree.WideTree.__init__

    def slowly(self, *given):
        time.sleep(0.05)
        lay_out(self, *given)

    monkeypatch.setattr(wide_tree.WideTree, "__init__", slowly)
    tracer = room(sphere(), placed(0, 0, -1)).tracer
    assert len(set(by_threads(4, lambda k: tracer.packets))) == 1


def test_threads_may_draw_a_new_scene_at_once():
    def drawn(scene, k):
        plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(bounces=1 + k % 2, shadows="on"), method="reference")
        return wr.render_frame(scene, plan)["RGBA"]

    def anew():
        return everything(room(sphere(), placed(0, 0, -1, 1.5)))

    known, scene = [drawn(anew(), k) for k in range(2)], anew()
    for k, picture in enumerate(by_threads(4, lambda k: drawn(scene, k))):
        np.testing.assert_array_equal(picture, known[k % 2])


def test_threads_may_draw_times_of_a_stage_at_once():
    """They fit one tree to what has moved, each to its own."""
    stage = Path(__file__).parents[2] / "usd_scenes" / "city_block.usda"
    asked = {"size": (96, 54), "settings": wr.Settings(shadows="on"), "method": "reference"}
    first = wr.load_stage(stage, time=1.0)
    wr.render_frame(first, wr.make_plan(first, **asked))
    times = [first.at(code) for code in (10.0, 20.0, 30.0, 40.0)]
    assert first.tracer._tree is times[0].tracer._tree is times[3].tracer._tree
    plans = [wr.make_plan(scene, **asked) for scene in times]
    known = [wr.render_frame(scene, plan)["RGBA"] for scene, plan in zip(times, plans, strict=True)]
    for _ in range(3):
        for k, picture in enumerate(by_threads(4, lambda k: wr.render_frame(times[k], plans[k])["RGBA"])):
            np.testing.assert_array_equal(picture, known[k])
    plan = wr.make_plan(first, **asked)
    for k, picture in enumerate(by_threads(4, lambda k: wr.render_frame(first.at(10.0 * (k + 1)), plan)["RGBA"])):
        np.testing.assert_array_equal(picture, known[k])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked here")
def test_a_forked_process_waits_for_none_of_its_parents_threads():
    """One of them draws, of a stage whose times take turns, while the process is forked."""
    scene = wr.load_stage(Path(__file__).parents[2] / "usd_scenes" / "city_block.usda", time=1.0)
    plan = wr.make_plan(scene, size=(32, 18), method="reference")
    known, begun, done = wr.render_frame(scene, plan)["RGBA"], threading.Event(), threading.Event()

    def hold():
        with scene.alone(), scene.tracer._tree._making:
            begun.set()
            done.wait()

    holder = threading.Thread(target=hold)
    holder.start()
    begun.wait()
    child = os.fork()
    if not child:
        signal.alarm(60)  # ends a process that waits for ever
        os._exit(0 if np.array_equal(wr.render_frame(scene, plan)["RGBA"], known) else 1)
    done.set()
    holder.join()
    assert os.waitpid(child, 0)[1] == 0
