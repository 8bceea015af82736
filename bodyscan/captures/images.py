"""Images read from disk, checked before and after decoding."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bodyscan.arrays import Bytes
from bodyscan.captures.folder import ImageSequence
from bodyscan.captures.grey_png import decode_grey_png
from bodyscan.captures.image_faults import header_fault, image_error
from bodyscan.captures.image_header import png_damage
from bodyscan.errors import ImageError
from bodyscan.progress import THREADS
from bodyscan.rig.pair import CameraSpec

SHOWS_NOTHING_BELOW = 8
"""Grey levels (sensor offset and noise): a lit image without a brighter pixel is black."""


@dataclass(frozen=True, eq=False)
class StripeImages:
    """The images of one stripe sequence, grey levels 0 to 255.

    lit, dark: (H, W) uint8; dark is None where none was taken. coded: (F, H, W) uint8, the images
    of the code in the order of `FrameNames.of_code`.
    """

    pair: str
    shot: str
    lit: Bytes
    dark: Bytes | None
    coded: Bytes


def read_image(
    path: Path, width: int, height: int, *, pair: str = "", shot: str = "", lit: bool = False
) -> Bytes:
    """One image as grey levels, (height, width) uint8; colour is turned to grey (luma).

    The size is compared with the header before anything is decoded. 16-bit images are refused: how
    many of their bits a camera fills is not written in them, and a wrong guess gives black images.
    A turn noted in EXIF is not applied, since it would swap the camera's axes. `lit`: the image
    should show something. Raises ImageError: missing, no image, of the wrong size or depth, cut
    short, damaged, or (lit) black.
    """
    fault = header_fault(path, width, height)
    if fault:
        raise image_error(fault, path, pair, shot)
    data = path.read_bytes()
    is_png = data.startswith(b"\x89PNG")
    damage = png_damage(data) if is_png else None
    if damage:
        raise image_error(damage, path, pair, shot)
    image = decode_grey_png(data, width, height) if is_png else None
    if image is None:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None or image.shape != (height, width) or image.dtype != np.uint8:
        raise image_error("cannot be decoded", path, pair, shot)
    brightest = int(image.max()) if lit else 255
    if brightest <= SHOWS_NOTHING_BELOW:
        raise image_error(
            f"shows nothing: its brightest pixel is {brightest} of 255",
            path,
            pair,
            shot,
            remedy="Check the exposure, the lens cap, and that the projector was on; then retake.",
        )
    return image


def read_lit(sequence: ImageSequence, camera: CameraSpec) -> Bytes:
    """The lit image of a sequence, (H, W) uint8. Raises ImageError as `read_image`."""
    return read_image(
        sequence.lit, camera.width, camera.height, pair=sequence.pair, shot=sequence.shot, lit=True
    )


def read_sequence(
    sequence: ImageSequence, camera: CameraSpec, *, workers: int = THREADS
) -> StripeImages:
    """All images of a stripe sequence.

    Raises ImageError as `read_image`, and where the sequence is a lit image alone.
    """
    if not sequence.has_stripes:
        raise ImageError(
            "is a lit image alone; there is no stripe sequence",
            where=f"{sequence.lit} (pair {sequence.pair}, shot {sequence.shot})",
            remedy="Take the stripes as well, or leave this pair out of this shot.",
        )

    def read(path: Path) -> Bytes:
        names = {"pair": sequence.pair, "shot": sequence.shot}
        return read_image(path, camera.width, camera.height, lit=path == sequence.lit, **names)

    coded = np.empty((len(sequence.coded), camera.height, camera.width), np.uint8)

    def read_into(place: int) -> None:
        coded[place] = read(sequence.coded[place])

    with ThreadPoolExecutor(workers) as pool:
        lit = pool.submit(read, sequence.lit)
        dark = pool.submit(read, sequence.dark) if sequence.dark else None
        list(pool.map(read_into, range(len(coded))))
    dark_image = dark.result() if dark else None
    return StripeImages(sequence.pair, sequence.shot, lit.result(), dark_image, coded)
