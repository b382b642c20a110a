"""One method a file. `TECHNIQUES` maps a name to the module that has `applies`, `prepare` and `reflect`."""

from warp_reflect.techniques import (
    environment,
    explosion_map,
    layered_environment,
    planar,
    quadric,
    raytraced,
    reflector_map,
)

TECHNIQUES = {
    "planar": planar,
    "quadric": quadric,
    "reflector_map": reflector_map,
    "explosion_map": explosion_map,
    "environment": environment,
    "layered_environment": layered_environment,
    "raytraced": raytraced,
}
# What is seen is looked up in maps: there is no virtual picture, and nothing to refine.
MAPS = ("environment", "layered_environment")
