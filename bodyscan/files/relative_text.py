"""Stored messages name files relative to a folder, not by where that folder is.

Folders are named after people, and the same work elsewhere must give the same bytes.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path


def relative_text(text: str, base: Path, below: Iterable[Path] = ()) -> str:
    """`text` with every path that begins with `base`, or with one of the folders `below`, made
    relative to `base`."""
    for folder in (*below, base):
        short = os.path.relpath(folder, base)
        to = "" if short == os.curdir else f"{Path(short).as_posix()}/"
        for known in {str(folder), os.path.abspath(folder)} - {os.curdir}:
            # Not in the middle of another path.
            text = re.sub(
                rf"(?<![\w./-]){re.escape(known.rstrip('/'))}/", to.replace("\\", "/"), text
            )
    return text
