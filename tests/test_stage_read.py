"""Stages to arrays: geometry, attributes, transforms, instances, materials, cameras, lights, bad prims."""

import tracemalloc

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt

from warp_reflect.stage.load import load_stage
from warp_reflect.stage.read import StageReader, read_stage


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def read(stage, **arguments):
    return read_stage(samples.saved(stage), **arguments)


def texts(data):
    return [f"{note.path}: {note.text}" for note in data.notes if not note.path.startswith("/__")]


def corner_values(values, index, mesh):
    return values[mesh.triangles if index is None else index]


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.usda"):
        read_stage(tmp_path / "nowhere.usda")


@pytest.mark.parametrize("content", [b"", b"\xff\xfe#usda 1.0", b"PXR-USDC\x00\x00", b"#usda 1.0\ndef Xform {"])
def test_unreadable_file_is_one_line(tmp_path, content, capfd):
    path = tmp_path / "broken.usda"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"broken\.usda") as caught:
        read_stage(path)
    assert "\n" not in str(caught.value) and "Error in" not in str(caught.value)
    assert capfd.readouterr().err == ""


def test_folder_is_no_stage(tmp_path):
    with pytest.raises(ValueError, match="not a regular file"):
        read_stage(tmp_path)


def test_mesh_of_mixed_faces(stage):
    points = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (1, 0.5, 0), (0, 2, 0), (3, 1, 0)]
    samples.add_mesh(stage, "/M", points, [5, 3], [0, 1, 2, 3, 4, 1, 5, 2])
    data = read(stage)
    mesh = data.meshes[0]
    assert mesh.triangles.dtype == np.int32 and mesh.points.dtype == np.float32
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    assert (area > 0.0).all() and area.sum() == pytest.approx(2.5 + 1.0)
    assert mesh.normals is None and not texts(data)


@pytest.mark.parametrize(("corners", "scheme"), [(3, "none"), (4, "none"), (3, "catmullClark")])
def test_large_meshes_take_a_small_multiple_of_their_arrays(stage, corners, scheme):
    """Blocks keep what is made on the way small; the library's own arrays are not counted here."""
    n = 401
    u, v = np.meshgrid(np.linspace(0, 6, n), np.linspace(0, 6, n))
    points = np.stack([u, v, 0.1 * np.sin(u) * np.sin(v)], axis=-1).reshape(-1, 3).astype(np.float32)
    grid = np.arange(n * n, dtype=np.int32).reshape(n, n)
    faces = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=-1).reshape(-1, 4)
    if corners == 3:
        faces = faces[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    mesh = UsdGeom.Mesh.Define(stage, "/Mesh")
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), corners, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr(scheme)
    reader = StageReader(samples.saved(stage))
    tracemalloc.start()
    data = reader.read()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    found = data.meshes[0]
    assert len(found.triangles) == 2 * (n - 1) ** 2
    arrays = [found.points, found.triangles, found.normals, found.normal_index]
    assert peak < 6 * sum(each.nbytes for each in arrays if each is not None)
    # Every triangle of the height field faces up, with the area of its square's half below it.
    side = found.points[found.triangles[:, 1:]] - found.points[found.triangles[:, :1]]
    area = np.cross(side[:, 0].astype(float), side[:, 1].astype(float))[:, 2]
    assert area.sum() == pytest.approx(2 * 36.0, rel=1e-5) and (area > 0.0).all()


def test_holes_are_not_drawn(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube")
    mesh.CreateHoleIndicesAttr([1, 4])
    drawn = read(stage).meshes[0]
    assert len(drawn.triangles) == 8
    centres = drawn.points[drawn.triangles].mean(axis=1)
    assert centres[:, 2].max() < 1.0 and centres[:, 0].min() > -1.0


def test_left_handed_mesh_faces_outward(stage):
    indices = [i for k in range(0, 24, 4) for i in reversed(samples.CUBE_INDICES[k : k + 4])]
    mesh = samples.add_mesh(stage, "/Cube", samples.CUBE_POINTS, [4] * 6, indices)
    mesh.CreateOrientationAttr("leftHanded")
    drawn = read(stage).meshes[0]
    a, b, c = (drawn.points[drawn.triangles[:, k]] for k in range(3))
    assert (np.einsum("nk,nk->n", np.cross(b - a, c - a), a) > 0.0).all()


def test_left_handed_corners_keep_their_values(stage):
    mesh = samples.add_quad(stage, "/Quad")
    colors = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "faceVarying")
    values = [Gf.Vec3f(*p) for p in samples.QUAD_POINTS]
    colors.Set(values)
    mesh.CreateOrientationAttr("leftHanded")
    drawn = read(stage).meshes[0]
    np.testing.assert_array_equal(corner_values(drawn.colors, drawn.color_index, drawn), drawn.points[drawn.triangles])


def test_normals_primvar_wins_over_attribute(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateNormalsAttr([Gf.Vec3f(1, 0, 0)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "uniform")
    primvar.Set([Gf.Vec3f(0, 3, 4)])
    drawn = read(stage).meshes[0]
    np.testing.assert_allclose(corner_values(drawn.normals, drawn.normal_index, drawn), [[[0, 0.6, 0.8]] * 3] * 2)


@pytest.mark.parametrize("interpolation", ["constant", "uniform", "vertex", "varying", "faceVarying"])
@pytest.mark.parametrize("indexed", [False, True])
def test_primvar_interpolations_reach_the_corners(stage, interpolation, indexed):
    mesh = samples.add_mesh(stage, "/M", [*samples.QUAD_POINTS, (3, 1, 0)], [4, 3], [0, 1, 2, 3, 1, 4, 2])
    count = {"constant": 1, "uniform": 2, "vertex": 5, "varying": 5, "faceVarying": 7}[interpolation]
    rng = np.random.default_rng(3)
    values = rng.uniform(size=(count, 3)).astype(np.float32)
    index = rng.permutation(count)
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, interpolation)
    primvar.Set(Vt.Vec3fArray.FromNumpy(values))
    expected = values
    if indexed:
        primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))
        expected = values[index]
    drawn = read(stage).meshes[0]
    # Corners of the two fans of the quad, and of the triangle, as positions in faceVertexIndices.
    corners = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    element = {
        "constant": np.zeros_like(corners),
        "uniform": np.array([[0] * 3, [0] * 3, [1] * 3]),
        "faceVarying": corners,
    }.get(interpolation, drawn.triangles)
    wanted = expected[element] / np.linalg.norm(expected[element], axis=2, keepdims=True)
    np.testing.assert_allclose(corner_values(drawn.normals, drawn.normal_index, drawn), wanted, atol=1e-6)


def test_bad_normals_become_face_normals(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateNormalsAttr([Gf.Vec3f(0, 0, 0), Gf.Vec3f(np.nan, 0, 0), Gf.Vec3f(0, 1e30, 0), Gf.Vec3f(0, 1e-30, 0)])
    mesh.SetNormalsInterpolation("vertex")
    data = read(stage)
    np.testing.assert_allclose(data.meshes[0].normals, [(0, 0, 1), (0, 0, 1), (0, 1, 0), (0, 1, 0)], atol=1e-7)
    assert any("normals[0]: got (0.0, 0.0, 0.0); 2 replaced" in text for text in texts(data))


def test_constant_display_color_becomes_the_material(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateDisplayColorAttr([Gf.Vec3f(0.1, 0.5, 0.25)])
    mesh.CreateDisplayOpacityAttr([0.5])
    sphere = UsdGeom.Sphere.Define(stage, "/Ball")
    sphere.CreateDisplayColorAttr([Gf.Vec3f(0.1, 0.5, 0.25)])
    sphere.CreateDisplayOpacityAttr([0.5])
    data = read(stage)
    assert len(data.materials) == 1
    assert data.materials[0].base_color == pytest.approx((0.1, 0.5, 0.25))
    assert data.materials[0].opacity == 0.5 and not data.materials[0].uses_vertex_color


def test_varying_display_color_is_the_meshes(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateDisplayColorPrimvar("vertex").Set([Gf.Vec3f(k, 0, 1) for k in range(4)])
    data = read(stage)
    assert data.materials[data.instances[0].materials[0]].uses_vertex_color
    drawn = data.meshes[0]
    assert corner_values(drawn.colors, drawn.color_index, drawn)[:, :, 0].tolist() == [[0, 1, 2], [0, 2, 3]]


def test_bound_material_replaces_display_color(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0)])
    material = samples.add_material(
        stage, "/Mirror", diffuseColor=(0.9, 0.8, 0.7), metallic=1.0, roughness=0.01, ior=2.0, clearcoat=0.5
    )
    samples.bind(mesh, material)
    data = read(stage)
    got = data.materials[data.instances[0].materials[0]]
    assert got.path == "/Mirror" and got.base_color == pytest.approx((0.9, 0.8, 0.7))
    assert (got.metallic, got.ior, got.clearcoat, got.opacity) == (1.0, 2.0, 0.5, 1.0)
    assert got.roughness == pytest.approx(0.01)


def test_material_values_come_through_interface_inputs(stage):
    material = samples.add_material(stage, "/Looks/M")
    public = material.CreateInput("metal", Sdf.ValueTypeNames.Float)
    public.Set(0.75)
    graph = UsdShade.NodeGraph.Define(stage, "/Looks/M/Graph")
    inner = graph.CreateInput("through", Sdf.ValueTypeNames.Float)
    inner.ConnectToSource(public)
    shader = UsdShade.Shader(stage.GetPrimAtPath("/Looks/M/Surface"))
    shader.CreateInput("metallic", Sdf.ValueTypeNames.Float).ConnectToSource(inner)
    samples.bind(samples.add_quad(stage, "/Quad"), material)
    assert read(stage).materials[0].metallic == 0.75


def test_subsets_split_a_mesh_and_the_rest_keeps_its_material(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube")
    samples.bind(mesh, samples.add_material(stage, "/Red", diffuseColor=(1.0, 0.0, 0.0)))
    subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset("top", [1, 5], "face")
    samples.bind(subset, samples.add_material(stage, "/Blue", diffuseColor=(0.0, 0.0, 1.0)))
    data = read(stage)
    drawn, (instance,) = data.meshes[0], data.instances
    assert [(p.subset, p.first_triangle, p.triangle_count) for p in drawn.parts] == [
        ("", 0, 8),
        ("top", 8, 4),
    ]
    assert [data.materials[m].path for m in instance.materials] == ["/Red", "/Blue"]
    top = drawn.points[drawn.triangles[8:]].reshape(-1, 3)
    assert ((top[:, 2] == 1.0) | (top[:, 0] == 1.0)).all()


def test_subset_faces_out_of_range_or_taken_are_noted(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube")
    binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    binding.CreateMaterialBindSubset("a", [0, 17], "face")
    binding.CreateMaterialBindSubset("b", [0, 1], "face")
    data = read(stage)
    assert [p.triangle_count for p in data.meshes[0].parts] == [8, 2, 2]
    assert any("/Cube/a: indices[1]: got 17, expected 0 to 5" in text for text in texts(data))
    assert any("/Cube/b: indices: 1 faces belong to an earlier subset" in text for text in texts(data))


def test_material_without_known_surface_falls_back(stage):
    mesh = samples.add_quad(stage, "/Quad")
    mesh.CreateDisplayColorAttr([Gf.Vec3f(1, 0, 0)])
    samples.bind(mesh, UsdShade.Material.Define(stage, "/Empty"))
    data = read(stage)
    assert data.materials[0].base_color == (1.0, 0.0, 0.0)
    assert any(text.startswith("/Empty: outputs:surface") for text in texts(data))


def test_transforms_follow_the_xform_stack(stage):
    outer = UsdGeom.Xform.Define(stage, "/A")
    outer.AddTranslateOp().Set(Gf.Vec3d(1e7, 2, 3))
    outer.AddRotateZOp().Set(90.0)
    inner = UsdGeom.Xform.Define(stage, "/A/B")
    inner.AddScaleOp().Set(Gf.Vec3f(-2, 1, 1))
    samples.add_quad(stage, "/A/B/Quad")
    reset = samples.add_quad(stage, "/A/B/Reset")
    reset.AddTranslateOp().Set(Gf.Vec3d(0, 0, 5))
    reset.SetResetXformStack(True)
    by_path = {i.prim_path: i.world_from_object for i in read(stage).instances}
    expected = np.array([[0, -1, 0, 1e7], [-2, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], float)
    np.testing.assert_allclose(by_path["/A/B/Quad"], expected, atol=1e-9)
    np.testing.assert_array_equal(by_path["/A/B/Reset"][:3, 3], [0, 0, 5])


def test_visibility_and_purpose_are_inherited(stage):
    UsdGeom.Xform.Define(stage, "/Hidden").MakeInvisible()
    samples.add_quad(stage, "/Hidden/Quad")
    UsdGeom.Camera.Define(stage, "/Hidden/Camera")
    UsdGeom.Xform.Define(stage, "/Proxy").CreatePurposeAttr("proxy")
    samples.add_quad(stage, "/Proxy/Quad")
    UsdGeom.Xform.Define(stage, "/Render").CreatePurposeAttr("render")
    samples.add_quad(stage, "/Render/Quad")
    samples.add_quad(stage, "/Render/Guide").CreatePurposeAttr("guide")
    data = read(stage)
    assert [i.prim_path for i in data.instances] == ["/Render/Quad"]
    assert [c.path for c in data.cameras] == ["/Hidden/Camera"]
    data = read(stage, purposes=("default", "proxy"))
    assert [i.prim_path for i in data.instances] == ["/Proxy/Quad"]


def test_abstract_and_undefined_prims_are_not_drawn(stage):
    stage.CreateClassPrim("/Class")
    samples.add_quad(stage, "/Class/Quad")
    stage.OverridePrim("/Over")
    stage.OverridePrim("/Over/Quad").SetTypeName("Mesh")
    assert not read(stage).instances


def test_gprims_carry_their_analytic_surface(stage):
    for k, (kind, patches) in enumerate(
        {"Sphere": 1, "Cube": 6, "Cylinder": 3, "Cone": 2, "Capsule": 3, "Plane": 1, "Cylinder_1": 3}.items()
    ):
        stage.DefinePrim(f"/G{k}_{patches}", kind)
    data = read(stage)
    assert len(data.instances) == 7
    for instance in data.instances:
        part = data.meshes[instance.mesh].parts[0]
        assert len(part.patches) == int(instance.prim_path[-1])
        assert sum(p.triangle_count for p in part.patches) == part.triangle_count
        assert all(p.shape is not None for p in part.patches)
    assert data.meshes[data.instances[5].mesh].double_sided


def test_native_instances_share_one_mesh(stage):
    UsdGeom.Xform.Define(stage, "/Part")
    samples.add_quad(stage, "/Part/Quad")
    red = samples.add_material(stage, "/Red", diffuseColor=(1.0, 0.0, 0.0))
    for name, x in (("A", 1), ("B", 2)):
        copy = UsdGeom.Xform.Define(stage, f"/{name}")
        copy.GetPrim().GetReferences().AddInternalReference("/Part")
        copy.GetPrim().SetInstanceable(True)
        copy.AddTranslateOp().Set(Gf.Vec3d(x, 0, 0))
    samples.bind(stage.GetPrimAtPath("/B"), red)
    data = read(stage)
    paths = [i.prim_path for i in data.instances]
    assert paths == ["/Part/Quad", "/A/Quad", "/B/Quad"]
    shared = [i.mesh for i in data.instances[1:]]
    assert shared[0] == shared[1]
    assert [i.world_from_object[0, 3] for i in data.instances] == [0.0, 1.0, 2.0]
    # The binding on the instance itself reaches the prim inside the prototype.
    assert [data.materials[i.materials[0]].path for i in data.instances] == ["", "", "/Red"]


def add_instancer(stage, path, prototypes, proto_indices, positions):
    instancer = UsdGeom.PointInstancer.Define(stage, path)
    instancer.CreatePrototypesRel().SetTargets([Sdf.Path(p) for p in prototypes])
    instancer.CreateProtoIndicesAttr(proto_indices)
    instancer.CreatePositionsAttr([Gf.Vec3f(*map(float, p)) for p in positions])
    return instancer


def test_point_instancer_places_prototypes_and_not_in_place(stage):
    UsdGeom.Xform.Define(stage, "/Root").AddTranslateOp().Set(Gf.Vec3d(0, 100, 0))
    instancer = add_instancer(
        stage,
        "/Root/PI",
        ["/Root/PI/P", "/Elsewhere"],
        [0, 1, 0, 0],
        [(1, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0)],
    )
    prototype = UsdGeom.Xform.Define(stage, "/Root/PI/P")
    prototype.AddTranslateOp().Set(Gf.Vec3d(0, 0, 7))
    samples.add_quad(stage, "/Root/PI/P/Quad")
    samples.add_quad(stage, "/Elsewhere")
    instancer.CreateScalesAttr([Gf.Vec3f(2, 2, 2)] * 4)
    instancer.CreateIdsAttr([10, 11, 12, 13])
    instancer.CreateInvisibleIdsAttr([12])
    data = read(stage)
    got = {(i.prim_path, i.instance): i.world_from_object[:3, 3].tolist() for i in data.instances}
    assert got == {
        ("/Root/PI/P/Quad", "/Root/PI:10"): [1.0, 100.0, 14.0],
        ("/Root/PI/P/Quad", "/Root/PI:13"): [4.0, 100.0, 14.0],
        ("/Elsewhere", "/Root/PI:11"): [2.0, 100.0, 0.0],
    }
    assert len(data.meshes) == 2


def test_nested_point_instancers_multiply(stage):
    add_instancer(stage, "/Outer", ["/Outer/Inner"], [0, 0], [(0, 10, 0), (0, 20, 0)])
    add_instancer(stage, "/Outer/Inner", ["/Outer/Inner/Quad"], [0, 0, 0], [(1, 0, 0), (2, 0, 0), (3, 0, 0)])
    samples.add_quad(stage, "/Outer/Inner/Quad")
    data = read(stage)
    places = sorted(tuple(i.world_from_object[:2, 3].tolist()) for i in data.instances)
    assert places == [(x, y) for x in (1.0, 2.0, 3.0) for y in (10.0, 20.0)]
    assert len({i.instance for i in data.instances}) == 6


def test_point_instancer_in_itself_ends(stage):
    add_instancer(stage, "/PI", ["/PI/P"], [0], [(0, 0, 0)])
    UsdGeom.Xform.Define(stage, "/PI/P")
    samples.add_quad(stage, "/PI/P/Quad")
    add_instancer(stage, "/PI/P/Again", ["/PI/P"], [0], [(1, 0, 0)])
    data = read(stage)
    assert len(data.instances) == 1
    assert any("holds this instancer itself" in text for text in texts(data))


def test_point_instancer_with_wrong_lengths_is_dropped(stage):
    add_instancer(stage, "/PI", ["/PI/Quad"], [0, 0], [(0, 0, 0)])
    samples.add_quad(stage, "/PI/Quad")
    data = read(stage)
    assert not data.instances
    assert any("/PI: positions: got 1 values, expected 2" in text for text in texts(data))


def test_camera_values_reach_camera_data(stage):
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    camera.CreateFocalLengthAttr(35.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(24.0)
    camera.CreateHorizontalApertureOffsetAttr(1.5)
    camera.CreateVerticalApertureOffsetAttr(-0.5)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.5, 50.0))
    camera.CreateProjectionAttr("orthographic")
    (got,) = read(stage).cameras
    assert (got.projection, got.focal_length, got.horizontal_aperture, got.vertical_aperture) == (
        "orthographic",
        50.0,
        36.0,
        24.0,
    )
    assert (got.horizontal_offset, got.vertical_offset, got.near, got.far) == (1.5, -0.5, 0.5, 50.0)
    assert got.world_from_camera[:3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("focalLength", 0.0),
        ("focalLength", float("nan")),
        ("horizontalAperture", -1.0),
        ("verticalAperture", 0.0),
        ("clippingRange", Gf.Vec2f(0, 0)),
        ("clippingRange", Gf.Vec2f(100, 1)),
        ("clippingRange", Gf.Vec2f(-1, 10)),
        ("projection", "fisheye"),
    ],
)
def test_impossible_camera_is_named_and_dropped(stage, attribute, value):
    UsdGeom.Camera.Define(stage, "/Bad").GetPrim().GetAttribute(attribute).Set(value)
    UsdGeom.Camera.Define(stage, "/Good")
    data = read(stage)
    assert [c.path for c in data.cameras] == ["/Good"]
    assert any(text.startswith(f"/Bad: {attribute}: got") for text in texts(data))
    with pytest.raises(ValueError, match=f"</Bad>: {attribute}"):
        read(stage, strict=True)


@pytest.mark.parametrize(("last", "cameras"), [(1.0 + 2.0**-52, ["/Eye"]), (1.01, ["/__default camera"])])
def test_rounded_last_entry_of_a_matrix_is_no_projection(stage, last, cameras):
    samples.add_cube_mesh(stage, "/Cube")
    matrix = Gf.Matrix4d(1.0).SetTranslate(Gf.Vec3d(0, 0, 5))
    matrix[3, 3] = last
    UsdGeom.Camera.Define(stage, "/Eye").AddTransformOp().Set(matrix)
    data = read(stage)
    assert [camera.path for camera in data.cameras] == cameras
    np.testing.assert_array_equal(data.cameras[0].world_from_camera[3], [0, 0, 0, 1])


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_default_camera_sees_everything(tmp_path, up_axis):
    stage = samples.new_stage(tmp_path / "s.usda", up_axis)
    cube = samples.add_cube_mesh(stage, "/Cube")
    cube.AddTranslateOp().Set(Gf.Vec3d(50, -3, 1000))
    cube.AddScaleOp().Set(Gf.Vec3f(10, 1, 3))
    data = read(stage)
    (camera,) = data.cameras
    assert camera.path == "/__default camera"
    world = data.instances[0].world_from_object
    points = data.meshes[0].points @ world[:3, :3].T + world[:3, 3]
    frame = camera.world_from_camera
    np.testing.assert_allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-12)
    assert frame["XYZ".index(up_axis), 1] > 0.5
    seen = ((points - frame[:3, 3]) @ frame[:3, :3]).T
    assert (-seen[2] > camera.near).all() and (-seen[2] < camera.far).all()
    assert (np.abs(seen[0] / seen[2]) < 0.5 * camera.horizontal_aperture / camera.focal_length).all()
    assert (np.abs(seen[1] / seen[2]) < 0.5 * camera.vertical_aperture / camera.focal_length).all()


def test_lights_follow_usdlux(stage):
    dome = UsdLux.DomeLight.Define(stage, "/Dome")
    dome.CreateColorAttr(Gf.Vec3f(1, 0.5, 0.25))
    dome.CreateIntensityAttr(3.0)
    dome.CreateExposureAttr(1.0)
    sun = UsdLux.DistantLight.Define(stage, "/Sun")
    sun.CreateIntensityAttr(50000.0)
    sun.CreateAngleAttr(60.0)
    even = UsdLux.DistantLight.Define(stage, "/Even")
    even.CreateIntensityAttr(2.0)
    even.CreateNormalizeAttr(True)
    by_path = {light.path: light for light in read(stage).lights}
    assert by_path["/Dome"].kind == "dome" and by_path["/Dome"].color == (6.0, 3.0, 1.5)
    # A disc of half angle 30 degrees and radiance L lights a facing surface with L pi / 4.
    assert by_path["/Sun"].color[0] == pytest.approx(50000.0 * np.pi / 4.0)
    assert by_path["/Even"].color == pytest.approx((2.0, 2.0, 2.0))


def test_stage_without_light_or_camera_gets_both(stage):
    samples.add_quad(stage, "/Quad")
    data = read(stage)
    assert data.lights[0].kind == "dome" and data.lights[0].color[0] > 0.0
    assert {note.path for note in data.notes} == {"/__default dome", "/__default camera"}


NAN, INF = float("nan"), float("inf")
BAD_MESHES = {
    "no points": ({"points": []}, "points: got an empty array"),
    "no counts": ({"counts": []}, "faceVertexCounts: got an empty array"),
    "no indices": ({"indices": []}, "faceVertexIndices: got an empty array"),
    "negative count": ({"counts": [8, -4]}, "faceVertexCounts[1]: got -4"),
    "wrapped count": ({"counts": [2147483647, 2147483647, 6]}, "faceVertexCounts[0]: got 2147483647"),
    "short": ({"counts": [5]}, "faceVertexIndices: got 4 values, expected 5"),
    "index too large": ({"indices": [0, 1, 2, 4]}, "faceVertexIndices[3]: got 4, expected 0 to 3"),
    "index negative": ({"indices": [0, -1, 2, 3]}, "faceVertexIndices[1]: got -1"),
    "index minimum": ({"indices": [-2147483648, 1, 2, 3]}, "faceVertexIndices[0]: got -2147483648"),
    "nan": ({"points": [(0, 0, 0), (1, NAN, 0), (1, 1, 0), (0, 1, 0)]}, "points[1]: got (1.0, nan, 0.0)"),
    "inf": ({"points": [(0, 0, 0), (1, 0, 0), (1, 1, INF), (0, 1, 0)]}, "points[2]: got (1.0, 1.0, inf)"),
    "huge": ({"points": [(0, 0, 0), (1, 0, 0), (1, 1, 1e30), (0, 1, 0)]}, "points[2]: got (1.0, 1.0, 1"),
    "no area": (
        {"points": [(0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)]},
        "points: got no face with an area",
    ),
    "lines": ({"counts": [2, 2]}, "faceVertexCounts: got no face with 3 corners"),
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_bad_mesh_is_dropped_with_its_reason(stage, name):
    change, expected = BAD_MESHES[name]
    arrays = {"points": samples.QUAD_POINTS, "counts": [4], "indices": [0, 1, 2, 3]} | change
    samples.add_mesh(stage, "/Bad", **arrays)
    samples.add_quad(stage, "/Good")
    data = read(stage)
    assert [i.prim_path for i in data.instances] == ["/Good"]
    assert any(text.startswith(f"/Bad: {expected}") and text.endswith("prim dropped") for text in texts(data))
    with pytest.raises(ValueError, match="</Bad>: ") as caught:
        read(stage, strict=True)
    assert expected in str(caught.value)


def test_wrong_attribute_types_are_named(tmp_path):
    path = tmp_path / "types.usda"
    path.write_text(
        """#usda 1.0
def Mesh "Text"
{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    string faceVertexCounts = "3"
    int[] faceVertexIndices = [0, 1, 2]
}
def Mesh "FloatIndices"
{
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    float[] faceVertexIndices = [0, 1, 2]
}
def Mesh "Double"
{
    double3[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}
"""
    )
    data = read_stage(path)
    assert [i.prim_path for i in data.instances] == ["/Double"]
    assert any("/Text: faceVertexCounts: got str, expected int[]" in text for text in texts(data))
    assert any("/FloatIndices: faceVertexIndices: got FloatArray, expected int[]" in text for text in texts(data))


def test_unreferenced_bad_point_is_harmless(stage):
    samples.add_mesh(stage, "/M", [*samples.QUAD_POINTS, (INF, 0, 0)], [4], [0, 1, 2, 3])
    data = read(stage)
    assert np.isfinite(data.meshes[0].points).all() and not texts(data)


@pytest.mark.parametrize("scale", [(0, 1, 1), (1, 1, NAN), (1e20, 1, 1)])
def test_singular_transform_drops_the_prim(stage, scale):
    samples.add_quad(stage, "/Bad").AddScaleOp().Set(Gf.Vec3f(*scale))
    samples.add_quad(stage, "/Thin").AddScaleOp().Set(Gf.Vec3f(1, 1, 1e-6))
    data = read(stage)
    assert [i.prim_path for i in data.instances] == ["/Thin"]
    assert any(text.startswith("/Bad: transform: got") for text in texts(data))


@pytest.mark.parametrize(
    ("kind", "attribute", "value"),
    [("Sphere", "radius", NAN), ("Sphere", "radius", -1.0), ("Cone", "height", 0.0), ("Cone", "axis", "Q")],
)
def test_bad_gprim_is_dropped(stage, kind, attribute, value):
    stage.DefinePrim("/Bad", kind).GetAttribute(attribute).Set(value)
    data = read(stage)
    assert not data.instances
    assert any(text.startswith(f"/Bad: {attribute}: got") for text in texts(data))


@pytest.mark.parametrize(
    ("values", "indices", "expected"),
    [
        (2, None, "got 2 values, expected 4"),
        (4, [0, 1, 2, 9], "indices[3]: got 9"),
        (4, [0, -1, 2, 3], "indices[1]"),
    ],
)
def test_bad_primvar_is_dropped_and_the_mesh_kept(stage, values, indices, expected):
    mesh = samples.add_quad(stage, "/Quad")
    primvar = mesh.CreateDisplayColorPrimvar("vertex")
    primvar.Set([Gf.Vec3f(1, 1, 1)] * values)
    if indices:
        primvar.SetIndices(indices)
    data = read(stage)
    assert len(data.instances) == 1 and data.meshes[0].colors is None
    assert not data.materials[0].uses_vertex_color
    assert any(expected in text for text in texts(data))


def test_units_axis_and_times_are_read(stage):
    stage.SetStartTimeCode(1.0)
    stage.SetEndTimeCode(10.0)
    stage.SetTimeCodesPerSecond(30.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    data = read(stage, time=4.0)
    assert (data.up_axis, data.meters_per_unit, data.time, data.time_range, data.time_codes_per_second) == (
        "Z",
        1.0,
        4.0,
        (1.0, 10.0),
        30.0,
    )


@pytest.mark.parametrize("text", ["metersPerUnit = 0", "metersPerUnit = nan", 'upAxis = "X"', "timeCodesPerSecond = 0"])
def test_bad_stage_metadata_is_replaced(tmp_path, text):
    path = tmp_path / "meta.usda"
    path.write_text(f"#usda 1.0\n(\n    {text}\n)\n")
    data = read_stage(path)
    name = text.split()[0]
    assert any(note.startswith(f"/: {name}: got") for note in texts(data))
    assert data.up_axis == "Y" and data.meters_per_unit == 0.01 and data.time_codes_per_second == 24.0


def test_composition_errors_are_noted_once(tmp_path):
    path = tmp_path / "refs.usda"
    path.write_text('#usda 1.0\ndef Xform "A" (references = @./nowhere.usda@)\n{\n}\n')
    data = read_stage(path)
    assert sum("nowhere.usda" in text for text in texts(data)) == 1
    with pytest.raises(ValueError, match=r"nowhere\.usda"):
        read_stage(path, strict=True)


def test_other_times_share_what_does_not_move(stage):
    still = samples.add_quad(stage, "/Still")
    still.AddTranslateOp().Set(Gf.Vec3d(0, 1, 0), 1.0)
    still.GetOrderedXformOps()[0].Set(Gf.Vec3d(0, 3, 0), 3.0)
    moving = samples.add_quad(stage, "/Moving")
    moving.GetPointsAttr().Set([Gf.Vec3f(*map(float, p)) for p in samples.QUAD_POINTS], 1.0)
    moving.GetPointsAttr().Set([Gf.Vec3f(p[0], p[1], 4.0) for p in samples.QUAD_POINTS], 3.0)
    reader = StageReader(samples.saved(stage))
    first, middle = reader.read(None), reader.read(2.0)
    assert first.meshes[0] is middle.meshes[0] and first.meshes[1] is not middle.meshes[1]
    assert [d.instances[0].world_from_object[1, 3] for d in (first, middle)] == [1.0, 2.0]
    assert [d.meshes[1].points[0, 2] for d in (first, middle)] == [0.0, 2.0]


def test_topology_that_changes_in_time_is_not_interpolated(stage):
    mesh = samples.add_mesh(stage, "/Mesh", samples.QUAD_POINTS, [4], [0, 1, 2, 3])
    mesh.GetPointsAttr().Clear()
    mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, p)) for p in samples.QUAD_POINTS], 1.0)
    mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, p)) for p in samples.CUBE_POINTS], 3.0)
    mesh.GetPointsAttr().Set([], 5.0)
    for attribute, first, second in (
        (mesh.GetFaceVertexCountsAttr(), [4], [4] * 6),
        (mesh.GetFaceVertexIndicesAttr(), [0, 1, 2, 3], samples.CUBE_INDICES),
    ):
        attribute.Clear()
        for time, value in ((1.0, first), (3.0, second), (5.0, [])):
            attribute.Set(value, time)
    scene = load_stage(samples.saved(stage))
    counts = [(len(m.triangles), len(m.points)) for t in (1.0, 2.0, 3.0, 4.0) for m in scene.at(t).data.meshes]
    assert counts == [(2, 4), (2, 4), (12, 8), (12, 8)]
    gone = scene.at(5.0)
    assert not gone.data.instances and gone.triangle_count == 0
    assert any("/Mesh: points: got an empty array" in text for text in texts(gone.data))
    assert scene.at(1.0).triangle_count == 2  # and back


def test_visibility_and_gprims_change_in_time(stage):
    blink = samples.add_quad(stage, "/Group/Blink")
    group = UsdGeom.Imageable(stage.GetPrimAtPath("/Group"))
    UsdGeom.Xform.Define(stage, "/Group")
    group.CreateVisibilityAttr().Set("invisible", 2.0)
    group.GetVisibilityAttr().Set("inherited", 1.0)
    ball = UsdGeom.Sphere.Define(stage, "/Ball")
    ball.CreateRadiusAttr().Set(1.0, 1.0)
    ball.GetRadiusAttr().Set(3.0, 3.0)
    reader = StageReader(samples.saved(stage))
    seen = {t: reader.read(t) for t in (1.0, 2.0)}
    assert [[i.prim_path for i in d.instances] for d in seen.values()] == [[str(blink.GetPath()), "/Ball"], ["/Ball"]]
    assert [d.meshes[-1].points.max() for d in seen.values()] == pytest.approx([1.0, 2.0])


def test_notes_are_one_line_each_and_told_at_every_time(stage):
    samples.add_mesh(stage, "/Bad", [(0, 0, 0), (1, NAN, 0), (1, 1, 0)], [3], [0, 1, 2])
    samples.add_quad(stage, "/Holed").CreateHoleIndicesAttr([7])
    stage.OverridePrim("/Lost").GetReferences().AddReference("./nowhere.usda")
    UsdGeom.BasisCurves.Define(stage, "/Curves")
    reader = StageReader(samples.saved(stage))
    first, second = reader.read(1.0), reader.read(2.0)
    assert first.notes == second.notes and len(first.notes) == len(set(first.notes))
    assert {"/Bad", "/Holed", "/Lost", "/Curves"} <= {note.path for note in first.notes}
    assert not any("\n" in note.text for note in first.notes)


def test_changed_file_is_read_anew(stage, tmp_path):
    samples.add_quad(stage, "/Quad")
    path = samples.saved(stage)
    assert len(read_stage(path).instances) == 1
    other = Usd.Stage.CreateInMemory()
    samples.add_quad(other, "/One")
    samples.add_quad(other, "/Two")
    (tmp_path / "stage.usda").write_text(other.GetRootLayer().ExportToString())
    assert [i.prim_path for i in read_stage(path).instances] == ["/One", "/Two"]


def test_what_is_met_and_not_drawn_is_noted_once(stage):
    UsdGeom.BasisCurves.Define(stage, "/Curves")
    UsdGeom.NurbsPatch.Define(stage, "/Patch")
    data = read(stage)
    assert [text.split(":")[0] for text in texts(data) if "is not drawn" in text] == ["/Curves", "/Patch"]


def add_points(stage, centres, widths=None):
    points = UsdGeom.Points.Define(stage, "/Points")
    points.CreatePointsAttr([Gf.Vec3f(*map(float, centre)) for centre in centres])
    if widths is not None:
        points.CreateWidthsAttr(widths)
    return points


def test_points_are_balls_of_their_widths(stage):
    centres, widths = [(0, 0, 0), (5, 0, 0), (0, 7, -3)], [2.0, 1.0, 0.5]
    points = add_points(stage, centres, widths)
    points.CreateDisplayColorPrimvar("vertex").Set([Gf.Vec3f(1, 0, 0), Gf.Vec3f(0, 1, 0), Gf.Vec3f(0, 0, 1)])
    points.AddTranslateOp().Set(Gf.Vec3d(0, 0, 9))
    data = read(stage)
    mesh, (instance,) = data.meshes[0], data.instances
    assert instance.prim_path == "/Points" and instance.world_from_object[2, 3] == 9.0
    corners = mesh.points[mesh.triangles].astype(float)
    ball = np.linalg.norm(corners[:, :1] - np.array(centres), axis=2).argmin(axis=1)
    out = corners - np.array(centres)[ball][:, None]
    np.testing.assert_allclose(
        np.linalg.norm(out, axis=2), 0.5 * np.array(widths)[ball][:, None] * np.ones(3), rtol=1e-5
    )
    unit = out / np.linalg.norm(out, axis=2, keepdims=True)
    np.testing.assert_allclose(mesh.normals[mesh.normal_index], unit, atol=1e-5)
    facing = np.einsum("nk,nk->n", np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), out[:, 0])
    assert (facing > 0.0).all()
    np.testing.assert_array_equal(mesh.colors[mesh.color_index], np.eye(3)[ball][:, None] * np.ones((1, 3, 1)))
    # Closed and inscribed: a little less than the spheres' volume.
    volume = np.einsum("nk,nk->n", out[:, 0], np.cross(out[:, 1], out[:, 2])).sum() / 6.0
    assert 0.96 < volume / (np.pi / 6.0 * np.sum(np.array(widths) ** 3)) < 1.0


def test_points_without_widths_have_a_diameter_of_one(stage):
    add_points(stage, [(1, 2, 3)])
    data = read(stage)
    assert np.ptp(data.meshes[0].points, axis=0) == pytest.approx(np.ones(3), abs=0.06)
    assert "/Points: widths: no value; 1 is used" in texts(data)


@pytest.mark.parametrize("count", [900, 2_000, 60_000])
def test_many_points_stay_affordable(stage, count):
    points = UsdGeom.Points.Define(stage, "/Points")
    points.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.random.default_rng(1).random((count, 3), np.float32)))
    points.CreateWidthsAttr([0.01])
    data = read(stage)
    assert 20 * count <= len(data.meshes[0].triangles) <= max(320 * 1_000, 80 * 50_000)


def test_bad_points_are_left_out_and_told(stage):
    add_points(stage, [(0, 0, 0), (NAN, 0, 0), (2, 0, 0), (3, 0, 0), (4, 0, 0)], [1.0, 1.0, -1.0, 0.0, 1.0])
    data = read(stage)
    assert len(data.meshes[0].triangles) == 2 * 320
    assert any("/Points: points[1]: got (nan" in text for text in texts(data))
    assert any("/Points: widths[2]: got -1" in text for text in texts(data))


@pytest.mark.parametrize(
    ("centres", "widths", "message"),
    [([], None, "points: got an empty array"), ([(0, 0, 0)] * 3, [1.0, 2.0], "widths: got 2 values, expected 1 or 3")],
)
def test_points_that_cannot_be_drawn_are_dropped(stage, centres, widths, message):
    add_points(stage, centres, widths)
    data = read(stage)
    assert not data.instances
    assert any(text.startswith(f"/Points: {message}") and text.endswith("prim dropped") for text in texts(data))


@pytest.mark.parametrize("arguments", [{"purposes": ("all",)}, {"complexity": "extreme"}, {"time": NAN}])
def test_impossible_arguments_are_named(stage, arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        read(stage, **arguments)


def test_what_the_library_itself_refuses_is_told_prim_by_prim(tmp_path):
    path = tmp_path / "wrong.usda"
    quad = """
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    uniform token subdivisionScheme = "none"
"""
    path.write_text(
        f"""#usda 1.0
def Mesh "Moved"
{{{quad}
    string xformOp:translate = "far"
    uniform token[] xformOpOrder = ["xformOp:translate"]
}}
def Mesh "Bound"
{{{quad}
    string material:binding = "red"
}}
def Mesh "Normals"
{{{quad}
    normal3f[] normals = [(0, 0, 1)] (
        interpolation = "sometimes"
    )
}}
"""
    )
    data = read_stage(path)
    assert [i.prim_path for i in data.instances] == ["/Bound", "/Normals"]
    found = texts(data)
    assert any(text.startswith("/Moved: ") and "opType" in text and text.endswith("dropped") for text in found)
    assert any(text.startswith("/Bound: material:binding: ") for text in found)
    assert any("/Normals: normals: got interpolation 'sometimes'" in text for text in found)
    with pytest.raises(ValueError, match="</Moved>: "):
        read_stage(path, strict=True)


def test_scene_moves_through_time(stage):
    quad = samples.add_quad(stage, "/Quad")
    move = quad.AddTranslateOp()
    move.Set(Gf.Vec3d(0, 0, 1), 1.0)
    move.Set(Gf.Vec3d(0, 0, 5), 5.0)
    scene = load_stage(samples.saved(stage))
    later = scene.at(3.0)
    assert scene.data.instances[0].world_from_object[2, 3] == 1.0
    assert later.data.instances[0].world_from_object[2, 3] == 3.0 and later.data.time == 3.0
    assert later.data.meshes[0] is scene.data.meshes[0]
    assert later.at(5.0).data.instances[0].world_from_object[2, 3] == 5.0


def test_untrusted_scene_is_read_again_in_a_child(stage):
    move = samples.add_quad(stage, "/Quad").AddTranslateOp()
    move.Set(Gf.Vec3d(0, 0, 1), 1.0)
    move.Set(Gf.Vec3d(0, 0, 5), 5.0)
    scene = load_stage(samples.saved(stage), time=1.0, untrusted=True)
    assert [s.data.instances[0].world_from_object[2, 3] for s in (scene, scene.at(5.0))] == [1.0, 5.0]
