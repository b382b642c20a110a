"""`SceneData` to files and back, as numbers and text only: how a child process hands a stage over.

One file of raw arrays and one JSON tree that points into it. What comes back is checked as if it were hostile:
sizes, indices and finiteness.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from pathlib import Path

import numpy as np

from warp_reflect import scene
from warp_reflect.scene import SceneData

ARRAYS, TREE = "arrays.bin", "scene.json"
ALIGN = 64  # bytes; arrays start on a cache line
DTYPES = ("<f4", "<f8", "<i4")


def save(data: SceneData, folder: Path) -> None:
    """Write a scene into a folder."""
    with open(folder / ARRAYS, "wb") as file:
        tree = _encode(data, file)
    (folder / TREE).write_text(json.dumps(tree))


def load(folder: Path) -> SceneData:
    """Read a scene that `save` wrote.

    Raises:
        ValueError: it is damaged, or its numbers do not fit together.
    """
    try:
        tree = json.loads((folder / TREE).read_text())
        blob = np.fromfile(folder / ARRAYS, np.uint8)
        data = _decode(tree, SceneData, blob)
    except (OSError, KeyError, TypeError, IndexError, AttributeError) as fault:
        raise ValueError(f"the stage's reader gave a damaged answer ({type(fault).__name__}: {fault})") from None
    check(data)
    return data


def check(data: SceneData) -> None:
    """Raise `ValueError` where the numbers of a scene would lead outside an array, or are not finite."""
    for number, mesh in enumerate(data.meshes):
        triangles = mesh.triangles
        good = mesh.points.ndim == 2 and mesh.points.shape[1] == 3 and triangles.ndim == 2 and triangles.shape[1] == 3
        good = good and _within(triangles, len(mesh.points)) and bool(np.isfinite(mesh.points).all())
        for values, index, width in (
            (mesh.normals, mesh.normal_index, 3),
            (mesh.uvs, mesh.uv_index, 2),
            (mesh.colors, mesh.color_index, 3),
        ):
            if values is not None:
                index = triangles if index is None else index
                good = good and values.ndim == 2 and values.shape[1] == width and index.shape == triangles.shape
                good = good and _within(index, len(values)) and bool(np.isfinite(values).all())
        covered = 0
        for part in mesh.parts:
            good = good and part.first_triangle == covered and part.triangle_count > 0
            inner = part.first_triangle
            for patch in part.patches:
                good = good and patch.first_triangle == inner and patch.triangle_count > 0
                inner += patch.triangle_count
            covered += part.triangle_count
            good = good and (not part.patches or inner == covered)
        _require(good and (not mesh.parts or covered == len(triangles)), f"mesh {number}")
    for instance in data.instances:
        good = 0 <= instance.mesh < len(data.meshes) and instance.world_from_object.shape == (4, 4)
        good = good and bool(np.isfinite(instance.world_from_object).all())
        good = good and all(0 <= m < len(data.materials) for m in instance.materials)
        good = good and len(instance.materials) == max(len(data.meshes[instance.mesh].parts), 1)
        _require(good, f"instance {instance.prim_path}")
    for light in data.lights:
        good = light.world_from_light.shape == (4, 4) and bool(np.isfinite(light.world_from_light).all())
        if light.texture is not None:
            good = good and light.texture.ndim == 3 and light.texture.shape[2] == 3
        _require(good and bool(np.isfinite(light.color).all()), f"light {light.path}")
    for path, maps in data.baked_maps.items():
        _require(not any(each.fault() for each in maps), f"baked map of {path}")
    textured = any(material.textures for material in data.materials)
    _require(data.pictures is not None or not textured, "no pictures")  # this process is not to open them
    for key, picture in (data.pictures or {}).items():
        good = picture.dtype == np.float32 and picture.ndim == 3 and picture.shape[2] in (1, 3) and picture.size > 0
        _require(good and bool(np.isfinite(picture).all()), f"picture {key}")
    for camera in data.cameras:
        numbers = [camera.horizontal_aperture, camera.vertical_aperture, camera.focal_length, camera.near, camera.far]
        good = camera.world_from_camera.shape == (4, 4) and bool(np.isfinite(camera.world_from_camera).all())
        _require(good and bool(np.isfinite(numbers).all()) and min(numbers[:3]) > 0.0, f"camera {camera.path}")


def _within(index: np.ndarray, count: int) -> bool:
    return index.dtype.kind == "i" and (not index.size or (int(index.min()) >= 0 and int(index.max()) < count))


def _require(good: bool, what: str) -> None:
    if not good:
        raise ValueError(f"the stage's reader gave a damaged answer ({what})")


def _encode(value, file):
    if isinstance(value, np.ndarray):
        array = np.ascontiguousarray(value)
        if array.dtype.str not in DTYPES:
            raise TypeError(f"arrays of {array.dtype} are not handed over")
        file.write(b"\0" * (-file.tell() % ALIGN))
        offset = file.tell()
        array.tofile(file)
        return {"dtype": array.dtype.str, "shape": list(array.shape), "offset": offset}
    if dataclasses.is_dataclass(value):
        return {f.name: _encode(getattr(value, f.name), file) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {"keys": list(value), "values": [_encode(v, file) for v in value.values()]}
    if isinstance(value, (list, tuple)):
        return [_encode(v, file) for v in value]
    if isinstance(value, np.generic):
        return value.item()
    return value


def _decode(tree, kind, blob: np.ndarray):
    """A value of an annotated type from its tree."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):
        if tree is None:
            return None
        (kind,) = (a for a in arguments if a is not type(None))
        return _decode(tree, kind, blob)
    if kind is np.ndarray:
        dtype, shape, offset = tree["dtype"], [int(n) for n in tree["shape"]], int(tree["offset"])
        if dtype not in DTYPES or min(shape, default=0) < 0:
            raise TypeError(f"dtype {dtype}, shape {shape}")
        size = int(np.dtype(dtype).itemsize * np.prod(shape, dtype=object))
        if not 0 <= offset <= len(blob) - size:
            raise IndexError(f"{size} bytes at {offset} of {len(blob)}")
        return blob[offset : offset + size].view(dtype).reshape(shape)
    if dataclasses.is_dataclass(kind):
        hints = typing.get_type_hints(kind, vars(scene))
        return kind(**{f.name: _decode(tree[f.name], hints[f.name], blob) for f in dataclasses.fields(kind)})
    if origin is dict:
        return dict(zip(tree["keys"], (_decode(v, arguments[1], blob) for v in tree["values"]), strict=True))
    if origin is list:
        return [_decode(v, arguments[0], blob) for v in tree]
    if origin is tuple:
        kinds = [arguments[0]] * len(tree) if len(arguments) == 2 and arguments[1] is Ellipsis else arguments
        return tuple(_decode(v, k, blob) for v, k in zip(tree, kinds, strict=True))
    if kind is float and isinstance(tree, int) and not isinstance(tree, bool):
        return float(tree)
    if not isinstance(tree, kind):
        raise TypeError(f"{tree!r} for {kind.__name__}")
    return tree
