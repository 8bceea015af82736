from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from table_one import CAMERA

from bodyscan.calibration.boundary_points import (
    BoundaryPoints,
    boundary_points,
    concatenate,
    select,
)
from bodyscan.calibration.sheet_fit import fit_light_planes
from bodyscan.geometry.light_planes import LightPlanes, compute_baseline_angle_tilt
from bodyscan.geometry.transforms import RigidTransform

STRIPES = 16
POSES = [
    RigidTransform.from_rotation_vector(turn, [-90.0, -70.0, depth])
    for turn, depth in (
        ([0.3, 0.2, 0.0], 380.0),
        ([-0.3, 0.1, 0.0], 420.0),
        ([0.1, -0.4, 0.0], 460.0),
    )
]


def true_planes() -> np.ndarray:
    """Vertical sheets that do not share a line: baseline and angle both drift, slightly tilted."""
    i = np.arange(STRIPES + 1.0)
    angle = np.radians(20.0 + 1.0 * i)
    normals = np.stack([np.cos(angle), 0.02 * np.ones_like(i), -np.sin(angle)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.column_stack([normals, normals[:, 0] * (200.0 - 0.5 * i)])


def seen_on(
    pose: RigidTransform, planes: np.ndarray, number: int, noise_px: float = 0.0
) -> BoundaryPoints:
    """Boundary pixels of every plane on one board, by intersecting planes with the board's."""
    index = np.repeat(np.arange(STRIPES + 1), 60)
    v = np.tile(np.linspace(40.0, 440.0, 60), STRIPES + 1)
    normal = pose.rotation[:, 2]
    rows = np.stack([planes[index, :3], np.broadcast_to(normal, (len(index), 3))], axis=1)
    right = np.stack([-planes[index, 3], np.full(len(index), normal @ pose.translation)], axis=1)
    point = np.linalg.pinv(rows) @ right[..., None]
    along = np.cross(rows[:, 0], rows[:, 1])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    points = point[..., 0] + along * ((v - 240.0) * 0.3)[:, None]
    pixels = CAMERA.project(points)
    pixels[:, 0] += np.random.default_rng(number).normal(0.0, noise_px, len(pixels))
    return boundary_points(
        CAMERA, pose, index, pixels, np.full(len(index), 0.05), board=number, direction="vertical"
    )


def test_planes_are_recovered_from_three_boards() -> None:
    data = concatenate([seen_on(pose, true_planes(), k) for k, pose in enumerate(POSES)])
    fit = fit_light_planes(data, STRIPES, "vertical")
    assert fit.planes.calibrated.all()
    # Newton's undistortion and float64 leave well under a nanometre over half a metre.
    assert np.allclose(fit.planes.coefficients, true_planes(), atol=1e-6)
    assert fit.rms_mm < 1e-6


def test_outliers_move_no_plane() -> None:
    clean = concatenate([seen_on(pose, true_planes(), k, 0.05) for k, pose in enumerate(POSES)])
    dirty = clean.points.copy()
    dirty[::40] += [3.0, 0.0, 5.0]
    spoilt = type(clean)(clean.index, clean.board, dirty, clean.per_pixel, clean.sigma_px)
    moved = (
        fit_light_planes(spoilt, STRIPES, "vertical").planes.coefficients
        - fit_light_planes(clean, STRIPES, "vertical").planes.coefficients
    )
    off = np.abs(np.sum(clean.points * moved[clean.index, :3], axis=1) + moved[clean.index, 3])
    # Planes by themselves are good to 0.002 mm; unweighted the outliers would move them by 0.08.
    assert np.sqrt(np.mean(off**2)) < 0.002


def pulls(noise_px: float, board_mm: float, believed_mm: float) -> float:
    """RMS of how far fitted planes are off amid the boards, over what their covariance says."""
    planes, found = true_planes(), []
    for seed in range(12):
        rng = np.random.default_rng([7, seed])
        parts = []
        for k, pose in enumerate(POSES):
            part = seen_on(pose, planes, 100 * seed + k, noise_px)
            moved = board_mm * rng.standard_normal()
            out = part.points * (moved / (part.points @ pose.rotation[:, 2]))[:, None]
            parts.append(replace(part, points=part.points + out))
        fit = fit_light_planes(concatenate(parts), STRIPES, "vertical", board_error_mm=believed_mm)
        place = np.column_stack([np.zeros((STRIPES + 1, 2)), np.full(STRIPES + 1, 420.0)])
        place[:, 0] = -(planes[:, 2] * 420.0 + planes[:, 3]) / planes[:, 0]
        place = np.column_stack([place, np.ones(STRIPES + 1)])
        off = np.sum(place * fit.planes.coefficients, axis=1)
        variance = np.einsum("ni,nij,nj->n", place, fit.planes.covariance, place)
        found.append(off / np.sqrt(variance))
    return float(np.sqrt(np.mean(np.square(found))))


def test_the_planes_covariance_is_that_of_their_errors() -> None:
    # 12 x 17 independent planes: 1 +- 0.05. Points claim 0.05 px and err by 0.15: the residuals tell.
    assert pulls(0.15, 0.0, 0.0) == pytest.approx(1.0, abs=0.15)


def test_points_count_by_what_a_pixel_moves_them_off_the_plane() -> None:
    """The light grazes one of three boards: a pixel moves a point far along its plane, hardly off it,
    so that the plane lies on that board nearly exactly."""
    planes = true_planes()
    grazed = RigidTransform.from_rotation_vector([0.0, -0.9, 0.0], [-60.0, -70.0, 360.0])
    poses, off = (*POSES[:2], grazed), []
    there = seen_on(grazed, planes, 0)
    moves = np.abs(np.sum(there.per_pixel * planes[there.index, :3], axis=1))
    for seed in range(4):
        parts = [seen_on(pose, planes, 20 * seed + k, 0.3) for k, pose in enumerate(poses)]
        found = fit_light_planes(concatenate(parts), STRIPES, "vertical").planes.coefficients
        distance = np.sum(there.points * found[there.index, :3], axis=1) + found[there.index, 3]
        off.append(distance / (0.3 * moves))
    # A straight line through 60 points: sqrt(2 / 60) of one's noise, whatever the other boards say.
    assert np.sqrt(np.mean(np.square(off))) < 1.1 * np.sqrt(2.0 / 60.0)


def test_a_board_with_a_few_points_is_no_second_board() -> None:
    parts = [seen_on(pose, true_planes(), k) for k, pose in enumerate(POSES)]
    few = np.flatnonzero(parts[1].index == 5)[:11]
    kept = [part.index != 5 for part in parts]
    kept[0][:], kept[1][few] = True, True
    planes = fit_light_planes(
        concatenate([select(part, keep) for part, keep in zip(parts, kept, strict=True)]),
        STRIPES,
        "vertical",
    ).planes
    # Eleven points beside each other open a plane, and say nothing of which stripe they are.
    assert not planes.calibrated[5]
    assert planes.calibrated.sum() == STRIPES


def test_boards_out_of_place_are_in_the_planes_covariance() -> None:
    # All planes of a draw share their boards' errors: 12 x 3 draws, 1 +- 0.12; and boards that are
    # shifted only are a little better than boards that are tilted as well, as is believed.
    assert 0.75 < pulls(0.02, 0.1, 0.1) < 1.25
    assert pulls(0.02, 0.1, 0.0) > 5.0


def test_horizontal_stripes_are_told_about_the_other_axis() -> None:
    """The same sheets seen by a camera turned by a quarter: x and y exchanged."""
    planes = true_planes()
    turned = planes[:, [1, 0, 2, 3]]
    i = np.arange(STRIPES + 1.0)
    baseline, angle, tilt = compute_baseline_angle_tilt(turned, "horizontal")
    assert np.allclose(baseline, 200.0 - 0.5 * i)
    assert np.allclose(angle, np.radians(20.0 + i))
    assert np.allclose(tilt, -np.arctan(0.02 / np.cos(np.radians(20.0 + i))))


@given(st.floats(20.0, 600.0), st.floats(20.0, 460.0), st.integers(0, STRIPES))
def test_equation_13_equals_equation_14(u: float, v: float, i: int) -> None:
    planes = LightPlanes(true_planes(), np.zeros((STRIPES + 1, 4, 4)), "vertical")
    ray = CAMERA.rays(np.array([[u, v]]))
    baseline, angle, tilt = compute_baseline_angle_tilt(planes.coefficients[i], "vertical")
    # The chapter prints - tan(tilt): with its own Eq. 9 the sign must be + (docs/method.md).
    by_14 = baseline / (np.tan(angle) - ray[0, 0] + np.tan(tilt) * ray[0, 1])
    by_13 = planes.intersect(ray, np.array([float(i)])).depth[0]
    assert np.isclose(by_13, by_14, rtol=1e-9) or (by_14 <= 0 and np.isnan(by_13))
