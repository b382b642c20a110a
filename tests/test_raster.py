"""The rasteriser against an exact-integer oracle, and watertightness."""

import numpy as np
import pytest
import warp as wp

from warp_reflect import launch, raster, raster_pieces

NEAR, FAR = 0.5, 1.0e4


def draw(corners, width, height, threads=1, box=None, mask=None, mask_value=0):
    """Draw float [n, 3, 4] (x, y, key, depth) triangles; returns (id, key) images."""
    corners = np.asarray(corners, np.float32)
    device = "cpu"
    box = box or (0, 0, width, height)
    target = raster.make_target(raster.Picture((width, height), NEAR, FAR), box, device, mask, mask_value)
    screen = wp.array(corners.reshape(-1, 4), dtype=wp.vec4, device=device)
    index = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    raster.rasterise(target, screen, wp.array(index, dtype=wp.vec3i, device=device), threads=threads)
    keys = target.key.numpy().reshape(box[3] - box[1], box[2] - box[0])
    ids = np.where(keys == 0, -1, (~keys.astype(np.uint32)).astype(np.int64))
    return ids, (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)


def flat(xy, key=0.1):
    """[n, 3, 2] pixel positions at one depth key."""
    xy = np.asarray(xy, np.float64)
    return np.concatenate([xy, np.full((*xy.shape[:-1], 1), key), np.full((*xy.shape[:-1], 1), 1 / key)], axis=-1)


def covered(triangle, width, height):
    """Pixels a triangle owns by the top-left rule, in Python integers at 1/256 pixel."""
    points = [(int(np.floor(np.float32(x) * 256 + 0.5)), int(np.floor(np.float32(y) * 256 + 0.5))) for x, y in triangle]
    (ax, ay), (bx, by), (cx, cy) = points
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if area < 0:
        points = [points[0], points[2], points[1]]
    result = set()
    if area == 0:
        return result
    for y in range(height):
        for x in range(width):
            px, py = x * 256 + 128, y * 256 + 128
            inside = True
            for k in range(3):
                (x0, y0), (x1, y1) = points[k], points[(k + 1) % 3]
                edge = (x1 - x0) * (py - y0) - (y1 - y0) * (px - x0)
                top_left = y1 < y0 or (y1 == y0 and x1 > x0)
                inside &= edge > 0 or (edge == 0 and top_left)
            if inside:
                result.add((x, y))
    return result


@pytest.mark.parametrize("takers", [1, 7, raster_pieces.TAKERS])
@pytest.mark.parametrize("box", [None, (13, 5, 190, 101)])
def test_pieces_of_triangles_are_the_triangles(takers, box, monkeypatch):
    """A device's way: from one pixel to all of them, cut by the eye's plane, and out of sight; pixel for pixel the same."""
    rng = np.random.default_rng(5)
    size = 2.0 ** rng.uniform(0, 11, (300, 1, 1))
    corners = flat(rng.uniform(0, 200, (300, 1, 2)) * (1.0, 0.55) + size * rng.uniform(-1, 1, (300, 3, 2)))
    corners[..., 3] = size[..., 0] * rng.uniform(0.6, 2.0, corners.shape[:2])  # small ones in front of large ones
    corners[::100, 0, 3] = 0.3
    corners[..., 2] = 1.0 / corners[..., 3]
    behind = corners[..., 3] < NEAR
    corners[behind, 2] = 0.0  # as `layers.project` gives what lies in front of the near plane
    cut = behind.any(axis=1) & ~behind.all(axis=1)
    assert cut.sum() == 3
    mask = wp.array((rng.random(200 * 110) < 0.8).astype(np.int32), dtype=int, device="cpu")
    expected = draw(corners, 200, 110, box=box, mask=mask, mask_value=1)
    monkeypatch.setattr(raster_pieces, "TAKERS", takers)
    with launch.as_device(), launch.recorded() as launches:
        drawn = draw(corners, 200, 110, box=box, mask=mask, mask_value=1)
    assert ("warp_reflect.raster_pieces.draw_pieces_kernel", takers) in launches
    np.testing.assert_array_equal(drawn[0], expected[0])
    np.testing.assert_array_equal(drawn[1], expected[1])
    assert len(np.unique(drawn[0])) > 30


@pytest.mark.parametrize("seed", range(3))
def test_coverage_matches_integer_oracle(seed):
    rng = np.random.default_rng(seed)
    for _ in range(15):
        triangle = np.round(rng.uniform(-4, 20, (3, 2)) * rng.choice([1, 2, 256])) / rng.choice([1, 2, 256])
        ids, _ = draw(flat([triangle]), 16, 16)
        assert {(x, y) for y, x in zip(*np.nonzero(ids >= 0), strict=True)} == covered(triangle, 16, 16)


@pytest.mark.parametrize("seed", range(4))
def test_shared_edges_own_each_pixel_once(seed):
    """A fan around a random point, snapped corners included, tiles the picture: no gap, no pixel drawn twice."""
    rng = np.random.default_rng(seed)
    size = 96
    centre = rng.uniform(20, 76, 2)
    if seed % 2:
        centre = np.floor(centre) + 0.5
    angle = np.sort(rng.uniform(0, 2 * np.pi, 61))
    angle = np.concatenate([angle, np.linspace(0, 2 * np.pi, 8, endpoint=False)])
    angle.sort()
    rim = centre + 400 * np.stack([np.cos(angle), np.sin(angle)], 1)
    triangles = np.stack([np.broadcast_to(centre, rim.shape), rim, np.roll(rim, -1, 0)], 1)
    count = np.zeros((size, size), int)
    for triangle in triangles:
        count += draw(flat([triangle]), size, size)[0] >= 0
    assert (count == 1).all()


def test_result_does_not_depend_on_order_or_threads():
    rng = np.random.default_rng(5)
    corners = flat(rng.uniform(-10, 74, (6000, 1, 2)) + rng.normal(0, 4, (6000, 3, 2)))
    corners[:, :, 2] = rng.choice([0.1, 0.2, 0.3], (6000, 1))  # many equal depths
    ids, keys = draw(corners, 64, 64)
    for threads in (2, 5):
        again, again_keys = draw(corners, 64, 64, threads=threads)
        assert (again == ids).all() and (again_keys == keys).all()
    order = rng.permutation(6000)
    permuted, permuted_keys = draw(corners[order], 64, 64)
    assert (permuted_keys == keys).all()
    # Equal depths go to the lower id of each order.
    assert (corners[order][permuted][..., 0, 2] == corners[ids][..., 0, 2]).all()


@pytest.mark.parametrize("count", [4033, 4080, 4095, 4096])
def test_one_run_of_survivors_is_one_threads(count):
    """Triangles of one run that are as many blocks as launches are split at, the last of them not whole."""
    rng = np.random.default_rng(count)
    corners = flat(rng.uniform(-4.0, 68.0, (count, 1, 2)) + rng.uniform(-3.0, 3.0, (count, 3, 2)))
    corners[..., 2] = rng.uniform(0.05, 0.9, (count, 1))
    first, first_keys = draw(corners, 64, 64, threads=1)
    for _ in range(150):
        again, again_keys = draw(corners, 64, 64, threads=2)
        np.testing.assert_array_equal(again, first)
        np.testing.assert_array_equal(again_keys, first_keys)


def test_equal_depth_goes_to_lower_id():
    triangle = [[0, 0], [16, 0], [0, 16]]
    ids, _ = draw(flat([triangle, triangle]), 16, 16)
    assert ids[2, 2] == 0


def test_depth_key_is_linear_on_screen():
    corners = np.array([[[0, 0, 0.1, 10], [32, 0, 0.2, 5], [0, 32, 0.4, 2.5]]])
    ids, keys = draw(corners, 32, 32)
    y, x = np.nonzero(ids >= 0)
    expected = 0.1 + 0.1 * (x + 0.5) / 32 + 0.3 * (y + 0.5) / 32
    np.testing.assert_allclose(keys[y, x], expected, rtol=2e-6)


def homogeneous(points):
    """Eye-space (x, y, depth) -> project's vec4 for a unit camera at pixel scale 20, centre 16."""
    rows = []
    for x, y, depth in points:
        big_x, big_y = 20 * x + 16 * depth, 20 * y + 16 * depth
        rows.append([big_x / depth, big_y / depth, 1 / depth, depth] if depth >= NEAR else [big_x, big_y, 0.0, depth])
    return rows


def clipped_oracle(points, size=32):
    """Pixels whose ray meets the triangle in front of the near plane, float64."""
    a, b, c = np.asarray(points, float)
    hits = set()
    for y in range(size):
        for x in range(size):
            d = np.array([(x + 0.5 - 16) / 20, (y + 0.5 - 16) / 20, 1.0])
            m = np.stack([a, b, c], 1)
            if abs(np.linalg.det(m)) < 1e-12:
                continue
            w = np.linalg.solve(m, d)
            if (w > 0).all() and 1 / w.sum() > NEAR:
                hits.add((x, y))
    return hits


@pytest.mark.parametrize("seed", range(12))
def test_near_plane_clipping_matches_ray_oracle(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (3, 3))
    points[:, 2] = rng.uniform(-2, 4, 3)
    points[0, 2] = rng.choice([0.0, 1e-30, -5.0])
    points[1, 2] = 3.0
    ids, _ = draw([homogeneous(points)], 32, 32)
    drawn = {(x, y) for y, x in zip(*np.nonzero(ids >= 0), strict=True)}
    # Snapping to 1/256 pixel may move a handful of border pixels.
    assert len(drawn ^ clipped_oracle(points)) <= 2


@pytest.mark.parametrize("kernels", ["plain", "auto"])
def test_what_lies_beyond_a_side_of_the_picture_is_not_clipped(kernels):
    """Of triangles with a corner behind the eye those survive that no side of the frustum, seen by all corners, hides."""
    rng = np.random.default_rng(8)
    points = rng.uniform(-3, 3, (600, 3, 3))
    points[:, 0, 2], points[:, 1, 2] = -rng.uniform(0.1, 3, 600), rng.uniform(0.5, 3, 600)
    screen = wp.array(
        np.array([homogeneous(each) for each in points], np.float32).reshape(-1, 4), dtype=wp.vec4, device="cpu"
    )
    w = points[..., 2]
    x, y = (20 * points[..., k] + 16 * w for k in (0, 1))
    hidden = [side.all(axis=1) for side in (x < 0, y < 0, x > 32 * w, y > 32 * w)]
    expected = int((~np.any(hidden, axis=0)).sum())
    assert 100 < expected < 500
    target = raster.make_target(raster.Picture((32, 32), NEAR, 100.0), (0, 0, 32, 32), "cpu")
    index = wp.array(np.arange(1800, dtype=np.int32).reshape(-1, 3), dtype=wp.vec3i, device="cpu")
    survivors = raster.rasterise(target, screen, index, threads=1, kernels=kernels)
    assert int(survivors.numpy().sum()) == expected


def test_huge_triangles_are_clipped_to_the_guard_band():
    big = 1.0e9
    ids, _ = draw(flat([[[-big, -big], [big, -big], [0, big]]]), 32, 32)
    assert (ids == 0).all()


def test_everything_behind_draws_nothing():
    ids, _ = draw([homogeneous([[0, 0, -1], [1, 0, -2], [0, 1, 0.1]])], 32, 32)
    assert (ids == -1).all()


def test_dropped_and_zero_area_triangles_draw_nothing():
    corners = flat([[[0, 0], [16, 0], [0, 16]], [[1, 1], [5, 5], [9, 9]]])
    corners[0, 1, 2] = -1.0
    ids, _ = draw(corners, 16, 16)
    assert (ids == -1).all()


def test_mask_and_box_limit_the_drawing():
    mask = np.zeros((16, 16), np.int32)
    mask[4:8, 4:12] = 3
    ids, _ = draw(
        flat([[[-40, -40], [80, -40], [-40, 80]]]),
        16,
        16,
        box=(2, 3, 14, 10),
        mask=wp.array(mask.reshape(-1), dtype=int, device="cpu"),
        mask_value=3,
    )
    assert ((ids == 0) == (mask[3:10, 2:14] == 3)).all()
