"""Where tracing becomes cheaper than forward projection: triangles of the scene against pixels of the mirror.

    python tools/bench_crossing.py OUTDIR
    python tools/bench_crossing.py OUTDIR --triangles 1e4 1e5 1e6 1e7 --pixels 1e3 1e4 1e5 1e6 --method reflector_map

A ball that mirrors a closed room full of balls, made here, at every number of triangles and of mirror pixels: milliseconds of
the reflection pass with every ray traced and by forward projection (a frame that follows another, whose eye stood a step
aside; and the first), measured on this thread's own time and predicted by the cost model, and what the planner takes. A
cell counts as the planner counts it: one frame of ten starts from nothing (`budget.COLD_SHARE`).

Writes OUTDIR/crossing.json (one entry per cell, and the machine) and OUTDIR/crossing.png.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import commit, machine

from warp_reflect.budget import COLD_SHARE

TRIANGLES = (1.0e4, 3.0e4, 1.0e5, 3.0e5, 1.0e6)
PIXELS = (1.0e3, 1.0e4, 1.0e5, 1.0e6)
BALLS = 24  # beside the mirror; they hold half of the triangles, the walls the other half
MIRROR_ROWS = 24  # of the mirror's own facets, from pole to pole
HALF = 4.0  # of the room, in the mirror's radii
STEP = 0.004  # by which the eye moves between two frames, of its distance to the mirror
TRACED, FORWARD = "traced", "forward"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="OUTDIR")
    parser.add_argument("--triangles", nargs="+", type=float, default=TRIANGLES)
    parser.add_argument("--pixels", nargs="+", type=float, default=PIXELS)
    parser.add_argument("--method", default="quadric", help="the technique that projects")
    parser.add_argument("--rounds", type=int, default=3, help="timed frames of every kind, contenders in turn")
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    if min(*arguments.triangles, *arguments.pixels) < 100.0:
        parser.error(f"got {min(*arguments.triangles, *arguments.pixels):g} triangles or pixels, expected 100 or more")
    wp.config.log_level = wp.LOG_WARNING
    arguments.folder.mkdir(parents=True, exist_ok=True)
    cells = []
    for triangles in sorted(arguments.triangles):
        scene = room(int(triangles), arguments.device)
        for pixels in sorted(arguments.pixels):
            cells.append(cell(scene, pixels, arguments))
            print(line(cells[-1]), flush=True)
    told = {"machine": machine(), "warp": wp.__version__, "commit": commit(), "threads": 1, "method": arguments.method}
    told |= {"summary": summary(cells), "cells": cells}
    (arguments.folder / "crossing.json").write_text(json.dumps(told, indent=1))
    plot(cells, arguments.folder / "crossing.png", f"{told['machine']}, one thread, {arguments.method}")
    print(json.dumps(told["summary"]))


def room(triangles: int, device):
    """A scene of about so many triangles: a mirror ball in a closed room among balls."""
    from warp_reflect.scene import CameraData, InstanceData, MaterialData, Part, Patch, Scene, SceneData, Shape

    rows = max(round(math.sqrt(triangles / (2.0 * BALLS * 4.0))), 3)
    cells = max(round(math.sqrt(triangles / (2.0 * 6.0 * 2.0))), 1)
    mirror = ball(MIRROR_ROWS)
    patch = Patch(0, len(mirror.triangles), Shape("quadric", np.eye(4), 1.0, 0.0, 1.0))
    mirror = dataclasses.replace(mirror, parts=[Part(0, len(mirror.triangles), patches=(patch,))])
    instances = [InstanceData(0, np.eye(4), "/mirror", (0,))]
    for k in range(6):
        turned = np.eye(4)
        turned[:3, :3] = np.roll(np.eye(3), k // 2, axis=0)
        turned[:3, 3] = turned[:3, 2] * (HALF if k % 2 else -HALF)
        instances.append(InstanceData(1, turned, f"/wall{k}", (1,)))
    placing = np.random.default_rng(4)
    while len(instances) < 7 + BALLS:
        where = placing.uniform(-HALF + 0.5, HALF - 0.5, 3)
        # Neither in the mirror nor between it and the eye.
        if np.linalg.norm(where) > 1.8 and not (where[2] > 0.0 and np.hypot(*where[:2]) < 1.6):
            matrix = np.diag([0.45, 0.45, 0.45, 1.0])
            matrix[:3, 3] = where
            instances.append(InstanceData(2, matrix, f"/ball{len(instances)}", (1,)))
    eye = np.eye(4)
    eye[2, 3] = 3.6
    camera = CameraData(
        "/camera", eye, near=0.05, horizontal_aperture=20.955, vertical_aperture=20.955, focal_length=35.0
    )
    chrome = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
    meshes = [mirror, wall(cells), ball(rows)]
    return Scene(SceneData("room", meshes, instances, [chrome, MaterialData()], [], [camera]), device)


def ball(rows: int):
    """A unit sphere of 4 rows (rows - 1) triangles."""
    from warp_reflect.scene import MeshData

    columns = 2 * rows
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rows + 1), np.arange(columns) * np.pi / rows, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points[0], points[-1] = (0, 1, 0), (0, -1, 0)  # to the bit: the mirror is closed
    points = points.reshape(-1, 3)
    i = np.arange(rows * columns)
    a, b = i, i // columns * columns + (i + 1) % columns
    upper, lower = np.stack([a, b, a + columns], 1)[columns:], np.stack([b, b + columns, a + columns], 1)[:-columns]
    faces = np.concatenate([upper, lower]).astype(np.int32)
    return MeshData(points.astype(np.float32), faces, points.astype(np.float32))


def wall(cells: int):
    """A square of side 2 HALF in the plane z = 0, of 2 cells^2 triangles."""
    from warp_reflect.scene import MeshData

    line_of = np.linspace(-HALF, HALF, cells + 1)
    v, u = np.meshgrid(line_of, line_of, indexing="ij")
    points = np.stack([u, v, 0.0 * u], -1).reshape(-1, 3)
    i = np.arange(cells * cells)
    a = i // cells * (cells + 1) + i % cells
    above = a + cells + 1
    faces = np.concatenate([np.stack([a, a + 1, above], 1), np.stack([a + 1, above + 1, above], 1)])
    return MeshData(points.astype(np.float32), faces.astype(np.int32), double_sided=True)


def cell(scene, pixels: float, arguments) -> dict:
    """Times of both ways at one size of the picture."""
    import warp_reflect as wr
    from warp_reflect.timing import counted_by

    base = wr.Settings(threads=1, keep_static=False, shadows="off")
    # What share of a square picture the mirror fills.
    probe = wr.make_plan(scene, size=(200, 200), settings=base, method="reference")
    side = max(round(200.0 * math.sqrt(pixels / probe.rows[0].pixels)), 8)
    size = side, side
    methods = {TRACED: "reference", FORWARD: arguments.method}
    plans = {name: wr.make_plan(scene, size=size, settings=base, method=method) for name, method in methods.items()}
    chosen = wr.make_plan(scene, size=size, settings=base).rows[0]
    clock = time.perf_counter if wp.get_device(arguments.device).is_cuda else time.thread_time
    first: dict[str, list[float]] = {name: [] for name in plans}
    next_: dict[str, list[float]] = {name: [] for name in plans}
    with counted_by(clock):
        for round_ in range(arguments.rounds + 1):
            for name, plan in plans.items():
                start = wr.render_frame(scene, plan)
                eye = plan.camera.eye + STEP * (1 + round_ % 2) * 3.6 * plan.camera.right
                after = wr.render_frame(scene, plan, dataclasses.replace(plan.camera, eye=eye), previous=start)
                if round_:  # the first loads kernels
                    first[name].append(start.timings["reflect"])
                    next_[name].append(after.timings["reflect"])
    row = {"triangles": scene.triangle_count, "pixels": plans[TRACED].rows[0].pixels}
    for name, plan in plans.items():
        predicted = plan.rows[0].predicted
        cold, warm = statistics.median(first[name]), statistics.median(next_[name])
        row |= {
            f"{name}_first_ms": cold,
            f"{name}_next_ms": warm,
            f"{name}_ms": (1.0 - COLD_SHARE) * warm + COLD_SHARE * cold,
            f"{name}_predicted_ms": predicted["ms"],
            f"{name}_predicted_first_ms": predicted["first_ms"],
        }
    taken = TRACED if chosen.technique == "raytraced" else FORWARD
    row["planner"] = chosen.technique
    row["lost"] = row[f"{taken}_ms"] / min(row[f"{TRACED}_ms"], row[f"{FORWARD}_ms"])
    return row


def line(row: dict) -> str:
    """A cell for a reader."""
    times = (
        f"{name} {row[f'{name}_ms']:.2f} ms ({row[f'{name}_predicted_ms']:.2f} predicted)" for name in (TRACED, FORWARD)
    )
    return (
        f"{row['triangles']:>9,d} triangles {row['pixels']:>9,d} pixels: {', '.join(times)}; planner: {row['planner']}"
    )


def summary(cells: list[dict]) -> dict:
    """How far predictions err, and what the planner's choices lose."""
    off = {
        f"{name}_predicted_over_measured": [
            float(each)
            for each in np.percentile([row[f"{name}_predicted_ms"] / row[f"{name}_ms"] for row in cells], (0, 50, 100))
        ]
        for name in (TRACED, FORWARD)
    }
    return off | {
        "cells": len(cells),
        "planner_right": sum(row["lost"] == 1.0 for row in cells),
        "planner_lost_worst": max(row["lost"] for row in cells),
    }


def plot(cells: list[dict], path: Path, title: str) -> None:
    """Ratios of tracing to projection, measured and predicted, and predictions against times."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    counts = sorted({row["triangles"] for row in cells})
    by_row = {
        count: sorted((row for row in cells if row["triangles"] == count), key=lambda row: row["pixels"])
        for count in counts
    }
    pixels = [
        float(np.median(column))
        for column in zip(*([row["pixels"] for row in rows] for rows in by_row.values()), strict=True)
    ]
    figure, panels = pyplot.subplots(1, 3, figsize=(16, 5), constrained_layout=True)
    for panel, suffix, name in zip(panels, ("ms", "predicted_ms"), ("measured", "predicted"), strict=False):
        ratio = np.array(
            [[row[f"{TRACED}_{suffix}"] / row[f"{FORWARD}_{suffix}"] for row in by_row[count]] for count in counts]
        )
        drawn = panel.imshow(np.log2(ratio), cmap="RdYlGn", vmin=-3, vmax=3, origin="lower", aspect="auto")
        for y, count in enumerate(counts):
            for x, row in enumerate(by_row[count]):
                took = "F" if row["planner"] != "raytraced" else "T"
                panel.text(x, y, f"{ratio[y, x]:.2f}x\n{took}", ha="center", va="center", fontsize=10)
        if ratio.shape[0] > 1 and ratio.shape[1] > 1 and ratio.min() < 1.0 < ratio.max():
            panel.contour(np.log2(ratio), levels=[0.0], colors="black")
        panel.set_xticks(range(len(pixels)), [f"{value:,.0f}" for value in pixels])
        panel.set_yticks(range(len(counts)), [f"{count:,d}" for count in counts])
        panel.set_xlabel("mirror pixels")
        panel.set_ylabel("triangles")
        panel.set_title(name)
    figure.colorbar(drawn, ax=panels[1], label="log2 (tracing / forward)")
    for name, mark in ((TRACED, "o"), (FORWARD, "^")):
        panels[2].loglog(
            [row[f"{name}_ms"] for row in cells], [row[f"{name}_predicted_ms"] for row in cells], mark, label=name
        )
    limits = panels[2].get_xlim()
    panels[2].plot(limits, limits, "k-", linewidth=0.8)
    panels[2].set_xlabel("measured ms")
    panels[2].set_ylabel("predicted ms")
    panels[2].legend()
    panels[2].set_title("predicted against measured")
    figure.suptitle(
        "Tracing takes so many times as long as forward projection (line: equal). The planner takes F forward, T tracing.\n"
        f"{title}",
        fontsize=10,
    )
    written = path.with_name(f".{path.name}")
    figure.savefig(written, dpi=110, format="png")
    pyplot.close(figure)
    written.replace(path)


if __name__ == "__main__":
    main()
