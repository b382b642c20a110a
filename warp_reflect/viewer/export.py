"""What the inspector writes without a window: a picture of itself, a turntable, a page. Only the first needs OpenGL."""

from __future__ import annotations

import base64
import html
import io
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from warp_reflect import __version__, images
from warp_reflect.frame import Frame, render_frame
from warp_reflect.planner import make_plan
from warp_reflect.viewer import cameras, gl
from warp_reflect.viewer.session import CLASS_COLORS, ERROR_SHOWN_PX, HEAT, PixelClass, Session, heat_map, picture

TURNTABLE_FRAMES = 36  # ten degrees a frame
TURNTABLE_SECONDS = 4.0  # of a GIF's turn
GIF = ".gif"
FILES_MAX = 1_000_000  # more numbered files than this is a slip of the keyboard
GIF_TICK_MS = 10  # a GIF tells durations in hundredths of a second
GIF_FRAMES_MAX = 400  # a turn of hundredths of a second


def check_picture(path: str | os.PathLike, suffix: str) -> Path:
    """Refuse, before any work is done, an output that could not be written.

    Raises:
        ValueError: another extension.
        OSError: the folder is missing, or nothing can be written there.
    """
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise ValueError(f"{path}: expected a name that ends in {suffix}")
    if not path.parent.is_dir():
        raise OSError(f"{path}: cannot be written: the folder '{path.parent}' does not exist; make it first")
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: cannot be written: it exists and is not a regular file")
    return path


def write_screenshot(path: str | os.PathLike, session: Session, frame_only: bool = False) -> str:
    """Write what the inspector shows of a session, or its frame alone, as PNG.

    Args:
        path: Ends in .png.
        session: What is shown; picks included.
        frame_only: The frame as `render` writes it, pixel by pixel.

    Returns:
        What was written instead and what to install, where there is no OpenGL; else nothing.

    Raises:
        ValueError, OSError: the file cannot be written.
    """
    path = images.check_writable(check_picture(path, ".png"))
    if frame_only or not gl.library():
        session.refine()
        session.frame.write(path)
        return (
            "" if frame_only else f"{path}: the frame alone, for there is no OpenGL to draw the inspector; {gl.ADVICE}"
        )
    from warp_reflect.viewer.inspector import Inspector

    inspector = Inspector(session, off_screen=True)
    try:
        shown = inspector.plotter.screenshot(return_img=True)
    finally:
        inspector.plotter.close()
    _write_whole(path, _encoded(Image.fromarray(shown), "PNG"))
    return ""


def turntable_files(out: str, frames: int) -> list[Path]:
    """The files of a turntable, checked; see `write_turntable`."""
    from warp_reflect.stage.frames import frame_name, has_frame_pattern

    animated = Path(out).suffix.lower() == GIF
    most = GIF_FRAMES_MAX if animated else FILES_MAX
    if not 1 <= frames <= most:
        raise ValueError(f"--frames: got {frames}, expected 1 to {most:,}")
    if animated:
        return [check_picture(out, GIF)]
    if not has_frame_pattern(out):
        raise ValueError(f"--turntable: got '{out}', expected a .gif, or a name such as out.####.png")
    images.check_writable(frame_name(out, 1.0))
    return [Path(frame_name(out, float(k + 1))) for k in range(frames)]


def write_turntable(
    out: str, session: Session, frames: int = TURNTABLE_FRAMES, report: Callable[[str], None] | None = None
) -> list[Path]:
    """Write frames of a full turn about the mirror seen most, about the stage's up axis.

    Args:
        out: An animated .gif, or .png (or .exr) with a place for the frame number, such as out.####.png.
        session: Its camera is where the turn starts.
        frames: Of the turn.
        report: Told of every file.

    Returns:
        The files.

    Raises:
        ValueError: the name or the number cannot be.
        OSError: a file cannot be written.
    """
    files = turntable_files(out, frames)
    animated = files[0].suffix.lower() == GIF
    reuses, before = session.settings.reuse_px > 0.0, None
    shown = []
    for k in range(frames):
        camera = cameras.orbited(
            session.camera, session.pivot, cameras.up_of(session.scene), 2.0 * math.pi * k / frames, 0.0
        )
        plan = make_plan(session.scene, camera, session.size, session.settings, session.method, earlier=session.plan)
        frame = render_frame(session.scene, plan, previous=before)
        before = frame if reuses else None
        if animated:
            shown.append(Image.fromarray(picture(frame)))
        else:
            frame.write(files[k])
            if report is not None:
                report(str(files[k]))
    if animated:
        ticks = max(round(1000.0 * TURNTABLE_SECONDS / frames / GIF_TICK_MS), 2)
        stream = io.BytesIO()
        shown[0].save(stream, "GIF", save_all=True, append_images=shown[1:], duration=ticks * GIF_TICK_MS, loop=0)
        _write_whole(files[0], stream.getvalue())
        if report is not None:
            report(str(files[0]))
    return files


def write_html(path: str | os.PathLike, session: Session) -> Path:
    """Write a page of its own: frame and reference with a wipe, error map, what is seen at a pixel, numbers and plan.

    Everything is baked into pictures: a browser's shading could not show these reflections. Nothing is loaded from elsewhere,
    and there is no 3-D view in it.

    Raises:
        ValueError, OSError: the file cannot be written.
    """
    path = check_picture(path, ".html")
    session.measure()
    frame = session.frame
    names, ids = _id_picture(frame)
    width, height = session.size
    heat = "".join(f"rgb({r:.0f},{g:.0f},{b:.0f})," for r, g, b in HEAT).rstrip(",")
    keys = "".join(
        f'<span><i style="background:rgb{CLASS_COLORS[number]}"></i>{word}</span>'
        for number, word in (
            (PixelClass.IDENTICAL, "same hit"),
            (PixelClass.WRONG, "wrong"),
            (PixelClass.UNMATCHED, "unmatched"),
            (PixelClass.BORDER, "rim"),
        )
    )
    fields = {
        "TITLE": html.escape(Path(session.scene.data.source).name),
        "VERSION": __version__,
        "WIDTH": str(width),
        "HEIGHT": str(height),
        "FRAME": _data_url(picture(frame)),
        "REFERENCE": _data_url(picture(session.reference)),
        "ERROR": _data_url(heat_map(session.comparison)),
        "IDS": _data_url(ids),
        "NAMES": ",".join('"' + html.escape(name).replace("\\", "\\\\") + '"' for name in names),
        "HEAT": heat,
        "MOST": f"{ERROR_SHOWN_PX:g}+ px",
        "KEYS": keys,
        "NUMBERS": html.escape("\n".join(session.numbers())),
        "PLAN": html.escape(str(session.plan)),
    }
    page = (Path(__file__).parent / "page.html").read_text("utf-8")
    for name, text in fields.items():
        page = page.replace(f"@{name}@", text)
    _write_whole(path, page.encode("utf-8"))
    return path


def _id_picture(frame: Frame) -> tuple[list[str], np.ndarray]:
    """(names, uint8 [h, w, 3]): prim ids seen directly and in mirrors as places in `names`.

    Red and the high half of blue: seen directly; green and the low half of blue: in the mirror. 0: nothing.
    """
    direct, mirrored = frame["primId"].astype(int), frame["reflectedId"].astype(int)
    used = np.unique(np.concatenate([[0], direct.ravel(), mirrored.ravel()]))[: 1 << 12]
    place = np.zeros(max(int(direct.max()), int(mirrored.max())) + 1, int)
    place[used] = np.arange(len(used))
    a, b = place[direct], place[mirrored]
    names = ["", *(frame.prims.get(int(number), "") for number in used[1:])]
    return names, np.stack([a & 255, b & 255, (a >> 8) << 4 | b >> 8], axis=-1).astype(np.uint8)


def _data_url(image: np.ndarray) -> str:
    data = _encoded(Image.fromarray(np.ascontiguousarray(image)), "PNG")
    return "data:image/png;base64," + base64.b64encode(data).decode("ascii")


def _encoded(image: Image.Image, kind: str) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind)
    return stream.getvalue()


def _write_whole(path: Path, data: bytes) -> None:
    """Under a temporary name first: what is there under the final one is whole."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None
