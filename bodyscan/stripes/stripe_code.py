"""Interface of a stripe code: the images that a projector shows in turn, and how they are decoded.

Each code is one file of `bodyscan.stripes.codes`. Every rig file needs the codes' descriptions, so
anything heavy (numpy, numba, OpenCV) is imported inside methods.
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

from bodyscan.errors import BadInput
from bodyscan.files.model import Model, Problem

if TYPE_CHECKING:
    from bodyscan.arrays import Array, Bytes, Greys
    from bodyscan.stripes.stripe_limits import StripeLimits
    from bodyscan.stripes.stripe_map import StripeMap

DEFAULT_CODE = "gray"


@dataclass(frozen=True)
class ImageKind:
    """Images of one purpose in a sequence, such as the patterns of bits.

    name: its key below `frames` in a rig file.
    template: the names of its images if the rig file does not say.
    number: the field of the template that numbers them from 0, None for a single image.
    max_count: how many there can be.
    """

    name: str
    template: str
    number: str | None = None
    max_count: int = 1


@dataclass(frozen=True, eq=False)
class SequenceImages:
    """A camera's images of a sequence, grey levels, all uint8, or float32 with fractions of levels.

    lit, dark: (H, W); dark is None if not taken.
    coded: (n, H, W) of each kind.
    """

    lit: Greys
    dark: Greys | None
    coded: Mapping[ImageKind, Greys]


Shift = Literal["forward", "backward"]


@dataclass(frozen=True)
class Wave:
    """Image k of `steps` shows 1/2 + 1/2 cos(2 pi ((s - origin) / period -+ k / steps) + start).

    period, origin: stripes.
    start: radians.
    shift: forward if the wave moves to larger s from image to image (the sign before k is minus),
        backward if it moves to smaller s.
    """

    period: float
    steps: int
    shift: Shift = "forward"
    start: float = 0.0
    origin: float = 0.0

    @property
    def sign(self) -> float:
        """Sign of the shift: 1 forward."""
        return 1.0 if self.shift == "forward" else -1.0

    @property
    def first_turn(self) -> float:
        """s / period where image 0 is brightest, modulo 1."""
        return (self.origin / self.period - self.start / 6.283185307179586) % 1.0


class StripeCode(Model):
    """Number, direction and coding of the stripes that a projector shows.

    A code adds the keys that it takes in the rig file as fields, and defines the following.

    kinds: of its images, in the order in which they are shown.
    uses_dark: whether an image without the projector's light is of use.
    is_projected: False for an instrument that projects stripes itself and outputs decoded numbers.
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
        if 1 in (self.stripes, self.crossing.stripes):
            yield ("crossing",), "is for projectors: a laser's single line is a pair by itself"

    @property
    def needs_lit(self) -> bool:
        """Whether it cannot be read without a lit image."""
        return self.needs_dark or not self.is_projected

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
        """The time at which its stripe map holds, in the unit of the images' times (n,) by kind."""
        first = min(float(each.min()) for each in times.values())
        return (first + max(float(each.max()) for each in times.values())) / 2.0

    def pattern_images(self, width: int, height: int) -> Bytes:
        """Render the projector's images (F, height, width) uint8, read-only, in the order of
        `image_counts`, followed by those of the crossing stripes.

        The stripes divide the projector's image evenly. Raises BadInput if they are narrower than
        one of its pixels, or if the code is not projected.
        """
        import numpy as np

        images = [code._pattern_images(width, height) for code in self.directions]
        return images[0] if len(images) == 1 else np.concatenate(images)

    def _pattern_images(self, width: int, height: int) -> Bytes:
        import numpy as np

        if self.stripes < 2:
            raise BadInput(
                "a pair's one line of light is a laser's: there is nothing to project",
                remedy="leave such pairs out, or sweep the line: one stripe for each of its places",
            )
        horizontal = self.direction == "horizontal"
        side, across = ("height", height) if horizontal else ("width", width)
        if self.stripes > across:
            raise BadInput(
                f"{self.stripes} stripes do not fit on {across} projector pixels",
                remedy=f"give the projector's own {side}, or project fewer stripes",
            )
        s = (np.arange(across) + 0.5) * self.stripes / across
        lines = np.concatenate([self.intensity(kind, s) for kind in self.image_counts])
        grey = np.rint(255.0 * lines).astype(np.uint8)
        grey = grey[:, :, None] if horizontal else grey[:, None, :]
        return np.broadcast_to(grey, (len(grey), height, width))

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
