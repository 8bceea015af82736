"""Where a result came from, as far as a report has to say: simulated, or not known to be."""

from __future__ import annotations

from pathlib import Path

SIMULATED_SUBJECT = "sim-"
"""What the simulator's pseudonyms begin with."""
LEVELS = 3
"""So many folders above a result are looked at: a batch's lie deeper than a single scan's."""


def is_synthetic(folder: Path, subject: str | None = None) -> bool:
    """Whether the simulator's truth lies beside a result, or its subject is the simulator's."""
    above = (folder.resolve(), *folder.resolve().parents[:LEVELS])
    return (subject or "").startswith(SIMULATED_SUBJECT) or any(
        (place / "truth" / "truth.json").is_file() for place in above
    )
