"""A real pair: each board held out in turn, measured with planes fitted to the others."""

from __future__ import annotations

import numpy as np

from benchmarks.captures import open_real
from benchmarks.held_out_boards import hold_out_boards


def report() -> str:
    """The section of docs/results.md."""
    rig, captures = open_real("procam-board")
    results = hold_out_boards(rig, captures, rig.pairs[0].name)
    models = list(dict.fromkeys(r.model for r in results))
    shots = list(dict.fromkeys(r.shot for r in results))
    lines = []
    for model in models:
        own = {r.shot: r for r in results if r.model == model}
        cells = [f"{own[s].median_mm:.2f} / {own[s].flatness_rms_mm:.2f}" for s in shots]
        mean = np.mean([own[s].median_mm for s in shots])
        lines.append(f"| {model} | {' | '.join(cells)} | {mean:.2f} |")
    return f"""## A real pair, each board held out (procam-board)

Camera and boards from the corners of all poses; the projector from the stripes of all poses but
one; that one's board measured. Board units (75 a square): median absolute distance to the board's
plane, then RMS about the points' own plane. Stripes of one direction only: for OpenCV's stereo
calibration the missing projector coordinate is imputed. "Chosen" is the model that the remaining
boards choose by holding out each of them in turn; the board measured takes no part in the choice.

| model | {" | ".join(shots)} | mean of medians |
|---|{"---|" * (len(shots) + 1)}
{chr(10).join(lines)}
"""
