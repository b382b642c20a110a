"""Every mirror pixel's reflected ray through the BVH of the scene: the reference and the last resort."""

from __future__ import annotations

from dataclasses import dataclass

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
