"""Vector kernels of waves, crossings and look-ups against the plain ones: frames of every kind of clear surface."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from panes import EYE, GLASS, WATER, balls, frame, stage, upright, with_finish
from rooms import placed, sphere, square

import warp_reflect as wr
from warp_reflect import raster, surface, transmission, waves
from warp_reflect.finishes.still_picture import make_picture
from warp_reflect.finishes.water_vector import fill_blocks_kernel, reflect_blocks_kernel, refract_blocks_kernel
from warp_reflect.launch import recorded
from warp_reflect.shade import look
from warp_reflect.transmission_vector import cross_blocks_kernel
from warp_reflect.waves_vector import wave_blocks_kernel

BLOCKS = [fill_blocks_kernel, reflect_blocks_kernel, refract_blocks_kernel, cross_blocks_kernel, wave_blocks_kernel]
# So steep that rays reflected in them would go down into the water, were they not turned up again.
WAVY = with_finish(WATER, wave_slope=0.3, wave_length=0.7, wave_speed=1.0)


def clear_things():
    """Water, a tinted and a vertex-coloured pane, a coated one, a ball of glass, an ellipsoid of facets, a frosted pane."""
    painted = square(3, 0.5)
    painted.colors = np.random.default_rng(3).random((len(painted.points), 3)).astype(np.float32)
    painted.color_index = painted.triangles
    pane, world = upright(0.4, 0.5)
    world[0, 3], world[1, 3] = -1.0, 0.4
    ball = dataclasses.replace(sphere(8, 12), parts=[])
    tinted = dataclasses.replace(GLASS, base_color=(0.9, 0.5, 0.3), opacity=0.8, transmission=0.7, roughness=0.1)
    coated = dataclasses.replace(GLASS, clearcoat=0.7, clearcoat_roughness=0.1, ior=1.3)
    return [
        (square(1, 20.0), placed(0, 0, -3), WAVY),
        (pane, world, tinted),
        (painted, placed(1.0, 0.05, 1.0) @ upright(0.0)[1], dataclasses.replace(tinted, uses_vertex_color=True)),
        (sphere(), placed(-0.4, 0.2, 0.8, 0.25), GLASS),
        (ball, placed(0.5, 0.25, 0.4, 0.3), coated),
        (*upright(-0.5, 0.4), with_finish(coated, frost=4.0, frost_distance=1.0)),
        *balls(),
    ]


def tilted():
    """A parallel camera must look down to see the water at all."""
    world = placed(0.0, 2.0, 3.0)
    world[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.8, 0.6], [0.0, -0.6, 0.8]]
    return world


UNDER = placed(0.1, -0.4, 2.0)


# Of the vector kernels of looked-up pictures those of traced ones, waves and crossings, are two: one eye is enough for these.
@pytest.mark.parametrize(
    "camera, projection, mode, threads",
    [
        (EYE, "perspective", "lookup", 2),
        (UNDER, "perspective", "lookup", 1),
        (tilted(), "orthographic", "lookup", 2),
        (EYE, "perspective", "traced", 2),
    ],
)
def test_frames_of_clear_surfaces_are_those_of_the_plain_kernels(camera, projection, mode, threads):
    scene = stage(*clear_things(), camera=camera, projection=projection)
    shown = {}
    for kernels, count in dict.fromkeys((("plain", 1), ("vector", 1), ("vector", threads))):
        with recorded() as launches:
            shown[kernels, count] = frame(scene, (173, 97), waves=mode, kernels=kernels, threads=count)
        names = {name for name, _ in launches}
        assert not (kernels == "plain" and any("block" in name for name in names))
    plain, vectors = shown["plain", 1], shown["vector", 1]
    used = {f"{kernel.module.name}.{kernel.key}" for kernel in BLOCKS} & names
    assert len(used) == (2 if mode == "traced" else 5)
    assert len(plain.plan.panes) == 6 and plain.transmitted.keys() == vectors.transmitted.keys()
    for channel in ("RGBA", "reflection"):
        off = np.abs(vectors[channel] - plain[channel]).max(axis=2)
        assert np.isfinite(vectors[channel]).all()
        assert np.quantile(off, 0.99) < 1e-4 and (off > 1e-3).mean() < 2e-3
        np.testing.assert_array_equal(shown["vector", threads][channel], vectors[channel])


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_rays_behind_a_surface_are_those_of_the_plain_kernel(projection):
    """Of every surface, plain, with waves, and through a cone."""
    scene = stage(*clear_things(), camera=EYE if projection == "perspective" else tilted(), projection=projection)
    plan = wr.make_plan(scene, size=(173, 97))
    gbuffer = raster.draw_scene(scene, plan.camera)
    parts = [pane.part for pane in plan.panes]
    mirrors = {part + 1: part for part in parts[::2]}
    _, gbuffer.reflector_id = surface.mirror_pixels(scene, gbuffer, mirrors)
    seen = surface.part_pixels(scene, gbuffer, parts, {})
    finish = {pane.part: scene.data.materials[scene.parts[pane.part].material].finish for pane in plan.panes}
    asked = {part: each or WAVY.finish for part, each in finish.items()}
    interfaces = transmission.make_interfaces(scene, asked)
    shown = look(scene, gbuffer)
    wavy = {parts[0]: WAVY.finish}
    normals = {k: waves.wave_normals(scene, gbuffer, shown.normals, wavy, seen, 1, k) for k in ("plain", "vector")}
    # The vector kernel's exponential is a polynomial; sums are taken in the plain kernel's order.
    np.testing.assert_allclose(normals["vector"].numpy(), normals["plain"].numpy(), atol=2e-6)
    assert (np.abs(normals["plain"].numpy()).max(axis=1) > 0.0).sum() > 2000
    shown = dataclasses.replace(shown, normals=normals["plain"])
    for part in seen:
        for sample, turned in (((0, 0), False), ((0, 0), True), ((1, 4), False)):
            rays = [
                transmission.look_through(
                    scene, shown, interfaces, seen[part], wr.Settings(kernels=kernels), sample, turned
                )
                for kernels in ("plain", "vector")
            ]
            for name in ("normal", "direction"):
                got, want = (getattr(each.layer.pixels, name).numpy() for each in rays)
                np.testing.assert_allclose(got, want, atol=2e-6, err_msg=f"{name} of {part}")
            for name in ("weight", "inside"):
                got, want = (getattr(each, name).numpy() for each in rays)
                np.testing.assert_allclose(got, want, atol=2e-6, err_msg=f"{name} of {part}")


def test_the_still_picture_is_the_same_bit_for_bit():
    rng = np.random.default_rng(1)
    pixel = np.sort(rng.choice(40 * 30, 333, replace=False)).astype(np.int32)
    vectors = [rng.normal(size=(333, 3)).astype(np.float32) for _ in range(3)]
    vectors[1][:5] = 0.0
    normal, direction, radiance = (wp.array(each, dtype=wp.vec3, device="cpu") for each in vectors)
    box = (int((pixel % 40).min()), int(pixel[0]) // 40, int((pixel % 40).max()) + 1, int(pixel[-1]) // 40 + 1)
    point = wp.zeros(333, dtype=wp.vec3, device="cpu")
    pixels = surface.MirrorPixels(1, wp.array(pixel, dtype=int, device="cpu"), point, normal, direction, box)
    triangle = wp.array(rng.integers(-1, 3, 333).astype(np.int32), dtype=int, device="cpu")
    way = wp.array(rng.choice([0.0, 1e-3, 1.0, 1e4], 333).astype(np.float32), dtype=float, device="cpu")
    for asked in ({"hits": (triangle, way)}, {"nearness": way}):
        plain, *others = (
            make_picture(pixels, radiance, 40, threads=threads, kernels=kernels, **asked)
            for kernels, threads in (("plain", 1), ("vector", 1), ("vector", 2))
        )
        texels = plain.texels.numpy().reshape(plain.height, plain.width, 4)
        assert (texels[..., 3] >= 0.0).sum() == 333 and np.isfinite(texels).all()
        assert (texels[[0, -1], :, 3] < 0.0).all() and (texels[:, [0, -1], 3] < 0.0).all()
        for other in others:
            np.testing.assert_array_equal(other.texels.numpy(), plain.texels.numpy())
