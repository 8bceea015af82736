"""Small charts by Matplotlib, all in one style: SVG, or PNG for maps."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import matplotlib
import numpy as np

from bodyscan.arrays import Array, Bytes

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, GREY, BLUE, RED = "#1d2430", "#8a93a0", "#0072b2", "#d55e00"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")
"""Okabe and Ito's colours, which the colour-blind can tell apart too."""
STYLE: Any = {
    "svg.hashsalt": "bodyscan",
    "font.size": 9.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "image.interpolation": "nearest",
}


@contextmanager
def style() -> Iterator[None]:
    """Draw in the style of the reports within the block."""
    with matplotlib.rc_context(STYLE):
        yield


def svg(figure: Figure) -> bytes:
    """A figure as SVG; the same figure gives the same bytes: no date, no random ids."""
    return _save(figure, format="svg", metadata={"Date": None, "Creator": None})


def png(figure: Figure, height_px: int) -> bytes:
    """A figure as PNG of this height; the same figure gives the same bytes."""
    dpi = height_px / figure.get_figheight()
    return _save(figure, format="png", dpi=dpi, metadata={"Software": None})


def _save(figure: Figure, **options: Any) -> bytes:
    stream = io.BytesIO()
    with style():
        figure.savefig(stream, **options)
    plt.close(figure)
    return stream.getvalue()


def diverging() -> Bytes:
    """The colour map of signed values, blue below and red above: (256, 3) red, green, blue."""
    return np.asarray(matplotlib.colormaps["RdBu_r"](np.arange(256), bytes=True))[:, :3]


def histogram(values: Array, limit: float, label: str) -> bytes:
    """Histogram of signed values; those beyond the limits are counted in the outermost bins."""
    with style():
        figure, axis = plt.subplots(figsize=(8.2, 2.8), constrained_layout=True)
        edges = np.linspace(-limit, limit, 81)
        counts, _ = np.histogram(np.clip(values, -limit, limit), edges)
        share = 100.0 * counts / max(len(values), 1)
        middle = 0.5 * (edges[1:] + edges[:-1])
        colours = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * middle / limit)
        axis.bar(middle, share, np.diff(edges), color=colours, edgecolor=GREY, linewidth=0.3)
        axis.axvline(float(np.mean(values)), color=INK, linewidth=1.0)
        axis.set(xlabel=label, ylabel="share, %", xlim=(-limit, limit))
    return svg(figure)


def matrix(names: Sequence[str], values: Array, label: str, form: str = ".2f") -> bytes:
    """Numbers between every two names (rows see columns), NaN left empty."""
    with style():
        size = max(3.0, 0.4 * len(names) + 1.2)
        figure, axis = plt.subplots(figsize=(size + 1.0, size), constrained_layout=True)
        known = values[np.isfinite(values)]
        top = float(known.max()) if known.size else 1.0
        shown = axis.imshow(values, cmap="YlGnBu", vmin=0.0, vmax=top or 1.0)
        for row, column in zip(*np.nonzero(np.isfinite(values)), strict=True):
            text = axis.text(column, row, format(values[row, column], form), fontsize=7.5)
            colour = "white" if values[row, column] > 0.55 * top else INK
            text.set(ha="center", va="center", color=colour)
        axis.set_xticks(range(len(names)), names, rotation=45, ha="right")
        axis.set_yticks(range(len(names)), names)
        axis.tick_params(length=0)
        axis.spines[:].set_visible(False)
        figure.colorbar(shown, ax=axis, shrink=0.7, label=label)
    return svg(figure)


def grid_of(count: int) -> tuple[Figure, list[Axes]]:
    """`count` axes in rows of four; surplus ones are hidden."""
    rows = -(-count // 4)
    size = (4 * 2.6, rows * 2.3)  # inches
    figure, axes = plt.subplots(rows, 4, figsize=size, constrained_layout=True, squeeze=False)
    flat = list(axes.ravel())
    for axis in flat[count:]:
        axis.set_visible(False)
    return figure, flat[:count]


def round_up(value: float) -> float:
    """Round a positive number up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value))
