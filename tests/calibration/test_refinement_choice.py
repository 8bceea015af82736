"""A pair by itself on bent and flat boards: the way to solve follows held-out boards."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from lit_boards import binned, chapter_scene
from sheet_models import PINHOLE

from bodyscan.arrays import Array, Indices
from bodyscan.calibration import refinement_choice
from bodyscan.calibration.board_form import EXACT_PRINT, BoardForm
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import boundary_points, concatenate, subsample
from bodyscan.calibration.camera import CameraCalibration, calibrate_camera
from bodyscan.calibration.held_out import CLEARLY, Compared
from bodyscan.calibration.joint_refinement import StripedBoard, known_apart, striped_board
from bodyscan.calibration.light_sheets import fit_light_sheets
from bodyscan.calibration.refinement_choice import (
    APART,
    BENT,
    TOGETHER,
    Refinement,
    refine_where_better,
)
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform

SCENE = chapter_scene()
TURNS = (
    (0.35, 0.2, 0.1),
    (-0.3, 0.25, 0.0),
    (0.05, -0.45, -0.1),
    (-0.2, -0.3, 0.4),
    (0.3, -0.2, 0.2),
)
CORNER_PX, STRIPE_PX, FLATNESS_MM = 0.015, 0.06, 0.1


def bow(places: Array, bow_mm: float) -> Array:
    """How high the board's middle stands out, (N,) mm, at places (N, 2) on it."""
    x, y = ((places - SCENE.size / 2.0) / SCENE.size).T
    return np.asarray(-bow_mm * (1.0 - 2.0 * (x**2 + y**2)), np.float64)


def seen_on_bent_board(pose: RigidTransform, bow_mm: float) -> tuple[Indices, Array]:
    """Boundaries and where they are seen (N, 2) px on a board bent by so much."""
    index, pixels = SCENE.crossings(pose, 8)
    wanted = index.astype(float)
    for _ in range(3):
        s = SCENE.projector.stripe(_on_bent(pixels, pose, bow_mm))
        ahead = SCENE.projector.stripe(_on_bent(pixels + [0.5, 0.0], pose, bow_mm))
        pixels[:, 0] += (wanted - s) * 0.5 / (ahead - s)
    return index, pixels


def _on_bent(pixels: Array, pose: RigidTransform, bow_mm: float) -> Array:
    rays = SCENE.camera.rays(pixels)
    flat = points = SCENE.on_plane(pixels, pose)
    for _ in range(3):
        height = bow(pose.inverse().apply(points)[:, :2], bow_mm)
        points = flat + rays * (height / (rays @ pose.rotation[:, 2]))[:, None]
    return points


@dataclass(frozen=True, eq=False)
class Solved:
    own: CameraCalibration
    sheets: SmoothSheets
    boards: list[StripedBoard]
    refinement: Refinement


def printer_errors(size_mm: float, seed: int) -> Array:
    """How far off a printer sets 48 corners, (48, 3) mm: a stretch, a skew and a bend of each axis,
    that is of `size_mm` times 1, 1 and 1/2 at the rims."""
    x, y = (np.moveaxis(np.indices((6, 8)), 0, -1)[..., ::-1].reshape(-1, 2) / [3.5, 2.5] - 1.0).T
    patterns = np.stack([x, y, x * y / 2.0, x**2 / 2.0, y**2 / 2.0], axis=1)
    amounts = size_mm * np.random.default_rng([seed, 48]).standard_normal((5, 2))
    return np.column_stack([patterns @ amounts, np.zeros(48)])


def solved(bow_mm: float, boards: int, seed: int = 0, print_mm: float = 0.0) -> Solved:
    rng = np.random.default_rng(seed)
    poses = [
        SCENE.looking_at([5.0 * k - 10.0, 0.0, 390.0 + 8.0 * k], turn)
        for k, turn in enumerate(TURNS[:boards])
    ]
    column, row = np.meshgrid(np.arange(1, 9), np.arange(1, 7))
    corners = np.column_stack([20.0 * column.ravel(), 20.0 * row.ravel(), np.zeros(48)])
    true = corners + np.column_stack([np.zeros((48, 2)), bow(corners[:, :2], bow_mm)])
    true += printer_errors(print_mm, seed)
    views = [
        PlanarView(f"s{k}", corners, pixels + rng.normal(0.0, CORNER_PX, pixels.shape))
        for k, pixels in enumerate(SCENE.camera.project(pose.apply(true)) for pose in poses)
    ]
    own = calibrate_camera(views, 640, 480)
    parts = []
    for k, pose in enumerate(poses):
        index, pixels = seen_on_bent_board(pose, bow_mm)
        pixels[:, 0] += rng.normal(0.0, STRIPE_PX, len(pixels))
        means = binned(index, pixels, STRIPE_PX, "vertical")
        placed = own.camera_from_board[f"s{k}"]
        parts.append(boundary_points(own.camera, placed, *means, board=k, direction="vertical"))
    data = subsample(concatenate(parts), 1500)
    sheets = fit_light_sheets(data, 254, "vertical").sheets
    striped = [striped_board(v, own.camera, data, k, "b") for k, v in enumerate(views)]
    assert isinstance(sheets, SmoothSheets)
    found = refine_where_better(own, sheets, striped, data, {"b": FLATNESS_MM})
    return Solved(own, sheets, striped, found)


def flat_plate(camera: Camera, sheets: SmoothSheets) -> tuple[float, Array]:
    """RMS from flat of a plate within the boards, mm, and its depths' errors over sigmas."""
    pose = SCENE.looking_at([0.0, 0.0, 405.0], [0.1, 0.1, 0.0])
    u, v = np.meshgrid(np.arange(220.0, 480.0, 20.0), np.arange(190.0, 390.0, 20.0))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    true = SCENE.on_plane(pixels, pose)
    s = SCENE.projector.stripe(true)
    rays = camera.rays(pixels)
    depth = sheets.depth(rays, s)
    points = rays * depth[:, None]
    centred = points - points.mean(axis=0)
    flat = float(np.sqrt(np.linalg.eigvalsh(centred.T @ centred / len(centred))[0]))
    return flat, (depth - true[:, 2]) / np.sqrt(sheets.variance_mm2(rays, s, depth))


@pytest.fixture(scope="module")
def bent() -> Solved:
    return solved(0.1, 5)


@pytest.fixture(scope="module")
def flat() -> Solved:
    return solved(0.0, 3)


def chosen(found: Solved) -> str:
    return next(trial.way for trial in found.refinement.trials if trial.chosen)


def test_a_bent_board_is_found_out_by_a_pair_alone(bent: Solved) -> None:
    assert chosen(bent) == BENT
    fit = bent.refinement.fit
    assert fit is not None
    # Inner corners reach 70/90 of the way to the rims: of the bow of 0.1 mm both ways together
    # 2 * 0.1 * ((70/180)^2 + (50/140)^2) lie between the lowest and the highest.
    assert fit.forms["b"].out_of_plane_mm == pytest.approx(0.0558, abs=0.006)
    before = flat_plate(bent.own.camera, bent.sheets)[0]
    after = flat_plate(fit.camera, fit.sheets)[0]
    # Taken for flat the board bends the plate by a twelfth of its own bow.
    assert before > 0.006
    assert after < 0.003


def test_flat_boards_are_left_flat(flat: Solved) -> None:
    assert chosen(flat) in (APART, TOGETHER)
    fit = flat.refinement.fit
    assert fit is not None
    assert not fit.forms["b"].heights.any()
    assert flat_plate(fit.camera, fit.sheets)[0] < 0.002


def test_what_was_tried_and_refused_is_said(flat: Solved) -> None:
    trials = flat.refinement.trials
    assert [trial.way for trial in trials] == [APART, TOGETHER, BENT]
    assert trials[0].gain is None
    for trial in trials[1:]:
        assert trial.gain is not None
        assert f"{trial.way}: {trial.gain:+.1f} standard errors" in flat.refinement.reason


def test_sigmas_are_those_of_the_errors_whether_boards_are_bent_or_not(
    flat: Solved, bent: Solved
) -> None:
    pulls = []
    for one in (flat, bent, solved(0.0, 3, seed=1), solved(0.1, 4, seed=1)):
        found = one.refinement.fit
        assert found is not None
        pulls.append(flat_plate(found.camera, found.sheets)[1])
    rms = [float(np.sqrt(np.mean(pull**2))) for pull in pulls]
    # Errors are common to the plate, so these are four draws, not 4 x 130: 1 +- 0.35.
    assert 0.6 < np.sqrt(np.mean(np.square(rms))) < 1.4, rms
    assert max(rms) < 3.0


def test_what_few_poses_cannot_see_of_a_print_is_in_the_camera_s_sigmas() -> None:
    """A print that is skewed looks like a camera that is: its other faults tell how much of that
    there may be."""
    pulls = []
    for seed in range(6):
        found = solved(0.0, 3, seed, print_mm=0.02).refinement.fit
        assert found is not None
        off = found.camera.parameters - SCENE.camera.parameters
        pulls.append((off / np.sqrt(np.diag(found.camera_covariance)))[2:5])
    # Skew and principal point of six draws: 7.5 if corners err one by one alone. 18 draws of unit
    # normals have an RMS of 1 +- 0.17; but how much stretch there may be is told by three patterns
    # of each axis, which is known to a factor of 1.5 or so.
    assert 0.6 < np.sqrt(np.mean(np.square(pulls))) < 2.0, np.round(pulls, 1)


def test_what_few_poses_cannot_see_of_a_bow_is_in_the_sigmas(flat: Solved) -> None:
    points = flat.boards[0].view.points
    sigmas = []
    for flatness_mm in (0.0, 0.1, 1.0):
        forms = {"b": BoardForm.flat(points, flatness_mm, EXACT_PRINT)}
        known = known_apart(
            flat.own.camera, flat.own.camera_from_board, flat.sheets, flat.boards, forms
        )
        sigmas.append(np.sqrt(np.trace(known.camera_covariance[:2, :2])))
        assert np.array_equal(known.sheets.parameters, flat.sheets.parameters)
    # Corners of three poses know a bow to some hundredths of a millimetre: a tenth of the focal
    # length's own sigma, however much is believed beforehand.
    assert sigmas[1] > 1.05 * sigmas[0]
    assert sigmas[2] > sigmas[1]


def test_whether_camera_and_light_are_others_than_before_is_said(
    bent: Solved, flat: Solved
) -> None:
    assert bent.refinement.taken
    assert flat.refinement.taken is (chosen(flat) != APART)
    for one in (bent, flat):
        assert one.refinement.reason.startswith(chosen(one))
        first, now = one.refinement.flatness_mm or (0.0, 0.0)
        assert first == one.refinement.trials[0].rms_mm
        assert now == next(trial.rms_mm for trial in one.refinement.trials if trial.chosen)


@pytest.mark.parametrize(
    ("gains", "way", "compared"),
    [
        ((-0.1, CLEARLY - 0.1), APART, [(0, 1), (0, 2)]),
        ((-0.1, CLEARLY), BENT, [(0, 1), (0, 2)]),
        ((0.0, CLEARLY - 0.1), TOGETHER, [(0, 1), (1, 2)]),
        ((0.3, CLEARLY), BENT, [(0, 1), (1, 2)]),
    ],
)
def test_a_way_is_taken_where_it_is_as_good_and_bent_boards_where_they_are_clearly_better(
    monkeypatch: pytest.MonkeyPatch,
    gains: tuple[float, float],
    way: str,
    compared: list[tuple[int, int]],
) -> None:
    """Each is held against the way that was best until then; a fit that is not the richest gets what
    that leaves open."""
    fits = [SimpleNamespace(name=name) for name in (APART, TOGETHER, BENT)]
    held = [
        SimpleNamespace(stripes=np.full((6, 1), 1.0 + k), corners=np.full((4, 2), k))
        for k in range(3)
    ]
    left, seen = list(gains), []

    def solve(*_: Any, bent: bool = True, **__: Any) -> Any:
        if not bent:
            return fits[1]
        done = SimpleNamespace(forms={}, camera=None, camera_from_board=None, sheets=None)
        return vars(fits[2]).update(vars(done)) or fits[2]

    def better(stripes: Compared, corners: Compared) -> float:
        assert np.array_equal(corners.simple, np.full((4, 2), stripes.simple[0, 0] - 1.0))
        seen.append((int(stripes.simple[0, 0] - 1.0), int(stripes.rich[0, 0] - 1.0)))
        return left.pop(0)

    instead: dict[str, Any] = {
        "refine_jointly": solve,
        "print_errors": lambda *_: {},
        "known_apart": lambda *_: fits[0],
        "_hold_out": lambda *_: held,
        "parts_of_boards": lambda _: np.repeat([0, 1, 2], 2),
        "gain": better,
        "shared_weights": lambda _: np.ones(6),
        "allowing_for": lambda fit, richest, _: (fit.name, richest.name),
    }
    for name, value in instead.items():
        monkeypatch.setattr(refinement_choice, name, value)
    camera: Any = SimpleNamespace(camera=None, camera_from_board=None)
    board: Any = SimpleNamespace(view=SimpleNamespace(points=np.zeros((4, 3))))
    nothing: Any = None
    sheets: Any = PINHOLE
    found: Any = refine_where_better(camera, sheets, [board] * 3, nothing, {})
    assert seen == compared
    assert found.taken is (way != APART)
    assert found.reason.startswith(way)
    assert found.fit == (fits[2] if way == BENT else (way, BENT))
    assert [trial.gain for trial in found.trials] == [None, *gains]
    assert [trial.rms_mm for trial in found.trials] == [1.0, 2.0, 3.0]
    few: Any = refine_where_better(camera, sheets, [board] * 2, nothing, {})
    assert (few.fit, few.taken) == (fits[0], False)
    assert few.reason == "2 boards with stripes are too few"
