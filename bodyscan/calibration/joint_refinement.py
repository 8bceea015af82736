"""Refine camera, board poses, board shapes and light sheets of one pair in a single solve.

Stripes are straight-edged light on a nearly flat board: they determine how boards lie relative to
each other far more finely than 48 corners do, and corners determine the scale. Boards are neither
flat nor printed exactly: their warp and print are unknowns with priors, so that whatever a few poses
leave open enters every covariance. Only for sheets that are smooth in s.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.calibration.board_views import BoardFace, PlanarView, make_corner_keys, match_corners
from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    intersect_with_board,
    lift_along_rays,
)
from bodyscan.calibration.camera import evaluate_camera_prior
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.least_squares import EXACT, Block, Noise, minimize
from bodyscan.geometry.light_planes import SmoothSheets
from bodyscan.geometry.transforms import RigidTransform, twist_jacobian

WARP_POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
CORNERS = Noise("corners, px", group=2, cauchy=4.0, min_scale=1e-3)
STRIPES = tuple(
    Noise(f"{which} stripes, in sigmas", cauchy=4.0, min_scale=1e-2)
    for which in ("first", "crossing")
)


@dataclass(frozen=True, eq=False)
class BoardStripes:
    """Stripe boundaries of one direction on a board."""

    pixels: Array  # of boundary points, (N, 2) px
    index: Array  # their boundaries, s = i, (N,)
    sigma_px: Array  # (N,)
    across: Array  # unit vector across the stripes in the image, (2,)

    @staticmethod
    def from_points(camera: Camera, points: BoundaryPoints) -> BoardStripes:
        """Turn boundary points, on their board by `camera`, into pixels again."""
        pixels = camera.project(points.points)
        across = np.array([1.0, 0.0])
        if len(pixels):
            across = np.median(camera.project(points.points + points.per_pixel) - pixels, axis=0)
            across /= np.linalg.norm(across)
        sigma_px = np.hypot(points.sigma_px, 0.02)  # no lens is known better than that
        return BoardStripes(pixels, points.index.astype(float), sigma_px, across)


@dataclass(frozen=True, eq=False)
class StripedBoard:
    """One observation of a board: its corners, and the stripe boundaries on it.

    stripes: of each direction, in the order of the sheets; without points where none were seen.
    face: the face that was seen, if corners alone already gave it a shape.
    """

    board: str
    view: PlanarView
    stripes: tuple[BoardStripes, ...]
    face: BoardFace | None = None

    @cached_property
    def board_from_face(self) -> RigidTransform:
        z_mm = self.face.z_mm if self.face else self.view.points[0, 2]
        return RigidTransform.from_translation([0.0, 0.0, z_mm])


@dataclass(frozen=True, eq=False)
class BoardWarp:
    """Deviation of a board from its description, as unknowns with a Gaussian prior."""

    points: Array  # corners as described, (N, 3) mm
    # Coefficients of WARP_POWERS, each less its best plane, (7,) mm; x and y are -1 and 1 at the
    # outermost corners.
    heights: Array
    printed: Array  # displacement of corners within the sheet, (N, 2) mm
    # flatness_mm, print_mm: prior standard deviations of heights and printed.
    flatness_mm: float
    print_mm: float

    @staticmethod
    def flat(points: Array, flatness_mm: float, print_mm: float) -> BoardWarp:
        """Describe a board without deviation; points (M, 3) are the corners of any views given."""
        known = np.unique(make_corner_keys(points), axis=0)
        heights, printed = np.zeros(len(WARP_POWERS)), np.zeros((len(known), 2))
        return BoardWarp(known, heights, printed, flatness_mm, print_mm)

    @property
    def count(self) -> int:
        """Number of unknowns: heights, then the corners' x and y."""
        return len(self.heights) + self.printed.size

    @property
    def prior(self) -> tuple[Array, Array]:
        """Residuals of the prior, (count,), and their derivatives by the unknowns, (count, count).

        Terms of third degree are expected to be three tenths of those of second degree.
        """
        heights = [self.flatness_mm * (1.0 if sum(power) == 2 else 0.3) for power in WARP_POWERS]
        sigmas = np.append(heights, np.full(self.printed.size, self.print_mm))
        sigmas = np.maximum(sigmas, 1e-6)  # a nanometre where a board is said to be exact
        unknowns = np.append(self.heights, self.printed.ravel())
        return unknowns / sigmas, np.diag(1.0 / sigmas)

    @property
    def out_of_plane_mm(self) -> float:
        """Height from the lowest to the highest corner, mm."""
        return float(np.ptp(self.basis(self.points[:, :2]) @ self.heights))

    def retract(self, step: Array) -> BoardWarp:
        """Add a step (count,) to the unknowns."""
        heights, printed = np.split(step, [len(WARP_POWERS)])
        return replace(
            self, heights=self.heights + heights, printed=self.printed + printed.reshape(-1, 2)
        )

    def basis(self, xy: Array) -> Array:
        """Height at (..., 2) mm of the board per unit of each of `heights`, (..., 7)."""
        powers, plane = self._powers(xy)
        return np.asarray(powers - plane @ self._best_planes, np.float64)

    def height(self, xy: Array) -> Array:
        """Heights (...) mm above the described surface at (..., 2) mm of the board."""
        return np.asarray(self.basis(xy) @ self.heights)

    def apply(self, points: Array) -> Array:
        """Displace described corners (M, 3) mm to where they lie."""
        shift = self.printed[match_corners(points, self.points)]
        return points + np.column_stack([shift, self.height(points[:, :2])])

    @cached_property
    def _best_planes(self) -> Array:
        """Best plane of each power at the corners, (3, 7)."""
        powers, plane = self._powers(self.points[:, :2])
        return np.asarray(np.linalg.lstsq(plane, powers, rcond=None)[0])

    def _powers(self, xy: Array) -> tuple[Array, Array]:
        """WARP_POWERS (..., 7) and 1, x, y (..., 3) at (..., 2) mm."""
        low, high = self.points[:, :2].min(axis=0), self.points[:, :2].max(axis=0)
        x, y = np.moveaxis((xy - (low + high) / 2.0) / ((high - low) / 2.0), -1, 0)
        powers = np.stack([x**i * y**j for i, j in WARP_POWERS], axis=-1)
        return powers, np.stack([np.ones_like(x), x, y], axis=-1)


@dataclass(frozen=True, eq=False)
class JointFit:
    """The fit to corners and stripes together."""

    camera: Camera
    sheets: tuple[SmoothSheets, ...]  # of each direction
    camera_covariance: Array  # (P, P)
    corners_rms_px: float  # robustly weighted
    warps: dict[str, BoardWarp]


def refine_jointly(
    camera: Camera,
    camera_from_board: Sequence[RigidTransform],
    sheets: Sequence[SmoothSheets],
    boards: Sequence[StripedBoard],
    flatness_mm: Mapping[str, float],
    *,
    print_mm: float = 0.05,
) -> JointFit:
    """Refine camera, board poses and shapes, and sheets by maximum a posteriori estimation.

    camera, camera_from_board, sheets: found one after the other, where the solve starts; sheets of
        one direction or of two.
    boards: every observation that the camera is calibrated from, with stripes or without.
    flatness_mm: prior standard deviation of the warp of each board, by name.
    print_mm: of each printed corner, per axis: what office printers and plotters do.
    """
    points = {
        name: np.concatenate([one.view.points for one in boards if one.board == name])
        for name in flatness_mm
    }
    warps = {name: BoardWarp.flat(points[name], mm, print_mm) for name, mm in flatness_mm.items()}
    start = _State(camera, tuple(camera_from_board), tuple(sheets), warps)
    solution = minimize(
        start,
        lambda state: _make_blocks(state, boards),
        lambda state, step: state.retract(step),
        unknowns=sum(start.sizes),
        steps=20,
        tolerance=1e-2,  # within a tenth of a sigma in every unknown
        damping=1e-6,
    )
    state, covariance = solution.state, solution.covariance_by_freedoms
    camera_columns = state.columns[0]
    corners = np.concatenate(
        [_compute_corner_residuals(state, k, one) for k, one in enumerate(boards)]
    )
    return JointFit(
        state.camera,
        tuple(
            replace(one, covariance=_compute_depth_covariance(state, boards, covariance, direction))
            for direction, one in enumerate(state.sheets)
        ),
        covariance[np.ix_(camera_columns, camera_columns)],
        float(np.sqrt(CORNERS.mean_square(corners)) * np.sqrt(2.0)),
        state.warps,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Camera, poses, sheets and warps; their unknowns follow one another in this order."""

    camera: Camera
    poses: tuple[RigidTransform, ...]
    sheets: tuple[SmoothSheets, ...]
    warps: dict[str, BoardWarp]

    @property
    def sizes(self) -> list[int]:
        """Number of unknowns of the camera, each pose, each direction's sheets, each board's warp."""
        sheets = [one.linearize_prior()[1].shape[1] for one in self.sheets]
        warps = [warp.count for warp in self.warps.values()]
        return [len(self.camera.parameters), *([6] * len(self.poses)), *sheets, *warps]

    @property
    def columns(self) -> tuple[Indices, list[Indices], list[Indices], dict[str, Indices]]:
        """Indices of the unknowns of the camera, each pose, each direction's sheets, each warp."""
        camera, *rest = np.split(np.arange(sum(self.sizes)), np.cumsum(self.sizes)[:-1])
        first_warp = len(self.poses) + len(self.sheets)
        warps = dict(zip(self.warps, rest[first_warp:], strict=True))
        return camera, rest[: len(self.poses)], rest[len(self.poses) : first_warp], warps

    def retract(self, step: Array) -> _State:
        """Move the state by a step of the unknowns."""
        camera, poses, sheets, warps = self.columns
        return _State(
            self.camera.retract(step[camera]),
            tuple(pose.retract(step[k]) for pose, k in zip(self.poses, poses, strict=True)),
            tuple(one.retract(step[k]) for one, k in zip(self.sheets, sheets, strict=True)),
            {name: warp.retract(step[warps[name]]) for name, warp in self.warps.items()},
        )


def _make_blocks(state: _State, boards: Sequence[StripedBoard]) -> Iterator[Block]:
    """Residuals of each board's corners and stripes, then the priors of camera, sheets, warps."""
    camera, poses, sheets, warps = state.columns
    with np.errstate(all="ignore"):
        for k, board in enumerate(boards):
            pose, warp = poses[k], warps[board.board]
            yield Block(
                _compute_corner_residuals(state, k, board),
                partial(_compute_corner_jacobian, state, k, board),
                np.concatenate([camera, pose, warp]),
                CORNERS,
            )
            heights = warp[: len(WARP_POWERS)]
            for direction, sheet_columns in enumerate(sheets):
                stripes = board.stripes[direction]
                # Through the boundaries' pixels, and half a pixel across from them.
                pixels = np.stack([stripes.pixels, stripes.pixels + 0.5 * stripes.across])
                rays = state.camera.rays(pixels)
                yield Block(
                    _compute_stripe_residuals(state, k, board, direction, rays),
                    partial(_compute_stripe_jacobian, state, k, board, direction, rays),
                    np.concatenate([camera, pose, sheet_columns, heights]),
                    STRIPES[direction],
                )
    yield evaluate_camera_prior(state.camera, camera)
    for one, sheet_columns in zip(state.sheets, sheets, strict=True):
        yield _make_prior_block(one.linearize_prior(), sheet_columns)
    for name, shape in state.warps.items():
        yield _make_prior_block(shape.prior, warps[name])


def _make_prior_block(prior: tuple[Array, Array], columns: Indices) -> Block:
    residuals, jacobian = prior
    return Block(residuals, lambda: jacobian, columns, EXACT)


def _place_corners(state: _State, k: int, board: StripedBoard) -> Array:
    """Corners of the k-th board as warped, camera frame, (N, 3) mm."""
    return state.poses[k].apply(state.warps[board.board].apply(board.view.points))


def _compute_corner_residuals(state: _State, k: int, board: StripedBoard) -> Array:
    return (state.camera.project(_place_corners(state, k, board)) - board.view.pixels).ravel()


def _compute_corner_jacobian(state: _State, k: int, board: StripedBoard) -> Array:
    """Derivatives (2N, ...) by camera, this board's pose, and its warp."""
    points, warp = _place_corners(state, k, board), state.warps[board.board]
    by_parameter, by_point = state.camera.jacobians(points)
    in_board = by_point @ state.poses[k].rotation
    by_heights = in_board[:, :, 2:] * warp.basis(board.view.points[:, :2])[:, None, :]
    by_print = np.zeros((len(points), 2, len(warp.points), 2))
    corner = match_corners(board.view.points, warp.points)
    by_print[np.arange(len(points)), :, corner] = in_board[:, :, :2]
    parts = [by_parameter, by_point @ twist_jacobian(points), by_heights]
    jacobian = np.concatenate([*parts, by_print.reshape(len(points), 2, -1)], axis=2)
    return jacobian.reshape(-1, jacobian.shape[2])


def _differentiate_rays(camera: Camera, rays: Array) -> Array:
    """Derivatives (..., 2, P) of rays (x, y, 1) through fixed pixels by the camera's P parameters."""
    by_parameter, _ = camera.jacobians(rays.reshape(-1, 3))
    by_parameter = by_parameter.reshape(*rays.shape[:-1], 2, -1)
    return -(camera.rays_by_pixels(rays) @ by_parameter)


def _evaluate_height(state: _State, board: StripedBoard, xy: Array) -> Array:
    """Height of a board's surface above the plane of its face at (..., 2) mm."""
    height = state.warps[board.board].height(xy)
    return height + board.face.height(xy) if board.face else height


def _compute_stripe_residuals(
    state: _State, k: int, board: StripedBoard, direction: int, rays: Array
) -> Array:
    """Offsets of the k-th board's boundaries of one direction from their sheets, in sigmas, (N,)."""
    sheets, stripes = state.sheets[direction], board.stripes[direction]
    camera_from_face = state.poses[k] @ board.board_from_face
    points = intersect_with_board(rays, camera_from_face, partial(_evaluate_height, state, board))
    return _whiten_offsets(sheets, sheets.evaluate(stripes.index), stripes, points)


def _whiten_offsets(sheets: SmoothSheets, at: Any, stripes: BoardStripes, points: Array) -> Array:
    offset = sheets.offset(points[0], at)
    return np.asarray(
        offset.value / _compute_offset_sigma(stripes, points, offset.by_point), np.float64
    )


def _compute_offset_sigma(stripes: BoardStripes, points: Array, by_point: Array) -> Array:
    """Standard deviation (N,) of the offsets, in their unit, propagated from that of the pixels."""
    per_pixel = np.abs(np.sum(by_point * (points[1] - points[0]), axis=1)) / 0.5
    return np.maximum(per_pixel, 1e-12) * stripes.sigma_px


def _compute_stripe_jacobian(
    state: _State, k: int, board: StripedBoard, direction: int, rays: Array
) -> Array:
    """Derivatives (N, ...) by camera, board pose, sheets and board heights.

    Camera and pose by finite differences, because the sigma changes too: without its derivative,
    noise would push the focal lengths up.
    """
    sheets, stripes = state.sheets[direction], board.stripes[direction]
    pose, by_camera = state.poses[k], _differentiate_rays(state.camera, rays)
    camera_from_face = pose @ board.board_from_face
    points = intersect_with_board(rays, camera_from_face, partial(_evaluate_height, state, board))
    at = sheets.evaluate(stripes.index)
    offset = sheets.offset(points[0], at, parameters=True)
    assert offset.by_parameter is not None
    sigma = _compute_offset_sigma(stripes, points, offset.by_point)
    # The height of a board changes by a thousandth of a step along it: it is held constant here.
    height = _evaluate_height(state, board, camera_from_face.inverse().apply(points)[..., :2])

    def residuals(rays: Array, pose: RigidTransform) -> Array:
        camera_from_face = pose @ board.board_from_face
        points = intersect_with_board(rays, camera_from_face) + lift_along_rays(
            rays, camera_from_face, height
        )
        return _whiten_offsets(sheets, at, stripes, points)

    def by_parameter(column: int, step: float) -> Array:
        turn = np.zeros_like(rays)
        turn[..., :2] = step * by_camera[..., column]
        return residuals(rays + turn, pose) - residuals(rays - turn, pose)

    def by_twist(column: int, step: float) -> Array:
        twist = step * np.eye(6)[column]
        return residuals(rays, pose.retract(twist)) - residuals(rays, pose.retract(-twist))

    # Rays turn by a microradian, about 1e-3 px; radians and mm of a pose.
    camera_steps = 1e-6 / np.abs(by_camera.reshape(-1, by_camera.shape[-1])).max(axis=0)
    twist_steps = [1e-6] * 3 + [1e-3] * 3
    differences = [
        *(by_parameter(c, step) / (2.0 * step) for c, step in enumerate(camera_steps)),
        *(by_twist(c, step) / (2.0 * step) for c, step in enumerate(twist_steps)),
    ]
    along_ray = np.sum(offset.by_point * rays[0], axis=1) / (rays[0] @ pose.rotation[:, 2])
    basis = state.warps[board.board].basis(pose.inverse().apply(points[0])[:, :2])
    by_heights = (along_ray / sigma)[:, None] * basis
    return np.column_stack([*differences, offset.by_parameter / sigma[:, None], by_heights])


def _compute_depth_covariance(
    state: _State, boards: Sequence[StripedBoard], covariance: Array, direction: int
) -> Array:
    """Covariance (P, P) of one direction's sheets together with the rays that meet them, as it
    affects shapes.

    A camera error turns rays and sheets together, and moves all boards nearly alike, which nobody can
    measure: the rigid motion that explains most of it is removed (an S-transformation to the frame of
    the boards: Baarda 1973). The rest along the rays is expressed as the change of the sheets that
    changes depths equally; what none expresses, a lens, is in the rays' own sigma.
    """
    sheets, stripes = state.sheets[direction], [board.stripes[direction] for board in boards]
    index = np.concatenate([one.index for one in stripes])
    rays = state.camera.rays(np.concatenate([one.pixels for one in stripes]))
    with np.errstate(all="ignore"):
        depth = sheets.intersect(rays, index).depth[:, None]
        points = rays * depth
        offset = sheets.offset(points, sheets.evaluate(index), parameters=True)
        assert offset.by_parameter is not None
        along_ray = np.sum(offset.by_point * rays, axis=1)[:, None]
        by_rays = depth[..., None] * _differentiate_rays(state.camera, rays)
        by_camera = -np.einsum("nk,nkp->np", offset.by_point[:, :2], by_rays) / along_ray
        by_sheets = -offset.by_parameter / along_ray
    # How points move, (N, 3, P), by the unknowns of the camera and of the sheets.
    moved = rays[..., None] * np.concatenate([by_camera, by_sheets], axis=1)[:, None]
    moved[:, :2, : by_camera.shape[1]] += by_rays
    valid = np.isfinite(moved).all(axis=(1, 2))
    moved, rays, depth = moved[valid], rays[valid], depth[valid]
    motion = twist_jacobian(points[valid])
    common = np.linalg.lstsq(motion.reshape(-1, 6), moved.reshape(len(motion) * 3, -1), rcond=None)
    remaining = np.einsum("ni,nip->np", rays, moved - motion @ common[0])
    remaining /= np.sum(rays**2, axis=1)[:, None] * depth
    # A weak prior, at relative changes of 1e-7, keeps unobserved directions of the sheets at zero.
    prior = 1e-7 * np.sqrt(len(depth)) * sheets.linearize_prior()[1]
    matrix = np.concatenate([by_sheets[valid] / depth, prior])
    right = np.concatenate([remaining, np.zeros((len(prior), remaining.shape[1]))])
    transfer = np.linalg.lstsq(matrix, right, rcond=None)[0]
    camera, _, sheet_columns, _ = state.columns
    columns = np.concatenate([camera, sheet_columns[direction]])
    total = transfer @ covariance[np.ix_(columns, columns)] @ transfer.T
    return np.asarray(0.5 * (total + total.T), np.float64)
