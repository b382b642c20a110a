"""Level of detail of local maps: sizes on screen against projected spheres, steadiness, shares, and what kept maps show."""

import numpy as np
import pytest
import street
from stage_samples import saved
from test_layered_environment import plan_of

import warp_reflect as wr
from warp_reflect import detail
from warp_reflect.techniques import layered_environment


@pytest.fixture
def scene(tmp_path):
    return wr.load_stage(saved(street.street(tmp_path / "street.usda")), time=1.0)


def levels(sizes, before=None, full=256, **settings) -> dict[int, int]:
    asked = wr.Settings(environment_resolution=full, **{"local_detail": 1.0} | settings)
    return {id: each.resolution for id, each in detail.details(sizes, asked, before or {}).items()}


def test_size_on_screen_is_that_of_the_sphere_around_the_box(scene):
    plan = plan_of(scene)
    (row,) = plan.rows
    camera = plan.camera
    middle = scene.data.instances[-1].world_from_object[:3, 3]
    depth = (middle - camera.eye) @ camera.forward
    diameter = 2 * 0.5 * np.sqrt(3)  # of the sphere around the box around a ball of radius 0.5
    assert detail.size_px(scene, camera, row.reflector.part) == pytest.approx(diameter * camera.fx / depth, rel=1e-3)
    inside = wr.make_plan(scene, size=(64, 36), method="none").camera
    inside = type(camera)(**vars(inside) | {"eye": middle})
    assert detail.size_px(scene, inside, row.reflector.part) == 128.0


@pytest.mark.parametrize(
    ("size", "expected"), [(0.0, 256), (1.0, 8), (9.0, 16), (100.0, 128), (128.0, 128), (1e9, 256)]
)
def test_map_has_as_many_texels_as_its_mirror_has_pixels(size, expected):
    assert levels({1: size}) == {1: expected}


def test_size_that_trembles_around_a_step_changes_nothing():
    rng = np.random.default_rng(3)
    before = levels({1: 64.0})
    for size in 64.0 * rng.uniform(0.9, 1.15, 200):
        now = levels({1: size}, before)
        assert now == before
        before = now


@pytest.mark.parametrize("sizes", [np.geomspace(10, 400, 300), np.geomspace(400, 10, 300)])
def test_size_that_grows_or_shrinks_takes_every_level_once(sizes):
    found, before = [], {}
    for size in sizes:
        before = levels({1: size}, before)
        found.append(before[1])
    steps = np.diff(np.log2(found))
    assert set(np.abs(steps[steps != 0])) == {1.0} and len(set(np.sign(steps[steps != 0]))) == 1
    assert {found[0], found[-1]} == {16, 256}


def test_maps_share_what_a_frame_may_have():
    sizes = {1: 200.0, 2: 60.0, 3: 12.0}
    free = levels(sizes)
    assert free == {1: 256, 2: 64, 3: 16}
    shared = levels(sizes, local_texels=150_000)
    assert sum(6 * each**2 for each in shared.values()) <= 150_000
    assert shared == {1: 128, 2: 64, 3: 8}  # 16 for 12 pixels are finer than 256 for 200
    # Steady: what was taken is taken again.
    assert levels(sizes, shared, local_texels=150_000) == shared
    # What cannot be held ends at the least.
    assert set(levels(sizes, local_texels=1).values()) == {detail.LEAST}
    told = detail.details(sizes, wr.Settings(local_texels=150_000), {})[1]
    assert "150,000" in told.reason and told.resolution == 128


def test_plan_says_how_fine_a_map_is_and_why(scene):
    off = plan_of(scene).rows[0]
    assert not off.effects["detail"].on and off.effects["detail"].reason == "local_detail=0, local_texels=0"
    plan = plan_of(scene, local_detail=0.05)
    (row,) = plan.rows
    effect = row.effects["detail"]
    assert effect.on and "local_detail=0.05" in effect.reason
    assert row.settings.local_resolution == effect.numbers["resolution"] < 64
    assert row.predicted["error_px"] > off.predicted["error_px"]
    frame = wr.render_frame(scene, plan)
    prepared = plan.prepared(row)
    # The reference maps stay as they are.
    assert prepared.local.resolution == row.settings.local_resolution and prepared.references.maps.resolution == 64
    assert np.isfinite(frame["RGBA"]).all()
    asked = plan_of(scene, local_detail=0.05, budget_ms=100.0).rows[0]
    assert not asked.effects["detail"].on and "a request" in asked.effects["detail"].reason
    other = plan_of(scene, "reference", local_detail=0.05).rows[0]
    assert not other.effects["detail"].on and not other.effects["kept_map"].on


def test_map_that_has_moved_little_is_kept_and_shows_the_same(scene):
    keep = {"local_keep_px": 2.0}
    plan = plan_of(scene, **keep)
    frame = wr.render_frame(scene, plan)
    first = plan.prepared(plan.rows[0])
    assert plan.rows[0].effects["kept_map"].on and "local_keep_px" in plan.rows[0].effects["kept_map"].reason
    kept, rebuilt = 0, 0
    for time in (1.03, 1.06, 1.5, 3.0):
        moved = scene.at(time)
        frame = wr.render_frame(moved, plan, previous=frame)
        prepared = frame.plan.prepared(frame.plan.rows[0])
        fresh = wr.render_frame(moved.at(time), plan_of(wr.load_stage(scene.data.source, time=time)))
        if frame.statistics.get("local_kept"):
            kept += 1
            np.testing.assert_array_equal(prepared.centre, first.centre)
            shift = layered_environment.shift_px(prepared.local, moved.data.instances[-1].world_from_object[:3, 3])
            assert 0.0 < shift < 2.0
        else:
            rebuilt += 1
            np.testing.assert_allclose(prepared.centre, moved.data.instances[-1].world_from_object[:3, 3], atol=1e-5)
        mirror = (frame["reflectorId"] > 0) & (fresh["reflectorId"] > 0)
        off = np.abs(frame["reflection"] - fresh["reflection"])[mirror].max(-1)
        assert np.mean(off) < 0.01 and np.quantile(off, 0.95) < 0.05, (time, np.mean(off), np.quantile(off, 0.95))
    assert kept and rebuilt


def test_shift_is_the_mean_angle_in_texels(scene):
    plan = plan_of(scene)
    local = plan.prepared(plan.rows[0]).local
    assert layered_environment.shift_px(local, local.centres[0]) == 0.0
    near, far = (layered_environment.shift_px(local, local.centres[0] + [0, step, 0]) for step in (0.01, 0.02))
    assert 0.0 < near < far < 2.0 * near + 1e-12


@pytest.mark.parametrize("name", ["local_resolution", "local_detail", "local_texels", "local_keep_px"])
def test_values_that_cannot_be_are_refused(name):
    with pytest.raises(ValueError, match=name):
        wr.Settings(**{name: -1})
