"""One method a file. `TECHNIQUES` maps a name to the module that has `applies`, `prepare` and `reflect`."""

from warp_reflect.techniques import planar, raytraced, reflector_map

TECHNIQUES = {"planar": planar, "reflector_map": reflector_map, "raytraced": raytraced}
