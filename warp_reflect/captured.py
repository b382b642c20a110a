"""Frames that are drawn by repeating what was launched for one: on CUDA a graph, with none of the host's work between.

A frame is some twenty launches, each of which keeps the host busy for as long as many of them keep a device. Here
`frame.render_frame` is walked once while Warp writes down what it launches; from then on a frame is the camera put where all
kernels look for it (`layers.CameraView`), and one call that does everything again. That works for what decides nothing between
its launches: launches go over all pixels that a mirror could have (`launch.unread`), and nothing is read before the picture.
Where rays go on from surface to surface the device decides whether, and how often (`launch.when`).

On the CPU Warp repeats launches as well, of plain kernels on one thread. That shows that nothing is missing, but saves little:
ordinary frames, in vectors on all cores, are faster there.
"""

from __future__ import annotations

import gc
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING

import warp as wp

from warp_reflect import compact, launch, surface
from warp_reflect.counts import Statistics
from warp_reflect.frame import Frame, render_frame
from warp_reflect.layers import Camera, MirrorPixels, ReflectionLayer
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import Plan, find_camera
from warp_reflect.scene import Scene
from warp_reflect.timing import StageTimer

if TYPE_CHECKING:
    from warp_reflect.transmission import Transmission

RECORDS_CPU = tuple(int(part) for part in wp.__version__.split(".")[:2]) >= (1, 19)  # whether Warp does on a CPU too
PLACES_MAX = 4000  # that decide what is done: each holds some twenty launches
BLOCK_BYTES = 512  # what memory of CUDA's pools comes in
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
        self._room = _Room(scene.device)
        with scene.alone():
            self._graph = self._written_down(seat)
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
            self._last.gone = self._last.layers.gone = self._last.transmitted.gone = True
        timer = StageTimer(self.scene.device)
        with timer("replay"), self.scene.alone():
            self._fit_trees()
            wp.copy(self._place, view.view(self.scene))
            wp.capture_launch(self._graph)
        recorded = self._recorded
        gbuffer = replace(recorded.gbuffer, camera=view)
        layers = _Told("layers", recorded.layers, view.size[0], _told_layer)
        behind = _Told("transmitted", recorded.transmitted, view.size[0], _told_behind)
        self._last = Frame(self.scene, plan, gbuffer, layers, recorded._picture, timer.ms, previous, behind)
        self._last.lasts = False
        return self._last

    def _written_down(self, seat: Seat) -> wp.Graph:
        """What a frame launches."""
        device = self.scene.device
        # Once before: what is compiled, prepared and kept is so before the launches are written down.
        with launch.unread(is_last=False) as before:
            render_frame(self.scene, self.plan, seat)
        if before.count > PLACES_MAX:
            raise ValueError(
                f"capture: {before.count} places decide what follows; a lower transparency_depth has fewer"
            )
        if not decides(device):
            return self._captured(seat)
        if device.is_cuda:
            with launch.unread(is_last=False), self._room:
                render_frame(self.scene, self.plan, seat)
        self._marks = wp.zeros(max(before.count, 1), dtype=int, device=device)
        try:
            return self._captured(seat, self._marks)
        except RuntimeError:
            if device.is_cpu:
                raise
        return self._captured(seat)  # a driver that refuses decisions: all is done then, wherever rays might go on

    def _captured(self, seat: Seat, marks: wp.array | None = None) -> wp.Graph:
        device = self.scene.device
        with launch.unread(marks), self._room, wp.ScopedCapture(device, force_module_load=False) as capture:
            if marks is not None:
                marks.zero_()
            self._recorded = render_frame(self.scene, self.plan, seat)
        return capture.graph

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
    for pane in plan.panes:
        if pane.effects["refraction_image"].on:
            return f"what is seen through {pane.name} is drawn where it is seen; refraction=traced asks rays"
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
    if row.effects["roughness"].numbers.get("way") == "filter" and (
        row.effects["roughness"].on or row.effects["clearcoat"].on
    ):
        return "glossy=gather"
    return ""


def decides(device: wp.Device) -> bool:
    """Whether what is written down may depend on numbers that the device finds."""
    return device.is_cpu or (hasattr(wp, "ScopedAllocator") and wp.is_conditional_graph_supported())


class _Room:
    """Memory of a CUDA device for what is written down, which may not ask for any where the device decides what is done.

    The first time in its context memory is the device's own, and kept when arrays let go of it; the next time arrays get that.
    """

    def __init__(self, device: wp.Device):
        self._device = device
        self._blocks: dict[int, int] = {}  # the size of each
        self._free: defaultdict[int, list[int]] = defaultdict(list)  # of each size
        self._thread = 0  # whose arrays are kept here: others work beside it

    def __enter__(self) -> _Room:
        self._thread = threading.get_ident()
        # When garbage is found decides which memory is free: it must be the same each time.
        gc.collect()
        self._collects = gc.isenabled()
        gc.disable()
        if self._device.is_cuda and decides(self._device):
            self._own = wp.get_device_allocator(self._device)
            self._scope = wp.ScopedAllocator(self._device, self)
            self._scope.__enter__()
        return self

    def __exit__(self, *failure) -> None:
        self._thread = 0
        if self._device.is_cuda and decides(self._device):
            self._scope.__exit__(*failure)
        if self._collects:
            gc.enable()

    def __del__(self):
        with suppress(TypeError, AttributeError):  # when the program ends, as Warp's own arrays do
            for block, size in self._blocks.items():
                with self._device.context_guard:
                    self._own.deallocate(block, size)

    def allocate(self, size: int) -> int:
        """What Warp asks: an address."""
        if threading.get_ident() != self._thread:
            return self._own.allocate(size)
        whole = -(-size // BLOCK_BYTES) * BLOCK_BYTES
        if self._free[whole]:
            return self._free[whole].pop()
        block = self._own.allocate(whole)
        if not self._device.is_capturing:
            self._blocks[block] = whole
        return block

    def deallocate(self, block: int, size: int) -> None:
        """What Warp asks when an array is gone."""
        if block in self._blocks:
            self._free[self._blocks[block]].append(block)
        else:
            self._own.deallocate(block, size)


class _Told(Mapping):
    """What is seen of several surfaces, without the entries that have no pixel; their number is read when one is asked for.

    Args:
        name: Of what this is.
        whole: What was written down for each surface.
        width: Of the picture. [pixels]
        told: (that, width) -> the same without those entries; None: the surface is not seen.
    """

    def __init__(self, name: str, whole: Mapping, width: int, told: Callable):
        self._name, self._whole, self._width, self._tell = name, whole, width, told
        self.gone = False  # see `Frame.gone`

    @property
    def _found(self) -> dict[int, object]:
        if self.gone:
            raise RuntimeError(f"{self._name}: the next captured frame was drawn over this one; ask before that")
        return self._read

    @cached_property
    def _read(self) -> dict[int, object]:
        told = {id: self._tell(each, self._width) for id, each in self._whole.items()}
        return {id: each for id, each in told.items() if each is not None}

    def __getitem__(self, id: int):
        return self._found[id]

    def __iter__(self) -> Iterator[int]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def _told_layer(layer: ReflectionLayer, width: int) -> ReflectionLayer | None:
    where, pixels = surface.told(layer.pixels, width)
    if not pixels.count:
        return None
    counted = layer.statistics.anew()
    counted["bvh"] = pixels.count
    return _cut(layer, where, pixels, counted)


def _told_behind(found: Transmission, width: int) -> Transmission | None:
    where, pixels = surface.told(found.surface, width)
    if not pixels.count:
        return None
    rays = found.layer.pixels
    taken = [compact.taken(array, where) for array in (rays.direction, rays.normal)]
    turned = replace(pixels.turned(*taken), reflector=rays.reflector)
    arrays = {name: compact.taken(getattr(found, name), where) for name in ("weight", "inside", "nearness")}
    layer = _cut(found.layer, where, turned, found.layer.statistics.anew())
    return replace(found, surface=pixels, layer=layer, **arrays)


def _cut(layer: ReflectionLayer, where: wp.array, pixels: MirrorPixels, counted: Statistics) -> ReflectionLayer:
    names = ("triangle", "u", "v", "distance", "status")
    arrays = {name: compact.taken(getattr(layer, name), where) for name in names}
    return replace(layer, pixels=pixels, statistics=counted, whole=None, **arrays)
