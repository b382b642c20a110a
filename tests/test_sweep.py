"""The sweep: what it compares, what it measures by, what it writes. Nothing here depends on how fast the machine is."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import warp_reflect as wr
from warp_reflect import cli, sweep, sweep_report
from warp_reflect.realised import as_points
from warp_reflect.scene import Scene
from warp_reflect.settings import COMPLEXITIES, Settings
from warp_reflect.techniques import TECHNIQUES

ROOT = Path(__file__).parent.parent
STAGE = ROOT / "usd_scenes" / "sphere_on_checker.usda"
SIZE = (48, 27)
EMPTY = """#usda 1.0
(
    upAxis = "Y"
    metersPerUnit = 1
)
def Sphere "Ball"
{
    double radius = 1
}
def Camera "View"
{
    double3 xformOp:translate = (0, 0, 5)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
"""


@pytest.fixture(scope="module")
def scene():
    return wr.load_stage(STAGE)


@pytest.fixture(scope="module")
def measured(scene) -> sweep.Sweep:
    every, notes = sweep.default_contenders(scene, None, SIZE, Settings(threads=1))
    chosen = sweep.choose(every, ["quadric", f"{sweep.ESTALELLA} 3 iterations", f"{sweep.ESTALELLA} grid 9.6 %"])
    names = (sweep.REFERENCE, "quadric", "quadric reuse_px=1.0 refine=exact warm", "quadric refine=off")
    chosen = [each for each in chosen if each.name in names or each.source == sweep.ESTALELLA]
    result = sweep.run_sweep(scene, None, SIZE, chosen, rounds=1)
    result.notes += notes
    return result


def test_contenders_are_derived_from_the_techniques(scene, monkeypatch):
    every, notes = sweep.default_contenders(scene, None, SIZE)
    methods = {each.method for each in every}
    assert methods <= {*TECHNIQUES, "auto", "reference"} and {"quadric", "reflector_map"} <= methods
    assert any(note.startswith("planar: left out") for note in notes)  # a sphere is not flat
    assert len({each.name for each in every}) == len(every)
    assert len({(each.method, each.settings, each.warm) for each in every}) == len(every)
    without = {name: module for name, module in TECHNIQUES.items() if name != "quadric"}
    monkeypatch.setattr(sweep, "TECHNIQUES", without)
    fewer, _ = sweep.default_contenders(scene, None, SIZE)
    assert "quadric" not in {each.method for each in fewer}
    assert not any(each.source == sweep.LAGES_MIGUEL for each in fewer)


def test_contenders_cover_the_papers_settings(scene):
    every, _ = sweep.default_contenders(scene, None, SIZE)
    settings = [each.settings for each in every if each.method == "reflector_map"]
    for share in (0.041, 0.055, 0.096, 0.143):
        for kind in ("direction", "slope", "position"):
            assert any((each.grid_share, each.grid_kind) == (share, kind) for each in settings)
    for search, counts in (("midpoint", (3, 5, 7, 9)), ("newton", (1, 2, 3, 4))):
        assert {each.iterations for each in settings if each.search == search} >= set(counts)
    assert {32, 64, 128, 256, 512, 1024} <= {each.map_resolution for each in settings}
    assert {each.settings.reuse_px for each in every if each.warm} >= {0.25, 0.5, 1.0}


def test_contenders_cover_the_settings_of_maps(scene):
    every, _ = sweep.default_contenders(scene, None, SIZE)
    for method in ("environment", "layered_environment"):
        settings = [each.settings for each in every if each.method == method]
        assert {each.environment_resolution for each in settings} >= set(sweep.ENVIRONMENT_RESOLUTIONS)
        assert {each.environment_update for each in settings} == {"static", "frame"}
    assert {each.rem_count for each in settings} >= set(sweep.REM_COUNTS)
    assert {each.rem_limit for each in settings} >= set(sweep.REM_LIMITS)
    assert {each.parallax_steps for each in settings} >= set(sweep.PARALLAX_STEPS)


def test_contenders_cover_the_cells_of_fields_where_mirrors_move(scene):
    def cells(of):
        every, _ = sweep.default_contenders(of, None, SIZE)
        return sorted(each.settings.field_cell for each in every if each.settings.local_rays == "field")

    assert not cells(scene), "this mirror stands still"
    (part,) = {row.reflector.part for row in wr.make_plan(scene, size=SIZE).rows}
    prim = scene.parts[part].prim - 1
    instances = [dataclasses.replace(each, moves=k == prim) for k, each in enumerate(scene.data.instances)]
    moving = Scene(dataclasses.replace(scene.data, instances=instances), str(scene.device))
    found = cells(moving)
    assert found[0] == 0.0 and len(found) == 1 + len(sweep.FIELD_CELLS)
    assert np.allclose(sorted(scene.size / np.array(found[1:])), sweep.FIELD_CELLS, rtol=0.06)


def test_tessellations_are_rows_judged_by_the_same_reference(scene):
    base = Settings(threads=1)
    every, _ = sweep.default_contenders(scene, None, SIZE, base, COMPLEXITIES)
    chosen = sweep.choose(every, ["complexity"])
    assert [each.settings.complexity for each in chosen[1:]] == list(COMPLEXITIES[1:])
    read = []

    def load(complexity):
        read.append(complexity)
        return wr.load_stage(STAGE, complexity=complexity)

    result = sweep.run_sweep(scene, None, SIZE, chosen, 1, read=load)
    assert read == list(COMPLEXITIES[1:]) and not result.failed
    for row in result.rows[1:]:
        assert row.frame_ms > 0.0 and row.settings["complexity"] in row.name
        assert row.error_p95_px is not None and row.wrong_share < 0.02
    alone = sweep.run_sweep(scene, None, SIZE, chosen[:2], 1)
    assert len(alone.rows) == 1 and "give `read`" in alone.failed[0]


def test_choosing_refuses_a_name_that_fits_nothing(scene):
    every, _ = sweep.default_contenders(scene, None, SIZE)
    with pytest.raises(ValueError, match=r"'quadrik' names no contender.*quadric"):
        sweep.choose(every, ["quadrik"])
    grids = sweep.choose(every, ["grid_share"])
    assert grids[0].name == sweep.REFERENCE
    assert all(each.settings.grid_share > 0.0 for each in grids[1:])


def test_refined_rows_err_less_than_unrefined(measured):
    exact, plain = measured.row("quadric"), measured.row("quadric refine=off")
    few = measured.row(f"{sweep.ESTALELLA} 3 iterations")
    assert exact.identical_share >= 0.99 > plain.identical_share
    assert exact.error_mean_px < plain.error_mean_px < few.error_mean_px
    assert exact.off_share < plain.off_share <= few.off_share
    # Exact hits lie on the exact rays, others do not.
    assert exact.angle_p95_deg < 1e-3 < plain.angle_p95_deg < few.angle_p95_deg
    reference = measured.row(sweep.REFERENCE)
    assert (reference.identical_share, reference.psnr_db, reference.error_max_px) == (1.0, None, 0.0)
    assert reference.bvh_share == 1.0 > exact.bvh_share and plain.bvh_share == 0.0


def test_rows_hold_plain_positive_numbers(measured):
    for row in measured.rows:
        assert row.reflect_ms > 0.0 and row.frame_ms > row.reflect_ms and row.first_ms > 0.0 and row.frame_cpu_ms > 0.0
        assert row.compile_ms >= 0.0 and row.predicted_ms > 0.0 and row.predicted_px >= 0.0
        shares = (row.identical_share, row.off_share, row.wrong_share, row.bvh_share, row.reused_share)
        assert all(0.0 <= share <= 1.0 for share in shares)
        assert row.error_median_px <= row.error_p95_px <= row.error_max_px
    assert measured.row(f"{sweep.ESTALELLA} grid 9.6 %").prepared_bytes >= 6 * 128 * 128 * 32
    assert measured.row("quadric reuse_px=1.0 refine=exact warm").reused_share > 0.0
    json.loads(json.dumps(measured.to_json(), allow_nan=False))


def test_environment_maps_are_judged_by_what_lies_where_they_show_it(scene):
    """Near things are shifted by many pixels: a map that is said to show the sky alone would have no error."""
    every, _ = sweep.default_contenders(scene, None, SIZE, Settings(threads=1))
    chosen = [each for each in every if each.name in (sweep.REFERENCE, "environment")]
    row = sweep.run_sweep(scene, None, SIZE, chosen, rounds=1).row("environment")
    assert row.error_p95_px > 1.0 and row.angle_median_deg > 0.1
    reference = wr.render_frame(scene, wr.make_plan(scene, size=SIZE, method="reference"))
    for name, image in as_points(reference).items():
        own = reference.relative(name) if name == "reflectedPoint" else reference[name]
        np.testing.assert_array_equal(image, own)


def test_unrefined_picture_reports_the_point_it_shows(scene):
    """Against NumPy: the point lies in the picture's own triangle, and the residual is its error, not 0."""
    plan = wr.make_plan(scene, size=SIZE, settings=Settings(refine="off", edge_px=0.0), method="reflector_map")
    frame = wr.render_frame(scene, plan)
    (layer,) = frame.layers.values()
    triangle, u, v = (each.numpy() for each in (layer.triangle, layer.u, layer.v))
    hit = triangle >= 0
    corner = scene.host_points[scene.host_triangles[triangle[hit]]].astype(np.float64) + scene.origin
    weights = np.stack([1.0 - u - v, u, v], axis=1)[hit]
    expected = np.einsum("ij,ijk->ik", weights, corner)
    pixel = layer.pixels.pixel.numpy()[hit]
    shown = frame["reflectedPoint"].reshape(-1, 3)[pixel]
    np.testing.assert_allclose(shown, expected, atol=1e-5 * scene.size)
    mirror, normal = (frame[name].reshape(-1, 3)[pixel].astype(np.float64) for name in ("mirrorPoint", "N"))
    to_eye, to_point = frame.camera.eye - mirror, expected - mirror
    half = to_eye / np.linalg.norm(to_eye, axis=1)[:, None] + to_point / np.linalg.norm(to_point, axis=1)[:, None]
    sine = np.linalg.norm(np.cross(half / np.linalg.norm(half, axis=1)[:, None], normal), axis=1)
    np.testing.assert_allclose(frame["residual"].reshape(-1)[pixel], sine, atol=2e-5)
    assert np.percentile(sine, 90) > 1e-4


def test_camera_path_ends_at_the_camera_and_keeps_its_distance(scene):
    camera = wr.make_plan(scene, size=SIZE, method="reference").camera
    pivot = camera.eye + 3.0 * camera.forward
    path = sweep.camera_path(camera, pivot, 4, step=0.02)
    assert path[-1] is camera
    for k, view in enumerate(path):
        assert np.linalg.norm(view.eye - pivot) == pytest.approx(3.0)
        turned = math.acos(np.clip(view.forward @ camera.forward, -1.0, 1.0))
        assert turned == pytest.approx((3 - k) * 0.02, abs=1e-7)
        axes = np.stack([view.right, view.up, view.forward])
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)


def test_frontier_holds_what_no_faster_row_equals():
    blank = sweep.Row("", "", "", "", False, {})
    rows = [
        dataclasses.replace(blank, name=name, reflect_ms=ms, off_share=error)
        for name, ms, error in (
            ("b", 2.0, 0.1),
            ("a", 1.0, 0.5),
            ("worse", 3.0, 0.1),
            ("slow", 9.0, 0.3),
            ("c", 4.0, 0.0),
        )
    ]
    front = sweep.pareto(rows, lambda row: row.reflect_ms, lambda row: row.off_share)
    assert [row.name for row in front] == ["a", "b", "c"]


def test_a_row_that_shows_nothing_right_has_no_displacement():
    """One Newton step converges nowhere: everything is off, and that is no displacement of 0."""
    settings = Settings(search="newton", iterations=1, refine="off", threads=1)
    lost = sweep.Contender("lost", "reflector_map", settings)
    row = sweep.run_sweep(wr.load_stage(ROOT / "usd_scenes" / "one_mirror.usda"), None, SIZE, [lost], 1).row("lost")
    assert row.off_share == 1.0
    assert row.error_mean_px is None and row.error_max_px is None


def test_held_bytes_count_each_array_once():
    data = np.zeros(1000, np.float32)
    assert sweep.held_bytes([data, data[:], {"not walked": 1}, (np.zeros(8, np.uint8),)]) == 4008


class Loads(HTMLParser):
    """What a page would load."""

    def __init__(self):
        super().__init__()
        self.sources, self.rows = [], 0

    def handle_starttag(self, tag, attrs):
        self.rows += tag == "tr"
        self.sources += [value for name, value in attrs if name in ("src", "href")]


def test_files_tell_the_same_rows(measured, tmp_path):
    pytest.importorskip("matplotlib")
    written = sweep_report.write_sweep(measured, tmp_path / "out")
    names = {file.name for file in written.files}
    assert names == {"results.json", "results.csv", "pareto.png", "contact.png", "report.html"} and not written.notes
    told = json.loads((tmp_path / "out" / "results.json").read_text())
    with open(tmp_path / "out" / "results.csv", newline="") as stream:
        lines = list(csv.DictReader(stream))
    assert (
        [line["name"] for line in lines] == [row["name"] for row in told["rows"]] == [row.name for row in measured.rows]
    )
    for line, row in zip(lines, measured.rows, strict=True):
        assert float(line["error_p95_px"]) == row.error_p95_px
        assert line["psnr_db"] == ("" if row.psnr_db is None else str(row.psnr_db))
    page = Loads()
    page.feed((tmp_path / "out" / "report.html").read_text())
    assert page.rows == 1 + len(measured.rows)
    assert len(page.sources) == 2 and all(source.startswith("data:image/png;base64,") for source in page.sources)


def test_without_matplotlib_the_numbers_are_still_written(measured, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    written = sweep_report.write_sweep(measured, tmp_path)
    assert {file.name for file in written.files} == {"results.json", "results.csv", "report.html"}
    assert len(written.notes) == 1 and "extra 'plot'" in written.notes[0]


def test_command_writes_and_reports(tmp_path, capsys):
    out = tmp_path / "sweep"
    tokens = ["sweep", str(STAGE), str(out), "--res", "48x27", "--rounds", "1", "--only", "quadric refine=off,Ofek*"]
    assert cli.main(tokens) == 0
    told = capsys.readouterr()
    assert told.out.split() == [str(out / name.name) for name in map(Path, told.out.split())]
    assert "round 1 of 1" in told.err
    rows = json.loads((out / "results.json").read_text())["rows"]
    assert [row["name"] for row in rows] == [sweep.REFERENCE, sweep.OFEK, "quadric refine=off"]


def test_command_goes_on_without_a_contender_that_fails(tmp_path, capsys, monkeypatch):
    whole = sweep.render_frame

    def short_of_memory(scene, plan, *rest, **more):
        if plan.method == "explosion_map":
            raise MemoryError("no room for a map")
        return whole(scene, plan, *rest, **more)

    monkeypatch.setattr(sweep, "render_frame", short_of_memory)
    tokens = [
        "sweep",
        str(STAGE),
        str(tmp_path),
        "--res",
        "48x27",
        "--rounds",
        "1",
        "--only",
        "quadric refine=off,Ofek*",
    ]
    assert cli.main(tokens) == 1
    assert f"error: {sweep.OFEK}: no room for a map" in capsys.readouterr().err.splitlines()
    told = json.loads((tmp_path / "results.json").read_text())
    assert [row["name"] for row in told["rows"]] == [sweep.REFERENCE, "quadric refine=off"] and len(told["failed"]) == 1


def test_command_says_that_nothing_mirrors(tmp_path, capsys):
    stage = tmp_path / "dull.usda"
    stage.write_text(EMPTY)
    assert cli.main(["sweep", str(stage), str(tmp_path / "out"), "--res", "48x27", "--rounds", "1"]) == 0
    assert capsys.readouterr().err.count("no mirror is seen") == 1
    assert json.loads((tmp_path / "out" / "results.json").read_text())["rows"] == []


def test_command_refuses_in_one_line(tmp_path, capsys):
    stage = str(STAGE)
    file = tmp_path / "file"
    file.write_text("")
    for tokens, word in (
        ([stage, str(tmp_path), "--rounds", "0"], "--rounds"),
        ([stage, str(tmp_path), "--res", "48x27", "--only", "nothing"], "nothing"),
        ([stage, str(file)], "cannot be written"),
        ([stage, str(tmp_path), "--camera", "Nobody"], "Nobody"),
        ([str(tmp_path / "missing.usda"), str(tmp_path)], "missing.usda"),
    ):
        assert cli.main(["sweep", *tokens]) == 2
        last = capsys.readouterr().err.strip().splitlines()[-1]
        assert last.startswith("error: ") and word in last


@pytest.fixture
def bench_frames(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import bench_frames

    return bench_frames


def test_slope_is_the_exponent(bench_frames):
    amounts = [1.0, 2.0, 5.0, 10.0]
    assert bench_frames.fitted_slope(amounts, [3.0 * each**0.7 for each in amounts]) == pytest.approx(0.7)
    assert bench_frames.fitted_slope([4.0], [1.0]) is None


def test_histogram_counts_every_frame(bench_frames):
    times = np.r_[np.linspace(10.0, 20.0, 50), 400.0]
    lines = bench_frames.histogram(times)
    assert sum(int(line.split()[-1]) for line in lines) == len(times)
