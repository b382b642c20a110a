"""Mirrors by name: every form of a pattern, what it makes of the material, what is refused."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Usd, UsdGeom, UsdShade

from warp_reflect.planner import make_plan
from warp_reflect.stage.load import load_stage
from warp_reflect.stage.read import StageReader, read_stage
from warp_reflect.stage.reflectors import NEUTRAL_COLOR

PAINT = pytest.approx((0.8, 0.1, 0.1))


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


@pytest.fixture
def garage(stage):
    """A car of a body with a window and a wheel without material, before a wall of dark displayColor."""
    for path in ("/World/Car/Body", "/World/Car/Wheel", "/World/Wall"):
        samples.add_cube_mesh(stage, path)
    paint = samples.add_material(stage, "/Looks/Paint", diffuseColor=(0.8, 0.1, 0.1), useSpecularWorkflow=1)
    body = stage.GetPrimAtPath("/World/Car/Body")
    samples.bind(body, paint)
    subset = UsdShade.MaterialBindingAPI(body).CreateMaterialBindSubset("window", [0], "face")
    samples.bind(subset, samples.add_material(stage, "/Looks/Glass"))
    UsdGeom.Mesh.Get(stage, "/World/Wall").CreateDisplayColorPrimvar("constant").Set([Gf.Vec3f(0.05, 0.05, 0.1)])
    collection = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "shiny")
    collection.IncludePath("/World/Wall")
    return samples.saved(stage)


def mirrors(data):
    """Material of each part that was made a mirror, by "prim:part"."""
    return {
        f"{i.prim_path}:{k}": data.materials[m]
        for i in data.instances
        for k, m in enumerate(i.materials)
        if data.materials[m].mirror is not None
    }


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [
        ("/World/Wall", {"/World/Wall:0"}),
        ("/World/Car", {"/World/Car/Body:0", "/World/Car/Body:1", "/World/Car/Wheel:0"}),
        ("/World/Car/", {"/World/Car/Body:0", "/World/Car/Body:1", "/World/Car/Wheel:0"}),
        ("/World/*/Wheel", {"/World/Car/Wheel:0"}),
        ("/World/C*", {"/World/Car/Body:0", "/World/Car/Body:1", "/World/Car/Wheel:0"}),
        ("W*l", {"/World/Car/Wheel:0", "/World/Wall:0"}),
        ("Wall", {"/World/Wall:0"}),
        ("/Looks/Paint", {"/World/Car/Body:0"}),
        ("/Looks/G*", {"/World/Car/Body:1"}),
        ("Paint", {"/World/Car/Body:0"}),
        ("/World/Car/Body/window", {"/World/Car/Body:1"}),
        ("window", {"/World/Car/Body:1"}),
        ("/World.collection:shiny", {"/World/Wall:0"}),
        ("/World.collection:shiny:color=keep", {"/World/Wall:0"}),
    ],
)
def test_every_form_of_a_pattern_names_its_parts(garage, pattern, expected):
    assert not mirrors(read_stage(garage))
    chosen = mirrors(read_stage(garage, reflectors=(pattern,)))
    assert chosen.keys() == expected
    assert all((m.metallic, m.roughness, m.specular_workflow) == (1.0, 0.0, False) for m in chosen.values())


@pytest.mark.parametrize(
    ("options", "metallic", "roughness", "wall", "body"),
    [
        ("", 1.0, 0.0, NEUTRAL_COLOR, NEUTRAL_COLOR),
        (":color=keep", 1.0, 0.0, pytest.approx((0.05, 0.05, 0.1)), PAINT),
        (":color=1,0.5,0.25", 1.0, 0.0, (1.0, 0.5, 0.25), (1.0, 0.5, 0.25)),
        (":roughness=0.25:color=0.5", 1.0, 0.25, (0.5,) * 3, (0.5,) * 3),
        (":metallic=0.5:roughness=0.1", 0.5, 0.1, NEUTRAL_COLOR, NEUTRAL_COLOR),
    ],
)
def test_options_set_what_the_mirror_is_like(garage, options, metallic, roughness, wall, body):
    chosen = mirrors(read_stage(garage, reflectors=(f"/World/*{options}",)))
    assert {(m.metallic, m.roughness) for m in chosen.values()} == {(metallic, roughness)}
    assert chosen["/World/Wall:0"].base_color == wall
    assert chosen["/World/Car/Body:0"].base_color == body
    # Without a material and without a colour: UsdPreviewSurface's grey is what there is to keep.
    grey = pytest.approx((0.18,) * 3) if "keep" in options else wall
    assert chosen["/World/Car/Wheel:0"].base_color == grey


def test_varying_colours_are_kept_only_when_asked_for(stage):
    quad = samples.add_quad(stage, "/Quad")
    quad.CreateDisplayColorPrimvar("vertex").Set([Gf.Vec3f(0.1 * k, 0, 0) for k in range(4)])
    path = samples.saved(stage)
    neutral = mirrors(read_stage(path, reflectors="/Quad"))["/Quad:0"]
    kept = mirrors(read_stage(path, reflectors="/Quad:color=keep"))["/Quad:0"]
    assert not neutral.uses_vertex_color and neutral.base_color == NEUTRAL_COLOR
    assert kept.uses_vertex_color


def test_the_last_pattern_that_names_a_part_decides(garage):
    chosen = mirrors(read_stage(garage, reflectors=("/World/Car:roughness=0.2", "Wheel:color=0.5", "Wall")))
    assert [chosen[f"/World/{n}:0"].roughness for n in ("Car/Body", "Car/Wheel", "Wall")] == [0.2, 0.0, 0.0]
    assert chosen["/World/Car/Wheel:0"].base_color == (0.5,) * 3


def test_what_shares_a_material_keeps_its_own(garage):
    stage = Usd.Stage.Open(garage)
    samples.bind(stage.GetPrimAtPath("/World/Car/Wheel"), UsdShade.Material.Get(stage, "/Looks/Paint"))
    data = read_stage(samples.saved(stage), reflectors="Wheel")
    assert mirrors(data).keys() == {"/World/Car/Wheel:0"}


@pytest.mark.parametrize("pattern", ["/World/Wal", "/World.collection:dull", "/World/Wall:0", "Wal"])
def test_a_mirror_that_is_not_there_is_named_with_its_nearest(garage, pattern):
    with pytest.raises(ValueError, match=f"'{pattern}' names no drawn prim.*nearest: .*Wall"):
        read_stage(garage, reflectors=pattern)


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("Wall:rougness=0.1", "unknown option 'rougness'; nearest: roughness"),
        ("Wall:roughness=2", "roughness: got '2', expected a number from 0 to 1"),
        ("Wall:metallic=shiny", "metallic: got 'shiny'"),
        ("Wall:color=1,2", "color: got '1,2', expected one or 3 numbers"),
        ("Wall:color=nan", "color: got 'nan'"),
    ],
)
def test_impossible_options_are_named(garage, pattern, message):
    with pytest.raises(ValueError, match=message):
        StageReader(garage, reflectors=(pattern,))


def test_point_instances_can_be_named(stage):
    instancer = UsdGeom.PointInstancer.Define(stage, "/PI")
    instancer.CreatePrototypesRel().SetTargets(["/PI/Ball"])
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(3, 0, 0)])
    UsdGeom.Sphere.Define(stage, "/PI/Ball")
    data = read_stage(samples.saved(stage), reflectors="/PI:1")
    assert [data.materials[i.materials[0]].metallic for i in data.instances] == [0.0, 1.0]


def test_a_chosen_mirror_is_planned_whatever_its_roughness(garage):
    """Rough and half metallic it would be no mirror by itself; its technique is the one that was asked for."""
    chosen = ("Wall:roughness=0.9:metallic=0.1", "/World/Car/Body:technique=raytraced", "window:technique=magic")
    plan = make_plan(load_stage(garage, reflectors=chosen), size=(64, 48))
    rows = {f"{row.path}.{row.subset}": row for row in plan.rows}
    assert rows.keys() == {"/World/Wall.", "/World/Car/Body.", "/World/Car/Body.window"}
    assert (rows["/World/Car/Body."].technique, rows["/World/Car/Body."].forced) == ("raytraced", True)
    assert "chosen" in rows["/World/Wall."].effects["reflection"].reason or not rows["/World/Wall."].pixels
    assert any("magic" in note.text for note in plan.notes)
    assert np.isfinite([row.effects["reflection"].numbers["weight"] for row in plan.rows]).all()
