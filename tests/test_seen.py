"""Boxes of objects seen in mirrors, ST maps, and channels on the device, on scenes with known answers."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import warp as wp
from rooms import CHROME, placed, plane_room, render, sphere, square

import warp_reflect as wr
from warp_reflect import cli, images, seen
from warp_reflect.scene import CameraData, InstanceData, MaterialData, Scene, SceneData

SIZE = (200, 120)
EYE = np.array([0.1, 0.3, 4.0])
BALLS = {"/left": np.array([-1.0, 0.2, 1.0]), "/right": np.array([1.2, 0.6, 0.0])}
RADIUS = 0.3
FLOOR = -1.0


def two_balls(projection="perspective", pitch=0.0, **camera) -> Scene:
    """A mirror at z = -2 that faces the eye, a floor and two balls."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    turn[2, 3] = -2.0
    plain = dataclasses.replace(sphere(48, 96), parts=[])
    instances = [InstanceData(0, turn, "/mirror", (0,)), InstanceData(1, placed(0, FLOOR, 0), "/floor", (1,))]
    instances += [InstanceData(2, placed(*at, RADIUS), path, (1,)) for path, at in BALLS.items()]
    cosine, sine = np.cos(pitch), np.sin(pitch)
    world_from_camera = placed(*EYE)
    world_from_camera[1:3, 1:3] = [[cosine, -sine], [sine, cosine]]
    view = CameraData("/camera", world_from_camera, projection, near=0.05, focal_length=22.0, **camera)
    meshes = [square(2, 2.5), square(12, 6.0), plain]
    return Scene(SceneData("balls", meshes, instances, [CHROME, MaterialData()], [], [view]))


def mirrored(point: np.ndarray) -> np.ndarray:
    return point * [1, 1, -1] + [0, 0, -4.0]


def sphere_span(across: float, depth: float) -> np.ndarray:
    """Tangents of the two lines of sight, in a plane through the eye, that touch a sphere of RADIUS."""
    middle, half = np.arctan2(across, depth), np.arcsin(RADIUS / np.hypot(across, depth))
    return np.tan([middle - half, middle + half])


@pytest.mark.parametrize("method", ["planar", "reference"])
def test_boxes_of_balls_in_a_plane_are_those_of_their_images(method):
    frame = render(two_balls(), method, size=SIZE)
    found = {each["object"]: each for each in seen.seen_objects(frame)}
    assert found.keys() == {"/left", "/right", "/floor"}
    camera = frame.camera
    for path, centre in BALLS.items():
        away = mirrored(centre) - EYE
        x = camera.fx * sphere_span(away[0], -away[2]) + camera.cx
        y = camera.cy - camera.fy * sphere_span(away[1], -away[2])[::-1]
        left, top, width, height = found[path]["bbox"]
        np.testing.assert_allclose([left, left + width], x, atol=1.0)
        np.testing.assert_allclose([top, top + height], y, atol=1.0)
        np.testing.assert_allclose(found[path]["area"], np.pi / 4 * width * height, rtol=0.1)
        distance = np.linalg.norm(away)
        assert distance - RADIUS < found[path]["pathLength"] < distance
        assert (found[path]["mirror"], found[path]["mirrorId"]) == ("/mirror", 1)


def test_boxes_count_every_mirror_pixel_once():
    frame = render(plane_room(), "planar", size=SIZE)
    boxes = seen.seen_objects(frame)
    assert sum(each["area"] for each in boxes) == (frame["reflectedId"] > 0).sum()
    for each in boxes:
        rows, columns = np.nonzero((frame["reflectedId"] == each["objectId"]) & (frame["reflectorId"] == 1))
        x, y, width, height = each["bbox"]
        assert (columns.min(), rows.min()) == (x, y)
        assert (columns.max(), rows.max()) == (x + width - 1, y + height - 1)


def test_coco_file_refers_to_what_it_holds():
    frame = render(two_balls(), "planar", size=SIZE)
    boxes = json.loads(json.dumps(seen.coco_boxes(frame, 7, "a.png"), allow_nan=False))
    assert boxes["images"] == [
        {"id": 7, "width": 200, "height": 120, "file_name": "a.png", "camera": "/camera", "time": None}
    ]
    names = {each["id"]: each["name"] for each in boxes["categories"]}
    assert names == frame.prims
    assert {names[each["category_id"]] for each in boxes["annotations"]} == {"/left", "/right", "/floor"}
    assert all(each["image_id"] == 7 for each in boxes["annotations"])
    assert len({each["id"] for each in boxes["annotations"]}) == 3


# ST maps.


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_st_map_leads_to_where_the_floor_is_seen_directly(projection):
    parallel = projection == "orthographic"
    tilted = {"pitch": -0.15, "horizontal_aperture": 60.0, "vertical_aperture": 36.0} if parallel else {}
    frame = render(two_balls(projection, **tilted), "reference", size=SIZE)
    width, height = SIZE
    camera = frame.camera
    image = seen.st_map(frame)
    row, column = np.nonzero(frame["reflectedId"] == 2)
    assert len(row) > 1000
    point = frame["reflectedPoint"][row, column].astype(float)
    away = point - EYE
    depth = away @ camera.forward
    scale = 1.0 if parallel else depth
    x, y = camera.fx * (away @ camera.right) / scale + camera.cx, camera.cy - camera.fy * (away @ camera.up) / scale
    start = point - depth[:, None] * camera.forward if parallel else np.broadcast_to(EYE, point.shape)
    along = (point - start) / np.linalg.norm(point - start, axis=1, keepdims=True)
    closest = np.full(len(point), np.inf)
    for centre in BALLS.values():
        t = np.maximum(np.einsum("ij,ij->i", centre - start, along), 0.0)
        t = np.minimum(t, np.linalg.norm(point - start, axis=1))
        closest = np.minimum(closest, np.linalg.norm(start + t[:, None] * along - centre, axis=1))
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height) & (depth > 0)
    sure = np.abs(closest - RADIUS) > 0.01
    expected = inside & (closest > RADIUS)
    np.testing.assert_array_equal(image[row, column, 3][sure] > 0, expected[sure])
    shown = image[row, column, 3] > 0
    assert 100 < shown.sum() < len(row)
    np.testing.assert_allclose(image[row, column, 0][shown], (x / width)[shown], atol=1e-5)
    np.testing.assert_allclose(image[row, column, 1][shown], (1.0 - y / height)[shown], atol=1e-5)


def test_st_map_is_empty_where_the_far_side_is_seen():
    """What the mirror shows of the balls is turned away from the eye."""
    frame = render(two_balls(), "reference", size=SIZE)
    image = seen.st_map(frame)
    assert (image[frame["reflectedId"] == 0] == 0).all()
    for number, path in frame.prims.items():
        if path not in BALLS:
            continue
        own = frame["reflectedId"] == number
        normal = frame["reflectedPoint"][own] - BALLS[path]
        turned = np.einsum("ij,ij->i", normal / RADIUS, EYE - frame["reflectedPoint"][own]) < -0.1
        assert turned.sum() > 30
        assert (image[own][turned] == 0).all()


def test_st_map_file_warps_as_it_says(tmp_path):
    """OpenImageIO's st_warp looks a ramp up at the very places; the file says how."""
    frame = render(two_balls(), "planar", size=SIZE)
    path = tmp_path / "st.exr"
    seen.write_st_map(path, frame)
    width, height = SIZE
    file = oiio.ImageBuf(str(path))
    assert list(file.spec().channelnames) == ["R", "G", "B", "A"]
    assert file.spec().format == oiio.FLOAT
    assert "flip_t" in images.read_exr(path)[1]["warp_reflect:st"]
    y, x = np.mgrid[:height, :width] + 0.5
    ramp = oiio.ImageBuf(oiio.ImageSpec(width, height, 3, oiio.FLOAT))
    ramp.set_pixels(oiio.ROI(), np.stack([x, y, 0 * x], -1).astype(np.float32))
    warped = oiio.ImageBufAlgo.st_warp(ramp, file, "triangle", 0.0, 0, 1, False, True)
    looked = np.asarray(warped.get_pixels(oiio.FLOAT))
    image = seen.st_map(frame)
    s, t = image[..., 0] * width, (1.0 - image[..., 1]) * height
    sure = (image[..., 3] > 0) & (np.abs(s - 0.5 * width) < 0.48 * width) & (np.abs(t - 0.5 * height) < 0.47 * height)
    assert sure.sum() > 100
    np.testing.assert_allclose(looked[sure][:, 0], s[sure], atol=0.51)
    np.testing.assert_allclose(looked[sure][:, 1], t[sure], atol=0.51)


# The command.


@pytest.fixture
def call(tmp_path, monkeypatch, capfd, device):
    """Run `render` of a stage in an empty folder: (exit code, standard output, standard error)."""
    from test_process import write_stage

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    write_stage(tmp_path / "stage.usda")

    def run(*tokens) -> tuple[int, str, str]:
        capfd.readouterr()
        code = cli.main(["render", "stage.usda", *tokens, "--res", "120x90", "--device", device])
        return code, *capfd.readouterr()

    return run


def test_render_writes_boxes_and_st_maps_of_every_frame(call):
    sides = ("--boxes", "boxes.##.json", "--st-map", "st.##.exr")
    code, _, err = call("out.##.png", "-f", "1:2", *sides)
    assert code == 0, err
    for number in (1, 2):
        boxes = seen.read_boxes(f"boxes.{number:02}.json")
        assert boxes["images"][0]["file_name"] == f"out.{number:02}.png"
        assert (boxes["images"][0]["id"], boxes["images"][0]["time"]) == (number, number)
        names = {each["id"]: each["name"] for each in boxes["categories"]}
        shown = {(each["mirror"]["path"], names[each["category_id"]]) for each in boxes["annotations"]}
        assert ("/World/Wall", "/World/Box") in shown
        assert set(images.read_exr(f"st.{number:02}.exr")[0]) == set("RGBA")
    code, _, err = call("out.##.png", "-f", "1:2", *sides, "--resume")
    assert "2 of 2 frames are done" in err
    Path("boxes.02.json").write_text("{}")
    code, _, err = call("out.##.png", "-f", "1:2", *sides, "--resume")
    assert code == 0
    assert "1 of 2 frames are done" in err
    assert seen.read_boxes("boxes.02.json")["annotations"]


def test_boxes_can_be_the_only_output(call):
    code, _, err = call("--boxes", "boxes.json")
    assert code == 0, err
    assert seen.read_boxes("boxes.json")["images"][0]["file_name"] == ""


@pytest.mark.parametrize(
    ("tokens", "expected"),
    [
        (("--boxes", "boxes.xml"), "--boxes: got 'boxes.xml', expected a name that ends in .json"),
        (("--st-map", "st.png"), "--st-map: got 'st.png', expected a name that ends in .exr"),
        (("--boxes", "gone/boxes.json"), "the folder 'gone' does not exist"),
        (("--boxes", "boxes.json", "-f", "1:2"), "expected exactly one frame number"),
    ],
)
def test_side_files_that_cannot_be_are_refused(call, tokens, expected):
    code, _, err = call("out.exr", *tokens)
    assert code == 2
    assert expected in err
    assert not Path("out.exr").exists()


# Channels on the device.


def test_device_arrays_are_the_channels_without_a_copy(device):
    data = two_balls().data
    scene = Scene(data, device)
    plan = wr.make_plan(scene, size=SIZE, method="planar")
    first = wr.render_frame(scene, plan)
    eye = dataclasses.replace(first.camera, eye=first.camera.eye + [0.05, 0.0, 0.0])
    frame = wr.render_frame(scene, plan, camera=eye, previous=first)
    for name in frame.keys():
        array = frame.device_array(name)
        assert array.device == wp.get_device(device)
        assert array.shape == SIZE[::-1]
        expected = frame.relative(name) if name in ("mirrorPoint", "reflectedPoint") else frame[name]
        np.testing.assert_array_equal(array.numpy().astype(np.float32), expected, err_msg=name)
        assert frame.device_array(name).ptr == array.ptr
    assert np.abs(frame["reflectionMotion"]).max() > 0.5
    if scene.device.is_cpu:
        motion = frame.device_array("reflectionMotion")
        assert np.from_dlpack(motion).__array_interface__["data"][0] == motion.ptr
    with pytest.raises(KeyError, match=r"N\.X"):
        frame.device_array("N.X")


def test_simulator_loop_measures_the_mirrors_motion(capsys):
    """Of a sphere moved sideways by d the image of what is far moves by d, as its centre does."""
    path = Path(__file__).resolve().parents[1] / "tools" / "moving_mirror.py"
    spec = importlib.util.spec_from_file_location("moving_mirror", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    frame = example.main(steps=2)
    told = capsys.readouterr().out.splitlines()
    assert "up to 0.00 px" in told[0]
    motion = frame["reflectionMotion"][..., 0][frame["reflectedId"] > 0]
    centre = frame.scene.data.instances[0].world_from_object[:3, 3] - frame.camera.eye
    expected = 0.02 * frame.camera.fx / (centre @ frame.camera.forward)
    assert 0.3 * expected < np.median(motion) < 1.5 * expected
