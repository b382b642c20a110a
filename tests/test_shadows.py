"""Shadows of every kind of light against sums in float64, and the plan that turns them on."""

from dataclasses import replace

import numpy as np
import pytest
from test_shade import (
    WHITE,
    ball_mesh,
    distant,
    dome,
    emitting_elements,
    eye_rays,
    ground,
    look_at,
    place,
    scene_of,
    turned,
)

import warp_reflect as wr
from warp_reflect import direct, launch, raster, shade, shadows, surface
from warp_reflect.scene import LightData, MaterialData, MeshData, Scene
from warp_reflect.settings import Settings

SILVER = MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
CARD = 0.6  # half of its side
CARD_HEIGHT = 0.7


def under_a_card(light, size=(32, 24)):
    """Ground with a card above it: (scene, camera, points [n, 3] of the ground seen)."""
    scene = scene_of([(ground(), place(0.1, 0, 0), WHITE), (ground(CARD), place(0, CARD_HEIGHT, 0), WHITE)], [light])
    camera = look_at((0.0, 5.0, 4.0), (0, 0, 0), fov=40.0, size=size)
    d = eye_rays(camera)
    return scene, camera, camera.eye - (camera.eye[1] / d[:, 1])[:, None] * d


def share_by_sum(light, points) -> np.ndarray:
    """Share of a light's irradiance on upward faces that passes the card, by summing over the light's surface."""
    elements, normals, areas = emitting_elements(light.kind, light.size, light.world_from_light, count=90)
    result = []
    for x in points:
        d = elements - x
        r = np.linalg.norm(d, axis=1)
        facing = np.maximum(-np.einsum("ij,ij->i", normals, d) / r, 0.0)
        weight = np.maximum(d[:, 1] / r, 0.0) * facing / r**2 * areas
        t = CARD_HEIGHT / np.where(d[:, 1] == 0.0, np.inf, d[:, 1])
        at = x + t[:, None] * d
        blocked = (t > 0) & (t < 1) & (np.abs(at[:, 0]) < CARD) & (np.abs(at[:, 2]) < CARD)
        result.append((weight * ~blocked).sum() / max(weight.sum(), 1e-300))
    return np.array(result)


LAMPS = {
    "rect": LightData("/lamp", "rect", (1, 1, 1), turned(-1.4, 0.4, (0.3, 2.0, 0.2)), size=(1.2, 0.8)),
    "disk": LightData("/lamp", "disk", (1, 1, 1), turned(-1.5, 0.4, (0.2, 2.0, 0.2)), size=(0.6,)),
    "sphere": LightData("/lamp", "sphere", (1, 1, 1), turned(0, 0, (0.3, 2.2, -0.2)), size=(0.5,)),
    "cylinder": LightData("/lamp", "cylinder", (1, 1, 1), turned(0, 0.4, (0.3, 2.0, 0.2)), size=(1.4, 0.04)),
}


@pytest.mark.parametrize("kind", LAMPS)
def test_penumbra_of_a_shape_is_the_share_of_it_that_is_seen(kind):
    scene, camera, p = under_a_card(LAMPS[kind])
    gbuffer = raster.draw_scene(scene, camera)
    points = direct.points_of(scene, gbuffer)
    whole = direct.direct_irradiance(scene, scene.lights.direct, points).numpy()[:, 0]
    on_ground = gbuffer.triangle.numpy() < 2
    exact = share_by_sum(LAMPS[kind], p[on_ground])
    part = (exact > 0.05) & (exact < 0.95)
    assert part.sum() > 30 and (exact == 0).sum() + (exact == 1).sum() > 100
    error = []
    # What neighbours share is as good as what each asks itself.
    shared = replace(shadows.every_shadow(scene, 16), shared=True)
    seen = shadows.shadowed_irradiance(scene, points, shared).numpy()[:, 0]
    assert np.sqrt(np.mean(((seen / whole)[on_ground] - exact)[part] ** 2)) < 0.08
    for samples in (4, 16, 256):
        seen = shadows.shadowed_irradiance(scene, points, shadows.every_shadow(scene, samples)).numpy()[:, 0]
        difference = (seen / whole)[on_ground] - exact
        error.append(np.sqrt(np.mean(difference[part] ** 2)))
        # What is wholly lit keeps its irradiance; what is wholly dark gets none.
        assert np.abs(difference[exact == 1.0]).max() <= 1e-6
        assert np.abs(difference[exact == 0.0]).max() == 0.0
    assert error[0] < 0.2 and error[1] < 0.08 and error[2] < 0.02, error
    assert error[2] < 0.5 * error[1] < 0.5 * error[0]


def test_neighbours_share_where_a_penumbra_is_wide_and_ask_where_it_is_narrow():
    """Half of the error of each asking as many itself; an edge as sharp as without; what is one light or none stays so."""
    lamp = LightData("/lamp", "rect", (1, 1, 1), turned(-1.4, 0.4, (0.3, 2.0, 0.2)), size=(1.2, 0.8))
    small = LightData("/lamp", "sphere", (1, 1, 1), turned(0, 0, (0.3, 2.2, -0.2)), size=(0.01,))
    for light, most in ((lamp, 0.5), (small, 1.0)):
        scene, camera, _ = under_a_card(light, (160, 120))
        points = direct.points_of(scene, raster.draw_scene(scene, camera))
        whole = direct.direct_irradiance(scene, scene.lights.direct, points).numpy()[:, 0]
        every = shadows.every_shadow(scene, 256)
        exact = shadows.shadowed_irradiance(scene, points, every).numpy()[:, 0]
        lit = whole > 0.0
        error = []
        for cast in (replace(every, samples=4), replace(every, samples=16, shared=True)):
            seen = shadows.shadowed_irradiance(scene, points, cast).numpy()[:, 0]
            error.append(np.sqrt(np.mean(((seen - exact)[lit] / whole[lit]) ** 2)))
        assert 0.0 < error[1] < most * error[0], error


@pytest.mark.parametrize("size", [(64, 40), (70, 38)], ids=["whole tiles", "rows"])
@pytest.mark.parametrize("shared", [False, True])
def test_blocks_of_rays_find_what_single_rays_do(size, shared):
    """Whatever way a picture is cut into blocks, and in memory that held another picture before."""
    scene, camera, _ = under_a_card(LAMPS["sphere"], size)
    points = direct.points_of(scene, raster.draw_scene(scene, camera))
    cast = replace(shadows.every_shadow(scene, 16), shared=shared)
    plain = shadows.shadowed_irradiance(scene, points, cast, kernels="plain").numpy()
    for threads in (1, 2):
        blocks = shadows.shadowed_irradiance(scene, points, cast, threads).numpy()
        np.testing.assert_allclose(blocks, plain, rtol=1.0e-5, atol=1.0e-6)


@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("samples", [1, 7, 16, 80])
def test_lists_of_rays_bring_the_same_on_a_device_and_on_threads(samples, shared):
    """More samples than a ray's bits are told by among them, a shape that points lie in, and one that none asks."""
    lights = [LAMPS["sphere"], distant((1, 2, 1), (0.2, 1.0, 0.1)), LAMPS["rect"], LAMPS["cylinder"]]
    lights.append(LightData("/inside", "sphere", (1, 1, 1), place(0, 0.0, 0), size=(0.5,)))
    scene = scene_of([(ground(), place(0.1, 0, 0), WHITE), (ground(CARD), place(0, CARD_HEIGHT, 0), WHITE)], lights)
    camera = look_at((0.0, 5.0, 4.0), (0, 0, 0), fov=40.0, size=(70, 38))
    points = direct.points_of(scene, raster.draw_scene(scene, camera))
    cast = replace(shadows.every_shadow(scene, samples), shared=shared)
    cast = replace(cast, areas=(True, True, False, True))
    blocks = shadows.shadowed_irradiance(scene, points, cast).numpy()
    with launch.as_device():
        expected = shadows.shadowed_irradiance(scene, points, cast, kernels="plain").numpy()
    np.testing.assert_allclose(expected, blocks, rtol=1.0e-5, atol=1.0e-6)
    for threads in (1, 2, 3):
        plain = shadows.shadowed_irradiance(scene, points, cast, threads, kernels="plain").numpy()
        np.testing.assert_array_equal(plain, expected)


def test_no_light_below_the_horizon_or_from_behind_a_shape():
    """A rect that looks away, and one under the ground: dark, and no ray decides anything."""
    for world in (turned(np.pi / 2, 0.0, (0, 2, 0)), turned(-np.pi / 2, 0.0, (0, -1, 0))):
        scene, camera, _ = under_a_card(LightData("/lamp", "rect", (1, 1, 1), world, size=(1.0, 1.0)))
        points = direct.points_of(scene, raster.draw_scene(scene, camera))
        top = points.triangle.numpy() < 2
        assert not shadows.shadowed_irradiance(scene, points, shadows.every_shadow(scene)).numpy()[top].any()


@pytest.mark.parametrize("smooth", [True, False])
def test_a_ball_does_not_shade_its_own_lit_side(smooth):
    """Facets stand for a ball: seen with its normals, nothing on its lit side is dark, up to the terminator."""
    mesh = ball_mesh()
    to_light = np.array([0.6, 0.8, 0.0])
    scene = scene_of([(mesh, place(), WHITE)], [distant((1, 1, 1), to_light)])
    if not smooth:
        mesh.normals = None
        scene = scene_of([(mesh, place(), WHITE)], [distant((1, 1, 1), to_light)])
    camera = look_at((0.5, 1, 3), (0, 0, 0))
    gbuffer = raster.draw_scene(scene, camera)
    gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {})[1]
    points = direct.points_of(scene, gbuffer)
    got = shadows.shadowed_irradiance(scene, points, shadows.every_shadow(scene)).numpy()[:, 0]
    normal = surface.surface_channels(scene, gbuffer)["N"].numpy()
    cosine = normal @ to_light
    lit = (points.triangle.numpy() >= 0) & (cosine > (0.02 if smooth else 0.15))
    assert lit.sum() > 300
    right = np.abs(got[lit] - cosine[lit]) < 1e-5
    assert right.mean() > 0.998  # a pixel of the outline may lie on a facet that looks away


def test_sky_beside_a_wall_has_the_closed_form():
    """A long wall of height h at distance d hides (1 - d / sqrt(d^2 + h^2)) / 2 of the cosine-weighted sky."""
    wall = MeshData(
        points=np.float32([[-90, 0, 0], [90, 0, 0], [90, 1, 0], [-90, 1, 0]]),
        triangles=np.int32([[0, 1, 2], [0, 2, 3]]),
        double_sided=True,
    )
    scene = scene_of([(ground(90.0), place(), WHITE), (wall, place(), WHITE)], [dome()])
    camera = look_at((0.0, 6.0, 2.0), (0, 0, 1.5), fov=30.0, size=(24, 18))
    gbuffer = raster.draw_scene(scene, camera)
    d = eye_rays(camera)
    p = camera.eye - (camera.eye[1] / d[:, 1])[:, None] * d
    clear = (gbuffer.triangle.numpy() < 2) & (p[:, 2] > 0.05)
    assert clear.sum() > 200
    exact = 0.5 + 0.5 * p[clear, 2] / np.sqrt(p[clear, 2] ** 2 + 1.0)
    points = direct.points_of(scene, gbuffer)
    error = [
        np.sqrt(np.mean((shadows.sky_share(scene, points, samples).numpy()[clear] - exact) ** 2))
        for samples in (16, 256)
    ]
    assert error[0] < 0.08 and error[1] < 0.015, error
    # In the picture it multiplies what the dome gives.
    gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {})[1]
    cast = shadows.every_shadow(scene, 256, domes=True)
    picture = shade.shade(scene, gbuffer, {}, shadows=cast)[0].numpy()[clear, 0]
    np.testing.assert_allclose(picture, shadows.sky_share(scene, points, 256).numpy()[clear], atol=1e-5)


def test_a_closed_room_under_a_dome_is_dark():
    import trimesh

    box = trimesh.creation.box((4, 4, 4))
    room = MeshData(np.float32(box.vertices), np.int32(box.faces), double_sided=True)
    scene = scene_of([(room, place(), WHITE), (ball_mesh(), place(0, -1, 0, 0.5), SILVER)], [dome()])
    camera = look_at((0, 0.2, 1.8), (0, -0.5, 0), fov=70)
    open_plan = wr.make_plan(scene, camera, size=(48, 36))
    shut = wr.make_plan(scene, camera, size=(48, 36), settings=Settings(dome_shadows="on"))
    assert wr.render_frame(scene, open_plan)["R"].min() > 0.2
    picture = wr.render_frame(scene, shut)["RGBA"]
    ball = wr.render_frame(scene, shut)["reflectorId"] > 0
    assert not picture[~ball][:, :3].any()
    assert not open_plan.lights[0].effects["shadows"].on and shut.lights[0].effects["shadows"].on
    assert "dome_shadows=off" in open_plan.lights[0].effects["shadows"].reason


def lit_scene(lights, with_ball=True) -> Scene:
    placed = [(ground(), place(), WHITE)]
    if with_ball:
        placed.append((ball_mesh(), place(0, 0.8, 0, 0.5), WHITE))
    return scene_of(placed, lights)


VIEW = look_at((0, 4.0, 5.0), (0, 0.3, 0), fov=40, size=(96, 72))


def planned(scene, camera=VIEW, **settings):
    return wr.make_plan(scene, camera, size=camera.size, settings=Settings(**settings))


def test_plan_turns_on_the_lights_that_cast_into_view():
    sun = distant((1, 1, 1), (0.35, 1.0, 0.1))
    lamp = LightData("/lamp", "sphere", (30, 30, 30), place(1, 3, 0), size=(0.2,))
    below = LightData("/cellar", "sphere", (5, 5, 5), place(0, -3, 0), size=(0.2,))
    plan = planned(lit_scene([sun, lamp, below, dome()]))
    assert [row.effects["shadows"].on for row in plan.lights] == [True, True, False, False]
    assert [row.path for row in plan.lights] == ["/sun", "/lamp", "/cellar", "/dome"]
    sunny = plan.lights[0].effects["shadows"]
    assert 0.001 < sunny.numbers["taken"] < 0.2 and sunny.numbers["shadowed"] > 0.0 and sunny.numbers["ms"] > 0.0
    assert "shadow_min_share" in sunny.reason
    assert plan.shadows.distant == (True,) and plan.shadows.areas == (True, False)
    told = plan.to_json()["lights"]
    assert told[1]["effects"]["shadows"]["on"] and told[1]["kind"] == "sphere"
    assert "/lamp: sphere light" in str(plan)


def test_plan_leaves_off_what_casts_nothing():
    sun = distant((1, 1, 1), (0.35, 1.0, 0.1))
    plan = planned(lit_scene([sun], with_ball=False))
    assert not plan.lights[0].effects["shadows"].on and plan.shadows is None
    assert planned(lit_scene([sun]), shadow_min_share=0.5).shadows is None
    assert planned(lit_scene([sun]), shadows="off").shadows is None
    assert planned(lit_scene([sun], with_ball=False), shadows="on").shadows.distant == (True,)
    assert planned(lit_scene([dome()])).shadows is None
    assert planned(scene_of([], [sun])).shadows is None


def test_a_shadow_that_only_a_mirror_shows_is_cast():
    """The ball's shadow lies behind the eye; a mirror before it shows it."""
    wall = MeshData(
        points=np.float32([[-4, 0, -3], [4, 0, -3], [4, 4, -3], [-4, 4, -3]]),
        triangles=np.int32([[0, 1, 2], [0, 2, 3]]),
    )
    sun = distant((1, 1, 1), (0.0, 1.0, 0.3))
    camera = look_at((0, 2.5, 0.0), (0, 1.5, -3), fov=50, size=(96, 72))
    for material, on in ((SILVER, True), (WHITE, False)):
        placed = [(ground(), place(), WHITE), (ball_mesh(), place(0, 1.2, 2, 1.0), WHITE), (wall, place(), material)]
        plan = planned(scene_of(placed, [sun]), camera)
        assert plan.lights[0].effects["shadows"].on == on, plan.lights


def test_shadowed_frames_do_not_depend_on_threads_and_stay_finite():
    lights = [distant((1, 1, 1), (0.35, 1.0, 0.1)), LAMPS["rect"], LAMPS["sphere"], dome()]
    lights.append(LightData("/inside", "sphere", (1, 1, 1), place(0, 0.8, 0), size=(0.2,)))
    lights.append(LightData("/touching", "sphere", (1, 1, 1), place(0, 0.0, 0), size=(0.5,)))
    placed = [(ground(), place(), WHITE), (ball_mesh(), place(0, 0.8, 0, 0.5), SILVER)]
    scene = scene_of(placed, lights)
    frames = [
        wr.render_frame(scene, planned(scene, threads=threads, dome_shadows=True, shadows=True))
        for threads in (1, 2, 3)
    ]
    assert np.isfinite(frames[0]["RGBA"]).all()
    for other in frames[1:]:
        np.testing.assert_array_equal(frames[0]["RGBA"], other["RGBA"])
    assert (frames[0]["RGBA"] != wr.render_frame(scene, planned(scene, shadows=False))["RGBA"]).any()


def test_settings_take_switches_in_every_spelling():
    for value, kept in ((True, "on"), (False, "off"), ("true", "on"), ("0", "off"), ("auto", "auto"), ("ON", "on")):
        assert Settings(shadows=value).shadows == kept
        assert Settings().replace(shadows=value).shadows == kept
    assert Settings().shadows == "auto" and Settings().dome_shadows == "off"
    for wrong in ({"shadows": "perhaps"}, {"dome_shadows": "auto"}, {"shadow_samples": 0}, {"shadow_min_share": 2}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            Settings(**wrong)
