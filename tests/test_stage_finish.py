"""`WarpReflectFinishAPI`: what a stage asks of surfaces, to whom it goes, and what is refused by name."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, Usd, UsdGeom

from warp_reflect.scene import FinishData
from warp_reflect.stage.finish import FINISH_API
from warp_reflect.stage.read import read_stage
from warp_reflect.stage.schema import PLUGIN

TYPES = {"interface": Sdf.ValueTypeNames.Token, "fadeColor": Sdf.ValueTypeNames.Color3f}
TYPES["frostColor"] = TYPES["fadeColor"]


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def asked(prim, **values):
    prim.AddAppliedSchema(FINISH_API)
    for name, value in values.items():
        prim.CreateAttribute(f"warp_reflect:{name}", TYPES.get(name, Sdf.ValueTypeNames.Float)).Set(value)
    return prim


def finish_of(data, path):
    (instance,) = (each for each in data.instances if each.prim_path == path)
    return data.materials[instance.materials[0]].finish


def test_what_is_asked_goes_to_the_prim_and_all_below_it(stage):
    group = UsdGeom.Xform.Define(stage, "/Group").GetPrim()
    asked(group, frost=3.0, frostDistance=2.0, frostColor=Gf.Vec3f(0.5, 0.6, 0.7), interface="solid")
    for path in ("/Group/A", "/Group/B", "/C"):
        samples.add_cube_mesh(stage, path)
    asked(stage.GetPrimAtPath("/Group/B"), waveSlope=0.1, waveLength=2.0, waveSpeed=0.5, fadeDistance=1.0)
    data = read_stage(samples.saved(stage))
    wanted = {"frost": 3.0, "frost_distance": 2.0, "frost_color": pytest.approx((0.5, 0.6, 0.7)), "interface": "solid"}
    assert {name: getattr(finish_of(data, "/Group/A"), name) for name in wanted} == wanted
    wanted = {
        "wave_slope": pytest.approx(0.1),
        "wave_length": 2.0,
        "wave_speed": 0.5,
        "fade_distance": 1.0,
        "frost": 0.0,
    }
    assert {name: getattr(finish_of(data, "/Group/B"), name) for name in wanted} == wanted
    assert finish_of(data, "/C") is None and not any("WarpReflect" in each.text for each in data.notes)


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("frost", 50.0, "got 50, expected at most 45"),
        ("frost", -1.0, "got -1"),
        ("frost", float("nan"), "got nan"),
        ("waveSlope", 0.7, "got 0.7, expected at most 0.5"),
        ("waveLength", 0.0, "expected a number > 0"),
        ("waveSpeed", float("inf"), "got inf"),
        ("fadeDistance", -3.0, "got -3"),
        ("frostColor", Gf.Vec3f(-1.0, 0.0, 0.0), "expected 3 numbers from 0 on"),
        ("interface", "thick", "expected one of auto, thin, solid"),
    ],
)
def test_bad_values_are_refused_by_prim_and_attribute(stage, name, value, told):
    asked(samples.add_cube_mesh(stage, "/Cube").GetPrim(), **{name: value})
    data = read_stage(samples.saved(stage))
    assert finish_of(data, "/Cube") is None
    (note,) = (each for each in data.notes if each.path == "/Cube")
    assert f"warp_reflect:{name}: " in note.text and told in note.text


def test_the_schema_has_the_fallbacks_of_the_data():
    definitions = Usd.Stage.Open(str(PLUGIN / "generatedSchema.usda"))
    prim = definitions.GetPrimAtPath(f"/{FINISH_API}")
    fields = {
        "interface": "interface",
        "fadeDistance": "fade_distance",
        "fadeColor": "fade_color",
        "frost": "frost",
        "frostDistance": "frost_distance",
        "frostColor": "frost_color",
        "waveSlope": "wave_slope",
        "waveLength": "wave_length",
        "waveSpeed": "wave_speed",
    }
    assert {each.GetBaseName() for each in prim.GetAttributes()} == set(fields)
    for name, field in fields.items():
        fallback = prim.GetAttribute(f"warp_reflect:{name}").Get()
        np.testing.assert_array_equal(np.asarray(fallback), np.asarray(getattr(FinishData(""), field)))
