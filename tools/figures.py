"""The README's tables by one command: every benchmark in a process of its own, one after the other, as Markdown.

    python tools/figures.py > figures.md
    python tools/figures.py --only frames registers
    python tools/figures.py --small

What a benchmark measures, and how, stands at its own head. One that fails is named where its table would stand, the others go
on, and the exit code is 1. The whole ends after `--total` seconds: what is then left is named like what failed. `--small` (or
`--quick`) takes the smallest pictures and one round: it tries the command, its times say nothing.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCENES = "usd_scenes/one_mirror.usda", "usd_scenes/kitchen.usda"
SIZES = "640x480", "1280x720", "1920x1080"  # of the aims that the frames are held to
ROUNDS = "7"
LIMIT, TOTAL = 600.0, 1500.0  # seconds: of one benchmark and of all
FAILED_LINES = 5  # of what a failing benchmark said last


def number(name: str, digits: int = 1, scale: float = 1.0, unit: str = "") -> Callable[[dict, list[dict]], str]:
    """A column of one of a row's numbers; empty where it has none."""

    def cell(row: dict, _: list[dict]) -> str:
        value = row.get(name)
        return "" if value is None else f"{scale * value:.{digits}f}{unit}"

    return cell


def word(*names: str) -> Callable[[dict, list[dict]], str]:
    return lambda row, _: ", ".join(str(row[name]) for name in names if row.get(name) not in (None, ""))


def size(row: dict, _: list[dict]) -> str:
    return "x".join(map(str, row["size"]))


def against(contender: str, name: str) -> Callable[[dict, list[dict]], str]:
    """A column of how many times as long another contender of the same picture takes."""

    def cell(row: dict, rows: list[dict]) -> str:
        for other in rows:
            same = all(other.get(key) == row.get(key) for key in ("stage", "size"))
            if same and other["contender"] == contender and other.get(name) and row.get(name):
                return f"{other[name] / row[name]:.2f}x"
        return ""

    return cell


def ratio(above: str, below: str) -> Callable[[dict, list[dict]], str]:
    return lambda row, _: f"{row[above] / row[below]:.2f}x" if row.get(above) and row.get(below) else ""


def rate(row: dict, _: list[dict]) -> str:
    return f"{row['elements'] / row['vector_ms'] / 1000.0:.1f}" if row["elements"] else ""


@dataclass(frozen=True)
class Figure:
    """A table and the benchmark that fills it.

    Attributes:
        title: What it shows.
        tool: File under tools/.
        asked: Its arguments.
        small: The same of a trial.
        columns: Heading to cell of (row, all rows), for a tool that prints rows of JSON; None: it prints lines for a reader.
    """

    title: str
    tool: str
    asked: tuple[str, ...] = ()
    small: tuple[str, ...] = ()
    columns: dict[str, Callable[[dict, list[dict]], str]] | None = None


FINISHES = {
    "scene": word("scene", "size"),
    "contender": word("contender", "technique"),
    "frame ms": number("ms"),
    "mean error": number("mean_error", 4),
    "FLIP": number("flip", 4),
}
FIGURES = {
    "frames": Figure(
        "Whole frames beside rays: CPU time of one thread",
        "bench_frames.py",
        (*SCENES, "--size", *SIZES, "--frames", ROUNDS, "--cpu"),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--frames", "1", "--cpu"),
        {
            "scene": word("stage"),
            "size": size,
            "contender": word("contender", "technique"),
            "reflection ms": number("reflect_ms"),
            "against BVH": against("reference", "reflect_ms"),
            "frame ms": number("frame_ms"),
            "against Embree": against("embreex", "frame_ms"),
            "identical": number("identical", 3, 100.0, " %"),
        },
    ),
    "kernels": Figure(
        "Plain beside vector kernels: CPU time of one thread",
        "bench_kernels.py",
        (SCENES[0], "--size", SIZES[1], "--rounds", ROUNDS, "--method", "reflector_map"),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--rounds", "1"),
        {
            "loop": word("loop"),
            "plain ms": number("plain_ms", 2),
            "vector ms": number("vector_ms", 2),
            "faster": ratio("plain_ms", "vector_ms"),
            "million elements/s": rate,
        },
    ),
    "roofline": Figure(
        "Each kernel of a frame beside the machine's peaks: one thread",
        "bench_roofline.py",
        (*SCENES, "--size", SIZES[1], "--rounds", ROUNDS),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--rounds", "1", "--steps", "1000"),
        {
            "scene": word("stage"),
            "kernel": word("kernel"),
            "ms": number("ms", 2),
            "flops an element": number("flops", 0),
            "bytes": number("bytes", 0),
            "instructions": number("instructions", 0),
            "Gflop/s": number("gflops"),
            "of peak": number("of_flops", 0, 100.0, " %"),
            "GB/s": number("gbytes"),
            "of first cache": number("of_near", 0, 100.0, " %"),
            "arrays, of memory": number("of_far", 0, 100.0, " %"),
            "instructions a cycle": number("ipc", 2),
            "bound": word("bound"),
        },
    ),
    "slopes": Figure(
        "How reflections' time grows: exponents of fitted powers",
        "bench_frames.py",
        (SCENES[1], "--size", SIZES[0], "--frames", "3", "--slopes", "--method", "reflector_map"),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--frames", "1", "--slopes"),
        {
            "scene": word("stage"),
            "contender": word("contender", "technique"),
            "grows with": word("quantity"),
            "exponent": number("slope", 2),
            "at": lambda row, _: ", ".join(f"{amount:,.0f}" for amount in row["amounts"]),
            "reflection ms": lambda row, _: ", ".join(f"{ms:.1f}" for ms in row["reflect_ms"]),
        },
    ),
    "peers": Figure(
        "Other renderers",
        "peers.py",
        (*SCENES, "--size", SIZES[1], "--threads", "2", "--rounds", "3", "--converged", "16"),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--rounds", "1"),
        {
            "scene": word("stage"),
            "size": size,
            "contender": word("contender"),
            "shadows": word("shadows"),
            "reflection ms": number("reflect_ms"),
            "frame ms": number("frame_ms"),
            "identical": number("identical", 3, 100.0, " %"),
            "PSNR dB": number("psnr_db"),
            "against": word("against"),
        },
    ),
    "shadows": Figure(
        "Shadow rays beside Embree's",
        "bench_shadows.py",
        ("usd_scenes/kitchen.usda", "--size", "640x360", "--threads", "1"),
        ("usd_scenes/sphere_on_checker.usda", "--size", "96x54", "--rounds", "1"),
    ),
    "heightfield": Figure(
        "Rays through a heightfield", "bench_heightfield.py", (), ("--cells", "64", "--rays", "2000")
    ),
    "registers": Figure(
        "CUDA kernels: registers / bytes of stack a thread / occupancy",
        "cubin_registers.py",
        (),
        ("warp_reflect.vector", "--arch", "90"),
        {
            "kernel": word("kernel"),
            "arrays": number("arrays", 0),
            **{f"sm_{arch}": word(f"sm_{arch}") for arch in (75, 80, 86, 89, 90, 100, 120)},
        },
    ),
    "finishes": Figure(
        "Rough mirrors and clear coats beside their reference",
        "bench_finishes.py",
        ("--size", "320x180", "--frames", "3"),
        ("--size", "48x27", "--frames", "1"),
        {**FINISHES, "faster": number("faster", 1, 1.0, "x")},
    ),
    "water": Figure(
        "Water and panes beside their references",
        "bench_water.py",
        ("--size", "640x360", "--frames", ROUNDS),
        ("--size", "64x36", "--frames", "1"),
        {**FINISHES, "against the first": number("ratio", 2, 1.0, "x")},
    ),
    "environment": Figure(
        "Local maps of moving mirrors beside maps drawn anew",
        "bench_environment.py",
        ("usd_scenes/city_block.usda", "--mirrors", "3"),
        ("usd_scenes/city_block.usda", "--mirrors", "1", "--resolution", "32", "--rounds", "1", "--time", "12"),
        {
            "mirror": lambda row, _: row.get("mirror", "median"),
            "time": number("time", 0),
            "local ms": number("local_ms"),
            "drawn ms": number("drawn_ms"),
            "faster": ratio("drawn_ms", "local_ms"),
            "angle, median": number("angle_deg", 3, 1.0, " deg"),
            "95 %": number("angle_95_deg", 2, 1.0, " deg"),
            "FLIP": number("flip", 3),
        },
    ),
    "planning": Figure(
        "Planning",
        "bench_planning.py",
        (),
        ("--prims", "20", "--mirrors", "2", "--size", "64x36", "--frames", "1"),
    ),
}


class Failed(Exception):
    """A benchmark gave no table; the text says why."""


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"some of {', '.join(FIGURES)}")
    parser.add_argument("--small", "--quick", action="store_true", help="smallest pictures, one round")
    parser.add_argument("--limit", type=float, default=LIMIT, metavar="SECONDS", help="of one benchmark")
    parser.add_argument("--total", type=float, default=TOTAL, metavar="SECONDS", help="of all")
    arguments = parser.parse_args(words)
    names = arguments.only or list(FIGURES)
    unknown = [name for name in names if name not in FIGURES]
    if unknown:
        parser.error(f"argument --only: got {', '.join(unknown)}, expected some of {', '.join(FIGURES)}")
    for name in ("limit", "total"):
        if not getattr(arguments, name) > 0.0:
            parser.error(f"argument --{name}: got {getattr(arguments, name):g}, expected more than 0 seconds")
    print(f"{told(machine())}\n", flush=True)
    failed = []
    end = time.monotonic() + arguments.total
    for name in dict.fromkeys(names):
        figure = FIGURES[name]
        asked = figure.small if arguments.small else figure.asked
        print(f"### {figure.title}\n\n`{' '.join(('tools/' + figure.tool, *asked))}`\n", flush=True)
        start = time.monotonic()
        try:
            if start >= end:
                raise Failed(f"no time was left of {arguments.total:g} s (--total)")
            text = made(figure, asked, min(arguments.limit, end - start))
        except Failed as error:
            failed.append(name)
            text = f"**{name} failed**: {error}"
        print(f"{text}\n\n({time.monotonic() - start:.0f} s)\n", flush=True)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def made(figure: Figure, asked: Iterable[str], limit: float) -> str:
    """The table of a figure, from a process of its own.

    Raises:
        Failed: It ended with another code than 0, took longer than `limit` seconds, or printed no row.
    """
    tool = ROOT / "tools" / figure.tool
    if not tool.is_file():
        raise Failed(f"there is no tools/{figure.tool}")
    command = [sys.executable, str(tool), *asked, *(["--json"] if figure.columns else [])]
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=limit, check=False)
    except subprocess.TimeoutExpired:
        raise Failed(f"tools/{figure.tool} took longer than {limit:.4g} s (--limit, --total)") from None
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()][-FAILED_LINES:]
        raise Failed(f"tools/{figure.tool} ended with {done.returncode}\n\n```\n" + "\n".join(said) + "\n```")
    if figure.columns is None:
        return f"```\n{done.stdout.strip()}\n```"
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    if not rows:
        raise Failed(f"tools/{figure.tool} printed no row")
    return table(rows, figure.columns)


def table(rows: list[dict], columns: dict[str, Callable[[dict, list[dict]], str]]) -> str:
    """Rows as Markdown; columns that are empty in all of them are left out, those of numbers stand to the right."""
    cells = {heading: [cell(row, rows) for row in rows] for heading, cell in columns.items()}
    cells = {heading: column for heading, column in cells.items() if any(column)}
    sides = ["---:" if all(not each or each[0].isdigit() for each in column) else "---" for column in cells.values()]
    lines = [list(cells), *zip(*cells.values(), strict=True)]
    lines = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([lines[0], f"|{'|'.join(sides)}|", *lines[1:]])


def machine() -> dict:
    from warp_reflect import sweep
    from warp_reflect.devices import open_device

    open_device("cpu")  # quietly
    return sweep.machine()


def told(known: dict) -> str:
    """The machine, the versions and how busy it was, in one line."""
    versions = ", ".join(f"{name} {version}" for name, version in known["versions"].items())
    load = "" if known["load"] is None else f", load {known['load']:.1f}"
    return f"{known['processor']}, {known['cores']} cores{load}; {known['system']}; {versions}; {known['commit']}"


if __name__ == "__main__":
    raise SystemExit(main())
