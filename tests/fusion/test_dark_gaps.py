"""Gaps between bright surfaces are found, dark things are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bodyscan.fusion.cleaning import find_dark_gaps

SKIN, DARK = 150, 12


def photographed(grey: np.ndarray, noise: float = 2.0) -> np.ndarray:
    """Through a lens whose blur has a sigma of a pixel, with noise."""
    blurred = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), 1.0)
    blurred += np.random.default_rng(0).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def skin_with_a_band(width: int, level: int = DARK) -> np.ndarray:
    """An image of skin with a dark upright band in its middle."""
    grey = np.full((60, 80), SKIN)
    grey[:, 40 - width // 2 : 40 + (width + 1) // 2] = level
    return grey


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("width", [2, 3, 5])
def test_a_narrow_gap_is_found(width: int, turned: bool) -> None:
    grey = skin_with_a_band(width)
    found = find_dark_gaps(photographed(grey.T if turned else grey))
    found = found.T if turned else found
    assert found[10:-10, 40].all()
    # The skin on both sides stays, but for the two pixels into which the dark is blurred.
    assert not found[:, : 40 - width // 2 - 2].any()
    assert not found[:, 40 + (width + 1) // 2 + 2 :].any()


@pytest.mark.parametrize("width", [12, 30])
def test_something_dark_and_wide_stays(width: int) -> None:
    assert not find_dark_gaps(photographed(skin_with_a_band(width))).any()


def test_a_silhouette_before_a_dark_room_stays() -> None:
    grey = np.full((60, 80), DARK)
    grey[:, 30:] = SKIN
    assert not find_dark_gaps(photographed(grey)).any()


def test_a_faint_line_stays() -> None:
    assert not find_dark_gaps(photographed(skin_with_a_band(3, SKIN // 2 + 10))).any()


def test_noise_on_something_dark_stays() -> None:
    assert not find_dark_gaps(photographed(np.full((200, 200), DARK), noise=5.0)).any()
