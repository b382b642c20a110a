"""The inspector: live frames of a stage, their error, their pixels, and what mirrors show, in space.

Needs pyvista; `Session` and the pictures of `export` need no OpenGL. Names are imported when they are first asked for.
"""

from importlib import import_module

_HOME = {
    "Inspector": "inspector",
    "Region": "geometry",
    "Session": "session",
    "inspector_of": "inspector",
    "meshes": "geometry",
    "plotter": "inspector",
}
__all__ = list(_HOME)


def __getattr__(name: str):
    if name not in _HOME:
        raise AttributeError(f"module 'warp_reflect.viewer' has no attribute '{name}'")
    return getattr(import_module(f"warp_reflect.viewer.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
