"""Error measures on fields whose displacement is known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from warp_reflect import metrics
from warp_reflect.metrics import PixelClass, compare_frames
from warp_reflect.settings import Status

WIDTH, HEIGHT = 80, 60
MIRROR = (slice(10, 50), slice(15, 65))


def plane_field(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """What a plane mirror z = 0 shows of the plane z = 5 + 0.3 x to an eye at (0, 0, 3), in closed form.

    The mirrored eye (0, 0, -3) looks along (u, v, 1) through the mirror point (3u, 3v, 0).
    """
    u, v = (x - 40.0) / 50.0, (y - 30.0) / 50.0
    t = 8.0 / (1.0 - 0.3 * u)
    return np.stack([u * t, v * t, t - 3.0], axis=-1)


def frame(field=plane_field, shift=(0.0, 0.0), **changes) -> dict:
    """A frame of one mirror and one prim; what belongs at pixel p is shown at p + shift."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    inside = np.zeros((HEIGHT, WIDTH), bool)
    inside[MIRROR] = True
    points = field(column - shift[0], row - shift[1]) * inside[..., None]
    length = np.linalg.norm(points - [0.0, 0.0, -3.0], axis=-1) * inside
    channels = {
        "reflectorId": inside * 1.0,
        "reflectedId": inside * 7.0,
        "status": inside * float(Status.CONVERGED),
        "pathLength": length,
        "reflectedPoint": points,
        "R": inside * 0.5,
        "G": inside * 0.25,
        "B": inside * 0.125,
    }
    channels.update(changes)
    return {name: np.asarray(values, np.float32) for name, values in channels.items()}


def test_equal_frames_are_identical_everywhere():
    result = compare_frames(frame(), frame())
    assert result.interior_pixels == 38 * 48
    assert result.border_pixels == 40 * 50 - 38 * 48
    assert result.mirror_pixels == 40 * 50
    assert (result.identical, result.border_identical) == (result.interior_pixels, result.border_pixels)
    assert (result.wrong, result.shifted, result.unmatched, result.unanswered) == (0, 0, 0, 0)
    assert (result.error_max_px, result.psnr_db, result.mean_abs) == (0.0, None, 0.0)
    assert result.within_half_px == result.interior_pixels


@pytest.mark.parametrize("shift", [(0.02, 0.0), (0.3, -0.4), (-2.0, 1.5), (6.3, 5.1)])
def test_pixel_error_of_plane_mirror_is_the_shift(shift):
    result = compare_frames(frame(shift=shift), frame())
    assert result.identical == 0
    expected = np.hypot(*shift)
    # What moved in over the rim is shown nowhere in the reference; all the rest is found.
    rim = 1 + int(np.ceil(max(abs(shift[0]), abs(shift[1]))))
    middle = result.classes[10 + rim : 50 - rim, 15 + rim : 65 - rim]
    assert (middle == PixelClass.SHIFTED).all()
    errors = result.error_px[10 + rim : 50 - rim, 15 + rim : 65 - rim]
    # Linear between pixels: off by the field's curvature, 2e-3 px here, and by the end of the search.
    assert np.abs(errors - expected).max() < 5e-3
    assert result.error_median_px == pytest.approx(expected, abs=5e-3)
    assert result.shifted + result.unmatched == result.interior_pixels


@pytest.mark.parametrize("lookup_pixels", [4096, 100])
def test_pixel_error_finds_points_far_away(monkeypatch, lookup_pixels):
    """A block of pixels shows what belongs 30 pixels further right, beyond another prim."""
    monkeypatch.setattr(metrics, "LOOKUP_PIXELS", lookup_pixels)
    reference = frame()
    reference["reflectedId"][MIRROR[0], 38:42] = 8  # no slope leads across it
    points = reference["reflectedPoint"].copy()
    points[20:30, 20:30] = reference["reflectedPoint"][20:30, 50:60]
    result = compare_frames({**reference, "reflectedPoint": points}, reference)
    assert result.shifted == 100
    assert result.error_max_px == pytest.approx(30.0, abs=0.01)
    assert result.error_median_px == pytest.approx(30.0, abs=0.01)
    assert result.within_half_px == result.interior_pixels - 100


def test_pixel_error_crosses_a_silhouette_within_one_prim():
    """Two walls of one prim, 40 apart in depth: slopes must not be taken across the edge at column 40.5."""

    def walls(x, y):
        near = np.stack([x * 0.1, y * 0.1, np.full(x.shape, 2.0)], axis=-1)
        far = np.stack([x * 0.5, y * 0.5, np.full(x.shape, 42.0)], axis=-1)
        return np.where((x < 40.5)[..., None], near, far)

    result = compare_frames(frame(walls, shift=(0.25, 0.0)), frame(walls))
    assert result.shifted == result.interior_pixels
    assert result.error_max_px == pytest.approx(0.25, abs=1e-3)

    points = frame(walls)["reflectedPoint"].copy()
    points[30, 20:60] = [3.0, 3.0, 20.0]  # between the walls, where the reference shows nothing
    result = compare_frames(frame(walls, reflectedPoint=points), frame(walls))
    assert (result.classes[30, 20:60] == PixelClass.UNMATCHED).all()
    assert (result.unmatched, result.shifted) == (40, 0)


def test_pixel_error_on_magnified_and_tiny_scales():
    for scale in (1e-4, 1.0, 1e5):
        result = compare_frames(
            {**frame(shift=(0.4, 0.0)), **scaled(frame(shift=(0.4, 0.0)), scale)},
            {**frame(), **scaled(frame(), scale)},
        )
        assert result.error_median_px == pytest.approx(0.4, abs=5e-3)


def scaled(channels: dict, scale: float) -> dict:
    return {name: channels[name] * np.float32(scale) for name in ("reflectedPoint", "pathLength")}


def test_identical_hit_limit_is_a_share_of_the_path():
    reference = frame()
    for share, same in ((0.9e-4, True), (1.1e-4, False)):
        points = reference["reflectedPoint"].astype(np.float64)
        points[..., 1] += share * reference["pathLength"]
        result = compare_frames(frame(reflectedPoint=points), reference)
        assert (result.identical == result.interior_pixels) is same


def test_world_points_far_from_the_origin_keep_their_rounding():
    """At 1e6 float32 steps by 1/16: two roundings of one point are one hit, ten steps are not."""
    offset = np.float32(1e6)
    reference = frame()
    reference["reflectedPoint"] = reference["reflectedPoint"] + offset
    other = dict(reference, reflectedPoint=reference["reflectedPoint"] + np.float32(0.0625))
    assert compare_frames(other, reference).identical == 38 * 48
    other = dict(reference, reflectedPoint=reference["reflectedPoint"] + np.float32(0.625))
    assert compare_frames(other, reference).identical == 0


def test_wrong_sky_and_unanswered_are_told_apart():
    reference = frame()
    reflected, status = reference["reflectedId"].copy(), reference["status"].copy()
    reflected[20, 20:30] = 8  # another prim
    reflected[21, 20:24], status[21, 20:24] = 0, Status.SKY  # sky instead of the prim
    reflected[22, 20:22], status[22, 20:22] = 0, Status.MAX_ITERATIONS
    result = compare_frames(frame(reflectedId=reflected, status=status), reference)
    assert (result.wrong, result.unanswered) == (14, 2)
    assert result.identical == result.interior_pixels - 16
    both = frame(reflectedId=reflected, status=status)
    again = compare_frames(both, both)
    assert (again.wrong, again.unanswered) == (0, 2)
    assert again.identical == again.interior_pixels - 2


def test_border_counts_another_mirror_as_wrong():
    reference = frame()
    reflector = reference["reflectorId"].copy()
    reflector[30:, :] *= 2
    result = compare_frames(frame(reflectorId=reflector), reference)
    assert result.interior_pixels == 18 * 48  # rows 11 to 28: row 29 touches the other mirror
    assert result.border_wrong == 20 * 50
    assert result.wrong == 0


def test_points_that_are_not_finite_are_unanswered():
    points = frame()["reflectedPoint"].copy()
    points[30, 30], points[31, 31] = np.nan, np.inf
    result = compare_frames(frame(reflectedPoint=points), frame())
    assert result.unanswered == 2
    assert result.identical == result.interior_pixels - 2


def test_picture_error_is_psnr_of_what_is_shown():
    darker = frame(R=frame()["R"] * 0.0)
    result = compare_frames(darker, frame())
    share = 40 * 50 / (WIDTH * HEIGHT)
    assert result.mean_abs == pytest.approx(0.5 * share / 3.0)
    encoded = 1.055 * 0.5 ** (1.0 / 2.4) - 0.055
    assert result.psnr_db == pytest.approx(-10.0 * np.log10(encoded**2 * share / 3.0), abs=1e-4)


def test_comparison_is_json_and_text():
    result = compare_frames(frame(shift=(0.3, 0.0)), frame())
    numbers = json.loads(json.dumps(result.to_json(), allow_nan=False))
    assert numbers["identical_share"] == 0.0
    assert numbers["shifted"] + numbers["unmatched"] == numbers["interior_pixels"]
    assert "pixel error median 0.3" in str(result)


def test_frames_that_cannot_be_compared_are_refused():
    small = {name: values[:30] for name, values in frame().items()}
    with pytest.raises(ValueError, match="80x60 and 80x30"):
        compare_frames(frame(), small)
    lacking = frame()
    del lacking["reflectedPoint"]
    with pytest.raises(ValueError, match="lacks the channel 'reflectedPoint'"):
        compare_frames(lacking, frame())


def test_frames_without_mirrors_compare_as_pictures():
    nothing = frame(reflectorId=np.zeros((HEIGHT, WIDTH)))
    result = compare_frames(nothing, nothing)
    assert (result.mirror_pixels, result.error_max_px) == (0, 0.0)
    assert result.to_json()["identical_share"] == 0.0
