"""What a warm frame copies between host and device on a device's way, see `tools/host_copies.py`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warp_reflect as wr
from warp_reflect import launch

ROOT = Path(__file__).parent.parent
SIZE = 160, 90


@pytest.fixture
def host_copies(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import host_copies

    return host_copies


def test_every_way_between_host_and_device_is_counted_once(host_copies):
    with host_copies.counted() as copies:
        array = wp.array(np.zeros((5, 3)), dtype=wp.vec3, device="cpu")
        wp.array(np.zeros(0), dtype=float, device="cpu")
        wp.from_numpy(np.zeros(2, np.int32), dtype=int, device="cpu")
        wp.clone(array), wp.zeros(7, dtype=int, device="cpu"), array[1:]
        array.assign(np.ones((5, 3)))
        array.numpy(), array.list()
        wp.synchronize_device("cpu")
    assert [(copy.kind, copy.bytes) for copy in copies] == [
        ("write", 60),
        ("write", 8),
        ("write", 60),
        ("read", 60),
        ("read", 60),
        ("wait", 0),
    ]
    assert wp.array(np.ones(2), dtype=float, device="cpu").numpy().sum() == 2.0 and len(copies) == 6


def test_the_devices_way_shows_the_same_picture(host_copies, device):
    scene = wr.load_stage(ROOT / "usd_scenes" / "one_mirror.usda", device=device)
    plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(kernels="plain"), method="reflector_map")
    here = wr.render_frame(scene, plan)
    with launch.as_device():
        there = wr.render_frame(scene, plan)
    for channel in ("RGBA", "reflectedPoint", "status"):
        np.testing.assert_array_equal(there[channel], here[channel])


# Stage, method, settings: reads and bytes of a warm frame at most, and bytes written.
HELD = {
    "traced": ("one_mirror", "reference", {}, 1, 64, 8),
    "quadric": ("one_mirror", "quadric", {}, 2, 64, 8),
    "reflector map": ("one_mirror", "reflector_map", {}, 2, 64, 8),
}


@pytest.mark.parametrize("case", HELD)
def test_a_warm_frame_copies_little(case, host_copies):
    stage, method, settings, reads, bytes_read, bytes_written = HELD[case]
    scene = wr.load_stage(ROOT / "usd_scenes" / f"{stage}.usda")
    copies = host_copies.of_warm_frame(scene, SIZE, method, **settings)
    found = host_copies.summary(copies)
    assert sum(copy.kind == "read" for copy in copies) <= reads, found
    assert host_copies.bytes_of(copies, "read") <= bytes_read, found
    assert host_copies.bytes_of(copies, "write") <= bytes_written, found
