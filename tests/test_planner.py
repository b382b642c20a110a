"""What a plan decides, and why: every decision with its measured value, its threshold and the setting that moves it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from rooms import CHROME, identical, placed, plane_room, render, room, sphere

import warp_reflect as wr
from warp_reflect import bvh, launch, planner, probe
from warp_reflect.layers import ReflectionLayer
from warp_reflect.scene import LightData, MirrorData, Scene
from warp_reflect.settings import Technique

SIZE = (160, 90)


def planned(scene, camera=None, method="auto", **settings):
    (row,) = wr.make_plan(scene, camera, SIZE, wr.Settings(**settings), method).rows
    return row


def looking_away(scene):
    camera = wr.make_plan(scene, size=SIZE).camera
    return dataclasses.replace(camera, right=-camera.right, forward=-camera.forward)


@pytest.fixture(scope="module")
def ball_room(device):
    return Scene(room(sphere(), placed(0, 0, 0)).data, device)


def test_mirror_out_of_view_costs_nothing(ball_room):
    plan = wr.make_plan(ball_room, looking_away(ball_room), SIZE)
    (row,) = plan.rows
    assert row.pixels == 0 and not row.effects["reflection"].on and "not seen" in row.reason
    assert row.predicted["ms"] == 0.0 and row.predicted["bytes"] == 0
    with launch.recorded() as launches:
        frame = wr.render_frame(ball_room, plan)
    assert not frame.layers and not plan._prepared
    assert not [name for name, _ in launches if "trace" in name or "techniques" in name or "mirror_pixels" in name]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"eye": np.array([np.nan, 0.0, 0.0])}, r"eye: got \[nan"),
        ({"forward": np.array([0.0, np.inf, 0.0])}, "forward: got"),
        ({"fx": np.nan}, "fx: got nan"),
        ({"fx": 0.0}, "fx: got 0"),
        ({"near": np.nan}, "near: got nan"),
    ],
)
def test_cameras_that_see_nothing_are_refused(change, told, ball_room):
    plan = wr.make_plan(ball_room, size=SIZE)
    camera = dataclasses.replace(plan.camera, **change)
    with pytest.raises(ValueError, match=f"camera: {told}"):
        wr.make_plan(ball_room, camera, SIZE)
    with pytest.raises(ValueError, match=f"camera: {told}"):
        wr.render_frame(ball_room, plan, camera)


def test_tiny_mirror_gets_the_cheapest_without_a_look_at_its_shape(ball_room):
    pixels = planned(ball_room).pixels
    scene = Scene(ball_room.data, str(ball_room.device))
    row = planned(scene, few_pixels=pixels + 1)
    assert row.technique == "raytraced" and f"few_pixels={pixels + 1}" in row.reason and str(pixels) in row.reason
    assert not scene.bodies, "its shape was looked at"
    assert "few_pixels" not in planned(ball_room, few_pixels=pixels).reason


@pytest.mark.parametrize("bump, flat", [(0.0, True), (2.0e-5, True), (2.0e-2, False)])
def test_flat_mesh_is_a_plane_within_a_bound_in_pixels(bump, flat, device):
    data = plane_room().data
    data.meshes[0] = dataclasses.replace(data.meshes[0], points=data.meshes[0].points.copy())
    data.meshes[0].points[4, 1] += bump  # the middle of 3 x 3 points, along the plane's normal
    scene = Scene(data, device)
    row = planned(scene, method="planar")
    assert (row.technique == "planar") == flat
    assert ("shape_px=0.5" in row.reason) == (bump > 0.0), row.reason
    if flat:
        assert identical(render(scene, "planar"), render(scene, "reference")) >= 0.999
    else:
        assert planned(scene, method="planar", shape_px=1e3).technique == "planar"


@pytest.mark.parametrize("method", ["reference", "reflector_map", "quadric"])
def test_second_frame_of_a_still_scene_recomputes_nothing(method, ball_room):
    first = render(ball_room, method)
    with launch.recorded() as launches:
        second = wr.render_frame(ball_room, first.plan, previous=first)
    assert launches == []
    assert second.kept == {1} and second.layers[1] is first.layers[1]
    np.testing.assert_array_equal(second["RGBA"], first["RGBA"])
    assert np.abs(second["reflectionMotion"]).max() < 1.0e-3


def test_still_frame_is_made_anew_where_asked_for_or_where_something_moved(ball_room):
    first = render(ball_room, "quadric")
    camera = dataclasses.replace(first.camera, eye=first.camera.eye + [0.01, 0.0, 0.0])
    for frame in (
        render(ball_room, "quadric", previous=first, keep_static=False),
        render(ball_room, "quadric", previous=first, camera=camera),
        render(ball_room, "reflector_map", previous=first),
        render(Scene(ball_room.data, str(ball_room.device)), "quadric", previous=first),
    ):
        assert not frame.kept


def test_eye_view_drawn_to_decide_is_the_frames_own(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE)
    anew = dataclasses.replace(plan, _seen=None, _prepared={})
    with launch.recorded() as launches:
        frame = wr.render_frame(ball_room, plan)
    drawn = [name for name, _ in launches if "raster" in name or "reflector_id" in name or "mirror_pixels" in name]
    assert not [name for name in drawn if "virtual" not in name and "techniques" not in name], drawn
    assert frame.timings["raster"] > 0.0 and frame.timings["mirror_pixels"] > 0.0, "what planning drew counts"
    assert plan.take_view(frame.camera) is None, "it serves one frame"
    other = wr.render_frame(ball_room, anew)
    for name in ("RGBA", "reflectorId", "reflectedPoint"):
        assert np.array_equal(frame[name], other[name]), name


def test_eye_view_serves_no_other_camera_and_no_other_mirrors(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE)
    away = looking_away(ball_room)
    assert dataclasses.replace(plan).take_view(away) is None
    assert dataclasses.replace(plan, rows=[]).take_view(plan.camera) is None
    assert dataclasses.replace(plan).take_view(plan.camera).pixels[1].count == plan.rows[0].pixels > 0


def test_the_same_asked_again_is_decided_by_nothing_new(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE)
    with launch.recorded() as launches:
        again = wr.make_plan(ball_room, plan.camera, SIZE, earlier=plan)
    assert not launches and again is not plan and str(again) == str(plan)
    with launch.recorded() as launches:
        wr.make_plan(ball_room, plan.camera, SIZE, plan.settings.replace(few_pixels=3), earlier=plan)
    assert launches, "another request is decided anew"


def test_small_mirrors_are_tried_at_points_of_their_own():
    pixel = np.sort(np.random.default_rng(5).choice(10000, 4000, replace=False)).astype(np.int32)
    grid = np.arange(3, 10000, 7, dtype=np.int32)
    place, on_grid = probe._some(pixel, np.intersect1d(pixel, grid))
    assert np.array_equal(pixel[place], np.intersect1d(pixel, grid)) and on_grid.all()
    few = pixel[:300]
    place, on_grid = probe._some(few, np.intersect1d(few, grid))
    assert len(place) >= probe.LEAST_TRIED and (np.diff(place) > 0).all()
    assert np.array_equal(few[place[on_grid]], np.intersect1d(few, grid))
    place, _ = probe._some(pixel[:5], np.intersect1d(pixel[:5], grid))
    assert np.array_equal(place, np.arange(5)), "all of fewer"
    assert not len(probe._some(pixel[:0], grid[:0])[0])


def test_mirrors_that_are_tried_together_show_what_each_shows_alone(device):
    """A mirror before another, and an open bowl that sees itself and what its back is left by."""
    stage = Path(__file__).parent.parent / "usd_scenes"
    for name in ("two_spheres", "open_bowl", "facing_mirrors"):
        scene = wr.load_stage(stage / f"{name}.usda", device=str(device))
        plan = wr.make_plan(scene, size=(320, 180))
        parts = {row.reflector.id: row.reflector.part for row in plan.rows}
        together = probe.probe(scene, probe.look(scene, plan.camera, parts))
        assert together.mirrored
        for id, part in parts.items():
            seen = probe.look(scene, plan.camera, parts)
            layer = bvh_layer(scene, seen, id, part)
            pixel = seen.pixels[id].pixel.numpy()
            stride = 320 // probe.TRIED_SIDE | 1
            row, column = pixel // 320, pixel % 320
            grid = pixel[(row % stride == stride // 2) & (column % stride == stride // 2)]
            shown = layer.triangle.numpy()[probe._some(pixel, grid)[0]]
            patch = scene.host_triangle_patch[shown[shown >= 0]]
            for other in parts.values():
                share = np.isin(patch, list(scene.parts[other].patches)).sum() / max(len(shown), 1)
                assert together.mirrored.get(part, {}).get(other, 0.0) == pytest.approx(share)


def bvh_layer(scene, seen, id, part):
    layer = ReflectionLayer.empty(seen.pixels[id], Technique.RAYTRACED, scene.device)
    bvh.trace_pixels(scene, seen.gbuffer, layer.pixels, layer, part, False)
    return layer


def lit(lights, device, **more):
    data = room(sphere(), placed(0, 0, 0)).data
    return Scene(dataclasses.replace(data, lights=lights), device), {
        "size": (320, 180),
        "settings": wr.Settings(**more),
    }


def test_few_points_decide_what_is_clear_and_all_decide_the_rest(device, monkeypatch):
    spacings = []
    tried = probe.probe
    monkeypatch.setattr(planner, "probe", lambda *given: spacings.append(given[3]) or tried(*given))
    high = LightData("/sun", "distant", (2.0, 2.0, 2.0), placed(0, 0, 0))
    high.world_from_light[:3, :3] = [[1, 0, 0], [0, 0.6, 0.8], [0, -0.8, 0.6]]
    scene, asked = lit([high], device)
    numbers = wr.make_plan(scene, **asked).lights[0].effects["shadows"].numbers
    assert spacings == [2] and numbers["taken"] > 10.0 * numbers["threshold"]
    taken = numbers["taken"]
    spacings.clear()
    scene, asked = lit([high], device, shadow_min_share=0.5)
    numbers = wr.make_plan(scene, **asked).lights[0].effects["shadows"].numbers
    assert spacings == [2, 1] and numbers["taken"] == pytest.approx(taken, abs=0.03)  # two deviations of 460 points


@pytest.mark.parametrize("size", [(1, 1), (1, 400), (400, 1), (2000, 9)])
def test_pictures_narrower_than_the_grid_of_points_are_tried_too(size, device):
    """Two mirrors that may show each other under a light."""
    scene, asked = lit([LightData("/sun", "distant", (2.0, 2.0, 2.0), placed(0, 0, 0))], device, bounces=2)
    scene.data.instances.append(dataclasses.replace(scene.data.instances[0], prim_path="/other"))
    scene = Scene(scene.data, device)
    plan = wr.make_plan(scene, **asked | {"size": size})
    assert len(plan.rows) == 2 and all(np.isfinite(row.effects["shadows"].numbers["taken"]) for row in plan.lights)
    assert np.isfinite(wr.render_frame(scene, plan)["RGBA"]).all()


def test_one_setting_changed_on_a_still_scene_draws_the_same_pixels_anew(ball_room):
    first = render(ball_room, "quadric")
    second = render(ball_room, "quadric", previous=first, walk_hops=2)
    assert not second.kept and second.gbuffer is first.gbuffer
    np.testing.assert_array_equal(second["status"], first["status"])


def chosen_room(mirror, where, seen, device):
    """A room whose mirror shows some of its prims, and the same room with nothing but those and the mirror."""
    data = room(mirror, where).data
    paths = tuple(each.prim_path for each in data.instances if seen(each.prim_path))
    asks = dataclasses.replace(CHROME, mirror=MirrorData("/mirror", reflects=paths))
    all_of_it = dataclasses.replace(data, materials=[asks, data.materials[1]])
    kept = [each for each in data.instances if each.prim_path in ("/mirror", *paths)]
    return Scene(all_of_it, device), Scene(dataclasses.replace(data, instances=kept), device)


@pytest.mark.parametrize("method", ["reference", "quadric", "reflector_map", "explosion_map"])
@pytest.mark.parametrize("refine", ["exact", "off"])
def test_mirror_shows_what_its_collection_names_and_nothing_else(method, refine, device):
    # The last balls are left out: the others keep their ids.
    scene, rest = chosen_room(sphere(), placed(0, 0, 0), lambda path: path in ("/floor", "/ball0", "/ball1"), device)
    shown, expected = (render(each, method, refine=refine) for each in (scene, rest))
    assert set(np.unique(shown["reflectedId"])) <= {0, 2, 3, 4}
    assert shown["primId"].max() > 4, "the others are there, only not in the mirror"
    # Left-out vertices change no other: away from the edges of what stands before the mirror the pictures are the same.
    assert identical(shown, expected) >= 0.999
    row = shown.plan.rows[0]
    assert row.effects["collection"].on and "reflects" in row.effects["collection"].reason


def test_planar_mirror_and_one_that_could_see_itself_obey_their_collection(device):
    for method in ("planar", "reference"):
        scene, rest = chosen_room(
            plane_room().data.meshes[0],
            plane_room().data.instances[0].world_from_object,
            lambda path: path == "/floor",
            device,
        )
        shown = render(scene, method)
        assert shown.plan.rows[0].technique == ("planar" if method == "planar" else "raytraced")
        assert set(np.unique(shown["reflectedId"])) == {0, 2}
        assert identical(shown, render(rest, method)) >= 0.999


def test_empty_collection_shows_the_sky_alone(device):
    scene, _ = chosen_room(sphere(), placed(0, 0, 0), lambda path: False, device)
    for method in ("reference", "quadric"):
        assert not render(scene, method)["reflectedId"].any()
