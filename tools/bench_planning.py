"""What planning costs: once for many prims, in every later frame, and a frame of a stage without mirrors beside one told so.

    python tools/bench_planning.py
    python tools/bench_planning.py --foretold usd_scenes/*.usda
    python tools/bench_planning.py --prims 2000 --mirrors 20 --stage usd_scenes/toy_room.usda --size 640x360

*Once*: the first plan of a scene of balls, some of them mirrors; kernels are loaded, nothing is known of the scene. *Later*: the
plan of a frame whose scene or camera has moved, over the whole frame's time. The eye's view is drawn for the plan and used by the
frame: it counts as the frame's. *Without mirrors*: frames of that stage planned as ever over frames of plans told to skip
reflections (`--method none`), in turn. CPU time of one thread, medians.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import warp_reflect as wr
from warp_reflect import devices
from warp_reflect.calibrate import square
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, MeshData, Scene, SceneData
from warp_reflect.timing import counted_by

SIDE = 40.0  # of the floor
STEP = 0.02  # the camera's, a frame
CHROME = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
ROWS = 8  # of a ball's facets, from pole to pole: 500 balls have 112,000


def ball() -> MeshData:
    """A sphere of radius 1 with its normals."""
    columns = 2 * ROWS
    theta, phi = np.meshgrid(np.linspace(0, np.pi, ROWS + 1), np.arange(columns) * np.pi / ROWS, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points[0], points[-1] = (0, 1, 0), (0, -1, 0)
    points = points.reshape(-1, 3).astype(np.float32)
    i = np.arange(ROWS * columns)
    right = i // columns * columns + (i + 1) % columns
    upper, lower = np.stack([i, right, i + columns], 1), np.stack([right, right + columns, i + columns], 1)
    # Those at the poles have a side of no length.
    faces = np.concatenate([upper[i >= columns], lower[i < (ROWS - 1) * columns]])
    return MeshData(points, faces.astype(np.int32), points)


def scene_of(prims: int, mirrors: int) -> Scene:
    """Balls over a floor, some of them mirrors, each with its own matrix and material."""
    rng = np.random.default_rng(3)
    shining = {k * (prims - 1) // mirrors for k in range(mirrors)}
    instances = [InstanceData(0, np.eye(4), "/floor", (0,))]
    for k in range(prims - 1):
        world = np.diag([0.3, 0.3, 0.3, 1.0])
        world[:3, 3] = rng.uniform((-SIDE / 2, 0.3, -SIDE / 2), (SIDE / 2, 2.0, SIDE / 2))
        instances.append(InstanceData(1, world, f"/ball{k}", (1 if k in shining else 2 + k % 8,)))
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


def planned(*asked, **more) -> tuple[wr.Plan, float, float]:
    """(a plan, milliseconds that deciding took, those of the eye's view that it drew for the frame)."""
    made, ms = spent(lambda: wr.make_plan(*asked, **more))
    view = 0.0 if made._seen is None else sum(made._seen.ms.values())
    return made, ms - view, view


def once(prims: int, mirrors: int, size: tuple[int, int], repeats: int) -> tuple[float, float]:
    """Milliseconds of deciding for a scene that nothing is known of, and for one that is ready to be traced."""
    asked = wr.Settings(threads=1)
    wr.make_plan(scene_of(prims, mirrors), size=size, settings=asked)
    times: dict[bool, list[float]] = {False: [], True: []}
    for is_ready, found in 2 * repeats * [*times.items()]:
        scene = scene_of(prims, mirrors)
        if is_ready:
            _ = scene.tracer.id, scene.triangle_records, scene.lights, scene.shadow_tracer.id
        found.append(planned(scene, size=size, settings=asked)[1])
    return statistics.median(times[False]), statistics.median(times[True])


def later(scene: Scene, size: tuple[int, int], frames: int, is_read: bool) -> tuple[float, float, float]:
    """(milliseconds of deciding, of the eye's view, of the rest) of frames whose camera, and stage where it is read, moves."""
    plan = wr.make_plan(scene, size=size, settings=wr.Settings(threads=1))
    frame = wr.render_frame(scene, plan)
    times = []
    first = scene.data.time_range[0] if is_read else 0.0
    for k in range(frames + 2):
        eye = plan.camera.eye + STEP * plan.camera.right
        moved = scene.at(first + 1.0 + 0.5 * k) if is_read else scene
        camera = replace(plan.camera, eye=eye)
        plan, deciding, view = planned(moved, camera, size, plan.settings, earlier=plan)
        frame, rest = spent(lambda moved=moved, plan=plan, frame=frame: wr.render_frame(moved, plan, previous=frame))
        scene = moved
        times.append((deciding, view, rest))
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


def foretold(stages: list[str], widths: list[int]) -> None:
    """Print what first frames were predicted to take beside what they took, after one that loaded kernels."""
    print("| stage | size | predicted ms | realised | ratio |\n|---|---|--:|--:|--:|")
    for stage, width in itertools.product(stages, widths):
        scene, size = wr.load_stage(stage), (width, width * 9 // 16)
        asked = {"size": size, "settings": wr.Settings(threads=1)}
        wr.render_frame(scene, wr.make_plan(scene, **asked))
        frame = wr.render_frame(scene, wr.make_plan(scene, **asked))
        ratio = frame.expected_ms / frame.spent_ms
        print(
            f"| {stage} | {width}x{size[1]} | {frame.expected_ms:.0f} | {frame.spent_ms:.0f} | {ratio:.2f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prims", type=int, default=500)
    parser.add_argument("--mirrors", type=int, default=10)
    parser.add_argument("--stage", nargs="*", default=["usd_scenes/kitchen.usda", "usd_scenes/toy_room.usda"])
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--frames", type=int, default=9)
    parser.add_argument(
        "--foretold", nargs="+", metavar="STAGE", help="instead: first frames, predicted beside realised"
    )
    parser.add_argument("--widths", type=int, nargs="+", default=[160, 320, 640], help="of these")
    arguments = parser.parse_args()
    size = tuple(int(side) for side in arguments.size.split("x"))
    devices.open_device("cpu")
    if arguments.foretold:
        with counted_by(time.thread_time):
            foretold(arguments.foretold, arguments.widths)
        return
    with counted_by(time.thread_time):
        ms, ready = once(arguments.prims, arguments.mirrors, size, 3)
        print(
            f"once, {arguments.prims} prims, {arguments.mirrors} mirrors: {ms:.0f} ms, {ready:.0f} of them not for what frames "
            "trace and shade by (asked: 100 for 500)"
        )
        for stage in arguments.stage:
            scene = wr.load_stage(stage)
            for is_read in (False, True) if scene.data.time_range else (False,):
                deciding, view, rest = later(scene, size, arguments.frames, is_read)
                what = "stage and camera move" if is_read else "camera moves"
                whole = deciding + view + rest
                print(f"later, {stage}, {what}: {deciding:.2f} of {whole:.0f} ms, {deciding / whole:.1%} (asked: 2 %)")
    made, told = without_mirrors(size, arguments.frames)
    print(f"without mirrors: {made:.1f} ms, told to skip reflections {told:.1f} ms, {made / told:.3f}x (asked: 1.02)")


if __name__ == "__main__":
    main()
