"""The analytic mirrors of the bare solver: `PlanarMirror` and `QuadricMirror`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warp_reflect.quadrics import FAMILY, MAX_ROOTS, RANK_TOLERANCE, CanonicalQuadric, Family, canonical_quadric


@dataclass(frozen=True)
class PlanarMirror:
    """A flat mirror; it reflects on the side its normal points to.

    Attributes:
        point: A point of the plane, the centre of the extent; world, float64 [3]. [scene units]
        normal: float64 [3], any length but 0; normalised here.
        extent: (half width, half height) of the rectangle, or None for the whole plane. [scene units]
        up: The height runs along this direction projected to the plane, the width along up x normal;
        float64 [3].
            None: world +Y, or world -Z for a mirror that faces along +-Y (within 0.01 degrees).
        side: "outer": the normal's side; "inner": the other.

    Raises:
        ValueError: on creation; an argument is not finite, a direction is zero, an extent is not positive.
    """

    point: Any
    normal: Any
    extent: Any = None
    up: Any = None
    side: str = "outer"
    width_axis: np.ndarray = field(init=False, repr=False, compare=False)
    height_axis: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        _check_side("PlanarMirror", self.side)
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        put("point", _vector(self.point, "PlanarMirror point"))
        normal = _direction(self.normal, "PlanarMirror normal")
        put("normal", -normal if self.side == "inner" else normal)
        if self.up is None:
            up = np.array([0.0, 1.0, 0.0])
            if abs(normal[1]) > 1.0 - 1.5e-8:  # cos of 0.01 degrees
                up = np.array([0.0, 0.0, -1.0])
        else:
            up = _direction(self.up, "PlanarMirror up")
        height = up - up @ normal * normal
        if np.linalg.norm(height) < 1e-9:
            raise ValueError(f"PlanarMirror up: {up.tolist()} is parallel to the normal; give another direction")
        height /= np.linalg.norm(height)
        put("height_axis", height)
        put("width_axis", np.cross(height, normal))
        if self.extent is not None:
            extent = np.asarray(self.extent, np.float64)
            if extent.shape != (2,) or not np.isfinite(extent).all() or not (extent > 0.0).all():
                raise ValueError(
                    f"PlanarMirror extent: got {self.extent!r}, expected (half width, half height), both positive"
                )
            put("extent", (float(extent[0]), float(extent[1])))

    @property
    def matrix(self) -> np.ndarray:
        """The plane as a quadric without curvature, float64 [4, 4]: 2 normal.(x - point), negative behind it."""
        q = np.zeros((4, 4))
        q[:3, 3] = q[3, :3] = self.normal
        q[3, 3] = -2.0 * self.normal @ self.point
        return q


@dataclass(frozen=True)
class QuadricMirror:
    """The surface x~^T Q x~ = 0, negative inside; it reflects on the outside unless side="inner".

    Make one with `sphere`, `from_matrix` or `rotational`.

    Attributes:
        canonical: The quadric in its unit principal frame.
        side: "outer" or "inner".
        sheet: Of a hyperboloid, hyperbolic cylinder or cone: +1 or -1, the part on that side of the centre
            along `axis`; 0: both. With both, a part in which the eye or the point lies does not take part.
    """

    canonical: CanonicalQuadric
    side: str = "outer"
    sheet: int = 0

    @classmethod
    def sphere(cls, center, radius: float, side: str = "outer") -> QuadricMirror:
        """A sphere.

        Args:
            center: World, [3]. [scene units]
            radius: Positive. [scene units]
            side: "outer" (a ball) or "inner" (a hollow).

        Raises:
            ValueError: center or radius is not finite, or radius is not positive.
        """
        _check_side("QuadricMirror.sphere", side)
        center = _vector(center, "QuadricMirror.sphere center")
        radius = float(radius)
        if not (np.isfinite(radius) and radius > 0.0):
            raise ValueError(f"QuadricMirror.sphere radius: got {radius}, expected a positive number")
        quadric = canonical_quadric(
            np.eye(3),
            np.zeros(3),
            -1.0,
            np.zeros(3),
            "QuadricMirror.sphere",
            RANK_TOLERANCE[np.dtype(np.float64)],
        )
        return cls(replace(quadric, origin=center, size=radius), side)

    @classmethod
    def from_matrix(cls, Q, side: str = "outer", sheet: int = 0) -> QuadricMirror:
        """The quadric of a symmetric 4x4 matrix in world space.

        Args:
            Q: [4, 4]; x~^T Q x~ is negative inside. The antisymmetric part has no effect.
            side: "outer" or "inner".
            sheet: See the class; the sign of z of `axis` is made positive along its largest component.

        Raises:
            ValueError: Q has another shape, is not finite, or has no curved real surface.
        """
        _check_side("QuadricMirror.from_matrix", side)
        given = np.asarray(Q)
        tolerance = RANK_TOLERANCE.get(given.dtype, RANK_TOLERANCE[np.dtype(np.float64)])
        matrix = np.asarray(given, np.float64)
        if matrix.shape != (4, 4):
            raise ValueError(f"QuadricMirror.from_matrix Q: got shape {matrix.shape}, expected (4, 4)")
        matrix = 0.5 * (matrix + matrix.T)
        quadric = canonical_quadric(
            matrix[:3, :3], matrix[:3, 3], matrix[3, 3], np.zeros(3), "QuadricMirror.from_matrix Q", tolerance
        )
        axis = quadric.axes[:, 2]
        up = axis * np.sign(axis[np.argmax(np.abs(axis))])
        return cls(_turn_axis(quadric, up), side, _check_sheet("QuadricMirror.from_matrix", sheet, quadric))

    @classmethod
    def rotational(
        cls, A: float, B: float, C: float, world_from_object=None, side: str = "outer", sheet: int = 0
    ) -> QuadricMirror:
        """x^2 + y^2 + A z^2 + B z - C = 0 in object space (Lages Miguel et al. 2014, equation 1).

        A = 1 is a sphere, A > 0 a spheroid, A = 0 a paraboloid (B != 0) or a cylinder (B = 0), A < 0 a
        hyperboloid or, where its two sheets meet, a cone.

        Args:
            A: Coefficient of z^2.
            B: Coefficient of z. [scene units]
            C: Constant. [scene units^2]
            world_from_object: [4, 4], acts on columns; None: the identity. Any invertible affine map.
            side: "outer" or "inner".
            sheet: +1: the part towards object +z, -1: the other, 0: both (two-sheeted surfaces only).

        Raises:
            ValueError: a number is not finite, the map is not invertible, or there is no curved real surface.
        """
        _check_side("QuadricMirror.rotational", side)
        name = f"QuadricMirror.rotational A={A}, B={B}, C={C}"
        world = np.eye(4) if world_from_object is None else np.asarray(world_from_object, np.float64)
        if world.shape != (4, 4) or not np.isfinite(world).all():
            raise ValueError(f"{name}: world_from_object must be a finite [4, 4] matrix, got shape {world.shape}")
        if not np.allclose(world[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-12):
            raise ValueError(f"{name}: world_from_object must have the last row 0 0 0 1, got {world[3].tolist()}")
        linear = world[:3, :3]
        scale = np.abs(linear).max()
        if not scale > 0.0 or abs(np.linalg.det(linear / scale)) < 1e-12:
            raise ValueError(f"{name}: world_from_object is not invertible; give every axis a scale other than 0")
        back = np.linalg.inv(linear)
        a = back.T @ np.diag([1.0, 1.0, float(A)]) @ back
        b = back.T @ np.array([0.0, 0.0, 0.5 * float(B)])
        tolerance = RANK_TOLERANCE[np.dtype(np.float64)]
        quadric = canonical_quadric(a, b, -float(C), world[:3, 3], name, tolerance)
        return cls(_turn_axis(quadric, linear[:, 2]), side, _check_sheet(name, sheet, quadric))

    @property
    def axis(self) -> np.ndarray:
        """Unit world direction of the principal z axis, float64 [3]."""
        return self.canonical.axes[:, 2]

    @property
    def reverse(self) -> bool:
        """The reflecting side is the inside of the canonical body."""
        return self.canonical.inner != (self.side == "inner")

    @property
    def convex(self) -> bool:
        """At most one reflection point per sheet exists."""
        return not self.reverse and FAMILY[self.canonical.kind] != Family.GENERAL

    @property
    def matrix(self) -> np.ndarray:
        """Q in world space, float64 [4, 4], negative on the side that does not reflect."""
        quadric = self.canonical
        unit = np.zeros((4, 4))
        unit[:3, :3] = np.diag(quadric.lam)
        unit[2, 3] = unit[3, 2] = quadric.b
        unit[3, 3] = quadric.c
        unit_from_world = np.eye(4)
        unit_from_world[:3, :3] = quadric.axes.T / quadric.size
        unit_from_world[:3, 3] = -quadric.axes.T @ quadric.origin / quadric.size
        q = unit_from_world.T @ unit @ unit_from_world
        return -q if self.reverse else q

    @property
    def max_roots(self) -> int:
        """Bound on the reflection points of one pair: the degree of the problem."""
        if self.convex:
            return 2 if FAMILY[self.canonical.kind] == Family.SHEET and self.sheet == 0 else 1
        return {1: MAX_ROOTS, 2: 8, 3: 4}[self.canonical.equal]


def _turn_axis(quadric: CanonicalQuadric, up: np.ndarray) -> CanonicalQuadric:
    """Turn the frame half round where z may point either way (b = 0), so that it points along `up`."""
    if quadric.b == 0.0 and quadric.axes[:, 2] @ up < 0.0:
        return replace(quadric, axes=quadric.axes * np.array([1.0, -1.0, -1.0]))
    return quadric


def _check_side(name: str, side: str) -> None:
    if side not in ("outer", "inner"):
        raise ValueError(f"{name} side: got {side!r}, expected 'outer' or 'inner'")


def _check_sheet(name: str, sheet: int, quadric: CanonicalQuadric) -> int:
    if sheet not in (-1, 0, 1):
        raise ValueError(f"{name} sheet: got {sheet!r}, expected 1, -1 or 0 (both)")
    if sheet != 0 and FAMILY[quadric.kind] != Family.SHEET:
        kind = quadric.kind.name.lower().replace("_", " ")
        raise ValueError(f"{name} sheet: got {sheet}, but this {kind} has one part; leave it 0")
    return sheet


def _vector(value, name: str) -> np.ndarray:
    vector = np.asarray(value, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"{name}: got {value!r}, expected 3 finite numbers")
    return vector


def _direction(value, name: str) -> np.ndarray:
    vector = _vector(value, name)
    largest = np.abs(vector).max()
    if largest == 0.0:
        raise ValueError(f"{name}: got the zero vector, expected a direction")
    vector = vector / largest
    return vector / np.linalg.norm(vector)
