"""What is wrong with an image file, in words, as far as its header tells."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodyscan.captures.image_header import NoImage, read_header
from bodyscan.errors import BadInput, ImageError
from bodyscan.rig.templates import ANYTHING

NO_INVERSES = (
    "All inverses and nothing else are missing: if none were projected, write `inverses: false` below "
    "`projector` (lit and dark images are needed then)."
)


def header_fault(path: Path, width: int, height: int) -> str | None:
    """Why the file cannot be an image of that size with at most 16 bits per sample, or None."""
    try:
        header = read_header(path)
    except FileNotFoundError:
        return absence(path)
    except NoImage as error:
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
    return None if header.complete else "is cut short"


def absence(path: Path) -> str:
    """Why a file was not found: it is missing, or `*` in its name matches several."""
    fitting = sorted(found.name for found in path.parent.glob(_plain(path.name)))
    if ANYTHING in path.name and len(fitting) > 1:
        return f"fits {len(fitting)} files, {fitting[0]} and {fitting[1]} among them"
    return "is there with other capitals" if _spelt_otherwise(path) else "is missing"


def _spelt_otherwise(path: Path) -> bool:
    """Whether a neighbouring file differs only in capitals, such as `.PNG` for `.png`."""
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    return any(other.name.casefold() == path.name.casefold() for other in beside)


def _plain(name: str) -> str:
    """A glob pattern in which only `*` is special."""
    return name.replace("[", "[[]").replace("?", "[?]")


def image_error(what: str, path: Path, pair: str, shot: str, *, remedy: str = "") -> ImageError:
    """An ImageError that names file, pair and shot, and what to do."""
    taken = ", ".join(f"{kind} {name}" for kind, name in (("pair", pair), ("shot", shot)) if name)
    where = f"{path} ({taken})" if taken else str(path)
    return ImageError(what, where=where, remedy=remedy or _remedy(what))


def missing_error(
    missing: Sequence[Path], inverses: Sequence[Path], pair: str, shot: str
) -> ImageError:
    """An ImageError for missing images, which names the first of them.

    inverses: those of the sequence, missing or not.
    """
    what = absence(missing[0])
    remedy = NO_INVERSES if set(missing) == set(inverses) else _remedy(what)
    if len(missing) > 1:
        what += f", and {len(missing) - 1} more of this shot cannot be found"
    return image_error(what, missing[0], pair, shot, remedy=remedy)


def _remedy(what: str) -> str:
    if what.startswith("fits "):
        return "Keep one of them, or say more of the name in `files` or `frames` of the rig file."
    if "capitals" in what:
        return "Rename it, or write `files` and `frames` of the rig file as the files are named."
    if what == "is missing":
        return "Copy it here, take the shot again, or leave it out of captures.yaml."
    if "the rig file says" in what:
        return "Check the camera's width and height in the rig file, and which camera took this."
    if "bits a sample" in what:
        return "Save whole numbers of 8 or 16 bits; the camera's software can choose them."
    return "Copy it again from where it was taken, or take the shot again."
