"""What a scene calls for, and why: `make_plan` decides once, everything later reads the `Plan`."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass, field

import numpy as np

from warp_reflect import __version__, budget, raster
from warp_reflect.effects import Effect, finish_effects
from warp_reflect.layers import Camera, Reflector
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Note, PartRange, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import MAPS, TECHNIQUES

PREFERRED = ("planar", "quadric", "reflector_map")  # the exact and cheap first
JUDGED_IN_PIXELS = ("planar", "quadric")  # whether they apply depends on the view
METHODS = ("auto", "reference")
REUSING = ("quadric", "reflector_map")  # know a bound on how far a virtual vertex drifts
DEFAULT_SIZE = (960, 540)  # usdrecord's default width at 16:9


@dataclass(frozen=True)
class PlanRow:
    """What is simulated for one reflector."""

    reflector: Reflector
    path: str
    subset: str
    instance: str
    technique: str
    forced: bool
    reason: str
    pixels: int
    effects: dict[str, Effect]
    settings: Settings
    predicted: dict[str, float]

    @property
    def name(self) -> str:
        """The mirror's prim path, with which copy and which subset of it."""
        return self.path + (f"[{self.instance}]" if self.instance else "") + (f":{self.subset}" if self.subset else "")


@dataclass
class Plan:
    """What a frame simulates; also the owner of what the techniques prepared.

    Attributes:
        rows: One `PlanRow` per reflector, in the order of their ids.
        notes: What the user should know about the plan, beside the scene's own notes.
    """

    scene: Scene
    camera: Camera
    settings: Settings
    method: str
    rows: list[PlanRow]
    notes: list[Note]
    _prepared: dict[int, object] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the frames, in pixels."""
        return self.camera.size

    def prepared(self, row: PlanRow) -> object:
        """The technique's view-independent data of a reflector, made at first use."""
        if row.reflector.id not in self._prepared:
            technique = TECHNIQUES[row.technique]
            self._prepared[row.reflector.id] = technique.prepare(self.scene, row.reflector, row.settings)
        return self._prepared[row.reflector.id]

    def at(self, scene: Scene) -> Plan:
        """The plan for its stage at another time: decided anew, with its own camera there."""
        if scene is self.scene:
            return self
        moving = any(camera.path == self.camera.path for camera in scene.data.cameras)
        camera = self.camera.path if moving else self.camera
        return make_plan(scene, camera, self.size, self.settings, self.method, earlier=self)

    def to_json(self) -> dict:
        """The plan as `warp-reflect plan --json` prints it."""
        return {
            "version": __version__,
            "stage": self.scene.data.source,
            "camera": self.camera.path,
            "size": list(self.camera.size),
            "time": self.scene.data.time,
            "method": self.method,
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
            "notes": [{"path": note.path, "text": note.text} for note in [*self.scene.notes, *self.notes]],
        }

    def __str__(self) -> str:
        width, height = self.camera.size
        lines = [f"{self.scene.data.source}  camera {self.camera.path}  {width}x{height}"]
        if not self.rows:
            return "\n".join([*lines, "no reflector: nothing is simulated beyond the direct picture"])
        names = [row.name for row in self.rows]
        column = max(len("mirror"), *map(len, names))
        technique = max(len("technique"), *(len(row.technique) + 7 * row.forced for row in self.rows))
        lines.append(
            f"  # {'mirror':{column}}  {'technique':{technique}}  {'pixels':>9}  {'error px':>8}  {'ms':>8}  {'kB':>8}"
        )
        for row, name in zip(self.rows, names, strict=True):
            chosen = row.technique + " forced" * row.forced
            numbers = (
                f"{row.predicted['error_px']:8.2f}  {row.predicted['ms']:8.2f}  {row.predicted['bytes'] / 1e3:8,.0f}"
            )
            lines.append(f"{row.reflector.id:3d} {name:{column}}  {chosen:{technique}}  {row.pixels:9,d}  {numbers}")
            lines.append(f"    {row.reason}")
            lines += [f"    {'on ' if each.on else 'off'} {name}: {each.reason}" for name, each in row.effects.items()]
        return "\n".join(lines)


def make_plan(
    scene: Scene,
    camera: str | Camera | None = None,
    size: tuple[int, int] = DEFAULT_SIZE,
    settings: Settings | None = None,
    method: str = "auto",
    earlier: Plan | None = None,
) -> Plan:
    """Decide what is simulated for every reflector of a scene.

    Args:
        scene: From `load_stage`.
        camera: Prim path or name of a camera in the stage, or a `Camera`; None: the stage's first.
        size: (width, height). [pixels]
        settings: The knobs; None: the defaults.
        method: `auto`, `reference` (every mirror traced) or a key of `TECHNIQUES`; where it does not apply the mirror
            is traced, with a note.
        earlier: The plan of another time of the stage; what its techniques prepared is taken over where the world is
            the same (`Scene.shares_world`). It decides nothing.

    Raises:
        ValueError: an unknown method, an impossible size, or no such camera.
    """
    settings = settings or Settings()
    if method not in METHODS and method not in TECHNIQUES:
        near = difflib.get_close_matches(method, [*METHODS, *TECHNIQUES], n=3, cutoff=0.3)
        raise ValueError(f"unknown method '{method}'; nearest: {', '.join(near or [*METHODS, *TECHNIQUES])}")
    view = find_camera(scene, camera, size)
    notes: list[Note] = []
    found = [
        (k, part, weight) for k, part in enumerate(scene.parts) if (weight := mirror_weight(scene, part, settings))
    ]
    pixels = _pixel_counts(scene, view, [k for k, _, _ in found], settings)
    rows = [
        _row(scene, view, settings, method, number, part_index, part, weight, pixels[part_index], notes)
        for number, (part_index, part, weight) in enumerate(found, 1)
    ]
    bumpy = [scene.data.materials[part.material] for _, part, _ in found]
    for path in dict.fromkeys(material.path for material in bumpy if "normal" in material.textures):
        notes.append(
            Note(path, "texture of normal: a mirror reflects at the surface itself; its normal map is not used")
        )
    made = Plan(scene, view, settings, method, rows, notes)
    _take_over(made, earlier)
    return made


def prefer_forward(plan: Plan, earlier: Plan | None = None) -> Plan:
    """The plan with virtual objects wherever they can be: no mirror is traced because that is expected to be faster.

    Args:
        plan: Rows that were forced stay.
        earlier: As for `make_plan`.
    """
    scene, camera = plan.scene, plan.camera
    rows = []
    for row in plan.rows:
        held = [(name, *_applies(scene, row.reflector, camera, name, row.settings)) for name in PREFERRED]
        chosen = next(((name, reason) for name, applies, reason in held if applies), None)
        if row.technique == "raytraced" and not row.forced and plan.method == "auto" and chosen is not None:
            name, reason = chosen
            part = scene.parts[row.reflector.part]
            work = _work(scene, row.reflector, camera, name)
            predicted = budget.predict(scene, part, name, row.pixels, row.settings, *work)
            reason = f"{reason}; for its virtual objects"
            row = dataclasses.replace(row, technique=name, reason=reason, predicted=predicted)
        rows.append(row)
    made = dataclasses.replace(plan, rows=rows, _prepared={})
    _take_over(made, plan)
    _take_over(made, earlier)
    return made


def _take_over(made: Plan, earlier: Plan | None) -> None:
    """Hand over what an earlier plan's techniques prepared, where it is still that."""
    if earlier is None or not earlier.scene.shares_world(made.scene):
        return
    before = {row.reflector: row for row in earlier.rows}
    for row in made.rows:
        known = before.get(row.reflector)
        if known is not None and (known.technique, known.settings) == (row.technique, row.settings):
            made._prepared |= {k: v for k, v in earlier._prepared.items() if k == row.reflector.id}


def find_camera(scene: Scene, camera: str | Camera | None, size: tuple[int, int]) -> Camera:
    """The named camera of a scene (path or unique name; None: the first) at an image size."""
    width, height = (int(side) for side in size)
    if not (1 <= width <= raster.GUARD and 1 <= height <= raster.GUARD):
        raise ValueError(f"size: got {width}x{height}, expected 1 to {int(raster.GUARD)} pixels a side")
    if isinstance(camera, Camera):
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


# Triangles. Finding out what a larger mesh is (a quadric, convex sheets) takes seconds: `auto` leaves it where the outcome
# is several sheets at best, or would lose against tracing even if it were one.
ANALYSED_MAX = 20000
PREVIEW_SIDE = 320  # pixels; enough to count a mirror's pixels within a few per cent for the choice of technique


def _pixel_counts(scene: Scene, camera: Camera, parts: list[int], settings: Settings) -> dict[int, int]:
    """Pixels that show each part from the camera, counted in a small picture."""
    if not parts or not scene.triangle_count:
        return dict.fromkeys(parts, 0)
    width, height = camera.size
    shrink = max(1.0, max(width, height) / PREVIEW_SIDE)
    small = dataclasses.replace(
        camera,
        size=(max(1, round(width / shrink)), max(1, round(height / shrink))),
        fx=camera.fx / shrink,
        fy=camera.fy / shrink,
        cx=camera.cx / shrink,
        cy=camera.cy / shrink,
    )
    triangle = raster.draw_scene(scene, small, settings.threads).triangle.numpy()
    patches = np.bincount(scene.host_triangle_patch[triangle[triangle >= 0]], minlength=len(scene.patch_shapes))
    scale = width * height / (small.size[0] * small.size[1])
    return {k: round(float(patches[list(scene.parts[k].patches)].sum()) * scale) for k in parts}


def _row(scene, camera, settings, method, number, part_index, part, weight, pixels, notes) -> PlanRow:
    looked_at = method != "auto" or pixels >= max(settings.few_pixels, 1)
    reflector = Reflector(number, part_index, looked_at and scene.body(part_index).convex)
    technique, forced, reason = _technique(scene, reflector, camera, method, pixels, settings, part, notes)
    if method == "reference":
        settings = settings.replace(refine="off")
    predicted = budget.predict(scene, part, technique, pixels, settings, *_work(scene, reflector, camera, technique))
    if technique == "environment" and pixels:
        predicted["error_px"] = TECHNIQUES[technique].parallax_px(scene, reflector, camera, settings.threads)
    return PlanRow(
        reflector,
        part.prim_path,
        part.subset,
        part.instance,
        technique,
        forced,
        reason,
        pixels,
        _effects(scene, part, technique, pixels, weight, settings),
        settings,
        predicted,
    )


def _technique(scene, reflector, camera, method, pixels, settings, part, notes) -> tuple[str, bool, str]:
    """(technique, forced, reason) of a reflector."""
    if method == "reference":
        return "raytraced", True, "the reference: every mirror is traced"
    mirror = scene.data.materials[part.material].mirror
    if method == "auto" and mirror is not None and mirror.technique != "auto":
        if mirror.technique in TECHNIQUES:
            method = mirror.technique
        else:
            known = ", ".join(TECHNIQUES)
            notes.append(Note(part.prim_path, f"technique: got '{mirror.technique}', expected auto or one of {known}"))
    if method != "auto":
        applies, reason = _applies(scene, reflector, camera, method, settings)
        if applies:
            return method, True, f"asked for; {reason}"
        notes.append(Note(part.prim_path, f"{method} does not apply ({reason}); traced"))
        return "raytraced", False, f"{method} was asked for but does not apply: {reason}"
    if pixels == 0:
        return "raytraced", False, "not seen from the plan's camera: nothing is done, and rays serve another camera"
    if pixels < settings.few_pixels:
        why = f"{pixels} pixels, fewer than few_pixels={settings.few_pixels}: rays are cheapest, its shape is not looked at"
        return "raytraced", False, why
    reasons = []
    traced = budget.predict(scene, part, "raytraced", pixels, settings)["ms"]
    for name in PREFERRED:
        least = budget.predict(scene, part, name, pixels, settings)["ms"]
        if name != "planar" and part.triangle_count > ANALYSED_MAX and (traced < least or not reflector.convex):
            reasons.append(
                f"{part.triangle_count} triangles that are not convex together, or dearer to reflect than to trace, are "
                f"not analysed by auto (at most {ANALYSED_MAX})"
            )
            break
        applies, reason = _applies(scene, reflector, camera, name, settings)
        if not applies:
            reasons.append(f"{name}: {reason}")
            continue
        forward = budget.predict(scene, part, name, pixels, settings, *_work(scene, reflector, camera, name))["ms"]
        if traced < forward:
            return (
                "raytraced",
                False,
                f"{reason}, but {pixels} pixels are traced in {traced:.1f} ms and "
                f"{scene.vertex_count} vertices reflected in {forward:.1f} ms (predicted)",
            )
        return name, False, reason
    return "raytraced", False, "; ".join(reasons)


def _work(scene, reflector, camera: Camera, technique: str) -> tuple[bool, int, float]:
    """`budget.predict`'s branches, passes and held."""
    module = TECHNIQUES[technique]
    branches = technique in ("quadric", "reflector_map") and module.has_branches(scene, reflector, camera)
    passes, held = module.extent(scene, reflector) if technique in ("quadric", "reflector_map") else (1, 1.0)
    return branches, passes, held


def _applies(scene, reflector, camera: Camera, method: str, settings: Settings) -> tuple[bool, str]:
    if camera.orthographic and method not in ("raytraced", *MAPS):
        return False, "orthographic camera: there is no eye to reflect from"
    if method in JUDGED_IN_PIXELS:
        return TECHNIQUES[method].applies(scene, reflector, camera, settings.shape_px)
    return TECHNIQUES[method].applies(scene, reflector)


def _collection(scene: Scene, part: PartRange) -> Effect:
    seen = scene.seen_in(part)
    if seen is None:
        return Effect(False, "no collection named reflects: it shows everything")
    count = int(seen.sum())
    return Effect(True, f"its collection named reflects holds {count} of {len(seen)} triangles", {"triangles": count})


def _effects(scene, part, technique, pixels, weight, settings) -> dict[str, Effect]:
    traced, mapped = technique == "raytraced", technique in MAPS
    searched = not traced and not mapped
    no_search = "maps are looked up" if mapped else "no search"
    visible = pixels > 0
    chosen = scene.data.materials[part.material].mirror is not None
    bound = "chosen by name" if chosen else f">= {settings.reflector_min_weight} (reflector_min_weight)"
    return {
        "reflection": Effect(
            visible,
            f"mirror weight {weight:.2f} {bound}, {pixels} pixels" if visible else "not seen from the camera",
            {"weight": weight, "pixels": pixels},
        ),
        "collection": _collection(scene, part),
        "refinement": Effect(
            visible and searched and settings.refine != "off",
            "traced rays are exact already"
            if traced
            else "maps are looked up: there is no candidate to refine"
            if mapped
            else f"refine={settings.refine}",
        ),
        "grid": Effect(
            visible and technique == "reflector_map" and (settings.grid_share > 0.0 or settings.grid_error_px > 0.0),
            f"grid_share={settings.grid_share:g}, grid_error_px={settings.grid_error_px:g}"
            if technique == "reflector_map"
            else "only reflector maps are interpolated",
        ),
        "reuse": Effect(
            visible and technique in REUSING and settings.reuse_px > 0.0,
            f"reuse_px={settings.reuse_px:g}" if technique in REUSING else "no search that could be left out",
        ),
        "warm_start": Effect(
            visible and searched, "from the previous frame where one is given" if searched else no_search
        ),
        "shadows": Effect(settings.shadows, f"shadows={settings.shadows}"),
        "second_bounce": Effect(False, "a mirror seen in a mirror shows its base and the dome, one level deep"),
        **finish_effects(scene, part, visible, settings),
    }
