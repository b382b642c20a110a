"""Frame ranges: what is written, kept, redone and said, however a range is cut, stopped or shared out."""

from __future__ import annotations

import gc
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from openjd.model import create_job, decode_job_template, preprocess_job_parameters

import warp_reflect as wr
from warp_reflect import cli, cluster, frame, images, launch, pipeline
from warp_reflect.progress import Report
from warp_reflect.stage.frames import snapshot_name
from warp_reflect.stage.identity import stage_digest

ROOT = Path(__file__).resolve().parents[1]
SMALL = ("-w", "24", "--aov", "RGBA,reflectedPoint,reflectionMotion")

# A chrome sphere, a box that rises from 1 to 9, and the camera, whose place is filled in.
STAGE = """#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 9
    subLayers = [@look.usda@]
)
def Xform "World"
{
    def Camera "Camera"
    {
        float2 clippingRange = (0.1, 1000)
        float focalLength = 30
        float horizontalAperture = 24
        float verticalAperture = 18
        %CAMERA%
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Sphere "Mirror" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        double radius = 1
        rel material:binding = </World/Chrome>
    }
    def Cube "Box"
    {
        double size = 1
        %BOX%
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""
LOOK = """#usda 1.0
over "World"
{
    def DomeLight "Sky"
    {
        float inputs:intensity = 1
    }
    def Material "Chrome"
    {
        token outputs:surface.connect = </World/Chrome/Surface.outputs:surface>
        def Shader "Surface"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.9, 0.9, 0.9)
            float inputs:metallic = 1
            float inputs:roughness = 0
            token outputs:surface
        }
    }
}
"""
STILL_CAMERA = "double3 xformOp:translate = (0, 1, 8)"
MOVING_CAMERA = "double3 xformOp:translate.timeSamples = { 1: (0, 1, 8), 9: (1, 1, 7) }"
STILL_BOX = "double3 xformOp:translate = (2, 0, 2)"
MOVING_BOX = "double3 xformOp:translate.timeSamples = { 1: (2, 0, 2), 9: (2, 2, 2) }"


def write_stage(name: str, camera: str = STILL_CAMERA, box: str = MOVING_BOX) -> str:
    Path("look.usda").write_text(LOOK)
    Path(name).write_text(STAGE.replace("%CAMERA%", camera).replace("%BOX%", box))
    return name


@pytest.fixture
def stage(tmp_path, monkeypatch, device) -> str:
    """The stage with the moving box, in an otherwise empty current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    return write_stage("stage.usda")


@pytest.fixture
def render(stage, capfd, device):
    """Render a range of the stage small: (exit code, lines of standard output, lines of standard error)."""

    def run(*tokens: str) -> tuple[int, list[str], list[str]]:
        capfd.readouterr()
        code = cli.main(["render", stage, *map(str, tokens), *SMALL, "--device", device])
        out, err = capfd.readouterr()
        return code, out.splitlines(), err.splitlines()

    return run


def contents(pattern: str = "a.*") -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(Path().glob(pattern))}


def names(lines: list[str]) -> list[str]:
    """The files that lines of results are about."""
    return [line.split(":")[0] for line in lines]


# Resume.


def test_resume_redoes_exactly_what_is_missing_cut_or_foreign(render):
    assert render("a.##.exr", "a.##.png", "-f", "1:5")[0] == 0
    whole = contents()
    assert len(whole) == 10
    os.truncate("a.01.exr", len(whole["a.01.exr"]) * 9 // 10)
    os.unlink("a.02.png")
    shutil.copy("a.05.exr", "a.03.exr")  # whole, and of another frame
    code, out, err = render("a.##.exr", "a.##.png", "-f", "1:5", "--resume")
    assert code == 0
    assert err == ["resume: 2 of 5 frames are done"]
    assert names(out) == [f"a.{k:02}.{kind}" for k in (1, 2, 3) for kind in ("exr", "png")]
    assert contents() == whole


def test_resume_finds_one_changed_byte(render):
    assert render("a.#.exr", "-f", "1")[0] == 0
    whole = contents()
    damaged = bytearray(whole["a.1.exr"])
    damaged[-200] ^= 0xFF
    Path("a.1.exr").write_bytes(damaged)
    assert names(render("a.#.exr", "-f", "1", "--resume")[1]) == ["a.1.exr"]
    assert contents() == whole


def test_resume_with_everything_done_renders_nothing(render):
    assert render("a.#.exr", "-f", "1:3")[0] == 0
    before = {name: os.stat(name).st_mtime_ns for name in contents()}
    code, out, err = render("a.#.exr", "-f", "1:3", "--resume")
    assert (code, out, err) == (0, [], ["resume: 3 of 3 frames are done"])
    assert {name: os.stat(name).st_mtime_ns for name in contents()} == before
    _, _, err = render("a.#.exr", "-f", "1:3", "--resume", "--progress", "json")
    assert [json.loads(line)["event"] for line in err] == ["line", "begin", "end"]


@pytest.mark.parametrize("change", ["setting", "method", "size", "camera", "layer", "threads", "moved"])
def test_resume_redoes_frames_that_would_look_different(render, change):
    assert render("a.#.exr", "-f", "1:2")[0] == 0
    options = {
        "setting": ["--set", "refine=off"],
        "method": ["--method", "reference"],
        "size": ["--res", "24x20"],
        "camera": ["-cam", "/World/Camera"],
        "threads": ["--set", "threads=1"],
    }.get(change, [])
    if change == "layer":
        Path("look.usda").write_text(LOOK.replace("0.9, 0.9, 0.9", "0.9, 0.5, 0.5"))
    if change == "moved":
        for name in ("stage.usda", "look.usda"):
            shutil.copy(name, f"{name}.copy")  # another file and time, the same words
            os.replace(f"{name}.copy", name)
    out = render("a.#.exr", "-f", "1:2", "--resume", *options)[1]
    # The number of threads changes no bit.
    assert names(out) == ([] if change in ("threads", "moved") else ["a.1.exr", "a.2.exr"])


@pytest.mark.parametrize("file", ["look.usda", "stage.usda"])
def test_a_stage_that_changes_under_way_is_told_and_its_frames_are_made_anew(render, monkeypatch, file):
    tell, text = Report.frame, Path(file).read_text()

    def change(*arguments):
        Path(file).write_text(text + "\n# another\n")
        tell(*arguments)

    monkeypatch.setattr(Report, "frame", change)
    code, out, err = render("a.#.exr", "-f", "1:3")
    assert (code, len(out)) == (1, 3)
    assert [line for line in err if "changed while it was rendered" in line and "--resume" in line]
    monkeypatch.setattr(Report, "frame", tell)
    assert names(render("a.#.exr", "-f", "1:3", "--resume")[1]) == ["a.1.exr", "a.2.exr", "a.3.exr"]
    assert render("a.#.exr", "-f", "1:3", "--resume")[0] == 0


def test_resumed_and_divided_ranges_are_the_same_bytes(render):
    assert render("a.#.exr", "-f", "1:7")[0] == 0
    whole = contents()
    for name in ("a.2.exr", "a.4.exr", "a.7.exr"):
        os.unlink(name)
    assert render("a.#.exr", "-f", "1:7", "--resume")[0] == 0
    assert contents() == whole
    for name in whole:
        os.unlink(name)
    for part, frames in (("3/3", "567"), ("1/3", "12"), ("2/3", "34")):
        assert names(render("a.#.exr", "-f", "1:7", "--part", part)[1]) == [f"a.{k}.exr" for k in frames]
    assert contents() == whole


def test_what_is_reused_from_frame_to_frame_starts_afresh_at_fixed_frames(stage, capfd, device, monkeypatch):
    monkeypatch.setattr(pipeline, "REUSE_RUN", 3)
    write_stage("turn.usda", MOVING_CAMERA, STILL_BOX)
    shared = []
    history = frame._history

    def watched(*arguments):
        shared.append(history(*arguments) is not None)
        return history(*arguments)

    monkeypatch.setattr(frame, "_history", watched)
    options = ["-f", "1:8", "--method", "reflector_map", "--set", "reuse_px=0.5", "-w", "60", "--device", device]
    assert cli.main(["render", "turn.usda", "a.#.exr", *options]) == 0
    # Frames 1; 2, 3; 3 again with nothing reused, 4 to 6; 6 again, 7, 8.
    assert shared == [False, True, True, False, True, True, True, False, True, True]
    whole = contents()
    for name in ("a.3.exr", "a.5.exr", "a.7.exr"):
        os.unlink(name)
    assert cli.main(["render", "turn.usda", "a.#.exr", *options, "--resume"]) == 0
    assert names(capfd.readouterr().out.splitlines())[8:] == ["a.3.exr", "a.5.exr", "a.7.exr"]
    assert contents() == whole


def test_frames_of_a_range_start_from_nothing_unless_asked_to(stage, device):
    write_stage("turn.usda", MOVING_CAMERA, STILL_BOX)
    scene = wr.load_stage("turn.usda", device, 1.0)
    for reuse, kept in ((0.0, False), (0.5, True)):
        plan = wr.make_plan(scene, size=(60, 45), method="reflector_map", settings=wr.Settings(reuse_px=reuse))
        first = wr.render_frame(scene, plan)
        assert (frame._history(first, scene.at(2.0), plan.rows[0]) is not None) == kept


def test_frames_needed_are_the_one_before_or_a_run():
    job = pipeline.Job("s.usda", tuple(range(40)), tuple((f"a.{k}.exr",) for k in range(40)))
    assert [job.first_needed(place) for place in (0, 1, 20)] == [0, 0, 19]
    part, local = job.cut([20, 21, 30])
    assert (part.times, local) == ((19, 20, 21, 29, 30), [1, 2, 4])
    reusing = pipeline.dataclasses.replace(job, settings=wr.Settings(reuse_px=1.0))
    run = pipeline.REUSE_RUN
    assert [reusing.first_needed(place) for place in (0, run - 1, run, run + 4)] == [0, 0, run - 1, run - 1]
    part, local = reusing.cut([run + 2])
    assert (part.times, local) == (tuple(range(run - 1, run + 3)), [3])
    assert [part.starts_run(place) for place in range(4)] == [False, True, False, False]
    pictures = pipeline.dataclasses.replace(job, files=tuple((f"a.{k}.png",) for k in range(40)))
    assert pictures.first_needed(20) == 20


# The stage's identity.


def test_a_stage_that_names_a_pipe_is_known_without_reading_it(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    path = tmp_path / "stage.usda"
    path.write_text('#usda 1.0\ndef "A"\n{\n    asset picture = @./pipe.png@\n}\n')
    known = []
    reading = threading.Thread(target=lambda: known.append(stage_digest(path)), daemon=True)
    reading.start()
    reading.join(60.0)  # to read a pipe that nobody writes to would take for ever
    assert [len(digest) for digest in known] == [32]


def test_stage_is_known_by_the_contents_of_all_its_files(stage, tmp_path):
    first = stage_digest(stage)
    assert stage_digest(stage, untrusted=True) == first
    (tmp_path / "elsewhere").mkdir()
    for name in ("stage.usda", "look.usda"):
        shutil.copy(name, tmp_path / "elsewhere")
    assert stage_digest(tmp_path / "elsewhere" / stage) == first
    Path("look.usda").write_text(LOOK + "# a comment\n")
    assert stage_digest(stage) != first
    with pytest.raises(ValueError, match="outside the folder elsewhere"):
        stage_digest(stage, root="elsewhere")


def test_stage_is_known_by_its_pictures(stage):
    Path("look.usda").write_text(
        LOOK.replace("float inputs:intensity = 1", "float inputs:intensity = 1\nasset inputs:texture:file = @sky.exr@")
    )
    digests = set()
    for value in (0.5, 0.6):
        images.write_exr("sky.exr", {"RGB": np.full((4, 8, 3), value, np.float32)})
        digests.add(stage_digest(stage))
    os.unlink("sky.exr")
    digests.add(stage_digest(stage))
    assert len(digests) == 3


# Stopping.


@pytest.fixture
def after_frame(monkeypatch):
    """Do something to this process right after a frame (1-based) was rendered and written."""

    def plan(actions: dict[int, object]) -> None:
        render_one, number = pipeline._render, itertools.count(1)

        def wrapped(*arguments):
            outcome = render_one(*arguments)
            action = actions.get(next(number))
            if action is not None:
                action()
            return outcome

        monkeypatch.setattr(pipeline, "_render", wrapped)

    return plan


def raising(number: int):
    return lambda: os.kill(os.getpid(), number)


@pytest.mark.parametrize(("number", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_stops_after_the_frame_at_hand_and_says_how_to_go_on(render, after_frame, number, expected):
    after_frame({2: raising(number)})
    before = signal.getsignal(number)
    code, out, err = render("a.#.exr", "-f", "1:5")
    assert code == expected
    assert names(out) == ["a.1.exr", "a.2.exr"]
    assert list(contents()) == ["a.1.exr", "a.2.exr"]
    assert err[-1] == (
        f"stopped by {number.name}: from frame 3 on 3 of 5 frames are left; the same command with --resume goes on"
    )
    assert signal.getsignal(number) is before
    assert render("a.#.exr", "-f", "1:5", "--resume")[0] == 0
    assert len(contents()) == 5


def test_second_signal_stops_at_once_and_leaves_no_part_of_a_file(render, monkeypatch):
    write = images._write_whole

    def interrupted(path, *rest):
        if path.name == "a.2.exr":
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        write(path, *rest)

    monkeypatch.setattr(images, "_write_whole", interrupted)
    code, _, err = render("a.#.exr", "-f", "1:3")
    assert code == 130
    assert "2 of 3 frames are left" in err[-1]
    assert sorted(os.listdir()) == ["a.1.exr", "look.usda", "stage.usda"]


@pytest.mark.skipif(not hasattr(signal, "SIGUSR1"), reason="a signal that Windows does not have")
def test_snapshot_is_the_last_finished_frame(render, after_frame):
    after_frame({1: raising(signal.SIGUSR1), 3: raising(signal.SIGUSR1)})
    code, _, err = render("a.##.exr", "b.##.png", "-f", "1:4")
    assert code == 0
    assert err == ["snapshot: no frame is finished yet", "snapshot: a.snapshot.png shows a.02.exr"]
    assert Path("a.snapshot.png").exists()
    snapshot, frame = images.read_image("a.snapshot.png").rgb, images.read_image("b.02.png").rgb
    np.testing.assert_array_equal(snapshot, frame)


def test_snapshot_of_exr_alone_is_its_picture(render, after_frame):
    after_frame({2: raising(signal.SIGUSR1)})
    assert render("a.##.exr", "-f", "1:2")[0] == 0
    channels, _ = images.read_exr("a.01.exr")
    linear = np.clip(np.stack([channels[letter] for letter in "RGB"], axis=-1), 0.0, 1.0)
    shown = images.srgb_from_linear(images.read_image("a.snapshot.png").rgb)
    np.testing.assert_allclose(shown, images.srgb_from_linear(linear), atol=0.6 / 255.0)


def test_snapshots_have_no_frame_number():
    assert [snapshot_name(name) for name in ("d/a.####.exr", "a_%04d.png", "a.exr", "a.###.##.exr")] == [
        "d/a.snapshot.png",
        "a.snapshot.png",
        "a.snapshot.png",
        "a.snapshot.png",
    ]


def test_time_limit_begins_no_frame_that_would_not_end(stage, monkeypatch):
    """With a clock that frames alone move: 10 s a frame, 47 s in all."""
    clock = [1000.0]
    monkeypatch.setattr(pipeline.time, "time", lambda: clock[0])
    monkeypatch.setattr(pipeline.time, "perf_counter", lambda: clock[0])

    def slow(_opened, place, _digest):
        clock[0] += 10.0
        return pipeline.Outcome(place, "written")

    monkeypatch.setattr(pipeline, "_render", slow)
    job = pipeline.Job(stage, tuple(range(9)), tuple((f"a.{k}.exr",) for k in range(9)))
    outcomes = list(pipeline.render_places(job, range(9), "", [None], deadline=1047.0))
    assert [outcome.place for outcome in outcomes] == [0, 1, 2, 3]


@pytest.mark.parametrize("seconds", ["-1", "nan"])
def test_time_limit_that_is_none_is_refused(render, seconds):
    code, _, err = render("a.#.exr", "-f", "1:3", f"--timelimit={seconds}")
    assert (code, err) == (2, [f"error: --timelimit: got {seconds}, expected seconds, 0 or more"])


def test_time_limit_is_told(render):
    code, out, err = render("a.#.exr", "-f", "1:3", "--timelimit", "0")
    assert (code, out) == (1, [])
    assert err == [
        "stopped by the time limit: from frame 1 on 3 of 3 frames are left; the same command with --resume goes on"
    ]


# Several processes.


def test_frame_that_another_process_writes_is_left_to_it(render):
    with pipeline.claimed(["a.2.exr"]) as free:
        assert free
        code, out, err = render("a.#.exr", "-f", "1:3")
        assert (code, names(out)) == (1, ["a.1.exr", "a.3.exr"])
        assert err[0] == "error: frame 2: another process is writing a.2.exr; left to it"
        assert render("a.#.exr", "-f", "1:3", "--resume")[0] == 1
        assert not Path("a.2.exr").exists()
    assert render("a.#.exr", "-f", "1:3", "--resume")[0] == 0
    assert not list(Path().glob(".*"))


KILLED = """
import os, signal, sys
from warp_reflect import cli, images
check = images._check_last_rows
def killed(path, *rest):
    if path.name == "a.2.exr":
        os.kill(os.getpid(), signal.SIGKILL)
    check(path, *rest)
images._check_last_rows = killed
cli.main(sys.argv[1:])
"""


def test_what_a_killed_process_left_is_removed_on_resuming(render, stage, device):
    command = ["render", stage, "a.#.exr", "-f", "1:2", *SMALL, "--device", device]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", KILLED, *command], env=environment, check=False, capture_output=True)
    assert done.returncode == -signal.SIGKILL
    left = {name for name in os.listdir() if name.startswith(".")}
    assert {Path(name).suffix for name in left} == {".part", ".lock"}
    assert not Path("a.2.exr").exists()
    assert names(render("a.#.exr", "-f", "1:2", "--resume")[1]) == ["a.2.exr"]
    assert sorted(os.listdir()) == ["a.1.exr", "a.2.exr", "look.usda", "stage.usda"]


def test_claims_exclude_each_other_and_leave_nothing(tmp_path):
    inside, most, won = [], [0], []

    def contend() -> None:
        mine = 0
        for _ in range(100_000):  # how often a claim is refused is a matter of the scheduler
            with pipeline.claimed([str(tmp_path / "b.exr"), str(tmp_path / "a.exr")]) as free:
                if free:
                    inside.append(1)
                    most[0] = max(most[0], len(inside))
                    mine += 1
                    inside.pop()
            if mine == 50:
                break
        won.append(mine)

    threads = [threading.Thread(target=contend) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1
    assert won == [50] * 4
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("count", "workers"), [(200, 2), (7, 2), (1, 3), (1000, 8)])
def test_every_worker_gets_the_same_share_and_ends_with_short_batches(count, workers):
    plain = SimpleNamespace(reuses=False)
    parts = cluster._parts(plain, list(range(count)), workers)
    assert [place for part in parts for batch in part for place in batch] == list(range(count))
    shares = [sum(map(len, part)) for part in parts]
    assert max(shares) - min(shares) <= 1
    assert all(len(part[-1]) == 1 for part in parts if part)
    assert max(len(batch) for part in parts for batch in part) <= cluster.BATCH_MAX


def test_what_reuses_from_frame_to_frame_is_cut_where_it_starts_afresh():
    parts = cluster._parts(SimpleNamespace(reuses=True), list(range(5, 200)), 2)
    batches = [batch for part in parts for batch in part]
    assert [place for batch in batches for place in batch] == list(range(5, 200))
    assert all(batch[0] % pipeline.REUSE_RUN == 0 for batch in batches[1:])


def test_two_workers_write_the_same_bytes_although_one_is_killed(render, monkeypatch):
    assert render("a.#.exr", "-f", "1:8")[0] == 0
    whole = contents()
    for name in whole:
        os.unlink(name)
    tell, processes = Report.frame, []

    def kill_first(report, job, outcome):
        if not processes:
            os.kill(outcome.process, signal.SIGKILL)
        processes.append(outcome.process)
        tell(report, job, outcome)

    monkeypatch.setattr(Report, "frame", kill_first)
    code, out, err = render("a.#.exr", "-f", "1:8", "--workers", "2", "--progress", "json")
    assert code == 0
    assert sorted(names(out)) == list(whole)
    assert len(set(processes)) >= 2
    assert os.getpid() not in processes
    assert contents() == whole
    events = [json.loads(line) for line in err]
    assert [event["state"] for event in events if event["event"] == "frame"] == ["written"] * 8


def test_scheduler_that_is_not_there_is_one_line_and_2(render, monkeypatch):
    monkeypatch.setattr(cluster, "SCHEDULER_SECONDS", 0.5)
    code, out, err = render("a.#.exr", "-f", "1:3", "--scheduler", "tcp://127.0.0.1:9")
    assert (code, out, len(err)) == (2, [], 1)
    assert err[0].startswith("error: --scheduler tcp://127.0.0.1:9: no answer within 0.5 s")
    assert not contents()


def test_scheduler_address_that_is_none_is_one_line_and_2(stage, device):
    # In a process of its own: what is complained of at its end counts, too.
    addresses = ["nonsense", "tcp://host", "tcp://host:port", "foo://host:8786"]
    command = ["render", stage, "a.#.exr", "-f", "1:3", *SMALL, "--device", device, "--scheduler"]
    script = f"from warp_reflect import cli\nprint([cli.main([*{command}, address]) for address in {addresses}])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    told = done.stderr.splitlines()
    assert (done.returncode, done.stdout, len(told)) == (0, "[2, 2, 2, 2]\n", 4)
    for address, line in zip(addresses, told, strict=True):
        assert line.startswith(f"error: --scheduler: got '{address}', expected an address as tcp://host:8786")


def test_missing_dask_is_one_line_that_names_the_extra(render, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    code, out, err = render("a.#.exr", "-f", "1:3", "--workers", "2")
    assert (code, out) == (2, [])
    assert err == ["error: --workers and --scheduler need dask: pip install 'warp_reflect[cluster]'"]


def test_cores_of_a_process_are_bounded_by_the_environment(monkeypatch, device):
    if device != "cpu":
        pytest.skip("slices are a matter of the CPU")
    monkeypatch.setattr(launch, "thread_count", lambda *_: 4)
    assert launch.shared_by(100_000, "cpu") == 4
    monkeypatch.setenv(launch.CORES_VARIABLE, "1")
    assert launch.shared_by(100_000, "cpu") == 1


# What frames share.


def test_world_is_shared_while_cameras_alone_move(stage, device):
    write_stage("turn.usda", MOVING_CAMERA, STILL_BOX)
    first = wr.load_stage("turn.usda", device, 1.0)
    second = first.at(5.0)
    assert second.shares_world(first)
    assert second.data.time == 5.0
    assert not np.array_equal(first.data.cameras[0].world_from_camera, second.data.cameras[0].world_from_camera)
    plan = wr.make_plan(first, size=(40, 30), method="reflector_map")
    wr.render_frame(first, plan)
    later = wr.make_plan(second, size=(40, 30), method="reflector_map", earlier=plan)
    (row,) = later.rows
    assert later.prepared(row) is plan.prepared(row)
    fresh = wr.load_stage("turn.usda", device, 5.0)
    alone = wr.render_frame(fresh, wr.make_plan(fresh, size=(40, 30), method="reflector_map"))
    shared = wr.render_frame(second, later)
    for name in shared.keys():
        np.testing.assert_array_equal(shared[name], alone[name], err_msg=name)


def test_world_that_moves_is_not_shared(stage, device):
    first = wr.load_stage(stage, device, 1.0)
    plan = wr.make_plan(first, size=(40, 30), method="reflector_map")
    plan.prepared(plan.rows[0])
    second = first.at(5.0)
    assert not second.shares_world(first)
    later = wr.make_plan(second, size=(40, 30), method="reflector_map", earlier=plan)
    # A map is of its mirror alone, which stands still; the picture of what stands around it is not.
    assert later.prepared(later.rows[0]) is plan.prepared(plan.rows[0])
    plan, later = (
        wr.make_plan(each, size=(40, 30), method="environment", earlier=known)
        for each, known in ((first, None), (second, plan))
    )
    assert later.prepared(later.rows[0]) is not plan.prepared(plan.rows[0])


def test_still_stage_is_read_once(stage, device, monkeypatch):
    from warp_reflect.stage import read

    write_stage("still.usda", STILL_CAMERA, STILL_BOX)
    scene = wr.load_stage("still.usda", device, 1.0)
    monkeypatch.setattr(read.StageReader, "_read", lambda *_: pytest.fail("read again"))
    assert scene.at(2.0).shares_world(scene)
    assert scene.at(2.0).data.time == 2.0


@pytest.mark.parametrize("method", ["auto", "reference", "reflector_map"])
def test_nothing_of_a_frame_waits_for_the_garbage_collector(stage, device, method):
    first = wr.load_stage(stage, device, 1.0)
    gc.disable()
    try:
        scene = first.at(2.0)
        plan = wr.make_plan(scene, size=(40, 30), method=method)
        frame = wr.render_frame(scene, plan)
        for name in frame.keys():
            assert frame[name].size
        kept = [weakref.ref(each) for each in (frame, plan, scene)]
        del frame, plan, scene
        assert [each() for each in kept] == [None, None, None]
    finally:
        gc.enable()


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from Linux' /proc")
def test_memory_stays_flat_over_many_frames(render, monkeypatch):
    sizes = []
    tell = Report.frame
    monkeypatch.setattr(Report, "frame", lambda *arguments: (sizes.append(resident_bytes()), tell(*arguments)))
    assert render("a.#.###.exr", "-f", "1:9x0.125")[0] == 0
    assert len(sizes) == 65
    # A frame of this size with its scene is about 3 MB; one kept a frame would be 180 MB.
    assert max(sizes[-10:]) - max(sizes[:11]) < 12e6


# What is said.


def test_json_progress_is_one_object_a_line(render):
    Path("a.2.exr").mkdir()
    code, _, err = render("a.#.exr", "-f", "1:12", "--progress", "json")
    events = [json.loads(line) for line in err]
    assert code == 1
    assert [event["event"] for event in events] == ["begin", "line"] + ["frame"] * 12 + ["line", "end"]
    frames = [event for event in events if event["event"] == "frame"]
    assert [(event["frame"], event["done"], event["state"]) for event in frames] == [
        (float(k), k, "failed" if k == 2 else "written") for k in range(1, 13)
    ]
    assert frames[0]["left_s"] > 0.0
    assert frames[-1]["left_s"] == 0.0
    assert "lie outside of its time codes 1 to 9 (from 10 on)" in events[1]["text"]
    assert events[-1]["exit"] == 1


def test_json_progress_holds_the_reason_of_a_refusal(render):
    code, _, err = render("a.#.exr", "-f", "1:2", "-cam", "Nothing", "--progress", "json")
    assert code == 2
    assert "/World/Camera" in [json.loads(line) for line in err][-1]["text"]


def test_alf_progress_counts_per_cent(render):
    code, _, err = render("a.#.exr", "-f", "1:3", "--progress", "alf")
    assert (code, err) == (0, ["ALF_PROGRESS 33%", "ALF_PROGRESS 66%", "ALF_PROGRESS 100%"])


def test_rich_progress_shows_the_frames_and_the_time_left(render, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "100")
    code, out, err = render("a.#.exr", "-f", "1:3", "--progress", "rich")
    assert code == 0
    assert names(out) == ["a.1.exr", "a.2.exr", "a.3.exr"]
    assert "3/3" in "".join(err)


def test_frames_outside_of_the_stage_are_one_note_and_hold_its_values(render):
    code, out, err = render("a.##.exr", "-f", "8:12")
    assert (code, len(out)) == (0, 5)
    assert err == [
        "note: stage.usda: 3 of 5 frames lie outside of its time codes 1 to 9 (from 10 on); it holds its values there"
    ]
    held = [images.read_exr(f"a.{k:02}.exr")[0]["reflectedPoint"] for k in (9, 10, 12)]
    np.testing.assert_array_equal(held[0], held[1])
    np.testing.assert_array_equal(held[0], held[2])


# Multi-part files.


def test_parts_of_a_file_hold_the_channels_of_one(stage, device):
    options = [stage, "-f", "1", "-w", "24", "--device", device]
    assert cli.main(["render", *options, "a.#.exr"]) == 0
    assert cli.main(["render", *options, "b.#.exr", "--multi-part"]) == 0
    (one, head), (many, parted) = images.read_exr("a.1.exr"), images.read_exr("b.1.exr")
    assert one.keys() == many.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], many[name], err_msg=name)
    assert parted["oiio:subimages"] == 14
    assert parted["name"] == "RGBA"
    assert parted["warp_reflect:prims"] == head["warp_reflect:prims"]
    os.truncate("b.1.exr", os.stat("b.1.exr").st_size - 100)
    with pytest.raises(OSError, match=r"b\.1\.exr: cannot be read"):
        images.check_whole("b.1.exr")


# Farms.


def test_farm_job_is_valid_and_its_tasks_make_the_whole_range(stage, capfd, device, monkeypatch):
    options = [
        "--frames=-1:9x0.5",
        "-w",
        "24",
        "--aov",
        "RGBA",
        "--set",
        "refine=off",
        "--set",
        "threads=1",
        "--strict",
    ]
    assert cli.main(["render", stage, "a.##.#.exr", "b.##.#.png", *options, "--print-job", "openjd"]) == 0
    template = json.loads(capfd.readouterr().out)
    decoded = decode_job_template(template=template)
    here = Path().resolve()
    values = preprocess_job_parameters(
        job_template=decoded, job_parameter_values={}, job_template_dir=here, current_working_dir=here
    )
    job = create_job(job_template=decoded, job_parameter_values=values)
    (step,) = job.steps
    tasks = list(step.parameterSpace.taskParameterDefinitions["Part"].range)
    assert tasks == [1, 2, 3]
    action = step.script.actions.onRun
    assert str(action.command) == "warp-reflect"
    resolved = {f"{{{{Param.{name}}}}}": value.value for name, value in values.items()}
    seen = []
    monkeypatch.setattr(pipeline, "run", lambda job, _report, **rest: seen.append((job, rest)) or 0)
    for task in tasks:
        tokens = []
        for argument in map(str, action.args):
            text = argument.replace("{{Task.Param.Part}}", str(task))
            for name, value in resolved.items():
                text = text.replace(name, str(value))
            tokens.append(text)
        assert cli.main(tokens) == 0
    assert [rest["part"] for _, rest in seen] == [(1, 3), (2, 3), (3, 3)]
    assert all(rest["resume"] and rest["strict"] for _, rest in seen)
    made = seen[0][0]
    assert made.times == tuple(-1.0 + 0.5 * k for k in range(21))
    assert made.settings == wr.Settings(refine="off", threads=1)
    assert (made.channels, made.width) == (("RGBA",), 24)
    places = [place for _, rest in seen for place in pipeline.part_of(21, rest["part"])]
    assert places == list(range(21))


def test_farm_job_of_one_frame_has_no_parts(stage, capfd):
    assert cli.main(["render", stage, str(Path("out.exr").resolve()), "--print-job", "openjd"]) == 0
    template = json.loads(capfd.readouterr().out)
    decode_job_template(template=template)
    assert "parameterSpace" not in template["steps"][0]
    assert not contents("out*")
