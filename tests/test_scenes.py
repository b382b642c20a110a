"""Every scene of `usd_scenes/` against what its own layer expects of a renderer; a scene added is a test added."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf

import warp_reflect as wr
from warp_reflect.channels import CHANNELS, known_names
from warp_reflect.metrics import PixelClass
from warp_reflect.techniques import TECHNIQUES

FOLDER = Path(__file__).resolve().parents[1] / "usd_scenes"
SCENES = sorted(path.stem for path in FOLDER.glob("*.usda"))
SIZE = (160, 90)
AUTO_SIZE = (640, 360)  # so many pixels that the planner does not trace them all
INTERIOR_MIN = 1000  # pixels; a share of fewer says nothing about a thousandth
RESIDUAL_MAX = 1.0e-3  # sine of the reflection-law error
WARM_MIN = 0.9999  # share of pixels that a start from the last frame leaves as they were


@dataclass(frozen=True)
class Expectations:
    """What a scene's layer says under `customLayerData["warp_reflect"]`."""

    techniques: tuple[str, ...]  # each taken by one mirror at least where it is asked for
    allowed: tuple[str, ...]  # may be taken as well; one that is in neither is taken by no mirror
    reflectors: tuple[str, ...]
    min_identical: float  # share of the interior mirror pixels
    max_error_px: float  # of the pixels that are not identical


def expectations(name: str) -> Expectations:
    data = Sdf.Layer.FindOrOpen(str(FOLDER / f"{name}.usda")).customLayerData["warp_reflect"]
    return Expectations(
        tuple(data["techniques"]),
        tuple(data["allowed"]),
        tuple(data["reflectors"]),
        data["min_identical"],
        data["max_error_px"],
    )


BASELINES = {
    "explosion_map",
    "environment",
    "layered_environment",
}  # show no exact hits: compared in tests of their own


@functools.cache
def loaded(name: str, device: str) -> wr.Scene:
    return wr.load_stage(str(FOLDER / f"{name}.usda"), device=device)


def rendered(name: str, device: str, method: str, threads: int = 0, size: tuple[int, int] = SIZE) -> wr.Frame:
    return frame_of(name, device, method, threads, size)


@functools.cache
def frame_of(name: str, device: str, method: str, threads: int, size: tuple[int, int]) -> wr.Frame:
    """Without defaults: calls that give them and calls that leave them out would each be rendered."""
    scene = loaded(name, device)
    plan = wr.make_plan(scene, size=size, settings=wr.Settings(threads=threads, keep_static=False), method=method)
    return wr.render_frame(scene, plan)


def triangles_seen(frame: wr.Frame) -> np.ndarray:
    """The triangle each pixel shows in its mirror, int32 [height, width]; -1 the sky, -2 no mirror."""
    width, height = frame.camera.size
    image = np.full(width * height, -2, np.int32)
    for layer in frame.layers.values():
        image[layer.pixels.pixel.numpy()] = layer.triangle.numpy()
    return image.reshape(height, width)


def test_every_scene_says_what_it_expects():
    assert len(SCENES) >= 14
    for name in SCENES:
        expected = expectations(name)
        assert expected.techniques and expected.reflectors, name
        assert 0.99 <= expected.min_identical <= 1.0, name
        assert 0.0 < expected.max_error_px <= 0.5, name


def compared_frames() -> list[tuple[str, str, tuple[int, int]]]:
    """(scene, method, size): every scene as planned, and by every technique that it lists or allows."""
    cases = []
    for name in SCENES:
        expected = expectations(name)
        cases.append((name, "auto", AUTO_SIZE))
        cases += [(name, how, SIZE) for how in TECHNIQUES if how in (*expected.techniques, *expected.allowed)]
    return [case for case in cases if case[1] != "raytraced"]


@pytest.mark.parametrize(("name", "method", "size"), compared_frames())
def test_scene_shows_what_the_reference_shows(name, method, size, device, leave_images):
    expected = expectations(name)
    frame, reference = (rendered(name, device, how, size=size) for how in (method, "reference"))
    compared = wr.compare_frames(frame, reference)
    assert compared.interior_pixels >= INTERIOR_MIN
    share = compared.share(compared.identical)
    if share < expected.min_identical or compared.error_max_px > expected.max_error_px:
        where = leave_images(frame["RGBA"][..., :3], reference["RGBA"][..., :3], f"{name}_{method}")
        different = (compared.classes > PixelClass.BORDER) & (compared.classes != PixelClass.IDENTICAL)
        pixels = np.argwhere(different)[:10, ::-1].tolist()
        pytest.fail(
            f"{name}, {method}: {share:.5f} identical of {expected.min_identical}, first others at (x, y) {pixels}; "
            f"{where}\n{compared}"
        )


@pytest.mark.parametrize("method", ["auto", "reflector_map", "reference"])
@pytest.mark.parametrize("name", SCENES)
def test_scene_fills_every_channel_with_possible_values(name, method, device):
    frame = rendered(name, device, method)
    width, height = SIZE
    assert set(frame.keys()) == set(CHANNELS)
    for channel in known_names():
        image = frame[channel]
        parts = len(CHANNELS.get(channel, ("",)))
        assert image.shape == ((height, width) if parts == 1 else (height, width, parts)), channel
        assert image.dtype == np.float32, channel
        assert np.isfinite(image).all(), channel
    mirror = frame["reflectorId"] > 0
    status = frame["status"]
    assert (status[~mirror] == wr.Status.NONE).all()
    assert (status[mirror] != wr.Status.NONE).all()
    assert set(np.unique(status)) <= set(wr.Status)
    for channel in ("reflectedId", "mirrorPoint", "reflectedPoint", "reflection", "pathLength", "residual", "method"):
        assert not frame[channel][~mirror].any(), channel
    assert set(np.unique(frame["primId"])) - {0} <= frame.prims.keys()
    assert set(np.unique(frame["reflectedId"])) - {0} <= frame.prims.keys()
    assert set(np.unique(frame["method"])) <= set(wr.Technique)
    assert frame["residual"].max() <= RESIDUAL_MAX
    hit = frame["reflectedId"] > 0
    assert (frame["pathLength"][hit] > 0).all()
    assert (status[hit] == wr.Status.CONVERGED).all()


@pytest.mark.parametrize("name", SCENES)
def test_scene_has_the_mirrors_it_lists_and_shows_them(name, device):
    frame = rendered(name, device, "reference")
    assert sorted(row.path for row in frame.plan.rows) == sorted(expectations(name).reflectors)
    seen = {frame.reflectors[int(number)] for number in np.unique(frame["reflectorId"]) if number > 0}
    mirrored = {frame.prims[int(number)] for number in np.unique(frame["reflectedId"]) if number > 0}
    reflectors = set(expectations(name).reflectors)
    assert seen and seen | (mirrored & reflectors) == reflectors


@pytest.mark.parametrize("name", SCENES)
def test_scene_takes_the_techniques_it_lists(name, device):
    expected = expectations(name)
    assert set(expected.techniques) <= TECHNIQUES.keys()
    for method in TECHNIQUES.keys() - BASELINES:
        plan = wr.make_plan(loaded(name, device), size=SIZE, method=method)
        taken = [row for row in plan.rows if row.technique == method and row.forced]
        why = method, [(row.path, row.reason) for row in plan.rows]
        assert taken or method not in expected.techniques, why
        assert not taken or method in (*expected.techniques, *expected.allowed), why
        if method not in expected.techniques:
            continue
        frame = rendered(name, device, method)
        number = wr.Technique[method.upper()]
        methods = frame["method"]
        paths = {row.path for row in taken}
        for row in frame.plan.rows:
            own = methods[frame["reflectorId"] == row.reflector.id]
            assert (own == (number if row.path in paths else wr.Technique.RAYTRACED)).all(), (method, row.path)
        noted = {note.path for note in frame.plan.notes}
        assert {row.path for row in frame.plan.rows} - paths <= noted


def test_body_with_sharp_rims_is_mapped_in_pieces_beside_one_that_is_whole(device):
    rows = {row.path: row for row in rendered("capped_cylinder", device, "reflector_map").plan.rows}
    assert all(row.technique == "reflector_map" and row.forced for row in rows.values())
    assert "3 pieces hold 100 %" in rows["/World/Cylinder"].reason and "2 planar" in rows["/World/Cylinder"].reason
    assert "closed convex" in rows["/World/Capsule"].reason


@pytest.mark.parametrize("method", ["reference", "reflector_map"])
def test_picture_does_not_change_far_from_the_origin(method, device, leave_images):
    near, far = rendered("sphere_on_checker", device, method), rendered("far_offset", device, method)
    assert np.linalg.norm(far.camera.eye - near.camera.eye) > 1e7
    assert near.prims == far.prims
    if not np.array_equal(near["reflectedId"], far["reflectedId"]):
        where = leave_images(far["RGBA"][..., :3], near["RGBA"][..., :3], f"far_{method}")
        pixels = np.argwhere(near["reflectedId"] != far["reflectedId"])[:, ::-1].tolist()
        pytest.fail(f"reflectedId differs at (x, y) {pixels}; {where}")
    delta = np.linalg.norm(far.relative("reflectedPoint") - near.relative("reflectedPoint"), axis=-1)
    assert (delta <= 1e-4 * near["pathLength"]).all()
    assert (near["reflectedId"] > 0).sum() >= INTERIOR_MIN


@pytest.mark.parametrize("method", ["reference", "reflector_map"])
def test_threads_do_not_change_a_pixel(method, device):
    one, two = (rendered("kitchen", device, method, threads) for threads in (1, 2))
    np.testing.assert_array_equal(triangles_seen(one), triangles_seen(two))
    assert (triangles_seen(one) >= 0).sum() >= INTERIOR_MIN
    for channel in CHANNELS:
        np.testing.assert_array_equal(one[channel], two[channel], err_msg=channel)


@pytest.mark.parametrize("name", SCENES)
def test_start_from_the_last_frame_keeps_the_picture(name, device):
    cold = rendered(name, device, "reflector_map")
    warm = wr.render_frame(cold.scene, cold.plan, previous=cold)
    before, after = triangles_seen(cold), triangles_seen(warm)
    mirror = before > -2
    np.testing.assert_array_equal(mirror, after > -2)
    share = np.mean(before[mirror] == after[mirror])
    pixels = np.argwhere(before != after)[:10, ::-1].tolist()
    assert share >= WARM_MIN, f"{share:.5f} of {mirror.sum()} pixels show the same triangle; others at (x, y) {pixels}"
