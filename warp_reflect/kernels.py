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
ROW_MULTIPLE = 16  # `local_maps.ROW_MULTIPLE`, whose import would build Warp's modules before they are asked for
FLAT_LIGHTS = {"rect", "disk", "cylinder"}  # of `direct.AREA_KINDS`: all but spheres
# Name of a technique, or of an effect that is on, to kernel modules; a module's part stands after a slash, what is of vector
# kernels alone after a bar, what is of plain ones after a minus.
ROWS = {
    "planar": (*FORWARD, "techniques.planar"),
    "quadric": (*FORWARD, "techniques.quadric_patch", "|techniques.quadric_vector"),
    "reflector_map": (
        *FORWARD,
        "|techniques.map_vector",
        "-techniques.reflector_map/plain",
    ),
    "explosion_map": (*FORWARD, "techniques.explosion_map"),
    "environment": ("environment_maps",),
    "layered_environment": (
        "environment_maps",
        "techniques.layered_environment",
        "|techniques.local_shading_vector",
        "-techniques.local_shading",
        "-techniques.local_map",
    ),
    "raytraced": ("bvh", "|wide_tree", "|bvh_vector"),
    "refinement": ("|raster_rays_vector", "|techniques.refine_vector", "-techniques.refine"),
    "grid": ("techniques.interpolation",),
    "second_bounce": ("bounces", "-bvh"),
    "clearcoat": ("finishes.coat",),
    "fade": ("finishes.fade",),
}
# The way of rough mirrors, `effects.glossy_way`, to those of them.
GLOSSY = {
    "filter": ("finishes.glossy_filter", "finishes.layer_map"),
    "gather": ("finishes.glossy_rays", "finishes.glossy_gather"),
    "prefiltered": ("finishes.glossy_prefiltered",),
    "accumulate": ("finishes.glossy_rays",),
}


_last: list[tuple[list[str], wp.DeviceLike]] = []


def keep_last(names: list[str], device: wp.DeviceLike) -> None:
    """Modules that nothing waits for before a frame is shaded: begun when planning has begun those it waits for itself."""
    _last.append((names, device))


def begin_last() -> None:
    """Begin what was kept."""
    while _last:
        begin(*_last.pop())


def of_eye(settings: Settings, device: wp.DeviceLike) -> list[str]:
    """Those of every frame: known before its stage is read."""
    return [*of_view(settings, device), *_of(["|shade_vector", "-shade/plain"], vectors(settings, device))]


def of_view(settings: Settings, device: wp.DeviceLike, casting: bool = False, mirrors: bool = False) -> list[str]:
    """Those that planning launches where it looks at a scene.

    Args:
        settings, device: The plan's and the scene's.
        casting: Points are tried for what shadows do to them.
        mirrors: There are some, seen or not.
    """
    asked = ["|vector", "-raster", "|raster_vector", "-raster/plain"]
    if mirrors:
        asked += ["-surface", "|surface_vector"]
    if casting:
        asked += ["direct", "|shadow_starts_vector", "-shadow_starts/plain", "shade"]
        asked += ["|wide_tree", "|shadows_vector", "-shadows/tried"]
    return _of(asked, vectors(settings, device))


def of_mirrors(settings: Settings, device: wp.DeviceLike, casting: bool) -> list[str]:
    """Those that planning launches once mirrors are seen; `casting` as for `of_view`."""
    asked = ["|surface_vector", "-surface/plain", *(["bvh"] if casting else [])]
    return _of(asked, vectors(settings, device))


def of_plan(plan: Plan) -> list[str]:
    """Those of what a plan has on, as far as a first frame surely launches them."""
    vector = vectors(plan.settings, plan.scene.device)
    asked: list[str] = []
    seen = [row for row in plan.rows if row.pixels > 0]
    if plan.shadows is not None and plan.shadows.direct and plan.scene.triangle_count:
        cut = plan.scene.has_hole is not None
        sent = ["-direct", "|shadow_starts_vector", "-shadow_starts/plain", "|shadows_vector", "-shadow_lists"]
        asked += ["direct", "cut_shadows"] if cut else sent
        if not cut and FLAT_LIGHTS & {light.kind for light in plan.scene.data.lights}:
            asked.append("|shadow_starts_vector/flat")
    if seen:
        asked += ["-surface", "|surface_vector", "-surface/plain"]
    for row in seen:
        on = [row.technique, *(name for name, effect in row.effects.items() if effect.on)]
        asked += [module for name in on for module in ROWS.get(name, ())]
        asked += GLOSSY[row.effects["roughness"].numbers["way"]] if "roughness" in on else ()
    local = [row.settings for row in seen if row.technique == "layered_environment"]
    if local:
        # One map alone is blended in vectors whatever `rem_count` is: that one is compiled where it is launched.
        fits = any(each.local_edge % ROW_MULTIPLE == 0 and each.rem_count <= 2 for each in local)
        asked.append("|techniques.local_map_vector" if fits else "techniques.local_map")
    if any(pane.pixels > 0 for pane in plan.panes):
        asked += ["transmission", "|transmission_vector", "|wide_tree", "|bvh_vector", "-bvh/onward"]
    return _of(asked, vector)


def of_channels(plan: Plan) -> list[str]:
    """Those of all data channels of a frame, which are launched after those of the plan."""
    return ["surface/channels", *(["channels"] if any(row.pixels > 0 for row in plan.rows) else [])]


def vectors(settings: Settings, device: wp.DeviceLike) -> bool:
    """Whether vector kernels run where this machine's compiler has them, which is not tried here."""
    return settings.kernels != "plain" and not wp.get_device(device).is_cuda


def _of(asked: list[str], vector: bool) -> list[str]:
    left = "-" if vector else "|"
    return list(dict.fromkeys(name.lstrip("|-") for name in asked if not name.startswith(left)))


def modules_of(name: str) -> list[wp.Module]:
    """Warp's modules of a module of the package by its full name, which is imported: its own, and parts of it."""
    found = vars(importlib.import_module(name)).values()
    made = {each.module.name: each.module for each in found if isinstance(each, wp.Kernel)}
    return [module for key, module in made.items() if key == name or key.startswith(f"{name}.")]


def begin(names: Iterable[str], device: wp.DeviceLike) -> None:
    """Begin to compile and load modules of the package, without waiting: see `launch.ready`. On CUDA launches do."""
    if wp.get_device(device).is_cuda:
        return
    for name in names:
        importlib.import_module(f"{PACKAGE}.{name.partition('/')[0]}")
        launch.ready([wp.get_module(f"{PACKAGE}.{name.replace('/', '.')}")], device)
