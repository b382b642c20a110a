"""Material networks, textures, lights and named mirrors."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, UsdGeom, UsdLux, UsdShade

from warp_reflect.images import write_exr, write_png
from warp_reflect.stage.lights import latlong
from warp_reflect.stage.read import read_stage
from warp_reflect.stage.textures import unpacked

TYPES = Sdf.ValueTypeNames


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def texts(data):
    return [f"{note.path}: {note.text}" for note in data.notes]


def node(stage, path, identifier, **inputs):
    """A shader; an input is (type, value) or (type, source shader, its output)."""
    shader = UsdShade.Shader.Define(stage, path)
    shader.CreateIdAttr(identifier)
    for name, (kind, value, *output) in inputs.items():
        made = shader.CreateInput(name.replace("__", ":"), kind)
        if output:
            made.ConnectToSource(value.CreateOutput(output[0], kind))
        else:
            made.Set(value)
    return shader


def textured_quad(stage, tmp_path, **texture_inputs):
    """A quad with st, and a material whose roughness and colour come from one picture."""
    write_png(tmp_path / "map.png", np.full((2, 2, 3), 0.5, np.float32))
    mesh = samples.add_quad(stage, "/Quad")
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", TYPES.TexCoord2fArray, "faceVarying")
    st.Set([Gf.Vec2f(0, 0), Gf.Vec2f(1, 0), Gf.Vec2f(1, 1), Gf.Vec2f(0, 1)])
    material = samples.add_material(stage, "/M")
    reader = node(stage, "/M/st", "UsdPrimvarReader_float2", varname=(TYPES.Token, "st"))
    move = node(
        stage,
        "/M/move",
        "UsdTransform2d",
        **{"in": (TYPES.Float2, reader, "result")},
        scale=(TYPES.Float2, Gf.Vec2f(2, 3)),
        rotation=(TYPES.Float, 90.0),
        translation=(TYPES.Float2, Gf.Vec2f(0.25, 0.5)),
    )
    texture = node(
        stage,
        "/M/map",
        "UsdUVTexture",
        file=(TYPES.Asset, "./map.png"),
        st=(TYPES.Float2, move, "result"),
        wrapS=(TYPES.Token, "repeat"),
        wrapT=(TYPES.Token, "mirror"),
        fallback=(TYPES.Float4, Gf.Vec4f(0.1, 0.2, 0.3, 1)),
        **texture_inputs,
    )
    surface = UsdShade.Shader(stage.GetPrimAtPath("/M/Surface"))
    surface.CreateInput("diffuseColor", TYPES.Color3f).ConnectToSource(texture.CreateOutput("rgb", TYPES.Float3))
    surface.CreateInput("roughness", TYPES.Float).ConnectToSource(texture.CreateOutput("g", TYPES.Float))
    samples.bind(mesh, material)
    return texture


def test_texture_is_described_whole(stage, tmp_path):
    textured_quad(
        stage,
        tmp_path,
        scale=(TYPES.Float4, Gf.Vec4f(2, 2, 2, 1)),
        bias=(TYPES.Float4, Gf.Vec4f(-1, -1, -1, 0)),
        sourceColorSpace=(TYPES.Token, "sRGB"),
    )
    data = read_stage(samples.saved(stage))
    (material,) = data.materials
    color, roughness = material.textures["base_color"], material.textures["roughness"]
    assert color.file == str(tmp_path / "map.png") and (color.channel, color.color_space) == ("rgb", "sRGB")
    # A data map is raw whatever its tag says.
    assert (roughness.channel, roughness.color_space) == ("g", "raw")
    assert color.wrap == ("repeat", "mirror") and color.uv_name == "st"
    assert color.scale == (2, 2, 2, 1) and color.bias == (-1, -1, -1, 0)
    np.testing.assert_allclose(color.uv_from_st, [[0, -3, 0.25], [2, 0, 0.5]], atol=1e-15)
    assert material.base_color == pytest.approx((0.1, 0.2, 0.3)) and material.roughness == pytest.approx(0.2)
    mesh = data.meshes[0]
    np.testing.assert_array_equal(mesh.uvs[mesh.uv_index][:, :, :2], mesh.points[mesh.triangles][:, :, :2] / 2 + 0.5)


def test_missing_and_udim_textures_fall_back(stage, tmp_path):
    texture = textured_quad(stage, tmp_path)
    texture.GetInput("file").Set("./nowhere.png")
    data = read_stage(samples.saved(stage))
    assert not data.materials[0].textures and data.materials[0].base_color == pytest.approx((0.1, 0.2, 0.3))
    assert any("/M/map: inputs:file: @./nowhere.png@: no such file" in text for text in texts(data))
    texture.GetInput("file").Set("./map.<UDIM>.png")
    assert any("UDIM" in text for text in texts(read_stage(samples.saved(stage))))


def test_backslashes_in_a_texture_path_are_understood(stage, tmp_path):
    texture = textured_quad(stage, tmp_path)
    (tmp_path / "maps").mkdir()
    (tmp_path / "map.png").rename(tmp_path / "maps" / "map.png")
    texture.GetInput("file").Set("maps\\map.png")
    (material,) = read_stage(samples.saved(stage)).materials
    assert material.textures["base_color"].file == str(tmp_path / "maps" / "map.png")


def test_packed_texture_can_be_unpacked(stage, tmp_path):
    from pxr import UsdUtils

    textured_quad(stage, tmp_path)
    package = str(tmp_path / "all.usdz")
    assert UsdUtils.CreateNewUsdzPackage(samples.saved(stage), package)
    (material,) = read_stage(package).materials
    file = material.textures["base_color"].file
    assert file.startswith(package + "[")
    copy = unpacked(file, tmp_path)
    assert copy.read_bytes() == (tmp_path / "map.png").read_bytes()
    with pytest.raises(ValueError, match=r"all\.usdz"):
        unpacked(f"{package}[nothing.png]", tmp_path)


@pytest.mark.parametrize("other", ["UVMap", "map1"])
def test_only_uv_primvar_is_taken_whatever_its_name(stage, tmp_path, other):
    textured_quad(stage, tmp_path)
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/Quad"))
    mesh.GetPrim().RemoveProperty("primvars:st")
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(other, TYPES.Float2Array, "vertex")
    uv.Set([Gf.Vec2f(0, 0)] * 4)
    data = read_stage(samples.saved(stage))
    assert data.meshes[0].uvs is not None
    assert any(f"primvars:st: no such primvar; {other}" in text for text in texts(data))


def test_color_primvar_reader_uses_the_primvar(stage):
    material = samples.add_material(stage, "/M", metallic=1.0)
    reader = node(
        stage,
        "/M/reader",
        "UsdPrimvarReader_float3",
        varname=(TYPES.String, "paint"),
        fallback=(TYPES.Float3, Gf.Vec3f(0.5, 0.25, 0)),
    )
    surface = UsdShade.Shader(stage.GetPrimAtPath("/M/Surface"))
    surface.CreateInput("diffuseColor", TYPES.Color3f).ConnectToSource(reader.CreateOutput("result", TYPES.Float3))
    for name, interpolation, values in (
        ("Varying", "vertex", [Gf.Vec3f(k, 0, 0) for k in range(4)]),
        ("Constant", "constant", [Gf.Vec3f(0, 1, 0)]),
        ("Without", "", []),
    ):
        mesh = samples.add_quad(stage, f"/{name}")
        samples.bind(mesh, material)
        if interpolation:
            UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("paint", TYPES.Color3fArray, interpolation).Set(values)
    data = read_stage(samples.saved(stage))
    by_path = {i.prim_path: (data.meshes[i.mesh], data.materials[i.materials[0]]) for i in data.instances}
    mesh, got = by_path["/Varying"]
    assert got.uses_vertex_color and mesh.colors[mesh.color_index].max() == 3.0
    assert by_path["/Constant"][1].base_color == (0, 1, 0) and not by_path["/Constant"][1].uses_vertex_color
    assert by_path["/Without"][1].base_color == (0.5, 0.25, 0)
    assert all(m.metallic == 1.0 for _, m in by_path.values())


@pytest.mark.parametrize(
    ("identifier", "inputs", "expected"),
    [
        (
            "ND_standard_surface_surfaceshader",
            {
                "base": (TYPES.Float, 0.5),
                "base_color": (TYPES.Color3f, Gf.Vec3f(1, 0.5, 0)),
                "metalness": (TYPES.Float, 1.0),
                "specular_roughness": (TYPES.Float, 0.125),
                "coat": (TYPES.Float, 0.25),
                "emission": (TYPES.Float, 2.0),
            },
            {
                "base_color": (0.5, 0.25, 0),
                "metallic": 1.0,
                "roughness": 0.125,
                "clearcoat": 0.25,
                "emissive": (2, 2, 2),
            },
        ),
        (
            "ND_standard_surface_surfaceshader",
            {},
            {"base_color": (0.8, 0.8, 0.8), "roughness": 0.2, "emissive": (0, 0, 0)},
        ),
        (
            "ND_open_pbr_surface_surfaceshader",
            {"base_metalness": (TYPES.Float, 1.0), "specular_roughness": (TYPES.Float, 0.0)},
            {"metallic": 1.0, "roughness": 0.0, "base_color": (0.8, 0.8, 0.8), "ior": 1.5},
        ),
        (
            "ND_UsdPreviewSurface_surfaceshader",
            {"roughness": (TYPES.Float, 0.25), "ior": (TYPES.Float, 2.0)},
            {"roughness": 0.25, "ior": 2.0, "base_color": (0.18, 0.18, 0.18)},
        ),
    ],
)
def test_materialx_surfaces_map_to_the_same_parameters(stage, identifier, inputs, expected):
    material = UsdShade.Material.Define(stage, "/M")
    shader = node(stage, "/M/S", identifier, **inputs)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(shader.CreateOutput("out", TYPES.Token))
    samples.bind(samples.add_quad(stage, "/Quad"), material)
    got = read_stage(samples.saved(stage)).materials[0]
    assert {name: pytest.approx(getattr(got, name)) for name in expected} == expected


def test_values_out_of_range_or_not_finite_are_told(stage):
    material = samples.add_material(stage, "/M", roughness=float("nan"), metallic=3.0)
    samples.bind(samples.add_quad(stage, "/Quad"), material)
    data = read_stage(samples.saved(stage))
    assert data.materials[0].roughness == 0.5 and data.materials[0].metallic == 1.0
    assert any("inputs:roughness: got nan, expected 1 finite" in text for text in texts(data))
    assert any("inputs:metallic: got 3.0" in text for text in texts(data))


def test_what_is_not_simulated_is_noted(stage):
    material = samples.add_material(stage, "/M", displacement=0.5)
    samples.bind(samples.add_quad(stage, "/Quad"), material)
    assert any("/M: inputs:displacement is not used" in text for text in texts(read_stage(samples.saved(stage))))


def test_shape_lights_carry_their_radiance(stage):
    rect = UsdLux.RectLight.Define(stage, "/Rect")
    rect.CreateIntensityAttr(12.0)
    rect.CreateWidthAttr(2.0)
    rect.CreateHeightAttr(3.0)
    rect.CreateNormalizeAttr(True)
    rect.AddScaleOp().Set(Gf.Vec3f(2, 1, 7))
    ball = UsdLux.SphereLight.Define(stage, "/Ball")
    ball.CreateRadiusAttr(2.0)
    ball.CreateNormalizeAttr(True)
    tube = UsdLux.CylinderLight.Define(stage, "/Tube")
    tube.CreateLengthAttr(5.0)
    data = read_stage(samples.saved(stage))
    by_path = {light.path: light for light in data.lights}
    assert by_path["/Rect"].kind == "rect" and by_path["/Rect"].size == (2.0, 3.0)
    assert by_path["/Rect"].color[0] == pytest.approx(12.0 / (2.0 * 3.0 * 2.0))
    assert by_path["/Ball"].color[0] == pytest.approx(1.0 / (4.0 * np.pi * 4.0))
    assert by_path["/Tube"].size == (5.0, 0.5) and by_path["/Tube"].color[0] == 1.0
    assert "/__default dome" not in by_path  # these light the picture
    assert not any("light" in text for text in texts(data))


def test_dome_texture_is_read_and_turned_to_its_pole(tmp_path):
    picture = np.linspace(0.0, 2.0, 4 * 8 * 3, dtype=np.float32).reshape(4, 8, 3)
    write_exr(tmp_path / "sky.exr", {"RGB": picture}, half=())
    stage = samples.new_stage(tmp_path / "stage.usda", up_axis="Z")
    dome = UsdLux.DomeLight_1.Define(stage, "/Dome")
    dome.CreateTextureFileAttr("./sky.exr")
    UsdLux.DomeLight.Define(stage, "/Missing").CreateTextureFileAttr("./nowhere.exr")
    data = read_stage(samples.saved(stage))
    by_path = {light.path: light for light in data.lights}
    np.testing.assert_array_equal(by_path["/Dome"].texture, picture)
    # The pole axis "scene" of a Z-up stage: the light's +Y, the map's upper end, is the world's +Z.
    np.testing.assert_allclose(by_path["/Dome"].world_from_light[:3, :3] @ [0, 1, 0], [0, 0, 1])
    assert by_path["/Missing"].texture is None
    assert any("nowhere.exr@: no such file" in text for text in texts(data))


def latlong_directions(height):
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    lon = np.pi * (1.0 - (np.arange(2 * height) + 0.5) / height)[None, :]
    return np.stack([np.cos(lat) * np.sin(lon), np.sin(lat) + 0.0 * lon, np.cos(lat) * np.cos(lon)], axis=2)


@pytest.mark.parametrize("layout", ["mirroredBall", "angular", "cubeMapVerticalCross"])
def test_dome_layouts_agree_with_the_function_they_picture(layout):
    """Each picture is made from a smooth function of direction by the layout's forward definition."""

    def radiance(d):
        return (1.5 + d @ np.array([[0.5, 0.1, 0.3], [0.2, -0.6, 0.1], [0.3, 0.2, 0.7]])).astype(np.float32)

    n = 240
    if layout == "cubeMapVerticalCross":
        row, column = np.mgrid[0 : 4 * n // 2, 0 : 3 * n // 2] + 0.5
        cell_x, cell_y = (column // (n // 2)).astype(int), (row // (n // 2)).astype(int)
        u, v = 2 * (column / (n // 2) - cell_x) - 1, 1 - 2 * (row / (n // 2) - cell_y)
        one = np.ones_like(u)
        faces = {
            (1, 1): (-u, v, one),
            (0, 1): (one, v, u),
            (2, 1): (-one, v, -u),
            (1, 0): (-u, one, -v),
            (1, 2): (-u, -one, v),
            (1, 3): (-u, -v, -one),
        }
        direction = np.zeros((*u.shape, 3))
        for (x, y), axes in faces.items():
            where = (cell_x == x) & (cell_y == y)
            direction[where] = np.stack(axes, axis=2)[where]
    else:
        y, x = np.mgrid[0:n, 0:n] + 0.5
        u, v = 2 * x / n - 1, 1 - 2 * y / n
        r = np.minimum(np.hypot(u, v), 1.0)
        if layout == "angular":
            angle = np.pi * r
            side = np.sin(angle) / np.maximum(np.hypot(u, v), 1e-9)
            direction = np.stack([-u * side, v * side, np.cos(angle)], axis=2)
        else:
            normal = np.stack([u, v, np.sqrt(np.maximum(1 - r**2, 0.0))], axis=2)
            direction = 2 * normal[..., 2:] * normal - [0, 0, 1]
    direction /= np.maximum(np.linalg.norm(direction, axis=2, keepdims=True), 1e-9)
    result = latlong(radiance(direction), layout)
    wanted = radiance(latlong_directions(len(result)))
    # The rim of a ball or disc holds the whole rear: there a pixel spans tens of degrees.
    front = latlong_directions(len(result))[..., 2] > -0.9
    assert np.abs(result - wanted)[front].max() < 0.05
