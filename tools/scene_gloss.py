"""Scenes of mirrors that are not perfectly sharp: polished and brushed metal, and a clear coat over a rough base."""

from __future__ import annotations

import numpy as np
from scene_sets import arena, boxes, corner
from scene_shapes import sheet
from scene_writer import Recipe, Writer

POLISHES = 7  # roughness 0.0, 0.1, ... 0.6
SHOWN = 4  # of them are mirrors by default (`reflector_max_roughness` 0.3)


def _polished_spheres(w: Writer) -> None:
    """A row of silver balls, from a mirror to brushed metal."""
    arena(w, 7.0, 28)
    for k in range(POLISHES):
        x = 0.92 * (k - (POLISHES - 1) / 2)
        w.sphere(f"/World/Sphere{k}", (x, 0.445, 0.25 * abs(k - 3) - 0.4), 0.44, f"Polished{k}")
    boxes(
        w,
        (-1.8, 1.6, 0.3, 0.3, 15, "Red"),
        (-0.7, 1.5, 0.3, 0.3, 40, "Orange"),
        (0.9, 1.6, 0.3, 0.45, 65, "Green"),
        (1.85, 1.6, 0.3, 0.3, 20, "SkyBlue"),
    )
    w.camera((0.0, 1.45, 6.0), (0.0, 0.5, 0.0), 33)
    w.lights()


def _coated_car(w: Writer) -> None:
    """A car in metallic paint: a rough base below a smooth clear coat."""
    d, half, high = w.detail, 6.0, 4.0
    arena(w, half, 24)
    looks = ("Cream", "Teal", "Orange", "Navy", "Lemon", "Sage", "Coral", "SkyBlue")
    for side, turn in enumerate((0, 90, 180, 270)):
        for k in range(4):
            x, z = corner(-half + 1.5 + 3.0 * k, -half, turn)
            size = (2.4, 1.6 + 0.5 * ((k + side) % 3), 0.1)
            w.cube(f"/World/Room/Panel{side}{k}", (x, 0, z), size, looks[(3 * side + k) % 8], (0, turn, 0))
    lid = sheet((-half, high, -half), (2 * half, 0, 0), (0, 0, 2 * half), d.count(4), d.count(4))
    w.mesh("/World/Room/Ceiling", lid, "Plaster")
    for k in range(4):
        w.cube(f"/World/Room/Strip{k}", (-3.3 + 2.2 * k, high - 0.1, 0), (0.35, 0.06, 8.0), "Lamp")
    w.part("/World/Car", "car_shell", (0, 0.02, 0), look="CarPaint", instance=False)
    for k, (x, z) in enumerate(((-0.74, 1.36), (0.74, 1.36), (-0.74, -1.34), (0.74, -1.34))):
        w.cylinder(f"/World/Wheels/Tyre{k}", (x, 0.24, z), 0.33, 0.22, "Rubber", (0, 0, 90))
        w.cylinder(f"/World/Wheels/Hub{k}", (x + 0.06 * np.sign(x), 0.29, z), 0.2, 0.12, "Steel", (0, 0, 90))
    w.camera((3.5, 1.7, 4.3), (0.05, 0.6, 0.1), 30)
    w.room_lights(3.6, 0.3)


GLOSS_SCENES = {
    "polished_spheres": Recipe(
        _polished_spheres,
        "Silver balls of roughness 0 to 0.6 in a row",
        tuple(f"/World/Sphere{k}" for k in range(SHOWN)),
    ),
    "coated_car": Recipe(
        _coated_car,
        "A car body in metallic paint under a clear coat",
        ("/World/Car/Body",),
        techniques=("reflector_map", "raytraced"),
    ),
}
