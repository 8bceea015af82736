"""What a stripe code is: the images a projector shows one after the other, and how they are read.

Each code is one file of `bodyscan.stripes.codes`. Every rig file needs the codes' descriptions, so
what is heavy (numpy, numba, OpenCV) is imported inside `intensity` and `decode`.
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
    from bodyscan.stripes.one_moment import Moments
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

DEFAULT_CODE = "gray"


@dataclass(frozen=True)
class ImageKind:
    """Images of one purpose in a sequence, such as the patterns of bits.

    name: its key below `frames` in a rig file.  template: how its images are named if the rig file
    does not say.  number: the field of the template that numbers them from 0, None for a single
    image.  most: how many there can be.
    """

    name: str
    template: str
    number: str | None = None
    most: int = 1


@dataclass(frozen=True, eq=False)
class SequenceImages:
    """What a camera saw of a sequence, grey levels.

    lit, dark: (H, W); no dark where none was taken.  coded: (n, H, W) of each kind.  All of one type:
    uint8, or float32 where parts of grey levels are known.  moments: when they were taken, if what
    moved meanwhile is to be told and taken out by codes that can.  bands: where boundaries alone are
    wanted; codes that can look there only, and give no s.
    """

    lit: Greys
    dark: Greys | None
    coded: Mapping[ImageKind, Greys]
    moments: Moments | None = None
    bands: LineBands | None = None


class StripeCode(Model):
    """The stripes that a projector shows: how many, which way they run, and how they are told apart.

    A code adds the keys that the rig file may give it as fields, and what follows here.

    kinds: of its images, in the order in which they are shown.  uses_dark: whether it has use for an
    image without the projector's light.  is_projected: False where an instrument projects stripes
    of its own and hands out what it read.  has_edges: whether its light changes at boundaries of
    stripes, which then lie best on whole projector pixels.
    crossing: stripes that the same projector shows the other way after these, if it does.
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
        """Itself, and the stripes that cross them if there are any."""
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
        """How many images of each kind are shown, in their order, besides lit and dark; those of
        `crossing`, which follow, left out."""

    @property
    def show_order(self) -> tuple[int, ...]:
        """Its images, numbered as in `image_counts`, in the order in which they are best shown."""
        return tuple(range(sum(self.image_counts.values())))

    def moment(self, times: Mapping[str, Array]) -> float:
        """The moment for which its stripe map stands, in the unit of the images' times (n,) by kind."""
        first = min(float(each.min()) for each in times.values())
        return (first + max(float(each.max()) for each in times.values())) / 2.0

    @abstractmethod
    def intensity(self, kind: ImageKind, s: Array) -> Array:
        """Of the images of one kind at stripe coordinates s (N,): (images, N), 0 to 1."""

    def lit_from(self, coded: Mapping[ImageKind, Greys]) -> Greys:
        """(H, W): the scene under all of the projector's light, from images (n, H, W) that each
        show a part of it; for a code that does not need a lit image."""
        import numpy as np

        brightest: list[Greys] = [images.max(axis=0) for images in coded.values()]
        whole: Greys = np.max(brightest, axis=0)
        return whole

    @abstractmethod
    def decode(self, images: SequenceImages, limits: StripeLimits | None) -> StripeMap:
        """The stripe coordinate of every pixel.

        limits: a code may leave out stripes beyond them, and say so in `beyond`; it need not.
        Raises DecodingFailed, naming the image where it can be told, if they do not add up.
        """

    @model_serializer(mode="wrap")
    def _with_its_name(
        self, serialize: SerializerFunctionWrapHandler, info: SerializationInfo
    ) -> dict[str, Any]:
        """`code` is a default of each class; of a rig file only one of them is."""
        keys = serialize(self)
        plain = info.exclude_defaults and self.code == DEFAULT_CODE
        return keys if plain else {"code": self.code, **keys}
