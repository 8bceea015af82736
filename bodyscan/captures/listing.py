"""Look-ups in a capture folder that never leave it."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from bodyscan.errors import CaptureError
from bodyscan.rig.templates import ANYTHING, compile_names


class Listing:
    """Reads each folder once; refuses symbolic links that lead out of the capture folder unless
    `follow_links`."""

    def __init__(
        self, root: Path, *, follow_links: bool = False, named: Iterable[str] = ()
    ) -> None:
        """named: files that count as present, such as images whose corners are known.

        Raises CaptureError if `root` is not a folder and `named` is empty.
        """
        self._named: dict[str, dict[str, bool]] = {}
        for path in named:
            while path:
                folder, _, name = path.rpartition("/")
                self._named.setdefault(folder, {})[name] = False
                path = folder
        if not root.is_dir() and not (self._named and not root.exists()):
            what = "is not a folder" if root.exists() else "does not exist"
            remedy = "Check the folder's name, and that its disk is connected."
            remedy = "Write / between folders, not \\." if "\\" in str(root) else remedy
            raise CaptureError(f"the capture folder {what}", where=str(root), remedy=remedy)
        self.root, self.follow_links = root, follow_links
        self._real_root = os.path.realpath(root)
        self._entries: dict[str, dict[str, bool]] = {}

    def has(self, relative: str, *, broken: bool = False) -> bool:
        """Test whether a file or folder with that relative path (parts joined by /) exists.

        broken: a link that leads nowhere counts, too.
        """
        parent, _, name = relative.rpartition("/")
        is_link = self._read(parent).get(name)
        if is_link is None:
            return False
        if not is_link:
            return True
        path = self.root / relative
        real = os.path.realpath(path)
        if not (self.follow_links or Path(real).is_relative_to(self._real_root)):
            raise CaptureError(
                f"is a symbolic link that leads out of the capture folder, to {real}",
                where=str(path),
                remedy="If it is meant, write `follow_links: true` in the rig file, or say "
                "--follow-links to `scan` or `check-calibration`; else copy what it points to here, "
                "or name that folder.",
            )
        return broken or path.exists()

    def find(self, relative: str) -> str:
        """Replace a path that contains `*` by the file that matches if there is just one."""
        if ANYTHING not in relative:
            return relative
        matches = [""]
        for part, wanted in zip(relative.split("/"), compile_names(relative), strict=True):
            matches = [
                f"{folder}/{name}".lstrip("/")
                for folder in matches
                for name in (self.names(folder) if ANYTHING in part else (part,))
                if wanted.fullmatch(name)
            ]
        existing = [path for path in matches if self.has(path)]
        return existing[0] if len(existing) == 1 else relative

    def names(self, relative: str) -> tuple[str, ...]:
        """List the names in a folder, () if it does not exist. "" is the root."""
        return tuple(self._read(relative))

    def _read(self, relative: str) -> dict[str, bool]:
        """List the names in a folder, and whether each is a symbolic link."""
        if relative not in self._entries:
            exists = relative == "" or self.has(relative)
            found = self._scan(self.root / relative) if exists else {}
            self._entries[relative] = self._named.get(relative, {}) | found
        return self._entries[relative]

    def _scan(self, folder: Path) -> dict[str, bool]:
        try:
            with os.scandir(folder) as entries:
                return {entry.name: entry.is_symlink() for entry in entries}
        except NotADirectoryError:
            return {}
        except FileNotFoundError:
            if self._named:
                return {}
            raise CaptureError("has disappeared", where=str(folder)) from None
        except OSError as error:
            what = f"cannot be read: {error.strerror}"
            raise CaptureError(what, where=str(folder), remedy="Check its permissions.") from None
