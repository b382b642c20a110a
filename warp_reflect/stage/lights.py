"""UsdLux lights to `LightData`, and the dome of a stage that has none."""

from __future__ import annotations

import numpy as np
from pxr import UsdLux

from warp_reflect.scene import LightData
from warp_reflect.stage.intake import BadPrim, Intake, number, transform_fault

DEFAULT_LIGHT_PATH = "/__default dome"
DEFAULT_DOME_RADIANCE = (
    0.5  # grey that leaves white diffuse surfaces below the display's white, and mirrors readable
)

DOMES = ("DomeLight", "DomeLight_1")


def read_light(prim, world_from_light: np.ndarray, intake: Intake) -> LightData:
    """A dome or distant light.

    A dome's colour is its radiance, color * intensity * 2^exposure. A distant light's is the irradiance E on
    a surface that faces it: its disc of half angle t has radiance L = color * intensity * 2^exposure and E =
    L pi sin^2 t; `normalize` divides L by that same pi sin^2 t; of an angle of 0 (no disc) E is the
    normalized value.

    Raises:
        BadPrim: a value that is no number or below zero, or a transform that turns nothing.
        NotImplementedError: a light of another type.

    Source: UsdLuxLightAPI, UsdLuxDistantLight (sizeFactor_distant), in the schema's documentation.
    """
    kind = prim.GetTypeName()
    if kind not in (*DOMES, "DistantLight"):
        raise NotImplementedError(f"{kind} is not used")
    fault = transform_fault(world_from_light)
    if fault:
        raise BadPrim(fault)
    radiance = _emission(prim, intake)
    path = str(prim.GetPath())
    if kind in DOMES:
        texture = UsdLux.DomeLight(prim).GetTextureFileAttr().Get(intake.time)
        if texture and texture.path:
            intake.note(path, f"inputs:texture:file: @{texture.path}@ is not used")
        return LightData(path, "dome", radiance, world_from_light)
    light = UsdLux.DistantLight(prim)
    angle = number(light.GetAngleAttr(), intake.time, 0.0)
    disc = np.pi * np.sin(np.radians(min(0.5 * angle, 90.0))) ** 2
    normalized = bool(UsdLux.LightAPI(prim).GetNormalizeAttr().Get(intake.time))
    factor = 1.0 if normalized or disc == 0.0 else disc
    return LightData(path, "distant", tuple(factor * v for v in radiance), world_from_light)


def default_dome() -> LightData:
    """The grey dome of a stage without lights."""
    return LightData(DEFAULT_LIGHT_PATH, "dome", (DEFAULT_DOME_RADIANCE,) * 3, np.eye(4))


def _emission(prim, intake: Intake) -> tuple[float, float, float]:
    """Color * intensity * 2^exposure, times the colour temperature where enabled; linear Rec.709."""
    light = UsdLux.LightAPI(prim)
    color = np.array(light.GetColorAttr().Get(intake.time), np.float64)
    if color.shape != (3,) or not np.isfinite(color).all():
        raise BadPrim(f"inputs:color: got {color.tolist()}, expected 3 finite numbers")
    intensity = light.GetIntensityAttr()
    legacy = prim.GetAttribute("intensity")
    if legacy and legacy.HasAuthoredValue() and not intensity.HasAuthoredValue():
        intake.note(prim.GetPath(), "intensity: written without inputs: by an old exporter; used")
        intensity = legacy
    strength = number(intensity, intake.time, 0.0) * 2.0 ** number(light.GetExposureAttr(), intake.time)
    if light.GetEnableColorTemperatureAttr().Get(intake.time):
        kelvin = number(light.GetColorTemperatureAttr(), intake.time, 0.0, open_low=True)
        color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    emission = color * strength
    if not np.isfinite(emission).all():
        raise BadPrim(
            f"inputs:intensity, inputs:exposure: got an emission of {strength:g}, expected a finite one"
        )
    return tuple(float(v) for v in emission)
