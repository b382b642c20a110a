"""The walk over a stage's prims: what is drawn where, with visibility, purpose and instancing resolved."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from pxr import Tf, Usd, UsdGeom

from warp_reflect.scene import CameraData, EnvironmentMapData, FinishData, InstanceData, LightData
from warp_reflect.stage.cameras import read_camera
from warp_reflect.stage.finish import FINISH_API, read_finish
from warp_reflect.stage.instancer import expand, read_instancer
from warp_reflect.stage.intake import BadPrim, Intake, column_matrix, library_message
from warp_reflect.stage.lights import read_light
from warp_reflect.stage.reflectors import Choices
from warp_reflect.stage.schema import ENVIRONMENT_MAP_API, MIRROR_API, applied, read_environment_map, read_mirror

ANALYTIC = ("Sphere", "Cube", "Cylinder", "Cylinder_1", "Cone", "Capsule", "Capsule_1", "Plane")
DRAWN = frozenset(("Mesh", "Points", *ANALYTIC))


def _varies(prim) -> bool:
    """Whether anything of a prim itself may change in time."""
    return any(attribute.ValueMightBeTimeVarying() for attribute in prim.GetAuthoredAttributes())


# A prim's own transform, float64 [4, 4], None where it has none, and whether it takes nothing from its parent.
Local = tuple[np.ndarray | None, bool]


def local_of(prim, transforms: UsdGeom.XformCache) -> Local:
    """How a prim is placed in its parent."""
    if not prim.IsA(UsdGeom.Imageable):
        return None, False
    local, resets = transforms.GetLocalTransformation(prim)
    return column_matrix(local), resets


def world_of(local: Local, world_from_parent: np.ndarray) -> np.ndarray:
    """world_from_object of a prim, float64 [4, 4]."""
    matrix, resets = local
    if matrix is None:
        return world_from_parent
    if resets:
        return matrix
    with np.errstate(invalid="ignore", over="ignore"):  # told by `transform_fault` where something is drawn
        return world_from_parent @ matrix


@dataclass(frozen=True)
class State:
    """What a prim inherits from the prims above it."""

    world_from_parent: np.ndarray
    visible: bool = True
    purpose: str = "default"
    inside_instancer: bool = False
    mover: str = ""  # the innermost of them that may move in time


@dataclass
class Walk:
    """One pass over a stage at one time.

    Attributes:
        drawn: The prims that are drawn, each once; what `below` returns has its index here as `mesh`, and no
            materials yet.
        lights, cameras, environment_maps: What was met of them; mirrors are added to `choices`.
        finishes: By the path of the prim that asks for them.
    """

    stage: Usd.Stage
    intake: Intake
    purposes: frozenset[str]
    source: str
    up_axis: str
    choices: Choices
    drawn: list = field(default_factory=list)
    lights: list[LightData] = field(default_factory=list)
    cameras: list[CameraData] = field(default_factory=list)
    environment_maps: list[EnvironmentMapData] = field(default_factory=list)
    finishes: dict[str, FinishData] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._drawn_index: dict[str, int] = {}
        self.transforms = UsdGeom.XformCache(self.intake.time)
        self.visited = 0
        self.prototypes: dict[str, list[InstanceData]] = {}
        self.open_prototypes: list[str] = []
        self.elsewhere = self._prototypes_elsewhere()

    def _prototypes_elsewhere(self) -> set[str]:
        """Paths of prototypes that do not lie below their point instancer: not drawn in place."""
        paths = set()
        predicate = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
        if not any(
            prim.IsA(UsdGeom.PointInstancer)
            for root in (self.stage.GetPseudoRoot(), *self.stage.GetPrototypes())
            for prim in Usd.PrimRange(root)
        ):
            return paths
        for count, prim in enumerate(Usd.PrimRange(self.stage.GetPseudoRoot(), predicate)):
            if count > self.intake.limits.prims:
                self._too_many_prims()
            if prim.IsA(UsdGeom.PointInstancer):
                targets = UsdGeom.PointInstancer(prim).GetPrototypesRel().GetForwardedTargets()
                paths.update(str(t) for t in targets if not t.HasPrefix(prim.GetPath()))
        return paths

    def _too_many_prims(self) -> None:
        raise ValueError(
            f"{self.source}: got more than {self.intake.limits.prims} prims, instances included; "
            "raise the limit if the file is trusted"
        )

    def below(self, root, state: State, predicate) -> list[InstanceData]:
        """The instances of the prims below `root`, in namespace order, placed from its parent's frame."""
        found: list[InstanceData] = []
        predicate = Usd.TraverseInstanceProxies(predicate)
        stack = [(child, state) for child in reversed(root.GetFilteredChildren(predicate))]
        while stack:
            prim, state = stack.pop()
            self.visited += 1
            if self.visited > self.intake.limits.prims:
                self._too_many_prims()
            if prim.GetPath().pathElementCount > self.intake.limits.depth:
                raise ValueError(f"<{prim.GetPath()}>: deeper than {self.intake.limits.depth} levels")
            if self.elsewhere and str(prim.GetPath()) in self.elsewhere:
                self.intake.note(prim.GetPath(), "a point instancer's prototype: drawn by the instancer only")
                continue
            try:
                own = self.visit(prim, state, found)
            except Tf.ErrorException as fault:
                self.intake.bad(prim.GetPath(), f"{library_message(fault)}; prim and what is below dropped")
                continue
            if own is not None:
                stack.extend((child, own) for child in reversed(prim.GetFilteredChildren(predicate)))
        return found

    def visit(self, prim, state: State, found: list[InstanceData]) -> State | None:
        """Take up one prim; returns what its children inherit, None where they are not to be visited."""
        time = self.intake.time
        if prim.IsA(UsdGeom.Imageable):
            imageable = UsdGeom.Imageable(prim)
            visible = state.visible and imageable.GetVisibilityAttr().Get(time) != UsdGeom.Tokens.invisible
            purpose_attribute = imageable.GetPurposeAttr()
            authored = purpose_attribute.HasAuthoredValue()
            purpose = str(purpose_attribute.Get(time)) if authored else state.purpose
            local = local_of(prim, self.transforms)
            world, resets = world_of(local, state.world_from_parent), local[1]
            if resets and state.inside_instancer:
                self.intake.note(prim.GetPath(), "xformOpOrder: !resetXformStack! stops at the point instancer")
            moves = imageable.GetVisibilityAttr().ValueMightBeTimeVarying()
            moves = moves or (prim.IsA(UsdGeom.Xformable) and UsdGeom.Xformable(prim).TransformMightBeTimeVarying())
            mover = str(prim.GetPath()) if moves else state.mover
            state = State(world, visible, purpose, state.inside_instancer, mover)
        kind = prim.GetTypeName()
        schemas = applied(prim)
        if MIRROR_API in schemas:
            choice = read_mirror(prim, self.intake, self.choices.collections)
            if choice is not None:
                self.choices.prims[choice.mirror.path] = choice
        if FINISH_API in schemas:
            finish = read_finish(prim, self.intake)
            if finish is not None:
                self.finishes[finish.path] = finish
        if ENVIRONMENT_MAP_API in schemas and state.visible and not state.inside_instancer:
            self._environment_map(prim, state)
        if prim.IsModel():
            self._draw_mode(prim)
        if prim.IsA(UsdGeom.Camera):
            self._camera(prim, state)
        elif not state.visible or state.purpose not in self.purposes:
            pass
        elif kind in DRAWN:
            self._geometry(prim, state, found)
        elif prim.IsA(UsdGeom.PointInstancer):
            self._instancer(prim, state, found)
        elif prim.IsA(UsdGeom.Gprim):
            self.intake.note(prim.GetPath(), f"{kind} is not drawn")
        elif kind.endswith(("Light", "Light_1")):
            self._light(prim, state)
        return None if prim.IsA(UsdGeom.PointInstancer) else state

    def _draw_mode(self, prim) -> None:
        mode = prim.GetAttribute("model:drawMode")
        if mode and mode.Get() not in (None, "default", "inherited"):
            self.intake.note(prim.GetPath(), f"model:drawMode: {mode.Get()} is not used: its geometry is drawn")

    def _camera(self, prim, state: State) -> None:
        if state.inside_instancer:
            return
        try:
            self.cameras.append(read_camera(prim, state.world_from_parent, self.intake))
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; camera dropped")

    def _environment_map(self, prim, state: State) -> None:
        try:
            self.environment_maps.append(read_environment_map(prim, state.world_from_parent, self.intake))
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; {ENVIRONMENT_MAP_API} not used")

    def _light(self, prim, state: State) -> None:
        if state.inside_instancer:
            self.intake.note(prim.GetPath(), f"{prim.GetTypeName()} in a point instancer's prototype is not used")
            return
        try:
            self.lights.append(read_light(prim, state.world_from_parent, self.up_axis, self.intake))
        except NotImplementedError as unused:
            self.intake.note(prim.GetPath(), str(unused))
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; light dropped")

    def _geometry(self, prim, state: State, found: list[InstanceData]) -> None:
        path = str(prim.GetPath())
        if path not in self._drawn_index:
            self._drawn_index[path] = len(self.drawn)
            self.drawn.append(prim)
        mover = path if _varies(prim) else state.mover
        index = self._drawn_index[path]
        found.append(InstanceData(index, state.world_from_parent, path, (), moves=mover != "", mover=mover))

    def _instancer(self, prim, state: State, found: list[InstanceData]) -> None:
        path = str(prim.GetPath())
        try:
            targets, prototype, ids, transforms = read_instancer(prim, self.intake)
        except BadPrim as fault:
            self.intake.bad(path, f"{fault}; instancer dropped")
            return
        mover = path if _varies(prim) else state.mover
        for k, target in enumerate(targets):
            chosen = np.flatnonzero(prototype == k)
            if not len(chosen):
                continue
            items = self._prototype(prim, target, state.purpose)
            if mover:
                items = [replace(item, moves=True, mover=item.mover or mover) for item in items]
            if len(items) * len(chosen) + len(found) > self.intake.limits.instances:
                raise ValueError(f"<{path}>: more than {self.intake.limits.instances} instances; raise the limit")
            worlds = state.world_from_parent @ transforms[chosen]
            found.extend(expand(items, worlds, ids[chosen], path))

    def _prototype(self, instancer, target: str, purpose: str) -> list[InstanceData]:
        """The instances of one prototype of a point instancer, placed from the prototype's parent frame."""
        key = f"{target} {purpose}"
        if target in self.open_prototypes:
            self.intake.bad(instancer.GetPath(), f"prototypes: <{target}> holds this instancer itself; not drawn")
            return []
        if key not in self.prototypes:
            self.open_prototypes.append(target)
            prim = self.stage.GetPrimAtPath(target)
            # Prototypes are often kept as overs or classes so that nothing draws them in place.
            predicate = Usd.PrimIsActive & Usd.PrimIsLoaded
            found: list[InstanceData] = []
            state = self.visit(prim, State(np.eye(4), purpose=purpose, inside_instancer=True), found)
            if state is not None:
                found.extend(self.below(prim, state, predicate))
            self.prototypes[key] = found
            self.open_prototypes.pop()
        return self.prototypes[key]
