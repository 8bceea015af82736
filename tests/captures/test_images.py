"""Images: read exactly, and refused before they do harm."""

from __future__ import annotations

import os
import struct
import zlib
from contextlib import nullcontext, suppress
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from small_captures import BITS, FRAMES, HEIGHT, STRIPES, WIDTH, encoded, picture, png, write
from small_captures import write_small_captures as small

from bodyscan.captures.check import check, format_report
from bodyscan.captures.folder import Captures, ImageSequence, open_captures
from bodyscan.captures.grey_png import find_png_damage
from bodyscan.captures.image_header import NotAnImage, read_header
from bodyscan.captures.images import (
    measure_mosaic,
    read_board_image,
    read_colours,
    read_image,
    read_sequence,
)
from bodyscan.errors import BadInput, ImageError
from bodyscan.rig.pair import CameraSpec
from bodyscan.rig.rig import load_rig

CAMERA = CameraSpec(width=WIDTH, height=HEIGHT)
NOISE = np.random.default_rng(5).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)


def sequence_of(captures: Captures, pair: str, shot: str) -> ImageSequence:
    return next(s for s in captures.pair_sequences(pair) if s.shot == shot)


def first_sequence(folder: Path) -> ImageSequence:
    rig_path = small(folder, shots=1)
    return sequence_of(open_captures(load_rig(rig_path), rig_path), "p1", "b1")


def read(path: Path, **options: bool) -> np.ndarray:
    return read_image(path, CAMERA, pair="p1", shot="b1", **options)


def tiff(**options: Any) -> bytes:
    """A TIFF of NOISE."""
    stream = BytesIO()
    Image.fromarray(NOISE).save(stream, "tiff", **options)
    return stream.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_of_a_tiff_are_read_as_stored(tmp_path: Path, orientation: int) -> None:
    content = tiff(tiffinfo={274: orientation}, compression="tiff_lzw")
    np.testing.assert_array_equal(read(write(tmp_path / "x.tif", content)), NOISE)


def test_colour_becomes_grey_and_exif_turns_are_not_applied(tmp_path: Path) -> None:
    colour = np.dstack([NOISE // 4, NOISE // 2, NOISE])
    expected = NOISE / 4 * 0.114 + NOISE / 2 * 0.587 + NOISE * 0.299  # luma, blue first
    image = read(write(tmp_path / "x.png", colour))
    assert np.abs(image - expected).max() <= 1.5  # whole grey levels, and // above
    # Turned by 90 degrees.
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    jpeg = encoded(picture("bit02"), ".jpg")
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]
    plain = read(write(tmp_path / "x.jpg", jpeg))
    np.testing.assert_array_equal(read(write(tmp_path / "y.jpg", turned)), plain)


RGB = np.dstack([NOISE, NOISE // 2, NOISE // 3])
GREEN = np.dstack([NOISE // 6, NOISE, NOISE // 8])


@pytest.mark.parametrize(
    ("suffix", "lit", "channel", "expected"),
    [
        *((suffix, RGB, "grey", RGB) for suffix in (".png", ".tif", ".bmp")),
        *((suffix, NOISE, "grey", None) for suffix in (".png", ".tif", ".bmp", ".jpg")),
        (".png", RGB.astype(np.uint16) * 256 + 17, "grey", RGB),
        (".png", np.dstack([NOISE] * 3), "grey", None),
        (".png", RGB, "green", RGB),
        (
            ".png",
            GREEN,
            "green",
            None,
        ),  # of a projector of one colour, through the camera's filters
        (".png", GREEN, "grey", GREEN),
    ],
)
def test_the_lit_image_is_read_in_colour_where_it_has_any(
    tmp_path: Path, suffix: str, lit: np.ndarray, channel: Any, expected: np.ndarray | None
) -> None:
    sequence = first_sequence(tmp_path)
    path = write(tmp_path / f"lit{suffix}", lit[..., ::-1] if lit.ndim == 3 else lit)
    camera = CameraSpec(width=WIDTH, height=HEIGHT, channel=channel)
    found = read_colours(replace(sequence, lit=path), camera)
    assert (found is None) is (expected is None)
    if found is not None and expected is not None:
        assert np.abs(found.astype(int) - expected).max() <= int(lit.dtype == np.uint16)
    assert read_colours(replace(sequence, lit=None), camera) is None


def test_the_lit_image_in_colour_is_made_where_none_was_taken(tmp_path: Path) -> None:
    """Each pixel as bright as in the brighter of a pattern and its inverse."""
    sequence = replace(first_sequence(tmp_path), lit=None)
    for path in sequence.coded:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        write(path, np.dstack([grey // 4, grey // 2, grey]))
    found = read_colours(sequence, CAMERA)
    assert found is not None
    np.testing.assert_array_equal(found, np.broadcast_to([200, 100, 50], found.shape))


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (None, "is missing"),
        (b"", "is an empty file"),
        (b"this is text", "is not a PNG, JPEG, BMP or TIFF image"),
        (encoded(NOISE, ".bmp")[:-20], "cannot be decoded"),
        (encoded(NOISE, ".bmp")[:20], "is cut short"),
        (encoded(NOISE, ".tif")[:-20], "cannot be decoded"),
        (tiff(compression="zstd").replace(b"\x50\xc3", b"\x98\x87"), "is compressed by JPEG 2000"),
        (tiff(compression="zstd"), "is compressed by Zstandard, which is not read: save it with"),
        (tiff(save_all=True, append_images=[Image.fromarray(NOISE)] * 2), "holds 3 images: save"),
        (encoded(NOISE.astype(np.float32), ".tif"), "has 32 bits a sample; 8 to 16 are read"),
        (encoded(NOISE.T), "is 30 x 40 pixels, but the rig file says 40 x 30"),
        (encoded(NOISE.T.copy(), ".jpg"), "is 30 x 40 pixels, but the rig file says 40 x 30"),
        (encoded(NOISE.astype(np.uint16)), "16 bits a sample, but 8 bits in them (none of"),
        (encoded(NOISE.astype(np.uint16) * 256), "but 8 bits in them (all their numbers are mult"),
        (encoded(NOISE.astype(np.uint16) * 257), "but 8 bits in them (all their numbers are mult"),
        (encoded(NOISE)[:-20], "is cut short"),
        (encoded(NOISE)[:600], "is cut short"),
        (encoded(NOISE)[:20], "is cut short"),
        (encoded(NOISE, ".jpg")[:-20], "is cut short"),
        (encoded(NOISE, ".jpg")[:30], "is cut short"),
        (png((WIDTH, HEIGHT), zlib.compress(b"")), "cannot be decoded"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "is damaged (its PNG header is wrong)"),
        (b"\xff\xd8\xff\xe0\x00\x01" + bytes(50), "or damaged (its JPEG header cannot be read)"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_bad_images_are_refused(tmp_path: Path, content: bytes | None, what: str) -> None:
    path = tmp_path / "x.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError) as caught:
        read(path)
    assert what in caught.value.what
    assert caught.value.where == f"{path} (pair p1, shot b1)"
    assert caught.value.remedy


def test_a_huge_image_is_refused_by_its_header(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "x.png", png((60_000, 60_000), zlib.compress(b"")))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(ImageError, match="is 60000 x 60000 pixels, but the rig file says"):
        read(path)


@given(st.integers(33, len(encoded(NOISE)) - 13), st.integers(1, 255))
def test_every_changed_byte_of_a_png_is_noticed(place: int, change: int) -> None:
    data = bytearray(encoded(NOISE))
    data[place] ^= change
    assert find_png_damage(bytes(data)) is not None
    assert find_png_damage(encoded(NOISE)) is None


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"]))
def test_any_bytes_give_a_header_or_a_reason(
    tmp_path_factory: pytest.TempPathFactory, tail: bytes, start: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.png"
    path.write_bytes(start + tail)
    with suppress(NotAnImage):  # anything else that is raised would reach the user as a traceback
        assert read_header(path).width >= 0


def test_a_jpeg_header_is_found_behind_long_segments(tmp_path: Path) -> None:
    jpeg = encoded(NOISE, ".jpg")
    thumbnail = b"\xff\xe2" + struct.pack(">H", 60_002) + b"\xff\xd9" * 30_000
    for content, complete in ((jpeg, True), (jpeg + bytes(300), True), (jpeg[:-9], False)):
        path = write(tmp_path / "x.jpg", content[:2] + thumbnail * 3 + content[2:])
        header = read_header(path)
        assert (header.width, header.height, header.bits) == (WIDTH, HEIGHT, 8)
        assert header.complete is complete


def test_a_raw_bayer_image_is_told_from_a_grey_one() -> None:
    v, u = np.indices((96, 128))
    grey = (40 + 150 * ((u // 13 + v // 13) % 2) + 0.2 * u).astype(np.uint8)
    assert measure_mosaic(grey) < 0.02
    grey[::2, ::2] //= 2
    assert measure_mosaic(grey) > 0.3


@pytest.mark.parametrize(
    ("rest", "level", "said"),
    [
        (0, 0, "brightest pixel is 0"),
        (0, 8, "brightest pixel is 8"),
        (0, 9, ""),
        (255, 253, ""),
        (255, 254, "nothing but white: its darkest pixel is 254"),
    ],
)
def test_a_black_or_white_lit_image_is_refused(
    tmp_path: Path, rest: int, level: int, said: str
) -> None:
    image = np.full((HEIGHT, WIDTH), rest, np.uint8)
    image[3, 4] = level
    path = write(tmp_path / "lit.png", image)
    assert read(path)[3, 4] == level  # any other image may be so
    with (
        pytest.raises(ImageError, match=f"shows {'.*' * bool(said)}{said}")
        if said
        else nullcontext()
    ):
        assert read(path, lit=True)[3, 4] == level


def test_a_sequence_comes_in_order(tmp_path: Path) -> None:
    images = read_sequence(first_sequence(tmp_path), CAMERA)
    patterns, inverses = np.split(images.coded, 2)
    assert patterns.shape == inverses.shape == (BITS, HEIGHT, WIDTH)
    assert images.lit is not None
    assert images.dark is not None
    assert images.lit.min() == 200
    assert images.dark.max() == 5
    gray = sum(
        (patterns[bit] > inverses[bit]).astype(int) << (BITS - 1 - bit) for bit in range(BITS)
    )
    stripe = np.arange(HEIGHT) * STRIPES // HEIGHT
    np.testing.assert_array_equal(gray, np.repeat((stripe ^ stripe >> 1)[:, None], WIDTH, axis=1))


@pytest.mark.parametrize("scale", [1, 5])
def test_of_a_sequence_a_part_can_be_read(tmp_path: Path, scale: int) -> None:
    """Of 16 bits too, whose white the rest of the images may tell: the crop has too few for 12."""
    sequence = first_sequence(tmp_path)
    for path in (sequence.lit, sequence.dark, *sequence.coded):
        assert path is not None
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image[-1, -1] = 255
        write(path, image * np.uint16(scale) + np.uint16(1) if scale > 1 else image)
    whole = read_sequence(sequence, CAMERA)
    part = read_sequence(sequence, CAMERA, crop=(slice(2, HEIGHT - 3), slice(5, WIDTH - 1)))
    assert whole.lit is not None
    np.testing.assert_array_equal(part.lit, whole.lit[2:-3, 5:-1])
    np.testing.assert_array_equal(part.coded, whole.coded[:, 2:-3, 5:-1])


def test_a_black_sequence_is_refused_and_a_lit_image_is_no_sequence(tmp_path: Path) -> None:
    sequence = first_sequence(tmp_path)
    pair = load_rig(tmp_path / "rig.yaml").pair("p1")
    np.testing.assert_array_equal(read_board_image(sequence, pair), picture("lit"))
    write(sequence.board_path, picture("dark"))
    with pytest.raises(ImageError, match="shows nothing"):
        read_sequence(sequence, CAMERA)
    with pytest.raises(ImageError, match="shows nothing"):
        read_board_image(sequence, pair)
    alone = ImageSequence("p1", "b1", sequence.lit, None, (), ())
    with pytest.raises(ImageError, match="there is no stripe sequence"):
        read_sequence(alone, CAMERA)


def test_boards_are_looked_for_in_the_image_taken_for_them(tmp_path: Path) -> None:
    """Under room light: the lit image, whose light a projector's picture cuts, is decoded with."""
    rig_path = small(tmp_path, shots=1)
    rig_path.write_text(rig_path.read_text() + "frames: {board: room}\n")
    for name in ("p1", "p2", "cam"):
        write(
            tmp_path / "captures" / "b1" / name / "room.png", np.full((HEIGHT, WIDTH), 90, np.uint8)
        )
    rig = load_rig(rig_path)
    captures = open_captures(rig, rig_path)
    assert not any(s.missing for s in captures.sequences)
    for name, frames in (("p1", len(FRAMES) + 1), ("cam", 1)):
        sequence = sequence_of(captures, name, "b1")
        assert len(sequence.paths) == frames
        assert sequence.board_path.name == "room.png"
        assert read_board_image(sequence, rig.pair(name)).max() == 90
    sequence = sequence_of(captures, "p1", "b1")
    lit = read_sequence(sequence, CAMERA).lit
    assert lit is not None
    assert lit.max() == 200


def test_the_lit_image_is_made_where_none_was_taken(tmp_path: Path) -> None:
    rig_path = small(tmp_path, shots=1)
    text = rig_path.read_text().replace("  - name: cam\n    camera: *camera\n", "")
    rig_path.write_text(text + "frames: {lit: null, dark: null}\n")
    for path in tmp_path.glob("captures/b1/*/*t.png"):
        path.unlink()
    rig = load_rig(rig_path)
    captures = open_captures(rig, rig_path)
    assert captures.shots == ("b1",)
    assert not any(s.missing for s in captures.sequences)
    sequence = sequence_of(captures, "p1", "b1")
    assert sequence.lit is None
    assert sequence.board_path.name == "bit00.png"
    assert read_sequence(sequence, CAMERA).lit is None
    # Every pixel is bright, 200, in one of a pattern and its inverse.
    np.testing.assert_array_equal(read_board_image(sequence, rig.pair("p1")), picture("lit"))


def test_a_star_in_a_name_stands_for_what_differs(tmp_path: Path) -> None:
    rig_path = small(tmp_path, shots=1)
    rig_path.write_text(rig_path.read_text() + 'files: "{shot}/{pair}/*_[{frame}]_*.png"\n')
    for number, path in enumerate(sorted(tmp_path.glob("captures/b1/*/*.png"))):
        path.rename(path.with_name(f"{1481302049.5 + number}_[{path.stem}]_{number}.png"))
    captures = open_captures(load_rig(rig_path), rig_path)
    assert captures.shots == ("b1",)
    assert not any(s.missing for s in captures.sequences)
    sequence = sequence_of(captures, "p2", "b1")
    np.testing.assert_array_equal(read_sequence(sequence, CAMERA).lit, picture("lit"))
    lit = sequence.board_path
    write(lit.with_name("1_[lit]_again.png"), picture("lit"))
    again = sequence_of(open_captures(load_rig(rig_path), rig_path), "p2", "b1")
    with pytest.raises(
        ImageError, match=r"matches 2 files, such as 1481.*lit.*_again\.png"
    ) as caught:
        read_sequence(again, CAMERA)
    assert caught.value.where.endswith("*_[lit]_*.png (pair p2, shot b1)")
    lit.unlink()
    (lit.parent / "1_[lit]_again.png").unlink()
    gone = sequence_of(open_captures(load_rig(rig_path), rig_path), "p2", "b1")
    with pytest.raises(ImageError, match="is missing"):
        read_sequence(gone, CAMERA)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no named pipes here")
def test_a_named_pipe_among_the_images_is_not_waited_for(tmp_path: Path) -> None:
    sequence = first_sequence(tmp_path)
    sequence.coded[1].unlink()
    os.mkfifo(sequence.coded[1])
    with pytest.raises(ImageError, match="is not a regular file"):
        read_sequence(sequence, CAMERA)
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(BadInput, match="is not a regular file"):
        load_rig(tmp_path / "pipe.yaml")
    assert "is not a regular file" in "".join(format_report(check(tmp_path / "rig.yaml")))


def test_all_that_is_missing_is_counted_and_absent_inverses_are_told(tmp_path: Path) -> None:
    sequence = first_sequence(tmp_path)
    assert len(sequence.inverses) == BITS
    for path in sequence.inverses:
        path.unlink()
    with pytest.raises(ImageError, match=f"and {BITS - 1} more") as caught:
        read_sequence(reopened(tmp_path), CAMERA)
    assert str(sequence.inverses[0]) in caught.value.where
    assert "`inverses: false`" in caught.value.remedy
    assert any("`inverses: false`" in line for line in format_report(check(tmp_path / "rig.yaml")))
    sequence.coded[0].unlink()
    with pytest.raises(ImageError, match=f"and {BITS} more") as caught:
        read_sequence(reopened(tmp_path), CAMERA)
    assert "inverses" not in caught.value.remedy


def reopened(folder: Path) -> ImageSequence:
    rig_path = folder / "rig.yaml"
    return sequence_of(open_captures(load_rig(rig_path), rig_path), "p1", "b1")
