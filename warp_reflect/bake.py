"""Bake a stage: draw the reflector map of every mirror once, into files, and write a layer that names them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from warp_reflect import __version__, images
from warp_reflect.baked_maps import LAYOUT, write_maps
from warp_reflect.planner import make_plan
from warp_reflect.scene import Note, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import baking, reflector_map

METHOD = "reflector_map"
PREVIEW_SIZE = (64, 64)  # of the plan, whose pixel counts say nothing here [pixels]


@dataclass(frozen=True)
class Baked:
    """What a bake has written.

    Attributes:
        layer: The layer.
        files: Path of each mirror to its EXR.
        notes: Mirrors without a map, and why.
    """

    layer: Path
    files: dict[str, Path]
    notes: list[Note]


def bake_stage(
    scene: Scene,
    path: str | os.PathLike,
    settings: Settings | None = None,
    *,
    report: Callable[[str, Path, int], None] = lambda prim_path, file, resolution: None,
) -> Baked:
    """Draw the reflector maps of a scene's mirrors into EXR files beside a layer over its stage.

    `render` of that layer takes the maps from the files as long as they fit the geometry; it shows the same picture as the
    stage, bit for bit, and stays a mirror by the same materials and choices.

    Args:
        scene: From `load_stage`, of a file; its maps are drawn at the scene's time.
        path: The layer, .usd, .usda or .usdc.
        settings: `map_resolution` and what makes a material a mirror; None: the defaults.
        report: Called after each file with the mirror's path, the file and its nodes along a cube edge.

    Raises:
        ValueError: an impossible name for the layer, or it is the stage itself or one of its layers.
        OSError: a file could not be written.
    """
    from warp_reflect.stage import write

    settings = settings or Settings()
    source = scene.data.source
    path = write.check_layer_writable(path, source)
    stage = write.open_source(source)
    write.layer_over(stage, source, path)  # refused before the work, if at all
    plan = make_plan(scene, size=PREVIEW_SIZE, settings=settings, method=METHOD)
    mirrors, notes, taken = [], [], set()
    for row in plan.rows:
        part = scene.parts[row.reflector.part]
        prim_path = baking.mirror_path(part)
        if row.technique != METHOD:
            notes.append(Note(prim_path, f"no map is baked: {row.reason}"))
            continue
        fault = write.bake_fault(stage, prim_path, part.instance)
        if fault:
            notes.append(Note(prim_path, f"no map is baked: {fault}; it is drawn when it is needed"))
            continue
        maps = tuple(baking.to_baked(scene, part, each) for each in reflector_map.drawn_maps(plan.prepared(row)))
        if not maps:
            notes.append(Note(prim_path, "no map is baked: all of its pieces are held without one"))
            continue
        file = write.map_file(path, prim_path, taken)
        images.check_writable(file)
        write_maps(file, maps, {"warp_reflect:version": __version__, "warp_reflect:prim": prim_path})
        mirrors.append(write.BakedMirror(prim_path, file, maps))
        report(prim_path, file, maps[0].resolution)
    provenance = {"version": __version__, "layout": LAYOUT, "mirrors": len(mirrors)}
    write.write_baked_layer(source, path, mirrors, provenance)
    return Baked(path, {mirror.prim_path: mirror.file for mirror in mirrors}, notes)
