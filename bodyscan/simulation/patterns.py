"""The light of every image of every code, for the simulator alone: its own formulas."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bodyscan.rig.frame_names import FrameNames
from bodyscan.simulation.gray import bit_count, code_bits
from bodyscan.stripes.projector_spec import ProjectorSpec

Array = NDArray[np.float64]

PARTS = 16
"""Values of light in a stripe, where it changes inside stripes."""


def projected_patterns(spec: ProjectorSpec, frames: FrameNames) -> dict[str, Array]:
    """By name of the image, its light (stripes * k,), 0 to 1, at evenly spaced places of the sweep.

    Of a stripe-index rig, what its instrument throws for itself: Gray code (see `instrument`).
    """
    if spec.code == "light-section":
        images = np.eye(spec.stripes)
        return {_named(frames.stripe, "stripe", i): image for i, image in enumerate(images)}
    if spec.code == "phase-shift":
        place = (np.arange(spec.stripes * PARTS) + 0.5) / PARTS
        halves = np.floor(2.0 * place / spec.period_stripes).astype(int)
        bits = code_bits(int(halves[-1]) + 1)[:, halves].astype(float)
        return _bit_images(spec, frames, bits) | _waves(spec, frames, place)
    if spec.code == "binary":
        shifts = np.arange(bit_count(spec.stripes))[::-1]
        bits = (np.arange(spec.stripes) >> shifts[:, None] & 1).astype(float)
        return _bit_images(spec, frames, bits)
    return _bit_images(spec, frames, code_bits(spec.stripes).astype(float))


def _bit_images(spec: ProjectorSpec, frames: FrameNames, bits: Array) -> dict[str, Array]:
    images = {_named(frames.pattern, "bit", i): bit for i, bit in enumerate(bits)}
    if spec.inverses is not False:
        images |= {_named(frames.inverse, "bit", i): 1.0 - bit for i, bit in enumerate(bits)}
    return images


def _waves(spec: ProjectorSpec, frames: FrameNames, place: Array) -> dict[str, Array]:
    steps, turns = spec.phase_steps, place / spec.period_stripes
    return {
        _named(frames.phase, "step", i): np.cos(np.pi * (turns - i / steps)) ** 2
        for i in range(steps)
    }


def _named(names: str | tuple[str, ...], number: str, place: int) -> str:
    return names.format(**{number: place}) if isinstance(names, str) else names[place]
