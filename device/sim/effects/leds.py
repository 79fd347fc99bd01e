"""Single LEDs of unequal strength: the ring stands where the pupil is imaged, so each floods the whole field.

optics.md 3.5: discreteness and spread are seen in the pupil, never in the image; only the common gain changes.
"""

from device.sim.setup import Scene, Setup, Size

name = "leds"


def size(scene: Scene) -> Size:
    """Exactly nothing after the common gain."""
    return Size(0.0, f"a spread of {scene.sim.light.led_spread:.0%} between LEDs changes only the common gain")


def apply(setup: Setup) -> None:
    """The mean of twelve LEDs: a gain, which the exposure takes out again."""
