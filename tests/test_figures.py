"""The command that makes the README's tables."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture
def figures(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "tools"), *sys.path])
    import figures

    return figures


def test_every_figure_has_its_tool(figures):
    for figure in figures.FIGURES.values():
        assert (ROOT / "tools" / figure.tool).is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--only", "frames", "frmes"], "got frmes, expected some of frames, kernels"),
        (["--only"], "expected at least one argument"),
        (["--limit", "0"], "got 0, expected more than 0"),
        (["--limit", "nan"], "got nan, expected more than 0"),
        (["--total", "-1"], "--total: got -1, expected more than 0"),
        (["frames"], "unrecognized arguments: frames"),
    ],
)
def test_bad_arguments_are_told(figures, capsys, words, said):
    with pytest.raises(SystemExit) as stopped:
        figures.main(words)
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err


def test_a_small_table_is_made_and_a_failing_bench_is_named_beside_it(figures, capsys, monkeypatch):
    broken = figures.Figure("Broken", "bench_frames.py", small=("no_such.usda", "--cpu"), columns={})
    slow = figures.Figure("Slow", "bench_kernels.py", small=("usd_scenes/kitchen.usda",), columns={})
    monkeypatch.setattr(figures, "FIGURES", {"broken": broken, **figures.FIGURES, "slow": slow})
    assert figures.main(["--small", "--only", "broken", "registers", "registers"]) == 1
    out, err = capsys.readouterr()
    assert err == "failed: broken\n"
    assert "**broken failed**: tools/bench_frames.py ended with 1" in out and "no_such.usda" in out.split("failed**")[1]
    assert "warp-lang 1." in out.splitlines()[0] and "cores" in out.splitlines()[0]
    rows = [line for line in out.splitlines() if line.startswith("|")]
    assert rows[:2] == ["| kernel | arrays | sm_90 |", "|---|---:|---:|"] and len(rows) == 3
    kernel, arrays, used = rows[2].strip("| ").split(" | ")
    registers, stack, share = used.split("/")
    assert kernel == "probe_kernel" and 0 < int(registers) < 256 and (arrays, stack, share) == ("0", "0", "100%")
    assert figures.main(["--small", "--only", "slow", "--limit", "0.1"]) == 1
    assert "took longer than 0.1 s" in capsys.readouterr().out
    assert figures.main(["--quick", "--only", "slow", "registers", "--total", "0.1"]) == 1
    out, err = capsys.readouterr()
    assert "slow failed" in out and "no time was left of 0.1 s" in out and err == "failed: slow, registers\n"


def test_tables_leave_empty_columns_out_and_compare_within_a_picture(figures):
    rows = [
        {"stage": stage, "size": [side, side], "contender": name, "reflect_ms": ms, "frame_ms": None, "identical": 0.5}
        for stage, side, name, ms in (("a", 8, "reference", 9.0), ("a", 8, "auto", 3.0), ("a", 16, "auto", 3.0))
    ]
    assert figures.table(rows, figures.FIGURES["frames"].columns).splitlines() == [
        "| scene | size | contender | reflection ms | against BVH | identical |",
        "|---|---:|---|---:|---:|---:|",
        "| a | 8x8 | reference | 9.0 | 1.00x | 50.000 % |",
        "| a | 8x8 | auto | 3.0 | 3.00x | 50.000 % |",
        "| a | 16x16 | auto | 3.0 |  | 50.000 % |",
    ]
