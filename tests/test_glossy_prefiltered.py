"""Filtered levels of maps, and rough mirrors that look them up: against float64 quadrature of the lobe, and against rays."""

import dataclasses

import numpy as np
import pytest
from rooms import CHROME, placed, render, room, sphere
from test_environment import oracle_look_up, random_maps
from test_glossy import FURNACE, dome, reflected_quadrature, sky, wall

from warp_reflect.cubemap import texel_directions
from warp_reflect.finishes import glossy_prefiltered
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, Scene, SceneData

SIZE = (96, 54)
ROUGH = {"reflector_max_roughness": 1.0, "environment_resolution": 64}
EVERYTHING = {"reflector_min_weight": 0.0}  # is a mirror


def rough_ball(roughness):
    scene = room(sphere(), placed(0, 0, -1))
    materials = [dataclasses.replace(CHROME, roughness=roughness), *scene.data.materials[1:]]
    return Scene(dataclasses.replace(scene.data, materials=materials))


def lobe_means(axes, alpha, directions, values, solid_angle):
    """What GGX mirrors of an alpha see that are looked at along their normals; float64.

    Args:
        axes: Normals, unit [m, 3].
        directions, values, solid_angle: Unit [n, 3], radiance [n, c] and [n] of places that fill the sphere.
    """
    out = axes @ directions.T
    half = axes[:, None] + directions[None]
    cosine = np.einsum("mc,mnc->mn", axes, half) / np.maximum(np.linalg.norm(half, axis=2), 1e-9)
    d = alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1.0) + 1.0) ** 2)
    masked = 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / np.maximum(out, 1e-6) ** 2 - 1.0)) - 1.0)
    weight = np.where(out > 0.0, d / (4.0 * (1.0 + masked)), 0.0) * solid_angle
    return weight @ values / weight.sum(axis=1, keepdims=True)


def unit_axes(resolution):
    """Of the texels' centres, float64 [6 n n, 3], and the solid angles of the texels."""
    axes = texel_directions(resolution).reshape(-1, 3)
    length = np.linalg.norm(axes, axis=1)
    return axes / length[:, None], (2.0 / resolution) ** 2 / length**3


@pytest.mark.parametrize("number", [0, 1])
def test_levels_are_what_lobes_see_of_the_map(device, number):
    """Of random texels, which a level's lobes mix to a tenth of their spread, over the edges of the faces too."""
    scene, maps, texels = random_maps(device)
    levels = glossy_prefiltered.levels_of(scene, maps, number, 0.1, 1.0, 1)
    assert levels is glossy_prefiltered.levels_of(scene, maps, number, 0.5, 0.8, 1)
    assert levels.lowest == 0 and len(maps.filtered) == 1
    np.testing.assert_allclose(levels.maps.radiance(0, 0)[..., :3], texels[number][..., :3], rtol=1e-6)
    directions, solid_angle = unit_axes(24)
    values = np.stack([oracle_look_up(texels[number], d)[:3] for d in directions])
    for level in range(1, levels.highest + 1):
        alpha = float(glossy_prefiltered.WIDTH) * 2**level / maps.resolution
        shown = levels.maps.radiance(0, level)[..., :3].reshape(-1, 3)
        wanted = lobe_means(unit_axes(8)[0], alpha, directions, values, solid_angle)
        error = np.abs(shown - wanted)

        assert error.mean() < 0.01 and error.max() < 0.045


def test_levels_are_made_of_the_range_that_is_asked_for(device):
    scene, maps, _ = random_maps(device)
    fine = glossy_prefiltered.levels_of(scene, maps, 0, 0.0, 0.1, 1)
    wide = glossy_prefiltered.levels_of(scene, maps, 0, 0.8, 1.0, 1)
    assert (fine.lowest, fine.highest) == (0, 1) and (wide.lowest, wide.highest) == (2, 3)
    other = glossy_prefiltered.levels_of(scene, maps, 1, 0.8, 1.0, 1)
    assert other is not wide and len(maps.filtered) == 3


def test_domes_are_behind_what_a_map_holds(device):
    """A map of nothing under a dome of a known sky: its levels are the sky in a lobe."""
    scene, maps, _ = random_maps(device, covered=0.0)
    scene = Scene(dataclasses.replace(scene.data, lights=[dome()]), device)
    levels = glossy_prefiltered.levels_of(scene, maps, 0, 0.1, 1.0, 1)
    directions, solid_angle = unit_axes(24)
    wanted = lobe_means(unit_axes(8)[0], 0.375, directions, sky(directions), solid_angle)
    np.testing.assert_allclose(levels.maps.radiance(0, 1)[..., :3].reshape(-1, 3), wanted, atol=0.03)


@pytest.mark.parametrize(("roughness", "atol"), [(0.15, 0.002), (0.4, 0.016), (0.6, 0.012)])
def test_plane_shows_the_lobe_over_a_known_sky(roughness, atol):
    """As `test_glossy` has it of the other ways: Fresnel's term at every microfacet times the sky, masked; by quadrature."""
    f0 = 0.3
    material = MaterialData(
        roughness=roughness, specular_workflow=True, specular_color=(f0, f0, f0), base_color=(0, 0, 0)
    )
    frame = render(wall(material, [dome()], half=12.0), "environment", size=SIZE, **ROUGH)
    effect = frame.plan.rows[0].effects["roughness"]
    assert effect.on and effect.reason.endswith("its map is prefiltered, glossy=auto")
    schlick = lambda c: f0 + (1.0 - f0) * (1.0 - c) ** 5  # noqa: E731
    points = frame.relative("mirrorPoint").astype(np.float64)
    for y in range(8, 48, 13):
        for x in range(8, 90, 20):
            view = -points[y, x] / np.linalg.norm(points[y, x])
            wanted, _ = reflected_quadrature(view, roughness, sky, schlick, 80, 64)
            np.testing.assert_allclose(frame["reflection"][y, x], wanted, atol=atol)


@pytest.mark.parametrize("samples", [1, 8])
@pytest.mark.parametrize("roughness", [0.05, 0.3, 1.0])
def test_nothing_gives_more_light_than_it_gets(roughness, samples):
    """A white furnace: all materials on balls in a row."""
    materials = [dataclasses.replace(m, roughness=roughness) for m in FURNACE.values()]
    instances = [InstanceData(0, placed(2.2 * k - 4.4, 0, 0), f"/{k}", (k,)) for k in range(len(materials))]
    lights = [LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4))]
    camera = CameraData("/camera", placed(0, 0, 12), focal_length=22.0)
    scene = Scene(SceneData("furnace", [sphere(12, 24)], instances, materials, lights, [camera]))
    frame = render(scene, "environment", size=SIZE, glossy_samples=samples, **ROUGH, **EVERYTHING)
    assert len(frame.plan.rows) == len(materials)
    assert frame["RGBA"][..., :3].max() <= 1.0 + 1e-3
    if roughness <= 0.3:
        first = frame["reflectorId"] == 1
        assert first.sum() > 20 and frame["RGBA"][first][:, :3].mean() > 0.93


@pytest.mark.parametrize("method", ["environment", "layered_environment"])
def test_rough_ball_is_near_the_rays(method):
    """As near to many rays as the sharp picture of the same map is to what a sharp mirror shows: what is off is parallax."""
    asked = {"size": SIZE, "shadows": "off", **ROUGH}
    sharp, rough = rough_ball(0.0), rough_ball(0.3)
    truth = render(rough, "raytraced", glossy="accumulate", glossy_samples=64, **asked)
    shown = render(rough, method, **asked)
    seen = truth["reflectorId"] > 0
    assert seen.sum() > 500
    error = np.abs(shown["RGBA"] - truth["RGBA"])[seen].mean()
    of_sharp = np.abs(render(sharp, method, **asked)["RGBA"] - render(sharp, "raytraced", **asked)["RGBA"])[seen].mean()

    assert error < of_sharp < 0.02


@pytest.mark.parametrize("method", ["environment", "layered_environment"])
def test_threads_do_not_change_a_pixel(method):
    one, two = (render(rough_ball(0.3), method, size=SIZE, threads=threads, **ROUGH) for threads in (1, 2))
    np.testing.assert_array_equal(one["RGBA"], two["RGBA"])


def test_levels_are_made_once_a_map_and_only_of_rough_mirrors():
    scene = rough_ball(0.3)
    first = render(scene, "environment", size=SIZE, keep_static=False, **ROUGH)
    (layer,) = first.layers.values()
    assert len(layer.history.maps.filtered) == 1
    again = render(
        scene, "environment", previous=first, size=SIZE, keep_static=False, environment_update="frame", **ROUGH
    )
    np.testing.assert_array_equal(first["RGBA"], again["RGBA"])
    (remade,) = again.layers.values()
    assert remade.history.maps is not layer.history.maps and len(remade.history.maps.filtered) == 1
    traced = render(scene, "environment", size=SIZE, glossy="gather", **ROUGH)
    (layer,) = traced.layers.values()
    assert layer.history.maps.filtered == []


def test_mirrors_without_a_map_gather_and_say_so():
    frame = render(rough_ball(0.3), "raytraced", size=SIZE, glossy="prefiltered", **ROUGH)
    effect = frame.plan.rows[0].effects["roughness"]
    assert effect.numbers["way"] == "gather" and "no map to prefilter" in effect.reason
