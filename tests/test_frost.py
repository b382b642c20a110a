"""Fades and frost by distance: against what the distances say, against averaged rays, and what is off costs nothing."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from panes import GLASS, SIZE, WHITE, balls, eye_rays, frame, stage, upright, with_finish
from rooms import CHROME, placed, sphere, square

import warp_reflect as wr
from warp_reflect.scene import MaterialData

CLEAR = MaterialData(opacity=0.5, roughness=1.0, specular_workflow=True, base_color=(0.0,) * 3)


def in_cone(frame_, part_id=2):
    return frame_["primId"] == part_id


@pytest.mark.parametrize("by", ["stage", "settings"])
def test_what_a_mirror_shows_fades_with_the_length_of_the_reflected_ray(by):
    wall, at = upright(-2.0, 2.0)
    asked = {"fade_distance": 3.0}
    color = (0.0, 0.2, 0.5) if by == "stage" else (0.25,) * 3
    if by == "stage":
        material, settings = with_finish(CHROME, fade_color=color, **asked), {}
    else:
        material, settings = CHROME, {"fade_grey": 0.25, **asked}
    plain = frame(stage((wall, at, CHROME)))
    faded = frame(stage((wall, at, material)), **settings)
    mirror = plain["reflectorId"] > 0
    eye, _ = eye_rays(plain.camera)
    to_mirror = np.linalg.norm(plain["mirrorPoint"] - eye, axis=-1)
    way = np.where(plain["reflectedId"] > 0, plain["pathLength"] - to_mirror, np.inf)
    share = np.exp(-way / 3.0)[..., None]
    weight = np.float32(0.9)
    expected = share * plain["reflection"] + (1.0 - share) * weight * np.float32(color)
    assert (plain["reflectedId"][mirror] > 0).any() and (plain["reflectedId"][mirror] == 0).any()
    np.testing.assert_allclose(faded["reflection"][mirror], expected[mirror], atol=2e-3)
    assert "to 1/e over 3" in faded.plan.rows[0].effects["fade"].reason


def test_what_is_behind_glass_fades_to_white_behind_every_pane_in_mirrors_too():
    pane, world = upright(1.0)
    glass = with_finish(CLEAR, frost_distance=4.0, frost_color=(0.9, 0.8, 0.7))
    plain, faded = frame(stage()), frame(stage((pane, world, glass)))
    inner = faded["primId"] == 2
    eye, d = eye_rays(plain.camera)
    floor = inner & (plain["primId"] == 1)
    way = (-1.0 - eye[1]) / d[..., 1] - (1.0 - eye[2]) / d[..., 2]
    share = np.where(floor, np.exp(-np.where(floor, way, 0.0) / 4.0), 0.0)[..., None]
    expected = 0.5 * (share * plain["RGBA"][..., :3] + (1.0 - share) * np.float32([0.9, 0.8, 0.7]))
    assert floor.sum() > 1000
    np.testing.assert_allclose(faded["RGBA"][..., :3][inner], expected[inner], atol=2e-3)
    # Two such panes: the way behind the first fades as one, whatever is on it.
    second, between = upright(0.0)
    twice = frame(stage((pane, world, glass), (second, between, CLEAR)))
    covered = floor & (np.abs(eye[0] - d[..., 0] / d[..., 2] * eye[2]) < 0.9)
    covered &= np.abs(eye[1] - d[..., 1] / d[..., 2] * eye[2]) < 0.9
    first = np.exp((1.0 - 0.0) / d[..., 2] / 4.0)[..., None]  # to the second pane
    color = np.float32([0.9, 0.8, 0.7])
    behind = share * plain["RGBA"][..., :3] + (first - share) * color
    expected = 0.5 * ((1.0 - first) * color + 0.5 * behind)
    assert covered.sum() > 300
    np.testing.assert_allclose(twice["RGBA"][..., :3][covered], expected[covered], atol=2e-3)
    # Seen in a mirror.
    wall, at = upright(-2.0, 2.0)
    pane, between = upright(0.5, 0.5)
    between[0, 3] = 1.2
    bare, veiled = (frame(stage((wall, at, CHROME), (pane, between, each))) for each in (CLEAR, glass))
    seen = (veiled["reflectorId"] > 0) & (veiled["reflectedId"] == 3)
    assert seen.sum() > 50
    assert (np.abs(veiled["reflection"] - bare["reflection"])[seen].max(axis=1) > 0.02).mean() > 0.9


def frosted(half_angle, **finish):
    return with_finish(dataclasses.replace(GLASS, roughness=0.5), frost=half_angle, **finish)


def test_frost_blurs_as_the_mean_of_the_rays_does():
    """Within 0.015 of radiance, and a fifth of what clear glass is off, of 64 averaged rays."""
    pane, world = upright(1.0)
    things = [(pane, world, frosted(6.0)), *balls()]
    blurred, averaged = (frame(stage(*things), (320, 180), frost_samples=n) for n in (0, 64))
    clear = frame(stage((pane, world, frosted(1e-6)), *balls()), (320, 180))
    inner = blurred["primId"] == 2
    assert inner.sum() > 5000
    error, of_clear = (np.abs(each["RGBA"] - averaged["RGBA"])[inner].mean() for each in (blurred, clear))
    assert error < 0.015
    assert error < 0.2 * of_clear
    np.testing.assert_array_equal(blurred["RGBA"][~inner], averaged["RGBA"][~inner])


def test_rays_tell_what_cones_see_past_the_pane():
    """A pane half as wide as its cones: at most half as far off as the blurred picture alone, the same at any threads."""
    pane, world = upright(1.0, 0.5)
    things = [(pane, world, frosted(20.0)), *balls()]
    asked = [{"frost_rays": 0}, {"threads": 1}, {"threads": 2}, {"frost_samples": 128}]
    alone, corrected, again, averaged = (frame(stage(*things), (160, 90), **settings) for settings in asked)
    inner = averaged["primId"] == 2
    assert inner.sum() > 300
    error, of_alone = (np.abs(each["RGBA"] - averaged["RGBA"])[inner].mean() for each in (corrected, alone))
    assert error < 0.5 * of_alone, (error, of_alone)
    np.testing.assert_array_equal(corrected["RGBA"], again["RGBA"])
    assert "(frost_rays)" in corrected.plan.panes[0].effects["frost"].reason
    assert "(frost_rays)" not in alone.plan.panes[0].effects["frost"].reason


@pytest.mark.parametrize("samples", [0, 32])
def test_frost_grows_with_distance_behind_the_pane(samples):
    """A black wall's edge against the sky, near the pane and far behind it: widths of the edges are their cones'."""
    black = MaterialData(base_color=(0.0,) * 3, specular_workflow=True, roughness=1.0)
    pane, world = upright(1.0)
    widths = []
    for z in (0.9, -3.0):
        wall, at = upright(z, 50.0)
        at[0, 3] = 50.1  # its edge in the middle of the picture
        shown = frame(
            stage((pane, world, frosted(5.0)), (wall, at, black), floor=False), (320, 180), frost_samples=samples
        )
        row = shown["RGBA"][90, :, 0]
        row = row[shown["primId"][90] == 1]
        row = (row - row.min()) / np.ptp(row)
        widths.append(((row > 0.1) & (row < 0.9)).sum())
        radius = shown.camera.fx * np.tan(np.radians(5.0)) * (1.0 - z) / (4.0 - z)
        # Over a disc the mean goes from 0.1 to 0.9 within 1.37 radii.
        assert widths[-1] == pytest.approx(1.37 * radius, abs=max(2.5, 0.35 * radius))
    assert widths[1] > 4 * widths[0]


def test_frost_comes_from_the_roughness_where_nothing_is_asked_and_from_settings():
    pane, world = upright(1.0)
    rough = dataclasses.replace(GLASS, roughness=0.5)
    effects = {
        key: wr.make_plan(stage((pane, world, material)), size=SIZE, settings=wr.Settings(**settings)).panes[0].effects
        for key, material, settings in (
            ("clear", GLASS, {}),
            ("rough", rough, {}),
            ("asked", GLASS, {"frost": 3.0}),
            ("small", GLASS, {"frost": 3.0, "frost_px": 100.0}),
            ("absent", dataclasses.replace(CLEAR, roughness=0.5), {"frost": 3.0}),
        )
    }
    assert [key for key, each in effects.items() if each["frost"].on] == ["rough", "asked"]
    # atan(sqrt(2) (1.5 - 1) 0.25)
    assert effects["rough"]["frost"].numbers["angle"] == pytest.approx(10.02, abs=0.01)
    assert "(frost_px)" in effects["small"]["frost"].reason


@pytest.mark.parametrize("samples", [0, 16])
@pytest.mark.parametrize("body", ["ball", "pane"])
def test_white_furnace_stays_white_behind_frost(body, samples):
    thing = (sphere(), placed(0, 0, 0, 0.8)) if body == "ball" else upright(0.0)
    scene = stage((*thing, frosted(20.0, frost_distance=2.0)), floor=False)
    rgb = frame(scene, frost_samples=samples)["RGBA"][..., :3]
    assert rgb.max() <= 1.0 + 1e-3
    if body == "pane":
        np.testing.assert_allclose(rgb, 1.0, atol=1e-3)


def test_frost_is_finite_whatever_it_meets():
    """At an edge of the frame, an orthographic eye, a pane of few pixels, one in front of nothing, one behind one."""
    pane, world = upright(3.9, 0.02)
    near, at = upright(1.0, 30.0)
    for scene in (
        stage((pane, world, frosted(45.0)), *balls()),
        stage((near, at, frosted(45.0)), (*upright(0.5, 3.0), frosted(10.0)), *balls()),
        stage((near, at, frosted(3.0)), *balls(), projection="orthographic"),
        stage((near, at, frosted(3.0)), floor=False),
    ):
        rgb = frame(scene, (64, 36))["RGBA"]
        assert np.isfinite(rgb).all() and (rgb >= 0.0).all() and rgb.max() <= 1.001


FINISHLESS = """
import sys, warp as wp
wp.config.log_level = wp.LOG_WARNING
from panes import GLASS, frame, stage, upright
shown = frame(stage((*upright(1.0), GLASS)))
assert shown.transmitted
print([name for name in [*sys.modules, *wp._src.context.user_modules] if name.startswith("warp_reflect.finishes")])
"""


def test_nothing_of_a_finish_is_imported_for_clear_glass():
    run = [sys.executable, "-c", FINISHLESS]
    done = subprocess.run(run, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[-2:] == ["[]", ""]


def test_maps_do_not_fade_and_say_so():
    scene = stage((square(1, 1.0), placed(0, 0, 0), with_finish(CHROME, fade_distance=3.0)))
    plan = wr.make_plan(scene, size=SIZE, method="environment")
    assert not plan.rows[0].effects["fade"].on and "no distances" in plan.rows[0].effects["fade"].reason
    assert WHITE.finish is None
