"""All poses of a rig in one solve (pycolmap): cameras are sensors of one rig, shots are frames.

Ceres, behind pycolmap, does what it does best: thousands of corners, sparse, from a start that may
be centimetres off. Corners are known points, and cameras ideal: lens and skew are taken out of the
pixels. `bundle_adjustment` follows, with the cameras' own parameters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap

from bodyscan.calibration.board_views import LocatedView
from bodyscan.errors import FailedWork
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.view_graph import Target


@dataclass(frozen=True, eq=False)
class JointSolution:
    """Cameras, and all poses in the root camera's frame, mm: the start or the result of a solve."""

    root_from_camera: dict[str, RigidTransform]
    root_from_board: dict[Target, RigidTransform]
    cameras: dict[str, Camera]


def solve_jointly(
    views: Sequence[LocatedView], start: JointSolution, *, root: str, loss_px: float
) -> JointSolution:
    """Bundle adjustment of all poses, with the boards' corners as constant points and a Cauchy loss.

    COLMAP's world is one board, and each (shot, board) is a frame, so `rig_from_world` is
    `root_from_board`. Raises FailedWork if the solver does not converge.
    """
    names = [root, *sorted(set(start.cameras) - {root})]
    ids = {name: number for number, name in enumerate(names, start=1)}
    targets = sorted({view.target for view in views})
    model = pycolmap.Reconstruction()
    for name, camera in start.cameras.items():
        model.add_camera(
            pycolmap.Camera(
                model="SIMPLE_PINHOLE",
                width=camera.width,
                height=camera.height,
                params=[camera.alpha, 0.0, 0.0],
                camera_id=ids[name],
            )
        )
    model.add_rig(_colmap_rig(names, start.root_from_camera))
    points = _add_points(model, views)
    if not points:  # a single view of a known camera; `bundle_adjustment` needs no start
        return start
    for number, target in enumerate(targets, start=1):
        group = [view for view in views if view.target == target]
        _add_frame(model, number, group, ids, start.cameras, points, start.root_from_board[target])
    _adjust(model, loss_px)
    rig = model.rig(1)
    root_from_camera = {root: RigidTransform.identity()}
    for name in names[1:]:
        sensor_from_rig = rig.sensor_from_rig(_sensor(ids[name]))
        root_from_camera[name] = RigidTransform.from_matrix(sensor_from_rig.matrix()).inverse()
    boards = {
        target: RigidTransform.from_matrix(model.frame(number).rig_from_world.matrix())
        for number, target in enumerate(targets, start=1)
    }
    return JointSolution(root_from_camera, boards, start.cameras)


def _sensor(camera_id: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)


def _rigid3d(transform: RigidTransform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(transform.matrix[:3])


def _colmap_rig(names: Sequence[str], root_from_camera: dict[str, RigidTransform]) -> pycolmap.Rig:
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(_sensor(1))
    for number, name in enumerate(names[1:], start=2):
        rig.add_sensor(_sensor(number), _rigid3d(root_from_camera[name].inverse()))
    return rig


def _add_points(
    model: pycolmap.Reconstruction, views: Sequence[LocatedView]
) -> dict[tuple[str, tuple[float, ...]], int]:
    """Add one constant point for each corner of each board, keyed by board and rounded position.

    COLMAP refuses a point observed in a single view: such corners are left out.
    """
    counts = Counter(key for view in views for key in _point_keys(view))
    keys = sorted(key for key, count in counts.items() if count > 1)
    numbers = {key: number for number, key in enumerate(keys, start=1)}
    for (_, position), number in numbers.items():
        point = pycolmap.Point3D()
        point.xyz = np.array(position)
        model.add_point3D_with_id(number, point)
    return numbers


def _point_keys(view: LocatedView) -> list[tuple[str, tuple[float, ...]]]:
    rounded = np.round(view.points, 6) + 0.0
    return [(view.board, tuple(point)) for point in rounded.tolist()]


def _add_frame(
    model: pycolmap.Reconstruction,
    number: int,
    group: Sequence[LocatedView],
    ids: dict[str, int],
    cameras: Mapping[str, Camera],
    points: dict[tuple[str, tuple[float, ...]], int],
    root_from_board: RigidTransform,
) -> None:
    frame = pycolmap.Frame(frame_id=number, rig_id=1)
    first_image = model.num_images() + 1
    for image_id, view in enumerate(group, start=first_image):
        data = pycolmap.data_t(_sensor(ids[view.pair]), image_id)
        frame.add_data_id(data)
    frame.rig_from_world = _rigid3d(root_from_board)
    model.add_frame(frame)
    for image_id, view in enumerate(group, start=first_image):
        camera = cameras[view.pair]
        pixels = camera.alpha * camera.rays(view.pixels)[:, :2]  # as a pinhole with alpha sees them
        image = pycolmap.Image(
            name=f"{view.shot}/{view.board}/{view.pair}",
            keypoints=pixels,
            camera_id=ids[view.pair],
            image_id=image_id,
        )
        image.frame_id = number
        model.add_image(image)
        for k, key in enumerate(_point_keys(view)):
            if key in points and np.isfinite(pixels[k]).all():
                model.add_observation(points[key], pycolmap.TrackElement(image_id, k))
    model.register_frame(number)


def _adjust(model: pycolmap.Reconstruction, loss_px: float) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_points3D = False
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = loss_px
    options.ceres.solver_options.gradient_tolerance = 1e-6
    options.ceres.solver_options.function_tolerance = 1e-6  # `bundle_adjustment` finishes
    options.ceres.solver_options.num_threads = 2
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.images:
        config.add_image(image_id)
    for point_id in model.points3D:
        config.add_constant_point(point_id)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    summary = adjuster.solve()
    if not summary.is_solution_usable():
        raise FailedWork(
            f"the joint solve of the rig did not converge: {summary.brief_report()}",
            remedy="look at the views listed above; a mislabelled shot can cause this",
        )
