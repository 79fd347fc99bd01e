"""Colours of light of one press, by what the lamp of the head has."""

from collections.abc import Sequence

from device.config.head_file import InstrumentSpec
from device.optics.matrix import lamps_of
from services.records.capture import OtherColour


def colours_of_lamp(spec: InstrumentSpec, wanted: Sequence[OtherColour]) -> tuple[OtherColour, ...]:
    """Return the `wanted` colours, amber in place of red on a ring that has amber and no red LEDs.

    Amber light stands for red in the picture. A colour that the ring does not have stays: the press reports it.
    """
    lamps = lamps_of(spec)
    if lamps is None or "red" in lamps or "amber" not in lamps:
        return tuple(wanted)
    return tuple(dict.fromkeys("amber" if colour == "red" else colour for colour in wanted))
