"""The command line: what it prints, what it writes, and how it ends."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from warp_reflect import cli, devices, images
from warp_reflect.channels import CHANNELS
from warp_reflect.stage.frames import frame_name, has_frame_pattern, parse_frames
from warp_reflect.techniques import TECHNIQUES

ROOT = Path(__file__).resolve().parents[1]

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 3
)
def Xform "World"
{
    def Camera "Camera"
    {
        float2 clippingRange = (0.1, 1000)
        float focalLength = 30
        float horizontalAperture = 24
        float verticalAperture = 18
        double3 xformOp:translate = (0, 1, 8)
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
        double3 xformOp:translate.timeSamples = { 1: (2, 0, 2), 3: (2, 1, 2) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
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
BAD_MESH = """
def "Extra"
{
    def Mesh "Broken"
    {
        int[] faceVertexCounts = [3]
        int[] faceVertexIndices = [0, 1, 7]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    }
}
"""


@pytest.fixture
def stage(tmp_path, monkeypatch, device) -> str:
    """A chrome sphere and a moving box, in an otherwise empty current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    Path("stage.usda").write_text(STAGE)
    return "stage.usda"


@pytest.fixture
def call(capfd, device):
    """Run the command line in this process: (exit code, standard output, standard error)."""

    def run(*tokens: str) -> tuple[int, str, str]:
        if tokens[0] in ("plan", "render"):
            tokens = (*tokens, "--device", device)
        capfd.readouterr()
        code = cli.main([str(token) for token in tokens])
        out, err = capfd.readouterr()
        return code, out, err

    return run


def files() -> list[str]:
    return sorted(path.name for path in Path().iterdir() if path.name != "stage.usda")


def test_render_writes_every_channel_and_the_picture(stage, call):
    code, out, err = call("render", stage, "a.exr", "-o", "a.png", "-w", "80")
    assert (code, err) == (0, "")
    assert files() == ["a.exr", "a.png"]
    lines = out.splitlines()
    assert [line.split(":")[0] for line in lines] == ["a.exr", "a.png"]
    # 24 x 18 film: the height follows from the aspect.
    assert all("80x60" in line and " ms" in line and "mirror pixels" in line for line in lines)
    channels, header = images.read_exr("a.exr")
    assert set(channels) == (set(CHANNELS) - {"RGBA"}) | set("RGBA")
    assert (channels["reflectorId"] == 1).sum() > 200
    assert "/World/Mirror" in header["warp_reflect:prims"].values()
    assert header["warp_reflect:eye"] == [0.0, 1.0, 8.0]
    assert images.read_image("a.png").rgb.shape == (60, 80, 3)


def test_render_of_chosen_channels_and_exact_size(stage, call):
    code, _, _ = call("render", stage, "a.exr", "--res", "64x32", "--aov", "reflectedPoint, R,reflection.G")
    assert code == 0
    channels, _ = images.read_exr("a.exr")
    assert {name: values.shape for name, values in channels.items()} == {
        "reflectedPoint": (32, 64, 3),
        "R": (32, 64),
        "reflection.G": (32, 64),
    }


def test_channels_are_asked_for_by_the_names_of_others_too(stage, call):
    code, _, _ = call("render", stage, "a.exr", "--res", "16x8", "--aov", "depth, normal,HdrColor,color,N")
    assert code == 0
    assert set(images.read_exr("a.exr")[0]) == {"Z", "N", "R", "G", "B", "A"}
    code, _, err = call("render", stage, "a.exr", "--aov", "pathLenght")
    assert code == 2
    assert "unknown channel 'pathLenght'; nearest: pathLength; known: RGBA, R," in err


def test_render_of_frames_numbers_the_files(stage, call):
    code, out, _ = call("render", stage, "a.###.exr", "b.#.##.png", "-f", "1:3x2", "-w", "40")
    assert code == 0
    assert files() == ["a.001.exr", "a.003.exr", "b.1.00.png", "b.3.00.png"]
    told = [line.split(":")[0] for line in out.splitlines()]
    assert told == ["a.001.exr", "b.1.00.png", "a.003.exr", "b.3.00.png"]
    assert call("render", stage, "c.#.##.png", "-f", "1:1.5x0.25", "-w", "40")[0] == 0
    assert files()[-3:] == ["c.1.00.png", "c.1.25.png", "c.1.50.png"]


def test_frames_show_the_stage_at_their_time(stage, call):
    assert call("render", stage, "a.#.exr", "-f", "1:3", "-w", "40", "--method", "reference")[0] == 0
    ids = [images.read_exr(f"a.{time}.exr")[0]["primId"] for time in (1, 2, 3)]
    rows = [np.nonzero(image == 2)[0].mean() for image in ids]
    assert rows[0] > rows[1] + 0.5 > rows[2] + 1.0  # the box rises


def test_frame_that_fails_is_named_and_the_others_go_on(stage, call):
    Path("a.2.exr").mkdir()
    code, out, err = call("render", stage, "a.#.exr", "-f", "1:3", "-w", "40")
    assert code == 1
    assert [line.split(":")[0] for line in out.splitlines()] == ["a.1.exr", "a.3.exr"]
    assert err.splitlines() == [
        "error: frame 2: a.2.exr: cannot be written: it exists and is not a regular file",
        "kept 2 finished files: a.1.exr, a.3.exr",
    ]
    assert files() == ["a.1.exr", "a.2.exr", "a.3.exr"]


@pytest.mark.parametrize(
    ("tokens", "message"),
    [
        (["render", "none.usda", "a.exr"], "none.usda"),
        (["render", "stage.usda"], "no output given"),
        (["render", "stage.usda", "a.jpg"], "use .exr or .png"),
        (["render", "stage.usda", "missing/a.exr"], "the folder 'missing' does not exist"),
        (["render", "stage.usda", "a.exr", "a.exr"], "the same output is given twice"),
        (["render", "stage.usda", "a.###.exr"], "add --frames"),
        (["render", "stage.usda", "a.exr", "-f", "1:3"], "expected exactly one frame number"),
        (["render", "stage.usda", "a.#.exr", "-f", "1:x"], "expected frames such as"),
        (["render", "stage.usda", "a.#.exr", "-f", "1:2x0.5"], "needs more digits"),
        (["render", "stage.usda", "a.exr", "-cam", "Nothing"], "/World/Camera"),
        (["render", "stage.usda", "a.exr", "--method", "magic"], ", ".join(TECHNIQUES)),
        (["render", "stage.usda", "a.exr", "--set", "refin=off"], "refine"),
        (["render", "stage.usda", "a.exr", "--set", "refine=maybe"], "exact"),
        (["render", "stage.usda", "a.exr", "--set", "refine"], "expected name=value"),
        (["render", "stage.usda", "a.exr", "--res", "100"], "expected WIDTHxHEIGHT"),
        (["render", "stage.usda", "a.exr", "--res", "0x10"], "--res: got '0x10'"),
        (["render", "stage.usda", "a.exr", "-w", "0"], "--imageWidth: got 0"),
        (["render", "stage.usda", "a.exr", "-w", "wide"], "wide"),
        (["render", "stage.usda", "a.exr", "--aov", "deep"], "reflectedPoint"),
        (["render", "stage.usda", "a.exr", "--reflector", "/World/None*"], "/World/None*"),
        (["render", "stage.usda", "a.exr", "--purposes", "everything"], "proxy"),
        (["render", "stage.usda", "a.exr", "--complexity", "extreme"], "veryhigh"),
        (["render", "stage.usda", "a.exr", "--root", "elsewhere"], "outside the folder elsewhere"),
        (["render", "stage.usda", "a.exr", "--root", "elsewhere", "--untrusted"], "outside the folder elsewhere"),
        (["render", "stage.usda", "a.exr", "--bogus"], "--bogus"),
        (["render", "stage.usda", "a.exr", "--progress", "bar"], "rich, json, alf, none"),
        (["render", "stage.usda", "a.exr", "--part", "3/2"], "--part: got '3/2'"),
        (["render", "stage.usda", "a.exr", "--workers", "0"], "--workers: got 0"),
        (["render", "stage.usda", "a.exr", "--print-job", "slurm"], "openjd"),
        (["render", "stage.usda", "a.#.exr", "-f", "1:4", "--strict"], "outside of its time codes 1 to 3"),
        (["plan", "stage.usda", "more.usda"], "more.usda"),
        (["compare", "none.exr", "stage.usda"], "none.exr: cannot be read: no such file"),
        (["compare", "stage.usda", "stage.usda"], "stage.usda: cannot be read"),
    ],
)
def test_impossible_requests_end_with_one_line_and_2(stage, call, tokens, message):
    code, out, err = call(*tokens)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert len(err.splitlines()) == 1
    assert message in err
    assert files() == []


def test_device_that_is_not_there_is_refused(stage, capfd):
    assert cli.main(["plan", stage, "--device", "cuda:97"]) == 2
    err = capfd.readouterr().err
    assert err.startswith("error: --device: got 'cuda:97', this machine has cpu")


def test_debug_shows_the_traceback_and_ends_the_same(stage, call):
    code, _, err = call("render", stage, "a.exr", "-cam", "Nothing", "--debug")
    assert code == 2
    assert "Traceback (most recent call last)" in err
    assert err.splitlines()[-1].startswith("error: ")


def test_fault_of_the_program_is_one_line_and_1(stage):
    script = (
        "import sys, warp_reflect.planner as p\n"
        "def make_plan(*a, **k): raise AssertionError('two\\nlines')\n"
        "p.make_plan = make_plan\n"
        "from warp_reflect import cli\n"
        f"sys.exit(cli.main(['plan', {stage!r}]))"
    )
    done = python(script)
    assert done.returncode == 1
    assert done.stderr == "error: AssertionError: two lines (a fault of warp-reflect: --debug shows where)\n"


def test_bad_prim_is_a_note_or_with_strict_an_error(stage, call):
    Path("bad.usda").write_text(STAGE + BAD_MESH)
    code, _, err = call("render", "bad.usda", "a.exr", "-w", "40")
    assert code == 0
    assert "note: /Extra/Broken: " in err
    os.unlink("a.exr")
    code, _, err = call("render", "bad.usda", "a.exr", "-w", "40", "--strict")
    assert code == 2
    assert err.startswith("error: ")
    assert "/Extra/Broken" in err
    assert not Path("a.exr").exists()


def test_plan_is_text_or_json(stage, call):
    code, out, err = call("plan", stage)
    assert (code, err) == (0, "")
    assert "/World/Mirror " in out
    code, out, _ = call("plan", stage, "--json", "-w", "200", "--method", "reference")
    numbers = json.loads(out)
    assert code == 0
    assert numbers["size"] == [200, 150]
    assert numbers["camera"] == "/World/Camera"
    assert [(row["path"], row["technique"], row["forced"]) for row in numbers["reflectors"]] == [
        ("/World/Mirror", "raytraced", True)
    ]


def test_chosen_reflectors_join_the_mirrors_of_the_stage(stage, call):
    def mirrors(*tokens: str) -> list[str]:
        code, out, _ = call("plan", stage, "--json", *tokens)
        assert code == 0
        return [row["path"] for row in json.loads(out)["reflectors"]]

    assert mirrors() == ["/World/Mirror"]
    # The box has no material: the word of the user alone makes it a mirror.
    assert mirrors("--reflector", "/World/Box") == ["/World/Mirror", "/World/Box"]
    assert mirrors("--reflector", "Bo?", "--reflector", "/World/Mirror") == ["/World/Mirror", "/World/Box"]
    assert call("render", stage, "a.exr", "--reflector", "Box", "-w", "80")[0] == 0
    assert {1, 2} <= set(np.unique(images.read_exr("a.exr")[0]["reflectorId"]))


def test_untrusted_stage_gives_the_same_frame(stage, call):
    for name, options in {"a.exr": [], "b.exr": ["--untrusted", "--root", "."]}.items():
        assert call("render", stage, name, "-w", "40", *options)[0] == 0
    (plain, _), (guarded, _) = images.read_exr("a.exr"), images.read_exr("b.exr")
    for name in plain:
        np.testing.assert_array_equal(plain[name], guarded[name], err_msg=name)


def test_untrusted_stage_reads_nothing_outside_its_folder(stage, call):
    Path("inner").mkdir()
    Path("inner/stage.usda").write_text(
        '#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@../stage.usda@]\n)\n'
    )
    assert call("plan", "inner/stage.usda")[0] == 0
    code, out, err = call("plan", "inner/stage.usda", "--untrusted")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert "outside the folder" in err
    assert call("plan", "inner/stage.usda", "--untrusted", "--root", ".")[0] == 0


def test_stage_without_camera_is_framed(stage, call):
    Path("bare.usda").write_text(STAGE.replace('def Camera "Camera"', 'def Xform "Camera"'))
    code, _, err = call("render", "bare.usda", "a.exr", "-w", "90")
    assert code == 0
    assert "the stage has no camera; one that frames it is used" in err
    seen = images.read_exr("a.exr")[0]["primId"]
    assert set(np.unique(seen)) == {0, 1, 2}
    border = np.concatenate([seen[0], seen[-1], seen[:, 0], seen[:, -1]])
    assert not border.any()


def test_compare_measures_a_technique_against_the_reference(stage, call):
    assert call("render", stage, "a.exr", "-w", "96")[0] == 0
    assert call("render", stage, "b.exr", "-w", "96", "--method", "reference")[0] == 0
    code, out, err = call("compare", "a.exr", "b.exr", "--json")
    assert (code, err) == (0, "")
    numbers = json.loads(out)
    assert numbers["interior_pixels"] > 300
    assert numbers["identical_share"] > 0.999
    code, out, _ = call("compare", "a.exr", "a.exr")
    assert code == 0
    assert "equal pictures" in out


def test_compare_refuses_frames_of_different_eyes(stage, call):
    Path("moved.usda").write_text(STAGE.replace("(0, 1, 8)", "(0, 1, 9)"))
    for name in ("stage", "moved"):
        assert call("render", f"{name}.usda", f"{name}.exr", "-w", "32")[0] == 0
    code, _, err = call("compare", "stage.exr", "moved.exr")
    assert code == 2
    assert "different eyes" in err


def test_help_names_every_command_and_exits_0(call):
    code, out, _ = call("--help")
    assert code == 0
    for command in ("plan", "render", "compare"):
        assert command in out


def test_frame_specifications_are_usdrecords():
    assert parse_frames("101:109x2,120") == [101.0, 103.0, 105.0, 107.0, 109.0, 120.0]
    assert parse_frames("101:102x0.5") == [101.0, 101.5, 102.0]
    assert parse_frames("105:101") == [105.0, 104.0, 103.0, 102.0, 101.0]
    for bad in ("", "x", "1:3x0", "1:2:3", "1:1e12", "1,,2"):
        with pytest.raises(ValueError, match="--frames"):
            parse_frames(bad)


def test_frame_names_take_every_common_pattern():
    for pattern, time, name in [
        ("a.####.exr", 7, "a.0007.exr"),
        ("a.###.##.exr", 7.25, "a.007.25.exr"),
        ("a.$F4.exr", 12, "a.0012.exr"),
        ("a.<F3>.exr", 12345, "a.12345.exr"),
        ("a.%04d.exr", -3, "a.-0003.exr"),
    ]:
        assert has_frame_pattern(pattern)
        assert frame_name(pattern, time) == name
    assert not has_frame_pattern("a.exr")


# Render settings of the stage.

SETTINGS = """
def Scope "Render"
{
    def RenderSettings "Draft"
    {
        rel camera = </World/Second>
        rel products = [</Render/Beauty>, </Render/Deep>]
        uniform int2 resolution = (40, 20)
    }
    def RenderProduct "Beauty"
    {
        uniform int2 resolution = (32, 24)
        rel orderedVars = [</Render/color>, </Render/Depth>, </Render/pathLength>, </Render/albedo>]
        token productName = "beauty.exr"
    }
    def RenderProduct "Deep"
    {
        uniform token productType = "deepRaster"
        token productName = "deep.exr"
    }
    def RenderVar "color"
    {
    }
    def RenderVar "Depth"
    {
        uniform string sourceName = "depth"
    }
    def RenderVar "pathLength"
    {
    }
    def RenderVar "albedo"
    {
    }
    def RenderSettings "Bare"
    {
    }
}
"""
SECOND_CAMERA = STAGE[STAGE.index('    def Camera "Camera"') : STAGE.index('    def Sphere "Mirror"')]


@pytest.fixture
def settings_stage(stage) -> str:
    """The stage with a second, farther camera and render settings."""
    second = SECOND_CAMERA.replace('"Camera"', '"Second"').replace("(0, 1, 8)", "(0, 1, 9)")
    Path("asking.usda").write_text(
        STAGE.replace('    def Sphere "Mirror"', second + '    def Sphere "Mirror"') + SETTINGS
    )
    return "asking.usda"


def test_render_settings_give_size_camera_name_and_channels(settings_stage, call):
    code, out, err = call("render", settings_stage, "--render-settings", "Draft")
    assert code == 0
    assert out.startswith("beauty.exr: 32x24")  # the product stands over its settings
    channels, header = images.read_exr("beauty.exr")
    assert set(channels) == {"R", "G", "B", "A", "Z", "pathLength"}
    assert header["warp_reflect:eye"] == [0.0, 1.0, 9.0]
    assert err.splitlines() == [
        "note: /Render/Deep: a product of type deepRaster is not rendered",
        "note: /Render/albedo: no channel is called 'albedo'",
    ]


def test_command_stands_over_the_render_settings_of_the_stage(settings_stage, call):
    text = Path(settings_stage).read_text()
    Path(settings_stage).write_text(text.replace("(\n", '(\n    renderSettingsPrimPath = "/Render/Draft"\n', 1))
    assert json.loads(call("plan", settings_stage, "--json")[1])["size"] == [32, 24]
    code, out, _ = call("render", settings_stage, "a.exr", "-w", "20", "-cam", "Camera", "--aov", "status")
    assert (code, out[:12]) == (0, "a.exr: 20x15")
    channels, header = images.read_exr("a.exr")
    assert (set(channels), header["warp_reflect:eye"]) == ({"status"}, [0.0, 1.0, 8.0])
    assert not Path("beauty.exr").exists()
    code, out, _ = call("render", settings_stage, "a.exr", "-rs", "/Render/Bare")
    assert (code, out[:14]) == (0, "a.exr: 960x720")


def test_render_settings_that_are_not_there_are_named(settings_stage, call):
    code, out, err = call("render", settings_stage, "a.exr", "--render-settings", "Final")
    assert (code, out) == (2, "")
    assert err == (
        "error: --render-settings: no RenderSettings prim at '/Render/Final'; the stage has /Render/Draft, /Render/Bare\n"
    )
    assert call("render", settings_stage, "a.exr", "-rs", "Draft", "--untrusted")[0] == 2
    assert call("render", settings_stage, "a.exr", "-w", "20", "--untrusted")[0] == 0


# The kernel cache.


def python(script: str, **environment: str) -> subprocess.CompletedProcess:
    environment = os.environ | {"PYTHONPATH": str(ROOT)} | environment
    run = [sys.executable, "-c", script]
    return subprocess.run(run, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def cached_module(tmp_path, device) -> Path:
    """A copy of a kernel cache that holds one compiled module of the package."""
    wp.load_module("warp_reflect.channels", device=device)
    source = max(
        Path(wp.config.kernel_cache_dir).glob("wp_warp_reflect.channels_*"),
        key=lambda path: path.stat().st_mtime,
    )
    cache = tmp_path / "cache" / Path(wp.config.kernel_cache_dir).name
    shutil.copytree(source, cache / source.name)
    return cache / source.name


def test_whole_cached_kernels_are_kept(cached_module):
    assert devices.heal_kernel_cache(cached_module.parent) == []
    assert cached_module.is_dir()


@pytest.mark.parametrize("suffix", [".o", ".meta"])
@pytest.mark.parametrize("share", [0.0, 0.05, 0.7, 0.99])
def test_cut_cached_kernels_are_found(cached_module, suffix, share, device):
    if suffix == ".o" and device != "cpu":
        suffix = ".cubin"
    file = next(path for path in cached_module.iterdir() if path.suffix == suffix)
    os.truncate(file, int(share * file.stat().st_size))
    assert devices.heal_kernel_cache(cached_module.parent) == [cached_module]
    assert not cached_module.exists()


def test_kernels_that_another_process_compiles_are_left_alone(cached_module):
    building = cached_module.rename(f"{cached_module}_p123_t140415733521280")
    for file in building.iterdir():
        os.truncate(file, 0)
    assert devices.heal_kernel_cache(building.parent) == []
    assert building.is_dir()


LOAD = """
import warp as wp
from warp_reflect import channels, devices
devices.open_device("cpu")
wp.load_module("warp_reflect.channels", device="cpu")
print(wp.config.kernel_cache_dir)
"""


def test_cut_kernels_are_compiled_again_in_one_start(cached_module, device):
    for file in cached_module.iterdir():
        os.truncate(file, file.stat().st_size // 2)
    done = python(LOAD, WARP_CACHE_PATH=str(cached_module.parents[1]))
    assert done.returncode == 0, done.stderr
    assert devices.heal_kernel_cache(cached_module.parent) == []


KEEP = """
from pathlib import Path
import warp as wp
from warp_reflect import devices
devices.open_device("cpu")
Path(wp.config.kernel_cache_dir, "kernel").mkdir()
Path(wp.config.kernel_cache_dir, "kernel", "kernel.o").write_text("compiled")
print(wp.config.kernel_cache_dir)
"""


def test_cache_folder_that_cannot_be_made_is_replaced_for_the_run(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "temporary").mkdir()
    done = python(KEEP, WARP_CACHE_PATH=str(tmp_path / "file"), TMPDIR=str(tmp_path / "temporary"))
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).is_relative_to(tmp_path / "temporary")
    assert list((tmp_path / "temporary").iterdir()) == []


def test_read_only_cache_lends_its_kernels(cached_module, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cached_module.parent))
    monkeypatch.setattr(devices, "_is_writable", lambda folder: False)
    devices.open_device("cpu")
    copy = Path(wp.config.kernel_cache_dir)
    assert copy != cached_module.parent
    assert [path.name for path in copy.iterdir()] == [cached_module.name]


@pytest.mark.parametrize("writable", [True, False])
def test_modules_of_another_user_are_passed_by(writable, cached_module, monkeypatch):
    """They can be neither read nor deleted; the others of the cache are lent."""
    theirs = cached_module.parent / "wp_warp_reflect.theirs_0000000"
    shutil.copytree(cached_module, theirs)
    read, copy, delete = devices._is_whole, shutil.copytree, shutil.rmtree

    def copied(source, to, **how):
        copy(source, to, **how)
        if Path(source) == theirs:
            raise shutil.Error([(source, to, "Permission denied")])

    monkeypatch.setattr(devices, "_is_whole", lambda folder: folder != theirs and read(folder))
    monkeypatch.setattr(shutil, "copytree", copied)
    monkeypatch.setattr(shutil, "rmtree", lambda folder, **how: folder == theirs or delete(folder, **how))
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(cached_module.parent))
    monkeypatch.setattr(devices, "_is_writable", lambda folder: writable)
    devices.open_device("cpu")
    lent = Path(wp.config.kernel_cache_dir)
    assert lent != cached_module.parent and theirs.is_dir()
    assert [path.name for path in lent.iterdir()] == [cached_module.name]


def test_warmup_readies_what_the_plan_needs_and_nothing_else(stage, capsys):
    assert cli.main(["warmup", str(stage), "--res", "64x36"]) == 0
    first = capsys.readouterr().out.splitlines()
    assert {"warp_reflect.raster", "warp_reflect.raster_vector"} & {*first}
    assert first[-1].startswith(f"{len(first) - 1} modules ready in ")
    assert not any("environment" in name or "heightfield" in name for name in first)
    assert cli.main(["warmup", str(stage), "--res", "64x36"]) == 0
    assert capsys.readouterr().out.splitlines()[-1].endswith(" ready in 0.0 s")


def test_warmup_knows_every_kernel_module():
    from warp_reflect.warmup import kernel_modules

    names = set(kernel_modules())
    assert {
        "warp_reflect.raster",
        "warp_reflect.techniques.refine_vector",
        "warp_reflect.finishes.glossy_gather",
    } <= names
    assert not names & {"warp_reflect.cli", "warp_reflect.settings", "warp_reflect.planner"}


def test_unknown_methods_are_told_the_nearest(capsys):
    for wrong, right in (
        ("quadrik", "quadric"),
        ("raytrace", "raytraced"),
        ("layered_environement", "layered_environment"),
    ):
        assert cli.main(["plan", "none.usda", "--method", wrong]) == 2
        assert f"nearest: {right}" in capsys.readouterr().err
    assert cli.main(["plan", "none.usda", "--method", "none"]) == 2
    assert "--method" not in capsys.readouterr().err  # it is one; the stage is what is missing
