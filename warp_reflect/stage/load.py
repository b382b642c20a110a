"""`load_stage`: a stage file to a `Scene` on a device."""

from __future__ import annotations

from pathlib import Path

from warp_reflect.scene import Scene


def load_stage(
    path: str | Path,
    device: str = "cpu",
    time: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    *,
    complexity: str = "low",
    strict: bool = False,
    reflectors: tuple[str, ...] = (),
) -> Scene:
    """Read a USD stage at one time and put it on a device.

    `scene.at(time)` reads the same open stage at another time; meshes that do not change are not read again.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.
        device: Warp device, as "cpu" or "cuda:0".
        time: Time code; None: the earliest sample of what is animated (usdrecord's choice).
        purposes: Some of "default", "render", "proxy", "guide"; "default" is always drawn.
        complexity: "low", "medium", "high" or "veryhigh": subdivision and tessellation of gprims.
        strict: Raise for a prim that would be dropped or repaired with a note.
        reflectors: Patterns of prims, materials or collections that get a mirror's material, whatever the
            stage says; see `override_reflectors`.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not a stage, an impossible argument, or (strict) a bad prim; one line.
    """
    from warp_reflect.stage.read import StageReader

    reader = StageReader(path, purposes, complexity, strict, reflectors=reflectors)

    def at(code: float | None) -> Scene:
        return Scene(reader.read(code), device, reload=at)

    return at(time)
