"""Named settings and the closed sets of the package: `Status`, `Technique`, `Settings`."""

from __future__ import annotations

import dataclasses
import difflib
from dataclasses import dataclass
from enum import IntEnum


class Status(IntEnum):
    """What an answer is worth. Every point, pixel and ray carries one; it comes from the residual."""

    NONE = 0
    """Nothing was asked: no reflection here."""
    CONVERGED = 1
    """A reflection point (or an exact hit) that fulfils the law of reflection within the tolerance."""
    SKY = 2
    """The reflected ray leaves the scene."""
    HIDDEN = 3
    """The reflector itself stands between the eye and the point; of maps: none of them sees the point."""
    UNREFLECTED = 4
    """The point lies in neither the reflected nor the hidden region of an open reflector."""
    GRAZING = 5
    """Incidence so close to 90 degrees that the answer is not resolved in this precision."""
    MAX_ITERATIONS = 6
    """The search ended at its bound with a residual above the tolerance; the best point is given."""
    DEGENERATE = 7
    """The geometry admits no direction (a zero normal, a bisector of length zero)."""
    AMBIGUOUS = 8
    """A continuum of equally good answers (a ring on an axis); one fixed member is given."""
    NEAR_CAUSTIC = 9
    """Two roots are about to merge; about half of the digits are lost."""
    INSIDE = 10
    """The eye or the point lies inside the reflector's body."""
    BAD_INPUT = 11
    """Not finite, or the eye or the point lies on the surface where it may not."""
    OUT_OF_EXTENT = 12
    """The reflection point lies outside the mirror's outline."""
    STEP_LIMIT = 13
    """A traversal ended at its step bound."""
    DEPTH_LIMIT = 14
    """A recursion ended at its depth bound."""


class Technique(IntEnum):
    """Who answered a pixel; the `method` channel."""

    NONE = 0
    RAYTRACED = 1
    PLANAR = 2
    QUADRIC = 3
    REFLECTOR_MAP = 4
    EXPLOSION_MAP = 5
    ENVIRONMENT = 6
    LAYERED_ENVIRONMENT = 7


SEARCHES = ("newton", "midpoint")
REFRACTIONS = ("auto", "drawn", "traced")
GRID_KINDS = ("direction", "slope", "position")
REFINEMENTS = ("exact", "strict", "off")
OCCLUSIONS = ("exact", "painter")
SWITCHED = ("shadows", "shadow_sharing", "dome_shadows")  # settings that take a boolean for on and off
SWITCHES = {"1": "on", "true": "on", "on": "on", "0": "off", "false": "off", "off": "off"}
REM_TEXELS = ("packed", "full")
LOCAL_RAYS = ("exact", "field")
REM_MISSING = ("shade", "best")
ENVIRONMENT_UPDATES = ("static", "frame", "previous")
FIELDS = ("auto", "heightfield", "occupancy")
BUMPS = ("lookup", "traced", "off")
GLOSSY = ("auto", "gather", "prefiltered", "filter", "accumulate", "off")
KERNELS = ("auto", "plain", "vector")
WAVES = ("lookup", "traced", "off")


@dataclass(frozen=True)
class Settings:
    """Every knob of a plan. Unknown names and impossible values are a `ValueError` that says what is possible."""

    search: str = "newton"
    """`newton` (the default) or `midpoint`, the search of Estalella et al. 2005, section 4.3."""
    iterations: int = 0
    """Bound on the steps of a search per vertex; 0: the search's own default (newton 12, midpoint 9)."""
    tolerance: float = 0.0
    """Residual sine at which a search stops; 0: 0.1 h^2 of the map's texel size h (below that the map is wrong)."""
    map_resolution: int = 128
    """Nodes along a cube edge of a reflector map. [nodes]"""
    grid_share: float = 0.0
    """Interpolation grid: nodes as a fraction of the vertices; 0: every vertex is searched (but see `grid_error_px`)."""
    grid_kind: str = "direction"
    """The grid holds: `direction` (one exact step a vertex), `slope` (positions, derivatives), `position` (the paper's)."""
    grid_error_px: float = 0.0
    """Vertices are interpolated over cells of any size while their estimated error stays below this; 0: off. [pixels]"""
    max_error_px: float = 0.0
    """The plan takes what is cheapest among all that is predicted to show 95 % of the mirror pixels within this; 0: what is
    exact and cheap. [pixels]"""
    budget_ms: float = 0.0
    """The plan takes what is most accurate among all that is predicted to make a frame in this time, without preparation;
    0: what is exact and cheap. Where `max_error_px` contradicts, this gives way. [ms]"""
    environment_px: float = 0.5
    """An environment map replaces what is exact where it is cheaper and off by at most this; 0: never. [pixels]"""
    shape_px: float = 0.5
    """A mesh counts as a plane or a quadric where that shifts what it shows by at most this. [pixels]"""
    few_pixels: int = 16
    """A mirror seen at fewer pixels gets the cheapest technique, its shape not looked at; 0: none does. [pixels]"""
    keep_static: bool = True
    """A frame takes over what the previous one answered where neither the eye nor the world has moved."""
    reuse_px: float = 0.0
    """A virtual vertex of the previous frame is kept while the bound on its drift stays below this; 0: off. [pixels]"""
    occlusion: str = "exact"
    """What hides what in a virtual picture: `exact` (path length per pixel) or `painter` (one depth a triangle; no refine)."""
    explosion_walk: int = 64
    """Neighbour triangles an `explosion_map` look-up may walk over; 0: none, the paper's far map."""
    edge_px: float = 0.25
    """Virtual triangles are cut until a straight edge's picture bends by less than this; 0: never cut. [pixels]"""
    refine: str = "exact"
    """`exact` (every pixel gets the hit of an exact ray-triangle test), `strict` (all 3x3 candidates are tested for a nearer
    hit, not only those that rise above the surface: 2 to 3 times fewer wrong pixels), or `off` (the papers' picture)."""
    environment_resolution: int = 256
    """Texels along a cube edge of environment maps."""
    environment_update: str = "static"
    """A mirror's environment map is drawn: `static` (again only where the world changed), `frame` (in every frame), or
    `previous` (in every frame, and mirrors seen in it show the maps of the frame before)."""
    rem_count: int = 2
    """Reference environment maps that a texel of a local map is blended from."""
    rem_texels: str = "packed"
    """Texels of reference environment maps: `packed` (4 bytes) or `full` (20 bytes, single precision)."""
    rem_missing: str = "shade"
    """What no reference map sees is shaded where it is met (`shade`), or shows the map that would weigh most (`best`)."""
    rem_blur_px: float = 16.0
    """A reference map whose texel covers more texels of the local map than this does not count as seeing a point; 0: it does.
    [texels of a local map]"""
    rem_limit: int = 16
    """Reference maps that are placed at most where the stage names no places."""
    rem_error_px: float = 1.0
    """Reference maps are placed until their predicted error is below this. [texels of a local map]"""
    local_rays: str = "exact"
    """Depths of local maps: `exact` (rays through the triangles, at the nodes of a mesh), or `field` (the field of what never
    moves, `field_kind`)."""
    local_shade_step: int = 1
    """What is shaded in local maps: squares of so many texels that show one triangle share what one of them sees; 1: none do."""
    mesh_cells: int = 32
    """Cells along a face of a local map's mesh before it is refined, at least."""
    depth_ratio: float = 0.25
    """A cell whose corners' depths differ by more than this share of the nearest is refined; 0: every texel is traced."""
    parallax_steps: int = 12
    """Steps along a mirror pixel's ray at which a local map is asked what it meets; 0: looked up by direction alone."""
    local_resolution: int = 0
    """Texels along a cube edge of mirrors' local maps; 0: as many as reference maps have, `environment_resolution`."""
    local_detail: float = 0.0
    """Texels along an edge of a local map for each pixel of its mirror's size on screen; 0: all maps have as many."""
    local_texels: int = 0
    """Texels that the local maps of a frame have together at most, those finest for their size give first; 0: no limit."""
    local_blend: float = 1.0
    """Grey levels, of 255 in sRGB, by which a mirror's pixel changes at most in a frame because its local map takes another
    level of detail (`local_detail`, `local_texels`); 0: it switches at once."""
    local_own_size: float = 2.0
    """What moves with a mirror, its vehicle, is not in the mirror's own map where the box around both has at most so many
    times the diagonal of the mirror's; 0: it is shown."""
    local_keep_px: float = 0.0
    """A moving mirror's local map is kept while what it holds has shifted by less than this in the mean; 0: never. [texels]"""
    walk_hops: int = 4
    """Neighbour triangles a refinement may walk over before the BVH decides."""
    complexity: str = "low"
    """`low`, `medium`, `high`, `veryhigh`: subdivision level 0-3, and the tessellation of gprims, as in usdrecord."""
    bounces: int = 2
    """Mirrors seen in mirrors, in mirrors ...: how many reflections are followed; beyond them a mirror shows the dome."""
    refraction: str = "auto"
    """What lies behind a flat refracting surface: `traced` by rays, `drawn` as its virtual image and refined, `auto` what is
    predicted to be cheaper; the same hits either way."""
    transparency_depth: int = 8
    """Transparent surfaces behind one another that are looked through; nothing is seen through the next."""
    fade_distance: float = 0.0
    """What mirrors show fades over this distance to 1/e, where the stage asks for no fade; 0: it does not. [scene units]"""
    fade_grey: float = 0.0
    """Radiance of what `fade_distance` fades to."""
    frost: float = 0.0
    """Half-angle of the cone into which transparent surfaces scatter what is behind, where the stage asks for none; 0: by their
    roughness. [degrees]"""
    frost_px: float = 0.5
    """Frost that blurs even what is infinitely far by less than this is left out. [pixels]"""
    frost_samples: int = 0
    """Frosted surfaces: 0 blurs the picture of what is behind them, else so many rays a pixel are averaged, the reference."""
    frost_rays: int = 3
    """Rays a pixel that say what blurred frost lacks, as what its cone sees past the surface's outline; 0: it lacks it."""
    frost_distance: float = 0.0
    """What is seen through transparent surfaces fades over this distance to 1/e, where the stage asks for no fade; 0: it does
    not. [scene units]"""
    frost_grey: float = 1.0
    """Radiance of what `frost_distance` fades to."""
    waves: str = "lookup"
    """Waves on flat mirrors: `lookup` distorts the pictures of the still surface, `traced` follows the rays that the waves turn,
    the reference, `off` leaves the surface still."""
    threads: int = 0
    """CPU threads of a launch; 0: one per core."""
    kernels: str = "auto"
    """`auto` (vector kernels where this CPU's compiler has them), `plain` (never) or `vector` (an error where it has none)."""
    shadows: str = "auto"
    """Shadows of distant lights and of shapes that emit: `auto` (of those that cast them into view), `on` or `off`."""
    shadow_min_share: float = 0.001
    """`shadows=auto`: a light casts shadows where they take at least this share of all light off what is seen."""
    shadow_samples: int = 16
    """Rays from a point towards a shape, or into a dome. A penumbra's error falls with their 3/4th power where each point sends
    all, with their 2/3rd to half where neighbours share: 16 leave 0.041 rms of a shape in `one_mirror`, unshared 0.055."""
    shadow_sharing: str = "on"
    """`on`: from a shape's penumbra a quarter of `shadow_samples` is sent, and neighbouring pixels of one plane share what it
    finds, where it is wide; or `off`: each sends all."""
    dome_shadows: str = "off"
    """`on`: domes light a point only through what it sees of the sky, `shadow_samples` rays a point; or `off`."""
    field_kind: str = "auto"
    """What maps trace rays through: `heightfield`, `occupancy` (a 3-D grid), or `auto`, by `field_overhang`."""
    field_cell: float = 0.0
    """Edge of a column of the heightfield, or of a cell of the grid; 0: automatic. [scene units]"""
    field_overhang: float = 0.02
    """Share of the columns with free space under a roof above which `auto` takes the grid."""
    bumps: str = "traced"
    """Normal maps of mirrors: `traced` follows every turned ray, `lookup` looks it up in the smooth picture first,
    `off` reflects at the surface itself."""
    glossy: str = "auto"
    """Rough mirrors: `gather` (a few rays of the lobe a pixel, shared by neighbours), `prefiltered` (look-ups in a map's filtered
    levels), `auto` (that where the technique is a map, else gather), `filter` (look-ups in the sharp picture), `accumulate` (rays
    of the lobe: the reference), or `off`."""
    glossy_samples: int = 0
    """Look-ups or rays a pixel of a rough mirror; 0: the method's own (gather 6, prefiltered 1, filter 16, accumulate
    256)."""
    glossy_neighbours: int = 16
    """Of `gather`: pixels around one whose rays it shares, where their lobes overlap its own; 0: it has but its own."""
    glossy_smooth: float = 0.3
    """Of `gather`: grain is smoothed over pixels that see the same up to this share of their lobes' width; 0: it is left."""
    glossy_min_roughness: float = 0.01
    """A mirror up to this roughness is shown sharp; a lobe of 0.01 is a fifth of a pixel wide at a focal length of 1000."""
    reflector_max_roughness: float = 0.3
    """A material rougher than this is not treated as a mirror: its specular share is scattered."""
    reflector_min_weight: float = 0.2
    """A material whose mirror weight at normal incidence is below this is not treated as a mirror."""

    def __post_init__(self) -> None:
        for name in SWITCHED:
            object.__setattr__(self, name, SWITCHES.get(str(getattr(self, name)).lower(), getattr(self, name)))
        _require(self.shadows in ("auto", *SWITCHES.values()), "shadows", self.shadows, "auto, on or off")
        _require(0.0 <= self.shadow_min_share <= 1.0, "shadow_min_share", self.shadow_min_share, "0 to 1")
        _require(1 <= self.shadow_samples <= 65536, "shadow_samples", self.shadow_samples, "1 to 65536 rays")
        _require(self.shadow_sharing in SWITCHES.values(), "shadow_sharing", self.shadow_sharing, "on or off")
        _require(self.dome_shadows in SWITCHES.values(), "dome_shadows", self.dome_shadows, "on or off")
        _require(self.search in SEARCHES, "search", self.search, f"one of {', '.join(SEARCHES)}")
        _require(0.0 <= self.grid_share <= 1.0, "grid_share", self.grid_share, "0 to 1")
        _require(self.grid_kind in GRID_KINDS, "grid_kind", self.grid_kind, f"one of {', '.join(GRID_KINDS)}")
        _require(
            0.0 <= self.grid_error_px <= 1.0e6, "grid_error_px", self.grid_error_px, "0 (off) or a number of pixels"
        )
        _require(0.0 <= self.max_error_px <= 1.0e6, "max_error_px", self.max_error_px, "0 (off) or a number of pixels")
        _require(0.0 <= self.budget_ms <= 1.0e6, "budget_ms", self.budget_ms, "0 (off) or a number of milliseconds")
        _require(0.0 <= self.environment_px <= 1.0e6, "environment_px", self.environment_px, "0 (never) or pixels")
        _require(0.0 <= self.shape_px <= 1.0e6, "shape_px", self.shape_px, "0 to 1000000 pixels")
        _require(0 <= self.few_pixels <= 1000000, "few_pixels", self.few_pixels, "0 to 1000000 pixels")
        _require(0.0 <= self.reuse_px <= 1.0e6, "reuse_px", self.reuse_px, "0 (off) or a number of pixels")
        _require(self.occlusion in OCCLUSIONS, "occlusion", self.occlusion, f"one of {', '.join(OCCLUSIONS)}")
        painted = self.occlusion == "painter" and self.refine != "off"
        _require(not painted, "occlusion", self.occlusion, "exact, or refine=off with it")
        _require(0 <= self.explosion_walk <= 10000, "explosion_walk", self.explosion_walk, "0 to 10000")
        _require(0.0 <= self.edge_px <= 1.0e6, "edge_px", self.edge_px, "0 (never cut) or a number of pixels")
        _require(self.refine in REFINEMENTS, "refine", self.refine, f"one of {', '.join(REFINEMENTS)}")
        _require(self.complexity in COMPLEXITIES, "complexity", self.complexity, f"one of {', '.join(COMPLEXITIES)}")
        _require(0 <= self.iterations <= 1000, "iterations", self.iterations, "0 to 1000")
        _require(0.0 <= self.tolerance < 1.0, "tolerance", self.tolerance, "0 to 1 (a sine)")
        _require(8 <= self.map_resolution <= 2048, "map_resolution", self.map_resolution, "8 to 2048 nodes")
        _require(1 <= self.bounces <= 64, "bounces", self.bounces, "1 to 64")
        texels = self.environment_resolution
        _require(4 <= texels <= 4096, "environment_resolution", texels, "4 to 4096 texels")
        update = self.environment_update
        _require(
            update in ENVIRONMENT_UPDATES, "environment_update", update, f"one of {', '.join(ENVIRONMENT_UPDATES)}"
        )
        _require(self.refraction in REFRACTIONS, "refraction", self.refraction, f"one of {', '.join(REFRACTIONS)}")
        depth = self.transparency_depth
        _require(0 <= depth <= 64, "transparency_depth", depth, "0 to 64 surfaces")
        _require(1 <= self.rem_count <= 8, "rem_count", self.rem_count, "1 to 8")
        _require(self.rem_texels in REM_TEXELS, "rem_texels", self.rem_texels, f"one of {', '.join(REM_TEXELS)}")
        _require(self.rem_missing in REM_MISSING, "rem_missing", self.rem_missing, f"one of {', '.join(REM_MISSING)}")
        _require(0.0 <= self.rem_blur_px <= 1.0e6, "rem_blur_px", self.rem_blur_px, "0 (off) or a number of texels")
        _require(1 <= self.rem_limit <= 1024, "rem_limit", self.rem_limit, "1 to 1024")
        _require(0.0 <= self.rem_error_px <= 1.0e6, "rem_error_px", self.rem_error_px, "a number of texels")
        _require(self.local_rays in LOCAL_RAYS, "local_rays", self.local_rays, f"one of {', '.join(LOCAL_RAYS)}")
        _require(1 <= self.local_shade_step <= 16, "local_shade_step", self.local_shade_step, "1 to 16 texels")
        _require(1 <= self.mesh_cells <= 4096, "mesh_cells", self.mesh_cells, "1 to 4096")
        _require(0.0 <= self.depth_ratio <= 1.0e6, "depth_ratio", self.depth_ratio, "0 (all texels) or a ratio")
        _require(0 <= self.parallax_steps <= 64, "parallax_steps", self.parallax_steps, "0 to 64")
        texels = self.local_resolution
        _require(texels == 0 or 4 <= texels <= 4096, "local_resolution", texels, "0 (as reference maps) or 4 to 4096")
        _require(0.0 <= self.local_detail <= 64.0, "local_detail", self.local_detail, "0 (off) to 64 texels a pixel")
        _require(0 <= self.local_texels <= 2**40, "local_texels", self.local_texels, "0 (no limit) or texels")
        _require(0.0 <= self.local_blend <= 255.0, "local_blend", self.local_blend, "0 (off) to 255 grey levels")
        _require(0.0 <= self.local_own_size <= 1.0e6, "local_own_size", self.local_own_size, "0 (shown) or a ratio")
        _require(0.0 <= self.local_keep_px <= 1.0e6, "local_keep_px", self.local_keep_px, "0 (never) or texels")
        for name in ("fade_distance", "frost_distance"):
            value = getattr(self, name)
            _require(0.0 <= value <= 1.0e9, name, value, "0 (off) or a length")
        for name in ("fade_grey", "frost_grey"):
            value = getattr(self, name)
            _require(0.0 <= value <= 1.0e6, name, value, "a radiance from 0 on")
        _require(0.0 <= self.frost <= 45.0, "frost", self.frost, "0 to 45 degrees")
        _require(0.0 <= self.frost_px <= 1.0e6, "frost_px", self.frost_px, "0 to 1000000 pixels")
        _require(0 <= self.frost_samples <= 65536, "frost_samples", self.frost_samples, "0 (blurred) to 65536 rays")
        _require(0 <= self.frost_rays <= 256, "frost_rays", self.frost_rays, "0 (blurred alone) to 256")
        _require(self.waves in WAVES, "waves", self.waves, f"one of {', '.join(WAVES)}")
        _require(0 <= self.walk_hops <= 64, "walk_hops", self.walk_hops, "0 to 64")
        _require(self.field_kind in FIELDS, "field_kind", self.field_kind, f"one of {', '.join(FIELDS)}")
        _require(0.0 <= self.field_cell <= 1.0e9, "field_cell", self.field_cell, "0 (automatic) or a length")
        _require(0.0 <= self.field_overhang <= 1.0, "field_overhang", self.field_overhang, "0 to 1")
        _require(self.bumps in BUMPS, "bumps", self.bumps, f"one of {', '.join(BUMPS)}")
        _require(self.glossy in GLOSSY, "glossy", self.glossy, f"one of {', '.join(GLOSSY)}")
        _require(0 <= self.glossy_samples <= 65536, "glossy_samples", self.glossy_samples, "0 (its own) to 65536")
        _require(0 <= self.glossy_neighbours <= 256, "glossy_neighbours", self.glossy_neighbours, "0 to 256 pixels")
        _require(0.0 <= self.glossy_smooth <= 1.0, "glossy_smooth", self.glossy_smooth, "0 (off) to 1")
        _require(0.0 <= self.glossy_min_roughness <= 1.0, "glossy_min_roughness", self.glossy_min_roughness, "0 to 1")
        _require(self.kernels in KERNELS, "kernels", self.kernels, f"one of {', '.join(KERNELS)}")
        _require(0 <= self.threads <= 1024, "threads", self.threads, "0 (all cores) to 1024")
        _require(
            0.0 <= self.reflector_max_roughness <= 1.0,
            "reflector_max_roughness",
            self.reflector_max_roughness,
            "0 to 1",
        )
        _require(0.0 <= self.reflector_min_weight <= 1.0, "reflector_min_weight", self.reflector_min_weight, "0 to 1")

    @property
    def blends_levels(self) -> bool:
        """Whether a local map that takes another level of detail is blended over."""
        return self.local_blend > 0.0 and (self.local_detail > 0.0 or self.local_texels > 0)

    @property
    def local_edge(self) -> int:
        """Texels along a cube edge of mirrors' local maps."""
        return self.local_resolution or self.environment_resolution

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names `--set` and `replace` accept."""
        return tuple(field.name for field in dataclasses.fields(cls))

    def replace(self, **changes) -> Settings:
        """A copy with the named settings changed; strings are converted to the setting's type.

        Raises:
            ValueError: an unknown name (with the nearest known ones), or a value that cannot be.
        """
        types = {field.name: type(field.default) for field in dataclasses.fields(self)}
        values = {}
        for name, value in changes.items():
            if name not in types:
                near = difflib.get_close_matches(name, types, n=3, cutoff=0.4)
                raise ValueError(f"unknown setting '{name}'; nearest: {', '.join(near or types)}")
            values[name] = _convert(name, value, types[name])
        return dataclasses.replace(self, **values)


COMPLEXITIES = ("low", "medium", "high", "veryhigh")


def _require(good: bool, name: str, got, expected: str) -> None:
    if not good:
        raise ValueError(f"setting '{name}': got {got!r}, expected {expected}")


def _convert(name: str, value, kind: type):
    if isinstance(value, kind) and not (kind is int and isinstance(value, bool)):
        return value
    try:
        if kind is bool:
            return {"1": True, "true": True, "on": True, "0": False, "false": False, "off": False}[str(value).lower()]
        return kind(value)
    except (KeyError, TypeError, ValueError):
        raise ValueError(f"setting '{name}': got {value!r}, expected a value of type {kind.__name__}") from None
