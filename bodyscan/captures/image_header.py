"""What the first bytes of an image file say, and whether the file is complete.

A wrong image is thus refused before it is decoded: an image of 60000 x 60000 pixels fits into a few
kilobytes of file and fills the memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from isal import isal_zlib

from bodyscan.files.regular import open_regular

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_JPEG = b"\xff\xd8\xff"
_JPEG_END = b"\xff\xd9"
_BMP = b"BM"
_TIFF = (b"II*\0", b"MM\0*")
_MOST_TAGS, _MOST_STRIPS = 1000, 1 << 20
_LOCKED, _MANY = 5120, 16  # bytes summed without releasing the lock; pieces worth holding it
_TAIL = 65536  # some writers add a few bytes after the end


@dataclass(frozen=True)
class ImageHeader:
    """Width and height in pixels, bits per sample, and whether the end of the image is there.

    rounded: RMS error of JPEG's rounding, in grey levels, for an image with sharp edges everywhere,
        such as stripes.
    """

    width: int
    height: int
    bits: int
    complete: bool
    rounded: float = 0.0


class NoImage(Exception):
    """Raised for what is not the start of a PNG, JPEG, BMP or TIFF file; says why."""


def read_header(path: Path) -> ImageHeader:
    """Read the header of an image file.

    Raises NoImage if `path` is not of a known kind, BadInput if it is not a regular file, OSError
    if it cannot be read.
    """
    with open_regular(path) as stream:
        start = stream.read(33)
        if not start:
            raise NoImage("is an empty file")
        if start.startswith(_PNG):
            width, height, bits = _png_header(start)
            return ImageHeader(width, height, bits, _ends_with(stream, 33, _PNG_END))
        if start.startswith(_JPEG):
            width, height, bits, rounded, end = _jpeg_header(stream)
            return ImageHeader(width, height, bits, _ends_with(stream, end, _JPEG_END), rounded)
        if start.startswith(_BMP):
            return _bmp_header(start, stream.seek(0, 2))
        if start.startswith(_TIFF):
            return _tiff_header(stream)
    raise NoImage("is no PNG, JPEG, BMP or TIFF image")


def png_damage(data: bytes) -> str | None:
    """What is wrong with the chunks of a whole PNG file (ends early, wrong checksum), or None.

    libpng decodes such a file as far as it gets and leaves the rest of the image as it is.
    """
    try:
        sound = all(
            _checksum(content, isal_zlib.crc32(kind)) == checksum
            for kind, content, checksum in png_chunks(data)
        )
    except NoImage as error:
        return str(error)
    return None if sound else "is damaged (a checksum is wrong)"


def _checksum(content: memoryview, before: int) -> int:
    """CRC-32 of a chunk, continued from `before`.

    Chunks are a few kilobytes, whose sum takes a microsecond. From _LOCKED bytes on ISA-L releases
    the interpreter's lock for it, and getting it back from another thread takes many times as long.
    """
    if len(content) > _MANY * _LOCKED:
        return isal_zlib.crc32(content, before)
    for first in range(0, len(content), _LOCKED):
        before = isal_zlib.crc32(content[first : first + _LOCKED], before)
    return before


def png_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview, int]]:
    """Kind, content and checksum of every chunk of a whole PNG file. Raises NoImage if the file
    ends before its last chunk does."""
    place, kind = len(_PNG), b""
    while kind != b"IEND":
        if place + 12 > len(data):
            raise NoImage("is cut short")
        length, kind = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        if end + 4 > len(data):
            raise NoImage("is cut short")
        (checksum,) = struct.unpack_from(">I", data, end)
        yield kind, memoryview(data)[place + 8 : end], checksum
        place = end + 4


def _png_header(start: bytes) -> tuple[int, int, int]:
    if len(start) < 33:
        raise NoImage("is cut short")
    length, kind, width, height, bits = struct.unpack_from(">I4sIIB", start, 8)
    (checksum,) = struct.unpack_from(">I", start, 29)
    if (length, kind) != (13, b"IHDR") or zlib.crc32(start[12:29]) != checksum:
        raise NoImage("is damaged (its PNG header is wrong)")
    return width, height, bits


def _jpeg_header(stream: BinaryIO) -> tuple[int, int, int, float, int]:
    """Width, height, bits, rounding error, and where the frame header ends. Source: ITU-T T.81,
    Annex B."""
    rounded = 0.0
    stream.seek(2)
    while True:
        marker = stream.read(2)
        while marker == b"\xff\xff":  # fill bytes
            marker = b"\xff" + stream.read(1)
        if len(marker) < 2:
            raise NoImage("is cut short")
        if marker[0] != 0xFF or marker[1] in (0x00, 0xD9, 0xDA):
            raise NoImage("is damaged (its JPEG header is wrong)")
        if marker[1] == 0x01 or 0xD0 <= marker[1] <= 0xD8:
            continue  # markers without content
        content = stream.read(2)
        if len(content) < 2:
            raise NoImage("is cut short")
        (length,) = struct.unpack(">H", content)
        if length < 2:
            raise NoImage("is damaged (its JPEG header is wrong)")
        if 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):
            frame = stream.read(5)
            if len(frame) < 5:
                raise NoImage("is cut short")
            bits, height, width = struct.unpack(">BHH", frame)
            return width, height, bits, rounded, stream.tell()
        if marker[1] == 0xDB:
            rounded = max(rounded, _rounding(stream.read(length - 2)))
        else:
            stream.seek(length - 2, 1)


def _rounding(tables: bytes) -> float:
    """RMS rounding error of the first table, that of brightness; 0.0 if it is not among these.

    A coefficient rounded to multiples of q errs by q / sqrt(12); the transform preserves squares.
    """
    while len(tables) > 64:
        wide, which = divmod(tables[0], 16)
        steps = tables[1 : 65 + 64 * bool(wide)]
        if which == 0 and len(steps) == 64 * (1 + bool(wide)):
            squares = [step**2 for step in struct.unpack(">64H" if wide else ">64B", steps)]
            return float((sum(squares) / 64 / 12) ** 0.5)
        tables = tables[1 + len(steps) :]
    return 0.0


def _bmp_header(start: bytes, size: int) -> ImageHeader:
    """Header of a BMP file. Rows are padded to four bytes; a negative height means top row first.

    Source: BITMAPINFOHEADER, Windows GDI.
    """
    if len(start) < 30:
        raise NoImage("is cut short")
    offset, kind, width, height, _, bits = struct.unpack_from("<IIiiHH", start, 10)
    if kind < 40 or width <= 0 or height == 0 or bits not in (1, 4, 8, 16, 24, 32):
        raise NoImage("is damaged (its BMP header is wrong)")
    row = (width * bits + 31) // 32 * 4
    packed = start[30:31] not in (b"\0", b"\3")
    whole = packed or size >= offset + row * abs(height)
    return ImageHeader(width, abs(height), min(bits, 8), whole)


def _tiff_header(stream: BinaryIO) -> ImageHeader:
    """Header of the file's first image. Source: TIFF 6.0, sections 2 and 8."""
    size = stream.seek(0, 2)
    stream.seek(0)
    order = "<" if stream.read(4)[:1] == b"I" else ">"
    (place,) = _read(stream, order + "I")
    stream.seek(place)
    (count,) = _read(stream, order + "H")
    if count > _MOST_TAGS:
        raise NoImage("is damaged (its TIFF header is wrong)")
    entries = [_read(stream, order + "HHI4s") for _ in range(count)]
    tags = {tag: _tiff_values(stream, order, *entry) for tag, *entry in entries if tag in _TAGS}
    width, height, bits = (tags.get(tag, (0,))[0] for tag in (_WIDTH, _HEIGHT, _BITS))
    if not width or not height:
        raise NoImage("is damaged (its TIFF header is wrong)")
    ends = zip(tags.get(_STRIPS, tags.get(_TILES, ())), _lengths(tags), strict=False)
    return ImageHeader(
        width, height, bits or 1, all(first + length <= size for first, length in ends)
    )


_WIDTH, _HEIGHT, _BITS, _STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES = (
    256,
    257,
    258,
    273,
    279,
    324,
    325,
)
_TAGS = (_WIDTH, _HEIGHT, _BITS, _STRIPS, _STRIP_BYTES, _TILES, _TILE_BYTES)


def _lengths(tags: dict[int, tuple[int, ...]]) -> tuple[int, ...]:
    """Length of each strip or tile in bytes."""
    return tags.get(_STRIP_BYTES, tags.get(_TILE_BYTES, ()))


def _tiff_values(
    stream: BinaryIO, order: str, kind: int, count: int, content: bytes
) -> tuple[int, ...]:
    """Values of one entry: short or long whole numbers, in the entry itself if they fit."""
    form = {3: "H", 4: "I"}.get(kind)
    if form is None or not 0 < count <= _MOST_STRIPS:
        raise NoImage("is damaged (its TIFF header is wrong)")
    wanted = f"{order}{count}{form}"
    if struct.calcsize(wanted) <= len(content):
        return struct.unpack_from(wanted, content)
    (place,) = struct.unpack(order + "I", content)
    stream.seek(place)
    return _read(stream, wanted)


def _read(stream: BinaryIO, form: str) -> tuple[Any, ...]:
    """Unpack the next bytes of the file. Raises NoImage if it ends."""
    content = stream.read(struct.calcsize(form))
    if len(content) < struct.calcsize(form):
        raise NoImage("is cut short")
    return struct.unpack(form, content)


def _ends_with(stream: BinaryIO, start: int, mark: bytes) -> bool:
    """Whether `mark` occurs near the end of the file, after `start`."""
    size = stream.seek(0, 2)
    stream.seek(max(start, size - _TAIL))
    return mark in stream.read()
