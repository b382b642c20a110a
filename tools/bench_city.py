"""What mirrors of a city cost a frame: none, maps drawn anew, local maps from reference maps; after Meyer and Loscos, table 1.

    python tools/bench_city.py --size 640x360 --frames 8

The stages are made in a temporary folder (`tools/make_scenes.py`). *Frame* is the median over the frames of everything but the
reading of the stage, cars moving in every one; contenders in turn at each frame, in one process. Times are of this process on
the processor, not of the wall. *Angle* is between where a mirror pixel's ray leads and where what is shown lies, against the
ray traced picture; *FLIP* of the whole pictures.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import make_scenes
import numpy as np

import warp_reflect as wr
from warp_reflect import devices

CARS = (15, 30)
RESOLUTION = 128  # of every map, texels along a cube edge
LOCAL = {"local_rays": "field", "local_shade_step": 2}
DETAIL = LOCAL | {"local_detail": 1.0, "local_texels": 200_000, "local_keep_px": 2.0}


def contenders(common: dict) -> dict[str, tuple[str, dict]]:
    """Name to (method, settings)."""
    return {
        "no reflection": ("none", common),
        "maps drawn anew in every frame": ("environment", common | {"environment_update": "frame"}),
        "local maps from reference maps": ("layered_environment", common | LOCAL),
        "the same with level of detail, blended over": ("layered_environment", common | DETAIL),
        "the same, switched at once": ("layered_environment", common | DETAIL | {"local_blend": 0.0}),
        "every ray traced": ("reference", common),
    }


def angles(frame: wr.Frame, reference: wr.Frame) -> np.ndarray:
    """Degrees between what two frames show, seen from the mirror, where both show a surface."""
    both = (frame["reflectedId"] > 0) & (reference["reflectedId"] > 0) & (reference["reflectorId"] > 0)
    at = reference.relative("mirrorPoint")[both].astype(np.float64)
    ways = [each.relative("reflectedPoint")[both].astype(np.float64) - at for each in (frame, reference)]
    ways = [way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-30) for way in ways]
    sine = np.linalg.norm(np.cross(*ways), axis=1)
    return np.degrees(np.arctan2(sine, np.einsum("ij,ij->i", *ways)))


def measure(cars: int, folder: Path, size: tuple[int, int], frames: int, threads: int) -> list[tuple]:
    own = folder / str(cars)  # its parts are its own: those of a stage that is open do not change
    own.mkdir()
    path = make_scenes.build(f"city_{cars}", own / "city.usdc")
    common = {"environment_resolution": RESOLUTION, "shadows": "off", "bounces": 1, "threads": threads}
    scene = wr.load_stage(str(path))
    rows = {name: ([], []) for name in contenders(common)}
    plans, previous = {}, {}
    for name, (method, settings) in contenders(common).items():
        start = time.process_time()
        plans[name] = wr.make_plan(scene, size=size, settings=wr.Settings(**settings), method=method)
        previous[name] = wr.render_frame(scene, plans[name])
        rows[name][1].append(1e3 * (time.process_time() - start))
    for k in range(frames):
        for name in rows:
            moved = scene.at(2.0 + k)  # one of its own: what a frame makes of its scene would be there for the next
            start = time.process_time()
            previous[name] = wr.render_frame(moved, plans[name], previous=previous[name])
            rows[name][0].append(1e3 * (time.process_time() - start))
    bare = statistics.median(rows["no reflection"][0])
    table = []
    for name, (times, first) in rows.items():
        frame, reference = previous[name], previous["every ray traced"]
        median = statistics.median(times)
        off = angles(frame, reference) if name != "no reflection" else np.zeros(0)
        seen = int((reference["reflectorId"] > 0).sum())
        row = (name, median, median - bare, median / bare, first[0], np.median(off) if len(off) else None)
        table.append((*row, np.quantile(off, 0.95) if len(off) else None, flip(frame, reference), seen))
    return table


def flip(frame: wr.Frame, reference: wr.Frame) -> float:
    """FLIP of two pictures, 0 is equal; NaN where flip-evaluator is not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return float("nan")
    shown = [np.clip(each["RGBA"][..., :3], 0.0, 1.0).astype(np.float32) for each in (reference, frame)]
    return float(flip_evaluator.evaluate(*shown, "LDR", inputsRGB=False, applyMagma=False)[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--cars", type=int, nargs="*", default=CARS, choices=CARS)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    devices.open_device("cpu")
    print(
        "| cars | contender | frame ms | for mirrors ms | frames without | first frame ms | angle, median | 95 % | FLIP |"
    )
    print("|---:|---|---:|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        for cars in arguments.cars:
            for name, ms, extra, ratio, first, half, most, off, seen in measure(
                cars, Path(folder), (width, height), arguments.frames, arguments.threads
            ):
                angle = "" if half is None else f"{half:.3f} deg | {most:.3f} deg"
                cells = f"{ms:.0f} | {extra:.1f} | {ratio:.2f}x | {first:.0f} | {angle or ' | '} | {off:.3f}"
                print(f"| {cars} ({seen:,} pixels) | {name} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
