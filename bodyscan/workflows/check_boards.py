"""Check with shots of a board whether a calibrated rig is unchanged, and repair it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bodyscan.arrays import Array
from bodyscan.boards.view import BoardView
from bodyscan.calibration.board_views import LocatedView
from bodyscan.calibration.camera import CameraCalibration
from bodyscan.calibration.pair import PairCalibration
from bodyscan.calibration.striped_view import BoardBoundaries, StripedView, on_board
from bodyscan.captures.folder import Captures
from bodyscan.errors import BoardNotFound
from bodyscan.geometry.light_sheets import intersect_rays
from bodyscan.outcome import Outcome
from bodyscan.progress import Progress, silent
from bodyscan.registration.drift import Drift, Move, find_drift, observe_pose
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.workflows.decode import decode_on_boards
from bodyscan.workflows.find_boards import find_all_boards, locate_views


@dataclass(frozen=True)
class StripeOffset:
    """Distance of the surface that a pair's stripes measure from the board that its corners show.

    offset_mm: median over all boards, positive away from the camera.
    tilt_mm: half the difference between the board's two ends.
    sigma_mm: the sigma that the calibration predicts.
    """

    pair: str
    offset_mm: float
    tilt_mm: float
    sigma_mm: float

    @property
    def moved(self) -> bool:
        """Whether the projector has moved relative to its camera: 5 sigmas and 0.25 mm."""
        return max(abs(self.offset_mm), abs(self.tilt_mm)) > max(5.0 * self.sigma_mm, 0.25)


@dataclass(frozen=True, eq=False)
class BoardCheck:
    """The drift of cameras and the stripe offsets of projectors, from shots of a board.

    checked, unchecked: calibrated pairs that saw a board, and that did not.
    """

    drift: Drift
    stripes: tuple[StripeOffset, ...]
    checked: tuple[str, ...]
    unchecked: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def valid(self) -> bool:
        return not self.drift.moves and not any(offset.moved for offset in self.stripes)


def check_boards(
    calibration: RigCalibration, captures: Captures, progress: Progress = silent
) -> BoardCheck:
    """Compare the calibrated rig with one or more shots of the calibration's boards.

    A board seen by a single pair still shows whether that pair's stripes lie where its corners are.
    Raises BoardNotFound if no board is seen by two pairs and none has decoded stripes on it.
    """
    views = find_all_boards(calibration.rig, captures, progress)
    located = locate_views(calibration.rig, views.value, _cameras(calibration))
    unique = [view for view in located.value if not view.ambiguous]
    poses = [
        observe_pose(view, calibration.pairs[view.pair].camera, _noise_px(calibration, view.pair))
        for view in unique
    ]
    drift = find_drift(
        poses, calibration.rig_from_camera, calibration.covariance, calibration.rig.poles
    )
    # Which end of a plain board is which makes no difference to its surface.
    stripes = _stripe_offsets(calibration, captures, views.value, located.value, progress)
    notes = (*views.notes, *located.notes, *stripes.notes)
    if not drift.rig_from_board and not stripes.value:
        raise _nothing_to_compare(captures, located.value, notes)
    checked = tuple(sorted({view.pair for view in (unique or located.value)}))
    unchecked = tuple(sorted(set(calibration.pairs) - set(checked)))
    return BoardCheck(drift, stripes.value, checked, unchecked, notes)


def _nothing_to_compare(
    captures: Captures, located: Sequence[LocatedView], notes: Sequence[str]
) -> BoardNotFound:
    symmetric = sorted({view.board for view in located if view.ambiguous})
    what = (
        f"board {', '.join(symmetric)} looks the same when turned by 180 degrees, so cameras cannot "
        "be compared by it"
        if symmetric
        else "no board is seen by two calibrated pairs at once"
    )
    why = "".join(f"\n  {note}" for note in dict.fromkeys(notes))
    return BoardNotFound(
        f"{what}, and no stripes on one were decoded{why}",
        where=", ".join(str(folder) for folder in captures.folders),
        remedy="show a board whose corners are numbered (ChArUco) to as many cameras as can see "
        "it together, or take the stripe sequence on a board",
    )


def apply_moves(calibration: RigCalibration, moves: Sequence[Move]) -> RigCalibration:
    """Set the moved pairs to their new poses, and leave everything else unchanged.

    A pole takes along those of its pairs that saw no board. The covariance of a move is added to that
    of its pairs, which share its error.
    """
    poses, covariance = dict(calibration.rig_from_camera), calibration.covariance
    poles = calibration.rig.poles
    for move in moves:
        carried = {poles[pair] for pair in move.pairs if len(move.pairs) > 1}
        pairs = [pair for pair in poses if pair in move.pairs or poles.get(pair) in carried]
        poses |= {pair: move.motion @ poses[pair] for pair in pairs}
        covariance = covariance.add_common_motion(pairs, move.covariance)
    notes = tuple(f"repaired: {move_line(move)}" for move in moves)
    notes = (*calibration.notes, *notes)
    return replace(calibration, rig_from_camera=poses, covariance=covariance, notes=notes)


def move_line(move: Move) -> str:
    """State how far a pair or pole moved."""
    return (
        f"{move.name} moved by {move.shift_mm:.2f} mm (sigma {move.sigma_mm:.2f}) and "
        f"{move.turn_deg:.3f} degrees"
    )


def _noise_px(calibration: RigCalibration, pair: str) -> float:
    """Sigma of one coordinate of a corner, px, as measured by the calibration."""
    return max(_corners_px(calibration.pairs[pair]) / np.sqrt(2.0), 0.02)


def _corners_px(pair: PairCalibration) -> float:
    """RMS error of a pair's corners, px; 0.5, which OpenCV's users reach, if none is known."""
    known = pair.quality.corners_rms_px
    return known if known is not None else pair.quality.imported_sigma_px or 0.5


def _cameras(calibration: RigCalibration) -> Mapping[str, CameraCalibration]:
    return {
        name: CameraCalibration(pair.camera, pair.camera_covariance, (), _corners_px(pair))
        for name, pair in calibration.pairs.items()
    }


def _stripe_offsets(
    calibration: RigCalibration,
    captures: Captures,
    views: Sequence[BoardView],
    located: Sequence[LocatedView],
    progress: Progress,
) -> Outcome[tuple[StripeOffset, ...]]:
    """Stripe offsets of every pair that took stripes on a board it saw."""
    known = {view.key: view for view in located if calibration.pairs[view.pair].sheets is not None}
    wanted = [view for view in views if view.key in known]
    decoded = decode_on_boards(calibration.rig, captures, wanted, progress)
    parts: dict[str, list[Array]] = defaultdict(list)
    for key, boundaries in decoded.value.items():
        parts[key[0]].append(_stripe_distances(calibration, known[key], boundaries))
    rows = {pair: np.concatenate(found) for pair, found in sorted(parts.items())}
    offsets = tuple(_offset(pair, found) for pair, found in rows.items() if len(found) >= 100)
    lost = (f"{pair}: {reason}" for pair, reason in decoded.failures.items())
    return Outcome(offsets, (*decoded.notes, *lost))


def _stripe_distances(
    calibration: RigCalibration, view: LocatedView, boundaries: BoardBoundaries
) -> Array:
    """Distances of a view's stripe boundaries from the board: (N, 3), distance along its normal (mm),
    position across the stripes (-1 to 1), sigma (mm)."""
    rig, pair = calibration.rig, calibration.pairs[view.pair]
    projector = rig.pair(view.pair).projector
    assert projector is not None
    assert pair.sheets is not None
    shot = StripedView(view, rig.board(view.board), boundaries)
    points = on_board(
        pair.camera, projector, shot.board, shot.camera_from_face, boundaries, number=0
    )
    rays = points.points / points.points[:, 2:]
    measured = intersect_rays(pair.sheets, rays, points.index.astype(float))
    facing = np.abs(rays @ view.camera_from_board.rotation[:, 2])
    away = (measured.depth - points.points[:, 2]) * facing
    axis = 1 if projector.direction == "horizontal" else 0
    across = points.points[:, axis] - np.mean(points.points[:, axis])
    across = across / max(float(np.abs(across).max(initial=0.0)), 1e-9)
    rows = np.stack([away, across, np.sqrt(measured.variance_mm2) * facing], axis=1)
    return rows[np.all(np.isfinite(rows), axis=1)]


def _offset(pair: str, rows: Array) -> StripeOffset:
    """Medians of such distances over all boards."""
    away, across, sigma = rows.T
    low, high = across < -0.4, across > 0.4
    tilt = 0.0
    if min(low.sum(), high.sum()) > 20:
        tilt = 0.5 * float(np.median(away[high]) - np.median(away[low]))
    return StripeOffset(pair, float(np.median(away)), tilt, float(np.median(sigma)))
