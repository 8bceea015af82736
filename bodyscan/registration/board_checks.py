"""Compare boards with their description in the rig file, by all views of them together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from scipy.optimize import minimize_scalar

from bodyscan.arrays import Array
from bodyscan.boards.board_layout import compute_corner_points, count_corners_per_face
from bodyscan.boards.board_map import fit_board_map
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import has_enough_corners, make_planar_view
from bodyscan.calibration.camera import CameraCalibration, calibrate_camera
from bodyscan.errors import BadInput, DegeneratePoses
from bodyscan.geometry.camera import Camera
from bodyscan.rig.board import Board
from bodyscan.rig.rig import Rig


def describe_board(board: Board) -> str:
    """The board as the rig file describes it, for a message."""
    marker = f", markers of {board.marker_mm:g} mm, {board.dictionary}" if board.marker_mm else ""
    return (
        f"board {board.name} ({board.kind}, {board.columns} columns x {board.rows} rows of squares "
        f"of {board.square_mm:g} mm{marker})"
    )


def refuse_other_pitch(board: Board, views: Sequence[BoardView]) -> None:
    """Raise BadInput if tags stand 0.3 % otherwise than described: focal lengths err by half of it.

    Whatever homography and lens a view has, it shows the ratio of tag and distance, to a few parts in
    ten thousand. Views of less than 40 corners do not determine the lens.
    """
    complete = [v for v in views if v.board == board.name and len(v.pixels) >= 40]
    complete = sorted(complete, key=lambda view: -len(view.pixels))[:10]
    if board.kind != "aprilgrid" or board.marker_mm is None or not complete:
        return

    def misfit(square_mm: float) -> float:
        tried = compute_corner_points(board.model_copy(update={"square_mm": square_mm}))[:, :2]
        fits = ((tried[v.corner_ids], v.pixels) for v in complete)
        errors = [fit_board_map(xy, pixels).apply(xy) - pixels for xy, pixels in fits]
        return float(np.median(np.abs(np.concatenate(errors))))

    side, square_mm = board.marker_mm, board.square_mm
    pitch = float(minimize_scalar(misfit, bounds=(1.02 * side, 2.0 * side), method="bounded").x)
    if abs(pitch / square_mm - 1.0) > 3e-3:
        raise BadInput(
            f"tags of {side:g} mm stand {pitch:.2f} mm from one another in images, not {square_mm:g}",
            where=f"board {board.name}",
            remedy=f"measure both on the print: square_mm {pitch:.2f} would fit marker_mm {side:g}, or "
            f"marker_mm {side * square_mm / pitch:.2f} square_mm {square_mm:g}",
        )


def find_common_aspect(cameras: Iterable[tuple[Camera, Array]]) -> float:
    """Return fy / fx if all cameras, each with the covariance (P, P) of its parameters, have one in
    common that is not 1, beyond 0.5 % and three sigmas; else 1."""
    ratios, variances = [], []
    for camera, covariance in cameras:
        slope = np.array([-1.0 / camera.alpha, 1.0 / camera.beta])
        ratios.append(math.log(camera.beta / camera.alpha))
        variances.append(slope @ covariance[:2, :2] @ slope + 2e-3**2)  # sensors differ by 0.2 %
    weights = 1.0 / np.array(variances)
    mean, sigma = float(np.average(ratios, weights=weights)), float(weights.sum() ** -0.5)
    # With a wrong board each camera's ratio follows its own views, by some tenths.
    agree = np.all((np.array(ratios) - mean) ** 2 < 9.0 / weights + (0.3 * mean) ** 2)
    return math.exp(mean) if agree and abs(mean) > max(5e-3, 3.0 * sigma) else 1.0


def correct_stretch(
    rig: Rig, views: Sequence[BoardView], cameras: Mapping[str, CameraCalibration]
) -> tuple[Rig, list[str]]:
    """Return the rig with its boards stretched as their views show, and a line on each that is.

    Printers stretch pages along one axis. In upright views that looks like pixels that are not square,
    of all cameras alike; in views of a turned board it cannot, and leaves large residuals.
    """
    ratio = find_common_aspect((one.camera, one.covariance) for one in cameras.values())
    boards, notes = list(rig.boards), list[str]()
    for k, board in enumerate(rig.boards):
        groups = [
            (found.camera, [v for v in views if (v.pair, v.board) == (name, board.name)])
            for name, found in cameras.items()
        ]
        groups = sorted(groups, key=lambda group: -len(group[1]))[:2]
        # Two cameras and some twenty views of each are enough.
        groups = [(camera, every[:: 1 + len(every) // 20]) for camera, every in groups]
        count = sum(len(view.pixels) for _, group in groups for view in group)
        misfit = partial(_compute_misfit_of_stretch, board, groups)
        with suppress(DegeneratePoses):
            about = ratio**2 if ratio != 1.0 else _estimate_stretch(misfit)
            if about == 1.0:
                continue
            bounds = min(1.0, about) / 1.01, max(1.0, about) * 1.01
            found = minimize_scalar(misfit, bounds=bounds, method="bounded")
            # In variances of a corner: chance gives one, bent boards and simple lenses some tens.
            if misfit(1.0) - found.fun > 100.0 * found.fun / count:
                boards[k] = board.model_copy(update={"stretch": board.stretch * float(found.x)})
                notes.append(
                    f"board {board.name}: squares are {found.x:.4f} times as high as wide, by views of "
                    "the turned board; using that: measure both sides, write `stretch` in the rig file"
                )
    return rig.model_copy(update={"boards": tuple(boards)}), notes


def _compute_misfit_of_stretch(
    board: Board, groups: Sequence[tuple[Camera, Sequence[BoardView]]], stretch: float
) -> float:
    """Sum of the squared residuals, px2, of cameras calibrated with squares so many times as high."""
    tried, total = board.model_copy(update={"stretch": board.stretch * stretch}), 0.0
    for camera, views in groups:
        used = (view for view in views if has_enough_corners(view, tried))
        planar = [make_planar_view(view, tried) for view in used]
        found = calibrate_camera(planar, camera.width, camera.height, type(camera.lens)())
        total += found.rms_px**2 * sum(len(view.pixels) for view in planar)
    return total


def _estimate_stretch(misfit: Callable[[float], float]) -> float:
    """Estimate where the misfit is least, by a parabola; 1 unless the stretch explains more than it
    leaves: a wrong lens or a bent board leaves most of its own."""
    low, middle, high = (misfit(stretch) for stretch in (0.99, 1.0, 1.01))
    slope, curvature = (high - low) / 2.0, low - 2.0 * middle + high
    return 1.0 - 0.01 * slope / curvature if slope**2 > middle * curvature > 0.0 else 1.0


def list_boards_not_found(rig: Rig, views: Sequence[BoardView], images: int) -> list[str]:
    """One line for each board that no image shows as the rig file describes it."""
    found = {view.board for view in views}
    return [
        f"{describe_board(board)} was found in none of {images} images: check it against the board "
        "itself: kind, columns and rows (they count squares, not corners)"
        + (", dictionary, and square_mm against marker_mm" if board.marker_mm else "")
        for board in rig.boards
        if board.name not in found and images
    ]


def describe_findings(rig: Rig, views: Sequence[BoardView], images: int) -> str:
    """How much of each board was seen and what to check, for when no camera could be calibrated."""
    lines = list_boards_not_found(rig, views, images)
    for board in rig.boards:
        count = count_corners_per_face(board)
        shares = [len(view.pixels) / count for view in views if view.board == board.name]
        if shares:
            # The description may be wrong if the median view shows less than half of the corners.
            median = float(np.median(shares))
            hint = ": its columns, rows or square_mm in the rig file may not be those of the board"
            lines.append(
                f"{describe_board(board)} was found in {len(shares)} of {images} images, with "
                f"{100 * median:.0f} % of its corners in the median view{hint if median < 0.5 else ''}"
            )
    return "\n  ".join(lines)


def note_appearance(rig: Rig, views: Sequence[BoardView]) -> list[str]:
    """One line for each difference between a board and its description in the rig file."""
    by_board = ((board, [v for v in views if v.board == board.name]) for board in rig.boards)
    return [line for board, of_it in by_board for line in _note_board(board, of_it)]


def _note_board(board: Board, views: Sequence[BoardView]) -> Iterator[str]:
    def where(views: Iterable[BoardView]) -> str:
        pairs = sorted({view.pair for view in views})
        return f"{len(list(views))} views ({', '.join(pairs)})"

    inverted = [view for view in views if view.appearance.inverted]
    mirrored = [view for view in views if view.appearance.mirrored]
    other = [view for view in views if view.appearance.other_layout]
    if inverted:
        yield f"board {board.name} is white on black in {where(inverted)}; using that"
    if mirrored:
        others = (
            ". Other cameras see it as printed: if none looks at it from behind, the images of these "
            "are flipped"
        )
        yield (
            f"board {board.name} is mirrored in {where(mirrored)}, as in a mirror or through the "
            "glass it is printed on; using that"
        ) + others * ({view.pair for view in mirrored} != {view.pair for view in views})
    if other:
        layout = "false" if board.legacy_layout else "true"
        yield (
            f"board {board.name} has the other of OpenCV's two layouts (legacy_layout: {layout}) in "
            f"{where(other)}; using that"
        )
