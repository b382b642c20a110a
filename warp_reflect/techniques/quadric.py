"""Quadric mirrors: every vertex solved on the analytic surface, patch by patch.

Source: Lages Miguel, Nogueira, Goncalves, "Real-Time 3D Visualization of Accurate Specular Reflections in Curved Mirrors"
(GRAPP 2014), for mirrors x^2 + y^2 + A z^2 + B z - C = 0. What differs: the search (`quadric_search.py`), any quadric
instead of those of revolution, a mirror with rims is solved piece by piece (a capped cylinder: its side and two planes),
and a mesh that a quadric describes within a fraction of a pixel counts as one. What a mesh shows stays its own surface:
the quadric gives the candidates, refinement the hits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warp_reflect.layers import Camera, GBuffer, MirrorPixels, ReflectionLayer, Reflector
from warp_reflect.quadrics import FAMILY, CanonicalQuadric, Family, QuadricKind
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings, Technique
from warp_reflect.techniques import pieces, planar, quadric_branches, quadric_patch
from warp_reflect.techniques.pieces import Piece
from warp_reflect.techniques.quadric_sheets import Sheet, sheets_of

# Of the size, and a sine: what is asked where no view is known.
RESIDUAL_MAX = 1.0e-3


@dataclass(frozen=True)
class Prepared:
    """A mirror as its pieces.

    Attributes:
        reflector: The mirror.
        pieces: One or more; see `pieces.Piece`.
    """

    reflector: Reflector
    pieces: list[Piece]
    bytes: int = 0


def applies(
    scene: Scene, reflector: Reflector, camera: Camera | None = None, shape_px: float = 0.5
) -> tuple[bool, str]:
    """A part all of whose patches are analytic with a quadric among them, or a mesh that a quadric describes.

    Args:
        camera: The view in whose pixels the residual of a mesh is judged; None: by size.
        shape_px: A mesh whose points and normals would shift the picture by more is no quadric. Refinement starts from
            candidates that are off by this, and a pixel next to the right one is a neighbour in all but the finest meshes.
    """
    sheets = sheets_of(scene, reflector.part)
    analytic = scene.patch_shapes[scene.parts[reflector.part].patches[0]] is not None
    strange = [sheet.name for sheet in sheets if not sheet.known]
    if strange:
        what = "an analytic patch is no curved surface in the world" if analytic else "mesh not recognised"
        return False, f"{what}: {strange[0]}"
    if not any(sheet.quadric for sheet in sheets):
        return False, "no curved patch" if analytic else "mesh not recognised: it is flat"
    names = ", ".join(dict.fromkeys(sheet.name for sheet in sheets))
    count = f" ({len(sheets)} patches)" if len(sheets) > 1 else ""
    if analytic:
        return True, f"analytic: {names}{count}" + _branches_text(scene, reflector, camera)
    residual, unit, limit = _residual(scene, reflector.part, sheets, camera, shape_px)
    text = f"residual {residual:.2g} {unit} (at most {'' if camera is None else 'shape_px='}{limit:g})"
    if residual > limit:
        return False, f"mesh not recognised: nearest is {names}{count}, {text}"
    return True, f"mesh recognised as {names}{count}, {text}" + _branches_text(scene, reflector, camera)


def _branches_text(scene: Scene, reflector: Reflector, camera: Camera | None) -> str:
    if camera is None or not has_branches(scene, reflector, camera):
        return ""
    return ", seen from within: up to three pictures of every vertex"


def has_branches(scene: Scene, reflector: Reflector, camera: Camera) -> bool:
    """True where the eye sees a side of the mirror on which one point appears several times; where it applies."""
    if reflector.convex:
        return False
    eye = camera.eye - scene.origin
    for sheet in sheets_of(scene, reflector.part):
        quadric = sheet.quadric
        if quadric is None:
            continue
        if FAMILY[quadric.kind] == Family.GENERAL:
            return True
        middle = scene.host_points[scene.host_triangles[sheet.triangles]].astype(np.float64).mean(axis=1)
        if (np.einsum("ij,ij->i", quadric_patch.gradients(quadric, middle), eye - middle) < 0.0).any():
            return True
    return False


def extent(scene: Scene, reflector: Reflector) -> tuple[int, float]:
    """(how often a frame reflects every vertex of the scene: of parallel caps the eye sees one; share that it holds)."""
    sheets = sheets_of(scene, reflector.part)
    return sum(sheet.quadric is not None for sheet in sheets) + any(sheet.plane is not None for sheet in sheets), 1.0


def prepare(scene: Scene, reflector: Reflector, settings: Settings) -> Prepared:
    """Every patch in its unit frame."""
    found = []
    for sheet in sheets_of(scene, reflector.part):
        if sheet.quadric is not None:
            found += _sides(scene, reflector, sheet)
        else:
            found.append(Piece(sheet.triangles, planar, planar.Prepared(reflector, sheet.plane)))
    return Prepared(reflector, _numbered(found))


def reflect(
    scene: Scene,
    prepared: Prepared,
    gbuffer: GBuffer,
    pixels: MirrorPixels,
    camera: Camera,
    settings: Settings,
    history=None,
) -> ReflectionLayer:
    """Reflect patch by patch: see `pieces.reflect`; a mirror of one piece needs no masks."""
    only = prepared.pieces[0]
    if len(prepared.pieces) == 1 and only.holds is None:
        return only.technique.reflect(scene, only.prepared, gbuffer, pixels, camera, settings, history)
    return pieces.reflect(
        scene, prepared.reflector, Technique.QUADRIC, prepared.pieces, gbuffer, pixels, camera, settings, history
    )


def _numbered(found: list[Piece]) -> list[Piece]:
    """The pieces with their numbers as reflector ids, which is what `pieces.reflect` masks by; one alone keeps its id."""
    if len(found) == 1 and found[0].holds is None:
        return found
    return [
        replace(piece, prepared=replace(piece.prepared, reflector=replace(piece.prepared.reflector, id=number)))
        for number, piece in enumerate(found, 1)
    ]


def _sides(scene: Scene, reflector: Reflector, sheet: Sheet) -> list[Piece]:
    """The sides of a quadric sheet that the eye can see."""
    own, quadric = sheet.triangles, sheet.quadric
    corner = scene.host_points[scene.host_triangles[own]].reshape(-1, 3).astype(np.float64)
    quadric = _towards(quadric, corner)
    convex = FAMILY[quadric.kind] != Family.GENERAL
    outside = quadric_patch.Prepared(reflector, quadric, quadric_patch.similarity(quadric), sheet.distance > 0.0)
    if reflector.convex and convex:
        return [Piece(own, quadric_patch, outside)]

    def facing(sign: int):
        def holds(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
            return sign * np.einsum("ij,ij->i", quadric_patch.gradients(quadric, points), normals) > 0.0

        return holds

    first = Piece(own, quadric_patch, outside, facing(1))
    if not convex:
        first = Piece(own, quadric_branches, quadric_branches.prepare_side(reflector, quadric, 1), facing(1))
    return [first, Piece(own, quadric_branches, quadric_branches.prepare_side(reflector, quadric, -1), facing(-1))]


def _towards(quadric: CanonicalQuadric, points: np.ndarray) -> CanonicalQuadric:
    """The quadric turned so that a sheet's points lie at z > 0; a cone, which has no size of its own, gets theirs."""
    if quadric.kind not in (QuadricKind.TWO_SHEETS, QuadricKind.HYPERBOLIC_CYLINDER, QuadricKind.CONE):
        return quadric
    local = (points - quadric.origin) @ quadric.axes
    axes = quadric.axes
    if local[:, 2].mean() < 0.0:
        axes = axes * np.array([1.0, -1.0, -1.0])
    size = float(np.linalg.norm(local, axis=1).max()) if quadric.kind == QuadricKind.CONE else quadric.size
    return replace(quadric, axes=axes, size=size)


def _residual(scene: Scene, part_index: int, sheets: list[Sheet], camera: Camera | None, shape_px: float):
    """(residual, its unit, its limit): how far points and normals off the surfaces move what the mirror shows."""
    part = scene.parts[part_index]
    points = scene.host_points[part.first_vertex : part.first_vertex + part.vertex_count].astype(np.float64)
    size = 0.5 * float(np.linalg.norm(np.ptp(points, axis=0)))
    # A normal off by an angle moves the reflection point by that angle times the radius of curvature, at most the size.
    shift = max(sheet.distance + sheet.sine * size for sheet in sheets)
    if camera is None:
        return shift / size, "of its size", RESIDUAL_MAX
    nearest = float(np.linalg.norm(points - (camera.eye - scene.origin), axis=1).min())
    return shift * max(camera.fx, camera.fy) / max(nearest, 1.0e-300), "px", shape_px
