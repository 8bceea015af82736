"""Stripes of two directions: points of both, sigmas that are true, and wrong codes found out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from stripe_rendering import rms

from bodyscan.arrays import Array
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.calibration.projector_camera import sheets_from_projector
from bodyscan.errors import BadInput
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.opencv import Radial
from bodyscan.geometry.light_planes import Axis, LightPlanes
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.reconstruction.triangulation import (
    Depths,
    combine_directions,
    reconstruct_range_image,
)
from bodyscan.stripes.stripe_map import StripeMap

WIDTH, HEIGHT = 160, 120
CAMERA = Camera(400.0, 400.0, 0.0, 79.5, 59.5, Radial(0.0, 0.0), WIDTH, HEIGHT)
FOCAL, CENTRE, SIZE = 420.0, (99.5, 79.5), (200, 160)
PLACE = RigidTransform.from_rotation_vector([-0.15, 0.25, 0.02], [-180.0, -110.0, 10.0])
WAYS: tuple[Axis, Axis] = ("vertical", "horizontal")
SIGMA = 0.05
FIELDS = (np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.float32))


def pair(*, crossing: bool = True) -> PairCalibration:
    light = Camera(FOCAL, FOCAL, 0.0, *CENTRE, Radial(0.0, 0.0), *SIZE)
    columns, rows = (
        sheets_from_projector(light, PLACE, np.array([0.0, 0.0, 700.0]), size, way)
        for size, way in zip(SIZE, WAYS, strict=True)
    )
    known = PairQuality(0.1, 5)
    return PairCalibration(
        "p", CAMERA, np.zeros((7, 7)), columns, known, rows if crossing else None
    )


def surface() -> Array:
    """(H, W, 3) of a bowl 0.7 m away."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    x, y = (u - 79.5) / 400.0, (v - 59.5) / 400.0
    z = 700.0 + 300.0 * x + 900.0 * (x * x + y * y)
    return np.stack([x * z, y * z, z], axis=-1)


def stripes() -> StripeMap:
    """What a projector's columns and rows show there, by the pinhole's formula, with noise."""
    rng = np.random.default_rng(1)
    away = surface() @ PLACE.rotation.T + PLACE.translation
    lit = np.full((HEIGHT, WIDTH), 200, np.uint8)
    maps = []
    for axis in (0, 1):
        true = FOCAL * away[..., axis] / away[..., 2] + CENTRE[axis] + 0.5
        s = (true + SIGMA * rng.standard_normal(true.shape)).astype(np.float32)
        sigma = np.full(s.shape, SIGMA, np.float32)
        maps.append(StripeMap(s, sigma, lit, *FIELDS, SIZE[axis]))
    return replace(maps[0], crossing=maps[1])


def errors(image: RangeImage) -> Array:
    """(N,) along the viewing rays, mm."""
    off = np.linalg.norm(image.points, axis=-1) - np.linalg.norm(surface(), axis=-1)
    return np.asarray(off[image.valid])


def test_points_of_both_ways_are_better_than_of_either_and_say_by_how_much() -> None:
    seen = stripes()
    assert seen.crossing is not None
    both = reconstruct_range_image(pair(), seen)
    columns = reconstruct_range_image(pair(), replace(seen, crossing=None))
    calibrated = pair()
    turned = replace(calibrated, sheets=calibrated.crossing, crossing=None)
    rows = reconstruct_range_image(turned, seen.crossing)
    assert columns.agreement is None
    # Two independent measurements: weights 1 / variance.
    predicted = (rms(errors(columns)) ** -2 + rms(errors(rows)) ** -2) ** -0.5
    assert abs(rms(errors(both)) / predicted - 1.0) < 0.03
    # 19,200 pixels tell the RMS to half a percent.
    assert abs(rms(errors(both) / both.sigma_mm[both.valid]) - 1.0) < 0.03
    assert both.agreement is not None
    assert abs(both.agreement.offset_sigmas - 1.0) < 0.03
    assert both.valid.sum() > HEIGHT * WIDTH - 3  # beyond 5 sigmas


def test_noise_is_alike_along_the_way_across_stripes_but_hardly_of_two_ways_together() -> None:
    seen = replace(stripes(), correlation_px=(0.0, 4.0))
    assert reconstruct_range_image(pair(), replace(seen, crossing=None)).correlation_px == (
        0.0,
        4.0,
    )
    assert reconstruct_range_image(pair(), seen).correlation_px == (0.0, 0.0)


def test_wrong_codes_disagree_and_are_left_out() -> None:
    seen = stripes()
    s = seen.s.copy()
    s[40:60, 30:50] += 8.0  # as a wrong coarse bit would
    image = reconstruct_range_image(pair(), replace(seen, s=s))
    assert not image.valid[40:60, 30:50].any()
    assert image.valid.sum() > HEIGHT * WIDTH - 403


def test_a_calibration_that_is_off_everywhere_costs_no_pixels() -> None:
    """As of other programs, whose sigmas are not known: rows 0.5 stripes, ten sigmas, off."""
    seen = stripes()
    assert seen.crossing is not None
    off = replace(seen, crossing=replace(seen.crossing, s=seen.crossing.s + np.float32(0.5)))
    image = reconstruct_range_image(pair(), off)
    assert image.agreement is not None
    assert image.agreement.offset_sigmas > 5.0
    assert image.valid.all()


def test_one_way_tells_where_the_other_does_not() -> None:
    seen = stripes()
    s = seen.s.copy()
    s[:, :40] = np.nan
    alone = reconstruct_range_image(pair(), replace(seen, s=s))
    assert alone.valid.all()
    nothing = np.zeros(s.shape, bool)
    limited = reconstruct_range_image(pair(), replace(seen, s=s, beyond=nothing))
    assert not limited.valid[:, :40].any(), "crossing stripes are not limited to the volume"
    without = reconstruct_range_image(pair(crossing=False), replace(seen, s=s))
    assert without.agreement is None
    assert not without.valid[:, :40].any()


def test_ways_that_differ_by_more_than_their_sigmas_are_not_averaged() -> None:
    """Rows across a baseline of columns: 9 times the noise, and more of a calibration's error, which
    no sigma knows of."""
    shape = (HEIGHT, WIDTH)
    points = surface().astype(np.float32)
    wrong = points * np.float32(1.005)
    fine, rough = np.full(shape, 0.1, np.float32), np.full(shape, 0.9, np.float32)
    nowhere = np.zeros(shape, bool)
    none = np.zeros(shape, np.float32)
    better, worse = (points, fine, none), (wrong, rough, none)
    (found, sigma_mm, _), _ = combine_directions(better, worse, alone=nowhere)
    np.testing.assert_array_equal(found, points)
    np.testing.assert_array_equal(sigma_mm, fine)
    (swapped, sigma_mm, _), _ = combine_directions(worse, better, alone=nowhere)
    np.testing.assert_allclose(swapped, points, rtol=1e-6)
    np.testing.assert_allclose(sigma_mm, fine, rtol=1e-6)


def shifted(stripes_off: float) -> StripeMap:
    """Rows that far from where the calibration has them."""
    seen = stripes()
    assert seen.crossing is not None
    s = seen.crossing.s + np.float32(stripes_off)
    return replace(seen, crossing=replace(seen.crossing, s=s))


@pytest.mark.parametrize(("off", "unusual"), [(0.05, False), (2.0, True)])
def test_what_a_calibration_is_off_is_told_in_stripes(off: float, unusual: bool) -> None:
    """Limits are 0.3 and 3 of 160 rows."""
    agreement = reconstruct_range_image(pair(), shifted(off)).agreement
    assert agreement is not None
    assert agreement.unusual == unusual
    assert f"{agreement.offset_stripes:.1f} of 160 stripes" in agreement.description
    if unusual:  # 1.48 medians, and columns' noise
        assert abs(agreement.offset_stripes / (1.4826 * off) - 1.0) < 0.05


OURS, THEIRS = PairQuality(0.1, 5), PairQuality(None, 0, imported="its file")


@pytest.mark.parametrize(
    ("quality", "remedy"), [(OURS, "calibrate again: camera or projector"), (THEIRS, "inverse")]
)
def test_a_calibration_that_is_wrong_is_refused(quality: PairQuality, remedy: str) -> None:
    with pytest.raises(
        BadInput, match=rf"does not fit these stripes: the directions differ.*\n.*{remedy}"
    ):
        reconstruct_range_image(replace(pair(), quality=quality), shifted(20.0))


@pytest.mark.parametrize(
    ("quality", "remedy"), [(OURS, "calibrate again: camera or projector"), (THEIRS, "inverse")]
)
def test_sheets_that_meet_nowhere_are_refused(quality: PairQuality, remedy: str) -> None:
    """Rows' light that shines the other way has no sheet before the camera."""
    light = Camera(FOCAL, FOCAL, 0.0, *CENTRE, Radial(0.0, 0.0), *SIZE)
    away = RigidTransform(PLACE.rotation, np.array([0.0, 0.0, -9000.0]))
    rows = sheets_from_projector(light, away, np.array([0.0, 0.0, 700.0]), SIZE[1], "horizontal")
    with pytest.raises(
        BadInput, match=rf"does not fit these stripes.*, 0 meet both light sheets\n.*{remedy}"
    ):
        reconstruct_range_image(replace(pair(), crossing=rows, quality=quality), stripes())


def planes_of_rows(*, d_mm: float = 0.0) -> LightPlanes:
    """The rows' sheets as the chapter's planes, of which d is known to that many mm."""
    rows = pair().crossing
    assert rows is not None
    coefficients = rows.tangent_planes(np.arange(SIZE[1] + 1.0))
    covariance = np.tile(np.diag([0.0, 0.0, 0.0, d_mm**2]), (SIZE[1] + 1, 1, 1))
    return LightPlanes(coefficients, covariance, "horizontal")


def test_stripes_that_no_board_has_shown_are_no_contradiction() -> None:
    """Our own calibration may know no sheet where the other direction's measure, or only guess."""
    known = planes_of_rows()
    agreement = reconstruct_range_image(replace(pair(), crossing=known), stripes()).agreement
    assert agreement is not None
    assert agreement.offset_sigmas < 1.1
    elsewhere = known.coefficients.copy()
    elsewhere[5:] = np.nan
    for rows in (replace(known, coefficients=elsewhere), planes_of_rows(d_mm=50.0)):
        image = reconstruct_range_image(replace(pair(), crossing=rows), stripes())
        assert image.agreement is None
        assert image.valid.all()
        assert rms(errors(image) / image.sigma_mm[image.valid]) < 1.03


def test_a_way_off_by_five_sigmas_is_dropped_where_most_agree_better_than_they_claim() -> None:
    """Of most the sigmas claim too much, by ten; what those hold is no reason to drop a point."""
    rays = np.tile([0.0, 0.0, 1.0], (10, 20, 1)).astype(np.float32)
    sigma = np.full((10, 20), 1.0, np.float32)
    noise = 0.1 * np.random.default_rng(0).standard_normal((10, 20, 1)).astype(np.float32)
    crossing = rays * (700.0 + noise)
    crossing[3, 4] = rays[3, 4] * (700.0 + 4.9 * np.sqrt(2.0))
    crossing[5, 6] = rays[5, 6] * (700.0 - 5.1 * np.sqrt(2.0))
    nowhere = np.zeros((10, 20), bool)
    none = np.zeros_like(sigma)
    own, other = (rays * np.float32(700.0), sigma, none), (crossing, sigma, none)
    (_, sigma_mm, _), sigmas = combine_directions(own, other, alone=nowhere)
    assert np.isnan(sigma_mm).sum() == 1
    assert np.isnan(sigma_mm[5, 6])
    np.testing.assert_allclose(sigma_mm[np.isfinite(sigma_mm)], np.sqrt(0.5), rtol=1e-6)
    assert sigmas is not None
    assert sigmas < 0.2
    few = np.where(np.arange(200).reshape(10, 20) < 99, sigma, np.float32(np.nan))
    assert combine_directions((own[0], few, none), other, alone=nowhere)[1] is None


@pytest.mark.parametrize("alike", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(("noise_mm", "rows_mm"), [(0.3, 0.6), (0.3, 5.0), (2.0, 1.5), (0.01, 1.1)])
def test_two_ways_are_never_worse_than_the_better_however_much_they_share(
    alike: float, noise_mm: float, rows_mm: float
) -> None:
    """Columns have 0.3 mm of noise and 1 mm of calibration error, rows as given; of the calibration
    errors `alike` is one and the same."""
    rng, shape = np.random.default_rng(0), (10, 20)
    error, stated = [], []
    for _ in range(1000):
        same, *own = rng.standard_normal(3)

        def measured(noise: float, common: float, one: float, same: float = same) -> Depths:
            shared = common * (np.sqrt(alike) * same + np.sqrt(1.0 - alike) * one)
            off = shared + noise * rng.standard_normal(shape)
            points = np.stack([0.0 * off, 0.0 * off, 1000.0 + off], axis=-1).astype(np.float32)
            flat = np.ones(shape, np.float32)
            return points, np.float32(np.hypot(noise, common)) * flat, np.float32(common) * flat

        ways = measured(0.3, 1.0, own[0]), measured(noise_mm, rows_mm, own[1])
        (points, sigma_mm, _), _ = combine_directions(*ways, alone=np.zeros(shape, bool))
        error.append(np.nanmean((points[..., 2] - 1000.0) ** 2))
        stated.append(np.nanmean(sigma_mm**2))
    better = min(np.hypot(0.3, 1.0), np.hypot(noise_mm, rows_mm))
    assert np.sqrt(np.mean(error)) < 1.02 * better
    # The sigma holds for errors that are all alike, and is never too small.
    assert np.sqrt(np.mean(error) / np.mean(stated)) < 1.1
    assert np.sqrt(np.mean(error) / np.mean(stated)) > (0.9 if alike == 1.0 else 0.7)
