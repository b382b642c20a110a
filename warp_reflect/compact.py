"""Which elements of an array are meant: their numbers in a list, and the elements in a row, made where the array lies.

Where a device is waited for to tell a number (`launch.stays`), a list's length is the only thing that is read; where arrays are
at hand anyway NumPy finds the numbers faster than kernels do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import warp as wp

from warp_reflect.launch import launch, mark, reads, stays, when

wp.set_module_options({"enable_backward": False})

RUN = wp.constant(32)  # values that a thread looks at: four launches for a large picture


@cache
def _none(dtype, device: str) -> wp.array:
    return wp.empty(0, dtype=dtype, device=device)


def none(dtype, device) -> wp.array:
    """The array of length 0 that stands for one that a kernel is not given: always the same, since a frame has dozens."""
    return _none(dtype, str(device))


def listed(numbers: np.ndarray, device) -> wp.array:
    """NumPy's whole numbers as int32; nobody writes to them: on the CPU int32 is not copied."""
    return wp.array(numbers.astype(np.int32, copy=False), dtype=int, device=device, copy=False)


@wp.kernel
def is_marked_kernel(first: int, marks: wp.array(dtype=wp.uint8), value: int, out_one: wp.array(dtype=int)):
    """One thread per element: 1 or 0."""
    i = first + wp.tid()
    out_one[i] = wp.where(int(marks[i]) == value, 1, 0)


@wp.kernel
def list_kernel(
    first: int, marks: wp.array(dtype=wp.uint8), value: int, end: wp.array(dtype=int), out_list: wp.array(dtype=int)
):
    """One thread per element; `end`: how many are marked up to it, itself included."""
    i = first + wp.tid()
    if int(marks[i]) == value:
        out_list[end[i] - 1] = i


def _listed(marks: wp.array, value: int, padded: bool) -> tuple[wp.array, wp.array]:
    """(numbers of the marked elements, as many as there are elements, those behind -1 if padded; how many up to each)."""
    count, device = len(marks), marks.device
    ones, ends = (wp.empty(count, dtype=int, device=device) for _ in range(2))
    launch(is_marked_kernel, count, [marks, value, ones], device)
    wp.utils.array_scan(ones, ends, inclusive=True)
    numbers = wp.full(count, -1, dtype=int, device=device) if padded else wp.empty(count, dtype=int, device=device)
    launch(list_kernel, count, [marks, value, ends, numbers], device)
    return numbers, ends


def marked(marks: wp.array, value: int) -> wp.array:
    """Ascending numbers of the elements of a uint8 array that have a value, int32."""
    if not stays(marks.device):
        return listed(np.flatnonzero(marks.numpy() == np.uint8(value)), marks.device)
    if not len(marks):
        return wp.empty(0, dtype=int, device=marks.device)
    if not reads():
        raise RuntimeError("marked: a list's length is asked for where nothing is read; expected padded")
    numbers, ends = _listed(marks, value, False)
    return numbers[: int(ends[len(ends) - 1 :].numpy()[0])]


def padded(marks: wp.array, value: int) -> tuple[wp.array, wp.array]:
    """The same for launches over all that might be asked for: nothing is read.

    Returns:
        (numbers; where they stay on a device as many as there are elements, -1 behind the last; how many, int32 [1]).
    """
    if not stays(marks.device) or not len(marks):
        numbers = marked(marks, value)
        return numbers, wp.full(1, len(numbers), dtype=int, device=marks.device)
    numbers, ends = _listed(marks, value, True)
    return numbers, ends[len(ends) - 1 :]


@dataclass(frozen=True)
class Some:
    """Some elements of an array.

    Attributes:
        numbers: int32, ascending; where nothing is read the array's whole length, with -1 for every other element.
        mark: int32 [1], set where there is any; None: `numbers` has a length.
    """

    numbers: wp.array
    mark: wp.array | None = None

    def then(self, work: Callable[[], None]) -> None:
        """Do what is to be done where there is any."""
        if self.mark is not None:
            when(self.mark, work)
        elif len(self.numbers):
            work()

    def told(self) -> bool:
        """Whether there is any; read now."""
        return len(self.numbers) > 0 if self.mark is None else bool(self.mark.numpy()[0])


@wp.kernel
def positive_kernel(first: int, values: wp.array(dtype=wp.vec3), out_mark: wp.array(dtype=wp.uint8)):
    """One thread per element: 1 where any of its numbers is above 0."""
    i = first + wp.tid()
    out_mark[i] = wp.uint8(wp.where(wp.max(values[i]) > 0.0, 1, 0))


@wp.kernel
def positive_here_kernel(
    first: int, values: wp.array(dtype=wp.vec3), out_number: wp.array(dtype=int), out_mark: wp.array(dtype=int)
):
    """One thread per element: its number where any of its own is above 0, else -1; threads that set the mark agree."""
    i = first + wp.tid()
    out_number[i] = -1
    if wp.max(values[i]) > 0.0:
        out_number[i] = i
        out_mark[0] = 1


def positive(values: wp.array) -> Some:
    """The elements of a vec3 array, none of whose numbers is below 0, that are not 0."""
    device = values.device
    if not stays(device):
        x, y, z = values.numpy().T
        return Some(listed(np.flatnonzero(x + y + z > 0.0), device))
    if not reads():
        numbers, some = wp.empty(len(values), dtype=int, device=device), mark(device)
        launch(positive_here_kernel, len(values), [values, numbers, some], device)
        return Some(numbers, some)
    marks = wp.empty(len(values), dtype=wp.uint8, device=device)
    launch(positive_kernel, len(values), [values, marks], device)
    return Some(marked(marks, 1))


@wp.kernel
def count_kernel(first: int, marks: wp.array(dtype=wp.uint8), value: int, out_count: wp.array(dtype=int)):
    """One thread per element, on a device."""
    if int(marks[first + wp.tid()]) == value:
        wp.atomic_add(out_count, 0, 1)


def counted(marks: wp.array, value: int) -> wp.array:
    """How many elements of a uint8 array have a value, int32 [1]; few of many, or they queue on a device."""
    if not stays(marks.device):
        return wp.full(1, int(np.count_nonzero(marks.numpy() == value)), dtype=int, device=marks.device)
    count = wp.zeros(1, dtype=int, device=marks.device)
    launch(count_kernel, len(marks), [marks, value, count], marks.device)
    return count


@wp.kernel
def largest_kernel(first: int, values: wp.array(dtype=wp.vec3), out_largest: wp.array(dtype=wp.vec3)):
    """One thread per `RUN` values: the largest of each of their numbers."""
    i = first + wp.tid()
    largest = values[i * RUN]
    for k in range(i * RUN + 1, wp.min(i * RUN + RUN, values.shape[0])):
        largest = wp.max(largest, values[k])
    out_largest[i] = largest


def largest(values: wp.array) -> wp.array:
    """The largest first, second and third number of the elements of a vec3 array that is not empty, vec3 [1]."""
    device = values.device
    if not stays(device):
        return wp.array(values.numpy().max(axis=0, keepdims=True), dtype=wp.vec3, device=device)
    while len(values) > 1:
        fewer = wp.empty(-(-len(values) // RUN), dtype=wp.vec3, device=device)
        launch(largest_kernel, len(fewer), [values, fewer], device)
        values = fewer
    return values


@wp.kernel
def every_kernel(first: int, out_number: wp.array(dtype=int)):
    """One thread per element."""
    i = first + wp.tid()
    out_number[i] = i


def every(count: int, device) -> wp.array:
    """The numbers from 0 on, int32."""
    if not stays(device):
        return listed(np.arange(count, dtype=np.int32), device)
    numbers = wp.empty(count, dtype=int, device=device)
    launch(every_kernel, count, [numbers], device)
    return numbers


def taken(array: wp.array, numbers: wp.array) -> wp.array:
    """The elements of an array with some numbers, in their order."""
    if not stays(array.device):
        # NumPy does it without a launch.
        elements = array.numpy().take(numbers.numpy(), axis=0)
        return wp.array(elements, dtype=array.dtype, device=array.device, copy=False)
    return wp.indexedarray(array, [numbers]).contiguous()


def run(array: wp.array, first: int, end: int) -> wp.array:
    """A slice of an array; one without elements too, which Warp refuses to make."""
    return array[first:end] if end > first else none(array.dtype, array.device)


def joined(arrays: Sequence[wp.array]) -> wp.array:
    """Arrays of one kind, one after the other; a single one is itself."""
    if len(arrays) == 1:
        return arrays[0]
    whole = wp.empty(sum(map(len, arrays)), dtype=arrays[0].dtype, device=arrays[0].device)
    first = 0
    for array in arrays:
        if len(array):
            wp.copy(whole, array, dest_offset=first, count=len(array))
        first += len(array)
    return whole


def put(array: wp.array, numbers: wp.array, values: wp.array) -> None:
    """Write elements of an array, each at most once."""
    if not stays(array.device):
        array.numpy()[numbers.numpy()] = values.numpy()
        return
    wp.copy(wp.indexedarray(array, [numbers]), values)
