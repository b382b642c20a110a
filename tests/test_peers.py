"""The parts of the comparison with other renderers that need none of them but Embree."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import warp_reflect as wr

ROOT = Path(__file__).parent.parent


@pytest.fixture
def peers(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import peers

    return peers


def test_wavefront_finds_the_triangles_of_the_reference(peers):
    scene = wr.load_stage(ROOT / "usd_scenes" / "sphere_on_checker.usda")
    frame = wr.render_frame(scene, wr.make_plan(scene, size=(96, 54), method="reference"))
    wavefront = peers.Wavefront(scene, frame)
    wavefront.trace()
    # Its mirror is faceted, and its rays leave a step off the surface: neighbours are met at some triangles' edges.
    assert wavefront.agreement() > 0.9
    assert len(wavefront.pixel) == pytest.approx(np.count_nonzero(frame["reflectorId"]), rel=0.02)


def test_psnr_is_of_the_displayed_pictures(peers):
    a, b = (np.full((4, 5, 3), value, np.float32) for value in (4.0, 1.0))
    assert peers.psnr(a, b) == pytest.approx(120.0)  # both are shown white
    black = np.zeros_like(a)
    half = np.full_like(a, 0.21404114)  # shown as 0.5
    assert peers.psnr(half, black) == pytest.approx(20.0 * np.log10(2.0), abs=1e-4)
    there = np.zeros((4, 5), bool)
    there[0] = True
    half[1:] = 0.0
    assert peers.psnr(half, black, there) == pytest.approx(20.0 * np.log10(2.0), abs=1e-4)


def test_packets_of_embree_find_what_its_single_rays_find(peers):
    import embree_packets

    scene = wr.load_stage(ROOT / "usd_scenes" / "kitchen.usda")
    frame = wr.render_frame(scene, wr.make_plan(scene, size=(97, 54), method="reference"))
    wavefront = peers.Wavefront(scene, frame)
    wavefront.trace()
    if fault := embree_packets.built()[1]:  # without Embree's own headers there is none, and it says what is missing
        with pytest.raises(RuntimeError, match=r"install Embree 3|no C[+][+] compiler"):
            embree_packets.Packets(wavefront, threads=1)
        assert fault
        return
    found = []
    for threads in (1, 2):
        packets = embree_packets.Packets(wavefront, threads)
        packets.trace()
        found.append(packets.triangle.copy())
        packets.close()
    np.testing.assert_array_equal(*found)
    # Rounding differs: rays that pass an edge closely meet the other triangle of it.
    assert (found[0][wavefront.pixel] == wavefront.hit).mean() > 0.99
    assert (found[0] == embree_packets.NOTHING).sum() == pytest.approx(97 * 54 - len(wavefront.pixel), abs=20)


def test_packets_say_that_no_compiler_was_found(peers, monkeypatch):
    import embree_packets

    monkeypatch.setattr(embree_packets.shutil, "which", lambda _name: None)
    assert embree_packets.built.__wrapped__() == (None, "no C++ compiler was found")


def test_what_moves_is_drawn_as_if_laid_out_anew(peers):
    import bench_moving

    kitchen = wr.load_stage(ROOT / "usd_scenes" / "kitchen.usda")
    scene = bench_moving.movable(kitchen, "/World/Table")
    moving = {each.prim_path.split("/")[2] for each in scene.data.instances if each.moves}
    assert moving == {"Table"}
    later = bench_moving.lifted(scene, 0.01 * scene.size)
    assert later.host_triangles is scene.host_triangles
    anew = wr.Scene(later.source_data)
    np.testing.assert_array_equal(later.host_points, anew.host_points)
    assert np.ptp(later.host_points - scene.host_points, axis=0) == pytest.approx(
        [0.0, 0.01 * scene.size, 0.0], rel=1e-3
    )
    pictures = [wr.render_frame(each, wr.make_plan(each, size=(64, 36)))["RGBA"] for each in (later, anew)]
    np.testing.assert_array_equal(*pictures)
