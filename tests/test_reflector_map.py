"""Reflection points in reflector maps against constructed truth: choose R and the angle, then eye and point."""

import numpy as np
import pytest
import warp as wp

import warp_reflect as wr
from warp_reflect.bodies import analyse
from warp_reflect.reflector_maps import ReflectorMap, ReflectorMapView
from warp_reflect.settings import Settings, Status
from warp_reflect.techniques import map_search
from warp_reflect.techniques.map_search import SearchResult, SearchSettings

wp.set_module_options({"enable_backward": False})


@wp.kernel
def probe_kernel(
    first: int,
    map: ReflectorMapView,
    eye: wp.array(dtype=wp.vec3),
    target: wp.array(dtype=wp.vec3),
    settings: SearchSettings,
    out: wp.array(dtype=SearchResult),
    out_visible: wp.array(dtype=int),
):
    i = first + wp.tid()
    out_visible[i] = wp.where(map_search.is_visible(map, eye[i], target[i]), 1, 0)
    seed = map_search.first_guess(map, eye[i], target[i])
    out[i] = map_search.search(map, eye[i], target[i], seed, settings)


def probe(drawn, eye, target, settings):
    """(R [n, 3], residual tangent, visible) in the body's own frame."""
    m = drawn.unit_from_body
    unit = [wp.array((x @ m[:3, :3].T + m[:3, 3]).astype(np.float32), dtype=wp.vec3) for x in (eye, target)]
    out = wp.zeros(len(eye), dtype=SearchResult)
    visible = wp.zeros(len(eye), dtype=int)
    chosen = map_search.search_settings(settings, drawn.resolution)
    wp.launch(probe_kernel, dim=len(eye), inputs=[0, drawn.view, *unit, chosen, out, visible])
    result = out.numpy()
    points = (result["p"].astype(np.float64) - m[:3, 3]) @ np.linalg.inv(m[:3, :3]).T
    return points, result["residual"], visible.numpy() == 1


def ellipsoid(axes, rows=48, columns=96):
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    unit = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    unit[0], unit[-1] = [0, 1, 0], [0, -1, 0]
    unit = unit.reshape(-1, 3)
    i = np.arange(rows * columns)
    a, b = i // columns * columns + i % columns, i // columns * columns + (i + 1) % columns
    faces = np.concatenate([np.stack([a, b, a + columns], 1), np.stack([b, b + columns, a + columns], 1)])
    p = unit[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    return unit * axes, faces[area > 1e-9].astype(np.int32)


def ellipsoid_polish(axes):
    """Moves map nodes onto the ellipsoid x / axes on the unit sphere."""

    def polish(triangle, origin, directions, distance):
        o, d = origin / axes, directions / axes
        a, b, c = (d * d).sum(1), d @ o, o @ o - 1
        t = (-b + np.sqrt(b * b - a * c)) / a
        p = origin + t[:, None] * directions
        n = p / axes**2
        return t, n / np.linalg.norm(n, axis=1, keepdims=True)

    return polish


def constructed(axes, count, rng, incidence=80.0, near=0.2, far=10.0):
    """Eyes and targets whose reflection point is known."""
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    r = u * axes
    n = u / axes
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    helper = rng.normal(size=(count, 3))
    tangent = np.cross(n, helper)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = np.radians(rng.uniform(0, incidence, count))[:, None]
    o = np.cos(angle) * n + np.sin(angle) * tangent
    v = 2 * (n * o).sum(1, keepdims=True) * n - o
    size = max(axes)
    lengths = size * np.exp(rng.uniform(np.log(near), np.log(far), (2, count, 1)))
    return r, r + lengths[0] * o, r + lengths[1] * v


BODIES = {"sphere": (1, 1, 1), "2:1:1": (2, 1, 1), "1:1:.2": (1, 1, 0.2), "10:1:1": (10, 1, 1)}


def draw(axes, resolution, scale=1.0):
    axes = scale * np.asarray(axes, float)
    points, faces = ellipsoid(axes)
    return axes, ReflectorMap.from_mesh(points, faces, resolution, polish=ellipsoid_polish(axes))


@pytest.mark.parametrize("name", BODIES)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_newton_finds_the_constructed_point(name, scale):
    axes, drawn = draw(BODIES[name], 128, scale)
    r, eye, target = constructed(axes, 4000, np.random.default_rng(1))
    found, residual, visible = probe(drawn, eye, target, Settings())
    error = np.linalg.norm(found - r, axis=1) / max(axes)
    assert visible.all()
    # The map's own error at n = 128 is 4 times that of n = 256 measured for such maps: 95 % below 1e-4 of the size.
    assert np.percentile(error, 95) < 1e-4
    assert np.percentile(error, 99.9) < 2e-3
    assert (residual < 1e-5).mean() > 0.99


def test_error_falls_with_the_square_of_the_texel():
    errors = []
    rng_seed = 3
    for resolution in (32, 64, 128):
        axes, drawn = draw((2, 1, 1), resolution)
        r, eye, target = constructed(axes, 3000, np.random.default_rng(rng_seed))
        found, _, _ = probe(drawn, eye, target, Settings(tolerance=1e-6))
        errors.append(np.median(np.linalg.norm(found - r, axis=1)))
    slope = np.polyfit(np.log([31, 63, 127]), np.log(errors), 1)[0]
    assert -2.3 < slope < -1.7


def test_midpoint_search_converges_with_its_iterations():
    axes, drawn = draw((1, 1, 1), 128)
    r, eye, target = constructed(axes, 2000, np.random.default_rng(2))
    medians = []
    for iterations in (1, 3, 9):
        found, _, _ = probe(drawn, eye, target, Settings(search="midpoint", iterations=iterations))
        medians.append(np.median(np.linalg.norm(found - r, axis=1)))
    assert medians[0] > 2 * medians[1] > 4 * medians[2]
    assert medians[2] < 1e-3


@pytest.mark.parametrize("name", BODIES)
def test_visibility_matches_the_chord(name):
    """A target is hidden exactly where the segment to the eye cuts the ellipsoid."""
    axes, drawn = draw(BODIES[name], 128)
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(2, 6000, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    eye, target = direction * axes * np.exp(rng.uniform(np.log(1.05), np.log(8), (2, 6000, 1)))
    o, d = eye / axes, (target - eye) / axes
    t = np.clip(-(o * d).sum(1) / (d * d).sum(1), 0, 1)
    nearest = np.linalg.norm(o + t[:, None] * d, axis=1)
    _, _, visible = probe(drawn, eye, target, Settings())
    sure = np.abs(nearest - 1) > 4e-4  # the bilinear body at n = 128 deviates by h^2 / 8 = 3e-5 and the gauge margin
    assert (visible[sure] == (nearest > 1)[sure]).all()
    assert 0.1 < visible.mean() < 0.95


def test_eye_and_target_exchange_without_moving_the_point():
    axes, drawn = draw((2, 1, 1), 128)
    _, eye, target = constructed(axes, 1000, np.random.default_rng(5))
    one, _, _ = probe(drawn, eye, target, Settings(tolerance=1e-6))
    two, _, _ = probe(drawn, target, eye, Settings(tolerance=1e-6))
    assert np.percentile(np.linalg.norm(one - two, axis=1), 99) < 1e-5


def test_search_never_answers_nan():
    _, drawn = draw((1, 1, 0.2), 64)
    rng = np.random.default_rng(6)
    scale = 10.0 ** rng.uniform(-8, 8, (2, 20000, 1))
    eye, target = rng.normal(size=(2, 20000, 3)) * scale
    eye[:100] = 0.0
    target[50:150] = 0.0
    target[200:300] = eye[200:300]
    for search in ("newton", "midpoint"):
        found, residual, _ = probe(drawn, eye, target, Settings(search=search))
        assert np.isfinite(found).all() and np.isfinite(residual).all()


@pytest.mark.parametrize(
    ("edit", "word"),
    [
        (lambda p, f: (np.where(p[:, :1] > 0.7, p * [-0.2, 1, 1], p), f[5:]), "open"),
        (lambda p, f: (np.where(np.abs(p[:, :1]) < 0.3, p * [1, 0.2, 0.2], p), f), "convex"),
        (lambda p, f: (np.concatenate([p, p + 5]), np.concatenate([f, f + len(p)])), "star-shaped"),
    ],
)
def test_bodies_no_map_can_hold_are_refused(edit, word):
    points, faces = edit(*ellipsoid(np.ones(3)))
    with pytest.raises(ValueError, match=word):
        ReflectorMap.from_mesh(points, faces, 32)


def test_body_analysis_recognises_a_convex_body():
    points, faces = ellipsoid(np.array([3.0, 1.0, 0.5]))
    body = analyse(points + 7.0, faces)
    assert body.closed and body.star_shaped and body.convex and not body.reason
    np.testing.assert_allclose(body.centre, 7.0, atol=1e-6)
    np.testing.assert_allclose(np.sort(body.extent), [0.5, 1.0, 3.0], rtol=5e-3)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_bare_solver_takes_a_reflector_map(dtype, device):
    """The public call, in the body's own frame far from the origin, one eye and many points; the map was drawn on the CPU."""
    axes, _ = draw((2, 1, 1), 16)
    offset = np.array([100.0, -20.0, 7.0])
    points, faces = ellipsoid(axes)
    mirror = wr.ReflectorMap.from_mesh(points + offset, faces, resolution=128)
    r, eye, target = constructed(axes, 300, np.random.default_rng(8))
    for k in range(5):
        answer = wr.solve(mirror, eye[k] + offset, (target[k : k + 1] + offset).astype(dtype), device=device)
        assert answer.point.dtype == dtype and answer.status[0] == Status.CONVERGED
        # A mesh of 96 columns deviates from the ellipsoid by 4e-4 of its size, and its normals by their interpolation.
        assert np.linalg.norm(answer.point[0] - offset - r[k]) < 1e-2
        assert answer.residual[0] < 1e-3
    bad = np.array([[np.nan, 0, 0], offset, offset + [6.0, 0, 0], offset + [50, 0, 0]], dtype)
    answer = wr.solve(mirror, offset - [50.0, 0, 0], bad, device=device)
    assert list(answer.status[[0, 1, 3]]) == [Status.BAD_INPUT, Status.INSIDE, Status.HIDDEN]
    assert all(np.isfinite(x).all() for x in (answer.point, answer.normal, answer.virtual, answer.residual))


def test_open_half_has_the_whole_bodys_reflection_points_and_masks_the_rest():
    """Of an ellipsoid's upper half: R by construction; above, R is found and masked 1, below, the search ends off it."""
    axes = np.array([1.5, 1.0, 0.8])
    points, faces = ellipsoid(axes, 96, 192)
    upper = faces[(points[faces][:, :, 1] >= -1e-9).all(axis=1)]
    drawn = ReflectorMap.from_mesh(points, upper, 128, polish=ellipsoid_polish(axes))
    assert not drawn.closed and 0.3 < drawn.texels[..., 3].mean() < 0.7
    r, eye, target = constructed(axes, 4000, np.random.default_rng(6), incidence=70.0)
    found, residual, visible = probe(drawn, eye, target, Settings())
    above, below = r[:, 1] > 0.05, r[:, 1] < -0.05
    assert visible[above].all()
    error = np.linalg.norm(found - r, axis=1)[above]
    assert np.percentile(error, 95) < 1e-3 and (residual[above] < 1e-3).mean() > 0.995
    assert (found[below & visible][:, 1] < 1e-2).mean() > 0.995
    assert np.isfinite(found).all() and np.isfinite(residual).all()


@pytest.mark.parametrize(("rows", "columns", "gain"), [(16, 32, 20.0), (32, 64, 20.0)])
def test_map_of_a_coarse_sphere_lies_on_the_sphere_its_normals_describe(rows, columns, gain):
    """Half of Phong's displacement: distances from the sphere fall by far more than the tessellation alone would give."""
    points, faces = ellipsoid(np.ones(3), rows, columns)
    flat = points[faces]
    facet = np.cross(flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0])
    facet /= np.linalg.norm(facet, axis=1, keepdims=True)
    radii = []
    for normals in (np.repeat(facet[:, None], 3, axis=1), flat):
        drawn = ReflectorMap.from_mesh(points, faces, 64, normals=normals)
        unit = drawn.texels[..., :3].reshape(-1, 3).astype(np.float64)
        m = drawn.unit_from_body
        radii.append(np.linalg.norm((unit - m[:3, 3]) @ np.linalg.inv(m[:3, :3]).T, axis=1))
    plain, lifted = (np.abs(radius - 1.0).max() for radius in radii)
    assert lifted < plain / gain
