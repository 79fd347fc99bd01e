"""What may stand before a simulated head instead of an eye: a cap, an even screen, the factory's point source.

Each is the light that it brings, float32 electrons per second (rows, cols); `world.stage` takes it, None is the eye.
"""

import numpy as np

from device.sim.calibrate import calibration_point
from device.sim.render import fitted
from device.sim.world import World
from device.values import Colour, Image

SHADED = 0.05  # how much darker an even screen is at the sensor's corners: no screen is even


def cap(world: World) -> Image:
    """No light at all."""
    return np.zeros(world.shape, np.float32)


def screen(world: World, e_per_s: float) -> Image:
    """An even screen that shines by itself: `e_per_s` electrons per second in the middle, a little less outside."""
    rows, cols = (np.linspace(-1, 1, size, dtype=np.float32) for size in world.shape)
    even = np.float32(e_per_s) * (1 - np.float32(SHADED / 2) * (rows[:, None] ** 2 + cols[None, :] ** 2))
    return _seen(world, even)


def point(
    world: World, e_per_s: float, moved_px: tuple[int, int] = (0, 0), moved_mm: float = 0.0,
    colour: Colour | None = None,
) -> Image:  # fmt: skip
    """The factory's point source on the axis, its brightest pixel at `e_per_s`.

    `moved_px` is (down, right); `moved_mm` along the axis, away from the model eye's lens; no `colour`: the picture's.
    """
    caustic = calibration_point(world, moved_mm, colour)
    rows, cols = (size // 2 - by for size, by in zip(caustic.shape, moved_px, strict=True))
    there = fitted(caustic, world.shape, (rows, cols))
    return _seen(world, there * np.float32(e_per_s / float(there.max())))


def _seen(world: World, light: Image) -> Image:
    """As this sensor's pixels respond to it."""
    response = world.setup(world.spec.light.colour).response
    return light if response is None else light * response
