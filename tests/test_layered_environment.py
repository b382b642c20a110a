"""Local maps from reference environment maps, against float64 weights, planes and walls, redrawn maps and the traced picture."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from rooms import placed, render, room, sphere, square
from test_environment import hall

import warp_reflect as wr
from warp_reflect import environment_maps
from warp_reflect.cubemap import texel_directions
from warp_reflect.environment_maps import CubeMapsView
from warp_reflect.scene import EnvironmentMapData, InstanceData, LightData, MaterialData, Scene
from warp_reflect.techniques import local_map
from warp_reflect.techniques.local_map import REMS_MAX, RemWeights

wp.set_module_options({"enable_backward": False})

ROUNDING = float(np.finfo(np.float32).eps) / 2


@wp.kernel
def weights_kernel(
    maps: CubeMapsView,
    rems: wp.array(dtype=int),
    used: int,
    eye: wp.vec3,
    point: wp.array(dtype=wp.vec3),
    valid: wp.array(dtype=RemWeights),
    out_weights: wp.array(dtype=RemWeights),
):
    i = wp.tid()
    out_weights[i] = local_map.rem_weights(maps, rems, used, eye, point[i], valid[i])


@wp.kernel
def normalised_kernel(
    weights: wp.array(dtype=RemWeights),
    valid: wp.array(dtype=RemWeights),
    prior: wp.array(dtype=RemWeights),
    count: int,
    out_weights: wp.array(dtype=RemWeights),
):
    i = wp.tid()
    out_weights[i] = local_map.normalised(weights[i], count, valid[i], prior[i])


@wp.kernel
def sees_kernel(
    maps: CubeMapsView,
    normal: wp.array(dtype=wp.vec3),
    point: wp.array(dtype=wp.vec3),
    out_seen: wp.array(dtype=wp.uint8),
):
    i = wp.tid()
    out_seen[i] = wp.uint8(local_map.sees_point(maps, 0, point[i], normal[i], 0.0))


def empty_scene(device="cpu", lights=()) -> Scene:
    data = room(sphere(8, 12), placed(0, 0, 0)).data
    return Scene(dataclasses.replace(data, lights=list(lights)), device)


def uniform_maps(scene: Scene, centres, colors=None, distance: float = 1e6, edge: int = 8):
    """Maps of one colour each, everything at one distance."""
    centres = np.asarray(centres, np.float64)
    radiance = np.ones((len(centres), 6, edge, edge, 4), np.float32)
    if colors is not None:
        radiance[..., :3] = np.asarray(colors, np.float32)[:, None, None, None]
    distances = np.full(radiance.shape[:-1], distance, np.float32)
    axes = np.tile(np.eye(3), (len(centres), 1, 1))
    return environment_maps.stored_maps(scene, centres, axes, radiance, distances)


def weights_of(centres, points, valid=None, used: int = 2, eye=(0, 0, 0), device="cpu") -> np.ndarray:
    """Weights float32 [points, maps]."""
    scene = empty_scene(device)
    count, points = len(centres), np.asarray(points, np.float32)
    maps = uniform_maps(scene, np.asarray(centres, np.float64) + scene.origin)
    known = np.zeros((len(points), REMS_MAX), np.float32)
    known[:, :count] = 1.0 if valid is None else valid
    arrays = [wp.array(points, dtype=wp.vec3, device=device), wp.array(known, dtype=RemWeights, device=device)]
    out = wp.empty(len(points), dtype=RemWeights, device=device)
    rems = wp.array(np.arange(count), dtype=int, device=device)
    wp.launch(weights_kernel, len(points), [maps.view, rems, used, wp.vec3(*eye), *arrays, out], device=device)
    return out.numpy()[:, :count]


def two_map_weights(centres, points, valid) -> np.ndarray:
    """The paper's weights, W_A = 1 - |C_A I_p| / |C_A C_B| with the sign of I_p and clamped, in float64."""
    a, b = np.asarray(centres, np.float64)
    axis = b - a
    square = axis @ axis
    share = np.clip((points - a) @ axis / square, 0, 1) if square > 0 else np.full(len(points), 0.5)
    before = np.stack([1 - share, share], 1)
    after = before * valid
    total = after.sum(1, keepdims=True)
    lost = total[:, 0] <= 1e-6
    after[~lost] /= total[~lost]
    # Without a share the one that sees the point; where none does, the one that weighed most.
    known = np.where(valid.any(1, keepdims=True), np.where(valid > 0, before, -1), before)
    after[lost] = np.eye(2)[known[lost].argmax(1)]
    return after


# --- the rows E01 to E08 of the hard cases


def test_maps_at_one_place_share_alike(device):
    """E01."""
    found = weights_of([[1, 2, 3], [1, 2, 3]], np.random.default_rng(0).normal(size=(200, 3)), device=device)
    np.testing.assert_array_equal(found, 0.5)
    # Coincident within roundings, and the point at both.
    close = weights_of([[1, 2, 3], [1, 2, 3 + 2e-7]], [[1, 2, 3], [5, 5, 5], [1, 2, 1e30]], device=device)
    assert np.isfinite(close).all()
    np.testing.assert_allclose(close.sum(1), 1.0, atol=4 * ROUNDING)


def test_weights_add_up_to_one_beyond_the_axis(device):
    """E02: 1/2 and 0 by unsigned distances."""
    centres = [[-1.0, 0.3, 0.0], [2.0, 0.1, 0.5]]
    rng = np.random.default_rng(1)
    points = rng.normal(size=(2000, 3)).astype(np.float32) * 10.0 ** rng.uniform(-2, 4, (2000, 1)).astype(np.float32)
    valid = rng.integers(0, 2, (2000, 2)).astype(np.float32)
    found = weights_of(centres, points, valid, device=device)
    np.testing.assert_allclose(found, two_map_weights(centres, points.astype(np.float64), valid), atol=2e-6)
    np.testing.assert_allclose(found.sum(1), 1.0, atol=4 * ROUNDING)
    beyond = weights_of([[0, 0, 0], [1, 0, 0]], [[-0.5, 1, 0], [1.5, 1, 0]], device=device)
    np.testing.assert_array_equal(beyond, [[1, 0], [0, 1]])


def behind_a_screen(missing: str, device="cpu", **settings) -> tuple:
    """A mirror ball in a box; its only reference map is behind a wall that spans the box."""
    base = hall(3.0)
    screen = np.eye(4)
    screen[:3, :3] = [[0, 1, 0], [1, 0, 0], [0, 0, 1]]
    screen[:3, 3] = 2.0, 0, 0
    mesh = square(2, 3.0)
    data = dataclasses.replace(
        base.data,
        meshes=[*base.data.meshes, mesh],
        materials=[*base.data.materials, MaterialData(base_color=(0.8, 0.2, 0.2))],
        instances=[*base.data.instances, InstanceData(2, screen, "/screen", (2,))],
        environment_maps=[EnvironmentMapData("/there", placed(2.5, 0.1, 0.2))],
    )
    scene = Scene(data, device)
    options = {"environment_resolution": 64, "rem_missing": missing, "rem_texels": "full"} | settings
    return scene, render(scene, "layered_environment", **options)


def test_what_no_map_sees_is_shaded_or_flagged():
    """E03: never black; where the best map is shown all the same the pixel says so."""
    scene, best = behind_a_screen("best")
    mirror = best["reflectorId"] > 0
    assert (best["status"][mirror] == wr.Status.HIDDEN).mean() > 0.99
    assert (best["reflection"][mirror].max(-1) > 0.01).all()
    assert best.statistics["rem_missing"] == best.statistics["rem_texels"] == 6 * 64 * 64
    _, shaded = behind_a_screen("shade")
    traced = render(scene, "reference")
    assert shaded.statistics["rem_shaded"] == shaded.statistics["rem_missing"] > 0
    error = np.abs(shaded["RGBA"] - traced["RGBA"])[mirror].max(-1)
    assert np.median(error) < 0.01 and (shaded["status"][mirror] == wr.Status.CONVERGED).mean() > 0.95
    assert np.median(np.abs(best["RGBA"] - traced["RGBA"])[mirror].max(-1)) > 5 * np.median(error)


def blended(scene: Scene, maps, mesh, rems=(0, 1), **settings):
    settings = wr.Settings(environment_resolution=mesh.inverse.shape[1], **settings)
    centre = scene.origin.copy()
    return local_map.blend_local_map(scene, centre, mesh, no_rays, maps, np.array(rems), settings)


def no_rays(directions):
    return np.zeros(len(directions), np.float32), np.full(len(directions), -1, np.int32)


def mesh_at(depth: float, edge: int) -> local_map.DepthMesh:
    """Everything at one depth along the faces' axes, all texels traced."""
    mesh = local_map.DepthMesh.empty(edge)
    mesh.inverse[:], mesh.traced[:] = 1.0 / depth, True
    return mesh


def test_point_at_the_eye_of_a_map_is_seen_by_the_other(device):
    """E04."""
    scene = empty_scene(device)
    edge, depth = 8, 2.0
    texel = (0, 3, 5)
    at = texel_directions(edge)[texel] * depth
    maps = uniform_maps(scene, np.array([at, [-1, 0, 0]]) + scene.origin, [[1, 0, 0], [0, 0, 1]])
    local, _, _ = blended(scene, maps, mesh_at(depth, edge), rem_missing="best")
    radiance = local.radiance(0)
    assert np.isfinite(radiance).all()
    np.testing.assert_allclose(radiance[texel][:3], [0, 0, 1], atol=1e-6)
    alone, _, statistics = blended(scene, maps, mesh_at(depth, edge), rems=(0,), rem_missing="best")
    np.testing.assert_allclose(alone.radiance(0)[..., :3], np.broadcast_to([1, 0, 0], (6, edge, edge, 3)), atol=1e-6)
    assert statistics["rem_missing"] == 1  # itself: it has no direction


@pytest.mark.parametrize("angle", [0.0, 60.0, 80.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e5])
def test_surface_seen_at_an_angle_does_not_hide_itself(scale, angle, device):
    """E05: points of a plane within 1/4 texel of the texels' middles are all seen, points behind it are not."""
    scene = empty_scene(device)
    edge, rng = 64, np.random.default_rng(3)
    normal = np.array([-np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0])
    offset = normal @ [2.0 * scale, 0, 0]
    directions = texel_directions(edge).astype(np.float64)
    with np.errstate(divide="ignore"):
        along = offset / (directions @ normal)
    length = np.linalg.norm(directions, axis=-1)
    distance = np.where(along > 0, along * length, 0.0)
    centre = scene.origin[None]
    radiance = np.ones((1, 6, edge, edge, 4), np.float32)
    maps = environment_maps.stored_maps(scene, centre, np.eye(3)[None], radiance, distance[None].astype(np.float32))
    # The middle of the face that looks at it: incidence at the middle is `angle`.
    middle = directions[0, edge // 2 - 3 : edge // 2 + 3, edge // 2 - 3 : edge // 2 + 3].reshape(-1, 3)
    jitter = np.zeros((200, 3))
    jitter[:, 1:] = rng.uniform(-0.25, 0.25, (200, 2)) * 2 / edge
    rays = (middle[:, None] + jitter).reshape(-1, 3)
    points = rays * (offset / (rays @ normal))[:, None]

    def seen(points, side=1.0):
        normals = np.tile(side * normal, (len(points), 1))
        arrays = (wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (normals, points))
        out = wp.empty(len(points), dtype=wp.uint8, device=device)
        wp.launch(sees_kernel, len(points), [maps.view, *arrays, out], device=device)
        return out.numpy() == 1

    normal = -np.sign(offset) * normal  # towards the map
    assert seen(points).all()
    # The slack is 0.75 texels of slope and 0.002; what a texel holds is half a texel of slope off.
    cosine = -(rays @ normal) / np.linalg.norm(rays, axis=1)
    slope = np.sqrt(1.0 - cosine**2) / cosine
    assert not seen(points * (1.01 + 1.5 * (2.0 / edge) * slope)[:, None]).any()
    assert not seen(points, side=-1.0).any()  # its other side


def test_sky_has_no_distance_and_no_weights(device):
    """E06: sky in the reference maps hides nothing, sky in the local map is the dome."""
    scene = empty_scene(device, [LightData("/dome", "dome", (0.2, 0.4, 0.6), np.eye(4))])
    maps = uniform_maps(scene, np.array([[1, 0, 0], [-1, 0, 0]]) + scene.origin, distance=0.0)
    half = mesh_at(2.0, 8)
    half.inverse[:3] = 0.0
    local, state, statistics = blended(scene, maps, half)
    radiance, distance = local.radiance(0), local.distance(0)
    assert np.isfinite(radiance).all() and np.isfinite(distance).all()
    assert not distance[:3].any() and not radiance[:3].any() and (distance[3:] > 0).all()
    assert statistics["rem_missing"] == 0 and (state.numpy().reshape(6, -1)[:3] == local_map.TEXEL_SKY).all()


def test_weights_that_vanish_are_one_maps(device):
    """E07: W = (0, 1e-38) after a map is dropped."""
    weights, valid, prior = (np.zeros((3, REMS_MAX), np.float32) for _ in range(3))
    weights[0, 1], valid[0, 1], prior[0] = 1e-38, 1, 0
    prior[0, :2] = 1, 1e-38
    prior[1, :2] = 0.3, 0.7  # none is valid
    weights[2, :2], valid[2, :2], prior[2, :2] = 1e-38, 1, 1e-38
    arrays = [wp.array(a, dtype=RemWeights, device=device) for a in (weights, valid, prior)]
    out = wp.empty(3, dtype=RemWeights, device=device)
    wp.launch(normalised_kernel, 3, [*arrays, 2, out], device=device)
    np.testing.assert_array_equal(out.numpy()[:, :2], [[0, 1], [0, 1], [1, 0]])
    # As it comes about: the point lies at A, which does not see it.
    np.testing.assert_array_equal(weights_of([[0, 0, 0], [1, 0, 0]], [[0, 1, 0]], [[0, 1]], device=device), [[0, 1]])


@pytest.mark.parametrize("near", [0.0, 1e-30, 3.0, 1e30])
def test_edges_against_the_sky_are_refined_at_any_depth(near, device):
    """E08: Z = 0 and no Z at all give no NaN; every texel at the border has a ray of its own."""

    def intersect(directions):
        hit = directions @ np.array([0.6, 0.5, 0.62]) > 0.1
        distance = np.where(hit, np.float32(near), np.float32(0.0))
        return distance.astype(np.float32), np.where(hit, 0, -1).astype(np.int32)

    edge = 32
    mesh = local_map.trace_depth_mesh(edge, intersect, 4, 0.25, device)
    directions = texel_directions(edge).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    expected = (intersect(directions.astype(np.float32))[1] >= 0).reshape(6, edge, edge)
    assert np.isfinite(mesh.inverse).all()
    np.testing.assert_array_equal(mesh.inverse > 0, expected)
    statistics = mesh.statistics
    assert statistics["local_discontinuities_traced"] == statistics["local_discontinuities"] > 100
    assert statistics["local_rays"] < 0.5 * mesh.traced.size
    scene = empty_scene(device)
    maps = uniform_maps(scene, np.array([[1, 0, 0], [-1, 0, 0]]) + scene.origin)
    local, _, _ = blended(scene, maps, mesh, rem_missing="best")
    assert np.isfinite(local.radiance(0)).all() and np.isfinite(local.distance(0)).all()


# --- weights of more than two maps


@pytest.mark.parametrize("used", [1, 2, 3, 5])
def test_weights_of_more_maps_are_those_of_the_unstructured_lumigraph(used, device):
    rng = np.random.default_rng(5)
    centres, points = rng.normal(size=(6, 3)), (4 * rng.normal(size=(500, 3))).astype(np.float32)
    valid = (rng.random((500, 6)) < 0.7).astype(np.float32)
    found = weights_of(centres, points, valid, used, device=device)
    np.testing.assert_allclose(found.sum(1), 1.0, atol=4 * ROUNDING)
    assert (found >= 0).all()
    if used <= 2:
        assert not found[:, used:].any()
        return
    assert not found[(valid == 0) & valid.any(1, keepdims=True)].any()
    to_eye, to_map = -points.astype(np.float64), centres - points[:, None].astype(np.float64)
    near, far = np.linalg.norm(to_eye, axis=1)[:, None], np.linalg.norm(to_map, axis=2)
    angle = np.arccos(np.clip(np.einsum("ik,ijk->ij", to_eye, to_map) / near / far, -1, 1))
    penalty = angle + 0.2 * np.maximum(0, far / near - 1) + 1e-4
    for row in range(500):
        seen = np.flatnonzero(valid[row])
        if len(seen) <= used:
            continue
        order = seen[np.argsort(penalty[row, seen])]
        bound = penalty[row, order[used]]
        expected = np.zeros(6)
        expected[order[:used]] = (1 - penalty[row, order[:used]] / bound) / penalty[row, order[:used]]
        np.testing.assert_allclose(found[row], expected / expected.sum(), atol=2e-4)
