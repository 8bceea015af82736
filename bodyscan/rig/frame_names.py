"""Names of capture folders and of the images of a stripe sequence."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator

from bodyscan.files.model import (
    Model,
    Problem,
    ShotName,
    copy_errors,
    find_duplicates,
    make_unknown_key_error,
)
from bodyscan.rig.templates import find_frame_name_faults, find_path_fault
from bodyscan.stripes.codes import list_image_kinds
from bodyscan.stripes.stripe_code import ImageKind, StripeCode

Names = str | tuple[str, ...]


class CaptureFolder(Model):
    """A folder of captures, relative to the rig file.

    shots: overrides those of its captures.yaml.
    corners: a corners.vnl, relative to the rig file. Its corners of the rig's only board replace
        those of the images that it names; the images themselves need not exist.
    """

    folder: Annotated[str, Field(min_length=1)]
    files: str | None = None
    shots: tuple[ShotName, ...] | None = None
    corners: Annotated[str, Field(min_length=1)] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in find_duplicates(self.shots or ()):
            yield ("shots", index), f"is a shot named twice ({name})"


def _find_name_faults(kind: ImageKind, names: Names) -> Iterator[Problem]:
    if isinstance(names, str):
        numbering = find_frame_name_faults(names, kind.number) if kind.number else ()
        for fault in [*numbering, *filter(None, [find_path_fault(names)])]:
            yield (kind.name,), fault
        return
    if kind.number is None:
        yield (kind.name,), "must be text: there is one image of this kind"
        return
    for index, name in enumerate(names):
        fault = find_path_fault(name)
        if fault:
            yield (kind.name, index), fault


class ImageNames(Model):
    """Names of a code's images, by kind: either a template with the kind's number (such as `{bit}`,
    0 the most significant), or a list with one name per image."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Names] = Field(init=False)

    @model_validator(mode="wrap")
    @classmethod
    def _refuse_unknown_kinds(cls, keys: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(keys, dict):
            return handler(keys)
        known = [*cls.model_fields, *(kind.name for kind in list_image_kinds())]
        errors = [make_unknown_key_error(key, known) for key in keys if key not in known]
        # Strict validation takes JSON's lists as tuples, but does not know that this was JSON.
        named = {k: tuple(v) if isinstance(v, list) else v for k, v in keys.items() if k in known}
        try:
            names = handler(named)
        except ValidationError as refused:
            errors += copy_errors(refused)
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors)
        return names

    def templates(self, kind: ImageKind) -> Names:
        """Return the template or list of names for one kind of image."""
        return (self.model_extra or {}).get(kind.name, self.default(kind))

    def default(self, kind: ImageKind) -> str:
        """Return the template of a kind of image that the rig file does not name."""
        return kind.template

    def kind_names(self, kind: ImageKind, count: int) -> tuple[str, ...]:
        """Return the names of `count` images of one kind, in the code's order."""
        names = self.templates(kind)
        if not isinstance(names, str):
            return names
        if kind.number is None:
            return (names,)
        return tuple(names.format(**{kind.number: number}) for number in range(count))

    def direction_names(self, code: StripeCode) -> tuple[str, ...]:
        """Return the names of a code's images, without crossing stripes, by its `image_counts`."""
        counts = code.image_counts.items()
        return tuple(name for kind, count in counts for name in self.kind_names(kind, count))

    def problems(self) -> Iterator[Problem]:
        for kind in list_image_kinds():
            yield from _find_name_faults(kind, self.templates(kind))


class CrossingNames(ImageNames):
    """Names of the images of crossing stripes."""

    def default(self, kind: ImageKind) -> str:
        return f"crossing-{kind.template}"


class FrameNames(ImageNames):
    """What `{frame}` in the file-name template becomes, for each kind of image.

    lit, dark: the projector fully on, and off; None if there is no such image.
    board: the image in which boards are looked for, if it is not the lit one.

    Besides these there is one key per kind of image of the stripe codes.
    """

    lit: str | None = "lit"
    dark: str | None = "dark"
    board: str | None = None
    crossing: CrossingNames = CrossingNames()

    @property
    def board_image(self) -> str | None:
        """Name of the image in which boards are detected; None if it is made from the code's."""
        return self.board or self.lit

    def code_names(self, code: StripeCode) -> tuple[str, ...]:
        """Return the names of a code's images in the order of its `image_counts`, then those of the
        crossing stripes; without lit and dark."""
        by_direction = zip((self, self.crossing), code.directions, strict=False)
        return tuple(name for names, one in by_direction for name in names.direction_names(one))

    def shown_names(self, code: StripeCode) -> tuple[str, ...]:
        """Return `code_names` in the best order to show them (`StripeCode.show_order`)."""
        by_direction = zip((self, self.crossing), code.directions, strict=False)
        return tuple(
            names.direction_names(one)[k] for names, one in by_direction for k in one.show_order
        )

    def moment_ms(self, code: StripeCode, frame_ms: Mapping[str, float]) -> float:
        """Compute the time at which a code's stripe map holds (`StripeCode.moment`), ms.

        frame_ms: the time of each image by its name.
        """
        import numpy as np

        counts = code.image_counts.items()
        names = {kind.name: self.kind_names(kind, count) for kind, count in counts}
        return code.moment({k: np.array([frame_ms[n] for n in some]) for k, some in names.items()})

    def sequence_names(self, code: StripeCode | None) -> tuple[str, ...]:
        """Return the names of all images of a sequence in the default order of taking them; for a
        camera without a projector, the board image alone."""
        if code is None:
            return tuple(filter(None, [self.board_image]))
        dark = self.dark if any(one.uses_dark for one in code.directions) else None
        return (*filter(None, (self.lit, dark, self.board)), *self.code_names(code))

    def problems(self) -> Iterator[Problem]:
        wrong = list(super().problems())
        single = {"lit": self.lit, "dark": self.dark, "board": self.board}
        for key, name in single.items():
            fault = find_path_fault(name) if name is not None else None
            if fault:
                wrong.append(((key,), fault))
        yield from wrong
        refused = {where[0] for where, _ in wrong}
        names = [*single.values()]
        for one in (self, self.crossing):
            for kind in list_image_kinds():
                if kind.name not in refused:
                    names += one.kind_names(kind, kind.max_count)
        for _, twice in islice(find_duplicates(names), 1):  # not one error for each of a kind
            yield (), f"gives two images the same name ({twice!r})"
