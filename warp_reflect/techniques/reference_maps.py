"""Reference environment maps (REMs) of a stage: at authored places, or placed where mirrors are and go.

Authored: prims with `WarpReflectEnvironmentMapAPI`, drawn, or read from the files that `bake` wrote. Placed: candidates along
the paths of the mirrors, chosen one after the other by what each would take off the predicted error. A map holds what is
there at any time: parts that move are left out of it with their shadows, and so is the mirror that it stands in.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass

import numpy as np

from warp_reflect import baked_environments, bvh
from warp_reflect.environment_maps import CubeMaps, pack_maps, render_maps, stored_maps
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Note, Scene
from warp_reflect.scene_times import same_lights
from warp_reflect.settings import Settings
from warp_reflect.shadows import asked_shadows
from warp_reflect.techniques.environment import centre_of

PATH_TIMES = 9  # times of a stage at which the places of moving mirrors are asked
POSITIONS_MAX = 48  # places of mirrors that a placement is judged from
CANDIDATES_MAX = 64
RAYS = 96  # directions from a place; their points stand for what a mirror there shows
SAME_PLACE = 1.0e-3  # of the scene's size: places nearer than this are one
SEEN_SLACK = 1.0e-3  # of a distance: what a candidate meets so little before a point is the point
UNSEEN_MAX = 0.5  # radians; an error of what no map sees counts as at most this
BURIED_SHARE = 0.5  # of what rays from a place meet: so many closed bodies from within, and it is inside a wall
LEAST_GAIN = 0.02  # of the error: a map that takes off less is not placed
DIGEST_BYTES = 16  # two worlds share a digest by chance once in 1e38
COINCIDENT = 1.0e-6  # of the scene's size: places nearer than this are told
KEY, PLACES_KEY = "reference maps", "places of reference maps"
BYTES_FULL, BYTES_PACKED, BYTES_PALETTE = 20, 4, 8192


@dataclass(frozen=True)
class Placement:
    """Places of reference maps and what they are predicted to be worth.

    Attributes:
        paths: Of the prims that name the places; "" where they were placed.
        centres: World, float64 [count, 3].
        axes: Columns, world, float64 [count, 3, 3].
        error_px: Mean error of what a mirror on its path shows, texels of a local map of the maps' resolution; 0: not asked.
        unseen: Share of it that no map sees.
    """

    paths: tuple[str, ...]
    centres: np.ndarray
    axes: np.ndarray
    error_px: float = 0.0
    unseen: float = 0.0


@dataclass(frozen=True)
class ReferenceMaps:
    """The maps of a stage that can be used.

    Attributes:
        maps: The maps; at least one.
        placement: Of these.
        notes: What the user should know.
        reach: Length: a mirror farther than this from all maps is outside of them; inf where they were placed for it.
    """

    maps: CubeMaps
    placement: Placement
    notes: tuple[Note, ...]
    reach: float


def reference_maps(scene: Scene, settings: Settings) -> ReferenceMaps:
    """The stage's reference maps, drawn or read at first use and kept with the scene.

    What cannot be used is left out with a note in `scene.notes`. Where nothing is left, maps are placed.
    """
    key = _key(settings)
    if key not in scene.environments:
        made = _make(scene, settings)
        scene.environments[key] = made
        scene.notes += [note for note in made.notes if note not in scene.notes]
    return scene.environments[key]


def usable_places(scene: Scene, settings: Settings) -> tuple[list[int], list[Note]]:
    """Which of the authored places can be used, by number, and notes about those that cannot, or are one."""
    key = (PLACES_KEY, *_key(settings))
    if key not in scene.environments:
        asked = authored(scene)
        usable, notes = [], []
        for k, centre in enumerate(asked.centres):
            if _buried(scene, centre, settings):
                notes.append(Note(asked.paths[k], "environment map: its place is inside a body; it is not used"))
                continue
            same = [j for j in usable if np.linalg.norm(asked.centres[j] - centre) <= COINCIDENT * scene.size]
            if same:
                notes.append(Note(asked.paths[k], f"environment map: at the place of {asked.paths[same[0]]}"))
            usable.append(k)
        scene.environments[key] = usable, notes
    return scene.environments[key]


def _buried(scene: Scene, centre: np.ndarray, settings: Settings) -> bool:
    """Whether most of what rays from a place meet are closed bodies from within."""
    tracer = scene.still_tracer
    if not tracer.id:
        return False
    directions = _sphere(RAYS)
    origins = np.tile(centre - scene.origin, (RAYS, 1))
    triangle = tracer.trace(origins, directions, settings.threads)[0].numpy()
    gone = np.zeros(max(len(scene.patch_shapes), 1), bool)
    for part in left_out(scene, centre, settings):
        gone[list(scene.parts[part].patches)] = True
    hit = triangle >= 0
    hit[hit] = ~gone[scene.host_triangle_patch[triangle[hit]]]
    if not hit.any():
        return False
    corners = scene.host_points[scene.host_triangles[triangle[hit]]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    closed = scene.closed_patches.numpy()[scene.host_triangle_patch[triangle[hit]]] == 1
    return float(np.mean(closed & (np.einsum("ij,ij->i", normal, directions[hit]) > 0.0))) > BURIED_SHARE


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand reference maps, and the structure for rays, to the same stage's scene at another time: nothing in them moves."""
    if earlier is scene or not same_lights(earlier, scene) or _still_prims(earlier) != _still_prims(scene):
        return
    for key, known in earlier.environments.items():
        if key[0] == PLACES_KEY and key not in scene.environments and _same_places(earlier, scene):
            scene.environments[key] = known
        if key[0] == KEY and key not in scene.environments:
            maps = known.maps.at(scene)
            scene.environments[key] = ReferenceMaps(maps, known.placement, known.notes, known.reach)
            scene.notes += [note for note in known.notes if note not in scene.notes]


def predicted_bytes(scene: Scene, settings: Settings) -> int:
    """Memory of a stage's reference maps; where they are to be placed, at most."""
    known = scene.environments.get(_key(settings))
    if known is not None:
        return known.maps.bytes
    count = len(scene.data.environment_maps) or settings.rem_limit
    texels = 6 * settings.environment_resolution**2
    return count * (texels * BYTES_PACKED + BYTES_PALETTE if settings.rem_texels == "packed" else texels * BYTES_FULL)


def left_out(scene: Scene, centre: np.ndarray, settings: Settings) -> tuple[int, ...]:
    """The parts that a map at a place does not hold: those that move, and mirrors whose box the place is in."""
    p = centre - scene.origin
    gone = set(scene.moving_parts)
    first, _, corners = scene.boxes
    inside = set(first[((corners.min(axis=1) < p) & (p < corners.max(axis=1))).all(axis=1)].tolist())
    for k, part in enumerate(scene.parts):
        if part.first_vertex in inside and part.triangle_count and mirror_weight(scene, part, settings):
            gone.add(k)
    return tuple(gone)


def place_maps(scene: Scene, settings: Settings) -> Placement:
    """Propose places of reference maps along the paths of the mirrors.

    From places on the paths rays go out in all directions. For each point met and each candidate the error is half a texel
    of the map as the place sees it if the candidate sees the point, else the angle, at the place, between the point and what
    the candidate has in its direction. Candidates are taken greedily until the mean of the best errors is below
    `rem_error_px`, `rem_limit` maps are placed, or another one would not help.
    """
    positions, owners = _paths(scene, settings)
    if not len(positions):
        return Placement((), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    candidates = _spread(positions, CANDIDATES_MAX)
    judged = _spread(positions, POSITIONS_MAX)
    texel = 2.0 / settings.environment_resolution
    errors, seen = _errors(scene, positions[judged], owners[judged], positions[candidates], texel, settings.threads)
    chosen: list[int] = []
    best = np.full(errors.shape[1], UNSEEN_MAX)
    while len(chosen) < min(settings.rem_limit, len(candidates)):
        means = np.minimum(errors, best).mean(axis=1) if errors.shape[1] else np.zeros(len(errors))
        next_ = int(np.argmin(means))
        before = float(best.mean()) if len(best) else 0.0
        if chosen and (before / texel <= settings.rem_error_px or means[next_] > (1.0 - LEAST_GAIN) * before):
            break
        chosen.append(next_)
        best = np.minimum(errors[next_], best)
    centres = positions[candidates[chosen]]
    error, unseen = _judged(errors[chosen], seen[chosen], texel)
    return Placement(("",) * len(chosen), centres, np.tile(np.eye(3), (len(chosen), 1, 1)), error, unseen)


def told_of(placement: Placement) -> str:
    """What is predicted of maps that were placed, for a note."""
    return (
        f"{len(placement.centres)} placed along the paths of its mirrors: {placement.error_px:.1f} texels predicted error, "
        f"{100 * placement.unseen:.0f} % of what is reflected is seen by none"
    )


def predicted_error(scene: Scene, centres: np.ndarray, settings: Settings) -> tuple[float, float]:
    """What maps at some places (world, [n, 3]) are worth: see `Placement.error_px` and `Placement.unseen`."""
    positions, owners = _paths(scene, settings)
    if not len(positions) or not len(centres):
        return 0.0, 0.0
    judged, texel = _spread(positions, POSITIONS_MAX), 2.0 / settings.environment_resolution
    return _judged(*_errors(scene, positions[judged], owners[judged], centres, texel, settings.threads), texel)


def _judged(errors: np.ndarray, seen: np.ndarray, texel: float) -> tuple[float, float]:
    """Mean of the best errors of all points in texels, and the share of the points that nothing sees."""
    if not errors.shape[1]:
        return 0.0, 0.0
    return float(errors.min(axis=0).mean() / texel), float(1.0 - seen.any(axis=0).mean())


def draw_maps(scene: Scene, placement: Placement, settings: Settings) -> CubeMaps:
    """The maps of some places, all texels in full."""
    return render_maps(
        scene.with_still_rays(),
        placement.centres,
        settings.environment_resolution,
        axes=placement.axes,
        without=[left_out(scene, centre, settings) for centre in placement.centres],
        shadows=asked_shadows(scene, settings),
        threads=settings.threads,
        kernels=settings.kernels,
    )


def world_digest(scene: Scene, settings: Settings) -> str:
    """Digest, 32 hexadecimal digits, of what reference maps are drawn from: what stands still, its materials, the lights."""
    digest = hashlib.blake2b(baked_environments.LAYOUT.encode(), digest_size=DIGEST_BYTES)

    def add(value) -> None:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.dtype.str}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
        elif dataclasses.is_dataclass(value):
            for field in dataclasses.fields(value):
                add(getattr(value, field.name))
        elif isinstance(value, dict):
            add(sorted(value))
            add([value[key] for key in sorted(value)])
        elif isinstance(value, (list, tuple)):
            digest.update(str(len(value)).encode())
            for item in value:
                add(item)
        else:
            digest.update(repr(value).encode() + b"\n")

    data = scene.data
    still = [each for each in data.instances if not each.moves]
    for number in sorted({each.mesh for each in still}):
        add(data.meshes[number])
    add(still)
    add([data.materials, data.lights, data.pictures, asked_shadows(scene, settings)])
    add([getattr(settings, name) for name in ("reflector_max_roughness", "reflector_min_weight")])
    return digest.hexdigest()


def authored(scene: Scene) -> Placement:
    """The places that the stage names."""
    given = scene.data.environment_maps
    frames = np.array([each.world_from_map for each in given]).reshape(-1, 4, 4)
    axes = frames[:, :3, :3] / np.maximum(np.linalg.norm(frames[:, :3, :3], axis=1, keepdims=True), 1e-300)
    return Placement(tuple(each.path for each in given), frames[:, :3, 3].copy(), axes)


def _make(scene: Scene, settings: Settings) -> ReferenceMaps:
    notes: list[Note] = []
    asked = authored(scene)
    usable, told = usable_places(scene, settings)
    notes += told
    texels = {k: texel for k, texel in _from_files(scene, settings, notes).items() if k in usable}
    rest = [k for k in usable if k not in texels]
    edge = settings.environment_resolution
    if texels and not rest:
        edge = next(iter(texels.values()))[0].shape[1]
    for k in [k for k, (radiance, _) in texels.items() if radiance.shape[1] != edge]:
        notes.append(Note(asked.paths[k], f"environment map: its file has another resolution than {edge}; drawn anew"))
        del texels[k]
        rest.append(k)
    if rest:
        part = Placement(tuple(asked.paths[k] for k in rest), asked.centres[rest], asked.axes[rest])
        drawn = draw_maps(scene, part, settings.replace(environment_resolution=edge))
        texels |= {k: (drawn.radiance(number), drawn.distance(number)) for number, k in enumerate(rest)}
    if texels:
        order = sorted(texels)
        placement = Placement(tuple(asked.paths[k] for k in order), asked.centres[order], asked.axes[order])
        arrays = (np.stack([texels[k][i] for k in order]) for i in (0, 1))
        maps = stored_maps(scene, placement.centres, placement.axes, *arrays)
        reach = reach_of(placement.centres)
    else:
        placement, reach = place_maps(scene, settings), float("inf")
        if not len(placement.centres):
            placement = Placement(("",), scene.origin[None].copy(), np.eye(3)[None])
        maps = draw_maps(scene, placement, settings)
        what = "none of its environment maps can be used" if asked.paths else "it names no places of environment maps"
        notes.append(Note("/", f"{what}; {told_of(placement)}"))
    # At another time the numbers of triangles are others: they are not kept.
    maps = pack_maps(maps) if settings.rem_texels == "packed" else maps.at(scene)
    return ReferenceMaps(maps, placement, tuple(notes), reach)


def _from_files(scene: Scene, settings: Settings, notes: list[Note]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """(radiance, distance) of the authored places whose files can be used, by number."""
    found = {}
    world = world_digest(scene, settings) if any(each.map_file for each in scene.data.environment_maps) else ""
    for k, each in enumerate(scene.data.environment_maps):
        if not each.map_file:
            continue
        try:
            found[k] = baked_environments.read_map(each, world)
        except (OSError, ValueError) as fault:
            notes.append(Note(each.path, f"environment map: {fault}; drawn anew"))
    return found


def reach_of(centres: np.ndarray) -> float:
    """The largest distance of a map from its nearest neighbour: how far apart maps are meant to be; inf for one."""
    if len(centres) < 2:
        return float("inf")
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    return float(apart.min(axis=1).max())


def _paths(scene: Scene, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Centres of the mirrors at some times of the stage, float64 [n, 3], and their parts here (-1: it moves), int [n]."""
    mirrors = [k for k, part in enumerate(scene.parts) if mirror_weight(scene, part, settings)]
    moving = [k for k in mirrors if k in set(scene.moving_parts)]
    places = [(centre_of(scene, k), -1 if k in moving else k) for k in mirrors]
    if moving and scene.data.time_range is not None:
        start, end = scene.data.time_range
        for time in np.linspace(start, end, PATH_TIMES):
            then = scene.at(float(time))
            if len(then.parts) == len(scene.parts):
                places += [(centre_of(then, k), -1) for k in moving]
    return np.array([place for place, _ in places]).reshape(-1, 3), np.array([part for _, part in places], int)


def _spread(points: np.ndarray, most: int) -> np.ndarray:
    """Indices of at most so many points, far from each other, none twice: the farthest from those before it is the next."""
    chosen = [0]
    distance = np.linalg.norm(points - points[0], axis=1)
    least = SAME_PLACE * max(float(distance.max()), 1e-30)
    while len(chosen) < min(most, len(points)):
        farthest = int(np.argmax(distance))
        if distance[farthest] <= least:
            break
        chosen.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    return np.array(chosen)


def _sphere(count: int) -> np.ndarray:
    """Directions spread over the sphere (a Fibonacci lattice), float64 [count, 3]."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - height * height)
    return np.stack([radius * np.cos(turn), height, radius * np.sin(turn)], axis=1)


def _errors(
    scene: Scene, places: np.ndarray, owners: np.ndarray, candidates: np.ndarray, texel: float, threads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Errors in radians, float64 [candidates, points], and which points a candidate sees, bool likewise."""
    tracer, directions = scene.still_tracer, _sphere(RAYS)
    eyes, points = [], []
    for place, owner in zip(places - scene.origin, owners, strict=True):
        body = bvh.body_of(scene, int(owner), convex=True)
        triangle, t, _, _ = tracer.trace(np.tile(place, (RAYS, 1)), directions, threads, body)
        hit = triangle.numpy() >= 0
        points.append(place + t.numpy()[hit, None].astype(np.float64) * directions[hit])
        eyes.append(np.tile(place, (int(hit.sum()), 1)))
    eye, point = np.concatenate(eyes), np.concatenate(points)
    errors = np.zeros((len(candidates), len(point)))
    seen = np.zeros(errors.shape, bool)
    to_point = point - eye
    near = np.maximum(np.linalg.norm(to_point, axis=1), 1e-30)
    for k, candidate in enumerate(candidates - scene.origin):
        ray = point - candidate
        distance = np.maximum(np.linalg.norm(ray, axis=1), 1e-30)
        # The mirror that a candidate stands in is no obstacle.
        same = np.flatnonzero(np.linalg.norm(places - scene.origin - candidate, axis=1) == 0.0)
        body = bvh.body_of(scene, int(owners[same[0]]) if len(same) else -1, convex=True)
        triangle, t, _, _ = tracer.trace(np.tile(candidate, (len(ray), 1)), ray / distance[:, None], threads, body)
        reached = np.where(triangle.numpy() >= 0, t.numpy().astype(np.float64), np.inf)
        seen[k] = reached >= (1.0 - SEEN_SLACK) * distance
        shown = candidate + np.minimum(reached, distance)[:, None] * ray / distance[:, None] - eye
        angle = np.arctan2(np.linalg.norm(np.cross(shown, to_point), axis=1), (shown * to_point).sum(axis=1))
        errors[k] = np.where(seen[k], 0.5 * texel * distance / near, np.minimum(angle, UNSEEN_MAX))
    return np.minimum(errors, UNSEEN_MAX), seen


def _key(settings: Settings) -> tuple:
    names = ("environment_resolution", "rem_texels", "rem_limit", "rem_error_px", "shadows")
    names += ("dome_shadows", "shadow_samples", "shadow_sharing", "reflector_max_roughness", "reflector_min_weight")
    return (KEY, *(getattr(settings, name) for name in names))


def known_maps(scene: Scene, settings: Settings) -> ReferenceMaps | None:
    """The stage's reference maps where they have been made."""
    return scene.environments.get(_key(settings))


def same_numbers(earlier: Scene, scene: Scene) -> bool:
    """Whether triangles of two scenes of a stage that have the same number are the same ones, at other times."""
    one, other = ([(part.first_triangle, part.triangle_count) for part in each.parts] for each in (earlier, scene))
    return one == other


def _same_places(earlier: Scene, scene: Scene) -> bool:
    one, other = (authored(each) for each in (earlier, scene))
    return one.paths == other.paths and np.array_equal(one.centres, other.centres)


def _still_prims(scene: Scene) -> list[tuple]:
    return [(each.prim_path, each.instance, each.mesh) for each in scene.data.instances if not each.moves]
