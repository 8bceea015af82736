"""A calibrated rig for other programs: a COLMAP model with rig, and OpenCV's YAML.

Neither has skew in its camera model, so both files say it beside the camera.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import pycolmap

from bodyscan.errors import BadInput
from bodyscan.files.atomic import write_bytes, write_json, write_text
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.joint_solve import COLMAP_PIXEL_CENTRE
from bodyscan.registration.rig_calibration import RigCalibration

PlacedCameras: TypeAlias = dict[str, tuple[Camera, RigidTransform]]
"""Camera and `rig_from_camera` by the pair's name."""

SKEW_FILE = "bodyscan.json"
OPENCV_FILE = "rig-opencv.yaml"
NO_SKEW = (
    "Cameras here have no skew. Shear an image point (u, v) of the pair (pixel centres at whole "
    "numbers, v0 = cy - 0.5) to (u - gamma / beta * (v - v0), v) before using it with them."
)
OPENCV_NOTE = (
    "Lengths in mm. x_camera = R x_rig + T. Pixel centres at whole numbers. camera_matrix holds the "
    "skew, but OpenCV's functions ignore it: use it with pixels sheared to "
    "u - skew / fy * (v - cy), v, which a camera without skew would have seen."
)


def placed_cameras(calibration: RigCalibration) -> PlacedCameras:
    """Camera and placing of every pair of a calibration."""
    return {
        name: (pair.camera, calibration.rig_from_camera[name])
        for name, pair in calibration.pairs.items()
    }


def export_rig(calibration: RigCalibration, folder: Path, formats: Sequence[str]) -> list[Path]:
    """Write the rig in each format: `colmap` (a folder of that name), `opencv` (a YAML file).

    Raises BadInput for a format that is neither.
    """
    writers: dict[str, Callable[[RigCalibration, Path], Path]] = {
        "colmap": lambda c, f: write_colmap_rig(c, f / "colmap"),
        "opencv": lambda c, f: write_opencv_rig(c, f / OPENCV_FILE),
    }
    unknown = [name for name in formats if name not in writers]
    if unknown:
        raise BadInput(
            f"a rig cannot be written as {', '.join(map(repr, unknown))}",
            where="--format",
            remedy=f"choose from {', '.join(writers)}",
        )
    return [writers[name](calibration, folder) for name in dict.fromkeys(formats)]


def write_colmap_rig(calibration: RigCalibration, folder: Path) -> Path:
    """COLMAP's text model: one rig whose sensors are the cameras, and one frame of one empty image
    a pair, which puts them where they stand: COLMAP's world is the rig frame, mm.

    `bodyscan.json` beside it holds what COLMAP has no place for: each camera's gamma.  Returns
    `folder`.
    """
    cameras = placed_cameras(calibration)
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


def read_colmap_rig(folder: Path) -> PlacedCameras:
    """Cameras and placings as the COLMAP model says (another program may have refined it); the skew
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


def write_opencv_rig(calibration: RigCalibration, path: Path) -> Path:
    """A sequence `pairs` as cv2.FileStorage reads it: name, image size, camera_matrix (with its
    skew), distortion_coefficients (OpenCV's, in its order), R and T of `camera_from_rig`.

    Returns `path`.  Raises BadInput for a lens that OpenCV does not have.
    """
    memory = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    store = cv2.FileStorage("rig.yaml", memory)
    store.writeComment(OPENCV_NOTE, False)
    store.startWriteStruct("pairs", cv2.FILE_NODE_SEQ)
    for name, (camera, rig_from_camera) in placed_cameras(calibration).items():
        camera_from_rig = rig_from_camera.inverse()
        store.startWriteStruct("", cv2.FILE_NODE_MAP)
        store.write("name", name)
        store.write("image_width", camera.width)
        store.write("image_height", camera.height)
        store.write("camera_matrix", camera.matrix)
        store.write("skew", camera.gamma)
        store.write("distortion_coefficients", camera.lens.opencv()[None])
        store.write("R", camera_from_rig.rotation)
        store.write("T", camera_from_rig.translation.reshape(3, 1))
        store.endWriteStruct()
    store.endWriteStruct()
    write_text(Path(path), store.releaseAndGetString())
    return Path(path)


def read_opencv_rig(path: Path) -> PlacedCameras:
    """Cameras and placings of a file that `write_opencv_rig` wrote.

    Raises BadInput if it is no such file, or has a lens that there is not here.
    """
    try:
        text = Path(path).read_text("utf-8")
        read = cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
        store = cv2.FileStorage(text, read)  # its nodes live only as long as it does
        pairs = store.getNode("pairs")
        found = [_camera_from_opencv(pairs.at(k)) for k in range(pairs.size())]
    except (OSError, ValueError, TypeError, AttributeError, SystemError, cv2.error) as error:
        raise BadInput(
            f"is not a rig as bodyscan writes it for OpenCV ({type(error).__name__}: {error})",
            where=str(path),
            remedy="write it again with `bodyscan export-rig --format opencv`",
        ) from error
    if not found:
        raise BadInput("holds no pairs", where=str(path), remedy="is it a file of export-rig?")
    return dict(found)


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


def _camera_from_opencv(node: Any) -> tuple[str, tuple[Camera, RigidTransform]]:
    matrix = node.getNode("camera_matrix").mat()
    lens = lens_from_opencv(np.ravel(node.getNode("distortion_coefficients").mat()))
    places = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
    alpha, beta, gamma, u0, v0 = (float(matrix[place]) for place in places)
    width, height = (int(node.getNode(f"image_{side}").real()) for side in ("width", "height"))
    camera = Camera(alpha, beta, gamma, u0, v0, lens, width, height)
    camera_from_rig = RigidTransform(node.getNode("R").mat(), np.ravel(node.getNode("T").mat()))
    return node.getNode("name").string(), (camera, camera_from_rig.inverse())


def _rigid3d(transform: RigidTransform) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(transform.matrix[:3])
