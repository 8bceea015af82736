"""Our reader of grey PNG files against OpenCV's, and against files that it should leave alone."""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.strategies._internal.core import DataObject

from bodyscan.captures.grey_png import decode_grey_png

FILTERS = 5


def chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)


def png(
    size: tuple[int, int], packed: bytes, *, parts: int = 1, kind: tuple[int, ...] = (8, 0, 0)
) -> bytes:
    """A PNG file of width and height; kind: bits, colour type, interlace."""
    bits, colour, interlace = kind
    header = struct.pack(">IIBBBBB", *size, bits, colour, 0, 0, interlace)
    cuts = np.linspace(0, len(packed), parts + 1).astype(int)
    data = b"".join(chunk(b"IDAT", packed[start:end]) for start, end in pairwise(cuts))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


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
