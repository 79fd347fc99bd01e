"""Sequences of frames: several frames in one illumination, or a lit and a dark frame of each colour."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from device.errors import LightCut
from device.ports import Camera, Light
from device.values import Colour, ExposureSettings, Frame, Illumination


def burst(
    camera: Camera,
    light: Light,
    illumination: Illumination,
    shot: ExposureSettings,
    count: int,
    into: NDArray[np.uint16] | None = None,
) -> Iterator[Frame]:
    """Yield `count` frames in one illumination, which stays on from the first to the last of them.

    `into` (count, rows, cols) is filled if given. Raises LightCut if the guard ends the light early; the lamp is then
    dark.
    """
    with light.on(illumination):
        for k in range(count):
            yield require_lit(camera.expose(shot, None if into is None else into[k]))


def colour_sequence(
    camera: Camera, light: Light, illuminations: Sequence[Illumination], shot: ExposureSettings
) -> Iterator[tuple[Colour, Frame, Frame]]:
    """Yield for each illumination its colour, a lit frame, and the dark frame taken right after it.

    Red, green, red again shows the movement of an eye (OPTICS.md 4.5). The lamp is dark between two colours. Raises
    LightCut if the guard ends a light early.
    """
    for glow in illuminations:
        with light.on(glow):
            frame = require_lit(camera.expose(shot))
        yield glow.colour, frame, camera.expose(shot)


def require_lit(frame: Frame) -> Frame:
    """Return the frame unchanged if the lamp was on for its whole exposure; raise LightCut otherwise."""
    if frame.illumination is None:
        raise LightCut("the light went out during the exposure: it had been on for too long")
    return frame
