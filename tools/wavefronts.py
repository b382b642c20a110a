"""Eye rays and mirror rays of a frame by Embree (embreex, NumPy between its calls) and by Mitsuba (Dr.Jit), for `peers.py`."""

from __future__ import annotations

import time
from functools import cached_property

import numpy as np

from warp_reflect.sweep import Embree

RAY_STEP = 1.0e-4  # of the scene's size: how far off the surface mirror rays begin
NOTHING = -2  # a pixel that shows no mirror; -1: one whose ray meets nothing


class Wavefront:
    """A frame's eye rays and mirror rays through embreex, with NumPy between them: hits, no shading."""

    def __init__(self, scene, frame):
        self.rays = Embree(scene, frame)
        self.source, self.frame = scene, frame
        camera = frame.camera
        width, height = camera.size
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        across = ((x - camera.cx) / camera.fx)[..., None] * camera.right
        down = ((camera.cy - y) / camera.fy)[..., None] * camera.up
        eye = camera.eye - scene.origin
        if camera.orthographic:
            self.origins = (eye + across + down).reshape(-1, 3).astype(np.float32)
            self.directions = np.broadcast_to(camera.forward, (width * height, 3)).astype(np.float32)
        else:
            d = (camera.forward + across + down).reshape(-1, 3)
            self.directions = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
            self.origins = np.broadcast_to(eye, d.shape).astype(np.float32)
        self.origins = np.ascontiguousarray(self.origins)
        parts = [row.reflector.part for row in frame.plan.rows]
        self.is_mirror = np.zeros(len(scene.patch_shapes) + 1, bool)  # the last: nothing was hit
        for part in parts:
            self.is_mirror[list(scene.parts[part].patches)] = True
        self.curved = [
            (
                k,
                shape.unit_from_object @ np.linalg.inv(scene.parts[part].world_from_object) @ _moved(scene.origin),
                shape,
            )
            for part in parts
            for k in scene.parts[part].patches
            if (shape := scene.patch_shapes[k]) is not None and shape.kind == "quadric"
        ]

    @cached_property
    def mirror_patch(self) -> np.ndarray:
        """int32 of each triangle: its patch, -1 where that is no mirror."""
        patch = self.source.host_triangle_patch
        return np.where(self.is_mirror[patch], patch, -1).astype(np.int32)

    @cached_property
    def quadric_rows(self) -> dict[int, list[float]]:
        """By patch, of x^2 + y^2 + a z^2 + b z = const: three rows of its unit frame from the scene's, a, b."""
        return {k: [*frame[:3].ravel(), shape.a, shape.b] for k, frame, shape in self.curved}

    def rebuild(self) -> None:
        """Give Embree the triangles anew, as they are."""
        self.rays.build(self.source)

    def trace(self) -> tuple[float, float]:
        """Milliseconds of the mirror rays and of both."""
        start = time.perf_counter()
        seen = self.rays.scene.run(self.origins, self.directions, output=True)
        triangle = seen["primID"].astype(np.int64)
        eye_done = time.perf_counter()
        patch = np.where(triangle >= 0, self.source.host_triangle_patch[triangle], -1)
        at = np.nonzero(self.is_mirror[patch])[0]
        u, v, d = seen["u"][at, None], seen["v"][at, None], self.directions[at]
        corner = self.source.host_points[self.source.host_triangles[triangle[at]]]
        point = (1.0 - u - v) * corner[:, 0] + u * corner[:, 1] + v * corner[:, 2]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        index = self.source.host_normal_index[triangle[at]]
        smooth = index[:, 0] >= 0
        if smooth.any():
            n = self.source.host_normals[index[smooth]]
            normal[smooth] = (1.0 - u - v)[smooth] * n[:, 0] + u[smooth] * n[:, 1] + v[smooth] * n[:, 2]
        for k, unit_from_scene, shape in self.curved:
            own = patch[at] == k
            q = point[own] @ unit_from_scene[:3, :3].T + unit_from_scene[:3, 3]
            gradient = np.stack([q[:, 0], q[:, 1], shape.a * q[:, 2] + 0.5 * shape.b], axis=1)
            normal[own] = gradient @ unit_from_scene[:3, :3]
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1.0e-30)
        cosine = np.einsum("ij,ij->i", normal, d)[:, None]
        onward = np.ascontiguousarray(d - 2.0 * cosine * normal, np.float32)
        step = RAY_STEP * self.source.size
        origin = np.ascontiguousarray(point - np.sign(cosine) * step * normal, np.float32)
        self.pixel, self.hit = at, self.rays.scene.run(origin, onward)
        end = time.perf_counter()
        return 1000.0 * (end - eye_done), 1000.0 * (end - start)

    def agreement(self) -> float:
        """Share of the reference's mirror pixels with its triangle."""
        found = np.full(len(self.origins), NOTHING, np.int64)
        found[self.pixel] = self.hit
        return self.share(found)

    def share(self, found: np.ndarray) -> float:
        """The same of others' triangles, one of every pixel of the picture."""
        same = [found[layer.pixels.pixel.numpy()] == layer.triangle.numpy() for layer in self.frame.layers.values()]
        return float(np.concatenate(same).mean())


def _moved(origin: np.ndarray) -> np.ndarray:
    world_from_scene = np.eye(4)
    world_from_scene[:3, 3] = origin
    return world_from_scene


class MitsubaRays:
    """The mirror rays of a frame through Mitsuba: nearest triangle of one mesh of the whole scene."""

    def __init__(self, scene, frame):
        import mitsuba as mi

        self.embree = Embree(scene, frame)  # its rays
        points, triangles = scene.host_points, scene.host_triangles
        mesh = mi.Mesh("all", len(points), len(triangles))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = points.ravel()
        parameters["faces"] = triangles.ravel().astype(np.uint32)
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", "all": mesh})
        origins = mi.Point3f(self.embree.origins.T)
        self.rays = mi.Ray3f(origins, mi.Vector3f(self.embree.directions.T))
        self.frame = frame

    def trace(self) -> float:
        """Milliseconds of one call."""
        import drjit as dr
        import mitsuba as mi

        start = time.perf_counter()
        found = self.scene.ray_intersect_preliminary(self.rays)
        triangle = dr.select(found.is_valid(), mi.Int32(found.prim_index), -1)
        dr.eval(triangle)
        dr.sync_thread()
        spent = 1000.0 * (time.perf_counter() - start)
        self.embree.hit = np.array(triangle)
        return spent

    def agreement(self) -> float:
        return self.embree.agreement(self.frame)


class MitsubaWavefront:
    """What `Wavefront` does, as one kernel of Dr.Jit on any number of threads: hits, no shading."""

    def __init__(self, wavefront: Wavefront, scene):
        import mitsuba as mi

        source, camera = wavefront.source, wavefront.frame.camera
        self.wavefront, self.scene, self.size = wavefront, scene, camera.size
        self.step = RAY_STEP * source.size

        def table(rows, kind):
            return kind(np.ascontiguousarray(rows).ravel())

        self.mirror = table(wavefront.mirror_patch, mi.Int32)
        self.points = table(source.host_points.astype(np.float32), mi.Float)
        self.triangles = table(source.host_triangles.astype(np.int32), mi.Int32)
        self.normals = table(source.host_normals.astype(np.float32), mi.Float)
        self.normal_index = table(source.host_normal_index.astype(np.int32), mi.Int32)
        # Of every patch: the unit frame of its quadric by rows, a, b, and whether it has one.
        shapes = np.zeros((len(source.patch_shapes), 15), np.float32)
        for k, row in wavefront.quadric_rows.items():
            shapes[k] = *row, 1.0
        self.shapes = table(shapes, mi.Float)
        # Opaque: a literal would be compiled into the kernel, which other cameras then could not use.
        eye = camera.eye - source.origin
        rows = eye, camera.forward, camera.right / camera.fx, camera.up / camera.fy
        self.eye, self.forward, self.right, self.up = (mi.Vector3f(np.float32(row)) for row in rows)
        self.centre = mi.Point2f(camera.cx, camera.cy)
        self.orthographic = camera.orthographic

    def trace(self) -> float:
        """Milliseconds of both kinds of rays."""
        import drjit as dr
        import mitsuba as mi

        start = time.perf_counter()
        width, height = self.size
        for each in (self.eye, self.forward, self.right, self.up, self.centre):
            dr.make_opaque(each)
        number = dr.arange(mi.UInt32, width * height)
        x, y = mi.Float(number % width) + 0.5 - self.centre.x, self.centre.y - mi.Float(number // width) - 0.5
        aside = x * self.right + y * self.up
        if self.orthographic:
            ray = mi.Ray3f(mi.Point3f(self.eye + aside), self.forward)
        else:
            ray = mi.Ray3f(mi.Point3f(self.eye), dr.normalize(self.forward + aside))
        seen = self.scene.ray_intersect_preliminary(ray)
        patch = dr.gather(mi.Int32, self.mirror, seen.prim_index, seen.is_valid())
        mirrored = seen.is_valid() & (patch >= 0)

        def three(array, row, kind=mi.Vector3f):
            return dr.gather(kind, array, row, mirrored)

        corner = three(self.triangles, seen.prim_index, mi.Vector3i)
        index = three(self.normal_index, seen.prim_index, mi.Vector3i)
        u, v = seen.prim_uv
        w = 1.0 - u - v
        a, b, c = (three(self.points, mi.UInt32(k)) for k in corner)
        point = w * a + u * b + v * c
        smooth = mirrored & (index.x >= 0)
        r = [dr.gather(mi.Vector3f, self.normals, mi.UInt32(k), smooth) for k in index]
        normal = dr.select(smooth, w * r[0] + u * r[1] + v * r[2], dr.cross(b - a, c - a))
        m = [dr.gather(mi.Float, self.shapes, mi.UInt32(15 * patch + k), mirrored) for k in range(15)]
        q = [m[4 * k] * point.x + m[4 * k + 1] * point.y + m[4 * k + 2] * point.z + m[4 * k + 3] for k in range(3)]
        gradient = q[0], q[1], m[12] * q[2] + 0.5 * m[13]
        curved = mi.Vector3f(*(m[k] * gradient[0] + m[4 + k] * gradient[1] + m[8 + k] * gradient[2] for k in range(3)))
        normal = dr.normalize(dr.select(m[14] > 0.0, curved, normal))
        cosine = dr.dot(normal, ray.d)
        onward = mi.Ray3f(mi.Point3f(point - dr.sign(cosine) * self.step * normal), ray.d - 2.0 * cosine * normal)
        found = self.scene.ray_intersect_preliminary(onward, active=mirrored)
        triangle = dr.select(mirrored, dr.select(found.is_valid(), mi.Int32(found.prim_index), -1), NOTHING)
        dr.eval(triangle)
        dr.sync_thread()
        spent = 1000.0 * (time.perf_counter() - start)
        self.triangle = np.array(triangle)
        return spent

    def agreement(self) -> float:
        return self.wavefront.share(self.triangle)
