"""When a pair saw what, and how its sheets tell motion from that: what decoding needs to show a body at
one moment."""

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
"""In depth, RMS over what a pair sees: more than twice what the restless do."""


def sequence_moments(
    pair: PairCalibration,
    code: StripeCode,
    frames: FrameNames,
    frame_ms: Mapping[str, float] | None,
    pairs: int = 1,
) -> tuple[Moments, ...]:
    """Of the stripes, and of those that cross them, which are wanted at the same moment.

    pairs: of the rig. Each is asked whether the subject moved: noise that says so of one in a hundred
    would say it of every sixth mannequin before sixteen.

    frame_ms: when each image was taken, by its name; times are in seconds then. Where it is not known,
    images are taken to have come one after the other in the code's order or in that in which they are
    best shown, and times are counted in images: motion can be taken out by that as well, only its speed
    is not known.
    """
    # Sidak's, for looks that are independent.
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
    """Of the images of each kind, s."""
    return {
        kind.name: np.array([frame_ms[name] for name in names.of_kind(kind, count)]) / MS
        for kind, count in way.image_counts.items()
    }


def _told(
    camera: Camera, sheets: LightSheets | None, chance: float, comb: Comb
) -> StripeMotion | None:
    return None if sheets is None else tell_motion(camera, sheets, comb, chance=chance)
