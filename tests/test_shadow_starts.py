"""Where shadow rays start: blocks of points against the plain kernel, bit for bit."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from test_vector import lights_of, lit_room

from warp_reflect import direct, raster, shadow_starts
from warp_reflect.layers import Camera

# Points, normals, facets and shifts; vectors keep more behind them where shapes need it.
ROWS = int(shadow_starts.ROWS)


def same_starts(scene, plain_points, vector_points, normals=None, numbered=False):
    areas, count = len(scene.lights.direct.areas), len(plain_points.triangle)
    plain = shadow_starts.starts_of(scene, plain_points, normals, areas, 1, numbered, "plain")
    assert np.isfinite(plain.rows.numpy()[:, :count]).all()
    for threads in (1, 2):
        got = shadow_starts.starts_of(scene, vector_points, normals, areas, threads, numbered, "vector")
        np.testing.assert_array_equal(got.rows.numpy()[:ROWS, :count], plain.rows.numpy()[:, :count])
        np.testing.assert_array_equal(got.unshadowed.numpy()[:, :count], plain.unshadowed.numpy()[:, :count])
    return plain


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("kind", ["spheres", "shapes"])
def test_rays_start_bit_for_bit_where_the_plain_kernel_has_them_start(kind, projection):
    """Analytic, smooth, torn and flat surfaces, a speck, silhouettes, sky; spheres below the horizon and around points."""
    scene = lit_room(lights_of(kind), projection)
    gbuffer = raster.draw_scene(scene, Camera.from_data(scene.data.cameras[0], (173, 101)))
    triangle = gbuffer.triangle.numpy()
    assert len(np.unique(triangle)) > 300 and (triangle < 0).any()
    weighed = direct.points_of(scene, gbuffer, None, 1)
    # What the eye sees, with weights found before and on the way.
    plain = same_starts(scene, weighed, weighed)
    same_starts(scene, weighed, direct.points_of(scene, gbuffer, None, 1, weighed=False))
    brought = plain.unshadowed.numpy()[:, : len(triangle)]
    assert (brought.max(1) > 0).all() and (brought[:, triangle < 0] == 0).all()
    # Some pixels only, with normals of maps at a third of them, shifted by pixels and by numbers.
    rng = np.random.default_rng(5)
    chosen = np.flatnonzero(rng.random(len(triangle)) < 0.4).astype(np.int32)
    some = direct.points_of(scene, gbuffer, None, 1, chosen)
    mapped = rng.normal(size=(len(chosen), 3)).astype(np.float32)
    mapped /= np.linalg.norm(mapped, axis=1)[:, None]
    mapped[rng.random(len(chosen)) < 0.66] = 0.0
    normals = wp.array(mapped, dtype=wp.vec3, device="cpu")
    for numbered in (False, True):
        same_starts(scene, some, some, normals, numbered)
    same_starts(scene, some, direct.points_of(scene, gbuffer, None, 1, chosen, weighed=False), normals)


def test_points_of_triangles_without_area_start_somewhere():
    scene = lit_room(lights_of("spheres"))
    gbuffer = raster.draw_scene(scene, Camera.from_data(scene.data.cameras[0], (64, 16)))
    corners = scene.host_triangles.copy()
    flat = np.linspace(0, len(corners) - 1, 40).astype(int)
    corners[flat[::2], 1] = corners[flat[::2], 0]
    corners[flat[1::2]] = corners[flat[1::2], :1]
    scene.view.triangles.assign(corners.astype(np.int32).reshape(scene.view.triangles.numpy().shape))
    scene.host_triangles[:] = corners
    count = len(gbuffer.triangle)
    points = replace(
        direct.points_of(scene, gbuffer, None, 1),
        triangle=wp.array(np.resize(flat, count), dtype=int, device="cpu"),
    )
    facet = same_starts(scene, points, points).rows.numpy()[6:9, :count]
    assert not facet.any()
