"""The cornea's mirror image of the ring, as far as the polarisers let it through (optics.md 3.6)."""

from math import asin, cos, degrees, pi, radians, sin

import numpy as np

from device.sim.setup import Scene, Setup, Size
from device.values import Image

name = "reflex"

CORNEA_MM = 7.8
CORNEA_R = (0.376 / 2.376) ** 2
TISSUE_R = 0.0141  # of the perifovea in green, to which the share refers
LEDS = 12
ETA_PER_SHARE = 45.0  # a smooth blob outside the fitted basis: 0.45 per 1 % of the mean


def ring_mm(scene: Scene) -> float:
    """Radius of the ring's image at the pupil."""
    return scene.sim.light.ring_um / 2000 * scene.optics.angular_magnification


def reflex_deg(scene: Scene) -> float:
    """How far from the axis the mirror image stands: a ray parallel to the axis leaves at twice its slope."""
    return 2 * degrees(asin(min(ring_mm(scene) / CORNEA_MM, 1.0))) - scene.half_field_deg


def share(scene: Scene) -> float:
    """The reflex over the mean signal of the tissue."""
    return CORNEA_R * scene.sim.light.polariser_leak / TISSUE_R


def size(scene: Scene) -> Size:
    """Nothing without a cornea, nothing if it misses the field, else by its share."""
    if scene.sim.eye.shown_by != "human eye":
        return Size(0.0, "there is no cornea in front")
    away_deg = reflex_deg(scene)
    if away_deg > scene.half_field_deg:
        return Size(0.0, f"the reflex stands {away_deg:.1f} deg off the axis, outside the field")
    return Size(ETA_PER_SHARE * share(scene) * scene.weight, f"{share(scene):.2%} of the mean signal, in the field")


def apply(setup: Setup) -> None:
    """Twelve discs of the iris's width, smooth because the cornea's focus is 256 dpt away."""
    setup.veils[name] = spots(setup.scene, setup.shape) * np.float32(share(setup.scene))


def spots(scene: Scene, shape: tuple[int, int]) -> Image:
    """The mirror images on the sensor, float32 (rows, cols); 1 in the middle of each, 0 where none falls."""
    optics, pitch_um = scene.optics, scene.spec.camera.pitch_um
    out = np.zeros(shape, np.float32)
    if scene.sim.eye.shown_by != "human eye":
        return out
    away_um = optics.angular_magnification * optics.diffuser_to_sensor_um * radians(max(reflex_deg(scene), 0.0))
    y_um, x_um = ((np.arange(n) - n // 2) * pitch_um for n in shape)
    for led in range(LEDS):
        turn = 2 * pi * led / LEDS
        squared = (y_um[:, None] - away_um * sin(turn)) ** 2 + (x_um[None, :] - away_um * cos(turn)) ** 2
        out += np.exp(-squared / (2 * (optics.iris_um / 4) ** 2)).astype(np.float32)
    return out
