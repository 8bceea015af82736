"""The two solves of a rig's boards: both end where the corners put everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from ring import ring_of_cameras, ring_views

from bodyscan.calibration.board_views import LocatedView, PlanarView
from bodyscan.calibration.camera import fit_camera
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.lens import Lens
from bodyscan.geometry.lenses.opencv import Brown, Radial
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.cluster_covariance import build_normal_equations
from bodyscan.registration.joint_solve import JointSolution, refine_solution, solve_poses
from bodyscan.registration.rig_solve import LOSSES_PX

PLACINGS, CAMERAS = ring_of_cameras(poles=2, heights=(700, 1100))
ROOT = "p1-1"


def in_frame_of_root(
    placings: dict[str, RigidTransform], boards: dict[tuple[str, str], RigidTransform]
) -> JointSolution:
    to_root = placings[ROOT].inverse()
    return JointSolution(
        {name: to_root @ placing for name, placing in placings.items()},
        {target: to_root @ board for target, board in boards.items()},
        dict(CAMERAS),
    )


def astray(placing: RigidTransform, rng: np.random.Generator) -> RigidTransform:
    return placing @ RigidTransform.from_rotation_vector(
        rng.normal(0.0, 0.02, 3), rng.normal(0.0, 10.0, 3)
    )


def far_start(true: JointSolution, cameras: dict[str, Camera]) -> JointSolution:
    """Poses 2 degrees and 20 mm off, but for the root camera's, which is the frame."""
    rng = np.random.default_rng(1)
    return JointSolution(
        {n: p if n == ROOT else astray(p, rng) for n, p in true.root_from_camera.items()},
        {target: astray(placing, rng) for target, placing in true.root_from_board.items()},
        cameras,
    )


def test_the_full_solve_ends_at_the_minimum_from_afar() -> None:
    """Corners without noise: everything is found again, from poses 2 degrees and 20 mm off."""
    views, truth = ring_views(PLACINGS, CAMERAS, shots=12, noise_px=0.0)
    true = in_frame_of_root(PLACINGS, {view.target: truth[view.target] for view in views})
    longer = np.array([8.0, 8.0, 0.0, 3.0, 3.0, 0, 0])
    start = far_start(true, {name: c.retract(longer) for name, c in CAMERAS.items()})
    found = refine_solution(views, start, root=ROOT)
    for name, placing in true.root_from_camera.items():
        off = found.root_from_camera[name].translation - placing.translation
        # One step of Gauss and Newton leaves some millimetres.
        assert np.linalg.norm(off) < 1e-3, name
        assert np.allclose(found.cameras[name].parameters, CAMERAS[name].parameters, atol=1e-3)


@pytest.mark.parametrize("lens", [Radial(-0.2, 0.1), Brown(-0.2, 0.1, 1e-3, -2e-3, 0.0)])
def test_the_poses_are_found_from_afar_whatever_the_cameras(lens: Lens) -> None:
    """Corners without noise; a tenth of the views 40 px away from where their boards are."""
    cameras = {n: replace(c, beta=1.02 * c.alpha, lens=lens) for n, c in CAMERAS.items()}
    views, truth = ring_views(PLACINGS, cameras, shots=12, noise_px=0.0)
    true = in_frame_of_root(PLACINGS, {view.target: truth[view.target] for view in views})
    start = far_start(true, cameras)
    rng = np.random.default_rng(2)
    views = [
        replace(view, pixels=view.pixels + 40.0 * (rng.random() < 0.1) * np.array([1.0, -1.0]))
        for view in views
    ]
    found = start
    for loss_px in LOSSES_PX:
        found = solve_poses(views, found, root=ROOT, loss_px=loss_px)
    assert found.cameras == cameras
    for name, placing in true.root_from_camera.items():
        off = found.root_from_camera[name].translation - placing.translation
        assert np.linalg.norm(off) < 0.05, name


def test_the_corners_variance_is_found_although_the_unknowns_take_some_up() -> None:
    """Of 96 residuals camera and poses take 25: without the degrees of freedom 26 % too small."""
    column, row = np.meshgrid(np.arange(4.0), np.arange(4.0))
    corners = 100.0 * np.column_stack([column.ravel(), row.ravel(), np.zeros(16)])
    turns = ([0.4, 0.3, 0.0], [-0.4, 0.2, 0.5], [0.1, -0.5, 1.0])
    poses = [RigidTransform.from_rotation_vector(t, [-150.0, -150.0, 1200.0]) for t in turns]
    sigma_px, found = 0.05, []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        planar = [
            PlanarView(str(k), corners, CAMERAS[ROOT].project(pose.apply(corners))
                       + rng.normal(0.0, sigma_px, (16, 2)))
            for k, pose in enumerate(poses)
        ]  # fmt: skip
        fit = fit_camera(CAMERAS[ROOT], poses, planar)
        views = [
            LocatedView(ROOT, view.shot, "b", corners, view.pixels, pose)
            for view, pose in zip(planar, fit.poses, strict=True)
        ]
        equations = build_normal_equations(
            views,
            {ROOT: fit.camera},
            {ROOT: RigidTransform.identity()},
            {view.target: view.camera_from_board for view in views},
            fixed_pair=ROOT,
            fixed_target=None,
        )
        found.append(equations.variance_px2)
    # 40 draws of 71 degrees of freedom: 2.7 %; weights of corners beyond 4 sigmas take 3 % away.
    assert np.mean(found) == pytest.approx(sigma_px**2, rel=0.1)
