"""A COLMAP model of one rig, whose sensors are the cameras.

COLMAP's cameras have no skew, so it is said beside them.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap

from bodyscan.errors import BadInput
from bodyscan.export.rig_format import RigCameras, RigFormat, cameras_of
from bodyscan.files.atomic import write_bytes, write_json
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.joint_solve import COLMAP_PIXEL_CENTRE
from bodyscan.registration.rig_calibration import RigCalibration

SKEW_FILE = "bodyscan.json"
NO_SKEW = (
    "Cameras here have no skew. Shear an image point (u, v) of the pair (pixel centres at whole "
    "numbers, v0 = cy - 0.5) to (u - gamma / beta * (v - v0), v) before using it with them."
)


def write_colmap_rig(calibration: RigCalibration, folder: Path) -> Path:
    """COLMAP's text model: one rig whose sensors are the cameras, and one frame of one empty image
    a pair, which puts them where they stand: COLMAP's world is the rig frame, mm.

    `bodyscan.json` beside it holds what COLMAP has no place for: each camera's gamma.  Returns
    `folder`.
    """
    cameras = cameras_of(calibration)
    model = _colmap_model(cameras)
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


def read_colmap_rig(folder: Path) -> RigCameras:
    """Cameras and poses as the COLMAP model says (another program may have refined it); the skew
    from `bodyscan.json`.  Raises BadInput if files are missing or do not belong together."""
    folder, model = Path(folder), pycolmap.Reconstruction()
    try:
        model.read_text(folder)
        pairs = json.loads((folder / SKEW_FILE).read_text("utf-8"))["pairs"]
        images = {image.name: image for image in model.images.values()}
        return {
            name: (
                _camera_from_colmap(images[name].camera, float(pairs[name]["gamma"])),
                RigidTransform.from_matrix(images[name].cam_from_world().matrix()).inverse(),
            )
            for name in pairs
        }
    except (OSError, ValueError, KeyError, TypeError, RuntimeError, IndexError) as error:
        raise BadInput(
            f"is not a rig as bodyscan writes it for COLMAP ({type(error).__name__}: {error})",
            where=str(folder),
            remedy=f"it needs COLMAP's text files and {SKEW_FILE}, written by "
            "`bodyscan export-rig --format colmap`",
        ) from error


def _colmap_model(cameras: Mapping[str, tuple[Camera, RigidTransform]]) -> pycolmap.Reconstruction:
    """The first pair is the reference sensor, whose frame COLMAP takes for the rig's own."""
    model, rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)
    frame = pycolmap.Frame(frame_id=1, rig_id=1)
    reference = next(iter(cameras.values()))[1]
    for number, (camera, rig_from_camera) in enumerate(cameras.values(), start=1):
        model.add_camera(_colmap_camera(camera, number))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number)
        if number == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, _rigid3d(rig_from_camera.inverse() @ reference))
        frame.add_data_id(pycolmap.data_t(sensor, number))
    model.add_rig(rig)
    frame.rig_from_world = _rigid3d(reference.inverse())
    model.add_frame(frame)
    for number, name in enumerate(cameras, start=1):
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        image.frame_id = 1
        model.add_image(image)
    model.register_frame(1)
    return model


def _colmap_camera(camera: Camera, camera_id: int) -> pycolmap.Camera:
    centre = [camera.u0 + COLMAP_PIXEL_CENTRE, camera.v0 + COLMAP_PIXEL_CENTRE]
    # COLMAP's OPENCV is a prefix of its FULL_OPENCV, which has OpenCV's first eight coefficients.
    lens = np.append(camera.lens.opencv(), np.zeros(8))[:8]
    model = "FULL_OPENCV" if lens[4:].any() else "OPENCV"
    return pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=[camera.alpha, camera.beta, *centre, *lens[: 4 if model == "OPENCV" else 8]],
        camera_id=camera_id,
    )


def _camera_from_colmap(camera: pycolmap.Camera, gamma: float) -> Camera:
    if camera.model.name not in ("OPENCV", "FULL_OPENCV"):
        raise ValueError(f"camera model {camera.model.name}, expected OPENCV or FULL_OPENCV")
    fx, fy, cx, cy, *coefficients = (float(value) for value in camera.params)
    lens = lens_from_opencv(np.array(coefficients))
    u0, v0 = cx - COLMAP_PIXEL_CENTRE, cy - COLMAP_PIXEL_CENTRE
    return Camera(fx, fy, gamma, u0, v0, lens, camera.width, camera.height)


def _rigid3d(transform: RigidTransform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(transform.matrix[:3])


FORMAT = RigFormat("colmap", write_colmap_rig, read_colmap_rig)
