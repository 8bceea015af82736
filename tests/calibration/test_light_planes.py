import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bodyscan.calibration.boundary_points import BoundaryPoints, boundary_points, concatenate
from bodyscan.calibration.light_planes import fit_light_planes
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses.radial import Radial
from bodyscan.geometry.light_planes import LightPlanes, baseline_angle_tilt
from bodyscan.geometry.transforms import RigidTransform

CAMERA = Camera(
    1061.71, 1064.09, -0.562002, 350.08, 286.547, Radial(-0.140279, -0.0916363), 640, 480
)
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


def test_outliers_lose_their_weight() -> None:
    clean = concatenate([seen_on(pose, true_planes(), k, 0.05) for k, pose in enumerate(POSES)])
    dirty = clean.points.copy()
    dirty[::40] += [3.0, 0.0, 5.0]
    spoilt = type(clean)(clean.index, clean.board, dirty, clean.per_pixel, clean.sigma_px)
    planes = fit_light_planes(spoilt, STRIPES, "vertical").planes.coefficients
    # 180 points of about 0.03 mm each: a plane's offset at its points is good to a few um, and
    # the outliers, 100 sigmas off, may add as much again; unweighted they would add 0.1 mm.
    offsets = np.abs(
        np.sum(clean.points * planes[clean.index, :3], axis=1) + planes[clean.index, 3]
    )
    assert np.median(offsets) < 0.04


def test_a_stripe_on_one_board_gets_no_plane() -> None:
    parts = [seen_on(pose, true_planes(), k) for k, pose in enumerate(POSES)]
    keep = [part.index != 5 for part in parts]
    keep[0][:] = True
    parts = [
        type(p)(*(getattr(p, n)[k] for n in ("index", "board", "points", "per_pixel", "sigma_px")))
        for p, k in zip(parts, keep, strict=True)
    ]
    planes = fit_light_planes(concatenate(parts), STRIPES, "vertical").planes
    assert not planes.calibrated[5]
    assert planes.calibrated.sum() == STRIPES


def test_depth_is_nan_beside_a_missing_plane() -> None:
    coefficients = true_planes()
    coefficients[5] = np.nan
    planes = LightPlanes(coefficients, np.zeros((STRIPES + 1, 4, 4)), "vertical")
    rays = np.tile([0.02, 0.01, 1.0], (5, 1))
    depth = planes.depth(rays, np.array([3.5, 4.0, 4.5, 5.5, 6.0]))
    assert list(np.isfinite(depth)) == [True, True, False, False, True]


@given(st.floats(20.0, 600.0), st.floats(20.0, 460.0), st.integers(0, STRIPES))
def test_equation_13_equals_equation_14(u: float, v: float, i: int) -> None:
    planes = LightPlanes(true_planes(), np.zeros((STRIPES + 1, 4, 4)), "vertical")
    ray = CAMERA.rays(np.array([[u, v]]))
    baseline, angle, tilt = baseline_angle_tilt(planes.coefficients[i], "vertical")
    # The chapter prints - tan(tilt): with its own Eq. 9 the sign must be + (docs/method.md).
    by_14 = baseline / (np.tan(angle) - ray[0, 0] + np.tan(tilt) * ray[0, 1])
    by_13 = planes.depth(ray, np.array([float(i)]))[0]
    assert np.isclose(by_13, by_14, rtol=1e-9) or (by_14 <= 0 and np.isnan(by_13))
