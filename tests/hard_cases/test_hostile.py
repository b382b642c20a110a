"""Hostile stages and pictures end as a scene with notes or as one line: no crash, no hang, no traceback, no stray file.

Every case is read in a forked child as `--untrusted` reads it; some of each family also go through the command. With
WARP_REFLECT_HOSTILE=N in the environment families of randomly damaged files have N of them (20 without).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import hostile
import pytest
from hostile import CRASH, NOTED, READ, REFUSED

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
MUTANTS = int(os.environ.get("WARP_REFLECT_HOSTILE", "20"))
HANGING = (int(signal.SIGXCPU), int(signal.SIGALRM))
# What the image library itself prints of a bad PNG, beside what it reports.
FOREIGN = ("libpng ",)
# Families whose files may kill a process or name what lies outside: these are for --untrusted.
UNTRUSTED = ("missing", "crate-truncated", "crate-flipped", "crate-headers", "growth", "escapes", "packages", "files")


def environment(scratch: Path) -> dict[str, str]:
    """One thread of linear algebra each, and temporary files where they are counted."""
    return os.environ | {"OPENBLAS_NUM_THREADS": "1", "TMPDIR": str(scratch), "PYTHONPATH": str(ROOT)}


def listing(folder: Path) -> dict[str, tuple]:
    """What lies below a folder, with sizes and times."""
    found = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            status = os.lstat(os.path.join(place, name))
            size = status.st_mtime_ns if not os.path.isdir(os.path.join(place, name)) else 0
            found[os.path.join(place, name)] = (status.st_mode, status.st_size if size else 0, size)
    return found


def forked(cases: list[dict], place: Path) -> list[dict]:
    """Outcomes of cases, in order."""
    scratch = place / "scratch"
    scratch.mkdir()
    (place / "cases.json").write_text(json.dumps(cases))
    run = [sys.executable, str(HERE / "forked_intake.py"), str(place / "cases.json"), str(place / "outcomes.json")]
    one = environment(scratch) | {"PXR_WORK_THREAD_LIMIT": "1"}  # a parent with threads cannot be forked safely
    subprocess.run(run, cwd=scratch, env=one, check=True, capture_output=True)
    # Warp's compiler keeps its precompiled headers there for as long as a process lives; a forked child does not clear them.
    left = [path for path in scratch.iterdir() if not path.name.startswith("wp_pch_")]
    assert not left, "temporary files were left behind"
    return json.loads((place / "outcomes.json").read_text())


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> list[hostile.Case]:
    return hostile.write(tmp_path_factory.mktemp("corpus"), MUTANTS)


@pytest.fixture(scope="module")
def outcomes(corpus, tmp_path_factory) -> list[dict]:
    """Every case read as an untrusted stage, and that this changed no file."""
    folder = corpus[0].path.parents[2]
    before = listing(folder)
    cases = [case.__dict__ | {"path": str(case.path), "times": list(case.times)} for case in corpus]
    found = forked(cases, tmp_path_factory.mktemp("read"))
    assert listing(folder) == before, "reading wrote beside the stages"
    return found


def told(outcome: dict) -> str:
    return outcome["text"] if outcome["kind"] == "refused" else " | ".join(outcome["notes"])


def fault(outcome: dict) -> str:
    """What is wrong with how a case ended; empty if nothing is."""
    kind, expect = outcome["kind"], outcome["expect"]
    if kind == "died":
        # The library died in a process of its own, which is what that is for; but nothing may hang.
        return "" if expect == CRASH and outcome["signal"] not in HANGING else f"died of signal {outcome['signal']}"
    if kind == "raised":
        return f"raised {outcome['stderr'][-500:]}"
    if "Traceback" in outcome["stderr"] or "RuntimeWarning" in outcome["stderr"]:
        return outcome["stderr"]
    if kind == "refused":
        if expect in (NOTED, READ):
            return f"refused: {outcome['text']}"
        if "\n" in outcome["text"].replace(outcome["path"], "") or not outcome["text"]:
            return f"not one line: {outcome['text']!r}"
        names = (outcome["path"], str(Path(outcome["path"]).parent), "</", "/Bad")
        if not any(name in outcome["text"] for name in names):
            return f"names no culprit: {outcome['text']}"
    elif expect == REFUSED:
        return "read, expected a refusal"
    elif expect in (NOTED, READ) and "Good" not in "".join(outcome["paths"]):
        return f"the good neighbour is gone: {outcome['paths']}"
    if outcome["culprit"] not in told(outcome):
        return f"{outcome['culprit']!r} is not named: {told(outcome)}"
    return ""


@pytest.mark.parametrize("family", hostile.FAMILIES)
def test_hostile_files_end_in_a_scene_or_one_line(family, outcomes):
    mine = [outcome for outcome in outcomes if outcome["family"] == family]
    faults = {outcome["name"]: fault(outcome) for outcome in mine}
    assert mine and not {name: text for name, text in faults.items() if text}


def test_corpus_is_large_and_each_case_is_bounded(corpus, outcomes):
    assert len(corpus) == len(outcomes) >= 500
    assert len({(case.family, case.name) for case in corpus}) == len(corpus)
    assert max(outcome["megabytes"] for outcome in outcomes) < 4096
    kinds = Counter(outcome["kind"] for outcome in outcomes)
    assert kinds["read"] > 300 and kinds["refused"] > 200
    # Of randomly damaged crates the library may die of a few; of anything else it does not.
    assert kinds["died"] <= 0.02 * len(outcomes)


def chosen(corpus: list[hostile.Case], untrusted: bool) -> list[hostile.Case]:
    """Of every family one case of each kind of end that is expected; of untrusted ones as few as may be that are never read."""
    found = []
    for family in hostile.FAMILIES:
        if (family in UNTRUSTED) != untrusted:
            continue
        mine = [case for case in corpus if case.family == family]
        kinds = {case.expect for case in mine}
        for kind in sorted((kinds - {REFUSED} if untrusted else kinds) or kinds):
            those = [case for case in mine if case.expect == kind]
            found.append(those[len(those) // 2])
    return found


def check_command(case: hostile.Case, code: int, stderr: str, output: Path) -> str:
    """What is wrong with how the command ended; empty if nothing is."""
    lines = [line for line in stderr.replace(str(case.path), "STAGE").splitlines() if not line.startswith(FOREIGN)]
    if "Traceback" in stderr or "Warning" in stderr:
        return stderr
    if code == 0:
        return "" if output.exists() else "exit 0 without a picture"
    if code != 2:
        return f"exit {code}: {stderr}"
    if output.exists() or len(lines) != 1 or not lines[0].startswith("error: "):
        return f"exit 2 with {len(lines)} lines: {stderr}"
    return (
        ""
        if "STAGE" in lines[0] or str(case.path.parent) in lines[0] or "</" in lines[0]
        else f"names nothing: {lines}"
    )


def check_commands(cases: list[hostile.Case], corpus: list[hostile.Case], place: Path, *options: str) -> None:
    """Each case through the command's own function, in a forked process."""
    before = listing(corpus[0].path.parents[2])
    folder = place / "out"
    folder.mkdir()
    outputs = [folder / f"{k}.exr" for k in range(len(cases))]
    jobs = [
        {"command": ["render", str(case.path), str(output), "--res", "16x12", *options], "outputs": [str(output)]}
        for case, output in zip(cases, outputs, strict=True)
    ]
    faults = {}
    for case, output, outcome in zip(cases, outputs, forked(jobs, place), strict=True):
        if outcome["kind"] != "ended" or not outcome["finite"]:
            faults[case.family, case.name] = outcome
        elif check_command(case, outcome["code"], outcome["stderr"], output):
            faults[case.family, case.name] = check_command(case, outcome["code"], outcome["stderr"], output)
    assert not faults
    assert set(folder.iterdir()) <= set(outputs)
    assert listing(corpus[0].path.parents[2]) == before


def test_command_ends_with_0_or_2_and_writes_its_output_alone(corpus, tmp_path):
    check_commands(chosen(corpus, untrusted=False), corpus, tmp_path)


def test_untrusted_command_ends_with_0_or_2_and_writes_its_output_alone(corpus, tmp_path):
    check_commands(chosen(corpus, untrusted=True), corpus, tmp_path, "--untrusted")


def test_untrusted_command_of_a_user_writes_a_picture_and_nothing_else(corpus, tmp_path):
    """A process of its own, as a user starts it."""
    case = next(case for case in corpus if case.family == "files" and case.expect == READ)
    output, scratch = tmp_path / "out" / "frame.exr", tmp_path / "scratch"
    output.parent.mkdir()
    scratch.mkdir()
    run = [sys.executable, "-m", "warp_reflect.cli", "render", "--res", "16x12", "--untrusted", str(case.path)]
    done = subprocess.run(
        [*run, str(output)],
        cwd=scratch,
        env=environment(scratch),
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert not check_command(case, done.returncode, done.stderr, output)
    assert not list(scratch.iterdir())
    assert [path.name for path in output.parent.iterdir()] == ["frame.exr"]
