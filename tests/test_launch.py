"""Launches that are split over threads: every element once, whatever the slices."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_reflect import launch

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_up_kernel(first: int, step: int, out_times: wp.array(dtype=int), out_run: wp.array(dtype=int)):
    """One thread per element: how often each is met, and how many there are in each run of `step`."""
    i = first + wp.tid()
    out_times[i] += 1
    out_run[i / step] += 1


@pytest.mark.parametrize("split_min", [1, 8, 64, launch.SPLIT_MIN])
@pytest.mark.parametrize("parts", [2, 3, 8])
@pytest.mark.parametrize("count", [1, 63, 401, 14400, 462_657])
def test_slices_are_all_elements_once_the_large_ones_first(count, parts, split_min):
    made = launch.slices(count, parts, split_min)
    ends = np.cumsum([length for _, length in made])
    assert [first for first, _ in made] == [0, *ends[:-1]] and ends[-1] == count
    lengths = [length for _, length in made]
    assert sorted(lengths, reverse=True) == lengths and lengths[-1] > 0
    assert len(made) == 1 or max(lengths) <= max(count / parts, split_min)
    assert len(made) <= 6 * parts  # each costs something


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


def test_failure_of_any_thread_is_raised():
    def fail():
        raise ValueError("this one")

    done = []
    with pytest.raises(ValueError, match="this one"):
        launch.run_parallel([lambda: done.append(0), fail])
    assert done == [0]
