"""Analytic gprims: vertices on their surface, outward winding, volumes in closed form."""

import numpy as np
import pytest

from warp_reflect.stage import gprims
from warp_reflect.topology import edge_neighbours

# Each solid, its volume, and how many patches it has.
SOLIDS = {
    "sphere": (gprims.sphere(2.0), 4.0 / 3.0 * np.pi * 8.0, 1),
    "cube": (gprims.cube(3.0), 27.0, 6),
    "cylinder": (gprims.cylinder(1.0, 1.0, 4.0, "X"), np.pi * 4.0, 3),
    "frustum": (gprims.cylinder(1.0, 2.0, 3.0, "Y"), np.pi * 3.0 / 3.0 * (1.0 + 2.0 + 4.0), 3),
    "cone": (gprims.cone(1.5, 2.0, "Z"), np.pi * 2.25 * 2.0 / 3.0, 2),
    "cone_upside_down": (gprims.cylinder(0.0, 1.5, 2.0, "Z"), np.pi * 2.25 * 2.0 / 3.0, 2),
    "capsule": (gprims.capsule(0.5, 0.5, 1.0, "Y"), np.pi * (0.25 + 0.5 / 3.0), 3),
    "capsule_flat": (gprims.capsule(1.0, 1.0, 0.0, "X"), np.pi * 4.0 / 3.0, 2),
    "long_capsule_fine": (gprims.capsule(0.5, 0.25, 10.0, "X", 1), None, 3),
}


def unit_points(mesh, patch):
    first = patch.first_triangle
    corners = mesh.triangles[first : first + patch.triangle_count]
    points = mesh.points[corners].reshape(-1, 3).astype(float)
    unit = patch.shape.unit_from_object
    return points @ unit[:3, :3].T + unit[:3, 3]


@pytest.mark.parametrize("name", SOLIDS)
def test_gprim_vertices_lie_on_their_patch(name):
    mesh = SOLIDS[name][0]
    for patch in mesh.parts[0].patches:
        x, y, z = unit_points(mesh, patch).T
        shape = patch.shape
        value = z if shape.kind == "plane" else x**2 + y**2 + shape.a * z**2 + shape.b * z - shape.c
        # float32 vertices: each unit coordinate is off by half an ulp of the largest coordinate in the sum.
        rounding = 2.0**-24 * np.abs(mesh.points).max() * np.abs(shape.unit_from_object[:3, :3]).max()
        assert np.abs(value).max() < 8.0 * rounding
        if shape.kind == "quadric":
            assert z.min() > shape.z_min - 1e-6 and z.max() < shape.z_max + 1e-6


@pytest.mark.parametrize("name", SOLIDS)
def test_gprim_normals_are_the_gradient_of_their_patch(name):
    mesh = SOLIDS[name][0]
    for patch in mesh.parts[0].patches:
        x, y, z = unit_points(mesh, patch).T
        shape = patch.shape
        gradient = np.stack([x, y, shape.a * z + 0.5 * shape.b], axis=1)
        if shape.kind == "plane":
            gradient = np.tile([0.0, 0.0, 1.0], (len(x), 1))
        gradient = gradient @ shape.unit_from_object[:3, :3]
        length = np.linalg.norm(gradient, axis=1)
        regular = length > 1e-5  # the apex of a cone has no gradient
        span = slice(patch.first_triangle, patch.first_triangle + patch.triangle_count)
        normals = mesh.normals[mesh.normal_index[span]].reshape(-1, 3)
        cosine = (gradient[regular] / length[regular, None] * normals[regular]).sum(axis=1)
        assert cosine.min() > 1.0 - 1e-6


@pytest.mark.parametrize("name", SOLIDS)
def test_gprim_is_closed_and_faces_outward(name):
    mesh, volume, patch_count = SOLIDS[name]
    assert len(mesh.parts[0].patches) == patch_count
    assert (edge_neighbours(mesh.triangles) >= 0).all()
    a, b, c = (mesh.points[mesh.triangles[:, k]].astype(float) for k in range(3))
    enclosed = float(np.einsum("nk,nk->n", a, np.cross(b, c)).sum() / 6.0)
    if volume is not None:
        # Inscribed in the solid: smaller, by less than the defect of a 64-gon and of 32 bands.
        assert 0.995 * volume < enclosed <= volume * (1.0 + 1e-6)
    facet = np.cross(b - a, c - a)
    facing = np.einsum("nk,nck->nc", facet, mesh.normals[mesh.normal_index])
    assert (facing > 0.0).all()


@pytest.mark.parametrize(("axis", "spans"), [("X", (0, 3, 2)), ("Y", (2, 0, 3)), ("Z", (2, 3, 0))])
def test_plane_spans_and_faces_its_axis(axis, spans):
    mesh = gprims.plane(2.0, 3.0, axis)
    assert np.ptp(mesh.points, axis=0).tolist() == list(spans)
    a, b, c = (mesh.points[mesh.triangles[0, k]] for k in range(3))
    assert np.cross(b - a, c - a)["XYZ".index(axis)] > 0.0


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_cone_points_along_its_axis(axis):
    mesh = gprims.cone(1.0, 2.0, axis)
    k = "XYZ".index(axis)
    tip = mesh.points[np.argmax(mesh.points[:, k])]
    assert tip[k] == 1.0 and np.abs(np.delete(tip, k)).max() == 0.0


def test_complexity_doubles_the_segments():
    counts = [len(gprims.sphere(1.0, level).triangles) for level in range(3)]
    assert counts[0] == 2 * 64 * 31
    assert counts[1] == 2 * 128 * 63 and counts[2] == 2 * 256 * 127
