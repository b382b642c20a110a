"""Virtual objects in world space: what a mirror shows, as meshes behind it that any renderer can draw.

A virtual vertex lies on the line of sight through the reflection point, as far behind it as the light travelled (Ofek and
Rappoport 1998; Estalella et al. 2005): seen from the eye it was made for, the virtual mesh covers the very pixels at which
the mirror shows the object, in the right order of depth. From another eye it is right for planes alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_reflect.clipping import clip_to_mask
from warp_reflect.layers import Camera, ReflectionLayer
from warp_reflect.scene import Scene
from warp_reflect.techniques.virtual_mesh import Drawn


@dataclass(frozen=True)
class VirtualObject:
    """One object as one mirror, or one piece of it, shows it to an eye.

    Attributes:
        reflector: `reflectorId` of the mirror.
        piece: 1-based among the pieces of the mirror that are seen (the side and the caps of a cylinder, the two sides of a
            sheet), each with a picture of its own; 0 where the mirror is one piece.
        part: Index into `Scene.parts` of the object.
        points: float64 [n, 3], virtual, world axes, relative to the eye. [scene units]
        sources: float64 [n, 3], the object's own points, scene frame.
        triangles: int32 [m, 3], wound so that the side the mirror shows is counter-clockwise where it is on the object.
        parents: int32 [m], the scene's triangle that each is a picture of.
    """

    reflector: int
    piece: int
    part: int
    points: np.ndarray
    sources: np.ndarray
    triangles: np.ndarray
    parents: np.ndarray


def virtual_objects(
    scene: Scene, camera: Camera, layers: dict[int, ReflectionLayer], clip: bool = False
) -> list[VirtualObject]:
    """The virtual objects of every mirror that a forward technique answered; a traced mirror has none.

    A triangle is there if all of its corners have a virtual vertex; of one that the mirror itself hides in part, the visible
    side is.

    Args:
        scene: Of the frame.
        camera: Of the frame.
        layers: By reflector id, as `Frame.layers`.
        clip: Cut the meshes, seen from the eye, along the outline of the pixels at which their mirror, or piece of it, is
            seen: pixel squares, so that twice the resolution halves the error of the outline.
    """
    part_of = _part_of_triangle(scene)
    found = []
    for reflector, layer in sorted(layers.items()):
        pictures: dict[int, list[Drawn]] = {}
        for drawn in layer.virtual:
            pictures.setdefault(id(drawn.pixels), []).append(drawn)
        for piece, drawn in enumerate(pictures.values(), 1):
            triangles = _Triangles.together([_solved(scene, camera, each) for each in drawn])
            triangles = triangles.wound(scene)
            if clip:
                triangles = triangles.clipped(camera, _mask(camera, drawn[0].pixels.pixel.numpy()))
            number = piece if len(pictures) > 1 else 0
            parts = part_of[triangles.parents]
            found += [
                VirtualObject(reflector, number, int(part), *triangles.of(parts == part)) for part in np.unique(parts)
            ]
    return found


@dataclass(frozen=True)
class _Triangles:
    """Virtual triangles of many objects; the fields as in `VirtualObject`."""

    points: np.ndarray
    sources: np.ndarray
    triangles: np.ndarray
    parents: np.ndarray
    eye: np.ndarray  # scene frame

    @classmethod
    def together(cls, several: list[_Triangles]) -> _Triangles:
        first = np.cumsum([0] + [len(each.points) for each in several[:-1]])
        return cls(
            np.concatenate([each.points for each in several]),
            np.concatenate([each.sources for each in several]),
            np.concatenate([each.triangles + n for each, n in zip(several, first, strict=True)]),
            np.concatenate([each.parents for each in several]),
            several[0].eye,
        )

    def of(self, chosen: np.ndarray) -> tuple[np.ndarray, ...]:
        """(points, sources, triangles, parents) of some triangles, without the points that none of them uses."""
        used, place = np.unique(self.triangles[chosen], return_inverse=True)
        triangles = place.reshape(-1, 3).astype(np.int32)
        return self.points[used], self.sources[used], triangles, self.parents[chosen].astype(np.int32)

    def wound(self, scene: Scene) -> _Triangles:
        """Turned over where the eye would see the other side than the mirror shows.

        An image in a plane is mirrored, but of the several images in a hollow mirror some are not.
        """
        virtual, source = self.points[self.triangles], self.sources[self.triangles]
        v, p = virtual.mean(axis=1), source.mean(axis=1) - self.eye
        path = np.linalg.norm(v, axis=1, keepdims=True)
        u = v / np.maximum(path, 1.0e-300)
        # The reflection point lies on the first, as far from the point as from the virtual point.
        span = np.maximum(path - np.einsum("ij,ij->i", u, p)[:, None], 1.0e-300)
        r = 0.5 * (path**2 - np.einsum("ij,ij->i", p, p)[:, None]) / span * u
        shown = np.einsum("ij,ij->i", _normals(source), r - p)
        seen = np.einsum("ij,ij->i", _normals(virtual), -v)
        triangles = np.where((shown * seen < 0.0)[:, None], self.triangles[:, [0, 2, 1]], self.triangles)
        return _Triangles(self.points, self.sources, triangles, self.parents, self.eye)

    def clipped(self, camera: Camera, mask: np.ndarray) -> _Triangles:
        """Cut along the outline of pixels."""
        corners = (self.points @ _pixels_from_eye(camera).T)[self.triangles]
        owner, weights, triangles = clip_to_mask(corners, mask, camera.near)
        points, sources = (
            np.einsum("pk,pkj->pj", weights, each[self.triangles[owner]]) for each in (self.points, self.sources)
        )
        parents = self.parents[owner[triangles[:, 0]]]
        return _Triangles(points, sources, triangles, parents, self.eye)


def _solved(scene: Scene, camera: Camera, drawn: Drawn) -> _Triangles:
    """What was drawn, back from the screen to space."""
    screen = drawn.screen.numpy()
    corners = drawn.mesh.host_triangles
    kept = (screen[corners, 2] >= 0.0).all(axis=1)
    triangles, parents = corners[kept], drawn.mesh.host_parents[kept]
    eye = camera.eye - scene.origin
    used, place = np.unique(triangles, return_inverse=True)
    # Every solved vertex has its place on the screen, whichever technique solved it.
    points = _unproject(camera, screen[used].astype(np.float64))
    sources = drawn.mesh.points.numpy()[used].astype(np.float64)
    triangles = place.reshape(-1, 3)
    sides = drawn.straddling
    if sides is not None:
        own, boundary, side_triangles, owners = sides.on_host()
        seen = screen[own, 2] >= 0.0  # the others are corners behind the mirror, which no triangle here uses
        there = np.zeros((len(own), 3))
        there[seen] = _unproject(camera, screen[own[seen]].astype(np.float64))
        boundary = boundary.astype(np.float64)
        whole = np.concatenate([seen, np.ones(len(boundary), bool)])[side_triangles].all(axis=1)
        triangles = np.concatenate([triangles, side_triangles[whole] + len(points)])
        parents = np.concatenate([parents, drawn.mesh.host_parents[owners[whole]]])
        points = np.concatenate([points, there, boundary])
        sources = np.concatenate([sources, drawn.mesh.points.numpy()[own].astype(np.float64), boundary + eye])
    return _Triangles(points, sources, triangles.astype(np.int32), parents, eye)


def _unproject(camera: Camera, screen: np.ndarray) -> np.ndarray:
    """Eye-frame points of `layers.project`'s (x, y, key, depth)."""
    # In front of the near plane, where the key is 0, x and y are homogeneous already.
    scale = np.where(screen[:, 2] > 0.0, screen[:, 3], 1.0)[:, None]
    homogeneous = np.concatenate([screen[:, :2] * scale, screen[:, 3:]], axis=1)
    return homogeneous @ np.linalg.inv(_pixels_from_eye(camera)).T


def _pixels_from_eye(camera: Camera) -> np.ndarray:
    """float64 [3, 3]: eye-frame point to homogeneous pixel coordinates, as `Camera.view` has it."""
    return np.stack(
        [
            camera.fx * camera.right + camera.cx * camera.forward,
            -camera.fy * camera.up + camera.cy * camera.forward,
            camera.forward,
        ]
    )


def _mask(camera: Camera, pixel: np.ndarray) -> np.ndarray:
    width, height = camera.size
    mask = np.zeros(width * height, bool)
    mask[pixel] = True
    return mask.reshape(height, width)


def _normals(corner: np.ndarray) -> np.ndarray:
    return np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])


def _part_of_triangle(scene: Scene) -> np.ndarray:
    part_of = np.zeros(scene.triangle_count, np.int32)
    for k, part in enumerate(scene.parts):
        part_of[part.first_triangle : part.first_triangle + part.triangle_count] = k
    return part_of
