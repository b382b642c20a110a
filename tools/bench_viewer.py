"""Figures of the inspector, off screen: the first picture, frames a second while a hand orbits, memory, what closing frees.

    python tools/bench_viewer.py [usd_scenes/kitchen.usda] [--size 640x480] [--window 1680x1000] [--frames 1000]

The first picture is timed from the start of a program of its own, as `warp-reflect view` starts, with cached kernels. The
hand drags over the frame's pane in small steps; every step draws the moving picture. CPU time stands beside the wall clock,
which others on the machine lengthen.
"""

from __future__ import annotations

import argparse
import gc
import os
import statistics
import subprocess
import sys
import time
import weakref
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect.viewer import inspector
from warp_reflect.viewer.session import Session

ROOT = Path(__file__).resolve().parents[1]
STRIDE = 3  # pixels of the hand from one step to the next
SETTLED = 100  # frames, after which memory must be flat
FIRST = """
import time
start = time.time()
from warp_reflect.viewer import inspector
from warp_reflect.viewer.session import Session
import warp_reflect as wr
session = Session(wr.load_stage({stage!r}), size={size})
picture, busy = time.time(), time.process_time()
window = inspector.Inspector(session, off_screen=True, window_size={window})
print("first", picture - start, busy, time.time() - start, time.process_time())
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", nargs="?", default=str(ROOT / "usd_scenes" / "kitchen.usda"))
    parser.add_argument("--size", default="640x480", help="WxH of the frame")
    parser.add_argument("--window", default="1680x1000", help="WxH of all panes")
    parser.add_argument("--frames", type=int, default=1000)
    arguments = parser.parse_args()
    size, window_size = (tuple(map(int, text.split("x"))) for text in (arguments.size, arguments.window))
    wp.config.log_level = wp.LOG_WARNING
    for _ in range(2):  # the first fills the caches
        told = subprocess.run(
            [sys.executable, "-c", FIRST.format(stage=arguments.stage, size=size, window=window_size)],
            capture_output=True,
            text=True,
            check=True,
        )
    line = next(line for line in told.stdout.splitlines() if line.startswith("first"))
    numbers = [f"{float(word):.1f} s" for word in line.split()[1:]]
    print("first picture {} after the start ({} of CPU), all panes {} ({}), cached kernels".format(*numbers))
    session = Session(wr.load_stage(arguments.stage), size=size)
    window = inspector.Inspector(session, off_screen=True, window_size=window_size)
    walls, cpus, sizes = orbit(window, arguments.frames)
    wall, cpu = statistics.median(walls), statistics.median(cpus)
    print(
        f"orbit at {size[0]}x{size[1]}: {1.0 / wall:.1f} frames a second by the clock, {1.0 / cpu:.1f} by CPU time; "
        f"slowest of a hundred {1e3 * float(np.quantile(walls, 0.99)):.0f} ms"
    )
    grown = statistics.median(sizes[-SETTLED:]) - statistics.median(sizes[SETTLED : 2 * SETTLED])
    print(f"memory: {sizes[-1]:.0f} MB, {grown:+.1f} MB from frame {SETTLED} to {len(sizes)}")
    held = [weakref.ref(each) for each in (window, session, session.scene, session.frame, session.plan)]
    window.plotter.close()
    del window, session
    gc.collect()
    left = sum(each() is not None for each in held)
    print(f"closed: {left} of inspector, session, scene, frame and plan are still held; {resident_mb():.0f} MB")
    return 1 if left else 0


def orbit(window, count: int) -> tuple[list[float], list[float], list[float]]:
    """Drag in circles: (seconds, CPU seconds, resident MB) of every frame."""
    interactor = window.plotter.iren.interactor
    x, y = window.frame_place(0.5 * window.session.size[0], 0.3 * window.session.size[1])

    def send(event: str, x: float, y: float) -> None:
        interactor.SetEventInformation(round(x), round(y), 0, 0, "\0", 0, None)
        interactor.InvokeEvent(event)

    walls, cpus, sizes = [], [], []
    send("LeftButtonPressEvent", x, y)
    for k in range(count):
        turn = 2.0 * np.pi * k / 120.0
        x, y = x + STRIDE * np.cos(turn), y + STRIDE * np.sin(turn)
        start, busy = time.perf_counter(), time.process_time()
        send("MouseMoveEvent", x, y)
        walls.append(time.perf_counter() - start)
        cpus.append(time.process_time() - busy)
        sizes.append(resident_mb())
    send("LeftButtonReleaseEvent", x, y)
    return walls, cpus, sizes


def resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    sys.exit(main())
