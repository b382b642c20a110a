"""Rough mirrors against float64 quadrature of the GGX lobe, against rays, and against themselves."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from rooms import placed, plane_room, room, sphere, square

import warp_reflect as wr
from warp_reflect.finishes import lobe
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, Scene, SceneData

wp.set_module_options({"enable_backward": False})
SIZE = (96, 54)


@wp.kernel
def sample_kernel(
    first: int,
    alpha: float,
    view: wp.vec3,
    count: int,
    out_direction: wp.array(dtype=wp.vec3),
    out_weight: wp.array(dtype=float),
    out_solid_angle: wp.array(dtype=float),
):
    k = first + wp.tid()
    n = wp.vec3(0.0, 0.0, 1.0)
    sample = lobe.lobe_sample(alpha, n, view, lobe.lattice_point(k, count, wp.vec2(0.3, 0.7)))
    out_direction[k] = sample.direction
    out_weight[k] = sample.weight
    out_solid_angle[k] = sample.solid_angle


def samples(roughness, view, count=4096):
    direction = wp.zeros(count, dtype=wp.vec3, device="cpu")
    weight, solid_angle = (wp.zeros(count, dtype=float, device="cpu") for _ in range(2))
    inputs = [0, max(roughness**2, 1e-5), wp.vec3(*view), count, direction, weight, solid_angle]
    wp.launch(sample_kernel, dim=count, inputs=inputs, device="cpu")
    return direction.numpy().astype(np.float64), weight.numpy(), solid_angle.numpy()


def reflected_quadrature(view, roughness, radiance, fresnel=lambda cosine: 1.0, rings=400, spokes=256):
    """Radiance that a GGX mirror of normal +z sends towards `view`, by quadrature over microfacet normals; float64.

    Args:
        view: Unit.
        roughness: alpha = roughness^2.
        radiance: Of unit directions [n, 3] to [n] or [n, c].
        fresnel: Of the cosine at the microfacet.
    """
    alpha = roughness**2
    # tan(theta) = alpha sqrt(u / (1 - u)) spreads D cos(theta) dh evenly over u.
    u, du = np.polynomial.legendre.leggauss(rings)
    u, du = 0.5 * (u + 1.0), 0.5 * du
    phi = 2.0 * np.pi * (np.arange(spokes) + 0.5) / spokes
    tangent = alpha * np.sqrt(u / (1.0 - u))
    cosine = 1.0 / np.sqrt(1.0 + tangent**2)
    sine = tangent * cosine
    h = np.stack(
        [sine[:, None] * np.cos(phi), sine[:, None] * np.sin(phi), np.broadcast_to(cosine[:, None], (rings, spokes))],
        -1,
    ).reshape(-1, 3)
    share = np.repeat(du, spokes) / spokes  # of the integral of D (n.h) dh = 1
    v_h = h @ view
    d = 2.0 * v_h[:, None] * h - view

    def smith(c):
        return 0.5 * (np.sqrt(1.0 + alpha**2 * (1.0 / c**2 - 1.0)) - 1.0)

    out = (v_h > 0.0) & (d[:, 2] > 0.0)
    h, d, v_h, share = h[out], d[out], v_h[out], share[out]
    shadow = 1.0 / (1.0 + smith(view[2]) + smith(d[:, 2]))
    # f cos(out) d(out) = D G F / (4 (n.v)) d(out), d(out) = 4 (v.h) dh.
    weight = share * shadow * fresnel(v_h) * v_h / (view[2] * h[:, 2])
    values = np.asarray(radiance(d))
    return np.tensordot(weight, values, axes=(0, 0)), float(weight.sum())


def at_angle(degrees, turn=0.0):
    a, b = np.radians(degrees), np.radians(turn)
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


@pytest.mark.parametrize("roughness", [0.02, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("degrees", [0.0, 40.0, 75.0, 86.0])
def test_samples_have_the_lobe_s_energy_mean_and_spread(roughness, degrees):
    view = at_angle(degrees, 30.0)
    direction, weight, solid_angle = samples(roughness, view)
    assert np.isfinite(direction).all() and np.isfinite(solid_angle).all()
    assert (weight >= 0.0).all() and (weight <= 1.0 + 1e-6).all()
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=2e-6)
    second = lambda d: np.concatenate([d, d[:, :1] * d, d[:, 1:2] * d], 1)  # noqa: E731
    wanted, energy = reflected_quadrature(view, roughness, second)
    assert abs(weight.mean() - energy) < 3e-3
    np.testing.assert_allclose((weight[:, None] * second(direction)).mean(axis=0), wanted, atol=4e-3)


def test_solid_angles_of_samples_tell_their_density():
    """The number of samples in a cone times the mean of their solid angles over the count is the cone."""
    direction, weight, solid_angle = samples(0.5, at_angle(20.0), 65536)
    axis = np.array([-np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))])
    inside = (direction @ axis > np.cos(0.15)) & (weight > 0)
    cone = 2.0 * np.pi * (1.0 - np.cos(0.15))
    assert abs(solid_angle[inside].sum() / 65536 / cone - 1.0) < 0.02


def sky(d):
    """A smooth known radiance of unit directions, float64 [n, 3]."""
    x, y, z = d.T
    return np.stack([1.0 + 0.8 * x, 0.5 + 0.4 * np.sin(3.0 * y), 0.6 + 0.5 * z * x], -1)


def dome():
    height, width = 256, 512
    lat = (0.5 - (np.arange(height) + 0.5) / height) * np.pi
    lon = (1.0 - 2.0 * (np.arange(width) + 0.5) / width) * np.pi
    lat, lon = np.meshgrid(lat, lon, indexing="ij")
    d = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1).reshape(-1, 3)
    return LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4), sky(d).reshape(height, width, 3).astype(np.float32))


def wall(material, lights, others=(), half=4.0):
    """A square mirror in the plane z = -2 that faces the camera at z = 4."""
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    turn[2, 3] = -2.0
    meshes = [square(2, half), *(mesh for mesh, _, _ in others)]
    instances = [InstanceData(0, turn, "/mirror", (0,))]
    instances += [InstanceData(k, at, f"/other{k}", (k,)) for k, (_, at, _) in enumerate(others, 1)]
    materials = [material, *(m for _, _, m in others)]
    camera = CameraData("/camera", placed(0.4, 0.3, 4.0), near=0.05, focal_length=22.0)
    return Scene(SceneData("wall", meshes, instances, materials, list(lights), [camera]))


def rendered(scene, size=SIZE, **settings):
    settings = {"reflector_max_roughness": 1.0, "reflector_min_weight": 0.0} | settings
    return wr.render_frame(scene, wr.make_plan(scene, size=size, settings=wr.Settings(**settings)))


@pytest.mark.parametrize(
    ("glossy", "roughness", "atol"),
    [
        ("accumulate", 0.15, 0.004),
        ("accumulate", 0.4, 0.012),
        ("gather", 0.15, 0.012),
        ("gather", 0.4, 0.02),
        ("filter", 0.15, 0.012),
        ("filter", 0.3, 0.03),
    ],
)
def test_plane_shows_the_lobe_over_a_known_sky(glossy, roughness, atol):
    """The mirror's own term is Fresnel's at every microfacet times the sky, masked; by quadrature at a grid of pixels."""
    f0 = 0.3
    material = MaterialData(
        roughness=roughness, specular_workflow=True, specular_color=(f0, f0, f0), base_color=(0, 0, 0)
    )
    scene = wall(material, [dome()], half=12.0)
    frame = rendered(scene, glossy=glossy)
    assert [row.effects["roughness"].on for row in frame.plan.rows] == [True]
    schlick = lambda c: f0 + (1.0 - f0) * (1.0 - c) ** 5  # noqa: E731
    points = frame.relative("mirrorPoint").astype(np.float64)
    for y in range(8, 48, 13):
        for x in range(8, 90, 20):
            view = -points[y, x] / np.linalg.norm(points[y, x])
            wanted, _ = reflected_quadrature(
                view, roughness, sky, schlick, 80, 64
            )  # the wall faces +z as the oracle does
            np.testing.assert_allclose(frame["reflection"][y, x], wanted, atol=atol)


FURNACE = {
    "silver": MaterialData(base_color=(1, 1, 1), metallic=1.0),
    "gold": MaterialData(base_color=(1.0, 0.8, 0.3), metallic=1.0),
    "china": MaterialData(base_color=(1, 1, 1), ior=1.5),
    "diamond": MaterialData(base_color=(1, 1, 1), ior=2.4),
    "coated": MaterialData(base_color=(1, 1, 1), metallic=0.5, clearcoat=1.0, clearcoat_roughness=0.02, ior=1.8),
}


@pytest.mark.parametrize("glossy", ["gather", "filter", "accumulate"])
@pytest.mark.parametrize("roughness", [0.0, 0.05, 0.3, 0.6, 1.0])
def test_nothing_gives_more_light_than_it_gets(glossy, roughness):
    """A white furnace: radiance 1 from everywhere; all materials on balls in a row."""
    materials = [dataclasses.replace(m, roughness=roughness) for m in FURNACE.values()]
    ball = sphere(12, 24)
    scene = Scene(
        SceneData(
            "furnace",
            [ball],
            [InstanceData(0, placed(2.2 * k - 4.4, 0, 0), f"/{k}", (k,)) for k in range(len(materials))],
            materials,
            [LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4))],
            [CameraData("/camera", placed(0, 0, 12), focal_length=22.0)],
        )
    )
    frame = rendered(scene, glossy=glossy, glossy_samples=8)
    assert len(frame.plan.rows) == len(materials)
    # Balls see each other: a mirror in a mirror is one level deep and gives no more either.
    assert frame["RGBA"][..., :3].max() <= 1.0 + 1e-3
    if roughness <= 0.3:
        first = frame["reflectorId"] == 1
        assert first.sum() > 20 and frame["RGBA"][first][:, :3].mean() > 0.93


def test_smooth_mirrors_are_shown_as_they_were_bit_for_bit():
    smooth, off = (
        rendered(wall(m, [dome()]), **s)
        for m, s in (
            (MaterialData(metallic=1.0, roughness=0.01), {}),
            (MaterialData(metallic=1.0, roughness=0.2), {"glossy": "off"}),
        )
    )
    assert not smooth.plan.rows[0].effects["roughness"].on and "0.01" in smooth.plan.rows[0].effects["roughness"].reason
    assert off.plan.rows[0].effects["roughness"].reason == "glossy=off"
    np.testing.assert_array_equal(smooth["RGBA"], off["RGBA"])


def edge_width(image):
    """Pixels from 16 % to 84 % of a vertical edge's rise, over the middle rows of one channel."""
    profile = image[image.shape[0] // 2 - 3 : image.shape[0] // 2 + 3].mean(axis=0)
    rise = np.abs(profile - profile[0]) / np.abs(profile[-1] - profile[0])
    return np.interp(0.84, rise, np.arange(len(rise))) - np.interp(0.16, rise, np.arange(len(rise)))


@pytest.mark.parametrize("glossy", ["gather", "filter", "accumulate"])
def test_blur_grows_with_the_path_length(glossy):
    """A glowing half plane beside the axis, near the mirror and far: the edge is f beta d_o / (d_e + d_o) pixels wide."""
    widths = []
    for distance in (0.5, 2.0):
        turn = np.eye(4)
        turn[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        # Its edge is at x = 0.4, before the camera; its back would hide nothing of the mirror from rays that miss it.
        turn[:3, 3] = 0.4 + 3.0, 0.0, -2.0 + distance
        glow = MaterialData(base_color=(0, 0, 0), emissive=(1, 1, 1), ior=1.0, roughness=1.0)
        scene = wall(
            MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.2), [], [(square(2, 3.0), turn, glow)]
        )
        scene.data.cameras[0] = dataclasses.replace(scene.data.cameras[0], world_from_camera=placed(-1.6, 0.0, 4.0))
        frame = rendered(scene, (480, 160), glossy=glossy, glossy_samples=64)
        # Mirrored, the edge is at x = 0.4, distance behind z = -2; the plane itself hides the right of the mirror.
        camera = frame.camera
        column = camera.fx * (0.4 + 1.6) / (6.0 + distance) + camera.cx
        half = 12 if distance < 1.0 else 39  # as many blurs: a lobe's tails are long
        part = frame["reflection"][:, round(column) - half : round(column) + half, 0]
        assert (frame["reflectorId"][77:83, round(column) - half : round(column) + half] == 1).all()
        widths.append(edge_width(part))
    wanted = (2.0 / 8.0) / (0.5 / 6.5)
    # Filtered, the near edge is 4.9 pixels wide instead of 3.0: its blur is not much wider than the texels looked up, and
    # the glowing plane's back hides from the eye, and so from the picture looked up in, what lies past it.
    allowed = 0.35 if glossy == "filter" else 0.15
    assert abs(widths[1] / widths[0] / wanted - 1.0) < allowed, widths


@pytest.mark.parametrize("make", [lambda: room(sphere(), placed(0, 0, -1)), plane_room])
@pytest.mark.parametrize(("roughness", "mean_abs"), [(0.1, 0.008), (0.3, 0.015)])
def test_filter_is_near_the_rays(make, roughness, mean_abs, assert_images_close):
    scene = make()
    materials = [dataclasses.replace(scene.data.materials[0], roughness=roughness), *scene.data.materials[1:]]
    scene = Scene(dataclasses.replace(scene.data, materials=materials))
    # A quarter of the rays it takes by itself: their noise is a tenth of the bound, and all of it counts against the filter.
    frames = [rendered(scene, glossy="filter"), rendered(scene, glossy="accumulate", glossy_samples=64)]
    seen = frames[0]["reflectorId"] > 0
    assert seen.sum() > 500
    pictures = [frame["RGBA"][seen][:, :3] for frame in frames]
    assert_images_close(*pictures, mean_abs)


@pytest.mark.parametrize("glossy", ["gather", "filter", "accumulate"])
def test_threads_do_not_change_a_pixel(glossy):
    scene = wall(MaterialData(metallic=1.0, roughness=0.2), [dome()])
    one, two = (rendered(scene, threads=threads, glossy=glossy, glossy_samples=8) for threads in (1, 2))
    np.testing.assert_array_equal(one["RGBA"], two["RGBA"])


def test_plan_says_what_is_too_rough_for_a_mirror():
    scene = wall(MaterialData("/m", metallic=1.0, base_color=(0.9, 0.9, 0.9), roughness=0.45), [])
    plan = wr.make_plan(scene, size=SIZE)
    assert not plan.rows
    assert [(n.path, n.text) for n in plan.notes] == [
        ("/m", "roughness 0.45 > 0.3 (reflector_max_roughness): no mirror; what it reflects is scattered")
    ]
    assert wr.make_plan(scene, size=SIZE, settings=wr.Settings(reflector_max_roughness=0.5)).rows


def test_shared_rays_are_few_near_the_reference_and_leave_no_grain():
    """A rough ball in a room: nearer to many rays than as few that are not shared, at every setting finite."""
    scene = room(sphere(), placed(0, 0, -1))
    materials = [dataclasses.replace(scene.data.materials[0], roughness=0.5), *scene.data.materials[1:]]
    scene = Scene(dataclasses.replace(scene.data, materials=materials))
    truth = rendered(scene, (128, 72), glossy="accumulate", glossy_samples=128)
    rays = rendered(scene, (128, 72), glossy="accumulate", glossy_samples=4)
    smooth, shared, alone = (
        rendered(scene, (128, 72), glossy="gather", glossy_samples=4, **settings)
        for settings in ({}, {"glossy_smooth": 0.0}, {"glossy_smooth": 0.0, "glossy_neighbours": 0})
    )
    seen = truth["reflectorId"] > 0
    error = [np.abs(f["RGBA"] - truth["RGBA"])[seen].mean() for f in (smooth, shared, alone)]
    assert error[0] < 0.5 * error[1] and error[1] < 0.9 * error[2], error
    # Without neighbours it is the mean over the pixel's own rays.
    np.testing.assert_array_equal(alone["RGBA"], rays["RGBA"])


@pytest.mark.parametrize(
    ("name", "value"), [("glossy_neighbours", -1), ("glossy_smooth", 1.5), ("glossy_smooth", -0.1)]
)
def test_impossible_settings_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        wr.Settings(**{name: value})
