"""A scene at another time shares what does not move with the one before, and is the scene that is read there, to the bit."""

import numpy as np
import pytest

import warp_reflect as wr

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
        double3 xformOp:translate = (0, 1.5, 8)
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
    def Mesh "Flag"
    {
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points.timeSamples = {
            1: [(-4, 0, -3), (-3, 0, -3), (-3, 2, -3), (-4, 2, -3)],
            9: [(-4, 0, -3), (-3, 0, -3), (-3, 2, -2), (-4, 2, -1)],
        }
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


@pytest.fixture(params=["1", "-2"])
def path(request, tmp_path):
    stage = tmp_path / "moving.usda"
    stage.write_text(STAGE.replace("SCALE", request.param))
    return str(stage)


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
    flag = next(k for k, part in enumerate(second.parts) if part.prim_path.endswith("Flag"))
    still = next(k for k, part in enumerate(second.parts) if part.prim_path.endswith("Still"))
    assert second.bodies[still] is first.bodies[still] and flag not in second.bodies


@pytest.mark.parametrize("settings", [{}, {"shadows": "off", "refine": "strict"}, {"environment_update": "frame"}])
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
