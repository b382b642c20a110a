"""Error measures between two frames of the same camera and size.

Points may be world or eye-relative, as long as both frames use the same: every measure is of differences, and
world points that were rounded to float32 are given that rounding.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from warp_reflect.images import srgb_from_linear
from warp_reflect.settings import Status

IDENTICAL_SHARE = 1e-4  # of the path length: the distance up to which two hits are the same hit
SEARCH_STEPS = 24  # Gauss-Newton steps; a smooth field takes 2 or 3, the rest is for walking far
STEP_MAX = 8.0  # pixels a step may go: beyond, the slopes at the start say nothing
CONVERGED_PX = 1e-3  # step length at which the search ends: 1/500 of the error one cares about
# A point that misses the reference's field by more than this many pixel footprints is not shown there.
MATCH_FOOTPRINTS = 1.5
# A difference inside a cell that is this many times the slope at the nearest pixel is a silhouette, no slope.
LEAP = 4.0
# Pixels of one (mirror, prim) that a lost point is compared with; a larger area is sampled evenly, some
# pixels apart, which is well within what the search walks from there.
LOOKUP_PIXELS = 4096
LOOKUP_CHUNK = 1 << 22  # distances held at once, 32 MB


class PixelClass(IntEnum):
    """What a comparison found at a pixel."""

    NONE = 0
    """No mirror in either frame."""
    BORDER = 1
    """A mirror in one frame or both, but not the same one over the 3x3 neighbourhood."""
    IDENTICAL = 2
    """The same hit, or sky in both."""
    SHIFTED = 3
    """The same prim at another place; its pixel error is known."""
    UNMATCHED = 4
    """The same prim, at a point that the reference shows nowhere in this mirror."""
    WRONG = 5
    """Another prim, or sky in one of them."""
    UNANSWERED = 6
    """Neither a prim nor sky in at least one frame (its status says why)."""


@dataclass(frozen=True)
class Comparison:
    """The error of frame `a` against the reference `b`; counts are of pixels.

    Shares are of all interior mirror pixels: those whose 3x3 neighbourhood shows one mirror, in both frames.
    """

    mirror_pixels: int
    """With a mirror in either frame; interior + border."""
    interior_pixels: int
    identical: int
    """Same prim and reflected points within 1e-4 of the path length, or both sky."""
    shifted: int
    unmatched: int
    wrong: int
    unanswered: int
    border_pixels: int
    border_identical: int
    border_wrong: int
    """Another mirror, or the same mirror with another prim in it."""
    error_median_px: float
    """Pixel errors are of the shifted pixels; 0 where there are none."""
    error_p95_px: float
    error_max_px: float
    within_half_px: int
    """Identical, or shifted by at most half a pixel."""
    psnr_db: float | None
    """Of the sRGB-encoded pictures clipped to [0, 1]; None where they are equal."""
    mean_abs: float
    """Mean absolute difference of linear R, G, B over the whole picture."""
    classes: np.ndarray = dataclasses.field(repr=False, compare=False)
    """uint8 [height, width], `PixelClass`."""
    error_px: np.ndarray = dataclasses.field(repr=False, compare=False)
    """float32 [height, width], the pixel error of shifted pixels, else 0."""

    def share(self, count: int) -> float:
        """A count as a share of the interior pixels; 0 where there are none."""
        return count / self.interior_pixels if self.interior_pixels else 0.0

    def to_json(self) -> dict:
        """The numbers as plain Python, with the shares beside the counts."""
        numbers = {
            field.name: getattr(self, field.name)
            for field in dataclasses.fields(self)
            if field.name not in ("classes", "error_px")
        }
        for name in ("identical", "shifted", "unmatched", "wrong", "unanswered", "within_half_px"):
            numbers[f"{name}_share"] = self.share(getattr(self, name))
        return numbers

    def __str__(self) -> str:
        def row(name: str, count: int, of: int) -> str:
            return f"  {name:<12}{count:>12,}  {100.0 * count / of if of else 0.0:8.4f} %"

        interior, border = self.interior_pixels, self.border_pixels
        psnr = "equal pictures" if self.psnr_db is None else f"PSNR {self.psnr_db:.2f} dB"
        return "\n".join(
            [
                f"interior mirror pixels {interior:,}",
                row("identical", self.identical, interior),
                row("shifted", self.shifted, interior)
                + f"  pixel error median {self.error_median_px:.3g}, p95 {self.error_p95_px:.3g}, "
                f"max {self.error_max_px:.3g} px",
                row("unmatched", self.unmatched, interior),
                row("wrong", self.wrong, interior),
                row("unanswered", self.unanswered, interior),
                f"border mirror pixels {border:,}",
                row("identical", self.border_identical, border),
                row("wrong", self.border_wrong, border),
                f"picture: {psnr}, mean absolute difference {self.mean_abs:.3g}",
            ]
        )


def compare_frames(a: Mapping, b: Mapping) -> Comparison:
    """Measure frame `a` against the reference `b`.

    Args:
        a: Channel name to array, as `images.read_exr` returns them or a `Frame` answers them: `reflectorId`,
            `reflectedId`, `status`, `pathLength`, `R`, `G`, `B` [height, width] and `reflectedPoint`
            [height, width, 3].
        b: The same of the reference.

    The pixel error of a shifted pixel p is the distance from p to where `b` shows the point that `a` shows at
    p: the place at which b's reflectedPoint, interpolated between pixels of the same mirror and prim, is
    nearest to it (Gauss-Newton with finite differences, started at p; where that fails, at the best of all
    pixels).

    Raises:
        ValueError: a channel is missing, or the frames differ in size.
    """
    ra, rb = _channel(a, "reflectorId"), _channel(b, "reflectorId")
    if ra.shape != rb.shape:
        raise ValueError(f"frames differ in size: {ra.shape[1]}x{ra.shape[0]} and {rb.shape[1]}x{rb.shape[0]}")
    ra, rb = np.rint(ra).astype(np.int64), np.rint(rb).astype(np.int64)
    ia, ib = (np.rint(_channel(f, "reflectedId")).astype(np.int64) for f in (a, b))
    sky_a, sky_b = (np.rint(_channel(f, "status")) == Status.SKY for f in (a, b))
    point_a, point_b = (_channel(f, "reflectedPoint").astype(np.float64) for f in (a, b))
    whole_a, whole_b = (np.isfinite(point).all(axis=-1) for point in (point_a, point_b))
    point_a[~whole_a], point_b[~whole_b] = 0.0, 0.0
    mirror = (ra > 0) | (rb > 0)
    interior = _same_around(ra) & _same_around(rb) & (ra == rb) & (ra > 0)
    border = mirror & ~interior
    # A world point is rounded once on output: its float32 spacing is no difference of hits.
    rounding = np.linalg.norm(np.spacing(np.maximum(abs(point_a), abs(point_b)).astype(np.float32)), axis=-1)
    delta = np.linalg.norm(point_a - point_b, axis=-1)
    close = delta <= IDENTICAL_SHARE * _channel(b, "pathLength") + rounding
    hit_a, hit_b = (ia > 0) & ~sky_a & whole_a, (ib > 0) & ~sky_b & whole_b
    same_prim = hit_a & hit_b & (ia == ib)
    identical = (same_prim & close) | (sky_a & sky_b)
    answered = (hit_a | sky_a) & (hit_b | sky_b)
    wrong = answered & ~identical & ~same_prim

    classes = np.zeros(ra.shape, np.uint8)
    classes[border] = PixelClass.BORDER
    classes[interior & ~answered] = PixelClass.UNANSWERED
    classes[interior & identical] = PixelClass.IDENTICAL
    classes[interior & wrong] = PixelClass.WRONG
    shifted = interior & same_prim & ~close
    field = _ReferenceField(point_b, np.where(hit_b, rb, 0), ib)
    rows, columns = np.nonzero(shifted)
    error, found = field.pixel_error(rows, columns, point_a[rows, columns])
    classes[rows, columns] = np.where(found, PixelClass.SHIFTED, PixelClass.UNMATCHED)
    error_px = np.zeros(ra.shape, np.float32)
    error_px[rows[found], columns[found]] = error[found]

    errors = error[found] if found.any() else np.zeros(1)
    counts = np.bincount(classes.reshape(-1), minlength=len(PixelClass))
    psnr_db, mean_abs = _picture_error(a, b)
    return Comparison(
        mirror_pixels=int(np.count_nonzero(mirror)),
        interior_pixels=int(np.count_nonzero(interior)),
        identical=int(counts[PixelClass.IDENTICAL]),
        shifted=int(counts[PixelClass.SHIFTED]),
        unmatched=int(counts[PixelClass.UNMATCHED]),
        wrong=int(counts[PixelClass.WRONG]),
        unanswered=int(counts[PixelClass.UNANSWERED]),
        border_pixels=int(counts[PixelClass.BORDER]),
        border_identical=int(np.count_nonzero(border & identical & (ra == rb))),
        border_wrong=int(np.count_nonzero(border & (wrong | (ra != rb)))),
        error_median_px=float(np.median(errors)),
        error_p95_px=float(np.percentile(errors, 95)),
        error_max_px=float(errors.max()),
        within_half_px=int(counts[PixelClass.IDENTICAL] + np.count_nonzero(found & (error <= 0.5))),
        psnr_db=psnr_db,
        mean_abs=mean_abs,
        classes=classes,
        error_px=error_px,
    )


def _channel(frame: Mapping, name: str) -> np.ndarray:
    try:
        return np.asarray(frame[name])
    except KeyError:
        raise ValueError(f"a frame lacks the channel '{name}'; render it with every channel to compare it") from None


def _same_around(ids: np.ndarray) -> np.ndarray:
    """Whether the 3x3 neighbourhood holds one id; never at the picture's rim."""
    same = np.zeros(ids.shape, bool)
    if min(ids.shape) >= 3:
        windows = np.lib.stride_tricks.sliding_window_view(ids, (3, 3))
        same[1:-1, 1:-1] = windows.min(axis=(2, 3)) == windows.max(axis=(2, 3))
    return same


def _picture_error(a: Mapping, b: Mapping) -> tuple[float | None, float]:
    pictures = [np.stack([_channel(f, name) for name in "RGB"], axis=-1).astype(np.float64) for f in (a, b)]
    mean_abs = float(np.mean(abs(pictures[0] - pictures[1])))
    shown = [srgb_from_linear(np.clip(picture, 0.0, 1.0)).astype(np.float64) for picture in pictures]
    mean_square = float(np.mean((shown[0] - shown[1]) ** 2))
    return (-10.0 * math.log10(mean_square) if mean_square > 0.0 else None), mean_abs


class _ReferenceField:
    """The reference's reflected points as a function of the pixel, for each (mirror, prim)."""

    def __init__(self, points: np.ndarray, reflector: np.ndarray, reflected: np.ndarray):
        self.points = points
        # One key per (mirror, prim); 0 where there is no hit.
        self.key = np.where(reflector > 0, reflector * (int(reflected.max(initial=0)) + 1) + reflected, 0)
        self.height, self.width = self.key.shape

    def pixel_error(self, rows, columns, targets) -> tuple[np.ndarray, np.ndarray]:
        """Distance from each pixel to where its target is shown, and whether it is shown at all.

        Args:
            rows: Of the pixels [n].
            columns: Of the pixels [n].
            targets: Points [n, 3].

        Returns:
            (distance [n] in pixels, found [n]).
        """
        start = np.stack([columns, rows], axis=-1).astype(np.float64)
        key = self.key[rows, columns]
        place, found = self._search(start, key, targets)
        lost = np.nonzero(~found)[0]
        if lost.size:
            again, lost_start = self._nearest_pixels(key[lost], targets[lost])
            lost, lost_start = lost[again], lost_start[again]
            better, there = self._search(lost_start, key[lost], targets[lost])
            place[lost[there]] = better[there]
            found[lost[there]] = True
        return np.linalg.norm(place - start, axis=-1), found

    def _search(self, start: np.ndarray, key: np.ndarray, targets: np.ndarray):
        """Gauss-Newton on the field; the place of the smallest miss met, and whether that is a match."""
        place = start.copy()
        best_place = start.copy()
        best_miss = np.full(len(start), np.inf)
        best_footprint = np.zeros(len(start))
        active = np.arange(len(start))
        for _ in range(SEARCH_STEPS):
            if not active.size:
                break
            value, along_x, along_y, valid = self._sample(place[active], key[active])
            active, value = active[valid], value[valid]
            along_x, along_y = along_x[valid], along_y[valid]
            miss_vector = targets[active] - value
            miss = np.linalg.norm(miss_vector, axis=-1)
            improved = miss < best_miss[active]
            chosen = active[improved]
            best_miss[chosen] = miss[improved]
            best_place[chosen] = place[chosen]
            footprint = np.maximum(np.linalg.norm(along_x, axis=-1), np.linalg.norm(along_y, axis=-1))
            best_footprint[chosen] = footprint[improved]
            step, solvable = _least_squares_2d(along_x, along_y, miss_vector)
            length = np.linalg.norm(step, axis=-1)
            step *= np.minimum(1.0, STEP_MAX / np.maximum(length, 1e-300))[:, None]
            place[active] += step
            active = active[solvable & (length > CONVERGED_PX)]
        return best_place, best_miss <= MATCH_FOOTPRINTS * best_footprint

    def _sample(self, place: np.ndarray, key: np.ndarray):
        """Value and slopes per pixel at sub-pixel places; invalid off the pixels of the same key.

        Bilinear where all four pixels around belong to the key and none lies beyond a leap (a silhouette
        within one prim), else linear from the nearest pixel with the slopes to its neighbours of the key.
        """
        column = np.clip(np.floor(place[:, 0]), 0, max(self.width - 2, 0)).astype(np.int64)
        row = np.clip(np.floor(place[:, 1]), 0, max(self.height - 2, 0)).astype(np.int64)
        inside = (abs(place[:, 0] - (self.width - 1) / 2) <= self.width / 2) & (
            abs(place[:, 1] - (self.height - 1) / 2) <= self.height / 2
        )
        right, below = np.minimum(column + 1, self.width - 1), np.minimum(row + 1, self.height - 1)
        whole = inside & (right > column) & (below > row)
        for r, c in ((row, column), (row, right), (below, column), (below, right)):
            whole &= self.key[r, c] == key
        fx = (place[:, 0] - column)[:, None]
        fy = (place[:, 1] - row)[:, None]
        p00, p10 = self.points[row, column], self.points[row, right]
        p01, p11 = self.points[below, column], self.points[below, right]
        value = (1 - fy) * ((1 - fx) * p00 + fx * p10) + fy * ((1 - fx) * p01 + fx * p11)
        along_x = (1 - fy) * (p10 - p00) + fy * (p11 - p01)
        along_y = (1 - fx) * (p01 - p00) + fx * (p11 - p10)

        near_column = np.clip(np.rint(place[:, 0]), 0, self.width - 1).astype(np.int64)
        near_row = np.clip(np.rint(place[:, 1]), 0, self.height - 1).astype(np.int64)
        slope_x, good_x = self._slope(near_row, near_column, key, 0, 1)
        slope_y, good_y = self._slope(near_row, near_column, key, 1, 0)
        leap_x = LEAP * np.linalg.norm(slope_x, axis=-1)
        leap_y = LEAP * np.linalg.norm(slope_y, axis=-1)
        for difference, leap in (
            (p10 - p00, leap_x),
            (p11 - p01, leap_x),
            (p01 - p00, leap_y),
            (p11 - p10, leap_y),
        ):
            whole &= np.linalg.norm(difference, axis=-1) <= leap
        linear = inside & ~whole & good_x & good_y & (self.key[near_row, near_column] == key)
        away_x, away_y = place[:, 0] - near_column, place[:, 1] - near_row
        extended = self.points[near_row, near_column] + away_x[:, None] * slope_x + away_y[:, None] * slope_y
        value = np.where(linear[:, None], extended, value)
        along_x = np.where(linear[:, None], slope_x, along_x)
        along_y = np.where(linear[:, None], slope_y, along_y)
        return value, along_x, along_y, whole | linear

    def _slope(self, row, column, key, down: int, across: int):
        """Difference to the neighbour ahead or behind, the smaller: the larger may be a silhouette."""
        here = self.points[row, column]
        slopes, goods = [], []
        for sign in (1, -1):
            r = np.clip(row + sign * down, 0, self.height - 1)
            c = np.clip(column + sign * across, 0, self.width - 1)
            goods.append((self.key[r, c] == key) & ((r != row) | (c != column)))
            slopes.append(sign * (self.points[r, c] - here))
        lengths = [
            np.where(good, np.linalg.norm(slope, axis=-1), np.inf) for good, slope in zip(goods, slopes, strict=True)
        ]
        ahead = (lengths[0] <= lengths[1])[:, None]
        return np.where(ahead, slopes[0], slopes[1]), goods[0] | goods[1]

    def _nearest_pixels(self, keys: np.ndarray, targets: np.ndarray):
        """The pixel of each key whose point is nearest: (whether there is one [n], place [n, 2])."""
        exists = np.zeros(len(keys), bool)
        place = np.zeros((len(keys), 2))
        for key in np.unique(keys):
            rows, columns = np.nonzero(self.key == key)
            if not rows.size:
                continue
            stride = math.ceil(math.sqrt(rows.size / LOOKUP_PIXELS))
            if stride > 1:
                kept = (rows % stride == 0) & (columns % stride == 0)
                # An area thinner than the stride may hold no such pixel.
                kept = kept if np.count_nonzero(kept) > LOOKUP_PIXELS // 4 else slice(None, None, stride**2)
                rows, columns = rows[kept], columns[kept]
            members = np.nonzero(keys == key)[0]
            points = self.points[rows, columns]
            middle = points.mean(axis=0)
            points = points - middle
            squares = np.einsum("ij,ij->i", points, points)
            chunk = max(LOOKUP_CHUNK // len(points), 1)
            for first in range(0, len(members), chunk):
                some = members[first : first + chunk]
                distance = squares - 2.0 * (targets[some] - middle) @ points.T
                nearest = distance.argmin(axis=1)
                place[some] = np.stack([columns[nearest], rows[nearest]], axis=-1)
                exists[some] = True
        return exists, place


def _least_squares_2d(along_x: np.ndarray, along_y: np.ndarray, miss: np.ndarray):
    """The (x, y) [n, 2] of least |x along_x + y along_y - miss|, and whether they are unique [n]."""
    xx = np.einsum("ij,ij->i", along_x, along_x)
    xy = np.einsum("ij,ij->i", along_x, along_y)
    yy = np.einsum("ij,ij->i", along_y, along_y)
    bx = np.einsum("ij,ij->i", along_x, miss)
    by = np.einsum("ij,ij->i", along_y, miss)
    determinant = xx * yy - xy * xy
    # Slopes within 1e-6 rad of parallel leave the step open along them.
    solvable = determinant > 1e-12 * xx * yy
    safe = np.where(solvable, determinant, 1.0)
    step = np.stack([(yy * bx - xy * by) / safe, (xx * by - xy * bx) / safe], axis=-1)
    return np.where(solvable[:, None], step, 0.0), solvable
