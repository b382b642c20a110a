"""The analytic surfaces of a mirror: those its gprim carries, or those its mesh is recognised as. Host, float64."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warp_reflect.bodies import weld
from warp_reflect.mirrors import QuadricMirror
from warp_reflect.quadric_fit import Fit, fit_quadric
from warp_reflect.quadrics import CanonicalQuadric, QuadricKind
from warp_reflect.scene import PartRange, Scene, Shape
from warp_reflect.segments import components, mesh_at_rest, part_mesh
from warp_reflect.techniques import planar

CREASE_COS = 0.955  # 17 degrees between two facets' normals at a corner they share: beyond, they belong to two sheets
SHEETS_MAX = 12  # each is a pass over the scene's vertices; a solid with rims has up to four


@dataclass(frozen=True)
class Sheet:
    """One smooth piece of a mirror and its surface.

    Attributes:
        triangles: Ids of its triangles in the scene, ascending.
        quadric: World is the scene frame; None: a plane, or nothing that was recognised.
        plane: float64 [4, 4], see `planar.plane_frame`; None: a quadric.
        distance: Largest distance of its corners and facets from the surface; 0 for gprims. [scene units]
        sine: Largest sine between its normals and the surface's; 0 for gprims.
        name: What it is, with its measures where a mesh was recognised.
    """

    triangles: np.ndarray
    quadric: CanonicalQuadric | None
    plane: np.ndarray | None
    distance: float
    sine: float
    name: str

    @property
    def known(self) -> bool:
        """Whether it has a surface."""
        return self.quadric is not None or self.plane is not None

    def placed(self, scene_from_object: np.ndarray, first_triangle: int) -> Sheet:
        """The same sheet of a mesh placed by a similarity that does not mirror, float64 [4, 4]."""
        scale = float(np.cbrt(np.linalg.det(scene_from_object[:3, :3])))
        quadric, plane, name = self.quadric, self.plane, self.name
        if quadric is not None:
            quadric = replace(
                quadric,
                origin=scene_from_object[:3, :3] @ quadric.origin + scene_from_object[:3, 3],
                axes=scene_from_object[:3, :3] @ quadric.axes / scale,
                size=quadric.size * scale,
            )
            name = str(Fit(quadric, self.distance, self.sine))
        if plane is not None:
            plane = plane @ np.linalg.inv(scene_from_object)
        return Sheet(self.triangles + first_triangle, quadric, plane, scale * self.distance, self.sine, name)


def sheets_of(scene: Scene, part_index: int) -> list[Sheet]:
    """The sheets of a part, one without a surface last if there is any; kept with the scene.

    Those of a mesh that moves are recognised once, wherever it stands.
    """
    if part_index not in scene.fits:
        part = scene.parts[part_index]
        shapes = [scene.patch_shapes[k] for k in part.patches]
        if all(shape is not None for shape in shapes):
            found = _analytic(scene, part)
        elif (rest := scene.at_rest(part_index)) is None or rest.is_mirrored:
            found = _recognised(*part_mesh(scene, part), part.first_triangle)
        else:
            known = scene.kept_at_rest(rest, "sheets", lambda: _recognised(*mesh_at_rest(rest), 0))
            found = [sheet.placed(rest.scene_from_rest, part.first_triangle) for sheet in known]
        scene.fits[part_index] = found
    return scene.fits[part_index]


def _analytic(scene: Scene, part: PartRange) -> list[Sheet]:
    own = np.arange(part.first_triangle, part.first_triangle + part.triangle_count)
    patch = scene.host_triangle_patch[own]
    found = []
    for k in part.patches:
        triangles = own[patch == k]
        if not len(triangles):
            continue
        shape = scene.patch_shapes[k]
        if shape.kind == "plane":
            point, normal = _plane(scene, part, shape)
            size = float(np.ptp(scene.host_points[scene.host_triangles[triangles]].reshape(-1, 3), axis=0).max())
            frame = planar.plane_frame(point, normal, size or 1.0)
            found.append(Sheet(triangles, None, frame, 0.0, 0.0, "plane"))
            continue
        try:
            quadric = _canonical(scene, part, shape)
        except ValueError as error:
            return [Sheet(triangles, None, None, np.inf, 1.0, str(error))]
        found.append(Sheet(triangles, quadric, None, 0.0, 0.0, _name(quadric)))
    return found


def _recognised(points: np.ndarray, faces: np.ndarray, normals: np.ndarray, first_triangle: int) -> list[Sheet]:
    """The sheets of a mesh, in its own frame; arguments as from `part_mesh`."""
    sheet = _smooth_sheets(points, faces, normals)
    if sheet.max(initial=0) >= SHEETS_MAX:
        own = first_triangle + np.arange(len(faces))
        return [Sheet(own, None, None, np.inf, 1.0, f"{sheet.max() + 1} smooth sheets, at most {SHEETS_MAX}")]
    found = []
    for number in range(int(sheet.max(initial=-1)) + 1):
        members = np.flatnonzero(sheet == number)
        own = members + first_triangle
        corner, normal = points[faces[members]].astype(np.float64), normals[members].astype(np.float64)
        flat = _flat(corner, normal)
        if flat is not None:
            found.append(Sheet(own, None, flat, 0.0, 0.0, "plane"))
            continue
        fit = fit_quadric(corner.reshape(-1, 3), normal.reshape(-1, 3))
        if fit is None:
            return [*found, Sheet(own, None, None, np.inf, 1.0, "no quadric passes through its points")]
        # The mesh shows its facets, which leave the surface between their corners.
        sagitta = fit.quadric.distances(corner.mean(axis=1)).max()
        found.append(Sheet(own, fit.quadric, None, max(fit.distance, float(sagitta)), fit.sine, str(fit)))
    return found


def _smooth_sheets(points: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Number of the sheet of each triangle: those that edges without a crease join, int64 [triangle_count]."""
    welded = weld(points, faces)
    start, end = welded.reshape(-1), welded[:, [1, 2, 0]].reshape(-1)
    at_start, at_end = normals.reshape(-1, 3), normals[:, [1, 2, 0]].reshape(-1, 3)
    turned = start > end
    at_start, at_end = np.where(turned[:, None], at_end, at_start), np.where(turned[:, None], at_start, at_end)
    key = np.minimum(start, end) * (int(welded.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    a, b = order[:-1], order[1:]
    alike = key[a] == key[b]
    for normal in (at_start, at_end):
        alike &= np.einsum("ij,ij->i", normal[a], normal[b]) > CREASE_COS
    joined = components(len(faces), a[alike] // 3, b[alike] // 3)
    return np.unique(joined, return_inverse=True)[1].reshape(-1)


def _flat(corner: np.ndarray, normal: np.ndarray) -> np.ndarray | None:
    """The frame of the plane of flat triangles with its normals; None where they bend."""
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).sum(axis=0)
    length = float(np.linalg.norm(area))
    flat = corner.reshape(-1, 3)
    size = float(np.ptp(flat, axis=0).max())
    if not length > 0.0:
        return None
    up, middle = area / length, flat.mean(axis=0)
    bent = np.linalg.norm(np.cross(normal.reshape(-1, 3), up), axis=1).max() > planar.NORMAL_SINE_MAX
    if bent or np.abs((flat - middle) @ up).max() > planar.FLATNESS_MAX * size:
        return None
    return planar.plane_frame(middle, up, size)


def _canonical(scene: Scene, part: PartRange, shape: Shape) -> CanonicalQuadric:
    """An analytic patch in its unit principal frame; world is the scene frame."""
    scene_from_unit = part.world_from_object @ np.linalg.inv(shape.unit_from_object)
    scene_from_unit[:3, 3] -= scene.origin
    return QuadricMirror.rotational(shape.a, shape.b, shape.c, scene_from_unit).canonical


def _plane(scene: Scene, part: PartRange, shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """(point, unit normal) of an analytic plane, scene frame."""
    scene_from_unit = part.world_from_object @ np.linalg.inv(shape.unit_from_object)
    normal = np.linalg.inv(scene_from_unit[:3, :3])[2]
    return scene_from_unit[:3, 3] - scene.origin, normal / np.linalg.norm(normal)


def _name(quadric: CanonicalQuadric) -> str:
    if quadric.kind == QuadricKind.ELLIPSOID and quadric.equal == 3:
        return "sphere"
    return quadric.kind.name.lower().replace("_", " ")
