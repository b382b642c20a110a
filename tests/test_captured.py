"""Frames that repeat the launches of one: the same bits as frames that are launched anew, and a reason where there are none."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from panes import GLASS, stage, upright
from rooms import placed, plane_room, room, sphere
from test_bumps import above
from test_glossy import dome
from test_normal_maps import SILVER, shown
from test_textures import MATT, looking_down, quad

import warp_reflect as wr
from warp_reflect import captured, launch
from warp_reflect.channels import CHANNELS
from warp_reflect.layers import Camera
from warp_reflect.scene import FinishData, InstanceData, MaterialData, Scene, SceneData

ROOT = Path(__file__).parent.parent
SIZE = 96, 54
STAGES = "one_mirror kitchen facing_mirrors toy_room cut_outs coated_car polished_spheres pool frosted_window".split()
pytestmark = pytest.mark.skipif(not captured.RECORDS_CPU, reason="this Warp writes launches down on CUDA alone")


def planned(scene, method="reference", **settings):
    settings = {"bounces": 1, "kernels": "plain", "keep_static": False} | settings
    return wr.make_plan(scene, size=SIZE, settings=wr.Settings(**settings), method=method)


def walk(camera, reach):
    """The camera, steps aside, from nearer (the mirror grows), turned round (it is gone), and where it began."""
    aside = [dataclasses.replace(camera, eye=camera.eye + k * 0.1 * reach * camera.right) for k in (1, 2)]
    near = dataclasses.replace(camera, eye=camera.eye + 0.4 * reach * camera.forward, fx=0.8 * camera.fx)
    turned = dataclasses.replace(camera, right=-camera.right, forward=-camera.forward)
    return [camera, *aside, near, turned, camera]


def panes():
    """Three behind one another before a ball of glass, a mirror and a floor."""
    ball = dataclasses.replace(sphere(), parts=[])
    chrome = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    glass = [(*upright(z), GLASS) for z in (1.5, 1.0, 0.5)]
    return stage(*glass, (ball, placed(-0.5, 0, -1, 0.5), GLASS), (sphere(), placed(0.8, 0, -1, 0.5), chrome), sky=0.5)


def scenes():
    stages = {name: lambda name=name: wr.load_stage(ROOT / "usd_scenes" / f"{name}.usda") for name in STAGES}
    return stages | {"panes": panes, "ball": lambda: room(sphere(), placed(0, 0, -1)), "plane": plane_room}


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("ball", {}),
        ("ball", {"shadows": "on"}),
        ("plane", {}),
        ("one_mirror", {"shadows": "on"}),
        ("one_mirror", {"shadows": "off"}),
        ("kitchen", {"shadows": "on"}),
        ("kitchen", {"shadows": "off", "bounces": 2}),
        ("facing_mirrors", {"shadows": "on", "bounces": 3}),
        # Where mirrors meet on the screen they share what they find of a penumbra.
        ("toy_room", {"shadows": "on", "bounces": 2}),
        ("cut_outs", {"shadows": "on", "bounces": 2}),
        ("coated_car", {"bounces": 2}),
        ("polished_spheres", {"shadows": "on"}),
        ("pool", {"shadows": "on", "bounces": 2}),
        ("pool", {"shadows": "off", "waves": "traced", "frost_distance": 0.0}),
        ("frosted_window", {"shadows": "off"}),
        ("frosted_window", {"frost_samples": 2, "transparency_depth": 1, "shadows": "off"}),
        ("panes", {"transparency_depth": 1, "bounces": 2}),
        ("polished_spheres", {"glossy": "accumulate", "glossy_samples": 4, "fade_distance": 2.0}),
    ],
)
def test_a_repeated_frame_is_the_launched_one_bit_for_bit(name, settings):
    scene = scenes()[name]()
    plan = planned(scene, **settings)
    repeated, before, last, counts = wr.capture_frame(scene, plan), None, None, []
    for view in walk(plan.camera, np.linalg.norm(plan.camera.eye - scene.origin)):
        with launch.as_device():
            before = wr.render_frame(scene, plan, view, before)
        last = repeated.render(view, last)
        for channel in CHANNELS:
            np.testing.assert_array_equal(last[channel], before[channel], err_msg=channel)
        assert {id: (layer.pixels.count, layer.pixels.box) for id, layer in last.layers.items()} == {
            id: (layer.pixels.count, layer.pixels.box) for id, layer in before.layers.items()
        }
        assert last.statistics == before.statistics and last.transmitted.keys() == before.transmitted.keys()
        counts.append(sum(layer.pixels.count for layer in last.layers.values()))
    around = name == "facing_mirrors"
    if name == "panes":
        assert before.statistics["onward"] > 0 and before.statistics["depth_limit"] > 0
    assert counts[0] == counts[-1] > 0 and (counts[4] > 0) == around and (around or len(set(counts)) >= 3)


def test_a_mirror_may_fill_the_picture():
    """Its first pixel is the picture's, behind entries that are none; on the corners it shows the sky, which is asked twice."""
    scene = plane_room()
    plan = planned(scene)
    view = dataclasses.replace(plan.camera, eye=np.array([0.1, 0.6, -1.5]))
    with launch.as_device():
        launched = wr.render_frame(scene, plan, view)
    assert (launched["reflectorId"] == 1.0).all() and launched["status"][0, 0] == wr.Status.SKY
    repeated = wr.capture_frame(scene, plan).render(view)
    for channel in CHANNELS:
        np.testing.assert_array_equal(repeated[channel], launched[channel], err_msg=channel)


def test_normal_maps_and_waves_turn_the_rays_of_repeated_frames(tmp_path):
    tilted = dataclasses.replace(SILVER, textures=shown(tmp_path, np.array([0.12, 0.2, 1.0])).textures)
    wavy = dataclasses.replace(tilted, finish=FinishData("/waves", wave_slope=0.05, wave_length=0.5))
    things = [(quad(0.35), above(0.8), MATT), (quad(1.0), np.eye(4), wavy)]
    instances = [InstanceData(k, world, f"/p{k}", (k,)) for k, (_, world, _) in enumerate(things)]
    meshes, _, materials = zip(*things, strict=True)
    scene = Scene(SceneData("bumps", list(meshes), instances, list(materials), [dome()], []))
    for waves in ("off", "traced"):
        settings = wr.Settings(bounces=1, kernels="plain", keep_static=False, waves=waves)
        plan = wr.make_plan(scene, looking_down(3.0, size=SIZE), SIZE, settings, "reference")
        effects = plan.rows[0].effects
        assert effects["normal_map"].on and effects["waves"].on == (waves == "traced")
        repeated = wr.capture_frame(scene, plan)
        for view in walk(plan.camera, 1.0):
            with launch.as_device():
                expected = wr.render_frame(scene, plan, view)["RGBA"]
            np.testing.assert_array_equal(repeated.render(view)["RGBA"], expected)


def test_orthographic_cameras_are_repeated_too():
    scene = room(sphere(), placed(0, 0, -1))
    camera = dataclasses.replace(scene.data.cameras[0], projection="orthographic", horizontal_aperture=40.0)
    scene.data.cameras[0] = camera
    plan = planned(scene)
    repeated = wr.capture_frame(scene, plan)
    for shift in (0.0, 0.3):
        view = dataclasses.replace(plan.camera, eye=plan.camera.eye + shift * plan.camera.right)
        with launch.as_device():
            np.testing.assert_array_equal(repeated.render(view)["RGBA"], wr.render_frame(scene, plan, view)["RGBA"])


def test_a_repeated_frame_copies_its_camera_alone(monkeypatch):
    """What is recorded copies nothing: on CUDA a copy from the host would be repeated from memory that is another's by then."""
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import host_copies

    scene = room(sphere(), placed(0, 0, -1))
    plan = planned(scene, shadows="on")
    wr.capture_frame(scene, plan)
    with host_copies.counted() as copies:
        repeated = wr.capture_frame(scene, plan)
        repeated.render()
        frame = repeated.render()
    assert [copy.kind for copy in copies] == ["write"] * 3
    with host_copies.counted() as copies:
        frame["RGBA"]
    assert [copy.kind for copy in copies] == ["read"]


@pytest.mark.parametrize("name", ["pool", "coated_car", "toy_room"])
def test_what_is_written_down_finds_its_memory_again(name, monkeypatch):
    """Where a device decides what is done nothing asks it for more: the CPU's memory stands for it."""
    device = wp.get_device("cpu")
    room, own = captured._Room(device), device.default_allocator
    room._own = own
    scene = scenes()[name]()
    plan = planned(scene, shadows="on", bounces=2)
    place = plan.camera.view(scene)
    seat = captured.Seat(
        **{each.name: getattr(plan.camera, each.name) for each in dataclasses.fields(Camera)}, taken=place
    )
    blocks = []
    for kept in (False, True, True):
        with launch.unread(), room:
            monkeypatch.setattr(device, "default_allocator", room if kept else own)
            frame = wr.render_frame(scene, plan, seat)
            monkeypatch.setattr(device, "default_allocator", own)
        blocks.append(len(room._blocks))
        picture = frame["RGBA"].copy()
        del frame
    assert blocks[0] == 0 < blocks[1] == blocks[2]
    assert sum(map(len, room._free.values())) == blocks[2]
    with launch.as_device():
        # All is done where nothing is decided: rays that nothing is seen behind are summed up as others are.
        np.testing.assert_allclose(picture, wr.render_frame(scene, plan)["RGBA"], rtol=2e-5, atol=1e-6)


def test_ordinary_frames_are_what_they_were():
    scene = room(sphere(), placed(0, 0, -1))
    plan = planned(scene, kernels="auto", shadows="on")
    before = wr.render_frame(scene, plan)
    repeated = wr.capture_frame(scene, plan)
    moved = dataclasses.replace(plan.camera, eye=plan.camera.eye + 0.2)
    with launch.recorded() as first:
        other = wr.render_frame(scene, plan, moved)
    repeated.render()
    with launch.recorded() as second:
        after = wr.render_frame(scene, plan)
    assert [name for name, _ in first] == [name for name, _ in second]
    np.testing.assert_array_equal(after["RGBA"], before["RGBA"])
    assert not np.array_equal(other["RGBA"], before["RGBA"])


def test_other_times_of_the_stage_may_be_drawn_between():
    scene = wr.load_stage(ROOT / "usd_scenes" / "city_block.usda")
    assert scene.moving_parts
    plan = planned(scene, shadows="on")
    repeated = wr.capture_frame(scene, plan)
    before = repeated.render()["RGBA"].copy()
    later = wr.render_frame(scene.at(2.0), plan)
    assert not np.array_equal(later["RGBA"], before)
    np.testing.assert_array_equal(repeated.render()["RGBA"], before)


def test_nothing_is_told_of_a_frame_that_was_drawn_over():
    scene = room(sphere(), placed(0, 0, -1))
    repeated = wr.capture_frame(scene, planned(scene))
    first = repeated.render()
    kept = first["RGBA"].copy()
    second = repeated.render()
    with pytest.raises(RuntimeError, match=r"'N': .*drawn over"):
        first["N"]
    with pytest.raises(RuntimeError, match="drawn over"):
        first.layers.keys() | set()
    np.testing.assert_array_equal(second["RGBA"], kept)


def test_what_was_asked_of_a_frame_does_not_outlive_it():
    scene = room(sphere(), placed(0, 0, -1))
    repeated = wr.capture_frame(scene, planned(scene))
    first = repeated.render()
    assert len(first.layers) == 1 and first.statistics["bvh"] > 0
    repeated.render()
    with pytest.raises(RuntimeError, match=r"layers: .*drawn over"):
        first.layers[1]


@pytest.mark.parametrize("kernels", ["auto", "plain"])
def test_frames_take_nothing_over_from_one_that_is_drawn_over(kernels):
    """With `keep_static` a frame shares the last one's arrays: not those that the next repetition writes to."""
    scene = room(sphere(), placed(0, 0, -1))
    plan = planned(scene, kernels=kernels, keep_static=True)
    moved = dataclasses.replace(plan.camera, eye=plan.camera.eye + 0.3)
    repeated, alone = wr.capture_frame(scene, plan), wr.render_frame(scene, plan)
    passing = repeated.render()
    before = wr.render_frame(scene, plan, previous=passing)
    repeated.render(moved)
    after = wr.render_frame(scene, plan, previous=passing)
    for frame in (before, after):
        assert not frame.kept
        for channel in ("RGBA", "reflectorId", "reflectedPoint", "status"):
            np.testing.assert_array_equal(frame[channel], alone[channel], err_msg=channel)
    assert wr.render_frame(scene, plan, previous=after).kept  # and of ordinary frames all


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"near": 0.2}, "near: got 0.2"),
        ({"far": 50.0}, "far: got 50"),
        ({"orthographic": True}, "orthographic: got True"),
    ],
)
def test_cameras_that_see_otherwise_are_refused(change, told):
    scene = room(sphere(), placed(0, 0, -1))
    plan = planned(scene)
    with pytest.raises(ValueError, match=told):
        wr.capture_frame(scene, plan).render(dataclasses.replace(plan.camera, **change))


@pytest.mark.parametrize(
    ("stage", "method", "settings", "told"),
    [
        ("one_mirror", "reflector_map", {}, "solved by reflector_map"),
        ("one_mirror", "environment", {}, "solved by environment"),
        ("pool", "auto", {"refraction": "drawn"}, "refraction=traced asks rays"),
        ("polished_spheres", "reference", {"glossy": "filter"}, "glossy=gather asks rays"),
    ],
)
def test_plans_that_decide_between_launches_say_so(stage, method, settings, told):
    scene = wr.load_stage(ROOT / "usd_scenes" / f"{stage}.usda")
    plan = planned(scene, method, **settings)
    assert told in captured.why_not(scene, plan)
    with pytest.raises(ValueError, match=f"{told}.*render_frame"):
        wr.capture_frame(scene, plan)
