"""What a process sets up before anything else."""

import ctypes
import os
import subprocess
import sys

import numpy as np

from warp_reflect.devices import ALLOCATOR_VARIABLES
from warp_reflect.layers import pixel_bounds

ASKED = """
import resource
import sys
import numpy as np

if sys.argv[1] == "command":
    from warp_reflect.devices import open_device

    open_device("cpu")
elif sys.argv[1] == "library":
    import warp_reflect as wr

    wr.keep_freed_memory()
else:
    import warp_reflect.frame
faults = []
for _ in range(6):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    arrays = [np.ones(5_000_000, np.float32) for _ in range(4)]
    del arrays
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(min(faults[2:]))
"""


def pages_asked_for(way="command", **environment):
    """Pages that a process asks the system for when it makes 80 MB of arrays as it has before."""
    inherited = {name: value for name, value in os.environ.items() if name not in ALLOCATOR_VARIABLES}
    found = subprocess.run(
        [sys.executable, "-c", ASKED, way], env=inherited | environment, capture_output=True, text=True, check=True
    )
    return int(found.stdout.split()[-1])


def test_freed_arrays_stay_with_the_process_unless_its_user_says_otherwise():
    if not hasattr(ctypes.CDLL(None), "mallopt"):
        return  # another C library, which is left alone
    assert pages_asked_for() < 100
    assert pages_asked_for("library") < 100
    assert pages_asked_for("nothing") > 1000
    assert pages_asked_for(MALLOC_TRIM_THRESHOLD_="131072") > 1000


def test_bounds_of_pixels_are_those_of_their_rows_and_columns():
    rng = np.random.default_rng(0)
    assert pixel_bounds(np.empty(0, np.int32), 9) == (0, 0, 0, 0)
    for width in (1, 7, 64):
        for count in (1, 2, 5, 60):
            pixel = np.unique(rng.integers(0, width * 50, count)).astype(np.int32)
            column, row = pixel % width, pixel // width
            assert pixel_bounds(pixel, width) == (column.min(), row.min(), column.max() + 1, row.max() + 1)
