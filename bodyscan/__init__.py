"""Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model.

What a Python program needs is here by name, see `bodyscan.api`; it is imported when it is asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from bodyscan.version import __version__ as __version__

if TYPE_CHECKING:
    from bodyscan.api import *  # noqa: F403
else:

    def __getattr__(name: str) -> Any:
        if name.startswith("_") and name != "__all__":
            raise AttributeError(f"module 'bodyscan' has no attribute {name!r}")
        return getattr(import_module("bodyscan.api"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *import_module("bodyscan.api").__all__})
