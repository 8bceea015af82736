"""How a person stood, and what a standard wants otherwise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodyscan.arrays import Array
from bodyscan.body_model.fitting import FittedBody


@dataclass(frozen=True)
class Posture:
    """Angles in degrees, left and right where there are two."""

    heels_mm: float  # between the backs of the heels, to the side
    sink_mm: float  # how much lower the hips are than with the ankles straight beneath them
    feet_deg: tuple[float, float]  # that the toes point outwards
    arms_deg: tuple[float, float]  # between upper arms and the trunk's axis
    elbows_deg: tuple[float, float]  # 0 for a straight arm
    head_deg: float  # that the head nods forward, against the template's level one

    def describe_departure(self, stance: Sequence[str]) -> str:
        """What a standard's stance wants otherwise than the person stood; "" if nothing.

        stance: of "feet together", "arms down", "elbow bent", "head level".
        """
        arm, elbow = max(self.arms_deg), min(self.elbows_deg)
        departures = {
            # ISO 20685-1 has feet 200 mm apart for scans, and lets heights be wrong by 4.
            "feet together": (
                self.sink_mm > 4.0 or self.heels_mm > 200.0,
                f"stood with heels {self.heels_mm:.0f} mm apart, {self.sink_mm:.0f} mm lower",
            ),
            # From 30 degrees on the shoulder blade turns with the arm and lifts the shoulder.
            "arms down": (arm > 30.0, f"held an arm {arm:.0f} degrees off"),
            "elbow bent": (elbow < 60.0, f"held an arm {elbow:.0f} degrees from straight"),
            # 10 degrees lower the top of a head by some 3 mm.
            "head level": (
                abs(self.head_deg) > 10.0,
                f"the head nodded {self.head_deg:.0f} degrees",
            ),
        }
        found = [(name, *departures[name]) for name in stance]
        return "; ".join(f"{name} ({how})" for name, departs, how in found if departs)


def find_posture(fitted: FittedBody, landmarks: Mapping[str, Array]) -> Posture:
    """How a person stood, from the joints and landmarks (body frame) of the fitted template."""
    names = fitted.template.joint_names
    joint = dict(zip(names, fitted.posed.joints, strict=True))
    rotation = dict(zip(names, fitted.posed.rotations, strict=True))
    down = -rotation["thorax"][:, 2]
    sinks, feet, arms, elbows = [], [], [], []
    for side, outward in (("left", 1.0), ("right", -1.0)):
        hip, ankle, shoulder, elbow, wrist = (
            joint[f"{side} {name}"] for name in ("thigh", "foot", "upper arm", "forearm", "hand")
        )
        sinks.append(float(np.linalg.norm(hip - ankle) - (hip - ankle)[2]))
        foot = landmarks[f"{side} acropodion"] - landmarks[f"{side} pternion"]
        feet.append(float(np.degrees(np.arctan2(outward * foot[1], foot[0]))))
        arms.append(_measure_angle(elbow - shoulder, down))
        elbows.append(_measure_angle(elbow - shoulder, wrist - elbow))
    heels = landmarks["left pternion"] - landmarks["right pternion"]
    x, _, z = rotation["head"][:, 0]
    return Posture(
        float(abs(heels[1])),
        float(np.mean(sinks)),
        (feet[0], feet[1]),
        (arms[0], arms[1]),
        (elbows[0], elbows[1]),
        float(np.degrees(np.arctan2(-z, x))),
    )


def _measure_angle(one: Array, other: Array) -> float:
    """Angle between two vectors (3,), degrees."""
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
