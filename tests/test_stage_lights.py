"""Lights: where a dome's texels are seen, how strong lights are, what is told of their pictures."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, UsdGeom, UsdLux

from warp_reflect.frame import render_frame
from warp_reflect.images import write_exr
from warp_reflect.planner import make_plan
from warp_reflect.stage.lights import world_area
from warp_reflect.stage.load import load_stage
from warp_reflect.stage.read import read_stage

BRIGHT = (30.0, 20.0, 10.0)
X, Y, Z = np.eye(3)


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def texts(data):
    return [f"{note.path}: {note.text}" for note in data.notes]


def by_path(data):
    return {light.path: light for light in data.lights}


def sky(tmp_path, size, texel, name="sky.exr"):
    """A black picture with one bright texel, (column, row) from the top left."""
    picture = np.zeros((size[1], size[0], 3), np.float32)
    picture[texel[1], texel[0]] = BRIGHT
    write_exr(tmp_path / name, {"RGB": picture}, half=())
    return f"./{name}"


def brightest_direction(light):
    """World direction of the mean radiance of a dome, by OpenEXR's definition of a latlong map."""
    weight = light.texture.sum(axis=2).astype(np.float64)
    rows, columns = weight.shape
    latitude = np.pi / 2 - np.pi * (np.arange(rows)[:, None] + 0.5) / rows
    longitude = np.pi - 2 * np.pi * (np.arange(columns)[None, :] + 0.5) / columns
    ones = np.ones_like(weight)
    local = np.stack(
        [np.sin(longitude) * np.cos(latitude), np.sin(latitude) * ones, np.cos(longitude) * np.cos(latitude)]
    )
    mean = (local * weight * np.cos(latitude)).sum(axis=(1, 2))
    world = light.world_from_light[:3, :3] @ mean
    return world / np.linalg.norm(world)


def unit(*direction):
    return np.array(direction) / np.linalg.norm(direction)


# 33 by 33 pixels: the middle of the middle texel is the middle of the picture; (24, 8) is at u = v = 16 / 33.
U = 16.0 / 33.0
BALL_N = np.array([U, U, np.sqrt(1 - 2 * U * U)])  # the ball's normal there; the eye looks from +Z
ANGLE = np.pi * np.hypot(U, U)
TEXELS = {
    "latlong middle": ("latlong", (65, 33), (32, 16), Z),
    "latlong left": ("latlong", (64, 32), (15, 15), unit(np.cos(np.pi / 64), np.tan(np.pi / 64), -np.sin(np.pi / 64))),
    "latlong top": ("latlong", (65, 65), (32, 0), unit(0.0, np.cos(np.pi / 130), np.sin(np.pi / 130))),
    "ball middle": ("mirroredBall", (33, 33), (16, 16), Z),
    "ball": ("mirroredBall", (33, 33), (24, 8), 2 * BALL_N[2] * BALL_N - Z),
    "angular middle": ("angular", (33, 33), (16, 16), Z),
    "angular": ("angular", (33, 33), (24, 8), unit(-np.sin(ANGLE), np.sin(ANGLE), np.sqrt(2) * np.cos(ANGLE))),
    "cross front": ("cubeMapVerticalCross", (99, 132), (49, 49), Z),
    "cross left": ("cubeMapVerticalCross", (99, 132), (16, 49), X),
    "cross right": ("cubeMapVerticalCross", (99, 132), (82, 49), -X),
    "cross top": ("cubeMapVerticalCross", (99, 132), (49, 16), Y),
    "cross below": ("cubeMapVerticalCross", (99, 132), (49, 82), -Y),
    "cross bottom": ("cubeMapVerticalCross", (99, 132), (49, 115), -Z),
    # 8 of 33 texels right of and above the middle of a face.
    "cross corner": ("cubeMapVerticalCross", (99, 132), (57, 41), unit(-16 / 33, 16 / 33, 1)),
    "cross ceiling": ("cubeMapVerticalCross", (99, 132), (57, 8), unit(-16 / 33, 1, -16 / 33)),
    "cross rear": ("cubeMapVerticalCross", (99, 132), (57, 107), unit(-16 / 33, -16 / 33, -1)),
}


@pytest.mark.parametrize("name", TEXELS)
def test_a_bright_texel_is_where_its_layout_puts_it(stage, tmp_path, name):
    layout, size, texel, expected = TEXELS[name]
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.CreateTextureFileAttr(sky(tmp_path, size, texel))
    dome.CreateTextureFormatAttr(layout)
    data = read_stage(samples.saved(stage))
    angle = np.degrees(np.arccos(np.clip(brightest_direction(data.lights[0]) @ expected, -1, 1)))
    # The resampled map is about as fine as the picture: a third of one of its texels, 5.6 degrees.
    assert angle < 2.0
    assert not any("texture" in text for text in texts(data))


@pytest.mark.parametrize(
    ("size", "texel", "layout", "expected"),
    [
        ((64, 32), (15, 15), "latlong", X),
        ((99, 132), (16, 49), "cubeMapVerticalCross", X),
        ((33, 33), (20, 16), "angular", unit(-np.sin(np.pi * 8 / 33), 0, np.cos(np.pi * 8 / 33))),
        ((50, 32), (12, 15), "latlong", X),
    ],
)
def test_automatic_goes_by_the_shape_of_the_picture(stage, tmp_path, size, texel, layout, expected):
    UsdLux.DomeLight.Define(stage, "/Dome").CreateTextureFileAttr(sky(tmp_path, size, texel))
    data = read_stage(samples.saved(stage))
    assert brightest_direction(data.lights[0]) @ expected > np.cos(np.radians(8))
    guessed = [text for text in texts(data) if "texture:format: automatic" in text]
    assert len(guessed) == (size != (64, 32)) and all(text.endswith(f"taken as {layout}") for text in guessed)


def test_an_unknown_layout_is_told(stage, tmp_path):
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.CreateTextureFileAttr(sky(tmp_path, (64, 32), (15, 15)))
    dome.CreateTextureFormatAttr("octahedral")
    path = samples.saved(stage)
    assert any("/Dome: inputs:texture:format: got 'octahedral'" in text for text in texts(read_stage(path)))
    with pytest.raises(ValueError, match="</Dome>: inputs:texture:format"):
        read_stage(path, strict=True)


# Where the map's upper end and its middle point, by pole axis and the stage's up axis (UsdLuxDomeLight_1).
POLES = {
    ("DomeLight", None, "Y"): (Y, Z),
    ("DomeLight", None, "Z"): (Y, Z),
    ("DomeLight_1", None, "Y"): (Y, Z),
    ("DomeLight_1", None, "Z"): (Z, -Y),
    ("DomeLight_1", "scene", "Z"): (Z, -Y),
    ("DomeLight_1", "Y", "Z"): (Y, Z),
    ("DomeLight_1", "Z", "Y"): (Z, -Y),
}


@pytest.mark.parametrize(("kind", "pole", "up"), POLES)
def test_the_pole_follows_the_convention_of_its_schema(tmp_path, kind, pole, up):
    stage = samples.new_stage(tmp_path / "stage.usda", up_axis=up)
    for name, texel in (("Top", (32, 0)), ("Middle", (32, 16))):
        dome = getattr(UsdLux, kind).Define(stage, f"/{name}")
        dome.CreateTextureFileAttr(sky(tmp_path, (65, 33), texel, f"{name}.exr"))
        if pole:
            dome.CreatePoleAxisAttr(pole)
    found = by_path(read_stage(samples.saved(stage)))
    top, middle = POLES[kind, pole, up]
    assert brightest_direction(found["/Top"]) @ top > np.cos(np.radians(5))
    np.testing.assert_allclose(brightest_direction(found["/Middle"]), middle, atol=1e-6)


def test_a_turned_dome_turns_its_texels(tmp_path):
    """orientToStageUpAxis, which exporters write for the older schema, and a turn about the vertical below it."""
    stage = samples.new_stage(tmp_path / "stage.usda", up_axis="Z")
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.OrientToStageUpAxis()
    dome.CreateTextureFileAttr(sky(tmp_path, (65, 33), (32, 16)))
    parent = UsdGeom.Xform.Define(stage, "/Turn")
    parent.AddRotateZOp().Set(90.0)
    other = UsdLux.DomeLight.Define(stage, "/Turn/Dome")
    other.OrientToStageUpAxis()
    other.CreateTextureFileAttr("./sky.exr")
    found = by_path(read_stage(samples.saved(stage)))
    np.testing.assert_allclose(brightest_direction(found["/Dome"]), -Y, atol=1e-6)
    np.testing.assert_allclose(brightest_direction(found["/Turn/Dome"]), X, atol=1e-6)


def test_the_background_shows_the_texel_at_its_pixel(stage, tmp_path):
    """The whole way: a camera that looks along -Z with +X on its right sees the texel of -Z + X / 2 on its right."""
    size = (256, 128)
    longitude = np.arctan2(0.5, -1.0)
    texel = int((np.pi - longitude) / (2 * np.pi) * size[0]), size[1] // 2
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.CreateTextureFileAttr(sky(tmp_path, size, texel))
    dome.CreateExposureAttr(1.0)
    dome.CreateIntensityAttr(0.25)
    dome.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 1.0))
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.CreateHorizontalApertureAttr(20.0)
    camera.CreateVerticalApertureAttr(20.0)
    camera.CreateFocalLengthAttr(10.0)  # 90 degrees across: -Z + X / 2 is at three quarters of the width
    scene = load_stage(samples.saved(stage))
    frame = render_frame(scene, make_plan(scene, size=(101, 101)))
    color = np.stack([frame[name] for name in "RGB"], axis=2).reshape(101, 101, 3)
    row, column, _ = np.unravel_index(np.argmax(color), color.shape)
    assert abs(column + 0.5 - 0.75 * 101) < 2.0 and abs(row + 0.5 - 50.5) < 2.0
    # intensity 1/4, exposure 1: half the texel, green halved once more; interpolation takes some of it.
    peak = color[row, column]
    np.testing.assert_allclose(peak / peak[0], [1.0, 1.0 / 3.0, 1.0 / 3.0], rtol=1e-5)
    assert 0.4 * BRIGHT[0] * 0.5 < peak[0] <= BRIGHT[0] * 0.5 * 1.0001


BAD_PICTURES = {
    "missing": (None, "no such file"),
    "empty": (b"", ""),
    "text": (b"not a picture at all", ""),
    "cut": ("cut", ""),
}


@pytest.mark.parametrize("name", BAD_PICTURES)
def test_a_picture_that_cannot_be_used_is_one_note(stage, tmp_path, name):
    content, message = BAD_PICTURES[name]
    if content == "cut":
        noise = np.random.default_rng(1).random((64, 128, 3), np.float32)
        write_exr(tmp_path / "bad.exr", {"RGB": noise}, half=())
        content = (tmp_path / "bad.exr").read_bytes()
        content = content[: len(content) // 2]
    if content is not None:
        (tmp_path / "bad.exr").write_bytes(content)
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.CreateTextureFileAttr("./bad.exr")
    dome.CreateIntensityAttr(2.0)
    data = read_stage(samples.saved(stage))
    (told,) = [text for text in texts(data) if "inputs:texture:file" in text]
    assert told.startswith("/Dome: ") and "bad.exr" in told and message in told and "\n" not in told
    assert data.lights[0].texture is None and data.lights[0].color == (2.0, 2.0, 2.0)


def test_values_of_a_picture_that_are_no_radiance_are_cleaned(stage, tmp_path):
    picture = np.ones((8, 16, 3), np.float32)
    picture[0, 0] = [np.nan, -1.0, np.inf]
    write_exr(tmp_path / "sky.exr", {"RGB": picture}, half=())
    UsdLux.DomeLight.Define(stage, "/Dome").CreateTextureFileAttr("./sky.exr")
    data = read_stage(samples.saved(stage))
    assert (data.lights[0].texture >= 0.0).all() and np.isfinite(data.lights[0].texture).all()


def test_strength_is_color_times_intensity_times_exposure(stage):
    for name, light in (("Dome", UsdLux.DomeLight), ("Rect", UsdLux.RectLight), ("Ball", UsdLux.SphereLight)):
        made = light.Define(stage, f"/{name}")
        made.CreateColorAttr(Gf.Vec3f(1.0, 0.5, 0.25))
        made.CreateIntensityAttr(3.0)
        made.CreateExposureAttr(-2.0)
    for light in read_stage(samples.saved(stage)).lights:
        assert light.color == pytest.approx((0.75, 0.375, 0.1875))


@pytest.mark.parametrize(("kelvin", "redder"), [(2000, True), (3000, True), (10000, False)])
def test_color_temperature_tints_and_keeps_the_luminance(stage, kelvin, redder):
    light = UsdLux.DomeLight.Define(stage, "/Dome")
    light.CreateColorTemperatureAttr(kelvin)
    off = read_stage(samples.saved(stage)).lights[0].color
    light.CreateEnableColorTemperatureAttr(True)
    on = np.array(read_stage(samples.saved(stage)).lights[0].color)
    assert off == (1.0, 1.0, 1.0)
    assert (on[0] > on[2]) == redder and on @ [0.2126, 0.7152, 0.0722] == pytest.approx(1.0, abs=0.01)


def test_daylight_is_white(stage):
    light = UsdLux.DomeLight.Define(stage, "/Dome")
    light.CreateEnableColorTemperatureAttr(True)
    light.CreateColorTemperatureAttr(6500.0)
    np.testing.assert_allclose(read_stage(samples.saved(stage)).lights[0].color, 1.0, atol=0.05)


def sampled_area(point, count=400):
    """Area of a parametric surface over the unit square by its facets."""
    u, v = np.meshgrid(np.linspace(0, 1, count), np.linspace(0, 1, count))
    p = np.stack(point(u, v), axis=2)
    a, b, c, d = p[:-1, :-1], p[:-1, 1:], p[1:, 1:], p[1:, :-1]
    return 0.5 * np.linalg.norm(np.cross(c - a, d - b), axis=2).sum()


@pytest.mark.parametrize("scale", [(1, 1, 1), (2, 1, 1), (3, 0.5, 1.5), (1, 4, 0.25)])
def test_normalized_lights_divide_by_their_world_area(scale):
    x, y, z = scale
    world = np.diag([x, y, z, 1.0])
    ball = sampled_area(
        lambda u, v: (
            2 * x * np.sin(np.pi * v) * np.cos(2 * np.pi * u),
            2 * y * np.sin(np.pi * v) * np.sin(2 * np.pi * u),
            2 * z * np.cos(np.pi * v),
        )
    )
    tube = sampled_area(lambda u, v: (3 * x * v, 0.5 * y * np.cos(2 * np.pi * u), 0.5 * z * np.sin(2 * np.pi * u)))
    assert world_area("sphere", (2.0,), world) == pytest.approx(ball, rel=0.0115)
    assert world_area("cylinder", (3.0, 0.5), world) == pytest.approx(tube, rel=0.003)
    assert world_area("rect", (2.0, 3.0), world) == pytest.approx(6.0 * x * y)
    assert world_area("disk", (2.0,), world) == pytest.approx(4.0 * np.pi * x * y)


def test_what_is_not_simulated_of_lights_is_told_once(stage):
    light = UsdLux.SphereLight.Define(stage, "/Ball")
    light.CreateSpecularAttr(0.5)
    light.CreateDiffuseAttr(1.0)
    light.CreateTreatAsPointAttr(True)
    UsdLux.ShapingAPI.Apply(light.GetPrim()).CreateShapingConeAngleAttr(30.0)
    samples.add_quad(stage, "/Quad")
    UsdLux.LightAPI(light.GetPrim()).GetLightLinkCollectionAPI().ExcludePath("/Quad")
    UsdLux.PortalLight.Define(stage, "/Portal")
    found = [text for text in texts(read_stage(samples.saved(stage))) if text.startswith(("/Ball", "/Portal"))]
    assert len(found) == 5
    for told in ("inputs:specular", "treatAsPoint", "shaping:cone:angle", "light linking", "PortalLight"):
        assert sum(told in text for text in found) == 1


def mesh_light(stage, path, mode, **values):
    quad = samples.add_quad(stage, path)
    light = UsdLux.MeshLightAPI.Apply(quad.GetPrim())
    quad.GetPrim().CreateAttribute("light:materialSyncMode", Sdf.ValueTypeNames.Token, False).Set(mode)
    api = UsdLux.LightAPI(light.GetPrim())
    api.CreateIntensityAttr(values.get("intensity", 8.0))
    api.CreateNormalizeAttr(values.get("normalize", False))
    return quad


def test_mesh_lights_glow_as_their_mode_says(stage):
    lamp = samples.add_material(stage, "/Lamp", emissiveColor=(1.0, 2.0, 3.0), diffuseColor=(0.5, 0.5, 0.5))
    for name, mode in (("Alone", "noMaterialResponse"), ("Tint", "materialGlowTintsLight"), ("Own", "independent")):
        samples.bind(mesh_light(stage, f"/{name}", mode), lamp)
    mesh_light(stage, "/Even", "noMaterialResponse", normalize=True).AddScaleOp().Set(Gf.Vec3f(2, 1, 1))
    data = read_stage(samples.saved(stage))
    found = {i.prim_path: data.materials[i.materials[0]] for i in data.instances}
    assert found["/Alone"].emissive == (8.0, 8.0, 8.0) and found["/Alone"].base_color == (0.0, 0.0, 0.0)
    assert found["/Tint"].emissive == found["/Own"].emissive == (1.0, 2.0, 3.0)
    assert found["/Even"].emissive == pytest.approx((1.0, 1.0, 1.0))  # 8 over an area of 8


def test_a_glowing_mesh_shows_its_radiance_directly_and_in_a_mirror(stage):
    """Constant radiance: a mirror of reflectance 0.9 across a closed room of one glow shows 0.9 of it anywhere."""
    room = samples.add_cube_mesh(stage, "/Room")
    room.AddScaleOp().Set(Gf.Vec3f(5, 5, 5))
    room.CreateDoubleSidedAttr(True)
    black = {"diffuseColor": (0.0, 0.0, 0.0), "roughness": 1.0, "ior": 1.0}
    samples.bind(room, samples.add_material(stage, "/Glow", emissiveColor=(2.0, 1.0, 0.5), **black))
    quad = samples.add_quad(stage, "/Quad")
    quad.AddTranslateOp().Set(Gf.Vec3d(0, 0, -2))
    UsdGeom.Camera.Define(stage, "/Camera").AddTranslateOp().Set(Gf.Vec3d(0.5, 0.5, 3))
    scene = load_stage(samples.saved(stage), reflectors="/Quad")
    frame = render_frame(scene, make_plan(scene, size=(48, 36)))
    color = np.stack([frame[name] for name in "RGB"], axis=-1).reshape(-1, 3)
    seen = frame["reflectorId"].reshape(-1) > 0
    assert 100 < seen.sum() < 1600
    np.testing.assert_allclose(color[~seen], np.broadcast_to([2.0, 1.0, 0.5], color[~seen].shape), rtol=2e-3)
    grazing = np.broadcast_to([1.8, 0.9, 0.45], color[seen].shape)  # Schlick's term adds little this near the normal
    np.testing.assert_allclose(color[seen], grazing, rtol=5e-3)
