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
from dataclasses import dataclass, replace
from functools import partial

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
    """One thread per pixel that shows a transparent surface; a ray of no facet where the number is -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        out_facet[i] = -1
        out_normal[i] = wp.vec3(0.0, 0.0, 0.0)
        out_direction[i] = wp.vec3(0.0, 0.0, 0.0)
        out_inside[i] = wp.uint8(0)
        out_weight[i] = wp.vec3(0.0, 0.0, 0.0)
        return
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
    # Surfaces before; those that are counted on the device are added:
    depth: int,
    deeper: wp.array(dtype=int),
    # Outputs, which what they replace may lie in:
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
    d = direction[i]
    nothing = wp.vec3(0.0, 0.0, 0.0)
    out_faded[i] = nothing
    out_point[i] = nothing
    out_normal[i] = nothing
    out_direction[i] = nothing
    out_inside[i] = wp.uint8(0)
    out_weight[i] = nothing
    if fading.shape[0] > 0:
        # The patch that the ray came through last.
        out_fading[i] = fading[i]
        if fading[i] >= 0:
            veil = interfaces[fading[i]]
            share = fade_share(veil, tri, distance[i])
            out_faded[i] = (1.0 - share) * wp.cw_mul(left, veil.fade_color)
            left = share * left
    out_own[i] = left
    if tri < 0:
        return
    patch = scene.triangle_patch[tri]
    interface = interfaces[patch]
    if interface.kind == OPAQUE:
        return
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
        surfaces = int(depth)
        if deeper.shape[0] > 0:
            surfaces += deeper[0]
        disc = disc_sample(pixel[i], surfaces, 1)
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
    begins: int,
    # Outputs:
    out_total: wp.array(dtype=wp.vec3),
):
    """One thread per ray, but for the number -1; each adds to the total of its own pixel, which may begin with it."""
    i = first + wp.tid()
    k = index[i]
    if k < 0:
        return
    total = wp.vec3(0.0, 0.0, 0.0)
    if begins == 0:
        total = out_total[k]
    out_total[k] = total + (faded[i] + wp.cw_mul(own[i], seen[i]))


@wp.kernel
def next_surface_kernel(first: int, out_depth: wp.array(dtype=int), out_mark: wp.array(dtype=int)):
    """One thread: one surface more; of no ray is known yet whether it goes on behind that."""
    out_depth[first + wp.tid()] += 1
    out_mark[0] = 0


@wp.kernel
def still_kernel(
    first: int,
    weight: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=int),
    depth: wp.array(dtype=int),
    limit: int,
    # Changed; facets of the rays that go on, -1 of others; how often each went on, and whether the limit ended it:
    out_pixel: wp.array(dtype=int),
    out_number: wp.array(dtype=int),
    out_facet: wp.array(dtype=int),
    out_onward: wp.array(dtype=wp.uint16),
    out_ended: wp.array(dtype=wp.uint8),
    out_mark: wp.array(dtype=int),
    out_counted: wp.array(dtype=int),
):
    """One thread per ray; threads that set the marks, that any goes on and that any is counted, agree."""
    i = first + wp.tid()
    goes = wp.max(weight[i]) > 0.0
    if goes:
        out_counted[0] = 1
    if goes and depth[0] >= limit:
        out_ended[i] = wp.uint8(1)
        goes = bool(False)
    out_facet[i] = wp.where(goes, triangle[i], -1)
    if not goes:
        out_pixel[i] = -1
        out_number[i] = -1
        return
    out_onward[i] = out_onward[i] + wp.uint16(1)
    out_mark[0] = 1


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
    """One thread per ray, but for the number -1: how near what it met is, weighted by what is not seen through that."""
    i = first + wp.tid()
    if index[i] < 0:
        return
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
    if fading.shape[0] > 0 and fading[i] >= 0:
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
    """One thread per pixel that shows a transparent surface, but for the number -1."""
    i = first + wp.tid()
    if pixel[i] < 0:
        return
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
    pixels = replace(surface.turned(direction, normal), reflector=NO_REFLECTOR)
    make = ReflectionLayer.unset if follow is None else ReflectionLayer.empty
    layer = make(pixels, Technique.RAYTRACED, device)
    if follow is not None:
        follow(layer, facet, inside)
    else:
        bvh.trace_transmitted(scene, layer, facet, inside, threads, None, settings.kernels, gbuffer.camera.size[0])
    return Transmission(surface, layer, weight, inside, wp.empty(n, dtype=float, device=device))


def through_radiance(scene: Scene, through: Through, found: Transmission, settings: Settings) -> wp.array:
    """What a transparent surface's pixels see through it, vec3 [n], before its weight; sets `found.nearness`."""
    gbuffer, interfaces = through.shown.gbuffer, through.interfaces
    seen = through.met(found.layer)
    patches = None
    if interfaces.fades:
        patches = _patches(scene, gbuffer, found.surface.pixel, settings.threads)
    asked = [interfaces, found.layer, seen, settings, through.met, patches, found.nearness]
    return behind(scene, gbuffer, *asked)


@wp.kernel
def patch_kernel(
    first: int,
    triangle: wp.array(dtype=int),
    triangle_patch: wp.array(dtype=int),
    pixel: wp.array(dtype=int),
    out_patch: wp.array(dtype=int),
):
    """One thread per pixel of a surface: the patch there; -1 where there is none."""
    i = first + wp.tid()
    out_patch[i] = -1
    if pixel[i] >= 0:
        out_patch[i] = triangle_patch[triangle[pixel[i]]]


def _patches(scene: Scene, gbuffer: GBuffer, pixel: wp.array, threads: int) -> wp.array:
    patches = wp.empty(len(pixel), dtype=int, device=scene.device)
    inputs = [gbuffer.triangle, scene.view.triangle_patch, pixel, patches]
    launch.launch(patch_kernel, len(pixel), inputs, scene.device, threads)
    return patches


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
    met_any = meeting(scene, layer, interfaces.clear)
    walk = _Walk(scene, gbuffer, interfaces, layer, seen, settings, met, patches, nearness)
    if not launch.reads() or not len(met_any.numbers):
        walk.end_here()
    met_any.then(walk.begin)
    return walk.total


class _Walk:
    """From surface to surface, as `behind` has it.

    Attributes:
        total: What the layer's rays see as far as they were followed.
    """

    def __init__(self, scene, gbuffer, interfaces, layer, seen, settings, met, patches, nearness):
        self._scene, self._gbuffer, self._interfaces, self._first, self._seen = scene, gbuffer, interfaces, layer, seen
        self._settings, self._met, self._patches, self._nearness = settings, met, patches, nearness
        self._near: wp.array | None = None
        self.total = seen

    def end_here(self) -> None:
        """Nothing transparent is met, or it is not known yet whether it is."""
        device, patches, nearness, layer = self._scene.device, self._patches, self._nearness, self._first
        if patches is None and nearness is None and launch.reads():
            return
        if patches is not None:
            self.total = wp.empty(layer.pixels.count, dtype=wp.vec3, device=device)
        elif not launch.reads():
            self.total = wp.clone(self._seen)
        near = compact.none(float, device) if nearness is None else nearness
        given = patches if patches is not None else compact.none(int, device)
        if len(given) or len(near):
            inputs = [self._interfaces.views, given, layer.triangle, layer.distance, self._seen, self.total, near]
            launch.launch(met_kernel, layer.pixels.count, inputs, device, self._settings.threads)

    def begin(self) -> None:
        """Go on behind what the first rays have met."""
        count, device, fades = self._first.pixels.count, self._scene.device, self._interfaces.fades
        weight = wp.full(count, wp.vec3(1.0, 1.0, 1.0), dtype=wp.vec3, device=device)
        fading = self._patches
        if fading is None or not fades:
            fading = wp.full(count if fades else 0, -1, dtype=int, device=device)
        if self._nearness is not None:
            self._near = wp.zeros(count, dtype=wp.vec2, device=device)
        numbers = compact.every(count, device)  # of the first layer's rays
        self._cross(0, self._first, self._seen, numbers, weight, fading, compact.none(float, device))
        if self._near is not None:
            inputs = [self._near, self._nearness]
            launch.launch(mean_nearness_kernel, count, inputs, device, self._settings.threads)

    def _cross(
        self,
        depth: int,
        layer: ReflectionLayer,
        seen: wp.array,
        numbers: wp.array,
        weight: wp.array,
        fading: wp.array,
        way: wp.array,
    ) -> None:
        """Add what rays see, and lead them through what they have met.

        Args:
            depth: Surfaces so far.
            layer, seen: Rays and what they met; radiance of that.
            numbers: int32, theirs among the first layer's.
            weight: vec3, what they carry.
            fading: int32, the patch that each has come through, -1 none; length 0: nothing fades.
            way: float, the length of their way so far; length 0: none.
        """
        device, n = self._scene.device, layer.pixels.count
        point, normal, direction, carried = (wp.empty(n, dtype=wp.vec3, device=device) for _ in range(4))
        inside = wp.empty(n, dtype=wp.uint8, device=device)
        still_fading = wp.empty(len(fading), dtype=int, device=device)
        further = wp.empty(n if self._near is not None else 0, dtype=float, device=device)
        behind = point, normal, direction, inside, carried, still_fading, further
        none = compact.none(int, device)
        own, faded = self._lead(depth, none, layer, numbers, (weight, fading, way), behind)
        gather = partial(self._gather, depth, numbers, own, faded, seen)
        going = compact.positive(carried)
        onward = partial(self._go_on, depth, layer, numbers, going, behind)
        if depth > 0 or (self._interfaces.fades and self._patches is not None):
            gather()
            going.then(onward)
        else:
            # Where nothing goes on, what is seen is all of it.
            going.then(partial(_both, gather, onward))

    def _lead(self, depth: int, deeper: wp.array, layer: ReflectionLayer, numbers: wp.array, carried, behind) -> tuple:
        """Lead rays through what they have met; what they see there by itself, and what faded before it.

        Args:
            depth, deeper, layer, numbers: See `_cross` and `cross_hits_kernel`.
            carried: Weight, patch and way of rays.
            behind: Gets points, normals, directions, whether they are inside, weights, patches and ways, which may be the same.
        """
        scene, gbuffer, threads, n = self._scene, self._gbuffer, self._settings.threads, layer.pixels.count
        weight, fading, way = carried
        point, normal, direction, inside, carried, still_fading, further = behind
        looks = prepare_looks(scene, gbuffer, layer, threads)
        normals = prepare_normals(scene, gbuffer, layer, threads)
        own, faded = (wp.empty(n, dtype=wp.vec3, device=scene.device) for _ in range(2))
        inputs = [scene.view, self._interfaces.views, looks, normals, layer.triangle, layer.u, layer.v, layer.distance]
        inputs += [layer.pixels.pixel, layer.pixels.direction, fading, weight, depth, deeper]
        outputs = [own, faded, point, normal, direction, inside, carried, still_fading]
        launch.launch(cross_hits_kernel, n, inputs + outputs, scene.device, threads)
        if self._near is not None:
            ways = [numbers, layer.triangle, layer.distance, own, carried, way, further, self._near]
            launch.launch(nearness_kernel, n, ways, scene.device, threads)
        return own, faded

    def _gather(self, depth: int, numbers: wp.array, own: wp.array, faded: wp.array, seen: wp.array) -> None:
        device = self._scene.device
        if self.total is self._seen:
            self.total = wp.empty(self._first.pixels.count, dtype=wp.vec3, device=device)
        inputs = [numbers, own, faded, seen, int(depth == 0), self.total]
        launch.launch(gather_kernel, len(numbers), inputs, device, self._settings.threads)

    def _go_on(self, depth: int, layer: ReflectionLayer, numbers: wp.array, going: compact.Some, behind: tuple) -> None:
        if going.mark is not None:
            self._repeat(layer, numbers, going, behind)
            return
        rays = numbers, layer.pixels.pixel, layer.triangle, *behind
        taken = [compact.taken(array, going.numbers) if len(array) else array for array in rays]
        if depth == self._settings.transparency_depth:
            self._first.count_later("depth_limit", taken[0].numpy)
            return
        numbers, pixel, facet, point, normal, direction, inside, *carried = taken
        self._first.count_later("onward", numbers.numpy)
        pixels = MirrorPixels(layer.pixels.reflector, pixel, point, normal, direction, layer.pixels.box)
        layer = self._trace(pixels, facet, inside)
        self._cross(depth + 1, layer, self._met(layer), numbers, *carried)

    def _trace(self, pixels: MirrorPixels, facet: wp.array, inside: wp.array) -> ReflectionLayer:
        scene, settings, width = self._scene, self._settings, self._gbuffer.camera.size[0]
        layer = ReflectionLayer.unset(pixels, Technique.RAYTRACED, scene.device)
        bvh.trace_transmitted(scene, layer, facet, inside, settings.threads, None, settings.kernels, width)
        return layer

    def _repeat(self, layer: ReflectionLayer, numbers: wp.array, going: compact.Some, behind: tuple) -> None:
        """The same where nothing is read, as often as rays go on: all stay where they are, and what ends has the number -1."""
        device, n, limit = self._scene.device, layer.pixels.count, self._settings.transparency_depth
        numbers, pixel = (wp.clone(array) for array in (numbers, layer.pixels.pixel))
        facet, depth = wp.empty(n, dtype=int, device=device), wp.full(1, -1, dtype=int, device=device)
        counted = launch.mark(device)
        onward, ended = wp.zeros(n, dtype=wp.uint16, device=device), wp.zeros(n, dtype=wp.uint8, device=device)
        point, normal, direction, inside, weight, fading, way = behind
        rays = replace(
            layer.pixels, pixel=pixel, point=point, normal=normal, direction=direction, everywhere=False, whole=None
        )

        def still(triangle: wp.array) -> None:
            launch.launch(next_surface_kernel, 1, [depth, going.mark], device)
            inputs = [weight, triangle, depth, limit, pixel, numbers, facet, onward, ended, going.mark, counted]
            launch.launch(still_kernel, n, inputs, device)

        def behind_next() -> None:
            layer = self._trace(rays, facet, inside)
            seen = self._met(layer)
            own, faded = self._lead(1, depth, layer, numbers, (weight, fading, way), behind)
            self._gather(1, numbers, own, faded, seen)
            still(layer.triangle)

        still(layer.triangle)
        launch.while_marked(going.mark, behind_next, limit)
        for name, times in (("onward", onward), ("depth_limit", ended)):
            self._first.count_later(name, partial(_repeated, times, counted))


def _both(one: Callable[[], None], other: Callable[[], None]) -> None:
    one()
    other()


def _repeated(times: wp.array, counted: wp.array) -> np.ndarray:
    """The number of each ray as often as it is counted, if any was; read now."""
    if not counted.numpy()[0]:
        return np.zeros(0, np.int32)
    return np.repeat(np.arange(len(times)), times.numpy())


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
