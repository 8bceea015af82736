"""Images read from disk, checked before and after decoding."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bodyscan.arrays import Bytes, whole_grey
from bodyscan.captures.folder import ImageSequence
from bodyscan.captures.grey_png import decode_grey_png
from bodyscan.captures.image_faults import header_fault, image_error
from bodyscan.captures.image_header import png_damage
from bodyscan.errors import ImageError
from bodyscan.progress import THREADS
from bodyscan.rig.pair import CameraSpec, Pair
from bodyscan.stripes.decoding import images_by_kind

SHOWS_NOTHING_BELOW = 8
"""Grey levels (sensor offset and noise): a lit image without a brighter pixel is black."""


@dataclass(frozen=True, eq=False)
class StripeImages:
    """The images of one stripe sequence, grey levels 0 to 255.

    lit, dark: (H, W) uint8, None where none was taken. coded: (F, H, W) uint8, the images
    of the code in the order of `FrameNames.of_code`.
    """

    pair: str
    shot: str
    lit: Bytes | None
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
    if lit:
        _refuse_black(image, path, pair, shot)
    return image


def read_board_image(sequence: ImageSequence, pair: Pair) -> Bytes:
    """The image of a sequence in which boards are looked for, (H, W) uint8: that of the board, the
    lit one, or where neither was taken, one made from the images of the code.

    Raises ImageError as `read_image`.
    """
    path = sequence.board or sequence.lit
    if path is not None or pair.projector is None:
        return _read(sequence, sequence.seen_in, pair.camera, shows=True)
    code, images = pair.projector, read_sequence(sequence, pair.camera)
    made = whole_grey(code.lit_from(images_by_kind(code, images.coded)[0]))
    _refuse_black(made, sequence.seen_in, sequence.pair, sequence.shot)
    return made


def read_sequence(
    sequence: ImageSequence, camera: CameraSpec, *, workers: int = THREADS
) -> StripeImages:
    """All images of a stripe sequence.

    Raises ImageError as `read_image`, and where the sequence is an image of the board alone.
    """
    if not sequence.has_stripes:
        raise ImageError(
            "is a lit image alone; there is no stripe sequence",
            where=f"{sequence.lit} (pair {sequence.pair}, shot {sequence.shot})",
            remedy="Take the stripes as well, or leave this pair out of this shot.",
        )
    coded = np.empty((len(sequence.coded), camera.height, camera.width), np.uint8)

    def read_into(place: int) -> None:
        coded[place] = _read(sequence, sequence.coded[place], camera)

    with ThreadPoolExecutor(workers) as pool:
        lit, dark = (
            pool.submit(_read, sequence, path, camera, shows=path == sequence.lit) if path else None
            for path in (sequence.lit, sequence.dark)
        )
        list(pool.map(read_into, range(len(coded))))
    lit_image, dark_image = (image.result() if image else None for image in (lit, dark))
    return StripeImages(sequence.pair, sequence.shot, lit_image, dark_image, coded)


def _read(sequence: ImageSequence, path: Path, camera: CameraSpec, *, shows: bool = False) -> Bytes:
    names = {"pair": sequence.pair, "shot": sequence.shot}
    return read_image(path, camera.width, camera.height, lit=shows, **names)


def _refuse_black(image: Bytes, path: Path, pair: str, shot: str) -> None:
    brightest = int(image.max())
    if brightest <= SHOWS_NOTHING_BELOW:
        raise image_error(
            f"shows nothing: its brightest pixel is {brightest} of 255",
            path,
            pair,
            shot,
            remedy="Check the exposure, the lens cap, and that the projector was on; then retake.",
        )
