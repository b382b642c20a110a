"""Mirrors by choice: the word of the user, on the stage or by name, over what the materials say."""

from __future__ import annotations

import dataclasses
import difflib
import re
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

from warp_reflect.scene import MaterialData, MirrorData, SceneData, reflectance
from warp_reflect.settings import Settings

# A metal as a mirror's maker would have it: silver-like, without a tint of its own.
NEUTRAL_METALLIC, NEUTRAL_ROUGHNESS, NEUTRAL_COLOR = 1.0, 0.0, (0.9, 0.9, 0.9)
KEEP = "keep"  # as a colour: the material's own
OPTIONS = ("metallic", "roughness", "color", "technique")
CLEARCOAT_MIN = 0.5  # a coat from here on is a mirror, whatever lies below it
_OPTION = re.compile(r":(\w+)=([^:]*)$")


@dataclass(frozen=True)
class Choice:
    """A mirror the user chose, and the material it gets.

    Attributes:
        mirror: Where it was asked for, and what else was.
        metallic: None: the material's own where that is a mirror already, else `NEUTRAL_METALLIC`.
        roughness: Likewise.
        color: Linear Rec.709; `KEEP`: the material's own; None: likewise.
    """

    mirror: MirrorData
    metallic: float | None = None
    roughness: float | None = None
    color: tuple[float, float, float] | str | None = None


@dataclass
class Choices:
    """All mirrors that were chosen for one reading.

    Attributes:
        patterns: By name; the last that matches decides, before any prim.
        prims: By the path of the prim that carries the schema; the nearest above decides.
        collections: Member paths by "/Prim.collection:name".
        matched: Patterns that named something so far.
    """

    patterns: dict[str, Choice] = field(default_factory=dict)
    prims: dict[str, Choice] = field(default_factory=dict)
    collections: dict[str, tuple[str, ...]] = field(default_factory=dict)
    matched: set[str] = field(default_factory=set)

    def of(self, names: tuple[str, ...]) -> Choice | None:
        """What was chosen for the part that has these names, `part_names`; None: nothing."""
        chosen = None
        for pattern, choice in self.patterns.items():
            if matches(pattern, names, self.collections):
                self.matched.add(pattern)
                chosen = choice
        return nearest_above(names, self.prims) if chosen is None else chosen


def nearest_above(names: tuple[str, ...], asked: dict):
    """What is asked for at the nearest prim above any of the names, or at one of them; None: nothing."""
    above = {path for name in names for path in _ancestors(name)} & asked.keys() if asked else ()
    return asked[max(above, key=lambda path: path.count("/"))] if above else None


def parse_patterns(texts: tuple[str, ...] | str) -> dict[str, Choice]:
    """Patterns with what their mirrors shall be: "PATTERN[:metallic=M][:roughness=R][:color=C][:technique=T]".

    A pattern is the path or glob of a prim (with all below it), of a GeomSubset, of a point instance or of a
    material; a name or glob without "/" (any prim of that name); or a collection, "/Prim.collection:name". It becomes
    a mirror of metallic 1, roughness 0 and a neutral grey of 0.9, but for the options. A colour is one number or
    three, linear Rec.709, "0.9,0.6,0.5", or "keep", the material's own, texture included.

    Raises:
        ValueError: an option that is unknown or has an impossible value.
    """
    found = {}
    for text in (texts,) if isinstance(texts, str) else texts:
        pattern, options = text, {}
        while option := _OPTION.search(pattern):
            name, value = option.groups()
            if name not in OPTIONS:
                near = difflib.get_close_matches(name, OPTIONS, n=3, cutoff=0.3) or OPTIONS
                raise ValueError(f"reflector '{text}': unknown option '{name}'; nearest: {', '.join(near)}")
            options.setdefault(name, value)
            pattern = pattern[: option.start()]
        color = options.get("color", "")
        found[pattern] = Choice(
            MirrorData(pattern, technique=options.get("technique", "auto")),
            *(
                _numbers(text, name, options[name], 1)[0] if name in options else neutral
                for name, neutral in (("metallic", NEUTRAL_METALLIC), ("roughness", NEUTRAL_ROUGHNESS))
            ),
            KEEP if color == KEEP else _numbers(text, "color", color, 3) if color else NEUTRAL_COLOR,
        )
    return found


def _numbers(text: str, name: str, value: str, width: int) -> tuple[float, ...]:
    try:
        numbers = [float(piece) for piece in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, width) or not all(0.0 <= each <= 1.0 for each in numbers):
        expected = "a number from 0 to 1" if width == 1 else f"one or {width} numbers from 0 to 1, or {KEEP}"
        raise ValueError(f"reflector '{text}': {name}: got '{value}', expected {expected}")
    return tuple(numbers) if len(numbers) == width else (numbers[0],) * width


def choose_reflectors(data: SceneData, choices: Choices) -> int:
    """Give what was chosen a reflective material; the stage itself is not touched.

    Args:
        data: Changed in place: new materials are appended, instances point to them.
        choices: What was chosen.

    Returns:
        Parts (prim instances times material subsets) changed.

    Raises:
        ValueError: a pattern that names nothing that is drawn; with the nearest names.
    """
    replaced: dict[tuple[int, int], int] = {}
    changed = 0
    for instance in data.instances:
        parts = data.meshes[instance.mesh].parts
        materials = list(instance.materials)
        for k, index in enumerate(instance.materials):
            subset = parts[k].subset if parts else ""
            choice = choices.of(part_names(instance.prim_path, subset, instance.instance, data.materials[index].path))
            if choice is None:
                continue
            key = index, id(choice)
            if key not in replaced:
                replaced[key] = len(data.materials)
                data.materials.append(mirrored(data.materials[index], choice))
            materials[k] = replaced[key]
            changed += 1
        instance.materials = tuple(materials)
    unused = [pattern for pattern in choices.patterns if pattern not in choices.matched]
    if unused:
        pattern = min(unused)
        known = {name for i in data.instances for name in (i.prim_path, i.prim_path.rpartition("/")[2])}
        known.update(m.path for m in data.materials if m.path)
        near = difflib.get_close_matches(pattern, sorted(known), n=3, cutoff=0.3)
        raise ValueError(
            f"reflector '{pattern}' names no drawn prim, subset, material or collection"
            + (f"; nearest: {', '.join(near)}" if near else "")
        )
    return changed


def part_names(prim_path: str, subset: str, instance: str, material: str) -> tuple[str, ...]:
    """Every path a pattern may name a part by."""
    names = [prim_path]
    if subset:
        names.append(f"{prim_path}/{subset}")
    names += [f"/{piece.lstrip('/')}" for piece in instance.split("/") if ":" in piece] if instance else []
    if instance:
        names.append(instance)
    if material:
        names.append(material)
    return tuple(names)


def matches(pattern: str, names: tuple[str, ...], collections: dict[str, tuple[str, ...]]) -> bool:
    """Whether a pattern names one of the paths, or something above it."""
    if ".collection:" in pattern:
        members = collections.get(pattern, ())
        return any(_below(member, name) for member in members for name in names)
    if "/" not in pattern:
        return any(fnmatchcase(piece, pattern) for name in names for piece in name.split("/"))
    pattern = pattern.rstrip("/") or "/"
    return any(_below(pattern, name) or fnmatchcase(name, pattern + "/*") for name in names)


def _below(path: str, name: str) -> bool:
    return fnmatchcase(name, path) or name.startswith(f"{path}/")


def _ancestors(path: str) -> list[str]:
    """A path and all paths above it."""
    found = [path]
    while path := path.rpartition("/")[0]:
        found.append(path)
    return found


def mirrored(material: MaterialData, choice: Choice) -> MaterialData:
    """The material that a choice makes of another: constants in the metallic workflow where it says so."""
    if not choice.mirror.include:
        return dataclasses.replace(material, mirror=choice.mirror)
    values = {"metallic": choice.metallic, "roughness": choice.roughness, "base_color": choice.color}
    if not may_reflect(material):
        neutral = {"metallic": NEUTRAL_METALLIC, "roughness": NEUTRAL_ROUGHNESS, "base_color": NEUTRAL_COLOR}
        values = {name: neutral[name] if value is None else value for name, value in values.items()}
        values["transmission"] = 0.0
    if material.opacity == 0.0:
        values["opacity"] = 1.0
    values = {name: value for name, value in values.items() if value is not None and value != KEEP}
    if "base_color" in values:
        values["uses_vertex_color"] = False
    if "metallic" in values or "base_color" in values:
        values["specular_workflow"] = False
    textures = {name: texture for name, texture in material.textures.items() if name not in values}
    return dataclasses.replace(material, **values, textures=textures, mirror=choice.mirror)


def may_reflect(material: MaterialData) -> bool:
    """Whether a material can be a mirror by the default settings; a textured value counts as its best."""
    defaults = Settings()
    roughness = 0.0 if "roughness" in material.textures else material.roughness
    if material.clearcoat >= CLEARCOAT_MIN:
        return True
    best = dataclasses.replace(material, metallic=1.0 if "metallic" in material.textures else material.metallic)
    if "base_color" in material.textures:
        best = dataclasses.replace(best, base_color=(1.0, 1.0, 1.0))
    weight = float(reflectance(best)[0].max())
    least = defaults.reflector_min_weight * (1.0 - material.transmission)
    return roughness <= defaults.reflector_max_roughness and weight >= least
