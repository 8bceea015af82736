"""A pair by itself whose stripes changed its camera: boards are where that camera sees them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views

from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.pair import PairCalibration, PairQuality
from bodyscan.registration.rig_solve import RigSolution, solve_rig, update_poses


def misfit_px(placed: RigSolution, views: Sequence[LocatedView]) -> float:
    off = []
    for view in views:
        camera_from_rig = placed.rig_from_camera[view.pair].inverse()
        seen = (camera_from_rig @ placed.rig_from_board[view.target]).apply(view.points)
        off.append(placed.cameras[view.pair].project(seen) - view.pixels)
    return float(np.sqrt(np.mean(np.concatenate(off) ** 2)))


@pytest.mark.parametrize("change", [0.0, 20.0])
def test_boards_follow_the_camera(change: float) -> None:
    placings, cameras = ring_of_cameras(poles=1, heights=(850,))
    views, _ = ring_views(placings, cameras, shots=8)
    rig = ring_rig(placings, fixed="p1-1")
    placed = solve_rig(rig, views, cameras).value
    camera = placed.cameras["p1-1"]
    other = replace(camera, alpha=camera.alpha + change, beta=camera.beta + change)
    pair = PairCalibration("p1-1", other, np.eye(len(camera.parameters)), None, PairQuality(0.1, 8))
    again = update_poses(rig, placed, pair)
    assert (again is placed) == (change == 0.0)
    assert again.cameras["p1-1"] == other
    # Another focal length is made up for by another distance, nearly.
    assert misfit_px(again, placed.views) < 0.4
    if change:
        assert misfit_px(replace(placed, cameras={"p1-1": other}), placed.views) > 1.0
