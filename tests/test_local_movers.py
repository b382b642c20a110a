"""What moves in local maps: a mirror's own vehicle is not in its own map, all else is, as rays meet it."""

from __future__ import annotations

import numpy as np
import pytest
import street
import warp as wp
from pxr import Gf, UsdGeom
from stage_samples import add_material, saved
from test_layered_environment import plan_of

import warp_reflect as wr
from warp_reflect.cubemap import texel_directions
from warp_reflect.environment_maps import empty_maps
from warp_reflect.techniques import environment, layered_environment, local_movers, local_shading


def car_stage(path, trailer: bool = False):
    """A street with a car: a mirror ball with a mast through it, a wheel that turns by itself, and a walker who is in no car."""
    stage = street.street(path, walker=True)
    stage.RemovePrim("/World/Ball")
    car = UsdGeom.Xform.Define(stage, "/World/Car")
    move = car.AddTranslateOp()
    for time, x in zip(street.TIMES, (street.START, street.END), strict=True):
        move.Set(Gf.Vec3d(x, street.HEIGHT, 0.0), time)
    sphere = UsdGeom.Sphere.Define(stage, "/World/Car/Ball")
    sphere.GetRadiusAttr().Set(0.5)
    street.bind(sphere, add_material(stage, "/World/Mirror", metallic=1.0, roughness=0.0, diffuseColor=(0.9, 0.9, 0.9)))
    street.box(stage, "/World/Car/Mast", (0, 0.3, 0), (0.1, 1.0, 0.1), (0.0, 0.0, 0.0))
    wheel = street.box(stage, "/World/Car/Wheel", (0, -0.4, 0), (0.2, 0.2, 0.8), (0.0, 0.0, 0.0))
    turn = wheel.AddRotateYOp()
    for time, angle in zip(street.TIMES, (0.0, 90.0), strict=True):
        turn.Set(angle, time)
    if trailer:
        street.box(stage, "/World/Car/Trailer", (-4.0, 0.2, 0), (6.0, 1.0, 0.8), (0.0, 0.0, 0.0))
    return stage


def load(path, time: float = 2.4, **options):
    return wr.load_stage(saved(car_stage(path, **options)), time=time)


def named(scene, parts) -> set[str]:
    return {scene.parts[k].prim_path.rpartition("/")[2] for k in parts}


def ball(scene) -> int:
    return next(k for k in scene.moving_parts if scene.parts[k].prim_path.endswith("Ball"))


def test_instances_name_what_they_move_by(tmp_path):
    scene = load(tmp_path / "car.usda")
    movers = {each.prim_path: each.mover for each in scene.data.instances if each.moves}
    assert movers == {
        "/World/Car/Ball": "/World/Car",
        "/World/Car/Mast": "/World/Car",
        "/World/Car/Wheel": "/World/Car/Wheel",
        "/World/Walker": "/World/Walker",
    }
    assert not any(each.mover for each in scene.data.instances if not each.moves)


def test_its_own_vehicle_is_not_in_a_mirrors_map(tmp_path):
    """As the traced picture has it but where the ball's own mast stands; with the vehicle shown, its inside is seen."""
    scene = load(tmp_path / "car.usda")
    plan, shown = plan_of(scene), plan_of(scene, local_own_size=0.0)
    assert [named(scene, each.prepared(each.rows[0]).movers) for each in (plan, shown)] == [
        {"Walker"},
        {"Walker", "Mast", "Wheel"},
    ]
    told = [note.text for note in plan.notes if note.path == "/World/Car/Ball"]
    assert told == [
        "its own vehicle is not in its local map: /World/Car/Mast, /World/Car/Wheel (local_own_size=2)"
    ] and not any("vehicle" in note.text for note in shown.notes)
    frames = [wr.render_frame(scene, each) for each in (plan, shown, plan_of(scene, "reference"))]
    mirror = frames[2]["reflectorId"] > 0
    off = [np.abs(frame["reflection"] - frames[2]["reflection"])[mirror].max(-1) for frame in frames[:2]]
    assert mirror.sum() > 1000 and off[0].mean() < 0.5 * off[1].mean() and np.median(off[0]) < 0.02
    walker = next(k for k, path in frames[0].prims.items() if path.endswith("Walker"))
    shown, real = (frame["reflectedId"] == walker for frame in (frames[0], frames[2]))
    assert real.sum() > 100 and (shown & real).sum() > 0.6 * (shown | real).sum()


@pytest.mark.parametrize(("size", "vehicle"), [(2.0, set()), (9.0, {"Mast", "Wheel", "Trailer"}), (0.0, set())])
def test_a_small_mirror_shows_the_large_vehicle_it_sits_on(tmp_path, size, vehicle):
    scene = load(tmp_path / "car.usda", trailer=True)
    settings = wr.Settings(local_own_size=size)
    assert named(scene, environment.vehicle_of(scene, ball(scene), settings)) == vehicle
    assert named(scene, environment.left_out(scene, ball(scene), settings)) == {"Ball", *vehicle}
    still = next(k for k, part in enumerate(scene.parts) if part.prim_path.endswith("Ground"))
    assert environment.vehicle_of(scene, still, settings) == ()


def test_vehicles_hold_in_time(tmp_path):
    scene = load(tmp_path / "car.usda")
    later = scene.at(3.0)
    layered_environment.take_over(scene, later)
    assert named(later, environment.vehicle_of(later, ball(later), wr.Settings())) == {"Mast", "Wheel"}


@pytest.mark.parametrize("size", [-1.0, 1e7, float("nan")])
def test_ratios_that_cannot_be_are_refused(size):
    with pytest.raises(ValueError, match="local_own_size"):
        wr.Settings(local_own_size=size)


def empty_map(scene, eye, edge: int, distance):
    """A local map at a place, scene frame, that holds nothing but distances of what stands still."""
    local = empty_maps(scene, (eye + scene.origin)[None], np.eye(3)[None], edge)
    local.view.distance = wp.array(distance, dtype=float, device=scene.device)
    local.view.triangle.fill_(-1)
    return local, wp.zeros(len(distance), dtype=wp.uint8, device=scene.device)


@pytest.mark.parametrize("edge", [16, 21, 48])
def test_texels_show_the_moving_triangles_that_their_rays_meet(tmp_path, edge, device):
    """From beside, within and above what moves, at two times of one tree: what rays through all triangles meet first."""
    first = wr.load_stage(saved(car_stage(tmp_path / "car.usda")), time=1.0, device=device)
    local_movers._movers(first)
    later = first.at(3.0)
    layered_environment.take_over(first, later)
    assert local_movers._movers(later).known is local_movers._movers(first).known
    directions = texel_directions(edge).reshape(-1, 3)
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    settings = wr.Settings(shadows="off", bounces=1, threads=1)
    for scene in (later, first, later):
        walker = next(part for part in scene.parts if part.prim_path.endswith("Walker"))
        own = scene.host_triangles[walker.first_triangle : walker.first_triangle + walker.triangle_count]
        middle = scene.host_points[own.reshape(-1)].mean(axis=0).astype(np.float64)
        for away in ([1.1, 0.2, 0.3], [0.01, 0.02, 0.03], [0.0, 3.0, 0.0]):
            eye = middle + away
            rays = np.tile(eye, (len(directions), 1)), directions, 1
            still, far = (tracer.trace(*rays) for tracer in (scene.still_tracer, scene.tracer))
            distance = np.where(still[0].numpy() >= 0, still[1].numpy(), 0.0).astype(np.float32)
            moves = np.zeros(scene.triangle_count, bool)
            for part in (scene.parts[k] for k in scene.moving_parts):
                moves[part.first_triangle : part.first_triangle + part.triangle_count] = True
            ask = (*empty_map(scene, eye, edge, distance), scene.moving_parts, lambda: None, settings)
            made, state, statistics = local_movers.draw_moving(scene, *ask)
            shown = state.numpy() == local_shading.TEXEL_SHADED
            met, t = far[0].numpy(), far[1].numpy()
            real = (met >= 0) & moves[met]
            apart = (distance == 0.0) | (np.abs(distance - t) > 1e-5 * distance)  # feet lie in the plane of the ground
            np.testing.assert_array_equal(shown[apart], real[apart])
            assert statistics["local_moving"] == shown.sum() >= 5
            both = shown & real
            np.testing.assert_allclose(made.distance(0).reshape(-1)[both], t[both], rtol=1e-5)
            assert (made.triangle(0).reshape(-1) == met)[both].mean() > 0.98
            np.testing.assert_array_equal(made.distance(0).reshape(-1)[~shown], distance[~shown])


def test_parts_that_are_not_asked_for_are_not_met(tmp_path):
    scene = load(tmp_path / "car.usda")
    part = ball(scene)
    eye = layered_environment.centre_of(scene, part) - scene.origin
    asked = local_movers.moving_in(scene, part, wr.Settings())
    ask = (*empty_map(scene, eye, 32, np.zeros(6 * 32 * 32, np.float32)), asked, lambda: None)
    made, _, _ = local_movers.draw_moving(scene, *ask, wr.Settings(shadows="off", bounces=1))
    triangle = made.triangle(0)
    walker = scene.parts[asked[0]]
    inside = (triangle >= walker.first_triangle) & (triangle < walker.first_triangle + walker.triangle_count)
    assert len(asked) == 1 and inside.any() and (inside | (triangle < 0)).all()
