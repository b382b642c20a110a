"""Launches that are split over threads: every element once, whatever the slices."""

from __future__ import annotations

import gc
import os
import threading
import time
import weakref
from functools import partial
from typing import Any

import numpy as np
import pytest
import warp as wp

from warp_reflect import launch, timing

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_up_kernel(first: int, step: int, out_times: wp.array(dtype=int), out_run: wp.array(dtype=int)):
    """One thread per element: how often each is met, and how many there are in each run of `step`."""
    i = first + wp.tid()
    out_times[i] += 1
    out_run[i / step] += 1


@pytest.mark.parametrize("pieces", [1, 3, launch.MOST_PIECES])
@pytest.mark.parametrize("parts", [2, 3, 8])
@pytest.mark.parametrize("count", [1, 63, 401, 14400, 462_657])
def test_slices_are_all_elements_once_the_large_ones_first(count, parts, pieces):
    for align in (1, launch.SLICE_ALIGN):
        made = launch.slices(count, parts, pieces, align)
        ends = np.cumsum([length for _, length in made])
        assert [first for first, _ in made] == [0, *ends[:-1]] and ends[-1] == count
        lengths = [length for _, length in made]
        assert sorted(lengths, reverse=True) == lengths and lengths[-1] > 0
        assert max(lengths) < count / parts + align
        assert len(made) <= (pieces + 1) * parts  # each costs something


def test_slices_keep_runs_together():
    made = launch.slices(10_000, 4, align=640)
    assert {first % 640 for first, _ in made} == {0}
    assert sum(length for _, length in made) == 10_000


@pytest.mark.parametrize("threads", [1, 2, 8])
def test_a_launch_meets_every_element_once(threads):
    count, step = 100_003, 1280
    times = wp.zeros(count, dtype=int, device="cpu")
    runs = wp.zeros(-(-count // step), dtype=int, device="cpu")
    launch.launch(count_up_kernel, count, [step, times, runs], "cpu", threads, align=step)
    assert (times.numpy() == 1).all()
    np.testing.assert_array_equal(runs.numpy(), [*[step] * (count // step), count % step])


@wp.kernel
def add_kernel(first: int, given: wp.array(dtype=Any), more: float, out_sum: wp.array(dtype=Any)):
    i = first + wp.tid()
    out_sum[i] = given[i] + given.dtype(more)


def test_launches_of_one_kernel_differ_in_their_arguments_alone():
    """Of a kernel for many types, too; what is wrong is told at every launch, and no array is kept."""
    for kind, host in ((float, np.float32), (wp.float64, np.float64), (float, np.float32)):
        for count, more in ((3, 0.5), (5000, 2.0)):
            given = wp.array(np.arange(count), dtype=kind, device="cpu")
            out = wp.zeros(count, dtype=kind, device="cpu")
            launch.launch(add_kernel, count, [given, more, out], "cpu", 2)
            np.testing.assert_array_equal(out.numpy(), np.arange(count, dtype=host) + more)
    times, runs = (wp.zeros(5000, dtype=int, device="cpu") for _ in range(2))
    for step in (1, 5000):
        launch.launch(count_up_kernel, 5000, [step, times, runs], "cpu", 1)
    assert runs.numpy()[:2].tolist() == [5001, 1] and (times.numpy() == 2).all()
    wrong = wp.zeros(5000, dtype=float, device="cpu")
    for inputs, message in (
        ([1, times, wrong], "dtype"),
        ([1, times], "arguments"),
        ([1, times, None, 1], "arguments"),
    ):
        with pytest.raises(RuntimeError, match=message):
            launch.launch(count_up_kernel, 5000, inputs, "cpu", 1)
    gone = weakref.ref(wrong)
    del wrong, inputs
    gc.collect()
    assert gone() is None


@wp.struct
class Scale:
    factor: float


@wp.kernel
def scale_kernel(first: int, by: Scale, plus: wp.vec3, more: float, out_sum: wp.array(dtype=wp.vec3)):
    i = first + wp.tid()
    out_sum[i] = by.factor * float(i) * plus + wp.vec3(more, more, more)


def test_structures_vectors_and_numbers_are_those_of_each_launch():
    by = Scale()
    for factor, plus, more in ((1.0, (1, 2, 3), 0.5), (2.0, (3, 2, 1), 4), (0.5, (0, 1, 0), np.float32(0.25))):
        by.factor = factor
        for threads in (1, 2):
            out = wp.zeros(9000, dtype=wp.vec3, device="cpu")
            launch.launch(scale_kernel, 9000, [by, wp.vec3(*plus), more, out], "cpu", threads)
            expected = factor * np.arange(9000)[:, None] * np.array(plus) + float(more)
            np.testing.assert_array_equal(out.numpy(), expected.astype(np.float32))
    with pytest.raises(RuntimeError, match="more"):
        launch.launch(scale_kernel, 9000, [by, wp.vec3(), "much", out], "cpu", 1)


@pytest.mark.parametrize("failing", [0, 1, 2])
def test_failure_of_any_thread_is_raised_when_all_are_done(failing):
    done = []

    def job(k):
        if k == failing:
            raise ValueError(f"number {k}")
        time.sleep(0.01)
        done.append(k)

    for _ in range(3):
        done.clear()
        with pytest.raises(ValueError, match=f"number {failing}"):
            launch.run_parallel([partial(job, k) for k in range(3)])
        assert sorted(done) == [k for k in range(3) if k != failing]


class Slow:
    """A module that takes some seconds of a clock to load."""

    def __init__(self, now: list[float], seconds: float):
        self._now, self._seconds = now, seconds

    def done(self) -> bool:
        return False

    def exception(self) -> None:
        self._now[0] += self._seconds

    def result(self) -> None:
        """Nothing went wrong."""


@pytest.mark.parametrize("seconds", [7.0, 0.0])
def test_waiting_for_kernels_is_left_out_of_what_a_stage_takes(seconds, monkeypatch):
    """By a clock of the wall, and by one that stands while its thread waits; what another thread waits for is no part of it."""
    now = [0.0]
    monkeypatch.setattr(launch, "_begun", lambda module, device: Slow(now, seconds))
    with timing.counted_by(lambda: now[0]):
        timer = timing.StageTimer()
        with timer("loads"):
            launch._load(count_up_kernel, "cpu")
            now[0] += 2.0
        with timer("beside"):
            other = threading.Thread(target=launch._load, args=(count_up_kernel, "cpu"))
            other.start()
            other.join()
    assert dict(timer.ms) == {"loads": 2000.0, "beside": 1000.0 * seconds}


def test_a_clock_inside_another_is_taken_off_alone():
    with timing.counted_by(time.thread_time):
        with timing.counted_by(time.perf_counter):
            assert launch.clocks[-1] is time.perf_counter
        assert launch.clocks == [time.perf_counter, time.thread_time]
    assert launch.clocks == [time.perf_counter]


def test_launches_of_many_threads_do_not_get_into_each_others_way():
    results = []

    def launching(seed):
        for k in range(20):
            times = wp.zeros(20_000 + 64 * seed + k, dtype=int, device="cpu")
            runs = wp.zeros(1, dtype=int, device="cpu")
            launch.launch(count_up_kernel, len(times), [1 << 30, times, runs], "cpu", 3)
            results.append((times.numpy() == 1).all())

    threads = [threading.Thread(target=launching, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 80 and all(results)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system forks no processes")
def test_a_forked_process_has_helpers_of_its_own():
    launch.run_parallel([int, int])  # this one's have been at work
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        done = threading.Event()
        launch.run_parallel([lambda: done.wait(10.0), done.set])  # the second one at the same time
        os._exit(0 if done.is_set() and launch._Helper.idle.keys() == {parent, os.getpid()} else 1)
    assert os.waitpid(child, 0)[1] == 0
