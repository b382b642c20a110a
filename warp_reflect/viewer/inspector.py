"""The window: six panes in a pyvista plotter, and what the mouse and the keys do in them.

The flat panes are pictures that are drawn without OpenGL and shown as they are, pixel by pixel; OpenGL draws the 3-D pane.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

import numpy as np
import pyvista as pv
from pyvista import _vtk

from warp_reflect.layers import Camera
from warp_reflect.planner import PlanLine
from warp_reflect.scene import Scene
from warp_reflect.settings import Settings
from warp_reflect.viewer import cameras, geometry, gl, method, panes
from warp_reflect.viewer.session import Session, heat_map, picture

WINDOW = (1680, 1000)  # pixels
COLUMNS, ROWS = 3, 2
FRAME, SPACE, CONTROLS, REFERENCE, ERROR, TEXT = range(COLUMNS * ROWS)  # panes, row by row
FLAT = (FRAME, CONTROLS, REFERENCE, ERROR, TEXT)
BACKEND = "VTK_DEFAULT_OPENGL_WINDOW"  # VTK's environment variable
STILL_SECONDS = 0.25  # without a move after which a coarse frame is refined
STEP_MS = 1  # until the next step of what follows a refined frame: as soon as the window has answered
TOLD_SECONDS = 0.2  # between two drawings of the numbers while the camera moves; text costs as much as a coarse frame
POINTS_SHOWN = 1500  # reflection points: more would cover the mirrors
CLICK_SLACK = 3  # pixels that a hand moves in a click
WIPE_SLACK = 8  # pixels beside the wipe's line at which it is gripped
ZOOM_STEP = 1.15  # of the distance, for a notch of the wheel
EVENT_PRIORITY = 10.0  # before the interactor style, whose priority is 0
SPACE_BACK = tuple(c / 255.0 for c in panes.BACK)
RAY_COLOR, VIRTUAL_COLOR, EYE_COLOR, MESH_COLOR = "#ffb03a", "#e23cbe", "#6cc4ff", "#20242c"
REGION_COLORS = ["#5a5f6a", "#4fae62", "#c2503f", "#5a7fc0"]  # by `geometry.Region`
USE_COLORS = ["#5a5f6a", "#4fae62", "#c2503f", "#ff9a3a"]  # by `grid.CellUse`
NEARER = (
    0.003  # by which a local map's mesh is drawn nearer to its centre than what it lies on, which would shine through
)
ARROW_SHARE = 0.6  # of a node's distance to the next, about
RESIDUAL_SHOWN = 1.0  # tangent of the angle at the far end of the arrows' colours
SPACE_SIDE = (0.30, 0.22, 0.10)  # where the 3-D view stands beside the eye: right, up, back, of the pivot's distance


def plotter(
    scene: Scene,
    camera: str | Camera | None = None,
    settings: Settings | None = None,
    off_screen: bool | None = None,
    *,
    method: str = "auto",
    size: tuple[int, int] = (640, 480),
    window_size: tuple[int, int] = WINDOW,
) -> pv.Plotter:
    """A pyvista plotter that inspects a scene; `show()` opens it, `inspector_of` tells what it holds.

    Args:
        scene: From `load_stage`.
        camera: As for `make_plan`; None: the stage's first, or a view of everything where it has none.
        settings: The knobs at the start.
        off_screen: Draw without a window; None: as PYVISTA_OFF_SCREEN says.
        method: As for `make_plan`.
        size: (width, height) of frames. [pixels]
        window_size: (width, height) of all panes together. [pixels]

    Raises:
        ValueError: as `make_plan`.
    """
    session = Session(scene, camera, settings, size, method)
    return Inspector(session, off_screen, window_size).plotter


def inspector_of(plotter: pv.Plotter) -> Inspector:
    """The inspector of a plotter from `plotter`."""
    return plotter._warp_reflect


class Inspector:
    """What the panes show and do.

    Attributes:
        session: The scene under inspection.
        plotter: The pyvista plotter.
        wipe: Share of the frame's width from where the reference is shown; 1: none of it.
        whole_plan, shows_regions, shows_virtual, shows_grid, shows_search, shows_maps, shows_field, shows_tradeoff: What the
            keys p, g, v, i, b, m, h and t switch.
        knobs_first: The first knob shown, where there are more than there is room for.
        meshes: What the 3-D pane shows, see `geometry.meshes`.
        stepwise: Leave measuring and the 3-D pane to the timer, so that a window answers between them.
    """

    def __init__(self, session: Session, off_screen: bool | None = None, window_size: tuple[int, int] = WINDOW):
        self.session = session
        self.wipe = 0.75
        self.whole_plan = self.shows_regions = self.shows_grid = self.shows_search = False
        self.shows_maps = self.shows_field = False
        self.shows_virtual = True
        self.shows_tradeoff = bool(session.tradeoff.marks)
        self.knobs_first = 0
        self.meshes: dict[str, pv.PolyData] = {}
        self._pending: list = []
        self._drag: str | None = None
        self._at = self._start = (0, 0)
        self._typed: str | None = None
        self._moved_at = self._told_at = 0.0
        self._picture = picture(session.frame)
        self._reference = self._heat = None
        with _quiet_backend(off_screen):
            self.plotter = pv.Plotter(
                shape=(ROWS, COLUMNS), border=False, off_screen=off_screen, window_size=list(window_size)
            )
        self.plotter._warp_reflect = self
        # Smoothed afterwards, in the 3-D pane alone: several samples a pixel cost software drawing most of its time.
        self.plotter.render_window.SetMultiSamples(0)
        self.plotter.renderers[SPACE].UseFXAAOn()
        self._flat = {pane: _FlatPane(self.plotter.renderers[pane]) for pane in FLAT}
        space = self.plotter.renderers[SPACE]
        space.set_background(SPACE_BACK)
        self._place_space_camera()
        self.stepwise = not self.plotter.off_screen
        self._observe()
        self.settle()

    # Showing.

    def settle(self) -> None:
        """Refine what moved, measure its error, bring the 3-D pane up to date, and draw."""
        self._pending = [self._refine, self._measure, self._show_space]
        while self._pending:
            self._pending.pop(0)()

    def _rest(self) -> None:
        """As `settle`; in steps, where a hand may move again between them."""
        self.settle() if not self.stepwise else self._begin()

    def _begin(self) -> None:
        self._pending = [self._measure, self._show_space]
        self._refine()
        self.plotter.iren.interactor.CreateOneShotTimer(STEP_MS)

    def _refine(self) -> None:
        self.session.refine()
        self._picture = picture(self.session.frame)
        self._reference = self._heat = None
        if self.meshes:  # the window is up: what is ready is shown, the slower things follow
            self.draw(*FLAT)

    def _measure(self) -> None:
        session = self.session
        session.measure()
        self._reference = picture(session.reference)
        self._heat = heat_map(session.comparison)
        if self.meshes:
            self.draw(*FLAT)

    def _show_space(self) -> None:
        session = self.session
        self.meshes = geometry.meshes(
            session.plan,
            session.frame,
            session.picks,
            apart=False,
            searches=self.shows_search,
            field=self.shows_field,
        )
        self._fill_space()
        self.draw()

    def draw(self, *only: int) -> None:
        """Draw panes anew; without arguments all of them."""
        for pane in only or FLAT:
            if pane in self._flat:
                self._flat[pane].show(self._pane_image(pane))
        for number, renderer in enumerate(self.plotter.renderers):
            renderer.SetDraw(not only or number in only)
        self.plotter.render_window.Render()
        for renderer in self.plotter.renderers:
            renderer.SetDraw(True)

    def pane_size(self, pane: int) -> tuple[int, int]:
        """The (width, height) of a pane in pixels."""
        _, _, width, height = self._pane_box(pane)
        return width, height

    def frame_place(self, x: float, y: float) -> tuple[float, float]:
        """Window coordinates (y up, as VTK has them) of a place in the frame (pixels, y down): to point at it."""
        left, bottom, width, height = self._pane_box(FRAME)
        box = panes.picture_box((width, height), self.session.size)
        across, down = x / self.session.size[0], y / self.session.size[1]
        return left + box.x + across * box.width, bottom + height - 1 - (box.y + down * box.height)

    def _pane_box(self, pane: int) -> tuple[int, int, int, int]:
        """(left, bottom, width, height) in the window, as VTK rounds viewports."""
        width, height = self.plotter.render_window.GetSize()
        x0, y0, x1, y1 = self.plotter.renderers[pane].viewport
        left, bottom, right, top = round(x0 * width), round(y0 * height), round(x1 * width), round(y1 * height)
        return left, bottom, max(right - left, 1), max(top - bottom, 1)

    def _pane_image(self, pane: int) -> np.ndarray:
        session, size = self.session, self.pane_size(pane)
        if pane == CONTROLS:
            return panes.controls_pane(session, size, self._typed, self.knobs_first)
        if pane == TEXT:
            return panes.text_pane(session, size, self.whole_plan)
        waiting = "after the camera rests" if session.coarse else "measuring"
        if pane == REFERENCE and self.shows_tradeoff:
            return panes.tradeoff_pane(size, session.tradeoff, session.comparison is None)
        if pane == REFERENCE:
            shown = None if session.coarse else self._reference
            title = "reference: every mirror traced"
            return panes.picture_pane(size, title, shown, session.size, empty=waiting)
        if pane == ERROR:
            return panes.error_pane(size, None if session.coarse else self._heat, session.size, waiting)
        right = None if session.coarse else self._reference
        mark = session.picks[-1].pixel if session.picks else None
        title = (
            "frame (moving)" if session.coarse else "frame" if right is None else "frame | reference, right of the line"
        )
        return panes.picture_pane(size, title, self._picture, session.size, right, self.wipe, mark)

    # The 3-D pane.

    def _place_space_camera(self) -> None:
        """Beside the eye, looking where it looks; and at once so far that a mouse turns about the pivot."""
        session = self.session
        camera, origin = session.camera, session.scene.origin
        gap = float(np.linalg.norm(session.pivot - camera.eye)) or 1.0
        right, up, back = (share * gap for share in SPACE_SIDE)
        eye = camera.eye + right * camera.right + up * camera.up - back * camera.forward
        view = self.plotter.renderers[SPACE].camera
        view.position, view.focal_point = tuple(eye - origin), tuple(session.pivot - origin)
        view.up, view.view_angle = tuple(cameras.up_of(session.scene)), 50.0
        self.plotter.renderers[SPACE].camera_set = True

    def _fill_space(self) -> None:
        self.plotter.subplot(*divmod(SPACE, COLUMNS))
        common = {"reset_camera": False, "render": False, "show_scalar_bar": False}
        groups: dict[str, list[pv.PolyData]] = {"mirror": [], "virtual": [], "reflection points": [], "grid": []}
        for name, mesh in self.meshes.items():
            for kind, members in groups.items():
                if name.startswith(kind + " ") and mesh.n_points:
                    members.append(mesh)
        scene = self.meshes["scene"]
        self._add("scene", None)
        if scene.n_cells and self.shows_regions and "region" in scene.point_data:
            look = {"scalars": "region", "cmap": REGION_COLORS, "clim": (-0.5, 3.5), "interpolate_before_map": False}
            self._add("scene", scene, **look, **common)
        elif scene.n_cells:
            self._add("scene", scene, scalars="rgb", rgb=True, ambient=0.35, diffuse=0.65, **common)
        self._add("mirror", _together(groups["mirror"]), color="#c8d4e4", opacity=0.35, **common)
        virtual = _together(groups["virtual"]) if self.shows_virtual else None
        self._add("virtual", virtual, scalars="rgb", rgb=True, ambient=0.5, diffuse=0.5, **common)
        covered = self.shows_search or self.shows_grid or self.shows_maps or self.shows_field
        points = None if covered else _together(groups["reflection points"])
        if points is not None:
            points = pv.PolyData(points.points[:: -(-points.n_points // POINTS_SHOWN)])
        self._add("points", points, color=RAY_COLOR, point_size=3, lighting=False, **common)
        grids = groups["grid"] if self.shows_grid else []
        look = {"scalars": "use", "cmap": USE_COLORS, "clim": (-0.5, 3.5), "line_width": 1, "lighting": False}
        self._add("grid", _merged(grids), **look, **common)
        self._fill_search(common)
        self._fill_maps(common)
        self._add("eye", self._eye_lines(), color=EYE_COLOR, line_width=2, lighting=False, **common)
        rays = self.meshes.get("rays")
        real = virtual = None
        if rays is not None and rays.n_cells:
            is_virtual = rays.cell_data["virtual"].astype(bool)
            real = rays.extract_cells(~is_virtual)
            virtual = rays.extract_cells(is_virtual) if is_virtual.any() else None
        self._add("ray", real, color=RAY_COLOR, line_width=4, lighting=False, **common)
        self._add("virtual ray", virtual, color=VIRTUAL_COLOR, line_width=3, lighting=False, **common)
        words = "3-D: mirror points, virtual objects in the mirrors, the eye"
        if self.shows_regions:
            words = "3-D: reflected green, hidden red, unreflected blue"
        elif self.shows_search:
            words = "3-D: projected bisectors on mirror and cube, the search's path"
            if "search" not in self.plotter.renderers[SPACE].actors:
                words = "3-D: no mirror here is searched in a map (method = reflector_map)"
        elif self.shows_grid:
            words = "3-D: grid: interpolated green, hidden red, solved one by one orange"
            if not grids:
                words = "3-D: no interpolation grid: grid share and grid error are off, or no map is searched"
        elif self.shows_maps:
            words = "3-D: reference maps, and each local map's adaptive mesh"
            if "reference maps" not in self.meshes:
                words = "3-D: no mirror here has a local map (method = layered_environment)"
        elif self.shows_field:
            words = "3-D: the field that rays of maps are traced through"
        self._title(words)
        self.plotter.renderers[SPACE].ResetCameraClippingRange()

    def _fill_search(self, common: dict) -> None:
        """The field as arrows of one length, coloured by the angle to the law of reflection; the path as a line."""
        fields, lines, cubes = [], [], []
        for name, mesh in self.meshes.items() if self.shows_search else ():
            if name.startswith("bisector field ") and mesh.n_points:
                reach = ARROW_SHARE * mesh.length / method.FIELD_SIDE
                vectors = mesh.point_data["bisector"]
                lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
                arrows = pv.PolyData(mesh.points)
                arrows.point_data["arrow"] = reach * vectors / np.maximum(lengths, 1.0e-12)
                arrows.point_data["residual"] = mesh.point_data["residual"]
                fields.append(arrows.glyph(orient="arrow", scale="arrow", geom=pv.Arrow(tip_length=0.4)))
            elif name.startswith("search path "):
                lines.append(mesh)
            elif name.startswith("cube "):
                cubes.append(mesh)
        look = {"scalars": "residual", "cmap": "viridis_r", "clim": (0.0, RESIDUAL_SHOWN), "lighting": False}
        self._add("bisectors", _merged(fields), **look, **common)
        self._add("search", _merged(lines), color=VIRTUAL_COLOR, line_width=5, lighting=False, **common)
        ends = [pv.PolyData(mesh.points) for mesh in lines]
        self._add("search places", _merged(ends), color=VIRTUAL_COLOR, point_size=8, lighting=False, **common)
        self._add("cube", _merged(cubes), style="wireframe", color="#7a8090", lighting=False, **common)

    def _fill_maps(self, common: dict) -> None:
        references = self.meshes.get("reference maps") if self.shows_maps else None
        self._add("reference maps", references, color=RAY_COLOR, point_size=14, render_points_as_spheres=True, **common)
        # Of the mirror that was picked last, else of the one with most pixels; several lie over one another.
        local = self.meshes.get("local map " + self._told_mirror()) if self.shows_maps else None
        if local is not None and local.n_cells:
            centre = local.field_data["centre"]
            local = local.extract_cells(np.flatnonzero(local.cell_data["torn"] == 0))
            local.points += NEARER * (centre - local.points)
        look = {"scalars": "rgb", "rgb": True, "show_edges": True, "edge_color": MESH_COLOR, "lighting": False}
        self._add("local map", local, **look, **common)
        field = self.meshes.get("field") if self.shows_field else None
        self._add("field", field, scalars="height", cmap="viridis", opacity=0.7, **common)

    def _told_mirror(self) -> str:
        plan = self.session.plan
        names = geometry.names_of(plan)
        picked = [pick.reflector for pick in self.session.picks if pick.reflector]
        own = [row for row in plan.rows if picked and row.path == picked[-1]]
        row = max(own or plan.rows, key=lambda row: row.pixels, default=None)
        return "" if row is None else names[row.reflector.id]

    def _add(self, name: str, mesh: pv.DataSet | None, **look) -> None:
        if mesh is None or not mesh.n_points:
            self.plotter.remove_actor(name, reset_camera=False, render=False)
        else:
            self.plotter.add_mesh(mesh, name=name, **look)

    def _title(self, words: str) -> None:
        _, height = self.pane_size(SPACE)
        self.plotter.remove_actor("title", reset_camera=False, render=False)
        title = pv.Text(f" {words} ", position=(panes.MARGIN, max(height - panes.TITLE_HEIGHT + 9, 0)))
        title.prop.font_size, title.prop.color = panes.TITLE_SIZE, tuple(c / 255.0 for c in panes.INK)
        title.prop.bold = True
        title.prop.background_color, title.prop.background_opacity = SPACE_BACK, 0.7
        self.plotter.add_actor(title, name="title", reset_camera=False, render=False)

    def _eye_lines(self) -> pv.PolyData:
        """The picture's rectangle in front of the eye, and the lines to its corners."""
        camera, session = self.session.camera, self.session
        eye = camera.eye - session.scene.origin
        depth = 0.15 * float(np.linalg.norm(session.pivot - camera.eye))
        width, height = camera.size
        corners = []
        for x, y in ((0, 0), (width, 0), (width, height), (0, height)):
            side = (x - camera.cx) / camera.fx * camera.right - (y - camera.cy) / camera.fy * camera.up
            corners.append(eye + (side if camera.orthographic else depth * side) + depth * camera.forward)
        lines = np.hstack([[5, 1, 2, 3, 4, 1], *[[2, 0, k] for k in (1, 2, 3, 4)]])
        return pv.PolyData(np.array([eye, *corners]), lines=lines)

    # The mouse and the keys.

    def _observe(self) -> None:
        """Take the events of the flat panes; those of the 3-D pane go on to pyvista's own style."""
        interactor = self.plotter.iren.interactor
        handlers = {
            "LeftButtonPressEvent": Inspector._press,
            "MiddleButtonPressEvent": Inspector._press,
            "RightButtonPressEvent": Inspector._press,
            "MouseMoveEvent": Inspector._move,
            "LeftButtonReleaseEvent": Inspector._release,
            "MiddleButtonReleaseEvent": Inspector._release,
            "RightButtonReleaseEvent": Inspector._release,
            "MouseWheelForwardEvent": Inspector._wheel,
            "MouseWheelBackwardEvent": Inspector._wheel,
            "CharEvent": Inspector._char,
            "KeyPressEvent": Inspector._key,
            "TimerEvent": Inspector._timer,
        }
        this = weakref.ref(self)
        for event, handler in handlers.items():
            tags: list[int] = []

            def observe(_, name, handler=handler, tags=tags):
                inspector = this()
                if inspector is not None and not inspector.plotter._closed and handler(inspector, name):
                    interactor_now = inspector.plotter.iren.interactor
                    interactor_now.GetCommand(tags[0]).SetAbortFlag(1)

            tags.append(interactor.AddObserver(event, observe, EVENT_PRIORITY))

        def resize(_, __):
            inspector = this()
            if inspector is not None and not inspector.plotter._closed:
                inspector._resized()

        self.plotter.render_window.AddObserver("WindowResizeEvent", resize)

    def _pane_at(self, x: int, y: int) -> int | None:
        for pane in range(COLUMNS * ROWS):
            left, bottom, width, height = self._pane_box(pane)
            if left <= x < left + width and bottom <= y < bottom + height:
                return pane
        return None

    def _local(self, pane: int, x: int, y: int) -> tuple[int, int]:
        """Window to pane coordinates, y down."""
        left, bottom, _, height = self._pane_box(pane)
        return x - left, height - 1 - (y - bottom)

    def _knobs(self) -> list[panes.Knob]:
        return panes.knobs_of(self.session, self.pane_size(CONTROLS), self.knobs_first)

    def _press(self, event: str) -> bool:
        interactor = self.plotter.iren.interactor
        x, y = interactor.GetEventPosition()
        pane = self._pane_at(x, y)
        if pane in (SPACE, None):
            return False
        self._start = self._at = (x, y)
        local = self._local(pane, x, y)
        if pane == FRAME:
            box = panes.picture_box(self.pane_size(FRAME), self.session.size)
            line = box.x + self.wipe * box.width
            if event.startswith("Left") and not self.session.coarse and abs(local[0] - line) <= WIPE_SLACK:
                self._drag = "wipe"
            elif event.startswith("Right"):
                self._drag = "zoom"
            else:
                self._drag = "pan" if event.startswith("Middle") or interactor.GetShiftKey() else "orbit"
        elif pane == TEXT and event.startswith("Left"):
            line = panes.plan_line_at(self.session, self.pane_size(TEXT), local[1], self.whole_plan)
            if line is not None:
                self.toggle(line)
        elif pane == CONTROLS and event.startswith("Left"):
            for knob in self._knobs():
                inside = 0 <= local[1] - knob.track.y < knob.track.height
                if inside and abs(knob.track.share_of(*local)[0] - 0.5) <= 0.5 + panes.KNOB_RADIUS / knob.track.width:
                    self._drag = "knob " + knob.name
                    self._slide(knob, local[0])
        return True

    def _move(self, _event: str) -> bool:
        if self._drag is None:
            return False
        x, y = self.plotter.iren.interactor.GetEventPosition()
        if self._drag.startswith("knob "):
            knobs = self._knobs()
            knob = next((each for each in knobs if "knob " + each.name == self._drag), None)
            if knob is not None:
                self._slide(knob, self._local(CONTROLS, x, y)[0])
            return True
        box = panes.picture_box(self.pane_size(FRAME), self.session.size)
        if self._drag == "wipe":
            across, _ = box.share_of(*self._local(FRAME, x, y))
            self.wipe = min(max(across, 0.0), 1.0)
            self.draw(FRAME)
            return True
        far = max(abs(x - self._start[0]), abs(y - self._start[1]))
        if far <= CLICK_SLACK and self._at == self._start:
            return True
        scale = self.session.size[0] / box.width
        dx, dy = scale * (x - self._at[0]), -scale * (y - self._at[1])
        self._at = (x, y)
        if self._drag == "orbit":
            self.session.orbit(dx, dy)
        elif self._drag == "pan":
            self.session.pan(dx, dy)
        else:
            self.session.zoom(ZOOM_STEP ** (dy / 40.0))
        self._show_moving()
        return True

    def _release(self, event: str) -> bool:
        drag, self._drag = self._drag, None
        if drag is None:
            return False
        if drag == "orbit" and self._at == self._start and event.startswith("Left"):
            self._pick_at(*self._start)
        if self.session.coarse:
            self._rest()
        return True

    def _wheel(self, event: str) -> bool:
        x, y = self.plotter.iren.interactor.GetEventPosition()
        pane = self._pane_at(x, y)
        if pane == FRAME:
            self.session.zoom(1.0 / ZOOM_STEP if "Forward" in event else ZOOM_STEP)
            self._show_moving()
        elif pane == CONTROLS:
            last = len(panes.knob_rows(self.session)) - len(self._knobs())
            self.knobs_first = min(max(self.knobs_first + (-1 if "Forward" in event else 1), 0), last)
            self.draw(CONTROLS)
        return pane != SPACE

    def _show_moving(self) -> None:
        self._picture = picture(self.session.frame)
        self._pending = []
        self._moved_at = perf_counter()
        # Once per motion the other panes say that they wait; then only the frame and its numbers are drawn.
        changed = [FRAME] if self._reference is None else [FRAME, REFERENCE, ERROR]
        if self._moved_at - self._told_at > TOLD_SECONDS:
            self._told_at = self._moved_at
            changed.append(TEXT)
        self.draw(*changed)
        self._reference = self._heat = None
        if not self.plotter.off_screen:
            self.plotter.iren.interactor.CreateOneShotTimer(round(1000 * STILL_SECONDS))

    def _timer(self, _event: str) -> bool:
        rested = perf_counter() - self._moved_at >= 0.9 * STILL_SECONDS
        if self.session.coarse:
            if rested and self._drag is None:
                self._rest()
        elif self._pending:
            self._pending.pop(0)()
            if self._pending:
                self.plotter.iren.interactor.CreateOneShotTimer(STEP_MS)
        return False

    def _pick_at(self, x: int, y: int) -> None:
        box = panes.picture_box(self.pane_size(FRAME), self.session.size)
        across, down = box.share_of(*self._local(FRAME, x, y))
        if 0.0 <= across < 1.0 and 0.0 <= down < 1.0:
            width, height = self.session.size
            self.pick(int(across * width), int(down * height))

    def pick(self, x: int, y: int) -> None:
        """Ask a pixel, say what it is, and show its ray."""
        self.session.pick(x, y)
        self.meshes["rays"] = geometry.ray_mesh(self.session.scene, self.session.picks)
        self._update_search()
        self._fill_space()
        self.draw()

    def _slide(self, knob: panes.Knob, x: int) -> None:
        share = (x - knob.track.x) / max(knob.track.width, 1)
        place = round(min(max(share, 0.0), 1.0) * (len(knob.values) - 1))
        if knob.values[place] != self.session.knob_value(knob.name):
            self.turn_knob(knob.name, knob.values[place])

    def turn_knob(self, name: str, value) -> None:
        """Set a control, the camera or the time; what is refused stays, with the reason on screen."""
        if self.session.turn_knob(name, value):
            self._rest()
        else:
            self.draw(CONTROLS)

    def toggle(self, line: PlanLine) -> None:
        """Force what a line of the plan says the other way; where nothing can, the reason is on screen."""
        if self.session.toggle(line):
            self._rest()
        else:
            self.draw(CONTROLS)

    def _char(self, _event: str) -> bool:
        """VTK's own keys would switch to wire frames or stereo; only leaving is left to it."""
        return self._typed is not None or self.plotter.iren.interactor.GetKeyCode() not in ("q", "e")

    def _key(self, _event: str) -> bool:
        interactor = self.plotter.iren.interactor
        symbol, code = interactor.GetKeySym(), interactor.GetKeyCode()
        if self._typed is not None:
            self._type(symbol, code)
            return True
        if code == ":":
            self._typed = ""
            self.draw(CONTROLS)
        elif code == "p":
            self.whole_plan = not self.whole_plan
            self.draw(TEXT)
        elif code == "g":
            self.shows_regions = not self.shows_regions
        elif code == "v":
            self.shows_virtual = not self.shows_virtual
        elif code == "i":
            self.shows_grid = not self.shows_grid
        elif code == "b":
            self.shows_search = not self.shows_search
            self._update_search()
        elif code == "m":
            self.shows_maps = not self.shows_maps
        elif code == "h":
            self.shows_field = not self.shows_field
            if self.shows_field and "field" not in self.meshes:
                self.meshes |= geometry.field_meshes_of(self.session.plan)
        elif code == "t":
            self.shows_tradeoff = not self.shows_tradeoff
            self.draw(REFERENCE)
        elif code == "s":
            self._sweep()
        elif code == "c":
            self.session.picks.clear()
            self.meshes.pop("rays", None)
            self._update_search()
        if code in ("g", "v", "i", "b", "m", "h", "c"):
            self._fill_space()
            self.draw()
        return code not in ("q", "e")

    def _update_search(self) -> None:
        """Bring the search's meshes up to date with the last pick, where they are shown."""
        session = self.session
        if self.shows_search and not session.coarse:
            self.meshes |= geometry.search_meshes_of(session.plan, session.frame, session.picks)

    def _sweep(self) -> None:
        """Measure this view with everything that applies, a contender a step, so that a window answers between."""
        self.shows_tradeoff = True
        self._rest()
        names = self.session.quick_sweep()

        def step() -> None:
            name = next(names, None)
            if name is None:
                self.session.message = f"swept: {len(self.session.tradeoff.marks)} points"
            else:
                self.session.message = f"sweeping: {name}"
                self._pending.append(step)
            self.draw(REFERENCE, CONTROLS)

        self._pending.append(step)
        if not self.stepwise:
            while self._pending:
                self._pending.pop(0)()

    def _type(self, symbol: str, code: str) -> None:
        if symbol in ("Return", "KP_Enter"):
            name, equals, value = self._typed.partition("=")
            self._typed = None
            if equals:
                self.turn_knob(name.strip(), value.strip())
        elif symbol == "Escape":
            self._typed = None
        elif symbol == "BackSpace":
            self._typed = self._typed[:-1]
        elif code and code.isprintable():
            self._typed += code
        self.draw(CONTROLS)

    def _resized(self) -> None:
        self._title(self.plotter.renderers[SPACE].actors["title"].input.strip())
        self.draw()


class _FlatPane:
    """A picture that fills a renderer, pixel by pixel."""

    def __init__(self, renderer):
        self._renderer = renderer
        self._texture = _vtk.vtkTexture()
        self._texture.InterpolateOff()
        self._plane = _vtk.vtkPlaneSource()
        mapper = _vtk.vtkPolyDataMapper()
        mapper.SetInputConnection(self._plane.GetOutputPort())
        actor = _vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.SetTexture(self._texture)
        actor.GetProperty().LightingOff()
        renderer.AddActor(actor)
        renderer.set_background(SPACE_BACK)
        self._size = (0, 0)

    def show(self, image: np.ndarray) -> None:
        """Args: image: uint8 [height, width, 3], row 0 at the top."""
        height, width = image.shape[:2]
        data = pv.ImageData(dimensions=(width, height, 1))
        data.point_data["rgb"] = np.ascontiguousarray(image[::-1]).reshape(-1, 3)
        data.point_data.active_scalars_name = "rgb"
        self._texture.SetInputData(data)
        if (width, height) == self._size:
            return
        self._size = (width, height)
        self._plane.SetOrigin(0.0, 0.0, 0.0)
        self._plane.SetPoint1(width, 0.0, 0.0)
        self._plane.SetPoint2(0.0, height, 0.0)
        camera = self._renderer.camera
        self._renderer.camera_set = True  # or pyvista would choose a view of its own
        camera.ParallelProjectionOn()
        camera.SetFocalPoint(0.5 * width, 0.5 * height, 0.0)
        camera.SetPosition(0.5 * width, 0.5 * height, 1.0)
        camera.SetViewUp(0.0, 1.0, 0.0)
        camera.SetParallelScale(0.5 * height)
        camera.SetClippingRange(0.5, 1.5)


@contextmanager
def _quiet_backend(off_screen: bool | None) -> Iterator[None]:
    """Tell VTK which window to make where there is no display: it would try X first, and complain."""
    off_screen = pv.OFF_SCREEN if off_screen is None else off_screen
    if not off_screen or gl.has_display() or BACKEND in os.environ or not gl.library().startswith("EGL"):
        yield
        return
    os.environ[BACKEND] = "vtkEGLRenderWindow"
    try:
        yield
    finally:
        del os.environ[BACKEND]


def _merged(meshes: list[pv.PolyData]) -> pv.PolyData | None:
    """Meshes of any cells as one, with their data."""
    meshes = [mesh for mesh in meshes if mesh.n_points]
    if not meshes:
        return None
    return meshes[0] if len(meshes) == 1 else meshes[0].append_polydata(*meshes[1:])


def _together(meshes: list[pv.PolyData]) -> pv.PolyData | None:
    """Meshes as one, with the cell colours that all of them have."""
    if not meshes:
        return None
    firsts = np.cumsum([0] + [mesh.n_points for mesh in meshes])
    points = np.concatenate([mesh.points for mesh in meshes])
    if not meshes[0].n_faces:
        return pv.PolyData(points)
    faces = np.concatenate([mesh.regular_faces + first for mesh, first in zip(meshes, firsts[:-1], strict=True)])
    whole = pv.PolyData.from_regular_faces(points, faces)
    whole.cell_data["rgb"] = np.concatenate([mesh.cell_data["rgb"] for mesh in meshes])
    return whole
