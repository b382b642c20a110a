"""Every mirror pixel's reflected ray through the BVH of the scene: the reference and the last resort."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from warp_reflect import bvh
from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Technique


@dataclass(frozen=True)
class Prepared:
    """The mirror as the tracer needs it: `part` of the scene, `convex` if its own body is stepped over."""

    part: int
    convex: bool


def applies(scene: Scene, reflector) -> tuple[bool, str]:
    """Tracing asks nothing of a mirror."""
    return True, "rays can be traced off any surface"


def prepare(scene: Scene, reflector, settings: Settings) -> Prepared:
    """Build the BVH of what the mirror may show here, so that the first frame does not pay for it."""
    scene.mirror_tracer(reflector.part)
    return Prepared(reflector.part, reflector.convex)


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """The first surface along every reflected ray; neither the camera nor the history matters.

    Returns:
        A layer with status CONVERGED, SKY or STEP_LIMIT; statistics `bvh`: rays traced.
    """
    layer = ReflectionLayer.unset(pixels, Technique.RAYTRACED, scene.device)
    layer.statistics["bvh"] = bvh.trace_pixels(
        scene,
        gbuffer,
        pixels,
        layer,
        prepared.part,
        prepared.convex,
        threads=settings.threads,
        kernels=settings.kernels,
    )
    return layer


def reflect_together(
    scene: Scene,
    prepared: Sequence[Prepared],
    gbuffer: GBuffer,
    pixels: Sequence[MirrorPixels],
    settings: Settings,
    bodies: wp.array,
) -> list[ReflectionLayer]:
    """The same of several mirrors, whose pixels follow one another: their layers are slices of a whole.

    Args:
        bodies: Of the scene's mirrors, `bounces.Mirrors.bodies`.
    """
    whole = ReflectionLayer.unset(MirrorPixels.joined(pixels), Technique.RAYTRACED, scene.device)
    layers = whole.parts(pixels)
    mirrors = [(each.part, each.convex) for each in prepared]
    bvh.trace_together(scene, gbuffer, layers, mirrors, bodies, settings.threads, settings.kernels)
    for layer in layers:
        layer.statistics["bvh"] = layer.pixels.count
    return layers
