"""A stage at another time in which nothing but places and cameras change: those alone are read."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from warp_reflect.scene import CameraData, InstanceData, SceneData
from warp_reflect.stage.assemble import Smooth, suspect_worlds
from warp_reflect.stage.cameras import read_camera
from warp_reflect.stage.detail import pixels_across, subdivision_level
from warp_reflect.stage.intake import BadPrim, Intake
from warp_reflect.stage.walk import Local, local_of, world_of


@dataclass(frozen=True)
class _Link:
    """A prim in or above which something moves.

    Attributes:
        prim: The prim.
        above: The link of its parent; -1: the stage itself.
        still: What `walk.local_of` gives at every time; None: that has to be asked.
    """

    prim: Usd.Prim
    above: int
    still: Local | None


@dataclass
class Places:
    """What of a reading holds at every time of its stage, and what has to be asked again.

    Attributes:
        stage: Open.
        first: The reading.
        smooth: Its subdivided meshes, whose detail depends on where they are seen from.
        links: What moves, cameras, and all above them, parents first.
        link_of: Of each such path.
    """

    stage: Usd.Stage
    first: SceneData
    smooth: list[Smooth]
    links: list[_Link]
    link_of: dict[str, int]

    @classmethod
    def of(cls, stage: Usd.Stage, first: SceneData, smooth: list[Smooth]) -> Places | None:
        """None where more than places and cameras may change, or a fault of them was met."""
        varying = _varying(stage)
        if varying is None or any(each.moves and each.instance for each in first.instances):
            return None
        fixed = [light.path for light in first.lights] + [each.path for each in first.environment_maps]
        told = [note.path for note in first.notes]
        if any(_below(path, varying) for path in fixed + told):
            return None
        if not all(stage.GetPrimAtPath(camera.path).IsValid() for camera in first.cameras):
            return None  # the default camera, which follows the bounds
        placed = [each.prim_path for each in first.instances]
        whole = all(sum(path in each.paths for path in placed) == each.count for each in smooth)
        paths = [each.prim_path for each in first.instances if each.moves] + [each.path for each in first.cameras]
        return cls(stage, first, smooth, *_links(stage, paths, varying)) if whole else None

    def at(self, time: float | None, intake: Intake) -> SceneData | None:
        """The stage at a time; None where it has to be read."""
        transforms, worlds = UsdGeom.XformCache(intake.time), []
        for link in self.links:
            local = local_of(link.prim, transforms) if link.still is None else link.still
            worlds.append(world_of(local, worlds[link.above] if link.above >= 0 else np.eye(4)))

        def world(path: str) -> np.ndarray:
            return worlds[self.link_of[path]]

        instances: list[InstanceData] = []
        for each in self.first.instances:
            instances.append(replace(each, world_from_object=world(each.prim_path)) if each.moves else each)
        try:
            cameras = [
                read_camera(self.stage.GetPrimAtPath(each.path), world(each.path), intake)
                for each in self.first.cameras
            ]
        except BadPrim:
            return None
        moved = [each.world_from_object for each in instances if each.moves]
        bad = bool(moved) and suspect_worlds(np.stack(moved)).any()
        if bad or set(intake.notes) - set(self.first.notes) or self._other_detail(instances, cameras[0]):
            return None
        return replace(self.first, time=time, instances=instances, cameras=cameras, notes=list(self.first.notes))

    def _other_detail(self, instances: list[InstanceData], camera: CameraData) -> bool:
        for each in self.smooth:
            worlds = np.stack([one.world_from_object for one in instances if one.prim_path in each.paths])
            pixels = pixels_across(*each.box, worlds, camera)
            if subdivision_level(each.faces, each.mirror, pixels) != each.level:
                return True
        return False


def _varying(stage: Usd.Stage) -> set[str] | None:
    """Paths of the prims whose place, or camera, may change in time; None where anything else may."""
    found = set()
    for root in (stage.GetPseudoRoot(), *stage.GetPrototypes()):
        for prim in Usd.PrimRange(root, Usd.PrimAllPrimsPredicate):
            names = [each.GetName() for each in prim.GetAuthoredAttributes() if each.ValueMightBeTimeVarying()]
            if names and not prim.IsA(UsdGeom.Camera) and not all(name.startswith("xformOp:") for name in names):
                return None
            if names and prim.IsInPrototype():
                return None  # of which of its copies a path below is told, the stage does not say
            if names:
                found.add(str(prim.GetPath()))
    return found


def _below(path: str, roots: set[str]) -> bool:
    """Whether a path is one of some, or lies below one."""
    while path.startswith("/") and path != "/":
        if path in roots:
            return True
        path = path.rpartition("/")[0]
    return False


def _links(stage: Usd.Stage, paths: list[str], varying: set[str]) -> tuple[list[_Link], dict[str, int]]:
    """(prims and all above them, parents first; the number of each path there)."""
    links, link_of = [], {}
    transforms = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())  # the default has no value where there is one sample

    def add(prim: Usd.Prim) -> int:
        if prim.IsPseudoRoot():
            return -1
        path = str(prim.GetPath())
        if path not in link_of:
            above = add(prim.GetParent())
            link_of[path] = len(links)
            links.append(_Link(prim, above, None if path in varying else local_of(prim, transforms)))
        return link_of[path]

    for path in paths:
        add(stage.GetPrimAtPath(path))
    return links, link_of
