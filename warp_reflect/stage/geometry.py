"""UsdGeomMesh and the analytic gprims to `MeshData`: validation, corner attributes, material subsets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import UsdGeom, UsdShade

from warp_reflect.scene import MeshData, Part
from warp_reflect.stage import gprims
from warp_reflect.stage.intake import COORDINATE_MAX, BadPrim, Intake, floats, integers, number, token
from warp_reflect.stage.triangulate import triangulate

# Squared relative size under which a triangle has no plane: the cross product of its edges against their
# length.
DEGENERATE_AREA = 1.0e-12


@dataclass
class CornerAttribute:
    """A primvar: `values[index[element]]`, where `interpolation` says what an element is."""

    values: np.ndarray  # float64 [n, width]
    index: np.ndarray | None  # int64 [element_count]; None: element i is value i
    interpolation: str


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


def read_mesh(prim, intake: Intake, level: int) -> tuple[MeshData, list]:
    """A UsdGeomMesh in object space.

    Args:
        prim: The mesh prim.
        intake: The reading; repairs are noted there.
        level: Subdivision level.

    Returns:
        (mesh, subsets): one GeomSubset prim per part, None for the part with the mesh's own material.

    Raises:
        BadPrim: nothing of it can be drawn; the text names attribute, value and what is expected.
    """
    path = prim.GetPath()
    mesh = UsdGeom.Mesh(prim)
    points, counts, indices = _topology(mesh, intake)
    face_count = len(counts)
    drawn = counts >= 3
    if not drawn.all():
        first = int(np.flatnonzero(~drawn)[0])
        intake.note(
            path,
            f"faceVertexCounts[{first}]: got {counts[first]}; {np.sum(~drawn)} faces with less than 3 "
            f"corners dropped",
        )
    drawn &= ~_holes(mesh, face_count, intake)
    if not drawn.any():
        raise BadPrim("faceVertexCounts: got no face with 3 corners or more that is no hole, expected one")
    starts = np.cumsum(counts) - counts
    kept = np.flatnonzero(drawn)
    corner_of_kept = _ranges(starts[kept], counts[kept])
    corners, face, crossing = triangulate(counts[kept], indices[corner_of_kept], points)
    corners, face = corner_of_kept[corners], kept[face]
    triangles = indices[corners]
    solid = _has_area(points, triangles)
    if not solid.all():
        intake.note(path, f"faceVertexIndices: {np.sum(~solid)} triangles without area dropped")
        corners, face, triangles = corners[solid], face[solid], triangles[solid]
    crossing = np.intersect1d(kept[crossing], face)
    if len(crossing):
        intake.note(
            path, f"faceVertexIndices: face {crossing[0]} crosses itself, as do {len(crossing) - 1} more"
        )
    if not len(triangles):
        raise BadPrim("points: got no face with an area, expected one")

    part_of_face, subsets = _material_subsets(mesh, face_count, intake)
    order = np.argsort(part_of_face[face], kind="stable")
    corners, face, triangles = corners[order], face[order], triangles[order]
    if mesh.GetOrientationAttr().Get(intake.time) == "leftHanded":
        corners, triangles = corners[:, [0, 2, 1]], triangles[:, [0, 2, 1]]

    result = MeshData(points.astype(np.float32), triangles.astype(np.int32))
    result.double_sided = bool(mesh.GetDoubleSidedAttr().Get(intake.time))
    sizes = np.bincount(part_of_face[face], minlength=len(subsets))
    firsts = np.cumsum(sizes) - sizes
    named = [
        (Part(int(f), int(n), s.GetName() if s else ""), s)
        for f, n, s in zip(firsts, sizes, subsets, strict=True)
        if n
    ]
    result.parts = [part for part, _ in named]
    elements = {
        "constant": 1,
        "uniform": face_count,
        "vertex": len(points),
        "varying": len(points),
        "faceVarying": len(indices),
    }

    def placed(attribute: CornerAttribute | None, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """(values float64 [n, width], index int32 [triangle_count, 3]); None where it does not fit."""
        if attribute is None:
            return None
        count = len(attribute.values) if attribute.index is None else len(attribute.index)
        expected = elements[attribute.interpolation]
        if count != expected and not (expected == 1 and count > 1):
            intake.bad(
                path,
                f"{name}: got {count} values, expected {expected} for {attribute.interpolation}; not used",
            )
            return None
        if attribute.interpolation == "constant":
            index = np.zeros_like(triangles)
        elif attribute.interpolation == "uniform":
            index = np.repeat(face[:, None], 3, axis=1)
        else:
            index = corners if attribute.interpolation == "faceVarying" else triangles
        if attribute.index is not None:
            index = attribute.index[index]
        return attribute.values, index.astype(np.int32)

    smooth = mesh.GetSubdivisionSchemeAttr().Get(intake.time) != "none"
    normals = None if smooth else placed(*_normals(mesh, intake))
    if normals is not None:
        result.normals, result.normal_index = _unit_normals(*normals, points, triangles, path, intake)
    colors = _primvar(prim, "displayColor", 3, intake)
    if colors is not None and colors.interpolation != "constant":
        colors = placed(colors, "primvars:displayColor")
        if colors is not None:
            result.colors, result.color_index = colors[0].astype(np.float32), colors[1]
    return result, [subset for _, subset in named]


def display_color(prim, intake: Intake) -> tuple[tuple[float, float, float] | None, float]:
    """(mean colour, mean opacity) of primvars displayColor and displayOpacity; None without a colour."""
    color = _primvar(prim, "displayColor", 3, intake)
    opacity = _primvar(prim, "displayOpacity", 1, intake)
    alpha = 1.0
    if opacity is not None and len(opacity.values):
        alpha = float(np.clip(opacity.values.mean(), 0.0, 1.0))
        if opacity.interpolation != "constant" and np.ptp(opacity.values) > 0.0:
            intake.note(
                prim.GetPath(), f"primvars:displayOpacity: varies over the mesh; its mean {alpha:g} is used"
            )
    if color is None:
        return None, alpha
    used = color.values if color.index is None else color.values[color.index]
    mean = used.mean(axis=0) if color.interpolation != "constant" else used[0]
    return tuple(float(v) for v in mean), alpha


def _topology(mesh: UsdGeom.Mesh, intake: Intake) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Validated (points float64 [n, 3], counts int64, indices int64).

    UsdGeomMesh.ValidateTopology accepts negative counts, sums that wrap and points that are not finite: not
    used.
    """
    points = floats(mesh.GetPointsAttr(), intake.time, 3)
    counts = integers(mesh.GetFaceVertexCountsAttr(), intake.time)
    indices = integers(mesh.GetFaceVertexIndicesAttr(), intake.time)
    for name, array in (("points", points), ("faceVertexCounts", counts), ("faceVertexIndices", indices)):
        if array is None or not len(array):
            raise BadPrim(f"{name}: got {'no value' if array is None else 'an empty array'}, expected a mesh")
    low = int(np.argmin(counts))
    if counts[low] < 0:
        raise BadPrim(f"faceVertexCounts[{low}]: got {counts[low]}, expected 3 or more")
    high = int(np.argmax(counts))
    if counts[high] > intake.limits.face_corners:
        raise BadPrim(
            f"faceVertexCounts[{high}]: got {counts[high]}, expected at most {intake.limits.face_corners}"
        )
    if counts.sum() != len(indices):
        raise BadPrim(
            f"faceVertexIndices: got {len(indices)} values, expected {counts.sum()}, the sum of "
            f"faceVertexCounts"
        )
    wrong = (indices < 0) | (indices >= len(points))
    if wrong.any():
        first = int(np.argmax(wrong))
        raise BadPrim(f"faceVertexIndices[{first}]: got {indices[first]}, expected 0 to {len(points) - 1}")
    fine = np.isfinite(points).all(axis=1) & (np.abs(points) <= COORDINATE_MAX).all(axis=1)
    if not fine.all():
        used = np.zeros(len(points), bool)
        used[indices] = True
        if (used & ~fine).any():
            first = int(np.argmax(used & ~fine))
            value = tuple(points[first].tolist())
            raise BadPrim(
                f"points[{first}]: got {value}, expected finite coordinates up to {COORDINATE_MAX:g}"
            )
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
    a, b, c = (points[triangles[:, k]] for k in range(3))
    first, second = b - a, c - a
    longest = np.maximum(np.maximum((first**2).sum(1), (second**2).sum(1)), ((c - b) ** 2).sum(1))
    return np.linalg.norm(np.cross(first, second), axis=1) > DEGENERATE_AREA * longest


def _material_subsets(mesh: UsdGeom.Mesh, face_count: int, intake: Intake) -> tuple[np.ndarray, list]:
    """(part of each face int64 [face_count], GeomSubset prim of each part: None for the rest)."""
    part_of_face = np.zeros(face_count, np.int64)
    subsets = [None]
    for subset in UsdGeom.Subset.GetAllGeomSubsets(mesh):
        prim = subset.GetPrim()
        family = subset.GetFamilyNameAttr().Get()
        if family != UsdShade.Tokens.materialBind:
            if prim.HasRelationship("material:binding"):
                intake.note(
                    prim.GetPath(), f"familyName: got {family!r}; only materialBind subsets carry materials"
                )
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
    primvar = _primvar(mesh.GetPrim(), "normals", 3, intake)
    if primvar is not None:
        return primvar, "primvars:normals"
    try:
        values = floats(mesh.GetNormalsAttr(), intake.time, 3)
    except BadPrim as fault:
        intake.bad(mesh.GetPath(), f"{fault}; not used")
        return None, "normals"
    if values is None or not len(values):
        return None, "normals"
    return CornerAttribute(values, None, str(mesh.GetNormalsInterpolation())), "normals"


def _primvar(prim, name: str, width: int, intake: Intake) -> CornerAttribute | None:
    """A primvar of the prim, or inherited where constant; None (with a note) where it is malformed."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    label = f"primvars:{name}"
    try:
        attribute = primvar.GetAttr()
        value = attribute.Get(intake.time)
        if value is None:
            return None
        if np.ndim(value) == (1 if width > 1 else 0):
            # A single value where an array is expected (seen in real files) can only be constant.
            values = np.array(value, np.float64).reshape(1, width)
        else:
            values = floats(attribute, intake.time, width).reshape(-1, width)
        index = integers(primvar.GetIndicesAttr(), intake.time) if primvar.IsIndexed() else None
    except (BadPrim, ValueError, TypeError) as fault:
        intake.bad(prim.GetPath(), f"{label}: {fault}; not used")
        return None
    interpolation = str(primvar.GetInterpolation())
    if interpolation not in ("constant", "uniform", "vertex", "varying", "faceVarying"):
        intake.bad(
            prim.GetPath(),
            f"{label}: got interpolation {interpolation!r}, expected a UsdGeomPrimvar one; not used",
        )
        return None
    if not len(values):
        return None
    if index is not None:
        wrong = (index < 0) | (index >= len(values))
        if not len(index) or wrong.any():
            first = int(np.argmax(wrong)) if len(index) else 0
            got = index[first] if len(index) else "nothing"
            intake.bad(
                prim.GetPath(),
                f"{label}:indices[{first}]: got {got}, expected 0 to {len(values) - 1}; not used",
            )
            return None
    if name == "normals":
        return CornerAttribute(values, index, interpolation)
    if not np.isfinite(values).all():
        first = int(np.argmin(np.isfinite(values).all(axis=1)))
        intake.bad(
            prim.GetPath(), f"{label}[{first}]: got {tuple(values[first])}, expected finite numbers; not used"
        )
        return None
    return CornerAttribute(values, index, interpolation)


def _unit_normals(values, index, points, triangles, path, intake: Intake) -> tuple[np.ndarray, np.ndarray]:
    """Unit float32 normals; what is zero or not finite becomes the normal of a face that uses it."""
    largest = np.abs(values).max(axis=1)
    good = np.isfinite(largest) & (largest > 0.0)
    unit = np.where(good[:, None], values, 1.0) / np.where(good, largest, 1.0)[:, None]
    if not good[index].all():
        first = int(np.argmin(good))
        intake.note(
            path,
            f"normals[{first}]: got {tuple(values[first].tolist())}; {int(np.sum(~good))} replaced by "
            f"face normals",
        )
        a, b, c = (points[triangles[:, k]] for k in range(3))
        facet = np.cross(b - a, c - a)
        facet /= np.linalg.norm(facet, axis=1, keepdims=True)
        row, corner = np.nonzero(~good[index])
        unit[index[row, corner]] = facet[row]
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return unit.astype(np.float32), index
