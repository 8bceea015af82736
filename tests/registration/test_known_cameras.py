"""Cameras that were calibrated elsewhere: held in the joint solve, or where it starts from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from ring import as_found, centre_errors, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.view import BoardView
from bodyscan.calibration.known_pair import read_known_camera
from bodyscan.errors import CalibrationFileError
from bodyscan.interchange.rig_format import RIG_FORMATS
from bodyscan.outcome import Outcome
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.pair import Known, KnownCamera
from bodyscan.rig.rig import Rig
from bodyscan.workflows.find_boards import calibrate_cameras, locate_views

PLACINGS, CAMERAS = ring_of_cameras(poles=2, heights=(700, 1100))
KNOWN = "p1-1"
"""The others are not known."""


@pytest.fixture(scope="module")
def views() -> list[BoardView]:
    found, _ = ring_views(PLACINGS, CAMERAS, shots=25, seed=3)
    return as_found(found)


def rig_with(folder: Path, *, off_px: float, sigma_px: float | None) -> Rig:
    """A rig whose file for KNOWN has a principal point so far from the truth."""
    camera = CAMERAS[KNOWN]
    told = replace(camera, u0=camera.u0 + off_px)
    form = RIG_FORMATS.find("opencv")
    form.write({KNOWN: (told, PLACINGS[KNOWN])}, folder / "told.yaml")
    known = Known(file="told.yaml", format="opencv", sigma_px=sigma_px)
    pairs = [
        pair.model_copy(update={"known": known} if pair.name == KNOWN else {})
        for pair in ring_rig(PLACINGS).pairs
    ]
    return ring_rig(PLACINGS, pairs=pairs)


def solved(rig: Rig, views: list[BoardView], folder: Path) -> Outcome[RigSolution]:
    cameras = calibrate_cameras(rig, views, folder=folder)
    assert not cameras.failures
    located = locate_views(rig, views, cameras.value)
    found = solve_rig(rig, located.value, {n: c.camera for n, c in cameras.value.items()})
    return Outcome(found.value, (*cameras.notes, *located.notes, *found.notes))


def test_a_held_camera_stays_to_the_last_digit(views: list[BoardView], tmp_path: Path) -> None:
    found = solved(rig_with(tmp_path, off_px=0.0, sigma_px=None), views, tmp_path)
    np.testing.assert_allclose(
        found.value.cameras[KNOWN].parameters, CAMERAS[KNOWN].parameters, rtol=0, atol=1e-6
    )
    assert found.notes[0] == f"{KNOWN}: camera from told.yaml (opencv), fixed"
    free = solved(ring_rig(PLACINGS), views, tmp_path)
    errors = centre_errors(found.value, PLACINGS).values()
    assert max(np.linalg.norm(error) for error, _ in errors) < 0.6
    # What is known of one camera tells more of where that stands than boards do by themselves.
    sigma = {
        name: np.sqrt(np.trace(one.value.covariance.relative(KNOWN, "p2-1")[3:, 3:]))
        for name, one in (("held", found), ("free", free))
    }
    assert sigma["held"] < sigma["free"]


def test_one_view_places_the_board_before_a_known_camera(
    views: list[BoardView], tmp_path: Path
) -> None:
    """No other view shares its corners, which is what COLMAP asks for."""
    rig = rig_with(tmp_path, off_px=0.0, sigma_px=None)
    rig = rig.model_copy(update={"pairs": tuple(p for p in rig.pairs if p.name == KNOWN)})
    own = next(view for view in views if view.pair == KNOWN)
    found = solved(rig, [own], tmp_path)
    assert found.value.rms_px[KNOWN] < 0.3  # corners have 0.1 px
    assert len(found.value.rig_from_board) == 1


def test_a_start_is_left_as_far_as_its_sigma_lets(views: list[BoardView], tmp_path: Path) -> None:
    found = solved(rig_with(tmp_path, off_px=5.0, sigma_px=5.0), views, tmp_path)
    # 0.03 px of noise on some thousand corners: a principal point is known to a few tenths.
    assert found.value.cameras[KNOWN].u0 == pytest.approx(CAMERAS[KNOWN].u0, abs=0.6)
    assert "a prior of sigma 5 px" in found.notes[0]


def test_another_cameras_file_is_told_by_the_boards(views: list[BoardView], tmp_path: Path) -> None:
    rig = rig_with(tmp_path, off_px=0.0, sigma_px=None)
    other = replace(CAMERAS[KNOWN], alpha=1700.0, beta=1400.0)
    RIG_FORMATS.find("opencv").write({KNOWN: (other, PLACINGS[KNOWN])}, tmp_path / "told.yaml")
    notes = calibrate_cameras(rig, views, folder=tmp_path).notes
    assert "another camera's" in notes[1]


def test_a_file_that_is_wrong_costs_its_pair(views: list[BoardView], tmp_path: Path) -> None:
    rig = rig_with(tmp_path, off_px=0.0, sigma_px=None)
    cameras = calibrate_cameras(rig, views, folder=tmp_path / "elsewhere")
    assert "there is no such file" in cameras.failures[KNOWN]
    assert set(cameras.value) == set(CAMERAS) - {KNOWN}


def test_its_prior_is_no_part_of_a_camera(tmp_path: Path) -> None:
    rig = rig_with(tmp_path, off_px=0.0, sigma_px=2.0)
    found = read_known_camera(rig.pair(KNOWN), tmp_path)
    assert found == CAMERAS[KNOWN]
    assert found.prior is not None
    assert hash(found) == hash(CAMERAS[KNOWN])  # the tables of cameras go by it
    assert np.all(found.prior.sigmas > 0)
    named = KnownCamera(name="somebody")
    strange = rig.pair(KNOWN).model_copy(
        update={"known": Known(file="told.yaml", format="opencv", camera=named)}
    )
    with pytest.raises(CalibrationFileError, match="has no camera 'somebody'"):
        read_known_camera(strange, tmp_path)
