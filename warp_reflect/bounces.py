"""Mirrors seen in mirrors: reflected rays are followed from what a mirror shows, as far as `bounces` says.

What a mirror shows of another one, or of itself, is shaded with the domes alone where that reflects (`shade.hit_radiance`).
Here the ray is reflected there once more, on the analytic surface where there is one, and what it meets takes the domes'
place; between facing mirrors so often as is asked for, and then the domes stand. A rough mirror seen in a mirror is sharp.

Source: the recursion of Whitted, An Improved Illumination Model for Shaded Display, CACM 1980. Differs from it by: the first
reflection is any technique's, and only reflectors are followed, what is merely glossy shows the domes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

import numpy as np
import warp as wp

from warp_reflect import bvh, compact, launch, ray_walk, shade
from warp_reflect.counts import add_statistics
from warp_reflect.layers import GBuffer, MirrorPixels, ReflectionLayer, Reflector, meeting
from warp_reflect.normal_maps import prepare_normals
from warp_reflect.scene import SHAPE_NONE, Scene, SceneView
from warp_reflect.settings import Status, Technique
from warp_reflect.shade import LightView
from warp_reflect.surface import hit_normal, polish, shown_normal
from warp_reflect.textures import Look, plain_look, prepare_looks

wp.set_module_options({"enable_backward": False})

# Share of the light below which a reflection is not followed: half a step of an 8 bit picture.
LEAST_WEIGHT = wp.constant(2.0e-3)


class Mirrors:
    """The reflectors of a scene, patch by patch.

    Attributes:
        patches: bool [patches], whether each is a reflector's.
    """

    def __init__(self, scene: Scene, reflectors: Iterable[Reflector]):
        self._scene, self._reflectors = scene, list(reflectors)
        self.patches = np.zeros(len(scene.patch_shapes), bool)
        for reflector in self._reflectors:
            self.patches[list(scene.parts[reflector.part].patches)] = True

    @property
    def bodies(self) -> wp.array:
        """`ray_walk.OwnBody` of every patch, without triangles where it is no reflector's."""
        return self._scene.kept("bodies of mirrors", self._reflectors, self._bodies)

    def _bodies(self) -> wp.array:
        # By columns: to make a structure for each of some thousand patches takes as long as a small picture.
        scene, bodies = self._scene, np.zeros(len(self.patches), ray_walk.OwnBody.numpy_dtype())
        for reflector in self._reflectors:
            body, patches = bvh.body_of(scene, reflector.part, reflector.convex), scene.parts[reflector.part].patches
            for name in bodies.dtype.names:
                bodies[name][list(patches)] = getattr(body, name)
        return wp.array(bodies, dtype=ray_walk.OwnBody, device=scene.device)


@wp.kernel
def reflect_hits_kernel(
    first: int,
    scene: SceneView,
    lights: LightView,
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    # Rays, what they met, and which of them are asked:
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    direction: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=int),
    # Outputs:
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_weight: wp.array(dtype=wp.vec3),
    out_domes: wp.array(dtype=wp.vec3),
):
    """One thread per asked ray: its reflection at the mirror that it met, and what the domes gave there; weight 0: too dark."""
    k = first + wp.tid()
    i = index[k]
    out_weight[k] = wp.vec3(0.0, 0.0, 0.0)
    if i < 0:
        return
    tri = triangle[i]
    d = direction[i]
    look = Look()
    if looks.shape[0] > 0:
        look = looks[i]
    else:
        look = plain_look(scene, tri, u[i], v[i])
    # As `shade.hit_radiance` has it, whose domes are taken back.
    n = shown_normal(normals, i, hit_normal(scene, tri, u[i], v[i]))
    cosine = wp.dot(n, d)
    lobes = shade.split_lobes(look, wp.vec3(0.0, 0.0, 0.0), wp.abs(cosine), False)
    carried = lobes.mirror
    if weight.shape[0] > 0:
        carried = wp.cw_mul(weight[i], carried)
    if wp.max(carried) < LEAST_WEIGHT:
        return
    onward = d - 2.0 * cosine * n
    out_domes[k] = wp.cw_mul(carried, shade.dome_radiance(lights, onward))
    corner = scene.triangles[tri]
    p = (1.0 - u[i] - v[i]) * scene.points[corner[0]] + u[i] * scene.points[corner[1]] + v[i] * scene.points[corner[2]]
    if scene.patches[scene.triangle_patch[tri]].shape != SHAPE_NONE and normals.shape[0] == 0:
        polished = polish(scene, tri, p, d)
        if polished[0] != 0.0 or polished[1] != 0.0 or polished[2] != 0.0:
            n = wp.vec3(polished[0], polished[1], polished[2])
            p += polished[3] * d
            onward = d - 2.0 * wp.dot(n, d) * n
    if wp.dot(n, d) > 0.0:
        n = -n
    out_point[k] = p
    out_normal[k] = n
    out_direction[k] = wp.normalize(onward)
    out_weight[k] = carried


@wp.kernel
def take_rays_kernel(
    first: int,
    # Rays that go on, as numbers of those asked for, and what is known of all of these:
    going: wp.array(dtype=int),
    asked: wp.array(dtype=int),
    point: wp.array(dtype=wp.vec3),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.vec3),
    domes: wp.array(dtype=wp.vec3),
    # Of the layer's rays:
    triangle: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    index: wp.array(dtype=int),
    # Outputs:
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_weight: wp.array(dtype=wp.vec3),
    out_domes: wp.array(dtype=wp.vec3),
    out_facet: wp.array(dtype=int),
    out_pixel: wp.array(dtype=int),
    out_index: wp.array(dtype=int),
):
    """One thread per ray that goes on, -1: none; `index` of length 0: the layer's rays are the first ones."""
    k = first + wp.tid()
    i = going[k]
    if i < 0:
        out_point[k] = wp.vec3(0.0, 0.0, 0.0)
        out_normal[k] = wp.vec3(0.0, 0.0, 0.0)
        out_direction[k] = wp.vec3(0.0, 0.0, 0.0)
        out_facet[k] = -1
        out_pixel[k] = -1
        out_index[k] = -1
        return
    ray = asked[i]
    out_point[k] = point[i]
    out_normal[k] = normal[i]
    out_direction[k] = direction[i]
    out_weight[k] = weight[i]
    out_domes[k] = domes[i]
    out_facet[k] = triangle[ray]
    out_pixel[k] = pixel[ray]
    out_index[k] = ray
    if index.shape[0] > 0:
        out_index[k] = index[ray]


@wp.kernel
def add_bounce_kernel(
    first: int,
    index: wp.array(dtype=int),
    weight: wp.array(dtype=wp.vec3),
    domes: wp.array(dtype=wp.vec3),
    seen: wp.array(dtype=wp.vec3),
    out_total: wp.array(dtype=wp.vec3),
):
    """One thread per ray; each adds to the total of its own pixel, if there is one."""
    i = first + wp.tid()
    k = index[i]
    if k < 0:
        return
    changed = out_total[k] + wp.cw_mul(weight[i], seen[i]) - domes[i]
    # Domes that were added in another order leave a rounding of theirs.
    out_total[k] = wp.vec3(wp.max(changed[0], 0.0), wp.max(changed[1], 0.0), wp.max(changed[2], 0.0))


def onward(
    scene: Scene,
    gbuffer: GBuffer,
    mirrors: Mirrors,
    layer: ReflectionLayer,
    seen: wp.array,
    met: Callable[[ReflectionLayer], wp.array],
    bounces: int,
    threads: int = 0,
    forward: Callable[[ReflectionLayer, wp.array], None] | None = None,
    kernels: str = "auto",
) -> wp.array:
    """What a layer's rays see, with what the mirrors among it reflect.

    Args:
        scene: On the G-buffer's device; its BVH is built if this is the first use.
        gbuffer: What the eye sees.
        mirrors: Of the scene.
        layer: Rays and what they met.
        seen: vec3 [n], radiance of that, mirrors showing the domes; not written to.
        met: The same of other rays.
        bounces: Reflections that are followed from there on.
        threads: CPU threads; 0: one per core.
        forward: Answers some of the first rays that mirrors reflect, and leaves the status of others NONE; None: rays do.
        kernels: `Settings.kernels`.

    Returns:
        vec3 [n]; `seen` itself where no mirror is met. The layer's statistics get `bounced`: rays followed, and
        `bounce_limit`: those whose mirror shows the domes as `bounces` ended there, counted when it is asked for.
    """
    walk = _Walk(scene, gbuffer, mirrors, layer, seen, met, bounces, threads, forward, kernels)
    walk.go_on(0, layer, compact.none(int, scene.device), compact.none(wp.vec3, scene.device))
    return walk.total


class _Walk:
    """From mirror to mirror, as `onward` has it.

    Attributes:
        total: What the layer's rays see as far as they were followed.
    """

    def __init__(self, scene, gbuffer, mirrors, layer, seen, met, bounces, threads, forward, kernels):
        self._scene, self._gbuffer, self._mirrors, self._first = scene, gbuffer, mirrors, layer
        self._met, self._bounces, self._threads, self._forward, self._kernels = met, bounces, threads, forward, kernels
        self._is_own = not launch.reads()  # where it is not known whether a mirror is met, room is made for what may be
        self.total = wp.clone(seen) if self._is_own else seen

    def go_on(
        self, depth: int, layer: ReflectionLayer, index: wp.array, weight: wp.array, going: compact.Some | None = None
    ) -> None:
        """Follow what mirrors reflect of a layer's rays.

        Args:
            depth: Reflections so far.
            layer: Of the last ones.
            index: int32, their numbers among the first layer's rays; length 0: they are these.
            weight: vec3, what they carry; length 0: all of what they see.
            going: The rays before that these are the reflections of.
        """
        scene, gbuffer, threads = self._scene, self._gbuffer, self._threads
        if depth == self._bounces:
            ended = partial(_ended, scene, gbuffer, self._mirrors, layer, weight, index, going, threads)
            self._first.count_later("bounce_limit", ended)
            return
        asked = meeting(scene, layer, self._mirrors.patches)
        if not len(asked.numbers):
            return
        rays = _reflections(scene, gbuffer, layer, asked.numbers, weight, threads)
        going = compact.positive(rays[3])
        going.then(partial(self._follow, depth, layer, index, asked.numbers, going, rays))

    def _follow(
        self,
        depth: int,
        layer: ReflectionLayer,
        index: wp.array,
        asked: wp.array,
        going: compact.Some,
        rays: list[wp.array],
    ) -> None:
        scene, device, threads, kernels = self._scene, self._scene.device, self._threads, self._kernels
        width, bodies, count = self._gbuffer.camera.size[0], self._mirrors.bodies, len(going.numbers)
        if not self._is_own:
            self.total, self._is_own = wp.clone(self.total), True
        known = [going.numbers, asked, *rays, layer.triangle, layer.pixels.pixel, index]
        point, normal, direction, weight, domes = (wp.empty(count, dtype=wp.vec3, device=device) for _ in range(5))
        facet, pixel, index = (wp.empty(count, dtype=int, device=device) for _ in range(3))
        taken = [point, normal, direction, weight, domes, facet, pixel, index]
        launch.launch(take_rays_kernel, count, [*known, *taken], device, threads)
        self._first.count_later("bounced", partial(_numbers, index, going))
        pixels = MirrorPixels(layer.pixels.reflector, pixel, point, normal, direction, layer.pixels.box)
        first = self._forward is not None and depth == 0
        layer = (ReflectionLayer.empty if first else ReflectionLayer.unset)(pixels, Technique.RAYTRACED, device)
        if first:
            self._forward(layer, facet)
            _trace_others(scene, layer, facet, bodies, threads, kernels, width)
            add_statistics(self._first.statistics, layer.statistics)
        else:
            bvh.trace_bounced(scene, layer, facet, bodies, threads, kernels, width)
        inputs = [index, weight, domes, self._met(layer), self.total]
        launch.launch(add_bounce_kernel, count, inputs, device, threads)
        self.go_on(depth + 1, layer, index, weight, going)


def _numbers(index: wp.array, going: compact.Some) -> np.ndarray:
    """The numbers of rays that go on; read now."""
    return index.numpy() if going.told() else np.zeros(0, np.int32)


def _reflections(
    scene: Scene, gbuffer: GBuffer, layer: ReflectionLayer, asked: wp.array, weight: wp.array, threads: int
) -> list[wp.array]:
    """Points, normals and directions of rays that mirrors reflect, what they carry, and what the domes gave there."""
    looks, normals = prepare_looks(scene, gbuffer, layer, threads), prepare_normals(scene, gbuffer, layer, threads)
    outputs = [wp.empty(len(asked), dtype=wp.vec3, device=scene.device) for _ in range(5)]
    inputs = [scene.view, scene.lights, looks, normals, layer.triangle, layer.u, layer.v]
    inputs += [layer.pixels.direction, weight, asked]
    where = scene.device, threads
    launch.launch(reflect_hits_kernel, len(asked), [*inputs, *outputs], *where, split_min=bvh.TRACE_SPLIT_MIN)
    return outputs


def _ended(
    scene: Scene,
    gbuffer: GBuffer,
    mirrors: Mirrors,
    layer: ReflectionLayer,
    weight: wp.array,
    index: wp.array,
    going: compact.Some,
    threads: int,
) -> np.ndarray:
    """Of the last rays that are followed those that meet a mirror again, as numbers of the first layer's."""
    if not going.told():
        return np.zeros(0, np.int32)
    asked = meeting(scene, layer, mirrors.patches).numbers
    if not len(asked):
        return asked.numpy()
    *_, carried, _ = _reflections(scene, gbuffer, layer, asked, weight, threads)
    return compact.taken(index, compact.taken(asked, compact.positive(carried).numbers)).numpy()


def _trace_others(
    scene: Scene, layer: ReflectionLayer, facet: wp.array, bodies: wp.array, threads: int, kernels: str, width: int
) -> None:
    """Trace the rays of a layer whose status is NONE."""
    others = compact.marked(layer.status, int(Status.NONE))
    if not len(others):
        return
    pixels = layer.pixels
    arrays = pixels.pixel, pixels.point, pixels.normal, pixels.direction, facet
    some = [compact.taken(array, others) for array in arrays]
    rest = ReflectionLayer.unset(MirrorPixels(pixels.reflector, *some[:4], pixels.box), layer.method, scene.device)
    bvh.trace_bounced(scene, rest, some[4], bodies, threads, kernels, width)
    for name in ("triangle", "u", "v", "distance", "status"):
        compact.put(getattr(layer, name), others, getattr(rest, name))
