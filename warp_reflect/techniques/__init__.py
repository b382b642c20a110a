"""One method a file. `TECHNIQUES` maps a name to the module that has `applies`, `prepare` and `reflect`."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from types import ModuleType


class _Modules(Mapping):
    """Modules of this package by name, imported where they are asked for: building Warp's kernels takes its time."""

    def __init__(self, *names: str):
        self._names = dict.fromkeys(names)

    def __getitem__(self, name: str) -> ModuleType:
        if name not in self._names:
            raise KeyError(name)
        return import_module(f"{__name__}.{name}")

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


TECHNIQUES = _Modules(
    "planar",
    "quadric",
    "reflector_map",
    "explosion_map",
    "environment",
    "layered_environment",
    "raytraced",
)
# What is seen is looked up in maps: there is no virtual picture, and nothing to refine.
MAPS = ("environment", "layered_environment")
# What mirrors need is made of several at once: the module has `prepare_together` too.
TOGETHER = ("layered_environment",)
