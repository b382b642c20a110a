"""The `warp-reflect` command: `plan`, `render`, `compare`.

Results go to standard output, notes and errors to standard error. Exit 0: done; 1: a job failed part way;
2: cannot be done, with one line that says why.
"""

from __future__ import annotations

import json
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated

import cyclopts
from cyclopts import Parameter

from warp_reflect import images
from warp_reflect.devices import open_device as _open_device

DONE, PART_WAY, IMPOSSIBLE = 0, 1, 2
NOTES_SHOWN = 40  # a stage of thousands of prims may have thousands; `plan --json` has them all
SIDE_MAX = 32768  # pixels; what the image readers of this package accept back

# What a user's input can cause; anything else is a fault of this program.
REFUSALS = (ValueError, KeyError, OSError, NotImplementedError, MemoryError)

app = cyclopts.App(name="warp-reflect", help="Accurate specular reflections on curved objects, for OpenUSD stages.")


@Parameter(name="*")
@dataclass
class StageOptions:
    """How a stage is opened."""

    purposes: str = "render"
    """Purposes to draw besides default, comma-separated: render, proxy, guide."""
    device: str = "cpu"
    """cpu or cuda:0."""
    strict: Annotated[bool, Parameter(negative=())] = False
    """Refuse a stage with a prim that cannot be used, instead of dropping the prim with a note."""
    untrusted: Annotated[bool, Parameter(negative=())] = False
    """Read the stage in a child process with bounded time and memory, and nothing outside --root."""
    root: str | None = None
    """The folder that layers and pictures must lie in (default: anywhere; with --untrusted the stage's own)."""
    debug: Annotated[bool, Parameter(negative=())] = False
    """Show tracebacks."""


@Parameter(name="*")
@dataclass
class PlanOptions:
    """What is simulated, and how."""

    camera: Annotated[str | None, Parameter(name=["--camera", "-cam"])] = None
    """Path or name of a camera."""
    image_width: Annotated[int, Parameter(name=["--imageWidth", "-w"])] = 960
    """Width in pixels; the height follows from the camera's aspect."""
    res: str | None = None
    """Exact size instead, WIDTHxHEIGHT."""
    method: str = "auto"
    """auto, reference (every mirror ray traced) or a technique."""
    reflector: Annotated[list[str] | None, Parameter(negative=())] = None
    """Make mirrors of the prims, materials or collection that this path, name or pattern (* and ?) names; repeatable.
    They become neutral metal; end it in :color=keep (or one number or three), :roughness=R, :metallic=M or :technique=T
    for another, as in '/World/Car*:color=keep:roughness=0.1'."""
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None
    """A setting, name=value; repeatable."""
    complexity: Annotated[str | None, Parameter(name=["--complexity", "-c"])] = None
    """low, medium, high or veryhigh: how finely surfaces are tessellated."""


@app.command
def plan(
    stage: str,
    /,
    *,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
    opened: StageOptions | None = None,
    planned: PlanOptions | None = None,
) -> int:
    """Say what would be simulated, what not, and why.

    Args:
        stage: A USD file.
        json_: Print the plan as JSON.
        opened: How the stage is opened.
        planned: What is simulated, and how.
    """
    opened, planned = opened or StageOptions(), planned or PlanOptions()
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    device = _open_device(opened.device)
    with _progress() as show:
        show("reading " + stage)
        scene = _load(stage, opened, planned, settings, device, None)
        show("planning")
        made = _make_plan(scene, planned, settings)
    if json_:
        print(json.dumps(made.to_json(), indent=2, allow_nan=False))
    else:
        print(made)
    _print_notes([*scene.notes, *made.notes], set())
    return DONE


@app.command
def render(
    stage: str,
    /,
    *outputs: str,
    output: Annotated[list[str] | None, Parameter(name=["--output", "-o"], negative=())] = None,
    frames: Annotated[str | None, Parameter(name=["--frames", "-f"])] = None,
    aov: str | None = None,
    opened: StageOptions | None = None,
    planned: PlanOptions | None = None,
) -> int:
    """Render frames to EXR (every data channel, linear) or PNG (the picture, sRGB).

    Args:
        stage: A USD file.
        outputs: Files to write, .exr or .png; with --frames their names hold ####.
        output: The same as a positional output.
        frames: Frames such as 101:109x2,120; without it the stage's first.
        aov: Channels to write to EXR, comma-separated; without it all of them.
        opened: How the stage is opened.
        planned: What is simulated, and how.
    """
    from warp_reflect.stage.frames import frame_name, has_frame_pattern, parse_frames

    opened, planned = opened or StageOptions(), planned or PlanOptions()
    names = [*outputs, *(output or [])]
    if not names:
        raise ValueError("no output given; add a file such as out.exr or out.png")
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    channels = _channel_names(aov) if aov is not None else None
    if frames is None:
        for name in names:
            if has_frame_pattern(name):
                raise ValueError(f"{name}: has a place for a frame number; add --frames")
        times = [None]
        files = [names]
    else:
        times = parse_frames(frames)
        files = [[frame_name(name, time) for name in names] for time in times]
    checked = {name for row in files[:1] for name in row}
    for name in checked:
        images.check_writable(name)
    if len(checked) != len(names):
        raise ValueError(f"the same output is given twice: {', '.join(names)}")
    device = _open_device(opened.device)

    written: list[str] = []
    told: set = set()
    with _progress(len(times)) as show:
        try:
            show("reading " + stage)
            first = _load(stage, opened, planned, settings, device, times[0])
            made, previous = None, None
            for time, row in zip(times, files, strict=True):
                label = stage if time is None else f"frame {time:g}"
                scene = first if time == times[0] else first.at(time)
                show(label, frames_done=len(written) // len(names))
                if made is None or made.scene is not scene:
                    made = _make_plan(scene, planned, settings)
                    _print_notes([*scene.notes, *made.notes], told)
                previous = _render_one(scene, made, previous, row, channels, written)
        except (*REFUSALS, KeyboardInterrupt) as error:
            if not written:
                raise
            if opened.debug:
                traceback.print_exc()
            _tell(f"error: {label}: {_line(error)}")
            _tell(f"kept {len(written)} finished file{'s' if len(written) > 1 else ''}: {_shortened(written)}")
            return PART_WAY
    return DONE


def _render_one(scene, made, previous, row: list[str], channels: list[str] | None, written: list[str]):
    """Render one frame, write its files, print a line for each; returns the frame."""
    import warp_reflect as wr

    start = perf_counter()
    frame = wr.render_frame(scene, made, previous=previous)
    rendered_ms = 1000.0 * (perf_counter() - start)
    for name in row:
        frame.write(name, channels=channels)
        written.append(name)
        width, height = made.size
        print(f"{name}: {width}x{height}, {rendered_ms:.0f} ms{_statistics_line(frame.statistics)}", flush=True)
    return frame


def _statistics_line(statistics: dict) -> str:
    """`, mirror pixels 12,345: 91.2 % candidate, 8.0 % walk, 0.8 % BVH`, as far as a frame counted it."""
    names = {"candidate": "candidate", "walk": "walk", "empty": "sky", "bvh": "BVH"}
    counts = {shown: int(statistics[key]) for key, shown in names.items() if key in statistics}
    total = sum(counts.values())
    if not total:
        return ""
    shares = ", ".join(f"{100.0 * number / total:.4g} % {shown}" for shown, number in counts.items())
    return f", {total:,} mirror pixels: {shares}"


@app.command
def compare(
    a: str,
    b: str,
    /,
    *,
    json_: Annotated[bool, Parameter(name="--json", negative=())] = False,
    debug: Annotated[bool, Parameter(negative=())] = False,
) -> int:
    """Measure the error of a frame against a reference.

    Args:
        a: The EXR to judge.
        b: The reference, from the same camera at the same size.
        json_: Print the numbers as JSON.
        debug: Show tracebacks.
    """
    from warp_reflect import metrics

    (channels_a, header_a), (channels_b, header_b) = images.read_exr(a), images.read_exr(b)
    eyes = header_a.get("warp_reflect:eye"), header_b.get("warp_reflect:eye")
    if None not in eyes and eyes[0] != eyes[1]:
        raise ValueError(f"{a} and {b} were made from different eyes, {eyes[0]} and {eyes[1]}; nothing to compare")
    result = metrics.compare_frames(channels_a, channels_b)
    print(json.dumps(result.to_json(), indent=2, allow_nan=False) if json_ else result)
    return DONE


def main(tokens: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = sys.argv[1:] if tokens is None else list(tokens)
    debug = "--debug" in arguments
    if not debug:
        sys.excepthook = _say_fault
    try:
        command, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False)
    except cyclopts.CycloptsError as error:
        _tell(f"error: {_line(error)}")
        return IMPOSSIBLE
    try:
        code = command(*bound.args, **bound.kwargs) or DONE
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # `| head` has read enough; what is left in the buffer goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except REFUSALS as error:
        if debug:
            traceback.print_exc()
        _tell(f"error: {_line(error)}")
        return IMPOSSIBLE
    except KeyboardInterrupt:
        _tell("error: interrupted, nothing was written")
        return PART_WAY


def _say_fault(kind, error, _trace) -> None:
    _tell(f"error: {kind.__name__}: {_line(error)} (a fault of warp-reflect: --debug shows where)")


def _line(error: BaseException) -> str:
    """An exception as one line."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, MemoryError):
        return f"not enough memory {error}".strip()
    # str() of a KeyError is its repr.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split()) or type(error).__name__


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _shortened(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]} ... {names[-1]}"


# Arguments.


def _settings(planned: PlanOptions):
    from warp_reflect.settings import Settings

    changes = {}
    for item in planned.set_ or []:
        name, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"--set: got '{item}', expected name=value with a name of {', '.join(Settings.names())}")
        changes[name.strip()] = value.strip()
    if planned.complexity is not None:
        changes["complexity"] = planned.complexity
    return Settings().replace(**changes)


def _channel_names(text: str) -> list[str]:
    """The channels of --aov, checked before a frame is rendered for them."""
    from warp_reflect.channels import component_of

    names = list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    if not names:
        raise ValueError(f"--aov: got '{text}', expected channels such as RGBA,reflectedPoint")
    for name in names:
        component_of(name)
    return names


def _check_method(method: str) -> None:
    from warp_reflect.techniques import TECHNIQUES

    valid = ["auto", "reference", *TECHNIQUES]
    if method not in valid:
        raise ValueError(f"--method: got '{method}', expected one of {', '.join(valid)}")


def _check_size_options(planned: PlanOptions) -> None:
    if not 1 <= planned.image_width <= SIDE_MAX:
        raise ValueError(f"--imageWidth: got {planned.image_width}, expected 1 to {SIDE_MAX} pixels")
    if planned.res is not None:
        _size(planned.res)


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"--res: got '{text}', expected WIDTHxHEIGHT such as 1280x720")
    size = int(width), int(height)
    if not all(1 <= side <= SIDE_MAX for side in size):
        raise ValueError(f"--res: got '{text}', expected sides of 1 to {SIDE_MAX} pixels")
    return size


def _purposes(text: str) -> tuple[str, ...]:
    """Default is always drawn, as in usdrecord."""
    known = ("default", "render", "proxy", "guide")
    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        if name not in known:
            raise ValueError(f"--purposes: got '{name}', expected some of {', '.join(known)}")
    return tuple(dict.fromkeys(["default", *asked]))


# Scenes.


def _load(stage: str, opened: StageOptions, planned: PlanOptions, settings, device: str, time: float | None):
    import warp_reflect as wr

    return wr.load_stage(
        stage,
        device=device,
        time=time,
        purposes=_purposes(opened.purposes),
        complexity=settings.complexity,
        strict=opened.strict,
        reflectors=tuple(planned.reflector or ()),
        untrusted=opened.untrusted,
        root=opened.root or "",
    )


def _make_plan(scene, planned: PlanOptions, settings):
    import warp_reflect as wr
    from warp_reflect.planner import find_camera

    if planned.res is not None:
        size = _size(planned.res)
    else:
        path = find_camera(scene, planned.camera, (1, 1)).path
        film = next(camera for camera in scene.data.cameras if camera.path == path)
        height = planned.image_width * film.vertical_aperture / film.horizontal_aperture
        size = planned.image_width, min(max(round(height), 1), SIDE_MAX)
    return wr.make_plan(
        scene,
        camera=planned.camera,
        size=size,
        settings=settings,
        method=planned.method,
    )


def _print_notes(notes: list, told: set) -> None:
    """Notes not told before, one line each."""
    fresh = [note for note in notes if note not in told]
    told.update(fresh)
    for note in fresh[:NOTES_SHOWN]:
        _tell(f"note: {note.path}: {note.text}")
    if len(fresh) > NOTES_SHOWN:
        _tell(f"note: {len(fresh) - NOTES_SHOWN:,} more; `plan --json` lists them all")


@contextmanager
def _progress(total: int = 1) -> Iterator[Callable]:
    """A line on a terminal that says what is going on, and is gone when it is done; nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda text, frames_done=0: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = [SpinnerColumn(), TextColumn("{task.description}", markup=False)]
    columns += [BarColumn(), TimeRemainingColumn()] if total > 1 else [TimeElapsedColumn()]
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=True) as progress:
        task = progress.add_task("", total=total)

        def show(text: str, frames_done: int = 0) -> None:
            progress.update(task, description=text, completed=frames_done)

        yield show


if __name__ == "__main__":
    sys.exit(main())
