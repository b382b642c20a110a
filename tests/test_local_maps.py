"""Local maps that are made together are what each is alone, bit for bit, whatever else is made with them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import warp_reflect as wr
from warp_reflect import launch
from warp_reflect.scene import LightData, Scene
from warp_reflect.techniques import layered_environment, local_shading
from warp_reflect.techniques.local_maps import LINES, LocalMaps, layout
from warp_reflect.vector import BLOCK

STAGE = Path(__file__).parents[1] / "usd_scenes" / "city_block.usda"
SETTINGS = wr.Settings(environment_resolution=32, local_rays="field", field_kind="heightfield", bounces=1, threads=1)


class Named:
    def __init__(self, part: int):
        self.part = part


@pytest.fixture(scope="module")
def block():
    return wr.load_stage(str(STAGE), time=12.0)


def mirrors(scene) -> list[int]:
    found = [k for k in scene.moving_parts if scene.data.materials[scene.parts[k].material].metallic > 0.5]
    assert len(found) >= 3
    return found


def arrays(made) -> list[np.ndarray]:
    view = made.local.view
    return [each.numpy() for each in (made.state, view.triangle, view.distance, view.radiance)]


def forget(scene) -> None:
    kept = layered_environment.KEY, layered_environment.SHOWN_KEY
    for key in [key for key in scene.environments if key[0] in kept]:
        del scene.environments[key]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"local_shade_step": 2, "kernels": "plain"},
        {"bounces": 2},
        {"local_keep_px": 2.0, "local_shade_step": 3},
        {"local_rays": "exact"},
        {"rem_missing": "best", "rem_count": 3},
    ],
)
def test_maps_made_together_are_those_made_alone(block, changes):
    settings, parts = SETTINGS.replace(**changes), mirrors(block)
    # Of several sizes, rows of no whole number of vectors and a map twice among them.
    edges = [32, 21, 16, 32][: len(parts)]
    asked = [(Named(part), settings.replace(local_resolution=n)) for part, n in zip(parts, edges, strict=False)]
    asked.append(asked[0])
    forget(block)
    together = layered_environment.prepare_together(block, asked)
    shaded = moving = 0
    for (reflector, own), made in zip(asked, together, strict=True):
        forget(block)
        alone = layered_environment.prepare(block, reflector, own)
        for ours, its in zip(arrays(made), arrays(alone), strict=True):
            np.testing.assert_array_equal(ours, its)
        assert made.statistics == alone.statistics
        np.testing.assert_array_equal(made.centre, alone.centre)
        shaded += made.statistics["rem_shaded"]
        moving += made.statistics["local_moving"]
    assert moving > 0 and (shaded > 0) == (settings.rem_missing == "shade")
    forget(block)


@pytest.mark.parametrize("edge", [32, 22])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_vectors_find_and_shade_what_single_texels_do(block, edge, step):
    """What moves and what is shaded is the same; their colours within roundings of what is seen where."""
    common = SETTINGS.replace(local_resolution=edge, local_shade_step=step)
    parts, found = mirrors(block), []
    for kernels in ("plain", "auto"):
        forget(block)
        asked = [(Named(part), common.replace(kernels=kernels)) for part in parts]
        found.append(layered_environment.prepare_together(block, asked))
    moving = 0
    for plain, vector in zip(*found, strict=True):
        (state, triangle, distance, radiance), other = arrays(plain), arrays(vector)
        same = (state == other[0]) & (triangle == other[1])
        assert (~same).mean() < 2e-3
        np.testing.assert_allclose(other[2][same], distance[same], rtol=1e-5)
        off = np.abs(other[3] - radiance)[same].max(-1)
        assert np.quantile(off, 0.99) < 1e-3 and off.mean() < 1e-3
        assert abs(plain.statistics["local_moving"] - vector.statistics["local_moving"]) <= 2
        moving += plain.statistics["local_moving"]
    assert moving > 50
    forget(block)


def test_soft_shadows_and_their_noise_are_those_of_a_map_alone(block):
    """They look at neighbouring texels: beyond the first face as well, of which there is more than a square's."""
    lamp = LightData("/lamp", "sphere", (900.0, 800.0, 700.0), np.eye(4), size=(2.0,))
    place = np.eye(4)
    place[:3, 3] = block.origin + [0.0, 30.0, 0.0]
    data = dataclasses.replace(
        block.data, lights=[*block.data.lights, dataclasses.replace(lamp, world_from_light=place)]
    )
    scene = Scene(data, "cpu")
    settings = SETTINGS.replace(rem_blur_px=0.25, shadows="on")
    asked = [(Named(part), settings) for part in mirrors(scene)[:2]]
    together = layered_environment.prepare_together(scene, asked)
    for (reflector, own), made in zip(asked, together, strict=True):
        forget(scene)
        alone = layered_environment.prepare(scene, reflector, own)
        assert made.statistics["rem_shaded"] > 32 * 32
        for ours, its in zip(arrays(made), arrays(alone), strict=True):
            np.testing.assert_array_equal(ours, its)


def test_launches_do_not_grow_with_the_number_of_maps(block):
    def launched(parts) -> int:
        forget(block)
        with launch.recorded() as launches:
            layered_environment.prepare_together(block, [(Named(part), SETTINGS) for part in parts])
        return len(launches)

    parts = mirrors(block)
    launched(parts)  # what is made at first use
    assert launched(parts) == launched(parts[:1]) < 20


def test_a_frame_makes_its_maps_together_and_thread_by_thread_the_same(block):
    pictures = []
    for threads in (1, 3):
        settings = SETTINGS.replace(threads=threads, local_shade_step=2)
        plan = wr.make_plan(block, size=(160, 90), settings=settings, method="layered_environment")
        forget(block)
        with launch.recorded() as launches:
            pictures.append(wr.render_frame(block, plan)["RGBA"])
        assert sum(".moving_t" in name for name, _ in launches) == 1
    np.testing.assert_array_equal(*pictures)
    forget(block)


def test_kept_maps_do_not_hold_the_memory_of_those_they_were_made_with(block):
    settings = SETTINGS.replace(local_keep_px=50.0)
    parts = mirrors(block)
    made = layered_environment.prepare_together(block, [(Named(part), settings) for part in parts])
    later = block.at(12.05)
    layered_environment.take_over(block, later)
    kept = [later.environments[layered_environment.KEY, part, settings] for part in parts]
    for own, before in zip(kept, made, strict=True):
        assert not own.together and own.statistics["local_kept"] == 1
        assert own.local.view.radiance.ptr != before.local.view.radiance.ptr
        np.testing.assert_array_equal(own.local.view.triangle.numpy() >= 0, own.local.view.distance.numpy() > 0)
    forget(block)


@pytest.mark.parametrize("resolutions", [(4,), (128, 5, 33, 8), (16, 16)])
def test_every_texel_line_and_row_knows_its_map(resolutions):
    where = layout(resolutions, "cpu")
    of_block, of_group, of_row = (each.numpy() for each in (where.block_map, where.group_map, where.row_map))
    for k, n in enumerate(resolutions):
        texels = where.texels(k)
        assert texels.start % BLOCK == 0 and texels.stop - texels.start == 6 * n * n
        assert (of_block[texels.start // BLOCK : (texels.stop - 1) // BLOCK + 1] == k).all()
        assert (of_group == k).sum() * LINES >= 4 * n and of_group[where.first_group[k]] == k
        assert (of_row == k).sum() == 6 * n and of_row[where.first_row[k]] == k
    assert where.texel_count == len(of_block) * BLOCK


def test_a_map_that_is_put_among_others_is_the_same(block):
    made = layered_environment.prepare(block, Named(mirrors(block)[0]), SETTINGS)
    maps = LocalMaps.empty(block, np.tile(made.centre, (2, 1)), [16, 32])
    maps.put(1, made.local, made.state)
    cube, state = maps.cube_map(1)
    np.testing.assert_array_equal(cube.radiance(0), made.local.radiance(0))
    np.testing.assert_array_equal(cube.triangle(0), made.local.triangle(0))
    np.testing.assert_array_equal(state.numpy(), made.state.numpy())
    assert not (state.numpy() == local_shading.TEXEL_MOVING).any()
    forget(block)
