"""A scan's body as a rotatable model: a light mesh, coloured by everything known about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.arrays import Bytes, Mask
from bodyscan.evaluation.surface import Comparison
from bodyscan.mesh.body import REGION_NAMES, BodyCloud, BodyMesh, compute_cover_shares
from bodyscan.progress import THREADS
from bodyscan.report.model import Layer, css, ramp_legend
from bodyscan.report.pictures import FILLED_TINT, blue_white_red, turbo

UNKNOWN = (150, 150, 150)
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


def colour_layers(
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
    sigma = _ramp(np.nan_to_num(small.sigma_mm / top), turbo()[:, ::-1])
    nearest = np.asarray(cKDTree(cloud.points).query(small.vertices, workers=THREADS)[1])
    pairs = np.array(PAIRS, np.uint8)[np.clip(cloud.pairs_seen[nearest], 1, len(PAIRS)) - 1]
    tint, grey = FILLED_TINT[::-1], (css(UNKNOWN), "filled, nothing measured")
    found = [
        Layer("photo", small.colours, None, unlit=True),
        Layer("shape", np.full(small.vertices.shape, SKIN, np.uint8)),
        Layer("pairs", _without(pairs, made_up), {"caption": "pairs that measured it", "swatches": [
            *((css(c), f"{k}{' or more' if k == len(PAIRS) else ''}") for k, c in enumerate(PAIRS, 1)),
            grey,
        ]}),
        Layer("sigma", _without(sigma, made_up), {
            **ramp_legend("sigma along the normal, mm", turbo()[:, ::-1], ("0", f"{top:g}")),
            "swatches": [grey],
        }),
        Layer("filled", np.where(made_up[:, None], tint, SKIN).astype(np.uint8), {
            "swatches": [(css(SKIN), "measured"), (css(tint), "filled to close the mesh")],
        }),
    ]  # fmt: skip
    if compute_cover_shares(small.regions) and small.regions is not None:
        region_colours = np.array(REGIONS, np.uint8)
        swatches = [(css(colour), name) for colour, name in zip(REGIONS, REGION_NAMES, strict=True)]
        found.append(Layer("regions", region_colours[small.regions], {"swatches": swatches}))
    if comparison is not None:
        found.append(_deviation(small, mesh, comparison, made_up, limit_mm))
    return found


def _deviation(
    small: BodyMesh,
    mesh: BodyMesh,
    comparison: Comparison,
    made_up: Mask,
    limit_mm: float,
) -> Layer:
    """Colour by the deviation of the full mesh's nearest vertex: reduction moves the surface by some
    tenths of a mm."""
    tree = cKDTree(mesh.vertices[comparison.vertices])
    signed = comparison.signed_mm[np.asarray(tree.query(small.vertices, workers=THREADS)[1])]
    table = blue_white_red()[:, ::-1]
    caption, ends = (
        f"from {comparison.name}, mm (red: outside it)",
        (f"−{limit_mm:g}", f"+{limit_mm:g}"),
    )
    legend = ramp_legend(caption, table, ends) | {
        "swatches": [(css(UNKNOWN), "filled, not compared")]
    }
    return Layer(
        "deviation", _without(_ramp(0.5 + 0.5 * signed / limit_mm, table), made_up), legend
    )


def _ramp(share: NDArray[np.floating], table: Bytes) -> Bytes:
    return table[np.clip(np.rint(255 * share), 0, 255).astype(np.int64)]


def _without(colours: Bytes, unknown: Mask) -> Bytes:
    return np.where(unknown[:, None], UNKNOWN, colours).astype(np.uint8)
