"""Time and error of whole frames and of the reflection pass, side by side, one process, contenders in turn.

    python tools/bench_frames.py usd_scenes/kitchen.usda usd_scenes/one_mirror.usda --size 1280x720 --frames 9
    python tools/bench_frames.py usd_scenes/one_mirror.usda --size 640x480 1280x720 1920x1080 --cpu
    python tools/bench_frames.py usd_scenes/kitchen.usda --path 60
    python tools/bench_frames.py usd_scenes/kitchen.usda --slopes --threads 2

Per stage, on the same pixels with the same number of threads: the planned technique (cold: no history; warm: from the
previous frame), the project's own BVH reference (its best flags), and Embree through embreex where it is installed
(single rays in one call, one thread): the mirror's rays alone, and a wavefront of eye and mirror rays for the frame, without
shading. Error and time stand on the same row. `--json` prints one JSON line per row; `--cpu` counts this thread's own time,
which others on the machine disturb less.

`--path N`: frame times while the camera walks N frames on a circle about the mirrors, each frame from the one before: the
first frame, percentiles, the worst, a histogram. `--slopes`: how the reflections' time grows with pixels, vertices
(scenes of `make_scenes.py` alone), reflectors and threads: the exponents of fitted powers.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parent))

from warp_reflect import sweep
from warp_reflect.devices import open_device
from warp_reflect.launch import thread_count
from warp_reflect.sweep import Embree, commit
from warp_reflect.timing import counted_by

PIXEL_SCALES = (0.25, 0.5, 1.0)  # of the picture's sides
MESH_SCALES = (0.5, 1.0, 2.0)  # of the segments along each direction of every mesh
BINS = 12  # of the histogram
BAR = 40  # characters of its longest bar


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", nargs="+", default=["1280x720"], help="WxH, one or several")
    parser.add_argument("--frames", type=int, default=9, help="timed frames per contender, after two for warm-up")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--grid-share", type=float, default=0.05, help="share of the interpolation-grid row; 0: no row")
    parser.add_argument("--path", type=int, default=0, metavar="N", help="frame times along a camera path of N frames")
    parser.add_argument(
        "--slopes", action="store_true", help="how time grows with pixels, vertices, reflectors, threads"
    )
    parser.add_argument("--method", default="auto", help="the technique of --path and --slopes, beside the reference")
    parser.add_argument(
        "--cpu", action="store_true", help="this thread's processor time instead of the wall's (one thread)"
    )
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--preview", help="folder for pictures of the frames that were timed")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    open_device(arguments.device)  # quietly
    sizes = [tuple(int(side) for side in size.split("x")) for size in arguments.size]
    if arguments.cpu and (arguments.threads != 1 or arguments.device != "cpu"):
        sys.exit("--cpu counts one thread: use --threads 1 --device cpu")
    rows = []
    measure, show = (bench, table)
    if arguments.path:
        measure, show = walk, path_table
    elif arguments.slopes:
        measure, show = slopes, slope_table
    with counted_by(time.thread_time if arguments.cpu else time.perf_counter):
        for stage in arguments.stages:
            for size in sizes:
                rows += measure(stage, size, arguments)
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
    else:
        show(rows)


def common(stage: str, size: tuple[int, int], scene, arguments) -> dict:
    """What every row tells."""
    return {
        "stage": Path(stage).stem,
        "size": list(size),
        "threads": arguments.threads,
        "device": str(scene.device),
        "triangles": scene.triangle_count,
        "vertices": scene.vertex_count,
        "machine": machine(),
        "warp": wp.__version__,
        "commit": commit(),
    }


def machine() -> str:
    """Processor name and cores."""
    known = sweep.machine()
    return f"{known['processor']}, {known['cores']} cores"


def bench(stage: str, size: tuple[int, int], arguments) -> list[dict]:
    """Rows of one stage."""
    import warp_reflect as wr

    start = time.perf_counter()
    scene = wr.load_stage(stage, device=arguments.device)
    loaded = time.perf_counter() - start
    base = wr.Settings(threads=arguments.threads, keep_static=False, shadows="off")
    reference = wr.make_plan(scene, size=size, settings=base, method="reference")
    contenders = {
        "reference": (reference, False),
        "cold": (wr.make_plan(scene, size=size, settings=base, method="reflector_map"), False),
        "warm": (wr.make_plan(scene, size=size, settings=base, method="reflector_map"), True),
        "auto": (wr.make_plan(scene, size=size, settings=base), True),
    }
    if arguments.grid_share > 0:
        settings = base.replace(grid_share=arguments.grid_share)
        contenders[f"grid {100 * arguments.grid_share:g} %"] = (
            wr.make_plan(scene, size=size, settings=settings, method="reflector_map"),
            False,
        )
    frames, times = {}, {name: [] for name in contenders}
    start = time.perf_counter()
    first = wr.render_frame(scene, contenders["auto"][0])
    first_picture = time.perf_counter() - start
    embree = Embree.over(scene, first)
    wave = wavefront(scene, first) if embree else None
    clock = time.thread_time if arguments.cpu else time.perf_counter
    embree_ms, wave_ms = [], []
    for round_ in range(arguments.frames + 2):
        for name, (plan, warm) in contenders.items():
            frame = wr.render_frame(scene, plan, previous=frames.get(name) if warm else None)
            frames[name] = frame
            if round_ >= 2:
                times[name].append(frame.timings)
        for contender, taken in ((embree, embree_ms), (wave, wave_ms)):
            if contender is not None:
                started = clock()
                contender.trace()
                if round_ >= 2:
                    taken.append(1000.0 * (clock() - started))
    told = common(stage, size, scene, arguments) | {"load_s": loaded, "first_picture_s": first_picture}
    rows = []
    for name, (plan, _) in contenders.items():
        comparison = wr.compare_frames(frames[name], frames["reference"])
        reflect = [timing.get("reflect", 0.0) for timing in times[name]]
        whole = [sum(ms for step, ms in timing.items() if "/" not in step) for timing in times[name]]
        steps = sorted({step for timing in times[name] for step in timing})
        rows.append(
            told
            | {
                "contender": name,
                "technique": ", ".join(sorted({row.technique for row in plan.rows})),
                "reflect_ms": statistics.median(reflect),
                "reflect_p95_ms": float(np.percentile(reflect, 95)),
                "frame_ms": statistics.median(whole),
                "steps_ms": {
                    step: statistics.median(timing.get(step, 0.0) for timing in times[name]) for step in steps
                },
                "identical": comparison.share(comparison.identical),
                "wrong": comparison.share(comparison.wrong),
                "mirror_pixels": int((frames[name]["reflectorId"] > 0).sum()),
                "statistics": frames[name].statistics,
            }
        )
        if arguments.preview:
            Path(arguments.preview).mkdir(parents=True, exist_ok=True)
            frames[name].write(Path(arguments.preview) / f"{Path(stage).stem}_{name.split()[0]}.png")
    if embree_ms:
        rows.append(
            told
            | {
                "contender": "embreex",
                "technique": "Embree, same rays, hits only",
                "reflect_ms": statistics.median(embree_ms),
                "reflect_p95_ms": float(np.percentile(embree_ms, 95)),
                "frame_ms": statistics.median(wave_ms) if wave_ms else None,
                "steps_ms": {},
                "identical": embree.agreement(frames["reference"]),
                "wrong": None,
                "mirror_pixels": len(embree.origins),
                "statistics": {},
            }
        )
    return rows


def wavefront(scene, frame):
    """Embree's eye and mirror rays by `wavefronts.Wavefront`; None where nothing is reflected."""
    from wavefronts import Wavefront

    return Wavefront(scene, frame) if frame.layers else None


def walk(stage: str, size: tuple[int, int], arguments) -> list[dict]:
    """Frame times of one stage along a camera path: the chosen technique and the reference, frame by frame in turn."""
    import warp_reflect as wr

    start = time.perf_counter()
    scene = wr.load_stage(stage, device=arguments.device)
    loaded = 1000.0 * (time.perf_counter() - start)
    base = wr.Settings(threads=arguments.threads, keep_static=False, shadows="off")
    plans = {
        name: wr.make_plan(scene, size=size, settings=base, method=name) for name in (arguments.method, "reference")
    }
    camera = plans["reference"].camera
    rows = []
    for name, plan in plans.items():
        start = time.perf_counter()
        first = wr.render_frame(scene, plan)
        first_ms = 1000.0 * (time.perf_counter() - start)
        rows.append(
            common(stage, size, scene, arguments)
            | {
                "contender": name,
                "technique": ", ".join(sorted({row.technique for row in plan.rows})),
                "load_ms": loaded,
                "first_ms": first_ms,
                "prepare_ms": first.timings.get("prepare", 0.0),
                "frames_ms": [],
                "reflect_ms": [],
            }
        )
    pivot = sweep.mirrors_middle(first)
    if pivot is None:
        print(f"{stage}: no mirror is seen; nothing to walk about", file=sys.stderr)
        return []
    frames: dict = {}
    for view in sweep.camera_path(camera, pivot, arguments.path + 1):
        for row, (name, plan) in zip(rows, plans.items(), strict=True):
            start = time.perf_counter()
            frame = wr.render_frame(scene, plan, camera=view, previous=frames.get(name))
            if name in frames:  # the first has no frame before
                row["frames_ms"].append(1000.0 * (time.perf_counter() - start))
                row["reflect_ms"].append(frame.timings.get("reflect", 0.0))
            frames[name] = frame
    return rows


def path_table(rows: list[dict]) -> None:
    """Print the rows of `walk` with a histogram each."""
    for row in rows:
        times = np.array(row["frames_ms"])
        p50, p95, p99 = np.percentile(times, (50, 95, 99))
        print(
            f"{row['stage']} {row['contender']} ({row['technique']}), {row['size'][0]}x{row['size'][1]}, "
            f"{row['threads']} thread(s), {row['machine']}: load {row['load_ms']:.0f} ms, first frame {row['first_ms']:.0f} "
            f"(prepare {row['prepare_ms']:.0f}); {len(times)} frames: p50 {p50:.1f} p95 {p95:.1f} p99 {p99:.1f} "
            f"worst {times.max():.1f} ms (number {int(times.argmax()) + 1}), reflections p50 {np.median(row['reflect_ms']):.1f}"
        )
        for line in histogram(times):
            print("  " + line)


def histogram(times: np.ndarray) -> list[str]:
    """Lines of a text histogram; what lies beyond the 99th percentile shares the last bin."""
    low, high = times.min(), np.percentile(times, 99)
    edges = np.linspace(low, max(high, low * 1.01), BINS + 1)
    counts = np.bincount(np.clip(np.searchsorted(edges, times, side="right") - 1, 0, BINS - 1), minlength=BINS)
    return [
        f"{edges[k]:8.1f} ms {'#' * round(BAR * count / counts.max()):{BAR}s} {count}" for k, count in enumerate(counts)
    ]


def slopes(stage: str, size: tuple[int, int], arguments) -> list[dict]:
    """Exponents of the reflections' time in what it depends on, one row per (quantity, contender)."""
    import warp_reflect as wr

    scene = wr.load_stage(stage, device=arguments.device)
    base = wr.Settings(threads=arguments.threads, keep_static=False, shadows="off")
    cases: dict[str, list[tuple[float, object, object]]] = {}
    methods = (arguments.method, "reference")

    def case(quantity: str, amount, of_scene, plan) -> None:
        cases.setdefault(quantity, []).append((float(amount), of_scene, plan))

    rows = []
    for method in methods:
        cases.clear()
        plan = wr.make_plan(scene, size=size, settings=base, method=method)
        for scale in PIXEL_SCALES:
            side = tuple(round(scale * each) for each in size)
            case("pixels", side[0] * side[1], scene, wr.make_plan(scene, size=side, settings=base, method=method))
        seen = sorted((row for row in plan.rows if row.pixels), key=lambda row: -row.pixels)
        for count in range(1, len(seen) + 1):
            # The mirrors left out are shaded as what they are, but reflect nothing.
            case("reflectors", count, scene, replace(plan, rows=seen[:count]))
        for count in range(1, thread_count(scene.device, 0) + 1):
            settings = base.replace(threads=count)
            case("threads", count, scene, wr.make_plan(scene, size=size, settings=settings, method=method))
        for finer in finer_scenes(stage, arguments.device):
            case("vertices", finer.vertex_count, finer, wr.make_plan(finer, size=size, settings=base, method=method))
        for quantity, points in cases.items():
            spent: list[list[float]] = [[] for _ in points]
            whole: list[list[float]] = [[] for _ in points]
            for round_ in range(arguments.frames + 1):
                for k, (_, of_scene, each) in enumerate(points):
                    frame = wr.render_frame(of_scene, each)
                    if round_:
                        spent[k].append(frame.timings.get("reflect", 0.0))
                        whole[k].append(frame.spent_ms)
            medians = [statistics.median(times) for times in spent]
            rows.append(
                common(stage, size, scene, arguments)
                | {
                    "contender": method,
                    "technique": ", ".join(sorted({row.technique for row in plan.rows})),
                    "quantity": quantity,
                    "amounts": [amount for amount, _, _ in points],
                    "reflect_ms": medians,
                    "frame_ms": [statistics.median(times) for times in whole],
                    "least_frame_ms": [min(times) for times in whole],
                    "slope": fitted_slope([amount for amount, _, _ in points], medians),
                }
            )
    return rows


def finer_scenes(stage: str, device: str) -> list:
    """A scene of `make_scenes.py` at several finenesses; empty for other stages."""
    import make_scenes

    import warp_reflect as wr

    name = Path(stage).stem
    if name not in make_scenes.SCENES:
        print(
            f"{stage}: no scene of make_scenes.py, so it has no finer version: no slope with vertices", file=sys.stderr
        )
        return []
    with tempfile.TemporaryDirectory() as folder:
        return [
            wr.load_stage(make_scenes.build(name, Path(folder) / f"{scale:g}" / f"{name}.usdc", scale), device=device)
            for scale in MESH_SCALES
            if (Path(folder) / f"{scale:g}").mkdir() is None
        ]


def fitted_slope(amounts: list[float], times: list[float]) -> float | None:
    """Exponent b of the least-squares fit times ~ amounts^b; None where there are fewer than two amounts."""
    if len(set(amounts)) < 2 or min(times) <= 0.0:
        return None
    return float(np.polyfit(np.log(amounts), np.log(times), 1)[0])


def slope_table(rows: list[dict]) -> None:
    """Print the rows of `slopes`."""
    print(f"{'stage':14s} {'contender':14s} {'grows with':11s} {'exponent':>8s}  reflections (ms) at")
    for row in rows:
        slope = "-" if row["slope"] is None else f"{row['slope']:.2f}"
        points = ", ".join(
            f"{time:.1f} at {amount:,.0f}" for amount, time in zip(row["amounts"], row["reflect_ms"], strict=True)
        )
        print(f"{row['stage']:14s} {row['contender']:14s} {row['quantity']:11s} {slope:>8s}  {points}")
        if row["quantity"] == "threads":
            # Others on the machine disturb several threads more than one: the least is nearer to a machine of one's own.
            frames = zip(row["frame_ms"], row["least_frame_ms"], row["amounts"], strict=True)
            told = ", ".join(f"{median:.1f} ({least:.1f}) at {amount:.0f}" for median, least, amount in frames)
            print(f"{'':42s} whole frames, median and least: {told}")


def table(rows: list[dict]) -> None:
    """Print the rows for a reader."""
    first = rows[0]
    print(f"{first['machine']}; warp {first['warp']}; {first['threads']} thread(s)")
    header = f"{'stage':14s} {'size':10s} {'contender':10s} {'reflect ms':>10s} {'p95':>7s} {'x ref':>6s} "
    header += f"{'frame ms':>9s} {'identical':>10s}"
    print(header + "  steps (ms)")
    for row in rows:
        same = (r for r in rows if (r["stage"], r["size"]) == (row["stage"], row["size"]))
        reference = next(r for r in same if r["contender"] == "reference")
        ratio = reference["reflect_ms"] / max(row["reflect_ms"], 1e-9)
        frame = f"{row['frame_ms']:9.1f}" if row["frame_ms"] is not None else " " * 9
        steps = ", ".join(
            f"{step.split('/')[-1]} {ms:.1f}" for step, ms in row["steps_ms"].items() if step != "reflect"
        )
        size = "x".join(map(str, row["size"]))
        print(
            f"{row['stage']:14s} {size:10s} {row['contender']:10s} {row['reflect_ms']:10.1f} {row['reflect_p95_ms']:7.1f} "
            f"{ratio:6.2f} {frame} {100 * row['identical']:9.4f}%  {steps}"
        )


if __name__ == "__main__":
    main()
