"""The verdict on a scan, a calibration or an acceptance test: one grade and its reasons."""

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
"""The mark that each grade stands for; any other grade is bad."""
STYLES: dict[Mark, str] = {"good": "green", "usable": "yellow", "bad": "red"}
"""The colour in which a terminal shows a grade of each mark."""

LEFT_OUT = "left out: "
"""Begins a reason that names pairs that were lost, then a colon and why."""


@dataclass(frozen=True)
class Verdict:
    """A grade with its reasons.

    grade: of a scan good, usable or repeat; of a calibration good, usable or recalibrate; of an
        acceptance test accepted, not accepted or not judged.
    reasons: worst first; () if there is nothing to report.
    consequences: what the reasons explain, and what therefore is none.
    """

    grade: Grade
    reasons: tuple[str, ...] = ()
    consequences: tuple[str, ...] = ()

    @property
    def mark(self) -> Mark:
        return MARKS.get(self.grade, "bad")

    def __str__(self) -> str:
        lines = [f"verdict: {self.grade}", *self.reasons]
        if self.consequences:
            more = f"; and {len(self.consequences) - 4} more" if len(self.consequences) > 4 else ""
            lines.append(f"this explains: {'; '.join(self.consequences[:4])}{more}")
        return "\n  ".join(line.replace("\n", "\n  ") for line in lines)


class Announce(Protocol):
    """Receives a scan's verdict as soon as it is known.

    It is called with the verdict on the points, before there is a mesh, and with the final one,
    which the mesh can only make worse.
    """

    def __call__(self, verdict: Verdict, *, final: bool) -> None: ...


def say_nothing(verdict: Verdict, *, final: bool) -> None:
    """An `Announce` that does nothing."""
