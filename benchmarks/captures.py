"""Where the real captures are."""

from __future__ import annotations

import os
from pathlib import Path

from bodyscan.captures.folder import Captures, open_captures
from bodyscan.rig.rig import Rig, load_rig

PROJECT = Path(__file__).parents[1]


def open_real(name: str) -> tuple[Rig, Captures]:
    """The rig file rigs/NAME.yaml and its captures, in BODYSCAN_CAPTURES if that is set."""
    path = PROJECT / "rigs" / f"{name}.yaml"
    rig = load_rig(path)
    folder = os.environ.get("BODYSCAN_CAPTURES")
    if folder:
        entries = tuple(
            entry.model_copy(update={"folder": str(Path(folder).resolve() / name)})
            for entry in rig.calibration
        )
        rig = rig.model_copy(update={"calibration": entries})
    return rig, open_captures(rig, path)
