"""What `warp-reflect bake` has authored on mirrors: the attributes, and reading the maps they name.

The attributes stand on the drawn prim or its GeomSubset, with or without the package's API schema: a baked map changes
nothing of what is a mirror.
"""

from __future__ import annotations

from pxr import Sdf

from warp_reflect.baked_maps import LAYOUT, BakedMap, read_maps
from warp_reflect.stage.intake import Intake
from warp_reflect.stage.textures import resolve_asset

MAP = "warp_reflect:map"
LAYOUT_ATTRIBUTE = "warp_reflect:layout"
RESOLUTION = "warp_reflect:mapResolution"
GEOMETRY = "warp_reflect:mapGeometry"
UNIT_FRAME = "warp_reflect:unitFromBody"


def read_baked_maps(drawn: list, intake: Intake) -> dict[str, tuple[BakedMap, ...]]:
    """The baked maps of the prims that are drawn, by the path of the prim or GeomSubset that carries them.

    What cannot be used is noted; its map will be drawn.

    Args:
        drawn: Prims, as `Walk.drawn`.
        intake: The reading; its cache keeps what was read.
    """
    found = {}
    for prim in drawn:
        subsets = [child for child in prim.GetChildren() if child.GetTypeName() == "GeomSubset"]
        for target in (prim, *subsets):
            attribute = target.GetAttribute(MAP)
            if not attribute or not attribute.HasAuthoredValue():
                continue
            maps = _read(target, attribute, intake)
            if maps:
                found[str(target.GetPath())] = maps
    return found


def _read(prim, attribute, intake: Intake) -> tuple[BakedMap, ...]:
    layout = prim.GetAttribute(LAYOUT_ATTRIBUTE)
    name = layout.Get() if layout else None
    if name != LAYOUT:
        text = f"{LAYOUT_ATTRIBUTE}: got {name!r}, expected {LAYOUT!r}; its map is drawn anew"
        intake.bad(prim.GetPath(), text)
        return ()
    asset = attribute.Get(intake.time)
    file = resolve_asset(asset, attribute, intake) if isinstance(asset, Sdf.AssetPath) else ""
    if not file:
        return ()
    key = "baked map", file
    if key not in intake.cache:
        try:
            intake.cache[key] = read_maps(file)
        except (OSError, ValueError) as fault:
            intake.cache[key] = str(fault)
    maps = intake.cache[key]
    if isinstance(maps, str):
        intake.bad(prim.GetPath(), f"{MAP}: {maps}; its map is drawn anew")
        return ()
    digests = prim.GetAttribute(GEOMETRY)
    expected = list(digests.Get() or ()) if digests else []
    if expected != [each.geometry for each in maps]:
        intake.bad(
            prim.GetPath(), f"{MAP}: {file} is not the file that was baked with this layer; its map is drawn anew"
        )
        return ()
    return maps
