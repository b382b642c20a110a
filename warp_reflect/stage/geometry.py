"""UsdGeomMesh and the analytic gprims to `MeshData`: validation, subdivision, material subsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom, UsdShade

from warp_reflect.scene import MeshData, Part
from warp_reflect.stage import gprims
from warp_reflect.stage.intake import COORDINATE_MAX, BadPrim, Intake, floats, integers, number, token
from warp_reflect.stage.primvars import INTERPOLATIONS, CornerAttribute, read_primvar, read_uvs
from warp_reflect.stage.subdivide import BOUNDARY_RULES, Cage, subdivide
from warp_reflect.stage.triangulate import triangulate

# Relative area under which a triangle has no plane: the cross product of its edges over the longest edge
# squared.
DEGENERATE_AREA = 1.0e-12
SMOOTH_SCHEMES = ("catmullClark", "loop")
REFINED_FACES_MAX = 4_000_000  # of one mesh; above it the level is lowered (about 1 GB while refining)
BLOCK = 1 << 15  # faces or triangles worked on at a time: their float64 intermediates stay in the cache


def read_gprim(prim, intake: Intake, level: int) -> MeshData:
    """An analytic gprim in object space.

    Args:
        prim: A Sphere, Cube, Cylinder(_1), Cone, Capsule(_1) or Plane.
        intake: The reading.
        level: 0 to 3: tessellation.

    Raises:
        BadPrim: a radius, height, size or axis that is none.
    """

    def positive(name: str, low: float = 0.0, open_low: bool = True) -> float:
        value = number(prim.GetAttribute(name), intake.time, low, open_low)
        if value > COORDINATE_MAX:
            raise BadPrim(f"{name}: got {value:g}, expected at most {COORDINATE_MAX:g}")
        return value

    def radii() -> tuple[float, float]:
        if prim.GetAttribute("radiusBottom"):
            pair = positive("radiusBottom", open_low=False), positive("radiusTop", open_low=False)
            if max(pair) == 0.0:
                raise BadPrim("radiusBottom, radiusTop: got 0 for both, expected one > 0")
            return pair
        return (positive("radius"),) * 2

    kind = prim.GetTypeName()
    if kind == "Sphere":
        mesh = gprims.sphere(positive("radius"), level)
    elif kind == "Cube":
        mesh = gprims.cube(positive("size"), level)
    else:
        axis = token(prim.GetAttribute("axis"), intake.time, ("X", "Y", "Z"))
        if kind == "Plane":
            mesh = gprims.plane(positive("width"), positive("length"), axis, level)
        elif kind == "Cone":
            mesh = gprims.cone(positive("radius"), positive("height"), axis, level)
        elif kind in ("Cylinder", "Cylinder_1"):
            mesh = gprims.cylinder(*radii(), positive("height"), axis, level)
        else:
            bottom, top = radii()
            height = positive("height", open_low=bottom != top)
            mesh = gprims.capsule(bottom, top, height, axis, level)
    mesh.double_sided = bool(UsdGeom.Gprim(prim).GetDoubleSidedAttr().Get(intake.time))
    return mesh


@dataclass
class _Surface:
    """A validated polygon mesh between reading and triangulation.

    Attributes:
        points: float64 [point_count, 3].
        counts, indices: Faces, int32 or int64.
        source: Face of the authored mesh each face belongs to, int [face_count].
        drawn: bool [face_count].
        attributes: What follows the corners, by name: "normals", "colors", "uvs".
    """

    points: np.ndarray
    counts: np.ndarray
    indices: np.ndarray
    source: np.ndarray
    drawn: np.ndarray
    attributes: dict[str, CornerAttribute]


def read_mesh(
    prim, intake: Intake, level: int, uv_name: str = "", color_name: str = "displayColor"
) -> tuple[MeshData, list]:
    """A UsdGeomMesh in object space.

    Args:
        prim: The mesh prim.
        intake: The reading; repairs are noted there.
        level: Subdivision level; 0: the cage. Without effect on polygon meshes.
        uv_name: Primvar that becomes the UVs; empty: none is read.
        color_name: Primvar that becomes the colours, where it varies over the mesh.

    Returns:
        (mesh, subsets): one GeomSubset prim per part, None for the part with the mesh's own material.

    Raises:
        BadPrim: nothing of it can be drawn; the text names attribute, value and what is expected.
    """
    path = prim.GetPath()
    mesh = UsdGeom.Mesh(prim)
    surface = _authored(mesh, intake, uv_name, color_name)
    face_count = len(surface.counts)
    scheme = subdivision_scheme(prim, intake)
    if scheme in SMOOTH_SCHEMES and level > 0:
        surface = _refined(mesh, surface, scheme, level, intake)
    elif scheme in SMOOTH_SCHEMES and not len(mesh.GetCreaseLengthsAttr().Get(intake.time) or ()):
        surface.attributes["normals"] = _point_normals(surface)

    corners, face, crossing = _triangles(surface)
    triangles = surface.indices[corners]
    solid = _has_area(surface.points, triangles)
    if not solid.all():
        intake.note(path, f"faceVertexIndices: {np.sum(~solid)} triangles without area dropped")
        corners, face, triangles = corners[solid], face[solid], triangles[solid]
    crossing = crossing[np.isin(crossing, face)]
    if len(crossing):
        first = surface.source[crossing[0]]
        intake.note(path, f"faceVertexIndices: face {first} crosses itself, as do {len(crossing) - 1} more")
    if not len(triangles):
        raise BadPrim("points: got no face with an area, expected one")

    part_of_face, subsets = _material_subsets(mesh, face_count, intake)
    sizes = np.array([len(triangles)])
    if len(subsets) > 1:
        part = part_of_face[surface.source[face]]
        order = np.argsort(part, kind="stable")
        corners, face, triangles = corners[order], face[order], triangles[order]
        sizes = np.bincount(part, minlength=len(subsets))
    if mesh.GetOrientationAttr().Get(intake.time) == "leftHanded":
        corners, triangles = corners[:, [0, 2, 1]], triangles[:, [0, 2, 1]]
        if scheme in SMOOTH_SCHEMES and "normals" in surface.attributes:
            surface.attributes["normals"].values *= -1.0  # made by the winding, which is the other way round

    result = MeshData(surface.points.astype(np.float32), triangles.astype(np.int32))
    result.double_sided = bool(mesh.GetDoubleSidedAttr().Get(intake.time))
    firsts = np.cumsum(sizes) - sizes
    named = [
        (Part(int(f), int(n), s.GetName() if s else ""), s) for f, n, s in zip(firsts, sizes, subsets, strict=True) if n
    ]
    result.parts = [each for each, _ in named]
    placed = {
        name: (attribute.values, _corner_index(attribute, corners, face, triangles))
        for name, attribute in surface.attributes.items()
    }
    if "normals" in placed:
        values, result.normal_index = placed["normals"]
        result.normals = _unit_normals(values, result.normal_index, surface.points, triangles, path, intake)
    if "colors" in placed:
        result.colors, result.color_index = placed["colors"][0].astype(np.float32), placed["colors"][1]
    if "uvs" in placed:
        result.uvs, result.uv_index = placed["uvs"][0].astype(np.float32), placed["uvs"][1]
    return result, [subset for _, subset in named]


def _triangles(surface: _Surface) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(corners int32 [triangle_count, 3], face int32 [triangle_count], crossing faces) of the faces that are drawn."""
    if surface.drawn.all():
        return triangulate(surface.counts, surface.indices, surface.points)
    starts = np.cumsum(surface.counts) - surface.counts
    kept = np.flatnonzero(surface.drawn)
    corner_of_kept = _ranges(starts[kept], surface.counts[kept]).astype(np.int32)
    corners, face, crossing = triangulate(surface.counts[kept], surface.indices[corner_of_kept], surface.points)
    return corner_of_kept[corners], kept[face].astype(np.int32), kept[crossing]


def _point_normals(surface: _Surface) -> CornerAttribute:
    """Normals of a cage drawn as it is: the sum of the area vectors of the faces at each point."""
    total = np.zeros((3, len(surface.points)))
    corner = 0
    for first in range(0, len(surface.counts), BLOCK):
        counts = surface.counts[first : first + BLOCK]
        indices = surface.indices[corner : corner + int(counts.sum())]
        drawn = surface.drawn[first : first + BLOCK]
        corner += len(indices)
        size = int(counts[0])
        if (counts == size).all():
            faces = indices.reshape(-1, size)[drawn]
            p = surface.points[faces]
            if size == 3:  # the same at its three corners
                turn = np.repeat(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), 3, axis=0)
            else:
                turn = np.cross(np.roll(p, -1, axis=1) - p, np.roll(p, 1, axis=1) - p).reshape(-1, 3)
            at = faces.reshape(-1)
        else:
            starts = np.cumsum(counts) - counts
            face_of = np.repeat(np.arange(len(counts)), counts)
            within, size = np.arange(len(indices)) - starts[face_of], counts[face_of]
            here = surface.points[indices]
            ahead = surface.points[indices[starts[face_of] + (within + 1) % size]]
            behind = surface.points[indices[starts[face_of] + (within - 1) % size]]
            at, turn = indices[drawn[face_of]], np.cross(ahead - here, behind - here)[drawn[face_of]]
        for k in range(3):
            np.add.at(total[k], at, turn[:, k])
    return CornerAttribute(total.T, None, "vertex")


def subdivision_scheme(prim, intake: Intake) -> str:
    """The scheme of a mesh; one that is not authored is catmullClark."""
    attribute = UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr()
    scheme = attribute.Get(intake.time)
    if scheme not in ("none", "bilinear", *SMOOTH_SCHEMES):
        intake.bad(
            prim.GetPath(),
            f"subdivisionScheme: got {scheme!r}, expected none, bilinear, loop or catmullClark; none is used",
        )
        return "none"
    return str(scheme)


def _authored(mesh: UsdGeom.Mesh, intake: Intake, uv_name: str, color_name: str) -> _Surface:
    path, prim = mesh.GetPath(), mesh.GetPrim()
    points, counts, indices = _topology(mesh, intake)
    face_count = len(counts)
    drawn = counts >= 3
    if not drawn.all():
        first = int(np.flatnonzero(~drawn)[0])
        intake.note(
            path,
            f"faceVertexCounts[{first}]: got {counts[first]}; {np.sum(~drawn)} faces with less than 3 corners dropped",
        )
    drawn &= ~_holes(mesh, face_count, intake)
    if not drawn.any():
        raise BadPrim("faceVertexCounts: got no face with 3 corners or more that is no hole, expected one")
    elements = {
        "constant": 1,
        "uniform": face_count,
        "vertex": len(points),
        "varying": len(points),
        "faceVarying": len(indices),
    }
    found = {}
    # Subdivided surfaces have their own normals; authored ones are ignored (UsdGeomMesh).
    if subdivision_scheme(prim, intake) == "none":
        found["normals"] = _normals(mesh, intake)
    color = read_primvar(prim, color_name, 3, intake)
    if color is not None and color.interpolation != "constant":
        found["colors"] = color, f"primvars:{color_name}"
    if uv_name:
        found["uvs"] = read_uvs(prim, uv_name, intake)
    attributes = {}
    for name, (attribute, label) in found.items():
        if attribute is None:
            continue
        count, expected = attribute.element_count, elements[attribute.interpolation]
        if count == expected or (attribute.interpolation == "constant" and count > 1):
            attributes[name] = attribute
        else:
            intake.bad(
                path,
                f"{label}: got {count} values, expected {expected} for {attribute.interpolation}; not used",
            )
    return _Surface(points, counts, indices, np.arange(face_count, dtype=np.int32), drawn, attributes)


def _refined(mesh: UsdGeom.Mesh, surface: _Surface, scheme: str, level: int, intake: Intake) -> _Surface:
    """The surface subdivided onto its limit."""
    path = mesh.GetPath()
    counts, indices, attributes = surface.counts.astype(np.int64), surface.indices, surface.attributes
    # A corner that repeats the one before it adds no edge: without this it would count as a border.
    starts = np.cumsum(counts) - counts
    face_of = np.repeat(np.arange(len(counts)), counts)
    last = np.arange(len(indices)) + 1 == (starts + counts)[face_of]
    following = np.where(last, starts[face_of], np.arange(len(indices)) + 1)
    solid = indices != indices[following]
    left = np.bincount(face_of[solid], minlength=len(counts))
    faces = np.flatnonzero(left >= 3)
    corners = np.flatnonzero(solid & (left >= 3)[face_of])
    if scheme == "loop" and (left[faces] != 3).any():
        intake.note(path, "subdivisionScheme: loop on faces that are no triangles; catmullClark is used")
        scheme = "catmullClark"
    while level > 0 and len(corners) * 4 ** (level - 1) > REFINED_FACES_MAX:
        level -= 1
        intake.note(path, f"level {level} instead of {level + 1}: more than {REFINED_FACES_MAX} faces")
    if level == 0 or not len(faces):
        return surface
    if mesh.GetTriangleSubdivisionRuleAttr().Get(intake.time) == "smooth":
        intake.note(path, "triangleSubdivisionRule: smooth is not used; catmullClark is")
    creases, sharpness = _creases(mesh, len(surface.points), intake)
    sharp_points, point_sharpness = _sharp_points(mesh, len(surface.points), intake)
    boundary = mesh.GetInterpolateBoundaryAttr().Get(intake.time)
    cage = Cage(
        left[faces],
        indices[corners].astype(np.int64),
        boundary if boundary in BOUNDARY_RULES else BOUNDARY_RULES[-1],
        creases,
        sharpness,
        sharp_points,
        point_sharpness,
        ~surface.drawn[faces],
    )
    # Values of each kind side by side, as columns that are refined together.
    columns: dict[str, list[np.ndarray]] = {"vertex": [surface.points], "varying": [], "faceVarying": []}
    spans: dict[str, slice] = {}
    for name, attribute in attributes.items():
        if attribute.interpolation in columns:
            values = attribute.flat()
            if attribute.interpolation == "faceVarying":
                values = values[corners]
            first = sum(each.shape[1] for each in columns[attribute.interpolation])
            spans[name] = slice(first, first + values.shape[1])
            columns[attribute.interpolation].append(values)
    stacked = {kind: np.concatenate(each, axis=1) if each else None for kind, each in columns.items()}
    fine = subdivide(scheme, level, cage, stacked["vertex"], stacked["varying"], stacked["faceVarying"])
    size = fine.indices.shape[1]
    source = faces[fine.source]
    results = {"vertex": fine.points, "varying": fine.varying}
    if fine.face_varying is not None:
        results["faceVarying"] = fine.face_varying.reshape(-1, fine.face_varying.shape[2])
    refined = {"normals": CornerAttribute(fine.normals, fine.normal_index.reshape(-1), "faceVarying")}
    for name, attribute in attributes.items():
        if name in spans:
            values = results[attribute.interpolation][:, spans[name]]
            refined[name] = CornerAttribute(values, None, attribute.interpolation)
        elif attribute.interpolation == "uniform":
            refined[name] = CornerAttribute(attribute.flat()[source], None, "uniform")
        else:
            refined[name] = attribute
    return _Surface(
        fine.points[:, :3],
        np.full(len(fine.indices), size, np.int64),
        fine.indices.reshape(-1),
        source,
        np.ones(len(fine.indices), bool),
        refined,
    )


def _creases(mesh: UsdGeom.Mesh, point_count: int, intake: Intake) -> tuple[np.ndarray, np.ndarray]:
    """(edges int64 [n, 2], sharpness float64 [n]) of the creases; malformed ones are noted and left out."""
    nothing = np.zeros((0, 2), np.int64), np.zeros(0)
    lengths = integers(mesh.GetCreaseLengthsAttr(), intake.time)
    if lengths is None or not len(lengths):
        return nothing
    indices = integers(mesh.GetCreaseIndicesAttr(), intake.time)
    values = floats(mesh.GetCreaseSharpnessesAttr(), intake.time, 1)
    indices = np.zeros(0, np.int64) if indices is None else indices
    values = np.zeros(0) if values is None else values
    per_edge = int(np.maximum(lengths - 1, 0).sum())
    fault = ""
    if (lengths < 2).any() or lengths.sum() != len(indices):
        fault = f"creaseLengths: got lengths that sum to {lengths.sum()}, expected {len(indices)}, each >= 2"
    elif len(values) not in (len(lengths), per_edge):
        fault = f"creaseSharpnesses: got {len(values)} values, expected {len(lengths)} or {per_edge}"
    elif ((indices < 0) | (indices >= point_count)).any():
        fault = f"creaseIndices: got a value outside 0 to {point_count - 1}"
    elif not (values >= 0.0).all():
        fault = "creaseSharpnesses: got a value that is no number >= 0"
    if fault:
        intake.bad(mesh.GetPath(), f"{fault}; creases not used")
        return nothing
    ends = np.zeros(len(indices), bool)
    ends[np.cumsum(lengths) - 1] = True
    first = np.flatnonzero(~ends)
    if len(values) == len(lengths):
        values = np.repeat(values, lengths - 1)
    return np.stack([indices[first], indices[first + 1]], axis=1), values


def _sharp_points(mesh: UsdGeom.Mesh, point_count: int, intake: Intake) -> tuple[np.ndarray, np.ndarray]:
    """(points int64 [n], sharpness float64 [n]) of the corners; malformed ones are noted and left out."""
    indices = integers(mesh.GetCornerIndicesAttr(), intake.time)
    values = floats(mesh.GetCornerSharpnessesAttr(), intake.time, 1)
    if indices is None or not len(indices):
        return np.zeros(0, np.int64), np.zeros(0)
    count = 0 if values is None else len(values)
    if count != len(indices) or ((indices < 0) | (indices >= point_count)).any() or not (values >= 0.0).all():
        intake.bad(
            mesh.GetPath(),
            f"cornerIndices, cornerSharpnesses: got {len(indices)} and {count} values, expected as "
            f"many, points "
            f"0 to {point_count - 1} and sharpnesses >= 0; corners not used",
        )
        return np.zeros(0, np.int64), np.zeros(0)
    return indices, values


def _corner_index(attribute: CornerAttribute, corners, face, triangles) -> np.ndarray | None:
    """Index into the attribute's values per triangle corner, int32 [triangle_count, 3]; None: the triangles."""
    if attribute.interpolation in ("vertex", "varying") and attribute.index is None:
        return None
    if attribute.interpolation == "constant":
        index = np.zeros_like(triangles)
    elif attribute.interpolation == "uniform":
        index = np.repeat(face[:, None], 3, axis=1)
    else:
        index = corners if attribute.interpolation == "faceVarying" else triangles
    return (index if attribute.index is None else attribute.index[index]).astype(np.int32)


def _topology(mesh: UsdGeom.Mesh, intake: Intake) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Validated (points float64 [n, 3], counts, indices: int32 where authored so, else int64).

    UsdGeomMesh.ValidateTopology accepts negative counts, sums that wrap and points that are not finite: not
    used.
    """
    points = floats(mesh.GetPointsAttr(), intake.time, 3)
    counts = integers(mesh.GetFaceVertexCountsAttr(), intake.time, np.int32)
    indices = integers(mesh.GetFaceVertexIndicesAttr(), intake.time, np.int32)
    for name, array in (("points", points), ("faceVertexCounts", counts), ("faceVertexIndices", indices)):
        if array is None or not len(array):
            raise BadPrim(f"{name}: got {'no value' if array is None else 'an empty array'}, expected a mesh")
    low = int(np.argmin(counts))
    if counts[low] < 0:
        raise BadPrim(f"faceVertexCounts[{low}]: got {counts[low]}, expected 3 or more")
    high = int(np.argmax(counts))
    if counts[high] > intake.limits.face_corners:
        raise BadPrim(f"faceVertexCounts[{high}]: got {counts[high]}, expected at most {intake.limits.face_corners}")
    if counts.sum() != len(indices):
        raise BadPrim(
            f"faceVertexIndices: got {len(indices)} values, expected {counts.sum()}, the sum of faceVertexCounts"
        )
    if indices.min() < 0 or indices.max() >= len(points):
        first = int(np.argmax((indices < 0) | (indices >= len(points))))
        raise BadPrim(f"faceVertexIndices[{first}]: got {indices[first]}, expected 0 to {len(points) - 1}")
    fine = np.isfinite(points).all(axis=1) & (np.abs(points) <= COORDINATE_MAX).all(axis=1)
    if not fine.all():
        used = np.zeros(len(points), bool)
        used[indices] = True
        if (used & ~fine).any():
            first = int(np.argmax(used & ~fine))
            value = tuple(points[first].tolist())
            raise BadPrim(f"points[{first}]: got {value}, expected finite coordinates up to {COORDINATE_MAX:g}")
        points[~fine] = points[indices[0]]  # no face uses it; it must not spoil the bounds
    return points, counts, indices


def _holes(mesh: UsdGeom.Mesh, face_count: int, intake: Intake) -> np.ndarray:
    result = np.zeros(face_count, bool)
    holes = integers(mesh.GetHoleIndicesAttr(), intake.time)
    if holes is not None and len(holes):
        valid = (holes >= 0) & (holes < face_count)
        if not valid.all():
            first = int(np.argmin(valid))
            intake.bad(
                mesh.GetPath(),
                f"holeIndices[{first}]: got {holes[first]}, expected 0 to {face_count - 1}; not used",
            )
        result[holes[valid]] = True
    return result


def _ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """The concatenation of starts[i] .. starts[i] + counts[i] - 1."""
    return np.repeat(starts - (np.cumsum(counts) - counts), counts) + np.arange(counts.sum())


def _has_area(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    result = np.empty(len(triangles), bool)
    for first in range(0, len(triangles), BLOCK):
        a, b, c = (points[triangles[first : first + BLOCK, k]] for k in range(3))
        sides = b - a, c - a, c - b
        longest = np.maximum.reduce([np.einsum("ij,ij->i", side, side) for side in sides])
        turn = np.cross(sides[0], sides[1])
        area = np.sqrt(np.einsum("ij,ij->i", turn, turn))
        result[first : first + BLOCK] = area > DEGENERATE_AREA * longest
    return result


def _material_subsets(mesh: UsdGeom.Mesh, face_count: int, intake: Intake) -> tuple[np.ndarray, list]:
    """(part of each face int64 [face_count], GeomSubset prim of each part: None for the rest)."""
    part_of_face = np.zeros(face_count, np.int64)
    subsets = [None]
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        prim = subset.GetPrim()
        family = subset.GetFamilyNameAttr().Get()
        if family != UsdShade.Tokens.materialBind:
            if prim.HasRelationship("material:binding"):
                intake.note(prim.GetPath(), f"familyName: got {family!r}; only materialBind subsets carry materials")
            continue
        element = subset.GetElementTypeAttr().Get()
        if element != "face":
            intake.note(prim.GetPath(), f"elementType: got {element!r}, expected face; not used")
            continue
        try:
            faces = integers(subset.GetIndicesAttr(), intake.time)
        except BadPrim as fault:
            intake.bad(prim.GetPath(), f"{fault}; subset not used")
            continue
        if faces is None or not len(faces):
            continue
        valid = (faces >= 0) & (faces < face_count)
        if not valid.all():
            first = int(np.argmin(valid))
            intake.bad(
                prim.GetPath(),
                f"indices[{first}]: got {faces[first]}, expected 0 to {face_count - 1}; not used",
            )
        faces = faces[valid]
        taken = part_of_face[faces] != 0
        if taken.any():
            intake.note(
                prim.GetPath(),
                f"indices: {int(taken.sum())} faces belong to an earlier subset, which keeps them",
            )
        part_of_face[faces[~taken]] = len(subsets)
        subsets.append(prim)
    return part_of_face, subsets


def _normals(mesh: UsdGeom.Mesh, intake: Intake) -> tuple[CornerAttribute | None, str]:
    """Authored normals: primvars:normals, else the attribute normals (UsdGeomPointBased's rule)."""
    primvar = read_primvar(mesh.GetPrim(), "normals", 3, intake)
    if primvar is not None:
        return primvar, "primvars:normals"
    try:
        values = floats(mesh.GetNormalsAttr(), intake.time, 3)
    except BadPrim as fault:
        intake.bad(mesh.GetPath(), f"{fault}; not used")
        return None, "normals"
    if values is None or not len(values):
        return None, "normals"
    interpolation = str(mesh.GetNormalsInterpolation())
    if interpolation not in INTERPOLATIONS:
        intake.bad(
            mesh.GetPath(), f"normals: got interpolation {interpolation!r}, expected a UsdGeomPrimvar one; not used"
        )
        return None, "normals"
    return CornerAttribute(values, None, interpolation), "normals"


def _unit_normals(values, index, points, triangles, path, intake: Intake) -> np.ndarray:
    """Unit float32 normals; what is zero or not finite becomes the normal of a face that uses it."""
    largest = np.abs(values).max(axis=1)
    good = np.isfinite(largest) & (largest > 0.0)
    if good.all():
        unit = values / largest[:, None]
    else:
        unit = np.where(good[:, None], values, 1.0) / np.where(good, largest, 1.0)[:, None]
        index = triangles if index is None else index
        row, corner = np.nonzero(~good[index])
        if len(row):
            first = int(np.argmin(good))
            intake.note(
                path,
                f"normals[{first}]: got {tuple(values[first].tolist())}; {int(np.sum(~good))} replaced by face normals",
            )
            a, b, c = (points[triangles[row, k]] for k in range(3))
            unit[index[row, corner]] = np.cross(b - a, c - a)
    unit /= np.sqrt(np.einsum("ij,ij->i", unit, unit))[:, None]
    return unit.astype(np.float32)
