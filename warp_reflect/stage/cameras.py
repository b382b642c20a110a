"""UsdGeomCamera to `CameraData`, and a camera that frames a stage that has none."""

from __future__ import annotations

import numpy as np
from pxr import UsdGeom

from warp_reflect.scene import CameraData
from warp_reflect.stage.intake import BadPrim, Intake, number, token, transform_fault

DEFAULT_CAMERA_PATH = "/__default camera"
# Where the default camera stands, seen from the middle of the stage: to the right, in front, a little above.
DEFAULT_AZIMUTH = np.radians(30.0)
DEFAULT_ELEVATION = np.radians(20.0)


def read_camera(prim, world_from_camera: np.ndarray, intake: Intake) -> CameraData:
    """A camera prim.

    Raises:
        BadPrim: an aperture, focal length, clipping range, projection or transform that makes no picture.
    """
    fault = transform_fault(world_from_camera)
    if fault:
        raise BadPrim(fault)
    camera = UsdGeom.Camera(prim)
    projection = token(camera.GetProjectionAttr(), intake.time, ("perspective", "orthographic"))
    clipping = np.array(camera.GetClippingRangeAttr().Get(intake.time))
    if clipping.dtype.kind not in "fiu" or clipping.shape != (2,):
        raise BadPrim(f"clippingRange: got {clipping.tolist()!r}, expected two numbers")
    near, far = (float(v) for v in clipping)
    if not (np.isfinite(near) and far > near and (near > 0.0 or projection == "orthographic")):
        raise BadPrim(f"clippingRange: got ({near:g}, {far:g}), expected 0 < near < far")
    planes = camera.GetClippingPlanesAttr().Get(intake.time)
    if planes is not None and len(planes):
        intake.note(prim.GetPath(), f"clippingPlanes: {len(planes)} planes are not used")
    f_stop = camera.GetFStopAttr().Get(intake.time)
    if isinstance(f_stop, float) and f_stop > 0.0:
        intake.note(prim.GetPath(), "fStop: depth of field is not simulated")
    perspective = projection == "perspective"
    return CameraData(
        path=str(prim.GetPath()),
        world_from_camera=world_from_camera,
        projection=projection,
        horizontal_aperture=number(camera.GetHorizontalApertureAttr(), intake.time, 0.0, open_low=True),
        vertical_aperture=number(camera.GetVerticalApertureAttr(), intake.time, 0.0, open_low=True),
        horizontal_offset=number(camera.GetHorizontalApertureOffsetAttr(), intake.time),
        vertical_offset=number(camera.GetVerticalApertureOffsetAttr(), intake.time),
        focal_length=number(camera.GetFocalLengthAttr(), intake.time, 0.0, open_low=True) if perspective else 50.0,
        near=near,
        far=min(far, 1.0e30),  # infinity is legal in USD; a depth must stay finite in float32
    )


def default_camera(low: np.ndarray, high: np.ndarray, up_axis: str) -> CameraData:
    """A camera that sees the whole box low..high (float64 [3]), from the front right."""
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0
    level = np.cos(DEFAULT_ELEVATION) * np.array([np.sin(DEFAULT_AZIMUTH), np.cos(DEFAULT_AZIMUTH)])
    rise = np.sin(DEFAULT_ELEVATION)
    if up_axis == "Z":
        back, up = np.array([level[0], -level[1], rise]), np.array([0.0, 0.0, 1.0])
    else:
        back, up = np.array([level[0], rise, level[1]]), np.array([0.0, 1.0, 0.0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    frame = CameraData(DEFAULT_CAMERA_PATH, np.eye(4))
    narrow = min(frame.horizontal_aperture, frame.vertical_aperture)
    distance = radius / float(np.sin(np.arctan(0.5 * narrow / frame.focal_length)))
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    world_from_camera[:3, 3] = middle + distance * back
    return CameraData(
        DEFAULT_CAMERA_PATH, world_from_camera, near=0.5 * (distance - radius), far=2.0 * (distance + radius)
    )
