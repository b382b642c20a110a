"""Bound materials to `MaterialData`: UsdPreviewSurface, the common MaterialX surfaces, displayColor."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
from pxr import Sdf, Tf, UsdShade

from warp_reflect.scene import MaterialData, TextureRef
from warp_reflect.stage.intake import Intake, library_message
from warp_reflect.stage.materialx import referenced_material
from warp_reflect.stage.networks import LETTERS, Signal, Unmapped, constant, evaluate, picked, product, widened
from warp_reflect.stage.primvars import display_color, read_primvar
from warp_reflect.stage.textures import ENCODED_NORMAL, read_texture, scaled, value_of

# Fields of MaterialData whose textures shade.py looks up, and what else a texture decides.
SHADED_TEXTURES = (
    "base_color",
    "emissive",
    "specular_color",
    "metallic",
    "roughness",
    "clearcoat",
    "clearcoat_roughness",
)
NORMAL = "normal"


@dataclass(frozen=True)
class _Parameter:
    """Input `name` of a surface node sets `field` of MaterialData, times the input `weight`."""

    name: str
    field: str
    default: float | tuple[float, float, float]
    high: float = np.inf
    low: float = 0.0
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
    _Parameter("ior", "ior", 1.5, low=1.0),
)
_STANDARD = (
    _Parameter("base_color", "base_color", _GREY, weight="base"),
    _Parameter("emission_color", "emissive", _WHITE, weight="emission", weight_default=0.0),
    _Parameter("metalness", "metallic", 0.0, 1.0),
    _Parameter("specular_roughness", "roughness", 0.2, 1.0),
    _Parameter("coat", "clearcoat", 0.0, 1.0),
    _Parameter("coat_roughness", "clearcoat_roughness", 0.1, 1.0),
    _Parameter("opacity", "opacity", 1.0, 1.0),
    _Parameter("specular_IOR", "ior", 1.5, low=1.0),
    _Parameter("transmission", "transmission", 0.0, 1.0),
)
_OPEN_PBR = (
    _Parameter("base_color", "base_color", _GREY, weight="base_weight"),
    _Parameter("emission_color", "emissive", _WHITE, weight="emission_luminance", weight_default=0.0),
    _Parameter("base_metalness", "metallic", 0.0, 1.0),
    _Parameter("specular_roughness", "roughness", 0.3, 1.0),
    _Parameter("coat_weight", "clearcoat", 0.0, 1.0),
    _Parameter("coat_roughness", "clearcoat_roughness", 0.0, 1.0),
    _Parameter("geometry_opacity", "opacity", 1.0, 1.0),
    _Parameter("specular_ior", "ior", 1.5, low=1.0),
    _Parameter("transmission_weight", "transmission", 0.0, 1.0),
)
SURFACES = {
    "UsdPreviewSurface": _PREVIEW,
    "ND_UsdPreviewSurface_surfaceshader": _PREVIEW,
    "ND_standard_surface_surfaceshader": _STANDARD,
    "ND_open_pbr_surface_surfaceshader": _OPEN_PBR,
}
NORMAL_INPUTS = ("normal", "geometry_normal")
# Inputs that change the picture and are not simulated: noted where they are driven, or not this value.
UNUSED_PREVIEW = {"displacement": 0.0}
UNUSED = {
    "specular": 1.0,
    "specular_weight": 1.0,
    "subsurface": 0.0,
    "subsurface_weight": 0.0,
    "sheen": 0.0,
    "fuzz_weight": 0.0,
    "thin_film_thickness": 0.0,
    "thin_film_weight": 0.0,
    "coat_normal": None,
    "geometry_coat_normal": None,
}


@dataclass(frozen=True)
class _PrimvarInput:
    """A parameter that a primvar of the drawn prim sets, by `signal`."""

    parameter: _Parameter
    signal: Signal
    fallback: float | tuple[float, ...]

    @property
    def primvar(self) -> str:
        return self.signal.primvar

    @property
    def is_plain(self) -> bool:
        """Whether the value is the primvar's own."""
        signal = widened(self.signal, self.parameter.width)
        plain = signal.components == tuple(range(signal.width))
        return plain and bool((signal.scale == 1.0).all() and (signal.bias == 0.0).all())


@dataclass(frozen=True)
class Surface:
    """A material as read: its constants and textures, and what each drawn prim's primvars set."""

    data: MaterialData
    primvars: tuple[_PrimvarInput, ...] = ()

    @property
    def color_primvar(self) -> str:
        """The primvar that sets the base colour; empty: none does."""
        found = (p for p in self.primvars if p.parameter.field == "base_color" and p.is_plain)
        return next((p.primvar for p in found), "")

    @property
    def uv_primvars(self) -> list[str]:
        """The primvars its textures are looked up with, each once."""
        return list(dict.fromkeys(texture.uv_name for texture in self.data.textures.values()))


@dataclass
class MaterialTable:
    """The materials of one reading, each once; hands out indices into `materials`."""

    intake: Intake
    materials: list[MaterialData] = field(default_factory=list)
    _surfaces: dict = field(default_factory=dict)  # by material prim, or by path where there is no prim
    _bound: dict = field(default_factory=dict)  # by path of what they are bound to
    _index: dict = field(default_factory=dict)

    def bound(self, target) -> Surface | None:
        """The material bound to a prim or GeomSubset; None where there is none that is understood."""
        path = target.GetPath()
        if path not in self._bound:
            self._bound[path] = self._find(target)
        return self._bound[path]

    def _find(self, target) -> Surface | None:
        binding = UsdShade.MaterialBindingAPI(target)
        try:
            material, relationship = binding.ComputeBoundMaterial(UsdShade.Tokens.full)
        except Tf.ErrorException as fault:
            self.intake.bad(target.GetPath(), f"material:binding: {library_message(fault)}; not used")
            return None
        if not material and relationship:
            path = next(iter(relationship.GetTargets()), None)
            other, told = referenced_material(target.GetStage(), path, self.intake) if path else (None, False)
            if other:
                if path not in self._surfaces:
                    self._surfaces[path] = read_material(other, self.intake, str(path))
                return self._surfaces[path]
            if told:
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
        key = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
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
            if each.parameter.field == "base_color" and has_colors and each.is_plain:
                data = dataclasses.replace(data, uses_vertex_color=True)
                values.append(True)
                continue
            value = self._primvar_value(prim, each)
            values.append(value)
            data = dataclasses.replace(data, **{each.parameter.field: value})
        return self._add(data, (id(surface), *values))

    def _primvar_value(self, prim, each: _PrimvarInput):
        signal = each.signal
        width = max(each.parameter.width if each.is_plain else signal.width, max(signal.components) + 1)
        found = read_primvar(prim, each.primvar, width, self.intake)
        if found is None:
            return each.fallback
        values = found.flat()
        if found.interpolation != "constant" and np.ptp(values, axis=0).any():
            self.intake.note(prim.GetPath(), f"primvars:{each.primvar}: its mean is used for {each.parameter.name}")
            values = values.mean(axis=0, keepdims=True)
        result = signal.scale * values[0][list(signal.components)] + signal.bias
        return _fitted(result[: each.parameter.width], each.parameter)

    def _add(self, data: MaterialData, key: tuple) -> int:
        if key not in self._index:
            self._index[key] = len(self.materials)
            self.materials.append(data)
        return self._index[key]


def read_material(material: UsdShade.Material, intake: Intake, name: str = "") -> Surface | None:
    """A UsdShade material; None (with a note) where no surface of it is understood.

    Args:
        material: The material.
        intake: The reading.
        name: What to call it; empty: its path.
    """
    path = Sdf.Path(name) if name else material.GetPath()
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
        return None
    # A Material that is a reference to one in a .mtlx file, which the library could not compose.
    other, told = referenced_material(material.GetPrim().GetStage(), path, intake)
    if other:
        return read_material(other, intake, str(path))
    if not told:
        intake.note(path, "outputs:surface: no surface shader; displayColor is used")
    return None


def _read_surface(shader: UsdShade.Shader, parameters, path: str, intake: Intake) -> Surface:
    values: dict = {"path": path}
    textures: dict[str, TextureRef] = {}
    primvars: list[_PrimvarInput] = []
    for parameter in parameters:
        value = _driven(shader, parameter, intake)
        if isinstance(value, _PrimvarInput):
            primvars.append(value)
            value = value.fallback
        if isinstance(value, tuple) and isinstance(value[0], TextureRef):
            textures[parameter.field], value = value
        values[parameter.field] = value
    normal = _read_normal(shader, intake)
    if normal is not None:
        textures[NORMAL] = normal
    values["specular_workflow"] = value_of(shader, "useSpecularWorkflow", intake) == 1
    _read_opacity(shader, values, textures, primvars, path, intake)
    unshaded = sorted(set(textures) - {*SHADED_TEXTURES, NORMAL, "opacity"})
    if unshaded:
        intake.note(path, f"textures of {', '.join(unshaded)} are read but not shaded; constants are used")
    unused = UNUSED_PREVIEW if parameters is _PREVIEW else UNUSED
    for name, idle in unused.items():
        found = shader.GetInput(name)
        if found and (found.HasConnectedSource() or (idle is not None and found.Get(intake.time) not in (None, idle))):
            intake.note(path, f"inputs:{name} is not used")
    return Surface(MaterialData(**values, textures=textures), tuple(primvars))


def _read_opacity(shader, values: dict, textures: dict, primvars: list, path: str, intake: Intake) -> None:
    """Opacity by the rules of UsdPreviewSurface; of a picture there is none but what a threshold cuts out of it.

    Without a threshold and in the mode "transparent", the default, what is not opaque lets light through and still mirrors, as
    glass does; otherwise, and in MaterialX, that share of the surface is not there.
    """
    threshold = value_of(shader, "opacityThreshold", intake)
    threshold = float(threshold) if isinstance(threshold, (int, float)) and np.isfinite(threshold) else 0.0
    if "opacity" in textures:
        values["opacity"] = 1.0
        if threshold > 0.0:
            values["opacity_threshold"] = threshold
            return
        del textures["opacity"]
        intake.note(path, "inputs:opacity: a texture's opacity without opacityThreshold is not simulated; drawn opaque")
    elif any(each.parameter.field == "opacity" for each in primvars):
        return
    elif threshold > 0.0:
        values["opacity"] = float(values["opacity"] >= threshold)
    elif "transmission" not in values and value_of(shader, "opacityMode", intake) in (None, "transparent"):
        values["transmission"], values["opacity"] = 1.0 - values["opacity"], 1.0


def _read_normal(shader: UsdShade.Shader, intake: Intake) -> TextureRef | None:
    """The normal map of a surface; None where it has none that can be used, with a note if it meant to."""
    path = shader.GetPath()
    preview = "UsdPreviewSurface" in str(shader.GetIdAttr().Get())
    for name in NORMAL_INPUTS:
        try:
            signal = evaluate(shader, name, intake)
            if signal is None or signal.is_constant:
                continue  # one normal for a whole surface says nothing in tangent space
            if signal.primvar or signal.width < 3 or not (preview or signal.tangent):
                raise Unmapped("driven by what is no tangent space picture")
        except Unmapped as fault:
            intake.note(path, f"inputs:{name}: {fault}; the surface's own normal is used")
            continue
        texture, _ = _texture(widened(signal, 3), "normal", intake)
        if texture is not None and preview and texture.scale[:3] == (1.0,) * 3 and texture.bias[:3] == (0.0,) * 3:
            scale, bias = ENCODED_NORMAL
            intake.note(
                signal.picture.GetPath(),
                f"scale and bias are 1 and 0: right for directions stored as they are; one in 8 bits needs {scale:g} "
                f"and {bias:g}",
            )
        return texture
    return None


def _driven(shader: UsdShade.Shader, parameter: _Parameter, intake: Intake):
    """What sets a parameter: a constant, a `_PrimvarInput`, or (TextureRef, fallback value)."""
    path, name = shader.GetPath(), parameter.name
    try:
        signal = evaluate(shader, name, intake)
        weight = evaluate(shader, parameter.weight, intake) if parameter.weight else None
    except Unmapped as fault:
        text = str(fault)
        if text.startswith("got "):
            intake.bad(path, f"inputs:{name}: {text}; its default is used")
        else:
            intake.note(path, f"inputs:{name}: {text}; its default is used")
        return parameter.default
    if parameter.weight:
        weight = constant(parameter.weight_default) if weight is None else weight
        if weight.is_constant:
            weight = constant(np.clip(np.nan_to_num(weight.bias), 0.0, None))
        signal = product(constant(parameter.default) if signal is None else signal, weight)
    if signal is None:
        return parameter.default
    for note in signal.notes:
        intake.note(path, f"inputs:{name}: {note}")
    if signal.is_constant:
        return _constant(signal.bias, path, parameter, intake)
    if signal.primvar:
        fallback = parameter.default
        if signal.fallback is not None:
            wide = signal.scale * signal.fallback[list(signal.components)] + signal.bias
            fallback = _constant(wide[: parameter.width], path, parameter, intake)
        return _PrimvarInput(parameter, signal, fallback)
    if parameter.width == 1 and signal.width > 1:
        signal = picked(signal, [0])
    texture, value = _texture(widened(signal, parameter.width), "color" if parameter.width == 3 else "data", intake)
    value = parameter.default if value is None else _fitted(value, parameter)
    return value if texture is None else (texture, value)


def _texture(signal: Signal, use: str, intake: Intake):
    """(TextureRef or None, fallback float64 [1 or 3] or None) of a signal whose source is a picture."""
    letters = "".join(LETTERS[k] for k in signal.components)
    same = len(set(letters)) == 1 and np.ptp(signal.scale) == 0.0 and np.ptp(signal.bias) == 0.0
    if same:
        letters = letters[0]
    texture, fallback = read_texture(signal.picture, letters, use, intake)
    if fallback is not None:
        fallback = signal.scale * fallback[list(signal.components)] + signal.bias
    if texture is not None and ((signal.scale != 1.0).any() or (signal.bias != 0.0).any()):
        kept = slice(0, 1) if same else slice(None)
        texture = scaled(texture, signal.scale[kept], signal.bias[kept])
    return texture, fallback


def _constant(array: np.ndarray, path, parameter: _Parameter, intake: Intake):
    got = array[0] if len(array) == 1 else tuple(array.tolist())
    if len(array) not in (1, 3) or not np.isfinite(array).all():
        intake.bad(
            path,
            f"inputs:{parameter.name}: got {got}, expected {parameter.width} finite number(s); its default is used",
        )
        return parameter.default
    fitted = _fitted(array, parameter)
    if not np.allclose(fitted, array.mean() if parameter.width == 1 else array, rtol=0.0, atol=1e-12):
        intake.note(path, f"inputs:{parameter.name}: got {got}, used as {fitted}")
    return fitted


def _fitted(array: np.ndarray, parameter: _Parameter):
    """A value clipped to the parameter's range, as a float or three; a colour for a number is its mean."""
    clipped = np.clip(np.nan_to_num(array), parameter.low, parameter.high)
    if parameter.width == 1:
        return float(clipped.mean())
    return tuple(float(v) for v in np.broadcast_to(clipped, (3,)))
