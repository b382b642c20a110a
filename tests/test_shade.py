"""Deferred shading against closed forms and float64 NumPy."""

import numpy as np
import pytest
import trimesh
import warp as wp

from warp_reflect import raster, shade, shadows, surface
from warp_reflect.layers import Camera, ReflectionLayer
from warp_reflect.scene import (
    InstanceData,
    LightData,
    MaterialData,
    MeshData,
    Scene,
    SceneData,
)
from warp_reflect.settings import Settings, Status, Technique
from warp_reflect.techniques import raytraced

DEVICE = "cpu"
BALL = trimesh.creation.icosphere(3)
SIZE = (64, 48)


def ball_mesh(**attributes) -> MeshData:
    return MeshData(
        points=np.float32(BALL.vertices),
        triangles=np.int32(BALL.faces),
        normals=np.float32(BALL.vertices),
        **attributes,
    )


def place(x=0.0, y=0.0, z=0.0, scale=1.0) -> np.ndarray:
    m = np.diag([scale, scale, scale, 1.0])
    m[:3, 3] = (x, y, z)
    return m


def dome(color=(1.0, 1.0, 1.0), texture=None, world_from_light=None) -> LightData:
    return LightData("/dome", "dome", color, np.eye(4) if world_from_light is None else world_from_light, texture)


def distant(color, to_light) -> LightData:
    z = np.asarray(to_light, float) / np.linalg.norm(to_light)
    x = np.cross([0.3, 1.0, 0.2], z)
    x /= np.linalg.norm(x)
    m = np.eye(4)
    m[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1) * 2.5  # a scale must not matter
    return LightData("/sun", "distant", color, m)


def scene_of(placed, lights, up_axis="Y") -> Scene:
    """A scene of (mesh, world_from_object, material) triples."""
    return Scene(
        SceneData(
            "test",
            [mesh for mesh, _, _ in placed],
            [InstanceData(i, m, f"/p{i}", (i,)) for i, (_, m, _) in enumerate(placed)],
            [material for _, _, material in placed],
            lights,
            [],
            up_axis=up_axis,
        ),
        DEVICE,
    )


def look_at(eye, target, fov=50.0, size=SIZE) -> Camera:
    eye = np.asarray(eye, float)
    forward = np.asarray(target, float) - eye
    distance = np.linalg.norm(forward)
    forward /= distance
    right = np.cross(forward, [0.0, 1.0, 0.1])
    right /= np.linalg.norm(right)
    focal = size[0] / (2 * np.tan(np.radians(fov) / 2))
    return Camera(
        eye=eye,
        right=right,
        up=np.cross(right, forward),
        forward=forward,
        fx=focal,
        fy=focal,
        cx=size[0] / 2,
        cy=size[1] / 2,
        near=1e-2,
        far=1e4,
        size=size,
    )


def eye_rays(camera) -> np.ndarray:
    """Unit directions, [height * width, 3]."""
    y, x = np.mgrid[0 : camera.size[1], 0 : camera.size[0]].reshape(2, -1) + 0.5
    d = (
        camera.forward
        + ((x - camera.cx) / camera.fx)[:, None] * camera.right
        - ((y - camera.cy) / camera.fy)[:, None] * camera.up
    )
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def picture_of(scene, camera, mirrors=(), threads=0):
    """(RGBA [n, 4], mirror term [n, 3], triangle [n], normal [n, 3]) with traced mirrors, named by part."""
    gbuffer = raster.draw_scene(scene, camera)
    parts = {part + 1: part for part in mirrors}
    pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, parts)
    layers = {
        k: raytraced.reflect(scene, raytraced.Prepared(parts[k], True), gbuffer, pixels[k], camera, Settings())
        for k in parts
    }
    picture, mirror = shade.shade(scene, gbuffer, layers, threads)
    normal = surface.surface_channels(scene, gbuffer)["N"].numpy().astype(float)
    return picture.numpy(), mirror.numpy(), gbuffer.triangle.numpy(), normal


def latlong(function, width=256, height=128) -> np.ndarray:
    """A map of `function(direction)` in OpenEXR orientation: +Y on top; from the left -Z, +X, +Z, -X."""
    lat = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    lon = np.pi - (np.arange(width) + 0.5) / width * 2 * np.pi
    lat, lon = np.meshgrid(lat, lon, indexing="ij")
    d = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], axis=-1)
    return function(d).astype(np.float32)


def turn(axis, angle) -> np.ndarray:
    m = np.eye(4)
    m[:3, :3] = trimesh.transformations.rotation_matrix(angle, axis)[:3, :3]
    return m


def fresnel(f0, f90, cosine):
    return f0 + (f90 - f0) * (1.0 - cosine)[:, None] ** 5


@pytest.mark.parametrize("metallic", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.2, 0.5])
@pytest.mark.parametrize("clearcoat", [0.0, 0.6])
def test_a_white_surface_in_a_white_dome_vanishes(metallic, roughness, clearcoat):
    """The furnace: nothing is lost and nothing gained, whatever the split between the lobes."""
    material = MaterialData(base_color=(1, 1, 1), metallic=metallic, roughness=roughness, clearcoat=clearcoat)
    scene = scene_of([(ball_mesh(), place(), material)], [dome((0.7, 0.8, 0.9))])
    rgba, mirror, triangle, _ = picture_of(scene, look_at((0, 1, 3), (0, 0, 0)))
    assert 0.1 < (triangle >= 0).mean() < 0.9
    np.testing.assert_allclose(rgba[:, :3], np.tile(np.float32([0.7, 0.8, 0.9]), (len(rgba), 1)), rtol=2e-6)
    np.testing.assert_array_equal(rgba[:, 3], triangle >= 0)
    assert not mirror.any()


def test_no_material_gives_more_than_it_gets():
    rng = np.random.default_rng(4)
    camera = look_at((0, 1, 3), (0, 0, 0), size=(24, 18))
    for _ in range(40):
        material = MaterialData(
            base_color=tuple(rng.random(3)),
            metallic=rng.random(),
            roughness=rng.random(),
            ior=rng.uniform(1, 3),
            clearcoat=rng.random(),
            specular_workflow=bool(rng.random() < 0.3),
            specular_color=tuple(rng.random(3)),
        )
        scene = scene_of([(ball_mesh(), place(), material)], [dome()])
        rgba = picture_of(scene, camera)[0]
        assert rgba.min() >= 0.0 and rgba[:, :3].max() <= 1.0 + 1e-6


def test_distant_light_follows_the_cosine():
    material = MaterialData(base_color=(0.8, 0.5, 0.25), roughness=1.0, ior=1.0, emissive=(0.01, 0.02, 0.03))
    to_light = np.array([1.0, 2.0, 0.5]) / np.linalg.norm([1.0, 2.0, 0.5])
    scene = scene_of([(ball_mesh(), place(5, 0, 0), material)], [distant((3.0, 2.0, 1.0), to_light)])
    rgba, _, triangle, normal = picture_of(scene, look_at((5.5, 1, 3), (5, 0, 0)))
    seen = triangle >= 0
    cosine = np.maximum(normal[seen] @ to_light, 0.0)
    want = np.array([0.01, 0.02, 0.03]) + cosine[:, None] * np.array([3.0, 2.0, 1.0]) * [0.8, 0.5, 0.25] / np.pi
    assert (cosine > 0.1).sum() > 100 and (cosine == 0).sum() > 20
    np.testing.assert_allclose(rgba[seen, :3], want, atol=2e-6)
    assert not rgba[~seen].any()  # no dome: black, without coverage


def test_background_is_the_turned_dome():
    def radiance(d):
        return np.stack([1.0 + d[..., 0], 1.0 + 0.5 * d[..., 1] * d[..., 2], 1.0 - d[..., 2] ** 3], axis=-1)

    world_from_light = turn([1, 2, 3], 1.1)
    light = dome((2.0, 1.0, 0.5), latlong(radiance), world_from_light)
    scene = scene_of([], [light])
    for target in ([1, 0, 0], [0, 1, 0.01], [0, 0, -1], [-1, -1, 1]):
        camera = look_at((0, 0, 0), target, fov=90)
        rgba, _, _, _ = picture_of(scene, camera)
        want = radiance(eye_rays(camera) @ world_from_light[:3, :3]) * [2.0, 1.0, 0.5]
        # Bilinear, texels 1.4 degrees apart: h^2 / 8 of the curvature, and half a texel flat at the poles.
        np.testing.assert_allclose(rgba[:, :3], want, atol=2e-2)
        assert np.median(np.abs(rgba[:, :3] - want)) < 2e-4
        assert not rgba[:, 3].any()


def test_latlong_corners_follow_openexr():
    """Top row +Y; the middle of the map +Z; a quarter from the left +X; the left edge -Z."""
    texture = np.zeros((8, 16, 3), np.float32)
    texture[:2, :, 0] = 1.0
    texture[3:5, 7:9, 1] = 1.0
    texture[3:5, 3:5, 2] = 1.0
    texture[3:5, [0, 15], :] = 5.0
    scene = scene_of([], [dome(texture=texture)])
    for target, want in (
        ([0, 1, 1e-3], [1, 0, 0]),
        ([0, 0, 1], [0, 1, 0]),
        ([1, 0, 0], [0, 0, 1]),
        ([0, 0, -1], [5, 5, 5]),
        ([0, -1, 1e-3], [0, 0, 0]),
    ):
        rgba = picture_of(scene, look_at((0, 0, 0), target, fov=1.0, size=(3, 3)))[0]
        np.testing.assert_allclose(rgba[4, :3], want, atol=0.05)


def test_irradiance_of_a_textured_dome_is_its_integral():
    def radiance(d):  # second order: nine coefficients hold it exactly
        x, y, z = d[..., 0], d[..., 1], d[..., 2]
        return np.stack([1 + x * y - 0.4 * z, 1.2 + y * y - 0.8 * x * z, 1.2 + 0.5 * x + y * z - z * z], axis=-1)

    rng = np.random.default_rng(0)
    world_from_light = turn([3, -1, 2], 0.8)
    material = MaterialData(base_color=(1, 1, 1), roughness=1.0, ior=1.0)
    lights = [dome((1.0, 1.0, 2.0), latlong(radiance, 512, 256), world_from_light), dome((0.1, 0.2, 0.3))]
    scene = scene_of([(ball_mesh(), place(), material)], lights)
    rgba, _, triangle, normal = picture_of(scene, look_at((2, 1, 2), (0, 0, 0)))
    some = rng.choice(np.flatnonzero(triangle >= 0), 40, replace=False)
    d = rng.normal(size=(400_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    arriving = radiance(d @ world_from_light[:3, :3]) * [1.0, 1.0, 2.0] + [0.1, 0.2, 0.3]
    for pixel in some:
        cosine = np.maximum(d @ normal[pixel], 0.0)
        want = 4.0 * np.mean(cosine[:, None] * arriving, axis=0)  # irradiance / pi by uniform sampling
        # Monte Carlo: about 1 / sqrt(400,000) of values up to 4.
        np.testing.assert_allclose(rgba[pixel, :3], want, atol=2e-2)


def test_a_stage_without_light_has_a_grey_dome_brighter_above():
    material = MaterialData(base_color=(0.5, 0.5, 0.5), ior=1.0, roughness=1.0)
    for up_axis, up in (("Y", [0, 1, 0]), ("Z", [0, 0, 1])):
        scene = scene_of([(ball_mesh(), place(), material)], [], up_axis)
        camera = look_at((3, 1, 2), (0, 0, 0))
        rgba, _, triangle, normal = picture_of(scene, camera)
        seen = triangle >= 0
        np.testing.assert_allclose(rgba[~seen, 0], 0.5 + 0.3 * (eye_rays(camera)[~seen] @ up), atol=1e-6)
        # The integral of (0.5 + 0.3 d.up) max(d.n, 0) / pi.
        np.testing.assert_allclose(rgba[seen, 0], 0.5 * (0.5 + 0.2 * (normal[seen] @ up)), atol=1e-6)
        assert np.ptp(rgba[:, :3], axis=1).max() == 0.0


MIRRORS = {
    "metal": MaterialData(base_color=(0.9, 0.6, 0.3), metallic=1.0, roughness=0.0),
    "glass": MaterialData(base_color=(0.1, 0.3, 0.2), ior=1.5, roughness=0.0),
    "half": MaterialData(base_color=(0.4, 0.5, 0.6), metallic=0.5, roughness=0.05),
    "specular": MaterialData(base_color=(0.2, 0.2, 0.2), specular_workflow=True, specular_color=(0.3, 0.5, 0.7)),
    "coat": MaterialData(base_color=(0.9, 0.1, 0.1), roughness=0.0, clearcoat=1.0, ior=1.6),
}


@pytest.mark.parametrize("name", MIRRORS)
def test_mirror_term_is_fresnel_times_what_is_seen(name):
    """A ball in a room that glows in one colour: every reflected ray ends on the same radiance."""
    m = MIRRORS[name]
    room = trimesh.creation.box((20, 20, 20))
    glow = np.array([0.3, 0.6, 0.9])
    black = MaterialData(base_color=(0, 0, 0), roughness=1.0, ior=1.0, emissive=tuple(glow))
    room_mesh = MeshData(points=np.float32(room.vertices), triangles=np.int32(room.faces))
    light = distant((2.0, 2.0, 2.0), (0, 1, 0))
    scene = scene_of([(ball_mesh(), place(), m), (room_mesh, place(), black)], [light])
    camera = look_at((0, 0.5, 3), (0, 0, 0))
    rgba, mirror, triangle, normal = picture_of(scene, camera, mirrors=[0])
    on_ball = (triangle >= 0) & (triangle < len(BALL.faces))
    cosine = -np.einsum("ij,ij->i", normal[on_ball], eye_rays(camera)[on_ball])
    base = np.array(m.base_color)
    dielectric = ((m.ior - 1) / (m.ior + 1)) ** 2
    # A mixture of a dielectric over Lambert and a metal that reflects its colour at every angle.
    metallic = 0.0 if m.specular_workflow else m.metallic
    skin_f0 = np.array(m.specular_color) if m.specular_workflow else np.full(3, dielectric)
    skin = fresnel(skin_f0, np.ones(3), cosine)
    f = (1 - metallic) * skin + metallic * base
    diffuse = (1 - metallic) * (1 - skin) * base
    coat = m.clearcoat * fresnel(np.full(3, dielectric), np.ones(3), cosine)
    weight = coat + (1 - coat) * f
    np.testing.assert_allclose(mirror[on_ball], weight * glow, atol=1e-5)
    below = (1 - coat) * diffuse * 2.0 / np.pi * np.maximum(normal[on_ball, 1:2], 0.0)
    np.testing.assert_allclose(rgba[on_ball, :3], weight * glow + below, atol=1e-5)
    assert not mirror[~on_ball].any()
    np.testing.assert_allclose(rgba[~on_ball, :3], np.tile(glow, ((~on_ball).sum(), 1)), atol=1e-6)


def test_a_mirror_seen_in_a_mirror_shows_base_and_dome():
    sky = np.array([0.2, 0.4, 0.8])
    coated = MaterialData(base_color=(0.5, 0.3, 0.1), metallic=1.0, roughness=0.0)
    silver = MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    scene = scene_of([(ball_mesh(), place(), silver), (ball_mesh(), place(0, 0, 6, 3.5), coated)], [dome(tuple(sky))])
    camera = look_at((0, 2.5, 1.2), (0, 0, 0), fov=60)
    gbuffer = raster.draw_scene(scene, camera)
    pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {1: 0})
    layer = raytraced.reflect(scene, raytraced.Prepared(0, True), gbuffer, pixels[1], camera, Settings())
    mirror = shade.shade(scene, gbuffer, {1: layer})[1].numpy()[pixels[1].pixel.numpy()]
    hit = layer.status.numpy() == Status.CONVERGED
    assert hit.sum() > 100 and (~hit).sum() > 100
    np.testing.assert_allclose(mirror[~hit], np.tile(sky, ((~hit).sum(), 1)), atol=1e-6)
    # The angle at the second mirror, from the ball's own geometry.
    p = layer.pixels.point.numpy() + layer.distance.numpy()[:, None].astype(float) * layer.pixels.direction.numpy()
    n = p[hit] + scene.origin - [0, 0, 6]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    cosine = np.abs(np.einsum("ij,ij->i", n, layer.pixels.direction.numpy()[hit]))
    clear = cosine > 0.3  # interpolated normals stay within 1e-3 of the ball's
    base = np.array(coated.base_color)
    np.testing.assert_allclose(mirror[hit][clear], (fresnel(base, base, cosine) * sky)[clear], atol=2e-3)
    assert clear.sum() > 50


def test_vertex_colors_are_interpolated_in_both_views():
    """A coloured quad seen directly, and the same in a flat mirror beside it."""
    quad = MeshData(
        points=np.float32([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]]),
        triangles=np.int32([[0, 1, 2], [0, 2, 3]]),
        colors=np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0]]),
    )
    floor = MeshData(
        points=np.float32([[-9, 0, 0], [9, 0, 0], [9, 0, 9], [-9, 0, 9]]),
        triangles=np.int32([[0, 2, 1], [0, 3, 2]]),
    )
    paint = MaterialData(uses_vertex_color=True, roughness=1.0, ior=1.0)
    silver = MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    scene = scene_of([(quad, place(), paint), (floor, place(), silver)], [dome((1, 1, 1))])
    camera = look_at((0.0, 1.5, 6), (0, 0.5, 0), fov=40)
    rgba, _, triangle, _ = picture_of(scene, camera, mirrors=[1])
    d = eye_rays(camera)

    def color_at(x, y):
        """On the plane z = 0: the upper-left triangle is (0, 2, 3), the lower right (0, 1, 2)."""
        c = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0]])
        right = (x + 1) > y
        s, t = (x + 1) / 2, y / 2
        low = (1 - s)[:, None] * c[0] + (s - t)[:, None] * c[1] + t[:, None] * c[2]
        high = (1 - t)[:, None] * c[0] + s[:, None] * c[2] + (t - s)[:, None] * c[3]
        return np.where(right[:, None], low, high)

    direct = (triangle >= 0) & (triangle < 2)
    t = -camera.eye[2] / d[direct, 2]
    p = camera.eye + t[:, None] * d[direct]
    inside = (np.abs(p[:, 0]) < 0.99) & (np.abs(p[:, 1] - 1) < 0.99)
    assert inside.sum() > 200
    np.testing.assert_allclose(rgba[direct, :3][inside], color_at(p[:, 0], p[:, 1])[inside], atol=1e-5)

    on_floor = triangle >= 2
    mirrored = d[on_floor] * [1, -1, 1]
    t = -camera.eye[2] / mirrored[:, 2]
    p = camera.eye * [1, -1, 1] + t[:, None] * mirrored
    inside = (np.abs(p[:, 0]) < 0.99) & (np.abs(p[:, 1] - 1) < 0.99)
    assert inside.sum() > 100
    np.testing.assert_allclose(rgba[on_floor, :3][inside], color_at(p[:, 0], p[:, 1])[inside], atol=1e-5)


def test_unsettled_pixels_show_the_dome_and_stay_finite():
    scene = scene_of([(ball_mesh(), place(), MIRRORS["metal"])], [dome((0.2, 0.3, 0.4))])
    camera = look_at((0, 1, 3), (0, 0, 0))
    gbuffer = raster.draw_scene(scene, camera)
    pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {1: 0})
    layer = ReflectionLayer.empty(pixels[1], Technique.QUADRIC, DEVICE)
    picture, mirror = (x.numpy() for x in shade.shade(scene, gbuffer, {1: layer}))
    assert np.isfinite(picture).all() and np.isfinite(mirror).all()
    assert mirror[pixels[1].pixel.numpy()].min() > 0.2 * 0.3 - 1e-6


def test_shade_is_equal_for_any_number_of_threads():
    lights = [dome(texture=latlong(lambda d: 1.0 + d)), distant((1, 1, 1), (1, 1, 1))]
    placed = [(ball_mesh(), place(), MIRRORS["half"]), (ball_mesh(), place(1.5, 1, -2), MIRRORS["coat"])]
    scene = scene_of(placed, lights)
    camera = look_at((0, 1, 3), (0, 0, 0), size=(160, 120))
    one = picture_of(scene, camera, mirrors=[0], threads=1)
    for threads in (2, 3):
        other = picture_of(scene, camera, mirrors=[0], threads=threads)
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1], other[1])


def test_prepared_lights_ignore_kinds_they_do_not_know():
    strange = LightData("/lamp", "portal", (9.0, 9.0, 9.0), np.eye(4))
    scene = scene_of([], [strange, dome((0.25, 0.5, 0.75))])
    rgba = picture_of(scene, look_at((0, 0, 0), (0, 0, 1), size=(4, 4)))[0]
    np.testing.assert_allclose(rgba[:, :3], np.tile(np.float32([0.25, 0.5, 0.75]), (16, 1)))
    assert isinstance(scene.lights.texels, wp.array)


WHITE = MaterialData(base_color=(1, 1, 1), roughness=1.0, ior=1.0)  # shows its irradiance / pi


def ground(half=9.0) -> MeshData:
    """In the plane y = 0, facing up."""
    return MeshData(
        points=np.float32([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]]),
        triangles=np.int32([[0, 2, 1], [0, 3, 2]]),
    )


def emitting_elements(kind, size, world, count=160):
    """(points [n, 3], normals [n, 3], areas [n]) of a shape light's surface."""
    a, b = (grid.reshape(-1) for grid in np.meshgrid(*[(np.arange(count) + 0.5) / count] * 2, indexing="ij"))
    zero = np.zeros_like(a)
    if kind == "rect":
        p = np.stack([(a - 0.5) * size[0], (b - 0.5) * size[1], zero], axis=1)
        n, area = np.tile([0.0, 0, -1], (len(a), 1)), np.full(len(a), size[0] * size[1])
    elif kind == "disk":
        r, t = size[0] * np.sqrt(a), 2 * np.pi * b
        p = np.stack([r * np.cos(t), r * np.sin(t), zero], axis=1)
        n, area = np.tile([0.0, 0, -1], (len(a), 1)), np.full(len(a), np.pi * size[0] ** 2)
    elif kind == "sphere":
        z, t = 2 * a - 1, 2 * np.pi * b
        n = np.stack([np.sqrt(1 - z * z) * np.cos(t), np.sqrt(1 - z * z) * np.sin(t), z], axis=1)
        p, area = size[0] * n, np.full(len(a), 4 * np.pi * size[0] ** 2)
    else:
        t = 2 * np.pi * b
        n = np.stack([zero, np.cos(t), np.sin(t)], axis=1)
        p = size[1] * n + np.stack([(a - 0.5) * size[0], zero, zero], axis=1)
        area = np.full(len(a), 2 * np.pi * size[0] * size[1])
    return p @ world[:3, :3].T + world[:3, 3], n @ world[:3, :3].T, area / len(a)


def irradiance_by_sum(light, p) -> np.ndarray:
    """On upward faces at p [n, 3], by summing over the light's surface."""
    points, normals, areas = emitting_elements(light.kind, light.size, light.world_from_light)
    result = []
    for x in p:
        d = points - x
        r = np.linalg.norm(d, axis=1)
        facing = np.maximum(-np.einsum("ij,ij->i", normals, d) / r, 0.0)
        result.append(np.sum(np.maximum(d[:, 1] / r, 0.0) * facing / r**2 * areas))
    return np.array(result)


def turned(x_angle, y_angle, position) -> np.ndarray:
    cx, sx, cy, sy = np.cos(x_angle), np.sin(x_angle), np.cos(y_angle), np.sin(y_angle)
    m = np.eye(4)
    m[:3, :3] = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    m[:3, 3] = position
    return m


@pytest.mark.parametrize(
    ("kind", "size", "world", "error"),
    [
        ("rect", (1.5, 0.8), turned(-1.3, 0.4, (0.3, 2.0, 0.2)), 2e-3),
        ("rect", (3.0, 2.0), turned(-0.4, 0.9, (0.0, 0.6, -1.0)), 5e-3),  # half below the ground
        ("disk", (0.7,), turned(-1.2, 0.4, (0.3, 1.5, 0.2)), 5e-3),
        ("sphere", (0.5,), turned(0.0, 0.0, (0.2, 1.5, 0.3)), 2e-3),
        ("sphere", (0.8,), turned(0.0, 0.0, (1.2, 0.2, -1.5)), 1e-2),  # partly below the ground
        # Its nearer edge is in front of the rectangle that stands for it: off by radius / distance.
        ("cylinder", (2.0, 0.05), turned(0.0, 0.4, (0.3, 1.5, 0.2)), 0.05 / 1.5),
    ],
)
def test_shape_lights_give_their_irradiance(kind, size, world, error):
    light = LightData("/lamp", kind, (2.0, 1.0, 0.5), world, size=size)
    scene = scene_of([(ground(), place(0.1, 0, 0), WHITE)], [light])
    camera = look_at((0.0, 9.0, 0.1), (0, 0, 0), fov=50.0, size=(16, 12))
    rgba, _, triangle, _ = picture_of(scene, camera)
    d = eye_rays(camera)
    p = camera.eye - (camera.eye[1] / d[:, 1])[:, None] * d
    elements = emitting_elements(kind, size, world)[0]
    # Where the light cuts the ground the sum is singular, and a sphere would be looked at from inside.
    clear = np.linalg.norm(p[:, None] - elements[::7], axis=2).min(axis=1) > 0.3
    if kind == "sphere":
        clear &= np.linalg.norm(p - world[:3, 3], axis=1) > 1.2 * size[0]
    expected = irradiance_by_sum(light, p[clear])[:, None] * np.array(light.color) / np.pi
    assert (triangle >= 0).all() and clear.sum() > 120 and expected.max() > 0.02
    np.testing.assert_allclose(rgba[clear, :3], expected, atol=error * expected.max())


def test_sphere_light_above_a_facing_point_has_the_closed_form():
    """E = pi L (r / d)^2, also where the ground is seen in a mirror."""
    light = LightData("/lamp", "sphere", (3.0, 3.0, 3.0), place(0, 4, 0, 2.0), size=(0.5,))
    scene = scene_of([(ground(), place(), WHITE)], [light])
    camera = look_at((0.0, 3.0, 0.01), (0, 0, 0), fov=2.0, size=(3, 3))
    rgba, *_ = picture_of(scene, camera)
    assert rgba[4, 0] == pytest.approx(3.0 * (1.0 / 4.0) ** 2, rel=1e-3)


def test_a_shape_light_alone_brings_no_default_sky():
    light = LightData("/lamp", "rect", (1.0, 1.0, 1.0), turned(np.pi / 2, 0.0, (0, 2, 0)), size=(1.0, 1.0))
    scene = scene_of([(ground(), place(), WHITE)], [light])
    rgba, *_ = picture_of(scene, look_at((0, 5, 3), (0, 0, 0)))
    assert not rgba[:, :3].any()  # it shines upwards, away from the ground


def shadowed_ground(on):
    """Ground under a slanted sun with a square card one unit above it: (rgb, points [n, 3] of the ground or NaN)."""
    card = ground(0.5)
    sun = distant((np.pi, np.pi, np.pi), (1.0, 2.0, 0.0))
    scene = scene_of([(ground(), place(), WHITE), (card, place(0, 1, 0), WHITE)], [sun])
    camera = look_at((0.0, 6.0, 6.0), (0, 0, 0), fov=40.0)
    gbuffer = raster.draw_scene(scene, camera)
    _, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {})
    picture = shade.shade(scene, gbuffer, {}, shadows=shadows.every_shadow(scene) if on else None)[0].numpy()
    d = eye_rays(camera)
    p = camera.eye - (camera.eye[1] / d[:, 1])[:, None] * d
    return picture[:, 0], np.where((gbuffer.triangle.numpy() < 2)[:, None], p, np.nan)


def test_shadows_fall_where_the_sun_says():
    lit, p = shadowed_ground(False)
    seen, _ = shadowed_ground(True)
    cosine = 2.0 / np.sqrt(5.0)
    inside = (np.abs(p[:, 0] + 0.5) < 0.48) & (np.abs(p[:, 2]) < 0.48)  # the card moved by 1 / 2 against the sun
    outside = (np.abs(p[:, 0] + 0.5) > 0.52) | (np.abs(p[:, 2]) > 0.52)
    assert inside.sum() > 15 and outside.sum() > 1500
    np.testing.assert_allclose(lit[~np.isnan(p[:, 0])], cosine, rtol=1e-5)
    assert not seen[inside].any()
    np.testing.assert_allclose(seen[outside], cosine, rtol=1e-5)


def test_shadows_are_seen_in_mirrors():
    """A ground patch in a vertical mirror: with the card in the way it is black."""
    silver = MaterialData(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    wall = MeshData(
        points=np.float32([[-9, 0, -3], [9, 0, -3], [9, 9, -3], [-9, 9, -3]]),
        triangles=np.int32([[0, 1, 2], [0, 2, 3]]),
    )
    sun = distant((np.pi, np.pi, np.pi), (0.0, 1.0, 0.0))
    placed = [(ground(), place(), WHITE), (ground(1.0), place(0, 2, 0), WHITE), (wall, place(), silver)]
    scene = scene_of(placed, [sun])
    camera = look_at((0.0, 1.5, 1.0), (0, 0.9, -3), fov=50.0)
    gbuffer = raster.draw_scene(scene, camera)
    pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {1: 2})
    layer = raytraced.reflect(scene, raytraced.Prepared(2, False), gbuffer, pixels[1], camera, Settings())
    cast = shadows.every_shadow(scene)
    mirror = [shade.shade(scene, gbuffer, {1: layer}, shadows=on)[1].numpy()[:, 0] for on in (None, cast)]
    index = pixels[1].pixel.numpy()
    on_ground = layer.triangle.numpy() // 2 == 0
    p = layer.pixels.point.numpy() + layer.distance.numpy()[:, None] * layer.pixels.direction.numpy() + scene.origin
    under = on_ground & (np.abs(p[:, 0]) < 0.98) & (np.abs(p[:, 2]) < 0.98)
    free = on_ground & ((np.abs(p[:, 0]) > 1.02) | (np.abs(p[:, 2]) > 1.02))
    assert under.sum() > 10 and free.sum() > 100
    np.testing.assert_allclose(mirror[0][index[on_ground]], 1.0, atol=1e-4)
    assert not mirror[1][index[under]].any()
    np.testing.assert_allclose(mirror[1][index[free]], 1.0, atol=1e-4)


@pytest.mark.parametrize("roughness", [0.0, 0.175, 1.0])
def test_clear_coat_is_divided_by_its_own_roughness(roughness):
    """A black body with a full coat, a distant light only: what is not mirrored sharply is scattered like Lambert's."""
    material = MaterialData(
        base_color=(0, 0, 0),
        roughness=1.0,
        ior=1.5,
        clearcoat=1.0,
        clearcoat_roughness=roughness,
        specular_workflow=True,
    )
    to_light = np.array([0.0, 0.0, 1.0])
    scene = scene_of([(ball_mesh(), place(), material)], [distant((np.pi,) * 3, to_light)])
    camera = look_at((0, 0, 4), (0, 0, 0))
    rgba, _, triangle, normal = picture_of(scene, camera)
    seen = triangle >= 0
    toward = np.abs(np.einsum("ij,ij->i", eye_rays(camera), normal))[seen]
    coat = fresnel(0.04, 1.0, toward)
    sharp = np.clip((0.3 - roughness) / 0.25, 0.0, 1.0)
    wanted = (1.0 - sharp) * coat * np.maximum(normal[seen] @ to_light, 0.0)[:, None]
    # The body itself: F90 of its rough lobe is white at grazing angles only, and nothing of it is sharp.
    np.testing.assert_allclose(rgba[seen, :3], np.repeat(wanted, 3, axis=1), atol=2e-5)


def test_a_rough_coat_keeps_the_furnace():
    material = MaterialData(base_color=(1, 1, 1), roughness=0.2, clearcoat=0.8, clearcoat_roughness=0.2)
    scene = scene_of([(ball_mesh(), place(), material)], [dome((0.7, 0.8, 0.9))])
    rgba = picture_of(scene, look_at((0, 1, 3), (0, 0, 0)))[0]
    np.testing.assert_allclose(rgba[:, :3], np.tile(np.float32([0.7, 0.8, 0.9]), (len(rgba), 1)), rtol=2e-6)
