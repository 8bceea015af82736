"""The pipeline file: what a batch does and with which settings; see docs/formats.md."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from bodyscan.errors import BadInput
from bodyscan.files.model import Model, Name, Problem
from bodyscan.files.model_file import apply_changes, load_model

_REMEDY = "Mend the pipeline file; docs/formats.md explains every key."

Millimetres = Annotated[float, Field(gt=0)]
MeshFormat = Literal["ply", "obj", "stl", "glb"]


class PipelineError(BadInput):
    """The pipeline file, or a --set, is wrong."""


class Resources(Model):
    """What one job takes.  limit_minutes: after which it counts as stuck and is ended."""

    threads: int = Field(default=2, ge=1)
    memory_mb: int = Field(default=4000, ge=100)
    limit_minutes: float = Field(default=120.0, gt=0)


class Alignment(Model):
    """See bodyscan.alignment.icp.AlignmentSettings; matching none: boards alone."""

    matching: Literal["projected", "nearest", "none"] = "projected"
    spacing_mm: Millimetres = 3.0
    reach_mm: Millimetres = 12.0
    least_reach_mm: Millimetres = 3.0
    rounds: int = Field(default=5, ge=1)
    fewest: int = Field(default=30, ge=6)
    sway_mm: float = Field(default=1.0, ge=0)
    sway_deg: float = Field(default=0.05, ge=0)
    least_sway: float = Field(default=0.3, ge=0)
    most_sway: float = Field(default=4.0, gt=0)
    limit_sigmas: float = Field(default=5.0, gt=0)
    correlated: float = Field(default=5.0, ge=1)


class Fusion(Model):
    """See bodyscan.fusion.merging.merge."""

    points: int = Field(default=1_000_000, ge=1000)
    window_mm: Millimetres = 7.0
    agreement_mm: Millimetres = 1.5
    double_mm: Millimetres = 6.0


class Mesh(Model):
    """See bodyscan.fusion.meshing.mesh."""

    depth: int = Field(default=9, ge=5, le=12)
    reach_mm: Millimetres = 4.0


class Export(Model):
    """deface: without a recognisable face, everything below the neck as it is."""

    formats: tuple[MeshFormat, ...] = Field(default=("ply", "obj", "stl", "glb"), min_length=1)
    versions: tuple[Literal["full", "light", "open"], ...] = Field(
        default=("full", "light"), min_length=1
    )
    deface: bool = False


class RigExport(Model):
    """The calibrated rig for other programs."""

    formats: tuple[Literal["colmap", "opencv"], ...] = Field(
        default=("colmap", "opencv"), min_length=1
    )


SECTIONS = {
    "fuse": ("alignment", "fusion", "mesh", "export"),
    "calibrate": ("rig_export",),
}


class Pipeline(Model):
    """The whole file.  kind: what a job is, one scan (fuse) or one rig file (calibrate)."""

    version: Literal[1] = 1
    name: Name
    kind: Literal["fuse", "calibrate"]
    resources: Resources = Resources()
    alignment: Alignment = Alignment()
    fusion: Fusion = Fusion()
    mesh: Mesh = Mesh()
    export: Export = Export()
    rig_export: RigExport = RigExport()

    def problems(self) -> Iterator[Problem]:
        own = SECTIONS[self.kind]
        every = {name for names in SECTIONS.values() for name in names}
        for name in sorted((every - set(own)) & self.model_fields_set):
            yield (name,), f"is for another kind of pipeline than {self.kind}"

    def section(self, name: str) -> dict[str, Any]:
        """One section as plain data."""
        return dict(getattr(self, name).model_dump(mode="json"))


def load_pipeline(path: Path, changes: Sequence[str] = ()) -> Pipeline:
    """Read a pipeline file and apply `--set` changes such as `fusion.points=2000000`.

    Raises PipelineError that lists every problem: those of the file by line and column.
    """
    pipeline = load_model(Path(path), Pipeline, PipelineError, remedy=_REMEDY)
    return (
        apply_changes(pipeline, dict(map(_change, changes)), PipelineError) if changes else pipeline
    )


def _change(text: str) -> tuple[tuple[str, ...], Any]:
    """`fusion.points=2000000` as (("fusion", "points"), 2000000); `a,b` is a list."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise PipelineError(
            f"--set {text} is no change",
            remedy="write --set KEY=VALUE, such as fusion.points=2000000",
        )
    where = tuple(key.strip().split("."))
    try:
        return where, json.loads(value)
    except ValueError:
        pass
    if where[-1] in ("formats", "versions"):
        return where, [part.strip() for part in value.split(",")]
    return where, value.strip()
