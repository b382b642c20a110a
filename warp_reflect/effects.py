"""Which effects a surface calls for beyond its sharp picture, each with one reason: a value, its threshold, its setting."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

from warp_reflect.budget import GLOSSY_RAYS
from warp_reflect.layers import Camera
from warp_reflect.scene import FinishData, MaterialData, PartRange, Scene
from warp_reflect.settings import Settings
from warp_reflect.techniques import MAPS, planar

# The effects of mirrors that are finishes, in the order in which they are applied, and the module of `finishes` of each.
FINISHES: dict[str, str] = {
    "waves": "water",
    "normal_map": "bumps",
    "roughness": "glossy",
    "clearcoat": "coat",
    "fade": "fade",
}
# Those of what is seen through transparent surfaces.
PANE_FINISHES: dict[str, str] = {"waves": "water", "frost": "frost"}
UNASKED = FinishData("")


@dataclass(frozen=True)
class Effect:
    """One effect of a reflector: on or off, the reason, and the numbers it was decided by."""

    on: bool
    reason: str
    numbers: dict = field(default_factory=dict)


def finish_of(material: MaterialData, settings: Settings) -> FinishData:
    """What is asked of a surface: what the stage does, else what the settings do."""
    asked = material.finish or UNASKED
    grey, white = (settings.fade_grey,) * 3, (settings.frost_grey,) * 3
    if asked.fade_distance == 0.0:
        asked = dataclasses.replace(asked, fade_distance=settings.fade_distance, fade_color=grey)
    if asked.frost_distance == 0.0:
        asked = dataclasses.replace(asked, frost_distance=settings.frost_distance, frost_color=white)
    if asked.frost == 0.0:
        asked = dataclasses.replace(asked, frost=settings.frost or frost_of(material))
    return asked


def frost_of(material: MaterialData) -> float:
    """Half-angle in degrees of the cone into which a rough transparent surface scatters what is behind it.

    Source: Walter et al., Microfacet Models for Refraction through Rough Surfaces, EGSR 2007. Half of the GGX distribution's
    slopes are below alpha = roughness^2; a slope s at one face turns a ray by about (ior - 1) s; half of a disc is within
    1 / sqrt(2) of its radius. Differs from it by: a cone in place of the distribution's long tail.
    """
    if material.transmission == 0.0:
        return 0.0
    return min(math.degrees(math.atan(math.sqrt(2.0) * (material.ior - 1.0) * material.roughness**2)), 45.0)


def finish_effects(
    scene: Scene, part: PartRange, visible: bool, settings: Settings, technique: str = ""
) -> dict[str, Effect]:
    """The finishes of a reflector, one effect for each name of `FINISHES`.

    Args:
        scene, part: The reflector's.
        visible: Whether the plan's camera sees it; what is not seen has no finish.
        settings: The reflector's.
        technique: The reflector's.
    """
    if not visible:
        return {name: Effect(False, "not seen from the camera") for name in FINISHES}
    material = scene.data.materials[part.material]
    finish = finish_of(material, settings)
    waves, normal_map = _waves(scene, part, finish, settings), _normal_map(material, settings, technique)
    if waves.on and normal_map.on:
        normal_map = Effect(True, f"{normal_map.reason}: its slopes are added to the waves'", normal_map.numbers)
    return {
        "waves": waves,
        "normal_map": normal_map,
        "roughness": _roughness(material, settings, technique),
        "clearcoat": _clearcoat(material, settings),
        "fade": _fade(finish, technique),
    }


def lobe_rays(effects: dict[str, Effect], settings: Settings, technique: str) -> list[int]:
    """Rays a pixel of each lobe or turned mirror that a reflector's effects follow; 0: the sharp picture is looked up."""
    usual = GLOSSY_RAYS[glossy_way(settings, technique)[0]]
    of_lobe = usual and (settings.glossy_samples or usual)
    found = [of_lobe] if effects["roughness"].on else []
    if effects["clearcoat"].on and effects["clearcoat"].numbers["roughness"] > settings.glossy_min_roughness:
        found.append(of_lobe)
    bumpy = effects["normal_map"].on and settings.bumps == "traced"
    if bumpy or (effects["waves"].on and settings.waves == "traced"):
        found.append(1)
    return found


def pane_rays(pixels: int, interface: str, effects: dict[str, Effect], settings: Settings) -> int:
    """Rays behind a transparent surface that a frame shades, expected.

    Whoever looks into a body looks out of it again, but where what lies in it is drawn; further surfaces are not counted.
    """
    frost = settings.frost_samples if effects["frost"].on else 0
    again = 1 + frost + (effects["waves"].on and settings.waves == "traced")
    onward = interface == "solid" and not effects["refraction_image"].on
    return pixels * again * (1 + onward)


def frost_rays(pixels: int, effects: dict[str, Effect], settings: Settings) -> int:
    """Rays that correct what a frosted surface blurs."""
    return pixels * settings.frost_rays if effects["frost"].on and not settings.frost_samples else 0


def bounce_effect(visible: bool, alone: bool, mirrored: float | None, settings: Settings) -> Effect:
    """Whether what a mirror shows of mirrors is followed on.

    Args:
        visible: Whether the plan's camera sees it.
        alone: Whether it is the only mirror, and convex.
        mirrored: Share of the points tried in it that show a mirror; None: none was tried.
        settings: The plan's.
    """
    if settings.bounces < 2:
        return Effect(False, f"bounces={settings.bounces}: a mirror seen in a mirror shows its base and the dome")
    if not visible:
        return Effect(False, "not seen from the camera")
    if alone:
        return Effect(False, "the only mirror, and convex: it shows none")
    if not mirrored:
        return Effect(False, "no point of it that was tried shows a mirror", {"share": 0.0})
    reason = f"{100.0 * mirrored:.2g}% of its points show a mirror, up to {settings.bounces} reflections (bounces)"
    return Effect(True, reason, {"share": mirrored, "bounces": settings.bounces})


def pane_effects(
    scene: Scene, part: PartRange, interface: str, reason: str, pixels: int, settings: Settings, camera: Camera
) -> dict[str, Effect]:
    """What is simulated of a transparent surface.

    Args:
        scene, part: The surface's.
        interface: "thin" or "solid".
        reason: Why it is that.
        pixels: At which the plan's camera sees it.
        settings: The plan's.
        camera: The plan's.
    """
    material = scene.data.materials[part.material]
    finish = finish_of(material, settings)
    seen = f"{pixels} pixels" if pixels else "not seen from the camera, but perhaps in mirrors and behind others"
    depth = f"up to {settings.transparency_depth} surfaces behind one another (transparency_depth)"
    numbers = {"opacity": material.opacity, "transmission": material.transmission, "pixels": pixels}
    waves = _waves(scene, part, finish, settings)
    if waves.on and interface != "solid":
        waves = Effect(False, "a thin surface bends nothing, still or wavy", waves.numbers)
    elif not waves.on and interface == "solid" and "normal" in material.textures and settings.waves != "off":
        flat, why = planar.is_flat(scene, part)
        mapped = f"its normal map bends what is seen through it, waves={settings.waves}"
        waves = Effect(flat, mapped if flat else f"normal maps bend rays on flat surfaces only; {why}", waves.numbers)
    return {
        "transparency": Effect(True, f"opacity {material.opacity:g}, {seen}, {depth}", numbers),
        "refraction": Effect(interface == "solid", reason, {"ior": material.ior}),
        "waves": waves,
        "frost": _frost(material, finish, settings, camera),
        "frost_fade": _frost_fade(finish),
    }


def refraction_effect(
    scene: Scene, part: int, interface: str, pixels: int, settings: Settings, camera: Camera, method: str
) -> Effect:
    """Whether what lies behind a surface is drawn as the eye sees it through that, instead of traced.

    Args:
        scene, part: The surface, index into `scene.parts`.
        interface: "thin" or "solid".
        pixels: At which the plan's camera sees it.
        settings, camera: The plan's.
        method: The plan's; the reference traces.
    """
    if interface != "solid":
        return Effect(False, "thin: nothing is bent")
    if not pixels:
        return Effect(False, "not seen from the camera")
    if method == "reference":
        return Effect(False, "the reference: every ray is traced")
    if settings.refraction == "traced":
        return Effect(False, "refraction=traced")
    if camera.orthographic:
        return Effect(False, "a parallel camera's rays are traced")
    if settings.refraction == "auto" and scene.device.is_cuda:
        # The host cuts the image's triangles: 14.6 ms a frame of `pool` at 1280x720 on an H100, 10.1 by rays.
        return Effect(False, "a GPU follows rays sooner than the host cuts an image (refraction=auto)")
    from warp_reflect.techniques import refraction_image

    drawn, reason, numbers = refraction_image.applies(scene, part, pixels)
    if settings.refraction == "drawn" and numbers:
        return Effect(True, "refraction=drawn", numbers)
    return Effect(drawn, f"{reason} (refraction={settings.refraction})", numbers)


def moves_with_time(effects: dict[str, Effect]) -> bool:
    """Whether any effect shows something else at another time in a world where nothing moves."""
    return any(effect.on and effect.numbers.get("speed", 0.0) > 0.0 for effect in effects.values())


def _fade(finish: FinishData, technique: str) -> Effect:
    numbers = {"distance": finish.fade_distance, "color": list(finish.fade_color)}
    if finish.fade_distance == 0.0:
        return Effect(False, "nothing asks for a fade, fade_distance=0", numbers)
    if technique in MAPS:
        return Effect(False, "maps know no distances", numbers)
    return Effect(True, f"to 1/e over {finish.fade_distance:g}", numbers)


def _waves(scene: Scene, part: PartRange, finish: FinishData, settings: Settings) -> Effect:
    numbers = {"slope": finish.wave_slope, "length": finish.wave_length, "speed": finish.wave_speed}
    if finish.wave_slope == 0.0:
        return Effect(False, "nothing asks for waves")
    if settings.waves == "off":
        return Effect(False, "waves=off", numbers)
    flat, why = planar.is_flat(scene, part)
    if not flat:
        return Effect(False, f"waves are on flat surfaces only; {why}", numbers)
    return Effect(True, f"slopes of {finish.wave_slope:g} as authored, waves={settings.waves}", numbers)


def _frost(material: MaterialData, finish: FinishData, settings: Settings, camera: Camera) -> Effect:
    radius = math.tan(math.radians(finish.frost)) * max(camera.fx, camera.fy)
    asked = f"a cone of {finish.frost:.3g} degrees blurs by up to {radius:.3g} px"
    numbers = {"angle": finish.frost, "radius_px": radius}
    if material.transmission == 0.0 and finish.frost > 0.0:
        return Effect(False, "it is partly not there: through the rest one looks straight", numbers)
    if radius <= settings.frost_px:
        return Effect(False, f"{asked}, <= {settings.frost_px:g} (frost_px)", numbers)
    how = f"{settings.frost_samples} rays a pixel" if settings.frost_samples else "the picture behind it is blurred"
    if settings.frost_rays and not settings.frost_samples:
        how = f"{how} and corrected by {settings.frost_rays} rays a pixel (frost_rays)"
    return Effect(True, f"{asked}, > {settings.frost_px:g} (frost_px); {how} (frost_samples)", numbers)


def _frost_fade(finish: FinishData) -> Effect:
    numbers = {"distance": finish.frost_distance}
    if finish.frost_distance == 0.0:
        return Effect(False, "nothing asks for a fade, frost_distance=0", numbers)
    return Effect(True, f"to 1/e over {finish.frost_distance:g}", numbers)


def glossy_way(settings: Settings, technique: str) -> tuple[str, str]:
    """(How rough mirrors of a technique are shown, one of `settings.GLOSSY` but auto; why)."""
    asked = settings.glossy
    if technique in MAPS and asked == "auto":
        return "prefiltered", "its map is prefiltered, glossy=auto"
    if technique not in MAPS and asked == "prefiltered":
        return "gather", "no map to prefilter: as gather, glossy=prefiltered"
    return ("gather", "as gather, glossy=auto") if asked == "auto" else (asked, f"glossy={asked}")


def _roughness(material: MaterialData, settings: Settings, technique: str) -> Effect:
    if settings.glossy == "off":
        return Effect(False, "glossy=off")
    textured = "roughness" in material.textures
    value = f"roughness {material.roughness:.3g}{' (mean of its texture)' if textured else ''}"
    least = settings.glossy_min_roughness
    way, how = glossy_way(settings, technique)
    numbers = {"roughness": material.roughness, "way": way}
    if not textured and material.roughness <= least:
        return Effect(False, f"{value} <= {least:g} (glossy_min_roughness)", numbers)
    return Effect(True, f"{value} > {least:g} (glossy_min_roughness), {how}", numbers)


def _normal_map(material: MaterialData, settings: Settings, technique: str) -> Effect:
    if "normal" not in material.textures:
        return Effect(False, "no normal map")
    if settings.bumps == "off":
        return Effect(False, "bumps=off: it reflects at the surface itself")
    if technique in MAPS:
        return Effect(False, "maps are looked up with the surface's own normals")
    return Effect(True, f"a texture of normal, bumps={settings.bumps}")


def _clearcoat(material: MaterialData, settings: Settings) -> Effect:
    if material.clearcoat == 0.0:
        return Effect(False, "no clear coat")
    if settings.glossy == "off":
        return Effect(False, "glossy=off: base and coat show the same picture")
    least, numbers = settings.glossy_min_roughness, {"roughness": material.clearcoat_roughness}
    value = f"clear coat {material.clearcoat:.3g} of roughness {material.clearcoat_roughness:.3g}"
    textured = {"roughness", "clearcoat_roughness"} & material.textures.keys()
    if not textured and max(material.roughness, material.clearcoat_roughness) <= least:
        return Effect(False, f"{value}: base and coat are smooth (glossy_min_roughness={least:g})", numbers)
    return Effect(True, f"{value} over a base of {material.roughness:.3g}", numbers)
