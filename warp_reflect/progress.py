"""What a running job says: results on standard output, everything else, with the time left, on standard error."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

STYLES = ("rich", "json", "alf", "none")
NOTES_SHOWN = 40  # a stage of thousands of prims may have thousands; `plan --json` has them all


class Report:
    """Tells of a job in one of four styles.

    `rich`: a bar with the time left, on a terminal. `json`: one object a line on standard error, notes and errors
    included: `{"event": "begin" | "frame" | "note" | "line" | "end", ...}`. `alf`: lines `ALF_PROGRESS 50%` as Pixar's
    Tractor reads them. `none`: notes and errors alone.
    """

    def __init__(self, style: str, bar=None):
        self.style = style
        self._bar = bar
        self._task = bar.add_task("", total=None) if bar is not None else None
        self._total = self._done = 0
        self._started = time.perf_counter()
        self._told: set = set()

    def busy(self, text: str) -> None:
        """What is going on, where there is a bar to say it beside."""
        if self._bar is not None:
            self._bar.update(self._task, description=text)

    def begin(self, total: int) -> None:
        """So many frames are to be rendered."""
        self._total = total
        self._event("begin", frames=total)
        if self.style == "alf" and not total:
            self._tell("ALF_PROGRESS 100%")
        if self._bar is not None and total > 1:
            self._bar.update(self._task, total=total)

    def notes(self, notes: list) -> None:
        """Notes (`Note` or (path, text)) not told before, one line each."""
        pairs = [(note.path, note.text) if hasattr(note, "path") else tuple(note) for note in notes]
        fresh = [pair for pair in dict.fromkeys(pairs) if pair not in self._told]
        self._told.update(fresh)
        for path, text in fresh if self.style == "json" else fresh[:NOTES_SHOWN]:
            if not self._event("note", path=path, text=text):
                self._tell(f"note: {path}: {text}")
        if len(fresh) > NOTES_SHOWN and self.style != "json":
            self._tell(f"note: {len(fresh) - NOTES_SHOWN:,} more; `plan --json` lists them all")

    def frame(self, job, outcome) -> None:
        """What became of a frame (`pipeline.Outcome`)."""
        self.notes(list(outcome.notes))
        self._done += 1
        label, names = job.label(outcome.place), job.files[outcome.place]
        if outcome.state == "written":
            for name in names:
                print(f"{name}: {outcome.text}", flush=True)
        told = self._event(
            "frame",
            frame=job.times[outcome.place],
            state=outcome.state,
            files=list(names),
            text=outcome.text,
            ms=round(outcome.ms, 3),
            seconds=round(outcome.seconds, 3),
            done=self._done,
            frames=self._total,
            left_s=round(self._left(), 1),
            process=outcome.process,
        )
        if outcome.state == "failed" and not told:
            self._tell(f"error: {label}: {outcome.text}")
        elif outcome.state == "taken" and not told:
            self._tell(f"error: {label}: another process is writing {names[0]}; left to it")
        if self.style == "alf":
            self._tell(f"ALF_PROGRESS {100 * self._done // max(self._total, 1)}%")
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, description=label)

    def line(self, text: str) -> None:
        """One line that belongs to no frame."""
        if not self._event("line", text=text):
            self._tell(text)

    def urgent(self, text: str) -> None:
        """The same from inside a signal handler, where a print could meet itself."""
        shown = json.dumps({"event": "line", "text": text}) if self.style == "json" else text
        os.write(2, f"{shown}\n".encode())

    def end(self, code: int) -> None:
        """The job is over, with this exit code."""
        seconds = round(time.perf_counter() - self._started, 3)
        self._event("end", done=self._done, frames=self._total, seconds=seconds, exit=code)

    def _left(self) -> float:
        """Seconds left, judged by the frames so far."""
        if not self._done:
            return 0.0
        return (time.perf_counter() - self._started) / self._done * max(self._total - self._done, 0)

    def _event(self, kind: str, **content) -> bool:
        if self.style != "json":
            return False
        self._tell(json.dumps({"event": kind} | content, allow_nan=False))
        return True

    def _tell(self, text: str) -> None:
        print(text, file=sys.stderr, flush=True)


@contextmanager
def reporting(style: str | None) -> Iterator[Report]:
    """A `Report`; style None: rich on a terminal, else none.

    Raises:
        ValueError: an unknown style.
    """
    if style is not None and style not in STYLES:
        raise ValueError(f"--progress: got '{style}', expected one of {', '.join(STYLES)}")
    style = style or ("rich" if sys.stderr.isatty() else "none")
    if style != "rich":
        yield Report(style)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    columns = [SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn()]
    columns += [MofNCompleteColumn(), TimeRemainingColumn()]
    # What the bar redirects it prints on its own console: results that go to a file must not end there.
    console, redirect = Console(stderr=True), sys.stdout.isatty()
    with Progress(*columns, console=console, transient=True, redirect_stdout=redirect) as bar:
        yield Report(style, bar)


def statistics_line(statistics: dict) -> str:
    """`, 12,345 mirror pixels: 91.2 % candidate, 8.0 % walk, 0.8 % BVH`, as far as a frame counted it."""
    names = {"candidate": "candidate", "walk": "walk", "empty": "sky", "bvh": "BVH"}
    counts = {shown: int(statistics[key]) for key, shown in names.items() if key in statistics}
    total = sum(counts.values())
    if not total:
        return ""
    shares = ", ".join(f"{100.0 * number / total:.4g} % {shown}" for shown, number in counts.items())
    return f", {total:,} mirror pixels: {shares}"
