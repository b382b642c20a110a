"""Numbers of what is meant, found on a device's way and by NumPy: the same."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warp_reflect import compact, launch, surface
from warp_reflect.layers import pixel_bounds


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("count", [0, 1, 1000])
def test_marked_elements_are_listed_in_order(count, share, device):
    rng = np.random.default_rng(count)
    marks = np.where(rng.random(count) < share, 3, rng.choice([1, 2, 4, 255], count)).astype(np.uint8)
    given = wp.array(marks, dtype=wp.uint8, device=device)
    expected = np.flatnonzero(marks == 3)
    for way in (launch.as_device, launch.recorded):
        with way():
            numbers, (all_numbers, listed) = compact.marked(given, 3), compact.padded(given, 3)
        assert numbers.dtype == wp.int32
        np.testing.assert_array_equal(numbers.numpy(), expected)
        assert listed.numpy().tolist() == [len(expected)]
        np.testing.assert_array_equal(all_numbers.numpy()[: len(expected)], expected)
        assert (all_numbers.numpy()[len(expected) :] == -1).all()


@pytest.mark.parametrize("way", [launch.as_device, launch.recorded])
def test_elements_are_taken_and_put_back(way, device):
    values = np.arange(30, dtype=np.float32).reshape(10, 3)
    array, numbers = wp.array(values, dtype=wp.vec3, device=device), wp.array([7, 0, 4], dtype=int, device=device)
    changed = wp.zeros(10, dtype=wp.vec3, device=device)
    with way():
        some = compact.taken(array, numbers)
        compact.put(changed, numbers, some)
    np.testing.assert_array_equal(some.numpy(), values[[7, 0, 4]])
    np.testing.assert_array_equal(changed.numpy(), np.where(np.isin(np.arange(10), [7, 0, 4])[:, None], values, 0.0))


@pytest.mark.parametrize("wanted", [(1,), (2, 9, 4, 5)])
@pytest.mark.parametrize("kind", ["none", "all of one", "scattered", "blocks", "over the edge"])
def test_pixels_sorted_by_id_are_those_found_one_by_one(kind, wanted, device):
    width, height = 37, 23
    rng = np.random.default_rng(3)
    ids = np.zeros((height, width), np.int32)
    if kind == "all of one":
        ids[:] = wanted[0]
    elif kind == "scattered":
        ids[:] = rng.choice([0, *wanted[:3]], ids.shape)
    elif kind == "blocks":
        for k, id in enumerate(wanted):
            ids[3 + 5 * k : 6 + 5 * k, 4 + k : 20 - k] = id
    elif kind == "over the edge":
        ids.reshape(-1)[width - 2 : width + 3] = wanted[0]  # the end of a row and the beginning of the next
        ids.reshape(-1)[-1] = wanted[-1]
    flat = ids.reshape(-1)
    expected, ends = surface._pixels_by_id(flat, wanted)
    found, runs = surface._sorted_by_id(wp.array(flat, dtype=int, device=device), wanted, width)
    np.testing.assert_array_equal(found.numpy(), expected)
    assert runs.keys() == ends.keys() == set(wanted)
    for id, (first, end, box) in runs.items():
        np.testing.assert_array_equal(expected[first:end], np.flatnonzero(flat == id))
        assert (first, end) == ends[id] or (first == end and ends[id][0] == ends[id][1])
        assert box == pixel_bounds(expected[first:end], width)


def test_what_is_not_black_is_listed_and_everything_counted(device):
    values = np.random.default_rng(2).random((500, 3)).astype(np.float32)
    values[::3] = 0.0
    values[1::3, 1:] = 0.0
    given = wp.array(values, dtype=wp.vec3, device=device)
    marks = wp.array((values[:, 2] > 0.5).astype(np.uint8), dtype=wp.uint8, device=device)
    for way in (launch.as_device, launch.recorded):
        with way():
            found, numbers, count = compact.positive(given), compact.every(500, device), compact.counted(marks, 1)
        np.testing.assert_array_equal(found.numbers.numpy(), np.flatnonzero(values.any(axis=1)))
        assert found.told() and found.mark is None
        np.testing.assert_array_equal(numbers.numpy(), np.arange(500))
        assert count.numpy().tolist() == [(values[:, 2] > 0.5).sum()]


def test_where_nothing_is_read_what_is_not_black_stays_in_its_place(device):
    values = np.zeros((50, 3), np.float32)
    values[[7, 30], 1] = 0.5
    done = []
    for share in (1.0, 0.0):
        given = wp.array(share * values, dtype=wp.vec3, device=device)
        with launch.unread() as plan:
            found = compact.positive(given)
            found.then(lambda share=share: done.append(share))
        expected = np.where((share * values).any(axis=1), np.arange(50), -1)
        np.testing.assert_array_equal(found.numbers.numpy(), expected)
        assert found.told() == (share > 0.0) and plan.count == 1
    assert done == [1.0, 0.0]  # by nobody's decision


@pytest.mark.parametrize("count", [1, 32, 33, 5000])
def test_largest_numbers_are_found(count, device):
    values = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    given = wp.array(values, dtype=wp.vec3, device=device)
    for way in (launch.as_device, launch.recorded):
        with way():
            np.testing.assert_array_equal(compact.largest(given).numpy(), values.max(axis=0, keepdims=True))
