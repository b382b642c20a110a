"""Virtual objects in space, the layer of `process`, and its ways to end."""

from __future__ import annotations

import itertools
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import tinyusdz
import trimesh
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation
from rooms import plane_room, render

import warp_reflect as wr
from warp_reflect import cli, pipeline, process
from warp_reflect.clipping import clip_to_mask, rectangles
from warp_reflect.stage.glb import write_glb
from warp_reflect.stage.write_virtual import Place, VirtualLayer, VirtualSample, place_name

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
# Errors of the law of reflection at the mirror's points of virtual vertices, most of them grazing. float32 virtual points;
# a map of 128 nodes along an edge.
SINE_MAX = {"quadric": 1.0e-3, "reflector_map": 4.0e-3}
OFFSET = 1.0e6  # of the far stage [units]; float32 resolves 0.06 there

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Y"
    metersPerUnit = 1
    startTimeCode = 1
    endTimeCode = 4
    timeCodesPerSecond = 30
)
def Xform "World"
{
    double3 xformOp:translate = (OFFSET, 0, 0)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Camera "Camera"
    {
        float2 clippingRange = (0.1, 1000)
        float focalLength = 30
        float horizontalAperture = 24
        float verticalAperture = 18
        double3 xformOp:translate.timeSamples = { 1: (0, 0.4, 6), 4: (0.5, 0.4, 6) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        double radius = 1
        float3[] extent = [(-1, -1, -1), (1, 1, 1)]
        rel material:binding = </World/Looks/Chrome>
        double3 xformOp:translate = (-1.1, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Mesh "Wall" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0.2, -1, -0.4), (2.2, -1, 0), (2.2, 1, 0), (0.2, 1, -0.4)]
        float3[] extent = [(0.2, -1, -0.4), (2.2, 1, 0)]
        uniform token subdivisionScheme = "none"
        bool doubleSided = 1
        rel material:binding = </World/Looks/Chrome>
    }
    def Mesh "Card" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        int[] faceVertexCounts = [4, 4]
        int[] faceVertexIndices = [0, 1, 4, 3, 1, 2, 5, 4]
        point3f[] points = [(-0.8, -0.4, 0), (0, -0.4, 0), (0.8, -0.4, 0), (-0.8, 0.6, 0), (0, 0.6, 0), (0.8, 0.6, 0)]
        float3[] extent = [(-0.8, -0.4, 0), (0.8, 0.6, 0)]
        texCoord2f[] primvars:st = [(0, 0), (0.5, 0), (1, 0), (0, 1), (0.5, 1), (1, 1)] (interpolation = "vertex")
        uniform token subdivisionScheme = "none"
        bool doubleSided = 1
        rel material:binding = </World/Looks/Red>
        double3 xformOp:translate.timeSamples = { 1: (0.2, -1.2, 4), 2: (0.2, -1.2, 4), 3: (0.6, -1.1, 4), 4: (60, 0, 2) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
        uniform token subsetFamily:materialBind:familyType = "nonOverlapping"
        def GeomSubset "Half" (prepend apiSchemas = ["MaterialBindingAPI"])
        {
            uniform token elementType = "face"
            uniform token familyName = "materialBind"
            int[] indices = [1]
            rel material:binding = </World/Looks/Blue>
        }
    }
    def Cube "Box"
    {
        double size = 0.8
        float3[] extent = [(-0.4, -0.4, -0.4), (0.4, 0.4, 0.4)]
        color3f[] primvars:displayColor = [(0.1, 0.7, 0.2)]
        double3 xformOp:translate = (1, -1.4, 3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Scope "Looks"
    {
        LOOKS
    }
}
"""
LOOK = """
        def Material "{name}"
        {{
            token outputs:surface.connect = </World/Looks/{name}/Surface.outputs:surface>
            def Shader "Surface"
            {{
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = {color}
                float inputs:metallic = {metallic}
                float inputs:roughness = {roughness}
                {texture}
                token outputs:surface
            }}
            {nodes}
        }}
"""
TEXTURE = """
            def Shader "Picture"
            {
                uniform token info:id = "UsdUVTexture"
                asset inputs:file = @./red.png@
                float2 inputs:st.connect = </World/Looks/Red/Reader.outputs:result>
                float3 outputs:rgb
            }
            def Shader "Reader"
            {
                uniform token info:id = "UsdPrimvarReader_float2"
                string inputs:varname = "st"
                float2 outputs:result
            }
"""
CONNECT = "color3f inputs:emissiveColor.connect = </World/Looks/Red/Picture.outputs:rgb>"


def look(name: str, color: tuple, metallic=0, roughness=0.5, texture="", nodes="") -> str:
    return LOOK.format(name=name, color=color, metallic=metallic, roughness=roughness, texture=texture, nodes=nodes)


def write_stage(path: Path, offset: float = 0.0) -> Path:
    from warp_reflect.images import write_png

    looks = look("Chrome", (0.9, 0.9, 0.9), 1, 0) + look("Red", (0.8, 0.1, 0.1), texture=CONNECT, nodes=TEXTURE)
    looks += look("Blue", (0.1, 0.1, 0.8))
    path.write_text(STAGE.replace("LOOKS", looks).replace("OFFSET", repr(offset)))
    write_png(path.with_name("red.png"), np.full((4, 4, 3), 0.5, np.float32))
    return path


@pytest.fixture
def stage(tmp_path, monkeypatch) -> str:
    """A chrome ball and a chrome wall before a card of two materials and a box, in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    write_stage(Path("stage.usda"))
    return "stage.usda"


@pytest.fixture
def call(capfd, device):
    """Run `process` in this process: (exit code, standard output, standard error)."""

    def run(*tokens) -> tuple[int, str, str]:
        capfd.readouterr()
        code = cli.main(["process", *map(str, tokens), "--res", "160x120", "--device", device])
        out, err = capfd.readouterr()
        return code, out, err

    return run


def validation_errors(path: str) -> list[str]:
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(data.name) for data in registry.GetAllValidatorMetadata()]
    stage = Usd.Stage.Open(path)
    return [e.GetErrorAsString() for e in UsdValidation.ValidationContext(validators).Validate(stage)]


def virtual_meshes(stage: Usd.Stage) -> list[UsdGeom.Mesh]:
    return [UsdGeom.Mesh(p) for p in stage.Traverse() if p.HasAttribute("warp_reflect:kind") and p.IsA(UsdGeom.Mesh)]


def world_points(mesh: UsdGeom.Mesh, time=Usd.TimeCode.Default()) -> np.ndarray:  # noqa: B008
    matrix = np.array(mesh.ComputeLocalToWorldTransform(time))
    points = np.array(mesh.GetPointsAttr().Get(time), np.float64)
    return points @ matrix[:3, :3] + matrix[3, :3]


def sources(prim: Usd.Prim) -> tuple[str, str]:
    """(mirror, object) of a virtual mesh."""
    mirror = prim.GetParent().GetRelationship("warp_reflect:mirror").GetTargets()[0]
    return str(mirror), str(prim.GetRelationship("warp_reflect:source").GetTargets()[0])


# Virtual objects.


def test_virtual_points_of_a_plane_are_mirrored_points():
    frame = render(plane_room(), "planar", edge_px=0.0)
    eye = frame.camera.eye
    objects = frame.virtual_objects()
    assert len(objects) > 5
    for found in objects:
        expected = found.sources + frame.scene.origin
        expected = expected * [1, 1, -1] + [0, 0, -4.0]  # the plane z = -2
        np.testing.assert_allclose(found.points + eye, expected, atol=2e-5)


@pytest.mark.parametrize("method", ["quadric", "reflector_map"])
def test_virtual_points_of_a_sphere_obey_the_law_of_reflection(method):
    """R, where the line of sight meets the sphere, must reflect it to the point, and the path must be as long."""
    scene = wr.load_stage(str(SCENES / "sphere_on_checker.usda"))
    plan = wr.make_plan(scene, size=(200, 150), method=method, settings=wr.Settings(refine="off"))
    frame = wr.render_frame(scene, plan)
    part = scene.parts[plan.rows[0].reflector.part]
    centre, radius = part.world_from_object[:3, 3], np.linalg.norm(part.world_from_object[:3, 0])
    checked = 0
    for found in frame.virtual_objects():
        u = found.points / np.linalg.norm(found.points, axis=1, keepdims=True)
        to_centre = centre - frame.camera.eye
        along = u @ to_centre
        chord = along**2 - to_centre @ to_centre + radius**2
        seen = chord > 1e-3  # the others are the hidden boundary, where the line of sight grazes
        t = along - np.sqrt(np.maximum(chord, 0.0))
        r = frame.camera.eye + t[:, None] * u
        n = (r - centre) / radius
        target = found.sources + scene.origin - r
        path = np.linalg.norm(target, axis=1)
        reflected = u - 2.0 * np.einsum("ij,ij->i", u, n)[:, None] * n
        sine = np.linalg.norm(np.cross(reflected, target / path[:, None]), axis=1)
        assert np.quantile(sine[seen], 0.99) < SINE_MAX[method]
        np.testing.assert_allclose((t + path)[seen], np.linalg.norm(found.points, axis=1)[seen], rtol=2e-4)
        checked += int(seen.sum())
    assert checked > 1000


@pytest.mark.parametrize("name", ["capped_cylinder", "shaving_mirror", "open_bowl", "two_spheres"])
def test_clipped_virtual_objects_cover_what_the_mirror_shows(name):
    """A z-buffer of our own draws them: at mirror pixels the nearest must be the object that rays find.

    In the bowl, which hides much from itself, it must be what the frame of the technique shows without refinement.
    """
    scene = wr.load_stage(str(SCENES / f"{name}.usda"))
    size = (160, 120)
    traced = wr.render_frame(scene, wr.make_plan(scene, size=size, method="reference"))
    plan = wr.make_plan(scene, size=size, method="reflector_map", settings=wr.Settings(refine="off"))
    frame = wr.render_frame(scene, plan)
    shown = np.zeros(size[::-1])
    nearest = np.full(size[::-1], np.inf)
    for found in frame.virtual_objects(clip=True):
        pixel, depth = on_screen(frame.camera, found.points)
        assert (depth > 0.0).all()
        draw(pixel[found.triangles], depth[found.triangles], scene.parts[found.part].prim, shown, nearest)
    ids, expected = traced["reflectorId"], (frame if name == "open_bowl" else traced)["reflectedId"]
    held = np.isin(ids, [row.reflector.id for row in plan.rows if row.technique == "reflector_map"])
    assert (shown[ids == 0] == 0).all()
    inner = held & interior(ids) & interior(expected)
    assert inner.sum() > 300
    assert (shown == expected)[inner].mean() > 0.98


def on_screen(camera: wr.Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(pixels [n, 2], depths [n]) of eye-frame points."""
    depth = points @ camera.forward
    x = camera.fx * (points @ camera.right) / depth + camera.cx
    y = -camera.fy * (points @ camera.up) / depth + camera.cy
    return np.stack([x, y], 1), depth


def interior(ids: np.ndarray) -> np.ndarray:
    """Pixels whose 3x3 neighbourhood is alike."""
    padded = np.pad(ids, 1, mode="edge")
    shifted = [padded[y : y + ids.shape[0], x : x + ids.shape[1]] for y in range(3) for x in range(3)]
    return np.all([each == ids for each in shifted], axis=0)


def draw(pixel: np.ndarray, depth: np.ndarray, number: int, shown: np.ndarray, nearest: np.ndarray) -> None:
    """Triangles [n, 3, 2] into a z-buffer, at pixel centres, both sides."""
    for corner, z in zip(pixel, depth, strict=True):
        x0, y0 = np.maximum(np.floor(corner.min(axis=0)).astype(int), 0)
        x1, y1 = np.minimum(np.ceil(corner.max(axis=0)).astype(int), shown.shape[::-1])
        if x0 >= x1 or y0 >= y1:
            continue
        px, py = np.meshgrid(np.arange(x0, x1) + 0.5, np.arange(y0, y1) + 0.5)
        (ax, ay), (bx, by), (cx, cy) = corner
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        wb = ((px - ax) * (cy - ay) - (py - ay) * (cx - ax)) / area
        wc = ((bx - ax) * (py - ay) - (by - ay) * (px - ax)) / area
        inside = (wb >= 0.0) & (wc >= 0.0) & (wb + wc <= 1.0)
        at = 1.0 / ((1.0 - wb - wc) / z[0] + wb / z[1] + wc / z[2])
        box = (slice(y0, y1), slice(x0, x1))
        closer = inside & (at < nearest[box])
        nearest[box][closer] = at[closer]
        shown[box][closer] = number


@pytest.mark.parametrize("name", ["sphere_on_checker", "shaving_mirror"])
def test_virtual_triangles_are_wound_by_the_side_that_is_seen(name):
    """Closed objects show their outside in a mirror, and so must their virtual meshes to the eye."""
    scene = wr.load_stage(str(SCENES / f"{name}.usda"))
    size = (400, 300)
    settings = wr.Settings(refine="off")
    frame = wr.render_frame(scene, wr.make_plan(scene, size=size, method="quadric", settings=settings))
    shown, nearest = np.zeros(size[::-1]), np.full(size[::-1], np.inf)
    closed = scene.closed_patches.numpy()
    for found in frame.virtual_objects(clip=True):
        corner = found.points[found.triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        facing = np.where(np.einsum("ij,ij->i", normal, corner.mean(axis=1)) < 0.0, 1, 2)
        facing[:] *= int(closed[scene.parts[found.part].patches].all())
        pixel, depth = on_screen(frame.camera, found.points)
        for kind in np.unique(facing):
            chosen = found.triangles[facing == kind]
            draw(pixel[chosen], depth[chosen], kind, shown, nearest)
    inner = interior(frame["reflectedId"])
    outside, inside = (shown[inner] == 1).sum(), (shown[inner] == 2).sum()
    assert outside > 100
    assert inside < 0.01 * outside


# Clipping.


@pytest.mark.parametrize("seed", range(4))
def test_rectangles_make_up_the_mask(seed):
    mask = np.random.default_rng(seed).random((17, 23)) < 0.6
    painted = np.zeros(mask.shape, int)
    for x0, y0, x1, y1 in rectangles(mask):
        painted[y0:y1, x0:x1] += 1
    np.testing.assert_array_equal(painted, mask)
    assert len(rectangles(np.zeros((3, 4), bool))) == 0


@pytest.mark.parametrize("seed", range(4))
def test_clipped_area_is_that_of_the_covered_pixels(seed):
    """A fan around a point tiles the picture: what is left of it has the mask's area, each pixel once."""
    rng = np.random.default_rng(seed)
    mask = rng.random((12, 16)) < 0.7
    angle = np.linspace(0, 2 * np.pi, 10)[:-1]
    rim = np.stack([8 + 40 * np.cos(angle), 6 + 40 * np.sin(angle)], 1)
    depth = rng.uniform(1, 3, 10)
    flat = np.concatenate([[[8.0, 6.0]], rim])
    h = np.concatenate([flat * depth[:, None], depth[:, None]], axis=1)
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 9] for k in range(9)])
    owner, weights, triangles = clip_to_mask(h[faces], mask, 0.01)
    points = np.einsum("pk,pkj->pj", weights, h[faces][owner])
    corner = (points[:, :2] / points[:, 2:])[triangles]
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * np.abs(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
    np.testing.assert_allclose(area.sum(), mask.sum(), rtol=1e-9)
    middle = corner.mean(axis=1)[area > 1e-9].astype(int)
    assert mask[middle[:, 1], middle[:, 0]].all()


def test_triangle_through_the_eye_plane_is_cut_at_the_near_plane():
    corners = np.array([[[4.0, 4.0, 1.0], [40.0, 40.0, 10.0], [-4.0, -20.0, -5.0]]])
    owner, weights, triangles = clip_to_mask(corners, np.ones((8, 8), bool), 0.5)
    points = np.einsum("pk,pkj->pj", weights, corners[owner])
    assert len(triangles)
    assert points[:, 2].min() >= 0.5 - 1e-9
    pixel = points[:, :2] / points[:, 2:]
    assert pixel.min() >= -1e-9
    assert pixel.max() <= 8 + 1e-9


# The layer.


@pytest.mark.parametrize("ending", ["usd", "usda", "usdc"])
def test_layer_is_valid_and_keeps_metadata_and_materials(stage, call, ending):
    before = Path(stage).read_bytes()
    os.mkdir("out")
    code, out, err = call(stage, f"out/all.{ending}", "--clip")
    assert code == 0, err
    assert Path(stage).read_bytes() == before
    assert "virtual objects in 2 mirrors" in out
    assert os.listdir("out") == [f"all.{ending}"]
    assert validation_errors(f"out/all.{ending}") == []
    layer = Sdf.Layer.FindOrOpen(f"out/all.{ending}")
    assert list(layer.subLayerPaths) == ["../stage.usda"]
    opened = Usd.Stage.Open(layer)
    assert UsdGeom.GetStageUpAxis(opened) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(opened) == 1.0
    assert (opened.GetStartTimeCode(), opened.GetEndTimeCode(), opened.GetTimeCodesPerSecond()) == (1, 4, 30)
    assert opened.GetDefaultPrim().GetPath() == "/World"
    meshes = virtual_meshes(opened)
    assert {str(mesh.GetPath()).rpartition("/")[0] for mesh in meshes} == {
        "/World/WarpReflect/Ball",
        "/World/WarpReflect/Wall",
    }
    bound = {}
    for mesh in meshes:
        assert mesh.ComputePurpose() == "guide"
        assert mesh.GetPrim().GetAttribute("warp_reflect:kind").Get() == "virtual"
        bound[sources(mesh.GetPrim())] = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].GetPath()
    assert bound["/World/Ball", "/World/Card"] == bound["/World/Wall", "/World/Card"] == "/World/Looks/Red"
    assert bound["/World/Ball", "/World/Card/Half"] == "/World/Looks/Blue"
    assert bound["/World/Wall", "/World/Box"].isEmpty
    noted = layer.customLayerData["warp_reflect"]["process"]
    assert noted["camera"] == "/World/Camera"
    assert len(noted["sourceDigest"]) == 32
    assert json.loads(noted["settings"])["refine"] == "off"
    assert {row["path"] for row in json.loads(noted["plan"])["reflectors"]} == {"/World/Ball", "/World/Wall"}


@pytest.mark.parametrize("ending", ["usda", "usdc"])
def test_layer_reads_the_same_in_another_library(stage, call, ending):
    assert call(stage, f"out.{ending}")[0] == 0
    opened = Usd.Stage.Open(f"out.{ending}")
    expected = {str(mesh.GetPath()): mesh for mesh in virtual_meshes(opened)}
    found = {}

    def collect(prim, path: str) -> None:
        path = f"{path}/{prim.name}"
        if prim.type_name == "Mesh" and path in expected:
            found[path] = prim
        for child in prim.children():
            collect(child, path)

    for root in tinyusdz.load(f"out.{ending}").root_prims():
        collect(root, "")
    assert found.keys() == expected.keys()
    assert len(found) >= 6
    for path, prim in found.items():
        mesh = expected[path]
        for name in ("points", "faceVertexCounts", "faceVertexIndices"):
            read = np.asarray(prim.get_attribute(name).value)
            np.testing.assert_array_equal(read, np.array(mesh.GetPrim().GetAttribute(name).Get()))


def test_uvs_of_virtual_objects_are_the_objects_own(stage, call):
    """The card's u runs with its x: a mirrored point keeps it."""
    assert call(stage, "out.usda", "--clip")[0] == 0
    opened = Usd.Stage.Open("out.usda")
    card = next(m for m in virtual_meshes(opened) if sources(m.GetPrim()) == ("/World/Wall", "/World/Card"))
    uv = UsdGeom.PrimvarsAPI(card).GetPrimvar("st")
    assert uv.GetInterpolation() == "faceVarying"
    index = np.array(card.GetFaceVertexIndicesAttr().Get())
    virtual = world_points(card)[index]
    a, b = np.array([0.2, -1, -0.4]), np.array([2.2, -1, 0])
    n = np.cross(b - a, [0, 1, 0]) / np.linalg.norm(b - a)
    real = virtual - 2.0 * ((virtual - a) @ n)[:, None] * n - [0.2, -1.2, 4.0]
    np.testing.assert_allclose(np.array(uv.Get())[:, 0], (real[:, 0] + 0.8) / 1.6, atol=2e-5)
    np.testing.assert_allclose(np.array(uv.Get())[:, 1], real[:, 1] + 0.4, atol=2e-5)


def test_large_offsets_stay_exact(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    near, far = write_stage(tmp_path / "near.usda"), write_stage(tmp_path / "far.usda", OFFSET)
    assert call(near, "a.usda")[0] == call(far, "b.usda")[0] == 0
    stages = [Usd.Stage.Open(name) for name in ("a.usda", "b.usda")]
    first, second = map(virtual_meshes, stages)
    assert [m.GetPath() for m in first] == [m.GetPath() for m in second]
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(world_points(b) - [OFFSET, 0, 0], world_points(a), rtol=1e-5, atol=1e-5)


def test_samples_of_other_topology_are_not_interpolated(stage, call):
    code, _, err = call(stage, "out.usdc", "--frames", "1:4", "--clip")
    assert code == 0, err
    assert validation_errors("out.usdc") == []
    opened = Usd.Stage.Open("out.usdc")
    changing = 0
    for mesh in virtual_meshes(opened):
        times = mesh.GetPointsAttr().GetTimeSamples()
        for a, b in itertools.pairwise(times):
            index = [np.array(mesh.GetFaceVertexIndicesAttr().Get(t)) for t in (a, b)]
            if not np.array_equal(*index):
                changing += 1
                between = np.array(mesh.GetPointsAttr().Get(0.5 * (a + b)))
                np.testing.assert_array_equal(between, np.array(mesh.GetPointsAttr().Get(a)))
    assert changing > 0
    card = UsdGeom.Mesh(opened.GetPrimAtPath("/World/WarpReflect/Wall/Card"))
    assert [card.ComputeVisibility(t) for t in (1, 2, 3, 4)] == ["inherited"] * 3 + ["invisible"]


def test_resumed_layer_is_the_same(stage, call):
    assert call(stage, "whole.usda", "-f", "1:3")[0] == 0
    assert call(stage, "parts.usda", "-f", "1:2")[0] == 0
    code, out, err = call(stage, "parts.usda", "-f", "1:3", "--resume")
    assert code == 0
    assert "2 of 3 frames are done" in err
    assert out.count("parts.usda:") == 1
    assert Path("parts.usda").read_text() == Path("whole.usda").read_text()
    code, out, err = call(stage, "parts.usda", "-f", "1:3", "--resume", "--clip")
    assert code == 0
    assert "are done" not in err
    assert out.count("parts.usda:") == 3


def test_a_stage_that_changes_under_way_is_told(stage, call, monkeypatch):
    real = process._add_frame

    def change(*arguments):
        with open(stage, "a") as file:
            file.write("# another\n")
        return real(*arguments)

    monkeypatch.setattr(process, "_add_frame", change)
    code, _, err = call(stage, "changed.usda", "-f", "1:3")
    assert code == 1
    assert err.count("changed while it was rendered") == 1
    monkeypatch.setattr(process, "_add_frame", real)
    code, out, err = call(stage, "changed.usda", "-f", "1:3", "--resume")
    assert (code, out.count("changed.usda:")) == (0, 3)


def test_stopped_run_keeps_its_frames(stage, call, monkeypatch):
    real = process._add_frame

    def second_fails(opened, wish, place, layer):
        if place == 1:
            raise MemoryError("for the test")
        return real(opened, wish, place, layer)

    monkeypatch.setattr(process, "_add_frame", second_fails)
    code, _, err = call(stage, "out.usda", "-f", "1:3")
    assert code == 1
    assert "frame 2: not enough memory for the test" in err
    monkeypatch.setattr(process, "_add_frame", real)
    code, out, _ = call(stage, "out.usda", "-f", "1:3", "--resume")
    assert code == 0
    assert out.count("out.usda:") == 1
    assert list(Sdf.Layer.FindOrOpen("out.usda").customLayerData["warp_reflect"]["process"]["frames"]) == [1, 2, 3]


def test_failed_write_leaves_the_older_layer(stage, call, monkeypatch):
    assert call(stage, "out.usda", "-f", "1:2")[0] == 0
    before = Path("out.usda").read_bytes()

    def full(*_, **__):
        raise OSError("out.usda: cannot be written: no space left")

    monkeypatch.setattr("warp_reflect.stage.write_virtual.save_layer", full)
    code, _, err = call(stage, "out.usda", "-f", "1:2")
    assert code == 2
    assert "no space left" in err
    assert Path("out.usda").read_bytes() == before
    assert sorted(os.listdir()) == ["out.usda", "red.png", "stage.usda"]


def test_glb_holds_the_same_objects_in_metres(stage, call):
    code, _, err = call(stage, "out.usda", "--glb", "out.glb")
    assert code == 0, err
    opened = Usd.Stage.Open("out.usda")
    meshes = {str(mesh.GetPath()).removeprefix("/World/WarpReflect/"): mesh for mesh in virtual_meshes(opened)}
    scene = trimesh.load("out.glb", force="scene")
    assert set(scene.geometry) == set(meshes)
    for name, mesh in meshes.items():
        transform, geometry = scene.graph[name]
        loaded = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
        expected = world_points(mesh)
        np.testing.assert_allclose(loaded.min(axis=0), expected.min(axis=0), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(loaded.max(axis=0), expected.max(axis=0), rtol=1e-5, atol=1e-5)
    color = scene.geometry["Wall/Box"].visual.material.baseColorFactor
    np.testing.assert_allclose(np.array(color[:3]) / 255.0, [0.1, 0.7, 0.2], atol=3e-3)


def test_stage_without_default_prim_gets_a_root_scope(stage, call):
    text = Path(stage).read_text().replace('    defaultPrim = "World"\n', "")
    Path(stage).write_text(text)
    assert call(stage, "out.usda")[0] == 0
    opened = Usd.Stage.Open("out.usda")
    meshes = virtual_meshes(opened)
    assert str(meshes[0].GetPath()).startswith("/WarpReflect/World__Ball/")


def test_traced_mirrors_are_told_once(stage, call):
    code, _, err = call(stage, "out.usda", "-f", "1:2", "--method", "reference")
    assert code == 0
    assert err.count("/World/Ball: no virtual objects: the reference") == 1
    assert err.count("/World/Wall: no virtual objects") == 1
    assert virtual_meshes(Usd.Stage.Open("out.usda")) == []
    assert validation_errors("out.usda") == []


@pytest.mark.parametrize(
    ("tokens", "expected"),
    [
        (("stage.usda", "stage.usda"), "is the stage itself"),
        (("stage.usda", "out.obj"), "cannot write a '.obj' layer"),
        (("stage.usda", "gone/out.usda"), "the folder 'gone' does not exist"),
        (("stage.usda", "out.usda", "--camera", "Nobody"), "camera: 'Nobody' names 0 cameras"),
        (("stage.usda", "out.usda", "--purpose", "rendered"), "expected one of default, render, proxy, guide"),
        (("stage.usda", "out.usda", "--glb", "out.obj"), "ends in .glb"),
        (("stage.usda", "out.usda", "--glb", "gone/out.glb"), "the folder 'gone' does not exist"),
        (("stage.usda", "out.usda", "--untrusted"), "--untrusted"),
        (("stage.usda", "out.usda", "-f", "3:9", "--strict"), "outside of its time codes 1 to 4"),
        (("gone.usda", "out.usda"), "gone.usda"),
    ],
)
def test_what_cannot_be_done_is_one_line(stage, call, tokens, expected):
    code, _, err = call(*tokens)
    assert code == 2
    assert expected in err
    errors = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert not Path("out.usda").exists()


def test_frames_outside_of_the_range_are_noted(stage, call):
    code, _, err = call(stage, "out.usda", "-f", "4:5")
    assert code == 0
    assert "1 of 2 frames lie outside of its time codes 1 to 4" in err


def test_hidden_mirrors_and_their_virtual_objects_make_the_same_picture(stage, call):
    """Rendered as real geometry, where the mirrors are hidden: the same prims at the same pixels, in their own colours."""
    assert call(stage, "out.usda", "--clip", "--purpose", "render", "--method", "auto")[0] == 0
    layer = Sdf.Layer.CreateNew("view.usda")
    layer.subLayerPaths.append("./out.usda")
    layer.defaultPrim = "World"
    for mirror in ("/World/Ball", "/World/Wall"):
        Sdf.AttributeSpec(
            Sdf.CreatePrimInLayer(layer, mirror), "visibility", Sdf.ValueTypeNames.Token
        ).default = "invisible"
    layer.Save()
    size = (160, 120)
    real, virtual = (wr.load_stage(name) for name in (stage, "view.usda"))
    expected = wr.render_frame(real, wr.make_plan(real, size=size, method="reference"))
    frame = wr.render_frame(virtual, wr.make_plan(virtual, size=size, method="reference"))
    opened = Usd.Stage.Open("view.usda")
    source_of = {str(mesh.GetPath()): sources(mesh.GetPrim())[1] for mesh in virtual_meshes(opened)}
    number = {path: k for k, path in real.prims.items()}
    own = np.zeros(len(virtual.prims) + 1)
    for k, path in virtual.prims.items():
        own[k] = number[source_of.get(path, path).removesuffix("/Half")]
    shown = own[frame["primId"].astype(int)]
    mirror = expected["reflectorId"] > 0
    wanted = np.where(mirror, expected["reflectedId"], expected["primId"])
    inner = interior(expected["reflectorId"]) & interior(wanted)
    assert (mirror & inner & (wanted > 0)).sum() > 300
    np.testing.assert_array_equal(shown[inner & ~mirror], wanted[inner & ~mirror])
    assert (shown == wanted)[inner & mirror].mean() > 0.995


def sample(points: np.ndarray, triangles: list, source: str = "/World/Box") -> VirtualSample:
    index = np.array(triangles, np.int32)
    return VirtualSample(Place("/World/Ball"), Place(source), 0, "quadric", points, index, (0.5, 0.5, 0.5))


def test_samples_are_interpolated_where_the_topology_stays_and_nowhere_else(stage):
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    one, other = [[0, 1, 2], [0, 2, 3]], [[0, 1, 3], [1, 2, 3]]
    layer = VirtualLayer.open(stage, Path("out.usda"), {"key": "k"}, "render", resume=False)
    for time, triangles in ((1.0, one), (4.0, other), (2.0, one), (3.0, other)):  # in no order
        layer.add(time, np.zeros(3), [sample(points + time, triangles)])
    layer.save()
    opened = Usd.Stage.Open("out.usda")
    (mesh,) = virtual_meshes(opened)
    for time, expected in ((1.5, 1.5), (2.0, 2.0), (2.5, 2.0), (3.0, 3.0), (3.5, 3.5)):
        np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get(time))[:4], points + expected, atol=1e-6)
    assert validation_errors("out.usda") == []


def test_names_of_different_places_differ():
    paths = [
        "/World/A/B",
        "/World/A__B",
        "/World/A",
        "/World/A/_B",
        "/World/A_/B",
        "/A/B",
        "/World/World/A",
        "/World/Å",
    ]
    places = [Place(path) for path in paths]
    places += [Place("/World/A", instance=each) for each in ("2", "12", "1/2", "inner 2")]
    places += [Place("/World/A", subset="C"), Place("/World/A__2")]
    for parent in ("/", "/World"):
        names = [place_name(each, parent) for each in places]
        assert len(set(names)) == len(names)
        assert all(Sdf.Path.IsValidIdentifier(name) for name in names)


def test_glb_of_a_z_up_stage_in_centimetres_is_y_up_in_metres(tmp_path):
    points, origin = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 3]]), np.array([1.0e6, -20.0, 30.0])
    write_glb(tmp_path / "out.glb", [("M", "A", points, np.array([[0, 1, 2]]), (0.2, 0.4, 0.6))], origin, "Z", 0.01)
    scene = trimesh.load(tmp_path / "out.glb", force="scene")
    transform, geometry = scene.graph["M/A"]
    loaded = trimesh.transform_points(scene.geometry[geometry].vertices, transform)
    world = points + origin
    np.testing.assert_allclose(loaded, 0.01 * np.stack([world[:, 0], world[:, 2], -world[:, 1]], 1), rtol=1e-7)


def test_layer_that_another_run_writes_is_left_to_it(stage, call):
    with pipeline.claimed(["out.usda"]):
        code, _, err = call(stage, "out.usda")
    assert code == 2
    assert "another process is writing it" in err
    assert not Path("out.usda").exists()
