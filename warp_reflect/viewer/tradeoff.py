"""Accuracy against time as the inspector plots it: a sweep's rows, and the point of the settings at hand among them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from warp_reflect.frame import Frame
from warp_reflect.metrics import Comparison
from warp_reflect.sweep import REFERENCE, Contender, default_contenders

RESULTS = "results.json"  # as `sweep` names it
# Knobs of a sweep that a short one leaves out: what they prepare or search takes seconds.
SLOW = ("map_resolution=512", "map_resolution=1024", "iterations=1", "iterations=2")
SIZE_MAX = 64 << 20  # bytes of a results file; a larger one is something else


@dataclass(frozen=True)
class Mark:
    """A point of the plot.

    Attributes:
        name: Of the contender, or of the settings.
        ms: Reflections of a frame. [ms]
        off: Share of the interior mirror pixels off by more than half a pixel, or showing another thing.
        technique: Of the mirrors in view; several, comma-separated.
    """

    name: str
    ms: float
    off: float
    technique: str


@dataclass
class Tradeoff:
    """What the plot holds.

    Attributes:
        marks: Of a sweep.
        told: Where they are from, and of which picture.
        trail: Of the settings that were tried by hand, the present ones last.
    """

    marks: list[Mark] = field(default_factory=list)
    told: str = ""
    trail: list[Mark] = field(default_factory=list)

    def front(self) -> list[Mark]:
        """The marks that no faster one equals, fastest first; the reference is none of them."""
        found: list[Mark] = []
        for mark in sorted(
            (mark for mark in self.marks if mark.name != REFERENCE), key=lambda each: (each.ms, each.off)
        ):
            if not found or mark.off < found[-1].off:
                found.append(mark)
        return found


def mark_of(name: str, frame: Frame, comparison: Comparison) -> Mark:
    """The point of a measured frame."""
    techniques = dict.fromkeys(row.technique for row in frame.plan.rows if row.reflector.id in frame.layers)
    off = comparison.share(comparison.interior_pixels - comparison.within_half_px)
    return Mark(name, frame.timings.get("reflect", 0.0), off, ",".join(techniques))


def read_results(path: str | os.PathLike) -> Tradeoff:
    """The rows of a sweep.

    Args:
        path: A results.json, or the folder that `sweep` wrote.

    Raises:
        OSError: it cannot be read.
        ValueError: it holds no sweep.
    """
    path = Path(path)
    if path.is_dir():
        path = path / RESULTS
    try:
        if path.stat().st_size > SIZE_MAX:
            raise ValueError("more than a sweep writes")
        found = json.loads(path.read_bytes())
        size, stage = found["size"], Path(found["stage"]).name
        marks = [
            Mark(str(row["name"]), float(row["reflect_ms"]), float(row["off_share"]), str(row["technique"]))
            for row in found["rows"]
        ]
        if not all(0.0 <= mark.ms < float("inf") and 0.0 <= mark.off <= 1.0 for mark in marks):
            raise ValueError("a time or a share out of range")
        told = f"{stage} at {int(size[0])}x{int(size[1])}, {path.parent.name}/{path.name}"
    except OSError as error:
        raise OSError(f"{path}: cannot be read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ValueError(f"{path}: is no result of `warp-reflect sweep` ({error})") from None
    return Tradeoff(marks, told)


def beside(stage: str | os.PathLike) -> Tradeoff | None:
    """The sweep of a stage that lies in its folder or in one of the folders there; None where there is none."""
    stage = Path(stage)
    if not stage.is_file():
        return None
    for path in (stage.parent / RESULTS, *sorted(stage.parent.glob(f"*/{RESULTS}"))):
        try:
            found = json.loads(path.read_bytes()) if path.is_file() and path.stat().st_size <= SIZE_MAX else None
            if found and Path(found["stage"]).name == stage.name:
                return read_results(path)
        except (OSError, ValueError, KeyError, TypeError):
            continue  # not asked for, so nothing to complain about
    return None


def quick_contenders(session) -> Iterator[Contender]:
    """What a short sweep of a session's view tries: every technique refined with each knob, and once unrefined."""
    made, _ = default_contenders(session.scene, session.camera, session.size, session.settings)
    for each in made:
        knobs = each.name.split()[1:]
        unrefined = "refine=off" in knobs
        slow = any(knob in SLOW for knob in knobs)
        if not (each.warm or each.source or slow) and (not unrefined or len(knobs) == 1):
            yield each
