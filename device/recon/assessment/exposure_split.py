"""Split of an exposure into shorter ones while the eye moves: no more light, in more frames, which are registered.

Loss of a picture against one exposure of a still eye, in dB, for m frames that share the light of a press:

    loss(m) = 2 / (1 + (d0 m / D)^2) + min(0.2 ((m - 1) D / (m d0))^2, 0.55) + 0.0106 (m - 1) (220 / L)^0.7
    d0      = 0.372 (220 / L)^0.34        degrees

The first term is the motion blur of one frame, the second the displacement between the frames, the third read noise and
registration. D: motion of the eye over the light of the press, degrees; d0: motion within one frame at which blur costs
1 dB; L: light of the press, mean electrons per um^2 of the sensor. Fitted to 18 pictures of one photograph (one
exposure, 4 and 8 frames; none to 12 pixels of 0.064 degrees; 22 and 220 electrons per um^2), at most 0.16 dB off; on
four other photographs up to 0.44 dB off. The lamp stays on during the overhead o of a frame (read-out, wait for its
begin), seconds. A press must not have more light than without a split: the p parts of an exposure of T seconds and
their overheads fill T + o, so that each part lasts (T + o) / p - o. Lost light counts at 0.7 dB per halving.
NUMERICS.md 9.3.
"""

from dataclasses import dataclass
from math import log2, pow

from device.recon.assessment.frame_quality import MIN_E_PER_UM2

MAX_FRAMES = 8  # of a press: what the fit rests on
MIN_MOTION_DEG = 0.257  # of a split, during one exposure: 4 pixels of the paper's sensor
MIN_GAIN_DB = 0.16  # the largest error of the fit
MIN_PART_E_PER_UM2 = 1.25 * MIN_E_PER_UM2  # of one frame, which the frame quality must not call dark

REFERENCE_E_PER_UM2, BLUR_DEG, BLUR_DB, BLUR_POWER = 220.0, 0.372, 2.0, 0.34
DISPLACED_DB, MAX_DISPLACED_DB = 0.2, 0.55
FRAME_DB, FRAME_POWER = 0.0106, 0.7
MAX_DARK_RATIO = 1.5  # a frame of twice the exposure has twice the dark current
HALVING_DB = 0.7  # of half the light, measured with one and two frames of six photographs


@dataclass(frozen=True)
class ExposureSplit:
    """Split of each exposure of a press into parts, with its predicted gain.

    Without a split `parts` is 1, `part_s` None, and the others are 0, whatever the eye does.

    Attributes
    ----------
    parts
        Number of parts.
    motion_deg
        Motion of the eye during one whole exposure.
    gain_db
        Gain over exposures that are not split, less what the shorter light loses.
    part_s
        Duration of each part in s.
    """

    parts: int = 1
    motion_deg: float = 0.0
    gain_db: float = 0.0
    part_s: float | None = None


WHOLE = ExposureSplit()


@dataclass(frozen=True)
class PressLight:
    """What is known of the exposures of the next press from those before.

    Attributes
    ----------
    light_e_per_um2_s
        Mean light on the sensor per second of exposure.
    overhead_s
        What a frame takes longer than its exposure, in s.
    """

    light_e_per_um2_s: float
    overhead_s: float


def choose_split(
    count: int, exposure_s: float, speed_deg_per_s: float | None, known: PressLight | None
) -> ExposureSplit:
    """Return how to split each of the `count` exposures of a press, `exposure_s` seconds each.

    `speed_deg_per_s`: of the eye in the aiming stream; None, or nothing `known` of the light: then nothing is split. A
    split press has at most MAX_FRAMES lit frames, each with enough light of its own, and is chosen for the largest
    predicted gain, at least MIN_GAIN_DB, if the eye moves by more than MIN_MOTION_DEG during one exposure. The lamp
    is on for as long as for the whole exposures: parts and overheads fill the time of an exposure and one overhead.
    """
    if speed_deg_per_s is None or known is None or known.light_e_per_um2_s <= 0:
        return WHOLE
    motion_deg = speed_deg_per_s * exposure_s
    if motion_deg <= MIN_MOTION_DEG:
        return WHOLE
    possible = [_split(count, parts, exposure_s, motion_deg, known) for parts in range(2, MAX_FRAMES // count + 1)]
    best = max((split for split in possible if split is not None), key=lambda split: split.gain_db, default=WHOLE)
    return best if best.gain_db >= MIN_GAIN_DB else WHOLE


def _split(count: int, parts: int, exposure_s: float, motion_deg: float, known: PressLight) -> ExposureSplit | None:
    """Return the split into so many parts; None if a part would have too little light."""
    part_s = (exposure_s + known.overhead_s) / parts - known.overhead_s
    if known.light_e_per_um2_s * part_s < MIN_PART_E_PER_UM2:
        return None
    light_e_per_um2 = count * known.light_e_per_um2_s * exposure_s
    whole_db = loss_db(count, count * motion_deg, light_e_per_um2)
    parts_db = loss_db(count * parts, count * motion_deg, light_e_per_um2)
    lost_db = HALVING_DB * log2(exposure_s / (parts * part_s))
    return ExposureSplit(parts, motion_deg, whole_db - parts_db - lost_db, part_s)


def loss_db(frames: int, motion_deg: float, light_e_per_um2: float) -> float:
    """Return the loss of a picture of that many frames against one exposure of a still eye, dB; 0 or more.

    `motion_deg`: of the eye over the light of all frames, degrees; `light_e_per_um2`: of all frames, above 0.
    """
    relative = REFERENCE_E_PER_UM2 / light_e_per_um2
    moved = motion_deg / (BLUR_DEG * pow(relative, BLUR_POWER))
    blur_db = BLUR_DB * moved**2 / (moved**2 + frames**2)
    displaced_db = min(DISPLACED_DB * ((frames - 1) / frames * moved) ** 2, MAX_DISPLACED_DB)
    return blur_db + displaced_db + FRAME_DB * (frames - 1) * pow(relative, FRAME_POWER)


def dark_fits(exposure_s: float, dark_s: float) -> bool:
    """Return True if a frame of `exposure_s` seconds is not too long for a dark frame of `dark_s` seconds.

    A dark frame that is too long is accepted. That of a split press has the exposure of one part, which is at most half
    the exposure of the frames in other colours.
    """
    return exposure_s <= MAX_DARK_RATIO * dark_s
