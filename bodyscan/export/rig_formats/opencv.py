"""A YAML file of cameras as OpenCV reads it.

OpenCV's camera functions know no skew, so the file says what to do about it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bodyscan.errors import BadInput
from bodyscan.export.rig_format import RigCameras, RigFormat, cameras_of
from bodyscan.files.atomic import write_text
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.lenses import lens_from_opencv
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.registration.rig_calibration import RigCalibration

NOTE = (
    "Lengths in mm. x_camera = R x_rig + T. Pixel centres at whole numbers. camera_matrix holds the "
    "skew, but OpenCV's functions ignore it: use it with pixels sheared to "
    "u - skew / fy * (v - cy), v, which a camera without skew would have seen."
)


def write_opencv_rig(calibration: RigCalibration, path: Path) -> Path:
    """A sequence `pairs` as cv2.FileStorage reads it: name, image size, camera_matrix (with its
    skew), distortion_coefficients (OpenCV's, in its order), R and T of `camera_from_rig`.

    Returns `path`.  Raises BadInput for a lens that OpenCV does not have.
    """
    memory = cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY | cv2.FILE_STORAGE_FORMAT_YAML
    store = cv2.FileStorage("rig.yaml", memory)
    store.writeComment(NOTE, False)
    store.startWriteStruct("pairs", cv2.FILE_NODE_SEQ)
    for name, (camera, rig_from_camera) in cameras_of(calibration).items():
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


def read_opencv_rig(path: Path) -> RigCameras:
    """Cameras and poses of a file that `write_opencv_rig` wrote.

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


def _camera_from_opencv(node: Any) -> tuple[str, tuple[Camera, RigidTransform]]:
    matrix = node.getNode("camera_matrix").mat()
    lens = lens_from_opencv(np.ravel(node.getNode("distortion_coefficients").mat()))
    places = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))
    alpha, beta, gamma, u0, v0 = (float(matrix[place]) for place in places)
    width, height = (int(node.getNode(f"image_{side}").real()) for side in ("width", "height"))
    camera = Camera(alpha, beta, gamma, u0, v0, lens, width, height)
    camera_from_rig = RigidTransform(node.getNode("R").mat(), np.ravel(node.getNode("T").mat()))
    return node.getNode("name").string(), (camera, camera_from_rig.inverse())


FORMAT = RigFormat("rig-opencv.yaml", write_opencv_rig, read_opencv_rig)
