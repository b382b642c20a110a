"""What the steps of a frame cost on this machine, as `warp-reflect calibrate` measured it, kept in the user's cache."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import sys
import tempfile
from functools import cache
from pathlib import Path

import warp as wp

from warp_reflect import __version__
from warp_reflect.budget import BUILT_IN, ON_CUDA, Costs
from warp_reflect.devices import processor

# Environment variable: the file itself, in place of the one in the user's cache; empty: none, the built-in costs.
FILE_VARIABLE = "WARP_REFLECT_CALIBRATION"
FILE_NAME = "calibration.json"
# A cost beyond these factors of the built-in one was disturbed, or is of a damaged file.
FACTORS = (1.0e-3, 1.0e3)


def cache_file() -> Path | None:
    """Where calibrations are kept; None: nowhere (`FILE_VARIABLE` is empty, or its user has no home)."""
    named = os.environ.get(FILE_VARIABLE)
    if named is not None:
        return Path(named) if named else None
    try:
        if sys.platform == "win32":
            home = Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local")
        elif sys.platform == "darwin":
            home = Path.home() / "Library" / "Caches"
        else:
            home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:  # a container's user, who is no one
        return None
    return home / "warp_reflect" / FILE_NAME


def identity(device: wp.DeviceLike) -> dict[str, str | int]:
    """What costs hang on: processor, cores, device, versions."""
    known = wp.get_device(device)
    return {
        "processor": processor(),
        "cores": os.cpu_count() or 1,
        "device": known.name if known.is_cuda else "cpu",
        "warp": wp.config.version,
        "warp_reflect": __version__,
    }


def built_in(device: wp.DeviceLike) -> Costs:
    """The costs of a device of this kind."""
    return ON_CUDA if wp.get_device(device).is_cuda else BUILT_IN


def known(device: wp.DeviceLike) -> Costs:
    """The costs that were measured for a device on this machine with these versions; `built_in` where none were."""
    file, usual = cache_file(), built_in(device)
    if file is None:
        return usual
    try:
        changed = file.stat().st_mtime_ns
    except OSError:
        return usual
    return _read(file, changed, _key(identity(device)), usual) or usual


def check_writable() -> Path:
    """The file to keep calibrations in, once its folder is there.

    Raises:
        ValueError: there is no place to keep them (`cache_file`).
        OSError: the folder cannot be made or written to.
    """
    file = cache_file()
    if file is None:
        why = "is empty" if FILE_VARIABLE in os.environ else "is not set, and the user has no home"
        raise ValueError(f"{FILE_VARIABLE} {why}: there is no file to keep a calibration in; name one there")
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.is_dir() or not os.access(file.parent, os.W_OK):
        raise OSError(f"{file}: cannot be written; name another file in {FILE_VARIABLE}")
    return file


def store(costs: Costs, device: wp.DeviceLike) -> Path:
    """Keep costs for a device on this machine, beside those of others; written to a temporary name and renamed.

    Raises:
        ValueError, OSError: as of `check_writable`, or the file cannot be written.
    """
    file = check_writable()
    entries = _entries(file)
    this = identity(device)
    entries[_key(this)] = {"machine": this, "microseconds": dataclasses.asdict(costs)}
    with tempfile.NamedTemporaryFile("w", dir=file.parent, prefix=f".{file.name}.", delete=False) as stream:
        json.dump(entries, stream, indent=2)
    try:
        Path(stream.name).replace(file)
    except OSError:
        Path(stream.name).unlink(missing_ok=True)
        raise
    return file


def described(device: wp.DeviceLike) -> str:
    """The machine that costs are kept for, in a line."""
    this = identity(device)
    return f"{this['processor']}, {this['cores']} cores, {this['device']}, Warp {this['warp']}"


def table(costs: Costs, device: wp.DeviceLike) -> str:
    """Costs beside a device's built-in ones, a line each."""
    usual, whose = built_in(device), "the device" if wp.get_device(device).is_cuda else "one thread"
    lines = [f"{'step':14s} {'here':>10s} {'built in':>10s}  microseconds of {whose} (sharing: of a further thread)"]
    for each in dataclasses.fields(Costs):
        lines.append(f"{each.name:14s} {getattr(costs, each.name):10.4g} {getattr(usual, each.name):10.4g}")
    return "\n".join(lines)


def _key(this: dict) -> str:
    return hashlib.blake2b(json.dumps(this, sort_keys=True).encode(), digest_size=8).hexdigest()


def _entries(file: Path) -> dict:
    """What a file holds; nothing where it is not there or damaged."""
    try:
        entries = json.loads(file.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return entries if isinstance(entries, dict) else {}


@cache
def _read(file: Path, changed: int, key: str, usual: Costs) -> Costs | None:
    """The costs under a key; None where they are not there, or one of them cannot be."""
    entry = _entries(file).get(key)
    found = entry.get("microseconds") if isinstance(entry, dict) else None
    if not isinstance(found, dict) or found.keys() != dataclasses.asdict(BUILT_IN).keys():
        return None
    return Costs(**found) if all(_is_likely(value, getattr(usual, name)) for name, value in found.items()) else None


def _is_likely(value: object, usual: float) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and FACTORS[0] * usual <= value <= FACTORS[1] * usual
