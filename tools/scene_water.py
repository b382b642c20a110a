"""Scenes of what is seen through surfaces and on water: `frosted_window`, `pool`."""

from __future__ import annotations

import math

import numpy as np
from pxr import Sdf
from scene_parts import checked_sheet
from scene_shapes import sheet, sweep, torus
from scene_writer import Recipe, Writer


def finish(prim, interface: str = "", **numbers) -> None:
    """Apply `WarpReflectFinishAPI` to a prim with these attributes; colours are three numbers."""
    prim.AddAppliedSchema("WarpReflectFinishAPI")
    if interface:
        token = prim.CreateAttribute("warp_reflect:interface", Sdf.ValueTypeNames.Token, False, Sdf.VariabilityUniform)
        token.Set(interface)
    for name, value in numbers.items():
        kind = Sdf.ValueTypeNames.Float if np.ndim(value) == 0 else Sdf.ValueTypeNames.Color3f
        prim.CreateAttribute(f"warp_reflect:{name}", kind, False).Set(value)


def _frosted_window(w: Writer) -> None:
    """Three panes over a polished floor; after figure 9.44 of Real-Time Rendering, 3rd edition."""
    d = w.detail
    low, high, half = 0.55, 1.95, 1.5  # of the opening; to its sides [m]
    room, ceiling = 2.6, 2.5
    walls = [
        sheet((-room, 0, 0), (2 * room, 0, 0), (0, low, 0), d.count(10), d.count(2)),
        sheet((-room, high, 0), (2 * room, 0, 0), (0, ceiling - high, 0), d.count(10), d.count(2)),
        sheet((-room, low, 0), (room - half, 0, 0), (0, high - low, 0), d.count(2), d.count(5)),
        sheet((half, low, 0), (room - half, 0, 0), (0, high - low, 0), d.count(2), d.count(5)),
    ]
    for k, wall in enumerate(walls):
        w.mesh(f"/World/Room/Window{k}", wall, "Plaster")
    for name, x, turn in (("Left", -room, 90), ("Right", room, -90)):
        side = checked_sheet((-2, 0, 0), (4, 0, 0), (0, ceiling, 0), 8, 5, ((0.62, 0.3, 0.2), (0.66, 0.6, 0.5)), d)
        w.mesh(f"/World/Room/{name}", side.moved((x, 0, 2), rotate=(0, turn, 0)))
    w.mesh(
        "/World/Room/Ceiling",
        sheet((-room, ceiling, 0), (2 * room, 0, 0), (0, 0, 4), d.count(8), d.count(6)),
        "Ceiling",
    )
    for k, x in enumerate((-half, -0.5, 0.5, half)):
        w.cube(f"/World/Frame/Post{k}", (x, low, 0), (0.06, high - low, 0.1), "DarkWood")
    for k, y in enumerate((low - 0.03, high - 0.03)):
        w.cube(f"/World/Frame/Rail{k}", (0, y, 0), (2 * half + 0.06, 0.06, 0.12), "DarkWood")
    w.cube("/World/Frame/Sill", (0, low - 0.06, 0.12), (2 * half + 0.2, 0.03, 0.24), "White")
    for name, x, look in (("Frosted", -1.5, "FrostedGlass"), ("Clear", -0.5, "Glass"), ("Misted", 0.5, "Glass")):
        w.mesh(f"/World/Panes/{name}", sheet((x, low, 0), (1, 0, 0), (0, high - low, 0), 1, 1), look, double_sided=True)
    finish(w.stage.GetPrimAtPath("/World/Panes/Frosted"), frost=9.0)
    finish(w.stage.GetPrimAtPath("/World/Panes/Misted"), frost=3.0, frostDistance=2.5, frostColor=(0.95, 0.93, 0.9))
    floor = w.mesh("/World/Floor", sheet((-room, 0, 4), (2 * room, 0, 0), (0, 0, -4), 1, 1), "BlackMarble")
    finish(floor.GetPrim(), fadeDistance=1.2, fadeColor=(0.0, 0.0, 0.0))
    # Behind: what touches the glass, what stands near it and what is far.
    garden = checked_sheet((-9, 0, -0.05), (18, 0, 0), (0, 0, -18), 18, 18, ((0.2, 0.36, 0.1), (0.3, 0.42, 0.16)), d)
    w.mesh("/World/Garden/Ground", garden)
    for k, x in enumerate((-1.2, -0.15, 0.85)):
        w.part(f"/World/Garden/Plant{k}", "plant", (x, low, -0.14), (0, 50 * k, 0), 1.3)
        w.cube(f"/World/Garden/Box{k}", (x, low - 0.1, -0.14), (0.34, 0.1, 0.2), "Terracotta")
    for k, (x, y, z, look) in enumerate(
        (
            (-0.95, 1.35, -0.6, "Red"),
            (0.1, 1.45, -0.6, "Lemon"),
            (1.15, 1.4, -0.6, "SkyBlue"),
            (-1.35, 1.75, -2.2, "Purple"),
            (-0.35, 1.9, -2.2, "Orange"),
            (0.8, 1.85, -2.2, "Green"),
        )
    ):
        w.part(f"/World/Garden/Balloon{k}", "balloon", (x, y, z), (0, 0, 6 * (k % 3) - 6), 1.2, look)
    for k, (x, z, height, look) in enumerate(
        (
            (-5.0, -9.0, 3.6, "Coral"),
            (-2.6, -7.0, 3.0, "Cream"),
            (-0.6, -10.0, 4.2, "Teal"),
            (1.2, -7.5, 3.1, "Terracotta"),
            (3.2, -9.5, 3.9, "Navy"),
            (5.4, -8.0, 3.4, "Orange"),
        )
    ):
        w.cube(f"/World/Garden/House{k}", (x, 0, z), (1.5, height, 1.5), look)
    for k, (name, x, z, turn, size, look) in enumerate(
        (
            ("pawn", -1.3, 0.55, 0, 1.5, "Coral"),
            ("ring_tower", -0.6, 0.8, 20, 1.3, None),
            ("toy_block", 0.1, 0.5, 25, 1.3, "Blue"),
            ("beach_ball", 0.75, 0.85, 40, 0.9, None),
            ("pawn", 1.35, 0.5, 0, 1.3, "SkyBlue"),
        )
    ):
        w.part(f"/World/Things/Thing{k}", name, (x, 0, z), (0, turn, 0), size, look)
    w.camera((0.0, 1.15, 3.8), (0.0, 0.76, 0.0), 38)
    w.lights(sun_rotate=(-48, 160, 0))
    w.lamp("/World/Lamp", (0, 2.2, 2.6), 0.12, 160.0)


BASIN = ((0.12, 0.42, 0.5), (0.62, 0.75, 0.74))
HALL = (
    ((0.72, 0.56, 0.32), (0.5, 0.2, 0.13)),
    ((0.16, 0.36, 0.46), (0.66, 0.7, 0.66)),
    ((0.3, 0.46, 0.22), (0.72, 0.7, 0.5)),
    ((0.5, 0.26, 0.44), (0.78, 0.62, 0.66)),
)


def _pool(w: Writer) -> None:
    """A pool in a hall, its water moved by waves; after figures 9.42 and 9.45 of Real-Time Rendering, 3rd edition."""
    d = w.detail
    x0, x1, z0, z1, deep = -2.4, 2.4, -3.6, 1.8, 1.1
    _hall(w, 4.6, 3.6, (x0, x1, z0, z1))
    bottom = checked_sheet((x0, -deep, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1), 16, 18, BASIN, d)
    w.mesh("/World/Basin/Bottom", bottom)
    for name, corner, across in (
        ("Back", (x0, -deep, z0), (x1 - x0, 0, 0)),
        ("Front", (x1, -deep, z1), (x0 - x1, 0, 0)),
        ("Left", (x0, -deep, z1), (0, 0, z0 - z1)),
        ("Right", (x1, -deep, z0), (0, 0, z1 - z0)),
    ):
        w.mesh(f"/World/Basin/{name}", checked_sheet(corner, across, (0, deep + 0.06, 0), 16, 4, BASIN, d))
    for k, (x, z, width, depth) in enumerate(
        (
            (0, z0 - 0.15, x1 - x0 + 0.6, 0.3),
            (0, z1 + 0.15, x1 - x0 + 0.6, 0.3),
            (x0 - 0.15, 0.5 * (z0 + z1), 0.3, z1 - z0),
            (x1 + 0.15, 0.5 * (z0 + z1), 0.3, z1 - z0),
        )
    ):
        w.cube(f"/World/Basin/Rim{k}", (x, 0.06, z), (width, 0.06, depth), "Stone")
    water = w.mesh("/World/Water", sheet((x0, 0, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1), 1, 1), "Water")
    finish(
        water.GetPrim(),
        interface="solid",
        waveSlope=0.035,
        waveLength=0.7,
        waveSpeed=0.5,
        frostDistance=6.0,
        frostColor=(0.05, 0.22, 0.24),
    )
    _reeds(w, x0, x1, z0, z1, deep)
    _chandelier(w, (0.0, 1.75, -1.5), 3.6)
    for k, (x, z, look) in enumerate(((-0.9, 0.4, "Coral"), (0.8, -0.3, "Lemon"), (1.5, -2.3, "SkyBlue"))):
        w.part(f"/World/Balls/Ball{k}", "beach_ball", (x, -0.12, z), (10 * k, 70 * k, 0), 0.8, look)
    for k, (x, z, look) in enumerate(((-1.4, -0.9, "Red"), (0.1, 0.7, "Orange"), (1.2, 0.9, "Purple"))):
        w.cube(f"/World/Balls/Sunk{k}", (x, -deep, z), (0.3, 0.3, 0.3), look, (0, 25 * k, 0))
    w.camera((0.0, 0.95, 2.75), (0.0, 0.36, -1.5), 46)
    w.room_lights(3.3, 0.12, 2.6)


def _hall(w: Writer, half: float, high: float, hole) -> None:
    """A square room whose floor leaves a hole free."""
    d, (x0, x1, z0, z1) = w.detail, hole
    for k, palette in enumerate(HALL):
        wall = checked_sheet((-half, 0, -half), (2 * half, 0, 0), (0, high, 0), 14, 6, palette, d)
        w.mesh(f"/World/Hall/Wall{k}", wall.moved(rotate=(0, 90 * k, 0)))
    floors = (
        (-half, half, 2 * half, half - z1),
        (-half, z0, 2 * half, half + z0),
        (-half, z1, half + x0, z1 - z0),
        (x1, z1, half - x1, z1 - z0),
    )
    for k, (x, z, width, depth) in enumerate(floors):
        cells = [d.count(max(round(edge), 1)) for edge in (width, depth)]
        part = sheet((x, 0.08, z), (width, 0, 0), (0, 0, -depth), *cells)
        w.mesh(f"/World/Hall/Floor{k}", part, "Sandstone")
    w.mesh(
        "/World/Hall/Ceiling",
        sheet((-half, high, -half), (2 * half, 0, 0), (0, 0, 2 * half), d.count(8), d.count(8)),
        "Ceiling",
    )
    for k, x in enumerate((-2.7, -0.9, 0.9, 2.7)):
        w.cube(f"/World/Hall/Window{k}", (x, 1.2, -half + 0.03), (1.1, 1.7, 0.04), "Daylight")


def _reeds(w: Writer, x0: float, x1: float, z0: float, z1: float, deep: float) -> None:
    """Stalks and leaves that stand on the bottom along three sides of the pool and lean over the water."""
    for k in range(36):
        along = math.modf(0.618034 * (k + 1))[0]
        inward = 0.1 + 0.3 * math.modf(0.754878 * (k + 1))[0]
        side = k % 3
        x = (x0 + inward, x1 - inward, x0 + along * (x1 - x0))[side]
        z = z0 + along * 0.75 * (z1 - z0) if side < 2 else z0 + inward
        height = deep + 0.6 + 0.7 * math.modf(0.569840 * (k + 1))[0]
        lean = 0.25 * (math.modf(0.4421 * (k + 1))[0] - 0.5)
        t = np.linspace(0, 1, w.detail.count(4) + 1)[:, None]
        path = np.array([x, -deep, z]) + t * np.array([0, height, 0]) + t**2 * np.array([lean, 0, 0.6 * lean])
        look = ("Leaf", "Green", "AppleGreen")[k % 3]
        w.mesh(f"/World/Reeds/R{k:02d}", sweep(path, 0.03 * (1.0 - 0.5 * t[:, 0]), w.detail, 5), look)
        if k % 4 == 0:
            w.capsule(f"/World/Reeds/Head{k:02d}", path[-1] + (0, 0.02, 0), 0.035, 0.14, "DarkWood")


def _chandelier(w: Writer, middle, ceiling: float) -> None:
    """Two rings of candles on a stem."""
    x, y, z = middle
    for name, ring, rise, candles in (("Large", 0.75, 0.0, 10), ("Small", 0.42, 0.32, 6)):
        hoop = torus(ring, 0.03, w.detail, 28, 8).moved((x, y + rise, z))
        w.mesh(f"/World/Chandelier/{name}", hoop, "Amber")
        for k in range(candles):
            a = 2.0 * math.pi * k / candles
            at = np.array([x + ring * math.sin(a), y + rise + 0.03, z + ring * math.cos(a)])
            w.cylinder(f"/World/Chandelier/{name}Candle{k}", at, 0.03, 0.16, "Cream")
            w.sphere(f"/World/Chandelier/{name}Flame{k}", at + (0, 0.2, 0), (0.022, 0.04, 0.022), "Lamp")
        for k in range(3):
            a = 2.0 * math.pi * (k + 0.25) / 3.0
            arm = np.array([[x + ring * math.sin(a), y + rise, z + ring * math.cos(a)], [x, y + rise + 0.3, z]])
            w.mesh(f"/World/Chandelier/{name}Arm{k}", sweep(arm, (0.015, 0.015), w.detail, 5), "Amber")
    w.cylinder("/World/Chandelier/Stem", (x, y + 0.25, z), 0.02, ceiling - y - 0.25, "Amber")


WATER_SCENES = {
    "frosted_window": Recipe(
        _frosted_window,
        "A frosted, a clear and a misted pane over a polished floor that fades; after Real-Time Rendering, figure 9.44",
        ("/World/Floor", "/World/Panes/Clear", "/World/Panes/Misted"),
        techniques=("planar", "reflector_map", "raytraced"),
    ),
    "pool": Recipe(
        _pool,
        "Water with waves in a hall, under a chandelier and among reeds; after Real-Time Rendering, figures 9.42 and 9.45",
        ("/World/Water",),
        techniques=("planar", "reflector_map", "raytraced"),
    ),
}
