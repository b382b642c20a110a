"""Direction <-> cube face: of node-centred reflector maps, and of texel-centred radiance maps (at the end).

Of reflector maps: a direction x with max |x_i| = 1 lies on face 2 k + (x_k < 0) of the major axis k, at u = x[k+1] / |x_k|,
v = x[k+2] / |x_k| (indices modulo 3). Nodes lie at u_i = -1 + 2 i / (n - 1): nodes on an edge of the cube belong to
both faces, so bilinear interpolation is continuous across faces without gutters. Texel (face, j, i) of a map of n
nodes is element (face n + j) n + i.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_reflect.shapes import max_abs

wp.set_module_options({"enable_backward": False})

FACE_COUNT = 6
SHORTEST = wp.constant(1.2e-38)  # of directions: what is shorter has no inverse in float32


@wp.struct
class CubePoint:
    """A point on the cube: face 0-5, position in [-1, 1]^2."""

    face: int
    u: float
    v: float


@wp.func
def project_to_cube(x: wp.vec3) -> wp.vec3:
    """The point of the cube surface in direction x; +x for a vector shorter than `SHORTEST`."""
    m = max_abs(x)
    if m < SHORTEST:
        return wp.vec3(1.0, 0.0, 0.0)
    return x * (1.0 / m)


@wp.func
def cube_point(x: wp.vec3) -> CubePoint:
    """Face and position of a point of the cube, whose largest component is 1."""
    point = CubePoint()
    ax = wp.abs(x[0])
    ay = wp.abs(x[1])
    az = wp.abs(x[2])
    if ax >= ay and ax >= az:
        point.face = wp.where(x[0] < 0.0, 1, 0)
        point.u = x[1]
        point.v = x[2]
    elif ay >= az:
        point.face = wp.where(x[1] < 0.0, 3, 2)
        point.u = x[2]
        point.v = x[0]
    else:
        point.face = wp.where(x[2] < 0.0, 5, 4)
        point.u = x[0]
        point.v = x[1]
    return point


def face_axes(face: int) -> tuple[int, int, int, float]:
    """(k, axis of u, axis of v, sign of x_k) of a face."""
    k = face // 2
    return k, (k + 1) % 3, (k + 2) % 3, -1.0 if face % 2 else 1.0


def node_directions(resolution: int) -> np.ndarray:
    """The cube point of every node, float64 [6, n, n, 3] (face, row v, column u)."""
    line = np.linspace(-1.0, 1.0, resolution)
    result = np.empty((FACE_COUNT, resolution, resolution, 3))
    for face in range(FACE_COUNT):
        k, ku, kv, sign = face_axes(face)
        result[face, :, :, k] = sign
        result[face, :, :, ku] = line[None, :]
        result[face, :, :, kv] = line[:, None]
    return result


# Radiance cube maps: OpenEXR's orientation (ImfEnvmap.h), texel-centred. Face order +X -X +Y -Y +Z -Z; each face is the
# picture of a camera at the centre. Rows: right, up, forward.
RADIANCE_AXES = np.array(
    [
        [[0, 0, 1], [0, 1, 0], [1, 0, 0]],
        [[0, 0, -1], [0, 1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[-1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 0, 0], [0, 1, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)


@wp.func
def radiance_point(x: wp.vec3) -> CubePoint:
    """Face of a radiance map and position on it, u to the right and v downwards, of a direction (any length but zero)."""
    point = CubePoint()
    ax = wp.abs(x[0])
    ay = wp.abs(x[1])
    az = wp.abs(x[2])
    if ax >= ay and ax >= az:
        point.face = wp.where(x[0] < 0.0, 1, 0)
        point.u = wp.where(x[0] < 0.0, -x[2], x[2]) / ax
        point.v = -x[1] / ax
    elif ay >= az:
        point.face = wp.where(x[1] < 0.0, 3, 2)
        point.u = x[0] / ay
        point.v = wp.where(x[1] < 0.0, x[2], -x[2]) / ay
    else:
        point.face = wp.where(x[2] < 0.0, 5, 4)
        point.u = wp.where(x[2] < 0.0, x[0], -x[0]) / az
        point.v = -x[1] / az
    return point


# `radiance_direction` for vectors of texels of one face, after `vector.snippet`'s head.
RADIANCE_DIRECTION = r"""
    auto radiance_direction = [&](int face, F u, F v) -> V {
        const F one = F(1.0f);
        switch (face) {
            case 0: return V{one, -v, u};
            case 1: return V{-one, -v, -u};
            case 2: return V{u, one, -v};
            case 3: return V{u, -one, v};
            case 4: return V{-u, -v, one};
            default: return V{u, -v, -one};
        }
    };
"""


@wp.func
def radiance_direction(face: int, u: float, v: float) -> wp.vec3:
    """The direction of a position on a face of a radiance map, at length 1 along the face's axis."""
    if face == 0:
        return wp.vec3(1.0, -v, u)
    if face == 1:
        return wp.vec3(-1.0, -v, -u)
    if face == 2:
        return wp.vec3(u, 1.0, -v)
    if face == 3:
        return wp.vec3(u, -1.0, v)
    if face == 4:
        return wp.vec3(-u, -v, 1.0)
    return wp.vec3(u, -v, -1.0)


def texel_directions(resolution: int) -> np.ndarray:
    """Directions of the texels' centres of a radiance map, at length 1 along their face's axis, float64 [6, n, n, 3]."""
    line = (np.arange(resolution) + 0.5) * 2.0 / resolution - 1.0
    right, up, forward = (RADIANCE_AXES[:, None, None, k] for k in range(3))
    return forward + line[None, None, :, None] * right - line[None, :, None, None] * up
