"""The package's own API schemas on a stage: mirrors and reference environment maps.

The schemas are codeless (`plugin/`). What is authored is read also where the plugin is not registered: names of API
schemas and attributes are composed all the same, only fallback values are missing.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
from pxr import Plug, Tf

from warp_reflect.scene import EnvironmentMapData, MirrorData
from warp_reflect.stage.intake import BadPrim, Intake, number, transform_fault
from warp_reflect.stage.reflectors import Choice
from warp_reflect.stage.textures import resolve_asset

PLUGIN = Path(__file__).with_name("plugin")
MIRROR_API = "WarpReflectMirrorAPI"
ENVIRONMENT_MAP_API = "WarpReflectEnvironmentMapAPI"
NAMESPACE = "warp_reflect"
REFLECTS = "collection:reflects"  # on a mirror: what is seen in it


def register() -> None:
    """Make the schemas known to the USD library, for other tools in this process; without effect after the first time.

    A process that has opened stages before keeps the schemas it knew then.
    """
    with contextlib.suppress(Tf.ErrorException):  # another version of them is known already
        Plug.Registry().RegisterPlugins(str(PLUGIN))


def applied(prim) -> tuple[str, ...]:
    """Names of the API schemas on a prim, known to the library or not."""
    return tuple(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def read_mirror(prim, intake: Intake, collections: dict[str, tuple[str, ...]]) -> Choice | None:
    """What a prim with `MIRROR_API` asks for, but its baked maps (`baked.py`); None (with a note) where it cannot be used.

    Args:
        prim: The prim.
        intake: The reading.
        collections: Member paths by "/Prim.collection:name".
    """
    try:
        include = _value(prim, "include", intake)
        if include is not None and not isinstance(include, bool):
            raise BadPrim(f"{NAMESPACE}:include: got {include!r}, expected a bool")
        choice = Choice(
            MirrorData(
                str(prim.GetPath()),
                include is not False,
                str(_value(prim, "technique", intake) or "auto"),
                collections.get(f"{prim.GetPath()}.{REFLECTS}"),
            ),
            *(_share(prim, name, intake) for name in ("metallic", "roughness")),
            _color(prim, intake),
        )
    except BadPrim as fault:
        intake.bad(prim.GetPath(), f"{fault}; {MIRROR_API} not used")
        return None
    return choice


def read_environment_map(prim, world_from_map: np.ndarray, intake: Intake) -> EnvironmentMapData:
    """A prim with `ENVIRONMENT_MAP_API`.

    Raises:
        BadPrim: a transform that cannot be used.
    """
    fault = transform_fault(world_from_map)
    if fault:
        raise BadPrim(fault)
    attribute, layout = _attribute(prim, "map"), str(_value(prim, "layout", intake) or "")
    file = resolve_asset(attribute.Get(intake.time), attribute, intake) if attribute else ""
    return EnvironmentMapData(str(prim.GetPath()), world_from_map, file, layout)


def _attribute(prim, name: str):
    return prim.GetAttribute(f"{NAMESPACE}:{name}")


def _value(prim, name: str, intake: Intake):
    attribute = _attribute(prim, name)
    return attribute.Get(intake.time) if attribute else None


def _share(prim, name: str, intake: Intake) -> float | None:
    """A number from 0 to 1; None where it is not authored."""
    if _value(prim, name, intake) is None:
        return None
    value = number(_attribute(prim, name), intake.time, 0.0)
    if value > 1.0:
        raise BadPrim(f"{NAMESPACE}:{name}: got {value:g}, expected 0 to 1")
    return value


def _color(prim, intake: Intake) -> tuple[float, float, float] | None:
    value = _value(prim, "color", intake)
    if value is None:
        return None
    color = np.array(value)
    if color.shape != (3,) or color.dtype.kind not in "fiu" or not ((color >= 0.0) & (color <= 1.0)).all():
        raise BadPrim(f"{NAMESPACE}:color: got {value}, expected 3 numbers from 0 to 1")
    return tuple(float(v) for v in color)
