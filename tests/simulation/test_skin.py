"""Skin that lets light in, shines and is covered by hair and cloth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_view import CAMERA, CRISP, LAMPS, projector, view, wall

from bodyscan.arrays import Array, Floats
from bodyscan.simulation.body import load_subject
from bodyscan.simulation.lamps import highlight, shape_mm, spread_light
from bodyscan.simulation.render import render_pair
from bodyscan.simulation.scene import Scene, Surface
from bodyscan.simulation.settings import Person, Skin

SUBJECT = Path(__file__).parents[2] / "data" / "subjects" / "woman_average.ply"
SPREADS = Skin(spread_mm=1.0, stays=0.07)


def bright_point(size: int = 201) -> Floats:
    light = np.zeros((size, size), np.float32)
    light[size // 2, size // 2] = 1.0
    return light


def test_light_spreads_as_burley_has_it() -> None:
    """Of the profile (exp(-r/d) + exp(-r/3d)) / (8 pi d r) the mean square radius is 14 d^2."""
    light, depth = bright_point(), np.full((201, 201), 1000.0, np.float32)
    share = np.ones_like(depth)
    alpha = 4000.0  # 4 px/mm, so that a pixel is small against the profile
    spread = spread_light(light, share, depth, alpha, SPREADS)
    assert spread.sum() == pytest.approx(1.0, abs=1e-4)  # none is lost
    stayed = light * 0.07
    v, u = np.indices(light.shape) - 100
    r2 = (u**2 + v**2) / 4.0**2
    entered = (spread - stayed) / 0.93
    # Cut off at 18 d, beyond which lies a five-hundredth of the light, but a twentieth of this.
    assert np.sum(entered * r2) == pytest.approx(14.0 * shape_mm(SPREADS) ** 2, rel=0.08)
    assert spread[100, 100] > 0.07


def test_farther_away_it_spreads_over_fewer_pixels() -> None:
    light = bright_point()
    depth = np.full((201, 201), 1500.0, np.float32)
    depth[:, :80] = 750.0
    pair = np.roll(light, -60, axis=1) + np.roll(light, 60, axis=1)
    spread = spread_light(pair, np.ones_like(depth), depth, 2000.0, SPREADS)
    near, far = spread[100, 40], spread[100, 160]
    # The profile is a pole: in its middle twice as wide is half as bright. A 14th stays.
    assert near - 0.07 == pytest.approx(0.55 * (far - 0.07), rel=0.1)


def test_light_does_not_leave_skin_for_cloth() -> None:
    light = np.ones((60, 60), np.float32)
    share = np.zeros_like(light)
    share[:, :30] = 1.0
    depth = np.full_like(light, 1000.0)
    spread = spread_light(light, share, depth, 2000.0, SPREADS)
    np.testing.assert_allclose(spread, 1.0, atol=1e-5)
    light[:, 30:] = 0.0
    np.testing.assert_allclose(spread_light(light, share, depth, 2000.0, SPREADS), light, atol=1e-5)
    assert spread_light(light, 0 * share, depth, 2000.0, SPREADS) is light
    assert spread_light(light, share, depth, 2000.0, Skin()) is light


def test_gloss_is_where_a_mirror_would_show_the_light() -> None:
    skin = Skin(gloss=0.8, gloss_power=30.0)
    point, towards = np.array([[0.0, 0.0, 1000.0]]), np.array([[300.0, 0.0, -1000.0]])
    view_direction = np.array([0.0, 0.0, -1.0])
    half = view_direction + towards[0] / np.linalg.norm(towards)
    assert highlight(point, towards, half[None], skin)[0] == pytest.approx(0.8)
    tilted = half + [0.6, 0.0, 0.0]
    assert highlight(point, towards, tilted[None], skin)[0] < 0.4


def rendered(skin: Skin, share: float) -> dict[str, Floats]:
    flat = wall(900.0, albedo=0.5)
    covered: Surface = replace(flat, skin=np.full(len(flat.vertices), share))
    lamps = replace(LAMPS, skin=skin)
    rng = np.random.default_rng(0)
    return render_pair(Scene([covered]), view(), projector(), lamps, CRISP, rng)


def test_images_of_skin() -> None:
    plain = rendered(Skin(), 1.0)
    finest = max(name for name in plain if name.startswith("bit") and len(name) == 5)

    def contrast(images: dict[str, Floats]) -> Array:
        middle = images[finest][40:90, 40:120].astype(float)
        return middle.std() / middle.mean()

    # Stripes are some 4 px wide, a pixel 5 mm: only a long free path blurs them.
    deep = Skin(spread_mm=10.0)
    assert contrast(rendered(deep, 1.0)) < 0.9 * contrast(plain)
    assert contrast(rendered(deep, 0.0)) == contrast(plain)
    shining = rendered(Skin(gloss=0.5, gloss_power=5.0), 1.0)
    assert (shining["lit"] - plain["lit"]).max() > 10.0
    np.testing.assert_array_equal(shining["dark"], plain["dark"])
    assert CAMERA.width == plain["lit"].shape[1]


def test_hair_and_shorts_are_dark_and_let_no_light_in() -> None:
    person = Person(subdivisions=1, skin_variation=0.0)

    def dressed(skin: Skin) -> Surface:
        return load_subject(SUBJECT, person, np.random.default_rng(0), skin)

    plain = dressed(Skin())
    assert plain.skin is None
    worn = dressed(Skin(spread_mm=0.7, hair=0.03, shorts=0.05, moles=40, mottling=0.03))
    assert isinstance(worn.albedo, np.ndarray)
    assert worn.skin is not None
    z = plain.vertices[:, 2] / plain.vertices[:, 2].max()
    hair, cloth = worn.albedo == 0.03, worn.albedo == 0.05
    assert z[hair].min() > 0.88
    assert hair[np.argmax(z)]
    face = (z > 0.89) & (z < 0.93) & (plain.vertices[:, 0] > 40)
    assert not hair[face].any()
    assert 0.4 < z[cloth].min() < z[cloth].max() < 0.57
    assert set(np.unique(worn.skin[hair | cloth])) == {0.0}
    assert set(np.unique(worn.skin[~(hair | cloth)])) == {1.0}
    rough = np.linalg.norm(worn.vertices - plain.vertices, axis=1)
    assert rough[~hair].max() == 0.0
    assert rough[hair].mean() == pytest.approx(np.sqrt(2 / np.pi), rel=0.1)  # mean of |N(0, 1)|
    skin = worn.albedo[~(hair | cloth)]
    assert 0.02 < np.std(skin[skin > 0.5]) / np.mean(skin) < 0.05
    assert (skin < 0.4).any()  # moles
