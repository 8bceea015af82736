"""When a pair saw what, and how its sheets show motion: what decoding needs for a single moment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from bodyscan.arrays import Array
from bodyscan.calibration.pair import PairCalibration
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.light_planes import LightSheets
from bodyscan.reconstruction.told_motion import CHANCE, tell_motion
from bodyscan.rig.frame_names import FrameNames, ImageNames
from bodyscan.stripes.comb import Comb
from bodyscan.stripes.one_moment import LEAP_MM, Moments, StripeMotion
from bodyscan.stripes.stripe_code import StripeCode

MS = 1000.0
FASTEST_MM_S = 40.0
"""Depth speed, RMS over what a pair sees: more than twice that of restless people."""


def sequence_moments(
    pair: PairCalibration,
    code: StripeCode,
    frames: FrameNames,
    frame_ms: Mapping[str, float] | None,
    pairs: int = 1,
) -> tuple[Moments, ...]:
    """Moments of the stripes and of the crossing stripes, for which the same moment is wanted.

    frame_ms: when each image was taken, by name; times are then in seconds. None if not known:
        images are assumed to follow one another in the code's order, or in the order in which they
        are best shown, and times are counted in images. Motion can be removed with that too,
        without its speed.
    pairs: number of pairs in the rig. Each is tested for motion: noise that gives one false alarm
        in a hundred would give one for every sixth mannequin in front of sixteen pairs.
    """
    # Sidak's correction for independent tests.
    chance = -np.expm1(np.log1p(-CHANCE) / (pairs * len(code.directions)))
    told_of = partial(_moments, pair, code, frames, chance)
    if frame_ms is not None:
        lasted = float(np.ptp(list(frame_ms.values()))) / MS
        most = max(LEAP_MM, FASTEST_MM_S * lasted)
        return tuple(replace(one, most_mm=most) for one in told_of(frame_ms))
    orders = frames.of_code(code), frames.as_shown(code)
    counted = [{name: MS * place for place, name in enumerate(names)} for names in orders]
    usual, shown = (told_of(each) for each in counted)
    if orders[0] == orders[1]:
        return usual
    return tuple(replace(one, instead=other) for one, other in zip(usual, shown, strict=True))


def _moments(
    pair: PairCalibration,
    code: StripeCode,
    frames: FrameNames,
    chance: float,
    frame_ms: Mapping[str, float],
) -> tuple[Moments, ...]:
    found: list[Moments] = []
    ways = zip(
        code.directions, (frames, frames.crossing), (pair.sheets, pair.crossing), strict=False
    )
    for way, names, sheets in ways:
        times = _times(way, names, frame_ms)
        moment = found[0].moment if found else way.moment(times)
        told = partial(_told, pair.camera, sheets, chance)
        found.append(Moments(times, moment, told))
    return tuple(found)


def _times(way: StripeCode, names: ImageNames, frame_ms: Mapping[str, float]) -> dict[str, Array]:
    """Times of the images of each kind, s."""
    return {
        kind.name: np.array([frame_ms[name] for name in names.of_kind(kind, count)]) / MS
        for kind, count in way.image_counts.items()
    }


def _told(
    camera: Camera, sheets: LightSheets | None, chance: float, comb: Comb
) -> StripeMotion | None:
    return None if sheets is None else tell_motion(camera, sheets, comb, chance=chance)
