"""Images read from disk, checked before and after decoding.

Also what their numbers mean as grey levels, 0 to 255, and several exposures merged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial, reduce
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import WHOLE, Array, Bytes, Crop, Floats, Greys, round_to_grey
from bodyscan.captures.folder import ImageSequence
from bodyscan.captures.grey_png import decode_grey_png, find_png_damage
from bodyscan.captures.image_header import (
    find_header_fault,
    make_image_error,
    make_missing_error,
    read_header,
    store_upright,
)
from bodyscan.errors import ImageError
from bodyscan.files.reading import read_regular
from bodyscan.geometry.robust import SIGMAS_PER_MEDIAN
from bodyscan.progress import THREADS, map_threads
from bodyscan.rig.pair import CameraSpec, Pair
from bodyscan.stripes.decoding import split_by_kind
from bodyscan.stripes.usable_pixels import SATURATED

Raw = NDArray[np.uint8] | NDArray[np.uint16]


@dataclass(frozen=True, eq=False)
class StripeImages:
    """The images of one stripe sequence, grey levels 0 to 255.

    All uint8, or float32 if files or exposures resolve more.
    """

    # lit, dark: (H, W), None if not taken.
    lit: Greys | None
    dark: Greys | None
    coded: Greys  # (F, H, W), the code's images in the order of `FrameNames.code_names`


def read_image(
    path: Path, camera: CameraSpec, *, pair: str = "", shot: str = "", lit: bool = False
) -> Bytes:
    """Read one image as whole grey levels, (height, width) uint8.

    lit: the image should show something, and is refused if it is black.

    Raises ImageError as `_read_raw` and `find_full_scale`.
    """
    where = ", ".join(f"{kind} {name}" for kind, name in (("pair", pair), ("shot", shot)) if name)
    raw = _read_raw(path, camera, where)
    image = round_to_grey(convert_to_greys(raw, _find_scale([raw], camera, path, where)))
    if lit:
        _refuse_blank(image, path, where)
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
    made = round_to_grey(code.lit_from(split_by_kind(code, images.coded)[0]))
    _refuse_blank(made, sequence.board_path, sequence.where)
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
        _refuse_blank(round_to_grey(lit), sequence.lit, sequence.where)
    coded = whole[len(whole) - len(sequence.coded) :]
    return StripeImages(lit, dark, coded)


def read_colours(sequence: ImageSequence, camera: CameraSpec) -> Bytes | None:
    """Read the lit image of a colour camera, (H, W, 3) uint8, red, green, blue; of several exposures
    the shortest. Where none was taken it is made from patterns and their inverses.

    None if there are neither, if images are grey (files of three equal channels too), and for a
    projector of one colour: where the rig file names a channel, and another has less than a quarter
    of its light (filters let through up to a fifth), the image shows the projector's colour and not
    the subject's.

    Raises ImageError as `read_image`.
    """
    paths = [sequence.lit] if sequence.lit else _list_complements(sequence.without_crossing)
    if not paths or not read_header(paths[0]).colour:
        return None
    images = []
    for path in paths:
        found = _decode(_read_file(path, camera, sequence.where), cv2.IMREAD_COLOR_RGB)
        if found is None or found.shape != (camera.height, camera.width, 3):
            raise make_image_error("cannot be decoded", path, sequence.where)
        images.append(found)
    path, raw = paths[0], np.max(images, axis=0)
    # The lit image is the brightest of its sequence, so that it shows the scale by itself.
    colours = round_to_grey(convert_to_greys(raw, _find_scale([raw], camera, path, sequence.where)))
    if (colours == colours[..., :1]).all():
        return None
    if camera.channel_number is not None:
        light = colours[..., camera.channel_number]
        levels = np.median(colours[light > light.mean()], axis=0)
        if levels.min() < 0.25 * levels[camera.channel_number]:
            return None
    return colours


def _list_complements(sequence: ImageSequence) -> list[Path]:
    """Two patterns and their inverses, in one of which each pixel is lit: edges of two bits of a Gray
    code do not coincide. Empty if no inverses were taken."""
    patterns = [path for path in sequence.coded if path not in sequence.inverses]
    return [*patterns[:2], *sequence.inverses[:2]] if sequence.inverses else []


def _read_stack(sequence: ImageSequence, camera: CameraSpec, crop: Crop, workers: int) -> Greys:
    """Read grey levels (F, H, W) of one exposure: lit, dark if they exist, then the code's."""
    taken = [path for path in (sequence.lit, sequence.dark) if path is not None]
    paths = (*taken, *sequence.coded)
    missing = [path for path in paths if path in sequence.missing]
    if missing:
        raise make_missing_error(missing, sequence.inverses, sequence.where)
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
            raise make_image_error(what, paths[k], sequence.where)
        stack[k] = image[early]

    map_threads(read_into, range(1, len(paths)), workers=workers)
    scale = _find_scale(list(stack), camera, paths[0], sequence.where)
    return convert_to_greys(np.ascontiguousarray(stack[(slice(None), *late)]), scale)


def _find_scale(images: list[Raw], camera: CameraSpec, path: Path, where: str) -> float:
    """Call `find_full_scale` so that its errors name the file."""
    try:
        return find_full_scale(images, camera.bits)
    except ImageError as error:
        raise make_image_error(error.what, path, where, remedy=error.remedy) from None


def _read_raw(path: Path, camera: CameraSpec, where: str, rows: int | None = None) -> Raw:
    """Read the numbers in an image file, (height, width) uint8 or uint16.

    Only the first `rows` rows need be read; of a colour image the camera's channel, where grey is luma.
    The size is checked in the header before anything is decoded. A rotation noted in EXIF or TIFF is
    not applied: it would swap the camera's axes. Raises ImageError for a file that is missing, no
    image, of the wrong size or depth, cut short, damaged, or without the channel.
    """
    width, height = camera.width, camera.height
    data = _read_file(path, camera, where)
    image = decode_grey_png(data, width, height, rows)
    channel = camera.channel_number
    if image is not None and channel is None:
        return image
    found = _decode(data, cv2.IMREAD_GRAYSCALE if channel is None else cv2.IMREAD_ANYCOLOR)
    if found is None or found.shape[:2] != (height, width):
        raise make_image_error("cannot be decoded", path, where)
    if channel is not None and found.ndim == 3:
        found = found[:, :, 2 - channel]  # OpenCV's order is blue, green, red
    elif channel is not None:
        what = f"is grey, but the rig file says `channel: {camera.channel}`"
        raise make_image_error(what, path, where, remedy="Leave `channel` out for this camera.")
    return cast(Raw, np.ascontiguousarray(found))


def _read_file(path: Path, camera: CameraSpec, where: str) -> bytes:
    """Read a file whose header, and if it is a PNG whose checksums, are sound."""
    fault = find_header_fault(path, camera.width, camera.height)
    data = b"" if fault else read_regular(path)
    fault = fault or (find_png_damage(data) if data.startswith(b"\x89PNG") else None)
    if fault:
        raise make_image_error(fault, path, where)
    return data


def _decode(data: bytes, colour: int) -> Raw | None:
    """Decode an image file by OpenCV, as stored, with its flag `colour`; None if it cannot."""
    data = store_upright(data) if data[:2] in (b"II", b"MM") else data
    flags = colour | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    found = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    return found if found is not None and found.dtype in (np.uint8, np.uint16) else None


def measure_mosaic(image: Bytes) -> float:
    """Measure by what share the four pixels of 2 x 2 differ over the whole image (H, W): some tenths
    in a raw Bayer image."""
    means = [image[row::2, column::2].mean() for row in (0, 1) for column in (0, 1)]
    return float(np.ptp(means) / max(np.mean(means), 1.0))


def _refuse_blank(image: Bytes, path: Path, where: str) -> None:
    brightest = int(image.max())
    if brightest <= 8:  # the sensor's offset and noise
        what = f"shows nothing: its brightest pixel is {brightest} of 255"
        remedy = "Check the exposure, the lens cap, and that the projector was on; then retake."
        raise make_image_error(what, path, where, remedy=remedy)
    darkest = int(image.min())
    if darkest >= SATURATED:
        what = f"shows nothing but white: its darkest pixel is {darkest} of 255"
        remedy = "Shorten the exposure, close the iris or dim the projector; then retake."
        raise make_image_error(what, path, where, remedy=remedy)


def find_full_scale(images: Sequence[Raw], bits: int | None) -> float:
    """Find the number that stands for white in one sequence's images; 255 for 8-bit files.

    A file with 16 bits per sample holds what the camera measured: 16 bits, or 10, 12 or 14 at the
    low or the high end of the number. No file says which; the numbers of a whole sequence do.

    bits: how many the camera measures; None: judged by the numbers, so that a dim sequence may be
        taken for one of fewer bits, which changes only its unit of brightness.

    Raises ImageError for 16-bit files that hold only 8 bits, unless `bits` says so, for 8-bit files
    if `bits` says more, and for numbers at the low end that need more bits than `bits`.
    """
    if images[0].dtype == np.uint8:
        if bits is not None and bits > 8:
            raise ImageError(
                f"has 8 bits a sample, but the rig file says `bits: {bits}`",
                remedy=f"Let the camera's software save files of 16 bits, with {bits} in them, or "
                "leave `bits` out.",
            )
        return 255.0
    # About a million numbers of each: 8 bits in 16 show within the first thousand.
    values = [image.ravel()[:: max(1, image.size >> 20)].astype(np.uint16) for image in images]
    largest = max(int(value.max()) for value in values)
    used = reduce(int.__or__, (int(np.bitwise_or.reduce(value)) for value in values))
    if bits is None:
        _refuse_eight_bits(values, largest, used)
        counts = (10, 12, 14, 16)
        low = next(count for count in counts if largest < 1 << count)
        high = next(count for count in counts if used & ((1 << (16 - count)) - 1) == 0)
        bits = low if low < 16 else high
    spare = 16 - bits
    if largest < 1 << bits:
        return float((1 << bits) - 1)
    low_end_is_empty = used & ((1 << spare) - 1) == 0
    # A program that scales to 16 bits repeats the highest ones at the low end.
    scaled = all(np.array_equal(v & ((1 << spare) - 1), v >> bits) for v in values)
    if largest < 1 << 14 and not low_end_is_empty and not scaled:
        needed = 12 if largest < 1 << 12 else 14
        raise ImageError(
            f"holds numbers up to {largest}: above {(1 << bits) - 1} they do not fit the rig file's "
            f"`bits: {bits}`",
            remedy=f"Write `bits: {needed}` below `camera` in the rig file, or leave `bits` out.",
        )
    return float(65536 - (1 << spare)) if low_end_is_empty else 65535.0


def convert_to_greys(image: Raw, scale: float) -> Greys:
    """Scale to grey levels 0 to 255, float32, so that `scale` is white; keep 8-bit images."""
    if image.dtype == np.uint8:
        return image.astype(np.uint8, copy=False)
    return np.minimum(image * np.float32(255.0 / scale), np.float32(255.0))


def _refuse_eight_bits(values: Sequence[NDArray[np.uint16]], largest: int, used: int) -> None:
    found = ""
    if largest < 256:
        found = f"none of their numbers is above {largest}"
    elif used & 0xFF == 0:
        found = "all their numbers are multiples of 256"
    elif all(np.array_equal(value >> 8, value & 0xFF) for value in values):
        found = "all their numbers are multiples of 257"
    if found:
        raise ImageError(
            f"the files have 16 bits a sample, but 8 bits in them ({found})",
            remedy="Let the camera's software save all bits that the camera has (Mono12, Mono16); if "
            "8 are all it has, write `bits: 8` below `camera` in the rig file.",
        )


def merge_exposures(stacks: Sequence[Greys], names: Sequence[str], where: str) -> Floats:
    """Merge exposures into images (F, H, W) float32, in grey levels of the shortest.

    A pixel that is not too bright in a longer exposure is less noisy there. Each image of a longer
    exposure is brought to the unit of the shortest, short = a + b long, where a and b are found
    from the images, and averaged with it. Near white an exposure's weight falls gradually, so that
    there is no seam. Source: Debevec and Malik, Recovering high dynamic range radiance maps (1997),
    for a linear camera.

    stacks: (F, H, W) grey levels of each exposure, the shortest first, images in equal order.
    names: of the exposures.

    Raises ImageError for exposures that are out of order or cannot be compared.
    """
    lines = [(0.0, 1.0)]
    for k in range(1, len(stacks)):
        offset, slope = _fit_exposures(stacks[k - 1], stacks[k], names[k - 1 : k + 1], where)
        start, unit = lines[-1]
        lines.append((start + unit * offset, unit * slope))
    merged = np.empty(stacks[0].shape, np.float32)
    for number, (shortest, *longer) in enumerate(zip(*stacks, strict=True)):
        total = shortest.astype(np.float32)
        weights = np.ones_like(total)
        for image, (offset, slope) in zip(longer, lines[1:], strict=True):
            level = image.astype(np.float32)
            # The sensor's noise shrinks with the unit: the weight is its inverse variance. Sensors
            # become non-linear below white: from 215 to 245 it falls to zero.
            weight = np.clip((245.0 - level) / 30.0, 0.0, 1.0) / np.float32(slope * slope)
            total += weight * (np.float32(offset) + np.float32(slope) * level)
            weights += weight
        merged[number] = np.clip(total / weights, 0.0, 255.0)
    return merged


def _fit_exposures(
    shorter: Greys, longer: Greys, names: Sequence[str], where: str
) -> tuple[float, float]:
    """Fit offset and slope in shorter = offset + slope * longer to pixels neither black nor white."""
    step = max(1, shorter.size // 1_600_000)
    one, other = (stack.reshape(-1)[::step].astype(float) for stack in (shorter, longer))
    brighter = np.maximum(one, other)
    usable = (brighter > 12.0) & (brighter < 215.0)
    if np.count_nonzero(usable) < 1000:
        raise ImageError(
            f"exposures {names[0]} and {names[1]} cannot be compared: hardly a pixel is neither black "
            "nor white in both",
            where=where,
            remedy="Choose exposures that are closer to each other: 2 to 8 times.",
        )
    offset, slope = _fit_line(other[usable], one[usable])
    if slope > 1.0 / 0.95:  # darker than the shorter one by more than rounding
        raise ImageError(
            f"exposure {names[1]} is {1.0 / slope:.2g} times as bright as {names[0]}, which is listed"
            " as the shorter one",
            where=where,
            remedy=f"Name the shortest first: `exposures: [{names[1]}, {names[0]}]`.",
        )
    return offset, slope


def _fit_line(x: Array, y: Array) -> tuple[float, float]:
    """Fit offset and slope of y against x, without residuals beyond 4 sigma."""
    inliers = np.ones(len(x), bool)
    slope, offset = 1.0, 0.0
    for _ in range(4):
        slope, offset = np.polyfit(x[inliers], y[inliers], 1)
        residual = np.abs(y - offset - slope * x)
        inliers = residual <= 4.0 * SIGMAS_PER_MEDIAN * max(float(np.median(residual)), 0.1)
    return float(offset), float(slope)
