"""The flat parts of the inspector as pictures: frames with their titles, knobs, numbers. Drawn without OpenGL."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from warp_reflect.planner import PlanLine
from warp_reflect.sweep import REFERENCE
from warp_reflect.viewer.session import CLASS_COLORS, CONTROLS, ERROR_SHOWN_PX, PixelClass, Session, heat_colors
from warp_reflect.viewer.tradeoff import Mark, Tradeoff

BACK, RAISED, INK, DIM, ACCENT, WARN, ON = (
    (24, 26, 30),
    (48, 52, 60),
    (232, 234, 238),
    (150, 156, 168),
    (255, 176, 58),
    (255, 112, 96),
    (140, 205, 140),
)
TITLE_HEIGHT = 28  # pixels, as all below
MARGIN = 8
LINE_HEIGHT = 17
ROW_HEIGHT, ROW_HEIGHT_MIN = 32, 14
FOOT_LINES = 7  # of text under the knobs
KNOBS_MIN = 9  # shown at once, however small the pane
TEXT_SIZE, TITLE_SIZE, MONO_SIZE = 14, 14, 12
KNOB_RADIUS = 7
PANE_MIN = 64  # a pane smaller than this is drawn at this size and shown smaller
PLOT_LEFT = 54  # pixels for the labels of the axis
MS_LEAST = 0.01  # of a plotted time
PLOT_COLORS = {
    "raytraced": (200, 200, 205),
    "planar": (190, 130, 110),
    "quadric": (88, 160, 220),
    "reflector_map": (90, 190, 90),
    "explosion_map": (225, 80, 70),
    "environment": (170, 130, 210),
    "layered_environment": (235, 140, 205),
}
TRACK = (0.36, 0.70)  # of the pane's width, where a knob's track begins and ends
KEYS = (
    "drag: orbit   shift-drag: pan   wheel: zoom, or more settings   click: pick",
    "g: regions   v: virtual objects   i: interpolation grid   b: bisector field   c: forget picks",
    "m: reference and local maps   h: heightfield   p: plan   t: accuracy against time",
    "s: sweep this view   : name=value sets any setting   q: quit",
)


@dataclass(frozen=True)
class Box:
    """A rectangle of a pane, pixels from its top left."""

    x: int
    y: int
    width: int
    height: int

    def share_of(self, x: float, y: float) -> tuple[float, float]:
        """A place as shares of the rectangle."""
        return (x - self.x) / max(self.width, 1), (y - self.y) / max(self.height, 1)


@dataclass(frozen=True)
class Knob:
    """A slider on screen: `name` is a control's, "camera" or "time"; `track` where its knob slides."""

    name: str
    values: tuple
    track: Box


@cache
def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(font_file(name), size)


def font_file(name: str) -> str:
    """Where a font lies that comes with matplotlib, itself a part of pyvista's installation."""
    import matplotlib

    return str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{name}.ttf")


def _blank(size: tuple[int, int], title: str) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    image = Image.new("RGB", tuple(max(side, PANE_MIN) for side in size), BACK)
    draw = ImageDraw.Draw(image)
    if title:
        text = _cut(draw, title, _font("DejaVuSans-Bold", TITLE_SIZE), image.width - 2 * MARGIN)
        draw.text((MARGIN, 6), text, INK, _font("DejaVuSans-Bold", TITLE_SIZE))
    return image, draw


def _cut(draw: ImageDraw.ImageDraw, text: str, font, width: float) -> str:
    """A text as far as it fits."""
    if draw.textlength(text, font) <= width:
        return text
    while text and draw.textlength(text + "…", font) > width:
        text = text[:-1]
    return text + "…"


def picture_box(pane: tuple[int, int], picture: tuple[int, int]) -> Box:
    """Where a picture of some aspect lies in a pane, under the title."""
    room = max(pane[0], PANE_MIN) - 2 * MARGIN, max(pane[1], PANE_MIN) - TITLE_HEIGHT - MARGIN
    scale = min(room[0] / picture[0], room[1] / picture[1])
    width, height = (max(1, round(scale * side)) for side in picture)
    return Box(MARGIN + (room[0] - width) // 2, TITLE_HEIGHT + (room[1] - height) // 2, width, height)


def picture_pane(
    size: tuple[int, int],
    title: str,
    picture: np.ndarray | None,
    aspect: tuple[int, int],
    right: np.ndarray | None = None,
    wipe: float = 1.0,
    mark: tuple[int, int] | None = None,
    empty: str = "",
) -> np.ndarray:
    """A picture under its title.

    Args:
        size: (width, height) of the pane.
        title: Of the pane.
        picture: uint8 [h, w, 3]; None: `empty` is said instead.
        aspect: (width, height) that the picture stands for, whatever its resolution.
        right: Shown right of the wipe.
        wipe: Share of the width.
        mark: A pixel of `aspect` to encircle.
        empty: Why there is no picture.
    """
    image, draw = _blank(size, title)
    box = picture_box(size, aspect)
    if picture is None:
        draw.rectangle((box.x, box.y, box.x + box.width - 1, box.y + box.height - 1), fill=(32, 34, 38))
        font = _font("DejaVuSans", TEXT_SIZE)
        draw.text((box.x + box.width / 2, box.y + box.height / 2), empty, DIM, font, anchor="mm")
        return np.asarray(image)
    image.paste(_scaled(picture, box), (box.x, box.y))
    if right is not None:
        column = round(min(max(wipe, 0.0), 1.0) * box.width)
        beyond = _scaled(right, box).crop((column, 0, box.width, box.height))
        image.paste(beyond, (box.x + column, box.y))
        x, y = box.x + column, box.y + box.height // 2
        draw.line((x, box.y, x, box.y + box.height - 1), ACCENT, 2)
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), ACCENT, BACK)
    if mark is not None:
        x = box.x + (mark[0] + 0.5) / aspect[0] * box.width
        y = box.y + (mark[1] + 0.5) / aspect[1] * box.height
        for radius, color in ((7, BACK), (6, ACCENT)):
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=color, width=2)
    return np.asarray(image)


def _scaled(picture: np.ndarray, box: Box) -> Image.Image:
    enlarged = box.width > picture.shape[1]
    how = Image.Resampling.NEAREST if enlarged else Image.Resampling.BOX
    return Image.fromarray(np.ascontiguousarray(picture)).resize((box.width, box.height), how)


def error_pane(size: tuple[int, int], heat: np.ndarray | None, aspect: tuple[int, int], empty: str = "") -> np.ndarray:
    """The heat map with its legend in the title's line."""
    image = Image.fromarray(picture_pane(size, "error in pixels", heat, aspect, empty=empty))
    draw, font = ImageDraw.Draw(image), _font("DejaVuSans", 11)
    words = ("same hit", CLASS_COLORS[PixelClass.IDENTICAL]), ("wrong", CLASS_COLORS[PixelClass.WRONG])
    words += (("unmatched", CLASS_COLORS[PixelClass.UNMATCHED]), ("rim", CLASS_COLORS[PixelClass.BORDER]))
    x = image.width - MARGIN
    bar = heat_colors(np.linspace(0.0, ERROR_SHOWN_PX, 80))
    needed = 80 + 56 + sum(draw.textlength(word, font) + 22 for word, _ in words) + 150
    if needed > image.width:
        words = ()
    x -= round(draw.textlength(f"{ERROR_SHOWN_PX:g}+", font))
    draw.text((x, 8), f"{ERROR_SHOWN_PX:g}+", DIM, font)
    x -= 84
    if x > 140:
        image.paste(Image.fromarray(np.tile(bar, (10, 1, 1))), (x, 10))
        draw.text((x - 11, 8), "0", DIM, font)
    x -= 22
    for word, color in reversed(words):
        x -= round(draw.textlength(word, font))
        draw.text((x, 8), word, DIM, font)
        draw.rectangle((x - 14, 10, x - 5, 19), color)
        x -= 22
    return np.asarray(image)


def knob_rows(session: Session) -> list[tuple[str, tuple]]:
    """(name, positions) of all knobs of a session; camera and time where there is a choice, before the settings."""
    rows: list[tuple[str, tuple]] = [(control.name, control.values) for control in CONTROLS]
    cameras = tuple(each.path for each in session.scene.data.cameras)
    chosen = [("camera", cameras)] if len(cameras) > 1 else []
    if session.times:
        chosen.append(("time", session.times))
    return rows[:1] + chosen + rows[1:]


def knobs_of(session: Session, size: tuple[int, int], first: int = 0) -> list[Knob]:
    """The knobs that there is room for, from the `first` on, and where they lie."""
    rows = knob_rows(session)
    width = max(size[0], PANE_MIN)
    room = max(size[1] - TITLE_HEIGHT - FOOT_LINES * LINE_HEIGHT, ROW_HEIGHT_MIN)
    count = max(min(len(rows), room // ROW_HEIGHT), min(len(rows), KNOBS_MIN))
    height = min(ROW_HEIGHT, max(room // count, ROW_HEIGHT_MIN))
    first = min(max(first, 0), len(rows) - count)
    rows = rows[first : first + count]
    left, right = (round(share * width) for share in TRACK)
    return [
        Knob(name, values, Box(left, TITLE_HEIGHT + k * height, right - left, height))
        for k, (name, values) in enumerate(rows)
    ]


def nearest(values: tuple, value) -> int:
    """The position of a value, or of the nearest number to one that is set between them."""
    if value in values:
        return values.index(value)
    if isinstance(value, str) or value is None:
        return 0
    return int(np.argmin([abs(each - value) for each in values]))


def controls_pane(session: Session, size: tuple[int, int], typed: str | None = None, first: int = 0) -> np.ndarray:
    """Knobs from the `first` on, the message, and what keys and buttons do."""
    knobs, names = knobs_of(session, size, first), [name for name, _ in knob_rows(session)]
    at = names.index(knobs[0].name)
    hidden = len(knobs) < len(names)
    counted = f": {at + 1} to {at + len(knobs)} of {len(names)}, wheel for more" if hidden else ""
    image, draw = _blank(size, "settings" + counted)
    font, bold = _font("DejaVuSans", TEXT_SIZE), _font("DejaVuSans-Bold", TEXT_SIZE)
    labels = {control.name: control for control in CONTROLS}
    for knob in knobs:
        box, control = knob.track, labels.get(knob.name)
        y = box.y + box.height // 2
        value = session.knob_value(knob.name)
        shown = control.shown(value) if control else f"{value:g}" if knob.name == "time" else f"{value}"
        share = nearest(knob.values, value) / max(len(knob.values) - 1, 1)
        x = box.x + share * box.width
        label = _cut(draw, control.label if control else knob.name, font, box.x - KNOB_RADIUS - 2 * MARGIN)
        draw.text((MARGIN, y), label, INK, font, anchor="lm")
        draw.rounded_rectangle((box.x, y - 2, box.x + box.width, y + 2), 2, RAISED)
        draw.rounded_rectangle((box.x, y - 2, max(x, box.x + 1), y + 2), 2, ACCENT)
        draw.ellipse((x - KNOB_RADIUS, y - KNOB_RADIUS, x + KNOB_RADIUS, y + KNOB_RADIUS), INK)
        at = box.x + box.width + 2 * MARGIN
        draw.text((at, y), _cut(draw, shown, bold, image.width - at - MARGIN), ACCENT, bold, anchor="lm")
    y = knobs[-1].track.y + knobs[-1].track.height + 4
    said = f"set: {typed}_" if typed is not None else session.message
    color = WARN if said.startswith("refused") else ACCENT if typed is not None else INK
    foot = image.height - len(KEYS) * LINE_HEIGHT - 4
    for line in _wrapped(draw, said, font, image.width - 2 * MARGIN)[: max((foot - y) // (LINE_HEIGHT + 2), 0)]:
        draw.text((MARGIN, y), line, color, font)
        y += LINE_HEIGHT + 2
    small = _font("DejaVuSans", 12)
    for k, line in enumerate(KEYS):
        text = _cut(draw, line, small, image.width - 2 * MARGIN)
        draw.text((MARGIN, foot + k * LINE_HEIGHT), text, DIM, small)
    return np.asarray(image)


def tradeoff_pane(size: tuple[int, int], tradeoff: Tradeoff, waiting: bool = False) -> np.ndarray:
    """Share of wrong mirror pixels against milliseconds, both logarithmic: the sweep's points, and the present one.

    Args:
        size: (width, height) of the pane.
        tradeoff: What is plotted.
        waiting: The present point is not measured yet; the last one of the trail is of other settings.
    """
    image, draw = _blank(size, "accuracy against time" + (f": {tradeoff.told}" if tradeoff.told else ""))
    small = _font("DejaVuSans", 11)
    box = plot_box(size)
    marks = [*tradeoff.marks, *tradeoff.trail]
    draw.rectangle((box.x, box.y, box.x + box.width, box.y + box.height), outline=RAISED)
    if not marks:
        draw.text((image.width / 2, image.height / 2), "nothing measured in this view yet", DIM, small, anchor="mm")
        return np.asarray(image)
    axes = plot_axes(marks)
    for decade in range(axes.left, axes.right + 1):
        x, _ = plot_place(box, axes, 10.0**decade, 1.0)
        draw.line((x, box.y, x, box.y + box.height), RAISED)
        draw.text((x, box.y + box.height + 3), f"{10.0**decade:g}", DIM, small, anchor="ma")
    for decade in range(axes.bottom, 1):
        _, y = plot_place(box, axes, 1.0, 10.0**decade)
        draw.line((box.x, y, box.x + box.width, y), RAISED)
        label = "0" if decade == axes.bottom else f"{100.0 * 10.0**decade:g}%"
        draw.text((box.x - 4, y), label, DIM, small, anchor="rm")
    foot = image.height - MARGIN
    draw.text((box.x, foot), "wrong mirror pixels over ms of reflections", DIM, small, anchor="ld")
    front = [plot_place(box, axes, mark.ms, mark.off) for mark in tradeoff.front()]
    for a, b in pairwise(front):
        draw.line((*a, b[0], a[1]), DIM)
        draw.line((b[0], a[1], *b), DIM)
    for mark in tradeoff.marks:
        x, y = plot_place(box, axes, mark.ms, mark.off)
        draw.ellipse((x - 3, y - 3, x + 3, y + 3), PLOT_COLORS.get(mark.technique, DIM))
        if mark.name == REFERENCE:
            draw.text((x, y - 6), REFERENCE, INK, small, anchor="md")
    trail = [plot_place(box, axes, mark.ms, mark.off) for mark in tradeoff.trail]
    if len(trail) > 1:
        draw.line(trail, ACCENT)
    for x, y in trail[:-1]:
        draw.ellipse((x - 2, y - 2, x + 2, y + 2), ACCENT)
    if trail:
        x, y = trail[-1]
        draw.ellipse((x - 6, y - 6, x + 6, y + 6), None if waiting else ACCENT, INK)
        mark = tradeoff.trail[-1]
        text = f"{mark.name}: {mark.ms:.1f} ms, {100.0 * mark.off:.3g} % wrong" + ("  (measuring)" if waiting else "")
        text = _cut(draw, text, small, box.width - 2 * MARGIN)
        draw.text((box.x + box.width - MARGIN, box.y + MARGIN), text, INK, small, anchor="ra")
    seen = dict.fromkeys(mark.technique for mark in tradeoff.marks if mark.technique in PLOT_COLORS)
    x = image.width - MARGIN
    for name in reversed(seen):
        x -= round(draw.textlength(name, small)) + 16
        if x < box.x + 250:
            break
        draw.text((x + 10, foot), name, DIM, small, anchor="ld")
        draw.ellipse((x, foot - 10, x + 6, foot - 4), PLOT_COLORS[name])
    return np.asarray(image)


@dataclass(frozen=True)
class PlotAxes:
    """Decades that a plot spans: of time from left to right, of error from the bottom (which stands for none) to 1."""

    left: int
    right: int
    bottom: int


def plot_box(size: tuple[int, int]) -> Box:
    """Where the plot lies in its pane."""
    width, height = (max(side, PANE_MIN) for side in size)
    return Box(PLOT_LEFT, TITLE_HEIGHT + 4, max(width - PLOT_LEFT - 2 * MARGIN, 8), max(height - TITLE_HEIGHT - 44, 8))


def plot_axes(marks: list[Mark]) -> PlotAxes:
    """Axes that hold all marks."""
    times = [max(mark.ms, MS_LEAST) for mark in marks]
    errors = [mark.off for mark in marks if mark.off > 0.0]
    left, right = math.floor(math.log10(min(times))), math.ceil(math.log10(max(times)))
    return PlotAxes(left, max(right, left + 1), min(math.floor(math.log10(min(errors, default=0.1))) - 1, -2))


def plot_place(box: Box, axes: PlotAxes, ms: float, off: float) -> tuple[float, float]:
    """Where a mark lies in the pane, pixels from its top left."""
    across = (math.log10(max(ms, MS_LEAST)) - axes.left) / (axes.right - axes.left)
    up = (math.log10(max(off, 10.0**axes.bottom)) - axes.bottom) / -axes.bottom
    return box.x + across * box.width, box.y + (1.0 - up) * box.height


def text_pane(session: Session, size: tuple[int, int], whole_plan: bool = False) -> np.ndarray:
    """Numbers, the last pick and the plan; or the plan alone."""
    image, draw = _blank(size, "")
    bold, mono = _font("DejaVuSans-Bold", TITLE_SIZE), _font("DejaVuSansMono", MONO_SIZE)
    for place in _text_places(session, (image.width, image.height), whole_plan):
        if place.is_title:
            draw.text((MARGIN, place.y), place.text, INK, bold)
            continue
        effect = place.line is not None and place.line.effect
        on = effect and place.line.row.effects[effect].on
        draw.text((MARGIN, place.y), place.text, ON if on else DIM, mono)
    return np.asarray(image)


def plan_line_at(session: Session, size: tuple[int, int], y: int, whole_plan: bool = False) -> PlanLine | None:
    """The line of the plan that the text pane shows at a height, y down."""
    places = _text_places(session, tuple(max(side, PANE_MIN) for side in size), whole_plan)
    return next((place.line for place in places if place.y <= y < place.y + LINE_HEIGHT and not place.is_title), None)


@dataclass(frozen=True)
class _TextPlace:
    """A line of the text pane: `line` is the plan's, where it is one."""

    text: str
    y: int
    is_title: bool = False
    line: PlanLine | None = None


def _text_places(session: Session, size: tuple[int, int], whole_plan: bool) -> list[_TextPlace]:
    """What the text pane says, and where."""
    width, height = size
    columns = max(int((width - 2 * MARGIN) / _font("DejaVuSansMono", MONO_SIZE).getlength("0")), 20)
    sections: list[tuple[str, list[tuple[str, PlanLine | None]]]] = []
    if not whole_plan:
        picked = session.picks[-1].lines() if session.picks else ["click into the frame: what is seen there"]
        for title, lines in (("time and error", session.numbers()), ("picked pixel", picked)):
            sections.append((title, [(line, None) for line in lines]))
    sections.append(("plan: click a line to force the other way", [(line.text, line) for line in session.plan.lines()]))
    y, places = 6, []
    for title, lines in sections:
        if y + TITLE_HEIGHT + LINE_HEIGHT > height:
            break
        places.append(_TextPlace(title, y, is_title=True))
        y += TITLE_HEIGHT - 6
        folded = [(part, line) for text, line in lines for part in _folded(text, columns)]
        room = (height - y - 4) // LINE_HEIGHT
        if len(folded) > room:
            keep = max(room - 1, 0)
            more = "" if whole_plan else " (p: the plan alone)"
            folded = [*folded[:keep], (f"… {len(folded) - keep} more lines{more}", None)][:room]
        for text, line in folded:
            places.append(_TextPlace(text, y, line=line))
            y += LINE_HEIGHT
        y += 8
    return places


def _folded(line: str, columns: int) -> list[str]:
    """A line in lines of at most so many columns, further ones under the first."""
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(line, columns, subsequent_indent=indent, drop_whitespace=True) or [""]


def _wrapped(draw: ImageDraw.ImageDraw, text: str, font, width: float) -> list[str]:
    lines: list[str] = []
    for word in text.split():
        longer = f"{lines[-1]} {word}" if lines else word
        if lines and draw.textlength(longer, font) <= width:
            lines[-1] = longer
        else:
            lines.append(_cut(draw, word, font, width))
    return lines
