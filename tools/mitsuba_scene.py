"""A loaded stage as a Mitsuba 3 scene: an independent renderer's view of the same geometry, materials and lights.

Only the host data of a scene are read (points, texture coordinates, material parameters, picture files, lights,
camera); pictures are read by Mitsuba itself. A `mitsuba` variant must be set before anything here is called, as
`llvm_ad_rgb` for `direct_picture`; what is made belongs to that variant.

What is compared is what the package sets out to show: Lambert's reflection of direct light, and one sharp mirror
image. `diffuse_version` takes the rest (lobes, coats, opacity, normal maps) off all materials but the mirrors', for
both renderers.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
import zipfile
from functools import cached_property
from pathlib import Path

import mitsuba as mi
import numpy as np

# The grey dome of a stage without lights: radiance at the horizon, and what is added straight up.
DEFAULT_SKY, DEFAULT_SLOPE = 0.5, 0.3
ENVIRONMENT_ROWS = 512  # of a latlong map that sums several domes
QUADRIC_SPLITS = 2  # each triangle of a gprim becomes 4^2 on the analytic surface
PROJECTION_STEPS = 4  # of Newton; from a facet's edge the second is already exact to float32
NEAREST_HIT = 1.0e-4  # of the distance to a light: shadow rays end this share before it
SAMPLES_PER_PASS = 16  # light samples a pixel and wavefront; bounds its memory
AP1_PRIMARIES = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)  # ACEScg
REC709_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
KEPT_TEXTURES = ("base_color", "emissive")  # of a diffuse surface


@dataclasses.dataclass
class MitsubaScene:
    """A converted scene. World axes, the origin at the camera's eye.

    Attributes:
        geometry: Dictionary of the surfaces and the sensor, without lights.
        lights: Dictionary of the emitters alone.
        materials: Of each part, in the order of the parts.
        mirrors: Indices of the parts that mirror.
        size: (width, height). [pixels]
    """

    geometry: dict
    lights: dict
    materials: list
    mirrors: frozenset
    size: tuple[int, int]

    @cached_property
    def loaded(self) -> tuple:
        """Mitsuba's scenes of the geometry and of the lights, and the mirrors' parameters."""
        geometry, lights = (mi.load_dict(d, optimize=False) for d in (self.geometry, self.lights))
        return geometry, lights, _tables(geometry, self)

    def whole(self, integrator: dict) -> dict:
        """One scene for Mitsuba's own integrators."""
        return {**self.geometry, **self.lights, "integrator": integrator}


def diffuse_version(data, mirrors: set[int]):
    """The scene data with materials reduced to emission and a base colour, but for those of mirrors.

    Args:
        data: `warp_reflect.scene.SceneData`.
        mirrors: Indices of the materials that stay.
    """

    def reduced(material):
        return dataclasses.replace(
            material,
            metallic=0.0,
            roughness=1.0,
            ior=1.0,  # no reflection at the surface: the base colour is the albedo
            specular_workflow=False,
            opacity=1.0,
            clearcoat=0.0,
            textures={name: texture for name, texture in material.textures.items() if name in KEPT_TEXTURES},
        )

    materials = [m if k in mirrors else reduced(m) for k, m in enumerate(data.materials)]
    return dataclasses.replace(data, materials=materials)


def convert(
    data, camera, size: tuple[int, int], mirrors: set[int], samples: int = 16, ideal: bool = False
) -> MitsubaScene:
    """The Mitsuba scene of a stage.

    Args:
        data: `warp_reflect.scene.SceneData`.
        camera: One of its `CameraData`.
        size: (width, height). [pixels]
        mirrors: Indices of the parts (in the order of instances, then parts) that mirror.
        samples: A pixel, for Mitsuba's own integrators.
        ideal: Metals that mirror become Mitsuba's ideal mirrors, as its own integrators need them; else every
            surface has its base colour as Lambert's, and `direct_picture` adds the mirror.
    """
    origin = np.asarray(camera.world_from_camera, np.float64)[:3, 3]
    pictures = _Pictures()
    geometry: dict = {"type": "scene", "sensor": _sensor(camera, size, samples)}
    materials = []
    looks: dict[tuple, object] = {}
    for instance in data.instances:
        mesh = data.meshes[instance.mesh]
        for k, (first, count, patches) in enumerate(parts_of(mesh)):
            number = len(materials)
            material = data.materials[instance.materials[k]]
            colored = material.uses_vertex_color and mesh.colors is not None
            key = (instance.materials[k], colored, number in mirrors)
            if key not in looks:
                looks[key] = mi.load_dict(_surface(material, colored, ideal and number in mirrors, pictures))
            corners = part_corners(mesh, first, count, patches)
            if len(corners["points"]):
                geometry[f"part{number}"] = _mesh(
                    f"part{number}", corners, instance.world_from_object, origin, looks[key], colored
                )
            materials.append(material)
    lights: dict = {"type": "scene"}
    for k, light in enumerate(data.lights):
        emitter = _shape_light(light, origin)
        if emitter is not None:
            lights[f"light{k}"] = emitter
    sky = _environment(data)
    if sky is not None:
        lights["sky"] = sky
    return MitsubaScene(geometry, lights, materials, frozenset(mirrors), size)


def parts_of(mesh) -> list[tuple[int, int, tuple]]:
    """(first triangle, triangle count, patches) of each part of a mesh."""
    if not mesh.parts:
        return [(0, len(mesh.triangles), ())]
    return [(part.first_triangle, part.triangle_count, part.patches) for part in mesh.parts]


def part_corners(mesh, first: int, count: int, patches) -> dict[str, np.ndarray | None]:
    """Attributes of a part corner by corner, [3 * triangles, n] each, object space; None where it has none."""
    own = slice(first, first + count)
    triangles = mesh.triangles[own]

    def taken(values, index):
        if values is None:
            return None
        chosen = triangles if index is None else index[own]
        return values[chosen.reshape(-1)].astype(np.float64)

    points = mesh.points[triangles.reshape(-1)].astype(np.float64)
    normals = taken(mesh.normals, mesh.normal_index)
    uvs, colors = taken(mesh.uvs, mesh.uv_index), taken(mesh.colors, mesh.color_index)
    curved = [patch for patch in patches if patch.shape is not None and patch.shape.kind == "quadric"]
    if not curved:
        return {"points": points, "normals": normals, "uvs": uvs, "colors": colors}
    # Gprims: the analytic surface, by patches.
    rows = [(patch, slice(3 * (patch.first_triangle - first), None)) for patch in patches]
    pieces: dict[str, list] = {"points": [], "normals": [], "uvs": [], "colors": []}
    for patch, start in rows:
        where = slice(start.start, start.start + 3 * patch.triangle_count)
        piece = {"points": points[where], "uvs": None if uvs is None else uvs[where]}
        piece["colors"] = None if colors is None else colors[where]
        if patch in curved:
            for _ in range(QUADRIC_SPLITS):
                piece = {name: None if v is None else _split(v) for name, v in piece.items()}
            piece["points"], piece["normals"] = _on_quadric(patch.shape, piece["points"])
        else:
            piece["normals"] = _facet_normals(piece["points"]) if normals is None else normals[where]
        for name, values in piece.items():
            if values is not None:
                pieces[name].append(values)
    return {name: np.concatenate(values) if values else None for name, values in pieces.items()}


def _split(corners: np.ndarray) -> np.ndarray:
    """Every triangle in four, at the middles of its edges."""
    a, b, c = corners.reshape(-1, 3, corners.shape[1]).transpose(1, 0, 2)
    ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
    return np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, corners.shape[1])


def _facet_normals(points: np.ndarray) -> np.ndarray:
    a, b, c = points.reshape(-1, 3, 3).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-300)
    return np.repeat(normal, 3, axis=0)


def _on_quadric(shape, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points moved onto x^2 + y^2 + a z^2 + b z = c at their height along the axis, and the unit normals there.

    Moving them across the axis alone keeps the rims of a cut surface where they are; at a pole, where there is no
    across, they move along the gradient.
    """
    m = np.asarray(shape.unit_from_object, np.float64)
    q = points @ m[:3, :3].T + m[:3, 3]
    for _ in range(PROJECTION_STEPS):
        value = q[:, 0] ** 2 + q[:, 1] ** 2 + shape.a * q[:, 2] ** 2 + shape.b * q[:, 2] - shape.c
        gradient = np.stack([2 * q[:, 0], 2 * q[:, 1], 2 * shape.a * q[:, 2] + shape.b], axis=1)
        inner = (q[:, 2] > shape.z_min + 1.0e-6) & (q[:, 2] < shape.z_max - 1.0e-6)
        along = np.where(inner[:, None], gradient, gradient * [1.0, 1.0, 0.0])
        square = np.einsum("ij,ij->i", gradient, along)
        q -= (value / np.where(square > 0.0, square, np.inf))[:, None] * along
    gradient = np.stack([q[:, 0], q[:, 1], shape.a * q[:, 2] + 0.5 * shape.b], axis=1)
    normal = gradient @ m[:3, :3]
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-300)
    back = np.linalg.inv(m)
    return q @ back[:3, :3].T + back[:3, 3], normal


def _mesh(name: str, corners: dict, world_from_object: np.ndarray, origin: np.ndarray, bsdf, colored: bool):
    linear = np.asarray(world_from_object, np.float64)[:3, :3]
    points = corners["points"] @ linear.T + (world_from_object[:3, 3] - origin)
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    count = len(points)
    mesh = mi.Mesh(name, count, count // 3, properties, corners["normals"] is not None, corners["uvs"] is not None)
    parameters = mi.traverse(mesh)
    # The parameters' own types: those of the variant.
    parameters["vertex_positions"] = _buffer(parameters["vertex_positions"], points)
    parameters["faces"] = _buffer(parameters["faces"], np.arange(count))
    if corners["normals"] is not None:
        normals = corners["normals"] @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1.0e-300)
        parameters["vertex_normals"] = _buffer(parameters["vertex_normals"], normals)
    if corners["uvs"] is not None:
        parameters["vertex_texcoords"] = _buffer(parameters["vertex_texcoords"], corners["uvs"])
    parameters.update()
    if colored:
        mesh.add_attribute("vertex_color", 3, corners["colors"].astype(np.float32).ravel())
    return mesh


def _buffer(like, values: np.ndarray):
    kind = type(like)
    return kind(np.ascontiguousarray(values.ravel(), np.uint32 if "UInt" in kind.__name__ else np.float32))


def _surface(material, colored: bool, mirror: bool, pictures: _Pictures) -> dict:
    """A Lambert surface on both sides; of a metal that mirrors, the ideal mirror."""
    color: dict = {"type": "rgb", "value": [float(v) for v in material.base_color]}
    if colored:
        color = {"type": "mesh_attribute", "name": "vertex_color"}
    if "base_color" in material.textures:
        color = pictures.bitmap(material.textures["base_color"], 1.0) or color
    if mirror and material.metallic >= 0.5:
        return {"type": "twosided", "bsdf": {"type": "conductor", "material": "none", "specular_reflectance": color}}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}


class _Pictures:
    """Picture files as Mitsuba's textures, each read once."""

    def __init__(self):
        self.read: dict[tuple, np.ndarray | None] = {}

    def bitmap(self, texture, ceiling: float = np.inf) -> dict | None:
        """The dictionary of a texture, values clipped to 0..ceiling; None where it cannot be read."""
        key = (texture.file, texture.color_space)
        if key not in self.read:
            try:
                self.read[key] = _linear_picture(*key)
            except (OSError, RuntimeError) as fault:
                print(f"{texture.file}: {' '.join(str(fault).split())[:120]}; its fallback is used", file=sys.stderr)
                self.read[key] = None
        texels = self.read[key]
        if texels is None:
            return None
        channels = [0, 1, 2] if texture.channel == "rgb" else ["rgba".index(texture.channel)] * 3
        if texels.shape[2] < 3:  # grey, with or without alpha
            channels = [texels.shape[2] - 1 if texture.channel == "a" else 0] * 3
        values = texels[..., channels] * np.array(texture.scale)[channels] + np.array(texture.bias)[channels]
        wraps = {"mirror": "mirror", "clamp": "clamp", "black": "clamp"}
        if texture.wrap[0] != texture.wrap[1] or "black" in texture.wrap:
            print(f"{texture.file}: wrap modes {texture.wrap} are approximated", file=sys.stderr)
        # Mitsuba's v runs downwards from the picture's first row.
        to_uv = np.array([*texture.uv_from_st, (0.0, 0.0, 1.0)], np.float64)
        to_uv[1] = np.array([0.0, 0.0, 1.0]) - to_uv[1]
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(np.ascontiguousarray(np.clip(values, 0.0, ceiling), np.float32)),
            "raw": True,
            "wrap_mode": wraps.get(texture.wrap[0], "repeat"),
            "to_uv": mi.ScalarTransform3f(to_uv),
        }


def _linear_picture(file: str, color_space: str) -> np.ndarray:
    """Texels of a file as linear Rec.709, float32 [h, w, channels]."""
    with tempfile.TemporaryDirectory(prefix="mitsuba_scene_") as folder:
        if file.endswith("]"):
            package, _, inner = file[:-1].partition("[")
            with zipfile.ZipFile(package) as archive:
                file = archive.extract(inner, folder)
        bitmap = mi.Bitmap(str(file))
    texels = np.array(bitmap)
    texels = texels[..., None] if texels.ndim == 2 else texels
    if texels.dtype.kind == "u":
        eight_bit = texels.dtype.itemsize == 1
        values = texels.astype(np.float32) / np.iinfo(texels.dtype).max
        colors = min(texels.shape[2], 3) if texels.shape[2] != 2 else 1
        if color_space == "sRGB" or (color_space == "auto" and eight_bit and colors == 3):
            part = values[..., :colors]
            values[..., :colors] = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
        return values
    values = texels.astype(np.float32)
    if color_space == "auto" and values.shape[2] >= 3:
        primaries = REC709_PRIMARIES
        if "chromaticities" in bitmap.metadata():
            primaries = [float(v) for v in np.ravel(bitmap.metadata()["chromaticities"])]
        elif "acescg" in Path(file).name.lower():
            primaries = AP1_PRIMARIES
        values[..., :3] = values[..., :3] @ _rec709_from(primaries).T.astype(np.float32)
    return values


def _rec709_from(primaries) -> np.ndarray:
    """Matrix between linear colours, white to white.

    Source: SMPTE RP 177, Derivation of Basic Television Color Equations, 1993, section 3.3.
    """

    def xyz_from(chromaticities) -> np.ndarray:
        x, y = np.reshape(chromaticities, (4, 2)).T
        columns = np.stack([x, y, 1.0 - x - y]) / y
        return columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])

    ours, theirs = xyz_from(REC709_PRIMARIES), xyz_from(primaries)
    # Bradford's adaptation of the white points.
    cone = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    gain = (cone @ ours.sum(axis=1)) / (cone @ theirs.sum(axis=1))
    return np.linalg.inv(ours) @ np.linalg.inv(cone) @ np.diag(gain) @ cone @ theirs


def _sensor(camera, size: tuple[int, int], samples: int) -> dict:
    """A UsdGeomCamera at the origin; the aperture is widened so that pixels are square."""
    width, height = size
    axes = np.asarray(camera.world_from_camera, np.float64)[:3, :3]
    axes = axes / np.linalg.norm(axes, axis=0)
    to_world = np.eye(4)
    # Mitsuba's cameras look along +Z and have +X on the left.
    to_world[:3, :3] = axes * [-1.0, 1.0, -1.0]
    aperture = max(camera.horizontal_aperture, camera.vertical_aperture * width / height)
    sensor = {
        "to_world": mi.ScalarTransform4f(to_world),
        "near_clip": max(float(camera.near), 1.0e-6),
        "far_clip": float(camera.far),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": samples},
    }
    if camera.projection == "orthographic":
        half = 0.05 * aperture  # apertures are tenths of a scene unit
        to_world[:3, 3] = 0.1 * axes @ [camera.horizontal_offset, camera.vertical_offset, 0.0]
        to_world = to_world @ np.diag([half, half, 1.0, 1.0])
        return {**sensor, "type": "orthographic", "to_world": mi.ScalarTransform4f(to_world)}
    return {
        **sensor,
        "type": "perspective",
        "fov_axis": "x",
        "fov": float(np.degrees(2.0 * np.arctan(0.5 * aperture / camera.focal_length))),
        "principal_point_offset_x": float(camera.horizontal_offset) / aperture,
        "principal_point_offset_y": -float(camera.vertical_offset) / (aperture * height / width),
    }


def _shape_light(light, origin: np.ndarray) -> dict | None:
    """A distant light or a shape that emits; None for domes."""
    world = np.array(light.world_from_light, np.float64)
    world[:3, 3] -= origin
    color = [float(v) for v in light.color]
    if light.kind == "distant":
        axis = -world[:3, 2] / np.linalg.norm(world[:3, 2])
        return {"type": "directional", "direction": axis.tolist(), "irradiance": {"type": "rgb", "value": color}}
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": color}}
    if light.kind == "sphere":
        scale = abs(np.linalg.det(world[:3, :3])) ** (1.0 / 3.0)
        return {
            "type": "sphere",
            "center": world[:3, 3].tolist(),
            "radius": float(light.size[0] * scale),
            "emitter": emitter,
        }
    if light.kind == "cylinder":
        half = 0.5 * light.size[0] * world[:3, 0]
        scales = np.linalg.norm(world[:3, :3], axis=0)
        return {
            "type": "cylinder",
            "p0": (world[:3, 3] - half).tolist(),
            "p1": (world[:3, 3] + half).tolist(),
            "radius": float(light.size[1] * 0.5 * (scales[1] + scales[2])),
            "emitter": emitter,
        }
    if light.kind in ("rect", "disk"):
        half = 0.5 * np.array(light.size) if light.kind == "rect" else np.array([light.size[0]] * 2)
        # Mitsuba's emit along +Z.
        to_world = world @ np.diag([half[0], -half[1], -1.0, 1.0])
        kind = "rectangle" if light.kind == "rect" else "disk"
        return {"type": kind, "to_world": mi.ScalarTransform4f(to_world), "emitter": emitter}
    return None


def _environment(data) -> dict | None:
    """All domes as one emitter (Mitsuba has one); the grey dome where a stage has no light at all."""
    domes = [light for light in data.lights if light.kind == "dome"]
    textured = [light for light in domes if light.texture is not None]
    plain = np.sum([light.color for light in domes if light.texture is None], axis=0) + np.zeros(3)
    if not data.lights:
        rows = ENVIRONMENT_ROWS
        up = _latlong_directions(rows)[..., "XYZ".index(data.up_axis)]
        return _envmap(np.repeat((DEFAULT_SKY + DEFAULT_SLOPE * up)[..., None], 3, axis=2), np.eye(3))
    if not textured:
        return {"type": "constant", "radiance": {"type": "rgb", "value": plain.tolist()}} if plain.any() else None
    if len(textured) == 1:
        light = textured[0]
        return _envmap(light.texture * np.asarray(light.color) + plain, light.world_from_light[:3, :3])
    world = _latlong_directions(ENVIRONMENT_ROWS)
    total = np.broadcast_to(plain, world.shape).copy()
    for light in textured:
        axes = light.world_from_light[:3, :3] / np.linalg.norm(light.world_from_light[:3, :3], axis=0)
        x, y, z = np.moveaxis(world @ axes, -1, 0)
        height, width = light.texture.shape[:2]
        column = ((0.5 - np.arctan2(x, z) / (2.0 * np.pi)) * width).astype(int) % width
        row = np.minimum((np.arccos(np.clip(y, -1.0, 1.0)) / np.pi * height).astype(int), height - 1)
        total += light.texture[row, column] * np.asarray(light.color)
    return _envmap(total, np.eye(3))


def _latlong_directions(rows: int) -> np.ndarray:
    """Unit directions of a latlong map's texels in OpenEXR orientation, [rows, 2 rows, 3]."""
    lat = (0.5 - (np.arange(rows) + 0.5) / rows)[:, None] * np.pi
    lon = (1.0 - (np.arange(2 * rows) + 0.5) / rows)[None, :] * np.pi
    return np.stack(np.broadcast_arrays(np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)), axis=-1)


def _envmap(texels: np.ndarray, axes: np.ndarray) -> dict:
    to_world = np.eye(4)
    to_world[:3, :3] = np.asarray(axes, np.float64) / np.linalg.norm(axes, axis=0)
    bitmap = mi.Bitmap(np.ascontiguousarray(texels, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": mi.ScalarTransform4f(to_world)}


def direct_picture(
    made: MitsubaScene, samples: int, shadows: str = "none", centred: bool = False, seed: int = 0
) -> np.ndarray:
    """The picture by direct light and one mirror image, from Mitsuba's rays, textures, surfaces and lights.

    Lights are neither seen nor cast shadows themselves. A mirror seen in a mirror mirrors the environment.

    Args:
        made: From `convert`, with a vectorised variant set.
        samples: Light samples a pixel.
        shadows: Of which lights surfaces cast shadows: `none`, `lights` (all but the environment) or `all`.
        centred: Eye rays through the pixels' centres instead of all over them.
        seed: Of the samples.

    Returns:
        Linear radiance, float32 [height, width, 3].
    """
    import drjit as dr

    geometry, lights, tables = made.loaded
    sensor = geometry.sensors()[0]
    width, height = made.size
    total = np.zeros((height, width, 3))
    passes = max(samples // SAMPLES_PER_PASS, 1)
    each = min(samples, SAMPLES_PER_PASS)
    for number in range(passes):
        lane = dr.arange(mi.UInt32, width * height * each)
        pixel = lane // each
        sampler = _Sequence(pixel, dr.opaque(mi.UInt32, number * each) + lane % each, dr.opaque(mi.UInt32, seed))
        place = mi.Vector2f(mi.Float(pixel % width), mi.Float(pixel // width))
        place += mi.Vector2f(0.5) if centred else sampler.next_2d()
        ray, _ = sensor.sample_ray(0.0, 0.5, place / mi.Vector2f(width, height), mi.Point2f(0.5))
        radiance = _radiance(geometry, lights, tables, sampler, mi.Ray3f(ray), shadows, mi.Bool(True), 0)
        mean = dr.block_sum(dr.ravel(radiance.x), each), dr.block_sum(radiance.y, each), dr.block_sum(radiance.z, each)
        total += np.stack([np.array(channel) for channel in mean], axis=-1).reshape(height, width, 3) / each
    return (total / passes).astype(np.float32)


class _Sequence:
    """Well spread points of the unit square: multiples of square roots of primes, shifted at random for each pixel.

    Source: Richtmyer, The Evaluation of Definite Integrals, 1951; Cranley and Patterson, Randomization of Number
    Theoretic Methods for Multiple Integration, 1976.
    """

    def __init__(self, pixel, index, seed):
        import drjit as dr

        self.pixel, self.index, self.axis, self.seed = pixel, mi.Float64(index), 0, seed
        self.primes = [p for p in range(2, 1000) if all(p % q for q in range(2, int(p**0.5) + 1))]
        self.fraction = lambda x: x - dr.floor(x)

    def _next(self):
        start, _ = mi.sample_tea_32(self.pixel, self.axis + len(self.primes) * self.seed)
        step = float(np.sqrt(self.primes[self.axis % len(self.primes)]))
        self.axis += 1
        return mi.Float(self.fraction(self.index * step + mi.Float64(start) * 2.0**-32))

    def next_2d(self):
        """The next two dimensions."""
        return mi.Point2f(self._next(), self._next())


def _tables(geometry, made: MitsubaScene) -> dict:
    """Mirror parameters by the shapes' registry numbers, and the emissive parts."""
    import drjit as dr

    numbers = {}
    for shape in geometry.shapes():
        registry = int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])
        numbers[int(shape.id().removeprefix("part"))] = registry
    length = max(numbers.values(), default=0) + 1
    columns = {name: np.zeros(length, np.float32) for name in ("mirror", "metallic", "dielectric", "coat")}
    emissive = []
    pictures = _Pictures()
    for part, registry in numbers.items():
        material = made.materials[part]
        columns["mirror"][registry] = part in made.mirrors
        columns["metallic"][registry] = material.metallic
        columns["dielectric"][registry] = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
        columns["coat"][registry] = material.clearcoat
        if "emissive" in material.textures:
            found = pictures.bitmap(material.textures["emissive"])
            if found is not None:
                emissive.append((registry, mi.load_dict(found)))
                continue
        if max(material.emissive) > 0.0:
            emissive.append((registry, mi.Color3f(*(float(v) for v in material.emissive))))
    return {name: mi.Float(values) for name, values in columns.items()} | {"emissive": emissive}


def _radiance(geometry, lights, tables, sampler, ray, shadows: str, active, level: int):
    """Radiance back along rays; a mirror's image at level 0, the environment's alone in it at level 1."""
    import drjit as dr

    si = geometry.ray_intersect(ray, active)
    hit = active & si.is_valid()
    result = dr.select(active & ~hit, _sky(lights, ray.d), mi.Color3f(0.0))
    number = dr.select(hit, dr.reinterpret_array(mi.UInt32, si.shape), 0)
    values = {name: dr.gather(mi.Float, tables[name], number, hit) for name in ("metallic", "dielectric", "coat")}
    mirror = hit & (dr.gather(mi.Float, tables["mirror"], number, hit) > 0.0)
    for registry, emission in tables["emissive"]:
        own = hit & (number == registry)
        value = emission if isinstance(emission, mi.Color3f) else emission.eval(si, own)
        result += dr.select(own, value, mi.Color3f(0.0))

    normal = dr.normalize(si.sh_frame.n)
    normal = dr.select(dr.dot(normal, ray.d) > 0.0, -normal, normal)
    cosine = dr.abs(dr.dot(normal, ray.d))
    color = mi.Color3f(si.bsdf(ray).eval_diffuse_reflectance(si, hit))
    # A mirror's split between its image and its base; UsdPreviewSurface's F0 and F90 with Schlick's curve between.
    fade = (1.0 - cosine) ** 5
    f0 = (1.0 - values["metallic"]) * values["dielectric"] + values["metallic"] * color
    f90 = 1.0 - values["metallic"] + values["metallic"] * color
    image = f0 + fade * (f90 - f0)
    coat = values["coat"] * (values["dielectric"] + fade * (1.0 - values["dielectric"]))
    albedo = dr.select(mirror, (1.0 - coat) * (f90 - image) * color, color)
    image = dr.select(mirror, (1.0 - coat) * image + coat, mi.Color3f(0.0))

    for light in lights.emitters():
        sample, weight = light.sample_direction(si, sampler.next_2d(), hit)
        facing = dr.dot(normal, sample.d)
        seen = hit & (sample.pdf > 0.0) & (facing > 0.0)
        flags = light.flags()
        distant = mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        around = mi.has_flag(flags, mi.EmitterFlags.Infinite) and not distant
        if shadows == "all" or (shadows == "lights" and not around):
            shadow = si.spawn_ray(sample.d)
            if not (distant or mi.has_flag(flags, mi.EmitterFlags.Infinite)):
                shadow.maxt = sample.dist * (1.0 - NEAREST_HIT)
            seen &= ~geometry.ray_test(shadow, seen)
        result += dr.select(seen, albedo * mi.Color3f(weight) * facing / dr.pi, mi.Color3f(0.0))
    if dr.any(mirror):
        onward = ray.d - 2.0 * dr.dot(normal, ray.d) * normal
        if level == 0:
            behind = _radiance(geometry, lights, tables, sampler, si.spawn_ray(onward), shadows, mirror, 1)
        else:
            behind = _sky(lights, onward)
        result += dr.select(mirror, image * behind, mi.Color3f(0.0))
    return result


def _sky(lights, direction):
    import drjit as dr

    sky = lights.environment()
    if sky is None:
        return mi.Color3f(0.0)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    si.wi = -direction
    return mi.Color3f(sky.eval(si))
