"""The counting of a kernel's instructions: what one is worth, and that sampled elements are whole."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

ROOT = Path(__file__).parent.parent
STEPPED = sys.platform.startswith("linux") and os.uname().machine == "x86_64" and shutil.which("objdump") is not None

wp.set_module_options({"enable_backward": False})


@pytest.fixture
def roofline(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import bench_roofline

    return bench_roofline


@pytest.mark.parametrize(
    ("instruction", "flops", "moved"),
    [
        ("vmulps zmm0,zmm1,ZMMWORD PTR [rax+0x40]", 16, 64),
        ("vfmadd231ps ymm0,ymm1,ymm2", 16, 0),
        ("vfnmsub132ss xmm0,xmm1,DWORD PTR [rdx]", 2, 4),
        ("vaddss xmm3,xmm3,xmm4", 1, 0),
        ("addsd xmm0,QWORD PTR [rip+0x10]", 1, 8),
        ("vdivpd ymm0,ymm1,ymm2", 4, 0),
        ("vsqrtps xmm0,xmm1", 4, 0),
        ("vmulps zmm0,zmm1,DWORD BCST [rax]", 16, 4),
        ("vmaxps zmm0,zmm1,zmm2", 0, 0),
        ("add rax,QWORD PTR [rbx]", 0, 8),
        ("vpaddd zmm0,zmm1,zmm2", 0, 0),
        ("vgatherdps zmm0{k1},DWORD PTR [rax+zmm1*4]", 0, 64),
        ("lea rax,[rbx+rcx*4]", 0, 0),
        ("nop WORD PTR cs:[rax+rax*1+0x0]", 0, 0),
        ("push rbp", 0, 8),
        ("ret", 0, 8),
        ("vmovups ZMMWORD PTR [rsp],zmm3", 0, 64),
    ],
)
def test_an_instruction_is_worth_its_lanes_and_its_operands(roofline, instruction, flops, moved):
    assert roofline.cost(instruction) == (flops, moved)


@wp.kernel
def known_kernel(first: int, rounds: int, a: wp.array(dtype=float), out_sum: wp.array(dtype=float)):
    i = first + wp.tid()
    x = a[i]
    for _ in range(rounds):
        x = x * 1.5 + 0.25
    out_sum[i] = x


@pytest.mark.skipif(not STEPPED, reason="ptrace and objdump are of Linux with binutils")
def test_the_flops_of_a_known_kernel_are_counted(roofline):
    if not roofline.may_trace():
        pytest.skip("this system lets no process be traced")
    a, out = wp.ones(64, dtype=float, device="cpu"), wp.zeros(64, dtype=float, device="cpu")
    inputs = [0, 10, a, out]
    work = roofline.Work()
    roofline.count_instructions(known_kernel, 64, inputs, 2000, work, np.random.default_rng(2), wp.launch)
    assert 1 < work.sampled < 64
    assert not out.numpy().any()  # it ran elsewhere
    told = roofline.disassembled(set(work.counts))
    flops = sum(times * told[address][0] for address, times in work.counts.items())
    assert flops == 20 * work.sampled
    assert roofline.given(inputs) == 512
    peaks = roofline.Peaks(100.0, 100.0, 10.0, 3.0)
    work.elements, work.given, work.flops, work.instructions = 64, 512, flops, sum(work.counts.values())
    row = roofline.row_of(
        "known_kernel", work, 64 * 20 / 1.0e6 / 80.0, peaks
    )  # so long that 80 of 100 flops are reached
    assert row["of_flops"] == pytest.approx(0.8) and row["bound"] in ("arithmetic", "memory")
    assert row["gflops"] == pytest.approx(80.0)
