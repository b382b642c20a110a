"""Mirrors by name: the user's word over what the materials say."""

from __future__ import annotations

import dataclasses
import difflib
from fnmatch import fnmatchcase

import numpy as np

from warp_reflect.scene import MaterialData, SceneData, reflectance
from warp_reflect.settings import Settings

OVERRIDDEN = ("metallic", "roughness")
CHROME = (0.55, 0.556, 0.554)  # normal reflectance of polished chromium, linear Rec. 709
REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)


def override_reflectors(
    data: SceneData, patterns: tuple[str, ...] | str, metallic: float = 1.0, roughness: float = 0.0
) -> int:
    """Give what the patterns name a reflective material; the stage itself is not touched.

    Args:
        data: Changed in place: new materials are appended, instances point to them.
        patterns: Each the path or glob of a prim (with all below it), of a GeomSubset, of a point instance
            or of a material; a name or glob without "/" (any prim of that name); or a collection,
            "/Prim.collection:name".
        metallic: The material's new value; 1 reflects with its base colour.
        roughness: The material's new value.

    Returns:
        Parts (prim instances times material subsets) changed.

    Raises:
        ValueError: a pattern that names nothing that is drawn; with the nearest names.
    """
    patterns = (patterns,) if isinstance(patterns, str) else tuple(patterns)
    unused, replaced, changed = set(patterns), {}, 0
    for instance in data.instances:
        parts = data.meshes[instance.mesh].parts
        materials = list(instance.materials)
        for k, index in enumerate(instance.materials):
            subset = parts[k].subset if parts else ""
            names = part_names(instance.prim_path, subset, instance.instance, data.materials[index].path)
            hits = [p for p in patterns if matches(p, names, data.collections)]
            if not hits:
                continue
            unused.difference_update(hits)
            if index not in replaced:
                replaced[index] = len(data.materials)
                data.materials.append(mirrored(data.materials[index], metallic, roughness))
            materials[k] = replaced[index]
            changed += 1
        instance.materials = tuple(materials)
    if unused:
        pattern = min(unused)
        known = {name for i in data.instances for name in (i.prim_path, i.prim_path.rpartition("/")[2])}
        known.update(m.path for m in data.materials if m.path)
        near = difflib.get_close_matches(pattern, sorted(known), n=3, cutoff=0.3)
        raise ValueError(
            f"reflector '{pattern}' names no drawn prim, subset, material or collection"
            + (f"; nearest: {', '.join(near)}" if near else "")
        )
    return changed


def part_names(prim_path: str, subset: str, instance: str, material: str) -> tuple[str, ...]:
    """Every path a pattern may name a part by."""
    names = [prim_path]
    if subset:
        names.append(f"{prim_path}/{subset}")
    names += [f"/{piece.lstrip('/')}" for piece in instance.split("/") if ":" in piece] if instance else []
    if instance:
        names.append(instance)
    if material:
        names.append(material)
    return tuple(names)


def matches(pattern: str, names: tuple[str, ...], collections: dict[str, tuple[str, ...]]) -> bool:
    """Whether a pattern names one of the paths, or something above it."""
    if ".collection:" in pattern:
        members = collections.get(pattern, ())
        return any(_below(member, name) for member in members for name in names)
    if "/" not in pattern:
        return any(fnmatchcase(piece, pattern) for name in names for piece in name.split("/"))
    pattern = pattern.rstrip("/") or "/"
    return any(_below(pattern, name) or fnmatchcase(name, pattern + "/*") for name in names)


def _below(path: str, name: str) -> bool:
    return fnmatchcase(name, path) or name.startswith(f"{path}/")


def mirrored(material: MaterialData, metallic: float, roughness: float) -> MaterialData:
    """The material with another metallic and roughness, constant, in the metallic workflow.

    A metal reflects with its base colour. Where that is too dark to count as a mirror's, or is only the
    fallback of what has no material, the mirror is chrome: who names a mirror wants to see one.
    """
    dropped, base = set(OVERRIDDEN), material.base_color
    unnamed = not material.path and not material.uses_vertex_color
    if unnamed or float(np.dot(base, REC709_LUMINANCE)) < Settings().reflector_min_weight:
        base = CHROME
        dropped.add("base_color")
    return dataclasses.replace(
        material,
        base_color=base,
        metallic=metallic,
        roughness=roughness,
        specular_workflow=False,
        textures={name: ref for name, ref in material.textures.items() if name not in dropped},
    )


def may_reflect(material: MaterialData) -> bool:
    """Whether a material can be a mirror by the default settings; a textured value counts as its best."""
    defaults = Settings()
    roughness = 0.0 if "roughness" in material.textures else material.roughness
    if material.clearcoat >= CLEARCOAT_MIN:
        return True
    best = dataclasses.replace(material, metallic=1.0 if "metallic" in material.textures else material.metallic)
    if "base_color" in material.textures:
        best = dataclasses.replace(best, base_color=(1.0, 1.0, 1.0))
    weight = float(reflectance(best)[0].max())
    return roughness <= defaults.reflector_max_roughness and weight >= defaults.reflector_min_weight


CLEARCOAT_MIN = 0.5  # a coat from here on is a mirror, whatever lies below it
