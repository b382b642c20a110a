"""What every reader of this package shares: the time, the notes, and typed values out of attributes."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field

# Set before pxr loads: a crate file cut short by another process then raises instead of killing this one
# (SIGBUS).
os.environ.setdefault("USDC_USE_PREAD", "1")

import numpy as np
from pxr import Tf, Usd

from warp_reflect.scene import Note
from warp_reflect.stage.guard import Limits

# The squares of coordinates, and products of three, must stay finite in float32 (3.4e38).
COORDINATE_MAX = 1.0e12
# det / scale^3 below which a transform flattens what it places and has no usable inverse.
SINGULAR_VOLUME = 1.0e-12
AFFINE_ROW = (0.0, 0.0, 0.0, 1.0)
AFFINE_ROUNDING = 1.0e-12  # of the projective row: thousands of float64 units, far below any projection


class BadPrim(ValueError):
    """What makes a prim unusable: attribute, what it holds, what is expected; the text of a note."""


@dataclass
class Intake:
    """One reading of a stage.

    Attributes:
        time: When attributes are read.
        strict: Whether what would be dropped or repaired with a note is an error instead.
        limits: What is refused for its size.
        notes: What was met so far, each (path, text) once.
        cache: What readings of one stage at several times share.
    """

    time: Usd.TimeCode
    strict: bool = False
    limits: Limits = field(default_factory=Limits)
    notes: list[Note] = field(default_factory=list)
    cache: dict = field(default_factory=dict)
    _seen: set = field(default_factory=set)

    def note(self, path, text: str) -> None:
        """Tell the user something harmless about a prim."""
        key = (str(path), text)
        if key not in self._seen:
            self._seen.add(key)
            self.notes.append(Note(*key))

    def bad(self, path, text: str) -> None:
        """Tell the user what is wrong with a prim.

        Raises:
            ValueError: the same text, where the reading is strict.
        """
        if self.strict:
            raise ValueError(f"<{path}>: {text}")
        self.note(path, text)


def floats(attribute: Usd.Attribute, time: Usd.TimeCode, width: int) -> np.ndarray | None:
    """A float array attribute as float64 [n, width] ([n] for width 1); None where there is no value.

    Raises:
        BadPrim: the value is of another type.
    """
    value = attribute.Get(time) if attribute else None
    if value is None:
        return None
    array = np.array(value)
    shape_ok = array.size == 0 or (array.ndim == 1 if width == 1 else array.ndim == 2 and array.shape[1] == width)
    if array.dtype.kind not in "fiu" or not shape_ok:
        kind = "float" if width == 1 else f"float{width}"
        raise BadPrim(f"{attribute.GetName()}: got {type(value).__name__}, expected {kind}[]")
    return array.astype(np.float64).reshape((-1,) if width == 1 else (-1, width))


def integers(attribute: Usd.Attribute, time: Usd.TimeCode, dtype: type = np.int64) -> np.ndarray | None:
    """An int array attribute as int64 [n], or as `dtype` where that holds its type; None where there is no value.

    Raises:
        BadPrim: the value is of another type.
    """
    value = attribute.Get(time) if attribute else None
    if value is None:
        return None
    array = np.array(value)
    if array.size == 0 and array.dtype.kind in "fiu":
        return np.zeros(0, dtype)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise BadPrim(f"{attribute.GetName()}: got {type(value).__name__}, expected int[]")
    return array.astype(dtype if np.can_cast(array.dtype, dtype) else np.int64, copy=False)


def number(attribute: Usd.Attribute, time: Usd.TimeCode, low: float = -np.inf, open_low: bool = False) -> float:
    """A finite scalar attribute not below `low` (above it: open_low).

    Raises:
        BadPrim: not a number, not finite, or out of range.
    """
    value = attribute.Get(time)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadPrim(f"{attribute.GetName()}: got {value!r}, expected a number")
    value = float(value)
    if not np.isfinite(value) or value < low or (open_low and value == low):
        bound = "a finite number" if low == -np.inf else f"a number {'>' if open_low else '>='} {low:g}"
        raise BadPrim(f"{attribute.GetName()}: got {value:g}, expected {bound}")
    return value


def token(attribute: Usd.Attribute, time: Usd.TimeCode, allowed: tuple[str, ...]) -> str:
    """A token attribute out of a closed set.

    Raises:
        BadPrim: another value.
    """
    value = attribute.Get(time)
    if value not in allowed:
        raise BadPrim(f"{attribute.GetName()}: got {value!r}, expected one of {', '.join(allowed)}")
    return str(value)


def library_message(fault: Tf.ErrorException | UnicodeDecodeError) -> str:
    """The innermost message of the library's error list as one line, without positions in its source.

    A UnicodeDecodeError comes from the library where a name or text of a file is not UTF-8.
    """
    if isinstance(fault, UnicodeDecodeError):
        return f"a text that is not UTF-8: {fault.object.decode(errors='backslashreplace')}"
    try:
        text = str(fault)
    except UnicodeDecodeError as quoted:  # the message quotes such a text
        text = quoted.object.decode(errors="backslashreplace")
    messages = re.findall(r" : '(.*?)'\s*(?:$|\n\s*Error in)", text, flags=re.DOTALL)
    return " ".join((messages[0] if messages else text).split())


def column_matrix(matrix) -> np.ndarray:
    """A Gf.Matrix4d (rows, acts on row vectors) as float64 [4, 4] acting on columns.

    A projective row that is 0, 0, 0, 1 but for rounding, as the inverse of a matrix leaves it, becomes that.
    """
    columns = np.array(matrix, np.float64).T.copy()
    if np.abs(columns[3] - AFFINE_ROW).max() <= AFFINE_ROUNDING:
        columns[3] = AFFINE_ROW
    return columns


def transform_fault(world_from_object: np.ndarray) -> str:
    """What makes a transform unusable, as text for a note; empty if nothing does."""
    if not np.isfinite(world_from_object).all():
        return "transform: got a value that is not finite, expected finite numbers"
    if not np.array_equal(world_from_object[3], AFFINE_ROW):
        return f"transform: got the projective row {world_from_object[3].tolist()}, expected 0, 0, 0, 1"
    if np.abs(world_from_object).max() > COORDINATE_MAX:
        return f"transform: got {np.abs(world_from_object).max():g}, expected at most {COORDINATE_MAX:g}"
    scale = np.linalg.norm(world_from_object[:3, :3], axis=0)
    # Normalised column by column: a thin but invertible scale (1, 1, 1e-9) is legal, a flattening one is not.
    if scale.min() == 0.0 or scale.min() < SINGULAR_VOLUME * scale.max():
        return f"transform: got a singular matrix with scales {scale.tolist()}, expected an invertible one"
    volume = abs(np.linalg.det(world_from_object[:3, :3] / scale))
    if volume < SINGULAR_VOLUME:
        return f"transform: got a singular matrix (determinant {volume:g} of its axes), expected an invertible one"
    return ""
