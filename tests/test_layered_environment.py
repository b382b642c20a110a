"""Local maps from reference environment maps, against float64 weights, planes and walls, redrawn maps and the traced picture."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import street
import warp as wp
from pxr import UsdShade
from rooms import placed, render, room, sphere, square
from stage_samples import saved
from test_environment import brute_force, hall

import warp_reflect as wr
from warp_reflect import environment_maps
from warp_reflect.cubemap import RADIANCE_AXES, texel_directions
from warp_reflect.environment_maps import CubeMapsView
from warp_reflect.scene import EnvironmentMapData, InstanceData, LightData, MaterialData, Scene
from warp_reflect.shadows import asked_shadows
from warp_reflect.techniques import local_map, local_mesh, local_shading, reference_maps
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


def mesh_at(depth: float, edge: int) -> local_mesh.DepthMesh:
    """Everything at one depth along the faces' axes, all texels traced."""
    mesh = local_mesh.DepthMesh.empty(edge)
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
    assert statistics["rem_missing"] == 0 and (state.numpy().reshape(6, -1)[:3] == local_shading.TEXEL_SKY).all()


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
    mesh = local_mesh.trace_depth_mesh(edge, intersect, 4, 0.25, device)
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


# --- mirrors on their way through a street


@pytest.fixture
def street_stage(tmp_path):
    def make(**options):
        return saved(street.street(tmp_path / f"street{len(list(tmp_path.iterdir()))}.usda", **options))

    return make


SIZE = (192, 108)


def plan_of(scene, method="layered_environment", earlier=None, **settings):
    settings = {"environment_resolution": 64} | settings
    return wr.make_plan(scene, size=SIZE, settings=wr.Settings(**settings), method=method, earlier=earlier)


def rays_met(scene: Scene, origin, directions, part: int) -> np.ndarray:
    """Distances along unit directions from a place, world, in float64; inf where there is nothing; one part is not there."""
    own = scene.parts[part]
    gone = range(own.first_triangle, own.first_triangle + own.triangle_count)
    return brute_force(scene, np.asarray(origin, np.float64), directions, gone)[1]


def test_moving_mirror_shows_the_street_and_takes_its_maps_along(street_stage):
    """No map is drawn and no structure for rays built after the first frame; what is shown is what is traced."""
    scene = wr.load_stage(street_stage(), time=1.0)
    plan, frame, before = None, None, None
    for time in (1.0, 2.4, 4.1):
        scene = scene.at(time)
        plan = plan_of(scene, earlier=plan)
        frame = wr.render_frame(scene, plan, previous=frame)
        prepared = plan.prepared(plan.rows[0])
        if before is not None:
            assert prepared.references.maps.view.packed.ptr == before[0].ptr and scene.still_tracer is before[1]
        before = prepared.references.maps.view.packed, scene.still_tracer
        np.testing.assert_allclose(prepared.centre, scene.data.instances[-1].world_from_object[:3, 3], atol=1e-5)
        traced = wr.render_frame(scene, plan_of(scene, "reference"))
        mirror = (frame["reflectorId"] > 0) & (traced["reflectorId"] > 0)
        error = np.abs(frame["RGBA"] - traced["RGBA"])[mirror].max(-1)
        assert mirror.sum() > 3000 and np.median(error) < 0.01 and error.mean() < 0.03
        same = frame["reflectedId"][mirror] == traced["reflectedId"][mirror]
        assert same.mean() > 0.93
        status = frame["status"][mirror]
        assert np.isin(status, [wr.Status.CONVERGED, wr.Status.SKY, wr.Status.MAX_ITERATIONS]).all()
        assert (status == wr.Status.MAX_ITERATIONS).mean() < 0.05
        np.testing.assert_array_equal(frame["method"][mirror], wr.Technique.LAYERED_ENVIRONMENT)
        assert all(np.isfinite(frame[name]).all() for name in frame.keys())
        # What is said of a pixel is so: the point shown is within a texel of the reflected ray.
        layer = frame.layers[1]
        converged = mirror & (frame["status"] == wr.Status.CONVERGED)
        ray = np.zeros((*mirror.shape, 3))
        ray.reshape(-1, 3)[layer.pixels.pixel.numpy()] = layer.pixels.direction.numpy()
        to_point = (frame.relative("reflectedPoint") - frame.relative("mirrorPoint"))[converged].astype(np.float64)
        sine = np.linalg.norm(np.cross(to_point, ray[converged]), axis=1) / np.linalg.norm(to_point, axis=1)
        assert sine.max() <= 2 / 64 + 1e-4


def test_memory_is_what_the_plan_says(street_stage):
    scene = wr.load_stage(street_stage(), time=1.0)
    for texels in ("packed", "full"):
        plan = plan_of(scene, rem_texels=texels)
        said = next(note.text for note in plan.notes if "reference environment maps" in note.text)
        maps = plan.prepared(plan.rows[0]).references.maps
        assert f"3 reference environment maps: {maps.bytes / 1e6:.1f} MB" in said
    assert maps.bytes == 3 * 6 * 64 * 64 * 20


@pytest.fixture
def at_a_place(street_stage):
    """A scene between two of its maps, its mirror's local map, and the map drawn at the same place."""

    def make(**settings):
        scene = wr.load_stage(street_stage(), time=2.4)
        plan = plan_of(scene, **({"rem_texels": "full"} | settings))
        prepared = plan.prepared(plan.rows[0])
        options = {"without": [(prepared.part,)], "shadows": asked_shadows(scene, plan.settings)}
        drawn = environment_maps.render_maps(scene, prepared.centre[None], prepared.local.resolution, **options)
        return scene, prepared, drawn

    return make


def texel_of(rays: np.ndarray, edge: int) -> np.ndarray:
    """Flat index of the texel that each ray falls into."""
    on_face = np.einsum("fij,nj->nfi", RADIANCE_AXES, rays)
    face = on_face[..., 2].argmax(axis=1)
    right, up, forward = on_face[np.arange(len(rays)), face].T
    column, row = ((0.5 * (1 + x / forward) * edge).astype(int).clip(0, edge - 1) for x in (right, -up))
    return (face * edge + row) * edge + column


def angles_shown(prepared, scene) -> np.ndarray:
    """By how many degrees, from the local map's eye, what each texel shows is off: what the nearest map has there."""
    local, maps = prepared.local, prepared.references.maps
    edge = local.resolution
    distance = local.distance(0)
    directions = texel_directions(edge)
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    points = prepared.centre + distance[..., None] * directions
    k = int(np.argmin(np.linalg.norm(maps.centres - prepared.centre, axis=1)))
    ray = points - maps.centres[k]
    texel = texel_of(ray.reshape(-1, 3), edge)
    far = maps.distance(k).reshape(-1)[texel]
    shown = maps.centres[k] + far[:, None] * directions.reshape(-1, 3)[texel] - prepared.centre
    shown /= np.linalg.norm(shown, axis=1, keepdims=True)
    asked = (distance.reshape(-1) > 0) & (far > 0)
    sine = np.linalg.norm(np.cross(shown, directions.reshape(-1, 3)), axis=1)[asked]
    cosine = np.einsum("ij,ij->i", shown, directions.reshape(-1, 3))[asked]
    return np.degrees(np.arctan2(sine, cosine))


def test_local_map_is_the_one_drawn_at_its_place(at_a_place):
    scene, prepared, drawn = at_a_place()
    local = prepared.local
    a, b = local.distance(0), drawn.distance(0)
    there = (a > 0) & (b > 0)
    assert ((a > 0) == (b > 0)).mean() > 0.99
    assert (np.abs(a - b)[there] <= 0.01 * b[there]).mean() > 0.97
    color = np.abs(local.radiance(0)[..., :3] - drawn.radiance(0)[..., :3]).max(-1)
    assert np.median(color[there]) < 0.005 and color.mean() < 0.03
    # A texel of 64 along a face is 1.4 degrees wide.
    assert np.median(angles_shown(prepared, scene)) < 1.0
    # The rays saved: a small share of the texels has one.
    assert prepared.statistics["local_rays"] < 0.5 * a.size
    assert (
        prepared.statistics["local_discontinuities_traced"] >= 0.9 * prepared.statistics["local_discontinuities"] > 50
    )


def test_finer_meshes_hold_more(at_a_place):
    """Share of the texels at a wrong depth, and the rays spent, from a coarse mesh to all texels."""
    wrong, rays = [], []
    for ratio, cells in ((1e6, 8), (1.0, 16), (0.25, 32), (0.0, 32)):
        _, prepared, drawn = at_a_place(depth_ratio=ratio, mesh_cells=cells)
        a, b = prepared.local.distance(0), drawn.distance(0)
        wrong.append(float((np.abs(a - b) > 0.02 * np.maximum(a, b)).mean()))
        rays.append(prepared.statistics["local_rays"])
    assert wrong[0] > 3 * wrong[2] and wrong[1] >= wrong[2] >= wrong[3] and wrong[3] < 0.005, wrong
    assert rays[0] < rays[1] < rays[2] < rays[3] == a.size


def test_rays_meet_what_stands_still(at_a_place):
    scene, prepared, _ = at_a_place(depth_ratio=0.0)
    directions = texel_directions(64).reshape(-1, 3)[::97]
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    expected = rays_met(scene, prepared.centre, directions, prepared.part)
    found = prepared.local.distance(0).reshape(-1)[::97]
    np.testing.assert_allclose(np.where(found > 0, found, np.inf), expected, rtol=1e-4)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_any_number_of_maps_is_blended(count, at_a_place):
    """The walls that one map sees badly another sees well: never worse by more than the blur of a texel."""
    _, prepared, drawn = at_a_place(rem_count=count)
    assert np.isfinite(prepared.local.radiance(0)).all()
    color = np.abs(prepared.local.radiance(0)[..., :3] - drawn.radiance(0)[..., :3]).max(-1)
    assert np.median(color) < 0.01 and color.mean() < 0.035
    covered = prepared.local.distance(0) > 0
    assert (prepared.local.radiance(0)[covered][:, :3].max(-1) > 0.01).all()


def test_packed_maps_show_the_same(at_a_place):
    full, packed = (at_a_place(rem_texels=kind)[1].local.radiance(0) for kind in ("full", "packed"))
    assert np.abs(full - packed).mean() < 0.01 and np.median(np.abs(full - packed)) < 0.005


def test_threads_do_not_change_a_local_map(at_a_place):
    one, two = (at_a_place(threads=n)[1] for n in (1, 2))
    np.testing.assert_array_equal(one.local.radiance(0), two.local.radiance(0))
    np.testing.assert_array_equal(one.state.numpy(), two.state.numpy())


# --- what moves


def test_what_moves_is_drawn_over_what_the_maps_hold(street_stage):
    """Not in the reference maps, nor its shadow; in the mirror where it is traced."""
    scene = wr.load_stage(street_stage(walker=True), time=2.4)
    plan = plan_of(scene)
    frame = wr.render_frame(scene, plan)
    traced = wr.render_frame(scene, plan_of(scene, "reference"))
    walker = next(k for k, path in frame.prims.items() if path.endswith("Walker"))
    shown, real = (each["reflectedId"] == walker for each in (frame, traced))
    assert real.sum() > 150 and (shown & real).sum() > 0.6 * (shown | real).sum()
    red = frame["reflection"][shown]
    assert (red[:, 0] > 2.0 * red[:, 1]).mean() > 0.9
    assert frame.statistics["local_moving"] > 50
    alone = wr.load_stage(street_stage(), time=2.4)
    maps, without = (p.prepared(p.rows[0]).references.maps for p in (plan, plan_of(alone)))
    # The frames' origins differ: a distance may round to the next code.
    assert (maps.view.packed.numpy() != without.view.packed.numpy()).mean() < 1e-3


def test_moving_mirrors_show_each_other(tmp_path):
    """A second mirror in the local map shows the sky; with the maps of the frame before, the street."""
    stage = street.street(tmp_path / "street.usda")
    material = UsdShade.Material.Get(stage, "/World/Chrome")
    street.ball(stage, "/World/Second", material, 0.5, ((-5.0, 0.6, 0.1), (7.0, 0.6, 0.1)))
    stage.GetPrimAtPath("/World/Camera").GetAttribute("focalLength").Set(15.0)
    scene = wr.load_stage(saved(stage), time=2.4)
    plan = plan_of(scene, environment_update="previous")
    assert all(row.pixels > 100 for row in plan.rows)
    first = wr.render_frame(scene, plan)
    second = wr.render_frame(scene, plan, previous=first)
    pair = [k for k, path in first.prims.items() if path.endswith(("Second", "Ball"))]
    mirror = first["reflectorId"] > 0
    seen = mirror & np.isin(first["reflectedId"], pair)
    assert seen.sum() > 100
    changed = np.abs(second["reflection"] - first["reflection"]).max(-1)
    assert (changed[seen] > 0.02).mean() > 0.3 and (changed[mirror & ~seen] > 0.02).mean() < 0.05
    # The sky is grey, the street is not.
    color = [np.ptp(frame["reflection"][seen], axis=-1).mean() for frame in (first, second)]
    assert color[1] > 2.0 * color[0]


# --- places of maps


def test_places_are_proposed_along_the_way(street_stage):
    """Without places in the stage: on the path, none in a house, the predicted error falls with their number."""
    scene = wr.load_stage(street_stage(places=()), time=1.0)
    errors, unseen = [], []
    for limit in (1, 2, 4):
        settings = wr.Settings(environment_resolution=64, rem_limit=limit, rem_error_px=0.0)
        placed_maps = reference_maps.place_maps(scene, settings)
        assert 1 <= len(placed_maps.centres) <= limit
        assert (np.abs(placed_maps.centres[:, 1:] - [street.HEIGHT, 0]) < 1e-3).all()
        assert (placed_maps.centres[:, 0] >= street.START - 1e-3).all() and (
            placed_maps.centres[:, 0] <= street.END + 1e-3
        ).all()
        errors.append(placed_maps.error_px)
        unseen.append(placed_maps.unseen)
    assert errors[0] > 1.5 * errors[-1] and (np.diff(errors) <= 1e-9).all() and (np.diff(unseen) <= 1e-9).all(), errors
    asked = reference_maps.place_maps(scene, wr.Settings(environment_resolution=64, rem_error_px=errors[1] * 1.01))
    assert len(asked.centres) == 2 and asked.error_px <= errors[1] * 1.01
    plan = plan_of(scene, rem_limit=4)
    wr.render_frame(scene, plan)
    told = [note.text for note in scene.notes if "placed along the paths" in note.text]
    assert len(told) == 1 and "texels predicted error" in told[0]


def test_predicted_error_is_what_local_maps_show(street_stage):
    """Mean angle in texels by which what is shown is off, over the path, within a factor of two of what was predicted."""
    scene = wr.load_stage(street_stage(), time=1.0)
    settings = wr.Settings(environment_resolution=64, rem_texels="full", rem_missing="best", rem_count=1)
    found = []
    for time in (1.4, 3.3, 4.6):
        then = scene.at(time)
        plan = wr.make_plan(then, size=SIZE, settings=settings, method="layered_environment")
        angles = angles_shown(plan.prepared(plan.rows[0]), then)
        found.append(np.minimum(angles, np.degrees(0.5)).mean() / np.degrees(2 / 64))
    predicted, _ = reference_maps.predicted_error(scene, reference_maps.authored(scene).centres, settings)
    assert 0.5 < predicted / np.mean(found) < 2.0, (predicted, found)


# --- bad input


def told(scene, plan) -> dict[str, str]:
    return {note.path: note.text for note in [*plan.notes, *scene.notes]}


def check_picture(scene, plan):
    frame = wr.render_frame(scene, plan)
    mirror = frame["reflectorId"] > 0
    assert mirror.any() and (frame["reflection"][mirror].max(-1) > 0.01).all()
    assert all(np.isfinite(frame[name]).all() for name in frame.keys())
    return frame


def test_maps_at_one_place_are_told(street_stage):
    scene = wr.load_stage(street_stage(places=(street.PLACES[1], street.PLACES[1])), time=2.4)
    plan = plan_of(scene)
    check_picture(scene, plan)
    assert told(scene, plan)["/World/Maps/M1"] == "environment map: at the place of /World/Maps/M0"


def test_map_inside_a_wall_is_not_used(street_stage):
    house = (-12.5 + 25.0 * 2 / 5, 1.0, -4.0)
    scene = wr.load_stage(street_stage(places=(street.PLACES[1], house)), time=2.4)
    plan = plan_of(scene)
    check_picture(scene, plan)
    assert told(scene, plan)["/World/Maps/M1"] == "environment map: its place is inside a body; it is not used"
    assert plan.prepared(plan.rows[0]).references.placement.paths == ("/World/Maps/M0",)


def test_where_no_map_can_be_used_maps_are_placed(street_stage):
    house = (-12.5 + 25.0 * 2 / 5, 1.0, -4.0)
    scene = wr.load_stage(street_stage(places=(house,)), time=2.4)
    plan = plan_of(scene)
    check_picture(scene, plan)
    assert any("none of its environment maps can be used" in note.text for note in plan.notes)
    assert len(plan.prepared(plan.rows[0]).references.placement.centres) >= 1


def test_mirror_beyond_the_maps_is_told(street_stage):
    near = ((-6.0, 0.6, 0.0), (-5.8, 0.6, 0.0))
    scene = wr.load_stage(street_stage(places=near), time=5.0)
    plan = plan_of(scene)
    frame = check_picture(scene, plan)
    assert "from the nearest environment map" in told(scene, plan)["/World/Ball"]
    traced = wr.render_frame(scene, plan_of(scene, "reference"))
    mirror = frame["reflectorId"] > 0
    assert np.abs(frame["RGBA"] - traced["RGBA"])[mirror].mean() < 0.05


def test_stage_of_one_mirror_shows_the_sky():
    data = room(sphere(), placed(0, 0, 0)).data
    lights = [LightData("/dome", "dome", (0.2, 0.5, 0.7), np.eye(4))]
    scene = Scene(dataclasses.replace(data, instances=data.instances[:1], lights=lights))
    frame, traced = (
        render(scene, method, environment_resolution=16) for method in ("layered_environment", "reference")
    )
    np.testing.assert_allclose(frame["RGBA"], traced["RGBA"], atol=1e-5)
    assert (frame["status"][frame["reflectorId"] > 0] == wr.Status.SKY).all()
