"""Plain against vector kernels, loop by loop: the same frames in one process, in turn.

    python tools/bench_kernels.py usd_scenes/one_mirror.usda --size 1280x720 --rounds 7

A row is a loop of the frame: its kernels' time with `kernels=plain` and `kernels=vector` (medians of this thread's processor
time, so that others on the machine count less), their ratio, and elements a second. The rasteriser's rows have culling and
order in them, not the projection of vertices; their elements are triangles, those that are culled too. The last rows are the
whole frame and, where it is installed, Embree's eye and mirror rays through embreex without shading (`wavefronts.Wavefront`).
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import statistics
import sys
import time
from collections import Counter
from pathlib import Path

import warp as wp

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import commit, machine, wavefront

EYE, VIRTUAL = "rasterise, eye view", "rasterise, virtual"
# Loop: kernels of either kind, or calls of the rasteriser. The plain search runs after the vector one, for what that leaves.
LOOPS = {
    EYE: (EYE,),
    VIRTUAL: (VIRTUAL,),
    "meet the mirror": ("mirror_pixels_kernel", "mirror_blocks_kernel"),
    "search reflection points": ("search_kernel", "search_blocks_kernel"),
    "step from a grid's directions": ("direction_kernel", "direction_lanes_kernel"),
    "refine": ("settle_kernel", "coarse_kernel", "settle_blocks_kernel", "coarse_blocks_kernel"),
    "shade": (
        "shade_kernel",
        "seen_radiance_kernel",
        "shade_blocks_kernel",
        "eye_weights_kernel",
        "direct_kernel",
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--rounds", type=int, default=7, help="timed frames of either kind, after one for warm-up")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    rows = bench(arguments)
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
        return
    print(f"{machine()}; warp {wp.__version__}; {commit()}; {arguments.stage} {arguments.size}, 1 thread, no shadows")
    print(f"{'loop':28s} {'plain ms':>9s} {'vector ms':>9s} {'ratio':>6s} {'M elements/s':>13s}")
    for row in rows:
        plain = " " * 9 if row["plain_ms"] is None else f"{row['plain_ms']:9.1f}"
        ratio = " " * 6 if row["plain_ms"] is None else f"{row['plain_ms'] / row['vector_ms']:6.2f}"
        rate = "" if not row["elements"] else f"{row['elements'] / row['vector_ms'] / 1000.0:13.1f}"
        print(f"{row['loop']:28s} {plain} {row['vector_ms']:9.1f} {ratio} {rate}")


def bench(arguments: argparse.Namespace) -> list[dict]:
    """Rows of one stage."""
    import warp_reflect as wr
    from warp_reflect import raster

    spent: Counter = Counter()
    run = wp.Launch.launch

    def timed(command, *given):
        start = time.thread_time()
        run(command, *given)
        spent[command.kernel.key] += 1000.0 * (time.thread_time() - start)

    rasterise = raster.rasterise
    triangles: Counter = Counter()

    def timed_raster(target, screen, drawn, **how):
        start = time.thread_time()
        result = rasterise(target, screen, drawn, **how)
        loop = VIRTUAL if target.view.ray.shape[0] > 0 else EYE
        spent[loop] += 1000.0 * (time.thread_time() - start)
        triangles[loop] += len(drawn)
        return result

    wp.Launch.launch, raster.rasterise = timed, timed_raster
    size = tuple(int(side) for side in arguments.size.split("x"))
    scene = wr.load_stage(arguments.stage)
    base = wr.Settings(threads=1, keep_static=False, shadows=False)
    plans = {
        kernels: wr.make_plan(scene, size=size, settings=base.replace(kernels=kernels), method=arguments.method)
        for kernels in ("plain", "vector")
    }
    frames = {kernels: wr.render_frame(scene, plan) for kernels, plan in plans.items()}
    wave = wavefront(scene, frames["vector"]) if importlib.util.find_spec("embreex") else None
    times: dict[str, list[Counter]] = {kernels: [] for kernels in plans}
    whole: dict[str, list[float]] = {kernels: [] for kernels in (*plans, "wavefront")}
    for round_ in range(arguments.rounds + 1):
        for kernels, plan in plans.items():
            spent.clear()
            triangles.clear()
            start = time.thread_time()
            frames[kernels] = wr.render_frame(scene, plan, previous=frames[kernels])
            if round_:
                whole[kernels].append(1000.0 * (time.thread_time() - start))
                times[kernels].append(spent.copy())
        if wave is not None:
            start = time.thread_time()
            wave.trace()
            if round_:
                whole["wavefront"].append(1000.0 * (time.thread_time() - start))
    pixels, mirror = size[0] * size[1], sum(layer.pixels.count for layer in frames["vector"].layers.values())
    elements = dict(triangles) | {
        "meet the mirror": mirror,
        "search reflection points": frames["vector"].statistics.get("vertices", 0),
        "refine": mirror,
        "shade": pixels + mirror,
    }
    rows = []
    for loop, kernels in LOOPS.items():
        ms = {
            kind: statistics.median(sum(each[kernel] for kernel in kernels) for each in times[kind]) for kind in plans
        }
        if ms["vector"] > 0.0:
            rows.append(row_of(loop, ms["plain"], ms["vector"], elements.get(loop, 0)))
    rows.append(row_of("frame", statistics.median(whole["plain"]), statistics.median(whole["vector"]), 0))
    if wave is not None:
        rows.append(row_of("embree wavefront, no shading", None, statistics.median(whole["wavefront"]), 0))
    return rows


def row_of(loop: str, plain: float | None, vector: float, elements: int) -> dict:
    return {"loop": loop, "plain_ms": plain, "vector_ms": vector, "elements": elements}


if __name__ == "__main__":
    main()
