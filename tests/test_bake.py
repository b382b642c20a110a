"""Baked reflector maps: the layer, the files, and frames rendered with them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdValidation, Vt
from stage_samples import add_mesh

import warp_reflect as wr
from warp_reflect import baked_maps, cli, images, reflector_maps
from warp_reflect.bake import bake_stage
from warp_reflect.channels import CHANNELS

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
SIZE = (120, 90)
SETTINGS = wr.Settings(map_resolution=32)
# Pixels of a mirror that show another triangle after its map was kept over a motion: those on the edges of triangles, where
# the map's rounding in float32 decides.
MOVED_MAX = 0.01


def bind_chrome(stage: Usd.Stage, prim: Usd.Prim) -> None:
    material = UsdShade.Material.Define(stage, "/World/Chrome")
    shader = UsdShade.Shader.Define(stage, "/World/Chrome/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.9))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(1.0)
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def make_stage(path: Path) -> Path:
    """A chrome ball and a chrome egg over coloured boxes, metres, +Z up."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(1)
    stage.SetEndTimeCode(5)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    ball = UsdGeom.Sphere.Define(stage, "/World/Ball")
    ball.CreateRadiusAttr(1.0)
    ball.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    ball.AddTranslateOp().Set(Gf.Vec3d(-1.2, 0, 0))
    bind_chrome(stage, ball.GetPrim())
    egg = UsdGeom.Sphere.Define(stage, "/World/Egg")
    egg.CreateRadiusAttr(1.0)
    egg.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    egg.AddTranslateOp().Set(Gf.Vec3d(1.3, 0, 0))
    egg.AddRotateXYZOp().Set(Gf.Vec3f(0, 0, 25))
    egg.AddScaleOp().Set(Gf.Vec3f(1.0, 0.6, 1.4))
    bind_chrome(stage, egg.GetPrim())
    for k in range(9):
        angle = 2.0 * np.pi * k / 9
        box = UsdGeom.Cube.Define(stage, f"/World/Box{k}")
        box.CreateSizeAttr(0.6 + 0.1 * (k % 3))
        box.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
        box.AddTranslateOp().Set(Gf.Vec3d(4 * np.cos(angle), 4 * np.sin(angle), 0.7 * (k % 4) - 1))
        box.CreateDisplayColorAttr([(0.2 + 0.08 * k, 0.8 - 0.07 * k, 0.3)])
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(24.0)
    camera.CreateHorizontalApertureAttr(24.0)
    camera.CreateVerticalApertureAttr(18.0)
    camera.AddTranslateOp().Set(Gf.Vec3d(0, -7, 0.5))
    camera.AddRotateXYZOp().Set(Gf.Vec3f(88, 0, 0))
    stage.GetRootLayer().Save()
    return path


def framed(path: Path, time: float | None = None, **options) -> wr.Frame:
    scene = wr.load_stage(str(path), time=time, **options)
    return wr.render_frame(scene, wr.make_plan(scene, size=SIZE, settings=SETTINGS, method="reflector_map"))


def baked(path: Path, out: Path, **options):
    return bake_stage(wr.load_stage(str(path), **options), out, SETTINGS)


def assert_same_frame(frame: wr.Frame, expected: wr.Frame) -> None:
    for channel in CHANNELS:
        np.testing.assert_array_equal(frame[channel], expected[channel], err_msg=channel)


def forbid(monkeypatch) -> None:
    """Make any drawing of a map a failure from here on."""
    monkeypatch.setattr(reflector_maps.ReflectorMap, "from_mesh", lambda *_, **__: pytest.fail("a map was drawn"))
    monkeypatch.setattr(reflector_maps.ReflectorMap, "from_sheet", lambda *_, **__: pytest.fail("a map was drawn"))


def validation_errors(path: Path) -> list[str]:
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(data.name) for data in registry.GetAllValidatorMetadata()]
    stage = Usd.Stage.Open(str(path))
    return [e.GetErrorAsString() for e in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("name", ["capped_cylinder", "mesh_kettle", "far_offset"])
def test_baked_scene_renders_bit_for_bit_without_drawing(name, tmp_path, monkeypatch):
    source = SCENES / f"{name}.usda"
    expected = framed(source)
    written = baked(source, tmp_path / "out.usd")
    assert written.files and all(file.is_file() for file in written.files.values())
    forbid(monkeypatch)
    frame = framed(tmp_path / "out.usd")
    assert {row.path for row in frame.plan.rows if row.technique == "reflector_map"} == set(written.files)
    assert_same_frame(frame, expected)
    assert (frame["reflectedId"] > 0).sum() > 100
    assert frame.scene.notes == expected.scene.notes


def test_layer_opens_as_its_stage_and_is_valid(tmp_path):
    (tmp_path / "source").mkdir()
    (tmp_path / "out").mkdir()
    source = make_stage(tmp_path / "source" / "stage.usda")
    before = source.read_bytes()
    for ending in ("usd", "usda", "usdc"):
        out = tmp_path / "out" / f"baked.{ending}"
        written = baked(source, out)
        assert written.layer == out and set(written.files) == {"/World/Ball", "/World/Egg"} and not written.notes
        layer = Sdf.Layer.FindOrOpen(str(out))
        assert list(layer.subLayerPaths) == ["../source/stage.usda"]
        assert validation_errors(out) == validation_errors(source) == []
        stage = Usd.Stage.Open(str(out))
        assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (1, 5)
        assert stage.GetDefaultPrim().GetPath() == "/World"
        prim = stage.GetPrimAtPath("/World/Egg")
        assert prim.GetAttribute("warp_reflect:layout").Get() == baked_maps.LAYOUT
        assert prim.GetAttribute("warp_reflect:mapResolution").Get() == 32
        asset = prim.GetAttribute("warp_reflect:map").Get()
        assert not Path(asset.path).is_absolute() and Path(asset.resolvedPath) == written.files["/World/Egg"]
        (only,) = baked_maps.read_maps(asset.resolvedPath)
        assert list(prim.GetAttribute("warp_reflect:mapGeometry").Get()) == [only.geometry]
        (frame,) = np.array(prim.GetAttribute("warp_reflect:unitFromBody").Get())
        np.testing.assert_array_equal(frame.T, only.unit_from_body)
    assert source.read_bytes() == before
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "baked.World_Ball.exr",
        "baked.World_Egg.exr",
        "baked.usd",
        "baked.usda",
        "baked.usdc",
    ]


def test_stage_and_layer_can_be_moved_together(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    source = make_stage(tmp_path / "here" / "stage.usda")
    expected = framed(source)
    baked(source, tmp_path / "here" / "baked.usda")
    (tmp_path / "here").rename(tmp_path / "there")
    forbid(monkeypatch)
    assert_same_frame(framed(tmp_path / "there" / "baked.usda"), expected)


def test_untrusted_stage_gets_its_maps_from_the_child_process(tmp_path, monkeypatch):
    expected = framed(make_stage(tmp_path / "stage.usda"))
    baked(tmp_path / "stage.usda", tmp_path / "baked.usda")
    forbid(monkeypatch)
    monkeypatch.setattr(baked_maps, "read_maps", lambda path: pytest.fail(f"{path} was opened in this process"))
    assert_same_frame(framed(tmp_path / "baked.usda", untrusted=True), expected)


def test_other_geometry_is_drawn_anew_with_a_note_for_that_mirror(tmp_path):
    source = make_stage(tmp_path / "stage.usda")
    baked(source, tmp_path / "baked.usda")
    stage = Usd.Stage.Open(str(source))
    UsdGeom.Sphere.Get(stage, "/World/Ball").GetRadiusAttr().Set(0.8)
    stage.GetRootLayer().Save()
    expected, frame = framed(source), framed(tmp_path / "baked.usda")
    assert_same_frame(frame, expected)
    (note,) = [note for note in frame.scene.notes if "baked" in note.text]
    assert note.path == "/World/Ball" and "does not fit the geometry" in note.text
    again = wr.render_frame(frame.scene, frame.plan, previous=frame)
    assert again.scene.notes.count(note) == 1


def test_stretched_mirror_is_drawn_anew(tmp_path):
    source = make_stage(tmp_path / "stage.usda")
    baked(source, tmp_path / "baked.usda")
    stage = Usd.Stage.Open(str(source))
    stage.GetPrimAtPath("/World/Egg").GetAttribute("xformOp:scale").Set(Gf.Vec3f(1.0, 0.6, 1.3))
    stage.GetRootLayer().Save()
    expected, frame = framed(source), framed(tmp_path / "baked.usda")
    assert_same_frame(frame, expected)
    (note,) = [note for note in frame.scene.notes if "baked" in note.text]
    assert note.path == "/World/Egg" and "stretched" in note.text


def test_mirror_that_moves_keeps_its_map(tmp_path, monkeypatch):
    source = make_stage(tmp_path / "stage.usda")
    stage = Usd.Stage.Open(str(source))
    egg = stage.GetPrimAtPath("/World/Egg")
    for time, x, turn, size in ((1, 1.3, 25, 1.0), (5, 1.6, 70, 1.3)):
        egg.GetAttribute("xformOp:translate").Set(Gf.Vec3d(x, 0.2 * time, 0.1), time)
        egg.GetAttribute("xformOp:rotateXYZ").Set(Gf.Vec3f(3 * time, 0, turn), time)
        egg.GetAttribute("xformOp:scale").Set(Gf.Vec3f(size, 0.6 * size, 1.4 * size), time)
    stage.GetRootLayer().Save()
    baked(source, tmp_path / "baked.usda")
    expected = framed(source, time=5)
    forbid(monkeypatch)
    frame = framed(tmp_path / "baked.usda", time=5)
    assert not [note for note in frame.scene.notes if "baked" in note.text]
    mirror = expected["reflectorId"] > 0
    np.testing.assert_array_equal(mirror, frame["reflectorId"] > 0)
    assert np.mean(frame["reflectedId"][mirror] != expected["reflectedId"][mirror]) <= MOVED_MAX
    delta = np.linalg.norm(frame["reflectedPoint"] - expected["reflectedPoint"], axis=-1)
    assert np.mean(delta[mirror] > 1.0e-4 * expected["pathLength"][mirror]) <= MOVED_MAX
    assert mirror.sum() > 500


def test_coarser_map_than_asked_for_is_drawn_anew_and_a_finer_one_used(tmp_path, monkeypatch):
    make_stage(tmp_path / "stage.usda")
    scene = wr.load_stage(str(tmp_path / "stage.usda"))
    bake_stage(scene, tmp_path / "coarse.usda", SETTINGS.replace(map_resolution=16))
    bake_stage(scene, tmp_path / "fine.usda", SETTINGS.replace(map_resolution=48))
    frame = framed(tmp_path / "coarse.usda")
    assert_same_frame(frame, framed(tmp_path / "stage.usda"))
    assert [note.path for note in frame.scene.notes if "has 16 nodes" in note.text] == ["/World/Ball", "/World/Egg"]
    forbid(monkeypatch)
    fine = framed(tmp_path / "fine.usda")
    assert {fine.plan.prepared(row).map.resolution for row in fine.plan.rows} == {48}


@pytest.mark.parametrize("damage", ["cut", "gone", "swapped", "picture", "layout"])
def test_damaged_file_is_noted_and_its_map_drawn(damage, tmp_path):
    source = make_stage(tmp_path / "stage.usda")
    written = baked(source, tmp_path / "baked.usda")
    file = written.files["/World/Ball"]
    if damage == "cut":
        file.write_bytes(file.read_bytes()[:-200])
    elif damage == "gone":
        file.unlink()
    elif damage == "swapped":
        file.write_bytes(written.files["/World/Egg"].read_bytes())
    elif damage == "picture":
        images.write_exr(file, {"RGB": np.zeros((12, 2, 3))})
    else:
        layer = Sdf.Layer.FindOrOpen(str(tmp_path / "baked.usda"))
        layer.GetAttributeAtPath("/World/Ball.warp_reflect:layout").default = "another_1"
        layer.Save()
    frame = framed(tmp_path / "baked.usda")
    assert_same_frame(frame, framed(source))
    assert [note.path for note in frame.scene.notes if "map" in note.text] == ["/World/Ball"]


def test_file_holds_every_bit_of_several_maps(tmp_path):
    generator = np.random.default_rng(5)
    maps = []
    for k in range(3):
        texels = generator.normal(size=(6, 9, 9, 8)).astype(np.float32)
        texels[0, 0, 0] = [0.0, -0.0, 1e-38, 3e38, 1 / 3, -1e-30, 2.0, -5e-39]
        turn, _ = np.linalg.qr(generator.normal(size=(3, 3)))
        frame = np.eye(4)
        frame[:3, :3], frame[:3, 3] = turn / 7, generator.normal(size=3)
        place = generator.normal(size=(4, 4))
        maps.append(
            baked_maps.BakedMap(
                f"{k:032x}", texels, frame, np.array([1.0, 0.3, 1 / 3]), 0.1 / 3, 1.7 / 3, place, frame[0, :3]
            )
        )
    baked_maps.write_maps(tmp_path / "maps.exr", maps, {"warp_reflect:prim": "/A"})
    for found, expected in zip(baked_maps.read_maps(tmp_path / "maps.exr"), maps, strict=True):
        for each in dataclasses.fields(expected):
            a, b = getattr(found, each.name), getattr(expected, each.name)
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes(), each.name


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("texels", np.full((6, 9, 9, 8), np.nan, np.float32), "texels"),
        ("texels", np.zeros((6, 9, 8, 8), np.float32), "texels"),
        ("unit_from_body", np.diag([1.0, 2.0, 1.0, 1.0]), "unit_from_body"),
        ("unit_from_body", np.zeros((4, 4)), "unit_from_body"),
        ("extent", np.array([1.0, 0.0, 1.0]), "extent"),
        ("outer_radius", float("inf"), "radii"),
        ("world_from_object", np.full((4, 4), np.inf), "place"),
        ("origin", np.zeros(2), "place"),
    ],
)
def test_impossible_numbers_of_a_map_are_told(name, value, said):
    good = baked_maps.BakedMap(
        "", np.zeros((6, 9, 9, 8), np.float32), np.eye(4), np.ones(3), 0.5, 1.0, np.eye(4), np.zeros(3)
    )
    assert good.fault() == ""
    assert dataclasses.replace(good, **{name: value}).fault().startswith(said)


def icosphere(centre: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=3)
    return np.asarray(ball.vertices) + centre, np.asarray(ball.faces)


def test_subsets_get_maps_of_their_own(tmp_path, monkeypatch):
    source = make_stage(tmp_path / "stage.usda")
    stage = Usd.Stage.Open(str(source))
    (left, faces), (right, _) = icosphere((-1.2, 0, 3.0)), icosphere((1.2, 0, 3.0))
    points, both = np.concatenate([left, right]), np.concatenate([faces, faces + len(left)])
    mesh = add_mesh(stage, "/World/Two", points, [3] * len(both), both.reshape(-1).tolist())
    normals = np.concatenate([left - (-1.2, 0, 3.0), right - (1.2, 0, 3.0)]).astype(np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.CreateExtentAttr([(-2.2, -1, 2), (2.2, 1, 4)])
    for name, first in (("Left", 0), ("Right", len(faces))):
        indices = list(range(first, first + len(faces)))
        subset = UsdGeom.Subset.CreateGeomSubset(mesh, name, "face", Vt.IntArray(indices), "materialBind", "partition")
        bind_chrome(stage, subset.GetPrim())
    stage.GetRootLayer().Save()
    expected = framed(source)
    written = baked(source, tmp_path / "baked.usda")
    assert {"/World/Two/Left", "/World/Two/Right"} < set(written.files)
    forbid(monkeypatch)
    assert_same_frame(framed(tmp_path / "baked.usda"), expected)


def test_mirrors_in_instances_are_named_and_drawn(tmp_path):
    source = make_stage(tmp_path / "stage.usda")
    stage = Usd.Stage.Open(str(source))
    part = Usd.Stage.CreateNew(str(tmp_path / "part.usda"))
    part.SetDefaultPrim(UsdGeom.Xform.Define(part, "/World").GetPrim())
    ball = UsdGeom.Sphere.Define(part, "/World/Bead")
    ball.CreateRadiusAttr(0.4)
    bind_chrome(part, ball.GetPrim())
    part.GetRootLayer().Save()
    copy = UsdGeom.Xform.Define(stage, "/World/Copy")
    copy.AddTranslateOp().Set(Gf.Vec3d(0, 0, 2))
    copy.GetPrim().GetReferences().AddReference("./part.usda")
    copy.GetPrim().SetInstanceable(True)
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Many")
    pearl = UsdGeom.Sphere.Define(stage, "/World/Many/Pearl")
    pearl.CreateRadiusAttr(0.2)
    bind_chrome(stage, pearl.GetPrim())
    instancer.CreatePrototypesRel().AddTarget("/World/Many/Pearl")
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(0, 0, -2), (0.6, 0, -2)])
    stage.GetRootLayer().Save()
    written = baked(source, tmp_path / "baked.usda")
    assert set(written.files) == {"/World/Ball", "/World/Egg"}
    reasons = {note.path: note.text for note in written.notes}
    assert "inside an instance" in reasons["/World/Copy/Bead"]
    assert "point instancer" in reasons["/World/Many/Pearl"]
    frame = framed(tmp_path / "baked.usda")
    assert_same_frame(frame, framed(source))
    assert not [note for note in frame.scene.notes if "baked" in note.text]


def test_a_chosen_mirror_is_baked_and_stays_the_callers_choice(tmp_path, monkeypatch):
    source = make_stage(tmp_path / "stage.usda")
    stage = Usd.Stage.Open(str(source))
    matt = UsdGeom.Sphere.Define(stage, "/World/Matt")
    matt.AddTranslateOp().Set(Gf.Vec3d(0, 1, 2.5))
    stage.GetRootLayer().Save()
    expected, plain = framed(source, reflectors=("/World/Matt",)), framed(source)
    assert "/World/Matt" in baked(source, tmp_path / "baked.usda", reflectors=("/World/Matt",)).files
    forbid(monkeypatch)
    assert_same_frame(framed(tmp_path / "baked.usda", reflectors=("/World/Matt",)), expected)
    assert_same_frame(framed(tmp_path / "baked.usda"), plain)


def test_command_bakes_and_its_layer_renders(tmp_path, capsys):
    source = make_stage(tmp_path / "stage.usda")
    out = tmp_path / "baked.usd"
    assert cli.main(["bake", str(source), str(out), "--set", "map_resolution=32"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) == 3 and "/World/Ball, 32 nodes" in said[0] and "2 mirrors baked" in said[2]
    picture = tmp_path / "picture.png"
    assert cli.main(["render", str(out), str(picture), "--res", "64x48", "--set", "map_resolution=32"]) == 0
    assert picture.stat().st_size > 0
    bare = tmp_path / "bare.usda"
    stage = Usd.Stage.Open(str(source))
    for name in ("Ball", "Egg"):
        stage.RemovePrim(f"/World/{name}")
    stage.GetRootLayer().Export(str(bare))
    assert cli.main(["bake", str(bare), str(out)]) == 0
    assert "0 mirrors baked" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("tokens", "said"),
    [
        (["stage.usda", "out.png"], "cannot write a '.png' layer"),
        (["stage.usda", "nowhere/out.usd"], "does not exist"),
        (["stage.usda", "stage.usda"], "is the stage itself"),
        (["over.usda", "stage.usda"], "is a layer of"),
        (["missing.usda", "out.usd"], "no such stage"),
        (["stage.usda", "out.usd", "--set", "map_resolution=4"], "map_resolution"),
        (["stage.usda", "out.usd", "--untrusted"], "--untrusted"),
        (["stage.usda", "folder.usd"], "not a regular file"),
    ],
)
def test_impossible_bakes_are_refused_in_one_line(tokens, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    before = make_stage(tmp_path / "stage.usda").read_bytes()
    (tmp_path / "folder.usd").mkdir()
    layer = Sdf.Layer.CreateNew(str(tmp_path / "over.usda"))
    layer.subLayerPaths.append("./stage.usda")
    layer.Save()
    files = set(tmp_path.iterdir())
    assert cli.main(["bake", *tokens]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("error:") and said in error[0], error
    assert set(tmp_path.iterdir()) == files and (tmp_path / "stage.usda").read_bytes() == before


def test_bake_that_fails_part_way_keeps_and_names_what_is_finished(tmp_path, monkeypatch, capsys):
    source = make_stage(tmp_path / "stage.usda")
    whole = baked_maps.write_maps

    def full(path, maps, attributes=None):
        if "Egg" in str(path):
            raise OSError(f"{path}: cannot be written: No space left on device")
        whole(path, maps, attributes)

    monkeypatch.setattr("warp_reflect.bake.write_maps", full)
    assert cli.main(["bake", str(source), str(tmp_path / "out.usd")]) == 1
    error = capsys.readouterr().err
    assert "No space left" in error and "out.World_Ball.exr" in error
    assert not (tmp_path / "out.usd").exists()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["out.World_Ball.exr", "stage.usda"]
