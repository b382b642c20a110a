"""Cube maps of a scene and the environment technique, against float64 look-ups, brute-force rays and the traced picture."""

from __future__ import annotations

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
from rooms import CHROME, placed, render, room, sphere, square

import warp_reflect as wr
from warp_reflect import environment_maps
from warp_reflect.cubemap import RADIANCE_AXES, texel_directions
from warp_reflect.layers import Camera, Reflector
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, Scene, SceneData
from warp_reflect.shadows import asked_shadows
from warp_reflect.techniques import environment

EDGE = 8  # texels along a cube edge of the maps of random texels
CENTRE = np.array([0.3, 0.2, 0.4])


def latlong(rows: int = 16) -> np.ndarray:
    """A smooth map that tells every direction."""
    row, column = np.meshgrid(np.arange(rows) + 0.5, np.arange(2 * rows) + 0.5, indexing="ij")
    lat, lon = (0.5 - row / rows) * np.pi, (1.0 - column / rows) * np.pi
    d = np.stack([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)], -1)
    return (0.5 + 0.4 * d).astype(np.float32)


def random_maps(device, covered: float = 1.0, count: int = 2) -> tuple[Scene, environment_maps.CubeMaps, np.ndarray]:
    rng = np.random.default_rng(0)
    texels = rng.random((count, 6, EDGE, EDGE, 4)).astype(np.float32)
    texels[..., 3] = rng.random(texels.shape[:-1]) < covered
    texels[..., :3] *= texels[..., 3:]
    scene = room(sphere(), placed(0, 0, 0))
    scene = Scene(dataclasses.replace(scene.data, lights=[LightData("/dome", "dome", (1, 1, 1), np.eye(4))]), device)
    maps = environment_maps.stored_maps(
        scene, np.zeros((count, 3)), np.tile(np.eye(3), (count, 1, 1)), texels, texels[..., 3]
    )
    return scene, maps, texels.astype(np.float64)


def some_directions(n: int, seed: int = 1) -> np.ndarray:
    """Unit directions, a third of them within a texel of an edge or a corner of the cube."""
    d = np.random.default_rng(seed).normal(size=(n, 3))
    d /= np.abs(d).max(axis=1, keepdims=True)
    rng = np.random.default_rng(seed + 1)
    for k in range(0, n, 3):
        axis = rng.integers(3)
        d[k, axis] = np.sign(d[k, axis]) * rng.uniform(1.0 - 1.0 / EDGE, 1.0)
        if k % 2:
            d[k] = np.sign(d[k]) * rng.uniform(1.0 - 1.0 / EDGE, 1.0, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def oracle_look_up(texels: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Bilinear look-up of one map in float64: a tap beyond an edge is the texel elsewhere that lies nearest to it."""
    n = texels.shape[1]
    centres = texel_directions(n)
    unit = centres / np.linalg.norm(centres, axis=-1, keepdims=True)
    forward = RADIANCE_AXES[:, 2]
    face = int(np.argmax(forward @ direction))
    right, up, ahead = RADIANCE_AXES[face]
    u, v = right @ direction / (ahead @ direction), -(up @ direction) / (ahead @ direction)
    x, y = (u + 1) / 2 * n - 0.5, (v + 1) / 2 * n - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    taps, weights = [], []
    for row, share_y in ((y0, 1 - (y - y0)), (y0 + 1, y - y0)):
        for column, share_x in ((x0, 1 - (x - x0)), (x0 + 1, x - x0)):
            weights.append(share_x * share_y)
            out = (not 0 <= column < n) + (not 0 <= row < n)
            if out == 0:
                taps.append(texels[face, row, column])
            elif out == 2:
                taps.append(None)
            else:
                d = ahead + ((2 * column + 1) / n - 1) * right - ((2 * row + 1) / n - 1) * up
                near = unit @ (d / np.linalg.norm(d))
                near[face] = -2.0
                taps.append(texels[np.unravel_index(np.argmax(near), near.shape)])
    known = [tap for tap in taps if tap is not None]
    taps = [np.mean(known, axis=0) if tap is None else tap for tap in taps]
    return np.einsum("i,ij->j", weights, np.array(taps))


def sampled(scene, maps, k: int, directions: np.ndarray, level: float = 0.0) -> np.ndarray:
    import warp as wp

    array = wp.array(directions.astype(np.float32), dtype=wp.vec3, device=scene.device)
    return environment_maps.look_up(scene, maps, k, array, level).numpy()


# --- cube maps


def test_faces_lie_as_in_openexr():
    """The rule of OpenEXR's reader, CubeMap::faceAndPixelPosition and pixelPosition, for the middles of texels."""
    n = 4
    d = texel_directions(n)
    x, y, z = d[..., 0], d[..., 1], d[..., 2]
    down = {0: -y, 1: -y, 2: -z, 3: z, 4: -y, 5: -y}
    along = {0: z, 1: -z, 2: x, 3: x, 4: -x, 5: x}
    line = (np.arange(n) + 0.5) / n * 2 - 1
    for face in range(6):
        np.testing.assert_allclose(down[face][face], np.tile(line[:, None], (1, n)), atol=1e-12)
        np.testing.assert_allclose(along[face][face], np.tile(line, (n, 1)), atol=1e-12)
        axis, sign = face // 2, 1 - 2 * (face % 2)
        assert (d[face, ..., axis] == sign).all()


def test_look_up_is_bilinear_over_edges_and_corners(device):
    scene, maps, texels = random_maps(device)
    directions = some_directions(600)
    for k in range(maps.count):
        expected = np.array([oracle_look_up(texels[k], d) for d in directions])
        np.testing.assert_allclose(sampled(scene, maps, k, directions), expected[:, :3], atol=2e-6)


def test_look_up_has_no_seams(device):
    """Either side of every edge, and around every corner, the values meet."""
    scene, maps, _ = random_maps(device)
    rng = np.random.default_rng(2)
    for corner in (False, True):
        d = rng.uniform(-1, 1, (300, 3))
        for row in d:
            axes = rng.permutation(3)[: 3 if corner else 2]
            row[axes] = np.sign(row[axes])
        step = 1e-5 * rng.normal(size=d.shape)
        a, b = (sampled(scene, maps, 0, x / np.linalg.norm(x, axis=1, keepdims=True)) for x in (d + step, d - step))
        # A texel is 2 / EDGE wide, its values at most 1 apart.
        assert np.abs(a - b).max() < EDGE * 1e-4


def test_axes_of_a_map_turn_it(device):
    scene, maps, texels = random_maps(device)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = environment_maps.stored_maps(scene, np.zeros((1, 3)), turn[None], texels[:1], texels[:1, ..., 3])
    directions = some_directions(60)
    np.testing.assert_allclose(
        sampled(scene, turned, 0, directions @ turn.T), sampled(scene, maps, 0, directions), atol=1e-6
    )


def test_sky_is_the_dome_itself(device):
    """What is not covered shows the dome from the very direction: no texel of the map blurs it."""
    scene, _, texels = random_maps(device, covered=0.4)
    lights = [LightData("/dome", "dome", (1, 1, 1), np.eye(4), latlong())]
    scene = Scene(dataclasses.replace(scene.data, lights=lights), device)
    eyes, axes = np.zeros((1, 3)), np.eye(3)[None]
    maps = environment_maps.stored_maps(scene, eyes, axes, texels[:1], texels[:1, ..., 3])
    none = environment_maps.stored_maps(scene, eyes, axes, 0 * texels[:1], 0 * texels[:1, ..., 3])
    directions = some_directions(300)
    expected = np.array([oracle_look_up(texels[0], d) for d in directions])
    dome = sampled(scene, none, 0, directions)
    assert np.abs(dome - (0.5 + 0.4 * directions)).max() < 0.03
    np.testing.assert_allclose(
        sampled(scene, maps, 0, directions), expected[:, :3] + (1 - expected[:, 3:]) * dome, atol=3e-6
    )


def brute_force(scene: Scene, eye: np.ndarray, directions: np.ndarray, gone=()) -> tuple[np.ndarray, np.ndarray]:
    """(triangle, distance) of the first hits in float64, -1 and inf where there is none."""
    corners = scene.host_points[scene.host_triangles].astype(np.float64) - (eye - scene.origin)
    corners[list(gone)] = np.nan
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    triangle, nearest = np.full(len(directions), -1), np.full(len(directions), np.inf)
    normal = np.cross(b - a, c - a)
    for i, d in enumerate(directions):
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.einsum("ij,ij->i", normal, a) / (normal @ d)
            p = t[:, None] * d
            sides = [np.einsum("ij,ij->i", normal, np.cross(y - x, p - x)) for x, y in ((a, b), (b, c), (c, a))]
            inside = (np.min(sides, axis=0) >= 0) & (t > 0)
        if inside.any():
            triangle[i] = np.flatnonzero(inside)[np.argmin(t[inside])]
            nearest[i] = t[triangle[i]]
    return triangle, nearest


def test_maps_hold_what_rays_from_their_eyes_meet(device):
    scene = room(sphere(8, 12), placed(0, 0, 0), floor_cells=4)
    scene = Scene(dataclasses.replace(scene.data), device)
    eyes = np.array([CENTRE + [0, 0.9, 1.0], [-1.5, 0.4, 2.0]])
    maps = environment_maps.render_maps(scene, eyes, 8, without=[(0,), ()])
    own = range(scene.parts[0].triangle_count)
    directions = texel_directions(8).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for k, eye in enumerate(eyes):
        triangle, distance = brute_force(scene, eye, directions, own if k == 0 else ())
        same = maps.triangle(k).reshape(-1) == triangle
        assert same.mean() > 0.99  # texels whose middle lies within 1/512 of an edge
        found = maps.distance(k).reshape(-1)
        hit = same & (triangle >= 0)
        np.testing.assert_allclose(found[hit], distance[hit], rtol=2e-5)
        assert (found[triangle < 0] == 0.0).mean() > 0.99 and hit.sum() > 150
    assert not np.isin(maps.triangle(0), list(own)).any() and np.isin(maps.triangle(1), list(own)).any()


def test_maps_are_shaded_as_pictures_are(device):
    """Each face is the picture of its camera: matt things, the dome, a light and its shadows, textures off."""
    base = room(sphere(), placed(0, 0, 0)).data
    lights = [
        LightData("/dome", "dome", (0.5, 0.6, 0.7), np.eye(4)),
        LightData("/sun", "distant", (2, 2, 1), np.eye(4)),
    ]
    scene = Scene(dataclasses.replace(base, lights=lights, materials=[MaterialData()] * 2), device)
    n, eye = 24, CENTRE + [0, 1.2, 1.5]
    maps = environment_maps.render_maps(scene, eye[None], n, shadows=asked_shadows(scene, wr.Settings()))
    for face in (0, 3, 5):
        right, up, forward = RADIANCE_AXES[face]
        camera = Camera(eye, right, up, forward, n / 2, n / 2, n / 2, n / 2, 1e-3, 1e3, (n, n))
        plan = wr.make_plan(scene, camera, (n, n))
        picture = wr.render_frame(scene, plan)["RGBA"]
        covered = picture[..., 3] > 0
        assert covered.any()
        np.testing.assert_allclose(maps.radiance(0)[face][covered][:, :3], picture[covered][:, :3], atol=3e-6)
        np.testing.assert_array_equal(maps.radiance(0)[face][..., 3], picture[..., 3])


@pytest.mark.parametrize("edge", [1, 5, 8, 12])
def test_coarser_levels_keep_the_mean(edge, device):
    scene = room(sphere(8, 12), placed(0, 0, 0), floor_cells=4)
    scene = Scene(dataclasses.replace(scene.data), device)
    maps = environment_maps.render_maps(scene, CENTRE[None] + [0, 1, 1], edge, levels=True)
    levels = maps.view.level_count
    assert maps.radiance(0, levels - 1).shape == (6, 1, 1, 4)
    finest = maps.radiance(0).astype(np.float64).mean(axis=(1, 2))
    for level in range(levels):
        np.testing.assert_allclose(maps.radiance(0, level).mean(axis=(1, 2)), finest, rtol=1e-5, atol=1e-6)
    directions = some_directions(50)
    between = sampled(scene, maps, 0, directions, 0.25)
    ends = [sampled(scene, maps, 0, directions, float(level)) for level in (0, 1)]
    np.testing.assert_allclose(between, 0.75 * ends[0] + 0.25 * ends[1] if levels > 1 else ends[0], atol=1e-5)


def test_packed_maps_are_four_bytes_a_texel_and_near(device):
    scene = room(sphere(), placed(0, 0, 0))
    scene = Scene(dataclasses.replace(scene.data), device)
    maps = environment_maps.render_maps(scene, np.array([CENTRE, CENTRE + [0, 1, 1.5]]) + [0, 0.5, 1.5], 32)
    packed = environment_maps.pack_maps(maps)
    # 54 maps of 128^2 in 22 MB: 4 bytes a texel and the palettes.
    assert packed.bytes == 2 * (6 * 32 * 32 * 4 + 1024 * 8)
    assert 54 * (6 * 128 * 128 * 4 + 1024 * 8) <= 22e6
    directions = some_directions(400)
    for k in range(2):
        a, b = sampled(scene, maps, k, directions), sampled(scene, packed, k, directions)
        assert np.abs(a - b).max() < 0.02 * max(a.max(), 1e-6)
    black = environment_maps.stored_maps(
        scene, np.zeros((1, 3)), np.eye(3)[None], np.zeros((1, 6, 4, 4, 4)), np.ones((1, 6, 4, 4))
    )
    assert not sampled(scene, environment_maps.pack_maps(black), 0, directions).any()


def test_values_that_are_no_numbers_are_black(device):
    scene, _, _ = random_maps(device)
    lights = [LightData("/sun", "distant", (np.inf, np.nan, 1e38), np.eye(4))]
    bad = Scene(dataclasses.replace(scene.data, lights=lights), device)
    maps = environment_maps.render_maps(bad, CENTRE[None] + [0, 1, 1], 8)
    assert np.isfinite(maps.radiance(0)).all() and np.isfinite(maps.distance(0)).all()


@pytest.mark.parametrize("edge", [0, 5000])
def test_impossible_maps_are_refused(edge, device):
    scene = room(sphere(8, 12), placed(0, 0, 0))
    with pytest.raises(ValueError, match="resolution"):
        environment_maps.render_maps(scene, np.zeros((1, 3)), edge)
    with pytest.raises(ValueError, match="centres"):
        environment_maps.render_maps(scene, np.full((1, 3), np.nan), 8)


# --- the technique


def hall(size: float) -> Scene:
    """A mirror ball in the middle of a box of coloured squares, `size` times its radius wide."""
    wall = square(6, 1.0)
    rng = np.random.default_rng(3)
    colors = rng.random((len(wall.triangles) * 3, 3)).astype(np.float32)
    index = np.arange(len(wall.triangles) * 3, dtype=np.int32).reshape(-1, 3)
    wall = dataclasses.replace(wall, colors=np.repeat(colors[::6], 6, axis=0)[: len(colors)], color_index=index)
    walls = []
    for axis in range(3):
        for side in (-1, 1):
            m = np.eye(4)
            turn = np.roll(np.eye(3), axis + 2, axis=0)
            m[:3, :3] = turn * size
            m[axis, 3] = 0
            normal = m[:3, :3] @ [0, 1, 0]
            m[:3, 3] = side * normal
            walls.append(InstanceData(1, m, f"/wall{axis}{side}", (1,)))
    return Scene(
        SceneData(
            "hall",
            [sphere(), wall],
            [InstanceData(0, np.eye(4), "/mirror", (0,)), *walls],
            [CHROME, MaterialData(uses_vertex_color=True)],
            [LightData("/dome", "dome", (1, 1, 1), np.eye(4))],
            [CameraData("/camera", placed(0.0, 0.0, 1.9), near=0.01, focal_length=12.0)],
        )
    )


def test_error_falls_with_the_distance_of_what_is_seen():
    errors, predicted = [], []
    for size in (2.0, 8.0, 32.0, 128.0):
        scene = hall(size)
        frame = render(scene, "environment", environment_resolution=128)
        traced = render(scene, "reference")
        mirror = frame["reflectorId"] > 0
        assert mirror.sum() > 3000
        errors.append(np.abs(frame["RGBA"] - traced["RGBA"])[mirror].mean())
        predicted.append(frame.plan.rows[0].predicted["error_px"])
    assert (np.diff(errors) < 0).all() and errors[-1] < 0.15 * errors[0], errors
    assert (np.diff(predicted) < 0).all() and predicted[-1] < 0.5 < 5.0 < predicted[0], predicted


@pytest.mark.parametrize("size", [2.5, 12.0])
def test_parallax_is_what_solving_for_the_shown_points_finds(size):
    """Where the exact mirror shows the points that the map shows at the pixels, in float64."""
    scene = hall(size)
    frame = render(scene, "reference", size=(96, 54))
    layer = frame.layers[1]
    point, ray = (a.numpy().astype(np.float64) for a in (layer.pixels.point, layer.pixels.direction))
    triangle, t = brute_force(scene, scene.origin, ray, range(scene.parts[0].triangle_count))
    shown = t[:, None] * ray
    inside = triangle >= 0
    camera = frame.camera
    solved = wr.solve(wr.QuadricMirror.sphere((0, 0, 0), 1.0), camera.eye, shown[inside])
    good = solved.status == wr.Status.CONVERGED

    def place(p):
        q = p - camera.eye
        depth = q @ camera.forward
        return np.stack([camera.fx * (q @ camera.right) / depth, -camera.fy * (q @ camera.up) / depth], -1)

    error = np.linalg.norm(place(solved.point) - place(point[inside] + scene.origin), axis=1)[good]
    predicted = environment.parallax_px(scene, Reflector(1, 0, True), camera)
    assert good.mean() > 0.9 and predicted == pytest.approx(np.quantile(error, 0.99), rel=0.3)


def test_answers_are_sky_with_their_method():
    frame = render(room(sphere(), placed(0, 0, 0)), "environment", environment_resolution=32)
    mirror = frame["reflectorId"] > 0
    assert (frame["status"][mirror] == wr.Status.SKY).all()
    assert (frame["method"][mirror] == wr.Technique.ENVIRONMENT).all()
    for name in ("reflectedPoint", "reflectedId", "pathLength", "residual"):
        assert not frame[name].any(), name
    assert (frame["reflection"][mirror] > 0).any() and all(np.isfinite(frame[name]).all() for name in frame.keys())
    row = frame.plan.rows[0]
    assert row.predicted["bytes"] == 6 * 32 * 32 * 24 and not row.effects["refinement"].on
    assert frame.plan.prepared(row).maps.bytes == row.predicted["bytes"]


def test_orthographic_eyes_look_maps_up():
    scene = room(sphere(), placed(0, 0, 0))
    flat = dataclasses.replace(scene.data.cameras[0], projection="orthographic", horizontal_aperture=40.0)
    scene = Scene(dataclasses.replace(scene.data, cameras=[flat]))
    frame = render(scene, "environment", environment_resolution=32)
    assert frame.plan.rows[0].technique == "environment" and (frame["method"] == wr.Technique.ENVIRONMENT).any()


def test_maps_of_every_frame_are_those_prepared():
    scene = room(sphere(), placed(0, 0, 0))
    static = render(scene, "environment", environment_resolution=32)
    every = render(scene, "environment", environment_resolution=32, environment_update="frame")
    np.testing.assert_array_equal(static["RGBA"], every["RGBA"])
    assert every.statistics["environment_maps"] == 1 and "environment_maps" not in static.statistics
    assert every.plan.prepared(every.plan.rows[0]).maps is None


def test_threads_do_not_change_a_map():
    scene = room(sphere(), placed(0, 0, 0))
    one, two = (render(scene, "environment", environment_resolution=32, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one["RGBA"], two["RGBA"])


def test_mirror_alone_shows_the_sky():
    data = room(sphere(), placed(0, 0, 0)).data
    lights = [LightData("/dome", "dome", (1, 1, 1), np.eye(4), latlong())]
    scene = Scene(dataclasses.replace(data, instances=data.instances[:1], lights=lights))
    frame, traced = (render(scene, method, environment_resolution=16) for method in ("environment", "reference"))
    np.testing.assert_allclose(frame["RGBA"], traced["RGBA"], atol=1e-5)


def test_what_is_not_asked_for_is_not_loaded():
    script = (
        "import sys; sys.path.insert(0, 'tests'); from rooms import *; "
        "render(room(sphere(8, 12), placed(0, 0, 0)), 'raytraced', size=(32, 18)); "
        "import warp_reflect.environment_maps as m; print(m.sample_kernel.module.execs, "
        "'warp_reflect.techniques.mirror_maps' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip().splitlines()[-1] == "{} False"
