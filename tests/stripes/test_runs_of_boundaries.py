"""s between and beside the boundaries of a run, their scatter, and what edges of brightness do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from bodyscan.arrays import Greys, Mask
from bodyscan.stripes.albedo_edges import (
    BoundaryBrightness,
    Brightness,
    correct_across_lines,
    fit_gradient,
)
from bodyscan.stripes.boundaries import Boundaries, find_boundaries
from bodyscan.stripes.scan_lines import ScanLines
from bodyscan.stripes.stripe_coordinates import (
    estimate_scatter,
    interpolate_stripes,
    measure_correlation,
    smooth_runs,
)

WIDTH = 100


def run(
    position: np.ndarray, index: np.ndarray, sigma: float = 0.02, blur2: float = 0.0
) -> Boundaries:
    """On line 1 of two, all joined."""
    line = np.ones(len(position), np.int64)
    return Boundaries(
        line=line,
        before=np.floor(position).astype(np.int64),
        position=position,
        line_position=line.astype(float),
        sigma_px=np.full(len(position), sigma),
        index=index,
        joined=np.ones(len(position) - 1, bool),
        blur2=blur2,
    )


def bent(x: np.ndarray) -> np.ndarray:
    """Stripes of 5 px and, at the end, 2.5: too wide for five of them to be smoothed."""
    return np.asarray(0.2 * x + 0.001 * x**2)


X = np.arange(WIDTH)
INDEX = np.arange(3, 26)
POSITION = -100.0 + np.sqrt(100.0**2 + INDEX / 0.001)


def interpolated(boundaries: Boundaries, off: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """s and sigma of line 1; off: what codes are wrong by."""
    codes = np.tile(np.floor(bent(X)).astype(np.int32) + off, (2, 1))
    s, sigma = interpolate_stripes(boundaries, codes, np.ones(codes.shape, bool))
    assert np.isnan(s[0]).all(), "there is no boundary on line 0"
    return s[1], sigma[1]


def test_s_between_boundaries_on_a_curved_surface_is_exact() -> None:
    s, sigma = interpolated(run(POSITION, INDEX))
    within = (POSITION[1] < X) & (POSITION[-2] > X)
    np.testing.assert_allclose(s[within], bent(X)[within], atol=1e-5)
    # Two boundaries tell a place between them as well as either does.
    width = np.diff(POSITION)[np.searchsorted(POSITION, X[within]) - 1]
    wide = width > 4.0
    np.testing.assert_allclose(sigma[within][wide], 0.02 / width[wide], rtol=1e-5)


def test_s_is_extrapolated_by_up_to_0_4_stripes() -> None:
    s, sigma = interpolated(run(POSITION, INDEX))
    true = bent(X)
    for beside in ((true > 25.0) & (true < 25.4), (true > 2.6) & (true < 3.0)):
        assert beside.any()
        np.testing.assert_allclose(s[beside], true[beside], atol=2e-3)
        assert np.all(sigma[beside] > 2.9 * sigma[(true > 3.0) & (true < 25.0)].min())
    assert np.isnan(s[(true > 25.41) | (true < 2.59)]).all()
    assert np.isnan(sigma[np.isnan(s)]).all()


def test_sigma_of_extrapolated_s_includes_the_curvature() -> None:
    s, sigma = interpolated(run(POSITION, INDEX, sigma=0.002))
    for end, side, segment in ((0, -1.0, 0), (-1, 1.0, -1)):
        away = side * (X - POSITION[end])
        beside = np.isfinite(s) & (away > 0.0)
        assert beside.any()
        alone = 3.0 * 0.002 / np.diff(POSITION)[segment]
        expected = np.hypot(alone, 0.001 * away[beside] ** 2)
        # The last segment's slopes are those of its neighbours: its bend is known to some per cent.
        np.testing.assert_allclose(sigma[beside], expected, rtol=0.02)
        assert expected.max() > (1.2 if end == 0 else 1.0) * alone


def test_s_that_contradicts_the_code_is_nan() -> None:
    s, _ = interpolated(run(POSITION, INDEX), off=1)
    # A code is a sixth of a stripe off at most: what is left lies so near to the next stripe.
    known = np.isfinite(s)
    near = bent(X) % 1.0
    assert known.sum() < 0.3 * WIDTH
    assert np.all(near[known] > 0.85 - 1e-3)
    assert known[(near > 0.85 + 1e-3) & (bent(X) > 3.0) & (bent(X) < 25.0)].all()


def test_bias_by_blur_is_proportional_to_the_curvature() -> None:
    s, _ = interpolated(run(POSITION, INDEX))
    blurred, _ = interpolated(run(POSITION, INDEX, blur2=2.0))
    within = (POSITION[1] < X) & (POSITION[-2] > X)
    # blur^2 / 2 times the second derivative, 0.002.
    np.testing.assert_allclose((s - blurred)[within], 0.002, rtol=0.02)
    beside = np.isfinite(s) & ((POSITION[0] > X) | (POSITION[-1] < X))
    assert beside.sum() > 2
    np.testing.assert_allclose((s - blurred)[beside], 0.002, rtol=0.02)
    most, _ = interpolated(run(POSITION, INDEX, blur2=1000.0))
    np.testing.assert_allclose((s - most)[within & np.isfinite(most)], 0.05, atol=1e-5)


def test_narrow_stripes_are_smoothed_along_their_run() -> None:
    rng = np.random.default_rng(0)
    count, noise = 4000, 0.05
    true = 1.5 * np.arange(count) + 0.3 * np.sin(np.arange(count) / 40.0)
    seen = true + noise * rng.normal(size=count)
    position, sigma = smooth_runs(run(seen, np.arange(count), noise))
    # Seven points: 0.577 of the noise is left; at a run's ends five: 0.697, and one alone: all.
    share = np.sqrt(147.0) / 21.0
    assert np.std((position - true)[3:-3]) == pytest.approx(share * noise, rel=0.03)
    np.testing.assert_allclose(sigma[3:-3], share * noise)
    five = np.sqrt(9 + 144 + 289 + 144 + 9) / 35.0
    np.testing.assert_allclose(sigma[[2, -3]], five * noise)
    np.testing.assert_allclose(sigma[[0, 1, -2, -1]], noise)
    np.testing.assert_array_equal(position[[0, 1, -2, -1]], seen[[0, 1, -2, -1]])


def test_smoothing_stops_at_the_ends_of_runs_and_at_outliers() -> None:
    place = 1.5 * np.arange(40)
    joined = np.ones(39, bool)
    joined[19] = False
    step = place + np.where(np.arange(40) > 19, 0.9, 0.0)
    position, sigma = smooth_runs(replace(run(step, np.arange(40), 0.02), joined=joined))
    np.testing.assert_allclose(position, step, atol=1e-12)
    np.testing.assert_allclose(sigma[[18, 19, 20, 21]], 0.02)
    stray = place.copy()
    stray[10] += 0.3  # the fit would move it by 0.2, ten sigmas
    position, sigma = smooth_runs(run(stray, np.arange(40), 0.02))
    assert position[10] == stray[10]
    assert sigma[10] == 0.02
    # Five boundaries over 12 px and more are not smoothed at all.
    wide = 3.0 * np.arange(40)
    assert np.all(smooth_runs(run(wide, np.arange(40)))[1] == 0.02)


def test_gradient_is_that_of_the_plane_through_usable_pixels() -> None:
    rng = np.random.default_rng(0)
    v, u = np.indices((40, 50))
    image = (2.0 + 0.03 * u - 0.05 * v).astype(np.float32)
    usable: Mask = np.asarray(rng.random(image.shape) < 0.7)
    image[~usable] = 99.0
    along, across = fit_gradient(image, usable)
    assert not along[~usable].any()
    assert not across[~usable].any()
    usable[[0, 1, -2, -1]] = usable[:, [0, 1, -2, -1]] = False  # there may be too few
    np.testing.assert_allclose(along[usable], 0.03, atol=2e-5)
    np.testing.assert_allclose(across[usable], -0.05, atol=2e-5)
    assert not fit_gradient(image, np.zeros_like(usable))[0].any()


def flat_brightness(across: float) -> Brightness:
    shape = (6, 8)
    none = np.zeros(shape, np.float32)
    return Brightness(none, none, np.full(shape, across, np.float32), none)


def test_s_is_corrected_by_blur_times_slope_at_edges_along_the_lines() -> None:
    v, u = np.indices((6, 8))
    s = (3.0 + 0.5 * u + 0.4 * v).astype(np.float32)
    s[3, 5] = np.nan  # its neighbours know one side alone
    sigma = np.full(s.shape, 0.03, np.float32)
    freed, doubt = correct_across_lines(s, sigma, flat_brightness(0.5), 0.6)
    shift = 0.6 * 0.5 * 0.4
    np.testing.assert_allclose(s - freed, np.where(np.isnan(s), np.nan, shift), atol=1e-6)
    np.testing.assert_allclose(doubt[~np.isnan(s)], np.hypot(0.03, 2.0 * 0.3 * shift), rtol=1e-5)
    assert np.isnan(freed[3, 5])
    # By six tenths of a pixel at most, either way.
    freed, _ = correct_across_lines(s, sigma, flat_brightness(5.0), 0.6)
    np.testing.assert_allclose((s - freed)[:2], 0.6 * 0.4, atol=1e-6)
    freed, _ = correct_across_lines(s, sigma, flat_brightness(-5.0), 0.6)
    np.testing.assert_allclose((s - freed)[:2], -0.6 * 0.4, atol=1e-6)
    # What leaps from line to line is no one surface.
    freed, doubt = correct_across_lines(3.0 * s, sigma, flat_brightness(0.5), 0.6)
    np.testing.assert_array_equal(freed, 3.0 * s)
    np.testing.assert_allclose(doubt[0], 0.03, rtol=1e-6)


def edges(along: np.ndarray, sigma: float = 0.01) -> BoundaryBrightness:
    ones = np.ones(len(along))
    return BoundaryBrightness(ones, ones, along, 0.0 * ones, sigma * ones)


def beside_edges(count: int, blur2: float, steep: float = 0.8) -> tuple[float, np.ndarray]:
    """Every fourth boundary on an edge, which pulls it: blur2 as it is found, and the edges."""
    along = np.zeros(4 * count + 1)
    along[2::4] = steep * np.where(np.arange(count) % 2, 1.0, -1.0)
    position = 3.0 * np.arange(len(along)) - blur2 * along
    return edges(along).estimate_blur2(position, np.ones(len(along) - 1, bool)), along


def test_blur_is_estimated_from_a_hundred_boundaries_on_edges() -> None:
    assert beside_edges(100, 0.7)[0] == pytest.approx(0.7)
    assert beside_edges(99, 0.7)[0] == 0.45
    assert beside_edges(100, 2.5)[0] == 2.0
    assert beside_edges(100, -0.3)[0] == 0.0
    # Gentle ones and such as noise may make are no edges.
    assert beside_edges(100, 0.7, steep=0.4)[0] == 0.45
    along = beside_edges(100, 0.7)[1]
    position = 3.0 * np.arange(len(along)) - 0.7 * along
    joined = np.ones(len(along) - 1, bool)
    assert edges(along, 0.2).estimate_blur2(position, joined) == 0.45


@pytest.mark.parametrize("of", [np.uint8, np.float32])
def test_brightness_around_a_boundary_is_lit_minus_dark(of: type) -> None:
    lit: Greys = np.full((8, 20), 120).astype(of)
    lit[:, 10:] = 60
    dark: Greys = np.full((8, 20), 20).astype(of)
    images = ScanLines(lit, dark, lit[None], None, False)
    sharp = Brightness.from_images(images, np.full(256, 1e-6, np.float32), np.ones(lit.shape, bool))
    found = sharp.at_boundaries(np.array([3 * 20 + 4, 3 * 20 + 9]))
    np.testing.assert_allclose(found.before, [100.0, 100.0], rtol=1e-3)
    np.testing.assert_allclose(found.after, [100.0, 40.0], rtol=1e-3)
    np.testing.assert_allclose(found.along, [0.0, np.log(0.4)], atol=1e-3)
    np.testing.assert_allclose(found.across, 0.0, atol=1e-6)
    np.testing.assert_allclose(found.sigma[0], np.sqrt(2.0 * 2e-6) / 100.0, rtol=1e-3)
    # Noise that may explain the step takes it for shading.
    noisy = Brightness.from_images(images, np.full(256, 4e4, np.float32), np.ones(lit.shape, bool))
    assert abs(noisy.at_boundaries(np.array([69])).along[0] - sharp.shading.ravel()[69]) < 0.05


def test_edges_across_lines_are_significant_differences() -> None:
    lit = np.full((20, 8), 120, np.uint8)
    lit[10:] = 60
    images = ScanLines(lit, np.full_like(lit, 20), lit[None], None, False)
    sharp = Brightness.from_images(images, np.full(256, 1e-6, np.float32), np.ones(lit.shape, bool))
    np.testing.assert_allclose(sharp.across[[9, 10], 4], np.log(0.4) / 2.0, rtol=1e-3)
    np.testing.assert_allclose(sharp.across[[4, 15], 4], 0.0, atol=1e-4)


def boundaries_in(stripe: np.ndarray, bright: np.ndarray, more: np.ndarray) -> Boundaries:
    """Of images of stripes in Gray code; more: light in each bit's pattern, not in its inverse."""
    gray, bits = stripe ^ (stripe >> 1), range(len(more))[::-1]
    share = [gaussian_filter1d(((gray >> bit) & 1).astype(float), 1.0, axis=1) for bit in bits]
    parts = np.array(share) + more[:, None, None], 1.0 - np.array(share)
    pattern, inverse = ((10.0 + bright * part).astype(np.float32) for part in parts)
    dark, lit = np.full(bright.shape, 10.0, np.float32), (10.0 + bright).astype(np.float32)
    images = ScanLines.from_images(lit, dark, pattern, inverse, "vertical")
    variance, usable = np.full(256, 1e-4, np.float32), np.ones(bright.shape, bool)
    brightness = Brightness.from_images(images, variance, usable)
    return find_boundaries(images, brightness, stripe, usable, variance)


def test_light_that_reached_the_patterns_alone_moves_no_boundary() -> None:
    stripe = np.tile(np.arange(320, dtype=np.int32) // 5, (60, 1))
    more = np.array([0.0, 0.02, -0.02, 0.02, 0.01, -0.03])
    found = boundaries_in(stripe, np.full(stripe.shape, 100.0), more)
    off = (found.position - (5.0 * found.index - 0.5))[found.index % 8 > 0]  # of fine bits
    assert np.sqrt(np.mean(off**2)) < 0.01, "0.03 without"


@pytest.mark.parametrize(
    ("down", "right"), [(0.08, 0.0), (-0.08, 0.0), (0.0, 0.005), (0.0, -0.005)]
)
def test_boundaries_are_shifted_to_the_centroid_of_the_light(down: float, right: float) -> None:
    """A surface that gets brighter by so much from pixel to pixel, as a logarithm, shows more of its
    bright side: by the lens' usual blur squared, towards it."""
    line, place = np.mgrid[:15, :160].astype(float)
    bright = 100.0 * np.exp(down * (line - 7.0) + right * (place - 80.0))
    found = boundaries_in(np.floor(place / 20.0).astype(np.int32), bright, np.zeros(3))
    assert found.blur2 == 0.45, "no edge tells another"
    assert found.index.reshape(15, 7).tolist() == [[1, 2, 3, 4, 5, 6, 7]] * 15
    inner = (found.line > 0) & (found.line < 14)
    # Pixel 19 is the last of stripe 0: half a pixel behind its middle.  Greys are not rounded.
    np.testing.assert_allclose((found.line_position - found.line)[inner], 0.45 * down, atol=1e-3)
    moved = found.position - (20.0 * found.index - 0.5)
    np.testing.assert_allclose(moved[inner], 0.45 * right, atol=1e-3)


@pytest.mark.parametrize("width", [2.2, 5.0])
def test_correlation_length_of_noise_along_lines(width: float) -> None:
    """As measured on many runs of noisy boundaries: narrow stripes are smoothed, wide ones are not."""
    rng, index = np.random.default_rng(2), np.arange(int(WIDTH / width) - 1)
    even, codes = (index + 1) * width, np.floor(X / width).astype(np.int32) - 1
    off = []
    for _ in range(400):
        boundaries = run(even + 0.05 * rng.normal(size=len(index)), index, 0.05)
        s, _ = interpolate_stripes(boundaries, np.tile(codes, (2, 1)), np.ones((2, WIDTH), bool))
        off.append(s[1, 20:80] - (X[20:80] / width - 1))
    alike = measure_correlation(boundaries)
    seen = np.array([np.mean([o[: 60 - k] * o[k:] for o in off]) for k in range(16)])
    line = np.maximum(0.0, 1.0 - np.arange(16) / alike)
    np.testing.assert_allclose(seen / seen[0], line, atol=0.16)
    assert measure_correlation(run(even[:1], index[:1])) == 0.0


def boundaries(count: int, *, claimed: float, line: int | None = None) -> Boundaries:
    """Runs of so many boundaries (all, where line is None) that lie 0.05 px off a parabola."""
    number = np.arange(count)
    along = number % (line or count)
    noise = 0.05 * np.random.default_rng(0).standard_normal(count)
    return Boundaries(
        line=number // (line or count),
        before=np.floor(2.0 * along).astype(np.int64),
        position=30.0 + 2.0 * along + 1e-6 * along**2 + noise,
        line_position=np.zeros(count),
        sigma_px=np.full(count, claimed),
        index=along + 1,
        joined=along[1:] > 0,
        blur2=0.0,
    )


def test_ratio_of_observed_to_predicted_scatter() -> None:
    # Of 10,000 overlapping fives the robust ratio is known to 2 %.
    for times in (0.5, 1.0, 1.1):
        assert estimate_scatter(boundaries(10_000, claimed=0.05 / times)) == 1.0
    for times in (1.3, 2.0, 4.0):
        assert estimate_scatter(boundaries(10_000, claimed=0.05 / times)) == pytest.approx(
            times, rel=0.05
        )


def test_a_thousand_runs_of_five_are_needed() -> None:
    assert estimate_scatter(boundaries(1004, claimed=0.02)) > 2.0
    assert estimate_scatter(boundaries(1003, claimed=0.02)) == 1.0
    assert estimate_scatter(boundaries(4, claimed=0.02)) == 1.0
    # Of lines of twelve, eight starts each.
    assert estimate_scatter(boundaries(12 * 125, claimed=0.02, line=12)) > 2.0
    assert estimate_scatter(boundaries(12 * 125 - 1, claimed=0.02, line=12)) == 1.0
