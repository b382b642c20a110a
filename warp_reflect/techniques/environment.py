"""One environment map at a mirror's centre, looked up by the reflected direction: the classic baseline.

Source: Blinn and Newell, Texture and Reflection in Computer Generated Images, CACM 1976; as a cube, Greene, Environment
Mapping and Other Applications of World Projections, IEEE CG&A 1986. Exact for what is infinitely far; how far off it is
elsewhere, `parallax_px` predicts. The mirror itself is left out of its map, and the vehicle that it moves with.

Mirrors seen in the map show the domes (`bounces` 1), their own maps to a fixed depth, or their maps of the previous frame
(`environment_update` "previous"), see `mirror_maps.py`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from warp_reflect import bvh, raster, surface
from warp_reflect.environment_maps import CubeMaps, Onward, look_up, render_maps
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.shadows import asked_shadows

PREVIEW_SIDE = 160  # pixels of the picture in which parallax is predicted; its pixels' errors vary slowly
QUANTILE = (
    0.99  # of the mirror's pixels that stay below the predicted parallax; the last per cent are at its silhouette
)
SINGULAR = 1.0e-9  # squared sine by which neighbouring pixels' rays must part for an error to be a number of pixels


@dataclass(frozen=True)
class Prepared:
    """A mirror's map, unless every frame draws it: map `number` of `maps`, at `centre` (world, float64 [3])."""

    part: int
    centre: np.ndarray
    maps: CubeMaps | None
    number: int = 0


@dataclass(frozen=True)
class Shown:
    """What the next frame may start from: the map that this one showed in the mirror `part`, and `level_blend.Levels` of it."""

    part: int
    maps: CubeMaps
    number: int
    levels: tuple[tuple[int, int], ...] = ()


def applies(scene: Scene, reflector) -> tuple[bool, str]:
    """A map asks nothing of a mirror."""
    return True, "a map at its centre shows what is far away"


def centre_of(scene: Scene, part: int) -> np.ndarray:
    """Middle of a part's box, world, float64 [3]; kept with the scene."""
    key = ("centre", None, part)  # of this time alone
    if key not in scene.facts:
        own = scene.parts[part]
        faces = scene.host_triangles[own.first_triangle : own.first_triangle + own.triangle_count]
        points = scene.host_points[faces.reshape(-1)] if len(faces) else np.zeros((1, 3))
        low, high = (bound.astype(np.float64) for bound in (points.min(axis=0), points.max(axis=0)))
        scene.facts[key] = 0.5 * (low + high) + scene.origin
    return scene.facts[key].copy()


def left_out(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    """The parts that a mirror's map does not show: itself, its vehicle, and what its collection does not name."""
    seen, own = scene.seen_in(scene.parts[part]), (part, *vehicle_of(scene, part, settings))
    if seen is None:
        return own
    solid = [k for k, other in enumerate(scene.parts) if other.triangle_count and k not in own]
    return *own, *(k for k in solid if not seen[scene.parts[k].first_triangle])


def vehicle_of(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    """What moves with a mirror and is about as large: a map's eye is amid it, where it would hide what the mirror shows.

    Meyer and Loscos leave a car out of its own map. A small mirror on a large vehicle, whose eye is not within it, shows it;
    what stands still is no vehicle, since it is not known what would move together.

    Args:
        scene: Its instances name what they move by.
        part: The mirror, index into `scene.parts`.
        settings: `local_own_size`.

    Returns:
        The parts, without the mirror; none where it does not move. Kept with the scene.
    """
    key = ("vehicle", None, part, settings.local_own_size)  # of this time alone
    if key not in scene.facts:
        scene.facts[key] = _vehicle(scene, part, settings)
    return scene.facts[key]


def _vehicle(scene: Scene, part: int, settings: Settings) -> tuple[int, ...]:
    instances, own = scene.data.instances, scene.parts[part]
    by, copy = instances[own.prim - 1].mover, own.instance
    if not by or settings.local_own_size == 0.0:
        return ()
    with_it = [
        k
        for k in scene.moving_parts
        if scene.parts[k].instance == copy
        and scene.parts[k].triangle_count
        and f"{instances[scene.parts[k].prim - 1].mover}/".startswith(f"{by}/")
    ]
    first, _, boxes = scene.boxes
    rows = np.searchsorted(first, [own.first_vertex, *(scene.parts[k].first_vertex for k in with_it)])
    alone, together = (np.linalg.norm(np.ptp(boxes[each].reshape(-1, 3), axis=0)) for each in (rows[:1], rows))
    return tuple(k for k in with_it if k != part) if together <= settings.local_own_size * alone else ()


def prepare(scene: Scene, reflector, settings: Settings) -> Prepared:
    """Draw the mirror's map, where it is not drawn in every frame."""
    centre = centre_of(scene, reflector.part)
    if settings.environment_update != "static":
        return Prepared(reflector.part, centre, None)
    maps, number = _draw(scene, reflector.part, centre, settings)
    return Prepared(reflector.part, centre, maps, number)


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history: dict[int, Shown] | None = None,
) -> ReflectionLayer:
    """Look every reflected direction up.

    Args:
        history: By reflector id the maps of the previous frame.

    Returns:
        A layer with `radiance`, status SKY and no hits: what a map shows has no place. Statistics `environment_maps`: maps
        drawn in this frame.
    """
    layer = ReflectionLayer.empty(pixels, Technique.ENVIRONMENT, scene.device)
    maps, number = prepared.maps, prepared.number
    if maps is None:
        before = history if settings.environment_update == "previous" else None
        maps, number = _draw(scene, prepared.part, prepared.centre, settings, before)
        layer.statistics["environment_maps"] = 1
    layer.radiance = look_up(scene, maps, number, pixels.direction, threads=settings.threads)
    layer.status.fill_(int(Status.SKY))
    layer.history = Shown(prepared.part, maps, number)
    return layer


def _draw(scene: Scene, part: int, centre: np.ndarray, settings: Settings, before=None) -> tuple[CubeMaps, int]:
    resolution = settings.environment_resolution
    options = {"shadows": asked_shadows(scene, settings), "threads": settings.threads, "kernels": settings.kernels}
    onward = onward_of(scene, part, settings, before)
    return render_maps(
        scene, centre[None], resolution, without=[left_out(scene, part, settings)], onward=onward, **options
    ), 0


def onward_of(scene: Scene, part: int, settings: Settings, before: dict[int, Shown] | None = None) -> Onward | None:
    """What mirrors in a mirror's map show: maps of their own, as `bounces` and `environment_update` ask; None: the domes.

    Args:
        part: The mirror whose map it is; without another in the scene nothing is drawn for it.
        before: By reflector id the maps of the previous frame, where that is what is asked for.
    """
    if settings.environment_update == "previous":
        if not before:
            return None  # the first frame
        from warp_reflect.techniques import mirror_maps

        return mirror_maps.of_previous_frame(scene, before)
    gone = left_out(scene, part, settings)
    others = (k for k, other in enumerate(scene.parts) if k not in gone and other.triangle_count)
    if settings.bounces <= 1 or not any(mirror_weight(scene, scene.parts[k], settings) for k in others):
        return None
    from warp_reflect.techniques import mirror_maps

    return mirror_maps.of_depth(scene, settings, settings.bounces - 1)


def parallax_px(scene: Scene, reflector, camera: Camera, threads: int = 0, kernels: str = "auto") -> float:
    """How many pixels off an environment map at a mirror's centre shows things.

    In a small picture each mirror pixel's ray is followed from the centre instead of the mirror: the point met is what the
    map shows there. To first order it belongs where the mirror's reflected rays, followed from pixel to pixel, point to it.

    Args:
        scene: Its BVH is built if this is the first use.
        reflector: The mirror.
        camera: Whose pixels count.
        threads: CPU threads; 0: one per core.
        kernels: `Settings.kernels`.

    Returns:
        The error below which `QUANTILE` of the mirror's pixels stay; 0 where it is not seen.
    """
    number, point, ray, width, shrink = _preview(scene, reflector, camera, threads, kernels)
    if not len(number) or not scene.tracer.id:
        return 0.0
    centre = centre_of(scene, reflector.part) - scene.origin
    origins = np.tile(centre, (len(ray), 1))
    body = bvh.body_of(scene, reflector.part, convex=True)
    triangle, distance, _, _ = scene.mirror_tracer(reflector.part).trace(origins, ray, threads, body)
    shown = centre + distance.numpy()[:, None].astype(np.float64) * ray
    right, below = _neighbours(number, width)
    asked = (triangle.numpy() >= 0) & (right >= 0) & (below >= 0)
    if not asked.any():
        return 0.0
    target = shown[asked]

    def miss(which: np.ndarray) -> np.ndarray:
        """By how much reflected rays miss the targets: differences of unit vectors."""
        to_target = target - point[which]
        return ray[which] - to_target / np.maximum(np.linalg.norm(to_target, axis=1, keepdims=True), 1e-300)

    here = miss(np.flatnonzero(asked))
    across, down = miss(right[asked]) - here, miss(below[asked]) - here
    # Least squares for the step (x, y): across x + down y = -here.
    a, b, c = ((p * q).sum(axis=1) for p, q in ((across, across), (across, down), (down, down)))
    d, e = -(across * here).sum(axis=1), -(down * here).sum(axis=1)
    det = a * c - b * b
    good = det > (SINGULAR * np.maximum(a, c)) * np.maximum(a, c)
    safe = np.where(good, det, 1.0)
    step = np.hypot((c * d - b * e) / safe, (a * e - b * d) / safe)
    # Where neighbours' rays do not part, the picture is one direction wide: all of it is off.
    step = np.where(good, step, np.where((here * here).sum(axis=1) > 0.0, width, 0.0))
    return float(min(np.quantile(step, QUANTILE), width) * shrink)


def _preview(scene: Scene, reflector, camera: Camera, threads: int, kernels: str):
    """A small picture of a mirror: its pixels' numbers, points, reflected rays; the picture's width; how often it is smaller."""
    shrink = max(1.0, max(camera.size) / PREVIEW_SIDE)
    size = tuple(max(1, round(side / shrink)) for side in camera.size)
    scaled = {name: getattr(camera, name) / shrink for name in ("fx", "fy", "cx", "cy")}
    of, gbuffer = scene.facts.get(("preview", None), (None, None))
    if of is not camera:  # else it was drawn for another mirror of the same plan
        small = dataclasses.replace(camera, size=size, **scaled)
        gbuffer = raster.draw_scene(scene, small, threads, kernels=kernels)
        scene.facts["preview", None] = camera, gbuffer
    found, _ = surface.mirror_pixels(scene, gbuffer, {reflector.id: reflector.part}, threads, kernels)
    pixels = found[reflector.id]
    point, ray = (array.numpy().astype(np.float64) for array in (pixels.point, pixels.direction))
    return pixels.pixel.numpy(), point, ray, size[0], shrink


def _neighbours(number: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """For ascending pixel numbers the index of the pixel to the right and of the one below, -1 where there is none."""
    place = np.full(int(number.max()) + width + 2, -1)
    place[number] = np.arange(len(number))
    return np.where((number + 1) % width != 0, place[number + 1], -1), place[number + width]
