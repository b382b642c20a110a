"""`load_stage`: a stage file to a `Scene` on a device."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from warp_reflect.launch import Turns
from warp_reflect.scene import Note, Scene, SceneData


def load_stage(
    path: str | Path,
    device: str = "cpu",
    time: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    *,
    complexity: str = "low",
    strict: bool = False,
    reflectors: tuple[str, ...] = (),
    untrusted: bool = False,
    root: str | Path = "",
) -> Scene:
    """Read a USD stage at one time and put it on a device.

    `scene.at(time)` reads the same open stage at another time; meshes that do not change are not read again, and a
    world in which only cameras move is not prepared again.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        device: Warp device, as "cpu" or "cuda:0".
        time: Time code; None: the earliest sample of what is animated (usdrecord's choice).
        purposes: Some of "default", "render", "proxy", "guide"; "default" is always drawn.
        complexity: "low", "medium", "high" or "veryhigh": subdivision and tessellation of gprims.
        strict: Raise for a prim that would be dropped or repaired with a note.
        reflectors: Patterns of prims, materials or collections that get a mirror's material, whatever the
            stage says, as "/World/Car*:color=keep"; see `reflectors.parse_patterns`.
        untrusted: Read in a child process with bounded memory and time, confined to `root` or, where it is empty, to
            the stage's folder.
        root: Folder that layers and pictures must lie in; empty: anywhere, unless untrusted.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a stage, an impossible argument, or (strict) a bad prim; one line.
    """
    from warp_reflect.stage.guard import Limits, read_untrusted
    from warp_reflect.stage.read import StageReader

    arguments = path, purposes, complexity, strict, Limits(root=str(root)), reflectors
    reader, reading = None if untrusted else StageReader(*arguments), Turns()

    def at(code: float | None, known: Scene | None = None) -> Scene:
        if reader is None:
            data = _without_map_files(read_untrusted(path, code, *arguments[1:]))
        else:
            with reading:
                data = reader.read(code)
        seen = known.seen_at(data) if known is not None else None
        return Scene(data, device, reload=at, earlier=known) if seen is None else seen

    return at(time)


def _without_map_files(data: SceneData) -> SceneData:
    """An untrusted stage whose environment maps are drawn: their files would be decoded here, not in the child process."""
    for k, each in enumerate(data.environment_maps):
        if each.map_file:
            data.environment_maps[k] = dataclasses.replace(each, map_file="")
            data.notes.append(
                Note(each.path, "environment map: the file of an untrusted stage is not read; drawn anew")
            )
    return data
