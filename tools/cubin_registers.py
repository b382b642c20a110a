"""Registers, stack, spills and occupancy of every CUDA kernel, read from the binaries of each architecture; needs no GPU.

    python tools/cubin_registers.py                                  the modules of a frame, sm_75 to sm_120
    python tools/cubin_registers.py warp_reflect.bvh --arch 90 120

A row is a kernel. A cell is registers a thread / bytes of stack a thread / warps that a multiprocessor holds, in percent of the
most. `arrays` are those of the stack's bytes that the kernel declares itself, arrays that are indexed by a variable (`bvh`: the
stacks of Warp's ray queries); what the stack has beyond them are spilled registers, told as `+N` behind the stack's bytes.
Registers and stack stand in the section `.nv.info` of the binary, arrays in the PTX.

Occupancy by CUDA's Occupancy Calculator (CUDA C++ Best Practices Guide, "Calculating Occupancy"): registers are handed out to
warps in units of 256, warps to the four parts of a multiprocessor; a block of `launch.CUDA_BLOCK_DIM` threads holds no shared
memory here. Limits of an architecture: CUDA C++ Programming Guide, "Technical Specifications per Compute Capability".
"""

from __future__ import annotations

import argparse
import json
import re
import struct
import tempfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from warp_reflect import kernels
from warp_reflect.launch import CUDA_BLOCK_DIM

# Compute capability times ten to (warps, blocks) that a multiprocessor holds at most; every one has 65,536 registers.
LIMITS = {
    75: (32, 16),
    80: (64, 32),
    86: (48, 16),
    89: (48, 24),
    90: (64, 32),
    100: (64, 32),
    120: (48, 24),
}
REGISTERS, REGISTER_UNIT, PARTS = 65536, 256, 4
WARP = 32  # threads
# The plain kernels that draw a frame; the vector ones are the CPU's.
FRAME = (
    "raster",
    "surface",
    "shade",
    "direct",
    "shadow_starts",
    "shadows",
    "shadow_lists",
    "bvh",
    "bounces",
    "transmission",
    "techniques.forward",
    "techniques.virtual_mesh",
    "techniques.planar",
    "techniques.quadric_patch",
    "techniques.reflector_map",
    "techniques.interpolation",
    "techniques.refine",
)
# Of `.nv.info`: entries are (format, attribute, length), with a payload (symbol, value) in the format SIZED.
SIZED = 0x04
FRAME_SIZE, REGISTER_COUNT = 0x11, 0x2F
SYMBOL_BYTES = 24  # of a 64-bit ELF symbol
ENTRY = r"(\w+_kernel)_[0-9a-f]+_cuda_kernel_forward"


@dataclass(frozen=True)
class Used:
    """What a thread of a kernel uses on one architecture.

    Attributes:
        registers: 32 bits each.
        stack: All of it. [bytes]
        arrays: Of the stack, what the kernel declares. [bytes]
        occupancy: Warps that a multiprocessor holds at a time, as a share of the most.
    """

    registers: int
    stack: int
    arrays: int
    occupancy: float

    @property
    def spilled(self) -> int:
        """Bytes of registers that the stack holds."""
        return max(self.stack - self.arrays, 0)

    def __str__(self) -> str:
        spilled = f"+{self.spilled}" if self.spilled else ""
        return f"{self.registers}/{self.stack - self.spilled}{spilled}/{100.0 * self.occupancy:.0f}%"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", default=[f"warp_reflect.{name}" for name in FRAME])
    parser.add_argument("--arch", nargs="+", type=int, default=list(LIMITS), choices=list(LIMITS))
    parser.add_argument("--json", action="store_true", help="one JSON line per kernel")
    arguments = parser.parse_args()
    wp.config.log_level = wp.LOG_WARNING
    if not arguments.json:
        print(f"warp {wp.__version__}; registers / stack bytes a thread / occupancy")
        print(f"{'kernel':42s} {'arrays':>6s}" + "".join(f"{f'sm_{arch}':>14s}" for arch in arguments.arch))
    for module in arguments.modules:
        for kernel, used in sorted(kernels_of(module, arguments.arch).items()):
            if arguments.json:
                cells = {f"sm_{arch}": str(each) for arch, each in used.items()}
                arrays = max(each.arrays for each in used.values())
                print(json.dumps({"module": module, "kernel": kernel, "arrays": arrays, **cells}), flush=True)
                continue
            cells = (str(used[arch]) if arch in used else "-" for arch in arguments.arch)
            arrays = max(each.arrays for each in used.values())
            print(f"{kernel:42s} {arrays:6d}" + "".join(f"{cell:>14s}" for cell in cells), flush=True)


def kernels_of(module: str, architectures: list[int]) -> dict[str, dict[int, Used]]:
    """Kernel to architecture to what it uses."""
    found: dict[str, dict[int, Used]] = defaultdict(dict)
    for part in kernels.modules_of(module):
        # Arrays are declared before an architecture's registers are handed out: one text tells them for all.
        arrays = declared("".join(text.decode(errors="replace") for text in made(part, architectures[0], ".ptx")))
        for arch in architectures:
            for binary in made(part, arch, ".cubin"):
                for name, (registers, stack) in usage(binary).items():
                    found[name][arch] = Used(registers, stack, arrays.get(name, 0), occupancy(registers, arch))
    return found


def made(module: wp.Module, arch: int, suffix: str) -> list[bytes]:
    """A module compiled for one architecture: to text, `.ptx`, or to the machine's code, `.cubin`."""
    with tempfile.TemporaryDirectory() as folder:
        paths = wp.compile_aot_module(module, arch=[arch], module_dir=folder, use_ptx=suffix == ".ptx")
        return [Path(path).read_bytes() for path in paths if Path(path).suffix == suffix]


def occupancy(registers: int, arch: int, block_dim: int = CUDA_BLOCK_DIM) -> float:
    """Share of an architecture's warps that a multiprocessor holds of a kernel of that many registers a thread."""
    warps, blocks = LIMITS[arch]
    of_warp = -(-registers * WARP // REGISTER_UNIT) * REGISTER_UNIT
    held = REGISTERS // PARTS // of_warp * PARTS
    of_block = block_dim // WARP
    return min(held // of_block, warps // of_block, blocks) * of_block / warps


def declared(text: str) -> dict[str, int]:
    """Kernel to bytes of the arrays that its PTX declares in local memory."""
    found = {}
    parts = re.split(rf"\.entry {ENTRY}", text)
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        found[name] = sum(int(size) for size in re.findall(r"\.local [^;]*\[(\d+)\];", body))
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
        plain = re.fullmatch(ENTRY, name)
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
