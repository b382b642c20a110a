"""Which lights cast shadows: decided per light from a few points of what the eye and the mirrors see."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warp_reflect import shade
from warp_reflect.budget import BUILT_IN, Costs, shadow_ray_ms
from warp_reflect.direct import AREA_KINDS
from warp_reflect.effects import Effect
from warp_reflect.launch import thread_count
from warp_reflect.probe import Probe
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.shadows import Shadows, first_count, light_shares, shared_count

REC709_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
PROBE_SAMPLES = 4  # rays to a shape from each point that is tried
# Of `shadow_min_share`: what the shadows of a light clearly take that few points tell of. Of 600 points one that takes no more
# than the share itself shows so much once in a million.
CLEAR = 10.0
# More rays are sent where the first ones of 5 x 5 pixels part; the points tried tell where `PROBE_SAMPLES` do. Where any share of
# a shape is as likely to be seen, n rays part with probability 1 - 2 / (n + 1).
MORE_PARTED = (1.0 - 2.0 / (25.0 + 1.0)) / (1.0 - 2.0 / (PROBE_SAMPLES + 1.0))
# Points of a penumbra that send all of their rays although neighbours share theirs: where it is narrow. Measured: sharing leaves
# 0.61 of the time that shadow rays take in `one_mirror`, 0.71 in `toy_room`, which is what this share of 16 samples makes.
NARROW_SHARE = 0.45
# Of the visible share of a shape in its penumbra, root mean square, times samples^-3/4. Measured against 256 samples in
# `one_mirror` and `toy_room`, 4 to 64 samples: 0.38 to 0.48 where each point sends all, 0.30 to 0.49 where neighbours share.
PENUMBRA_ERROR = 0.4


@dataclass(frozen=True)
class LightRow:
    """What is simulated for one light."""

    path: str
    kind: str
    effects: dict[str, Effect] = field(default_factory=dict)


def plan_lights(scene: Scene, probe: Probe | None, settings: Settings, costs: Costs = BUILT_IN) -> list[LightRow]:
    """One row per light of the stage, in its order.

    Args:
        scene: The scene.
        probe: What is seen; None: nothing is, or nothing has to be tried (see `needs_probe`).
        settings: The knobs.
        costs: Of the machine.
    """
    ray_ms = shadow_ray_ms(scene.triangle_count, costs, thread_count(scene.device, settings.threads))
    tried = _tried(scene, probe, settings) if needs_probe(scene, settings) and probe is not None else None
    rows, seen = [], {"distant": 0, "area": 0}
    distant = sum(light.kind == "distant" for light in scene.data.lights)
    for light in scene.data.lights:
        pixels = 0 if probe is None else probe.count
        if light.kind == "dome":
            ms = pixels * settings.shadow_samples * ray_ms
            reason = f"dome_shadows={settings.dome_shadows}"
            reason += f"; {settings.shadow_samples} rays a point" + (f", {ms:.0f} ms predicted" if pixels else "")
            effect = Effect(
                settings.dome_shadows == "on", reason, {"samples": settings.shadow_samples, "points": pixels, "ms": ms}
            )
        elif light.kind == "distant" or light.kind in AREA_KINDS:
            kind = "distant" if light.kind == "distant" else "area"
            index = seen[kind] + (distant if kind == "area" else 0)
            seen[kind] += 1
            effect = _effect(settings, kind, None if tried is None else tried[index], pixels, ray_ms)
        else:
            effect = Effect(False, f"{light.kind} lights are not used")
        rows.append(LightRow(light.path, light.kind, {"shadows": effect}))
    return rows


def shadows_of(rows: list[LightRow], settings: Settings) -> Shadows | None:
    """What shading is told of the plan of the lights; None where no light casts a shadow."""
    cast = Shadows(
        tuple(row.effects["shadows"].on for row in rows if row.kind == "distant"),
        tuple(row.effects["shadows"].on for row in rows if row.kind in AREA_KINDS),
        settings.dome_shadows == "on",
        settings.shadow_samples,
        settings.shadow_sharing == "on",
    )
    return cast if cast.direct or cast.domes else None


def needs_probe(scene: Scene, settings: Settings) -> bool:
    """Whether points must be tried to decide."""
    casting = any(light.kind == "distant" or light.kind in AREA_KINDS for light in scene.data.lights)
    return settings.shadows == "auto" and casting and scene.triangle_count > 0


def are_clear(rows: list[LightRow], settings: Settings) -> bool:
    """Whether few points tell of every light that it casts shadows into view."""
    numbers = [row.effects["shadows"].numbers for row in rows]
    least = CLEAR * settings.shadow_min_share
    return all(each["taken"] > 0.0 and each["taken"] >= least for each in numbers if "taken" in each)


@dataclass(frozen=True)
class _Tried:
    """A light at the points that were tried."""

    share: float  # of all light there, were there no shadows
    shadowed: float  # of the points that it would light: those that get less than half of it
    penumbra: float  # those that get a part of it
    taken: float  # of all light there: what its shadows take
    lit: float  # of the points: that it would light


def _tried(scene: Scene, probe: Probe, settings: Settings) -> list[_Tried]:
    """Every light at the points of a probe, the distant ones first."""
    normal, unshadowed, arrived = light_shares(scene, probe.points, PROBE_SAMPLES, settings.threads, settings.kernels)
    brought, arrived = unshadowed.astype(np.float64) @ REC709_LUMINANCE, arrived.astype(np.float64)
    sky = shade.dome_irradiances(scene, normal, settings.threads).astype(np.float64) @ REC709_LUMINANCE
    total = max(float(brought.sum() + sky.sum()), 1.0e-300)
    result = []
    for k in range(brought.shape[1]):
        lit = brought[:, k] > 0.0
        count = max(int(lit.sum()), 1)
        result.append(
            _Tried(
                float(brought[:, k].sum()) / total,
                float((arrived[lit, k] < 0.5).sum()) / count,
                float(((arrived[lit, k] > 0.0) & (arrived[lit, k] < 1.0)).sum()) / count,
                float((brought[:, k] * (1.0 - arrived[:, k])).sum()) / total,
                float(lit.sum()) / max(len(lit), 1),
            )
        )
    return result


def _effect(settings: Settings, kind: str, tried: _Tried | None, pixels: int, ray_ms: float) -> Effect:
    if settings.shadows != "auto":
        return Effect(settings.shadows == "on", f"shadows={settings.shadows}")
    if tried is None:
        return Effect(False, "nothing is seen that it could light")
    rays = pixels * tried.lit
    alone = tried.lit * (1 if kind == "distant" else first_count(settings.shadow_samples) + settings.shadow_samples)
    error = penumbra = 0.0
    if kind == "area":
        samples = settings.shadow_samples
        more = float(samples)
        if settings.shadow_sharing == "on":
            few = shared_count(samples)
            more = few + NARROW_SHARE * (samples - few)
        penumbra = min(tried.penumbra * MORE_PARTED, 1.0)
        rays *= first_count(samples) + penumbra * more
        error = min(PENUMBRA_ERROR * samples**-0.75, 0.5)
    ms = rays * ray_ms
    numbers = {
        "share": tried.share,
        "shadowed": tried.shadowed,
        "taken": tried.taken,
        "threshold": settings.shadow_min_share,
        "penumbra": penumbra,
        "lit": tried.lit,
        "points": pixels,
        "rays": round(rays),
        "rays_alone": alone,  # from a point that shares nothing with neighbours
        "ms": ms,
        "penumbra_error": error,
    }
    on = tried.taken > 0.0 and tried.taken >= settings.shadow_min_share
    reason = (
        f"{tried.share:.0%} of the light on what is seen; {tried.shadowed:.1%} of the points that it would light lie in "
        f"shadow, which takes {tried.taken:.2%} of all light ({'' if on else 'not '}at least "
        f"{settings.shadow_min_share:.2%}: shadow_min_share)"
    )
    if on:
        reason += f"; {ms:.0f} ms predicted"
        if kind == "area":
            reason += f", {settings.shadow_samples} samples: penumbras within {error:.3f} rms"
        if tried.shadowed >= 0.995:
            reason += "; it reaches nothing that is seen"
    return Effect(on, reason, numbers)
