"""Small stages written by tests into their tmp_path."""

from __future__ import annotations

from pathlib import Path

from pxr import Gf, Usd, UsdGeom, UsdShade

QUAD_POINTS = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
CUBE_POINTS = [(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
CUBE_INDICES = [
    0,
    2,
    3,
    1,
    4,
    5,
    7,
    6,
    0,
    1,
    5,
    4,
    2,
    6,
    7,
    3,
    0,
    4,
    6,
    2,
    1,
    3,
    7,
    5,
]  # outside counter-clockwise


def new_stage(path: Path, up_axis: str = "Y", meters_per_unit: float = 1.0) -> Usd.Stage:
    """An empty stage that will be saved at `path`."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up_axis)
    UsdGeom.SetStageMetersPerUnit(stage, meters_per_unit)
    return stage


def add_mesh(stage: Usd.Stage, path: str, points, counts, indices, scheme: str = "none") -> UsdGeom.Mesh:
    """A mesh from plain lists."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([Gf.Vec3f(*map(float, p)) for p in points])
    mesh.CreateFaceVertexCountsAttr(list(counts))
    mesh.CreateFaceVertexIndicesAttr(list(indices))
    mesh.CreateSubdivisionSchemeAttr(scheme)
    return mesh


def add_quad(stage: Usd.Stage, path: str) -> UsdGeom.Mesh:
    """A square of side 2 in the plane z = 0, facing +z."""
    return add_mesh(stage, path, QUAD_POINTS, [4], [0, 1, 2, 3])


def add_cube_mesh(stage: Usd.Stage, path: str, scheme: str = "none") -> UsdGeom.Mesh:
    """A cube of side 2 as a mesh of six quads."""
    return add_mesh(stage, path, CUBE_POINTS, [4] * 6, CUBE_INDICES, scheme)


def add_material(stage: Usd.Stage, path: str, **inputs) -> UsdShade.Material:
    """A UsdPreviewSurface material; values of `inputs` are floats, ints or colours."""
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, f"{path}/Surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    for name, value in inputs.items():
        kind = {int: "int", float: "float"}.get(type(value), "color3f")
        prim = shader.GetPrim().CreateAttribute(f"inputs:{name}", _type(kind))
        prim.Set(value if kind != "color3f" else Gf.Vec3f(*value))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", _type("token")))
    return material


def bind(prim, material: UsdShade.Material) -> None:
    """Bind a material directly."""
    UsdShade.MaterialBindingAPI.Apply(getattr(prim, "GetPrim", lambda: prim)()).Bind(material)


def saved(stage: Usd.Stage) -> str:
    """Write the stage and return its file name."""
    stage.GetRootLayer().Save()
    return stage.GetRootLayer().realPath


def _type(name: str):
    from pxr import Sdf

    return Sdf.ValueTypeNames.Find(name)
