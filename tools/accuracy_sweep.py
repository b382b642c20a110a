"""The papers' tables again: their settings on this package's versions of their scenes, time and error, as Markdown.

    python tools/accuracy_sweep.py --size 960x540 --rounds 7
    python tools/accuracy_sweep.py --paper lages-miguel-2014

Estalella et al. 2005 (figures 7 and 8): grid densities and iteration counts, on `usd_scenes/kitchen.usda`. Lages Miguel et
al. 2014 (figures 4 to 6, section 5): a toy room and an ancient hall, every vertex or some kept from the frame before. Their
machines are twenty years and ten years old and their scenes are not to be had: their frames a second stand beside ours as
they are printed, and what may be compared are the ratios between rows. Errors are ours alone; the papers give pictures.
Every technique and setting on one stage: `warp-reflect sweep`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import warp_reflect as wr
from warp_reflect import sweep
from warp_reflect.devices import open_device

SCENES = Path(__file__).resolve().parents[1] / "usd_scenes"
# Section 7, frames a second of the whole picture by share of vertices searched.
ESTALELLA_GRID_FPS = {0.041: 16.3, 0.055: 13.6, 0.096: 10.1, 0.143: 8.3}
ESTALELLA_ALL_FPS = 1.3
# Figures 4, 5 and 6: (what, vertices, frames a second, whether some are kept from the frame before).
LAGES_MIGUEL_FPS = {
    "toy_room": (("figure 4, a room with toys", 7400, 61, True), ("figure 6, a room with toys", 10000, 49, True)),
    "corridor": (("figure 4, an ancient environment", 7500, 200, False), ("figure 5, the same", 1200, 203, False)),
}
LAGES_MIGUEL_TRACED_S = 12.0  # figure 5's reference, by a rendering engine
REUSES_PX = (0.25, 0.5, 1.0)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--paper", choices=sorted(PAPERS), action="append", help="one of them; default all")
    parser.add_argument("--size", default="960x540", help="WxH")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=1)
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    open_device("cpu")  # quietly
    size = tuple(int(side) for side in arguments.size.split("x"))
    for paper in arguments.paper or PAPERS:
        print("\n".join(PAPERS[paper](size, arguments.rounds, arguments.threads)), flush=True)


def measured(name: str, size: tuple[int, int], contenders: list, rounds: int) -> sweep.Sweep:
    """A sweep over a scene of `usd_scenes`, told of on standard error."""

    def tell(text: str) -> None:
        print(f"{name}: {text}", file=sys.stderr)

    scene = wr.load_stage(SCENES / f"{name}.usda")
    return sweep.run_sweep(
        scene, None, size, contenders, rounds, lambda text: print(f"{name}: {text}", file=sys.stderr)
    )


def estalella(size: tuple[int, int], rounds: int, threads: int) -> list[str]:
    """Lines of their two tables."""
    base = wr.Settings(threads=threads)
    theirs = [each for each in sweep.paper_contenders(base) if each.source == sweep.ESTALELLA]
    ours = [
        sweep.Contender(f"ours {share}", "reflector_map", base.replace(grid_share=share))
        for share in ESTALELLA_GRID_FPS
    ]
    ours += [
        sweep.Contender(f"newton {count}", "reflector_map", base.replace(iterations=count, refine="off", edge_px=0.0))
        for count in sweep.NEWTON_ITERATIONS
    ]
    ours.append(sweep.Contender("ours", "reflector_map", base))
    result = measured("kitchen", size, [*theirs, *ours], rounds)
    every = result.row(f"{sweep.ESTALELLA} {max(sweep.MIDPOINT_ITERATIONS)} iterations")
    lines = [
        *heading(result, "Estalella et al. 2005, figure 7: interpolation grids"),
        "| vertices searched | paper, frames/s | paper, speed-up | same settings here, frame ms | speed-up | off > 0.5 px | "
        "median px | 95 % px | FLIP | grid of directions, refined: frame ms | off > 0.5 px |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for share, fps in ESTALELLA_GRID_FPS.items():
        row, other = result.row(f"{sweep.ESTALELLA} grid {100 * share:g} %"), result.row(f"ours {share}")
        lines.append(
            f"| {share:.1%} | {fps} | {fps / ESTALELLA_ALL_FPS:.1f} | {row.frame_ms:.1f} | "
            f"{every.frame_ms / row.frame_ms:.2f} | {errors(row)} | {other.frame_ms:.1f} | {other.off_share:.4%} |"
        )
    own = result.row("ours")
    lines += [
        f"| all | {ESTALELLA_ALL_FPS} | 1 | {every.frame_ms:.1f} | 1 | {errors(every)} | {own.frame_ms:.1f} | "
        f"{own.off_share:.4%} |",
        "",
        *heading(result, "Estalella et al. 2005, figure 8: iterations of the search, every vertex"),
        "| search | iterations | paper | frame ms | search ms | off > 0.5 px | median px | 95 % px | FLIP |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for count in sweep.MIDPOINT_ITERATIONS:
        said = "a picture" if count < max(sweep.MIDPOINT_ITERATIONS) else "more: no noticeable improvement"
        lines.append(iteration_line("midpoint", count, said, result.row(f"{sweep.ESTALELLA} {count} iterations")))
    lines += [iteration_line("Newton", count, "", result.row(f"newton {count}")) for count in sweep.NEWTON_ITERATIONS]
    return [*lines, ""]


def iteration_line(search: str, count: int, said: str, row: sweep.Row) -> str:
    spent = row.steps_ms.get("reflect/search", 0.0)
    return f"| {search} | {count} | {said} | {row.frame_ms:.1f} | {spent:.1f} | {errors(row)} |"


def lages_miguel(size: tuple[int, int], rounds: int, threads: int) -> list[str]:
    """Lines of a table per scene."""
    base = wr.Settings(threads=threads)
    paper = next(each for each in sweep.paper_contenders(base) if each.name == sweep.LAGES_MIGUEL)
    contenders = [paper, sweep.Contender("ours", "quadric", base), sweep.Contender("ours warm", "quadric", base, True)]
    for reuse in REUSES_PX:
        kept = paper.settings.replace(reuse_px=reuse)
        contenders.append(sweep.Contender(f"reuse {reuse}", "quadric", kept, True))
    lines = []
    for name, figures in LAGES_MIGUEL_FPS.items():
        result = measured(name, size, contenders, rounds)
        reference, every = result.row(sweep.REFERENCE), result.row(sweep.LAGES_MIGUEL)
        lines += [
            *heading(result, f"Lages Miguel et al. 2014: {name}"),
            "| | virtual vertices | solved a frame | frames/s | vertices/s | frame ms | x every vertex | x traced | "
            "off > 0.5 px | median px | 95 % px | FLIP |",
            "|---|---|---|---|---|---|---|---|---|---|---|---|",
        ]
        for what, count, fps, kept in figures:
            traced = f"{LAGES_MIGUEL_TRACED_S * fps:,.0f}" if "5" in what else ""
            solved = "25 %" if kept else "all"
            lines.append(
                f"| paper, {what} | {count:,} | {solved} | {fps} | {count * fps:,} | {1000 / fps:.1f} | | {traced} | | | | |"
            )
        rows = [("every vertex", every)] + [
            (f"kept within {each} px", result.row(f"reuse {each}")) for each in REUSES_PX
        ]
        rows += [
            ("this package, refined", result.row("ours")),
            ("refined, from the frame before", result.row("ours warm")),
        ]
        for what, row in [*rows, ("traced", reference)]:
            count = int(row.statistics.get("vertices", 0))
            lines.append(
                f"| here, {what} | {count:,} | {1.0 - row.reused_share:.0%} | {1000 / row.frame_ms:.1f} | "
                f"{1000 * count / row.frame_ms:,.0f} | {row.frame_ms:.1f} | {every.frame_ms / row.frame_ms:.2f} | "
                f"{reference.frame_ms / row.frame_ms:.2f} | {errors(row)} |"
            )
        lines.append("")
    return lines


def errors(row: sweep.Row) -> str:
    """Cells of a row's errors."""
    cells = ((row.error_median_px, ".3g"), (row.error_p95_px, ".3g"), (row.flip, ".4f"))
    shown = ["" if value is None else format(value, style) for value, style in cells]
    return " | ".join([f"{row.off_share:.3%}", *shown])


def heading(result: sweep.Sweep, title: str) -> list[str]:
    """Title and what the figures of this machine hang on."""
    known = result.machine
    width, height = result.size
    return [
        f"### {title}",
        f"{Path(result.stage).name}, {width}x{height}, {result.vertices:,} vertices, {result.mirror_pixels:,} mirror pixels; "
        f"{known['processor']}, {result.threads} thread(s); medians of {result.rounds}; "
        f"Warp {known['versions'].get('warp-lang', '?')}; commit {known['commit'] or '-'}",
        "",
    ]


PAPERS = {"estalella-2005": estalella, "lages-miguel-2014": lages_miguel}


if __name__ == "__main__":
    main()
