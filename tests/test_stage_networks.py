"""Shading networks folded into what is looked up, against the nodes evaluated one by one in NumPy."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, UsdGeom, UsdShade

from warp_reflect.images import write_png
from warp_reflect.stage.read import read_stage

T = Sdf.ValueTypeNames
KINDS = {1: T.Float, 2: T.Float2, 3: T.Color3f, 4: T.Color4f}
GRAPH = {"float": T.Float, "vector2": T.Float2, "vector3": T.Float3, "color3": T.Color3f, "color4": T.Color4f}
TEXEL = np.array([0.3, 0.6, 0.9, 0.5])  # what the picture is taken to hold where a formula is checked


@pytest.fixture
def stage(tmp_path):
    write_png(tmp_path / "map.png", np.full((2, 2, 3), 0.5, np.float32))
    return samples.new_stage(tmp_path / "stage.usda")


def texts(data):
    return [f"{note.path}: {note.text}" for note in data.notes if "__default" not in note.path]


def shader(stage, name, identifier, **inputs):
    """A node; an input is a number, a tuple, a string, or another node's (shader, output)."""
    made = UsdShade.Shader.Define(stage, f"/M/{name}")
    made.CreateIdAttr(identifier)
    for key, value in inputs.items():
        if isinstance(value, tuple) and isinstance(value[0], UsdShade.Shader):
            source, output = value
            made.CreateInput(key, T.Color3f).ConnectToSource(source.CreateOutput(output, T.Color3f))
        elif isinstance(value, str):
            kind = {"file": T.Asset, "space": T.String}.get(key, T.String)
            made.CreateInput(key, kind).Set(value)
        elif isinstance(value, int):
            made.CreateInput(key, T.Int).Set(value)
        elif np.ndim(value) == 0:
            made.CreateInput(key, T.Float).Set(float(value))
        else:
            made.CreateInput(key, KINDS[len(value)]).Set({2: Gf.Vec2f, 3: Gf.Vec3f, 4: Gf.Vec4f}[len(value)](*value))
    return made


def picture(stage, kind="color3", **inputs):
    return shader(stage, "picture", f"ND_image_{kind}", file="./map.png", **inputs), "out"


def surface(stage, identifier="ND_standard_surface_surfaceshader", **inputs):
    """A drawn quad with coordinates whose material has the inputs."""
    material = UsdShade.Material.Define(stage, "/M")
    made = shader(stage, "S", identifier, **inputs)
    material.CreateSurfaceOutput("mtlx").ConnectToSource(made.CreateOutput("out", T.Token))
    mesh = samples.add_quad(stage, "/Quad")
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", T.TexCoord2fArray, "vertex")
    st.Set([Gf.Vec2f(x, y) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))])
    samples.bind(mesh, material)
    return material


def looked_up(texture):
    """The texture's value where its picture holds `TEXEL`."""
    chosen = ["rgba".index(letter) for letter in texture.channel]
    slots = range(3) if len(chosen) == 3 else chosen
    return TEXEL[chosen] * np.array(texture.scale)[slots] + np.array(texture.bias)[slots]


def grey_of_blue(stage, source):
    blue = shader(stage, "blue", "ND_extract_color3", index=2, **{"in": source})
    return shader(stage, "grey", "ND_convert_float_color3", **{"in": (blue, "out")})


NODES = {
    "multiply": (
        lambda s, p: shader(s, "n", "ND_multiply_color3", in1=p, in2=(0.5, 0.25, 2.0)),
        lambda t: t * [0.5, 0.25, 2],
    ),
    "multiply by a number": (lambda s, p: shader(s, "n", "ND_multiply_color3FA", in1=p, in2=0.5), lambda t: t * 0.5),
    "constant first": (
        lambda s, p: shader(s, "n", "ND_multiply_color3", in1=(0.5, 1.0, 2.0), in2=p),
        lambda t: t * [0.5, 1, 2],
    ),
    "divide": (lambda s, p: shader(s, "n", "ND_divide_color3FA", in1=p, in2=4.0), lambda t: t / 4),
    "add": (lambda s, p: shader(s, "n", "ND_add_color3", in1=p, in2=(0.1, 0.2, 0.3)), lambda t: t + [0.1, 0.2, 0.3]),
    "subtract": (lambda s, p: shader(s, "n", "ND_subtract_color3", in1=(1.0, 1.0, 1.0), in2=p), lambda t: 1 - t),
    "invert": (lambda s, p: shader(s, "n", "ND_invert_color3", **{"in": p}), lambda t: 1 - t),
    "mix": (
        lambda s, p: shader(s, "n", "ND_mix_color3", fg=p, bg=(1.0, 0.5, 0.0), mix=0.25),
        lambda t: 0.25 * t + 0.75 * np.array([1, 0.5, 0]),
    ),
    "mix by the picture": (
        lambda s, p: shader(s, "n", "ND_mix_color3", fg=(1.0, 0.5, 0.0), bg=(0.0, 0.25, 1.0), mix=p),
        lambda t: t * [1, 0.5, 0] + (1 - t) * [0, 0.25, 1],
    ),
    "remap": (
        lambda s, p: shader(s, "n", "ND_remap_color3FA", inlow=0.25, inhigh=0.75, outlow=1.0, outhigh=3.0, **{"in": p}),
        lambda t: 1 + (t - 0.25) / 0.5 * 2,
    ),
    "contrast": (
        lambda s, p: shader(s, "n", "ND_contrast_color3FA", amount=2.0, pivot=0.25, **{"in": p}),
        lambda t: 2 * t - 0.25,
    ),
    "clamp": (lambda s, p: shader(s, "n", "ND_clamp_color3", **{"in": p}), lambda t: t),
    "swizzle": (
        lambda s, p: shader(s, "n", "ND_swizzle_color3_color3", channels="bgr", **{"in": p}),
        lambda t: t[::-1],
    ),
    "grey": (
        lambda s, p: shader(s, "n", "ND_swizzle_color3_color3", channels="ggg", **{"in": p}),
        lambda t: t[[1, 1, 1]],
    ),
    "dot": (lambda s, p: shader(s, "n", "ND_dot_color3", **{"in": p}), lambda t: t),
    "two steps": (
        lambda s, p: shader(
            s, "m", "ND_multiply_color3FA", in2=3.0, in1=(shader(s, "n", "ND_add_color3FA", in1=p, in2=0.5), "out")
        ),
        lambda t: 3 * (t + 0.5),
    ),
    "tinted grey": (
        lambda s, p: shader(s, "m", "ND_multiply_color3", in1=(grey_of_blue(s, p), "out"), in2=(0.5, 0.25, 1.0)),
        lambda t: t[2] * np.array([0.5, 0.25, 1]),
    ),
}


@pytest.mark.parametrize("name", NODES)
def test_graph_of_one_picture_is_folded_into_its_scale_and_bias(stage, name):
    make, formula = NODES[name]
    surface(stage, base_color=(make(stage, picture(stage)), "out"))
    data = read_stage(samples.saved(stage))
    texture = data.materials[0].textures["base_color"]
    np.testing.assert_allclose(np.broadcast_to(looked_up(texture), 3), formula(TEXEL[:3]), atol=1e-6)
    assert texts(data) == []


def test_weight_and_colour_multiply(stage):
    surface(stage, base_color=picture(stage), base=0.5, emission_color=(1.0, 0.5, 0.25), emission=4.0)
    material = read_stage(samples.saved(stage)).materials[0]
    np.testing.assert_allclose(looked_up(material.textures["base_color"]), 0.5 * TEXEL[:3], atol=1e-7)
    assert material.emissive == (4.0, 2.0, 1.0)


@pytest.mark.parametrize(
    ("identifier", "inputs", "expected"),
    [
        ("ND_power_float", {"in1": 0.5, "in2": 3.0}, 0.125),
        ("ND_max_float", {"in1": 0.25, "in2": 0.75}, 0.75),
        ("ND_luminance_color3", {"in": (1.0, 0.0, 0.0)}, 0.2126),
        ("ND_combine3_color3", {"in1": 0.3, "in2": 0.3, "in3": 0.3}, 0.3),
        ("ND_switch_float", {"in1": 0.1, "in2": 0.9, "which": 1}, 0.9),
        ("ND_constant_float", {"value": 0.4}, 0.4),
    ],
)
def test_graph_of_constants_is_evaluated(stage, identifier, inputs, expected):
    surface(stage, specular_roughness=(shader(stage, "n", identifier, **inputs), "out"))
    data = read_stage(samples.saved(stage))
    assert data.materials[0].roughness == pytest.approx(expected) and texts(data) == []


def test_separate_outputs_name_the_channel(stage):
    node = shader(stage, "n", "ND_separate3_color3", **{"in": picture(stage)})
    surface(stage, specular_roughness=(node, "outg"), metalness=(node, "outb"))
    textures = read_stage(samples.saved(stage)).materials[0].textures
    assert (textures["roughness"].channel, textures["metallic"].channel) == ("g", "b")


def test_what_cannot_be_folded_is_told_with_its_node(stage):
    other = shader(stage, "other", "ND_image_color3", file="./map.png"), "out"
    both = shader(stage, "n", "ND_add_color3", in1=picture(stage), in2=other)
    surface(stage, base_color=(both, "out"), metalness=(shader(stage, "noise", "ND_noise2d_float"), "out"))
    data = read_stage(samples.saved(stage))
    assert data.materials[0].textures == {} and data.materials[0].metallic == 0.0
    found = texts(data)
    assert len(found) == 2
    assert any("base_color: driven by ND_add_color3: a sum of two pictures" in text for text in found)
    assert any("metalness: driven by ND_noise2d_float; its default is used" in text for text in found)


def test_product_of_two_pictures_keeps_one_and_tells(stage):
    other = shader(stage, "other", "ND_image_float", file="./map.png"), "out"
    surface(stage, base_color=(shader(stage, "n", "ND_multiply_color3FA", in1=other, in2=picture(stage)), "out"))
    data = read_stage(samples.saved(stage))
    assert data.materials[0].textures["base_color"].channel == "rgb"
    (text,) = texts(data)
    assert "product of two pictures" in text


def test_normal_map_node_decodes_and_scales(stage):
    node = shader(stage, "n", "ND_normalmap_float", scale=0.5, **{"in": picture(stage, "vector3")})
    surface(stage, normal=(node, "out"))
    data = read_stage(samples.saved(stage))
    texture = data.materials[0].textures["normal"]
    assert texture.color_space == "signed" and texts(data) == []
    np.testing.assert_allclose(looked_up(texture), (2 * TEXEL[:3] - 1) * [0.5, 0.5, 1], atol=1e-7)


def test_world_normals_of_a_picture_are_not_taken_for_tangent_space(stage):
    surface(stage, normal=picture(stage, "vector3"))
    data = read_stage(samples.saved(stage))
    assert "normal" not in data.materials[0].textures
    assert any("inputs:normal: driven by what is no tangent space picture" in text for text in texts(data))


def preview(stage, **texture_inputs):
    """A UsdPreviewSurface whose normal is a UsdUVTexture."""
    texture = shader(stage, "picture", "UsdUVTexture", file="./map.png")
    for name, (kind, value) in texture_inputs.items():
        texture.CreateInput(name, kind).Set(value)
    surface(stage, "UsdPreviewSurface", normal=(texture, "rgb"))
    data = read_stage(samples.saved(stage))
    return data.materials[0].textures["normal"], texts(data)


def test_preview_normal_keeps_its_scale_and_bias(stage):
    texture, found = preview(
        stage,
        scale=(T.Float4, Gf.Vec4f(2, 2, 2, 1)),
        bias=(T.Float4, Gf.Vec4f(-1, -1, -1, 0)),
        sourceColorSpace=(T.Token, "raw"),
    )
    assert texture.scale == (2, 2, 2, 1) and texture.bias == (-1, -1, -1, 0) and found == []


def test_wrong_tags_of_a_normal_map_are_told(stage):
    texture, found = preview(stage, sourceColorSpace=(T.Token, "sRGB"))
    assert texture.color_space == "signed"
    assert any("got sRGB on values that are no colour; they are read raw" in text for text in found)
    assert any("scale and bias are 1 and 0" in text for text in found)


def test_unknown_color_space_is_told(stage):
    node, output = picture(stage)
    node.GetInput("file").GetAttr().SetColorSpace("film_log_17")
    surface(stage, base_color=(node, output))
    data = read_stage(samples.saved(stage))
    assert data.materials[0].textures["base_color"].color_space == "auto"
    assert any("got film_log_17, which is not known" in text for text in texts(data))


def place2d(st, pivot, scale, degrees, offset, order):
    """MaterialX' place2d by its node graph; rotate2d is (c x + s y, -s x + c y)."""
    s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))

    def turn(p):
        return np.stack([c * p[:, 0] + s * p[:, 1], -s * p[:, 0] + c * p[:, 1]], axis=1)

    p = st - pivot
    p = turn(p - offset) / scale if order else turn(p / scale) - offset
    return p + pivot


@pytest.mark.parametrize("order", [0, 1])
def test_place2d_moves_coordinates(stage, order):
    arguments = ((0.25, 0.5), (2.0, 4.0), 30.0, (0.1, -0.2))
    names = ("pivot", "scale", "rotate", "offset")
    node = shader(
        stage,
        "place",
        "ND_place2d_vector2",
        operationorder=order,
        texcoord=(shader(stage, "st", "ND_texcoord_vector2"), "out"),
        **dict(zip(names, arguments, strict=True)),
    )
    surface(stage, base_color=picture(stage, texcoord=(node, "out")))
    data = read_stage(samples.saved(stage))
    rows = np.array(data.materials[0].textures["base_color"].uv_from_st)
    st = np.random.default_rng(0).uniform(-1, 2, (20, 2))
    wanted = place2d(st, arguments[0], arguments[1], arguments[2], arguments[3], order)
    np.testing.assert_allclose(st @ rows[:, :2].T + rows[:, 2], wanted, atol=1e-6)
    assert texts(data) == []


def test_arithmetic_on_coordinates_is_followed(stage):
    scaled = shader(
        stage, "a", "ND_multiply_vector2", in1=(shader(stage, "st", "ND_texcoord_vector2"), "out"), in2=(2.0, 3.0)
    )
    moved = shader(stage, "b", "ND_add_vector2", in1=(0.5, 0.25), in2=(scaled, "out"))
    surface(stage, base_color=picture(stage, texcoord=(moved, "out")))
    data = read_stage(samples.saved(stage))
    np.testing.assert_allclose(data.materials[0].textures["base_color"].uv_from_st, [[2, 0, 0.5], [0, 3, 0.25]])
    assert texts(data) == []


@pytest.mark.parametrize("kind", ["float", "float3"])
def test_primvar_through_a_graph_is_scaled(stage, kind):
    reader = shader(stage, "r", f"UsdPrimvarReader_{kind}", varname="gloss")
    surface(stage, specular_roughness=(shader(stage, "n", "ND_invert_float", **{"in": (reader, "result")}), "out"))
    if kind == "float":
        values, made = [0.75], T.FloatArray
    else:
        values, made = [Gf.Vec3f(0.75, 0.75, 0.75)], T.Color3fArray
    UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/Quad")).CreatePrimvar("gloss", made, "constant").Set(values)
    assert read_stage(samples.saved(stage)).materials[0].roughness == pytest.approx(0.25)


def test_interface_inputs_of_graph_and_material_are_followed(stage):
    material = surface(stage)
    graph = UsdShade.NodeGraph.Define(stage, "/M/G")
    inner = graph.CreateInput("rough", T.Float)
    outer = material.CreateInput("gloss", T.Float)
    outer.Set(0.125)
    inner.ConnectToSource(outer)
    node = shader(stage, "G/n", "ND_multiply_float", in2=2.0)
    node.CreateInput("in1", T.Float).ConnectToSource(inner)
    output = graph.CreateOutput("result", T.Float)
    output.ConnectToSource(node.CreateOutput("out", T.Float))
    UsdShade.Shader(stage.GetPrimAtPath("/M/S")).CreateInput("specular_roughness", T.Float).ConnectToSource(output)
    data = read_stage(samples.saved(stage))
    assert data.materials[0].roughness == 0.25 and texts(data) == []


def test_udim_set_is_found_beside_the_stage(stage, tmp_path):
    for number in (1001, 1012):
        write_png(tmp_path / f"skin.{number}.png", np.full((2, 2, 3), 0.5, np.float32))
    surface(stage, base_color=(shader(stage, "p", "ND_image_color3", file="./skin.<UDIM>.png"), "out"))
    data = read_stage(samples.saved(stage))
    assert data.materials[0].textures["base_color"].file == str(tmp_path / "skin.<UDIM>.png")
    assert texts(data) == []


def test_udim_set_without_a_tile_falls_back_and_is_told(stage):
    surface(stage, base_color=(shader(stage, "p", "ND_image_color3", file="./none.<UDIM>.png"), "out"))
    data = read_stage(samples.saved(stage))
    assert not data.materials[0].textures
    assert any("no tile of this set was found" in text for text in texts(data))


# Opacity.


@pytest.mark.parametrize(
    ("inputs", "drawn", "told"),
    [
        ({"opacity": 0.0}, (1.0, 1.0), ""),
        ({"opacity": 0.25}, (1.0, 0.75), ""),
        ({"opacity": 0.25, "opacityMode": "transparent"}, (1.0, 0.75), ""),
        ({"opacity": 0.25, "opacityMode": "presence"}, (0.25, 0.0), ""),
        ({"opacity": 0.0, "opacityMode": "presence"}, None, "got 0; what has it is not drawn"),
        ({"opacity": 0.25, "opacityThreshold": 0.5}, None, "got 0; what has it is not drawn"),
        ({"opacity": 0.5, "opacityThreshold": 0.5}, (1.0, 0.0), ""),
        ({"opacity": 1.0}, (1.0, 0.0), ""),
        ({"opacity": 7.0}, (1.0, 0.0), "inputs:opacity: got 7"),
    ],
)
def test_opacity_is_glass_or_absence(stage, inputs, drawn, told):
    """Opacity and transmission of what is drawn; None: it is not."""
    surface(stage, "UsdPreviewSurface", **inputs)
    samples.add_cube_mesh(stage, "/Cube")
    data = read_stage(samples.saved(stage))
    quad = [data.materials[i.materials[0]] for i in data.instances if i.prim_path == "/Quad"]
    assert [(m.opacity, m.transmission) for m in quad] == ([] if drawn is None else [drawn])
    assert [told in text for text in texts(data)] == ([True] if told else [])


def test_an_index_below_that_of_air_is_clamped_with_a_note(stage):
    surface(stage, "UsdPreviewSurface", ior=0.5, opacity=0.0)
    data = read_stage(samples.saved(stage))
    assert data.materials[data.instances[0].materials[0]].ior == 1.0
    assert ["inputs:ior: got 0.5, used as 1" in text for text in texts(data)] == [True]


def test_opacity_of_a_picture_without_a_threshold_is_told_once(stage):
    texture = shader(stage, "p", "UsdUVTexture", file="./map.png")
    surface(stage, "UsdPreviewSurface", opacity=(texture, "a"), opacityThreshold=0.0)
    data = read_stage(samples.saved(stage))
    assert len(data.instances) == 1 and data.materials[0].opacity == 1.0
    (text,) = texts(data)
    assert "without opacityThreshold" in text and "opacity" not in data.materials[0].textures


def test_opacity_of_a_picture_with_a_threshold_is_kept(stage):
    texture = shader(stage, "p", "UsdUVTexture", file="./map.png")
    surface(stage, "UsdPreviewSurface", opacity=(texture, "a"), opacityThreshold=0.5)
    material = read_stage(samples.saved(stage)).materials[0]
    assert (material.opacity, material.opacity_threshold, material.textures["opacity"].channel) == (1.0, 0.5, "a")


def test_transparent_subset_is_cut_out_of_its_mesh(stage):
    cube = samples.add_cube_mesh(stage, "/Cube")
    UsdGeom.PrimvarsAPI(cube).CreatePrimvar("st", T.TexCoord2fArray, "faceVarying").Set(
        [Gf.Vec2f(k, k) for k in range(24)]
    )
    binding = UsdShade.MaterialBindingAPI.Apply(cube.GetPrim())
    faces = {"glass": [0, 1], "paint": [2, 3, 4]}
    subsets = {name: binding.CreateMaterialBindSubset(name, which, "face") for name, which in faces.items()}
    samples.bind(subsets["glass"], samples.add_material(stage, "/Hole", opacity=0.0, opacityThreshold=0.1))
    samples.bind(subsets["paint"], samples.add_material(stage, "/Paint", metallic=0.5))
    data = read_stage(samples.saved(stage))
    (instance,) = data.instances
    mesh = data.meshes[instance.mesh]
    assert [part.subset for part in mesh.parts] == ["", "paint"]
    assert [(p.first_triangle, p.triangle_count) for p in mesh.parts] == [(0, 2), (2, 6)]
    assert len(mesh.triangles) == 8 and [data.materials[m].metallic for m in instance.materials] == [0.0, 0.5]


def test_transparent_display_opacity_is_not_drawn(stage):
    for name, opacity in (("/A", 0.0), ("/B", 1.0)):
        mesh = samples.add_quad(stage, name)
        UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayOpacity", T.FloatArray, "constant").Set([opacity])
    data = read_stage(samples.saved(stage))
    assert [i.prim_path for i in data.instances] == ["/B"] and any(text.startswith("/A: ") for text in texts(data))


# Binding rules (UsdShadeMaterialBindingAPI).


@pytest.fixture
def looks(stage):
    return {name: samples.add_material(stage, f"/Looks/{name}", metallic=k / 8) for k, name in enumerate("ABCDEFG")}


def bound(stage, path="/World/Group/Quad"):
    data = read_stage(samples.saved(stage))
    (instance,) = [i for i in data.instances if i.prim_path == path]
    return data.materials[instance.materials[0]].path.removeprefix("/Looks/")


def api(stage, path):
    return UsdShade.MaterialBindingAPI.Apply(stage.DefinePrim(path))


@pytest.fixture
def group(stage):
    return samples.add_quad(stage, "/World/Group/Quad")


def test_nearest_binding_wins(stage, looks, group):
    api(stage, "/World").Bind(looks["A"])
    assert bound(stage) == "A"
    api(stage, "/World/Group").Bind(looks["B"])
    assert bound(stage) == "B"


def test_stronger_binding_of_an_ancestor_wins(stage, looks, group):
    api(stage, "/World").Bind(looks["A"], UsdShade.Tokens.strongerThanDescendants)
    api(stage, "/World/Group").Bind(looks["B"])
    UsdShade.MaterialBindingAPI.Apply(group.GetPrim()).Bind(looks["C"])
    assert bound(stage) == "A"


def test_full_purpose_wins_over_all_purpose_and_preview_is_not_used(stage, looks, group):
    binding = UsdShade.MaterialBindingAPI.Apply(group.GetPrim())
    binding.Bind(looks["A"])
    binding.Bind(looks["B"], materialPurpose=UsdShade.Tokens.preview)
    assert bound(stage) == "A"
    api(stage, "/World").Bind(looks["C"], materialPurpose=UsdShade.Tokens.full)
    assert bound(stage) == "C"


def test_collection_binding_wins_over_a_direct_one_of_the_same_prim(stage, looks, group):
    from pxr import Usd

    collection = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "chosen")
    collection.IncludePath("/World/Group")
    binding = api(stage, "/World")
    binding.Bind(looks["A"])
    binding.Bind(collection, looks["B"], "chosen")
    assert bound(stage) == "B"
    collection.ExcludePath("/World/Group/Quad")
    assert bound(stage) == "A"


def test_binding_without_the_applied_schema_counts(stage, looks, group):
    group.GetPrim().CreateRelationship("material:binding").SetTargets(["/Looks/D"])
    assert bound(stage) == "D"
