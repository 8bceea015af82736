"""Images read from disk, checked before and after decoding."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from bodyscan.arrays import WHOLE, Bytes, Crop, Greys, whole_grey
from bodyscan.captures.folder import ImageSequence
from bodyscan.captures.grey_levels import Raw, convert_to_greys, find_full_scale, merge_exposures
from bodyscan.captures.grey_png import decode_grey_png, png_damage
from bodyscan.captures.image_header import find_header_fault, image_error, missing_error
from bodyscan.errors import ImageError
from bodyscan.files.reading import read_regular
from bodyscan.progress import THREADS
from bodyscan.rig.pair import CameraSpec, Pair
from bodyscan.stripes.decoding import images_by_kind


@dataclass(frozen=True, eq=False)
class StripeImages:
    """The images of one stripe sequence, grey levels 0 to 255.

    lit, dark: (H, W), None if not taken.
    coded: (F, H, W), the code's images in the order of `FrameNames.code_names`.

    All uint8, or float32 if files or exposures resolve more.
    """

    pair: str
    shot: str
    lit: Greys | None
    dark: Greys | None
    coded: Greys


def read_image(
    path: Path, camera: CameraSpec, *, pair: str = "", shot: str = "", lit: bool = False
) -> Bytes:
    """Read one image as whole grey levels, (height, width) uint8.

    lit: the image should show something, and is refused if it is black.

    Raises ImageError as `_read_raw` and `find_full_scale`.
    """
    where = ", ".join(f"{kind} {name}" for kind, name in (("pair", pair), ("shot", shot)) if name)
    raw = _read_raw(path, camera, where)
    image = whole_grey(convert_to_greys(raw, _find_scale([raw], camera, path, where)))
    if lit:
        _refuse_black(image, path, where)
    return image


def read_board_image(sequence: ImageSequence, pair: Pair) -> Bytes:
    """Read the image in which boards are detected, (H, W) uint8.

    This is the board image, the lit one, or if neither was taken one made from the code's images.
    Of several exposures it is the shortest. Raises ImageError as `read_image`.
    """
    path = sequence.board or sequence.lit
    if path is not None or pair.projector is None:
        path, shot = sequence.board_path, sequence.shot
        return read_image(path, pair.camera, pair=pair.name, shot=shot, lit=True)
    code = pair.projector.model_copy(update={"crossing": None})
    images = read_sequence(sequence.without_crossing, pair.camera)
    made = whole_grey(code.lit_from(images_by_kind(code, images.coded)[0]))
    _refuse_black(made, sequence.board_path, sequence.where)
    return made


def read_sequence(
    sequence: ImageSequence, camera: CameraSpec, *, crop: Crop = WHOLE, workers: int = THREADS
) -> StripeImages:
    """Read all images of a stripe sequence, cut to `crop`; several exposures are merged.

    Raises ImageError as `read_image`, if exposures are out of order, and if the sequence is a board
    image alone.
    """
    if not sequence.has_stripes:
        raise ImageError(
            "is a lit image alone; there is no stripe sequence",
            where=f"{sequence.lit} ({sequence.where})",
            remedy="Take the stripes as well, or leave this pair out of this shot.",
        )
    exposures = (sequence, *sequence.longer)
    stacks = [_read_stack(exposure, camera, crop, workers) for exposure in exposures]
    names = [exposure.exposure for exposure in exposures]
    whole = stacks[0] if len(stacks) == 1 else merge_exposures(stacks, names, sequence.where)
    singles = iter(whole)
    lit, dark = (next(singles) if path else None for path in (sequence.lit, sequence.dark))
    if lit is not None and sequence.lit is not None:
        _refuse_black(whole_grey(lit), sequence.lit, sequence.where)
    coded = whole[len(whole) - len(sequence.coded) :]
    return StripeImages(sequence.pair, sequence.shot, lit, dark, coded)


def _read_stack(sequence: ImageSequence, camera: CameraSpec, crop: Crop, workers: int) -> Greys:
    """Read grey levels (F, H, W) of one exposure: lit, dark if they exist, then the code's."""
    taken = [path for path in (sequence.lit, sequence.dark) if path is not None]
    paths = (*taken, *sequence.coded)
    missing = [path for path in paths if path in sequence.missing]
    if missing:
        raise missing_error(missing, sequence.inverses, sequence.where)
    read = partial(_read_raw, camera=camera, where=sequence.where, rows=crop[0].stop)
    first = read(paths[0])
    # In 16-bit files white is found from all numbers, so these are cropped afterwards.
    early, late = (crop, WHOLE) if first.dtype == np.uint8 else (WHOLE, crop)
    stack = np.empty((len(paths), *first[early].shape), first.dtype)
    stack[0] = first[early]

    def read_into(k: int) -> None:
        image = read(paths[k])
        if image.dtype != first.dtype:
            bits, others = 8 * image.itemsize, 8 * first.itemsize
            what = f"has {bits} bits a sample, but {paths[0].name} has {others}"
            raise image_error(what, paths[k], sequence.where)
        stack[k] = image[early]

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(read_into, range(1, len(paths))))
    scale = _find_scale(list(stack), camera, paths[0], sequence.where)
    return convert_to_greys(np.ascontiguousarray(stack[(slice(None), *late)]), scale)


def _find_scale(images: list[Raw], camera: CameraSpec, path: Path, where: str) -> float:
    """Call `find_full_scale` so that its errors name the file."""
    try:
        return find_full_scale(images, camera.bits)
    except ImageError as error:
        raise image_error(error.what, path, where, remedy=error.remedy) from None


def _read_raw(path: Path, camera: CameraSpec, where: str, rows: int | None = None) -> Raw:
    """Read the numbers in an image file, (height, width) uint8 or uint16.

    Of a colour image those of the camera's channel are read, where grey is luma.

    rows: only so many rows, from the first, need be read.

    The size is checked in the header before anything is decoded. A rotation noted in EXIF is not
    applied, since it would swap the camera's axes. Raises ImageError for a file that is missing, no
    image, of the wrong size or depth, cut short, damaged, or without the channel.
    """
    width, height = camera.width, camera.height
    fault = find_header_fault(path, width, height)
    data = b"" if fault else read_regular(path)
    is_png = data.startswith(b"\x89PNG")
    fault = fault or (png_damage(data) if is_png else None)
    if fault:
        raise image_error(fault, path, where)
    image = decode_grey_png(data, width, height, rows) if is_png else None
    if image is not None and camera.channel == "grey":
        return image
    found = _decode(data, camera.channel)
    if found is None or found.shape[:2] != (height, width):
        raise image_error("cannot be decoded", path, where)
    if found.ndim == 3:
        found = found[:, :, ("blue", "green", "red").index(camera.channel)]
    elif camera.channel != "grey":
        what = f"is grey, but the rig file says `channel: {camera.channel}`"
        raise image_error(what, path, where, remedy="Leave `channel` out for this camera.")
    return cast(Raw, np.ascontiguousarray(found))


def _decode(data: bytes, channel: str) -> Raw | None:
    """Decode to (H, W) if image or channel is grey, else (H, W, 3); None if it is not decodable."""
    colour = cv2.IMREAD_GRAYSCALE if channel == "grey" else cv2.IMREAD_ANYCOLOR
    flags = colour | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None or image.dtype not in (np.uint8, np.uint16):
        return None
    return cast(Raw, image)


def _refuse_black(image: Bytes, path: Path, where: str) -> None:
    brightest = int(image.max())
    if brightest <= 8:  # the sensor's offset and noise
        what = f"shows nothing: its brightest pixel is {brightest} of 255"
        remedy = "Check the exposure, the lens cap, and that the projector was on; then retake."
        raise image_error(what, path, where, remedy=remedy)
