"""A USD stage to `SceneData`, plain NumPy: one walk over the prims at one time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from warp_reflect.scene import SceneData
from warp_reflect.settings import COMPLEXITIES
from warp_reflect.stage.guard import Limits, check_file, confinement_fault
from warp_reflect.stage.intake import Intake, library_message  # before pxr: sets USDC_USE_PREAD

from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils  # isort: skip

from warp_reflect.stage.assemble import Assembly, MeshEntry
from warp_reflect.stage.baked import read_baked_maps
from warp_reflect.stage.finish import give_finishes
from warp_reflect.stage.lights import SHADED_KINDS, default_dome
from warp_reflect.stage.materialx import is_materialx_error
from warp_reflect.stage.opacity import drop_transparent
from warp_reflect.stage.places import Places
from warp_reflect.stage.reflectors import Choices, choose_reflectors, parse_patterns
from warp_reflect.stage.schema import register
from warp_reflect.stage.walk import State, Walk

PURPOSES = ("default", "render", "proxy", "guide")
LINK_COLLECTIONS = ("lightLink", "shadowLink", "filterLink")  # on every light; they name no reflectors
METERS_PER_UNIT_DEFAULT = 0.01  # UsdGeom's fallback: centimetres
FRAMES_PER_SECOND_DEFAULT = 24.0  # Usd's fallback


def read_stage(
    path: str | Path,
    time: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    complexity: str = "low",
    strict: bool = False,
    limits: Limits | None = None,
    reflectors: tuple[str, ...] = (),
) -> SceneData:
    """Read a stage at one time.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        time: Time code; None: the earliest sample of what is animated, the default value of what is not
            (usdrecord's choice).
        purposes: Which of `PURPOSES` are drawn; "default" always is.
        complexity: Subdivision and tessellation, one of `COMPLEXITIES`; "low" subdivides each mesh as far as
            it needs (`detail.subdivision_level`), the others all to level 1, 2 or 3.
        strict: Raise what would be dropped or repaired with a note.
        limits: What is refused for its size.
        reflectors: Patterns of prims that get a mirror's material; see `reflectors.parse_patterns`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a stage, an impossible argument or, where strict, a prim that would be dropped; one
            line.
    """
    return StageReader(path, purposes, complexity, strict, limits, reflectors).read(time)


class StageReader:
    """A stage kept open to be read at several times; meshes that do not change in time are read once.

    Attributes:
        path: The file.
        stage: The open Usd.Stage; closed with this object.
    """

    def __init__(
        self,
        path: str | Path,
        purposes: tuple[str, ...] = ("default", "render"),
        complexity: str = "low",
        strict: bool = False,
        limits: Limits | None = None,
        reflectors: tuple[str, ...] = (),
    ):
        unknown = set(purposes) - set(PURPOSES)
        if unknown:
            raise ValueError(f"purposes: got {', '.join(sorted(unknown))}, expected some of {', '.join(PURPOSES)}")
        if complexity not in COMPLEXITIES:
            raise ValueError(f"complexity: got {complexity!r}, expected one of {', '.join(COMPLEXITIES)}")
        self.path = str(path)
        self.purposes = frozenset(purposes) | {"default"}
        self.level = COMPLEXITIES.index(complexity)
        self.strict = strict
        self.patterns = parse_patterns(reflectors)
        self.limits = limits or Limits()
        self.stage = open_stage(self.path, self.limits)
        self._static: dict[tuple, MeshEntry] = {}
        self._pictures: dict = {}
        self._first: SceneData | None = None
        self._smooth: list = []  # of the first reading

    def read(self, time: float | None = None) -> SceneData:
        """The stage at one time; see `read_stage`."""
        if time is not None and not math.isfinite(time):
            raise ValueError(f"time: got {time}, expected a finite time code")
        if self._first is not None and self._is_still:
            return replace(self._first, time=time, notes=list(self._first.notes))
        code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))
        if self._first is not None and self._places is not None:
            with quiet():
                data = self._places.at(time, Intake(code, self.strict, self.limits, cache=self._pictures))
            if data is not None:
                return data
        intake = Intake(code, self.strict, self.limits, cache=self._pictures)
        try:
            with quiet():
                data = self._read(time, intake)
        except (Tf.ErrorException, UnicodeDecodeError) as fault:
            raise ValueError(f"cannot read {self.path}: {library_message(fault)}") from None
        data.notes = intake.notes
        self._first = self._first or data
        return data

    @cached_property
    def _is_still(self) -> bool:
        """Whether no attribute of the stage may change in time."""
        roots = [self.stage.GetPseudoRoot(), *self.stage.GetPrototypes()]
        with quiet():
            return not any(
                attribute.ValueMightBeTimeVarying()
                for root in roots
                for prim in Usd.PrimRange(root)
                for attribute in prim.GetAuthoredAttributes()
            )

    @cached_property
    def _places(self) -> Places | None:
        """What has to be asked of the stage at another time, where that is little."""
        with quiet():
            return Places.of(self.stage, self._first, self._smooth)

    def _read(self, time: float | None, intake: Intake) -> SceneData:
        data = self._metadata(time, intake)
        for error in self.stage.GetCompositionErrors():
            text = " ".join(str(error).split())
            if not is_materialx_error(text):  # what is needed of such a file is read, or noted, where it is bound
                intake.bad(error.rootSite.path, f"composition: {text}")
        choices = Choices(self.patterns, {}, data.collections)
        walk = Walk(self.stage, intake, self.purposes, self.path, data.up_axis, choices)
        placed = walk.below(self.stage.GetPseudoRoot(), State(np.eye(4)), Usd.PrimDefaultPredicate)
        data.lights, data.cameras = walk.lights, self._primary_first(walk.cameras)
        data.environment_maps = walk.environment_maps
        assembly = Assembly(intake, self.level, choices, self._static)
        assembly.complete(data, walk.drawn, placed)
        if self._first is None:
            self._smooth = assembly.smooth
        choose_reflectors(data, choices)
        give_finishes(data, walk.finishes)
        drop_transparent(data, intake)
        data.baked_maps = read_baked_maps(walk.drawn, intake)
        if not data.instances:
            intake.note("/", "the stage holds no geometry that can be drawn")
        if not any(light.kind in SHADED_KINDS for light in data.lights):
            data.lights.append(default_dome())
            intake.note(data.lights[-1].path, "the stage has no light that is used; a grey dome lights it")
        return data

    def _primary_first(self, cameras: list) -> list:
        """The cameras with the pipeline's primary one (by name, "main_cam") in front."""
        primary = UsdUtils.GetPrimaryCameraName()
        return sorted(cameras, key=lambda camera: not camera.path.endswith(f"/{primary}"))

    def _collections(self) -> dict[str, tuple[str, ...]]:
        """Member paths of the stage's collections, by "/Prim.collection:name"."""
        found = {}
        for prim in self.stage.Traverse():
            if not prim.HasAPI(Usd.CollectionAPI):
                continue
            for collection in Usd.CollectionAPI.GetAll(prim):
                name = collection.GetName()
                whole = collection.GetIncludeRootAttr().Get()
                if name in LINK_COLLECTIONS or not (whole or collection.GetIncludesRel().HasAuthoredTargets()):
                    continue
                members = Usd.CollectionAPI.ComputeIncludedPaths(
                    collection.ComputeMembershipQuery(),
                    self.stage,
                    Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate),
                )
                found[f"{prim.GetPath()}.collection:{name}"] = tuple(sorted(map(str, members)))
        return found

    def _metadata(self, time: float | None, intake: Intake) -> SceneData:
        root = self.stage.GetRootLayer().pseudoRoot

        def positive(name: str, fallback: float) -> float:
            # UsdGeomGetStageMetersPerUnit raises where the metadata has another type than double.
            value = root.GetInfo(name) if root.HasInfo(name) else fallback
            if isinstance(value, (int, float)) and math.isfinite(value) and value > 0.0:
                return float(value)
            intake.bad("/", f"{name}: got {value}, expected a finite number > 0; {fallback:g} is used")
            return fallback

        up_axis = str(root.GetInfo("upAxis")) if root.HasInfo("upAxis") else str(UsdGeom.GetFallbackUpAxis())
        if up_axis not in ("Y", "Z"):
            intake.bad("/", f"upAxis: got {up_axis!r}, expected Y or Z; Y is used")
            up_axis = "Y"
        authored = self.stage.HasAuthoredTimeCodeRange()
        return SceneData(
            source=self.path,
            meshes=[],
            instances=[],
            materials=[],
            lights=[],
            cameras=[],
            up_axis=up_axis,
            meters_per_unit=positive("metersPerUnit", METERS_PER_UNIT_DEFAULT),
            time=time,
            time_range=(self.stage.GetStartTimeCode(), self.stage.GetEndTimeCode()) if authored else None,
            time_codes_per_second=positive("timeCodesPerSecond", FRAMES_PER_SECOND_DEFAULT),
            collections=self._collections(),
        )


def open_stage(path: str, limits: Limits) -> Usd.Stage:
    """Open a stage file with everything loaded.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no regular file, not readable as USD, or outside of `limits.root`; one line.
    """
    check_file(path, limits)
    with quiet():
        register()
        try:
            known = Sdf.Layer.Find(path)
            stage = Usd.Stage.Open(path, Usd.Stage.LoadAll)
            if known and not known.dirty:
                stage.Reload()  # else the library answers from memory although the file has changed
            for layer in stage.GetUsedLayers() if limits.root else ():
                fault = confinement_fault(layer.realPath, limits.root) if layer.realPath else ""
                if fault:
                    raise ValueError(f"cannot read {path}: the layer {layer.realPath} is {fault}")
        except Tf.ErrorException as fault:
            raise ValueError(f"cannot read {path}: {library_message(fault)}") from None
    return stage


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the USD library's warnings off stderr; what matters of them is noted by the reader."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()
