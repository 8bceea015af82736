"""A scan's body as a rotatable model: a light mesh, coloured by everything known about it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bodyscan.evaluation.surface import Comparison
from bodyscan.mesh.body import REGION_NAMES, BodyCloud, BodyMesh, compute_cover_shares
from bodyscan.progress import THREADS
from bodyscan.report.charts import diverging
from bodyscan.report.model import Layer, css
from bodyscan.report.pictures import FILLED_TINT, UNKNOWN, Scale, turbo

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
    sigma = Scale(0.0, top, "sigma along the normal, mm", turbo()[:, ::-1])
    nearest = np.asarray(cKDTree(cloud.points).query(small.vertices, workers=THREADS)[1])
    pairs = np.array(PAIRS, np.uint8)[np.clip(cloud.pairs_seen[nearest], 1, len(PAIRS)) - 1]
    pairs[made_up] = UNKNOWN
    tint, grey = FILLED_TINT[::-1], (css(UNKNOWN), "filled, nothing measured")
    found = [
        Layer("photo", small.colours, None, unlit=True),
        Layer("shape", np.full(small.vertices.shape, SKIN, np.uint8)),
        Layer("pairs", pairs, {"caption": "pairs that measured it", "swatches": [
            *((css(c), f"{k}{' or more' if k == len(PAIRS) else ''}") for k, c in enumerate(PAIRS, 1)),
            grey,
        ]}),
        _values_layer("sigma", np.where(made_up, np.nan, small.sigma_mm), sigma, grey),
        Layer("filled", np.where(made_up[:, None], tint, SKIN).astype(np.uint8), {
            "swatches": [(css(SKIN), "measured"), (css(tint), "filled to close the mesh")],
        }),
    ]  # fmt: skip
    if compute_cover_shares(small.regions) and small.regions is not None:
        region_colours = np.array(REGIONS, np.uint8)
        swatches = [(css(colour), name) for colour, name in zip(REGIONS, REGION_NAMES, strict=True)]
        found.append(Layer("regions", region_colours[small.regions], {"swatches": swatches}))
    if comparison is not None:
        # Of the full mesh's nearest vertex: reduction moves the surface by some tenths of a mm.
        tree = cKDTree(mesh.vertices[comparison.vertices])
        signed = comparison.signed_mm[np.asarray(tree.query(small.vertices, workers=THREADS)[1])]
        caption = f"from {comparison.name}, mm (red: outside it)"
        scale, grey = (
            Scale(-limit_mm, limit_mm, caption, diverging()),
            (grey[0], "filled, not compared"),
        )
        found.append(_values_layer("deviation", np.where(made_up, np.nan, signed), scale, grey))
    return found


def _values_layer(
    name: str, values: NDArray[np.floating], scale: Scale, unknown: tuple[str, str]
) -> Layer:
    """Colours by value, and the scale as a legend; unknown: colour of NaN, and what it means."""
    gradient = [css(colour) for colour in scale.table[np.linspace(0, 255, 12).astype(int)]]
    ends = [f"{scale.low:g}".replace("-", "−"), f"{scale.high:g}"]
    legend = {"caption": scale.caption, "gradient": gradient, "ends": ends, "swatches": [unknown]}
    return Layer(name, scale.colours(values), legend)
