"""Colours to the bytes of an APA102 chain: pure, so that every byte can be checked without a wire."""

import numpy as np
from numpy.typing import NDArray

from device.drivers.blank import blank_frame

FULL_MA = 20.0  # one colour of one LED at 255: data sheets differ, the larger figure is budgeted


def encoded(rgb: NDArray[np.uint8]) -> bytes:
    """One frame for (leds, 3) values of red, green, blue: 4 zero bytes, 4 per LED, zero tail; 268 bytes for 64.

    Global brightness is 31 always: below that it is a slow PWM of its own, which beats with the shutter.
    """
    leds = len(rgb)
    frame = np.frombuffer(blank_frame(leds), np.uint8).copy()
    frame[4 : 4 + 4 * leds].reshape(leds, 4)[:, 1:] = rgb[:, ::-1]
    return frame.tobytes()


def current_ma(rgb: NDArray[np.uint8]) -> float:
    """What the chain draws for these values, above its rest."""
    return float(rgb.sum(dtype=np.int64)) * FULL_MA / 255


def levels(level: float, output: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The drive, 1 to 255, that makes LEDs of relative `output` equally bright: all as the weakest at `level`."""
    drive: NDArray[np.uint8] = np.clip(np.rint(255 * level * output.min() / output), 1, 255).astype(np.uint8)
    return drive
