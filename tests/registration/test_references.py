"""A certified length fixes the size of a rig, with its sigma; what contradicts it is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring import CHARUCO, ring_of_cameras, ring_rig, ring_views

from bodyscan.boards.board_layout import compute_corner_points
from bodyscan.boards.view import BoardView
from bodyscan.errors import FailedWork
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration.references import (
    compute_board_length,
    find_rig_size,
    rescale_boards,
    select_solving_views,
)
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.board import Board
from bodyscan.rig.gauge import Reference
from bodyscan.rig.rig import Rig

PLACINGS, CAMERAS = ring_of_cameras(poles=2, heights=(850, 1300))
BAR_MM = 400.0
SMALLER = 0.997
"""A print three parts in a thousand larger than its file says makes a rig that much too small."""


def plate(name: str, first: int) -> Board:
    return Board(
        name=name, kind="charuco", columns=5, rows=4, square_mm=30, marker_mm=22, first_marker=first
    )


LEFT, RIGHT = plate("left", 200), plate("right", 220)


def small_rig(*references: Reference) -> Rig:
    return ring_rig(PLACINGS, CHARUCO, LEFT, RIGHT, references=references)


def bar(length_mm: float = BAR_MM) -> Reference:
    return Reference(name="bar", boards=("left", "right"), length_mm=length_mm, sigma_mm=0.01)


def placed(scale: float) -> RigSolution:
    """The cameras as boards would place them whose squares are taken to be `scale` of what they are."""
    poses = {
        name: RigidTransform(at.rotation, scale * at.translation) for name, at in PLACINGS.items()
    }
    unknown = PoseCovariance(tuple(poses), np.zeros((6 * len(poses),) * 2))
    return RigSolution(poses, {}, CAMERAS, unknown, (), {})


def bar_views(rng: np.random.Generator, shots: int = 4, noise_px: float = 0.05) -> list[BoardView]:
    """The bar in front of the first pole, both of whose cameras see all of it."""
    views = []
    towards = PLACINGS["p1-1"].translation * [1.0, 1.0, 0.0]
    towards /= np.linalg.norm(towards)
    along = np.cross([0.0, 0.0, 1.0], towards)
    facing = np.column_stack([along, [0.0, 0.0, -1.0], -towards])
    for shot in range(shots):
        turn = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.15, 3), np.zeros(3))
        middle = np.array([0.0, 0.0, 1050.0]) + rng.normal(0.0, 30.0, 3)
        for board, side in ((LEFT, -0.5), (RIGHT, 0.5)):
            own = [0.5 * board.columns * board.square_mm, 0.5 * board.rows * board.square_mm, 0.0]
            points = compute_corner_points(board) - own + [side * BAR_MM, 0.0, 0.0]
            there = points @ (turn.rotation @ facing).T + middle
            for name in ("p1-1", "p1-2"):
                pixels = CAMERAS[name].project(PLACINGS[name].inverse().apply(there))
                pixels = pixels + rng.normal(0.0, noise_px, pixels.shape)
                views.append(
                    BoardView(name, f"r{shot}", board.name, np.arange(len(points)), pixels)
                )
    return views


def test_a_bar_gives_the_size_within_its_sigma() -> None:
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        certified = bar(BAR_MM + 0.01 * rng.standard_normal())
        size = find_rig_size(small_rig(certified), placed(SMALLER), bar_views(rng)).value
        errors.append((size.factor - 1.0 / SMALLER) / size.sigma)
        assert size.sigma < 2e-4  # 0.05 px at 1.3 m over 400 mm
    # RMS of 20 standard normal numbers, four sigmas of it to either side; four shots each.
    assert 0.4 < np.sqrt(np.mean(np.square(errors))) < 1.9


def test_one_certified_board_does_as_well() -> None:
    steel = Reference(
        name="steel", boards=("left",), length_mm=compute_board_length(LEFT), sigma_mm=0.01
    )
    assert compute_board_length(LEFT) == pytest.approx(90.0)
    views = bar_views(np.random.default_rng(0), noise_px=1e-6)
    size = find_rig_size(small_rig(steel), placed(SMALLER), views).value
    assert size.factor == pytest.approx(1.0 / SMALLER, abs=1e-6)
    assert size.sigma == pytest.approx(0.01 / 90.0, rel=0.01)  # the certificate's


def test_a_reference_that_nobody_saw_leaves_the_size_and_is_named() -> None:
    found = find_rig_size(small_rig(bar()), placed(1.0), [])
    assert found.value.factor == 1.0
    assert "reference bar was measured in no shot" in found.notes[0]
    (note,) = find_rig_size(small_rig(), placed(1.0), []).notes
    assert "all lengths rest on square_mm (" in note


def test_the_rig_has_its_size_after_a_second_solve() -> None:
    """Boards of 70 mm that the rig file says are 69.79."""
    views, _ = ring_views(PLACINGS, CAMERAS, shots=12)
    rig = small_rig(bar())
    small = [
        replace(
            view,
            points=SMALLER * view.points,
            camera_from_board=RigidTransform(
                view.camera_from_board.rotation, SMALLER * view.camera_from_board.translation
            ),
        )
        for view in views
    ]
    first = solve_rig(rig, small, CAMERAS).value
    size = find_rig_size(rig, first, bar_views(np.random.default_rng(0))).value
    second = rescale_boards(rig, size.factor)
    assert second.board("left").square_mm == 30.0  # the bar's own boards are what they are
    ratio = second.board("board").square_mm / CHARUCO.square_mm
    # Nominal places hold one camera; the other's distance is 0.4 m away.
    assert ratio == pytest.approx(1.0 / SMALLER, abs=4 * size.sigma)


def test_boards_of_references_do_not_place_the_rig() -> None:
    views = bar_views(np.random.default_rng(0), shots=1)
    assert select_solving_views(small_rig(bar()), views) == []
    alone = small_rig(bar()).model_copy(update={"boards": (LEFT, RIGHT)})
    assert select_solving_views(alone, views) == views


@pytest.mark.parametrize(("sigmas", "refused"), [(3.9, False), (4.1, True)])
def test_references_count_by_their_sigmas_and_may_differ_by_four(
    sigmas: float, refused: bool
) -> None:
    """A board of 90 mm and a bar of 400 mm, each certified to 0.01 mm, and corners without noise."""
    one, other = 0.01 / 90.0, 0.01 / 400.0
    share = one**-2 / (one**-2 + other**-2)
    longer = sigmas * one / (1.0 - share)
    steel = Reference(
        name="steel", boards=("left",), length_mm=90.0 * (1.0 + longer), sigma_mm=0.01
    )
    views = bar_views(np.random.default_rng(0), noise_px=1e-6)
    if refused:
        with pytest.raises(FailedWork, match=r"disagree: bar: .*steel: "):
            find_rig_size(small_rig(bar(), steel), placed(1.0), views)
        return
    size = find_rig_size(small_rig(bar(), steel), placed(1.0), views).value
    assert size.factor == pytest.approx(1.0 + share * longer, abs=1e-6)
    assert size.sigma == pytest.approx((one**-2 + other**-2) ** -0.5, rel=1e-3)


def cut(views: list[BoardView], board: str, corners: dict[str, int]) -> list[BoardView]:
    """Of that board, cameras saw so many corners."""
    return [
        replace(
            view,
            corner_ids=view.corner_ids[: corners[view.pair]],
            pixels=view.pixels[: corners[view.pair]],
        )
        if view.board == board
        else view
        for view in views
    ]


@pytest.mark.parametrize(
    ("corners", "measured"), [((6, 12), True), ((5, 12), False), ((12, 5), False), ((0, 0), False)]
)
def test_two_cameras_have_to_see_six_corners_of_each_board(
    corners: tuple[int, int], measured: bool
) -> None:
    views = bar_views(np.random.default_rng(0), noise_px=1e-6)
    seen = cut(views, "right", dict(zip(("p1-1", "p1-2"), corners, strict=True)))
    if not any(corners):
        seen = [view for view in views if view.board == "left"]
    found = find_rig_size(small_rig(bar()), placed(SMALLER), seen)
    assert ("measured in no shot" in found.notes[0]) != measured
    # From half of its corners, 30 mm off, a middle is reached by the size that is told of the print.
    assert found.value.factor == pytest.approx(1.0 / SMALLER if measured else 1.0, abs=3e-4)


@pytest.mark.parametrize(
    ("scale", "judged"),
    [
        (0.9, "refused"), (0.92, "asked about"), (0.95, "asked about"), (0.9999, "taken"),
        (1.1, "asked about"), (1.12, "refused"),
    ],
)  # fmt: skip
def test_a_size_that_no_print_is_off_by_is_asked_about_and_a_tenth_off_refused(
    scale: float, judged: str
) -> None:
    """1 / 1.1 is 9 % off, 1 / 0.9 is 11 %."""
    views = bar_views(np.random.default_rng(0))
    if judged == "refused":
        with pytest.raises(FailedWork, match="times as large as square_mm says"):
            find_rig_size(small_rig(bar()), placed(scale), views)
        return
    found = find_rig_size(small_rig(bar()), placed(scale), views)
    assert found.value.factor == pytest.approx(1.0 / scale, abs=1e-3)
    assert "scale from references" in found.notes[-1]
    assert ("is square_mm right" in " ".join(found.notes)) == (judged == "asked about")


def test_a_board_is_resized_with_its_markers_and_a_certified_one_alone_as_well() -> None:
    rig = rescale_boards(small_rig(bar()), 1.25)
    assert [board.square_mm for board in rig.boards] == [87.5, 30.0, 30.0]
    assert [board.marker_mm for board in rig.boards] == [65.0, 22.0, 22.0]
    alone = rescale_boards(small_rig(bar()).model_copy(update={"boards": (LEFT, RIGHT)}), 1.25)
    assert [(board.square_mm, board.marker_mm) for board in alone.boards] == [(37.5, 27.5)] * 2
