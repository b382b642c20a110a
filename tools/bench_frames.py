"""Time and error of whole frames and of the reflection pass, side by side, one process, contenders in turn.

    python tools/bench_frames.py usd_scenes/kitchen.usda usd_scenes/one_mirror.usda --size 1280x720 --frames 9

Per stage, on the same pixels with the same number of threads: the planned technique (cold: no history; warm: from the
previous frame), the project's own BVH reference (its best flags), and Embree through embreex where it is installed
(single rays in one call, one thread). Error and time stand on the same row. `--json` prints one JSON line per row.
"""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--frames", type=int, default=9, help="timed frames per contender, after two for warm-up")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--grid-share", type=float, default=0.05, help="share of the interpolation-grid row; 0: no row")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--preview", help="folder for pictures of the frames that were timed")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    wp.config.quiet = True
    width, height = (int(side) for side in arguments.size.split("x"))
    rows = []
    for stage in arguments.stages:
        rows += bench(stage, (width, height), arguments)
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
    else:
        table(rows)


def bench(stage: str, size: tuple[int, int], arguments) -> list[dict]:
    """Rows of one stage."""
    import warp_reflect as wr

    start = time.perf_counter()
    scene = wr.load_stage(stage, device=arguments.device)
    loaded = time.perf_counter() - start
    base = wr.Settings(threads=arguments.threads)
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
    embree_ms = []
    for round_ in range(arguments.frames + 2):
        for name, (plan, warm) in contenders.items():
            frame = wr.render_frame(scene, plan, previous=frames.get(name) if warm else None)
            frames[name] = frame
            if round_ >= 2:
                times[name].append(frame.timings)
        if embree:
            elapsed = embree.trace()
            if round_ >= 2:
                embree_ms.append(elapsed)
    common = {
        "stage": Path(stage).stem,
        "size": list(size),
        "threads": arguments.threads,
        "device": str(scene.device),
        "triangles": scene.triangle_count,
        "vertices": scene.vertex_count,
        "load_s": loaded,
        "first_picture_s": first_picture,
        "machine": machine(),
        "warp": wp.__version__,
        "commit": commit(),
    }
    rows = []
    for name, (plan, _) in contenders.items():
        comparison = wr.compare_frames(frames[name], frames["reference"])
        reflect = [timing.get("reflect", 0.0) for timing in times[name]]
        whole = [sum(ms for step, ms in timing.items() if "/" not in step) for timing in times[name]]
        steps = sorted({step for timing in times[name] for step in timing})
        rows.append(
            common
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
            common
            | {
                "contender": "embreex",
                "technique": "Embree, same rays, hits only",
                "reflect_ms": statistics.median(embree_ms),
                "reflect_p95_ms": float(np.percentile(embree_ms, 95)),
                "frame_ms": None,
                "steps_ms": {},
                "identical": embree.agreement(frames["reference"]),
                "wrong": None,
                "mirror_pixels": len(embree.origins),
                "statistics": {},
            }
        )
    return rows


class Embree:
    """The mirror rays of a frame through embreex: nearest triangle, one thread, one call for all rays.

    Rays start a step of 1e-4 of the scene's size along the normal, so that they do not meet their own facet.
    """

    def __init__(self, scene, frame):
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self.scene, scene.host_points, scene.host_triangles)
        pixels = [layer.pixels for layer in frame.layers.values()]
        self.order = list(frame.layers)
        self.counts = [p.count for p in pixels]
        step = 1.0e-4 * scene.size
        points = [p.point.numpy() + step * p.normal.numpy() for p in pixels]
        self.origins = np.ascontiguousarray(np.concatenate(points), np.float32)
        self.directions = np.ascontiguousarray(np.concatenate([p.direction.numpy() for p in pixels]), np.float32)
        self.hit = None

    @classmethod
    def over(cls, scene, frame):
        """None where embreex is not installed or nothing is reflected."""
        try:
            import embreex  # noqa: F401
        except ImportError:
            print("embreex is not installed: no Embree row", file=sys.stderr)
            return None
        return cls(scene, frame) if frame.layers else None

    def trace(self) -> float:
        """Milliseconds of one call."""
        start = time.perf_counter()
        self.hit = self.scene.run(self.origins, self.directions)
        return 1000.0 * (time.perf_counter() - start)

    def agreement(self, reference) -> float:
        """Share of rays with the reference's triangle (or none)."""
        mine = np.split(self.hit, np.cumsum(self.counts)[:-1])
        same = sum(
            int((hit == reference.layers[number].triangle.numpy()).sum())
            for number, hit in zip(self.order, mine, strict=True)
        )
        return same / max(len(self.hit), 1)


def machine() -> str:
    """Processor name and cores."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.split(":")[1].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        name = f"{names[0]}, {len(names)} cores" if names else name
    return name


def commit() -> str:
    """Short hash of the checkout, empty outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()


def table(rows: list[dict]) -> None:
    """Print the rows for a reader."""
    first = rows[0]
    print(
        f"{first['machine']}; warp {first['warp']}; {first['threads']} thread(s); {first['size'][0]}x{first['size'][1]}"
    )
    header = f"{'stage':14s} {'contender':10s} {'reflect ms':>10s} {'p95':>7s} {'x ref':>6s} "
    header += f"{'frame ms':>9s} {'identical':>10s}"
    print(header + "  steps (ms)")
    for row in rows:
        reference = next(r for r in rows if r["stage"] == row["stage"] and r["contender"] == "reference")
        ratio = reference["reflect_ms"] / max(row["reflect_ms"], 1e-9)
        frame = f"{row['frame_ms']:9.1f}" if row["frame_ms"] is not None else " " * 9
        steps = ", ".join(
            f"{step.split('/')[-1]} {ms:.1f}" for step, ms in row["steps_ms"].items() if step != "reflect"
        )
        print(
            f"{row['stage']:14s} {row['contender']:10s} {row['reflect_ms']:10.1f} {row['reflect_p95_ms']:7.1f} "
            f"{ratio:6.2f} {frame} {100 * row['identical']:9.4f}%  {steps}"
        )


if __name__ == "__main__":
    main()
