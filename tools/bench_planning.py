"""What planning costs: once for many prims, in every later frame, and a frame of a stage without mirrors beside one told so.

    python tools/bench_planning.py
    python tools/bench_planning.py --prims 2000 --mirrors 20 --stage usd_scenes/toy_room.usda --size 640x360

*Once*: the first plan of a scene of boxes and balls, some of them mirrors; kernels are loaded, nothing is known of the scene.
*Later*: the plan of a frame whose scene or camera has moved, over that frame's own time. *Without mirrors*: frames of that
stage planned as ever over frames of plans told to skip reflections (`--method none`), in turn. CPU time of one thread, medians.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import warp_reflect as wr
from warp_reflect import devices
from warp_reflect.calibrate import ball, square
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, Scene, SceneData

SIDE = 40.0  # of the floor
STEP = 0.02  # the camera's, a frame
CHROME = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)


def scene_of(prims: int, mirrors: int) -> Scene:
    """Balls over a floor, one of them a mirror now and then, each with its own matrix and material."""
    rng = np.random.default_rng(3)
    instances = [InstanceData(0, np.eye(4), "/floor", (0,))]
    for k in range(prims - 1):
        world = np.diag([0.3, 0.3, 0.3, 1.0])
        world[:3, 3] = rng.uniform((-SIDE / 2, 0.3, -SIDE / 2), (SIDE / 2, 2.0, SIDE / 2))
        shines = k % max((prims - 1) // max(mirrors, 1), 1) == 0 and k * mirrors < (prims - 1) * mirrors
        instances.append(InstanceData(1, world, f"/ball{k}", (1 if shines and mirrors else 2 + k % 8,)))
    materials = [MaterialData(), CHROME, *(MaterialData(base_color=(0.1 * k, 0.5, 0.4)) for k in range(8))]
    eye = np.eye(4)
    eye[:3, 3] = 0.0, 3.0, SIDE / 2
    sun = LightData(
        "/sun",
        "distant",
        (2.0, 2.0, 2.0),
        np.array([[1, 0, 0, 0], [0, 0.6, 0.8, 0], [0, -0.8, 0.6, 0], [0, 0, 0, 1.0]]),
    )
    data = SceneData(
        "prims", [square(8, SIDE / 2), ball()], instances, materials, [sun], [CameraData("/camera", eye, near=0.05)]
    )
    return Scene(data)


def spent(ask: Callable) -> tuple[object, float]:
    """(what it returns, milliseconds of this thread)."""
    start = time.thread_time()
    found = ask()
    return found, 1e3 * (time.thread_time() - start)


def once(prims: int, mirrors: int, size: tuple[int, int], repeats: int) -> float:
    asked = wr.Settings(threads=1)
    wr.make_plan(scene_of(prims, mirrors), size=size, settings=asked)
    scenes = [scene_of(prims, mirrors) for _ in range(repeats)]
    return statistics.median(
        spent(lambda scene=scene: wr.make_plan(scene, size=size, settings=asked))[1] for scene in scenes
    )


def later(scene: Scene, size: tuple[int, int], frames: int, is_read: bool) -> tuple[float, float]:
    """(milliseconds of planning, of the rest) of frames whose camera, and stage where it is read, moves."""
    plan = wr.make_plan(scene, size=size, settings=wr.Settings(threads=1))
    frame = wr.render_frame(scene, plan)
    times = []
    first = scene.data.time_range[0] if is_read else 0.0
    for k in range(frames + 2):
        eye = plan.camera.eye + STEP * plan.camera.right
        moved = scene.at(first + 1.0 + 0.5 * k) if is_read else scene
        camera = replace(plan.camera, eye=eye)
        made, planning = spent(
            lambda moved=moved, camera=camera, plan=plan: wr.make_plan(moved, camera, size, plan.settings, earlier=plan)
        )
        frame, rest = spent(lambda moved=moved, made=made, frame=frame: wr.render_frame(moved, made, previous=frame))
        plan, scene = made, moved
        times.append((planning, rest))
    return tuple(statistics.median(column) for column in zip(*times[2:], strict=True))


def without_mirrors(size: tuple[int, int], frames: int) -> tuple[float, float]:
    """(milliseconds of a frame of a stage without mirrors, of one told to skip reflections), planning included, in turn."""
    scene, asked = scene_of(100, 0), wr.Settings(threads=1, keep_static=False)
    times: dict[str, list[float]] = {"auto": [], "none": []}
    for k in range(frames + 2):
        for method, found in times.items():
            eye = np.array([STEP * k, 3.0, SIDE / 2])

            def whole(method=method, eye=eye) -> object:
                camera = replace(wr.make_plan(scene, size=size, settings=asked, method="none").camera, eye=eye)
                return wr.render_frame(scene, wr.make_plan(scene, camera, size, asked, method))

            found.append(spent(whole)[1])
    return tuple(statistics.median(found[2:]) for found in times.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prims", type=int, default=500)
    parser.add_argument("--mirrors", type=int, default=10)
    parser.add_argument("--stage", nargs="*", default=["usd_scenes/kitchen.usda", "usd_scenes/toy_room.usda"])
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--frames", type=int, default=9)
    arguments = parser.parse_args()
    size = tuple(int(side) for side in arguments.size.split("x"))
    devices.open_device("cpu")
    ms = once(arguments.prims, arguments.mirrors, size, 5)
    print(f"once, {arguments.prims} prims, {arguments.mirrors} mirrors: {ms:.0f} ms (asked: 100 for 500)")
    for stage in arguments.stage:
        scene = wr.load_stage(stage)
        for is_read in (False, True) if scene.data.time_range else (False,):
            planning, rest = later(scene, size, arguments.frames, is_read)
            what = "stage and camera move" if is_read else "camera moves"
            share = planning / (planning + rest)
            print(f"later, {stage}, {what}: {planning:.2f} of {planning + rest:.0f} ms, {share:.1%} (asked: 2 %)")
    planned, told = without_mirrors(size, arguments.frames)
    print(
        f"without mirrors: {planned:.1f} ms, told to skip reflections {told:.1f} ms, {planned / told:.3f}x (asked: 1.02)"
    )


if __name__ == "__main__":
    main()
