"""Vector kernels against the plain ones: the same bits, on every shape of triangle and on every scene."""

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
import warp as wp
from rooms import CHROME, placed, plane_room, room, sphere, square

import warp_reflect as wr
from warp_reflect import raster, raster_vector, reflector_maps, surface, surface_vector, vector
from warp_reflect.launch import launch
from warp_reflect.layers import Camera, CameraView, MirrorPixels
from warp_reflect.raster import Picture, make_target, rasterise
from warp_reflect.scene import CameraData, InstanceData, LightData, MaterialData, Scene, SceneData
from warp_reflect.techniques import grid, map_search, quadric_patch, refine, reflector_map
from warp_reflect.techniques.interpolation import ChunkView
from warp_reflect.techniques.quadric_search import QuadricView
from warp_reflect.techniques.vertices import VERTEX_ARRAYS, SolveFrame, empty_vertices

wp.set_module_options({"enable_backward": False})
CPU = wp.get_device("cpu")


def target_of(width, height, rays=None, mask=None):
    picture = Picture((width, height), near=1.0e-3, far=1.0e3)
    if mask is None:
        target = make_target(picture, (0, 0, width, height), CPU)
    else:
        target = make_target(picture, (0, 0, width, height), CPU, wp.array(mask.reshape(-1), dtype=int, device=CPU), 1)
    if rays is not None:
        target.view.ray = wp.array(rays, dtype=wp.vec4, device=CPU)
    return target


def drawn(kernels, screen, triangles, width, height, rays=None, mask=None, points=None, threads=1, painter=0, **named):
    target = target_of(width, height, rays, mask)
    target.view.painter = painter
    rasterise(
        target,
        wp.array(screen, dtype=wp.vec4, device=CPU),
        wp.array(triangles, dtype=wp.vec3i, device=CPU),
        points=None if points is None else wp.array(points, dtype=wp.vec3, device=CPU),
        threads=threads,
        kernels=kernels,
        **named,
    )
    return target.key.numpy()


def corners_of(kind, rng, count, width, height):
    """Screen corners float32 [3 * count, 4]: x, y, depth key, 1 / w."""
    middle = rng.uniform((0, 0), (width, height), (count, 1, 2))
    size = {"tiny": 0.7, "small": 12.0, "edge": 64.0, "large": 900.0, "sliver": 15000.0}[kind]
    xy = middle + rng.uniform(-size, size, (count, 3, 2))
    if kind == "edge":
        # Boxes of exactly 64 pixels and a little either side, and corners on pixel centres and borders.
        xy = np.round(xy * 2.0) / 2.0
        xy[:, 1] = xy[:, 0] + rng.choice([63.5, 64.0, 64.5], (count, 2)) * rng.choice([-1, 1], (count, 2))
    key = rng.uniform(0.01, 1.0, (count, 3, 1))
    if kind == "sliver":
        # A few of the raster's positions wide, through the picture, with depths decades apart.
        share = rng.uniform(-1.0, 1.0, (count, 1))
        xy[:, 1] = middle[:, 0] - share * (xy[:, 0] - middle[:, 0]) + rng.uniform(-0.6, 0.6, (count, 2))
        xy[:, 2] = middle[:, 0] + rng.uniform(-30.0, 30.0, (count, 2)) * rng.choice([0.02, 1.0], (count, 1))
        key **= 4.0
    return np.concatenate([xy, key, np.ones((count, 3, 1))], -1).reshape(-1, 4).astype(np.float32)


def test_this_machine_has_vector_kernels_or_says_why():
    why = vector.missing()
    assert not why or why.startswith(("the compiler refuses", "they compile but"))
    assert vector.chosen("auto", CPU) == (not why)
    assert not vector.chosen("plain", CPU)


@pytest.mark.parametrize("kind", ["tiny", "small", "edge", "large", "sliver"])
@pytest.mark.parametrize("size", [(7, 5), (131, 97)])
def test_triangles_are_drawn_bit_for_bit_as_the_plain_kernel_draws_them(kind, size):
    rng = np.random.default_rng(len(kind))
    count = 400
    screen = corners_of(kind, rng, count, *size)
    triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    plain = drawn("plain", screen, triangles, *size)
    assert (plain > 0).any()
    np.testing.assert_array_equal(drawn("vector", screen, triangles, *size), plain)
    np.testing.assert_array_equal(drawn("vector", screen, triangles, *size, threads=2), plain)


@pytest.mark.parametrize("kind", ["tiny", "small", "large"])
@pytest.mark.parametrize("with_rays", [False, True])
def test_masks_and_rays_are_honoured_bit_for_bit(kind, with_rays):
    rng = np.random.default_rng(5)
    width, height, count = 101, 77, 300
    screen = corners_of(kind, rng, count, width, height)
    triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    mask = (rng.random((height, width)) < 0.7).astype(np.int32)
    rays = points = None
    if with_rays:
        ray = rays_of(rng, height * width)
        ray[mask.reshape(-1) == 0] = 0.0
        rays = ray.reshape(-1, 4)
        points = rng.normal(size=(3 * count, 3)).astype(np.float32) * 3.0
    args = screen, triangles, width, height, rays, mask, points
    plain = drawn("plain", *args)
    assert (plain > 0).any() and not plain.reshape(height, width)[mask == 0].any()
    np.testing.assert_array_equal(drawn("vector", *args), plain)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_left_out_behind_others_is_hidden_by_them(seed):
    """Layers of every size, each behind the one before it but for depths that touch, drawn once over the other."""
    rng = np.random.default_rng(seed)
    width, height = 157, 83
    parts = [
        corners_of(kind, rng, count, width, height) for kind, count in (("small", 3000), ("large", 60), ("edge", 400))
    ]
    screen = np.concatenate(parts).reshape(-1, 3, 4)
    screen[:, :, 2] = rng.choice([0.1, 0.1000001, 0.2, 0.4], (len(screen), 1))
    screen[::3, :, 2] *= rng.uniform(0.999999, 1.000001, (len(screen[::3]), 3))
    triangles = np.arange(3 * len(screen), dtype=np.int32).reshape(-1, 3)
    screen = screen.reshape(-1, 4).astype(np.float32)
    plain = drawn("plain", screen, triangles, width, height)
    assert (plain > 0).all()
    for threads in (1, 3):
        np.testing.assert_array_equal(drawn("vector", screen, triangles, width, height, threads=threads), plain)


@pytest.mark.parametrize("wanted", [(1,), (2, 9, 4, 5)])
@pytest.mark.parametrize("kind", ["none", "one", "scattered", "blocks"])
@pytest.mark.parametrize("count", [5, 64, 9001])
def test_pixels_of_each_id_are_listed(count, kind, wanted):
    rng = np.random.default_rng(count)
    patch_id = np.array([0, *wanted], np.int32)
    triangle = np.full(count, -1, np.int32)
    if kind == "one":
        triangle[:] = 1
    elif kind == "scattered":
        triangle = rng.integers(-1, len(patch_id), count, dtype=np.int32)
    elif kind == "blocks":
        triangle = np.repeat(rng.integers(-1, len(patch_id), count // 20 + 1, dtype=np.int32), 20)[:count]
    expected = np.where(triangle >= 0, patch_id[triangle], 0)
    given = [wp.array(each, dtype=int, device=CPU) for each in (triangle, np.arange(len(patch_id)), patch_id)]
    for threads in (1, 2):
        ids, pixel, edges = surface_vector.pixels_by_id(*given, max(wanted), threads)
        np.testing.assert_array_equal(ids.numpy(), expected)
        assert len(edges) == max(wanted) + 1 and edges[0] == 0 and edges[-1] == len(pixel)
        for id, (first, end) in enumerate(itertools.pairwise(edges), 1):
            np.testing.assert_array_equal(pixel.numpy()[first:end], np.flatnonzero(expected == id))


def test_bands_of_rows_have_whole_tiles():
    rng = np.random.default_rng(3)
    for first, end, count in ((0, 720, 2), (3, 94, 5), (0, 5, 8), (2, 9, 2)):
        rows = rng.uniform(first - 50, end + 50, 200).astype(np.float32)
        rows[:4] = np.nan, np.inf, -np.inf, 1e30
        for some in (rows, rows[:4], rows[:0]):
            bands = raster.balanced_bands((7, first, 60, end), some, count)
            assert bands[0][0] == first and bands[-1][1] == end and len(bands) <= count
            assert all(a[1] == b[0] for a, b in itertools.pairwise(bands))
            assert all((begin - first) % 8 == 0 and begin < stop for begin, stop in bands)


def test_bands_of_rows_are_narrow_where_triangles_are_many():
    even = raster.balanced_bands((0, 0, 1280, 720), np.zeros(0), 2)
    assert even == [(0, 352), (352, 720)]
    rows = np.full(1000, 600.0)  # one of BALANCED_BY each
    (_, middle), _ = raster.balanced_bands((0, 0, 1280, 720), rows, 2)
    assert 592 <= middle <= 600


@pytest.mark.parametrize("shape", ["full rows", "scattered", "one", "all"])
def test_cells_without_a_ray_hold_zeros(shape, monkeypatch):
    """In memory that held something else before, by the plain kernel and by vectors."""
    rng = np.random.default_rng(8)
    size, box = (60, 40), (5, 7, 55, 33)
    inside = np.zeros((size[1], size[0]), bool)
    inside[box[1] : box[3], box[0] : box[2]] = {
        "full rows": np.arange(26)[:, None] % 5 == 1,
        "scattered": rng.random((26, 50)) < 0.3,
        "one": (np.arange(26)[:, None] == 12) & (np.arange(50) == 30),
        "all": True,
    }[shape]
    pixel = np.flatnonzero(inside).astype(np.int32)
    point, direction = rng.normal(size=(2, len(pixel), 3)).astype(np.float32)
    point[:, 2] = -3.0 - rng.random(len(pixel))
    arrays = [wp.array(each, dtype=wp.vec3, device=CPU) for each in (point, direction, direction)]
    pixels = MirrorPixels(1, wp.array(pixel, dtype=int, device=CPU), arrays[0], arrays[1], arrays[2], box)
    view = CameraView()
    view.width, view.height, view.forward = *size, wp.vec3(0.0, 0.0, -1.0)
    view = wp.array([view], dtype=CameraView, device=CPU)
    picture = Picture(size, near=1.0e-3, far=1.0e3)
    stale = lambda count, dtype, device: wp.array(np.full((count, 4), np.nan, np.float32), dtype=dtype, device=device)  # noqa: E731
    monkeypatch.setattr(wp, "empty", stale)
    images = {}
    for kernels, threads in (("plain", 1), ("plain", 2), ("vector", 1), ("vector", 2)):
        target = make_target(picture, box, CPU)
        raster.attach_rays(target, view, pixels, threads, kernels)
        images[kernels, threads] = target.view.ray.numpy().reshape(box[3] - box[1], box[2] - box[0], 8)
    there = inside[box[1] : box[3], box[0] : box[2]]
    for image in images.values():
        assert (image[~there] == 0.0).all() and (image[there][:, 3] > 0.0).all()
        np.testing.assert_allclose(image, images["plain", 1], rtol=1e-6)


def rays_of(rng, count):
    """What `raster.attach_rays` gives the cells of a target, float32 [2 * count, 4]."""
    turned = rng.normal(size=(count, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    ray = np.zeros((count, 2, 4), np.float32)
    ray[:, 0, :3], ray[:, 0, 3] = rng.normal(size=(count, 3)), rng.uniform(1, 3, count)
    ray[:, 1, :3], ray[:, 1, 3] = turned, rng.uniform(1.0, 1.5, count)
    return ray


@pytest.mark.parametrize("painter", [0, 1])
@pytest.mark.parametrize("with_rays", [False, True])
def test_blocks_of_triangles_of_every_kind_are_drawn_bit_for_bit(with_rays, painter):
    """Small, large and clipped ones, some without area or off the picture, side by side in blocks that are not full."""
    rng = np.random.default_rng(8)
    width, height, each = 173, 91, 1100
    kinds = ("tiny", "small", "edge", "large")
    screen = np.concatenate([corners_of(kind, rng, each, width, height) for kind in kinds]).reshape(-1, 3, 4)
    clipped = rng.choice(len(screen), 60, replace=False)
    screen[clipped[:20], 0, :2] *= 1.0e5
    screen[clipped[20:40], 1] = rng.normal(size=(20, 4)) * (40.0, 40.0, 0.0, 1.0)  # in front of the near plane
    screen[clipped[40:], 2] = screen[clipped[40:], 1]
    screen = screen[rng.permutation(len(screen))].reshape(-1, 4)
    count = len(screen) // 3
    triangles = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    given = {"painter": painter, "id_offset": 7}
    if with_rays:
        given["rays"] = rays_of(rng, width * height).reshape(-1, 4)
        # Planes of triangles of every size, down to where their edges' product leaves float32's safe range.
        scale = 10.0 ** rng.uniform(-14.0, 10.0, (count, 1, 1))
        given["points"] = (rng.normal(size=(count, 3, 3)) * scale).reshape(-1, 3).astype(np.float32)
        given["plane_triangles"] = wp.array(triangles[:, [2, 0, 1]], dtype=wp.vec3i, device=CPU)
        given["ids"] = wp.array(rng.permutation(count).astype(np.int32), dtype=int, device=CPU)
    plain = drawn("plain", screen, triangles, width, height, **given)
    assert (plain > 0).mean() > 0.9
    for threads in (1, 2, 5):
        again = drawn("vector", screen, triangles, width, height, threads=threads, **given)
        np.testing.assert_array_equal(again, plain)


def test_what_cannot_be_drawn_is_the_same_nothing():
    """Zero area, dropped corners (key 0), not finite, far outside, behind the eye."""
    odd = [np.nan, np.inf, -np.inf, 0.0, 1e-30, -5.0, 1e9, 20.0, 33.5]
    rng = np.random.default_rng(1)
    screen = rng.choice(odd, (3000, 4)).astype(np.float32)
    # What is in front of the eye has a positive 1 / w and finite places: the vertex stage sees to that.
    good = np.isfinite(screen).all(axis=1)
    screen[~good] = (0.0, 0.0, 0.0, 0.0)
    triangles = rng.integers(0, 3000, (2000, 3), dtype=np.int32)
    plain = drawn("plain", screen, triangles, 64, 48)
    np.testing.assert_array_equal(drawn("vector", screen, triangles, 64, 48), plain)


@pytest.mark.parametrize("orthographic", [0, 1])
def test_vertices_are_projected_bit_for_bit(orthographic):
    """In front of the near plane, on the eye's plane and behind it, in blocks that are not full."""
    rng = np.random.default_rng(2)
    view = CameraView()
    view.orthographic, view.near, view.far = orthographic, 0.5, 40.0
    view.eye, view.forward = wp.vec3(1.0, 2.0, -0.5), wp.vec3(0.0, 0.6, 0.8)
    view.x_row, view.y_row = wp.vec4(300.0, 20.0, -4.0, 7.0), wp.vec4(1.0, -250.0, 90.0, 0.3)
    camera = wp.array([view], dtype=CameraView, device=CPU)
    for count in (1, 63, 64, 65, 1001):
        places = rng.normal(size=(count, 3)).astype(np.float32) * 5.0
        places[::7] = np.array(view.eye)
        points = wp.array(places, dtype=wp.vec3, device=CPU)
        plain, vectors = (wp.zeros(count, dtype=wp.vec4, device=CPU) for _ in range(2))
        launch(raster.project_kernel, count, [points, camera, plain], CPU, 1)
        vector.launch_blocks(raster_vector.project_blocks_kernel, count, [points, camera, vectors], CPU, 2)
        assert (plain.numpy()[:, 2] == 0.0).any()
        np.testing.assert_array_equal(vectors.numpy().view(np.uint32), plain.numpy().view(np.uint32))


def scenes():
    return {
        "ball": lambda: room(sphere(), placed(0, 0, -1)),
        "small ball": lambda: room(sphere(6, 9), placed(0.4, 0.2, -2, 0.4)),
        "plane": plane_room,
    }


@pytest.mark.parametrize("refine", ["exact", "strict"])
@pytest.mark.parametrize("name", scenes())
def test_frames_are_the_same_bit_for_bit(name, refine):
    scene = scenes()[name]()
    frames = {}
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
        settings = wr.Settings(kernels=kernels, threads=threads, refine=refine)
        plan = wr.make_plan(scene, size=(173, 101), settings=settings, method="reflector_map")
        if name == "plane":
            plan = wr.make_plan(scene, size=(173, 101), settings=settings, method="planar")
        assert all(row.forced for row in plan.rows)
        frames[kernels, threads] = wr.render_frame(scene, plan)
    plain = frames.pop(("plain", 1))
    assert plain.statistics["candidate"] > 50
    for frame in frames.values():
        for channel in plain.keys():
            np.testing.assert_array_equal(frame[channel], plain[channel], err_msg=channel)
        assert frame.statistics == plain.statistics


def test_unknown_kernels_are_refused_and_missing_ones_are_told(monkeypatch):
    with pytest.raises(ValueError, match="setting 'kernels': got 'fast', expected one of auto, plain, vector"):
        wr.Settings(kernels="fast")
    monkeypatch.setattr(vector, "missing", lambda: "the compiler refuses them: no such type")
    with pytest.raises(RuntimeError, match="kernels=vector: the compiler refuses them"):
        vector.chosen("vector", CPU)
    scene = room(sphere(6, 9), placed(0, 0, -1))
    plan = wr.make_plan(scene, size=(48, 27))
    assert [note.text for note in plan.notes if "kernels" in note.text] == [
        "plain kernels only: the compiler refuses them: no such type (kernels=auto)"
    ]
    assert not [
        n
        for n in wr.make_plan(scene, size=(48, 27), settings=wr.Settings(kernels="plain")).notes
        if "kernels" in n.text
    ]
    assert wr.render_frame(scene, plan)["RGBA"].max() > 0


def lit_room(lights, projection="perspective"):
    """Every kind of surface there is to shade: analytic, smooth, flat, coloured per corner, coated, see-through, a speck."""
    rng = np.random.default_rng(3)
    colors = rng.random((300, 3)).astype(np.float32)
    smooth = dataclasses.replace(sphere(9, 14), parts=[])
    # Normals that cancel between the corners of a facet.
    torn = dataclasses.replace(smooth, normals=(smooth.normals * rng.choice([-1.0, 1.0], (len(smooth.normals), 1))))
    painted = dataclasses.replace(smooth, normals=None, colors=colors[: len(smooth.points)])
    meshes = [sphere(), square(6, 6.0), smooth, dataclasses.replace(torn, normals=np.float32(torn.normals)), painted]
    materials = [
        CHROME,
        MaterialData(),
        MaterialData(base_color=(0.1, 0.5, 0.3), clearcoat=0.6, clearcoat_roughness=0.1, roughness=0.2),
        MaterialData(metallic=0.7, roughness=0.15, uses_vertex_color=True),
        MaterialData(emissive=(0.3, 0.0, 1.0), opacity=0.5, transmission=0.4, roughness=0.1),
    ]
    where = [(0, 0, -1.5, 1.0), (0, -1, 0, 1.0), (-1.6, -0.3, 0.5, 0.5), (1.6, 0.1, 0.4, 0.6), (0.9, -0.6, 1.5, 0.4)]
    instances = [InstanceData(k, placed(*at), f"/p{k}", (k % 5,)) for k, at in enumerate(where)]
    instances.append(InstanceData(2, placed(0, 0, 2, 1e-13), "/speck", (4,)))
    instances.append(InstanceData(4, placed(-0.8, 0.9, 1.0, 0.4), "/painted", (3,)))
    camera = CameraData("/camera", placed(0.1, 0.3, 4.0), projection, near=0.05, focal_length=22.0)
    if projection == "orthographic":
        camera = dataclasses.replace(camera, horizontal_aperture=60.0, vertical_aperture=40.0)
    return Scene(SceneData("lit", meshes, instances, materials, lights, [camera]))


def lights_of(kind):
    texture = np.random.default_rng(7).random((6, 11, 3)).astype(np.float32)
    turn = np.eye(4)
    turn[:3, :3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    dome = LightData("/dome", "dome", (0.5, 0.7, 0.9), turn, texture)
    sun = LightData("/sun", "distant", (2.0, 1.9, 1.7), turn)
    # So near the floor that it sets for parts of it, and around the eye of some points.
    low = LightData("/low", "sphere", (3.0, 2.0, 1.0), placed(-0.6, -0.9, 0.9), size=(0.5,))
    far = LightData("/far", "sphere", (40.0, 50.0, 60.0), placed(2, 4, 1), size=(0.2,))
    tube = LightData("/tube", "cylinder", (3.0, 2.0, 1.0), placed(0, 2, 0), size=(1.0, 0.1))
    return {
        "none": [],
        "dome": [dome],
        "sun": [sun, LightData("/grey", "dome", (0.2, 0.2, 0.2), np.eye(4))],
        "spheres": [low, far, sun],
        "shapes": [low, tube],
    }[kind]


@pytest.mark.parametrize("shadows", [False, True])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("kind", ["none", "dome", "sun", "spheres", "shapes"])
def test_every_surface_is_shaded_as_the_plain_kernels_do(kind, projection, shadows):
    scene = lit_room(lights_of(kind), projection)
    frames = {}
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
        settings = wr.Settings(kernels=kernels, threads=threads, shadows=shadows, shadow_samples=1)
        plan = wr.make_plan(scene, size=(107, 61), settings=settings, method="reference")
        frames[kernels, threads] = wr.render_frame(scene, plan)
    plain, vectors = frames["plain", 1], frames["vector", 1]
    assert len(np.unique(plain["primId"])) >= 6 and (plain["reflectedId"] > 0).sum() > 100
    for channel in ("RGBA", "reflection"):
        assert np.isfinite(vectors[channel]).all()
        # Sums of some twenty products each: 16 units in the last place.
        np.testing.assert_allclose(vectors[channel], plain[channel], rtol=16 * 2.0**-23, atol=1e-6, err_msg=channel)
        np.testing.assert_array_equal(frames["vector", 2][channel], vectors[channel], err_msg=channel)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_mirrors_are_met_bit_for_bit_where_the_plain_kernel_meets_them(projection):
    """An analytic ball, a plane, smooth and torn facets, each a mirror, silhouettes included."""
    scene = lit_room([], projection)
    gbuffer = raster.draw_scene(scene, Camera.from_data(scene.data.cameras[0], (173, 101)))
    parts = {part + 1: part for part in range(len(scene.parts))}
    plain, _ = surface.mirror_pixels(scene, gbuffer, parts, 1, "plain")
    assert sum(mirror.count > 50 for mirror in plain.values()) >= 5
    for threads in (1, 2):
        vectors, _ = surface.mirror_pixels(scene, gbuffer, parts, threads, "vector")
        for number, mirror in plain.items():
            for name in ("pixel", "point", "normal", "direction"):
                got, want = getattr(vectors[number], name).numpy(), getattr(mirror, name).numpy()
                np.testing.assert_array_equal(got, want, err_msg=f"{name} of {number}")


# (lam, b, c) in the unit frame, family 0 about a centre, 1 a bowl, 2 a sheet; eye outside.
BODIES = {
    "sphere": ((1.0, 1.0, 1.0), 0.0, -1.0, 0),
    "needle": ((1.0, 900.0, 400.0), 0.0, -1.0, 0),
    "cylinder": ((1.0, 1.0, 0.0), 0.0, -1.0, 0),
    "bowl": ((1.0, 0.5, 0.0), -0.5, 0.1, 1),
    "sheet": ((1.0, 2.0, -1.0), 0.0, 0.5, 2),
}


def looking_at_origin(eye):
    """(SolveFrame, CameraView [1]) of a unit frame that is the scene's."""
    frame = SolveFrame()
    frame.unit_from_scene = frame.eye_from_unit = wp.mat33(np.eye(3, dtype=np.float32))
    frame.eye = wp.vec3(*eye)
    camera = CameraView()
    forward = -np.float64(eye) / np.linalg.norm(eye)
    camera.forward, camera.near, camera.far = wp.vec3(*forward), 1e-3, 1e3
    camera.x_row, camera.y_row = wp.vec4(300.0, 0.0, 20.0, 0.0), wp.vec4(0.0, 280.0, -30.0, 0.0)
    return frame, wp.array([camera], dtype=CameraView, device=CPU)


def searched(body, points, eye, kernels, threads=1, seeds=None):
    """VertexView of points in the unit frame, as `quadric_patch.reflect` has them solved."""
    lam, b, c, family = body
    quadric = QuadricView()
    quadric.lam, quadric.b, quadric.c, quadric.family = wp.vec3(*lam), b, c, family
    frame, camera = looking_at_origin(eye)
    out = empty_vertices(len(points), CPU, with_position=True)
    if seeds is not None:
        out.seed.assign(seeds)
    array = wp.array(points, dtype=wp.vec3, device=CPU)
    quadric_patch.search(array, [3, 2], quadric, frame, camera, seeds is not None, out, CPU, threads, kernels)
    return {name: getattr(out, name).numpy() for name in ("status", "screen", "seed", "residual", "reach", "position")}


def hard_points(body, eye):
    """Around, on and in the body, far, tiny distances apart, on the line of sight, at the eye, grazing."""
    rng = np.random.default_rng(11)
    turned = rng.normal(size=(900, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    near = turned * rng.uniform(0.2, 3.0, (900, 1))
    far = turned[:60] * 10.0 ** rng.uniform(1, 6, (60, 1))
    sight = np.float64(eye) * np.linspace(-3.0, 1.5, 40)[:, None]
    skin = near[:200] * (1.0 + 10.0 ** rng.uniform(-7, -2, (200, 1)))
    special = [eye, (0, 0, 0), (0, 0, 1), (1, 0, 0), (0, 0, -1e-6), (1e-30, 0, 2)]
    return np.concatenate([near, far, sight, skin, special]).astype(np.float32)


@pytest.mark.parametrize("name", BODIES)
def test_reflection_points_are_searched_as_the_plain_kernel_does(name):
    body, eye = BODIES[name], (2.5, 1.2, 1.7 if name != "sheet" else 0.9)
    points = hard_points(body, eye)
    cold = searched(body, points, eye, "plain")
    assert {1, 3} <= set(cold["status"].tolist()) and (cold["status"] == 1).sum() > 300
    # Seeds that are right, far off, and missing.
    seeds = cold["seed"] * np.random.default_rng(2).choice([0.0, 1.0, 1.0, 0.7], (len(points), 1)).astype(np.float32)
    for start in (None, seeds):
        plain = searched(body, points, eye, "plain", seeds=start)
        vectors = searched(body, points, eye, "vector", seeds=start)
        np.testing.assert_array_equal(vectors["status"], plain["status"])
        for field in ("screen", "seed", "residual", "reach", "position"):
            # Sums are taken in the plain kernel's order.
            np.testing.assert_array_equal(vectors[field], plain[field], err_msg=field)
        for field, values in searched(body, points, eye, "vector", threads=2, seeds=start).items():
            np.testing.assert_array_equal(values, vectors[field], err_msg=field)


@pytest.fixture(scope="module")
def bodies_of_maps():
    """(map, whether it has a closing part) of an ellipsoid, a needle, a box with round edges and half an ellipsoid."""
    turned = trimesh.creation.icosphere(3)
    directions, faces = np.asarray(turned.vertices), np.asarray(turned.faces)
    power = np.abs(directions) ** 6
    shapes = {
        "ellipsoid": directions * (1.0, 0.7, 0.5),
        "needle": directions * (1.0, 0.06, 0.05),
    }
    maps = {name: reflector_maps.ReflectorMap.from_mesh(points, faces, 48) for name, points in shapes.items()}
    box = trimesh.convex.convex_hull(directions / power.sum(axis=1, keepdims=True) ** (1.0 / 6.0))
    maps["rounded box"] = reflector_maps.ReflectorMap.from_mesh(box.vertices, box.faces, 48)
    front = faces[(shapes["ellipsoid"][faces][..., 2] > 0.0).all(axis=1)]
    maps["half"] = reflector_maps.ReflectorMap.from_mesh(shapes["ellipsoid"], front, 48)
    return maps


def searched_in_map(drawn_map, points, eye, kernels, threads=1, seeds=None, **knobs):
    """VertexView of points in a map's unit frame, as `reflector_map.reflect` has them solved."""
    frame, camera = looking_at_origin(eye)
    out = empty_vertices(len(points), CPU, with_position=True)
    if seeds is not None:
        out.seed.assign(seeds)
    array = wp.array(points, dtype=wp.vec3, device=CPU)
    chosen = map_search.search_settings(wr.Settings(**knobs), drawn_map.resolution)
    where = CPU, threads, kernels
    reflector_map.search(array, [3, 2], drawn_map, frame, camera, chosen, seeds is not None, out, *where)
    return {name: getattr(out, name).numpy() for name in ("status", "screen", "seed", "residual", "reach", "position")}


@pytest.mark.parametrize("name", ["ellipsoid", "needle", "rounded box", "half"])
def test_maps_are_searched_as_the_plain_kernel_does(bodies_of_maps, name):
    drawn_map, eye = bodies_of_maps[name], (2.5, 1.2, 1.7)
    points = hard_points(None, eye)
    cold = searched_in_map(drawn_map, points, eye, "plain")
    assert {1, 3} <= set(cold["status"].tolist()) and (cold["status"] == 1).sum() > 200
    # Seeds that are right, far off, and missing; a search of few steps, which leaves much to the plain kernel.
    seeds = cold["seed"] * np.random.default_rng(2).choice([0.0, 1.0, 1.0, -1.0], (len(points), 1)).astype(np.float32)
    for start, knobs in ((None, {}), (seeds, {}), (None, {"iterations": 2}), (None, {"tolerance": 1.0e-3})):
        plain = searched_in_map(drawn_map, points, eye, "plain", seeds=start, **knobs)
        vectors = searched_in_map(drawn_map, points, eye, "vector", seeds=start, **knobs)
        np.testing.assert_array_equal(vectors["status"], plain["status"])
        for field in ("screen", "seed", "residual", "reach", "position"):
            # Sums are taken in the plain kernel's order.
            np.testing.assert_array_equal(vectors[field], plain[field], err_msg=field)
        for field, values in searched_in_map(drawn_map, points, eye, "vector", 2, start, **knobs).items():
            np.testing.assert_array_equal(values, vectors[field], err_msg=field)


@pytest.mark.parametrize("name", ["ellipsoid", "needle", "rounded box", "half"])
def test_edges_end_in_sight_where_the_plain_kernel_has_them_end(bodies_of_maps, name):
    drawn_map, eye = bodies_of_maps[name], (2.5, 1.2, 1.7)
    points = hard_points(None, eye)
    frame, _ = looking_at_origin(eye)
    rng = np.random.default_rng(5)
    edges = rng.integers(0, len(points), (1000, 2)).astype(np.int32)
    edges[::7, 0] = -1
    given = [wp.array(points, dtype=wp.vec3, device=CPU), drawn_map, frame, wp.array(edges, dtype=wp.vec2i, device=CPU)]
    found = {}
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
        out = wp.full(len(edges), wp.vec3(7.0, 7.0, 7.0), dtype=wp.vec3, device=CPU)
        reflector_map.boundary(*given, 12, out, CPU, threads, kernels)
        found[kernels, threads] = out.numpy()
    assert np.isfinite(found["plain", 1]).all()
    assert (found["plain", 1][::7] == 7.0).all()
    np.testing.assert_array_equal(found["vector", 1], found["plain", 1])
    np.testing.assert_array_equal(found["vector", 2], found["plain", 1])


@pytest.mark.parametrize("name", ["ellipsoid", "needle"])
def test_vertices_step_from_directions_as_the_plain_kernel_has_them(bodies_of_maps, name):
    """Cells of all sizes about the mirror, some hidden, some with corners behind it; answers that are there already."""
    drawn_map, eye = bodies_of_maps[name], (2.5, 1.2, 1.7)
    frame, camera = looking_at_origin(eye)
    rng = np.random.default_rng(6)
    cells, each = 40, 51  # vertices per cell: no multiple of the lanes
    edge = rng.uniform(0.02, 2.0, cells)
    low = rng.uniform(-3.0, 3.0, (cells, 3))
    corners = low[:, None] + edge[:, None, None] * [[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]
    inside = low[:, None] + edge[:, None, None] * rng.uniform(0.0, 1.0, (cells, each, 3))
    node = empty_vertices(8 * cells, CPU)
    node.seed.assign(searched_in_map(drawn_map, corners.reshape(-1, 3).astype(np.float32), eye, "plain")["seed"])
    chunks = ChunkView()
    ranges = np.stack([np.arange(cells) * each, np.full(cells, each)], axis=1)
    chunks.range = wp.array(ranges.astype(np.int32), dtype=wp.vec2i, device=CPU)
    chunks.cell = wp.array(np.arange(cells, dtype=np.int32), dtype=int, device=CPU)
    chunks.corner = wp.array(np.arange(8 * cells, dtype=np.int32).reshape(-1, 8), dtype=int, device=CPU)
    chunks.low = wp.array(low.astype(np.float32), dtype=wp.vec3, device=CPU)
    hidden = rng.random(cells) < 0.1
    chunks.inv_edge = wp.array(np.where(hidden, 0.0, 1.0 / edge).astype(np.float32), dtype=float, device=CPU)
    points = wp.array(inside.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=CPU)
    order = wp.array(rng.permutation(cells * each).astype(np.int32), dtype=int, device=CPU)
    answered = rng.choice([0, 0, 0, 1, 3], cells * each).astype(np.uint8)
    answers = {}
    for kernels in ("plain", "vector"):
        out, failed = (
            empty_vertices(cells * each, CPU, with_position=True),
            wp.zeros(cells * each, wp.uint8, device=CPU),
        )
        out.status.assign(answered)
        given = [points, order, chunks, node, drawn_map.view, frame, camera, 2.0e-4, out, failed]
        grid.step_from_directions(cells, given, CPU, 1, kernels)
        answers[kernels] = [failed.numpy()] + [getattr(out, field).numpy() for field in VERTEX_ARRAYS[:-1]]
    assert 30 < answers["plain"][0].sum() < 0.5 * cells * each
    assert ((answers["plain"][2] == 1) & (answered == 0)).sum() > 200
    for got, want, field in zip(answers["vector"], answers["plain"], ("failed", *VERTEX_ARRAYS), strict=False):
        np.testing.assert_array_equal(got, want, err_msg=field)


def test_rays_are_put_in_doubt_by_coarse_triangles_as_the_plain_kernel_does():
    """Rays before, behind, along and through corners and edges of triangles, some without area."""
    scene = lit_room([])
    rng = np.random.default_rng(4)
    count, corners = 333, scene.host_points[scene.host_triangles].astype(np.float64)
    coarse = rng.choice(len(corners), 48, replace=False).astype(np.int32)
    at = coarse[rng.integers(0, 48, count)]
    weights = rng.dirichlet((1.0, 1.0, 1.0), count)
    weights[::5] = (1.0, 0.0, 0.0)
    weights[1::5] = (0.5, 0.5, 0.0)
    goal = np.einsum("nk,nkc->nc", weights, corners[at])
    start = goal + rng.normal(size=(count, 3))
    ray = (goal - start) / np.linalg.norm(goal - start, axis=1, keepdims=True) * rng.choice([-1.0, 1.0], (count, 1))
    settled = rng.choice([0, 1, 2, 3], count).astype(np.uint8)
    length = np.linalg.norm(goal - start, axis=1) * rng.choice([0.5, 1.0, 2.0], count)
    triangle = np.where(settled == 3, -1, rng.choice([0, 5], count) + at * rng.integers(0, 2, count)) % len(corners)
    triangle[settled == 3] = -1
    layer = SimpleNamespace(
        triangle=wp.array(triangle, dtype=int, device=CPU), distance=wp.array(length, dtype=float, device=CPU)
    )
    vectors = [wp.array(np.float32(each), dtype=wp.vec3, device=CPU) for each in (start, ray)]
    marks = {}
    for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2)):
        marks[kernels, threads] = wp.array(settled, dtype=wp.uint8, device=CPU)
        settings = wr.Settings(kernels=kernels, threads=threads)
        chosen = wp.array(coarse, dtype=int, device=CPU)
        refine.doubt_coarse(scene, chosen, *vectors, layer, marks[kernels, threads], settings)
    plain = marks["plain", 1].numpy()
    assert 30 < ((plain == 0) & (settled != 0)).sum() < (settled != 0).sum() - 30
    np.testing.assert_array_equal(marks["vector", 1].numpy(), plain)
    np.testing.assert_array_equal(marks["vector", 2].numpy(), plain)
