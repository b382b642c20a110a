"""The device that Warp runs on, and the cache of its compiled kernels: what a process sets up before anything else."""

from __future__ import annotations

import atexit
import ctypes
import json
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import warp as wp

# Warp compiles into such a folder (process, thread) and renames it when it is whole; another process may be at it.
BEING_WRITTEN = re.compile(r"_p\d+_t\d+$")

# Of glibc's mallopt, and what a user sets instead of it.
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
ALLOCATOR_VARIABLES = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")
KEPT_BYTES = 1 << 28  # several frames' arrays at 1920x1080; what is larger goes back to the system
OLD_MMAP_LIMIT = 1 << 25  # the largest threshold that older C libraries take; they refuse others


def open_device(name: str) -> str:
    """Start Warp quietly, with a kernel cache that works; returns the name of the device.

    Raises:
        ValueError: no such device here.
    """
    if hasattr(wp.config, "log_level"):
        wp.config.log_level = wp.LOG_WARNING
    else:
        wp.config.quiet = True  # Warp before 1.12
    with _without_driver_warning():
        try:
            wp.init()
        except OSError:
            # The cache folder cannot be made: another home for it.
            wp.config.kernel_cache_dir = _temporary_cache()
            wp.init()
    cache = Path(wp.config.kernel_cache_dir)
    # Of a cache that users share, some modules may be another one's alone: they can neither be read nor replaced.
    if not _is_writable(cache) or any(folder.exists() for folder in heal_kernel_cache(cache)):
        wp.config.kernel_cache_dir = _temporary_cache(cache)
        heal_kernel_cache(Path(wp.config.kernel_cache_dir))
    keep_freed_memory()
    known = [device.alias for device in wp.get_devices()]
    if name not in known and name != "cuda":
        raise ValueError(f"--device: got '{name}', this machine has {', '.join(known)}")
    return str(wp.get_device(name))


def keep_freed_memory() -> None:
    """Let the process keep the memory of one frame's arrays for the next one's.

    By default the C library gives large blocks back when they are freed, and the next frame waits for the system to find and
    clear their pages anew: a tenth of a frame's time, two fifths of one at 3840x2160 without shadows. It holds for the whole
    process, with whatever else that allocates: commands ask for it, and a program that has this package as a library may, once.
    Nothing happens where its user has set the C library's own variables, or has another C library.
    """
    if any(os.environ.get(name) for name in ALLOCATOR_VARIABLES):
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return  # another C library
    if mallopt(MMAP_THRESHOLD, KEPT_BYTES) or mallopt(MMAP_THRESHOLD, OLD_MMAP_LIMIT):
        mallopt(TRIM_THRESHOLD, KEPT_BYTES)


@contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Drop the line that Warp's native code prints on every machine without CUDA; pass everything else on."""
    sys.stderr.flush()
    with tempfile.TemporaryFile() as caught:
        kept = os.dup(2)
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            caught.seek(0)
            for line in caught.read().decode(errors="replace").splitlines():
                if "Could not find or load the NVIDIA CUDA driver" not in line:
                    print(line, file=sys.stderr, flush=True)


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _temporary_cache(source: Path | None = None) -> str:
    """A kernel cache for this process alone, with those compiled kernels of another cache that can be read."""
    folder = Path(tempfile.mkdtemp(prefix="warp_reflect_kernels_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    if source is not None and source.is_dir():
        for module in source.glob("wp_warp_reflect*"):
            try:
                shutil.copytree(module, folder / module.name)
            except OSError:  # another user's
                shutil.rmtree(folder / module.name, ignore_errors=True)
    return str(folder)


def processor() -> str:
    """The processor's name."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def heal_kernel_cache(cache: Path) -> list[Path]:
    """Delete cached modules of this package that were cut short; they are compiled again when needed.

    A full disk or a crash leaves such files, and Warp would fail on them at every start.

    Returns:
        The folders that were to be deleted: another user's stay.
    """
    damaged = [
        folder
        for folder in cache.glob("wp_warp_reflect*")
        if folder.is_dir() and not BEING_WRITTEN.search(folder.name) and not _is_whole(folder)
    ]
    for folder in damaged:
        shutil.rmtree(folder, ignore_errors=True)
    return damaged


def _is_whole(folder: Path) -> bool:
    try:
        for file in folder.iterdir():
            if file.suffix == ".meta":
                json.loads(file.read_text())
            elif file.suffix in (".o", ".cubin") and not _is_whole_elf(file):
                return False
            elif file.suffix == ".ptx" and file.stat().st_size == 0:
                return False
    except (OSError, ValueError):
        return False
    return True


def _is_whole_elf(file: Path) -> bool:
    """Whether a 64-bit ELF file holds all of its section table; other formats: whether it has data."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        head = stream.read(64)
    if head[:5] != b"\x7fELF\x02":
        return len(head) > 0 and not b"\x7fELF".startswith(head[:4])
    if len(head) < 64:
        return False
    table = int.from_bytes(head[40:48], "little")
    entry, entries = int.from_bytes(head[58:60], "little"), int.from_bytes(head[60:62], "little")
    return size >= table + entry * entries
