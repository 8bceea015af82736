"""The verdict on a scan, a calibration or an acceptance test: one grade, and the reasons for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

Grade = Literal["good", "accepted", "usable", "not judged", "repeat", "recalibrate", "not accepted"]
Mark = Literal["good", "usable", "bad"]
MARKS: dict[str, Mark] = {
    "good": "good",
    "accepted": "good",
    "usable": "usable",
    "not judged": "usable",
}
"""What a grade stands for; what is not here is bad."""


@dataclass(frozen=True)
class Verdict:
    """A scan is good, usable or to be taken again (repeat); a calibration good, usable or to be done
    again (recalibrate); an acceptance test accepted, not accepted, or not judged.

    reasons: worst first; () where all is well.
    """

    grade: Grade
    reasons: tuple[str, ...] = ()

    @property
    def mark(self) -> Mark:
        return MARKS.get(self.grade, "bad")

    def __str__(self) -> str:
        return "\n  ".join([f"verdict: {self.grade}", *self.reasons])


class Announce(Protocol):
    """Takes a scan's verdict as soon as it is known: as the points have it, before there is a mesh, and
    the final one, which the mesh can only make worse."""

    def __call__(self, verdict: Verdict, *, final: bool) -> None: ...


def say_nothing(verdict: Verdict, *, final: bool) -> None:
    """Where nobody waits for a verdict."""
