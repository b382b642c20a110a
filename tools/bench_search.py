"""The search of reflection points in reflector maps: rate and error side by side, from every kind of start.

    python tools/bench_search.py usd_scenes/one_mirror.usda usd_scenes/kitchen.usda

The searches of three frames are kept and run again, plain and vector kernels in turn: *cold* ones of a first frame, *cut* ones
of what that frame tessellates (they start beside known points), *walking* ones of a camera that has walked 0.002 rad about the
mirrors, *still* ones of a frame that finds its own answers. A row is the largest search of its kind: medians of one thread's
processor time, vertices that were asked for a second, and how many pixels the pictures lie from those of a search that goes on
to TIGHT. Statuses are compared, too: plain and vector kernels are to agree in all of them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import commit, machine

TIGHT = 2.0e-7  # residual: as low as float32 goes
TIGHT_EVALUATIONS = 40


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--rounds", type=int, default=9, help="timed searches of either kind, after one for warm-up")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    size = tuple(int(side) for side in arguments.size.split("x"))
    rows = [row for stage in arguments.stages for row in bench(stage, size, arguments.rounds)]
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
        return
    print(f"{machine()}; warp {wp.__version__}; {commit()}; {arguments.size}, 1 thread")
    print(
        f"{'stage':14s} {'start':8s} {'vertices':>8s} {'plain ms':>8s} {'vector ms':>9s} {'ratio':>6s} {'M/s':>6s} "
        f"{'px 50 %':>8s} {'99 %':>8s} {'other statuses':>14s}"
    )
    for row in rows:
        print(
            f"{row['stage'][:14]:14s} {row['start']:8s} {row['vertices']:8d} {row['plain_ms']:8.2f} {row['vector_ms']:9.2f} "
            f"{row['plain_ms'] / row['vector_ms']:6.2f} {row['vertices'] / row['vector_ms'] / 1000.0:6.1f} "
            f"{row['px_50']:8.5f} {row['px_99']:8.5f} {row['other_statuses']:14d}"
        )


def bench(stage: str, size: tuple[int, int], rounds: int) -> list[dict]:
    """Rows of one stage."""
    import warp_reflect as wr
    from warp_reflect import sweep
    from warp_reflect.techniques import reflector_map
    from warp_reflect.techniques.vertices import copy_vertices, empty_vertices

    def copied(vertices):
        count = len(vertices.status)
        made = empty_vertices(count, "cpu", with_position=len(vertices.position) > 0)
        copy_vertices(made, vertices, count)
        return made

    search = reflector_map.search
    kept: list[tuple] = []

    def keeping(*given):
        *asked, out, _, _, _ = given
        kept.append((asked, copied(out)))
        search(*given)

    def largest(warm: bool):
        """The largest of the searches kept since the last call, none of which started otherwise."""
        found = max((each for each in kept if each[0][6] == warm), key=lambda each: len(each[0][0]), default=None)
        kept.clear()
        return found

    scene = wr.load_stage(stage)
    settings = wr.Settings(threads=1, keep_static=False, shadows="off")
    plan = wr.make_plan(scene, size=size, settings=settings, method="reflector_map")
    reflector_map.search = keeping
    try:
        first = wr.render_frame(scene, plan)
        pivot = sweep.mirrors_middle(first)
        if pivot is None:
            print(f"{stage}: no mirror is seen", file=sys.stderr)
            return []
        both = list(kept)
        starts = {"cold": largest(False)}
        kept.extend(both)
        starts["cut"] = largest(True)
        here, there = sweep.camera_path(plan.camera, pivot, 2)
        second = wr.render_frame(scene, plan, camera=here, previous=first)
        kept.clear()
        wr.render_frame(scene, plan, camera=there, previous=second)
        starts["walking"] = largest(True)
        wr.render_frame(scene, plan, camera=here, previous=second)
        starts["still"] = largest(True)
    finally:
        reflector_map.search = search

    rows = []
    for start, found in starts.items():
        if found is None:
            continue
        (points, own, map, frame, camera, chosen, warm), before = found
        asked = before.status.numpy() == 0
        spent: dict[str, list[float]] = {"plain": [], "vector": []}
        answers = {}
        for _ in range(rounds + 1):
            for kernels, times in spent.items():
                answers[kernels] = copied(before)
                begun = time.thread_time()
                search(points, own, map, frame, camera, chosen, warm, answers[kernels], "cpu", 1, kernels)
                times.append(1000.0 * (time.thread_time() - begun))
        tight = reflector_map.SearchSettings()
        tight.method, tight.accepted = chosen.method, chosen.accepted
        tight.iterations, tight.tolerance = TIGHT_EVALUATIONS, TIGHT
        exact = copied(before)
        wp.copy(exact.seed, answers["vector"].seed)
        search(points, own, map, frame, camera, tight, True, exact, "cpu", 1, "plain")
        status = {name: each.status.numpy() for name, each in (*answers.items(), ("exact", exact))}
        placed = asked & (status["vector"] == wr.Status.CONVERGED) & (status["exact"] == wr.Status.CONVERGED)
        px = np.hypot(*(answers["vector"].screen.numpy() - exact.screen.numpy())[placed, :2].T)
        rows.append(
            {
                "stage": Path(stage).stem,
                "size": list(size),
                "commit": commit(),
                "start": start,
                "vertices": int(asked.sum()),
                **{f"{kernels}_ms": statistics.median(times[1:]) for kernels, times in spent.items()},
                **{f"px_{k}": float(np.percentile(px, k)) for k in (50, 99)},
                "other_statuses": int((status["plain"] != status["vector"]).sum()),
            }
        )
    return rows


if __name__ == "__main__":
    main()
