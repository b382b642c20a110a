"""What is refused before the USD library sees it, how large a stage may be, and reading in a child process.

A file can end the process inside the USD library: no exception comes out. `check_file` gives good messages for what
can be seen from outside; `read_untrusted` is for safety.
"""

from __future__ import annotations

import json
import os
import re
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from warp_reflect.scene import SceneData
from warp_reflect.stage.transfer import load

CRATE_MAGIC = b"PXR-USDC"
TEXT_MAGIC = (b"#usda", b"#sdf")
ZIP_MAGIC = b"PK\x03\x04"
CRATE_HEADER = struct.Struct("<8s8Bq")  # magic, version, offset of the table of contents
CRATE_SECTION = struct.Struct("<16sqq")  # name, start, size
CRATE_SECTIONS_MAX = 64  # the format has six
CRATE_COUNTED = ("TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS")  # begin with a count, uint64
CRATE_COUNT_MAX = 200_000_000
CRATE_COUNT_PER_BYTE = 2000  # what the format's compression reaches at most, with room
# Strings (of three quotes or one) and comments of a text layer, which may hold any bracket.
TEXT_OPAQUE = re.compile(
    rb'"""(?:\\.|[^\\])*?"""|\'\'\'(?:\\.|[^\\])*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'|#[^\n]*', re.DOTALL
)
NESTING_EXTRA = 64  # brackets below a prim: values, metadata, variants; on top of Limits.depth
MEMORY_BYTES = 4 * 2**30
SECONDS = 60.0


class UnknownFormat(ValueError):
    """The file is no USD layer by its first bytes."""


@dataclass(frozen=True)
class Limits:
    """Sizes above which a stage is refused (`ValueError`) or a prim dropped; generous for honest files."""

    file_bytes: int = 8 * 2**30
    """Size of a binary layer or package."""
    text_bytes: int = 256 * 2**20
    """Size of a text layer; parsing takes about 100 times this in memory."""
    layers: int = 10_000
    """Layers of an untrusted stage."""
    arcs: int = 200
    """References one behind the other, of an untrusted stage."""
    prims: int = 2_000_000
    """Prims visited, prims in instances counted once per instance."""
    depth: int = 512
    """Namespace depth; the library itself fails near 10,000."""
    instances: int = 2_000_000
    """Placed meshes."""
    face_corners: int = 65_536
    """Corners of one face."""
    triangles: int = 200_000_000
    """Triangles of all placed meshes together."""
    root: str = ""
    """Folder that layers and pictures must lie in; empty: anywhere."""


def confinement_fault(file: str, root: str) -> str:
    """Why a file may not be read from a stage confined to the folder `root`; empty if it may."""
    if not root:
        return ""
    package = file.partition("[")[0] if file.endswith("]") else file
    real, inside = Path(package).resolve(), Path(root).resolve()
    return "" if real.is_relative_to(inside) else f"outside the folder {root}"


def check_file(path: str | Path, limits: Limits) -> None:
    """Refuse a file that is no USD layer, or one the library is known to fail on.

    Args:
        path: The layer.
        limits: Sizes and depth.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a regular file, too large, or not USD; one line.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as fault:
        raise FileNotFoundError(f"no such stage: {path} ({getattr(fault, 'strerror', None) or fault})") from None
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: not a regular file")
    try:
        with open(path, "rb") as file:
            magic = file.read(8)
            if magic == CRATE_MAGIC:
                _require(
                    status.st_size <= limits.file_bytes, path, f"{status.st_size} bytes, more than {limits.file_bytes}"
                )
                _check_crate(path, file, status.st_size)
            elif magic[:4] == ZIP_MAGIC:
                _require(
                    status.st_size <= limits.file_bytes, path, f"{status.st_size} bytes, more than {limits.file_bytes}"
                )
                _check_package(path)
            elif magic.startswith(TEXT_MAGIC):
                _require(
                    status.st_size <= limits.text_bytes,
                    path,
                    f"{status.st_size} bytes of text, more than {limits.text_bytes}",
                )
                _check_text(path, magic + file.read(), limits)
            else:
                raise UnknownFormat(f"cannot read {path}: not a USD file (it begins with {magic!r})")
    except OSError as fault:
        raise ValueError(f"cannot read {path}: {fault.strerror}") from None


def read_untrusted(
    path: str | Path,
    time: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    complexity: str = "low",
    strict: bool = False,
    limits: Limits | None = None,
    reflectors: tuple[str, ...] = (),
    *,
    memory_bytes: int = MEMORY_BYTES,
    seconds: float = SECONDS,
) -> SceneData:
    """`read_stage` in a child process with bounded memory and time, confined to the stage's folder.

    The child's answer is arrays and text, never code, and is checked before it is used.

    Args:
        path: The stage.
        time: See `read_stage`, like all others up to `reflectors`.
        purposes: What is drawn.
        complexity: Detail.
        strict: Errors instead of notes.
        limits: Sizes; where `limits.root` is empty the folder of the stage is used.
        reflectors: Mirrors by name.
        memory_bytes: Address space of the child.
        seconds: Wall-clock time of the child.

    Raises:
        FileNotFoundError: no such file.
        ValueError: as `read_stage`; also when the library crashed, hung or ran out of memory; one line.
    """
    limits = limits or Limits()
    if not limits.root:
        limits = Limits(**(asdict(limits) | {"root": str(Path(path).resolve().parent)}))
    check_file(path, limits)
    arguments = {
        "path": str(Path(path).absolute()),
        "time": time,
        "purposes": list(purposes),
        "complexity": complexity,
        "strict": strict,
        "limits": asdict(limits),
        "reflectors": [reflectors] if isinstance(reflectors, str) else list(reflectors),
        "memory_bytes": memory_bytes,
    }
    # One thread is enough there, and every further one would take address space.
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    environment["PXR_WORK_THREAD_LIMIT"] = "1"
    with tempfile.TemporaryDirectory(prefix="warp_reflect_") as folder:
        arguments["folder"] = folder
        try:
            done = subprocess.run(
                [sys.executable, "-m", "warp_reflect.stage.child"],
                input=json.dumps(arguments).encode(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=seconds,
                env=environment,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"reading {path} took longer than {seconds:g} s") from None
        if done.returncode < 0:
            number = -done.returncode
            name = signal.Signals(number).name if number in set(signal.Signals) else "unknown"
            raise ValueError(
                f"the USD library crashed on {path} (signal {number}, {name}; memory limit {memory_bytes >> 20} MB)"
            )
        answer = Path(folder) / "answer.json"
        if done.returncode != 0 or not answer.exists():
            last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
            raise ValueError(f"reading {path} failed: {last or f'exit status {done.returncode}'}")
        message = json.loads(answer.read_text())
        if "error" in message:
            kind = FileNotFoundError if message["kind"] == "FileNotFoundError" else ValueError
            raise kind(message["error"])
        data = load(Path(folder))
    data.source = str(path)
    return data


def _require(good: bool, path, problem: str) -> None:
    if not good:
        raise ValueError(f"cannot read {path}: {problem}")


def _check_crate(path, file, size: int) -> None:
    """The header and the counts at the head of each section, which the library allocates for unseen."""
    file.seek(0)
    header = file.read(CRATE_HEADER.size)
    _require(len(header) == CRATE_HEADER.size, path, "a truncated header")
    toc = CRATE_HEADER.unpack(header)[-1]
    _require(CRATE_HEADER.size <= toc <= size - 8, path, f"the table of contents lies at {toc} of {size} bytes")
    file.seek(toc)
    (section_count,) = struct.unpack("<Q", file.read(8))
    _require(section_count <= CRATE_SECTIONS_MAX, path, f"{section_count} sections, more than {CRATE_SECTIONS_MAX}")
    table = file.read(section_count * CRATE_SECTION.size)
    _require(len(table) == section_count * CRATE_SECTION.size, path, "a truncated table of contents")
    for raw_name, start, length in CRATE_SECTION.iter_unpack(table):
        name = raw_name.split(b"\0")[0].decode("ascii", "replace")
        good = 0 <= start <= size and 0 <= length <= size - start
        _require(good, path, f"section {name} at {start} with {length} of {size} bytes")
        if name in CRATE_COUNTED and length >= 8:
            file.seek(start)
            (count,) = struct.unpack("<Q", file.read(8))
            bound = min(CRATE_COUNT_MAX, CRATE_COUNT_PER_BYTE * size)
            _require(count <= bound, path, f"section {name} claims {count} entries, more than {bound}")


def _check_package(path) -> None:
    """Entries that are stored, named once, inside the package, and where the directory says."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            names = set()
            for entry in entries:
                name = entry.filename
                _require(name not in names, path, f"two entries named {name!r}")
                names.add(name)
                inside = not name.startswith("/") and ".." not in name.replace("\\", "/").split("/")
                _require(inside, path, f"the entry {name!r} leaves the package")
                stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
                _require(stored, path, f"the entry {name!r} is compressed")
                with archive.open(entry):
                    pass  # zipfile compares the entry's own header with the directory
    except (zipfile.BadZipFile, OSError, NotImplementedError, RuntimeError, UnicodeDecodeError) as fault:
        raise ValueError(f"cannot read {path}: {' '.join(str(fault).split())}") from None
    _require(bool(entries), path, "an empty package")


def _check_text(path, text: bytes, limits: Limits) -> None:
    """No NUL, which cuts the rest off silently, and no nesting the library's recursion cannot take."""
    at = text.find(b"\0")
    _require(at < 0, path, f"a NUL byte at {at}")
    deepest = limits.depth + NESTING_EXTRA
    if _nesting(text) > deepest:
        found = _nesting(TEXT_OPAQUE.sub(b" ", text))
        _require(found <= deepest, path, f"brackets nested {found} deep, more than {deepest}")


def _nesting(text: bytes) -> int:
    data = np.frombuffer(text, np.uint8)
    step = np.zeros(256, np.int8)
    step[[ord(c) for c in "([{"]] = 1
    step[[ord(c) for c in ")]}"]] = -1
    depth = step[data]
    return int(np.cumsum(depth[depth != 0], dtype=np.int64).max(initial=0))
