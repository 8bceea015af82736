"""Scans that went wrong, each with its verdict; quarter-size images, so that a pixel is 2.8 mm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_bodies import ellipsoid, together
from ray_cast_scan import Truth, cast_scan, load_body, load_rig, nominal_placings

from bodyscan.arrays import Array, Indices
from bodyscan.errors import ScanFailed
from bodyscan.fusion.cleaning import apply_mask
from bodyscan.fusion.meshing import make_closed_surface
from bodyscan.fusion.storage import Scan
from bodyscan.geometry.transforms import RigidTransform
from bodyscan.geometry.uncertainty import PoseCovariance
from bodyscan.outcome import Outcome
from bodyscan.reconstruction.range_image import RangeImage
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.rig.rig import Rig, Volume
from bodyscan.settings import AlignmentSettings, FusionSettings, MeshSettings, ScanSettings
from bodyscan.verdict import Announce, Verdict, say_nothing
from bodyscan.workflows.scan_person import fuse

RIG = load_rig()
SETTINGS = ScanSettings(
    fusion=FusionSettings(points=66_000),
    mesh=MeshSettings(depth=7, reach_mm=16.0),  # four times what it is at depth 9, as the cells are
)

NOT_FOLLOWED = SETTINGS.model_copy(update={"alignment": AlignmentSettings(sway_mm=0.0)})
"""Where the verdict is not about motion: who sways is looked for in half of the time of a scan."""


def moved(truth: Truth, shift: list[float]) -> Truth:
    return Truth(truth.vertices + np.asarray(shift), truth.faces)


def joined(*truths: Truth) -> Truth:
    return Truth(*together(*((truth.vertices, truth.faces) for truth in truths)))


@pytest.fixture(scope="module")
def person() -> Truth:
    return load_body(subdivisions=1)


@pytest.fixture(scope="module")
def images(person: Truth) -> list[RangeImage]:
    return photographed(person)


def photographed(truth: Truth) -> list[RangeImage]:
    """By all pairs at one moment: nobody moves meanwhile, which is soon told."""
    images = cast_scan(truth, RIG, scale=0.25, noise_mm=0.1).range_images
    return [replace(image, time_ms=0.0) for image in images]


def untimed(images: Sequence[RangeImage]) -> list[RangeImage]:
    """As cameras take them that do not say when: each pair may have seen another stance."""
    return [replace(image, time_ms=None) for image in images]


def placings() -> dict[str, RigidTransform]:
    return nominal_placings(RIG)


def fused(
    images: list[RangeImage],
    *,
    placed: dict[str, RigidTransform] | None = None,
    failed: dict[str, str] | None = None,
    rig: Rig = RIG,
    volume: Volume = RIG.volume,
    empty: Sequence[RangeImage] = (),
    settings: ScanSettings = SETTINGS,
    announce: Announce = say_nothing,
) -> Scan:
    """What `bodyscan scan` makes of range images, with a calibration good to 0.05 mm."""
    placed = placed or placings()
    sigmas = np.tile([2e-5] * 3 + [0.05] * 3, len(placed))
    covariance = PoseCovariance(tuple(placed), np.diag(sigmas**2))
    rig = rig.model_copy(update={"volume": volume})
    calibration = RigCalibration(rig, {}, placed, covariance, {}, {}, ())
    measured = Outcome(images, failures=failed or {})
    return fuse(calibration, measured, settings, empty=empty, announce=announce)


def said(scan: Scan) -> str:
    return " | ".join((*scan.verdict.reasons, *scan.verdict.consequences))


def test_a_good_scan(images: list[RangeImage]) -> None:
    for taken in (images, untimed(images)):
        verdict = fused(taken).verdict
        assert (verdict.grade, verdict.reasons) == ("good", ())


def test_nobody_in_the_volume(person: Truth) -> None:
    empty = photographed(moved(person, [5000.0, 0.0, 0.0]))
    with pytest.raises(ScanFailed, match="nobody is in the scan volume"):
        fused(empty)


def test_two_people_are_told_before_there_is_a_mesh(
    person: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = joined(moved(person, [-230.0, 0.0, 0.0]), moved(person, [230.0, 0.0, 0.0]))
    told: list[Verdict] = []

    def listen(verdict: Verdict, *, final: bool) -> None:
        assert not final
        told.append(verdict)

    def meshed(*about: Any) -> tuple[Array, Indices]:
        assert [verdict.grade for verdict in told] == ["repeat"]
        return make_closed_surface(*about)

    monkeypatch.setattr("bodyscan.workflows.scan_person.make_closed_surface", meshed)
    scan = fused(photographed(both), settings=NOT_FOLLOWED, announce=listen)
    assert scan.verdict.grade == "repeat"
    assert "two bodies" in said(scan)
    assert "two bodies" in told[0].reasons[0]
    assert set(told[0].reasons) <= set(scan.verdict.reasons)  # a mesh takes nothing back


def test_two_people_hand_in_hand(person: Truth) -> None:
    """In one piece: the scan volume's cells and the cloud's pieces do not tell them apart."""
    apart = 0.5 * float(np.ptp(person.vertices[:, 1])) - 15.0
    both = joined(moved(person, [0.0, -apart, 0.0]), moved(person, [0.0, apart, 0.0]))
    scan = fused(photographed(both), settings=NOT_FOLLOWED)
    assert scan.verdict.grade == "repeat"
    assert "more than one person" in said(scan)


def test_what_always_stands_there_is_cut_away_by_an_empty_scan(person: Truth) -> None:
    """A post beside the person: part of the model, unless a scan of the empty rig shows it."""
    post = Truth(*ellipsoid((120.0, 120.0, 120.0), (-350.0, 350.0, 1000.0), 40))
    with_post = photographed(joined(person, post))
    empty = photographed(post)
    taken = fused(with_post, settings=NOT_FOLLOWED)
    cut = fused(with_post, empty=empty, settings=NOT_FOLLOWED)
    assert "a piece between 9" in said(taken) or "not in the mesh" in said(taken)
    assert cut.verdict.grade == "good", said(cut)
    near = np.linalg.norm(cut.cloud.points - [-350.0, 350.0, 1000.0], axis=1) < 130.0
    assert not near.any()
    assert len(cut.cloud.points) > 0.9 * len(taken.cloud.points) - 3000


def spaced(factor: float) -> Rig:
    """With nominal places so many times as far apart as the cameras are."""
    pairs = []
    for pair in RIG.pairs:
        assert pair.nominal
        x, y, z = (factor * value for value in pair.nominal.position_mm)
        nominal = pair.nominal.model_copy(update={"position_mm": (x, y, z)})
        pairs.append(pair.model_copy(update={"nominal": nominal}))
    return RIG.model_copy(update={"pairs": tuple(pairs)})


def lifted(z_mm: float) -> dict[str, RigidTransform]:
    """All cameras, and with them whatever they see."""
    return {
        n: RigidTransform(at.rotation, at.translation + [0, 0, z_mm])
        for n, at in placings().items()
    }


def test_a_failed_pair_is_named_and_so_are_a_doubtful_size_and_floor(
    images: list[RangeImage],
) -> None:
    without_one = [image for image in images if image.pair != "p2-3"]
    failed = {"p2-3": "bit03.png is missing"}
    scan = fused(
        without_one, failed=failed, placed=lifted(-8.0), rig=spaced(0.96), settings=NOT_FOLLOWED
    )
    assert scan.verdict.grade == "usable"
    assert "p2-3: bit03.png is missing" in said(scan)
    assert "1.042 times as far apart as their nominal poses" in said(scan)
    assert "the floor is at -8 mm" in said(scan)


def test_half_the_pairs_give_half_a_body(images: list[RangeImage]) -> None:
    """One pole of three: the other side is all filled, and the verdict says so."""
    one_pole = [image for image in images if image.pair in ("p2-2", "p2-3")]
    scan = fused(one_pole, failed={"p1-2": "is missing", "p3-2": "is missing"})
    assert scan.verdict.grade == "repeat"
    assert f"{scan.mesh.filled_share:.0%} of the surface was not measured" in said(scan)
    assert "saw nobody" not in said(scan)


def test_who_left_is_missed(images: list[RangeImage]) -> None:
    """Before the third pole fires. Of a child the highest pair sees nothing either."""
    seen = [
        image if image.pair[:2] != "p3" else apply_mask(image, np.zeros(image.valid.shape, bool))
        for image in images
    ]
    heard: list[Verdict] = []

    class Enough(Exception):
        """The mesh would say no more of it."""

    def hear(verdict: Verdict, *, final: bool) -> None:
        heard.append(verdict)
        raise Enough

    with pytest.raises(Enough):
        fused(seen, settings=NOT_FOLLOWED, announce=hear)
    assert heard[0].grade != "good"
    assert "pole p3 saw nobody" in str(heard[0])
    alone = [
        image if image.pair != "p3-4" else apply_mask(image, np.zeros(image.valid.shape, bool))
        for image in images
    ]
    with pytest.raises(Enough):
        fused(alone, settings=NOT_FOLLOWED, announce=hear)
    assert "saw nobody" not in str(heard[1])


def test_what_no_camera_of_the_rig_could_see_is_no_reason_to_repeat(
    images: list[RangeImage],
) -> None:
    """A rig that stands on one side: the mesh's other half is filled in every scan of it."""
    one_side = {name: at for name, at in placings().items() if name in ("p2-2", "p2-3")}
    scan = fused([image for image in images if image.pair in one_side], placed=one_side)
    assert scan.verdict.grade == "usable"
    assert "saw only one side" in said(scan)
    assert "of the surface was not measured" not in said(scan)
    assert "stature" not in said(scan)


def test_the_calibration_of_another_rig(images: list[RangeImage]) -> None:
    rng = np.random.default_rng(3)
    other = {
        name: placing
        @ RigidTransform.from_rotation_vector(rng.normal(0.0, 0.02, 3), rng.normal(0.0, 20.0, 3))
        for name, placing in placings().items()
    }
    scan = fused(untimed(images), placed=other)
    assert scan.verdict.grade == "repeat"
    assert "calibration" in said(scan)


def test_two_pairs_exchanged(images: list[RangeImage]) -> None:
    """Their cables, or their folders: hardly anything overlaps, and what does overlaps well."""
    placed = placings()
    placed["p2-2"], placed["p2-3"] = placed["p2-3"], placed["p2-2"]
    scan = fused(untimed(images), placed=placed)
    assert scan.verdict.grade == "repeat"
    assert "pole p2 and the others disagree" in said(scan)
    assert "exchanged" in said(scan)


def test_a_person_who_stepped_aside(images: list[RangeImage]) -> None:
    """Twelve millimetres between one pole's turn and the next."""
    away = {
        name: RigidTransform(t.rotation, t.translation + [0.0, 12.0 * name.startswith("p3"), 0.0])
        for name, t in placings().items()
    }
    scan = fused(untimed(images), placed=away)
    assert scan.verdict.grade == "repeat"
    assert "moved" in said(scan)


def test_alignment_takes_no_part_if_not_wanted(images: list[RangeImage]) -> None:
    placed = placings()
    known = PoseCovariance(tuple(placed), np.zeros((6 * len(placed), 6 * len(placed))))
    calibration = RigCalibration(RIG, {}, placed, known, {}, {}, ())
    boards_alone = SETTINGS.model_copy(update={"alignment": AlignmentSettings(matching="none")})
    scan = fuse(calibration, Outcome(images, ("as it was said",)), boards_alone)
    assert scan.notes == ("as it was said",)
    assert scan.alignment is None
    assert scan.verdict.grade == "good"
