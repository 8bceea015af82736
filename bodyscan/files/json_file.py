"""JSON as this program writes it, read from files that anyone may have edited."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from bodyscan.files.regular import read_regular

MOST_BYTES = 100_000_000  # a calibration of sixteen pairs and two hundred shots takes one million


def read_json_object(path: Path) -> dict[str, Any]:
    """The single mapping in a JSON file, with every number finite.

    Raises ValueError for anything else (duplicate keys, NaN, 1e999, half surrogates, too long,
    nested too deeply), BadInput if it is not a regular file, OSError if it cannot be read.
    """
    data = read_regular(path, MOST_BYTES)
    if len(data) > MOST_BYTES:
        raise ValueError(f"is longer than {MOST_BYTES:,} bytes")
    try:
        content = json.loads(
            data.decode("utf-8"),
            parse_float=_finite,
            parse_constant=_finite,
            object_pairs_hook=_without_twins,
        )
    except RecursionError:
        raise ValueError("is nested too deep") from None
    if b"\\ud" in data.lower():
        # Half of a surrogate pair could be read, but never printed or written again.
        json.dumps(content, ensure_ascii=False).encode("utf-8")
    if not isinstance(content, dict):
        raise ValueError("does not hold a mapping")
    return content


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _without_twins(items: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(items)
    if len(content) < len(items):
        names = [name for name, _ in items]
        twin = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twin!r} is given twice in the same place")
    return content
