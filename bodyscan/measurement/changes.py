"""Changes of a person's named measures from an earlier scan to a later one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bodyscan.measurement.named import NamedMeasures


@dataclass(frozen=True)
class Change:
    """How much larger a measure is in the later scan, mm, with its 95 % interval."""

    name: str
    mm: float
    interval_mm: tuple[float, float]
    # Why nothing can be said: the person stood otherwise, which alone may change it; "" if nothing.
    reason: str

    @property
    def is_certain(self) -> bool:
        """Whether the measure changed, beyond what both scans leave open (95 %)."""
        low, high = self.interval_mm
        return not self.reason and not low <= 0.0 <= high


@dataclass(frozen=True)
class MeasureChanges:
    """Changes since an earlier scan."""

    # Of the earlier scan.
    subject: str | None
    when: str | None
    # With another one its scale may be another, which no interval holds.
    same_calibration: bool
    measures: tuple[Change, ...]


def find_changes(earlier: NamedMeasures, later: NamedMeasures) -> tuple[Change, ...]:
    """Changes of all measures that both scans have.

    The errors of both count as independent. On one person the errors of the template's landmarks are
    correlated, which makes the intervals too wide rather than too narrow; the scale of one
    calibration cancels.
    """
    changes = []
    for name, now in later.measures.items():
        if then := earlier.measures.get(name):
            change = now.mm - then.mm
            low, high = (abs(end - now.mm) for end in now.interval_mm)
            low_then, high_then = (abs(end - then.mm) for end in then.interval_mm)
            interval = change - np.hypot(low, high_then), change + np.hypot(high, low_then)
            otherwise = bool(now.stance) != bool(then.stance)
            reason = "stood otherwise" if otherwise else ""
            changes.append(Change(name, change, (float(interval[0]), float(interval[1])), reason))
    return tuple(changes)
