"""Normal-mapped mirrors and clear coats: against tilted normals, against rays, and against quadrature."""

import dataclasses

import numpy as np
import pytest
from test_glossy import dome, reflected_quadrature, sky, wall
from test_normal_maps import SILVER, shown, with_normal
from test_textures import MATT, looking_down, quad

import warp_reflect as wr
from warp_reflect.finishes import bumps
from warp_reflect.images import write_exr
from warp_reflect.scene import InstanceData, MaterialData, Scene, SceneData, TextureRef

SIZE = (96, 72)
TILTED = np.array([0.12, 0.2, 1.0]) / np.linalg.norm([0.12, 0.2, 1.0])


def rendered(placed, device, lights=None, method="reference", **settings):
    meshes = [mesh for mesh, _, _ in placed]
    instances = [InstanceData(i, world, f"/p{i}", (i,)) for i, (_, world, _) in enumerate(placed)]
    scene = Scene(SceneData("bumps", meshes, instances, [m for _, _, m in placed], lights or [dome()], []), device)
    plan = wr.make_plan(scene, looking_down(3.0, size=SIZE), SIZE, wr.Settings(**settings), method)
    return wr.render_frame(scene, plan)


def above(height):
    """Over the right of the mirror, facing down."""
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = 0.8, 0.0, height
    return matrix


def wavy_map(tmp_path, slope, waves=3):
    """A map of crossing sine waves, periodic over the quad."""
    t = (np.arange(256) + 0.5) / 256
    x, y = np.meshgrid(t, t)
    dx = slope * np.cos(2 * np.pi * (waves * x + y))
    dy = slope * np.cos(2 * np.pi * (waves * y - x))
    n = np.stack([-dx, -dy, np.ones_like(dx)], -1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    write_exr(tmp_path / "waves.exr", {"RGB": np.float32(0.5 * n + 0.5)}, half=())
    return TextureRef(
        str(tmp_path / "waves.exr"), color_space="signed", scale=(2.0, 2.0, 2.0, 1.0), bias=(-1.0, -1.0, -1.0, 0.0)
    )


@pytest.mark.parametrize("how", ["traced", "lookup"])
def test_map_of_one_direction_mirrors_as_tilted_corners_do(device, tmp_path, how):
    mirror = dataclasses.replace(SILVER, textures=shown(tmp_path, TILTED).textures)
    glow = MaterialData(base_color=(0, 0, 0), emissive=(0.9, 0.3, 0.1), ior=1.0, roughness=1.0)
    lid = (quad(0.35), above(0.8), glow)
    mapped = rendered([lid, (quad(2.0), np.eye(4), mirror)], device, bumps=how)
    tilted = rendered([lid, (with_normal(quad(2.0), TILTED), np.eye(4), SILVER)], device)
    off = rendered([lid, (quad(2.0), np.eye(4), mirror)], device, bumps="off")
    seen = (mapped["reflectorId"] > 0) & (tilted["reflectorId"] > 0)
    assert seen.sum() > 2000
    error = np.abs(mapped["RGBA"] - tilted["RGBA"])[seen].max(axis=1)
    # A picture looked up has its edges half a pixel wide.
    assert (error > 2e-3).mean() < (0.001 if how == "traced" else 0.03), (error > 2e-3).mean()
    assert np.abs(off["RGBA"] - tilted["RGBA"])[seen].mean() > 0.02
    # The data stay those of the smooth mirror.
    np.testing.assert_array_equal(mapped["reflectedPoint"], off["reflectedPoint"])


def test_look_ups_are_near_the_rays(device, tmp_path):
    mirror = dataclasses.replace(SILVER, textures={"normal": wavy_map(tmp_path, 0.05)})
    board = dataclasses.replace(MATT, base_color=(0.9, 0.2, 0.1))
    room = [(quad(0.35), above(0.8), board), (quad(2.0), np.eye(4), mirror)]
    traced, looked, smooth = (rendered(room, device, bumps=how) for how in ("traced", "lookup", "off"))
    seen = traced["reflectorId"] > 0
    error = np.abs(looked["RGBA"] - traced["RGBA"])[seen].mean()
    left = np.abs(smooth["RGBA"] - traced["RGBA"])[seen].mean()
    assert error < 0.15 * left, (error, left)
    assert 0 < looked.statistics["bumps_traced"] < 0.25 * seen.sum()


def test_broken_maps_leave_the_mirror_smooth(device, tmp_path):
    for name, normal in (("zero.exr", (0.0, 0.0, 0.0)), ("nan.exr", (np.nan, 0.0, 1.0))):
        textures = shown(tmp_path, normal, name).textures
        mirror = dataclasses.replace(SILVER, textures=textures)
        frame = rendered([(quad(2.0), np.eye(4), mirror)], device)
        assert np.isfinite(frame["RGBA"]).all()
        if name == "zero.exr":
            plain = rendered([(quad(2.0), np.eye(4), SILVER)], device)
            np.testing.assert_allclose(frame["RGBA"], plain["RGBA"], atol=1e-6)
    missing = dataclasses.replace(SILVER, textures={"normal": TextureRef(str(tmp_path / "no such.exr"))})
    frame = rendered([(quad(2.0), np.eye(4), missing)], device)
    assert [note for note in frame.scene.notes if "no such.exr" in note.text]
    assert np.isfinite(frame["RGBA"]).all()


def test_plan_says_which_mirrors_are_turned(device, tmp_path):
    mirror = dataclasses.replace(SILVER, textures=shown(tmp_path, TILTED).textures)
    for material, settings, on, why in (
        (SILVER, {}, False, "no normal map"),
        (mirror, {}, True, "a texture of normal, bumps=traced"),
        (mirror, {"bumps": "off"}, False, "bumps=off: it reflects at the surface itself"),
    ):
        effect = rendered([(quad(), np.eye(4), material)], device, **settings).plan.rows[0].effects["normal_map"]
        assert (effect.on, effect.reason) == (on, why)


def test_smooth_mirrors_run_nothing_of_it(device, monkeypatch):
    monkeypatch.setattr(bumps.launch, "launch", bumps.launch.launch)
    with wr.launch.recorded() as launches:
        rendered([(quad(), np.eye(4), SILVER)], device)
    names = [str(name) for name in launches]
    assert names and not [n for n in names if "turn_rays" in n or "mix_coat" in n or "eye_normals" in n]


@pytest.mark.parametrize("glossy", ["gather", "filter", "accumulate"])
def test_coat_over_a_rough_base_is_two_mirrors(glossy):
    """A plane under a known sky: the coat's sharp share of it and the base's lobe of what that leaves."""
    f0, coat, roughness = 0.6, 0.8, 0.3
    material = MaterialData(
        roughness=roughness,
        specular_workflow=True,
        specular_color=(f0,) * 3,
        base_color=(0, 0, 0),
        clearcoat=coat,
        clearcoat_roughness=0.0,
    )
    scene = wall(material, [dome()], half=12.0)
    plan = wr.make_plan(scene, size=SIZE, settings=wr.Settings(glossy=glossy))
    assert plan.rows[0].effects["clearcoat"].on and plan.rows[0].effects["roughness"].on
    frame = wr.render_frame(scene, plan)
    fresnel = lambda f, c: f + (1.0 - f) * (1.0 - c) ** 5  # noqa: E731
    points = frame.relative("mirrorPoint").astype(np.float64)
    for y in range(8, 68, 19):
        for x in range(8, 90, 27):
            view = -points[y, x] / np.linalg.norm(points[y, x])
            lobe, _ = reflected_quadrature(view, roughness, sky, lambda c: fresnel(f0, c), 80, 64)
            upper = coat * fresnel(0.04, view[2])
            mirrored = sky(np.array([[-view[0], -view[1], view[2]]]))[0]
            wanted = upper * mirrored + (1.0 - upper) * lobe
            np.testing.assert_allclose(frame["reflection"][y, x], wanted, atol=0.03 if glossy == "filter" else 0.012)


def test_coat_as_rough_as_its_base_runs_only_if_rough():
    for coat_roughness, roughness, on in ((0.0, 0.0, False), (0.2, 0.0, True), (0.0, 0.2, True)):
        material = MaterialData(
            base_color=(0.8, 0.8, 0.8),
            metallic=1.0,
            roughness=roughness,
            clearcoat=1.0,
            clearcoat_roughness=coat_roughness,
        )
        plan = wr.make_plan(wall(material, [dome()]), size=SIZE)
        assert plan.rows[0].effects["clearcoat"].on == on
