"""A plan at another time is the plan made from nothing there: whatever moved, and whatever was taken over from before."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import warp_reflect as wr
from warp_reflect.techniques import TECHNIQUES

FOLDER = Path(__file__).resolve().parents[1] / "usd_scenes"
SIZE = 160, 90
TIMES = 3.0, 9.0, 6.0, 1.0, 6.0  # forwards, back, and one time twice
WHOLE = """#usda 1.0
(
    startTimeCode = 1
    endTimeCode = 9
    upAxis = "Y"
    metersPerUnit = 1
    subLayers = [@{below}@]
)
over "World"
{{
{moves}
}}
"""
TABLE = """
    def Xform "Table"
    {
        double3 xformOp:translate:rise.timeSamples = { 1: (0, 0, 0), 9: (0.02, 0.09, 0) }
        uniform token[] xformOpOrder = ["xformOp:translate:rise"]
    }"""
MIRROR = """
    over "ChromeSphere"
    {
        double3 xformOp:translate.timeSamples = { 1: (0.035, 0.934158, -0.17), 9: (0.3, 1.2, -0.5) }
    }"""
STRETCHED = """
    over "ChromeEllipsoid"
    {
        double3 xformOp:translate.timeSamples = { 1: (0.43, 0.908368, 0.04), 9: (0.5, 1.1, -0.3) }
        float3 xformOp:rotateXYZ.timeSamples = { 6: (0, 16, 0), 9: (0, 70, 20) }
    }"""
CAMERA = """
    over "Camera"
    {
        double3 xformOp:translate.timeSamples = { 1: (0.02, 1.15, 1.4), 9: (-0.4, 1.3, 1.2) }
    }"""
SEEN = """
    over "ChromeSphere"
    {
        token visibility.timeSamples = { 1: "inherited", 4: "invisible", 8: "inherited" }
    }"""
SUN = """
    over "Sun"
    {
        float inputs:intensity.timeSamples = { 1: 3, 9: 0 }
    }"""
TURNED_SUN = """
    over "Sun"
    {
        float3 xformOp:rotateXYZ.timeSamples = { 1: (-50, 20, 0), 9: (-20, 70, 0) }
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    }"""
ROUGH = """
    over "Materials"
    {
        over "Chrome"
        {
            over "Surface"
            {
                float inputs:roughness.timeSamples = { 1: 0, 5: 0.1, 9: 0.9 }
            }
        }
    }"""
KITCHENS = {
    "the table": TABLE,
    "a mirror": MIRROR,
    "a stretched mirror that slides, then turns": STRETCHED,
    "the camera": CAMERA,
    "all three": TABLE + MIRROR + CAMERA,
    "what is there": TABLE + SEEN,
    "a light": TABLE + SUN,
    "where light comes from": TABLE + TURNED_SUN,
    "a material": MIRROR + ROUGH,
}
FEW = {"few_pixels": 0}  # so that shapes are looked at in small pictures


def kitchen(folder: Path, moves: str) -> str:
    path = folder / "moving_kitchen.usda"
    path.write_text(WHOLE.format(below=FOLDER / "kitchen.usda", moves=moves))
    return str(path)


def told(plan: wr.Plan) -> dict:
    """All of a plan that is decided."""
    rows = [(row.reflector, row.settings, row.technique, row.forced, row.reason) for row in plan.rows]
    return json.loads(json.dumps(plan.to_json())) | {"rows": rows, "shadows": plan.shadows, "panes": plan.panes}


def plans(path: str, times, settings: wr.Settings, method: str = "auto"):
    """(time, the plan there of one that goes through all times, one made from nothing)."""
    scene = wr.load_stage(path, time=times[-1])
    last = first = wr.make_plan(scene, size=SIZE, settings=settings, method=method)
    for time in times:
        scene = scene.at(time)
        last = first.at(scene, last)
        yield time, last, wr.make_plan(wr.load_stage(path, time=time), size=SIZE, settings=settings, method=method)


@pytest.mark.parametrize("moves", KITCHENS.values(), ids=KITCHENS)
def test_plans_of_a_kitchen_in_which_things_change(moves, tmp_path):
    found = []
    for time, plan, fresh in plans(kitchen(tmp_path, moves), TIMES, wr.Settings(**FEW)):
        assert told(plan) == told(fresh), time
        found.append(plan.to_json() | {"time": 0.0})
    assert found[2] == found[4] and found[0] != found[1]  # what changes does change the plan


@pytest.mark.parametrize(
    "settings",
    [{"shadows": "off"}, {"max_error_px": 0.5}, {"environment_px": 4.0}, {"bounces": 4, "shadow_min_share": 0.0}],
)
def test_plans_of_a_kitchen_by_other_settings(settings, tmp_path):
    path = kitchen(tmp_path, TABLE + MIRROR)
    for time, plan, fresh in plans(path, TIMES, wr.Settings(**FEW | settings)):
        assert told(plan) == told(fresh), time


@pytest.mark.parametrize("method", ["auto", "reflector_map", "layered_environment"])
def test_plans_of_a_crossing(method):
    for time, plan, fresh in plans(str(FOLDER / "city_block.usda"), (2.0, 3.0, 30.0, 48.0), wr.Settings(), method):
        assert told(plan) == told(fresh), time


@pytest.mark.parametrize("method, count", [("reflector_map", 3), ("quadric", 2), ("explosion_map", 3)])
def test_what_is_prepared_for_mirrors_that_stand_still_is_kept(method, count, tmp_path, monkeypatch):
    """The sphere moves between the first two times alone; the table between all."""
    stops = MIRROR.replace("9: (0.3", "5: (0.3")
    path, settings = kitchen(tmp_path, TABLE + stops), wr.Settings(**FEW, map_resolution=32, shadows="off")
    module, made = TECHNIQUES[method], []
    prepare = module.prepare
    monkeypatch.setattr(module, "prepare", lambda *given: made.append(given[1].part) or prepare(*given))
    scene = wr.load_stage(path, time=1.0)
    plan = wr.make_plan(scene, size=SIZE, settings=settings, method=method)
    frame = wr.render_frame(scene, plan)
    assert len(made) == count
    for time, again in ((5.0, 1), (7.0, 0), (9.0, 0), (1.0, 1)):
        made.clear()
        scene = scene.at(time)
        frame = wr.render_frame(scene, plan, previous=frame)
        assert len(made) == again, time
        fresh = wr.load_stage(path, time=time)
        whole = wr.render_frame(fresh, wr.make_plan(fresh, size=SIZE, settings=settings, method=method))
        for name in ("RGBA", "reflectedPoint", "status"):
            np.testing.assert_array_equal(frame[name], whole[name], err_msg=f"{name} at {time}")


def test_a_camera_of_ones_own_stays_where_it_is(tmp_path):
    scene = wr.load_stage(kitchen(tmp_path, CAMERA), time=1.0)
    plan = wr.make_plan(scene, size=SIZE)
    own = wr.make_plan(scene, dataclasses.replace(plan.camera, eye=plan.camera.eye + 0.1), SIZE)
    there = wr.load_stage(kitchen(tmp_path, CAMERA), time=9.0)
    first = wr.render_frame(scene.at(5.0), own)
    later = wr.render_frame(scene.at(9.0), own, previous=first)
    assert later.camera.sees_as(own.camera) and later.plan.camera.sees_as(own.camera)
    assert wr.render_frame(scene.at(9.0), plan).camera.sees_as(wr.make_plan(there, size=SIZE).camera)


def test_findings_that_are_kept_too_long_are_noticed(tmp_path):
    """What a scene found out before things moved makes another plan: the comparisons above can fail."""
    path = kitchen(tmp_path, TABLE + MIRROR)
    scene = wr.load_stage(path, time=1.0)
    wr.make_plan(scene, size=SIZE, settings=wr.Settings(**FEW))
    later = scene.at(9.0)
    later.facts.update(scene.facts)
    stale = wr.make_plan(later, size=SIZE, settings=wr.Settings(**FEW))
    fresh = wr.make_plan(wr.load_stage(path, time=9.0), size=SIZE, settings=wr.Settings(**FEW))
    assert told(stale) != told(fresh)
