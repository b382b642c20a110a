"""What requests for an error or a time come out as: predicted beside realised, at camera positions nobody tuned for.

    warp-reflect calibrate && python tools/bench_budgets.py usd_scenes/kitchen.usda --size 960x540
    python tools/bench_budgets.py usd_scenes/kitchen.usda --json

*Errors*: ten views of the mirrors from random places; at each the plan for `--max-error-px`, its realised 95th percentile
(`realised_error`), and the time of its reflections over those of the exact plans: `auto` (whatever is exact and cheapest) and
the exact forward ones, all as second frames that start from a frame a step away. *Times*: a walk of frames with
`--budget-ms` set to shares of what the exact plan takes; met where a frame takes at most 15 % more, or where the plan said
that it cannot be. *Predictions*: every technique's time and error beside what came out.

Times are of this thread's own CPU time (one thread), which others on the machine disturb little.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import statistics
import time

import numpy as np

import warp_reflect as wr
from warp_reflect import calibration, sweep
from warp_reflect.budget import BUILT_IN
from warp_reflect.devices import open_device
from warp_reflect.realised import realised_error
from warp_reflect.timing import counted_by

VIEWS = 10
SEED = 20051  # of the views
TURN = 0.6  # radians to either side, about the mirrors
RISE = 0.25  # radians up and down
NEARER, FARTHER = 0.8, 1.25  # of the distance
SHARES = (0.97, 0.9, 0.8, 0.5)  # of the exact plan's time, that are asked for
TOLERANCE = 1.15  # of a time that was asked for
WAYS = (
    ("raytraced", {}),
    ("planar", {}),
    ("quadric", {}),
    ("quadric", {"refine": "off", "edge_px": 1.0}),
    ("reflector_map", {}),
    ("reflector_map", {"refine": "off", "edge_px": 1.0}),
    ("reflector_map", {"grid_error_px": 0.5}),
    ("environment", {}),
)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--size", default="960x540", help="WxH")
    parser.add_argument("--max-error-px", type=float, default=0.5)
    parser.add_argument("--views", type=int, default=VIEWS)
    parser.add_argument("--frames", type=int, default=20, help="of each walk")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting that all share")
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    open_device("cpu")  # quietly
    size = tuple(int(side) for side in arguments.size.split("x"))
    base = wr.Settings(threads=1, keep_static=False).replace(**dict(item.split("=") for item in arguments.set))
    scene = wr.load_stage(arguments.stage)
    first = wr.render_frame(scene, wr.make_plan(scene, size=size, settings=base, method="reference"))
    pivot = sweep.mirrors_middle(first)
    if pivot is None:
        raise SystemExit(f"{arguments.stage}: no mirror is seen")
    with counted_by(time.thread_time):
        found = {
            "stage": arguments.stage,
            "size": size,
            "calibrated": calibration.known("cpu") != BUILT_IN,
            "machine": sweep.machine(),
            "predictions": predictions(scene, first.camera, pivot, size, base),
            "errors": errors(scene, first.camera, pivot, size, base, arguments),
            "times": times(scene, first.camera, pivot, size, base, arguments),
        }
    if arguments.json:
        print(json.dumps(found))
    else:
        show(found, arguments)


def views(camera, pivot: np.ndarray, count: int) -> list:
    """Random cameras that look at a world point as one does."""
    rng = np.random.default_rng(SEED)
    made = []
    for turn, rise, far in zip(
        rng.uniform(-TURN, TURN, count),
        rng.uniform(-RISE, RISE, count),
        rng.uniform(NEARER, FARTHER, count),
        strict=True,
    ):
        turned = sweep.camera_path(camera, pivot, 2, -turn)[0]
        # The same about the axis to the right: a camera whose up is that.
        tipped = dataclasses.replace(turned, up=turned.right, right=-turned.up)
        tipped = sweep.camera_path(tipped, pivot, 2, rise)[0]
        made.append(
            dataclasses.replace(tipped, up=-tipped.right, right=tipped.up, eye=pivot + far * (tipped.eye - pivot))
        )
    return made


def second_frame(scene, view, pivot, size, settings, method="auto"):
    """A frame that starts from one a step away, as planned for it."""
    plan = wr.make_plan(scene, view, size, settings, method)
    before = wr.render_frame(scene, plan, sweep.camera_path(view, pivot, 2)[0])
    return wr.render_frame(scene, dataclasses.replace(plan, _prepared=plan._prepared), view, previous=before)


def told(frame) -> dict:
    """Time and error of a frame, predicted and realised."""
    predicted = frame.plan.predicted
    reflect = sum(frame.plan.reflecting("ms").values())
    came_out = realised_error(frame)
    return {
        "techniques": ", ".join(sorted({row.technique for row in frame.plan.rows if row.pixels})),
        "predicted_reflect_ms": reflect,
        "reflect_ms": frame.timings.get("reflect", 0.0),
        "search_ms": frame.timings.get("reflect/search", 0.0),
        "predicted_frame_ms": predicted["ms"],
        "frame_ms": frame.spent_ms,
        "predicted_px": predicted["error_px"],
        "error_px": came_out.error_p95_px,
        "pixels": came_out.pixels,
        "notes": [note.text for note in frame.plan.notes if "budget_ms" in note.text or "max_error_px" in note.text],
    }


def predictions(scene, camera, pivot, size, base) -> list[dict]:
    rows = []
    for method, changes in WAYS:
        settings = base.replace(environment_px=0.0, **changes)
        if method != "raytraced":
            planned = wr.make_plan(scene, camera, size, settings, method)
            if not any(row.technique == method for row in planned.rows if row.pixels):
                continue
        name = " ".join([method, *(f"{knob}={value}" for knob, value in changes.items())])
        rows.append({"way": name} | told(second_frame(scene, camera, pivot, size, settings, method)))
    return rows


def errors(scene, camera, pivot, size, base, arguments) -> list[dict]:
    rows = []
    asked = base.replace(max_error_px=arguments.max_error_px)
    for view in views(camera, pivot, arguments.views):
        row = told(second_frame(scene, view, pivot, size, asked))
        exact = second_frame(scene, view, pivot, size, base)
        forward = second_frame(scene, view, pivot, size, base, "reflector_map")
        row["exact_ms"], row["forward_ms"] = (each.timings["reflect"] for each in (exact, forward))
        row["forward_search_ms"] = forward.timings.get("reflect/search", 0.0) + forward.timings.get(
            "reflect/tessellate", 0.0
        )
        rows.append(row)
    return rows


def times(scene, camera, pivot, size, base, arguments) -> list[dict]:
    poses = sweep.camera_path(camera, pivot, arguments.frames + 1)
    plan = wr.make_plan(scene, camera, size, base)
    exact = []
    last = None
    for view in poses[: len(poses) // 2 + 1]:
        last = wr.render_frame(scene, plan, view, previous=last)
        exact.append(last.spent_ms)
    whole = statistics.median(exact[1:])
    rows = []
    for share in SHARES:
        settings = base.replace(budget_ms=share * whole)
        plan, last, spent, said, used = wr.make_plan(scene, camera, size, settings), None, [], [], []
        for view in poses:
            last = wr.render_frame(scene, last.plan if last else plan, view, previous=last)
            spent.append(last.spent_ms)
            said.append(any("cannot be met" in note.text for note in last.plan.notes))
            used.append([(row.technique, row.settings) for row in last.plan.rows])
        asked = settings.budget_ms
        rows.append(
            {
                "share": share,
                "budget_ms": asked,
                "frame_ms": spent,
                "said_impossible": sum(said),
                "met": sum(ms <= TOLERANCE * asked or no for ms, no in zip(spent, said, strict=True)),
                "frames": len(spent),
                "changes": sum(a != b for a, b in itertools.pairwise(used)),
                "error_px": realised_error(last).error_p95_px,
                "techniques": ", ".join(sorted({row.technique for row in last.plan.rows if row.pixels})),
            }
        )
    return rows


def show(found: dict, arguments) -> None:
    """Print as Markdown tables."""
    known = found["machine"]
    width, height = found["size"]
    print(
        f"{found['stage']}, {width}x{height}, one thread, CPU time; {known['processor']}, load {known['load']:.1f}; "
        f"costs {'of this machine' if found['calibrated'] else 'built in'}; commit {known['commit'] or '-'}\n"
    )
    print(
        "| way | reflection ms, predicted | realised | ratio | 95 % px, predicted | realised |\n|---|--:|--:|--:|--:|--:|"
    )
    for row in found["predictions"]:
        ratio = row["predicted_reflect_ms"] / max(row["reflect_ms"], 1e-9)
        print(
            f"| {row['way']} | {row['predicted_reflect_ms']:.1f} | {row['reflect_ms']:.1f} | {ratio:.2f} | "
            f"{row['predicted_px']:.2g} | {row['error_px']:.2g} |"
        )
    print(
        f"\n| view, max_error_px={arguments.max_error_px:g} | plan | 95 % px, predicted | realised | reflection ms | predicted | "
        "of exact `auto` | of exact `reflector_map` |\n|--:|---|--:|--:|--:|--:|--:|--:|"
    )
    for k, row in enumerate(found["errors"], 1):
        print(
            f"| {k} | {row['techniques']} | {row['predicted_px']:.2g} | {row['error_px']:.2g} | {row['reflect_ms']:.1f} | "
            f"{row['predicted_reflect_ms']:.1f} | {row['reflect_ms'] / row['exact_ms']:.0%} | "
            f"{row['reflect_ms'] / row['forward_ms']:.0%} |"
        )
    print(
        "\n| budget_ms | of the exact plan | frame ms, median | worst | met within 15 % (or said impossible) | said impossible | "
        "changes of plan | 95 % px |\n|--:|--:|--:|--:|--:|--:|--:|--:|"
    )
    for row in found["times"]:
        print(
            f"| {row['budget_ms']:.0f} | {row['share']:.0%} | {statistics.median(row['frame_ms']):.0f} | "
            f"{max(row['frame_ms']):.0f} | {row['met']} of {row['frames']} | {row['said_impossible']} | {row['changes']} | "
            f"{row['error_px']:.2g} |"
        )


if __name__ == "__main__":
    main()
