"""Subdivision: closed forms of B-splines, invariance of the limit under refinement, normals from fine facets."""

import numpy as np
import pytest
import stage_samples as samples
from pxr import Gf, Sdf, UsdGeom

from warp_reflect.stage.detail import subdivision_level
from warp_reflect.stage.read import read_stage
from warp_reflect.stage.subdivide import Cage, subdivide

CUBE = np.array(samples.CUBE_POINTS, float)
CUBE_FACES = np.array(samples.CUBE_INDICES)
OCTAHEDRON = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], float)
OCTAHEDRON_FACES = np.array([0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5])


def fan(count, quads):
    """Faces around a border vertex (index 0), bent out of the plane."""
    angle = np.linspace(0.0, 0.9 * np.pi, count + 1)
    points = [(0.0, 0.0, 0.0), *((np.cos(a), np.sin(a), 0.2 * np.sin(3.0 * a)) for a in angle)]
    if not quads:
        indices = [i for k in range(count) for i in (0, 1 + k, 2 + k)]
        return Cage(np.full(count, 3), np.array(indices), "edgeOnly"), np.array(points)
    middle = 0.5 * (angle[1:] + angle[:-1])
    points += [(1.4 * np.cos(a), 1.4 * np.sin(a), 0.1 * count) for a in middle]
    indices = [i for k in range(count) for i in (0, 1 + k, count + 2 + k, 2 + k)]
    return Cage(np.full(count, 4), np.array(indices), "edgeOnly"), np.array(points)


def creased(edges, sharpness):
    return Cage(
        np.full(6, 4), CUBE_FACES, crease_edges=np.array(edges), crease_sharpness=np.full(len(edges), sharpness)
    )


MESHES = {
    "cube": ("catmullClark", Cage(np.full(6, 4), CUBE_FACES), CUBE),
    "open_box": ("catmullClark", Cage(np.full(5, 4), CUBE_FACES[4:]), CUBE),
    "open_box_round": ("catmullClark", Cage(np.full(5, 4), CUBE_FACES[4:], "edgeOnly"), CUBE),
    "creased_cube": ("catmullClark", creased([(0, 1), (1, 3), (3, 2), (2, 0)], 10.0), CUBE),
    "octahedron": ("loop", Cage(np.full(8, 3), OCTAHEDRON_FACES), OCTAHEDRON),
    "creased_octahedron": (
        "loop",
        Cage(
            np.full(8, 3),
            OCTAHEDRON_FACES,
            crease_edges=np.array([(0, 2), (2, 1), (1, 3), (3, 0)]),
            crease_sharpness=np.full(4, 10.0),
        ),
        OCTAHEDRON,
    ),
    **{f"quad_fan_{k}": ("catmullClark", *fan(k, True)) for k in (2, 3, 5)},
    **{f"triangle_fan_{k}": ("loop", *fan(k, False)) for k in (2, 3, 4, 5)},
}


def normals_by_vertex(refined, count):
    """Vertex to the set of its fans' normals."""
    found = {vertex: [] for vertex in range(count)}
    owner = np.zeros(len(refined.normals), np.int64)
    owner[refined.normal_index.reshape(-1)] = refined.indices.reshape(-1)
    for k, vertex in enumerate(owner):
        if vertex < count:
            found[vertex].append(refined.normals[k])
    return found


@pytest.mark.parametrize("name", MESHES)
def test_limit_does_not_depend_on_the_level(name):
    scheme, cage, points = MESHES[name]
    coarse, fine = subdivide(scheme, 1, cage, points), subdivide(scheme, 4, cage, points)
    count = len(coarse.points)  # refinement keeps the numbers of old vertices
    np.testing.assert_allclose(coarse.points, fine.points[:count], atol=1e-14)
    before, after = normals_by_vertex(coarse, count), normals_by_vertex(fine, count)
    for vertex in range(count):
        for normal in before[vertex]:
            assert max(other @ normal for other in after[vertex]) > 1.0 - 1e-6


@pytest.mark.parametrize("name", ["cube", "open_box", "creased_cube", "octahedron", "quad_fan_2", "triangle_fan_3"])
def test_limit_normals_are_those_of_ever_finer_facets(name):
    scheme, cage, points = MESHES[name]
    coarse, fine = subdivide(scheme, 1, cage, points), subdivide(scheme, 6, cage, points)
    corner = fine.points[fine.indices]
    ahead, behind = np.roll(corner, -1, axis=1) - corner, np.roll(corner, 1, axis=1) - corner
    facet = np.cross(ahead, behind)
    facet /= np.maximum(np.linalg.norm(facet, axis=2, keepdims=True), 1e-300)
    total = np.zeros_like(fine.normals)
    np.add.at(total, fine.normal_index.reshape(-1), facet.reshape(-1, 3))
    total /= np.linalg.norm(total, axis=1, keepdims=True)
    fine.normals[:] = total
    wanted, got = normals_by_vertex(fine, len(coarse.points)), normals_by_vertex(coarse, len(coarse.points))
    for vertex, normals in got.items():
        for normal in normals:
            # 1.3e-3 rad: what the facets of level 6 are off by, measured; halves with every level.
            assert max(normal @ other for other in wanted[vertex]) > np.cos(2e-3)


@pytest.mark.parametrize("name", MESHES)
def test_normals_point_to_the_counter_clockwise_side(name):
    scheme, cage, points = MESHES[name]
    refined = subdivide(scheme, 3, cage, points)
    corner = refined.points[refined.indices]
    facet = np.cross(corner[:, 1] - corner[:, 0], corner[:, -1] - corner[:, 0])
    assert (np.einsum("nk,nck->nc", facet, refined.normals[refined.normal_index]) > 0.0).all()


def test_flat_grid_is_the_uniform_bicubic_spline():
    """Regular patch: Catmull-Clark is the tensor product of cubic B-splines, in each column of the values."""
    n = 6
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    value = 0.3 * x**2 - 0.1 * x * y + 0.05 * y**3
    points = np.stack([x, y, value], axis=2).reshape(-1, 3).astype(float)
    index = np.arange(n * n).reshape(n, n)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=2).reshape(-1, 4)
    refined = subdivide("catmullClark", 2, Cage(np.full(len(quads), 4), quads.reshape(-1)), points)
    # Cubic B-spline with coefficients x^2 at integers: x^2 + 1/3; x^3: x^3 + x; products separate.
    inner = (np.abs(refined.points[:, :2] - 2.5) < 1.4).all(axis=1)
    px, py, pz = refined.points[inner].T
    expected = 0.3 * (px**2 + 1.0 / 3.0) - 0.1 * px * py + 0.05 * (py**3 + py)
    assert inner.sum() > 50
    np.testing.assert_allclose(pz, expected, atol=1e-12)


def test_border_is_the_cubic_spline_of_its_own_points():
    """Two rows of quads: the border curve of a straight strip depends on its points only."""
    length = 9
    t = np.arange(length)
    rows = [np.stack([t, np.full(length, k), (0.2 + k) * t**2], axis=1) for k in range(3)]
    points = np.concatenate(rows).astype(float)
    index = np.arange(3 * length).reshape(3, length)
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=2).reshape(-1, 4)
    refined = subdivide("catmullClark", 3, Cage(np.full(len(quads), 4), quads.reshape(-1)), points)
    border = refined.points[(np.abs(refined.points[:, 1]) < 1e-12) & (np.abs(refined.points[:, 0] - 4.0) < 2.9)]
    np.testing.assert_allclose(border[:, 2], 0.2 * (border[:, 0] ** 2 + 1.0 / 3.0), atol=1e-12)
    # edgeAndCorner pins the corners, edgeOnly rounds them.
    assert (np.abs(refined.points - points[0]).max(axis=1) < 1e-12).any()
    rounded = subdivide("catmullClark", 3, Cage(np.full(len(quads), 4), quads.reshape(-1), "edgeOnly"), points)
    assert not (np.abs(rounded.points - points[0]).max(axis=1) < 1e-3).any()


def test_infinite_creases_all_over_keep_the_cage():
    edges = {tuple(sorted((f[i], f[(i + 1) % 4]))) for f in CUBE_FACES.reshape(-1, 4) for i in range(4)}
    refined = subdivide("catmullClark", 3, creased(sorted(edges), 10.0), CUBE)
    assert np.allclose(np.abs(refined.points).max(axis=1), 1.0, atol=1e-14)
    axis = np.abs(refined.normals[refined.normal_index]).max(axis=2)
    np.testing.assert_allclose(axis, 1.0, atol=1e-12)


def test_sharper_creases_stay_closer_to_the_cage():
    reach = [
        subdivide("catmullClark", 4, creased([(0, 1), (1, 3), (3, 2), (2, 0)], s), CUBE).points[0, 2]
        for s in (0.0, 0.5, 1.0, 2.0, 3.0, 10.0)
    ]
    assert (np.diff(reach) < 0.0).all()
    # An infinite crease around a planar square: its corner is on the square's own cubic spline, in its plane.
    assert reach[-1] == pytest.approx(-1.0, abs=1e-14)


def test_boundary_rule_none_drops_border_faces():
    n = 5
    index = np.arange(n * n).reshape(n, n)
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    points = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3).astype(float)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=2).reshape(-1, 4)
    refined = subdivide("catmullClark", 1, Cage(np.full(16, 4), quads.reshape(-1), "none"), points)
    used = refined.points[refined.indices.reshape(-1)]
    assert len(refined.indices) == 4 * 4 and used[:, 0].min() == 1.0 and used[:, 0].max() == 3.0


def test_refined_attributes_follow_their_interpolation():
    cage = Cage(np.full(6, 4), CUBE_FACES)
    corner_values = np.arange(24.0)[:, None]
    refined = subdivide("catmullClark", 2, cage, np.hstack([CUBE, CUBE]), CUBE[:, :1], corner_values)
    np.testing.assert_allclose(refined.points[:, 3:], refined.points[:, :3])
    assert set(np.unique(refined.varying)) == {-1.0, -0.5, 0.0, 0.5, 1.0}
    # Linear inside each face: the mean over a face's descendants is the mean of its corners.
    for face in range(6):
        mean = refined.face_varying[refined.source == face].mean()
        assert mean == pytest.approx(corner_values[4 * face : 4 * face + 4].mean())


def test_degenerate_cages_give_finite_surfaces():
    """Three faces on an edge, two sheets on a vertex, a repeated corner's face turned around."""
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (1, 0, 1), (0, 0, 1), (0, 0, -1), (1, 0, -1)], float)
    indices = np.array([0, 1, 2, 3, 0, 1, 4, 5, 1, 0, 6, 7])
    refined = subdivide("catmullClark", 3, Cage(np.full(3, 4), indices), points)
    assert np.isfinite(refined.points).all() and np.isfinite(refined.normals).all()
    np.testing.assert_allclose(np.linalg.norm(refined.normals, axis=1), 1.0)
    cubes = np.concatenate([CUBE + 1.0, CUBE - 1.0])
    both = np.concatenate([CUBE_FACES, CUBE_FACES + 8])
    both[both == 15] = 0  # the second cube's top corner is the first one's bottom corner
    touching = subdivide("catmullClark", 2, Cage(np.full(12, 4), both), cubes)
    assert np.isfinite(touching.points).all()
    assert np.abs(touching.points[0]).max() < 1e-14  # pinned where they touch


@pytest.mark.parametrize(
    ("faces", "mirror", "pixels", "level"),
    [
        (6, False, 31.0, 0),
        (6, False, 33.0, 1),
        (6, False, np.inf, 1),
        (200_000, False, 600.0, 0),
        (6, True, 8.0, 0),
        (6, True, 10.0, 1),
        (6, True, np.inf, 4),
        (6, True, 100.0, 4),
        (1000, True, 200.0, 1),
        (1000, True, 400.0, 2),
        (100_000, True, 500.0, 1),
        (1_000_000, True, 500.0, 0),
    ],
)
def test_level_follows_role_and_size(faces, mirror, pixels, level):
    assert subdivision_level(faces, mirror, pixels) == level


@pytest.fixture
def stage(tmp_path):
    return samples.new_stage(tmp_path / "stage.usda")


def test_mesh_without_a_scheme_is_subdivided_onto_its_limit(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube")
    mesh.GetSubdivisionSchemeAttr().Clear()
    mesh.CreateNormalsAttr([Gf.Vec3f(1, 0, 0)] * 8)  # ignored on a subdivision surface
    path = samples.saved(stage)
    meshes = [read_stage(path, complexity=c).meshes[0] for c in ("medium", "high")]
    assert [len(m.triangles) for m in meshes] == [48, 192]
    corner = meshes[1].points[7]
    # One step by hand: vertex 5/9, edge points sum to 3/2, face points to 1; (9 * 5/9 + 4 * 3/2 + 1) / 24.
    np.testing.assert_allclose(corner, 0.5, atol=1e-7)
    normals = meshes[1].normals[meshes[1].normal_index]
    facing = np.einsum("nck,nck->nc", normals, meshes[1].points[meshes[1].triangles])
    assert (facing > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(meshes[1].normals, axis=1), 1.0, atol=1e-6)


def test_left_handed_subdivided_mesh_faces_outward(stage):
    indices = [i for k in range(0, 24, 4) for i in reversed(samples.CUBE_INDICES[k : k + 4])]
    mesh = samples.add_mesh(stage, "/Cube", samples.CUBE_POINTS, [4] * 6, indices, "catmullClark")
    mesh.CreateOrientationAttr("leftHanded")
    drawn = read_stage(samples.saved(stage), complexity="medium").meshes[0]
    a, b, c = (drawn.points[drawn.triangles[:, k]] for k in range(3))
    facet = np.cross(b - a, c - a)
    assert (np.einsum("nk,nk->n", facet, a) > 0.0).all()
    assert (np.einsum("nk,nck->nc", facet, drawn.normals[drawn.normal_index]) > 0.0).all()


def test_holes_creases_and_subsets_survive_subdivision(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube", "catmullClark")
    mesh.CreateHoleIndicesAttr([0])
    mesh.CreateCreaseIndicesAttr([0, 1, 3, 2, 0])
    mesh.CreateCreaseLengthsAttr([5])
    mesh.CreateCreaseSharpnessesAttr([10.0])
    from pxr import UsdShade

    subset = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).CreateMaterialBindSubset("top", [1], "face")
    samples.bind(subset, samples.add_material(stage, "/Blue", diffuseColor=(0.0, 0.0, 1.0)))
    drawn = read_stage(samples.saved(stage), complexity="high").meshes[0]
    assert [(p.subset, p.triangle_count) for p in drawn.parts] == [("", 4 * 32), ("top", 32)]
    used = drawn.points[np.unique(drawn.triangles)]
    assert used[:, 2].min() == -1.0  # the crease keeps the rim of the hole in its plane


def test_bad_creases_are_told_and_left_out(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube", "catmullClark")
    mesh.CreateCreaseIndicesAttr([0, 99])
    mesh.CreateCreaseLengthsAttr([2])
    mesh.CreateCreaseSharpnessesAttr([1.0])
    data = read_stage(samples.saved(stage), complexity="medium")
    assert len(data.instances) == 1
    assert any("creaseIndices: got a value outside 0 to 7" in note.text for note in data.notes)


def test_mirrors_get_more_detail_than_the_rest(stage):
    for name, x in (("Mirror", -2), ("Wall", 2)):
        cube = samples.add_cube_mesh(stage, f"/{name}", "catmullClark")
        cube.AddTranslateOp().Set(Gf.Vec3d(x, 0, 0))
    samples.bind(
        stage.GetPrimAtPath("/Mirror"),
        samples.add_material(stage, "/Metal", metallic=1.0, roughness=0.0, diffuseColor=(1.0, 1.0, 1.0)),
    )
    camera = UsdGeom.Camera.Define(stage, "/Camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, 0, 20))
    path = samples.saved(stage)

    def sizes(**arguments):
        data = read_stage(path, **arguments)
        return {i.prim_path: len(data.meshes[i.mesh].triangles) for i in data.instances}

    assert sizes() == {"/Mirror": 12 * 4**4, "/Wall": 12 * 4}
    assert sizes(reflectors=("Wall",)) == {"/Mirror": 12 * 4**4, "/Wall": 12 * 4**4}
    camera.GetOrderedXformOps()[0].Set(Gf.Vec3d(0, 0, 5000))
    stage.GetRootLayer().Save()
    assert sizes() == {"/Mirror": 12, "/Wall": 12}


def test_vertex_and_face_varying_values_reach_refined_corners(stage):
    mesh = samples.add_cube_mesh(stage, "/Cube", "catmullClark")
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "vertex")
    primvar.Set([Gf.Vec3f(*p) for p in samples.CUBE_POINTS])
    drawn = read_stage(samples.saved(stage), complexity="medium").meshes[0]
    # Refined by the same rules as the points: still equal to them.
    np.testing.assert_allclose(drawn.colors, drawn.points, atol=1e-6)
