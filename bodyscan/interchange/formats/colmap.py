"""A COLMAP model: its cameras, and the poses of its images or of the sensors of its rig.

COLMAP's cameras have no skew, so bodyscan writes it in a file beside them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from bodyscan.errors import CalibrationFileError
from bodyscan.files.atomic import write_bytes, write_json
from bodyscan.files.reading import read_json_object
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.interchange.foreign_file import ForeignFile
from bodyscan.interchange.found_camera import FoundCamera, FoundCameras
from bodyscan.interchange.rig_format import RigCameras, RigFormat, describe_opencv_lens

PIXEL_CENTRE = 0.5  # COLMAP's pixels have their centres at + 0.5, ours at whole numbers
SKEW_FILE = "bodyscan.json"
NO_SKEW = (
    "Cameras here have no skew. Shear an image point (u, v) of the pair (pixel centres at whole "
    "numbers, v0 = cy - 0.5) to (u - gamma / beta * (v - v0), v) before using it with them."
)
# Their further parameters are OpenCV's k1, k2, p1, p2, ... or, of a fisheye, its k1 to k4.
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYES = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")


def write_colmap(cameras: RigCameras, folder: Path) -> Path:
    """Write COLMAP's text model: one rig whose sensors are the cameras, and one frame with one
    empty image per pair, which gives their poses: COLMAP's world is the rig frame, mm.

    `bodyscan.json` beside it holds what COLMAP does not: each camera's gamma. Returns `folder`.
    """
    model = _build_model(cameras)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".colmap-", dir=folder) as temporary:
        model.write_text(temporary)
        for file in sorted(Path(temporary).iterdir()):
            write_bytes(folder / file.name, file.read_bytes())
    pairs = {
        name: {"gamma": camera.gamma, "rig_from_camera": rig_from_camera.matrix}
        for name, (camera, rig_from_camera) in cameras.items()
    }
    write_json(folder / SKEW_FILE, {"units": "mm", "skew": NO_SKEW, "pairs": pairs})
    return folder


def read_colmap(folder: Path) -> FoundCameras:
    """Read every image by its name, and every camera with several images by their folder or its
    number, with its pose in its rig if there is one.

    The skew comes from `bodyscan.json` if there is one.
    """
    folder, model = Path(folder), pycolmap.Reconstruction()
    try:
        model.read(folder)
        images = sorted(model.images.values(), key=lambda image: image.image_id)
        # Names are decoded only when accessed.
        names_of = {image.image_id: image.name for image in images}
    except (OSError, ValueError, RuntimeError, IndexError, MemoryError) as error:
        reason = str(error).strip().splitlines() or [type(error).__name__]
        remedy = "give the folder that holds cameras, images and points3D, .bin or .txt"
        what = f"is not a COLMAP model ({reason[-1]})"
        raise ForeignFile(folder).error(what, remedy=remedy) from error
    gammas = _read_gammas(folder)
    readers = {}
    for number, camera in sorted(model.cameras.items()):
        taken = [image for image in images if image.camera_id == number]
        folders = {names_of[image.image_id].rpartition("/")[0] for image in taken}
        names = {str(number), *(folders - {""} if len(folders) == 1 else ())}
        rig_pose = _find_pose_in_rig(model, number)
        for name in names - {image.name for image in taken}:
            readers[name] = partial(_read_camera, folder, camera, 0.0, rig_pose)
        for image in taken:
            gamma = gammas.get(image.name, 0.0)
            readers[image.name] = partial(_read_camera, folder, camera, gamma, _find_pose(image))
    for name in gammas:
        if name not in readers:
            what = f"names a pair {name!r} that the model does not have"
            remedy = "give both as `bodyscan export-rig --format colmap` wrote them"
            raise ForeignFile(folder / SKEW_FILE).error(what, remedy=remedy)
    return readers


def _read_gammas(folder: Path) -> dict[str, float]:
    file = folder / SKEW_FILE
    if not file.is_file():
        return {}
    try:
        pairs = read_json_object(file)["pairs"]
        return {name: float(pair["gamma"]) for name, pair in pairs.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise CalibrationFileError(
            f"is not what bodyscan writes beside a COLMAP model ({type(error).__name__}: {error})",
            where=str(file),
            remedy="write it again with `bodyscan export-rig --format colmap`, or remove it",
        ) from error


def _find_pose(image: Any) -> RigidTransform | None:
    """Return the pose of an image; None if it has none, or its camera has none in its rig."""
    try:
        return _convert_pose(image.cam_from_world()) if image.has_pose else None
    except RuntimeError:
        return None


def _find_pose_in_rig(model: Any, number: int) -> RigidTransform | None:
    """Return camera_from_rig in a rig of several sensors (identity for the reference), or None."""
    sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
    for rig in model.rigs.values():
        if rig.num_sensors() > 1 and rig.has_sensor(sensor):
            if rig.is_ref_sensor(sensor):
                return RigidTransform.identity()
            pose = rig.sensor_from_rig(sensor)
            return None if pose is None else _convert_pose(pose)
    return None


def _read_camera(
    folder: Path, camera: Any, gamma: float, pose: RigidTransform | None
) -> FoundCamera:
    file = ForeignFile(folder)
    name, model = f"camera {camera.camera_id}", camera.model.name
    if model not in PERSPECTIVE + FISHEYES:
        what = f"has a camera of COLMAP's model {model}, which is not supported"
        raise file.error(what, remedy=f"calibrate it with {', '.join(PERSPECTIVE + FISHEYES)}")
    centre = camera.principal_point_x - PIXEL_CENTRE, camera.principal_point_y - PIXEL_CENTRE
    four = [camera.focal_length_x, camera.focal_length_y, *centre]
    matrix = file.pinhole_matrix(four, name)
    matrix[0, 1] = gamma
    further = [camera.params[k] for k in camera.extra_params_idxs()]
    lens = file.lens(further, name, {"fisheye": model in FISHEYES})
    return FoundCamera(matrix, lens, (camera.width, camera.height), pose, str(folder))


def _build_model(cameras: Mapping[str, tuple[Camera, RigidTransform]]) -> pycolmap.Reconstruction:
    """Build COLMAP's model; the first pair is the reference sensor, whose frame is the rig's."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    reference = next(iter(cameras.values()))[1]
    for number, (camera, rig_from_camera) in enumerate(cameras.values(), start=1):
        model.add_camera(_make_camera(camera, number))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        if number == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, _make_rigid3d(rig_from_camera.inverse() @ reference))
        frame.add_data_id(pycolmap.data_t(sensor, number))
    model.add_rig(rig)
    frame.rig_from_world = _make_rigid3d(reference.inverse())
    model.add_frame(frame)
    for number, name in enumerate(cameras, start=1):
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        image.frame_id = 1
        model.add_image(image)
    model.register_frame(1)
    return model


def _make_camera(camera: Camera, camera_id: int) -> pycolmap.Camera:
    centre = [camera.u0 + PIXEL_CENTRE, camera.v0 + PIXEL_CENTRE]
    # COLMAP's OPENCV is a prefix of its FULL_OPENCV, which has OpenCV's first eight coefficients.
    is_fisheye, coefficients = describe_opencv_lens(camera)
    lens = np.append(coefficients, np.zeros(8))[:8]
    model = "FULL_OPENCV" if lens[4:].any() else "OPENCV_FISHEYE" if is_fisheye else "OPENCV"
    return pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=[camera.alpha, camera.beta, *centre, *lens[: 8 if model == "FULL_OPENCV" else 4]],
        camera_id=camera_id,
    )


def _make_rigid3d(transform: RigidTransform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(transform.matrix[:3])


def _convert_pose(pose: Any) -> RigidTransform:
    return RigidTransform.from_matrix(pose.matrix())


FORMAT = RigFormat("colmap", None, write_colmap, read_colmap)
