"""Local environment maps blended from reference maps against drawing the scene into each mirror's map: time, error, memory.

    python tools/bench_environment.py usd_scenes/city_block.usda --mirrors 3

For some moving mirrors of a stage at some times, contenders in turn in one process with the same number of threads and the
same resolution: the local map from the nearest two reference maps (rays, blending, what no map sees shaded, what moves drawn
in), and the six faces drawn, shadows included in both. Beside the time: the median angle by which what a texel shows is off,
as seen from the map's eye, the colour difference as flip has it over the six faces, the share of texels that no map sees, and
the memory of the stage's maps and of 54 maps of 128 texels. Times are of this process on the processor, not of the wall.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np

import warp_reflect as wr
from warp_reflect import environment_maps
from warp_reflect.cubemap import RADIANCE_AXES, texel_directions
from warp_reflect.devices import open_device
from warp_reflect.shadows import asked_shadows
from warp_reflect.techniques import layered_environment, local_map, reference_maps
from warp_reflect.techniques.environment import centre_of

SEEN_SLACK = 0.02  # of a distance: what a map has so little before a point is the point
PALETTE_BYTES = 1024 * 8


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--mirrors", type=int, default=4)
    parser.add_argument("--time", type=float, action="append", help="time code; may be repeated")
    parser.add_argument(
        "--blur", type=float, default=wr.Settings.rem_blur_px, help="rem_blur_px: what maps hold too coarsely is shaded"
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    open_device("cpu")  # quietly
    settings = wr.Settings(
        environment_resolution=arguments.resolution,
        threads=arguments.threads,
        rem_texels="full",
        rem_blur_px=arguments.blur,
        bounces=1,
    )
    rows, scene = [], None
    for when in arguments.time or [12.0, 30.0]:
        before = scene
        scene = wr.load_stage(arguments.stage, time=when) if scene is None else scene.at(when)
        if before is not None:
            reference_maps.take_over(before, scene)
        references = reference_maps.reference_maps(scene, settings)
        rows += [
            measure(scene, part, references, settings, arguments.rounds, when) for part in mirrors(scene, arguments)
        ]
    summary = {
        "speedup": statistics.median(row["drawn_ms"] / row["local_ms"] for row in rows),
        "local_ms": statistics.median(row["local_ms"] for row in rows),
        "drawn_ms": statistics.median(row["drawn_ms"] for row in rows),
        "angle_deg": statistics.median(row["angle_deg"] for row in rows),
        "flip": statistics.median(row["flip"] for row in rows),
        "maps": references.maps.count,
        "packed_MB": environment_maps.pack_maps(references.maps).bytes / 1e6,
        "full_MB": references.maps.bytes / 1e6,
        "MB_of_54_at_128": 54 * (6 * 128 * 128 * 4 + PALETTE_BYTES) / 1e6,
        "triangles": scene.triangle_count,
        "resolution": arguments.resolution,
        "threads": arguments.threads,
    }
    if arguments.json:
        for row in [*rows, summary]:
            print(json.dumps(row))
        return
    print(
        f"{'mirror':28} {'time':>5} {'local':>8} {'drawn':>8} {'ratio':>6} {'angle':>7} {'flip':>6} {'unseen':>7} {'rays':>6}"
    )
    for row in rows:
        print(
            f"{row['mirror'][-28:]:28} {row['time']:5g} {row['local_ms']:6.1f}ms {row['drawn_ms']:6.0f}ms "
            f"{row['drawn_ms'] / row['local_ms']:6.1f} {row['angle_deg']:6.3f}° {row['flip']:6.3f} "
            f"{100 * row['unseen']:6.2f}% {row['rays']:6}"
        )
    print(", ".join(f"{name} {value:.4g}" for name, value in summary.items()))


def mirrors(scene: wr.Scene, arguments) -> list[int]:
    """Moving mirrors, as many as asked for."""
    found = [k for k in scene.moving_parts if scene.data.materials[scene.parts[k].material].metallic > 0.5]
    return found[: arguments.mirrors]


def measure(scene, part: int, references, settings, rounds: int, when: float) -> dict:
    """One mirror's row; the first of each contender's turns is not counted."""
    centre = centre_of(scene, part)
    shadows = asked_shadows(scene, settings)
    without = [(part,)]
    local, drawn = [], []
    for turn in range(rounds + 1):
        start = time.process_time()
        made = layered_environment.prepare(scene, _Reflector(part), settings)
        local.append(time.process_time() - start)
        forget(scene)
        if turn == 0 or turn <= min(rounds, 2):
            start = time.process_time()
            whole = environment_maps.render_maps(
                scene,
                centre[None],
                settings.environment_resolution,
                without=without,
                shadows=shadows,
                threads=settings.threads,
            )
            drawn.append(time.process_time() - start)
    return {
        "mirror": scene.parts[part].prim_path,
        "time": when,
        "local_ms": 1e3 * statistics.median(local[1:]),
        "drawn_ms": 1e3 * statistics.median(drawn[1:]),
        "angle_deg": float(np.median(angles(scene, made, references.maps, settings))),
        "difference": float(np.abs(shown(made.local) - shown(whole)).mean()),
        "flip": flip(shown(made.local), shown(whole)),
        "unseen": made.statistics["rem_missing"] / max(made.statistics["rem_texels"], 1),
        "rays": made.statistics["local_rays"],
        "timings": made.timings,
    }


class _Reflector:
    """What `prepare` asks of a reflector."""

    def __init__(self, part: int):
        self.part = part


def forget(scene) -> None:
    """Drop the local maps that a scene keeps, so that the next one is built."""
    for key in [key for key in scene.environments if key[0] == layered_environment.KEY]:
        del scene.environments[key]


def angles(scene, made, maps, settings) -> np.ndarray:
    """Degrees by which what each texel shows is off: what the map nearest to the mirror that sees the point has there."""
    n = made.local.resolution
    directions = texel_directions(n).reshape(-1, 3)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    distance = made.local.distance(0).reshape(-1).astype(np.float64)
    points = made.centre + distance[:, None] * directions
    best, known = np.zeros(len(points)), np.zeros(len(points), bool)
    for k in layered_environment.nearest_maps(made.references, made.centre, settings.rem_count):
        ray = points - maps.centres[k]
        far = maps.distance(int(k)).reshape(-1)[texel_of(ray, n)].astype(np.float64)
        length = np.linalg.norm(ray, axis=1)
        shown = maps.centres[k] + far[:, None] * ray / np.maximum(length, 1e-30)[:, None] - made.centre
        sine = np.linalg.norm(np.cross(shown, directions), axis=1)
        angle = np.degrees(np.arctan2(sine, np.einsum("ij,ij->i", shown, directions)))
        sees = (far > 0.0) & (far >= (1.0 - SEEN_SLACK) * length) & ~known
        best[sees], known[sees] = angle[sees], True
    state = made.state.numpy()
    best[state == local_map.TEXEL_SHADED] = 0.0  # where they are
    return best[(state == local_map.TEXEL_SHADED) | (state == local_map.TEXEL_BLENDED) & known]


def texel_of(rays: np.ndarray, n: int) -> np.ndarray:
    """Flat index of the texel that each ray falls into."""
    on_face = np.einsum("fij,nj->nfi", RADIANCE_AXES, rays)
    face = on_face[..., 2].argmax(axis=1)
    right, up, forward = on_face[np.arange(len(rays)), face].T
    column, row = ((0.5 * (1 + x / forward) * n).astype(int).clip(0, n - 1) for x in (right, -up))
    return (face * n + row) * n + column


def shown(maps) -> np.ndarray:
    """A map's faces one below the other in sRGB, sky as the domes have it."""
    value = maps.radiance(0)
    picture = value[..., :3] + (1.0 - value[..., 3:]) * 0.7
    linear = np.clip(picture.reshape(-1, maps.resolution, 3), 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)


def flip(test: np.ndarray, reference: np.ndarray) -> float:
    """Mean FLIP; NaN where flip-evaluator is not installed."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return float("nan")
    return float(evaluate(reference, test, "LDR", applyMagma=False, inputsRGB=True)[1])


if __name__ == "__main__":
    main()
