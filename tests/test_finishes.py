"""Finishes as a whole: what is off costs nothing, what is on is applied to its own mirror, in order."""

import dataclasses
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from panes import GLASS, WATER, WHITE, stage, upright, with_finish
from panes import frame as drawn
from rooms import placed, room, sphere, square

import warp_reflect as wr
from warp_reflect import effects, frame
from warp_reflect.scene import MaterialData

SHARP_FRAME = """
import sys, warp as wp
wp.config.log_level = wp.LOG_WARNING
from rooms import placed, render, room, sphere
frame = render(room(sphere(), placed(0, 0, -1)), "auto")
assert (frame["reflectorId"] > 0).sum() > 500
modules = [*sys.modules, *wp._src.context.user_modules]
assert "warp_reflect.shade" in modules
print([name for name in modules if name.startswith("warp_reflect.finishes")])
"""


def test_nothing_of_a_finish_is_imported_or_compiled_for_sharp_mirrors():
    run = [sys.executable, "-c", SHARP_FRAME]
    done = subprocess.run(run, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[-2:] == ["[]", ""]


def test_finishes_are_applied_in_order_to_the_mirrors_that_call_for_them(monkeypatch):
    scene = room(sphere(), placed(0, 0, -1))
    plan = wr.make_plan(scene, size=(64, 36))
    sharp = wr.render_frame(scene, plan)["reflection"]
    seen = []

    def halved(scene, shown, layer, sharp, radiance, row):
        seen.append((row.reflector.id, np.array_equal(sharp.numpy(), radiance.numpy())))
        return type(radiance)(0.5 * radiance.numpy(), dtype=radiance.dtype, device=radiance.device)

    names = {"one": "halved", "two": "halved", "three": "halved"}
    monkeypatch.setattr(frame, "FINISHES", names)
    monkeypatch.setitem(sys.modules, "warp_reflect.finishes.halved", types.SimpleNamespace(apply=halved))
    on = {"one": True, "two": False, "three": True}
    for row in plan.rows:
        row.effects.update({name: effects.Effect(on[name], "asked for") for name in names})
    halves = wr.render_frame(scene, plan)["reflection"]
    number = plan.rows[0].reflector.id
    assert seen == [(number, True), (number, False)]
    np.testing.assert_array_equal(halves, 0.25 * sharp)


@pytest.mark.parametrize("grey", [1.0, 0.4, 0.0])
@pytest.mark.parametrize("which", ["mirror", "coated", "water", "frosted"])
def test_a_white_furnace_fades_to_no_more_than_white(which, grey):
    """White balls under a white dome: what is near is white, and what is far the colour that it fades to."""
    asked = {"fade_distance": 0.7, "fade_color": (grey,) * 3, "frost_distance": 0.5, "frost_color": (grey,) * 3}
    mirror = MaterialData(metallic=1.0, roughness=0.0, base_color=(1.0,) * 3)
    pool = square(1, 20.0), placed(0, 0, -3)
    things = {
        "mirror": (*pool, with_finish(mirror, **asked)),
        "coated": (*pool, with_finish(dataclasses.replace(mirror, clearcoat=0.6), **asked)),
        "water": (*pool, with_finish(WATER, wave_slope=0.1, **asked)),
        "frosted": (*upright(0.5), with_finish(GLASS, frost=5.0, **asked)),
    }
    white = [(sphere(), placed(x, y, z, 0.4), WHITE) for x, y, z in ((-1, 0.5, -1), (0.5, 0.2, -2), (0.2, -0.4, -1))]
    shown = drawn(stage(things[which], *white, floor=False))
    effect = "frost_fade" if which == "frosted" else "fade"
    assert any(each.effects[effect].on for each in (*shown.plan.rows, *shown.plan.panes) if effect in each.effects)
    rgb = shown["RGBA"][..., :3]
    assert rgb.max() <= 1.0 + 1e-3 and rgb.min() >= 0.0
    if grey == 1.0:
        np.testing.assert_allclose(rgb, 1.0, atol=2e-3)
    else:
        assert grey - 1e-3 <= rgb.min() < 0.5 * (1.0 + grey)
