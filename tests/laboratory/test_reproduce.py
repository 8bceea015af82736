"""The chapter's experiments once, coarsely: images rendered, decoded, every approach calibrated."""

from pathlib import Path

import numpy as np
import pytest

from bodyscan.laboratory import apparatus
from bodyscan.laboratory.apparatus import ChapterCaptures, take_captures
from bodyscan.laboratory.approaches import Calibrations, calibrate_all
from bodyscan.laboratory.measuring import (
    ApproachAccuracy,
    compare_point_sigmas,
    make_true_approach,
    measure_artefacts,
    triangulate_pixels,
)
from bodyscan.laboratory.reproduce import Reproduction, draw, name_figures, render_reproduction

Measured = dict[bool, dict[str, ApproachAccuracy]]


@pytest.fixture(scope="module")
def captures() -> ChapterCaptures:
    # Two rays a pixel each way: boundaries are then some 0.02 px worse than in the real run.
    return take_captures(
        apparatus.build_chapter_setup(apparatus.make_ideal_settings(2)), stage_stops=3
    )


@pytest.fixture(scope="module")
def calibrated(captures: ChapterCaptures) -> Calibrations:
    return calibrate_all(captures)


@pytest.fixture(scope="module")
def measured(captures: ChapterCaptures, calibrated: Calibrations) -> Measured:
    approaches = [*calibrated.approaches, make_true_approach(captures.setup)]
    return {
        whole: {
            m.name: m for m in (measure_artefacts(a, captures, whole=whole) for a in approaches)
        }
        for whole in (True, False)
    }


def test_boards_and_stage_are_wholly_in_the_picture(captures: ChapterCaptures) -> None:
    assert len(captures.boards) == 3
    assert len(captures.stage) == 3
    for shot in (*captures.boards, *captures.stage):
        assert len(shot.view.corner_ids) == 48


def test_corners_are_the_simulated_boards(captures: ChapterCaptures) -> None:
    camera = captures.setup.view.camera
    places = [*apparatus.list_board_poses(), *apparatus.stage_poses(apparatus.stage_readings(3), 0)]
    for shot, place in zip((*captures.boards, *captures.stage), places, strict=True):
        true = camera.image(place.apply(captures.setup.board.corners))[shot.view.corner_ids]
        # Two rays a pixel move an edge by up to 0.1 px in one pixel; a corner has thirty of them.
        assert np.sqrt(np.mean((shot.view.pixels - true) ** 2)) < 0.04


def test_true_stripes_and_true_calibration_leave_nothing(captures: ChapterCaptures) -> None:
    truth = make_true_approach(captures.setup)
    for number, centre in enumerate(apparatus.CENTRES):
        own = captures.owner == number
        points = triangulate_pixels(truth, captures.spheres.truth.s, own)
        # 0.0005 mm of facets, and float32 in the ray caster.
        assert np.abs(np.linalg.norm(points - centre, axis=1) - 25.0).max() < 0.003
    assert measure_artefacts(truth, captures).plate_systematic_mm < 1e-3


def test_a_smile_belongs_to_the_truth() -> None:
    """Under real light as well nothing is left of points that the true light says."""
    setup = apparatus.build_chapter_setup(apparatus.make_real_settings(1))
    truth = make_true_approach(setup)
    u, v = np.meshgrid(np.arange(200.0, 500.0, 30.0), np.arange(150.0, 400.0, 30.0))
    rays = truth.camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    true = rays * 400.0
    s = setup.projector.stripe(true)
    depth = truth.sheets.intersect(rays, s).depth
    # Planes without the smile are 0.04 mm off, RMS, and 0.1 at the fan's ends.
    assert np.abs(depth - 400.0).max() < 1e-6
    slope = truth.sheets.intersect(rays, s).per_stripe
    beyond = setup.projector.stripe(true + 0.1 * rays)
    assert np.allclose(0.1 / slope, beyond - s, rtol=0.01)


def test_whole_stripes_hide_the_calibration(measured: Measured) -> None:
    third = measured[True]["(iii)"]
    for name, one in measured[True].items():
        # The trial: 0.31 to 0.52 with whole stripes, chapter's Table 2: 0.13 to 0.41.
        assert all(0.1 < sphere.e_given < 0.6 for sphere in one.spheres), name
        # Whole stripes of 2.8 px leave 0.5 mm whatever the model: within a tenth of one another.
        assert one.mean_e == pytest.approx(third.mean_e, rel=0.1), name


def test_sub_pixel_boundaries_do_not(measured: Measured) -> None:
    fine = measured[False]
    assert fine["(iii)"].mean_e < 0.02 * measured[True]["(iii)"].mean_e
    assert fine["(i)"].mean_e > 1.3 * fine["(iii)"].mean_e
    for name in ("(i) mended", "ours", "true calibration"):
        assert fine[name].mean_e == pytest.approx(fine["(iii)"].mean_e, rel=0.3), name
    # Tsai's camera has no skew, Table 1's has: 0.1 px at the rim, some 0.0001 mm^2. With one (ii) is
    # as good as (iii), as the chapter says.
    assert fine["(iii)"].mean_e < fine["(ii)"].mean_e < fine["(iii)"].mean_e + 0.001
    assert fine["(ii)"].plate_systematic_mm > 1.5 * fine["(iii)"].plate_systematic_mm
    assert fine["(ii) with skew"].mean_e == pytest.approx(fine["(iii)"].mean_e, rel=0.3)
    for one in fine.values():
        # The issue: at least 90 percent of the pixels that a sphere covers and the light reaches.
        assert min(one.covered) > 0.9


def test_the_plate_and_the_centres_tell_calibrations_apart(measured: Measured) -> None:
    fine = measured[False]
    # Corners found to 0.03 px in rendering this coarse: a few um, and 0.2 um for all in one solve.
    assert fine["(iii)"].plate_systematic_mm < 0.02
    assert fine["ours"].plate_systematic_mm < 0.004
    assert fine["(i)"].plate_systematic_mm > 0.15
    assert fine["(i) mended"].plate_systematic_mm < 0.2 * fine["(i)"].plate_systematic_mm
    assert fine["ours"].distances.rms_mm < 0.02
    assert fine["(i)"].distances.rms_mm > 0.05
    for name in ("(iii)", "ours"):
        for sphere, true in zip(fine[name].spheres, apparatus.CENTRES, strict=True):
            # An error of 1e-3 in the focal length is 0.4 mm of depth at 400 mm.
            assert np.linalg.norm(sphere.given.centre - true) < 0.8


def test_table_1_is_recovered(calibrated: Calibrations) -> None:
    found, sigmas = calibrated.reference.camera, np.sqrt(np.diag(calibrated.reference.covariance))
    errors = found.parameters - [getattr(apparatus.CAMERA, name) for name in found.parameter_names]
    # Three sigmas is the bound; a fixed seed makes it no matter of chance.
    assert np.all(np.abs(errors) < 3.0 * sigmas), np.array(errors) / sigmas


def test_points_are_as_far_off_as_they_say(
    captures: ChapterCaptures, calibrated: Calibrations
) -> None:
    found = compare_point_sigmas(calibrated.ours, captures)
    # What a calibration leaves open is common to all points: one calibration is one draw of it, of
    # which nothing but "not beyond three" can be asked.
    assert found.spheres < 3.0
    assert found.plate < 3.0
    # Nor may it be had by sigmas that are too large: 0.011 mm in docs/reproduction.md, and corners of
    # images so coarsely rendered err by 0.03 px instead of 0.014.
    assert found.median_mm < 3.0 * 0.011


def test_the_report_says_all_of_it(
    tmp_path: Path, captures: ChapterCaptures, calibrated: Calibrations, measured: Measured
) -> None:
    fine, whole = tuple(measured[False].values()), tuple(measured[True].values())
    found = Reproduction(
        seed=0,
        real_light=False,
        calibrated=calibrated,
        whole=whole,
        fine=fine,
        by_stage=fine[:1],
        by_reference=fine[-1:],
        sigmas=(compare_point_sigmas(calibrated.ours, captures),),
    )
    text = render_reproduction(found)
    for wanted in ("Table 1", "Table 2", "mean square", "contradicts", "scale ppm"):
        assert wanted in text
    assert f"{fine[3].spheres[2].e_given:.5f}" in text
    assert f"{whole[0].spheres[4].e_given:.3f}" in text
    for line in text.splitlines():
        if line.startswith("|"):
            assert line.endswith("|")
    names = name_figures(real_light=False)
    draw(captures, calibrated, tmp_path, names)
    for name in names:
        assert f"({name})" in text
        assert (tmp_path / name).stat().st_size > 10_000
    assert not list(tmp_path.glob("*.tmp*"))
