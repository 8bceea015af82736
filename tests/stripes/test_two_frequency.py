"""A real board under waves of two periods and nothing else: decoded, and how exactly."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from real_captures import real_rig_file

from bodyscan.captures.folder import Captures, open_captures
from bodyscan.captures.images import read_sequence
from bodyscan.rig.rig import load_rig
from bodyscan.stripes.stripe_map import StripeMap
from bodyscan.workflows.decode import decode_sequence
from bodyscan.workflows.find_boards import find_all_boards


@pytest.fixture(scope="module")
def opened(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Captures:
    path = real_rig_file("two-frequency", captures, tmp_path_factory.mktemp("rig"))
    return open_captures(load_rig(path), path)


@pytest.fixture(scope="module")
def decoded(opened: Captures) -> StripeMap:
    return decode_sequence(opened.sequences[0], opened.rig.pairs[0])


@pytest.fixture(scope="module")
def board(opened: Captures) -> np.ndarray:
    """Where the board's inner corners span the picture."""
    found = find_all_boards(opened.rig, opened)
    (view,) = found.value
    assert len(view.corner_ids) == 13 * 9
    mask = np.zeros((1352, 1688), np.uint8)
    hull = cv2.convexHull(np.rint(view.pixels).astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(mask, hull, 1) > 0)


def off_surface(s: np.ndarray, board: np.ndarray, reach_px: float) -> np.ndarray:
    """How far s is off a polynomial, and that off its own mean over some pixels around; of the picture
    the board and what the mean reaches beside it."""
    v, u = np.nonzero(board)
    beside = round(4.0 * reach_px)
    rows, columns = (slice(max(w.min() - beside, 0), w.max() + beside) for w in (v, u))
    s, board = s[rows, columns], board[rows, columns]
    v, u = np.nonzero(board)
    x, y = (u - u.mean()) / u.std(), (v - v.mean()) / v.std()
    powers = np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)
    value = s[board]
    kept = np.isfinite(value)
    for _ in range(3):
        some = np.flatnonzero(kept)[::20]  # tens of thousands of pixels for ten numbers
        off = value - powers @ np.linalg.lstsq(powers[some], value[some], rcond=None)[0]
        kept = np.isfinite(value) & (np.abs(off) < 3.0)
    rest = np.zeros(board.shape)
    rest[board] = np.where(kept, off, 0.0)
    known = np.zeros(board.shape)
    known[board] = kept
    around = cv2.GaussianBlur(rest, (0, 0), reach_px) / np.maximum(
        cv2.GaussianBlur(known, (0, 0), reach_px), 1e-3
    )
    return np.where(known > 0, rest - around, np.nan)


def systematic(off: np.ndarray) -> float:
    """What is left of `off` in means of 15 x 15 pixels, RMS."""
    known = np.isfinite(off).astype(float)
    mean = cv2.blur(np.nan_to_num(off), (15, 15)) / np.maximum(cv2.blur(known, (15, 15)), 0.1)
    return float(np.sqrt(np.mean(np.square(mean[known > 0]))))


def plain(images: np.ndarray, pixels: float) -> np.ndarray:
    """s by the arctangents alone: three steps of sixteen periods, then of one."""
    turns = []
    for part in np.split(images.astype(float), 2):
        arrow = np.tensordot(np.exp(2j * np.pi * np.arange(3) / 3), part, 1)
        turns.append(np.angle(arrow) / (2 * np.pi) % 1)
    return np.asarray((turns[0] + np.rint(16 * turns[1] - turns[0])) * pixels / 16 + 0.5)


# About a surface that follows the bubbles which the paper throws (0.2 mm high: columns and rows agree
# on them along the epipolar line): 0.337 and 0.210 stripes, of which 0.086 and 0.038 over 15 x 15 px. A
# plain arctangent has 0.453 and 0.283, of which 0.087 and 0.039.
@pytest.mark.parametrize(("crossing", "rms", "slow"), [(False, 0.36, 0.1), (True, 0.23, 0.06)])
def test_columns_and_rows_are_decoded_exactly(
    opened: Captures, decoded: StripeMap, board: np.ndarray, crossing: bool, rms: float, slow: float
) -> None:
    found = decoded.crossing if crossing else decoded
    assert found is not None
    assert np.isfinite(found.s[board]).mean() > 0.999
    off = off_surface(found.s, board, 15.0)
    images = read_sequence(opened.sequences[0], opened.rig.pairs[0].camera).coded
    by_arctangent = plain(images[6:] if crossing else images[:6], 1140.0 if crossing else 1824.0)
    # No pixel of the board is a period (114 or 71 stripes) off, or a tenth of one.
    assert np.nanmax(np.abs(found.s - by_arctangent)[board]) < 7.0
    assert np.nanstd(off) < rms
    assert systematic(off) < slow
    assert np.nanstd(off) < 0.8 * np.nanstd(off_surface(by_arctangent, board, 15.0))
    # The sigma is what is seen.
    expected = float(np.sqrt(np.nanmean(np.square(found.sigma[board]))))
    assert 0.9 < np.nanstd(off) / expected < 1.15
