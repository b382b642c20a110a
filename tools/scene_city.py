"""A city of one square kilometre with moving cars that mirror it, and a crossing of it; after Meyer and Loscos 2003.

Eight roads cross between blocks of houses; reference environment maps stand at the crossings and between them, 54 of them as
in the paper; cars drive along the roads.
"""

from __future__ import annotations

import numpy as np
from pxr import Gf, UsdGeom
from scene_shapes import block, sheet
from scene_writer import Recipe, Writer

MAP_API = "WarpReflectEnvironmentMapAPI"
CITY = 1000.0  # edge [m]
ROADS = 4  # in either direction
ROAD_WIDTH = 12.0
MAP_HEIGHT = 1.2  # of reference maps over the road: a car's middle [m]
MAPS = 54
HOUSES_A_SIDE = 4  # of a block, along either of its edges
TREES = 8
FRAMES = 48
SECONDS = 2.0
QUEUE_GAP = 18.0  # between cars of one lane
SPEEDS = (9.0, 14.0)  # of cars [m/s]
PAINTS = ("Chrome", "PaintRed", "PaintBlue", "PaintGold")


def _roads() -> np.ndarray:
    """Where the middles of the roads cross the axes, in metres."""
    return (np.arange(ROADS) + 0.5) * CITY / ROADS - CITY / 2


def _map_places() -> list[tuple[float, float]]:
    """Crossings first, then the middles between them and the ends of the roads."""
    roads = _roads()
    between = np.concatenate([[-CITY / 2 + 30], 0.5 * (roads[1:] + roads[:-1]), [CITY / 2 - 30]])
    places = [(x, z) for x in roads for z in roads]
    places += [(x, z) for x in roads for z in between] + [(x, z) for z in roads for x in between]
    return places[:MAPS]


def _drive(w: Writer, path: str, start, way: int, speed: float, paint: str) -> None:
    """A car that keeps its lane; `way`: 0 to 3 for +x, +z, -x, -z."""
    direction = np.array([(1, 0, 0), (0, 0, 1), (-1, 0, 0), (0, 0, -1)][way], float)
    prim = w.part(path, "city_car", look=paint, instance=False)
    xform = UsdGeom.Xformable(prim)
    xform.ClearXformOpOrder()
    for op in prim.GetPropertyNames():
        if op.startswith("xformOp:"):
            prim.RemoveProperty(op)
    move = xform.AddTranslateOp()
    for time in (1, FRAMES):
        at = np.asarray(start, float) + direction * speed * SECONDS * (time - 1) / (FRAMES - 1)
        move.Set(Gf.Vec3d(*np.round(at, 3).tolist()), time)
    xform.AddRotateYOp().Set(float((90, 0, 270, 180)[way]))


def _maps(w: Writer, places) -> None:
    for k, (x, z) in enumerate(places):
        prim = UsdGeom.Xform.Define(w.stage, f"/World/Maps/M{k:02d}")
        prim.AddTranslateOp().Set(Gf.Vec3d(round(float(x), 3), MAP_HEIGHT, round(float(z), 3)))
        prim.GetPrim().AddAppliedSchema(MAP_API)


def _range(w: Writer) -> None:
    w.stage.SetStartTimeCode(1)
    w.stage.SetEndTimeCode(FRAMES)
    w.stage.SetTimeCodesPerSecond(FRAMES / SECONDS)
    w.stage.SetFramesPerSecond(FRAMES / SECONDS)


def _see_far(w: Writer) -> None:
    UsdGeom.Camera.Get(w.stage, "/World/Camera").CreateClippingRangeAttr(Gf.Vec2f(0.1, 3000.0))


def _city(cars: int):
    def make(w: Writer) -> None:
        _range(w)
        rng = np.random.default_rng(11)
        half, roads = CITY / 2, _roads()
        ground = sheet((-half, 0, half), (CITY, 0, 0), (0, 0, -CITY), 1, 1)
        w.mesh("/World/Ground", ground, "Stone")
        for k, x in enumerate(roads):
            strip = sheet((x - ROAD_WIDTH / 2, 0.02, half), (ROAD_WIDTH, 0, 0), (0, 0, -CITY), 1, 1)
            w.mesh(f"/World/Roads/X{k}", strip, "Steel")
            w.mesh(f"/World/Roads/Z{k}", strip.moved((-x, 0.01, 0)).moved(rotate=(0, 90, 0)).moved((0, 0, x)), "Steel")
        edges = [-half, *roads, half]
        number = 0
        for i in range(ROADS + 1):
            for j in range(ROADS + 1):
                low = np.array([edges[i], edges[j]]) + ROAD_WIDTH / 2 + 6
                high = np.array([edges[i + 1], edges[j + 1]]) - ROAD_WIDTH / 2 - 6
                for a in range(HOUSES_A_SIDE):
                    for b in range(HOUSES_A_SIDE):
                        x, z = low + (high - low) * (np.array([a, b]) + 0.5) / HOUSES_A_SIDE
                        kind, turn = "abcd"[rng.integers(4)], 90.0 * rng.integers(4)
                        fit = min(1.0, float((high - low).min()) / HOUSES_A_SIDE / 34.0)
                        scale = (fit, 0.7 + 0.8 * rng.random(), fit)
                        place = (round(float(x), 2), 0, round(float(z), 2))
                        w.part(
                            f"/World/Houses/H{number:03d}",
                            f"city_house_{kind}",
                            place,
                            (0, turn, 0),
                            tuple(round(float(s), 3) for s in scale),
                        )
                        number += 1
        for k in range(TREES):
            x, z = roads[k % ROADS] + (9.0 if k % 2 else -9.0), roads[(k // ROADS) * 2] + 30.0 + 18.0 * (k % 3)
            w.part(f"/World/Trees/T{k}", "city_tree", (float(x), 0, float(z)))
        _maps(w, _map_places())
        for k in range(cars):
            # Four lanes that cross before the camera, the first cars nearest to it.
            road, way = float(roads[1]), k % 4
            lane = 2.8 * (1 if way in (0, 3) else -1)
            along = road + QUEUE_GAP * (1, -1)[k // 4 % 2] * (0.5 + k // 8) + (0.25 - 0.5 * (way // 2)) * QUEUE_GAP
            start = (along, 0.03, road + lane) if way % 2 == 0 else (road + lane, 0.03, along)
            _drive(w, f"/World/Cars/C{k:02d}", start, way, float(rng.uniform(*SPEEDS)), PAINTS[k % len(PAINTS)])
        x, z = roads[1], roads[1]
        w.camera((float(x) + 17.0, 7.5, float(z) + 24.0), (float(x) - 6.0, 0.5, float(z) - 30.0), 42)
        _see_far(w)
        w.lights(sun_rotate=(-52, 34, 0))

    return make


def _city_block(w: Writer) -> None:
    """One crossing: four houses, three shrubs, three cars, five reference maps."""
    _range(w)
    half = 45.0
    w.mesh("/World/Ground", sheet((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), 1, 1), "Stone")
    strip = sheet((-ROAD_WIDTH / 2, 0.02, half), (ROAD_WIDTH, 0, 0), (0, 0, -2 * half), 1, 1)
    w.mesh("/World/Roads/X0", strip, "Steel")
    w.mesh("/World/Roads/Z0", strip.moved((0, 0.01, 0)).moved(rotate=(0, 90, 0)), "Steel")
    for k, (x, z) in enumerate(((-1, -1), (1, -1), (1, 1), (-1, 1))):
        place, turn = (22.0 * x, 0, 22.0 * z), (0, 90.0 * k, 0)
        w.part(f"/World/Houses/H{k}", f"city_house_{'abcd'[k]}", place, turn, (0.95, 0.6, 0.95))
    for k, (x, z) in enumerate(((-8.5, -13.0), (10.5, -9.5), (-9.5, 12.0))):
        w.part(f"/World/Trees/T{k}", "city_shrub", (x, 0, z), (0, 40 * k, 0), 0.55)
    for k, look in enumerate(("Red", "Yellow", "SkyBlue")):
        w.mesh(
            f"/World/Signs/S{k}", block((0.9, 2.2 + 0.5 * k, 0.25), w.detail).moved((7.2, 0.02, 6.4 - 6.0 * k)), look
        )
    _maps(w, ((0, 0), (-18, 0), (18, 0), (0, -18), (0, 18)))
    _drive(w, "/World/Cars/C0", (-2.5, 0.03, 2.8), 0, 9.0, "Chrome")
    _drive(w, "/World/Cars/C1", (-2.8, 0.03, -9.0), 1, 6.0, "PaintRed")
    _drive(w, "/World/Cars/C2", (5.2, 0.03, -2.8), 2, 10.0, "PaintGold")
    w.camera((4.6, 2.5, 8.6), (0.5, 0.7, -0.4), 42)
    _see_far(w)
    w.lights(sun_rotate=(-52, 34, 0))


CARS = tuple(f"/World/Cars/C{k}/Body" for k in range(3))
CITY_SCENES = {
    "city_block": Recipe(
        _city_block,
        "A crossing with cars that drive and mirror it, with reference environment maps; after Meyer and Loscos 2003",
        CARS,
        techniques=("reflector_map", "raytraced"),
        # Strips of road lie a centimetre above one another: measured 0.9924 at 160x90 (9 of 1,177 pixels show the other
        # strip), 0.9986 at 320x180.
        min_identical=0.99,
    ),
}
# Written on demand: their trees alone are megabytes.
LARGE_CITIES = {
    f"city_{cars}": Recipe(
        _city(cars),
        f"A square kilometre of city with {cars} cars; after Meyer and Loscos 2003, section 5",
        tuple(f"/World/Cars/C{k:02d}/Body" for k in range(cars)),
        techniques=("reflector_map", "raytraced"),
    )
    for cars in (15, 30)
}
