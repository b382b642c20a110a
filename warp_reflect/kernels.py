"""Which kernel modules a first frame launches, told as early as it is known, so that they compile several at a time.

Without it every module is compiled where it is first launched, one after the other. Nothing is named here that the frame
does not launch; what is not named (textures, cut-outs, a second frame's) is compiled where it is launched, as ever.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING

import warp as wp

from warp_reflect import launch
from warp_reflect.settings import Settings

if TYPE_CHECKING:
    from warp_reflect.planner import Plan

PACKAGE = __package__
FORWARD = ("techniques.forward", "techniques.virtual_mesh")
# Name of a technique, or of an effect that is on, to kernel modules; behind a bar those of vector kernels alone.
ROWS = {
    "planar": (*FORWARD, "techniques.planar"),
    "quadric": (*FORWARD, "techniques.quadric_patch", "|techniques.quadric_vector"),
    "reflector_map": (*FORWARD, "techniques.reflector_map", "|techniques.map_vector"),
    "explosion_map": (*FORWARD, "techniques.explosion_map"),
    "environment": ("environment_maps",),
    "layered_environment": ("environment_maps", "techniques.layered_environment", "techniques.local_map"),
    "raytraced": ("bvh",),
    "grid": ("techniques.interpolation",),
    "second_bounce": ("bounces",),
    "roughness": ("finishes.glossy", "finishes.layer_map"),
    "clearcoat": ("finishes.coat",),
    "fade": ("finishes.fade",),
}


def of_eye(settings: Settings, device: wp.DeviceLike) -> list[str]:
    """Those of every frame: known before its stage is read."""
    shading = "shade_vector" if vectors(settings, device) else "shade"
    return [*of_preview(settings, device), shading]


def of_preview(settings: Settings, device: wp.DeviceLike, casting: bool = False, mirrors: bool = False) -> list[str]:
    """Those that planning launches where it looks at a scene.

    Args:
        settings, device: The plan's and the scene's.
        casting: Points are tried for what shadows do to them.
        mirrors: So they are in mirrors that are seen.
    """
    asked = ["|vector", "raster", "|raster_vector"]
    if casting:
        asked += ["direct", "shadows"]
    if mirrors:
        asked += ["surface", "|surface_vector", "bvh"]
    return _of(asked, vectors(settings, device))


def of_plan(plan: Plan) -> list[str]:
    """Those of what a plan has on, as far as a first frame surely launches them."""
    vector = vectors(plan.settings, plan.scene.device)
    asked: list[str] = []
    seen = [row for row in plan.rows if row.pixels > 0]
    if plan.shadows is not None and plan.shadows.direct and plan.scene.triangle_count:
        asked += ["direct", *(["cut_shadows"] if plan.scene.has_hole is not None else ["shadows", "|shadows_vector"])]
    if seen:
        asked += ["surface", "|surface_vector", "shade"]
    for row in seen:
        on = [row.technique, *(name for name, effect in row.effects.items() if effect.on)]
        asked += [module for name in on for module in ROWS.get(name, ())]
        if row.effects["refinement"].on:
            asked += ["techniques.refine_vector" if vector else "techniques.refine"]
    if any(pane.pixels > 0 for pane in plan.panes):
        asked += ["transmission", "|transmission_vector"]
    return _of(asked, vector)


def vectors(settings: Settings, device: wp.DeviceLike) -> bool:
    """Whether vector kernels run where this machine's compiler has them, which is not tried here."""
    return settings.kernels != "plain" and not wp.get_device(device).is_cuda


def _of(asked: list[str], vector: bool) -> list[str]:
    return list(dict.fromkeys(name.removeprefix("|") for name in asked if vector or not name.startswith("|")))


def begin(names: Iterable[str], device: wp.DeviceLike) -> None:
    """Begin to compile and load modules of the package, without waiting: see `launch.ready`. On CUDA launches do."""
    if wp.get_device(device).is_cuda:
        return
    full = [f"{PACKAGE}.{name}" for name in names]
    for name in full:
        importlib.import_module(name)
    launch.ready([wp.get_module(name) for name in full], device)
