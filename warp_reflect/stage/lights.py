"""UsdLux lights to `LightData`, and the dome of a stage that has none."""

from __future__ import annotations

import tempfile

import numpy as np
from pxr import UsdLux

from warp_reflect.images import read_image
from warp_reflect.scene import LightData
from warp_reflect.stage.intake import BadPrim, Intake, number, transform_fault
from warp_reflect.stage.textures import resolve_asset, unpacked

DEFAULT_LIGHT_PATH = "/__default dome"
DEFAULT_DOME_RADIANCE = 0.5  # grey that leaves white surfaces below the display's white, and mirrors readable
SHADED_KINDS = ("dome", "distant", "sphere", "rect", "disk", "cylinder")  # what shade.py uses; others are noted

DOMES = ("DomeLight", "DomeLight_1")
SHAPES = {
    "SphereLight": ("sphere", ("radius",)),
    "RectLight": ("rect", ("width", "height")),
    "DiskLight": ("disk", ("radius",)),
    "CylinderLight": ("cylinder", ("length", "radius")),
}
# Authored, these change how a light shines and are not simulated: noted.
UNUSED = ("shaping:cone:angle", "shaping:cone:softness", "shaping:focus", "shaping:ies:file", "diffuse", "specular")
LINKS = ("collection:lightLink:includes", "collection:lightLink:excludes", "collection:shadowLink:excludes")
LAYOUTS = ("latlong", "mirroredBall", "angular", "cubeMapVerticalCross")
# Width over height of the layouts that a picture's shape gives away; a square is a light probe's.
ASPECTS = {2.0: "latlong", 0.75: "cubeMapVerticalCross", 1.0: "angular"}
ASPECT_ROUNDING = 0.02  # pictures a few pixels off their shape
# A pole along the light's +Z instead of +Y: a quarter turn about x.
Z_POLE = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
RESAMPLED_ROWS_MAX = 1024  # rows of a latlong map made from another layout


def read_light(prim, world_from_light: np.ndarray, up_axis: str, intake: Intake) -> LightData:
    """A light prim.

    With L = color * intensity * 2^exposure (times the colour temperature where enabled):
    a dome's colour is its radiance L, its texture multiplies it. A distant light's is the irradiance E on a
    surface that faces it: its disc of half angle t has radiance L and E = L pi sin^2 t; `normalize` divides L
    by that same pi sin^2 t; of an angle of 0 (no disc) E is L. A shape's is the radiance of its surface, L,
    divided by its world-space area where `normalize` is set.

    Args:
        prim: The light.
        world_from_light: Its transform, float64 [4, 4].
        up_axis: The stage's, for domes whose pole follows it.
        intake: The reading.

    Raises:
        BadPrim: a value that is no number or below zero, or a transform that turns nothing.
        NotImplementedError: a light of another type.

    Source: UsdLuxLightAPI (normalize, sizeFactor), UsdLuxDistantLight, in the schemas' documentation.
    """
    kind = prim.GetTypeName()
    if kind not in (*DOMES, "DistantLight", *SHAPES):
        raise NotImplementedError(f"{kind} is not used")
    fault = transform_fault(world_from_light)
    if fault:
        raise BadPrim(fault)
    radiance = _emission(prim, intake)
    path = str(prim.GetPath())
    normalized = bool(UsdLux.LightAPI(prim).GetNormalizeAttr().Get(intake.time))
    for name in UNUSED:
        attribute = prim.GetAttribute(f"inputs:{name}")
        if attribute and attribute.HasAuthoredValue() and attribute.Get(intake.time) != 1.0:
            intake.note(path, f"inputs:{name} is not used")
    if any(link and link.HasAuthoredTargets() for link in map(prim.GetRelationship, LINKS)):
        intake.note(path, "light linking is not used: it lights everything")
    if kind in DOMES:
        if kind == "DomeLight_1":
            pole = prim.GetAttribute("poleAxis").Get(intake.time)
            if pole == "Z" or (pole == "scene" and up_axis == "Z"):
                world_from_light = world_from_light @ Z_POLE
        return LightData(path, "dome", radiance, world_from_light, _dome_texture(prim, intake))
    if kind == "DistantLight":
        angle = number(prim.GetAttribute("inputs:angle"), intake.time, 0.0)
        disc = np.pi * np.sin(np.radians(min(0.5 * angle, 90.0))) ** 2
        factor = 1.0 if normalized or disc == 0.0 else disc
        return LightData(path, "distant", _times(radiance, factor), world_from_light)
    shape, names = SHAPES[kind]
    size = tuple(number(prim.GetAttribute(f"inputs:{n}"), intake.time, 0.0, open_low=True) for n in names)
    if normalized:
        radiance = _times(radiance, 1.0 / world_area(shape, size, world_from_light))
    if shape not in SHADED_KINDS:
        intake.note(path, f"{kind} is read but does not light the picture")
    texture = prim.GetAttribute("inputs:texture:file")
    if texture and texture.HasAuthoredValue():
        intake.note(path, "inputs:texture:file is not used")
    point = prim.GetAttribute("treatAsPoint")
    if point and point.Get(intake.time):
        intake.note(path, "treatAsPoint is not used: it shines as the sphere it is")
    return LightData(path, shape, radiance, world_from_light, size=size)


def world_area(shape: str, size: tuple[float, ...], world_from_light: np.ndarray) -> float:
    """Area of a light's surface in world space; of a scaled sphere or cylinder side by the mean of its axes.

    Source: UsdLuxLightAPI's sizeFactor: rect width * height, disk pi r^2, sphere 4 pi r^2, cylinder 2 pi r l
    (its caps do not emit), with the transform's scale; a sphere's ellipsoid by Thomsen's formula.
    """
    axes = world_from_light[:3, :3]
    x, y, z = np.linalg.norm(axes, axis=0)
    across = float(np.linalg.norm(np.cross(axes[:, 0], axes[:, 1])))
    if shape == "rect":
        return size[0] * size[1] * across
    if shape == "disk":
        return np.pi * size[0] ** 2 * across
    if shape == "sphere":
        p = 1.6075  # Thomsen's exponent: off by at most 1.061 %
        mean = (((x * y) ** p + (y * z) ** p + (x * z) ** p) / 3.0) ** (1.0 / p)
        return 4.0 * np.pi * size[0] ** 2 * float(mean)
    # Ramanujan's perimeter of the ellipse the circle becomes.
    ratio = ((y - z) / (y + z)) ** 2
    perimeter = np.pi * (y + z) * (1.0 + 3.0 * ratio / (10.0 + np.sqrt(4.0 - 3.0 * ratio)))
    return float(size[0] * x * size[1] * perimeter)


def mesh_light_radiance(prim, area: float, intake: Intake) -> tuple[float, float, float] | None:
    """Radiance of a mesh with MeshLightAPI where its light replaces its material; None where the material glows.

    Args:
        prim: The mesh.
        area: Of its surface in world space, which `normalize` divides by.
        intake: The reading.

    Raises:
        BadPrim: a value that is no number or below zero.

    Source: UsdLuxLightAPI's materialSyncMode: "noMaterialResponse" draws the light's colour alone; in the other modes
    what is seen is the material's own emission.
    """
    if prim.GetAttribute("light:materialSyncMode").Get(intake.time) != "noMaterialResponse":
        return None
    radiance = _emission(prim, intake)
    return _times(radiance, 1.0 / area) if UsdLux.LightAPI(prim).GetNormalizeAttr().Get(intake.time) else radiance


def default_dome() -> LightData:
    """The grey dome of a stage without lights."""
    return LightData(DEFAULT_LIGHT_PATH, "dome", (DEFAULT_DOME_RADIANCE,) * 3, np.eye(4))


def _times(color: tuple[float, ...], factor: float) -> tuple[float, float, float]:
    return tuple(float(factor * v) for v in color)


def _emission(prim, intake: Intake) -> tuple[float, float, float]:
    """L of `read_light`; linear Rec.709."""
    light = UsdLux.LightAPI(prim)
    color = np.array(light.GetColorAttr().Get(intake.time), np.float64)
    if color.shape != (3,) or not (color >= 0.0).all() or not np.isfinite(color).all():
        raise BadPrim(f"inputs:color: got {color.tolist()}, expected 3 finite numbers >= 0")
    intensity = light.GetIntensityAttr()
    legacy = prim.GetAttribute("intensity")
    if legacy and legacy.HasAuthoredValue() and not intensity.HasAuthoredValue():
        intake.note(prim.GetPath(), "intensity: written without inputs: by an old exporter; used")
        intensity = legacy
    exposure = number(light.GetExposureAttr(), intake.time)
    with np.errstate(over="ignore"):
        strength = float(number(intensity, intake.time, 0.0) * np.exp2(exposure))
    if light.GetEnableColorTemperatureAttr().Get(intake.time):
        kelvin = number(light.GetColorTemperatureAttr(), intake.time, 0.0, open_low=True)
        color = color * np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin))
    emission = color * strength
    if not (emission <= np.finfo(np.float32).max).all():
        raise BadPrim(f"inputs:intensity, inputs:exposure: got an emission of {strength:g}, expected a finite one")
    return tuple(float(v) for v in emission)


def _dome_texture(prim, intake: Intake) -> np.ndarray | None:
    """The dome's picture as float32 [h, w, 3], linear, latlong in OpenEXR orientation; None without one."""
    attribute = prim.GetAttribute("inputs:texture:file")
    file = resolve_asset(attribute.Get(intake.time), attribute, intake) if attribute else ""
    if not file:
        return None
    layout = str(prim.GetAttribute("inputs:texture:format").Get(intake.time))
    space = attribute.GetColorSpace()
    key = ("dome", file, layout)
    if key not in intake.cache:
        try:
            with tempfile.TemporaryDirectory(prefix="warp_reflect_") as folder:
                picture = read_image(unpacked(file, folder), space if space in ("raw", "sRGB") else "auto")
        except (OSError, ValueError) as fault:
            intake.bad(prim.GetPath(), f"inputs:texture:file: {' '.join(str(fault).split())}; not used")
            return None
        if picture.cleaned:
            intake.note(
                prim.GetPath(),
                f"inputs:texture:file: {picture.cleaned} samples below 0 or not finite set to 0",
            )
        intake.cache[key] = latlong(picture.rgb, _layout(prim, layout, picture.rgb.shape, intake))
    return intake.cache[key]


def _layout(prim, layout: str, shape: tuple[int, ...], intake: Intake) -> str:
    """The layout of a dome's picture; one that is not given is guessed by the picture's shape."""
    if layout in LAYOUTS:
        return layout
    label = "inputs:texture:format"
    aspect = shape[1] / shape[0]
    found = next((name for a, name in ASPECTS.items() if abs(aspect / a - 1.0) <= ASPECT_ROUNDING), LAYOUTS[0])
    told = f"a picture of {shape[1]} by {shape[0]} pixels is taken as {found}"
    if layout != "automatic":
        intake.bad(prim.GetPath(), f"{label}: got {layout!r}, expected automatic, {', '.join(LAYOUTS)}; {told}")
    elif abs(aspect / 2.0 - 1.0) > ASPECT_ROUNDING:
        intake.note(prim.GetPath(), f"{label}: automatic: {told}")
    return found


def latlong(picture: np.ndarray, layout: str) -> np.ndarray:
    """A dome picture in another of UsdLux' layouts as a latlong map in OpenEXR orientation.

    The middle of every layout looks along +Z, where the latlong's middle looks. "mirroredBall" is a mirror
    ball photographed from there, "angular" has the angle from +Z as its radius; "cubeMapVerticalCross" has
    +Y above and -Y below its middle, -Z at the bottom, upside down.

    Args:
        picture: float32 [h, w, 3].
        layout: One of `LAYOUTS`; "latlong" is returned as it is.
    """
    if layout == "latlong":
        return picture
    side = picture.shape[0] // 4 if layout == "cubeMapVerticalCross" else picture.shape[0] // 2
    rows = int(np.clip(2 * side, 2, RESAMPLED_ROWS_MAX))
    lat = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)[:, None]
    lon = np.pi * (1.0 - 2.0 * (np.arange(2 * rows) + 0.5) / (2 * rows))[None, :]
    x, y, z = np.cos(lat) * np.sin(lon), np.sin(lat) + 0.0 * lon, np.cos(lat) * np.cos(lon)
    height, width = picture.shape[:2]
    if layout == "cubeMapVerticalCross":
        column, row = _cross_coordinates(x, y, z, 1.5 / width, 2.0 / height)
        return _bilinear(picture, column * width / 3.0, row * height / 4.0)
    if layout == "mirroredBall":
        # The ball's normal halves the way between the eye (+Z) and what is seen.
        scale = 1.0 / np.sqrt(np.maximum(2.0 * (1.0 + z), 1.0e-12))
        u, v = x * scale, y * scale
    else:
        radius = np.arccos(np.clip(z, -1.0, 1.0)) / np.pi
        scale = radius / np.maximum(np.hypot(x, y), 1.0e-12)
        u, v = -x * scale, y * scale  # seen from inside: +X is on the left
    return _bilinear(picture, 0.5 * (1.0 + u) * width, 0.5 * (1.0 - v) * height)


def _cross_coordinates(x, y, z, half_column: float, half_row: float) -> tuple[np.ndarray, np.ndarray]:
    """(column in 0..3, row in 0..4) of directions in a vertical cross, unfolded around +Z.

    Half a pixel stays free at every face's border, so that no other face is blended in.
    """
    ax, ay, az = np.abs(x), np.abs(y), np.abs(z)
    faces = [  # condition, cell, right, up, forward
        ((az >= ax) & (az >= ay) & (z > 0), (1, 1), -x, y, az),
        ((az >= ax) & (az >= ay) & (z <= 0), (1, 3), -x, -y, az),
        ((ax > az) & (ax >= ay) & (x > 0), (0, 1), z, y, ax),
        ((ax > az) & (ax >= ay) & (x <= 0), (2, 1), -z, y, ax),
        ((ay > az) & (ay > ax) & (y > 0), (1, 0), -x, -z, ay),
        ((ay > az) & (ay > ax) & (y <= 0), (1, 2), -x, z, ay),
    ]
    column, row = np.zeros_like(x), np.zeros_like(x)
    for where, (cell_x, cell_y), right, up, forward in faces:
        u, v = 0.5 * (1.0 + (right / forward)[where]), 0.5 * (1.0 - (up / forward)[where])
        column[where] = cell_x + np.clip(u, half_column, 1.0 - half_column)
        row[where] = cell_y + np.clip(v, half_row, 1.0 - half_row)
    return column, row


def _bilinear(picture: np.ndarray, column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Picture values at coordinates with pixel centres at +0.5, clamped to the border."""
    height, width = picture.shape[:2]
    column, row = np.clip(column - 0.5, 0.0, width - 1.0), np.clip(row - 0.5, 0.0, height - 1.0)
    c0, r0 = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    c1, r1 = np.minimum(c0 + 1, width - 1), np.minimum(r0 + 1, height - 1)
    s, t = (column - c0)[..., None], (row - r0)[..., None]
    top = (1.0 - s) * picture[r0, c0] + s * picture[r0, c1]
    bottom = (1.0 - s) * picture[r1, c0] + s * picture[r1, c1]
    return ((1.0 - t) * top + t * bottom).astype(np.float32)
