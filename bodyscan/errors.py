"""The errors that bodyscan raises: what went wrong, where, and what to do about it.

`BadInput` is something the user can correct (the command line exits with 2); `FailedWork` is good
input on which the work did not succeed (exit 1).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any


def escape_control(text: str) -> str:
    """Escape control characters, which would disturb a terminal or a table."""
    return "".join(
        letter if letter.isprintable() or letter == "\n" else ascii(letter)[1:-1] for letter in text
    )


class BodyscanError(Exception):
    """Root of all errors: `what` went wrong, `where` (file, line, pair, shot), and the `remedy`."""

    exit_code = 1

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        # Both may quote a damaged file.
        what = re.sub(r"(\S{200})\S{100,}", r"\1...", escape_control(what))
        where = re.sub(r"(?s)^(.{200}).{100,}(.{200})$", r"\1...\2", escape_control(where))
        super().__init__(what, where, remedy)
        self.what, self.where, self.remedy = what, where, remedy

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text}\n  {self.remedy}" if self.remedy else text


def format_error(error: BodyscanError) -> str:
    """Return `what` and the remedy as text, for messages that already say where."""
    return f"{error.what}\n  {error.remedy}" if error.remedy else error.what


def group_reasons(reasons: Iterable[tuple[Any, str]]) -> list[tuple[list[Any], str]]:
    """Names that failed for one reason, and that reason; most names first.

    Reasons are one, and the first is given, if they differ only in the name, in figures (but for the
    number of a bit), in brackets, or in the example after "such as".
    """
    groups: dict[str, tuple[list[Any], str]] = {}
    for name, reason in reasons:
        text = reason.partition("such as")[0].replace(str(name), "")
        kind = re.sub(r"\(.*?\)|(?<!bit )(?<!\d)\d[\d.]*%?(, \d[\d.]*%?)*", "", text)
        groups.setdefault(kind, ([], reason))[0].append(name)
    return sorted(groups.values(), key=lambda group: len(group[0]), reverse=True)


def format_list(reasons: Mapping[str, str]) -> str:
    """Format several failures, one a line; a remedy stands once, after all those that it helps."""
    groups: dict[str, list[str]] = {}
    for names, reason in group_reasons(reasons.items()):
        what, _, remedy = reason.partition("\n")
        groups.setdefault(remedy, []).append(f"\n  {', '.join(names)}: {what}")
    return "".join(
        "".join(lines) + (f"\n{remedy}" if remedy else "") for remedy, lines in groups.items()
    )


class BadInput(BodyscanError):
    """The input cannot be used as it is."""

    exit_code = 2


class RigFileError(BadInput):
    """The rig file is wrong; `where` is file:line:column."""


class CaptureError(BadInput):
    """A capture folder lacks something or holds something unusable."""


class ImageError(CaptureError):
    """One image is missing, unreadable, of the wrong size, or shows nothing."""


class CalibrationFileError(BadInput):
    """A stored calibration cannot be read or does not belong to this rig."""


class ResultError(BadInput):
    """A stored scan result cannot be read."""


class FailedWork(BodyscanError):
    """The input was good but the work on it did not succeed."""

    exit_code = 1


class BoardNotFound(FailedWork):
    """No board was found in an image that should show one."""


class DecodingFailed(FailedWork):
    """The images of a stripe sequence do not form a valid stripe code."""


class WrongDirection(DecodingFailed):
    """The stripes run in the other direction from the one the rig file gives."""


class DegeneratePoses(FailedWork):
    """The board poses cannot determine the camera (too few, or a pure translation)."""


class PairFailed(FailedWork):
    """One pair could not be calibrated; the others continue."""


class RigDisconnected(FailedWork):
    """No shared board view ties two groups of pairs together."""


class ScanFailed(FailedWork):
    """A scan yields no body."""
