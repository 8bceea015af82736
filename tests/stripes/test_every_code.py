"""Stripe coordinates by every code on rendered surfaces whose stripe coordinate is known."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from stripe_rendering import Field, boundary_errors, checkered, code_light, render, rms, wavy

from bodyscan.arrays import Array, Bytes, Indices
from bodyscan.errors import DecodingFailed
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.stripes.codes import parse_stripe_code
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_limits import StripeLimits
from bodyscan.stripes.stripe_map import StripeMap

GRAY = {"code": "gray"}
PLAIN_GRAY = {"code": "gray", "inverses": False}
BINARY = {"code": "binary"}
PLAIN_BINARY = {"code": "binary", "inverses": False}
SECTION = {"code": "light-section"}
INDEX = {"code": "stripe-index"}
PHASE = {"code": "phase-shift", "steps": 4, "period": 8}
THREE_PHASES = {"code": "phase-shift", "steps": 3, "period": 16, "inverses": False}
LONG_WAVES = {"code": "phase-shift", "steps": 3, "period": (10.0, 60.0)}
ALL = [PLAIN_GRAY, BINARY, PLAIN_BINARY, SECTION, INDEX, PHASE, THREE_PHASES]


Code = dict[str, Any]  # as a rig file gives it


def name(value: object) -> str | None:
    if not isinstance(value, dict):
        return None
    return "-".join(str(part) for part in value.values())


def spec_of(code: Code, stripes: int, direction: Axis = "horizontal") -> StripeCode:
    return parse_stripe_code({**code, "stripes": stripes, "direction": direction})


def captured(
    code: Code, s_at: Field, stripes: int, **scene: Any
) -> tuple[Bytes, Bytes, Bytes, Array]:
    """Lit, dark, coded images and the true s at pixel centres."""
    scene = {"shape": (110, 140), **scene}
    if code["code"] != "stripe-index":
        return render(s_at, code_light(stripes=stripes, **code), stripes=stripes, **scene)
    lit, dark, _, s = render(s_at, np.zeros((1, stripes)), stripes=stripes, **scene)
    number = np.where(np.isfinite(s), np.nan_to_num(s).astype(int) + 1, 0)
    return lit, dark, number.astype(np.uint8)[None], s


def read(code: Code, images: tuple[Bytes, Bytes, Bytes, Array], stripes: int) -> StripeMap:
    lit, dark, coded, _ = images
    return decode_stripes(spec_of(code, stripes), lit, dark, coded)


# Noise of 1 in 180 grey levels, stripes of 2.2 px blurred by 0.25 stripes and 0.6 px. Tolerances
# are about 1.4 times what was measured.
@pytest.mark.parametrize(
    ("code", "s_rms", "boundary_px", "share"),
    [
        (GRAY, 0.007, 0.017, 0.97),
        (PLAIN_GRAY, 0.008, 0.024, 0.97),
        (BINARY, 0.008, 0.024, 0.94),
        (PLAIN_BINARY, 0.01, 0.03, 0.92),
        (SECTION, 0.018, 0.036, 0.99),
        # A place known to a pixel only: uniform within 1 px, 0.29.
        (INDEX, 0.14, 0.3, 0.99),
        (PHASE, 0.021, 0.032, 0.99),
        # Noise of sqrt(2 / 3) / 90 of a radian, period / 2 pi of it: 0.023.
        (THREE_PHASES, 0.035, 0.065, 0.99),
    ],
    ids=name,
)
def test_s_and_boundaries_are_where_they_should_be(
    code: Code, s_rms: float, boundary_px: float, share: float
) -> None:
    s_at = wavy(2.2)
    images = captured(code, s_at, 60)
    seen = read(code, images, 60)
    error = (seen.s - images[3])[np.isfinite(images[3]) & np.isfinite(seen.s)]
    assert len(error) > share * np.isfinite(images[3]).sum()
    assert rms(error) < s_rms
    assert abs(error.mean()) < 0.1 * s_rms + 0.001
    assert rms(boundary_errors(seen, s_at)) < boundary_px
    assert len(seen.boundary_index) > share * 140 * 49  # 49 boundaries on each of 140 lines
    np.testing.assert_array_equal(np.isnan(seen.s), np.isnan(seen.sigma))
    assert seen.stripes == 60


@pytest.mark.parametrize("stripe_px", [1.5, 10.0])
@pytest.mark.parametrize(
    ("code", "s_rms"), [(SECTION, (0.024, 0.018)), (PHASE, (0.027, 0.016))], ids=name
)
def test_narrow_and_wide_stripes_are_read_too(
    code: Code, s_rms: tuple[float, float], stripe_px: float
) -> None:
    stripes = int(140 / stripe_px)
    images = captured(code, wavy(stripe_px), stripes)
    seen = read(code, images, stripes)
    error = (seen.s - images[3])[np.isfinite(images[3]) & np.isfinite(seen.s)]
    # The last stripe of a light section has no image behind it to tell s by.
    assert len(error) > (0.98 - stripe_px / 110) * np.isfinite(images[3]).sum()
    assert rms(error) < s_rms[stripe_px > 5]


@pytest.mark.parametrize("code", [GRAY, PLAIN_GRAY, SECTION, PHASE, THREE_PHASES], ids=name)
def test_sigmas_match_errors_in_dim_light(code: Code) -> None:
    s_at, light = wavy(3.0), 40.0
    images = captured(code, s_at, 50, light=light)
    seen = read(code, images, 50)
    known = np.isfinite(images[3]) & np.isfinite(seen.s)
    assert known.sum() > 0.98 * np.isfinite(images[3]).sum()
    # 1 would be perfect; the variance of grey levels is found a little too large.
    assert 0.5 < estimate_robust_scale((seen.s - images[3])[known] / seen.sigma[known]) < 1.4
    assert 0.55 < estimate_robust_scale(boundary_errors(seen, s_at) / seen.boundary_sigma_px) < 1.4


@pytest.mark.parametrize(
    ("code", "untouched", "corrected"),
    [(GRAY, 0.07, 0.03), (SECTION, 0.16, 0.12), (PHASE, 0.13, 0.1)],
    ids=name,
)
def test_edges_of_brightness_are_corrected(code: Code, untouched: float, corrected: float) -> None:
    images = captured(code, wavy(2.2), 60, albedo=checkered(24))
    seen = read(code, images, 60)
    error = (seen.s - images[3])[np.isfinite(images[3]) & np.isfinite(seen.s)]
    assert rms(error) < corrected < untouched
    assert len(error) > 0.97 * np.isfinite(images[3]).sum()


@pytest.mark.parametrize("code", [GRAY, *ALL], ids=name)
def test_vertical_stripes_are_horizontal_ones_transposed(code: Code) -> None:
    images = captured(code, wavy(3.0), 64, shape=(120, 140))
    seen = read(code, images, 64)
    lit, dark, coded = images[0].T, images[1].T, images[2].transpose(0, 2, 1)
    turned = decode_stripes(
        spec_of(code, 64, "vertical"), *map(np.ascontiguousarray, (lit, dark, coded))
    )
    np.testing.assert_array_equal(turned.s.T, seen.s)
    np.testing.assert_array_equal(turned.sigma.T, seen.sigma)
    np.testing.assert_array_equal(turned.boundary_pixels[:, ::-1], seen.boundary_pixels)
    assert turned.correlation_px == seen.correlation_px[::-1]


@pytest.mark.parametrize("direction", ["horizontal", "vertical"])
@pytest.mark.parametrize("code", [GRAY, *(each for each in ALL if each is not INDEX)], ids=name)
def test_projected_patterns_are_decoded_to_their_stripes(code: Code, direction: Axis) -> None:
    spec = spec_of(code, 40, direction)
    coded = spec.pattern_images(120, 160) // 2 + 20
    assert len(coded) == sum(spec.image_counts.values())
    lit = np.full((160, 120), 147, np.uint8)
    seen = decode_stripes(spec, lit, np.full_like(lit, 20), np.ascontiguousarray(coded))
    pixel = np.arange(160 if direction == "horizontal" else 120)
    true = (pixel + 0.5) / (len(pixel) / 40)
    true = np.broadcast_to(true[:, None] if direction == "horizontal" else true, lit.shape)
    known = np.isfinite(seen.s)
    assert known.mean() > 0.86
    # Light that is not blurred at all says at which pixels a boundary lies between, and no more:
    # s is right to half a pixel of 3 or 4 a stripe.
    # A pixel that lies between no two boundaries says so by its sigma.
    assert np.all(np.abs(seen.s - true)[known] < np.maximum(0.17, 2.0 * seen.sigma[known]))


@pytest.mark.parametrize("code", [GRAY, SECTION, PHASE, INDEX], ids=name)
def test_a_depth_jump_gives_no_values_in_between(code: Code) -> None:
    near = wavy(2.2)

    def far(u: Array | Indices, v: Array | Indices) -> Array:
        return near(u, v) + 17.3

    def s_at(u: Array | Indices, v: Array | Indices) -> Array:
        return np.where((u - 70) ** 2 + (v - 55) ** 2 < 35**2, near(u, v), far(u, v))

    seen = read(code, captured(code, s_at, 80), 80)
    v, u = np.nonzero(np.isfinite(seen.s))
    nearest = np.minimum(np.abs(seen.s[v, u] - near(u, v)), np.abs(seen.s[v, u] - far(u, v)))
    everywhere = s_at(*np.meshgrid(np.arange(140), np.arange(110)))
    assert len(nearest) > 0.9 * np.isfinite(everywhere).sum()
    # A mixed pixel would lie anywhere between surfaces 17.3 stripes apart.
    assert (nearest > 1.0).sum() == 0


def test_too_bright_and_doubly_lit_pixels_have_no_value_in_a_light_section() -> None:
    def bright_spot(u: Array, v: Array) -> Array:
        return np.where((u - 60) ** 2 + (v - 60) ** 2 < 20**2, 1.5, 1.0)

    lit, dark, coded, s = captured(SECTION, wavy(3.0), 50, albedo=bright_spot)
    coded = coded.copy()
    twice = np.s_[80:100, 100:130]
    coded[5][twice] = coded[45][twice] = 150  # light by way of another surface
    seen = decode_stripes(spec_of(SECTION, 50), lit, dark, coded)
    v, u = np.mgrid[: lit.shape[0], : lit.shape[1]]
    spot = (u - 60) ** 2 + (v - 60) ** 2 < 17**2
    assert np.isnan(seen.s[spot & (coded.max(axis=0) >= 254)]).all()
    # What is left of the spot lies between two stripes, each half as bright.
    assert np.nanmax(np.abs(seen.s - s)[spot]) < 0.1
    assert np.isnan(seen.s[twice]).all()


@pytest.mark.parametrize("code", [GRAY, *ALL], ids=name)
@pytest.mark.parametrize("rising", [True, False])
def test_limits_do_not_change_s_within_them(code: Code, rising: bool) -> None:
    stripes = 60
    images = captured(code, wavy(2.2), stripes)
    whole = read(code, images, stripes)
    low, high = (20.0, 35.0) if rising else (-35.0, -20.0)
    corners = np.ones((3, 4), np.float32)
    limits = StripeLimits(low * corners, high * corners, high * corners, rising, 64, 5.0)
    lit, dark, coded, _ = images
    part = decode_stripes(spec_of(code, stripes), lit, dark, coded, limits=limits)
    # Within two stripes of the ends a run, and what is smoothed along it, ends earlier.
    inside = np.isfinite(whole.s) & (whole.s > 22.0) & (whole.s < 33.0)
    assert inside.sum() > 1000
    np.testing.assert_allclose(part.s[inside], whole.s[inside], atol=0.02)
    shown = part.s[np.isfinite(part.s)]
    assert shown.min() > 19.0
    assert shown.max() < 36.0
    deep = whole.s > 36.0 if rising else whole.s < 19.0
    assert part.beyond is not None
    assert part.beyond[deep].mean() > 0.99
    assert not part.beyond[whole.s < 34.0 if rising else whole.s > 21.0].any()
    assert whole.beyond is None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("late", "by_bit"), [(1, False), (2, True), (-1, False), (-2, True)])
def test_frames_out_of_step_are_counted(late: int, by_bit: bool) -> None:
    lit, dark, coded, _ = captured(GRAY, wavy(2.2), 60)
    order = np.arange(12).reshape(2, 6).T.ravel() if by_bit else np.arange(12)
    moved = np.roll(np.stack([lit, dark, *coded[order]]), late, axis=0)
    with pytest.raises(DecodingFailed, match=f"out of step by {abs(late)}: each file holds"):
        decode_stripes(spec_of(GRAY, 60), moved[0], moved[1], moved[2:][np.argsort(order)])
    with pytest.raises(DecodingFailed, match="lights only"):  # and is out of step by nothing
        decode_stripes(spec_of(GRAY, 60), dark, dark, np.stack([dark] * 12))
    with pytest.raises(
        DecodingFailed, match="pattern of bit 2 and the pattern of bit 3 are the same"
    ):
        decode_stripes(
            spec_of(GRAY, 60), lit, dark, coded[[0, 1, 2, 2, *range(4, 8), 8, 8, 10, 11]]
        )


@pytest.mark.parametrize(("code", "period"), [(PHASE, 8), (LONG_WAVES, 10)], ids=name)
def test_light_in_a_part_of_one_image_of_a_wave_is_left_out(code: Code, period: int) -> None:
    images, part = captured(code, wavy(2.2), 60), np.s_[30:80, 40:110]
    calm = read(code, images, 60)
    images[2][1 if code is LONG_WAVES else -3][part] += 20  # a ninth of the contrast
    seen = read(code, images, 60)
    (fault,) = seen.faults
    assert f"image 1 of the wave of {period} stripes contradicts the others over " in fault
    assert not calm.faults
    assert not np.isfinite(seen.s[part]).any()
    kept = np.isfinite(images[3]) & np.isfinite(seen.s)
    assert rms((seen.s - images[3])[kept]) < 0.03
    assert kept.sum() > 0.6 * np.isfinite(calm.s).sum()
