"""Time and error of rough mirrors and clear coats, side by side, one process, contenders in turn.

    python tools/bench_finishes.py --size 480x270 --frames 3
    python tools/bench_finishes.py --json

`usd_scenes/polished_spheres.usda` (its mirrors of roughness above 0) and `usd_scenes/coated_car.usda` (a clear coat over a
rough base): the sharp picture; a few rays a pixel that neighbours share, without that and without smoothing too; look-ups in
the sharp picture; rays without either; and the mean of 256 rays a pixel, the reference. 192 rays say what grain that has
itself. Times are CPU milliseconds of a whole frame, and of what the finish adds to the sharp one (medians of the frames after
the first; frames of more than 100 rays a pixel are timed once). Errors are over the pixels of the mirrors: the mean absolute
difference of radiance and, where flip-evaluator is installed, the mean FLIP. Shadows are off: they cost the same in every row.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
JUDGED = {
    "polished_spheres": ("/World/Sphere1", "/World/Sphere2", "/World/Sphere3"),
    "coated_car": ("/World/Car/Body",),
}
SHARP, GATHERED, REFERENCE = "sharp", "gather", "accumulate, 256 rays"
CONTENDERS = {
    SHARP: {"glossy": "off"},
    "filter": {"glossy": "filter"},
    "filter, 64 look-ups": {"glossy": "filter", "glossy_samples": 64},
    "gather, 3 rays": {"glossy": "gather", "glossy_samples": 3},
    GATHERED: {"glossy": "gather"},
    "gather, 10 rays": {"glossy": "gather", "glossy_samples": 10},
    "gather, not smoothed": {"glossy": "gather", "glossy_smooth": 0.0},
    "gather, not shared": {"glossy": "gather", "glossy_neighbours": 0},
    "accumulate, 6 rays": {"glossy": "accumulate", "glossy_samples": 6},
    "accumulate, 192 rays": {"glossy": "accumulate", "glossy_samples": 192},
    REFERENCE: {"glossy": "accumulate", "glossy_samples": 256},
}
TIMED_ONCE = 100  # rays a pixel from which on


def measure(name: str, size, frames: int, threads: int) -> list[dict]:
    """A row for each contender, then one for each judged mirror as sharing shows it."""
    scene = wr.load_stage(str(SCENES / f"{name}.usda"))
    plans = {
        contender: wr.make_plan(
            scene, size=size, settings=wr.Settings(shadows="off", keep_static=False, threads=threads, **settings)
        )
        for contender, settings in CONTENDERS.items()
    }
    shown = {}
    # All kernels of the reference are loaded by a few rays.
    few = wr.Settings(shadows="off", keep_static=False, threads=threads, glossy="accumulate", glossy_samples=1)
    wr.render_frame(scene, wr.make_plan(scene, size=size, settings=few))
    spent: dict[str, list[float]] = {contender: [] for contender in CONTENDERS}
    for turn in range(frames + 1):
        for contender, plan in plans.items():
            if plan.settings.glossy_samples > TIMED_ONCE and turn != 1:
                continue
            start = time.process_time()
            shown[contender] = wr.render_frame(scene, plan)
            if turn:
                spent[contender].append(1000.0 * (time.process_time() - start))
    cost = {contender: statistics.median(each) for contender, each in spent.items()}
    truth = shown[REFERENCE]
    rows = []
    for contender in CONTENDERS:
        row = {"contender": contender, "ms": cost[contender], "added_ms": cost[contender] - cost[SHARP]}
        row["faster"] = cost[REFERENCE] / cost[contender]
        rows.append({**row, **errors(shown[contender], truth, JUDGED[name])})
    for path in JUDGED[name]:
        rows.append({"contender": f"{GATHERED} {path}", **errors(shown[GATHERED], truth, (path,))})
    return rows


def errors(shown, truth, paths: tuple[str, ...]) -> dict:
    """Mean absolute difference and mean FLIP over what the eye sees of some prims."""
    ids = [number for number, path in truth.prims.items() if path in paths]
    mask = np.isin(truth["primId"], ids)
    mean = float(np.abs(shown["RGBA"] - truth["RGBA"])[..., :3][mask].mean())
    return {"pixels": int(mask.sum()), "mean_error": mean, "flip": flip(shown, truth, mask)}


def flip(shown, truth, mask) -> float | None:
    """Mean FLIP over a mask; None where it is not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    pictures = [np.ascontiguousarray(np.clip(each["RGBA"][..., :3], 0.0, 1.0)) for each in (truth, shown)]
    error = flip_evaluator.evaluate(*pictures, "LDR", inputsRGB=False, applyMagma=False)[0]
    return float(np.asarray(error).reshape(*mask.shape, -1)[..., 0][mask].mean())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", default="480x270")
    parser.add_argument("--frames", default=3, type=int, help="that are timed")
    parser.add_argument("--threads", default=1, type=int)
    parser.add_argument("--json", action="store_true", help="one JSON line per row")
    args = parser.parse_args()
    if args.frames < 1:
        parser.error(f"--frames {args.frames}: expected 1 or more")
    wp.config.log_level = wp.LOG_WARNING
    size = tuple(int(edge) for edge in args.size.split("x"))
    for name in JUDGED:
        rows = measure(name, size, args.frames, args.threads)
        if not args.json:
            print(f"{name} {args.size}, {args.threads} thread(s), CPU time of a frame")
        for row in rows:
            if args.json:
                print(json.dumps({"scene": name, "size": args.size, **row}))
                continue
            timed = " " * 48
            if "ms" in row:
                timed = f"{row['ms']:9.1f} ms {row['added_ms']:+10.1f} ms {row['faster']:8.1f} x faster"
            perceived = "" if row["flip"] is None else f"  flip {row['flip']:.4f}"
            print(
                f"  {row['contender']:24} {timed}  {row['pixels']:6} px  mean error {row['mean_error']:.4f}{perceived}"
            )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
