"""Radiance cube maps of a scene: drawn by the rasteriser, shaded as what mirrors see is, looked up without seams.

Orientation of faces as OpenEXR's cubes (`cubemap.RADIANCE_AXES`), texel-centred. A map knows its eye, the radiance and the
triangle of each texel, and the distance to it along the texel's own ray, 0 where there is only sky. Sky is not stored:
texels carry coverage, and what is not covered is the domes' own radiance from the direction asked for, at their resolution.

A look-up is bilinear over the edges of the faces: beyond an edge lies the neighbouring face's texel; beyond a corner of the
cube, where three faces meet, the mean of the three.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import numpy as np
import warp as wp

from warp_reflect import launch, raster, shade
from warp_reflect.cubemap import FACE_COUNT, RADIANCE_AXES, radiance_direction, radiance_point
from warp_reflect.layers import Camera, CameraView, GBuffer, MirrorPixels, ReflectionLayer, eye_ray_direction
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Technique
from warp_reflect.shade import LightView, dome_radiance
from warp_reflect.shadows import Shadows
from warp_reflect.shapes import clamp_weights, intersect_triangle, unit

wp.set_module_options({"enable_backward": False})

# Of the scene's size: what is nearer to a map's eye is not drawn. Far below a texel of what is worth a mirror's picture.
NEAR_SHARE = 1.0e-5
FAR_SLACK = 1.01  # times the distance of the farthest corner: nothing is clipped there
RESOLUTION_MAX = 4096  # texels along a cube edge; look-ups beyond an edge count in halves of them
COVERED = wp.constant(1.0 - 1.0e-6)  # coverage from here on is whole: four weights add up to 1 within roundings
SKY = wp.constant(0.0)  # distance of a texel without a surface

# Packed texels: 32 bits. From above: distance 13 (0: sky), luma 9 (0: black), both logarithmic on a range of their map, and
# 10 of a number in its map's palette of chromaticities. 13 bits of the distance's logarithm are 1e-3 of it over a range of
# 1 : 3000, half the depth test's slack; 9 bits of luma over 12 stops are 1.6 %.
DISTANCE_CODES = 8190
LUMA_CODES = 510
PALETTE = wp.constant(1024)
PALETTE_GRID = 512  # cells along each axis of the chromaticities, halved until no more are met than the palette holds
LUMA_STOPS = 12.0  # below a map's brightest texel; darker is stored as this


@wp.struct
class PackedRange:
    """What the codes of one map's packed texels mean: logarithm = low + step * (code - 1)."""

    distance_low: float
    distance_step: float
    luma_low: float
    luma_step: float


@wp.struct
class CubeMapsView:
    """Cube maps of one resolution. Texel (map k, level l, face, y, x): k map_texels + level_first[l] + (face n + y) n + x."""

    resolution: int
    map_texels: int  # of one map, all levels
    level_count: int
    level_first: wp.array(dtype=int)
    level_size: wp.array(dtype=int)
    radiance: wp.array(dtype=wp.vec4)  # RGB times coverage, coverage; length 0 where texels are packed
    distance: wp.array(dtype=float)  # of the finest level: k 6 n n + (face n + y) n + x
    triangle: wp.array(dtype=int)  # likewise; length 0 where it is not known
    packed: wp.array(dtype=wp.uint32)
    ranges: wp.array(dtype=PackedRange)
    palette: wp.array(dtype=wp.vec2)  # PALETTE of every map: shares of red and blue in the sum of the three
    centre: wp.array(dtype=wp.vec3)  # scene frame
    map_from_world: wp.array(dtype=wp.mat33)


@dataclass(frozen=True)
class CubeMaps:
    """Radiance cube maps of one resolution on a device.

    Attributes:
        view: For kernels.
        centres: Their eyes, world, float64 [count, 3].
        axes: Columns are a map's axes, world, float64 [count, 3, 3].
        filtered: What finishes made of them, `finishes.glossy_prefiltered.Levels`.
    """

    view: CubeMapsView
    centres: np.ndarray
    axes: np.ndarray
    filtered: list = field(default_factory=list, compare=False, repr=False)

    @property
    def count(self) -> int:
        return len(self.centres)

    @property
    def resolution(self) -> int:
        """Texels along a cube edge."""
        return self.view.resolution

    @property
    def bytes(self) -> int:
        """Memory of the texels, all maps."""
        view = self.view
        arrays = (view.radiance, view.distance, view.triangle, view.packed, view.palette)
        return sum(len(array) * wp.types.type_size_in_bytes(array.dtype) for array in arrays)

    def radiance(self, k: int, level: int = 0) -> np.ndarray:
        """RGB times coverage, and coverage, of map k, float32 [6, n, n, 4]; not of packed maps."""
        n = int(self.view.level_size.numpy()[level])
        first = k * self.view.map_texels + int(self.view.level_first.numpy()[level])
        return self.view.radiance.numpy()[first : first + FACE_COUNT * n * n].reshape(FACE_COUNT, n, n, 4)

    def distance(self, k: int) -> np.ndarray:
        """Distance of every texel of map k, 0 sky, float32 [6, n, n]; not of packed maps."""
        return self._finest(self.view.distance, k)

    def triangle(self, k: int) -> np.ndarray:
        """Triangle of every texel of map k, -1 sky, int32 [6, n, n]; only of maps that were drawn here."""
        return self._finest(self.view.triangle, k)

    def _finest(self, array: wp.array, k: int) -> np.ndarray:
        n = self.resolution
        count = FACE_COUNT * n * n
        return array.numpy()[k * count : (k + 1) * count].reshape(FACE_COUNT, n, n)

    def at(self, scene: Scene) -> CubeMaps:
        """The same maps in the frame of the same stage's scene at another time."""
        view = _copied(self.view)
        view.centre = _vectors(self.centres - scene.origin, scene.device)
        view.triangle = wp.empty(0, dtype=int, device=scene.device)  # numbers of another scene
        return CubeMaps(view, self.centres, self.axes)


@wp.func
def texel_index(face: int, x: int, y: int, n: int) -> int:
    """Index within its level of a texel that may lie one beyond the edge of its face (but not beyond a corner)."""
    if x >= 0 and y >= 0 and x < n and y < n:
        return (face * n + y) * n + x
    size = float(n)
    u = (2.0 * float(x) + 1.0) / size - 1.0
    v = (2.0 * float(y) + 1.0) / size - 1.0
    point = radiance_point(radiance_direction(face, u, v))
    column = wp.clamp(int(0.5 * (point.u + 1.0) * size), 0, n - 1)
    row = wp.clamp(int(0.5 * (point.v + 1.0) * size), 0, n - 1)
    return (point.face * n + row) * n + column


@wp.func
def unpack_radiance(maps: CubeMapsView, k: int, code: wp.uint32) -> wp.vec4:
    """RGB and coverage of a packed texel."""
    if (code >> wp.uint32(19)) == wp.uint32(0):
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    luma = int((code >> wp.uint32(10)) & wp.uint32(0x1FF))
    if luma == 0:
        return wp.vec4(0.0, 0.0, 0.0, 1.0)
    total = wp.exp(maps.ranges[k].luma_low + maps.ranges[k].luma_step * float(luma - 1))
    share = maps.palette[k * PALETTE + int(code & wp.uint32(0x3FF))]
    return wp.vec4(total * share[0], total * (1.0 - share[0] - share[1]), total * share[1], 1.0)


@wp.func
def unpack_distance(code: wp.uint32, r: PackedRange) -> float:
    """Distance of a packed texel, 0 sky."""
    number = int(code >> wp.uint32(19))
    if number == 0:
        return SKY
    return wp.exp(r.distance_low + r.distance_step * float(number - 1))


@wp.func
def texel_radiance(maps: CubeMapsView, k: int, level: int, index: int) -> wp.vec4:
    if maps.packed.shape[0] > 0:
        return unpack_radiance(maps, k, maps.packed[k * maps.map_texels + index])
    return maps.radiance[k * maps.map_texels + maps.level_first[level] + index]


@wp.func
def fetch_level(maps: CubeMapsView, k: int, level: int, direction: wp.vec3) -> wp.vec4:
    """Bilinear look-up in one level of map k by a direction in its axes: RGB times coverage, coverage."""
    n = maps.level_size[level]
    point = radiance_point(direction)
    x = 0.5 * (point.u + 1.0) * float(n) - 0.5
    y = 0.5 * (point.v + 1.0) * float(n) - 0.5
    x_floor = wp.floor(x)
    y_floor = wp.floor(y)
    fx = x - x_floor
    fy = y - y_floor
    x0 = int(x_floor)
    y0 = int(y_floor)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    plain = wp.vec4(0.0, 0.0, 0.0, 0.0)
    missing = float(0.0)
    tap = int(0)
    while tap < 4:
        column = x0 + (tap & 1)
        row = y0 + (tap >> 1)
        weight = wp.where((tap & 1) == 1, fx, 1.0 - fx) * wp.where((tap >> 1) == 1, fy, 1.0 - fy)
        if (column < 0 or column >= n) and (row < 0 or row >= n):
            missing = weight
        else:
            value = texel_radiance(maps, k, level, texel_index(point.face, column, row, n))
            total += weight * value
            plain += value
        tap += 1
    if missing > 0.0:
        total += (missing / 3.0) * plain
    return total


@wp.func
def fetch_covered(maps: CubeMapsView, k: int, direction: wp.vec3, level: float) -> wp.vec4:
    """RGB times coverage, and coverage, of map k from a world direction of any length but zero.

    `level` 0 is the finest; between levels of a map that has them it is interpolated.
    """
    d = maps.map_from_world[k] * direction
    height = wp.clamp(level, 0.0, float(maps.level_count - 1))
    lower = int(height)
    share = height - float(lower)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    # A loop, so that the look-up is compiled once.
    step = int(0)
    while step < 2:
        weight = wp.where(step == 0, 1.0 - share, share)
        if weight > 0.0:
            total += weight * fetch_level(maps, k, lower + step, d)
        step += 1
    return total


@wp.func
def fetch_radiance(maps: CubeMapsView, lights: LightView, k: int, direction: wp.vec3, level: float) -> wp.vec3:
    """Radiance that map k has for a unit world direction; where nothing is in the way that of the domes."""
    value = fetch_covered(maps, k, direction, level)
    radiance = wp.vec3(value[0], value[1], value[2])
    if value[3] < COVERED:
        radiance += (1.0 - value[3]) * dome_radiance(lights, direction)
    return radiance


@wp.func
def nearest_texel(maps: CubeMapsView, k: int, direction: wp.vec3) -> int:
    """Index within the finest level of the texel of map k that a world direction falls into."""
    n = maps.resolution
    point = radiance_point(maps.map_from_world[k] * direction)
    x = wp.clamp(int(0.5 * (point.u + 1.0) * float(n)), 0, n - 1)
    y = wp.clamp(int(0.5 * (point.v + 1.0) * float(n)), 0, n - 1)
    return (point.face * n + y) * n + x


@wp.func
def texel_distance(maps: CubeMapsView, k: int, index: int) -> float:
    """Distance of a texel of the finest level of map k, 0 sky."""
    if maps.packed.shape[0] > 0:
        return unpack_distance(maps.packed[k * maps.map_texels + index], maps.ranges[k])
    return maps.distance[k * FACE_COUNT * maps.resolution * maps.resolution + index]


@wp.kernel
def texel_hits_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    triangle: wp.array(dtype=int),
    # Outputs:
    out_point: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
):
    """One thread per texel of a face: what its ray meets."""
    i = first + wp.tid()
    row = i / camera[0].width
    ray = unit(eye_ray_direction(camera[0], float(i - row * camera[0].width) + 0.5, float(row) + 0.5))
    out_direction[i] = ray
    tri = triangle[i]
    if tri < 0:
        return
    corner = scene.triangles[tri]
    a = scene.points[corner[0]] - camera[0].eye
    b = scene.points[corner[1]] - camera[0].eye
    c = scene.points[corner[2]] - camera[0].eye
    hit = intersect_triangle(wp.vec3(0.0, 0.0, 0.0), ray, a, b, c)
    weights = clamp_weights(hit.u, hit.v)
    if hit.det == 0.0:
        weights = wp.vec2(1.0 / 3.0, 1.0 / 3.0)
    p = (1.0 - weights[0] - weights[1]) * a + weights[0] * b + weights[1] * c
    out_point[i] = camera[0].eye + p
    out_u[i] = weights[0]
    out_v[i] = weights[1]
    out_distance[i] = wp.max(wp.length(p), 1.0e-30)


@wp.kernel
def store_texels_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    radiance: wp.array(dtype=wp.vec3),
    distance: wp.array(dtype=float),
    first_texel: int,
    first_finest: int,
    out_maps: CubeMapsView,
):
    """One thread per texel of a face; a value that is not finite is stored as black."""
    i = first + wp.tid()
    value = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if triangle[i] >= 0:
        r = radiance[i]
        if not (wp.isfinite(r[0]) and wp.isfinite(r[1]) and wp.isfinite(r[2])):
            r = wp.vec3(0.0, 0.0, 0.0)
        value = wp.vec4(r[0], r[1], r[2], 1.0)
    out_maps.radiance[first_texel + i] = value
    out_maps.distance[first_finest + i] = wp.where(triangle[i] >= 0, distance[i], SKY)
    out_maps.triangle[first_finest + i] = triangle[i]


@wp.kernel
def coarser_level_kernel(first: int, level: int, out_maps: CubeMapsView):
    """One thread per texel of a level above the finest: the mean of the square that it covers, edges by their share."""
    i = first + wp.tid()
    n = out_maps.level_size[level]
    m = out_maps.level_size[level - 1]
    k = i / (FACE_COUNT * n * n)
    rest = i - k * FACE_COUNT * n * n
    face = rest / (n * n)
    y = (rest - face * n * n) / n
    x = rest - face * n * n - y * n
    ratio = float(m) / float(n)
    left = float(x) * ratio
    top = float(y) * ratio
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    row = int(top)
    while row < m and float(row) < top + ratio:
        height = wp.min(float(row + 1), top + ratio) - wp.max(float(row), top)
        column = int(left)
        while column < m and float(column) < left + ratio:
            width = wp.min(float(column + 1), left + ratio) - wp.max(float(column), left)
            total += (wp.max(width, 0.0) * wp.max(height, 0.0)) * texel_radiance(
                out_maps, k, level - 1, (face * m + row) * m + column
            )
            column += 1
        row += 1
    out_maps.radiance[k * out_maps.map_texels + out_maps.level_first[level] + rest] = total / (ratio * ratio)


@wp.kernel
def sample_kernel(
    first: int,
    maps: CubeMapsView,
    lights: LightView,
    k: int,
    direction: wp.array(dtype=wp.vec3),
    level: float,
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per direction."""
    i = first + wp.tid()
    out_radiance[i] = fetch_radiance(maps, lights, k, direction[i], level)


# Changes the radiance (vec3 [texels]) that the texels of a face see, given what they see as a mirror's layer.
Onward = Callable[[GBuffer, ReflectionLayer, wp.array], None]


def render_maps(
    scene: Scene,
    centres: np.ndarray,
    resolution: int,
    *,
    axes: np.ndarray | None = None,
    without: Sequence[Collection[int]] = (),
    onward: Onward | None = None,
    levels: bool = False,
    shadows: Shadows | None = None,
    threads: int = 0,
    kernels: str = "auto",
) -> CubeMaps:
    """Draw the cube maps of a scene at many places in one go.

    Args:
        scene: What they show, shaded as what a mirror sees (`shade.seen_radiance`).
        centres: Their eyes, world, shape [count, 3].
        resolution: Texels along a cube edge, 1 to 4096.
        axes: Columns are a map's axes in the world, shape [count, 3, 3]; None: the world's.
        without: Per map the parts that it leaves out, indices into `scene.parts`; empty: every map shows all.
        onward: Gives mirrors in the maps what they show; None: the domes.
        levels: Coarser levels for blurred look-ups, a third more memory.
        shadows: Which lights cast shadows; None: none.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Raises:
        ValueError: a resolution or centres that cannot be.
    """
    centres = np.asarray(centres, np.float64).reshape(-1, 3)
    if not 1 <= resolution <= RESOLUTION_MAX:
        raise ValueError(f"resolution: got {resolution}, expected 1 to {RESOLUTION_MAX} texels")
    if not np.isfinite(centres).all():
        raise ValueError("centres: expected finite points")
    axes = np.tile(np.eye(3), (len(centres), 1, 1)) if axes is None else np.asarray(axes, np.float64)
    maps = empty_maps(scene, centres, axes, resolution, levels)
    for k, centre in enumerate(centres):
        for face in range(FACE_COUNT):
            camera = face_camera(scene, centre, axes[k], face, resolution)
            gone = without[k] if without else ()
            _draw_face(scene, camera, maps, k, face, gone, onward, shadows, threads, kernels)
    for level in range(1, maps.view.level_count):
        n = int(maps.view.level_size.numpy()[level])
        count = maps.count * FACE_COUNT * n * n
        launch.launch(coarser_level_kernel, count, [level, maps.view], scene.device, threads)
    return maps


def stored_maps(
    scene: Scene, centres: np.ndarray, axes: np.ndarray, radiance: np.ndarray, distance: np.ndarray
) -> CubeMaps:
    """Maps from arrays that were kept.

    Args:
        scene: Whose frame and device they get.
        centres, axes: As `CubeMaps` has them.
        radiance: RGB times coverage, coverage; float32 [count, 6, n, n, 4].
        distance: 0 sky, float32 [count, 6, n, n].
    """
    maps = empty_maps(scene, centres, axes, radiance.shape[2])
    maps.view.radiance.assign(np.ascontiguousarray(radiance, np.float32).reshape(-1, 4))
    maps.view.distance.assign(np.ascontiguousarray(distance, np.float32).reshape(-1))
    maps.view.triangle = wp.empty(0, dtype=int, device=scene.device)
    return maps


def pack_maps(maps: CubeMaps) -> CubeMaps:
    """The finest levels at 4 bytes a texel, without triangles."""
    device = maps.view.distance.device
    packed = [_packed_map(maps, k) for k in range(maps.count)]
    view = _copied(maps.view)
    view.map_texels = FACE_COUNT * maps.resolution**2
    view.level_count = 1
    view.packed = wp.array(np.concatenate([codes for codes, _, _ in packed]), dtype=wp.uint32, device=device)
    view.ranges = wp.array([bounds for _, bounds, _ in packed], dtype=PackedRange, device=device)
    view.palette = wp.array(np.concatenate([colors for _, _, colors in packed]), dtype=wp.vec2, device=device)
    view.radiance = wp.empty(0, dtype=wp.vec4, device=device)
    view.distance = wp.empty(0, dtype=float, device=device)
    view.triangle = wp.empty(0, dtype=int, device=device)
    return CubeMaps(view, maps.centres, maps.axes)


def look_up(
    scene: Scene, maps: CubeMaps, k: int, directions: wp.array, level: float = 0.0, threads: int = 0
) -> wp.array:
    """Radiance that a map has for directions.

    Args:
        scene: Its domes are the sky.
        maps: The maps.
        k: Which of them.
        directions: vec3, world axes, unit.
        level: Of the coarser levels, 0 the finest.
        threads: CPU threads; 0: one per core.

    Returns:
        vec3 as many, linear Rec.709.
    """
    radiance = wp.empty(len(directions), dtype=wp.vec3, device=scene.device)
    inputs = [maps.view, scene.lights, k, directions, float(level), radiance]
    launch.launch(sample_kernel, len(directions), inputs, scene.device, threads)
    return radiance


def empty_maps(scene: Scene, centres: np.ndarray, axes: np.ndarray, resolution: int, levels: bool = False) -> CubeMaps:
    """Maps to be filled; arguments as for `render_maps`."""
    sizes = [resolution]
    while levels and sizes[-1] > 1:
        sizes.append(sizes[-1] // 2)
    counts = [FACE_COUNT * n * n for n in sizes]
    device, count = scene.device, len(centres)
    view = CubeMapsView()
    view.resolution, view.map_texels, view.level_count = resolution, sum(counts), len(sizes)
    view.level_first = wp.array(np.cumsum([0, *counts[:-1]]).astype(np.int32), dtype=int, device=device)
    view.level_size = wp.array(np.array(sizes, np.int32), dtype=int, device=device)
    view.radiance = wp.empty(count * view.map_texels, dtype=wp.vec4, device=device)
    view.distance = wp.empty(count * counts[0], dtype=float, device=device)
    view.triangle = wp.empty(count * counts[0], dtype=int, device=device)
    view.packed = wp.empty(0, dtype=wp.uint32, device=device)
    view.ranges = wp.empty(0, dtype=PackedRange, device=device)
    view.palette = wp.empty(0, dtype=wp.vec2, device=device)
    view.centre = _vectors(centres - scene.origin, device)
    transposed = np.ascontiguousarray(np.swapaxes(axes, 1, 2), np.float32)
    view.map_from_world = wp.array(transposed, dtype=wp.mat33, device=device)
    return CubeMaps(view, centres, axes)


def copied_maps(maps: CubeMaps) -> CubeMaps:
    """Maps whose texels can be changed and those of the others stay; not of packed ones."""
    view = _copied(maps.view)
    for name in ("radiance", "distance", "triangle"):
        setattr(view, name, wp.clone(getattr(maps.view, name)))
    return CubeMaps(view, maps.centres, maps.axes)


def _copied(view: CubeMapsView) -> CubeMapsView:
    """Another struct with the same arrays."""
    other = CubeMapsView()
    for name in CubeMapsView.vars:
        setattr(other, name, getattr(view, name))
    return other


def face_camera(scene: Scene, centre: np.ndarray, axes: np.ndarray, face: int, resolution: int) -> Camera:
    """The camera whose picture is a face of a map.

    Args:
        scene: Its near and far planes leave nothing of it out.
        centre, axes: Of the map, world, see `CubeMaps`.
        face: 0 to 5.
        resolution: Texels along an edge.
    """
    right, up, forward = RADIANCE_AXES[face] @ axes.T
    _, _, corners = scene.boxes
    eye = centre - scene.origin
    farthest = float(np.linalg.norm(corners - eye, axis=-1).max()) if len(corners) else 1.0
    half = 0.5 * resolution
    near = NEAR_SHARE * scene.size
    far = max(FAR_SLACK * farthest, 2.0 * near)
    return Camera(centre, right, up, forward, half, half, half, half, near, far, (resolution, resolution))


def _draw_face(scene, camera, maps, k, face, without, onward, shadows, threads, kernels) -> None:
    """Draw, shade and store one face."""
    device, count = scene.device, camera.size[0] * camera.size[1]
    gbuffer = raster.draw_scene(scene, camera, threads, without, kernels)
    layer, distance = texel_hits(scene, gbuffer, threads)
    radiance = shade.seen_radiance(scene, gbuffer, layer, threads, shadows, kernels)
    if onward is not None:
        onward(gbuffer, layer, radiance)
    view = maps.view
    places = [k * view.map_texels + face * count, (k * FACE_COUNT + face) * count]
    launch.launch(store_texels_kernel, count, [gbuffer.triangle, radiance, distance, *places, view], device, threads)


def texel_hits(scene: Scene, gbuffer: GBuffer, threads: int = 0) -> tuple[ReflectionLayer, wp.array]:
    """What the texels of a drawn face see, to be shaded, and the distances to it (float32, 0 sky)."""
    device, count = scene.device, len(gbuffer.triangle)
    point, direction = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    u, v, distance = (wp.zeros(count, dtype=float, device=device) for _ in range(3))
    inputs = [scene.view, gbuffer.view, gbuffer.triangle, point, direction, u, v, distance]
    launch.launch(texel_hits_kernel, count, inputs, device, threads)
    return hits_layer(point, direction, gbuffer.triangle, u, v), distance


def hits_layer(
    point: wp.array, direction: wp.array, triangle: wp.array, u: wp.array, v: wp.array, pixel: wp.array | None = None
) -> ReflectionLayer:
    """What texels see as the layer of a mirror that stands at the hits themselves, to be shaded.

    The cone that textures are looked up with has come that far from the eye of the G-buffer it is shaded with.

    Args:
        point: The hits, vec3, scene frame.
        direction: Of the rays that met them, unit.
        triangle, u, v: As in `ReflectionLayer`.
        pixel: Of the G-buffer that each is seen at, int32; None: at all of them in order.
    """
    device, count = triangle.device, len(triangle)
    if pixel is None:
        pixel = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    pixels = MirrorPixels(0, pixel, point, direction, direction, (0, 0, 0, 0))
    layer = ReflectionLayer.empty(pixels, Technique.ENVIRONMENT, device)
    layer.triangle, layer.u, layer.v = triangle, u, v
    return layer


def _packed_map(maps: CubeMaps, k: int) -> tuple[np.ndarray, PackedRange, np.ndarray]:
    """Codes uint32 [texels], their ranges and palette float32 [PALETTE, 2] of one map."""
    distance = maps.distance(k).reshape(-1).astype(np.float64)
    texels = maps.radiance(k)[..., :3].reshape(-1, 3).astype(np.float64)
    total = texels.sum(axis=1)
    there, lit = distance > 0.0, (distance > 0.0) & (total > 0.0)
    bounds = PackedRange()
    codes = np.zeros(len(distance), np.uint32)
    number, bounds.distance_low, bounds.distance_step = _log_codes(distance[there], DISTANCE_CODES, np.inf)
    codes[there] = number << 19
    number, bounds.luma_low, bounds.luma_step = _log_codes(total[lit], LUMA_CODES, LUMA_STOPS)
    codes[lit] |= number << 10
    palette = np.zeros((int(PALETTE), 2), np.float32)
    if lit.any():
        shares = texels[lit][:, [0, 2]] / total[lit, None]
        grid = PALETTE_GRID
        while True:
            cell = (np.minimum(shares * grid, grid - 1).astype(np.int64) * [grid, 1]).sum(axis=1)
            met, number = np.unique(cell, return_inverse=True)
            if len(met) <= int(PALETTE):
                break
            grid //= 2
        count = np.bincount(number)
        for axis in (0, 1):
            palette[: len(met), axis] = np.bincount(number, shares[:, axis]) / count
        codes[lit] |= number.astype(np.uint32)
    return codes, bounds, palette


def _log_codes(values: np.ndarray, codes: int, stops: float) -> tuple[np.ndarray, float, float]:
    """Codes 1 to codes + 1 of the logarithms of values > 0, the logarithm of code 1, and the step between two."""
    if not len(values):
        return np.zeros(0, np.uint32), 0.0, 0.0
    logs = np.log(values)
    low, high = max(logs.min(), logs.max() - stops * np.log(2.0)), logs.max()
    step = (high - low) / codes
    number = np.rint((np.maximum(logs, low) - low) / step) if step > 0.0 else np.zeros(len(logs))
    return 1 + number.astype(np.uint32), float(low), float(step)


def _vectors(values: np.ndarray, device) -> wp.array:
    return wp.array(np.ascontiguousarray(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)
