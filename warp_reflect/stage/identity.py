"""What a stage is made of, as one number: the digest of every file that it composes, by content."""

from __future__ import annotations

import hashlib
import os
import stat
import subprocess
import sys
from pathlib import Path

from warp_reflect.stage.guard import MEMORY_BYTES, SECONDS, Limits, check_file, confinement_fault

DIGEST_BYTES = 16  # two stages alike by chance: never


def stage_digest(path: str | Path, root: str = "", untrusted: bool = False) -> str:
    """Digest of the names and contents of a stage's layers and assets; moving them together does not change it.

    Args:
        path: The root layer.
        root: Folder that all of them must lie in; empty: anywhere, unless untrusted.
        untrusted: Look at the layers in a child process with bounded memory and time.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not readable as USD, or a file outside the folder.
    """
    check_file(path, Limits())
    if not untrusted:
        return _digest(str(path), root)
    root = root or str(Path(path).resolve().parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "PXR_WORK_THREAD_LIMIT": "1"}
    try:
        done = subprocess.run(
            [sys.executable, "-m", "warp_reflect.stage.identity", str(path), root],
            capture_output=True,
            timeout=SECONDS,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"reading {path} took longer than {SECONDS:g} s") from None
    answer = done.stdout.decode(errors="replace").strip()
    if done.returncode != 0 or len(answer) != 2 * DIGEST_BYTES:
        last = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise ValueError(last or f"reading {path} failed: exit status {done.returncode}")
    return answer


def _digest(path: str, root: str) -> str:
    from pxr import Sdf, Tf, UsdUtils

    from warp_reflect.stage.intake import library_message
    from warp_reflect.stage.read import quiet

    with quiet():
        try:
            layers, assets, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(path))
        except Tf.ErrorException as fault:
            raise ValueError(f"cannot read {path}: {library_message(fault)}") from None
    named = {layer.realPath for layer in layers} | set(assets)
    # A file in a package: the package.
    files = {os.path.realpath(name.partition("[")[0] if name.endswith("]") else name) for name in named if name}
    folder = os.path.dirname(os.path.realpath(path))
    total = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for file in sorted(files | {os.path.realpath(path)}, key=lambda file: os.path.relpath(file, folder)):
        fault = confinement_fault(file, root)
        if fault:
            raise ValueError(f"cannot read {path}: the file {file} is {fault}")
        total.update(os.path.relpath(file, folder).encode())
        try:
            if not stat.S_ISREG(os.stat(file).st_mode):  # a pipe or a device: read, it might have no end
                total.update(b"no file")
                continue
            with open(file, "rb") as stream:
                total.update(hashlib.file_digest(stream, "blake2b").digest())
        except OSError as fault:
            total.update((fault.strerror or "unreadable").encode())
    for name in sorted(missing):
        total.update(name.encode())
    return total.hexdigest()


def main() -> int:
    """Print the digest of an untrusted stage; 1 and one line on stderr where it has none."""
    from warp_reflect.stage.child import limit_memory
    from warp_reflect.stage.layers import check_layers

    path, root = sys.argv[1:]
    limit_memory(MEMORY_BYTES)
    try:
        check_layers(str(Path(path).absolute()), Limits(root=root))
        print(_digest(path, root))
    except (ValueError, OSError) as fault:
        # The last line alone is told, and a file's name may have line ends.
        print(str(fault).replace("\n", " "), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
