"""Every setting of a simulated scanner; each number with its unit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Optics:
    """The cameras: each pair's true lens is drawn around these values.

    Pixels are those of an image 1280 px wide and scale with the image, unless stated otherwise.
    A `spread` is a standard deviation.
    """

    focal_widths: float = 1.18  # focal length in image widths; sees 1.1 m at 1.3 m
    focal_spread: float = 0.01  # of alpha, relative
    aspect_spread: float = 0.002  # of beta / alpha, relative
    skew_px: float = -0.5  # gamma
    centre_px: float = 10.0  # standard deviation of the principal point about the middle
    k1: float = -0.10  # Eq. 3-4, in normalised coordinates
    k1_spread: float = 0.03
    k2: float = 0.05
    k2_spread: float = 0.02
    p_spread: float = 0.0  # of OpenCV's p1 and p2: an axis off centre
    k3_spread: float = 0.0  # of OpenCV's k3
    blur_px: float = 0.6  # standard deviation of the point spread, px of the actual image
    # Added to it (in quadrature) at half the working distance; grows as
    # |working distance / distance - 1|.
    defocus_px: float = 0.0
    vignetting: float = 0.0  # 0 none, 1 the full cos^4 law
    samples: int = 3  # the image is sampled at samples x samples points per pixel
    # Standard deviation, per axis, of the true pose about the nominal one (projectors too).
    position_mm: float = 10.0
    angle_deg: float = 1.0


@dataclass(frozen=True)
class Projection:
    """The projectors: `mirror`, a laser sheet swept by a rotating mirror whose surface lies off its
    axis, or `pinhole`, a projector with a lens (k1, k2 bend its sheets)."""

    kind: Literal["mirror", "pinhole"] = "mirror"
    mirror_offset_mm: tuple[float, float] = (5.0, 10.0)  # mirror's surface to its axis: range
    laser_mm: float = 45.0  # from the axis to the laser's apex
    sheet_tilt_deg: float = 1.0  # the laser sheet's angle against the axis, give or take 30 %
    aim_mm: float = 1.0  # standard deviation of how far it misses the axis
    # The sweep covers the image between these distances, in working distances.
    near: float = 0.62
    far: float = 1.4
    margin: float = 0.02  # share of the sweep added at each end
    # Standard deviation of the light's spread across the stripes, and what is added to it (in
    # quadrature) at half the working distance; grows as |working distance / distance - 1|.
    blur_stripes: float = 0.25
    defocus_stripes: float = 0.0
    jitter_stripes: float = 0.0  # standard deviation of each boundary, drawn anew for each frame
    smile_stripes: float = 0.0  # how far a stripe's ends are bowed from its middle
    speckle: float = 0.0  # standard deviation of brightness, relative, drawn anew for each frame
    flicker: float = 0.0  # standard deviation of each frame's brightness, relative
    gamma: float = 1.0  # exponent from grey value to light; black and white do not change
    k1: float = -0.12  # of the pinhole kind
    k2: float = 0.05


@dataclass(frozen=True)
class Lighting:
    """Brightness. Grey levels are those at exposure 1 unless stated otherwise."""

    laser_grey: float = 240.0  # of a white surface facing the projector at 0.85 working distances
    ambient_grey: float = 10.0  # added by the room's own light to a white surface
    # Added by a window if a white surface faces it; so large that its shadows have no edges.
    window_grey: float = 0.0
    window_from: tuple[float, float, float] = (0.5, -0.8, 0.4)  # direction from the rig's centre
    mains_hz: float = 100.0  # how often lamps pulse
    mains_depth: float = 0.0  # and how far, relative (that of `ambient_grey`)
    # Each pair sets its exposure for each shot, so that the brightest thousandth of the lit image
    # begins at this grey level, between the shortest and the longest exposure it can set.
    board_grey: float = 235.0
    person_grey: float = 230.0
    shortest: float = 0.4
    longest: float = 2.5


@dataclass(frozen=True)
class Noise:
    """The sensor. Grey levels are rounded to 0..255; figures are standard deviations."""

    electrons_per_grey: float = 140.0  # shot noise at grey 200 is then sqrt(200 / 140) = 1.2
    photons: float = 1.0  # scales the number of photons, not the brightness
    read_grey: float = 0.7
    # Each pixel's own gain, relative, and dark level: the same in all of a camera's images.
    pixel_gain: float = 0.0
    pixel_grey: float = 0.0
    gain_flicker: float = 0.0  # of each frame's gain, relative


@dataclass(frozen=True)
class BoardMaking:
    """How well the board is made."""

    white: float = 0.8  # albedo
    black: float = 0.06
    side: float = 0.3
    bow_mm: float = 0.0  # how far its middle stands out towards the front
    # Each board is also bent and twisted by between these two, from its highest to its lowest point.
    warp_mm: tuple[float, float] = (0.0, 0.0)
    # Standard deviation, per axis, of where a square's corner was printed: a slow wave.
    print_error_mm: float = 0.0


@dataclass(frozen=True)
class Person:
    """The subject, and how it moves.

    From `sway_mm_s` on: what happens while frames are taken, each at its own moment, smooth and
    random; `presets.SUBJECTS` has values for people.
    """

    skin: float = 0.62  # mean albedo
    skin_variation: float = 0.10  # how much it varies over the body, relative
    subdivisions: int = 2  # Loop subdivisions of the subject's mesh
    size: float = 1.0  # factor on the subject's mesh
    sway_mm_s: float = 0.0  # inverted pendulum on the ankles; RMS speed of the top of the head
    breath_mm: float = 0.0  # how far chest and belly move from breathed out to breathed in
    breath_s: float = 3.5  # duration of a breath
    arms_deg: float = 0.0  # RMS rotation of each arm about its shoulder
    head_deg: float = 0.0  # and of the head about the neck


@dataclass(frozen=True)
class Skin:
    """What covers the subject, besides its mean albedo (`Person.skin`)."""

    spread_mm: float = 0.0  # light's mean free path under the skin; 0: none enters
    stays: float = 0.07  # share that does not enter
    albedo: float = 0.62  # of the path inside
    gloss: float = 0.0  # brightness of a highlight's middle, relative to white paper
    gloss_power: float = 40.0  # the larger, the smaller the highlight
    mottling: float = 0.0  # standard deviation of the albedo over millimetres, relative
    moles: int = 0  # their number
    hair: float = 0.0  # albedo of the scalp's hair; 0: bald
    hair_mm: float = 1.0  # its roughness, standard deviation
    shorts: float = 0.0  # albedo of a pair of shorts; 0: none


@dataclass(frozen=True)
class Pace:
    """When frames of a person are taken. Each is so short that nothing moves in it."""

    frame_ms: float = 1000.0 / 120.0  # from one frame to the next
    # Of the pairs; as `timing` of captures.yaml.
    start: Literal["one-after-another", "together", "poles"] = "one-after-another"
    # Names of frames as they are taken, () as `FrameNames.sequence_names` lists them: patterns, then
    # inverses, which is not the order that `bodyscan patterns` proposes.
    order: tuple[str, ...] = ()


@dataclass(frozen=True)
class Room:
    """Floor at z = 0 and four walls, so that stripes fall behind the board too."""

    floor: float = 0.22  # albedo
    wall: float = 0.25
    wall_mm: float = 2600.0  # from the rig's centre, but at least twice as far as the cameras


@dataclass(frozen=True)
class SimulationSettings:
    """All settings of a simulated scanner."""

    optics: Optics = field(default_factory=Optics)
    projection: Projection = field(default_factory=Projection)
    lighting: Lighting = field(default_factory=Lighting)
    noise: Noise = field(default_factory=Noise)
    board: BoardMaking = field(default_factory=BoardMaking)
    person: Person = field(default_factory=Person)
    skin: Skin = field(default_factory=Skin)
    pace: Pace = field(default_factory=Pace)
    room: Room = field(default_factory=Room)
