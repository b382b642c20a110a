"""Costs of this machine: what is measured, where it is kept, and that nothing damaged is believed."""

import dataclasses
import json

import pytest
from rooms import placed, room, sphere

import warp_reflect as wr
from warp_reflect import calibrate, calibration, cli
from warp_reflect.budget import Costs
from warp_reflect.scene import Scene


@pytest.fixture
def other(device):
    """Costs that are not those of the device's kind, and could be measured on one."""
    usual = calibration.built_in(device)
    return dataclasses.replace(usual, trace=3.0 * usual.trace, draw=0.5 * usual.draw)


@pytest.fixture
def kept(monkeypatch, tmp_path):
    file = tmp_path / "made" / "costs.json"
    monkeypatch.setenv(calibration.FILE_VARIABLE, str(file))
    return file


def test_kept_costs_come_back_and_plans_go_by_them(kept, device, other):
    assert calibration.known(device) == calibration.built_in(device)
    assert calibration.store(other, device) == kept
    assert calibration.known(device) == other
    scene, usual = Scene(room(sphere(), placed(0, 0, 0)).data, device), calibration.built_in(device)
    plans = [wr.make_plan(scene, size=(160, 90), method="reference", costs=costs) for costs in (None, other, usual)]
    assert plans[0].costs == other and plans[0].predicted == plans[1].predicted != plans[2].predicted
    calibration.store(usual, device)
    assert calibration.known(device) == calibration.built_in(device)
    assert [file.name for file in kept.parent.iterdir()] == [kept.name]  # no temporary is left


def test_costs_of_another_machine_or_version_are_not_taken(kept, device, other, monkeypatch):
    calibration.store(other, device)
    for name, value in (("processor", lambda: "another"), ("__version__", "0.0")):
        with monkeypatch.context() as changed:
            changed.setattr(calibration, name, value)
            assert calibration.known(device) == calibration.built_in(device)
            calibration.store(dataclasses.replace(other, layer=1.0), device)
    assert calibration.known(device) == other, "the other machines' costs lie beside it"
    assert len(json.loads(kept.read_text())) == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: entry.pop("trace"),
        lambda entry: entry.update(more=1.0),
        lambda entry: entry.update(trace="fast"),
        lambda entry: entry.update(trace=float("nan")),
        lambda entry: entry.update(trace=True),
        lambda entry: entry.update(trace=-1.0),
        lambda entry: entry.update(trace=1e9),
        lambda entry: entry.update(trace=10**400),
        lambda entry: entry.update(trace=float("nan")),
    ],
)
def test_damaged_costs_are_not_believed(damage, kept, device, other):
    calibration.store(other, device)
    entries = json.loads(kept.read_text())
    (entry,) = entries.values()
    damage(entry["microseconds"])
    kept.write_text(json.dumps(entries))
    calibration._read.cache_clear()
    assert calibration.known(device) == calibration.built_in(device)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"x": 1}', "\x00\xff", "[" * 10**5])
def test_files_that_are_none_are_no_calibration_and_are_replaced(text, kept, device, other):
    kept.parent.mkdir()
    kept.write_text(text)
    assert calibration.known(device) == calibration.built_in(device)
    calibration.store(other, device)
    assert calibration.known(device) == other


def test_the_file_lies_in_the_users_cache(monkeypatch, tmp_path):
    monkeypatch.delenv(calibration.FILE_VARIABLE, raising=False)
    monkeypatch.setattr(calibration.sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert calibration.cache_file() == tmp_path / "warp_reflect" / calibration.FILE_NAME
    monkeypatch.setenv(calibration.FILE_VARIABLE, "")
    assert calibration.cache_file() is None


def test_a_user_without_a_home_has_the_built_in_costs(monkeypatch, device, capsys):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(calibration.Path, "home", nowhere)
    for name in (calibration.FILE_VARIABLE, "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    assert calibration.known(device) == calibration.built_in(device)
    assert cli.main(["calibrate"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error:") and "no home" in line


def test_measured_costs_are_of_every_step_and_the_command_keeps_them(kept, device, monkeypatch, capsys):
    """One run on a small scene: how long anything took is not judged."""
    monkeypatch.setattr(calibrate, "WALL_CELLS", 6)
    monkeypatch.setattr(calibrate, "BALLS", 2)
    monkeypatch.setattr(calibrate, "ROWS", 8)
    monkeypatch.setattr(calibrate, "SIZE", (64, 36))
    assert cli.main(["calibrate", "--device", str(device), "--repeats", "1"]) == 0
    told = capsys.readouterr().out
    assert str(kept) in told and all(each.name in told for each in dataclasses.fields(Costs))
    found = dataclasses.asdict(calibration.known(device))
    assert calibration.known(device) != calibration.built_in(device)
    assert all(value > 0.0 for value in found.values())


def test_calibrating_where_nothing_can_be_kept_is_one_line(monkeypatch, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    for place, told in (("", "empty"), (str(tmp_path / "file" / "costs.json"), "file")):
        monkeypatch.setenv(calibration.FILE_VARIABLE, place)
        assert cli.main(["calibrate"]) == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert line.startswith("error:") and told in line
    monkeypatch.setenv(calibration.FILE_VARIABLE, str(tmp_path / "costs.json"))
    assert cli.main(["calibrate", "--repeats", "0"]) == 2
    assert "--repeats" in capsys.readouterr().err


def test_calibration_scenes_hold_what_is_measured(device):
    """The mirrors get the techniques they are there to time; the lamp casts shadows."""
    for kind, technique in (("ball", "quadric"), ("ball", "reflector_map"), ("wall", "planar"), ("hollow", "quadric")):
        (row,) = wr.make_plan(calibrate._scene(kind, device), size=(64, 36), method=technique).rows
        assert row.technique == technique and row.pixels > 0, row.reason
    (rough,) = wr.make_plan(calibrate._scene("rough", device), size=(64, 36), method="reference").rows
    assert rough.effects["roughness"].on and rough.pixels > 0
    (pane,) = wr.make_plan(calibrate._scene("pane", device), size=(64, 36), method="none").panes
    assert pane.pixels > 0
    settings = wr.Settings(shadow_min_share=0.0)
    plan = wr.make_plan(calibrate._scene("lamp", device), size=(64, 36), settings=settings, method="none")
    assert plan.lights[0].effects["shadows"].numbers["rays"] > 0
