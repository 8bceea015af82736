"""Even out the pairs' colours, so that a body's colour shows no seam between pairs.

Cameras that see the same spot differ in two ways: their exposures and white balances, a factor for
each channel, and how squarely each one's projector, which stands beside it, lights the spot. A matt
surface is as bright as the cosine of the light's incidence, over the squared distance; light of the
room weakens that dependence, by a power from 0 to 1. The overlaps determine that power and the
factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bodyscan.arrays import Array, Bytes, Floats
from bodyscan.fusion.consistency import Consistency
from bodyscan.fusion.smoothing import SmoothSurface
from bodyscan.fusion.voxel_thinning import Samples
from bodyscan.progress import map_threads

MIN_GREY = 8
"""Level below which a pixel carries no information about the light."""


@dataclass(frozen=True, eq=False)
class EqualizedColours:
    """Equalized colours, float32: of the samples, (N, C), and of each surface's points, (n, C)."""

    samples: Floats
    surfaces: list[Floats]


def equalize_colours(
    samples: Samples, surfaces: Sequence[SmoothSurface], consistency: Sequence[Consistency]
) -> EqualizedColours:
    """Correct colours to equal exposure and white balance of all pairs and even light on the body.

    A grey camera among colour ones, whose channels are equal, gets the mean colour of what it shows
    in common with them.
    """
    centres = [surface.rig_from_camera.translation for surface in surfaces]
    of_surfaces = map_threads(
        lambda one: compute_log_irradiance(
            one.points, one.normals, one.rig_from_camera.translation
        ),
        surfaces,
    )
    parts = [slice(start, end) for start, end in pairwise(samples.starts)]
    log_irradiances = map_threads(
        lambda both: compute_log_irradiance(
            samples.points[both[0]], samples.normals[both[0]], both[1]
        ),
        zip(parts, centres, strict=True),
    )
    of_samples = np.concatenate(log_irradiances)
    overlaps = [
        find_overlaps(samples, surfaces, consistency, of_samples, of_surfaces, channel)
        for channel in range(samples.colours.shape[1])
    ]
    power = estimate_light_exponent([(one.ratio, one.shade) for found in overlaps for one in found])
    gains = np.stack([_solve_channel(found, power, len(surfaces)) for found in overlaps], axis=1)
    coloured = [bool((one.colours != one.colours[:, :1]).any()) for one in surfaces]
    if any(coloured):  # whose white balance the body has
        gains /= np.exp(np.log(gains[coloured]).mean(axis=0))
    typical = float(np.mean(of_samples)) if len(of_samples) else 0.0

    def normalize(colours: list[Bytes], log_irradiances: list[Floats]) -> list[Floats]:
        """Divide out each pair's gains, and the irradiance relative to the typical one."""
        return [
            levels * (gain * np.exp(np.float32(-power) * (light - np.float32(typical)))[:, None])
            for levels, light, gain in zip(colours, log_irradiances, gains, strict=True)
        ]

    of_parts = normalize([samples.colours[part] for part in parts], log_irradiances)
    return EqualizedColours(
        np.concatenate(of_parts), normalize([one.colours for one in surfaces], of_surfaces)
    )


@dataclass(frozen=True, eq=False)
class Overlap:
    """Spots shown by both surfaces a and b, and how many these stand for.

    ratio, shade: logarithms (N,) of b's level over a's, and of the light that falls there.
    """

    a: int
    b: int
    ratio: Floats
    shade: Floats
    spots: int


def find_overlaps(
    samples: Samples,
    surfaces: Sequence[SmoothSurface],
    consistency: Sequence[Consistency],
    of_samples: Floats,
    of_surfaces: Sequence[Floats],
    channel: int,
) -> list[Overlap]:
    """Compare a channel's levels where surfaces agree with others, in up to 5000 spots a pair.

    of_samples, of_surfaces: logarithms of irradiance.
    """
    found = []
    for b, (surface, one) in enumerate(zip(surfaces, consistency, strict=True)):
        starts = np.searchsorted(one.index, samples.starts)
        for a, (start, end) in enumerate(pairwise(starts)):
            step = 1 + (end - start) // 5000
            here, there = one.index[start:end:step], one.at[start:end:step]
            ours, theirs = samples.colours[here, channel], surface.colours[there, channel]
            clear = (np.minimum(ours, theirs) > MIN_GREY) & (np.maximum(ours, theirs) < 250)
            if np.count_nonzero(clear) < 200:
                continue
            ratio = np.log(theirs[clear] / ours[clear].astype(np.float32))
            shade = of_surfaces[b][there[clear]] - of_samples[here[clear]]
            found.append(Overlap(a, b, ratio, shade, step * len(ratio)))
    return found


def _solve_channel(overlaps: Sequence[Overlap], power: float, count: int) -> Floats:
    """Solve for the factors (count,) of one channel, given the power of irradiance."""
    logs = [float(np.median(one.ratio - power * one.shade)) for one in overlaps]
    return solve_gains(
        [(one.a, one.b, log, one.spots) for one, log in zip(overlaps, logs, strict=True)], count
    )


def estimate_light_exponent(overlaps: Sequence[tuple[Floats, Floats]]) -> float:
    """Estimate the exponent, 0 to 1, of irradiance to which grey levels are proportional.

    overlaps: log ratios (N,) of two cameras' levels, and of their irradiances. Least absolute error,
        each overlap about its medians.
    """
    if not overlaps:
        return 0.0
    ratio, shade = (
        np.concatenate([overlap[k] - np.median(overlap[k]) for overlap in overlaps]).astype(
            np.float64
        )
        for k in range(2)
    )
    some = np.abs(shade) > 1e-6
    if not some.any():
        return 0.0
    slopes, weights = ratio[some] / shade[some], np.abs(shade[some])
    median = np.quantile(slopes, 0.5, weights=weights, method="inverted_cdf")
    return float(np.clip(median, 0.0, 1.0))


def solve_gains(ratios: Sequence[tuple[int, int, float, int]], count: int) -> Floats:
    """Solve for the factors (count,) that bring the pairs' levels together, with geometric mean 1.

    ratios: (a, b, log of b's level over a's at common spots, number of spots).
    """
    # Pairs without overlap keep their brightness.
    normal, right = 1e-3 * np.eye(count), np.zeros(count)
    for a, b, ratio, spots in ratios:
        weight = spots / sum(n for *_, n in ratios)
        normal[[a, b], [a, b]] += weight
        normal[[a, b], [b, a]] -= weight
        right[a] += weight * ratio
        right[b] -= weight * ratio
    logarithms = np.linalg.solve(normal, right)
    return np.exp(logarithms - logarithms.mean()).astype(np.float32)


def compute_log_irradiance(points: Floats, normals: Floats, centre: Array) -> Floats:
    """Logarithm (N,) of a surface's irradiance from a lamp at a camera's centre, up to a
    constant: cosine of incidence over squared distance. Below a cosine of 0.1 the room's light
    prevails."""
    away = centre - points
    distance2 = np.einsum("nk,nk->n", away, away)
    cosine = np.maximum(np.einsum("nk,nk->n", normals, away) / np.sqrt(distance2), 0.1)
    return np.log(cosine / distance2).astype(np.float32)
