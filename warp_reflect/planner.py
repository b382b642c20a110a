"""What a scene calls for, and why: `make_plan` decides once, everything later reads the `Plan`."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from warp_reflect import (
    __version__,
    applicable,
    calibration,
    choice,
    detail,
    kernels,
    launch,
    mirrored_eyes,
    raster,
    vector,
)
from warp_reflect.applicable import PREFERRED
from warp_reflect.budget import (
    BUILT_IN,
    Costs,
    bounce_ms,
    fixed_ms,
    lobe_ms,
    loss,
    scattered_ms,
    through_ms,
)
from warp_reflect.direct import AREA_KINDS
from warp_reflect.effects import (
    Effect,
    bounce_effect,
    frost_rays,
    lobe_rays,
    pane_rays,
)
from warp_reflect.layers import Camera, GBuffer
from warp_reflect.lighting import LightRow, are_clear, needs_probe, plan_lights, shadows_of
from warp_reflect.plan_rows import (
    PaneRow,
    PlanRow,
    effects_of,
    pane_of,
    predicted_of,
    row_of,
    shadow_effect,
)
from warp_reflect.probe import EyeView, Probe, look, probe
from warp_reflect.reflectors import is_transparent, mirror_roughness, mirror_weight
from warp_reflect.scene import Note, PartRange, Scene
from warp_reflect.settings import Settings
from warp_reflect.shadows import Shadows
from warp_reflect.techniques import TECHNIQUES, TOGETHER

METHODS = ("auto", "reference", "none")
OF_ALL_TIMES = ("layered_environment",)  # prepare something that holds nothing that moves
# Prepare what follows from the mirror alone and where it stands; reflector maps but for grids and maps that were baked.
OF_MIRROR = ("planar", "quadric", "reflector_map", "explosion_map", "raytraced")
DEFAULT_SIZE = (960, 540)  # usdrecord's default width at 16:9
# Of a time asked for: a frame that takes more is late, and what is dearer may be predicted to take as much; between them a
# choice stands.
LATE, ROOM = 1.05, 0.95
GLANCE = 97  # pixels from one to the next that are asked for mirrors, so that kernels of theirs begin to compile early
BETTER = 0.8  # of the error: what a dearer choice has to come down to, else the last one stands


@dataclass(frozen=True)
class PlanLine:
    """A line of a plan as it is printed.

    Attributes:
        text: The line.
        row: What it is about; None: the whole plan.
        effect: The name of the row's effect that it is about; empty: the row itself.
    """

    text: str
    row: PlanRow | PaneRow | LightRow | None = None
    effect: str = ""


@dataclass
class Plan:
    """What a frame simulates; also the owner of what the techniques prepared.

    Attributes:
        rows: One `PlanRow` per reflector, in the order of their ids.
        panes: One `PaneRow` per transparent surface, in the order of their parts.
        notes: What the user should know about the plan, beside the scene's own notes.
        lights: One `LightRow` per light of the stage.
        costs: What the machine's steps cost.
        pace: How long things took for what was predicted of them, learnt where a time is asked for.
    """

    scene: Scene
    camera: Camera
    settings: Settings
    method: str
    rows: list[PlanRow]
    panes: list[PaneRow]
    notes: list[Note]
    lights: list[LightRow] = field(default_factory=list)
    costs: Costs = BUILT_IN
    pace: choice.Pace = field(default_factory=choice.Pace)
    _prepared: dict[int, object] = field(default_factory=dict)
    _prepared_in_mirrors: dict[tuple[int, str], object] = field(default_factory=dict)
    _ways: dict[int, list[choice.Option]] = field(default_factory=dict)
    _revised: bool = False  # rows were chosen otherwise than `make_plan` does: it is no answer to the same request
    _seen: EyeView | None = None  # what the plan's camera sees, drawn to decide: the first frame's
    _told: int = 0  # of the notes, the last: those of the request for an error or a time

    @property
    def fixed_ms(self) -> float:
        """Predicted milliseconds of a frame whatever is chosen: the eye's view, the shading, finishes, panes, bounces."""
        width, height = self.size
        seen = sum(row.pixels for row in self.rows)
        triangles, threads = self.scene.triangle_count, launch.thread_count(self.scene.device, self.settings.threads)
        cast = [row.effects["shadows"].numbers for row in self.lights if row.effects["shadows"].on]
        shadows = sum(numbers.get("ms", 0.0) for numbers in cast)
        point = sum(numbers.get("ms", 0.0) / max(numbers.get("points", 0), 1) for numbers in cast)
        finishes = sum(
            lobe_ms(row.pixels, rays, triangles, point, row.settings, self.costs, threads)
            for row in self.rows
            for rays in lobe_rays(row.effects, row.settings, row.technique)
        )
        followed = [pane_rays(pane.pixels, pane.interface, pane.effects, pane.settings) for pane in self.panes]
        panes = sum(through_ms(rays, point, self.costs, threads) for rays in followed)
        alone = sum(numbers.get("rays_alone", 0.0) for numbers in cast)
        frost = sum(
            scattered_ms(frost_rays(pane.pixels, pane.effects, pane.settings), alone, triangles, self.costs, threads)
            for pane in self.panes
        )
        shares = [(row.pixels, row.effects["second_bounce"]) for row in self.rows]
        bounces = sum(
            bounce_ms(round(pixels * bounce.numbers["share"]), alone, triangles, self.costs, threads)
            for pixels, bounce in shares
            if bounce.on
        )
        view = fixed_ms(triangles, width * height, seen, self.costs, threads)
        return view + shadows + finishes + panes + frost + bounces

    @property
    def shadows(self) -> Shadows | None:
        """Which lights cast shadows; None: none does."""
        return shadows_of(self.lights, self.settings)

    @property
    def predicted(self) -> dict[str, float]:
        """Of a whole frame, without preparation: `ms` among others, `first_ms` from nothing, `error_px` of its worst mirror."""
        view = self.pace.of(choice.VIEW) * self.fixed_ms
        return {
            "ms": view + sum(self.reflecting("ms").values()),
            "first_ms": view + sum(self.reflecting("first_ms").values()),
            "error_px": max((row.predicted["error_px"] for row in self.rows), default=0.0),
        }

    @property
    def loss(self) -> float:
        """One number for the error of a frame, to compare plans by."""
        return sum(row.pixels * loss(row.predicted) for row in self.rows)

    def reflecting(self, key: str) -> dict[str, float]:
        """Predicted milliseconds of every technique, at its pace."""
        spent: dict[str, float] = {}
        for row in self.rows:
            ms = self.pace.of(row.technique) * row.predicted[key]
            spent[row.technique] = spent.get(row.technique, 0.0) + ms
        return spent

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frames, in pixels."""
        return self.camera.size

    def prepared(self, row: PlanRow, technique: str | None = None) -> object:
        """The view-independent data of a reflector, made at first use.

        Args:
            row: The reflector's.
            technique: By which it is solved where a flat mirror shows it; None: the row's own.
        """
        if technique not in (None, row.technique):
            key = row.reflector.id, technique
            if key not in self._prepared_in_mirrors:
                made = TECHNIQUES[technique].prepare(self.scene, row.reflector, row.settings)
                self._prepared_in_mirrors[key] = made
            return self._prepared_in_mirrors[key]
        if row.reflector.id not in self._prepared:
            technique = TECHNIQUES[row.technique]
            self._prepared[row.reflector.id] = technique.prepare(self.scene, row.reflector, row.settings)
        return self._prepared[row.reflector.id]

    def prepare_together(self, rows: Iterable[PlanRow]) -> None:
        """Make what reflectors need that is not made yet, where their technique makes that of several at once."""
        asked: dict[str, list[PlanRow]] = {}
        for row in rows:
            if row.technique in TOGETHER and row.reflector.id not in self._prepared:
                asked.setdefault(row.technique, []).append(row)
        for technique, alike in asked.items():
            made = TECHNIQUES[technique].prepare_together(self.scene, [(row.reflector, row.settings) for row in alike])
            self._prepared |= {row.reflector.id: each for row, each in zip(alike, made, strict=True)}

    def take_view(self, camera: Camera) -> EyeView | None:
        """What a camera sees of the plan's scene and mirrors, where that was drawn to decide; for one frame."""
        seen, self._seen = self._seen, None
        same = seen is not None and seen.gbuffer.camera.sees_as(camera)
        if not same or seen.parts != {row.reflector.id: row.reflector.part for row in self.rows}:
            return None
        return dataclasses.replace(seen, gbuffer=dataclasses.replace(seen.gbuffer, camera=camera))

    def at(self, scene: Scene, last: Plan | None = None) -> Plan:
        """The plan for its stage at another time: decided anew; a camera of the stage is where it is then, another stays.

        Args:
            scene: The stage then.
            last: Of a time nearer to that one; what it prepared is taken over where it was made for the same request.
        """
        if scene is self.scene:
            return self
        same = last is not None and (last.settings, last.method, last.size) == (self.settings, self.method, self.size)
        there = any(camera.path == self.camera.path for camera in scene.data.cameras)
        camera = self.camera.path if there and self._sees_as_staged() else self.camera
        earlier = last if same else self
        return make_plan(scene, camera, self.size, self.settings, self.method, earlier=earlier, costs=self.costs)

    def _sees_as_staged(self) -> bool:
        """Whether the camera is the stage's own, and not one made from it."""
        own = (camera for camera in self.scene.data.cameras if camera.path == self.camera.path)
        return any(Camera.from_data(camera, self.size).sees_as(self.camera) for camera in own)

    def to_json(self) -> dict:
        """The plan as `warp-reflect plan --json` prints it."""
        return {
            "version": __version__,
            "stage": self.scene.data.source,
            "camera": self.camera.path,
            "size": list(self.camera.size),
            "time": self.scene.data.time,
            "method": self.method,
            "predicted": self.predicted,
            "reflectors": [
                {
                    "id": row.reflector.id,
                    "path": row.path,
                    "subset": row.subset,
                    "instance": row.instance,
                    "technique": row.technique,
                    "forced": row.forced,
                    "reason": row.reason,
                    "pixels": row.pixels,
                    "effects": {name: dataclasses.asdict(effect) for name, effect in row.effects.items()},
                    "settings": dataclasses.asdict(row.settings),
                    "predicted": row.predicted,
                }
                for row in self.rows
            ],
            "panes": [
                {
                    "path": pane.path,
                    "subset": pane.subset,
                    "instance": pane.instance,
                    "interface": pane.interface,
                    "pixels": pane.pixels,
                    "effects": {name: dataclasses.asdict(effect) for name, effect in pane.effects.items()},
                }
                for pane in self.panes
            ],
            "lights": [dataclasses.asdict(row) for row in self.lights],
            "notes": [{"path": note.path, "text": note.text} for note in [*self.scene.notes, *self.notes]],
        }

    def lines(self) -> list[PlanLine]:
        """The plan for a reader, line by line."""
        width, height = self.camera.size
        found = [PlanLine(f"{self.scene.data.source}  camera {self.camera.path}  {width}x{height}")]
        panes = []
        for pane in self.panes:
            panes.append(PlanLine(f"pane {pane.name}  {pane.interface}  {pane.pixels:,d} pixels", pane))
            panes += _effect_lines(pane)
        lights = []
        for light in self.lights:
            lights += [PlanLine(f"    {light.path}: {light.kind} light", light), *_effect_lines(light)]
        if not self.rows:
            none = "no reflector: nothing is simulated beyond the direct picture"
            found.append(PlanLine(none.replace("beyond", "in mirrors beyond") if panes else none))
            return [*found, *panes, *lights]
        names = [row.name for row in self.rows]
        column = max(len("mirror"), *map(len, names))
        technique = max(len("technique"), *(len(row.technique) + 7 * row.forced for row in self.rows))
        head = f"{'mirror':{column}}  {'technique':{technique}}  {'pixels':>9}  {'error px':>8}  {'ms':>8}  {'kB':>8}"
        found.append(PlanLine("  # " + head))
        for row, name in zip(self.rows, names, strict=True):
            chosen = row.technique + " forced" * row.forced
            numbers = (
                f"{row.predicted['error_px']:8.2f}  {row.predicted['ms']:8.2f}  {row.predicted['bytes'] / 1e3:8,.0f}"
            )
            text = f"{row.reflector.id:3d} {name:{column}}  {chosen:{technique}}  {row.pixels:9,d}  {numbers}"
            found += [PlanLine(text, row), PlanLine(f"    {row.reason}", row), *_effect_lines(row)]
        whole = self.predicted
        times = f"{whole['ms']:.3g} ms, {whole['first_ms']:.3g} ms from nothing"
        return [*found, *panes, *lights, PlanLine(f"a frame: {times}, {whole['error_px']:.2g} px (predicted)")]

    def __str__(self) -> str:
        return "\n".join(line.text for line in self.lines())


def _effect_lines(row: PlanRow | PaneRow | LightRow) -> list[PlanLine]:
    return [
        PlanLine(f"    {'on ' if each.on else 'off'} {name}: {each.reason}", row, name)
        for name, each in row.effects.items()
    ]


def keep_pace(plan: Plan, before: Plan, spent: choice.Spent) -> Plan:
    """The plan of the next frame of an animation, for a request for a time, from how long the last frame took.

    Every frame teaches the pace. A choice is left for a cheaper one only after a frame that was late, and for a dearer one
    only where that is predicted to leave room and to err clearly less: so quality does not flicker.

    Args:
        plan: Of the next frame.
        before: Of the last one.
        spent: On it.
    """
    budget = plan.settings.budget_ms
    if budget <= 0.0 or (before.settings, before.method) != (plan.settings, plan.method):
        return plan
    pace = before.pace.learnt(*_compared(before, spent))
    stays, free = (dataclasses.replace(plan, rows=list(plan.rows), notes=list(plan.notes), _prepared={}) for _ in "12")
    _fit(stays, pace, keep=before)
    free._ways = stays._ways
    _fit(free, pace)
    late = spent.ms > LATE * budget
    dearer = free.predicted["ms"] <= ROOM * budget and free.loss < BETTER * stays.loss
    made = free if late or dearer else stays
    for earlier in (plan, before):
        _take_over(made, earlier)
    return made


def _compared(before: Plan, spent: choice.Spent) -> tuple[dict[str, float], dict[str, float]]:
    """(milliseconds taken, expected) by technique and `choice.VIEW`; techniques of one frame share its time as predicted."""
    reflecting = before.reflecting("first_ms" if spent.cold else "ms")
    ratio = spent.reflect_ms / max(sum(reflecting.values()), 1.0e-9)
    expected = reflecting | {choice.VIEW: before.pace.of(choice.VIEW) * before.fixed_ms}
    return {name: ratio * ms for name, ms in reflecting.items()} | {choice.VIEW: spent.view_ms}, expected


def make_plan(
    scene: Scene,
    camera: str | Camera | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    settings: Settings | None = None,
    method: str = "auto",
    earlier: Plan | None = None,
    costs: Costs | None = None,
) -> Plan:
    """Decide what is simulated for every reflector of a scene.

    Args:
        scene: From `load_stage`.
        camera: Prim path or name of a camera in the stage, or a `Camera`; None: the stage's first.
        size: (width, height). [pixels]
        settings: The knobs; None: the defaults.
        method: `auto`, `reference` (every mirror traced), `none` (no mirror reflects) or a key of `TECHNIQUES`; where it
            does not apply the mirror is traced, with a note.
        earlier: The plan of another time of the stage; what its techniques prepared is taken over where the world is
            the same (`Scene.shares_world`). It decides nothing but what a request for a time has learnt (`Plan.pace`).
        costs: What the machine's steps cost; None: what is known of it, `calibration.known`.

    Raises:
        ValueError: an unknown method, an impossible size, or no such camera.
    """
    settings, costs = settings or Settings(), costs or calibration.known(scene.device)
    if method not in METHODS and method not in TECHNIQUES:
        near = difflib.get_close_matches(method, [*METHODS, *TECHNIQUES], n=3, cutoff=0.3)
        raise ValueError(f"unknown method '{method}'; nearest: {', '.join(near or [*METHODS, *TECHNIQUES])}")
    view = find_camera(scene, camera, size)
    if earlier is not None and _asks_the_same(earlier, scene, view, settings, method, costs):
        return dataclasses.replace(
            earlier, scene=scene, camera=view, rows=list(earlier.rows), notes=list(earlier.notes)
        )
    if earlier is not None and not earlier.scene.shares_world(scene):
        for name in {row.technique for row in earlier.rows} & set(OF_ALL_TIMES):
            TECHNIQUES[name].take_over(earlier.scene, scene)
    notes: list[Note] = []
    found, clear, rough = _surfaces(scene, settings)
    if method == "none":
        found = []
    pixels, seen = _look(scene, view, [k for k, _ in found], clear, settings)
    if launch.is_compiling() and not (settings.max_error_px or settings.budget_ms):
        # What techniques launch is told before the lights are: those are tried for as long as that is compiled. The choice may
        # yet be another one, where shadows decide it: then a module or two will have been in vain.
        ask = scene, view, settings, method
        guess = [
            row_of(*ask, number, k, scene.parts[k], weight, pixels[k], [], costs)
            for number, (k, weight) in enumerate(found, 1)
        ]
        kernels.begin(kernels.of_plan(Plan(*ask, guess, [], [], [], costs)), scene.device)
    with scene.alone():
        tried, lights = _tried(scene, seen, pixels, [k for k, _ in found], settings, costs)
    # What techniques draw themselves is shadowed where the picture is.
    cast = shadows_of(lights, settings)
    drawn = settings.replace(shadows=cast is not None and cast.direct)
    rows = [
        row_of(scene, view, drawn, method, number, k, scene.parts[k], weight, pixels[k], notes, costs)
        for number, (k, weight) in enumerate(found, 1)
    ]
    alone = len(rows) == 1 and rows[0].reflector.convex
    for row in rows:
        visible = row.pixels > 0
        shares = {} if tried is None else tried.mirrored.get(row.reflector.part, {})
        bounce = bounce_effect(visible, alone, sum(shares.values()), settings)
        if bounce.on:
            solved = mirrored_eyes.solved_forward(scene, row, rows, shares, method, view, costs)
            names = {other.reflector.id: other.name for other in rows}
            how = [f"; {names[number]} by {technique} from the eye behind it" for number, technique in solved.items()]
            bounce = Effect(True, bounce.reason + "".join(how), bounce.numbers | {"solved": solved})
        row.effects["second_bounce"] = bounce
        row.effects["shadows"] = shadow_effect(lights, visible)
    panes = [pane_of(scene, view, settings, method, k, pixels[k]) for k in clear]
    notes += rough if method != "none" else _too_rough(scene, settings, {})
    if settings.kernels != "plain" and not scene.device.is_cuda and vector.missing():
        notes.append(Note("", f"plain kernels only: {vector.missing()} (kernels={settings.kernels})"))
    rows = _with_detail(scene, view, settings, rows, earlier, costs)
    made = Plan(scene, view, settings, method, rows, panes, notes, lights, costs, _seen=seen)
    _fit(made, choice.Pace() if earlier is None else earlier.pace)
    _take_over(made, earlier)
    return made


def _asks_the_same(earlier: Plan, scene: Scene, view: Camera, settings: Settings, method: str, costs: Costs) -> bool:
    """Whether a plan is the answer again: the same request of the same world from the same eye, and no time was asked for."""
    asked = settings, method, costs
    if earlier._revised:
        return False
    still = earlier.scene.shares_world(scene) and earlier.camera.sees_as(view)
    return still and (earlier.settings, earlier.method, earlier.costs) == asked and settings.budget_ms == 0.0


def _field_effect(scene: Scene, row: PlanRow) -> Effect:
    """Whether a local map's depths are those of a field, and why."""
    settings = row.settings
    if settings.local_rays == "exact":
        return Effect(False, "rays through the triangles, local_rays=exact")
    if row.reflector.part not in scene.moving_parts:
        return Effect(False, "the field holds what never moves, this mirror too; rays through the triangles")
    cell = f"cells of {settings.field_cell:g} (field_cell)" if settings.field_cell else "automatic cells (field_cell=0)"
    told = f"depths from the field of what never moves, field_kind={settings.field_kind}, {cell}, local_rays=field"
    return Effect(True, told, {"cell": settings.field_cell})


def _with_detail(scene, camera, settings, rows: list[PlanRow], earlier: Plan | None, costs) -> list[PlanRow]:
    """The rows with the resolution of their local maps, and why."""
    mapped = [row for row in rows if row.technique == "layered_environment" and row.pixels]
    for row in rows:
        seen = "only local maps have one" if row.pixels else "not seen from the camera"
        row.effects.update(dict.fromkeys(("detail", "level_blend", "kept_map", "field"), Effect(False, seen)))
    for row in mapped:
        kept = settings.local_keep_px
        told = f"while what it holds has shifted by less than {kept:g} texels in the mean (local_keep_px)"
        row.effects["kept_map"] = Effect(
            kept > 0.0, told if kept > 0.0 else "made anew where it moves, local_keep_px=0"
        )
        row.effects["field"] = _field_effect(scene, row)
    if not (settings.local_detail or settings.local_texels) or settings.max_error_px or settings.budget_ms:
        asked = settings.max_error_px or settings.budget_ms
        why = "a request for an error or a time decides" if asked else "local_detail=0, local_texels=0"
        for row in mapped:
            row.effects["detail"] = row.effects["level_blend"] = Effect(False, why)
        return rows
    sizes = {row.reflector.id: detail.size_px(scene, camera, row.reflector.part) for row in mapped}
    known = earlier.rows if earlier is not None and earlier.settings == settings else []
    before = {row.reflector.id: row.settings.local_edge for row in known if row.effects["detail"].on}
    found, made = detail.details(sizes, settings, before, {row.reflector.id: row.pixels for row in mapped}), []
    for row in rows:
        if row.reflector.id in found:
            level = found[row.reflector.id]
            row.effects["detail"] = Effect(True, level.reason, level.numbers)
            blend = settings.local_blend
            told = (
                f"no pixel changes by more than {blend:g} grey levels a frame where its map's texels do (local_blend)"
            )
            row.effects["level_blend"] = Effect(
                blend > 0.0, told if blend > 0.0 else "maps switch at once, local_blend=0"
            )
            own = row.settings.replace(local_resolution=level.resolution)
            ask = (scene, row.reflector, camera, row.technique, row.pixels, own, costs)
            row = dataclasses.replace(row, settings=own, predicted=predicted_of(*ask))
        made.append(row)
    return made


def _too_rough(scene: Scene, settings: Settings, weights: dict[int, float]) -> list[Note]:
    """A note for each material that would be a mirror if it were smoother."""
    smoother, notes = settings.replace(reflector_max_roughness=1.0), []
    one_of: dict[int, PartRange] = {}
    for part in scene.parts:
        one_of.setdefault(part.material, part)
    for number, part in one_of.items():
        material = scene.data.materials[number]
        rougher = mirror_roughness(material) > settings.reflector_max_roughness
        if rougher and not weights.get(number, 0.0) and mirror_weight(scene, part, smoother):
            text = f"roughness {mirror_roughness(material):.3g} > {settings.reflector_max_roughness:g}"
            text += " (reflector_max_roughness): no mirror; what it reflects is scattered"
            notes.append(Note(material.path or part.prim_path, text))
    return list(dict.fromkeys(notes))


def _surfaces(scene: Scene, settings: Settings) -> tuple[list[tuple[int, float]], list[int], list[Note]]:
    """((part, its weight) of every mirror; the transparent parts; `_too_rough`): of materials alone, at any time."""

    def make() -> tuple[list[tuple[int, float]], list[int], list[Note]]:
        weights = _weights(scene, settings)
        found = [(k, weight) for k, part in enumerate(scene.parts) if (weight := weights.get(part.material, 0.0))]
        clear = [k for k, part in enumerate(scene.parts) if is_transparent(scene, part)]
        return found, clear, _too_rough(scene, settings, weights)

    key = "surfaces", settings.reflector_max_roughness, settings.reflector_min_weight
    return scene.kept_always(key, make)


def _weights(scene: Scene, settings: Settings) -> dict[int, float]:
    """`mirror_weight` of every material in use."""
    one_of = {part.material: part for part in scene.parts}
    return {material: mirror_weight(scene, part, settings) for material, part in one_of.items()}


def prefer_forward(plan: Plan, earlier: Plan | None = None) -> Plan:
    """The plan with virtual objects wherever they can be: no mirror is traced because that is expected to be faster.

    Args:
        plan: Rows that were forced stay.
        earlier: As for `make_plan`.
    """
    scene, camera = plan.scene, plan.camera
    rows = []
    for row in plan.rows:
        held = [(name, *applicable.applies(scene, row.reflector, camera, name, row.settings)) for name in PREFERRED]
        chosen = next(((name, reason) for name, applies, reason in held if applies), None)
        if row.technique == "raytraced" and not row.forced and plan.method == "auto" and chosen is not None:
            name, reason = chosen
            predicted = predicted_of(scene, row.reflector, camera, name, row.pixels, row.settings, plan.costs)
            reason = f"{reason}; for its virtual objects"
            row = dataclasses.replace(row, technique=name, reason=reason, predicted=predicted)
        rows.append(row)
    made = dataclasses.replace(plan, rows=rows, _prepared={}, _revised=True)
    _take_over(made, plan)
    _take_over(made, earlier)
    return made


def with_techniques(plan: Plan, techniques: Mapping[int, str]) -> Plan:
    """The plan with mirrors' techniques chosen by hand.

    Args:
        plan: What it decided for the other mirrors stands, and so do its notes.
        techniques: Reflector id to a key of `TECHNIQUES`; one that does not apply is left out, with a note.
    """
    scene, rows, notes = plan.scene, [], list(plan.notes)
    for row in plan.rows:
        name = techniques.get(row.reflector.id, row.technique)
        if name != row.technique or row.reflector.id in techniques:
            applies, reason = applicable.applies(scene, row.reflector, plan.camera, name, row.settings)
            if applies:
                ask = (scene, row.reflector, plan.camera, name, row.pixels, row.settings, plan.costs)
                row = _changed(plan, row, name, row.settings, f"asked for; {reason}", predicted_of(*ask), forced=True)
            else:
                notes.append(Note(row.path, f"{name} does not apply ({reason})"))
        rows.append(row)
    made = dataclasses.replace(plan, rows=rows, notes=notes, _prepared={}, _revised=True)
    _take_over(made, plan)
    return made


def _take_over(made: Plan, earlier: Plan | None) -> None:
    """Hand over what an earlier plan's techniques prepared, where it is still that."""
    if earlier is None:
        return
    before = {row.reflector: row for row in earlier.rows}
    for row in made.rows:
        known = before.get(row.reflector)
        if known is None or known.settings != row.settings:
            continue
        number = row.reflector.id
        if known.technique == row.technique and number in earlier._prepared and _holds(made, earlier, row):
            made._prepared[number] = earlier._prepared[number]


def _holds(made: Plan, earlier: Plan, row: PlanRow) -> bool:
    """Whether what was prepared for a row is what would be now."""
    if earlier.scene.shares_world(made.scene):
        return True
    alone = row.technique in OF_MIRROR and not (row.settings.grid_share or row.settings.grid_error_px)
    return alone and not made.scene.data.baked_maps and made.scene.stands_as_in(earlier.scene, row.reflector.part)


def find_camera(scene: Scene, camera: str | Camera | None, size: tuple[int, int]) -> Camera:
    """The named camera of a scene (path or unique name; None: the first) at an image size.

    Raises:
        ValueError: an impossible size, no such camera, or a `Camera` that no picture can be drawn by.
    """
    width, height = (int(side) for side in size)
    if not (1 <= width <= raster.GUARD and 1 <= height <= raster.GUARD):
        raise ValueError(f"size: got {width}x{height}, expected 1 to {int(raster.GUARD)} pixels a side")
    if isinstance(camera, Camera):
        _check(camera)
        return dataclasses.replace(camera, size=(width, height)) if camera.size != (width, height) else camera
    cameras = scene.data.cameras
    if camera is None:
        if not cameras:
            raise ValueError("camera: the stage has none; give a Camera")
        return Camera.from_data(cameras[0], (width, height))
    matching = [c for c in cameras if c.path == camera or c.path.rpartition("/")[2] == camera]
    exact = [c for c in matching if c.path == camera]
    if len(exact or matching) != 1:
        known = ", ".join(c.path for c in matching or cameras) or "none"
        raise ValueError(f"camera: '{camera}' names {len(matching)} cameras; the stage has: {known}")
    return Camera.from_data((exact or matching)[0], (width, height))


def _check(camera: Camera) -> None:
    """Refuse what would be seen as NaN, or as nothing."""
    vectors, numbers = ("eye", "right", "up", "forward"), ("fx", "fy", "cx", "cy")
    every = *camera.eye, *camera.right, *camera.up, *camera.forward, *(getattr(camera, name) for name in numbers)
    if not all(map(math.isfinite, every)):
        name = next(name for name in (*vectors, *numbers) if not np.isfinite(getattr(camera, name)).all())
        raise ValueError(f"camera: {name}: got {getattr(camera, name)}, expected finite numbers")
    for name in ("fx", "fy"):
        if getattr(camera, name) == 0.0:
            raise ValueError(f"camera: {name}: got 0, expected another number of pixels")
    for name in ("near", "far"):
        if np.isnan(getattr(camera, name)):
            raise ValueError(f"camera: {name}: got nan, expected a depth")


def _look(
    scene: Scene, camera: Camera, mirrors: list[int], panes: list[int], settings: Settings
) -> tuple[dict[int, int], EyeView | None]:
    """(pixels of each part; what the camera sees, if it was drawn)."""
    casting = needs_probe(scene, settings)
    looks = scene.triangle_count > 0 and bool(mirrors or panes or casting)
    if looks:
        kernels.begin(kernels.of_view(settings, scene.device, casting, bool(mirrors)), scene.device)
    if not (looks and casting):
        kernels.begin_last()
    if not looks:
        return dict.fromkeys([*mirrors, *panes], 0), None

    def begin_mirrors(gbuffer: GBuffer) -> None:
        some = gbuffer.triangle.numpy()[::GLANCE]
        is_mirror = np.zeros(len(scene.patch_shapes), bool)
        for part in mirrors:
            is_mirror[list(scene.parts[part].patches)] = True
        if is_mirror[scene.host_triangle_patch[some[some >= 0]]].any():
            kernels.begin(kernels.of_mirrors(settings, scene.device, casting), scene.device)
        kernels.begin_last()

    seen = look(scene, camera, dict(enumerate(mirrors, 1)), settings.threads, settings.kernels, begin_mirrors)
    return seen.pixels_of(scene, [*mirrors, *panes], settings.threads, settings.kernels), seen


def _tried(
    scene: Scene, seen: EyeView | None, pixels: Mapping[int, int], mirrors: list[int], settings: Settings, costs: Costs
) -> tuple[Probe | None, list[LightRow]]:
    """(What is tried of what the camera sees, where lights or bounces are decided by that; the lights).

    A quarter of the points is enough where every light clearly casts shadows and every mirror shows a mirror; not of shapes,
    the cost of whose shadows hangs on how far their penumbras reach. Where mirrors alone are in doubt, light is not tried again.
    """
    clear = [k for k in mirrors if pixels[k] >= max(settings.few_pixels, 1)]
    facing = settings.bounces > 1 and (len(mirrors) > 1 or any(not scene.body(k).convex for k in clear))
    casting = needs_probe(scene, settings)
    if seen is None or not (casting or facing):
        return None, plan_lights(scene, None, settings, costs)
    if not casting:  # points cost less than trying twice
        tried = probe(scene, seen, settings.threads, 1, False)
        return tried, plan_lights(scene, tried, settings, costs)
    if not any(light.kind in AREA_KINDS for light in scene.data.lights):
        tried = probe(scene, seen, settings.threads, 2, True)
        lights = plan_lights(scene, tried, settings, costs)
        if are_clear(lights, settings):
            if facing and not all(tried.mirrored.values()):
                tried = probe(scene, seen, settings.threads, 1, False)
            return tried, lights
    tried = probe(scene, seen, settings.threads, 1, True)
    return tried, plan_lights(scene, tried, settings, costs)


def _fit(made: Plan, pace: choice.Pace, keep: Plan | None = None) -> None:
    """Choose techniques and settings anew where the user asks for an error or a time.

    Args:
        made: Changed in place.
        pace: What is known of how long things take.
        keep: A plan of the same request whose choice stands, where it is one of this plan's.
    """
    settings = made.settings
    if not (settings.max_error_px > 0.0 or settings.budget_ms > 0.0):
        return
    if made.method == "reference":
        ms, budget = made.predicted["ms"], settings.budget_ms
        told = f"budget_ms={budget:g} gave way: method=reference traces every mirror, in {ms:.3g} ms (predicted)"
        _tell(made, [told] if 0.0 < budget < ms else [])
        return
    rows = {row.reflector.id: row for row in made.rows if row.pixels >= max(settings.few_pixels, 1)}
    if not made._ways:
        made._ways = {id: _options(made, row) for id, row in rows.items()}
    ways = {
        id: [dataclasses.replace(option, pace=pace.of(option.technique)) for option in options]
        for id, options in made._ways.items()
    }
    tiny = sum(pace.of(row.technique) * row.predicted["ms"] for row in made.rows if row.reflector.id not in rows)
    chosen = choice.choose(
        {id: choice.frontier(options) for id, options in ways.items()},
        {id: row.pixels for id, row in rows.items()},
        pace.of(choice.VIEW) * made.fixed_ms + tiny,
        settings.max_error_px,
        settings.budget_ms,
    )
    if keep is not None:
        before = {row.reflector.id: (row.technique, row.settings) for row in keep.rows}
        for id, options in ways.items():
            same = next((each for each in options if (each.technique, each.settings) == before.get(id)), None)
            chosen.options[id] = same or chosen.options[id]
    for k, row in enumerate(made.rows):
        option = chosen.options.get(row.reflector.id)
        if option is None:
            continue
        reason = chosen.reasons[row.reflector.id]
        made.rows[k] = _changed(made, row, option.technique, option.settings, reason, option.predicted)
    _tell(made, chosen.notes)
    made.pace = pace


def _tell(made: Plan, texts: list[str]) -> None:
    """Notes of the request for an error or a time, in place of those told before."""
    kept = made.notes[: len(made.notes) - made._told]
    made.notes, made._told = kept + [Note(made.scene.data.source, text) for text in texts], len(texts)


def _changed(plan: Plan, row: PlanRow, technique, settings, reason, predicted, forced: bool = False) -> PlanRow:
    """A mirror's row with another choice, and the effects that follow from it."""
    weight = row.effects["reflection"].numbers["weight"]
    part = plan.scene.parts[row.reflector.part]
    return dataclasses.replace(
        row,
        technique=technique,
        forced=forced or row.forced,
        reason=reason,
        settings=settings,
        predicted=predicted,
        effects=row.effects | effects_of(plan.scene, part, technique, row.pixels, weight, settings),
    )


def _options(made: Plan, row: PlanRow) -> list[choice.Option]:
    """Every way to reflect a mirror that a plan may take for a request."""
    scene, camera, settings = made.scene, made.camera, made.settings
    ask = (scene, row.reflector, camera, row.pixels, settings)
    work = {row.technique: applicable.work_of(scene, row.reflector, camera, row.technique, row.pixels, settings)}
    if not row.forced:
        found, _ = applicable.exact_candidates(*ask, made.costs)
        work |= {each.technique: each.work for each in found}
        work["raytraced"] = applicable.work_of(scene, row.reflector, camera, "raytraced", row.pixels, settings)
        far = applicable.far_environment(*ask, settings.max_error_px or float("inf"))
        work |= {far.technique: far.work} if far is not None else {}
    return choice.options_of(work, settings, made.costs, launch.thread_count(scene.device, settings.threads))
