"""Primvars: values with an interpolation, validated, as arrays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom

from warp_reflect.stage.intake import BadPrim, Intake, floats, integers

UV_TYPES = ("texCoord2f[]", "texCoord2d[]", "texCoord2h[]", "float2[]", "double2[]", "half2[]")
INTERPOLATIONS = ("constant", "uniform", "vertex", "varying", "faceVarying")


@dataclass
class CornerAttribute:
    """A primvar: `values[index[element]]`, where `interpolation` says what an element is."""

    values: np.ndarray  # float64 [n, width]
    index: np.ndarray | None  # int64 [element_count]; None: element i is value i
    interpolation: str

    @property
    def element_count(self) -> int:
        """How many elements (faces, points or corners) it has values for."""
        return len(self.values) if self.index is None else len(self.index)

    def flat(self) -> np.ndarray:
        """One value per element, float64 [element_count, width]."""
        return self.values if self.index is None else self.values[self.index]


def read_primvar(prim, name: str, width: int, intake: Intake) -> CornerAttribute | None:
    """A primvar of the prim, or inherited where constant; None (with a note) where it is malformed."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    label = f"primvars:{name}"
    try:
        attribute = primvar.GetAttr()
        value = attribute.Get(intake.time)
        if value is None:
            return None
        if np.ndim(value) == (1 if width > 1 else 0):
            # A single value where an array is expected (seen in real files) can only be constant.
            values = np.array(value, np.float64).reshape(1, width)
        else:
            values = floats(attribute, intake.time, width).reshape(-1, width)
        index = integers(primvar.GetIndicesAttr(), intake.time) if primvar.IsIndexed() else None
    except (BadPrim, ValueError, TypeError) as fault:
        intake.bad(prim.GetPath(), f"{label}: {fault}; not used")
        return None
    interpolation = str(primvar.GetInterpolation())
    if interpolation not in INTERPOLATIONS:
        intake.bad(
            prim.GetPath(),
            f"{label}: got interpolation {interpolation!r}, expected a UsdGeomPrimvar one; not used",
        )
        return None
    if not len(values):
        return None
    if index is not None:
        wrong = (index < 0) | (index >= len(values))
        if not len(index) or wrong.any():
            first = int(np.argmax(wrong)) if len(index) else 0
            got = index[first] if len(index) else "nothing"
            intake.bad(
                prim.GetPath(),
                f"{label}:indices[{first}]: got {got}, expected 0 to {len(values) - 1}; not used",
            )
            return None
    if name == "normals":
        return CornerAttribute(values, index, interpolation)
    if not np.isfinite(values).all():
        first = int(np.argmin(np.isfinite(values).all(axis=1)))
        intake.bad(prim.GetPath(), f"{label}[{first}]: got {tuple(values[first])}, expected finite numbers; not used")
        return None
    return CornerAttribute(values, index, interpolation)


def display_color(prim, intake: Intake) -> tuple[tuple[float, float, float] | None, float]:
    """(mean colour, mean opacity) of primvars displayColor and displayOpacity; None without a colour."""
    color = read_primvar(prim, "displayColor", 3, intake)
    opacity = read_primvar(prim, "displayOpacity", 1, intake)
    alpha = 1.0
    if opacity is not None and len(opacity.values):
        alpha = float(np.clip(opacity.values.mean(), 0.0, 1.0))
        if opacity.interpolation != "constant" and np.ptp(opacity.values) > 0.0:
            intake.note(prim.GetPath(), f"primvars:displayOpacity: varies over the mesh; its mean {alpha:g} is used")
    if color is None:
        return None, alpha
    used = color.values if color.index is None else color.values[color.index]
    mean = used.mean(axis=0) if color.interpolation != "constant" else used[0]
    return tuple(float(v) for v in mean), alpha


def read_uvs(prim, name: str, intake: Intake) -> tuple[CornerAttribute | None, str]:
    """(texture coordinates, label): the named primvar, else the only two-component one the prim has."""
    found = read_primvar(prim, name, 2, intake)
    if found is not None:
        return found, f"primvars:{name}"
    others = [
        primvar.GetPrimvarName()
        for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues()
        if str(primvar.GetTypeName()) in UV_TYPES
    ]
    if len(others) == 1:
        intake.note(prim.GetPath(), f"primvars:{name}: no such primvar; {others[0]}, the only one, is used")
        return read_primvar(prim, others[0], 2, intake), f"primvars:{others[0]}"
    got = f"{len(others)} others" if others else "no other"
    intake.note(prim.GetPath(), f"primvars:{name}: no such primvar and {got}; its textures are not used")
    return None, f"primvars:{name}"
