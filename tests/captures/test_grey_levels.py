"""Files of every kind: what of them is read; and our reader of grey PNG files against OpenCV's."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.strategies._internal.core import DataObject
from small_captures import encoded, png, write

from bodyscan.captures.grey_png import decode_grey_png
from bodyscan.captures.images import convert_to_greys, find_full_scale, read_image
from bodyscan.errors import ImageError
from bodyscan.rig.pair import CameraSpec
from bodyscan.rig.templates import find_template_faults

CAMERA = CameraSpec(width=40, height=30)
NOISE = np.random.default_rng(5).integers(0, 256, (30, 40), dtype=np.uint8)
DEEP = np.random.default_rng(6).integers(0, 4096, (30, 40), dtype=np.uint16)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tif", ".tiff"])
def test_files_of_every_kind_give_the_same_image(tmp_path: Path, kind: str) -> None:
    found = read_image(write(tmp_path / f"x{kind}", encoded(NOISE, kind)), CAMERA)
    np.testing.assert_array_equal(found, NOISE)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tif", ".jpg"])
@pytest.mark.parametrize(("channel", "place"), [("blue", 0), ("green", 1), ("red", 2)])
def test_one_channel_of_a_colour_image_can_be_chosen(
    tmp_path: Path, kind: str, channel: str, place: int
) -> None:
    levels = np.array([40, 90, 200], np.uint8)
    colour = np.broadcast_to(levels, (30, 40, 3)).copy()
    camera = CameraSpec.model_validate({"width": 40, "height": 30, "channel": channel})
    found = read_image(write(tmp_path / f"x{kind}", encoded(colour, kind)), camera)
    assert np.abs(found.astype(int) - int(levels[place])).max() <= 2  # JPEG rounds
    with pytest.raises(ImageError, match=f"is grey, but the rig file says `channel: {channel}`"):
        read_image(write(tmp_path / f"y{kind}", encoded(NOISE, kind)), camera)


@pytest.mark.parametrize(
    ("numbers", "bits", "white"),
    [
        (DEEP, None, 4095),
        (DEEP, 12, 4095),
        (DEEP << 4, None, 65520),
        (DEEP << 4, 12, 65520),
        (DEEP // 4, None, 1023),
        (DEEP // 4, 12, 4095),  # dim, and said to be of 12 bits
        (DEEP * 4 + 1, None, 16383),
        (DEEP * 16 + (DEEP >> 8), None, 65535),  # scaled to 16 bits by a program
        (DEEP * 16 + (DEEP >> 8), 12, 65535),
        (DEEP % 256, 8, 255),
    ],
)
def test_no_bit_is_lost_wherever_it_is(numbers: np.ndarray, bits: int | None, white: int) -> None:
    assert find_full_scale([numbers], bits) == white
    grey = convert_to_greys(numbers, find_full_scale([numbers], bits))
    assert grey.dtype == np.float32
    np.testing.assert_allclose(grey, numbers * (255.0 / white), rtol=1e-6)
    assert len(np.unique(grey)) == len(np.unique(numbers))


@pytest.mark.parametrize("numbers", [DEEP, DEEP * 4 + 1])
def test_numbers_that_need_more_bits_than_stated_are_named(numbers: np.ndarray) -> None:
    message = f"numbers up to {numbers.max()}: above 1023 they do not fit the rig file's `bits: 10`"
    with pytest.raises(ImageError, match=message):
        find_full_scale([numbers], 10)


@pytest.mark.parametrize("kind", [".png", ".tif"])
def test_deep_files_are_read_to_the_last_bit(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / f"x{kind}", encoded(DEEP, kind))
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), DEEP)
    found = read_image(path, CAMERA)
    assert np.abs(found - DEEP * (255.0 / 4095.0)).max() <= 0.501


def test_eight_bits_in_sixteen_are_read_if_the_rig_file_says_so(tmp_path: Path) -> None:
    camera = CameraSpec(width=40, height=30, bits=8)
    for place, numbers in enumerate((NOISE.astype(np.uint16), NOISE.astype(np.uint16) << 8)):
        path = write(tmp_path / f"{place}.png", encoded(numbers))
        np.testing.assert_array_equal(read_image(path, camera), NOISE)
    with pytest.raises(ImageError, match="has 8 bits a sample, but the rig file says `bits: 12`"):
        read_image(
            write(tmp_path / "x.png", encoded(NOISE)), CAMERA.model_copy(update={"bits": 12})
        )


def test_a_video_is_named_with_the_command_that_unpacks_it() -> None:
    said = list(find_template_faults("{shot}/{pair}.mp4", many_pairs=False, needs_frame=False))
    assert len(said) == 1
    assert "ffmpeg -i VIDEO" in said[0]
    assert "'{shot}/{pair}/{frame}.png'" in said[0]


FILTERS = 5


def filtered(image: np.ndarray, kinds: list[int]) -> bytes:
    """Rows of an image, each behind its filter's number, as the standard (9.2) defines them."""
    wide = np.pad(image.astype(int), ((1, 0), (1, 0)))
    rows = []
    for v, kind in enumerate(kinds):
        here, left = wide[v + 1, 1:], wide[v + 1, :-1]
        above, corner = wide[v, 1:], wide[v, :-1]
        guess = left + above - corner
        off = np.abs(np.stack([guess - left, guess - above, guess - corner]))
        paeth = np.choose(off.argmin(axis=0), [left, above, corner])
        told = [0 * here, left, above, (left + above) // 2, paeth][kind]
        rows.append(bytes([kind]) + ((here - told) % 256).astype(np.uint8).tobytes())
    return b"".join(rows)


@given(st.data(), st.integers(1, 40), st.integers(1, 12), st.integers(1, 3), st.booleans())
def test_any_grey_image_in_any_filters_is_read(
    data: DataObject, width: int, height: int, parts: int, smooth: bool
) -> None:
    image = np.random.default_rng(width * height).integers(0, 256, (height, width), dtype=np.uint8)
    image = image // 64 + 100 if smooth else image
    kinds = data.draw(st.lists(st.integers(0, 4), min_size=height, max_size=height))
    file = png((width, height), zlib.compress(filtered(image, kinds)), parts=parts)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(file, np.uint8), 0), image)
    np.testing.assert_array_equal(decode_grey_png(file, width, height), image)
    for rows in (1, height, height + 1):
        np.testing.assert_array_equal(decode_grey_png(file, width, height, rows), image[:rows])


@pytest.mark.parametrize("level", range(10))
def test_what_opencv_writes_is_read(level: int) -> None:
    image = np.random.default_rng(level).normal(90, 20, (50, 70)).clip(0, 255).astype(np.uint8)
    file = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, level])[1].tobytes()
    np.testing.assert_array_equal(decode_grey_png(file, 70, 50), image)


def test_all_else_is_left_to_opencv() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    rows = filtered(image, [0, 1, 2])
    whole = zlib.compress(rows)
    assert decode_grey_png(png((4, 3), whole), 4, 3) is not None
    assert decode_grey_png(png((4, 3), whole), 3, 4) is None
    for kind in ((16, 0, 0), (8, 2, 0), (8, 3, 0), (8, 4, 0), (8, 0, 1), (4, 0, 0)):
        assert decode_grey_png(png((4, 3), whole, kind=kind), 4, 3) is None
    spoilt = whole[:-1] + bytes([whole[-1] ^ 1])
    for packed in (b"", b"no deflate stream", zlib.compress(rows[:-1]), spoilt):
        assert decode_grey_png(png((4, 3), packed), 4, 3) is None
    unknown = zlib.compress(rows[:5] + bytes([FILTERS]) + rows[6:])
    assert decode_grey_png(png((4, 3), unknown), 4, 3) is None


def test_a_file_that_holds_far_more_than_its_image_is_inflated_no_further() -> None:
    image = np.zeros((3, 4), np.uint8)
    bomb = zlib.compress(filtered(image, [0, 0, 0]) + bytes(10_000_000))
    found = decode_grey_png(png((4, 3), bomb), 4, 3)
    np.testing.assert_array_equal(found, image)
