"""Whole objects that a mirror cannot show, found by the corners of their boxes before any vertex is searched.

What lies behind a convex body as seen from the eye is convex (so is the half space behind a plane): an object whose box
has all its corners there is hidden. An object whose box appears, bent edges included, beside the pixels at which the
mirror is seen is not shown either.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from warp_reflect import raster
from warp_reflect.layers import Camera, MirrorPixels
from warp_reflect.scene import PartRange, Scene
from warp_reflect.settings import Status
from warp_reflect.techniques import virtual_mesh
from warp_reflect.techniques.vertices import VertexView

# Vertices: the corners of a box are searched from nothing, which costs as much as some thirty vertices of the last frame.
WORTH = 128
# Corners solved per vertex of the scene at most: beyond it the boxes cost more than they can save.
CORNER_SHARE = 0.1


def settle_culled(
    scene: Scene,
    solve: Callable,
    pixels: MirrorPixels,
    camera: Camera,
    unit_per_scene: float,
    out_vertex: VertexView,
) -> Callable[[], int]:
    """Settle the vertices of objects that the mirror cannot show as `Status.UNREFLECTED`.

    Args:
        solve: points vec3 [n] -> `VertexView` of them.
        pixels: The mirror's pixels; the mirror is convex or a plane.
        unit_per_scene: Scale of the solver's frame.
        out_vertex: The scene's own vertices come first.

    Returns:
        How many vertices, counted when it is called.
    """
    first, count, corners = (values[scene.boxes[1] >= WORTH] for values in scene.boxes)
    if not 0 < 8 * len(first) <= CORNER_SHARE * scene.vertex_count:
        return lambda: 0

    def make() -> tuple[wp.array, wp.array, wp.array]:
        numbers = (wp.array(each.astype(np.int32), dtype=int, device=scene.device) for each in (first, count))
        return *numbers, wp.array(corners.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=scene.device)

    boxes, focal = scene.kept("boxes", None, make), max(camera.fx, camera.fy)
    gone = virtual_mesh.settle_gone(boxes, solve(boxes[2]), unit_per_scene, focal, pixels.box, out_vertex)
    return lambda: int(count[gone.numpy() == 1].sum())


def settle_unseen(scene: Scene, mirror: PartRange, out_vertex: VertexView) -> None:
    """Settle the vertices of prims that a mirror may not show (`Scene.seen_in`) as `Status.UNREFLECTED`."""
    seen = scene.seen_in(mirror)
    for part in scene.parts if seen is not None else ():
        if part.triangle_count and not seen[part.first_triangle]:
            _settle(part.first_vertex, part.vertex_count, out_vertex)


def _settle(first: int, count: int, out_vertex: VertexView) -> None:
    members = slice(first, first + count)
    out_vertex.status[members].fill_(int(Status.UNREFLECTED))
    out_vertex.screen[members].fill_(wp.vec4(0.0, 0.0, raster.DROPPED, 0.0))
