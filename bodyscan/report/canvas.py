"""Building blocks of pictures: colour scales, round numbers, panels with text, PNG files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bodyscan.arrays import Bytes

BACKGROUND = (250, 250, 250)
INK = (40, 40, 40)
PICTURE_PX = 760  # height of a picture in a page


@dataclass(frozen=True)
class Scale:
    """A colour for every number between two ends, with a caption for its bar."""

    low: float
    high: float
    caption: str
    table: Bytes  # (256, 3) blue, green, red

    def colours(self, values: NDArray[np.floating]) -> Bytes:
        """Colours (N, 3) of values (N,); clipped to the ends, grey for NaN."""
        share = (np.nan_to_num(values) - self.low) / (self.high - self.low)
        colours = self.table[np.clip(np.rint(255 * share), 0, 255).astype(np.uint8)]
        return np.where(np.isfinite(values)[:, None], colours, 128).astype(np.uint8)


def colour_bar(scale: Scale, height_px: int) -> Bytes:
    """A colour bar with round numbers beside it, and its caption."""
    panel = np.full((height_px, 130, 3), BACKGROUND, np.uint8)
    top, bottom = height_px // 6, height_px - height_px // 6
    ramp = scale.table[np.linspace(255, 0, bottom - top).astype(np.uint8)]
    panel[top:bottom, 20:50] = ramp[:, None]
    for value in round_ticks(scale.low, scale.high):
        share = (value - scale.low) / (scale.high - scale.low)
        row = round(bottom - share * (bottom - top))
        panel[row, 50:54] = INK
        write_label(panel, f"{value:g}", (58, row + 5))
    write_label(panel, scale.caption, (8, top - 20))
    return panel


def round_ticks(low: float, high: float) -> list[float]:
    """Three to six round numbers from low to high; whole numbers if the range is large enough."""
    rough = (high - low) / 5.0
    unit = 10.0 ** np.floor(np.log10(rough))
    step = next(unit * times for times in (1.0, 2.0, 5.0, 10.0) if unit * times >= rough * 0.999)
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return [float(np.round(k * step, 10)) + 0.0 for k in np.arange(first, last + 1)]


def write_label(panel: Bytes, text: str, corner: tuple[int, int]) -> None:
    cv2.putText(panel, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.45, INK, 1, cv2.LINE_AA)


def turbo() -> Bytes:
    ramp = np.arange(256, dtype=np.uint8)[:, None]
    return np.asarray(cv2.applyColorMap(ramp, cv2.COLORMAP_TURBO)).reshape(256, 3)


def blue_white_red() -> Bytes:
    share = np.linspace(-1.0, 1.0, 256)[:, None]
    blue, white, red = np.array([[180, 60, 20], [245, 245, 245], [30, 20, 180]], float)
    ends = np.where(share < 0, blue, red)
    return np.rint(white + np.abs(share) ** 0.8 * (ends - white)).astype(np.uint8)


def png(panels: Iterable[Bytes]) -> bytes:
    """Panels of equal height side by side, as a PNG file's bytes."""
    ok, data = cv2.imencode(".png", np.concatenate(list(panels), axis=1))
    if not ok:
        raise ValueError("no PNG could be made")
    return data.tobytes()


def round_down(value: float, digits: int) -> float:
    """Round a positive number down to so many digits."""
    power = 10.0 ** (np.floor(np.log10(value)) - digits + 1)
    return float(np.floor(value / power) * power)


def round_up(value: float) -> float:
    """Round a positive number up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= value))
