"""Write the stages of `usd_scenes/`: small, original, one reflection effect or one paper scene each.

`python tools/make_scenes.py [--out DIR] [--only NAME] [--scale K] [--large DIR]`; from a benchmark:
`make_scenes.build("kitchen", "kitchen.usdc", scale=4)`.

Lengths are metres, +Y is up, colours linear Rec.709; two runs write the same bytes. `scale` multiplies the
segments along each direction of every mesh, so triangles grow with its square. Shared objects are files of
their own in `parts/` beside the scene. What a scene expects of a renderer stands in its layer's
`customLayerData["warp_reflect"]`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation, Vt
from scene_parts import LOOKS, PARTS, STAND_BEAD, STAND_RING, Copies, Look, checked_sheet
from scene_shapes import Detail, Surface, block, merge, patch, revolve, rotation, sheet, weld

# Decimals of a coordinate [m] and of a normal in the committed text. On dull things 0.1 mm and half a degree
# are not seen; a mirror's own normals turn rays. Finer builds (scale above 1) are not rounded.
DIGITS = (4, 2)
MIRROR_DIGITS = (6, 4)
MIRROR_PARTS = ("kettle",)


@dataclass
class Writer:
    """A stage being written, and where the parts it references go."""

    stage: Usd.Stage
    detail: Detail
    suffix: str  # of every file: .usda or .usdc
    parts: Path  # their folder
    parts_asset: str  # the same as the stage's layer writes it
    written: set[str] = field(default_factory=set)  # parts this build has written

    def mesh(
        self, path: str, surface: Surface, look: str | None = None, double_sided: bool = False, digits=DIGITS
    ) -> UsdGeom.Mesh:
        """A Mesh prim; without a look its displayColor stands (per face, from the surface's palette)."""
        surface = weld(surface) if surface.normals is None else surface
        prim = UsdGeom.Mesh.Define(self.stage, path)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(self._rounded(surface.points, digits[0])))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(surface.counts.astype(np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.indices.astype(np.int32)))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(prim.GetPointsAttr().Get()))
        if surface.normals is not None:
            prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(self._rounded(surface.normals, digits[1])))
            prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if double_sided:
            prim.CreateDoubleSidedAttr(True)
        if look:
            self.bind(prim.GetPrim(), look)
        elif surface.color_index is not None:
            primvar = prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform)
            primvar.Set(Vt.Vec3fArray([Gf.Vec3f(*c) for c in surface.palette]))
            primvar.SetIndices(Vt.IntArray.FromNumpy(surface.color_index.astype(np.int32)))
        return prim

    def _rounded(self, values: np.ndarray, digits: int) -> np.ndarray:
        if self.detail.scale <= 1.0:
            values = np.round(values, digits) + 0.0  # adding 0 turns -0 into 0
        return values.astype(np.float32)

    def bind(self, prim: Usd.Prim, look: str) -> None:
        root = self.stage.GetDefaultPrim().GetPath()
        scope = UsdGeom.Scope.Define(self.stage, root.AppendChild("Materials"))
        path = scope.GetPath().AppendChild(look)
        material = UsdShade.Material.Get(self.stage, path)
        if not material:
            material = _define_material(self.stage, path, LOOKS[look])
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)

    def sphere(self, path: str, translate, radii, look: str, rotate=(0, 0, 0)) -> UsdGeom.Sphere:
        """A Sphere gprim: one number is its radius, three are half axes (a scale op on radius 1)."""
        prim = UsdGeom.Sphere.Define(self.stage, path)
        scale = None
        if np.ndim(radii) == 0:
            prim.CreateRadiusAttr(float(radii))
        else:
            prim.CreateRadiusAttr(1.0)
            scale = radii
        return self._gprim(prim, translate, rotate, scale, look)

    def cube(self, path: str, bottom, size, look: str, rotate=(0, 0, 0)) -> UsdGeom.Cube:
        """A Cube gprim standing on the middle of its bottom."""
        prim = UsdGeom.Cube.Define(self.stage, path)
        prim.CreateSizeAttr(1.0)
        middle = np.add(bottom, (0, 0.5 * size[1], 0))
        return self._gprim(prim, middle, rotate, size, look)

    def cylinder(self, path: str, bottom, radius: float, height: float, look: str) -> UsdGeom.Cylinder:
        prim = UsdGeom.Cylinder.Define(self.stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.y)
        prim.CreateRadiusAttr(radius)
        prim.CreateHeightAttr(height)
        middle = np.add(bottom, (0, 0.5 * height, 0))
        return self._gprim(prim, middle, (0, 0, 0), None, look)

    def capsule(self, path: str, middle, radius: float, height: float, look: str, rotate=(0, 0, 0)) -> UsdGeom.Capsule:
        prim = UsdGeom.Capsule.Define(self.stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.y)
        prim.CreateRadiusAttr(radius)
        prim.CreateHeightAttr(height)
        return self._gprim(prim, middle, rotate, None, look)

    def _gprim(self, prim, translate, rotate, scale, look):
        prim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode.Default()))
        self.transform(prim, translate, rotate, scale)
        self.bind(prim.GetPrim(), look)
        return prim

    def transform(self, prim, translate, rotate=(0, 0, 0), scale=None) -> None:
        xformable = UsdGeom.Xformable(prim)
        xformable.AddTranslateOp().Set(Gf.Vec3d(*np.round(np.asarray(translate, float), 6).tolist()))
        if any(rotate):
            xformable.AddRotateXYZOp().Set(Gf.Vec3f(*map(float, rotate)))
        if scale is not None:
            xformable.AddScaleOp().Set(Gf.Vec3f(*np.broadcast_to(np.asarray(scale, float), 3).tolist()))

    def part(
        self,
        path: str,
        name: str,
        translate=(0, 0, 0),
        rotate=(0, 0, 0),
        scale=None,
        look=None,
        instance=True,
    ) -> Usd.Prim:
        """A reference to a part file, written at its first use; a native instance by default.

        `look` is bound to the referencing prim: the part's meshes without a look of their own inherit it.
        """
        if name not in self.written:
            self.written.add(name)
            write_part(name, self)
        prim = UsdGeom.Xform.Define(self.stage, path).GetPrim()
        prim.GetReferences().AddReference(f"{self.parts_asset}/{name}{self.suffix}")
        self.transform(prim, translate, rotate, None if scale == 1.0 else scale)
        if instance:
            prim.SetInstanceable(True)
        if look:
            self.bind(prim, look)
        return prim

    def camera(self, eye, target, vertical_fov: float, path: str = "/World/Camera") -> None:
        """A 16:9 camera; vertical field of view in degrees."""
        prim = UsdGeom.Camera.Define(self.stage, path)
        aperture = 0.36  # tenths of a metre: a 36 mm wide film gate
        prim.CreateHorizontalApertureAttr(aperture)
        prim.CreateVerticalApertureAttr(aperture * 9 / 16)
        prim.CreateFocalLengthAttr(round(0.5 * aperture * 9 / 16 / math.tan(math.radians(vertical_fov) / 2), 4))
        prim.CreateClippingRangeAttr(Gf.Vec2f(0.01, 100.0))
        view = np.asarray(target, float) - np.asarray(eye, float)
        pitch = math.degrees(math.atan2(view[1], math.hypot(view[0], view[2])))
        yaw = math.degrees(math.atan2(-view[0], -view[2]))
        self.transform(prim, eye, (round(pitch, 3), round(yaw, 3), 0.0))

    def lights(self, dome=(0.62, 0.7, 0.82), sun: float = 2.2, sun_rotate=(-62, 24, 0)) -> None:
        """A constant dome and a distant light of irradiance `sun` (normalized: whatever its angle)."""
        light = UsdLux.DomeLight.Define(self.stage, "/World/Dome")
        light.CreateColorAttr(Gf.Vec3f(*dome))
        light.CreateIntensityAttr(0.75)
        light = UsdLux.DistantLight.Define(self.stage, "/World/Sun")
        light.CreateColorAttr(Gf.Vec3f(1.0, 0.95, 0.86))
        light.CreateIntensityAttr(sun)
        light.CreateNormalizeAttr(True)
        UsdGeom.Xformable(light).AddRotateXYZOp().Set(Gf.Vec3f(*map(float, sun_rotate)))


def _define_material(stage: Usd.Stage, path: Sdf.Path, look: Look) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    color = Sdf.ValueTypeNames.Color3f
    number = Sdf.ValueTypeNames.Float
    shader.CreateInput("diffuseColor", color).Set(Gf.Vec3f(*look.color))
    shader.CreateInput("metallic", number).Set(look.metallic)
    shader.CreateInput("roughness", number).Set(look.roughness)
    shader.CreateInput("ior", number).Set(1.5)
    if any(look.emissive):
        shader.CreateInput("emissiveColor", color).Set(Gf.Vec3f(*look.emissive))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def _new_stage(path: Path, root: str) -> Usd.Stage:
    """An empty stage on a file, whatever stood there; metres, +Y up, an Xform `root` as default prim."""
    path.parent.mkdir(parents=True, exist_ok=True)
    layer = Sdf.Layer.Find(str(path)) or Sdf.Layer.CreateNew(str(path))
    layer.Clear()
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, f"/{root}").GetPrim())
    return stage


def write_part(name: str, writer: Writer) -> None:
    """Write one shared object: meshes, their materials and copies of other parts under one root prim."""
    root = "".join(word.capitalize() for word in name.split("_"))
    stage = _new_stage(writer.parts / f"{name}{writer.suffix}", root)
    inner = Writer(stage, writer.detail, writer.suffix, writer.parts, ".", writer.written)
    for piece, content, look in PARTS[name](writer.detail):
        if isinstance(content, Copies):
            for k, place in enumerate(content.places):
                inner.part(f"/{root}/{piece}{k}", content.part, place)
        else:
            digits = MIRROR_DIGITS if name in MIRROR_PARTS else DIGITS
            inner.mesh(f"/{root}/{piece}", content, look, digits=digits)
    stage.GetRootLayer().Save()


@dataclass(frozen=True)
class Recipe:
    """How a scene is made, and what it expects of a renderer."""

    make: Callable[[Writer], None]
    description: str
    reflectors: tuple[str, ...]
    techniques: tuple[str, ...] = ("reflector_map", "raytraced")
    max_error_px: float = 0.5
    min_identical: float = 0.999


def build(name: str, path, scale: float = 1.0) -> Path:
    """Write the scene `name` to `path` (.usda or .usdc) and the parts it references beside it.

    Args:
        name: A key of `SCENES`.
        path: The file to write; the parts go to `parts/` (`parts_x<scale>/`) beside it, in the same format.
        scale: Multiplies the segments along each direction of every mesh; triangles grow with its square.

    Raises:
        ValueError: an unknown scene, or a scale that is not above 0.
    """
    if name not in SCENES:
        raise ValueError(f"scene: got '{name}', expected one of {', '.join(SCENES)}")
    if not scale > 0.0:
        raise ValueError(f"scale: got {scale!r}, expected a number above 0")
    path = Path(path).absolute()
    recipe = SCENES[name]
    folder = "parts" if scale == 1.0 else f"parts_x{scale:g}"
    stage = _new_stage(path, "World")
    recipe.make(Writer(stage, Detail(scale), path.suffix, path.parent / folder, f"./{folder}"))
    layer = stage.GetRootLayer()
    layer.customLayerData = {
        "warp_reflect": {
            "description": recipe.description,
            "techniques": Vt.StringArray(list(recipe.techniques)),
            "reflectors": Vt.StringArray(list(recipe.reflectors)),
            "max_error_px": recipe.max_error_px,
            "min_identical": recipe.min_identical,
        }
    }
    layer.Save()
    return path


TABLE = 0.76  # height of the kitchen table's top [m]
ROOM = 2.1  # half the kitchen's width and depth [m]
WALLS = (("Left", 90), ("Front", 180), ("Right", -90))  # about +Y [degrees], from the back wall


def _kitchen(w: Writer) -> None:
    """Three chrome bodies among the things of a laid table, after figure 6 of Estalella et al. 2005."""
    _kitchen_shell(w)
    _kitchen_window(w)
    _kitchen_furniture(w)
    _kitchen_table(w)
    _kitchen_mirrors(w)
    w.camera((0.02, 1.15, 1.4), (0.02, 0.935, 0.0), 32.5)
    w.lights()


def _corner(x: float, z: float, degrees: float) -> tuple[float, float]:
    p = rotation((0, degrees, 0)) @ (x, 0.0, z)
    return round(float(p[0]), 6), round(float(p[2]), 6)


def _kitchen_shell(w: Writer) -> None:
    d, m = w.detail, ROOM
    for name, turn in WALLS:
        upper = sheet((-m, 1.2, -m), (2 * m, 0, 0), (0, 1.4, 0), d.count(7), d.count(3))
        w.mesh(f"/World/Shell/{name}Wall", upper.moved(rotate=(0, turn, 0)), "Plaster")
        x, z = _corner(-m, -m, turn)
        w.part(f"/World/Shell/{name}Tiles", "wall_ochre", (x, 0, z), (0, turn, 0))
    back = [
        sheet((-m, y, -m), (2 * m, 0, 0), (0, h, 0), d.count(7), d.count(n)) for y, h, n in ((0, 0.9, 2), (2.1, 0.5, 1))
    ]
    back += [sheet((x, 1.5, -m), (1.2, 0, 0), (0, 0.6, 0), d.count(3), d.count(2)) for x in (-m, 0.9)]
    w.mesh("/World/Shell/BackWall", merge(*back), "Plaster")
    for row in range(2):
        for column in range(7):
            if row == 0 or column in (0, 1, 5, 6):  # the window is above the others
                w.part(f"/World/Shell/T{row}{column}", "tiles_teal", (-m + 0.6 * column, 0.9 + 0.3 * row, -m))
    for column in range(6):
        w.part(f"/World/Shell/Floor{column}", "floor_strip", (-m + 0.7 * column, 0, m))
    # A roof light, 1.8 m square above the table, through which the distant light falls.
    rim = 0.9
    slabs = [
        sheet((-m, 2.6, -m), (2 * m, 0, 0), (0, 0, m - rim), d.count(7), d.count(2)),
        sheet((-m, 2.6, rim), (2 * m, 0, 0), (0, 0, m - rim), d.count(7), d.count(2)),
        sheet((-m, 2.6, -rim), (m - rim, 0, 0), (0, 0, 2 * rim), d.count(2), d.count(3)),
        sheet((rim, 2.6, -rim), (m - rim, 0, 0), (0, 0, 2 * rim), d.count(2), d.count(3)),
    ]
    w.mesh("/World/Shell/Ceiling", merge(*slabs), "Ceiling")
    for k, x in enumerate((-0.9, -0.3, 0.3, 0.9)):
        w.cube(f"/World/Shell/Beam{k}", (x, 2.56, 0), (0.06, 0.12, 1.86), "PaleWood")
    for k, z in enumerate((-0.9, 0.9)):
        w.cube(f"/World/Shell/Cross{k}", (0, 2.57, z), (1.86, 0.1, 0.06), "PaleWood")


def _kitchen_window(w: Writer) -> None:
    d, z = w.detail, -ROOM
    sky = sheet((-0.9, 1.36, z - 0.06), (1.8, 0, 0), (0, 0.74, 0), d.count(6), d.count(3))
    w.mesh("/World/Window/Sky", sky, "Daylight")
    u = np.linspace(0, 1, d.count(12) + 1)
    hills = np.stack([1.8 * u - 0.9, 1.44 + 0.035 * np.sin(8 * u) + 0.02 * np.sin(19 * u + 1), 0 * u + z - 0.055], -1)
    w.mesh("/World/Window/Meadow", patch(np.stack([hills * (1, 0, 1) + (0, 1.2, 0), hills], 1)), "Meadow")
    for k, x in enumerate((-0.9, -0.3, 0.3, 0.9)):
        w.cube(f"/World/Window/Mullion{k}", (x, 1.2, z), (0.05, 0.9, 0.09), "White")
    for k, y in enumerate((1.19, 1.62, 2.06)):
        w.cube(f"/World/Window/Rail{k}", (0, y, z), (1.85, 0.045, 0.085), "White")
    w.cube("/World/Window/Sill", (0, 1.17, z + 0.05), (1.95, 0.025, 0.17), "PaleWood")
    for k, x in enumerate((-0.6, 0.0, 0.6)):
        w.part(f"/World/Window/Plant{k}", "plant", (x, 1.195, z + 0.07), (0, 70 * k, 0), 0.8)


def _kitchen_furniture(w: Writer) -> None:
    d, m = w.detail, ROOM
    for k in range(7):
        w.part(f"/World/Units/Base{k}", "base_unit", (-m + 0.6 * k, 0, -m))
    w.mesh("/World/Units/Top", block((2 * m, 0.035, 0.62), d, 0.006, 0.6).moved((0, 0.88, -m + 0.31)), "PaleWood")
    for k, x in enumerate((-m, -m + 0.6, 0.9, 1.5)):
        w.part(f"/World/Units/Wall{k}", "wall_unit", (x, 1.5, -m))
    # Right wall: a second run of units under a shelf.
    for k in range(4):
        w.part(f"/World/Units/Side{k}", "base_unit", (m, 0, -0.9 + 0.6 * k), (0, -90, 0))
    w.mesh(
        "/World/Units/SideTop",
        block((0.62, 0.035, 2.4), d, 0.006, 0.6).moved((m - 0.31, 0.88, 0.3)),
        "PaleWood",
    )
    w.cube("/World/Shelf/Board", (m - 0.12, 1.55, 0.3), (0.24, 0.03, 2.0), "DarkWood")
    w.part("/World/Shelf/Books", "book_row", (m - 0.12, 1.58, -0.55), (0, -90, 0))
    for k in range(3):
        w.part(f"/World/Shelf/Jar{k}", "jar", (m - 0.12, 1.58, 0.25 + 0.3 * k), (0, 30 * k, 0))
    # Left wall: a dresser. Front wall: a door and a clock.
    w.cube("/World/Dresser/Body", (-m + 0.22, 0, 0.55), (0.44, 0.92, 1.3), "Teal")
    w.cube("/World/Dresser/Top", (-m + 0.23, 0.92, 0.55), (0.46, 0.03, 1.34), "PaleWood")
    for k in range(3):
        w.cube(f"/World/Dresser/Drawer{k}", (-m + 0.445, 0.08 + 0.28 * k, 0.55), (0.02, 0.25, 1.2), "Cream")
    for k in range(2):
        w.cube(f"/World/Dresser/Board{k}", (-m + 0.13, 1.3 + 0.36 * k, 0.55), (0.26, 0.025, 1.3), "PaleWood")
    for k in range(3):
        z = 0.19 + 0.36 * k
        w.part(f"/World/Dresser/Plate{k}", "plate", (-m + 0.1, 1.455, z), (0, 0, -80))
        w.part(f"/World/Dresser/Cup{k}", "cup", (-m + 0.15, 1.685, z), (0, 40 + 25 * k, 0))
    w.part("/World/Dresser/Bowl", "bowl", (-m + 0.23, 0.95, 0.3))
    w.part("/World/Dresser/Plant", "plant", (-m + 0.23, 0.95, 0.95), scale=1.3)
    w.cube("/World/Door/Leaf", (-0.7, 0, m - 0.02), (0.86, 2.05, 0.04), "Blue")
    for k, (y, h) in enumerate(((0.15, 0.75), (1.05, 0.85))):
        w.cube(f"/World/Door/Panel{k}", (-0.7, y, m - 0.045), (0.6, h, 0.02), "SkyBlue")
    w.part("/World/Clock", "clock", (0.75, 1.9, m - 0.03), (0, 180, 0))
    # On the back counter, and above it.
    for name, x, z, turn, size, look in (
        ("pot", -1.15, -1.72, 25, 1.0, None),
        ("jar", -0.78, -1.86, 0, 1.0, None),
        ("jar", -0.65, -1.82, 40, 0.85, None),
        ("bowl", 0.82, -1.75, 0, 1.0, None),
        ("bottle", 1.12, -1.85, 0, 1.0, "Amber"),
        ("bottle", 1.25, -1.8, 0, 1.0, "Bottle"),
    ):
        path = f"/World/Counter/{name.capitalize()}{round(100 * abs(x))}"
        w.part(path, name, (x, 0.915, z), (0, turn, 0), size, look)
    w.cube("/World/Counter/Rail", (-1.45, 1.4, -m + 0.04), (0.8, 0.012, 0.012), "Steel")
    for k in range(4):
        w.part(f"/World/Counter/Ladle{k}", "ladle", (-1.75 + 0.2 * k, 1.39, -m + 0.06))
    for k, (x, z) in enumerate(((-0.5, -0.3), (0.5, 0.3))):
        w.part(f"/World/Lamp{k}", "lamp", (x, 1.86, z))


def _kitchen_table(w: Writer) -> None:
    t = TABLE
    w.mesh(
        "/World/Table/Board",
        block((1.86, 0.035, 1.26), w.detail, 0.008, 0.6).moved((0, t - 0.038, 0)),
        "Wood",
    )
    for k, (x, z) in enumerate(((-0.85, -0.55), (0.85, -0.55), (-0.85, 0.55), (0.85, 0.55))):
        w.cube(f"/World/Table/Leg{k}", (x, 0, z), (0.07, t - 0.038, 0.07), "Wood")
    for column in range(6):
        w.part(f"/World/Table/Cloth{column}", "cloth_strip", (-0.9 + 0.3 * column, t, 0.6))
    for k, (name, x, z, turn, look) in enumerate(
        (
            ("apple", -0.14, 0.19, 20, "Red"),
            ("apple", -0.235, 0.24, 200, "AppleGreen"),
            ("orange", -0.07, 0.1, 0, None),
            ("lemon", 0.12, 0.19, 35, None),
            ("lemon", 0.2, 0.25, -20, None),
            ("banana", 0.3, 0.26, 12, None),
            ("pear", 0.245, -0.1, 80, None),
            ("pear", -0.59, 0.1, 10, None),
            ("cup", -0.16, -0.3, 215, None),
            ("cup", 0.52, 0.33, -30, None),
            ("bottle", -0.6, -0.3, 0, "Bottle"),
            ("bottle", -0.51, -0.42, 0, "Amber"),
            ("bottle", 0.29, -0.44, 0, "Bottle"),
            ("bowl", 0.66, -0.34, 0, None),
            ("orange", 0.68, 0.03, 60, None),
            ("plate", -0.03, 0.42, 0, None),
            ("plate", -0.56, 0.37, 0, None),
            ("jar", -0.29, -0.46, 0, None),
            ("plant", 0.05, -0.52, 15, None),
        )
    ):
        w.part(f"/World/Table/Item{k:02d}", name, (x, t, z), (0, turn, 0), look=look)
    for k, (name, x, y, z, look) in enumerate(
        (
            ("apple", 0.62, 0.03, -0.37, "Red"),
            ("orange", 0.7, 0.032, -0.38, None),
            ("apple", 0.66, 0.035, -0.29, "AppleGreen"),
            ("lemon", 0.665, 0.085, -0.345, None),
        )
    ):
        w.part(f"/World/Table/Fruit{k}", name, (x, t + y, z), (0, 70 * k, 0), look=look)
    chairs = ((-1.15, 0.05, 90), (1.15, 0.1, -90), (0.4, -0.85, 0), (-0.4, -0.85, 0), (-0.25, 1.0, 180))
    for k, (x, z, turn) in enumerate(chairs):
        w.part(f"/World/Chair{k}", "chair", (x, 0, z), (0, turn, 0))


def _resting_height(half_height: float, radius: float) -> float:
    """Height of the centre of an ellipsoid of revolution (about Y) on a ring stand, just clear of it [m]."""
    # Where the meridian, offset by the bead's radius, passes the ring's circle: bisection on its parameter.
    low, high = 0.0, math.pi / 2
    for _ in range(60):
        t = 0.5 * (low + high)
        normal = np.array([math.sin(t) / radius, math.cos(t) / half_height])
        normal /= np.linalg.norm(normal)
        if radius * math.sin(t) + STAND_BEAD * normal[0] < STAND_RING:
            low = t
        else:
            high = t
    clearance = 0.0005
    return round(half_height * math.cos(low) + STAND_BEAD * normal[1] + STAND_BEAD + clearance, 6)


def _kitchen_mirrors(w: Writer) -> None:
    t = TABLE
    _chrome_kettle(w, (-0.37, t, -0.04), -24)
    w.part("/World/SphereStand", "ring_stand", (0.035, t, -0.17))
    w.sphere("/World/ChromeSphere", (0.035, t + _resting_height(0.168, 0.168), -0.17), 0.168, "Chrome")
    # The long axis, where the ellipsoid is flattest, is what meets the stand first.
    w.part("/World/EllipsoidStand", "ring_stand", (0.43, t, 0.04))
    height = _resting_height(0.135, 0.215)
    w.sphere("/World/ChromeEllipsoid", (0.43, t + height, 0.04), (0.215, 0.135, 0.15), "Chrome", (0, 16, 0))


def _chrome_kettle(w: Writer, at, turn: float) -> None:
    w.part("/World/KettleTrim", "kettle_trim", at, (0, turn, 0))
    w.part("/World/Kettle", "kettle", at, (0, turn, 0), look="Chrome", instance=False)


TOYS = (  # part, x, z, y [m], turn [degrees], size, look
    ("beach_ball", -1.3, -0.9, 0, 20, 1.0, None),
    ("beach_ball", 1.55, 1.5, 0, 80, 1.3, None),
    ("beach_ball", -0.75, 2.05, 0, 45, 0.8, None),
    ("beach_ball", 1.7, -1.7, 0, 10, 0.9, None),
    ("ring_tower", 1.25, -0.75, 0, 0, 1.3, None),
    ("ring_tower", -1.75, 0.9, 0, 30, 1.2, None),
    ("ring_tower", 0.65, 1.95, 0, 30, 1.0, None),
    ("rainbow", 0.0, -1.7, 0, 0, 1.9, None),
    ("rainbow", -1.0, 1.55, 0, 150, 1.2, None),
    ("rainbow", 2.05, 0.35, 0, -90, 1.5, None),
    ("pawn", -0.85, -1.45, 0, 0, 1.6, "Coral"),
    ("pawn", 1.0, 1.15, 0, 0, 1.3, "Coral"),
    ("pawn", -1.9, -0.2, 0, 0, 1.5, "Coral"),
    ("pawn", 0.85, -1.55, 0, 0, 1.6, "SkyBlue"),
    ("pawn", -1.35, 0.55, 0, 0, 1.3, "SkyBlue"),
    ("pawn", 0.1, 2.1, 0, 0, 1.5, "SkyBlue"),
    ("spinning_top", 0.8, 0.55, 0, 0, 1.3, None),
    ("spinning_top", -0.75, 0.75, 0, 0, 1.2, None),
    ("spinning_top", 1.75, -0.4, 0, 0, 1.4, None),
    ("toy_block", -1.6, -1.6, 0, 15, 1.4, "Red"),
    ("toy_block", -1.62, -1.58, 0.336, -20, 1.2, "Blue"),
    ("toy_block", -1.6, -1.62, 0.624, 35, 1.0, "Green"),
    ("toy_block", 1.4, 0.75, 0, 25, 1.1, "Blue"),
    ("toy_block", 1.42, 0.77, 0.264, -12, 1.0, "Green"),
    ("toy_block", -1.95, 1.75, 0, 5, 1.5, "Red"),
    ("toy_block", -1.45, 1.95, 0, 30, 1.2, "Green"),
    ("toy_block", -1.93, 1.77, 0.36, 40, 1.2, "Blue"),
    ("toy_block", 0.55, 1.4, 0, 50, 0.8, "Red"),
    ("toy_block", -0.45, 1.35, 0, 12, 0.8, "Green"),
    ("toy_block", 0.95, 2.2, 0, 22, 1.0, "Purple"),
    ("ring_tower", -1.5, -1.0, 0, 0, 0.9, None),
    ("ring_tower", 2.0, 1.0, 0, 0, 1.1, None),
    ("rainbow", -2.0, 0.3, 0, 80, 1.1, None),
    ("rainbow", 1.3, 1.9, 0, 215, 1.0, None),
    ("beach_ball", 0.35, 1.75, 0, 130, 0.6, None),
    ("beach_ball", -1.45, 1.2, 0, 200, 0.7, None),
    ("spinning_top", -0.2, 1.75, 0, 0, 0.8, None),
    ("spinning_top", -0.4, -1.2, 0, 0, 1.0, None),
    ("pawn", 0.75, 1.65, 0, 0, 0.9, "Lemon"),
    ("pawn", -0.35, 2.15, 0, 0, 1.2, "Green"),
    ("pawn", 1.25, 0.2, 0, 0, 1.1, "Pink"),
    ("pawn", -1.15, -0.3, 0, 0, 1.0, "Lemon"),
)


BALLOONS = (  # x, z, y of the knot [m], look
    (-0.9, 0.95, 1.75, "Red"),
    (-0.62, 1.15, 1.62, "Lemon"),
    (-0.75, 0.6, 1.9, "SkyBlue"),
    (0.85, 1.1, 1.72, "Green"),
    (0.6, 0.8, 1.86, "Pink"),
    (1.05, 0.7, 1.6, "Orange"),
    (0.1, 1.95, 1.8, "Purple"),
    (-0.15, 2.05, 1.65, "Coral"),
    (1.7, -0.1, 1.7, "Lemon"),
    (1.85, -0.5, 1.85, "Red"),
    (-1.75, 0.1, 1.75, "Green"),
    (-1.8, -0.45, 1.6, "Pink"),
    (0.95, -1.3, 1.72, "SkyBlue"),
    (1.3, -1.5, 1.55, "Orange"),
    (-1.0, -1.3, 1.78, "Purple"),
    (0.25, 0.35, 1.98, "Orange"),
    (-0.3, -0.3, 1.95, "Green"),
    (0.35, -0.45, 1.88, "Red"),
)
CEILING = ((0.8, 0.8, 0.78), (0.62, 0.72, 0.8))


def _one_mirror(w: Writer) -> None:
    """One ellipsoid over half of the picture in a toy room; most of what it shows stands around the eye."""
    d, m, high = w.detail, 2.4, 2.4
    for name, turn in (("Back", 0), *WALLS):
        x, z = _corner(-m, -m, turn)
        w.part(f"/World/Room/{name}", "wall_play", (x, 0, z), (0, turn, 0))
    for k in range(5):
        w.part(f"/World/Room/Mats{k}", "mat_strip", (-m - 0.1 + k, 0, m + 0.1))
    ceiling = checked_sheet((-m, high, -m), (2 * m, 0, 0), (0, 0, 2 * m), 12, 12, CEILING, d)
    w.mesh("/World/Room/Ceiling", ceiling)
    for k, (x, z) in enumerate(((-1.2, 0.4), (1.2, 0.4), (0.0, 1.6), (0.0, -1.2))):
        w.cube(f"/World/Room/Light{k}", (x, high - 0.04, z), (0.5, 0.03, 0.5), "Lamp")
    w.cube("/World/Room/Door", (0.9, 0, m - 0.02), (0.85, 1.9, 0.04), "Coral")
    for k, (x, look) in enumerate(((-1.7, "Lemon"), (-0.95, "Pink"), (-0.2, "Green"))):
        w.cube(f"/World/Room/Frame{k}", (x, 1.3, m - 0.02), (0.6, 0.6, 0.04), "White")
        w.cube(f"/World/Room/Picture{k}", (x, 1.36, m - 0.045), (0.48, 0.48, 0.02), look)
    for k, (x, z, y, look) in enumerate(BALLOONS):
        w.part(f"/World/Balloons/B{k:02d}", "balloon", (x, y, z), (0, 0, 3 * (k % 5) - 6), look=look)
    for k, (name, x, z, y, turn, size, look) in enumerate(TOYS):
        w.part(f"/World/Toys/Toy{k:02d}", name, (x, y, z), (0, turn, 0), size, look)
    w.cylinder("/World/Pedestal", (0, 0, 0), 0.15, 0.42, "Wood")
    w.sphere("/World/Mirror", (0, 0.98, 0), (0.81, 0.54, 0.6), "Chrome")
    w.camera((0.0, 1.2, 1.75), (0.0, 0.97, 0.0), 41.0)
    w.lights(sun_rotate=(-50, 24, 0))


CHECKER = ((0.75, 0.73, 0.7), (0.06, 0.09, 0.12))


def _arena(w: Writer, half: float, cells: int) -> None:
    """A checker floor and, around scene and eye, a ring of pillars: else mirrors would show empty sky."""
    floor = checked_sheet((-half, 0, half), (2 * half, 0, 0), (0, 0, -2 * half), cells, cells, CHECKER, w.detail)
    w.mesh("/World/Floor", floor)
    looks = (
        "Red",
        "Cream",
        "Orange",
        "SkyBlue",
        "Lemon",
        "Green",
        "Pink",
        "Teal",
        "Purple",
        "Coral",
        "Leaf",
        "Blue",
    )
    for k, look in enumerate(looks):
        a = math.radians(30 * k + 15)
        height = half * (0.3 + 0.12 * (k * 5 % 4))
        at = (0.95 * half * math.sin(a), 0, 0.95 * half * math.cos(a))
        w.cube(f"/World/Pillar{k:02d}", at, (0.2 * half, height, 0.06 * half), look, (0, 30 * k + 15, 0))


def _boxes(w: Writer, *boxes) -> None:
    """Boxes given as (x, z, width, height, turn [degrees], look)."""
    for k, (x, z, width, height, turn, look) in enumerate(boxes):
        w.cube(f"/World/Box{k}", (x, 0, z), (width, height, width), look, (0, turn, 0))


def _sphere_on_checker(w: Writer) -> None:
    _arena(w, 7.0, 28)
    w.sphere("/World/Mirror", (0, 1.005, 0), 1.0, "Chrome")
    _boxes(
        w,
        (-1.7, 0.6, 0.5, 0.5, 20, "Red"),
        (1.55, 0.9, 0.5, 0.7, 45, "Yellow"),
        (-1.1, 1.9, 0.5, 0.6, 70, "Green"),
        (1.3, -1.6, 0.5, 1.3, 95, "Blue"),
        (0.35, 2.2, 0.3, 0.3, 15, "Orange"),
        (-1.5, -1.5, 0.6, 1.7, 30, "Purple"),
    )
    w.camera((0.6, 2.0, 5.2), (0, 0.95, 0), 31)
    w.lights()


def _ellipsoid_row(w: Writer) -> None:
    _arena(w, 7.0, 28)
    w.sphere("/World/Tall", (-1.75, 1.38, 0), (0.45, 1.35, 0.45), "Chrome")
    w.sphere("/World/Disc", (0, 0.9, 0), (0.8, 0.8, 0.16), "Chrome", (0, 12, 0))
    w.sphere("/World/Cigar", (2.1, 0.5, 0.3), (1.6, 0.32, 0.32), "Chrome", (0, 25, 0))
    looks = ("Red", "Orange", "Lemon", "Green", "SkyBlue", "Purple", "Pink")
    near = [
        (3.0 * math.sin(a), 1.5 * math.cos(a) + 0.3, 0.3, 0.3, 17 * k, looks[k])
        for k, a in enumerate(np.radians(np.linspace(-80, 80, 7)))
    ]
    far = [(-3.0 + k, -2.2, 0.45, 0.6 + 0.2 * (k * 3 % 5), 11 * k, looks[-1 - k]) for k in range(7)]
    _boxes(w, *near, *far)
    w.camera((0.2, 1.9, 6.0), (0.4, 1.15, 0), 36)
    w.lights()


def _capped_cylinder(w: Writer) -> None:
    _arena(w, 7.0, 28)
    w.cylinder("/World/Cylinder", (-0.95, 0.01, 0), 0.65, 1.2, "Chrome")
    w.capsule("/World/Capsule", (1.05, 1.0, 0.1), 0.5, 0.9, "Chrome", (0, 0, 12))
    _boxes(
        w,
        (-2.2, 0.9, 0.4, 0.5, 15, "Red"),
        (0.1, 1.3, 0.4, 0.4, 40, "Yellow"),
        (2.2, 0.9, 0.4, 0.6, 65, "Green"),
        (-0.1, -1.5, 0.4, 0.9, 90, "Blue"),
    )
    w.cube("/World/Board", (0, 2.5, -1.5), (3.6, 0.9, 0.1), "Coral")
    w.camera((0.2, 2.9, 4.9), (0.05, 0.95, 0), 33)
    w.lights()


def _two_spheres(w: Writer) -> None:
    _arena(w, 7.0, 28)
    w.sphere("/World/Left", (-0.95, 0.905, 0), 0.9, "Chrome")
    w.sphere("/World/Right", (1.0, 0.705, 0.35), 0.7, "Chrome")
    _boxes(
        w,
        (-2.1, 0.9, 0.4, 0.4, 15, "Red"),
        (0.1, 1.3, 0.35, 0.35, 40, "Orange"),
        (1.9, 1.3, 0.4, 0.5, 65, "Green"),
        (0.3, -1.4, 0.4, 1.2, 90, "SkyBlue"),
    )
    w.camera((0.1, 1.9, 5.0), (0.0, 0.75, 0), 31)
    w.lights()


def _open_bowl(w: Writer) -> None:
    """A thin double-sided shell: its rim is a border (no closed map holds it) and inside it sees itself."""
    d = w.detail
    _arena(w, 5.0, 16)
    t = np.linspace(-math.pi / 2, -0.1, d.count(10) + 1)
    r, y = np.cos(t), np.sin(t)
    r[0] = 0.0
    shell = revolve(r, 0.8 * y, d.count(32), np.stack([0.8 * r, y], 1))
    bowl = w.mesh("/World/Bowl", shell, "Chrome", double_sided=True, digits=MIRROR_DIGITS)
    w.transform(bowl, (0, 0.86, 0), (24, 0, 10))
    _boxes(
        w,
        (-1.5, 0.7, 0.4, 0.5, 20, "Red"),
        (1.4, 0.9, 0.4, 0.7, 45, "Yellow"),
        (-0.9, -1.5, 0.4, 1.3, 70, "Green"),
        (1.2, -1.5, 0.4, 1.7, 95, "Blue"),
    )
    w.cube("/World/Board", (0, 2.4, -1.8), (3.0, 0.6, 0.1), "Coral")
    w.camera((0.4, 2.6, 3.9), (0, 0.65, 0), 30)
    w.lights()


def _mesh_kettle(w: Writer) -> None:
    _arena(w, 1.4, 28)
    _chrome_kettle(w, (0, 0, 0), -30)
    looks = ("Red", "Orange", "Lemon", "Green", "SkyBlue", "Purple")
    boxes = []
    for k, look in enumerate(looks):
        a = math.radians(60 * k + 30)
        boxes.append((0.34 * math.sin(a), 0.3 * math.cos(a), 0.07, 0.06 + 0.03 * (k * 5 % 6), 23 * k, look))
    _boxes(w, *boxes)
    w.camera((0.1, 0.4, 0.92), (0, 0.165, 0), 25)
    w.lights()


def _far_offset(w: Writer) -> None:
    """sphere_on_checker, camera and lights included, 22,000 km from the origin."""
    near = w.parts.parent / f"sphere_on_checker{w.suffix}"
    build("sphere_on_checker", near, w.detail.scale)
    world = w.stage.GetDefaultPrim()
    world.GetReferences().AddReference(f"./{near.name}")
    w.transform(world, (1e7, 0.0, -2e7))


SCENES = {
    "kitchen": Recipe(
        _kitchen,
        "Chrome mesh, sphere and ellipsoid on a laid kitchen table; after Estalella et al. 2005, figure 6",
        ("/World/Kettle/Body", "/World/ChromeSphere", "/World/ChromeEllipsoid"),
    ),
    "one_mirror": Recipe(_one_mirror, "One ellipsoid over half of the picture in a toy room", ("/World/Mirror",)),
    "sphere_on_checker": Recipe(_sphere_on_checker, "A sphere over a checker floor", ("/World/Mirror",)),
    "ellipsoid_row": Recipe(
        _ellipsoid_row,
        "Ellipsoids of half axes 1:3:1, 1:1:0.2 and 5:1:1 among boxes",
        ("/World/Tall", "/World/Disc", "/World/Cigar"),
    ),
    "capped_cylinder": Recipe(
        _capped_cylinder,
        "A cylinder with flat caps and sharp rims (three surfaces in one mirror) and a capsule",
        ("/World/Cylinder", "/World/Capsule"),
    ),
    "two_spheres": Recipe(_two_spheres, "Two spheres that see each other", ("/World/Left", "/World/Right")),
    "open_bowl": Recipe(
        _open_bowl,
        "An open double-sided bowl: no map can hold it, so it is traced",
        ("/World/Bowl",),
        techniques=("raytraced",),
    ),
    "mesh_kettle": Recipe(_mesh_kettle, "A convex mesh of revolution close up", ("/World/Kettle/Body",)),
    "far_offset": Recipe(
        _far_offset,
        "sphere_on_checker moved by (1e7, 0, -2e7): the picture must not change",
        ("/World/Mirror",),
    ),
}


def triangle_count(path) -> tuple[int, int]:
    """(triangles of meshes and cubes, curved gprims) a stage draws, instances expanded."""
    stage = Usd.Stage.Open(str(path))
    triangles = curved = 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if prim.IsA(UsdGeom.Mesh):
            triangles += int((np.asarray(UsdGeom.Mesh(prim).GetFaceVertexCountsAttr().Get()) - 2).sum())
        elif prim.IsA(UsdGeom.Cube):
            triangles += 12
        elif prim.IsA(UsdGeom.Gprim):
            curved += 1
    return triangles, curved


def validate(path) -> list[str]:
    """What every validator of USD says against a file; empty where it is clean."""
    registry = UsdValidation.ValidationRegistry()
    validators = [registry.GetOrLoadValidatorByName(data.name) for data in registry.GetAllValidatorMetadata()]
    stage = Usd.Stage.Open(str(path))
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{error.GetName()}: {error.GetErrorAsString()}" for error in errors]


# The factor of `--large`: it brings the kitchen and the one mirror scene to millions of triangles.
LARGE_SCALE = 6.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default=Path(__file__).resolve().parent.parent / "usd_scenes", type=Path)
    parser.add_argument("--only", action="append", choices=sorted(SCENES), help="this scene; may be repeated")
    parser.add_argument("--scale", default=1.0, type=float, help="multiplies the segments of every mesh")
    parser.add_argument("--large", type=Path, help="also write million-triangle .usdc versions into this folder")
    args = parser.parse_args()
    jobs = [(name, args.out / f"{name}.usda", args.scale) for name in args.only or SCENES]
    if args.large:
        jobs += [(name, args.large / f"{name}.usdc", LARGE_SCALE) for name in ("kitchen", "one_mirror")]
    failed = False
    folders = set()
    for name, path, scale in jobs:
        build(name, path, scale)
        folders |= {(folder, path.suffix) for folder in path.parent.glob("parts*")}
        triangles, curved = triangle_count(path)
        print(f"{path}: {triangles:,} triangles, {curved} curved gprims, {path.stat().st_size / 1000:.1f} kB")
        failed = _report(path) or failed
    for folder, suffix in sorted(folders):
        parts = sorted(folder.glob(f"*{suffix}"))
        size = sum(part.stat().st_size for part in parts)
        print(f"{folder}: {len(parts)} parts, {size / 1000:.0f} kB")
        for part in parts:
            failed = _report(part) or failed
    return 1 if failed else 0


def _report(path: Path) -> bool:
    errors = validate(path)
    for error in errors:
        print(f"  {path}: {error}")
    return bool(errors)


if __name__ == "__main__":
    raise SystemExit(main())
