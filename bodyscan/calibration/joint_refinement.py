"""Refine camera, board poses and light sheets of one pair together, on corners and stripes.

Stripes are straight-edged light on a flat board: they fix how boards lie relative to each other far
more finely than 48 corners do, and corners fix the scale. Only for sheets that are smooth in s,
whose few parameters are unknowns like any other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_form import POWERS, BoardForm, PrintSpread
from bodyscan.calibration.board_views import PlanarView
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    boundary_points,
    lifts,
    rays_on_board,
)
from bodyscan.calibration.camera import known_beforehand
from bodyscan.calibration.held_out import CLEARLY
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, Solution, minimize
from bodyscan.geometry.light_planes import Axis
from bodyscan.geometry.linear_gaussian import invert_scaled
from bodyscan.geometry.smooth_sheets import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

Sheets = TypeVar("Sheets", bound=SmoothSheets)

STEPS = 20
SETTLED = 1e-2
"""Convergence, in variances: a tenth of a sigma in every unknown makes no difference."""
CORNERS = Noise("corners, px", group=2, cauchy=4.0, min_scale=1e-3)
STRIPES = Noise("stripes, in sigmas", cauchy=4.0, min_scale=1e-2)
FLOOR_PX = 0.02
LEAST_SHOWN = 1e-6
"""Information on a print below this share of the best-known direction's counts as none."""
SPREADS_MM = np.append(0.0, np.geomspace(1e-3, 1.0, 121))
AS_WELL = 1e-7
"""Relative change of depth at which the sheets' prior takes effect when they stand in for rays."""
TWIST_STEPS = (*[1e-6] * 3, *[1e-3] * 3)
"""Radians and mm: steps for derivatives of a boundary point by its board's motion."""


@dataclass(frozen=True, eq=False)
class StripedBoard:
    """One shot: its corners and the stripe boundaries on it.

    pixels: boundary points, (N, 2) px.
    index: their boundaries, s = i, (N,).
    sigma_px: (N,).
    across: unit vector across the stripes in the image, (2,).
    board: the board's name.
    """

    view: PlanarView
    pixels: Array
    index: Array
    sigma_px: Array
    across: Array
    board: str


@dataclass(frozen=True, eq=False)
class JointFit(Generic[Sheets]):
    """The fit to corners and stripes together.

    camera_covariance: (P, P).
    corners_rms_px: robustly weighted.
    forms: of the boards, by name.
    """

    camera: Camera
    camera_from_board: dict[str, RigidTransform]
    sheets: Sheets
    camera_covariance: Array
    corners_rms_px: float
    forms: dict[str, BoardForm]


@dataclass(frozen=True, eq=False)
class _State(Generic[Sheets]):
    camera: Camera
    poses: tuple[RigidTransform, ...]
    sheets: Sheets
    forms: dict[str, BoardForm]

    @property
    def first_pose(self) -> int:
        """Index of the first pose among the unknowns; the camera's parameters come before."""
        return len(self.camera.parameters)

    @property
    def first_sheet(self) -> int:
        return self.first_pose + 6 * len(self.poses)

    @property
    def first_form(self) -> int:
        return self.first_sheet + self.sheets.prior()[1].shape[1]

    @property
    def of_form(self) -> dict[str, Indices]:
        """Indices of the unknowns that are each board's form."""
        found, first = {}, self.first_form
        for name, form in self.forms.items():
            found[name] = np.arange(first, first + form.count)
            first += form.count
        return found

    @property
    def unknowns(self) -> int:
        return self.first_form + sum(form.count for form in self.forms.values())

    def moved(self, step: Array) -> _State[Sheets]:
        twists = step[self.first_pose : self.first_sheet].reshape(-1, 6)
        poses = tuple(p.retract(twist) for p, twist in zip(self.poses, twists, strict=True))
        camera = self.camera.retract(step[: self.first_pose])
        sheets = self.sheets.retract(step[self.first_sheet : self.first_form])
        of_form = self.of_form
        forms = {name: form.moved(step[of_form[name]]) for name, form in self.forms.items()}
        return _State(camera, poses, sheets, forms)


def striped_board(
    view: PlanarView, camera: Camera, data: BoundaryPoints, number: int, board: str
) -> StripedBoard:
    """The (binned) boundary points of one board, as image measurements again; board: its name."""
    own = data.board == number
    across = np.median(
        camera.project(data.points[own] + data.per_pixel[own]) - camera.project(data.points[own]),
        axis=0,
    )
    return StripedBoard(
        view,
        camera.project(data.points[own]),
        data.index[own].astype(float),
        np.hypot(data.sigma_px[own], FLOOR_PX),
        across / np.linalg.norm(across),
        board,
    )


def carried(
    camera: Camera,
    camera_from_board: RigidTransform,
    board: StripedBoard,
    number: int,
    direction: Axis,
) -> BoundaryPoints:
    """The boundary points of a flat board, for a given camera and pose."""
    index, place = board.index.astype(np.int64), camera_from_board @ _face(board)
    return boundary_points(
        camera, place, index, board.pixels, board.sigma_px, board=number, direction=direction
    )


def refine_jointly(
    camera: Camera,
    camera_from_board: Mapping[str, RigidTransform],
    sheets: Sheets,
    boards: Sequence[StripedBoard],
    forms: Mapping[str, BoardForm],
    *,
    bent: bool = True,
    steps: int = STEPS,
) -> JointFit[Sheets]:
    """Least squares, starting from camera, poses and sheets that were found one after the other.

    boards: those without stripes, known by corners alone, take part with empty pixels.
    bent: whether the forms of the boards are fitted; if not, their uncertainty only enters the
        covariance.
    """
    poses = tuple(camera_from_board[b.view.shot] for b in boards)
    fitted = forms if bent else {name: form.exact for name, form in forms.items()}
    state = _solve(_State(camera, poses, sheets, dict(fitted)), boards, steps).state
    if not bent:
        state = replace(state, forms=dict(forms))
    solution = _solve(state, boards, 0)
    return _fit(solution, boards, solution.covariance)


def known_apart(
    camera: Camera,
    camera_from_board: Mapping[str, RigidTransform],
    sheets: Sheets,
    boards: Sequence[StripedBoard],
    forms: Mapping[str, BoardForm],
) -> JointFit[Sheets]:
    """The given solution unchanged, with the covariance of solving for corners and stripes in turn.

    Camera and boards are known by corners alone, sheets by the stripes on those boards; the
    former's uncertainty is carried into the latter's covariance.
    """
    poses = tuple(camera_from_board[b.view.shot] for b in boards)
    solution = _solve(_State(camera, poses, sheets, dict(forms)), boards, 0)
    state = solution.state
    of_sheets = np.arange(state.first_sheet, state.first_form)
    others = np.setdiff1d(np.arange(state.unknowns), of_sheets)
    first = invert_scaled(solution.normal([CORNERS, EXACT])[np.ix_(others, others)])
    striped = solution.normal([STRIPES, EXACT])
    own = invert_scaled(striped[np.ix_(of_sheets, of_sheets)])
    follow = -own @ striped[np.ix_(of_sheets, others)]
    covariance = np.zeros((state.unknowns, state.unknowns))
    covariance[np.ix_(others, others)] = first
    covariance[np.ix_(of_sheets, others)] = follow @ first
    covariance[np.ix_(others, of_sheets)] = (follow @ first).T
    covariance[np.ix_(of_sheets, of_sheets)] = own + follow @ first @ follow.T
    return _fit(solution, boards, covariance)


def print_errors(fit: JointFit[Sheets], boards: Sequence[StripedBoard]) -> dict[str, PrintSpread]:
    """Maximum-likelihood spread of each board's print errors, given what `fit` found.

    In each direction in which corners and stripes determine the corners' places, the places found
    scatter by print errors and noise together.
    """
    poses = tuple(fit.camera_from_board[b.view.shot] for b in boards)
    state = _State(fit.camera, poses, fit.sheets, fit.forms)
    normal = _solve(state, boards, 0).normal([CORNERS, STRIPES, EXACT])
    found = {}
    for name, own in state.of_form.items():
        form, of_print = fit.forms[name], own[len(POWERS) :]
        rest = np.setdiff1d(np.arange(state.unknowns), of_print)
        whitening = form.print_whitening
        cross = normal[np.ix_(of_print, rest)]
        both = normal[np.ix_(of_print, of_print)]
        both = both - cross @ invert_scaled(normal[np.ix_(rest, rest)]) @ cross.T
        values, vectors = np.linalg.eigh(both - whitening.T @ whitening)
        shown = values > LEAST_SHOWN * values[-1]
        values, vectors = values[shown], vectors[:, shown]
        # Without their prior the places would be these.
        places = vectors.T @ both @ form.printed.ravel() / values
        slow = vectors.T @ np.kron(form.slow, np.eye(2))
        found[name] = _likeliest_spread(places, 1.0 / values, slow)
    return found


def _likeliest_spread(values: Array, variances: Array, slow: Array) -> PrintSpread:
    """Of values (N,) seen with noise of `variances` (N,): of each one's own part, and of unknowns
    that `slow` (N, K) adds to them, if they are clearly there."""
    stretch = SPREADS_MM[:, None] ** 2
    misfit = np.empty((len(SPREADS_MM), len(SPREADS_MM)))
    for row, corner in zip(misfit, SPREADS_MM, strict=True):
        total = corner**2 + variances
        white = values / np.sqrt(total)
        gains, modes = np.linalg.eigh(slow.T @ (slow / total[:, None]))
        along = modes.T @ (slow.T @ (white / np.sqrt(total)))
        grown = 1.0 + stretch * gains
        row[:] = np.sum(np.log(grown) - stretch * along**2 / grown, axis=1)
        row += np.sum(np.log(total)) + np.sum(white**2)
    # Twice a log likelihood is a squared number of standard errors.
    if misfit[:, 0].min() - misfit.min() < CLEARLY**2:
        return PrintSpread(float(SPREADS_MM[np.argmin(misfit[:, 0])]))
    corner, shared = np.unravel_index(np.argmin(misfit), misfit.shape)
    return PrintSpread(float(SPREADS_MM[corner]), float(SPREADS_MM[shared]))


def _solve(
    state: _State[Sheets], boards: Sequence[StripedBoard], steps: int
) -> Solution[_State[Sheets]]:
    return minimize(
        state,
        lambda state: _blocks(state, boards),
        lambda state, step: state.moved(step),
        unknowns=state.unknowns,
        steps=steps,
        tolerance=SETTLED,
        damping=1e-6,
    )


def _fit(
    solution: Solution[_State[Sheets]], boards: Sequence[StripedBoard], covariance: Array
) -> JointFit[Sheets]:
    state = solution.state
    first = state.first_pose
    corners = np.concatenate([_corner_residuals(state, k, b) for k, b in enumerate(boards)])
    return JointFit(
        state.camera,
        {b.view.shot: pose for b, pose in zip(boards, state.poses, strict=True)},
        state.sheets.with_covariance(_of_depths(state, boards, covariance)),
        covariance[:first, :first],
        float(np.sqrt(CORNERS.mean_square(corners)) * np.sqrt(2.0)),
        state.forms,
    )


def _blocks(state: _State[Sheets], boards: Sequence[StripedBoard]) -> Iterator[Block]:
    """Corners and stripes of each board, then the priors on camera, sheets and boards."""
    camera, sheets = np.arange(state.first_pose), np.arange(state.first_sheet, state.first_form)
    of_form = state.of_form
    with np.errstate(all="ignore"):
        for k, board in enumerate(boards):
            pose, form = state.first_pose + 6 * k + np.arange(6), of_form[board.board]
            corners, rays = _corner_residuals(state, k, board), _rays(state.camera, board)
            stripes = _offsets(state, k, board, rays)
            of_corners = partial(_corner_jacobian, state, k, board)
            of_stripes = partial(_stripe_jacobian, state, k, board, rays)
            yield Block(corners, of_corners, np.concatenate([camera, pose, form]), CORNERS)
            bent = form[: len(POWERS)]
            yield Block(stripes, of_stripes, np.concatenate([camera, pose, sheets, bent]), STRIPES)
    if state.camera.prior is not None:
        yield known_beforehand(state.camera, camera)
    known, jacobian = state.sheets.prior()
    yield Block(known, lambda: jacobian, sheets, EXACT)
    for name, own in state.forms.items():
        yield _known_of_form(own, of_form[name])


def _known_of_form(form: BoardForm, own: Indices) -> Block:
    known, jacobian = form.prior
    return Block(known, lambda: jacobian, own, EXACT)


def _corners_of(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    """Where the corners of the k-th board lie, camera frame, (N, 3) mm."""
    form = state.forms[board.board]
    points = board.view.points
    return state.poses[k].apply(form.applied(points, form.numbers(points)))


def _corner_residuals(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    seen = state.camera.project(_corners_of(state, k, board))
    return (seen - board.view.pixels).ravel()


def _rays(camera: Camera, board: StripedBoard) -> Array:
    """Rays (2, N, 3), z = 1: through boundary pixels, and half a pixel across from them."""
    return camera.rays(np.stack([board.pixels, board.pixels + 0.5 * board.across]))


def _ray_slopes(camera: Camera, rays: Array) -> Array:
    """(2, N, 2, P): how the rays of fixed pixels turn with the camera's parameters.

    The turn undoes what the parameters do to the pixels of fixed rays.
    """
    by_parameter, _ = camera.jacobians(rays.reshape(-1, 3))
    return -(camera.rays_by_pixels(rays) @ by_parameter.reshape(*rays.shape[:2], 2, -1))


def _offsets(state: _State[Sheets], k: int, board: StripedBoard, rays: Array) -> Array:
    """Offsets of the k-th board's boundaries from their sheets, over their sigma, (N,)."""
    points, across = _on_board(state, k, board, rays)
    return _over_sigma(state.sheets, state.sheets.at(board.index), board, points, across)


def _over_sigma(
    sheets: SmoothSheets, at: Any, board: StripedBoard, points: Array, across: Array
) -> Array:
    offset = sheets.offset(points, at)
    return np.asarray(offset.value / _sigma(board, points, across, offset.by_point), np.float64)


def _on_board(state: _State[Sheets], k: int, board: StripedBoard, rays: Array) -> Array:
    """Where rays meet the face on which the stripes were seen, (2, N, 3) mm."""
    camera_from_face = state.poses[k] @ _face(board)
    form = state.forms[board.board]
    return rays_on_board(rays, camera_from_face, form.height if form.heights.any() else None)


def _face(board: StripedBoard) -> RigidTransform:
    return RigidTransform.from_translation([0.0, 0.0, board.view.points[0, 2]])


def _sigma(board: StripedBoard, points: Array, across: Array, by_point: Array) -> Array:
    """One sigma_px across the stripe, in the offset's unit, (N,)."""
    leverage = np.abs(np.sum(by_point * (across - points), axis=1)) / 0.5
    return np.maximum(leverage, 1e-12) * board.sigma_px


def _corner_jacobian(state: _State[Sheets], k: int, board: StripedBoard) -> Array:
    """Derivatives (2N, ...) by camera, this board's pose, and its form."""
    points, form = _corners_of(state, k, board), state.forms[board.board]
    by_parameter, by_point = state.camera.jacobians(points)
    in_board = by_point @ state.poses[k].rotation
    lifted = in_board[:, :, 2:] * form.basis(board.view.points[:, :2])[:, None, :]
    printed = np.zeros((len(points), 2, len(form.points), 2))
    each = np.arange(len(points))
    printed[each, :, form.numbers(board.view.points)] = in_board[:, :, :2]
    parts = [by_parameter, by_point @ twist_jacobian(points), lifted]
    jacobian = np.concatenate([*parts, printed.reshape(len(points), 2, -1)], axis=2)
    return jacobian.reshape(-1, jacobian.shape[2])


def _stripe_jacobian(state: _State[Sheets], k: int, board: StripedBoard, rays: Array) -> Array:
    """Derivatives (N, ...) of offsets over sigma, by camera, board pose, sheets and board heights.

    Camera and pose by finite differences, because the sigma changes too: without its derivative,
    noise would push the focal lengths up.
    """
    pose, slopes, face = state.poses[k], _ray_slopes(state.camera, rays), _face(board)
    points, across = both = _on_board(state, k, board, rays)
    at = state.sheets.at(board.index)
    offset = state.sheets.offset(points, at, parameters=True)
    assert offset.by_parameter is not None
    sigma = _sigma(board, points, across, offset.by_point)
    # The height of a board changes by a thousandth of a step along it, so it may be held constant
    # here.
    height = state.forms[board.board].height((pose @ face).inverse().apply(both)[..., :2])

    def there(rays: Array, pose: RigidTransform) -> Array:
        place = pose @ face
        found = rays_on_board(rays, place) + lifts(rays, place, height)
        return _over_sigma(state.sheets, at, board, found[0], found[1])

    def turned(column: int, step: float) -> Array:
        turn = np.zeros_like(rays)
        turn[..., :2] = step * slopes[..., column]
        return there(rays + turn, pose)

    def moved(column: int, step: float) -> Array:
        return there(rays, pose.retract(step * np.eye(6)[column]))

    by_place = [
        (change(column, size) - change(column, -size)) / (2.0 * size)
        for change, sizes in ((turned, state.camera.difference_steps), (moved, TWIST_STEPS))
        for column, size in enumerate(sizes)
    ]
    along = np.sum(offset.by_point * rays[0], axis=1) / (rays[0] @ pose.rotation[:, 2])
    basis = state.forms[board.board].basis(pose.inverse().apply(points)[:, :2])
    by_height = (along / sigma)[:, None] * basis
    return np.column_stack([*by_place, offset.by_parameter / sigma[:, None], by_height])


def allowing_for(
    fit: JointFit[Sheets], other: JointFit[Sheets], boards: Sequence[StripedBoard]
) -> JointFit[Sheets]:
    """The fit with covariances enlarged by its difference from another fit, which may be right."""
    there = _depths_by_sheets(fit.camera, fit.sheets, boards)
    rays = other.camera.rays(np.concatenate([board.pixels for board in boards]))
    depth = other.sheets.depth(rays, np.concatenate([board.index for board in boards]))
    motion = _motion_of_sheets(fit.sheets, there.by_sheets, depth[:, None] / there.depth - 1.0)
    changed = (other.camera.parameters - fit.camera.parameters)[:, None]
    return replace(
        fit,
        sheets=fit.sheets.with_covariance(fit.sheets.covariance + motion @ motion.T),
        camera_covariance=fit.camera_covariance + changed @ changed.T,
    )


@dataclass(frozen=True, eq=False)
class _Depths:
    """Depths (N, 1) mm of boundary points on boards, and their relative derivatives.

    by_sheets: (N, P), by the sheets' unknowns.
    by_camera: (N, C), by the camera's parameters, which turn the rays of fixed pixels.
    """

    depth: Array
    by_sheets: Array
    by_camera: Array


def _depths_by_sheets(
    camera: Camera, sheets: SmoothSheets, boards: Sequence[StripedBoard]
) -> _Depths:
    index = np.concatenate([board.index for board in boards])
    rays = camera.rays(np.concatenate([board.pixels for board in boards]))[None]
    with np.errstate(all="ignore"):
        depth = sheets.depth(rays[0], index)[:, None]
        offset = sheets.offset(rays[0] * depth, sheets.at(index), parameters=True)
        assert offset.by_parameter is not None
        along = np.sum(offset.by_point * rays[0], axis=1)[:, None]
        turned = np.einsum("nk,nkp->np", offset.by_point[:, :2], _ray_slopes(camera, rays)[0])
        return _Depths(depth, -offset.by_parameter / along / depth, -turned / along)


def _motion_of_sheets(sheets: SmoothSheets, by_sheets: Array, changes: Array) -> Array:
    """(P, K): motions of the sheets' unknowns for relative changes of depth (N, K), nearly."""
    known = np.isfinite(by_sheets).all(axis=1) & np.isfinite(changes).all(axis=1)
    prior = AS_WELL * np.sqrt(np.count_nonzero(known)) * sheets.prior()[1]
    matrix = np.concatenate([by_sheets[known], prior])
    right = np.concatenate([changes[known], np.zeros((len(prior), changes.shape[1]))])
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], np.float64)


def _of_depths(state: _State[Sheets], boards: Sequence[StripedBoard], covariance: Array) -> Array:
    """Covariance (P, P) of the sheets together with the rays that meet them, as it affects depths.

    A camera error turns rays and sheets together. The rays' part is expressed as the motion of the
    sheets that changes depths on the boards equally, so that both add with their signs. What no
    motion expresses, a lens, is in the rays' own sigma.
    """
    own = np.arange(state.first_sheet, state.first_form)
    there = _depths_by_sheets(state.camera, state.sheets, boards)
    motion = _motion_of_sheets(state.sheets, there.by_sheets, there.by_camera)
    carried = np.concatenate([motion, np.eye(len(own))], axis=1)
    columns = np.concatenate([np.arange(state.first_pose), own])
    total = carried @ covariance[np.ix_(columns, columns)] @ carried.T
    return np.asarray(0.5 * (total + total.T), np.float64)
