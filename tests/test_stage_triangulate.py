"""Triangulation of faces: areas and orientation against the shoelace formula."""

import numpy as np
import pytest

from warp_reflect.stage.triangulate import triangulate


def areas(outline, triangles):
    a, b, c = (outline[triangles[:, k]] for k in range(3))
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


def shoelace(outline):
    x, y = outline.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


def star(count, seed):
    rng = np.random.default_rng(seed)
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    radius = rng.uniform(0.2, 1.0, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def keyhole():
    """A square with a square hole, joined by a bridge whose two sides coincide."""
    outer = [(0, 0), (4, 0), (4, 4), (0, 4)]
    inner = [(1, 1), (1, 3), (3, 3), (3, 1)]
    return np.array([*outer, outer[0], *inner, inner[0]], float)


def lift(outline, seed=0):
    """Put a plane outline into space in a random orientation."""
    rng = np.random.default_rng(seed)
    frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    frame *= np.sign(np.linalg.det(frame))
    return outline @ frame[:2] + rng.normal(size=3), frame


@pytest.mark.parametrize(
    "outline",
    [
        np.array([(0, 0), (2, 0), (2, 2), (0, 2)], float),
        np.array([(0, 0), (2, 0), (0.5, 0.5), (0, 2)], float),
        np.array([(0.5, 0.5), (0, 2), (0, 0), (2, 0)], float),
        np.array([(0, 0), (1, 0), (2, 0), (2, 2), (1, 2), (0, 2)], float),
        np.array([(0, 0), (6, 0), (6, 5), (5, 5), (5, 1), (1, 1), (1, 5), (0, 5)], float),
        keyhole(),
        star(7, 1),
        star(50, 2),
        star(2000, 3),
    ],
    ids=[
        "square",
        "arrow",
        "arrow_from_notch",
        "straight_corners",
        "u",
        "keyhole",
        "star7",
        "star50",
        "star2000",
    ],
)
def test_triangles_tile_the_face(outline):
    points, frame = lift(outline)
    corners, face, crossing = triangulate(np.array([len(outline)]), np.arange(len(outline)), points)
    assert len(corners) == len(outline) - 2
    assert not len(crossing) and not face.any()
    signed = areas(points @ frame[:2].T, corners)
    # A tiling: nothing is turned over, and the areas sum to the outline's.
    assert signed.min() > -1e-12
    assert abs(signed.sum() - shoelace(outline)) < 1e-12 * len(outline)


def test_quad_keeps_the_first_diagonal_where_it_can():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.3), (0, 1, 0)], float)
    corners, _, _ = triangulate(np.array([4]), np.arange(4), points)
    assert corners.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_mixed_faces_stay_in_face_order():
    points, _ = lift(np.concatenate([star(9, 4), star(4, 5), star(3, 6)]))
    counts = np.array([3, 9, 4, 3])
    indices = np.concatenate([[13, 14, 15], np.arange(9), np.arange(9, 13), [13, 15, 14]])
    corners, face, _ = triangulate(counts, indices, points)
    assert face.tolist() == [0] + [1] * 7 + [2] * 2 + [3]
    starts = np.cumsum(counts) - counts
    assert (corners >= starts[face][:, None]).all() and (corners < (starts + counts)[face][:, None]).all()


def test_crossing_face_is_told_and_still_cut():
    bow_tie = np.array([(0, 0), (2, 0), (0, 1), (2, 1), (1, 3)], float)
    points, _ = lift(bow_tie)
    corners, _, crossing = triangulate(np.array([5]), np.arange(5), points)
    assert len(corners) == 3 and crossing.tolist() == [0]


def test_many_corners_are_quick():
    angle = np.linspace(0.0, 2.0 * np.pi, 60_000, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    corners, _, crossing = triangulate(np.array([len(circle)]), np.arange(len(circle)), lift(circle)[0])
    assert len(corners) == len(circle) - 2 and not len(crossing)
