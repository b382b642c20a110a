"""Warm frames on a CUDA device: by the wall's clock, what of it is the host's, and what the device does, kernel by kernel.

    python tools/device_frames.py usd_scenes/one_mirror.usda usd_scenes/kitchen.usda --set shadows=off
    python tools/device_frames.py usd_scenes/one_mirror.usda --method quadric --size 1920x1080 --kernels 20
    python tools/device_frames.py usd_scenes/one_mirror.usda --method reference --set bounces=1

The camera walks to the side; frames are waited for one by one. The device's work is that of one frame, every kernel, fill and
copy in it: below the wall's time, the device waits for the host. A second line, `captured`, is that of the same frames as one
graph (`wr.capture_frame`), or says why there is none.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect import captured
from warp_reflect.devices import open_device

STEP = 1.0e-4  # of the distance to the scene's origin: how far the eye moves between frames
WARM_UP = 3  # frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting")
    parser.add_argument("--frames", type=int, default=9, help="timed ones")
    parser.add_argument("--kernels", type=int, default=9, metavar="N", help="the N that take longest are listed")
    parser.add_argument("--device", default="cuda:0")
    arguments = parser.parse_args()
    device = wp.get_device(open_device(arguments.device))
    if not device.is_cuda:
        sys.exit(f"--device: got {arguments.device}, expected a CUDA device; bench_frames.py times frames on a CPU")
    size = tuple(int(side) for side in arguments.size.split("x"))
    asked = dict(item.split("=", 1) for item in arguments.set)
    print(f"{device.name}, Warp {wp.config.version}, {arguments.size}")
    for stage in arguments.stages:
        scene = wr.load_stage(stage, device=str(device))
        settings = wr.Settings(keep_static=False).replace(**asked)
        plan = wr.make_plan(scene, size=size, settings=settings, method=arguments.method)
        wall, host, steps, work = timed(scene, plan, arguments.frames, partial(wr.render_frame, scene, plan))
        techniques = ", ".join(sorted({row.technique for row in plan.rows}))
        total, count = sum(ms for _, ms in work.values()), sum(times for times, _ in work.values())
        print(
            f"{Path(stage).stem} ({techniques}): {wall:.2f} ms, the host {host:.2f}, the device {total:.2f} in {count} pieces"
        )
        print("  " + ", ".join(f"{step} {ms:.2f}" for step, ms in steps.items()))
        for name, (times, ms) in sorted(work.items(), key=lambda item: -item[1][1])[: arguments.kernels]:
            print(f"  {ms:8.3f} ms {times:4d} times {name}")
        why = captured.why_not(scene, plan)
        if why:
            print(f"  captured: none, {why}")
            continue
        wall, host, _, work = timed(scene, plan, arguments.frames, wr.capture_frame(scene, plan).render)
        total = sum(ms for _, ms in work.values())
        print(f"  captured: {wall:.2f} ms, the host {host:.2f}, the device {total:.2f}")


def timed(
    scene: wr.Scene, plan: wr.Plan, frames: int, draw: Callable[..., wr.Frame]
) -> tuple[float, float, dict, dict]:
    """Medians of a frame until it is done, and until the host is; of its steps; name to (times, ms) of the device's work.

    Args:
        scene, plan: What is drawn.
        frames: Those timed.
        draw: (camera, previous frame) -> frame.
    """
    wall, host, steps, frame = [], [], defaultdict(list), None
    distance = np.linalg.norm(plan.camera.eye - scene.origin)
    for k in range(WARM_UP + frames):
        view = replace(plan.camera, eye=plan.camera.eye + STEP * k * distance * plan.camera.right)
        wp.synchronize_device(scene.device)
        start = time.perf_counter()
        frame = draw(view, previous=frame)
        left = time.perf_counter()
        wp.synchronize_device(scene.device)
        if k >= WARM_UP:
            wall.append(1000.0 * (time.perf_counter() - start))
            host.append(1000.0 * (left - start))
            for step, ms in frame.timings.items():
                steps[step].append(ms)
    wp.timing_begin(cuda_filter=wp.TIMING_ALL)
    draw(plan.camera, previous=frame)
    work: dict[str, tuple[int, float]] = {}
    for result in wp.timing_end():
        times, ms = work.get(result.name, (0, 0.0))
        work[result.name] = times + 1, ms + result.elapsed
    medians = {step: statistics.median(values) for step, values in steps.items()}
    return statistics.median(wall), statistics.median(host), medians, work


if __name__ == "__main__":
    main()
