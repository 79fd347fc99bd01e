"""The cornea's mirror image of the ring, as far as the polarisers let it through (optics.md 3.6)."""

from math import asin, cos, degrees, exp, pi, radians, sin

import numpy as np

from device.sim.setup import Scene, Setup, Size
from device.values import Image

name = "reflex"

CORNEA_MM = 7.8
CORNEA_R = (0.376 / 2.376) ** 2
TISSUE_R = 0.0141  # of the perifovea in green, to which the share refers
LEDS = 12
WIDTH = 0.25  # of the iris: the sigma of a blob that fills it
ETA_PER_SHARE = 55.0  # a smooth blob outside the fitted basis, by its brightest place


def ring_mm(scene: Scene) -> float:
    """Radius of the ring's image at the pupil."""
    return scene.sim.light.ring_um / 2000 * scene.optics.angular_magnification


def reflex_deg(scene: Scene) -> float:
    """How far from the axis the mirror image stands: a ray parallel to the axis leaves at twice its slope."""
    return 2 * degrees(asin(min(ring_mm(scene) / CORNEA_MM, 1.0))) - scene.half_field_deg


def share(scene: Scene) -> float:
    """The reflex over the mean signal of the tissue."""
    return CORNEA_R * scene.sim.light.polariser_leak / TISSUE_R


def seen(scene: Scene) -> bool:
    """Whether there is a cornea, and its mirror image stands inside the field."""
    return scene.sim.eye.shown_by == "human eye" and reflex_deg(scene) <= scene.half_field_deg


def brightest(scene: Scene) -> float:
    """Where the spots overlap most, on one of them or amid all: over the mean signal of the tissue."""
    if not seen(scene):
        return 0.0
    away, wide = away_um(scene), WIDTH * scene.optics.iris_um
    chords = (2 * away * sin(pi * k / LEDS) for k in range(LEDS))
    amid = LEDS * exp(-((away / wide) ** 2) / 2)
    return share(scene) * max(sum(exp(-((chord / wide) ** 2) / 2) for chord in chords), amid)


def size(scene: Scene) -> Size:
    """Nothing without a cornea, nothing if it misses the field, else by how bright it is."""
    if scene.sim.eye.shown_by != "human eye":
        return Size(0.0, "there is no cornea in front")
    if not seen(scene):
        return Size(0.0, f"the reflex stands {reflex_deg(scene):.1f} deg off the axis, outside the field")
    why = f"up to {brightest(scene):.2%} of the mean signal, {reflex_deg(scene):.1f} deg off the axis"
    return Size(ETA_PER_SHARE * brightest(scene) * scene.weight, why)


def apply(setup: Setup) -> None:
    """Twelve discs of the iris's width, smooth because the cornea's focus is 256 dpt away."""
    if seen(setup.scene):
        setup.veils[name] = spots(setup.scene, setup.shape) * np.float32(share(setup.scene))


def away_um(scene: Scene) -> float:
    """How far from the axis the spots stand on the sensor."""
    optics = scene.optics
    return optics.angular_magnification * optics.diffuser_to_sensor_um * radians(max(reflex_deg(scene), 0.0))


def spots(scene: Scene, shape: tuple[int, int]) -> Image:
    """The mirror images on the sensor, float32 (rows, cols); each is 1 in its middle, where they overlap they add."""
    away, wide = away_um(scene), WIDTH * scene.optics.iris_um
    y_um, x_um = ((np.arange(n) - n // 2) * scene.spec.camera.pitch_um for n in shape)
    out = np.zeros(shape, np.float32)
    for led in range(LEDS):
        turn = 2 * pi * led / LEDS
        squared = (y_um[:, None] - away * sin(turn)) ** 2 + (x_um[None, :] - away * cos(turn)) ** 2
        out += np.exp(-squared / (2 * wide**2)).astype(np.float32)
    return out
