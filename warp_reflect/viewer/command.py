"""`warp-reflect view`: the inspector's window, or what it shows as files."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from warp_reflect.layers import Camera
from warp_reflect.planner import find_camera
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.viewer import export, gl
from warp_reflect.viewer.session import Session
from warp_reflect.viewer.tradeoff import beside, read_results

WIDTH = 640  # pixels of a frame; small enough to follow a hand on a CPU
ASPECT = 4.0 / 3.0  # where no camera of the stage says otherwise


def check(shown) -> None:
    """Refuse options that contradict each other, before anything is read.

    Args:
        shown: `cli.ViewOptions`.

    Raises:
        ValueError: they do, a pixel is none, or there is neither an output nor a display.
        OSError: an output cannot be written.
    """
    if shown.frame_only and not shown.screenshot:
        raise ValueError("--frame-only: goes with --screenshot OUT.png")
    if shown.screenshot:
        export.check_picture(shown.screenshot, ".png")
    if shown.html:
        export.check_picture(shown.html, ".html")
    if shown.turntable:
        export.turntable_files(shown.turntable, shown.frames)
    for text in shown.pick or []:
        _pixel(text)
    if shown.sweep:
        read_results(shown.sweep)
    if shown.screenshot or shown.html or shown.turntable:
        return
    if not gl.library():
        raise ValueError(f"no OpenGL was found: {gl.ADVICE}; or write files with --screenshot, --turntable or --html")
    if not gl.has_display() and not gl.off_screen_asked():
        raise ValueError("no display to open a window on; write files with --screenshot, --turntable or --html")


def make_session(
    scene: Scene,
    camera: str | None,
    settings: Settings,
    method: str,
    size: tuple[int, int] | None,
    width: int | None,
) -> Session:
    """A session at an exact size, or at a width whose height follows from the camera's film; errors as `make_plan`."""
    if size is None:
        width = width or WIDTH
        aspect = ASPECT
        if camera is not None or scene.data.cameras:
            path = find_camera(scene, camera, (1, 1)).path
            film = next(each for each in scene.data.cameras if each.path == path)
            aspect = film.horizontal_aperture / film.vertical_aperture
        size = width, max(round(width / aspect), 1)
    named: str | Camera | None = camera
    return Session(scene, named, settings, size, method)


def run(session: Session, shown, say: Callable[[str], None]) -> Iterator[str]:
    """Write the files that are asked for, or open the window.

    Args:
        session: What is shown.
        shown: `cli.ViewOptions`.
        say: Told of every file.

    Yields:
        What the user should know.

    Raises:
        ValueError, OSError: a pixel outside of the picture, a file that cannot be written.
    """
    found = read_results(shown.sweep) if shown.sweep else beside(session.scene.data.source)
    if found is not None:
        session.tradeoff = found
    if session.message:
        yield session.message
    for text in shown.pick or []:
        say("\n".join(session.pick(*_pixel(text)).lines()))
    if shown.screenshot:
        lack = export.write_screenshot(shown.screenshot, session, shown.frame_only)
        say(shown.screenshot)
        if lack:
            yield lack
    if shown.html:
        say(str(export.write_html(shown.html, session)))
    if shown.turntable:
        export.write_turntable(shown.turntable, session, shown.frames, say)
    if not (shown.screenshot or shown.html or shown.turntable):
        from warp_reflect.viewer.inspector import Inspector

        inspector = Inspector(session)
        if inspector.plotter.off_screen:
            yield "PYVISTA_OFF_SCREEN is set: drawn without a window; --screenshot OUT.png keeps the picture"
        inspector.plotter.show(title=f"warp-reflect: {session.scene.data.source}")


def _pixel(text: str) -> tuple[int, int]:
    x, comma, y = text.partition(",")
    if not (comma and x.strip().isdecimal() and y.strip().isdecimal()):
        raise ValueError(f"--pick: got '{text}', expected X,Y such as 320,240")
    return int(x), int(y)
