"""Random hard inputs through the public calls: what comes out, and how exact, as a Markdown table.

    python tools/stability_report.py [--cases 1000000] [--seed 0]

Every kind of mirror, both sides and precisions; sizes over twelve decades, offsets up to 10,000 sizes; points far and
near, on the surface and beside it by 1e-7, on the eye, on the axes, over sixteen decades, not finite. Nothing that
comes out may be NaN or infinite. What comes out as found is judged by the two equations it must fulfil, in float64 and
without the package: it lies on the surface, and the normal there halves the angle between eye and point. Both errors
are given in what the rounding of the reported point explains.

A tenth of the inputs each goes to all roots of quadrics (judged likewise) with their derivatives, to refraction, to rays
in heightfields and grids of cells, and to whole frames: small pictures of small stages by every technique, from within
mirrors, beside their surface, from far away, through lenses of any length, with motion from the frame before. Of these the
values must be finite and every answer have a status.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect.channels import CHANNELS
from warp_reflect.heightfield import make_heightfield, trace_heightfield
from warp_reflect.occupancy import make_occupancy, trace_occupancy
from warp_reflect.settings import Status
from warp_reflect.solver_gradients import solve_gradients
from warp_reflect.techniques import TECHNIQUES

# Unit-frame surfaces lx x^2 + ly y^2 + lz z^2 + 2 b z + c = 0.
SURFACES = {
    "sphere": (1, 1, 1, 0, -1),
    "ellipsoid 3:1:1": (1, 9, 9, 0, -1),
    "ellipsoid 100:10:1": (1, 100, 1e4, 0, -1),
    "disc 1000:1000:1": (1, 1, 1e6, 0, -1),
    "needle 1000:1:1": (1, 1e6, 1e6, 0, -1),
    "elliptic cylinder": (1, 4, 0, 0, -1),
    "paraboloid": (0.5, 0.5, 0, -0.5, 0),
    "elliptic paraboloid": (0.5, 2.0, 0, -0.5, 0),
    "parabolic cylinder": (0.5, 0, 0, -0.5, 0),
    "two sheets": (1, 1, -1, 0, 1),
    "hyperbolic cylinder": (1, 0, -2, 0, 1),
    "cone": (1, 1, -1, 0, 0),
    "one sheet": (1, 2, -1, 0, -1),
    "saddle": (0.5, -0.7, 0, -0.5, 0),
}
OFFSET_MAX = 1.0e4  # sizes
SHARE = 0.1  # of the cases, of each kind of call beside `solve` for one root
# What is looked through: index of refraction, and the surface; None: a plane.
REFRACTED = {
    "water": (1.33, None),
    "glass ball": (1.5, "sphere"),
    "glass ellipsoid": (1.5, "ellipsoid 3:1:1"),
    "diamond lens": (2.4, "ellipsoid 100:10:1"),
    "bubble": (0.75, "sphere"),
}
SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
STAGES = ("sphere_on_checker", "two_spheres", "ellipsoid_row", "open_bowl", "capped_cylinder", "torus", "far_offset")
FRAME_SIZE = (64, 36)
FRAME_KNOBS = {
    "refine": ("exact", "strict", "off"),
    "search": ("newton", "midpoint"),
    "occlusion": ("exact", "painter"),
    "grid_share": (0.0, 0.0, 0.05),
    "grid_error_px": (0.0, 0.0, 0.5),
    "reuse_px": (0.0, 0.5),
    "edge_px": (0.0, 0.25),
    "shadows": ("auto", "on"),
}
EYES, POINTS = 4, 250  # a batch: one mirror in one place
EMPTY = (Status.HIDDEN, Status.UNREFLECTED, Status.DEGENERATE, Status.INSIDE, Status.BAD_INPUT)


@dataclass
class Family:
    """What became of one kind of mirror.

    Attributes:
        cases: Pairs of eye and point, rays, or pixels.
        not_finite: Values that came out NaN or infinite.
        untold: Pairs without a status, or with values where the status says there are none.
        surface: Largest distance of a CONVERGED point from the surface, in roundings of its coordinates.
        law: Largest angle between half vector and normal there, in what a rounding of the point explains.
        silent: CONVERGED pairs whose law error exceeds 100 of those.
        statuses: How often each came out.
    """

    name: str
    cases: int = 0
    not_finite: int = 0
    untold: int = 0
    surface: float = 0.0
    law: float = 0.0
    silent: int = 0
    statuses: Counter = field(default_factory=Counter)


def main() -> int:
    """Print the table; 1 if anything that is not finite came out."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = wp.LOG_WARNING
    else:
        wp.config.quiet = True
    start = time.process_time()
    families = report(arguments.cases, arguments.seed)
    print(table(families))
    bad = sum(each.not_finite + each.untold for each in families)
    total = sum(each.cases for each in families)
    print(f"\n{total} cases, {bad} values that are not finite or not told, {time.process_time() - start:.0f} s of CPU")
    return 1 if bad else 0


def report(cases: int, seed: int = 0) -> list[Family]:
    """At least `cases` inputs, shared evenly by all families of a kind."""
    rng = np.random.default_rng(seed)
    names = [(name, side) for name in (*SURFACES, "plane", "plane with an extent") for side in ("outer", "inner")]
    names += [("reflector map of an ellipsoid", "outer")]
    batches = [
        (f"{name}, {side}, {np.dtype(dtype).name}", partial(_one_batch, name=name, side=side, dtype=dtype))
        for name, side in names
        for dtype in (np.float32, np.float64)
    ]
    rooted = [(name, side) for name, side in names if name in SURFACES]
    roots = [
        (f"{name}, {side}, all roots", partial(_one_batch, name=name, side=side, dtype=np.float64, all_roots=True))
        for name, side in rooted
    ]
    refracted = [
        (f"refraction, {name}, {np.dtype(dtype).name}", partial(_refraction_batch, name=name, dtype=dtype))
        for name in REFRACTED
        for dtype in (np.float32, np.float64)
    ]
    rays = [(f"rays, {name}", partial(_ray_batch, name=name)) for name in ("heightfield", "grid of cells")]
    views = Views()
    frames = [
        (f"frames, {method}", partial(_frame_batch, views=views, method=method)) for method in (*TECHNIQUES, "auto")
    ]
    families = []
    for group, share in (
        (batches, 1.0 - 4 * SHARE),
        (roots, SHARE),
        (refracted, SHARE),
        (rays, SHARE),
        (frames, SHARE),
    ):
        for name, batch in group:
            family = Family(name)
            while family.cases * len(group) < share * cases:
                batch(family, rng=rng)
            families.append(family)
    return families


def table(families: list[Family]) -> str:
    """The families as Markdown."""
    lines = [
        "| family | cases | not finite | worst distance [roundings] | worst angle [roundings] | silent | statuses |",
        "|---|---|---|---|---|---|---|",
    ]
    for each in families:
        counts = ", ".join(f"{Status(status).name} {count}" for status, count in each.statuses.most_common())
        lines.append(
            f"| {each.name} | {each.cases} | {each.not_finite} | {each.surface:.3g} | {each.law:.3g} | {each.silent} | {counts} |"
        )
    return "\n".join(lines)


def _one_batch(family: Family, name: str, side: str, dtype, rng: np.random.Generator, all_roots: bool = False) -> None:
    q = _matrix(name)
    pose = _pose(10.0 ** rng.uniform(-6, 6), _farthest(name, q), rng)
    eyes, world = _hard_ends(q, side, pose, dtype, rng)
    mirror = _mirror(name, side, pose, q)
    solution = wr.solve(mirror, eyes, world, all_roots=all_roots)
    outputs = [np.asarray(a) for a in (solution.point, solution.normal, solution.virtual, solution.residual)]
    empty = np.isin(solution.status, EMPTY)
    _count(family, solution.status, outputs, empty)
    point, found = outputs[0], solution.status == Status.CONVERGED
    if all_roots:
        k = solution.roots.shape[-2]
        _count_values(family, (solution.roots, solution.root_length))
        padding = np.arange(k) >= solution.root_count[..., None]
        family.untold += int((padding != (solution.root_status == Status.NONE)).sum())
        _count_values(family, vars(solve_gradients(mirror, eyes, world, solution)).values())
        point, found = solution.roots, solution.root_status == Status.CONVERGED
    if not found.any() or name.startswith("reflector map"):  # a map has the accuracy of its texels
        return
    rows, columns = np.nonzero(found)[:2]
    by_matrix = isinstance(mirror, wr.QuadricMirror) and not _is_rotational(q)
    distance, law = _errors(
        q,
        pose,
        1.0 if side == "outer" else -1.0,
        eyes[rows],
        world[columns].astype(np.float64),
        point[found],
        dtype,
        by_matrix,
    )
    family.surface = max(family.surface, float(distance.max()))
    family.law = max(family.law, float(law.max()))
    family.silent += int((law > 100.0).sum())


def _count(family: Family, status: np.ndarray, values: Iterable[np.ndarray], empty: np.ndarray) -> None:
    """Take statuses and values into account; where `empty` the values must be 0."""
    family.cases += status.size
    _count_values(family, values)
    family.untold += int((status == Status.NONE).sum()) + sum(int(a[empty].any()) for a in values)
    family.statuses.update(int(s) for s in status.ravel())


def _count_values(family: Family, values: Iterable[np.ndarray]) -> None:
    family.not_finite += sum(int(np.count_nonzero(~np.isfinite(a))) for a in values)


def _hard_ends(q, side: str, pose: np.ndarray, dtype, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eyes and points in world space, some of either not finite."""
    eyes, points = _ends(q, side, rng)
    bad = ~np.isfinite(points).all(axis=1)
    world = _moved(pose, np.where(bad[:, None], 0.0, points))
    world[bad] = points[bad]
    eyes = _moved(pose, eyes)
    if rng.random() < 0.2:
        eyes[rng.integers(len(eyes))] = rng.choice([np.nan, np.inf, -np.inf, 0.0], 3)
    return eyes, world.astype(dtype)


def _refraction_batch(family: Family, name: str, dtype, rng: np.random.Generator) -> None:
    ior, shape = REFRACTED[name]
    q = _matrix("plane" if shape is None else shape)
    pose = _pose(10.0 ** rng.uniform(-6, 6), _farthest(shape or "plane", q), rng)
    eyes, world = _hard_ends(q, "outer" if rng.random() < 0.7 else "inner", pose, dtype, rng)
    found = wr.refract(_mirror(shape or "plane", "outer", pose, q), eyes, world, ior)
    values = [np.asarray(value) for name, value in vars(found).items() if name != "status"]
    _count(family, found.status, values, np.isin(found.status, EMPTY))


def _ray_batch(family: Family, name: str, rng: np.random.Generator) -> None:
    side = int(rng.choice([1, 2, 7, 64]))
    cell, corner = 10.0 ** rng.uniform(-4, 4), rng.normal(size=3) * rng.choice([0.0, 1.0, 1.0e7])
    levels = rng.integers(0, 6, (side, side + 1)) * cell * rng.choice([0.5, 1.0])
    if name == "heightfield":
        levels[rng.random(levels.shape) < 0.1] = rng.choice([np.nan, np.inf, -np.inf])
        field, trace = make_heightfield(levels, cell, corner), trace_heightfield
    else:
        shape = (side + 1, side, 5)
        solid = np.argwhere(rng.random(shape) < rng.choice([0.02, 0.3, 1.0]))
        field, trace = make_occupancy(solid, None, shape, cell, corner), trace_occupancy
    # Along axes and diagonals, on borders and corners of columns, at their heights, and anywhere.
    count = EYES * POINTS
    origins = rng.uniform(-1.0, side + 2.0, (count, 3)) * cell
    snapped = rng.random((count, 3)) < 0.5
    origins[snapped] = np.round(origins[snapped] / cell) * cell
    directions = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-38, 30, (count, 1))
    directions[rng.random((count, 3)) < 0.3] = rng.choice([0.0, -0.0, 1.0e-30])
    diagonal = rng.random(count) < 0.2
    directions[diagonal] = rng.choice([-1.0, 0.0, 1.0], (int(diagonal.sum()), 3))
    for each in (origins, directions):
        each[rng.random(count) < 0.02, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    found = trace(field, corner + origins, directions, walk=str(rng.choice(["hierarchy", "cells"])))
    status = found.status.numpy()
    _count(family, status, [found.t.numpy(), found.normal.numpy()], np.isin(status, [*EMPTY, Status.SKY]))
    limit = int((status == Status.STEP_LIMIT).sum())
    family.untold += limit  # a bound that no ray needs


class Views:
    """Stages, read at first use, and hard views of them."""

    def __init__(self) -> None:
        self._scenes: dict[str, wr.Scene] = {}

    def draw(self, rng: np.random.Generator) -> tuple[wr.Scene, wr.Camera]:
        """A stage, and a camera that stands anywhere and looks at or away from a mirror."""
        name = str(rng.choice(STAGES))
        if name not in self._scenes:
            self._scenes[name] = wr.load_stage(str(SCENES / f"{name}.usda"))
        scene = self._scenes[name]
        plan = wr.make_plan(scene, size=FRAME_SIZE)
        part = scene.parts[rng.choice([row.reflector.part for row in plan.rows])]
        own = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
        corner = scene.host_points[own[rng.integers(len(own)), 0]].astype(np.float64)
        middle = scene.host_points[np.unique(own)].astype(np.float64).mean(axis=0)
        size = float(np.linalg.norm(corner - middle)) or 1.0
        outwards = (corner - middle) / size + 0.3 * rng.normal(size=3)
        share = rng.choice([0.0, 0.5, 1.0, 1.0 + 1e-7, 1.0 + 1e-3, 1.5, 3.0, 30.0, 1e4, 1e7])
        eye = middle + share * (corner - middle) if share <= 1.01 else middle + share * size * outwards
        forward = middle - eye if rng.random() < 0.7 else rng.normal(size=3)
        forward = (
            forward / (np.linalg.norm(forward) or 1.0) if np.linalg.norm(forward) > 0.0 else np.array([0.0, 0, -1])
        )
        right = np.cross(forward, rng.normal(size=3))
        right /= np.linalg.norm(right)
        width, height = FRAME_SIZE
        focal = width * 10.0 ** rng.uniform(-1.5, 3.0)
        near = size * 10.0 ** rng.uniform(-6, 0)
        camera = dataclasses.replace(
            plan.camera,
            eye=scene.origin + eye,
            right=right,
            up=np.cross(right, forward),
            forward=forward,
            fx=focal,
            fy=focal * rng.choice([1.0, 1.5]),
            cx=0.5 * width + rng.choice([0.0, 0.3 * width]),
            cy=0.5 * height,
            near=near,
            far=near * 10.0 ** rng.uniform(1, 10),
            orthographic=bool(rng.random() < 0.15),
        )
        return scene, camera


def _frame_batch(family: Family, views: Views, method: str, rng: np.random.Generator) -> None:
    scene, camera = views.draw(rng)
    settings = {"few_pixels": 0, "map_resolution": 32, "environment_resolution": 16}
    for name, values in FRAME_KNOBS.items():
        settings[name] = rng.choice(values).item()
    if settings["refine"] != "off":
        settings["occlusion"] = "exact"
    plan = wr.make_plan(scene, camera, FRAME_SIZE, wr.Settings().replace(**settings), method)
    previous = wr.render_frame(scene, plan)
    step = dataclasses.replace(camera, eye=camera.eye + rng.normal(size=3) * 0.01 * camera.near)
    frame = wr.render_frame(scene, plan, camera=step, previous=previous)
    status = frame["status"].astype(int)
    mirror = frame["reflectorId"] > 0
    family.cases += status.size
    _count_values(family, [frame[name] for name in CHANNELS])
    seen = np.isin(frame["reflectorId"], list(frame.layers))
    family.untold += int((mirror & seen & (status == Status.NONE)).sum() + (~mirror & (status != Status.NONE)).sum())
    family.statuses.update(int(s) for s in status.ravel())


def _matrix(name: str) -> np.ndarray:
    """Of a plane: z = 0, the normal towards +z; of what has no matrix here: a sphere."""
    lx, ly, lz, b, c = (
        (0, 0, 0, 0.5, 0) if name.startswith("plane") else SURFACES.get(name, SURFACES["ellipsoid 3:1:1"])
    )
    q = np.diag([lx, ly, lz, c]).astype(np.float64)
    q[2, 3] = q[3, 2] = b
    return q


def _mirror(name: str, side: str, pose: np.ndarray, q: np.ndarray):
    if name.startswith("plane"):
        size = np.linalg.norm(pose[:3, 0])
        extent = (3.0 * size, 2.0 * size) if name != "plane" else None
        return wr.PlanarMirror(pose[:3, 3], pose[:3, 2], extent=extent, up=pose[:3, 1], side=side)
    if name.startswith("reflector map"):
        return _map(pose)
    back = np.linalg.inv(pose)
    # Placed by its map, not by a matrix in world space, whose constant term loses the square of the offset.
    lx = q[0, 0]
    if _is_rotational(q):
        return wr.QuadricMirror.rotational(
            q[2, 2] / lx, 2.0 * q[2, 3] / lx, -q[3, 3] / lx, world_from_object=pose, side=side
        )
    return wr.QuadricMirror.from_matrix(back.T @ q @ back, side=side)


def _is_rotational(q: np.ndarray) -> bool:
    return q[0, 0] == q[1, 1] > 0.0


def _map(pose: np.ndarray):
    rows, columns = 24, 48
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1)[1:-1], np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    ring = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    points = np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]]) * [1.0, 1 / 3, 1 / 3]
    i = np.arange((rows - 2) * columns)
    right = i // columns * columns + (i + 1) % columns
    around = np.arange(columns)
    last = (rows - 2) * columns
    faces = [
        np.stack([i, i + columns, right], 1),
        np.stack([right, i + columns, right + columns], 1),
        np.stack([np.full(columns, len(ring)), around, (around + 1) % columns], 1),
        np.stack([np.full(columns, len(ring) + 1), last + (around + 1) % columns, last + around], 1),
    ]
    return wr.ReflectorMap.from_mesh(_moved(pose, points), np.concatenate(faces).astype(np.int32), resolution=32)


def _farthest(name: str, q: np.ndarray) -> float:
    """Offset in sizes up to which float64 tells the mirror: a matrix in world space holds the square of it."""
    by_matrix = name in SURFACES and not _is_rotational(q)
    return min(OFFSET_MAX, 1e-3 / np.sqrt(np.finfo(float).eps * np.abs(q).max())) if by_matrix else OFFSET_MAX


def _pose(size: float, farthest: float, rng: np.random.Generator) -> np.ndarray:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn)) * size
    pose[:3, 3] = rng.normal(size=3) * size * rng.choice([0.0, 1.0, farthest ** rng.uniform(0, 1)])
    return pose


def _moved(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ pose[:3, :3].T + pose[:3, 3]


def _ends(q: np.ndarray, side: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Eyes mostly on the reflecting side, and points of every kind, in the unit frame."""
    tries = rng.normal(size=(40 * EYES, 3)) * 10.0 ** rng.uniform(-1, 1, (40 * EYES, 1))
    value = np.einsum("ni,ij,nj->n", _homogeneous(tries), q, _homogeneous(tries))
    before = tries[value > 0 if side == "outer" else value < 0]
    eyes = np.concatenate([before, tries])[:EYES].copy()
    points = rng.normal(size=(POINTS, 3)) * 10.0 ** rng.uniform(-1, 1.5, (POINTS, 1))
    kind = rng.random(POINTS)
    wild = kind < 0.15
    points[wild] = rng.choice([-1.0, 1.0], (wild.sum(), 3)) * 10.0 ** rng.uniform(-8, 8, (wild.sum(), 3))
    near = (kind >= 0.15) & (kind < 0.3)
    points[near] = _near_surface(q, points[near], rng)
    points[(kind >= 0.3) & (kind < 0.33)] = eyes[0]
    points[(kind >= 0.33) & (kind < 0.4)] *= rng.integers(0, 2, 3)
    lost = (kind >= 0.4) & (kind < 0.45)
    points[lost, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    return eyes, points


def _near_surface(q: np.ndarray, x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points moved to the surface by Newton's method along the gradient, then off it by 1e-9 to 1e-1."""
    for _ in range(30):
        gradient = x @ q[:3, :3] + q[:3, 3]
        value = np.einsum("ni,ij,nj->n", _homogeneous(x), q, _homogeneous(x))
        x = x - 0.5 * value[:, None] * gradient / np.maximum((gradient**2).sum(1, keepdims=True), 1e-30)
    return x + rng.normal(size=x.shape) * 10.0 ** rng.uniform(-9, -1, (len(x), 1))


def _homogeneous(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x, np.ones((len(x), 1))], axis=1)


def _errors(q, pose, side, eye, point, r, dtype, by_matrix) -> tuple[np.ndarray, np.ndarray]:
    """(distance from the surface, angle from the law), each over what a rounding of the reported R explains."""
    size = np.linalg.norm(pose[:3, 0])
    back = np.linalg.inv(pose)
    reach = np.abs(r).max(axis=1) + np.abs(pose[:3, 3]).max()
    double = np.finfo(float).eps
    # A rounding in the mirror's frame, of the output, and of the float64 map between world and that frame.
    rounding = np.finfo(dtype).eps / 2 * (1.0 + np.abs(r).max(axis=1) / size) + 8 * double * (1.0 + reach / size)
    x = _moved(back, r.astype(np.float64))
    o, v = _moved(back, eye) - x, _moved(back, point) - x
    gradient = side * (x @ q[:3, :3] + q[:3, 3])
    slope = np.linalg.norm(gradient, axis=1)
    value = np.einsum("ni,ij,nj->n", _homogeneous(x), q, _homogeneous(x))
    terms = np.einsum("ni,ij,nj->n", np.abs(_homogeneous(x)), np.abs(q), np.abs(_homogeneous(x)))
    safe = np.maximum(slope, 1e-300)
    # The largest entry of a matrix is rounded, and found again by its eigenvectors; given in world space, its constant
    # entry holds the square of the offset as well.
    offset = 1.0 + (np.linalg.norm(pose[:3, 3]) / size if by_matrix else 0.0)
    rounding = rounding + 8 * double * np.abs(q).max() * (offset + np.linalg.norm(x, axis=1)) ** 2 / safe
    distance = 0.5 * np.abs(value) / safe / (rounding + double * terms / safe)
    a, b = np.linalg.norm(o, axis=1), np.linalg.norm(v, axis=1)
    bend = np.linalg.norm(q[:3, :3], 2) / safe
    half = o / np.maximum(a, 1e-300)[:, None] + v / np.maximum(b, 1e-300)[:, None]
    n = gradient / safe[:, None]
    cosine = 0.5 * np.linalg.norm(half, axis=1)
    sine = np.linalg.norm(np.cross(half, n), axis=1) / np.maximum(2.0 * cosine, 1e-300)
    sine = np.where((half * n).sum(1) < 0.0, 1.0, sine)
    explained = rounding * (
        bend + (1.0 / np.maximum(a, 1e-300) + 1.0 / np.maximum(b, 1e-300)) / np.maximum(cosine, 1e-300)
    )
    # A point that touches the mirror, or the eye's own, has no direction that a rounding leaves.
    return distance, np.where(explained > 0.05, 0.0, sine / (explained + 4 * np.finfo(dtype).eps))


if __name__ == "__main__":
    sys.exit(main())
