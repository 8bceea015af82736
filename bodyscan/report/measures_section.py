"""A report's section of measures by name: drawn on the body, and as a table.

What is drawn is the content of a `measurements.json` (docs/formats.md): of `bodyscan measure --named`,
of a batch's stage, or made for the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from bodyscan.errors import BadInput
from bodyscan.files.reading import read_json_object
from bodyscan.fusion.storage import StoredScan
from bodyscan.measurement.measurements import measure
from bodyscan.measurement.named import MIN_MEASURED
from bodyscan.mesh.body import BodyMesh
from bodyscan.mesh.repair import decimate
from bodyscan.report.measurement_table import MEASUREMENTS, make_measurements_document
from bodyscan.report.model import Layer, Strokes, pack
from bodyscan.report.page import Block, Column, Lines, Picture, Table, Viewer
from bodyscan.report.pictures import Callout, draw_callouts

Content = Mapping[str, Any]

COLOURS = {
    **dict.fromkeys(("tape", "chain", "distance"), (0, 158, 115)),
    **dict.fromkeys(("breadth", "depth"), (213, 94, 0)),
    "girth": (0, 114, 178),
    "height": (150, 70, 120),
}
"""Red, green, blue, by a measure's kind."""


def show_measures(scan: StoredScan, folder: Path) -> list[Block]:
    """The measures by name of a scan in a folder. Raises BadInput if no standing body fits it."""
    content = _read_measures(folder)
    if content is None:
        content = make_measurements_document(measure(scan.mesh, named=True), scan.facts)
    # Files of 0.2 do not say whether a measure is a range.
    measures = [{"is_range": one["measured"] < MIN_MEASURED} | one for one in content["measures"]]
    posture = content["posture"]
    arms, feet = (" and ".join(f"{a:.0f}" for a in posture[k]) for k in ("arms_deg", "feet_deg"))
    stood = (
        f"The person stood with heels {posture['heels_mm']:.0f} mm apart, toes {feet} degrees out, "
        f"arms {arms} degrees off the trunk, head nodding {posture['head_deg']:.0f} degrees."
    )
    missing = tuple(f"{name}: {reason}" for name, reason in content["not_measured"].items())
    small = decimate(scan.mesh)
    views = "From the front, from the subject's left side, from the back. "
    return [
        f"A parametric body was laid over the scan; it says where to measure. {stood}",
        Picture(
            "Measures on the body",
            f"{views}mm.",
            draw_callouts(small, _list_callouts(content, measures)),
        ),
        Viewer(
            "The same, to turn",
            "Blue: girths as a tape runs; green: lengths along the surface.",
            _pack_measures(small, measures),
        ),
        _tabulate(measures),
        *([Lines(missing)] if missing else []),
    ]


def _read_measures(folder: Path) -> Content | None:
    """What was measured by name of the scan in `folder`, there or by the next stage of its job. Raises
    BadInput if that stage found no body: a fit that fails takes longest, and fails again."""
    of_job = folder.parent / "measures" / MEASUREMENTS
    for path in (folder / MEASUREMENTS, of_job):
        if path.is_file():
            content = read_json_object(path)
            if "measures" in content and "posture" in content:
                return content
            if path == of_job:
                raise BadInput("no standing body fits the scan; measures.csv says why")
    return None


def _tabulate(measures: Sequence[Content]) -> Table:
    columns = (
        Column("measure"),
        Column("value", "mm", "Empty where what was not measured may change it by more than 8 mm: then "
               "it is a range.", digits=1),
        Column("from", "mm", "95 % interval: noise, breath, where the landmarks are.", digits=1),
        Column("to", "mm", digits=1),
        Column("measured", "%", "of what the tape touches", 100.0 * MIN_MEASURED, True, 0),
        Column("standard", "", "whose definition it follows; this is no certificate"),
        Column("clause"),
        Column("the standard's stance", "", "where the person stood otherwise"),
    )  # fmt: skip
    rows = tuple(
        (
            one["name"],
            None if one["is_range"] else one["mm"],
            *one["interval_mm"],
            100.0 * one["measured"],
            one["standard"],
            one["clause"],
            one["stance"],
        )
        for one in measures
    )
    return Table(columns, rows)


def _list_callouts(content: Content, measures: Sequence[Content]) -> dict[str, list[Callout]]:
    """Measures by the view that shows them best: girths and breadths from the front, heights and depths
    from the side, lengths from where they run."""
    front = np.array(content["rig_from_body"])[:3, 0]
    middle = np.array(content["rig_from_body"])[:3, 3]
    found: dict[str, list[Callout]] = {"front": [], "side": [], "back": []}
    for one in measures:
        path = np.array(one["path_mm"])
        low, high = one["interval_mm"]
        value = f"{low:.0f} to {high:.0f}" if one["is_range"] else f"{one['mm']:.0f}"
        colour = COLOURS[one["kind"]][::-1]
        view = {"girth": "front", "breadth": "front", "height": "side", "depth": "side"}.get(
            one["kind"], "front" if (path.mean(axis=0) - middle) @ front > 60.0 else "back"
        )
        path = path[1:] if one["kind"] == "height" else path
        found[view].append(Callout(f"{one['name']} {value}", path, colour))
    return found


def _pack_measures(mesh: BodyMesh, measures: Sequence[Content]) -> dict[str, Any]:
    """The body with girths and lengths along its surface as lines, those of trunk and neck labelled."""
    tree = cKDTree(mesh.vertices)
    ends, colours, labels = [], [], []
    for one in measures:
        if one["kind"] not in ("girth", "tape", "chain"):
            continue
        path = np.array(one["path_mm"])
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        at = np.linspace(0.0, along[-1], max(2, int(along[-1] / 10.0) + 1))  # every 10 mm
        path = np.stack([np.interp(at, along, column) for column in path.T], axis=1)
        # Above the surface by more than its reduction moves it.
        path = path + 3.0 * mesh.normals[tree.query(path)[1]]
        ends.append(np.stack([path[:-1], path[1:]], axis=1))
        colours.append(np.tile(np.array(COLOURS[one["kind"]], np.uint8), (len(path) - 1, 1)))
        if one["kind"] == "girth" and not one["name"].startswith(("left ", "right ")):
            labels.append((f"{one['name'].removesuffix(' girth')} {one['mm']:.0f}", path[0]))
    strokes = Strokes(np.concatenate(ends), np.concatenate(colours))
    plain = Layer("shape", np.full(mesh.vertices.shape, (214, 210, 205), np.uint8))
    return pack(mesh, [plain], strokes=strokes, labels=labels)
