"""How finely a mesh is subdivided: by what it is and how large it appears."""

from __future__ import annotations

import numpy as np

from warp_reflect.scene import CameraData

NOMINAL_WIDTH = 960  # pixels; a stage is read before the image size is known, and this is usdrecord's default
MIRROR_EDGE_PIXELS = 6.0  # facets of a mirror are cut to about this; limit normals do the rest
MIRROR_LEVEL_MAX = 4
SMALL_PIXELS = 32.0  # what is smaller on screen is drawn as its cage
FINE_EDGE_PIXELS = 3.0  # so is a cage that is this dense: production meshes of 10^5 faces
MIRROR_FINE_EDGE_PIXELS = 2.0  # likewise of a mirror: 10^6 faces, whose own normals are as good as the limit's


def subdivision_level(face_count: int, is_mirror: bool, pixels: float) -> int:
    """The level of a subdivision surface where no complexity is asked for.

    Mirrors are refined until an edge spans about `MIRROR_EDGE_PIXELS`, at most `MIRROR_LEVEL_MAX` times and at least
    once, unless their edges span `MIRROR_FINE_EDGE_PIXELS` at most; everything else once if it is larger than
    `SMALL_PIXELS` and its edges span more than `FINE_EDGE_PIXELS`, else not at all.

    Args:
        face_count: Faces of the cage.
        is_mirror: Whether its material may make it a reflector.
        pixels: How large it appears, `pixels_across`; inf where the eye is within its bounds.
    """
    # The faces tile a sphere of this diameter about evenly: an edge is sqrt(pi pixels^2 / face_count).
    edge = pixels * np.sqrt(np.pi / max(face_count, 1))
    if not is_mirror:
        return 1 if pixels > SMALL_PIXELS and edge > FINE_EDGE_PIXELS else 0
    if edge <= MIRROR_EDGE_PIXELS:
        return 1 if pixels > SMALL_PIXELS and edge > MIRROR_FINE_EDGE_PIXELS else 0
    if not np.isfinite(edge):
        return MIRROR_LEVEL_MAX
    return int(np.clip(np.ceil(np.log2(edge / MIRROR_EDGE_PIXELS)), 1, MIRROR_LEVEL_MAX))


def pixels_across(low: np.ndarray, high: np.ndarray, worlds: np.ndarray, camera: CameraData) -> float:
    """Diameter of a box's bounding sphere in a `NOMINAL_WIDTH` picture, the largest over all placements.

    Args:
        low: Lower corner of the box in object space, float64 [3].
        high: Upper corner.
        worlds: `world_from_object` of each placement, float64 [n, 4, 4].
        camera: Where it is seen from; which way it looks does not count, as a mirror may show what is behind
            it.
    """
    middle = worlds[:, :3, :3] @ (0.5 * (low + high)) + worlds[:, :3, 3]
    scale = np.linalg.norm(worlds[:, :3, :3], axis=1).max(axis=1)
    radius = 0.5 * np.linalg.norm(high - low) * scale
    if camera.projection == "orthographic":
        return float((2.0 * radius).max() * NOMINAL_WIDTH * 10.0 / camera.horizontal_aperture)
    distance = np.linalg.norm(middle - camera.world_from_camera[:3, 3], axis=1)
    focal_pixels = NOMINAL_WIDTH * camera.focal_length / camera.horizontal_aperture
    with np.errstate(divide="ignore"):
        pixels = np.where(distance > radius, 2.0 * radius * focal_pixels / distance, np.inf)
    return float(pixels.max())
