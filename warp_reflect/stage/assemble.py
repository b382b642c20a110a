"""From what the walk found to arrays: meshes, materials per part, the detail each mesh needs."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np
from pxr import Tf, UsdGeom, UsdLux

from warp_reflect.scene import InstanceData, MaterialData, MeshData, Note, SceneData
from warp_reflect.stage.cameras import default_camera
from warp_reflect.stage.detail import pixels_across, subdivision_level
from warp_reflect.stage.geometry import SMOOTH_SCHEMES, read_gprim, read_mesh, subdivision_scheme
from warp_reflect.stage.intake import BadPrim, Intake, floats, integers, library_message, transform_fault
from warp_reflect.stage.lights import mesh_light_radiance
from warp_reflect.stage.materials import MaterialTable, Surface
from warp_reflect.stage.points import read_points
from warp_reflect.stage.reflectors import Choices, may_reflect, part_names

DISPLAY_COLOR = "displayColor"
Box = tuple[np.ndarray, np.ndarray]


@dataclass
class MeshEntry:
    """A mesh that was read: kept between times where nothing of it changes."""

    mesh: MeshData
    subsets: list[str]  # GeomSubset name per part; "" for the rest
    notes: list[Note]


@dataclass(frozen=True)
class Smooth:
    """A subdivided mesh and what its level was chosen by.

    Attributes:
        paths: Of the prims that show it.
        count: Of its placements.
        box: Of its cage, in the frame of the mesh.
        faces: Of its cage.
        mirror: Whether it is one.
        level: That was chosen.
    """

    paths: frozenset[str]
    count: int
    box: Box
    faces: int
    mirror: bool
    level: int


@dataclass
class Assembly:
    """One reading's meshes, materials and instances.

    Attributes:
        intake: The reading.
        level: 0: every mesh gets the detail it needs; 1 to 3: all get this level.
        choices: What the user calls a mirror.
        static: Meshes of earlier readings, by what they depend on; filled here.
        smooth: The subdivided meshes whose level was chosen.
    """

    intake: Intake
    level: int
    choices: Choices
    static: dict[tuple, MeshEntry]
    meshes: list[MeshData] = field(default_factory=list)
    smooth: list[Smooth] = field(default_factory=list)

    def complete(self, data: SceneData, drawn: list, placed: list[InstanceData]) -> None:
        """Fill meshes, materials and instances of `data`, and its camera where it has none.

        Args:
            data: Has its cameras and collections already.
            drawn: Prims, as `Walk.drawn`.
            placed: Instances whose `mesh` is an index into `drawn`.
        """
        placed = usable(placed, self.intake)
        materials = MaterialTable(self.intake)
        members: dict[str, list[int]] = {}
        for index in sorted({instance.mesh for instance in placed}):
            members.setdefault(prototype_path(drawn[index]), []).append(index)
        surfaces = {
            index: [materials.bound(target) for target in targets(drawn[index])]
            for index in itertools.chain.from_iterable(members.values())
        }
        worlds: dict[int, list[np.ndarray]] = {}
        for instance in placed:
            worlds.setdefault(instance.mesh, []).append(instance.world_from_object)

        entries: dict[str, tuple[int, MeshEntry, str] | None] = {}
        boxes: dict[str, Box] = {}
        smooth: list[str] = []
        for key, indices in members.items():
            prim = drawn[indices[0]]
            if prim.GetTypeName() == "Mesh" and subdivision_scheme(prim, self.intake) in SMOOTH_SCHEMES:
                smooth.append(key)
                box = self._cage_box(prim)
                if box is not None:
                    boxes[key] = box
                continue
            entries[key] = self._entry(key, prim, [surfaces[i] for i in indices], self.level)
            if entries[key] is not None:
                boxes[key] = used_box(entries[key][1].mesh)
        stacks = {key: np.stack(list(itertools.chain.from_iterable(worlds[i] for i in members[key]))) for key in boxes}
        if not data.cameras:
            low, high = bounds(boxes, stacks)
            data.cameras.append(default_camera(low, high, data.up_axis))
            self.intake.note(data.cameras[0].path, "the stage has no camera; one that frames it is used")
        for key in smooth:
            prim, found = drawn[members[key][0]], [surfaces[i] for i in members[key]]
            level = self.level
            if level == 0 and key in boxes:
                mirror = any(self._is_mirror(drawn[i], surfaces[i]) for i in members[key])
                faces = self._cage_faces(prim)
                level = subdivision_level(faces, mirror, pixels_across(*boxes[key], stacks[key], data.cameras[0]))
                paths = frozenset(str(drawn[i].GetPath()) for i in members[key])
                self.smooth.append(Smooth(paths, len(stacks[key]), boxes[key], faces, mirror, level))
            entries[key] = self._entry(key, prim, found, level)

        parts: dict[int, tuple[int, tuple[int, ...]]] = {}
        for key, indices in members.items():
            if entries[key] is None:
                continue
            mesh_index, entry, color_name = entries[key]
            colored = color_name if entry.mesh.colors is not None else ""
            for index in indices:
                prim = drawn[index]
                chosen = tuple(
                    materials.of_prim(prim, prim.GetChild(name) if name else None, colored) for name in entry.subsets
                )
                if prim.HasAPI(UsdLux.MeshLightAPI):
                    chosen = self._glowing(prim, entry.mesh, worlds[index][0], materials.materials) or chosen
                parts[index] = mesh_index, chosen
        for instance in placed:
            if instance.mesh in parts:
                instance.mesh, instance.materials = parts[instance.mesh]
                data.instances.append(instance)
        data.meshes, data.materials = self.meshes, materials.materials
        total = sum(len(data.meshes[instance.mesh].triangles) for instance in data.instances)
        if total > self.intake.limits.triangles:
            raise ValueError(f"{data.source}: got {total} triangles, expected at most {self.intake.limits.triangles}")

    def _entry(self, key: str, prim, surfaces: list[list[Surface | None]], level: int):
        """(index into meshes, entry, colour primvar) of a mesh; None where it is dropped."""
        bound = [surface for each in surfaces for surface in each if surface is not None]
        wanted = list(dict.fromkeys(name for surface in bound for name in surface.uv_primvars))
        if len(wanted) > 1:
            self.intake.note(prim.GetPath(), f"primvars:{wanted[0]} is used for all textures, also for {wanted[1]}")
        uv_name = wanted[0] if wanted else ""
        color_name = next((s.color_primvar for s in bound if s.color_primvar), DISPLAY_COLOR)
        cache_key = (key, level, uv_name, color_name)
        entry = self.static.get(cache_key)
        if entry is None:
            before = len(self.intake.notes)
            try:
                entry = self._read(prim, level, uv_name, color_name)
            except (BadPrim, Tf.ErrorException) as fault:
                reason = library_message(fault) if isinstance(fault, Tf.ErrorException) else fault
                self.intake.bad(prim.GetPath(), f"{reason}; prim dropped")
                return None
            entry.notes = self.intake.notes[before:]
            if not changes_in_time(prim):
                self.static[cache_key] = entry
        else:
            for note in entry.notes:
                self.intake.note(note.path, note.text)
        self.meshes.append(entry.mesh)
        return len(self.meshes) - 1, entry, color_name

    def _glowing(self, prim, mesh: MeshData, world: np.ndarray, materials: list[MaterialData]) -> tuple[int, ...]:
        """Materials per part of a mesh whose light replaces its material; empty where it keeps that."""
        corners = mesh.points[mesh.triangles].astype(np.float64) @ world[:3, :3].T
        sides = corners[:, 1:] - corners[:, :1]
        area = 0.5 * float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())
        try:
            radiance = mesh_light_radiance(prim, area, self.intake)
        except BadPrim as fault:
            self.intake.bad(prim.GetPath(), f"{fault}; it does not glow")
            return ()
        if radiance is None:
            return ()
        materials.append(MaterialData(str(prim.GetPath()), (0.0,) * 3, roughness=1.0, ior=1.0, emissive=radiance))
        return (len(materials) - 1,) * max(len(mesh.parts), 1)

    def _read(self, prim, level: int, uv_name: str, color_name: str) -> MeshEntry:
        if prim.HasRelationship("skel:skeleton") or prim.HasAttribute("primvars:skel:jointIndices"):
            self.intake.note(prim.GetPath(), "skeletal skinning is not applied: drawn in its rest pose")
        if prim.HasAPI(UsdLux.MeshLightAPI):
            self.intake.note(prim.GetPath(), "MeshLightAPI: the mesh is seen to glow but does not light the scene")
        if prim.GetTypeName() == "Mesh":
            mesh, subsets = read_mesh(prim, self.intake, level, uv_name, color_name)
            return MeshEntry(mesh, [subset.GetName() if subset else "" for subset in subsets], [])
        if uv_name:
            self.intake.note(prim.GetPath(), f"{prim.GetTypeName()} has no texture coordinates: textures not used")
        if prim.GetTypeName() == "Points":
            return MeshEntry(read_points(prim, self.intake, level, color_name), [""], [])
        return MeshEntry(read_gprim(prim, self.intake, level), [""], [])

    def _cage_box(self, prim) -> Box | None:
        try:
            points = floats(UsdGeom.Mesh(prim).GetPointsAttr(), self.intake.time, 3)
        except BadPrim:
            return None  # told when the mesh is read
        if points is None or not len(points) or not np.isfinite(points).all():
            return None
        return points.min(axis=0), points.max(axis=0)

    def _cage_faces(self, prim) -> int:
        try:
            counts = integers(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr(), self.intake.time)
        except BadPrim:
            return 0  # told when the mesh is read
        return 0 if counts is None else len(counts)

    def _is_mirror(self, prim, surfaces: list[Surface | None]) -> bool:
        for target, surface in zip(targets(prim), surfaces, strict=True):
            subset = "" if target == prim else target.GetName()
            choice = self.choices.of(part_names(str(prim.GetPath()), subset, "", surface.data.path if surface else ""))
            if choice.mirror.include if choice else surface is not None and may_reflect(surface.data):
                return True
        return False


def targets(prim) -> list:
    """What materials are bound to: the prim and, of a mesh, its GeomSubsets."""
    if prim.GetTypeName() != "Mesh":
        return [prim]
    return [prim, *(subset.GetPrim() for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(prim)))]


def prototype_path(prim) -> str:
    """Path that all instances of one prim share."""
    return str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())


def changes_in_time(prim) -> bool:
    """Whether anything but the place of a drawn prim may be animated."""
    prims = [prim, *(child for child in prim.GetChildren() if child.GetTypeName() == "GeomSubset")]
    return any(
        attribute.ValueMightBeTimeVarying()
        for each in prims
        for attribute in each.GetAuthoredAttributes()
        if not attribute.GetName().startswith("xformOp") and attribute.GetName() != "visibility"
    )


def usable(placed: list[InstanceData], intake: Intake) -> list[InstanceData]:
    """The instances whose transforms can be used; the others noted, one note a prim."""
    if not placed:
        return []
    # What fails is looked at one by one.
    suspect = suspect_worlds(np.stack([instance.world_from_object for instance in placed]))
    kept, blamed = [], set()
    for instance, look in zip(placed, suspect, strict=True):
        fault = transform_fault(instance.world_from_object) if look else ""
        if not fault:
            kept.append(instance)
        elif instance.prim_path not in blamed:
            blamed.add(instance.prim_path)
            where = f" (instance {instance.instance})" if instance.instance else ""
            intake.bad(instance.prim_path, f"{fault}{where}; prim dropped")
    return kept


def suspect_worlds(worlds: np.ndarray) -> np.ndarray:
    """Which transforms, float64 [n, 4, 4], may be unusable, bool [n], by a cheap bound that no good one fails."""
    suspect = ~np.isfinite(worlds).all(axis=(1, 2))
    with np.errstate(all="ignore"):
        scale = np.linalg.norm(worlds[:, :3, :3], axis=1)
        volume = np.abs(np.linalg.det(np.where(suspect[:, None, None], np.eye(3), worlds[:, :3, :3])))
        suspect |= ~(volume > 1.0e-9 * scale.prod(axis=1)) | (scale.min(axis=1) < 1.0e-9 * scale.max(axis=1))
        suspect |= (np.abs(worlds).max(axis=(1, 2)) > 1.0e9) | (worlds[:, 3] != [0.0, 0.0, 0.0, 1.0]).any(axis=1)
    return suspect


def used_box(mesh: MeshData) -> Box:
    """Bounds of the points that triangles use, float64 [3] each."""
    is_used = np.zeros(len(mesh.points), bool)
    is_used[mesh.triangles.reshape(-1)] = True
    used = mesh.points[is_used]
    return used.min(axis=0).astype(np.float64), used.max(axis=0).astype(np.float64)


def bounds(boxes: dict[str, Box], worlds: dict[str, np.ndarray]) -> Box:
    """World bounds of boxes in object space at all their placements; a unit cube where there are none."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for key, ends in boxes.items():
        corners = np.array(list(itertools.product(*zip(*ends, strict=True))))
        points = corners @ worlds[key][:, :3, :3].transpose(0, 2, 1) + worlds[key][:, None, :3, 3]
        low, high = np.minimum(low, points.min(axis=(0, 1))), np.maximum(high, points.max(axis=(0, 1)))
    if not boxes:
        return -np.ones(3), np.ones(3)
    return low, high
