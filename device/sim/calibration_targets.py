"""Simulated calibration targets: cap, flat-field screen, point source.

Each function returns the target's light, float32 electrons per second (rows, cols), to be assigned to `world.target`;
`world.target` = None means that the eye is in front of the head.
"""

import numpy as np

from device.sim.render import crop_or_pad
from device.sim.simulated_calibration import calibration_point
from device.sim.world import World
from device.values import Colour, Image

SCREEN_FALLOFF = 0.05  # relative falloff at the sensor's corners: no real screen is even, also directly before it


def cap(world: World) -> Image:
    """Return the light behind the closed cap: zero on every pixel."""
    return np.zeros(world.shape, np.float32)


def screen(world: World, e_per_s: float) -> Image:
    """Return a self-luminous screen: `e_per_s` in the middle, 5 % less in the corners, times the pixels' response."""
    rows, cols = (np.linspace(-1, 1, size, dtype=np.float32) for size in world.shape)
    even = np.float32(e_per_s) * (1 - np.float32(SCREEN_FALLOFF / 2) * (rows[:, None] ** 2 + cols[None, :] ** 2))
    return _with_response(world, even)


def point(
    world: World,
    e_per_s: float,
    moved_px: tuple[int, int] = (0, 0),
    moved_mm: float = 0.0,
    colour: Colour | None = None,
) -> Image:
    """Return the image of the calibration's point source, brightest pixel `e_per_s` before the pixels' response.

    The image is centred, then shifted by `moved_px` (down, right). `moved_mm` moves the source along the axis, away
    from the model eye's lens. `colour` None: the colour of the head's pictures.
    """
    caustic = calibration_point(world, moved_mm, colour)
    rows, cols = (size // 2 - by for size, by in zip(caustic.shape, moved_px, strict=True))
    image = crop_or_pad(caustic, world.shape, (rows, cols))
    return _with_response(world, image * np.float32(e_per_s / float(image.max())))


def _with_response(world: World, light: Image) -> Image:
    """Return the light multiplied by the pixels' relative response; unchanged if the response is uniform."""
    response = world.setup(world.spec.light.colour).whole_response
    return light if response is None else light * response
