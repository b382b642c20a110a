"""The `warp-reflect` command: `plan`, `render`, `bake`, `process`, `view`, `sweep`, `calibrate`, `warmup`, `compare`.

Results go to standard output, notes and errors to standard error. Exit 0: done; 1: a job failed part way;
2: cannot be done, with one line that says why; 130, 143: stopped by SIGINT, SIGTERM.
"""

from __future__ import annotations

import difflib
import json
import os
import sys
import traceback
from dataclasses import dataclass, fields, replace
from typing import Annotated, get_type_hints

import cyclopts
from cyclopts import Parameter

from warp_reflect import images, kernels, pipeline
from warp_reflect.devices import open_device as _open_device
from warp_reflect.pipeline import DONE, IMPOSSIBLE, PART_WAY, SIDE_MAX, Job, one_line, plan_scene
from warp_reflect.progress import reporting

WIDTH_DEFAULT = 960  # pixels; usdrecord's
INTERRUPTED = 130  # what a shell expects of a process that SIGINT ended

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
    image_width: Annotated[int | None, Parameter(name=["--imageWidth", "-w"])] = None
    """Width in pixels (960); the height follows from the camera's aspect."""
    res: str | None = None
    """Exact size instead, WIDTHxHEIGHT."""
    method: str = "auto"
    """auto, reference (every mirror ray traced), none (no mirror reflects) or a technique."""
    reflector: Annotated[list[str] | None, Parameter(negative=())] = None
    """Make mirrors of the prims, materials or collection that this path, name or pattern (* and ?) names; repeatable.
    They become neutral metal; end it in :color=keep (or one number or three), :roughness=R, :metallic=M or :technique=T
    for another, as in '/World/Car*:color=keep:roughness=0.1'."""
    max_error_px: float | None = None
    """Take what is cheapest among all that shows 95 % of the mirror pixels within this, and say what it came out as."""
    budget_ms: float | None = None
    """Take what is most accurate among all that makes a frame in this time, and say what it came out as."""
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None
    """A setting, name=value; repeatable."""
    complexity: Annotated[str | None, Parameter(name=["--complexity", "-c"])] = None
    """low, medium, high or veryhigh: how finely surfaces are tessellated."""
    render_settings: Annotated[str | None, Parameter(name=["--render-settings", "--renderSettingsPrimPath", "-rs"])] = (
        None
    )
    """A RenderSettings prim to take size, camera, outputs and channels from, as far as this command does not name them
    (default: the stage's renderSettingsPrimPath)."""


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
    _, _, planned, notes = _as_the_stage_asks(stage, [], None, opened, planned)
    device = _open_device(opened.device)
    with reporting(None) as report:
        report.busy("reading " + stage)
        scene = _load(stage, opened, planned, settings, device, None)
        report.busy("planning")
        made = _make_plan(scene, planned, settings)
    print(json.dumps(made.to_json(), indent=2, allow_nan=False) if json_ else made)
    report.notes([*notes, *scene.notes, *made.notes])
    return DONE


@Parameter(name="*")
@dataclass
class RangeOptions:
    """How a range of frames is rendered."""

    resume: Annotated[bool, Parameter(negative=())] = False
    """Keep frames whose files are whole and were made from the same stage and settings; redo all others."""
    workers: int = 1
    """Processes that render; more than one needs the extra `cluster`. Each uses its share of the cores."""
    scheduler: str | None = None
    """A running dask scheduler to use instead, as tcp://host:8786."""
    part: str | None = None
    """Render part K of N of the frames, K/N; frames keep their neighbours in the whole range."""
    timelimit: float | None = None
    """Seconds after which no frame is begun, or one that would take longer than that."""
    progress: str | None = None
    """rich, json (one object a line on standard error), alf (ALF_PROGRESS 50%) or none; rich on a terminal."""
    multi_part: Annotated[bool, Parameter(negative=())] = False
    """Write EXR with one part per channel group."""
    boxes: str | None = None
    """A .json file for the boxes of the objects seen in mirrors, in COCO's layout; with --frames its name holds ####."""
    st_map: str | None = None
    """An .exr file for where in the picture the points seen in mirrors appear directly (s right, t up); likewise."""
    print_job: str | None = None
    """Render nothing; print this command as a job for a render farm: openjd (Open Job Description)."""


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
    ranged: RangeOptions | None = None,
) -> int:
    """Render frames to EXR (every data channel, linear) or PNG (the picture, sRGB).

    SIGINT and SIGTERM stop after the frame at hand (exit 130 and 143); SIGUSR1 writes the last one as a PNG.

    Args:
        stage: A USD file.
        outputs: Files to write, .exr or .png; with --frames their names hold ####.
        output: The same as a positional output.
        frames: Frames such as 101:109x2,120; without it the stage's first.
        aov: Channels to write to EXR, comma-separated; without it all of them. Hydra's and Omniverse's names are known, too.
        opened: How the stage is opened.
        planned: What is simulated, and how.
        ranged: How a range of frames is rendered.
    """
    opened, planned, ranged = opened or StageOptions(), planned or PlanOptions(), ranged or RangeOptions()
    names = [*outputs, *(output or [])]
    with reporting(ranged.progress) as report:
        try:
            part = _part(ranged.part)
            _check_time_limit(ranged.timelimit)
            if ranged.workers < 1:
                raise ValueError(f"--workers: got {ranged.workers}, expected 1 or more")
            if _is_rendered_here(ranged) and os.path.exists(stage):
                # What every frame launches first is compiled while the stage is opened.
                device = _open_device(opened.device)
                kernels.begin(kernels.of_view(_settings(planned), device), device)
            names, channels, wanted, notes = _as_the_stage_asks(stage, names, aov, opened, planned)
            job = _job(stage, names, frames, channels, opened, wanted, ranged)
            if ranged.print_job is not None:
                return _print_job(ranged.print_job, job, names, frames, aov, opened, planned, ranged)
            report.notes(notes)
            job = replace(job, load=job.load | {"device": _open_device(opened.device)})
            return pipeline.run(
                job,
                report,
                resume=ranged.resume,
                workers=ranged.workers,
                scheduler=ranged.scheduler,
                seconds=ranged.timelimit,
                part=part,
                strict=opened.strict,
                debug=opened.debug,
            )
        except REFUSALS as error:
            if report.style != "json":
                raise
            if opened.debug:
                report.line(traceback.format_exc())
            report.line(f"error: {one_line(error)}")
            return IMPOSSIBLE


def _is_rendered_here(ranged: RangeOptions) -> bool:
    """Whether this process makes a frame, as far as its options tell."""
    return ranged.workers == 1 and not (ranged.scheduler or ranged.resume or ranged.print_job)


def _as_the_stage_asks(stage: str, names: list[str], aov: str | None, opened: StageOptions, planned: PlanOptions):
    """(outputs, channels, options, notes) with what a RenderSettings prim says wherever the command says nothing."""
    if opened.untrusted:
        if planned.render_settings is not None:
            raise ValueError("--render-settings: not read from an untrusted stage; give --camera, --res and --aov")
        return names, aov, planned, []
    from warp_reflect.stage.render_settings import read_render_settings

    spec = read_render_settings(stage, planned.render_settings, opened.root or "")
    if spec is None:
        return names, aov, planned, []
    if planned.res is None and planned.image_width is None and spec.resolution is not None:
        planned = replace(planned, res="{}x{}".format(*spec.resolution))
    if planned.camera is None and spec.camera:
        planned = replace(planned, camera=spec.camera)
    if aov is None and spec.channels:
        aov = ",".join(spec.channels)
    return names or list(spec.outputs), aov, planned, list(spec.notes)


def _job(stage, names, frames, aov, opened: StageOptions, planned: PlanOptions, ranged: RangeOptions):
    """The options of `render` as a `pipeline.Job`."""
    from warp_reflect.stage.frames import frame_name, has_frame_pattern, parse_frames, snapshot_name

    sides = _sides(ranged)
    kinds = (*(pipeline.PICTURE for _ in names), *sides)
    names = [*names, *sides.values()]
    if not names:
        raise ValueError("no output given; add a file such as out.exr or out.png")
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    channels = tuple(_channel_names(aov)) if aov is not None else None
    if frames is None:
        for name in names:
            if has_frame_pattern(name):
                raise ValueError(f"{name}: has a place for a frame number; add --frames")
        times, files = (None,), (tuple(names),)
    else:
        times = tuple(dict.fromkeys(parse_frames(frames)))
        files = tuple(tuple(frame_name(name, time) for name in names) for time in times)
    every = [name for row in files for name in row]
    if len(set(every)) != len(every):
        raise ValueError(f"the same output is given twice: {', '.join(names)}")
    return Job(
        stage,
        times,
        files,
        load=_load_options(opened, planned, settings),
        camera=planned.camera,
        width=planned.image_width or WIDTH_DEFAULT,
        size=_size(planned.res) if planned.res is not None else None,
        settings=settings,
        method=planned.method,
        channels=channels,
        multi_part=ranged.multi_part,
        kinds=kinds,
        snapshot=snapshot_name(names[0]),
    )


def _sides(ranged: RangeOptions) -> dict[str, str]:
    """Kind to name of the files that are asked for beside the pictures."""
    asked = {pipeline.BOXES: ("--boxes", ranged.boxes, ".json"), pipeline.ST_MAP: ("--st-map", ranged.st_map, ".exr")}
    for flag, name, ending in asked.values():
        if name is not None and not name.lower().endswith(ending):
            raise ValueError(f"{flag}: got '{name}', expected a name that ends in {ending}")
    return {kind: name for kind, (_, name, _) in asked.items() if name is not None}


def _part(text: str | None) -> tuple[int, int]:
    """(k, n) of --part."""
    if text is None:
        return 1, 1
    k, slash, n = text.partition("/")
    if not (slash and k.strip().isdecimal() and n.strip().isdecimal() and 1 <= int(k) <= int(n)):
        raise ValueError(f"--part: got '{text}', expected K/N such as 3/8, with K from 1 to N")
    return int(k), int(n)


def _check_time_limit(seconds: float | None) -> None:
    if seconds is not None and not seconds >= 0.0:
        raise ValueError(f"--timelimit: got {seconds:g}, expected seconds, 0 or more")


def _print_job(kind, job, names, frames, aov, opened, planned, ranged) -> int:
    from warp_reflect.farm import openjd_template

    if kind != "openjd":
        raise ValueError(f"--print-job: got '{kind}', expected openjd")
    options = [*_as_tokens(opened), *_as_tokens(planned)]
    options += ["--aov", aov] if aov is not None else []
    options += ["--multi-part"] if ranged.multi_part else []
    options += [each for kind, name in _sides(ranged).items() for each in ("--" + kind.replace("_", "-"), name)]
    print(json.dumps(openjd_template(job.stage, names, frames, len(job.times), options), indent=2))
    return DONE


def _as_tokens(options) -> list[str]:
    """The command line of an options class, as far as it differs from the defaults."""
    tokens = []
    hints = get_type_hints(type(options), include_extras=True)
    for each in fields(options):
        value = getattr(options, each.name)
        if value == each.default:
            continue
        named = [extra.name for extra in getattr(hints[each.name], "__metadata__", ()) if extra.name]
        flag = named[0][0] if named else f"--{each.name.replace('_', '-')}"
        if isinstance(value, bool):
            tokens.append(flag)
        else:
            for item in value if isinstance(value, list) else [value]:
                tokens += [flag, str(item)]
    return tokens


@Parameter(name="*")
@dataclass
class MirrorOptions:
    """What is a mirror, and how finely it is held."""

    reflector: Annotated[list[str] | None, Parameter(negative=())] = None
    """Make mirrors of the prims, materials or collection that this path, name or pattern (* and ?) names; repeatable."""
    set_: Annotated[list[str] | None, Parameter(name="--set", negative=())] = None
    """A setting, name=value, such as map_resolution=256; repeatable."""
    complexity: Annotated[str | None, Parameter(name=["--complexity", "-c"])] = None
    """low, medium, high or veryhigh: how finely surfaces are tessellated."""


@app.command
def bake(
    stage: str,
    out: str,
    /,
    *,
    opened: StageOptions | None = None,
    mirrors: MirrorOptions | None = None,
) -> int:
    """Draw all mirrors' reflector maps, and environment maps, once: an EXR each, and a layer over the stage to render with.

    Args:
        stage: A USD file; it is not changed.
        out: The layer to write, .usd, .usda or .usdc; the maps lie beside it.
        opened: How the stage is opened.
        mirrors: What is a mirror; give the same options when the layer is rendered.
    """
    from warp_reflect.bake import bake_stage

    opened, mirrors = opened or StageOptions(), mirrors or MirrorOptions()
    if opened.untrusted:
        raise ValueError("--untrusted: a stage is baked by opening it here; render it untrusted, without a bake")
    planned = PlanOptions(reflector=mirrors.reflector, set_=mirrors.set_, complexity=mirrors.complexity)
    settings = _settings(planned)
    device = _open_device(opened.device)
    written = []
    with reporting(None) as report:

        def wrote(prim_path: str, file, size: str) -> None:
            written.append(str(file))
            print(f"{file}: {prim_path}, {size}", flush=True)

        try:
            report.busy("reading " + stage)
            scene = _load(stage, opened, planned, settings, device, None)
            report.busy("drawing maps")
            baked = bake_stage(scene, out, settings, report=wrote)
        except (*REFUSALS, KeyboardInterrupt) as error:
            if not written:
                raise
            if opened.debug:
                report.line(traceback.format_exc())
            report.line(f"error: {one_line(error)}")
            report.line(f"kept {len(written)} finished: {', '.join(written)}")
            return PART_WAY
        report.notes([*scene.notes, *baked.notes])
    done = f"{len(baked.files)} mirror{'s' * (len(baked.files) != 1)} baked"
    if baked.environments:
        done += f", {len(baked.environments)} environment map{'s' * (len(baked.environments) != 1)}"
    print(f"{baked.layer}: {done}, over {stage}")
    return DONE


@app.command
def process(
    stage: str,
    out: str,
    /,
    *,
    frames: Annotated[str | None, Parameter(name=["--frames", "-f"])] = None,
    clip: Annotated[bool, Parameter(negative=())] = False,
    purpose: str = "guide",
    glb: str | None = None,
    resume: Annotated[bool, Parameter(negative=())] = False,
    timelimit: float | None = None,
    progress: str | None = None,
    opened: StageOptions | None = None,
    planned: PlanOptions | None = None,
) -> int:
    """Write what mirrors show as virtual objects, meshes behind the mirrors, into a layer over the stage.

    They are right for the camera they were made for. Traced mirrors have none; a note says which.

    Args:
        stage: A USD file; it is not changed.
        out: The layer to write, .usd, .usda or .usdc.
        frames: Frames such as 101:109x2,120, as time samples; without it the stage's first, as default values.
        clip: Cut virtual objects along the outline of the pixels that show their mirror, so that a renderer that hides the
            mirrors shows the same picture.
        purpose: Of the virtual objects: default, render, proxy or guide, which renderers leave out.
        glb: Write those of the first frame as a binary glTF file, too.
        resume: Keep the frames that the layer has, where it was made from the same stage and options.
        timelimit: Seconds after which no frame is begun.
        progress: As of render.
        opened: How the stage is opened.
        planned: What is simulated, and how.
    """
    from warp_reflect import process as processing
    from warp_reflect.stage.frames import parse_frames

    opened, planned = opened or StageOptions(), planned or PlanOptions()
    if opened.untrusted:
        raise ValueError("--untrusted: a stage is processed by opening it here; render it untrusted instead")
    _check_time_limit(timelimit)
    _, _, planned, notes = _as_the_stage_asks(stage, [out], "", opened, planned)
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    times = (None,) if frames is None else tuple(dict.fromkeys(parse_frames(frames)))
    job = processing.make_job(
        stage,
        out,
        times,
        load=_load_options(opened, planned, settings) | {"device": _open_device(opened.device)},
        camera=planned.camera,
        width=planned.image_width or WIDTH_DEFAULT,
        size=_size(planned.res) if planned.res is not None else None,
        settings=settings,
        method=planned.method,
    )
    wish = processing.Wish(clip, purpose, glb or "")
    with reporting(progress) as report:
        report.notes(notes)
        return processing.run(
            job, wish, report, resume=resume, seconds=timelimit, strict=opened.strict, debug=opened.debug
        )


@app.command
def sweep(
    stage: str,
    folder: str,
    /,
    *,
    camera: Annotated[str | None, Parameter(name=["--camera", "-cam"])] = None,
    image_width: Annotated[int, Parameter(name=["--imageWidth", "-w"])] = 960,
    res: str | None = None,
    rounds: int = 7,
    only: str | None = None,
    threads: int = 0,
    opened: StageOptions | None = None,
    mirrors: MirrorOptions | None = None,
) -> int:
    """Measure what accuracy costs: every technique and setting, its error beside its time, as JSON, CSV, PNG and a page.

    Args:
        stage: A USD file.
        folder: Where results.json, results.csv, pareto.png, contact.png and report.html are written.
        camera: Path or name of a camera.
        image_width: Width in pixels; the height follows from the camera's aspect.
        res: Exact size instead, WIDTHxHEIGHT.
        rounds: Timed frames of each contender.
        only: Contenders to measure, comma-separated: techniques (quadric), settings (grid_share, refine=off), names or
            patterns (Estalella*).
        threads: CPU threads; 0: one per core.
        opened: How the stage is opened.
        mirrors: What is a mirror, and settings that all contenders share.
    """
    opened, mirrors = opened or StageOptions(), mirrors or MirrorOptions()
    planned = PlanOptions(camera, image_width, res, "reference", mirrors.reflector, mirrors.set_, mirrors.complexity)
    settings = _settings(planned).replace(threads=threads)
    _check_size_options(planned)
    if rounds < 1:
        raise ValueError(f"--rounds: got {rounds}, expected 1 or more")
    device = _open_device(opened.device)

    from warp_reflect import sweep as sweeping
    from warp_reflect.settings import COMPLEXITIES
    from warp_reflect.sweep_report import open_folder, write_sweep

    open_folder(folder)
    with reporting(None) as report:

        def tell(text: str) -> None:
            report.busy(text)
            if report.style != "rich":
                report.line(text)

        tell("reading " + stage)
        scene = _load(stage, opened, planned, settings, device, None)
        reference = _make_plan(scene, planned, settings)
        asked = scene, reference.camera, reference.size
        contenders, notes = sweeping.default_contenders(*asked, settings, COMPLEXITIES)
        if only is not None:
            contenders = sweeping.choose(contenders, [name.strip() for name in only.split(",") if name.strip()])

        def read(complexity: str):
            return _load(stage, opened, planned, settings.replace(complexity=complexity), device, None)

        measured = sweeping.run_sweep(*asked, contenders, rounds, tell, read=read)
        measured.notes[:0] = notes
        written = write_sweep(measured, folder)
        report.notes([*scene.notes, *((stage, text) for text in [*measured.notes, *written.notes])])
        for text in measured.failed:
            report.line(f"error: {text}")
    for file in written.files:
        print(file)
    return PART_WAY if measured.failed else DONE


@app.command
def calibrate(*, device: str = "cpu", repeats: int = 3, debug: Annotated[bool, Parameter(negative=())] = False) -> int:
    """Measure in half a minute what the steps of a frame cost on this machine, and keep it for plans to choose by.

    Kept in the user's cache for this processor, device and version, or in the file that the environment variable
    WARP_REFLECT_CALIBRATION names (empty: nowhere). Without it, plans go by the costs of a server core of 2026, or of
    an NVIDIA H100.

    Args:
        device: cpu or cuda:0.
        repeats: Frames of each kind that are timed.
        debug: Show tracebacks.
    """
    from warp_reflect import calibration

    if not 1 <= repeats <= 1000:
        raise ValueError(f"--repeats: got {repeats}, expected 1 to 1000")
    device = _open_device(device)
    calibration.check_writable()
    from warp_reflect.calibrate import measure

    with reporting(None) as report:

        def tell(text: str) -> None:
            report.busy(text)
            if report.style != "rich":
                report.line(text)

        costs = measure(device, repeats, tell)
    file = calibration.store(costs, device)
    print(calibration.table(costs, device))
    print(f"{file}: kept for {calibration.described(device)}")
    return DONE


@app.command
def warmup(
    stage: str | None = None, /, *, opened: StageOptions | None = None, planned: PlanOptions | None = None
) -> int:
    """Compile kernels now, so that the first picture needs not wait for them; Warp keeps them from then on.

    Args:
        stage: A USD file: what its frames need, as planned. Without one: everything, which takes minutes.
        opened: How the stage is opened.
        planned: What is simulated, and how.
    """
    from warp_reflect import warmup as warm

    opened, planned = opened or StageOptions(), planned or PlanOptions()
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    device = _open_device(opened.device)
    with reporting(None) as report:
        if stage is None:
            report.busy("compiling")
            names, seconds = warm.warm_all(device, settings.threads)
        else:
            _, _, planned, notes = _as_the_stage_asks(stage, [], None, opened, planned)
            report.busy("reading " + stage)
            scene = _load(stage, opened, planned, settings, device, None)
            report.busy("compiling")
            made, names, seconds = warm.warm_plan(scene, lambda: _make_plan(scene, planned, settings))
            report.notes([*notes, *scene.notes, *made.notes])
    print("\n".join(names))
    print(f"{len(names)} modules ready in {seconds:.1f} s")
    return DONE


@Parameter(name="*")
@dataclass
class ViewOptions:
    """What is shown, without a window where a file is named."""

    screenshot: str | None = None
    """Write the inspector's view to a PNG."""
    frame_only: Annotated[bool, Parameter(negative=())] = False
    """With --screenshot: the frame alone, which needs no OpenGL."""
    turntable: str | None = None
    """Write a full turn about the mirror to a GIF, or to numbered files such as out.####.png."""
    frames: int = 36
    """Of the turntable."""
    html: str | None = None
    """Write a page that needs nothing else: frame, reference, error map, numbers, plan."""
    time: float | None = None
    """Time code to begin at."""
    pick: Annotated[list[str] | None, Parameter(negative=())] = None
    """A pixel X,Y to ask; repeatable."""
    sweep: str | None = None
    """What `sweep` wrote, a folder or its results.json, for the plot of accuracy against time; else one beside the stage."""


@app.command
def view(
    stage: str,
    /,
    *,
    shown: ViewOptions | None = None,
    opened: StageOptions | None = None,
    planned: PlanOptions | None = None,
) -> int:
    """Inspect a stage: live frames beside the reference, the error in pixels, rays and virtual objects in space.

    Args:
        stage: A USD file.
        shown: What is shown.
        opened: How the stage is opened.
        planned: What is simulated, and how.
    """
    from warp_reflect.viewer import command

    shown, opened, planned = shown or ViewOptions(), opened or StageOptions(), planned or PlanOptions()
    settings = _settings(planned)
    _check_method(planned.method)
    _check_size_options(planned)
    command.check(shown)
    device = _open_device(opened.device)
    with reporting(None) as report:
        report.busy("reading " + stage)
        scene = _load(stage, opened, planned, settings, device, shown.time)
        report.busy("rendering")
        size = _size(planned.res) if planned.res is not None else None
        session = command.make_session(scene, planned.camera, settings, planned.method, size, planned.image_width)
        report.notes([*scene.notes, *session.plan.notes])
        for text in command.run(session, shown, print):
            report.line(text)
    return DONE


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
        _tell(f"error: {one_line(error)}")
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
        _tell(f"error: {one_line(error)}")
        return IMPOSSIBLE
    except KeyboardInterrupt:
        _tell("error: interrupted, nothing was written")
        return INTERRUPTED


def _say_fault(kind, error, _trace) -> None:
    _tell(f"error: {kind.__name__}: {one_line(error)} (a fault of warp-reflect: --debug shows where)")


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# Arguments.


def _settings(planned: PlanOptions):
    from warp_reflect.settings import Settings

    changes = {}
    for item in planned.set_ or []:
        name, equals, value = item.partition("=")
        if not equals:
            raise ValueError(f"--set: got '{item}', expected name=value with a name of {', '.join(Settings.names())}")
        changes[name.strip()] = value.strip()
    for name in ("complexity", "max_error_px", "budget_ms"):
        if getattr(planned, name) is not None:
            changes[name] = getattr(planned, name)
    return Settings().replace(**changes)


def _channel_names(text: str) -> list[str]:
    """The channels of --aov by our names, checked before a frame is rendered for them."""
    from warp_reflect.channels import own_name

    names = list(dict.fromkeys(own_name(name.strip()) for name in text.split(",") if name.strip()))
    if not names:
        raise ValueError(f"--aov: got '{text}', expected channels such as RGBA,reflectedPoint")
    return names


def _check_method(method: str) -> None:
    from warp_reflect.planner import METHODS
    from warp_reflect.techniques import TECHNIQUES

    valid = [*METHODS, *TECHNIQUES]
    if method not in valid:
        near = difflib.get_close_matches(method, valid, n=3, cutoff=0.4)
        nearest = f"nearest: {', '.join(near)}; " if near else ""
        raise ValueError(f"--method: got '{method}'; {nearest}expected one of {', '.join(valid)}")


def _check_size_options(planned: PlanOptions) -> None:
    if planned.image_width is not None and not 1 <= planned.image_width <= SIDE_MAX:
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


def _load_options(opened: StageOptions, planned: PlanOptions, settings) -> dict:
    """What `load_stage` gets beside the stage, the time and the device."""
    return {
        "purposes": _purposes(opened.purposes),
        "complexity": settings.complexity,
        "strict": opened.strict,
        "reflectors": tuple(planned.reflector or ()),
        "untrusted": opened.untrusted,
        "root": opened.root or "",
    }


def _load(stage: str, opened: StageOptions, planned: PlanOptions, settings, device: str, time: float | None):
    import warp_reflect as wr

    return wr.load_stage(stage, device=device, time=time, **_load_options(opened, planned, settings))


def _make_plan(scene, planned: PlanOptions, settings):
    size = _size(planned.res) if planned.res is not None else None
    width = planned.image_width or WIDTH_DEFAULT
    return plan_scene(scene, planned.camera, width, size, settings, planned.method)


if __name__ == "__main__":
    sys.exit(main())
