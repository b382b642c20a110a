"""Scenes of curved mirrors: quadrics in rooms after Lages Miguel et al. 2014, and shapes with several reflection points."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scene_parts import checked_sheet
from scene_sets import BALLOONS, WALLS, arena, boxes, corner, play_room, play_things, studio
from scene_shapes import block, dome, patch, revolve, sheet, spherical_cap, torus
from scene_writer import MIRROR_DIGITS, Recipe, Writer


def _toy_room(w: Writer) -> None:
    """Sphere, ellipsoid, cylinder, cone and paraboloid on toy blocks, the toys around them."""
    play_room(w)
    play_things(w, lambda x, z: abs(x) > 1.4 or not -0.85 < z < 1.2)
    stands = (  # x, z, width, height, turn [degrees], look
        (-1.0, -0.15, 0.44, 0.36, 12, "Red"),
        (0.0, -0.55, 0.42, 0.84, -8, "Blue"),
        (1.0, -0.15, 0.5, 0.3, 20, "Green"),
        (-0.52, 0.35, 0.5, 0.2, 30, "Lemon"),
        (0.5, 0.4, 0.66, 0.2, -14, "Purple"),
    )
    for k, (x, z, width, height, turn, look) in enumerate(stands):
        slab = block((width, height, width), w.detail, 0.02, 0.2).moved((x, 0, z), (0, turn, 0))
        w.mesh(f"/World/Stands/Stand{k}", slab, look)
    gap = 0.003  # keeps a mirror off what it stands on
    w.sphere("/World/Sphere", (-1.0, 0.36 + 0.4 + gap, -0.15), 0.4, "Chrome")
    w.sphere("/World/Ellipsoid", (0.0, 0.84 + 0.33 + gap, -0.55), (0.5, 0.33, 0.33), "Chrome", (0, 14, 0))
    w.cone("/World/Cone", (1.0, 0.3 + gap, -0.15), 0.4, 0.95, "Chrome")
    w.cylinder("/World/Cylinder", (-0.52, 0.2 + gap, 0.35), 0.22, 0.5, "Chrome")
    shape = dome(0.36, 0.42, w.detail, 48, 12)
    bowl = w.mesh("/World/Paraboloid", shape, "Chrome", digits=MIRROR_DIGITS)
    w.transform(bowl, (0.5, 0.2 + gap, 0.4))
    w.camera((0.05, 1.4, 2.25), (0.0, 0.7, 0.0), 43)
    w.room_lights(2.0, 0.08)


HALL_WIDTH, HALL_LENGTH, HALL_HEIGHT = 3.6, 12.0, 2.6  # half of the width is the radius of the vault [m]
HALL_FLOOR = ((0.55, 0.5, 0.42), (0.2, 0.1, 0.07))
HALL_WALL = ((0.6, 0.5, 0.36), (0.5, 0.4, 0.28))
BANNERS = ("Crimson", "Navy", "Leaf", "Orange", "Purple", "Teal")


def _corridor(w: Writer) -> None:
    """A vaulted hall with stone columns, banners and lamps, quadric mirrors down its middle."""
    d, half, length, high = w.detail, 0.5 * HALL_WIDTH, HALL_LENGTH, HALL_HEIGHT
    near = 0.5 * length
    floor = checked_sheet((-half, 0, near), (HALL_WIDTH, 0, 0), (0, 0, -length), 9, 30, HALL_FLOOR, d)
    w.mesh("/World/Hall/Floor", floor)
    left = checked_sheet((-half, 0, near), (0, 0, -length), (0, high, 0), 30, 6, HALL_WALL, d)
    right = checked_sheet((half, 0, -near), (0, 0, length), (0, high, 0), 30, 6, HALL_WALL, d)
    w.mesh("/World/Hall/Left", left)
    w.mesh("/World/Hall/Right", right)
    turn = np.linspace(0.0, math.pi, d.count(16) + 1)
    ribs = np.linspace(near, -near, d.count(24) + 1)
    arch = np.stack([half * np.cos(turn), high + 0.7 * half * np.sin(turn), 0 * turn], -1)
    vault = patch(arch[None] + ribs[:, None, None] * (0, 0, 1.0))
    band = np.arange(len(vault.counts)) // d.count(16) // d.count(2) % 2
    w.mesh("/World/Hall/Vault", vault.painted(((0.62, 0.55, 0.45), (0.25, 0.33, 0.42)), band))
    for k, (z, normal) in enumerate(((-near, 1.0), (near, -1.0))):
        end = sheet(
            (-half * normal, 0, z), (2 * half * normal, 0, 0), (0, high + 0.7 * half, 0), d.count(6), d.count(6)
        )
        w.mesh(f"/World/Hall/End{k}", end, "Sandstone")
        w.cube(f"/World/Hall/Door{k}", (0, 0, z + 0.03 * normal), (1.3, 2.2, 0.06), "DarkWood")
        w.sphere(f"/World/Hall/Rose{k}", (0, 2.95, z), (0.45, 0.45, 0.05), "Daylight")
    for k in range(6):
        z = near - 1.0 - 2.0 * k
        for side, name in ((-1.0, "L"), (1.0, "R")):
            x = side * (half - 0.22)
            w.cylinder(f"/World/Columns/{name}{k}", (x, 0.16, z), 0.15, high - 0.32, "Stone")
            w.cube(f"/World/Columns/{name}{k}Foot", (x, 0, z), (0.42, 0.16, 0.42), "Sandstone")
            w.cube(f"/World/Columns/{name}{k}Head", (x, high - 0.16, z), (0.42, 0.16, 0.42), "Sandstone")
            lamp = (side * (half - 0.42), 1.75, z)
            w.sphere(f"/World/Lamps/{name}{k}Globe", lamp, 0.07, "Lamp")
            w.cube(f"/World/Lamps/{name}{k}Arm", (side * (half - 0.36), 1.64, z), (0.14, 0.03, 0.03), "Black")
            if k < 5:
                look = BANNERS[(k + (3 if side > 0 else 0)) % 6]
                w.cube(f"/World/Banners/{name}{k}", (side * (half - 0.02), 0.75, z - 1.0), (0.03, 1.5, 0.7), look)
                w.cube(
                    f"/World/Banners/{name}{k}Stripe", (side * (half - 0.04), 0.95, z - 1.0), (0.03, 0.12, 0.7), "Lemon"
                )
    for k, z in enumerate((3.6, -0.4, -4.4)):
        w.lamp(f"/World/Lights/Hall{k}", (0, 3.0, z), 0.12, 90.0)
    things = (  # part, x, z, y, turn, size, look: in front of the mirrors and behind the eye
        ("pot", -1.2, 2.2, 0.0, 20, 2.0, None),
        ("plant", 1.2, 2.4, 0.0, 0, 2.4, None),
        ("plant", -1.15, -0.6, 0.0, 40, 2.4, None),
        ("chair", 1.1, 4.4, 0.0, 215, 1.1, None),
        ("chair", -1.1, 4.9, 0.0, 150, 1.1, None),
        ("beach_ball", 0.55, 3.0, 0.0, 20, 0.7, None),
        ("pawn", -0.65, 3.1, 0.0, 0, 1.6, "SkyBlue"),
        ("ring_tower", 1.05, 0.9, 0.0, 0, 1.3, None),
        ("pawn", 0.0, 5.3, 0.0, 0, 3.0, "Coral"),
    )
    for k, (name, x, z, y, angle, size, look) in enumerate(things):
        w.part(f"/World/Things/T{k}", name, (x, y, z), (0, angle, 0), size, look)
    gap = 0.003
    plinths = (
        (-0.62, 0.9, 0.5, 0.3),
        (0.62, 0.75, 0.55, 0.55),
        (0.0, -0.2, 0.7, 0.7),
        (-0.85, -1.5, 0.5, 0.9),
        (0.85, -1.5, 0.5, 0.9),
    )
    for k, (x, z, width, height) in enumerate(plinths):
        w.cube(f"/World/Plinths/P{k}", (x, 0, z), (width, height, width), "Stone")
    w.cylinder("/World/Cylinder", (-0.62, 0.3 + gap, 0.9), 0.22, 1.2, "Chrome")
    w.cone("/World/Cone", (0.62, 0.55 + gap, 0.75), 0.26, 0.85, "Chrome")
    w.sphere("/World/Sphere", (0.0, 0.7 + 0.42 + gap, -0.2), 0.42, "Chrome")
    w.sphere("/World/Ellipsoid", (-0.85, 0.9 + 0.5 + gap, -1.5), (0.26, 0.5, 0.26), "Chrome")
    shape = dome(0.3, 0.75, w.detail, 48, 16)
    body = w.mesh("/World/Paraboloid", shape, "Chrome", digits=MIRROR_DIGITS)
    w.transform(body, (0.85, 0.9 + gap, -1.5))
    w.camera((0.08, 1.6, 3.35), (-0.02, 1.06, 0.0), 35)
    w.lights(dome=(0.5, 0.5, 0.55), sun=0.5)


MIRROR_RADIUS = 0.6  # of the shaving mirror's sphere: its focus is 0.3 m before it [m]
MIRROR_ANGLE = 18.0  # half of the cap [degrees]


def _shaving_mirror(w: Writer) -> None:
    """A concave mirror on a wash stand: what is nearer than the eye's image is upright and large, the rest stands on its head."""
    d, m = w.detail, 2.1
    for name, turn in (("Back", 0), *WALLS):
        x, z = corner(-m, -m, turn)
        w.part(f"/World/Bath/{name}Tiles", "wall_teal", (x, 0, z), (0, turn, 0))
        upper = sheet((-m, 1.2, -m), (2 * m, 0, 0), (0, 1.3, 0), d.count(7), d.count(3))
        w.mesh(f"/World/Bath/{name}", upper.moved(rotate=(0, turn, 0)), "Plaster")
    for column in range(6):
        w.part(f"/World/Bath/Floor{column}", "floor_strip", (-m + 0.7 * column, 0, m))
    w.mesh("/World/Bath/Ceiling", sheet((-m, 2.5, -m), (2 * m, 0, 0), (0, 0, 2 * m), d.count(7), d.count(7)), "Ceiling")
    top = 0.85
    w.mesh("/World/Stand/Top", block((1.5, 0.04, 0.7), d, 0.008, 0.3).moved((0, top - 0.04, 0.1)), "PaleWood")
    w.cube("/World/Stand/Body", (0, 0, 0.08), (1.4, top - 0.05, 0.6), "Sage")
    # The mirror faces +z and leans back a little.
    middle, tilt = np.array([0.0, top + 0.2, -0.1]), 79.0
    cap = spherical_cap(MIRROR_RADIUS, MIRROR_ANGLE, d, 64, 14)
    w.transform(w.mesh("/World/Mirror", cap, "Chrome", digits=MIRROR_DIGITS), middle, (tilt, 0, 0))
    rim, depth = (
        MIRROR_RADIUS * math.sin(math.radians(MIRROR_ANGLE)),
        MIRROR_RADIUS * (1 - math.cos(math.radians(MIRROR_ANGLE))),
    )
    frame = torus(rim + 0.012, 0.01, d, 48, 8).moved((0, depth, 0))
    w.transform(w.mesh("/World/Frame", frame, "Crimson"), middle, (tilt, 0, 0))
    w.cylinder("/World/Post", (0, top, -0.17), 0.012, 0.1, "Steel")
    w.cylinder("/World/Foot", (0, top, -0.15), 0.09, 0.012, "Steel")
    near = (  # part, x, z, y, turn [degrees], size, look: between the mirror and where the eye's image is
        ("jar", -0.075, 0.1, 0.0, 0, 1.0, None),
        ("bottle", 0.085, 0.08, 0.0, 0, 0.62, "Amber"),
        ("cup", 0.005, 0.17, 0.0, 205, 0.8, None),
        ("lemon", -0.2, 0.13, 0.0, 30, 1.0, None),
        ("apple", 0.2, 0.14, 0.0, 20, 1.0, "Red"),
    )
    far = (  # behind it, beside the eye and beyond
        ("bottle", -0.3, 0.25, 0.0, 0, 1.0, "Bottle"),
        ("bottle", 0.36, 0.2, 0.0, 0, 0.9, "Amber"),
        ("jar", 0.3, 0.32, 0.0, 0, 1.0, None),
        ("plant", -0.45, 0.02, 0.0, 10, 1.0, None),
        ("orange", -0.38, 0.32, 0.0, 0, 1.0, None),
        ("pear", 0.47, 0.33, 0.0, 60, 1.0, None),
        ("bowl", 0.5, 0.02, 0.0, 0, 1.0, None),
    )
    for k, (name, x, z, y, turn, size, look) in enumerate(near + far):
        w.part(f"/World/Things/T{k:02d}", name, (x, top + y, z), (0, turn, 0), size, look)
    # What the mirror turns over: the far wall with a window, a shelf and balloons.
    w.mesh(
        "/World/Window/Sky", sheet((0.5, 0.9, m - 0.03), (-1.0, 0, 0), (0, 1.1, 0), d.count(4), d.count(4)), "Daylight"
    )
    w.mesh(
        "/World/Window/Meadow",
        sheet((0.5, 0.9, m - 0.05), (-1.0, 0, 0), (0, 0.3, 0), d.count(4), d.count(2)),
        "Meadow",
    )
    for k, x in enumerate((-0.5, 0.0, 0.5)):
        w.cube(f"/World/Window/Post{k}", (x, 0.85, m - 0.05), (0.05, 1.2, 0.06), "White")
    for k, y in enumerate((0.85, 2.0)):
        w.cube(f"/World/Window/Rail{k}", (0, y, m - 0.05), (1.05, 0.05, 0.07), "White")
    w.part("/World/Chair", "chair", (0.75, 0, 1.3), (0, 200, 0))
    for k, (x, z, look) in enumerate(
        ((-0.55, 1.2, "Red"), (0.45, 1.45, "Lemon"), (-0.9, 1.6, "SkyBlue"), (0.85, 1.7, "Green"))
    ):
        w.part(f"/World/Balloons/B{k}", "balloon", (x, 1.25 + 0.08 * k, z), (0, 0, 4 * k - 6), look=look)
    w.camera((0.0, 1.43, 0.78), (0.0, 1.03, -0.1), 30)
    w.room_lights(2.2, 0.08)


def _torus(w: Writer) -> None:
    """A ring of chrome: convex outside, saddle-shaped inside its hole, where it shows itself."""
    d = w.detail
    studio(w, 5.4, 5.0)
    ring = w.mesh("/World/Torus", torus(0.95, 0.36, d, 72, 36), "Chrome", digits=MIRROR_DIGITS)
    w.transform(ring, (0, 1.2, 0), (62, 0, 14))
    boxes(
        w,
        (-1.9, 0.9, 0.45, 0.5, 20, "Red"),
        (1.8, 1.0, 0.45, 0.7, 45, "Yellow"),
        (-1.3, -1.6, 0.5, 1.5, 70, "Green"),
        (1.5, -1.5, 0.5, 1.1, 95, "Blue"),
        (0.0, -2.4, 0.7, 0.8, 10, "Orange"),
        (0.7, 2.2, 0.3, 0.3, 25, "Purple"),
        (-0.7, 2.0, 0.3, 0.45, 65, "Coral"),
    )
    for k, (x, z, size) in enumerate(((0.0, 0.35, 0.9), (-2.4, -0.4, 1.5), (2.5, -0.3, 1.4))):
        w.part(f"/World/Balls/Ball{k}", "beach_ball", (x, 0, z), (0, 50 * k, 0), size)
    for k, (x, z, y, look) in enumerate(BALLOONS[:12]):
        w.part(f"/World/Balloons/B{k:02d}", "balloon", (1.7 * x, y + 0.9, 1.6 * z), (0, 0, 3 * (k % 5) - 6), 1.5, look)
    w.camera((0.5, 2.3, 4.6), (0, 1.05, 0), 34)
    w.room_lights(4.6, 0.16)


SHOWROOM_FLOOR = ((0.62, 0.6, 0.57), (0.5, 0.48, 0.46))


def _car_body(w: Writer) -> None:
    """A car's body as one subdivided mesh in a show room; bonnet, cabin and wheel arches are convex and concave pieces."""
    d = w.detail
    half, high = 7.0, 4.2
    floor = checked_sheet((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), 28, 28, SHOWROOM_FLOOR, d)
    w.mesh("/World/Room/Floor", floor)
    looks = ("Red", "Cream", "Teal", "Orange", "White", "Navy", "Lemon", "Sage", "Coral", "SkyBlue", "Purple", "Leaf")
    for side, turn in enumerate((0, 90, 180, 270)):
        for k in range(7):
            x, z = corner(-half + 1.0 + 2.0 * k, -half, turn)
            look = looks[(5 * side + 3 * k) % 12]
            w.cube(
                f"/World/Room/Panel{side}{k}", (x, 0, z), (1.9, 2.4 + 0.4 * ((k + side) % 3), 0.1), look, (0, turn, 0)
            )
        wall = sheet((-half, 0, -half - 0.06), (2 * half, 0, 0), (0, high, 0), d.count(8), d.count(4))
        w.mesh(f"/World/Room/Wall{side}", wall.moved(rotate=(0, turn, 0)), "Plaster")
    w.mesh(
        "/World/Room/Ceiling",
        sheet((-half, high, -half), (2 * half, 0, 0), (0, 0, 2 * half), d.count(8), d.count(8)),
        "Navy",
    )
    for k in range(5):
        w.cube(f"/World/Room/Strip{k}", (-4.4 + 2.2 * k, high - 0.1, 0), (0.35, 0.06, 9.0), "Lamp")
    table = revolve([2.8, 2.75, 2.3, 1.6, 0.0], [0.002, 0.04, 0.04, 0.04, 0.04], d.count(64))
    around = np.arange(len(table.counts)) % d.count(64) * 32 // d.count(64) % 2
    span = np.arange(len(table.counts)) // d.count(64)
    colors = np.where(span == 1, around, np.where(span == 2, 2, 3))
    palette = ((0.7, 0.1, 0.06), (0.75, 0.72, 0.66), (0.1, 0.14, 0.2), (0.3, 0.36, 0.42))
    w.mesh("/World/Turntable", replace(table, normals=None).painted(palette, colors))
    lift = 0.045
    w.part("/World/Car", "car_shell", (0, lift, 0), look="Chrome", instance=False)
    for k, (x, z) in enumerate(((-0.74, 1.36), (0.74, 1.36), (-0.74, -1.34), (0.74, -1.34))):
        place = (x, lift + 0.33 - 0.11, z)
        w.cylinder(f"/World/Wheels/Tyre{k}", place, 0.33, 0.22, "Rubber", (0, 0, 90))
        hub = (x + 0.06 * np.sign(x), lift + 0.33 - 0.06, z)
        w.cylinder(f"/World/Wheels/Hub{k}", hub, 0.2, 0.12, "Steel", (0, 0, 90))
    for k, x in enumerate((-0.58, 0.58)):
        w.sphere(f"/World/Lights/Head{k}", (x, lift + 0.56, 2.13), (0.12, 0.07, 0.05), "Lamp")
        w.sphere(f"/World/Lights/Tail{k}", (x, lift + 0.68, -2.12), (0.14, 0.06, 0.05), "Red")
    things = (
        ("pawn", 0.6, 4.3, 0, 3.6, "Coral"),
        ("pawn", -2.6, 3.0, 0, 3.9, "SkyBlue"),
        ("pawn", 5.2, 0.9, 0, 4.2, "Lemon"),
        ("plant", 3.4, -2.2, 0, 5.0, None),
        ("plant", -3.4, -2.0, 0, 5.0, None),
        ("beach_ball", 3.3, -0.6, 40, 1.7, None),
        ("ring_tower", -1.9, 4.0, 0, 1.8, None),
    )
    for k, (name, x, z, turn, size, look) in enumerate(things):
        w.part(f"/World/Things/T{k}", name, (x, 0, z), (0, turn, 0), size, look)
    w.camera((4.05, 1.8, 5.2), (0.05, 0.6, 0.1), 25.5)
    w.room_lights(3.8, 0.3)


def _facing_mirrors(w: Writer) -> None:
    """Two flat mirrors that face each other, a sphere and toys between them: a row of images that never ends."""
    arena(w, 6.0, 24)
    for name, z, turn in (("Near", 2.6, -90), ("Far", -2.6, 90)):
        pane = sheet((-1.7, 0, 1.3), (3.4, 0, 0), (0, 0, -2.6), w.detail.count(1), w.detail.count(1))
        mirror = w.mesh(f"/World/{name}", pane, "Chrome", digits=MIRROR_DIGITS)
        w.transform(mirror, (0, 1.4, z), (turn, 0, 0))
    w.sphere("/World/Sphere", (-0.75, 0.45, -0.6), 0.4, "Chrome")
    boxes(
        w,
        (0.55, -0.9, 0.4, 0.9, 20, "Red"),
        (0.95, 0.6, 0.35, 0.35, 50, "Orange"),
        (-0.4, 0.9, 0.3, 0.3, 10, "Green"),
        (0.1, -1.7, 0.3, 1.3, 35, "SkyBlue"),
    )
    w.camera((0.42, 1.35, 2.3), (-0.05, 0.95, -2.6), 46)
    w.lights()


CURVED_SCENES = {
    "facing_mirrors": Recipe(
        _facing_mirrors,
        "Two flat mirrors that face each other, with a sphere between them",
        ("/World/Far", "/World/Near", "/World/Sphere"),
        techniques=("planar", "quadric", "reflector_map", "raytraced"),
    ),
    "toy_room": Recipe(
        _toy_room,
        "Sphere, ellipsoid, cylinder, cone and paraboloid among toys; after Lages Miguel et al. 2014, figure 4",
        ("/World/Sphere", "/World/Ellipsoid", "/World/Cone", "/World/Cylinder", "/World/Paraboloid"),
        # The joints of its tiles are narrower than a pixel of a small picture: measured 0.9983 at 160x90 (reflector_map;
        # 7 of 4,067 pixels, each on the other face of a joint), 0.9996 at 640x360.
        min_identical=0.998,
    ),
    "corridor": Recipe(
        _corridor,
        "Quadric mirrors in a lit hall of columns; after Lages Miguel et al. 2014, figure 4",
        ("/World/Sphere", "/World/Ellipsoid", "/World/Cone", "/World/Cylinder", "/World/Paraboloid"),
    ),
    "shaving_mirror": Recipe(
        _shaving_mirror,
        "A concave spherical cap: near things upright and large, far ones upside down",
        ("/World/Mirror",),
    ),
    "torus": Recipe(
        _torus,
        "A torus among coloured things: saddles and a hole, and it sees itself",
        ("/World/Torus",),
        techniques=("reflector_map", "raytraced"),
    ),
    "car_body": Recipe(
        _car_body,
        "A car body as one subdivided mesh, neither convex nor star-shaped",
        ("/World/Car/Body",),
        techniques=("reflector_map", "raytraced"),
    ),
}
