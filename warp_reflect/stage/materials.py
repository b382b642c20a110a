"""Bound materials to `MaterialData`: UsdPreviewSurface, the common MaterialX surfaces, displayColor."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from pxr import Tf, UsdShade

from warp_reflect.scene import MaterialData, TextureRef
from warp_reflect.stage.intake import Intake, library_message
from warp_reflect.stage.primvars import display_color, read_primvar
from warp_reflect.stage.textures import is_texture, read_texture, scaled, value_of

# Fields of MaterialData whose textures shade.py looks up.
SHADED_TEXTURES = ("base_color", "emissive", "specular_color", "metallic", "roughness", "clearcoat")
NODE_HOPS_MAX = 16  # nodes followed from a surface input; longer chains (and cycles) are not evaluated
PASS_THROUGH = ("ND_convert_", "ND_dot_", "ND_normalmap")
EXTRACTED = ("r", "g", "b", "a")


@dataclass(frozen=True)
class _Parameter:
    """Input `name` of a surface node sets `field` of MaterialData, times the input `weight`."""

    name: str
    field: str
    default: float | tuple[float, float, float]
    high: float = np.inf
    weight: str = ""
    weight_default: float = 1.0

    @property
    def width(self) -> int:
        return 3 if isinstance(self.default, tuple) else 1


_GREY = (0.8, 0.8, 0.8)
_BLACK = (0.0, 0.0, 0.0)
_WHITE = (1.0, 1.0, 1.0)
# Sources: UsdPreviewSurface specification; MaterialX standard_surface 1.38 (its nodedef's defaults); OpenPBR
# 1.1.
_PREVIEW = (
    _Parameter("diffuseColor", "base_color", (0.18, 0.18, 0.18)),
    _Parameter("emissiveColor", "emissive", _BLACK),
    _Parameter("specularColor", "specular_color", _BLACK),
    _Parameter("metallic", "metallic", 0.0, 1.0),
    _Parameter("roughness", "roughness", 0.5, 1.0),
    _Parameter("clearcoat", "clearcoat", 0.0, 1.0),
    _Parameter("clearcoatRoughness", "clearcoat_roughness", 0.01, 1.0),
    _Parameter("opacity", "opacity", 1.0, 1.0),
    _Parameter("ior", "ior", 1.5),
)
_STANDARD = (
    _Parameter("base_color", "base_color", _GREY, weight="base"),
    _Parameter("emission_color", "emissive", _WHITE, weight="emission", weight_default=0.0),
    _Parameter("metalness", "metallic", 0.0, 1.0),
    _Parameter("specular_roughness", "roughness", 0.2, 1.0),
    _Parameter("coat", "clearcoat", 0.0, 1.0),
    _Parameter("coat_roughness", "clearcoat_roughness", 0.1, 1.0),
    _Parameter("opacity", "opacity", 1.0, 1.0),
    _Parameter("specular_IOR", "ior", 1.5),
)
_OPEN_PBR = (
    _Parameter("base_color", "base_color", _GREY, weight="base_weight"),
    _Parameter("emission_color", "emissive", _WHITE, weight="emission_luminance", weight_default=0.0),
    _Parameter("base_metalness", "metallic", 0.0, 1.0),
    _Parameter("specular_roughness", "roughness", 0.3, 1.0),
    _Parameter("coat_weight", "clearcoat", 0.0, 1.0),
    _Parameter("coat_roughness", "clearcoat_roughness", 0.0, 1.0),
    _Parameter("geometry_opacity", "opacity", 1.0, 1.0),
    _Parameter("specular_ior", "ior", 1.5),
)
SURFACES = {
    "UsdPreviewSurface": _PREVIEW,
    "ND_UsdPreviewSurface_surfaceshader": _PREVIEW,
    "ND_standard_surface_surfaceshader": _STANDARD,
    "ND_open_pbr_surface_surfaceshader": _OPEN_PBR,
}
# Inputs that change the picture and are not simulated: noted where they are driven, or not this value.
UNUSED = {
    "normal": None,
    "displacement": 0.0,
    "opacityThreshold": 0.0,
    "transmission": 0.0,
    "transmission_weight": 0.0,
    "subsurface": 0.0,
    "subsurface_weight": 0.0,
    "sheen": 0.0,
    "fuzz_weight": 0.0,
    "thin_film_thickness": 0.0,
    "thin_film_weight": 0.0,
    "geometry_normal": None,
    "coat_normal": None,
}


@dataclass(frozen=True)
class _PrimvarInput:
    """A parameter that a primvar of the drawn prim sets."""

    parameter: _Parameter
    primvar: str
    fallback: float | tuple[float, ...]


@dataclass(frozen=True)
class Surface:
    """A material as read: its constants and textures, and what each drawn prim's primvars set."""

    data: MaterialData
    primvars: tuple[_PrimvarInput, ...] = ()

    @property
    def color_primvar(self) -> str:
        """The primvar that sets the base colour; empty: none does."""
        return next((p.primvar for p in self.primvars if p.parameter.field == "base_color"), "")

    @property
    def uv_primvars(self) -> list[str]:
        """The primvars its textures are looked up with, each once."""
        return list(dict.fromkeys(texture.uv_name for texture in self.data.textures.values()))


@dataclass
class MaterialTable:
    """The materials of one reading, each once; hands out indices into `materials`."""

    intake: Intake
    materials: list[MaterialData] = field(default_factory=list)
    _surfaces: dict[str, Surface | None] = field(default_factory=dict)
    _index: dict = field(default_factory=dict)

    def bound(self, target) -> Surface | None:
        """The material bound to a prim or GeomSubset; None where there is none that is understood."""
        binding = UsdShade.MaterialBindingAPI(target)
        try:
            material, relationship = binding.ComputeBoundMaterial(UsdShade.Tokens.full)
        except Tf.ErrorException as fault:
            self.intake.bad(target.GetPath(), f"material:binding: {library_message(fault)}; not used")
            return None
        if not material:
            if relationship:
                targets = ", ".join(f"<{t}>" for t in relationship.GetTargets())
                self.intake.note(
                    target.GetPath(),
                    f"{relationship.GetName()}: {targets or 'no target'} is no Material; not used",
                )
            return None
        prim = material.GetPrim()
        # The copies of an instance share the material of their prototype.
        key = str((prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim).GetPath())
        if key not in self._surfaces:
            self._surfaces[key] = read_material(material, self.intake)
        return self._surfaces[key]

    def of_prim(self, prim, subset=None, colored: str = "") -> int:
        """Index of the material of a drawn prim, or of one of its GeomSubsets.

        Args:
            prim: The drawn prim.
            subset: One of its GeomSubsets, or None.
            colored: The primvar its mesh carries as colours of its own; empty: it has none.
        """
        surface = self.bound(subset or prim)
        has_colors = colored != "" and colored == ("displayColor" if surface is None else surface.color_primvar)
        if surface is None:
            color, opacity = display_color(prim, self.intake)
            data = MaterialData(opacity=opacity, uses_vertex_color=has_colors)
            if color is not None and not has_colors:
                data = dataclasses.replace(data, base_color=color)
            return self._add(data, (data.base_color, opacity, has_colors))
        data, values = surface.data, []
        for each in surface.primvars:
            if each.parameter.field == "base_color" and has_colors:
                data = dataclasses.replace(data, uses_vertex_color=True)
                values.append(True)
                continue
            value = self._primvar_value(prim, each)
            values.append(value)
            data = dataclasses.replace(data, **{each.parameter.field: value})
        return self._add(data, (id(surface), *values))

    def _primvar_value(self, prim, each: _PrimvarInput):
        found = read_primvar(prim, each.primvar, each.parameter.width, self.intake)
        if found is None:
            return each.fallback
        values = found.flat()
        if found.interpolation != "constant" and np.ptp(values, axis=0).any():
            self.intake.note(prim.GetPath(), f"primvars:{each.primvar}: its mean is used for {each.parameter.name}")
            values = values.mean(axis=0, keepdims=True)
        return _fitted(values[0], each.parameter)

    def _add(self, data: MaterialData, key: tuple) -> int:
        if key not in self._index:
            self._index[key] = len(self.materials)
            self.materials.append(data)
        return self._index[key]


def read_material(material: UsdShade.Material, intake: Intake) -> Surface | None:
    """A UsdShade material; None (with a note) where no surface of it is understood."""
    path = material.GetPath()
    met = []
    for context in ("", "mtlx"):
        shader, _, _ = material.ComputeSurfaceSource(context)
        identifier = shader.GetIdAttr().Get() if shader else None
        if identifier in SURFACES:
            return _read_surface(shader, SURFACES[identifier], str(path), intake)
        if shader:
            met.append(str(identifier))
    if met:
        intake.note(path, f"info:id: got {met[0]}, expected one of {', '.join(SURFACES)}; displayColor is used")
    else:
        intake.note(path, "outputs:surface: no surface shader; displayColor is used")
    return None


def _read_surface(shader: UsdShade.Shader, parameters, path: str, intake: Intake) -> Surface:
    values: dict = {"path": path}
    textures: dict[str, TextureRef] = {}
    primvars: list[_PrimvarInput] = []
    for parameter in parameters:
        weight = _weight(shader, parameter, intake)
        value = _evaluate(shader, parameter, intake)
        if isinstance(value, _PrimvarInput):
            primvars.append(value)
            value = value.fallback
        if isinstance(value, tuple) and isinstance(value[0], TextureRef):
            texture, value = value
            textures[parameter.field] = texture if weight == 1.0 else scaled(texture, weight)
        if parameter.width == 3:
            values[parameter.field] = tuple(float(weight * v) for v in value)
        else:
            values[parameter.field] = float(value)
    unshaded = sorted(set(textures) - set(SHADED_TEXTURES))
    if unshaded:
        intake.note(path, f"textures of {', '.join(unshaded)} are read but not shaded; constants are used")
    workflow = value_of(shader, "useSpecularWorkflow", intake)
    values["specular_workflow"] = workflow == 1
    for name, idle in UNUSED.items():
        found = shader.GetInput(name)
        if found and (found.HasConnectedSource() or (idle is not None and found.Get(intake.time) not in (None, idle))):
            intake.note(path, f"inputs:{name} is not used")
    return Surface(MaterialData(**values, textures=textures), tuple(primvars))


def _weight(shader: UsdShade.Shader, parameter: _Parameter, intake: Intake) -> float:
    if not parameter.weight:
        return 1.0
    found = value_of(shader, parameter.weight, intake)
    if found is None:
        return parameter.weight_default
    return float(np.clip(np.nan_to_num(float(found)), 0.0, None))


def _evaluate(shader: UsdShade.Shader, parameter: _Parameter, intake: Intake):
    """What drives an input: a constant, a `_PrimvarInput`, or (TextureRef, fallback value)."""
    path, name = shader.GetPath(), parameter.name
    node, input_name, channel = shader, name, ""
    for _ in range(NODE_HOPS_MAX):
        found = node.GetInput(input_name)
        sources = UsdShade.Utils.GetValueProducingAttributes(found) if found else ()
        if not sources:
            return parameter.default
        attribute = sources[0]
        if not UsdShade.Output.IsOutput(attribute):
            return _constant(attribute.Get(intake.time), path, parameter, intake)
        node = UsdShade.Shader(attribute.GetPrim())
        identifier = (node.GetIdAttr().Get() if node else None) or ""
        output = UsdShade.Output(attribute).GetBaseName()
        if is_texture(identifier):
            texture, fallback = read_texture(node, channel or output, parameter.width, intake)
            value = parameter.default
            if fallback is not None:
                first = EXTRACTED.index(channel or output) if (channel or output) in EXTRACTED else 0
                value = _fitted(fallback[:3] if parameter.width == 3 else fallback[first : first + 1], parameter)
            return value if texture is None else (texture, value)
        if identifier.startswith(("UsdPrimvarReader", "ND_UsdPrimvarReader", "ND_geompropvalue", "ND_geomcolor")):
            key = "geomprop" if "geompropvalue" in identifier else "varname"
            default = "default" if identifier.startswith("ND_geom") else "fallback"
            fallback = value_of(node, default, intake)
            fallback = parameter.default if fallback is None else _constant(fallback, path, parameter, intake)
            primvar = "displayColor" if "geomcolor" in identifier else value_of(node, key, intake)
            return _PrimvarInput(parameter, str(primvar), fallback) if primvar else fallback
        if identifier.startswith("ND_constant_"):
            input_name = "value"
        elif identifier.startswith(PASS_THROUGH):
            input_name = "in"
        elif identifier.startswith("ND_extract_"):
            channel = EXTRACTED[int(value_of(node, "index", intake) or 0) % 4]
            input_name = "in"
        else:
            break
    intake.note(path, f"inputs:{name}: driven by {identifier or 'an unknown node'}; its default is used")
    return parameter.default


def _constant(value, path, parameter: _Parameter, intake: Intake):
    if value is None:
        return parameter.default
    array = np.asarray(value)
    array = array.astype(np.float64).reshape(-1) if array.dtype.kind in "fiu" else np.zeros(0)
    if len(array) not in (1, 3) or not np.isfinite(array).all():
        intake.bad(
            path,
            f"inputs:{parameter.name}: got {value}, expected {parameter.width} finite number(s); its default is used",
        )
        return parameter.default
    fitted = _fitted(array, parameter)
    if not np.allclose(fitted, array.mean() if parameter.width == 1 else array, rtol=0.0, atol=1e-12):
        intake.note(path, f"inputs:{parameter.name}: got {value}, used as {fitted}")
    return fitted


def _fitted(array: np.ndarray, parameter: _Parameter):
    """A value clipped to the parameter's range, as a float or three; a colour for a number is its mean."""
    clipped = np.clip(np.nan_to_num(array), 0.0, parameter.high)
    if parameter.width == 1:
        return float(clipped.mean())
    return tuple(float(v) for v in np.broadcast_to(clipped, (3,)))
