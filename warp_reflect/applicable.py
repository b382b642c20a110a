"""Which techniques apply to a mirror, and what each would have to do there."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


def _bends(scene: Scene, part: PartRange, camera: Camera, pixels: int) -> tuple[float, ...]:
    """`Work.bends` of a mirror as if it were a ball of its box's size, by some of the scene's triangles.

    The estimate of `vertices.edge_reach`; what the body hides is left out, and of a mirror that is partly seen the part not
    seen.
    """
    if part.is_whole:
        mine = scene.host_points[part.first_vertex : part.first_vertex + part.vertex_count].astype(np.float64)
    else:
        own = scene.host_triangles[part.first_triangle : part.first_triangle + part.triangle_count]
        mine = scene.host_points[np.unique(own)].astype(np.float64)
    low, high = mine.min(axis=0), mine.max(axis=0)
    extents = np.sort(0.5 * (high - low))
    size, centre = extents[2], 0.5 * (low + high)
    if not size > 0.0:
        return ()
    ids = np.arange(0, scene.triangle_count, -(-scene.triangle_count // BENT_TRIANGLES))
    share = scene.triangle_count / len(ids)
    ids = ids[(ids < part.first_triangle) | (ids >= part.first_triangle + part.triangle_count)]
    corner = [(scene.host_points[each] - centre) / size for each in scene.host_triangles[ids].T]
    longest = np.sqrt(np.max([np.sum((corner[k] - corner[k - 1]) ** 2, axis=1) for k in range(3)], axis=0))
    middle = sum(corner) / 3.0
    eye = (camera.eye - scene.origin - centre) / size
    eye_far, far = np.linalg.norm(eye), np.linalg.norm(middle, axis=1)
    cosine = middle @ eye / np.maximum(eye_far * far, 1.0e-30)
    hidden = (cosine < 0.0) & ((1.0 - cosine**2) * far**2 < HIDDEN_SHARE**2)
    radius = float(np.cbrt(np.prod(extents / size)))
    d_o, d_v = max(eye_far - radius, NEAREST), np.maximum(far - radius, NEAREST)
    incidence = np.sqrt(np.maximum(0.5 * (1.0 + cosine), NEAREST**2))
    least = incidence**2 * (1.0 / d_o + 1.0 / d_v) + 2.0 * incidence
    focal = math.sqrt(camera.fx * camera.fy)
    wanted = longest * np.sqrt(CUT_SLACK * focal) / (d_v * np.sqrt(float(ESTIMATE) * d_o * least))
    whole = math.pi * extents[1] * size * camera.fx * camera.fy / (size * eye_far) ** 2
    share *= min(1.0, pixels / whole)
    steps = np.floor(BENDS_PER_OCTAVE * np.log2(np.maximum(wanted[~hidden], 1.0e-9) / BEND_LEAST))
    steps = np.minimum(steps[steps >= 0.0], BENDS - 1.0).astype(np.int64)
    return tuple(float(count) for count in share * np.bincount(steps, minlength=BENDS))


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
    faces = scene.host_triangles[own.first_triangle : own.first_triangle + own.triangle_count]
    points = scene.host_points[np.unique(faces)].astype(np.float64)
    if not len(points):
        return 0.0
    centre, radius = 0.5 * (points.min(axis=0) + points.max(axis=0)), 0.5 * float(np.ptp(points, axis=0).max())
    first, _, corners = scene.boxes
    others = corners[first != own.first_vertex]
    if not len(others):
        return 0.0
    low, high = others[:, 0], others[:, 7]
    distance = np.linalg.norm(np.maximum(np.maximum(low - centre, centre - high), 0.0), axis=1).min()
    return radius / distance if distance > 0.0 else math.inf
