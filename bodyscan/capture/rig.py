"""What a rig file describes: boards, poles, pairs, where captures lie and how files are named."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from bodyscan.capture import rig_checks
from bodyscan.capture.model import Model, Name, Problem, duplicates

Vector = tuple[float, float, float]
Pixels = Annotated[int, Field(gt=0, le=32767)]


class Board(Model):
    """A flat checkered board. `columns` x `rows` counts squares, not corners.

    Board frame: origin at the first square's outer corner (of the checkered area), x along the
    columns, y along the rows (down, as printed), z away from whoever looks at the front.
    """

    name: Name
    kind: Literal["checkerboard", "charuco"] = "checkerboard"
    columns: Annotated[int, Field(ge=3, le=200)]
    rows: Annotated[int, Field(ge=3, le=200)]
    square_mm: PositiveFloat
    marker_mm: PositiveFloat | None = None
    dictionary: str = "DICT_4X4_1000"
    legacy_layout: bool = False
    first_marker: Annotated[int, Field(ge=0)] = 0
    margin_mm: Annotated[float, Field(ge=0)] = 0.0
    faces: Literal[1, 2] = 1
    thickness_mm: Annotated[float, Field(ge=0)] = 0.0

    @property
    def marker_count(self) -> int:
        """Markers on all faces of a charuco board: every second square of a face carries one."""
        return self.faces * (self.columns * self.rows // 2) if self.kind == "charuco" else 0

    def problems(self) -> Iterator[Problem]:
        return rig_checks.board_problems(self)


class CameraSpec(Model):
    """Image size in pixels."""

    width: Pixels
    height: Pixels


FrameKind = Literal["pattern", "inverse", "phase", "stripe", "index"]
"""What an image of a code is; `FrameNames` has a name for each."""

DEFAULT_STEPS = 4
DEFAULT_PERIOD = 8


class ProjectorSpec(Model):
    """The stripes a projector throws. `direction` is the way the stripes run in the image.

    inverses: whether each pattern of a Gray or binary code is thrown inverted as well.
    steps, period: of phase-shift, images in one period and stripes in it.
    """

    code: Literal["gray", "binary", "light-section", "stripe-index", "phase-shift"] = "gray"
    stripes: Annotated[int, Field(ge=2, le=65535)]
    direction: Literal["horizontal", "vertical"]
    inverses: bool | None = None
    steps: Annotated[int, Field(ge=3, le=64)] | None = None
    period: Annotated[int, Field(ge=2, le=65535)] | None = None

    @property
    def words(self) -> int:
        """Code words thrown: one a stripe; of phase-shift, one each half period."""
        if self.code == "phase-shift":
            return -(-2 * self.stripes // self.period_stripes)
        return self.stripes

    @property
    def bits(self) -> int:
        """Patterns of the Gray or binary code: ceil(log2(words)); 0 for codes without any."""
        wordless = self.code in ("light-section", "stripe-index")
        return 0 if wordless else max(1, (self.words - 1).bit_length())

    @property
    def has_inverses(self) -> bool:
        """Whether patterns are thrown inverted as well."""
        return self.bits > 0 and self.inverses is not False

    @property
    def phase_steps(self) -> int:
        """Images in a period of phase-shift, 0 for other codes."""
        return (self.steps or DEFAULT_STEPS) if self.code == "phase-shift" else 0

    @property
    def period_stripes(self) -> int:
        """Stripes in a period of phase-shift."""
        return self.period or DEFAULT_PERIOD

    @property
    def takes_dark(self) -> bool:
        """Whether the code has use for a dark image."""
        return self.code not in ("light-section", "stripe-index")

    @property
    def frame_counts(self) -> Mapping[FrameKind, int]:
        """How many images of each kind the code takes, in their order, besides lit and dark."""
        counts: dict[FrameKind, int] = {
            "pattern": self.bits,
            "inverse": self.bits * self.has_inverses,
            "phase": self.phase_steps,
            "stripe": self.stripes * (self.code == "light-section"),
            "index": 1 * (self.code == "stripe-index"),
        }
        return {kind: count for kind, count in counts.items() if count}

    def problems(self) -> Iterator[Problem]:
        return rig_checks.projector_problems(self)


class Placing(Model):
    """Where something is meant to stand, rig frame: looks from `position_mm` at `look_at_mm`."""

    position_mm: Vector
    look_at_mm: Vector

    def problems(self) -> Iterator[Problem]:
        if self.position_mm == self.look_at_mm:
            yield ("look_at_mm",), "must differ from position_mm, or it looks nowhere"


class Pair(Model):
    """One camera and one projector (or a camera alone)."""

    name: Name
    pole: Name | None = None
    camera: CameraSpec
    projector: ProjectorSpec | None = None
    nominal: Placing | None = None
    projector_nominal: Placing | None = None

    def problems(self) -> Iterator[Problem]:
        if self.projector_nominal and not self.projector:
            yield ("projector_nominal",), "needs a projector: this pair is a camera alone"


class FrameNames(Model):
    """What `{frame}` becomes in the file-name template, for each kind of image.

    `pattern` and `inverse` hold `{bit}` (0 is the most significant), `phase` holds `{step}` and
    `stripe` `{stripe}`; or they are lists, one name an image.
    """

    lit: str = "lit"
    dark: str | None = "dark"
    pattern: str | tuple[str, ...] = "bit{bit:02d}"
    inverse: str | tuple[str, ...] = "bit{bit:02d}-inverse"
    phase: str | tuple[str, ...] = "phase{step:02d}"
    stripe: str | tuple[str, ...] = "stripe{stripe:03d}"
    index: str = "index"

    def of_kind(self, kind: FrameKind, count: int) -> tuple[str, ...]:
        """Names of so many images of one kind, in the code's order."""
        names = getattr(self, kind)
        if isinstance(names, str):
            return tuple(names.format(bit=i, step=i, stripe=i) for i in range(count))
        return tuple(names)

    def of_code(self, projector: ProjectorSpec) -> tuple[str, ...]:
        """Names of a code's images, lit and dark left out, in the order of `frame_counts`."""
        counts = projector.frame_counts.items()
        return tuple(name for kind, count in counts for name in self.of_kind(kind, count))

    def problems(self) -> Iterator[Problem]:
        return rig_checks.frame_problems(self)


class CaptureFolder(Model):
    """A folder of captures; relative to the rig file. `shots` overrides its captures.yaml."""

    folder: Annotated[str, Field(min_length=1)]
    files: str | None = None
    shots: tuple[Name, ...] | None = None

    def problems(self) -> Iterator[Problem]:
        for index, name in duplicates(self.shots or ()):
            yield ("shots", index), f"is a shot named twice ({name})"


class RigFrame(Model):
    """How the rig frame is fixed: by a board in one shot, or by one pair at its nominal placing.

    With `pair`: that pair's camera stands exactly at its `nominal` placing (image upright: its y
    axis points down as far as may be); without a nominal placing the rig frame is the camera frame
    itself. With neither, the first pair of the file is meant.

    With `shot`: the board's origin lies at `origin_mm`, its x axis points along `x_axis` and its
    y axis along `y_axis` in the rig frame. The default is a board laid face up on the floor,
    printed side up, columns running the way the subject faces.
    """

    shot: Name | None = None
    board: Name | None = None
    origin_mm: Vector = (0.0, 0.0, 0.0)
    x_axis: Vector = (1.0, 0.0, 0.0)
    y_axis: Vector = (0.0, -1.0, 0.0)
    pair: Name | None = None

    def problems(self) -> Iterator[Problem]:
        return rig_checks.rig_frame_problems(self)


class Volume(Model):
    """The scan volume: an upright cylinder on the floor around the rig's centre."""

    radius_mm: PositiveFloat = 700.0
    bottom_mm: float = 5.0
    top_mm: PositiveFloat = 2200.0

    def problems(self) -> Iterator[Problem]:
        if self.bottom_mm >= self.top_mm:
            yield (
                ("bottom_mm",),
                f"must lie below top_mm ({self.top_mm:g}) (got {self.bottom_mm:g})",
            )


class Rig(Model):
    """The whole rig file."""

    version: Literal[1] = 1
    name: Name
    boards: tuple[Board, ...] = Field(min_length=1)
    pairs: tuple[Pair, ...] = Field(min_length=1)
    calibration: tuple[CaptureFolder, ...] = ()
    files: str = "{shot}/{pair}/{frame}.png"
    frames: FrameNames = FrameNames()
    rig_frame: RigFrame = RigFrame()
    volume: Volume = Volume()

    def pair(self, name: str) -> Pair:
        """The pair of that name; KeyError if there is none."""
        return {pair.name: pair for pair in self.pairs}[name]

    def board(self, name: str) -> Board:
        """The board of that name; KeyError if there is none."""
        return {board.name: board for board in self.boards}[name]

    @property
    def poles(self) -> dict[str, str]:
        """The pole of each pair that stands on one."""
        return {pair.name: pair.pole for pair in self.pairs if pair.pole}

    @property
    def frame_pair(self) -> Pair | None:
        """The pair that fixes the rig frame, or None where a board in a shot does."""
        if self.rig_frame.shot is not None:
            return None
        return self.pair(self.rig_frame.pair) if self.rig_frame.pair else self.pairs[0]

    @property
    def frame_board(self) -> Board | None:
        """The board that fixes the rig frame, or None where a pair does."""
        if self.rig_frame.shot is None:
            return None
        return self.board(self.rig_frame.board) if self.rig_frame.board else self.boards[0]

    def problems(self) -> Iterator[Problem]:
        return rig_checks.rig_problems(rig_checks.RigParts.of(self))
