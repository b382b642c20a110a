"""What a stage holds, as plain arrays (`SceneData`), and the same on a device (`Scene`).

Frames: *object* (a mesh's own), *world* (the stage's, float64 on the host) and *scene*: world axes with the
origin moved to `Scene.origin` (float64), so that float32 device arrays stay near zero at any stage offset.
Matrices act on columns: `p_world = world_from_object @ [p, 1]`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import warp as wp

from warp_reflect.at_rest import AtRest, placed_normals, placed_points
from warp_reflect.baked_maps import BakedMap
from warp_reflect.bodies import Body, analyse, is_similarity
from warp_reflect.cutouts import Cutouts, no_cutouts
from warp_reflect.launch import Turns
from warp_reflect.topology import closed_ranges, joined_neighbours

wp.set_module_options({"enable_backward": False})


@dataclass(frozen=True)
class Note:
    """One thing a user should know about a prim: repaired, dropped, defaulted, or met and not used."""

    path: str
    text: str


@dataclass(frozen=True)
class Shape:
    """The analytic surface behind a patch of triangles (gprims).

    `kind` "quadric": x^2 + y^2 + a z^2 + b z - c = 0 in the unit frame between z_min and z_max (the form of Lages
    Miguel et al. 2014, equation 1, with the paper's b). `kind` "plane": z = 0 in the unit frame, normal +z.
    """

    kind: str
    unit_from_object: np.ndarray  # float64 [4, 4]
    a: float = 0.0
    b: float = 0.0
    c: float = 0.0
    z_min: float = -np.inf
    z_max: float = np.inf


@dataclass(frozen=True)
class Patch:
    """A contiguous range of a mesh's triangles with one surface."""

    first_triangle: int
    triangle_count: int
    shape: Shape | None = None


@dataclass(frozen=True)
class Part:
    """A contiguous range of a mesh's triangles with one material: the whole mesh, or one GeomSubset."""

    first_triangle: int
    triangle_count: int
    subset: str = ""
    patches: tuple[Patch, ...] = ()  # empty: one patch without a shape


@dataclass
class MeshData:
    """One prototype in object space; triangles are ordered part by part and wound so that outside is counter-clockwise.

    Corner attributes are indexed apart from the points, so that USD point indices stay the topology.
    """

    points: np.ndarray  # float32 [vertex_count, 3]
    triangles: np.ndarray  # int32 [triangle_count, 3]
    normals: np.ndarray | None = None  # float32 [n, 3], unit; None: flat facets
    normal_index: np.ndarray | None = None  # int32 [triangle_count, 3]; None with normals: same as triangles
    uvs: np.ndarray | None = None  # float32 [n, 2]
    uv_index: np.ndarray | None = None
    colors: np.ndarray | None = None  # float32 [n, 3]: a displayColor that varies over the mesh, linear Rec.709
    color_index: np.ndarray | None = None
    parts: list[Part] = field(default_factory=list)  # empty: one part
    double_sided: bool = False


@dataclass
class InstanceData:
    """A mesh placed in the world: one drawn prim."""

    mesh: int
    world_from_object: np.ndarray  # float64 [4, 4]
    prim_path: str
    materials: tuple[int, ...]  # one per part, index into SceneData.materials
    instance: str = ""  # which copy, where several share prim_path (point instancers)
    moves: bool = False  # something of it may be otherwise at another time
    mover: str = ""  # the innermost prim, it or one above it, by which it moves


@dataclass(frozen=True)
class TextureRef:
    """A picture that drives a material parameter: value = scale * texel + bias, of `channel`."""

    file: str  # resolved; "package.usdz[inside.png]" where packed; with "<UDIM>" in it a set of tiles
    channel: str = "rgb"  # or "r", "g", "b", "a", or three of them in another order, as "rrr"
    # "sRGB", "raw"; "raw" wherever the parameter is no colour; "signed": raw, values below 0 too
    color_space: str = "auto"
    wrap: tuple[str, str] = ("useMetadata", "useMetadata")  # or "repeat", "clamp", "mirror", "black"
    scale: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    # Red to alpha; where channel is three letters, the first three belong to those.
    bias: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    uv_name: str = "st"  # the primvar in MeshData.uvs
    # Rows of the affine map from the primvar to picture coordinates, u right and v up: [u, v] = m @ [s, t, 1].
    uv_from_st: tuple[tuple[float, float, float], tuple[float, float, float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


@dataclass(frozen=True)
class MirrorData:
    """What the user asks of a surface as a mirror: on the stage (`WarpReflectMirrorAPI`), or by naming it.

    The material it asks for is in the `MaterialData` that holds this.
    """

    path: str  # the prim with the API, or the pattern
    include: bool = True  # False: never a mirror
    technique: str = "auto"  # as authored: not checked
    reflects: tuple[str, ...] | None = None  # prims that are seen in it, with all below; None: everything


# Share of the light on a surface that neither goes through nor past it, below which the surface casts no shadow.
CASTING_SHARE = 0.5


@dataclass(frozen=True)
class FinishData:
    """What the user asks of a surface for what is seen in it and through it (`WarpReflectFinishAPI`)."""

    path: str  # the prim with the API
    interface: str = "auto"  # or "thin", "solid": how light goes through
    fade_distance: float = 0.0  # over which what is seen in it fades to 1 / e, 0: it does not [scene units]
    fade_color: tuple[float, float, float] = (0.0, 0.0, 0.0)  # what it fades to, radiance
    frost: float = 0.0  # half-angle of the cone into which what is seen through it is scattered [degrees]
    frost_distance: float = 0.0  # over which what is seen through it fades to 1 / e, 0: it does not [scene units]
    frost_color: tuple[float, float, float] = (1.0, 1.0, 1.0)  # what that fades to, radiance
    wave_slope: float = 0.0  # root mean square of the waves' slopes, 0: still
    wave_length: float = 1.0  # of the longest wave [scene units]
    wave_speed: float = 1.0  # of the longest wave [scene units per second]


@dataclass(frozen=True)
class EnvironmentMapData:
    """The place of a reference environment map (`WarpReflectEnvironmentMapAPI`)."""

    path: str
    world_from_map: np.ndarray  # float64 [4, 4]; the eye is the origin
    map_file: str = ""  # resolved; empty: to be rendered
    map_layout: str = ""


@dataclass(frozen=True)
class MaterialData:
    """UsdPreviewSurface parameters; colours linear Rec.709.

    A parameter with a texture holds what to use without it: its authored fallback, else the surface's default; in
    `Scene.data`, where it decides whether the surface is a mirror, the texture's mean.
    """

    path: str = ""
    base_color: tuple[float, float, float] = (0.18, 0.18, 0.18)
    metallic: float = 0.0
    roughness: float = 0.5
    ior: float = 1.5
    specular_workflow: bool = False
    specular_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    opacity: float = 1.0  # share of the surface that is there at all; through the rest one looks straight
    opacity_threshold: float = 0.0  # where the texture of opacity is below it, the surface is not there; 0: no cut-outs
    # Share of the light that enters the surface which goes through instead of being scattered back (glass, water).
    transmission: float = 0.0
    emissive: tuple[float, float, float] = (0.0, 0.0, 0.0)
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.01
    uses_vertex_color: bool = False  # base_color is replaced by MeshData.colors
    textures: dict[str, TextureRef] = field(default_factory=dict)  # by field name: "roughness" ...; "normal"
    mirror: MirrorData | None = None  # None: its values decide whether it is a mirror
    finish: FinishData | None = None


@dataclass(frozen=True)
class LightData:
    """A dome (radiance from all sides), a distant light, or a shape that emits the same radiance everywhere."""

    path: str
    kind: str  # "dome" | "distant" | "sphere" | "rect" | "disk" | "cylinder"
    color: tuple[float, float, float]  # distant: irradiance on a facing surface; all others: radiance
    world_from_light: np.ndarray  # float64 [4, 4]; distant, rect and disk shine along -Z, a cylinder lies along X
    texture: np.ndarray | None = None  # float32 [h, w, 3], linear, latlong in OpenEXR orientation
    # In the light's frame; sphere, disk: (radius,), rect: (width, height), cylinder: (length, radius).
    size: tuple[float, ...] = ()


@dataclass(frozen=True)
class CameraData:
    """A UsdGeomCamera. Apertures and focal length share one unit (tenths of a scene unit), clipping in scene units."""

    path: str
    world_from_camera: np.ndarray  # float64 [4, 4]; looks along -Z, +Y up
    projection: str = "perspective"  # or "orthographic"
    horizontal_aperture: float = 20.955
    vertical_aperture: float = 15.2908
    horizontal_offset: float = 0.0
    vertical_offset: float = 0.0
    focal_length: float = 50.0
    near: float = 1.0
    far: float = 1.0e6


@dataclass
class SceneData:
    """A stage at one time as plain arrays: what crosses a process boundary, and all a `Scene` is made from."""

    source: str
    meshes: list[MeshData]
    instances: list[InstanceData]
    materials: list[MaterialData]
    lights: list[LightData]
    cameras: list[CameraData]
    notes: list[Note] = field(default_factory=list)
    up_axis: str = "Y"
    meters_per_unit: float = 0.01
    time: float | None = None
    time_range: tuple[float, float] | None = None
    time_codes_per_second: float = 24.0
    collections: dict[str, tuple[str, ...]] = field(default_factory=dict)  # "/Prim.collection:name" to member paths
    environment_maps: list[EnvironmentMapData] = field(default_factory=list)
    # By the path of the prim or GeomSubset that carries them; not compared with the geometry yet.
    baked_maps: dict[str, tuple[BakedMap, ...]] = field(default_factory=dict)
    # Textures that were read with the stage, by `pictures.picture_key`, float32 [h, w, 1 or 3]; None: read from files
    # when they are needed.
    pictures: dict[str, np.ndarray] | None = None


# Shape kinds on the device.
SHAPE_NONE = wp.constant(0)
SHAPE_QUADRIC = wp.constant(1)
SHAPE_PLANE = wp.constant(2)


@wp.struct
class PatchView:
    """A patch of one instance: which surface, material and prim its triangles belong to."""

    first_triangle: int
    triangle_count: int
    part: int  # index into Scene.parts
    prim: int  # 1-based id of the prim
    material: int
    double_sided: int
    shape: int
    quadric: wp.vec3  # a, b, c of Shape
    unit_from_scene: wp.mat44


@wp.struct
class MaterialView:
    # As in `textures.Look`, so that vectors read rows of either:
    base_color: wp.vec3
    f0: wp.vec3  # mirror weight at normal incidence
    f90: wp.vec3
    emissive: wp.vec3
    roughness: float
    clearcoat: float
    clearcoat_roughness: float
    clearcoat_f0: float
    opacity: float
    transmission: float
    # And what becomes of them with a colour of the mesh or of a texture:
    metallic: float
    uses_vertex_color: int
    specular_workflow: int


@wp.struct
class SceneView:
    """Device arrays of a scene, in the scene frame."""

    points: wp.array(dtype=wp.vec3)
    triangles: wp.array(dtype=wp.vec3i)
    normals: wp.array(dtype=wp.vec3)
    normal_index: wp.array(dtype=wp.vec3i)  # (-1, -1, -1): flat
    colors: wp.array(dtype=wp.vec3)
    color_index: wp.array(dtype=wp.vec3i)  # length 0 where no mesh has varying colours
    triangle_patch: wp.array(dtype=int)
    patches: wp.array(dtype=PatchView)
    materials: wp.array(dtype=MaterialView)
    cuts: Cutouts


@dataclass(frozen=True)
class PartRange:
    """One (prim instance, material subset) of a `Scene`: what a reflector is."""

    prim_path: str
    subset: str
    instance: str
    prim: int  # 1-based
    material: int
    first_triangle: int
    triangle_count: int
    first_vertex: int  # of the whole instance
    vertex_count: int
    patches: range  # indices into Scene.patch_shapes
    world_from_object: np.ndarray
    is_whole: bool  # no other part shares the vertices


class Scene:
    """A `SceneData` on a device.

    Attributes:
        data: The host arrays it was made from; textured parameters that make a mirror hold the textures' means.
        origin: float64 [3]; scene frame = world - origin.
        view: `SceneView` for kernels.
        parts: `PartRange` per (prim instance, subset), in triangle order.
        notes: What the user should know, one `Note` each.
    """

    def __init__(self, data: SceneData, device: str = "cpu", reload=None, earlier: Scene | None = None):
        """Put a stage's arrays on a device.

        Args:
            data: The arrays.
            device: Warp device.
            reload: Reads the stage at another time, see `at`.
            earlier: The same stage at another time: what does not move is shared with it.
        """
        self.data = self.source_data = data  # the latter as it was read
        self.device = wp.get_device(device)
        self.notes = list(data.notes)
        self._reload = reload
        # Whose turn it is to draw one of the times of a stage, which fit the same trees (`alone`).
        self.turn = Turns() if earlier is None else earlier.turn
        self.bodies: dict[int, Body] = {}
        # (*key of `AtRest`, what) -> what was found out about the shape of what moves, and which one that was.
        self.facts_at_rest: dict = {}
        self.part_tracers: dict = {}
        self.mirror_tracers: dict = {}  # material -> the structure over what a mirror of it may show
        self.seen: dict[int, np.ndarray] = {}  # material -> which triangles a mirror of it may show
        self.fits: dict = {}  # part -> the quadric nearest to it, found by the technique that asks
        self.segmentations: dict = {}  # part -> its sheets (`segments.Segmentation`), likewise
        self.facts: dict = {}  # (what, first triangle of a part) -> what a technique found out about its shape
        # What follows from materials, from which part has which, and from what stands still; shared by all times at which
        # nothing but places differs.
        self.lasting: dict = {}
        self.environments: dict = {}  # environment maps that several mirrors share, by what they were drawn with
        self.pyramids: dict = {}
        self.material_notes: list[Note] = []  # of what was met when the materials were prepared
        self.known_textures: tuple | None = None  # (`textures`, `texture_notes`) of another time
        if earlier is not None:
            from warp_reflect import scene_times

            moved = scene_times.moved_instances(earlier.source_data, data)
            if moved is not None:
                scene_times.lay_out(self, earlier, moved)
                return
        self.origin = _scene_origin(data)
        if any(material.textures for material in data.materials):
            from warp_reflect import pictures

            materials, notes, self.pyramids = pictures.mirror_constants(data)
            self.data = data = replace(data, materials=materials)
            self.notes += [note for note in notes if note not in self.notes]
        self._flatten()
        self.view.cuts = no_cutouts(self.device)
        if any(material.opacity_threshold > 0.0 for material in data.materials):
            from warp_reflect import holes

            self.view.cuts = holes.prepare_cutouts(self, self.pyramids)
        self.material_notes = self.notes[len(data.notes) :]

    @property
    def triangle_count(self) -> int:
        return len(self.host_triangles)

    @property
    def vertex_count(self) -> int:
        return len(self.host_points)

    @property
    def prims(self) -> dict[int, str]:
        """Prim id (1-based, the `primId` channel) to prim path."""
        return {
            i + 1: inst.prim_path + (f"[{inst.instance}]" if inst.instance else "")
            for i, inst in enumerate(self.data.instances)
        }

    @cached_property
    def size(self) -> float:
        """Length of the diagonal of the bounds, in scene units."""
        corners = self.boxes[2].reshape(-1, 3)
        return (float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0) or 1.0

    def at(self, time: float | None) -> Scene:
        """The same stage at another time code.

        What does not change in time is read once and shared; where nothing but cameras moves, so is all that lies on
        the device (`shares_world`).
        """
        if self._reload is None or time == self.data.time:
            return self
        return self._reload(time, self)

    def seen_at(self, data: SceneData) -> Scene | None:
        """This scene with the time, cameras and notes of `data`; None where more than those differ."""
        from warp_reflect.scene_times import same_world

        if not same_world(self.source_data, data):
            return None
        other = copy.copy(self)
        other.data = replace(self.data, time=data.time, cameras=data.cameras, notes=data.notes)
        other.notes = [*data.notes, *self.notes[len(self.source_data.notes) :]]
        other.source_data = data
        return other

    def alone(self) -> AbstractContextManager:
        """In the context no other thread draws or plans a time of the stage, where these fit the same trees to theirs."""
        return self.turn if self.moving_parts and not self.device.is_cuda else nullcontext()

    def shares_world(self, other: Scene) -> bool:
        """Whether two scenes are the same arrays, seen at two times."""
        return self.view is other.view

    def stands_as_in(self, earlier: Scene, part: int) -> bool:
        """Whether a part was laid out with an earlier time of the same stage, and neither moved nor was bent since."""
        return part < len(earlier.parts) and self.parts[part] is earlier.parts[part]

    def kept(self, what: str, given, make: Callable, of: PartRange | None = None):
        """What `make()` gives, made again where `given` is not what it was made for.

        Args:
            what, given, make: Of what was made for several `given`, the last is kept.
            of: None: for this time of the stage alone; a part: for all times until that one moves.
        """
        key = what, None if of is None else of.first_triangle
        known = self.facts.get(key)
        if known is None or known[0] != given:
            known = self.facts[key] = given, make()
        return known[1]

    def kept_always(self, key, make: Callable):
        """What `make()` gives, kept in `lasting`."""
        if key not in self.lasting:
            self.lasting[key] = make()
        return self.lasting[key]

    @cached_property
    def has_hole(self) -> np.ndarray | None:
        """Which triangles may have holes by a texture (`cutouts`), bool [triangle_count]; None: no triangle has."""
        cut = self.view.cuts.of_triangle.numpy()
        return cut >= 0 if len(cut) else None

    @cached_property
    def host_neighbours(self) -> np.ndarray:
        """As `neighbours`; what moves is joined with itself alone, so that they are the same at every time."""
        ranges: dict[int, slice] = {}
        for part in (self.parts[k] for k in self.moving_parts):
            first = ranges[part.prim].start if part.prim in ranges else part.first_triangle
            ranges[part.prim] = slice(first, part.first_triangle + part.triangle_count)
        return joined_neighbours(self.points_at_rest, self.host_triangles, list(ranges.values()))

    @cached_property
    def neighbours(self) -> wp.array:
        """vec3i [triangle_count]: the triangle across each edge (v0v1, v1v2, v2v0), -1 where there is none."""
        return wp.array(self.host_neighbours, dtype=wp.vec3i, device=self.device)

    @cached_property
    def closed_patches(self) -> wp.array:
        """int32 [patches]: 1 where the part is closed and wound outwards: no ray from outside meets its back first."""
        first, count = (
            np.array([getattr(p, name) for p in self.parts], int) for name in ("first_triangle", "triangle_count")
        )
        is_closed = closed_ranges(self.points_at_rest, self.host_triangles, self.host_neighbours, first, count)
        closed = np.zeros(max(len(self.patch_shapes), 1), np.int32)
        for k in np.flatnonzero(is_closed):
            part = self.parts[k]
            if self.has_hole is None or not self.has_hole[part.first_triangle :][: part.triangle_count].any():
                closed[list(part.patches)] = 1
        return wp.array(closed, dtype=int, device=self.device)

    @property
    def points_at_rest(self) -> np.ndarray:
        """`host_points`, those of what moves as the frame of its mesh has them, mirrored where it is: the same at every time."""
        if not self.moving_parts:
            return self.host_points
        points, (first, _) = self.host_points.copy(), first_rows(self.data)
        for k, instance in enumerate(self.data.instances):
            if instance.moves:
                own = self.data.meshes[instance.mesh].points
                mirrored = np.linalg.det(instance.world_from_object[:3, :3]) < 0.0
                points[first[k] : first[k] + len(own)] = own * np.float32([-1.0 if mirrored else 1.0, 1.0, 1.0])
        return points

    @cached_property
    def triangle_records(self) -> wp.array:
        """float32 [triangle_count, 12]: what a ray test reads on one cache line: three corners, then 1 where closed."""
        record = np.zeros((self.triangle_count, 12), np.float32)
        record[:, :9] = self.host_points[self.host_triangles].reshape(-1, 9)
        record[:, 9] = self.closed_patches.numpy()[self.host_triangle_patch]
        return wp.array(record.reshape(-1), dtype=float, device=self.device)

    @cached_property
    def boxes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per instance (first vertex, vertex count, corners of its box, float64 [n, 8, 3], scene frame)."""
        spans = sorted({(part.first_vertex, part.vertex_count) for part in self.parts if part.vertex_count})
        if not spans:
            return np.zeros(0, int), np.zeros(0, int), np.zeros((0, 8, 3))
        first, count = np.array(spans).T
        return first, count, box_corners(self.host_points, first)

    @cached_property
    def tracer(self):
        """The owner of the scene's ray acceleration structure (`bvh.Tracer`), built at first use."""
        from warp_reflect import bvh

        return bvh.Tracer(self)

    def seen_in(self, part: PartRange) -> np.ndarray | None:
        """Which triangles a mirror may show, bool [triangle_count], by its collection; None: all of them."""
        mirror = self.data.materials[part.material].mirror
        if mirror is None or mirror.reflects is None:
            return None
        if part.material not in self.seen:
            members = frozenset(mirror.reflects)
            seen = np.zeros(self.triangle_count, bool)
            for other in self.parts:
                if other.prim_path in members or (other.instance and other.instance.partition(":")[0] in members):
                    seen[other.first_triangle : other.first_triangle + other.triangle_count] = True
            self.seen[part.material] = seen
        return self.seen[part.material]

    def mirror_tracer(self, part: int):
        """The owner of the structure for the rays of a mirror: the scene's, or one over what it may show (`seen_in`)."""
        from warp_reflect import bvh

        seen = self.seen_in(self.parts[part])
        if seen is None:
            return self.tracer
        material = self.parts[part].material
        if material not in self.mirror_tracers:
            self.mirror_tracers[material] = bvh.Tracer(self, seen=seen)
        return self.mirror_tracers[material]

    def part_tracer(self, part: int):
        """The owner of the ray acceleration structure of one part alone (`bvh.Tracer`), built at first use."""
        from warp_reflect import bvh

        if part not in self.part_tracers:
            self.part_tracers[part] = bvh.Tracer(self, part)
        return self.part_tracers[part]

    @cached_property
    def moving_parts(self) -> tuple[int, ...]:
        """Indices of the parts whose prims may be otherwise at another time."""
        return tuple(k for k, part in enumerate(self.parts) if self.data.instances[part.prim - 1].moves)

    @cached_property
    def still_tracer(self):
        """The owner of the structure (`bvh.Tracer`) over all but the moving parts, built at first use."""
        return self._masked_tracer(self._stands_still()) if self.moving_parts else self.tracer

    def _stands_still(self) -> np.ndarray:
        still = np.ones(self.triangle_count, bool)
        for part in (self.parts[k] for k in self.moving_parts):
            still[part.first_triangle : part.first_triangle + part.triangle_count] = False
        return still

    @cached_property
    def shadow_tracer(self):
        """The owner of the structure (`bvh.Tracer`) over what casts shadows: what lets most of the light through does not."""
        casts = self._casts_shadows()
        return self.tracer if casts.all() else self._masked_tracer(casts)

    def _casts_shadows(self) -> np.ndarray:
        casts = np.ones(self.triangle_count, bool)
        for part in self.parts:
            material = self.data.materials[part.material]
            if material.opacity * (1.0 - material.transmission) < CASTING_SHARE:
                casts[part.first_triangle : part.first_triangle + part.triangle_count] = False
        return casts

    def _masked_tracer(self, seen: np.ndarray):
        from warp_reflect import bvh

        return bvh.Tracer(self, seen=seen)

    def with_still_rays(self) -> Scene:
        """The same scene whose rays, those of shadows too, meet nothing that moves."""
        if not self.moving_parts:
            return self
        other = copy.copy(self)
        other.tracer = other.shadow_tracer = self.still_tracer
        if not (casts := self._casts_shadows()).all():
            other.shadow_tracer = self._masked_tracer(casts & self._stands_still())
        return other

    @cached_property
    def lights(self):
        """The lights as kernels read them (`shade.LightView`), prepared at first use."""
        from warp_reflect import shade

        return shade.prepare_lights(self)

    @cached_property
    def textures(self):
        """The textures as kernels look them up (`textures.TextureSet`), read at first use."""
        from warp_reflect import textures

        if self.known_textures is not None:
            made, notes = self.known_textures
            self.notes += [note for note in notes if note not in self.notes]
        else:
            count = len(self.notes)
            made = textures.prepare_textures(self, self.pyramids)
            self.known_textures = made, self.notes[count:]
        return made

    def body(self, part: int) -> Body:
        """The triangles of a part classified as a solid, scene frame."""
        if part not in self.bodies:
            piece = self.parts[part]
            body = self._moving_body(part)
            if body is None:
                first = piece.first_vertex
                faces = self.host_triangles[piece.first_triangle : piece.first_triangle + piece.triangle_count]
                body = analyse(self.host_points[first : first + piece.vertex_count], faces - first)
            if self.has_hole is not None and self.has_hole[piece.first_triangle :][: piece.triangle_count].any():
                body = replace(body, convex=False)  # through its holes it sees its own inside
            self.bodies[part] = body
        return self.bodies[part]

    def _moving_body(self, part: int) -> Body | None:
        """The body of what moves: its mesh's, placed; None as for `at_rest`."""
        rest = self.at_rest(part)
        if rest is None:
            return None
        return self.kept_at_rest(rest, "body", lambda: analyse(*rest.shape()[:2])).placed(rest.scene_from_rest)

    def at_rest(self, part: int) -> AtRest | None:
        """A part that moves, where it does not; None: it never does."""
        prim = self.parts[part].prim
        instance = self.data.instances[prim - 1]
        if not instance.moves:
            return None
        first = part
        while first and self.parts[first - 1].prim == prim:
            first -= 1
        mesh, place = self.data.meshes[instance.mesh], self.scene_from_object(instance)
        own = (mesh.parts or [Part(0, len(mesh.triangles))])[part - first]
        key, stretch = (instance.mesh, part - first), None
        if not is_similarity(place):
            key, stretch, shift = (*key, prim), place[:3, :3].copy(), np.eye(4)
            shift[:3, 3] = place[:3, 3]
            place = shift
        return AtRest(key, mesh, own, place, stretch)

    def kept_at_rest(self, rest: AtRest, what: str, make: Callable):
        """What `make()` gives of a part at rest, kept wherever that stands; of what is stretched until it turns."""
        key, given = (*rest.key, what), b"" if rest.stretch is None else rest.stretch.tobytes()
        known = self.facts_at_rest.get(key)
        if known is None or known[0] != given:
            known = self.facts_at_rest[key] = given, make()
        return known[1]

    def scene_from_object(self, instance: InstanceData) -> np.ndarray:
        """float64 [4, 4] of an instance."""
        matrix = instance.world_from_object.copy()
        matrix[:3, 3] -= self.origin
        return matrix

    def _flatten(self) -> None:
        """Lay instances out one after the other in the scene frame."""
        data = self.data
        points, triangles, normals, normal_index, colors, color_index = [], [], [], [], [], []
        triangle_patch, patches, self.parts, self.patch_shapes = [], [], [], []
        first_vertex = first_triangle = first_normal = first_color = 0
        any_color = any(mesh.colors is not None for mesh in data.meshes)
        for prim, inst in enumerate(data.instances, 1):
            mesh = data.meshes[inst.mesh]
            count = len(mesh.triangles)
            scene_from_object = self.scene_from_object(inst)
            flip = np.linalg.det(scene_from_object[:3, :3]) < 0.0
            order = [0, 2, 1] if flip else [0, 1, 2]
            points.append(placed_points(mesh.points, scene_from_object))
            triangles.append(np.take(mesh.triangles, order, axis=1))
            triangles[-1] += np.int32(first_vertex)
            if mesh.normals is None:
                normal_index.append(np.full((count, 3), -1, np.int32))
            else:
                normals.append(placed_normals(mesh.normals, np.linalg.inv(scene_from_object[:3, :3])))
                index = mesh.triangles if mesh.normal_index is None else mesh.normal_index
                normal_index.append(np.take(index, order, axis=1))
                normal_index[-1] += np.int32(first_normal)
                first_normal += len(mesh.normals)
            if any_color:
                if mesh.colors is None:
                    color_index.append(np.full((count, 3), -1, np.int32))
                else:
                    colors.append(mesh.colors.astype(np.float32))
                    index = mesh.triangles if mesh.color_index is None else mesh.color_index
                    color_index.append(np.take(index, order, axis=1))
                    color_index[-1] += np.int32(first_color)
                    first_color += len(mesh.colors)
            for k, part in enumerate(mesh.parts or [Part(0, count)]):
                material = inst.materials[k]
                first_patch = len(patches)
                for patch in part.patches or (Patch(part.first_triangle, part.triangle_count),):
                    triangle_patch.append(np.full(patch.triangle_count, len(patches), np.int32))
                    own = first_triangle + patch.first_triangle, patch.triangle_count
                    owners = len(self.parts), prim, material, mesh.double_sided
                    patches.append((*own, *owners, *_shape_of(patch.shape, scene_from_object)))
                    self.patch_shapes.append(patch.shape)
                self.parts.append(
                    PartRange(
                        inst.prim_path,
                        part.subset,
                        inst.instance,
                        prim,
                        material,
                        first_triangle + part.first_triangle,
                        part.triangle_count,
                        first_vertex,
                        len(mesh.points),
                        range(first_patch, len(patches)),
                        inst.world_from_object,
                        len(mesh.parts) <= 1,
                    )
                )
            first_vertex += len(mesh.points)
            first_triangle += count
        self.host_points = _stack(points, (0, 3), np.float32)
        self.host_triangles = _stack(triangles, (0, 3), np.int32)
        self.host_triangle_patch = _stack(triangle_patch, (0,), np.int32)
        self.host_normals = _stack(normals, (0, 3), np.float32)
        self.host_normal_index = _stack(normal_index, (0, 3), np.int32)
        view = SceneView()
        # On the CPU the device arrays are the host's own.
        view.points = wp.array(self.host_points, dtype=wp.vec3, device=self.device, copy=False)
        view.triangles = wp.array(self.host_triangles, dtype=wp.vec3i, device=self.device, copy=False)
        view.normals = wp.array(self.host_normals, dtype=wp.vec3, device=self.device, copy=False)
        view.normal_index = wp.array(self.host_normal_index, dtype=wp.vec3i, device=self.device, copy=False)
        view.colors = wp.array(_stack(colors, (0, 3), np.float32), dtype=wp.vec3, device=self.device, copy=False)
        color_index = _stack(color_index, (0, 3), np.int32)
        view.color_index = wp.array(color_index, dtype=wp.vec3i, device=self.device, copy=False)
        view.triangle_patch = wp.array(self.host_triangle_patch, dtype=int, device=self.device, copy=False)
        rows = np.array(patches, PatchView.numpy_dtype())
        view.patches = wp.array(rows, dtype=PatchView, device=self.device)
        view.materials = wp.array([material_view(m) for m in data.materials], dtype=MaterialView, device=self.device)
        self.view = view


def _stack(arrays: list, empty: tuple, dtype) -> np.ndarray:
    if not arrays:
        return np.zeros(empty, dtype)
    return (arrays[0] if len(arrays) == 1 else np.concatenate(arrays)).astype(dtype, copy=False)


def first_rows(data: SceneData) -> tuple[np.ndarray, np.ndarray]:
    """Per instance its first row in a scene's points and in its normals, int [instance_count]."""
    meshes = [data.meshes[instance.mesh] for instance in data.instances]
    points = np.array([len(mesh.points) for mesh in meshes], int)
    normals = np.array([0 if mesh.normals is None else len(mesh.normals) for mesh in meshes], int)
    return np.cumsum(points) - points, np.cumsum(normals) - normals


def box_corners(points: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Corners of the boxes of ranges of points, each from its first to the next one's, float64 [n, 8, 3]."""
    low = np.minimum.reduceat(points, first, axis=0).astype(np.float64)
    high = np.maximum.reduceat(points, first, axis=0).astype(np.float64)
    bits = (np.arange(8)[:, None] >> np.arange(3)) & 1
    return np.where(bits[None] == 1, high[:, None], low[:, None])


def unit_from_scene(unit_from_object: np.ndarray, scene_from_object: np.ndarray) -> np.ndarray:
    """float32 of an analytic surface, [4, 4], or of several, [n, 4, 4]."""
    return (unit_from_object @ np.linalg.inv(scene_from_object)).astype(np.float32)


def _shape_of(shape: Shape | None, scene_from_object: np.ndarray) -> tuple[int, tuple, np.ndarray]:
    """The last three fields of a `PatchView`."""
    if shape is None:
        return SHAPE_NONE, (0.0, 0.0, 0.0), np.eye(4)
    kind = SHAPE_QUADRIC if shape.kind == "quadric" else SHAPE_PLANE
    return kind, (shape.a, shape.b, shape.c), unit_from_scene(shape.unit_from_object, scene_from_object)


def reflectance(material: MaterialData) -> tuple[np.ndarray, np.ndarray]:
    """(F0, F90) of a material's mirror term as UsdPreviewSurface defines it, linear RGB [3] each.

    Source: UsdPreviewSurface specification: metallic workflow F0 = lerp(((1-ior)/(1+ior))^2, baseColor, metallic),
    F90 = lerp(1, baseColor, metallic); specular workflow F0 = specularColor, F90 = 1.
    """
    if material.specular_workflow:
        return np.asarray(material.specular_color, float), np.ones(3)
    base = np.asarray(material.base_color, float)
    dielectric = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
    m = material.metallic
    return (1.0 - m) * dielectric + m * base, (1.0 - m) + m * base


def material_view(material: MaterialData) -> MaterialView:
    """The device form of a material."""
    f0, f90 = reflectance(material)
    view = MaterialView()
    view.base_color = wp.vec3(*material.base_color)
    view.f0 = wp.vec3(*f0)
    view.f90 = wp.vec3(*f90)
    view.emissive = wp.vec3(*material.emissive)
    view.metallic = 0.0 if material.specular_workflow else material.metallic
    view.roughness = material.roughness
    view.clearcoat = material.clearcoat
    view.clearcoat_roughness = material.clearcoat_roughness
    view.clearcoat_f0 = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
    view.opacity = material.opacity
    view.transmission = material.transmission
    view.uses_vertex_color = int(material.uses_vertex_color)
    view.specular_workflow = int(material.specular_workflow)
    return view


def _scene_origin(data: SceneData) -> np.ndarray:
    """Middle of the instances' positions (a median, which one stray prim cannot drag away).

    Of those that do not move, where there are any: the frame of a scene is then the same at every time of its stage.
    """
    if not data.instances:
        return np.zeros(3)
    centres = []
    middles = [_middle(mesh.points) for mesh in data.meshes]
    for inst in [each for each in data.instances if not each.moves] or data.instances:
        centres.append(inst.world_from_object[:3, :3] @ middles[inst.mesh] + inst.world_from_object[:3, 3])
    # Not `np.median`, which imports masked arrays.
    ordered = np.sort(np.asarray(centres), axis=0)
    return 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def _middle(points: np.ndarray) -> np.ndarray:
    return 0.5 * (points.min(axis=0) + points.max(axis=0)).astype(np.float64) if len(points) else np.zeros(3)
