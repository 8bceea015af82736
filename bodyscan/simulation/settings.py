"""Every setting of a simulated scanner; each number with its unit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Optics:
    """The cameras.

    Each pair's true lens is drawn around these values; pixels are those of an image 1280 px wide
    and scale with the image.

    focal_widths: focal length in image widths; 1.18 sees 1.1 m at 1.3 m.
    focal_spread, aspect_spread: relative standard deviations of alpha, and of beta / alpha.
    skew_px: gamma.
    centre_px: standard deviation of the principal point about the middle.
    k1, k2 and their standard deviations: Eq. 3-4, in normalised coordinates.
    p_spread, k3_spread: standard deviations of what a real lens has besides, p1 and p2 (an axis off
        centre) and k3, as OpenCV numbers them.
    blur_px: standard deviation of the lens's point spread, px of the actual image (not scaled).
    defocus_px: added to it (in quadrature) at half the working distance; grows as
        |working distance / distance - 1|.
    vignetting: 0 none, 1 the full cos^4 law.
    samples: the image is sampled at samples x samples points per pixel.
    position_mm, angle_deg: standard deviation, per axis, of the true pose about the nominal one
        (projectors too).
    """

    focal_widths: float = 1.18
    focal_spread: float = 0.01
    aspect_spread: float = 0.002
    skew_px: float = -0.5
    centre_px: float = 10.0
    k1: float = -0.10
    k1_spread: float = 0.03
    k2: float = 0.05
    k2_spread: float = 0.02
    p_spread: float = 0.0
    k3_spread: float = 0.0
    blur_px: float = 0.6
    defocus_px: float = 0.0
    vignetting: float = 0.0
    samples: int = 3
    position_mm: float = 10.0
    angle_deg: float = 1.0


@dataclass(frozen=True)
class Projection:
    """The projectors.

    kind: `mirror`, a laser sheet swept by a rotating mirror whose surface lies off its axis, or
        `pinhole`, a projector with a lens (k1, k2 bend its sheets).
    mirror_offset_mm: how far the mirror's surface lies off its axis (lowest, highest).
    laser_mm: from the axis to the laser's apex.
    sheet_tilt_deg: the laser sheet's angle against the axis, give or take 30 %.
    aim_mm: standard deviation of how far it misses the axis.
    near, far: the sweep covers the image between these distances, in working distances.
    margin: share of the sweep added at each end.
    blur_stripes: standard deviation of the light's spread across the stripes, in stripes.
    defocus_stripes: added to it (in quadrature) at half the working distance; grows as
        |working distance / distance - 1|.
    jitter_stripes: standard deviation of each stripe boundary's place, drawn anew for each frame.
    smile_stripes: how far a stripe's ends are bowed from its middle.
    speckle: standard deviation of the laser's brightness, relative, drawn anew for each frame.
    flicker: standard deviation of each frame's brightness, relative.
    gamma: exponent from grey value to light; black and white do not change.
    k1, k2: lens of the pinhole kind.
    """

    kind: Literal["mirror", "pinhole"] = "mirror"
    mirror_offset_mm: tuple[float, float] = (5.0, 10.0)
    laser_mm: float = 45.0
    sheet_tilt_deg: float = 1.0
    aim_mm: float = 1.0
    near: float = 0.62
    far: float = 1.4
    margin: float = 0.02
    blur_stripes: float = 0.25
    defocus_stripes: float = 0.0
    jitter_stripes: float = 0.0
    smile_stripes: float = 0.0
    speckle: float = 0.0
    flicker: float = 0.0
    gamma: float = 1.0
    k1: float = -0.12
    k2: float = 0.05


@dataclass(frozen=True)
class Lighting:
    """Brightness. Grey levels are those at exposure 1 unless stated otherwise.

    laser_grey: of a perfectly white surface that faces the projector at 0.85 working distances.
    ambient_grey: added by the room's own light to a perfectly white surface.
    window_grey: added by a large window if a white surface faces it; it is so large that its
        shadows have no edges.
    window_from: direction to the window from the rig's centre.
    mains_hz, mains_depth: how often lamps pulse, and how far, relative (that of `ambient_grey`).
    board_grey, person_grey: each pair sets its exposure for each shot, so that the brightest
        thousandth of the lit image begins at this grey level.
    shortest, longest: exposures it can set.
    """

    laser_grey: float = 240.0
    ambient_grey: float = 10.0
    window_grey: float = 0.0
    window_from: tuple[float, float, float] = (0.5, -0.8, 0.4)
    mains_hz: float = 100.0
    mains_depth: float = 0.0
    board_grey: float = 235.0
    person_grey: float = 230.0
    shortest: float = 0.4
    longest: float = 2.5


@dataclass(frozen=True)
class Noise:
    """The sensor. Grey levels are rounded to 0..255.

    electrons_per_grey: photo-electrons per grey level (shot noise at grey 200 is then
        sqrt(200 / 140) = 1.2).
    photons: scales the number of photons, not the brightness.
    read_grey: read noise, grey levels.
    pixel_gain, pixel_grey: standard deviations of each pixel's own gain, relative, and of its dark
        level: the same in all of a camera's images.
    gain_flicker: standard deviation of each frame's gain, relative.
    """

    electrons_per_grey: float = 140.0
    photons: float = 1.0
    read_grey: float = 0.7
    pixel_gain: float = 0.0
    pixel_grey: float = 0.0
    gain_flicker: float = 0.0


@dataclass(frozen=True)
class BoardMaking:
    """How well the board is made.

    white, black, side: albedo.
    bow_mm: how far its middle stands out towards the front.
    warp_mm: each board is also bent and twisted by between these two, from its highest to its
        lowest place.
    print_error_mm: standard deviation, per axis, of where a corner of a square was printed: a slow
        wave over the board.
    """

    white: float = 0.8
    black: float = 0.06
    side: float = 0.3
    bow_mm: float = 0.0
    warp_mm: tuple[float, float] = (0.0, 0.0)
    print_error_mm: float = 0.0


@dataclass(frozen=True)
class Person:
    """The subject, and how it moves.

    skin: mean albedo.
    skin_variation: how much it varies over the body, relative.
    subdivisions: Loop subdivisions of the subject's mesh.
    size: factor on the subject's mesh.

    The rest happens while frames are taken, each at its own moment, and is smooth and random;
    `presets.SUBJECTS` has values for people.
    sway_mm_s: as an inverted pendulum on the ankles; RMS speed of the top of the head.
    breath_mm, breath_s: how far chest and belly move from breathed out to breathed in, and the
        duration of a breath.
    arms_deg, head_deg: RMS rotation of each arm about its shoulder and of the head about the neck.
    """

    skin: float = 0.62
    skin_variation: float = 0.10
    subdivisions: int = 2
    size: float = 1.0
    sway_mm_s: float = 0.0
    breath_mm: float = 0.0
    breath_s: float = 3.5
    arms_deg: float = 0.0
    head_deg: float = 0.0


@dataclass(frozen=True)
class Skin:
    """What covers the subject, besides its mean albedo (`Person.skin`).

    spread_mm: light's mean free path under the skin; 0: none enters.
    stays: share that does not enter.
    albedo: of the path inside.
    gloss: brightness of a highlight's middle, relative to white paper.
    gloss_power: the larger, the smaller the highlight.
    mottling: standard deviation of the albedo over millimetres, relative.
    moles: their number.
    hair: albedo of the scalp's hair; 0: bald.
    hair_mm: its roughness, standard deviation.
    shorts: albedo of a pair of shorts; 0: none.
    """

    spread_mm: float = 0.0
    stays: float = 0.07
    albedo: float = 0.62
    gloss: float = 0.0
    gloss_power: float = 40.0
    mottling: float = 0.0
    moles: int = 0
    hair: float = 0.0
    hair_mm: float = 1.0
    shorts: float = 0.0


@dataclass(frozen=True)
class Pace:
    """When frames of a person are taken. Each is so short that nothing moves in it.

    frame_ms: from one frame to the next; by default 120 per second.
    start: of the pairs; as `timing` of captures.yaml.
    order: names of frames as they are taken, () as `FrameNames.sequence_names` lists them: patterns,
        then inverses, which is not the order that `bodyscan patterns` proposes.
    """

    frame_ms: float = 1000.0 / 120.0
    start: Literal["one-after-another", "together", "poles"] = "one-after-another"
    order: tuple[str, ...] = ()


@dataclass(frozen=True)
class Room:
    """Floor at z = 0 and four walls, so that stripes fall behind the board too.

    wall_mm: from the rig's centre to the walls, but at least twice as far as the cameras.
    """

    floor: float = 0.22
    wall: float = 0.25
    wall_mm: float = 2600.0


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
