"""A scan's report: the body, how well it was measured, and where it was not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.evaluation.surface import Comparison, compare_surfaces
from bodyscan.fusion.storage import StoredScan, load_scan, read_facts, read_stored_verdict
from bodyscan.fusion.verdict.coverage import MAX_FILLED
from bodyscan.fusion.verdict.motion import MAX_MOTION_MM, MAX_RESIDUAL_MM
from bodyscan.fusion.verdict.overlaps import MAX_DISAGREEMENT_MM
from bodyscan.mesh.body import (
    REGION_NAMES,
    BodyCloud,
    BodyMesh,
    compute_cover_shares,
    find_filled_patches,
)
from bodyscan.mesh.repair import decimate
from bodyscan.mesh.topology import compute_topology
from bodyscan.motion.person_motion import PartMotion, PersonMotion
from bodyscan.progress import THREADS
from bodyscan.registration.rig_calibration import FLOOR_AXES
from bodyscan.report import charts
from bodyscan.report.measures_section import show_measures
from bodyscan.report.model import Layer, format_css, pack
from bodyscan.report.page import (
    Block,
    Column,
    Lines,
    Numbers,
    Page,
    Picture,
    Section,
    Table,
    Value,
    Viewer,
    is_synthetic,
    make_sections,
)
from bodyscan.report.pictures import (
    FILLED_TINT,
    UNKNOWN,
    Scale,
    VisiblePoints,
    draw_pictures,
    turbo,
)
from bodyscan.verdict import Verdict

SKIN = (214, 210, 205)
REGIONS = (UNKNOWN, SKIN, (120, 70, 30), (40, 70, 130))
"""In the order of `REGION_NAMES`: unsure (including filled), skin, hair, dark cloth."""
PAIRS = (
    (70, 50, 125),
    (60, 100, 170),
    (40, 150, 150),
    (95, 185, 100),
    (190, 205, 60),
    (250, 210, 50),
)
"""For one pair, two, ... and six or more."""


def make_scan_page(folder: Path, other: Path | None = None) -> Page:
    """The report of the scan in `folder`, compared with `other` if given.

    A scan that gave no model has a report too: its reasons. Raises ResultError, BadInput.
    """
    facts = read_facts(folder)
    subject = facts.get("subject")
    sections: list[Section] = []
    found: list[Comparison] = []
    if "sha256" in facts:
        scan = load_scan(folder)
        found = compare_surfaces(scan.mesh, other) if other else []
        sections = _make_sections(scan, found, folder)
    return Page(
        f"Scan of {subject}" if subject else f"Scan {folder.resolve().name}",
        read_stored_verdict(facts)
        or Verdict("usable", ("this scan was made by a version of bodyscan that gave no verdict",)),
        is_synthetic(folder) or facts.get("simulated", False),
        (
            ("taken", _format_date(facts.get("when"))),
            ("calibration", str(facts["calibration_id"])[:12]),
            ("made by", str(facts["software"])),
            ("folder", folder.resolve().name),
        ),
        facts.get("axes", FLOOR_AXES),
        sections,
        subject,
    )


def _format_date(when: str | None) -> str:
    """Format a date as people write it; text that is no date is returned unchanged."""
    if not when:
        return "not known"
    try:
        moment = datetime.fromisoformat(when)
    except ValueError:
        return when
    return f"{moment.day} {moment:%B %Y, %H:%M}"


def _make_sections(scan: StoredScan, found: list[Comparison], folder: Path) -> list[Section]:
    # A person stands elsewhere in each scan, but a truth stands where it is true.
    shown = next((one for one in found if one.fitted == one.is_scan), None)
    # The map's scale ends at a round number above 95 % of the deviations.
    limit = charts.round_up(max(shown.figures.p95_mm, 1e-3)) if shown else 1.0
    parts: dict[str, Callable[[], Sequence[Block]]] = {
        "The body": lambda: _show_body(scan, shown, limit),
        "Figures": lambda: [_list_numbers(scan)],
        "Measures by name": lambda: show_measures(scan, folder),
    }
    if scan.facts.get("person"):
        parts["The person"] = lambda: _describe_motion(scan.facts["person"])
    if shown:
        parts[f"Compared with {shown.name}"] = lambda: _compare(scan.mesh, found, shown, limit)
    parts["Pictures"] = lambda: _show_pictures(scan)
    parts["Pairs and their overlaps"] = lambda: _tabulate_pairs(scan.facts)
    parts["Holes"] = lambda: _tabulate_holes(scan)
    return make_sections(parts)


def _show_body(scan: StoredScan, shown: Comparison | None, limit: float) -> list[Block]:
    small = decimate(scan.mesh)
    caption = (
        f"The mesh reduced to {len(small.faces):,} faces, a few tenths of a millimetre from the full "
        f"one ({len(scan.mesh.faces):,}), which the figures are of. Colours are those of the measured "
        "points: photo, number of pairs, sigma; grey or orange is what nothing measured."
    )
    layers = make_colour_layers(small, scan.mesh, scan.cloud, shown, limit)
    return [Viewer("Body model", caption, pack(small, layers))]


def make_colour_layers(
    small: BodyMesh,
    mesh: BodyMesh,
    cloud: BodyCloud,
    comparison: Comparison | None,
    limit_mm: float,
) -> list[Layer]:
    """Colour the mesh by photo, plain, number of pairs, sigma, filled; by region if some of it is
    covered, and by deviation if compared."""
    made_up = np.zeros(len(small.vertices), bool)
    made_up[small.faces[small.filled]] = True
    top = float(f"{max(np.nanpercentile(cloud.sigma_mm, 98), 1e-6):.2g}")
    sigma = Scale(0.0, top, "sigma along the normal, mm", turbo()[:, ::-1])
    nearest = np.asarray(cKDTree(cloud.points).query(small.vertices, workers=THREADS)[1])
    pairs = np.array(PAIRS, np.uint8)[np.clip(cloud.pairs_seen[nearest], 1, len(PAIRS)) - 1]
    pairs[made_up] = UNKNOWN
    tint, grey = FILLED_TINT[::-1], (format_css(UNKNOWN), "filled, nothing measured")
    found = [
        Layer("photo", small.colours, None, unlit=True),
        Layer("shape", np.full(small.vertices.shape, SKIN, np.uint8)),
        Layer("pairs", pairs, {"caption": "pairs that measured it", "swatches": [
            *(
                (format_css(c), f"{k}{' or more' if k == len(PAIRS) else ''}")
                for k, c in enumerate(PAIRS, 1)
            ),
            grey,
        ]}),
        _make_colour_layer("sigma", np.where(made_up, np.nan, small.sigma_mm), sigma, grey),
        Layer("filled", np.where(made_up[:, None], tint, SKIN).astype(np.uint8), {
            "swatches": [
                (format_css(SKIN), "measured"), (format_css(tint), "filled to close the mesh"),
            ],
        }),
    ]  # fmt: skip
    if compute_cover_shares(small.regions) and small.regions is not None:
        region_colours = np.array(REGIONS, np.uint8)
        swatches = [
            (format_css(colour), name) for colour, name in zip(REGIONS, REGION_NAMES, strict=True)
        ]
        found.append(Layer("regions", region_colours[small.regions], {"swatches": swatches}))
    if comparison is not None:
        # Of the full mesh's nearest vertex: reduction moves the surface by some tenths of a mm.
        tree = cKDTree(mesh.vertices[comparison.vertices])
        signed = comparison.signed_mm[np.asarray(tree.query(small.vertices, workers=THREADS)[1])]
        caption = f"from {comparison.name}, mm (red: outside it)"
        scale, grey = (
            Scale(-limit_mm, limit_mm, caption, charts.diverging()),
            (grey[0], "filled, not compared"),
        )
        found.append(
            _make_colour_layer("deviation", np.where(made_up, np.nan, signed), scale, grey)
        )
    return found


def _make_colour_layer(
    name: str, values: NDArray[np.floating], scale: Scale, unknown: tuple[str, str]
) -> Layer:
    """Colours by value, and the scale as a legend; unknown: colour of NaN, and what it means."""
    gradient = [format_css(colour) for colour in scale.table[np.linspace(0, 255, 12).astype(int)]]
    ends = [f"{scale.low:g}".replace("-", "−"), f"{scale.high:g}"]
    legend = {"caption": scale.caption, "gradient": gradient, "ends": ends, "swatches": [unknown]}
    return Layer(name, scale.colours(values), legend)


def _list_numbers(scan: StoredScan) -> Numbers:
    mesh, sigma_mm = scan.mesh, scan.cloud.sigma_mm
    largest = next((hole.area_mm2 / 100.0 for hole in find_filled_patches(mesh)), 0.0)
    shape = compute_topology(mesh.vertices, mesh.faces)
    return Numbers((
        (Column("points", "", "in the cloud, after pairs were merged"), len(sigma_mm)),
        (Column("faces", "", "triangles of the closed mesh"), len(mesh.faces)),
        (Column("sigma, median", "mm", "standard deviation of a point along its normal: half of the "
                "points have less. From the contrast of the stripes, the angles of view and light, "
                "and the calibration"), float(np.nanmedian(sigma_mm))),
        (Column("sigma, 95 %", "mm", "95 of 100 points have less"),
         float(np.nanpercentile(sigma_mm, 95))),
        (Column("filled", "% of area", "of the mesh's surface, filled to close it where nothing was "
                "measured", 100.0 * MAX_FILLED, digits=1), 100.0 * mesh.filled_share),
        (Column("largest hole", "cm²", "area of the largest filled patch", digits=1), largest),
        (Column("mesh", "", f"{shape.components} piece(s); closed: every edge belongs to two faces"),
         "closed" if shape.closed and shape.manifold else "open"),
        *((Column(name, "% of points", "by brightness, roughness and place", digits=1), 100.0 * share)
          for name, share in compute_cover_shares(scan.cloud.regions).items()),
        (Column("volume", "l", "inside the mesh", digits=2), shape.volume_mm3 / 1e6),
        *_list_alignment_numbers(scan.facts.get("alignment")),
    ))  # fmt: skip


def _list_alignment_numbers(alignment: Mapping[str, Any] | None) -> Iterator[tuple[Column, Value]]:
    if alignment is None:
        yield Column("overlaps", "", "pairs are at their calibrated poses"), "not aligned"
        return
    after = "distance between what two pairs measured of the same place, after alignment"
    yield (
        Column("overlap residual", "mm RMS", after, MAX_DISAGREEMENT_MM),
        alignment["rms_after_mm"],
    )
    before = "the same with the poses of the calibration alone"
    yield Column("overlap residual before", "mm RMS", before), alignment["rms_before_mm"]
    motions = alignment["motion_mm"]
    if motions:
        farthest = max(motions, key=motions.__getitem__)
        sway = (
            f"the largest motion of the subject between pairs, by alignment: pair {farthest}, at the "
            "body's middle"
        )
        yield Column("sway", "mm", sway, MAX_MOTION_MM, digits=2), motions[farthest]


def _describe_motion(person: Mapping[str, Any]) -> list[Block]:
    """What a person moved while being scanned, how far, and how certainly."""
    columns = (
        Column("part"),
        Column("moved", "mm", "most of it at most, against where it was in the middle.", digits=1),
        Column("known to", "mm", "standard deviation of what remains of that, along the surface's "
               "normals.", MAX_RESIDUAL_MM, digits=2),
        Column("seen once", "%", "by a single pair: no other could measure its motion.", digits=0),
    )  # fmt: skip
    keys = ("name", "moved_mm", "left_mm", "seen_once")
    parts = [PartMotion(*(part[key] for key in keys)) for part in person["parts"]]
    rows = tuple((one.name, one.moved_mm, one.left_mm, 100.0 * one.seen_once) for one in parts)
    whole = map(person.get, ("moment_ms", "fuller_mm", "fuller_sigma_mm"))
    motion = PersonMotion(tuple(parts), person["breathed_mm"], *whole)
    when = "the mean of all pairs"
    if motion.moment_ms is not None:
        when = f"{motion.moment_ms / 1000.0:.2f} s after the scan began"
    what = motion.summary or "moved while being scanned"
    intro = f"The person {what}. Cloud and mesh show the body as of {when}."
    return [intro, Table(columns, rows), Lines(motion.breath_lines)]


def _compare(
    mesh: BodyMesh, found: list[Comparison], shown: Comparison, limit: float
) -> list[Block]:
    """Tabulate the comparisons, and map the one `shown`; limit: of the map's scale, mm."""
    columns = (
        Column("the scan"),
        Column("bias", "mm", "mean signed distance, outside is positive."),
        Column("median", "mm", "of the absolute distances."),
        Column("RMS", "mm", "root of the mean squared distance."),
        Column("95 %", "mm", "of the absolute distances are less."),
        Column("worst", "mm", "the largest of the absolute distances.", digits=2),
    )
    words = {True: "fitted rigidly to the other", False: "in its rig frame"}
    rows = tuple((words[one.fitted], *astuple(one.figures)[1:]) for one in found)
    points = mesh.vertices[shown.vertices]
    fit = found[-1].other_from_scan
    moved = float(np.linalg.norm(fit.apply(points.mean(axis=0)) - points.mean(axis=0)))
    scale = Scale(-limit, limit, "deviation, mm", charts.diverging()[:, ::-1])
    visible = VisiblePoints.from_points(points, mesh.normals[shown.vertices])
    deviation_map = visible.draw_values(shown.signed_mm, scale)
    return [
        f"Distances of the {len(points):,} measured vertices of this scan's mesh from the surface of "
        f"{shown.name}; what was filled is left out. To fit it, the scan was moved by {moved:.2f} mm "
        f"and turned by {np.degrees(fit.angle):.3f} degrees as a whole.",
        Table(columns, rows),
        Lines(shown.notes, are_notes=True),
        Picture(
            "Deviation map",
            f"Front, left side, back; the scan {words[shown.fitted]}. Red: outside of {shown.name}, "
            "blue: inside. Values beyond the scale have the colour of its end.",
            deviation_map,
        ),
        Picture(
            "How the deviations are distributed",
            "The line stands at their mean; the outermost bars hold all that lies beyond.",
            charts.histogram(shown.signed_mm, limit, "signed distance, mm"),
        ),
    ]


def _show_pictures(scan: StoredScan) -> list[Block]:
    views = "From the front, from the subject's left side, from the back."
    table = {
        "cloud.png": ("Measured points, as photographed", "White: nothing was measured there."),
        "mesh.png": ("Mesh", "Orange: filled to close the mesh."),
        "sigma.png": ("Sigma of the points", "Standard deviation of each along its normal, mm."),
        "pairs.png": ("Pairs", "How many pairs measured each place."),
    }
    cloud, mesh = draw_pictures(scan.cloud), draw_pictures(scan.mesh)
    drawn = cloud.value | mesh.value
    shown = [
        Picture(title, f"{views} {caption}", drawn[name])
        for name, (title, caption) in table.items()
        if name in drawn
    ]
    return [*shown, Lines((*cloud.notes, *mesh.notes), are_notes=True)]


def _tabulate_pairs(facts: Mapping[str, Any]) -> list[Block]:
    alignment = facts.get("alignment") or {"motion_mm": {}, "overlaps": [], "refused": {}}
    overlaps = [o for o in alignment["overlaps"] if o["rms_after_mm"] is not None]

    def residual(name: str) -> float | None:
        known = [(o["points"], o["rms_after_mm"]) for o in overlaps if o["source"] == name]
        points = sum(count for count, _ in known)
        return np.sqrt(sum(n * rms**2 for n, rms in known) / points).item() if points else None

    rows = tuple(
        (name, points, alignment["motion_mm"].get(name), residual(name))
        for name, points in sorted(facts["measured"].items())
    )
    columns = (
        Column("pair"),
        Column("points", "", "measured on the subject after cleaning."),
        Column("moved", "mm", "by the alignment, at the body's middle: sway of the subject and error "
               "of the pair's pose together.", MAX_MOTION_MM),
        Column("residual", "mm RMS", "from the other pairs' surfaces where they overlap, after "
               "alignment.", MAX_DISAGREEMENT_MM),
    )  # fmt: skip
    lost = [f"{name} gave nothing: {reason}" for name, reason in facts["failed"].items()]
    lost += [
        f"{name} was left at its calibrated pose: alignment would have moved it by {sigmas:.1f} sigmas"
        for name, sigmas in alignment["refused"].items()
    ]
    blocks: list[Block] = [Table(columns, rows), *([Lines(tuple(lost))] if lost else [])]
    if alignment["overlaps"]:
        names = sorted({o[end] for o in alignment["overlaps"] for end in ("source", "target")})
        values = np.full((len(names), len(names)), np.nan)
        for o in overlaps:
            values[names.index(o["source"]), names.index(o["target"])] = o["rms_after_mm"]
        caption = (
            "RMS distance (mm) of the points of the pair at the left from the surface of the pair "
            "below, after alignment. Empty: the two share too little of the subject."
        )
        chart = charts.matrix(names, values, "mm RMS")
        blocks.append(Picture("Residuals of the overlaps", caption, chart))
    return blocks


def _tabulate_holes(scan: StoredScan) -> list[Block]:
    found = [hole for hole in find_filled_patches(scan.mesh) if hole.area_mm2 >= 100.0]
    rows = tuple(
        (str(k), hole.area_mm2 / 100.0, hole.centre[2], hole.centre[0], hole.centre[1])
        for k, hole in enumerate(found[:8], start=1)
    )
    columns = (
        Column("hole"),
        Column("area", "cm²", digits=1),
        *(Column(name, "mm", digits=0) for name in ("height", "x", "y")),
    )
    intro = (
        f"Patches of at least 1 cm² that nothing measured and that were filled: {len(found)}"
        + (", of which the 8 largest are listed" if len(found) > 8 else "")
        + ". Height and place are of the patch's middle."
    )
    return [intro, Table(columns, rows)] if rows else [intro]
