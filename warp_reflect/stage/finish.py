"""What a stage asks of surfaces beyond their materials (`WarpReflectFinishAPI`): interfaces, fades, frost, waves."""

from __future__ import annotations

import dataclasses

import numpy as np

from warp_reflect.scene import FinishData, SceneData
from warp_reflect.stage.intake import BadPrim, Intake, number, token
from warp_reflect.stage.reflectors import nearest_above, part_names

FINISH_API = "WarpReflectFinishAPI"
NAMESPACE = "warp_reflect"
INTERFACES = ("auto", "thin", "solid")
# Attribute, field, least value (with the end: closed), greatest.
NUMBERS = (
    ("fadeDistance", "fade_distance", 0.0, False, np.inf),
    ("frost", "frost", 0.0, False, 45.0),
    ("frostDistance", "frost_distance", 0.0, False, np.inf),
    ("waveSlope", "wave_slope", 0.0, False, 0.5),
    ("waveLength", "wave_length", 0.0, True, np.inf),
    ("waveSpeed", "wave_speed", 0.0, False, np.inf),
)
COLORS = (("fadeColor", "fade_color"), ("frostColor", "frost_color"))


def read_finish(prim, intake: Intake) -> FinishData | None:
    """What a prim with `FINISH_API` asks for; None (with a note) where it cannot be used.

    Args:
        prim: The prim.
        intake: The reading.
    """
    values: dict = {}
    try:
        for name, field, least, open_low, most in NUMBERS:
            attribute = prim.GetAttribute(f"{NAMESPACE}:{name}")
            if attribute and attribute.Get(intake.time) is not None:
                values[field] = number(attribute, intake.time, least, open_low)
                if values[field] > most:
                    raise BadPrim(f"{NAMESPACE}:{name}: got {values[field]:g}, expected at most {most:g}")
        interface = prim.GetAttribute(f"{NAMESPACE}:interface")
        if interface and interface.Get(intake.time) is not None:
            values["interface"] = token(interface, intake.time, INTERFACES)
        for name, field in COLORS:
            color = prim.GetAttribute(f"{NAMESPACE}:{name}")
            if color and color.Get(intake.time) is not None:
                got = np.array(color.Get(intake.time))
                if got.shape != (3,) or got.dtype.kind not in "fiu" or not (np.isfinite(got) & (got >= 0.0)).all():
                    raise BadPrim(f"{NAMESPACE}:{name}: got {color.Get(intake.time)}, expected 3 numbers from 0 on")
                values[field] = tuple(float(v) for v in got)
    except BadPrim as fault:
        intake.bad(prim.GetPath(), f"{fault}; {FINISH_API} not used")
        return None
    return FinishData(str(prim.GetPath()), **values)


def give_finishes(data: SceneData, asked: dict[str, FinishData]) -> None:
    """Give the materials of what is drawn the finishes that are asked for above it.

    Args:
        data: Changed in place: new materials are appended, instances point to them.
        asked: By the path of the prim that asks.
    """
    if not asked:
        return
    replaced: dict[tuple[int, str], int] = {}
    for instance in data.instances:
        parts = data.meshes[instance.mesh].parts
        materials = list(instance.materials)
        for k, index in enumerate(instance.materials):
            subset = parts[k].subset if parts else ""
            names = part_names(instance.prim_path, subset, instance.instance, data.materials[index].path)
            finish = nearest_above(names, asked)
            if finish is None:
                continue
            key = index, finish.path
            if key not in replaced:
                replaced[key] = len(data.materials)
                data.materials.append(dataclasses.replace(data.materials[index], finish=finish))
            materials[k] = replaced[key]
        instance.materials = tuple(materials)
