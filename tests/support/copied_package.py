"""The package as someone would have it who put one file of their own into it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import bodyscan


def run_with_file(
    folder: Path, module: ModuleType, place: str, *arguments: object
) -> subprocess.CompletedProcess[str]:
    """A bodyscan command run in `folder`, by a copy of the package there that holds the file of
    `module` in its `place` ("export/formats/xyz.py") and is otherwise as it was."""
    package = Path(bodyscan.__file__).parent
    copy = folder / "bodyscan"
    shutil.copytree(package, copy, ignore=shutil.ignore_patterns("__pycache__"))
    assert module.__file__ is not None
    shutil.copy(module.__file__, copy / place)
    return subprocess.run(
        [sys.executable, "-m", "bodyscan", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": str(folder), "NUMBA_DISABLE_JIT": "1"},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
