"""Local maps out of fields: swept depths against rays through the same field, planes against the triangles, what has no field."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import street
import warp as wp
from stage_samples import saved
from test_layered_environment import plan_of

import warp_reflect as wr
from warp_reflect import kernels, launch
from warp_reflect.cubemap import texel_directions
from warp_reflect.scene import Scene
from warp_reflect.techniques import layered_environment, local_field, local_maps, local_shading
from warp_reflect.techniques.local_maps import LocalMaps

SETTINGS = wr.Settings(
    environment_resolution=32, local_rays="field", field_cell=0.25, field_kind="heightfield", bounces=1
)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return wr.load_stage(saved(street.street(tmp_path_factory.mktemp("street") / "street.usda", walker=True)), time=1.0)


def ball(scene) -> int:
    return next(k for k in scene.moving_parts if scene.parts[k].prim_path.endswith("Ball"))


def still_map(scene, part: int, settings):
    return layered_environment._still_maps(scene, [(part, settings)])[part, settings]


def swept(scene, known, place, edge: int, kernels: str = "auto"):
    """Inverse depths and triangles of a map at a place, flat; None where that is not in the open."""
    if not local_field.in_the_open(scene, known, place[None])[0]:
        return None, None
    made = LocalMaps.empty(scene, place, [edge], known.field.cell, 1)
    local_field.sweep(scene, known, made, SETTINGS.replace(kernels=kernels))
    own = made.layout.texels(0)
    return made.inverse.numpy()[own], made.triangle.numpy()[own]


def unit_directions(edge: int) -> np.ndarray:
    directions = texel_directions(edge).reshape(-1, 3)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("edge", [32, 33])
def test_swept_depths_are_those_of_rays_through_the_field(scene, up, edge):
    turned = Scene(dataclasses.replace(scene.data, up_axis=up), "cpu")
    known = local_field.local_field(turned, SETTINGS)
    assert known.field.kind == "heightfield"
    low = turned.host_points.min(axis=0)
    directions = unit_directions(edge)
    asked = 0
    rng = np.random.default_rng(4)
    for _ in range(12):
        at = low + rng.uniform(0.05, 0.95, 3) * (turned.host_points.max(axis=0) - low)
        inverse, triangle = swept(turned, known, turned.origin + at, edge)
        origins = wp.array(np.tile(at, (len(directions), 1)).astype(np.float32), dtype=wp.vec3)
        trace = known.field.intersect(origins, wp.array(directions.astype(np.float32), dtype=wp.vec3), 1)
        if inverse is None:
            assert (trace.status.numpy() == wr.Status.INSIDE).any()
            continue
        asked += 1
        length = np.linalg.norm(texel_directions(edge).reshape(-1, 3), axis=1)
        met = trace.t.numpy() > 0
        expected = np.where(met, length / np.maximum(trace.t.numpy(), 1e-9), 0.0)
        off = np.abs(inverse - expected) > 1e-4 * np.maximum(expected, 1e-3)
        assert off.mean() < 0.002 and ((triangle >= 0) == (inverse > 0)).all()
    assert asked >= 4


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize("edge", [48, 33])
def test_lines_side_by_side_are_swept_as_single_ones(scene, up, edge):
    turned = Scene(dataclasses.replace(scene.data, up_axis=up), "cpu")
    known = local_field.local_field(turned, SETTINGS)
    low, high = turned.host_points.min(axis=0), turned.host_points.max(axis=0)
    places = turned.origin + low + np.random.default_rng(9).uniform(0.05, 0.95, (12, 3)) * (high - low)
    compared = 0
    for place in places:
        plain, vector = (swept(turned, known, place, edge, kernels) for kernels in ("plain", "auto"))
        if plain[0] is not None:
            np.testing.assert_array_equal(plain[0], vector[0])
            np.testing.assert_array_equal(plain[1], vector[1])
            compared += 1
    assert compared >= 4


def test_a_place_in_a_house_or_beyond_the_columns_has_no_field(scene):
    known = local_field.local_field(scene, SETTINGS)
    house = next(part for part in scene.parts if part.prim_path.endswith("House0L"))
    own = scene.host_triangles[house.first_triangle : house.first_triangle + house.triangle_count]
    middle = scene.host_points[own.reshape(-1)].astype(np.float64).mean(axis=0) + scene.origin
    for place in (middle, middle + [1e4, 0, 0], middle + [0, 0, -1e9]):
        assert swept(scene, known, place, 16) == (None, None)
    inverse, _ = swept(scene, known, middle + [0, 50, 0], 16)
    assert np.isfinite(inverse).all() and (inverse > 0).any()


@pytest.mark.parametrize("kind", ["heightfield", "occupancy"])
def test_depths_of_a_field_are_those_of_the_triangles_but_at_edges(scene, kind):
    settings = SETTINGS.replace(field_kind=kind)
    part = ball(scene)
    exact, found = (still_map(scene, part, each) for each in (settings.replace(local_rays="exact"), settings))
    assert exact.slack == 0.0 and found.slack == pytest.approx(0.25)
    true, got = (each.local.distance(0).reshape(-1).astype(np.float64) for each in (exact, found))
    both = (true > 0) & (got > 0)
    assert both.sum() > 0.95 * (true > 0).sum()
    off = np.abs(got - true)[both] / true[both]
    assert np.median(off) < 1e-3 and (off < 0.02).mean() > (0.85 if kind == "heightfield" else 0.75)


def test_a_mirror_shows_the_same_by_a_field(scene):
    exact = wr.render_frame(scene, plan_of(scene, shadows="off"))
    plan = plan_of(scene, local_rays="field", field_cell=0.25, shadows="off")
    row = plan.rows[0]
    assert row.effects["field"].on and "local_rays=field" in row.effects["field"].reason
    assert not plan_of(scene).rows[0].effects["field"].on
    frame = wr.render_frame(scene, plan)
    mirror = frame["reflectorId"] > 0
    off = np.abs(frame["reflection"] - exact["reflection"])[mirror].max(-1)
    assert np.isfinite(frame["RGBA"]).all() and off.mean() < 0.03 and np.median(off) < 0.005


@pytest.mark.parametrize("rays", ["field", "exact"])
def test_without_a_field_nothing_of_it_is_launched_or_kept(scene, rays):
    fresh = Scene(scene.data, "cpu")
    with launch.recorded() as launches:
        layered_environment.prepare(fresh, Named(ball(fresh)), SETTINGS.replace(local_rays=rays))
    asked = any("local_field" in name for name, _ in launches)
    kept = any(key[0] == layered_environment.FIELD_KEY for key in fresh.environments)
    assert asked == kept == (rays == "field")


def test_fields_are_handed_over_in_time(scene):
    known = local_field.local_field(scene, SETTINGS)
    later = scene.at(3.0)
    layered_environment.take_over(scene, later)
    assert local_field.local_field(later, SETTINGS) is known
    part = ball(later)
    exact, found = (still_map(later, part, each) for each in (SETTINGS.replace(local_rays="exact"), SETTINGS))
    true, got = (each.local.distance(0).reshape(-1).astype(np.float64) for each in (exact, found))
    assert np.median(np.abs(got - true)[(true > 0) & (got > 0)]) < 1e-3


@pytest.mark.parametrize(("name", "value"), [("local_rays", "none"), ("local_shade_step", 0), ("local_shade_step", 17)])
def test_values_that_cannot_be_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        wr.Settings(**{name: value})


def test_what_is_compiled_ahead_is_what_fits_vectors():
    assert kernels.ROW_MULTIPLE == local_maps.ROW_MULTIPLE


@pytest.mark.parametrize("settings", [{}, {"rem_missing": "best", "rem_blur_px": 0.0}, {"rem_texels": "packed"}])
@pytest.mark.parametrize("rays", ["field", "exact"])
def test_blocks_of_texels_are_blended_as_single_ones(scene, rays, settings):
    """Bit for bit but for distances, of another product's order: 2 ulp."""
    common = SETTINGS.replace(**{"rem_texels": "full", "local_rays": rays} | settings)
    part = ball(scene)
    maps = [layered_environment.prepare(scene, Named(part), common.replace(kernels=k)) for k in ("plain", "auto")]
    states, colours, depths = (
        [get(each) for each in maps]
        for get in (lambda m: m.state.numpy(), lambda m: m.local.radiance(0), lambda m: m.local.distance(0))
    )
    assert (states[0] != states[1]).mean() < 1e-3
    same = (states[0] == states[1]).reshape(colours[0].shape[:3])
    np.testing.assert_allclose(colours[0][same], colours[1][same], atol=2e-5)
    np.testing.assert_allclose(depths[0], depths[1], rtol=3e-7)
    np.testing.assert_array_equal(maps[0].local.triangle(0), maps[1].local.triangle(0))


class Named:
    def __init__(self, part: int):
        self.part = part


def test_shading_that_squares_share_is_that_of_one_of_them(scene):
    part = ball(scene)
    one, four = (still_map(scene, part, SETTINGS.replace(rem_blur_px=0.5, local_shade_step=step)) for step in (1, 4))
    np.testing.assert_array_equal(one.state.numpy(), four.state.numpy())
    shaded = (one.state.numpy() == local_shading.TEXEL_SHADED).reshape(6, 32, 32)
    assert shaded.sum() > 500
    off = np.abs(one.local.radiance(0) - four.local.radiance(0)).max(-1)
    assert not off[~shaded].any() and 0.0 < off[shaded].mean() < 0.05
    triangle, colours = four.local.triangle(0), four.local.radiance(0)
    square = (slice(0, 1), slice(4, 8), slice(8, 12))
    alike = shaded[square] & (triangle[square] == triangle[0, 6, 10])
    assert len(np.unique(colours[square][alike], axis=0)) <= 1
