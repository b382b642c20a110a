"""What a frame's error came out as: some tiles of its mirror pixels traced, and compared with what it shows there."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect import bvh
from warp_reflect.channels import reflection_channels
from warp_reflect.frame import Frame
from warp_reflect.layers import ReflectionLayer
from warp_reflect.metrics import PixelClass, compare_frames
from warp_reflect.settings import Status, Technique
from warp_reflect.techniques import MAPS, TECHNIQUES

TILE = 16  # pixels a side; what is shifted by more than a tile counts as not shown
PIXELS = 8192  # that are traced, about: a 95th percentile of them is good to a per cent
COMPARED = ("reflectedId", "status", "pathLength", "reflectedPoint")


@dataclass(frozen=True)
class Realised:
    """The error of a frame, of the interior mirror pixels in some tiles.

    Attributes:
        pixels: That were compared.
        error_median_px, error_p95_px: How far off things are shown; infinite where more pixels than that show another thing.
        wrong_share: Of the pixels that show another prim, or what is seen nowhere near.
    """

    pixels: int
    error_median_px: float
    error_p95_px: float
    wrong_share: float

    def __str__(self) -> str:
        return f"{self.error_p95_px:.2g} px (95 % of {self.pixels:,} pixels)"


def realised_error(frame: Frame, pixels: int = PIXELS) -> Realised:
    """Trace a part of a frame's mirror pixels and compare.

    Args:
        frame: Any frame; mirrors that were traced are their own truth. An environment map shows, in a direction, what lies
            there from its centre.
        pixels: To trace, about.

    Returns:
        A `Realised`, of 0 pixels where no mirror is seen.
    """
    width, height = frame.camera.size
    tiles = _tiles(frame, pixels) if frame.layers else []
    if not tiles:
        return Realised(0, 0.0, 0.0, 0.0)
    of_pixel = np.zeros((height, width), np.int64)
    for number, (y, x) in enumerate(tiles, 1):
        of_pixel[y : y + TILE, x : x + TILE] = number
    asked = of_pixel.reshape(-1) > 0
    shown, truth, unrefined = {}, {}, set()
    for row in frame.plan.rows:
        layer = frame.layers.get(row.reflector.id)
        if layer is None:
            continue
        index = np.flatnonzero(asked[layer.pixels.pixel.numpy()]).astype(np.int32)
        shown[row.reflector.id] = truth[row.reflector.id] = layer
        if row.technique == "raytraced" or not len(index):
            continue
        truth[row.reflector.id] = _traced(frame, row, layer, index)
        if row.technique == "environment":
            shown[row.reflector.id] = _from_the_centre(frame, row, layer)
        if row.technique in MAPS or row.settings.refine == "off":
            unrefined.add(row.reflector.id)
    mine = _atlas(frame, shown, of_pixel, tiles, frozenset(unrefined))
    true = _atlas(frame, truth, of_pixel, tiles, frozenset())
    found = compare_frames(mine, true)
    classes, error = found.classes, found.error_px.astype(np.float64)
    lost = np.isin(classes, (PixelClass.WRONG, PixelClass.UNMATCHED, PixelClass.UNANSWERED))
    error = np.where(lost, np.inf, error)[classes >= PixelClass.IDENTICAL]
    if not len(error):
        return Realised(0, 0.0, 0.0, 0.0)
    # Without interpolation: half of infinite is no error.
    median, p95 = (float(np.percentile(error, share, method="lower")) for share in (50, 95))
    return Realised(len(error), median, p95, float(lost.sum() / len(error)))


def as_points(frame: Frame) -> dict[str, np.ndarray]:
    """The channels of `COMPARED` with environment maps judged by the points that lie where they show them, relative to the eye.

    Of all else they are the frame's own.
    """
    width, height = frame.camera.size
    layers, unrefined = dict(frame.layers), set()
    for row in frame.plan.rows:
        if row.technique == "environment" and row.reflector.id in layers:
            layers[row.reflector.id] = _from_the_centre(frame, row, layers[row.reflector.id])
        if row.technique == "environment" or (row.settings.refine == "off" and row.technique != "raytraced"):
            unrefined.add(row.reflector.id)
    found = reflection_channels(frame.scene, frame.gbuffer, layers, frame.plan.settings.threads, frozenset(unrefined))
    images = {name: found[name].numpy() for name in COMPARED}
    return {name: image.reshape(height, width, *image.shape[1:]) for name, image in images.items()}


def _tiles(frame: Frame, pixels: int) -> list[tuple[int, int]]:
    """Corners (y, x) of the tiles to compare, evenly among those that show a mirror."""
    width, height = frame.camera.size
    mirror = np.zeros((-(-height // TILE) * TILE, -(-width // TILE) * TILE), bool)
    mirror[:height, :width] = frame["reflectorId"] > 0
    count = mirror.reshape(mirror.shape[0] // TILE, TILE, -1, TILE).sum(axis=(1, 3))
    rows, columns = np.nonzero(count)
    step = max(1, math.ceil(int(count.sum()) / pixels))
    return [(int(y) * TILE, int(x) * TILE) for y, x in zip(rows[::step], columns[::step], strict=True)]


def _traced(frame: Frame, row, layer: ReflectionLayer, index: np.ndarray) -> ReflectionLayer:
    scene, reflector = frame.scene, row.reflector
    truth = ReflectionLayer.empty(layer.pixels, Technique.RAYTRACED, scene.device)
    chosen = wp.array(index, dtype=int, device=scene.device)
    convex = reflector.convex
    settings = frame.plan.settings
    how = {"threads": settings.threads, "kernels": settings.kernels}
    bvh.trace_pixels(scene, frame.gbuffer, layer.pixels, truth, reflector.part, convex, chosen, **how)
    return truth


def _from_the_centre(frame: Frame, row, layer: ReflectionLayer) -> ReflectionLayer:
    """What an environment map shows as the points that lie there."""
    scene, part = frame.scene, row.reflector.part
    direction = layer.pixels.direction.numpy()
    centre = TECHNIQUES["environment"].centre_of(scene, part) - scene.origin
    origins = np.tile(centre, (len(direction), 1))
    body = bvh.body_of(scene, part, convex=True)
    shown = ReflectionLayer.empty(layer.pixels, Technique.ENVIRONMENT, scene.device)
    triangle, _, u, v = scene.mirror_tracer(part).trace(origins, direction, frame.plan.settings.threads, body)
    shown.triangle, shown.u, shown.v = triangle, u, v
    status = np.where(triangle.numpy() >= 0, int(Status.CONVERGED), int(Status.SKY)).astype(np.uint8)
    shown.status = wp.array(status, dtype=wp.uint8, device=scene.device)
    return shown


def _atlas(frame: Frame, layers, of_pixel: np.ndarray, tiles, unrefined: frozenset[int]) -> dict[str, np.ndarray]:
    """The channels that are compared, tile below tile with a gap between; every tile has mirrors of its own."""
    width, height = frame.camera.size
    found = reflection_channels(frame.scene, frame.gbuffer, layers, frame.plan.settings.threads, unrefined)
    images = {}
    for name in COMPARED:
        image = found[name].numpy()
        images[name] = image.reshape(height, width, *image.shape[1:])
    mirror = frame["reflectorId"].astype(np.int64)
    images["reflectorId"] = np.where(mirror > 0, of_pixel * (int(mirror.max(initial=0)) + 1) + mirror, 0)
    atlas = {}
    for name, image in images.items():
        stacked = np.zeros((len(tiles) * (TILE + 1), TILE, *image.shape[2:]), image.dtype)
        for number, (y, x) in enumerate(tiles):
            part = image[y : y + TILE, x : x + TILE]
            top = number * (TILE + 1)
            stacked[top : top + part.shape[0], : part.shape[1]] = part
        atlas[name] = stacked
    black = np.zeros(atlas["reflectorId"].shape, np.float32)
    return atlas | {"R": black, "G": black, "B": black}
