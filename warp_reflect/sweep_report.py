"""A sweep on paper: results.json, results.csv, pareto.png, contact.png and a page that holds them all."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_reflect.sweep import REFERENCE, Row, Sweep, pareto

# Not in the table: too long for a cell, or a picture.
NESTED = ("settings", "statistics", "steps_ms", "picture", "error_map")
SHOWN_MAX = 20  # pictures of the contact sheet
ERROR_SHOWN_PX = 2.0  # at which the error map's colour ends
COLOURS = {
    "raytraced": "#333333",
    "planar": "#8c564b",
    "quadric": "#1f77b4",
    "reflector_map": "#2ca02c",
    "explosion_map": "#d62728",
    "environment": "#9467bd",
    "layered_environment": "#e377c2",
}
OTHER_COLOUR = "#888888"  # several techniques in one picture
# Heading, format and meaning of the page's columns.
COLUMNS = (
    ("name", "", "contender"),
    ("reflect_ms", ".1f", "reflect ms"),
    ("reflect_p95_ms", ".1f", "p95"),
    ("predicted_ms", ".1f", "predicted"),
    ("predicted_px", ".2f", "predicted px"),
    ("frame_ms", ".1f", "frame ms"),
    ("frame_cpu_ms", ".1f", "frame CPU ms"),
    ("first_ms", ".0f", "first frame"),
    ("prepare_ms", ".0f", "prepare"),
    ("compile_ms", ".0f", "compile"),
    ("prepared_bytes", ",d", "bytes"),
    ("identical_share", ".4%", "identical"),
    ("off_share", ".4%", "off > 0.5 px"),
    ("wrong_share", ".4%", "wrong"),
    ("error_median_px", ".3g", "px median"),
    ("error_p95_px", ".3g", "px 95 %"),
    ("error_max_px", ".3g", "px max"),
    ("angle_p95_deg", ".2g", "degrees 95 %"),
    ("psnr_db", ".1f", "PSNR dB"),
    ("flip", ".4f", "FLIP"),
    ("bvh_share", ".1%", "traced"),
    ("dominated_by", "", "beaten by"),
)


@dataclass(frozen=True)
class Written:
    """Files of a sweep, and what could not be made."""

    files: list[Path]
    notes: list[str]


def open_folder(folder: Path | str) -> Path:
    """Make a folder where it is missing; refuse, before any work is done, one that cannot be written into.

    Raises:
        OSError: it cannot.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise OSError(f"{folder}: cannot be written into: {error.strerror}") from None


def write_sweep(sweep: Sweep, folder: Path | str) -> Written:
    """Write a sweep into a folder, which is made where it is missing.

    Raises:
        OSError: the folder or a file cannot be written.
    """
    folder = open_folder(folder)
    notes: list[str] = []
    pictures: dict[str, bytes] = {}
    if sweep.rows:
        try:
            import matplotlib  # noqa: F401

            pictures = {"pareto.png": pareto_png(sweep), "contact.png": contact_png(sweep)}
        except ImportError:
            notes.append("matplotlib is not installed (extra 'plot'): no pareto.png and contact.png")
    contents = {
        "results.json": json.dumps(sweep.to_json(), indent=2, allow_nan=False).encode(),
        "results.csv": table_csv(sweep).encode(),
        **pictures,
        "report.html": page(sweep, pictures, notes).encode(),
    }
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    return Written([folder / name for name in contents], notes)


def table_csv(sweep: Sweep) -> str:
    """A line per row; the settings as name=value."""
    names = [name for name in Row.__dataclass_fields__ if name not in NESTED]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*names, "settings"])
    for row in sweep.rows:
        settings = " ".join(f"{name}={value}" for name, value in row.settings.items())
        writer.writerow([*("" if (value := getattr(row, name)) is None else value for name in names), settings])
    return out.getvalue()


def label(row: Row) -> str:
    """A row's name without what goes without saying."""
    return (
        row.name.replace("reflector_map ", "map ").replace("explosion_map ", "explosion ").replace(" refine=exact", "")
    )


def shown_rows(sweep: Sweep) -> list[Row]:
    """The rows that the contact sheet shows: the reference, those on the frontier, and the papers' settings."""
    front = {row.name for row in frontier(sweep, off_share)}
    named = [row for row in sweep.rows if row.name == REFERENCE]
    named += [row for row in sweep.rows if row.name != REFERENCE and (row.name in front or row.source)]
    return named[:SHOWN_MAX]


def off_share(row: Row) -> float:
    """The error that decides what is on the frontier."""
    return row.off_share


def frontier(sweep: Sweep, error: Callable[[Row], float | None]) -> list[Row]:
    """Of the rows without the reference, those that no faster one equals."""
    return pareto(
        [row for row in sweep.rows if row.name != REFERENCE and error(row) is not None],
        lambda row: row.reflect_ms,
        error,
    )


def pareto_png(sweep: Sweep) -> bytes:
    """Error against time of every row, both logarithmic, the frontier marked; needs matplotlib."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17.0, 9.5), layout="constrained")
    least_share = 0.5 / max(sweep.interior_pixels, 1)
    panels = (
        (off_share, "mirror pixels off by more than half a pixel, or showing another thing [share]", least_share),
        (lambda row: row.error_mean_px, "mean displacement of what is shown [pixels]", 1.0e-6),
    )
    for axes, (error, title, least) in zip(figure.subplots(1, 2), panels, strict=True):
        _draw_panel(axes, sweep, error, title, least)
    handles, names = axes.get_legend_handles_labels()
    figure.legend(handles, names, fontsize=8, loc="outside lower center", ncols=6)
    machine = sweep.machine
    figure.suptitle(
        f"{Path(sweep.stage).name}, {sweep.size[0]}x{sweep.size[1]}, {sweep.triangles:,} triangles, "
        f"{sweep.mirror_pixels:,} mirror pixels; {machine['processor']}, {machine['device']}, {sweep.threads} thread(s); "
        f"medians of {sweep.rounds}; commit {machine['commit'] or '-'}"
    )
    return _png(figure)


def _draw_panel(axes, sweep: Sweep, error: Callable[[Row], float | None], title: str, least: float) -> None:
    rows = [row for row in sweep.rows if row.name != REFERENCE and error(row) is not None]
    positive = [error(row) for row in rows if error(row) > 0.0]
    # What has no error stands on a line of its own below all others.
    least = min([least, *(0.5 * each for each in positive)])
    seen = set()
    for row in rows:
        group = row.technique if row.technique in COLOURS else "several"
        axes.plot(
            row.reflect_ms,
            max(error(row), least),
            marker={"off": "o"}.get(row.settings.get("refine", "exact"), "D"),
            markersize=9 if row.source else 6,
            color=COLOURS.get(group, OTHER_COLOUR),
            markerfacecolor="none" if row.warm else COLOURS.get(group, OTHER_COLOUR),
            markeredgecolor="black" if row.source else COLOURS.get(group, OTHER_COLOUR),
            linestyle="none",
            label=None if group in seen else group,
            zorder=3 if row.source else 2,
        )
        seen.add(group)
    front = frontier(sweep, error)
    axes.step(
        [row.reflect_ms for row in front],
        [max(error(row), least) for row in front],
        where="post",
        color="black",
        linewidth=1.0,
        alpha=0.6,
        label="frontier",
    )
    for name, time in (
        ("BVH reference", sweep.row(REFERENCE).reflect_ms),
        ("Embree, hits alone, 1 thread", sweep.embree_ms),
    ):
        if time is not None:
            axes.axvline(time, color="#333333", linestyle="--" if name[0] == "B" else ":", linewidth=1.2, label=name)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axhline(least, color="#aaaaaa", linewidth=0.8)
    axes.text(0.005, least, " no error", transform=axes.get_yaxis_transform(), va="bottom", fontsize=8, color="#666666")
    axes.set_ylim(bottom=0.6 * least)
    axes.set_xlabel("reflections of a frame [ms]")
    axes.set_title(title, fontsize=10)
    axes.grid(True, which="both", alpha=0.2)
    axes.plot([], [], "D", color="#666666", label="diamond: refined")
    axes.plot([], [], "o", color="#666666", label="circle: not refined")
    axes.plot([], [], "o", color="#666666", markerfacecolor="none", label="hollow: from the frame before")
    axes.plot(
        [], [], "o", color="#666666", markeredgecolor="black", markersize=9, label="black rim: a paper's settings"
    )
    named = {row.name: row for row in [*front, *(row for row in rows if row.source)]}
    _write_names(axes, [(label(row), row.reflect_ms, max(error(row), least)) for row in named.values()])


def _write_names(axes, places: list[tuple[str, float, float]]) -> None:
    """Names in a column at the right of the panel, each with a thin line to its point, so that none covers another."""
    right = max(time for _, time, _ in places)
    left, end = axes.get_xlim()
    axes.set_xlim(left, max(end, right) * (max(end, right) / left) ** 0.75)
    low, high = np.log10(axes.get_ylim())
    ordered = sorted(places, key=lambda place: place[2])
    wanted = (np.log10([place[2] for place in ordered]) - low) / (high - low)
    step = min(0.034, 0.94 / len(ordered))
    heights = _spread(wanted, step)
    for (name, time, value), height in zip(ordered, heights, strict=True):
        axes.annotate(
            name,
            xy=(time, value),
            xytext=(0.67, height),
            textcoords=axes.transAxes,
            fontsize=8,
            va="center",
            arrowprops={"arrowstyle": "-", "color": "#999999", "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2},
        )


def _spread(wanted: np.ndarray, step: float) -> np.ndarray:
    """Ascending places near the ones wanted, at least a step apart, within [0.03, 0.98]."""
    places = np.clip(wanted, 0.03, 0.98)
    for k in range(1, len(places)):
        places[k] = max(places[k], places[k - 1] + step)
    places[-1] = min(places[-1], 0.98)
    for k in range(len(places) - 2, -1, -1):
        places[k] = min(places[k], places[k + 1] - step)
    return places


def contact_png(sweep: Sweep) -> bytes:
    """The mirrors as shown by chosen rows, each above the map of its errors; needs matplotlib."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    rows = shown_rows(sweep)
    columns = min(4, len(rows))
    bands = -(-len(rows) // columns)
    height, width = rows[0].picture.shape[:2]
    side = 4.2
    tall = side * height / width
    figure = Figure(figsize=(columns * side, bands * (2.0 * tall + 0.8) + 0.8), layout="constrained")
    axes = np.atleast_2d(figure.subplots(2 * bands, columns, squeeze=False))
    for each in axes.flat:
        each.set_axis_off()
    colours = colormaps["viridis"].with_extremes(bad="#ffffff", over="#ff2020")
    for k, row in enumerate(rows):
        above, below = axes[2 * (k // columns), k % columns], axes[2 * (k // columns) + 1, k % columns]
        above.imshow(row.picture, interpolation="nearest")
        above.set_title(f"{label(row)}\n{row.reflect_ms:.1f} ms, off {row.off_share:.2%}", fontsize=9)
        below.imshow(_capped(row.error_map), cmap=colours, vmin=0.0, vmax=ERROR_SHOWN_PX, interpolation="nearest")
    scale = ScalarMappable(Normalize(0.0, ERROR_SHOWN_PX), colours)
    bar = figure.colorbar(
        scale, ax=axes.ravel().tolist(), orientation="horizontal", fraction=0.02, pad=0.01, extend="max"
    )
    bar.set_label(
        f"displacement [pixels]; red: more than {ERROR_SHOWN_PX:g}, or another thing is shown; white: no mirror, or its border"
    )
    return _png(figure)


def _capped(error: np.ndarray) -> np.ndarray:
    """An error map with what is infinite made finite, so that it is drawn as over the end of the scale."""
    return np.where(np.isinf(error), 10.0 * ERROR_SHOWN_PX, error)


def _png(figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", dpi=110)
    return out.getvalue()


STYLE = """
body { font: 14px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 1500px; padding: 0 1em; color: #222; }
table { border-collapse: collapse; font-size: 12px; }
th, td { padding: 2px 7px; text-align: right; white-space: nowrap; border-bottom: 1px solid #e4e4e4; }
th { position: sticky; top: 0; background: #fff; }
th:first-child, td:first-child, td:last-child, th:last-child { text-align: left; }
tr.paper td:first-child { font-weight: 600; }
tr.front { background: #eaf5ea; }
.wide { overflow-x: auto; }
img { max-width: 100%; height: auto; }
"""


def page(sweep: Sweep, pictures: dict[str, bytes], notes: list[str] | None = None) -> str:
    """One HTML page with everything in it; loads nothing.

    Args:
        pictures: Name to PNG.
        notes: Beside the sweep's own.
    """
    text = html.escape
    machine = sweep.machine
    versions = ", ".join(f"{name} {version}" for name, version in machine["versions"].items())
    load = "unknown" if machine["load"] is None else f"{machine['load']:.1f}"
    facts = [
        f"camera {sweep.camera}, {sweep.size[0]}x{sweep.size[1]}, {sweep.triangles:,} triangles, {sweep.vertices:,} vertices, "
        f"{sweep.mirror_pixels:,} mirror pixels ({sweep.interior_pixels:,} of them not at a mirror's border)",
        f"{machine['processor']}, {machine['cores']} cores (load at the start: {load}), {machine['device']} "
        f"({machine['device_name']}), {sweep.threads} thread(s), medians of {sweep.rounds} rounds",
        f"{versions}; {machine['system']}; commit {machine['commit'] or 'unknown'}",
    ]
    if sweep.embree_ms is not None:
        facts.append(
            f"Embree, the mirror rays given, hits alone, one thread: {sweep.embree_ms:.1f} ms; "
            f"{sweep.embree_identical:.3%} of them meet the reference's triangle"
        )
    front = {row.name for row in frontier(sweep, off_share)}
    head = "".join(f"<th>{text(title)}</th>" for _, _, title in COLUMNS)
    body = "\n".join(
        f'<tr class="{"paper " * bool(row.source)}{"front" * (row.name in front)}">'
        + "".join(f"<td>{text(_cell(getattr(row, name), style))}</td>" for name, style, _ in COLUMNS)
        + "</tr>"
        for row in sweep.rows
    )
    said = [*sweep.notes, *(f"failed: {each}" for each in sweep.failed), *(notes or [])]
    images = "\n".join(
        f'<p><img alt="{text(name)}" src="data:image/png;base64,{base64.b64encode(data).decode()}"></p>'
        for name, data in pictures.items()
    )
    table = f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{text(Path(sweep.stage).name)}: accuracy against time</title>
<style>{STYLE}</style></head><body>
<h1>{text(Path(sweep.stage).name)}: accuracy against time</h1>
<ul>{"".join(f"<li>{text(each)}</li>" for each in facts)}</ul>
{images}
{table if sweep.rows else "<p>No mirror is seen: no rows.</p>"}
<p>Green: no faster row is off at fewer pixels. Bold: a paper's settings. Times are wall clock of one process in which all
take turns; first frame includes preparation, compile is what loading kernels added to it. Errors are against the traced
reference of the same camera; shares are of the mirror pixels that are not at a border; an empty PSNR: equal pictures.</p>
<ul>{"".join(f"<li>{text(each)}</li>" for each in said)}</ul>
</body></html>
"""


def _cell(value, style: str) -> str:
    if value is None:
        return ""
    return format(value, style) if style else str(value)
