"""What an inspector shows, without a window: the frame of a hand-held camera, its error, its pixels.

Everything here works on a machine without any graphics library.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from warp_reflect import applicable
from warp_reflect.frame import Frame, render_frame
from warp_reflect.images import srgb_from_linear
from warp_reflect.layers import Camera
from warp_reflect.metrics import Comparison, PixelClass, compare_frames
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import METHODS, Plan, PlanLine, find_camera, make_plan, with_techniques
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.sweep import REFERENCE, Contender
from warp_reflect.techniques import TECHNIQUES
from warp_reflect.viewer import cameras
from warp_reflect.viewer.tradeoff import Tradeoff, mark_of, quick_contenders

COARSE = 4  # a side of a moving picture is this much shorter
COARSE_MIN = 16  # pixels a side: below it nothing is recognised
ORBIT_PER_SIDE = math.pi  # radians of an orbit for a drag across the whole picture
DIGITS = 5  # of a picked point, counted from the size of the path length
TIMES_MAX = 400  # positions of the time slider, about one a pixel
ERROR_SHOWN_PX = 2.0  # pixel error at the hot end of the heat map

STATUS_WORDS = {
    Status.NONE: "no reflection here",
    Status.CONVERGED: "found",
    Status.SKY: "the reflected ray leaves the scene",
    Status.HIDDEN: "hidden by the mirror itself",
    Status.UNREFLECTED: "not reflected by this mirror",
    Status.GRAZING: "grazing: not resolved in this precision",
    Status.MAX_ITERATIONS: "search ended at its bound",
    Status.DEGENERATE: "degenerate geometry",
    Status.AMBIGUOUS: "one of a continuum of answers",
    Status.NEAR_CAUSTIC: "near a caustic",
    Status.INSIDE: "inside the mirror's body",
    Status.BAD_INPUT: "bad input",
    Status.OUT_OF_EXTENT: "outside of the mirror's outline",
    Status.STEP_LIMIT: "traversal ended at its bound",
    Status.DEPTH_LIMIT: "recursion ended at its bound",
}
TECHNIQUE_WORDS = {
    Technique.NONE: "none",
    Technique.RAYTRACED: "ray traced",
    Technique.PLANAR: "planar: mirrored at the plane",
    Technique.QUADRIC: "quadric: the point on the analytic surface",
    Technique.REFLECTOR_MAP: "reflector map: searched on a cube map",
    Technique.EXPLOSION_MAP: "explosion map (Ofek and Rappoport 1998)",
    Technique.ENVIRONMENT: "environment map",
    Technique.LAYERED_ENVIRONMENT: "layered environment maps",
}


@dataclass(frozen=True)
class Control:
    """A knob: the values it steps through, in order.

    Attributes:
        name: `method`, or a setting's name.
        label: What it is called on screen.
        values: All its positions.
    """

    name: str
    label: str
    values: tuple

    def shown(self, value) -> str:
        """A value in words."""
        return ZERO_WORDS.get(self.name, "0") if value == 0 and not isinstance(value, str) else f"{value}"


# Positions that say more than the generic ones; these knobs come first.
POSITIONS = {
    "budget_ms": (0.0, 2.0, 4.0, 8.0, 16.0, 33.0, 66.0, 100.0, 200.0),
    "max_error_px": (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0),
    "grid_share": (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
    "grid_error_px": (0.0, 0.1, 0.25, 0.5, 1.0, 2.0, 4.0),
    "iterations": (0, 1, 2, 3, 4, 6, 9, 12, 16, 24),
    "map_resolution": (8, 16, 32, 64, 128, 256, 512),
    "reuse_px": (0.0, 0.1, 0.25, 0.5, 1.0, 2.0),
    "refine": (),
    "search": (),
    "glossy": (),
    "glossy_samples": (0, 2, 4, 6, 8, 16, 32, 64, 128, 256),
    "rem_count": (1, 2, 3, 4, 6, 8),
    "tolerance": (0.0, 1.0e-6, 1.0e-5, 1.0e-4, 1.0e-3, 1.0e-2, 0.1),
}
LABELS = {
    "budget_ms": "budget (ms)",
    "max_error_px": "error (px)",
    "glossy": "rough mirrors",
    "glossy_samples": "rays of rough",
    "rem_count": "reference maps",
    "grid_share": "grid share",
    "grid_error_px": "grid error (px)",
    "map_resolution": "map resolution",
    "reuse_px": "reuse (px)",
}
ZERO_WORDS = {
    "budget_ms": "none",
    "max_error_px": "none",
    "glossy_samples": "automatic",
    "grid_share": "off",
    "grid_error_px": "off",
    "iterations": "default",
    "reuse_px": "off",
}
AT_LOADING = ("complexity", "reflector_max_roughness", "reflector_min_weight")  # nothing of a loaded stage follows them
FACTORS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)  # of a setting's default
FROM_ZERO = (0, 1, 2, 4, 8, 16, 32, 64)  # of a setting that is 0 by default
FRACTIONS = (0.05, 0.1, 0.25, 0.5)  # between 0 and 1 of those that take them


def controls() -> tuple[Control, ...]:
    """Every knob: the technique, then all settings that a loaded stage follows."""
    known = {each.name: each for each in dataclasses.fields(Settings) if each.name not in AT_LOADING}
    ordered = [known[name] for name in POSITIONS if name in known]
    ordered += [each for name, each in known.items() if name not in POSITIONS]
    made = [Control("method", "technique", (*METHODS, *TECHNIQUES))]
    for each in ordered:
        values = POSITIONS.get(each.name) or _positions(each.name, each.default)
        made.append(Control(each.name, LABELS.get(each.name, each.name.replace("_", " ")), values))
    return tuple(made)


def _positions(name: str, default) -> tuple:
    """Values of a setting that a slider steps through: all words, else the default and what lies about it."""
    if isinstance(default, bool):
        return (False, True)
    if isinstance(default, str):
        try:
            Settings().replace(**{name: "?"})
        except ValueError as refusal:  # it says what is possible
            said = str(refusal).partition("expected ")[2].removeprefix("one of ")
            words = tuple(word for word in re.split(r", | or ", said) if word.isidentifier())
            return words if default in words else (default,)
        return (default,)
    if not isinstance(default, int | float):
        return (default,)
    steps = sorted({0, *FRACTIONS, *FROM_ZERO}) if default == 0 else [factor * default for factor in FACTORS]
    kind = type(default)
    return tuple(value for value in sorted({kind(step) for step in steps} | {default}) if _possible(name, value))


def _possible(name: str, value) -> bool:
    try:
        Settings().replace(**{name: value})
    except ValueError:
        return False
    return True


CONTROLS = controls()


@dataclass(frozen=True)
class Pick:
    """What is known of one pixel; points are in world space [3] and None where there is none."""

    pixel: tuple[int, int]
    prim: str
    reflector: str
    reflected: str
    eye: np.ndarray
    mirror_point: np.ndarray | None
    reflected_point: np.ndarray | None
    path_length: float
    residual: float
    status: Status
    technique: Technique

    @property
    def virtual_point(self) -> np.ndarray | None:
        """Where the reflected point appears: on the line of sight, as far as the light travelled."""
        if self.mirror_point is None or self.reflected_point is None:
            return None
        sight = self.mirror_point - self.eye
        return self.eye + sight / max(float(np.linalg.norm(sight)), 1.0e-300) * self.path_length

    def lines(self) -> list[str]:
        """The pixel in words."""
        # Digits as the view's size asks: a stage may lie far from the origin.
        scale = self.path_length or 1.0
        decimals = min(max(DIGITS - 1 - math.floor(math.log10(scale)), 0), 12)

        def point(p: np.ndarray) -> str:
            return "(" + ", ".join(f"{x:.{decimals}f}" for x in p) + ")"

        lines = [f"pixel ({self.pixel[0]}, {self.pixel[1]}): {self.prim or 'background'}"]
        if not self.reflector:
            return [*lines, "  no mirror here"]
        lines.append(f"  in it: {self.reflected or STATUS_WORDS[self.status]}")
        if self.mirror_point is not None:
            lines.append(f"  mirror point R    {point(self.mirror_point)}")
        if self.reflected_point is not None:
            lines.append(f"  reflected point V {point(self.reflected_point)}")
            lines.append(f"  path eye-R-V {self.path_length:.6g}, law of reflection to {self.residual:.1e}")
        lines.append(f"  {self.status.name}: {STATUS_WORDS[self.status]}")
        lines.append(f"  by {TECHNIQUE_WORDS[self.technique]}")
        return lines


class Session:
    """A scene under inspection.

    Attributes:
        scene, plan, frame: What is shown; `frame` may be coarse.
        coarse: Whether the frame is of a moving camera, at a quarter of the resolution.
        reference: The same view with every mirror traced; None until `measure`.
        comparison: The frame's error against it; None likewise.
        picks: Picked pixels, the last one last.
        message: What the user should read, such as why a value was refused.
        tradeoff: Accuracy against time: a sweep's points, and those of the settings tried so far in this view.
        techniques: Chosen by hand for single mirrors, by reflector id.
        pivot: What the camera turns about, world [3].
        frame_ms: Wall time of the frame.
    """

    def __init__(
        self,
        scene: Scene,
        camera: str | Camera | None = None,
        settings: Settings | None = None,
        size: tuple[int, int] | None = None,
        method: str = "auto",
    ):
        self.settings, self.method = settings or Settings(), method
        self.techniques: dict[int, str] = {}
        self.size = size or (640, 480)
        self.scene = scene
        self.plan: Plan | None = None
        self.frame: Frame | None = None
        self.reference: Frame | None = None
        self.comparison: Comparison | None = None
        self.coarse = False
        self._stale = self._moved = True  # the frame is not the view's; nor is the plan
        self.picks: list[Pick] = []
        self.message = ""
        self.frame_ms = 0.0
        self.tradeoff = Tradeoff()
        self._swept = False  # its points are of this very view
        self.camera = self._first_camera(camera)
        self._replan()
        self.pivot = cameras.pivot_of(self.plan)
        self.refine()
        self.message = self._welcome()

    # Views.

    def orbit(self, dx: float, dy: float) -> None:
        """Turn the camera about the pivot as a drag by (dx, dy) pixels of the picture asks; a coarse frame."""
        yaw, pitch = (-ORBIT_PER_SIDE * d / max(self.size) for d in (dx, -dy))
        self._move(cameras.orbited(self.camera, self.pivot, cameras.up_of(self.scene), yaw, pitch))

    def pan(self, dx: float, dy: float) -> None:
        """Shift the camera as a drag by (dx, dy) pixels asks; a coarse frame."""
        camera, self.pivot = cameras.panned(self.camera, self.pivot, dx, dy)
        self._move(camera)

    def zoom(self, factor: float) -> None:
        """Bring the camera to `factor` times its distance from the pivot; a coarse frame."""
        self._move(cameras.zoomed(self.camera, self.pivot, factor))

    def use_camera(self, camera: str | Camera) -> None:
        """Look through a camera of the stage, by path or name; a full frame."""
        self.camera, self.picks = find_camera(self.scene, camera, self.size), []
        self._forget_points()
        self._replan()
        self.pivot = cameras.pivot_of(self.plan)
        self.refine()
        self.message = f"camera {self.camera.path}"

    def use_time(self, time: float) -> None:
        """Show the stage at another time code; a full frame. A camera of the stage that was not moved moves along."""
        before = self.scene
        scene = before.at(time)
        known = next((each for each in before.data.cameras if each.path == self.camera.path), None)
        held = known is not None and np.array_equal(Camera.from_data(known, self.size).eye, self.camera.eye)
        self.scene = scene
        self._forget_points()
        if held and any(each.path == self.camera.path for each in scene.data.cameras):
            self.camera = find_camera(scene, self.camera.path, self.size)
        self.picks = []
        self._replan()
        self.refine()
        self.message = f"time {time:g}"

    def _move(self, camera: Camera) -> None:
        self.camera = camera
        self._forget_points()
        small = tuple(max(side // COARSE, min(side, COARSE_MIN)) for side in self.size)
        # A plan renders at its own size. The coarse one shares what the techniques prepared.
        self._render(dataclasses.replace(self.plan, camera=cameras.resized(camera, small)), self.frame)
        self.coarse = self._stale = self._moved = True
        self.picks = []
        self.reference = self.comparison = None

    def refine(self) -> None:
        """The full frame of the camera where it is; does nothing where it is shown already."""
        if not self._stale:
            return
        if self._moved:
            self._replan()
        self._render(self.plan, self.frame if self.settings.reuse_px > 0.0 else None)
        self.coarse = self._stale = False
        self.reference = self.comparison = None

    def measure(self) -> Comparison:
        """The reference of this view, and the error against it; both are kept until something changes."""
        self.refine()
        if self.comparison is None:
            traced = make_plan(self.scene, self.camera, self.size, self.settings, "reference")
            self.reference = render_frame(self.scene, traced)
            self.comparison = compare_frames(self.frame, self.reference)
            if self.comparison.mirror_pixels:
                self.tradeoff.trail.append(mark_of(self._settings_in_words(), self.frame, self.comparison))
        return self.comparison

    def quick_sweep(self) -> Iterator[str]:
        """Measure this view with every technique and each of its knobs, one after the other; replaces the plot's sweep.

        Each contender's second frame counts, as its first one prepares.

        Yields:
            The name of what was measured.
        """
        self.measure()
        self.tradeoff = Tradeoff(
            [mark_of(REFERENCE, self.reference, compare_frames(self.reference, self.reference))]
            if self.comparison.mirror_pixels
            else [],
            f"measured here at {self.size[0]}x{self.size[1]}, one frame each",
            self.tradeoff.trail,
        )
        self._swept = True
        for each in quick_contenders(self) if self.comparison.mirror_pixels else ():
            if each.name != REFERENCE:
                self._try(each)
                yield each.name

    def _try(self, contender: Contender) -> None:
        plan = make_plan(self.scene, self.camera, self.size, contender.settings, contender.method)
        render_frame(self.scene, plan)
        frame = render_frame(self.scene, plan)
        self.tradeoff.marks.append(mark_of(contender.name, frame, compare_frames(frame, self.reference)))

    # Knobs.

    def value(self, name: str):
        """The value of a control."""
        return self.method if name == "method" else getattr(self.settings, name)

    @property
    def times(self) -> tuple[float, ...]:
        """Time codes to choose from, at most `TIMES_MAX` evenly spread; empty for a stage that does not move."""
        span = self.scene.data.time_range
        if span is None or span[1] <= span[0]:
            return ()
        steps = math.floor(span[1] - span[0] + 1.0e-6)
        codes = [span[0] + k for k in range(steps + 1)] if steps else list(span)
        stride = math.ceil(len(codes) / TIMES_MAX)
        return tuple(float(code) for code in codes[::stride])

    def knob_value(self, name: str):
        """The value of a control, of "camera" or of "time"."""
        if name == "camera":
            return self.camera.path
        if name == "time":
            return self.scene.data.time if self.scene.data.time is not None else self.scene.data.time_range[0]
        return self.value(name)

    def turn_knob(self, name: str, value) -> bool:
        """Set a control, the camera or the time."""
        if name == "camera":
            self.use_camera(value)
        elif name == "time":
            self.use_time(value)
        else:
            return self.set(name, value)
        return True

    def set(self, name: str, value) -> bool:
        """Change the method or a setting and show the full frame; False with the reason in `message` if refused."""
        before = self.method, self.settings
        try:
            if name == "method":
                self.method = value
            else:
                self.settings = self.settings.replace(**{name: value})
            self._replan()
        except ValueError as error:
            self.method, self.settings = before
            self.message = f"refused: {error}"
            return False
        self.picks = []
        self.refine()
        away = [note.text for note in self.plan.notes if "does not apply" in note.text]
        shown = f"{name} = {value}"
        self.message = f"{shown}; {away[0]}" if away else shown
        return True

    # The plan.

    def toggle(self, line: PlanLine) -> bool:
        """Force what a line of the plan says the other way; False with the reason in `message` where nothing can.

        Of a mirror's own lines: its next technique that applies, and after the last one what the plan chooses. Of an
        effect: the first setting among those its reason names that turns it on or off.
        """
        row = line.row
        if isinstance(row, PlanRow) and not line.effect:
            return self._next_technique(row)
        if row is None or not line.effect:
            return False
        now = row.effects[line.effect]
        named = [name for name in Settings.names() if re.search(rf"\b{name}\b", now.reason)]
        for control in (control for control in CONTROLS if control.name in named):
            known = dataclasses.fields(Settings)
            default = next(each.default for each in known if each.name == control.name)
            for value in dict.fromkeys((default, *control.values)):
                if self._turns(line, control.name, value):
                    return self.set(control.name, value)
        self.message = f"refused: no setting turns {line.effect} {'off' if now.on else 'on'}: {now.reason}"
        return False

    def _turns(self, line: PlanLine, name: str, value) -> bool:
        """Whether a setting's value turns the effect of a line."""
        try:
            settings = self.settings.replace(**{name: value})
        except ValueError:  # it contradicts another setting
            return False
        plan = self._planned(settings)
        found = next((each for each in plan.lines() if _same_effect(each, line)), None)
        return found is not None and found.row.effects[line.effect].on != line.row.effects[line.effect].on

    def _next_technique(self, row: PlanRow) -> bool:
        if self.method == "reference":
            self.message = "refused: technique = reference traces every mirror"
            return False
        id, before = row.reflector.id, dict(self.techniques)
        names = list(TECHNIQUES)
        # After what was chosen by hand the names that follow it; at the end what the plan chooses.
        following = names[names.index(before[id]) + 1 :] if id in before else names
        for name in following:
            applies, _ = applicable.applies(self.scene, row.reflector, self.camera, name, row.settings)
            if applies:
                self.techniques[id] = name
                break
        else:
            self.techniques.pop(id, None)
        self._replan()
        self.picks = []
        self.refine()
        chosen = self.techniques.get(id)
        self.message = f"{row.name}: {chosen}, by hand" if chosen else f"{row.name}: as the plan chooses"
        return True

    # Pixels.

    def pick(self, x: int, y: int) -> Pick:
        """What is seen at a pixel of the full frame; it is added to `picks`.

        Raises:
            ValueError: outside of the picture.
        """
        width, height = self.size
        if not (0 <= x < width and 0 <= y < height):
            raise ValueError(f"pixel: got ({x}, {y}), expected 0 to {width - 1}, 0 to {height - 1}")
        self.refine()
        found = pick_of(self.frame, x, y)
        self.picks.append(found)
        return found

    def numbers(self) -> list[str]:
        """Measured times and the error on screen, in words."""
        width, height = self.frame.camera.size
        lines = [f"frame {width}x{height}  {self.frame_ms:.0f} ms" + ("  (moving)" if self.coarse else "")]
        steps = [(name, ms) for name, ms in self.frame.timings.items() if "/" not in name and ms >= 0.05]
        lines.append("  " + "  ".join(f"{name} {ms:.1f}" for name, ms in steps))
        inner = [(name.partition("/")[2], ms) for name, ms in self.frame.timings.items() if "/" in name and ms >= 0.05]
        if inner:
            lines.append("  of reflect: " + "  ".join(f"{name} {ms:.1f}" for name, ms in inner))
        if self.comparison is None:
            return [*lines, "error: not measured" + (" while moving" if self.coarse else "")]
        e = self.comparison
        if not e.mirror_pixels:
            return [*lines, "error: no mirror is seen"]
        psnr = "equal pictures" if e.psnr_db is None else f"PSNR {e.psnr_db:.1f} dB"
        same = 100.0 * e.share(e.identical)
        lines.append(f"error: {same:.3f} % identical of {e.interior_pixels:,} mirror pixels, {psnr}")
        lines.append(
            f"  shifted {e.shifted:,} (median {e.error_median_px:.2g}, max {e.error_max_px:.2g} px)  "
            f"wrong {e.wrong:,}  unmatched {e.unmatched:,}"
        )
        return lines

    # What is not asked from outside.

    def _first_camera(self, camera: str | Camera | None) -> Camera:
        if isinstance(camera, Camera):
            return cameras.resized(camera, self.size)
        if camera is None and not self.scene.data.cameras:
            return cameras.default_camera(self.scene, self.size)
        return find_camera(self.scene, camera, self.size)

    def _forget_points(self) -> None:
        """Errors and times are of one view; a sweep that was read says itself of which."""
        self.tradeoff.trail.clear()
        if self._swept:
            self.tradeoff, self._swept = Tradeoff(), False

    def _settings_in_words(self) -> str:
        changed = {
            each.name: getattr(self.settings, each.name)
            for each in dataclasses.fields(Settings)
            if getattr(self.settings, each.name) != each.default
        }
        return " ".join([self.method, *(f"{name}={value}" for name, value in changed.items())])

    def _replan(self) -> None:
        self.plan = self._planned(self.settings)
        self._stale, self._moved = True, False

    def _planned(self, settings: Settings) -> Plan:
        plan = make_plan(self.scene, self.camera, self.size, settings, self.method, earlier=self.plan)
        return with_techniques(plan, self.techniques) if self.techniques and self.method != "reference" else plan

    def _render(self, plan: Plan, previous: Frame | None) -> None:
        if previous is not None and previous.scene is not self.scene:
            previous = None
        start = perf_counter()
        self.frame = render_frame(self.scene, plan, previous=previous)
        self.frame_ms = 1000.0 * (perf_counter() - start)

    def _welcome(self) -> str:
        said = []
        if not self.scene.triangle_count:
            said.append("nothing to draw in this stage")
        if not self.scene.data.cameras:
            said.append("no camera in this stage: a view of all of it")
        if self.scene.triangle_count and not self.plan.rows:
            said.append("no mirror in this stage: --reflector PATTERN makes one; roughness and weight decide else")
        elif self.plan.rows and not any(row.pixels for row in self.plan.rows):
            said.append("no mirror is seen from this camera")
        return "; ".join(said)


def _same_effect(a: PlanLine, b: PlanLine) -> bool:
    """Whether two lines, of two plans of one scene, are about the same effect of the same surface or light."""

    def named(line: PlanLine) -> tuple:
        where = (getattr(line.row, name, "") for name in ("path", "subset", "instance"))
        return type(line.row), *where, line.effect

    return bool(a.effect) and named(a) == named(b)


def pick_of(frame: Frame, x: int, y: int) -> Pick:
    """What a frame tells of a pixel."""

    def at(name: str):
        return frame[name][y, x]

    status, technique = Status(int(at("status"))), Technique(int(at("method")))
    reflected, eye = int(at("reflectedId")), frame.camera.eye
    mirror = frame.reflectors.get(int(at("reflectorId")), "")
    there = bool(mirror) and status != Status.NONE
    # Relative to the eye points are exact at any offset; in float64 the sum is, too.
    return Pick(
        (x, y),
        frame.prims.get(int(at("primId")), ""),
        mirror,
        frame.prims.get(reflected, ""),
        eye,
        eye + frame.relative("mirrorPoint")[y, x].astype(np.float64) if there else None,
        eye + frame.relative("reflectedPoint")[y, x].astype(np.float64) if reflected else None,
        float(at("pathLength")),
        float(at("residual")),
        status,
        technique,
    )


# Pictures: uint8 [height, width, 3], row 0 at the top.


def picture(frame: Frame) -> np.ndarray:
    """A frame in sRGB, as `Frame.write` puts it into a PNG."""
    linear = np.clip(frame["RGBA"][..., :3], 0.0, 1.0)
    return (srgb_from_linear(linear) * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)


# Colours of the heat map: what a class is shown as where it has no pixel error.
CLASS_COLORS = {
    PixelClass.NONE: (32, 34, 38),
    PixelClass.BORDER: (70, 74, 82),
    PixelClass.IDENTICAL: (24, 62, 110),
    PixelClass.UNMATCHED: (226, 60, 190),
    PixelClass.WRONG: (235, 235, 235),
    PixelClass.UNANSWERED: (130, 90, 200),
}
# Blue to red by way of green and yellow: control points of the colours of shifted pixels.
HEAT = np.array([(24, 62, 110), (30, 130, 150), (90, 180, 80), (245, 205, 60), (220, 50, 35)], float)


def heat_colors(error_px: np.ndarray) -> np.ndarray:
    """Colours uint8 [..., 3] of pixel errors; `ERROR_SHOWN_PX` and more are the last one."""
    place = np.clip(error_px / ERROR_SHOWN_PX, 0.0, 1.0) * (len(HEAT) - 1)
    return np.stack([np.interp(place, np.arange(len(HEAT)), HEAT[:, k]) for k in range(3)], -1).astype(np.uint8)


def heat_map(comparison: Comparison) -> np.ndarray:
    """The error of every pixel as a picture; see `CLASS_COLORS` and `heat_colors`."""
    image = np.zeros((*comparison.classes.shape, 3), np.uint8)
    for number, color in CLASS_COLORS.items():
        image[comparison.classes == number] = color
    shifted = comparison.classes == PixelClass.SHIFTED
    image[shifted] = heat_colors(comparison.error_px[shifted])
    return image
