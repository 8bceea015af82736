"""What a stripe code is: the images a projector shows one after the other, and how they are read.

Each code is one file of `bodyscan.stripes.codes`. Every rig file needs the codes' descriptions, so
anything heavy (numpy, numba, OpenCV) is imported inside `intensity` and `decode`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import (
    Field,
    SerializationInfo,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    model_serializer,
)

from bodyscan.files.model import Model, Problem

if TYPE_CHECKING:
    from bodyscan.arrays import Array, Greys
    from bodyscan.stripes.line_bands import LineBands
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

DEFAULT_CODE = "gray"


@dataclass(frozen=True)
class ImageKind:
    """Images of one purpose in a sequence, such as the patterns of bits.

    name: its key below `frames` in a rig file.
    template: the names of its images if the rig file does not say.
    number: the field of the template that numbers them from 0, None for a single image.
    most: how many there can be.
    """

    name: str
    template: str
    number: str | None = None
    most: int = 1


@dataclass(frozen=True, eq=False)
class SequenceImages:
    """What a camera saw of a sequence, grey levels.

    lit, dark: (H, W); dark is None if not taken.
    coded: (n, H, W) of each kind.
    bands: where only boundaries are wanted; codes that can look there alone, and give no s.

    All images are of one type: uint8, or float32 if they hold fractions of grey levels.
    """

    lit: Greys
    dark: Greys | None
    coded: Mapping[ImageKind, Greys]
    bands: LineBands | None = None


class StripeCode(Model):
    """The stripes that a projector shows: how many, which way they run, and how they are told
    apart.

    A code adds the keys that it takes in the rig file as fields, and defines the following.

    kinds: of its images, in the order in which they are shown.
    uses_dark: whether it has use for an image without the projector's light.
    is_projected: False if an instrument projects its own stripes and outputs what it read.
    has_edges: whether its light changes at boundaries of stripes, which then should lie on whole
        projector pixels.
    crossing: stripes that the same projector shows afterwards in the other direction, if any.
    """

    kinds: ClassVar[tuple[ImageKind, ...]]
    uses_dark: ClassVar[bool] = True
    is_projected: ClassVar[bool] = True
    has_edges: ClassVar[bool] = True

    code: str
    stripes: Annotated[int, Field(ge=2, le=65535)]
    direction: Literal["horizontal", "vertical"]
    crossing: SerializeAsAny[StripeCode] | None = None

    @property
    def directions(self) -> tuple[StripeCode, ...]:
        """This code, and the crossing stripes if there are any."""
        return (self,) if self.crossing is None else (self, self.crossing)

    def problems(self) -> Iterator[Problem]:
        if self.crossing is None:
            return
        if self.crossing.direction == self.direction:
            yield ("crossing", "direction"), f"must not be {self.direction} as well: leave it out"
        if self.crossing.crossing is not None:
            yield ("crossing", "crossing"), "is not a key known here: stripes run two ways"
        if not (self.is_projected and self.crossing.is_projected):
            yield ("crossing",), "is for projectors that show images"

    @property
    def needs_lit(self) -> bool:
        """Whether it cannot be read without a lit image."""
        return not self.is_projected

    @property
    def needs_dark(self) -> bool:
        """Whether it cannot be read without a dark image."""
        return False

    @property
    @abstractmethod
    def image_counts(self) -> Mapping[ImageKind, int]:
        """How many images of each kind are shown, in order, without lit and dark, and without those
        of `crossing`, which follow."""

    @property
    def show_order(self) -> tuple[int, ...]:
        """Its images, numbered as in `image_counts`, in the best order to show them."""
        return tuple(range(sum(self.image_counts.values())))

    def moment(self, times: Mapping[str, Array]) -> float:
        """The moment for which its stripe map stands, in the
        unit of the images' times (n,) by kind."""
        first = min(float(each.min()) for each in times.values())
        return (first + max(float(each.max()) for each in times.values())) / 2.0

    @abstractmethod
    def intensity(self, kind: ImageKind, s: Array) -> Array:
        """Images of one kind at stripe coordinates s (N,): (images, N), 0 to 1."""

    def lit_from(self, coded: Mapping[ImageKind, Greys]) -> Greys:
        """The scene under all of the projector's light, (H, W), from images (n, H, W) that each
        show part of it; for a code that does not need a lit image."""
        import numpy as np

        brightest: list[Greys] = [images.max(axis=0) for images in coded.values()]
        whole: Greys = np.max(brightest, axis=0)
        return whole

    @abstractmethod
    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        """The stripe coordinate of every pixel.

        limits: a code may leave out stripes beyond them, and say so in `beyond`; it need not.

        Raises DecodingFailed, naming the image if it can be identified, for inconsistent images.
        """

    @model_serializer(mode="wrap")
    def _with_its_name(
        self, serialize: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """Write `code` even if it is a class's default; in a rig
        file only DEFAULT_CODE may be left out."""
        keys = serialize(self)
        plain = info.exclude_defaults and self.code == DEFAULT_CODE
        return keys if plain else {"code": self.code, **keys}
