"""Materials in .mtlx files, by reference from a stage."""

import shutil
import sys

import numpy as np
import pytest
import stage_samples as samples
from pxr import Sdf, Usd, UsdShade

from warp_reflect.images import write_png
from warp_reflect.stage.intake import Intake
from warp_reflect.stage.materialx import referenced_material
from warp_reflect.stage.read import read_stage

GOLD = """<?xml version="1.0"?>
<materialx version="1.38" colorspace="lin_rec709" {extra}>
  {include}
  <nodegraph name="NG">
    <input name="gain" type="float" value="0.5"/>
    <image name="color" type="color3">
      <input name="file" type="filename" value="tex/color.png" colorspace="srgb_texture"/>
    </image>
    <multiply name="darker" type="color3">
      <input name="in1" type="color3" nodename="color"/>
      <input name="in2" type="float" interfacename="gain"/>
    </multiply>
    <image name="bumps" type="vector3">
      <input name="file" type="filename" value="tex/bumps.png"/>
    </image>
    <normalmap name="bump" type="vector3">
      <input name="in" type="vector3" nodename="bumps"/>
    </normalmap>
    <output name="out_color" type="color3" nodename="darker"/>
    <output name="out_normal" type="vector3" nodename="bump"/>
  </nodegraph>
  <standard_surface name="S" type="surfaceshader">
    <input name="base" type="float" value="1"/>
    <input name="base_color" type="color3" nodegraph="NG" output="out_color"/>
    <input name="metalness" type="float" value="1"/>
    <input name="specular_roughness" type="float" value="0.125"/>
    <input name="normal" type="vector3" nodegraph="NG" output="out_normal"/>
  </standard_surface>
  <surfacematerial name="gold" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="S"/>
  </surfacematerial>
</materialx>
"""
RED = """<?xml version="1.0"?>
<materialx version="1.39" colorspace="lin_rec709">
  <UsdPreviewSurface name="P" type="surfaceshader">
    <input name="diffuseColor" type="color3" value="0.5, 0.25, 0.125"/>
    <input name="ior" type="float" value="2.0"/>
  </UsdPreviewSurface>
  <surfacematerial name="red" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="P"/>
  </surfacematerial>
</materialx>
"""


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "looks" / "tex").mkdir(parents=True)
    for name in ("color", "bumps"):
        write_png(tmp_path / "looks" / "tex" / f"{name}.png", np.full((2, 2, 3), 0.5, np.float32))
    (tmp_path / "looks" / "gold.mtlx").write_text(GOLD.format(extra="", include=""))
    (tmp_path / "looks" / "red.mtlx").write_text(RED)
    return tmp_path


def stage_with(folder, references, targets):
    """Quads /Q0, /Q1 ... bound to the targets, and prims that reference (path, file, path in it)."""
    stage = samples.new_stage(folder / "stage.usda")
    for path, file, inside in references:
        stage.DefinePrim(path).GetReferences().AddReference(file, inside)
    for k, target in enumerate(targets):
        prim = samples.add_quad(stage, f"/Q{k}").GetPrim()
        UsdShade.MaterialBindingAPI.Apply(prim)
        prim.CreateRelationship("material:binding").SetTargets([target])
    return stage


def texts(data):
    return [f"{note.path}: {note.text}" for note in data.notes if "__default" not in note.path]


def materials(data):
    return [data.materials[instance.materials[0]] for instance in data.instances]


@pytest.mark.parametrize(
    ("site", "inside", "target"),
    [
        ("/L", "/MaterialX", "/L/Materials/gold"),
        ("/L/M", "/MaterialX/Materials", "/L/M/gold"),
        ("/L", "", "/L/Materials/gold"),
        ("/gold", "/MaterialX/Materials/gold", "/gold"),
    ],
)
def test_referenced_material_is_the_one_in_the_file(folder, site, inside, target):
    stage = stage_with(folder, [(site, "./looks/gold.mtlx", inside)], [target])
    data = read_stage(samples.saved(stage))
    (got,) = materials(data)
    assert got.path == target and (got.metallic, got.roughness) == (1.0, 0.125)
    color, normal = got.textures["base_color"], got.textures["normal"]
    assert color.file == str(folder / "looks" / "tex" / "color.png")
    assert color.color_space == "sRGB" and color.scale[:3] == (0.5, 0.5, 0.5)
    assert normal.color_space == "signed" and normal.scale[:3] == (2, 2, 2) and normal.bias[:3] == (-1, -1, -1)
    assert [text for text in texts(data) if "primvars:st" not in text] == []


def test_material_prim_that_references_a_file_is_read(folder):
    stage = stage_with(folder, [], ["/Looks/Red"])
    made = UsdShade.Material.Define(stage, "/Looks/Red")
    made.GetPrim().GetReferences().AddReference("./looks/red.mtlx", "/MaterialX/Materials/red")
    data = read_stage(samples.saved(stage))
    (got,) = materials(data)
    assert got.path == "/Looks/Red" and got.base_color == (0.5, 0.25, 0.125) and got.ior == 2.0
    assert texts(data) == []


def test_instances_find_the_files_of_their_prototype(folder):
    asset = Usd.Stage.CreateNew(str(folder / "asset.usda"))
    samples.add_quad(asset, "/A/Q")
    asset.DefinePrim("/A/Looks").GetReferences().AddReference("./looks/red.mtlx", "/MaterialX/Materials")
    quad = asset.GetPrimAtPath("/A/Q")
    UsdShade.MaterialBindingAPI.Apply(quad)
    quad.CreateRelationship("material:binding").SetTargets(["/A/Looks/red"])
    asset.SetDefaultPrim(asset.GetPrimAtPath("/A"))
    asset.GetRootLayer().Save()
    stage = samples.new_stage(folder / "stage.usda")
    for name in ("/I", "/J"):
        prim = stage.DefinePrim(name)
        prim.GetReferences().AddReference("./asset.usda")
        prim.SetInstanceable(True)
    data = read_stage(samples.saved(stage))
    assert [m.base_color for m in materials(data)] == [(0.5, 0.25, 0.125)] * 2
    assert texts(data) == []


def test_selected_variant_names_the_file(folder):
    stage = stage_with(folder, [], ["/L/red"])
    prim = stage.DefinePrim("/L")
    variants = prim.GetVariantSets().AddVariantSet("model")
    for name in ("a", "b"):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            prim.GetReferences().AddReference(
                {"a": "./looks/red.mtlx", "b": "./none.mtlx"}[name], "/MaterialX/Materials"
            )
    variants.SetVariantSelection("a")
    assert materials(read_stage(samples.saved(stage)))[0].base_color == (0.5, 0.25, 0.125)


def test_without_the_package_one_note_names_the_extra(folder, monkeypatch):
    stage = stage_with(
        folder,
        [("/L", "./looks/gold.mtlx", "/MaterialX"), ("/R", "./looks/red.mtlx", "/MaterialX")],
        ["/L/Materials/gold", "/R/Materials/red", "/R/Materials/red"],
    )
    monkeypatch.setitem(sys.modules, "MaterialX", None)
    data = read_stage(samples.saved(stage))
    assert [m.base_color for m in materials(data)] == [(0.18, 0.18, 0.18)] * 3
    (text,) = texts(data)
    assert "warp_reflect[materialx]" in text


def test_what_the_file_lacks_is_told_once(folder):
    stage = stage_with(folder, [("/L", "./looks/red.mtlx", "/MaterialX/Materials")], ["/L/blue", "/L/blue"])
    (text,) = texts(read_stage(samples.saved(stage)))
    assert text.startswith("/L/blue: no such material in @") and "red.mtlx" in text


@pytest.mark.parametrize("content", [None, "<materialx", "", "no xml at all", "\0\1\2"])
def test_files_that_cannot_be_read_are_told_once(folder, content):
    if content is not None:
        (folder / "bad.mtlx").write_text(content)
    stage = stage_with(folder, [("/L", "./bad.mtlx", "/MaterialX/Materials")], ["/L/a", "/L/b"])
    found = texts(read_stage(samples.saved(stage)))
    assert found and all("bad.mtlx" in text for text in found)
    assert len([text for text in found if "cannot be read" in text]) <= 1


def test_strict_reading_refuses_a_broken_file(folder):
    (folder / "bad.mtlx").write_text("<materialx")
    stage = stage_with(folder, [("/L", "./bad.mtlx", "/MaterialX/Materials")], ["/L/a"])
    with pytest.raises(ValueError, match=r"bad\.mtlx"):
        read_stage(samples.saved(stage), strict=True)


def test_included_documents_are_read_and_confined(folder):
    from warp_reflect.stage.guard import Limits

    outer = GOLD.format(
        extra='xmlns:xi="http://www.w3.org/2001/XInclude"', include='<xi:include href="../other/red.mtlx"/>'
    )
    (folder / "other").mkdir()
    shutil.move(folder / "looks" / "red.mtlx", folder / "other" / "red.mtlx")
    (folder / "looks" / "gold.mtlx").write_text(outer)
    stage = stage_with(folder / "looks", [("/L", "./gold.mtlx", "/MaterialX/Materials")], ["/L/red"])
    file = samples.saved(stage)
    assert materials(read_stage(file))[0].base_color == (0.5, 0.25, 0.125)
    confined = read_stage(file, limits=Limits(root=str(folder / "looks")))
    assert materials(confined)[0].base_color == (0.18, 0.18, 0.18)
    assert any("outside the folder" in text for text in texts(confined))


def test_packed_document_finds_its_packed_pictures(folder):
    stage = stage_with(folder, [("/L", "./looks/gold.mtlx", "/MaterialX/Materials")], ["/L/gold"])
    samples.saved(stage)
    package = str(folder / "all.usdz")
    with Sdf.ZipFileWriter.CreateNew(package) as zipped:
        for inside in ("stage.usda", "looks/gold.mtlx", "looks/tex/color.png", "looks/tex/bumps.png"):
            zipped.AddFile(str(folder / inside), inside)
    (got,) = materials(read_stage(package))
    assert got.textures["base_color"].file == f"{package}[looks/tex/color.png]"


def test_cyclic_graphs_end(folder):
    (folder / "loop.mtlx").write_text(
        RED.replace(
            "<UsdPreviewSurface",
            '<add name="A" type="color3"><input name="in1" type="color3" nodename="A"/></add><UsdPreviewSurface',
        ).replace('value="0.5, 0.25, 0.125"', 'nodename="A"')
    )
    stage = stage_with(folder, [("/L", "./loop.mtlx", "/MaterialX/Materials")], ["/L/red"])
    data = read_stage(samples.saved(stage))
    assert materials(data)[0].base_color == (0.18, 0.18, 0.18)
    assert any("cycle" in text for text in texts(data))


def test_prims_without_such_a_file_mean_none(folder):
    stage = stage_with(folder, [], ["/nothing"])
    assert referenced_material(stage, Sdf.Path("/nothing"), Intake(Usd.TimeCode.Default(), False, None)) == (
        None,
        False,
    )
