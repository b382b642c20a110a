"""Second reflections solved forward: what a flat mirror shows of another is that one's own picture from an eye behind the plane.

Real-Time Rendering, 3rd edition, section 9.3.1 (the eye mirrored in the plane), applied to what the flat mirror shows instead
of to the scene: seen from there, the other mirror is reflected by any forward technique as it is, plane or convex body.
Behind a curved mirror there is no such eye, and deeper reflections have mixed ways: both are followed by rays (`bounces`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warp_reflect import applicable, compact
from warp_reflect.budget import Costs, predict
from warp_reflect.launch import thread_count
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer, pixel_bounds
from warp_reflect.pictures import NORMAL
from warp_reflect.scene import Scene
from warp_reflect.techniques import TECHNIQUES, planar


def mirrored_camera(camera: Camera, plane: tuple[np.ndarray, np.ndarray]) -> Camera:
    """The camera behind a plane whose pixels see directly what the given one's see in it; its axes are left-handed."""
    point, normal = plane

    def mirrored(v: np.ndarray) -> np.ndarray:
        return v - 2.0 * (v @ normal) * normal

    return replace(
        camera,
        eye=camera.eye - 2.0 * ((camera.eye - point) @ normal) * normal,
        right=mirrored(camera.right),
        up=mirrored(camera.up),
        forward=mirrored(camera.forward),
        path="",
    )


def solved_forward(
    scene: Scene, row, rows: Sequence, shares: Mapping[int, float], method: str, camera: Camera, costs: Costs
) -> dict[int, str]:
    """By the id of each mirror that a flat one shows: the technique that solves it from the mirrored eye, where rays do not.

    Args:
        scene: The plan's.
        row: The flat mirror's `PlanRow`.
        rows: Those of all mirrors.
        shares: By part of each mirror that it shows, the share of its pixels that do.
        method: The plan's; one of `applicable.PREFERRED` is taken wherever it applies.
        camera: The plan's.
        costs: Of the machine.
    """
    part = scene.parts[row.reflector.part]
    if method not in ("auto", *applicable.PREFERRED) or _bumpy(scene, row) or not planar.is_flat(scene, part)[0]:
        return {}
    eye = mirrored_camera(camera, planar.plane_of(scene, row.reflector.part))
    by_part = {other.reflector.part: other for other in rows}
    found = {}
    for shown, share in shares.items():
        other = by_part[shown]
        pixels = max(round(share * row.pixels), 1)
        technique = "" if _bumpy(scene, other) else _chosen(scene, other, eye, pixels, method, costs)
        if technique:
            found[other.reflector.id] = technique
    return found


def _bumpy(scene: Scene, row) -> bool:
    """Whether its rays are turned pixel by pixel."""
    return NORMAL in scene.data.materials[scene.parts[row.reflector.part].material].textures


def _chosen(scene: Scene, other, eye: Camera, pixels: int, method: str, costs: Costs) -> str:
    """The technique that is asked for and applies, or that is cheaper than rays; empty: rays."""
    settings, reflector = other.settings, other.reflector
    if method != "auto":
        return method if applicable.applies(scene, reflector, eye, method, settings)[0] else ""
    if pixels < settings.few_pixels:
        return ""
    threads = thread_count(scene.device, settings.threads)

    def ms(technique: str) -> float:
        work = applicable.work_of(scene, reflector, eye, technique, pixels, settings)
        return predict(work, technique, settings, costs, threads)["first_ms"]

    found, _ = applicable.exact_candidates(scene, reflector, eye, pixels, settings, costs)
    best = min((each.technique for each in found), key=ms, default="")
    return best if best and ms(best) < ms("raytraced") else ""


def answers(scene: Scene, gbuffer: GBuffer, plan, reflector: int) -> Callable[[ReflectionLayer, wp.array], None]:
    """What fills in the second reflections of a flat mirror that its plan solves forward.

    Args:
        scene: The plan's.
        gbuffer: What the eye sees.
        plan: Whose row of that mirror has them (`solved` among the numbers of `second_bounce`).
        reflector: The mirror's id.

    Returns:
        (layer, facet) -> None: of rays that left other mirrors' facets (int32 [n]) after the eye's rays left this one, it
        answers those of the mirrors that are solved forward; the status of others stays NONE.
    """
    rows = {row.reflector.id: row for row in plan.rows}
    own = rows[reflector]
    eye = mirrored_camera(gbuffer.camera, planar.plane_of(scene, own.reflector.part))
    mirror_of_patch = np.zeros(max(len(scene.patch_shapes), 1), np.int32)
    for number, row in rows.items():
        mirror_of_patch[list(scene.parts[row.reflector.part].patches)] = number

    def fill(layer: ReflectionLayer, facet: wp.array) -> None:
        facets = facet.numpy()
        met = mirror_of_patch[scene.host_triangle_patch[facets]]
        names = ("triangle", "u", "v", "distance", "status")
        hosts = {name: getattr(layer, name).numpy() for name in names}
        for number, technique in own.effects["second_bounce"].numbers["solved"].items():
            chosen = np.flatnonzero(met == number)
            if not len(chosen):
                continue
            row = rows[number]
            seen, pixels = _seen_from(scene, eye, layer, facets, chosen, number)
            prepared = plan.prepared(row, technique)
            answer = TECHNIQUES[technique].reflect(scene, prepared, seen, pixels, eye, row.settings, None)
            for name in names:
                hosts[name][chosen] = getattr(answer, name).numpy()
            layer.statistics["mirrored_eye"] = layer.statistics.get("mirrored_eye", 0) + len(chosen)
        for name in names:
            getattr(layer, name).assign(hosts[name])

    return fill


def _seen_from(
    scene: Scene, eye: Camera, layer: ReflectionLayer, facets: np.ndarray, chosen: np.ndarray, number: int
) -> tuple[GBuffer, MirrorPixels]:
    """What an eye behind a plane sees of one mirror: the facets that rays leave, the mask, and the rays themselves."""
    device, count = scene.device, eye.size[0] * eye.size[1]
    pixel = layer.pixels.pixel.numpy()[chosen]
    triangle, reflector = np.full(count, -1, np.int32), np.zeros(count, np.int32)
    triangle[pixel], reflector[pixel] = facets[chosen], number
    vectors = [
        wp.array(array.numpy()[chosen], dtype=wp.vec3, device=device)
        for array in (layer.pixels.point, layer.pixels.normal, layer.pixels.direction)
    ]
    gbuffer = GBuffer(
        eye,
        eye.view(scene),
        wp.array(triangle, dtype=int, device=device),
        compact.none(float, device),
        wp.array(reflector, dtype=int, device=device),
    )
    numbers = wp.array(pixel, dtype=int, device=device)
    return gbuffer, MirrorPixels(number, numbers, *vectors, pixel_bounds(pixel, eye.size[0]))
