"""Pictures that drive material parameters, on the device (`pictures.py` reads them).

A look-up is bilinear within a level and linear between two of them, the levels chosen from the width of the pixel's cone
on the surface. A parameter with a picture uses it at every pixel of a mesh with texture coordinates; elsewhere, and for
the choice of mirrors, it has the picture's mean. Normal maps are kept here too, and looked up in `normal_maps.py`.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect import compact, launch
from warp_reflect.cutouts import WRAPS, wrapped_coordinate, wrapped_texel
from warp_reflect.layers import CameraView, GBuffer, ReflectionLayer, eye_ray_direction, eye_ray_origin
from warp_reflect.pictures import (
    COLORS,
    NORMAL,
    NUMBERS,
    SIDE_MAX,
    TILE_COLUMNS,
    TILE_FIRST,
    TILE_MARK,
    TILE_ROWS,
    Pyramid,
    load_pyramids,
    note_of,
    picture_key,
    pictures_of,
    scale_bias,
    tile_of,
    used_tiles,
)
from warp_reflect.scene import Note, Scene, SceneData, SceneView, TextureRef
from warp_reflect.shapes import clamp_weights, facet_normal, intersect_triangle, unit

wp.set_module_options({"enable_backward": False})

TEXELS_MAX = 2**28  # float32 values of all pyramids together (1 GiB); above it all lose their finest level

# At a grazing angle the cone's footprint is a line; a box filter that covered its length would blur it across.
LEAST_COSINE = wp.constant(0.1)
LEAST_LENGTH = wp.constant(1.0e-30)  # keeps the quotient of two lengths finite
# A decoded direction of a normal map shorter than this has lost its direction; the surface's own normal is used.
LEAST_DIRECTION = 0.1


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
    first_tile: int  # of a UDIM set, in `TextureSet.tiles`; -1: one picture
    tile_count: int
    without: wp.vec3  # value where a tile is missing


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
    clearcoat_roughness: int
    normal: int


@wp.struct
class TextureSet:
    """Everything textured of a scene; all arrays have length 0 where nothing is."""

    bindings: wp.array(dtype=BindingView)  # per material
    textures: wp.array(dtype=TextureView)
    levels: wp.array(dtype=LevelView)
    texels: wp.array(dtype=float)
    uvs: wp.array(dtype=wp.vec2)
    uv_index: wp.array(dtype=wp.vec3i)  # per triangle; (-1, -1, -1): without coordinates
    tiles: wp.array(dtype=int)  # of all UDIM sets: index into `textures`, -1 where a tile is missing
    look_count: int  # textures of parameters
    normal_count: int  # normal maps


def prepare_textures(scene: Scene, pyramids: dict[str, Pyramid]) -> TextureSet:
    """The device form of a scene's textures; pictures not in `pyramids` are read and added to it.

    What cannot be read is noted in `scene.notes`, and the parameter keeps its constant.
    """
    data = scene.data
    names = (*COLORS, *NUMBERS, NORMAL)
    used = []
    if any(data.meshes[instance.mesh].uvs is not None for instance in data.instances):
        used = [(k, name) for k, m in enumerate(data.materials) for name in names if name in m.textures]
    sources = {(k, name): pictures_of(data, k, name) for k, name in used}
    paths = {
        picture_key(texture): (data.materials[k].path, name) for (k, name), all_ in sources.items() for texture in all_
    }
    noted: set[Note] = set(scene.notes)

    def note(path: str, name: str, text: str) -> None:
        found = note_of(path, name, text)
        if found not in noted:
            noted.add(found)
            scene.notes.append(found)

    missing = [texture for textures in sources.values() for texture in textures if picture_key(texture) not in pyramids]
    pyramids.update(load_pyramids(data, missing, lambda texture, text: note(*paths[picture_key(texture)], text)))

    bindings = [_constants() for _ in data.materials]
    views: list[TextureView] = []
    levels: list[LevelView] = []
    texels: list[np.ndarray] = []
    tiles: list[int] = []
    first_level: dict[str, int] = {}
    kept = _within_budget({key: pyramids[key] for key in paths if key in pyramids})
    texel_count = look_count = normal_count = 0
    for (k, name), textures in sources.items():
        material = data.materials[k]
        textures = [texture for texture in textures if picture_key(texture) in kept]
        for texture in textures:
            key = picture_key(texture)
            if key not in first_level:
                first_level[key] = len(levels)
                for pixels in kept[key]:
                    level = LevelView()
                    level.first_texel, level.height, level.width = texel_count, *pixels.shape[:2]
                    levels.append(level)
                    texels.append(pixels.reshape(-1))
                    texel_count += pixels.size
                if name == NORMAL:
                    empty = _directionless(texture, kept[key][0])
                    if empty:
                        note(material.path, name, f"{empty} of {kept[key][0][..., 0].size} texels hold no direction")
        whole = material.textures[name]
        if TILE_MARK in whole.file:
            _tell_missing_tiles(data, k, name, whole, textures, note)
            by_file = {texture.file: texture for texture in textures}
            numbers = used_tiles(data, k, whole)
            table = np.full(max(numbers, default=-1) + 1, -1, np.int32)
            for number in numbers:
                texture = by_file.get(tile_of(whole, number).file)
                if texture is not None:
                    table[number] = len(views)
                    views.append(_texture_view(texture, first_level[picture_key(texture)], kept[picture_key(texture)]))
            if not textures:
                continue
            set_view = _texture_view(textures[0], first_level[picture_key(textures[0])], kept[picture_key(textures[0])])
            set_view.first_tile, set_view.tile_count = len(tiles), len(table)
            set_view.without = wp.vec3(*np.broadcast_to(getattr(material, name, 0.0), (3,)))
            tiles += table.tolist()
            number_of_view = len(views)
            views.append(set_view)
        elif textures:
            number_of_view = len(views)
            views.append(_texture_view(whole, first_level[picture_key(whole)], kept[picture_key(whole)]))
        else:
            continue
        setattr(bindings[k], name, number_of_view)
        if name == NORMAL:
            normal_count += 1
        else:
            bindings[k].count += 1
            look_count += 1

    result = TextureSet()
    device = scene.device
    flat = np.concatenate(texels) if texels else np.zeros(0, np.float32)
    uvs, uv_index = coordinates(data) if views else (np.zeros((0, 2), np.float32), np.zeros((0, 3), np.int32))
    result.bindings = wp.array(bindings if views else [], dtype=BindingView, device=device)
    result.textures = wp.array(views, dtype=TextureView, device=device)
    result.levels = wp.array(levels, dtype=LevelView, device=device)
    result.texels = wp.array(flat, dtype=float, device=device)
    result.uvs = wp.array(uvs, dtype=wp.vec2, device=device)
    result.uv_index = wp.array(uv_index, dtype=wp.vec3i, device=device)
    result.tiles = wp.array(np.array(tiles, np.int32), dtype=int, device=device)
    result.look_count, result.normal_count = look_count, normal_count
    return result


def _tell_missing_tiles(data, material: int, name: str, whole: TextureRef, found: list[TextureRef], note) -> None:
    """One note for the tiles of a set that are needed and not there."""
    files = {texture.file for texture in found}
    absent = [n for n in used_tiles(data, material, whole) if tile_of(whole, n).file not in files]
    if absent:
        listed = ", ".join(str(TILE_FIRST + number) for number in absent)
        note(data.materials[material].path, name, f"{whole.file}: no tile {listed}; its constant is used there")


def _directionless(texture: TextureRef, pixels: np.ndarray) -> int:
    """Texels of a normal map that decode to no direction."""
    scale, bias = scale_bias(texture)
    return int(np.count_nonzero(np.linalg.norm(pixels * scale + bias, axis=-1) < LEAST_DIRECTION))


def _constants() -> BindingView:
    binding = BindingView()
    for name in (*COLORS, *NUMBERS, NORMAL):
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
    scale, bias = scale_bias(texture)
    view = TextureView()
    view.first_level, view.level_count = first_level, len(levels)
    view.channels = levels[0].shape[2]
    view.wrap_u, view.wrap_v = (WRAPS[mode] for mode in texture.wrap)
    view.scale, view.bias = wp.vec3(*scale), wp.vec3(*bias)
    view.u_row, view.v_row = (wp.vec3(*row) for row in texture.uv_from_st)
    view.first_tile = -1
    return view


def coordinates(data: SceneData) -> tuple[np.ndarray, np.ndarray]:
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


@wp.struct
class Spot:
    """Where textures are looked up."""

    st: wp.vec2
    width: float  # of the footprint, in texture coordinates
    middle: wp.vec2  # of the triangle's coordinates: says which UDIM tile it lies in


@wp.func
def tile_view(textures: TextureSet, whole: TextureView, middle: wp.vec2) -> int:
    """Index of the texture of a UDIM set that a triangle with that middle lies in; -1: there is none."""
    p = wp.vec3(middle[0], middle[1], 1.0)
    column = int(wp.clamp(wp.floor(wp.dot(whole.u_row, p)), -1.0, float(TILE_COLUMNS)))
    row = int(wp.clamp(wp.floor(wp.dot(whole.v_row, p)), -1.0, float(TILE_ROWS)))
    number = row * TILE_COLUMNS + column
    if column < 0 or column >= TILE_COLUMNS or row < 0 or number >= whole.tile_count:
        return -1
    return textures.tiles[whole.first_tile + number]


@wp.func
def sample_signed(textures: TextureSet, number: int, spot: Spot) -> wp.vec3:
    """The value of a texture.

    Args:
        textures: All of the scene.
        number: Which.
        spot: From `footprint`.

    Returns:
        scale * texel + bias.
    """
    whole = textures.textures[number]
    p = wp.vec3(spot.st[0], spot.st[1], 1.0)
    u = wp.dot(whole.u_row, p)
    v = wp.dot(whole.v_row, p)
    chosen = int(number)
    if whole.first_tile >= 0:
        chosen = tile_view(textures, whole, spot.middle)
        if chosen < 0:
            return whole.without
        q = wp.vec3(spot.middle[0], spot.middle[1], 1.0)
        u -= wp.floor(wp.dot(whole.u_row, q))
        v -= wp.floor(wp.dot(whole.v_row, q))
    texture = textures.textures[chosen]
    finest = textures.levels[texture.first_level]
    magnified = wp.abs(texture.u_row[0] * texture.v_row[1] - texture.u_row[1] * texture.v_row[0])
    texels = spot.width * wp.sqrt(magnified * float(finest.width) * float(finest.height))
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
    return wp.cw_mul(texture.scale, value) + texture.bias


@wp.func
def sample(textures: TextureSet, number: int, spot: Spot) -> wp.vec3:
    """The value of a texture, not below 0; see `sample_signed`."""
    value = sample_signed(textures, number, spot)
    return wp.vec3(wp.max(value[0], 0.0), wp.max(value[1], 0.0), wp.max(value[2], 0.0))


@wp.func
def footprint(
    textures: TextureSet, scene: SceneView, triangle: int, u: float, v: float, direction: wp.vec3, width: float
) -> Spot:
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
    spot = Spot()
    spot.st = st
    spot.width = covered
    spot.middle = (a + b + c) / 3.0
    return spot


@wp.struct
class Look:
    """A material at one point."""

    base_color: wp.vec3
    f0: wp.vec3
    f90: wp.vec3
    emissive: wp.vec3
    roughness: float
    clearcoat: float
    clearcoat_roughness: float
    clearcoat_f0: float
    opacity: float
    transmission: float


@wp.func
def with_base(look: Look, color: wp.vec3, metallic: float) -> Look:
    """The metallic workflow's F0 and F90 of another base colour and metallic; see `scene.reflectance`."""
    dielectric = (1.0 - metallic) * look.clearcoat_f0
    result = Look()
    result.emissive = look.emissive
    result.roughness = look.roughness
    result.clearcoat = look.clearcoat
    result.clearcoat_roughness = look.clearcoat_roughness
    result.clearcoat_f0 = look.clearcoat_f0
    result.opacity = look.opacity
    result.transmission = look.transmission
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
    look.clearcoat_roughness = scene.materials[material].clearcoat_roughness
    look.clearcoat_f0 = scene.materials[material].clearcoat_f0
    look.opacity = scene.materials[material].opacity
    look.transmission = scene.materials[material].transmission
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
    if binding.clearcoat_roughness >= 0:
        look.clearcoat_roughness = wp.min(sample(textures, binding.clearcoat_roughness, st)[0], 1.0)
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
    camera: wp.array(dtype=CameraView),
    textures: TextureSet,
    triangle: wp.array(dtype=int),
    out_looks: wp.array(dtype=Look),
):
    """One thread per pixel."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        return
    row = i // camera[0].width
    x = float(i - row * camera[0].width) + 0.5
    y = float(row) + 0.5
    ray = eye_ray_direction(camera[0], x, y)
    corner = scene.triangles[tri]
    hit = intersect_triangle(
        eye_ray_origin(camera[0], x, y),
        ray,
        scene.points[corner[0]] - camera[0].eye,
        scene.points[corner[1]] - camera[0].eye,
        scene.points[corner[2]] - camera[0].eye,
    )
    uv = clamp_weights(hit.u, hit.v)
    width = pixel_width(camera[0], wp.max(hit.t, 0.0))
    out_looks[i] = look_at_point(scene, textures, tri, uv[0], uv[1], unit(ray), width)


@wp.kernel
def mirrored_looks_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
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
    to_mirror = point[i] - camera[0].eye
    longer = 1.0 + distance[i] / wp.max(wp.length(to_mirror), LEAST_LENGTH)
    width = pixel_width(camera[0], wp.dot(camera[0].forward, to_mirror) * longer)
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
        `Look` [pixels of the G-buffer or of the layer], not set where nothing is seen; length 0 where no parameter of
        the scene is textured.
    """
    textures = scene.textures
    if textures.look_count == 0:
        return compact.none(Look, scene.device)
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
