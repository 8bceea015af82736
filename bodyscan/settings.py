"""Every setting that a user can change, with its default: stated here and nowhere else.

Pipeline files, `bodyscan.api` and the command line take their settings from these models; lower
layers take the values and have no defaults of their own. Beside each value are its unit, its
meaning and the reason for it. What cannot be changed from outside is a constant where it is used.

    >>> ScanSettings().fusion.points
    1000000
    >>> ScanSettings(fusion=FusionSettings(points=200_000)).fusion.window_mm
    7.0
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from bodyscan.files.model import Model, Problem
from bodyscan.progress import THREADS

Millimetres = Annotated[float, Field(gt=0)]
MeshVersion = Literal["full", "light", "open", "registered", "textured"]

BODY_CENTRE_MM = (0.0, 0.0, 900.0)
"""Rig frame, mm: roughly the middle of a standing person. A pair's motion is stated at this point,
and the subject turns about it, so that a turn does not look like a shift."""


class AlignmentSettings(Model):
    """How range images are aligned (`alignment.icp`, `motion`)."""

    @model_validator(mode="before")
    @classmethod
    def _accept_old_names(cls, values: Any) -> Any:
        """Files of release 0.1 call some fields by other names."""
        old = {"least_reach_mm": "min_reach_mm", "fewest": "min_matches"}
        old |= {"least_sway": "min_sway", "most_sway": "max_sway"}
        if isinstance(values, dict):
            values = {old.get(name, name): value for name, value in values.items()}
        return values

    matching: Literal["projected", "open3d", "none"] = "projected"
    """`projected`: project points into the other camera's pixels, all pairs in one solve; `open3d`:
    Open3D's ICP of every two pairs and its pose graph; `none`: leave pairs where boards put them."""

    spacing_mm: Millimetres = 3.0
    """mm between the matched points: about 10,000 a pair; more cost time and gain nothing."""

    reach_mm: Millimetres = 12.0
    """mm, largest distance of a match in the first round, halved every round: twice what people move
    between pairs."""

    min_reach_mm: Millimetres = 3.0
    """mm, largest distance of a match in the last rounds: well beyond the noise, less than a finger."""

    rounds: int = Field(default=5, ge=1)
    """rounds of matching; after five nothing moves by 0.01 mm."""

    min_matches: int = Field(default=30, ge=6)
    """matches: two pairs with fewer do not overlap."""

    sway_mm: float = Field(default=1.0, ge=0)
    """mm, standard deviation of a person's shift between pairs; 0 for a rigid object."""

    sway_deg: float = Field(default=0.05, ge=0)
    """degrees, standard deviation of a person's turn between pairs, about the body's centre (0.8 mm
    at head and feet)."""

    min_sway: float = Field(default=0.3, ge=0)
    """times sway_mm and sway_deg: the smallest sway assumed after a round, the noise of a statue."""

    max_sway: float = Field(default=4.0, gt=0)
    """times sway_mm and sway_deg: the largest sway assumed; beyond it a scan must be repeated."""

    limit_sigmas: float = Field(default=5.0, gt=0)
    """standard deviations: a pair that would move farther keeps its calibrated pose."""

    correlated: float = Field(default=5.0, ge=1)
    """number of neighbouring matches that count as one, because their errors are correlated."""

    def widen_spacing(self, pairs: int) -> AlignmentSettings:
        """For over 16 pairs, whose overlaps grow with their square, match points farther apart: each
        pair then has as many matches, of which fewer count as one."""
        more = max(1.0, pairs / 16.0)
        spacing, correlated = self.spacing_mm * more**0.5, max(1.0, self.correlated / more)
        return self.model_copy(update={"spacing_mm": spacing, "correlated": correlated})


class FusionSettings(Model):
    """How range images become one cloud (`fusion.merging`)."""

    points: int = Field(default=1_000_000, ge=1000)
    """points of the cloud: one every 1.4 mm of a person's skin, as densely as the pixels of a
    1280 x 1024 camera lie there."""

    window_mm: Millimetres = 7.0
    """mm, side of the window over which a surface is smoothed: lips and edges of fingers stay."""

    agreement_mm: Millimetres = 1.5
    """mm along the normal within which two pairs are averaged: what alignment leaves, with room."""

    double_mm: Millimetres = 6.0
    """mm along the normal within which two surfaces are one surface seen twice: less than a
    finger's thickness."""


class MeshSettings(Model):
    """How a cloud becomes a closed mesh (`fusion.meshing`)."""

    depth: int = Field(default=9, ge=5, le=12)
    """of the grid that the surface is found on; one more halves its cells, 3.6 mm at depth 9."""

    reach_mm: Millimetres = 4.0
    """mm: points within this distance determine a vertex; a vertex without any counts as not
    measured. About a cell at depth 9: scale it with the cell for another depth."""

    @property
    def cell_mm(self) -> float:
        """mm between nodes of the grid: a quarter of a finger at depth 9."""
        return 3.6 * 2.0 ** (9 - self.depth)


class UseLimits(Model):
    """What a scan is used for: how wrong a girth of the trunk may be (`fusion.verdict`).

    A surface 1 mm off all round makes a girth wrong by 6.3 mm, so the limits come to 0.32 and
    0.64 mm between the surfaces of two pairs.
    """

    good_girth_mm: Millimetres = 2.0
    """mm; ISO 20685-1 allows 4 for small girths and 9 for large ones, for all errors together."""

    usable_girth_mm: Millimetres = 4.0
    """mm; beyond it a scan must be repeated."""

    def problems(self) -> Iterator[Problem]:
        if self.usable_girth_mm < self.good_girth_mm:
            yield ("usable_girth_mm",), f"is less than good_girth_mm, {self.good_girth_mm:g}"


class ScanSettings(Model):
    """Everything that determines a scan's result."""

    alignment: AlignmentSettings = AlignmentSettings()
    fusion: FusionSettings = FusionSettings()
    mesh: MeshSettings = MeshSettings()
    use: UseLimits = UseLimits()
    """Limits on girth errors, mm: what the scan is for, which its verdict is judged by."""


class ExportSettings(Model):
    """How a scan is exported for other programs (`export.scan`)."""

    formats: tuple[str, ...] = Field(default=("ply", "obj", "stl", "glb"), min_length=1)
    """file formats of each version, from bodyscan/export/formats; ply, obj and stl are in mm with z
    up, glb in metres with y up."""

    versions: tuple[MeshVersion, ...] = Field(default=("full", "light"), min_length=1)
    """full; light: 50,000 faces, which any viewer can turn; open: without the filled faces; registered:
    a parametric body laid over it, in one topology for all people, with parts, landmarks, skeleton;
    textured: light, its colours in an image (GLB and OBJ; needs the extra `texture`), as then has the
    registered body."""

    texture_px: int = Field(default=4096, ge=256, le=16384)
    """px: side of the image of `textured`."""

    deface: bool = False
    """remove the face, for sharing; everything below the neck stays as it is."""


class RigExportSettings(Model):
    """How a calibrated rig is exported for other programs (`export.rig`)."""

    formats: tuple[str, ...] = Field(default=("colmap", "opencv"), min_length=1)
    """formats from bodyscan/interchange/formats; colmap: a text model with its rig; opencv: YAML,
    one entry a pair."""


class Resources(Model):
    """What one job of a batch may use."""

    threads: int = Field(default=THREADS, ge=1)
    """cores: larger machines run more jobs side by side."""

    memory_mb: int = Field(default=4000, ge=100)
    """MB: twice what twelve pairs of 1280 x 1024 were measured to use."""

    limit_minutes: float = Field(default=120.0, gt=0)
    """minutes: a job that takes longer counts as stuck and is ended; a scan takes one or two."""
