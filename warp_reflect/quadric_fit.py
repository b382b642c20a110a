"""The quadric that a smooth triangle mesh was made from, found from its points and normals. Host, float64.

Source: Taubin, "Estimation of Planar Curves, Surfaces and Nonplanar Space Curves Defined by Implicit Equations", IEEE PAMI
13(11), 1991: minimise the mean of q^2 under a unit mean of |grad q|^2, a generalised eigenproblem. What differs: the
points are whitened, so that long bodies keep their digits, and normals count too: n x grad q = 0 is linear in q as well
and ties the quadric down where the points alone are nearly flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_reflect.quadrics import CanonicalQuadric, QuadricKind, canonical_quadric

POINTS_MIN = 10  # a quadric has nine degrees of freedom
NORMAL_WEIGHT = 1.0  # of a normal's sine against a distance of the (whitened) size
# Principal values below this share of the largest may be rounding (the axis of a cylinder): tried from coarse to fine,
# the first whose surface is as good as the finest one's is taken.
RANK_TOLERANCES = (1.0e-2, 1.0e-3, 1.0e-4, 1.0e-5, 1.0e-6, 1.0e-8, 1.0e-13)
FLATNESS = 1.0e-6  # thickness over width below which points lie on a plane
AS_GOOD = 1.5  # times the best residual
ROUNDING = 2.0e-7  # of the size: what float32 points miss their own surface by


SAMPLE = 4096  # points that decide the ten coefficients; more change them by less than their rounding
HOPELESS_SINE = 0.2  # of a normal, 12 degrees: no picture of a mirror forgives it


@dataclass(frozen=True)
class Fit:
    """A quadric and how well it describes a mesh.

    Attributes:
        quadric: In its unit principal frame; world is the frame of the points.
        distance: Largest distance of a point from the surface, first order. [scene units]
        sine: Largest sine between a normal and the surface's, either way round.
    """

    quadric: CanonicalQuadric
    distance: float
    sine: float

    @property
    def half_axes(self) -> np.ndarray:
        """Half axes of an ellipsoid, radii of a cylinder (infinite along it), float64 [3]. [scene units]."""
        with np.errstate(divide="ignore"):
            return self.quadric.size / np.sqrt(np.abs(self.quadric.lam))

    def __str__(self) -> str:
        kind = self.quadric.kind
        name = kind.name.lower().replace("_", " ")
        if kind in (QuadricKind.ELLIPSOID, QuadricKind.ELLIPTIC_CYLINDER):
            axes = self.half_axes[np.isfinite(self.half_axes)]
            return f"{name} ({' x '.join(f'{axis:.4g}' for axis in axes)})"
        return name


def fit_quadric(points: np.ndarray, normals: np.ndarray) -> Fit | None:
    """The quadric nearest to points with normals; None where none has a curved real surface there.

    Args:
        points: [n, 3]; repeated points count repeatedly. [scene units]
        normals: Unit, [n, 3], on either side.
    """
    points = np.asarray(points, np.float64)
    normals = np.asarray(normals, np.float64)
    if len(points) < POINTS_MIN or not (np.isfinite(points).all() and np.isfinite(normals).all()):
        return None
    best = _fitted(*(values[:: max(1, len(points) // SAMPLE)] for values in (points, normals)))
    # The largest residual of all points is no smaller than that of some.
    if best is None or best.sine > HOPELESS_SINE:
        return best
    return Fit(best.quadric, *_residuals(best.quadric, points, normals))


def _fitted(points: np.ndarray, normals: np.ndarray) -> Fit | None:
    middle = points.mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov((points - middle).T))
    if not spread[0] > FLATNESS**2 * spread[2]:
        return None  # points on a line or a plane
    # A flat cap keeps a share of its width as thickness: noise must not be blown up into shape.
    extent = np.sqrt(3.0 * np.maximum(spread, 1.0e-12 * spread[2]))
    x = (points - middle) @ axes / extent
    n = normals @ axes * extent
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1.0e-300)
    coefficients = _taubin(x, n)
    if coefficients is None:
        return None
    xx, yy, zz, yz, zx, xy, lx, ly, lz, constant = coefficients
    whitened = np.array([[xx, xy / 2, zx / 2], [xy / 2, yy, yz / 2], [zx / 2, yz / 2, zz]])
    unwhiten = axes / extent  # columns: x = unwhiten^T (p - middle)
    a = unwhiten @ whitened @ unwhiten.T
    b = 0.5 * unwhiten @ np.array([lx, ly, lz])
    fits = []
    for tolerance in RANK_TOLERANCES:
        try:
            quadric = canonical_quadric(
                *_snapped(a, b, points - middle, tolerance), constant, middle, "fit_quadric", tolerance
            )
        except ValueError:
            continue  # a pair of planes, a point: no curved surface at this tolerance
        fits.append(Fit(quadric, *_residuals(quadric, points, normals)))
    if not fits:
        return None
    size = float(np.sqrt(spread[2]))
    best = min(fit.distance / size + fit.sine for fit in fits)
    return next(fit for fit in fits if fit.distance / size + fit.sine <= max(AS_GOOD * best, ROUNDING))


def _snapped(a: np.ndarray, b: np.ndarray, local: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic and linear part without the principal terms that stay below a share of the largest over the points."""
    values, axes = np.linalg.eigh(a)
    extent = np.abs(local @ axes).max(axis=0)
    terms = np.abs(values) * extent**2
    kept = terms > tolerance * terms.max()
    slopes = axes.T @ b
    # A slope matters only where nothing curves: elsewhere it moves the centre.
    straight = ~kept & (2.0 * np.abs(slopes) * extent <= tolerance * terms.max())
    values, slopes = np.where(kept, values, 0.0), np.where(straight, 0.0, slopes)
    return (axes * values) @ axes.T, axes @ slopes


def _taubin(x: np.ndarray, n: np.ndarray) -> np.ndarray | None:
    """Coefficients of x^2, y^2, z^2, yz, zx, xy, x, y, z, 1; None for points without extent."""
    one, zero = np.ones(len(x)), np.zeros(len(x))
    u, v, w = x.T
    value = np.stack([u * u, v * v, w * w, v * w, w * u, u * v, u, v, w], 1)
    gradient = np.stack(
        [
            np.stack([2 * u, zero, zero, zero, w, v, one, zero, zero], 1),
            np.stack([zero, 2 * v, zero, w, zero, u, zero, one, zero], 1),
            np.stack([zero, zero, 2 * w, v, u, zero, zero, zero, one], 1),
        ]
    )
    cross = np.concatenate(
        [n[:, [(k + 1) % 3]] * gradient[(k + 2) % 3] - n[:, [(k + 2) % 3]] * gradient[(k + 1) % 3] for k in range(3)]
    )
    mean = value.mean(axis=0)
    centred = value - mean
    errors = centred.T @ centred + NORMAL_WEIGHT**2 * cross.T @ cross
    flat = gradient.reshape(-1, 9)
    slopes = flat.T @ flat
    # The best constant is minus the mean of the rest; without it the constraint is definite.
    scale = np.trace(slopes)
    if not scale > 0.0:
        return None
    try:
        root = np.linalg.cholesky(slopes + 1.0e-13 * scale * np.eye(9))
    except np.linalg.LinAlgError:
        return None
    inverse = np.linalg.inv(root)
    _, vectors = np.linalg.eigh(inverse @ errors @ inverse.T)
    chosen = inverse.T @ vectors[:, 0]
    return np.append(chosen, -mean @ chosen)


def _residuals(quadric: CanonicalQuadric, points: np.ndarray, normals: np.ndarray) -> tuple[float, float]:
    """Largest first-order distance of the points and largest sine of the normals."""
    x = (points - quadric.origin) @ quadric.axes / quadric.size
    gradient = x * quadric.lam + [0.0, 0.0, quadric.b]
    length = np.linalg.norm(gradient, axis=1)
    good = length > 0.0  # a cone's apex has no normal
    surface = (gradient[good] / length[good, None]) @ quadric.axes.T
    sine = np.linalg.norm(np.cross(surface, normals[good]), axis=1)
    return float(quadric.distances(points).max()), float(sine.max(initial=0.0))
