"""Bound materials to `MaterialData`: UsdPreviewSurface networks, and displayColor where nothing is bound."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from pxr import UsdShade

from warp_reflect.scene import MaterialData
from warp_reflect.stage.geometry import display_color
from warp_reflect.stage.intake import Intake

PREVIEW_SURFACE = "UsdPreviewSurface"


@dataclass(frozen=True)
class _Parameter:
    """An input of UsdPreviewSurface: the field of MaterialData it sets, its width and legal range."""

    field: str
    width: int
    low: float = 0.0
    high: float = np.inf


# Inputs and ranges: UsdPreviewSurface specification, core nodes.
PARAMETERS = {
    "diffuseColor": _Parameter("base_color", 3),
    "emissiveColor": _Parameter("emissive", 3),
    "specularColor": _Parameter("specular_color", 3),
    "metallic": _Parameter("metallic", 1, 0.0, 1.0),
    "roughness": _Parameter("roughness", 1, 0.0, 1.0),
    "clearcoat": _Parameter("clearcoat", 1, 0.0, 1.0),
    "clearcoatRoughness": _Parameter("clearcoat_roughness", 1, 0.0, 1.0),
    "opacity": _Parameter("opacity", 1, 0.0, 1.0),
    "ior": _Parameter("ior", 1),
}


class MaterialTable:
    """The materials of one reading, each once; hands out indices into `materials`."""

    def __init__(self, intake: Intake):
        self.intake = intake
        self.materials: list[MaterialData] = []
        self._index: dict = {}

    def of_prim(self, prim, subset=None, has_colors: bool = False) -> int:
        """The material of a drawn prim, or of one of its GeomSubsets.

        Args:
            prim: The drawn prim.
            subset: One of its GeomSubsets, or None.
            has_colors: Whether its mesh carries colours of its own, which show where no material is bound.
        """
        target = subset or prim
        material, binding = UsdShade.MaterialBindingAPI(target).ComputeBoundMaterial(UsdShade.Tokens.full)
        if material:
            index = self._of_material(material)
            if index is not None:
                return index
        elif binding:
            targets = ", ".join(f"<{t}>" for t in binding.GetTargets())
            self.intake.note(
                target.GetPath(), f"{binding.GetName()}: {targets or 'no target'} is no Material; not used"
            )
        return self._of_color(prim, has_colors)

    def _of_material(self, material) -> int | None:
        prim = material.GetPrim()
        # The copies of an instance share the material of their prototype.
        key = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if key not in self._index:
            data = read_material(material, self.intake)
            self._index[key] = None if data is None else self._add(data)
        return self._index[key]

    def _of_color(self, prim, has_colors: bool) -> int:
        color, opacity = display_color(prim, self.intake)
        key = (None if has_colors else color, opacity, has_colors)
        if key not in self._index:
            data = MaterialData(opacity=opacity, uses_vertex_color=has_colors)
            if color is not None:
                data = dataclasses.replace(data, base_color=color)
            self._index[key] = self._add(data)
        return self._index[key]

    def _add(self, data: MaterialData) -> int:
        self.materials.append(data)
        return len(self.materials) - 1


def read_material(material: UsdShade.Material, intake: Intake) -> MaterialData | None:
    """A UsdShade material; None (with a note) where no surface of it is understood."""
    path = material.GetPath()
    shader, _, _ = material.ComputeSurfaceSource()
    if not shader:
        intake.note(path, "outputs:surface: no surface shader; drawn with displayColor")
        return None
    identifier = shader.GetIdAttr().Get()
    if identifier != PREVIEW_SURFACE:
        intake.note(path, f"info:id: got {identifier!r}, expected {PREVIEW_SURFACE}; drawn with displayColor")
        return None
    values = {}
    for name, parameter in PARAMETERS.items():
        value = _constant(shader, name, parameter, intake)
        if value is not None:
            values[parameter.field] = value
    workflow = shader.GetInput("useSpecularWorkflow")
    if workflow:
        values["specular_workflow"] = workflow.Get(intake.time) == 1
    for name in ("normal", "displacement"):
        if shader.GetInput(name) and shader.GetInput(name).HasConnectedSource():
            intake.note(path, f"inputs:{name}: its texture is not used")
    return MaterialData(path=str(path), **values)


def _constant(shader: UsdShade.Shader, name: str, parameter: _Parameter, intake: Intake):
    """The value at the end of an input's connections; None where unauthored, bad or computed."""
    source = shader.GetInput(name)
    if not source:
        return None
    path = shader.GetPath()
    for attribute in UsdShade.Utils.GetValueProducingAttributes(source):
        if UsdShade.Output.IsOutput(attribute):
            node = UsdShade.Shader(attribute.GetPrim())
            kind = node.GetIdAttr().Get() if node else None
            intake.note(
                path,
                f"inputs:{name}: driven by {kind or attribute.GetPrim().GetTypeName()}; its default is used",
            )
            return None
        value = attribute.Get(intake.time)
        if value is None:
            continue
        array = (
            np.array(value, np.float64).reshape(-1) if np.asarray(value).dtype.kind in "fiu" else np.zeros(0)
        )
        if len(array) not in (1, parameter.width) or not np.isfinite(array).all():
            intake.bad(
                path,
                f"inputs:{name}: got {value}, expected {parameter.width} finite number(s); its default "
                f"is used",
            )
            return None
        clipped = np.clip(array, parameter.low, parameter.high)
        if (clipped != array).any():
            intake.note(
                path, f"inputs:{name}: got {value}, clipped to [{parameter.low:g}, {parameter.high:g}]"
            )
        clipped = np.broadcast_to(clipped, (parameter.width,))
        return tuple(float(v) for v in clipped) if parameter.width > 1 else float(clipped[0])
    return None
