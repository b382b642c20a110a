"""Writing a stage from shapes, gprims, looks and shared parts (`Writer`), and what a scene is made by (`Recipe`)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, Vt
from scene_parts import LOOKS, PARTS, Copies, Look
from scene_shapes import Detail, Surface, weld

# Decimals of a coordinate [m] and of a normal in the committed text. On dull things 0.1 mm and half a degree
# are not seen; a mirror's own normals turn rays. Finer builds (scale above 1) are not rounded.
DIGITS = (4, 2)
MIRROR_DIGITS = (6, 4)
MIRROR_PARTS = ("kettle", "car_shell", "city_car")


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
        surface = weld(surface) if surface.normals is None and surface.scheme == "none" else surface
        prim = UsdGeom.Mesh.Define(self.stage, path)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(self._rounded(surface.points, digits[0])))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(surface.counts.astype(np.int32)))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(surface.indices.astype(np.int32)))
        prim.CreateSubdivisionSchemeAttr(surface.scheme)
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
            material = define_material(self.stage, path, LOOKS[look])
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

    def cone(self, path: str, bottom, radius: float, height: float, look: str) -> UsdGeom.Cone:
        prim = UsdGeom.Cone.Define(self.stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.y)
        prim.CreateRadiusAttr(radius)
        prim.CreateHeightAttr(height)
        middle = np.add(bottom, (0, 0.5 * height, 0))
        return self._gprim(prim, middle, (0, 0, 0), None, look)

    def cylinder(
        self, path: str, bottom, radius: float, height: float, look: str, rotate=(0, 0, 0)
    ) -> UsdGeom.Cylinder:
        """A Cylinder gprim along its own Y, standing on the middle of its bottom before it is turned about its middle."""
        prim = UsdGeom.Cylinder.Define(self.stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.y)
        prim.CreateRadiusAttr(radius)
        prim.CreateHeightAttr(height)
        middle = np.add(bottom, (0, 0.5 * height, 0))
        return self._gprim(prim, middle, rotate, None, look)

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

    def lamp(self, path: str, at, radius: float, radiance: float) -> None:
        """A SphereLight of this surface radiance, warm."""
        light = UsdLux.SphereLight.Define(self.stage, path)
        light.CreateRadiusAttr(radius)
        light.CreateColorAttr(Gf.Vec3f(1.0, 0.86, 0.66))
        light.CreateIntensityAttr(radiance)
        self.transform(light, at)

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

    def room_lights(self, height: float, radius: float, irradiance: float = 2.2, dome=(0.62, 0.7, 0.82)) -> None:
        """A constant dome, and below a ceiling that no sun falls through a ball that gives the floor this irradiance."""
        light = UsdLux.DomeLight.Define(self.stage, "/World/Dome")
        light.CreateColorAttr(Gf.Vec3f(*dome))
        light.CreateIntensityAttr(0.75)
        self.lamp("/World/Lamp", (0, height, 0), radius, round(irradiance / math.pi * (height / radius) ** 2, 2))


def define_material(stage: Usd.Stage, path: Sdf.Path, look: Look) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, path)
    shader = UsdShade.Shader.Define(stage, path.AppendChild("Surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    color = Sdf.ValueTypeNames.Color3f
    number = Sdf.ValueTypeNames.Float
    shader.CreateInput("diffuseColor", color).Set(Gf.Vec3f(*look.color))
    shader.CreateInput("metallic", number).Set(look.metallic)
    shader.CreateInput("roughness", number).Set(round(look.roughness, 4))
    shader.CreateInput("ior", number).Set(look.ior)
    if look.opacity < 1.0:
        shader.CreateInput("opacity", number).Set(look.opacity)
    if look.clearcoat > 0.0:
        shader.CreateInput("clearcoat", number).Set(look.clearcoat)
        shader.CreateInput("clearcoatRoughness", number).Set(0.0)
    if any(look.emissive):
        shader.CreateInput("emissiveColor", color).Set(Gf.Vec3f(*look.emissive))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    return material


def new_stage(path: Path, root: str) -> Usd.Stage:
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
    stage = new_stage(writer.parts / f"{name}{writer.suffix}", root)
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
    """How a scene is made, and what it expects of a renderer.

    Attributes:
        make: Fills a new stage.
        description: One line.
        reflectors: Paths of all mirrors.
        techniques: Each is taken by one mirror at least where it is asked for.
        allowed: May be taken as well; what is in neither is taken by no mirror.
        max_error_px: Of the pixels that do not show what the reference shows.
        min_identical: Share of the interior mirror pixels.
    """

    make: Callable[[Writer], None]
    description: str
    reflectors: tuple[str, ...]
    techniques: tuple[str, ...] = ("quadric", "reflector_map", "raytraced")
    allowed: tuple[str, ...] = ()
    max_error_px: float = 0.5
    min_identical: float = 0.999
