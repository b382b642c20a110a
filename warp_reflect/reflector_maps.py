"""Position and normal cube maps of a reflector ("reflector maps"): how they are drawn, and how they are read.

Source: Estalella et al., "Accurate Interactive Specular Reflections on Curved Objects" (2005), section 4.1. What differs:
the map is node-centred and *whitened* (indexed by position / half extents in principal axes), so that long bodies keep
their resolution and faces join without seams; a gprim's nodes lie on its analytic surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.bodies import analyse
from warp_reflect.cubemap import FACE_COUNT, cube_point, face_axes, node_directions
from warp_reflect.launch import launch
from warp_reflect.layers import CameraView
from warp_reflect.raster import make_target, rasterise, resolve_kernel

wp.set_module_options({"enable_backward": False})


@wp.struct
class ReflectorMapView:
    """Position and normal per node in the reflector's unit frame: texel i is elements 2i (P, 0) and 2i+1 (N, 0)."""

    texels: wp.array(dtype=wp.vec4)
    resolution: int
    extent: wp.vec3  # half extents L; the map is indexed by position / L
    inv_extent: wp.vec3
    inner_radius: float  # the whitened body contains the ball of this radius
    outer_radius: float  # and lies in the ball of this one
    least_curvature: float  # of an ellipsoid with these extents [1/unit]


@wp.struct
class MapSample:
    """Surface at a cube point, with derivatives by the face coordinates."""

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
def xyz(v: wp.vec4) -> wp.vec3:
    return wp.vec3(v[0], v[1], v[2])


@wp.func
def sample_map(map: ReflectorMapView, x: wp.vec3) -> MapSample:
    """Bilinear position, normal and their derivatives at a cube point (4 texels)."""
    c = cube_point(x)
    scale = 0.5 * float(map.resolution - 1)
    fu = (c.u + 1.0) * scale
    fv = (c.v + 1.0) * scale
    i = wp.clamp(int(fu), 0, map.resolution - 2)
    j = wp.clamp(int(fv), 0, map.resolution - 2)
    a = fu - float(i)
    b = fv - float(j)
    t00 = texel_index(map, c.face, j, i)
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
    s.p = p_low + b * (p_high - p_low)
    s.p_v = scale * (p_high - p_low)
    s.p_u = scale * ((1.0 - b) * (p01 - p00) + b * (p11 - p10))
    raw = n_low + b * (n_high - n_low)
    inv = 1.0 / wp.max(wp.length(raw), 1.0e-20)
    n = raw * inv
    n_v = scale * inv * (n_high - n_low)
    n_u = scale * inv * ((1.0 - b) * (n01 - n00) + b * (n11 - n10))
    s.n = n
    s.n_u = n_u - wp.dot(n_u, n) * n
    s.n_v = n_v - wp.dot(n_v, n) * n
    return s


@dataclass(frozen=True)
class ReflectorMap:
    """Position and normal cube maps of a closed, convex body.

    Attributes:
        texels: float32 [6, n, n, 8]: position, 0, unit normal, 0, in the unit frame.
        unit_from_body: float64 [4, 4], a similarity: principal axes, centre at 0, largest half extent 1.
        extent: Half extents in the unit frame, float64 [3].
        inner_radius, outer_radius: The whitened body contains, and lies in, these balls.
        view: For kernels.
    """

    texels: np.ndarray
    unit_from_body: np.ndarray
    extent: np.ndarray
    inner_radius: float
    outer_radius: float
    view: object

    @property
    def resolution(self) -> int:
        return self.texels.shape[1]

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
            ValueError: The mesh is open, not star-shaped or not convex: no single-valued map holds it.
        """
        points = np.asarray(points, np.float64)
        faces = np.asarray(faces, np.int32)
        body = body or analyse(points, faces)
        if not body.convex:
            raise ValueError(f"faces: {body.reason or 'not convex'}; a reflector map needs a closed convex body")
        scale = 1.0 / float(body.extent.max())
        unit_from_body = np.eye(4)
        unit_from_body[:3, :3] = scale * body.axes
        unit_from_body[:3, 3] = -unit_from_body[:3, :3] @ body.centre
        local = points @ unit_from_body[:3, :3].T + unit_from_body[:3, 3]
        extent = body.extent * scale
        normals = _smooth_normals(local, faces) if normals is None else np.asarray(normals, np.float64) @ body.axes.T
        cube = node_directions(resolution)
        directions = cube * extent
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        triangle = _draw_faces((local / extent).astype(np.float32), faces, resolution)
        position, normal = _surface_along(local, faces, normals, triangle, directions.reshape(-1, 3))
        if polish is not None:
            world_directions = directions.reshape(-1, 3) @ body.axes
            distance = np.linalg.norm(position, axis=1) / scale
            distance, body_normal = polish(triangle, body.centre, world_directions, distance)
            position = directions.reshape(-1, 3) * (distance * scale)[:, None]
            analytic = np.linalg.norm(body_normal, axis=1) > 0.5
            normal[analytic] = body_normal[analytic] @ body.axes.T
        texels = np.zeros((FACE_COUNT, resolution, resolution, 8), np.float32)
        texels[..., 0:3] = position.reshape(cube.shape)
        texels[..., 4:7] = normal.reshape(cube.shape)
        inner, outer = _whitened_radii(local / extent, faces, position / extent)
        view = ReflectorMapView()
        view.texels = wp.array(texels.reshape(-1, 4), dtype=wp.vec4, device=device)
        view.resolution = resolution
        view.extent = wp.vec3(*extent)
        view.inv_extent = wp.vec3(*(1.0 / extent))
        view.inner_radius = inner
        view.outer_radius = outer
        view.least_curvature = float(extent.min() / extent.max() ** 2)
        return cls(texels, unit_from_body, extent, inner, outer, view)


def _smooth_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted vertex normals at the corners, float64 [triangle_count, 3, 3]."""
    corner = points[faces]
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    vertex = np.zeros_like(points)
    for k in range(3):
        np.add.at(vertex, faces[:, k], facet)
    vertex /= np.maximum(np.linalg.norm(vertex, axis=1, keepdims=True), 1.0e-300)
    return vertex[faces]


def _draw_faces(whitened: np.ndarray, faces: np.ndarray, resolution: int) -> np.ndarray:
    """Triangle seen from the centre at every node, int [6 n n], by the rasteriser: pixel centres are the nodes."""
    n = resolution
    half = 0.5 * (n - 1)
    triangles = wp.array(faces, dtype=wp.vec3i, device="cpu")
    result = np.empty((FACE_COUNT, n * n), np.int64)
    for face in range(FACE_COUNT):
        k, ku, kv, sign = face_axes(face)
        camera = CameraView()
        camera.width = camera.height = n
        camera.near = 1.0e-6
        camera.far = 1.0e6
        depth = sign * whitened[:, k]
        screen = np.zeros((len(whitened), 4), np.float32)
        front = depth > camera.near
        safe = np.where(front, depth, 1.0)
        x = half * whitened[:, ku] + 0.5 * n * depth
        y = half * whitened[:, kv] + 0.5 * n * depth
        screen[:, 0] = np.where(front, x / safe, x)
        screen[:, 1] = np.where(front, y / safe, y)
        screen[:, 2] = np.where(front, 1.0 / safe, 0.0)
        screen[:, 3] = depth
        target = make_target(camera, (0, 0, n, n), "cpu")
        rasterise(target, wp.array(screen, dtype=wp.vec4, device="cpu"), triangles)
        drawn = wp.empty(n * n, dtype=int, device="cpu")
        launch(resolve_kernel, n * n, [target.key, drawn, wp.empty(n * n, dtype=float, device="cpu")], "cpu")
        result[face] = drawn.numpy()
    return _fill_gaps(result.reshape(FACE_COUNT, n, n)).reshape(-1)


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


def _surface_along(points, faces, normals, triangle, directions) -> tuple[np.ndarray, np.ndarray]:
    """Point and interpolated unit normal where the rays from 0 meet the given triangles' planes."""
    corner = points[faces[triangle]]
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    weights = np.stack([np.einsum("ij,ij->i", directions, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))], axis=1)
    weights = np.maximum(weights, 0.0)  # a node on an edge may lie outside by the rasteriser's 1/256 of a node
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1.0e-300)
    facet = np.cross(b - a, c - a)
    distance = np.einsum("ij,ij->i", facet, a) / np.einsum("ij,ij->i", facet, directions)
    normal = np.einsum("ik,ikj->ij", weights, normals[triangle])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-300)
    return directions * distance[:, None], normal


def _whitened_radii(whitened: np.ndarray, faces: np.ndarray, nodes: np.ndarray) -> tuple[float, float]:
    """Radii of a ball inside and a ball around the convex body in whitened space, with a margin for float32."""
    corner = whitened[faces]
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.linalg.norm(facet, axis=1)
    solid = area > 1.0e-9 * area.max()
    height = np.einsum("ij,ij->i", facet[solid], corner[solid][:, 0]) / area[solid]
    outer = max(
        float(np.linalg.norm(whitened[faces.reshape(-1)], axis=1).max()), float(np.linalg.norm(nodes, axis=1).max())
    )
    return float(height.min()) * (1.0 - 1.0e-5), outer * (1.0 + 1.0e-5)
