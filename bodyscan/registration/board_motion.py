"""How far a board moved between the cameras' pictures of one shot, where these are not synchronised.

Each view shows its board a small motion away from where the shot has it: a random effect, normal, with
standard deviations of each camera's own along the board's path through the shots and in any
direction. These maximize the likelihood of the poses that single views give (EM), with Student's t for
the tails, since boards are carried and held still by turns. The joint solve marginalizes the motions:
lenses follow each view by itself, poses the mean over the shots.

Source: Laird and Ware, Random-Effects Models for Longitudinal Data, Biometrics 38, 1982; Lange, Little
and Taylor, Robust Statistical Modeling Using the t Distribution, JASA 84, 1989.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array, Indices
from bodyscan.boards.view import ViewKey
from bodyscan.calibration.board_views import LocatedView, apply_shape
from bodyscan.calibration.camera import CORNERS
from bodyscan.geometry.linear_gaussian import LinearGaussianSystem
from bodyscan.geometry.transforms import RigidTransform, adjoint, make_cross_matrix
from bodyscan.registration.joint_solve import JointSolution, linearize_reprojection


@dataclass(frozen=True, eq=False)
class _Motions:
    """Estimates by each of V views of its board's motion from where the shot has it."""

    # (V, 6, 6) columns: turns about the board's middle that move its corners by 1 mm, and shifts by
    # 1 mm, board frame.
    basis: Array
    observed: Array  # (V, 6) mm in that basis
    covariance: Array  # (V, 6, 6), of corners' noise
    path: Array  # (V, 6) mm from the shot before to the one after
    # camera, target: (V,) their numbers.
    camera: Indices
    target: Indices


def estimate_motions(
    views: Sequence[LocatedView], solution: JointSolution, noise_px: float
) -> tuple[dict[ViewKey, Array], dict[str, float]]:
    """Estimate each view's motions, for `JointSolution`, and their RMS by camera, mm.

    views: of boards as described. noise_px: sigma of a corner's coordinate.
    """
    estimates = _observe_motions(views, solution, noise_px)
    root, weight = _maximize_likelihood(estimates)
    motions = estimates.basis @ root / (noise_px * np.sqrt(weight))[:, None, None]
    square, number = np.sum(root[:, 3:] ** 2, axis=(1, 2)), np.bincount(estimates.camera)
    rms = np.sqrt(np.bincount(estimates.camera, square) / number).tolist()
    names = sorted({view.pair for view in views})
    by_view = {view.key: motion for view, motion in zip(views, motions, strict=True)}
    return by_view, dict(zip(names, rms, strict=True))


def _observe_motions(
    views: Sequence[LocatedView], solution: JointSolution, noise_px: float
) -> _Motions:
    bases, poses = {}, solution.root_from_board
    for board in {view.board for view in views}:
        points = np.concatenate([view.points for view in views if view.board == board])
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        radius = np.sqrt(np.mean(np.sum((points - middle) ** 2, axis=1)))
        turns = np.concatenate([np.eye(3), make_cross_matrix(middle)]) / radius
        bases[board] = np.hstack([turns, np.eye(6)[:, 3:]]), middle, radius
    targets = sorted({view.target for view in views})
    paths, systems = {}, []
    for target in targets:
        of_board = [one for one in targets if one[1] == target[1]]
        k, (_, middle, radius) = of_board.index(target), bases[target[1]]
        first, last = poses[of_board[max(k - 1, 0)]], poses[of_board[: k + 2][-1]]
        turn = RigidTransform(last.rotation @ first.rotation.T, np.zeros(3)).rotation_vector
        shift = last.apply(middle) - first.apply(middle)
        paths[target] = (
            np.concatenate([radius * turn, shift]).reshape(2, 3) @ poses[target].rotation
        )
    for view in views:
        residuals, linearize = linearize_reprojection(
            [apply_shape(view, solution.shapes)],
            solution.cameras, solution.root_from_camera, poses,
        )  # fmt: skip
        jacobian = linearize()[:, 6:12] @ adjoint(poses[view.target]) @ bases[view.board][0]
        alone = residuals - jacobian @ np.linalg.lstsq(jacobian, residuals, rcond=None)[0]
        weights = CORNERS.weights(alone / noise_px) / noise_px**2
        systems.append(LinearGaussianSystem.from_observations(jacobian, -residuals, weights))
    names = sorted({view.pair for view in views})
    return _Motions(
        np.array([bases[view.board][0] for view in views]),
        np.array([system.solve() for system in systems]),
        np.array([system.covariance() for system in systems]),
        np.array([paths[view.target].ravel() for view in views]),
        np.array([names.index(view.pair) for view in views]),
        np.array([targets.index(view.target) for view in views]),
    )


def _maximize_likelihood(estimates: _Motions) -> tuple[Array, Array]:
    """Roots (V, 6, 7) of the motions' covariances, mm: in any direction, then one along the
    path, both of the camera; and the weights (V,) of Student's t, by which variances are divided."""
    camera, shared = estimates.camera, np.bincount(estimates.target)[estimates.target] > 1
    # A camera's own pose follows one of its views.
    count = np.maximum(np.bincount(camera, shared) - 1, 1)
    sigma = np.full(len(count), max(np.sqrt(np.median(estimates.observed[shared] ** 2)), 1e-6))
    along, weight = np.full(len(count), 0.1), np.ones(len(camera))
    freedoms = 4.0  # one view in twenty moves more than 2.8 sigmas
    for _ in range(40):
        free, path = (
            sigma[camera][:, None, None] * np.eye(6),
            along[camera][:, None] * estimates.path,
        )
        root = np.concatenate([free, path[..., None]], axis=2)
        square = _expect_squares(estimates, root / np.sqrt(weight)[:, None, None])
        sigma *= np.sqrt(np.bincount(camera, shared * square[:, :6].mean(axis=1)) / count)
        along *= np.sqrt(np.bincount(camera, shared * square[:, 6]) / count)
        weight = (freedoms + 7.0) / (freedoms + square.sum(axis=1) / weight)
    # The information of a Student t of six dimensions is less than its weights say.
    return root, weight * (freedoms + 6.0) / (freedoms + 8.0)


def _expect_squares(estimates: _Motions, root: Array) -> Array:
    """Expected squares (V, 7) of the independent normal variables z of motions `root` z, root
    (V, 6, 7), with the boards' poses unknown."""
    known = np.linalg.inv(estimates.covariance + root @ root.transpose(0, 2, 1))
    count = estimates.target.max() + 1
    whole, vector = np.zeros((count, 6, 6)), np.zeros((count, 6))
    np.add.at(whole, estimates.target, known)
    np.add.at(vector, estimates.target, np.einsum("vij,vj->vi", known, estimates.observed))
    inverse = np.linalg.inv(whole)
    residual = estimates.observed - np.einsum("tij,tj->ti", inverse, vector)[estimates.target]
    gain = root.transpose(0, 2, 1) @ known
    variance = gain @ inverse[estimates.target] @ gain.transpose(0, 2, 1) - gain @ root
    found = np.einsum("vij,vj->vi", gain, residual)
    return np.asarray(found**2 + 1.0 + np.einsum("vii->vi", variance))
