"""Accurate specular reflections on curved objects for OpenUSD stages, in NVIDIA Warp, on CPU and CUDA.

`load_stage` -> `make_plan` -> `render_frame` is the main path; `solve` and `refract` are the bare solvers of the laws of
reflection and refraction.
"""

from importlib import import_module

__version__ = "0.1.0"

# Name to module; imported when first asked for, so that `import warp_reflect` stays light.
_HOME = {
    "Camera": "layers",
    "CapturedFrame": "captured",
    "Frame": "frame",
    "Plan": "planner",
    "PlanarMirror": "mirrors",
    "QuadricMirror": "mirrors",
    "ReflectorMap": "reflector_maps",
    "Refraction": "refraction",
    "Scene": "scene",
    "Settings": "settings",
    "Solution": "solver",
    "Status": "settings",
    "Technique": "settings",
    "capture_frame": "captured",
    "compare_frames": "metrics",
    "keep_freed_memory": "devices",
    "load_stage": "stage.load",
    "make_plan": "planner",
    "refract": "refraction",
    "render_frame": "frame",
    "solve": "solver",
}
__all__ = list(_HOME)


def __getattr__(name: str):
    if name == "viewer":  # needs pyvista: not among the names that `*` would import
        return import_module("warp_reflect.viewer")
    if name not in _HOME:
        raise AttributeError(f"module 'warp_reflect' has no attribute '{name}'")
    value = getattr(import_module(f"warp_reflect.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
