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
COLOR_SPACES = {"sRGB": "sRGB", "raw": "raw", "auto": "auto", "srgb_texture": "sRGB", "lin_rec709": "raw"}
CHANNELS = ("rgb", "r", "g", "b", "a")
PACKED_MAX = 512 * 2**20  # bytes of one picture inside a .usdz


def is_texture(identifier: str) -> bool:
    """Whether a node's identifier is one of a picture."""
    return identifier == "UsdUVTexture" or identifier.startswith(("ND_UsdUVTexture", "ND_image_", "ND_tiledimage_"))


def read_texture(node: UsdShade.Shader, output: str, width: int, intake: Intake):
    """A picture node.

    Args:
        node: UsdUVTexture, or MaterialX' image.
        output: Name of the output that is used.
        width: Components of the parameter it drives; 1 takes one channel, and raw values.
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
    channel = output if output in CHANNELS else "rgb"
    if width == 1 and channel == "rgb":
        channel = "r"
    space = value_of(node, "sourceColorSpace", intake) or attribute.GetColorSpace() or "auto"
    if width == 1 or channel == "a":
        space = "raw"  # data maps are often tagged sRGB by mistake
    uv_name, uv_from_st = _coordinates(node, coordinates, intake)
    if identifier.startswith("ND_tiledimage_"):
        tiling, offset = value_of(node, "uvtiling", intake), value_of(node, "uvoffset", intake)
        scale = np.diag([*_vector(tiling, (1.0, 1.0)), 1.0])
        scale[:2, 2] = -_vector(offset, (0.0, 0.0))
        uv_from_st = scale @ uv_from_st
    texture = TextureRef(
        file,
        channel,
        COLOR_SPACES.get(str(space), "auto"),
        tuple(WRAPS.get(str(value_of(node, name, intake)), "useMetadata") for name in (wrap_u, wrap_v)),
        tuple(_vector(value_of(node, "scale", intake), (1.0,) * 4).tolist()),
        tuple(_vector(value_of(node, "bias", intake), (0.0,) * 4).tolist()),
        uv_name,
        tuple(tuple(row) for row in uv_from_st[:2].tolist()),
    )
    if not np.isfinite([*texture.scale, *texture.bias, *uv_from_st.reshape(-1)]).all():
        intake.bad(path, "inputs:scale, inputs:bias: got a value that is not finite; its fallback is used")
        return None, fallback
    return texture, fallback


def scaled(texture: TextureRef, factor) -> TextureRef:
    """The texture times a constant: a number, or one per channel."""
    factor = np.ones(4) * np.append(factor, 1.0) if np.ndim(factor) else np.array([factor] * 3 + [1.0])
    scale, bias = np.array(texture.scale) * factor, np.array(texture.bias) * factor
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
    if "<UDIM>" in asset.path:
        intake.note(owner, f"{label}: a UDIM set is not used; its fallback is")
        return ""
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
            return str(value_of(node, key, intake) or "st"), affine
        if identifier not in ("UsdTransform2d", "ND_UsdTransform2d"):
            if not identifier.startswith("ND_texcoord"):
                intake.note(node.GetPath(), f"info:id: {identifier or None} as coordinates is not used; st is")
            return "st", affine
        angle = np.radians(float(value_of(node, "rotation", intake) or 0.0))
        scale = _vector(value_of(node, "scale", intake), (1.0, 1.0))
        step = np.eye(3)
        step[:2, :2] = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * scale
        step[:2, 2] = _vector(value_of(node, "translation", intake), (0.0, 0.0))
        affine, name = affine @ step, "in"
    return "st", affine


def _vector(value, default: tuple[float, ...]) -> np.ndarray:
    """A value as float64 of the default's length; a shorter one is filled up from the default."""
    if value is None:
        return np.array(default, np.float64)
    given = np.atleast_1d(np.array(value, np.float64))[: len(default)]
    if len(given) == 1 and len(default) > 1:
        given = np.repeat(given, min(3, len(default)))
    return np.concatenate([given, default[len(given) :]])
