"""Every setting that a person can change, with its default: stated here and nowhere else.

Pipeline files, `bodyscan.api` and the command line take theirs from these models; what lies below
takes the values, without defaults of its own.  Beside each value stand its unit, what it means and
why it is what it is.  What cannot be changed from outside is a constant where it is used.

    >>> ScanSettings().fusion.points
    1000000
    >>> ScanSettings(fusion=FusionSettings(points=200_000)).fusion.window_mm
    7.0
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field

from bodyscan.files.model import Model, Problem
from bodyscan.progress import THREADS

Millimetres = Annotated[float, Field(gt=0)]
MeshVersion = Literal["full", "light", "open"]

BODY_CENTRE_MM = (0.0, 0.0, 900.0)
"""Rig frame, mm: about where the middle of a standing person is. A pair's motion is told there, and
a subject turns about it, so that a turn does not look like a shift."""


class AlignmentSettings(Model):
    """How range images are brought together where they overlap (`alignment.icp`)."""

    matching: Literal["projected", "open3d", "none"] = "projected"
    """`projected`: points into the other camera's pixels, all pairs in one solve; `open3d`: Open3D's
    ICP of every two and its pose graph; `none`: each pair stays where the boards put it."""

    spacing_mm: Millimetres = 3.0
    """mm between the points that take part: some 10,000 a pair, more add time and no exactness."""

    reach_mm: Millimetres = 12.0
    """mm, the farthest match in the first round, halved each round: twice what a person is seen to
    move between pairs."""

    least_reach_mm: Millimetres = 3.0
    """mm, the farthest match in the last rounds: well beyond noise, less than a finger."""

    rounds: int = Field(default=5, ge=1)
    """times that matches are looked for; after five nothing moves by 0.01 mm."""

    fewest: int = Field(default=30, ge=6)
    """matches; two pairs with fewer do not count as overlapping."""

    sway_mm: float = Field(default=1.0, ge=0)
    """mm, standard deviation: how far a person moves between pairs; 0 for a rigid object."""

    sway_deg: float = Field(default=0.05, ge=0)
    """degrees, standard deviation: how far a person turns between pairs, about the body's centre
    (0.8 mm at head and feet)."""

    least_sway: float = Field(default=0.3, ge=0)
    """times sway_mm and sway_deg, the least that is believed after a round: a statue's noise."""

    most_sway: float = Field(default=4.0, gt=0)
    """times sway_mm and sway_deg, the most that is believed: beyond it a scan is to be repeated."""

    limit_sigmas: float = Field(default=5.0, gt=0)
    """standard deviations; a pair that wants to move farther does not fit and stays where it was."""

    correlated: float = Field(default=5.0, ge=1)
    """neighbouring points that count as one, because they share their errors."""


class FusionSettings(Model):
    """How range images become one cloud (`fusion.merging`)."""

    points: int = Field(default=1_000_000, ge=1000)
    """points of the cloud: one every 1.4 mm of a person's skin, as close as the pixels of a camera
    of 1280 x 1024 lie there."""

    window_mm: Millimetres = 7.0
    """mm, side of the window over which a surface is smoothed: a lip or a finger's edge survives."""

    agreement_mm: Millimetres = 1.5
    """mm along the normal, within which two pairs are averaged: what alignment leaves, with room."""

    double_mm: Millimetres = 6.0
    """mm along the normal, within which two surfaces are one seen twice: less than a finger's
    thickness."""


class MeshSettings(Model):
    """How a cloud becomes a closed mesh (`fusion.meshing`)."""

    depth: int = Field(default=9, ge=5, le=12)
    """of the grid that the surface is found on; one more halves its cells, which are 3.6 mm at 9."""

    reach_mm: Millimetres = 4.0
    """mm; points within this have a say about a vertex, without any it was measured by nobody: about
    a cell at depth 9; with another depth scale it alike."""

    @property
    def cell_mm(self) -> float:
        """mm from node to node of the grid: a quarter of a finger at depth 9."""
        return 3.6 * 2.0 ** (9 - self.depth)


class UseLimits(Model):
    """What a scan is used for: how wrong a girth of the trunk may be (`fusion.scan_verdict`).

    A surface that stands 1 mm off all round makes a girth wrong by 6.3 mm, so these come to 0.32 and
    0.64 mm between the surfaces of two pairs.
    """

    good_girth_mm: Millimetres = 2.0
    """mm; ISO 20685-1 allows 4 mm of small girths and 9 of large ones, for all errors together."""

    usable_girth_mm: Millimetres = 4.0
    """mm; beyond it a scan is to be repeated."""

    def problems(self) -> Iterator[Problem]:
        if self.usable_girth_mm < self.good_girth_mm:
            yield ("usable_girth_mm",), f"is less than good_girth_mm, {self.good_girth_mm:g}"


class ScanSettings(Model):
    """All that decides what a scan comes out as."""

    alignment: AlignmentSettings = AlignmentSettings()
    fusion: FusionSettings = FusionSettings()
    mesh: MeshSettings = MeshSettings()
    use: UseLimits = UseLimits()
    """mm of a girth: what the scan is for, by which its verdict judges."""


class ExportSettings(Model):
    """A scan for other programs (`export.scan`)."""

    formats: tuple[str, ...] = Field(default=("ply", "obj", "stl", "glb"), min_length=1)
    """files of each version, of the formats in bodyscan/export/formats; ply, obj, stl in mm, z up, glb
    in metres, y up."""

    versions: tuple[MeshVersion, ...] = Field(default=("full", "light"), min_length=1)
    """full; light: 50,000 faces, which any viewer turns; open: without what was filled."""

    deface: bool = False
    """without a recognisable face, for sharing; everything below the neck as it is."""


class RigExportSettings(Model):
    """A calibrated rig for other programs (`export.rig`)."""

    formats: tuple[str, ...] = Field(default=("colmap", "opencv"), min_length=1)
    """of those in bodyscan/interchange/formats; colmap: a text model with its rig; opencv: YAML, an
    entry a pair."""


class Resources(Model):
    """What one job of a batch takes."""

    threads: int = Field(default=THREADS, ge=1)
    """cores: larger machines run more jobs side by side."""

    memory_mb: int = Field(default=4000, ge=100)
    """MB: twice what twelve pairs of 1280 x 1024 were seen to take."""

    limit_minutes: float = Field(default=120.0, gt=0)
    """minutes; a job that takes longer counts as stuck and is ended: a scan takes one or two."""
