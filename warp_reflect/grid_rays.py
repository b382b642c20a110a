"""Rays on a regular grid: what the walks of `heightfield.py` and `occupancy.py` share.

The *grid frame* has its origin at the grid's lowest corner, its third axis up, and the cell's edge as its unit; a cell is
named by integers and borders lie at integers. Every time at which a ray meets a border is computed anew from that integer
(Amanatides and Woo 1987 add up increments instead, which is off by a whole cell after some thousands of steps). So two walks
that take different strides still see the same times, and where they meet a cell they enter it at the same time.

Which border comes first is decided by comparing those times; where two are equal the ray crosses the lower axis first.
Compiled finite-only (see `launch.FINITE_FLAGS`): `to_grid` looks at the bits of a ray's numbers, which no floating-point flag
touches, before any arithmetic.

Source: Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_reflect.launch import FINITE_FLAGS
from warp_reflect.settings import Status
from warp_reflect.shapes import max_abs, unit

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": FINITE_FLAGS})

# Kinds of hit.
NONE = wp.constant(0)
WALL = wp.constant(1)  # the side of a cell
ROOF = wp.constant(2)  # from above
CEILING = wp.constant(3)  # from below; occupancy only

# Which border a ray came through into a cell, beside the axes 0, 1, 2.
START = wp.constant(-1)

FAR = wp.constant(1.0e30)  # a border that is never met; far below the overflow of its products
# Share of the direction below which a component is none: over the widest grid (16,384 cells) it moves the ray by 1e-8 cells.
FLUSH = wp.constant(1.0e-12)
# Cells from the grid's corner; a ray that starts farther away knows no cell, and its products would come near FAR.
REACH = wp.constant(1.0e15)
EXPONENT = wp.constant(wp.uint32(0x7F800000))  # all ones: infinite or not a number
CELLS_MAX = 16384  # along an axis; a float32 position then still resolves a thousandth of a cell
UP_AXES = {"Y": 1, "Z": 2}

OK = wp.constant(int(Status.CONVERGED))
SKY = wp.constant(int(Status.SKY))
DEGENERATE = wp.constant(int(Status.DEGENERATE))
INSIDE = wp.constant(int(Status.INSIDE))
BAD_INPUT = wp.constant(int(Status.BAD_INPUT))
STEP_LIMIT = wp.constant(int(Status.STEP_LIMIT))


@wp.struct
class GridPlace:
    """Where a grid lies in the frame that rays are given in."""

    corner: wp.vec3  # the lowest corner
    cell: float  # edge of a cell
    inverse: float  # 1 / cell
    up: int  # axis that points up: 1 or 2


@wp.struct
class GridRay:
    """A ray in the grid frame."""

    origin: wp.vec3
    direction: wp.vec3  # unit; negligible components are 0
    inverse: wp.vec3  # 1 / direction, 0 where that is 0
    never: wp.vec3  # added to the times of borders: FAR where the direction is 0, else 0
    ahead: wp.vec3i  # 1 where the next border is the cell's upper one
    step: wp.vec3i  # -1, 0 or 1
    status: int  # CONVERGED: may be traced; BAD_INPUT, DEGENERATE


@wp.struct
class Entry:
    """Where a ray comes into the box of a grid."""

    t: float
    end: float  # when it leaves the box again
    axis: int  # START: the origin lies within
    inside: int  # 0: the ray misses the box


@wp.struct
class GridHit:
    """The first thing a ray meets in a grid; grid frame."""

    kind: int  # NONE, WALL, ROOF or CEILING
    status: int  # CONVERGED, SKY, INSIDE, BAD_INPUT, DEGENERATE or STEP_LIMIT
    t: float  # along the unit direction [cells]
    cell: wp.vec3i  # (x, y, z), z 0 in a heightfield; -1 without a hit
    normal: wp.vec3  # unit, towards the ray's origin
    steps: int  # cells and nodes looked at


@wp.func
def is_finite(x: float) -> bool:
    """Whether a number is finite, told by its bits."""
    return (wp.cast(x, wp.uint32) & EXPONENT) != EXPONENT


@wp.func
def is_finite_vector(v: wp.vec3) -> bool:
    return is_finite(v[0]) and is_finite(v[1]) and is_finite(v[2])


@wp.func
def swap_up(place: GridPlace, v: wp.vec3) -> wp.vec3:
    """A vector with the up axis third; its own inverse."""
    if place.up == 1:
        return wp.vec3(v[0], v[2], v[1])
    return v


@wp.func
def to_grid(place: GridPlace, origin: wp.vec3, direction: wp.vec3) -> GridRay:
    """A ray in the grid frame, with what its walk needs; the direction may have any length but zero."""
    ray = GridRay()
    if not (is_finite_vector(origin) and is_finite_vector(direction)):
        ray.status = BAD_INPUT
        return ray
    if max_abs(direction) == 0.0:
        ray.status = DEGENERATE
        return ray
    ray.origin = swap_up(place, origin - place.corner) * place.inverse
    if not (max_abs(ray.origin) <= REACH):
        ray.status = BAD_INPUT
        return ray
    d = swap_up(place, unit(direction))
    for k in range(3):
        c = d[k]
        if wp.abs(c) < FLUSH:
            ray.direction[k] = 0.0
            ray.inverse[k] = 0.0
            ray.never[k] = FAR
            ray.ahead[k] = 1
            ray.step[k] = 0
        else:
            ray.direction[k] = c
            ray.inverse[k] = 1.0 / c
            ray.never[k] = 0.0
            ray.ahead[k] = wp.where(c > 0.0, 1, 0)
            ray.step[k] = wp.where(c > 0.0, 1, -1)
    ray.status = OK
    return ray


@wp.func
def border_time(border: int, origin: float, inverse: float, never: float) -> float:
    """When a ray meets a border."""
    return (float(border) - origin) * inverse + never


@wp.func
def clip_axis(entry: Entry, axis: int, low: int, high: int, ray: GridRay) -> Entry:
    """The entry after the slab low..high of an axis."""
    clipped = Entry()
    clipped.t = entry.t
    clipped.end = entry.end
    clipped.axis = entry.axis
    clipped.inside = entry.inside
    o = ray.origin[axis]
    if ray.step[axis] == 0:
        if o < float(low) or o > float(high):
            clipped.inside = 0
        return clipped
    t_low = border_time(low, o, ray.inverse[axis], 0.0)
    t_high = border_time(high, o, ray.inverse[axis], 0.0)
    t_in = wp.min(t_low, t_high)
    clipped.end = wp.min(entry.end, wp.max(t_low, t_high))
    if t_in > entry.t:
        clipped.t = t_in
        clipped.axis = axis
    if clipped.t > clipped.end:
        clipped.inside = 0
    return clipped


@wp.func
def cell_at(
    t: float,
    inclusive: bool,
    low: int,
    high: int,
    origin: float,
    direction: float,
    inverse: float,
    step: int,
    ahead: int,
    at: int,
) -> int:
    """The cell of an axis in which a ray is at a time: every border met before it is behind (met at it too, if inclusive).

    A position rounded to a cell may be off by one; the times of the borders, which every walk compares, put it right.

    Args:
        t: The time.
        inclusive: Whether a border met at exactly that time is behind.
        low, high: The first and the last cell that can be.
        origin, direction, inverse, step, ahead: The ray's numbers of this axis.
        at: The cell it stays in where it does not move along the axis; -1: by its origin.
    """
    if step == 0 and at >= 0:
        return at
    cell = wp.clamp(int(wp.floor(wp.clamp(origin + t * direction, float(low), float(high)))), low, high)
    if step == 0:
        return cell
    # Forwards while the next border is behind.
    t_next = (float(cell + ahead) - origin) * inverse
    while cell != wp.where(step > 0, high, low) and (t_next < t or (inclusive and t_next == t)):
        cell += step
        t_next = (float(cell + ahead) - origin) * inverse
    # Back while the last border is still ahead.
    t_last = (float(cell + ahead - step) - origin) * inverse
    while cell != wp.where(step > 0, low, high) and (t_last > t or (not inclusive and t_last == t)):
        cell -= step
        t_last = (float(cell + ahead - step) - origin) * inverse
    return cell


@wp.func
def miss(status: int, steps: int) -> GridHit:
    """No hit, and why."""
    hit = GridHit()
    hit.status = status
    hit.cell = wp.vec3i(-1, -1, -1)
    hit.steps = steps
    return hit


@wp.func
def side_normal(axis: int, ray: GridRay) -> wp.vec3:
    """Unit normal of a border that a ray crosses, towards where it comes from."""
    normal = wp.vec3(0.0, 0.0, 0.0)
    normal[axis] = wp.where(ray.direction[axis] > 0.0, -1.0, 1.0)
    return normal


@dataclass
class GridTrace:
    """What an array of rays meets; device arrays, one element per ray.

    Attributes:
        kind: int32: NONE 0, WALL 1, ROOF 2, CEILING 3.
        t: float32, distance from the origin (whatever the direction's length); 0 without a hit.
        cell: vec3i, columns along the two level axes and the layer (0 in a heightfield); -1 without a hit.
        normal: vec3, unit, axes of the rays; zero without a hit.
        steps: int32, cells and nodes looked at.
        status: uint8, `Status`: CONVERGED, SKY, INSIDE (starts within something solid), BAD_INPUT (not finite),
            DEGENERATE (a direction of zero), STEP_LIMIT.
    """

    kind: wp.array
    t: wp.array
    cell: wp.array
    normal: wp.array
    steps: wp.array
    status: wp.array

    @classmethod
    def empty(cls, count: int, device) -> GridTrace:
        kinds = (int, float, wp.vec3i, wp.vec3, int, wp.uint8)
        return cls(*(wp.empty(count, dtype=kind, device=device) for kind in kinds))

    @property
    def arrays(self) -> list[wp.array]:
        """In the order of the kernels' outputs."""
        return [self.kind, self.t, self.cell, self.normal, self.steps, self.status]


def place_grid(corner, cell: float, up: str) -> GridPlace:
    """The device form of where a grid lies.

    Args:
        corner: Lowest corner in the frame of the rays, [3].
        cell: Edge of a cell, > 0.
        up: "Y" or "Z".

    Raises:
        ValueError: a corner or cell that cannot be.
    """
    corner = np.asarray(corner, np.float64)
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise ValueError(f"corner: got {corner!r}, expected three finite numbers")
    if not (np.isfinite(cell) and 1e-30 < cell < 1e30):
        raise ValueError(f"cell: got {cell!r}, expected a length above 0")
    if up not in UP_AXES:
        raise ValueError(f"up: got {up!r}, expected Y or Z")
    place = GridPlace()
    place.corner = wp.vec3(*corner)
    place.cell = float(cell)
    place.inverse = 1.0 / float(cell)
    place.up = UP_AXES[up]
    return place


def frame_origin(corner, place_corner) -> np.ndarray:
    """Where the frame of a grid's place has its origin in the frame of the host's rays, float64 [3].

    Args:
        corner: Lowest corner of the grid in the host's frame.
        place_corner: The same in the frame of the place; None: 0.

    Raises:
        ValueError: a corner that cannot be.
    """
    corner = np.asarray(corner, np.float64)
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise ValueError(f"corner: got {corner!r}, expected three finite numbers")
    return corner if place_corner is None else corner - np.asarray(place_corner, np.float64)


def rays_on_device(rays, name: str, origin: np.ndarray, device) -> wp.array:
    """Points or directions as a vec3 array: device arrays as they are, host arrays less `origin` in float64.

    Raises:
        ValueError: another shape than [n, 3].
    """
    if isinstance(rays, wp.array):
        return rays
    values = np.asarray(rays, np.float64)
    if values.ndim != 2 or values.shape[1] != 3:
        raise ValueError(f"{name}: got shape {values.shape}, expected [n, 3]")
    with np.errstate(over="ignore"):
        return wp.array((values - origin).astype(np.float32), dtype=wp.vec3, device=device)
