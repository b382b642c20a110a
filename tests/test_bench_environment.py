"""The benchmark of local environment maps, on a crossing of the city."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import warp_reflect as wr
from warp_reflect.techniques import reference_maps

ROOT = Path(__file__).parent.parent


@pytest.fixture
def bench(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import bench_environment

    return bench_environment


def test_what_maps_hold_too_coarsely_is_shaded(bench):
    """Less off than what they hold, and dearer."""
    scene = wr.load_stage(ROOT / "usd_scenes" / "city_block.usda", time=12.0)
    settings = wr.Settings(environment_resolution=32, rem_texels="full", bounces=1)
    references = reference_maps.reference_maps(scene, settings)
    part = bench.mirrors(scene, bench_arguments())[0]
    fine, coarse = (
        bench.measure(scene, part, references, settings.replace(rem_blur_px=blur), 1, 12.0) for blur in (2.0, 0.0)
    )
    assert fine["angle_deg"] < coarse["angle_deg"] <= coarse["angle_95_deg"] <= 180.0
    assert fine["difference"] < min(0.02, coarse["difference"])
    assert fine["unseen"] > coarse["unseen"] and fine["shaded"] > coarse["shaded"]
    assert fine["sky"] == coarse["sky"] < 0.01  # of either's rays
    assert 0.0 < fine["local_ms"] and 0.0 < fine["drawn_ms"] and fine["rays"] <= 6 * 32 * 32


def bench_arguments():
    class Arguments:
        mirrors = 1

    return Arguments


def test_angles_of_a_map_at_a_reference_map_are_small_and_grow_with_the_way(bench):
    """Texels show their own points but for half a texel where both eyes are one."""
    scene = wr.load_stage(ROOT / "usd_scenes" / "city_block.usda", time=12.0)
    part = bench.mirrors(scene, bench_arguments())[0]
    settings = wr.Settings(environment_resolution=32, rem_texels="full", rem_blur_px=0.0, bounces=1, rem_count=1)
    centre = bench.centre_of(scene, part)
    medians = []
    for away in (0.0, 0.5, 5.0):
        placed = reference_maps.Placement(("",), centre[None] + [away, 0, 0], np.eye(3)[None])
        maps = reference_maps.draw_maps(scene, placed, settings)
        key = reference_maps._key(settings)
        scene.environments[key] = reference_maps.ReferenceMaps(maps, placed, (), float("inf"))
        bench.forget(scene)
        made = bench.layered_environment.prepare(scene, bench._Reflector(part), settings)
        medians.append(float(np.median(bench.angles(scene, made, scene.environments[key], settings)["degrees"])))
    texel = 90.0 / 32
    assert medians[0] < 0.05 * texel and medians[0] < medians[1] < medians[2]


def test_rays_find_their_texels(bench):
    n = 16
    rays = np.random.default_rng(1).normal(size=(500, 3))
    directions = bench.texel_directions(n).reshape(-1, 3)
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    nearest = np.argmax(unit @ rays.T, axis=0)
    found = bench.texel_of(rays, n)
    # On the cube the texel whose square holds the ray; its middle is the nearest but near the squares' sides.
    assert (found == nearest).mean() > 0.9
