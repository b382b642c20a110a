"""Pictures that drive material parameters, on the host: read, reduced, and asked for what they say as a whole.

A picture is read once, reduced to at most `SIDE_MAX` texels a side and box-filtered to a pyramid of levels; only the
channels that a parameter uses are kept. Of a UDIM set the tiles are read that triangles lie in; each is a picture of its
own, clamped at its borders.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterable
from weakref import WeakValueDictionary

import numpy as np
import warp as wp

from warp_reflect.images import Picture, read_image
from warp_reflect.scene import MaterialData, Note, SceneData, TextureRef

SIDE_MAX = 1024  # texels; what a full-screen object shows in a 1080-row picture

# Parameters that are looked up, by their name in MaterialData; those of one component apart.
COLORS = ("base_color", "emissive", "specular_color")
NUMBERS = ("metallic", "roughness", "clearcoat", "clearcoat_roughness")
NORMAL = "normal"  # the normal map, looked up apart
# What says whether a surface is a mirror (with the base colour, for metals).
MIRROR_NUMBERS = ("metallic", "roughness", "clearcoat", "clearcoat_roughness")

# UDIM: tile = 1001 + column + 10 * row.
TILE_MARK = "<UDIM>"
TILE_FIRST = 1001
TILE_COLUMNS = wp.constant(10)
TILE_ROWS = wp.constant(100)  # beyond the four digits of a tile's name


@dataclasses.dataclass(frozen=True, eq=False)
class Pyramid:
    """A picture's levels, float32 [height, width, 1 or 3] each, the finest first and the last a single texel."""

    levels: tuple[np.ndarray, ...]
    notes: tuple[str, ...] = ()  # what was met reading it

    @property
    def mean(self) -> np.ndarray:
        """Mean of the picture, float64 [1 or 3]."""
        return self.levels[-1][0, 0].astype(np.float64)


_alive: WeakValueDictionary[tuple, Pyramid] = WeakValueDictionary()  # of the scenes in use: times of one stage share


def picture_key(texture: TextureRef) -> str:
    """What two uses of the same texels have in common."""
    return f"{texture.color_space}|{texture.channel}|{texture.file}"


def read_pictures(
    textures: Iterable[TextureRef], tell: Callable[[TextureRef, str], None], skip: Iterable[str] = ()
) -> dict[str, np.ndarray]:
    """The finest level of pictures, by `picture_key`.

    Args:
        textures: Their files; a packed one is copied out of its package first.
        tell: Called for a picture that cannot be read, which is left out, and for one that was repaired.
        skip: Keys that are not read.

    Returns:
        float32 [height, width, 1 or 3], linear, at most `SIDE_MAX` a side.
    """
    wanted = {picture_key(texture): texture for texture in textures}
    found: dict[str, np.ndarray] = {}
    last, picture = None, None
    for key, texture in sorted(wanted.items(), key=lambda item: (item[1].file, item[1].color_space)):
        if key in skip:
            continue
        if (texture.file, texture.color_space) != last:
            last = texture.file, texture.color_space
            try:
                picture = _read(texture)
            except (OSError, ValueError) as fault:
                picture = None
                tell(texture, f"{' '.join(str(fault).split())}; its fallback is used")
            if picture is not None and picture.cleaned:
                tell(texture, f"{texture.file}: {picture.cleaned} samples that are no light (NaN, infinite, < 0) are 0")
        if picture is not None:
            found[key] = reduced(_channels(picture, texture.channel))
    return found


def _read(texture: TextureRef) -> Picture:
    signed = texture.color_space == "signed"
    space = "raw" if signed else texture.color_space
    if not texture.file.endswith("]"):
        return read_image(texture.file, space, signed=signed)
    from warp_reflect.stage.textures import unpacked  # needs the USD library

    with tempfile.TemporaryDirectory(prefix="warp_reflect_") as folder:
        return read_image(unpacked(texture.file, folder), space, signed=signed)


def _channels(picture: Picture, channel: str) -> np.ndarray:
    if channel == "rgb":
        return picture.rgb
    if channel == "a":
        alpha = np.ones(picture.rgb.shape[:2], np.float32) if picture.alpha is None else picture.alpha
        return alpha[..., None]
    if len(channel) > 1:
        return np.concatenate([_channels(picture, letter) for letter in channel], axis=-1)
    first = "rgb".index(channel)
    return picture.rgb[..., first : first + 1]


def reduced(picture: np.ndarray, side: int = SIDE_MAX) -> np.ndarray:
    """A picture with no side longer than `side`; its mean is kept."""
    height, width = picture.shape[:2]
    shorter = box_resized(picture, min(height, side), axis=0)
    return np.ascontiguousarray(box_resized(shorter, min(width, side), axis=1), np.float32)


def box_resized(picture: np.ndarray, count: int, axis: int) -> np.ndarray:
    """A picture averaged down to `count` texels along an axis, each the mean of the part that it covers."""
    old = picture.shape[axis]
    if count == old:
        return picture
    rows = np.moveaxis(picture, axis, 0)
    if old % count == 0:
        result = rows.reshape(count, old // count, *rows.shape[1:]).mean(axis=1, dtype=np.float64)
    else:
        # The running sum at the new texels' borders, which may lie within an old texel.
        total = np.concatenate([np.zeros((1, *rows.shape[1:])), np.cumsum(rows, axis=0, dtype=np.float64)])
        border = np.arange(count + 1) * (old / count)
        whole = np.minimum(border.astype(np.int64), old - 1)
        share = (border - whole).reshape(-1, *[1] * (rows.ndim - 1))
        result = np.diff(total[whole] + share * rows[whole], axis=0) * (count / old)
    return np.moveaxis(result, 0, axis).astype(np.float32)


def make_pyramid(picture: np.ndarray) -> Pyramid:
    """Levels of half the size each, down to one texel."""
    levels = [picture]
    while max(levels[-1].shape[:2]) > 1:
        height, width = levels[-1].shape[:2]
        half = box_resized(levels[-1], max(height // 2, 1), axis=0)
        levels.append(box_resized(half, max(width // 2, 1), axis=1))
    return Pyramid(tuple(levels))


def load_pyramids(data: SceneData, textures: list[TextureRef], tell: Callable) -> dict[str, Pyramid]:
    """The pyramids of pictures by `picture_key`; those that cannot be read are told and left out.

    Pictures that came with the data are used instead of files, and then no file is opened.
    """
    if data.pictures is not None:
        keys = {picture_key(texture) for texture in textures}
        return {key: make_pyramid(data.pictures[key]) for key in keys if key in data.pictures}
    marks = {picture_key(texture): _mark(texture) for texture in textures}
    result = {key: _alive[mark] for key, mark in marks.items() if mark in _alive}
    for texture in {picture_key(texture): texture for texture in textures}.values():
        for text in result[picture_key(texture)].notes if picture_key(texture) in result else ():
            tell(texture, text)
    told: dict[str, list[str]] = {}

    def remember(texture: TextureRef, text: str) -> None:
        told.setdefault(texture.file, []).append(text)
        tell(texture, text)

    for key, picture in read_pictures(textures, remember, skip=result).items():
        notes = told.get(key.split("|", 2)[2], ())
        result[key] = _alive[marks[key]] = dataclasses.replace(make_pyramid(picture), notes=tuple(notes))
    return result


def _mark(texture: TextureRef) -> tuple:
    """What changes when a picture's file does."""
    package = texture.file.partition("[")[0] if texture.file.endswith("]") else texture.file
    try:
        status = os.stat(package)
    except OSError:
        return (picture_key(texture),)
    return picture_key(texture), status.st_mtime_ns, status.st_size


def with_pictures(data: SceneData) -> SceneData:
    """The data with every picture that shading uses read into it, for a reader that must open no file.

    Notes of pictures that cannot be read are added to `data.notes`. Without any texture nothing changes.
    """
    if not any(material.textures for material in data.materials):
        return data
    used = [
        (material, name, texture)
        for k, material in enumerate(data.materials)
        for name in material.textures
        if name in LOOKED_AT
        for texture in pictures_of(data, k, name)
    ]
    paths = {picture_key(texture): (material.path, name) for material, name, texture in used}

    def tell(texture: TextureRef, text: str) -> None:
        path, name = paths[picture_key(texture)]
        data.notes.append(note_of(path, name, text))

    return dataclasses.replace(data, pictures=read_pictures([texture for _, _, texture in used], tell))


# Parameters whose pictures are needed: looked up, or decisive for whether a surface is a mirror, or is there.
LOOKED_AT = frozenset((*COLORS, *NUMBERS, *MIRROR_NUMBERS, NORMAL, "opacity"))


def note_of(path: str, name: str, text: str) -> Note:
    return Note(path, f"texture of {name}: {text}")


def pictures_of(data: SceneData, material: int, name: str) -> list[TextureRef]:
    """The pictures behind a parameter: its texture, or the tiles of a UDIM set that triangles lie in and that exist."""
    texture = data.materials[material].textures[name]
    if TILE_MARK not in texture.file:
        return [texture]
    tiles = [tile_of(texture, number) for number in used_tiles(data, material, texture)]
    if data.pictures is not None:
        return [tile for tile in tiles if picture_key(tile) in data.pictures]
    return [tile for tile in tiles if _exists(tile.file)]


def tile_of(texture: TextureRef, number: int) -> TextureRef:
    file = texture.file.replace(TILE_MARK, str(TILE_FIRST + number))
    return dataclasses.replace(texture, file=file, wrap=("clamp", "clamp"))


def _exists(file: str) -> bool:
    if not file.endswith("]"):
        return os.path.isfile(file)
    package, _, inside = file[:-1].partition("[")
    try:
        with zipfile.ZipFile(package) as archive:
            return inside in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def used_tiles(data: SceneData, material: int, texture: TextureRef) -> list[int]:
    """The UDIM tiles, counted from 0, that triangles of a material lie in; a triangle's middle decides."""
    rows = np.array(texture.uv_from_st)
    found: set[int] = set()
    for mesh, parts in {(i.mesh, tuple(m == material for m in i.materials)) for i in data.instances}:
        uvs, index = data.meshes[mesh].uvs, data.meshes[mesh].uv_index
        if uvs is None or not any(parts):
            continue
        index = data.meshes[mesh].triangles if index is None else index
        ranges = data.meshes[mesh].parts
        for k, mine in enumerate(parts):
            if mine:
                own = index[ranges[k].first_triangle :][: ranges[k].triangle_count] if ranges else index
                middle = uvs[own].astype(np.float64).mean(axis=1)
                column, row = np.floor(middle @ rows[:, :2].T + rows[:, 2]).T
                inside = (column >= 0) & (column < int(TILE_COLUMNS)) & (row >= 0) & (row < int(TILE_ROWS))
                found |= set((column + int(TILE_COLUMNS) * row)[inside].astype(int).tolist())
    return sorted(found)


def mirror_constants(data: SceneData) -> tuple[list[MaterialData], list[Note], dict[str, Pyramid]]:
    """Materials with the means of the pictures that decide whether they are mirrors as their constants.

    Returns:
        (materials, notes, the pyramids read).
    """
    notes: list[Note] = []
    pyramids: dict[str, Pyramid] = {}
    materials = []
    for k, material in enumerate(data.materials):
        names = [name for name in MIRROR_NUMBERS if name in material.textures]
        if "base_color" in material.textures and (material.metallic > 0.0 or "metallic" in names):
            names.append("base_color")
        if "specular_color" in material.textures and material.specular_workflow:
            names.append("specular_color")
        material, known, told = _with_means(data, k, names, pyramids)
        notes += told
        numbers = [name for name in known if name in MIRROR_NUMBERS]
        if numbers:
            means = ", ".join(f"{name} {getattr(material, name):.3g}" for name in numbers)
            notes.append(Note(material.path, f"whether it is a mirror is decided by the textures' means: {means}"))
        materials.append(material)
    return materials, notes, pyramids


def _with_means(data, index: int, names: list[str], pyramids: dict) -> tuple[MaterialData, list[str], list[Note]]:
    """(the material with the means of its named pictures, the names of those, notes of what was met reading them)."""
    material = data.materials[index]
    notes: list[Note] = []
    values: dict = {}
    for name in names:
        textures = pictures_of(data, index, name)

        def tell(_, text: str, name=name) -> None:
            notes.append(note_of(material.path, name, text))

        missing = [texture for texture in textures if picture_key(texture) not in pyramids]
        pyramids.update(load_pyramids(data, missing, tell))
        known = [pyramids[picture_key(texture)] for texture in textures if picture_key(texture) in pyramids]
        if known:
            values[name] = _mean(material.textures[name], known, name)
    return (dataclasses.replace(material, **values) if values else material), list(values), notes


def _mean(texture: TextureRef, pyramids: list[Pyramid], name: str):
    scale, bias = scale_bias(texture)
    value = np.maximum(scale * np.mean([pyramid.mean for pyramid in pyramids], axis=0) + bias, 0.0)
    if name in COLORS:
        return tuple(float(v) for v in value)
    return float(min(value.mean(), 1.0))


def scale_bias(texture: TextureRef) -> tuple[np.ndarray, np.ndarray]:
    """Scale and bias of the channels that are used, float64 [3]; of a single one, three times that."""
    chosen = [0, 1, 2] if len(texture.channel) == 3 else ["rgba".index(texture.channel)] * 3
    return np.array(texture.scale, np.float64)[chosen], np.array(texture.bias, np.float64)[chosen]
