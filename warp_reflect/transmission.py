"""What is seen through transparent surfaces: panes, water, bodies of glass.

Source of the weights: the UsdPreviewSurface specification. Opacity below 1 in its mode "transparent" is the share of the
light entering the surface that is not let through (`MaterialData.transmission` is the rest), and leaves the mirror term
alone; in its mode "presence" it is the share of the surface that is there (`MaterialData.opacity`). Fresnel's reflectance
on entering is Schlick's, as for the mirror term, so that both sum to 1; on leaving a body it is Fresnel's own, with total
reflection, which Schlick's does not know.

A pane is thin: one looks straight through. A solid body bends the ray by Snell's law on the way in and on the way out.
What a ray meets behind is shaded as what a mirror shows, and where that is transparent too the ray goes on, up to a number
of surfaces. What a body reflects inside, other than totally, is lost: it is not followed.

Frosted surfaces scatter a ray into a cone: one ray of it where they are seen in mirrors and behind others, the mean of all
(`finishes/frost.py`) where the eye sees them. What is behind fades by its distance to a colour. Source of both: Diefenbach
and Badler, Multi-Pass Pipeline Rendering, I3D 1997, as told in Real-Time Rendering, 3rd edition, section 9.3.1. Differs from
it by: e^(-distance / length) in place of linear fog, so that two distances in a row fade as their sum does.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh, compact, launch, shade, vector
from warp_reflect.layers import (
    NO_REFLECTOR,
    CameraView,
    GBuffer,
    MirrorPixels,
    ReflectionLayer,
    eye_ray_direction,
    meeting,
)
from warp_reflect.normal_maps import prepare_normals
from warp_reflect.optics import PI, dielectric_reflectance, refract, tangent_basis
from warp_reflect.reflectors import INTERFACES, interface_of
from warp_reflect.scene import SHAPE_NONE, FinishData, Scene, SceneView
from warp_reflect.settings import Settings, Technique
from warp_reflect.shapes import facet_normal, unit
from warp_reflect.surface import hit_normal, polish, shown_normal
from warp_reflect.textures import Look, plain_look, prepare_looks

wp.set_module_options({"enable_backward": False})

# Their order is that of `reflectors.INTERFACES`.
OPAQUE = wp.constant(0)
THIN = wp.constant(1)
SOLID = wp.constant(2)
# Share of the light below which what is behind is not looked for: half a step of an 8 bit picture.
LEAST_WEIGHT = wp.constant(2.0e-3)
GOLDEN_ANGLE = wp.constant(2.399963229728653)


Met = Callable[[ReflectionLayer], wp.array]


@wp.struct
class InterfaceView:
    """How light goes through a patch."""

    kind: int  # OPAQUE, THIN or SOLID
    ior: float
    spread: float  # tangent of the half-angle of the cone into which it scatters; 0: it does not
    fade: float  # 1 / the distance over which what is behind fades to 1 / e; 0: it does not
    fade_color: wp.vec3


@wp.struct
class Crossing:
    """A ray behind a surface."""

    direction: wp.vec3  # unit
    normal: wp.vec3  # of the facet, on the ray's side
    weight: wp.vec3  # of what it sees; 0: nothing goes on
    own: float  # of what the surface itself shows
    inside: int  # the ray is in the surface's body now


@dataclass(frozen=True)
class Through:
    """What a finish of transparent surfaces works with.

    Attributes:
        shown: What the eye sees.
        interfaces: Of the scene.
        met: Radiance, vec3 [n], of what a layer's rays meet, without what is behind that.
    """

    shown: shade.Shown
    interfaces: Interfaces
    met: Met


@dataclass
class Transmission:
    """What is seen through one surface.

    Attributes:
        surface: The pixels that show it.
        layer: Its pixels' rays behind the surface and the first thing that they meet.
        weight: vec3 [n], share of it in the picture.
        inside: uint8 [n], 1 where the ray has gone into the surface's body.
        nearness: float [n], mean of 1 / length of the way to what is seen in the end, 0 for the sky; set by `behind`.
    """

    surface: MirrorPixels
    layer: ReflectionLayer
    weight: wp.array
    inside: wp.array
    nearness: wp.array


@dataclass
class Interfaces:
    """The surfaces of a scene as light goes through them.

    Attributes:
        views: `InterfaceView` of every patch.
        clear: bool [patches], whether anything is seen through one.
        fades: Whether what is behind any of them fades.
    """

    views: wp.array
    clear: np.ndarray
    fades: bool


def make_interfaces(scene: Scene, finishes: Mapping[int, FinishData]) -> Interfaces:
    """How light goes through the surfaces of a scene.

    Args:
        scene: The scene.
        finishes: Transparent part to what is asked of it; one that is not to be frosted has frost 0.
    """
    return scene.kept("interfaces", finishes, lambda: _interfaces(scene, finishes))


def _interfaces(scene: Scene, finishes: Mapping[int, FinishData]) -> Interfaces:
    # By columns, see `bounces.Mirrors`.
    views = np.zeros(len(scene.patch_shapes), InterfaceView.numpy_dtype())
    clear = np.zeros(len(scene.patch_shapes), bool)
    for index, finish in finishes.items():
        kind, _ = interface_of(scene, index)
        part = scene.parts[index]
        own = list(part.patches)
        views["kind"][own] = INTERFACES.index(kind)
        views["ior"][own] = scene.data.materials[part.material].ior
        views["spread"][own] = math.tan(math.radians(finish.frost))
        views["fade"][own] = 1.0 / finish.frost_distance if finish.frost_distance > 0.0 else 0.0
        views["fade_color"][own] = finish.frost_color
        clear[own] = True
    fades = any(finish.frost_distance > 0.0 for finish in finishes.values())
    return Interfaces(wp.array(views, dtype=InterfaceView, device=scene.device), clear, fades)


@wp.func
def disc_sample(pixel: int, k: int, count: int) -> wp.vec2:
    """Point k of `count` that fill the unit disc evenly, turned and shifted by the pixel.

    Source: Vogel, A better way to construct the sunflower head, 1979: the golden angle and the root of the rank.
    """
    state = wp.rand_init(pixel, k // wp.max(count, 1))
    turn = wp.randf(state)
    shift = wp.randf(state)
    radius = wp.sqrt((float(k % wp.max(count, 1)) + shift) / float(wp.max(count, 1)))
    angle = GOLDEN_ANGLE * float(k) + 2.0 * PI * turn
    return wp.vec2(radius * wp.cos(angle), radius * wp.sin(angle))


@wp.func
def scattered(direction: wp.vec3, spread: float, disc: wp.vec2) -> wp.vec3:
    """A unit direction of the cone about another one."""
    first, second = tangent_basis(direction)
    return unit(direction + spread * (disc[0] * first + disc[1] * second))


@wp.func
def cross_interface(
    scene: SceneView,
    interface: InterfaceView,
    look: Look,
    triangle: int,
    n: wp.vec3,
    incident: wp.vec3,
    shaded: float,
    reflector: bool,
    disc: wp.vec2,
) -> Crossing:
    """Lead a ray through a surface.

    Args:
        scene: Holds the triangle.
        interface: Of its patch.
        look: Its material there.
        triangle: The facet.
        n: Unit shading normal on the side that the ray comes from, polished onto the analytic surface.
        incident: Unit, towards the surface.
        shaded: Cosine of the angle of incidence that the surface itself is shaded by: what is let through is what that leaves.
        reflector: Whether its mirror term is a reflector's, see `shade.split_lobes`.
        disc: Where in the cone that a frosted surface scatters into; 0: its middle.
    """
    crossing = Crossing()
    tri = scene.triangles[triangle]
    outward = facet_normal(scene.points[tri[0]], scene.points[tri[1]], scene.points[tri[2]])
    leaving = wp.dot(outward, incident) > 0.0
    cosine = wp.abs(wp.dot(n, incident))
    lobes = shade.split_lobes(look, wp.vec3(0.0, 0.0, 0.0), shaded, reflector)
    crossing.direction = incident
    crossing.weight = lobes.through
    crossing.own = 1.0
    if interface.kind == SOLID:
        if not leaving:
            crossing.direction = unit(refract(incident, n, interface.ior))
            crossing.inside = 1
        else:
            back = 1.0 / interface.ior
            crossing.direction = unit(refract(incident, n, back))
            share = look.opacity * look.transmission * (1.0 - dielectric_reflectance(cosine, back)) + 1.0 - look.opacity
            # Seen from inside, a surface shows nothing of its own but what it scatters.
            crossing.own = 1.0 - look.transmission
            if crossing.direction[0] == 0.0 and crossing.direction[1] == 0.0 and crossing.direction[2] == 0.0:
                crossing.direction = unit(incident - 2.0 * wp.dot(incident, n) * n)
                crossing.inside = 1
                share = look.opacity * look.transmission
            crossing.weight = wp.vec3(share, share, share)
    crossing.normal = outward
    if wp.dot(outward, crossing.direction) < 0.0:
        crossing.normal = -outward
    if interface.spread > 0.0:
        turned = scattered(crossing.direction, interface.spread, disc)
        if wp.dot(turned, crossing.normal) > 0.0:
            crossing.direction = turned
    return crossing


@wp.func
def cross_pixel(
    scene: SceneView,
    camera: CameraView,
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    p: int,
    normal: wp.vec3,
    direction: wp.vec3,
    sample: int,
    count: int,
    wavy: int,
    i: int,
    out_facet: wp.array(dtype=int),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
):
    """The ray behind pixel p of the picture, whose surface reflects along `direction` at `normal`, into entry i."""
    row = p // camera.width
    tri = triangle[p]
    x = float(p - row * camera.width) + 0.5
    y = float(row) + 0.5
    incident = unit(direction - 2.0 * wp.dot(direction, normal) * normal)
    uv = shade.weights_seen(scene, camera, tri, x, y)
    look = Look()
    if looks.shape[0] > 0:
        look = looks[p]
    else:
        look = plain_look(scene, tri, uv[0], uv[1])
    n = shown_normal(normals, p, hit_normal(scene, tri, uv[0], uv[1]))
    shaded = wp.abs(wp.dot(n, unit(eye_ray_direction(camera, x, y))))
    disc = wp.vec2(0.0, 0.0)
    if count > 0:
        disc = disc_sample(p, sample, count)
    interface = interfaces[scene.triangle_patch[tri]]
    bent = normal
    corner = scene.triangles[tri]
    outward = facet_normal(scene.points[corner[0]], scene.points[corner[1]], scene.points[corner[2]])
    if wavy != 0 or wp.dot(outward, incident) > 0.0:
        bent = shown_normal(normals, p, normal)
    crossing = cross_interface(scene, interface, look, tri, bent, incident, shaded, reflector_id[p] > 0, disc)
    out_facet[i] = tri
    out_normal[i] = crossing.normal
    out_direction[i] = crossing.direction
    out_inside[i] = wp.uint8(crossing.inside)
    out_weight[i] = crossing.weight


@wp.kernel
def cross_seen_kernel(
    first: int,
    scene: SceneView,
    camera: wp.array(dtype=CameraView),
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    reflector_id: wp.array(dtype=int),
    # Pixels of the surface:
    pixel: wp.array(dtype=int),
    normal: wp.array(dtype=wp.vec3),
    direction: wp.array(dtype=wp.vec3),
    # Which ray of how many of a frosted surface's cone (of 0: its middle); whether normal maps and waves bend rays that enter:
    sample: int,
    count: int,
    wavy: int,
    # Outputs:
    out_facet: wp.array(dtype=int),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
):
    """One thread per pixel that shows a transparent surface."""
    i = first + wp.tid()
    cross_pixel(
        scene,
        camera[0],
        interfaces,
        looks,
        normals,
        triangle,
        reflector_id,
        pixel[i],
        normal[i],
        direction[i],
        sample,
        count,
        wavy,
        i,
        out_facet,
        out_normal,
        out_direction,
        out_inside,
        out_weight,
    )


@wp.func
def fade_share(veil: InterfaceView, triangle: int, distance: float) -> float:
    """What is left of what is seen at a distance behind a surface; nothing of the sky."""
    share = float(1.0)
    if veil.fade > 0.0:
        share = wp.where(triangle >= 0, wp.exp(-distance * veil.fade), 0.0)
    return share


@wp.kernel
def cross_hits_kernel(
    first: int,
    scene: SceneView,
    interfaces: wp.array(dtype=InterfaceView),
    looks: wp.array(dtype=Look),
    normals: wp.array(dtype=wp.vec3),
    # Hits:
    triangle: wp.array(dtype=int),
    u: wp.array(dtype=float),
    v: wp.array(dtype=float),
    distance: wp.array(dtype=float),
    pixel: wp.array(dtype=int),
    direction: wp.array(dtype=wp.vec3),
    fading: wp.array(dtype=int),
    weight: wp.array(dtype=wp.vec3),
    depth: int,
    # Outputs:
    out_own: wp.array(dtype=wp.vec3),
    out_faded: wp.array(dtype=wp.vec3),
    out_point: wp.array(dtype=wp.vec3),
    out_normal: wp.array(dtype=wp.vec3),
    out_direction: wp.array(dtype=wp.vec3),
    out_inside: wp.array(dtype=wp.uint8),
    out_weight: wp.array(dtype=wp.vec3),
    out_fading: wp.array(dtype=int),
):
    """One thread per ray: what of it counts here, and where it goes on behind what it met; weight 0 where it does not."""
    i = first + wp.tid()
    tri = triangle[i]
    left = weight[i]
    if fading.shape[0] > 0 and fading[i] >= 0:
        # The patch that the ray came through last.
        veil = interfaces[fading[i]]
        share = fade_share(veil, tri, distance[i])
        out_faded[i] = (1.0 - share) * wp.cw_mul(left, veil.fade_color)
        left = share * left
        out_fading[i] = fading[i]
    out_own[i] = left
    if tri < 0:
        return
    patch = scene.triangle_patch[tri]
    interface = interfaces[patch]
    if interface.kind == OPAQUE:
        return
    d = direction[i]
    corner = scene.triangles[tri]
    p = (1.0 - u[i] - v[i]) * scene.points[corner[0]] + u[i] * scene.points[corner[1]] + v[i] * scene.points[corner[2]]
    n = hit_normal(scene, tri, u[i], v[i])
    shaded = wp.abs(wp.dot(shown_normal(normals, i, n), d))
    if scene.patches[patch].shape != SHAPE_NONE:
        polished = polish(scene, tri, p, d)
        if polished[0] != 0.0 or polished[1] != 0.0 or polished[2] != 0.0:
            n = wp.vec3(polished[0], polished[1], polished[2])
            p += polished[3] * d
    if wp.dot(n, d) > 0.0:
        n = -n
    look = Look()
    if looks.shape[0] > 0:
        look = looks[i]
    else:
        look = plain_look(scene, tri, u[i], v[i])
    disc = wp.vec2(0.0, 0.0)
    if interface.spread > 0.0:
        disc = disc_sample(pixel[i], depth, 1)
    crossing = cross_interface(scene, interface, look, tri, n, d, shaded, False, disc)
    out_own[i] = crossing.own * left
    carried = wp.cw_mul(left, crossing.weight)
    if wp.max(carried) < LEAST_WEIGHT:
        return
    out_point[i] = p
    out_normal[i] = crossing.normal
    out_direction[i] = crossing.direction
    out_inside[i] = wp.uint8(crossing.inside)
    out_weight[i] = carried
    if fading.shape[0] > 0 and interface.fade > 0.0:
        out_fading[i] = patch


@wp.kernel
def gather_kernel(
    first: int,
    index: wp.array(dtype=int),
    own: wp.array(dtype=wp.vec3),
    faded: wp.array(dtype=wp.vec3),
    seen: wp.array(dtype=wp.vec3),
    # Outputs:
    out_total: wp.array(dtype=wp.vec3),
):
    """One thread per ray; each adds to the total of its own pixel."""
    i = first + wp.tid()
    out_total[index[i]] += faded[i] + wp.cw_mul(own[i], seen[i])


@wp.kernel
def nearness_kernel(
    first: int,
    index: wp.array(dtype=int),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    own: wp.array(dtype=wp.vec3),
    carried: wp.array(dtype=wp.vec3),
    before: wp.array(dtype=float),
    # Outputs:
    out_way: wp.array(dtype=float),
    out_nearness: wp.array(dtype=wp.vec2),
):
    """One thread per ray: how near what it met is, weighted by what is not seen through that."""
    i = first + wp.tid()
    way = distance[i]
    if before.shape[0] > 0:
        way += before[i]
    out_way[i] = way
    share = wp.max(wp.max(own[i]) - wp.max(carried[i]), 0.0)
    if triangle[i] >= 0 and way > 0.0:
        out_nearness[index[i]] += wp.vec2(share / way, share)
    else:
        out_nearness[index[i]] += wp.vec2(0.0, share)


@wp.kernel
def mean_nearness_kernel(first: int, nearness: wp.array(dtype=wp.vec2), out_nearness: wp.array(dtype=float)):
    """One thread per pixel."""
    i = first + wp.tid()
    out_nearness[i] = 0.0
    if nearness[i][1] > 0.0:
        out_nearness[i] = nearness[i][0] / nearness[i][1]


@wp.kernel
def met_kernel(
    first: int,
    interfaces: wp.array(dtype=InterfaceView),
    fading: wp.array(dtype=int),
    triangle: wp.array(dtype=int),
    distance: wp.array(dtype=float),
    seen: wp.array(dtype=wp.vec3),
    # Outputs:
    out_total: wp.array(dtype=wp.vec3),
    out_nearness: wp.array(dtype=float),
):
    """One thread per ray that has met something opaque or nothing: it, faded, and how near it is."""
    i = first + wp.tid()
    if fading.shape[0] > 0:
        veil = interfaces[fading[i]]
        share = fade_share(veil, triangle[i], distance[i])
        out_total[i] = share * seen[i] + (1.0 - share) * veil.fade_color
    if out_nearness.shape[0] > 0:
        out_nearness[i] = 0.0
        if triangle[i] >= 0 and distance[i] > 0.0:
            out_nearness[i] = 1.0 / distance[i]


@wp.kernel
def transmitted_term_kernel(
    first: int,
    pixel: wp.array(dtype=int),
    weight: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    out_picture: wp.array(dtype=wp.vec4),
):
    """One thread per pixel that shows a transparent surface."""
    i = first + wp.tid()
    term = wp.cw_mul(weight[i], radiance[i])
    out_picture[pixel[i]] += wp.vec4(term[0], term[1], term[2], 0.0)


def look_through(
    scene: Scene,
    shown: shade.Shown,
    interfaces: Interfaces,
    surface: MirrorPixels,
    settings: Settings,
    sample: tuple[int, int] = (0, 0),
    wavy: bool = False,
    follow: Callable[[ReflectionLayer, wp.array, wp.array], None] | None = None,
) -> Transmission:
    """The rays behind a transparent surface that the eye sees, and the first thing that each meets.

    Args:
        scene: On the G-buffer's device.
        shown: What the eye sees.
        interfaces: From `make_interfaces`.
        surface: The pixels of one surface, from `surface.part_pixels`.
        settings: Threads, kernels.
        sample: (k, n): ray k of n of the cone into which a frosted surface scatters; (0, 0): its middle.
        wavy: Rays are bent at the normals of `shown`, waves included; otherwise only those that leave a body are.
        follow: (layer, facet, inside) -> None, finds what rays meet first, as `bvh.trace_transmitted` does; None: that does.
    """
    device, threads, gbuffer, n = scene.device, settings.threads, shown.gbuffer, surface.count
    normal, direction, weight = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(3))
    facet, inside = wp.empty(n, dtype=int, device=device), wp.empty(n, dtype=wp.uint8, device=device)
    inputs = [gbuffer.view, interfaces.views, shown.looks, shown.normals, gbuffer.triangle, gbuffer.reflector_id]
    inputs += [surface.pixel, surface.normal, surface.direction, *sample, int(wavy)]
    outputs = [facet, normal, direction, inside, weight]
    if vector.chosen(settings.kernels, device):
        from warp_reflect import transmission_vector  # which works with this module's structures

        inputs = [scene.view, scene.triangle_records, *inputs, *outputs]
        vector.launch_blocks(transmission_vector.cross_blocks_kernel, n, inputs, device, threads)
    else:
        launch.launch(cross_seen_kernel, n, [scene.view, *inputs, *outputs], device, threads)
    pixels = MirrorPixels(NO_REFLECTOR, surface.pixel, surface.point, normal, direction, surface.box)
    layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, device)
    if follow is not None:
        follow(layer, facet, inside)
    else:
        bvh.trace_transmitted(scene, layer, facet, inside, threads, None, settings.kernels, gbuffer.camera.size[0])
    return Transmission(surface, layer, weight, inside, wp.zeros(n, dtype=float, device=device))


def through_radiance(scene: Scene, through: Through, found: Transmission, settings: Settings) -> wp.array:
    """What a transparent surface's pixels see through it, vec3 [n], before its weight; sets `found.nearness`."""
    gbuffer, interfaces = through.shown.gbuffer, through.interfaces
    seen = through.met(found.layer)
    patches = None
    if interfaces.fades:
        facets = compact.taken(gbuffer.triangle, found.layer.pixels.pixel)
        patches = compact.taken(scene.view.triangle_patch, facets)
    asked = [interfaces, found.layer, seen, settings, through.met, patches, found.nearness]
    return behind(scene, gbuffer, *asked)


def behind(
    scene: Scene,
    gbuffer: GBuffer,
    interfaces: Interfaces,
    layer: ReflectionLayer,
    seen: wp.array,
    settings: Settings,
    met: Met,
    patches: wp.array | None = None,
    nearness: wp.array | None = None,
) -> wp.array:
    """What a layer's rays see, with all that is behind the transparent surfaces among it.

    Args:
        scene: On the G-buffer's device.
        gbuffer: What the eye sees.
        interfaces: From `make_interfaces`.
        layer: Rays and what they met.
        seen: vec3 [n], radiance of that; not written to.
        settings: `transparency_depth`, threads.
        met: Radiance, vec3 [n], of what other rays meet, without what is behind that.
        patches: int32 [n], patch that each ray has come through, which fades what is behind it; None: none.
        nearness: float [n], gets the mean of 1 / length of the way to what is seen in the end; None: not asked for.

    Returns:
        vec3 [n]; `seen` itself where nothing is transparent. The layer's statistics get `onward`: rays followed, and
        `depth_limit`: those that `transparency_depth` ended (through the surface they met nothing is seen).
    """
    device, threads = scene.device, settings.threads
    count = layer.pixels.count
    if not len(meeting(scene, layer, interfaces.clear)):
        if patches is None and nearness is None:
            return seen
        total = wp.empty(count, dtype=wp.vec3, device=device) if patches is not None else seen
        near = compact.none(float, device) if nearness is None else nearness
        given = patches if patches is not None else compact.none(int, device)
        inputs = [interfaces.views, given, layer.triangle, layer.distance, seen]
        launch.launch(met_kernel, count, [*inputs, total, near], device, threads)
        return total
    numbers = compact.every(count, device)  # of the first layer's rays
    weight = wp.full(count, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
    fading = wp.full(count if interfaces.fades else 0, -1, dtype=int, device=device)
    if interfaces.fades and patches is not None:
        fading = patches
    way = compact.none(float, device)
    near = wp.zeros(count, dtype=wp.vec2, device=device) if nearness is not None else None
    total, first = None, layer
    for depth in range(settings.transparency_depth + 1):
        n = layer.pixels.count
        looks = prepare_looks(scene, gbuffer, layer, threads)
        normals = prepare_normals(scene, gbuffer, layer, threads)
        own, faded, point, normal, direction, carried = (wp.zeros(n, dtype=wp.vec3, device=device) for _ in range(6))
        inside = wp.zeros(n, dtype=wp.uint8, device=device)
        still_fading = wp.full(len(fading), -1, dtype=int, device=device)
        inputs = [scene.view, interfaces.views, looks, normals, layer.triangle, layer.u, layer.v, layer.distance]
        inputs += [layer.pixels.pixel, layer.pixels.direction, fading, weight, depth]
        outputs = [own, faded, point, normal, direction, inside, carried, still_fading]
        launch.launch(cross_hits_kernel, n, inputs + outputs, device, threads)
        going = compact.positive(carried)
        if near is not None:
            before, way = way, wp.empty(n, dtype=float, device=device)
            ways = [numbers, layer.triangle, layer.distance, own, carried, before, way, near]
            launch.launch(nearness_kernel, n, ways, device, threads)
        if total is None:
            if not len(going) and not (interfaces.fades and patches is not None):
                total = seen
                break
            total = wp.zeros(count, dtype=wp.vec3, device=device)
        launch.launch(gather_kernel, n, [numbers, own, faded, seen, total], device, threads)
        if depth == settings.transparency_depth:
            first.count_later("depth_limit", compact.taken(numbers, going).numpy)
            break
        if not len(going):
            break
        taken = lambda array: compact.taken(array, going)  # noqa: B023, E731
        numbers, weight = taken(numbers), taken(carried)
        first.count_later("onward", numbers.numpy)
        fading = taken(still_fading) if len(fading) else fading
        way = taken(way) if len(way) else way
        pixels = MirrorPixels(
            layer.pixels.reflector,
            taken(layer.pixels.pixel),
            taken(point),
            taken(normal),
            taken(direction),
            layer.pixels.box,
        )
        facet, inside = taken(layer.triangle), taken(inside)
        layer = ReflectionLayer.empty(pixels, Technique.RAYTRACED, device)
        bvh.trace_transmitted(scene, layer, facet, inside, threads, None, settings.kernels, gbuffer.camera.size[0])
        seen = met(layer)
    if near is not None:
        launch.launch(mean_nearness_kernel, count, [near, nearness], device, threads)
    return total


def add_to_picture(picture: wp.array, transmission: Transmission, radiance: wp.array, threads: int = 0) -> None:
    """Add what is seen through a surface to the picture that has its own light already.

    Args:
        picture: vec4 [height * width].
        transmission: The surface's.
        radiance: vec3 [n], what its pixels see behind it.
        threads: CPU threads; 0: one per core.
    """
    pixels = transmission.layer.pixels
    inputs = [pixels.pixel, transmission.weight, radiance, picture]
    launch.launch(transmitted_term_kernel, pixels.count, inputs, picture.device, threads)
