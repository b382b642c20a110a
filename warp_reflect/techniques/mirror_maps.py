"""Mirrors in mirrors by maps: what a mirror seen in an environment map shows is looked up in a map of its own.

Source: Akenine-Moller, Haines, Hoffman, Real-Time Rendering, 3rd ed., 2008, section 9.3.2: to a fixed depth (every level
draws the maps of all mirrors with those of the level before), or with the maps of the previous frame, one level a frame.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import warp as wp

from warp_reflect import launch
from warp_reflect.environment_maps import CubeMaps, CubeMapsView, Onward, fetch_radiance, render_maps
from warp_reflect.normal_maps import prepare_normals
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Scene, SceneView
from warp_reflect.settings import Settings
from warp_reflect.shade import LightView, dome_radiance, split_lobes
from warp_reflect.shadows import asked_shadows
from warp_reflect.surface import hit_normal, shown_normal
from warp_reflect.textures import Look, plain_look, prepare_looks

wp.set_module_options({"enable_backward": False})


@wp.kernel
def mirrored_onward_kernel(
    first: int,
    scene: SceneView,
    lights: LightView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    maps: CubeMapsView,
    patch_map: wp.array(dtype=int),
    direction: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    # Changed:
    out_radiance: wp.array(dtype=wp.vec3),
):
    """One thread per texel: a mirror in it shows its own map instead of the domes."""
    i = first + wp.tid()
    tri = triangle[i]
    if tri < 0:
        return
    k = patch_map[scene.triangle_patch[tri]]
    if k < 0:
        return
    n = shown_normal(normals, i, hit_normal(scene, tri, u[i], v[i]))
    cosine = wp.dot(n, direction[i])
    onward = direction[i] - 2.0 * cosine * n
    look = Look()
    if looks.shape[0] > 0:
        look = looks[i]
    else:
        look = plain_look(scene, tri, u[i], v[i])
    weight = split_lobes(look, wp.vec3(0.0, 0.0, 0.0), wp.abs(cosine), False).mirror
    seen = fetch_radiance(maps, lights, k, onward, 0.0) - dome_radiance(lights, onward)
    out_radiance[i] += wp.cw_mul(weight, seen)


def of_depth(scene: Scene, settings: Settings, depth: int) -> Onward:
    """What mirrors in maps show, `depth` reflections deep: maps of all mirrors of the scene, kept with it.

    Args:
        scene: Which surfaces are mirrors is decided by the settings.
        settings: Resolution and shadows of the maps.
        depth: At least 1; a mirror in the deepest maps shows the domes.
    """
    from warp_reflect.techniques.environment import centre_of, left_out

    resolution, shadows = settings.environment_resolution, asked_shadows(scene, settings)
    parts = tuple(k for k, part in enumerate(scene.parts) if mirror_weight(scene, part, settings))
    key = ("mirrors", parts, resolution, shadows, settings.local_own_size, depth)
    if key not in scene.environments:
        deeper = of_depth(scene, settings, depth - 1) if depth > 1 else None
        centres = np.array([centre_of(scene, part) for part in parts]).reshape(-1, 3)
        scene.environments[key] = render_maps(
            scene,
            centres,
            resolution,
            without=[left_out(scene, part, settings) for part in parts],
            onward=deeper,
            shadows=shadows,
            threads=settings.threads,
            kernels=settings.kernels,
        )
    return _onward(scene, [(part, scene.environments[key], k) for k, part in enumerate(parts)], settings.threads)


def of_maps(scene: Scene, known: Mapping[int, CubeMaps], threads: int = 0) -> Onward:
    """What mirrors in maps show: the first map of each part that is named; others show the domes."""
    return _onward(scene, [(part, maps, 0) for part, maps in known.items()], threads)


def of_previous_frame(scene: Scene, before: Mapping[int, object]) -> Onward:
    """What mirrors in maps show: what they showed in the frame before, by reflector id; others show the domes."""
    return _onward(scene, [(shown.part, shown.maps.at(scene), shown.number) for shown in before.values()], 0)


def _onward(scene: Scene, known: list[tuple[int, CubeMaps, int]], threads: int) -> Onward:
    tables = {}
    for part, maps, number in known:
        maps, of_patch = tables.setdefault(id(maps), (maps, np.full(max(len(scene.patch_shapes), 1), -1, np.int32)))
        if part < len(scene.parts):
            of_patch[list(scene.parts[part].patches)] = number
    ready = [(maps, wp.array(of_patch, dtype=int, device=scene.device)) for maps, of_patch in tables.values()]

    def change(gbuffer, layer, radiance: wp.array) -> None:
        looks = prepare_looks(scene, gbuffer, layer, threads)
        normals = prepare_normals(scene, gbuffer, layer, threads)
        for maps, of_patch in ready:
            inputs = [scene.view, scene.lights, looks, normals, maps.view, of_patch, layer.pixels.direction]
            inputs += [layer.triangle, layer.u, layer.v, radiance]
            launch.launch(mirrored_onward_kernel, layer.pixels.count, inputs, scene.device, threads)

    return change
