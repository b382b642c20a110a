"""Which surfaces are mirrors, and which are looked through."""

from __future__ import annotations

import numpy as np

from warp_reflect.scene import MaterialData, PartRange, Scene, reflectance
from warp_reflect.settings import Settings

CLEARCOAT_MIN = 0.5  # a coat from here on is a mirror of its own (design: clearcoat >= 0.5)
INTERFACES = ("opaque", "thin", "solid")  # how light meets a surface
REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def mirror_roughness(material: MaterialData) -> float:
    """Of the smoother layer of a coated material, of the material else."""
    if material.clearcoat >= CLEARCOAT_MIN:
        return min(material.roughness, material.clearcoat_roughness)
    return material.roughness


def mirror_weight(scene: Scene, part: PartRange, settings: Settings) -> float:
    """Luminance of a part's mirror term at normal incidence; 0 where it is no mirror, by choice or by the settings."""
    material = scene.data.materials[part.material]
    most = float(np.float32(settings.reflector_max_roughness))  # as a stage stores it: 0.3 is rough 0.30000001
    f0, _ = reflectance(material)
    weight = float(f0 @ REC709_LUMINANCE)
    if material.mirror is not None:
        return weight if material.mirror.include else 0.0
    coated = material.clearcoat >= CLEARCOAT_MIN and material.clearcoat_roughness <= most
    if coated:
        return max(weight, CLEARCOAT_MIN)
    # What a mirror's picture has to stand out from is what the surface scatters; through clear glass nothing is.
    least = settings.reflector_min_weight * (1.0 - material.transmission)
    if material.roughness <= most and weight >= least:
        return weight
    return 0.0


def is_transparent(scene: Scene, part: PartRange) -> bool:
    """Whether anything is seen through a part."""
    material = scene.data.materials[part.material]
    return material.opacity < 1.0 or material.transmission > 0.0


def interface_of(scene: Scene, part_index: int) -> tuple[str, str]:
    """(one of `INTERFACES`, the reason) of a part."""
    part = scene.parts[part_index]
    material = scene.data.materials[part.material]
    if not is_transparent(scene, part):
        return "opaque", "opacity 1"
    shares = f"opacity {material.opacity:g}, transmission {material.transmission:g}"
    if material.transmission == 0.0:
        return "thin", f"{shares}: partly not there"
    if material.ior == 1.0:
        return "thin", f"{shares}, ior 1: nothing bends a ray"
    asked = material.finish.interface if material.finish is not None else "auto"
    if asked != "auto":
        return asked, f"{shares}, ior {material.ior:g}, {asked} as authored"
    if scene.body(part_index).closed:
        return "solid", f"{shares}, ior {material.ior:g}, closed: a body"
    return "thin", f"{shares}, open: a pane"
