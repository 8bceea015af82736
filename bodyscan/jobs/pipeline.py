"""The pipeline file: what a batch does and with which settings; see docs/formats.md."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

from bodyscan.errors import BadInput
from bodyscan.export.formats import BODY_FORMATS
from bodyscan.files.model import Name, Problem, did_you_mean, format_alternatives
from bodyscan.files.model_file import apply_settings, load_model
from bodyscan.interchange.rig_format import RIG_FORMATS
from bodyscan.settings import ExportSettings, Resources, RigExportSettings, ScanSettings

SECTIONS = {"fuse": ("alignment", "fusion", "mesh", "use", "export"), "calibrate": ("rig_export",)}


class Pipeline(ScanSettings):
    """The whole file.

    kind: what a job is, one scan (fuse) or one rig file (calibrate).

    Its sections, with their defaults, are those of bodyscan.settings.
    """

    version: Literal[1] = 1
    name: Name
    kind: Literal["fuse", "calibrate"]
    resources: Resources = Resources()
    export: ExportSettings = ExportSettings()
    rig_export: RigExportSettings = RigExportSettings()

    def problems(self) -> Iterator[Problem]:
        allowed = SECTIONS[self.kind]
        every = {name for names in SECTIONS.values() for name in names}
        for name in sorted((every - set(allowed)) & self.model_fields_set):
            yield (name,), f"is for another kind of pipeline than {self.kind}"
        yield from _find_unknown_formats("export", self.export.formats, BODY_FORMATS.names())
        yield from _find_unknown_formats("rig_export", self.rig_export.formats, RIG_FORMATS.names())

    @property
    def scan(self) -> ScanSettings:
        """The settings that determine the result of a scan."""
        return ScanSettings(**{name: getattr(self, name) for name in ScanSettings.model_fields})

    def section(self, name: str) -> dict[str, Any]:
        """One section as plain data."""
        return dict(getattr(self, name).model_dump(mode="json"))


def _find_unknown_formats(
    section: str, formats: Sequence[str], known: Sequence[str]
) -> Iterator[Problem]:
    for index, name in enumerate(formats):
        if name not in known:
            wrong = (
                f"must be {format_alternatives(known)}{did_you_mean(name, known)} (got {name!r})"
            )
            yield (section, "formats", index), wrong


def load_pipeline(path: Path, changes: Sequence[str] = ()) -> Pipeline:
    """Read a pipeline file and apply `--set` changes such as `fusion.points=2000000`.

    Raises BadInput, which lists every problem, those of the file by line and column.
    """
    remedy = "Correct the pipeline file; docs/formats.md explains every key."
    pipeline = load_model(Path(path), Pipeline, BadInput, remedy=remedy)
    return apply_settings(pipeline, changes, BadInput) if changes else pipeline
