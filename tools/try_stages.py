"""Render a frame of every USD file below a folder, each in a process of its own: what it cost and how it ended.

Usage: python tools/try_stages.py DIR [DIR ...] [--pictures DIR] [--jobs N]

A file has to end with a picture and notes, or with one line that says why not, within the limits; else the
table says FAULT and the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SIZE = (640, 360)  # pixels
SECONDS = 60.0
MEMORY_MB = 4096.0
DONE, REFUSED = 0, 2
MEGABYTE = 1024.0  # of ru_maxrss, which Linux counts in KiB


@dataclass
class Row:
    """How one file ended; counts are 0 where it was refused."""

    stage: str
    triangles: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    mirrors: int = 0
    notes: int = 0
    refused: bool = False
    fault: bool = False
    line: str = ""


def main() -> int:
    """Print the table and a summary; 1 if a file ended in anything but a picture or one line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--pictures", type=Path, help="folder to keep a PNG of every stage in")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        return render_one(arguments.folder[0], arguments.pictures)
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    files = [(p, p.name) for p in arguments.folder if p.is_file()]
    for folder in arguments.folder:
        files += [(p, str(p.relative_to(folder))) for p in sorted(folder.rglob("*")) if p.suffix in SUFFIXES]
    print(f"{'triangles':>10} {'s':>6} {'MB':>6} {'mirrors':>7} {'notes':>5}  stage", flush=True)
    with ThreadPoolExecutor(arguments.jobs) as pool:
        rows = []
        for row in pool.map(lambda file: try_one(*file, arguments.pictures), files):
            rows.append(row)
            print(
                f"{row.triangles:10,} {row.seconds:6.1f} {row.megabytes:6.0f} {row.mirrors:7d} {row.notes:5d}  "
                f"{row.stage}" + (f"  {'FAULT: ' * row.fault}{row.line}" if row.line else ""),
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    print_summary(rows)
    return 1 if any(row.fault for row in rows) else 0


def print_summary(rows: list[Row]) -> None:
    """How many ended how, and the dearest of them."""
    if not rows:
        print("no USD file there")
        return
    faults = sum(row.fault for row in rows)
    refused = sum(row.refused and not row.fault for row in rows)
    print(f"{len(rows)} files: {len(rows) - refused - faults} drawn, {refused} refused with one line, {faults} faults")
    for name in ("seconds", "megabytes", "triangles"):
        worst = max(rows, key=lambda row: getattr(row, name))
        print(f"most {name}: {getattr(worst, name):,.0f} ({worst.stage})")


def try_one(path: Path, name: str, pictures: Path | None) -> Row:
    """Render one file in a child process and judge how it ended."""
    row = Row(name)
    command = [sys.executable, __file__, "--one", str(path)]
    if pictures is not None:
        command += ["--pictures", str(pictures / (name.replace("/", "__") + ".png"))]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        started = time.perf_counter()
        child = subprocess.Popen(command, stdout=out, stderr=err)
        killer = threading.Timer(SECONDS, child.kill)
        killer.start()
        _, status, used = os.wait4(child.pid, 0)
        killer.cancel()
        child.returncode = os.waitstatus_to_exitcode(status)
        row.seconds, row.megabytes = time.perf_counter() - started, used.ru_maxrss / MEGABYTE
        for stream in (out, err):
            stream.seek(0)
        answer = out.read().decode(errors="replace")
        told = [line for line in err.read().decode(errors="replace").splitlines() if line.strip()]
    if child.returncode == DONE:
        for key, value in json.loads(answer.splitlines()[-1]).items():
            setattr(row, key, value)
        if told:
            row.fault, row.line = True, f"exit 0, but on standard error: {told[0]}"
    elif child.returncode == REFUSED and len(told) == 1:
        row.refused, row.line = True, told[0]
    else:
        row.fault = True
        row.line = f"over {SECONDS:g} s" if row.seconds >= SECONDS else " | ".join(told[-1:]) or "silence"
        row.line = f"exit {child.returncode}: {row.line}"
    if row.megabytes > MEMORY_MB:
        row.fault, row.line = True, f"over {MEMORY_MB:g} MB; {row.line}"
    return row


def render_one(path: Path, picture: Path | None) -> int:
    """The child: load, plan, render; the numbers as JSON on standard output, a refusal as one line."""
    import numpy as np

    import warp_reflect as wr
    from warp_reflect import cli

    cli._open_device("cpu")
    try:
        scene = wr.load_stage(path)
        plan = wr.make_plan(scene, size=SIZE)
        frame = wr.render_frame(scene, plan)
        if picture is not None:
            frame.write(picture)
    except cli.REFUSALS as error:
        print(cli.one_line(error), file=sys.stderr)
        return REFUSED
    numbers = {"triangles": scene.triangle_count, "mirrors": len(plan.rows), "notes": len(scene.notes + plan.notes)}
    for name in frame.keys():
        if np.isnan(frame[name]).any():
            numbers |= {"fault": True, "line": f"NaN in {name}"}
    if scene.triangle_count and not frame["primId"].any():
        numbers["line"] = "nothing of it is seen"
    print(json.dumps(numbers))
    return DONE


if __name__ == "__main__":
    raise SystemExit(main())
