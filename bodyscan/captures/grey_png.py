"""PNG files: damage found by checksums; grey ones decoded in a third of OpenCV's time.

Reading is a large part of a scan's work, and grey PNG the usual output of a scanner's cameras.
ISA-L inflates; the rows are reconstructed here. Only 8-bit grey without interlacing; the rest is
left to OpenCV. Source: PNG, ISO/IEC 15948:2004.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import cast

import numpy as np
from isal import isal_zlib

from bodyscan.arrays import Bytes
from bodyscan.compiled import compiled

SUB, UP, AVERAGE, PAETH = 1, 2, 3, 4  # filters of rows; 0 is none


def find_png_damage(data: bytes) -> str | None:
    """Check a whole PNG file: return what is wrong (ends early, wrong checksum), or None.

    libpng decodes such a file as far as it can and leaves the rest of the image as it is.
    """
    last = b""
    for last, content, checksum in _iterate_png_chunks(data):
        if _update_crc(content, isal_zlib.crc32(last)) != checksum:
            return "is damaged (a checksum is wrong)"
    return None if last == b"IEND" else "is cut short"


def _iterate_png_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview, int]]:
    """Yield kind, content and checksum of every complete chunk of a PNG file."""
    position, kind = 8, b""
    while kind != b"IEND" and position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            return
        (checksum,) = struct.unpack_from(">I", data, end)
        yield kind, memoryview(data)[position + 8 : end], checksum
        position = end + 4


def _update_crc(content: memoryview, crc: int) -> int:
    """Continue the CRC-32 `crc` with the content of a chunk. Chunks are a few kilobytes, whose sum
    takes a microsecond. From 5120 bytes on ISA-L releases the interpreter's lock for it, and getting it
    back from another thread takes many times as long."""
    step = 5120
    if len(content) > 16 * step:
        return isal_zlib.crc32(content, crc)
    for first in range(0, len(content), step):
        crc = isal_zlib.crc32(content[first : first + step], crc)
    return crc


def decode_grey_png(data: bytes, width: int, height: int, rows: int | None = None) -> Bytes | None:
    """Decode an image, or its first rows: (height, width) uint8; the chunks must be sound.

    None if the file is not a grey image of that size, or does not decode.
    """
    if data[16:29] != struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0):
        return None
    packed = b"".join(content for kind, content, _ in _iterate_png_chunks(data) if kind == b"IDAT")
    # Inflate no more than is wanted, whatever the file holds.
    wanted = height if rows is None else min(rows, height)
    try:
        filtered = isal_zlib.decompressobj().decompress(packed, wanted * (width + 1))
    except cast("type[Exception]", isal_zlib.error):
        return None
    if len(filtered) < wanted * (width + 1):
        return None
    image = np.empty((wanted, width), np.uint8)
    known = _unfilter(np.frombuffer(filtered, np.uint8).reshape(wanted, width + 1), image)
    return image if known else None


@compiled
def _unfilter(rows: Bytes, image: Bytes) -> bool:
    """Fill the image (H, W) from its rows (H, W + 1), each preceded by its filter number; False if
    there is no such filter."""
    above = np.zeros(image.shape[1], np.uint8)
    for v in range(len(rows)):
        kind, row, line = rows[v, 0], rows[v, 1:], image[v]
        left, corner = np.int64(0), np.int64(0)
        if kind == 0:
            line[:] = row
        elif kind == SUB:
            for u in range(row.size):
                left = (left + np.int64(row[u])) & 255
                line[u] = left
        elif kind == UP:
            for u in range(row.size):
                line[u] = np.uint8(row[u] + above[u])
        elif kind == AVERAGE:
            for u in range(row.size):
                left = (np.int64(row[u]) + ((left + np.int64(above[u])) >> 1)) & 255
                line[u] = left
        elif kind == PAETH:
            for u in range(row.size):
                up = np.int64(above[u])
                to_left, to_up = abs(up - corner), abs(left - corner)
                to_corner = abs(left + up - 2 * corner)
                nearest = up if to_up <= to_corner else corner
                if to_left <= to_up and to_left <= to_corner:
                    nearest = left
                left, corner = (np.int64(row[u]) + nearest) & 255, up
                line[u] = left
        else:
            return False
        above = line
    return True
