"""Local environment maps blended from reference maps against drawing the scene into each mirror's map: time, error, memory.

    python tools/bench_environment.py usd_scenes/city_block.usda --mirrors 3

For some moving mirrors of a stage at some times, contenders in turn in one process with the same number of threads and the
same resolution: the local map from the nearest two reference maps (rays, blending, what no map sees shaded, what moves drawn
in; alone, and a map's share where all mirrors' are made at once, as a frame does), and the six faces drawn, shadows included in
all. *Faster* is the drawn over the latter. Beside the time, of the texels that are blended: the angle by which
what they show is off, as seen from the map's eye, median and 95 %, and the share of what is shown that lies nearer or farther;
shares of texels that are sky in one of map and truth alone, and that are shaded where they are; the colour difference as FLIP
has it over the six faces; the memory of the stage's maps and of 54 maps of 128 texels. Times are of this process on the
processor, not of the wall.
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
from warp_reflect.techniques import layered_environment, local_map, local_mesh, local_shading, reference_maps
from warp_reflect.techniques.environment import centre_of, left_out

DEPTH_APART = 0.05  # of a distance: what is shown and lies farther off than this is another thing
PALETTE_BYTES = 1024 * 8


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--mirrors", type=int, default=4)
    parser.add_argument("--time", type=float, action="append", help="time code; may be repeated")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="a setting; may be repeated")
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
        bounces=1,
    ).replace(**dict(each.split("=", 1) for each in arguments.set))
    rows, scene = [], None
    for when in arguments.time or [12.0, 30.0]:
        before = scene
        scene = wr.load_stage(arguments.stage, time=when) if scene is None else scene.at(when)
        if before is not None:
            reference_maps.take_over(before, scene)
        references = reference_maps.reference_maps(scene, settings)
        chosen = mirrors(scene, arguments)
        for part in chosen:
            rows.append(measure(scene, part, references, settings, arguments.rounds, when))
            rows[-1]["together_ms"] = together(scene, chosen, settings, arguments.rounds)
    summary = {
        "speedup": statistics.median(row["drawn_ms"] / row["together_ms"] for row in rows),
        "together_ms": statistics.median(row["together_ms"] for row in rows),
        "local_ms": statistics.median(row["local_ms"] for row in rows),
        "drawn_ms": statistics.median(row["drawn_ms"] for row in rows),
        "angle_deg": statistics.median(row["angle_deg"] for row in rows),
        "angle_95_deg": statistics.median(row["angle_95_deg"] for row in rows),
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
        "| mirror | time | alone ms | of all ms | drawn ms | faster | angle, median | 95 % | another depth | sky "
        "| shaded | FLIP |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|")
    for row in rows:
        print(
            f"| {row['mirror']} | {row['time']:g} | {row['local_ms']:.1f} | {row['together_ms']:.1f} | {row['drawn_ms']:.0f} | "
            f"{row['drawn_ms'] / row['together_ms']:.1f}x | {row['angle_deg']:.3f} deg | {row['angle_95_deg']:.2f} deg | "
            f"{100 * row['other']:.1f} % | {100 * row['sky']:.2f} % | {100 * row['shaded']:.0f} % | {row['flip']:.3f} |"
        )
    print(", ".join(f"{name} {value:.4g}" for name, value in summary.items()))


def mirrors(scene: wr.Scene, arguments) -> list[int]:
    """Moving mirrors, as many as asked for."""
    found = [k for k in scene.moving_parts if scene.data.materials[scene.parts[k].material].metallic > 0.5]
    return found[: arguments.mirrors]


def together(scene, parts: list[int], settings, rounds: int) -> float:
    """Milliseconds a map where those of all mirrors are made at once, as a frame does; the first turn is not counted."""
    spent = []
    for _ in range(rounds + 1):
        start = time.process_time()
        layered_environment.prepare_together(scene, [(_Reflector(part), settings) for part in parts])
        spent.append(time.process_time() - start)
        forget(scene)
    return 1e3 * statistics.median(spent[1:]) / len(parts)


def measure(scene, part: int, references, settings, rounds: int, when: float) -> dict:
    """One mirror's row; the first of each contender's turns is not counted."""
    centre = centre_of(scene, part)
    shadows = asked_shadows(scene, settings)
    without = [left_out(scene, part, settings)]
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
    off = angles(scene, made, references, settings)
    degrees = off.pop("degrees")
    return off | {
        "mirror": scene.parts[part].prim_path,
        "time": when,
        "local_ms": 1e3 * statistics.median(local[1:]),
        "drawn_ms": 1e3 * statistics.median(drawn[1:]),
        "angle_deg": float(np.median(degrees)) if len(degrees) else 0.0,
        "angle_95_deg": float(np.quantile(degrees, 0.95)) if len(degrees) else 0.0,
        "difference": float(np.abs(shown(made.local) - shown(whole)).mean()),
        "flip": flip(shown(made.local), shown(whole)),
        "unseen": made.statistics["rem_missing"] / max(made.statistics["rem_texels"], 1),
        "rays": made.statistics.get("local_rays", 0),
        "timings": made.timings,
    }


class _Reflector:
    """What `prepare` asks of a reflector."""

    def __init__(self, part: int):
        self.part = part


def forget(scene) -> None:
    """Drop the local maps that a scene keeps, so that the next one is built."""
    kept = layered_environment.KEY, layered_environment.SHOWN_KEY
    for key in [key for key in scene.environments if key[0] in kept]:
        del scene.environments[key]


def angles(scene, made, references, settings) -> dict[str, np.ndarray | float]:
    """By how much what a local map shows is off, as its eye sees it, of texels that are blended.

    A texel's ray meets the triangles at its own point. What it shows is what each reference map has in the direction that the
    texel looks it up in, weighted: the angle at the eye between that and the ray; the sky is infinitely far.

    Returns:
        `degrees`: of texels that show a surface and whose ray meets one; `shaded`, `sky`: shares of the texels that are shaded
        where they are, and of all others that are sky in one of map and truth alone; `other`: of those in `degrees`, which show
        what is nearer or farther than their point by more than `DEPTH_APART`.
    """
    n, state = made.local.resolution, made.state.numpy()
    directions = texel_directions(n).reshape(-1, 3)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    intersect = layered_environment.intersect_still(scene, made.part, made.centre, settings.threads)
    true = intersect(directions.astype(np.float32))[0].astype(np.float64)
    points = made.centre + made.local.distance(0).reshape(-1, 1).astype(np.float64) * directions
    rems = layered_environment.nearest_maps(references, made.centre, settings.rem_count)
    share = weights(scene, made, references.maps, rems, settings)
    angle, other = np.zeros(len(points)), np.zeros(len(points))
    for k, own in zip(rems, share, strict=True):
        ray = points - references.maps.centres[k]
        far = distances(references.maps, int(k))[texel_of(ray, n)]
        length = np.maximum(np.linalg.norm(ray, axis=1), 1e-30)[:, None]
        shown = np.where(
            far[:, None] > 0.0, references.maps.centres[k] + far[:, None] * ray / length - made.centre, ray
        )
        sine = np.linalg.norm(np.cross(shown, directions), axis=1)
        along = np.einsum("ij,ij->i", shown, directions)
        angle += own * np.degrees(np.arctan2(sine, along))
        other += own * ((far == 0.0) | (np.abs(np.hypot(sine, along) - true) > DEPTH_APART * true))
    blended = np.isin(state, (local_shading.TEXEL_BLENDED, local_shading.TEXEL_MISSING))
    still = state != local_shading.TEXEL_SHADED
    judged = blended & (true > 0.0)
    return {
        "degrees": angle[judged],
        "shaded": 1.0 - float(still.mean()),
        "sky": float(((state == local_shading.TEXEL_SKY) != (true == 0.0))[still].mean()),
        "other": float(other[judged].mean()) if judged.any() else 0.0,
    }


def weights(scene, made, maps, rems, settings) -> np.ndarray:
    """What each of some reference maps has of each texel, float [rems, texels]: maps of one and of nothing are blended."""
    n, found = made.local.resolution, []
    lengths = np.linalg.norm(texel_directions(n).reshape(-1, 3), axis=1)
    inverse = lengths / np.maximum(made.local.distance(0).reshape(-1), 1e-30)
    inverse[made.state.numpy() == local_shading.TEXEL_SKY] = 0.0
    shape = (6, n, n)
    mesh = local_mesh.DepthMesh(inverse.astype(np.float32).reshape(shape), made.local.triangle(0), np.ones(shape, bool))
    distance = np.array([distances(maps, int(k)).reshape(6, maps.resolution, -1) for k in rems])
    for k in range(len(rems)):
        radiance = np.zeros((*distance.shape, 4), np.float32)
        radiance[..., 3], radiance[k, ..., 0] = 1.0, 1.0
        coded = environment_maps.stored_maps(scene, maps.centres[rems], maps.axes[rems], radiance, distance)
        numbers, kept = np.arange(len(rems)), settings.replace(rem_missing="best")
        blended, _, _ = local_map.blend_local_map(scene, made.centre, mesh, None, coded, numbers, kept, made.slack)
        found.append(blended.radiance(0)[..., 0].reshape(-1))
    return np.array(found)


def distances(maps, k: int) -> np.ndarray:
    """Of the texels of a map, 0 sky, float64."""
    return maps.distance(k).reshape(-1).astype(np.float64)


def texel_of(rays: np.ndarray, n: int) -> np.ndarray:
    """Flat index of the texel that each ray falls into; of no direction: some texel."""
    rays = np.where((rays == 0.0).all(axis=1, keepdims=True), [1.0, 0.0, 0.0], rays)
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
