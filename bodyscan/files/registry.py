"""Formats by name: each is one module of a package, or an entry point, imported when it is used."""

from __future__ import annotations

import pkgutil
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib import import_module
from importlib.metadata import entry_points
from typing import Generic, TypeVar, cast

from bodyscan.errors import BadInput
from bodyscan.files.model import did_you_mean

Format = TypeVar("Format")


@dataclass(frozen=True)
class Registry(Generic[Format]):
    """The modules of a package, each with a FORMAT, and further registered formats.

    package: its dotted name, also the group of entry points by which other packages add formats.
    what: what its formats hold, such as "a mesh".
    refusal: what an unknown name means for it, in words between `what` and the name.
    """

    package: str
    what: str
    refusal: str = "cannot be written as"
    registered: dict[str, Format] = field(default_factory=dict)

    def names(self) -> tuple[str, ...]:
        """Names of all formats, found without importing them."""
        added = (point.name for point in entry_points(group=self.package))
        return tuple(dict.fromkeys([*self._modules(), *added, *self.registered]))

    def find(self, name: str) -> Format:
        """The format of that name. Raises BadInput, with the list, if there is none."""
        if name in self.registered:
            return self.registered[name]
        if name in self._modules():
            return cast(Format, import_module(f"{self.package}.{name}").FORMAT)
        # Last: every installed package is asked.
        for added in entry_points(group=self.package, name=name):
            return cast(Format, added.load())
        raise make_unknown_format_error(self.what, name, self.names(), refusal=self.refusal)

    def _modules(self) -> list[str]:
        return [one.name for one in pkgutil.iter_modules(import_module(self.package).__path__)]

    def register(self, name: str, format_: Format) -> None:
        """Add a format defined elsewhere. Raises ValueError if the name is taken."""
        if name in self.names():
            raise ValueError(f"there is a format {name!r} already")
        self.registered[name] = format_


def make_unknown_format_error(
    what: str,
    name: str,
    known: Iterable[str],
    where: str = "",
    refusal: str = "cannot be written as",
) -> BadInput:
    """An error that lists the known formats."""
    known = tuple(known)
    return BadInput(
        f"{what} {refusal} {name!r}{did_you_mean(name, known)}",
        where=where,
        remedy=f"choose from {', '.join(known)}",
    )
