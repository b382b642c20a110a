"""Render a frame of every USD file below a folder, each in a process of its own: what it cost and how it ended.

Usage: python tools/try_stages.py DIR [DIR ...] [--size 640x360] [--pictures DIR] [--jobs N] [--json FILE]

A file has to end with a picture and notes, or with one line that says why not (exit 2), within 60 seconds and 4 GB;
else the table says FAULT and the exit code is 1. Where a MANIFEST.md on the way has a table with the columns "stage"
and "must fail", a file named there must end as it says: an empty cell, "-" or "no" with a picture, all else with
exit 2.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
SIZE = "640x360"  # pixels
SECONDS = 60.0
MEMORY_MB = 4096
DONE, REFUSED = 0, 2
KIB_PER_MB = 1024.0  # of ru_maxrss, which Linux counts in KiB
MANIFEST, STAGE_COLUMN, FAIL_COLUMN = "MANIFEST.md", "stage", "must fail"
HARMLESS = ("", "-", "no")  # cells of that column that ask for a picture


@dataclass
class Row:
    """How one file ended; counts are 0 where it was refused."""

    stage: str
    triangles: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    megabytes: float = 0.0
    mirrors: int = 0
    notes: int = 0
    status: str = "drawn"  # or "refused", "FAULT"
    line: str = ""


def main() -> int:
    """Print the table and a summary; 1 if a file ended in anything but what it should."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--size", default=SIZE, help="of the picture, WIDTHxHEIGHT")
    parser.add_argument("--pictures", type=Path, help="folder to keep a PNG of every stage in")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        return render_one(arguments.folder[0], arguments.size, arguments.pictures)
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    files = [(p, p.name) for p in arguments.folder if p.is_file()]
    for folder in arguments.folder:
        files += [(p, str(p.relative_to(folder))) for p in sorted(folder.rglob("*")) if p.suffix in SUFFIXES]
    expected = {path.resolve(): fails for folder in arguments.folder for path, fails in expectations(folder).items()}
    print(
        f"{'triangles':>10} {'s':>6} {'cpu s':>6} {'MB':>6} {'mirrors':>7} {'notes':>5} {'status':7}  stage", flush=True
    )

    def judged(file: tuple[Path, str]) -> Row:
        row = try_one(*file, arguments.size, arguments.pictures)
        must_fail = expected.get(file[0].resolve())
        if row.status != "FAULT" and must_fail is not None and must_fail != (row.status == "refused"):
            row.line = f"{MANIFEST} says it must {'fail' if must_fail else 'be drawn'}; {row.line}".rstrip("; ")
            row.status = "FAULT"
        return row

    with ThreadPoolExecutor(arguments.jobs) as pool:
        rows = []
        for row in pool.map(judged, files):
            rows.append(row)
            print(
                f"{row.triangles:10,} {row.seconds:6.1f} {row.cpu_seconds:6.1f} {row.megabytes:6.0f} "
                f"{row.mirrors:7d} {row.notes:5d} {row.status:7}  {row.stage}" + (f": {row.line}" if row.line else ""),
                flush=True,
            )
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    print_summary(rows)
    return 1 if any(row.status == "FAULT" for row in rows) else 0


def expectations(folder: Path) -> dict[Path, bool]:
    """Whether each file that a MANIFEST in or below a folder lists must fail; those it does not say are left out."""
    found = {}
    for manifest in [*folder.rglob(MANIFEST)] if folder.is_dir() else [folder.parent / MANIFEST]:
        columns: list[str] = []
        for line in manifest.read_text().splitlines() if manifest.is_file() else ():
            if not line.startswith("|"):
                columns = []
                continue
            cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
            if not columns:
                columns = [cell.lower() for cell in cells]
            elif FAIL_COLUMN in columns and not set(line) <= set("|-: ") and len(cells) == len(columns):
                name = re.sub("[`*]", "", cells[columns.index(STAGE_COLUMN)])
                found[manifest.parent / name] = cells[columns.index(FAIL_COLUMN)].lower() not in HARMLESS
    return found


def print_summary(rows: list[Row]) -> None:
    """How many ended how, and the dearest of them."""
    if not rows:
        print("no USD file there")
        return
    ended = Counter(row.status for row in rows)
    print(
        f"{len(rows)} files: {ended['drawn']} drawn, {ended['refused']} refused with one line, {ended['FAULT']} faults"
    )
    for name in ("seconds", "cpu_seconds", "megabytes", "triangles", "notes"):
        worst = max(rows, key=lambda row: getattr(row, name))
        print(f"most {name}: {getattr(worst, name):,.0f} ({worst.stage})")


def try_one(path: Path, name: str, size: str, pictures: Path | None) -> Row:
    """Render one file in a child process and judge how it ended."""
    row = Row(name)
    command = [sys.executable, __file__, "--one", str(path), "--size", size]
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
        row.seconds, row.megabytes = time.perf_counter() - started, used.ru_maxrss / KIB_PER_MB
        row.cpu_seconds = used.ru_utime + used.ru_stime
        for stream in (out, err):
            stream.seek(0)
        answer = out.read().decode(errors="replace")
        told = [line for line in err.read().decode(errors="replace").splitlines() if line.strip()]
    if child.returncode == DONE:
        for key, value in json.loads(answer.splitlines()[-1]).items():
            setattr(row, key, value)
        if told:
            row.status, row.line = "FAULT", f"exit 0, but on standard error: {told[0]}"
    elif child.returncode == REFUSED and len(told) == 1:
        row.status, row.line = "refused", told[0]
    else:
        row.status = "FAULT"
        row.line = f"over {SECONDS:g} s" if row.seconds >= SECONDS else " | ".join(told[-1:]) or "silence"
        row.line = f"exit {child.returncode}: {row.line}"
    if row.megabytes > MEMORY_MB:
        row.status, row.line = "FAULT", f"over {MEMORY_MB} MB; {row.line}"
    return row


def render_one(path: Path, size: str, picture: Path | None) -> int:
    """The child: load, plan, render; the numbers as JSON on standard output, a refusal as one line."""
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_MB << 20, MEMORY_MB << 20))
    import numpy as np

    import warp_reflect as wr
    from warp_reflect.cli import REFUSALS
    from warp_reflect.devices import open_device
    from warp_reflect.pipeline import one_line

    open_device("cpu")
    try:
        scene = wr.load_stage(path)
        plan = wr.make_plan(scene, size=tuple(int(side) for side in size.split("x")), method="auto")
        frame = wr.render_frame(scene, plan)
        if picture is not None:
            frame.write(picture)
    except REFUSALS as error:
        print(one_line(error), file=sys.stderr)
        return REFUSED
    notes = [*scene.notes, *plan.notes]
    numbers = {"triangles": scene.triangle_count, "mirrors": len(plan.rows), "notes": len(notes)}
    for name in frame.keys():
        if not np.isfinite(frame[name]).all():
            numbers |= {"status": "FAULT", "line": f"not finite: {name}"}
    if len(set(notes)) < len(notes) or any("\n" in note.text for note in notes):
        numbers |= {"status": "FAULT", "line": "a note is told twice or is more than one line"}
    if scene.triangle_count and not frame["primId"].any():
        numbers.setdefault("line", "nothing of it is seen")
    print(json.dumps(numbers))
    return DONE


if __name__ == "__main__":
    raise SystemExit(main())
