"""Layers written over a stage: the stage itself is never touched.

A layer sublayers the stage by a relative path and carries the stage's own metadata, so that it opens as the stage does. It is
written under a passing name in its folder, synced and renamed.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdUtils, Vt

from warp_reflect.baked_environments import LAYOUT as ENVIRONMENT_LAYOUT
from warp_reflect.baked_maps import LAYOUT, BakedMap
from warp_reflect.stage.baked import GEOMETRY, LAYOUT_ATTRIBUTE, MAP, RESOLUTION, UNIT_FRAME
from warp_reflect.stage.guard import Limits
from warp_reflect.stage.intake import library_message
from warp_reflect.stage.read import open_stage, quiet
from warp_reflect.stage.schema import ENVIRONMENT_MAP_API

EXTENSIONS = (".usd", ".usda", ".usdc")
PROVENANCE = "warp_reflect"  # key in customLayerData
PLACED_SCOPE = "reference_environment_maps"  # of the prims of maps that were placed
MAP_NAME_MAX = 120  # characters of a map's file name that come from its prim path; file systems take 255 in all


def check_layer_writable(path: str | os.PathLike, stage_path: str | os.PathLike) -> Path:
    """Refuse, before any work is done, a layer that could not be written or would replace the stage.

    Raises:
        ValueError: an unknown extension, or the stage itself.
        OSError: the folder is missing or cannot be written, or the name is taken by something that is no file.
    """
    path = Path(path)
    if path.suffix.lower() not in EXTENSIONS:
        raise ValueError(f"{path}: cannot write a '{path.suffix}' layer; use {', '.join(EXTENSIONS)}")
    if path.resolve() == Path(stage_path).resolve():
        raise ValueError(f"{path}: is the stage itself; give another name")
    check_place(path)
    return path


def check_place(path: Path) -> None:
    """Refuse a file that could not be written.

    Raises:
        OSError: the folder is missing or cannot be written, or the name is taken by something that is no file.
    """
    if path.exists() and not path.is_file():
        raise OSError(f"{path}: cannot be written: it exists and is not a regular file")
    if not path.parent.is_dir():
        raise OSError(f"{path}: cannot be written: the folder '{path.parent}' does not exist; make it first")
    probe = passing_name(path)
    try:
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        os.unlink(probe)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None


def layer_over(stage: Usd.Stage, stage_path: str | os.PathLike, path: Path) -> Sdf.Layer:
    """An anonymous layer that opens as the stage does, to be saved as `path`.

    Raises:
        ValueError: `path` is one of the layers that the stage is made of.
    """
    for used in stage.GetUsedLayers():
        if used.realPath and Path(used.realPath).resolve() == path.resolve():
            raise ValueError(f"{path}: is a layer of {stage_path}; give another name")
    layer = Sdf.Layer.CreateAnonymous(".usda")
    UsdUtils.CopyLayerMetadata(stage.GetRootLayer(), layer, True)
    real = Path(stage_path).resolve()
    with contextlib.suppress(ValueError):  # another drive: there is no relative path
        relative = Path(os.path.relpath(real, path.resolve().parent)).as_posix()
        real = relative if relative.startswith("../") else f"./{relative}"
    layer.subLayerPaths.append(str(real))
    return layer


def save_layer(layer: Sdf.Layer, path: Path, usd_format: str = "usda") -> None:
    """Write a layer whole: text as .usda, binary as .usdc, and as .usd what is asked for ("usda" or "usdc").

    Raises:
        OSError: it could not be written; an older file under the name is still whole.
    """
    final = Path(os.path.realpath(path))
    part = passing_name(final)
    arguments = {"format": usd_format} if final.suffix.lower() == ".usd" else {}
    try:
        try:
            good = layer.Export(str(part), args=arguments)
        except Tf.ErrorException as fault:
            raise OSError(f"{path}: cannot be written: {library_message(fault)}") from None
        if not good:
            raise OSError(f"{path}: cannot be written: the USD library refused")
        with open(part, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, final)
    finally:
        part.unlink(missing_ok=True)


def passing_name(path: Path) -> Path:
    """The name in the same folder that a file has while it is written."""
    return path.with_name(f".{os.getpid()}-{path.stem[:60]}.part{path.suffix}")


# Baked maps.


@dataclass(frozen=True)
class BakedMirror:
    """The maps of one mirror, as a file beside the layer.

    Attributes:
        prim_path: The drawn prim, or its GeomSubset.
        file: The EXR.
        maps: What it holds.
    """

    prim_path: str
    file: Path
    maps: tuple[BakedMap, ...]


@dataclass(frozen=True)
class BakedEnvironment:
    """A reference environment map, as a file beside the layer.

    Attributes:
        prim_path: Of the prim that names its place.
        file: The EXR.
        world_from_map: Where a prim is to be made for it, float64 [4, 4]; None: there is one.
    """

    prim_path: str
    file: Path
    world_from_map: np.ndarray | None = None


def environment_path(stage: Usd.Stage, number: int) -> str:
    """A path for the prim of a map that was placed: below the stage's default prim, where nothing is yet."""
    root = stage.GetDefaultPrim()
    parent = (root.GetPath() if root else Sdf.Path.absoluteRootPath).AppendChild(PLACED_SCOPE)
    return str(parent.AppendChild(f"map_{number}"))


def map_file(path: Path, prim_path: str, taken: set[str]) -> Path:
    """Name of a mirror's EXR beside the layer `path`: LAYER.PRIM_PATH.exr; other than those taken, which it joins."""
    name = re.sub(r"\W+", "_", prim_path.strip("/"), flags=re.ASCII).strip("_")[-MAP_NAME_MAX:] or "mirror"
    unique, number = name, 1
    while unique.lower() in taken:  # file systems may not tell upper case from lower case
        number += 1
        unique = f"{name}_{number}"
    taken.add(unique.lower())
    return path.with_name(f"{path.stem}.{unique}.exr")


def bake_fault(stage: Usd.Stage, prim_path: str, instance: str) -> str:
    """Why a mirror cannot carry maps of its own; empty if it can."""
    if instance:
        return "drawn by a point instancer, whose instances carry no attributes"
    prim = stage.GetPrimAtPath(prim_path)
    if not prim:
        return "no prim of the stage"
    if prim.IsInstanceProxy() or prim.IsInPrototype():
        return "inside an instance, where no attribute can be authored"
    return ""


def write_baked_layer(
    stage_path: str | os.PathLike,
    path: str | os.PathLike,
    mirrors: Sequence[BakedMirror],
    environments: Sequence[BakedEnvironment],
    provenance: Mapping[str, object],
) -> None:
    """Write the layer that gives each mirror its maps, and each place of an environment map its own.

    Args:
        stage_path: What was baked.
        path: The layer; the maps' files lie in the same folder.
        mirrors, environments: May be empty.
        provenance: What is noted in the layer under `customLayerData["warp_reflect"]["bake"]`; str, int or float.

    Raises:
        ValueError: the stage cannot be read, or `path` is one of its layers.
        OSError: the layer could not be written.
    """
    path = Path(path)
    stage = open_source(stage_path)
    with quiet():
        layer = layer_over(stage, stage_path, path)
        known = dict(layer.customLayerData)
        own = known.get(PROVENANCE)
        known[PROVENANCE] = (dict(own) if isinstance(own, dict) else {}) | {"bake": dict(provenance)}
        layer.customLayerData = known
        for mirror in mirrors:
            prim = Sdf.CreatePrimInLayer(layer, mirror.prim_path)
            _author(prim, MAP, Sdf.ValueTypeNames.Asset, Sdf.AssetPath(f"./{mirror.file.name}"))
            _author(prim, LAYOUT_ATTRIBUTE, Sdf.ValueTypeNames.Token, LAYOUT)
            _author(prim, RESOLUTION, Sdf.ValueTypeNames.Int, mirror.maps[0].resolution)
            _author(prim, GEOMETRY, Sdf.ValueTypeNames.StringArray, Vt.StringArray([m.geometry for m in mirror.maps]))
            # USD's matrices act on rows.
            frames = [Gf.Matrix4d(*each.unit_from_body.T.reshape(-1).tolist()) for each in mirror.maps]
            _author(prim, UNIT_FRAME, Sdf.ValueTypeNames.Matrix4dArray, Vt.Matrix4dArray(frames))
        for each in environments:
            _author_environment(layer, each)
        save_layer(layer, path)


def _author_environment(layer: Sdf.Layer, baked: BakedEnvironment) -> None:
    prim = Sdf.CreatePrimInLayer(layer, baked.prim_path)
    if baked.world_from_map is not None:
        scope = prim.nameParent
        if scope.specifier != Sdf.SpecifierDef:
            scope.specifier, scope.typeName = Sdf.SpecifierDef, "Scope"
        prim.specifier, prim.typeName = Sdf.SpecifierDef, "Xform"
        schemas = Sdf.TokenListOp()
        schemas.prependedItems = [ENVIRONMENT_MAP_API]
        prim.SetInfo("apiSchemas", schemas)
        frame = Gf.Matrix4d(*baked.world_from_map.T.reshape(-1).tolist())
        spec = Sdf.AttributeSpec(prim, "xformOp:transform", Sdf.ValueTypeNames.Matrix4d)
        spec.default = frame
        order = Vt.TokenArray(["!resetXformStack!", "xformOp:transform"])
        _author(prim, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, order)
    # As the schema has it, the file may change in time.
    file = Sdf.AttributeSpec(prim, MAP, Sdf.ValueTypeNames.Asset)
    file.default = Sdf.AssetPath(f"./{baked.file.name}")
    _author(prim, LAYOUT_ATTRIBUTE, Sdf.ValueTypeNames.Token, ENVIRONMENT_LAYOUT)


def open_source(stage_path: str | os.PathLike) -> Usd.Stage:
    """The stage that a layer is written over, for what a `Scene` does not keep.

    Raises:
        FileNotFoundError, ValueError: as `read.open_stage`.
    """
    return open_stage(str(stage_path), Limits())


def _author(prim: Sdf.PrimSpec, name: str, kind, value) -> None:
    spec = Sdf.AttributeSpec(prim, name, kind, Sdf.VariabilityUniform)
    spec.default = value
