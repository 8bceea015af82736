"""Held-out boards choose the lens: the simplest that shows them as well as any."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from picture_boards import HEIGHT, NOISE_PX, WIDTH, seen

from bodyscan.calibration import lens_choice
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.held_out import CLEARLY, Compared
from bodyscan.calibration.lens_choice import (
    _HeldOut,
    calibrate_with_lenses,
    choose_lens,
    places,
)
from bodyscan.errors import DegeneratePoses
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.lenses.brown import Brown
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.lenses.rational import Rational

CASES = [
    (Radial(-0.3, 0.1), "radial"),
    (Brown(-0.3, 0.1, 1.5e-3, -1e-3, 0.0), "brown"),
    # Its radial factor levels out towards the corners, where no polynomial of three terms does.
    (Rational(0.2, 0.05, 0.0, 0.0, 0.0, 1.1, 0.3, 0.0), "rational"),
]


@pytest.mark.parametrize(("lens", "kind"), CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_lens_that_there_is_is_chosen(lens: Lens, kind: str, seed: int) -> None:
    found = calibrate_with_lenses(FAMILY, seen(lens, shots=16, seed=seed), WIDTH, HEIGHT)
    assert found.camera.lens.kind == kind
    (chosen,) = (tried for tried in found.lenses if tried.chosen)
    assert chosen.kind == kind
    # Corners err by NOISE_PX in u and v, boards held out hardly more: their poses are fitted to them.
    assert chosen.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.15)
    simpler = found.lenses[: found.lenses.index(chosen)]
    assert all(one.rms_px > chosen.rms_px for one in simpler)


def test_a_board_whose_corners_are_mixed_up_does_not_choose() -> None:
    views = seen(Radial(-0.3, 0.1), shots=14)
    mixed = views[3].pixels[np.random.default_rng(0).permutation(len(views[3].pixels))]
    views[3] = PlanarView(views[3].shot, views[3].points, mixed)
    assert calibrate_with_lenses(FAMILY, views, WIDTH, HEIGHT).camera.lens.kind == "radial"


def test_boards_that_stood_still_are_one_place() -> None:
    views = seen(Radial(-0.3, 0.1), shots=5, again=3)
    assert len(set(places(views).tolist())) <= 5
    assert all(len(set(places(views)[3 * k : 3 * k + 3].tolist())) == 1 for k in range(5))


def test_in_too_few_places_the_simplest_lens_stays_untried() -> None:
    # The same three poses ten times: 30 views, of which none says anything about another.
    views = seen(Brown(-0.3, 0.1, 1.5e-3, -1e-3, 0.0), shots=3, again=10)
    found = calibrate_with_lenses(FAMILY, views, WIDTH, HEIGHT)
    assert found.camera.lens.kind == "radial"
    assert found.lenses == ()


def test_two_poses_are_refused() -> None:
    with pytest.raises(DegeneratePoses):
        calibrate_with_lenses(FAMILY, seen(Radial(), shots=2), WIDTH, HEIGHT)


@pytest.mark.parametrize(
    ("gains", "kind", "richest"),
    [
        ([CLEARLY - 0.1], Radial, Brown),
        ([CLEARLY, CLEARLY - 0.1], Brown, Rational),
        ([CLEARLY, CLEARLY], Rational, Rational),
    ],
)
def test_lenses_are_tried_until_one_is_not_clearly_better(
    gains: list[float], kind: type[Lens], richest: type[Lens], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the last one tried leaves open says how well pixels are known."""
    fits = {each: SimpleNamespace(camera=SimpleNamespace(lens=each())) for each in FAMILY}
    left, compared = list(gains), []

    def better(both: Compared) -> float:
        compared.append((both.simple[0, 0], both.rich[0, 0]))
        assert both.part.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
        return left.pop(0)

    instead: dict[str, Any] = {
        "_fit": lambda each, *_: fits[each],
        "_hold_out": lambda fit, *_: _HeldOut(
            tuple(np.full((2, 2), float(FAMILY.index(type(fit.camera.lens)))) for _ in range(4))
        ),
        "places": lambda views: np.arange(4),
        "gain": better,
        "ray_uncertainty": lambda camera, rich, _: (type(camera.lens), type(rich.camera.lens)),
    }
    for name, value in instead.items():
        monkeypatch.setattr(lens_choice, name, value)
    view: Any = SimpleNamespace(points=np.zeros((2, 3)))
    nothing: Any = None
    found: Any = choose_lens(FAMILY, nothing, [], [view] * 4)
    assert type(found.fit.camera.lens) is kind
    assert found.rays == (kind, richest)
    assert [trial.gain for trial in found.trials] == [None, *gains]
    assert [trial.kind for trial in found.trials if trial.chosen] == [kind.kind]
    # Each against the one that was best until then; RMS lengths of residuals of 0, 1 and 2.
    assert compared == [(0.0, 1.0), (1.0, 2.0)][: len(gains)]
    assert [trial.rms_px for trial in found.trials] == pytest.approx(
        [k * np.sqrt(2.0) for k in range(len(gains) + 1)]
    )


@pytest.mark.parametrize(
    ("kinds", "count", "richest"),
    [(FAMILY, 3, Brown), ((Brown,), 9, Brown), ((Radial, Rational), 3, Rational)],
)
def test_of_one_lens_or_three_places_nothing_is_tried(
    kinds: tuple[type[Lens], ...], count: int, richest: type[Lens], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though what the next lens leaves open is not known."""
    fits = {each: SimpleNamespace(camera=each) for each in FAMILY}
    monkeypatch.setattr(lens_choice, "_fit", lambda kind, *_: fits[kind])
    monkeypatch.setattr(lens_choice, "places", lambda views: np.arange(count))
    monkeypatch.setattr(
        lens_choice, "ray_uncertainty", lambda camera, rich, _: (camera, rich.camera)
    )
    nothing: Any = None
    found: Any = choose_lens(kinds, nothing, [], [])
    assert found.trials == ()
    assert found.rays == (kinds[0], richest)


@pytest.mark.parametrize(("moved_px", "one"), [(24.0, True), (26.0, False)])
def test_a_board_that_moved_by_a_twentieth_of_its_picture_is_elsewhere(
    moved_px: float, one: bool
) -> None:
    """Of 300 by 400 px; some of its corners may be hidden, and one may be wrong."""
    points = np.array([[x, y, 0.0] for y in (0.0, 100.0, 200.0) for x in (0.0, 150.0)])
    pixels = points[:, :2] * 2.0 + [100.0, 50.0]
    later = pixels + moved_px * np.array([0.6, 0.8])
    later[5] += 300.0
    views = [PlanarView("a", points, pixels), PlanarView("b", points[1:], later[1:])]
    # The diagonal is 500 px: a twentieth of it is 25.
    assert (len(set(places(views).tolist())) == 1) is one
    assert places([views[0], PlanarView("a", points, later + 200.0)]).tolist() == [0, 0], "one shot"
    none_alike = PlanarView("c", points + [0.0, 0.0, 7.0], pixels)
    assert places([views[0], none_alike]).tolist() == [0, 1]
