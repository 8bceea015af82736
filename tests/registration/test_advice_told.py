"""What advice says of links and further shots, and by which links a rig holds together best."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.registration import advice as advice_file
from bodyscan.registration.advice import (
    Advice,
    Link,
    ShotSuggestion,
    _preference,
    advise,
    minimum_spanning_links,
)
from bodyscan.registration.more_shots import MAX_SHOTS, BoardCandidate, SigmaReduction


def more(**changes: Any) -> ShotSuggestion:
    views = tuple(
        tuple(cast(Any, type("Seen", (), {"pair": name})()) for name in names)
        for names in (("a", "b", "c"), ("c", "b", "a", "d"))
    )
    place = BoardCandidate(
        "knee", np.array([10.0, -20.0, 499.6]), 91.0, (RigidTransform.identity(),), views
    )
    keys = {"pair": "a", "shots": 3, "between": ("a", "b"), "candidate": place, "before_mm": 0.5,
            "after_mm": 0.24, "halves": True}  # fmt: skip
    return ShotSuggestion(**cast(Any, keys | changes))


def advice(
    *bridges: Link, weak: tuple[Link, ...] = (), shots: ShotSuggestion | None = None
) -> list[str]:
    crucial = (("s1", "b"), ("s4", "b")) if bridges else ()
    return Advice((), (), bridges, weak, crucial, "d", 0.3123, shots).lines


def test_what_alone_ties_a_rig_together_is_told_first() -> None:
    assert advice(
        Link("a", "b", 1, 0.2), Link("a", "c", 4, 0.1), weak=(Link("c", "d", 2, 0.9),)
    ) == [
        "a and b, with 1 shot in common, are the only link between two parts of the rig",
        "a and c, with 4 shots in common, are the only link between two parts of the rig",
        "without any one of these shots the rig is disconnected: s1 (b), s4 (b)",
        "weak link: sigma of d relative to c is 0.900 mm (2 shots in common), and no other link "
        "between their parts is better",
        "d has the largest sigma in the rig frame: 0.312 mm",
    ]
    assert len(advice()) == 1


def said(**changes: Any) -> str:
    return advice(shots=more(**changes))[-1]


def test_further_shots_are_told_with_where_to_hold_the_board() -> None:
    assert said() == (
        "3 more shots seen by both a and b (also by c), board at knee height (middle at 10, -20, 500 "
        "mm, facing the subject's left, tilted in turn in all directions), would halve the sigma of "
        "a: 0.500 to 0.240 mm"
    )
    assert "would improve a, though not by half: 0.500 to 0.300" in said(after_mm=0.3, halves=False)
    assert said(shots=1).startswith("1 more shot seen")
    assert said(after_mm=0.4).startswith("3 more shots seen")  # four fifths is worth it
    assert said(after_mm=0.401) == (
        "further shots of this board would improve a little: 3 more reduce its sigma from 0.500 to "
        "0.401 mm"
    )


@pytest.mark.parametrize(
    ("degrees", "way"),
    [
        (0.0, "front"), (22.0, "front"), (23.0, "front left"), (112.0, "left"), (135.0, "back left"),
        (180.0, "back"), (225.0, "back right"), (-90.0, "right"), (-45.0, "front right"),
        (338.0, "front"),
    ],
)  # fmt: skip
def test_ways_are_told_as_the_subject_has_them(degrees: float, way: str) -> None:
    place = more().candidate
    turned = BoardCandidate(
        place.height, place.centre_mm, degrees, place.rig_from_board, place.views
    )
    assert f"facing the subject's {way}," in said(candidate=turned)


def test_a_place_is_seen_by_those_who_see_every_tilt() -> None:
    place = more().candidate
    assert place.visible_to == ("a", "b", "c")
    two = place.restrict_to(("a", "d"))
    assert two.visible_to == ("a",)
    assert [len(tilt) for tilt in two.views] == [1, 2]


def test_the_best_chain_leaves_out_what_others_do_better() -> None:
    links = [
        Link("a", "b", 3, 0.1), Link("b", "c", 3, 0.3), Link("a", "c", 9, 0.4), Link("c", "d", 1, 2.0),
    ]  # fmt: skip
    assert minimum_spanning_links(links) == (links[3], links[1], links[0])
    assert minimum_spanning_links([]) == ()


def test_a_sigma_is_halved_where_its_variance_is_a_quarter() -> None:
    def to_halve(*after: float) -> int | None:
        return SigmaReduction(1.0, np.array(after)).shots_to_halve

    assert to_halve(0.6, 0.26, 0.25, 0.1) == 3
    assert to_halve(0.2, 0.1) == 1
    assert to_halve(0.6, 0.251) is None


def test_fewest_shots_are_preferred_and_then_what_gains_most() -> None:
    def gained(*after: float) -> SigmaReduction:
        rest = [after[-1]] * (MAX_SHOTS - len(after))
        return SigmaReduction(1.0, np.array([*after, *rest]))

    two, three = gained(0.5, 0.2), gained(0.5, 0.3, 0.2)
    sharper, never, hardly = gained(0.5, 0.1), gained(0.4), gained(0.9)
    last = SigmaReduction(1.0, np.array([0.9] * (MAX_SHOTS - 1) + [0.2]))
    order = sorted([hardly, three, last, never, two, sharper], key=_preference)
    assert order == [sharper, two, three, last, never, hardly]


def row_of_pairs(last_mm2: float) -> Any:
    """a, b, c and d, each of which shares shots with the next, two of c and d; shifts are known to a
    variance of 0.5 along each axis, and d's to another."""
    names = ("a", "b", "c", "d")
    shared = (("a", "b", "s1"), ("b", "c", "s2"), ("c", "d", "s3"), ("c", "d", "s4"))
    views = [
        SimpleNamespace(pair=pair, shot=shot, target=(shot, "board"))
        for one, other, shot in shared
        for pair in (one, other)
    ]
    variances = np.zeros((4, 6))
    variances[:, 3:] = [[0.5], [0.5], [0.5], [last_mm2]]
    return SimpleNamespace(
        views=views,
        rig_from_camera=dict.fromkeys(names, RigidTransform.identity()),
        covariance=PoseCovariance(names, np.diag(variances.ravel())),
    )


@pytest.mark.parametrize(("last_mm2", "weak"), [(3.4, False), (3.6, True)])
def test_a_link_is_weak_that_is_known_half_as_well_as_usual(
    last_mm2: float, weak: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Others have a variance of 1 along each axis; this one of 4 is twice as far off."""
    monkeypatch.setattr(advice_file, "more_shots", lambda *of: None)
    nothing: Any = None
    found = advise(nothing, row_of_pairs(last_mm2))
    assert [(link.first, link.second, link.shots) for link in found.links] == [
        ("c", "d", 2), ("a", "b", 1), ("b", "c", 1),
    ]  # fmt: skip
    assert found.links[0].sigma_mm == pytest.approx(np.sqrt(3.0 * (0.5 + last_mm2)))
    assert found.links[1].sigma_mm == pytest.approx(np.sqrt(3.0))
    assert [link.second for link in found.weak] == (["d"] if weak else [])
    assert found.bridges == found.links, "no link doubles another"
    assert found.crucial == (("s1", "board"), ("s2", "board"))
    assert found.worst == "d"
    assert found.worst_sigma_mm == pytest.approx(np.sqrt(3.0 * last_mm2))
