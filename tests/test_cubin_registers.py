"""What the table of registers is made of: occupancy, arrays and the sections of a CUDA binary."""

from __future__ import annotations

import struct
import sys
from pathlib import Path

import pytest
import warp as wp

from warp_reflect import launch

ROOT = Path(__file__).parent.parent

wp.set_module_options({"enable_backward": False})


@pytest.fixture
def cubins(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import cubin_registers

    return cubin_registers


@wp.kernel
def indexed_kernel(first: int, out_sum: wp.array(dtype=float)):
    i = first + wp.tid()
    kept = wp.zeros(shape=(37,), dtype=float)
    for k in range(out_sum.shape[0]):
        kept[k % 37] += out_sum[k]
    out_sum[i] = kept[i % 37]


@pytest.mark.parametrize(
    ("registers", "arch", "share"),
    [
        # In blocks of 256 threads:
        # By hand: 65,536 registers are 2,048 threads of 32, 1,024 of 64; a block is 8 warps.
        (32, 80, 1.0),
        (33, 80, 0.75),  # 40 a thread, of which a quarter's 16,384 hold 12 warps
        (64, 90, 0.5),
        (65, 90, 0.375),  # 72 a thread: 7 warps a quarter, 28 in all, 3 blocks
        (128, 90, 0.25),
        (129, 90, 0.125),
        (255, 90, 0.125),
        (255, 75, 0.25),  # of half as many warps
        (64, 75, 1.0),
        (40, 120, 1.0),
        (41, 120, 5.0 / 6.0),
        (16, 86, 1.0),
    ],
)
def test_occupancy_is_what_registers_leave(cubins, registers, arch, share):
    assert cubins.occupancy(registers, arch, 256) == pytest.approx(share)
    assert cubins.occupancy(registers, arch) >= cubins.occupancy(registers, arch, 256)


def test_smaller_blocks_leave_less_of_a_multiprocessor_idle(cubins):
    """168 registers a thread are 5,376 a warp, three of which fit into a quarter; of blocks of 8 warps one fits, of 4 three."""
    assert (cubins.occupancy(168, 90, 256), cubins.occupancy(168, 90)) == (0.125, 0.1875)
    assert cubins.occupancy(launch.MOST_REGISTERS, 120) == 0.25 > cubins.occupancy(launch.MOST_REGISTERS + 1, 120)
    most = [max(cubins.occupancy(registers, 90, block) for block in (64, 256)) for registers in range(16, 256)]
    assert all(cubins.occupancy(16 + k, 90) >= share for k, share in enumerate(most))


def test_a_kernel_told_to_gets_no_more_registers_than_the_most(cubins, monkeypatch):
    told = launch.few_registers(wp.Kernel(indexed_kernel.func, key="indexed_kernel", module=wp.get_module("told")))
    told.module.options["enable_backward"] = False
    monkeypatch.setattr(launch, "MOST_REGISTERS", 24)
    fewer = launch.few_registers(wp.Kernel(indexed_kernel.func, key="indexed_kernel", module=wp.get_module("fewer")))
    fewer.module.options["enable_backward"] = False
    used = {}
    for kernel in (told, fewer):
        monkeypatch.setattr(cubins.kernels, "modules_of", lambda name, kernel=kernel: [kernel.module])
        used[kernel] = cubins.kernels_of("indexed", [90])["indexed_kernel"][90].registers
    assert used[fewer] <= 24 < used[told] <= 168


def test_an_indexed_array_stands_on_the_stack_and_is_no_spill(cubins, monkeypatch):
    monkeypatch.setattr(cubins.kernels, "modules_of", lambda name: [indexed_kernel.module])
    used = cubins.kernels_of("indexed", [75, 120])["indexed_kernel"]
    for each in used.values():
        assert 4 * 37 <= each.arrays < 1024  # Warp's own data of the array included
        assert each.arrays <= each.stack and each.spilled == each.stack - each.arrays
    assert str(cubins.Used(100, 48, 32, 0.25)) == "100/32+16/25%"
    assert str(cubins.Used(100, 24, 32, 0.25)) == "100/24/25%"


def test_what_is_no_binary_is_refused(cubins):
    with pytest.raises(ValueError, match="no 64-bit little-endian ELF"):
        cubins.sections_of(b"\x7fELF\x01\x01" + bytes(64))
    # One section, of names, empty.
    header = bytearray(64 + 64)
    header[:6] = b"\x7fELF\x02\x01"
    struct.pack_into("<Q", header, 0x28, 64)
    struct.pack_into("<HHH", header, 0x3A, 64, 1, 0)
    struct.pack_into("<IIQQQQ", header, 64, 0, 3, 0, 0, 6, 1)
    header[6] = 0
    assert cubins.sections_of(bytes(header)) == {"": b"\0"}
