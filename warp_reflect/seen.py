"""Objects as mirrors show them: boxes for detection, and where the same points are seen directly (an ST map)."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from warp_reflect import __version__, images
from warp_reflect.frame import Frame
from warp_reflect.layers import Camera

# Of its distance: a point is seen directly if nothing lies this much before it. float32 points and hits carry 1e-6.
BEFORE = 1.0e-4
ST_CONVENTION = (
    "R, G: s, t of where the point seen in the mirror appears directly in this picture, s = x / width to the right, "
    "t = 1 - y / height upwards, pixel centres at +0.5; A: 1 where it is seen. OpenImageIO: st_warp with flip_t"
)


def seen_objects(frame: Frame) -> list[dict]:
    """Every object that a mirror shows, once per mirror, by `reflectorId` and `reflectedId`.

    Returns:
        Entries `mirrorId`, `mirror` (prim path), `objectId`, `object` (prim path), `bbox` [x, y, width, height] in pixels
        from the top left corner, `area` in pixels, `pathLength`: the mean of eye -> mirror -> object. [stage units]
    """
    mirror, seen, path_length = (frame[name] for name in ("reflectorId", "reflectedId", "pathLength"))
    row, column = np.nonzero((mirror > 0) & (seen > 0))
    pairs = np.stack([mirror[row, column], seen[row, column]], axis=1).astype(int)
    prims, mirrors = frame.prims, frame.reflectors
    found = []
    for mirror_id, object_id in np.unique(pairs, axis=0).tolist():
        own = (pairs == (mirror_id, object_id)).all(axis=1)
        y, x = row[own], column[own]
        found.append(
            {
                "mirrorId": mirror_id,
                "mirror": mirrors[mirror_id],
                "objectId": object_id,
                "object": prims[object_id],
                "bbox": [int(x.min()), int(y.min()), int(np.ptp(x)) + 1, int(np.ptp(y)) + 1],
                "area": len(x),
                "pathLength": float(path_length[y, x].astype(np.float64).mean()),
            }
        )
    return found


def coco_boxes(frame: Frame, image_id: int = 1, file_name: str = "", info: dict | None = None) -> dict:
    """A frame's `seen_objects` in the layout of COCO's detection files.

    Categories are the prims of the stage, by their `reflectedId`: all of them, so that the frames of a range agree. What COCO
    does not know: `mirror` {id, path} and `pathLength` of an annotation, `camera` and `time` of an image.

    Args:
        frame: A frame.
        image_id: Of the picture in its data set; numbers of annotations start at a million times it.
        file_name: Of the picture.
        info: More entries of `info`.
    """
    width, height = frame.camera.size
    picture = {"id": image_id, "width": width, "height": height, "file_name": file_name}
    annotations = [
        {
            "id": image_id * 1_000_000 + number,
            "image_id": image_id,
            "category_id": each["objectId"],
            "bbox": each["bbox"],
            "area": each["area"],
            "iscrowd": 0,
            "mirror": {"id": each["mirrorId"], "path": each["mirror"]},
            "pathLength": each["pathLength"],
        }
        for number, each in enumerate(seen_objects(frame))
    ]
    return {
        "info": {"description": "objects seen in mirrors", "version": __version__} | (info or {}),
        "images": [picture | {"camera": frame.camera.path, "time": frame.scene.data.time}],
        "categories": [
            {"id": number, "name": path, "supercategory": path.rpartition("/")[0] or "/"}
            for number, path in frame.prims.items()
        ],
        "annotations": annotations,
    }


def write_boxes(path: str | os.PathLike, boxes: dict) -> None:
    """Write `coco_boxes` as JSON, whole: to a passing name that is synced and renamed.

    Raises:
        OSError: it could not be written; an older file under the name is still whole.
    """
    final = Path(os.path.realpath(path))
    part = final.with_name(f".{os.getpid()}-{final.stem[:60]}.part{final.suffix}")
    try:
        with open(part, "w", encoding="utf-8") as file:
            json.dump(boxes, file, indent=1, allow_nan=False)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, final)
    except OSError as error:
        raise OSError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)


def read_boxes(path: str | os.PathLike) -> dict:
    """What `write_boxes` has written.

    Raises:
        OSError: it cannot be read, or is no such file.
    """
    try:
        boxes = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise OSError(f"{path}: no JSON: {error}") from None
    if not isinstance(boxes, dict) or not isinstance(boxes.get("info"), dict) or "annotations" not in boxes:
        raise OSError(f"{path}: no file of boxes")
    return boxes


def st_map(frame: Frame) -> np.ndarray:
    """Where the point seen at a mirror pixel appears directly in the same picture.

    Returns:
        float32 [height, width, 4]: s, t, 0, 1 as `ST_CONVENTION` has it; all 0 at pixels without a reflection, and where
        the point is outside of the picture, behind the camera or hidden by something else.
    """
    camera, scene = frame.camera, frame.scene
    width, height = camera.size
    result = np.zeros((height, width, 4), np.float32)
    triangle = np.full(width * height, -1)
    for layer in frame.layers.values():
        triangle[layer.pixels.pixel.numpy()] = layer.triangle.numpy()
    row, column = np.nonzero(frame["reflectedId"] > 0)
    point = frame.relative("reflectedPoint")[row, column].astype(np.float64)
    x, y, depth = _place(camera, point)
    inside = (x >= 0.0) & (x < width) & (y >= 0.0) & (y < height) & (depth >= camera.near) & (depth <= camera.far)
    row, column, point, x, y, depth = (each[inside] for each in (row, column, point, x, y, depth))
    if not len(row):
        return result
    start = point - depth[:, None] * camera.forward if camera.orthographic else np.zeros_like(point)
    distance = np.linalg.norm(point - start, axis=1)
    direction = (point - start) / distance[:, None]
    origin = start + (camera.eye - scene.origin)
    first, t, _, _ = scene.tracer.trace(
        origin.astype(np.float32), direction.astype(np.float32), frame.plan.settings.threads
    )
    first, t = first.numpy(), t.numpy()
    # A ray may miss the very edge of a triangle: nothing before the point is what counts.
    shown = (first < 0) | (first == triangle[row * width + column]) | (t >= (1.0 - BEFORE) * distance)
    result[row[shown], column[shown]] = np.stack(
        [x[shown] / width, 1.0 - y[shown] / height, np.zeros(shown.sum()), np.ones(shown.sum())], axis=1
    )
    return result


def write_st_map(path: str | os.PathLike, frame: Frame, attributes: dict | None = None) -> None:
    """Write `st_map` as an EXR of float32 channels R, G, B, A; the header's `warp_reflect:st` says what they are.

    Raises:
        OSError: it could not be written.
    """
    told = {"warp_reflect:version": __version__, "warp_reflect:st": ST_CONVENTION} | (attributes or {})
    image = st_map(frame)
    channels = {letter: image[..., k] for k, letter in enumerate("RGBA")}
    images.write_exr(path, channels, half=(), attributes=told)


def _place(camera: Camera, point: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixel coordinates and depths of eye-frame points; NaN free, outside of the picture behind the camera."""
    depth = point @ camera.forward
    scale = np.ones_like(depth) if camera.orthographic else np.where(depth > 0.0, depth, np.inf)
    x = camera.fx * (point @ camera.right) / scale + camera.cx
    y = -camera.fy * (point @ camera.up) / scale + camera.cy
    return x, y, depth
