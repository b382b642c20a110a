"""Textures against NumPy look-ups written from their definitions."""

import dataclasses

import numpy as np
import pytest

from warp_reflect import pictures, raster, shade, surface, textures
from warp_reflect.images import write_exr, write_png
from warp_reflect.layers import Camera
from warp_reflect.scene import InstanceData, LightData, MaterialData, MeshData, Scene, SceneData, TextureRef
from warp_reflect.settings import Settings
from warp_reflect.techniques import raytraced

SIZE = (64, 48)
MATT = MaterialData("/matt", roughness=1.0, ior=1.0)  # under a dome of radiance 1 it shows its base colour


def quad(half=1.0, **attributes) -> MeshData:
    """In the plane z = 0, s and t from 0 to 1 along x and y."""
    return MeshData(
        points=np.float32([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]]),
        triangles=np.int32([[0, 1, 2], [0, 2, 3]]),
        uvs=np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]),
        **attributes,
    )


def scene_of(placed, device, lights=None) -> Scene:
    meshes = [mesh for mesh, _, _ in placed]
    instances = [InstanceData(i, world, f"/p{i}", (i,)) for i, (_, world, _) in enumerate(placed)]
    lights = lights or [LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4))]
    return Scene(SceneData("test", meshes, instances, [m for _, _, m in placed], lights, []), device)


def looking_down(height, fov=40.0, orthographic=False, size=SIZE) -> Camera:
    """From +Z to the origin, +Y up."""
    focal = size[0] / (2.0 * np.tan(np.radians(fov) / 2.0))
    if orthographic:
        focal = size[0] / 2.0
    return Camera(
        eye=np.array([0.0, 0.0, height]),
        right=np.array([1.0, 0.0, 0.0]),
        up=np.array([0.0, 1.0, 0.0]),
        forward=np.array([0.0, 0.0, -1.0]),
        fx=focal,
        fy=focal,
        cx=size[0] / 2,
        cy=size[1] / 2,
        near=1e-2,
        far=1e4,
        size=size,
        orthographic=orthographic,
    )


def picture_of(scene, camera, mirrors=()):
    """(RGBA [n, 4], triangle [n]) with traced mirrors, named by part."""
    gbuffer = raster.draw_scene(scene, camera)
    parts = {part + 1: part for part in mirrors}
    pixels, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, parts)
    layers = {
        k: raytraced.reflect(scene, raytraced.Prepared(part, False), gbuffer, pixels[k], camera, Settings())
        for k, part in parts.items()
    }
    return shade.shade(scene, gbuffer, layers)[0].numpy(), gbuffer.triangle.numpy()


def plane_points(camera) -> np.ndarray:
    """Where the pixels of `looking_down` meet z = 0, [height * width, 2]."""
    y, x = np.mgrid[0 : camera.size[1], 0 : camera.size[0]].reshape(2, -1) + 0.5
    depth = 1.0 if camera.orthographic else camera.eye[2]
    return depth * np.stack([(x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy], axis=-1)


WRAPPED = {
    "repeat": lambda i, n: i % n,
    "clamp": lambda i, n: np.clip(i, 0, n - 1),
    "mirror": lambda i, n: np.where(i % (2 * n) < n, i % n, n - 1 - i % n),
    "black": lambda i, n: np.where((i < 0) | (i >= n), n, i),  # a row of zeros behind the last
}


def looked_up(picture, u, v, wrap):
    """Bilinear values of a picture at (u right, v up), float64."""
    height, width, channels = picture.shape
    padded = np.zeros((height + 1, width + 1, channels))
    padded[:height, :width] = picture
    x, y = u * width - 0.5, (1.0 - v) * height - 0.5
    result = 0.0
    for dx in (0, 1):
        for dy in (0, 1):
            i, j = np.floor(x).astype(int) + dx, np.floor(y).astype(int) + dy
            weight = (1.0 - np.abs(x - i)) * (1.0 - np.abs(y - j))
            result = result + weight[:, None] * padded[WRAPPED[wrap[1]](j, height), WRAPPED[wrap[0]](i, width)]
    return result


@pytest.fixture
def noise(tmp_path):
    """A linear picture of 5 x 4 texels and its file."""
    picture = np.random.default_rng(1).uniform(0.0, 1.0, (4, 5, 3)).astype(np.float32)
    write_exr(tmp_path / "noise.exr", {"RGB": picture}, half=())
    return picture, str(tmp_path / "noise.exr")


@pytest.mark.parametrize("wrap", [(mode, mode) for mode in WRAPPED] + [("repeat", "clamp"), ("black", "mirror")])
def test_texture_wraps_and_interpolates(device, noise, wrap):
    """Coordinates from -1.2 to 2.3 by the uv transform, seen from near enough for the finest level."""
    picture, file = noise
    rows = ((3.5, 0.25, -1.2), (-0.25, 3.0, -0.9))
    texture = TextureRef(file, wrap=wrap, uv_from_st=rows)
    material = dataclasses.replace(MATT, textures={"base_color": texture})
    camera = looking_down(2.0)
    rgba, triangle = picture_of(scene_of([(quad(4.0), np.eye(4), material)], device), camera)
    assert (triangle >= 0).all()
    st = np.column_stack([plane_points(camera) / 8.0 + 0.5, np.ones(len(triangle))])
    u, v = (st @ np.array(rows).T).T
    np.testing.assert_allclose(rgba[:, :3], looked_up(picture.astype(float), u, v, wrap), atol=3e-5)


def test_checker_is_upright_and_decoded_from_srgb(device, tmp_path):
    """Two by two texels of an sRGB picture: the first row is on top (t = 1)."""
    grey = ((188 / 255 + 0.055) / 1.055) ** 2.4  # a value that 8 bits hold
    colors = np.float32([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [grey, grey, grey]]])
    write_png(tmp_path / "checker.png", colors)
    texture = TextureRef(str(tmp_path / "checker.png"), wrap=("clamp", "clamp"))
    material = dataclasses.replace(MATT, textures={"base_color": texture})
    camera = looking_down(3.0)
    rgba, triangle = picture_of(scene_of([(quad(), np.eye(4), material)], device), camera)
    p = plane_points(camera)
    corner = (np.abs(p) > 0.6).all(axis=1) & (np.abs(p) < 0.98).all(axis=1)  # past the outer texels' centres
    assert corner.sum() > 60 and (triangle[corner] >= 0).all()
    expected = colors[(p[corner, 1] < 0).astype(int), (p[corner, 0] > 0).astype(int)]
    np.testing.assert_allclose(rgba[corner, :3], expected, atol=1e-5)


def test_one_channel_is_scaled_and_biased(device, noise):
    picture, file = noise
    texture = TextureRef(file, "g", wrap=("clamp", "clamp"), scale=(9.0, 0.5, 9.0, 9.0), bias=(9.0, 0.25, 9.0, 9.0))
    material = MaterialData("/m", base_color=(0, 0, 0), ior=1.0, roughness=1.0, textures={"emissive": texture})
    camera = looking_down(2.0, orthographic=True)
    rgba, _ = picture_of(scene_of([(quad(2.0), np.eye(4), material)], device), camera)
    u, v = (plane_points(camera) / 4.0 + 0.5).T
    green = looked_up(picture[..., 1:2].astype(float), u, v, ("clamp", "clamp"))
    np.testing.assert_allclose(rgba[:, :3], np.repeat(0.5 * green + 0.25, 3, axis=1), atol=1e-5)


@pytest.mark.parametrize("height", [1.5, 20.0, 150.0])
def test_constant_picture_looks_as_the_constant(device, tmp_path, height):
    write_exr(tmp_path / "flat.exr", {"RGB": np.full((37, 53, 3), 0.25, np.float32)}, half=())
    file = TextureRef(str(tmp_path / "flat.exr"))
    values = {"base_color": (0.25, 0.25, 0.25), "metallic": 0.25, "roughness": 0.25, "clearcoat": 0.25}
    plain = MaterialData("/m", **values)
    looked = {"base_color": file} | {n: dataclasses.replace(file, channel="r") for n in pictures.NUMBERS}
    camera = looking_down(height)
    one, triangle = picture_of(scene_of([(quad(), np.eye(4), plain)], device), camera)
    scene = scene_of([(quad(), np.eye(4), MaterialData("/m", textures=looked))], device)
    np.testing.assert_allclose(picture_of(scene, camera)[0], one, atol=1e-6)
    assert (triangle >= 0).any()


def test_minified_checker_tends_to_its_mean(device, tmp_path):
    """A checker of 256 squares a side on 12 pixels; without levels each pixel would be black or white."""
    checker = np.indices((256, 256)).sum(axis=0) % 2
    write_exr(tmp_path / "c.exr", {"RGB": np.repeat(checker[..., None], 3, axis=2).astype(np.float32)}, half=())
    texture = TextureRef(str(tmp_path / "c.exr"))
    material = dataclasses.replace(MATT, textures={"base_color": texture})
    camera = looking_down(15.0)
    scene = scene_of([(quad(), np.eye(4), material)], device)
    rgba, triangle = picture_of(scene, camera)
    assert 50 < (triangle >= 0).sum() < 400
    np.testing.assert_allclose(rgba[triangle >= 0, :3], 0.5, atol=1e-3)
    # Near enough that 4 x 4 pixels show a texel, squares are told apart; the middle pixels are 1/8 texel off.
    near = picture_of(scene, looking_down(2.0 / 256 * 16 / np.tan(np.radians(20.0)) / 2.0))[0]
    low = 2 * (1 / 8) * (7 / 8)
    assert near[:, 0].min() == pytest.approx(low, abs=1e-4) and near[:, 0].max() == pytest.approx(1 - low, abs=1e-4)


def test_level_follows_the_path_through_a_mirror(device, tmp_path):
    """A textured quad seen in a flat mirror has the colours of one seen directly from the mirrored eye."""
    rng = np.random.default_rng(3)
    write_exr(tmp_path / "n.exr", {"RGB": rng.uniform(0, 1, (128, 128, 3)).astype(np.float32)}, half=())
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(str(tmp_path / "n.exr"))})
    silver = MaterialData("/silver", base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    above = np.diag([1.0, 1.0, -1.0, 1.0])
    above[2, 3] = 4.0  # behind the eye, facing down
    below = np.diag([1.0, 1.0, 1.0, 1.0])
    below[2, 3] = -4.0
    camera = looking_down(3.0)
    in_mirror = scene_of([(quad(), above, material), (quad(9.0), np.eye(4), silver)], device)
    seen, triangle = picture_of(in_mirror, camera, mirrors=[1])
    direct, hit = picture_of(scene_of([(quad(), below, material)], device), camera)
    assert (triangle >= 2).all() and (hit >= 0).sum() > 200
    np.testing.assert_allclose(seen[hit >= 0, :3], direct[hit >= 0, :3], atol=2e-4)


def test_white_furnace_holds_for_any_textured_metallic_and_roughness(device, tmp_path):
    rng = np.random.default_rng(5)
    write_exr(tmp_path / "n.exr", {"RGB": rng.uniform(0, 1, (16, 16, 3)).astype(np.float32)}, half=())
    channel = {name: TextureRef(str(tmp_path / "n.exr"), c) for name, c in zip(pictures.NUMBERS, "rgbr", strict=True)}
    material = MaterialData("/m", base_color=(1.0, 1.0, 1.0), textures=channel)
    rgba, triangle = picture_of(scene_of([(quad(4.0), np.eye(4), material)], device), looking_down(2.0))
    assert (triangle >= 0).all()
    np.testing.assert_allclose(rgba[:, :3], 1.0, atol=1e-5)


def test_textured_metallic_is_used_at_every_pixel(device, tmp_path):
    """Left half a metal that is no mirror, right half a dielectric; a light from a side shows which."""
    write_exr(tmp_path / "m.exr", {"RGB": np.float32([[[1, 1, 1], [0, 0, 0]]])}, half=())
    texture = TextureRef(str(tmp_path / "m.exr"), "r", wrap=("clamp", "clamp"))
    material = MaterialData("/m", base_color=(0.5, 0.5, 0.5), roughness=0.0, textures={"metallic": texture})
    towards = np.eye(4)  # shines along -Z
    sun = LightData("/sun", "distant", (np.pi, np.pi, np.pi), towards)
    scene = scene_of([(quad(4.0), np.eye(4), material)], device, [sun])
    rgba, _ = picture_of(scene, looking_down(20.0, 20.0, orthographic=False))
    x = plane_points(looking_down(20.0, 20.0))[:, 0]
    assert rgba[x < -2.1, 0].max() < 1e-6  # a sharp metal scatters nothing
    assert rgba[x > 2.1, 0].min() > 0.4


def test_means_decide_what_is_a_mirror_and_are_told(device, noise):
    picture, file = noise
    looked = {"roughness": TextureRef(file, "r", scale=(0.1, 1, 1, 1)), "metallic": TextureRef(file, "g")}
    scene = scene_of([(quad(), np.eye(4), MaterialData("/m", textures=looked))], device)
    material = scene.data.materials[0]
    assert material.roughness == pytest.approx(0.1 * picture[..., 0].mean(), abs=1e-6)
    assert material.metallic == pytest.approx(picture[..., 1].mean(), abs=1e-6)
    assert [note.path for note in scene.notes] == ["/m"] and "metallic" in scene.notes[0].text


@pytest.mark.parametrize("name", ["base_color", "roughness"])
def test_unreadable_picture_is_told_and_the_constant_is_used(device, tmp_path, name):
    (tmp_path / "bad.png").write_bytes(b"no picture")
    plain = MaterialData("/m", base_color=(0.25, 0.5, 0.75), roughness=0.2)
    broken = dataclasses.replace(plain, textures={name: TextureRef(str(tmp_path / "bad.png"))})
    camera = looking_down(3.0)
    scene = scene_of([(quad(), np.eye(4), broken)], device)
    rgba, _ = picture_of(scene, camera)
    np.testing.assert_array_equal(rgba, picture_of(scene_of([(quad(), np.eye(4), plain)], device), camera)[0])
    assert len(scene.notes) == 1 and "bad.png" in scene.notes[0].text and name in scene.notes[0].text


def test_pictures_that_came_with_the_data_need_no_file(device, noise, tmp_path):
    _, file = noise
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(file), "metallic": TextureRef(file, "b")})
    missing = TextureRef(str(tmp_path / "none.exr"))
    other = dataclasses.replace(MATT, textures={"emissive": missing})
    data = SceneData(
        "test",
        [quad(), quad()],
        [InstanceData(k, np.eye(4), f"/p{k}", (k,)) for k in (0, 1)],
        [material, other],
        [LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4))],
        [],
    )
    camera = looking_down(3.0)
    expected, _ = picture_of(Scene(data, device), camera)
    packed = pictures.with_pictures(data)
    assert len(packed.pictures) == 2 and any("none.exr" in note.text for note in packed.notes)
    (tmp_path / "noise.exr").unlink()
    np.testing.assert_array_equal(picture_of(Scene(packed, device), camera)[0], expected)


def test_scene_without_textures_holds_none(device):
    found = scene_of([(quad(), np.eye(4), MATT)], device).textures
    for name in ("bindings", "textures", "levels", "texels", "uvs", "uv_index"):
        assert getattr(found, name).shape == (0,)


@pytest.mark.parametrize("size", [(64, 64), (37, 53), (1, 9), (130, 7)])
def test_every_level_keeps_the_mean(size):
    picture = np.random.default_rng(2).uniform(0, 1, (*size, 3)).astype(np.float32)
    pyramid = pictures.make_pyramid(pictures.reduced(picture, 48))
    assert max(pyramid.levels[0].shape[:2]) <= 48 and pyramid.levels[-1].shape == (1, 1, 3)
    for level in pyramid.levels:
        np.testing.assert_allclose(level.mean(axis=(0, 1)), picture.mean(axis=(0, 1)), atol=1e-5)


def test_too_many_texels_cost_the_finest_levels(monkeypatch):
    pyramids = {k: pictures.make_pyramid(np.zeros((s, s, 3), np.float32)) for k, s in (("a", 64), ("b", 16))}
    monkeypatch.setattr(textures, "TEXELS_MAX", 4000)
    kept = textures._within_budget(pyramids)
    assert sum(level.size for levels in kept.values() for level in levels) <= 4000
    assert len(kept["a"][0]) == 16 and len(kept["b"][0]) == 16


def test_mirrored_instances_keep_their_coordinates(device, noise):
    """An instance scaled by -1 along x shows the picture mirrored, not garbled."""
    _, file = noise
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(file, wrap=("clamp", "clamp"))})
    camera = looking_down(2.0)
    plain, _ = picture_of(scene_of([(quad(2.0), np.eye(4), material)], device), camera)
    flipped, _ = picture_of(scene_of([(quad(2.0), np.diag([-1.0, 1.0, 1.0, 1.0]), material)], device), camera)
    shape = (SIZE[1], SIZE[0], 4)
    np.testing.assert_allclose(flipped.reshape(shape)[:, ::-1], plain.reshape(shape), atol=1e-5)


def write_tiles(folder, numbers, seed=7) -> dict[int, np.ndarray]:
    """Random linear pictures of 4 x 4 texels by UDIM number, written as set.NUMBER.exr."""
    rng = np.random.default_rng(seed)
    tiles = {number: rng.uniform(0, 1, (4, 4, 3)).astype(np.float32) for number in numbers}
    for number, picture in tiles.items():
        write_exr(folder / f"set.{number}.exr", {"RGB": picture}, half=())
    return tiles


def tiled_quads(first, second) -> MeshData:
    """Two quads side by side; their coordinates fill the tiles at the given (column, row)."""
    points, uvs = [], []
    for k, (column, row) in enumerate((first, second)):
        points += [[2 * k - 2, -1, 0], [2 * k, -1, 0], [2 * k, 1, 0], [2 * k - 2, 1, 0]]
        uvs += [[column, row], [column + 1, row], [column + 1, row + 1], [column, row + 1]]
    return MeshData(
        points=np.float32(points), triangles=np.int32([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]), uvs=np.float32(uvs)
    )


@pytest.mark.parametrize("places", [((0, 0), (1, 0)), ((9, 0), (0, 1)), ((3, 12), (4, 2))])
def test_tiles_are_looked_up_where_their_triangles_lie(device, tmp_path, places):
    numbers = [1001 + column + 10 * row for column, row in places]
    tiles = write_tiles(tmp_path, numbers)
    texture = TextureRef(str(tmp_path / "set.<UDIM>.exr"), wrap=("repeat", "repeat"))
    material = dataclasses.replace(MATT, textures={"base_color": texture})
    camera = looking_down(5.0)
    scene = scene_of([(tiled_quads(*places), np.eye(4), material)], device)
    rgba, triangle = picture_of(scene, camera)
    p = plane_points(camera)
    for k, number in enumerate(numbers):
        mine = (triangle >= 2 * k) & (triangle < 2 * k + 2)
        u, v = p[mine, 0] / 2 + 1 - k, p[mine, 1] / 2 + 0.5
        assert mine.sum() > 150
        wanted = looked_up(tiles[number].astype(float), u, v, ("clamp", "clamp"))
        np.testing.assert_allclose(rgba[mine, :3], wanted, atol=1e-4)
    assert not scene.notes


def test_missing_tile_shows_the_fallback_and_is_told_once(device, tmp_path):
    write_tiles(tmp_path, [1001])
    texture = TextureRef(str(tmp_path / "set.<UDIM>.exr"))
    material = MaterialData(
        "/m", base_color=(0.1, 0.2, 0.3), roughness=1.0, ior=1.0, textures={"base_color": texture, "emissive": texture}
    )
    scene = scene_of([(tiled_quads((0, 0), (1, 0)), np.eye(4), material)], device)
    rgba, triangle = picture_of(scene, looking_down(5.0))
    np.testing.assert_allclose(rgba[triangle >= 2, :3], np.tile([0.1, 0.2, 0.3], ((triangle >= 2).sum(), 1)), atol=1e-5)
    found = [note.text for note in scene.notes if "no tile" in note.text]
    assert len(found) == 2 and all("no tile 1002; its constant" in text for text in found)


def test_only_tiles_in_use_are_read(device, tmp_path):
    write_tiles(tmp_path, [1001, 1002])
    (tmp_path / "set.1003.exr").write_bytes(b"no picture")
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(str(tmp_path / "set.<UDIM>.exr"))})
    scene = scene_of([(tiled_quads((0, 0), (1, 0)), np.eye(4), material)], device)
    picture_of(scene, looking_down(5.0))
    assert not scene.notes


def test_tiles_that_came_with_the_data_need_no_file(device, tmp_path):
    write_tiles(tmp_path, [1001, 1002])
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(str(tmp_path / "set.<UDIM>.exr"))})
    mesh = tiled_quads((0, 0), (1, 0))
    lights = [LightData("/dome", "dome", (1.0, 1.0, 1.0), np.eye(4))]
    data = SceneData("test", [mesh], [InstanceData(0, np.eye(4), "/p", (0,))], [material], lights, [])
    camera = looking_down(5.0)
    expected, _ = picture_of(Scene(data, device), camera)
    packed = pictures.with_pictures(data)
    for file in tmp_path.glob("set.*.exr"):
        file.unlink()
    np.testing.assert_array_equal(picture_of(Scene(packed, device), camera)[0], expected)


@pytest.mark.parametrize("packed", [False, True])
def test_samples_that_are_no_light_are_counted_in_a_note(device, tmp_path, packed):
    import OpenImageIO as oiio  # the package's own writer repairs what it writes

    pixels = np.full((4, 4, 3), 0.5, np.float32)
    pixels[0, 0], pixels[1, 1, 0], pixels[2, 2, 1] = np.nan, np.inf, -3.0
    file = str(tmp_path / "bad.exr")
    out = oiio.ImageOutput.create("openexr")
    assert out.open(file, oiio.ImageSpec(4, 4, 3, oiio.FLOAT)) and out.write_image(pixels) and out.close()
    del out
    material = dataclasses.replace(MATT, textures={"base_color": TextureRef(file)})
    scene = scene_of([(quad(), np.eye(4), material)], device)
    if packed:
        scene = Scene(pictures.with_pictures(scene.data), device)
        scene.notes += scene.data.notes
    for _ in range(2):
        rgba, _ = picture_of(scene, looking_down(3.0))
        assert np.isfinite(rgba).all()
    found = {note.text for note in scene.notes}
    assert len(found) == 1 and "base_color" in min(found) and "5 samples that are no light" in min(found)
    # Another scene that shares the picture in memory is told as well.
    again = scene_of([(quad(), np.eye(4), material)], device)
    picture_of(again, looking_down(3.0))
    assert len(again.notes) == 1


@pytest.mark.parametrize("channel", ["rrr", "bgr", "gab"])
def test_channels_may_be_mixed(device, tmp_path, channel):
    rng = np.random.default_rng(9)
    pixels = rng.uniform(0, 1, (4, 4, 4)).astype(np.float32)
    write_exr(tmp_path / "n.exr", {"RGBA": pixels}, half=())
    scale, bias = (0.5, 0.25, 1.0, 1.0), (0.0, 0.125, 0.0, 0.0)
    texture = TextureRef(str(tmp_path / "n.exr"), channel, wrap=("clamp", "clamp"), scale=scale, bias=bias)
    camera = looking_down(2.0)
    material = dataclasses.replace(MATT, textures={"base_color": texture})
    rgba, _ = picture_of(scene_of([(quad(2.0), np.eye(4), material)], device), camera)
    picked = pixels[..., ["rgba".index(letter) for letter in channel]].astype(float)
    u, v = (plane_points(camera) / 4.0 + 0.5).T
    wanted = looked_up(picked, u, v, ("clamp", "clamp")) * scale[:3] + bias[:3]
    np.testing.assert_allclose(rgba[:, :3], wanted, atol=3e-5)


def test_means_of_tiles_decide_what_is_a_mirror(device, tmp_path):
    tiles = write_tiles(tmp_path, [1001, 1002])
    looked = {"metallic": TextureRef(str(tmp_path / "set.<UDIM>.exr"), "g", "raw")}
    scene = scene_of([(tiled_quads((0, 0), (1, 0)), np.eye(4), MaterialData("/m", textures=looked))], device)
    wanted = np.mean([picture[..., 1].mean() for picture in tiles.values()])
    assert scene.data.materials[0].metallic == pytest.approx(wanted, abs=1e-6)
