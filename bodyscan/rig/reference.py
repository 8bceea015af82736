"""A certified length seen in calibration captures, which fixes the size of the whole rig."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveFloat

from bodyscan.files.model import Model, Name


class Reference(Model):
    """One board whose length was certified, or a bar that carries two boards.

    length_mm: of one board, between the first and the last corner of a row; of two, between their
        middles.
    sigma_mm: standard deviation of the length, from the certificate.
    """

    name: Name
    boards: Annotated[tuple[Name, ...], Field(min_length=1, max_length=2)]
    length_mm: PositiveFloat
    sigma_mm: PositiveFloat
