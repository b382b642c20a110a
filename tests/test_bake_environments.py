"""Baked reference environment maps: the files, the layer that names them, and frames that look them up."""

from __future__ import annotations

import numpy as np
import pytest
import street
from pxr import Gf, Usd, UsdGeom, UsdValidation
from stage_samples import saved

import warp_reflect as wr
from warp_reflect import baked_environments, cli, images
from warp_reflect.bake import bake_stage
from warp_reflect.techniques import reference_maps

SIZE = (160, 90)
SETTINGS = wr.Settings(environment_resolution=32, map_resolution=16)


def rendered(path, time=2.4):
    scene = wr.load_stage(str(path), time=time)
    return wr.render_frame(scene, wr.make_plan(scene, size=SIZE, settings=SETTINGS, method="layered_environment"))


def forbid(monkeypatch) -> None:
    def drawn(*arguments, **options):
        raise AssertionError("a map is drawn although it is baked")

    monkeypatch.setattr(reference_maps, "draw_maps", drawn)


@pytest.fixture
def source(tmp_path):
    return saved(street.street(tmp_path / "street.usda"))


@pytest.fixture
def baked(source, tmp_path):
    return bake_stage(wr.load_stage(source, time=1.0), tmp_path / "baked.usda", SETTINGS)


def test_baked_maps_are_read_instead_of_drawn(source, baked, monkeypatch):
    """At any time: colours are stored as half, so what is shown agrees to its precision."""
    assert list(baked.environments) == [f"/World/Maps/M{k}" for k in range(3)]
    expected = rendered(source)
    forbid(monkeypatch)
    frame = rendered(baked.layer)
    assert not [note for note in frame.scene.notes if "environment" in note.text]
    np.testing.assert_array_equal(frame["reflectedId"], expected["reflectedId"])
    difference = np.abs(frame["RGBA"] - expected["RGBA"])
    # A code of the packed luma is 1.6 % wide: a half may round to the next.
    assert difference.max() < 0.05 and difference.mean() < 1e-3


def test_file_holds_what_is_drawn(source, baked):
    scene = wr.load_stage(str(baked.layer), time=1.0)
    asked = scene.data.environment_maps[1]
    radiance, distance = baked_environments.read_map(asked, reference_maps.world_digest(scene, SETTINGS))
    drawn = reference_maps.draw_maps(scene, reference_maps.authored(scene), SETTINGS)
    np.testing.assert_allclose(radiance, drawn.radiance(1), rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(distance, drawn.distance(1))
    channels, header = images.read_exr(asked.map_file)
    assert header["warp_reflect:layout"] == baked_environments.LAYOUT and set(channels) == set("RGBAZ")
    # Compressed: smaller than its samples of 2 bytes for a colour and 4 for a distance.
    assert baked.environments["/World/Maps/M1"].stat().st_size < 0.6 * 6 * 32 * 32 * (4 * 2 + 4)


def test_layer_is_valid_and_changes_nothing_else(baked):
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(data.name) for data in registry.GetAllValidatorMetadata()]
    stage = Usd.Stage.Open(str(baked.layer))
    faults = UsdValidation.ValidationContext(validators).Validate(stage)
    # The stage of the tests has no default prim; the layer brings no fault of its own.
    assert not [fault.GetErrorAsString() for fault in faults if "Maps" in fault.GetErrorAsString()]
    prim = stage.GetPrimAtPath("/World/Maps/M0")
    assert prim.GetAttribute("warp_reflect:map").Get().resolvedPath == str(baked.environments["/World/Maps/M0"])


def test_places_that_were_proposed_are_written(tmp_path, monkeypatch):
    source = saved(street.street(tmp_path / "street.usda", places=()))
    written = bake_stage(wr.load_stage(source, time=1.0), tmp_path / "baked.usda", SETTINGS.replace(rem_limit=2))
    assert len(written.environments) == 2
    assert any("2 placed along the paths" in note.text for note in written.notes)
    stage = Usd.Stage.Open(str(written.layer))
    for path in written.environments:
        prim = stage.GetPrimAtPath(path)
        assert prim.GetTypeName() == "Xform" and street.MAP_API in prim.GetPrimTypeInfo().GetAppliedAPISchemas()
        place = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0).ExtractTranslation()
        assert street.START <= place[0] <= street.END and place[1] == pytest.approx(street.HEIGHT, abs=1e-6)
    forbid(monkeypatch)
    frame = rendered(written.layer)
    row = frame.plan.rows[0]
    assert frame.plan.prepared(row).references.placement.paths == tuple(written.environments)
    assert (frame["reflection"][frame["reflectorId"] > 0].max(-1) > 0.01).all()


def test_stage_without_moving_mirrors_or_places_gets_none(tmp_path):
    stage = street.street(tmp_path / "street.usda", places=())
    stage.RemovePrim("/World/Ball")
    written = bake_stage(wr.load_stage(saved(stage), time=1.0), tmp_path / "baked.usda", SETTINGS)
    assert written.environments == {} and len(list(tmp_path.glob("*.exr"))) == 0


@pytest.mark.parametrize("change", ["wall", "light", "place", "file", "garbage"])
def test_maps_that_no_longer_fit_are_drawn_anew_with_a_note(change, source, baked):
    stage = Usd.Stage.Open(str(source))
    said = "was drawn of another world"
    if change == "wall":
        stage.GetPrimAtPath("/World/House0R").GetAttribute("xformOp:translate").Set(Gf.Vec3d(-12.5, 2.0, 5.0))
    elif change == "light":
        stage.GetPrimAtPath("/World/Sun").GetAttribute("inputs:intensity").Set(3.0)
    elif change == "place":
        stage.GetPrimAtPath("/World/Maps/M1").GetAttribute("xformOp:translate").Set(Gf.Vec3d(0.5, 0.6, 0))
        said = "was drawn at another place"
    elif change == "file":
        baked.environments["/World/Maps/M1"].unlink()
        said = "M1"
    else:
        baked.environments["/World/Maps/M1"].write_bytes(b"\x76\x2f\x31\x01 no picture")
        said = "M1"
    stage.GetRootLayer().Save()
    frame = rendered(baked.layer)
    notes = [note for note in frame.scene.notes if note.path == "/World/Maps/M1"]
    assert notes and said in notes[0].text + notes[0].path, frame.scene.notes
    mirror = frame["reflectorId"] > 0
    assert (frame["reflection"][mirror].max(-1) > 0.01).all() and all(np.isfinite(frame[n]).all() for n in frame.keys())
    if change in ("wall", "light"):
        traced = wr.render_frame(frame.scene, wr.make_plan(frame.scene, size=SIZE, method="reference"))
        assert np.median(np.abs(frame["RGBA"] - traced["RGBA"])[mirror].max(-1)) < 0.02


def test_untrusted_stage_has_its_maps_drawn(baked):
    scene = wr.load_stage(str(baked.layer), time=2.4, untrusted=True)
    assert all(each.map_file == "" for each in scene.data.environment_maps)
    assert sum("untrusted" in note.text for note in scene.notes) == 3


def test_command_tells_the_maps(source, tmp_path, capsys):
    out = tmp_path / "out.usda"
    sizes = ["--set", "environment_resolution=16", "--set", "map_resolution=16"]
    assert cli.main(["bake", str(source), str(out), *sizes]) == 0
    said = capsys.readouterr().out.splitlines()
    assert "environment map of 16 texels along an edge" in said[1] and "1 mirror baked, 3 environment maps" in said[-1]
    picture = tmp_path / "picture.png"
    tokens = ["render", str(out), str(picture), "--res", "64x36", "--method", "layered_environment", *sizes]
    assert cli.main(tokens) == 0 and picture.stat().st_size > 0
