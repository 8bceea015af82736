"""The part of a scan's report that compares it with another surface."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np

from bodyscan.evaluation.surface import Comparison
from bodyscan.mesh.body import BodyMesh
from bodyscan.report import charts
from bodyscan.report.page import Column, Picture, Section, Table
from bodyscan.report.pictures import draw_deviation


def comparison_section(
    mesh: BodyMesh, found: list[Comparison], shown: Comparison, limit: float
) -> Section:
    """Tabulate the comparisons, and map the one `shown`; limit: of the map's scale, mm."""
    columns = (
        Column("the scan"),
        Column("bias", "mm", "mean signed distance, outside is positive."),
        Column("median", "mm", "of the absolute distances."),
        Column("RMS", "mm", "root of the mean squared distance."),
        Column("95 %", "mm", "of the absolute distances are less."),
        Column("worst", "mm", "the largest of the absolute distances.", digits=2),
    )
    rows = tuple((_frame_words(one), *astuple(one.figures)[1:]) for one in found)
    points = mesh.vertices[shown.vertices]
    fit = found[-1].other_from_scan
    moved = float(np.linalg.norm(fit.apply(points.mean(axis=0)) - points.mean(axis=0)))
    return Section(
        f"Compared with {shown.name}",
        intro=f"Distances of the {len(points):,} measured vertices of this scan's mesh from the "
        f"surface of {shown.name}; what was filled is left out. To fit it, the scan was moved "
        f"by {moved:.2f} mm and turned by {np.degrees(fit.angle):.3f} degrees as a whole.",
        blocks=[
            Table(columns, rows),
            Picture(
                "Deviation map",
                f"Front, left side, back; the scan {_frame_words(shown)}. Red: outside of "
                f"{shown.name}, blue: inside. Values beyond the scale "
                "have the colour of its end.",
                draw_deviation(
                    points,
                    mesh.normals[shown.vertices],
                    shown.signed_mm,
                    limit_mm=limit,
                    height_px=charts.PICTURE_PX,
                    caption="deviation, mm",
                ),
            ),
            Picture(
                "How the deviations are distributed",
                "The line stands at their mean; the outermost bars hold all that lies beyond.",
                charts.histogram(shown.signed_mm, limit, "signed distance, mm"),
            ),
        ],
    )


def _frame_words(one: Comparison) -> str:
    return "fitted rigidly to the other" if one.fitted else "in its rig frame"


def map_limit(one: Comparison) -> float:
    """Choose the end of the map's scale, mm: a round number above 95 % of the deviations."""
    return charts.round_up(max(one.figures.p95_mm, 1e-3))
