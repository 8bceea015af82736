"""Pairs with other exposures: a cloud without seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ray_cast_scan import Scan

from bodyscan.fusion.brightness import gains, log_ratio
from bodyscan.fusion.merging import merge
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings


def test_gains_undo_known_exposures() -> None:
    true = np.array([1.0, 1.3, 0.7, 0.9])
    true /= np.exp(np.log(true).mean())
    ring = [
        (a, b, float(np.log(true[b] / true[a])), 500) for a, b in [(0, 1), (1, 2), (2, 3), (3, 0)]
    ]
    np.testing.assert_allclose(gains(ring, 4) * true, 1.0, rtol=0.01)  # held back by a thousandth


def test_a_pair_without_overlap_keeps_its_brightness() -> None:
    assert gains([], 3) == pytest.approx(np.ones(3))


def test_a_ratio_of_too_few_spots_counts_for_nothing() -> None:
    assert log_ratio(np.full(50, 100, np.uint8), np.full(50, 50.0, np.float32)) == (0.0, 0)
    ratio, spots = log_ratio(np.full(500, 100, np.uint8), np.full(500, 50.0, np.float32))
    assert ratio == pytest.approx(np.log(0.5))
    assert spots == 500


def test_no_seams_between_exposures(scan: Scan, cleaned: list[RangeImage]) -> None:
    """A grey body whose pairs were exposed 0.6 to 1.4 times as long: one grey all over."""
    factors = np.linspace(0.6, 1.4, len(cleaned))
    images = [
        replace(image, colours=np.full_like(image.colours, round(120 * factor)))
        for image, factor in zip(cleaned, factors, strict=True)
    ]
    cloud = merge(images, scan.rig_from_camera, FusionSettings(points=100_000)).cloud
    grey = cloud.colours[:, 0].astype(float)
    # Without gains the scatter is that of the factors, 0.25.
    assert grey.std() / grey.mean() < 0.02
