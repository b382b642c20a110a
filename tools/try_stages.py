"""Load every USD file below a folder; one line each: what it holds, how long it took, what went wrong.

Usage: python tools/try_stages.py DIR [DIR ...]
"""

from __future__ import annotations

import argparse
import resource
import time
from pathlib import Path

from warp_reflect.stage.read import read_stage

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def main() -> int:
    """Print the table; 1 if a file ended in anything but data or a one-line ValueError."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="+")
    parser.add_argument("--notes", action="store_true", help="print every note below its stage")
    arguments = parser.parse_args()
    print(f"{'triangles':>10} {'inst':>6} {'mat':>4} {'lights':>6} {'cams':>4} {'s':>6} {'MB':>6} {'notes':>5}  stage")
    failed = 0
    for folder in arguments.folder:
        files = [folder] if folder.is_file() else sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES)
        for path in files:
            started = time.perf_counter()
            name = path.relative_to(folder) if path != folder else path
            try:
                data = read_stage(path)
            except (ValueError, FileNotFoundError) as fault:
                print(f"{'-':>10} {'':>41}  {name}  {fault}")
                failed += "\n" in str(fault)
                continue
            seconds = time.perf_counter() - started
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            triangles = sum(len(data.meshes[instance.mesh].triangles) for instance in data.instances)
            first = data.notes[0] if data.notes else None
            print(
                f"{triangles:10d} {len(data.instances):6d} {len(data.materials):4d} {len(data.lights):6d} "
                f"{len(data.cameras):4d} {seconds:6.2f} {peak:6.0f} {len(data.notes):5d}  {name}"
                + (f"  {first.path}: {first.text}"[:120] if first and not arguments.notes else "")
            )
            for note in data.notes if arguments.notes else ():
                print(f"{'':>12}{note.path}: {note.text}")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
