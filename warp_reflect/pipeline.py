"""Frame ranges: many frames of one stage, resumable, rendered by this process or by the workers of a cluster.

A `Job` names all that its frames depend on, and every frame is a function of the job and its place in the range alone:
what it takes from the frame before it is made anew where that frame is not at hand. So a resumed range, a part of a
range and a range cut over processes are made of the same bytes as one rendered in one go.

Files appear whole, synced, under their final names (`images`). While a frame is made its files are claimed by a lock
(`claimed`): of two processes with the same output one makes the frame, the other says so and goes on to the next.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import warp_reflect as wr
from warp_reflect import images, kernels, seen
from warp_reflect.progress import Report, statistics_line
from warp_reflect.realised import realised_error

KEY = "warp_reflect:key"  # header entry: what the frame was made from, see `frame_key`
DONE, PART_WAY, IMPOSSIBLE = 0, 1, 2
# What a file of a frame holds: the frame, boxes of the objects seen in mirrors (`seen`), or where they are seen directly.
KINDS = PICTURE, BOXES, ST_MAP = "picture", "boxes", "st_map"
# What a stage, a disk or a device can do to one frame; anything else is a fault of this program and ends the range.
FRAME_FAILURES = (ValueError, LookupError, ArithmeticError, OSError, RuntimeError, MemoryError)
# How a stage is opened that says nothing about what its frames show.
NOT_SEEN = ("device", "strict", "untrusted", "root")
# Frames after which what is reused from frame to frame (`reuse_px`) starts afresh, so that a frame depends on few others.
REUSE_RUN = 16
RECENT = 3  # frames that the time of the next one is judged by
SLACK = 1.1  # of that judgement: frames of a range differ
SIDE_MAX = 32768  # pixels; what the image readers of this package accept back


@dataclass(frozen=True)
class Job:
    """A range of frames.

    Attributes:
        stage: The stage's file.
        times: Time codes, in the order they are rendered; (None,): the stage's first.
        files: Per time the files to write.
        load: What `load_stage` gets beside stage and time.
        camera: Path or name; None: the stage's first.
        width: Of the picture; the height follows from the camera. [pixels]
        size: (width, height) instead. [pixels]
        settings: The knobs.
        method: See `make_plan`.
        channels: Of an EXR; None: all.
        multi_part: EXR of one part per channel group.
        numbers: The frames' places in the whole range; empty: this is the whole range.
        folder: What relative names are relative to.
        kinds: What each of a frame's files holds, of `KINDS`; empty: all are pictures.
        snapshot: Where a picture of the last finished frame is written when asked for by a signal.
    """

    stage: str
    times: tuple[float | None, ...]
    files: tuple[tuple[str, ...], ...]
    load: dict = field(default_factory=dict)
    camera: str | None = None
    width: int = 960
    size: tuple[int, int] | None = None
    settings: wr.Settings = field(default_factory=wr.Settings)
    method: str = "auto"
    channels: tuple[str, ...] | None = None
    multi_part: bool = False
    numbers: tuple[int, ...] = ()
    kinds: tuple[str, ...] = ()
    folder: str = field(default_factory=os.getcwd)
    snapshot: str = "snapshot.png"

    def label(self, place: int) -> str:
        """What messages call a frame."""
        time_code = self.times[place]
        return self.stage if time_code is None else f"frame {time_code:g}"

    def cut(self, places: list[int]) -> tuple[Job, list[int]]:
        """The same job with nothing but some of its frames and those they depend on, and their places in it."""
        kept = sorted({each for place in places for each in range(self.first_needed(place), place + 1)})
        at = {place: k for k, place in enumerate(kept)}
        part = dataclasses.replace(
            self,
            times=tuple(self.times[k] for k in kept),
            files=tuple(self.files[k] for k in kept),
            numbers=tuple(self.numbers[k] if self.numbers else k for k in kept),
        )
        return part, [at[place] for place in places]

    def starts_run(self, place: int) -> bool:
        """Whether nothing is reused from the frame before."""
        return not self.reuses or (self.numbers[place] if self.numbers else place) % REUSE_RUN == 0

    def first_needed(self, place: int) -> int:
        """The first of the frames that a frame depends on: itself, the one before, or all of its run and one more."""
        while place and not self.starts_run(place):
            place -= 1
        return max(place - 1, 0) if self.looks_back else place

    def outputs(self, place: int) -> list[tuple[str, str]]:
        """(file, kind) of a frame."""
        names = self.files[place]
        return list(zip(names, self.kinds or (PICTURE,) * len(names), strict=True))

    @property
    def looks_back(self) -> bool:
        """Whether a frame depends on the one before: through its motion channel, or by reusing what that one found."""
        asked = self.channels is None or any(name.startswith("reflectionMotion") for name in self.channels)
        return self.reuses or (self.has_data and asked)

    @property
    def has_data(self) -> bool:
        """Whether data channels are written."""
        return any(kind == PICTURE and name.lower().endswith(".exr") for name, kind in self.outputs(0))

    @property
    def reuses(self) -> bool:
        """Whether frames start from what the ones before found."""
        return self.settings.reuse_px > 0.0


@dataclass(frozen=True)
class Outcome:
    """What became of one frame of a job.

    Attributes:
        place: Its index in the job's times.
        state: "written", "kept" (it was done), "taken" (another process is at it) or "failed".
        text: Of a failure: why, one line. Of a written frame: size and counts.
        trace: Of a failure: the traceback.
        ms: Time of the rendering alone. [ms]
        seconds: Time of everything. [s]
        notes: (prim path, text) of what the user should know.
        process: Who did it.
    """

    place: int
    state: str
    text: str = ""
    trace: str = ""
    ms: float = 0.0
    seconds: float = 0.0
    notes: tuple[tuple[str, str], ...] = ()
    process: int = field(default_factory=os.getpid)


class OpenJob:
    """A job with its stage open: what is made once, and handed from frame to frame.

    Attributes:
        job: The job.
        plan: Of the last frame rendered; its `scene` is the stage at that frame's time.
    """

    def __init__(self, job: Job, place: int = 0):
        self.job = job
        self.plan: wr.Plan | None = None
        if os.path.exists(job.stage):
            device = job.load.get("device", "cpu")
            kernels.begin(kernels.of_view(job.settings, device), device)
            kernels.keep_last(kernels.of_eye(job.settings, device), device)
        self._scene = wr.load_stage(job.stage, time=job.times[place], **job.load)
        self._last: tuple[float | None, wr.Frame] | None = None

    def plan_at(self, place: int) -> wr.Plan:
        """The plan of a frame: decided anew, prepared from what the last one had."""
        self._scene = self._scene.at(self.job.times[place])
        if self.plan is None or self.plan.scene is not self._scene:
            job = self.job
            self.plan = plan_scene(
                self._scene, job.camera, job.width, job.size, job.settings, job.method, earlier=self.plan
            )
        return self.plan

    def render(self, place: int) -> wr.Frame:
        """A frame; the one before it is given to it where it looks back, and rendered first where it is not at hand."""
        previous = self._before(place) if place and self.job.looks_back else None
        self._last = None  # so that two frames are held at most, not three
        frame = self._draw(place, previous)
        self._last = (self.job.times[place], frame)
        return frame

    def _before(self, place: int) -> wr.Frame:
        """The frame before, as a frame takes it: at the start of a run with nothing that it reused itself."""
        starts, last = self.job.starts_run(place), self._last
        if last is not None and last[0] == self.job.times[place - 1] and not (self.job.reuses and starts):
            return last[1]
        self._last = None
        return self._draw(place - 1, None) if starts else self.render(place - 1)

    def _draw(self, place: int, previous: wr.Frame | None) -> wr.Frame:
        plan = self.plan_at(place)
        if previous is None and self.job.has_data and self.job.channels is None:
            kernels.begin([*kernels.of_plan(plan), *kernels.of_channels(plan)], plan.scene.device)
        return wr.render_frame(plan.scene, plan, previous=previous)


def plan_scene(
    scene: wr.Scene,
    camera: str | None,
    width: int,
    size: tuple[int, int] | None,
    settings: wr.Settings,
    method: str,
    earlier: wr.Plan | None = None,
) -> wr.Plan:
    """`make_plan` at a width whose height follows from the camera's film, or at an exact size, in pixels."""
    from warp_reflect.planner import find_camera

    if size is None:
        path = find_camera(scene, camera, (1, 1)).path
        film = next(each for each in scene.data.cameras if each.path == path)
        height = width * film.vertical_aperture / film.horizontal_aperture
        size = width, min(max(round(height), 1), SIDE_MAX)
    return wr.make_plan(scene, camera=camera, size=size, settings=settings, method=method, earlier=earlier)


# Frames that are done.


def frame_key(job: Job, place: int, digest: str) -> str:
    """What a frame is made from, as a number in hexadecimal: equal keys, equal frames (on one kind of device).

    Args:
        job: The job.
        place: Index of the frame.
        digest: Of the stage's files, `stage.identity.stage_digest`.
    """
    settings = dataclasses.asdict(job.settings)
    settings.pop("threads")  # any number of threads gives the same bits
    told = {
        "version": wr.__version__,
        "stage": digest,
        "time": job.times[place],
        "before": job.times[place - 1] if place and job.looks_back else None,
        "load": {name: value for name, value in sorted(job.load.items()) if name not in NOT_SEEN},
        "camera": job.camera,
        "size": job.size or job.width,
        "settings": settings,
        "method": job.method,
        "channels": job.channels,
        "multi_part": job.multi_part,
    }
    return hashlib.blake2b(json.dumps(told, sort_keys=True).encode(), digest_size=16).hexdigest()


def is_done(job: Job, place: int, digest: str) -> bool:
    """Whether every file of a frame is there, whole to the last pixel, and was made from the same."""
    key = frame_key(job, place, digest)
    try:
        return all(_key_of(name, kind) == key for name, kind in job.outputs(place))
    except OSError:
        return False


def _key_of(name: str, kind: str) -> object:
    from warp_reflect.seen import read_boxes

    return (read_boxes(name)["info"] if kind == BOXES else images.check_whole(name)).get(KEY)


@contextlib.contextmanager
def claimed(names: Iterable[str]) -> Iterator[bool]:
    """Hold the files of a frame against other processes while it is made; gives False where another holds one.

    A hidden file `.NAME.lock` beside each is locked (flock), so that a claim ends with its process however that ends.
    Where the system has no such locks nothing is held; files are renamed into place, so that they are whole even then.
    """
    with contextlib.ExitStack() as held:
        # In one order everywhere: two processes never hold one each of two.
        yield all(held.enter_context(_locked(name)) for name in sorted(map(os.path.realpath, names)))


@contextlib.contextmanager
def _locked(name: str) -> Iterator[bool]:
    try:
        import fcntl
    except ImportError:  # Windows
        yield True
        return
    folder, base = os.path.split(name)
    lock = os.path.join(folder, f".{base}.lock")
    while True:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(handle)
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                yield False
                return
            if error.errno not in (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS):
                raise
            yield True  # a file system without locks
            return
        # The holder before us may have removed the file between our opening and our locking it.
        if _is_file(handle, lock):
            break
        os.close(handle)
    try:
        yield True
    finally:
        os.unlink(lock)
        os.close(handle)


def _is_file(handle: int, name: str) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(name))
    except FileNotFoundError:
        return False


# Rendering.


def render_places(
    job: Job,
    places: Iterable[int],
    digest: str,
    opened: list[OpenJob],
    resume: bool = False,
    is_stopped: Callable[[], bool] = lambda: False,
    deadline: float | None = None,
) -> Iterator[Outcome]:
    """Render some frames of a job here, one `Outcome` each, until stopped.

    Args:
        job: The job.
        places: Indices of the frames.
        digest: Of the stage's files.
        opened: Holds the job's `OpenJob` from one call to the next; filled here when a frame is first rendered.
        resume: Keep frames that are done.
        is_stopped: Asked before each frame.
        deadline: No frame is begun that would end later, judged by the last ones. [seconds since 1970]
    """
    recent: deque[float] = deque(maxlen=RECENT)
    for place in places:
        if is_stopped() or (deadline is not None and time.time() + SLACK * max(recent, default=0.0) > deadline):
            return
        start = time.perf_counter()
        try:
            with claimed(job.files[place]) as free:
                if not free:
                    outcome = Outcome(place, "taken")
                elif resume and is_done(job, place, digest):
                    outcome = Outcome(place, "kept")
                else:
                    for name in job.files[place] if resume else ():
                        images.remove_parts(name)
                    if not opened:
                        opened.append(OpenJob(job, place))
                    outcome = _render(opened[0], place, digest)
                    recent.append(time.perf_counter() - start)
        except FRAME_FAILURES as error:
            outcome = Outcome(place, "failed", one_line(error), traceback.format_exc())
        yield dataclasses.replace(outcome, seconds=time.perf_counter() - start)


def _render(opened: OpenJob, place: int, digest: str) -> Outcome:
    job = opened.job
    start = time.perf_counter()
    frame = opened.render(place)
    rendered_ms = 1000.0 * (time.perf_counter() - start)
    attributes = {KEY: frame_key(job, place, digest)}
    for name, kind in job.outputs(place):
        if kind == PICTURE:
            frame.write(name, list(job.channels) if job.channels else None, attributes, job.multi_part)
        elif kind == ST_MAP:
            seen.write_st_map(name, frame, attributes)
        else:
            number = (job.numbers[place] if job.numbers else place) + 1
            picture = next((each for each, other in job.outputs(place) if other == PICTURE), "")
            relative = os.path.relpath(picture, os.path.dirname(name) or ".") if picture else ""
            seen.write_boxes(name, seen.coco_boxes(frame, number, relative, attributes))
    width, height = frame.camera.size
    notes = tuple((note.path, note.text) for note in [*frame.scene.notes, *frame.plan.notes])
    text = f"{width}x{height}, {rendered_ms:.0f} ms{statistics_line(frame.statistics)}{_came_out(frame)}"
    return Outcome(place, "written", text, ms=rendered_ms, notes=notes)


def _came_out(frame: wr.Frame) -> str:
    """What a request for an error or a time came out as; empty without one."""
    settings = frame.plan.settings
    if settings.max_error_px <= 0.0 and settings.budget_ms <= 0.0:
        return ""
    predicted = frame.plan.predicted
    told = f"; predicted {frame.expected_ms:.3g} ms, {predicted['error_px']:.2g} px"
    return f"{told}; realised {frame.spent_ms:.3g} ms, {realised_error(frame)}"


def part_of(count: int, part: tuple[int, int]) -> range:
    """The indices of part k of n (1-based) of a range: consecutive, all parts within one of the same length."""
    k, n = part
    return range(count * (k - 1) // n, count * k // n)


def run(
    job: Job,
    report: Report,
    *,
    resume: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    seconds: float | None = None,
    part: tuple[int, int] = (1, 1),
    strict: bool = False,
    debug: bool = False,
) -> int:
    """Render a job and tell of it; returns the exit code.

    0: every frame is done. 1: frames failed, are another process's, or the time was over; 128 + n: signal n ended it
    after the frame at hand. 2 where a job of one frame failed.

    Args:
        job: The job.
        report: Where to tell.
        resume: Keep frames that are done; see `is_done`.
        workers: Processes; more than one: a cluster on this machine.
        scheduler: Address of a running dask scheduler to use instead.
        seconds: From now; no frame is begun that would end later.
        part: (k, n): only the k-th of n parts; frames keep their neighbours in the whole range.
        strict: Refuse frames outside of the stage's range.
        debug: Tell tracebacks.

    Raises:
        ValueError, OSError: the stage, the camera or the outputs cannot be used, or the cluster cannot be reached.
    """
    from warp_reflect.stage.write import check_place

    deadline = None if seconds is None else time.time() + seconds
    for name, kind in dict.fromkeys(job.outputs(0)):
        if kind == BOXES:
            check_place(Path(name))
        else:
            images.check_writable(name)
    report.busy(f"reading {job.stage}")
    digest = digest_of(job)
    places = list(part_of(len(job.times), part))
    if resume:
        report.busy("looking at what is done")
        kept = {place for place in places if is_done(job, place, digest)}
        places = [place for place in places if place not in kept]
        if kept:
            report.line(f"resume: {len(kept):,} of {len(kept) + len(places):,} frames are done")
    report.begin(len(places))
    if not places:
        report.end(DONE)
        return DONE
    on_cluster = scheduler is not None or workers > 1
    opened = [OpenJob(job, places[0])]
    report.busy("planning")
    plan = opened[0].plan_at(places[0])
    report.notes([*plan.scene.notes, *plan.notes])
    check_range(job, places, plan.scene.data.time_range, strict, report)
    with listening(job, report) as asked:
        if on_cluster:
            from warp_reflect.cluster import render_on_cluster

            opened = []  # the workers have their own
            source = render_on_cluster(
                job, places, digest, resume, asked.is_stopped, deadline, workers, scheduler, report
            )
        else:
            source = render_places(job, places, digest, opened, resume, asked.is_stopped, deadline)
        states: dict[int, str] = {}
        tell_all(source, job, report, asked, states, debug)
        taken = [place for place in places if states.get(place) == "taken"]
        if resume and taken:
            # Whoever was at them may have finished them since.
            again = render_places(job, taken, digest, opened, True, asked.is_stopped, deadline)
            tell_all(again, job, report, asked, states, debug)
    return conclude(job, digest, places, states, asked, report)


def digest_of(job: Job) -> str:
    """`stage_digest` of a job's stage."""
    from warp_reflect.stage.identity import stage_digest

    return stage_digest(job.stage, job.load.get("root", ""), job.load.get("untrusted", False))


def _has_changed(job: Job, digest: str) -> bool:
    """Whether the stage's files are others than they were, or cannot be read any more."""
    try:
        return digest_of(job) != digest
    except (OSError, ValueError):
        return True


def tell_all(source, job: Job, report: Report, asked: Asked, states: dict[int, str], debug: bool) -> None:
    """Tell of outcomes as they come; where a second signal breaks off, of how far it got."""
    try:
        for outcome in source:
            states[outcome.place] = outcome.state
            if outcome.state == "written":
                asked.finished = job.files[outcome.place]
            if debug and outcome.trace:
                report.line(outcome.trace.rstrip())
            report.frame(job, outcome)
    except KeyboardInterrupt:
        asked.signal = asked.signal or signal.SIGINT
    except ConnectionError as error:
        asked.lost = one_line(error)


def conclude(job: Job, digest: str, places: list[int], states: dict[int, str], asked: Asked, report: Report) -> int:
    """Say what is missing or out of date and how to go on; returns the exit code."""
    written = [name for place in places if states.get(place) == "written" for name in job.files[place]]
    written = list(dict.fromkeys(written))
    bad = [place for place in places if states.get(place) in ("failed", "taken")]
    left = len(places) - len(states)
    # One frame is over before anybody could change what it reads, and a look at a stage takes as long as a small picture.
    has_changed = len(places) > 1 and bool(written) and _has_changed(job, digest)
    code = PART_WAY if bad or left or has_changed else DONE
    if bad and len(job.times) == 1 and states.get(0) == "failed":
        code = IMPOSSIBLE
    elif bad and written:
        report.line(f"kept {len(written):,} finished file{'s' if len(written) > 1 else ''}: {_shortened(written)}")
    if has_changed:
        report.line(
            f"{job.stage}: its files changed while it was rendered; frames may show what they were: the same command with "
            "--resume makes those anew"
        )
    if left:
        why = f"stopped by {asked.signal.name}" if asked.signal else asked.lost or "stopped by the time limit"
        report.line(
            f"{why}: from {job.label(next(place for place in places if place not in states))} on "
            f"{left:,} of {len(places):,} frames are left; the same command with --resume goes on"
        )
        if asked.signal:
            code = 128 + asked.signal
    report.end(code)
    return code


def check_range(job: Job, places: list[int], time_range, strict: bool, report: Report) -> None:
    """Tell of frames outside of the stage's range; where strict, refuse them by a ValueError."""
    if time_range is None:
        return
    first, last = time_range
    codes = (job.times[place] for place in places)
    outside = [code for code in codes if code is not None and not first <= code <= last]
    if not outside:
        return
    text = (
        f"{len(outside):,} of {len(places):,} frames lie outside of its time codes {first:g} to {last:g} "
        f"(from {outside[0]:g} on)"
    )
    if strict:
        raise ValueError(f"--frames: {job.stage}: {text}; without --strict it holds its values there")
    report.line(f"note: {job.stage}: {text}; it holds its values there")


def one_line(error: BaseException) -> str:
    """An exception as one line."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, MemoryError):
        return f"not enough memory {error}".strip()
    # str() of a KeyError is its repr.
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split()) or type(error).__name__


def _shortened(names: list[str]) -> str:
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]} ... {names[-1]}"


# Signals.


@dataclass
class Asked:
    """What signals asked for.

    Attributes:
        signal: The one that asked to stop.
        finished: Files of the last frame finished here.
        lost: What went away, so that no frame can be made any more.
    """

    signal: signal.Signals | None = None
    finished: tuple[str, ...] = ()
    lost: str = ""

    def is_stopped(self) -> bool:
        """Whether no further frame is to be begun."""
        return self.signal is not None


@contextlib.contextmanager
def listening(job: Job, report: Report) -> Iterator[Asked]:
    """Answer signals while a job runs: SIGINT and SIGTERM stop it after the frame at hand, at once the second time.

    SIGUSR1 writes the last finished frame as `OUTPUT.snapshot.png`. Only the main thread can listen; elsewhere nothing
    is changed.
    """
    asked = Asked()

    def stop(number: int, _frame) -> None:
        if asked.signal is not None:
            raise KeyboardInterrupt
        asked.signal = signal.Signals(number)
        report.urgent(f"{asked.signal.name}: the frame at hand is finished first; once more stops at once")

    def snapshot(_number: int, _frame) -> None:
        report.urgent(_snapshot(job, asked.finished))

    wanted = {"SIGINT": stop, "SIGTERM": stop, "SIGUSR1": snapshot}
    found = {getattr(signal, name): handler for name, handler in wanted.items() if hasattr(signal, name)}
    if threading.current_thread() is not threading.main_thread():
        found = {}
    before = {number: signal.signal(number, handler) for number, handler in found.items()}
    try:
        yield asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _snapshot(job: Job, finished: tuple[str, ...]) -> str:
    """Write the picture of finished files as a PNG; what to say about it."""
    if not finished:
        return "snapshot: no frame is finished yet"
    try:
        picture = next((file for file in finished if file.lower().endswith(".png")), None)
        if picture is not None:
            rgb = images.read_image(picture).rgb
        else:
            channels, _ = images.read_exr(finished[0])
            if not set("RGB") <= channels.keys():
                return f"snapshot: {finished[0]} has no channels R, G and B"
            rgb = np.stack([channels[letter] for letter in "RGB"], axis=-1)
        images.write_png(job.snapshot, rgb)
    except OSError as error:
        return f"snapshot: {one_line(error)}"
    return f"snapshot: {job.snapshot} shows {finished[0]}"
