"""The inspector's window, off screen: mouse and keys in, pixels out. Needs OpenGL; run with `-m gl`."""

from __future__ import annotations

import gc
import weakref
from itertools import islice

import numpy as np
import pytest
import pyvista as pv
import rooms
from PIL import Image

import warp_reflect as wr
from warp_reflect.viewer import export, inspector, panes
from warp_reflect.viewer import session as session_module
from warp_reflect.viewer.session import Session, heat_map, picture

pytestmark = pytest.mark.gl

SIZE, WINDOW = (96, 72), (960, 560)
CENTRE, RADIUS = np.array([0.2, 0.1, -0.4]), 1.1  # of the mirror ball
NAMED_KEYS = {"Return": "\r", "Escape": "\x1b"}
GREY_LEVELS = 1.0  # mean difference of 8-bit pictures that drivers may make


@pytest.fixture(scope="module")
def ball_room():
    return rooms.room(rooms.sphere(), rooms.placed(*CENTRE, RADIUS))


@pytest.fixture
def window(ball_room):
    """An inspector of the quadric technique's own picture, which differs from the reference."""
    session = Session(ball_room, size=SIZE, method="quadric", settings=wr.Settings(refine="off"))
    made = inspector.Inspector(session, off_screen=True, window_size=WINDOW)
    yield made
    made.plotter.close()


def shot(window) -> np.ndarray:
    return window.plotter.screenshot(return_img=True)


def pane_of(window, image, pane) -> np.ndarray:
    """A pane's part of a screenshot, by the grid of panes."""
    height, width = image.shape[:2]
    row, column = divmod(pane, inspector.COLUMNS)
    x = [round(k * width / inspector.COLUMNS) for k in (column, column + 1)]
    y = [height - round((inspector.ROWS - k) * height / inspector.ROWS) for k in (row, row + 1)]
    return image[y[0] : y[1], x[0] : x[1]].astype(int)


def send(window, event, x, y, shift=False, key="", symbol=""):
    interactor = window.plotter.iren.interactor
    interactor.SetEventInformation(round(x), round(y), 0, int(shift), key or "\0", 0, symbol or key or None)
    interactor.InvokeEvent(event)


def drag(window, start, *places, button="Left", shift=False, release=True):
    send(window, f"{button}ButtonPressEvent", *start, shift)
    for place in places:
        send(window, "MouseMoveEvent", *place, shift)
    if release:
        send(window, f"{button}ButtonReleaseEvent", *(places or [start])[-1], shift)


def press(window, *keys):
    for key in keys:
        send(window, "KeyPressEvent", 0, 0, key=key if len(key) == 1 else NAMED_KEYS[key], symbol=key)


def reflecting_pixel(window, place=0.5):
    rows, columns = np.nonzero(window.session.frame["reflectedId"] > 0)
    k = int(place * (len(rows) - 1))
    return int(columns[k]), int(rows[k])


# What is drawn.


def test_flat_panes_are_shown_pixel_by_pixel(window):
    image = shot(window)
    assert image.shape == (WINDOW[1], WINDOW[0], 3)
    for pane in inspector.FLAT:
        shown = pane_of(window, image, pane)
        assert np.abs(shown - window._pane_image(pane)).mean() < GREY_LEVELS


def test_frame_reference_and_error_are_in_their_panes(window):
    """Found again by enlarging the pictures as a printer would: nearest pixels, into the box of the pane."""
    image = shot(window)
    session = window.session
    session.measure()
    pictures = {
        inspector.FRAME: picture(session.frame),
        inspector.REFERENCE: picture(session.reference),
        inspector.ERROR: heat_map(session.comparison),
    }
    window.wipe = 1.0
    window.draw()
    image = shot(window)
    for pane, want in pictures.items():
        box = panes.picture_box(window.pane_size(pane), SIZE)
        shown = pane_of(window, image, pane)[box.y : box.y + box.height, box.x : box.x + box.width - 3]
        rows = ((np.arange(box.height) + 0.5) * SIZE[1] / box.height).astype(int)
        columns = ((np.arange(box.width - 3) + 0.5) * SIZE[0] / box.width).astype(int)
        far = np.abs(columns - columns.max()) > 4  # the wipe's grip stands at the edge
        assert np.abs(shown - want[rows][:, columns])[:, far].mean() < GREY_LEVELS


def test_plotter_is_pyvistas_and_honours_off_screen(ball_room, monkeypatch):
    monkeypatch.setattr(pv, "OFF_SCREEN", True)  # what PYVISTA_OFF_SCREEN=true sets
    plotter = wr.viewer.plotter(ball_room, size=SIZE, window_size=(480, 280))
    assert isinstance(plotter, pv.Plotter) and plotter.off_screen
    assert wr.viewer.inspector_of(plotter).session.frame.camera.size == SIZE
    plotter.show()
    assert plotter._closed


# The mouse.


def test_drag_orbits_coarsely_and_refines_when_let_go(window):
    start = window.frame_place(20, 40)
    eye, space = window.session.camera.eye, pane_of(window, shot(window), inspector.SPACE)
    drag(window, start, (start[0] + 30, start[1] - 10), (start[0] + 60, start[1] - 20), release=False)
    assert window.session.coarse and window.session.frame.camera.size == (24, 18)
    assert not np.allclose(window.session.camera.eye, eye)
    # Of the other panes nothing is drawn anew; in their places they stay.
    drawn = _window_pixels(window)
    assert np.abs(pane_of(window, drawn, inspector.SPACE) - space).mean() < GREY_LEVELS
    send(window, "LeftButtonReleaseEvent", start[0] + 60, start[1] - 20)
    assert not window.session.coarse and window.session.comparison is not None
    assert window.session.frame.camera is window.session.camera


def _window_pixels(window) -> np.ndarray:
    """What the window holds, without drawing it again."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

    render_window = window.plotter.render_window
    width, height = render_window.GetSize()
    data = vtkUnsignedCharArray()
    render_window.GetRGBACharPixelData(0, 0, width - 1, height - 1, 0, data)
    return vtk_to_numpy(data).reshape(height, width, 4)[::-1, :, :3]


def test_window_answers_between_the_steps_of_a_rest(window):
    """A window on a screen shows the refined frame first; its timer brings the error and the 3-D pane."""
    window.stepwise = True
    start, meshes = window.frame_place(20, 40), window.meshes
    drag(window, start, (start[0] + 30, start[1]))
    assert not window.session.coarse and window.session.comparison is None and window.meshes is meshes
    send(window, "TimerEvent", *start)
    assert window.session.comparison is not None and window.meshes is meshes
    drag(
        window, start, (start[0] - 30, start[1])
    )  # the hand moves on: the 3-D pane is not brought up to date for nothing
    assert window.session.comparison is None
    for _ in range(3):
        send(window, "TimerEvent", *start)
    assert window.session.comparison is not None and window.meshes is not meshes
    assert not window._pending


def test_shift_drag_pans_and_wheel_zooms(window):
    session, pivot = window.session, window.session.pivot.copy()
    away = np.linalg.norm(session.camera.eye - pivot)
    start = window.frame_place(20, 40)
    drag(window, start, (start[0] + 40, start[1]), shift=True)
    assert np.linalg.norm(session.camera.eye - session.pivot) == pytest.approx(away)
    assert abs((session.pivot - pivot) @ session.camera.right) > 0.1
    send(window, "MouseWheelForwardEvent", *start)
    assert session.coarse
    assert np.linalg.norm(session.camera.eye - session.pivot) == pytest.approx(away / inspector.ZOOM_STEP)
    window.settle()
    assert not session.coarse


def test_click_picks_the_pixel_under_the_pointer(window):
    x, y = reflecting_pixel(window)
    eye = window.session.camera.eye
    drag(window, window.frame_place(x + 0.5, y + 0.5))
    pick = window.session.picks[-1]
    assert pick.pixel == (x, y)
    assert pick.reflected == window.session.frame.prims[int(window.session.frame["reflectedId"][y, x])]
    assert np.array_equal(window.session.camera.eye, eye)
    press(window, "c")
    assert not window.session.picks and "rays" not in window.meshes


def test_wipe_follows_the_hand(window):
    window.turn_knob("map_resolution", 8)
    window.turn_knob("method", "explosion_map")  # a rough one, so that the error shows
    line = window.frame_place(window.wipe * SIZE[0], 36)
    target = window.frame_place(24, 36)
    drag(window, line, target)
    assert window.wipe == pytest.approx(0.25, abs=0.02)
    box = panes.picture_box(window.pane_size(inspector.FRAME), SIZE)
    shown = pane_of(window, shot(window), inspector.FRAME)
    frame, reference = picture(window.session.frame).astype(int), picture(window.session.reference).astype(int)
    differs = np.argwhere(np.abs(frame - reference).sum(axis=2) > 30)
    left, right = differs[differs[:, 1] < 20], differs[differs[:, 1] > 30]
    assert len(right) > 5
    for found, want in ((left, frame), (right, reference)):
        for y, x in found:
            place = shown[round(box.y + (y + 0.5) * box.height / 72), round(box.x + (x + 0.5) * box.width / 96)]
            assert np.abs(place - want[y, x]).max() <= 2


def test_slider_sets_what_its_knob_says(window):
    knobs = {knob.name: knob for knob in panes.knobs_of(window.session, window.pane_size(inspector.CONTROLS))}
    left, bottom, _, height = window._pane_box(inspector.CONTROLS)

    def place(name, position):
        track, last = knobs[name].track, len(knobs[name].values) - 1
        return left + track.x + position / last * track.width, bottom + height - 1 - (track.y + track.height / 2)

    for name, position in (("iterations", 2), ("grid_share", 3), ("refine", 0), ("method", 1)):
        before = [window.session.knob_value(each) for each in knobs if each != name]
        drag(window, place(name, 0), place(name, position))
        assert window.session.knob_value(name) == knobs[name].values[position]
        assert [window.session.knob_value(each) for each in knobs if each != name] == before
    # All mirrors are traced now, and the heat map that is shown says so.
    assert [row.technique for row in window.session.plan.rows] == ["raytraced"]
    assert window.session.comparison.share(window.session.comparison.identical) == 1.0


def test_click_into_the_plan_forces_the_other_way(window):
    press(window, "p")
    size, (left, bottom, _, height) = window.pane_size(inspector.TEXT), window._pane_box(inspector.TEXT)
    for effect, changes in (("refinement", "refine"), ("", "techniques")):
        for y in range(size[1]):
            line = panes.plan_line_at(window.session, size, y, window.whole_plan)
            if line is not None and getattr(line.row, "path", "") == "/mirror" and line.effect == effect:
                break
        drag(window, (left + 40, bottom + height - 1 - y))
        assert changes in window.session.message or window.session.techniques
    assert window.session.settings.refine == "exact" and window.session.plan.rows[0].forced
    assert list(window.session.techniques) == [1]


def test_typed_setting_is_set_or_refused_on_screen(window):
    press(window, ":", *"edge_px=1", "Return")
    assert window.session.settings.edge_px == 1.0
    press(window, ":", *"grid_share=7", "Return")
    assert window.session.message == "refused: setting 'grid_share': got 7.0, expected 0 to 1"
    shown = pane_of(window, shot(window), inspector.CONTROLS)
    assert np.abs(shown - np.array(panes.WARN)).sum(axis=2).min() < 12  # in the colour of warnings
    assert window.session.settings.grid_share == 0.0
    press(window, ":", *"qx", "Escape")
    assert window._typed is None and not window.plotter._closed


def test_keys_switch_plan_regions_and_virtual_objects(window):
    before = shot(window)
    press(window, "p", "g", "v")
    after = shot(window)
    assert window.whole_plan and window.shows_regions and not window.shows_virtual
    for pane in (inspector.TEXT, inspector.SPACE):
        assert np.abs(pane_of(window, before, pane) - pane_of(window, after, pane)).mean() > 1.0
    assert "virtual" not in window.plotter.renderers[inspector.SPACE].actors
    press(window, "p", "g", "v")
    assert np.abs(shot(window).astype(int) - before).mean() < GREY_LEVELS


def test_events_of_the_3d_pane_reach_pyvistas_own_style(window):
    left, bottom, width, height = window._pane_box(inspector.SPACE)
    camera = window.plotter.renderers[inspector.SPACE].camera
    before, eye = camera.position, window.session.camera.eye
    middle = (left + width / 2, bottom + height / 2)
    drag(window, middle, (middle[0] + 30, middle[1]), (middle[0] + 60, middle[1]))
    assert not np.allclose(camera.position, before)
    assert np.array_equal(window.session.camera.eye, eye)


# The 3-D pane: one value of each overlay is picked on the screen.


def looked_at(window, point):
    """Point the 3-D camera at a world point; returns the window's place of the pane's middle."""
    origin = window.session.scene.origin
    renderer = window.plotter.renderers[inspector.SPACE]
    camera = renderer.camera
    away = np.asarray(camera.position) - np.asarray(camera.focal_point)
    camera.focal_point = tuple(point - origin)
    camera.position = tuple(point - origin + away)
    renderer.ResetCameraClippingRange()
    window.plotter.render()
    left, bottom, width, height = window._pane_box(inspector.SPACE)
    return renderer, left + width / 2, bottom + height / 2


def picked(window, name, point, tolerance=0.01):
    """(world point, cell, mesh) that is drawn by an actor at the middle, where the camera looks at a point."""
    from vtkmodules.vtkRenderingCore import vtkCellPicker

    renderer, x, y = looked_at(window, point)
    picker = vtkCellPicker()
    picker.SetTolerance(tolerance)
    picker.PickFromListOn()
    picker.AddPickList(renderer.actors[name])
    assert picker.Pick(x, y, 0.0, renderer) == 1, f"nothing of '{name}' is drawn there"
    mesh = pv.wrap(picker.GetDataSet())
    return np.array(picker.GetPickPosition()) + window.session.scene.origin, picker.GetCellId(), mesh


def test_picked_scene_point_tells_its_prim_and_region(window):
    floor = np.array([2.6, -1.0, 2.0])
    point, cell, mesh = picked(window, "scene", floor)
    assert np.allclose(point, floor, atol=0.02)
    assert window.session.frame.prims[int(mesh.cell_data["prim"][cell])] == "/floor"
    corners = mesh.get_cell(cell).point_ids
    assert set(mesh.point_data["region"][corners]) == {wr.viewer.Region.REFLECTED}


def test_picked_mirror_point_lies_on_the_ball(window):
    point, _, _ = picked(window, "mirror", CENTRE)
    assert np.linalg.norm(point - CENTRE) == pytest.approx(RADIUS, rel=0.01)


def test_picked_ray_passes_by_the_mirror_point(window):
    window.pick(*reflecting_pixel(window, 0.4))
    pick = window.session.picks[-1]
    halfway = 0.5 * (pick.mirror_point + pick.reflected_point)
    point, cell, mesh = picked(window, "ray", halfway)
    assert np.linalg.norm(point - halfway) < 0.03
    assert np.allclose(mesh.get_cell(cell).points[1] + window.session.scene.origin, pick.mirror_point, atol=1e-5)
    halfway = 0.5 * (pick.mirror_point + pick.virtual_point)
    point, _, _ = picked(window, "virtual ray", halfway)
    assert np.linalg.norm(point - halfway) < 0.03


def test_picked_virtual_object_is_where_the_ray_says(window):
    window.pick(*reflecting_pixel(window, 0.6))
    want = window.session.picks[-1].virtual_point
    renderer = window.plotter.renderers[inspector.SPACE]
    # Seen from the eye the virtual object covers the pixel that shows it.
    renderer.camera.position = tuple(window.session.camera.eye - window.session.scene.origin)
    renderer.camera.focal_point = tuple(want - window.session.scene.origin)
    point, _, _ = picked(window, "virtual", want, tolerance=1e-6)
    sight = want - window.session.camera.eye
    assert np.linalg.norm(point - want) < 0.02 * np.linalg.norm(sight)


def test_picked_reflection_point_reflects(window):
    mesh = window.meshes["reflection points /mirror"]
    want = mesh.points[len(mesh.points) // 2] + window.session.scene.origin
    point, _, _ = picked(window, "points", want, tolerance=0.02)
    assert np.linalg.norm(point - CENTRE) == pytest.approx(RADIUS, rel=0.01)


def test_picked_eye_lines_start_at_the_eye(window):
    camera = window.session.camera
    _, _, mesh = picked(window, "eye", camera.eye, tolerance=0.02)
    assert np.allclose(mesh.points[0] + window.session.scene.origin, camera.eye, atol=1e-5)


@pytest.fixture
def searching(ball_room):
    """An inspector of a mirror whose vertices a grid holds and a map searches, both shown."""
    session = Session(ball_room, size=SIZE, method="reflector_map", settings=wr.Settings(grid_error_px=1.0))
    made = inspector.Inspector(session, off_screen=True, window_size=WINDOW)
    made.pick(*reflecting_pixel(made, 0.4))
    press(made, "i", "b")
    yield made
    made.plotter.close()


def test_picked_cell_of_the_grid_tells_its_level(searching):
    mesh, origin = searching.meshes["grid /mirror"], searching.session.scene.origin
    corners = mesh.points.reshape(mesh.n_cells, 16, 3)[int(np.argmin(mesh.cell_data["level"]))]
    # Something of the grid may stand before it: what is picked tells where it is itself.
    point, cell, shown = picked(searching, "grid", 0.5 * (corners[0] + corners[1]) + origin, tolerance=0.005)
    points = shown.get_cell(cell).points
    low, high = points.min(axis=0), points.max(axis=0)
    edge = float((high - low)[0])
    to_faces = np.minimum(np.abs(point - origin - low), np.abs(point - origin - high))
    assert np.sort(to_faces)[1] < 0.05 * edge  # on an edge: near two faces
    assert (point - origin > low - 0.05 * edge).all() and (point - origin < high + 0.05 * edge).all()
    largest = float(np.ptp(corners[:, 0]))
    assert shown.cell_data["level"][cell] == mesh.cell_data["level"].min() + round(np.log2(largest / edge))
    press(searching, "i")
    assert "grid" not in searching.plotter.renderers[inspector.SPACE].actors


PATHS = ("search path /mirror", "search path on the cube /mirror")


def test_picked_place_of_the_search_is_the_mirror_point(searching):
    pick, origin = searching.session.picks[-1], searching.session.scene.origin
    point, _, _ = picked(searching, "search places", pick.mirror_point, tolerance=0.005)
    # On the mirror or, before it on the same line of sight, on the cube.
    ends = [searching.meshes[name].points[-1] + origin for name in PATHS]
    assert np.linalg.norm(ends[0] - pick.mirror_point) < 0.002
    assert min(np.linalg.norm(point - end) for end in ends) < 0.02
    _, _, mesh = picked(searching, "search", pick.mirror_point, tolerance=0.01)
    assert mesh.point_data["residual"].min() < 1e-4


def test_picked_bisector_stands_at_its_node(searching):
    field = searching.meshes["bisector field /mirror"]
    k = int(field.point_data["residual"].argmax())
    vector = field.point_data["bisector"][k]
    at = field.points[k] + searching.session.scene.origin
    step = 0.3 * inspector.ARROW_SHARE * field.length / 17 * vector / np.linalg.norm(vector)
    point, cell, mesh = picked(searching, "bisectors", at + step, tolerance=0.005)
    # The arrow that is drawn there, of the mirror or the cube, is that of the node it stands at.
    shown = mesh.point_data["residual"][mesh.get_cell(cell).point_ids[0]]
    fields = [searching.meshes[name] for name in ("bisector field /mirror", "bisector field on the cube /mirror")]
    nodes = np.concatenate([each.points for each in fields]) + searching.session.scene.origin
    residual = np.concatenate([each.point_data["residual"] for each in fields])
    near = np.linalg.norm(nodes - point, axis=1).argsort()[:3]
    assert np.abs(residual[near] - shown).min() < 1e-5
    assert np.linalg.norm(nodes[near[0]] - point) < field.length / 17
    press(searching, "b")
    actors = searching.plotter.renderers[inspector.SPACE].actors
    assert not {"bisectors", "search", "search places", "cube"} & set(actors)


def test_picked_cube_stands_around_the_ball(searching):
    side = searching.session.camera.right
    corner = CENTRE + RADIUS * np.sign(side + 1e-9)
    point, _, _ = picked(searching, "cube", corner, tolerance=0.01)
    assert np.abs(point - CENTRE).max() == pytest.approx(RADIUS, rel=0.02)


@pytest.fixture(scope="module")
def mapped(ball_room):
    """An inspector of local maps, with their overlay and the field's on."""
    settings = wr.Settings(environment_resolution=32, mesh_cells=8, field_kind="heightfield", field_cell=0.1)
    session = Session(ball_room, size=SIZE, method="layered_environment", settings=settings)
    made = inspector.Inspector(session, off_screen=True, window_size=WINDOW)
    press(made, "m", "h")
    yield made
    made.plotter.close()


def test_picked_cell_of_a_local_map_lies_where_its_nodes_do(mapped):
    mesh = mapped.meshes["local map /mirror"]
    floor = np.abs(mesh.cell_centers().points[:, 1] + mapped.session.scene.origin[1] + 1.0) < 1e-4
    wanted = np.flatnonzero(floor & (mesh.cell_data["size"] == 4))[0]
    centre = mesh.get_cell(wanted).points.mean(axis=0) + mapped.session.scene.origin
    point, cell, drawn = picked(mapped, "local map", centre)
    assert point[1] == pytest.approx(-1.0, abs=0.01) and np.linalg.norm(point - centre) < 0.2
    assert drawn.cell_data["size"][cell] >= 1 and drawn.cell_data["rgb"][cell].max() > 0


def test_picked_reference_map_stands_at_its_eye(mapped):
    wanted = mapped.meshes["reference maps"].points[0] + mapped.session.scene.origin
    point, _, drawn = picked(mapped, "reference maps", wanted)
    assert np.linalg.norm(point - wanted) < 0.05 and drawn.point_data["map"][0] == 0


def test_picked_roof_of_the_field_has_its_height(mapped):
    mesh = mapped.meshes["field"]
    highest = mesh.cell_data["height"].argmax()
    wanted = mesh.get_cell(highest).points.mean(axis=0) + mapped.session.scene.origin
    renderer = mapped.plotter.renderers[inspector.SPACE]
    renderer.camera.position = tuple(wanted - mapped.session.scene.origin + [0.5, 4.0, 0.5])  # from above
    renderer.camera.focal_point = tuple(wanted - mapped.session.scene.origin)
    point, cell, drawn = picked(mapped, "field", wanted, tolerance=1e-6)
    assert np.linalg.norm(point - wanted) < 0.05
    assert drawn.cell_data["height"][cell] == pytest.approx(point[1] + 1.0, abs=1e-3)  # above the floor


def test_plot_shows_the_present_point_and_the_sweep(window, monkeypatch):
    every = session_module.quick_contenders
    monkeypatch.setattr(session_module, "quick_contenders", lambda session: islice(every(session), 5))
    window.session.settings = wr.Settings(refine="off", threads=1)
    press(window, "s")
    assert window.shows_tradeoff and len(window.session.tradeoff.marks) > 3
    assert window.session.message.startswith("swept: ")
    shown = pane_of(window, shot(window), inspector.REFERENCE)
    marks = [*window.session.tradeoff.marks, *window.session.tradeoff.trail]
    size = window.pane_size(inspector.REFERENCE)
    last = window.session.tradeoff.trail[-1]
    x, y = panes.plot_place(panes.plot_box(size), panes.plot_axes(marks), last.ms, last.off)
    assert np.abs(shown[round(y), round(x)] - np.array(panes.ACCENT)).max() <= 2
    press(window, "t")
    box = panes.picture_box(size, SIZE)
    middle = pane_of(window, shot(window), inspector.REFERENCE)[box.y + box.height // 2, box.x + box.width // 2]
    assert np.abs(middle - picture(window.session.reference)[SIZE[1] // 2, SIZE[0] // 2]).max() <= 2


def test_wheel_over_the_settings_turns_to_more_of_them(window):
    left, bottom, width, height = window._pane_box(inspector.CONTROLS)
    place = left + width / 2, bottom + height / 2
    before, eye = [knob.name for knob in window._knobs()], window.session.camera.eye
    for _ in range(3):
        send(window, "MouseWheelBackwardEvent", *place)
    assert [knob.name for knob in window._knobs()][:3] == before[3:6]
    for _ in range(99):
        send(window, "MouseWheelBackwardEvent", *place)
    every = [name for name, _ in panes.knob_rows(window.session)]
    assert [knob.name for knob in window._knobs()][-1] == every[-1]
    for _ in range(99):
        send(window, "MouseWheelForwardEvent", *place)
    assert [knob.name for knob in window._knobs()] == before
    assert np.array_equal(window.session.camera.eye, eye)


# Windows that change and end.


def test_resized_window_is_laid_out_anew(window):
    window.plotter.window_size = (720, 440)
    image = shot(window)
    assert image.shape[:2] == (440, 720)
    for pane in inspector.FLAT:
        assert np.abs(pane_of(window, image, pane) - window._pane_image(pane)).mean() < GREY_LEVELS
    x, y = reflecting_pixel(window)
    drag(window, window.frame_place(x + 0.5, y + 0.5))
    assert window.session.picks[-1].pixel == (x, y)


@pytest.mark.parametrize("window_size", [(300, 200), (90, 60)])
def test_tiny_window_is_no_error(ball_room, window_size):
    made = inspector.Inspector(Session(ball_room, size=SIZE), True, window_size)
    assert shot(made).shape[:2] == window_size[::-1]
    made.plotter.close()


def test_closed_inspector_is_let_go(ball_room):
    made = inspector.Inspector(Session(ball_room, size=SIZE), True, (300, 200))
    known = weakref.ref(made), weakref.ref(made.session)
    made.plotter.close()
    made.plotter.close()  # twice is no error
    del made
    gc.collect()
    assert known[0]() is None and known[1]() is None


def test_memory_does_not_grow_over_many_frames(ball_room):
    def resident() -> int:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096

    made = inspector.Inspector(Session(ball_room, size=(64, 48)), True, (300, 200))
    for k in range(200):
        made.session.orbit(1.0 if k % 20 < 10 else -1.0, 0.0)
        made._show_moving()
        if k % 20 == 19:
            made.settle()
        if k == 59:  # pools and caches have their size
            gc.collect()
            before = resident()
    gc.collect()
    grown = resident() - before
    made.plotter.close()
    assert grown < 24 << 20  # a leaked frame a step, of all buffers, would be 140 x 0.5 MB


def test_screenshot_is_the_inspectors_view(ball_room, tmp_path):
    session = Session(ball_room, size=SIZE)
    session.pick(48, 36)
    assert export.write_screenshot(tmp_path / "a.png", session) == ""
    image = np.asarray(Image.open(tmp_path / "a.png"))
    assert image.shape == (inspector.WINDOW[1], inspector.WINDOW[0], 3)
    made = inspector.Inspector(session, True)
    assert np.abs(image.astype(int) - shot(made)).mean() < GREY_LEVELS
    made.plotter.close()
