"""The sets that several scenes share: an arena of pillars on a checker, a play room and its toys."""

from __future__ import annotations

import math

from scene_parts import checked_sheet
from scene_shapes import rotation
from scene_writer import Writer

WALLS = (("Left", 90), ("Front", 180), ("Right", -90))  # about +Y [degrees], from the back wall


def corner(x: float, z: float, degrees: float) -> tuple[float, float]:
    p = rotation((0, degrees, 0)) @ (x, 0.0, z)
    return round(float(p[0]), 6), round(float(p[2]), 6)


TOYS = (  # part, x, z, y [m], turn [degrees], size, look
    ("beach_ball", -1.3, -0.9, 0, 20, 1.0, None),
    ("beach_ball", 1.55, 1.5, 0, 80, 1.3, None),
    ("beach_ball", -0.75, 2.05, 0, 45, 0.8, None),
    ("beach_ball", 1.7, -1.7, 0, 10, 0.9, None),
    ("ring_tower", 1.25, -0.75, 0, 0, 1.3, None),
    ("ring_tower", -1.75, 0.9, 0, 30, 1.2, None),
    ("ring_tower", 0.65, 1.95, 0, 30, 1.0, None),
    ("rainbow", 0.0, -1.7, 0, 0, 1.9, None),
    ("rainbow", -1.0, 1.55, 0, 150, 1.2, None),
    ("rainbow", 2.05, 0.35, 0, -90, 1.5, None),
    ("pawn", -0.85, -1.45, 0, 0, 1.6, "Coral"),
    ("pawn", 1.0, 1.15, 0, 0, 1.3, "Coral"),
    ("pawn", -1.9, -0.2, 0, 0, 1.5, "Coral"),
    ("pawn", 0.85, -1.55, 0, 0, 1.6, "SkyBlue"),
    ("pawn", -1.35, 0.55, 0, 0, 1.3, "SkyBlue"),
    ("pawn", 0.1, 2.1, 0, 0, 1.5, "SkyBlue"),
    ("spinning_top", 0.8, 0.55, 0, 0, 1.3, None),
    ("spinning_top", -0.75, 0.75, 0, 0, 1.2, None),
    ("spinning_top", 1.75, -0.4, 0, 0, 1.4, None),
    ("toy_block", -1.6, -1.6, 0, 15, 1.4, "Red"),
    ("toy_block", -1.62, -1.58, 0.336, -20, 1.2, "Blue"),
    ("toy_block", -1.6, -1.62, 0.624, 35, 1.0, "Green"),
    ("toy_block", 1.4, 0.75, 0, 25, 1.1, "Blue"),
    ("toy_block", 1.42, 0.77, 0.264, -12, 1.0, "Green"),
    ("toy_block", -1.95, 1.75, 0, 5, 1.5, "Red"),
    ("toy_block", -1.45, 1.95, 0, 30, 1.2, "Green"),
    ("toy_block", -1.93, 1.77, 0.36, 40, 1.2, "Blue"),
    ("toy_block", 0.55, 1.4, 0, 50, 0.8, "Red"),
    ("toy_block", -0.45, 1.35, 0, 12, 0.8, "Green"),
    ("toy_block", 0.95, 2.2, 0, 22, 1.0, "Purple"),
    ("ring_tower", -1.5, -1.0, 0, 0, 0.9, None),
    ("ring_tower", 2.0, 1.0, 0, 0, 1.1, None),
    ("rainbow", -2.0, 0.3, 0, 80, 1.1, None),
    ("rainbow", 1.3, 1.9, 0, 215, 1.0, None),
    ("beach_ball", 0.35, 1.75, 0, 130, 0.6, None),
    ("beach_ball", -1.45, 1.2, 0, 200, 0.7, None),
    ("spinning_top", -0.2, 1.75, 0, 0, 0.8, None),
    ("spinning_top", -0.4, -1.2, 0, 0, 1.0, None),
    ("pawn", 0.75, 1.65, 0, 0, 0.9, "Lemon"),
    ("pawn", -0.35, 2.15, 0, 0, 1.2, "Green"),
    ("pawn", 1.25, 0.2, 0, 0, 1.1, "Pink"),
    ("pawn", -1.15, -0.3, 0, 0, 1.0, "Lemon"),
)


BALLOONS = (  # x, z, y of the knot [m], look
    (-0.9, 0.95, 1.75, "Red"),
    (-0.62, 1.15, 1.62, "Lemon"),
    (-0.75, 0.6, 1.9, "SkyBlue"),
    (0.85, 1.1, 1.72, "Green"),
    (0.6, 0.8, 1.86, "Pink"),
    (1.05, 0.7, 1.6, "Orange"),
    (0.1, 1.95, 1.8, "Purple"),
    (-0.15, 2.05, 1.65, "Coral"),
    (1.7, -0.1, 1.7, "Lemon"),
    (1.85, -0.5, 1.85, "Red"),
    (-1.75, 0.1, 1.75, "Green"),
    (-1.8, -0.45, 1.6, "Pink"),
    (0.95, -1.3, 1.72, "SkyBlue"),
    (1.3, -1.5, 1.55, "Orange"),
    (-1.0, -1.3, 1.78, "Purple"),
    (0.25, 0.35, 1.98, "Orange"),
    (-0.3, -0.3, 1.95, "Green"),
    (0.35, -0.45, 1.88, "Red"),
)
CEILING = ((0.8, 0.8, 0.78), (0.62, 0.72, 0.8))


def play_room(w: Writer) -> None:
    """Walls, floor, ceiling, lamps, door and pictures of a room 4.8 m square and 2.4 m high about the origin."""
    d, m, high = w.detail, 2.4, 2.4
    for name, turn in (("Back", 0), *WALLS):
        x, z = corner(-m, -m, turn)
        w.part(f"/World/Room/{name}", "wall_play", (x, 0, z), (0, turn, 0))
    for k in range(5):
        w.part(f"/World/Room/Mats{k}", "mat_strip", (-m - 0.1 + k, 0, m + 0.1))
    ceiling = checked_sheet((-m, high, -m), (2 * m, 0, 0), (0, 0, 2 * m), 12, 12, CEILING, d)
    w.mesh("/World/Room/Ceiling", ceiling)
    for k, (x, z) in enumerate(((-1.2, 0.4), (1.2, 0.4), (0.0, 1.6), (0.0, -1.2))):
        w.cube(f"/World/Room/Light{k}", (x, high - 0.04, z), (0.5, 0.03, 0.5), "Lamp")
    w.cube("/World/Room/Door", (0.9, 0, m - 0.02), (0.85, 1.9, 0.04), "Coral")
    for k, (x, look) in enumerate(((-1.7, "Lemon"), (-0.95, "Pink"), (-0.2, "Green"))):
        w.cube(f"/World/Room/Frame{k}", (x, 1.3, m - 0.02), (0.6, 0.6, 0.04), "White")
        w.cube(f"/World/Room/Picture{k}", (x, 1.36, m - 0.045), (0.48, 0.48, 0.02), look)


def play_things(w: Writer, free=lambda x, z: True) -> None:
    """The balloons, and the toys that stand where `free(x, z)`."""
    for k, (x, z, y, look) in enumerate(BALLOONS):
        w.part(f"/World/Balloons/B{k:02d}", "balloon", (x, y, z), (0, 0, 3 * (k % 5) - 6), look=look)
    for k, (name, x, z, y, turn, size, look) in enumerate(TOYS):
        if free(x, z):
            w.part(f"/World/Toys/Toy{k:02d}", name, (x, y, z), (0, turn, 0), size, look)


CHECKER = ((0.75, 0.73, 0.7), (0.06, 0.09, 0.12))


def arena(w: Writer, half: float, cells: int) -> None:
    """A checker floor and, around scene and eye, a ring of pillars: else mirrors would show empty sky."""
    floor = checked_sheet((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), cells, cells, CHECKER, w.detail)
    w.mesh("/World/Floor", floor)
    looks = (
        "Red",
        "Cream",
        "Orange",
        "SkyBlue",
        "Lemon",
        "Green",
        "Pink",
        "Teal",
        "Purple",
        "Coral",
        "Leaf",
        "Blue",
    )
    for k, look in enumerate(looks):
        a = math.radians(30 * k + 15)
        height = half * (0.3 + 0.12 * (k * 5 % 4))
        at = (0.95 * half * math.sin(a), 0, 0.95 * half * math.cos(a))
        w.cube(f"/World/Pillar{k:02d}", at, (0.2 * half, height, 0.06 * half), look, (0, 30 * k + 15, 0))


def boxes(w: Writer, *placed) -> None:
    """Boxes given as (x, z, width, height, turn [degrees], look)."""
    for k, (x, z, width, height, turn, look) in enumerate(placed):
        w.cube(f"/World/Box{k}", (x, 0, z), (width, height, width), look, (0, turn, 0))


STUDIO_FLOOR = ((0.72, 0.7, 0.66), (0.1, 0.13, 0.17))
STUDIO_WALLS = (
    ((0.72, 0.56, 0.32), (0.6, 0.22, 0.13), (0.75, 0.68, 0.52)),
    ((0.16, 0.36, 0.46), (0.66, 0.7, 0.66), (0.08, 0.2, 0.32)),
    ((0.3, 0.46, 0.22), (0.72, 0.7, 0.5), (0.14, 0.3, 0.18)),
    ((0.5, 0.26, 0.44), (0.78, 0.62, 0.66), (0.3, 0.13, 0.33)),
)


def studio(w: Writer, half: float, high: float) -> None:
    """A square room about the origin with a checker floor, a pattern of its own on each wall, and lamps above."""
    d = w.detail
    floor = checked_sheet((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), 20, 20, STUDIO_FLOOR, d)
    w.mesh("/World/Studio/Floor", floor)
    for k, palette in enumerate(STUDIO_WALLS):
        wall = checked_sheet((-half, 0, -half), (2 * half, 0, 0), (0, high, 0), 15, 8, palette, d)
        w.mesh(f"/World/Studio/Wall{k}", wall.moved(rotate=(0, 90 * k, 0)))
    ceiling = checked_sheet((-half, high, -half), (2 * half, 0, 0), (0, 0, 2 * half), 10, 10, CEILING, d)
    w.mesh("/World/Studio/Ceiling", ceiling)
    for k, (x, z) in enumerate(((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5))):
        w.cube(f"/World/Studio/Lamp{k}", (x * half, high - 0.05, z * half), (0.35 * half, 0.04, 0.35 * half), "Lamp")
