"""What passes between the steps of a frame: `Camera`, `GBuffer`, `MirrorPixels`, `ReflectionLayer`.

Pixels are numbered row by row from the top: pixel = y * width + x, centre at (x + 0.5, y + 0.5).
The *eye frame* has world axes and its origin at the eye.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache, partial

import numpy as np
import warp as wp

from warp_reflect import compact
from warp_reflect.counts import Statistics
from warp_reflect.launch import launch, mark, module_part, reads, stays
from warp_reflect.scene import CameraData, Scene
from warp_reflect.settings import Status

wp.set_module_options({"enable_backward": False})
MET = module_part(__name__, "met")
UNREAD = module_part(__name__, "unread")


@wp.struct
class CameraView:
    """Projection of eye-frame points to pixels and back.

    Homogeneous pixel coordinates of p: X = dot(x_row.xyz, p) + x_row.w, likewise Y and W. Perspective: W is the depth
    along `forward`; orthographic: W = 1.
    """

    eye: wp.vec3  # scene frame
    forward: wp.vec3
    x_row: wp.vec4
    y_row: wp.vec4
    w_row: wp.vec4
    ray_corner: wp.vec3  # direction (perspective) or origin in the eye frame (orthographic) at pixel coordinate (0, 0)
    ray_dx: wp.vec3
    ray_dy: wp.vec3
    orthographic: int
    near: float
    far: float
    width: int
    height: int


@dataclass(frozen=True)
class Camera:
    """A camera with an image size, float64 on the host.

    Attributes:
        eye: World position [3].
        right, up, forward: Unit world directions [3].
        fx, fy, cx, cy: pixel = (fx X/Z + cx, -fy Y/Z + cy); orthographic: without the division.
        near, far: Depths along forward. [scene units]
        size: (width, height). [pixels]
    """

    eye: np.ndarray
    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    near: float
    far: float
    size: tuple[int, int]
    orthographic: bool = False
    path: str = ""

    @classmethod
    def from_data(cls, data: CameraData, size: tuple[int, int]) -> Camera:
        """Film-back geometry of a UsdGeomCamera at an image size.

        Pixels are square: the aperture is widened to fit (UsdRender's `expandAperture`).
        """
        width, height = size
        columns = data.world_from_camera[:3, :3].astype(np.float64)
        axes = columns / np.linalg.norm(columns, axis=0)
        aperture_x, aperture_y = data.horizontal_aperture, data.vertical_aperture
        if aperture_x * height > aperture_y * width:
            aperture_y = aperture_x * height / width
        else:
            aperture_x = aperture_y * width / height
        if data.projection == "orthographic":
            # Apertures of an orthographic camera are in tenths of a scene unit (UsdGeomCamera).
            scale = 10.0
        else:
            scale = data.focal_length
        fx, fy = width * scale / aperture_x, height * scale / aperture_y
        return cls(
            eye=data.world_from_camera[:3, 3].astype(np.float64),
            right=axes[:, 0],
            up=axes[:, 1],
            forward=-axes[:, 2],
            fx=fx,
            fy=fy,
            cx=width * (0.5 - data.horizontal_offset / aperture_x),
            cy=height * (0.5 + data.vertical_offset / aperture_y),
            near=data.near,
            far=data.far,
            size=(width, height),
            orthographic=data.projection == "orthographic",
            path=data.path,
        )

    def sees_as(self, other: Camera) -> bool:
        """Whether another camera's pixels are the same rays, whatever prim either comes from."""
        mine, theirs = (replace(camera, path="") for camera in (self, other))
        return all(np.array_equal(getattr(mine, each.name), getattr(theirs, each.name)) for each in fields(mine))

    def view(self, scene: Scene) -> wp.array:
        """The device form, `CameraView` [1], relative to the scene's origin.

        It lies on the device: what is launched again sees whichever camera lies there then.
        """
        x, y = self.fx * self.right, -self.fy * self.up
        # Word by word, in the order of `CameraView`: structures are copied to a device in four times as long.
        words = np.zeros(CAMERA_WORDS, np.float32)
        words[0:3], words[3:6] = self.eye - scene.origin, self.forward
        corner = self.cy / self.fy * self.up
        if self.orthographic:
            words[6:9], words[9], words[10:13], words[13], words[17] = x, self.cx, y, self.cy, 1.0
            corner = -self.cx / self.fx * self.right + corner
        else:
            words[6:9], words[10:13], words[14:17] = (
                x + self.cx * self.forward,
                y + self.cy * self.forward,
                self.forward,
            )
            corner = self.forward - self.cx / self.fx * self.right + corner
        words[18:21], words[21:24], words[24:27] = corner, self.right / self.fx, -self.up / self.fy
        words[28:30] = self.near, self.far
        words.view(np.int32)[[27, 30, 31]] = self.orthographic, *self.size
        held = wp.array(words, dtype=float, device=scene.device)
        view = wp.array(ptr=held.ptr, dtype=CameraView, shape=1, capacity=held.capacity, device=scene.device)
        view.held = held
        return view


CAMERA_WORDS = 32


@wp.func
def eye_ray_direction(camera: CameraView, x: float, y: float) -> wp.vec3:
    """Direction of the eye ray at pixel coordinate (x, y), world axes, not normalised (unit depth along forward)."""
    if camera.orthographic != 0:
        return camera.forward
    return camera.ray_corner + x * camera.ray_dx + y * camera.ray_dy


@wp.func
def eye_ray_origin(camera: CameraView, x: float, y: float) -> wp.vec3:
    """Origin of the eye ray at pixel coordinate (x, y), eye frame."""
    if camera.orthographic != 0:
        return camera.ray_corner + x * camera.ray_dx + y * camera.ray_dy
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def project(camera: CameraView, p_eye: wp.vec3) -> wp.vec4:
    """Pixel coordinates and depth key of an eye-frame point: (x, y, key, w).

    The key grows towards the eye and is linear on the screen: 1/depth (perspective) or 1 - depth/far (orthographic).
    In front of the near plane (x, y) stay homogeneous and the key is 0, for the clipper.
    """
    depth = wp.dot(camera.forward, p_eye)
    x = camera.x_row[0] * p_eye[0] + camera.x_row[1] * p_eye[1] + camera.x_row[2] * p_eye[2] + camera.x_row[3]
    y = camera.y_row[0] * p_eye[0] + camera.y_row[1] * p_eye[1] + camera.y_row[2] * p_eye[2] + camera.y_row[3]
    if camera.orthographic != 0:
        if depth < camera.near:
            return wp.vec4(x, y, 0.0, depth)
        return wp.vec4(x, y, 1.0 - depth / camera.far, depth)
    if depth < camera.near:
        return wp.vec4(x, y, 0.0, depth)
    inv = 1.0 / depth
    return wp.vec4(x * inv, y * inv, inv, depth)


@dataclass
class GBuffer:
    """What the eye sees: per pixel the nearest triangle.

    Attributes:
        camera, view: From where; the view on the device.
        triangle: int32 [height * width], -1 background.
        depth_key: float32 [height * width], see `project`; 0 background.
        reflector_id: int32 [height * width], 1-based id of the mirror seen, 0 none; set once the plan is known.
    """

    camera: Camera
    view: wp.array
    triangle: wp.array
    depth_key: wp.array
    reflector_id: wp.array | None = None


Box = tuple[int, int, int, int]  # x0, y0, x1, y1, half-open [pixels]
NO_REFLECTOR = 0  # id of rays that no mirror has reflected


class Sliced:
    """An array of a dataclass that a part of a whole (`_part`) gets as a slice when it is first asked for.

    Mostly none is: launches go over the wholes, and each array that is made costs a frame as much as half a launch.
    """

    def __set_name__(self, owner, name: str):
        self._name = name

    def __get__(self, part, owner=None) -> wp.array:
        if part is None:
            raise AttributeError(self._name)  # so that the dataclass has no default
        made = vars(part)[self._name] = compact.run(getattr(part.whole, self._name), part.first, part.end)
        return made


def _part(whole, first: int, end: int, **own):
    """What a whole is, from element `first` on, with some attributes of its own."""
    part = object.__new__(type(whole))
    others = {name: value for name, value in vars(whole).items() if not isinstance(value, wp.array)}
    vars(part).update(others, whole=whole, first=first, end=end, **own)
    return part


@dataclass
class MirrorPixels:
    """The pixels at which one reflector is seen, compacted, with the surface every technique reflects at.

    Attributes:
        reflector: 1-based id; `NO_REFLECTOR` behind a pane.
        pixel: int32 [n], ascending.
        point: vec3 [n], scene frame: P on the mirror.
        normal: vec3 [n], unit, on the eye's side.
        direction: vec3 [n], unit reflected direction.
        box: (x0, y0, x1, y1), half-open bounds of the pixels.
        whole: Those of several reflectors, one after the other, whose slice from `first` to `end` these are; None: they
            are alone.
        everywhere: Where nothing is read (`launch.unread`) every pixel of the picture has its entry, which has the pixel's own
            number, or -1 where that does not show the reflector (`surface.told`).
    """

    reflector: int
    pixel: wp.array = Sliced()
    point: wp.array = Sliced()
    normal: wp.array = Sliced()
    direction: wp.array = Sliced()
    box: Box
    whole: MirrorPixels | None = None
    first: int = 0
    end: int = 0
    everywhere: bool = False

    @property
    def count(self) -> int:
        return len(self.pixel) if self.whole is None else self.end - self.first

    def part(self, reflector: int, first: int, end: int, box: Box) -> MirrorPixels:
        """One reflector's of a whole's."""
        if end - first == self.count:
            return replace(self, reflector=reflector, box=box)
        return _part(self, first, end, reflector=reflector, box=box)

    def turned(self, direction: wp.array, normal: wp.array | None = None) -> MirrorPixels:
        """The same pixels with rays that go elsewhere, and with normals that would send them there."""
        normal = self.normal if normal is None else normal
        return MirrorPixels(
            self.reflector, self.pixel, self.point, normal, direction, self.box, everywhere=self.everywhere
        )

    def follows(self, other: MirrorPixels) -> bool:
        """Whether they lie right behind another reflector's, as far as there are any."""
        if self.everywhere:
            return other.everywhere
        return self.whole is not None and self.whole is other.whole and self.first == other.end

    @staticmethod
    def joined(pixels: Sequence[MirrorPixels]) -> MirrorPixels:
        """Those of several reflectors, each of which follows the one before, as if they were the first one's."""
        if len(pixels) == 1:
            return pixels[0]
        if pixels[0].everywhere:
            return replace(pixels[0], pixel=_united([each.pixel for each in pixels]))
        left, top, right, bottom = zip(*(each.box for each in pixels), strict=True)
        box = min(left), min(top), max(right), max(bottom)
        return pixels[0].whole.part(pixels[0].reflector, pixels[0].first, pixels[-1].end, box)

    def select(self, chosen: wp.array, reflector: int, width: int) -> MirrorPixels:
        """Some of the pixels under another id.

        Args:
            chosen: Ascending indices into the pixels, int32.
            reflector: The id they get.
            width: Of the image. [pixels]
        """
        arrays = (self.pixel, self.point, self.normal, self.direction)
        pixel, *vectors = (compact.taken(array, chosen) for array in arrays)
        return MirrorPixels(reflector, pixel, *vectors, pixel_bounds(pixel.numpy(), width))


@wp.kernel(module=UNREAD)
def united_kernel(first: int, one: wp.array(dtype=int), other: wp.array(dtype=int), out_pixel: wp.array(dtype=int)):
    """One thread per entry, which has a pixel in one list at most."""
    i = first + wp.tid()
    out_pixel[i] = wp.max(one[i], other[i])


def _united(pixels: Sequence[wp.array]) -> wp.array:
    """Lists of pixels of the same entries in one."""
    united, device = pixels[0], pixels[0].device
    for each in pixels[1:]:
        both = wp.empty(len(each), dtype=int, device=device)
        launch(united_kernel, len(each), [united, each, both], device)
        united = both
    return united


def pixel_bounds(pixel: np.ndarray, width: int) -> Box:
    """Half-open bounds (x0, y0, x1, y1) of ascending pixel numbers; all 0 if there are none."""
    if not len(pixel):
        return (0, 0, 0, 0)
    y0, y1 = int(pixel[0]) // width, int(pixel[-1]) // width + 1
    # Of every row its first and its last pixel alone; of one type, or every number would be converted.
    rows = np.arange(y0, y1 + 1, dtype=pixel.dtype) * pixel.dtype.type(width)
    first = np.searchsorted(pixel, rows)
    seen = first[1:] > first[:-1]
    rows = rows[:-1][seen]
    x0, x1 = (pixel[first[:-1][seen]] - rows).min(), (pixel[first[1:][seen] - 1] - rows).max() + 1
    return int(x0), y0, int(x1), y1


@dataclass(frozen=True)
class Reflector:
    """A mirror as the techniques see it.

    Attributes:
        id: 1-based, the `reflectorId` channel.
        part: Index into `Scene.parts`.
        convex: Its body is proven convex: its own triangles are never seen in it.
    """

    id: int
    part: int
    convex: bool


@dataclass
class ReflectionLayer:
    """The common answer of every technique for the pixels of one reflector, in the order of its `MirrorPixels`.

    Attributes:
        pixels: The pixels answered.
        method: `Technique` of the answer.
        triangle: int32 [n], the triangle seen in the mirror, -1 none.
        u, v: float32 [n], barycentric weights of its second and third corner at the hit.
        distance: float32 [n], from P to the hit along the reflected direction. [scene units]
        status: uint8 [n], `Status`.
        statistics: Counts of who settled the pixels, and of what the search met.
        timings: Milliseconds per step.
        history: What the next frame may start from.
        virtual: What a forward technique drew: `virtual_mesh.Drawn` of every piece and branch; empty where rays answered.
        cells: What an interpolation grid ended with: `grid.UsedCells` of every piece that has one.
        radiance: vec3 [n], what is seen at each pixel where the technique knows it itself (environment maps); None: it is
            shaded at the hits.
        whole: The layer of several reflectors that all are answered and shaded together, whose slice from `first` to `end`
            this one is; None: it is alone.
        shares: Of a whole, for each reflector: what tells which of some rays are its own, and its statistics.
    """

    pixels: MirrorPixels
    method: int
    triangle: wp.array = Sliced()
    u: wp.array = Sliced()
    v: wp.array = Sliced()
    distance: wp.array = Sliced()
    status: wp.array = Sliced()
    statistics: Statistics | dict = field(default_factory=Statistics)
    timings: Statistics | dict = field(default_factory=dict)
    history: object = None
    virtual: list = field(default_factory=list)
    cells: list = field(default_factory=list)
    radiance: wp.array | None = None
    whole: ReflectionLayer | None = None
    first: int = 0
    end: int = 0
    shares: list[tuple[Callable[[np.ndarray], np.ndarray], Statistics]] = field(default_factory=list)

    @classmethod
    def unset(cls, pixels: MirrorPixels, method: int, device) -> ReflectionLayer:
        """For who answers every pixel: nothing is filled in."""
        kinds = {"triangle": int, "u": float, "v": float, "distance": float, "status": wp.uint8}
        room = {name: wp.empty(pixels.count, dtype=kind, device=device) for name, kind in kinds.items()}
        return cls(pixels=pixels, method=int(method), **room)

    @classmethod
    def empty(cls, pixels: MirrorPixels, method: int, device) -> ReflectionLayer:
        """For who answers some of the pixels."""
        n = pixels.count
        return cls(
            pixels=pixels,
            method=int(method),
            triangle=wp.full(n, -1, dtype=int, device=device),
            u=wp.zeros(n, dtype=float, device=device),
            v=wp.zeros(n, dtype=float, device=device),
            distance=wp.zeros(n, dtype=float, device=device),
            status=wp.full(n, int(Status.NONE), dtype=wp.uint8, device=device),
        )

    def parts(self, pixels: Sequence[MirrorPixels]) -> list[ReflectionLayer]:
        """The layers of the reflectors whose joined pixels these are, as slices."""
        if len(pixels) == 1:
            return [self]
        made, end = [], 0
        for each in pixels:
            first, end = end, end + each.count
            run, own = (0, self.pixels.count) if each.everywhere else (first, end), Statistics()
            told = partial(_shown, each.pixel) if each.everywhere else partial(_between, *run)
            made.append(_part(self, *run, pixels=each, statistics=own, timings={}, virtual=[], cells=[], shares=[]))
            self.shares.append((told, own))
        return made

    def count_later(self, name: str, rays: Callable[[], np.ndarray]) -> None:
        """Add to each reflector's statistics how many rays are its own, when they are asked for; nothing where none is.

        Args:
            name: Of the statistics.
            rays: Gives their numbers among the layer's.
        """
        numbers = cache(rays) if reads() else rays
        for own, statistics in self.shares or [(partial(_between, 0, self.pixels.count), self.statistics)]:
            statistics.later(partial(_counted, name, numbers, own))


def _counted(name: str, numbers: Callable[[], np.ndarray], own: Callable[[np.ndarray], np.ndarray]) -> dict[str, int]:
    count = int(np.count_nonzero(own(numbers())))
    return {name: count} if count else {}


def _between(first: int, end: int, numbers: np.ndarray) -> np.ndarray:
    return (numbers >= first) & (numbers < end)


def _shown(pixel: wp.array, numbers: np.ndarray) -> np.ndarray:
    """Which of some entries, -1 for none, show a pixel; read now."""
    return (numbers >= 0) & (pixel.numpy()[numbers] >= 0)


def undivided(layers: Iterable[ReflectionLayer]) -> list[ReflectionLayer]:
    """Layers, and instead of those that are slices of a whole that whole, where all of its slices are among them."""
    layers = list(layers)
    slices = Counter(id(layer.whole) for layer in layers)
    found = {}
    for layer in layers:
        whole = layer.whole
        each = layer if whole is None or slices[id(whole)] < len(whole.shares) else whole
        found[id(each)] = each
    return list(found.values())


@wp.kernel(module=MET)
def met_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patches: wp.array(dtype=wp.uint8),
    out_met: wp.array(dtype=wp.uint8),
):
    """One thread per ray: whether it meets one of the patches."""
    i = first + wp.tid()
    out_met[i] = wp.uint8(0)
    if triangle[i] >= 0:
        out_met[i] = patches[triangle_patch[triangle[i]]]


@wp.kernel(module=UNREAD)
def met_here_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    patches: wp.array(dtype=wp.uint8),
    out_number: wp.array(dtype=int),
    out_mark: wp.array(dtype=int),
):
    """One thread per ray: its number where it meets one of the patches, else -1; threads that set the mark agree."""
    i = first + wp.tid()
    out_number[i] = -1
    if triangle[i] >= 0:
        if patches[triangle_patch[triangle[i]]] != wp.uint8(0):
            out_number[i] = i
            out_mark[0] = 1


def meeting(scene: Scene, layer: ReflectionLayer, patches: np.ndarray) -> compact.Some:
    """Which rays of a layer meet one of the patches, bool [patches of the scene]."""
    if stays(scene.device):
        of_patch = scene.kept_always(
            ("patches", patches.tobytes()),
            lambda: wp.array(patches.astype(np.uint8), dtype=wp.uint8, device=scene.device),
        )
        inputs, count = [layer.triangle, scene.view.triangle_patch, of_patch], layer.pixels.count
        if not reads():
            numbers, some = wp.empty(count, dtype=int, device=scene.device), mark(scene.device)
            launch(met_here_kernel, count, [*inputs, numbers, some], scene.device)
            return compact.Some(numbers, some)
        met = wp.empty(count, dtype=wp.uint8, device=scene.device)
        launch(met_kernel, count, [*inputs, met], scene.device)
        return compact.Some(compact.marked(met, 1))
    of_triangle = scene.kept_always(
        ("triangles of patches", patches.tobytes()),
        lambda: np.append(patches.take(scene.host_triangle_patch), False),  # the last is that of triangle -1
    )
    return compact.Some(compact.listed(np.flatnonzero(of_triangle.take(layer.triangle.numpy())), scene.device))
