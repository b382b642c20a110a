"""The API schemas on a stage: known to the library, read with and without it, and what they ask for."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from warp_reflect.planner import make_plan
from warp_reflect.stage.guard import read_untrusted
from warp_reflect.stage.load import load_stage
from warp_reflect.stage.read import read_stage
from warp_reflect.stage.reflectors import NEUTRAL_COLOR
from warp_reflect.stage.schema import ENVIRONMENT_MAP_API, MIRROR_API, PLUGIN

TYPES = {
    "metallic": Sdf.ValueTypeNames.Float,
    "roughness": Sdf.ValueTypeNames.Float,
    "color": Sdf.ValueTypeNames.Color3f,
    "include": Sdf.ValueTypeNames.Bool,
    "technique": Sdf.ValueTypeNames.Token,
    "layout": Sdf.ValueTypeNames.Token,
    "map": Sdf.ValueTypeNames.Asset,
    "mapResolution": Sdf.ValueTypeNames.Int,
    "mapGeometry": Sdf.ValueTypeNames.StringArray,
    "unitFromBody": Sdf.ValueTypeNames.Matrix4dArray,
}
# A process of its own: whether the library learns of the schemas is settled when it first needs any.
CHILD = """
import json, sys
if sys.argv[2] == "late":
    from pxr import Usd
    Usd.Stage.CreateInMemory().DefinePrim("/A", "Sphere")
from warp_reflect.stage.read import read_stage
data = read_stage(sys.argv[1])
from pxr import Usd
definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition("WarpReflectMirrorAPI")
properties = sorted(definition.GetPropertyNames()) if definition else None
found = [[i.prim_path, data.materials[i.materials[0]].metallic, data.materials[i.materials[0]].mirror is not None]
         for i in data.instances]
print(json.dumps([properties, found]))
"""


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def asked(prim, schema=MIRROR_API, **values):
    """Author a schema as any tool can that does not know it: its name, and attributes."""
    prim.AddAppliedSchema(schema)
    for name, value in values.items():
        prim.CreateAttribute(f"warp_reflect:{name}", TYPES[name]).Set(value)
    return prim


def materials(data):
    return {
        f"{i.prim_path}{f'[{i.instance}]' if i.instance else ''}:{k}": data.materials[m]
        for i in data.instances
        for k, m in enumerate(i.materials)
    }


def notes(data):
    return [f"{note.path}: {note.text}" for note in data.notes]


@pytest.mark.parametrize("when", ["early", "late"])
def test_schemas_are_read_whether_the_library_knows_them_or_not(stage, when):
    asked(samples.add_quad(stage, "/Quad").GetPrim(), metallic=0.75)
    samples.add_quad(stage, "/Other")
    command = [sys.executable, "-c", CHILD, samples.saved(stage), when]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    properties, found = json.loads(done.stdout)
    assert found == [["/Quad", 0.75, True], ["/Other", 0.0, False]]
    if when == "early":
        assert properties == sorted(f"warp_reflect:{name}" for name in TYPES)
    else:
        assert properties is None  # the library does not look for plugins a second time
    assert done.stderr == ""


def test_schema_files_are_part_of_the_package():
    root = Path(__file__).resolve().parents[1]
    table = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    shipped = {p.name for pattern in table["warp_reflect"] for p in (root / "warp_reflect").glob(pattern)}
    assert {p.name for p in PLUGIN.iterdir()} == {"plugInfo.json", "generatedSchema.usda"} <= shipped
    layer = Sdf.Layer.FindOrOpen(str(PLUGIN / "generatedSchema.usda"))
    for name, kind in TYPES.items():
        assert layer.GetAttributeAtPath(f"/{MIRROR_API}.warp_reflect:{name}").typeName == kind
    declared = json.loads((PLUGIN / "plugInfo.json").read_text())["Plugins"][0]["Info"]["Types"].values()
    assert {prim.name for prim in layer.rootPrims} == {each["alias"]["UsdSchemaBase"] for each in declared}


def test_a_mirror_is_what_its_prim_says(stage):
    grey = samples.add_quad(stage, "/Grey").GetPrim()
    asked(grey)
    asked(samples.add_quad(stage, "/Set").GetPrim(), metallic=0.5, roughness=0.25, color=Gf.Vec3f(1.0, 0.5, 0.25))
    copper = samples.add_material(stage, "/M", diffuseColor=(0.9, 0.5, 0.3), metallic=1.0, roughness=0.03125)
    for path in ("/Copper", "/Smooth", "/Plain"):
        samples.bind(samples.add_quad(stage, path), copper)
    asked(stage.GetPrimAtPath("/Copper"), technique="raytraced")
    asked(stage.GetPrimAtPath("/Smooth"), roughness=0.0)
    found = materials(read_stage(samples.saved(stage)))
    values = {path: (m.metallic, m.roughness, m.base_color) for path, m in found.items()}
    assert values["/Grey:0"] == (1.0, 0.0, NEUTRAL_COLOR)
    assert values["/Set:0"] == (0.5, 0.25, (1.0, 0.5, 0.25))
    # What is a mirror already stays what it is but for what is said.
    assert values["/Copper:0"] == values["/Plain:0"] and found["/Copper:0"].mirror.technique == "raytraced"
    assert values["/Smooth:0"] == (1.0, 0.0, values["/Plain:0"][2])
    assert found["/Plain:0"].mirror is None


def test_the_nearest_prim_above_decides_and_names_win(stage):
    world = UsdGeom.Xform.Define(stage, "/World").GetPrim()
    for path in ("/World/A", "/World/Car/Body", "/World/Car/Wheel"):
        samples.add_quad(stage, path)
    asked(world, roughness=0.25)
    asked(stage.GetPrimAtPath("/World/Car"), roughness=0.125)
    asked(stage.GetPrimAtPath("/World/Car/Wheel"), include=False)
    path = samples.saved(stage)
    found = materials(read_stage(path))
    assert [found[f"/World/{n}:0"].roughness for n in ("A", "Car/Body", "Car/Wheel")] == [0.25, 0.125, 0.5]
    assert [row.path for row in make_plan(load_stage(path), size=(64, 48)).rows] == ["/World/A", "/World/Car/Body"]
    assert materials(read_stage(path, reflectors="Wheel:roughness=0.05"))["/World/Car/Wheel:0"].roughness == 0.05


def test_an_excluded_mirror_is_not_planned(stage):
    chrome = samples.add_material(stage, "/M", diffuseColor=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    for path in ("/In", "/Out"):
        samples.bind(samples.add_quad(stage, path), chrome)
    asked(stage.GetPrimAtPath("/Out"), include=False)
    assert [row.path for row in make_plan(load_stage(samples.saved(stage)), size=(64, 48)).rows] == ["/In"]


def test_subsets_materials_and_instances_can_be_mirrors(stage):
    cube = samples.add_cube_mesh(stage, "/Cube").GetPrim()
    subset = UsdShade.MaterialBindingAPI(cube).CreateMaterialBindSubset("front", [0], "face").GetPrim()
    samples.bind(subset, samples.add_material(stage, "/Matt"))
    asked(subset, roughness=0.1)
    paint = samples.add_material(stage, "/Paint")
    asked(paint.GetPrim(), roughness=0.2)
    samples.bind(samples.add_quad(stage, "/Painted"), paint)
    asked(UsdGeom.Sphere.Define(stage, "/Proto/Ball").GetPrim(), roughness=0.3)
    stage.GetPrimAtPath("/Proto").SetSpecifier(Sdf.SpecifierClass)
    for path in ("/I1", "/I2"):
        prim = stage.DefinePrim(path)
        prim.GetInherits().AddInherit("/Proto")
        prim.SetInstanceable(True)
    instancer = UsdGeom.PointInstancer.Define(stage, "/PI")
    asked(UsdGeom.Sphere.Define(stage, "/PI/Drop").GetPrim(), roughness=0.25)
    instancer.CreatePrototypesRel().SetTargets(["/PI/Drop"])
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(3, 0, 0)])
    data = read_stage(samples.saved(stage))
    parts = {i.prim_path: data.meshes[i.mesh].parts for i in data.instances}
    found = {path: m.roughness for path, m in materials(data).items() if m.mirror is not None}
    front = [part.subset for part in parts["/Cube"]].index("front")
    assert found == {
        f"/Cube:{front}": pytest.approx(0.1),
        "/Painted:0": pytest.approx(0.2),
        "/I1/Ball:0": pytest.approx(0.3),
        "/I2/Ball:0": pytest.approx(0.3),
        "/PI/Drop[/PI:0]:0": 0.25,
        "/PI/Drop[/PI:1]:0": 0.25,
    }


def test_the_collection_says_what_a_mirror_reflects(stage):
    for path in ("/World/Near", "/World/Far/Tree", "/World/Far/Rock", "/Mirror", "/Whole"):
        samples.add_quad(stage, path)
    mirror, whole = (asked(stage.GetPrimAtPath(path)) for path in ("/Mirror", "/Whole"))
    collection = Usd.CollectionAPI.Apply(mirror, "reflects")
    collection.IncludePath("/World")
    collection.ExcludePath("/World/Far/Rock")
    found = materials(read_stage(samples.saved(stage)))
    reflects = found["/Mirror:0"].mirror.reflects
    assert {"/World/Near", "/World/Far/Tree"} <= set(reflects)
    assert not {"/World/Far/Rock", "/Mirror", "/Whole"} & set(reflects)
    assert found["/Whole:0"].mirror.reflects is None
    assert whole.GetPath() == "/Whole"


def test_reflecting_all_but_a_few(stage):
    for path in ("/A", "/B", "/Mirror"):
        samples.add_quad(stage, path)
    collection = Usd.CollectionAPI.Apply(asked(stage.GetPrimAtPath("/Mirror")), "reflects")
    collection.CreateIncludeRootAttr(True)
    collection.ExcludePath("/B")
    reflects = materials(read_stage(samples.saved(stage)))["/Mirror:0"].mirror.reflects
    assert "/A" in reflects and "/B" not in reflects


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"roughness": 1.5}, "warp_reflect:roughness: got 1.5, expected 0 to 1"),
        ({"metallic": float("nan")}, "warp_reflect:metallic: got nan"),
        ({"metallic": -1.0}, "warp_reflect:metallic: got -1"),
        ({"color": Gf.Vec3f(2, 0, 0)}, "warp_reflect:color: got (2, 0, 0)"),
    ],
)
def test_impossible_values_are_told_and_the_prim_stays_as_it_is(stage, values, message):
    asked(samples.add_quad(stage, "/Quad").GetPrim(), **values)
    path = samples.saved(stage)
    data = read_stage(path)
    assert materials(data)["/Quad:0"].mirror is None
    assert sum(text.startswith("/Quad: " + message) and text.endswith("not used") for text in notes(data)) == 1
    with pytest.raises(ValueError, match="</Quad>: warp_reflect:"):
        read_stage(path, strict=True)


def test_attributes_of_another_type_are_told(stage):
    prim = samples.add_quad(stage, "/Quad").GetPrim()
    prim.AddAppliedSchema(MIRROR_API)
    # As a spec: a stage holds authors to the schema's types once the schema is registered in the process.
    spec = stage.GetRootLayer().GetPrimAtPath("/Quad")
    Sdf.AttributeSpec(spec, "warp_reflect:include", Sdf.ValueTypeNames.String).default = "no"
    assert any("warp_reflect:include: got 'no', expected a bool" in t for t in notes(read_stage(samples.saved(stage))))


def test_places_of_environment_maps_are_read(stage, tmp_path):
    (tmp_path / "room.exr").touch()
    probe = UsdGeom.Xform.Define(stage, "/World/Probe")
    probe.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    asked(probe.GetPrim(), ENVIRONMENT_MAP_API, map=Sdf.AssetPath("./room.exr"), layout="cube")
    lost = UsdGeom.Xform.Define(stage, "/Lost")
    asked(lost.GetPrim(), ENVIRONMENT_MAP_API, map=Sdf.AssetPath("./lost.exr"))
    for path, fault in (("/Flat", "singular"), ("/Hidden", "")):
        other = UsdGeom.Xform.Define(stage, path)
        asked(other.GetPrim(), ENVIRONMENT_MAP_API)
        if fault:
            other.AddScaleOp().Set(Gf.Vec3f(0, 1, 1))
        else:
            other.MakeInvisible()
    data = read_stage(samples.saved(stage))
    missing, found = sorted(data.environment_maps, key=lambda each: each.path)
    assert (missing.path, missing.map_file) == ("/Lost", "")
    assert any("/Lost: warp_reflect:map: @./lost.exr@: no such file" in text for text in notes(data))
    assert (found.path, found.map_file, found.map_layout) == ("/World/Probe", str(tmp_path / "room.exr"), "cube")
    np.testing.assert_array_equal(found.world_from_map[:3, 3], [1, 2, 3])
    assert any(text.startswith("/Flat: ") and "singular" in text for text in notes(data))


def test_mirrors_and_maps_come_out_of_the_child_process(stage):
    asked(samples.add_quad(stage, "/Quad").GetPrim(), roughness=0.25, technique="planar")
    asked(UsdGeom.Xform.Define(stage, "/Probe").GetPrim(), ENVIRONMENT_MAP_API)
    path = samples.saved(stage)
    trusted, untrusted = read_stage(path), read_untrusted(path)
    assert materials(untrusted) == materials(trusted)
    assert [m.path for m in untrusted.environment_maps] == ["/Probe"]


def test_a_mirror_gets_the_detail_of_one(stage):
    for path in ("/Mirror", "/Wall"):
        samples.add_cube_mesh(stage, path, "catmullClark")
    asked(stage.GetPrimAtPath("/Mirror"))
    data = read_stage(samples.saved(stage))
    counts = {i.prim_path: len(data.meshes[i.mesh].triangles) for i in data.instances}
    assert counts["/Mirror"] > counts["/Wall"]
