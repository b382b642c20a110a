"""Texture nodes of a material network to `TextureRef`: decisions only, no pixel is read here."""

from __future__ import annotations

import dataclasses
import shutil
import zipfile
from pathlib import Path

import numpy as np
from pxr import Sdf, UsdShade

from warp_reflect.scene import TextureRef
from warp_reflect.stage.guard import confinement_fault
from warp_reflect.stage.intake import Intake

# Nodes that hold a picture, with the names of their inputs: coordinates, wrap u, wrap v, fallback.
PREVIEW_INPUTS = ("st", "wrapS", "wrapT", "fallback")
MATERIALX_INPUTS = ("texcoord", "uaddressmode", "vaddressmode", "default")
WRAPS = {  # MaterialX's names on the right of ours
    "periodic": "repeat",
    "clamp": "clamp",
    "mirror": "mirror",
    "constant": "black",
    "repeat": "repeat",
    "black": "black",
    "useMetadata": "useMetadata",
}
# Names of UsdUVTexture's input, of MaterialX and of USD's colour space metadata.
COLOR_SPACES = {
    "auto": "auto",
    "sRGB": "sRGB",
    "srgb_texture": "sRGB",
    "srgb_rec709_scene": "sRGB",
    "g22_rec709": "sRGB",
    "g22_rec709_scene": "sRGB",
    "raw": "raw",
    "data": "raw",
    "none": "raw",
    "identity": "raw",
    "lin_rec709": "raw",
    "lin_rec709_scene": "raw",
}
PACKED_MAX = 512 * 2**20  # bytes of one picture inside a .usdz
TILE_MARK = "<UDIM>"
ENCODED_NORMAL = (2.0, -1.0)  # scale and bias that make a direction of an 8-bit normal map


def is_texture(identifier: str) -> bool:
    """Whether a node's identifier is one of a picture."""
    return identifier == "UsdUVTexture" or identifier.startswith(("ND_UsdUVTexture", "ND_image_", "ND_tiledimage_"))


def read_texture(node: UsdShade.Shader, channel: str, use: str, intake: Intake):
    """A picture node.

    Args:
        node: UsdUVTexture, or MaterialX' image.
        channel: As in `TextureRef`.
        use: "color", "data" (raw values whatever the node says) or "normal" (raw values with a sign).
        intake: The reading.

    Returns:
        (texture or None, fallback): None for the picture, with a note, where there is none to use; None for
        the fallback, float64 [4] red to alpha, where none is authored.
    """
    path = node.GetPath()
    identifier = node.GetIdAttr().Get()
    names = PREVIEW_INPUTS if "UsdUVTexture" in identifier else MATERIALX_INPUTS
    coordinates, wrap_u, wrap_v, fallback_name = names
    authored = value_of(node, fallback_name, intake)
    fallback = None if authored is None else _vector(authored, (0.0, 0.0, 0.0, 1.0))
    asset, attribute = _asset(node, intake)
    file = resolve_asset(asset, attribute, intake)
    if not file:
        return None, fallback
    uv_name, uv_from_st = _coordinates(node, coordinates, intake)
    if identifier.startswith("ND_tiledimage_"):
        tiling, offset = value_of(node, "uvtiling", intake), value_of(node, "uvoffset", intake)
        scale = np.diag([*_vector(tiling, (1.0, 1.0)), 1.0])
        scale[:2, 2] = -_vector(offset, (0.0, 0.0))
        uv_from_st = scale @ uv_from_st
    scale = _vector(value_of(node, "scale", intake), (1.0,) * 4)
    bias = _vector(value_of(node, "bias", intake), (0.0,) * 4)
    if not np.isfinite([*scale, *bias, *uv_from_st.reshape(-1)]).all():
        intake.bad(path, "inputs:scale, inputs:bias: got a value that is not finite; its fallback is used")
        return None, fallback
    chosen = ["rgba".index(letter) for letter in channel]
    if len(chosen) == 3:  # the scale of a mixed order belongs to the result's components
        scale, bias = np.append(scale[chosen], 1.0), np.append(bias[chosen], 0.0)
    texture = TextureRef(
        file,
        channel,
        _color_space(node, attribute, channel, use, intake),
        tuple(WRAPS.get(str(value_of(node, name, intake)), "useMetadata") for name in (wrap_u, wrap_v)),
        tuple(scale.tolist()),
        tuple(bias.tolist()),
        uv_name,
        tuple(tuple(row) for row in uv_from_st[:2].tolist()),
    )
    return texture, fallback


def _color_space(node: UsdShade.Shader, attribute, channel: str, use: str, intake: Intake) -> str:
    tag = str(value_of(node, "sourceColorSpace", intake) or attribute.GetColorSpace() or "auto")
    space = COLOR_SPACES.get(tag)
    if use == "color" and channel != "a":
        if space is None:
            intake.note(node.GetPath(), f"color space: got {tag}, which is not known; auto is used")
        return space or "auto"
    if space == "sRGB" and channel != "a":
        # One picture often holds colour for one node and numbers for another, and both get the same tag.
        intake.note(node.GetPath(), f"color space: got {tag} on values that are no colour; they are read raw")
    return "signed" if use == "normal" else "raw"


def scaled(texture: TextureRef, factor, offset=0.0) -> TextureRef:
    """The texture times a factor plus an offset, each a number or one per component of the result."""
    slots = [0, 1, 2] if len(texture.channel) == 3 else ["rgba".index(texture.channel)]
    scale, bias = np.array(texture.scale), np.array(texture.bias)
    scale[slots] *= factor
    bias[slots] = bias[slots] * factor + offset
    return dataclasses.replace(texture, scale=tuple(scale.tolist()), bias=tuple(bias.tolist()))


def value_of(node: UsdShade.Shader, name: str, intake: Intake):
    """The value at the end of an input's connections; None where it is unauthored or computed."""
    found = node.GetInput(name)
    if not found:
        return None
    for attribute in UsdShade.Utils.GetValueProducingAttributes(found):
        if not UsdShade.Output.IsOutput(attribute):
            return attribute.Get(intake.time)
    return None


def resolve_asset(asset, attribute, intake: Intake) -> str:
    """The file of an asset path; "" with a note where there is none to use."""
    if not isinstance(asset, Sdf.AssetPath) or not asset.path:
        return ""
    owner = attribute.GetPrim().GetPath()
    label = f"{attribute.GetName()}: @{asset.path}@"
    if TILE_MARK in asset.path:
        return _resolve_tiles(asset.path.replace("\\", "/"), attribute, label, intake)
    file = asset.resolvedPath
    if not file and "\\" in asset.path:
        layer = attribute.GetPropertyStack(intake.time)[0].layer
        candidate = layer.ComputeAbsolutePath(asset.path.replace("\\", "/"))
        file = candidate if Path(candidate).is_file() else ""
    if not file:
        intake.note(owner, f"{label}: no such file; its fallback is used")
        return ""
    fault = confinement_fault(file, intake.limits.root)
    if fault:
        intake.bad(owner, f"{label}: {fault}; its fallback is used")
        return ""
    return file


def _resolve_tiles(path: str, attribute, label: str, intake: Intake) -> str:
    """The pattern of a UDIM set's files, absolute; "" with a note where it has none."""
    owner = attribute.GetPrim().GetPath()
    layer = attribute.GetPropertyStack(intake.time)[0].layer
    tiles = UsdShade.UdimUtils.ResolveUdimTilePaths(path, layer)
    if not tiles:
        intake.note(owner, f"{label}: no tile of this set was found; its fallback is used")
        return ""
    for file, _ in tiles:
        fault = confinement_fault(file, intake.limits.root)
        if fault:
            intake.bad(owner, f"{label}: {fault}; its fallback is used")
            return ""
    first, number = tiles[0]
    stem, _, ending = first.rpartition(number)
    return f"{stem}{TILE_MARK}{ending}"


def unpacked(file: str, folder: str | Path) -> Path:
    """A readable file for a resolved asset: itself, or a copy in `folder` of what is packed in a .usdz.

    Raises:
        ValueError: the package does not hold it, compressed or too large.
    """
    if not file.endswith("]") or "[" not in file:
        return Path(file)
    package, _, inside = file[:-1].partition("[")
    if "[" in inside:
        raise ValueError(f"{file}: a package in a package is not read")
    try:
        with zipfile.ZipFile(package) as archive:
            entry = archive.getinfo(inside)
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > PACKED_MAX:
                raise ValueError(f"{file}: compressed or larger than {PACKED_MAX} bytes")
            target = Path(folder) / f"{entry.header_offset}{Path(inside).suffix}"
            with archive.open(entry) as source, target.open("wb") as copy:
                shutil.copyfileobj(source, copy)
    except (OSError, KeyError, zipfile.BadZipFile) as fault:
        raise ValueError(f"{file}: cannot be unpacked ({fault})") from None
    return target


def _asset(node: UsdShade.Shader, intake: Intake):
    """(asset path, the attribute that holds it) of a picture node; (None, None) without one."""
    found = node.GetInput("file")
    for attribute in UsdShade.Utils.GetValueProducingAttributes(found) if found else ():
        if not UsdShade.Output.IsOutput(attribute):
            return attribute.Get(intake.time), attribute
    intake.note(node.GetPath(), "inputs:file: no value; its fallback is used")
    return None, None


def _coordinates(node: UsdShade.Shader, name: str, intake: Intake) -> tuple[str, np.ndarray]:
    """(primvar name, affine map float64 [3, 3]) behind a picture's coordinates."""
    affine = np.eye(3)
    for _ in range(16):  # transforms in a chain; a cycle ends here
        found = node.GetInput(name)
        sources = UsdShade.Utils.GetValueProducingAttributes(found) if found else ()
        if not sources or not UsdShade.Output.IsOutput(sources[0]):
            return "st", affine
        node = UsdShade.Shader(sources[0].GetPrim())
        identifier = (node.GetIdAttr().Get() if node else None) or ""
        if identifier.startswith(("UsdPrimvarReader", "ND_UsdPrimvarReader", "ND_geompropvalue")):
            key = "geomprop" if "geomprop" in identifier else "varname"
            primvar = str(value_of(node, key, intake) or "st")
            return ("st" if primvar == "UV0" else primvar), affine  # MaterialX' name of the first set
        kind = identifier.removeprefix("ND_").partition("_")[0]
        if kind not in _STEPS:
            if kind != "texcoord":
                intake.note(node.GetPath(), f"info:id: {identifier or None} as coordinates is not used; st is")
            return "st", affine
        step, name = _STEPS[kind](node, intake)
        if step is None or not np.isfinite(step).all():
            intake.note(node.GetPath(), f"info:id: {identifier} of two sets of coordinates is not used; st is")
            return "st", affine
        affine = affine @ step
    return "st", affine


def _turn(degrees: float, clockwise: bool = False) -> np.ndarray:
    angle = np.radians(-degrees if clockwise else degrees)
    return np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])


def _shift(x: float, y: float) -> np.ndarray:
    return np.array([[1.0, 0.0, x], [0.0, 1.0, y], [0.0, 0.0, 1.0]])


def _step_transform(node: UsdShade.Shader, intake: Intake):
    """UsdTransform2d: scaled, then turned, then moved."""
    turn = _turn(float(value_of(node, "rotation", intake) or 0.0))
    scale = _vector(value_of(node, "scale", intake), (1.0, 1.0))
    return _shift(*_vector(value_of(node, "translation", intake), (0.0, 0.0))) @ turn @ np.diag([*scale, 1.0]), "in"


def _step_place(node: UsdShade.Shader, intake: Intake):
    """MaterialX' place2d: about a pivot divided by the scale, turned, the offset taken; or the other way round."""
    pivot = _vector(value_of(node, "pivot", intake), (0.0, 0.0))
    with np.errstate(divide="ignore"):
        shrink = np.diag([*(1.0 / _vector(value_of(node, "scale", intake), (1.0, 1.0))), 1.0])
    # MaterialX' rotate2d turns by (c x + s y, -s x + c y).
    turn = _turn(float(value_of(node, "rotate", intake) or 0.0), clockwise=True)
    move = _shift(*-_vector(value_of(node, "offset", intake), (0.0, 0.0)))
    inner = shrink @ turn @ move if int(value_of(node, "operationorder", intake) or 0) == 1 else move @ turn @ shrink
    return _shift(*pivot) @ inner @ _shift(*-pivot), "texcoord"


def _step_rotate(node: UsdShade.Shader, intake: Intake):
    return _turn(float(value_of(node, "amount", intake) or 0.0), clockwise=True), "in"


def _step_arithmetic(node: UsdShade.Shader, intake: Intake):
    """A sum, difference, product or quotient with a constant; None for the step where there is none."""
    operation = node.GetIdAttr().Get().removeprefix("ND_").partition("_")[0]
    identity = 1.0 if operation in ("multiply", "divide") else 0.0
    name, other = "in1", value_of(node, "in2", intake)
    if operation in ("multiply", "add") and value_of(node, "in1", intake) is not None:
        name, other = "in2", value_of(node, "in1", intake)
    elif other is None and node.GetInput("in2") and node.GetInput("in2").HasConnectedSource():
        return None, name
    values = _vector(other, (identity, identity))
    with np.errstate(divide="ignore"):
        if operation in ("multiply", "divide"):
            return np.diag([*(values if operation == "multiply" else 1.0 / values), 1.0]), name
    return _shift(*(values if operation == "add" else -values)), name


def _step_none(node: UsdShade.Shader, intake: Intake):
    return np.eye(3), "in"


_STEPS = {
    "UsdTransform2d": _step_transform,
    "place2d": _step_place,
    "rotate2d": _step_rotate,
    "multiply": _step_arithmetic,
    "divide": _step_arithmetic,
    "add": _step_arithmetic,
    "subtract": _step_arithmetic,
    "convert": _step_none,
    "dot": _step_none,
    "swizzle": _step_none,
}


def _vector(value, default: tuple[float, ...]) -> np.ndarray:
    """A value as float64 of the default's length; a shorter one is filled up from the default."""
    if value is None:
        return np.array(default, np.float64)
    given = np.atleast_1d(np.array(value, np.float64))[: len(default)]
    if len(given) == 1 and len(default) > 1:
        given = np.repeat(given, min(3, len(default)))
    return np.concatenate([given, default[len(given) :]])
