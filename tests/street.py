"""A street: houses of many colours on both sides, a mirror ball that rolls along it, reference environment maps on its way."""

from __future__ import annotations

import numpy as np
from pxr import Gf, UsdGeom, UsdLux
from stage_samples import add_material, bind, new_stage

TIMES = (1.0, 5.0)
START, END, HEIGHT = -6.0, 6.0, 0.6
PLACES = ((-6.0, HEIGHT, 0.0), (0.0, HEIGHT, 0.0), (6.0, HEIGHT, 0.0))
MAP_API = "WarpReflectEnvironmentMapAPI"


def box(stage, path: str, middle, size, color) -> UsdGeom.Cube:
    cube = UsdGeom.Cube.Define(stage, path)
    cube.GetSizeAttr().Set(1.0)
    cube.AddTranslateOp().Set(Gf.Vec3d(*middle))
    cube.AddScaleOp().Set(Gf.Vec3f(*size))
    cube.GetDisplayColorAttr().Set([Gf.Vec3f(*color)])
    return cube


def ball(
    stage, path: str, material, radius: float = 0.5, at=((START, HEIGHT, 0.0), (END, HEIGHT, 0.0))
) -> UsdGeom.Sphere:
    """A mirror ball that rolls from one place to another over `TIMES`."""
    sphere = UsdGeom.Sphere.Define(stage, path)
    sphere.GetRadiusAttr().Set(radius)
    move = sphere.AddTranslateOp()
    for time, place in zip(TIMES, at, strict=True):
        move.Set(Gf.Vec3d(*place), time)
    bind(sphere, material)
    return sphere


def place_map(stage, name: str, at):
    prim = UsdGeom.Xform.Define(stage, f"/World/Maps/{name}")
    prim.AddTranslateOp().Set(Gf.Vec3d(*at))
    prim.GetPrim().AddAppliedSchema(MAP_API)
    return prim.GetPrim()


def street(path, places=PLACES, walker: bool = False, houses: int = 6):
    """Write the stage to `path` and return it."""
    stage = new_stage(path)
    stage.SetStartTimeCode(TIMES[0])
    stage.SetEndTimeCode(TIMES[1])
    rng = np.random.default_rng(7)
    box(stage, "/World/Ground", (0, -0.05, 0), (60, 0.1, 30), (0.3, 0.3, 0.32))
    for k in range(houses):
        x = -12.5 + 25.0 * k / max(houses - 1, 1)
        for side in (-1, 1):
            high = rng.uniform(2, 6)
            name = f"/World/House{k}{'LR'[side > 0]}"
            box(stage, name, (x, high / 2, 4.0 * side), (3.2, high, 2.5), rng.uniform(0.1, 0.9, 3))
            box(stage, name + "Door", (x, 0.6, 2.7 * side), (0.7, 1.2, 0.2), rng.uniform(0.1, 0.9, 3))
    chrome = add_material(stage, "/World/Chrome", metallic=1.0, roughness=0.0, diffuseColor=(0.9, 0.9, 0.9))
    ball(stage, "/World/Ball", chrome)
    if walker:
        moving = box(stage, "/World/Walker", (0, 0, 0), (0.4, 1.7, 0.4), (0.9, 0.1, 0.1))
        op = moving.GetOrderedXformOps()[0]
        op.Set(Gf.Vec3d(-5, 0.85, 1.2), TIMES[0])
        op.Set(Gf.Vec3d(7, 0.85, 1.2), TIMES[1])
    for k, at in enumerate(places):
        place_map(stage, f"M{k}", at)
    dome = UsdLux.DomeLight.Define(stage, "/World/Sky")
    dome.GetIntensityAttr().Set(0.6)
    sun = UsdLux.DistantLight.Define(stage, "/World/Sun")
    sun.GetIntensityAttr().Set(1.5)
    sun.GetAngleAttr().Set(0.0)
    sun.AddRotateXYZOp().Set(Gf.Vec3f(-50, 30, 0))
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.GetClippingRangeAttr().Set(Gf.Vec2f(0.01, 500))
    camera.GetFocalLengthAttr().Set(30)
    move = camera.AddTranslateOp()
    move.Set(Gf.Vec3d(START + 0.3, HEIGHT + 0.3, 2.2), TIMES[0])
    move.Set(Gf.Vec3d(END + 0.3, HEIGHT + 0.3, 2.2), TIMES[1])
    camera.AddRotateXYZOp().Set(Gf.Vec3f(-6, 6, 0))
    stage.GetRootLayer().Save()
    return stage
