"""Time and error of what is seen through surfaces and on water, side by side, one process, contenders in turn.

    python tools/bench_water.py --size 640x360 --frames 7
    python tools/bench_water.py --json

`usd_scenes/pool.usda`: the water as an opaque flat mirror (planar), still and clear, with waves looked up, with waves traced
(the reference of the row before). `usd_scenes/frosted_window.usda`: clear panes, frost blurred without and with the rays that
correct it, frost of so many rays (the last is the reference).
Times are CPU milliseconds of a whole frame, the median of the frames after the first; errors are
over the pixels of the water or the panes: the mean absolute difference of radiance and, where flip-evaluator is installed,
the mean FLIP. Shadows are off: they cost the same in every row.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect.scene import MaterialData

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
RAYS = (16, 64, 256)  # a pixel of the frosted panes; the last is the reference
MIRROR = {"transmission": 0.0, "metallic": 1.0, "base_color": (0.9, 0.9, 0.9), "finish": None}


def changed(scene: wr.Scene, change: Callable[[MaterialData], MaterialData]) -> wr.Scene:
    """The scene with other materials where the stage asks for a finish."""
    materials = [change(each) if each.finish is not None else each for each in scene.data.materials]
    return wr.Scene(replace(scene.data, materials=materials), scene.device)


def without(**values) -> Callable[[MaterialData], MaterialData]:
    return lambda material: replace(material, finish=replace(material.finish, **values))


def measure(contenders: dict[str, tuple[wr.Scene, dict]], size, frames: int, threads: int, method: str) -> list[dict]:
    """A row for each (scene, settings), the first the base of the ratios."""
    plans = {}
    for name, (scene, settings) in contenders.items():
        asked = wr.Settings(shadows="off", keep_static=False, threads=threads, **settings)
        plans[name] = wr.make_plan(scene, size=size, settings=asked, method=method)
    spent: dict[str, list[float]] = {name: [] for name in contenders}
    shown = {}
    for turn in range(frames + 1):
        for name, (scene, _) in contenders.items():
            start = time.process_time()
            shown[name] = wr.render_frame(scene, plans[name])
            if turn:
                spent[name].append(1000.0 * (time.process_time() - start))
    base = statistics.median(next(iter(spent.values())))
    return [
        {
            "contender": name,
            "technique": ", ".join(dict.fromkeys(row.technique for row in plans[name].rows)),
            "ms": statistics.median(spent[name]),
            "ratio": statistics.median(spent[name]) / base,
            "frame": shown[name],
        }
        for name in contenders
    ]


def judge(rows: list[dict], reference: str, judged: list[str], paths: tuple[str, ...]) -> None:
    """Give rows their errors against one of them, over what the eye sees of some prims."""
    truth = next(row["frame"] for row in rows if row["contender"] == reference)
    ids = [number for number, path in truth.prims.items() if path in paths]
    mask = np.isin(truth["primId"], ids)
    for row in rows:
        if row["contender"] in judged:
            row["mean_error"] = float(np.abs(row["frame"]["RGBA"] - truth["RGBA"])[..., :3][mask].mean())
            row["flip"] = flip(row["frame"], truth, mask)


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
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", default=5, type=int, help="that are timed")
    parser.add_argument("--threads", default=1, type=int)
    parser.add_argument("--method", default="planar", help="of the mirrors")
    parser.add_argument("--json", action="store_true", help="one JSON line per row")
    args = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    size = tuple(int(edge) for edge in args.size.split("x"))
    pool, window = (wr.load_stage(str(SCENES / f"{name}.usda")) for name in ("pool", "frosted_window"))
    waters = {
        "planar": (changed(pool, lambda material: replace(material, **MIRROR)), {}),
        "still water": (changed(pool, without(wave_slope=0.0, frost_distance=0.0)), {}),
        "waves, lookup": (pool, {}),
        "waves, traced": (pool, {"waves": "traced"}),
    }
    panes = {
        "clear": (window, {"frost_px": 1.0e6}),
        "frost, no rays": (window, {"frost_rays": 0}),
        "frost, blurred": (window, {}),
        **{f"frost, {rays} rays": (window, {"frost_samples": rays}) for rays in RAYS},
    }
    tables = {}
    tables["pool"] = measure(waters, size, args.frames, args.threads, args.method)
    judge(tables["pool"], "waves, traced", ["still water", "waves, lookup"], ("/World/Water",))
    tables["frosted_window"] = measure(panes, size, 1, args.threads, args.method)
    frosted = ("/World/Panes/Frosted", "/World/Panes/Misted")
    judged = ["clear", "frost, no rays", "frost, blurred", *(f"frost, {rays} rays" for rays in RAYS[:-1])]
    judge(tables["frosted_window"], f"frost, {RAYS[-1]} rays", judged, frosted)
    for name, rows in tables.items():
        if not args.json:
            print(f"{name} {args.size}, {args.threads} thread(s), CPU time of a frame")
        for row in rows:
            row.pop("frame")
            if args.json:
                print(json.dumps({"scene": name, "size": args.size, **row}))
                continue
            error, perceived = row.get("mean_error"), row.get("flip")
            errors = "" if error is None else f"  mean error {error:.4f}"
            errors += "" if perceived is None else f"  flip {perceived:.4f}"
            print(f"  {row['contender']:18} {row['technique']:20} {row['ms']:9.1f} ms {row['ratio']:7.2f} x{errors}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
