"""What moves in local maps: a mirror's own vehicle is not in its own map, all else is, as rays meet it."""

from __future__ import annotations

import numpy as np
import pytest
import street
from pxr import Gf, UsdGeom
from stage_samples import add_material, saved
from test_layered_environment import plan_of

import warp_reflect as wr
from warp_reflect.techniques import layered_environment, local_movers


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
    assert named(scene, local_movers.vehicle_of(scene, ball(scene), settings)) == vehicle
    still = next(k for k, part in enumerate(scene.parts) if part.prim_path.endswith("Ground"))
    assert local_movers.vehicle_of(scene, still, settings) == ()


def test_vehicles_hold_in_time(tmp_path):
    scene = load(tmp_path / "car.usda")
    later = scene.at(3.0)
    layered_environment.take_over(scene, later)
    assert named(later, local_movers.vehicle_of(later, ball(later), wr.Settings())) == {"Mast", "Wheel"}


@pytest.mark.parametrize("size", [-1.0, 1e7, float("nan")])
def test_ratios_that_cannot_be_are_refused(size):
    with pytest.raises(ValueError, match="local_own_size"):
        wr.Settings(local_own_size=size)
