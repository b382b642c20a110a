"""Normal maps against surfaces whose corners have the same normals, which need no map."""

import dataclasses

import numpy as np
import pytest
from test_textures import MATT, looking_down, picture_of, quad, scene_of

from warp_reflect import normal_maps
from warp_reflect.images import write_exr
from warp_reflect.scene import LightData, MaterialData, TextureRef

TILTED = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
SILVER = MaterialData("/silver", base_color=(1, 1, 1), metallic=1.0, roughness=0.0)


def sun(to_light=(0.4, 0.2, 0.9)) -> LightData:
    z = np.array(to_light) / np.linalg.norm(to_light)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    world = np.eye(4)
    world[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return LightData("/sun", "distant", (np.pi, np.pi, np.pi), world)


def lamp() -> LightData:
    """A square above the quad, facing down."""
    world = np.eye(4)
    world[:3, 3] = (2.0, 1.0, 6.0)
    return LightData("/lamp", "rect", (5.0, 5.0, 5.0), world, size=(2.0, 2.0))


LIGHTS = {"sun": lambda: [sun()], "lamp": lambda: [lamp()]}


def shown(tmp_path, normal, name="n.exr", scale=2.0, bias=-1.0, **texture) -> MaterialData:
    """A matt material with a map that says one direction everywhere."""
    stored = (np.asarray(normal) - bias) / scale
    write_exr(tmp_path / name, {"RGB": np.tile(np.float32(stored), (4, 4, 1))}, half=())
    ref = TextureRef(
        str(tmp_path / name), color_space="signed", scale=(scale,) * 3 + (1.0,), bias=(bias,) * 3 + (0.0,), **texture
    )
    return dataclasses.replace(MATT, base_color=(0.9, 0.6, 0.3), textures={"normal": ref})


def plain(material) -> MaterialData:
    return dataclasses.replace(material, textures={})


def with_normal(mesh, normal):
    return dataclasses.replace(mesh, normals=np.float32([normal]), normal_index=np.zeros_like(mesh.triangles))


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize(("scale", "bias"), [(2.0, -1.0), (1.0, 0.0)])
def test_map_of_one_direction_lights_as_tilted_corners(device, tmp_path, light, scale, bias):
    """Coordinates run along x and y, so that tangent space is the world's; with scale 1 the map holds signed values."""
    material = shown(tmp_path, TILTED, scale=scale, bias=bias)
    camera = looking_down(4.0)
    lights = LIGHTS[light]()
    mapped, hit = picture_of(scene_of([(quad(), np.eye(4), material)], device, lights), camera)
    wanted, _ = picture_of(
        scene_of([(with_normal(quad(), TILTED), np.eye(4), plain(material))], device, lights), camera
    )
    flat, _ = picture_of(scene_of([(quad(), np.eye(4), plain(material))], device, lights), camera)
    assert (hit >= 0).sum() > 200
    np.testing.assert_allclose(mapped, wanted, atol=3e-6)
    assert np.abs(mapped - flat)[hit >= 0, 0].mean() > 1e-3


def test_negative_components_survive_the_file(device, tmp_path):
    turned = TILTED * [-1.0, -1.0, 1.0]
    material = shown(tmp_path, turned, scale=1.0, bias=0.0)
    camera = looking_down(4.0)
    mapped, _ = picture_of(scene_of([(quad(), np.eye(4), material)], device, [sun()]), camera)
    mesh = with_normal(quad(), turned)
    wanted, _ = picture_of(scene_of([(mesh, np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_allclose(mapped, wanted, atol=3e-6)


@pytest.mark.parametrize(
    ("rows", "normal"),
    [
        (((0.0, 1.0, 0.0), (-1.0, 0.0, 1.0)), (-TILTED[1], TILTED[0], TILTED[2])),  # u along +y, v along -x
        (((-1.0, 0.0, 1.0), (0.0, 1.0, 0.0)), (-TILTED[0], TILTED[1], TILTED[2])),  # a mirrored picture
        (((7.0, 0.0, 0.0), (0.0, 0.01, 0.0)), tuple(TILTED)),  # a stretch turns nothing
    ],
)
def test_tangents_follow_the_picture(device, tmp_path, rows, normal):
    material = shown(tmp_path, TILTED, uv_from_st=rows)
    camera = looking_down(4.0)
    mapped, _ = picture_of(scene_of([(quad(), np.eye(4), material)], device, [sun()]), camera)
    mesh = with_normal(quad(), normal)
    wanted, _ = picture_of(scene_of([(mesh, np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_allclose(mapped, wanted, atol=3e-6)


def test_turned_and_mirrored_instances_turn_the_map_with_them(device, tmp_path):
    """Scaled by -1 along x the surface is its mirror picture, bumps included."""
    material = shown(tmp_path, TILTED)
    camera = looking_down(4.0)
    world = np.diag([-1.0, 1.0, 1.0, 1.0])
    mapped, _ = picture_of(scene_of([(quad(), world, material)], device, [sun()]), camera)
    mesh = with_normal(quad(), TILTED * [-1.0, 1.0, 1.0])
    wanted, _ = picture_of(scene_of([(mesh, np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_allclose(mapped, wanted, atol=3e-6)


def test_back_of_a_surface_shows_the_bumps_from_behind(device, tmp_path):
    """Seen from below, a bump towards +x of the front is one towards -x of the back."""
    material = shown(tmp_path, TILTED)
    camera = looking_down(4.0)
    over = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x: the back faces the eye
    mapped, _ = picture_of(scene_of([(quad(), over, material)], device, [sun()]), camera)
    in_world = TILTED * [1.0, -1.0, -1.0]
    mesh = with_normal(quad(), -in_world)
    wanted, _ = picture_of(scene_of([(mesh, np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_allclose(mapped, wanted, atol=3e-6)


def test_bumps_are_seen_in_a_mirror(device, tmp_path):
    """In a flat mirror a surface looks as from the mirrored eye."""
    material = shown(tmp_path, TILTED)
    above, below = np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4)
    above[2, 3], below[2, 3] = 4.0, -4.0
    camera = looking_down(3.0)
    through = scene_of([(quad(), above, material), (quad(9.0), np.eye(4), SILVER)], device, [sun((0.4, 0.2, -0.9))])
    seen, _ = picture_of(through, camera, mirrors=[1])
    direct, hit = picture_of(scene_of([(quad(), below, material)], device, [sun((0.4, 0.2, 0.9))]), camera)
    assert (hit >= 0).sum() > 200 and direct[hit >= 0, 0].min() > 0.1
    np.testing.assert_allclose(seen[hit >= 0, :3], direct[hit >= 0, :3], atol=1e-5)


def test_reflector_keeps_its_own_normal_unless_asked(device, tmp_path):
    above = np.diag([1.0, 1.0, -1.0, 1.0])
    above[2, 3] = 4.0
    bumpy = dataclasses.replace(shown(tmp_path, TILTED), **{k: getattr(SILVER, k) for k in ("metallic", "roughness")})
    camera = looking_down(3.0)
    pictures = [
        picture_of(scene_of([(quad(), above, MATT), (quad(9.0), np.eye(4), mirror)], device), camera, mirrors=[1])[0]
        for mirror in (bumpy, plain(bumpy))
    ]
    np.testing.assert_array_equal(*pictures)


def test_directions_without_length_leave_the_surface_as_it_is_and_are_told(device, tmp_path):
    material = shown(tmp_path, (0.0, 0.0, 0.0))
    camera = looking_down(4.0)
    scene = scene_of([(quad(), np.eye(4), material)], device, [sun()])
    mapped, _ = picture_of(scene, camera)
    wanted, _ = picture_of(scene_of([(quad(), np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_array_equal(mapped, wanted)
    assert any("normal: 16 of 16 texels hold no direction" in note.text for note in scene.notes)


def test_values_that_are_no_numbers_are_told_and_leave_none_in_the_picture(device, tmp_path):
    material = shown(tmp_path, TILTED)
    pixels = np.tile(np.float32(TILTED * 0.5 + 0.5), (4, 4, 1))
    pixels[1, 2] = np.nan
    import OpenImageIO as oiio  # the package's own writer repairs what it writes

    file = material.textures["normal"].file
    out = oiio.ImageOutput.create("openexr")
    assert out.open(file, oiio.ImageSpec(4, 4, 3, oiio.FLOAT)) and out.write_image(pixels) and out.close()
    del out
    scene = scene_of([(quad(), np.eye(4), material)], device, [sun()])
    assert np.isfinite(picture_of(scene, looking_down(4.0))[0]).all()
    assert any("normal: " in note.text and "3 samples" in note.text for note in scene.notes)


@pytest.mark.parametrize("uvs", [[[0.5, 0.5]] * 4, [[0, 0], [1, 0], [1, 0], [0, 0]]])
def test_coordinates_without_area_leave_finite_pictures(device, tmp_path, uvs):
    mesh = quad()
    mesh.uvs = np.float32(uvs)
    material = shown(tmp_path, TILTED)
    camera = looking_down(4.0)
    mapped, _ = picture_of(scene_of([(mesh, np.eye(4), material)], device, [sun()]), camera)
    wanted, _ = picture_of(scene_of([(mesh, np.eye(4), plain(material))], device, [sun()]), camera)
    np.testing.assert_array_equal(mapped, wanted)


def test_no_normal_is_turned_away_from_the_eye(device, tmp_path):
    """A map that points below the horizon of a grazing view still shows a front."""
    material = shown(tmp_path, (0.0, -0.99, 0.14))
    scene = scene_of([(quad(), np.eye(4), material)], device, [sun()])
    camera = dataclasses.replace(
        looking_down(1.0),
        eye=np.array([0.0, 4.0, 0.4]),
        forward=np.array([0.0, -1.0, 0.0]),
        right=np.array([-1.0, 0.0, 0.0]),
        up=np.array([0.0, 0.0, 1.0]),
    )
    from warp_reflect import raster, surface

    gbuffer = raster.draw_scene(scene, camera)
    _, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, {})
    normals = normal_maps.prepare_normals(scene, gbuffer, None).numpy().astype(float)
    hit = gbuffer.triangle.numpy() >= 0
    y, x = np.mgrid[0 : camera.size[1], 0 : camera.size[0]].reshape(2, -1) + 0.5
    rays = camera.forward + np.outer((x - camera.cx) / camera.fx, camera.right)
    rays -= np.outer((y - camera.cy) / camera.fy, camera.up)
    assert hit.sum() > 50
    np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1.0, atol=1e-5)
    assert (np.einsum("ij,ij->i", normals, rays)[hit] < 0.0).all()


def test_scene_without_maps_launches_nothing(device, monkeypatch):
    def fail(*_):
        raise AssertionError("a kernel was launched")

    monkeypatch.setattr(normal_maps.launch, "launch", fail)
    scene = scene_of([(quad(), np.eye(4), MATT)], device)
    assert len(normal_maps.prepare_normals(scene, None, None)) == 0
