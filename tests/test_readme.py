"""The README's marked commands do what they say."""

from __future__ import annotations

import itertools
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from warp_reflect import cli, images
from warp_reflect.channels import CHANNELS
from warp_reflect.stage.frames import frame_name, parse_frames

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 96  # pixels instead of the README's; the picture is the same, smaller
SIZE_OPTIONS = ("--imageWidth", "-w", "--res")
FRAME_OPTIONS = ("--frames", "-f")
SEPARATORS = {"&&", "||", ";", "|", "&"}


def commands(marker: str) -> list[list[str]]:
    """The commands, as words, of the fenced block that follows `<!-- marker -->` in the README.

    Continued lines are joined, `&&` and `;` separate commands, comments and `$` prompts are dropped.
    """
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(rf"<!-- {marker} -->\s*\n```[^\n`]*\n(.*?)\n```", text, flags=re.DOTALL)
    assert len(blocks) == 1, f"README.md: {len(blocks)} fenced blocks follow '<!-- {marker} -->', expected one"
    found = []
    for line in blocks[0].replace("\\\n", " ").splitlines():
        lexer = shlex.shlex(line.strip().removeprefix("$ "), posix=True, punctuation_chars=True)
        lexer.whitespace_split = True
        lexer.commenters = ""  # it would cut `frame.####.exr`; a shell's comment begins a word
        words: list[str] = []
        for word in [*itertools.takewhile(lambda word: not word.startswith("#"), lexer), ";"]:
            if word not in SEPARATORS:
                words.append(word)
            elif words:
                found.append(words)
                words = []
    assert found, f"README.md: the block of '<!-- {marker} -->' holds no command"
    return found


def render_words() -> list[str]:
    """What follows `warp-reflect` in the main command."""
    found = []
    for words in commands("main-command"):
        for k, word in enumerate(words[:-1]):
            if Path(word).name in ("warp-reflect", "warp_reflect.cli") and words[k + 1] == "render":
                found.append(words[k + 1 :])
    assert len(found) == 1, f"README.md: the main command holds {len(found)} times 'warp-reflect render', expected one"
    return found[0]


def option(words: list[str], names: tuple[str, ...]) -> str | None:
    """The value of an option, as `--name value` or `--name=value`."""
    for k, word in enumerate(words):
        name, equals, value = word.partition("=")
        if name in names:
            return value if equals else words[k + 1]
    return None


def without(words: list[str], names: tuple[str, ...]) -> list[str]:
    """The words without an option and its value."""
    kept, skip = [], False
    for word in words:
        name, equals, _ = word.partition("=")
        if skip:
            skip = False
        elif name in names:
            skip = not equals
        else:
            kept.append(word)
    return kept


def test_readme_says_how_to_run_the_tests():
    assert any("pytest" in words for words in commands("test-command"))


def test_readme_names_a_stage_of_the_checkout():
    stages = [word for word in render_words() if Path(word).suffix in (".usda", ".usdc", ".usd", ".usdz")]
    assert len(stages) == 1
    assert (ROOT / stages[0]).is_file(), f"README.md: {stages[0]} is not in the checkout"


def test_readme_main_command_renders_whole_files(tmp_path, monkeypatch, capfd, device):
    monkeypatch.setattr(sys, "excepthook", sys.excepthook)
    monkeypatch.chdir(ROOT)
    words, outputs = [], []
    for word in without(render_words(), SIZE_OPTIONS):
        if Path(word).suffix in (".exr", ".png"):
            outputs.append(tmp_path / Path(word).name)
            word = str(outputs[-1])
        words.append(word)
    assert outputs, "README.md: the main command writes no .exr and no .png"
    if option(words, ("--device",)) is None:
        words += ["--device", device]
    code = cli.main([*words, "--imageWidth", str(WIDTH)])
    out, err = capfd.readouterr()
    assert code == cli.DONE, f"{shlex.join(words)}: exit {code}: {err}"
    frames = option(words, FRAME_OPTIONS)
    written = [
        Path(frame_name(str(output), time)) if frames else output
        for output in outputs
        for time in (parse_frames(frames) if frames else [None])
    ]
    assert sorted(path for path in tmp_path.iterdir()) == sorted(written)
    for path in written:
        assert str(path) in out
        if path.suffix == ".png":
            rgb = images.read_image(path).rgb
            assert rgb.shape[1] == WIDTH
            assert np.ptp(rgb) > 0.1  # a picture of something
            continue
        channels, header = images.read_exr(path)
        if option(words, ("--aov",)) is None:
            assert set(channels) == (set(CHANNELS) - {"RGBA"}) | set("RGBA")
            assert (channels["reflectorId"] > 0).any()
        assert all(np.isfinite(values).all() and values.shape[1] == WIDTH for values in channels.values())
        assert "warp_reflect:plan" in header


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("python -m pytest", [["python", "-m", "pytest"]]),
        ("$ pip install . && pytest -q  # all", [["pip", "install", "."], ["pytest", "-q"]]),
        ("a b \\\n  c; d 'e f'", [["a", "b", "c"], ["d", "e f"]]),
        ("a x.###.exr # b", [["a", "x.###.exr"]]),
        ("a --set=x=1 '/World/*'", [["a", "--set=x=1", "/World/*"]]),
    ],
)
def test_commands_reads_a_block_as_a_shell_does(text, expected, tmp_path, monkeypatch):
    (tmp_path / "README.md").write_text(f"# x\n<!-- some -->\n```sh\n{text}\n```\n<!-- other -->\n```\nno\n```\n")
    monkeypatch.setattr(sys.modules[__name__], "ROOT", tmp_path)
    assert commands("some") == expected
