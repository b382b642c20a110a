"""The looks and the shared objects (`usd_scenes/parts/`) of the scenes.

A part stands on y = 0 about its own origin unless its docstring says otherwise; metres, +Y up, front +Z.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scene_city_parts import CITY_PARTS
from scene_shapes import (
    Detail,
    Egg,
    Surface,
    ball,
    block,
    lathe,
    merge,
    patch,
    revolve,
    sheet,
    smooth,
    sweep,
    tiles,
    torus,
    turned,
)


@dataclass(frozen=True)
class Look:
    """A constant UsdPreviewSurface; the default is a dielectric far from a mirror (mirror weight 0.04)."""

    color: tuple[float, float, float]
    metallic: float = 0.0
    roughness: float = 0.5
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opacity: float = 1.0
    ior: float = 1.5
    clearcoat: float = 0.0  # smooth


LOOKS = {
    "Chrome": Look((0.9, 0.9, 0.92), 1.0, 0.0),
    "RedMirror": Look((0.85, 0.12, 0.1), 1.0, 0.0),
    "BlueMirror": Look((0.12, 0.2, 0.85), 1.0, 0.0),
    "PaintRed": Look((0.75, 0.22, 0.18), 1.0, 0.0),
    "PaintBlue": Look((0.25, 0.4, 0.75), 1.0, 0.0),
    "PaintGold": Look((0.85, 0.66, 0.3), 1.0, 0.0),
    **{f"Polished{k}": Look((0.9, 0.9, 0.92), 1.0, 0.1 * k) for k in range(7)},
    "CarPaint": Look((0.55, 0.06, 0.05), 0.85, 0.35, clearcoat=1.0),
    "Black": Look((0.02, 0.02, 0.022)),
    "White": Look((0.82, 0.81, 0.78)),
    "Cream": Look((0.78, 0.7, 0.55)),
    "Plaster": Look((0.7, 0.66, 0.56)),
    "Ceiling": Look((0.8, 0.8, 0.78)),
    "Wood": Look((0.38, 0.2, 0.09)),
    "PaleWood": Look((0.58, 0.4, 0.22)),
    "DarkWood": Look((0.16, 0.08, 0.04)),
    "Teal": Look((0.05, 0.3, 0.3)),
    "Sage": Look((0.3, 0.42, 0.28)),
    "Blue": Look((0.05, 0.14, 0.45)),
    "SkyBlue": Look((0.2, 0.45, 0.7)),
    "Navy": Look((0.03, 0.06, 0.18)),
    "Red": Look((0.6, 0.04, 0.03)),
    "Crimson": Look((0.42, 0.02, 0.04)),
    "Coral": Look((0.75, 0.2, 0.12)),
    "Orange": Look((0.85, 0.3, 0.02)),
    "Yellow": Look((0.85, 0.6, 0.05)),
    "Lemon": Look((0.88, 0.72, 0.08)),
    "Green": Look((0.1, 0.4, 0.08)),
    "Leaf": Look((0.08, 0.25, 0.05)),
    "AppleGreen": Look((0.35, 0.5, 0.07)),
    "Bottle": Look((0.02, 0.14, 0.05)),
    "Amber": Look((0.4, 0.14, 0.02)),
    "Purple": Look((0.25, 0.06, 0.4)),
    "Pink": Look((0.75, 0.25, 0.4)),
    "Terracotta": Look((0.5, 0.2, 0.1)),
    "Steel": Look((0.35, 0.36, 0.38)),
    "Daylight": Look((0.2, 0.2, 0.2), emissive=(0.45, 0.7, 1.0)),
    "Meadow": Look((0.1, 0.2, 0.05), emissive=(0.18, 0.38, 0.1)),
    "Stone": Look((0.55, 0.47, 0.36)),
    "Sandstone": Look((0.62, 0.45, 0.27)),
    "Rubber": Look((0.03, 0.03, 0.035)),
    "Lamp": Look((0.5, 0.5, 0.5), emissive=(1.4, 1.2, 0.85)),
    "BlackMarble": Look((0.25, 0.25, 0.27), 1.0, 0.0),
    "Glass": Look((1.0, 1.0, 1.0), 0.0, 0.0, opacity=0.0),
    "FrostedGlass": Look((1.0, 1.0, 1.0), 0.0, 0.5, opacity=0.15),
    "Water": Look((1.0, 1.0, 1.0), 0.0, 0.0, opacity=0.0, ior=1.333),
}


@dataclass(frozen=True)
class Copies:
    """Instances of another part, one at every place."""

    part: str
    places: tuple[tuple[float, float, float], ...]


# Name, what, look. Without a look: the faces' own displayColor, else what is bound to the referencing prim.
Pieces = list[tuple[str, Surface | Copies, str | None]]


def arc(center, radius, start: float, end: float, n: int) -> np.ndarray:
    """N + 1 points of an elliptic arc in the x-y plane; angles in degrees, `radius` one number or two."""
    t = np.radians(np.linspace(start, end, n + 1))
    rx, ry = np.broadcast_to(radius, 2)
    return np.asarray(center, float) + np.stack([rx * np.cos(t), ry * np.sin(t), 0 * t], -1)


# Fruit


def _apple(d: Detail) -> Pieces:
    profile = [(0, 0.007), (0.012, 0.001), (0.026, 0.005), (0.037, 0.022), (0.041, 0.046), (0.036, 0.064)]
    profile += [(0.024, 0.074), (0.011, 0.071), (0, 0.062)]
    stem = [(0, 0.063, 0), (0.001, 0.074, 0), (0.006, 0.087, 0.001)]
    return [
        ("Skin", lathe(profile, d, 16), None),
        ("Stem", sweep(stem, [0.0015, 0.0014, 0.002], d, 4), "DarkWood"),
    ]


def _orange(d: Detail) -> Pieces:
    profile = [
        (0, 0),
        (0.018, 0.003),
        (0.033, 0.015),
        (0.041, 0.038),
        (0.035, 0.061),
        (0.02, 0.074),
        (0, 0.0775),
    ]
    return [("Peel", lathe(profile, d, 18), "Orange")]


def _lemon(d: Detail) -> Pieces:
    profile = [(0, -0.05), (0.007, -0.046), (0.014, -0.037), (0.026, -0.02), (0.03, 0.0), (0.026, 0.02)]
    body = lathe([*profile, (0.013, 0.036), (0.0065, 0.044), (0, 0.047)], d, 14)
    return [("Peel", body.moved((0, 0.03, 0), (0, 0, 90)), "Lemon")]


def _banana(d: Detail) -> Pieces:
    n = d.count(11)
    u = np.linspace(0, 1, n + 1)
    radii = 0.0185 * np.clip(np.minimum(u / 0.16, (1 - u) / 0.2), 0, 1) ** 0.6 + 0.003
    center = (0, 0.13, 0)
    tips = merge(
        sweep(arc(center, 0.112, 210.5, 214, 2), [0.005, 0.0045, 0.004], d, 5),
        sweep(arc(center, 0.112, 318, 327, 2), [0.004, 0.0045, 0.006], d, 5),
    )
    # The arcs in x-y are laid down on the table.
    lying = {"translate": (0, 0.0215, 0.06), "rotate": (82, 0, 0)}
    return [
        ("Peel", sweep(arc(center, 0.112, 214, 318, n), radii, d, 8).moved(**lying), "Yellow"),
        ("Tips", tips.moved(**lying), "DarkWood"),
    ]


def _pear(d: Detail) -> Pieces:
    profile = [(0, 0.004), (0.014, 0.0), (0.032, 0.012), (0.039, 0.034), (0.034, 0.056), (0.022, 0.078)]
    profile += [(0.016, 0.094), (0.009, 0.103), (0, 0.104)]
    stem = [(0, 0.102, 0), (0.001, 0.112, 0), (0.006, 0.124, 0)]
    return [
        ("Skin", lathe(profile, d, 14), "AppleGreen"),
        ("Stem", sweep(stem, [0.0016, 0.0014, 0.002], d, 4), "DarkWood"),
    ]


# Crockery, bottles

WHITE, BLUE, TEAL, SKY = (0.82, 0.81, 0.78), (0.04, 0.1, 0.4), (0.05, 0.3, 0.3), (0.2, 0.45, 0.7)
NAVY = (0.03, 0.06, 0.18)


def _plate(d: Detail) -> Pieces:
    under = [(0, 0.003), (0.068, 0.001), (0.072, 0.005), (0.128, 0.018), (0.13, 0.0215)]
    top = [(0.127, 0.0225), (0.113, 0.019), (0.103, 0.0165), (0.082, 0.0115), (0.074, 0.0085), (0, 0.008)]
    return [("Body", turned(under + top, d, 22, (WHITE, BLUE), (0, 0, 0, 0, 1, 0, 1, 0, 0, 0)), None)]


def _bowl(d: Detail) -> Pieces:
    outer = [(0, 0.004), (0.05, 0.001), (0.057, 0.005), (0.1, 0.03), (0.124, 0.06), (0.134, 0.09)]
    inner = [(0.131, 0.092), (0.119, 0.062), (0.094, 0.034), (0.054, 0.014), (0, 0.011)]
    return [("Body", turned(outer + inner, d, 20, (SKY, WHITE), (0, 0, 0, 0, 0, 1, 1, 1, 1, 1)), None)]


def _cup(d: Detail) -> Pieces:
    outer = [(0, 0.002), (0.029, 0.0005), (0.033, 0.005), (0.041, 0.04), (0.0436, 0.082), (0.044, 0.089)]
    inner = [(0.0412, 0.09), (0.039, 0.05), (0.031, 0.009), (0, 0.007)]
    n = d.count(7)
    handle = sweep(arc((0.047, 0.046, 0), (0.024, 0.029), -98, 98, n), np.full(n + 1, 0.0045), d, 5)
    return [
        ("Body", turned(outer + inner, d, 16, (TEAL, WHITE), (0, 0, 0, 0, 1, 1, 1, 1, 1)), None),
        ("Handle", handle, "Teal"),
    ]


def _bottle(d: Detail) -> Pieces:
    """A bottle whose glass takes the look bound to it."""
    foot = [(0, 0.003), (0.031, 0.0005), (0.0365, 0.006), (0.037, 0.04)]
    glass = turned([*foot, (0.037, 0.15), (0.032, 0.18), (0.02, 0.205), (0.0145, 0.225), (0.0138, 0.262)], d, 14)
    label = turned([(0.0375, 0.04), (0.0375, 0.125)], d, 14)
    cap = turned([(0.0138, 0.258), (0.0158, 0.26), (0.0158, 0.298), (0.0145, 0.303), (0, 0.304)], d, 10)
    return [("Glass", glass, None), ("Label", label, "Cream"), ("Cap", cap, "Coral")]


def _jar(d: Detail) -> Pieces:
    body = [(0, 0.001), (0.045, 0.0005), (0.05, 0.006), (0.05, 0.115), (0.043, 0.127)]
    lid = [(0.045, 0.128), (0.046, 0.144), (0.02, 0.147), (0.012, 0.157), (0, 0.161)]
    return [("Body", turned(body, d, 14), "Amber"), ("Lid", turned(lid, d, 14), "PaleWood")]


def _pot(d: Detail) -> Pieces:
    body = [(0, 0.001), (0.1, 0), (0.108, 0.008), (0.11, 0.12), (0.116, 0.124), (0.11, 0.129), (0.06, 0.142)]
    body += [(0.014, 0.147), (0.012, 0.155), (0.02, 0.167), (0.012, 0.176), (0, 0.178)]
    n = d.count(4)
    grip = sweep(arc((0.108, 0, 0), 0.028, -90, 90, n), np.full(n + 1, 0.005), d, 5).moved((0, 0.1, 0), (90, 0, 0))
    return [
        ("Body", turned(body, d, 14), "Crimson"),
        ("Grips", merge(grip, grip.moved(rotate=(0, 180, 0))), "Black"),
    ]


def _plant(d: Detail) -> Pieces:
    pot = [
        (0, 0.001),
        (0.05, 0),
        (0.068, 0.095),
        (0.074, 0.097),
        (0.074, 0.118),
        (0.066, 0.118),
        (0.062, 0.1),
        (0, 0.098),
    ]
    golden = 137.50776  # golden angle [degrees]: leaves never line up
    leaves = []
    for k in range(12):
        u = np.linspace(0, 1, d.count(3) + 1)[:, None]
        lift, reach = 0.12 + 0.12 * (k % 5) / 4, 0.07 + 0.006 * (k % 7)
        spine = np.concatenate([reach * u, lift * u - 0.07 * u**3, 0 * u], 1)
        width = 0.026 * np.sin(math.pi * np.clip(u, 0.02, 0.985) ** 0.8)
        net = np.stack([spine + width * (0, 0, 1), spine + width * (0, -0.25, 0), spine - width * (0, 0, 1)], axis=1)
        leaves.append(smooth(patch(net)).moved((0, 0.098, 0), (0, k * golden, 0)))
    return [("Pot", turned(pot, d, 12), "Terracotta"), ("Leaves", merge(*leaves), "Leaf")]


def _ladle(d: Detail) -> Pieces:
    """A ladle hanging from the origin."""
    n = d.count(5)
    handle = np.concatenate([np.linspace((0, -0.22, 0), (0, -0.03, 0), 2), arc((0.012, -0.012, 0), 0.012, 180, 20, n)])
    shell = [
        (0, -0.03),
        (0.02, -0.026),
        (0.034, -0.008),
        (0.036, 0),
        (0.033, 0),
        (0.018, -0.021),
        (0, -0.026),
    ]
    return [
        ("Handle", sweep(handle, np.full(len(handle), 0.004), d, 5), "Steel"),
        ("Cup", turned(shell, d, 12).moved((0, -0.22, 0.034), (20, 0, 0)), "Steel"),
    ]


# Furniture


def _framed_door(width: float, height: float, d: Detail) -> Surface:
    """A frame-and-panel door facing +z, from its lower left corner."""
    rail, depth = 0.06, 0.02
    inner = width - 2 * rail
    pieces = [block((rail, height, depth), d).moved((x, 0, depth / 2)) for x in (rail / 2, width - rail / 2)]
    pieces += [block((inner, rail, depth), d).moved((width / 2, y, depth / 2)) for y in (0, height - rail)]
    panel = sheet((rail, rail, 0.007), (inner, 0, 0), (0, height - 2 * rail, 0), d.count(3), d.count(3))
    return merge(*pieces, panel)


def _knob(d: Detail) -> Surface:
    profile = [(0, 0), (0.007, 0.0), (0.006, 0.012), (0.014, 0.02), (0.012, 0.028), (0, 0.031)]
    return turned(profile, d, 8).moved(rotate=(90, 0, 0))


def _base_unit(d: Detail) -> Pieces:
    """0.6 x 0.88 x 0.58 m from its lower left back corner."""
    plinth = block((0.6, 0.1, 0.5), d).moved((0.3, 0, 0.25))
    drawer = _framed_door(0.59, 0.2, d).moved((0.005, 0.67, 0.56))
    front = merge(_framed_door(0.59, 0.55, d).moved((0.005, 0.105, 0.56)), drawer)
    knobs = merge(_knob(d).moved((0.53, 0.55, 0.58)), _knob(d).moved((0.3, 0.77, 0.568)))
    body = merge(block((0.6, 0.78, 0.56), d, 0, 0.3).moved((0.3, 0.1, 0.28)), plinth)
    return [("Body", merge(body, front), "Sage"), ("Knobs", knobs, "Steel")]


def _wall_unit(d: Detail) -> Pieces:
    """0.6 x 0.7 x 0.34 m from its lower left back corner."""
    door = _framed_door(0.59, 0.69, d).moved((0.005, 0.005, 0.32))
    body = block((0.6, 0.7, 0.32), d, 0, 0.3).moved((0.3, 0, 0.16))
    return [("Body", merge(body, door), "Sage"), ("Knob", _knob(d).moved((0.55, 0.12, 0.34)), "Steel")]


def _chair(d: Detail) -> Pieces:
    """A chair whose back is at -z."""
    sides = (-0.19, 0.19)
    leg = turned([(0, 0), (0.013, 0), (0.02, 0.3), (0.018, 0.44), (0, 0.44)], d, 5)
    post = turned([(0, 0.44), (0.02, 0.44), (0.016, 0.9), (0.02, 0.93), (0, 0.95)], d, 5)
    sticks = [leg.moved((x, 0, z)) for x in sides for z in sides] + [post.moved((x, 0, -0.19)) for x in sides]
    slats = [block((0.37, 0.07, 0.018), d).moved((0, y, -0.19)) for y in (0.56, 0.69, 0.82)]
    seat = block((0.44, 0.035, 0.44), d, 0.008, 0.22).moved((0, 0.44, 0))
    return [
        ("Sticks", merge(*sticks), "PaleWood"),
        ("Slats", merge(*slats), "PaleWood"),
        ("Seat", seat, "Coral"),
    ]


def _lamp(d: Detail) -> Pieces:
    """A pendant lamp; the rim of its shade is at y = 0."""
    shade = [
        (0.022, 0.2),
        (0.03, 0.19),
        (0.06, 0.14),
        (0.17, 0.0),
        (0.167, 0.0),
        (0.056, 0.136),
        (0.02, 0.186),
    ]
    return [
        ("Shade", turned(shade[::-1], d, 14), "Crimson"),
        ("Bulb", ball(0.045, d, 8, 5).moved((0, 0.06, 0)), "Lamp"),
        ("Cord", block((0.008, 0.6, 0.008), d).moved((0, 0.19, 0)), "Black"),
    ]


def _clock(d: Detail) -> Pieces:
    """A wall clock about the origin, facing +z."""
    profile = [(0.17, 0), (0.166, 0.02), (0.15, 0.022), (0.148, 0.004), (0, 0.004)]
    face = turned(profile, d, 20, (NAVY, WHITE), (0, 0, 0, 1)).moved(rotate=(90, 0, 0))
    strokes = [block((0.008, 0.03, 0.004), d).moved((0, 0.1, 0.007)).moved(rotate=(0, 0, 90 * k)) for k in range(4)]
    for length, angle in ((0.09, 52), (0.12, -63)):
        strokes.append(block((0.008, length, 0.003), d).moved((0, -0.015, 0.012)).moved(rotate=(0, 0, angle)))
    return [("Face", face, None), ("Hands", merge(*strokes), "Black")]


def _book_row(d: Detail) -> Pieces:
    """Eight books from the origin along +x."""
    pieces: dict[str, list[Surface]] = {}
    x = 0.0
    for k in range(8):
        look = ("Crimson", "Navy", "Cream", "Leaf", "Amber", "Teal")[k * 5 % 6]
        width, height = 0.025 + 0.006 * (k * 7 % 5), 0.2 + 0.012 * (k * 3 % 6)
        pieces.setdefault(look, []).append(block((width, height, 0.16), d).moved((x + width / 2, 0, 0)))
        x += width + 0.002
    return [(look, merge(*books), look) for look, books in pieces.items()]


# Cloth and tiles

GINGHAM = ((0.8, 0.77, 0.72), (0.7, 0.22, 0.2), (0.52, 0.03, 0.04))
GROUT = (0.42, 0.4, 0.36)
TEAL_TILES = ((0.66, 0.72, 0.66), (0.06, 0.3, 0.32), GROUT)
OCHRE_TILES = ((0.72, 0.62, 0.42), (0.5, 0.2, 0.09), GROUT)
FLOOR_TILES = ((0.6, 0.56, 0.48), (0.13, 0.12, 0.13), (0.3, 0.28, 0.26))
PLAY_TILES = ((0.75, 0.68, 0.5), (0.1, 0.32, 0.5), (0.5, 0.5, 0.48))
PEACH_TILES = ((0.78, 0.7, 0.55), (0.75, 0.42, 0.26), (0.5, 0.5, 0.48))
MAT_TILES = ((0.75, 0.5, 0.1), (0.62, 0.12, 0.1), (0.12, 0.4, 0.2), (0.1, 0.22, 0.55), (0.1, 0.1, 0.1))


def checked_sheet(origin, across, along, columns: int, rows: int, palette, d: Detail) -> Surface:
    """`sheet` in a checker of columns x rows fields, each cut as finely as the detail asks."""
    n = d.count(1)
    fine = sheet(origin, across, along, columns * n, rows * n)
    k = np.arange(len(fine.counts))
    return fine.painted(palette, ((k // (rows * n) // n) % 2 + (k % (rows * n) // n) % 2) % len(palette))


def _cloth(d: Detail) -> Pieces:
    """0.3 m of gingham from its corner towards +x and -z: stripes of 2.5 cm, dark where they cross."""
    return [("Weave", checked_sheet((0, 0, 0), (0.3, 0, 0), (0, 0, -0.3), 12, 12, GINGHAM, d), None)]


def _wall_tiles(palette) -> Callable[[Detail], Pieces]:
    """Four by two tiles of 15 cm from the lower left corner, facing +z."""
    return lambda d: [("Tiles", tiles(4, 2, 0.15, palette, d), None)]


def _tiled_wall(columns: int, *rows: str) -> Callable[[Detail], Pieces]:
    """A wall of `_wall_tiles` parts (one name a row, from below) from the lower left corner."""
    return lambda d: [
        (f"Row{j}T", Copies(part, tuple((0.6 * i, 0.3 * j, 0.0) for i in range(columns))), None)
        for j, part in enumerate(rows)
    ]


def _strip(part: str, count: int, pitch: float) -> Callable[[Detail], Pieces]:
    """Copies of a square part of this pitch in a row towards -z."""
    places = tuple((0.0, 0.0, -pitch * k) for k in range(count))
    return lambda d: [("S", Copies(part, places), None)]


def _floor_tiles(d: Detail) -> Pieces:
    """0.7 m of floor from its corner towards +x and -z."""
    return [("Tiles", tiles(4, 4, 0.175, FLOOR_TILES, d).moved(rotate=(-90, 0, 0)), None)]


def _mat_tiles(d: Detail) -> Pieces:
    """1 m of coloured mats from its corner towards +x and -z."""
    mats = tiles(4, 4, 0.25, MAT_TILES, d, lambda i, j: (i + 2 * (j % 2) + j // 2) % 4)
    return [("Tiles", mats.moved(rotate=(-90, 0, 0)), None)]


# The kettle

KETTLE = Egg(0.168, 0.132, -0.0062)
KETTLE_GAP = 0.002  # what stands around the body keeps this off it, so that nothing touches or enters the mirror [m]
FOOT_BEAD = 0.008


def _kettle_foot() -> tuple[float, float, float]:
    """(ring radius, height of the ring's centre over the body's bottom, of that bottom over the table)."""
    (point,), (normal,) = KETTLE.meridian([math.radians(-75)])
    center = point + (FOOT_BEAD + KETTLE_GAP) * normal
    return float(center[0]), float(center[1]), FOOT_BEAD - float(center[1])


def _kettle(d: Detail) -> Pieces:
    lift = _kettle_foot()[2]
    return [("Body", KETTLE.surface(d, 60, 35).moved((0, lift, 0)), None)]


def _kettle_trim(d: Detail) -> Pieces:
    ring, _, lift = _kettle_foot()
    (spout_at, shoulder, top), (spout_out, shoulder_out, _) = KETTLE.meridian(np.radians([12, 42, 90]))
    base, out = np.array([-spout_at[0], spout_at[1], 0]), np.array([-spout_out[0], spout_out[1], 0])
    n = d.count(6)
    u = np.linspace(0, 1, n + 1)[:, None]
    tip = base + np.array([-0.09, 0.085, 0.0])
    spout = (1 - u) ** 2 * (base + KETTLE_GAP * out) + 2 * u * (1 - u) * (base + 0.055 * out) + u**2 * tip
    foot = shoulder + 0.01 * shoulder_out
    n = d.count(12)
    grip = arc((0, foot[1], 0), (foot[0], 0.12), 0, 180, n)
    knob = [(0, 0.0), (0.014, 0.0), (0.01, 0.01), (0.02, 0.022), (0.017, 0.032), (0, 0.036)]
    pieces = [
        ("Spout", sweep(spout, 0.024 - 0.012 * u[:, 0], d, 8)),
        ("Handle", sweep(grip, 0.008 + 0.004 * np.sin(math.pi * np.linspace(0, 1, n + 1)), d, 6)),
        ("Knob", turned(knob, d, 8).moved((0, top[1] + KETTLE_GAP, 0))),
        ("Foot", torus(ring, FOOT_BEAD, d, 18, 4).moved((0, FOOT_BEAD - lift, 0))),
    ]
    return [("Trim", merge(*[surface for _, surface in pieces]).moved((0, lift, 0)), "Black")]


STAND_RING, STAND_BEAD = 0.07, 0.01  # the ring a ball rests on [m]


def _ring_stand(d: Detail) -> Pieces:
    return [("Ring", torus(STAND_RING, STAND_BEAD, d, 20, 4).moved((0, STAND_BEAD, 0)), "DarkWood")]


# Toys

BEACH = ((0.75, 0.72, 0.68), (0.65, 0.05, 0.04), (0.05, 0.2, 0.55), (0.8, 0.5, 0.04))


def _beach_ball(d: Detail) -> Pieces:
    around = d.count(24)
    skin = ball(0.25, d, 24, 14).moved((0, 0.25, 0), (25, 0, 15))
    sector = np.arange(len(skin.counts)) % around * 6 // around
    return [("Skin", skin.painted(BEACH, np.where(sector % 2 == 0, 0, 1 + sector // 2)), None)]


def _balloon(d: Detail) -> Pieces:
    """A balloon whose knot is the origin, its string below; the skin takes the look bound to it."""
    skin = [
        (0, -0.012),
        (0.014, -0.011),
        (0.005, 0.0),
        (0.03, 0.025),
        (0.085, 0.09),
        (0.118, 0.17),
        (0.12, 0.22),
    ]
    skin += [(0.1, 0.275), (0.055, 0.315), (0, 0.33)]
    string = sweep([(0, -0.012, 0), (0.02, -0.2, 0.01), (-0.01, -0.4, 0)], [0.0025] * 3, d, 4)
    return [("Skin", lathe(skin, d, 20), None), ("String", string, "White")]


def _ring_tower(d: Detail) -> Pieces:
    stem = turned([(0, 0), (0.2, 0), (0.2, 0.03), (0.03, 0.05), (0.02, 0.46), (0, 0.47)], d, 20)
    pieces: Pieces = [("Foot", stem, "PaleWood"), ("Cap", ball(0.045, d, 12, 8).moved((0, 0.49, 0)), "Blue")]
    y = 0.04
    for ring, bead, look in (
        (0.13, 0.055, "Red"),
        (0.115, 0.05, "Orange"),
        (0.1, 0.045, "Lemon"),
        (0.085, 0.04, "Green"),
    ):
        y += bead
        pieces.append((look, torus(ring, bead, d, 20, 8).moved((0, y, 0)), look))
        y += bead
    return pieces


def _pawn(d: Detail) -> Pieces:
    profile = [(0, 0.001), (0.1, 0), (0.105, 0.02), (0.09, 0.045), (0.055, 0.08), (0.038, 0.16), (0.034, 0.2)]
    profile += [
        (0.06, 0.215),
        (0.06, 0.225),
        (0.035, 0.235),
        (0.055, 0.27),
        (0.06, 0.3),
        (0.045, 0.34),
        (0, 0.36),
    ]
    return [("Body", lathe(profile, d, 22), None)]


def _spinning_top(d: Detail) -> Pieces:
    body = [(0, 0), (0.012, 0.02), (0.09, 0.09), (0.15, 0.14), (0.155, 0.16), (0.1, 0.185), (0.03, 0.195)]
    stem = [(0.03, 0.195), (0.016, 0.21), (0.014, 0.3), (0.022, 0.32), (0, 0.33)]
    looks = ((0.25, 0.06, 0.4), (0.75, 0.25, 0.4))
    return [
        ("Body", turned(body, d, 24, looks, (0, 1, 0, 1, 0, 1)), None),
        ("Stem", turned(stem, d, 10), "Lemon"),
    ]


def _rainbow(d: Detail) -> Pieces:
    return [
        (look, torus(0.1 + 0.052 * k, 0.025, d, 16, 7, turn=180).moved(rotate=(-90, 0, 0)), look)
        for k, look in enumerate(("Purple", "Blue", "Green", "Lemon", "Orange", "Red"))
    ]


def _toy_block(d: Detail) -> Pieces:
    """A cube of 0.24 m with a dot on each open side; its body takes the look bound to it."""
    side = 0.24
    dot = revolve([0.055, 0.05, 0.0], [0.0, 0.006, 0.008], d.count(14))
    faces = [((0, side, 0), (0, 0, 0))]
    faces += [(((side / 2) * s, side / 2, 0), (0, 0, -90 * s)) for s in (1, -1)]
    faces += [((0, side / 2, (side / 2) * s), (90 * s, 0, 0)) for s in (1, -1)]
    dots = merge(*[dot.moved(at, turn) for at, turn in faces])
    return [("Body", block((side, side, side), d, 0.014, 0.08), None), ("Dots", dots, "Lemon")]


# The car

CAR_AXLES, CAR_WHEEL = (1.36, -1.34), 0.33  # where the wheels are along the car, and their radius [m]
CAR_ARCH = 0.43  # radius of the openings around them
CAR_GROUND = 0.21  # height of the floor plate


def _car_section(z: float) -> np.ndarray:
    """Right half of the cage's cross section at z, points (x, y) from the floor's middle to the roof's, [14, 2].

    Profiles over z are piecewise linear: the subdivision rounds them.
    """

    def along(*knots: tuple[float, float]) -> float:
        return float(np.interp(z, *zip(*knots, strict=True)))

    deck = along(
        (-2.25, 0.66), (-2.1, 0.86), (-1.6, 0.93), (-0.4, 0.92), (0.9, 0.9), (1.7, 0.83), (2.1, 0.74), (2.25, 0.56)
    )
    cabin = along((-1.75, 0.0), (-1.0, 0.86), (-0.55, 1.0), (0.05, 1.0), (0.3, 0.93), (1.0, 0.0))
    width = along((-2.25, 0.7), (-2.12, 0.82), (-1.7, 0.88), (0.0, 0.88), (1.7, 0.89), (2.08, 0.83), (2.25, 0.66))
    floor = along((-2.25, 0.36), (-2.1, 0.24), (-1.9, CAR_GROUND), (1.9, CAR_GROUND), (2.1, 0.24), (2.25, 0.34))
    reach = min(abs(z - axle) for axle in CAR_AXLES)
    arch = math.sqrt(max(CAR_ARCH**2 - reach**2, 0.0))
    sill = max(floor, CAR_WHEEL - 0.02 + arch) if arch > 0.0 else floor
    flare = 0.035 * arch / CAR_ARCH
    top = deck + 0.035 + 0.5 * cabin
    waist = deck - 0.06
    lean = 0.02 * (1.0 - cabin)  # a bonnet is a little crowned, where a cabin has its side windows
    return np.array(
        [
            (0.0, floor - 0.02),
            (0.58 * width, floor),
            (0.62 * width, sill),
            (0.94 * width + flare, sill),
            (0.995 * width + flare, sill + 0.04),
            (1.01 * width + 0.8 * flare, sill + 0.55 * (waist - sill)),
            (width, waist),
            (0.94 * width, deck),
            (0.86 * width, deck + lean),
            ((0.66 + 0.12 * cabin) * width, deck + 0.02 + 0.22 * cabin),
            ((0.5 + 0.17 * cabin) * width, top - 0.1 * cabin),
            ((0.34 + 0.2 * cabin) * width, top - 0.02 * cabin),
            (0.2 * width, top),
            (0.0, top + 0.01),
        ]
    )


def _car_shell(d: Detail) -> Pieces:
    """The control cage of a car's body, front +Z, wheels to stand on y = 0; neither convex nor star-shaped."""
    stops = [-2.25, -2.2, -2.13, -2.04, -1.94, -1.85, *np.linspace(-0.82, 0.84, 15), 1.86, 1.94, 2.03, 2.11, 2.18, 2.25]
    for axle in CAR_AXLES:
        stops += [axle + CAR_ARCH * share for share in (-1.04, -0.99, -0.85, -0.5, 0.0, 0.5, 0.85, 0.99, 1.04)]
    stops = np.sort(stops)[::-1]  # from the front on, so that the skin faces outwards
    fine = d.count(1)
    stops = np.interp(np.arange((len(stops) - 1) * fine + 1) / fine, np.arange(len(stops)), stops)
    half = np.array([_car_section(z) for z in stops])
    right = np.concatenate([half, np.broadcast_to(stops[:, None, None], (*half.shape[:2], 1))], axis=-1)
    left = right[:, -2:0:-1] * (-1.0, 1.0, 1.0)
    ring = np.concatenate([right, left], axis=1)
    n, last = ring.shape[1], half.shape[1] - 1
    skin = patch(ring, wrap_columns=True)
    caps = []
    for first, flip in ((0, False), ((len(stops) - 1) * n, True)):
        for k in range(last):
            quad = [k, k + 1, (n - k - 1) % n, (n - k) % n]
            face = [first + v for v in dict.fromkeys(quad)]
            caps.append(face[::-1] if flip else face)
    counts = np.concatenate([skin.counts, [len(face) for face in caps]])
    indices = np.concatenate([skin.indices, np.concatenate(caps)])
    return [("Body", Surface(skin.points, counts, indices, scheme="catmullClark"), None)]


PARTS: dict[str, Callable[[Detail], Pieces]] = {
    "apple": _apple,
    "balloon": _balloon,
    "banana": _banana,
    "base_unit": _base_unit,
    "beach_ball": _beach_ball,
    "book_row": _book_row,
    "bottle": _bottle,
    "bowl": _bowl,
    "car_shell": _car_shell,
    "chair": _chair,
    "clock": _clock,
    "cloth": _cloth,
    "cloth_strip": _strip("cloth", 4, 0.3),
    "cup": _cup,
    "floor_strip": _strip("tiles_floor", 6, 0.7),
    "jar": _jar,
    "kettle": _kettle,
    "kettle_trim": _kettle_trim,
    "ladle": _ladle,
    "lamp": _lamp,
    "lemon": _lemon,
    "mat_strip": _strip("tiles_mat", 5, 1.0),
    "orange": _orange,
    "pawn": _pawn,
    "pear": _pear,
    "plant": _plant,
    "plate": _plate,
    "pot": _pot,
    "rainbow": _rainbow,
    "ring_stand": _ring_stand,
    "ring_tower": _ring_tower,
    "spinning_top": _spinning_top,
    "tiles_floor": _floor_tiles,
    "tiles_mat": _mat_tiles,
    "tiles_ochre": _wall_tiles(OCHRE_TILES),
    "tiles_peach": _wall_tiles(PEACH_TILES),
    "tiles_play": _wall_tiles(PLAY_TILES),
    "tiles_teal": _wall_tiles(TEAL_TILES),
    "toy_block": _toy_block,
    "wall_ochre": _tiled_wall(7, *["tiles_ochre"] * 4),
    "wall_play": _tiled_wall(8, *["tiles_play"] * 4, *["tiles_peach"] * 4),
    "wall_teal": _tiled_wall(7, *["tiles_teal"] * 4),
    "wall_unit": _wall_unit,
    **CITY_PARTS,
}
