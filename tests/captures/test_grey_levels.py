"""Files of every kind, of more than eight bits, in colour: what of them is read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from small_captures import encoded, write

from bodyscan.captures.images import convert_to_greys, find_full_scale, read_image
from bodyscan.errors import ImageError
from bodyscan.rig.pair import CameraSpec
from bodyscan.rig.templates import template_faults

CAMERA = CameraSpec(width=40, height=30)
NOISE = np.random.default_rng(5).integers(0, 256, (30, 40), dtype=np.uint8)
DEEP = np.random.default_rng(6).integers(0, 4096, (30, 40), dtype=np.uint16)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tif", ".tiff"])
def test_files_of_every_kind_give_the_same_image(tmp_path: Path, kind: str) -> None:
    found = read_image(write(tmp_path / f"x{kind}", encoded(NOISE, kind)), CAMERA)
    np.testing.assert_array_equal(found, NOISE)


@pytest.mark.parametrize("kind", [".png", ".bmp", ".tif", ".jpg"])
@pytest.mark.parametrize(("channel", "place"), [("blue", 0), ("green", 1), ("red", 2)])
def test_one_channel_of_a_colour_image_can_be_chosen(
    tmp_path: Path, kind: str, channel: str, place: int
) -> None:
    levels = np.array([40, 90, 200], np.uint8)
    colour = np.broadcast_to(levels, (30, 40, 3)).copy()
    camera = CameraSpec.model_validate({"width": 40, "height": 30, "channel": channel})
    found = read_image(write(tmp_path / f"x{kind}", encoded(colour, kind)), camera)
    assert np.abs(found.astype(int) - int(levels[place])).max() <= 2  # JPEG rounds
    with pytest.raises(ImageError, match=f"is grey, but the rig file says `channel: {channel}`"):
        read_image(write(tmp_path / f"y{kind}", encoded(NOISE, kind)), camera)


@pytest.mark.parametrize(
    ("numbers", "bits", "white"),
    [
        (DEEP, None, 4095),
        (DEEP, 12, 4095),
        (DEEP << 4, None, 65520),
        (DEEP << 4, 12, 65520),
        (DEEP // 4, None, 1023),
        (DEEP // 4, 12, 4095),  # dim, and said to be of 12 bits
        (DEEP * 4 + 1, None, 16383),
        (DEEP * 16 + (DEEP >> 8), None, 65535),  # scaled to 16 bits by a program
        (DEEP * 16 + (DEEP >> 8), 12, 65535),
        (DEEP % 256, 8, 255),
    ],
)
def test_no_bit_is_lost_wherever_it_stands(
    numbers: np.ndarray, bits: int | None, white: int
) -> None:
    assert find_full_scale([numbers], bits) == white
    grey = convert_to_greys(numbers, find_full_scale([numbers], bits))
    assert grey.dtype == np.float32
    np.testing.assert_allclose(grey, numbers * (255.0 / white), rtol=1e-6)
    assert len(np.unique(grey)) == len(np.unique(numbers))


@pytest.mark.parametrize("numbers", [DEEP, DEEP * 4 + 1])
def test_numbers_that_need_more_bits_than_stated_are_named(numbers: np.ndarray) -> None:
    message = f"numbers up to {numbers.max()}: above 1023 they do not fit the rig file's `bits: 10`"
    with pytest.raises(ImageError, match=message):
        find_full_scale([numbers], 10)


@pytest.mark.parametrize("kind", [".png", ".tif"])
def test_deep_files_are_read_to_the_last_bit(tmp_path: Path, kind: str) -> None:
    path = write(tmp_path / f"x{kind}", encoded(DEEP, kind))
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), DEEP)
    found = read_image(path, CAMERA)
    assert np.abs(found - DEEP * (255.0 / 4095.0)).max() <= 0.501


def test_eight_bits_in_sixteen_are_read_if_the_rig_file_says_so(tmp_path: Path) -> None:
    camera = CameraSpec(width=40, height=30, bits=8)
    for place, numbers in enumerate((NOISE.astype(np.uint16), NOISE.astype(np.uint16) << 8)):
        path = write(tmp_path / f"{place}.png", encoded(numbers))
        np.testing.assert_array_equal(read_image(path, camera), NOISE)
    with pytest.raises(ImageError, match="has 8 bits a sample, but the rig file says `bits: 12`"):
        read_image(
            write(tmp_path / "x.png", encoded(NOISE)), CAMERA.model_copy(update={"bits": 12})
        )


def test_a_video_is_named_with_the_command_that_unpacks_it() -> None:
    said = list(template_faults("{shot}/{pair}.mp4", many_pairs=False, needs_frame=False))
    assert len(said) == 1
    assert "ffmpeg -i VIDEO" in said[0]
    assert "'{shot}/{pair}/{frame}.png'" in said[0]
