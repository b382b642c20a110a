"""Pictures that drive material parameters: read on the host, looked up on the device.

A picture is read once, reduced to at most `SIDE_MAX` texels a side and box-filtered to a pyramid of levels; only
the channels that a parameter uses are kept. A look-up is bilinear within a level and linear between two of them,
the levels chosen from the width of the pixel's cone on the surface.

A parameter with a picture uses it at every pixel of a mesh with texture coordinates. Elsewhere, and for the choice
of mirrors, it has the picture's mean.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Callable, Iterable
from weakref import WeakValueDictionary

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.images import Picture, read_image
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin
from warp_reflect.scene import MaterialData, Note, Scene, SceneData, SceneView, TextureRef
from warp_reflect.shapes import clamp_weights, facet_normal, intersect_triangle, unit

wp.set_module_options({"enable_backward": False})

SIDE_MAX = 1024  # texels; what a full-screen object shows in a 1080-row picture
TEXELS_MAX = 2**28  # float32 values of all pyramids together (1 GiB); above it all lose their finest level

# Parameters that are looked up, by their name in MaterialData; those of one component apart.
COLORS = ("base_color", "emissive", "specular_color")
NUMBERS = ("metallic", "roughness", "clearcoat")
# What says whether a surface is a mirror (with the base colour, for metals).
MIRROR_NUMBERS = ("metallic", "roughness", "clearcoat", "clearcoat_roughness")

WRAP_REPEAT = wp.constant(0)
WRAP_CLAMP = wp.constant(1)
WRAP_MIRROR = wp.constant(2)
WRAP_BLACK = wp.constant(3)
# A wrap mode in the file's metadata is not looked for: repeat is what exporters that write none mean.
WRAPS = {"useMetadata": 0, "repeat": 0, "clamp": 1, "mirror": 2, "black": 3}

# At a grazing angle the cone's footprint is a line; a box filter that covered its length would blur it across.
LEAST_COSINE = wp.constant(0.1)
LEAST_LENGTH = wp.constant(1.0e-30)  # keeps the quotient of two lengths finite


@dataclasses.dataclass(frozen=True, eq=False)
class Pyramid:
    """A picture's levels, float32 [height, width, 1 or 3] each, the finest first and the last a single texel."""

    levels: tuple[np.ndarray, ...]

    @property
    def mean(self) -> np.ndarray:
        """Mean of the picture, float64 [1 or 3]."""
        return self.levels[-1][0, 0].astype(np.float64)


_alive: WeakValueDictionary[tuple, Pyramid] = WeakValueDictionary()  # of the scenes in use: times of one stage share


@wp.struct
class LevelView:
    first_texel: int
    width: int
    height: int


@wp.struct
class TextureView:
    """One use of a picture: value = scale * texel + bias."""

    first_level: int
    level_count: int
    channels: int  # floats a texel
    wrap_u: int
    wrap_v: int
    scale: wp.vec3
    bias: wp.vec3
    u_row: wp.vec3  # u = dot(u_row, (s, t, 1))
    v_row: wp.vec3


@wp.struct
class BindingView:
    """A material's textures, indices into `TextureSet.textures`; -1: a constant."""

    count: int
    base_color: int
    emissive: int
    specular_color: int
    metallic: int
    roughness: int
    clearcoat: int


@wp.struct
class TextureSet:
    """Everything textured of a scene; all arrays have length 0 where nothing is."""

    bindings: wp.array(dtype=BindingView)  # per material
    textures: wp.array(dtype=TextureView)
    levels: wp.array(dtype=LevelView)
    texels: wp.array(dtype=float)
    uvs: wp.array(dtype=wp.vec2)
    uv_index: wp.array(dtype=wp.vec3i)  # per triangle; (-1, -1, -1): without coordinates


def picture_key(texture: TextureRef) -> str:
    """What two uses of the same texels have in common."""
    return f"{texture.color_space}|{texture.channel}|{texture.file}"


def read_pictures(
    textures: Iterable[TextureRef], tell: Callable[[TextureRef, str], None], skip: Iterable[str] = ()
) -> dict[str, np.ndarray]:
    """The finest level of pictures, by `picture_key`.

    Args:
        textures: Their files; a packed one is copied out of its package first.
        tell: Called for a picture that cannot be read, which is left out.
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
                tell(texture, " ".join(str(fault).split()))
        if picture is not None:
            found[key] = reduced(_channels(picture, texture.channel))
    return found


def _read(texture: TextureRef) -> Picture:
    if not texture.file.endswith("]"):
        return read_image(texture.file, texture.color_space)
    from warp_reflect.stage.textures import unpacked  # needs the USD library

    with tempfile.TemporaryDirectory(prefix="warp_reflect_") as folder:
        return read_image(unpacked(texture.file, folder), texture.color_space)


def _channels(picture: Picture, channel: str) -> np.ndarray:
    if channel == "rgb":
        return picture.rgb
    if channel == "a":
        alpha = np.ones(picture.rgb.shape[:2], np.float32) if picture.alpha is None else picture.alpha
        return alpha[..., None]
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
    for key, picture in read_pictures(textures, tell, skip=result).items():
        result[key] = _alive[marks[key]] = make_pyramid(picture)
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
    used = [(m, name, t) for m in data.materials for name, t in m.textures.items() if name in _looked_at(m)]
    paths = {picture_key(texture): (material.path, name) for material, name, texture in used}

    def tell(texture: TextureRef, fault: str) -> None:
        path, name = paths[picture_key(texture)]
        data.notes.append(_unreadable(path, name, fault))

    return dataclasses.replace(data, pictures=read_pictures([texture for _, _, texture in used], tell))


def _looked_at(material: MaterialData) -> set[str]:
    """The parameters whose pictures are needed: looked up, or decisive for whether it is a mirror."""
    return {*COLORS, *NUMBERS, *MIRROR_NUMBERS} & set(material.textures)


def _unreadable(path: str, name: str, fault: str) -> Note:
    return Note(path, f"texture of {name}: {fault}; its fallback is used")


def mirror_constants(data: SceneData) -> tuple[list[MaterialData], list[Note], dict[str, Pyramid]]:
    """Materials with the means of the pictures that decide whether they are mirrors as their constants.

    Returns:
        (materials, notes, the pyramids read).
    """
    notes: list[Note] = []
    pyramids: dict[str, Pyramid] = {}
    materials = []
    for material in data.materials:
        names = [name for name in MIRROR_NUMBERS if name in material.textures]
        if "base_color" in material.textures and (material.metallic > 0.0 or "metallic" in names):
            names.append("base_color")
        if "specular_color" in material.textures and material.specular_workflow:
            names.append("specular_color")
        material, told = _with_means(data, material, names, pyramids)
        notes += told
        numbers = [name for name in names if name in MIRROR_NUMBERS]
        if numbers and not told:
            means = ", ".join(f"{name} {getattr(material, name):.3g}" for name in numbers)
            notes.append(Note(material.path, f"whether it is a mirror is decided by the textures' means: {means}"))
        materials.append(material)
    return materials, notes, pyramids


def _with_means(data, material: MaterialData, names: list[str], pyramids: dict) -> tuple[MaterialData, list[Note]]:
    """The material with the means of its named pictures, and notes of those that cannot be read."""
    notes: list[Note] = []
    values: dict = {}
    for name in names:
        texture = material.textures[name]
        key = picture_key(texture)
        if key not in pyramids:
            pyramids.update(
                load_pyramids(
                    data,
                    [texture],
                    lambda _, fault, name=name: notes.append(_unreadable(material.path, name, fault)),
                )
            )
        if key in pyramids:
            values[name] = _mean(texture, pyramids[key], name)
    return (dataclasses.replace(material, **values) if values else material), notes


def _mean(texture: TextureRef, pyramid: Pyramid, name: str):
    scale, bias = _scale_bias(texture)
    value = np.maximum(scale * pyramid.mean + bias, 0.0)
    if name in COLORS:
        return tuple(float(v) for v in value)
    return float(min(value.mean(), 1.0))


def _scale_bias(texture: TextureRef) -> tuple[np.ndarray, np.ndarray]:
    """Scale and bias of the channels that are used, float64 [3]; of a single one, three times that."""
    chosen = [0, 1, 2] if texture.channel == "rgb" else ["rgba".index(texture.channel)] * 3
    return np.array(texture.scale, np.float64)[chosen], np.array(texture.bias, np.float64)[chosen]


def prepare_textures(scene: Scene, pyramids: dict[str, Pyramid]) -> TextureSet:
    """The device form of a scene's textures; pictures not in `pyramids` are read and added to it.

    What cannot be read is noted in `scene.notes`, and the parameter keeps its constant.
    """
    data = scene.data
    names = (*COLORS, *NUMBERS)
    has_uvs = any(data.meshes[instance.mesh].uvs is not None for instance in data.instances)
    used = []
    if has_uvs:
        used = [(k, name) for k, m in enumerate(data.materials) for name in names if name in m.textures]
    paths = {picture_key(data.materials[k].textures[name]): (data.materials[k].path, name) for k, name in used}
    noted: set[Note] = set(scene.notes)

    def tell(texture: TextureRef, fault: str) -> None:
        note = _unreadable(*paths[picture_key(texture)], fault)
        if note not in noted:
            scene.notes.append(note)

    missing = [data.materials[k].textures[name] for k, name in used]
    missing = [texture for texture in missing if picture_key(texture) not in pyramids]
    pyramids.update(load_pyramids(data, missing, tell))

    bindings = [_constants() for _ in data.materials]
    views: list[TextureView] = []
    levels: list[LevelView] = []
    texels: list[np.ndarray] = []
    first_level: dict[str, int] = {}
    kept = _within_budget({key: pyramids[key] for key in paths if key in pyramids})
    texel_count = 0
    for k, name in used:
        texture = data.materials[k].textures[name]
        key = picture_key(texture)
        if key not in kept:
            continue
        if key not in first_level:
            first_level[key] = len(levels)
            for pixels in kept[key]:
                level = LevelView()
                level.first_texel, level.height, level.width = texel_count, *pixels.shape[:2]
                levels.append(level)
                texels.append(pixels.reshape(-1))
                texel_count += pixels.size
        setattr(bindings[k], name, len(views))
        bindings[k].count += 1
        views.append(_texture_view(texture, first_level[key], kept[key]))

    result = TextureSet()
    device = scene.device
    flat = np.concatenate(texels) if texels else np.zeros(0, np.float32)
    uvs, uv_index = _coordinates(data) if views else (np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32))
    result.bindings = wp.array(bindings if views else [], dtype=BindingView, device=device)
    result.textures = wp.array(views, dtype=TextureView, device=device)
    result.levels = wp.array(levels, dtype=LevelView, device=device)
    result.texels = wp.array(flat, dtype=float, device=device)
    result.uvs = wp.array(uvs, dtype=wp.vec2, device=device)
    result.uv_index = wp.array(uv_index, dtype=wp.vec3i, device=device)
    return result


def _constants() -> BindingView:
    binding = BindingView()
    for name in (*COLORS, *NUMBERS):
        setattr(binding, name, -1)
    return binding


def _within_budget(pyramids: dict[str, Pyramid]) -> dict[str, tuple[np.ndarray, ...]]:
    """The levels that fit into `TEXELS_MAX`; the finest go first."""
    side = SIDE_MAX
    while True:
        kept = {
            key: tuple(level for level in pyramid.levels if max(level.shape[:2]) <= side)
            for key, pyramid in pyramids.items()
        }
        if side == 1 or sum(level.size for levels in kept.values() for level in levels) <= TEXELS_MAX:
            return kept
        side //= 2


def _texture_view(texture: TextureRef, first_level: int, levels: tuple[np.ndarray, ...]) -> TextureView:
    scale, bias = _scale_bias(texture)
    view = TextureView()
    view.first_level, view.level_count = first_level, len(levels)
    view.channels = levels[0].shape[2]
    view.wrap_u, view.wrap_v = (WRAPS[mode] for mode in texture.wrap)
    view.scale, view.bias = wp.vec3(*scale), wp.vec3(*bias)
    view.u_row, view.v_row = (wp.vec3(*row) for row in texture.uv_from_st)
    return view


def _coordinates(data: SceneData) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates float32 [n, 2] and their indices int32 [triangle_count, 3], in the scene's order."""
    uvs, index = [], []
    first: dict[int, int] = {}  # by mesh: its instances share the coordinates
    count = 0
    for instance in data.instances:
        mesh = data.meshes[instance.mesh]
        if mesh.uvs is None:
            index.append(np.full((len(mesh.triangles), 3), -1, np.int32))
            continue
        if instance.mesh not in first:
            first[instance.mesh] = count
            uvs.append(mesh.uvs)
            count += len(mesh.uvs)
        own = mesh.triangles if mesh.uv_index is None else mesh.uv_index
        # A scene winds mirrored instances back.
        flip = np.linalg.det(instance.world_from_object[:3, :3]) < 0.0
        index.append(own[:, [0, 2, 1] if flip else [0, 1, 2]] + np.int32(first[instance.mesh]))
    return np.concatenate(uvs).astype(np.float32), np.concatenate(index).astype(np.int32)


@wp.func
def wrapped_coordinate(x: float, mode: int) -> float:
    """A picture coordinate brought near [0, 1], so that no integer overflows."""
    if mode == WRAP_REPEAT:
        return x - wp.floor(x)
    if mode == WRAP_MIRROR:
        return x - 2.0 * wp.floor(0.5 * x)
    return wp.clamp(x, -1.0, 2.0)


@wp.func
def wrapped_texel(i: int, count: int, mode: int) -> int:
    """The texel that one of `wrapped_coordinate` stands for; -1: black."""
    k = i
    if mode == WRAP_REPEAT:
        if k < 0:
            k += count
        if k >= count:
            k -= count
    elif mode == WRAP_MIRROR:
        # Two periods: a neighbour of the last texel of the second is the first of the next.
        if k < 0:
            k = -1 - k
        if k >= 2 * count:
            k -= 2 * count
        if k >= count:
            k = 2 * count - 1 - k
    elif mode == WRAP_BLACK:
        if k < 0 or k >= count:
            return -1
    return wp.clamp(k, 0, count - 1)


@wp.func
def texel_at(texels: wp.array(dtype=float), level: LevelView, channels: int, column: int, row: int) -> wp.vec3:
    """A texel's value; one channel comes three times."""
    if column < 0 or row < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    k = level.first_texel + (row * level.width + column) * channels
    if channels == 1:
        return wp.vec3(texels[k], texels[k], texels[k])
    return wp.vec3(texels[k], texels[k + 1], texels[k + 2])


@wp.func
def sample_level(textures: TextureSet, texture: TextureView, number: int, u: float, v: float) -> wp.vec3:
    """Bilinear look-up in one level; u to the right, v upwards, both 0 to 1 over the picture."""
    level = textures.levels[texture.first_level + number]
    x = wrapped_coordinate(u, texture.wrap_u) * float(level.width) - 0.5
    y = wrapped_coordinate(1.0 - v, texture.wrap_v) * float(level.height) - 0.5
    x_floor = wp.floor(x)
    y_floor = wp.floor(y)
    fx = x - x_floor
    fy = y - y_floor
    column0 = wrapped_texel(int(x_floor), level.width, texture.wrap_u)
    column1 = wrapped_texel(int(x_floor) + 1, level.width, texture.wrap_u)
    row0 = wrapped_texel(int(y_floor), level.height, texture.wrap_v)
    row1 = wrapped_texel(int(y_floor) + 1, level.height, texture.wrap_v)
    n = texture.channels
    top = (1.0 - fx) * texel_at(textures.texels, level, n, column0, row0) + fx * texel_at(
        textures.texels, level, n, column1, row0
    )
    bottom = (1.0 - fx) * texel_at(textures.texels, level, n, column0, row1) + fx * texel_at(
        textures.texels, level, n, column1, row1
    )
    return (1.0 - fy) * top + fy * bottom


@wp.func
def sample(textures: TextureSet, number: int, st: wp.vec3) -> wp.vec3:
    """The value of a texture, not below 0.

    Args:
        textures: All of the scene.
        number: Which.
        st: Texture coordinates s and t, and the width of the footprint in them (see `footprint`).

    Returns:
        scale * texel + bias.
    """
    texture = textures.textures[number]
    p = wp.vec3(st[0], st[1], 1.0)
    u = wp.dot(texture.u_row, p)
    v = wp.dot(texture.v_row, p)
    finest = textures.levels[texture.first_level]
    magnified = wp.abs(texture.u_row[0] * texture.v_row[1] - texture.u_row[1] * texture.v_row[0])
    texels = st[2] * wp.sqrt(magnified * float(finest.width) * float(finest.height))
    value = wp.vec3(0.0, 0.0, 0.0)
    if texels <= 1.0:
        value = sample_level(textures, texture, 0, u, v)
    else:
        height = wp.min(wp.log2(texels), float(texture.level_count - 1))
        lower = wp.min(int(height), wp.max(texture.level_count - 2, 0))
        share = height - float(lower)
        value = (1.0 - share) * sample_level(textures, texture, lower, u, v)
        if share > 0.0:
            value += share * sample_level(textures, texture, lower + 1, u, v)
    value = wp.cw_mul(texture.scale, value) + texture.bias
    return wp.vec3(wp.max(value[0], 0.0), wp.max(value[1], 0.0), wp.max(value[2], 0.0))


@wp.func
def footprint(
    textures: TextureSet, scene: SceneView, triangle: int, u: float, v: float, direction: wp.vec3, width: float
) -> wp.vec3:
    """Texture coordinates at a hit, and how much of them the pixel's cone covers.

    Args:
        textures: Has coordinates for the triangle.
        scene: Holds its corners.
        triangle: The triangle hit.
        u: Weight of its second corner.
        v: Weight of its third corner.
        direction: Of the cone, unit.
        width: Of the cone at the hit, across it. [scene units]

    Source: Akenine-Moller et al., Texture Level of Detail Strategies for Real-Time Ray Tracing, Ray Tracing Gems
    2019, chapter 20, equations 20-4 and 20-6 (ray cones). Differs from it by `LEAST_COSINE`.
    """
    index = textures.uv_index[triangle]
    a = textures.uvs[index[0]]
    b = textures.uvs[index[1]]
    c = textures.uvs[index[2]]
    st = (1.0 - u - v) * a + u * b + v * c
    tri = scene.triangles[triangle]
    p0 = scene.points[tri[0]]
    p1 = scene.points[tri[1]]
    p2 = scene.points[tri[2]]
    area = wp.length(wp.cross(p1 - p0, p2 - p0))
    cosine = wp.abs(wp.dot(facet_normal(p0, p1, p2), direction))
    picture_area = wp.abs((b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]))
    covered = float(0.0)
    if area > 0.0:
        covered = width / wp.max(cosine, LEAST_COSINE) * wp.sqrt(picture_area / area)
    return wp.vec3(st[0], st[1], covered)


@wp.struct
class Look:
    """A material at one point."""

    base_color: wp.vec3
    f0: wp.vec3
    f90: wp.vec3
    emissive: wp.vec3
    roughness: float
    clearcoat: float
    clearcoat_f0: float


@wp.func
def with_base(look: Look, color: wp.vec3, metallic: float) -> Look:
    """The metallic workflow's F0 and F90 of another base colour and metallic; see `scene.reflectance`."""
    dielectric = (1.0 - metallic) * look.clearcoat_f0
    result = Look()
    result.emissive = look.emissive
    result.roughness = look.roughness
    result.clearcoat = look.clearcoat
    result.clearcoat_f0 = look.clearcoat_f0
    result.base_color = color
    result.f0 = wp.vec3(dielectric, dielectric, dielectric) + metallic * color
    result.f90 = wp.vec3(1.0 - metallic, 1.0 - metallic, 1.0 - metallic) + metallic * color
    return result


@wp.func
def plain_look(scene: SceneView, triangle: int, u: float, v: float) -> Look:
    """A surface's material from its constants and the colours of its corners."""
    material = scene.patches[scene.triangle_patch[triangle]].material
    look = Look()
    look.base_color = scene.materials[material].base_color
    look.f0 = scene.materials[material].f0
    look.f90 = scene.materials[material].f90
    look.emissive = scene.materials[material].emissive
    look.roughness = scene.materials[material].roughness
    look.clearcoat = scene.materials[material].clearcoat
    look.clearcoat_f0 = scene.materials[material].clearcoat_f0
    if scene.materials[material].uses_vertex_color != 0 and scene.color_index.shape[0] > 0:
        index = scene.color_index[triangle]
        if index[0] >= 0:
            color = (1.0 - u - v) * scene.colors[index[0]] + u * scene.colors[index[1]] + v * scene.colors[index[2]]
            look.base_color = color
            if scene.materials[material].metallic > 0.0:
                look = with_base(look, color, scene.materials[material].metallic)
    return look


@wp.func
def look_at_point(
    scene: SceneView, textures: TextureSet, triangle: int, u: float, v: float, direction: wp.vec3, width: float
) -> Look:
    """A surface's material at a point that a cone of the given unit direction and width meets."""
    look = plain_look(scene, triangle, u, v)
    material = scene.patches[scene.triangle_patch[triangle]].material
    binding = textures.bindings[material]
    if binding.count == 0 or textures.uv_index[triangle][0] < 0:
        return look
    st = footprint(textures, scene, triangle, u, v, direction, width)
    if binding.emissive >= 0:
        look.emissive = sample(textures, binding.emissive, st)
    if binding.roughness >= 0:
        look.roughness = wp.min(sample(textures, binding.roughness, st)[0], 1.0)
    if binding.clearcoat >= 0:
        look.clearcoat = wp.min(sample(textures, binding.clearcoat, st)[0], 1.0)
    color = look.base_color
    if binding.base_color >= 0:
        color = below_one(sample(textures, binding.base_color, st))
    if scene.materials[material].specular_workflow != 0:
        look.base_color = color
        if binding.specular_color >= 0:
            look.f0 = below_one(sample(textures, binding.specular_color, st))
    elif binding.base_color >= 0 or binding.metallic >= 0:
        metallic = scene.materials[material].metallic
        if binding.metallic >= 0:
            metallic = wp.min(sample(textures, binding.metallic, st)[0], 1.0)
        look = with_base(look, color, metallic)
    return look


@wp.func
def below_one(color: wp.vec3) -> wp.vec3:
    """A reflectance: above 1 a surface would give back more light than it gets."""
    return wp.vec3(wp.min(color[0], 1.0), wp.min(color[1], 1.0), wp.min(color[2], 1.0))


@wp.func
def pixel_width(camera: CameraView, depth: float) -> float:
    """Width of a pixel's cone after a path of that depth along the camera's forward direction, in scene units."""
    if camera.orthographic != 0:
        return wp.length(camera.ray_dx)
    return depth * wp.length(camera.ray_dx)


@wp.kernel
def eye_looks_kernel(
    first: int,
    scene: SceneView,
    camera: CameraView,
    textures: TextureSet,
    triangle: wp.array(dtype=int),
    out_looks: wp.array(dtype=Look),
):
    """One thread per pixel."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        return
    row = i // camera.width
    x = float(i - row * camera.width) + 0.5
    y = float(row) + 0.5
    ray = eye_ray_direction(camera, x, y)
    corner = scene.triangles[tri]
    hit = intersect_triangle(
        eye_ray_origin(camera, x, y),
        ray,
        scene.points[corner[0]] - camera.eye,
        scene.points[corner[1]] - camera.eye,
        scene.points[corner[2]] - camera.eye,
    )
    uv = clamp_weights(hit.u, hit.v)
    width = pixel_width(camera, wp.max(hit.t, 0.0))
    out_looks[i] = look_at_point(scene, textures, tri, uv[0], uv[1], unit(ray), width)


@wp.kernel
def mirrored_looks_kernel(
    first: int,
    scene: SceneView,
    camera: CameraView,
    textures: TextureSet,
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    out_looks: wp.array(dtype=Look),
):
    """One thread per mirror pixel. The cone goes on behind a mirror as it came: that a curved one widens it is left out."""
    i = first + wp.tid()
    if triangle[i] < 0:
        return
    to_mirror = point[i] - camera.eye
    longer = 1.0 + distance[i] / wp.max(wp.length(to_mirror), LEAST_LENGTH)
    width = pixel_width(camera, wp.dot(camera.forward, to_mirror) * longer)
    out_looks[i] = look_at_point(scene, textures, triangle[i], u[i], v[i], direction[i], width)


def prepare_looks(scene: Scene, gbuffer: GBuffer, layer: ReflectionLayer | None, threads: int = 0) -> wp.array:
    """The materials that a frame shows, where any of the scene is textured.

    Kernels of their own, so that a scene without textures is shaded by small ones.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        layer: What is seen in a mirror; None: of what the eye sees itself.
        threads: CPU threads; 0: one per core.

    Returns:
        `Look` [pixels of the G-buffer or of the layer], not set where nothing is seen; length 0 where nothing of the
        scene is textured.
    """
    textures = scene.textures
    if textures.textures.shape[0] == 0:
        return wp.zeros(0, dtype=Look, device=scene.device)
    if layer is None:
        looks = wp.zeros(len(gbuffer.triangle), dtype=Look, device=scene.device)
        inputs = [scene.view, gbuffer.view, textures, gbuffer.triangle, looks]
        launch.launch(eye_looks_kernel, len(looks), inputs, scene.device, threads)
        return looks
    pixels = layer.pixels
    looks = wp.zeros(pixels.count, dtype=Look, device=scene.device)
    inputs = [scene.view, gbuffer.view, textures, pixels.point, pixels.direction, layer.distance]
    inputs += [layer.triangle, layer.u, layer.v, looks]
    launch.launch(mirrored_looks_kernel, pixels.count, inputs, scene.device, threads)
    return looks
