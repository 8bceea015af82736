"""Reading, checking and writing the rig file; see docs/formats.md."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyscan.errors import RigFileError
from bodyscan.files.atomic import write_text
from bodyscan.files.model import Problem
from bodyscan.files.model_file import load_model, validate
from bodyscan.files.yaml_file import dump_yaml
from bodyscan.rig.board import Board
from bodyscan.rig.consistency import RigParts, rig_problems
from bodyscan.rig.frame_names import CaptureFolder, FrameNames
from bodyscan.rig.pair import Pair
from bodyscan.rig.rig import Rig
from bodyscan.rig.rig_frame import Reference, RigFrame

_REMEDY = "Correct the rig file; docs/formats.md explains every key."


def load_rig(path: Path) -> Rig:
    """Read and check a rig file. Raises RigFileError, which lists every problem by line."""
    return load_model(
        Path(path), Rig, RigFileError, remedy=_REMEDY, salvage=_find_problems_of_parts
    )


def write_rig(path: Path, rig: Rig) -> None:
    """Write a rig file that `load_rig` reads back as the same rig (comments are not kept)."""
    data = rig.model_dump(mode="json", exclude_defaults=True)
    write_text(path, dump_yaml({"version": rig.version, **data}))


def _find_problems_of_parts(data: Any) -> Iterator[Problem]:
    """Find what does not fit together in a file that is not a valid rig, as far as it is valid."""
    if not isinstance(data, dict):
        return iter(())
    boards, pairs, folders = (_items(data, key) for key in ("boards", "pairs", "calibration"))
    files = data.get("files", Rig.model_fields["files"].default)
    return rig_problems(
        RigParts(
            board_names=tuple(map(_name, boards)),
            boards=tuple(validate(Board, item) for item in boards),
            pair_names=tuple(map(_name, pairs)),
            pairs=tuple(validate(Pair, item) for item in pairs),
            folders=tuple(validate(CaptureFolder, item) for item in folders),
            references=tuple(validate(Reference, item) for item in _items(data, "references")),
            files=files if isinstance(files, str) else None,
            exposures=tuple(name for name in _items(data, "exposures") if isinstance(name, str)),
            frames=validate(FrameNames, data.get("frames", {})),
            rig_frame=validate(RigFrame, data.get("rig_frame", {})),
        )
    )


def _items(data: dict[str, Any], key: str) -> list[Any]:
    items = data.get(key)
    return items if isinstance(items, list) else []


def _name(item: Any) -> str | None:
    name = item.get("name") if isinstance(item, dict) else None
    return name if isinstance(name, str) else None
