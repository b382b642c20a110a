"""Derivatives of the bare solver's answers with respect to eye, points and mirror.

At a reflection point R of the surface q(x) = x~^T Q x~ = 0 the half vector is along the normal: o + v = l n with
n = (Q R~)_xyz. With Po = (I - o o^T)/|O-R|, Pv likewise, A the upper left of Q and T a tangent basis, the implicit
function theorem gives, for changes dO, dV, dQ,

    dR = dN + T H^-1 T^T (Po dO + Pv dV - (Po + Pv + l A) dN - l (dQ R~)_xyz),   H = T^T (Po + Pv + l A) T,
    dN = -n (R~^T dQ R~) / (2 n.n),

and for the virtual point V' = R + |V-R| u, u = (R-O)/|R-O|,

    dV' = dR + |V-R|/|R-O| (I - u u^T)(dR - dO) + u (v . (dV - dR)).

A plane is the quadric with A = 0 and n its normal. Everything is float64, whatever the points are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_reflect.launch import launch
from warp_reflect.optics import tangent_basis
from warp_reflect.solver import Request, Solution, solve_on_device

wp.set_module_options({"enable_backward": False})

CAUSTIC_CLAMP = wp.float64(1.0e-3)  # of cos^2 / |V-R|: smaller curvatures of the path would give endless motion
HAS_POINT = (1, 5, 6, 8, 9)  # Status CONVERGED, GRAZING, MAX_ITERATIONS, AMBIGUOUS, NEAR_CAUSTIC


@dataclass(frozen=True)
class Gradients:
    """Jacobians, float64; first the axes of the solution, then the changed quantity, then the changing one.

    0 where there is no reflection point, and where a point lies on the mirror (there R = V has only one-sided
    derivatives). Near a caustic, where the exact values have no bound, the Hessian's eigenvalues are kept at
    1e-3 cos^2 / |V-R| or more.

    Attributes:
        point_eye, point_target: dR/dO and dR/dV, [..., n, 3, 3].
        virtual_eye, virtual_target: dV'/dO and dV'/dV, [..., n, 3, 3].
        point_matrix, virtual_matrix: dR/dQ and dV'/dQ, Q = `mirror.matrix` with its 16 entries taken as independent
            (a symmetric dQ gives the directional derivative as the sum of the products), [..., n, 3, 4, 4].
    """

    point_eye: np.ndarray
    point_target: np.ndarray
    virtual_eye: np.ndarray
    virtual_target: np.ndarray
    point_matrix: np.ndarray
    virtual_matrix: np.ndarray


def solve_gradients(mirror, eye, points, solution: Solution) -> Gradients:
    """Jacobians of a solution's `point` and `virtual`, on the host.

    Args:
        mirror: The `PlanarMirror` or `QuadricMirror` that was solved.
        eye: As given to `solve`.
        points: As given to `solve`.
        solution: What `solve` returned for them.

    Returns:
        `Gradients`.

    Raises:
        TypeError: the mirror has no matrix (a reflector map).
        ValueError: the shapes do not belong together.
    """
    matrix = getattr(mirror, "matrix", None)
    if matrix is None:
        raise TypeError(f"solve_gradients mirror: got {type(mirror).__name__}, expected PlanarMirror or QuadricMirror")
    eye, points, r = _to_numpy(eye), _to_numpy(points), _to_numpy(solution.point)
    if eye.ndim == 2:
        eye = eye.reshape(len(eye), *([1] * (points.ndim - 1)), 3)
    if np.broadcast_shapes(eye.shape, points.shape) != r.shape:
        raise ValueError(
            f"solve_gradients: eye {eye.shape} and points {points.shape} do not give the solution's {r.shape}"
        )
    shape = r.shape[:-1]
    eye = np.broadcast_to(eye, r.shape).reshape(-1, 3)
    points = np.broadcast_to(points, r.shape).reshape(-1, 3)
    r = r.reshape(-1, 3)
    good = np.isin(_to_numpy(solution.status).reshape(-1), HAS_POINT)
    good &= np.linalg.norm(points - r, axis=1) > 0.0
    jacobians = [np.zeros((len(r), *tail)) for tail in ((3, 3),) * 4 + ((3, 4, 4),) * 2]
    for whole, part in zip(jacobians, _jacobians(matrix, eye[good], points[good], r[good]), strict=True):
        whole[good] = part
    return Gradients(*(j.reshape(*shape, *j.shape[1:]) for j in jacobians))


def _jacobians(q: np.ndarray, eye: np.ndarray, target: np.ndarray, r: np.ndarray) -> list[np.ndarray]:
    identity = np.eye(3)
    a = q[:3, :3]
    n = r @ a + q[:3, 3]
    nn = (n * n).sum(1)
    to_o, to_v = eye - r, target - r
    d_o, d_v = np.linalg.norm(to_o, axis=1), np.linalg.norm(to_v, axis=1)
    o, v = to_o / d_o[:, None], to_v / d_v[:, None]
    outer = lambda x, y: x[:, :, None] * y[:, None, :]  # noqa: E731
    p_o = (identity - outer(o, o)) / d_o[:, None, None]
    p_v = (identity - outer(v, v)) / d_v[:, None, None]
    bend = ((o + v) * n).sum(1) / nn
    total = p_o + p_v + bend[:, None, None] * a
    unit = n / np.sqrt(nn)[:, None]
    cosine = (o * unit).sum(1)
    # Tangent basis from the complement of the normal.
    t = np.linalg.svd(unit[:, None, :])[2][:, 1:].transpose(0, 2, 1)
    h = t.transpose(0, 2, 1) @ total @ t
    value, vector = np.linalg.eigh(h)
    floor = float(CAUSTIC_CLAMP) * (cosine**2 / d_v)[:, None]
    value = np.where(np.abs(value) < floor, np.where(value < 0.0, -floor, floor), value)
    turn = t @ vector
    inverse = turn / value[:, None, :] @ turn.transpose(0, 2, 1)
    point_eye, point_target = inverse @ p_o, inverse @ p_v
    r1 = np.concatenate([r, np.ones((len(r), 1))], axis=1)
    product = outer(r1, r1)
    # dN for a unit change of Q_ij is -n R_i R_j / (2 n.n); dQ R~ has the component R_j along i.
    normal = -n[:, :, None, None] * product[:, None] / (2.0 * nn)[:, None, None, None]
    along = np.zeros_like(normal)
    for i in range(3):
        along[:, i, i, :] += 0.5 * r1
        along[:, i, :, i] += 0.5 * r1
    pull = np.einsum("nij,njkl->nikl", total, normal) + bend[:, None, None, None] * along
    point_matrix = normal - np.einsum("nij,njkl->nikl", inverse, pull)
    u = -o
    lever = (d_v / d_o)[:, None, None] * (identity - outer(u, u))
    move = identity + lever - outer(u, v)
    return [
        point_eye,
        point_target,
        move @ point_eye - lever,
        move @ point_target + outer(u, v),
        point_matrix,
        np.einsum("nij,njkl->nikl", move, point_matrix),
    ]


def _to_numpy(values: Any) -> np.ndarray:
    if isinstance(values, wp.array):
        return values.numpy().astype(np.float64)
    if hasattr(values, "__dlpack__") and not isinstance(values, np.ndarray):
        detached = values.detach() if getattr(values, "requires_grad", False) else values
        return wp.from_dlpack(detached).numpy().astype(np.float64)
    return np.asarray(values, np.float64)


def solve_on_tape(mirror, eye: wp.array, points: wp.array, tape: wp.Tape, matrix: wp.array | None = None):
    """`solve` for a `wp.Tape`: the backward pass adds to the gradients of eye, points and mirror.

    Args:
        mirror: A `PlanarMirror` or `QuadricMirror`.
        eye: vec3d [m] on the points' device.
        points: vec3 or vec3d [n].
        tape: The tape to record on; call within its `with` block or not.
        matrix: mat44d [1], the mirror's Q (any common factor), where its gradient is wanted; None: not.

    Returns:
        (point, virtual, status): vec3 or vec3d [m * n], eye by eye, with gradients; uint8 [m * n].

    Raises:
        TypeError: the mirror has no matrix, or eye is not an array of vec3d.
    """
    if getattr(mirror, "matrix", None) is None:
        raise TypeError(f"solve_on_tape mirror: got {type(mirror).__name__}, expected PlanarMirror or QuadricMirror")
    if eye.dtype is not wp.vec3d or points.dtype not in (wp.vec3, wp.vec3d):
        raise TypeError(
            f"solve_on_tape: got eye {eye.dtype.__name__} and points {points.dtype.__name__}, "
            "expected vec3d and vec3 or vec3d"
        )
    answer = solve_on_device(mirror, Request(eye, points, None, False, "newton", 0))
    answer.point.requires_grad = True
    answer.virtual.requires_grad = True
    q = matrix if matrix is not None else wp.array([mirror.matrix], dtype=wp.mat44d, device=points.device)

    def backward() -> None:
        empty = wp.zeros(0, dtype=wp.vec3d, device=points.device)
        no_points = wp.zeros(0, dtype=points.dtype, device=points.device)
        no_matrix = wp.zeros(0, dtype=wp.mat44d, device=points.device)
        inputs = [
            eye,
            points,
            q,
            answer.point,
            answer.status,
            answer.point.grad,
            answer.virtual.grad,
            eye.grad if eye.requires_grad else empty,
            points.grad if points.requires_grad else no_points,
            matrix.grad if matrix is not None and matrix.requires_grad else no_matrix,
        ]
        # One slice: several rows add to the gradient of one eye, and a CPU launch has no atomics.
        launch(solve_adjoint_kernel, len(answer.point), inputs, points.device, threads=1)

    arrays = [eye, points, answer.point, answer.virtual] + ([] if matrix is None else [matrix])
    tape.record_func(backward, arrays)
    return answer.point, answer.virtual, answer.status


@wp.func
def project(x: wp.vec3d, axis: wp.vec3d):
    """Part of x perpendicular to the unit vector `axis`."""
    return x - wp.dot(x, axis) * axis


@wp.kernel
def solve_adjoint_kernel(
    first: int,
    eyes: wp.array(dtype=wp.vec3d),
    points: wp.array(dtype=Any),
    matrix: wp.array(dtype=wp.mat44d),
    point: wp.array(dtype=Any),
    status: wp.array(dtype=wp.uint8),
    point_grad: wp.array(dtype=Any),
    virtual_grad: wp.array(dtype=Any),
    # Outputs:
    out_eye_grad: wp.array(dtype=wp.vec3d),
    out_points_grad: wp.array(dtype=Any),
    out_matrix_grad: wp.array(dtype=wp.mat44d),
):
    """One thread per pair of eye and point, transposing the equations at the head of this file."""
    row = first + wp.tid()
    count = points.shape[0]
    s = int(status[row])
    if s != 1 and s != 5 and s != 6 and s != 8 and s != 9:
        return
    one = wp.float64(1.0)
    half = wp.float64(0.5)
    x = point[row]
    g = point_grad[row]
    k = virtual_grad[row]
    y = points[row % count]
    r = wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2]))
    adj_r = wp.vec3d(wp.float64(g[0]), wp.float64(g[1]), wp.float64(g[2]))
    adj_v = wp.vec3d(wp.float64(k[0]), wp.float64(k[1]), wp.float64(k[2]))
    target = wp.vec3d(wp.float64(y[0]), wp.float64(y[1]), wp.float64(y[2]))
    q = matrix[0]
    a = wp.mat33d(q[0, 0], q[0, 1], q[0, 2], q[1, 0], q[1, 1], q[1, 2], q[2, 0], q[2, 1], q[2, 2])
    n = a * r + wp.vec3d(q[0, 3], q[1, 3], q[2, 3])
    nn = wp.dot(n, n)
    to_o = eyes[row / count] - r
    to_v = target - r
    d_o = wp.length(to_o)
    d_v = wp.length(to_v)
    if not (d_v > wp.float64(0.0)) or not (d_o > wp.float64(0.0)):
        return
    o = to_o / d_o
    v = to_v / d_v
    bend = wp.dot(o + v, n) / nn
    unit = n / wp.sqrt(nn)
    cosine = wp.dot(o, unit)
    # The virtual point: adjoint of R, and what goes to eye and target directly.
    lever = project(adj_v, o) * (d_v / d_o)
    pull = -wp.dot(adj_v, o)
    adj_r = adj_r + adj_v + lever - pull * v
    adj_eye = -lever
    adj_target = pull * v
    # The tangential solve, symmetric: once for all right-hand sides.
    t1, t2 = tangent_basis(unit)
    s1 = (t1 - wp.dot(t1, o) * o) / d_o + (t1 - wp.dot(t1, v) * v) / d_v + bend * (a * t1)
    s2 = (t2 - wp.dot(t2, o) * o) / d_o + (t2 - wp.dot(t2, v) * v) / d_v + bend * (a * t2)
    h11 = wp.dot(t1, s1)
    h12 = wp.dot(t1, s2)
    h22 = wp.dot(t2, s2)
    mean = half * (h11 + h22)
    diff = half * (h11 - h22)
    spread = wp.sqrt(diff * diff + h12 * h12)
    c1 = one
    c2 = wp.float64(0.0)
    if spread > wp.float64(0.0):
        if diff > wp.float64(0.0):
            c1 = diff + spread
            c2 = h12
        else:
            c1 = h12
            c2 = spread - diff
        size = wp.sqrt(c1 * c1 + c2 * c2)
        c1 = c1 / size
        c2 = c2 / size
    least = CAUSTIC_CLAMP * cosine * cosine / d_v
    high = mean + spread
    low = mean - spread
    if wp.abs(high) < least:
        high = wp.where(high < wp.float64(0.0), -least, least)
    if wp.abs(low) < least:
        low = wp.where(low < wp.float64(0.0), -least, least)
    e1 = c1 * t1 + c2 * t2
    e2 = c1 * t2 - c2 * t1
    z = (wp.dot(adj_r, e1) / high) * e1 + (wp.dot(adj_r, e2) / low) * e2
    adj_eye = adj_eye + project(z, o) / d_o
    adj_target = adj_target + project(z, v) / d_v
    if out_eye_grad.shape[0] > 0:
        wp.atomic_add(out_eye_grad, row / count, adj_eye)
    if out_points_grad.shape[0] > 0:
        wp.atomic_add(
            out_points_grad,
            row % count,
            type(y)(y.dtype(adj_target[0]), y.dtype(adj_target[1]), y.dtype(adj_target[2])),
        )
    if out_matrix_grad.shape[0] > 0:
        # dN takes the rest of the adjoint; a unit change of Q_ij moves R by -n R_i R_j / (2 n.n) along n.
        stiff = project(z, o) / d_o + project(z, v) / d_v + bend * (a * z)
        depth = -half * wp.dot(n, adj_r - stiff) / nn
        r1 = wp.vec4d(r[0], r[1], r[2], one)
        z1 = wp.vec4d(z[0], z[1], z[2], wp.float64(0.0))
        change = depth * wp.outer(r1, r1) - (half * bend) * (wp.outer(z1, r1) + wp.outer(r1, z1))
        wp.atomic_add(out_matrix_grad, 0, change)


for _vector in (wp.vec3, wp.vec3d):
    _array = wp.array(dtype=_vector)
    wp.overload(
        solve_adjoint_kernel,
        {
            "points": _array,
            "point": _array,
            "point_grad": _array,
            "virtual_grad": _array,
            "out_points_grad": _array,
        },
    )
