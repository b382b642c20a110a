"""Position and normal cube maps of a reflector ("reflector maps"): how they are drawn, and how they are read.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 4.1. What differs:
the map is node-centred and *whitened* (indexed by position / half extents in principal axes), so that long bodies keep
their resolution and faces join without seams; a gprim's nodes lie on its analytic surface.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from warp_reflect.baked_maps import BakedMap
from warp_reflect.bodies import CLOSING_POWER, Sheet, analyse, fit_sheet, weld
from warp_reflect.cubemap import FACE_COUNT, cube_point, face_axes, node_directions
from warp_reflect.launch import launch
from warp_reflect.raster import Picture, make_target, rasterise, resolve_kernel
from warp_reflect.segments import COSINE_MIN, OVERHANG_MAX

wp.set_module_options({"enable_backward": False})


@wp.struct
class ReflectorMapView:
    """Position and normal per node in the reflector's unit frame: texel i is elements 2i (P, mask) and 2i+1 (N, 0).

    The mask is 1 on the reflector and 0 on what closes an open one.
    """

    texels: wp.array(dtype=wp.vec4)
    resolution: int
    extent: wp.vec3  # half extents L; the map is indexed by position / L
    inv_extent: wp.vec3
    inner_radius: float  # the whitened body contains the ball of this radius
    outer_radius: float  # and lies in the ball of this one
    least_curvature: float  # of an ellipsoid with these extents [1/unit]
    greatest_curvature: float
    accepted: float  # residual up to which an answer has a picture


@wp.struct
class MapCell:
    """Where a cube point lies: its first texel of four, and the place between them, 0 to 1 each way."""

    texel: int
    a: float
    b: float


@wp.struct
class MapSample:
    """Surface at a cube point, with derivatives per texel along the face's axes.

    Those of the normal are of the interpolated one over its length: they have a part along the normal, which every
    tangent leaves out.
    """

    cell: MapCell
    p: wp.vec3
    p_u: wp.vec3
    p_v: wp.vec3
    n: wp.vec3
    n_u: wp.vec3
    n_v: wp.vec3


@wp.func
def texel_index(map: ReflectorMapView, face: int, j: int, i: int) -> int:
    return 2 * ((face * map.resolution + j) * map.resolution + i)


@wp.func
def nearest_texel(map: ReflectorMapView, x: wp.vec3) -> int:
    """Index of the texel nearest to a cube point, for its mask."""
    c = cube_point(x)
    scale = 0.5 * float(map.resolution - 1)
    i = wp.clamp(int((c.u + 1.0) * scale + 0.5), 0, map.resolution - 1)
    j = wp.clamp(int((c.v + 1.0) * scale + 0.5), 0, map.resolution - 1)
    return texel_index(map, c.face, j, i)


@wp.func
def map_cell(map: ReflectorMapView, x: wp.vec3) -> MapCell:
    c = cube_point(x)
    scale = 0.5 * float(map.resolution - 1)
    fu = (c.u + 1.0) * scale
    fv = (c.v + 1.0) * scale
    i = wp.clamp(int(fu), 0, map.resolution - 2)
    j = wp.clamp(int(fv), 0, map.resolution - 2)
    cell = MapCell()
    cell.texel = texel_index(map, c.face, j, i)
    cell.a = fu - float(i)
    cell.b = fv - float(j)
    return cell


@wp.func
def least_mask(map: ReflectorMapView, x: wp.vec3) -> float:
    """The least mask of the four texels around a cube point: 0 on the closing part and across its border."""
    t = map_cell(map, x).texel
    below = t + 2 * map.resolution
    return wp.min(
        wp.min(map.texels[t][3], map.texels[t + 2][3]), wp.min(map.texels[below][3], map.texels[below + 2][3])
    )


@wp.func
def xyz(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def sample_map(map: ReflectorMapView, x: wp.vec3) -> MapSample:
    """Bilinear position, normal and their derivatives at a cube point (4 texels)."""
    cell = map_cell(map, x)
    a = cell.a
    b = cell.b
    t00 = cell.texel
    t10 = t00 + 2 * map.resolution
    p00 = xyz(map.texels[t00])
    n00 = xyz(map.texels[t00 + 1])
    p01 = xyz(map.texels[t00 + 2])
    n01 = xyz(map.texels[t00 + 3])
    p10 = xyz(map.texels[t10])
    n10 = xyz(map.texels[t10 + 1])
    p11 = xyz(map.texels[t10 + 2])
    n11 = xyz(map.texels[t10 + 3])
    p_low = p00 + a * (p01 - p00)
    p_high = p10 + a * (p11 - p10)
    n_low = n00 + a * (n01 - n00)
    n_high = n10 + a * (n11 - n10)
    s = MapSample()
    s.cell = cell
    s.p_v = p_high - p_low
    s.p_u = (1.0 - b) * (p01 - p00) + b * (p11 - p10)
    s.p = p_low + b * s.p_v
    raw_v = n_high - n_low
    raw = n_low + b * raw_v
    inv = 1.0 / wp.max(wp.length(raw), 1.0e-20)
    s.n = inv * raw
    s.n_v = inv * raw_v
    s.n_u = inv * ((1.0 - b) * (n01 - n00) + b * (n11 - n10))
    return s


@wp.func
def slide(s: MapSample, along_u: float, along_v: float) -> MapSample:
    """Position and normal a part of a texel on, from the same four texels, but for their twist: along_u along_v of it."""
    moved = MapSample()
    moved.p = s.p + along_u * s.p_u + along_v * s.p_v
    raw = s.n + along_u * s.n_u + along_v * s.n_v
    moved.n = raw * (1.0 / wp.max(wp.length(raw), 1.0e-20))
    return moved


@dataclass(frozen=True)
class ReflectorMap:
    """Position and normal cube maps of a convex body: a closed reflector, or an open one's companion.

    Attributes:
        texels: float32 [6, n, n, 8]: position, mask (1 reflector, 0 its closing part), unit outward normal, 0, unit frame.
        unit_from_body: float64 [4, 4], a similarity: principal axes, centre at 0, largest half extent 1.
        extent: Half extents in the unit frame, float64 [3].
        inner_radius, outer_radius: The whitened body contains, and lies in, these balls.
        view: For kernels, on the device it was made for; of another device see `on`.
        geometry: Digest of what it was drawn from, where that was asked for (`techniques.baking`).
    """

    texels: np.ndarray
    unit_from_body: np.ndarray
    extent: np.ndarray
    inner_radius: float
    outer_radius: float
    view: object
    geometry: str = ""
    _elsewhere: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def on(self, device: wp.DeviceLike) -> ReflectorMap:
        """The same map where a device reaches it: itself, or a copy that is kept."""
        device = wp.get_device(device)
        if self.view.texels.device == device:
            return self
        if device.alias not in self._elsewhere:
            numbers = self.texels, self.unit_from_body, self.extent, self.inner_radius, self.outer_radius
            self._elsewhere[device.alias] = self._of(*numbers, device).of_geometry(self.geometry)
        return self._elsewhere[device.alias]

    @property
    def resolution(self) -> int:
        return self.texels.shape[1]

    @property
    def closed(self) -> bool:
        """Whether every ray from the centre meets the reflector itself."""
        return bool((self.texels[..., 3] > 0.0).all())

    @property
    def bytes(self) -> int:
        return self.texels.nbytes

    @classmethod
    def from_mesh(cls, points, faces, resolution: int = 256, *, normals=None, polish=None, body=None, device="cpu"):
        """Draw the maps of a mesh.

        Args:
            points: Float [vertex_count, 3].
            faces: Int [triangle_count, 3], counter-clockwise seen from outside.
            resolution: Nodes along a cube edge.
            normals: Float [triangle_count, 3, 3] per corner; None: smooth normals from the facets, area weighted.
            polish: Callable (triangle index [k], origin [3], direction [k, 3], distance [k]) -> (distance [k], normal
                [k, 3]) that moves points along their rays onto an analytic surface; None: the facets are the surface.
            body: The mesh's `bodies.Body` where it is known.
            device: Warp device of the view.

        Raises:
            ValueError: The mesh is neither a closed convex body nor an open part of one's surface: no single map holds it;
                or an array has another shape, points that are not finite or out of range, or no area at all.
        """
        points, faces = _checked_mesh(points, faces)
        body = body or analyse(points, faces)
        if not body.convex:
            sheet = None if body.closed else fit_sheet(points[faces], inner=False)
            if sheet is not None and sheet.cosine >= COSINE_MIN and sheet.overhang <= OVERHANG_MAX:
                return cls.from_sheet(points, faces, sheet, resolution, normals=normals, polish=polish, device=device)
            raise ValueError(
                f"faces: {body.reason or 'not convex'}; a reflector map needs a convex body or a part of one"
            )
        return _draw(cls, points, faces, normals, body.centre, body.axes, body.extent, resolution, polish, device)

    @classmethod
    def from_sheet(cls, points, faces, sheet: Sheet, resolution: int = 128, *, normals=None, polish=None, device="cpu"):
        """Draw the maps of an open mesh's convex companion; the mask says which nodes lie on the mesh itself.

        A point has a reflection on an open convex mesh if and only if its reflection on any convex body that holds the
        mesh on its surface falls on the mesh (the path length is convex): so the closing part may have any convex shape.
        This one continues the tangent planes of the rim, so that nothing bends there, and is round beyond.

        Args:
            points: Float [vertex_count, 3].
            faces: Int [triangle_count, 3], counter-clockwise seen from the front.
            sheet: From `bodies.fit_sheet`; with `inner` the companion lies in front, and the normals point away from it.
            resolution: Nodes along a cube edge.
            normals: As for `from_mesh`.
            polish: As for `from_mesh`.
            device: Warp device of the view.

        Raises:
            ValueError: The sheet is not star-shaped about its centre.
        """
        points = np.asarray(points, np.float64)
        faces = np.asarray(faces, np.int32)
        if sheet.cosine <= 0.0:
            raise ValueError("faces: not star-shaped: a ray from the centre meets the sheet from its front")
        normals = _smooth_normals(points, faces) if normals is None else np.asarray(normals, np.float64)
        if sheet.inner:
            faces, normals = faces[:, [0, 2, 1]], -normals[:, [0, 2, 1]]
        rim = _rim(points, faces, normals)
        return _draw(
            cls, points, faces, normals, sheet.centre, sheet.axes, sheet.extent, resolution, polish, device, rim
        )

    @classmethod
    def restored(cls, baked: BakedMap, unit_from_body: np.ndarray, device="cpu"):
        """A map that was drawn before, bit for bit, of a body that may have moved."""
        numbers = baked.texels, unit_from_body, baked.extent, baked.inner_radius, baked.outer_radius
        return cls._of(*numbers, device).of_geometry(baked.geometry)

    def of_geometry(self, digest: str) -> ReflectorMap:
        """The same map with the digest of what it was drawn from."""
        return replace(self, geometry=digest)

    @classmethod
    def _of(cls, texels, unit_from_body, extent, inner, outer, device):
        view = ReflectorMapView()
        view.texels = wp.array(texels.reshape(-1, 4), dtype=wp.vec4, device=device)
        view.resolution = texels.shape[1]
        view.extent = wp.vec3(*extent)
        view.inv_extent = wp.vec3(*(1.0 / extent))
        view.inner_radius = inner
        view.outer_radius = outer
        view.least_curvature = float(extent.min() / extent.max() ** 2)
        view.greatest_curvature = float(extent.max() / extent.min() ** 2)
        closed = bool((texels[..., 3] > 0.0).all())
        view.accepted = CLOSED_ACCEPTED if closed else OPEN_ACCEPTED
        return cls(texels, unit_from_body, extent, inner, outer, view)


def _draw(cls, points, faces, normals, centre, axes, extent, resolution, polish, device, rim=None) -> ReflectorMap:
    """The maps of a body; `rim` (points, normals) is where an open one's companion begins, None of a closed one."""
    scale = 1.0 / float(extent.max())
    unit_from_body = np.eye(4)
    unit_from_body[:3, :3] = scale * axes
    unit_from_body[:3, 3] = -unit_from_body[:3, :3] @ centre
    local = points @ unit_from_body[:3, :3].T + unit_from_body[:3, 3]
    extent = extent * scale
    normals = _smooth_normals(local, faces) if normals is None else np.asarray(normals, np.float64) @ axes.T
    cube = node_directions(resolution)
    directions = cube * extent
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    directions = directions.reshape(-1, 3)
    triangle = _draw_faces((local / extent).astype(np.float32), faces, resolution, closed=rim is None)
    covered = triangle >= 0
    position, normal = np.zeros_like(directions), np.zeros_like(directions)
    position[covered], normal[covered] = _surface_along(
        local, faces, normals, triangle[covered], directions[covered], smooth=polish is None
    )
    if polish is not None:
        distance = np.linalg.norm(position[covered], axis=1) / scale
        distance, body_normal = polish(triangle[covered], centre, directions[covered] @ axes, distance)
        position[covered] = directions[covered] * (distance * scale)[:, None]
        # Outwards from the centre, whatever side the surface is seen from.
        analytic = np.linalg.norm(body_normal, axis=1) > 0.5
        kept = normal[covered]
        kept[analytic] = body_normal[analytic] @ axes.T
        normal[covered] = kept
    heights = []
    if rim is not None:
        rim_points = rim[0] @ unit_from_body[:3, :3].T + unit_from_body[:3, 3]
        rim_normals = rim[1] @ axes.T
        position[~covered], normal[~covered] = _close(directions[~covered], rim_points, rim_normals, extent)
        heights = [_whitened_heights(rim_points, rim_normals, extent)]
    texels = np.zeros((FACE_COUNT, resolution, resolution, 8), np.float32)
    texels[..., 0:3] = position.reshape(cube.shape)
    texels[..., 3] = covered.reshape(cube.shape[:-1])
    texels[..., 4:7] = normal.reshape(cube.shape)
    inner, outer = _whitened_radii(local / extent, faces, position / extent, heights)
    return cls._of(texels, unit_from_body, extent, inner, outer, device)


CLOSED_ACCEPTED = 1.0e-3  # residual (tangent): every vertex of a smooth closed body reaches it
OPEN_ACCEPTED = 0.3  # sheets of general meshes have creases sharper than a texel
RIM_PLANES = 160  # at most so many tangent planes close an open reflector
BLEND_POWER = 8.0


def _checked_mesh(points, faces) -> tuple[np.ndarray, np.ndarray]:
    """A mesh as float64 [n, 3] and int32 [m, 3] that can be analysed."""
    points, faces = np.asarray(points, np.float64), np.asarray(faces)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise ValueError(f"points: got shape {points.shape}, expected [n, 3] of finite numbers")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise ValueError(f"faces: got {faces.dtype} of shape {faces.shape}, expected integers of shape [m, 3]")
    if faces.size and (faces.min() < 0 or faces.max() >= len(points)):
        raise ValueError(f"faces: got {faces.min()} to {faces.max()}, expected 0 to {len(points) - 1}")
    corner = points[faces] - points[faces[:, :1]]
    if not faces.size or not np.any(np.cross(corner[:, 1], corner[:, 2])):
        raise ValueError(f"faces: {len(faces)} triangles without any area, expected the surface of a body")
    return points, faces.astype(np.int32)


def _rim(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of a sheet's border and its unit normals there, [k, 3] each."""
    welded = weld(points, faces)
    start, end = welded.reshape(-1), welded[:, [1, 2, 0]].reshape(-1)
    base = int(welded.max()) + 1
    border = ~np.isin(start * base + end, end * base + start)
    corner = np.flatnonzero(border)
    corner = corner[np.unique(start[corner], return_index=True)[1]]
    corner = corner[np.unique(np.linspace(0, len(corner) - 1, min(len(corner), RIM_PLANES)).astype(np.int64))]
    return points[faces.reshape(-1)[corner]], normals.reshape(-1, 3)[corner]


def _close(directions, rim_points, rim_normals, extent) -> tuple[np.ndarray, np.ndarray]:
    """Where rays from 0 leave the companion: the rim's tangent planes, blended into the superellipsoid that closes it.

    The gauge is (g_planes^q + g_closing^q)^(1/q): convex as a norm of convex gauges, and without an edge for a search to
    stumble over; at the rim, where g_closing is at most `CLOSING_GAUGE`, it differs from the planes' by 0.4 %.
    """
    heights = np.einsum("ij,ij->i", rim_normals, rim_points)
    planes = rim_normals[heights > 0.0] / heights[heights > 0.0, None]
    x = np.abs(directions) / extent
    total = (x**CLOSING_POWER).sum(axis=1)
    closing = total ** (1.0 / CLOSING_POWER)
    gradient = np.sign(directions) * x ** (CLOSING_POWER - 1.0) / extent
    gradient *= (total ** (1.0 / CLOSING_POWER - 1.0))[:, None]
    flat, plane = np.zeros(len(directions)), np.zeros_like(directions)
    if len(planes):
        for first in range(0, len(directions), 8192):
            block = slice(first, first + 8192)
            towards = directions[block] @ planes.T
            nearest = towards.argmax(axis=1)
            flat[block] = np.maximum(towards[np.arange(len(nearest)), nearest], 0.0)
            plane[block] = planes[nearest]
    gauge = (flat**BLEND_POWER + closing**BLEND_POWER) ** (1.0 / BLEND_POWER)
    normal = plane * (flat ** (BLEND_POWER - 1.0))[:, None] + gradient * (closing ** (BLEND_POWER - 1.0))[:, None]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return directions / gauge[:, None], normal


def _smooth_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted vertex normals at the corners, float64 [triangle_count, 3, 3]."""
    corner = points[faces]
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    vertex = np.zeros_like(points)
    for k in range(3):
        np.add.at(vertex, faces[:, k], facet)
    vertex /= np.maximum(np.linalg.norm(vertex, axis=1, keepdims=True), 1.0e-300)
    return vertex[faces]


def _draw_faces(whitened: np.ndarray, faces: np.ndarray, resolution: int, closed: bool) -> np.ndarray:
    """Triangle seen from the centre at every node, int [6 n n], -1 none; pixel centres of the rasteriser are the nodes."""
    n = resolution
    half = 0.5 * (n - 1)
    triangles = wp.array(faces, dtype=wp.vec3i, device="cpu")
    picture = Picture((n, n), near=1.0e-6, far=1.0e6)
    result = np.empty((FACE_COUNT, n * n), np.int64)
    for face in range(FACE_COUNT):
        k, ku, kv, sign = face_axes(face)
        depth = sign * whitened[:, k]
        screen = np.zeros((len(whitened), 4), np.float32)
        front = depth > picture.near
        safe = np.where(front, depth, 1.0)
        x = half * whitened[:, ku] + 0.5 * n * depth
        y = half * whitened[:, kv] + 0.5 * n * depth
        screen[:, 0] = np.where(front, x / safe, x)
        screen[:, 1] = np.where(front, y / safe, y)
        screen[:, 2] = np.where(front, 1.0 / safe, 0.0)
        screen[:, 3] = depth
        target = make_target(picture, (0, 0, n, n), "cpu")
        rasterise(target, wp.array(screen, dtype=wp.vec4, device="cpu"), triangles)
        drawn = wp.empty(n * n, dtype=int, device="cpu")
        launch(resolve_kernel, n * n, [target.key, drawn, wp.empty(n * n, dtype=float, device="cpu")], "cpu")
        result[face] = drawn.numpy()
    drawn = result.reshape(FACE_COUNT, n, n)
    return (_fill_gaps(drawn) if closed else drawn).reshape(-1)


def _fill_gaps(triangle: np.ndarray) -> np.ndarray:
    """A node that no triangle covers (the snapping of a corner in the picture of a face's rim) takes a neighbour's."""
    for axis in (1, 2):
        for shift in (1, -1):
            empty = triangle < 0
            if not empty.any():
                return triangle
            triangle = np.where(empty, np.roll(triangle, shift, axis), triangle)
    if (triangle < 0).any():
        raise ValueError("faces: rays from the centre meet no triangle; the body is not closed")
    return triangle


def _surface_along(points, faces, normals, triangle, directions, smooth) -> tuple[np.ndarray, np.ndarray]:
    """Point and interpolated unit normal where the rays from 0 meet the given triangles' planes.

    With `smooth` the points are moved along their rays onto the surface that the corner normals describe: half the way
    to Phong's (Boubekeur and Alexa, "Phong Tessellation", 2008), which reproduces the sagitta k h^2 / 8 of an edge.
    """
    corner = points[faces[triangle]]
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    weights = np.stack([np.einsum("ij,ij->i", directions, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], axis=1)
    weights = np.maximum(weights, 0.0)  # a node on an edge may lie outside by the rasteriser's 1/256 of a node
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0e-300)
    facet = np.cross(b - a, c - a)
    distance = np.einsum("ij,ij->i", facet, a) / np.einsum("ij,ij->i", facet, directions)
    normal = np.einsum("ik,ikj->ij", weights, normals[triangle])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-300)
    position = directions * distance[:, None]
    if smooth:
        tangent = np.zeros_like(position)
        for k, vertex in enumerate((a, b, c)):
            n = normals[triangle, k]
            above = np.einsum("ij,ij->i", position - vertex, n)
            tangent -= (weights[:, k] * above)[:, None] * n
        along = np.einsum("ij,ij->i", directions, normal)
        lift = np.einsum("ij,ij->i", tangent, normal) / np.where(along > PHONG_COS_MIN, along, np.inf)
        position += PHONG_SHARE * lift[:, None] * directions
    return position, normal


PHONG_SHARE = 0.5
PHONG_COS_MIN = 0.05  # of a ray and the normal; a grazing ray would be moved too far along itself


def _whitened_heights(points: np.ndarray, normals: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """Distances of planes from the centre in whitened space."""
    return np.einsum("ij,ij->i", points, normals) / np.maximum(np.linalg.norm(normals * extent, axis=1), 1.0e-300)


def _whitened_radii(whitened, faces: np.ndarray, nodes: np.ndarray, others: list) -> tuple[float, float]:
    """Radii of a ball inside and a ball around the convex body in whitened space, with a margin for float32."""
    corner = whitened[faces]
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(facet, axis=1)
    solid = area > 1.0e-9 * area.max()
    height = np.einsum("ij,ij->i", facet[solid], corner[solid][:, 0]) / area[solid]
    outer = max(
        float(np.linalg.norm(whitened[faces.reshape(-1)], axis=1).max()), float(np.linalg.norm(nodes, axis=1).max())
    )
    inner = max(float(np.concatenate([height, *others]).min()), 0.0)
    return inner * (1.0 - 1.0e-5), outer * (1.0 + 1.0e-5)
