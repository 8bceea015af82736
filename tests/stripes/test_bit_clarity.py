"""Which bits are seen clearly, and what pairs of frames that do not belong together look like."""

from __future__ import annotations

import numpy as np
import pytest

from bodyscan.errors import DecodingFailed
from bodyscan.stripes.bit_clarity import LitPairs, check_pairs, check_seen

BITS, PIXELS = 6, 960
CONTRAST = 100.0


def frames(**strength: float) -> tuple[np.ndarray, np.ndarray]:
    """Patterns and inverses (bits, N) of a binary code; strength: of a bit, 1 where it is as clear as
    the light (`b5=0.2`)."""
    s = np.arange(PIXELS) * 64 / PIXELS
    bit = (s.astype(int) >> np.arange(BITS - 1, -1, -1)[:, None]) & 1
    share = np.array([strength.get(f"b{k}", 1.0) for k in range(BITS)])[:, None]
    value = CONTRAST * share * (bit - 0.5)
    middle = 20.0 + 0.5 * CONTRAST
    return (middle + value).astype(np.float32), (middle - value).astype(np.float32)


def pairs(patterns: np.ndarray, inverses: np.ndarray, variance: float = 0.5) -> LitPairs:
    return LitPairs.of(patterns, inverses, np.full(256, variance, np.float32))


def test_a_value_is_pattern_minus_inverse_and_its_sigma_that_of_both() -> None:
    found = pairs(*frames())
    assert set(np.unique(found.value)) == {-100.0, 100.0}
    np.testing.assert_allclose(found.sigma, 1.0)
    levels = np.arange(256, dtype=np.float32)
    one = LitPairs.of(np.array([[9]], np.uint8), np.array([[16]], np.uint8), levels)
    assert one.value[0, 0] == -7.0
    assert one.sigma[0, 0] == 5.0


def test_a_bit_is_clear_from_four_sigmas_on() -> None:
    found = pairs(*frames(b1=0.04, b2=0.039, b5=0.0))
    assert found.clear.all(axis=1).tolist() == [True, True, False, True, True, False]
    assert not found.coarse_clear.any()
    # The three finest may be unclear.
    assert pairs(*frames(b3=0.0, b4=0.0, b5=0.0)).coarse_clear.all()
    few = LitPairs(found.patterns[:2], found.inverses[:2], found.value[:2], found.sigma[:2])
    assert few.coarse_clear.all()  # of two bits the first counts


def test_in_how_many_pixels_a_bit_is_weaker_than_a_finer_one() -> None:
    patterns, inverses = frames()
    weak = np.arange(PIXELS) < 240
    for bit in (1, 3):
        patterns[bit, weak], inverses[bit, weak] = 82.0, 58.0  # 24 of 100
    assert list(pairs(patterns, inverses).weak()) == [
        (0, 0.0),
        (1, 0.25),
        (2, 0.0),
        (3, 0.25),
        (4, 0.0),
    ]
    patterns[3, weak], inverses[3, weak] = 83.0, 57.0  # 26: no less than a quarter
    assert dict(pairs(patterns, inverses).weak())[3] == 0.0
    # Only against a finer bit of eight sigmas, in 200 pixels at least.
    noisy = pairs(patterns, inverses, variance=0.5 * 12.6**2)
    assert list(noisy.weak()) == []
    # Where the finest bit has five sigmas, the next has nothing finer to be held against.
    assert [bit for bit, _ in pairs(*frames(b5=0.05)).weak()] == [0, 1, 2, 3]
    assert [bit for bit, _ in pairs(*frames(b5=0.08)).weak()] == [0, 1, 2, 3, 4]
    assert len(list(pairs(patterns[:, ::5][:, :199], inverses[:, ::5][:, :199]).weak())) == 0
    assert len(list(pairs(patterns[:, :200], inverses[:, :200]).weak())) == 5


def test_a_sound_sequence_passes_and_so_does_one_blurred_away() -> None:
    check_seen(pairs(*frames()))
    check_pairs(pairs(*frames()))
    blurred = frames(b4=0.02, b5=0.0)
    blurred[0][5] += np.random.default_rng(0).normal(0.0, 0.5, PIXELS).astype(np.float32)
    check_seen(pairs(*blurred))
    check_pairs(pairs(*blurred))


@pytest.mark.parametrize(("blurred", "named"), [("b3 b4 b5", None), ("b2 b3 b4 b5", "bit 2")])
def test_the_three_finest_bits_may_be_blurred_away(blurred: str, named: str | None) -> None:
    """An even grey, but for a noise that leaves no pattern equal to its inverse."""
    patterns, inverses = frames(**dict.fromkeys(blurred.split(), 0.0))
    grey = [int(name[1:]) for name in blurred.split()]
    rng = np.random.default_rng(0)
    patterns[grey] += rng.normal(0.0, 0.5, (len(grey), PIXELS)).astype(np.float32)
    if named is None:
        check_seen(pairs(patterns, inverses))
    else:
        with pytest.raises(DecodingFailed, match=f"{named} look alike"):
            check_seen(pairs(patterns, inverses))


def test_a_bit_that_shows_nowhere_is_named() -> None:
    with pytest.raises(DecodingFailed, match="bit 2 look alike: the bit shows in"):
        check_seen(pairs(*frames(b2=0.0)))
    # A finest pattern that was taken for its own inverse is black and white, not grey.
    patterns, inverses = frames()
    rough = np.random.default_rng(0).normal(0.0, 0.3, PIXELS).astype(np.float32)
    with pytest.raises(DecodingFailed, match="bit 5 look alike"):
        check_seen(pairs(patterns, np.vstack([inverses[:5], patterns[5:] + rough])))
    copied = np.vstack([inverses[:5], patterns[5:]])
    with pytest.raises(DecodingFailed, match="bit 5 look alike"):
        check_seen(pairs(patterns, copied))
    # Shown by one pixel in fifty, it is there.
    patterns, inverses = frames(b2=0.0)
    patterns[2, ::48] += 50.0
    check_seen(pairs(patterns, inverses))
    # Of fewer than 200 pixels nothing is said.
    patterns, inverses = frames(b2=0.0)
    check_seen(pairs(patterns[:, :199], inverses[:, :199]))
    with pytest.raises(DecodingFailed):
        check_seen(pairs(patterns[:, :200], inverses[:, :200]))


@pytest.mark.parametrize(("level", "which"), [(120.0, "brighter"), (20.0, "darker")])
def test_a_finest_pattern_brighter_or_darker_than_its_inverse_everywhere_is_named(
    level: float, which: str
) -> None:
    patterns, inverses = frames()
    patterns[5], inverses[5] = level, 140.0 - level
    with pytest.raises(DecodingFailed, match=f"pattern 5 is {which} than its inverse nearly"):
        check_seen(pairs(patterns, inverses))
    # In six of seven pixels, and with as many to the other side, it may be.
    some = np.arange(PIXELS) % 6 == 0
    patterns[5, some], inverses[5, some] = 140.0 - level, level
    check_seen(pairs(patterns, inverses))


def test_a_pattern_with_another_bits_inverse_is_named_with_its_partner() -> None:
    patterns, inverses = frames()
    moved = inverses[[0, 2, 1, 3, 4, 5]]
    with pytest.raises(DecodingFailed) as caught:
        check_pairs(pairs(patterns, moved))
    assert "bit 1 (50% of the pixels), 2 (50% of the pixels)" in str(caught.value)
    assert "pattern 1 goes with inverse 2; pattern 2 goes with inverse 1" in str(caught.value)


@pytest.mark.parametrize(("bit", "most"), [(1, 0.15), (2, 0.15), (3, 0.35), (4, 0.35)])
def test_blur_weakens_fine_bits_in_more_pixels_than_coarse_ones(bit: int, most: float) -> None:
    for share, wrong in ((most - 0.01, False), (most + 0.01, True)):
        patterns, inverses = frames()
        weak = np.arange(PIXELS) < share * PIXELS
        patterns[bit, weak] = inverses[bit, weak] = 70.0
        if wrong:
            with pytest.raises(DecodingFailed, match=rf"bit {bit} \("):
                check_pairs(pairs(patterns, inverses))
        else:
            check_pairs(pairs(patterns, inverses))
