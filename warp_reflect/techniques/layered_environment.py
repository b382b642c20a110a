"""A local environment map at every mirror's centre, blended from reference environment maps: many moving mirrors, no rendering.

Source: Meyer and Loscos, Real-Time Reflection on Moving Vehicles in Urban Environments, VRST 2003. `reference_maps.py` has
the maps, `local_map.py` the local map. Differs from it by: a mirror's pixel is not looked up by its reflected direction
alone, but by where its own ray meets what the local map holds: the triangles of the texels that it passes, seen from the
map's eye, are asked, and the nearest that it hits is shown (after Szirmay-Kalos et al., Approximate Ray-Tracing on the GPU
with Distance Impostors, Eurographics 2005, who have distances only; a triangle's hit is exact).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
import warp as wp

from warp_reflect import bvh, launch
from warp_reflect.cubemap import FACE_COUNT
from warp_reflect.environment_maps import CubeMaps, CubeMapsView, Onward, copied_maps, fetch_radiance, nearest_texel
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Note, Scene, SceneView
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.shade import LightView
from warp_reflect.shapes import TriangleHit, clamp_weights, intersect_triangle, unit
from warp_reflect.techniques import local_map, local_mesh, local_movers, local_shading, reference_maps
from warp_reflect.techniques.environment import Shown, centre_of, onward_of, vehicle_of
from warp_reflect.techniques.local_maps import SIDES, LocalMaps
from warp_reflect.techniques.local_movers import moving_in
from warp_reflect.techniques.reference_maps import ReferenceMaps

wp.set_module_options({"enable_backward": False})

CONVERGED = wp.constant(int(Status.CONVERGED))
SKY = wp.constant(int(Status.SKY))
HIDDEN = wp.constant(int(Status.HIDDEN))
MAX_ITERATIONS = wp.constant(int(Status.MAX_ITERATIONS))
MISSING = wp.constant(local_shading.TEXEL_MISSING)
KEY, SHOWN_KEY, FIELD_KEY = "local maps", "local maps with what moves", "field of local maps"
PLANE_STEPS = wp.constant(3)  # from texel to texel; walls settle in one or two
NAMED = 4  # prims that a note names
NO_CELLS = np.zeros((0, 4), np.int32)
CANDIDATES_PER_MAP = 2  # maps that are looked at for each that is blended, where more than two are


@dataclass(frozen=True)
class Prepared:
    """A mirror's local map at `centre` (world, float64 [3]) and what building it met.

    Attributes:
        state: Of its texels, see `local_map.blend_local_map`.
        cells: Of its depths' adaptive mesh, see `local_mesh.DepthMesh`.
        movers: Parts that move and that it may show.
        slack: Length by which its depths may be off.
        together: Whether its arrays are parts of those of all maps that were made with it.
    """

    part: int
    centre: np.ndarray
    references: ReferenceMaps
    local: CubeMaps
    state: wp.array
    cells: np.ndarray
    movers: tuple[int, ...] = ()
    slack: float = 0.0
    statistics: dict = field(default_factory=dict)
    timings: dict = field(default_factory=dict)
    together: bool = False


def applies(scene: Scene, reflector) -> tuple[bool, str]:
    """A local map asks nothing of a mirror."""
    named = len(scene.data.environment_maps)
    maps = f"{named} reference maps" if named else "reference maps placed along the paths of the mirrors"
    return True, f"a local map is blended from {maps}"


def plan_notes(scene: Scene, reflector, settings: Settings) -> list[Note]:
    """Notes for a plan: maps that cannot be used, mirrors beyond them, memory."""
    usable, notes = reference_maps.usable_places(scene, settings)
    notes, part = list(notes), scene.parts[reflector.part]
    if usable:
        centres = reference_maps.authored(scene).centres[usable]
        notes += _beyond(scene, reflector.part, centres, reference_maps.reach_of(centres))
        if len(centres) == 1 and settings.rem_count > 1:
            notes.append(Note(part.prim_path, "there is one environment map: what it does not see is not blended"))
    elif scene.data.environment_maps:
        notes.append(
            Note("/", "none of its environment maps can be used: maps are placed along the paths of its mirrors")
        )
    vehicle = list(dict.fromkeys(scene.parts[k].prim_path for k in vehicle_of(scene, reflector.part, settings)))
    if vehicle:
        named = ", ".join(vehicle[:NAMED]) + (f" and {len(vehicle) - NAMED} more" if len(vehicle) > NAMED else "")
        text = f"its own vehicle is not in its local map: {named} (local_own_size={settings.local_own_size:g})"
        notes.append(Note(part.prim_path, text))
    megabytes = reference_maps.predicted_bytes(scene, settings) / 1e6
    most = "" if usable else "at most "
    count = len(usable) or settings.rem_limit
    notes.append(
        Note(
            "/",
            f"{most}{count} reference environment maps: {most}{megabytes:.1f} MB, shared by all mirrors (rem_texels)",
        )
    )
    return notes


def prepare(scene: Scene, reflector, settings: Settings) -> Prepared:
    """Build the mirror's local map; the scene's reference maps are drawn at first use."""
    return prepare_together(scene, [(reflector, settings)])[0]


def prepare_together(scene: Scene, asked: Sequence[tuple]) -> list[Prepared]:
    """As `prepare`, of several (reflector, settings) at once: the same maps by fewer launches."""
    found: dict[int, Prepared] = {}
    for numbers in _alike(settings for _, settings in asked):
        chosen = {k: (asked[k][0].part, asked[k][1]) for k in numbers}
        found |= dict(zip(chosen, _prepared(scene, list(chosen.values())), strict=True))
    return [found[k] for k in range(len(asked))]


def _alike(settings) -> list[list[int]]:
    """Numbers of the settings that differ in `local_resolution` alone, together: not where mirrors show others' maps."""
    groups: dict[tuple, list[int]] = {}
    for k, each in enumerate(settings):
        free = "local_resolution" if each.bounces <= 1 else ""
        groups.setdefault(tuple(value for name, value in vars(each).items() if name != free), []).append(k)
    return list(groups.values())


def _prepared(scene: Scene, asked: list[tuple[int, Settings]]) -> list[Prepared]:
    """The local maps of some (part, settings), whose settings differ in their resolutions alone."""
    settings = asked[0][1]
    movers = {part: moving_in(scene, part, settings) for part, _ in asked}
    alone = settings.environment_update == "previous"
    drawn = [each for each in dict.fromkeys(asked) if movers[each[0]] and not alone]
    missing = [each for each in drawn if (SHOWN_KEY, *each) not in scene.environments]
    # A map of what stands still is kept apart where another frame or another mirror may ask for it.
    apart = settings.local_keep_px > 0.0 or settings.bounces > 1
    still = _still_maps(scene, asked if apart else [each for each in asked if each not in drawn])
    if missing:
        scene.environments |= _drawn(scene, missing, [still[each] for each in missing] if apart else None, movers)
    found = [scene.environments[SHOWN_KEY, *each] if each in drawn else still[each] for each in asked]
    for each in found:
        beyond = _beyond(scene, each.part, each.references.placement.centres, each.references.reach)
        scene.notes += [note for note in beyond if note not in scene.notes]
    return [replace(each, movers=movers[each.part]) if alone else each for each in found]


def _drawn(scene: Scene, asked: list[tuple[int, Settings]], still: list[Prepared] | None, movers: dict) -> dict:
    """Local maps with what moves, by their keys; from those of what stands still, or all at once."""
    settings, start = asked[0][1], perf_counter()
    if still is None:
        local, references, slack = _blended(scene, asked)
        blended = perf_counter()
        timings = {"local_blend": 1e3 * (blended - start) / len(asked)}
        shading = settings
    else:
        local = LocalMaps.empty(scene, [each.centre for each in still], [each.local.resolution for each in still])
        for k, each in enumerate(still):
            local.put(k, each.local, each.state)
        timings, blended, shading = {}, start, settings.replace(rem_missing="best")
    local_movers.meet_moving(scene, local, [movers[part] for part, _ in asked], settings)
    local_shading.shade(scene, local, shading, lambda: _onward_of_still_maps(scene, local, settings))
    timings["local_moving"] = 1e3 * (perf_counter() - blended) / len(asked)
    made = {}
    for k, (part, own) in enumerate(asked):
        cube, state = local.cube_map(k)
        moving = {"local_moving": local.statistics[k].get("local_moving", 0)}
        if still is None:
            known = Prepared(
                part, local.centres[k], references, cube, state, local.cells.get(k, NO_CELLS), (), slack[k]
            )
            statistics = local.statistics[k] | moving
        else:
            known, statistics = still[k], still[k].statistics | moving
        timings = known.timings | timings
        key = (SHOWN_KEY, part, own)
        made[key] = replace(
            known, local=cube, state=state, movers=movers[part], statistics=statistics, timings=timings, together=True
        )
    return made


def _still_maps(scene: Scene, asked: list[tuple[int, Settings]]) -> dict[tuple[int, Settings], Prepared]:
    """Mirrors' local maps of what stands still, built at first use and kept with the scene; settings as for `_prepared`."""
    missing = [each for each in dict.fromkeys(asked) if (KEY, *each) not in scene.environments]
    if missing:
        start = perf_counter()
        local, references, slack = _blended(scene, missing)
        local_shading.shade(scene, local, missing[0][1])
        timings = {"local_blend": 1e3 * (perf_counter() - start) / len(missing)}
        for k, (part, own) in enumerate(missing):
            cube, state = local.cube_map(k)
            cells, statistics = local.cells.get(k, NO_CELLS), local.statistics[k]
            scene.environments[KEY, part, own] = Prepared(
                part, local.centres[k], references, cube, state, cells, (), slack[k], statistics, timings, True
            )
    return {each: scene.environments[KEY, *each] for each in asked}


def _blended(scene: Scene, asked: list[tuple[int, Settings]]) -> tuple[LocalMaps, ReferenceMaps, list[float]]:
    """(Local maps blended from reference maps, what these do not see not shaded; the reference maps; `Prepared.slack`)."""
    settings = asked[0][1]
    references = reference_maps.reference_maps(scene, settings)
    centres = np.array([centre_of(scene, part) for part, _ in asked])
    # A field holds what never moves: the body of a mirror that stands still would be around its own centre.
    by_field = np.array([settings.local_rays == "field" and part in scene.moving_parts for part, _ in asked])
    swept, known = np.zeros(len(asked), bool), None
    if by_field.any():
        from warp_reflect.techniques import local_field

        known = local_field.local_field(scene, settings)
        if known is not None and known.sides is not None:
            swept = by_field & local_field.in_the_open(scene, known, centres)
    meshes, slack = {}, np.where(swept, known.field.cell if known is not None else 0.0, 0.0)
    for k in np.flatnonzero(~swept).tolist():
        part, own = asked[k]
        intersect = intersect_still(scene, part, centres[k], settings.threads)
        mesh = None
        ask = (own.local_edge, settings.mesh_cells, settings.depth_ratio)
        if by_field[k] and known is not None and known.sides is None:
            mesh = local_field.depths(scene, known, centres[k], *ask, settings.threads)
            slack[k] = known.field.cell if mesh is not None else 0.0
        if mesh is None:
            mesh = local_mesh.trace_depth_mesh(
                ask[0], intersect, *ask[1:], device=scene.device, threads=settings.threads
            )
        meshes[k] = mesh, intersect
    local = LocalMaps.empty(scene, centres, [own.local_edge for _, own in asked], slack, swept)
    if swept.any():
        local_field.sweep(scene, known, local, settings)
    for k, (mesh, _) in meshes.items():
        local_map.put_mesh(local, k, mesh)
        local.cells[k] = mesh.cells
    rems = np.array([nearest_maps(references, centre, settings.rem_count) for centre in centres])
    local_map.blend(scene, local, references.maps, rems, settings)
    local_map.blend_again(scene, local, meshes, references.maps, rems, settings)
    for k, known_of_map in enumerate(local.statistics):
        if k in meshes:
            known_of_map |= meshes[k][0].statistics
        else:
            known_of_map["local_lines"] = SIDES * local.layout.resolutions[k]
    return local, references, slack.tolist()


def take_over(earlier: Scene, scene: Scene) -> None:
    """Hand over reference maps, and local maps that have moved little, to the same stage's scene at another time.

    A pixel follows its own ray through a local map wherever that stands: what a map that stays behind lacks is what its place
    does not see, or sees coarsely.
    """
    reference_maps.take_over(earlier, scene)
    if earlier is scene or not reference_maps.same_numbers(earlier, scene):
        return
    local_movers.take_over(earlier, scene)
    if any(key[0] == FIELD_KEY for key in earlier.environments):
        from warp_reflect.techniques import local_field

        local_field.take_over(earlier, scene)
    for key, known in earlier.environments.items():
        if key[0] != KEY or key in scene.environments or key[2].local_keep_px == 0.0:
            continue
        if reference_maps.known_maps(scene, key[2]) is None:
            continue
        shift = shift_px(known.local, centre_of(scene, key[1]))
        if shift < key[2].local_keep_px:
            local = known.local
            if known.together:  # its arrays are those of all that were made with it
                local = copied_maps(local)
            triangle = local.view.triangle
            local = local.at(scene)
            local.view.triangle = triangle
            statistics = known.statistics | {"local_kept": 1}
            references = reference_maps.known_maps(scene, key[2])
            scene.environments[key] = replace(
                known, references=references, local=local, statistics=statistics, timings={}, together=False
            )


def shift_px(local: CubeMaps, centre: np.ndarray) -> float:
    """By how many texels what a map holds is shifted, in the mean, as seen from another place; the sky by none."""
    moved = float(np.linalg.norm(centre - local.centres[0]))
    distance = local.view.distance.numpy()[: FACE_COUNT * local.resolution**2].astype(np.float64)
    met = distance > 0.0
    angle = np.arctan2(moved, distance[met]).sum() / len(distance)
    return float(angle * local.resolution / (0.5 * np.pi))


def _onward_of_still_maps(scene: Scene, local: LocalMaps, settings: Settings) -> Onward | None:
    """What mirrors that move through some maps show: their local maps of what stands still."""
    if settings.bounces <= 1:
        return None
    shown = np.unique(local.triangle.numpy()[local.state.numpy() == local_shading.TEXEL_MOVING])
    first = np.array([scene.parts[k].first_triangle for k in scene.moving_parts])
    count = np.array([scene.parts[k].triangle_count for k in scene.moving_parts])
    seen = np.searchsorted(shown, first) < np.searchsorted(shown, first + count)
    parts = [k for k, its in zip(scene.moving_parts, seen, strict=True) if its]
    mirrors = [k for k in parts if mirror_weight(scene, scene.parts[k], settings)]
    if not mirrors:
        return None
    from warp_reflect.techniques import mirror_maps

    still = _still_maps(scene, [(k, settings) for k in mirrors])
    return mirror_maps.of_maps(scene, {part: each.local for (part, _), each in still.items()}, settings.threads)


def intersect_still(scene: Scene, part: int, centre: np.ndarray, threads: int) -> local_mesh.Intersect:
    """Rays from a mirror's centre through the BVH of what never moves, the mirror itself left out: exact."""
    tracer = scene.still_tracer
    origin = centre - tracer.origin
    body = bvh.body_of(scene, -1 if part in scene.moving_parts else part, convex=True)

    def intersect(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        triangle, t, _, _ = tracer.trace(np.tile(origin, (len(directions), 1)), directions, threads, body)
        return np.where(triangle.numpy() >= 0, t.numpy(), np.float32(0.0)), triangle.numpy()

    return intersect


def nearest_maps(references: ReferenceMaps, centre: np.ndarray, count: int) -> np.ndarray:
    """Numbers of the reference maps that a local map looks at, the nearest first."""
    looked_at = count if count <= 2 else min(CANDIDATES_PER_MAP * count, local_map.REMS_MAX)
    distance = np.linalg.norm(references.placement.centres - centre, axis=1)
    return np.argsort(distance, kind="stable")[:looked_at]


def _beyond(scene: Scene, part: int, centres: np.ndarray, reach: float) -> list[Note]:
    nearest = float(np.linalg.norm(centres - centre_of(scene, part), axis=1).min())
    if nearest <= reach:
        return []
    text = f"{nearest:.3g} from the nearest environment map, which are {reach:.3g} apart: its reflection may be coarse"
    return [Note(scene.parts[part].prim_path, text)]


@wp.func
def intersect_texel(scene: SceneView, triangle: int, origin: wp.vec3, ray: wp.vec3) -> TriangleHit:
    """A ray against the triangle that a texel holds."""
    corner = scene.triangles[triangle]
    return intersect_triangle(origin, ray, scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]])


@wp.kernel
def look_up_kernel(
    first: int,
    scene: SceneView,
    lights: LightView,
    local: CubeMapsView,
    state: wp.array(dtype=wp.uint8),
    steps: int,
    point: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Outputs:
    out_triangle: wp.array(dtype=int),
    out_u: wp.array(dtype=float),
    out_v: wp.array(dtype=float),
    out_distance: wp.array(dtype=float),
    out_status: wp.array(dtype=wp.uint8),
    out_radiance: wp.array(dtype=wp.vec3),
    out_settled: wp.array(dtype=wp.uint8),
):
    """One thread per mirror pixel: to what the local map holds that its ray meets."""
    i = first + wp.tid()
    ray = direction[i]
    start = point[i] - local.centre[0]
    towards = ray
    texel = nearest_texel(local, 0, towards)
    t = local.distance[texel]
    settled = int(0)
    found = int(-1)
    # From the texel of its direction to where it meets the plane of what that holds, and on from there.
    step = int(0)
    while step < wp.min(steps, PLANE_STEPS) and settled == 0 and local.distance[texel] > 0.0:
        step += 1
        along = float(-1.0)
        triangle = local.triangle[texel]
        if triangle >= 0:
            hit = intersect_texel(scene, triangle, point[i], ray)
            if hit.det != 0.0:
                along = hit.t
                if hit.hit == 1 and hit.t > 0.0:
                    settled = int(1)
                    found = triangle
                    out_u[i] = hit.u
                    out_v[i] = hit.v
        if along <= 0.0:
            # Past the plane: the sphere of the texel's distance around the centre.
            middle = wp.dot(start, ray)
            inside = local.distance[texel] * local.distance[texel] - wp.dot(start, start) + middle * middle
            along = wp.sqrt(wp.max(inside, 0.0)) - middle
        if along > 0.0 and wp.isfinite(along):
            t = along
            towards = start + t * ray
            texel = nearest_texel(local, 0, towards)
        elif settled == 0:
            step = steps
    # What stands before it: in steps from the mirror's point to the ray's direction, as the map's eye sees them.
    nearest = wp.where(settled == 1, t, float(wp.inf))
    before = int(-1)
    step = int(0)
    while step < steps:
        step += 1
        share = float(step) / float(steps + 1)
        k = nearest_texel(local, 0, start + (wp.length(start) * share / (1.0 - share)) * ray)
        triangle = local.triangle[k]
        if triangle >= 0 and triangle != before and triangle != found:
            before = triangle
            hit = intersect_texel(scene, triangle, point[i], ray)
            if hit.det != 0.0 and hit.hit == 1 and hit.t > 0.0 and hit.t < nearest:
                nearest = hit.t
                settled = int(1)
                found = triangle
                out_u[i] = hit.u
                out_v[i] = hit.v
    off = float(0.0)
    if settled == 1:
        t = nearest
        towards = start + t * ray
        texel = nearest_texel(local, 0, towards)
        out_triangle[i] = found
    else:
        # What is passed on the way to the sky is where it was looked for last.
        triangle = wp.where(local.distance[texel] == 0.0, -1, local.triangle[texel])
        out_triangle[i] = triangle
        if triangle >= 0:
            corner = scene.triangles[triangle]
            a = scene.points[corner[0]] - point[i]
            b = scene.points[corner[1]] - point[i]
            c = scene.points[corner[2]] - point[i]
            hit = intersect_texel(scene, triangle, point[i], ray)
            weights = clamp_weights(hit.u, hit.v)
            if hit.det == 0.0:
                weights = wp.vec2(1.0 / 3.0, 1.0 / 3.0)
            out_u[i] = weights[0]
            out_v[i] = weights[1]
            shown = (1.0 - weights[0] - weights[1]) * a + weights[0] * b + weights[1] * c
            t = wp.length(shown)
            off = wp.length(wp.cross(unit(shown), ray))
        else:
            t = 0.0
            towards = wp.where(local.distance[texel] == 0.0, ray, towards)
    out_distance[i] = t
    status = int(SKY)
    if out_triangle[i] >= 0:
        status = wp.where(off * float(local.resolution) <= 2.0, CONVERGED, MAX_ITERATIONS)
        if int(state[texel]) == MISSING:
            status = HIDDEN
    out_status[i] = wp.uint8(status)
    out_radiance[i] = fetch_radiance(local, lights, 0, unit(towards), 0.0)
    out_settled[i] = wp.uint8(settled)


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Look every mirror pixel up in the mirror's local map.

    Args:
        history: By reflector id the maps of the previous frame; where this mirror's had another level of detail, what is shown
            goes on from it (`level_blend`).

    Returns:
        A layer with `radiance` and status CONVERGED (what is shown lies within a texel of the reflected ray), MAX_ITERATIONS
        (it does not), HIDDEN (no reference map sees it, and it was not shaded) or SKY. Statistics: those of the local map
        (`local_rays`, `local_moving`, `local_discontinuities` and `..._traced`, `rem_texels`, `rem_missing`, `rem_shaded`) and
        `local_settled`: pixels whose ray was found to hit the very triangle that the map holds; `local_blending` 1 where what
        is shown is on its way from one level of detail to another.
    """
    layer, local = _looked_up(scene, prepared, pixels, settings, history)
    levels = ()
    if settings.blends_levels:
        levels = _blend_levels(scene, prepared, layer, settings, history)
        if len(levels) > 1:
            layer.statistics["local_blending"] = 1
    layer.history = Shown(prepared.part, local, 0, levels)
    return layer


def _blend_levels(scene: Scene, prepared: Prepared, layer: ReflectionLayer, settings: Settings, history):
    """Hold a layer's radiance to what its mirror's levels of detail allow, and those: see `level_blend.advanced`."""
    shown = (history or {}).get(layer.pixels.reflector)
    before = shown.levels if shown is not None and shown.part == prepared.part else ()
    edge = settings.local_edge
    if not before or before == ((edge, 0),):
        return ((edge, 0),)
    from warp_reflect.techniques import level_blend  # not compiled where nothing switches

    levels, held, radiance = level_blend.advanced(before, edge), False, None
    for resolution, frames in levels:
        looked_up = layer
        if (resolution, frames) != levels[-1]:
            own = settings.replace(local_resolution=resolution)
            other = _prepared(scene, [(prepared.part, own)])[0]
            looked_up, _ = _looked_up(scene, other, layer.pixels, own, history)
        if radiance is not None:
            held = level_blend.approach(radiance, looked_up.radiance, frames, settings.local_blend, settings.threads)
        radiance = looked_up.radiance
    return levels if held else ((edge, 0),)


def _looked_up(
    scene: Scene, prepared: Prepared, pixels: MirrorPixels, settings: Settings, history
) -> tuple[ReflectionLayer, CubeMaps]:
    """What mirror pixels see in a local map, and that with what moves."""
    layer = ReflectionLayer.empty(pixels, Technique.LAYERED_ENVIRONMENT, scene.device)
    layer.radiance = wp.empty(pixels.count, dtype=wp.vec3, device=scene.device)
    settled = wp.zeros(pixels.count, dtype=wp.uint8, device=scene.device)
    local, state, statistics = prepared.local, prepared.state, prepared.statistics
    if prepared.movers and settings.environment_update == "previous":
        onward = onward_of(scene, prepared.part, settings, history)
        local, state, moved = local_movers.draw_moving(scene, local, state, prepared.movers, lambda: onward, settings)
        statistics = statistics | moved
    inputs = [scene.view, scene.lights, local.view, state, settings.parallax_steps, pixels.point, pixels.direction]
    inputs += [layer.triangle, layer.u, layer.v, layer.distance, layer.status, layer.radiance, settled]
    launch.launch(look_up_kernel, pixels.count, inputs, scene.device, settings.threads)
    layer.statistics.update(statistics)
    layer.statistics.later(lambda: {"local_settled": int(settled.numpy().sum())})
    return layer, local
