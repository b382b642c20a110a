"""The interpolation grid: the octree's cells, the error of what is interpolated against the full search, refinement."""

import numpy as np
import pytest
from rooms import CHROME, placed, render, room, sphere

import warp_reflect as wr
from warp_reflect.scene import CameraData, InstanceData, MaterialData, MeshData, Scene, SceneData
from warp_reflect.settings import GRID_KINDS, Status
from warp_reflect.techniques import grid, octree
from warp_reflect.techniques import vertices as vertices_module
from warp_reflect.techniques.octree import LEVEL_MAX


@pytest.fixture(scope="module")
def ball_room():
    return room(sphere(), placed(0, 0, -1))


def vertices(frame):
    """(pixel [n, 2], status [n]) of the scene's vertices in the only mirror."""
    (layer,) = frame.layers.values()
    found = layer.history.vertices
    n = frame.scene.vertex_count
    screen = found.screen.numpy()[:n]
    return np.where(screen[:, 2:3] > 0, screen[:, :2], np.nan), found.status.numpy()[:n]


def vertex_errors(frame, truth):
    """Pixels between the pictures of vertices that both show; what one shows, the other shows too."""
    (a, status_a), (b, status_b) = vertices(frame), vertices(truth)
    np.testing.assert_array_equal(status_a, status_b)
    error = np.linalg.norm(a - b, axis=1)
    return error[(status_a == int(Status.CONVERGED)) & np.isfinite(error)]


def searched(scene, **settings):
    return render(scene, "reflector_map", refine="off", edge_px=0.0, **settings)


def solves(frame):
    return frame.statistics["grid_nodes"] + frame.statistics["grid_exact"]


@pytest.mark.parametrize("count", [1, 5, 3000])
def test_octree_cells_hold_their_points_and_partition_them(count):
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 3)) * [3.0, 1.0, 0.0] + 100.0
    tree = octree.build(points)
    np.testing.assert_array_equal(np.sort(tree.order), np.arange(count))
    ordered = points[tree.order]
    edge = tree.edge(np.arange(len(tree.level)))
    low = tree.low + tree.place * tree.unit
    for cell in range(len(tree.level)):
        own = ordered[tree.first[cell] : tree.first[cell] + tree.count[cell]]
        assert len(own) > 0
        slack = 1e-9 * tree.size
        assert (own >= low[cell] - slack).all() and (own <= low[cell] + edge[cell] + slack).all()
        children = np.arange(tree.child_first[cell], tree.child_first[cell] + tree.child_count[cell])
        if len(children):
            assert (tree.level[children] == tree.level[cell] + 1).all()
            assert tree.first[children[0]] == tree.first[cell] and tree.count[children].sum() == tree.count[cell]
            np.testing.assert_array_equal(
                tree.first[children[1:]], tree.first[children[:-1]] + tree.count[children[:-1]]
            )
    corner = tree.low + tree.nodes[tree.corners] * tree.unit
    np.testing.assert_allclose(corner[:, 0], low, atol=1e-9 * tree.size)
    np.testing.assert_allclose(corner[:, 7], low + edge[:, None], atol=1e-9 * tree.size)
    np.testing.assert_allclose(corner[:, 2] - corner[:, 0], edge[:, None] * [0, 1, 0], atol=1e-9 * tree.size)


def test_octree_order_is_that_of_interleaved_bits():
    lattice = np.random.default_rng(0).integers(0, 1 << LEVEL_MAX, (200, 3))
    code = [
        sum((int(p[axis]) >> bit & 1) << (3 * bit + axis) for axis in range(3) for bit in range(16)) for p in lattice
    ]
    np.testing.assert_array_equal(octree._morton(lattice), code)


@pytest.mark.parametrize("kind", GRID_KINDS)
def test_tolerance_bounds_the_error_of_every_vertex(ball_room, kind):
    """Statuses are those of the full search, and pictures are as near as asked."""
    truth = searched(ball_room)
    shares = []
    for tolerance in (0.05, 0.5, 4.0):
        frame = searched(ball_room, grid_error_px=tolerance, grid_kind=kind)
        error = vertex_errors(frame, truth)
        assert len(error) > 5000
        # The map's own error of a converged search (0.1 of a texel's sagitta) stands below every tolerance.
        assert np.percentile(error, 99) <= tolerance + 0.02 and error.max() <= 2.0 * tolerance + 0.1
        shares.append(solves(frame) / frame.statistics["grid_vertices"])
    assert max(shares[1:]) < shares[0]
    assert shares[2] < 0.5


def test_tolerance_on_slopes_needs_fewer_solves_than_on_positions(ball_room):
    position = searched(ball_room, grid_error_px=0.1, grid_kind="position")
    slope = searched(ball_room, grid_error_px=0.1, grid_kind="slope")
    assert solves(slope) < 0.6 * solves(position)


def test_share_bounds_the_nodes_and_kinds_differ_in_order(ball_room):
    truth = searched(ball_room)
    medians = {}
    for kind in GRID_KINDS:
        frame = searched(ball_room, grid_share=0.1, grid_kind=kind)
        assert frame.statistics["grid_nodes"] <= 0.15 * frame.statistics["grid_vertices"]
        medians[kind] = np.median(vertex_errors(frame, truth))
    assert medians["direction"] < 0.5 * medians["position"]
    assert medians["slope"] < 0.5 * medians["position"]


@pytest.fixture(scope="module")
def cloud():
    """A mirror, and points that fill a cube beside it."""
    points = np.random.default_rng(3).uniform(-1.0, 1.0, (6000, 3)).astype(np.float32)
    mesh = MeshData(points, np.arange(6000, dtype=np.int32).reshape(-1, 3))
    instances = [InstanceData(0, np.eye(4), "/mirror", (0,)), InstanceData(1, placed(2.2, 1.0, 2.2), "/cloud", (1,))]
    camera = CameraData("/camera", placed(0.1, 0.3, 5.0), near=0.05, focal_length=22.0)
    return Scene(SceneData("cloud", [sphere(), mesh], instances, [CHROME, MaterialData()], [], [camera]))


@pytest.mark.parametrize("kind", ["slope", "position"])
def test_error_falls_with_the_order_of_the_kind(cloud, kind, monkeypatch):
    """Cells of one level and of the next: the edge halves, the error falls with its power."""
    truth = searched(cloud)
    cells = grid.build(cloud, cloud.parts[0])
    errors = []
    for level in (1, 2):
        start = grid.Grid(cells.tree, cells.vertices, cells.order, cells.points, cells.tree.cells_of(level))
        monkeypatch.setattr(grid, "build", lambda scene, own, start=start: start)
        # A tolerance that no cell exceeds: unsafe cells are solved, all others interpolated as they are.
        frame = searched(cloud, grid_error_px=1e6, grid_kind=kind)
        errors.append(np.linalg.norm(vertices(frame)[0] - vertices(truth)[0], axis=1)[cells.vertices])
    both = (errors[0] > 1e-5) & (errors[1] > 1e-5)  # exactly 0: solved
    assert both.sum() > 1000
    order = np.log2(np.median(errors[0][both]) / np.median(errors[1][both]))
    # The slopes come from finite differences of the map's texels, whose own error is of first order in the edge.
    assert abs(order - grid.ORDERS[kind]) < (0.3 if kind == "position" else 0.6)


@pytest.mark.parametrize(
    "settings", [{"grid_share": 0.1, "grid_kind": kind} for kind in GRID_KINDS] + [{"grid_error_px": 1.0}]
)
def test_refined_frame_with_a_grid_equals_the_reference(ball_room, settings):
    frame = render(ball_room, "reflector_map", **settings)
    comparison = wr.compare_frames(frame, render(ball_room, "reference"))
    assert comparison.share(comparison.identical) >= 0.999


def test_grid_after_a_previous_frame_gives_the_same_hits(ball_room):
    first = render(ball_room, "reflector_map", grid_error_px=0.5, grid_kind="slope")
    second = render(ball_room, "reflector_map", previous=first, grid_error_px=0.5, grid_kind="slope", keep_static=False)
    comparison = wr.compare_frames(second, first)
    assert comparison.share(comparison.identical) >= 0.999


def test_mirror_among_cells_larger_than_itself_hides_what_it_hides():
    """A small mirror in a large room: cells that it or its shadow might reach into are never interpolated blindly."""
    scene = room(sphere(), placed(0, 0, 1.5, scale=0.1))
    vertex_errors(searched(scene, grid_error_px=4.0, grid_kind="slope"), searched(scene))


@pytest.mark.parametrize("kind", GRID_KINDS)
def test_answers_that_are_there_already_are_kept(ball_room, kind):
    """Vertices that come with a status (culled, or kept from the last frame) are neither solved nor overwritten."""
    scene = ball_room
    frame = searched(scene, grid_error_px=0.5, grid_kind=kind)
    prepared = frame.plan.prepared(frame.plan.rows[0])
    camera = frame.camera
    solve_frame = vertices_module.solve_frame(scene, camera, prepared.unit_from_scene)
    for share in (0.5, 1.0):
        asked = []
        out = vertices_module.empty_vertices(scene.vertex_count, "cpu")
        kept = np.random.default_rng(1).random(scene.vertex_count) < share
        out.status.assign(np.where(kept, int(Status.SKY), 0).astype(np.uint8))
        statistics, _ = grid.fill(
            scene, prepared.grid, lambda points, found, asked=asked: asked.append(len(points)), solve_frame, prepared.map,
            frame.gbuffer.view, camera, (0, 0, *camera.size), frame.plan.settings, out,
        )  # fmt: skip
        assert (out.status.numpy()[kept] == int(Status.SKY)).all()
        assert statistics["grid_vertices"] == (~kept[prepared.grid.vertices]).sum()
    assert asked == []
