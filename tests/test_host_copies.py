"""What a warm frame copies between host and device on a device's way, see `tools/host_copies.py`."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warp_reflect as wr
from warp_reflect import captured, counts, launch, shade, timing
from warp_reflect.techniques import TECHNIQUES

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


@pytest.mark.parametrize(
    ("stage", "method"),
    [("one_mirror", "reflector_map"), ("kitchen", "auto"), ("frosted_window", "planar"), ("cut_outs", "auto")],
)
def test_the_devices_way_shows_the_same_picture(stage, method, device):
    scene = wr.load_stage(ROOT / "usd_scenes" / f"{stage}.usda", device=device)
    plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(kernels="plain"), method=method)
    here = wr.render_frame(scene, plan)
    with launch.as_device():
        there = wr.render_frame(scene, plan)
    for channel in ("reflectorId", "reflectedPoint", "status"):
        np.testing.assert_array_equal(there[channel], here[channel])
    # What is behind panes is summed up in another order.
    np.testing.assert_allclose(there["RGBA"], here["RGBA"], rtol=2e-6, atol=1e-7)


def test_stages_of_a_device_are_waited_for_when_their_time_is_asked(monkeypatch):
    """With marks that stand for CUDA's events: numbers of the moment at which each was made."""
    made, asked = [], []

    def elapsed(begin, end):
        asked.append((begin, end))
        return float(end - begin)

    monkeypatch.setattr(wp, "Event", lambda device, enable_timing: made.append(device) or len(made))
    monkeypatch.setattr(wp, "record_event", lambda mark: None)
    monkeypatch.setattr(wp, "get_event_elapsed_time", elapsed)
    timer = timing.StageTimer()
    timer._device = SimpleNamespace(is_cuda=True)
    with timer("raster"):
        pass
    with timer("reflect"):
        with timer("search"):
            pass
    with timer("raster"):
        pass
    timer.count_inside("reflect", {"refine": 5.0})
    assert not asked
    assert dict(timer.ms) == {"raster": 2.0, "reflect": 3.0, "reflect/search": 1.0, "reflect/refine": 5.0}
    assert list(timer.ms) == ["raster", "reflect", "reflect/search", "reflect/refine"] and timer.total_ms == 5.0
    assert len(asked) == 4


def test_numbers_are_found_out_once_and_when_asked():
    asked = []
    total = counts.Statistics({"bvh": 1, "reused_px": 0.5})
    total.later(lambda: asked.append("first") or {"bvh": 2, "walk": 7})
    counts.add_statistics(total, {"reused_px": 0.25, "walk": 1})
    total["culled"] = 3
    assert not asked
    assert total == {"bvh": 3, "reused_px": 0.5, "walk": 8, "culled": 3} and total["walk"] == 8
    total["walk"] += 1
    del total["bvh"]
    assert dict(total) == {"reused_px": 0.5, "walk": 9, "culled": 3} and asked == ["first"] and len(total) == 3


@pytest.mark.parametrize("method", ["reference", "environment"])
def test_what_follows_the_mirrors_pixels_is_launches_alone(method, host_copies):
    """No copy and no wait: all of it can be recorded as one graph, which shows the frame when it is played."""
    scene = wr.load_stage(ROOT / "usd_scenes" / "one_mirror.usda")
    with launch.as_device():
        plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(kernels="plain", threads=1), method=method)
        frame = wr.render_frame(scene, plan)
        (row,) = plan.rows
        prepared, pixels = plan.prepared(row), frame.layers[row.reflector.id].pixels

        def steps() -> wp.array:
            reflected = TECHNIQUES[row.technique].reflect(
                scene, prepared, frame.gbuffer, pixels, frame.camera, row.settings, None
            )
            layers = {row.reflector.id: reflected}
            return shade.shade(scene, frame.gbuffer, layers, 1, plan.shadows, kernels="plain")[0]

        with host_copies.counted() as copies:
            picture = steps()
        assert not copies
        if captured.RECORDS_CPU:
            with wp.ScopedCapture(device="cpu") as capture:
                picture = steps()
            picture.zero_()
            wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(picture.numpy().reshape(frame["RGBA"].shape), frame["RGBA"])


CAMERA = 128  # bytes: it is written to where all kernels look for it
# Stage, method, settings: reads and bytes of a warm frame at most, and bytes written.
HELD = {
    "traced": ("one_mirror", "reference", {}, 1, 64, CAMERA),
    "quadric": ("one_mirror", "quadric", {}, 2, 64, CAMERA),
    "reflector map": ("one_mirror", "reflector_map", {}, 2, 64, CAMERA),
    # Which piece holds a pixel, and what branches end in, is found out on the host.
    "pieces": ("torus", "reflector_map", {}, 40, 400_000, 400_000),
    "reuse": ("one_mirror", "quadric", {"reuse_px": 0.5}, 2, 64, CAMERA),
    "local maps": ("one_mirror", "layered_environment", {"environment_resolution": 32}, 1, 64, CAMERA),
    "mirrors in mirrors": ("kitchen", "auto", {}, 7, 128, CAMERA),
    "panes": ("pool", "auto", {"refraction": "traced"}, 5, 128, CAMERA),
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
