"""How the images of a stripe sequence are named."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import (
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)

from bodyscan.files.model import Model, Problem, duplicates, repeated_errors, unknown_key_error
from bodyscan.rig.templates import frame_name_faults, path_fault
from bodyscan.stripes.codes import image_kinds
from bodyscan.stripes.stripe_code import ImageKind, StripeCode

Names = str | tuple[str, ...]


class FrameNames(Model):
    """What `{frame}` becomes in the file-name template, for each kind of image.

    Besides lit and dark there is a key for each kind of image of the stripe codes: a template that
    holds the kind's number (such as `{bit}`, 0 the most significant), or a list, one name an image.
    """

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Names] = Field(init=False)

    lit: str = "lit"
    dark: str | None = "dark"

    @model_validator(mode="wrap")
    @classmethod
    def _refuse_unknown_kinds(
        cls, keys: Any, handler: ModelWrapValidatorHandler[FrameNames]
    ) -> FrameNames:
        if not isinstance(keys, dict):
            return handler(keys)
        known = [*cls.model_fields, *(kind.name for kind in image_kinds())]
        errors = [unknown_key_error(key, known) for key in keys if key not in known]
        # Strict validation, which takes JSON's lists for tuples, no longer sees that it was JSON.
        own = {k: tuple(v) if isinstance(v, list) else v for k, v in keys.items() if k in known}
        try:
            names = handler(own)
        except ValidationError as refused:
            errors += repeated_errors(refused)
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors)
        return names

    def given(self, kind: ImageKind) -> str | tuple[str, ...]:
        """Template or list of one kind of image."""
        return (self.model_extra or {}).get(kind.name, kind.template)

    def of_kind(self, kind: ImageKind, count: int) -> tuple[str, ...]:
        """Names of so many images of one kind, in the code's order."""
        names = self.given(kind)
        return _numbered(names, kind, count) if isinstance(names, str) else names

    def of_code(self, code: StripeCode) -> tuple[str, ...]:
        """Names of a code's images, lit and dark left out, in the order of its `image_counts`."""
        counts = code.image_counts.items()
        return tuple(name for kind, count in counts for name in self.of_kind(kind, count))

    def problems(self) -> Iterator[Problem]:
        return _problems(self)


def _numbered(template: str, kind: ImageKind, count: int) -> tuple[str, ...]:
    if kind.number is None:
        return (template,)
    return tuple(template.format(**{kind.number: number}) for number in range(count))


def _problems(frames: FrameNames) -> Iterator[Problem]:
    all_names = [frames.lit, frames.dark]
    for key, name in (("lit", frames.lit), ("dark", frames.dark)):
        fault = path_fault(name) if name is not None else None
        if fault:
            yield (key,), fault
    for kind in image_kinds():
        names = frames.given(kind)
        faults = list(_name_faults(kind, names))
        yield from faults
        if not faults:
            all_names += frames.of_kind(kind, kind.most)
    for _, twice in duplicates(tuple(all_names)):
        yield (), f"gives two images the same name ({twice!r})"


def _name_faults(kind: ImageKind, names: str | tuple[str, ...]) -> Iterator[Problem]:
    if isinstance(names, str):
        numbering = frame_name_faults(names, kind.number) if kind.number else ()
        for fault in [*numbering, *filter(None, [path_fault(names)])]:
            yield (kind.name,), fault
        return
    if kind.number is None:
        yield (kind.name,), "must be text: there is one image of this kind"
        return
    for index, name in enumerate(names):
        fault = path_fault(name)
        if fault:
            yield (kind.name, index), fault
