"""Shading networks to what this package can look up: a constant, one picture or one primvar, scaled and shifted.

A node that keeps that form is folded into it (`_NODES`); what does not is `Unmapped`, with the node's identifier.
Source of the nodes' meaning: the MaterialX specification 1.39, "Standard Nodes"; UsdPreviewSurface specification.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pxr import UsdShade

from warp_reflect.stage.intake import Intake
from warp_reflect.stage.textures import is_texture, value_of

HOPS_MAX = 16  # nodes followed from a surface input; longer chains (and cycles) are not evaluated
LETTERS = "rgba"
WIDTHS = {"float": 1, "integer": 1, "boolean": 1, "vector2": 2, "color3": 3, "vector3": 3, "color4": 4, "vector4": 4}
REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)


class Unmapped(ValueError):
    """A node that cannot be brought into the form of a `Signal`; the text says which and why."""


@dataclass(frozen=True)
class Signal:
    """Components that are scale * source + bias, each of one component of the same source.

    Attributes:
        scale, bias: float64 [n]; of a constant the scale is 0.
        components: Per component which one of the source, 0 to 3.
        picture: The picture node that is the source, or None.
        primvar: Name of the primvar that is the source, or "".
        fallback: The source where it has no value, float64 [4], or None.
        tangent: Whether it is a vector in tangent space made by a normal map node.
        notes: What was simplified on the way.
    """

    scale: np.ndarray
    bias: np.ndarray
    components: tuple[int, ...]
    picture: UsdShade.Shader | None = None
    primvar: str = ""
    fallback: np.ndarray | None = None
    tangent: bool = False
    notes: tuple[str, ...] = ()

    @property
    def width(self) -> int:
        """Number of components."""
        return len(self.bias)

    @property
    def is_constant(self) -> bool:
        """Whether it has no source."""
        return self.picture is None and not self.primvar

    def same_source(self, other: Signal) -> bool:
        """Whether both have one and the same source."""
        if self.is_constant or other.is_constant or self.primvar != other.primvar:
            return False
        mine, theirs = (s.picture.GetPath() if s.picture else None for s in (self, other))
        return mine == theirs


def constant(values) -> Signal:
    """A signal without a source."""
    bias = np.atleast_1d(np.asarray(values, np.float64))
    return Signal(np.zeros(len(bias)), bias, (0,) * len(bias))


def of_primvar(name: str, width: int, fallback=None) -> Signal:
    """A signal that is a primvar."""
    padded = None if fallback is None else _padded(np.atleast_1d(np.asarray(fallback, np.float64)))
    return Signal(np.ones(width), np.zeros(width), tuple(range(width)), primvar=name, fallback=padded)


def evaluate(node: UsdShade.Shader, name: str, intake: Intake, hops: int = HOPS_MAX) -> Signal | None:
    """What drives an input; None where nothing does.

    Raises:
        Unmapped: a node that is not understood, or one whose result has another form.
    """
    found = node.GetInput(name)
    sources = UsdShade.Utils.GetValueProducingAttributes(found) if found else ()
    if not sources:
        return None
    attribute = sources[0]
    if not UsdShade.Output.IsOutput(attribute):
        value = attribute.Get(intake.time)
        if value is None:
            return None
        array = np.asarray(value)
        if array.dtype.kind not in "fiub" or array.ndim > 1 or not 1 <= array.size <= 4:
            raise Unmapped(f"got {value}, expected a number or a colour")
        return constant(array.astype(np.float64))
    if hops == 0:
        raise Unmapped(f"driven by a cycle, or by more than {HOPS_MAX} nodes")
    source = UsdShade.Shader(attribute.GetPrim())
    identifier = (source.GetIdAttr().Get() if source else None) or ""
    return _evaluate_node(source, identifier, UsdShade.Output(attribute).GetBaseName(), intake, hops - 1)


def _evaluate_node(node: UsdShade.Shader, identifier: str, output: str, intake: Intake, hops: int) -> Signal:
    if is_texture(identifier):
        return _picture(node, identifier, output)
    if identifier.startswith(("UsdPrimvarReader", "ND_UsdPrimvarReader", "ND_geompropvalue", "ND_geomcolor")):
        return _primvar(node, identifier, intake)
    category = identifier.removeprefix("ND_").partition("_")[0] if identifier.startswith("ND_") else ""
    rule = _NODES.get(category)
    if rule is None:
        raise Unmapped(f"driven by {identifier or 'an unknown node'}")

    def read(name: str, default=0.0) -> Signal:
        signal = evaluate(node, name, intake, hops)
        return constant(default) if signal is None else signal

    def text(name: str, default: str = "") -> str:
        found = value_of(node, name, intake)
        return default if found is None else str(found)

    try:
        return rule(_Inputs(read, text, identifier, output))
    except Unmapped as fault:
        # The first node that does not fit is named, not what merely passes it on.
        raise Unmapped(str(fault) if "driven by" in str(fault) else f"driven by {identifier}: {fault}") from None


@dataclass(frozen=True)
class _Inputs:
    """A node's inputs, and which of its outputs is asked for."""

    read: Callable[..., Signal]
    text: Callable[..., str]
    identifier: str
    output: str

    @property
    def width(self) -> int:
        """Components of the result, from the end of the identifier; 0: it does not say."""
        return WIDTHS.get(self.identifier.rpartition("_")[2].removesuffix("FA"), 0)

    def number(self, name: str, default) -> np.ndarray:
        """The value of an input that must be constant.

        Raises:
            Unmapped: it is not.
        """
        signal = self.read(name, default)
        if not signal.is_constant:
            raise Unmapped(f"its input {name} is not constant")
        return signal.bias


def _picture(node: UsdShade.Shader, identifier: str, output: str) -> Signal:
    if len(output) == 1 and output in LETTERS:
        components = (LETTERS.index(output),)
    elif "UsdUVTexture" in identifier:
        components = (0, 1, 2, 3) if output == "rgba" else (0, 1, 2)
    else:
        components = tuple(range(WIDTHS.get(identifier.rpartition("_")[2], 3)))
    return Signal(np.ones(len(components)), np.zeros(len(components)), components, picture=node)


def _primvar(node: UsdShade.Shader, identifier: str, intake: Intake) -> Signal:
    if "geomcolor" in identifier:
        return of_primvar("displayColor", 3)
    name = value_of(node, "geomprop" if "geompropvalue" in identifier else "varname", intake)
    fallback = value_of(node, "default" if identifier.startswith("ND_geom") else "fallback", intake)
    kind = identifier.rpartition("_")[2]
    width = WIDTHS.get(kind) or {"float2": 2, "float3": 3, "float4": 4, "normal": 3, "point": 3, "vector": 3}.get(
        kind, 1
    )
    if not name:
        return constant(0.0 if fallback is None else fallback)
    return of_primvar(str(name), width, fallback)


def affine(signal: Signal, scale, bias=0.0) -> Signal:
    """The signal times a scale plus a bias, each a number or one per component; a single component is repeated as needed."""
    count = max(signal.width, np.size(scale), np.size(bias))
    wide = widened(signal, count)
    scale, bias = (np.broadcast_to(_cut(np.atleast_1d(x), wide.width), (wide.width,)) for x in (scale, bias))
    return dataclasses.replace(wide, scale=wide.scale * scale, bias=wide.bias * scale + bias)


def widened(signal: Signal, width: int) -> Signal:
    """The signal with as many components: one is repeated, more are cut, missing ones are 1 (an alpha)."""
    have = signal.width
    if have == width:
        return signal
    if have == 1:
        pick = [0] * width
    elif width < have:
        pick = list(range(width))
    else:
        extra = np.ones(width - have)
        return dataclasses.replace(
            signal,
            scale=np.concatenate([signal.scale, 0.0 * extra]),
            bias=np.concatenate([signal.bias, extra]),
            components=signal.components + (0,) * (width - have),
        )
    return picked(signal, pick)


def picked(signal: Signal, pick) -> Signal:
    """The named components."""
    if max(pick) >= signal.width:
        raise Unmapped(f"component {max(pick)} of {signal.width} is asked for")
    components = tuple(signal.components[k] for k in pick)
    return dataclasses.replace(signal, scale=signal.scale[pick], bias=signal.bias[pick], components=components)


def product(a: Signal, b: Signal) -> Signal:
    """The product of two signals. Of two sources only the first is kept, with a note."""
    if a.is_constant and not b.is_constant:
        a, b = b, a
    if b.is_constant:
        return affine(a, b.bias)
    if b.width > a.width:
        a, b = b, a
    return dataclasses.replace(a, notes=(*a.notes, "a product of two pictures or primvars: only one of them is used"))


def total(a: Signal, b: Signal) -> Signal:
    """The sum of two signals.

    Raises:
        Unmapped: two different sources.
    """
    if a.is_constant and not b.is_constant:
        a, b = b, a
    if b.is_constant:
        return affine(a, 1.0, b.bias)
    width = max(a.width, b.width)
    a, b = widened(a, width), widened(b, width)
    if not a.same_source(b) or a.components != b.components:
        raise Unmapped("a sum of two pictures or primvars")
    return dataclasses.replace(a, scale=a.scale + b.scale, bias=a.bias + b.bias, notes=a.notes + b.notes)


def _cut(values: np.ndarray, width: int) -> np.ndarray:
    return values if len(values) == 1 else values[:width]


def _padded(values: np.ndarray) -> np.ndarray:
    """Four components: a number is grey, a missing alpha is 1."""
    if len(values) == 1:
        values = np.repeat(values, 3)
    return np.concatenate([values, (0.0, 0.0, 0.0, 1.0)[len(values) :]])


def _only_constants(rule: Callable) -> Callable:
    """A node that is evaluated where its inputs in, in1 and in2 are constant, and mapped nowhere else."""

    def apply(node: _Inputs) -> Signal:
        signals = [node.read(name, np.nan) for name in ("in", "in1", "in2")]
        if any(not signal.is_constant for signal in signals):
            raise Unmapped("its inputs are not constant")
        one, first, second = (signal.bias for signal in signals)
        with np.errstate(all="ignore"):
            return constant(rule(first if np.isnan(one).all() else one, second))

    return apply


def _divide(node: _Inputs) -> Signal:
    divisor = node.number("in2", 1.0)
    if (divisor == 0.0).any():
        raise Unmapped("a division by 0")
    return affine(node.read("in1"), 1.0 / divisor)


def _mix(node: _Inputs) -> Signal:
    front, back, share = node.read("fg"), node.read("bg"), node.read("mix")
    if share.is_constant:
        if (share.bias == 1.0).all():
            return front
        if (share.bias == 0.0).all():
            return back
        return total(affine(front, share.bias), affine(back, 1.0 - share.bias))
    if front.is_constant and back.is_constant:
        return total(affine(share, front.bias - back.bias), back)
    raise Unmapped("a mixture by a picture of what is not constant")


def _remap(node: _Inputs) -> Signal:
    low, high = node.number("inlow", 0.0), node.number("inhigh", 1.0)
    if (low == high).any():
        raise Unmapped("an empty range")
    if "range" in node.identifier and (node.number("gamma", 1.0) != 1.0).any():
        raise Unmapped("a gamma")
    to_low = node.number("outlow", 0.0)
    slope = (node.number("outhigh", 1.0) - to_low) / (high - low)
    return affine(node.read("in"), slope, to_low - slope * low)


def _contrast(node: _Inputs) -> Signal:
    amount, pivot = node.number("amount", 1.0), node.number("pivot", 0.5)
    return affine(node.read("in"), amount, pivot * (1.0 - amount))


def _clamp(node: _Inputs) -> Signal:
    signal, low, high = node.read("in"), node.number("low", 0.0), node.number("high", 1.0)
    if signal.is_constant:
        return constant(np.clip(*np.broadcast_arrays(signal.bias, low, high)))
    if (low > 0.0).any() or (high < 1.0).any():
        raise Unmapped("a range narrower than 0 to 1")
    return signal  # parameters are clipped where they are used


def _invert(node: _Inputs) -> Signal:
    return affine(node.read("in"), -1.0, node.number("amount", 1.0))


def _convert(node: _Inputs) -> Signal:
    return widened(node.read("in"), node.width or 1)


def _extract(node: _Inputs) -> Signal:
    return picked(node.read("in"), [int(node.number("index", 0)[0])])


def _separate(node: _Inputs) -> Signal:
    letter = node.output.removeprefix("out")
    names = "xyzw" if letter and letter in "xyzw" else LETTERS
    if not letter or letter not in names:
        raise Unmapped(f"its output {node.output}")
    return picked(node.read("in"), [names.index(letter)])


def _swizzle(node: _Inputs) -> Signal:
    signal = node.read("in")
    letters = node.text("channels")
    pick = ["rgba".find(c) if c in "rgba" else "xyzw".find(c) for c in letters]
    if not pick or min(pick) < 0:
        raise Unmapped(f"channels {letters!r}")
    return picked(signal, pick)


def _combine(node: _Inputs) -> Signal:
    count = int(node.identifier.removeprefix("ND_combine")[:1] or 0)
    parts = [node.read(f"in{k + 1}") for k in range(count)]
    varying = [part for part in parts if not part.is_constant]
    if any(not part.same_source(varying[0]) for part in varying):
        raise Unmapped("components of several pictures or primvars")
    base = varying[0] if varying else constant(0.0)
    return dataclasses.replace(
        base,
        scale=np.concatenate([part.scale for part in parts]),
        bias=np.concatenate([part.bias for part in parts]),
        components=sum((part.components for part in parts), ()),
    )


def _normalmap(node: _Inputs) -> Signal:
    if node.text("space", "tangent") != "tangent":
        raise Unmapped(f"space {node.text('space')}")
    sideways = node.number("scale", 1.0)
    scale = 2.0 * np.append(np.broadcast_to(_cut(sideways, 2), (2,)), 1.0)
    signal = affine(widened(node.read("in", (0.5, 0.5, 1.0)), 3), scale, -0.5 * scale)
    return dataclasses.replace(signal, tangent=True)


def _switch(node: _Inputs) -> Signal:
    return node.read(f"in{int(node.number('which', 0)[0]) + 1}")


def _luminance(node: _Inputs) -> Signal:
    color = node.number("in", 0.0)
    return constant(np.repeat(color[:3] @ REC709_LUMINANCE if len(color) >= 3 else color[0], 3))


_NODES: dict[str, Callable[[_Inputs], Signal]] = {
    "constant": lambda node: node.read("value"),
    "dot": lambda node: node.read("in"),
    "convert": _convert,
    "multiply": lambda node: product(node.read("in1"), node.read("in2", 1.0)),
    "divide": _divide,
    "add": lambda node: total(node.read("in1"), node.read("in2")),
    "subtract": lambda node: total(node.read("in1"), affine(node.read("in2"), -1.0)),
    "mix": _mix,
    "invert": _invert,
    "remap": _remap,
    "range": _remap,
    "contrast": _contrast,
    "clamp": _clamp,
    "extract": _extract,
    "separate2": _separate,
    "separate3": _separate,
    "separate4": _separate,
    "swizzle": _swizzle,
    "combine2": _combine,
    "combine3": _combine,
    "combine4": _combine,
    "normalmap": _normalmap,
    "switch": _switch,
    "luminance": _luminance,
    "power": _only_constants(lambda a, b: np.power(a, 1.0 if np.isnan(b).all() else b)),
    "min": _only_constants(np.minimum),
    "max": _only_constants(np.maximum),
    "absval": _only_constants(lambda a, _: np.abs(a)),
    "sqrt": _only_constants(lambda a, _: np.sqrt(a)),
    "floor": _only_constants(lambda a, _: np.floor(a)),
    "normalize": lambda node: node.read("in"),  # of a normal, which is made a unit vector where it is used
}
