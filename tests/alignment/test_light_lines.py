"""Light that comes out of skin aside of where it entered, by Snell's law and the rays themselves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from bodyscan.alignment.oblique_light import LightLine, ObliqueLight

LINE = LightLine(np.array([-220.0, 30.0, 15.0]), np.array([0.05, 0.99, -0.02]))
ALONG = LINE.along / np.linalg.norm(LINE.along)


def depth_error(point: np.ndarray, normal: np.ndarray, aside_mm: float) -> float:
    """How far along its ray a point is measured behind where it is: what is seen there entered where
    light, refracted at 1.4, comes from; the stripe of that place's sheet is met by the ray."""
    light = point - LINE.origin
    light /= np.linalg.norm(light)
    level = light - (light @ normal) * normal
    sine = np.linalg.norm(level) / 1.4
    entered = point - aside_mm * sine / np.sqrt(1.0 - sine**2) * level / np.linalg.norm(level)
    sheet = np.cross(ALONG, entered - LINE.origin)
    ray = point / np.linalg.norm(point)
    met = (sheet @ LINE.origin) / (sheet @ ray)
    return float(met - np.linalg.norm(point))


@pytest.mark.parametrize("seed", range(6))
def test_a_point_is_lifted_by_where_its_ray_meets_the_sheet_that_entered_aside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    point = np.array([*rng.uniform(-200.0, 200.0, 2), rng.uniform(700.0, 1000.0)])
    normal = np.array([*rng.uniform(-0.7, 0.7, 2), -1.0])
    normal /= np.linalg.norm(normal)
    line = LightLine(LINE.origin, ALONG)
    lift = line.lift(point[None], normal[None])[0]
    small = 1e-3  # of a millimetre, at which sheets do not turn
    assert lift == pytest.approx(depth_error(point, normal, small) / small, rel=1e-3, abs=1e-5)


def test_where_light_or_camera_graze_nothing_is_known() -> None:
    line = LightLine(LINE.origin, ALONG)
    point = np.array([0.0, 0.0, 800.0])
    light = (point - LINE.origin) / np.linalg.norm(point - LINE.origin)

    def lift(towards: np.ndarray, cosine: float) -> float:
        """Under a surface that a direction meets so flat."""
        beside = np.cross(towards, [0.0, 1.0, 0.0])
        beside /= np.linalg.norm(beside)
        normal = -cosine * towards + np.sqrt(1.0 - cosine**2) * beside
        if normal @ point > 0.0 or normal @ light > 0.0:
            normal = -cosine * towards - np.sqrt(1.0 - cosine**2) * beside
        return float(line.lift(point[None], normal[None])[0])

    ray = point / 800.0
    assert np.isfinite(lift(ray, 0.11))
    assert np.isnan(lift(ray, 0.09))
    assert np.isfinite(lift(light, 0.11))
    assert np.isnan(lift(light, 0.09))
    # A camera that looks along the light sees no depth.
    behind = LightLine(np.array([0.0, 0.0, -50.0]), ALONG)
    assert np.isnan(behind.lift(point[None], np.array([[0.3, 0.0, -0.954]]))[0])


def test_it_is_told_from_four_sigmas_and_a_twentieth_of_a_millimetre_on() -> None:
    assert not ObliqueLight(0.05, 0.0).told
    assert ObliqueLight(0.051, 0.0).told
    assert not ObliqueLight(0.4, 0.1).told
    assert ObliqueLight(0.41, 0.1).told
    assert not ObliqueLight(-0.8, 0.1).told
    assert ObliqueLight(-0.2, 0.05).most_mm == pytest.approx(0.25)


@dataclass(frozen=True)
class Fan:
    """Sheets through a line at x = -220, z = 15 that runs along y, some of them measured."""

    turns: tuple[float, ...]
    stripes: int = 99

    def tangent_planes(self, s: np.ndarray) -> np.ndarray:
        # Neither the first boundary nor the last, which are nobody's own.
        np.testing.assert_allclose(s, 3.0 * np.arange(1, 33))
        planes = np.full((32, 4), np.nan)
        for k, turn in enumerate(self.turns):
            normal = np.array([np.cos(turn), 0.0, np.sin(turn)])
            planes[5 * k] = *normal, -normal @ [-220.0, 7.0, 15.0]
        return planes


def test_light_comes_from_where_three_sheets_meet() -> None:
    fan: Any = Fan((0.0, 0.1, -0.1))
    found = LightLine.of(fan)
    assert found is not None
    np.testing.assert_allclose(np.abs(found.along), [0.0, 1.0, 0.0], atol=1e-9)
    # The place of the line that is nearest to the camera.
    np.testing.assert_allclose(found.origin, [-220.0, 0.0, 15.0], atol=1e-6)
    few: Any = Fan((0.0, 0.1))
    assert LightLine.of(few) is None


@pytest.mark.parametrize(("apart", "told"), [(2e-3, True), (1e-3, False), (0.0, False)])
def test_sheets_that_hardly_turn_meet_nowhere(apart: float, told: bool) -> None:
    """Turned by so much to either side, the second direction has two thirds of that, as a root of
    squares, against one of them all."""
    fan: Any = Fan((-apart, 0.0, apart))
    assert (LightLine.of(fan) is not None) is told
