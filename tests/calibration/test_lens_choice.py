"""Held-out boards choose the lens: the simplest that shows them as well as any."""

from __future__ import annotations

import numpy as np
import pytest
from picture_boards import HEIGHT, NOISE_PX, WIDTH, calibrate_with_lenses, seen

from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.lens_selection import calibrate_widest, choose_lens, cluster_poses
from bodyscan.geometry.lenses import FAMILY
from bodyscan.geometry.lenses.fisheye import Fisheye
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial, Rational

CASES = [
    (Radial(-0.3, 0.1), 800.0, "radial"),
    (Brown(-0.3, 0.1, 1.5e-3, -1e-3, 0.0), 800.0, "brown"),
    # Its radial factor levels out towards the corners, where no polynomial of three terms does.
    (Rational(0.2, 0.05, 1e-3, -1e-3, 0.0, 0.9, 0.2, 0.0), 800.0, "rational"),
    # Corners are up to 70 degrees off the axis, where Brown's lens is no better than the chapter's.
    (Fisheye(0.04, -0.03, 0.01, -0.002), 250.0, "fisheye"),
]


@pytest.mark.parametrize(("lens", "focal", "kind"), CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_lens_that_there_is_is_chosen(lens: Lens, focal: float, kind: str, seed: int) -> None:
    found = calibrate_with_lenses(seen(lens, shots=16, seed=seed, focal=focal))
    assert found.fit.camera.lens.kind == kind
    (chosen,) = (tried for tried in found.trials if tried.chosen)
    assert chosen.kind == kind
    # Corners err by NOISE_PX in u and v, boards held out hardly more: their poses are fitted to them.
    assert chosen.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.15)
    simpler = found.trials[: found.trials.index(chosen)]
    # Of a fisheye a rational lens, with twice its coefficients, may be as good.
    assert all(one.rms_px > 0.99 * chosen.rms_px for one in simpler)


def test_a_lens_needs_no_more_than_the_best_prediction() -> None:
    """What a k3 adds that eight boards hardly show is in its covariance; left out, it is in none."""
    lens = Brown(-0.3, 0.1, 0.0, 0.0, -0.03)
    views = [seen(lens, shots=8, seed=seed, focal=800.0) for seed in range(4)]
    trials = [trial for each in views for trial in calibrate_with_lenses(each).trials]
    assert any(0.0 < (trial.gain or 0.0) < 3.0 for trial in trials if trial.chosen)


@pytest.mark.parametrize(("reach", "seed"), [(0.3, 0), (0.3, 1), (0.6, 0), (0.6, 1)])
def test_of_lenses_that_do_as_well_one_that_does_not_fold_is_chosen(
    reach: float, seed: int
) -> None:
    """Boards before the middle of a fisheye: beyond them richer polynomials turn back."""
    views = seen(Fisheye(0.02, -0.01, 0.003, 0.0), shots=20, seed=seed, focal=380.0, reach=reach)
    start = calibrate_widest(FAMILY, views, WIDTH, HEIGHT)
    assert start.camera.ray_share() > 0.5
    chosen = choose_lens(FAMILY, start.camera, start.poses, views).fit
    assert chosen.camera.ray_share() > 0.9
    assert chosen.rms_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.15)


def test_a_board_whose_corners_are_mixed_up_does_not_choose() -> None:
    views = seen(Radial(-0.3, 0.1), shots=14)
    mixed = views[3].pixels[np.random.default_rng(0).permutation(len(views[3].pixels))]
    views[3] = PlanarView(views[3].shot, views[3].points, mixed)
    assert calibrate_with_lenses(views).fit.camera.lens.kind == "radial"


def test_boards_that_stood_still_are_one_cluster() -> None:
    views = seen(Radial(-0.3, 0.1), shots=5, again=3)
    assert len(set(cluster_poses(views).tolist())) <= 5
    assert all(len(set(cluster_poses(views)[3 * k : 3 * k + 3].tolist())) == 1 for k in range(5))


def test_with_too_few_clusters_no_lens_is_tried() -> None:
    # The same three poses ten times: 30 views, of which none says anything about another.
    views = seen(Brown(-0.3, 0.1, 1.5e-3, -1e-3, 0.0), shots=3, again=10)
    found = calibrate_with_lenses(views)
    assert found.fit.camera.lens.kind == "radial"
    assert found.trials == ()
