"""A row of a plan: what is simulated for one mirror or one pane, and why."""

from __future__ import annotations

from dataclasses import dataclass

from warp_reflect import applicable
from warp_reflect.budget import predict
from warp_reflect.effects import Effect, finish_effects, pane_effects, refraction_effect
from warp_reflect.launch import thread_count
from warp_reflect.layers import Reflector
from warp_reflect.lighting import LightRow
from warp_reflect.reflectors import interface_of
from warp_reflect.scene import Note, PartRange, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import MAPS, TECHNIQUES

REUSING = ("quadric", "reflector_map")  # know a bound on how far a virtual vertex drifts


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
        return _name(self)


@dataclass(frozen=True)
class PaneRow:
    """What is simulated for one transparent surface."""

    part: int
    path: str
    subset: str
    instance: str
    interface: str  # "thin" or "solid"
    pixels: int
    effects: dict[str, Effect]
    settings: Settings

    @property
    def name(self) -> str:
        """The surface's prim path, with which copy and which subset of it."""
        return _name(self)


def _name(row: PlanRow | PaneRow) -> str:
    return row.path + (f"[{row.instance}]" if row.instance else "") + (f":{row.subset}" if row.subset else "")


def row_of(scene, camera, settings, method, number, part_index, part, weight, pixels, notes, costs) -> PlanRow:
    """A mirror's row.

    Args:
        scene, camera, settings, method, costs: Of the plan.
        number: The reflector's id.
        part_index, part: Into `scene.parts`, and what is there.
        weight: Its `mirror_weight`.
        pixels: That show it.
        notes: Changed: told of what was asked for and cannot be.
    """
    looked_at = method != "auto" or pixels >= max(settings.few_pixels, 1)
    reflector = Reflector(number, part_index, looked_at and scene.body(part_index).convex)
    technique, forced, reason = _technique(scene, reflector, camera, method, pixels, settings, part, notes, costs)
    if method == "reference":
        settings = settings.replace(refine="off")
    if technique == "layered_environment" and pixels:
        told = TECHNIQUES[technique].plan_notes(scene, reflector, settings)
        notes += [note for note in told if note not in notes]
    return PlanRow(
        reflector,
        part.prim_path,
        part.subset,
        part.instance,
        technique,
        forced,
        reason,
        pixels,
        effects_of(scene, part, technique, pixels, weight, settings),
        settings,
        predicted_of(scene, reflector, camera, technique, pixels, settings, costs),
    )


def pane_of(scene, camera, settings, method, part_index, pixels) -> PaneRow:
    """A transparent surface's row; arguments as for `row_of`."""
    part = scene.parts[part_index]
    interface, reason = interface_of(scene, part_index)
    effects = pane_effects(scene, part, interface, reason, pixels, settings, camera)
    effects["refraction_image"] = refraction_effect(scene, part_index, interface, pixels, settings, camera, method)
    return PaneRow(part_index, part.prim_path, part.subset, part.instance, interface, pixels, effects, settings)


def predicted_of(scene, reflector, camera, technique, pixels, settings, costs) -> dict:
    """Predicted time, error and memory of a mirror by a technique: `budget.predict`."""
    work = applicable.work_of(scene, reflector, camera, technique, pixels, settings)
    return predict(work, technique, settings, costs, thread_count(scene.device, settings.threads))


def _technique(scene, reflector, camera, method, pixels, settings, part, notes, costs) -> tuple[str, bool, str]:
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
        applies, reason = applicable.applies(scene, reflector, camera, method, settings)
        if applies:
            return method, True, f"asked for; {reason}"
        notes.append(Note(part.prim_path, f"{method} does not apply ({reason}); traced"))
        return "raytraced", False, f"{method} was asked for but does not apply: {reason}"
    if pixels == 0:
        return "raytraced", False, "not seen from the plan's camera: nothing is done, and rays serve another camera"
    if pixels < settings.few_pixels:
        why = f"{pixels} pixels, fewer than few_pixels={settings.few_pixels}: rays are cheapest, its shape is not looked at"
        return "raytraced", False, why
    return _cheapest(scene, reflector, camera, pixels, settings, costs)


def _cheapest(scene, reflector, camera, pixels, settings, costs) -> tuple[str, bool, str]:
    """(technique, False, reason): the first exact one that applies, unless rays or a map of what is far are cheaper."""
    threads = thread_count(scene.device, settings.threads)
    found, refused = applicable.exact_candidates(scene, reflector, camera, pixels, settings, costs)
    rays = predicted_of(scene, reflector, camera, "raytraced", pixels, settings, costs)["ms"]
    name, reason, least = "raytraced", "; ".join(refused), rays
    if found:
        name, reason = found[0].technique, found[0].reason
        least = predict(found[0].work, name, settings, costs, threads)["ms"]
        if rays < least:
            reason = (
                f"{reason}, but {pixels} pixels are traced in {rays:.1f} ms and {scene.vertex_count} vertices reflected "
                f"in {least:.1f} ms (predicted)"
            )
            name, least = "raytraced", rays
    far = applicable.far_environment(scene, reflector, camera, pixels, settings, settings.environment_px)
    if far is not None and predict(far.work, far.technique, settings, costs, threads)["ms"] < least:
        return far.technique, False, f"{far.reason} (at most environment_px={settings.environment_px:g})"
    return name, False, reason


def effects_of(scene, part, technique, pixels, weight, settings) -> dict[str, Effect]:
    """The effects that a mirror's technique, settings and material turn on; arguments as for `row_of`."""
    traced, mapped = technique == "raytraced", technique in MAPS
    searched = not traced and not mapped
    no_search = "maps are looked up" if mapped else "no search"
    visible = pixels > 0
    material = scene.data.materials[part.material]
    bound = f">= {settings.reflector_min_weight} (reflector_min_weight)"
    if material.transmission > 0.0:
        kept = f"{1.0 - material.transmission:g}, what is not let through"
        bound = f">= {kept}, x {settings.reflector_min_weight} (reflector_min_weight)"
    if material.mirror is not None:
        bound = "chosen by name"
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
        **finish_effects(scene, part, visible, settings, technique),
    }


def _collection(scene: Scene, part: PartRange) -> Effect:
    seen = scene.seen_in(part)
    if seen is None:
        return Effect(False, "no collection named reflects: it shows everything")
    count = int(seen.sum())
    return Effect(True, f"its collection named reflects holds {count} of {len(seen)} triangles", {"triangles": count})


def shadow_effect(lights: list[LightRow], visible: bool) -> Effect:
    """Shadows among what a mirror shows: of the lights that cast them."""
    casting = [row.path for row in lights if row.effects["shadows"].on]
    if not casting:
        return Effect(False, "no light casts shadows into view (see the lights)")
    return Effect(visible, f"cast by {', '.join(casting)}" if visible else "not seen from the camera")
