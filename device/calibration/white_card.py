"""White card before the head: what the ring's light of each colour gives on a surface that is white.

The LEDs of the head light the card, so that its light has the spectra of a picture's light; the light of a display has
others. Only ratios between colours are used: uneven light that is alike in all colours cancels. The card is placed
behind the plane of the eye's pupil: in that plane the spots of the LEDs lie outside the part that the iris passes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from device.errors import CalibrationRefused
from device.recon.white_balance import light_dn_per_s
from device.values import Calibration, Colour, Frame, WhiteReference

MIN_DN = 20.0  # mean light of a frame above the dark one: with 1 % of error from a dark level that drifts by 0.2 DN
MAX_ROOM_SHARE = 0.3  # of room light, and dark current, over the lamp's light: it may change between two frames
MAX_SPREAD = 0.02  # of the frames of one colour, over their mean: about a just noticeable difference of colour
MAX_SATURATED = 0.001  # share of pixels at full scale
MAX_RATIO = 20.0  # between two colours: LEDs of a ring and quantum efficiencies differ by less
CARD_PLACE = "40 to 60 mm behind the place of the eye's pupil, square to the axis"
CARD_REMEDY = f"Put a matt white card, 60 mm wide, {CARD_PLACE}, and start again."


@dataclass(frozen=True)
class CardFrames:
    """Lit frames of the card in one colour, with the dark frame of the same exposure; `level`: of the lamp."""

    lit: Sequence[Frame]
    dark: Frame
    level: float


def white_reference(frames: Mapping[Colour, CardFrames], calibration: Calibration) -> WhiteReference:
    """Return the light of the card in each colour; CalibrationRefused with the reason for frames that are no white."""
    lights = {colour: _light_dn_per_s(colour, card_frames, calibration) for colour, card_frames in frames.items()}
    low = min(lights, key=lights.__getitem__)
    high = max(lights, key=lights.__getitem__)
    if lights[high] > MAX_RATIO * lights[low]:
        raise CalibrationRefused(
            f"the card returns {lights[high] / lights[low]:.0f} times as much {high} light as {low} light "
            f"(at most {MAX_RATIO:.0f})",
            "Use a card that is white, and check that all LEDs of the ring shine in each colour.",
        )
    return WhiteReference(tuple(lights.items()))


def _light_dn_per_s(colour: Colour, frames: CardFrames, calibration: Calibration) -> float:
    """Return the mean light of the frames in one colour at full drive; CalibrationRefused if they are not usable."""
    white_dn = calibration.sensor.white_dn
    dark = frames.dark.counts
    seconds = frames.dark.exposure_s * frames.level
    each = [light_dn_per_s(frame.counts, dark, calibration, seconds) for frame in frames.lit]
    mean_dn = float(np.mean(each)) * seconds
    room_dn = float(dark.mean()) - calibration.sensor.black_dn
    saturated = max(float((frame.counts >= white_dn).mean()) for frame in frames.lit)
    if saturated > MAX_SATURATED:
        raise CalibrationRefused(
            f"in {colour} light {saturated:.1%} of the pixels are saturated", "Move the card away from the head."
        )
    if not mean_dn >= MIN_DN:  # also NaN, of frames in another mode than the calibration
        raise CalibrationRefused(
            f"in {colour} light the card returns {mean_dn:.1f} DN (at least {MIN_DN:.0f})", CARD_REMEDY
        )
    if room_dn > MAX_ROOM_SHARE * mean_dn:
        raise CalibrationRefused(
            f"the room's light is {room_dn / mean_dn:.0%} of the lamp's in {colour} (at most {MAX_ROOM_SHARE:.0%})",
            "Darken the room, and start again.",
        )
    spread = float(np.ptp(each)) / float(np.mean(each))
    if spread > MAX_SPREAD:
        raise CalibrationRefused(
            f"in {colour} light the frames differ by {spread:.1%} (at most {MAX_SPREAD:.0%})",
            "Rest card and head on something, and start again.",
        )
    return float(np.mean(each))
