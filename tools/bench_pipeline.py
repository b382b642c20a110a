"""Figures of frame ranges: workers, overhead, kills, races, memory, and the motion channel against the reference.

    python tools/bench_pipeline.py [usd_scenes/toy_room.usda] [--frames 200] [--size 640x360] [--only workers,motion]

A camera walks about the stage's own one. What is measured:

workers   the same range by one worker and by two, one core each, from the first frame's file to the last one's
overhead  what a frame costs in a range beside `render_frame` and `Frame.write`, and what the latter cost, in CPU time
kills     the command killed at random moments; every file must be whole, none that was whole is made again
race      two processes with the same output at once
memory    resident memory of the command along the range
motion    `reflectionMotion` of a moving eye and of a moving mirror, against the pictures of two reference frames: where
          the one before shows the same material point is found in its `reflectedPoint` channel by inverting it
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp
from moving_mirror import with_pose

import warp_reflect as wr
from warp_reflect import images, pipeline
from warp_reflect.launch import CORES_VARIABLE

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("workers", "overhead", "kills", "race", "memory", "motion")
STEP = 0.004  # of the distance to the mirror: the camera's walk from frame to frame
KILLS = 20
OVERHEAD_FRAMES = 10  # after two that warm up
SETTLED = 0.2  # of a range, after which its memory must be flat
NEIGHBOURS = 1  # pixels about the one that shows a point: the channel is inverted over their square
STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = {unit}
    upAxis = "{up}"
    startTimeCode = 1
    endTimeCode = {count}
    subLayers = [@{stage}@]
)
over "World"
{{
    def Camera "Walk"
    {{
        float2 clippingRange = ({near}, {far})
        float focalLength = {focal}
        float horizontalAperture = {width}
        float verticalAperture = {height}
        matrix4d xformOp:transform.timeSamples = {{ {samples} }}
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }}
}}
"""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", nargs="?", default=str(ROOT / "usd_scenes" / "toy_room.usda"))
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--size", default="640x360", help="WxH")
    parser.add_argument("--only", default=",".join(KINDS), help=f"some of {', '.join(KINDS)}")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    width, height = map(int, arguments.size.split("x"))
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        stage = walking(arguments.stage, arguments.frames, folder)
        for kind in arguments.only.split(","):
            lines, good = globals()[f"measure_{kind}"](stage, (width, height), arguments.frames, Path(folder))
            print("\n".join(f"{kind:9s} {line}" for line in lines), flush=True)
            failed += not good
    return 1 if failed else 0


def walking(stage: str, count: int, folder: str) -> str:
    """A layer over a stage with a camera that walks sideways, one step a time code."""
    scene = wr.load_stage(stage)
    camera = scene.data.cameras[0]
    pose = np.array(camera.world_from_camera, np.float64)
    plan = wr.make_plan(scene, size=(160, 90))
    mirror = max(plan.rows, key=lambda row: row.pixels).reflector.part
    part = scene.parts[mirror]
    corners = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
    gap = float(np.linalg.norm(scene.host_points[corners].mean(axis=(0, 1)) + scene.origin - pose[:3, 3]))
    samples = []
    for k in range(count):
        moved = pose.copy()
        moved[:3, 3] += STEP * gap * (k - 0.5 * count) * pose[:3, 0]
        rows = ", ".join("(" + ", ".join(f"{x:.9g}" for x in row) + ")" for row in moved.T)
        samples.append(f"{k + 1}: ({rows})")
    text = STAGE.format(
        unit=1.0,
        up=scene.data.up_axis,
        count=count,
        stage=Path(stage).resolve(),
        near=camera.near,
        far=camera.far,
        # USD gives film in tenths of scene units.
        focal=camera.focal_length,
        width=camera.horizontal_aperture,
        height=camera.vertical_aperture,
        samples=", ".join(samples),
    )
    path = Path(folder) / "walk.usda"
    path.write_text(text)
    return str(path)


def command(stage: str, size: tuple[int, int], count: int, out: str, *more: str) -> list[str]:
    start = [sys.executable, "-m", "warp_reflect.cli", "render", stage, out, "-cam", "/World/Walk"]
    return [*start, "-f", f"1:{count}", "--res", f"{size[0]}x{size[1]}", *more]


def one_core() -> dict[str, str]:
    return os.environ | {CORES_VARIABLE: "1", "OPENIMAGEIO_THREADS": "1"}


def measure_workers(stage, size, count, folder) -> tuple[list[str], bool]:
    spans, cpu = {}, {}
    for workers in (1, 2):
        out = folder / f"w{workers}"
        out.mkdir()
        scheduled = ["--workers", str(workers)] if workers > 1 else []
        before = children_seconds()
        run(command(stage, size, count, str(out / "a.####.exr"), *scheduled, "--progress", "none"), one_core())
        cpu[workers] = children_seconds() - before
        written = sorted(path.stat().st_mtime for path in out.iterdir())
        spans[workers] = written[-1] - written[0]
    same = all(
        (folder / "w1" / path.name).read_bytes() == path.read_bytes() for path in sorted((folder / "w2").iterdir())
    )
    ratio = spans[1] / spans[2]
    return [
        f"{count} frames at {size[0]}x{size[1]}: {spans[1]:.1f} s by one worker of one core, {spans[2]:.1f} s by two: "
        f"{ratio:.2f}x (asked: 1.8x); {'' if same else 'NOT '}the same bytes",
        f"CPU time in all, with starting the programs: {cpu[1]:.1f} s and {cpu[2]:.1f} s",
    ], same


def children_seconds() -> float:
    times = os.times()
    return times.children_user + times.children_system


def run(tokens: list[str], environment=None) -> subprocess.CompletedProcess:
    done = subprocess.run(tokens, capture_output=True, text=True, env=environment)
    if done.returncode:
        sys.exit(f"{' '.join(tokens)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return done


def measure_overhead(stage, size, count, folder) -> tuple[list[str], bool]:
    lines, few = [], min(count, OVERHEAD_FRAMES)
    for name, channels in (("PNG", None), ("EXR, R G B A and Z", ("RGBA", "Z")), ("EXR, all channels", None)):
        suffix = "png" if name == "PNG" else "exr"
        files = tuple((str(folder / f"o.{k:04d}.{suffix}"),) for k in range(few))
        times = tuple(float(k + 1) for k in range(few))
        job = pipeline.Job(stage, times, files, camera="/World/Walk", size=size, channels=channels)
        opened = pipeline.OpenJob(job)
        drawn, bare, whole, last = [], [], [], None
        # In turn, each on its own open job: what is measured first pays for what the caches do not hold.
        other = pipeline.OpenJob(job)
        for place in range(few):
            start = time.process_time()
            plan = other.plan_at(place)
            last = wr.render_frame(plan.scene, plan, previous=last if job.looks_back else None)
            rendered = time.process_time()
            last.write(str(folder / f"bare.{suffix}"), list(channels) if channels else None)
            written = time.process_time()
            (outcome,) = pipeline.render_places(job, [place], "", [opened])
            whole.append(time.process_time() - written)
            drawn.append(rendered - start)
            bare.append(written - start)
            if outcome.state != "written":
                return [f"{name}: {outcome.text}"], False
        a, b, c = (1000.0 * statistics.median(each[2:]) for each in (drawn, bare, whole))
        lines.append(
            f"{name}: {a:.1f} ms of CPU for a bare frame, {b:.1f} with its file written ({100.0 * (b / a - 1.0):+.1f} %), "
            f"{c:.1f} in a range: {100.0 * (c / b - 1.0):+.1f} %"
        )
    return [*lines, "(asked: at most 10 %)"], True


def measure_kills(stage, size, count, folder) -> tuple[list[str], bool]:
    few, size = min(count, 60), (size[0] // 4, size[1] // 4)
    out, rng = folder / "kills", random.Random(0)
    out.mkdir()
    whole, made_again, broken, kills, seconds = {}, 0, 0, 0, 0.0
    tokens = command(stage, size, few, str(out / "a.####.exr"), "--resume", "--progress", "none")
    while kills < KILLS:
        process = subprocess.Popen(tokens, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        start, seen = time.time(), len(whole)
        # From the start of the program to some frames on.
        wait = rng.uniform(0.0, 4.0 + 2.0 * seconds)
        while time.time() - start < wait and process.poll() is None:
            time.sleep(0.01)
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.wait()
        for path in out.glob("a.*.exr"):
            try:
                images.check_whole(path)
            except OSError:
                broken += 1
                continue
            made_again += path.name in whole and whole[path.name] != path.stat().st_mtime_ns
            whole[path.name] = path.stat().st_mtime_ns
        if len(whole) > seen:
            seconds = max(seconds, (time.time() - start) / 4.0)
        if len(whole) == few:  # all done before all kills: from the start again
            for path in out.glob("a.*.exr"):
                path.unlink()
            whole.clear()
    run(tokens)
    for path in out.glob("a.*.exr"):
        images.check_whole(path)
        made_again += path.name in whole and whole[path.name] != path.stat().st_mtime_ns
    complete = sorted(path.name for path in out.glob("a.*.exr")) == [f"a.{k:04d}.exr" for k in range(1, few + 1)]
    left = [path.name for path in out.iterdir() if not path.name.startswith("a.") and not path.name.endswith(".lock")]
    good = complete and not broken and not made_again and not left
    return [
        f"{kills} kills over {few} frames: {broken} broken files, {made_again} whole frames made again, {len(left)} parts "
        f"left after the last --resume, {'complete' if complete else 'NOT complete'}"
    ], good


def measure_race(stage, size, count, folder) -> tuple[list[str], bool]:
    few = min(count, 20)
    out = folder / "race"
    out.mkdir()
    tokens = command(stage, (size[0] // 4, size[1] // 4), few, str(out / "a.####.exr"), "--progress", "json")
    pair = [subprocess.Popen(tokens, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    states: list[dict[str, int]] = []
    for process in pair:
        _, err = process.communicate()
        events = [json.loads(line) for line in err.splitlines() if line.startswith("{")]
        told = [event["state"] for event in events if event["event"] == "frame"]
        states.append({state: told.count(state) for state in dict.fromkeys(told)})
    for path in out.glob("a.*.exr"):
        images.check_whole(path)
    complete = len(list(out.glob("a.*.exr"))) == few
    told = " and ".join(", ".join(f"{count} {state}" for state, count in each.items()) for each in states)
    return [
        f"two processes, {few} frames: {told}; exit {pair[0].returncode} and {pair[1].returncode}; all whole"
    ], complete


def measure_memory(stage, size, count, folder) -> tuple[list[str], bool]:
    out = folder / "memory"
    out.mkdir()
    tokens = command(
        stage, size, count, str(out / "a.####.exr"), "--progress", "json", "--aov", "RGBA,reflectionMotion"
    )
    process = subprocess.Popen(tokens, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    sizes = []
    for line in process.stderr:
        if line.startswith("{") and json.loads(line)["event"] == "frame":
            pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
            sizes.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
    process.wait()
    settled = sizes[round(SETTLED * count) :]
    slope = np.polyfit(range(len(settled)), settled, 1)[0]
    grown = max(settled[-10:]) - max(settled[:10])
    return [
        f"{count} frames at {size[0]}x{size[1]}: {settled[0]:.0f} MB, {grown:+.1f} MB from frame {count - len(settled)} to "
        f"{count} ({1000.0 * slope:+.1f} kB a frame)"
    ], process.returncode == 0


def measure_motion(stage, size, count, folder) -> tuple[list[str], bool]:
    scene = wr.load_stage(stage, time=1.0)
    lines, good = [], True
    plan = wr.make_plan(scene, "/World/Walk", size, method="reference")
    before = wr.render_frame(scene, plan)
    moved = wr.make_plan(scene.at(4.0), "/World/Walk", size).camera
    mirror = max(plan.rows, key=lambda row: row.pixels)
    pose = next(each for each in scene.data.instances if each.prim_path == mirror.path).world_from_object.copy()
    gap = float(np.linalg.norm(pose[:3, 3] - before.camera.eye))
    pose[:3, 3] += STEP * gap * np.array([1.0, 0.5, -0.7])
    turned = with_pose(scene, mirror.path, pose)
    cases = {
        "a moving eye": (scene, moved),
        f"{mirror.path.rpartition('/')[2]} moving": (turned, before.camera),
    }
    for name, (world, camera) in cases.items():
        for method in ("reference", "auto"):
            now = wr.render_frame(world, wr.make_plan(world, camera, size, method=method), previous=before)
            error, share = tracked(now, before, moving=mirror.path)
            median, most = np.quantile(error, [0.5, 0.99])
            good &= median <= 0.05 and most <= 0.5
            lines.append(
                f"{name}, {method}: median {median:.4f} px, 99 % {most:.3f} px of {len(error):,} pixels, {100 * share:.1f} % "
                "of those that show something in both (asked: 0.05 and 0.5)"
            )
    return lines, good


def tracked(now: wr.Frame, before: wr.Frame, moving: str) -> tuple[np.ndarray, float]:
    """Pixels between the motion channel and where `before` shows the same points of things that stand still.

    Args:
        now, before: Frames; only a mirror and the eye have moved.
        moving: The mirror's prim; where it is seen in other mirrors itself nothing is tracked.

    Returns:
        (errors of the pixels that could be tracked, their share of those that reflect something in both frames).
    """
    height, width = now["reflectedId"].shape
    ids, shown = before["reflectedId"], before.relative("reflectedPoint").astype(np.float64) + before.camera.eye
    mirrors = before["reflectorId"]
    motion, mirror = now["reflectionMotion"], now["reflectorId"]
    own = next(number for number, path in now.prims.items() if path == moving)
    y, x = np.nonzero((now["reflectedId"] > 0) & (now["reflectedId"] != own) & (np.abs(motion).max(axis=-1) > 0))
    target = now.relative("reflectedPoint")[y, x].astype(np.float64) + now.camera.eye
    place = np.stack([x + 0.5, y + 0.5], 1) - motion[y, x]
    column, row = (np.floor(place[:, k]).astype(int) for k in (0, 1))
    n = NEIGHBOURS
    inside = (column >= n) & (column < width - n) & (row >= n) & (row < height - n)
    candidates = int(inside.sum())
    y, x, target, place, column, row = (each[inside] for each in (y, x, target, place, column, row))
    around = [(dy, dx) for dy in range(-n, n + 1) for dx in range(-n, n + 1)]
    steady = np.ones(len(y), bool)
    for dy, dx in around:  # away from silhouettes: one thing in one mirror, in both frames
        at = row + dy, column + dx
        steady &= (ids[at] == now["reflectedId"][y, x]) & (mirrors[at] == mirror[y, x])
        there = np.clip(y + dy, 0, height - 1), np.clip(x + dx, 0, width - 1)
        steady &= (now["reflectedId"][there] == now["reflectedId"][y, x]) & (mirror[there] == mirror[y, x])
    y, x, target, place, column, row = (each[steady] for each in (y, x, target, place, column, row))
    # The channel as a quadratic of the pixel over the square, inverted by Gauss-Newton.
    offsets = np.array([(1.0, dx, dy, dx * dx, dx * dy, dy * dy) for dy, dx in around])
    points = np.stack([shown[row + dy, column + dx] for dy, dx in around], 1)
    fit = np.einsum("kj,njc->nkc", np.linalg.pinv(offsets), points - target[:, None])
    uv = place - np.stack([column + 0.5, row + 0.5], 1)
    start = uv.copy()
    for _ in range(8):
        u, v = uv[:, 0], uv[:, 1]
        one, zero = np.ones_like(u), np.zeros_like(u)
        miss = np.einsum("nk,nkc->nc", np.stack([one, u, v, u * u, u * v, v * v], 1), fit)
        slopes = np.stack(
            [
                np.einsum("nk,nkc->nc", np.stack([zero, one, zero, 2 * u, v, zero], 1), fit),
                np.einsum("nk,nkc->nc", np.stack([zero, zero, one, zero, u, 2 * v], 1), fit),
            ],
            2,
        )
        uv = uv - np.einsum("nij,nj->ni", np.linalg.pinv(slopes), miss)
    # Where the square bends (an edge of a box, a cut of two surfaces) a quadratic is no map of it.
    residual = points - target[:, None] - np.einsum("jk,nkc->njc", offsets, fit)
    span = np.linalg.norm(points - points.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    smooth = (np.linalg.norm(residual, axis=2).max(axis=1) < 0.02 * span) & (np.abs(uv) < n + 0.5).all(axis=1)
    far = (np.abs(uv) >= n + 0.5).any(axis=1) & (np.linalg.norm(residual, axis=2).max(axis=1) < 0.02 * span)
    error = np.linalg.norm(uv - start, axis=1)
    return np.where(far, np.maximum(error, 1.0), error)[smooth | far], float((smooth | far).sum()) / max(candidates, 1)


if __name__ == "__main__":
    sys.exit(main())
