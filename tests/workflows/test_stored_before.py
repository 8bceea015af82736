"""Files that version 0.1.0 wrote are read as they were meant.

`tests/data/stored-0.1.0`: the calibration of a simulated rig of four pairs by commit 723e584, and a
scan by it, cut down to 200 points and a tetrahedron by that commit's own writers.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from bodyscan.fusion.storage import load_scan
from bodyscan.registration.rig_calibration import RigCalibration
from bodyscan.registration.storage import load_calibration, save_calibration

STORED = Path(__file__).parents[1] / "data" / "stored-0.1.0"


@pytest.fixture(scope="module")
def calibration() -> RigCalibration:
    return load_calibration(STORED / "calibration")


def test_a_calibration_gives_the_depths_that_it_was_fitted_for(calibration: RigCalibration) -> None:
    assert sorted(calibration.pairs) == ["p1-2", "p1-3", "p2-2", "p2-3"]
    for name, pair in calibration.pairs.items():
        seen = calibration.observed[name]
        assert np.sqrt(np.mean(seen.residuals_px**2)) == pytest.approx(
            pair.quality.corners_rms_px / np.sqrt(2.0), rel=0.2
        )
        middle = pair.camera.rays(np.array([[pair.camera.width / 2.0, pair.camera.height / 2.0]]))
        assert pair.sheets is not None
        depth = pair.sheets.intersect(middle, np.array([160.0])).depth
        # The subject stands about 1.3 m before every camera of this rig.
        assert 900.0 < depth[0] < 1800.0


def test_a_calibration_is_written_again_as_it_was(
    calibration: RigCalibration, tmp_path: Path
) -> None:
    save_calibration(calibration, tmp_path)
    before = json.loads((STORED / "calibration" / "calibration.json").read_text("utf-8"))
    after = json.loads((tmp_path / "calibration.json").read_text("utf-8"))
    # Then every code had every key, null where it was not given; now each has its own, with values.
    for pair in before["rig"]["pairs"]:
        keys = pair["projector"]
        assert (keys["code"], keys["inverses"]) == ("gray", None)
        assert (keys.pop("steps"), keys.pop("period")) == (None, None)
        keys["inverses"] = True
    assert before.pop("software") != after.pop("software")
    # Then the file had no hash of itself.
    assert (before.pop("version"), after.pop("version")) == (1, 2)
    assert len(after.pop("sha256")) == 64
    # Smooth planes are now bowed sheets whose bow is 0: more parameters, all 0.
    assert before.pop("arrays_sha256") != after.pop("arrays_sha256")
    for pair in before["pairs"].values():
        assert pair["light"]["kind"] == "smooth-planes"
        pair["light"]["kind"] = "bowed"
    assert of_keys_then(after, before) == before
    with (
        np.load(STORED / "calibration" / "calibration.npz") as old,
        np.load(tmp_path / "calibration.npz") as new,
    ):
        assert sorted(new.files) == sorted(old.files)
        for key in old.files:
            of_then = new[key][tuple(slice(0, size) for size in old[key].shape)]
            assert np.array_equal(of_then, old[key], equal_nan=True)
            assert np.count_nonzero(new[key]) == np.count_nonzero(old[key])


def of_keys_then(after: object, before: object) -> object:
    """Without the keys that came since."""
    if isinstance(after, dict) and isinstance(before, dict):
        return {key: of_keys_then(after[key], before[key]) for key in after.keys() & before}
    if isinstance(after, list) and isinstance(before, list) and len(after) == len(before):
        return [of_keys_then(*items) for items in zip(after, before, strict=True)]
    return after


def test_a_scan_is_read() -> None:
    stored = load_scan(STORED / "scan")
    assert len(repr(stored)) < 200
    assert len(stored.cloud.points) == 200
    assert stored.mesh.filled.tolist() == [False, True, True, True]
    assert stored.facts["verdict"]["grade"] in ("good", "usable", "repeat")
