"""A real object under Gray code, as people take it: no lit image, sums that are wrong, JPEG.

Pattern minus inverse is right there all the same. What is wrong in its broken copies is found.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from bodyscan.arrays import Bytes, Floats
from bodyscan.captures.folder import open_scan
from bodyscan.captures.images import read_sequence
from bodyscan.errors import CaptureError, DecodingFailed
from bodyscan.rig.rig import Rig, load_rig
from bodyscan.stripes.decoding import decode_stripes
from bodyscan.stripes.gray.bit_words import stripe_from_gray
from bodyscan.stripes.stripe_code import StripeCode
from bodyscan.stripes.stripe_map import StripeMap

RIG = load_rig(Path(__file__).parents[2] / "rigs" / "gray-jpeg.yaml")
SHOT = "scan_0020"
LEAST_DIFFERENCE = 5


def code_of(rig: Rig) -> StripeCode:
    (pair,) = rig.pairs
    assert pair.projector is not None
    return pair.projector


def images_in(folder: Path, rig: Rig) -> Bytes | Floats:
    (sequence,) = open_scan(rig, folder).sequences
    assert sequence.lit is None
    assert sequence.dark is None
    return read_sequence(sequence, rig.pairs[0].camera).coded


def plainly_decoded(coded: Bytes) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Stripes by the sign of pattern minus inverse, and where each of these is clearly not 0."""
    patterns, inverses = np.split(coded, 2)
    words = np.zeros(coded.shape[1:], np.uint16)
    certain = np.ones(coded.shape[1:], bool)
    for pattern, inverse in zip(patterns, inverses, strict=True):
        words = (words << 1) | (pattern > inverse)
        certain &= cv2.absdiff(pattern, inverse) >= LEAST_DIFFERENCE
    return stripe_from_gray(words), certain


@pytest.fixture(scope="module")
def coded(captures: Path) -> Bytes | Floats:
    return images_in(captures / "gray-jpeg", RIG)


@pytest.fixture(scope="module")
def decoded(coded: Bytes) -> StripeMap:
    return decode_stripes(code_of(RIG), None, None, coded)


@pytest.mark.parametrize("way", ["columns", "rows"])
def test_both_directions_are_read_as_plain_decoding_reads_them(
    coded: Bytes, decoded: StripeMap, way: str
) -> None:
    bits = 2 * 11
    images = coded[:bits] if way == "columns" else coded[bits:]
    found = decoded if way == "columns" else decoded.crossing
    assert found is not None
    plain, certain = plainly_decoded(images)
    assert certain.sum() > 300_000
    told = certain & np.isfinite(found.s)
    # The targets of issue 13; 0.91 and 0.97 were seen, and all within a stripe but 3 in a million.
    assert told.sum() >= 0.9 * certain.sum()
    assert np.mean(np.abs(found.s[told] - (plain[told] + 0.5)) <= 1.0) >= 0.999


def test_sigmas_are_true_on_its_smooth_surface(decoded: StripeMap) -> None:
    """Of rows, which tell little of depth, so that the surface's grain hardly moves them.

    Over a few pixels they are smooth: what strays from a parabola through pixels that share neither
    blur nor boundaries is noise. That claimed from grey levels alone was 0.6 of it.
    """
    assert decoded.crossing is not None
    step, part = 4, (slice(500, 1100), slice(420, 800))
    s, sigma = decoded.crossing.s[part], decoded.crossing.sigma[part]
    fits = np.array([-1.0, 3.0, -3.0, 1.0])
    ends = [slice(k * step, len(s) - (3 - k) * step) for k in range(4)]
    off = np.tensordot(fits, np.stack([s[end] for end in ends]), 1)
    claimed = np.sqrt(np.tensordot(fits**2, np.stack([sigma[end] ** 2 for end in ends]), 1))
    share = (off / claimed)[np.isfinite(off)]
    assert share.size > 100_000
    assert 0.75 < 1.4826 * np.median(np.abs(share)) < 1.25


class Broken(NamedTuple):
    """Files that take each other's names, by axis, bit and inverse; a file that is lost."""

    exchanged: tuple[tuple[str, str], ...] = ()
    copied: tuple[tuple[str, str], ...] = ()
    said: str = ""


BROKEN = {
    "frames of two bits exchanged": Broken(
        (("00-07-00", "00-06-00"), ("00-07-01", "00-06-01")),
        said="swapped, missing or out of order",
    ),
    "pattern exchanged with another bit's": Broken(
        (("00-08-00", "00-05-00"),),
        said="bit 2 is faint where finer ones are clear",
    ),
    "first bit lost, the others moved up": Broken(
        copied=tuple(
            (f"00-{bit:02d}-{inverse}", f"00-{bit + 1:02d}-{inverse}")
            for bit in range(9, -1, -1)
            for inverse in ("00", "01")
        ),
        said="",
    ),
    "inverse lost, the frames after it moved up": Broken(
        copied=(
            ("00-04-00", "00-05-01"), ("00-04-01", "00-04-00"), ("00-03-00", "00-04-01"),
            ("00-03-01", "00-03-00"), ("00-02-00", "00-03-01"), ("00-02-01", "00-02-00"),
            ("00-01-00", "00-02-01"), ("00-01-01", "00-01-00"), ("00-00-00", "00-01-01"),
            ("00-00-01", "00-00-00"), ("01-09-00", "00-00-01"),
        ),
        said="bit 5 is faint where finer ones are clear",
    ),
    "rows for columns": Broken(
        tuple(
            (f"00-{bit:02d}-{inverse}", f"01-{bit:02d}-{inverse}")
            for bit in range(10)
            for inverse in ("00", "01")
        ),
        said="",
    ),
}  # fmt: skip


@pytest.fixture
def columns(captures: Path, tmp_path: Path) -> Iterator[tuple[Rig, Path]]:
    """The rig with columns alone, and a copy of the captures."""
    (pair,) = RIG.pairs
    alone = code_of(RIG).model_copy(update={"crossing": None})
    rig = RIG.model_copy(update={"pairs": (pair.model_copy(update={"projector": alone}),)})
    shutil.copytree(captures / "gray-jpeg" / SHOT, tmp_path / SHOT)
    yield rig, tmp_path
    shutil.rmtree(tmp_path / SHOT)


@pytest.mark.parametrize("name", BROKEN)
def test_a_wrong_order_is_refused(columns: tuple[Rig, Path], name: str) -> None:
    rig, folder = columns
    broken = BROKEN[name]

    def file(frame: str) -> Path:
        (found,) = (folder / SHOT).glob(f"*[[]{frame}_*")
        return found

    for one, other in broken.exchanged:
        first, second = file(one), file(other)
        first.rename(folder / "kept")
        second.rename(first)
        (folder / "kept").rename(second)
    for source, target in broken.copied:
        shutil.copyfile(file(source), file(target))
    coded = images_in(folder, rig)
    with pytest.raises(DecodingFailed, match=broken.said or None):
        decode_stripes(code_of(rig), None, None, coded)


def test_a_lost_frame_is_named(columns: tuple[Rig, Path]) -> None:
    rig, folder = columns
    (gone,) = (folder / SHOT).glob("*[[]00-03-01_*")
    gone.unlink()
    with pytest.raises(CaptureError, match=r"00-03-01.*is missing"):
        images_in(folder, rig)
