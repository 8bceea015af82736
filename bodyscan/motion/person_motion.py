"""Summarize a person's estimated motion, part by part, for the operator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.geometry.robust import rms
from bodyscan.motion.body_parts import PARTS, name_parts
from bodyscan.motion.breath import project_breath_on_normals
from bodyscan.motion.estimation import EstimatedMotion


@dataclass(frozen=True)
class PartMotion:
    """How one part of a person moved.

    moved_mm: largest displacement from the middle of the scan, 95th percentile over the part.
    left_mm: standard deviation of what remains of it, along the surface's normals.
    seen_once: share of the part that a single pair measured, so that its motion is extrapolated.
    """

    name: str
    moved_mm: float
    left_mm: float
    seen_once: float

    @property
    def description(self) -> str:
        return f"{self.name}: moved by {self.moved_mm:.1f} mm, corrected to {self.left_mm:.2f} mm"


@dataclass(frozen=True)
class PersonMotion:
    """How a person moved."""

    parts: tuple[PartMotion, ...]  # the parts that were measured, from the trunk outwards
    breathed_mm: float | None  # see `measure_breath`
    # The body's moment, since the scan began; None (the mean of all) without times.
    moment_ms: float | None
    # fuller_mm, fuller_sigma_mm: see `measure_fullness`.
    fuller_mm: float | None = None
    fuller_sigma_mm: float | None = None

    @staticmethod
    def from_motion(motion: EstimatedMotion) -> PersonMotion:
        return PersonMotion(
            summarize_parts(motion),
            measure_breath(motion),
            motion.moment_ms,
            *(measure_fullness(motion) or (None, None)),
        )

    @property
    def summary(self) -> str:
        """The motion in one line; empty if no part was measured."""
        if not self.parts:
            return ""
        remaining = np.sqrt(np.mean([part.left_mm**2 for part in self.parts]))
        missing = (
            "`timing` is missing in captures.yaml: with it the breath can be told, and moving arms are "
            "measured better if pairs fire in no usual order; "
        )
        summary = (
            f"{missing if self.moment_ms is None else ''}"
            f"moved {max(part.moved_mm for part in self.parts):.0f} mm while being scanned; "
            f"corrected to {remaining:.2f} mm"
        )
        uncertain = [part for part in self.parts if part.left_mm > 0.3]  # 2 mm of a girth
        if not uncertain:
            return summary
        named = ", ".join(f"the {part.name} ({part.left_mm:.1f} mm)" for part in uncertain)
        return f"{summary}; repeat if you need {named}"

    @property
    def lines(self) -> tuple[str, ...]:
        """Details after the summary."""
        return (*(part.description for part in self.parts), *self.breath_lines)

    @property
    def breath_lines(self) -> tuple[str, ...]:
        if self.breathed_mm is None:
            breath = "breath cannot be separated from other motion"
        else:
            breath = f"breath of {self.breathed_mm:.1f} mm, corrected to one moment"
        if self.fuller_mm is None or self.fuller_sigma_mm is None:
            return (breath,)
        if self.moment_ms is None:
            unknown = "without frame times it is unknown how full chest and belly were: girths are"
            return (
                breath,
                f"{unknown} those of mean breath to +- {self.fuller_sigma_mm:.1f} mm there",
            )
        side = "in front of" if self.fuller_mm > 0 else "behind"
        return (
            breath,
            f"chest and belly were {abs(self.fuller_mm):.1f} +- {self.fuller_sigma_mm:.1f} mm {side} "
            "their position at mean breath: girths are given at mean breath",
        )


def describe_posture(motion: EstimatedMotion) -> str:
    """Describe where the posture while one pole fired differed most from that at other times, such as
    "the belly was 8 mm or more farther in"; empty without a step of posture."""
    if motion.step is None:
        return ""
    length = np.linalg.norm(motion.step, axis=1)
    farthest = int(np.argmax(length))
    part = PARTS[name_parts(motion.cells)[farthest]]
    if part != "trunk":
        return f"the {part} was elsewhere, by {length[farthest]:.0f} mm or more,"
    # They meet between the navel and the end of the sternum.
    belly = motion.cells.centres[farthest, 2] < 0.64 * motion.cells.centres[:, 2].max()
    outward = -np.sum(motion.step * motion.cells.normals, axis=1)
    largest = outward[np.abs(outward) > 0.5 * np.abs(outward).max()]
    where = "in" if np.all(largest < 0.0) else "out" if np.all(largest > 0.0) else "in or out"
    name = "belly" if belly else "chest"
    return f"the {name} was {length[farthest]:.0f} mm or more farther {where}"


def summarize_parts(motion: EstimatedMotion) -> tuple[PartMotion, ...]:
    """Motions of the parts that were measured, from the trunk outwards."""
    part = name_parts(motion.cells)
    found = []
    for number, name in enumerate(PARTS):
        cells = (part == number) & motion.observed.any(axis=0)
        if not cells.any():
            continue
        observed = motion.observed[:, cells]
        moved = np.where(observed, np.linalg.norm(motion.displacements[:, cells], axis=2), 0.0)
        found.append(
            PartMotion(
                name,
                float(np.percentile(moved.max(axis=0), 95.0)),
                rms(motion.sigma_mm[cells]),
                float(np.mean(observed.sum(axis=0) == 1)),
            )
        )
    return tuple(found)


def measure_breath(motion: EstimatedMotion) -> float | None:
    """Range of the trunk's displacement by breath over the pairs' moments, mm, where it is largest.

    It is the first singular mode of the trunk's non-rigid motion. None if less than 0.6 of that mode
    points outwards together, or if it is below four times its standard deviation.
    """
    trunk = name_parts(motion.cells) == PARTS.index("trunk")
    if not trunk.any():
        return None
    outward = np.einsum(
        "pci,ci->pc",
        np.array(list(motion.warps.values()))[:, trunk, :3],
        motion.cells.normals[trunk],
    )
    temporal, singular_values, mode = np.linalg.svd(
        outward - outward.mean(axis=0), full_matrices=False
    )
    largest = np.percentile(np.abs(mode[0]), 95.0)
    range_mm = float(np.ptp(temporal[:, 0]) * singular_values[0] * largest)
    same_direction = abs(np.mean(mode[0])) > 0.6 * np.mean(np.abs(mode[0]))
    significant = range_mm > 4.0 * float(np.median(motion.sigma_mm[trunk]))
    return range_mm if same_direction and significant else None


def measure_fullness(motion: EstimatedMotion) -> tuple[float, float] | None:
    """Mean offset of the trunk's front from its position at mean breath, mm, and its sigma.

    None without a trunk.
    """
    breathes = project_breath_on_normals(motion.cells) > 0.5
    if motion.breath is None or not breathes.any():
        return None
    normals = motion.cells.normals[breathes]
    offset = np.sum(motion.breath.field[breathes, :3] * normals, axis=1)
    # The uncertainty is that of the breath's temporal, which all of the front shares.
    return -float(np.mean(offset)), rms(motion.breath.sigma_mm[breathes])
