"""Colours of pairs with other exposures, white balances and light: a cloud without seams."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ray_cast_scan import Scan

from bodyscan.arrays import Array
from bodyscan.fusion.brightness import (
    compute_log_irradiance,
    estimate_light_exponent,
    find_overlaps,
    solve_gains,
)
from bodyscan.fusion.merging import merge
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.settings import FusionSettings


def test_gains_undo_known_exposures() -> None:
    true = np.array([1.0, 1.3, 0.7, 0.9])
    true /= np.exp(np.log(true).mean())
    ring = [
        (a, b, float(np.log(true[b] / true[a])), 500) for a, b in [(0, 1), (1, 2), (2, 3), (3, 0)]
    ]
    np.testing.assert_allclose(
        solve_gains(ring, 4) * true, 1.0, rtol=0.01
    )  # held back by a thousandth


def test_a_pair_without_overlap_keeps_its_brightness() -> None:
    assert solve_gains([], 3) == pytest.approx(np.ones(3))


def test_the_power_of_light_is_told_whatever_the_exposures_and_some_stains() -> None:
    rng = np.random.default_rng(0)
    overlaps = []
    for exposure in (0.3, -0.2):
        shade = rng.normal(0.1, 0.4, 800).astype(np.float32)
        ratio = exposure + 0.8 * shade + rng.normal(0.0, 0.02, 800)
        ratio[::10] += 1.0  # highlights
        overlaps.append((ratio.astype(np.float32), shade))
    # Where light falls off to a third, 0.05 of the power is 5 % of grey, which nobody sees.
    assert estimate_light_exponent(overlaps) == pytest.approx(0.8, abs=0.05)
    assert estimate_light_exponent([]) == 0.0


def test_light_that_the_room_gives_is_not_taken_for_more_than_matt() -> None:
    shade = np.linspace(-1.0, 1.0, 500).astype(np.float32)
    assert estimate_light_exponent([(-0.5 * shade, shade)]) == 0.0
    assert estimate_light_exponent([(3.0 * shade, shade)]) == 1.0


def test_no_seams_between_exposures(scan: Scan, cleaned: list[RangeImage]) -> None:
    """A grey body whose pairs were exposed 0.6 to 1.4 times as long: one grey all over."""
    factors = np.linspace(0.6, 1.4, len(cleaned))
    images = [
        replace(image, colours=np.full_like(image.colours, round(120 * factor)))
        for image, factor in zip(cleaned, factors, strict=True)
    ]
    grey = merge(images, scan.rig_from_camera, FusionSettings(points=100_000)).cloud.colours[:, 0]
    # Without gains the scatter is that of the factors, 0.25.
    assert grey.std() / grey.mean() < 0.02


@pytest.mark.parametrize("grey_pairs", [0, 2])
def test_one_white_balance_of_pairs_that_have_others(
    scan: Scan, cleaned: list[RangeImage], grey_pairs: int
) -> None:
    """A body whose left half has another colour keeps both; if it has one colour all over, grey
    cameras among the others take it on."""
    halves = np.array([[170.0, 110.0, 80.0], [60.0, 90.0, 140.0]])[[0, 0 if grey_pairs else 1]]
    balance = np.random.default_rng(2).uniform(0.7, 1.3, (len(cleaned), 3))
    balance[grey_pairs:] /= np.exp(np.log(balance[grey_pairs:]).mean(axis=0))
    images = []
    for number, (image, factors) in enumerate(zip(cleaned, balance, strict=True)):
        left = scan.rig_from_camera[image.pair].apply(image.points.astype(float))[..., 1] > 0
        rgb = np.rint(halves[left.astype(int)] * factors).astype(np.uint8)
        images.append(replace(image, rgb=None if number < grey_pairs else rgb))
        if number < grey_pairs:
            images[-1] = replace(images[-1], colours=np.full_like(image.colours, 90 + 60 * number))
    cloud = merge(images, scan.rig_from_camera, FusionSettings(points=100_000)).cloud
    for side, colour in zip((-1.0, 1.0), halves, strict=True):
        found = cloud.colours[side * cloud.points[:, 1] > 10.0].astype(float)
        ratios = found[:, [0, 2]] / found[:, [1]]
        # Levels are rounded twice: 1 % of 60. Unbalanced, ratios scatter by 20 %.
        np.testing.assert_allclose(np.median(ratios, axis=0), colour[[0, 2]] / colour[1], rtol=0.02)
        assert (np.std(ratios, axis=0) < 0.02 * ratios.mean(axis=0)).all()


def test_no_seams_where_one_pair_looks_squarely_and_another_along(
    scan: Scan, cleaned: list[RangeImage]
) -> None:
    """A matt body, each pair's light beside its camera: one grey all over."""
    images = []
    for image in cleaned:
        distance = np.linalg.norm(image.points, axis=-1)
        facing = -np.sum(image.points * image.normals, axis=-1) / distance
        lit = np.nan_to_num(120.0 * facing * (1300.0 / distance) ** 2)
        images.append(replace(image, colours=np.clip(np.rint(lit), 0, 255).astype(np.uint8)))
    grey = merge(images, scan.rig_from_camera, FusionSettings(points=100_000)).cloud.colours[:, 0]
    # Normals that are off at 8 bits of grey leave 0.04; as the cameras give it, 0.39 would be left.
    assert grey.std() / grey.mean() < 0.06


def test_light_falls_off_with_the_square_of_the_distance_and_the_cosine() -> None:
    lean = np.radians([0.0, 60.0, 80.0, 88.0])
    normals = np.stack([np.sin(lean), 0.0 * lean, np.cos(lean)], axis=1).astype(np.float32)
    centre = np.array([100.0, -200.0, 900.0])
    for away in (500.0, 1000.0):
        points = np.tile(centre - [0.0, 0.0, away], (4, 1)).astype(np.float32)
        # From 84 degrees on the room lights it.
        expected = np.log(np.maximum(np.cos(lean), 0.1) / away**2)
        np.testing.assert_allclose(
            compute_log_irradiance(points, normals, centre), expected, rtol=1e-5
        )


def overlap(ours: Array, theirs: Array, shade: float = 0.3) -> list[Any]:
    """What the second of two pairs says of the first's samples, whose grey levels are `ours`."""
    count = len(ours)
    samples: Any = SimpleNamespace(
        colours=np.concatenate([ours, np.full(7, 99)]).astype(np.uint8)[:, None],
        starts=np.array([0, count, count + 7]),
    )
    surfaces: Any = [SimpleNamespace(colours=part[:, None]) for part in (np.zeros(0), theirs)]
    none = SimpleNamespace(index=np.zeros(0, np.int64), at=np.zeros(0, np.int64))
    seen: Any = [none, SimpleNamespace(index=np.arange(count), at=np.arange(count))]
    of_samples = np.full(count + 7, 0.1, np.float32)
    of_surfaces = [np.zeros(0, np.float32), np.full(count, 0.1 + shade, np.float32)]
    return list(find_overlaps(samples, surfaces, seen, of_samples, of_surfaces, 0))


def test_an_overlap_tells_how_much_brighter_one_pair_is_than_the_other() -> None:
    (found,) = overlap(np.full(1000, 100), np.full(1000, 150))
    assert (found.a, found.b, found.spots) == (0, 1, 1000)
    np.testing.assert_allclose(found.ratio, np.log(1.5), rtol=1e-6)
    np.testing.assert_allclose(found.shade, 0.3, rtol=1e-6)
    (many,) = overlap(np.full(12_000, 100), np.full(12_000, 150))
    assert many.spots == 12_000
    assert len(many.ratio) == 4000  # a third of them tell as much
