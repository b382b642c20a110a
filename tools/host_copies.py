"""What one warm frame copies between the host and its device, and where it waits for it; needs no GPU.

    python tools/host_copies.py usd_scenes/one_mirror.usda usd_scenes/kitchen.usda --size 320x180
    python tools/host_copies.py usd_scenes/torus.usda --method reflector_map --set grid_share=0.1

A CUDA device runs the plain kernels, launched over whole arrays: here they run on the CPU, told to go the device's way
(`launch.as_device`), and every array that is read or made from host memory in between is counted, by the line of the package
that asks for it. A read is a copy that waits for all work before it. The third frame of a moving eye is counted, without its
picture.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect import launch

PACKAGE = Path(wr.__file__).parent
SYNCHRONISING = ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event")
STEP = 1.0e-3  # of the distance to the scene's origin: how far the eye moves between frames


@dataclass(frozen=True)
class Copy:
    """One copy, or one wait.

    Attributes:
        kind: `read` (device to host), `write` (host to device) or `wait`.
        place: Of the line of the package that asks for it, `techniques/grid.py:311`.
        bytes: That are copied.
    """

    kind: str
    place: str
    bytes: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", default="320x180", help="WxH")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    size = tuple(int(side) for side in arguments.size.split("x"))
    asked = dict(item.split("=", 1) for item in arguments.set)
    for stage in arguments.stages:
        copies = of_warm_frame(wr.load_stage(stage), size, arguments.method, **asked)
        print(f"{stage} {arguments.size} {arguments.method}: {summary(copies)}")
        rows = Counter((copy.kind, copy.place) for copy in copies)
        for (kind, place), times in sorted(rows.items(), key=lambda row: -bytes_of(copies, *row[0])):
            print(f"  {kind:5s} {place:40s} {times:4d} times {bytes_of(copies, kind, place):10d} bytes")


def summary(copies: list[Copy]) -> str:
    """How many of either kind, and how much."""
    return ", ".join(
        f"{sum(copy.kind == kind for copy in copies)} {kind}s of {bytes_of(copies, kind)} bytes"
        for kind in ("read", "write", "wait")
    )


def bytes_of(copies: list[Copy], kind: str, place: str | None = None) -> int:
    """Bytes of copies of a kind, from one place or all."""
    return sum(copy.bytes for copy in copies if copy.kind == kind and place in (None, copy.place))


def of_warm_frame(scene: wr.Scene, size: tuple[int, int], method: str = "auto", **settings) -> list[Copy]:
    """The copies of the third frame of a moving eye, drawn with the plain kernels on a device's way."""
    chosen = wr.Settings(kernels="plain", threads=1).replace(**settings)
    with launch.as_device():
        plan = wr.make_plan(scene, size=size, settings=chosen, method=method)
        frame = None
        for k in range(3):
            moved = STEP * k * np.linalg.norm(plan.camera.eye - scene.origin) * plan.camera.right
            with counted() as copies:
                frame = wr.render_frame(scene, plan, replace(plan.camera, eye=plan.camera.eye + moved), previous=frame)
    return copies


@contextmanager
def counted() -> Iterator[list[Copy]]:
    """Gives a list that gets every copy and wait in the context, on all threads."""
    found: list[Copy] = []
    busy = []  # of a copy that is made of others, the outermost counts

    def outermost(kind: str, size: int, do):
        place = None if busy else _place()
        busy.append(True)
        try:
            return do()
        finally:
            busy.pop()
            if place is not None and (size or kind == "wait"):
                found.append(Copy(kind, place, size))

    made, read, assigned = wp.array.__init__, wp.array.numpy, wp.array.assign
    waits = {name: getattr(wp, name) for name in SYNCHRONISING}

    def make(self, data=None, *args, **named):
        if data is None or isinstance(data, wp.array):
            made(self, data, *args, **named)
            return
        outermost("write", 0, lambda: made(self, data, *args, **named))
        if not busy and self.size:
            found.append(Copy("write", _place(), _bytes(self)))

    def assign(self, source):
        if isinstance(source, wp.array):
            assigned(self, source)
        else:
            outermost("write", _bytes(self), lambda: assigned(self, source))

    wp.array.__init__ = make
    wp.array.numpy = lambda self, **named: outermost("read", _bytes(self), lambda: read(self, **named))
    wp.array.assign = assign
    for name, wait in waits.items():
        setattr(wp, name, lambda *args, _wait=wait: outermost("wait", 0, lambda: _wait(*args)))
    try:
        yield found
    finally:
        wp.array.__init__, wp.array.numpy, wp.array.assign = made, read, assigned
        for name, wait in waits.items():
            setattr(wp, name, wait)


def _bytes(array: wp.array) -> int:
    return array.size * wp.types.type_size_in_bytes(array.dtype)


def _place() -> str:
    frame = sys._getframe(1)
    while frame is not None and not frame.f_code.co_filename.startswith(f"{PACKAGE}{os.sep}"):
        frame = frame.f_back
    return "elsewhere" if frame is None else f"{Path(frame.f_code.co_filename).relative_to(PACKAGE)}:{frame.f_lineno}"


if __name__ == "__main__":
    main()
