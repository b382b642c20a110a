"""Mirrors seen in mirrors against a recursive ray tracer in float64 that knows spheres, squares and a sky by formula."""

import dataclasses
import itertools

import numpy as np
import pytest
from rooms import placed, sphere, square

import warp_reflect as wr
from warp_reflect import frame as frame_module
from warp_reflect import launch, shade
from warp_reflect.layers import undivided
from warp_reflect.scene import CameraData, InstanceData, MaterialData, Scene, SceneData

SIZE = (120, 68)
SKY, SLOPE = 0.5, 0.3  # without lights: SKY + SLOPE * y
BOUNCES = "warp_reflect.bounces"


def silver(value):
    return MaterialData(base_color=(value,) * 3, metallic=1.0, roughness=0.0)


GLOW = MaterialData(base_color=(0, 0, 0), emissive=(0.9, 0.2, 0.05), ior=1.0, roughness=1.0)


def standing(z, facing):
    """A square in the plane z = const that faces +z or -z."""
    matrix = np.eye(4)
    matrix[:3, :3] = [[1, 0, 0], [0, 0, -facing], [0, facing, 0]]
    matrix[2, 3] = z
    return matrix


def world(objects, eye=(0.3, 0.2, 1.2), focal_length=18.0):
    """objects: ("ball", centre, radius, material) or ("wall", z, half, material)."""
    ball = sphere(32, 64)
    meshes, instances, materials = [ball], [], []
    for k, (kind, place, size, material) in enumerate(objects):
        if kind == "ball":
            instances.append(InstanceData(0, placed(*place, size), f"/o{k}", (k,)))
        else:
            meshes.append(square(1, size))
            instances.append(InstanceData(len(meshes) - 1, standing(place, -np.sign(place)), f"/o{k}", (k,)))
        materials.append(material)
    camera = CameraData("/camera", placed(*eye), near=0.01, focal_length=focal_length)
    return Scene(SceneData("bounces", meshes, instances, materials, [], [camera]))


def first_hit(objects, origin, direction, skip):
    """(distance, object, unit normal towards the ray) of the nearest object; None for the sky."""
    best = None
    for k, (kind, place, size, _) in enumerate(objects):
        if k == skip:
            continue
        if kind == "ball":
            to = origin - np.asarray(place, float)
            b, c = to @ direction, to @ to - size * size
            if b * b - c <= 0 or -b - np.sqrt(b * b - c) <= 1e-9:
                continue
            t = -b - np.sqrt(b * b - c)
            n = (to + t * direction) / size
        else:
            t = (place - origin[2]) / direction[2]
            p = origin + t * direction
            if t <= 1e-9 or max(abs(p[0]), abs(p[1])) > size:
                continue
            n = np.array([0.0, 0.0, -np.sign(direction[2])])
        if best is None or t < best[0]:
            best = t, k, n
    return best


def radiance(objects, origin, direction, bounces, skip=-1):
    """Of what a ray sees; the `bounces`-th reflection and all after it show the sky alone."""
    hit = first_hit(objects, origin, direction, skip)
    if hit is None:
        return np.full(3, SKY + SLOPE * direction[1])
    t, k, n = hit
    material = objects[k][3]
    if not material.metallic:
        return np.array(material.emissive)
    onward = direction - 2 * (direction @ n) * n
    if bounces == 0:
        return np.array(material.base_color) * (SKY + SLOPE * onward[1])
    return np.array(material.base_color) * radiance(objects, origin + t * direction, onward, bounces - 1, k)


def wanted(objects, frame, pixels, bounces):
    camera = frame.camera
    points = frame.relative("mirrorPoint").astype(np.float64)
    result = []
    for y, x in pixels:
        d = points[y, x] / np.linalg.norm(points[y, x])
        result.append(radiance(objects, np.asarray(camera.eye, float), d, bounces))
    return np.array(result)


def rendered(scene, size=SIZE, method="auto", **settings):
    settings = {"shadows": "off"} | settings
    return wr.render_frame(scene, wr.make_plan(scene, size=size, settings=wr.Settings(**settings), method=method))


def some_pixels(frame, count=150):
    pixels = np.argwhere(frame["reflectorId"] > 0)
    return pixels[np.random.default_rng(0).permutation(len(pixels))[:count]]


BALLS = [
    ("ball", (-0.8, 0.0, -2.0), 0.7, silver(0.9)),
    ("ball", (0.8, 0.1, -2.2), 0.6, silver(0.8)),
    ("ball", (0.0, -0.9, -1.6), 0.35, GLOW),
]
WALLS = [
    ("wall", -2.0, 3.0, silver(0.9)),
    ("wall", 2.0, 3.0, silver(0.85)),
    ("ball", (1.0, 0.3, 0.0), 0.3, GLOW),
]


@pytest.mark.parametrize("objects", [BALLS, WALLS], ids=["balls", "walls"])
@pytest.mark.parametrize("bounces", [1, 2, 3, 6])
def test_every_reflection_is_that_of_a_recursive_tracer(objects, bounces):
    frame = rendered(world(objects), bounces=bounces, method="reference")
    pixels = some_pixels(frame)
    assert len(pixels) == 150
    got = frame["RGBA"][pixels[:, 0], pixels[:, 1], :3]
    error = np.abs(got - wanted(objects, frame, pixels, bounces)).max(axis=1)
    # Ten pixels of a hundred and fifty may lie where a ray of float32 passes an outline on the other side.
    assert np.sort(error)[-10] < 2e-4 and np.median(error) < 2e-5, np.sort(error)[-12:]


def test_forward_and_traced_frames_show_the_same_second_reflections():
    scene = world(BALLS)
    forward, traced = rendered(scene, method="quadric"), rendered(scene, method="reference")
    assert {row.technique for row in forward.plan.rows} == {"quadric"}
    same = (forward["reflectedId"] == traced["reflectedId"]) & (forward["reflectorId"] > 0)
    assert same.sum() > 0.99 * (forward["reflectorId"] > 0).sum()
    assert np.sort(np.abs(forward["RGBA"] - traced["RGBA"])[same].max(axis=1))[: -same.sum() // 200].max() < 1e-4


def test_facing_mirrors_end_and_converge():
    """Each reflection of two facing mirrors is dimmer: the picture converges, and what is left is counted."""
    scene = world(WALLS)
    frames = [rendered(scene, bounces=n) for n in (8, 24, 64)]
    steps = [np.abs(a["RGBA"] - b["RGBA"]).max() for a, b in itertools.pairwise(frames)]
    assert all(np.isfinite(frame["RGBA"]).all() and frame["RGBA"].max() <= 1.0 for frame in frames)
    # What is left after 24 reflections of 0.9 and 0.85 in turn is 0.765^12 = 0.04 of a sky of 0.5.
    assert steps[1] <= 0.02 < steps[0]
    assert frames[0].statistics["bounce_limit"] > 0 and frames[0].statistics["bounced"] > 0


def test_mirror_behind_a_pane_reflects_what_is_around_it():
    pane = MaterialData(transmission=1.0, ior=1.0, base_color=(0, 0, 0), roughness=0.0)
    objects = [BALLS[0], BALLS[2]]
    scene = world([*objects, ("wall", -0.5, 2.0, pane)])
    frame = rendered(scene)
    bare = rendered(world(objects))
    # An index of 1 neither bends nor reflects.
    there = bare["reflectorId"] > 0
    np.testing.assert_allclose(frame["RGBA"][there], bare["RGBA"][there], atol=2e-3)
    glowing = there & (bare["RGBA"][..., 0] > 2.0 * bare["RGBA"][..., 1])
    assert glowing.sum() > 5


def test_nothing_of_it_runs_where_no_mirror_sees_one(device):
    for objects, settings, why in (
        ([BALLS[0], BALLS[2]], {}, "the only mirror, and convex: it shows none"),
        (BALLS, {"bounces": 1}, "bounces=1: a mirror seen in a mirror shows its base and the dome"),
        (
            [BALLS[0], ("ball", (0.0, 0.0, 40.0), 0.05, silver(0.5))],
            {},
            "no point of it that was tried shows a mirror",
        ),
    ):
        with launch.recorded() as launches:
            frame = rendered(world(objects), **settings)
        assert frame.plan.rows[0].effects["second_bounce"] == dataclasses.replace(
            frame.plan.rows[0].effects["second_bounce"], on=False, reason=why
        )
        assert not [name for name in launches if "reflect_hits" in str(name)]
    with launch.recorded() as launches:
        frame = rendered(world(BALLS))
    assert frame.plan.rows[0].effects["second_bounce"].on
    assert [name for name in launches if "reflect_hits" in str(name)]


# Two balls side by side among the ids, and a wall that a plane's technique takes from between mirrors or from their end.
MIXED = [WALLS[0], *BALLS, ("ball", (0.1, 0.8, -1.9), 0.3, silver(0.7))]


@pytest.mark.parametrize("method", ["reference", "planar", "quadric"])
@pytest.mark.parametrize("turned", [False, True])
def test_mirrors_done_together_are_those_done_one_by_one(method, turned, monkeypatch):
    scene = world(MIXED[::-1] if turned else MIXED)
    settings = {"bounces": 3, "shadows": "on"}
    together = [rendered(scene, method=method, threads=threads, **settings) for threads in (1, 2, 8)]
    wholes = {id(layer.whole) for layer in together[0].layers.values() if layer.whole is not None}
    assert len(together[0].layers) == 4 and len(wholes) == (method != "quadric")
    monkeypatch.setattr(
        frame_module, "_together", lambda rows, pixels: [[row] for row in rows if pixels[row.reflector.id].count]
    )
    alone = rendered(scene, method=method, threads=1, **settings)
    assert all(layer.whole is None for layer in alone.layers.values())
    for frame in together:
        for name in ("RGBA", "reflection", "reflectedPoint", "pathLength", "status", "reflectedId"):
            np.testing.assert_array_equal(frame[name], alone[name], err_msg=name)
        for id_, layer in frame.layers.items():
            assert dict(layer.statistics) == dict(alone.layers[id_].statistics)
    assert together[0].statistics["bounced"] > 100


def test_mirrors_that_were_done_together_are_shaded_by_themselves_where_one_is_missing():
    scene = world(MIXED)
    frame = rendered(scene, method="reference")
    others = dict(frame.layers)
    others[1] = dataclasses.replace(others[1], whole=None)  # as it is where it was answered in another frame
    assert len(undivided(frame.layers.values())) == 1 and len(undivided(others.values())) == 4
    pictures = [shade.shade(scene, frame.gbuffer, layers) for layers in (frame.layers, others)]
    for whole, parts in zip(*pictures, strict=True):
        np.testing.assert_array_equal(whole.numpy(), parts.numpy())


def test_threads_do_not_change_a_pixel():
    one, two = (rendered(world(BALLS), bounces=4, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one["RGBA"], two["RGBA"])
    assert one.statistics == two.statistics


@pytest.mark.parametrize("method", ["planar", "quadric"])
def test_flat_mirror_solves_what_it_shows_from_the_eye_behind_it(method):
    """Two facing walls and a ball between them: pictures from the mirrored eye against rays, and against the tracer."""
    objects = [*WALLS, ("ball", (-0.3, -0.2, -0.8), 0.4, silver(0.8))]
    scene = world(objects)
    forward, traced = (rendered(scene, method=how, bounces=3) for how in (method, "reference"))
    solved = {row.path: row.effects["second_bounce"].numbers.get("solved") for row in forward.plan.rows if row.pixels}
    if method == "planar":
        assert solved["/o0"] == {2: "planar"} and forward.statistics["mirrored_eye"] > 100
        assert "/o1 by planar from the eye behind it" in str(forward.plan)
        assert not any(solved.get(row.path) for row in forward.plan.rows if row.path == "/o3")
    else:
        assert solved["/o0"] == {3: "quadric"}
    assert "mirrored_eye" not in traced.statistics
    error = np.abs(forward["RGBA"] - traced["RGBA"]).max(axis=-1)
    assert np.mean(error < 1e-4) > 0.998, np.sort(error.reshape(-1))[-20:]
    pixels = some_pixels(forward)
    got = forward["RGBA"][pixels[:, 0], pixels[:, 1], :3]
    off = np.abs(got - wanted(objects, forward, pixels, 3)).max(axis=1)
    assert np.sort(off)[-10] < 2e-4, np.sort(off)[-12:]


def test_turned_rays_of_a_flat_mirror_are_traced():
    """A rough flat mirror's jittered rays come from no mirrored eye."""
    rough = dataclasses.replace(silver(0.9), roughness=0.1)
    scene = world([("wall", -2.0, 3.0, rough), *WALLS[1:]])
    settings = {"glossy": "accumulate", "glossy_samples": 2, "size": (64, 36)}
    forward, traced = (rendered(scene, method=how, **settings) for how in ("planar", "reference"))
    error = np.abs(forward["RGBA"] - traced["RGBA"]).max(axis=-1)
    assert np.mean(error < 1e-3) > 0.99
