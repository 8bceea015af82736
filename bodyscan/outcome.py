"""What a workflow step returns: its value, and what to tell the user about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Value = TypeVar("Value", covariant=True)


@dataclass(frozen=True, eq=False)
class Outcome(Generic[Value]):
    """The result of a workflow step.

    value: what was asked for, as far as it could be had.
    notes: one line for each thing the user should know: what was dropped and why.
    failures: pairs that the step lost, by name, with the reason.
    """

    value: Value
    notes: tuple[str, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
