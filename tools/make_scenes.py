"""Write the stages of `usd_scenes/`: small, original, one reflection effect or one paper scene each.

`python tools/make_scenes.py [--out DIR] [--only NAME] [--scale K] [--large DIR]`; from a benchmark:
`make_scenes.build("kitchen", "kitchen.usdc", scale=4)`.

Lengths are metres, +Y is up, colours linear Rec.709; two runs write the same bytes. `scale` multiplies the
segments along each direction of every mesh, so triangles grow with its square. Shared objects are files of
their own in `parts/` beside the scene. What a scene expects of a renderer stands in its layer's
`customLayerData["warp_reflect"]`.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdValidation, Vt
from scene_city import CITY_SCENES, LARGE_CITIES
from scene_curved import CURVED_SCENES
from scene_cut import CUT_SCENES
from scene_gloss import GLOSS_SCENES
from scene_parts import STAND_BEAD, STAND_RING
from scene_sets import WALLS, arena, boxes, corner, play_room, play_things, studio
from scene_shapes import Detail, block, merge, patch, revolve, sheet
from scene_water import WATER_SCENES
from scene_writer import MIRROR_DIGITS, Recipe, Writer, new_stage


def build(name: str, path, scale: float = 1.0) -> Path:
    """Write the scene `name` to `path` (.usda or .usdc) and the parts it references beside it.

    Args:
        name: A key of `SCENES`.
        path: The file to write; the parts go to `parts/` (`parts_x<scale>/`) beside it, in the same format.
        scale: Multiplies the segments along each direction of every mesh; triangles grow with its square.

    Raises:
        ValueError: an unknown scene, or a scale that is not above 0.
    """
    recipes = SCENES | LARGE_CITIES
    if name not in recipes:
        raise ValueError(f"scene: got '{name}', expected one of {', '.join(recipes)}")
    if not scale > 0.0:
        raise ValueError(f"scale: got {scale!r}, expected a number above 0")
    path = Path(path).absolute()
    recipe = recipes[name]
    folder = "parts" if scale == 1.0 else f"parts_x{scale:g}"
    stage = new_stage(path, "World")
    recipe.make(Writer(stage, Detail(scale), path.suffix, path.parent / folder, f"./{folder}"))
    layer = stage.GetRootLayer()
    layer.customLayerData = {
        "warp_reflect": {
            "description": recipe.description,
            "techniques": Vt.StringArray(list(recipe.techniques)),
            "allowed": Vt.StringArray(list(recipe.allowed)),
            "reflectors": Vt.StringArray(list(recipe.reflectors)),
            "max_error_px": recipe.max_error_px,
            "min_identical": recipe.min_identical,
        }
    }
    layer.Save()
    return path


TABLE = 0.76  # height of the kitchen table's top [m]
ROOM = 2.1  # half the kitchen's width and depth [m]


def _kitchen(w: Writer) -> None:
    """Three chrome bodies among the things of a laid table, after figure 6 of Estalella et al. 2005."""
    _kitchen_shell(w)
    _kitchen_window(w)
    _kitchen_furniture(w)
    _kitchen_table(w)
    _kitchen_mirrors(w)
    w.camera((0.02, 1.15, 1.4), (0.02, 0.935, 0.0), 32.5)
    w.lights(sun_rotate=(-80, 24, 0))  # so steep that what falls through the roof light reaches the table


def _kitchen_shell(w: Writer) -> None:
    d, m = w.detail, ROOM
    for name, turn in WALLS:
        upper = sheet((-m, 1.2, -m), (2 * m, 0, 0), (0, 1.4, 0), d.count(7), d.count(3))
        w.mesh(f"/World/Shell/{name}Wall", upper.moved(rotate=(0, turn, 0)), "Plaster")
        x, z = corner(-m, -m, turn)
        w.part(f"/World/Shell/{name}Tiles", "wall_ochre", (x, 0, z), (0, turn, 0))
    back = [
        sheet((-m, y, -m), (2 * m, 0, 0), (0, h, 0), d.count(7), d.count(n)) for y, h, n in ((0, 0.9, 2), (2.1, 0.5, 1))
    ]
    back += [sheet((x, 1.5, -m), (1.2, 0, 0), (0, 0.6, 0), d.count(3), d.count(2)) for x in (-m, 0.9)]
    w.mesh("/World/Shell/BackWall", merge(*back), "Plaster")
    for row in range(2):
        for column in range(7):
            if row == 0 or column in (0, 1, 5, 6):  # the window is above the others
                w.part(f"/World/Shell/T{row}{column}", "tiles_teal", (-m + 0.6 * column, 0.9 + 0.3 * row, -m))
    for column in range(6):
        w.part(f"/World/Shell/Floor{column}", "floor_strip", (-m + 0.7 * column, 0, m))
    # A roof light, 1.8 m square above the table, through which the distant light falls.
    rim = 0.9
    slabs = [
        sheet((-m, 2.6, -m), (2 * m, 0, 0), (0, 0, m - rim), d.count(7), d.count(2)),
        sheet((-m, 2.6, rim), (2 * m, 0, 0), (0, 0, m - rim), d.count(7), d.count(2)),
        sheet((-m, 2.6, -rim), (m - rim, 0, 0), (0, 0, 2 * rim), d.count(2), d.count(3)),
        sheet((rim, 2.6, -rim), (m - rim, 0, 0), (0, 0, 2 * rim), d.count(2), d.count(3)),
    ]
    w.mesh("/World/Shell/Ceiling", merge(*slabs), "Ceiling")
    for k, x in enumerate((-0.9, -0.3, 0.3, 0.9)):
        w.cube(f"/World/Shell/Beam{k}", (x, 2.56, 0), (0.06, 0.12, 1.86), "PaleWood")
    for k, z in enumerate((-0.9, 0.9)):
        w.cube(f"/World/Shell/Cross{k}", (0, 2.57, z), (1.86, 0.1, 0.06), "PaleWood")


def _kitchen_window(w: Writer) -> None:
    d, z = w.detail, -ROOM
    sky = sheet((-0.9, 1.36, z - 0.06), (1.8, 0, 0), (0, 0.74, 0), d.count(6), d.count(3))
    w.mesh("/World/Window/Sky", sky, "Daylight")
    u = np.linspace(0, 1, d.count(12) + 1)
    hills = np.stack([1.8 * u - 0.9, 1.44 + 0.035 * np.sin(8 * u) + 0.02 * np.sin(19 * u + 1), 0 * u + z - 0.055], -1)
    w.mesh("/World/Window/Meadow", patch(np.stack([hills * (1, 0, 1) + (0, 1.2, 0), hills], 1)), "Meadow")
    for k, x in enumerate((-0.9, -0.3, 0.3, 0.9)):
        w.cube(f"/World/Window/Mullion{k}", (x, 1.2, z), (0.05, 0.9, 0.09), "White")
    for k, y in enumerate((1.19, 1.62, 2.06)):
        w.cube(f"/World/Window/Rail{k}", (0, y, z), (1.85, 0.045, 0.085), "White")
    w.cube("/World/Window/Sill", (0, 1.17, z + 0.05), (1.95, 0.025, 0.17), "PaleWood")
    for k, x in enumerate((-0.6, 0.0, 0.6)):
        w.part(f"/World/Window/Plant{k}", "plant", (x, 1.195, z + 0.07), (0, 70 * k, 0), 0.8)


def _kitchen_furniture(w: Writer) -> None:
    d, m = w.detail, ROOM
    for k in range(7):
        w.part(f"/World/Units/Base{k}", "base_unit", (-m + 0.6 * k, 0, -m))
    w.mesh("/World/Units/Top", block((2 * m, 0.035, 0.62), d, 0.006, 0.6).moved((0, 0.88, -m + 0.31)), "PaleWood")
    for k, x in enumerate((-m, -m + 0.6, 0.9, 1.5)):
        w.part(f"/World/Units/Wall{k}", "wall_unit", (x, 1.5, -m))
    # Right wall: a second run of units under a shelf.
    for k in range(4):
        w.part(f"/World/Units/Side{k}", "base_unit", (m, 0, -0.9 + 0.6 * k), (0, -90, 0))
    w.mesh(
        "/World/Units/SideTop",
        block((0.62, 0.035, 2.4), d, 0.006, 0.6).moved((m - 0.31, 0.88, 0.3)),
        "PaleWood",
    )
    w.cube("/World/Shelf/Board", (m - 0.12, 1.55, 0.3), (0.24, 0.03, 2.0), "DarkWood")
    w.part("/World/Shelf/Books", "book_row", (m - 0.12, 1.58, -0.55), (0, -90, 0))
    for k in range(3):
        w.part(f"/World/Shelf/Jar{k}", "jar", (m - 0.12, 1.58, 0.25 + 0.3 * k), (0, 30 * k, 0))
    # Left wall: a dresser. Front wall: a door and a clock.
    w.cube("/World/Dresser/Body", (-m + 0.22, 0, 0.55), (0.44, 0.92, 1.3), "Teal")
    w.cube("/World/Dresser/Top", (-m + 0.23, 0.92, 0.55), (0.46, 0.03, 1.34), "PaleWood")
    for k in range(3):
        w.cube(f"/World/Dresser/Drawer{k}", (-m + 0.445, 0.08 + 0.28 * k, 0.55), (0.02, 0.25, 1.2), "Cream")
    for k in range(2):
        w.cube(f"/World/Dresser/Board{k}", (-m + 0.13, 1.3 + 0.36 * k, 0.55), (0.26, 0.025, 1.3), "PaleWood")
    for k in range(3):
        z = 0.19 + 0.36 * k
        w.part(f"/World/Dresser/Plate{k}", "plate", (-m + 0.1, 1.455, z), (0, 0, -80))
        w.part(f"/World/Dresser/Cup{k}", "cup", (-m + 0.15, 1.685, z), (0, 40 + 25 * k, 0))
    w.part("/World/Dresser/Bowl", "bowl", (-m + 0.23, 0.95, 0.3))
    w.part("/World/Dresser/Plant", "plant", (-m + 0.23, 0.95, 0.95), scale=1.3)
    w.cube("/World/Door/Leaf", (-0.7, 0, m - 0.02), (0.86, 2.05, 0.04), "Blue")
    for k, (y, h) in enumerate(((0.15, 0.75), (1.05, 0.85))):
        w.cube(f"/World/Door/Panel{k}", (-0.7, y, m - 0.045), (0.6, h, 0.02), "SkyBlue")
    w.part("/World/Clock", "clock", (0.75, 1.9, m - 0.03), (0, 180, 0))
    # On the back counter, and above it.
    for name, x, z, turn, size, look in (
        ("pot", -1.15, -1.72, 25, 1.0, None),
        ("jar", -0.78, -1.86, 0, 1.0, None),
        ("jar", -0.65, -1.82, 40, 0.85, None),
        ("bowl", 0.82, -1.75, 0, 1.0, None),
        ("bottle", 1.12, -1.85, 0, 1.0, "Amber"),
        ("bottle", 1.25, -1.8, 0, 1.0, "Bottle"),
    ):
        path = f"/World/Counter/{name.capitalize()}{round(100 * abs(x))}"
        w.part(path, name, (x, 0.915, z), (0, turn, 0), size, look)
    w.cube("/World/Counter/Rail", (-1.45, 1.4, -m + 0.04), (0.8, 0.012, 0.012), "Steel")
    for k in range(4):
        w.part(f"/World/Counter/Ladle{k}", "ladle", (-1.75 + 0.2 * k, 1.39, -m + 0.06))
    for k, (x, z) in enumerate(((-0.5, -0.3), (0.5, 0.3))):
        w.part(f"/World/Lamp{k}", "lamp", (x, 1.86, z))


def _kitchen_table(w: Writer) -> None:
    t = TABLE
    w.mesh(
        "/World/Table/Board",
        block((1.86, 0.035, 1.26), w.detail, 0.008, 0.6).moved((0, t - 0.038, 0)),
        "Wood",
    )
    for k, (x, z) in enumerate(((-0.85, -0.55), (0.85, -0.55), (-0.85, 0.55), (0.85, 0.55))):
        w.cube(f"/World/Table/Leg{k}", (x, 0, z), (0.07, t - 0.038, 0.07), "Wood")
    for column in range(6):
        w.part(f"/World/Table/Cloth{column}", "cloth_strip", (-0.9 + 0.3 * column, t, 0.6))
    for k, (name, x, z, turn, look) in enumerate(
        (
            ("apple", -0.14, 0.19, 20, "Red"),
            ("apple", -0.235, 0.24, 200, "AppleGreen"),
            ("orange", -0.07, 0.1, 0, None),
            ("lemon", 0.12, 0.19, 35, None),
            ("lemon", 0.2, 0.25, -20, None),
            ("banana", 0.3, 0.26, 12, None),
            ("pear", 0.245, -0.1, 80, None),
            ("pear", -0.59, 0.1, 10, None),
            ("cup", -0.16, -0.3, 215, None),
            ("cup", 0.52, 0.33, -30, None),
            ("bottle", -0.6, -0.3, 0, "Bottle"),
            ("bottle", -0.51, -0.42, 0, "Amber"),
            ("bottle", 0.29, -0.44, 0, "Bottle"),
            ("bowl", 0.66, -0.34, 0, None),
            ("orange", 0.68, 0.03, 60, None),
            ("plate", -0.03, 0.42, 0, None),
            ("plate", -0.56, 0.37, 0, None),
            ("jar", -0.29, -0.46, 0, None),
            ("plant", 0.05, -0.52, 15, None),
        )
    ):
        w.part(f"/World/Table/Item{k:02d}", name, (x, t, z), (0, turn, 0), look=look)
    for k, (name, x, y, z, look) in enumerate(
        (
            ("apple", 0.62, 0.03, -0.37, "Red"),
            ("orange", 0.7, 0.032, -0.38, None),
            ("apple", 0.66, 0.035, -0.29, "AppleGreen"),
            ("lemon", 0.665, 0.085, -0.345, None),
        )
    ):
        w.part(f"/World/Table/Fruit{k}", name, (x, t + y, z), (0, 70 * k, 0), look=look)
    chairs = ((-1.15, 0.05, 90), (1.15, 0.1, -90), (0.4, -0.85, 0), (-0.4, -0.85, 0), (-0.25, 1.0, 180))
    for k, (x, z, turn) in enumerate(chairs):
        w.part(f"/World/Chair{k}", "chair", (x, 0, z), (0, turn, 0))


def _resting_height(half_height: float, radius: float) -> float:
    """Height of the centre of an ellipsoid of revolution (about Y) on a ring stand, just clear of it [m]."""
    # Where the meridian, offset by the bead's radius, passes the ring's circle: bisection on its parameter.
    low, high = 0.0, math.pi / 2
    for _ in range(60):
        t = 0.5 * (low + high)
        normal = np.array([math.sin(t) / radius, math.cos(t) / half_height])
        normal /= np.linalg.norm(normal)
        if radius * math.sin(t) + STAND_BEAD * normal[0] < STAND_RING:
            low = t
        else:
            high = t
    clearance = 0.0005
    return round(half_height * math.cos(low) + STAND_BEAD * normal[1] + STAND_BEAD + clearance, 6)


def _kitchen_mirrors(w: Writer) -> None:
    t = TABLE
    _chrome_kettle(w, (-0.37, t, -0.04), -24)
    w.part("/World/SphereStand", "ring_stand", (0.035, t, -0.17))
    w.sphere("/World/ChromeSphere", (0.035, t + _resting_height(0.168, 0.168), -0.17), 0.168, "Chrome")
    # The long axis, where the ellipsoid is flattest, is what meets the stand first.
    w.part("/World/EllipsoidStand", "ring_stand", (0.43, t, 0.04))
    height = _resting_height(0.135, 0.215)
    w.sphere("/World/ChromeEllipsoid", (0.43, t + height, 0.04), (0.215, 0.135, 0.15), "Chrome", (0, 16, 0))


def _chrome_kettle(w: Writer, at, turn: float) -> None:
    w.part("/World/KettleTrim", "kettle_trim", at, (0, turn, 0))
    w.part("/World/Kettle", "kettle", at, (0, turn, 0), look="Chrome", instance=False)


def _one_mirror(w: Writer) -> None:
    """One ellipsoid over half of the picture in a toy room; most of what it shows stands around the eye."""
    play_room(w)
    play_things(w)
    w.cylinder("/World/Pedestal", (0, 0, 0), 0.15, 0.42, "Wood")
    w.sphere("/World/Mirror", (0, 0.98, 0), (0.81, 0.54, 0.6), "Chrome")
    w.camera((0.0, 1.2, 1.75), (0.0, 0.97, 0.0), 41.0)
    w.room_lights(2.0, 0.08)


def _sphere_on_checker(w: Writer) -> None:
    arena(w, 7.0, 28)
    w.sphere("/World/Mirror", (0, 1.005, 0), 1.0, "Chrome")
    boxes(
        w,
        (-1.7, 0.6, 0.5, 0.5, 20, "Red"),
        (1.55, 0.9, 0.5, 0.7, 45, "Yellow"),
        (-1.1, 1.9, 0.5, 0.6, 70, "Green"),
        (1.3, -1.6, 0.5, 1.3, 95, "Blue"),
        (0.35, 2.2, 0.3, 0.3, 15, "Orange"),
        (-1.5, -1.5, 0.6, 1.7, 30, "Purple"),
    )
    w.camera((0.6, 2.0, 5.2), (0, 0.95, 0), 31)
    w.lights()


def _ellipsoid_row(w: Writer) -> None:
    arena(w, 7.0, 28)
    w.sphere("/World/Tall", (-1.75, 1.38, 0), (0.45, 1.35, 0.45), "Chrome")
    w.sphere("/World/Disc", (0, 0.9, 0), (0.8, 0.8, 0.16), "Chrome", (0, 12, 0))
    w.sphere("/World/Cigar", (2.1, 0.5, 0.3), (1.6, 0.32, 0.32), "Chrome", (0, 25, 0))
    looks = ("Red", "Orange", "Lemon", "Green", "SkyBlue", "Purple", "Pink")
    near = [
        (3.0 * math.sin(a), 1.5 * math.cos(a) + 0.3, 0.3, 0.3, 17 * k, looks[k])
        for k, a in enumerate(np.radians(np.linspace(-80, 80, 7)))
    ]
    far = [(-3.0 + k, -2.2, 0.45, 0.6 + 0.2 * (k * 3 % 5), 11 * k, looks[-1 - k]) for k in range(7)]
    boxes(w, *near, *far)
    w.camera((0.2, 1.9, 6.0), (0.4, 1.15, 0), 36)
    w.lights()


def _capped_cylinder(w: Writer) -> None:
    arena(w, 7.0, 28)
    w.cylinder("/World/Cylinder", (-0.95, 0.01, 0), 0.65, 1.2, "Chrome")
    w.capsule("/World/Capsule", (1.05, 1.0, 0.1), 0.5, 0.9, "Chrome", (0, 0, 12))
    boxes(
        w,
        (-2.2, 0.9, 0.4, 0.5, 15, "Red"),
        (0.1, 1.3, 0.4, 0.4, 40, "Yellow"),
        (2.2, 0.9, 0.4, 0.6, 65, "Green"),
        (-0.1, -1.5, 0.4, 0.9, 90, "Blue"),
    )
    w.cube("/World/Board", (0, 2.5, -1.5), (3.6, 0.9, 0.1), "Coral")
    w.camera((0.2, 2.9, 4.9), (0.05, 0.95, 0), 33)
    w.lights()


def _two_spheres(w: Writer) -> None:
    arena(w, 7.0, 28)
    w.sphere("/World/Left", (-0.95, 0.905, 0), 0.9, "Chrome")
    w.sphere("/World/Right", (1.0, 0.705, 0.35), 0.7, "Chrome")
    boxes(
        w,
        (-2.1, 0.9, 0.4, 0.4, 15, "Red"),
        (0.1, 1.3, 0.35, 0.35, 40, "Orange"),
        (1.9, 1.3, 0.4, 0.5, 65, "Green"),
        (0.3, -1.4, 0.4, 1.2, 90, "SkyBlue"),
    )
    w.camera((0.1, 1.9, 5.0), (0.0, 0.75, 0), 31)
    w.lights()


def _red_blue_balls(w: Writer) -> None:
    """Far enough apart that an environment map at a ball's centre shows the other where it is."""
    arena(w, 7.0, 28)
    w.sphere("/World/RedBall", (-1.45, 1.005, 0), 1.0, "RedMirror")
    w.sphere("/World/BlueBall", (1.45, 1.005, 0.3), 1.0, "BlueMirror")
    boxes(w, (-0.1, 1.5, 0.4, 0.4, 15, "Yellow"), (0.2, -1.4, 0.5, 1.0, 40, "White"))
    w.camera((0.0, 1.7, 5.6), (0.0, 0.9, 0), 34)
    w.lights()


def _open_bowl(w: Writer) -> None:
    """A thin double-sided shell: its rim is a border, and inside it sees itself."""
    d = w.detail
    studio(w, 4.0, 4.2)
    t = np.linspace(-math.pi / 2, -0.1, d.count(10) + 1)
    r, y = np.cos(t), np.sin(t)
    r[0] = 0.0
    shell = revolve(r, 0.8 * y, d.count(32), np.stack([0.8 * r, y], 1))
    bowl = w.mesh("/World/Bowl", shell, "Chrome", double_sided=True, digits=MIRROR_DIGITS)
    w.transform(bowl, (0, 0.86, 0), (24, 0, 10))
    boxes(
        w,
        (-1.5, 0.7, 0.4, 0.5, 20, "Red"),
        (1.4, 0.9, 0.4, 0.7, 45, "Yellow"),
        (-0.9, -1.5, 0.4, 1.3, 70, "Green"),
        (1.2, -1.5, 0.4, 1.7, 95, "Blue"),
    )
    w.cube("/World/Board", (0, 2.4, -1.8), (3.0, 0.6, 0.1), "Coral")
    for k, (x, y, z, look) in enumerate(
        ((0.3, 2.7, 0.1, "Purple"), (-0.5, 2.9, 0.5, "Orange"), (-0.2, 3.0, -0.5, "Green"))
    ):
        w.part(f"/World/Balloons/B{k}", "balloon", (x, y, z), (0, 0, 4 * k - 4), 1.4, look)
    w.camera((0.4, 2.6, 3.9), (0, 0.65, 0), 30)
    w.room_lights(3.9, 0.14)


def _mesh_kettle(w: Writer) -> None:
    arena(w, 1.4, 28)
    _chrome_kettle(w, (0, 0, 0), -30)
    looks = ("Red", "Orange", "Lemon", "Green", "SkyBlue", "Purple")
    placed = []
    for k, look in enumerate(looks):
        a = math.radians(60 * k + 30)
        placed.append((0.34 * math.sin(a), 0.3 * math.cos(a), 0.07, 0.06 + 0.03 * (k * 5 % 6), 23 * k, look))
    boxes(w, *placed)
    w.camera((0.1, 0.4, 0.92), (0, 0.165, 0), 25)
    w.lights()


def _far_offset(w: Writer) -> None:
    """sphere_on_checker, camera and lights included, 22,000 km from the origin."""
    near = w.parts.parent / f"sphere_on_checker{w.suffix}"
    build("sphere_on_checker", near, w.detail.scale)
    world = w.stage.GetDefaultPrim()
    world.GetReferences().AddReference(f"./{near.name}")
    w.transform(world, (1e7, 0.0, -2e7))


SCENES = {
    "kitchen": Recipe(
        _kitchen,
        "Chrome mesh, sphere and ellipsoid on a laid kitchen table; after Estalella et al. 2005, figure 6",
        ("/World/Kettle/Body", "/World/ChromeSphere", "/World/ChromeEllipsoid"),
    ),
    "one_mirror": Recipe(_one_mirror, "One ellipsoid over half of the picture in a toy room", ("/World/Mirror",)),
    "sphere_on_checker": Recipe(_sphere_on_checker, "A sphere over a checker floor", ("/World/Mirror",)),
    "ellipsoid_row": Recipe(
        _ellipsoid_row,
        "Ellipsoids of half axes 1:3:1, 1:1:0.2 and 5:1:1 among boxes",
        ("/World/Tall", "/World/Disc", "/World/Cigar"),
    ),
    "capped_cylinder": Recipe(
        _capped_cylinder,
        "A cylinder with flat caps and sharp rims (three surfaces in one mirror) and a capsule",
        ("/World/Cylinder", "/World/Capsule"),
    ),
    "two_spheres": Recipe(_two_spheres, "Two spheres that see each other", ("/World/Left", "/World/Right")),
    "red_blue_balls": Recipe(
        _red_blue_balls,
        "A red and a blue mirror ball: mirrors in mirrors; after Real-Time Rendering, section 9.3.2",
        ("/World/RedBall", "/World/BlueBall"),
    ),
    "open_bowl": Recipe(
        _open_bowl,
        "An open double-sided bowl: half an ellipsoid, from outside and from within",
        ("/World/Bowl",),
    ),
    "mesh_kettle": Recipe(
        _mesh_kettle,
        "A convex mesh of revolution close up",
        ("/World/Kettle/Body",),
        techniques=("reflector_map", "raytraced"),
    ),
    "far_offset": Recipe(
        _far_offset,
        "sphere_on_checker moved by (1e7, 0, -2e7): the picture must not change",
        ("/World/Mirror",),
    ),
    **CURVED_SCENES,
    **CUT_SCENES,
    **WATER_SCENES,
    **CITY_SCENES,
    **GLOSS_SCENES,
}


def triangle_count(path) -> tuple[int, int]:
    """(triangles of meshes and cubes, curved gprims) a stage draws, instances expanded."""
    stage = Usd.Stage.Open(str(path))
    triangles = curved = 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            triangles += int((np.asarray(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get()) - 2).sum())
        elif prim.IsA(UsdGeom.Cube):
            triangles += 12
        elif prim.IsA(UsdGeom.Gprim):
            curved += 1
    return triangles, curved


def validate(path) -> list[str]:
    """What every validator of USD says against a file; empty where it is clean."""
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(data.name) for data in registry.GetAllValidatorMetadata()]
    stage = Usd.Stage.Open(str(path))
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetErrorAsString()}" for error in errors]


# The factor of `--large`: it brings the kitchen and the one mirror scene to millions of triangles.
LARGE_SCALE = 6.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default=Path(__file__).resolve().parent.parent / "usd_scenes", type=Path)
    parser.add_argument(
        "--only", action="append", choices=sorted(SCENES | LARGE_CITIES), help="this scene; may be repeated"
    )
    parser.add_argument("--scale", default=1.0, type=float, help="multiplies the segments of every mesh")
    parser.add_argument(
        "--large", type=Path, help="also write million-triangle .usdc versions, and the cities, into this folder"
    )
    args = parser.parse_args()
    jobs = [(name, args.out / f"{name}.usda", args.scale) for name in args.only or SCENES]
    if args.large:
        jobs += [(name, args.large / f"{name}.usdc", LARGE_SCALE) for name in ("kitchen", "one_mirror")]
        jobs += [(name, args.large / f"{name}.usdc", 1.0) for name in LARGE_CITIES]
    failed = False
    folders = set()
    for name, path, scale in jobs:
        build(name, path, scale)
        folders |= {(folder, path.suffix) for folder in path.parent.glob("parts*")}
        triangles, curved = triangle_count(path)
        print(f"{path}: {triangles:,} triangles, {curved} curved gprims, {path.stat().st_size / 1000:.1f} kB")
        failed = _report(path) or failed
    for folder, suffix in sorted(folders):
        parts = sorted(folder.glob(f"*{suffix}"))
        size = sum(part.stat().st_size for part in parts)
        print(f"{folder}: {len(parts)} parts, {size / 1000:.0f} kB")
        for part in parts:
            failed = _report(part) or failed
    return 1 if failed else 0


def _report(path: Path) -> bool:
    errors = validate(path)
    for error in errors:
        print(f"  {path}: {error}")
    return bool(errors)


if __name__ == "__main__":
    raise SystemExit(main())
