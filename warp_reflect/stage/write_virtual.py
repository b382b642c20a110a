"""The layer of virtual objects that `warp-reflect process` writes over a stage.

Under one scope, `WarpReflect` below the stage's default prim, every mirror has a scope and every object seen in it a Mesh, in
world space: its points are float32 relative to a translation in double precision, whatever moves the prims above. USD
interpolates points between time samples of equally many; where the topology differs a point too many keeps it from that.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from warp_reflect.stage.read import quiet
from warp_reflect.stage.write import PROVENANCE, layer_over, open_source, save_layer

SCOPE = "WarpReflect"
KIND = "warp_reflect:kind"
PURPOSES = ("default", "render", "proxy", "guide")
FACE_VARYING = "faceVarying"
TRIANGLE = 3


@dataclass(frozen=True)
class Place:
    """A drawn prim of the stage, or a part of one."""

    prim_path: str
    subset: str = ""
    instance: str = ""

    @property
    def path(self) -> str:
        """The prim, or its GeomSubset."""
        return f"{self.prim_path}/{self.subset}" if self.subset else self.prim_path


@dataclass(frozen=True)
class VirtualSample:
    """A virtual object at one time.

    Attributes:
        mirror, source: Whose it is, and what it is a picture of.
        piece: See `virtual_objects.VirtualObject`.
        technique: That solved it.
        points: float64 [n, 3], world. [stage units]
        triangles: int32 [m, 3].
        color: Linear Rec.709 of the source's material, of all of it.
        corner_colors: float32 [3 m, 3] instead; None: `color`.
        uvs: float32 [3 m, 2]; None: without.
        uv_name: The primvar that they are.
    """

    mirror: Place
    source: Place
    piece: int
    technique: str
    points: np.ndarray
    triangles: np.ndarray
    color: tuple[float, float, float]
    corner_colors: np.ndarray | None = None
    uvs: np.ndarray | None = None
    uv_name: str = "st"


@dataclass
class VirtualLayer:
    """A layer over a stage that takes virtual objects, frame by frame.

    Attributes:
        path: Where it is saved.
        origin: float64 [3]: what points are relative to; None until the first frame.
        times: Time codes it holds; None stands for default values.
    """

    path: Path
    _stage: Usd.Stage
    _layer: Sdf.Layer
    _scope: Sdf.Path
    _provenance: dict
    _names: dict = field(default_factory=dict)
    origin: np.ndarray | None = None
    times: set[float | None] = field(default_factory=set)

    @classmethod
    def open(
        cls, stage_path: str, path: Path, provenance: Mapping[str, object], purpose: str, resume: bool
    ) -> VirtualLayer:
        """A new layer, or the one at `path` to go on with where it has the same `provenance["key"]`.

        Args:
            stage_path: What it lies over.
            path: From `write.check_layer_writable`.
            provenance: Noted in the layer under `customLayerData["warp_reflect"]["process"]`: str, int, float or bool.
            purpose: Of the virtual objects, one of `PURPOSES`.
            resume: Go on with what is there.

        Raises:
            ValueError: the stage cannot be read, or `path` is one of its layers.
        """
        stage = open_source(stage_path)
        with quiet():
            layer = layer_over(stage, stage_path, path)
            known = _read_layer(path) if resume else None
            noted = _noted(known)
            if noted.get("key") == provenance["key"]:
                scope = Sdf.Path(noted["scope"])
                frames = noted.get("frames")
                made = cls(path, stage, known, scope, dict(noted))
                made.origin = np.array(noted["origin"], np.float64) if "origin" in noted else None
                made.times = {None} if frames is None else set(map(float, frames))
                return made
            parent = _parent(stage)
            scope = parent.AppendChild(_free_name(stage, parent))
            _complete_metadata(layer)
            made = cls(path, stage, layer, scope, dict(provenance) | {"scope": str(scope)})
            # Above it nothing is defined that the stage does not define.
            _define(layer, scope, "Scope")
            _uniform(layer.GetPrimAtPath(scope), "purpose", Sdf.ValueTypeNames.Token, purpose)
            return made

    def add(self, time: float | None, origin: np.ndarray, samples: list[VirtualSample]) -> None:
        """Add the virtual objects of a frame.

        Args:
            time: Time code; None: default values.
            origin: Near the scene, float64 [3]; the first frame's is kept for all.
            samples: Those seen.
        """
        if self.origin is None:
            self.origin = np.array(origin, np.float64)
        for sample in samples:
            prim = self._mesh(sample)
            with quiet():
                self._write(prim, time, sample)
        self.times.add(time)

    def save(self) -> None:
        """Write the layer whole.

        Raises:
            OSError: it could not be written; what was saved before is still there.
        """
        with quiet():
            if None not in self.times:
                self._write_visibility()
            noted = dict(self._provenance)
            if self.origin is not None:
                noted["origin"] = Gf.Vec3d(*map(float, self.origin))
            if None not in self.times:
                noted["frames"] = Vt.DoubleArray(sorted(self.times))
            known = dict(self._layer.customLayerData)
            own = known.get(PROVENANCE)
            known[PROVENANCE] = (dict(own) if isinstance(own, dict) else {}) | {"process": noted}
            self._layer.customLayerData = known
            save_layer(self._layer, self.path, usd_format="usdc")

    def note(self, **entries: str) -> None:
        """Add to the provenance, where an entry is not there yet."""
        self._provenance = entries | self._provenance

    def meshes_at(self, time: float | None) -> list[tuple[str, str, np.ndarray, np.ndarray, tuple]]:
        """(mirror's name, object's name, points float64 [n, 3] from `origin`, triangles, colour) of a frame."""
        found = []
        for prim in self._meshes():
            points, index = (self._value(prim, name, time) for name in ("points", "faceVertexIndices"))
            if points is None or len(index) == 0:
                continue
            color = tuple(np.array(self._color(prim, time), np.float64).mean(axis=0))
            triangles = np.array(index, np.int64).reshape(-1, TRIANGLE)
            found.append((prim.nameParent.name, prim.name, np.array(points, np.float64), triangles, color))
        return found

    def _meshes(self) -> list[Sdf.PrimSpec]:
        scope = self._layer.GetPrimAtPath(self._scope)
        return [mesh for mirror in scope.nameChildren for mesh in mirror.nameChildren]

    def _value(self, prim: Sdf.PrimSpec, name: str, time: float | None):
        attribute = prim.attributes.get(name)
        if attribute is None:
            return None
        return attribute.default if time is None else self._layer.QueryTimeSample(attribute.path, time)

    def _color(self, prim: Sdf.PrimSpec, time: float | None):
        constant = prim.attributes["primvars:displayColor"].default
        return constant if constant is not None else self._value(prim, "primvars:displayColor", time)

    def _mesh(self, sample: VirtualSample) -> Sdf.PrimSpec:
        mirror_name = self._name(sample.mirror) + (f"__{sample.piece}" if sample.piece else "")
        mirror_path = self._scope.AppendChild(mirror_name)
        path = mirror_path.AppendChild(self._name(sample.source))
        prim = self._layer.GetPrimAtPath(path)
        if prim:
            return prim
        if not self._layer.GetPrimAtPath(mirror_path):
            mirror = _define(self._layer, mirror_path, "Scope")
            _relate(mirror, "warp_reflect:mirror", sample.mirror.path)
            _uniform(mirror, "warp_reflect:technique", Sdf.ValueTypeNames.Token, sample.technique)
            if sample.mirror.instance:
                _uniform(mirror, "warp_reflect:mirrorInstance", Sdf.ValueTypeNames.String, sample.mirror.instance)
            if sample.piece:
                _uniform(mirror, "warp_reflect:piece", Sdf.ValueTypeNames.Int, sample.piece)
        prim = _define(self._layer, path, "Mesh")
        _uniform(prim, KIND, Sdf.ValueTypeNames.Token, "virtual")
        _relate(prim, "warp_reflect:source", sample.source.path)
        if sample.source.instance:
            _uniform(prim, "warp_reflect:sourceInstance", Sdf.ValueTypeNames.String, sample.source.instance)
        _uniform(prim, "subdivisionScheme", Sdf.ValueTypeNames.Token, "none")
        _uniform(prim, "doubleSided", Sdf.ValueTypeNames.Bool, True)
        order = Vt.TokenArray([UsdGeom.XformOpTypes.resetXformStack, "xformOp:translate"])
        _uniform(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, order)
        translate = Sdf.AttributeSpec(prim, "xformOp:translate", Sdf.ValueTypeNames.Double3)
        translate.default = Gf.Vec3d(*map(float, self.origin))
        if sample.corner_colors is None:
            color = Sdf.AttributeSpec(prim, "primvars:displayColor", Sdf.ValueTypeNames.Color3fArray)
            color.default = Vt.Vec3fArray([Gf.Vec3f(*map(float, sample.color))])
            color.SetInfo("interpolation", UsdGeom.Tokens.constant)
        material = self._material(sample.source)
        if material:
            prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
            _relate(prim, "material:binding", material)
        return prim

    def _material(self, source: Place) -> str:
        """Path of the material that a prim, or its GeomSubset, is bound to; empty: none that can be named."""
        prim = self._stage.GetPrimAtPath(source.path)
        if not prim:
            return ""
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        if not material or material.GetPrim().IsInPrototype():
            return ""
        return str(material.GetPath())

    def _name(self, place: Place) -> str:
        if place not in self._names:
            self._names[place] = place_name(place, str(self._scope.GetParentPath()))
        return self._names[place]

    def _write(self, prim: Sdf.PrimSpec, time: float | None, sample: VirtualSample) -> None:
        points = (sample.points - self.origin).astype(np.float32)
        index = sample.triangles.reshape(-1).astype(np.int32)
        points = self._kept_apart(prim, time, points, index)
        kinds = Sdf.ValueTypeNames
        counts = np.full(len(sample.triangles), TRIANGLE, np.int32)
        self._set(prim, time, "points", kinds.Point3fArray, Vt.Vec3fArray.FromNumpy(points))
        self._set(prim, time, "faceVertexCounts", kinds.IntArray, Vt.IntArray.FromNumpy(counts))
        self._set(prim, time, "faceVertexIndices", kinds.IntArray, Vt.IntArray.FromNumpy(index))
        extent = np.stack([points.min(axis=0), points.max(axis=0)])
        self._set(prim, time, "extent", kinds.Float3Array, Vt.Vec3fArray.FromNumpy(extent))
        if sample.corner_colors is not None:
            colors = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(sample.corner_colors, np.float32))
            attribute = self._set(prim, time, "primvars:displayColor", kinds.Color3fArray, colors)
            attribute.SetInfo("interpolation", FACE_VARYING)
        if sample.uvs is not None:
            uvs = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(sample.uvs, np.float32))
            attribute = self._set(prim, time, f"primvars:{sample.uv_name}", kinds.TexCoord2fArray, uvs)
            attribute.SetInfo("interpolation", FACE_VARYING)

    def _kept_apart(self, prim, time: float | None, points: np.ndarray, index: np.ndarray) -> np.ndarray:
        """The points, and some of the last one again where a neighbouring sample is another mesh of as many points."""
        attribute = prim.attributes.get("points")
        if time is None or attribute is None:
            return points
        taken = set()
        for other in self._neighbours(attribute.path, time):
            known = self._value(prim, "faceVertexIndices", other)
            if not np.array_equal(np.array(known), index):
                taken.add(len(self._value(prim, "points", other)))
        count = len(points)
        while count in taken:
            count += 1
        return np.concatenate([points, np.repeat(points[-1:], count - len(points), axis=0)])

    def _neighbours(self, path: Sdf.Path, time: float) -> list[float]:
        times = self._layer.ListTimeSamplesForPath(path)
        before, after = [t for t in times if t < time], [t for t in times if t > time]
        return before[-1:] + after[:1]

    def _set(self, prim: Sdf.PrimSpec, time: float | None, name: str, kind, value) -> Sdf.AttributeSpec:
        attribute = prim.attributes.get(name) or Sdf.AttributeSpec(prim, name, kind)
        if time is None:
            attribute.default = value
        else:
            self._layer.SetTimeSample(attribute.path, time, value)
        return attribute

    def _write_visibility(self) -> None:
        """Hide every mesh at the times at which its mirror does not show it."""
        for prim in self._meshes():
            shown = set(self._layer.ListTimeSamplesForPath(prim.path.AppendProperty("points")))
            for time in self.times:
                value = UsdGeom.Tokens.inherited if time in shown else UsdGeom.Tokens.invisible
                self._set(prim, time, "visibility", Sdf.ValueTypeNames.Token, value)


def _read_layer(path: Path) -> Sdf.Layer | None:
    if not path.is_file():
        return None
    try:
        return Sdf.Layer.OpenAsAnonymous(str(path))
    except Tf.ErrorException:
        return None


def _noted(layer: Sdf.Layer | None) -> dict:
    own = dict(layer.customLayerData).get(PROVENANCE) if layer else None
    noted = own.get("process") if isinstance(own, dict) else None
    good = isinstance(noted, dict) and isinstance(noted.get("scope"), str) and layer.GetPrimAtPath(noted["scope"])
    return noted if good else {}


def _parent(stage: Usd.Stage) -> Sdf.Path:
    """The default prim where it is a group that can be added to, else the root."""
    prim = stage.GetDefaultPrim()
    if not prim or not prim.IsActive() or not prim.IsDefined() or prim.IsAbstract() or prim.IsInstance():
        return Sdf.Path.absoluteRootPath
    group = prim.GetTypeName() == "" or prim.IsA(UsdGeom.Xform) or prim.IsA(UsdGeom.Scope)
    return prim.GetPath() if group else Sdf.Path.absoluteRootPath


def _free_name(stage: Usd.Stage, parent: Sdf.Path) -> str:
    name, number = SCOPE, 1
    while stage.GetPrimAtPath(parent.AppendChild(name)):
        number += 1
        name = f"{SCOPE}{number}"
    return name


def place_name(place: Place, parent: str) -> str:
    """A prim name for a place that no other place has: its path below `parent`, steps joined by two underscores."""
    below = parent.rstrip("/") + "/"
    inside = place.path.startswith(below)
    steps = place.path[len(below) :].split("/") if inside else ["", *place.path.strip("/").split("/")]
    name = "__".join(steps)
    if place.instance:
        name += f"__{place.instance}"
    plain = (not place.instance or place.instance.isdecimal()) and not any(
        "__" in step or step.startswith("_") or step.endswith("_") for step in steps
    )
    if plain:
        return name
    told = json.dumps([place.prim_path, place.subset, place.instance]).encode()
    return f"{Tf.MakeValidIdentifier(name)}_{hashlib.blake2b(told, digest_size=4).hexdigest()}"


def _complete_metadata(layer: Sdf.Layer) -> None:
    """Say what the stage leaves to USD's fallbacks: a layer without these is none that validators pass."""
    root = layer.pseudoRoot
    if not root.HasInfo("upAxis"):
        root.SetInfo("upAxis", UsdGeom.GetFallbackUpAxis())
    if not root.HasInfo("metersPerUnit"):
        root.SetInfo("metersPerUnit", UsdGeom.LinearUnits.centimeters)


def _define(layer: Sdf.Layer, path: Sdf.Path, kind: str) -> Sdf.PrimSpec:
    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier, prim.typeName = Sdf.SpecifierDef, kind
    return prim


def _uniform(prim: Sdf.PrimSpec, name: str, kind, value) -> None:
    Sdf.AttributeSpec(prim, name, kind, Sdf.VariabilityUniform).default = value


def _relate(prim: Sdf.PrimSpec, name: str, target: str) -> None:
    Sdf.RelationshipSpec(prim, name, custom=name.startswith("warp_reflect:")).targetPathList.explicitItems = [target]
