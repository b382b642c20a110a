"""Measure what the steps of a frame cost on this machine, on a small scene made here.

Every figure is a median of some repeats, on the CPU of this thread's own time, which others on the machine disturb little.
Steps are timed as frames time them (kernels are loaded before), and divided by the counts that `budget.predict` estimates,
so that a prediction errs only as far as those counts do, whatever a step consists of.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import statistics
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from warp_reflect.budget import GLOSSY_RAYS, TRACE_BASE, Costs, packed
from warp_reflect.calibration import built_in
from warp_reflect.frame import Frame, render_frame
from warp_reflect.launch import thread_count
from warp_reflect.planner import Plan, make_plan
from warp_reflect.scene import (
    CameraData,
    InstanceData,
    LightData,
    MaterialData,
    MeshData,
    Part,
    Patch,
    Scene,
    SceneData,
    Shape,
)
from warp_reflect.settings import Settings
from warp_reflect.timing import counted_by

SIZE = (480, 270)
SMALL = (160, 90)  # the same with few pixels
FEW = (16, 9)  # with next to none
DEVICE_SIDES = (
    6  # times as long on a CUDA device, pictures' and walls' (in cells): launches alone take a millisecond there
)
REPEATS = 3  # the middle one of three frames counts
ROWS = 24  # of a ball's facets, from pole to pole
WALL_CELLS = 48  # along a side of each of six walls
BALLS = 16
HALF = 5.0  # of the room: closed, so that rays go as deep as in rooms that are no tests
STEP = 0.004  # by which the eye moves between two frames, of its distance to the mirror
SEED = 7
CHROME = MaterialData(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0)
ROUGHNESS = 0.2
LAMP = 1.0  # radius: penumbras are as wide as in rooms that are no tests
GRID_PX = 0.5
LOCAL_SIDE = 64  # texels along an edge of a local map
UNBENT_PX = 1.0e4  # edges are looked at, none is cut
SOME_PX = 0.5  # some are
BENT_PX = 0.03  # as many vertices are added as there were


def measure(device: str = "cpu", repeats: int = REPEATS, report: Callable[[str], None] | None = None) -> Costs:
    """The costs of this machine.

    Args:
        device: Warp device.
        repeats: Of every frame.
        report: Told what is being measured.
    """
    clock = time.perf_counter if wp.get_device(device).is_cuda else time.thread_time
    with counted_by(clock):
        return _measure(device, repeats, report or (lambda text: None))


def _measure(device: str, repeats: int, told: Callable[[str], None]) -> Costs:
    found: dict[str, float] = {}
    ball, wall, hollow = (_scene(kind, device) for kind in ("ball", "wall", "hollow"))
    told("rays")
    traced = _timed(ball, "reference", repeats)
    few = _timed(ball, "reference", repeats, size=FEW)
    ray = (traced.us("reflect") - few.us("reflect")) / (traced.pixels - few.pixels)
    found["trace"] = ray / packed(ball.triangle_count, traced.pixels)
    found["layer"] = max(few.us("reflect") - few.pixels * ray, 1.0)
    told("quadrics and maps")
    for name, technique in (("quadric", "quadric"), ("map", "reflector_map")):
        cold = _timed(ball, technique, repeats, edge_px=UNBENT_PX)
        warm = _timed(ball, technique, repeats, warm=True)
        found[f"{name}_cold"] = cold.us("reflect/search") / cold.scene_vertices
        found[f"{name}_warm"] = (warm.us("reflect/search") + warm.us("reflect/tessellate")) / warm.vertices
        if name == "map":
            some, many = (_timed(ball, technique, repeats, edge_px=px) for px in (SOME_PX, BENT_PX))
            added = [each.vertices - each.scene_vertices for each in (some, many)]
            found["cut"] = (many.us("reflect/tessellate") - some.us("reflect/tessellate")) / max(added[1] - added[0], 1)
            found["bent"] = (some.us("reflect/tessellate") - added[0] * found["cut"]) / some.scene_vertices
            small = _timed(ball, technique, repeats, warm=True, size=SMALL)
            found["draw"], found["covered"] = _drawn(small, warm)
            found["refined"] = warm.us("reflect/refine") / warm.pixels
    off = _timed(ball, "quadric", repeats, refine="off")
    found["candidate"] = off.us("reflect/candidates") / off.pixels
    gridded = _timed(ball, "reflector_map", repeats, grid_error_px=GRID_PX, edge_px=0.0)
    nodes = gridded.counts.get("grid_nodes", 0) + gridded.counts.get("grid_exact", 0)
    rest = gridded.us("reflect/search") - nodes * found["map_cold"]
    found["interpolated"] = max(rest, 0.1 * gridded.us("reflect/search")) / gridded.scene_vertices
    told("planes and hollow mirrors")
    plane = _timed(wall, "planar", repeats)
    found["mirrored"] = plane.us("reflect/search") / plane.scene_vertices
    inside = _timed(hollow, "quadric", 1)
    found["branches"] = inside.us("reflect/search") / inside.scene_vertices
    found["own_body"] = inside.us("reflect/own_body") / inside.pixels
    told("environment maps")
    drawn = [_timed(ball, "environment", repeats, environment_resolution=side) for side in (32, 128)]
    texels = [6 * side**2 for side in (32, 128)]
    slope = (drawn[1].us("prepare") - drawn[0].us("prepare")) / (texels[1] - texels[0])
    found["map_texel"] = max(slope, 0.1 * drawn[1].us("prepare") / texels[1])
    faces = 6 * ball.triangle_count
    found["map_triangle"] = max(drawn[0].us("prepare") - texels[0] * found["map_texel"], 0.0) / faces
    found["looked_up"] = max(drawn[1].us("reflect") - found["layer"], 0.1 * drawn[1].us("reflect")) / drawn[1].pixels
    local = _timed(ball, "layered_environment", repeats, environment_resolution=LOCAL_SIDE)
    # What its maps were blended from is kept with the scene, and that step's built-in cost stands; so does what a mirror that is
    # reflected forward takes beyond counts, which a scene as small as this one shows little of.
    found["followed"] = max(local.us("reflect") - found["layer"], 0.1 * local.us("reflect")) / local.pixels
    told("the eye's view")
    small, large = (_timed(ball, "none", repeats, size=size) for size in ((240, 135), (960, 540)))
    found["eye_pixel"] = (large.view_us - small.view_us) / (large.picture - small.picture)
    found["eye_triangle"] = (small.view_us - small.picture * found["eye_pixel"]) / ball.triangle_count
    plain = _timed(ball, "none", repeats)
    found["mirror_pixel"] = (traced.view_us - plain.view_us) / traced.pixels
    lit = _scene("lamp", device)
    dark, bright = _timed(lit, "none", repeats, shadows="off"), _timed(lit, "none", repeats, shadow_min_share=0.0)
    found["shadow"] = (bright.us("shade") - dark.us("shade")) / max(bright.shadow_rays, 1)
    found["shadow"] *= math.log2(TRACE_BASE) / math.log2(lit.triangle_count)
    told("rough mirrors and panes")
    rough = _timed(_scene("rough", device), "reference", repeats, glossy="gather")
    lobe = (rough.us("shade") - traced.us("shade")) / (rough.pixels * GLOSSY_RAYS["gather"])
    found["gathered"] = max(lobe - ray, 0.1 * lobe)
    pane = _timed(_scene("pane", device), "none", repeats)
    found["through"] = pane.us("transmission") / pane.panes
    found["sharing"] = _sharing(ball, device, repeats, traced)
    usual = built_in(device)
    return dataclasses.replace(usual, **{name: _likely(value, getattr(usual, name)) for name, value in found.items()})


@dataclasses.dataclass(frozen=True)
class _Measured:
    """The median times of some frames that differ in nothing, on one thread, and their counts."""

    ms: dict[str, float]
    counts: dict[str, float]
    pixels: int
    picture: int
    scene_vertices: int
    triangles: int
    shadow_rays: int
    panes: int

    @property
    def vertices(self) -> int:
        return int(self.counts["vertices"])

    @property
    def view_us(self) -> float:
        return sum(self.us(step) for step in ("raster", "mirror_pixels", "shade"))

    def us(self, step: str) -> float:
        return 1000.0 * self.ms.get(step, 0.0)


def _timed(scene: Scene, method: str, repeats: int, warm: bool = False, size=SIZE, threads: int = 1, **settings):
    asked = Settings(threads=threads, keep_static=False, environment_px=0.0, **settings)
    if size != FEW:
        size = tuple(side * _sides(scene.device) for side in size)
    plan = make_plan(scene, None, size, asked, method, costs=built_in(scene.device))
    render_frame(scene, plan)  # kernels, and what a scene makes once
    timings: list[dict[str, float]] = []
    frame: Frame | None = None
    for k in range(repeats):
        plan._prepared.clear()
        # No frame is held that a walk would not hold: each further one has the system find its pages, a frame's time again.
        frame = render_frame(scene, plan, _moved(plan, k)) if warm else None
        frame = render_frame(scene, plan, _moved(plan, k + 1), previous=frame)
        timings.append(frame.timings)
    steps = set().union(*timings)
    own = sum(scene.parts[row.reflector.part].vertex_count for row in plan.rows)
    meshes = [drawn.mesh for layer in frame.layers.values() for drawn in layer.virtual]
    return _Measured(
        {step: statistics.median(each.get(step, 0.0) for each in timings) for step in steps},
        frame.statistics,
        sum(layer.pixels.count for layer in frame.layers.values()),
        size[0] * size[1],
        scene.vertex_count - own,
        sum(len(mesh.host_triangles) for mesh in meshes),
        sum(int(row.effects["shadows"].numbers.get("rays", 0)) for row in plan.lights),
        sum(pane.pixels for pane in plan.panes),
    )


def _sides(device: wp.DeviceLike) -> int:
    return DEVICE_SIDES if wp.get_device(device).is_cuda else 1


def _drawn(small: _Measured, large: _Measured) -> tuple[float, float]:
    """What a virtual triangle and a mirror pixel cost to draw, from pictures of two sizes."""
    counts = np.array([[each.triangles, each.pixels] for each in (small, large)], np.float64)
    spent = np.array([each.us("reflect/virtual_raster") for each in (small, large)])
    found = np.linalg.solve(counts, spent) if np.linalg.det(counts) > 0.0 else spent[1] / counts[1] / 2.0
    # A disturbed difference leaves each at least a part of the whole.
    return tuple(float(max(value, 0.1 * spent[1] / count)) for value, count in zip(found, counts[1], strict=True))


def _moved(plan: Plan, k: int):
    return dataclasses.replace(plan.camera, eye=plan.camera.eye + k * STEP * 4.0 * plan.camera.right)


def _sharing(scene: Scene, device: str, repeats: int, alone: _Measured) -> float:
    """Of a further thread, how much it adds to the first, by rays."""
    threads = thread_count(device)
    if threads < 2:
        return built_in(device).sharing
    together = _timed(scene, "reference", repeats, threads=threads)
    speed = alone.us("reflect") / max(together.us("reflect"), 1e-9)
    return min(max((speed - 1.0) / (threads - 1), 0.05), 1.0)


def _likely(value: float, usual: float) -> float:
    """A cost no further from the built-in one than a disturbed difference of two times can bring it."""
    return min(max(float(value), 0.01 * usual), 100.0 * usual)


# The scene.


def _scene(kind: str, device: wp.DeviceLike) -> Scene:
    """A mirror in a room among balls: a sphere, a rough one, a square, or a bowl; a pane; or the room with a lamp."""
    mesh, where, cells, balls = ball(analytic=True), _placed(0.0, 0.0, 0.0), WALL_CELLS * _sides(device), BALLS
    camera, lights, material = _placed(0.1, 0.3, 4.0), [], CHROME
    if kind == "rough":
        material = dataclasses.replace(CHROME, roughness=ROUGHNESS)
    elif kind == "pane":
        material = MaterialData(opacity=0.5)
    if kind in ("wall", "pane"):
        mesh = square(2, 2.0)
        where = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, -1.5], [0, 0, 0, 1]])
    elif kind == "hollow":
        mesh = _bowl(mesh)
        where, cells, balls, camera = _placed(0.0, 0.0, 0.0, 6.0), 2, 1, _placed(0.1, 0.3, 3.0)
    elif kind == "lamp":
        lights = [LightData("/lamp", "sphere", (9.0, 9.0, 9.0), _placed(1.0, 3.0, 1.0), size=(LAMP,))]
        balls *= 4
    rng = np.random.default_rng(SEED)
    instances = [InstanceData(0, where, "/mirror", (0,))]
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        wall = np.eye(4)
        wall[:3, :3] = np.roll(np.eye(3), axis - 1, axis=0)  # what lay along Y lies along the axis
        wall[axis, 3] = side * HALF
        instances.append(InstanceData(1, wall, f"/wall{len(instances)}", (1,)))
    while balls:
        x, y, z = rng.uniform((-3.0, -1.5, -2.0), (3.0, 1.5, 4.5))
        if x * x + y * y + z * z > 2.0:
            instances.append(InstanceData(2, _placed(x, y, z, 0.3), f"/ball{balls}", (1,)))
            balls -= 1
    meshes = [mesh, square(cells, HALF), ball()]
    view = CameraData("/camera", camera, near=0.05, focal_length=22.0)
    return Scene(SceneData("calibration", meshes, instances, [material, MaterialData()], lights, [view]), str(device))


def _placed(x: float, y: float, z: float, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix


def ball(analytic: bool = False) -> MeshData:
    columns = 2 * ROWS
    theta, phi = np.meshgrid(np.linspace(0, np.pi, ROWS + 1), np.arange(columns) * np.pi / ROWS, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points[0], points[-1] = (0, 1, 0), (0, -1, 0)
    points = points.reshape(-1, 3).astype(np.float32)
    i = np.arange(ROWS * columns)
    right = i // columns * columns + (i + 1) % columns
    faces = np.concatenate([np.stack([i, right, i + columns], 1), np.stack([right, right + columns, i + columns], 1)])
    corner = points[faces]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1)
    faces = faces[area > 1.0e-9].astype(np.int32)  # not the poles' empty ones
    shape = (Patch(0, len(faces), Shape("quadric", np.eye(4), 1.0, 0.0, 1.0)),)
    return MeshData(points, faces, points, parts=[Part(0, len(faces), patches=shape)] if analytic else [])


def _bowl(ball: MeshData) -> MeshData:
    """The half of an analytic ball away from the eye, seen from within."""
    faces = ball.triangles[ball.points[ball.triangles].mean(axis=1)[:, 2] < 0.0]
    patch = dataclasses.replace(ball.parts[0].patches[0], triangle_count=len(faces))
    return dataclasses.replace(ball, triangles=faces, parts=[Part(0, len(faces), patches=(patch,))], double_sided=True)


def square(cells: int, half: float) -> MeshData:
    side = np.linspace(-half, half, cells + 1)
    z, x = np.meshgrid(side, side, indexing="ij")
    points = np.stack([x, 0.0 * x, z], -1).reshape(-1, 3).astype(np.float32)
    i = np.arange(cells * cells)
    a = i // cells * (cells + 1) + i % cells
    below = a + cells + 1
    faces = np.concatenate([np.stack([a, below, a + 1], 1), np.stack([a + 1, below, below + 1], 1)])
    return MeshData(points, faces.astype(np.int32), double_sided=True)
