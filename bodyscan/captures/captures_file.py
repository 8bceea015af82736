"""captures.yaml: what a capture folder says about itself; see docs/formats.md."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Literal

from bodyscan.captures.timing import Timing, timing_problems
from bodyscan.errors import CaptureError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import Model, Name, Problem, ShotName, did_you_mean, duplicates
from bodyscan.files.model_file import load_model
from bodyscan.files.yaml_file import dump_yaml
from bodyscan.rig.rig import Rig

FILE_NAME = "captures.yaml"
_REMEDY = "Correct captures.yaml; docs/formats.md explains every key."


class ShotEntry(Model):
    """One shot.

    stripes: the pairs that took the whole stripe sequence.
    lit: the pairs that took the lit image alone.

    If both are missing, the files in the folder decide.
    """

    name: ShotName
    stripes: tuple[Name, ...] | None = None
    lit: tuple[Name, ...] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in duplicates(self.stripes or ()):
            yield ("stripes", index), f"lists a pair twice (got {name!r})"
        named = (*(self.stripes or ()), *(self.lit or ()))
        for index, name in duplicates(named):
            if index >= len(self.stripes or ()):
                place = index - len(self.stripes or ())
                yield ("lit", place), f"lists a pair that is listed already (got {name!r})"


class CapturesFile(Model):
    """The whole captures.yaml.

    simulated: set by the simulator; reports repeat it.
    timing: when each frame was taken, if that is known.
    """

    version: Literal[1] = 1
    kind: Literal["calibration", "scan"]
    when: datetime | None = None
    subject: Name | None = None
    simulated: bool | None = None
    shots: tuple[ShotEntry, ...] | None = None
    timing: Timing | None = None

    def problems(self) -> Iterator[Problem]:
        if self.subject is not None and self.kind != "scan":
            yield ("subject",), "is for kind: scan"
        for index, name in duplicates(tuple(shot.name for shot in self.shots or ())):
            yield ("shots", index, "name"), f"is given to two shots (got {name!r})"


def load_captures_file(folder: Path, rig: Rig) -> CapturesFile:
    """Read the folder's captures.yaml and check it against the rig.

    Raises CaptureError, which lists every problem by line.
    """
    path = folder / FILE_NAME
    return load_model(
        path,
        CapturesFile,
        CaptureError,
        remedy=_REMEDY,
        also=lambda file: (*_unknown_names(file, rig), *_wrong_timing(file, rig)),
    )


def write_captures_file(folder: Path, captures: CapturesFile) -> None:
    """Write captures.yaml into a folder; `load_captures_file` reads back the same."""
    data = captures.model_dump(mode="json", exclude_none=True)
    write_text(folder / FILE_NAME, dump_yaml(data))


def _unknown_names(captures: CapturesFile, rig: Rig) -> Iterator[Problem]:
    pairs = {pair.name: pair for pair in rig.pairs}
    for index, shot in enumerate(captures.shots or ()):
        for key in ("stripes", "lit"):
            for place, name in enumerate(getattr(shot, key) or ()):
                where = ("shots", index, key, place)
                if name not in pairs:
                    hint = did_you_mean(name, pairs)
                    yield where, f"names no pair of rig {rig.name}{hint} (got {name!r})"
                elif key == "stripes" and pairs[name].projector is None:
                    yield where, f"names a camera without projector (got {name!r}): list it in lit"


def _wrong_timing(captures: CapturesFile, rig: Rig) -> Iterator[Problem]:
    for where, text in timing_problems(captures.timing, rig) if captures.timing else ():
        yield ("timing", *where), text
