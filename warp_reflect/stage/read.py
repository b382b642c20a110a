"""A USD stage to `SceneData`, plain NumPy: one walk over the prims at one time."""

from __future__ import annotations

import contextlib
import math
import re
import stat
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_reflect.scene import CameraData, InstanceData, LightData, MeshData, SceneData
from warp_reflect.settings import COMPLEXITIES
from warp_reflect.stage.guard import Limits
from warp_reflect.stage.intake import (  # before pxr: sets USDC_USE_PREAD
    BadPrim,
    Intake,
    column_matrix,
    transform_fault,
)

from pxr import Sdf, Tf, Usd, UsdGeom, UsdUtils  # isort: skip

from warp_reflect.stage.cameras import default_camera, read_camera
from warp_reflect.stage.geometry import read_gprim, read_mesh
from warp_reflect.stage.instancer import expand, read_instancer
from warp_reflect.stage.lights import default_dome, read_light
from warp_reflect.stage.materials import MaterialTable

PURPOSES = ("default", "render", "proxy", "guide")
ANALYTIC = frozenset(("Sphere", "Cube", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane"))
METERS_PER_UNIT_DEFAULT = 0.01  # UsdGeom's fallback: centimetres
FRAMES_PER_SECOND_DEFAULT = 24.0  # Usd's fallback


def read_stage(
    path: str | Path,
    time: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    complexity: str = "low",
    strict: bool = False,
    limits: Limits | None = None,
) -> SceneData:
    """Read a stage at one time.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        time: Time code; None: the earliest sample of what is animated, the default value of what is not
            (usdrecord's choice).
        purposes: Which of `PURPOSES` are drawn; "default" always is.
        complexity: Subdivision and tessellation, one of `COMPLEXITIES`.
        strict: Raise what would be dropped or repaired with a note.
        limits: What is refused for its size.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a stage, an impossible argument or, where strict, a prim that would be dropped; one
            line.
    """
    return StageReader(path, purposes, complexity, strict, limits).read(time)


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
    ):
        unknown = set(purposes) - set(PURPOSES)
        if unknown:
            raise ValueError(
                f"purposes: got {', '.join(sorted(unknown))}, expected some of {', '.join(PURPOSES)}"
            )
        if complexity not in COMPLEXITIES:
            raise ValueError(f"complexity: got {complexity!r}, expected one of {', '.join(COMPLEXITIES)}")
        self.path = str(path)
        self.purposes = frozenset(purposes) | {"default"}
        self.level = COMPLEXITIES.index(complexity)
        self.strict = strict
        self.limits = limits or Limits()
        self.stage = open_stage(self.path)
        self._static_meshes: dict[str, tuple[MeshData, list, list]] = {}

    def read(self, time: float | None = None) -> SceneData:
        """The stage at one time; see `read_stage`."""
        if time is not None and not math.isfinite(time):
            raise ValueError(f"time: got {time}, expected a finite time code")
        code = Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(float(time))
        intake = Intake(code, self.strict, self.limits)
        with quiet():
            data = self._metadata(time, intake)
            for error in self.stage.GetCompositionErrors():
                intake.bad(error.rootSite.path, f"composition: {_one_line(str(error))}")
            walk = _Walk(self, intake)
            data.instances = walk.below(
                self.stage.GetPseudoRoot(), _State(np.eye(4)), Usd.PrimDefaultPredicate
            )
            data.meshes, data.materials = walk.meshes, walk.materials.materials
            data.lights, data.cameras = walk.lights, walk.cameras
        data.instances = _usable(data, intake)
        if not data.instances:
            intake.note("/", "the stage holds no geometry that can be drawn")
        if not data.lights:
            data.lights.append(default_dome())
            intake.note(data.lights[0].path, "the stage has no light that is used; a grey dome lights it")
        if not data.cameras:
            data.cameras.append(default_camera(*_bounds(data), data.up_axis))
            intake.note(data.cameras[0].path, "the stage has no camera; one that frames it is used")
        data.notes = intake.notes
        return data

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
        )


@dataclass(frozen=True)
class _State:
    """What a prim inherits from the prims above it."""

    world_from_parent: np.ndarray
    visible: bool = True
    purpose: str = "default"
    inside_instancer: bool = False


@dataclass
class _Walk:
    """One pass over a stage: collects meshes, materials, lights and cameras, and returns instances."""

    reader: StageReader
    intake: Intake
    meshes: list[MeshData] = field(default_factory=list)
    lights: list[LightData] = field(default_factory=list)
    cameras: list[CameraData] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.materials = MaterialTable(self.intake)
        self.transforms = UsdGeom.XformCache(self.intake.time)
        self.visited = 0
        self.mesh_index: dict[str, tuple[int, list] | None] = {}
        self.prototypes: dict[str, list[InstanceData]] = {}
        self.open_prototypes: list[str] = []
        self.elsewhere = self._prototypes_elsewhere()

    def _prototypes_elsewhere(self) -> set[str]:
        """Paths of prototypes that do not lie below their point instancer: not drawn in place."""
        paths = set()
        predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
        if not any(
            prim.IsA(UsdGeom.PointInstancer)
            for root in (self.reader.stage.GetPseudoRoot(), *self.reader.stage.GetPrototypes())
            for prim in Usd.PrimRange(root)
        ):
            return paths
        for count, prim in enumerate(Usd.PrimRange(self.reader.stage.GetPseudoRoot(), predicate)):
            if count > self.intake.limits.prims:
                self._too_many_prims()
            if prim.IsA(UsdGeom.PointInstancer):
                targets = UsdGeom.PointInstancer(prim).GetPrototypesRel().GetForwardedTargets()
                paths.update(str(t) for t in targets if not t.HasPrefix(prim.GetPath()))
        return paths

    def _too_many_prims(self) -> None:
        raise ValueError(
            f"{self.reader.path}: got more than {self.intake.limits.prims} prims, instances included; "
            "raise the limit if the file is trusted"
        )

    def below(self, root, state: _State, predicate) -> list[InstanceData]:
        """The instances of the prims below `root`, in namespace order, placed from its parent's frame."""
        found: list[InstanceData] = []
        predicate = Usd.TraverseInstanceProxies(predicate)
        stack = [(child, state) for child in reversed(root.GetFilteredChildren(predicate))]
        while stack:
            prim, state = stack.pop()
            self.visited += 1
            if self.visited > self.intake.limits.prims:
                self._too_many_prims()
            if len(stack) > 0 and prim.GetPath().pathElementCount > self.intake.limits.depth:
                raise ValueError(f"<{prim.GetPath()}>: deeper than {self.intake.limits.depth} levels")
            if self.elsewhere and str(prim.GetPath()) in self.elsewhere:
                self.intake.note(prim.GetPath(), "a point instancer's prototype: drawn by the instancer only")
                continue
            own = self.visit(prim, state, found)
            if own is not None:
                stack.extend((child, own) for child in reversed(prim.GetFilteredChildren(predicate)))
        return found

    def visit(self, prim, state: _State, found: list[InstanceData]) -> _State | None:
        """Take up one prim; returns what its children inherit, None where they are not to be visited."""
        time = self.intake.time
        if prim.IsA(UsdGeom.Imageable):
            imageable = UsdGeom.Imageable(prim)
            visible = state.visible and imageable.GetVisibilityAttr().Get(time) != UsdGeom.Tokens.invisible
            purpose_attribute = imageable.GetPurposeAttr()
            authored = purpose_attribute.HasAuthoredValue()
            purpose = str(purpose_attribute.Get(time)) if authored else state.purpose
            local, resets = self.transforms.GetLocalTransformation(prim)
            world = column_matrix(local)
            if not resets:
                world = state.world_from_parent @ world
            elif state.inside_instancer:
                self.intake.note(
                    prim.GetPath(), "xformOpOrder: !resetXformStack! stops at the point instancer"
                )
            state = _State(world, visible, purpose, state.inside_instancer)
        kind = prim.GetTypeName()
        if prim.IsA(UsdGeom.Camera):
            self._camera(prim, state)
        elif not state.visible or state.purpose not in self.reader.purposes:
            pass
        elif kind == "Mesh" or kind in ANALYTIC:
            self._geometry(prim, state, found)
        elif prim.IsA(UsdGeom.PointInstancer):
            self._instancer(prim, state, found)
        elif prim.IsA(UsdGeom.Gprim):
            self.intake.note(prim.GetPath(), f"{kind} is not drawn")
        elif kind.endswith(("Light", "Light_1")):
            self._light(prim, state)
        return None if prim.IsA(UsdGeom.PointInstancer) else state

    def _camera(self, prim, state: _State) -> None:
        if state.inside_instancer:
            return
        try:
            self.cameras.append(read_camera(prim, state.world_from_parent, self.intake))
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; camera dropped")

    def _light(self, prim, state: _State) -> None:
        if state.inside_instancer:
            self.intake.note(
                prim.GetPath(), f"{prim.GetTypeName()} in a point instancer's prototype is not used"
            )
            return
        try:
            self.lights.append(read_light(prim, state.world_from_parent, self.intake))
        except NotImplementedError as unused:
            self.intake.note(prim.GetPath(), str(unused))
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; light dropped")

    def _geometry(self, prim, state: _State, found: list[InstanceData]) -> None:
        key = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if key not in self.mesh_index:
            self.mesh_index[key] = self._mesh(prim, key)
        entry = self.mesh_index[key]
        if entry is None:
            return
        mesh, subsets = entry
        colored = self.meshes[mesh].colors is not None
        materials = tuple(
            self.materials.of_prim(prim, prim.GetChild(name) if name else None, colored) for name in subsets
        )
        found.append(InstanceData(mesh, state.world_from_parent, str(prim.GetPath()), materials))

    def _mesh(self, prim, key: str) -> tuple[int, list[str]] | None:
        """(index into meshes, subset name per part) of a prim met first; None where it is dropped."""
        cached = self.reader._static_meshes.get(key)
        if cached is None:
            before = len(self.intake.notes)
            try:
                if prim.GetTypeName() == "Mesh":
                    mesh, subsets = read_mesh(prim, self.intake, self.reader.level)
                    names = [subset.GetName() if subset else "" for subset in subsets]
                else:
                    mesh, names = read_gprim(prim, self.intake, self.reader.level), [""]
                if prim.HasRelationship("skel:skeleton") or prim.HasAttribute("primvars:skel:jointIndices"):
                    self.intake.note(
                        prim.GetPath(), "skeletal skinning is not applied: drawn in its rest pose"
                    )
            except BadPrim as fault:
                self.intake.bad(prim.GetPath(), f"{fault}; prim dropped")
                return None
            cached = (mesh, names, self.intake.notes[before:])
            if not _changes_in_time(prim):
                self.reader._static_meshes[key] = cached
        else:
            for note in cached[2]:
                self.intake.note(note.path, note.text)
        self.meshes.append(cached[0])
        return len(self.meshes) - 1, cached[1]

    def _instancer(self, prim, state: _State, found: list[InstanceData]) -> None:
        path = str(prim.GetPath())
        try:
            targets, prototype, ids, transforms = read_instancer(prim, self.intake)
        except BadPrim as fault:
            self.intake.bad(path, f"{fault}; instancer dropped")
            return
        for k, target in enumerate(targets):
            chosen = np.flatnonzero(prototype == k)
            if not len(chosen):
                continue
            items = self._prototype(prim, target, state.purpose)
            if len(items) * len(chosen) + len(found) > self.intake.limits.instances:
                raise ValueError(
                    f"<{path}>: more than {self.intake.limits.instances} instances; raise the limit"
                )
            worlds = state.world_from_parent @ transforms[chosen]
            found.extend(expand(items, worlds, ids[chosen], path))

    def _prototype(self, instancer, target: str, purpose: str) -> list[InstanceData]:
        """The instances of one prototype of a point instancer, placed from the prototype's parent frame."""
        key = f"{target} {purpose}"
        if target in self.open_prototypes:
            self.intake.bad(
                instancer.GetPath(), f"prototypes: <{target}> holds this instancer itself; not drawn"
            )
            return []
        if key not in self.prototypes:
            self.open_prototypes.append(target)
            prim = self.reader.stage.GetPrimAtPath(target)
            # Prototypes are often kept as overs or classes so that nothing draws them in place.
            predicate = Usd.PrimIsActive & Usd.PrimIsLoaded
            found: list[InstanceData] = []
            state = self.visit(prim, _State(np.eye(4), purpose=purpose, inside_instancer=True), found)
            if state is not None:
                found.extend(self.below(prim, state, predicate))
            self.prototypes[key] = found
            self.open_prototypes.pop()
        return self.prototypes[key]


def open_stage(path: str) -> Usd.Stage:
    """Open a stage file with everything loaded.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no regular file, or not readable as USD; one line.
    """
    try:
        mode = Path(path).stat().st_mode
    except (OSError, ValueError) as fault:
        raise FileNotFoundError(f"no such stage: {path} ({_one_line(str(fault))})") from None
    if not stat.S_ISREG(mode):
        raise ValueError(f"{path}: not a regular file")
    with quiet():
        try:
            known = Sdf.Layer.Find(path)
            stage = Usd.Stage.Open(path, Usd.Stage.LoadAll)
            if known and not known.dirty:
                stage.Reload()  # else the library answers from memory although the file has changed
        except Tf.ErrorException as fault:
            raise ValueError(f"cannot read {path}: {_tf_message(fault)}") from None
    return stage


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep the USD library's warnings off stderr; what matters of them is noted by the reader."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        delegate.TakeUncoalescedDiagnostics()


def _tf_message(fault: Tf.ErrorException) -> str:
    """The innermost message of a Tf error list, without source positions."""
    messages = re.findall(r" : '(.*?)'\s*(?:$|\n\s*Error in)", str(fault), flags=re.DOTALL)
    return _one_line(messages[0] if messages else str(fault))


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _changes_in_time(prim) -> bool:
    prims = [prim, *(child for child in prim.GetChildren() if child.GetTypeName() == "GeomSubset")]
    return any(
        attribute.ValueMightBeTimeVarying()
        for each in prims
        for attribute in each.GetAuthoredAttributes()
        if not attribute.GetName().startswith("xformOp") and attribute.GetName() != "visibility"
    )


def _usable(data: SceneData, intake: Intake) -> list[InstanceData]:
    """The instances whose transforms can be used; the others noted, one note a prim."""
    if not data.instances:
        return []
    worlds = np.stack([instance.world_from_object for instance in data.instances])
    suspect = ~np.isfinite(worlds).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        scale = np.linalg.norm(worlds[:, :3, :3], axis=1)
        volume = np.abs(np.linalg.det(np.where(suspect[:, None, None], np.eye(3), worlds[:, :3, :3])))
        # A cheap bound that no good transform fails; what fails it is looked at one by one.
        suspect |= ~(volume > 1.0e-9 * scale.prod(axis=1)) | (scale.min(axis=1) < 1.0e-9 * scale.max(axis=1))
        suspect |= (np.abs(worlds).max(axis=(1, 2)) > 1.0e9) | (worlds[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(
            axis=1
        )
    kept, blamed = [], set()
    for instance, look in zip(data.instances, suspect, strict=True):
        fault = transform_fault(instance.world_from_object) if look else ""
        if not fault:
            kept.append(instance)
        elif instance.prim_path not in blamed:
            blamed.add(instance.prim_path)
            where = f" (instance {instance.instance})" if instance.instance else ""
            intake.bad(instance.prim_path, f"{fault}{where}; prim dropped")
    total = sum(len(data.meshes[instance.mesh].triangles) for instance in kept)
    if total > intake.limits.triangles:
        raise ValueError(f"{data.source}: got {total} triangles, expected at most {intake.limits.triangles}")
    return kept


def _bounds(data: SceneData) -> tuple[np.ndarray, np.ndarray]:
    """World bounds of what is drawn, float64 [3] each, from the corners of each mesh's own box."""
    if not data.instances:
        return -np.ones(3), np.ones(3)
    boxes = {}
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for instance in data.instances:
        if instance.mesh not in boxes:
            mesh = data.meshes[instance.mesh]
            used = mesh.points[np.unique(mesh.triangles)].astype(np.float64)
            ends = np.stack([used.min(axis=0), used.max(axis=0)])
            boxes[instance.mesh] = np.array(
                [[ends[i, 0], ends[j, 1], ends[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
            )
        corners = (
            boxes[instance.mesh] @ instance.world_from_object[:3, :3].T + instance.world_from_object[:3, 3]
        )
        low, high = np.minimum(low, corners.min(axis=0)), np.maximum(high, corners.max(axis=0))
    return low, high
