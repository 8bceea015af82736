"""What is wrong with an image file as far as its header tells, in words.

A wrong image is refused before it is decoded: an image of 60000 x 60000 pixels fits into a few
kilobytes of file and fills the memory.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from bodyscan.errors import BadInput, ImageError
from bodyscan.files.reading import open_regular
from bodyscan.rig.templates import ANYTHING

warnings.filterwarnings("ignore", module=r"PIL\.")  # what is wrong is reported here

NO_INVERSES = (
    "All inverses and nothing else are missing: if none were projected, write `inverses: false` below "
    "`projector` (lit and dark images are needed then)."
)


@dataclass(frozen=True)
class ImageHeader:
    """What an image file says of its image."""

    width: int
    height: int
    bits: int  # per sample
    complete: bool  # whether a PNG or JPEG has its end
    colour: bool = False  # whether pixels have red, green and blue
    # Of JPEG, RMS in grey levels, for an image with sharp edges everywhere, such as stripes.
    rounding_error: float = 0.0
    fault: str = ""  # of TIFF, what this program does not read


class NotAnImage(Exception):
    """Raised for what is not the start of a PNG, JPEG, BMP or TIFF file; says why."""


def read_header(path: Path) -> ImageHeader:
    """Read the header of an image file.

    PNG, the usual kind, is read here; the others by Pillow, which takes a tenth of a second to
    import. A rotation noted in EXIF is not applied.

    Raises NotAnImage if `path` is not of a known kind, BadInput if it is not a regular file,
    OSError if it cannot be read.
    """
    with open_regular(path) as stream:
        start = stream.read(33)
        if not start:
            raise NotAnImage("is an empty file")
        if start.startswith(b"\x89PNG\r\n\x1a\n"):
            if len(start) < 33:
                raise NotAnImage("is cut short")
            length, kind, width, height, bits, colour = struct.unpack_from(">I4sIIBB", start, 8)
            (checksum,) = struct.unpack_from(">I", start, 29)
            if (length, kind) != (13, b"IHDR") or zlib.crc32(start[12:29]) != checksum:
                raise NotAnImage("is damaged (its PNG header is wrong)")
            complete = _ends_with(stream, 33, b"\x00\x00\x00\x00IEND\xaeB`\x82")
            return ImageHeader(width, height, bits, complete, bool(colour & 2))
        kinds = {b"\xff\xd8\xff": "Jpeg", b"BM": "Bmp", b"II*\0": "Tiff", b"MM\0*": "Tiff"}
        kind = next((kind for magic, kind in kinds.items() if start.startswith(magic)), None)
        if kind is None:
            raise NotAnImage("is not a PNG, JPEG, BMP or TIFF image")
        stream.seek(0)
        try:
            return _read_by_pillow(stream, kind)
        except OSError as error:
            if error.errno is not None:
                raise
        except Exception:  # Pillow raises what its parsers run into
            pass
    raise NotAnImage(f"is cut short or damaged (its {kind.upper()} header cannot be read)")


def _read_by_pillow(stream: BinaryIO, kind: str) -> ImageHeader:
    """Size and depth; of JPEG also completeness, and the quantisation error in grey levels."""
    # The classes themselves: Image.open refuses large images before it says how large they are.
    plugin = import_module(f"PIL.{kind}ImagePlugin")
    for number in (34712, 34887) if kind == "Tiff" else ():  # compressions that Pillow cannot name
        plugin.COMPRESSION_INFO.setdefault(number, "raw")
    image: Any = getattr(plugin, f"{kind}ImageFile")(stream)
    width, height = image.size
    colour = image.mode not in ("1", "L")
    # OpenCV decodes no BMP or TIFF that is cut short.
    if kind == "Tiff":
        return _read_tiff_header(image)
    if kind == "Bmp":
        return ImageHeader(width, height, 8, True, colour)
    # A coefficient rounded to multiples of q errs by q / sqrt(12); the transform preserves squares.
    # Table 0 is that of brightness.
    squares = [step**2 for step in image.quantization.get(0, [0])]
    rounding_error = (sum(squares) / len(squares) / 12) ** 0.5
    complete = _ends_with(stream, stream.tell(), b"\xff\xd9")
    return ImageHeader(width, height, 8, complete, colour, rounding_error)


def _read_tiff_header(image: Any) -> ImageHeader:
    """Read a TIFF's tags: its size as stored, whatever its orientation, and what is not read of it."""
    tags, fault, pages = image.tag_v2, "", 0
    unread = {34712: "JPEG 2000", 34887: "LERC", 34925: "LZMA", 50000: "Zstandard", 50001: "WebP"}
    if tags.get(259) in unread:
        fault = (
            f"is compressed by {unread[tags[259]]}, which is not read: save it with LZW or Deflate"
        )
    for number in range(image.n_frames):
        image.seek(number)
        pages += not image.tag_v2.get(254, 0)  # not a thumbnail or mask
    fault = f"holds {pages} images: save each as a file of its own" if pages > 1 else fault
    colour, bits = tags.get(262, 1) > 1, max(tags.get(258, (1,)))  # 0 and 1: white or black is zero
    return ImageHeader(tags[256], tags[257], bits, True, colour, fault=fault)


def store_upright(tiff: bytes) -> bytes:
    """The TIFF file without its orientation tag: OpenCV turns pixels by it whatever its flags say."""
    order = "<" if tiff.startswith(b"II") else ">"
    (first,) = struct.unpack_from(f"{order}I", tiff, 4)
    for entry in range(first + 2, len(tiff) - 11, 12):  # in the order of their numbers
        (tag,) = struct.unpack_from(f"{order}H", tiff, entry)
        if tag >= 274:
            one = struct.pack(f"{order}H", 1)
            return tiff[: entry + 8] + one + tiff[entry + 10 :] if tag == 274 else tiff
    return tiff


def _ends_with(stream: BinaryIO, start: int, mark: bytes) -> bool:
    """Whether `mark` occurs after `start` near the end; some writers add a few bytes after it."""
    size = stream.seek(0, 2)
    stream.seek(max(start, size - 65536))
    return mark in stream.read()


def find_header_fault(path: Path, width: int, height: int) -> str | None:
    """Return why a file cannot be an image of that size with 8 to 16 bits a sample, or None."""
    try:
        header = read_header(path)
    except FileNotFoundError:
        return describe_missing(path)
    except NotAnImage as error:
        return str(error)
    except BadInput as error:
        return error.what
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    if (header.width, header.height) != (width, height):
        size = f"{header.width} x {header.height}"
        return f"is {size} pixels, but the rig file says {width} x {height}"
    if header.bits > 16:
        return f"has {header.bits} bits a sample; 8 to 16 are read"
    return header.fault or (None if header.complete else "is cut short")


def describe_missing(path: Path) -> str:
    """Return why a file was not found: it is missing, or `*` in its name matches several."""
    pattern = path.name.replace("[", "[[]").replace("?", "[?]")  # only `*` is special
    matches = sorted(found.name for found in path.parent.glob(pattern))
    if ANYTHING in path.name and len(matches) > 1:
        return f"matches {len(matches)} files, such as {matches[0]} and {matches[1]}"
    return "is missing"


def make_image_error(what: str, path: Path, where: str, *, remedy: str = "") -> ImageError:
    """Make an ImageError that names file, pair and shot, and what to do."""
    remedy = remedy or (
        "Possible causes: it was not taken, or is damaged (copy it again, take the shot again, or "
        "leave it out of captures.yaml); the calibration is another rig's; the rig file has another "
        "name for it (`files`, `frames`; capitals count) or another size (the camera's width and "
        "height); the software saves other kinds of files."
    )
    return ImageError(what, where=f"{path} ({where})" if where else str(path), remedy=remedy)


def make_missing_error(missing: Sequence[Path], inverses: Sequence[Path], where: str) -> ImageError:
    """Make an ImageError for missing images, which names the first of them.

    inverses: those of the sequence, missing or not.
    """
    what = describe_missing(missing[0])
    remedy = NO_INVERSES if set(missing) == set(inverses) else ""
    if len(missing) > 1:
        what += f", and {len(missing) - 1} more of this shot cannot be found"
    return make_image_error(what, missing[0], where, remedy=remedy)
