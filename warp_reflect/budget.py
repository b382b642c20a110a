"""What a technique is predicted to cost and to err, from what its steps were measured to cost on a machine.

The error model: what is refined is exact but for few pixels; of an unrefined picture the straight virtual edges, the texels
of the map, the steps of the search and the cells of the grid each err by a known law (sources at the constants), and the
picture by their sum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from warp_reflect.settings import Settings


@dataclass(frozen=True)
class Costs:
    """Microseconds per element on one CPU thread; those here were measured on a server core of 2026.

    `calibration.measure` finds them for another machine. Ratios between them decide, and those vary less.
    """

    trace: float = 0.5
    """A ray for itself through a BVH of `TRACE_BASE` triangles; grows with their logarithm. Of a mirror's own: see `packed`."""
    mirrored: float = 0.06
    """A vertex mirrored in a plane."""
    quadric_cold: float = 0.08
    """A vertex solved on a quadric, from nothing, boxes and the rest of a search's step included."""
    quadric_warm: float = 0.075
    """The same from the last frame's answer."""
    map_cold: float = 0.09
    """A vertex solved in a map, from nothing."""
    map_warm: float = 0.09
    """The same from the last frame's answer."""
    branches: float = 5.3
    """A vertex whose every reflection point on a concave side is searched."""
    bent: float = 0.2
    """A vertex of the scene on a frame that cuts anew: its edges are looked at, whether they bend, its triangles listed anew."""
    cut: float = 0.11
    """A virtual vertex added where they do."""
    draw: float = 0.023
    """A virtual triangle, the clipping at the hidden boundary included."""
    covered: float = 0.026
    """A mirror pixel that virtual triangles are drawn into, those included that others hide."""
    interpolated: float = 0.2
    """A vertex interpolated from a grid."""
    candidate: float = 0.053
    """A mirror pixel that shows its candidate, unrefined."""
    refined: float = 0.055
    """A mirror pixel whose candidate is tested."""
    own_body: float = 0.32
    """A pixel of a mirror that may see itself."""
    looked_up: float = 0.063
    """A mirror pixel that is looked up in a map of its environment: one bilinear look-up in a cube."""
    map_texel: float = 0.073
    """A texel of an environment map that is drawn: its ray, its shading."""
    map_triangle: float = 0.019
    """A triangle of the scene, for every face of such a map."""
    blended: float = 0.13
    """A texel of a local map and one of its reference maps: the depth test, the look-up."""
    followed: float = 0.8
    """A mirror pixel that is followed to what a local map holds, and looked up there."""
    eye_triangle: float = 0.03
    """A triangle in the eye's own view."""
    eye_pixel: float = 0.012
    """A pixel of the picture: drawn, its mirror found, shaded."""
    mirror_pixel: float = 0.065
    """A mirror pixel: its point and normal, and the shading of what it shows."""
    gathered: float = 0.83
    """A ray of a rough mirror's lobe, beyond following it and its shadows: drawn, shaded, shared with neighbours."""
    through: float = 0.061
    """A ray behind a transparent surface, beyond its shadows: bent, followed, shaded, added."""
    shadow: float = 0.095
    """A ray towards a light through `TRACE_BASE` triangles, that only asks whether anything is in the way, the rest of
    shadowing included."""
    layer: float = 240.0
    """A reflector: what does not depend on counts."""
    forward: float = 3800.0
    """The same of one that is reflected forward, which takes some more steps: 2 to 6 ms in this package's scenes."""
    sharing: float = 0.83
    """Of a further thread, how much it adds to the first."""


BUILT_IN = Costs()
# Likewise of a CUDA device, all of its threads together: an NVIDIA H100. What the host does one launch after the other is
# `layer`; what it still does for every vertex of a mesh that is made or cut anew makes those dear.
ON_CUDA = Costs(
    trace=0.0021,
    mirrored=0.05,
    quadric_cold=0.073,
    quadric_warm=0.002,
    map_cold=0.084,
    map_warm=0.002,
    branches=1.2,
    bent=0.15,
    cut=0.2,
    draw=0.0025,
    covered=0.0002,
    interpolated=0.089,
    candidate=0.00013,
    refined=0.00053,
    own_body=0.041,
    looked_up=0.0001,
    map_texel=0.0067,
    map_triangle=0.0012,
    blended=0.0005,
    followed=0.00015,
    eye_triangle=0.0006,
    eye_pixel=0.0001,
    mirror_pixel=0.0009,
    gathered=0.0007,
    through=0.0009,
    shadow=0.00014,
    layer=364.0,
    forward=1456.0,
)
TRACE_BASE = 65536  # triangles at which `Costs.trace` is told
# A mirror's own rays go through the tree side by side, the cheaper the more of them meet the same triangles: at least this
# share of `Costs.trace`, and more by the root of triangles per mirror pixel. Measured (`tools/bench_crossing.py`) over 10^4 to
# 10^6 triangles by 10^3 to 10^6 pixels of a mirror; beyond the last factor packets of rays that have nothing in common go
# through a tree that no cache holds.
PACKED_LEAST, PACKED_ROOT, PACKED_MOST = 0.05, 0.135, 2.8
# Rays of a pixel of a rough mirror that are followed, by `effects.glossy_way`: `SAMPLES` of `finishes.glossy_gather` and of
# `glossy_rays`, whose import would build Warp's modules before they are asked for.
GLOSSY_RAYS = {"gather": 6, "accumulate": 256, "filter": 0, "prefiltered": 0, "off": 0}
LOOKS = 16  # look-ups of what follows no ray that cost as much as a gathered ray's
BOUNCE_LAYERS = 3.0  # of `Costs.layer`: a mirror that shows mirrors, beyond its rays; measured: 2.2 to 3 ms a mirror
# Of a hollow mirror the middles of cut edges and what is added are searched branch by branch.
BRANCH_ADDED = 2.0
COLD_SHARE = 0.1  # of frames that start from nothing: of those of a walk few do, a single picture does
# Pixels that refinement leaves to the BVH: silhouettes, so many for the root of a mirror's own. Measured: 11 to 36.
DOUBT_ROOT = 21.0
DOUBT_UNCUT = 0.3  # share of the mirror pixels where edges are not cut
# Triangles are cut where their edges' pictures bend: into pieces along an edge whose number grows with the bend over the one
# allowed (`Work.bends`), less so than a triangle's own does, for what is measured bends less than what is estimated. Fitted to
# 24 mirrors of this package's scenes at 320 and 960 pixels: most counts come out within a factor of 1.4, all within 2.5.
CUT_SHARE, CUT_POWER, CUT_MOST = 0.55, 0.7, 32  # `virtual_mesh.CUT_MAX`
BEND_LEAST, BENDS, BENDS_PER_OCTAVE = 0.25, 24, 2  # the first of the counts of `Work.bends`, and how many there are
CUT_ADDED_MIN, CUT_ADDED_SHARE = 20000, 2.0  # `virtual_mesh.BUDGET_MIN`, BUDGET_SHARE
GRID_NODES = 0.06  # solved per vertex at `GRID_BASE`, by the third power of the cell's edge
GRID_BASE = 0.5  # pixels
GRID_NODES_MAX = 0.15  # `grid.NODES_MAX`
GRID_MIN = 0.02
REUSED_SHARE = 0.5  # of the vertices kept from frame to frame, at half a pixel and a slow walk
# Position and normal; radiance and coverage, distance, triangle.
TEXEL_BYTES = {"reflector_map": 32, "environment": 24, "layered_environment": 24}
LOCAL_RAYS = 0.15  # share of a local map's texels that have a ray of their own

# Errors, at the 95th percentile of the mirror pixels. Measured on this package's scenes where no other source is given.
EDGE_ERROR = 0.5  # of the bend that `edge_px` allows: few edges use it up
EDGE_FLOOR = 0.1  # pixels; corners of virtual triangles are right, what lies between is interpolated
UNCUT_ERROR = 2.8  # pixels: the papers' picture, straight edges between exact vertices
# Shares of the mirror pixels that show another thing: silhouettes that lie elsewhere, holes beside triangles cut
# differently; by `refine`. Those of an uncut mesh are so many that the percentile is no measure of it any more.
WRONG_SHARE = {"exact": 2.0e-4, "strict": 7.0e-5, "off": 0.0}
WRONG_UNCUT = {"exact": 3.0e-3, "strict": 1.0e-3, "off": 0.15}
# Unrefined, added: so many pixels to the half extent of a mirror, and more for every pixel of `edge_px`. Silhouettes grow with
# the extent, the picture with its square. The kitchen's; of the scenes measured none has more.
WRONG_BORDER, WRONG_COARSE = 3.6, 2.0
# A wrong pixel counts as so many pixels of error where plans are compared.
WRONG_PX = 30.0
# Error of a reflection point over the mirror's half extent, 95 %: bilinear maps err by 0.2 h^2, h the texel.
MAP_ERROR = 0.2
# Likewise, after so many steps of a search from nothing (a body of 2:1:1, maps of 256 nodes; Newton counts evaluations).
NEWTON_ERROR = {1: 1.0e-1, 2: 2.0e-2, 3: 1.2e-3, 4: 1.0e-4, 5: 1.0e-5}
MIDPOINT_ERROR = {3: 7.0e-2, 5: 2.1e-2, 7: 7.7e-3, 9: 3.3e-3, 14: 5.0e-4}
DIRECTION_PX = 0.25  # `grid.DIRECTION_PX`: cells of a grid of directions are never judged by more
GRID_SHARE_PX = (
    2.0  # error of a grid of a share of 4 %; falls with the share (Estalella et al. 2005, figure 7, as reproduced)
)


@dataclass(frozen=True)
class Work:
    """What a frame asks of one reflector by one technique, in counts.

    Attributes:
        pixels: At which it is seen.
        vertices: Of the scene, without the mirror's own.
        triangles: Likewise.
        scene_triangles: All of them.
        passes: How often every vertex is reflected: once for every sheet of a mirror.
        held: Share of the mirror that the technique holds; the rest is traced, and the mirror may see itself.
        branches: It is seen from within, and every vertex may appear several times.
        size_px: Half extent of the mirror's picture. [pixels]
        bends: Triangles by the pieces that their edges' pictures want at one pixel of bend: from BEND_LEAST on, BENDS_PER_OCTAVE
            counts for every doubling.
        parallax_px: By how much a map of its environment errs. [pixels]
    """

    pixels: int
    vertices: int = 0
    triangles: int = 0
    scene_triangles: int = 2
    passes: int = 1
    held: float = 1.0
    branches: bool = False
    size_px: float = 0.0
    parallax_px: float = 0.0
    bends: tuple[float, ...] = ()


def predict(work: Work, technique: str, settings: Settings, costs: Costs = BUILT_IN, threads: int = 1) -> dict:
    """Predicted cost and error of a reflector.

    Args:
        work: What is asked.
        technique: A key of `TECHNIQUES`.
        settings: The knobs.
        costs: Of the machine.
        threads: CPU threads.

    Returns:
        `ms` of a frame among others, `first_ms` of one that starts from nothing (without preparation), `error_px`: what 95 %
        of the mirror pixels stay below, `wrong_share`: of the pixels that show another thing, and prepared `bytes`.
    """
    if work.pixels == 0:
        return {"error_px": 0.0, "wrong_share": 0.0, "ms": 0.0, "first_ms": 0.0, "bytes": 0}
    warm, cold = _microseconds(work, technique, settings, costs)
    error, wrong = _error(work, technique, settings)
    speed = speedup(costs, threads)
    return {
        "error_px": error,
        "wrong_share": wrong,
        "ms": 1e-3 * ((1.0 - COLD_SHARE) * warm + COLD_SHARE * cold) / speed,
        "first_ms": 1e-3 * cold / speed,
        "bytes": work.passes * _texels(technique, settings) * TEXEL_BYTES.get(technique, 0),
    }


def fixed_ms(triangles: int, pixels: int, mirror_pixels: int, costs: Costs = BUILT_IN, threads: int = 1) -> float:
    """Predicted milliseconds of what no choice changes: the eye's view and the shading.

    Args:
        triangles: Of the scene.
        pixels: Of the picture.
        mirror_pixels: Of them, those that show a mirror.
        costs: Of the machine.
        threads: CPU threads.
    """
    spent = triangles * costs.eye_triangle + pixels * costs.eye_pixel + mirror_pixels * costs.mirror_pixel
    return 1e-3 * spent / speedup(costs, threads)


def lobe_ms(
    pixels: int,
    rays: int,
    triangles: int,
    shadow_ms: float,
    settings: Settings,
    costs: Costs = BUILT_IN,
    threads: int = 1,
) -> float:
    """Predicted milliseconds of the rays of a rough mirror's lobe, or of a turned one's.

    Args:
        pixels: At which it is seen.
        rays: Of each; 0: it is looked up.
        triangles: Of the scene.
        shadow_ms: Of the shadows of one point, on these threads.
        settings: `glossy_samples`.
        costs, threads: See `predict`.
    """
    if not rays:
        looks = (settings.glossy_samples or LOOKS) / LOOKS
        return 1e-3 * pixels * looks * costs.gathered / speedup(costs, threads)
    return pixels * rays * (1e-3 * (ray_us(triangles, costs) + costs.gathered) / speedup(costs, threads) + shadow_ms)


def through_ms(rays: int, shadow_ms: float, costs: Costs = BUILT_IN, threads: int = 1) -> float:
    """Predicted milliseconds of so many rays behind transparent surfaces; `shadow_ms` as for `lobe_ms`."""
    return rays * (1e-3 * costs.through / speedup(costs, threads) + shadow_ms)


def scattered_ms(rays: int, shadow_rays: float, triangles: int, costs: Costs = BUILT_IN, threads: int = 1) -> float:
    """Predicted milliseconds of rays whose neighbours go elsewhere, and of what they meet: nothing is shared there.

    Args:
        rays: Of mirrors seen in mirrors, or of a frosted surface's cone.
        shadow_rays: From each point that they meet.
        triangles: Of the scene.
        costs, threads: See `predict`.
    """
    if rays <= 0:
        return 0.0
    ray = costs.trace * packed(triangles, rays)
    return 1e-3 * rays * (ray * (1.0 + shadow_rays) + costs.mirror_pixel) / speedup(costs, threads)


def bounce_ms(rays: int, shadow_rays: float, triangles: int, costs: Costs = BUILT_IN, threads: int = 1) -> float:
    """Predicted milliseconds of following what a mirror shows of mirrors; arguments as for `scattered_ms`."""
    fixed = 1e-3 * BOUNCE_LAYERS * costs.layer / speedup(costs, threads)
    return fixed + scattered_ms(rays, shadow_rays, triangles, costs, threads)


def ray_us(triangles: int, costs: Costs = BUILT_IN) -> float:
    """Microseconds of a ray through a BVH of so many triangles, on one thread."""
    return costs.trace * math.log2(max(triangles, 2)) / math.log2(TRACE_BASE)


def packed(triangles: int, pixels: int) -> float:
    """What a mirror's own ray costs with vector kernels, over `Costs.trace`.

    Args:
        triangles: Of the scene.
        pixels: Of the mirror.
    """
    return min(PACKED_LEAST + PACKED_ROOT * math.sqrt(triangles / pixels), PACKED_MOST)


def shadow_ray_ms(triangles: int, costs: Costs = BUILT_IN, threads: int = 1) -> float:
    """Milliseconds of a ray towards a light in a scene of so many triangles."""
    deep = math.log2(max(triangles, 2)) / math.log2(TRACE_BASE)
    return 1e-3 * costs.shadow * deep / speedup(costs, threads)


def speedup(costs: Costs, threads: int) -> float:
    """How much faster several threads are than one."""
    return 1.0 + costs.sharing * (threads - 1)


def loss(predicted: dict) -> float:
    """One number to compare plans by: the error in pixels, wrong pixels included."""
    return predicted["error_px"] + WRONG_PX * predicted["wrong_share"]


def map_blur_px(pixels: int, resolution: int) -> float:
    """By how much the texels of an environment map blur what a curved mirror shows: half a texel, in pixels.

    A closed convex mirror shows every direction, 4 pi, over its pixels.
    """
    return 0.5 * (0.5 * math.pi / resolution) / math.sqrt(4.0 * math.pi / max(pixels, 1))


def _texels(technique: str, settings: Settings) -> int:
    resolution = {"reflector_map": settings.map_resolution}
    resolution |= {"environment": settings.environment_resolution, "layered_environment": settings.local_edge}
    return 6 * resolution.get(technique, 0) ** 2


def _microseconds(work: Work, technique: str, settings: Settings, costs: Costs) -> tuple[float, float]:
    """(of a frame that follows another, of one that starts from nothing) on one thread."""
    ray = ray_us(work.scene_triangles, costs)
    if technique == "raytraced":
        if settings.kernels != "plain":
            ray = costs.trace * packed(work.scene_triangles, work.pixels)
        return (costs.layer + work.pixels * ray,) * 2
    if technique == "environment":
        drawn = _texels(technique, settings) * costs.map_texel + 6 * work.scene_triangles * costs.map_triangle
        drawn = 0.0 if settings.environment_update == "static" else drawn
        return (costs.layer + work.pixels * costs.looked_up + drawn,) * 2
    if technique == "layered_environment":
        local = _texels(technique, settings) * (settings.rem_count * costs.blended + LOCAL_RAYS * ray)
        shown = costs.layer + work.pixels * costs.followed
        return shown, shown + local
    added = 0.0 if technique == "planar" else _added(work, settings)
    cold, warm = _search(work.vertices, added, technique, settings, costs)
    every = costs.forward + (work.triangles + added) * costs.draw + work.pixels * costs.covered
    every += work.pixels * costs.candidate if settings.refine == "off" else _refined(work.pixels, settings, ray, costs)
    cut = work.vertices * costs.bent + added * costs.cut if added else 0.0
    warm = work.passes * (every + warm)
    cold = work.passes * (every + cold + cut)
    rest = 0.0
    if work.held < 1.0 or work.passes > 1:
        rest += work.pixels * ((1.0 - work.held) * ray + costs.own_body)
    if work.branches:
        rest += (work.vertices + BRANCH_ADDED * added) * costs.branches + work.pixels * costs.own_body
    return warm + rest, cold + rest


def _added(work: Work, settings: Settings) -> float:
    """Virtual vertices and triangles added to the scene's, where a curved mirror bends edges."""
    if settings.edge_px == 0.0:
        return 0.0
    added = 0.0
    for k, triangles in enumerate(work.bends):
        wanted = BEND_LEAST * 2.0 ** ((k + 0.5) / BENDS_PER_OCTAVE) / math.sqrt(settings.edge_px)
        octaves = math.ceil(CUT_POWER * math.log2(CUT_SHARE * wanted))
        if octaves > 0:
            pieces = min(2**octaves, CUT_MOST)
            added += triangles * 0.5 * (pieces + 1) * (pieces + 2)
    return min(added, CUT_ADDED_MIN + CUT_ADDED_SHARE * work.triangles)


def _search(vertices: int, added: float, technique: str, settings: Settings, costs: Costs) -> tuple[float, float]:
    """(from nothing, for the scene's vertices; from the last frame, for the added ones too, which no grid holds)."""
    if technique == "planar":
        return (vertices * costs.mirrored,) * 2
    cold, warm = (costs.quadric_cold, costs.quadric_warm)
    if technique != "quadric":
        cold, warm = costs.map_cold, costs.map_warm
    gridded = warm
    if technique == "reflector_map" and (settings.grid_error_px > 0.0 or settings.grid_share > 0.0):
        nodes = settings.grid_share
        if settings.grid_error_px > 0.0:
            nodes = GRID_NODES * (GRID_BASE / settings.grid_error_px) ** (2.0 / 3.0)
        nodes = min(max(nodes, GRID_MIN), max(GRID_NODES_MAX, settings.grid_share))
        cold, gridded = nodes * cold + costs.interpolated, nodes * warm + costs.interpolated
    kept = REUSED_SHARE if settings.reuse_px > 0.0 and technique in ("quadric", "reflector_map") else 0.0
    return vertices * cold, (1.0 - kept) * (vertices * gridded + added * warm)


def _refined(pixels: int, settings: Settings, ray: float, costs: Costs) -> float:
    doubt = min(DOUBT_ROOT * math.sqrt(pixels), pixels) if settings.edge_px > 0.0 else DOUBT_UNCUT * pixels
    return pixels * costs.refined * (1.25 if settings.refine == "strict" else 1.0) + doubt * ray


def _error(work: Work, technique: str, settings: Settings) -> tuple[float, float]:
    """(95th percentile in pixels, share of wrong pixels)."""
    if technique == "raytraced":
        return 0.0, 0.0
    if technique == "layered_environment":
        return map_blur_px(work.pixels, settings.local_edge), 0.0
    if technique == "environment":
        return work.parallax_px + map_blur_px(work.pixels, settings.environment_resolution), 0.0
    curved = technique != "planar"
    uncut = curved and settings.edge_px == 0.0
    wrong = (WRONG_UNCUT if uncut else WRONG_SHARE)[settings.refine]
    if settings.refine != "off":
        return 0.0, wrong
    error = UNCUT_ERROR if uncut else EDGE_FLOOR + (EDGE_ERROR * settings.edge_px if curved else 0.0)
    wrong += (WRONG_BORDER + (WRONG_COARSE * settings.edge_px if curved else 0.0)) / max(work.size_px, WRONG_BORDER)
    wrong = min(wrong, 1.0)
    if technique in ("reflector_map", "explosion_map"):
        texel = 2.0 / (settings.map_resolution - 1)
        error += work.size_px * MAP_ERROR * texel * texel
    if technique == "reflector_map":
        error += work.size_px * _search_error(settings) + _grid_error(settings)
    if technique in ("reflector_map", "quadric"):
        error += settings.reuse_px
    return error, wrong


def _search_error(settings: Settings) -> float:
    """Of a reflection point over the mirror's half extent, 95 %."""
    if settings.search == "newton":
        return 0.0 if settings.iterations == 0 else _between(NEWTON_ERROR, settings.iterations)
    return _between(MIDPOINT_ERROR, settings.iterations or 9)


def _between(table: dict[int, float], steps: int) -> float:
    """The table at a number of steps, by the geometric law between its entries; its last beyond them."""
    below = [key for key in table if key <= steps]
    above = [key for key in table if key >= steps]
    if not below or not above:
        return table[max(table) if below else min(table)]
    low, high = max(below), min(above)
    share = 0.0 if low == high else (steps - low) / (high - low)
    return table[low] ** (1.0 - share) * table[high] ** share


def _grid_error(settings: Settings) -> float:
    if settings.grid_error_px > 0.0:
        return (
            min(settings.grid_error_px, DIRECTION_PX) if settings.grid_kind == "direction" else settings.grid_error_px
        )
    if settings.grid_share <= 0.0:
        return 0.0
    share = GRID_SHARE_PX * 0.04 / settings.grid_share
    return min(share, DIRECTION_PX) if settings.grid_kind == "direction" else share
