"""Frames that are drawn by repeating what was launched for one: on CUDA a graph, with none of the host's work between.

A frame is some twenty launches, each of which keeps the host busy for as long as many of them keep a device. Here
`frame.render_frame` is walked once while Warp writes down what it launches; from then on a frame is the camera put where all
kernels look for it (`layers.CameraView`), and one call that does everything again. That works for what decides nothing between
its launches: launches go over all pixels that a mirror could have (`launch.unread`), and nothing is read before the picture.

On the CPU Warp repeats launches as well, of plain kernels on one thread. That shows that nothing is missing, but saves little:
ordinary frames, in vectors on all cores, are faster there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property

import warp as wp

from warp_reflect import launch, surface
from warp_reflect.frame import Frame, render_frame
from warp_reflect.layers import Camera, ReflectionLayer
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import Plan, find_camera
from warp_reflect.scene import Scene
from warp_reflect.timing import StageTimer

RECORDS_CPU = tuple(int(part) for part in wp.__version__.split(".")[:2]) >= (1, 19)  # whether Warp does on a CPU too
# What a captured frame's z-buffer and its launches were made for, of a camera.
FIXED = ("size", "orthographic", "near", "far")


@dataclass(frozen=True)
class Seat(Camera):
    """A camera whose place on the device is taken by others: those that see as it does."""

    taken: wp.array | None = None

    def view(self, scene: Scene) -> wp.array:
        return self.taken


class CapturedFrame:
    """The frames of a plan, of any camera with the picture and the depths of its own; for one thread at a time.

    Attributes:
        scene, plan: What is drawn.
    """

    def __init__(self, scene: Scene, plan: Plan):
        self.scene, self.plan = scene, plan
        self._place = plan.camera.view(scene)
        seat = Seat(**{each.name: getattr(plan.camera, each.name) for each in fields(Camera)}, taken=self._place)
        plan.take_view(plan.camera)  # what was drawn to plan was read
        with launch.unread(), scene.alone():
            # Once before: what is compiled, prepared and kept is so before the launches are written down.
            render_frame(scene, plan, seat)
            with wp.ScopedCapture(scene.device, force_module_load=False) as capture:
                self._recorded = render_frame(scene, plan, seat)
        self._graph = capture.graph
        self._held = dict(scene.facts)  # what launches read, and the scene may replace where other plans ask it
        self._last: Frame | None = None

    def render(self, camera: str | Camera | None = None, previous: Frame | None = None) -> Frame:
        """Draw a frame over the last one, of which nothing can be asked any more: copy what is to stay.

        Args:
            camera: Another camera than the plan's; None: the plan's.
            previous: The last frame, from which motion is measured.

        Returns:
            A `Frame` as `render_frame` has it. How many pixels a mirror has is read when its layers are asked for.

        Raises:
            ValueError: a camera of another size, projection or depth range.
        """
        plan = self.plan
        view = plan.camera if camera is None else find_camera(self.scene, camera, plan.size)
        for name in FIXED:
            if getattr(view, name) != getattr(plan.camera, name):
                got, expected = getattr(view, name), getattr(plan.camera, name)
                raise ValueError(f"camera: {name}: got {got}, expected {expected} as it was captured")
        if self._last is not None:
            self._last.gone = self._last.layers.gone = True
        timer = StageTimer(self.scene.device)
        with timer("replay"), self.scene.alone():
            self._fit_trees()
            wp.copy(self._place, view.view(self.scene))
            wp.capture_launch(self._graph)
        recorded = self._recorded
        gbuffer = replace(recorded.gbuffer, camera=view)
        layers = _Told(recorded.layers, view.size[0])
        self._last = Frame(self.scene, plan, gbuffer, layers, recorded._picture, timer.ms, previous)
        self._last.lasts = False
        return self._last

    def _fit_trees(self) -> None:
        """Other times of the stage may have fitted the trees to theirs."""
        tracers = [self.scene.tracer, *(self.scene.mirror_tracer(row.reflector.part) for row in self.plan.rows)]
        if self.plan.shadows is not None:
            tracers.append(self.scene.shadow_tracer)
        for tracer in tracers:
            _ = tracer.id


def capture_frame(scene: Scene, plan: Plan) -> CapturedFrame:
    """Write down what a plan's frames launch, to repeat it for other cameras.

    Meanwhile no other thread may use the device: what it launches would be written down as well.

    Args:
        scene: The plan's own, as it is at its time.
        plan: From `make_plan`.

    Raises:
        ValueError: the plan's frames decide something between their launches; it says what.
    """
    why = why_not(scene, plan)
    if why:
        raise ValueError(f"capture: {why}; render_frame draws it")
    return CapturedFrame(scene, plan)


def why_not(scene: Scene, plan: Plan) -> str:
    """Why the frames of a plan cannot be captured; empty where they can."""
    if plan.scene is not scene:
        return "the plan is another scene's, or for another time"
    if not scene.device.is_cuda and not RECORDS_CPU:
        return f"on a CPU Warp {wp.__version__} writes nothing down, 1.19 does"
    if scene.device.is_cuda and not wp.is_mempool_enabled(scene.device):
        return "the device has no memory pool, without which a graph cannot ask for memory"
    if scene.triangle_count == 0:
        return "the scene has no triangles"
    if plan.panes:
        return f"what is seen through {plan.panes[0].name} is followed by rays that are listed first"
    for row in plan.rows:
        if row.technique != "raytraced":
            return f"{row.name} is solved by {row.technique}, and is drawn where it is seen; method=reference traces it"
        asked = looked_up(row)
        if asked:
            return f"{row.name} is looked up where it is seen in a picture of itself; {asked} asks rays"
        if row.effects["second_bounce"].numbers.get("solved"):
            return f"{row.name} shows mirrors that are solved from the eye behind it; method=reference traces them"
    return ""


def looked_up(row: PlanRow) -> str:
    """The setting that would follow rays where a finish of a mirror looks them up in its picture; empty where none does."""
    bumpy = row.effects["normal_map"].on
    if bumpy and row.settings.bumps != "traced":
        return "bumps=traced"
    if row.effects["waves"].on and not bumpy and row.settings.waves != "traced":
        return "waves=traced"
    if row.effects["roughness"].numbers.get("way") == "filter" and (
        row.effects["roughness"].on or row.effects["clearcoat"].on
    ):
        return "glossy=gather"
    return ""


class _Told(Mapping):
    """The layers of what mirrors are seen, without the entries that have no pixel; their number is read when one is asked for."""

    def __init__(self, layers: Mapping[int, ReflectionLayer], width: int):
        self._layers, self._width = layers, width
        self.gone = False  # see `Frame.gone`

    @property
    def _found(self) -> dict[int, ReflectionLayer]:
        if self.gone:
            raise RuntimeError("layers: the next captured frame was drawn over this one; ask before that")
        return self._read

    @cached_property
    def _read(self) -> dict[int, ReflectionLayer]:
        found = {}
        for id, layer in self._layers.items():
            where, pixels = surface.told(layer.pixels, self._width)
            if pixels.count:
                arrays = {name: getattr(layer, name)[where] for name in ("triangle", "u", "v", "distance", "status")}
                counted = layer.statistics.anew()
                counted["bvh"] = pixels.count
                found[id] = replace(layer, pixels=pixels, statistics=counted, whole=None, **arrays)
        return found

    def __getitem__(self, id: int) -> ReflectionLayer:
        return self._found[id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)
