"""Makes `oracle_table.csv`: reflection points of hard cases with 40 digits, and how much rounding moves them.

Run from a checkout: `python tests/hard_cases/make_oracle_table.py`. Shares nothing with the package: a point R of the
surface and an incidence are chosen, eye and point follow, both are rounded to float32, and the stationary point of the
path length next to R is found anew by mpmath. The last column is its relative condition: by how much R moves, in units
of the larger of the surface and |R|, for a relative change of eye and point.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import mpmath
import numpy as np

TABLE = Path(__file__).with_name("oracle_table.csv")
COLUMNS = "family side lx ly lz b c ex ey ez px py pz rx ry rz condition".split()
DIGITS = 40
STEP = mpmath.mpf("1e-14")  # of a coordinate, for differences; the square of it is far above the last digit

SPHERE = (1, 1, 1, 0, -1)
# Half axes 1 : 1/a : 1/b.
NEEDLE = {aspect: (1, aspect**2, aspect**2, 0, -1) for aspect in (100, 1000, 10_000)}
DISC = {aspect: (1, 1, aspect**2, 0, -1) for aspect in (100, 1000, 10_000)}
PARABOLOID = (0.5, 0.5, 0, -0.5, 0)
SHEETS = (1, 1, -1, 0, 1)


def value_and_gradient(surface, x):
    lx, ly, lz, b, c = surface
    value = lx * x[0] ** 2 + ly * x[1] ** 2 + lz * x[2] ** 2 + 2 * b * x[2] + c
    return value, [lx * x[0], ly * x[1], lz * x[2] + b]


def stationary(surface, eye, point, start):
    """The point near `start` where the path length is stationary, as mpmath numbers."""

    def equations(*unknown):
        x, multiplier = unknown[:3], unknown[3]
        to_eye, to_point = [a - b for a, b in zip(eye, x, strict=True)], [a - b for a, b in zip(point, x, strict=True)]
        length_eye, length_point = mpmath.norm(to_eye), mpmath.norm(to_point)
        value, gradient = value_and_gradient(surface, x)
        half = [a / length_eye + b / length_point for a, b in zip(to_eye, to_point, strict=True)]
        return [h - multiplier * g for h, g in zip(half, gradient, strict=True)] + [value]

    _, gradient = value_and_gradient(surface, start)
    half = equations(*start, mpmath.mpf(0))[:3]
    first = sum(h * g for h, g in zip(half, gradient, strict=True)) / sum(g * g for g in gradient)
    return list(mpmath.findroot(equations, [*start, first], tol=mpmath.mpf("1e-64"), maxsteps=60))[:3]


def row(family: str, side: int, surface, eye, point, start) -> list | None:
    """One line of the table; None where the stationary point ran away from where it was meant to be."""
    eye, point = np.float32(eye).astype(float), np.float32(point).astype(float)
    with mpmath.workdps(DIGITS):
        ends = [mpmath.mpf(float(v)) for v in (*eye, *point)]
        start = [mpmath.mpf(float(v)) for v in start]
        exact = [mpmath.mpf(repr(float(v))) for v in surface]
        try:
            r = stationary(exact, ends[:3], ends[3:], start)
            condition = mpmath.mpf(0)
            for k in range(6):
                reach = max(abs(v) for v in ends[3 * (k // 3) : 3 * (k // 3) + 3])
                moved = list(ends)
                moved[k] += STEP * reach
                other = stationary(exact, moved[:3], moved[3:], r)
                condition += mpmath.norm([a - b for a, b in zip(other, r, strict=True)]) / STEP
        except (ValueError, ZeroDivisionError):
            return None
        scale = max(mpmath.mpf(1), mpmath.norm(r))
        if mpmath.norm([a - b for a, b in zip(r, start, strict=True)]) > scale / 10:
            return None
        condition /= scale
        return [family, side, *surface, *map(repr, map(float, (*ends, *r))), f"{float(condition):.6g}"]


def around(surface, r, side: int, degrees: float, turn: float, eye_distance: float, point_distance: float):
    """Eye and point that the surface reflects into each other at r."""
    _, gradient = value_and_gradient(surface, r)
    n = side * np.array(gradient, float)
    n /= np.linalg.norm(n)
    t = np.cross(n, [0.3, -0.5, 0.8])
    t /= np.linalg.norm(t)
    t = np.cos(turn) * t + np.sin(turn) * np.cross(n, t)
    o = np.cos(np.radians(degrees)) * n + np.sin(np.radians(degrees)) * t
    v = 2 * (o @ n) * n - o
    return r + eye_distance * o, r + point_distance * v


def on_surface(surface, direction) -> np.ndarray:
    """The point of a surface in a direction: of an ellipsoid radially, of the others above (x, y)."""
    lx, ly, lz, b, c = surface
    d = np.array(direction, float)
    if lz > 0:
        return d / np.sqrt(lx * d[0] ** 2 + ly * d[1] ** 2 + lz * d[2] ** 2)
    level = lx * d[0] ** 2 + ly * d[1] ** 2 + c
    return np.array([d[0], d[1], -level / (2 * b) if b else np.sqrt(level / -lz)])


def cases() -> Iterator[tuple]:
    side_view = (0.4, 0.7, 0.59)
    for surface in (SPHERE, (1, 9, 9, 0, -1), PARABOLOID, SHEETS):
        for degrees in (85.0, 88.0, 89.0, 89.5):
            r = on_surface(surface, side_view)
            yield "near-silhouette", 1, surface, *around(surface, r, 1, degrees, 0.7, 2.0, 3.0), r
    for aspects in (NEEDLE, DISC):
        for surface in aspects.values():
            for direction in ((1, 1e-4, 1e-4), (1, 0.3, 0.3), (0.2, 1, 1), (1, 1, 1e-3)):
                r = on_surface(surface, direction)
                yield "aspect", 1, surface, *around(surface, r, 1, 40.0, 1.1, 0.7, 1.3), r
    for height in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6):
        for surface in (SPHERE, (1, 9, 9, 0, -1)):
            r = on_surface(surface, side_view)
            yield "point-near-surface", 1, surface, *around(surface, r, 1, 30.0, 0.2, 2.0, height), r
            yield "eye-near-surface", 1, surface, *around(surface, r, 1, 30.0, 0.2, height, 2.0), r
    for distance in (1e2, 1e4, 1e6, 1e8):
        for surface in (SPHERE, (1, 9, 9, 0, -1), DISC[100]):
            r = on_surface(surface, side_view)
            yield "far-point", 1, surface, *around(surface, r, 1, 50.0, 0.2, 2.0, distance), r
            yield "far-eye", 1, surface, *around(surface, r, 1, 50.0, 0.2, distance, 2.0), r
    for apart in (1e-1, 1e-3, 1e-5, 1e-6):
        for surface in (SPHERE, DISC[100]):
            r = on_surface(surface, side_view)
            eye, point = around(surface, r, 1, np.degrees(apart), 0.2, 2.0, 2.0)
            yield "eye-near-point", 1, surface, eye, point, r
            yield (
                "near-axis",
                1,
                surface,
                *around(surface, on_surface(surface, (apart, 0, 1)), 1, apart, 0.2, 2.0, 5.0),
                (on_surface(surface, (apart, 0, 1))),
            )
    # From one focus to near the other: at the focus itself every point of the ellipsoid reflects.
    ellipsoid = (1, 4, 4, 0, -1)
    focus = np.sqrt(0.75)
    for off in (1e-1, 1e-2, 1e-3, 1e-4):
        eye = np.array([focus, 0.0, 0.0])
        # What is left of the choice is made by the offset: R lies right above and below the second focus.
        for above in (0.25, -0.25):
            yield "near-focus", -1, ellipsoid, eye, np.array([-focus, 0.0, off]), np.array([-focus, 0.0, above])
    # Along the normal past the centre of curvature of a hollow sphere two roots merge: (1/a + 1/b) / 2 = cos / R.
    for gap in (1e-1, 1e-2, 1e-3, 1e-4):
        r = on_surface(SPHERE, side_view)
        a = 0.8
        b = 1.0 / (2.0 / np.cos(np.radians(20.0)) - 1.0 / a)
        eye, point = around(SPHERE, r, -1, 20.0, 0.4, a, b * (1.0 - gap))
        yield "near-caustic", -1, SPHERE, eye, point, r


def main() -> None:
    rows = [found for case in cases() if (found := row(*case)) is not None]
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(rows)
    print(f"{TABLE.name}: {len(rows)} rows")


if __name__ == "__main__":
    main()
