"""The package beside other renderers on the same stage, pixels and threads: its pictures judged, its time compared.

    python tools/peers.py usd_scenes/kitchen.usda --compare --out pairs
    python tools/peers.py usd_scenes/kitchen.usda usd_scenes/one_mirror.usda --rounds 5

`--compare` judges the picture: the stage, with what is neither diffuse nor a sharp mirror taken off its materials, by
the package (`--method reference`) and by Mitsuba 3 (`mitsuba_scene.py`), as FLIP (Andersson et al., FLIP: A Difference
Evaluator for Alternating Images, 2020; 0 equal, 1 opposite) over all pixels and over those without a mirror. Mitsuba
fills its pixels (`box`) or takes the package's own rays through their centres (`centre`): the difference between the
two is what edges cost that are not smoothed.

Without it, times: medians over rounds in which all contenders take turns, each with its error on the same row.
`identical` is the share of mirror rays that meet the reference's triangle; `PSNR` is of the sRGB picture, against the
converged picture of Mitsuba by the same rays and the same light, or, for Mitsuba's own path tracer (which always casts
all shadows and adds one more bounce), against its own converged picture: its noise. `--light-shadows` says which lights'
shadows the package and `mitsuba direct` both cast, none of them by default.

Mitsuba's vectorised variant needs LLVM 16 or later: DRJIT_LIBLLVM_PATH names the library, or one is looked for where
distributions and Rust keep theirs; VTK needs a GL that draws off screen. What is used is said, who is missing is left out.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import dataclasses
import glob
import importlib.util
import json
import mmap
import os
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parent))
from bench_frames import Embree, commit, machine
from embree_packets import Packets
from wavefronts import MitsubaRays, MitsubaWavefront, Wavefront

SHADOW_SAMPLES = 64
LIGHTING = ("none", "lights", "all")  # which lights' shadows Mitsuba casts
ENVIRONMENT_SIDE = 512  # pixels of a face of VTK's environment
CONVERGED = 128  # samples a pixel of the pictures that others are measured against
SCALAR_CONVERGED = 32  # where there is no vectorised variant
LLVM = "llvm_ad_rgb"
# Where shared libraries of LLVM lie, and what those since version 16 have.
LLVM_PLACES = "/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "~/.rustup/toolchains/*/lib/libLLVM*.so*"
LLVM_LIBRARY, LLVM_SYMBOL = "DRJIT_LIBLLVM_PATH", b"LLVMGetVersion\0"
WARM_UP = 2  # rounds: Dr.Jit compiles another kernel for its second frame
PATH_DEPTH = 3  # eye, mirror, surface, light


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stages", nargs="+")
    parser.add_argument("--compare", action="store_true", help="judge the pictures instead of timing")
    parser.add_argument("--size", default="480x270", help="WxH")
    parser.add_argument("--samples", type=int, default=64, help="light samples a pixel of the judging picture")
    parser.add_argument("--shadows", default="none,lights,all", help=f"some of {','.join(LIGHTING)}, for --compare")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds, after two for warm-up")
    parser.add_argument("--peer-samples", type=int, default=4, help="samples a pixel of Mitsuba's timed pictures")
    parser.add_argument(
        "--converged", type=int, default=CONVERGED, help="samples a pixel of the pictures that timed ones are judged by"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--light-shadows", default="none", choices=LIGHTING, help="which lights' shadows both cast in timed pictures"
    )
    parser.add_argument("--out", help="folder for the pictures that were compared or timed")
    parser.add_argument("--json", action="store_true", help="one line of JSON a row")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    wp.config.quiet = True
    size = tuple(int(side) for side in arguments.size.split("x"))
    library = name_llvm()
    fault = llvm_fault(arguments.threads)
    print(f"LLVM: {library or 'none of 16 or later was found; what Dr.Jit finds itself'}", file=sys.stderr)
    if fault:
        print(f"Mitsuba {LLVM}: {fault}", file=sys.stderr)
        if arguments.compare:
            sys.exit(2)
    rows = []
    for stage in arguments.stages:
        rows += (judge if arguments.compare else times)(stage, size, arguments, not fault)
    if arguments.json:
        for row in rows:
            print(json.dumps(row))
    else:
        (judge_table if arguments.compare else time_table)(rows, arguments)


def name_llvm() -> str:
    """The library that is named in the environment, or the first found that is new enough, which then is; else ""."""
    if LLVM_LIBRARY not in os.environ:
        for place in LLVM_PLACES:
            for path in sorted(glob.glob(os.path.expanduser(place)), reverse=True):
                with open(path, "rb") as file:
                    if (
                        os.path.getsize(path)
                        and mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ).find(LLVM_SYMBOL) >= 0
                    ):
                        os.environ[LLVM_LIBRARY] = path
                        return path
    return os.environ.get(LLVM_LIBRARY, "")


def llvm_fault(threads: int) -> str:
    """Why Mitsuba's vectorised variant cannot be used; empty where it can, and then it is set."""
    fix = "install Mitsuba 3 and LLVM 16 or later, and name its library in DRJIT_LIBLLVM_PATH"
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as fault:
        return f"{fault}; {fix}"
    if LLVM not in mi.variants() or not dr.has_backend(dr.JitBackend.LLVM):
        return f"no libLLVM was found; {fix}"
    mi.set_variant(LLVM)
    dr.set_thread_count(threads)
    dr.eval(mi.Float(0.0) + dr.arange(mi.Float, 2))
    maps = Path("/proc/self/maps")
    if maps.exists():
        # An older one ends the process at its first unknown instruction; this call exists since 16.
        found = {line.split()[-1] for line in maps.read_text().splitlines() if "libLLVM" in line}
        for library in found:
            if not hasattr(ctypes.CDLL(library), "LLVMGetVersion"):
                return f"{library} is too old; {fix}"
    return ""


def diffuse_stage(stage: str, size: tuple[int, int]) -> tuple:
    """(scene with the materials that can be compared, its mirrors' part numbers)."""
    import mitsuba_scene

    import warp_reflect as wr

    scene = wr.load_stage(stage)
    mirrors = {row.reflector.part for row in wr.make_plan(scene, size=size).rows}
    data = mitsuba_scene.diffuse_version(scene.data, {scene.parts[part].material for part in mirrors})
    return type(scene)(data), mirrors


def judge(stage: str, size: tuple[int, int], arguments, _llvm: bool) -> list[dict]:
    """Rows of one stage: FLIP for each lighting."""
    import mitsuba_scene

    import warp_reflect as wr
    from warp_reflect.images import write_png

    scene, mirrors = diffuse_stage(stage, size)
    made = mitsuba_scene.convert(scene.data, scene.data.cameras[0], size, mirrors)
    rows = []
    for shadows in arguments.shadows.split(","):
        settings = wr.Settings(shadows=shadows != "none", dome_shadows=shadows == "all", shadow_samples=SHADOW_SAMPLES)
        frame = wr.render_frame(scene, wr.make_plan(scene, size=size, settings=settings, method="reference"))
        ours = picture(frame)
        plain = frame["reflectorId"] == 0
        row = {"stage": Path(stage).stem, "size": list(size), "shadows": shadows, "samples": arguments.samples}
        row |= {"mirror_share": float(1.0 - plain.mean()), "commit": commit()}
        for filling in ("box", "centre"):
            theirs = mitsuba_scene.direct_picture(made, arguments.samples, shadows, filling == "centre")
            error = flip(theirs, ours)
            row[filling] = {
                "flip_all": float(error.mean()),
                "flip_diffuse": float(error[plain].mean()) if plain.any() else None,
                "psnr_db": psnr(ours, theirs),
                "mean_ours": ours[plain].mean(axis=0).tolist(),
                "mean_theirs": theirs[plain].mean(axis=0).tolist(),
            }
            if arguments.out:
                name = f"{Path(stage).stem}_{shadows}_{filling}"
                folder = Path(arguments.out)
                folder.mkdir(parents=True, exist_ok=True)
                write_png(folder / f"{name}_package.png", ours)
                write_png(folder / f"{name}_mitsuba.png", theirs)
                write_png(folder / f"{name}_flip.png", np.repeat(error[..., None], 3, axis=2))
        rows.append(row)
    return rows


def picture(frame) -> np.ndarray:
    """A frame's linear colours, float32 [height, width, 3]."""
    return np.ascontiguousarray(frame["RGBA"][..., :3])


def shown(linear: np.ndarray) -> np.ndarray:
    """As displayed: sRGB of exposure 0, float32 in 0..1."""
    from warp_reflect.images import srgb_from_linear

    return np.ascontiguousarray(srgb_from_linear(np.clip(linear, 0.0, 1.0)), np.float32)


def flip(reference: np.ndarray, test: np.ndarray) -> np.ndarray:
    """FLIP of two linear pictures as displayed at 67 pixels a degree, [height, width]."""
    import flip_evaluator

    error, _, _ = flip_evaluator.evaluate(shown(reference), shown(test), "LDR", applyMagma=False)
    return np.asarray(error).reshape(*reference.shape[:2], -1)[..., 0]


def psnr(a: np.ndarray, b: np.ndarray, where=None) -> float:
    """Of two linear pictures as displayed, over all pixels or those chosen, in dB."""
    difference = (shown(a) - shown(b)).astype(np.float64)
    square = float(np.mean((difference if where is None else difference[where]) ** 2))
    return -10.0 * np.log10(max(square, 1.0e-12))


@dataclasses.dataclass
class Contender:
    """One row of the time table; `run` gives the milliseconds of its reflections and of its whole frame."""

    name: str
    what: str
    run: object
    identical: object = None  # () -> share of mirror rays with the reference's triangle
    quality: object = None  # () -> (PSNR, against what)
    picture: object = None  # () -> linear picture
    shadows: str | None = None  # whose; None: those that are asked for


def times(stage: str, size: tuple[int, int], arguments, llvm: bool) -> list[dict]:
    """Rows of one stage: every contender in turn."""
    import warp_reflect as wr
    from warp_reflect.images import write_png

    wr.keep_freed_memory()  # as every program that draws many frames does
    mitsuba = importlib.util.find_spec("mitsuba") is not None
    scene, mirrors = diffuse_stage(stage, size) if mitsuba else (wr.load_stage(stage), set())
    base = wr.Settings(
        threads=arguments.threads,
        keep_static=False,
        shadows=arguments.light_shadows != "none",
        dome_shadows=arguments.light_shadows == "all",
    )
    first = wr.render_frame(scene, wr.make_plan(scene, size=size, settings=base, method="reference"))
    contenders = package_contenders(scene, size, base, first)
    judged = None
    if mitsuba:
        judged = mitsuba_contenders(scene, size, mirrors, first, arguments, contenders, llvm)
    if first.layers:
        embree = Embree.over(scene, first)
        if embree:
            contenders.append(
                Contender(
                    "embree hits",
                    "embreex, the mirror rays given",
                    lambda: (embree.trace(), None),
                    lambda: embree.agreement(first),
                    shadows="",
                )
            )
            wave = Wavefront(scene, first)
            contenders.append(
                Contender(
                    "embree wavefront", "embreex, eye rays, NumPy, mirror rays", wave.trace, wave.agreement, shadows=""
                )
            )
            try:
                packets = Packets(wave, arguments.threads)
                kind = "" if packets.native else ", of which this build has none for this processor"
                what = f"Embree 3 from C++, eye and mirror rays in packets of 16{kind}"
                contenders.append(
                    Contender("embree packets", what, lambda: (None, packets.trace()), packets.agreement, shadows="")
                )
            except RuntimeError as fault:
                print(f"embree packets: {fault}", file=sys.stderr)
        vtk = EnvironmentMap.over(scene, first) if mitsuba else None  # whose converter reads the scene
        if vtk:
            what = "one environment texture in PBR mirrors"
            contenders.append(Contender("vtk", what, vtk.run, quality=vtk.quality, picture=vtk.picture, shadows="none"))

    measured: dict[str, list] = {contender.name: [] for contender in contenders}
    for round_ in range(arguments.rounds + WARM_UP):
        for contender in contenders:
            elapsed = contender.run()
            if round_ >= WARM_UP:
                measured[contender.name].append(elapsed)
    rows = []
    for contender in contenders:
        row = {"stage": Path(stage).stem, "size": list(size), "threads": arguments.threads, "rounds": arguments.rounds}
        row |= {"contender": contender.name, "what": contender.what, "machine": machine(), "commit": commit()}
        row["triangles"] = scene.triangle_count
        row["shadows"] = contender.shadows if contender.shadows is not None else arguments.light_shadows
        row["mirror_pixels"] = int((first["reflectorId"] > 0).sum())
        for k, name in enumerate(("reflect_ms", "frame_ms")):
            values = [elapsed[k] for elapsed in measured[contender.name] if elapsed[k] is not None]
            row[name] = statistics.median(values) if values else None
        row["identical"] = contender.identical() if contender.identical else None
        row["psnr_db"], row["against"] = contender.quality() if contender.quality else (None, "")
        if contender.picture and judged is not None and row["psnr_db"] is None:
            row["psnr_db"], row["against"] = psnr(contender.picture(), judged), "same light, converged"
        rows.append(row)
        if arguments.out and contender.picture:
            folder = Path(arguments.out)
            folder.mkdir(parents=True, exist_ok=True)
            write_png(folder / f"{Path(stage).stem}_{contender.name.replace(' ', '_')}.png", contender.picture())
    return rows


def package_contenders(scene, size, base, first) -> list[Contender]:
    """The package: every mirror traced, and as it plans itself."""
    import warp_reflect as wr

    contenders = []
    for name, method in (("reference", "reference"), ("auto", "auto")):
        plan = wr.make_plan(scene, size=size, settings=base, method=method)
        last = {}

        def run(plan=plan, last=last, warm=method == "auto"):
            last["frame"] = wr.render_frame(scene, plan, previous=last.get("frame") if warm else None)
            spent = last["frame"].timings
            return spent.get("reflect", 0.0), sum(ms for step, ms in spent.items() if "/" not in step)

        def identical(last=last):
            comparison = wr.compare_frames(last["frame"], first)
            return comparison.share(comparison.identical)

        techniques = ", ".join(sorted({row.technique for row in plan.rows})) or "no mirror"
        contenders.append(
            Contender(
                name, f"this package, {techniques}", run, identical, picture=lambda last=last: picture(last["frame"])
            )
        )

    def hits(last=last):
        spent = last["frame"].timings
        return None, sum(ms for step, ms in spent.items() if "/" not in step and step != "shade")

    contenders.append(Contender("auto, hits", "the same frame without its shading", hits, identical, shadows=""))
    return contenders


def mitsuba_contenders(
    scene, size, mirrors, first, arguments, contenders: list[Contender], llvm: bool
) -> np.ndarray | None:
    """Adds Mitsuba's rows; returns the converged picture by the package's rays and lights, None without LLVM."""
    import drjit as dr
    import mitsuba as mi
    import mitsuba_scene

    data, camera, samples = scene.data, scene.data.cameras[0], arguments.peer_samples
    judged, converged = None, {}
    last: dict[str, np.ndarray] = {}
    counter = iter(range(1, 1 << 30))
    if llvm:
        made = mitsuba_scene.convert(data, camera, size, mirrors)
        judged = mitsuba_scene.direct_picture(made, arguments.converged, arguments.light_shadows, centred=True)
        if first.layers:
            rays = MitsubaRays(scene, first)
            what = f"{LLVM}, the mirror rays given"
            contenders.append(Contender("mitsuba hits", what, lambda: (rays.trace(), None), rays.agreement, shadows=""))
            both = MitsubaWavefront(Wavefront(scene, first), rays.scene)
            what = f"{LLVM}, eye and mirror rays in one kernel"
            contenders.append(
                Contender("mitsuba wavefront", what, lambda: (None, both.trace()), both.agreement, shadows="")
            )

        def same_light():
            start = time.perf_counter()
            last["direct"] = mitsuba_scene.direct_picture(
                made, samples, arguments.light_shadows, centred=True, seed=next(counter)
            )
            return None, 1000.0 * (time.perf_counter() - start)

        what = f"{LLVM}, same rays and light, {samples} samples"
        contenders.append(Contender("mitsuba direct", what, same_light, picture=lambda: last["direct"]))
    for variant in (LLVM, "scalar_rgb") if llvm else ("scalar_rgb",):
        if variant not in mi.variants():
            continue
        mi.set_variant(variant)
        own = mitsuba_scene.convert(data, camera, size, mirrors, samples, ideal=True)
        loaded = mi.load_dict(own.whole({"type": "path", "max_depth": PATH_DEPTH, "hide_emitters": False}))
        if "path" not in converged:
            spp = arguments.converged if variant == LLVM else min(arguments.converged, SCALAR_CONVERGED)
            converged["path"] = np.array(loaded.integrator().render(loaded, spp=spp))[..., :3]

        def path(loaded=loaded, variant=variant):
            start = time.perf_counter()
            seed = next(counter)
            # A literal would be compiled into the kernel, anew each time.
            seed = seed if variant != LLVM else dr.opaque(mi.UInt32, seed)
            last[variant] = np.array(loaded.integrator().render(loaded, seed=seed, spp=samples))[..., :3]
            return None, 1000.0 * (time.perf_counter() - start)

        contenders.append(
            Contender(
                f"mitsuba {variant.split('_')[0]}",
                f"{variant}, its path tracer, {samples} samples",
                path,
                quality=lambda variant=variant: (psnr(last[variant], converged["path"]), "its own, converged"),
                picture=lambda variant=variant: last[variant],
                shadows="all",
            )
        )
    if llvm:
        mi.set_variant(LLVM)
    dr.set_thread_count(arguments.threads)
    return judged


class EnvironmentMap:
    """A frame by VTK: the mirrors show one environment texture, taken from the middle of the largest of them.

    The texture is the package's own picture of the scene without its mirrors, so that colours agree and the error
    is that of reflecting surroundings as if they were far away; and of VTK, whose mirrors see a copy of 128 pixels a face.
    """

    def __init__(self, scene, first):
        import mitsuba_scene
        import pyvista as pv

        rows = [row for row in first.plan.rows if row.reflector.id in first.layers]
        largest = scene.parts[max(rows, key=lambda row: first.layers[row.reflector.id].pixels.count).reflector.part]
        own = scene.host_triangles[largest.first_triangle : largest.first_triangle + largest.triangle_count]
        corners = scene.host_points[own.reshape(-1)].astype(np.float64)
        middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0)) + scene.origin
        mirrors = {row.reflector.part for row in first.plan.rows}
        camera = first.camera
        self.mirror = first["reflectorId"] > 0
        self.reference = picture(first)
        self.plotter = pv.Plotter(off_screen=True, window_size=camera.size, lighting="none")
        self.plotter.set_background("black")
        part = 0
        for instance in scene.data.instances:
            mesh = scene.data.meshes[instance.mesh]
            for k, (start, count, patches) in enumerate(mitsuba_scene.parts_of(mesh)):
                material = scene.data.materials[instance.materials[k]]
                corner = mitsuba_scene.part_corners(mesh, start, count, patches)
                linear = instance.world_from_object[:3, :3]
                points = corner["points"] @ linear.T + (instance.world_from_object[:3, 3] - scene.origin)
                faces = np.arange(len(points)).reshape(-1, 3)
                surface = pv.PolyData.from_regular_faces(points.astype(np.float32), faces)
                if corner["normals"] is not None:
                    normals = corner["normals"] @ np.linalg.inv(linear)
                    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1.0e-30)
                    surface.point_data.active_normals = normals.astype(np.float32)
                look = {"pbr": True, "metallic": 1.0, "roughness": 0.0} if part in mirrors else {"lighting": False}
                if material.uses_vertex_color and corner["colors"] is not None:
                    surface.point_data["color"] = np.round(255.0 * shown(corner["colors"])).astype(np.uint8)
                    look |= {"scalars": "color", "rgb": True}
                else:
                    look["color"] = shown(np.array(material.base_color)).tolist()
                self.plotter.add_mesh(surface, **look)
                part += 1
        self.plotter.set_environment_texture(self._texture(scene, middle), is_srgb=True)
        # A smooth metal needs neither diffuse nor blurred copies, whose making takes minutes without a GPU.
        renderer = self.plotter.renderer
        renderer.GetEnvMapIrradiance().SetIrradianceSize(4)
        renderer.GetEnvMapIrradiance().SetIrradianceStep(0.5)
        renderer.GetEnvMapPrefiltered().SetPrefilterMaxSamples(4)
        eye = camera.eye - scene.origin
        view = self.plotter.camera
        view.position, view.focal_point, view.up = eye, eye + camera.forward, camera.up
        view.view_angle = float(np.degrees(2.0 * np.arctan(0.5 * camera.size[1] / camera.fy)))
        distance = float(np.linalg.norm(eye - scene.host_points.mean(axis=0)))
        view.clipping_range = (1.0e-3 * scene.size, 2.0 * scene.size + distance)
        self.seen = None

    @classmethod
    def over(cls, scene, first):
        """None where VTK or a GL that draws off screen is missing, or nothing is reflected."""
        try:
            import pyvista  # noqa: F401

            return cls(scene, first) if first.layers else None
        except (ImportError, RuntimeError) as fault:
            print(f"VTK: {fault}; no environment row", file=sys.stderr)
            return None

    def _texture(self, scene, middle: np.ndarray):
        """Cube map of the scene without the prims that mirror, seen from a point."""
        import pyvista as pv

        import warp_reflect as wr
        from warp_reflect.layers import Camera

        mirrors = {row.reflector.part for row in wr.make_plan(scene, size=self.reference.shape[1::-1]).rows}
        prims = {scene.parts[part].prim for part in mirrors}
        instances = [inst for k, inst in enumerate(scene.data.instances, 1) if k not in prims]
        empty = type(scene)(dataclasses.replace(scene.data, instances=instances))
        texture = pv.Texture()
        texture.SetCubeMap(True)
        x, y, z = np.eye(3)
        # OpenGL 4.6 core specification, table 8.19: (forward, along the columns, along the rows).
        # VTK looks its environment up with z turned round.
        faces = [(x, -z, -y), (-x, z, -y), (y, x, z), (-y, x, -z), (z, x, -y), (-z, -x, -y)]
        half = 0.5 * ENVIRONMENT_SIDE
        near = 1.0e-3 * scene.size
        side = (ENVIRONMENT_SIDE, ENVIRONMENT_SIDE)
        for k, axes in enumerate(faces):
            forward, column, row = (axis * [1.0, 1.0, -1.0] for axis in axes)
            camera = Camera(middle, column, -row, forward, half, half, half, half, near, 1.0e4 * near, side)
            frame = wr.render_frame(empty, wr.make_plan(empty, camera, side, method="reference"))
            texels = np.round(255.0 * shown(picture(frame))).astype(np.uint8)
            image = pv.ImageData(dimensions=(*side, 1))
            image.point_data["color"] = texels.reshape(-1, 3)
            image.set_active_scalars("color")
            texture.SetInputDataObject(k, image)
        texture.MipmapOn()
        texture.InterpolateOn()
        return texture

    def run(self) -> tuple[None, float]:
        """Milliseconds of a frame, read back."""
        start = time.perf_counter()
        self.plotter.render()
        self.seen = self.plotter.screenshot(return_img=True)
        return None, 1000.0 * (time.perf_counter() - start)

    def picture(self) -> np.ndarray:
        """Linear colours."""
        from warp_reflect.images import linear_from_srgb

        return linear_from_srgb(self.seen[..., :3].astype(np.float32) / 255.0)

    def quality(self) -> tuple[float, str]:
        """PSNR over the mirrors' pixels."""
        return psnr(self.picture(), self.reference, self.mirror), "reference, its mirror pixels"


def judge_table(rows: list[dict], arguments) -> None:
    """Print the rows of `judge` for a reader."""
    print(f"FLIP against Mitsuba, {arguments.size}, {arguments.samples} samples; commit {rows[0]['commit']}")
    print(
        f"{'stage':28s} {'shadows':8s} {'mirror %':>8s}  {'box: all':>9s} {'diffuse':>8s}  {'centre: all':>11s} {'diffuse':>8s}"
    )
    for row in rows:
        cells = []
        for filling in ("box", "centre"):
            for name in ("flip_all", "flip_diffuse"):
                value = row[filling][name]
                cells.append("       -" if value is None else f"{value:8.4f}")
        print(
            f"{row['stage']:28s} {row['shadows']:8s} {100 * row['mirror_share']:8.1f}   {cells[0]} {cells[1]}     "
            f"{cells[2]} {cells[3]}"
        )


def time_table(rows: list[dict], arguments) -> None:
    """Print the rows of `times` for a reader."""
    print(
        f"{rows[0]['machine']}; {arguments.threads} thread(s); {arguments.size}; medians of {arguments.rounds}; "
        f"commit {rows[0]['commit']}"
    )
    header = f"{'stage':14s} {'contender':17s} {'reflect ms':>10s} {'frame ms':>9s} {'identical':>10s} {'PSNR dB':>8s} "
    print(header + f"{'shadows':8s}  against; what")
    for row in rows:
        cells = [
            f"{'-':>{width}s}" if row[name] is None else f"{scale * row[name]:{width}.{digits}f}"
            for name, width, digits, scale in (
                ("reflect_ms", 10, 1, 1.0),
                ("frame_ms", 9, 1, 1.0),
                ("identical", 9, 3, 100.0),
                ("psnr_db", 9, 1, 1.0),
            )
        ]
        percent = " " if row["identical"] is None else "%"
        against = f"{row['against']}; " if row["against"] else ""
        print(
            f"{row['stage'][:14]:14s} {row['contender']:17s} {cells[0]} {cells[1]} {cells[2]}{percent} {cells[3]} "
            f"{row['shadows']:8s}  "
            f"{against}{row['what']}"
        )


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError):
        main()
