"""Checks of the pairs and of the rig's calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from bodyscan.fusion.verdict.evidence import Finding, ScanEvidence
from bodyscan.verdict import LEFT_OUT


def check_pairs(scan: ScanEvidence) -> Iterator[Finding]:
    """Pairs without a range image, and pairs that alignment refused."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in scan.images.failed.items():
        by_reason.setdefault(reason.replace(name, "*"), []).append(name)
    for names in by_reason.values():
        yield "usable", f"{LEFT_OUT}{', '.join(names)}: {scan.images.failed[names[0]]}"
    for name in scan.alignment.refused if scan.alignment else ():
        yield (
            "repeat",
            f"pair {name} does not fit the others. Possible causes: it was moved since the "
            "calibration; the person moved far between the captures",
        )


def find_silent_poles(
    poles: Mapping[str, str], working: Sequence[str], seeing: Sequence[str]
) -> tuple[str, ...]:
    """Poles of which no pair saw anybody, though several were to; one may look over a child's head.

    poles: the pole of each pair. working: pairs that took part. seeing: those that saw the subject.
    """
    count = Counter(poles[name] for name in working if name in poles)
    seeing_poles = {poles.get(name) for name in seeing}
    return tuple(pole for pole, n in count.items() if n > 1 and pole not in seeing_poles)


def check_silent_poles(scan: ScanEvidence) -> Iterator[Finding]:
    """Poles that saw nobody; `check_gaps` reports how much of the body is missing."""
    for name in scan.images.silent:
        yield (
            "usable",
            f"pole {name} saw nobody where the others saw a person. Possible causes: the person left, "
            "or came, while poles took turns; the pole's projector was off",
        )


def check_calibration(scan: ScanEvidence) -> Iterator[Finding]:
    """Imported calibrations, whose accuracy is unknown."""
    if scan.rig.unjudged:
        yield (
            "usable",
            f"the calibration of {', '.join(scan.rig.unjudged)} was imported, and its accuracy is "
            "unknown: sigmas include the decoding alone",
        )


def check_nominal_size(scan: ScanEvidence) -> Iterator[Finding]:
    """The rig's size, because whoever scans need not have read the notes on the calibration."""
    size = scan.rig.nominal
    if size is None or size.mark == "good":
        return
    yield (
        "repeat" if size.mark == "bad" else "usable",
        f"{size.words}, and every girth may be wrong by the same share: {size.remedy}",
    )


def check_stripe_directions(scan: ScanEvidence) -> Iterator[Finding]:
    """Depths from stripes of two directions that differ by more than noise."""
    for name, agreement in scan.images.agreements.items():
        if agreement.moderate:
            yield (
                "usable",
                f"pair {name}: depths from the two stripe directions differ by "
                f"{agreement.description}. Its calibration is wrong by as much, which sigmas do "
                "not include",
            )
