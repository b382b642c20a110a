"""What is off costs nothing: for every effect its kernels are not launched and not compiled, its arrays not there."""

import dataclasses
import json
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from rooms import CHROME, placed, plane_room, render, room, sphere

import warp_reflect as wr
from warp_reflect import effects, kernels, launch, sweep
from warp_reflect.scene import FinishData, LightData, MaterialData, MirrorData, Scene
from warp_reflect.techniques import TECHNIQUES

SIZE = (64, 36)
SUN = LightData(
    "/sun", "distant", (1.0, 1.0, 1.0), np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
)
WAVY = FinishData("/mirror", wave_slope=0.05)
MATT = MaterialData()
PACKAGE = "warp_reflect."


@dataclass(frozen=True)
class Case:
    """A frame that calls for an effect, and the modules that work for no other.

    Attributes:
        of: The rooms' mirror: "ball" or "plane".
        owns: Kernel modules, by how their names begin.
        twin: The same without the effect: what of the case is different then.
        holds: Bytes that the effect keeps in a frame, its plan or its scene; None: it keeps nothing of its own.
    """

    method: str = "reference"
    settings: dict = field(default_factory=dict)
    of: str = "ball"
    mirror: MaterialData = CHROME
    others: MaterialData = MATT
    lights: tuple = ()
    moves: bool = False
    owns: tuple[str, ...] = ()
    twin: dict = field(default_factory=dict)
    holds: object = None


def prepared(frame):
    return sum(sweep.held_bytes(each) for each in frame.plan._prepared.values())


def seen_through(frame):
    return sum(sweep.held_bytes(each) for each in frame.transmitted.values())


def layers(frame):
    return sum(sweep.held_bytes(each) for each in frame.layers.values())


def rays(frame):
    return int("tracer" in vars(frame.scene))


def technique(name, *modules, of="ball", holds=prepared, **settings):
    owns = (f"techniques.{name}", *modules)
    return Case(name, settings, of, owns=owns, twin={"method": "reference", "settings": {}}, holds=holds)


FORWARD = ("techniques.forward", "techniques.virtual_mesh")
CASES = {
    "reflection": Case(owns=("bvh", "surface"), twin={"method": "none"}, holds=layers),
    "planar": technique("planar", *FORWARD, of="plane"),
    "quadric": technique("quadric", *FORWARD),
    "reflector_map": technique("reflector_map", *FORWARD),
    "explosion_map": technique("explosion_map", *FORWARD),
    "environment": technique("environment", "environment_maps", environment_resolution=16),
    "layered_environment": technique("layered_environment", "techniques.local_map", environment_resolution=16),
    "raytraced": Case(owns=("bvh",), twin={"method": "quadric", "settings": {"refine": "off"}}, holds=rays),
    "refinement": Case("quadric", owns=("techniques.refine", "bvh"), twin={"settings": {"refine": "off"}}, holds=rays),
    "grid": Case(
        "reflector_map",
        {"grid_share": 0.1},
        owns=("techniques.interpolation", "techniques.grid"),
        twin={"settings": {}},
    ),
    "reuse": Case("quadric", {"reuse_px": 0.5}, moves=True, owns=("techniques.reuse",), twin={"settings": {}}),
    "second_bounce": Case(settings={"bounces": 2}, others=CHROME, owns=("bounces",), twin={"others": MATT}),
    "roughness": Case(
        mirror=dataclasses.replace(CHROME, roughness=0.2),
        owns=("finishes.glossy_gather", "finishes.glossy_rays"),
        twin={"mirror": CHROME},
    ),
    "roughness looked up": Case(
        settings={"glossy": "filter"},
        mirror=dataclasses.replace(CHROME, roughness=0.2),
        owns=("finishes.glossy_filter", "finishes.layer_map"),
        twin={"settings": {}},
    ),
    "roughness in a map": Case(
        "environment",
        {"environment_resolution": 16},
        mirror=dataclasses.replace(CHROME, roughness=0.2),
        owns=("finishes.glossy_prefiltered",),
        twin={"mirror": CHROME},
    ),
    "clearcoat": Case(
        mirror=dataclasses.replace(CHROME, roughness=0.2, clearcoat=1.0, clearcoat_roughness=0.02),
        owns=("finishes.coat",),
        twin={"mirror": dataclasses.replace(CHROME, roughness=0.2)},
    ),
    "fade": Case(settings={"fade_distance": 2.0}, owns=("finishes.fade",), twin={"settings": {}}),
    "waves": Case(
        of="plane", mirror=dataclasses.replace(CHROME, finish=WAVY), owns=("finishes.water",), twin={"mirror": CHROME}
    ),
    "shadows": Case(
        lights=(SUN,),
        owns=("shadows", "shadow_lists"),
        twin={"settings": {"shadows": "off"}},
        holds=lambda f: f.plan.shadows is not None,
    ),
    "transparency": Case(
        mirror=MaterialData(opacity=0.5), owns=("transmission",), twin={"mirror": MATT}, holds=seen_through
    ),
    "frost": Case(
        mirror=MaterialData(transmission=1.0, roughness=0.5),
        owns=("finishes.frost", "finishes.pyramid"),
        twin={"mirror": MaterialData(transmission=1.0, roughness=0.0)},
    ),
}
# Their cases take a picture, a stage that moves, a pool: test_bumps.py, test_local_field.py, test_refraction_image.py,
# test_level_blend.py.
ELSEWHERE = {"normal_map", "field", "refraction_image", "level_blend"}
# Effects that launch no kernel of their own: they choose an argument of those that run anyway, or the frame they begin at.
ARGUMENTS = {"collection", "warm_start", "refraction", "frost_fade", "detail", "kept_map"}


def scene_of(case, device):
    made = room(sphere(), placed(0, 0, 0)) if case.of == "ball" else plane_room()
    data = dataclasses.replace(made.data, materials=[case.mirror, case.others], lights=list(case.lights))
    return Scene(data, device)


def drawn(case, device):
    """(frame, names of the kernel modules that were launched, planning included)."""
    scene = scene_of(case, device)
    with launch.recorded() as launches:
        frame = render(scene, case.method, size=SIZE, **case.settings)
        if case.moves:
            moved = dataclasses.replace(frame.camera, eye=frame.camera.eye + [0.01, 0.0, 0.0])
            frame = wr.render_frame(scene, frame.plan, moved, previous=frame)
    return frame, {name.rpartition(".")[0].removeprefix(PACKAGE) for name, _ in launches}


def owned(case, modules):
    return {name for name in modules if name.startswith(case.owns)}


@pytest.mark.parametrize("effect", CASES)
def test_effect_launches_and_holds_nothing_unless_a_frame_calls_for_it(effect, device):
    on = CASES[effect]
    with_it, launched = drawn(on, device)
    assert owned(on, launched), f"the case does not call for it: {sorted(launched)}"
    off = dataclasses.replace(on, **on.twin)
    without, still = drawn(off, device)
    assert not owned(on, still)
    for frame, modules in ((with_it, launched), (without, still)):
        ahead = {*kernels.of_plan(frame.plan), *kernels.of_eye(frame.plan.settings, device)}
        assert {name.replace("/", ".") for name in ahead} <= modules | {"vector"}, "compiled, and never launched"
    if effect in {*kernels.ROWS, "shadows", "transparency", "refinement"}:
        assert owned(on, kernels.of_plan(with_it.plan))
    if on.holds is not None:
        assert on.holds(with_it) > 0 and not on.holds(without)


def test_every_technique_and_effect_has_its_case(device):
    plans = [drawn(CASES[effect], device)[0].plan for effect in ("shadows", "transparency")]
    (row,), (light,), (pane,) = plans[0].rows, plans[0].lights, plans[1].panes
    named = {*TECHNIQUES, *effects.FINISHES, *effects.PANE_FINISHES, *row.effects, *light.effects, *pane.effects}
    assert named <= CASES.keys() | ARGUMENTS | ELSEWHERE, named - CASES.keys()


def test_collection_that_is_not_there_builds_no_structure_of_its_own(device):
    asks = dataclasses.replace(CHROME, mirror=MirrorData("/mirror", reflects=("/floor",)))
    with_it, _ = drawn(Case(mirror=asks), device)
    without, _ = drawn(Case(), device)
    assert with_it.plan.rows[0].effects["collection"].on and with_it.scene.mirror_tracers
    assert not without.plan.rows[0].effects["collection"].on and not without.scene.mirror_tracers


PLAIN = """
import json, sys
import warp as wp
wp.config.log_level = wp.LOG_WARNING
from rooms import placed, render, room, sphere
from warp_reflect import launch
scene = room(sphere(), placed(0, 0, 0))
found = {}
for method in ("none", "reference"):
    frame = render(scene, method, size=(64, 36))
    compiled = {module.name for module, *_ in launch._loaded}
    found[method] = sorted(compiled), sorted(vars(scene)), len(frame.layers)
print(json.dumps([found, [name for name in sys.modules if name.startswith("warp_reflect.finishes")]]))
"""


def test_nothing_of_any_effect_is_compiled_or_imported_for_a_picture_without_it():
    """In a process of its own: first a picture whose mirrors reflect nothing, then one of a sharp traced mirror."""
    run = [sys.executable, "-c", PLAIN]
    done = subprocess.run(run, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    found, finishes = json.loads(done.stdout.splitlines()[-1])
    assert finishes == []
    for method, spared in (("none", set()), ("reference", {"reflection", "raytraced", "refinement"})):
        compiled, scene, layer_count = found[method]
        names = {name.removeprefix(PACKAGE) for name in compiled}
        assert any(name.startswith("shade") for name in names)
        for effect, case in CASES.items():
            if effect not in spared:
                assert not owned(case, names), f"{method}: {effect}"
        assert layer_count == (method == "reference") and ("tracer" in scene) == (method == "reference")


def test_stage_without_mirrors_does_what_one_told_to_skip_them_does(device):
    """Not more work by a single launch, in planning and drawing: the time follows."""
    plain = scene_of(Case(mirror=MATT), device)
    mirror = scene_of(Case(), device)

    def launches(scene, method):
        with launch.recorded() as found:
            frame = render(scene, method, size=SIZE)
        return found, frame

    without, frame = launches(plain, "auto")
    told, _ = launches(mirror, "none")
    assert not frame.plan.rows and without == told
    assert not frame.plan._prepared and "tracer" not in vars(plain)
