"""Which techniques apply to a mirror, and what each would have to do there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from warp_reflect.budget import BEND_LEAST, BENDS, BENDS_PER_OCTAVE, Costs, Work, map_blur_px, predict
from warp_reflect.launch import thread_count
from warp_reflect.layers import Camera, Reflector
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import MAPS, TECHNIQUES
from warp_reflect.techniques.vertices import ESTIMATE
from warp_reflect.techniques.virtual_mesh import CUT_SLACK

PREFERRED = ("planar", "quadric", "reflector_map")  # the exact and cheap first
JUDGED_IN_PIXELS = ("planar", "quadric")  # whether they apply depends on the view
# Triangles. Finding out what a larger mesh is (a quadric, convex sheets) takes seconds: `auto` leaves it where the outcome
# is several sheets at best, or would lose against tracing even if it were one.
ANALYSED_MAX = 20000
BENT_TRIANGLES = 8192  # of a scene, that are asked how they bend
NEAREST = 0.05  # of a mirror's size: what lies nearer, or is met at a lesser cosine, counts as if there
HIDDEN_SHARE = 0.8  # of a mirror's size: what lies behind a disc of that radius is hidden
# Of the error looked for: a bound on the parallax, from boxes alone, that is not worth a closer look.
PARALLAX_SLACK = 8.0


@dataclass(frozen=True)
class Candidate:
    """A technique that applies to a mirror, why, and what it would have to do."""

    technique: str
    reason: str
    work: Work


def applies(scene: Scene, reflector: Reflector, camera: Camera, technique: str, settings: Settings) -> tuple[bool, str]:
    """Whether a technique can reflect a mirror for a camera, and why."""
    if camera.orthographic and technique not in ("raytraced", *MAPS):
        return False, "orthographic camera: there is no eye to reflect from"
    if technique in JUDGED_IN_PIXELS:
        return TECHNIQUES[technique].applies(scene, reflector, camera, settings.shape_px)
    return TECHNIQUES[technique].applies(scene, reflector)


def work_of(
    scene: Scene, reflector: Reflector, camera: Camera, technique: str, pixels: int, settings: Settings
) -> Work:
    """What a technique that applies has to do for a mirror seen at so many pixels."""
    part = scene.parts[reflector.part]
    if technique == "raytraced" or not pixels:
        return Work(pixels, scene_triangles=scene.triangle_count)
    module = TECHNIQUES[technique]
    sheets = technique in ("quadric", "reflector_map")
    passes, held = module.extent(scene, reflector) if sheets else (1, 1.0)
    parallax = 0.0
    if technique == "environment":
        parallax = module.parallax_px(scene, reflector, camera, settings.threads, settings.kernels)
    return Work(
        pixels,
        scene.vertex_count - (part.vertex_count if part.is_whole else 0),
        scene.triangle_count - part.triangle_count,
        scene.triangle_count,
        passes,
        held,
        sheets and module.has_branches(scene, reflector, camera),
        _size_px(pixels),
        parallax,
        _bends(scene, part, camera, pixels) if technique != "planar" and technique not in MAPS else (),
    )


def exact_candidates(
    scene: Scene, reflector: Reflector, camera: Camera, pixels: int, settings: Settings, costs: Costs
) -> tuple[list[Candidate], list[str]]:
    """The techniques of `PREFERRED` that apply, in that order, and why the others do not.

    A large mesh is not looked at where that would not pay, see `ANALYSED_MAX`.
    """
    part = scene.parts[reflector.part]
    threads = thread_count(scene.device, settings.threads)
    rays = predict(
        work_of(scene, reflector, camera, "raytraced", pixels, settings), "raytraced", settings, costs, threads
    )
    found, refused = [], []
    for name in PREFERRED:
        if name != "planar" and part.triangle_count > ANALYSED_MAX:
            vertices = scene.vertex_count - (part.vertex_count if part.is_whole else 0)
            triangles = scene.triangle_count - part.triangle_count
            least = predict(Work(pixels, vertices, triangles, scene.triangle_count), name, settings, costs, threads)
            if rays["ms"] < least["ms"] or not reflector.convex:
                refused.append(
                    f"{part.triangle_count} triangles that are not convex together, or dearer to reflect than to trace, "
                    f"are not analysed by auto (at most {ANALYSED_MAX})"
                )
                break
        good, reason = applies(scene, reflector, camera, name, settings)
        if good:
            found.append(Candidate(name, reason, work_of(scene, reflector, camera, name, pixels, settings)))
        else:
            refused.append(f"{name}: {reason}")
    return found, refused


def far_environment(
    scene: Scene, reflector: Reflector, camera: Camera, pixels: int, settings: Settings, error_px: float
) -> Candidate | None:
    """An environment map, where all that a mirror shows is so far away that the map is wrong by no more than an error.

    Boxes are asked first; what they cannot rule out is measured in a small picture (`environment.parallax_px`).

    Args:
        error_px: Parallax and half a texel of the map together. [pixels]
    """
    blur = map_blur_px(pixels, settings.environment_resolution)
    if error_px <= 0.0 or blur > error_px:
        return None
    if _size_px(pixels) * _relative_size(scene, reflector.part) > PARALLAX_SLACK * error_px:
        return None
    work = work_of(scene, reflector, camera, "environment", pixels, settings)
    error = work.parallax_px + blur
    if error > error_px:
        return None
    reason = f"all it shows is far: a map at its centre is off by {error:.2g} px, texels included"
    return Candidate("environment", reason, work)


@dataclass(frozen=True)
class _Box:
    """A part's own, scene frame: its middle, and half its edges by length, the longest last."""

    centre: np.ndarray
    extents: np.ndarray


def _box(scene: Scene, part: PartRange) -> _Box:
    def make() -> _Box:
        if part.is_whole:
            mine = scene.host_points[part.first_vertex : part.first_vertex + part.vertex_count]
        else:
            own = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
            mine = scene.host_points[own.ravel()]
        low, high = (each.astype(np.float64) for each in (mine.min(axis=0), mine.max(axis=0)))
        return _Box(0.5 * (low + high), np.sort(0.5 * (high - low)))

    return scene.kept("box", None, make, part)


@dataclass(frozen=True)
class _Tried:
    """Triangles that are asked how they bend: numbers, longest edges squared, middles [3, n], scene frame."""

    ids: np.ndarray
    longest: np.ndarray
    middle: np.ndarray


def _tried(scene: Scene, still: bool) -> _Tried:
    """Those that stand still, at all times the same, or the others."""

    def make_ids() -> list[np.ndarray]:
        ids = np.arange(0, scene.triangle_count, -(-scene.triangle_count // BENT_TRIANGLES))
        stands = np.array([not each.moves for each in scene.data.instances])
        prims = np.array([part.prim for part in scene.parts])
        firsts = np.array([part.first_triangle for part in scene.parts])
        is_still = stands[prims - 1][np.searchsorted(firsts, ids, side="right") - 1]
        return [ids[~is_still], ids[is_still]]

    def make() -> _Tried:
        ids = scene.kept_always("triangles to bend", make_ids)[still]
        corners = scene.host_points[scene.host_triangles[ids]].astype(np.float64)
        edges = np.stack([corners[:, k] - corners[:, k - 1] for k in range(3)])
        return _Tried(ids, np.sum(edges**2, axis=2).max(axis=0), corners.sum(axis=1).T / 3.0)

    return scene.kept_always("still triangles bend", make) if still else scene.kept("triangles bend", None, make)


def _bends(scene: Scene, part: PartRange, camera: Camera, pixels: int) -> tuple[float, ...]:
    """`Work.bends` of a mirror as if it were a ball of its box's size, by some of the scene's triangles.

    Of a mirror that is partly seen the part not seen is left out. What stands still is counted again where the mirror or the
    camera has moved alone.
    """
    box = _box(scene, part)
    size = box.extents[2]
    if not size > 0.0:
        return ()
    seen_from = *camera.eye, camera.fx, camera.fy
    count = partial(_counted, scene, part, box, camera)
    bends = scene.kept("bends of what stands still", seen_from, lambda: count(True), part)
    bends = bends + scene.kept(("bends of what moves", part.first_triangle), seen_from, lambda: count(False))
    far_squared = np.sum((camera.eye - scene.origin - box.centre) ** 2)
    whole = math.pi * box.extents[1] * size * camera.fx * camera.fy / far_squared
    share = scene.triangle_count / sum(len(_tried(scene, still).ids) for still in (False, True))
    return tuple((share * min(1.0, pixels / whole) * bends).tolist())


def _counted(scene: Scene, part: PartRange, box: _Box, camera: Camera, still: bool) -> np.ndarray:
    """Triangles tried by `Work.bends`, which stand still or do not; the mirror's own and what its body hides are left out.

    The estimate of `vertices.edge_reach`, in units of the mirror's size.
    """
    tried, size = _tried(scene, still), box.extents[2]
    others = (tried.ids < part.first_triangle) | (tried.ids >= part.first_triangle + part.triangle_count)
    eye = (camera.eye - scene.origin - box.centre) / size
    eye_far = np.linalg.norm(eye)
    x, y, z = (tried.middle - box.centre[:, None]) / size
    far_squared = x * x + y * y + z * z
    far = np.sqrt(far_squared)
    cosine = (x * eye[0] + y * eye[1] + z * eye[2]) / np.maximum(eye_far * far, 1.0e-30)
    hidden = (cosine < 0.0) & ((1.0 - cosine * cosine) * far_squared < HIDDEN_SHARE**2)
    radius = float(np.cbrt(np.prod(box.extents / size)))
    d_o, d_v = max(eye_far - radius, NEAREST), np.maximum(far - radius, NEAREST)
    squared = np.maximum(0.5 * (1.0 + cosine), NEAREST**2)  # cosine of the incidence
    least = squared * (1.0 / d_o + 1.0 / d_v) + 2.0 * np.sqrt(squared)
    scale = CUT_SLACK * math.sqrt(camera.fx * camera.fy) / (size * size * float(ESTIMATE) * d_o * BEND_LEAST**2)
    wanted = scale * tried.longest / (d_v * d_v * least)  # pieces, squared, over the fewest counted
    counted = others & ~hidden & (wanted >= 1.0)
    steps = np.minimum(0.5 * BENDS_PER_OCTAVE * np.log2(wanted[counted]), BENDS - 1.0).astype(np.int64)
    return np.bincount(steps, minlength=BENDS)


def _size_px(pixels: int) -> float:
    """Half extent of a round mirror's picture."""
    return math.sqrt(pixels / math.pi)


def _relative_size(scene: Scene, part: int) -> float:
    """Half extent of a mirror over its distance to the nearest box of anything else; infinite inside one. Kept with the scene."""
    key = "relative size", None, part  # of all parts: known no longer where any has moved
    if key not in scene.facts:
        scene.facts[key] = _measured_size(scene, part)
    return scene.facts[key]


def _measured_size(scene: Scene, part: int) -> float:
    own = scene.parts[part]
    if not own.triangle_count:
        return 0.0
    low, high = _span(scene, own)
    centre, radius = 0.5 * (low + high), 0.5 * float((high - low).max())
    first, _, corners = scene.boxes
    others = corners[first != own.first_vertex]
    if not len(others):
        return 0.0
    low, high = others[:, 0], others[:, 7]
    distance = np.linalg.norm(np.maximum(np.maximum(low - centre, centre - high), 0.0), axis=1).min()
    return radius / distance if distance > 0.0 else math.inf


def _span(scene: Scene, part: PartRange) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest coordinates of a part's triangles, scene frame, float64."""

    def make() -> tuple[np.ndarray, np.ndarray]:
        own = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
        corners = scene.host_points[own.ravel()]
        return corners.min(axis=0).astype(np.float64), corners.max(axis=0).astype(np.float64)

    return scene.kept("span", None, make, part)
