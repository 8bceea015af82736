"""Rigs of the real captures, wherever those lie."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import yaml

RIGS = Path(__file__).parents[2] / "rigs"


def real_rig_file(
    name: str, captures: Path, folder: Path, shots: Sequence[str] | None = None
) -> Path:
    """rigs/NAME.yaml, written into `folder` with its captures, and the files of what is known already,
    where they lie on this machine: all captures, or only some shots."""
    rig = yaml.safe_load((RIGS / f"{name}.yaml").read_text("utf-8"))
    for pair in rig["pairs"]:
        if "known" in pair:
            known = pair["known"]
            known["file"] = str(captures.resolve() / name / Path(known["file"]).name)
    for entry in rig.get("calibration", ()):
        entry["folder"] = str(captures.resolve() / name)
        if "corners" in entry:
            entry["corners"] = str(captures.resolve() / name / Path(entry["corners"]).name)
        if shots is not None:
            entry["shots"] = list(shots)
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps(rig), "utf-8")
    return path
