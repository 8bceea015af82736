"""A scan's report: the body, how well it was measured, and where it was not."""

from __future__ import annotations

import calendar
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from bodyscan.evaluation.surface import Comparison, compare_surfaces
from bodyscan.fusion.scan_facts import read_facts, stored_verdict
from bodyscan.fusion.storage import StoredScan, load_scan
from bodyscan.fusion.verdict.coverage import MAX_FILLED
from bodyscan.fusion.verdict.motion import MAX_MOTION_MM, MAX_RESIDUAL_MM
from bodyscan.fusion.verdict.overlaps import MAX_DISAGREEMENT_MM
from bodyscan.mesh.body import compute_cover_shares, find_filled_patches
from bodyscan.mesh.topology import compute_topology
from bodyscan.motion.person_motion import PartMotion, PersonMotion
from bodyscan.registration.rig_calibration import FLOOR_AXES
from bodyscan.report import charts
from bodyscan.report.body_model import layers, shape_of, simplify_mesh
from bodyscan.report.comparison_section import comparison_section, map_limit
from bodyscan.report.model import pack
from bodyscan.report.page import (
    Column,
    Lines,
    Number,
    Numbers,
    Page,
    Picture,
    Section,
    Table,
    Viewer,
    is_synthetic,
    sections_of,
)
from bodyscan.report.pictures import draw_cloud, draw_mesh
from bodyscan.verdict import Verdict


def scan_page(folder: Path, other: Path | None = None) -> Page:
    """The report of the scan in `folder`, compared with `other` if given.

    A scan that gave no model has a report too: its reasons. Raises ResultError, BadInput.
    """
    facts = read_facts(folder)
    subject = facts.get("subject")
    sections: list[Section] = []
    if "sha256" in facts:
        scan = load_scan(folder)
        found = compare_surfaces(scan.mesh, other) if other is not None else []
        sections = _sections(scan, found)
    return Page(
        f"Scan of {subject}" if subject else f"Scan {folder.resolve().name}",
        stored_verdict(facts)
        or Verdict("usable", ("this scan was made by a version of bodyscan that gave no verdict",)),
        is_synthetic(folder) or facts.get("simulated", False),
        (
            ("taken", _in_words(facts.get("when"))),
            ("calibration", str(facts["calibration_id"])[:12]),
            ("made by", str(facts["software"])),
            ("folder", folder.resolve().name),
        ),
        facts.get("axes", FLOOR_AXES),
        sections,
        subject,
    )


def _in_words(when: str | None) -> str:
    """Format a date as people write it; text that is no date is returned unchanged."""
    if not when:
        return "not known"
    try:
        moment = datetime.fromisoformat(when)
    except ValueError:
        return when
    return f"{moment.day} {calendar.month_name[moment.month]} {moment.year}, {moment:%H:%M}"


def _sections(scan: StoredScan, found: list[Comparison]) -> list[Section]:
    # A person stands elsewhere in each scan, but a truth stands where it is true.
    shown = next((one for one in found if one.fitted == one.is_scan), None)
    limit = map_limit(shown) if shown else 1.0
    parts = {
        "The body": lambda: Section("The body", [_viewer(scan, shown, limit)]),
        "Figures": lambda: Section("Figures", [_numbers(scan)]),
    }
    if scan.facts.get("person"):
        parts["The person"] = lambda: _person(scan.facts["person"])
    if shown:
        parts["Comparison"] = lambda: comparison_section(scan.mesh, found, shown, limit)
    return sections_of(
        parts
        | {
            "Pictures": lambda: _pictures(scan),
            "Pairs and their overlaps": lambda: _pairs(scan.facts),
            "Holes": lambda: _holes(scan),
        }
    )


def _viewer(scan: StoredScan, shown: Comparison | None, limit: float) -> Viewer | Lines:
    small = simplify_mesh(scan.mesh)
    if small is None:
        return Lines(("The mesh cannot be reduced without folds: there is no model to rotate.",))
    return Viewer(
        "Body model",
        f"The mesh reduced to {len(small.faces):,} faces, a few tenths of a millimetre from the full "
        f"one ({len(scan.mesh.faces):,}), which the figures are of. Colours are those of the measured "
        "points: photo, number of pairs, sigma; grey or orange is what nothing measured.",
        pack(shape_of(small), layers(small, scan.mesh, scan.cloud, shown, limit)),
    )


def _numbers(scan: StoredScan) -> Numbers:
    facts, mesh = scan.facts, scan.mesh
    made_up = 100.0 * mesh.filled_share
    largest = next((hole.area_mm2 / 100.0 for hole in find_filled_patches(mesh)), 0.0)
    shape = compute_topology(mesh.vertices, mesh.faces)
    items = [
        Number("points", len(scan.cloud.points), "", "in the cloud, after pairs were merged"),
        Number("faces", len(mesh.faces), "", "triangles of the closed mesh"),
        Number(
            "sigma, median",
            float(np.nanmedian(scan.cloud.sigma_mm)),
            "mm",
            "standard deviation of a point along its normal: half of the points have less. From the "
            "contrast of the stripes, the angles of view and light, and the calibration",
        ),
        Number(
            "sigma, 95 %",
            float(np.nanpercentile(scan.cloud.sigma_mm, 95)),
            "mm",
            "95 of 100 points have less",
        ),
        Number(
            "filled",
            made_up,
            "% of area",
            "of the mesh's surface, filled to close it where nothing was measured",
            100.0 * MAX_FILLED,
            digits=1,
        ),
        Number("largest hole", largest, "cm²", "area of the largest filled patch", digits=1),
        Number(
            "mesh",
            "closed" if shape.closed and shape.manifold else "open",
            "",
            f"{shape.components} piece(s); closed: every edge belongs to two faces",
        ),
        *(
            Number(
                name, 100.0 * share, "% of points", "by brightness, roughness and place", digits=1
            )
            for name, share in compute_cover_shares(scan.cloud.regions).items()
        ),
        Number("volume", shape.volume_mm3 / 1e6, "l", "inside the mesh", digits=2),
    ]
    return Numbers((*items, *_alignment_numbers(facts)))


def _alignment_numbers(facts: Mapping[str, Any]) -> list[Number]:
    alignment = facts.get("alignment")
    if alignment is None:
        return [Number("overlaps", "not aligned", "", "pairs are at their calibrated poses")]
    motions = sorted(alignment["motion_mm"].items(), key=lambda item: -item[1])
    return [
        Number(
            "overlap residual",
            alignment["rms_after_mm"],
            "mm RMS",
            "distance between what two pairs measured of the same place, after alignment",
            MAX_DISAGREEMENT_MM,
        ),
        Number(
            "overlap residual before",
            alignment["rms_before_mm"],
            "mm RMS",
            "the same with the poses of the calibration alone",
        ),
        *(
            Number(
                "sway",
                motion,
                "mm",
                "the largest motion of the subject between pairs, by alignment: pair "
                f"{farthest}, at the body's middle",
                MAX_MOTION_MM,
                digits=2,
            )
            for farthest, motion in motions[:1]
        ),
    ]


def _person(person: Mapping[str, Any]) -> Section:
    """The section on a person who moved while being scanned: what moved, how far, and how
    certainly."""
    columns = (
        Column("part"),
        Column("moved", "mm", "most of it at most, against where it was in the middle.", digits=1),
        Column(
            "known to",
            "mm",
            "standard deviation of what remains of that, along the surface's normals.",
            MAX_RESIDUAL_MM,
            digits=2,
        ),
        Column("seen once", "%", "by a single pair: no other could measure its motion.", digits=0),
    )
    rows = tuple(
        (part["name"], part["moved_mm"], part["left_mm"], 100.0 * part["seen_once"])
        for part in person["parts"]
    )
    keys = ("name", "moved_mm", "left_mm", "seen_once")
    motion = PersonMotion(
        tuple(PartMotion(*(part[key] for key in keys)) for part in person["parts"]),
        person["breathed_mm"],
        person.get("moment_ms"),
        person.get("fuller_mm"),
        person.get("fuller_sigma_mm"),
    )
    when = "the mean of all pairs"
    if motion.moment_ms is not None:
        when = f"{motion.moment_ms / 1000.0:.2f} s after the scan began"
    what = motion.summary or "moved while being scanned"
    intro = f"The person {what}. Cloud and mesh show the body as of {when}."
    return Section("The person", [Table(columns, rows), Lines(motion.breath_lines)], intro)


def _pictures(scan: StoredScan) -> Section:
    cloud, mesh = scan.cloud, scan.mesh
    views = "From the front, from the subject's left side, from the back. "
    return Section(
        "Pictures",
        [
            Picture(
                "Measured points, as photographed",
                views + "White: nothing was measured there.",
                draw_cloud(cloud, height_px=charts.PICTURE_PX),
            ),
            Picture(
                "Mesh",
                views + "Orange: filled to close the mesh.",
                draw_mesh(mesh, height_px=charts.PICTURE_PX),
            ),
            Picture(
                "Sigma of the points",
                views + "Standard deviation of each point along its normal, mm.",
                draw_cloud(cloud, colour="sigma", height_px=charts.PICTURE_PX),
            ),
            Picture(
                "Pairs",
                views + "How many pairs measured each place.",
                draw_cloud(cloud, colour="pairs_seen", height_px=charts.PICTURE_PX),
            ),
        ],
    )


def _pairs(facts: Mapping[str, Any]) -> Section:
    alignment = facts.get("alignment") or {"motion_mm": {}, "overlaps": [], "refused": {}}
    motion, overlaps = alignment["motion_mm"], alignment["overlaps"]
    rows = tuple(
        (name, points, motion.get(name), _pair_residual(overlaps, name))
        for name, points in sorted(facts["measured"].items())
    )
    columns = (
        Column("pair"),
        Column("points", "", "measured on the subject after cleaning."),
        Column(
            "moved",
            "mm",
            "by the alignment, at the body's middle: sway of the subject and error of the pair's "
            "pose together.",
            MAX_MOTION_MM,
            digits=3,
        ),
        Column(
            "residual",
            "mm RMS",
            "from the other pairs' surfaces where they overlap, after alignment.",
            MAX_DISAGREEMENT_MM,
        ),
    )
    lost = [f"{name} gave nothing: {reason}" for name, reason in facts["failed"].items()]
    lost += [
        f"{name} was left at its calibrated pose: alignment would have moved it by {sigmas:.1f} sigmas"
        for name, sigmas in alignment["refused"].items()
    ]
    blocks: list[Any] = [Table(columns, rows)]
    if lost:
        blocks.append(Lines(tuple(lost)))
    if overlaps:
        blocks += [_overlap_picture(overlaps)]
    if motion:
        blocks += [_sway_picture(motion)]
    return Section("Pairs and their overlaps", blocks)


def _pair_residual(overlaps: list[dict[str, Any]], name: str) -> float | None:
    known = [o for o in overlaps if o["source"] == name and o["rms_after_mm"] is not None]
    points = sum(o["points"] for o in known)
    if not points:
        return None
    return float(np.sqrt(sum(o["points"] * o["rms_after_mm"] ** 2 for o in known) / points))


def _overlap_picture(overlaps: list[dict[str, Any]]) -> Picture:
    names = sorted({o[end] for o in overlaps for end in ("source", "target")})
    values = np.full((len(names), len(names)), np.nan)
    for o in overlaps:
        if o["rms_after_mm"] is not None:
            values[names.index(o["source"]), names.index(o["target"])] = o["rms_after_mm"]
    return Picture(
        "Residuals of the overlaps",
        "RMS distance (mm) of the points of the pair at the left from the surface of the pair below, "
        "after alignment. Empty: the two share too little of the subject.",
        charts.matrix(names, values, "mm RMS"),
    )


def _sway_picture(motion: Mapping[str, float]) -> Picture:
    return Picture(
        "Sway",
        "How far the alignment moved each pair against the subject, at the body's middle.",
        charts.bars(dict(sorted(motion.items())), "moved, mm", (MAX_MOTION_MM,)),
    )


def _holes(scan: StoredScan) -> Section:
    found = [hole for hole in find_filled_patches(scan.mesh) if hole.area_mm2 >= 100.0]
    rows = tuple(
        (str(k), hole.area_mm2 / 100.0, hole.centre[2], hole.centre[0], hole.centre[1], hole.facing)
        for k, hole in enumerate(found[:8], start=1)
    )
    columns = (
        Column("hole"),
        Column("area", "cm²", digits=1),
        Column("height", "mm", digits=0),
        Column("x", "mm", digits=0),
        Column("y", "mm", digits=0),
        Column("faces"),
    )
    intro = (
        f"Patches of at least 1 cm² that nothing measured and that were filled: {len(found)}"
        + (", of which the 8 largest are listed" if len(found) > 8 else "")
        + ". Height and place are of the patch's middle."
    )
    return Section("Holes", [Table(columns, rows)] if rows else [], intro)
