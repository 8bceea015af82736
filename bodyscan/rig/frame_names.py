"""How the images of a stripe sequence are named."""

from __future__ import annotations

from collections.abc import Iterator

from bodyscan.files.model import Model, Problem, duplicates
from bodyscan.rig.templates import frame_name_faults, path_fault
from bodyscan.stripes.projector_spec import FrameKind, ProjectorSpec

NUMBERED: dict[FrameKind, str] = {
    "pattern": "bit",
    "inverse": "bit",
    "phase": "step",
    "stripe": "stripe",
}
"""Kinds of images of which there are several, and what numbers them."""

_MOST = {"bit": 16, "step": 64, "stripe": 1000}


class FrameNames(Model):
    """What `{frame}` becomes in the file-name template, for each kind of image.

    `pattern` and `inverse` hold `{bit}` (0 is the most significant), `phase` holds `{step}` and
    `stripe` `{stripe}`; or they are lists, one name an image.
    """

    lit: str = "lit"
    dark: str | None = "dark"
    pattern: str | tuple[str, ...] = "bit{bit:02d}"
    inverse: str | tuple[str, ...] = "bit{bit:02d}-inverse"
    phase: str | tuple[str, ...] = "phase{step:02d}"
    stripe: str | tuple[str, ...] = "stripe{stripe:03d}"
    index: str = "index"

    def of_kind(self, kind: FrameKind, count: int) -> tuple[str, ...]:
        """Names of so many images of one kind, in the code's order."""
        names = getattr(self, kind)
        if isinstance(names, str):
            return tuple(names.format(bit=i, step=i, stripe=i) for i in range(count))
        return tuple(names)

    def of_code(self, projector: ProjectorSpec) -> tuple[str, ...]:
        """Names of a code's images, lit and dark left out, in the order of `frame_counts`."""
        counts = projector.frame_counts.items()
        return tuple(name for kind, count in counts for name in self.of_kind(kind, count))

    def problems(self) -> Iterator[Problem]:
        return _problems(self)


def _problems(frames: FrameNames) -> Iterator[Problem]:
    all_names = []
    for kind, name in (("lit", frames.lit), ("dark", frames.dark), ("index", frames.index)):
        fault = path_fault(name) if name is not None else None
        if fault:
            yield (kind,), fault
        all_names.append(name)
    for kind, number in NUMBERED.items():
        names = getattr(frames, kind)
        faults = list(_numbered_name_faults(kind, number, names))
        yield from faults
        if not faults and isinstance(names, str):
            all_names += [names.format(**{number: i}) for i in range(_MOST[number])]
        elif not faults:
            all_names += names
    for _, twice in duplicates(tuple(all_names)):
        yield (), f"gives two images the same name ({twice!r})"


def _numbered_name_faults(
    kind: str, number: str, names: str | tuple[str, ...]
) -> Iterator[Problem]:
    if isinstance(names, str):
        for fault in [*frame_name_faults(names, number), *filter(None, [path_fault(names)])]:
            yield (kind,), fault
        return
    for index, name in enumerate(names):
        wrong = path_fault(name)
        if wrong:
            yield (kind, index), wrong
