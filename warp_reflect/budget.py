"""What a technique is predicted to cost on a machine, from what its steps were measured to cost."""

from __future__ import annotations

from warp_reflect.launch import thread_count
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Settings

# Microseconds per element on one CPU thread (a 2026 server core). Ratios between them decide, and those vary less from
# machine to machine than the figures.
SEARCH_US = 0.16  # per virtual vertex, between a warm (0.13) and a cold (0.45) start
RASTER_US = 0.35  # per virtual triangle, the clipping at the hidden boundary included
REFINE_US = 0.18  # per mirror pixel
TRACE_US = 0.6  # per mirror pixel at 60,000 triangles; grows with their logarithm, which is left out
DOUBT_SHARE = 0.05  # of the mirror pixels that refinement leaves to the BVH
BRANCHES_US = (
    20.0  # per vertex of the scene, where all its reflection points on a concave side are searched (4 a search)
)
OWN_BODY_US = 0.25  # per pixel of a mirror that may see itself
LOOK_UP_US = 0.12  # per mirror pixel: one bilinear look-up in a cube map
MAP_TEXEL_US = 0.4  # per texel of a map that is drawn: its ray, its shading
MAP_RASTER_US = 0.1  # per triangle and face of a map that is drawn
MAP_TEXEL_BYTES = 24  # radiance and coverage, distance, triangle
CURVED_SHARE = 2.0  # virtual vertices and triangles per one of the scene, where a curved mirror bends edges


def predict(
    scene: Scene,
    part: PartRange,
    technique: str,
    pixels: int,
    settings: Settings,
    branches: bool = False,
    passes: int = 1,
    held: float = 1.0,
) -> dict[str, float]:
    """Predicted `error_px`, `ms` per frame and prepared `bytes` of a reflector.

    Args:
        part: The mirror; its own vertices and triangles have no picture in it.
        technique: A key of `TECHNIQUES`.
        pixels: At which it is seen.
        settings: The knobs.
        branches: The mirror is seen from within, and every vertex may appear several times (`quadric` and
            `reflector_map`).
        passes: How often every vertex is reflected: once for every sheet of a mirror.
        held: Share of the mirror that the technique holds; the rest is traced, and the mirror may see itself.
    """
    threads = thread_count(scene.device, settings.threads)
    traced = pixels * TRACE_US
    if technique == "raytraced" or pixels == 0:
        return {"error_px": 0.0, "ms": 1e-3 * traced / threads, "bytes": 0}
    if technique == "environment":
        texels = 6 * settings.environment_resolution**2
        drawn = texels * MAP_TEXEL_US + 6 * scene.triangle_count * MAP_RASTER_US
        work = pixels * LOOK_UP_US + (0.0 if settings.environment_update == "static" else drawn)
        return {"error_px": 0.0, "ms": 1e-3 * work / threads, "bytes": texels * MAP_TEXEL_BYTES}
    vertices = scene.vertex_count - (part.vertex_count if part.is_whole else 0)
    forward = vertices * SEARCH_US + (scene.triangle_count - part.triangle_count) * RASTER_US
    if technique != "planar":
        forward *= CURVED_SHARE
    forward *= passes
    if held < 1.0 or passes > 1:
        forward += pixels * ((1.0 - held) * TRACE_US + OWN_BODY_US)
    if branches:
        forward += vertices * BRANCHES_US + pixels * OWN_BODY_US
    if settings.refine != "off":
        forward += pixels * (REFINE_US + DOUBT_SHARE * TRACE_US)
    bytes_ = passes * 6 * settings.map_resolution**2 * 32 if technique == "reflector_map" else 0
    # Straight virtual edges between exact vertices: the papers' picture is wrong by about a pixel at silhouettes.
    error = 0.0 if settings.refine != "off" else 1.0
    return {"error_px": error, "ms": 1e-3 * forward / threads, "bytes": bytes_}
