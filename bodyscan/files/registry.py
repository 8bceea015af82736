"""Formats by name: each is one module of a package, imported when it is used."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib import import_module
from typing import Generic, TypeVar, cast

from bodyscan.errors import BadInput
from bodyscan.files.model import did_you_mean

Format = TypeVar("Format")


@dataclass(frozen=True)
class Registry(Generic[Format]):
    """The modules of a package, each with a FORMAT, and further registered formats.

    package: its dotted name.
    what: what its formats hold, such as "a mesh".
    """

    package: str
    what: str
    registered: dict[str, Format] = field(default_factory=dict)

    def names(self) -> tuple[str, ...]:
        """Names of all formats, found without importing them."""
        modules = pkgutil.iter_modules(import_module(self.package).__path__)
        return (*(module.name for module in modules), *self.registered)

    def find(self, name: str) -> Format:
        """The format of that name. Raises BadInput, with the list, if there is none."""
        if name not in self.names():
            raise unknown_format_error(self.what, name, self.names())
        if name in self.registered:
            return self.registered[name]
        return cast(Format, import_module(f"{self.package}.{name}").FORMAT)

    def register(self, name: str, format_: Format) -> None:
        """Add a format defined elsewhere. Raises ValueError if the name is taken."""
        if name in self.names():
            raise ValueError(f"there is a format {name!r} already")
        self.registered[name] = format_


def unknown_format_error(what: str, name: str, known: Iterable[str], where: str = "") -> BadInput:
    """An error that lists the known formats."""
    known = tuple(known)
    return BadInput(
        f"{what} cannot be written as {name!r}{did_you_mean(name, known)}",
        where=where,
        remedy=f"choose from {', '.join(known)}",
    )
