"""Cut-outs by textures' opacity against bilinear look-ups in float64: seen directly, in mirrors, and as shadows."""

import dataclasses

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, UsdGeom, UsdShade
from rooms import square
from test_shade import WHITE, ball_mesh, distant, dome, eye_rays, ground, look_at, place

import warp_reflect as wr
from warp_reflect import direct, launch, pictures, raster, shadows
from warp_reflect import frame as frame_module
from warp_reflect.scene import InstanceData, LightData, MaterialData, Scene, SceneData, TextureRef

SILVER = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
SIDE = 48
WRAPPED = TextureRef("card.png", "a", wrap=("repeat", "mirror"), uv_from_st=((2.5, 0.0, -0.4), (0.3, 1.7, -0.2)))
BLACK = TextureRef("card.png", "a", wrap=("black", "black"), uv_from_st=((1.6, 0.0, -0.3), (0.0, 1.6, -0.3)))
SCALED = TextureRef("card.png", "a", wrap=("clamp", "clamp"), scale=(1, 1, 1, -0.8), bias=(0, 0, 0, 0.9))
PLAIN = TextureRef("card.png", "a", wrap=("clamp", "clamp"))


def alpha() -> np.ndarray:
    """Waves and a ring, so that outlines run at every angle."""
    y, x = (np.mgrid[0:SIDE, 0:SIDE] + 0.5) / SIDE - 0.5
    r = np.hypot(x, y)
    return (0.5 + 0.5 * np.sin(18 * r) * np.cos(3 * np.arctan2(y, x)))[..., None].astype(np.float32)


def is_there(st, texture, threshold) -> np.ndarray:
    """Whether a surface is there at texture coordinates [n, 2], float64."""
    rows = np.array(texture.uv_from_st)
    u, v = (np.concatenate([st, np.ones((len(st), 1))], axis=1) @ rows.T).T
    values = alpha()[..., 0].astype(np.float64)

    def texel(i, mode):
        if mode == "repeat":
            return i % SIDE, np.ones(len(i), bool)
        if mode == "mirror":
            i = i % (2 * SIDE)
            return np.where(i < SIDE, i, 2 * SIDE - 1 - i), np.ones(len(i), bool)
        inside = (i >= 0) & (i < SIDE) if mode == "black" else np.ones(len(i), bool)
        return np.clip(i, 0, SIDE - 1), inside

    x, y = u * SIDE - 0.5, (1.0 - v) * SIDE - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros(len(st))
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        (column, in_x), (row, in_y) = texel(x0 + dx, texture.wrap[0]), texel(y0 + dy, texture.wrap[1])
        share = np.where(dx, x - x0, 1 - (x - x0)) * np.where(dy, y - y0, 1 - (y - y0))
        total += share * np.where(in_x & in_y, values[row, column], 0.0)
    return texture.scale[3] * total + texture.bias[3] >= threshold


def card(half=1.0):
    mesh = ground(half)
    mesh.uvs = np.float32([[0, 0], [1, 0], [1, 1], [0, 1]])
    return mesh


def st_of(x, z, half=1.0) -> np.ndarray:
    return np.stack([x / half, z / half], axis=-1) * 0.5 + 0.5


def cut(texture=PLAIN, threshold=0.5, **values) -> MaterialData:
    return MaterialData("/cut", textures={"opacity": texture}, opacity_threshold=threshold, **values)


def scene_of(placed, lights=(), given=True) -> Scene:
    keys = {pictures.picture_key(t): alpha() for t in (WRAPPED, BLACK, SCALED, PLAIN)}
    return Scene(
        SceneData(
            "test",
            [mesh for mesh, _, _ in placed],
            [InstanceData(i, m, f"/p{i}", (i,)) for i, (_, m, _) in enumerate(placed)],
            [material for _, _, material in placed],
            list(lights),
            [],
            pictures=keys if given else None,
        )
    )


def rendered(scene, camera, method="auto", **settings):
    return wr.render_frame(scene, wr.make_plan(scene, camera, camera.size, wr.Settings(**settings), method))


def on_card(origin, d, height=0.0, half=1.0):
    """(points where rays cross the card's plane [n, 3], which lie on it)."""
    t = (height - origin[..., 1]) / d[:, 1]
    p = origin + t[:, None] * d
    return p, (t > 0) & (np.abs(p[:, 0]) < half) & (np.abs(p[:, 2]) < half)


def orthographic(camera):
    return dataclasses.replace(camera, orthographic=True, fx=40.0, fy=40.0)


@pytest.mark.parametrize("texture", [PLAIN, WRAPPED, BLACK, SCALED], ids=["plain", "wrapped", "black", "scaled"])
@pytest.mark.parametrize("flat", [False, True], ids=["perspective", "orthographic"])
def test_eye_sees_a_card_where_its_picture_is_opaque(texture, flat):
    scene = scene_of([(card(), place(), cut(texture)), (ground(6.0), place(0, -1, 0), WHITE)])
    camera = look_at((0.3, 2.5, 1.5), (0, 0, 0), fov=50.0, size=(160, 120))
    camera = orthographic(camera) if flat else camera
    frame = rendered(scene, camera)
    d, origin = eye_rays(camera), np.broadcast_to(camera.eye, (160 * 120, 3))
    if flat:
        y, x = np.mgrid[0:120, 0:160].reshape(2, -1) + 0.5
        aside = ((x - camera.cx) / camera.fx)[:, None] * camera.right - ((y - camera.cy) / camera.fy)[
            :, None
        ] * camera.up
        d, origin = np.broadcast_to(camera.forward, aside.shape), camera.eye + aside
    p, inside = on_card(origin, d)
    there = np.zeros(len(p), bool)
    there[inside] = is_there(st_of(p[inside, 0], p[inside, 2]), texture, 0.5)
    seen = frame["primId"].reshape(-1) == 1
    assert 500 < there.sum() < 0.95 * inside.sum()
    assert np.count_nonzero(seen != there) <= 0.002 * inside.sum()
    depth = frame["Z"].reshape(-1)
    behind = inside & ~there & ~seen
    expected = ((on_card(origin, d, -1.0, 6.0)[0] - camera.eye) @ camera.forward)[behind]
    np.testing.assert_allclose(depth[behind], expected, rtol=1e-4)


@pytest.mark.parametrize("method", ["reference", "planar"])
@pytest.mark.parametrize("refine", ["exact", "off"])
def test_flat_mirror_shows_a_card_where_its_picture_is_opaque(method, refine):
    """The mirror is the plane y = -0.5, the card above it, a ceiling behind that."""
    placed = [(ground(3.0), place(0, -0.5, 0), SILVER), (card(), place(), cut()), (ground(9.0), place(0, 2, 0), WHITE)]
    scene = scene_of(placed)
    camera = look_at((0.2, 1.0, 3.5), (0, -0.3, 0), fov=50.0, size=(160, 120))
    frame = rendered(scene, camera, method, refine=refine)
    d = eye_rays(camera)
    p = camera.eye + (-(0.5 + camera.eye[1]) / d[:, 1])[:, None] * d
    up = d * np.array([1.0, -1.0, 1.0])
    q, inside = on_card(p, up)
    mirror = frame["reflectorId"].reshape(-1) == 1
    there = inside & mirror
    there[there] = is_there(st_of(q[there, 0], q[there, 2]), PLAIN, 0.5)
    shown = frame["reflectedId"].reshape(-1)
    assert 300 < there.sum() < 0.9 * (inside & mirror).sum()
    assert np.count_nonzero(((shown == 2) != there) & mirror) <= 0.004 * (inside & mirror).sum()
    assert set(np.unique(shown[mirror & inside & ~there])) <= {2, 3}
    assert np.isfinite(frame["RGBA"]).all() and (frame["residual"] < 1e-3).all()


def test_ball_shows_the_same_holes_by_every_technique():
    scene = scene_of(
        [
            (ball_mesh(), place(0, 0, -1.2), SILVER),
            (card(), place(0, 1.1, -0.6), cut()),
            (square(24, 9.0), place(0, -1, 0), WHITE),
        ]
    )
    camera = look_at((0.2, 1.6, 3.0), (0, 0.2, -1), fov=45.0, size=(160, 120))
    reference = rendered(scene, camera, "reference")
    assert (reference["reflectedId"] == 2).sum() > 200
    for settings in ({}, {"refine": "off"}, {"kernels": "plain"}):
        frame = rendered(scene, camera, "reflector_map", **settings)
        assert {row.technique for row in frame.plan.rows} == {"reflector_map"}
        same = frame["reflectedId"] == reference["reflectedId"]
        mirror = reference["reflectorId"] > 0
        assert same[mirror].mean() > (0.9 if settings.get("refine") == "off" else 0.999)


def test_mirrors_that_are_traced_together_show_the_holes_that_each_shows_alone(monkeypatch):
    balls = [(ball_mesh(), place(x, 0, -1.2, 0.8), SILVER) for x in (-0.9, 0.9)]
    scene = scene_of([*balls, (card(), place(0, 1.1, -0.6), cut()), (square(24, 9.0), place(0, -1, 0), WHITE)])
    camera = look_at((0.2, 1.6, 3.0), (0, 0.2, -1), fov=45.0, size=(160, 120))
    together = rendered(scene, camera, "reference")
    assert all(layer.whole is not None for layer in together.layers.values())
    monkeypatch.setattr(frame_module, "_together", lambda rows, pixels: [[row] for row in rows])
    alone = rendered(scene, camera, "reference")
    assert (alone["reflectedId"] == 3).sum() > 200
    for channel in ("RGBA", "reflectedPoint", "status"):
        np.testing.assert_array_equal(together[channel], alone[channel])


def test_a_distant_light_throws_the_shadow_of_what_is_there():
    to_light = np.array([0.4, 1.0, -0.3]) / np.linalg.norm([0.4, 1.0, -0.3])
    scene = scene_of([(ground(4.0), place(0, -1, 0), WHITE), (card(), place(), cut())], [distant((1, 1, 1), to_light)])
    camera = look_at((0.0, 5.0, 0.2), (0, -1, 0), fov=60.0, size=(160, 120))
    points = direct.points_of(scene, raster.draw_scene(scene, camera))
    got = shadows.shadowed_irradiance(scene, points, shadows.every_shadow(scene)).numpy()[:, 0]
    below = points.triangle.numpy() < 2
    d = eye_rays(camera)
    p = camera.eye + (-(1.0 + camera.eye[1]) / d[:, 1])[:, None] * d
    q, inside = on_card(p, np.broadcast_to(to_light, d.shape))
    dark = inside & below
    dark[dark] = is_there(st_of(q[dark, 0], q[dark, 2]), PLAIN, 0.5)
    assert 300 < dark.sum() < 0.9 * (inside & below).sum()
    assert np.count_nonzero(((got == 0.0) != dark) & below) <= 0.004 * (inside & below).sum()
    np.testing.assert_allclose(got[below & ~dark & (got > 0)], to_light[1], rtol=1e-5)


@pytest.mark.parametrize(
    "light",
    [
        LightData("/lamp", "sphere", (1, 1, 1), place(0.3, 2.2, 0.1), size=(0.4,)),
        dome(),
    ],
    ids=["sphere", "dome"],
)
def test_all_hole_is_no_card_and_no_hole_is_a_whole_one(light):
    """Shares of light past a card whose picture is all below, or all above, its threshold."""
    camera = look_at((0.0, 4.0, 3.0), (0, -1, 0), fov=50.0, size=(64, 48))
    shares = []
    for material in (cut(threshold=1.5), None, cut(threshold=1e-9, texture=SCALED), WHITE):
        placed = [(ground(4.0), place(0, -1, 0), WHITE)] + ([(card(), place(), material)] if material else [])
        scene = scene_of(placed, [light])
        points = direct.points_of(scene, raster.draw_scene(scene, camera))
        if light.kind == "dome":
            share = shadows.sky_share(scene, points, 16).numpy()
        else:
            share = shadows.shadowed_irradiance(scene, points, shadows.every_shadow(scene, 64)).numpy()[:, 0]
        shares.append(np.where(points.triangle.numpy() < 2, share, -1.0))
    empty, none, full, whole = shares
    both = (empty >= 0) & (none >= 0)
    np.testing.assert_allclose(empty[both], none[both], atol=1e-5)
    assert np.mean(empty == -1.0) < 0.05 + np.mean(none == -1.0)
    both = (full >= 0) & (whole >= 0)
    assert both.sum() > 500 and np.abs(full - whole)[both].mean() < 0.01
    assert (full[both] < 0.9 * none[both]).sum() > 30


def test_what_cannot_be_cut_is_whole_and_told():
    bare = ground(1.0)
    for mesh, texture, text in (
        (bare, PLAIN, "no texture coordinates st for the opacity of /cut"),
        (card(), TextureRef("/nowhere/leaf.png", "a"), "texture of opacity:"),
    ):
        scene = scene_of([(mesh, place(), cut(texture)), (card(), place(9, 0, 0), cut())], given=False)
        assert any(text in note.text and "not cut out" in note.text for note in scene.notes), scene.notes
        camera = look_at((0.3, 2.5, 1.5), (0, 0, 0), fov=30.0)
        assert (rendered(scene, camera)["primId"] == 1).sum() > 500


def test_hundreds_of_holes_behind_one_another_end():
    """A mirror looks at more holes than a ray goes through: an honest status, and a finite picture."""
    sheets = [(card(), place(0, 0.01 * k, 0), cut(threshold=1.5)) for k in range(300)]
    scene = scene_of([(ground(0.8), place(0, -0.5, 0), SILVER), *sheets])
    camera = look_at((0.0, -0.05, 0.04), (0, -0.5, 0), fov=50.0, size=(32, 24))
    frame = rendered(scene, camera, "reference")
    mirror = frame["reflectorId"] > 0
    assert mirror.sum() > 50
    assert set(np.unique(frame["status"][mirror])) <= {wr.Status.STEP_LIMIT, wr.Status.SKY}
    assert (frame["status"] == wr.Status.STEP_LIMIT).any() and np.isfinite(frame["RGBA"]).all()


def test_threads_do_not_change_a_pixel_and_other_scenes_pay_nothing():
    lights = [distant((1, 1, 1), (0.4, 1.0, -0.3))]
    placed = [(ground(3.0), place(0, -0.5, 0), SILVER), (ground(9.0), place(0, 2, 0), WHITE)]
    scene = scene_of([*placed, (card(), place(), cut())], lights)
    camera = look_at((0.2, 1.0, 3.5), (0, -0.3, 0), fov=50.0)
    with launch.recorded() as launches:
        one = rendered(scene, camera, threads=1)
    assert [name for name in launches if "go_past" in str(name)] and [n for n in launches if "look_past" in str(n)]
    two = rendered(scene, camera, threads=2)
    for channel in ("RGBA", "reflectedPoint", "primId"):
        np.testing.assert_array_equal(one[channel], two[channel])
    plain = scene_of([*placed, (card(), place(), WHITE)], lights)
    assert plain.has_hole is None and len(plain.view.cuts.texels) == 0
    with launch.recorded() as launches:
        rendered(plain, camera)
    assert not [name for name in launches if "past" in str(name) or "cut_" in str(name)]


@pytest.mark.parametrize("untrusted", [False, True])
def test_stage_with_a_threshold_is_cut_and_without_one_it_is_told(tmp_path, untrusted):
    from warp_reflect import images

    images.write_png(tmp_path / "leaf.png", np.repeat(alpha(), 3, axis=2))
    stage = samples.new_stage(tmp_path / "leaf.usda")
    for name, x, threshold in (("Cut", 0.0, 0.5), ("Clear", 5.0, 0.0)):
        mesh = samples.add_quad(stage, f"/{name}")
        UsdGeom.XformCommonAPI(mesh).SetTranslate((x, 0, 0))
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        st.Set([Gf.Vec2f(*each) for each in ((0, 0), (1, 0), (1, 1), (0, 1))])
        material = samples.add_material(stage, f"/{name}Look", opacityThreshold=threshold)
        reader = UsdShade.Shader.Define(stage, f"/{name}Look/st")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        picture = UsdShade.Shader.Define(stage, f"/{name}Look/leaf")
        picture.CreateIdAttr("UsdUVTexture")
        picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./leaf.png")
        picture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("raw")
        picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(
            reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        )
        shader = next(UsdShade.Shader(p) for p in material.GetPrim().GetChildren() if p.GetName() not in ("st", "leaf"))
        shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).ConnectToSource(
            picture.CreateOutput("r", Sdf.ValueTypeNames.Float)
        )
        samples.bind(mesh, material)
    scene = wr.load_stage(samples.saved(stage), untrusted=untrusted)
    first, second = (range(p.first_triangle, p.first_triangle + p.triangle_count) for p in scene.parts)
    assert scene.has_hole[list(first)].all() and not scene.has_hole[list(second)].any()
    assert any("without opacityThreshold" in note.text and note.path == "/ClearLook" for note in scene.notes)
