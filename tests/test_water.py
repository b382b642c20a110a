"""Waves on flat mirrors: normals that move with time, look-ups against rays, shores, and what still frames keep of them."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from panes import HALF, SIZE, WATER, balls, eye_rays, floor_error_px, frame, shown_places, stage, upright, with_finish
from rooms import CHROME, placed, sphere, square

import warp_reflect as wr
from warp_reflect import frame as frame_module
from warp_reflect import raster, surface, waves
from warp_reflect.images import write_exr
from warp_reflect.scene import MaterialData, Scene, TextureRef
from warp_reflect.timing import StageTimer

WAVY = with_finish(WATER, wave_slope=0.05, wave_length=1.0, wave_speed=1.0)
POOL = square(1, 20.0), placed(0, 0, -3)


def at_time(scene, time):
    return scene.seen_at(dataclasses.replace(scene.source_data, time=time))


def reflected_places(shown, mask):
    """(x, y) of the coded wall that a mirror shows."""
    picture = shown["reflection"]
    share = 2.0 * np.where(mask, picture[..., 2], 0.5)
    return np.where(mask[..., None], (picture[..., :2] / share[..., None] - 0.5) * 2.0 * HALF, 0.0)


def test_the_mirrored_picture_is_looked_up_where_the_turned_rays_lead():
    """A coded wall behind the water: waves move its picture by many pixels, look-ups are off by few of that."""
    scene = stage((*POOL, dataclasses.replace(WAVY, transmission=0.0, metallic=1.0, base_color=(1.0,) * 3)), sky=1.0)
    # The floor of the scene, stood up behind the water.
    data = scene.source_data
    turn = upright(0.0)[1]
    turn[1, 3], turn[2, 3] = 7.9, -8.0
    data.instances[0] = dataclasses.replace(data.instances[0], world_from_object=turn)
    scene = Scene(data)
    size = (320, 180)
    still, looked, traced = (frame(scene, size, waves=mode) for mode in ("off", "lookup", "traced"))
    seen = [each["reflection"][..., 2] > 0.0 for each in (still, looked, traced)]
    # Away from where the picture changes between the wall and the sky, whose blue is 1.
    wall = np.logical_and.reduce(
        [np.abs(2.0 * each["reflection"][..., 2] - 1.0) < 0.02 for each in (still, looked, traced)]
    )
    mask = np.logical_and.reduce(seen) & wall & (still["reflectorId"] > 0)
    # What is looked up beyond the frame is not there.
    mask[160:], mask[:, :40], mask[:, -40:] = False, False, False
    assert mask.sum() > 3000
    places = [reflected_places(each, mask) for each in (still, looked, traced)]
    # Pixels per unit of the wall where the still mirror shows it.
    step = np.minimum(*(np.linalg.norm(np.gradient(places[0], axis=k), axis=2) for k in (0, 1)))
    step = np.median(step[mask & (step > 0.0)])
    moved = np.linalg.norm(places[2] - places[0], axis=2)[mask] / step
    off = np.linalg.norm(places[1] - places[2], axis=2)[mask] / step
    assert moved.mean() > 4.0
    assert off.mean() < 0.1 * moved.mean()
    assert np.quantile(off, 0.95) < 1.5


def test_the_refracted_picture_is_looked_up_where_the_bent_rays_lead():
    scene = stage((*POOL, with_finish(WAVY, wave_slope=0.1)))
    size = (320, 180)
    still, looked, traced = (frame(scene, size, waves=mode) for mode in ("off", "lookup", "traced"))
    pictures = [each["RGBA"][..., :3] - each["reflection"] for each in (still, looked, traced)]
    # The near half of the water shows nothing but the floor.
    mask = np.zeros(size[::-1], bool)
    mask[110:160, 40:-40] = True
    mask &= still["primId"] == 2
    places = [shown_places(each, mask) for each in pictures]
    step = np.minimum(*(np.linalg.norm(np.gradient(places[0], axis=k), axis=2) for k in (0, 1)))
    moved = (np.linalg.norm(places[2] - places[0], axis=2) / np.maximum(step, 1e-3))[mask]
    off = (np.linalg.norm(places[1] - places[2], axis=2) / np.maximum(step, 1e-3))[mask]
    assert mask.sum() > 8000 and moved.mean() > 1.0
    assert off.mean() < 0.05 * moved.mean()
    assert np.quantile(off, 0.95) < 0.25


@pytest.mark.parametrize("mode", ["lookup", "traced"])
def test_a_normal_map_bends_what_is_seen_through_water(mode, tmp_path):
    """One that is tilted everywhere: as the rays through a surface with that normal, in float64."""
    tilt = np.array([0.06, -0.04, 1.0])  # along u, v and the surface's normal
    tilt /= np.linalg.norm(tilt)
    write_exr(tmp_path / "n.exr", {"RGB": np.tile(np.float32(0.5 * tilt + 0.5), (4, 4, 1))}, half=())
    signed = {"color_space": "signed", "scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
    pool = square(1, 20.0)
    pool.uvs, pool.uv_index = np.float32(pool.points[:, [0, 2]] * [1.0, -1.0]), pool.triangles
    mapped = dataclasses.replace(WATER, textures={"normal": TextureRef(str(tmp_path / "n.exr"), **signed)})
    size = (320, 180)
    shown = frame(stage((pool, placed(0, 0, -3), mapped)), size, waves=mode)
    eye, d = eye_rays(shown.camera)
    p = eye + (-eye[1] / d[..., 1])[..., None] * d
    n = np.array([tilt[0], tilt[2], -tilt[1]])
    across = (d - (d @ n)[..., None] * n) / 1.333
    bent = across - np.sqrt(1.0 - np.sum(across**2, -1, keepdims=True)) * n
    place = (p + (-1.0 / bent[..., 1])[..., None] * bent)[..., [0, 2]]
    mask = np.zeros(size[::-1], bool)
    mask[110:160, 40:-40] = True
    mask &= (np.abs(place[..., 0]) < HALF - 0.1) & (np.abs(place[..., 1] + 3.0) < HALF - 0.1)
    direct = shown["RGBA"][..., :3] - shown["reflection"]
    assert "normal map" in shown.plan.panes[0].effects["waves"].reason and mask.sum() > 5000
    assert np.quantile(floor_error_px(direct, place, mask), 0.95) < 0.1


@pytest.mark.parametrize("stored", ["missing", "zero"])
def test_a_normal_map_that_says_nothing_leaves_the_water_still(stored, tmp_path):
    if stored == "zero":
        write_exr(tmp_path / "n.exr", {"RGB": np.full((4, 4, 3), 0.5, np.float32)}, half=())
    signed = {"color_space": "signed", "scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
    pool = square(1, 20.0)
    pool.uvs, pool.uv_index = np.float32(pool.points[:, [0, 2]]), pool.triangles
    mapped = dataclasses.replace(WATER, textures={"normal": TextureRef(str(tmp_path / "n.exr"), **signed)})
    scene = stage((pool, placed(0, 0, -3), mapped))
    shown, still = frame(scene), frame(stage((pool, placed(0, 0, -3), WATER)))
    np.testing.assert_allclose(shown["RGBA"], still["RGBA"], atol=1e-3)
    assert any("n.exr" in note.text or "no direction" in note.text for note in scene.notes)


def test_look_ups_stay_on_the_water_at_a_shore_and_of_what_is_above_it():
    """A small pool: nothing of the ground around it and nothing in front of its surface is seen in it."""
    pool = square(1, 0.6), placed(0, 0, 1.5)
    red = MaterialData(base_color=(1.0, 0.0, 0.0), specular_workflow=True, roughness=1.0)
    ground = square(1, 30.0), placed(0, -1e-3, 0), red
    mirror = dataclasses.replace(WAVY, transmission=0.0, metallic=1.0, base_color=(1.0,) * 3)
    # White above: a mirror of the sky alone, whatever the waves.
    shown = frame(stage((*pool, with_finish(mirror, wave_slope=0.1)), ground, floor=False))
    inner = shown["reflectorId"] > 0
    assert inner.sum() > 500
    np.testing.assert_allclose(shown["reflection"][inner], 1.0, atol=1e-3)


def test_waves_move_with_time_and_nothing_else_does():
    """A still world at another time is drawn again where waves are on it, with its layers kept, and is not where they rest."""
    scene = stage((*POOL, WAVY), *balls())
    first = frame(scene)
    again = wr.render_frame(scene, first.plan, previous=first)
    assert again._picture is first._picture
    later = at_time(scene, 6.0)
    assert later.shares_world(scene)
    moved = wr.render_frame(later, first.plan, previous=first)
    assert moved.layers[1] is first.layers[1] and moved.kept == {1}
    alone = wr.render_frame(later, wr.make_plan(later, size=SIZE))
    np.testing.assert_array_equal(moved["RGBA"], alone["RGBA"])
    water = first["reflectorId"] > 0
    assert (np.abs(moved["RGBA"] - first["RGBA"])[water].max(axis=1) > 0.01).mean() > 0.3
    np.testing.assert_array_equal(moved["RGBA"][~water], first["RGBA"][~water])
    for still in (with_finish(WAVY, wave_speed=0.0), with_finish(WAVY, wave_slope=0.0)):
        scene = stage((*POOL, still), *balls())
        first = frame(scene)
        assert wr.render_frame(at_time(scene, 6.0), first.plan, previous=first)._picture is first._picture


def test_other_waves_in_the_same_world_are_not_taken_over():
    scene = stage((*POOL, WAVY), *balls())
    first = frame(scene)
    off = frame(scene, previous=first, waves="off")
    assert (off["RGBA"] != first["RGBA"]).any()
    np.testing.assert_array_equal(off["RGBA"], frame(scene, waves="off")["RGBA"])


def test_normals_have_the_slope_asked_for_and_do_not_care_where_the_stage_is():
    slopes = []
    for offset in (0.0, 1.0e6):
        shift = np.eye(4)
        shift[:3, 3] = offset
        camera = np.eye(4)
        camera[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # looks down
        camera[:3, 3] = 0.0, 3.0, -3.0
        scene = stage((POOL[0], shift @ POOL[1], WAVY), floor=False, camera=shift @ camera)
        view = wr.make_plan(scene, size=(160, 90)).camera
        gbuffer = raster.draw_scene(scene, view)
        none = waves.wp.zeros(0, dtype=waves.wp.vec3, device=scene.device)
        finish = {0: scene.data.materials[scene.parts[0].material].finish}
        seen = surface.part_pixels(scene, gbuffer, finish, {})
        n = waves.wave_normals(scene, gbuffer, none, finish, seen).numpy().astype(float)
        slopes.append((n[:, [0, 2]] / n[:, 1:2]).reshape(90, 160, 2))
    rms = [np.sqrt((each**2).sum(axis=2).mean()) for each in slopes]
    np.testing.assert_allclose(rms, 0.05, rtol=0.15)
    # From pixel to pixel: rounding of the place would show as noise.
    steps = [np.sqrt((np.diff(each, axis=1) ** 2).sum(axis=2).mean()) for each in slopes]
    assert steps[1] == pytest.approx(steps[0], rel=0.15) and steps[0] < 0.5 * rms[0]


@pytest.mark.parametrize("waves", ["lookup", "traced"])
@pytest.mark.parametrize("transmission", [0.0, 0.5, 1.0])
def test_white_furnace_stays_white_on_waves(waves, transmission):
    water = dataclasses.replace(with_finish(WAVY, wave_slope=0.3), transmission=transmission, base_color=(1.0,) * 3)
    rgb = frame(stage((*POOL, water), floor=False), waves=waves)["RGBA"][..., :3]
    assert rgb.max() <= 1.0 + 1e-3
    np.testing.assert_allclose(rgb, 1.0, atol=2e-3)


def tilted_map(tmp_path, tilt):
    """A mirror of 40 x 40 whose normal map is tilted the same way everywhere; slopes along x and -z."""
    normal = np.array([-tilt[0], -tilt[1], 1.0])  # along u, v and the surface's normal
    normal /= np.linalg.norm(normal)
    write_exr(tmp_path / "n.exr", {"RGB": np.tile(np.float32(0.5 * normal + 0.5), (4, 4, 1))}, half=())
    signed = {"color_space": "signed", "scale": (2.0, 2.0, 2.0, 1.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
    pool = square(1, 20.0)
    pool.uvs, pool.uv_index = np.float32(pool.points[:, [0, 2]] * [1.0, -1.0]), pool.triangles
    texture = TextureRef(str(tmp_path / "n.exr"), **signed)
    mirror = MaterialData(metallic=1.0, roughness=0.0, base_color=(1.0,) * 3, textures={"normal": texture})
    return pool, placed(0, 0, -3), mirror


def test_the_slopes_of_waves_and_of_a_normal_map_are_added(tmp_path):
    """Pixel by pixel, in float64: each alone, and both."""
    pool, world, mirror = tilted_map(tmp_path, (0.08, -0.05))
    wavy = with_finish(mirror, wave_slope=0.05, wave_length=1.0)
    normals = {}
    for name, material, settings in (
        ("waves", wavy, {"bumps": "off"}),
        ("map", wavy, {"waves": "off"}),
        ("both", wavy, {}),
    ):
        scene = stage((pool, world, material))
        plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(**settings))
        gbuffer, layers = frame_module.reflect_scene(scene, plan, plan.camera, StageTimer(scene.device))
        surfaces = frame_module._surfaces(scene, plan, gbuffer, layers)
        shown, _ = frame_module._shown(scene, plan, gbuffer, None, layers, surfaces)
        n = shown.normals.numpy().astype(float)[layers[1].pixels.pixel.numpy()]
        normals[name] = -n[:, [0, 2]] / n[:, 1:2]
    # Where no normal was turned towards the eye.
    row = layers[1].pixels.pixel.numpy() // SIZE[0]
    near = row > 66
    assert near.sum() > 2000
    np.testing.assert_allclose(normals["map"][near], np.tile((0.08, 0.05), (near.sum(), 1)), atol=1e-4)
    np.testing.assert_allclose(normals["both"][near], normals["map"][near] + normals["waves"][near], atol=2e-5)


def test_a_mirror_with_waves_and_a_normal_map_is_turned_once(tmp_path):
    """By waves too low to see it shows what its map alone makes of it; by both, what rays say."""
    pool, world, mirror = tilted_map(tmp_path, (0.04, -0.03))
    alone = frame(stage((pool, world, mirror), *balls()), bumps="traced")
    rows = {}
    for slope in (1e-7, 0.03):
        scene = stage((pool, world, with_finish(mirror, wave_slope=slope, wave_length=1.0)), *balls())
        rows[slope] = [
            frame(scene, waves=waves, bumps=bumps)
            for waves, bumps in (("lookup", "lookup"), ("traced", "lookup"), ("lookup", "traced"))
        ]
        effects = rows[slope][0].plan.rows[0].effects
        assert (
            effects["waves"].on and effects["normal_map"].on and "added to the waves'" in effects["normal_map"].reason
        )
        np.testing.assert_array_equal(rows[slope][1]["RGBA"], rows[slope][2]["RGBA"])
    seen = alone["reflectorId"] > 0
    low, high = (
        [np.abs(each[k]["reflection"] - each[1]["reflection"])[seen] for k in (0, 1)] for each in rows.values()
    )
    assert np.abs(rows[1e-7][1]["reflection"] - alone["reflection"])[seen].max() < 1e-3
    # What one turn more would change.
    still = frame(stage((pool, world, mirror), *balls()), bumps="off")
    moved = np.abs(still["reflection"] - alone["reflection"])[seen].mean()
    assert moved > 0.04
    # Look-ups do not have what the still mirror does not show.
    assert low[0].mean() < 0.4 * moved and high[0].mean() < 0.4 * moved


@pytest.mark.parametrize("wave_slope", [0.0, 0.2])
@pytest.mark.parametrize("how", ["lookup", "traced"])
@pytest.mark.parametrize("values", [{}, {"clearcoat": 0.8}, {"roughness": 0.2, "clearcoat": 0.5}])
def test_white_furnace_stays_white_on_normal_maps_and_waves(values, how, wave_slope, tmp_path):
    pool, world, mirror = tilted_map(tmp_path, (0.3, -0.2))
    material = with_finish(dataclasses.replace(mirror, **values), wave_slope=wave_slope, wave_length=0.5)
    rgb = frame(stage((pool, world, material), floor=False), waves=how, bumps=how)["RGBA"][..., :3]
    assert rgb.max() <= 1.0 + 1e-3
    # A rough lobe loses what its facets shadow and mask.
    np.testing.assert_allclose(rgb, 1.0, atol=0.2 if values.get("roughness") else 2e-3)


def test_waves_are_finite_whatever_the_eye():
    """From below, straight along the surface, orthographic, and with slopes that turn rays into the water."""
    steep = with_finish(WAVY, wave_slope=0.5, wave_length=0.05)
    low, below = placed(0.1, 1e-4, 4.0), placed(0.1, -0.5, 2.0)
    for camera, projection in ((low, "perspective"), (below, "perspective"), (placed(0, 0.5, 2), "orthographic")):
        for mode in ("lookup", "traced"):
            shown = frame(stage((*POOL, steep), *balls(), camera=camera, projection=projection), (96, 54), waves=mode)
            assert np.isfinite(shown["RGBA"]).all() and (shown["RGBA"] >= 0.0).all()


def test_curved_mirrors_have_no_waves_and_say_so():
    scene = stage((sphere(), placed(0, 0, 0, 0.8), with_finish(CHROME, wave_slope=0.1)))
    effect = wr.make_plan(scene, size=SIZE).rows[0].effects["waves"]
    assert not effect.on and "not flat" in effect.reason


STILL_FRAME = """
import sys, warp as wp
wp.config.log_level = wp.LOG_WARNING
from panes import WATER, frame, stage
from rooms import placed, square
shown = frame(stage((square(1, 20.0), placed(0, 0, -3), WATER)))
assert (shown["reflectorId"] > 0).sum() > 500
modules = [*sys.modules, *wp._src.context.user_modules]
assert "warp_reflect.shade" in modules
print([name for name in modules if name.startswith(("warp_reflect.finishes", "warp_reflect.waves"))])
import warp_reflect.waves  # so that a name that has changed does not pass
"""


def test_nothing_of_waves_is_compiled_for_still_water():
    run = [sys.executable, "-c", STILL_FRAME]
    done = subprocess.run(run, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    assert done.stdout.strip().split("\n")[-1] == "[]"
