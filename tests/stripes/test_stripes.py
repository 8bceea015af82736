"""Stripe coordinates on rendered surfaces whose stripe coordinate is known, and on real ones."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from stripe_rendering import (
    Sequence,
    boundary_errors,
    checkered,
    decode_gray,
    render_sequence,
    wavy,
)

from bodyscan.arrays import Array, Bytes
from bodyscan.boards.detection import find_boards
from bodyscan.geometry.robust import estimate_robust_scale
from bodyscan.rig.board import Board


def contrast(sequence: Sequence) -> Bytes:
    return cv2.subtract(sequence.lit, sequence.dark)


def test_where_the_light_ends_no_stripe_is_read_from_what_skin_scatters_beyond() -> None:
    """The last stripe is dark. Rows of points there were 3 to 12 mm inside a thigh."""
    s_at, stripes = wavy(2.2), 80
    sequence = render_sequence(s_at, stripes=stripes - 1)

    def scatter(frame: np.ndarray) -> np.ndarray:
        wide = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), 3.0)
        return np.rint(0.4 * frame + 0.6 * wide).astype(np.uint8)

    frames = sequence.lit, sequence.dark, sequence.patterns, sequence.inverses
    scattered = (scatter(f) if f.ndim == 2 else np.stack(list(map(scatter, f))) for f in frames)
    seen = decode_gray(*scattered, stripes=stripes, direction="horizontal")
    v, u = np.nonzero(seen.s > stripes - 8)
    assert np.sqrt(np.mean((seen.s[v, u] - s_at(u, v)) ** 2)) < 0.05


@pytest.mark.parametrize("gamma", [1.5, 2.2])
def test_a_projector_whose_fine_bits_and_inverses_sum_to_less_than_lit_loses_no_pixels(
    gamma: float,
) -> None:
    """Blurred edges that its response darkens: sums of the finest bit are up to 94 of 178 lower."""
    plain = render_sequence(lambda u, v: 30 + 0.3 * u + 4 * np.sin(v / 60), stripes=128, light=178)
    contrast = plain.lit.astype(float) - plain.dark

    def shown(frames: np.ndarray) -> np.ndarray:
        share = np.clip((frames - plain.dark) / np.maximum(contrast, 1.0), 0.0, 1.0)
        return np.rint(plain.dark + contrast * share**gamma).astype(np.uint8)

    frames = shown(plain.patterns.astype(float)), shown(plain.inverses.astype(float))
    lower = contrast - sum(frame[-1] - plain.dark.astype(float) for frame in frames)
    assert np.percentile(lower, 90.0) > 40.0
    found = decode_gray(plain.lit, plain.dark, *frames, stripes=128, direction="vertical")
    readable = np.abs(frames[0].astype(float) - frames[1]).min(axis=0) > 5.0
    assert np.mean(np.isfinite(found.s[readable])) > 0.97
    assert np.nanstd(found.s - plain.s) < 0.01


def test_pixels_half_off_the_surface_have_no_value() -> None:
    def s_at(u: Array, v: Array) -> Array:
        return np.where(np.abs(u - 130.3) < 60, 3 + (v + 0.7 * u) / 2.2, np.nan)

    sequence = render_sequence(s_at, stripes=200)
    seen = sequence.decode(200)
    on, has = np.isfinite(sequence.s), np.isfinite(seen.s)
    # 200 lines, each with two rims that cut a pixel: at most the better half of one is kept.
    assert (has & ~on).sum() < 20
    assert (on & has).sum() > 0.97 * on.sum()
    # At a rim across which s changes, a pixel's light comes from beside its middle: without
    # regard to that 82 pixels are off by more than a tenth of a stripe.
    error = np.abs(seen.s - sequence.s)[on & has]
    assert (error > 0.1).sum() < 10


def test_black_and_white_edges_along_the_scan_lines_do_not_move_slanted_stripes() -> None:
    s_at = wavy(2.2, slant=0.6)
    sequence = render_sequence(s_at, stripes=170, albedo=checkered(24, turned_deg=8))
    seen = sequence.decode(170)
    # Measured 0.084 px and 0.027 stripes; 0.107 and 0.039 if only edges across lines counted.
    assert np.sqrt(np.mean(boundary_errors(seen, s_at) ** 2)) < 0.095
    both = np.isfinite(sequence.s) & np.isfinite(seen.s)
    assert np.sqrt(np.mean((seen.s - sequence.s)[both] ** 2)) < 0.033


def test_saturated_and_unlit_pixels_have_no_value() -> None:
    def bright_spot(u: Array, v: Array) -> Array:
        return np.where((u - 60) ** 2 + (v - 60) ** 2 < 20**2, 1.5, 1.0)

    def s_at(u: Array, v: Array) -> Array:
        return np.where(u > 200, np.nan, wavy(3.0)(u, v))

    seen = render_sequence(s_at, stripes=90, albedo=bright_spot).decode(90)
    v, u = np.mgrid[: seen.s.shape[0], : seen.s.shape[1]]
    spot = (u - 60) ** 2 + (v - 60) ** 2
    assert np.isnan(seen.s[spot < 18**2]).all()
    assert np.isnan(seen.s[u > 202]).all()
    assert np.isfinite(seen.s[(u < 197) & (spot > 24**2)]).mean() > 0.99
    inside = (seen.boundary_pixels[:, 0] - 60) ** 2 + (seen.boundary_pixels[:, 1] - 60) ** 2 < 18**2
    assert not inside.any()


@pytest.mark.slow
@pytest.mark.parametrize("pose", [0, 1, 2, 4])
def test_real_stripes_on_a_real_board_are_smooth(captures: Path, pose: int) -> None:
    folder = captures / "procam-board" / f"capture_{pose}"
    frame = {k: cv2.imread(str(folder / f"graycode_{k}.png"), 0) for k in range(20, 42)}
    seen = decode_gray(
        frame[40], frame[41],
        np.stack([frame[k] for k in range(20, 40, 2)]),
        np.stack([frame[k] for k in range(21, 40, 2)]),
        stripes=768, direction="horizontal",
    )  # fmt: skip
    board = Board(name="procam", columns=10, rows=8, square_mm=75)
    (view,) = find_boards(frame[40], [board], pair="a", shot="b")
    inside = np.zeros(frame[40].shape, np.uint8)
    hull = cv2.convexHull(view.pixels.astype(np.float32)).reshape(-1, 2)
    cv2.fillConvexPoly(inside, np.rint(hull).astype(np.int32), 1)
    u, v = np.rint(seen.boundary_pixels).astype(int).T
    bright = (inside[v, u] > 0) & (cv2.subtract(frame[40], frame[41])[v, u] > 40)
    assert bright.sum() > 30_000
    place = (seen.boundary_pixels[bright] - hull.mean(axis=0)) / 500
    powers = [(i, j) for i in range(6) for j in range(6 - i)]
    design = np.stack([place[:, 0] ** i * place[:, 1] ** j for i, j in powers], axis=-1)
    index, sigma = seen.boundary_index[bright], seen.boundary_sigma_px[bright]
    fitted = np.linalg.lstsq(design / sigma[:, None], index / sigma, rcond=None)[0]
    stray_px = (index - design @ fitted) * 1.78
    # A plane lit by a projector: stripes 1.78 px wide. Measured 0.04 to 0.1 px, which is what the
    # sigmas say, in images whose finest stripes have only a fifth to a third of the full contrast.
    assert estimate_robust_scale(stray_px) < 0.13
    assert 0.7 < estimate_robust_scale(stray_px / sigma) < 1.4


def test_stripes_that_end_and_begin_again_are_not_joined() -> None:
    """Behind a narrow dark gap another surface happens to show the very next stripe."""

    def s_at(u: Array, v: Array) -> Array:
        behind = 17.4 + (v - 113) / 9.0
        return np.where(v < 108, 3 + v / 7.5, np.where(v < 113, np.nan, behind))

    sequence = render_sequence(s_at, stripes=40)
    seen = sequence.decode(40)
    both = np.isfinite(seen.s) & np.isfinite(sequence.s)
    # 0.2 stripes when the two were joined.
    assert np.abs(seen.s - sequence.s)[both].max() < 0.08
