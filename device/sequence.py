"""Several frames that belong together: a burst in one light, or one frame of each colour with darkness between."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from device.errors import LightCut
from device.ports import Camera, Light
from device.values import Colour, Frame, Glow, Shot


def burst(
    camera: Camera, light: Light, glow: Glow, shot: Shot, count: int, into: NDArray[np.uint16] | None = None
) -> Iterator[Frame]:
    """`count` frames in one light, which is on until the last of them; `into` (count, rows, cols) is filled if given.

    Raises LightCut if the guard ends the light before, and then it is dark.
    """
    with light.on(glow):
        for k in range(count):
            yield lit(camera.expose(shot, None if into is None else into[k]))


def colours(camera: Camera, light: Light, glows: Sequence[Glow], shot: Shot) -> Iterator[tuple[Colour, Frame, Frame]]:
    """For each glow in turn its colour, a lit frame, and the dark frame that was taken right after it.

    Red, green, red again shows how far an eye has moved (optics.md 8.4). The eye rests between two colours.
    """
    for glow in glows:
        with light.on(glow):
            frame = lit(camera.expose(shot))
        yield glow.colour, frame, camera.expose(shot)


def lit(frame: Frame) -> Frame:
    """The same frame, if its light shone through the whole of its exposure; LightCut otherwise."""
    if frame.glow is None:
        raise LightCut("the light went out during the exposure: it had been on for too long")
    return frame
