"""How many rays a second go through a heightfield on one thread: both walks, over cities and hills, from several views.

    python tools/bench_heightfield.py --cells 1024 --rays 200000

CPU time of the thread, medians of rounds with both walks in turn; the share of rays that meet something and the mean steps of
either walk beside. The walks' answers are compared first.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np
import warp as wp

from warp_reflect import devices
from warp_reflect.heightfield import WALKS, make_heightfield, trace_heightfield

ROUNDS = 5
STREET = 0.012  # width of a street as a share of the field
GRAZING = 0.01  # slope of rays that graze


def fields(cells: int, rng) -> dict[str, np.ndarray]:
    """Name to heights, in columns."""
    x, y = np.meshgrid(np.arange(cells), np.arange(cells))
    pitch, street = max(cells // 24, 4), max(int(STREET * cells), 1)
    tall = rng.uniform(6.0, 40.0, (cells // pitch + 1, cells // pitch + 1))
    city = np.where((x % pitch < street) | (y % pitch < street), 0.0, tall[y // pitch, x // pitch])
    hills = 12.0 + 6.0 * np.sin(x / 37.0) + 5.0 * np.cos(y / 53.0) + np.sin((x + 2 * y) / 11.0)
    return {"city": city, "hills": hills}


def views(heights: np.ndarray, count: int, rng) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Name to (origins, directions), float64 [n, 3]."""
    cells = len(heights)
    turn = rng.uniform(0.0, 2.0 * np.pi, count)
    level = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    across = rng.uniform(0.0, cells, (count, 2))
    # A mirror on the ground: rays of one place, in all directions, ordered as pixels are.
    open_ = np.argwhere(heights <= np.median(heights))
    place = open_[len(open_) // 2][::-1] + 0.5
    ordered = np.sort(turn)
    fan = np.stack([np.cos(ordered), np.sin(ordered), rng.uniform(-0.2, 0.6, count)], axis=1)
    from_mirror = np.tile([*place, float(heights[int(place[1]), int(place[0])]) + 1.2], (count, 1))
    top = float(heights.max())
    edge = np.stack([np.zeros(count), np.linspace(0.0, cells, count), np.full(count, top * 0.9)], axis=1)
    ahead = np.stack([np.ones(count), rng.uniform(-0.3, 0.3, count), rng.uniform(-2.0, 0.5, count) * GRAZING], axis=1)
    steep = np.column_stack([0.3 * level, np.full(count, -1.0)])
    return {
        "grazing, from the edge": (edge, ahead),
        "from a mirror on the ground": (from_mirror, fan),
        "from above, steep": (np.column_stack([across, np.full(count, top + 5.0)]), steep),
        "from above, grazing": (
            np.column_stack([across, np.full(count, top + 1.0)]),
            np.column_stack([level, np.full(count, -5.0 * GRAZING)]),
        ),
    }


def measure(field, origins, directions) -> dict[str, tuple[float, float, float]]:
    """Walk to (million rays a second, share that meets something, steps a ray)."""
    rays = [wp.array(each.astype(np.float32), dtype=wp.vec3, device=field.device) for each in (origins, directions)]
    found = {walk: trace_heightfield(field, *rays, walk, threads=1) for walk in WALKS}
    for name in ("kind", "t", "cell", "status"):
        first, *others = (getattr(each, name).numpy() for each in found.values())
        assert all(np.array_equal(first, other) for other in others), name
    times = {walk: [] for walk in WALKS}
    for _ in range(ROUNDS):
        for walk in WALKS:
            start = time.thread_time()
            trace_heightfield(field, *rays, walk, threads=1)
            times[walk].append(time.thread_time() - start)
    return {
        walk: (
            1e-6 * len(origins) / statistics.median(times[walk]),
            float((each.kind.numpy() > 0).mean()),
            float(each.steps.numpy().mean()),
        )
        for walk, each in found.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=1024)
    parser.add_argument("--rays", type=int, default=200_000)
    arguments = parser.parse_args()
    device, rng = devices.open_device("cpu"), np.random.default_rng(5)
    print("| field | view | meet | cells, M rays/s | hierarchy, M rays/s | ratio | steps: cells | hierarchy |")
    print("|---|---|---:|---:|---:|---:|---:|---:|")
    for name, heights in fields(arguments.cells, rng).items():
        field = make_heightfield(heights, device=device)
        for view, rays in views(heights, arguments.rays, rng).items():
            found = measure(field, *rays)
            (plain, met, walked), (fast, _, stepped) = found["cells"], found["hierarchy"]
            print(
                f"| {name} | {view} | {100 * met:.0f} % | {plain:.2f} | {fast:.2f} | {fast / plain:.2f}x "
                f"| {walked:.1f} | {stepped:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
