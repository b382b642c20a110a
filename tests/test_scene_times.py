"""A scene at another time shares what does not move with the one before, and is the scene that is read there, to the bit."""

import numpy as np
import pytest

import warp_reflect as wr
from warp_reflect.stage.read import StageReader

STAGE = """#usda 1.0
(
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 9
)
def Xform "World"
{
    def Camera "Camera"
    {
        float2 clippingRange = (0.1, 100)
        float focalLength = 24
        double3 xformOp:translate.timeSamples = { 1: (0, 1.5, 8), 9: (0.5, 1.5, 8) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def DistantLight "Sun"
    {
        float inputs:intensity = 2
        float3 xformOp:rotateXYZ = (-50, 20, 0)
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    }
    def Material "Chrome"
    {
        token outputs:surface.connect = </World/Chrome/Surface.outputs:surface>
        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.9, 0.9, 0.9)
            float inputs:metallic = 1
            float inputs:roughness = 0
            token outputs:surface
        }
    }
    def Mesh "Floor"
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(-6, 0, 6), (6, 0, 6), (6, 0, -6), (-6, 0, -6)]
        color3f[] primvars:displayColor = [(0.8, 0.5, 0.3)]
    }
    def Cube "Still"
    {
        double size = 1
        double3 xformOp:translate = (-2, 0.5, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Chrome>
        double3 xformOp:translate.timeSamples = { 1: (0, 1, 0), 9: (2, 1, 1) }
        double xformOp:rotateY.timeSamples = { 1: 0, 9: 170 }
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
    }
    def Mesh "Tent" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Chrome>
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 2, 3, 0, 3, 1, 1, 3, 2]
        point3f[] points = [(0, 1, 0), (-1, 0, 1), (1, 0, 1), (0, 0, -1)]
        uniform token subdivisionScheme = "none"
        double3 xformOp:translate.timeSamples = { 1: (2, 0.1, 0), 9: (-1, 0.1, 2) }
        float3 xformOp:scale = (SCALE, 1, 1)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
    }
    def Xform "Cart"
    {
        double3 xformOp:translate.timeSamples = { 1: (-3, 0, 2), 9: (3, 0, 2) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Scope "Load"
        {
            def Cube "Box"
            {
                double size = 0.4
                double3 xformOp:translate.timeSamples = { 3: (0, 0.3, 0) }
                uniform token[] xformOpOrder = ["xformOp:translate"]
            }
            def Cube "Post"
            {
                double size = 0.2
                double3 xformOp:translate = (-2, 1.4, 0)
                uniform token[] xformOpOrder = ["!resetXformStack!", "xformOp:translate"]
            }
        }
    }
    def Mesh "Flag"
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points FLAG
    }
}
"""
ARRAYS = (
    "host_points",
    "host_normals",
    "host_triangles",
    "host_normal_index",
    "host_triangle_patch",
    "host_neighbours",
)


POINTS = "[(-4, 0, -3), (-3, 0, -3), (-3, 2, -3), (-4, 2, -3)]"
BENT = "[(-4, 0, -3), (-3, 0, -3), (-3, 2, -2), (-4, 2, -1)]"


def stage(folder, scale: str = "1", is_waving: bool = False, **changes: str) -> str:
    flag = f".timeSamples = {{ 1: {POINTS}, 9: {BENT} }}" if is_waving else f"= {POINTS}"
    text = STAGE.replace("SCALE", scale).replace("points FLAG", "points" + (flag if is_waving else f" {flag}"))
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "moving.usda"
    path.write_text(text)
    return str(path)


@pytest.fixture(params=[("1", False), ("-2", False), ("1", True)])
def path(request, tmp_path):
    return stage(tmp_path, *request.param)


def told(scene: wr.Scene) -> dict:
    """All that is known of a scene, asked for."""
    found = {name: getattr(scene, name) for name in ARRAYS}
    found |= {name: getattr(scene, name).numpy() for name in ("neighbours", "closed_patches", "triangle_records")}
    found |= {"patches": scene.view.patches.numpy(), "points": scene.view.points.numpy(), "size": np.array(scene.size)}
    found |= {f"box {k}": each for k, each in enumerate(scene.boxes)}
    for k, part in enumerate(scene.parts):
        body = scene.body(k)
        found[f"body {k}"] = np.concatenate(
            [body.centre, body.axes.reshape(-1), body.extent, [body.convex, body.closed]]
        )
        found[f"world {k}"] = part.world_from_object
    return found


def test_a_scene_from_another_time_is_the_one_read_there(path):
    scene = wr.load_stage(path, time=1.0)
    told(scene)
    for time in (4.0, 9.0, 1.0):
        scene = scene.at(time)
        fresh = told(wr.load_stage(path, time=time))
        for name, value in told(scene).items():
            np.testing.assert_array_equal(value, fresh[name], err_msg=f"{name} at {time}")


def test_what_stands_still_is_shared(path):
    first = wr.load_stage(path, time=1.0)
    told(first)
    second = first.at(5.0)
    assert second.host_triangles is first.host_triangles and second.view.triangles is first.view.triangles
    assert second.still_tracer is not second.tracer
    assert second.at(6.0).still_tracer is second.still_tracer
    ball, still = (
        next(k for k, part in enumerate(second.parts) if part.prim_path.endswith(name)) for name in ("Ball", "Still")
    )
    assert second.bodies[still] is first.bodies[still] and ball not in second.bodies


def test_places_alone_are_read_where_nothing_else_changes(tmp_path, monkeypatch):
    reader = StageReader(stage(tmp_path))
    first = reader.read(1.0)
    with monkeypatch.context() as patch:
        patch.setattr(StageReader, "_read", None)
        later = reader.read(6.0)
    fresh = StageReader(reader.path).read(6.0)
    assert len(later.instances) == len(fresh.instances) and later.meshes[0] is first.meshes[0]
    for ours, theirs in zip(later.instances, fresh.instances, strict=True):
        assert (ours.prim_path, ours.materials, ours.moves) == (theirs.prim_path, theirs.materials, theirs.moves)
        np.testing.assert_array_equal(ours.world_from_object, theirs.world_from_object)
    np.testing.assert_array_equal(later.cameras[0].world_from_camera, fresh.cameras[0].world_from_camera)
    assert later.notes == fresh.notes and later.time == 6.0


CHANGES = {
    "a light": {"float inputs:intensity = 2": "float inputs:intensity.timeSamples = { 1: 2, 9: 5 }"},
    "a material": {"float inputs:roughness = 0": "float inputs:roughness.timeSamples = { 1: 0, 9: 0.1 }"},
    "what is seen": {
        "double size = 1": 'double size = 1\n token visibility.timeSamples = { 1: "inherited", 9: "invisible" }'
    },
    "a place that cannot be": {"9: (2, 1, 1) }": "5: (nan, 1, 1), 9: (2, 1, 1) }"},
    "no camera": {'def Camera "Camera"': 'def Xform "Camera"'},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_stage_that_changes_otherwise_is_read_whole(change, tmp_path):
    reader = StageReader(stage(tmp_path, **change))
    reader.read(1.0)
    for time in (5.0, 9.0):
        later, fresh = reader.read(time), StageReader(reader.path).read(time)
        assert [each.prim_path for each in later.instances] == [each.prim_path for each in fresh.instances]
        assert later.materials == fresh.materials and later.notes == fresh.notes
        assert [each.color for each in later.lights] == [each.color for each in fresh.lights]
        np.testing.assert_array_equal(later.cameras[0].world_from_camera, fresh.cameras[0].world_from_camera)


def test_a_stage_in_which_all_moves_has_its_own_frame_at_every_time(tmp_path):
    text = {
        "point3f[] points = [(-6": "double xformOp:rotateY.timeSamples = { 1: 0, 9: 5 }\n"
        '        uniform token[] xformOpOrder = ["xformOp:rotateY"]\n        point3f[] points = [(-6',
        'def Cube "Still"': 'over "Still"',
        'def Mesh "Flag"': 'over "Flag"',
        'def Cube "Post"': 'over "Post"',
    }
    path = stage(tmp_path, **text)
    scene = wr.load_stage(path, time=1.0)
    assert all(each.moves for each in scene.data.instances)
    told(scene)
    scene = scene.at(7.0)
    fresh = told(wr.load_stage(path, time=7.0))
    for name, value in told(scene).items():
        np.testing.assert_array_equal(value, fresh[name], err_msg=name)


@pytest.mark.parametrize(
    "settings",
    [{}, {"shadows": "off", "refine": "strict"}, {"environment_update": "frame", "environment_resolution": 64}],
)
def test_frames_of_shared_scenes_are_those_of_fresh_ones(path, settings):
    asked = wr.Settings(**settings)
    method = "environment" if "environment_update" in settings else "auto"
    scene = wr.load_stage(path, time=1.0)
    plan = wr.make_plan(scene, size=(96, 64), settings=asked, method=method)
    frame = wr.render_frame(scene, plan)
    for time in (5.0, 9.0):
        scene = scene.at(time)
        plan = plan.at(scene)
        frame = wr.render_frame(scene, plan, previous=frame)
        other = wr.load_stage(path, time=time)
        fresh = wr.render_frame(other, wr.make_plan(other, size=(96, 64), settings=asked, method=method))
        assert [(r.path, r.technique, r.pixels) for r in plan.rows] == [
            (r.path, r.technique, r.pixels) for r in fresh.plan.rows
        ]
        for name in ("RGBA", "reflectedPoint", "reflectedId", "status"):
            np.testing.assert_array_equal(frame[name], fresh[name], err_msg=f"{name} at {time}")
