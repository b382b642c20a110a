"""What the samples of a shape light's shadow cost and give: error beside time, against many samples.

    python tools/bench_shadows.py usd_scenes/corridor.usda --size 640x360

*Irradiance* is of all lights but the domes on what the eye sees directly; its error is the root mean square over the
pixels in a penumbra (where the samples of the exact picture disagree), of the unshadowed irradiance there. Times are of
one process, median of `--rounds`, CPU time of all threads; the rows below with `shadow_sharing=on` instead of `off`, and the
domes' the same with `dome_shadows=on`. The last rows are rays alone, from every point to one place of each shape: of the plain
kernel, in packets, and, where it is installed, of Embree through embreex to the shapes' middles.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
import warp as wp

import warp_reflect as wr
from warp_reflect import devices, direct, launch, raster, shadow_starts, shadows, shadows_vector, vector

EXACT = 1024  # samples; sixteen times the most that is measured
SAMPLES = (1, 4, 16, 64)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--size", default="640x360")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=0)
    arguments = parser.parse_args()
    width, height = (int(side) for side in arguments.size.split("x"))
    devices.open_device("cpu")
    scene = wr.load_stage(arguments.stage)
    plan = wr.make_plan(scene, size=(width, height), settings=wr.Settings(shadows="off"))
    gbuffer = raster.draw_scene(scene, plan.camera, arguments.threads)
    points = direct.points_of(scene, gbuffer, None, arguments.threads)
    seen = gbuffer.triangle.numpy() >= 0

    def irradiance(samples: int, shared: bool = False) -> np.ndarray:
        cast = replace(shadows.every_shadow(scene, samples), shared=shared)
        return shadows.shadowed_irradiance(scene, points, cast, arguments.threads).numpy()[seen].mean(axis=1)

    def sky(samples: int) -> np.ndarray:
        return shadows.sky_share(scene, points, samples, arguments.threads).numpy()[seen]

    unshadowed = (
        direct.direct_irradiance(scene, scene.lights.direct, points, arguments.threads).numpy()[seen].mean(axis=1)
    )
    print(f"{arguments.stage}  {width}x{height}, {seen.sum()} points")
    if len(scene.lights.direct.areas):
        exact = irradiance(EXACT)
        part = (exact > 0.02 * unshadowed) & (exact < 0.98 * unshadowed)
        print(f"lights: {part.mean():.1%} of the points partly shadowed")
        report(irradiance, exact, part, unshadowed, arguments.rounds)
        print("lights, neighbours share what their rays find")
        report(lambda samples: irradiance(samples, True), exact, part, unshadowed, arguments.rounds)
        report_rays(scene, points, arguments)
    exact = sky(EXACT)
    print("domes")
    report(sky, exact, np.full(len(exact), True), np.ones(len(exact)), arguments.rounds)


def report(answer, exact, part, whole, rounds: int) -> None:
    """One line per number of samples: its error and its time."""
    for samples in SAMPLES:
        spent = []
        for _ in range(rounds):
            start = time.process_time()
            got = answer(samples)
            spent.append(time.process_time() - start)
        error = ((got - exact) / np.maximum(whole, 1.0e-9))[part]
        print(
            f"  {samples:4d} samples: rms error {np.sqrt(np.mean(error**2)):.4f}, 95 % within "
            f"{np.percentile(np.abs(error), 95):.4f}, CPU {1e3 * np.median(spent):.0f} ms"
        )


def report_rays(scene, points, arguments: argparse.Namespace) -> None:
    """One line per way of sending the same rays: millions a second, of this process' CPU time."""
    lights, mesh, threads = scene.lights.direct, wp.uint64(scene.shadow_tracer.id), arguments.threads
    areas = lights.areas.numpy()
    starts = shadow_starts.starts_of(scene, points, None, len(areas), threads)
    count = len(points.triangle)
    share = wp.zeros(count * (len(lights.distant) + len(areas)), dtype=float, device="cpu")
    asked = starts.unshadowed.numpy()[:, :count] > 0.0
    sun = sum(
        int((starts.rows.numpy()[3:6, :count].T @ light["to_light"] > 0.0).sum()) for light in lights.distant.numpy()
    )
    rays = int(asked.sum()) + sun
    ways = {
        "plain": lambda: launch.launch(
            shadows.light_shares_kernel, count, [mesh, lights, starts, 1, share], "cpu", threads
        )
    }
    if not vector.missing():
        wide = wp.uint64(scene.shadow_tracer.packets)
        ways["packets"] = lambda: shadows_vector.shares(wide, lights, starts, count, 1, share, threads)
    try:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh
    except ImportError:
        pass
    else:
        traced = rtcore_scene.EmbreeScene()
        TriangleMesh(traced, scene.host_points.astype(np.float32), scene.host_triangles.astype(np.int32))
        p = starts.rows.numpy()[:3, :count].T
        origins = np.concatenate([p[own] for own in asked])
        to = np.concatenate([light["centre"] - p[own] for light, own in zip(areas, asked, strict=True)])
        distance = np.linalg.norm(to, axis=1).astype(np.float32)
        origins, to = (np.ascontiguousarray(each, np.float32) for each in (origins, to / distance[:, None]))
        reach = (1.0 - float(shadows.SHORT_OF_LIGHT)) * distance
        ways["embree"] = lambda: traced.run(origins, to, dists=reach.astype(np.float32), query="OCCLUDED")
    for name, send in ways.items():
        spent = []
        for _ in range(arguments.rounds + 1):
            start = time.process_time()
            send()
            spent.append(time.process_time() - start)
        of = len(origins) if name == "embree" else rays
        print(f"  rays alone, {name}: {of} rays, {of / np.median(spent[1:]) / 1.0e6:.1f} M/s")


if __name__ == "__main__":
    main()
