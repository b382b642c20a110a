"""Which effects a reflector calls for beyond its sharp picture, each with one reason: a value, its threshold, its setting."""

from __future__ import annotations

from dataclasses import dataclass, field

from warp_reflect.scene import MaterialData, PartRange, Scene
from warp_reflect.settings import Settings

# The effects that are finishes, in the order in which they are applied, and the module of `finishes` of each.
FINISHES = {"roughness": "glossy"}


@dataclass(frozen=True)
class Effect:
    """One effect of a reflector: on or off, the reason, and the numbers it was decided by."""

    on: bool
    reason: str
    numbers: dict = field(default_factory=dict)


def finish_effects(scene: Scene, part: PartRange, visible: bool, settings: Settings) -> dict[str, Effect]:
    """The finishes of a reflector, one effect for each name of `FINISHES`.

    Args:
        scene, part: The reflector's.
        visible: Whether the plan's camera sees it; what is not seen has no finish.
        settings: The reflector's.
    """
    if not visible:
        return {name: Effect(False, "not seen from the camera") for name in FINISHES}
    material = scene.data.materials[part.material]
    return {"roughness": _roughness(material, settings)}


def pane_effects(
    scene: Scene, part: PartRange, interface: str, reason: str, pixels: int, settings: Settings
) -> dict[str, Effect]:
    """What is simulated of a transparent surface.

    Args:
        scene, part: The surface's.
        interface: "thin" or "solid".
        reason: Why it is that.
        pixels: At which the plan's camera sees it.
        settings: The plan's.
    """
    material = scene.data.materials[part.material]
    seen = f"{pixels} pixels" if pixels else "not seen from the camera, but perhaps in mirrors and behind others"
    depth = f"up to {settings.transparency_depth} surfaces behind one another (transparency_depth)"
    numbers = {"opacity": material.opacity, "transmission": material.transmission, "pixels": pixels}
    return {
        "transparency": Effect(True, f"opacity {material.opacity:g}, {seen}, {depth}", numbers),
        "refraction": Effect(interface == "solid", reason, {"ior": material.ior}),
    }


def _roughness(material: MaterialData, settings: Settings) -> Effect:
    if settings.glossy == "off":
        return Effect(False, "glossy=off")
    textured = "roughness" in material.textures
    value = f"roughness {material.roughness:.3g}{' (mean of its texture)' if textured else ''}"
    least = settings.glossy_min_roughness
    numbers = {"roughness": material.roughness}
    if not textured and material.roughness <= least:
        return Effect(False, f"{value} <= {least:g} (glossy_min_roughness)", numbers)
    return Effect(True, f"{value} > {least:g} (glossy_min_roughness), glossy={settings.glossy}", numbers)
