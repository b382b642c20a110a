"""Registers and stack of every CUDA kernel, read from the binaries that are made for each architecture; needs no GPU.

    python tools/cubin_registers.py                                  the hot modules, sm_75 to sm_120
    python tools/cubin_registers.py warp_reflect.bvh --arch 90 120

A row is a kernel; columns are registers a thread / bytes of stack a thread (spilled registers and arrays that are indexed by
a variable), per architecture. Both stand in the section `.nv.info` of the binary.
"""

from __future__ import annotations

import argparse
import itertools
import json
import re
import struct
import tempfile
from collections import defaultdict
from pathlib import Path

import warp as wp

from warp_reflect import kernels

ARCHITECTURES = (75, 80, 86, 89, 90, 100, 120)
HOT = (
    "warp_reflect.raster",
    "warp_reflect.surface",
    "warp_reflect.shade",
    "warp_reflect.techniques.quadric_patch",
    "warp_reflect.techniques.reflector_map",
    "warp_reflect.techniques.refine",
)
# Of `.nv.info`: entries are (format, attribute, length), with a payload (symbol, value) in the format SIZED.
SIZED = 0x04
FRAME_SIZE, REGISTER_COUNT = 0x11, 0x2F
SYMBOL_BYTES = 24  # of a 64-bit ELF symbol


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=HOT)
    parser.add_argument("--arch", nargs="+", type=int, default=ARCHITECTURES)
    parser.add_argument("--json", action="store_true", help="one JSON line per kernel")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if arguments.json:
        for module in arguments.modules:
            for kernel, used in sorted(kernels_of(module, arguments.arch).items()):
                cells = {f"sm_{arch}": f"{registers}/{stack}" for arch, (registers, stack) in used.items()}
                print(json.dumps({"module": module, "kernel": kernel, **cells}))
        return
    print(f"warp {wp.__version__}; registers / stack bytes a thread")
    print(f"{'kernel':42s}" + "".join(f"{f'sm_{arch}':>11s}" for arch in arguments.arch))
    for module in arguments.modules:
        for kernel, used in sorted(kernels_of(module, arguments.arch).items()):
            cells = (f"{used[arch][0]}/{used[arch][1]}" if arch in used else "-" for arch in arguments.arch)
            print(f"{kernel:42s}" + "".join(f"{cell:>11s}" for cell in cells))


def kernels_of(module: str, architectures: list[int]) -> dict[str, dict[int, tuple[int, int]]]:
    """Kernel to architecture to (registers, stack bytes)."""
    found: dict[str, dict[int, tuple[int, int]]] = defaultdict(dict)
    for part, arch in itertools.product(kernels.modules_of(module), architectures):
        with tempfile.TemporaryDirectory() as folder:
            made = wp.compile_aot_module(part, arch=[arch], module_dir=folder, use_ptx=False)
            for path in made:
                if Path(path).suffix == ".cubin":
                    for name, used in usage(Path(path).read_bytes()).items():
                        found[name][arch] = used
    return found


def usage(binary: bytes) -> dict[str, tuple[int, int]]:
    """Kernel to (registers, stack bytes) of one CUDA binary, an ELF file."""
    sections = sections_of(binary)
    symbols, names = sections[".symtab"], sections[".strtab"]
    values: dict[int, dict[int, int]] = defaultdict(dict)
    info, at = sections[".nv.info"], 0
    while at + 4 <= len(info):
        form, attribute, length = struct.unpack_from("<BBH", info, at)
        at += 4
        if form != SIZED:
            continue
        if attribute in (FRAME_SIZE, REGISTER_COUNT) and length == 8:
            symbol, value = struct.unpack_from("<II", info, at)
            values[attribute][symbol] = value
        at += length
    result = {}
    for symbol, registers in values[REGISTER_COUNT].items():
        start = struct.unpack_from("<I", symbols, symbol * SYMBOL_BYTES)[0]
        name = names[start : names.index(b"\0", start)].decode()
        plain = re.fullmatch(r"(\w+_kernel)_[0-9a-f]+_cuda_kernel_forward", name)
        if plain:
            result[plain[1]] = registers, values[FRAME_SIZE].get(symbol, 0)
    return result


def sections_of(binary: bytes) -> dict[str, bytes]:
    """Name to content of a 64-bit little-endian ELF file's sections."""
    if binary[:6] != b"\x7fELF\x02\x01":
        raise ValueError("no 64-bit little-endian ELF file")
    table = struct.unpack_from("<Q", binary, 0x28)[0]
    size, count, name_index = struct.unpack_from("<HHH", binary, 0x3A)
    entries = [struct.unpack_from("<IIQQQQ", binary, table + k * size) for k in range(count)]
    start, length = entries[name_index][4], entries[name_index][5]
    names = binary[start : start + length]
    return {
        names[entry[0] : names.index(b"\0", entry[0])].decode(): binary[entry[4] : entry[4] + entry[5]]
        for entry in entries
    }


if __name__ == "__main__":
    main()
