"""Finishes as a whole: what is off costs nothing, what is on is applied to its own mirror, in order."""

import subprocess
import sys
import types
from pathlib import Path

import numpy as np
from rooms import placed, room, sphere

import warp_reflect as wr
from warp_reflect import effects, frame

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
