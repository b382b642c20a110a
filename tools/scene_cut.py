"""Scenes of surfaces that textures cut holes into."""

from __future__ import annotations

import numpy as np
from pxr import Gf, Sdf, UsdGeom, UsdShade
from scene_sets import arena, boxes
from scene_shapes import sheet
from scene_writer import MIRROR_DIGITS, Recipe, Writer

from warp_reflect.images import write_png

LATTICE, LEAF = "lattice.png", "leaf.png"
SIDE = 128  # texels


def _opacities() -> dict[str, np.ndarray]:
    """By file name: how opaque a lattice fence and a lobed leaf are, [SIDE, SIDE] 0 to 1, with soft outlines."""
    y, x = (np.mgrid[0:SIDE, 0:SIDE] + 0.5) / SIDE
    slats = np.minimum(*(np.abs((4 * across) % 1.0 - 0.5) for across in (x + y, x - y)))
    r, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    lobes = 0.34 + 0.12 * np.cos(5 * angle)
    return {LATTICE: np.clip(0.5 + 8.0 * (0.13 - slats), 0, 1), LEAF: np.clip(0.5 + 25.0 * (lobes - r), 0, 1)}


def _cut_material(w: Writer, name: str, color, file: str) -> UsdShade.Material:
    """A matt material that is there where a picture is at least half white."""
    path = f"/World/Materials/{name}"
    UsdGeom.Scope.Define(w.stage, "/World/Materials")
    kinds = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(w.stage, path)
    nodes = {}
    for node, kind in (
        ("Surface", "UsdPreviewSurface"),
        ("Picture", "UsdUVTexture"),
        ("St", "UsdPrimvarReader_float2"),
    ):
        nodes[node] = UsdShade.Shader.Define(w.stage, f"{path}/{node}")
        nodes[node].CreateIdAttr(kind)
    nodes["St"].CreateInput("varname", kinds.String).Set("st")
    picture = nodes["Picture"]
    picture.CreateInput("file", kinds.Asset).Set(f"{w.parts_asset}/{file}")
    picture.CreateInput("sourceColorSpace", kinds.Token).Set("raw")
    for wrap in ("wrapS", "wrapT"):
        picture.CreateInput(wrap, kinds.Token).Set("clamp")
    picture.CreateInput("st", kinds.Float2).ConnectToSource(nodes["St"].CreateOutput("result", kinds.Float2))
    surface = nodes["Surface"]
    surface.CreateInput("diffuseColor", kinds.Color3f).Set(Gf.Vec3f(*color))
    surface.CreateInput("roughness", kinds.Float).Set(0.9)
    surface.CreateInput("opacityThreshold", kinds.Float).Set(0.5)
    surface.CreateInput("opacity", kinds.Float).ConnectToSource(picture.CreateOutput("r", kinds.Float))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", kinds.Token))
    return material


def _card(w: Writer, path: str, corner, along, up, material: UsdShade.Material) -> None:
    """A rectangle that a whole picture covers."""
    card = w.mesh(path, sheet(corner, along, up, 1, 1), double_sided=True)
    points = np.array(card.GetPointsAttr().Get()) - np.asarray(corner, float)
    along, up = np.asarray(along, float), np.asarray(up, float)
    st = np.stack([points @ along / (along @ along), points @ up / (up @ up)], axis=-1)
    primvar = UsdGeom.PrimvarsAPI(card).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex)
    primvar.Set([Gf.Vec2f(*map(float, each)) for each in np.round(st, 4)])
    UsdShade.MaterialBindingAPI.Apply(card.GetPrim()).Bind(material)


def _cut_outs(w: Writer) -> None:
    """A lattice fence and leaves, cut out of cards, before a flat mirror and a chrome ball; the sun shines through them."""
    w.parts.mkdir(parents=True, exist_ok=True)
    for file, opacity in _opacities().items():
        write_png(w.parts / file, np.repeat(opacity[..., None], 3, axis=2).astype(np.float32))
    arena(w, 6.0, 24)
    wood = _cut_material(w, "CutLattice", (0.55, 0.33, 0.16), LATTICE)
    leaf = _cut_material(w, "CutLeaf", (0.16, 0.5, 0.14), LEAF)
    _card(w, "/World/Fence", (-2.1, 0.02, 0.3), (1.5, 0, 0.5), (0, 1.3, 0), wood)
    for k, (x, y, z, size) in enumerate(((0.9, 0.4, 1.0, 0.6), (1.25, 0.75, 0.85, 0.5), (0.75, 0.85, 0.7, 0.5))):
        _card(w, f"/World/Leaves/Leaf{k}", (x, y, z), (size, 0.1, -0.2), (-0.1, size, 0.15), leaf)
    glass = sheet((-2.2, 0.05, -1.9), (4.4, 0, 0), (0, 2.0, 0), w.detail.count(1), w.detail.count(1))
    w.mesh("/World/Mirror", glass, "Chrome", digits=MIRROR_DIGITS)
    w.sphere("/World/Ball", (0.1, 0.605, -0.5), 0.6, "Chrome")
    boxes(
        w, (-1.0, 1.3, 0.35, 0.35, 20, "Red"), (1.7, 0.2, 0.4, 0.8, 50, "Yellow"), (-0.9, -0.9, 0.3, 0.5, 10, "SkyBlue")
    )
    w.camera((0.15, 1.5, 4.4), (0.0, 0.75, -0.5), 34)
    w.lights()


CUT_SCENES = {
    "cut_outs": Recipe(
        _cut_outs,
        "A lattice fence and leaves that textures cut out of cards, before a flat mirror and a ball",
        ("/World/Mirror", "/World/Ball"),
        techniques=("planar", "quadric", "reflector_map", "raytraced"),
    ),
}
