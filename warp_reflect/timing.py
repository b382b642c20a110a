"""Time per named stage of a frame: of the wall's clock, or of another (`counted_by`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter

import warp as wp

from warp_reflect.launch import loading_ms

_clocks: list[Callable[[], float]] = [perf_counter]


@contextmanager
def counted_by(clock: Callable[[], float]) -> Iterator[None]:
    """Stages are timed by another clock: `time.thread_time` leaves out what others do on the machine.

    That counts the calling thread alone, and nothing that happens on a CUDA device.

    Args:
        clock: Gives seconds.
    """
    _clocks.append(clock)
    try:
        yield
    finally:
        _clocks.remove(clock)


class StageTimer:
    """Adds up the time spent in named stages, in the order they were first entered.

    `with timer("raster"): ...` counts everything launched inside: on CUDA the device is waited for at both
    ends (on the CPU a launch returns when it is done). The loading of kernels is left out. A stage opened inside
    another is named after it: "search" inside "reflect" is "reflect/search", and counts towards both. For one
    thread at a time.

    Attributes:
        ms: Stage name to milliseconds of the clock at hand (`counted_by`).
    """

    def __init__(self, device: wp.DeviceLike = "cpu"):
        self.ms: dict[str, float] = {}
        self._device = wp.get_device(device)
        self._open: list[str] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        parent = self._open[-1] + "/" if self._open else ""
        full = name if name.startswith(parent) else parent + name
        self.ms.setdefault(full, 0.0)
        self._open.append(full)
        self._wait()
        clock = _clocks[-1]
        start, loading = clock(), loading_ms()
        try:
            yield
            self._wait()
        finally:
            self.ms[full] += 1000.0 * (clock() - start) - (loading_ms() - loading)
            self._open.pop()

    def count(self, ms: Mapping[str, float]) -> None:
        """Add what was spent before, under the names of outermost stages."""
        for name, spent in ms.items():
            self.ms[name] = self.ms.get(name, 0.0) + spent

    @property
    def total_ms(self) -> float:
        """Time in all outermost stages [ms]."""
        return sum(ms for name, ms in self.ms.items() if "/" not in name)

    def _wait(self) -> None:
        if self._device.is_cuda:
            wp.synchronize_device(self._device)
