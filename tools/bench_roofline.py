"""Each kernel of a frame beside what the machine can do: counted work, time, share of the measured peaks, what bounds it.

    python tools/bench_roofline.py usd_scenes/one_mirror.usda --size 1280x720
    python tools/bench_roofline.py usd_scenes/kitchen.usda --method reflector_map --json

The work is counted, not estimated: for elements drawn at random from each launch of a frame, the kernel is run in a copy of this
process one instruction at a time (Linux on x86-64, ptrace), and objdump tells what each instruction was. Additions,
multiplications, divisions and roots are one flop a lane, multiply-adds two; lanes that are masked out count, comparisons and
minima do not. Bytes are those of all loads and stores, so of the first cache; beside them stands what the launch was given, all
its arrays once, which is the least that memory can be asked for where caches are cold and all of it is used. An element of a
vector kernel is a block of `vector.BLOCK`.

Times are medians of one thread's processor time. Peaks are measured in the same process: multiply-adds in vectors, the triad
a = b + s c within the first cache and beyond all, and the clock. The bound is the peak of which the largest share is reached if
that is half or more; else `issue` where IPC_HIGH or more instructions start in a cycle, else `latency`: chains of operations and
branches that wait for each other.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import json
import os
import re
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import commit, machine

from warp_reflect import launch
from warp_reflect.launch import CPU_BLOCK_DIM

wp.set_module_options({"enable_backward": False})

# Of linux/ptrace.h and the layout of `struct user` of x86-64.
TRACEME, PEEK_TEXT, PEEK_USER, POKE_TEXT, POKE_USER, CONTINUE, STEP = 0, 1, 3, 4, 6, 7, 9
INSTRUCTION_POINTER, STACK_POINTER = 128, 152
BREAKPOINT = 0xCC
INSTRUCTION_MAX, SLOT = 15, 32  # bytes: of an instruction, and from one to the next where they are told apart
WIDTHS = {"BYTE": 1, "WORD": 2, "DWORD": 4, "QWORD": 8, "XMMWORD": 16, "YMMWORD": 32, "ZMMWORD": 64}
REGISTERS = {"xmm": 16, "ymm": 32, "zmm": 64}
ARITHMETIC = re.compile(
    r"v?(fn?m(?:add|sub)(?:add|sub)?\d{3}|add|sub|mul|div|sqrt|rcp(?:14)?|rsqrt(?:14)?)([ps])([sd])"
)
LONGEST = 30  # times its share of the steps, that the first element of a launch may take
PEAK_ROUNDS = 5
STUCK_SECONDS = 300  # stepping 100,000 instructions takes one
FMA_LOOPS, CLOCK_LOOPS = 400_000, 10_000_000
TRIAD_NEAR, TRIAD_FAR = 2048, 16_000_000  # floats of each array
TRIAD_BYTES = 4_000_000_000  # moved in a round, and a tenth of it beyond the caches
HALF = 0.5  # of a peak: it bounds
IPC_HIGH = 3.0  # instructions a cycle

FMA = r"""
#if !defined(__CUDACC_RTC__)
#if defined(__AVX512F__)
    constexpr int LANES = 16;
#else
    constexpr int LANES = 8;
#endif
    typedef float F __attribute__((ext_vector_type(LANES)));
    F a = F(1.0f), b = F(0.5f);
    F s[12];
    _Pragma("clang loop unroll(full)") for (int k = 0; k < 12; ++k) s[k] = F((float)k + seed);
    for (int i = 0; i < loops; ++i) {
        _Pragma("clang loop unroll(full)") for (int k = 0; k < 12; ++k) s[k] = __builtin_elementwise_fma(s[k], b, a);
    }
    F sum = s[0];
    _Pragma("clang loop unroll(full)") for (int k = 1; k < 12; ++k) sum += s[k];
    out_sum.data[0] = sum[0] + sum[LANES - 1];
    out_sum.data[1] = (float)(2 * 12 * LANES);
#endif
"""
TRIAD = r"""
#if !defined(__CUDACC_RTC__)
    typedef float F __attribute__((ext_vector_type(16), aligned(4)));
    for (int i = 0; i < loops; ++i) {
        const float s = seed + (float)i;
        for (int k = 0; k + 16 <= count; k += 16) {
            *(F*)(a.data + k) = *(const F*)(b.data + k) + F(s) * *(const F*)(c.data + k);
        }
    }
#endif
"""
# A rotation and an exclusive or that wait for each other: two cycles.
CLOCK = r"""
#if !defined(__CUDACC_RTC__)
    unsigned long long x = (unsigned long long)seed + 1;
    for (unsigned long long i = 0; i < (unsigned long long)loops; ++i) x = ((x << 7) | (x >> 57)) ^ i;
    out_sum.data[0] = (float)x;
#endif
"""


@wp.func_native(FMA)
def multiply_adds(loops: int, seed: float, out_sum: wp.array(dtype=float)): ...


@wp.func_native(TRIAD)
def triad(
    loops: int, seed: float, count: int, a: wp.array(dtype=float), b: wp.array(dtype=float), c: wp.array(dtype=float)
): ...


@wp.func_native(CLOCK)
def rotations(loops: int, seed: float, out_sum: wp.array(dtype=float)): ...


@wp.kernel
def fma_kernel(first: int, loops: int, seed: float, out_sum: wp.array(dtype=float)):
    multiply_adds(loops, seed, out_sum)


@wp.kernel
def triad_kernel(
    first: int,
    loops: int,
    seed: float,
    count: int,
    out_a: wp.array(dtype=float),
    b: wp.array(dtype=float),
    c: wp.array(dtype=float),
):
    triad(loops, seed, count, out_a, b, c)


@wp.kernel
def clock_kernel(first: int, loops: int, seed: float, out_sum: wp.array(dtype=float)):
    rotations(loops, seed, out_sum)


@dataclass(frozen=True)
class Peaks:
    """What one thread can do at most: flops, bytes of the first cache and of memory a nanosecond, cycles likewise."""

    flops: float
    near: float
    far: float
    clock: float


@dataclass
class Work:
    """Of one kernel of a frame.

    Attributes:
        elements: Launched.
        given: Bytes of all arrays of its launches, each once.
        sampled: Elements that were run step by step.
        instructions, flops, bytes: Of those.
    """

    elements: int = 0
    given: int = 0
    sampled: int = 0
    instructions: int = 0
    flops: int = 0
    bytes: int = 0
    counts: Counter = field(default_factory=Counter)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--size", default="1280x720", help="WxH")
    parser.add_argument("--method", default="auto")
    parser.add_argument("--kernels", default="auto", choices=("auto", "plain", "vector"))
    parser.add_argument("--rounds", type=int, default=7, help="timed frames, after one for warm-up")
    parser.add_argument("--steps", type=int, default=100_000, help="instructions a kernel that are counted one by one")
    parser.add_argument("--share", type=float, default=0.01, help="of the frame's time; kernels with less are left out")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if not sys.platform.startswith("linux") or os.uname().machine != "x86_64" or not shutil.which("objdump"):
        sys.exit("instructions are counted by ptrace and told by objdump: this needs Linux on x86-64 and binutils")
    if not may_trace():
        sys.exit("this system does not let a process be traced by its parent (ptrace)")
    wp.config.log_level = wp.LOG_WARNING
    peaks = measured_peaks()
    rows = [row for stage in arguments.stages for row in bench(stage, arguments, peaks)]
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
        return
    print(
        f"{machine()}; warp {wp.__version__}; {commit()}; {arguments.size}, {arguments.method}, 1 thread, no shadows; peaks: "
        f"{peaks.flops:.0f} Gflop/s, {peaks.near:.0f} GB/s first cache, {peaks.far:.0f} GB/s memory, {peaks.clock:.2f} GHz"
    )
    print(
        f"{'stage':12s} {'kernel':28s} {'ms':>7s} {'elements':>9s} {'flop/el':>8s} {'B/el':>7s} {'instr/el':>8s} "
        f"{'Gflop/s':>7s} {'peak':>5s} {'GB/s':>6s} {'peak':>5s} {'given MB':>8s} {'peak':>5s} {'IPC':>5s}  bound"
    )
    for row in rows:
        print(
            f"{row['stage'][:12]:12s} {row['kernel'][:28]:28s} {row['ms']:7.2f} {row['elements']:9d} "
            f"{row['flops']:8.0f} {row['bytes']:7.0f} {row['instructions']:8.0f} {row['gflops']:7.1f} "
            f"{100 * row['of_flops']:4.0f}% {row['gbytes']:6.1f} {100 * row['of_near']:4.0f}% {row['given_mb']:8.1f} "
            f"{100 * row['of_far']:4.0f}% {row['ipc']:5.2f}  {row['bound']}"
        )


def measured_peaks() -> Peaks:
    """Best of several rounds: what disturbs only ever slows."""

    def best(kernel, inputs: list) -> float:
        taken = []
        for turn in range(PEAK_ROUNDS + 1):
            start = time.thread_time()
            wp.launch(kernel, dim=1, inputs=[0, inputs[0], float(turn), *inputs[1:]], device="cpu")
            taken.append(1.0e9 * (time.thread_time() - start))
        return min(taken[1:])  # the first compiles

    out = wp.zeros(2, dtype=float, device="cpu")
    fma = best(fma_kernel, [FMA_LOOPS, out])
    of_loop = float(out.numpy()[1])
    rates = []
    for count, share in ((TRIAD_NEAR, 1.0), (TRIAD_FAR, 0.1)):
        arrays = [wp.ones(count, dtype=float, device="cpu") for _ in range(3)]
        loops = max(int(share * TRIAD_BYTES / (12 * count)), 1)
        rates.append(12.0 * count * loops / best(triad_kernel, [loops, count, *arrays]))
    clock = 2.0 * CLOCK_LOOPS / best(clock_kernel, [CLOCK_LOOPS, out])
    return Peaks(of_loop * FMA_LOOPS / fma, rates[0], rates[1], clock)


def bench(stage: str, arguments: argparse.Namespace, peaks: Peaks) -> list[dict]:
    """Rows of one stage, the dearest first."""
    import warp_reflect as wr

    size = tuple(int(side) for side in arguments.size.split("x"))
    scene = wr.load_stage(stage)
    settings = wr.Settings(threads=1, keep_static=False, shadows="off", kernels=arguments.kernels)
    plan = wr.make_plan(scene, size=size, settings=settings, method=arguments.method)
    frame = wr.render_frame(scene, plan)
    works: dict[str, Work] = defaultdict(Work)
    spent: Counter = Counter()
    pack, run = launch._packed, wp.Launch.launch

    def timed(command, *given):
        start = time.thread_time()
        run(command, *given)
        spent[command.kernel.key] += 1000.0 * (time.thread_time() - start)

    def noted(kernel, count, inputs, device):
        elements[kernel.key] += count
        return pack(kernel, count, inputs, device)

    def counted(kernel, count, inputs, device):
        work, asked = works[kernel.key], [0, *inputs]
        work.elements += count
        work.given += given(asked)
        if chosen[kernel.key]:
            steps = max(int(arguments.steps * count / chosen[kernel.key]), 1)
            count_instructions(kernel, count, asked, steps, work, rng, wp.launch)
        return pack(kernel, count, inputs, device)

    times: list[Counter] = []
    whole: list[float] = []
    try:
        launch._packed, wp.Launch.launch = noted, timed
        for round_ in range(arguments.rounds + 1):
            spent.clear()
            elements: Counter = Counter()
            start = time.thread_time()
            frame = wr.render_frame(scene, plan, previous=frame)
            if round_:
                whole.append(1000.0 * (time.thread_time() - start))
                times.append(spent.copy())
        ms = {kernel: statistics.median(each[kernel] for each in times) for kernel in spent}
        total = statistics.median(whole)
        chosen = Counter({kernel: elements[kernel] for kernel in ms if ms[kernel] >= arguments.share * total})
        rng = np.random.default_rng(1)
        launch._packed = counted
        wr.render_frame(scene, plan, previous=frame)
    finally:
        launch._packed, wp.Launch.launch = pack, run
    told = disassembled({address for work in works.values() for address in work.counts})
    rows = []
    for kernel in sorted(chosen, key=lambda kernel: -ms[kernel]):
        work = works[kernel]
        if work.sampled:
            for address, times_ in work.counts.items():
                flops, moved = told[address]
                work.instructions += times_
                work.flops += times_ * flops
                work.bytes += times_ * moved
            rows.append(
                {
                    "stage": Path(stage).stem,
                    "size": list(size),
                    "commit": commit(),
                    **row_of(kernel, work, ms[kernel], peaks),
                }
            )
    kernels_ms = sum(ms.values())
    print(f"{stage}: frame {total:.1f} ms, {kernels_ms:.1f} of them in kernels", file=sys.stderr)
    return rows


def row_of(kernel: str, work: Work, ms: float, peaks: Peaks) -> dict:
    """What a kernel does an element and a second, and the share of each peak that this is."""
    scale = work.elements / work.sampled / (1.0e6 * ms)  # sampled to a nanosecond of the frame's
    shares = {
        "arithmetic": scale * work.flops / peaks.flops,
        "first cache": scale * work.bytes / peaks.near,
        "memory": work.given / (1.0e6 * ms) / peaks.far,
    }
    ipc = scale * work.instructions / peaks.clock
    bound = max(shares, key=shares.get)
    if shares[bound] < HALF:
        bound = "issue" if ipc >= IPC_HIGH else "latency"
    return {
        "kernel": kernel,
        "ms": ms,
        "elements": work.elements,
        "sampled": work.sampled,
        "flops": work.flops / work.sampled,
        "bytes": work.bytes / work.sampled,
        "instructions": work.instructions / work.sampled,
        "gflops": scale * work.flops,
        "of_flops": shares["arithmetic"],
        "gbytes": scale * work.bytes,
        "of_near": shares["first cache"],
        "given_mb": work.given / 1.0e6,
        "of_far": shares["memory"],
        "ipc": ipc,
        "bound": bound,
    }


def given(inputs) -> int:
    """Bytes of the arrays that a launch is given, in structures too, each once."""
    seen: dict[int, int] = {}

    def look(value) -> None:
        if isinstance(value, wp.array):
            seen[value.ptr] = max(seen.get(value.ptr, 0), value.size * wp.types.type_size_in_bytes(value.dtype))
        elif hasattr(value, "_cls"):  # an instance of a wp.struct
            for name in value._cls.vars:
                look(getattr(value, name))

    for each in inputs:
        look(each)
    return sum(seen.values())


@functools.cache
def _ptrace():
    call = ctypes.CDLL(None, use_errno=True).ptrace
    call.restype, call.argtypes = ctypes.c_long, (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p)
    return call


def count_instructions(kernel, dim: int, inputs, steps: int, work: Work, rng, launch) -> None:
    """Add to `work` the instructions of elements of a launch, drawn at random, until `steps` of them are counted.

    They run in a forked copy of this process, whose memory nobody else sees; code stands at the same addresses in both.
    """
    entry = kernel.module.load(wp.get_device("cpu"), CPU_BLOCK_DIM).get_kernel_hooks(kernel).forward
    entry = ctypes.cast(entry, ctypes.c_void_p).value
    offsets = rng.permutation(dim) if dim <= steps else rng.integers(0, dim, steps)
    child = os.fork()
    if child == 0:
        try:
            # A lock that another thread held at the fork is never given back here.
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(STUCK_SECONDS)
            if _ptrace()(TRACEME, 0, None, None) == 0:
                os.kill(os.getpid(), signal.SIGSTOP)
                for offset in offsets:
                    launch(kernel, dim=1, inputs=[inputs[0] + int(offset), *inputs[1:]], device="cpu")
        finally:
            os._exit(0)
    ptrace = _ptrace()
    _, state = os.waitpid(child, 0)
    if not os.WIFSTOPPED(state):
        raise PermissionError("this system does not let a process be traced by its parent (ptrace)")
    word = ptrace(PEEK_TEXT, child, entry, None)
    trap = (word & ~0xFF) | BREAKPOINT
    left = steps
    try:
        while left > 0:
            ptrace(POKE_TEXT, child, entry, trap)
            ptrace(CONTINUE, child, None, None)
            _, state = os.waitpid(child, 0)
            if not os.WIFSTOPPED(state):
                return
            if os.WSTOPSIG(state) != signal.SIGTRAP:
                raise RuntimeError(f"{kernel.key}: signal {os.WSTOPSIG(state)} while its instructions were counted")
            ptrace(POKE_TEXT, child, entry, word)
            ptrace(POKE_USER, child, INSTRUCTION_POINTER, entry)
            back = ptrace(PEEK_TEXT, child, ptrace(PEEK_USER, child, STACK_POINTER, None), None)
            counts: Counter = Counter()
            at, taken, most = entry, 0, LONGEST * steps if left == steps else left
            while at != back and taken < most:
                counts[at] += 1
                taken += 1
                ptrace(STEP, child, None, None)
                os.waitpid(child, 0)
                at = ptrace(PEEK_USER, child, INSTRUCTION_POINTER, None)
            left -= taken
            if at == back:  # else it is not whole
                work.counts.update(counts)
                work.sampled += 1
    finally:
        if not (os.WIFEXITED(state) or os.WIFSIGNALED(state)):
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)


def may_trace() -> bool:
    """Whether this system lets a process be stepped by its parent."""
    child = os.fork()
    if child == 0:
        os._exit(0 if _ptrace()(TRACEME, 0, None, None) == 0 else 1)
    return os.waitpid(child, 0)[1] == 0


def disassembled(addresses: set[int]) -> dict[int, tuple[int, int]]:
    """(flops, bytes moved) of the instruction at each address of this process."""
    ordered = sorted(addresses)
    filler = b"\x90" * (
        SLOT - INSTRUCTION_MAX
    )  # so that what follows an instruction never reaches into the next one's place
    with tempfile.NamedTemporaryFile() as file:
        file.write(b"".join(ctypes.string_at(address, INSTRUCTION_MAX) + filler for address in ordered))
        file.flush()
        command = ["objdump", "-D", "-b", "binary", "-m", "i386:x86-64", "-M", "intel", "--no-show-raw-insn", file.name]
        text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = {}
    for line in text.splitlines():
        place, colon, instruction = line.partition(":\t")
        if colon:
            lines[int(place, 16)] = instruction.strip()
    return {address: cost(lines[SLOT * k]) for k, address in enumerate(ordered)}


def cost(instruction: str) -> tuple[int, int]:
    """(flops, bytes moved) of an instruction as objdump writes it in Intel's syntax."""
    name, _, operands = instruction.partition(" ")
    widths = [REGISTERS[each] for each in re.findall(r"\b([xyz]mm)\d", operands)]
    flops = 0
    arithmetic = ARITHMETIC.fullmatch(name)
    if arithmetic:
        lanes = 1 if arithmetic[2] == "s" else max(widths, default=16) // (4 if arithmetic[3] == "s" else 8)
        flops = lanes * (2 if "fm" in arithmetic[1] or "fnm" in arithmetic[1] else 1)
    if name in ("push", "pop", "call", "ret"):
        return 0, 8
    if name.startswith(("lea", "nop", "prefetch")):
        return 0, 0
    places = re.findall(r"\b([A-Z]+) (?:PTR|BCST) ", operands)
    moved = sum(WIDTHS.get(place, 0) for place in places)
    if "gather" in name or "scatter" in name:
        moved *= max(widths, default=16) // (8 if name.endswith(("pd", "q")) else 4)
    return flops, moved


if __name__ == "__main__":
    main()
