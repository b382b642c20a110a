"""Process a stage: the virtual objects of its mirrors, frame by frame, as a layer over it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warp_reflect as wr
from warp_reflect.frame import reflect_scene
from warp_reflect.layers import ReflectionLayer
from warp_reflect.pipeline import (
    FRAME_FAILURES,
    IMPOSSIBLE,
    PART_WAY,
    Job,
    OpenJob,
    Outcome,
    check_range,
    claimed,
    conclude,
    digest_of,
    frame_key,
    listening,
    one_line,
    tell_all,
)
from warp_reflect.plan_rows import PlanRow
from warp_reflect.planner import prefer_forward
from warp_reflect.progress import Report
from warp_reflect.scene import PartRange, Scene
from warp_reflect.stage.write_virtual import PURPOSES, Place, VirtualLayer, VirtualSample
from warp_reflect.timing import StageTimer
from warp_reflect.virtual_objects import VirtualObject, virtual_objects

SAVING_SHARE = 0.1  # of the time that may go into saving the layer while frames are still to come
GLB = ".glb"


@dataclass(frozen=True)
class Wish:
    """What is written beside the frames of a `Job`.

    Attributes:
        clip: Cut virtual objects along their mirror's outline, see `virtual_objects.virtual_objects`.
        purpose: Of the virtual objects in the layer; "guide" keeps them out of every renderer's picture.
        glb: A glTF file of the first frame; empty: none.
    """

    clip: bool = False
    purpose: str = "guide"
    glb: str = ""


def make_job(stage: str, out: str, times: tuple[float | None, ...], **options) -> Job:
    """The range of frames that goes into one layer; options as of `pipeline.Job`."""
    settings = options.pop("settings", wr.Settings()).replace(refine="off")  # no pixel is asked for
    return Job(stage, times, ((out,),) * len(times), settings=settings, **options)


def run(
    job: Job,
    wish: Wish,
    report: Report,
    *,
    resume: bool = False,
    seconds: float | None = None,
    strict: bool = False,
    debug: bool = False,
) -> int:
    """Write the layer of a job and tell of it; returns the exit code, as `pipeline.run`.

    The layer is saved whole under its name after the first frame, then as often as takes a tenth of the time, and at the
    end, however that comes.

    Args:
        job: From `make_job`.
        wish: What else is asked.
        report: Where to tell.
        resume: Keep the frames of an earlier layer of the same stage and options.
        seconds: From now; no frame is begun after it.
        strict: Refuse frames outside of the stage's range.
        debug: Tell tracebacks.

    Raises:
        ValueError, OSError: the stage, the camera or the outputs cannot be used.
    """
    from warp_reflect.stage import write

    if wish.purpose not in PURPOSES:
        raise ValueError(f"--purpose: got '{wish.purpose}', expected one of {', '.join(PURPOSES)}")
    path = write.check_layer_writable(job.files[0][0], job.stage)
    if wish.glb:
        if not wish.glb.lower().endswith(GLB):
            raise ValueError(f"--glb: got '{wish.glb}', expected a name that ends in {GLB}")
        write.check_place(Path(wish.glb))
    deadline = None if seconds is None else time.time() + seconds
    report.busy(f"reading {job.stage}")
    digest = digest_of(job)
    provenance = _provenance(job, wish, digest, path)
    layer = VirtualLayer.open(job.stage, path, provenance, wish.purpose, resume)
    places = [place for place, code in enumerate(job.times) if code not in layer.times]
    kept = len(job.times) - len(places)
    if resume and not kept and path.exists():
        report.line(f"resume: {path} has none of the frames, or is of another stage or other options; made anew")
    if kept:
        report.line(f"resume: {kept:,} of {len(job.times):,} frames are done")
    report.begin(len(places))
    saver = _Saver(layer)
    states: dict[int, str] = {}
    with claimed([str(path)]) as free:
        if not free:
            raise OSError(f"{path}: another process is writing it")
        opened = OpenJob(job, places[0] if places else 0)
        report.busy("planning")
        plan = opened.plan = prefer_forward(opened.plan_at(places[0] if places else 0))
        report.notes([*plan.scene.notes, *plan.notes])
        check_range(job, places, plan.scene.data.time_range, strict, report)
        layer.note(camera=plan.camera.path, plan=json.dumps(plan.to_json()))
        try:
            with listening(job, report) as asked:
                source = _add_frames(opened, wish, places, saver, asked.is_stopped, deadline)
                tell_all(source, job, report, asked, states, debug)
            if "written" in states.values():
                report.busy(f"saving {path}")
                saver.save()
            if wish.glb:
                _write_glb(wish.glb, layer, job.times[0], plan.scene)
        except OSError as error:
            report.line(f"error: {one_line(error)}")
            if saver.saved:
                report.line(f"kept {path} with {saver.saved:,} frame{'s' * (saver.saved != 1)}")
            return PART_WAY if saver.saved or kept else IMPOSSIBLE
    return conclude(job, digest, places, states, asked, report)


class _Saver:
    """Saves a layer now and then.

    Attributes:
        saved: Frames that the file holds.
    """

    def __init__(self, layer: VirtualLayer):
        self.layer = layer
        self.saved = 0
        self._took = 0.0
        self._last = time.perf_counter()

    def save(self) -> None:
        start = time.perf_counter()
        self.layer.save()
        self._last = time.perf_counter()
        self._took = self._last - start
        self.saved = len(self.layer.times)

    def save_if_due(self) -> None:
        if SAVING_SHARE * (time.perf_counter() - self._last) >= self._took:
            self.save()


def _add_frames(
    opened: OpenJob,
    wish: Wish,
    places: list[int],
    saver: _Saver,
    is_stopped: Callable[[], bool],
    deadline: float | None,
) -> Iterator[Outcome]:
    for place in places:
        if is_stopped() or (deadline is not None and time.time() > deadline):
            return
        start = time.perf_counter()
        try:
            outcome = _add_frame(opened, wish, place, saver.layer)
        except FRAME_FAILURES as error:
            outcome = Outcome(place, "failed", one_line(error), traceback.format_exc())
        if outcome.state == "written" and place != places[-1]:
            saver.save_if_due()
        yield dataclasses.replace(outcome, seconds=time.perf_counter() - start)


def _add_frame(opened: OpenJob, wish: Wish, place: int, layer: VirtualLayer) -> Outcome:
    start = time.perf_counter()
    earlier = opened.plan
    opened.plan = plan = prefer_forward(opened.plan_at(place), earlier)
    scene = plan.scene
    _, layers = reflect_scene(scene, plan, plan.camera, StageTimer(scene.device))
    objects = virtual_objects(scene, plan.camera, layers, wish.clip)
    rows = {row.reflector.id: row for row in plan.rows}
    samples = [_sample(scene, plan.camera.eye, rows[each.reflector], each) for each in objects]
    layer.add(opened.job.times[place], scene.origin, samples)
    ms = 1000.0 * (time.perf_counter() - start)
    triangles = sum(len(each.triangles) for each in objects)
    mirrors = len({each.reflector for each in objects})
    text = (
        f"{opened.job.label(place)}: {len(objects):,} virtual object{'s' * (len(objects) != 1)} in {mirrors} "
        f"mirror{'s' * (mirrors != 1)}, {triangles:,} triangles, {ms:.0f} ms"
    )
    notes = [(note.path, note.text) for note in [*scene.notes, *plan.notes]]
    notes += [(row.path, reason) for row in plan.rows if (reason := _lack(row, layers.get(row.reflector.id)))]
    return Outcome(place, "written", text, ms=ms, notes=tuple(notes))


def _lack(row: PlanRow, layer: ReflectionLayer | None) -> str:
    """Why a mirror has no virtual objects, or not for all of its pixels; empty: it has."""
    if layer is None:
        return ""
    if row.technique == "raytraced":
        return f"no virtual objects: {row.reason}"
    if not row.reflector.convex and row.technique != "planar":
        return "not convex: where it shows itself, or hides things from itself, its virtual objects do not tell"
    pixels = {id(drawn.pixels): drawn.pixels.count for drawn in layer.virtual}
    if sum(pixels.values()) < layer.pixels.count:
        return "its virtual objects are not seen at all of its pixels: a part of it is held by rays alone"
    return ""


def _sample(scene: Scene, eye: np.ndarray, row: PlanRow, found: VirtualObject) -> VirtualSample:
    part = scene.parts[found.part]
    instance = scene.data.instances[part.prim - 1]
    mesh = scene.data.meshes[instance.mesh]
    material = scene.data.materials[part.material]
    colors = uvs = None
    if material.uses_vertex_color and mesh.colors is not None:
        colors = _at_corners(scene, part, found, mesh.colors, mesh.color_index)
    if mesh.uvs is not None:
        uvs = _at_corners(scene, part, found, mesh.uvs, mesh.uv_index)
    names = [texture.uv_name for texture in material.textures.values()]
    return VirtualSample(
        Place(row.path, row.subset, row.instance),
        Place(part.prim_path, part.subset, part.instance),
        found.piece,
        row.technique,
        found.points + eye,
        found.triangles,
        tuple(map(float, material.base_color)),
        colors,
        uvs,
        names[0] if names else "st",
    )


def _at_corners(scene: Scene, part: PartRange, found: VirtualObject, values: np.ndarray, index) -> np.ndarray:
    """What a mesh holds per corner, at the corners of virtual triangles, float32 [3 m, n]."""
    mesh = scene.data.meshes[scene.data.instances[part.prim - 1].mesh]
    index = mesh.triangles if index is None else index
    first = part.first_triangle - _first_triangle_of_part(scene, part)
    own = index[found.parents - first]
    if np.linalg.det(part.world_from_object[:3, :3]) < 0.0:  # a scene winds mirrored instances back
        own = own[:, [0, 2, 1]]
    corner = scene.host_points[scene.host_triangles[found.parents]].astype(np.float64)
    weights = _weights(found.sources[found.triangles], corner)
    return np.einsum("mck,mkn->mcn", weights, values[own]).reshape(-1, values.shape[1]).astype(np.float32)


def _first_triangle_of_part(scene: Scene, part: PartRange) -> int:
    """A part's first triangle as its mesh counts them."""
    mesh = scene.data.meshes[scene.data.instances[part.prim - 1].mesh]
    return next((each.first_triangle for each in mesh.parts if each.subset == part.subset), 0)


def _weights(points: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Barycentric weights float64 [m, 3, 3] of three points each in triangles [m, 3, 3]."""
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    p = points - corner[:, :1]
    g11, g12, g22 = (np.einsum("mi,mi->m", a, b)[:, None] for a, b in ((e1, e1), (e1, e2), (e2, e2)))
    d1, d2 = np.einsum("mci,mi->mc", p, e1), np.einsum("mci,mi->mc", p, e2)
    det = np.maximum(g11 * g22 - g12 * g12, 1.0e-300)
    b, c = (g22 * d1 - g12 * d2) / det, (g11 * d2 - g12 * d1) / det
    return np.clip(np.stack([1.0 - b - c, b, c], axis=2), 0.0, 1.0)


def _provenance(job: Job, wish: Wish, digest: str, path: Path) -> dict:
    """What the layer says of itself; "key" tells what its frames are made from."""
    frames = dataclasses.replace(job, times=(None,), files=(("",),))
    told = [frame_key(frames, 0, digest), wish.clip, wish.purpose, job.times == (None,)]
    source = os.path.relpath(Path(job.stage).resolve(), path.resolve().parent)
    return {
        "version": wr.__version__,
        "key": hashlib.blake2b(json.dumps(told).encode(), digest_size=16).hexdigest(),
        "source": Path(source).as_posix(),
        "sourceDigest": digest,
        "settings": json.dumps(dataclasses.asdict(job.settings)),
        "method": job.method,
        "clip": wish.clip,
    }


def _write_glb(name: str, layer: VirtualLayer, code: float | None, scene: Scene) -> None:
    from warp_reflect.stage.glb import write_glb

    meshes = layer.meshes_at(code)
    if not meshes:
        raise OSError(f"{name}: not written: no mirror shows a virtual object in its first frame")
    write_glb(name, meshes, layer.origin, scene.data.up_axis, scene.data.meters_per_unit)
    print(f"{name}: {len(meshes):,} virtual objects", flush=True)
