"""Mirrors in mirrors by maps: to a fixed depth and with the maps of the frame before, against look-ups in float64."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from rooms import CHROME, placed, render, room, sphere
from test_environment import oracle_look_up

import warp_reflect as wr
from warp_reflect import environment_maps
from warp_reflect.cubemap import texel_directions
from warp_reflect.scene import InstanceData, LightData, Scene
from warp_reflect.techniques import environment, mirror_maps

BALLS = Path(__file__).resolve().parents[1] / "usd_scenes" / "red_blue_balls.usda"
SIZE = (160, 90)
SKY = (0.5, 0.6, 0.7)
EDGE = 24


def pair(device="cpu") -> Scene:
    """Two mirror balls of radius 1 over a floor, in a uniform sky."""
    data = room(sphere(48, 96), placed(-2, 0, 0)).data
    instances = [data.instances[0], *data.instances[1:], InstanceData(0, placed(2, 0, 0), "/second", (0,))]
    lights = [LightData("/dome", "dome", SKY, np.eye(4))]
    return Scene(dataclasses.replace(data, instances=instances, lights=lights), device)


def test_mirror_in_a_map_shows_its_own_map(device):
    """A texel that sees the other ball: its Fresnel weight times what that ball's map has in the reflected direction."""
    scene = pair(device)
    first, second = (k for k, part in enumerate(scene.parts) if part.prim_path in ("/mirror", "/second"))
    settings = wr.Settings(environment_resolution=EDGE, shadows="off", bounces=2)
    centres = np.array([environment.centre_of(scene, part) for part in (first, second)])
    options = {"without": [environment.left_out(scene, part, settings) for part in (first, second)]}
    plain = environment_maps.render_maps(scene, centres, EDGE, **options)
    onward = mirror_maps.of_depth(scene, settings, 1)
    deep = environment_maps.render_maps(scene, centres, EDGE, onward=onward, **options)
    own = scene.parts[second]
    triangle = plain.triangle(0)
    sees = (triangle >= own.first_triangle) & (triangle < own.first_triangle + own.triangle_count)
    assert sees.sum() > 20
    np.testing.assert_array_equal(deep.radiance(0)[~sees], plain.radiance(0)[~sees])
    changed = (deep.radiance(0) - plain.radiance(0))[..., :3]
    other = plain.radiance(1).astype(np.float64)
    directions = texel_directions(EDGE)
    checked = 0
    for face, row, column in np.argwhere(sees):
        d = directions[face, row, column].astype(np.float64)
        d /= np.linalg.norm(d)
        to_ball = centres[1] - centres[0]
        along = to_ball @ d
        inside = along**2 - to_ball @ to_ball + 1.0
        if inside < 0.05:  # at its rim the facets' shape decides
            continue
        n = (along - np.sqrt(inside)) * d - to_ball
        reflected = d - 2 * (d @ n) * n
        value = oracle_look_up(other, reflected)
        seen = value[:3] + (1 - value[3]) * np.array(SKY)
        weight = 0.9 + 0.1 * (1 + d @ n) ** 5
        np.testing.assert_allclose(changed[face, row, column], weight * (seen - SKY), atol=0.03)
        checked += 1
    assert checked > 15 and np.abs(changed[sees]).max() > 0.1


def ball_frame(**settings):
    scene = wr.load_stage(str(BALLS))
    options = wr.Settings(environment_resolution=64, **settings)
    return scene, wr.make_plan(scene, size=SIZE, settings=options, method="environment")


def test_deeper_maps_change_less_and_less():
    pictures = []
    for depth in (1, 2, 3, 4):
        pictures.append(wr.render_frame(*ball_frame(bounces=depth))["RGBA"])
    change = [np.abs(b - a).sum() for a, b in itertools.pairwise(pictures)]
    assert change[0] > 4.0 * change[1] > 16.0 * change[2] > 0.0, change


def test_maps_of_the_frame_before_are_one_reflection_deeper_each_frame():
    """In a world that stands still the n-th frame is, bit for bit, that of n reflections."""
    scene, plan = ball_frame(environment_update="previous")
    frame = None
    for depth in (1, 2, 3):
        frame = wr.render_frame(scene, plan, previous=frame)
        assert frame.statistics["environment_maps"] == 2
        fixed = wr.render_frame(*ball_frame(bounces=depth))
        np.testing.assert_array_equal(frame["RGBA"], fixed["RGBA"])


@pytest.mark.parametrize("others", [False, True])
def test_one_mirror_alone_draws_one_map(others, monkeypatch):
    """What no mirror asks for is not drawn."""
    drawn = []
    whole = environment_maps.render_maps

    def counted(scene, centres, *arguments, **options):
        drawn.append(len(centres))
        return whole(scene, centres, *arguments, **options)

    monkeypatch.setattr(environment, "render_maps", counted)
    monkeypatch.setattr(mirror_maps, "render_maps", counted)
    scene = pair() if others else room(sphere(), placed(0, 0, 0))
    assert scene.data.materials[0] == CHROME
    render(scene, "environment", environment_resolution=8, bounces=2)
    assert sum(drawn) == (4 if others else 1)
