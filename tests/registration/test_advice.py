"""Which links hold a rig together, and which further shots are suggested."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest
from ring import ring_of_cameras, ring_rig, ring_views

from bodyscan.calibration.board_views import LocatedView
from bodyscan.geometry.camera import Camera
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import position_sigma
from bodyscan.registration.advice import (
    Advice,
    Link,
    ShotSuggestion,
    advise,
    find_articulation_shots,
    find_links,
    minimum_spanning_links,
)
from bodyscan.registration.rig_solve import RigSolution, solve_rig
from bodyscan.rig.rig import Rig

NOISE_PX = 0.03


Ring = tuple[
    Rig,
    dict[str, RigidTransform],
    dict[str, Camera],
    list[LocatedView],
    dict[tuple[str, str], RigidTransform],
    RigSolution,
]


@pytest.fixture(scope="module")
def ring() -> Ring:
    placings, cameras = ring_of_cameras()
    views, truth = ring_views(placings, cameras, noise_px=NOISE_PX)
    rig = ring_rig(placings)
    return rig, placings, cameras, views, truth, solve_rig(rig, views, cameras).value


def again(
    target: tuple[str, str], count: int, ring: Ring, rng: np.random.Generator
) -> list[LocatedView]:
    """`count` shots of the board about where it was, as the true cameras see it."""
    _, placings, cameras, views, truth, _ = ring
    found = []
    for shot in range(count):
        tilt = RigidTransform.from_rotation_vector(rng.normal(0.0, 0.15, 3), np.zeros(3))
        for seen in (view for view in views if view.target == target):
            pose = placings[seen.pair].inverse() @ truth[target] @ tilt
            pixels = cameras[seen.pair].project(pose.apply(seen.points))
            noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
            found.append(LocatedView(seen.pair, f"more{shot}", "board", seen.points, noisy, pose))
    return found


def test_shots_as_advised_reduce_the_sigma_as_told(ring: Ring) -> None:
    rig, _, cameras, views, _, placed = ring
    more = advise(rig, placed).more
    assert more is not None
    extra = again(more.target, more.shots, ring, np.random.default_rng(5))
    solution = solve_rig(rig, [*views, *extra], cameras).value
    centre = solution.rig_from_camera[more.pair].translation
    sigma = np.linalg.norm(position_sigma(solution.covariance, more.pair, centre))
    # The noise is estimated anew, robust weights shift a little, and boards are tilted anew: 15 %.
    assert sigma == pytest.approx(more.after_mm, rel=0.15)


def test_the_worst_pair_is_that_of_the_covariance(ring: Ring) -> None:
    rig, _, _, _, _, placed = ring
    advice = advise(rig, placed)
    sigmas = {
        name: np.linalg.norm(position_sigma(placed.covariance, name, t.translation))
        for name, t in placed.rig_from_camera.items()
    }
    assert advice.worst == max(sigmas, key=lambda name: sigmas[name])
    assert advice.more is not None
    assert advice.more.before_mm == pytest.approx(sigmas[advice.worst], rel=1e-6)
    assert len(minimum_spanning_links(find_links(placed))) == len(sigmas) - 1
    assert not advice.crucial
    assert len(advice.more.visible_to) > 1
    assert f"more like {advice.more.target[0]}" in advice.lines[-1].replace("shots ", "")


def test_links_that_nothing_doubles_are_named() -> None:
    placings, cameras = ring_of_cameras(heights=(700, 1200))
    views, _ = ring_views(placings, cameras, shots=30)
    # The third pole sees the board together with the others in one shot only.
    mixed = {v.shot for v in views if v.pair == "p3-2"} & {
        v.shot for v in views if v.pair == "p1-2"
    }
    bridge = min(mixed)
    kept = [
        v
        for v in views
        if (v.shot == bridge and v.pair in ("p1-2", "p3-2"))
        or (v.shot != bridge and (v.pair[:2] == "p3") == (int(v.shot[1:]) % 2 == 0))
    ]
    rig = ring_rig(placings)
    placed = solve_rig(rig, kept, cameras).value
    advice = advise(rig, placed)
    assert find_articulation_shots(placed) == ((bridge, "board"),)
    # One shot ties it: by far the least known link, and the advice is to tie that pole again.
    links = find_links(placed)
    assert {links[0].first[:2], links[0].second[:2]} == {"p1", "p3"}
    assert advice.weak[0].sigma_mm > 2 * np.median(
        [link.sigma_mm for link in minimum_spanning_links(links)]
    )
    assert {advice.weak[0].first[:2], advice.weak[0].second[:2]} == {"p1", "p3"}
    assert advice.worst.startswith("p3")
    assert advice.more is not None
    assert advice.more.target == (bridge, "board")
    assert advice.more.visible_to == ("p1-2", "p3-2")
    assert advice.more.after_mm < 0.6 * advice.more.before_mm
    assert bridge in "\n".join(advice.lines)


def more(**changes: Any) -> ShotSuggestion:
    keys = {"pair": "a", "shots": 3, "target": ("s07", "big"), "visible_to": ("a", "b", "c"),
            "before_mm": 0.5, "after_mm": 0.24}  # fmt: skip
    return ShotSuggestion(**cast(Any, keys | changes))


def test_what_alone_ties_a_rig_together_is_told_first() -> None:
    crucial, weak = (("s1", "b"), ("s4", "b")), (Link("c", "d", 2, 0.9),)
    assert Advice(weak, crucial, "d", 0.3123, None).lines == [
        "without any one of these shots the rig is disconnected: s1 (b), s4 (b)",
        "weak link: sigma of d relative to c is 0.900 mm (2 shots in common), and no other link "
        "between their parts is better",
        "d has the largest sigma in the rig frame: 0.312 mm",
    ]
    assert len(Advice((), (), "d", 0.3123, None).lines) == 1


def said(**changes: Any) -> str:
    return Advice((), (), "d", 0.3123, more(**changes)).lines[-1]


def test_further_shots_are_told_by_the_shot_that_they_repeat() -> None:
    assert said() == (
        "3 more shots like s07 (board big about there, tilted differently each time, seen by a, b, c) "
        "would halve the sigma of a: 0.500 to 0.240 mm"
    )
    assert "would improve the sigma of a: 0.500 to 0.300" in said(after_mm=0.3)
    assert said(shots=1).startswith("1 more shot like")
    assert said(after_mm=0.4).startswith("3 more shots like")  # four fifths is worth it
    assert said(after_mm=0.401) == (
        "further shots of these boards would improve a little: of all shots, 3 more like s07 help "
        "most, from 0.500 to 0.401 mm"
    )


def test_the_best_chain_leaves_out_what_others_do_better() -> None:
    links = [
        Link("a", "b", 3, 0.1), Link("b", "c", 3, 0.3), Link("a", "c", 9, 0.4), Link("c", "d", 1, 2.0),
    ]  # fmt: skip
    assert minimum_spanning_links(links) == (links[3], links[1], links[0])
    assert minimum_spanning_links([]) == ()
