"""The inspector without a window: its camera, its knobs, its pixels, its meshes, and the files it writes."""

from __future__ import annotations

import base64
import io
import json
import re
from itertools import islice, pairwise

import numpy as np
import pytest
import rooms
from PIL import Image

import warp_reflect as wr
from warp_reflect import cli
from warp_reflect.layers import Camera
from warp_reflect.scene import Scene, SceneData
from warp_reflect.techniques import TECHNIQUES
from warp_reflect.techniques.grid import CellUse
from warp_reflect.viewer import cameras, export, geometry, gl, panes, tradeoff
from warp_reflect.viewer import session as sessions
from warp_reflect.viewer.session import Session

SIZE = (96, 72)
CENTRE, RADIUS = np.array([0.2, 0.1, -0.4]), 1.1  # of the mirror ball

MOVING = """#usda 1.0
(
    defaultPrim = "World"
    startTimeCode = 1
    endTimeCode = 5
    upAxis = "Z"
)
def Xform "World"
{
    def Sphere "Mirror" ( prepend apiSchemas = ["MaterialBindingAPI"] )
    {
        rel material:binding = </World/Chrome>
    }
    def Sphere "Ball"
    {
        double radius = 0.5
        double3 xformOp:translate.timeSamples = { 1: (0, -2, 0), 5: (2, -2, 1) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Camera "Front"
    {
        double3 xformOp:translate.timeSamples = { 1: (0, -8, 1), 5: (1, -8, 1) }
        float3 xformOp:rotateXYZ = (90, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }
    def Camera "Side"
    {
        double3 xformOp:translate = (8, 0, 0)
        float3 xformOp:rotateXYZ = (90, 0, 90)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]
    }
    def Material "Chrome"
    {
        token outputs:surface.connect = </World/Chrome/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor = (0.9, 0.9, 0.9)
            float inputs:metallic = 1
            float inputs:roughness = 0
            token outputs:surface
        }
    }
}
"""


@pytest.fixture(scope="module")
def ball_room():
    return rooms.room(rooms.sphere(), rooms.placed(*CENTRE, RADIUS))


@pytest.fixture(scope="module")
def plane_room():
    return rooms.plane_room()


@pytest.fixture
def moving(tmp_path):
    path = tmp_path / "moving.usda"
    path.write_text(MOVING)
    return path


def pixel_of(camera: Camera, point) -> np.ndarray:
    """Where a world point is seen: by the film's definition, not by the package's matrices."""
    x, y, z = (float((point - camera.eye) @ axis) for axis in (camera.right, camera.up, camera.forward))
    assert z > 0.0
    return np.array([camera.cx + camera.fx * x / z, camera.cy - camera.fy * y / z])


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


# The camera.


def test_orbit_holds_the_pivot_where_it_is_seen_and_as_far(ball_room):
    session = Session(ball_room, size=SIZE)
    seen, away = pixel_of(session.camera, session.pivot), np.linalg.norm(session.camera.eye - session.pivot)
    assert np.allclose(session.pivot, CENTRE, atol=1e-5)
    for dx, dy in ((10, 0), (0, 7), (-25, 500), (3, -500)):
        session.orbit(dx, dy)
        assert np.allclose(pixel_of(session.camera, session.pivot), seen, atol=1e-6)
        assert np.linalg.norm(session.camera.eye - session.pivot) == pytest.approx(away, rel=1e-9)
        axes = np.stack([session.camera.right, session.camera.up, -session.camera.forward])
        assert np.allclose(axes @ axes.T, np.eye(3), atol=1e-9) and np.linalg.det(axes) > 0.0
        assert session.camera.up[1] > 0.0  # never over the pole
        assert abs(session.camera.right[1]) < 1e-6  # nor tilted


def test_orbit_turns_the_way_the_hand_drags(ball_room):
    """A drag to the right brings the near side of the ball along: the eye goes left. A drag down raises the eye."""
    session = Session(ball_room, size=SIZE)
    near = session.pivot + 0.5 * unit(session.camera.eye - session.pivot)
    before = pixel_of(session.camera, near)
    session.orbit(5, 3)
    after = pixel_of(session.camera, near)
    assert after[0] > before[0] and after[1] > before[1]


def test_pan_moves_the_pivots_depth_with_the_pointer(ball_room):
    session = Session(ball_room, size=SIZE)
    pivot = session.pivot.copy()
    before = pixel_of(session.camera, pivot)
    session.pan(11.0, -4.0)
    assert np.allclose(pixel_of(session.camera, pivot) - before, [11.0, -4.0], atol=1e-6)


def test_zoom_scales_the_distance(ball_room):
    session = Session(ball_room, size=SIZE)
    away = np.linalg.norm(session.camera.eye - session.pivot)
    session.zoom(0.5)
    assert np.linalg.norm(session.camera.eye - session.pivot) == pytest.approx(0.5 * away)


def test_moving_frame_is_coarse_and_shows_what_the_full_one_shows(ball_room):
    session = Session(ball_room, size=(160, 120))
    session.orbit(15, 5)
    assert session.coarse and session.frame.camera.size == (40, 30)
    coarse = session.frame["primId"].copy()
    session.refine()
    assert not session.coarse and session.frame.camera.size == (160, 120)
    # The middles of 4 x 4 pixels lie between pixels; away from silhouettes the four around agree.
    full = session.frame["primId"]
    around = np.stack([full[1 + j :: 4, 1 + i :: 4] for j in (0, 1) for i in (0, 1)])
    sure = (around == around[0]).all(axis=0)
    assert sure.mean() > 0.8
    assert (coarse == around[0])[sure].all()


def test_refined_frame_is_the_one_that_render_makes(ball_room):
    session = Session(ball_room, size=SIZE)
    session.orbit(15, 5)
    session.refine()
    plan = wr.make_plan(ball_room, session.camera, SIZE)
    assert np.array_equal(wr.render_frame(ball_room, plan)["RGBA"], session.frame["RGBA"])


def test_other_sizes_of_a_camera_see_the_same(ball_room):
    camera = wr.make_plan(ball_room, size=SIZE).camera
    small = cameras.resized(camera, (24, 18))
    assert np.allclose(4.0 * pixel_of(small, CENTRE), pixel_of(camera, CENTRE))


# The knobs.


def test_refused_value_changes_nothing_and_says_why(ball_room):
    session = Session(ball_room, size=SIZE)
    frame = session.frame
    assert not session.set("grid_share", 2.0)
    assert session.message == "refused: setting 'grid_share': got 2.0, expected 0 to 1"
    assert not session.set("method", "quadrik") and "nearest: quadric" in session.message
    assert not session.set("occlusion", "painter") and "refine=off" in session.message
    assert session.frame is frame and session.settings == wr.Settings() and session.method == "auto"


def test_technique_that_does_not_apply_is_told(plane_room):
    session = Session(plane_room, size=SIZE)
    assert session.set("method", "quadric")
    assert session.message.startswith("method = quadric; quadric does not apply (")
    assert [row.technique for row in session.plan.rows] == ["raytraced"]


def test_every_position_of_every_control_is_possible(ball_room):
    settings = wr.Settings(refine="off")  # one value of `occlusion` asks for it
    session = Session(ball_room, size=(48, 36), settings=settings)
    for control in sessions.CONTROLS:
        before = session.value(control.name)
        for value in control.values:
            assert session.set(control.name, value), session.message
            assert session.value(control.name) == value
            assert control.shown(value)
        session.set(control.name, before)


def test_settings_reach_the_frame_and_its_error(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric")
    exact = session.measure()
    assert exact.share(exact.identical) > 0.999
    session.set("refine", "off")
    assert session.comparison is None
    drawn = session.measure()
    assert drawn.identical < exact.identical and drawn.shifted > 0
    assert any(line.startswith("error: ") and "% identical" in line for line in session.numbers())


def test_cameras_and_times_of_a_moving_stage(moving):
    session = Session(wr.load_stage(moving), size=SIZE)
    assert session.times == (1.0, 2.0, 3.0, 4.0, 5.0)
    assert session.knob_value("camera") == "/World/Front" and session.knob_value("time") == 1.0
    session.turn_knob("time", 5.0)
    assert session.scene.data.time == 5.0
    assert np.allclose(session.camera.eye, [1.0, -8.0, 1.0])  # a camera of the stage moves along
    plan = wr.make_plan(wr.load_stage(moving, time=5.0), "Front", SIZE)
    assert np.array_equal(wr.render_frame(plan.scene, plan)["primId"], session.frame["primId"])
    session.orbit(9.0, 0.0)
    held = session.camera
    session.turn_knob("time", 1.0)
    assert session.camera is held  # one that a hand moved stays
    session.turn_knob("camera", "/World/Side")
    assert np.allclose(session.frame.camera.eye, [8.0, 0.0, 0.0])


def test_every_setting_that_a_loaded_stage_follows_has_a_knob():
    known = {control.name: control for control in sessions.CONTROLS}
    assert set(known) == {"method", *wr.Settings.names()} - set(sessions.AT_LOADING)
    for name in set(known) - {"method"}:
        default = getattr(wr.Settings(), name)
        assert default in known[name].values and len(known[name].values) > 1
        assert all(type(value) is type(default) for value in known[name].values)


def test_more_knobs_than_room_are_turned_to(ball_room):
    session = Session(ball_room, size=(48, 36))
    every = [name for name, _ in panes.knob_rows(session)]
    first = panes.knobs_of(session, (400, 280))
    last = panes.knobs_of(session, (400, 280), 99)
    assert [knob.name for knob in first] == every[: len(first)] and len(first) < len(every)
    assert [knob.name for knob in last] == every[-len(last) :]
    assert panes.controls_pane(session, (400, 280), None, 99).shape == (280, 400, 3)


# Accuracy against time.


def test_point_of_the_settings_moves_over_the_plot(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric")
    session.measure()
    session.measure()  # nothing changed: no second point
    session.set("refine", "off")
    drawn = session.measure()
    exact, off = session.tradeoff.trail
    assert (exact.name, off.name) == ("quadric", "quadric refine=off") and exact.technique == "quadric"
    assert off.ms == session.frame.timings["reflect"]
    assert off.off == pytest.approx(1.0 - drawn.within_half_px / drawn.interior_pixels)
    assert off.off > exact.off
    axes = panes.plot_axes(session.tradeoff.trail)
    box = panes.plot_box((400, 300))
    places = [panes.plot_place(box, axes, mark.ms, mark.off) for mark in (exact, off)]
    assert places[1][1] < places[0][1]  # more error is higher up
    image = panes.tradeoff_pane((400, 300), session.tradeoff)
    assert tuple(image[round(places[1][1]), round(places[1][0])]) == panes.ACCENT
    session.orbit(5, 0)
    assert not session.tradeoff.trail  # another view has other errors


def test_quick_sweep_measures_what_a_sweep_would(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric", settings=wr.Settings(threads=1))
    names = list(islice(session.quick_sweep(), 4))  # of which nothing takes long
    marks = {mark.name: mark for mark in session.tradeoff.marks}
    assert set(marks) == {"reference", *names} and {"quadric", "quadric refine=off"} <= set(names)
    assert marks["reference"].off == 0.0 and marks["quadric"].technique == "quadric"
    drawn = wr.render_frame(
        ball_room, wr.make_plan(ball_room, session.camera, SIZE, wr.Settings(refine="off"), "quadric")
    )
    found = wr.compare_frames(drawn, session.reference)
    assert marks["quadric refine=off"].off == pytest.approx(1.0 - found.within_half_px / found.interior_pixels)
    assert session.tradeoff.trail  # the present point stays
    front = session.tradeoff.front()
    assert all(a.ms <= b.ms and a.off > b.off for a, b in pairwise(front))
    session.use_camera(session.camera)
    assert not session.tradeoff.marks


def test_results_of_a_sweep_are_read_or_refused(tmp_path):
    row = {"name": "quadric", "reflect_ms": 3.5, "off_share": 0.25, "technique": "quadric"}
    whole = {"stage": "/far/room.usda", "size": [96, 72], "rows": [row]}
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "results.json").write_text(json.dumps(whole))
    read = tradeoff.read_results(tmp_path / "out")
    assert read.marks == [tradeoff.Mark("quadric", 3.5, 0.25, "quadric")]
    assert read.told == "room.usda at 96x72, out/results.json"
    assert tradeoff.beside(tmp_path / "room.usda") is None  # no such stage
    (tmp_path / "room.usda").write_text("#usda 1.0\n")
    assert tradeoff.beside(tmp_path / "room.usda") == read
    (tmp_path / "other.usda").write_text("#usda 1.0\n")
    assert tradeoff.beside(tmp_path / "other.usda") is None
    for bad in ("", "[]", "{}", json.dumps(whole | {"rows": [row | {"off_share": 7}]}), '{"size": [1]}', "\0\0"):
        (tmp_path / "bad.json").write_text(bad)
        with pytest.raises(ValueError, match=r"bad\.json: is no result of `warp-reflect sweep`"):
            tradeoff.read_results(tmp_path / "bad.json")
    with pytest.raises(OSError, match=r"none\.json: cannot be read"):
        tradeoff.read_results(tmp_path / "none.json")


# The plan.


def line_of(session, effect="", mirror="/mirror"):
    found = [line for line in session.plan.lines() if getattr(line.row, "path", "") == mirror]
    return next(line for line in found if line.effect == effect)


def test_click_on_a_mirror_takes_its_techniques_in_turn(ball_room):
    session = Session(ball_room, size=SIZE)
    planned, seen = session.plan.rows[0].technique, []
    for _ in range(len(TECHNIQUES) + 1):
        assert session.toggle(line_of(session))
        row = session.plan.rows[0]
        assert session.frame.layers[1].method == wr.Technique[row.technique.upper()]
        if not session.techniques:
            break
        assert row.forced and session.techniques == {1: row.technique}
        assert row.technique in session.message and "forced" in line_of(session).text
        seen.append(row.technique)
    # Each that applies once, in the order of the table; then the plan's own again.
    assert seen == [name for name in TECHNIQUES if name in seen] and {"quadric", "raytraced"} <= set(seen)
    assert "planar" not in seen and session.plan.rows[0].technique == planned and not session.plan.rows[0].forced


@pytest.mark.parametrize(
    ("effect", "method"), [("refinement", "quadric"), ("grid", "reflector_map"), ("reuse", "quadric")]
)
def test_click_on_an_effect_turns_it_and_back(ball_room, effect, method):
    session = Session(ball_room, size=SIZE, method=method)
    at_first = line_of(session, effect).row.effects[effect].on
    for want in (not at_first, at_first):
        assert session.toggle(line_of(session, effect))
        assert session.plan.rows[0].effects[effect].on == want and not session.coarse
    assert session.settings == wr.Settings()


def test_click_on_what_no_setting_turns_says_why(ball_room):
    session = Session(ball_room, size=SIZE, method="raytraced")
    before = session.frame
    assert not session.toggle(line_of(session, "refinement"))
    assert session.message.startswith("refused: no setting turns refinement on: traced rays are exact already")
    session = Session(ball_room, size=SIZE, method="reference")
    assert not session.toggle(line_of(session)) and session.message.startswith("refused: technique = reference")
    assert before.layers[1].method == wr.Technique.RAYTRACED


def test_lines_of_the_text_pane_are_those_of_the_plan(ball_room):
    session, size = Session(ball_room, size=SIZE), (700, 900)
    found = [panes.plan_line_at(session, size, y, whole_plan=True) for y in range(size[1])]
    shown = [line for before, line in pairwise([None, *found]) if line is not None and line != before]
    assert shown == session.plan.lines()
    assert "\n".join(line.text for line in shown) == str(session.plan)
    assert panes.plan_line_at(session, size, 8) is None  # the title of the numbers


# Pixels.


def test_pick_obeys_the_law_of_reflection_on_the_ball(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric")
    reflected = session.frame["reflectedId"]
    rows, columns = np.nonzero((session.frame["reflectorId"] > 0) & (reflected > 0))
    assert len(rows) > 300
    for k in np.linspace(0, len(rows) - 1, 12).astype(int):
        x, y = int(columns[k]), int(rows[k])
        pick = session.pick(x, y)
        r, v = pick.mirror_point, pick.reflected_point
        assert np.linalg.norm(r - CENTRE) == pytest.approx(RADIUS, rel=1e-5)
        assert np.allclose(pixel_of(session.camera, r), [x + 0.5, y + 0.5], atol=1e-3)
        n, away, onward = unit(r - CENTRE), unit(r - pick.eye), unit(v - r)
        assert np.allclose(onward, away - 2.0 * (away @ n) * n, atol=1e-4)
        path = np.linalg.norm(r - pick.eye) + np.linalg.norm(v - r)
        assert pick.path_length == pytest.approx(path, rel=1e-5)
        assert np.allclose(pick.virtual_point, pick.eye + path * away, atol=1e-4)
        assert pick.reflector == "/mirror" and pick.prim == "/mirror"
        assert pick.reflected == session.frame.prims[int(reflected[y, x])]
        told = "\n".join(pick.lines())
        assert pick.reflected in told and "CONVERGED" in told and "quadric" in told


def test_pick_beside_the_mirror_and_outside_of_the_picture(ball_room):
    session = Session(ball_room, size=SIZE)
    rows, columns = np.nonzero(session.frame["reflectorId"] == 0)
    pick = session.pick(int(columns[-1]), int(rows[-1]))
    assert pick.mirror_point is None and pick.lines()[1] == "  no mirror here"
    with pytest.raises(ValueError, match=r"pixel: got \(96, 0\), expected 0 to 95, 0 to 71"):
        session.pick(96, 0)


# Meshes.


def test_virtual_objects_of_a_plane_are_mirror_images(plane_room):
    plan = wr.make_plan(plane_room, size=SIZE, method="planar")
    found = geometry.meshes(plan)
    names = [name for name in found if name.startswith("virtual /mirror ")]
    assert "virtual /mirror /floor" in names and len(names) > 3
    for name in names:
        virtual, source = found[name].points, found[name].point_data["source"]
        image = source.copy()
        image[:, 2] = 2.0 * (-2.0 - plane_room.origin[2]) - image[:, 2]
        assert np.allclose(virtual, image, atol=2e-4 * np.ptp(virtual, axis=0).max())
    points = found["reflection points /mirror"].points + plane_room.origin
    assert np.allclose(points[:, 2], -2.0, atol=1e-3)


def test_reflection_points_of_a_ball_lie_on_it_and_reflect(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE, method="quadric")
    mesh = geometry.meshes(plan)["reflection points /mirror"]
    r, v = mesh.points + ball_room.origin, mesh.point_data["source"] + ball_room.origin
    assert len(r) > 100
    assert np.allclose(np.linalg.norm(r - CENTRE, axis=1), RADIUS, rtol=1e-3)
    n = unit(r - CENTRE)
    half = unit(unit(plan.camera.eye - r) + unit(v - r))
    steep = np.einsum("ij,ij->i", n, unit(plan.camera.eye - r)) > 0.2
    assert steep.sum() > 50
    assert np.abs(np.linalg.norm(np.cross(half, n), axis=1)[steep]).max() < 5e-3


def test_regions_are_where_the_ball_hides_the_scene():
    """A point is hidden where the segment from the eye to it meets the ball: the quadratic's smaller root is in (0, 1)."""
    ball_room = rooms.room(rooms.sphere(), rooms.placed(*CENTRE, RADIUS), floor_cells=60)
    plan = wr.make_plan(ball_room, size=SIZE, method="quadric")
    found = geometry.meshes(plan)
    scene, region = found["scene"], found["scene"].point_data["region"]
    assert np.array_equal(region, scene.point_data["region /mirror"])
    used = np.unique(scene.regular_faces)
    points = scene.points[used].astype(float) + ball_room.origin
    eye = plan.camera.eye
    d, f = points - eye, eye - CENTRE
    a, b, c = (d * d).sum(1), 2.0 * (d @ f), f @ f - RADIUS**2
    root = b * b - 4.0 * a * c
    first = (-b - np.sqrt(np.maximum(root, 0.0))) / (2.0 * a)
    hidden = (root > 0.0) & (first > 0.0) & (first < 1.0)
    outside = np.linalg.norm(points - CENTRE, axis=1) > RADIUS * 1.02
    sure = outside & (np.abs(root) > 0.02 * b * b)  # away from the silhouette
    assert sure.sum() > 500 and 20 < hidden[sure].sum() < 0.9 * sure.sum()
    assert (region[used][sure & hidden] == geometry.Region.HIDDEN).all()
    assert (region[used][sure & ~hidden] == geometry.Region.REFLECTED).all()


def test_traced_mirrors_get_virtual_objects_and_their_own_mesh(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE)
    frame = wr.render_frame(ball_room, plan)
    found = geometry.meshes(plan, frame)
    assert any(name.startswith("virtual /mirror ") for name in found)
    mirror = found["mirror /mirror"]
    assert np.allclose(np.linalg.norm(mirror.points + ball_room.origin - CENTRE, axis=1), RADIUS, rtol=1e-5)
    assert found["scene"].n_cells + mirror.n_cells == ball_room.triangle_count
    assert set(found["scene"].cell_data["prim"]) == set(range(2, 13))
    assert np.allclose(mirror.field_data["origin"], ball_room.origin)


def test_cells_of_the_interpolation_grid_hold_every_vertex_once():
    scene = rooms.room(rooms.sphere(), rooms.placed(*CENTRE, RADIUS), floor_cells=60)
    plan = wr.make_plan(scene, size=SIZE, method="reflector_map", settings=wr.Settings(grid_error_px=0.5))
    frame = wr.render_frame(scene, plan)
    mesh = geometry.meshes(plan, frame, searches=False)["grid /mirror"]
    use, error, level = (mesh.cell_data[name] for name in ("use", "error_px", "level"))
    assert mesh.cell_data["vertices"].sum() == scene.vertex_count - scene.parts[0].vertex_count
    assert set(use) == {CellUse.INTERPOLATED, CellUse.HIDDEN, CellUse.SOLVED} and len(np.unique(level)) > 1
    assert (error[use != CellUse.INTERPOLATED] == 0.0).all() and 0.0 < error.max() <= 0.5
    assert mesh.cell_data["vertices"][use == CellUse.SOLVED].sum() <= frame.statistics["grid_exact"]
    corners = mesh.points.reshape(mesh.n_cells, 16, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    edge = (high - low).astype(float)
    assert np.allclose(edge, edge[:, :1], rtol=1e-3)  # cubes
    assert np.allclose(edge[:, 0] * 2.0**level, edge[0, 0] * 2.0 ** level[0], rtol=1e-3)
    # Of the whole box hidden: the segment to its middle meets the ball.
    middle = 0.5 * (low + high)[use == CellUse.HIDDEN] + scene.origin
    towards = unit(middle - plan.camera.eye)
    foot = plan.camera.eye + np.einsum("ij,j->i", towards, CENTRE - plan.camera.eye)[:, None] * towards
    assert (np.linalg.norm(foot - CENTRE, axis=1) < RADIUS).all()


def test_grid_is_shown_where_one_is_used_alone(ball_room):
    assert "grid /mirror" not in geometry.meshes(wr.make_plan(ball_room, size=SIZE, method="reflector_map"))


@pytest.mark.parametrize("search", ["newton", "midpoint"])
def test_search_path_descends_to_what_the_pixel_shows(ball_room, search):
    session = Session(ball_room, size=SIZE, method="reflector_map", settings=wr.Settings(search=search, iterations=40))
    rows, columns = np.nonzero(session.frame["reflectedId"] > 0)
    for k in np.linspace(0, 0.8 * len(rows), 7).astype(int):  # not at the silhouette, where the midpoint rule crawls
        pick = session.pick(int(columns[k]), int(rows[k]))
        path = geometry.meshes(session.plan, session.frame, session.picks)["search path /mirror"]
        residual, used = path.point_data["residual"], path.point_data["evaluations"]
        # A search may end on texels it has just read: its last step then costs no evaluation.
        assert (np.diff(residual) < 0.0).all() and (np.diff(used) >= 0).all() and used[0] == 1
        assert residual[-1] < 1e-4
        # It ends at the mirror point that the ray of the pixel found, to the map's accuracy.
        assert np.linalg.norm(path.points[-1] + ball_room.origin - pick.mirror_point) < 2e-3
        on_cube = geometry.meshes(session.plan, session.frame, session.picks)["search path on the cube /mirror"]
        away = on_cube.points + ball_room.origin - CENTRE
        assert np.allclose(np.abs(away).max(axis=1), RADIUS, rtol=2e-3)
        assert np.allclose(unit(away), unit(path.points + ball_room.origin - CENTRE), atol=2e-3)


def test_search_path_ends_where_the_frame_s_search_ended(ball_room):
    """The seeds a frame hands on are its searches' own answers: the path of the same point ends there, bit for bit."""
    from warp_reflect.techniques.map_search import search_settings
    from warp_reflect.techniques.search_field import search_path
    from warp_reflect.techniques.vertices import solve_frame

    for settings in (wr.Settings(), wr.Settings(search="midpoint"), wr.Settings(tolerance=1e-7)):
        plan = wr.make_plan(ball_room, size=SIZE, method="reflector_map", settings=settings)
        frame = wr.render_frame(ball_room, plan)
        map = plan.prepared(plan.rows[0]).map
        vertices = frame.layers[1].history.vertices
        status, seed = vertices.status.numpy(), vertices.seed.numpy()
        known = np.flatnonzero(status[: ball_room.vertex_count] == wr.Status.CONVERGED)
        eye = np.array(solve_frame(ball_room, plan.camera, map.unit_from_body).eye)
        assert len(known) > 50
        for k in known[:: len(known) // 12]:
            target = map.unit_from_body[:3, :3] @ ball_room.host_points[k] + map.unit_from_body[:3, 3]
            path = search_path(map, eye, target, search_settings(settings, map.resolution), ball_room.device)
            assert path.visible and np.allclose(path.cube[-1], seed[k], atol=2e-6)


def test_bisector_field_is_the_papers(ball_room):
    """On a ball everything is known: N, the bisector, and that following the field makes the angle smaller."""
    session = Session(ball_room, size=SIZE, method="reflector_map")
    rows, columns = np.nonzero(session.frame["reflectedId"] > 0)
    pick = session.pick(int(columns[len(rows) // 3]), int(rows[len(rows) // 3]))
    found = geometry.meshes(session.plan, session.frame, session.picks)
    on_ball, on_cube = found["bisector field /mirror"], found["bisector field on the cube /mirror"]
    assert on_ball.n_points == on_cube.n_points > 150

    def tangential(points):
        n = unit(points - CENTRE)
        bisector = unit(unit(pick.eye - points) + unit(pick.reflected_point - points))
        along = np.einsum("ij,ij->i", bisector, n)
        return bisector - along[:, None] * n, np.linalg.norm(np.cross(bisector, n), axis=1) / along

    points = on_ball.points + ball_room.origin
    want, tangent = tangential(points)
    steep = tangent < 2.0
    assert steep.sum() > 100
    assert np.abs(on_ball.point_data["bisector"] - want)[steep].max() < 3e-3
    assert np.allclose(on_ball.point_data["residual"][steep], tangent[steep], atol=5e-3)
    # The least angle is at the node nearest to the mirror point: the sink.
    nearest = np.linalg.norm(points - pick.mirror_point, axis=1).argmin()
    assert on_ball.point_data["residual"].argsort().tolist().index(nearest) < 4
    # On the cube: along its faces, and downhill.
    at = on_cube.points + ball_room.origin - CENTRE
    field = on_cube.point_data["bisector"]
    face = np.abs(at).argmax(axis=1)
    inner = np.sort(np.abs(at), axis=1)[:, 1] < 0.95 * RADIUS
    assert np.abs(field[np.arange(len(at)), face])[inner].max() < 1e-4 * RADIUS
    moved = at + 0.1 * field
    _, after = tangential(CENTRE + RADIUS * unit(moved))
    far = inner & steep & (tangent > 0.05)
    assert far.sum() > 50 and (after[far] < tangent[far]).all()


def test_search_of_a_plane_or_a_traced_mirror_has_no_field(plane_room):
    found = geometry.meshes(wr.make_plan(plane_room, size=SIZE, method="planar"))
    assert not [name for name in found if name.startswith(("bisector", "search", "cube", "grid"))]


def balls_of(scene):
    """Centres [n, 3] and radius of the balls of a room, without the mirror."""
    placed = [each.world_from_object for each in scene.data.instances if each.prim_path.startswith("/ball")]
    return np.array([matrix[:3, 3] for matrix in placed]), 0.3


def test_nodes_of_a_local_map_lie_on_what_it_sees(ball_room):
    settings = wr.Settings(environment_resolution=32, mesh_cells=8, rem_count=2)
    plan = wr.make_plan(ball_room, size=SIZE, method="layered_environment", settings=settings)
    found = geometry.meshes(plan)
    mesh, (prepared,) = found["local map /mirror"], [plan.prepared(row) for row in plan.rows]
    at = mesh.points + ball_room.origin
    centres, radius = balls_of(ball_room)
    from_balls = np.abs(np.linalg.norm(at[:, None] - centres, axis=2) - radius).min(axis=1)
    on_floor = np.abs(at[:, 1] + 1.0) < 1e-4
    assert on_floor.any() and (~on_floor).sum() > 20
    assert (from_balls[~on_floor] < 0.01 * radius).all()  # facets of 24 x 48
    assert np.allclose(np.linalg.norm(at - prepared.centre, axis=1), mesh.point_data["distance"], rtol=1e-5)
    # Fine where depths part, coarse on the floor; together the cells cover the faces once.
    size = mesh.cell_data["size"]
    assert size.min() == 1 and size.max() == 4
    face, y, x, side = prepared.cells.T
    area = (np.minimum(x + side, 31) - x) * (np.minimum(y + side, 31) - y)
    assert (np.bincount(face, area) == 31 * 31).all()
    places = found["reference maps"]
    assert np.allclose(places.points + ball_room.origin, prepared.references.placement.centres, atol=1e-5)
    assert places.point_data["mirrors"].sum() == min(
        2, len(places.points)
    ) and "local map /mirror" not in geometry.meshes(wr.make_plan(ball_room, size=SIZE, method="environment"))


@pytest.mark.parametrize("kind", ["heightfield", "occupancy"])
def test_roofs_of_a_field_are_those_of_the_scene(ball_room, kind):
    plan = wr.make_plan(ball_room, size=SIZE, settings=wr.Settings(field_kind=kind, field_cell=0.1))
    assert "field" not in geometry.meshes(plan)
    mesh = geometry.meshes(plan, field=True)["field"]
    at = mesh.cell_centers().points + ball_room.origin
    centres, radius = balls_of(ball_room)
    apart = np.linalg.norm(at[:, None, ::2] - centres[:, ::2], axis=2)
    open_floor = (apart > radius + 0.15).all(axis=1)
    assert open_floor.sum() > 1000 and np.allclose(at[open_floor, 1], -1.0, atol=1e-4)
    for centre in centres:
        near = np.linalg.norm(at[:, ::2] - centre[::2], axis=1) < 0.5 * radius
        top = at[near, 1].max()
        assert top >= centre[1] + 0.95 * radius  # at the middle of a column, or another ball that stands higher
    assert at[:, 1].max() <= (centres[:, 1] + radius).max() + 0.101


def test_virtual_objects_of_a_mirror_together_are_the_same(ball_room):
    plan = wr.make_plan(ball_room, size=SIZE, method="quadric")
    apart = geometry.meshes(plan)
    whole = geometry.meshes(plan, apart=False)["virtual /mirror"]
    single = [mesh for name, mesh in apart.items() if name.startswith("virtual /mirror ")]
    assert len(single) > 3 and whole.n_cells == sum(mesh.n_cells for mesh in single)
    for name in ("rgb", "triangle"):
        assert np.array_equal(whole.cell_data[name], np.concatenate([mesh.cell_data[name] for mesh in single]))
    corners = [mesh.points[mesh.regular_faces].reshape(-1, 3) for mesh in single]
    assert np.array_equal(whole.points[whole.regular_faces].reshape(-1, 3), np.concatenate(corners))


def test_rays_go_by_the_mirror_to_the_point(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric")
    rows, columns = np.nonzero(session.frame["reflectedId"] > 0)
    picks = [session.pick(int(columns[k]), int(rows[k])) for k in (0, len(rows) // 2)]
    rays = geometry.meshes(session.plan, session.frame, picks)["rays"]
    assert list(rays.cell_data["virtual"]) == [0, 1, 0, 1] and list(rays.cell_data["pick"]) == [0, 0, 1, 1]
    line = rays.get_cell(2).points + ball_room.origin
    want = [picks[1].eye, picks[1].mirror_point, picks[1].reflected_point]
    assert np.allclose(line, want, atol=1e-5)


# Pictures.


def test_heat_colors_run_from_the_same_to_the_worst():
    error = np.array([0.0, sessions.ERROR_SHOWN_PX / 2, sessions.ERROR_SHOWN_PX, 50.0], np.float32)
    assert sessions.heat_colors(error).tolist() == [[24, 62, 110], [90, 180, 80], [220, 50, 35], [220, 50, 35]]


def test_heat_map_tells_classes_apart(ball_room):
    session = Session(ball_room, size=SIZE, method="quadric", settings=wr.Settings(refine="off"))
    comparison = session.measure()
    image = sessions.heat_map(comparison)
    for number in (0, 1, 2):
        own = comparison.classes == number
        assert own.any() and (image[own] == sessions.CLASS_COLORS[number]).all()


def test_picture_is_what_the_png_holds(ball_room, tmp_path):
    session = Session(ball_room, size=SIZE)
    session.frame.write(tmp_path / "a.png")
    written = np.asarray(Image.open(tmp_path / "a.png"))[..., :3].astype(int)
    assert np.abs(written - sessions.picture(session.frame)).max() <= 1


# Files.


def test_page_needs_nothing_else_and_holds_the_pictures(ball_room, tmp_path):
    session = Session(ball_room, size=SIZE, method="quadric")
    path = export.write_html(tmp_path / "a.html", session)
    page = path.read_text()
    assert "http" not in page and "@" not in re.sub(r"base64,[^\"]*|@media", "", page)
    shown = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in re.findall(r"base64,([^\"]*)\"", page)
    ]
    wanted = [sessions.picture(session.frame), sessions.picture(session.reference)]
    wanted.append(sessions.heat_map(session.comparison))
    for image, want in zip(shown, wanted, strict=False):
        assert np.array_equal(image, want)
    names = re.findall(r'"([^"]*)"', re.search(r"names = \[(.*?)\]", page)[1])
    ids = shown[3].astype(int)
    for y, x in ((5, 5), (SIZE[1] // 2, SIZE[0] // 2), (SIZE[1] - 5, SIZE[0] // 2)):
        direct, mirrored = int(session.frame["primId"][y, x]), int(session.frame["reflectedId"][y, x])
        assert names[ids[y, x, 0] | ids[y, x, 2] >> 4 << 8] == session.frame.prims.get(direct, "")
        assert names[ids[y, x, 1] | (ids[y, x, 2] & 15) << 8] == session.frame.prims.get(mirrored, "")
    assert "identical of" in page and re.search(r"1 /mirror +quadric", page)


def test_turntable_turns_once(ball_room, tmp_path):
    session = Session(ball_room, size=SIZE)
    start = sessions.picture(session.frame)
    files = export.write_turntable(str(tmp_path / "t.##.png"), session, 4)
    assert [path.name for path in files] == ["t.01.png", "t.02.png", "t.03.png", "t.04.png"]
    shown = [np.asarray(Image.open(path))[..., :3].astype(int) for path in files]
    assert np.abs(shown[0] - start).max() <= 1
    assert all(np.abs(image - shown[0]).mean() > 3.0 for image in shown[1:])
    export.write_turntable(str(tmp_path / "t.gif"), session, 4)
    with Image.open(tmp_path / "t.gif") as gif:
        assert gif.n_frames == 4 and gif.size == SIZE and gif.info["duration"] == 1000
        # A palette of 256 colours.
        assert np.abs(np.asarray(gif.convert("RGB"), int) - start).mean() < 6.0


@pytest.mark.parametrize("out", ["t.png", "t.mp4", "no_folder/t.gif"])
def test_turntable_refuses_names_that_cannot_be(out, tmp_path):
    with pytest.raises((ValueError, OSError), match="t\\."):
        export.turntable_files(str(tmp_path / out), 4)
    with pytest.raises(ValueError, match="--frames: got 0, expected 1 to 400"):
        export.turntable_files(str(tmp_path / "t.gif"), 0)


def test_without_opengl_the_frame_is_written_and_the_package_named(ball_room, tmp_path, monkeypatch):
    monkeypatch.setattr(gl, "library", lambda: "")
    session = Session(ball_room, size=SIZE)
    said = export.write_screenshot(tmp_path / "a.png", session)
    assert "libegl1" in said and "\n" not in said
    assert export.write_screenshot(tmp_path / "b.png", session, frame_only=True) == ""
    for name in ("a.png", "b.png"):
        assert np.abs(np.asarray(Image.open(tmp_path / name))[..., :3] - sessions.picture(session.frame)).max() <= 1


# Stages with little in them.


def empty_scene(**changes) -> Scene:
    return Scene(SceneData("nothing", [], [], [], [], [], **changes))


@pytest.mark.parametrize("up_axis", ["Y", "Z"])
def test_stage_without_a_camera_is_seen_whole(ball_room, up_axis):
    data = ball_room.data
    scene = Scene(SceneData("s", data.meshes, data.instances, data.materials, [], [], up_axis=up_axis))
    session = Session(scene, size=SIZE)
    assert "no camera in this stage" in session.message
    seen = np.array([pixel_of(session.camera, point) for point in scene.host_points + scene.origin])
    assert (seen >= 0).all() and (seen <= SIZE).all()
    assert np.ptp(seen, axis=0).max() > 0.4 * min(SIZE)
    assert session.frame["A"].max() > 0.0
    session.orbit(20, 10)
    session.measure()


def test_stage_without_a_mirror_says_so(ball_room):
    settings = wr.Settings(reflector_min_weight=1.0)
    session = Session(ball_room, size=SIZE, settings=settings)
    assert "no mirror in this stage" in session.message and "--reflector" in session.message
    session.measure()
    assert "error: no mirror is seen" in session.numbers()
    assert set(geometry.meshes(session.plan)) == {"scene"}


def test_empty_stage_opens(tmp_path):
    session = Session(empty_scene(), size=SIZE)
    assert session.message.startswith("nothing to draw in this stage")
    session.orbit(10, 10)
    session.measure()
    assert session.pick(3, 3).lines() == ["pixel (3, 3): background", "  no mirror here"]
    assert geometry.meshes(session.plan)["scene"].n_cells == 0
    export.write_html(tmp_path / "a.html", session)


# The command.


def test_view_command_writes_files_and_answers_pixels(moving, tmp_path, capsys):
    out = [f"{tmp_path}/{name}" for name in ("a.png", "a.html", "t.##.png")]
    tokens = ["view", str(moving), "--res", "64x48", "--time", "5", "--screenshot", out[0], "--frame-only"]
    tokens += ["--html", out[1], "--turntable", out[2], "--frames", "2", "--pick", "13,43"]
    assert cli.main(tokens) == 0
    told = capsys.readouterr().out
    assert "pixel (13, 43): /World/Mirror\n  in it: " in told and told.strip().endswith("t.02.png")
    assert Image.open(out[0]).size == (64, 48)


@pytest.mark.parametrize(
    ("tokens", "says"),
    [
        (["--frame-only"], "--frame-only: goes with --screenshot OUT.png"),
        (["--screenshot", "a.jpg"], "a.jpg: expected a name that ends in .png"),
        (["--html", "nowhere/a.html"], "the folder 'nowhere' does not exist"),
        (["--screenshot", "a.png", "--pick", "3"], "--pick: got '3', expected X,Y such as 320,240"),
        (["--screenshot", "a.png", "--res", "8x8", "--pick", "9,1"], "pixel: got (9, 1), expected 0 to 7, 0 to 7"),
        (["--screenshot", "a.png", "--camera", "None"], "camera: 'None' names 0 cameras"),
        (["--turntable", "a.gif", "--frames", "401"], "--frames: got 401, expected 1 to 400"),
    ],
)
def test_view_command_refuses_in_one_line(moving, tokens, says, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["view", str(moving), *tokens]) == 2
    *notes, error = capsys.readouterr().err.splitlines()
    assert says in error and error.startswith("error: ")
    assert all(line.startswith("note: ") for line in notes)
    assert [path.name for path in tmp_path.iterdir()] == ["moving.usda"]


def test_view_command_without_opengl_or_display_says_what_to_do(moving, capsys, monkeypatch):
    monkeypatch.setattr(gl, "library", lambda: "")
    assert cli.main(["view", str(moving)]) == 2
    assert "no OpenGL was found: install" in capsys.readouterr().err
    monkeypatch.setattr(gl, "library", lambda: "EGL")
    monkeypatch.setattr(gl, "has_display", lambda: False)
    monkeypatch.delenv("PYVISTA_OFF_SCREEN", raising=False)
    assert cli.main(["view", str(moving)]) == 2
    assert "no display to open a window on" in capsys.readouterr().err
