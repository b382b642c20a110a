"""Frames of a world in which things move, beside tracers that build their trees anew: medians of rounds in turn.

    python tools/bench_moving.py usd_scenes/one_mirror.usda /World/Toys --size 1280x720 --threads 2
    python tools/bench_moving.py usd_scenes/kitchen.usda /World/Table --size 640x480 --threads 2

Every round, all that lies below the named prim is lifted a little. The package makes its scene from the one before, with a
tree that is refitted, and draws a frame, shading included, shadows off; Embree commits the moved triangles and traces eye and
mirror rays, without shading (embreex: from Python; packets: from C++, where `embree_packets.py` can build it). Where things
lie is told to all of them as arrays. `identical`: as in `peers.py`.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import commit, machine
from embree_packets import Packets
from wavefronts import Wavefront

import warp_reflect as wr
from warp_reflect.devices import open_device

LIFT = 1.0e-3  # a round, of the scene's size
WARM_UP = 2  # rounds


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("prim", help="what lies below it moves")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=9, help=f"timed rounds, after {WARM_UP} for warm-up")
    return parser.parse_args()


def movable(scene: wr.Scene, prim: str) -> wr.Scene:
    """The scene as that of a stage in which all below `prim` is animated."""
    marked = [
        dataclasses.replace(each, moves=True, mover=prim) if each.prim_path.startswith(prim.rstrip("/") + "/") else each
        for each in scene.source_data.instances
    ]
    return wr.Scene(dataclasses.replace(scene.source_data, instances=marked), str(scene.device))


def lifted(scene: wr.Scene, height: float) -> wr.Scene:
    """The scene at its next time: what is animated is higher by `height` along y; the rest is shared."""
    up = np.eye(4)
    up[1, 3] = height
    placed = [
        dataclasses.replace(each, world_from_object=up @ each.world_from_object) if each.moves else each
        for each in scene.source_data.instances
    ]
    return wr.Scene(dataclasses.replace(scene.source_data, instances=placed), str(scene.device), earlier=scene)


def main() -> None:
    arguments = parse()
    open_device("cpu")  # quietly
    size = tuple(int(side) for side in arguments.size.split("x"))
    scene = movable(wr.load_stage(arguments.stage), arguments.prim)
    moved = sum(len(scene.data.meshes[each.mesh].triangles) for each in scene.data.instances if each.moves)
    if not moved:
        sys.exit(f"no mesh lies below {arguments.prim} in {arguments.stage}; name a prim above some")
    settings = wr.Settings(threads=arguments.threads, shadows="off")
    plan = wr.make_plan(scene, size=size, settings=settings)
    frame, times, shares = None, {}, {}
    for round_ in range(arguments.rounds + WARM_UP):
        start = time.perf_counter()
        scene = lifted(scene, LIFT * scene.size * (-1) ** (round_ // 4))
        placed = time.perf_counter()
        frame = wr.render_frame(scene, plan, previous=frame)
        drawn = time.perf_counter()
        taken = {"this package: scene": placed - start, "this package: scene and frame": drawn - start}
        wave = Wavefront(scene, frame)
        start = time.perf_counter()
        wave.rebuild()
        taken["embreex: tree and wavefront"] = time.perf_counter() - start + wave.trace()[1] / 1000.0
        shares["embreex: tree and wavefront"] = wave.agreement()
        try:
            packets = Packets(wave, arguments.threads)
            taken["embree packets: tree and wavefront"] = (packets.rebuild() + packets.trace()) / 1000.0
            shares["embree packets: tree and wavefront"] = packets.agreement()
            packets.close()
        except RuntimeError as fault:
            if round_ == 0:
                print(f"embree packets: {fault}", file=sys.stderr)
        if round_ >= WARM_UP:
            for name, seconds in taken.items():
                times.setdefault(name, []).append(1000.0 * seconds)
    print(
        f"{machine()}; {arguments.threads} thread(s); {arguments.size}; {Path(arguments.stage).stem}: {moved:,} of "
        f"{scene.triangle_count:,} triangles move; medians of {arguments.rounds}; commit {commit()}"
    )
    own = statistics.median(times["this package: scene and frame"])
    for name, taken in times.items():
        share = f"{100.0 * shares[name]:9.3f}%" if name in shares else 10 * " "
        middle = statistics.median(taken)
        print(f"{name:36s} {middle:9.1f} ms  {middle / own:5.2f}x  {share}")


if __name__ == "__main__":
    main()
