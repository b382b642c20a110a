"""Frame ranges and numbered output names, in usdrecord's spelling."""

from __future__ import annotations

import re
from pathlib import Path

from pxr import Tf, UsdUtils

FRAMES_MAX = 1_000_000  # a range longer than this is a slip of the keyboard, and would fill the memory

# usdrecord's `###` and `###.###`, and what other renderers write: $F4, <F4>, %04d.
_PATTERN = re.compile(r"(#+)(?:\.(#+))?|\$F(\d)?|<F(\d)>|%0?(\d)?d")


def parse_frames(spec: str) -> list[float]:
    """Time codes of a frame specification: `101:109x2,120`, `101:104x0.5`, `105:101`.

    Raises:
        ValueError: not a frame specification, or more than a million frames.
    """
    times: list[float] = []
    for part in spec.split(","):
        try:
            time_range = UsdUtils.TimeCodeRange.CreateFromFrameSpec(part.strip())
        except Tf.ErrorException:
            time_range = None
        if time_range is None or not time_range.IsValid():
            raise ValueError(f"--frames: got '{spec}', expected frames such as 101, 101:109x2 or 1:5,10:20")
        span = abs(time_range.endTimeCode.GetValue() - time_range.startTimeCode.GetValue())
        if span / abs(time_range.stride) > FRAMES_MAX - len(times):
            raise ValueError(f"--frames: '{spec}' is more than {FRAMES_MAX:,} frames")
        times.extend(float(time.GetValue()) for time in time_range)
    return times


def has_frame_pattern(name: str) -> bool:
    """Whether an output name has a place for the frame number."""
    return _PATTERN.search(name) is not None


def snapshot_name(pattern: str) -> str:
    """Where a snapshot of an output goes: the name without the frame number, `out.####.exr` to `out.snapshot.png`."""
    stem = _PATTERN.sub("", str(Path(pattern).with_suffix("")))
    return f"{stem.rstrip('._-')}.snapshot.png"


def frame_name(pattern: str, time: float) -> str:
    """The output name of a frame.

    Args:
        pattern: A name with exactly one place for the number, such as `out.####.exr` or `out.###.##.exr`.
        time: Time code.

    Raises:
        ValueError: no place, several, or one that cannot hold the fraction of this time code.
    """
    places = list(_PATTERN.finditer(pattern))
    if len(places) != 1:
        raise ValueError(f"{pattern}: expected exactly one frame number such as ####, got {len(places)}")
    place = places[0]
    hashes, fraction, *widths = place.groups()
    width = len(hashes) if hashes else int(next((w for w in widths if w), "1"))
    digits = len(fraction) if fraction else 0
    # Time codes are sums of strides: compare with room for the rounding of a long range.
    if abs(round(time, digits) - time) > 1e-6:
        raise ValueError(f"{pattern}: frame {time:g} needs more digits after the point; write ####.##")
    sign = "-" if round(time, digits) < 0 else ""
    number = f"{abs(time):.{digits}f}"
    whole, point, rest = number.partition(".")
    return pattern[: place.start()] + sign + whole.zfill(width) + point + rest + pattern[place.end() :]
