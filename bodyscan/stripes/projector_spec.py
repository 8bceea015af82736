"""What a projector throws: which code, how many stripes, which way they run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field

from bodyscan.files.model import Model, Problem

FrameKind = Literal["pattern", "inverse", "phase", "stripe", "index"]
"""What an image of a code is; `FrameNames` has a name for each."""

DEFAULT_STEPS = 4
DEFAULT_PERIOD = 8
_LARGEST_INDEX = 254


class ProjectorSpec(Model):
    """The stripes a projector throws. `direction` is the way the stripes run in the image.

    inverses: whether each pattern of a Gray or binary code is thrown inverted as well.
    steps, period: of phase-shift, images in one period and stripes in it.
    """

    code: Literal["gray", "binary", "light-section", "stripe-index", "phase-shift"] = "gray"
    stripes: Annotated[int, Field(ge=2, le=65535)]
    direction: Literal["horizontal", "vertical"]
    inverses: bool | None = None
    steps: Annotated[int, Field(ge=3, le=64)] | None = None
    period: Annotated[int, Field(ge=2, le=65535)] | None = None

    @property
    def words(self) -> int:
        """Code words thrown: one a stripe; of phase-shift, one each half period."""
        if self.code == "phase-shift":
            return -(-2 * self.stripes // self.period_stripes)
        return self.stripes

    @property
    def bits(self) -> int:
        """Patterns of the Gray or binary code: ceil(log2(words)); 0 for codes without any."""
        wordless = self.code in ("light-section", "stripe-index")
        return 0 if wordless else max(1, (self.words - 1).bit_length())

    @property
    def has_inverses(self) -> bool:
        """Whether patterns are thrown inverted as well."""
        return self.bits > 0 and self.inverses is not False

    @property
    def phase_steps(self) -> int:
        """Images in a period of phase-shift, 0 for other codes."""
        return (self.steps or DEFAULT_STEPS) if self.code == "phase-shift" else 0

    @property
    def period_stripes(self) -> int:
        """Stripes in a period of phase-shift."""
        return self.period or DEFAULT_PERIOD

    @property
    def takes_dark(self) -> bool:
        """Whether the code has use for a dark image."""
        return self.code not in ("light-section", "stripe-index")

    @property
    def frame_counts(self) -> Mapping[FrameKind, int]:
        """How many images of each kind the code takes, in their order, besides lit and dark."""
        counts: dict[FrameKind, int] = {
            "pattern": self.bits,
            "inverse": self.bits * self.has_inverses,
            "phase": self.phase_steps,
            "stripe": self.stripes * (self.code == "light-section"),
            "index": 1 * (self.code == "stripe-index"),
        }
        return {kind: count for kind, count in counts.items() if count}

    def problems(self) -> Iterator[Problem]:
        return _problems(self)


def _problems(projector: ProjectorSpec) -> Iterator[Problem]:
    code = projector.code
    if projector.inverses is not None and not projector.bits:
        yield ("inverses",), f"is for codes with bits; {code} has none"
    if code == "stripe-index" and projector.stripes > _LARGEST_INDEX:
        wrong = f"must be {_LARGEST_INDEX} or less for stripe-index (got {projector.stripes})"
        yield ("stripes",), wrong
    if code != "phase-shift":
        for key in ("steps", "period"):
            if getattr(projector, key) is not None:
                yield (key,), f"is for code: phase-shift (the code here is {code})"
    elif projector.period_stripes > projector.stripes:
        wrong = f"must be {projector.stripes} (stripes) or less (got {projector.period_stripes})"
        yield ("period",), wrong
