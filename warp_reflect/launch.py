"""Kernel launch on one device or on several CPU threads: the only place that calls `wp.launch`.

A Warp launch on the CPU is one loop on one thread. `launch` cuts it into slices that run at the same time;
a kernel therefore takes the first index of its slice as its first argument and works on element
`first + wp.tid()`. The threads take slice after slice, large ones first, until none is left: guided self-scheduling
(Polychronopoulos and Kuck, IEEE Transactions on Computers C-36, 1987), so that none waits long for another whose elements
cost more, or that begins late. Warp's CPU atomics are plain memory operations: kernels launched here write only to
elements that belong to their own index (or to their own row band, see raster.py), so that results are
bit-equal at any number of threads.

Warp builds a kernel twice for a CPU, for arrays without gaps between elements and for any, unless the kernel takes its number
as the first of two, `k, _ = wp.tid()`. Kernels that are long to build and long at each element do: theirs gain nothing from the
second form. Light ones would pay for the division that tells two numbers apart.
"""

from __future__ import annotations

import itertools
import math
import os
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache, partial
from time import perf_counter, thread_time
from typing import ClassVar

import warp as wp

SPLIT_MIN = 4096  # elements below which the hand-off (20-60 us) costs more than the second thread saves
# Of what is left, each thread takes a slice of so much: more would leave no room for elements that cost more than others.
TAKEN_SHARE = 1 / 2
# A thread's share is cut into so many of the smallest slices, by the milliseconds that all of the launch takes: each slice
# costs some 30 us itself, the last ones are waited for.
PIECES_A_ROOT_MS, MOST_PIECES = 1.6, 8
# Environment variable: the most threads of a launch where `threads` is 0, for processes that share a machine. It cuts
# launches, it plans nothing: a frame's plan is the same in all of them.
CORES_VARIABLE = "WARP_REFLECT_THREADS"
NUMBERS = {int: int, wp.int32: int, float: float, wp.float32: float}  # what is given for a kernel's numbers
CPU_BLOCK_DIM = 1  # what Warp launches with on the CPU
# Threads of a block on CUDA. Of Warp's own 256 a multiprocessor holds one block where a thread has more than 128 registers, and
# leaves idle what is not a whole one: with 160 it holds 8 warps of 256, 12 of 128 (`tools/cubin_registers.py`).
CUDA_BLOCK_DIM = 128
# A thread's at which three warps fit into each quarter of a multiprocessor: 16,384 are handed out in units of 256 a warp.
MOST_REGISTERS = 168
# Of kernels that follow rays: half of the most threads fit, which wait for memory in turn. What a ray is for is spilled, once
# for each walk. An H100 follows those of mirrors in 0.85 to 0.98 of the time that it takes with 116, which the compiler would
# hand out.
RAY_REGISTERS = 64
SLICE_ALIGN = 64  # elements; slices that share a cache line of results would ping-pong it

# Warp's own default (the option replaces it), without a number type that no kernel has: a third of what its header costs. What
# the header asks of its templates is made once with it, and not again in every module: 50 ms each. The last two are what Clang's
# driver would give a compiler: names of values and a check of its own code it does without, which is a twelfth of the time.
PLAIN_FLAGS = (
    "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-slp-recursion-max-depth=4 -DWP_NO_BFLOAT16 -fpch-instantiate-templates"
    " -discard-value-names -disable-llvm-verifier"
)
# And one flag: without NaN the box test's min and max are single instructions, which makes a query 1.5 to 1.8 times as fast.
# Warp's headers name NAN: no warnings about that. CUDA builds ignore the option.
FINITE_FLAGS = f"{PLAIN_FLAGS} -menable-no-nans -Wno-nan-infinity-disabled"
# What is in vectors already gains nothing from a search for more of them, which is a twelfth of compiling it; plain kernels get
# slower without it.
VECTOR_FLAGS = f"{PLAIN_FLAGS} -fno-slp-vectorize"
# These flags change what is made of the header's code, not the header: one does for all.
ALIKE_FLAGS = PLAIN_FLAGS, FINITE_FLAGS, VECTOR_FLAGS


# Of launches that were split, by their kernel and (binary) order of magnitude: what an element took last time. [s]
_measured: dict[tuple[wp.Kernel, int], float] = {}
_made: dict[wp.Kernel, tuple[wp.Launch, list]] = {}  # with the `_kind` of each argument after the first
_recordings: list[list[tuple[str, int]]] = []
_as_device: list[bool] = []
_unread = threading.local()
_loaded: dict[tuple, Future] = {}
_waiting = threading.local()
# The last one tells how long the calling thread waits for kernels: that by which the stages of a frame are timed. [s]
clocks: list[Callable[[], float]] = [perf_counter]


def loading_ms() -> float:
    """Milliseconds that the calling thread has waited for kernels to be compiled and loaded, by the `clocks` at hand then."""
    return 1000.0 * getattr(_waiting, "seconds", 0.0)


@contextmanager
def recorded() -> Iterator[list[tuple[str, int]]]:
    """Gives a list that gets (module.kernel, elements) of every launch made in the context, on all threads."""
    launches: list[tuple[str, int]] = []
    _recordings.append(launches)
    try:
        yield launches
    finally:
        # By identity: two recordings may hold equal lists.
        _recordings[:] = [each for each in _recordings if each is not launches]


def _record(kernel, count: int) -> None:
    for launches in _recordings:
        launches.append((f"{kernel.module.name}.{kernel.key}", count))


def stays(device) -> bool:
    """Whether numbers that only decide how much is launched stay on a device: on CUDA, where reading one waits for all work.

    A launch there goes over all that might be asked for, and its threads look at the number; on the CPU a number is at hand,
    and threads that find nothing to do cost as much as others.
    """
    return bool(_as_device) or not reads() or wp.get_device(device).is_cuda


def reads() -> bool:
    """Whether a device may be asked for a number: not where its work is only written down (`unread`)."""
    return getattr(_unread, "plan", None) is None


class Unread:
    """Work that is written down to be done later, and again.

    Attributes:
        marks: int32, one for each place (`mark`) that decides what is done after it; all 0 before the work. None: they are
            still counted, and all is done.
        is_last: Whether the work is written down; before that, once is enough of what is repeated.
        count: Of such places.
    """

    def __init__(self, marks: wp.array | None = None, is_last: bool = True):
        self.marks, self.is_last, self.count = marks, is_last, 0


@contextmanager
def unread(marks: wp.array | None = None, is_last: bool = True) -> Iterator[Unread]:
    """In the context the calling thread reads nothing from a device, whose work is written down to be done later, and again.

    Launches go over the most that there can be, and their threads look at what there is. A CPU goes a CUDA device's way
    (`stays`), with plain kernels.
    """
    before, _unread.plan = getattr(_unread, "plan", None), Unread(marks, is_last)
    try:
        yield _unread.plan
    finally:
        _unread.plan = before


def mark(device) -> wp.array:
    """Where nothing is read: int32 [1], 0 before the work that is written down, for one kernel of it to set."""
    plan = _unread.plan
    plan.count += 1
    if plan.marks is None:
        return wp.zeros(1, dtype=int, device=device)
    return plan.marks[plan.count - 1 : plan.count]


def when(mark: wp.array, work: Callable[[], None]) -> None:
    """Where nothing is read: launch what is to be done where a mark is set then; always where devices decide nothing."""
    if _unread.plan.marks is None:
        work()
    else:
        wp.capture_if(mark, on_true=work)


def while_marked(mark: wp.array, work: Callable[[], None], most: int) -> None:
    """The same as long as a mark is set, which the work sets anew.

    Args:
        mark, work: See `when`.
        most: Times that it is set, at most.
    """
    if _unread.plan.marks is not None:
        wp.capture_while(mark, while_body=work)
        return
    for _ in range(most if _unread.plan.is_last else 1):
        work()


@contextmanager
def as_device() -> Iterator[None]:
    """In the context a CPU goes a CUDA device's way (`stays`), for tests and tools of plain kernels."""
    _as_device.append(True)
    try:
        yield
    finally:
        _as_device.pop()


def thread_count(device, threads: int = 0) -> int:
    """Slices a launch is cut into: 1 on CUDA, else `threads`, or one per available core if 0."""
    if stays(device):
        return 1
    if threads > 0:
        return threads
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def shared_by(count: int, device, threads: int = 0, split_min: int = SPLIT_MIN) -> int:
    """Threads that a launch over `count` elements is shared by: 1 where it is not split."""
    parts = thread_count(device, threads)
    allowed = os.environ.get(CORES_VARIABLE, "") if threads == 0 else ""
    if allowed.isdecimal() and int(allowed) > 0:
        parts = min(parts, int(allowed))
    return 1 if count < split_min else parts


def slices(count: int, parts: int, pieces: int = MOST_PIECES, align: int = SLICE_ALIGN) -> list[tuple[int, int]]:
    """(first element, length) of a launch's slices: ever smaller ones.

    Args:
        count: Elements in all.
        parts: Threads.
        pieces: The smallest slices that a thread's share is worth.
        align: Elements that stay together.
    """
    least = count / (parts * pieces)
    made, first = [], 0
    while first < count:
        length = math.ceil(max((count - first) * TAKEN_SHARE / parts, least) / align) * align
        made.append((first, min(length, count - first)))
        first += length
    return made


def launch(
    kernel, count: int, inputs: list, device, threads: int = 0, split_min: int = SPLIT_MIN, align: int = 0
) -> None:
    """Run `kernel` for elements 0..count-1 and return when its outputs may be read by the next launch.

    Args:
        kernel: A kernel whose first argument is `first: int`, the first element of its slice.
        count: Elements in all.
        inputs: The arguments after `first`, outputs included.
        device: Warp device.
        threads: CPU threads; 0: one per core. Ignored on CUDA.
        split_min: Smallest count that is split over threads.
        align: Elements of runs that one thread works on, if a kernel writes to what belongs to a run; 0: any.
    """
    if count <= 0:
        return
    _record(kernel, count)
    device = wp.get_device(device)
    if device.is_cuda:
        wp.launch(kernel, dim=count, inputs=[0, *inputs], device=device, block_dim=CUDA_BLOCK_DIM)
        return
    # The arguments are checked and packed once; each thread has a copy of them, of which it sets what tells the slice.
    packed = _packed(kernel, count, inputs, device)
    parts = shared_by(count, device, threads, split_min)
    if parts == 1:
        packed.launch()
        return
    known, spent = (kernel, count.bit_length()), []
    pieces = round(PIECES_A_ROOT_MS * math.sqrt(1000.0 * count * _measured.get(known, 0.0)))
    align = align or (SLICE_ALIGN if split_min > SLICE_ALIGN else 1)
    left = deque(slices(count, parts, min(max(pieces, 1), MOST_PIECES), align))
    helping = [lambda: _take_slices(_own(packed), left, spent)] * (min(parts, len(left)) - 1)
    run_parallel([lambda: _take_slices(packed, left, spent), *helping])
    _measured[known] = sum(spent) / count


def _take_slices(own: wp.Launch, left: deque[tuple[int, int]], spent: list[float]) -> None:
    """Run slices of a launch that is this thread's own until none is left; adds the seconds that this took."""
    start = thread_time()
    while left:
        try:
            first, length = left.popleft()
        except IndexError:  # another thread was faster
            break
        _set_slice(own, first, length)
        own.launch()
    spent.append(thread_time() - start)


def _packed(kernel: wp.Kernel, count: int, inputs: list, device) -> wp.Launch:
    """A launch on the CPU, ready to run.

    The first one of a kernel is made by Warp and kept, without its arrays. The others differ from it in their arguments: what
    is just of the declared kind is taken as it is, anything else is looked at by Warp. All of this is run with cold caches,
    after a kernel that went over a picture: what it does counts several times over.
    """
    made, kinds = _made.get(kernel, (None, ()))
    if made is None or len(inputs) != len(kinds) or made.module_exec is not kernel.module.load(device, CPU_BLOCK_DIM):
        _load(kernel, device)
        made = wp.launch(kernel, dim=count, inputs=[0, *inputs], device=device, record_cmd=True)
        if made.kernel is kernel:  # and not the one of several that the arguments' types ask for
            own = _own(made)
            own.fwd_args = []
            _made[kernel] = own, [_kind(argument.type) for argument in kernel.adj.args[1:]]
        return _own(made)
    own = _own(made)
    own.fwd_args = [0, *inputs]
    params = own.params
    for k, (value, kind) in enumerate(zip(inputs, kinds, strict=True), 2):
        given = type(value)
        if given is wp.array:
            if kind == (value.dtype, value.ndim):
                params[k] = value.__ctype__()
                continue
        elif given is kind:
            params[k] = type(params[k])(value) if given is int or given is float else value.__ctype__()
            continue
        own.set_param_at_index(k - 1, value)
    _set_slice(own, 0, count)
    return own


def _kind(declared) -> object:
    """What `_packed` takes as it is for a declared argument: type and dimensions of an array, a structure, a number."""
    if type(declared) is wp.array:
        return declared.dtype, declared.ndim
    return NUMBERS.get(declared, getattr(declared, "instance_type", None))


def _set_slice(own: wp.Launch, first: int, count: int) -> None:
    """What `wp.Launch.set_dim` and `set_param_at_index` do, of one or of two dimensions: they take ten times as long."""
    dimensions = getattr(own.kernel.adj, "kernel_dim", 1)  # all the same to older versions of Warp
    own.bounds = own.params[0] = type(own.bounds)((count, 1)[:dimensions])
    own.params[1] = type(own.params[1])(first)
    own.fwd_args[:1] = [first]


def _own(packed: wp.Launch) -> wp.Launch:
    """A launch with the same arguments, some of which may be set."""
    own = object.__new__(type(packed))  # copy.copy() takes several times as long
    vars(own).update(vars(packed))
    own.params, own.fwd_args = list(packed.params), list(getattr(packed, "fwd_args", ()))
    return own


def few_registers(kernel: wp.Kernel) -> wp.Kernel:
    """A decorator over `wp.kernel`'s: on CUDA a thread gets at most `MOST_REGISTERS`; versions of Warp that cannot ignore it."""
    return most_registers(MOST_REGISTERS)(kernel)


def most_registers(count: int) -> Callable[[wp.Kernel], wp.Kernel]:
    """As `few_registers`, of so many."""

    def limited(kernel: wp.Kernel) -> wp.Kernel:
        kernel.options["cuda_max_registers"] = count
        return kernel

    return limited


def launch_bands(kernel, count: int, bands: list[tuple[int, int]], inputs: list, device) -> None:
    """On a CPU, run `kernel` for elements 0..count-1 once per band, the bands at the same time.

    The kernel's last two arguments are the rows [row_first, row_end) of its band; it writes nothing outside them.
    """
    if count <= 0 or not bands:
        return
    _record(kernel, count)
    packed = _packed(kernel, count, [*inputs, *bands[0]], device)

    def draw(band: tuple[int, int]) -> None:
        own = _own(packed)
        for k, row in enumerate(band, len(inputs) + 1):
            own.set_param_at_index(k, row)
        own.launch()

    run_parallel([partial(draw, band) for band in bands])


def module_part(home: str, name: str, **options) -> wp.Module:
    """A part of a kernel module, for `wp.kernel(module=...)`: compiled only where one of its own kernels is launched.

    Args:
        home: The Python module, `__name__`.
        name: What the part is for.
        options: Of Warp's module, beside the house's own.
    """
    made = wp.get_module(f"{home}.{name}")
    made.options.update({"enable_backward": False, **options})
    return made


def ready(modules: Iterable[wp.Module], device) -> list[Future]:
    """Begin to compile and load kernel modules for a CPU, several at a time; a launch waits for its own."""
    return [_begun(module, wp.get_device(device)) for module in modules]


def is_compiling() -> bool:
    """Whether a kernel module is on its way."""
    return not all(loading.done() for loading in _loaded.values())


def _load(kernel, device) -> None:
    # The module must be compiled and loaded before threads race for it.
    device = wp.get_device(device)
    loading = _begun(kernel.module, device)
    if not loading.done():
        clock = clocks[-1]
        start = clock()
        loading.exception()
        _waiting.seconds = getattr(_waiting, "seconds", 0.0) + clock() - start
    loading.result()


def _begun(module: wp.Module, device: wp.Device) -> Future:
    # A process that was forked has none of its parent's threads: it begins anew, with what is loaded already.
    key = module, str(device), os.getpid()
    if key not in _loaded:
        own = VECTOR_FLAGS if "_vector" in module.name.rpartition(f"{__package__}.")[2] else PLAIN_FLAGS
        module.options["cpu_compiler_flags"] = module.options["cpu_compiler_flags"] or own
        _loaded[key] = _compilers(os.getpid()).submit(_compile, module, device)
    return _loaded[key]


@cache
def _compilers(process: int) -> ThreadPoolExecutor:
    """Threads that compile, one per core.

    Flags that differ in what `-mllvm` sets would not do: Warp compiles those one after the other.
    """
    return ThreadPoolExecutor(thread_count("cpu"), "warp_reflect_compile", _headers(process).share)


def _compile(module: wp.Module, device: wp.Device) -> None:
    # Not begun where the program is at its end, which waits for these threads.
    if threading.main_thread().is_alive():
        with _headers(os.getpid()).at_hand(module.options["cpu_compiler_flags"]):
            # With the block size of a CPU launch: it is part of the module's identity, and another one would compile
            # everything a second time.
            module.load(device, CPU_BLOCK_DIM)


@cache
def _headers(process: int) -> _Headers:
    return _Headers()


class _Headers:
    """Precompiled headers of Warp's own code, one for every set of flags, that the threads which compile share.

    Each costs as much as a module or two, and Warp has each thread make its own, in a folder of its own.
    """

    def __init__(self):
        self._folder = tempfile.TemporaryDirectory(prefix="wp_pch_")
        self._is_shared = False
        self._makes: dict[tuple[str, ...], threading.Lock] = {}
        self._made: set[str] = set()

    def share(self) -> None:
        """Have the calling thread's headers be those of all."""
        with suppress(AttributeError):  # a version of Warp that keeps them elsewhere: they are not shared
            wp._src.context.runtime._pch_dirs[threading.get_ident()] = self._folder
            self._is_shared = True

    @contextmanager
    def at_hand(self, flags: str) -> Iterator[None]:
        """In the context a module is compiled with these flags, or loaded; by one thread while there is no header for them."""
        if self._is_shared and flags not in self._made:
            alike = ALIKE_FLAGS if flags in ALIKE_FLAGS else (flags,)
            with self._makes.setdefault(alike, threading.Lock()):
                if flags not in self._made:
                    before = set(os.listdir(self._folder.name))
                    yield
                    self._keep(set(os.listdir(self._folder.name)) - before, flags, alike)
                    return
        yield

    def _keep(self, names: set[str], flags: str, alike: tuple[str, ...]) -> None:
        """Of new files one, if any, is a header for these flags; it is given the names of those that would be the same."""
        if names:
            self._made.add(flags)
        own = _flags_hash(flags)
        for name, other in itertools.product(names, alike):
            place = os.path.join(self._folder.name, name.replace(own, _flags_hash(other)))
            if own in name and not os.path.exists(place):
                os.link(os.path.join(self._folder.name, name), place)
                self._made.add(other)


def _flags_hash(flags: str) -> str:
    """What Warp tells headers apart by: FNV-1a of 64 bits over each flag and a zero byte (warp/native/clang/clang.cpp)."""
    told = 0xCBF29CE484222325
    for byte in b"".join(flag.encode() + b"\0" for flag in flags.split()):
        told = (told ^ byte) * 0x100000001B3 % 2**64
    return f"{told:016x}"


def run_parallel(jobs: list[Callable[[], None]]) -> None:
    """Run the callables at the same time, the first on the calling thread; re-raise the first failure.

    What no other thread has begun when the calling one is done, as all cores are busy, that one does itself.
    """
    if not jobs:
        return
    helpers = [_Helper.begin(job) for job in jobs[1:]]
    failures: list[BaseException] = []
    for job in (jobs[0], *(helper.finish for helper in helpers)):
        try:
            job()
        except BaseException as failure:  # others still write to the launch's arrays
            failures.append(failure)
    if failures:
        raise failures[0]


class Turns:
    """A lock that threads of one process wait for: one that was forked has none of its parent's, which may have held it."""

    def __init__(self):
        self._locks: dict[int, threading.RLock] = {}

    def __enter__(self) -> None:
        process = os.getpid()
        (self._locks.get(process) or self._locks.setdefault(process, threading.RLock())).acquire()

    def __exit__(self, *failure) -> None:
        self._locks[os.getpid()].release()


class _Helper:
    """A thread that waits for one job after the other: less goes to and fro than with the futures of a pool."""

    idle: ClassVar[dict[int, list[_Helper]]] = {}  # by process: one that was forked has none of its parent's threads

    def __init__(self):
        self._job: Callable[[], None] | None = None
        self._failure: BaseException | None = None
        self._asked, self._done = threading.Lock(), threading.Lock()
        self._asked.acquire()
        self._done.acquire()
        threading.Thread(target=self._work, name="warp_reflect", daemon=True).start()

    @classmethod
    def begin(cls, job: Callable[[], None]) -> _Helper:
        """A helper that is at a job, or will be."""
        idle = cls.idle.setdefault(os.getpid(), [])
        try:
            helper = idle.pop()
        except IndexError:
            helper = cls()
        helper._job = job
        helper._asked.release()
        return helper

    def finish(self) -> None:
        """Wait for the job, or do it where it is not begun; raise its failure."""
        if self._asked.acquire(blocking=False):
            job, failure = self._job, None
        else:
            self._done.acquire()
            job, failure = None, self._failure
        self._job = self._failure = None
        self.idle[os.getpid()].append(self)
        if job is not None:
            job()
        if failure is not None:
            raise failure

    def _work(self) -> None:
        while True:
            self._asked.acquire()
            try:
                self._job()
            except BaseException as failure:  # raised where it is waited for
                self._failure = failure
            self._done.release()
