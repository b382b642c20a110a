"""The bare solver for refraction: where does the eye see each point through water or through a body of glass?

`refract(surface, eye, points, ior)` is to Snell's law what `solver.solve` is to the law of reflection.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_reflect.launch import launch
from warp_reflect.mirrors import PlanarMirror, QuadricMirror
from warp_reflect.quadrics import QuadricKind
from warp_reflect.solve_device import quadric_view
from warp_reflect.solve_refraction import refract_body_kernel, refract_plane_kernel
from warp_reflect.solver import MAX_PAIRS
from warp_reflect.solver_arrays import host_vectors, points_to_device


@dataclass
class Refraction:
    """Refracted paths, in the type and library of the points that were given.

    Shapes are for one eye; with eyes [m, 3] each has a leading m. Where there is no path everything is 0 and `status` says
    why; GRAZING, NEAR_CAUSTIC, OUT_OF_EXTENT and MAX_ITERATIONS come with their values.

    Attributes:
        point: Where the eye's ray meets the surface, world, [n, 3]. [scene units]
        normal: Unit normals there, on the eye's side, [n, 3].
        exit: Where the path leaves a body again; with one interface between the two ends the same as `point`, [n, 3].
        exit_normal: Unit normals there, on the point's side, [n, 3].
        virtual: Where the eye sees the points: on its own ray at the path's geometric length, [n, 3]. [scene units]
        length: Optical length, with the index before the surface as 1, [n]. [scene units]
        residual: The larger of |sin i - ior sin r| (as vectors) at the interfaces, [n].
        status: `Status`, uint8 [n].
    """

    point: Any
    normal: Any
    exit: Any
    exit_normal: Any
    virtual: Any
    length: Any
    residual: Any
    status: Any


def refract(surface, eye, points, ior: float, *, device=None, threads: int = 0) -> Refraction:
    """Where the eye sees each point through a surface.

    Args:
        surface: A `PlanarMirror` (water: one interface, from either side) or a `QuadricMirror` that is an ellipsoid: an eye
            and a point outside see each other through two interfaces, an eye outside and a point inside, or the other way
            round, through one.
        eye: World position [3], or several [m, 3]. [scene units]
        points: World positions [n, 3] (or one, [3]) of any library, see `solver.solve`. float32 in gives float32 out.
        ior: Index of refraction behind the surface (inside; on the side that the plane's normal turns away from), over that
            before it: 1.33 for water, below 1 for a bubble of air in it.
        device: Warp device for arrays of the host; None: Warp's current one.
        threads: CPU threads; 0: one per core.

    Returns:
        A `Refraction`. Of several paths (a lens can show a point more than once) the one of least optical length.
        UNREFLECTED: none was found, because both ends are on one side of the plane, nothing of the body's light goes there,
        or it is totally reflected inside. (Of what a ray reaches, 0 to 1 % is lost in glass and water, next to caustics; up to
        10 % in ellipsoids of index 2.4 and in bubbles, next to the limits of total reflection.) INSIDE: both are in the body.
        Nothing is ever NaN.

    Raises:
        ValueError: wrong shapes, an index that is no positive number, more than 2^31 - 1 pairs, a quadric that is no
            ellipsoid or refracts on its inside.
        TypeError: a surface of another type, or points that are no numbers.
    """
    index = float(ior)
    if not (np.isfinite(index) and index > 0.0):
        raise ValueError(f"refract ior: got {ior!r}, expected a positive number (water 1.33, glass 1.5)")
    if isinstance(surface, QuadricMirror):
        kind = surface.canonical.kind
        if kind != QuadricKind.ELLIPSOID or surface.reverse:
            shape = kind.name.lower().replace("_", " ")
            raise ValueError(
                f"refract surface: got an {surface.side} {shape}, expected a sphere or ellipsoid seen from outside"
            )
    elif not isinstance(surface, PlanarMirror):
        raise TypeError(f"refract surface: got {type(surface).__name__}, expected PlanarMirror or QuadricMirror")
    given = points_to_device(points, "refract points", device)
    eyes = host_vectors(eye, "refract eye")
    several = eyes.ndim == 2
    eyes = eyes.reshape(-1, 3)
    count = len(eyes) * len(given.array)
    if count > MAX_PAIRS:
        raise ValueError(
            f"refract: {len(eyes)} eyes x {len(given.array)} points exceed {MAX_PAIRS} pairs; split the points"
        )
    place, vector = given.array.device, given.array.dtype
    scalar = wp.float64 if vector is wp.vec3d else wp.float32
    vectors = [wp.zeros(count, dtype=vector, device=place) for _ in range(5)]
    numbers = [wp.zeros(count, dtype=scalar, device=place) for _ in range(2)]
    outputs = [*vectors, *numbers, wp.zeros(count, dtype=wp.uint8, device=place)]
    inputs = [wp.array(eyes, dtype=wp.vec3d, device=place), given.array, wp.float64(index)]
    if isinstance(surface, PlanarMirror):
        half_width, half_height = surface.extent or (0.0, 0.0)
        inputs += [wp.vec3d(x) for x in (surface.point, surface.normal, surface.width_axis, surface.height_axis)]
        inputs += [wp.float64(half_width), wp.float64(half_height)]
        launch(refract_plane_kernel, count, [*inputs, *outputs], place, threads)
    else:
        launch(refract_body_kernel, count, [*inputs, quadric_view(surface), *outputs], place, threads, split_min=64)
    shape = (len(eyes), *given.shape) if several else given.shape
    return Refraction(*(given.give_back(array, shape) for array in outputs))
