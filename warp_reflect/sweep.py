"""What accuracy costs in time: every applicable technique and setting on one stage, its error beside its time.

The contenders take turns in one process, on the same threads, along the same short camera path, and each is judged
against the traced reference of the same camera. Times are wall clock; the medians of rounds are compared, and their
ratios say more than they do.
"""

from __future__ import annotations

import dataclasses
import fnmatch
import importlib.metadata
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import warp as wp

from warp_reflect import __version__
from warp_reflect.channels import POINTS
from warp_reflect.devices import processor
from warp_reflect.frame import Frame, render_frame
from warp_reflect.images import srgb_from_linear
from warp_reflect.launch import thread_count
from warp_reflect.layers import Camera
from warp_reflect.metrics import Comparison, PixelClass, compare_frames
from warp_reflect.planner import Plan, find_camera, make_plan
from warp_reflect.realised import as_points
from warp_reflect.scene import Scene
from warp_reflect.settings import GRID_KINDS, REFINEMENTS, Settings
from warp_reflect.techniques import TECHNIQUES

REFERENCE = "reference"
# Estalella et al. 2005, figures 7 and 8.
GRID_SHARES = (0.041, 0.055, 0.096, 0.143)
MIDPOINT_ITERATIONS = (3, 5, 7, 9)
ESTALELLA = "Estalella 2005"
LAGES_MIGUEL = "Lages Miguel 2014"
OFEK = "Ofek 1998"
NEWTON_ITERATIONS = (1, 2, 3, 4)
ERRORS_PX = (0.1, 0.5, 2.0)
MAP_RESOLUTIONS = (32, 64, 128, 256, 512, 1024)
EDGES_PX = (0.0, 0.1, 0.25, 1.0)
REUSES_PX = (0.25, 0.5, 1.0)
ENVIRONMENT_RESOLUTIONS = (32, 64, 128, 256, 512)
REM_COUNTS = (1, 2, 3, 4)
REM_LIMITS = (1, 4, 16)
PARALLAX_STEPS = (0, 4, 12, 24)
FIELD_CELLS = (64, 128, 256)  # in the scene's size
# Which techniques hear of a knob; those that are not there are left out.
FORWARD = ("planar", "quadric", "reflector_map", "explosion_map")
SEARCHED = ("reflector_map",)
KEEPING = ("quadric", "reflector_map")  # keep virtual vertices from frame to frame
MAPPED = ("environment", "layered_environment")
# Of the camera about the mirrors' middle, per frame: a slow walk some metres away. What is kept from frame to frame is
# kept for such; a brisk one (0.01) leaves little of it.
STEP_RADIANS = 0.002
FLIP_MARGIN = 16  # pixels about the mirrors; FLIP's filters reach 10 at 67 pixels a degree
CPU = "cpu"  # among a frame's timings, beside its stages
CROP_SIDE = 640  # pixels of a row's picture, above which it is shrunk
RAY_STEP = 1.0e-4  # of the scene's size, along the normal: Embree's rays must not meet their own facet
VERSIONS = ("warp-lang", "numpy", "usd-core", "embreex", "flip-evaluator", "matplotlib")


@dataclass(frozen=True)
class Contender:
    """One way to make the picture.

    Attributes:
        method: As for `make_plan`.
        warm: Every frame starts from the one before; else each stands for itself.
        source: The paper whose settings these are.
    """

    name: str
    method: str
    settings: Settings
    warm: bool = False
    source: str = ""


@dataclass
class Row:
    """One contender's cost and its error against the reference of the same camera.

    Times are in milliseconds of wall clock; `reflect` is all that depends on the technique, `frame` the whole frame without
    preparation. Shares are of the interior mirror pixels (`metrics.Comparison`).
    """

    name: str
    method: str
    technique: str
    """Of the mirrors in view, comma-separated."""
    source: str
    warm: bool
    settings: dict
    """What differs from the defaults."""
    reflect_ms: float = 0.0
    reflect_p95_ms: float = 0.0
    frame_ms: float = 0.0
    frame_p95_ms: float = 0.0
    frame_cpu_ms: float = 0.0
    """Processor time of the whole frame, all threads together: hardly changes when others use the machine."""
    first_ms: float = 0.0
    """The first frame, preparation included, once all kernels are loaded."""
    prepare_ms: float = 0.0
    """Its view-independent part; a row after others finds made what they share in the scene, such as the BVH."""
    compile_ms: float = 0.0
    """What the first frame took longer where kernels had to be compiled, or loaded from the cache, for it."""
    predicted_ms: float = 0.0
    """`budget.predict`, of the mirrors in view: of a frame among others for warm rows, of a first one else."""
    predicted_px: float = 0.0
    """Likewise: what 95 % of the pixels were predicted to stay below, of the worst mirror."""
    prepared_bytes: int = 0
    """Arrays that the technique holds from frame to frame, on the host and the device; the scene's are shared."""
    identical_share: float = 0.0
    off_share: float = 0.0
    """Not within half a pixel of the truth: shifted by more, wrong, unmatched or unanswered."""
    wrong_share: float = 0.0
    error_mean_px: float | None = None
    """Pixel errors are of all pixels that show the right prim, identical ones counted as 0; None: no pixel does."""
    error_median_px: float | None = None
    error_p95_px: float | None = None
    error_max_px: float | None = None
    angle_median_deg: float | None = None
    """Between the directions from the mirror to what is shown and to what should be; None: nothing is shown."""
    angle_p95_deg: float | None = None
    angle_max_deg: float | None = None
    psnr_db: float | None = None
    """Of the sRGB picture; None: equal."""
    flip: float | None = None
    """Mean over the mirrors' pixels; None: flip-evaluator is not installed."""
    bvh_share: float = 0.0
    """Mirror pixels that were traced."""
    reused_share: float = 0.0
    """Virtual vertices kept from the frame before."""
    dominated_by: str = ""
    """The fastest row that takes less time and is off at no more pixels."""
    statistics: dict = field(default_factory=dict)
    steps_ms: dict = field(default_factory=dict)
    picture: np.ndarray | None = field(default=None, repr=False)
    """uint8 [h, w, 3], sRGB, the mirrors' part of the frame."""
    error_map: np.ndarray | None = field(default=None, repr=False)
    """float32 [h, w]: pixel error; infinite where another thing is shown, NaN off the mirrors."""

    def to_json(self) -> dict:
        """Everything but the pictures, as plain Python."""
        return {
            each.name: getattr(self, each.name)
            for each in dataclasses.fields(self)
            if each.name not in ("picture", "error_map")
        }


@dataclass
class Sweep:
    """The rows of a stage and what they were measured on."""

    stage: str
    camera: str
    size: tuple[int, int]
    rounds: int
    step_radians: float
    threads: int
    triangles: int
    vertices: int
    mirror_pixels: int
    interior_pixels: int
    machine: dict
    rows: list[Row] = field(default_factory=list)
    embree_ms: float | None = None
    """The mirror rays of the last camera through Embree, hits alone, one thread."""
    embree_identical: float | None = None
    notes: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    def row(self, name: str) -> Row:
        """The row of a contender.

        Raises:
            KeyError: no such row.
        """
        for row in self.rows:
            if row.name == name:
                return row
        raise KeyError(f"'{name}'; rows: {', '.join(row.name for row in self.rows)}")

    def to_json(self) -> dict:
        """As `results.json` holds it."""
        numbers = {each.name: getattr(self, each.name) for each in dataclasses.fields(self)}
        return {"version": __version__} | numbers | {"rows": [row.to_json() for row in self.rows]}


def default_contenders(
    scene: Scene,
    camera: str | Camera | None,
    size: tuple[int, int],
    base: Settings | None = None,
    complexities: Iterable[str] = (),
) -> tuple[list[Contender], list[str]]:
    """Every technique that applies to a mirror in view, with each of its settings; and why others are left out.

    Args:
        base: What all share unless their name says otherwise; None: the defaults.
        complexities: Tessellations to read the stage at, beside that of the scene; see `run_sweep`.

    Returns:
        (contenders, the reference first; notes).
    """
    base = (base or Settings()).replace(occlusion="exact")
    found = [Contender(REFERENCE, REFERENCE, base)]
    notes = []
    usable = []
    for name in TECHNIQUES:
        rows = [row for row in make_plan(scene, camera, size, base, name).rows if row.pixels]
        if name == "raytraced" or not rows:
            continue
        if any(row.technique == name for row in rows):
            usable.append(name)
        else:
            notes.append(f"{name}: left out; {rows[0].reason}")

    def add(method: str, warm: bool = False, **changes) -> None:
        if method in (*usable, "auto"):
            name = " ".join([method, *(f"{knob}={value}" for knob, value in changes.items()), *(["warm"] * warm)])
            found.append(Contender(name, method, base.replace(**changes), warm))

    if usable:
        add("auto")
        add("auto", warm=True)
        found += [each for each in paper_contenders(base) if each.method in usable]
        for complexity in complexities:
            add("auto", complexity=complexity)
    for method in usable:
        add(method)
        add(method, warm=True)
        if method in FORWARD:
            add(method, refine="off")
            add(method, refine="off", edge_px=0.0)
            for refine in set(REFINEMENTS) - {"exact", "off"}:
                add(method, refine=refine)
    for refine in ("exact", "off"):
        for method in SEARCHED:
            # Refined, the kinds differ in time alone, and hardly: one of them shows it.
            for kind in GRID_KINDS if refine == "off" else GRID_KINDS[:1]:
                for share in GRID_SHARES:
                    add(method, grid_kind=kind, grid_share=share, refine=refine)
            for error in ERRORS_PX:
                add(method, grid_error_px=error, refine=refine)
            for search, counts in (("midpoint", MIDPOINT_ITERATIONS), ("newton", NEWTON_ITERATIONS)):
                for count in counts:
                    add(method, search=search, iterations=count, refine=refine)
            for resolution in MAP_RESOLUTIONS:
                add(method, map_resolution=resolution, refine=refine)
        for method in KEEPING:
            for edge in EDGES_PX:
                add(method, edge_px=edge, refine=refine)
            for reuse in REUSES_PX:
                add(method, warm=True, reuse_px=reuse, refine=refine)
        add("explosion_map", explosion_walk=0, refine=refine)
    for method in MAPPED:
        for resolution in ENVIRONMENT_RESOLUTIONS:
            add(method, environment_resolution=resolution)
        add(method, warm=True, environment_update="frame")
    for knob, values in (("rem_count", REM_COUNTS), ("rem_limit", REM_LIMITS), ("parallax_steps", PARALLAX_STEPS)):
        for value in values:
            add("layered_environment", **{knob: value})
    mirrors = {row.reflector.part for row in make_plan(scene, camera, size, base).rows if row.pixels}
    if mirrors & set(scene.moving_parts):  # a field holds what never moves
        add("layered_environment", local_rays="field")
        for cells in FIELD_CELLS:
            add("layered_environment", local_rays="field", field_cell=float(f"{scene.size / cells:.2g}"))
    seen: dict[tuple, Contender] = {}
    for each in found:
        seen.setdefault((each.method, each.settings, each.warm), each)
    return list(seen.values()), notes


def paper_contenders(base: Settings) -> list[Contender]:
    """What the papers did, as far as their settings tell: straight virtual edges, nothing refined."""
    paper = base.replace(refine="off", edge_px=0.0, grid_share=0.0, grid_error_px=0.0, reuse_px=0.0)
    midpoint = paper.replace(search="midpoint", iterations=max(MIDPOINT_ITERATIONS), grid_kind="position")
    painted = paper.replace(occlusion="painter")
    return [
        *(
            Contender(
                f"{ESTALELLA} grid {100 * share:g} %",
                "reflector_map",
                midpoint.replace(grid_share=share),
                source=ESTALELLA,
            )
            for share in GRID_SHARES
        ),
        *(
            Contender(
                f"{ESTALELLA} {count} iterations", "reflector_map", midpoint.replace(iterations=count), source=ESTALELLA
            )
            for count in MIDPOINT_ITERATIONS
        ),
        Contender(LAGES_MIGUEL, "quadric", painted, source=LAGES_MIGUEL),
        Contender(f"{LAGES_MIGUEL} reuse", "quadric", painted.replace(reuse_px=0.5), warm=True, source=LAGES_MIGUEL),
        Contender(OFEK, "explosion_map", paper.replace(explosion_walk=0), source=OFEK),
    ]


def choose(contenders: Iterable[Contender], only: Iterable[str]) -> list[Contender]:
    """Those that a list names, and the reference.

    Args:
        only: Names or patterns (* and ?), methods, or settings that a name tells (`grid_share`, `refine=off`).

    Raises:
        ValueError: a name that fits none, with what would.
    """
    contenders = list(contenders)
    chosen = {REFERENCE}
    for wanted in only:
        fitting = {
            each.name
            for each in contenders
            if fnmatch.fnmatchcase(each.name, wanted)
            or each.method == wanted
            or any(wanted in (word, word.partition("=")[0]) for word in each.name.split()[1:])
        }
        if not fitting:
            known = dict.fromkeys([each.method for each in contenders] + [each.name for each in contenders])
            raise ValueError(f"'{wanted}' names no contender here; there are: {', '.join(known)}")
        chosen |= fitting
    return [each for each in contenders if each.name in chosen]


def run_sweep(
    scene: Scene,
    camera: str | Camera | None,
    size: tuple[int, int],
    contenders: list[Contender] | None = None,
    rounds: int = 7,
    report: Callable[[str], None] | None = None,
    step: float = STEP_RADIANS,
    read: Callable[[str], Scene] | None = None,
) -> Sweep:
    """Measure contenders side by side.

    Each makes a first frame, and then one frame a round; from round to round the camera moves on a small circle about what
    the mirrors show, which ends at the camera given: there the errors are taken.

    Args:
        camera, size: As for `make_plan`.
        contenders: None: `default_contenders`. A reference with the first one's threads is added where there is none.
        rounds: Timed frames of each.
        report: Told what is being done, a line at a time.
        step: Of the camera from round to round: what is kept from frame to frame depends on it. [radians]
        read: Reads the stage at another complexity than the reference's, for contenders that ask for one; None: those fail.
            They are judged by the same reference: by how much the tessellation moves what is seen.

    Returns:
        A `Sweep`; without rows, and with a note, where no mirror is seen.

    Raises:
        ValueError: an unknown camera, an impossible size, no rounds, or two contenders of one name. What another contender
            than the reference raises before its first frame is done is told in `Sweep.failed`; the others go on.
    """
    if rounds < 1:
        raise ValueError(f"rounds: got {rounds}, expected 1 or more")
    view = find_camera(scene, camera, size)
    told = report or (lambda text: None)
    notes: list[str] = []
    if contenders is None:
        contenders, notes = default_contenders(scene, view, size)
    contenders = _with_reference(contenders)
    threads = thread_count(scene.device, contenders[0].settings.threads)
    result = Sweep(
        stage=scene.data.source,
        camera=view.path,
        size=view.size,
        rounds=rounds,
        step_radians=step,
        threads=threads,
        triangles=scene.triangle_count,
        vertices=scene.vertex_count,
        mirror_pixels=0,
        interior_pixels=0,
        machine=machine(scene.device),
        notes=notes,
    )
    # Kernels are loaded, and the mirrors found, on a copy of the scene: the real one's first frames are then first.
    told(f"{len(contenders)} contenders: loading kernels")
    scenes = {contenders[0].settings.complexity: scene}
    spares = {contenders[0].settings.complexity: Scene(scene.data, str(scene.device))}
    loading, pivot = {}, None
    for contender in list(contenders):
        try:
            _read_at(contender.settings.complexity, scenes, spares, read)
            spare = spares[contender.settings.complexity]
            before, start = _loaded_modules(), time.perf_counter()
            frame = render_frame(spare, make_plan(spare, view, size, contender.settings, contender.method))
            if contender.warm:
                render_frame(spare, frame.plan, previous=frame)
            loading[contender.name] = 1000.0 * (time.perf_counter() - start) if _loaded_modules() != before else 0.0
        except (ValueError, NotImplementedError, MemoryError) as error:
            if contender.name == REFERENCE:
                raise
            result.failed.append(f"{contender.name}: {error}")
            contenders.remove(contender)
            continue
        if contender.name == REFERENCE:
            pivot = mirrors_middle(frame)
            if pivot is None:
                result.notes.append("no mirror is seen from the camera: nothing to compare")
                return result
            embree = Embree.over(spare, frame, result.notes)
    del spare, spares, frame
    poses = camera_path(view, pivot, rounds + 1, step)
    rows, plans, last, spent = {}, {}, {}, {each.name: [] for each in contenders}
    for contender in contenders:
        told(f"first frame: {contender.name}")
        own = scenes[contender.settings.complexity]
        plan = plans[contender.name] = make_plan(own, view, size, contender.settings, contender.method)
        start = time.perf_counter()
        first = render_frame(own, plan, poses[0])
        first_ms = 1000.0 * (time.perf_counter() - start)
        rows[contender.name] = _row(contender, plan, first, first_ms, loading[contender.name])
        if contender.warm:
            last[contender.name] = first
    embree_ms = []
    reference = None
    for round_ in range(1, rounds + 1):
        start = time.perf_counter()
        # The reference leads, as the last round's others are judged by it; the others begin with another one each time.
        turned = 1 + (np.arange(len(contenders) - 1) + round_) % max(len(contenders) - 1, 1)
        for contender in [contenders[0], *(contenders[k] for k in turned)]:
            name = contender.name
            started = time.process_time()
            frame = render_frame(plans[name].scene, plans[name], poses[round_], last.get(name))
            spent[name].append(frame.timings | {CPU: 1000.0 * (time.process_time() - started)})
            if contender.warm:
                last[name] = frame
            if round_ == rounds:
                reference = frame if name == REFERENCE else reference
                _judge(rows[name], frame, reference, result)
        if embree:
            embree_ms.append(embree.trace())
        told(f"round {round_} of {rounds}: {time.perf_counter() - start:.1f} s")
    for name, row in rows.items():
        _take_times(row, spent[name])
    result.rows = list(rows.values())
    _mark_dominated(result.rows)
    if embree:
        result.embree_ms, result.embree_identical = statistics.median(embree_ms), embree.agreement(reference)
    return result


def camera_path(camera: Camera, pivot: np.ndarray, count: int, step: float = STEP_RADIANS) -> list[Camera]:
    """Cameras on a circle about a world point, around their own up axis; the last is the one given.

    Args:
        pivot: World position [3].
        step: Angle between two. [radians]
    """
    return [_turned(camera, pivot, (k - count + 1) * step) for k in range(count)]


def _turned(camera: Camera, pivot: np.ndarray, angle: float) -> Camera:
    if angle == 0.0:
        return camera
    # Rodrigues' rotation about the camera's up axis.
    x, y, z = camera.up
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    return dataclasses.replace(
        camera,
        eye=pivot + turn @ (camera.eye - pivot),
        right=turn @ camera.right,
        up=turn @ camera.up,
        forward=turn @ camera.forward,
    )


def pareto(rows: Iterable[Row], cost: Callable[[Row], float], error: Callable[[Row], float]) -> list[Row]:
    """The rows that are more accurate than all that are as fast or faster, fastest first."""
    front: list[Row] = []
    for row in sorted(rows, key=lambda each: (cost(each), error(each))):
        if not front or error(row) < error(front[-1]):
            front.append(row)
    return front


def frame_ms(timings: dict[str, float]) -> float:
    """Milliseconds of a frame's outermost stages, without preparation."""
    return sum(ms for step, ms in timings.items() if "/" not in step and step not in ("prepare", CPU))


class Embree:
    """The mirror rays of a frame through embreex: nearest triangle, one thread, one call for all rays."""

    def __init__(self, scene: Scene, frame: Frame):
        self.build(scene)
        self.order = list(frame.layers)
        pixels = [layer.pixels for layer in frame.layers.values()]
        self.counts = [p.count for p in pixels]
        points = [p.point.numpy() + RAY_STEP * scene.size * p.normal.numpy() for p in pixels]
        self.origins = np.ascontiguousarray(np.concatenate(points), np.float32)
        self.directions = np.ascontiguousarray(np.concatenate([p.direction.numpy() for p in pixels]), np.float32)
        self.hit = None

    def build(self, scene: Scene) -> None:
        """The tree over a scene's triangles; Embree commits it at the first ray."""
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self.scene, scene.host_points, scene.host_triangles)

    @classmethod
    def over(cls, scene: Scene, frame: Frame, notes: list[str] | None = None) -> Embree | None:
        """None where embreex is not installed (noted, or said on standard error) or nothing is reflected."""
        try:
            import embreex  # noqa: F401
        except ImportError:
            text = "embreex is not installed (extra 'bench'): no time of Embree"
            print(text, file=sys.stderr) if notes is None else notes.append(text)
            return None
        return cls(scene, frame) if frame.layers else None

    def trace(self) -> float:
        """Milliseconds of one call."""
        start = time.perf_counter()
        self.hit = self.scene.run(self.origins, self.directions)
        return 1000.0 * (time.perf_counter() - start)

    def agreement(self, reference: Frame) -> float:
        """Share of rays with the reference's triangle (or none)."""
        mine = np.split(self.hit, np.cumsum(self.counts)[:-1])
        same = sum(
            int((hit == reference.layers[number].triangle.numpy()).sum())
            for number, hit in zip(self.order, mine, strict=True)
        )
        return same / max(len(self.hit), 1)


def machine(device: wp.DeviceLike = "cpu") -> dict:
    """What the figures depend on: processor, cores, how busy it is, device, versions, the checkout's commit."""
    versions = {"python": platform.python_version(), "warp_reflect": __version__}
    for name in VERSIONS:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    known = wp.get_device(device)
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        # Of others too: times of a busy machine are no times.
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "device": str(known),
        "device_name": known.name,
        "system": platform.platform(),
        "versions": versions,
        "commit": commit(),
    }


def commit() -> str:
    """Short hash of the checkout that this file belongs to, with a + where it was changed; empty outside one."""
    here = Path(__file__)

    def git(*words: str) -> subprocess.CompletedProcess:
        return subprocess.run(["git", "-C", str(here.parent), *words], capture_output=True, text=True, check=False)

    try:
        if git("ls-files", "--error-unmatch", here.name).returncode:
            return ""
        changed = git("status", "--porcelain", "--untracked-files=no", ".").stdout.strip()
        return git("rev-parse", "--short", "HEAD").stdout.strip() + "+" * bool(changed)
    except OSError:
        return ""


def held_bytes(value: object) -> int:
    """Bytes of the NumPy and Warp arrays that an object of this package holds, in its attributes and theirs, each once."""
    total = 0
    seen: set[int] = set()
    waiting = [value]
    while waiting:
        each = waiting.pop()
        if isinstance(each, (np.ndarray, wp.array)):
            # On the CPU a Warp array may be a view of one that NumPy owns.
            address, bytes_ = (
                (each.ptr, each.capacity) if isinstance(each, wp.array) else (each.ctypes.data, each.nbytes)
            )
            total += 0 if address in seen else bytes_
            seen.add(address)
        elif id(each) in seen:
            continue
        elif isinstance(each, (list, tuple)):
            waiting += each
        elif not isinstance(each, Scene) and any(
            base.__module__.startswith("warp_reflect.") for base in type(each).__mro__
        ):
            seen.add(id(each))
            waiting += vars(each).values()
    return total


def flip(reference: np.ndarray, test: np.ndarray) -> np.ndarray | None:
    """FLIP (Andersson et al., 2020) of two linear pictures as displayed at 67 pixels a degree; None: not installed.

    Returns:
        Float [height, width], 0 equal to 1 opposite.
    """
    try:
        import flip_evaluator
    except ImportError:
        return None
    error, _, _ = flip_evaluator.evaluate(shown(reference), shown(test), "LDR", applyMagma=False)
    return np.asarray(error).reshape(*reference.shape[:2], -1)[..., 0]


def shown(linear: np.ndarray) -> np.ndarray:
    """A linear picture as displayed: sRGB of exposure 0, float32 in [0, 1]."""
    return np.ascontiguousarray(srgb_from_linear(np.clip(linear, 0.0, 1.0)), np.float32)


def _with_reference(contenders: list[Contender]) -> list[Contender]:
    """The reference first, names told apart."""
    names = [each.name for each in contenders]
    if len(set(names)) < len(names):
        raise ValueError(f"contenders: two of one name among {', '.join(names)}")
    first = [each for each in contenders if each.name == REFERENCE]
    if not first:
        threads = contenders[0].settings.threads if contenders else 0
        first = [Contender(REFERENCE, REFERENCE, Settings(threads=threads))]
    return first + [each for each in contenders if each.name != REFERENCE]


def _read_at(
    complexity: str, scenes: dict[str, Scene], spares: dict[str, Scene], read: Callable[[str], Scene] | None
) -> None:
    """Have a stage at a complexity, and a copy to load kernels by."""
    if complexity in scenes:
        return
    if read is None:
        raise ValueError(f"complexity={complexity}: the stage was read at {', '.join(scenes)} alone; give `read`")
    scenes[complexity] = read(complexity)
    spares[complexity] = Scene(scenes[complexity].data, str(scenes[complexity].device))


def _loaded_modules() -> set[str]:
    """Of this package's kernel modules, those that Warp has loaded."""
    kernels = (
        each
        for name, module in list(sys.modules.items())
        if name.startswith("warp_reflect.")
        for each in vars(module).values()
        if isinstance(each, wp.Kernel)
    )
    return {kernel.module.name for kernel in kernels if kernel.module.execs}


def mirrors_middle(frame: Frame) -> np.ndarray | None:
    """World position in the middle of what is seen of the mirrors; None where nothing is."""
    points = frame.relative("mirrorPoint")[frame["status"] > 0]
    return frame.camera.eye + np.median(points.astype(np.float64), axis=0) if len(points) else None


def _row(contender: Contender, plan: Plan, first: Frame, first_ms: float, loading_ms: float) -> Row:
    defaults = dataclasses.asdict(Settings())
    settings = dataclasses.asdict(contender.settings)
    seen = [row for row in plan.rows if row.pixels]
    return Row(
        name=contender.name,
        method=contender.method,
        technique=", ".join(sorted({row.technique for row in seen})),
        source=contender.source,
        warm=contender.warm,
        settings={name: value for name, value in settings.items() if value != defaults[name]},
        first_ms=first_ms,
        prepare_ms=first.timings.get("prepare", 0.0),
        compile_ms=max(loading_ms - first_ms, 0.0),
        predicted_ms=sum(row.predicted["ms" if contender.warm else "first_ms"] for row in seen),
        predicted_px=max((row.predicted["error_px"] for row in seen), default=0.0),
        prepared_bytes=sum(held_bytes(plan.prepared(row)) for row in seen),
    )


def _take_times(row: Row, spent: list[dict[str, float]]) -> None:
    reflect = [timings.get("reflect", 0.0) for timings in spent]
    whole = [frame_ms(timings) for timings in spent]
    row.reflect_ms, row.frame_ms = statistics.median(reflect), statistics.median(whole)
    row.reflect_p95_ms, row.frame_p95_ms = float(np.percentile(reflect, 95)), float(np.percentile(whole, 95))
    row.frame_cpu_ms = statistics.median(timings[CPU] for timings in spent)
    steps = dict.fromkeys(step for timings in spent for step in timings if step not in ("prepare", CPU))
    row.steps_ms = {step: statistics.median(timings.get(step, 0.0) for timings in spent) for step in steps}


def _judge(row: Row, frame: Frame, reference: Frame, result: Sweep) -> None:
    """Take the errors of a row from its last frame, made by the reference's camera."""
    mine, true = _eye_channels(frame), _eye_channels(reference)
    found = compare_frames(mine, true)
    result.mirror_pixels, result.interior_pixels = found.mirror_pixels, found.interior_pixels
    row.identical_share, row.wrong_share = found.share(found.identical), found.share(found.wrong)
    row.off_share = found.share(found.interior_pixels - found.within_half_px)
    right = np.isin(found.classes, (PixelClass.IDENTICAL, PixelClass.SHIFTED))
    if right.any():
        errors = found.error_px[right]
        row.error_mean_px = float(errors.mean())
        row.error_median_px, row.error_p95_px = (float(each) for each in np.percentile(errors, (50, 95)))
        row.error_max_px = float(errors.max())
    angles = _angles_deg(mine, true, found.classes >= PixelClass.IDENTICAL)
    if len(angles):
        row.angle_median_deg, row.angle_p95_deg = (float(each) for each in np.percentile(angles, (50, 95)))
        row.angle_max_deg = float(angles.max())
    row.psnr_db = found.psnr_db
    pictures = [np.ascontiguousarray(each["RGBA"][..., :3]) for each in (reference, frame)]
    mirror = found.classes != PixelClass.NONE
    near = _around(mirror, FLIP_MARGIN)
    seen = flip(pictures[0][near], pictures[1][near])
    row.flip = None if seen is None else float(seen[mirror[near]].mean())
    counts = frame.statistics
    row.statistics = {name: float(value) for name, value in counts.items()}
    row.bvh_share = counts.get("bvh", 0) / max(np.count_nonzero(frame["reflectorId"]), 1)
    row.reused_share = counts.get("reused", 0) / max(counts.get("vertices", 0), 1)
    row.picture, row.error_map = _crops(shown(pictures[1]), found, mirror)


def _eye_channels(frame: Frame) -> dict[str, np.ndarray]:
    """What two frames of one camera are compared by, points relative to the eye: not rounded at any offset.

    Environment maps hold no points: what lies where they show it, from their centre, stands for them.
    """
    names = ("reflectorId", "reflectedId", "status", "pathLength", "R", "G", "B")
    channels = {name: frame[name] for name in names} | {name: frame.relative(name) for name in POINTS}
    if any(row.technique == "environment" and row.reflector.id in frame.layers for row in frame.plan.rows):
        channels |= as_points(frame)
    return channels


def _angles_deg(mine: dict, true: dict, where: np.ndarray) -> np.ndarray:
    """Angles [n] at the mirror between the points shown by two frames, where both show one."""
    where = where & (mine["reflectedId"] > 0) & (true["reflectedId"] > 0)
    mirror = true["mirrorPoint"][where].astype(np.float64)
    a, b = (each["reflectedPoint"][where] - mirror for each in (mine, true))
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.degrees(np.arctan2(sine, np.einsum("ij,ij->i", a, b)))


def _around(where: np.ndarray, margin: int) -> tuple[slice, slice]:
    """The rows and columns of a mask's bounding box, widened."""
    rows, columns = np.nonzero(where.any(axis=1))[0], np.nonzero(where.any(axis=0))[0]
    return tuple(slice(max(each[0] - margin, 0), each[-1] + 1 + margin) for each in (rows, columns))


def _crops(picture: np.ndarray, found: Comparison, mirror: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mirrors' part of a picture and of its errors, at most `CROP_SIDE` pixels a side (means and maxima)."""
    part = _around(mirror, 0)
    error = np.where(mirror, found.error_px, np.nan)
    # Nothing is known of the border's errors; what shows another thing is off by any distance.
    error[found.classes == PixelClass.BORDER] = np.nan
    error[np.isin(found.classes, (PixelClass.WRONG, PixelClass.UNMATCHED, PixelClass.UNANSWERED))] = np.inf
    picture, error = picture[part], error[part]
    block = -(-max(error.shape) // CROP_SIDE)
    height, width = (side // block for side in error.shape)
    tiles = np.s_[: height * block, : width * block]
    picture = picture[tiles].reshape(height, block, width, block, 3).mean(axis=(1, 3))
    # NaN is off the mirrors: as -1 it loses against every error.
    error = np.nan_to_num(error[tiles], nan=-1.0, posinf=np.inf).reshape(height, block, width, block).max(axis=(1, 3))
    return np.round(255.0 * picture).astype(np.uint8), np.where(error < 0.0, np.nan, error).astype(np.float32)


def _mark_dominated(rows: list[Row]) -> None:
    for row in rows:
        better = [each for each in rows if each.reflect_ms < row.reflect_ms and each.off_share <= row.off_share]
        row.dominated_by = min(better, key=lambda each: each.reflect_ms).name if better else ""
