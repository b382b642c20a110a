"""Levels of detail of local maps that switch: pictures of a world that stands still, and of a car that comes nearer."""

from __future__ import annotations

import numpy as np
import pytest
import street
import warp as wp
from pxr import Gf, UsdGeom, UsdShade
from stage_samples import saved

import warp_reflect as wr
from warp_reflect import launch
from warp_reflect.techniques import level_blend

SIZE = (96, 54)
COMMON = {"environment_resolution": 64, "shadows": "off", "bounces": 1}


def approaching(path, time: float = 1.0):
    """A mirror ball that comes down the street towards an eye that stands still."""
    stage = street.street(path)
    stage.RemovePrim("/World/Ball")
    material = UsdShade.Material.Get(stage, "/World/Chrome")
    street.ball(stage, "/World/Ball", material, 0.5, ((-9.0, 0.6, 0.0), (4.2, 0.6, 0.0)))
    stage.RemovePrim("/World/Camera")
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.GetClippingRangeAttr().Set(Gf.Vec2f(0.01, 500))
    camera.GetFocalLengthAttr().Set(40)
    camera.AddTranslateOp().Set(Gf.Vec3d(7.0, 1.0, 0.3))
    camera.AddRotateYOp().Set(90.0)
    return wr.load_stage(saved(stage), time=time)


def plan_of(scene, **settings):
    asked = wr.Settings(**(COMMON | settings))
    return wr.make_plan(scene, size=SIZE, settings=asked, method="layered_environment")


def encoded(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 in float64."""
    linear = linear.astype(np.float64)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055)


def grey_levels(frame) -> np.ndarray:
    return np.rint(255.0 * np.clip(encoded(frame["RGBA"][..., :3]), 0.0, 1.0)).astype(int)


def mirrored(frame) -> np.ndarray:
    """What the ball shows, in sRGB."""
    (layer,) = frame.layers.values()
    return encoded(layer.radiance.numpy())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return approaching(tmp_path_factory.mktemp("street") / "street.usda", time=4.2)


def test_switch_changes_no_pixel_by_more_than_a_grey_level_a_frame(scene):
    """The eye and the world stand still, and another level is asked for: in small steps to what it shows alone."""
    coarse, fine = (plan_of(scene, local_detail=detail) for detail in (0.01, 2.0))
    edges = [plan.rows[0].settings.local_edge for plan in (coarse, fine)]
    assert edges == [8, 64]
    frame = first = wr.render_frame(scene, coarse)
    end = grey_levels(wr.render_frame(scene, fine))
    apart = np.abs(end - grey_levels(first)).max()
    assert apart > 60
    before, steps = grey_levels(first), 0
    while True:
        frame = wr.render_frame(scene, fine, previous=frame)
        now = grey_levels(frame)
        assert np.abs(now - before).max() <= 1 and (np.abs(now - end) <= np.abs(before - end)).all()
        before, steps = now, steps + 1
        if not frame.statistics.get("local_blending"):
            break
        assert steps < 400
    np.testing.assert_array_equal(now, end)
    assert steps >= apart - 1
    after = wr.render_frame(scene, fine, previous=frame)
    assert after.layers == frame.layers  # nothing goes on: it is taken over
    at_once = wr.render_frame(scene, plan_of(scene, local_detail=2.0, local_blend=0.0), previous=first)
    np.testing.assert_array_equal(grey_levels(at_once), end)


def test_approaching_car_is_held_to_what_its_levels_allow(tmp_path):
    """Level after level, each taken before the last is reached, against their own pictures blended in float64."""
    scene = approaching(tmp_path / "street.usda")
    plan = plan_of(scene, local_detail=1.0, local_blend=4.0)
    frame, chain, most, found = None, (), 0, []
    for time in np.linspace(1.0, 4.8, 16):
        moved = scene.at(float(time))
        frame = wr.render_frame(moved, plan, previous=frame)
        edge = frame.plan.rows[0].settings.local_edge
        found.append(edge)
        goes_on = chain and (len(chain) > 1 or chain[0][0] != edge)
        held = chain
        if not goes_on:
            chain = ((edge, 0),)
        elif chain[-1][0] == edge:
            chain = (*chain[:-1], (edge, chain[-1][1] + 1))
        else:
            chain = (*chain, (edge, 1))
            held = (*held, (edge, 0))
        alone = {n: mirrored(wr.render_frame(moved, plan_of(moved, local_resolution=n))) for n, _ in chain}

        def blended(chain, alone=alone):
            shown = alone[chain[0][0]]
            for n, frames in chain[1:]:
                reach = frames * 4.0 * level_blend.STEP_SHARE / 255.0
                shown = shown + np.clip(alone[n] - shown, -reach, reach)
            return shown

        expected = blended(chain)
        np.testing.assert_allclose(mirrored(frame), expected, atol=1e-4)
        if goes_on:
            # By what the frame goes on with the switch, all else as it is.
            assert np.abs(expected - blended(held)).max() <= 4.0 / 255.0
            most = max(most, len(chain))
        if len(chain) > 1 and np.abs(expected - alone[edge]).max() == 0.0:
            chain = ((edge, 0),)
        assert (len(chain) > 1) == bool(frame.statistics.get("local_blending"))
    assert len(set(found)) >= 3 and (np.diff(found) >= 0).all() and most >= 2, (found, most)


def test_plan_says_whether_levels_are_blended(scene):
    on, off, without = (
        plan_of(scene, **asked).rows[0].effects["level_blend"]
        for asked in ({"local_detail": 1.0}, {"local_detail": 1.0, "local_blend": 0.0}, {})
    )
    assert on.on and "local_blend" in on.reason and not off.on and off.reason == "maps switch at once, local_blend=0"
    assert not without.on and without.reason == "local_detail=0, local_texels=0"


def test_nothing_is_blended_where_nothing_switches(scene):
    plan = plan_of(scene, local_detail=1.0)
    frame = wr.render_frame(scene, plan)
    with launch.recorded() as launches:
        other = wr.render_frame(scene.at(4.3), plan, previous=frame)
    assert not any("level_blend" in name for name, _ in launches) and "local_blending" not in other.statistics


@pytest.mark.parametrize("value", [0.0, 1e-9, 1e-3, 0.5, 1.0, 40.0, 1e30])
def test_values_of_any_size_approach(value, device):
    before = wp.array(np.full((2, 3), value, np.float32), dtype=wp.vec3, device=device)
    shown = wp.array(np.array([[0, 1, value], [value, 20.0, 1e-4]], np.float32), dtype=wp.vec3, device=device)
    asked = encoded(shown.numpy())
    level_blend.approach(before, shown, 2, 1.0)
    step = encoded(shown.numpy()) - encoded(np.float32(value))
    assert np.isfinite(step).all() and (np.abs(step) <= 2.0 / 255.0 + 1e-5 * encoded(np.float32(value))).all()
    assert (step * (asked - encoded(np.float32(value))) >= -1e-6 * encoded(np.float32(value)) ** 2).all()


@pytest.mark.parametrize("value", [-1.0, 256.0, float("nan")])
def test_steps_that_cannot_be_are_refused(value):
    with pytest.raises(ValueError, match="local_blend"):
        wr.Settings(local_blend=value)
