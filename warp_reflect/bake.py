"""Bake a stage: draw its reflector maps and reference environment maps once, into files, and write a layer that names them.

Environment maps are drawn where the stage names places for them; where it names none but has mirrors that move, at places
that are proposed along their paths.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warp_reflect import __version__, images
from warp_reflect.baked_environments import WORLD_HEADER, write_map
from warp_reflect.baked_maps import LAYOUT, write_maps
from warp_reflect.planner import make_plan
from warp_reflect.reflectors import mirror_weight
from warp_reflect.scene import Note, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import baking, reference_maps, reflector_map

METHOD = "reflector_map"
PREVIEW_SIZE = (64, 64)  # of the plan, whose pixel counts say nothing here [pixels]


@dataclass(frozen=True)
class Baked:
    """What a bake has written.

    Attributes:
        layer: The layer.
        files: Path of each mirror to its EXR.
        environments: Path of the prim of each environment map to its EXR.
        notes: Mirrors and places without a map, and why; what is predicted of places that were proposed.
    """

    layer: Path
    files: dict[str, Path]
    environments: dict[str, Path]
    notes: list[Note]


def bake_stage(
    scene: Scene,
    path: str | os.PathLike,
    settings: Settings | None = None,
    *,
    report: Callable[[str, Path, str], None] = lambda prim_path, file, size: None,
) -> Baked:
    """Draw the reflector maps of a scene's mirrors, and its environment maps, into EXR files beside a layer over its stage.

    `render` of that layer takes the maps from the files as long as they fit the geometry; it shows the same picture as the
    stage, bit for bit, and stays a mirror by the same materials and choices.

    Args:
        scene: From `load_stage`, of a file; its maps are drawn at the scene's time.
        path: The layer, .usd, .usda or .usdc.
        settings: `map_resolution`, `environment_resolution`, `rem_limit`, `rem_error_px` and what makes a material a mirror;
            None: the defaults.
        report: Called after each file with the prim's path, the file and how large its maps are.

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
        report(prim_path, file, f"{maps[0].resolution} nodes along an edge")
    environments = _bake_environments(scene, stage, path, settings, taken, notes, report)
    provenance = {"version": __version__, "layout": LAYOUT, "mirrors": len(mirrors), "environments": len(environments)}
    write.write_baked_layer(source, path, mirrors, environments, provenance)
    files = ({each.prim_path: each.file for each in baked} for baked in (mirrors, environments))
    return Baked(path, *files, notes)


def _bake_environments(scene: Scene, stage, path: Path, settings: Settings, taken: set[str], notes, report) -> list:
    from warp_reflect.stage import write

    usable, told = reference_maps.usable_places(scene, settings)
    notes += told
    asked = reference_maps.authored(scene)
    if asked.paths:
        kept = []
        for k in usable:
            fault = write.bake_fault(stage, asked.paths[k], "")
            if fault:
                notes.append(Note(asked.paths[k], f"environment map: {fault}; it is drawn when it is needed"))
            else:
                kept.append(k)
        paths, centres, axes = [asked.paths[k] for k in kept], asked.centres[kept], asked.axes[kept]
        frames = [scene.data.environment_maps[k].world_from_map for k in kept]
    elif any(mirror_weight(scene, scene.parts[k], settings) for k in scene.moving_parts):
        placed = reference_maps.place_maps(scene, settings)
        notes.append(Note("/", f"environment maps: {reference_maps.told_of(placed)}"))
        centres, axes = placed.centres, placed.axes
        paths = [write.environment_path(stage, k) for k in range(len(centres))]
        frames = []
        for centre in centres:
            frames.append(np.eye(4))
            frames[-1][:3, 3] = centre
    else:
        return []
    baked = []
    for k, prim_path in enumerate(paths):
        place = reference_maps.Placement((prim_path,), centres[k : k + 1], axes[k : k + 1])
        drawn = reference_maps.draw_maps(scene, place, settings)
        file = write.map_file(path, prim_path, taken)
        images.check_writable(file)
        header = {"warp_reflect:version": __version__, "warp_reflect:prim": prim_path}
        header[WORLD_HEADER] = reference_maps.world_digest(scene, settings)
        write_map(file, drawn.radiance(0), drawn.distance(0), frames[k], header)
        baked.append(write.BakedEnvironment(prim_path, file, None if asked.paths else frames[k]))
        report(prim_path, file, f"environment map of {drawn.resolution} texels along an edge")
    return baked
