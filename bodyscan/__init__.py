"""Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model.

The names that a Python program needs are listed in `bodyscan.api`; each is imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from bodyscan.version import __version__ as __version__

if TYPE_CHECKING:
    from bodyscan.api import *  # noqa: F403
else:

    def __getattr__(name: str) -> Any:
        if not name.startswith("_") or name == "__all__":
            api = import_module("bodyscan.api")
            if name == "__all__" or name in api.__all__:
                return getattr(api, name)
        raise AttributeError(f"module 'bodyscan' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted([*import_module("bodyscan.api").__all__, "__version__"])
