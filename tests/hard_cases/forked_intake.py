"""Reads hostile stages in forked children of one warm process: `python forked_intake.py CASES.json OUTCOMES.json`.

A child runs what a child of `read_untrusted` runs (`warp_reflect.stage.child`) under the same memory limit, or, for a
case with a `command`, the `main` of the command line; both with a limit of computing time and under an alarm. The
parent has imported everything and started neither Warp nor a thread. Its own process, so that a test run with Warp,
threads and open files is never forked.
"""

from __future__ import annotations

import gc
import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path

import numpy as np

SECONDS = 20  # of computing
COMMAND_SECONDS = 300  # of computing: kernels may have to be compiled
STUCK = 15  # times that by the clock: a busy machine may take long over what a child computes, but nothing may wait for ever
MEMORY_BYTES = 4 * 2**30
OUTPUT_BYTES = 512 * 2**20  # what a child may write into one file


def main(cases_file: str, outcomes_file: str) -> None:
    cases = json.loads(Path(cases_file).read_text())
    # Warm: the children find all of it loaded. What a case does not use would only make its process larger.
    import OpenImageIO  # noqa: F401
    from pxr import Usd

    from warp_reflect import images, pictures  # noqa: F401
    from warp_reflect.stage import child, transfer  # noqa: F401
    from warp_reflect.stage.layers import check_layers  # noqa: F401
    from warp_reflect.stage.read import read_stage

    if any("command" in case for case in cases):
        from warp_reflect import cli, frame, planner  # noqa: F401
        from warp_reflect.stage import load, render_settings  # noqa: F401
        from warp_reflect.techniques import TECHNIQUES  # noqa: F401
    warm_up(read_stage, Usd)
    gc.freeze()  # the children then leave the parent's objects alone, and their pages shared
    outcomes = []
    for case in cases:
        outcomes.append(outcome(case))
    Path(outcomes_file).write_text(json.dumps(outcomes))


def warm_up(read_stage, usd) -> None:
    """Load the library's plugins, once, instead of in every child."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "warm.usda"
        stage = usd.Stage.CreateNew(str(path))
        stage.DefinePrim("/A", "Sphere")
        stage.DefinePrim("/M", "Material")
        stage.GetRootLayer().Save()
        del stage
        read_stage(path)


def outcome(case: dict) -> dict:
    """What became of one child: {kind, text, notes, paths, code, stderr, signal, seconds}."""
    folder = tempfile.mkdtemp()
    answer = Path(folder) / "outcome.json"
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            for number, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(f"{folder}/{name}", os.O_WRONLY | os.O_CREAT), number)
            resource.setrlimit(resource.RLIMIT_FSIZE, (OUTPUT_BYTES, OUTPUT_BYTES))
            command = "command" in case
            seconds = COMMAND_SECONDS if command else SECONDS
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, resource.RLIM_INFINITY))
            signal.alarm(STUCK * seconds)
            result = run_command(case) if command else read_case(case, Path(folder))
            answer.write_text(json.dumps(result))
            code = 0
        except BaseException:
            traceback.print_exc()
            sys.stderr.flush()
        finally:
            os._exit(code)
    _, status, usage = os.wait4(pid, 0)
    result = {"kind": "raised", "text": "", "notes": [], "paths": []}
    if os.WIFSIGNALED(status):
        result |= {"kind": "died", "signal": os.WTERMSIG(status)}
    elif answer.exists():
        result |= json.loads(answer.read_text())
    errors = Path(folder) / "stderr"
    result["stderr"] = errors.read_text(errors="replace")[-4000:] if errors.exists() else ""
    result["seconds"] = usage.ru_utime + usage.ru_stime
    result["megabytes"] = usage.ru_maxrss / 1024
    shutil.rmtree(folder)
    return case | result


def run_command(case: dict) -> dict:
    """The command line in this process; the pictures it wrote must hold numbers only."""
    from warp_reflect import cli, images

    code = cli.main(case["command"])
    sys.stderr.flush()
    finite = True
    for output in case["outputs"]:
        if Path(output).exists():
            channels, _ = images.read_exr(output)
            finite = finite and all(bool(np.isfinite(channel).all()) for channel in channels.values())
    return {"kind": "ended", "code": code, "finite": finite}


def read_case(case: dict, folder: Path) -> dict:
    """The stage at each time, as `read_untrusted` would get it."""
    from warp_reflect.stage import child, transfer
    from warp_reflect.stage.guard import Limits, check_file

    limits = {"root": str(Path(case["path"]).parent.resolve())}
    notes, paths = [], []
    for k, time in enumerate(case["times"]):
        try:
            check_file(case["path"], Limits(**limits))
        except (ValueError, FileNotFoundError) as fault:
            return {"kind": "refused", "text": str(fault)}
        place = folder / str(k)
        place.mkdir()
        arguments = {
            "path": case["path"],
            "time": time,
            "limits": limits,
            "folder": str(place),
            "memory_bytes": MEMORY_BYTES,
        }
        sys.stdin = io.StringIO(json.dumps(arguments))
        if child.main() != 0:
            return {"kind": "raised", "text": "the child gave no answer"}
        answer = json.loads((place / "answer.json").read_text())
        if "error" in answer:
            return {"kind": "refused", "text": answer["error"]}
        data = transfer.load(place)  # a ValueError of its check: raised
        notes += [f"{note.path}: {note.text}" for note in data.notes]
        paths += [instance.prim_path for instance in data.instances]
    return {"kind": "read", "notes": notes, "paths": paths}


if __name__ == "__main__":
    main(*sys.argv[1:])
