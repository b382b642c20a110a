"""Time per named stage of a frame: of the wall's clock, or of another (`counted_by`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import warp as wp

from warp_reflect.counts import Statistics, add_statistics
from warp_reflect.launch import clocks, loading_ms, reads


@contextmanager
def counted_by(clock: Callable[[], float]) -> Iterator[None]:
    """Stages are timed by another clock: `time.thread_time` leaves out what others do on the machine.

    That counts the calling thread alone, and nothing that happens on a CUDA device.

    Args:
        clock: Gives seconds.
    """
    clocks.append(clock)
    try:
        yield
    finally:
        del clocks[len(clocks) - 1 - clocks[::-1].index(clock)]  # other threads may have come since


class StageTimer:
    """Adds up the time spent in named stages, in the order they were first entered.

    `with timer("raster"): ...` counts everything launched inside. On CUDA the device marks both ends, and is waited for only
    where the time is asked for (on the CPU a launch returns when it is done). The loading of kernels is left out. A stage
    opened inside another is named after it: "search" inside "reflect" is "reflect/search", and counts towards both. For one
    thread at a time.

    Attributes:
        ms: Stage name to milliseconds of the clock at hand (`counted_by`), or of the device.
    """

    def __init__(self, device: wp.DeviceLike = "cpu"):
        self.ms = Statistics()
        self._device = wp.get_device(device)
        self._open: list[str] = []

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        parent = self._open[-1] + "/" if self._open else ""
        full = name if name.startswith(parent) else parent + name
        add_statistics(self.ms, {full: 0.0})  # in the order they were entered
        self._open.append(full)
        clock, begin = clocks[-1], self._mark()
        start, loading = clock(), loading_ms()
        try:
            yield
        finally:
            if begin is None:
                add_statistics(self.ms, {full: 1000.0 * (clock() - start) - (loading_ms() - loading)})
            else:
                end = self._mark()
                self.ms.later(lambda: {full: wp.get_event_elapsed_time(begin, end)})
            self._open.pop()

    def count(self, ms: Mapping[str, float]) -> None:
        """Add what was spent before, under the names of outermost stages."""
        add_statistics(self.ms, ms)

    def count_inside(self, name: str, ms: Mapping[str, float]) -> None:
        """Add what was spent in stages inside one."""
        self.ms.later(lambda: {f"{name}/{inner}": spent for inner, spent in ms.items()})

    @property
    def total_ms(self) -> float:
        """Time in all outermost stages [ms]."""
        return sum(ms for name, ms in self.ms.items() if "/" not in name)

    def _mark(self) -> wp.Event | None:
        """A mark in what a CUDA device has to do."""
        if not self._device.is_cuda or not reads():
            return None
        mark = wp.Event(self._device, enable_timing=True)
        wp.record_event(mark)
        return mark
