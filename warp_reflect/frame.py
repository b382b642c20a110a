"""One frame: the eye view, every reflector by its planned technique, shading. `render_frame` reads as the method."""

from __future__ import annotations

import dataclasses
import importlib
import os
from collections.abc import Iterable, Mapping
from functools import cached_property, partial
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_reflect import (
    __version__,
    bounces,
    images,
    kernels,
    mirrored_eyes,
    probe,
    shade,
    surface,
)
from warp_reflect.channels import CHANNELS, POINTS, component_of, known_names, reflection_channels
from warp_reflect.choice import Spent
from warp_reflect.counts import add_statistics
from warp_reflect.effects import FINISHES, PANE_FINISHES, finish_of, moves_with_time
from warp_reflect.layers import NO_REFLECTOR, Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.plan_rows import PaneRow, PlanRow
from warp_reflect.planner import Plan, find_camera, keep_pace
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Technique
from warp_reflect.techniques import MAPS, TECHNIQUES
from warp_reflect.timing import StageTimer

if TYPE_CHECKING:
    from warp_reflect import transmission

DIRECT = ("Z", "N", "primId")  # of what the eye sees directly


class Frame:
    """A finished frame; its channels are computed when they are first asked for.

    Attributes:
        scene, plan, camera: What it was made from.
        gbuffer: What the eye sees.
        layers: Reflector id to its `ReflectionLayer`.
        transmitted: Part of a transparent surface to what the eye sees through it.
        statistics: Counts over all reflectors and what is seen through surfaces: pixels settled by `candidate`, `walk`,
            `empty`, `bvh`; vertices; ...; the largest bounds: `reused_px`.
        timings: Milliseconds per stage.
        kept: Ids of the reflectors whose layer is the previous frame's own, as nothing had moved.
        lasts: Whether its arrays stay what they are: those of a `CapturedFrame` are drawn over.
        gone: Whether a `CapturedFrame` has drawn another one over this: nothing can be asked of it any more.
    """

    def __init__(
        self,
        scene: Scene,
        plan: Plan,
        gbuffer: GBuffer,
        layers: Mapping[int, ReflectionLayer],
        picture: tuple,
        timings: Mapping[str, float],
        previous: Frame | None = None,
        transmitted: Mapping[int, transmission.Transmission] | None = None,
        kept: frozenset[int] = frozenset(),
    ):
        # Not the previous frame itself: each would keep the one before it alive.
        self._before = None if previous is None else (previous.scene, previous.camera)
        self.scene, self.plan, self.gbuffer, self.layers = scene, plan, gbuffer, layers
        self.camera: Camera = gbuffer.camera
        self._timings = timings
        self._picture = picture
        self.kept = kept
        self.transmitted = {} if transmitted is None else transmitted
        self.lasts, self.gone = True, False

    @cached_property
    def timings(self) -> dict[str, float]:
        """See above; waited for when first asked for."""
        return dict(self._timings)

    @cached_property
    def statistics(self) -> dict:
        """See above; counted when first asked for."""
        total: dict = {}
        for layer in (*self.layers.values(), *(each.layer for each in self.transmitted.values())):
            add_statistics(total, layer.statistics)
        return total

    @property
    def spent_ms(self) -> float:
        """Milliseconds of the frame's steps, without preparation."""
        return self.spent.ms

    @property
    def spent(self) -> Spent:
        """The same in parts."""
        outermost = {step: ms for step, ms in self.timings.items() if "/" not in step and step != "prepare"}
        reflect = outermost.pop("reflect", 0.0)
        return Spent(sum(outermost.values()), reflect, self._before is None)

    @property
    def expected_ms(self) -> float:
        """What the plan predicted for them."""
        return self.plan.predicted["first_ms" if self._before is None else "ms"]

    @property
    def prims(self) -> dict[int, str]:
        """`primId` and `reflectedId` to prim path."""
        return self.scene.prims

    @property
    def reflectors(self) -> dict[int, str]:
        """`reflectorId` to the path of the mirror's prim."""
        return {row.reflector.id: row.path for row in self.plan.rows}

    def keys(self) -> list[str]:
        """Every channel group, in the order they are written."""
        return list(CHANNELS)

    def __contains__(self, name: str) -> bool:
        return name in known_names()

    def __getitem__(self, name: str) -> np.ndarray:
        """A channel, float32 [height, width] or [height, width, n].

        On a CPU it may be the frame's own memory, and that of a later frame in which nothing moved: copy it to write to it.

        Args:
            name: A group such as `N`, `reflectedPoint`, `RGBA`, or one component such as `N.X`, `R`.

        Raises:
            KeyError: an unknown name; the message lists the known ones.
        """
        group, component = component_of(name)
        image = self._group(group)
        if group in POINTS:
            there = (self._group("status") > 0) if group == "mirrorPoint" else self["reflectedId"] > 0
            # Added in float64, rounded once; without a copy of the picture in float64.
            world = np.empty(image.shape, np.float32)
            np.add(image, self.camera.eye, out=world, dtype=np.float64, casting="same_kind")
            world[~there] = 0.0
            image = world
        return image if component is None else image[..., component]

    def relative(self, name: str) -> np.ndarray:
        """`mirrorPoint` or `reflectedPoint` relative to the eye, world axes: exact at any offset of the stage.

        Raises:
            KeyError: another name.
        """
        group, component = component_of(name)
        if group not in POINTS:
            raise KeyError(f"'{name}' is no point; relative to the eye are {', '.join(POINTS)}")
        image = self._group(group)
        return image if component is None else image[..., component]

    def device_array(self, name: str) -> wp.array:
        """A channel group as it lies on the device: no copy, for DLPack and the array interfaces.

        `wp.to_torch`, `torch.from_dlpack`, `cupy.asarray` and `numpy.asarray` (on the CPU) take it as it is; it is the frame's
        own memory, to be read.

        Args:
            name: A group such as `N` or `reflectionMotion`.

        Returns:
            Shape [height, width] of float32, int32 (ids of what is seen directly), vec2, vec3 or vec4; `mirrorPoint` and
            `reflectedPoint` are relative to the eye.

        Raises:
            KeyError: an unknown name, or a component.
        """
        group, component = component_of(name)
        if component is not None:
            raise KeyError(f"'{name}' is a component; on the device lie whole groups: {', '.join(CHANNELS)}")
        width, height = self.camera.size
        return self._on_device(group).reshape((height, width))

    def virtual_objects(self, clip: bool = False) -> list:
        """What the mirrors show as meshes behind them, see `virtual_objects.virtual_objects`."""
        from warp_reflect.virtual_objects import virtual_objects

        return virtual_objects(self.scene, self.camera, self.layers, clip)

    def write(
        self,
        path: str | os.PathLike,
        channels: list[str] | None = None,
        attributes: dict | None = None,
        multi_part: bool = False,
    ) -> None:
        """Write the frame: .exr with data channels and the plan in its header, .png with the picture in sRGB.

        Args:
            path: Where; written to a temporary name and renamed.
            channels: Groups or components for an EXR; None: all.
            attributes: More header entries, see `images.write_exr`.
            multi_part: An EXR of one part per channel group instead of one part.

        Raises:
            KeyError: an unknown channel.
            ValueError: an extension other than .exr and .png.
            OSError: the file could not be written.
        """
        images.check_writable(path)
        if os.fspath(path).lower().endswith(".png"):
            images.write_png(path, self["RGBA"][..., :3], attributes)
            return
        data = {name: self[name] for name in (channels or CHANNELS)}
        images.write_exr(path, data, attributes=self._header() | (attributes or {}), multi_part=multi_part)

    def _header(self) -> dict:
        return {
            "warp_reflect:version": __version__,
            "warp_reflect:eye": [float(x) for x in self.camera.eye],
            "warp_reflect:prims": {str(number): path for number, path in self.prims.items()},
            "warp_reflect:reflectors": {str(number): path for number, path in self.reflectors.items()},
            "warp_reflect:settings": dataclasses.asdict(self.plan.settings),
            "warp_reflect:plan": self.plan.to_json(),
        }

    def _group(self, group: str) -> np.ndarray:
        width, height = self.camera.size
        image = self._on_device(group).numpy().astype(np.float32, copy=False)
        return image.reshape(height, width, *image.shape[1:])

    def _on_device(self, group: str) -> wp.array:
        if self.gone:
            raise RuntimeError(f"'{group}': the next captured frame was drawn over this one; ask before that")
        if group == "RGBA":
            return self._picture[0]
        if group == "reflection":
            return self._picture[1]
        if group == "reflectorId":
            return self.gbuffer.reflector_id
        if group == "reflectionMotion":
            return self._motion
        return self._direct[group] if group in DIRECT else self._reflection[group]

    @cached_property
    def _direct(self) -> dict:
        return surface.surface_channels(self.scene, self.gbuffer, self.plan.settings.threads)

    @cached_property
    def _motion(self) -> wp.array:
        if self._before is None:
            return wp.zeros(self.camera.size[0] * self.camera.size[1], dtype=wp.vec2, device=self.scene.device)
        from warp_reflect.motion import reflection_motion

        threads = self.plan.settings.threads
        return reflection_motion(self.scene, self.gbuffer, self.layers, *self._before, threads)

    @cached_property
    def _reflection(self) -> dict[str, wp.array]:
        drawn = frozenset(
            row.reflector.id
            for row in self.plan.rows
            if row.technique in MAPS or (row.settings.refine == "off" and row.technique != "raytraced")
        )
        return reflection_channels(self.scene, self.gbuffer, self.layers, self.plan.settings.threads, drawn)


def render_frame(scene: Scene, plan: Plan, camera: str | Camera | None = None, previous: Frame | None = None) -> Frame:
    """Render a scene as planned. Several threads may: see `Scene.alone`.

    Args:
        scene: The plan's scene, or the same stage at another time, which is planned anew (`Frame.plan`).
        plan: From `make_plan`; keeps what its techniques prepare.
        camera: Another camera than the plan's; None: the plan's.
        previous: The last frame; searches start from its reflection points, and motion is measured from it. Where neither
            the eye nor the world has moved since, its answers are taken over (setting `keep_static`); of one that was
            captured, which is drawn over, none are.

    Returns:
        A `Frame`.
    """
    with scene.alone():
        return _drawn(scene, plan, camera, previous)


def _drawn(scene: Scene, plan: Plan, camera: str | Camera | None, previous: Frame | None) -> Frame:
    timer = StageTimer(scene.device)
    plan = plan.at(scene, None if previous is None else previous.plan)
    last = previous if previous is not None and previous.lasts else None  # whose answers may be taken over
    if last is not None and not last.kept and plan.settings.budget_ms > 0.0:
        plan = keep_pace(plan, last.plan, last.spent)
    settings = plan.settings
    view = plan.camera if camera is None else find_camera(scene, camera, plan.size)
    if last is None:
        kernels.begin(kernels.of_plan(plan), scene.device)
    gbuffer, layers = reflect_scene(scene, plan, view, timer, last)
    kept = _kept(layers, last)
    same_layers = last and gbuffer is last.gbuffer and len(kept) == len(layers)
    if same_layers and _same_finish(last, scene, plan):
        picture, transmitted = last._picture, last.transmitted
    else:
        interfaces = _interfaces(scene, plan)
        with timer("shade"):
            surfaces = _surfaces(scene, plan, gbuffer, layers)
            shown, met = _shown(scene, plan, gbuffer, interfaces, layers, surfaces)
            finish = _finish(scene, plan)
            picture = shade.shade(
                scene, gbuffer, layers, settings.threads, plan.shadows, finish, shown, settings.kernels
            )
        transmitted = {}
        if interfaces is not None:
            with timer("transmission"):
                transmitted = _look_through(scene, plan, shown, interfaces, met, surfaces, picture)
    for id in layers.keys() - kept:
        timer.count_inside("reflect", layers[id].timings)
    return Frame(scene, plan, gbuffer, layers, picture, timer.ms, previous, transmitted, kept)


def reflect_scene(
    scene: Scene, plan: Plan, view: Camera, timer: StageTimer, previous: Frame | None = None
) -> tuple[GBuffer, dict[int, ReflectionLayer]]:
    """What the eye sees, and what the mirrors show of it: a frame before its shading.

    Args:
        scene, plan: The plan's own scene.
        view: The camera.
        timer: Gets the steps.
        previous: See `render_frame`.
    """
    if _is_still(previous, scene, plan, view):
        gbuffer, answered = previous.gbuffer, _answered(previous, plan)
        pixels = {id: layer.pixels for id, layer in previous.layers.items()}
    else:
        gbuffer, pixels = _look(scene, plan, view, timer)
        answered = {}
    seen = [row for row in plan.rows if row.reflector.id in pixels and pixels[row.reflector.id].count > 0]
    groups = _together((row for row in plan.rows if row.reflector.id not in answered), pixels)
    with timer("prepare"):
        plan.prepare_together(row for rows in groups for row in rows)
    for rows in groups:
        with timer("prepare"):
            prepared = [plan.prepared(row) for row in rows]
        with timer("reflect"):
            shown = [pixels[row.reflector.id] for row in rows]
            if len(rows) > 1:
                found = TECHNIQUES[rows[0].technique].reflect_together(
                    scene, prepared, gbuffer, shown, rows[0].settings, _all_mirrors(scene, plan).bodies
                )
            else:
                reflect, history = TECHNIQUES[rows[0].technique].reflect, _history(previous, scene, rows[0])
                found = [reflect(scene, prepared[0], gbuffer, shown[0], view, rows[0].settings, history)]
        answered.update((layer.pixels.reflector, layer) for layer in found)
    return gbuffer, {row.reflector.id: answered[row.reflector.id] for row in seen}


def _together(rows: Iterable[PlanRow], pixels: Mapping[int, MirrorPixels]) -> list[list[PlanRow]]:
    """Those of rows that are seen, in groups whose rays are treated alike and whose pixels follow one another.

    What is treated otherwise divides groups even where it is not seen: they are the same wherever the eye is.
    """
    groups: list[list[PlanRow]] = []
    for _, alike in groupby(rows, _treatment):
        before = None
        for row in alike:
            own = pixels.get(row.reflector.id)
            if own is None or own.count == 0:
                continue
            if before is not None and own.follows(before):
                groups[-1].append(row)
            else:
                groups.append([row])
            before = own
    return groups


def _treatment(row: PlanRow) -> tuple:
    """What becomes of a mirror's rays: of no other's the same, unless they are traced and shaded as they are."""
    bounce = row.effects["second_bounce"]
    plain = row.technique == "raytraced" and not bounce.numbers.get("solved")
    plain = plain and not any(row.effects[name].on for name in FINISHES)
    return 0 if plain else row.reflector.id, bounce.on, row.settings.threads, row.settings.kernels


def _interfaces(scene: Scene, plan: Plan) -> transmission.Interfaces | None:
    """How light goes through the transparent surfaces; None where there are none."""
    if not plan.panes:
        return None
    from warp_reflect.transmission import make_interfaces

    finishes = {}
    for pane in plan.panes:
        finish = finish_of(scene.data.materials[scene.parts[pane.part].material], pane.settings)
        finishes[pane.part] = finish if pane.effects["frost"].on else dataclasses.replace(finish, frost=0.0)
    return make_interfaces(scene, finishes)


def _surfaces(
    scene: Scene, plan: Plan, gbuffer: GBuffer, layers: dict[int, ReflectionLayer]
) -> dict[int, MirrorPixels]:
    """By part: the pixels of what has waves or is looked through."""
    parts = dict.fromkeys([*_wavy(plan), *(pane.part for pane in plan.panes)])
    known = {row.reflector.part: layers[row.reflector.id].pixels for row in plan.rows if row.reflector.id in layers}
    return surface.part_pixels(scene, gbuffer, parts, known, plan.settings.threads, plan.settings.kernels)


def _shown(
    scene: Scene,
    plan: Plan,
    gbuffer: GBuffer,
    interfaces: transmission.Interfaces | None,
    layers: dict[int, ReflectionLayer],
    surfaces: dict[int, MirrorPixels],
) -> tuple[shade.Shown, transmission.Met]:
    """What the eye sees, with the waves on it; how rays see mirrors and, in the former alone, through surfaces."""
    threads, kernels = plan.settings.threads, plan.settings.kernels
    bumpy = [row.reflector.id for row in plan.rows if row.effects["normal_map"].on]
    shown = shade.look(scene, gbuffer, threads, plan.shadows, bumpy, kernels)
    wavy = _wavy(plan)
    if wavy:
        asked = {k: finish_of(scene.data.materials[scene.parts[k].material], each) for k, each in wavy.items()}
        from warp_reflect.waves import wave_normals

        normals = wave_normals(scene, gbuffer, shown.normals, asked, surfaces, threads, kernels)
        shown = dataclasses.replace(shown, normals=normals)
    met = _met(scene, plan, shown, interfaces, layers)
    if interfaces is None:
        return dataclasses.replace(shown, seen=met, add=shown.add if met is shown.seen else None), met
    from warp_reflect.transmission import behind

    def seen(layer: ReflectionLayer) -> wp.array:
        radiance = met(layer)
        if layer.radiance is not None:
            return radiance
        return behind(scene, gbuffer, interfaces, layer, radiance, plan.settings, met)

    return dataclasses.replace(shown, seen=seen, add=None), met


def _met(
    scene: Scene,
    plan: Plan,
    shown: shade.Shown,
    interfaces: transmission.Interfaces | None,
    layers: dict[int, ReflectionLayer],
) -> transmission.Met:
    """The radiance of what a layer's rays meet, with what the mirrors among that reflect where the plan asks for it."""
    settings, plain = plan.settings, shown.seen
    left = {row.reflector.id: settings.bounces - 1 for row in plan.rows if row.effects["second_bounce"].on}
    if plan.panes and plan.rows:
        left[NO_REFLECTOR] = settings.bounces
    if not left:
        return plain
    solved = {row.reflector.id for row in plan.rows if row.effects["second_bounce"].numbers.get("solved")}
    mirrors = _all_mirrors(scene, plan)

    def reflected(layer: ReflectionLayer) -> wp.array:
        radiance = plain(layer)
        if interfaces is None:
            return radiance
        from warp_reflect.transmission import behind

        return behind(scene, shown.gbuffer, interfaces, layer, radiance, settings, plain)

    def met(layer: ReflectionLayer) -> wp.array:
        radiance, follow = plain(layer), left.get(layer.pixels.reflector, 0)
        if layer.radiance is not None or not follow:
            return radiance
        forward, reflector = None, layer.pixels.reflector
        if reflector in solved and layer is layers.get(reflector):  # not where a finish turned its rays
            forward = mirrored_eyes.answers(scene, shown.gbuffer, plan, reflector)
        ask = (scene, shown.gbuffer, mirrors, layer, radiance, reflected, follow, settings.threads, forward)
        return bounces.onward(*ask, kernels=settings.kernels)

    return met


def _all_mirrors(scene: Scene, plan: Plan) -> bounces.Mirrors:
    return bounces.Mirrors(scene, [row.reflector for row in plan.rows])


def _wavy(plan: Plan) -> dict[int, Settings]:
    """The parts that have waves, and their settings."""
    surfaces = [*((row.reflector.part, row) for row in plan.rows), *((pane.part, pane) for pane in plan.panes)]
    return {part: row.settings for part, row in surfaces if _has_waves(row)}


def _has_waves(row: PlanRow | PaneRow) -> bool:
    """Not where it is a normal map alone that bends what is seen through a surface."""
    effect = row.effects["waves"]
    return effect.on and effect.numbers.get("slope", 0.0) > 0.0


def _look_through(
    scene: Scene,
    plan: Plan,
    shown: shade.Shown,
    interfaces: transmission.Interfaces,
    met: transmission.Met,
    pixels: dict[int, MirrorPixels],
    picture: tuple,
) -> dict[int, transmission.Transmission]:
    """Add to a picture what the eye sees through transparent surfaces; it, by the surfaces' parts."""
    from warp_reflect import transmission

    settings, through = plan.settings, transmission.Through(shown, interfaces, met)
    transmitted = {}
    for pane in plan.panes:
        if pane.part not in pixels:
            continue
        follow = None
        if pane.effects["refraction_image"].on:
            from warp_reflect.techniques import refraction_image

            follow = partial(refraction_image.follow, scene, shown.gbuffer, pane.part, settings=pane.settings)
        found = transmission.look_through(scene, shown, interfaces, pixels[pane.part], settings, follow=follow)
        radiance = transmission.through_radiance(scene, through, found, settings)
        for name, home in PANE_FINISHES.items():
            if pane.effects[name].on:
                module = importlib.import_module(f"warp_reflect.finishes.{home}")
                radiance = module.apply_through(scene, through, found, radiance, pane)
        transmission.add_to_picture(picture[0], found, radiance, settings.threads)
        transmitted[pane.part] = found
    return transmitted


def _finish(scene: Scene, plan: Plan) -> shade.Finish | None:
    """What the planned finishes make of what sharp mirrors see; None where every mirror is sharp and plain."""
    planned = {row.reflector.id: [name for name in FINISHES if row.effects[name].on] for row in plan.rows}
    if not any(planned.values()):
        return None
    rows = {row.reflector.id: row for row in plan.rows}

    def finish(shown: shade.Shown, layer: ReflectionLayer, sharp: wp.array) -> wp.array:
        radiance, reflector = sharp, layer.pixels.reflector
        for name in planned[reflector]:
            module = importlib.import_module(f"warp_reflect.finishes.{FINISHES[name]}")
            radiance = module.apply(scene, shown, layer, sharp, radiance, rows[reflector])
        return radiance

    return finish


def _look(scene: Scene, plan: Plan, view: Camera, timer: StageTimer) -> tuple[GBuffer, dict[int, MirrorPixels]]:
    """What the eye sees, and the pixels of every mirror."""
    seen = plan.take_view(view)
    if seen is None:
        seen = probe.look(scene, view, _mirrors(plan), plan.settings.threads, plan.settings.kernels)
    timer.count(seen.ms)
    return seen.gbuffer, seen.pixels


def _mirrors(plan: Plan) -> dict[int, int]:
    """Reflector id to part of the scene."""
    return {row.reflector.id: row.reflector.part for row in plan.rows}


def _is_still(previous: Frame | None, scene: Scene, plan: Plan, view: Camera) -> bool:
    """Whether the previous frame saw the same world from the same eye, with the same mirrors in it."""
    return (
        previous is not None
        and plan.settings.keep_static
        and previous.scene.shares_world(scene)
        and previous.camera.sees_as(view)
        and _mirrors(previous.plan) == _mirrors(plan)
    )


def _same_finish(previous: Frame, scene: Scene, plan: Plan) -> bool:
    """Whether a picture of the same layers looks the same: waves move with time in a world where nothing else does."""
    asked, before = ([each.effects for each in (*made.rows, *made.panes)] for made in (plan, previous.plan))
    same_time = previous.scene.data.time == scene.data.time or not any(moves_with_time(each) for each in asked)
    return same_time and asked == before and previous.plan.settings == plan.settings


def _answered(previous: Frame, plan: Plan) -> dict[int, ReflectionLayer]:
    """The layers of a still frame whose rows ask the same again, and no map that is drawn or goes on in every frame."""
    asked, before = ({row.reflector.id: _request(row) for row in each.rows} for each in (plan, previous.plan))
    redrawn = {r.reflector.id for r in plan.rows if r.technique in MAPS and r.settings.environment_update != "static"}
    redrawn |= {id for id, layer in previous.layers.items() if layer.statistics.get("local_blending")}
    return {id: layer for id, layer in previous.layers.items() if asked[id] == before[id] and id not in redrawn}


def _request(row: PlanRow) -> tuple:
    return row.technique, row.settings, {name: effect.on for name, effect in row.effects.items()}


def _kept(layers: dict[int, ReflectionLayer], previous: Frame | None) -> frozenset[int]:
    """Ids of the layers that are the previous frame's own."""
    return frozenset(id for id, layer in layers.items() if previous and previous.layers.get(id) is layer)


def _history(previous: Frame | None, scene: Scene, row: PlanRow):
    """What a reflector's search may start from: the previous frame's answers of the same technique in the same world.

    Mirrors that show maps get those of all such mirrors of the previous frame. Others start, at another time of the stage,
    only where reuse is asked for: otherwise a frame of a range depends on no other.
    """
    if previous is not None and row.technique in MAPS:
        method = Technique[row.technique.upper()]
        return {number: layer.history for number, layer in previous.layers.items() if layer.method == method}
    if previous is None or row.reflector.id not in previous.layers:
        return None
    if previous.scene is not scene and not (row.settings.reuse_px > 0.0 and previous.scene.shares_world(scene)):
        return None
    layer = previous.layers[row.reflector.id]
    return layer.history if layer.method == Technique[row.technique.upper()] else None
