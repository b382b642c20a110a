"""RenderSettings, RenderProduct and RenderVar prims: size, camera, names and channels that a stage asks for.

usd-core has no `UsdRenderComputeSpec` in Python; its rule is applied here by hand: what is authored on a product stands
over its settings.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pxr import Sdf, Tf, Usd, UsdRender

from warp_reflect.channels import own_name
from warp_reflect.scene import Note
from warp_reflect.stage.guard import Limits
from warp_reflect.stage.intake import library_message
from warp_reflect.stage.read import open_stage, quiet

METADATA = "renderSettingsPrimPath"
SCOPE = "/Render"  # where UsdRender keeps such prims; what relative paths are relative to
WRITTEN = (".exr", ".png")
# Attributes that say something a frame here does not follow, with the value at which that makes no difference.
UNUSED = {
    "pixelAspectRatio": 1.0,
    "aspectRatioConformPolicy": "expandAperture",
    "dataWindowNDC": (0.0, 0.0, 1.0, 1.0),
    "disableMotionBlur": True,
    "disableDepthOfField": True,
}


@dataclass(frozen=True)
class RenderSpec:
    """What a stage asks for.

    Attributes:
        path: Of the RenderSettings prim.
        resolution: (width, height), or None where nothing is authored. [pixels]
        camera: Path, or empty.
        outputs: Names of its products that can be written.
        channels: Of all their RenderVars, by our names; empty: not said.
        notes: What is asked for and not followed.
    """

    path: str
    resolution: tuple[int, int] | None
    camera: str
    outputs: tuple[str, ...]
    channels: tuple[str, ...]
    notes: tuple[Note, ...]


def read_render_settings(path: str | Path, prim: str | None = None, root: str = "") -> RenderSpec | None:
    """The render settings of a stage.

    Args:
        path: The stage.
        prim: Path of a RenderSettings prim, absolute or below /Render; None: what the stage's metadata
            `renderSettingsPrimPath` names.
        root: Folder that layers must lie in; empty: anywhere.

    Returns:
        None where `prim` is None and the stage names none, or cannot be read: whoever reads the scene says why.

    Raises:
        ValueError: no such prim; the text lists those there are.
    """
    named = prim if prim is not None else _named_by_stage(str(path))
    if not named:
        return None
    stage = open_stage(str(path), Limits(root=root))
    wanted = named if named.startswith("/") else f"{SCOPE}/{named}"
    found = stage.GetPrimAtPath(wanted) if Sdf.Path.IsValidPathString(wanted) else None
    if not found or not found.IsA(UsdRender.Settings):
        known = [str(each.GetPath()) for each in stage.Traverse() if each.IsA(UsdRender.Settings)]
        where = "--render-settings" if prim is not None else f"{path}: {METADATA}"
        raise ValueError(f"{where}: no RenderSettings prim at '{wanted}'; the stage has {', '.join(known) or 'none'}")
    with quiet():
        return _spec(stage, UsdRender.Settings(found))


def _named_by_stage(path: str) -> str:
    with quiet():
        try:
            layer = Sdf.Layer.FindOrOpen(path)
            return str(layer.pseudoRoot.GetInfo(METADATA)) if layer and layer.pseudoRoot.HasInfo(METADATA) else ""
        except Tf.ErrorException as fault:
            library_message(fault)  # reading the scene meets it again, and tells it
            return ""


def _spec(stage: Usd.Stage, settings: UsdRender.Settings) -> RenderSpec:
    notes: list[Note] = []
    products = []
    for target in settings.GetProductsRel().GetForwardedTargets():
        product = UsdRender.Product(stage.GetPrimAtPath(target))
        kind = product.GetProductTypeAttr().Get() if product else None
        name = str(product.GetProductNameAttr().Get() or "") if product else ""
        if kind != "raster":
            notes.append(Note(str(target), f"a product of type {kind or 'none'} is not rendered"))
        elif name and Path(name).suffix.lower() not in WRITTEN:
            notes.append(Note(str(target), f"productName '{name}' is not written; {' and '.join(WRITTEN)} are"))
        else:
            products.append((product, name))
    views = [_view(settings, product, notes) for product, _ in products] or [_view(settings, None, notes)]
    for (product, _), view in zip(products, views, strict=False):
        if view != views[0]:
            notes.append(
                Note(str(product.GetPath()), "another camera or resolution than the first product's is not used")
            )
    channels: dict[str, None] = {}
    for product, _ in products:
        for target in product.GetOrderedVarsRel().GetForwardedTargets():
            channels |= dict.fromkeys(_channels(stage, target, notes))
    resolution, camera = views[0]
    outputs = tuple(dict.fromkeys(name for _, name in products if name))
    return RenderSpec(
        str(settings.GetPath()), resolution, camera, outputs, tuple(channels), tuple(dict.fromkeys(notes))
    )


def _view(settings: UsdRender.Settings, product, notes: list[Note]) -> tuple[tuple[int, int] | None, str]:
    """(resolution, camera) of a product: its own where authored, else its settings'."""
    layered = [each for each in (product, settings) if each]
    for each in layered:
        for name, harmless in UNUSED.items():
            attribute = each.GetPrim().GetAttribute(name)
            value = attribute.Get() if attribute and attribute.HasAuthoredValue() else harmless
            if (tuple(value) if name == "dataWindowNDC" else value) != harmless:
                notes.append(Note(str(each.GetPath()), f"{name} = {value} is not followed"))
    sizes = [each.GetResolutionAttr() for each in layered]
    size = next((tuple(map(int, each.Get())) for each in sizes if each.HasAuthoredValue()), None)
    if size is not None and min(size) < 1:
        notes.append(Note(str(settings.GetPath()), f"resolution {size[0]}x{size[1]} is not used"))
        size = None
    cameras = [each.GetCameraRel().GetForwardedTargets() for each in layered]
    return size, next((str(targets[0]) for targets in cameras if targets), "")


def _channels(stage: Usd.Stage, target: Sdf.Path, notes: list[Note]) -> list[str]:
    var = UsdRender.Var(stage.GetPrimAtPath(target))
    if not var:
        notes.append(Note(str(target), "no such RenderVar"))
        return []
    for name in (str(var.GetSourceNameAttr().Get() or ""), target.name):
        try:
            return [own_name(name)]
        except KeyError:
            continue
    notes.append(Note(str(target), f"no channel is called '{var.GetSourceNameAttr().Get() or target.name}'"))
    return []
