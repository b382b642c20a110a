"""What lies behind flat water as its virtual image shows it, against rays: hits, hard views, and what the plan says of it."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from panes import GLASS, WATER, balls, stage, with_finish
from rooms import placed, sphere, square

import warp_reflect as wr
from warp_reflect import effects
from warp_reflect.launch import launch
from warp_reflect.layers import CameraView
from warp_reflect.scene import MaterialData
from warp_reflect.settings import Status
from warp_reflect.techniques import refraction_image
from warp_reflect.techniques.refraction_vector import refract_blocks_kernel
from warp_reflect.vector import launch_blocks

SIZE = (213, 120)
PAINT = MaterialData(base_color=(0.7, 0.3, 0.2), roughness=1.0)


def things(seed=3):
    """On the floor and across the surface: balls of facets and analytic ones, upright and lying squares, some very large."""
    rng = np.random.default_rng(seed)
    plain = dataclasses.replace(sphere(12, 18), parts=[])
    found = []
    for k in range(14):
        where = rng.uniform(-3, 3), rng.uniform(-0.9, 0.2), rng.uniform(-6, 1)
        found.append((sphere() if k % 3 == 0 else plain, placed(*where, rng.uniform(0.1, 0.5)), PAINT))
    for k in range(6):
        world = placed(rng.uniform(-3, 3), rng.uniform(-0.8, 0.3), rng.uniform(-5, 0))
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        world[:3, :3] = turn
        found.append((square(1, 0.3 if k % 2 else 2.5), world, PAINT))
    return found


def shown(scene, **settings):
    plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(**settings))
    frame = wr.render_frame(scene, plan)
    layer = next(iter(frame.transmitted.values())).layer
    return frame, {name: getattr(layer, name).numpy() for name in ("triangle", "distance", "status", "u", "v")}, layer


def looking_down(height, back=3.0):
    world = placed(0.2, height, back)
    world[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.8, 0.6], [0.0, -0.6, 0.8]]
    return world


@pytest.mark.parametrize("ior", [1.05, 1.333, 2.4])
@pytest.mark.parametrize("height", [0.02, 0.6, 4.0])
def test_every_ray_meets_what_a_traced_one_does(ior, height):
    water = dataclasses.replace(WATER, ior=ior)
    camera = placed(0.1, height, 3.0) if height < 1.0 else looking_down(height)
    scene = stage((square(1, 20.0), placed(0, 0, -3), water), *things(), camera=camera)
    _, traced, _ = shown(scene, refraction="traced")
    frame, drawn, layer = shown(scene, refraction="drawn")
    assert frame.plan.panes[0].effects["refraction_image"].on and len(traced["triangle"]) > 3000
    assert layer.statistics["candidate"] + layer.statistics["walk"] > 0.5 * len(traced["triangle"])
    away = np.abs(traced["distance"] - drawn["distance"]) > 1e-4 * traced["distance"]
    wrong = (traced["triangle"] != drawn["triangle"]) & away
    assert wrong.sum() <= 3e-4 * len(wrong)
    assert set(np.unique(drawn["status"])) <= {int(Status.CONVERGED), int(Status.SKY)}
    inside = drawn["triangle"] >= 0
    assert (drawn["u"][inside] >= 0.0).all() and (drawn["u"] + drawn["v"])[inside].max() <= 1.0 + 1e-6
    for kernels, threads in (("plain", 1), ("vector", 2)):
        _, again, _ = shown(scene, refraction="drawn", kernels=kernels, threads=threads)
        off = (again["triangle"] != drawn["triangle"]) & (again["distance"] != drawn["distance"])
        assert off.sum() <= 1e-3 * len(off)


@pytest.mark.parametrize(
    "camera, projection", [(placed(0.1, -0.4, 2.0), "perspective"), (looking_down(2.0), "orthographic")]
)
def test_an_eye_in_the_water_and_a_parallel_one_have_rays_traced(camera, projection):
    scene = stage((square(1, 20.0), placed(0, 0, -3), WATER), *things(), camera=camera, projection=projection)
    traced, drawn = (shown(scene, refraction=how)[1] for how in ("traced", "drawn"))
    for name in traced:
        np.testing.assert_array_equal(drawn[name], traced[name])


def test_nothing_under_the_water_is_sky():
    scene = stage((square(1, 20.0), placed(0, 0, -3), WATER), *balls(), floor=False)
    _, traced, _ = shown(scene, refraction="traced")
    frame, drawn, _ = shown(scene, refraction="drawn")
    assert "nothing lies under it" in frame.plan.panes[0].effects["refraction_image"].reason
    np.testing.assert_array_equal(drawn["triangle"], traced["triangle"])
    np.testing.assert_array_equal(drawn["status"], traced["status"])


def test_triangles_are_cut_where_they_cross_the_surface():
    """By area: what is left lies below, on it, and adds up."""
    depth_of = lambda points: -points[:, 1]  # noqa: E731
    scene = stage((square(1, 20.0), placed(0, 0, -3), WATER), *things())
    found = refraction_image.under(scene, 1)
    points = found.points.astype(np.float64) + scene.origin
    assert depth_of(points).min() > -1e-6 and len(found.edges) and len(found.solved) == len(points) + len(found.edges)
    area = np.linalg.norm(
        np.cross(*(points[found.triangles[:, k]] - points[found.triangles[:, 0]] for k in (1, 2))), axis=1
    )
    whole = scene.host_points[scene.host_triangles].astype(np.float64) + scene.origin
    for parent in np.unique(found.parents):
        corner = whole[parent]
        # Clipped by a fine lattice of the parent's own: Monte Carlo of its part below.
        rng = np.random.default_rng(parent)
        weights = rng.dirichlet((1.0, 1.0, 1.0), 2000)
        share = (depth_of(weights @ corner) > 0.0).mean()
        full = np.linalg.norm(np.cross(corner[1] - corner[0], corner[2] - corner[0]))
        assert area[found.parents == parent].sum() == pytest.approx(share * full, abs=0.06 * full)


@pytest.mark.parametrize("ior", [1.05, 1.333, 2.4])
@pytest.mark.parametrize("height", [1e-3, 0.6, 50.0])
def test_points_are_seen_by_the_law_of_refraction(ior, height):
    """Both kernels against bisection in float64: deep, on the surface, under the eye, far away, behind the eye."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(333, 3)) * 10.0 ** rng.uniform(-2, 2, (333, 1))
    points[:, 1] = -np.abs(points[:, 1])
    points[:20, 1], points[20:40, [0, 2]], points[40] = 0.0, 0.0, 0.0
    view = CameraView()
    view.eye, view.forward, view.near, view.far = wp.vec3(0.0, height, 0.0), wp.vec3(0.0, 0.0, -1.0), 1e-4, 1e5
    view.x_row, view.y_row = wp.vec4(300.0, 0.0, -160.0, 0.0), wp.vec4(0.0, -300.0, -90.0, 0.0)
    given = wp.array(points.astype(np.float32), dtype=wp.vec3, device="cpu")
    frame = [
        wp.array([view], dtype=CameraView, device="cpu"),
        wp.vec3(0.0, 0.0, 0.0),
        wp.vec3(0.0, 1.0, 0.0),
        height,
        ior,
    ]
    screens = [wp.zeros(333, dtype=wp.vec4, device="cpu") for _ in range(2)]
    launch(refraction_image.refract_vertices_kernel, 333, [given, *frame, screens[0]], "cpu")
    limits = [refraction_image.FOOT_STEPS, refraction_image.FOOT_DIGITS]
    launch_blocks(refract_blocks_kernel, 333, [given, *frame, *limits, screens[1]], "cpu")
    way, depth = np.hypot(points[:, 0], points[:, 2]), -points[:, 1]
    low, high = np.zeros(333), way.copy()
    for _ in range(80):
        s = 0.5 * (low + high)
        f = s / np.hypot(s, height) - ior * (way - s) / np.maximum(np.hypot(way - s, depth), 1e-300)
        low, high = np.where(f < 0.0, s, low), np.where(f < 0.0, high, s)
    s = 0.5 * (low + high)
    crossing = np.stack([points[:, 0], 0.0 * s, points[:, 2]], 1) * (s / np.maximum(way, 1e-300))[:, None]
    crossing[:, 1] = -height
    length = np.linalg.norm(crossing, axis=1)
    path = length + np.linalg.norm(points - [0.0, height, 0.0] - crossing, axis=1)
    ray = crossing / length[:, None]
    before = ray[:, 2] * path < -1e-3 * path  # well before the eye
    ray[~before, 2] = -1.0
    want = np.stack([160.0 + 300.0 * ray[:, 0] / -ray[:, 2], 90.0 - 300.0 * ray[:, 1] / -ray[:, 2]], 1)
    assert before.sum() > 80
    for screen in screens:
        got = screen.numpy()
        assert np.isfinite(got).all()
        # A pixel is 1/300 radian: what float32 leaves of a depth far below a low eye.
        off = np.abs(got[before, :2] - want[before]) / (1.0 + np.abs(want[before]))
        assert np.quantile(off, 0.95) < 1e-3 and off.max() < 0.05
        np.testing.assert_allclose(1.0 / got[before, 2], (-ray[:, 2] * path)[before], rtol=1e-3)
    np.testing.assert_allclose(screens[1].numpy()[before], screens[0].numpy()[before], rtol=1e-3, atol=1e-3)


def test_the_plan_says_how_and_why(monkeypatch):
    water = square(1, 20.0), placed(0, 0, -3), WATER
    scene = stage(water, *balls())

    def effect(scene, method="auto", size=SIZE, **settings):
        plan = wr.make_plan(scene, size=size, settings=wr.Settings(**settings), method=method)
        return plan.panes[0].effects["refraction_image"]

    on = effect(scene)
    plan = wr.make_plan(scene, size=SIZE)
    ask = scene, plan.panes[0].part, "solid", plan.panes[0].pixels
    for refraction, asked in (("auto", False), ("drawn", True)):
        with monkeypatch.context() as patched:
            patched.setattr(scene, "device", SimpleNamespace(is_cuda=True))
            there = effects.refraction_effect(*ask, wr.Settings(refraction=refraction), plan.camera, "auto")
        assert there.on == asked and (asked or "GPU" in there.reason)
    assert on.on and "triangles under it" in on.reason and "(refraction=auto)" in on.reason
    assert not effect(scene, refraction="traced").on
    assert "reference" in effect(scene, method="reference").reason
    assert not effect(scene, size=(4, 3)).on and effect(scene, size=(4, 3), refraction="drawn").on
    ball = effect(stage((sphere(), placed(0, 0.2, 0, 0.4), GLASS)), refraction="drawn")
    assert not ball.on and "not flat" in ball.reason
    thin = with_finish(WATER, interface="thin")
    assert "thin" in effect(stage((*water[:2], thin))).reason
    with pytest.raises(ValueError, match="setting 'refraction': got 'fast', expected one of auto, drawn, traced"):
        wr.Settings(refraction="fast")
