"""A small rig and its capture folder on disk, for the tests of this folder."""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT, STRIPES, BITS = 40, 30, 12, 4

RIG = """\
version: 1
name: small
boards:
  - {name: board, columns: 5, rows: 4, square_mm: 30}
pairs:
  - name: p1
    camera: &camera {width: 40, height: 30}
    projector: {code: gray, stripes: 12, direction: horizontal}
  - name: p2
    camera: *camera
    projector: {stripes: 12, direction: horizontal}
  - name: cam
    camera: *camera
calibration:
  - folder: captures
"""

FRAMES = ["lit", "dark", *(f"bit0{bit}{kind}" for bit in range(BITS) for kind in ("", "-inverse"))]


def picture(frame: str) -> np.ndarray:
    """The image of that name: lit is 200, dark 5, patterns are the Gray code of the rows."""
    if frame in ("lit", "dark"):
        return np.full((HEIGHT, WIDTH), 200 if frame == "lit" else 5, np.uint8)
    stripe = np.arange(HEIGHT) * STRIPES // HEIGHT
    bright = (stripe ^ (stripe >> 1)) >> (BITS - 1 - int(frame[3:5])) & 1
    if frame.endswith("inverse"):
        bright = 1 - bright
    return np.repeat((5 + 195 * bright).astype(np.uint8)[:, None], WIDTH, axis=1)


def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


def write(path: Path, content: str | bytes | np.ndarray) -> Path:
    """Write text, bytes or an image, making the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, np.ndarray):
        content = encoded(content, path.suffix)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def write_small_captures(folder: Path, shots: int = 3) -> Path:
    """rig.yaml in `folder` and whole captures below it; returns the rig file's path."""
    for shot in range(1, shots + 1):
        for pair in ("p1", "p2"):
            for frame in FRAMES:
                write(folder / "captures" / f"b{shot}" / pair / f"{frame}.png", picture(frame))
        write(folder / "captures" / f"b{shot}" / "cam" / "lit.png", picture("lit"))
    return write(folder / "rig.yaml", RIG)


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
