"""The flat parts of the inspector as pictures: frames with their titles, knobs, numbers. Drawn without OpenGL."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from warp_reflect.viewer.session import CLASS_COLORS, CONTROLS, ERROR_SHOWN_PX, PixelClass, Session, heat_colors

BACK, RAISED, INK, DIM, ACCENT, WARN = (
    (24, 26, 30),
    (48, 52, 60),
    (232, 234, 238),
    (150, 156, 168),
    (255, 176, 58),
    (255, 112, 96),
)
TITLE_HEIGHT = 28  # pixels, as all below
MARGIN = 8
LINE_HEIGHT = 17
ROW_HEIGHT = 36
TEXT_SIZE, TITLE_SIZE, MONO_SIZE = 14, 14, 12
KNOB_RADIUS = 7
PANE_MIN = 64  # a pane smaller than this is drawn at this size and shown smaller
TRACK = (0.36, 0.70)  # of the pane's width, where a knob's track begins and ends
KEYS = (
    "drag: orbit   shift-drag: pan   wheel: zoom   click: pick",
    "p: plan   g: regions   v: virtual objects   c: forget picks",
    ": name=value sets any setting   q: quit",
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


def knobs_of(session: Session, size: tuple[int, int]) -> list[Knob]:
    """The knobs of a session and where they lie; camera and time where there is a choice."""
    rows: list[tuple[str, tuple]] = [(control.name, control.values) for control in CONTROLS]
    cameras = tuple(each.path for each in session.scene.data.cameras)
    if len(cameras) > 1:
        rows.append(("camera", cameras))
    if session.times:
        rows.append(("time", session.times))
    width = max(size[0], PANE_MIN)
    height = min(ROW_HEIGHT, max((size[1] - TITLE_HEIGHT - 5 * LINE_HEIGHT) // len(rows), 14))
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


def controls_pane(session: Session, size: tuple[int, int], typed: str | None = None) -> np.ndarray:
    """Knobs, the message, and what keys and buttons do."""
    image, draw = _blank(size, "settings")
    font, bold = _font("DejaVuSans", TEXT_SIZE), _font("DejaVuSans-Bold", TEXT_SIZE)
    labels = {control.name: control for control in CONTROLS}
    knobs = knobs_of(session, size)
    for knob in knobs:
        box, control = knob.track, labels.get(knob.name)
        y = box.y + box.height // 2
        value = session.knob_value(knob.name)
        shown = control.shown(value) if control else f"{value:g}" if knob.name == "time" else f"{value}"
        share = nearest(knob.values, value) / max(len(knob.values) - 1, 1)
        x = box.x + share * box.width
        draw.text((MARGIN, y), control.label if control else knob.name, INK, font, anchor="lm")
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


def text_pane(session: Session, size: tuple[int, int], whole_plan: bool = False) -> np.ndarray:
    """Numbers, the last pick and the plan; or the plan alone."""
    image, draw = _blank(size, "")
    bold, mono = _font("DejaVuSans-Bold", TITLE_SIZE), _font("DejaVuSansMono", MONO_SIZE)
    columns = max(int((image.width - 2 * MARGIN) / draw.textlength("0", mono)), 20)
    sections = []
    if not whole_plan:
        sections.append(("time and error", session.numbers()))
        picked = session.picks[-1].lines() if session.picks else ["click into the frame: what is seen there"]
        sections.append(("picked pixel", picked))
    sections.append(("plan", str(session.plan).splitlines()))
    y = 6
    for title, lines in sections:
        if y + TITLE_HEIGHT + LINE_HEIGHT > image.height:
            break
        draw.text((MARGIN, y), title, INK, bold)
        y += TITLE_HEIGHT - 6
        folded = [part for line in lines for part in _folded(line, columns)]
        room = (image.height - y - 4) // LINE_HEIGHT
        if len(folded) > room:
            keep = max(room - 1, 0)
            more = "" if whole_plan else " (p: the plan alone)"
            folded = [*folded[:keep], f"… {len(folded) - keep} more lines{more}"][:room]
        for line in folded:
            draw.text((MARGIN, y), line, DIM, mono)
            y += LINE_HEIGHT
        y += 8
    return np.asarray(image)


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
